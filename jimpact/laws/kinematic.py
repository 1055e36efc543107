"""The kinematic laws, which prescribe gap velocities: Newton, Moreau,
RestitutionMatrix.
"""

import abc
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from jimpact.core.contact import Contact
from jimpact.core.law import Impulses, Law, OptionalValues, Values, option, parameter
from jimpact.core.quasi_space import check_independent, quasi_basis
from jimpact.core.scene import Scene, momentum
from jimpact.laws.friction import friction_fields, frictional_impulses
from jimpact.numerics.dense import solve_symmetric
from jimpact.numerics.lcp import solve_lcp
from jimpact.numerics.tridiagonal import as_matrix, diagonal, is_regular
from jimpact.tools.checks import check_shape, is_traced
from jimpact.tools.compiling import full_precision
from jimpact.tools.precision import precision
from jimpact.tools.status import CODE


class Kinematic(Law):
    """A law that prescribes the normal velocities: `gamma+ = -E gamma-`, E of any form.

    Equation: with `b = |grad f| (I + E) qn-`, prescribed: `W p + b = 0`; complementary:
    `0 <= W p + b  _|_  p >= 0`. With friction `W_nt p_t` is added, and
    `p_t in -mu p Sgn(u+ + e_t u-)`.
    """

    complementary: ClassVar[bool]

    if TYPE_CHECKING:  # fields of each law, in its own order

        @property
        def friction(self) -> OptionalValues:
            """Coulomb's mu; None: no friction."""

        @property
        def tangential_restitution(self) -> OptionalValues:
            """e_t; None: no friction."""

    @property
    @abc.abstractmethod
    def coefficients(self) -> jax.Array:
        """E: (), its diagonal (m,), or (m, m)."""

    def required(self, contact: Contact) -> jax.Array:
        """`b = |grad f| (I + E) qn-` (m,) [m/s]: W p + b is `gamma+ + e gamma-` of a
        diagonal E.
        """
        e = self.coefficients
        gamma = contact.gap_velocity
        if e.ndim < 2:
            return (1 + e) * gamma
        return gamma + contact.norm * (e @ contact.normalized_gap_velocity)

    @full_precision
    def impulses(self, contact: Contact) -> Impulses:
        """Impulses by a linear system, a complementarity problem, or a friction
        problem.
        """
        required = self.required(contact)
        mu = self.friction
        e_t = self.tangential_restitution
        if mu is not None and e_t is not None:
            return frictional_impulses(
                contact, required, mu, e_t, complementary=self.complementary
            )
        w = contact.delassus
        if self.complementary:
            solution = solve_lcp(w, required)
            return Impulses(solution.z, None, solution.code)
        return prescribed_impulses(contact, required)


def prescribed_impulses(contact: Contact, required: jax.Array) -> Impulses:
    """Impulses p (m,) [N s] with `W p + b = 0`, b = `required` (m,) [m/s].

    Solved in normalized ones: `G pbar = -b / d`, `pbar = d p`, `G = W / (d d^T)`,
    `d_j = sqrt(W_jj)`; of redundant contacts those of least |pbar|.
    """
    w = contact.delassus
    d = jnp.sqrt(diagonal(w))
    g = as_matrix(w) / (d[:, None] * d[None, :])
    solution = solve_symmetric(g, -required / d, regular=is_regular(w))
    pbar, singular, unsolved = solution
    code = jnp.where(singular, CODE["impulse_not_unique"], CODE["ok"])
    code = jnp.where(unsolved, CODE["infeasible"], code)
    return Impulses(pbar / d, None, code)


class _WithCoefficient(Kinematic):
    """E is one number, or one per contact."""

    restitution: Values = parameter(low=0.0, high=1.0)
    friction: OptionalValues = parameter(low=0.0)
    tangential_restitution: OptionalValues = parameter(low=-1.0, high=1.0)

    def __init__(
        self, restitution: Any, friction: Any = None, tangential_restitution: Any = 0.0
    ):
        self.restitution = restitution
        self.friction, self.tangential_restitution = friction_fields(
            friction, tangential_restitution
        )

    @property
    def coefficients(self) -> jax.Array:
        """e."""
        return self.restitution


