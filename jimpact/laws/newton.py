"""Newton's law: the diagonal kinematic law `gamma+ = -e gamma-`, contact by contact."""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from jimpact._checks import as_float_array, check_values
from jimpact.laws.base import Law
from jimpact.numerics.linear import solve_symmetric
from jimpact.numerics.tridiagonal import Symmetric, as_matrix, diagonal, is_regular
from jimpact.status import CODE


class Newton(Law):
    """Newton's restitution at every contact, without complementarity.

    Equation: `gamma+ = -e gamma-`, hence `p = -W^-1 (I + diag(e)) gamma-`.

    Args:
        restitution: kinematic coefficient e in [0, 1], scalar or one per contact (m,).

    Status: `negative_impulse` or `inadmissible_velocity` where the kinematic law contradicts
    unilateral contact (kinetic angles above pi/2, separating contacts, unequal e);
    `impulse_not_unique` for redundant contacts, `infeasible` where they contradict each other.

    Source: Brogliato, Nonsmooth Mechanics (2016), (6.41) with a diagonal E.

    >>> import jimpact as ji
    >>> ji.impact(ji.Newton(0.5), ji.chain([1.0, 1.0]), [1.0, 0.0]).velocity.tolist()
    [0.25, 0.75]
    """

    pulls: ClassVar[bool] = True

    restitution: jax.Array

    def __init__(self, restitution: Any):
        self.restitution = as_float_array("restitution", restitution)
        check_values("restitution", self.restitution, low=0.0, high=1.0)

    def by_blocks(self) -> bool:
        """Contacts feel each other through W only."""
        return True

    def impulse(self, delassus: Symmetric, gap_velocity: jax.Array) -> tuple[jax.Array, jax.Array]:
        """`p = -W^-1 (1 + e) gamma-`."""
        norm = jnp.sqrt(diagonal(delassus))
        g = as_matrix(delassus) / (norm[:, None] * norm[None, :])
        required = -(1 + self.restitution) * gap_velocity / norm
        pbar, singular, missed = solve_symmetric(g, required, regular=is_regular(delassus))
        code = jnp.where(singular, CODE["impulse_not_unique"], CODE["ok"])
        return pbar / norm, jnp.where(missed, CODE["infeasible"], code)
