"""Moreau's law: Newton's restitution in complementarity form."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from jimpact._checks import as_float_array, check_shape, check_square, check_values
from jimpact.laws.base import Law
from jimpact.laws.friction import check_friction, friction_fields, frictional_impulses
from jimpact.scene import Scene
from jimpact.solvers.lcp import solve_lcp
from jimpact.solvers.tridiagonal import Symmetric, as_matrix, diagonal, is_regular


class Moreau(Law):
    """Moreau's impact law: a contact either reverses its gap velocity or takes no impulse.

    Equation: `0 <= G pbar + (I + E) qn-  _|_  pbar >= 0`, in normalized gap velocities
    `qn = gamma / |grad f|` and impulses `pbar = |grad f| p`; with a scalar or diagonal E
    `0 <= gamma+ + e gamma-  _|_  p >= 0`. With friction also `p_t in -mu p Sgn(v_t+ + e_t v_t-)`.

    Args:
        restitution: e in [0, 1], scalar or one per contact (m,), or a matrix E (m, m).
        friction: Coulomb's mu >= 0, scalar or (m,), for scenes with tangents; None: no friction.
        tangential_restitution: e_t in [-1, 1], scalar or (m,): sticking is `v_t+ = -e_t v_t-`.

    Status: `inadmissible_velocity` where a contact that separated before the impact is driven
    together (the law then asks for gamma+ >= -e gamma- < 0 only); `energy_gain`, with unequal e;
    `infeasible` (a body squeezed between walls with unequal e); `impulse_not_unique` for redundant
    contacts (of all p that of least |pbar| is given, where friction allows it). With friction there
    is a solution unless contacts jam (impulses that move nothing).

    Derivatives are one-sided where a contact is about to take part (p_j = 0 = gamma+ + e gamma-).

    Source: Moreau (1988); Brogliato, Nonsmooth Mechanics (2016), (6.51), (6.54).

    >>> import jimpact as ji
    >>> out = ji.impact(ji.Moreau(0.5), ji.chain([1.0, 2.0, 3.0]), [1.0, 0.0, 0.0])
    >>> [round(float(v), 6) for v in out.velocity]
    [-0.25, 0.25, 0.25]
    """

    restitution: jax.Array
    friction: jax.Array | None
    tangential_restitution: jax.Array | None

    def __init__(self, restitution: Any, friction: Any = None, tangential_restitution: Any = 0.0):
        self.restitution = as_float_array("restitution", restitution)
        if self.restitution.ndim < 2:
            check_values("restitution", self.restitution, low=0.0, high=1.0)
        else:
            check_square("restitution", self.restitution)
            check_values("restitution", self.restitution)
        self.friction, self.tangential_restitution = friction_fields(
            friction, tangential_restitution
        )

    def by_blocks(self) -> bool:
        """Contacts feel each other through W only, unless by a matrix E or friction."""
        return self.restitution.ndim < 2 and self.friction is None

    def check_options(self, dtype: jnp.dtype, scene: Scene) -> None:
        """A matrix must have one row and one column per contact; friction needs tangents."""
        if self.friction is not None:
            check_friction(self, scene)
        if self.restitution.ndim == 2:
            shape = (scene.contacts, scene.contacts)
            check_shape("restitution", self.restitution, shape, "one row per contact")

    def all_impulses(
        self, scene: Scene, delassus: Symmetric, gap_velocity: jax.Array, velocity: jax.Array
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Entries of a matrix E that couple to an open contact do not count."""
        if self.restitution.ndim < 2:
            return self._impulses(scene, delassus, gap_velocity, velocity)
        both = scene.closed[:, None] & scene.closed[None, :]
        among_closed = eqx.tree_at(
            lambda law: law.restitution, self, jnp.where(both, self.restitution, 0.0)
        )
        return among_closed._impulses(scene, delassus, gap_velocity, velocity)

    def impulse(self, delassus: Symmetric, gap_velocity: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The solution of one linear complementarity problem."""
        required = self._required(delassus, gap_velocity)
        found = solve_lcp(as_matrix(delassus), required, regular=is_regular(delassus))
        return found.z, found.code

    def _required(self, delassus: Symmetric, gap_velocity: jax.Array) -> jax.Array:
        """`diag(|grad f|) (I + E) qn-`."""
        norm = jnp.sqrt(diagonal(delassus))
        qn, e = gap_velocity / norm, self.restitution
        return (qn + (e @ qn if e.ndim == 2 else e * qn)) * norm

    def _impulses(
        self, scene: Scene, delassus: Symmetric, gap_velocity: jax.Array, velocity: jax.Array
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Normal and, with friction, tangential impulses."""
        if self.friction is None or self.tangential_restitution is None:
            return Law.all_impulses(self, scene, delassus, gap_velocity, velocity)
        required = self._required(delassus, gap_velocity)
        return frictional_impulses(
            scene, velocity, required, self.friction, self.tangential_restitution, True
        )