class Newton(_WithCoefficient):
    """Newton's restitution at every contact, without complementarity.

    Equation: `gamma+ = -e gamma-`, hence `p = -W^-1 (I + diag(e)) gamma-`; with
    friction also `p_t in -mu p Sgn(v_t+ + e_t v_t-)`.

    Args:
        restitution: kinematic coefficient e in [0, 1], scalar or one per contact (m,).
        friction: Coulomb's mu >= 0, scalar or (m,), for scenes with tangents; None: no
            friction.
        tangential_restitution: e_t in [-1, 1], scalar or (m,): sticking is
            `v_t+ = -e_t v_t-`.

    Status: `negative_impulse` or `inadmissible_velocity` where the kinematic law
    contradicts unilateral contact (kinetic angles above pi/2, separating contacts,
    unequal e); `impulse_not_unique` for redundant contacts, `infeasible` where they
    contradict each other; with friction as in `RestitutionMatrix`.

    Derivatives, forward and reverse: v+ is linear in gamma- as long as a contact
    approaches. With friction they are one-sided where a contact begins to stick or to
    slide.

    Source: Brogliato, Nonsmooth Mechanics (2016), (6.44) with a diagonal E;
    (6.54)-(6.57).

    >>> import jimpact as ji
    >>> ji.impact(ji.Newton(0.5), ji.chain([1.0, 1.0]), [1.0, 0.0]).velocity.tolist()
    [0.25, 0.75]
    """

    complementary: ClassVar[bool] = False
    pulls: ClassVar[bool] = True
    separable: ClassVar[bool] = True


class Moreau(_WithCoefficient):
    """Moreau's impact law: a contact reverses its gap velocity or takes no impulse.

    Equation: `0 <= G pbar + (I + E) qn-  _|_  pbar >= 0`, in normalized gap velocities
    `qn = gamma / |grad f|` and impulses `pbar = |grad f| p`; with a scalar or diagonal
    E `0 <= gamma+ + e gamma-  _|_  p >= 0`. With friction also
    `p_t in -mu p Sgn(v_t+ + e_t v_t-)`.

    Args:
        restitution: e in [0, 1], scalar or one per contact (m,), or a matrix E (m, m).
        friction: Coulomb's mu >= 0, scalar or (m,), for scenes with tangents; None: no
            friction.
        tangential_restitution: e_t in [-1, 1], scalar or (m,): sticking is
            `v_t+ = -e_t v_t-`.

    Status: `inadmissible_velocity` where a contact that separated before the impact is
    driven together (the law then asks for gamma+ >= -e gamma- < 0 only); `energy_gain`,
    with unequal e; `infeasible` (a body squeezed between walls with unequal e);
    `impulse_not_unique` for redundant contacts (the p of least |pbar| is returned,
    where friction allows it). With friction there is a solution unless contacts jam
    (impulses that move nothing).

    Derivatives are one-sided where a contact is about to take part (p_j = 0 = gamma+ +
    e gamma-).

    Source: Moreau (1988); Brogliato, Nonsmooth Mechanics (2016), (6.51), (6.54).

    >>> import jimpact as ji
    >>> out = ji.impact(ji.Moreau(0.5), ji.chain([1.0, 2.0, 3.0]), [1.0, 0.0, 0.0])
    >>> [round(float(v), 6) for v in out.velocity]
    [-0.25, 0.25, 0.25]
    """

    complementary: ClassVar[bool] = True
    separable: ClassVar[bool] = True

    restitution: Values = parameter(low=0.0, high=1.0, matrix=True)

    @property
    def joins_step(self) -> bool:  # type: ignore[override]
        """Without a matrix."""
        return self.restitution.ndim < 2

    def check(self, scene: Scene, dtype: jnp.dtype) -> None:
        """A matrix must have one row and one column per contact."""
        if self.restitution.ndim == 2:
            shape = (scene.contacts, scene.contacts)
            check_shape("restitution", self.restitution, shape, "one row per contact")


