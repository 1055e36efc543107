"""Newton's law: the diagonal kinematic law `gamma+ = -e gamma-`, contact by contact."""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from jimpact._checks import as_float_array, check_values
from jimpact.laws.base import Law
from jimpact.laws.friction import check_friction, friction_fields, frictional_impulses
from jimpact.scene import Scene
from jimpact.solvers.linear import solve_symmetric
from jimpact.solvers.tridiagonal import Symmetric, as_matrix, diagonal, is_regular
from jimpact.status import CODE


class Newton(Law):
    """Newton's restitution at every contact, without complementarity.

    Equation: `gamma+ = -e gamma-`, hence `p = -W^-1 (I + diag(e)) gamma-`; with friction also
    `p_t in -mu p Sgn(v_t+ + e_t v_t-)`.

    Args:
        restitution: kinematic coefficient e in [0, 1], scalar or one per contact (m,).
        friction: Coulomb's mu >= 0, scalar or (m,), for scenes with tangents; None: no friction.
        tangential_restitution: e_t in [-1, 1], scalar or (m,): sticking is `v_t+ = -e_t v_t-`.

    Status: `negative_impulse` or `inadmissible_velocity` where the kinematic law contradicts
    unilateral contact (kinetic angles above pi/2, separating contacts, unequal e);
    `impulse_not_unique` for redundant contacts, `infeasible` where they contradict each other;
    with friction as in `RestitutionMatrix`.

    Source: Brogliato, Nonsmooth Mechanics (2016), (6.41) with a diagonal E; (6.54)-(6.57).

    >>> import jimpact as ji
    >>> ji.impact(ji.Newton(0.5), ji.chain([1.0, 1.0]), [1.0, 0.0]).velocity.tolist()
    [0.25, 0.75]
    """

    pulls: ClassVar[bool] = True

    restitution: jax.Array
    friction: jax.Array | None
    tangential_restitution: jax.Array | None

    def __init__(self, restitution: Any, friction: Any = None, tangential_restitution: Any = 0.0):
        self.restitution = as_float_array("restitution", restitution)
        check_values("restitution", self.restitution, low=0.0, high=1.0)
        self.friction, self.tangential_restitution = friction_fields(
            friction, tangential_restitution
        )

    def by_blocks(self) -> bool:
        """Without friction contacts feel each other through W only."""
        return self.friction is None

    def check_options(self, dtype: jnp.dtype, scene: Scene) -> None:
        """Friction needs tangents."""
        if self.friction is not None:
            check_friction(self, scene)

    def all_impulses(
        self, scene: Scene, delassus: Symmetric, gap_velocity: jax.Array, velocity: jax.Array
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """With friction: normal and tangential impulses together."""
        if self.friction is None or self.tangential_restitution is None:
            return super().all_impulses(scene, delassus, gap_velocity, velocity)
        required = (1 + self.restitution) * gap_velocity
        return frictional_impulses(
            scene, velocity, required, self.friction, self.tangential_restitution, False
        )

    def impulse(self, delassus: Symmetric, gap_velocity: jax.Array) -> tuple[jax.Array, jax.Array]:
        """`p = -W^-1 (1 + e) gamma-`."""
        norm = jnp.sqrt(diagonal(delassus))
        g = as_matrix(delassus) / (norm[:, None] * norm[None, :])
        required = -(1 + self.restitution) * gap_velocity / norm
        pbar, singular, missed = solve_symmetric(g, required, regular=is_regular(delassus))
        code = jnp.where(singular, CODE["impulse_not_unique"], CODE["ok"])
        return pbar / norm, jnp.where(missed, CODE["infeasible"], code)
