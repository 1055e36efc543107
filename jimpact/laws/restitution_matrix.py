"""The generalized restitution matrix: `qn+ = -E qn-`, or `v+ = -E v-` in all quasi-velocities."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import as_float_array, check_values, is_traced
from jimpact.contact_space import (
    kinetic_norm,
    momentum,
    normalized_gap_velocity,
    velocity_change,
)
from jimpact.laws.base import Law, no_tangential_impulse
from jimpact.laws.friction import check_friction, friction_fields, frictional_impulses
from jimpact.scene import Scene
from jimpact.solvers.linear import solve_symmetric
from jimpact.solvers.tridiagonal import Symmetric, as_matrix, diagonal, is_regular
from jimpact.status import CODE
from jimpact.theory.quasi_velocities import check_independent, quasi_basis


class RestitutionMatrix(Law):
    """A full matrix of kinematic coefficients between the quasi-velocities of all contacts.

    Equation: with E (m, m): `qn+ = -E qn-`, `qn_j = gamma_j / |grad f_j|`, hence
    `pbar = -G^-1 (I + E) qn-`, `p_j = pbar_j / |grad f_j|`; tangential velocities are conserved.
    With E (m + k, m + k), k = n - m - b: `(qn+, qt+) = -E (qn-, qt-)` in the basis of
    `ji.theory.quasi_basis`, E = [[E_nn, E_nt], [E_tn, E_tt]]. Impulses along the
    scene's tangents then carry the change of qt: `t_q^T H p_t = qt+ - qt-` (least p_t where
    several do), `pbar = G^-1 (qn+ - qn- - n_q^T H p_t)`. (Without friction E_tn = 0, E_tt = -I.)
    Bilateral constraints distort G and n_q as in (6.35). With friction, and E (m, m),
    `qn+ = -E qn-` and `p_t in -mu p Sgn(v_t+ + e_t v_t-)`.

    Args:
        matrix: E, (m, m) or (m + k, m + k), without dimension. Diagonal, it is `Newton`.
        admissible: whether `fit` keeps an (m, m) matrix consistent for all approach velocities
            `qn- <= 0`: `E >= 0` and `G^-1 (I + E) >= 0` elementwise, `G^-1 - E^T G^-1 E`
            copositive. An impact takes E as it is, whatever this says.
        friction: Coulomb's mu >= 0, scalar or (m,), for scenes with tangents; None: no friction.
        tangential_restitution: e_t in [-1, 1], scalar or (m,): sticking is `v_t+ = -e_t v_t-`.

    Open contacts take no part: their rows and columns of E count as zero; an
    (m + k, m + k) matrix needs closed contacts (ValueError; `infeasible` if traced).

    Status: `negative_impulse`, `inadmissible_velocity`, `energy_gain` where E contradicts
    unilateral contact or energy at this velocity; `infeasible` where contacts are redundant and
    contradict each other, or no tangential impulses give the change of qt; `impulse_not_unique`
    for redundant contacts. With friction `infeasible`, too, where normal and tangential directions
    couple so that neither sticking nor sliding is consistent, `several_outcomes` where more than
    one is (found for up to 3 contacts; of them that which sticks most is given), and
    `impulse_not_unique` where p_t is not determined (a block lying flat).

    Raises:
        ValueError: E not square, not finite, or not of a size that fits the scene; tangential
            blocks, or friction, for a scene without tangents; both together.

    Source: Brogliato, Nonsmooth Mechanics (2016), (6.42)-(6.48), (6.53)-(6.57).

    >>> import jimpact as ji
    >>> law = ji.RestitutionMatrix([[0.1, 0.0], [0.8, 0.5]])  # the striker's impact moves ball 3
    >>> out = ji.impact(law, ji.chain([1.0, 1.0, 1.0]), [1.0, 0.0, 0.0])
    >>> [round(float(v), 6) for v in out.velocity]
    [0.0, 0.1, 0.9]
    """

    matrix: jax.Array
    friction: jax.Array | None
    tangential_restitution: jax.Array | None
    admissible: bool = eqx.field(static=True)

    def __init__(
        self,
        matrix: Any,
        admissible: bool = True,
        friction: Any = None,
        tangential_restitution: Any = 0.0,
    ):
        self.matrix = as_float_array("matrix", matrix)
        shape = self.matrix.shape
        if len(shape) != 2 or shape[0] != shape[1] or shape[0] == 0:
            raise ValueError(
                "Argument `matrix` must be square, (m, m) for m contacts or (m + k, m + k) with "
                f"k tangential quasi-velocities, but has shape {shape}."
            )
        check_values("matrix", self.matrix)
        self.admissible = bool(admissible)
        self.friction, self.tangential_restitution = friction_fields(
            friction, tangential_restitution
        )

    def check_options(self, dtype: jnp.dtype, scene: Scene) -> None:
        """Raise where E does not fit the scene."""
        m, size = scene.contacts, self.matrix.shape[0]
        if self.friction is not None:
            check_friction(self, scene)
            if size != m:
                raise ValueError(
                    f"Argument `matrix` must have shape ({m}, {m}) with `friction`, which decides "
                    f"about the tangential velocities itself, but has shape {self.matrix.shape}."
                )
        if size == m:
            return
        held = 0 if scene.constraints is None else scene.constraints.shape[1]
        full = scene.size - held
        if size != full or full < m:
            other = f" or ({full}, {full})" if full > m else ""
            raise ValueError(
                f"Argument `matrix` must have shape ({m}, {m}){other} for {m} contacts and "
                f"{full} free velocities, but has shape {self.matrix.shape}."
            )
        if scene.tangents is None:
            raise ValueError(
                "Argument `scene` must have tangents for a `matrix` with tangential blocks: "
                "normal impulses cannot change tangential quasi-velocities."
            )
        gaps = scene.gaps
        if gaps is not None and not is_traced(gaps) and np.any(np.asarray(gaps) > 0):
            raise ValueError(
                "Argument `scene` must have closed contacts only for a `matrix` with tangential "
                "blocks: which quasi-velocities are tangential depends on the contacts."
            )
        check_independent(scene)

    def impulse(self, delassus: Symmetric, gap_velocity: jax.Array) -> tuple[jax.Array, jax.Array]:
        """`p = -diag(1 / |grad f|) G^-1 (I + E) qn-`, for E (m, m) and no constraints."""
        norm = jnp.sqrt(diagonal(delassus))
        required = _change(self.matrix, gap_velocity / norm)
        return _normal_impulse(delassus, norm, required)

    def all_impulses(
        self, scene: Scene, delassus: Symmetric, gap_velocity: jax.Array, velocity: jax.Array
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Impulses of either form of E."""
        norm, m = kinetic_norm(scene), scene.contacts
        if self.matrix.shape[0] == m:
            required = jnp.where(scene.closed, _change(self.matrix, gap_velocity / norm), 0.0)
            if self.friction is not None and self.tangential_restitution is not None:
                mu, e_t = self.friction, self.tangential_restitution
                return frictional_impulses(scene, velocity, -required * norm, mu, e_t, False)
            p, code = _normal_impulse(delassus, norm, required)
            return p, no_tangential_impulse(scene, p.dtype), code
        assert scene.tangents is not None  # see `check_options`
        _, basis = quasi_basis(scene)
        quasi = jnp.concatenate([gap_velocity / norm, basis.T @ momentum(scene, velocity)])
        required = _change(self.matrix, quasi)
        side, missed = _least(basis.T @ scene.tangents, required[m:], jnp.abs(quasi).max())
        pushed = velocity_change(scene, jnp.zeros(m, side.dtype), side)
        rest = required[:m] - normalized_gap_velocity(scene, pushed)
        p, code = _normal_impulse(delassus, norm, rest)
        lost = missed | ~jnp.all(scene.closed)
        return p, side, jnp.where(lost, CODE["infeasible"], code)


def _change(matrix: jax.Array, quasi: jax.Array) -> jax.Array:
    """`v+ - v- = -(I + E) v-`."""
    return -(quasi + matrix @ quasi)


def _normal_impulse(
    delassus: Symmetric, norm: jax.Array, required: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """p with `G pbar = required`, and its status code."""
    g = as_matrix(delassus) / (norm[:, None] * norm[None, :])
    pbar, singular, missed = solve_symmetric(g, required, regular=is_regular(delassus))
    code = jnp.where(singular, CODE["impulse_not_unique"], CODE["ok"])
    return pbar / norm, jnp.where(missed, CODE["infeasible"], code)


def _least(matrix: jax.Array, right: jax.Array, size: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Least x with `A x = right`, and whether none has, compared to velocities of this size."""
    x = jnp.linalg.pinv(matrix) @ right
    off = jnp.abs(matrix @ x - right).max()
    return x, off > jnp.sqrt(jnp.finfo(x.dtype).eps) * size