class RestitutionMatrix(Kinematic):
    """A full matrix of kinematic coefficients between quasi-velocities of contacts.

    Equation: with E (m, m): `qn+ = -E qn-`, `qn_j = gamma_j / |grad f_j|`, hence
    `pbar = -G^-1 (I + E) qn-`, `p_j = pbar_j / |grad f_j|`; tangential velocities are
    conserved. With E (m + k, m + k), k = n - m - b: `(qn+, qt+) = -E (qn-, qt-)` in the
    basis of `ji.theory.quasi_basis`, E = [[E_nn, E_nt], [E_tn, E_tt]]. Impulses along
    the scene's tangents then carry the change of qt: `t_q^T H p_t = qt+ - qt-` (least
    p_t where several do), `pbar = G^-1 (qn+ - qn- - n_q^T H p_t)`. (Without friction
    E_tn = 0, E_tt = -I.) Bilateral constraints distort G and n_q as in (6.35). With
    friction, and E (m, m), `qn+ = -E qn-` and `p_t in -mu p Sgn(v_t+ + e_t v_t-)`.

    Args:
        matrix: E, (m, m) or (m + k, m + k), without dimension. Diagonal, it is
            `Newton`.
        admissible: whether `fit` keeps an (m, m) matrix consistent for all approach
            velocities `qn- <= 0`: `E >= 0` and `G^-1 (I + E) >= 0` elementwise,
            `G^-1 - E^T G^-1 E` copositive. An impact takes E as it is, whatever this
            says.
        friction: Coulomb's mu >= 0, scalar or (m,), for scenes with tangents; None: no
            friction.
        tangential_restitution: e_t in [-1, 1], scalar or (m,): sticking is
            `v_t+ = -e_t v_t-`.

    Open contacts take no part: their rows and columns of E count as zero; an (m + k, m
    + k) matrix needs closed contacts (ValueError; `infeasible` if traced).

    Status: `negative_impulse`, `inadmissible_velocity`, `energy_gain` where E
    contradicts unilateral contact or energy at this velocity; `infeasible` where
    contacts are redundant and contradict each other, or no tangential impulses give the
    change of qt; `impulse_not_unique` for redundant contacts. With friction
    `infeasible`, too, where normal and tangential directions couple so that neither
    sticking nor sliding is consistent, `several_outcomes` where more than one is
    (detected for up to 3 contacts; the one with most sticking contacts is returned),
    and `impulse_not_unique` where p_t is not determined (a block lying flat).

    Raises:
        ValueError: E not square, not finite, or not of a size that fits the scene;
            tangential blocks, or friction, for a scene without tangents; both together.

    Derivatives, forward and reverse: v+ is linear in gamma- as long as a contact
    approaches. With friction they are one-sided where a contact begins to stick or to
    slide.

    Source: Brogliato, Nonsmooth Mechanics (2016), (6.42)-(6.48), (6.53)-(6.57).

    >>> import jimpact as ji
    >>> law = ji.RestitutionMatrix(
    ...     [[0.1, 0.0], [0.8, 0.5]]
    ... )  # the striker's impact moves ball 3
    >>> out = ji.impact(law, ji.chain([1.0, 1.0, 1.0]), [1.0, 0.0, 0.0])
    >>> [round(float(v), 6) + 0.0 for v in out.velocity]
    [0.0, 0.1, 0.9]
    """

    complementary: ClassVar[bool] = False
    pulls: ClassVar[bool] = True

    matrix: Values = parameter(matrix=True)
    friction: OptionalValues = parameter(low=0.0)
    tangential_restitution: OptionalValues = parameter(low=-1.0, high=1.0)
    admissible: bool = option(default=True, converter=bool)

    def __init__(
        self,
        matrix: Any,
        admissible: bool = True,
        friction: Any = None,
        tangential_restitution: Any = 0.0,
    ):
        """Set the fields; raise a ValueError unless E is square, or for e_t without
        friction.
        """
        self.matrix = matrix
        self.admissible = admissible
        shape = np.shape(matrix)
        if len(shape) != 2 or shape[0] != shape[1] or shape[0] == 0:
            raise ValueError(
                f"Argument `matrix` must be square, (m, m) for m contacts or (m + k, m "
                f"+ k) with k tangential quasi-velocities, but has shape {shape}."
            )
        self.friction, self.tangential_restitution = friction_fields(
            friction, tangential_restitution
        )

    @property
    def coefficients(self) -> jax.Array:
        """E."""
        return self.matrix

    def check(self, scene: Scene, dtype: jnp.dtype) -> None:
        """Raise a ValueError where the size of E, or its tangential blocks, does not
        fit the scene.

        Tangential blocks need tangents, closed contacts and no `friction`.
        """
        m = scene.contacts
        size = self.matrix.shape[0]
        if size == m:
            return
        if self.friction is not None:
            raise ValueError(
                f"Argument `matrix` must have shape ({m}, {m}) with `friction`, which "
                f"decides about the tangential velocities itself, but has shape "
                f"{self.matrix.shape}."
            )
        if scene.constraints is None:
            constraints = 0
        else:
            constraints = scene.constraints.shape[1]
        full = scene.size - constraints
        if size != full or full < m:
            if full > m:
                other = f" or ({full}, {full})"
            else:
                other = ""
            raise ValueError(
                f"Argument `matrix` must have shape ({m}, {m}){other} for {m} contacts "
                f"and {full} free velocities, but has shape {self.matrix.shape}."
            )
        if scene.tangents is None:
            raise ValueError(
                f"Argument `matrix` must have shape ({m}, {m}) for {m} contacts "
                f"without tangents, but has shape {self.matrix.shape}: normal impulses "
                "cannot change tangential quasi-velocities."
            )
        gaps = scene.gaps
        if gaps is not None and not is_traced(gaps) and np.any(np.asarray(gaps) > 0):
            raise ValueError(
                "Argument `scene` must have closed contacts only for a `matrix` with "
                "tangential blocks: which quasi-velocities are tangential depends on "
                "the contacts."
            )
        check_independent(scene)

    @full_precision
    def contact(self, scene: Scene, velocity: jax.Array) -> Contact:
        """The contact; for an E with tangential blocks with qt- = t_q^T M v- and t_q^T
        H, too.
        """
        contact = super().contact(scene, velocity)
        if self.matrix.shape[0] == scene.contacts:
            return contact
        assert scene.tangents is not None  # see `check`
        _, basis = quasi_basis(scene)
        return QuasiContact(
            contact, basis.T @ momentum(scene, velocity), basis.T @ scene.tangents
        )

    @full_precision
    def impulses(self, contact: Contact) -> Impulses:
        """Impulses p (m,), p_t (t,) [N s] of either form of E, and status.

        Equation, with tangential blocks: `t_q^T H p_t = qt+ - qt-`, then
        `W p + |grad f| (qn- - qn+) + W_nt p_t = 0`.
        """
        if not isinstance(contact, QuasiContact):
            return super().impulses(contact)
        assert contact.cross is not None
        m = contact.contacts
        quasi = jnp.concatenate([contact.normalized_gap_velocity, contact.quasi])
        change = quasi + self.matrix @ quasi  # qn- - qn+, qt- - qt+
        size = jnp.abs(quasi).max()
        tangential, unsolved = _least_squares(contact.directions, -change[m:], size)
        required = contact.norm * change[:m] + contact.cross @ tangential
        p, _, code = prescribed_impulses(contact, required)
        infeasible = unsolved | ~jnp.all(contact.closed)
        return Impulses(p, tangential, jnp.where(infeasible, CODE["infeasible"], code))


class QuasiContact(Contact):
    """A contact with its tangential quasi-velocities qt- (k,) and `t_q^T H` (k, t)."""

    quasi: jax.Array
    directions: jax.Array

    def __init__(self, contact: Contact, quasi: jax.Array, directions: jax.Array):
        for name, value in vars(contact).items():
            setattr(self, name, value)
        self.quasi = quasi
        self.directions = directions


def _least_squares(
    matrix: jax.Array, right: jax.Array, size: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The x (t,) of least |x| that minimizes |A x - b|, A (k, t), b = `right` (k,).

    And True () where no x solves `A x = b`: the residual is not rounding, beside
    velocities of this `size` ().
    """
    x = jnp.linalg.pinv(matrix) @ right
    residual = jnp.abs(matrix @ x - right).max()
    return x, residual > precision(x.dtype).root * size
