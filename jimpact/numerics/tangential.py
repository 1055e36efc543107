"""The tangential rows of the Delassus matrix and the slip velocities: what friction acts on."""

from typing import NamedTuple

import jax
import jax.numpy as jnp


class TangentialBlock(NamedTuple):
    """What the t tangents add to m contacts: `u+ = u- + W_tn p + W_tt p_t`.

    t = m in the plane, 2 m in space, contact by contact.
    """

    normal_tangent: jax.Array  # W_nt (m, t) [1/kg]
    tangent: jax.Array  # W_tt (t, t) [1/kg]
    slip: jax.Array  # u- (t,) [m/s]

    def scaled(self, root: jax.Array, speed: jax.Array | float = 1.0) -> "TangentialBlock":
        """The block where contact j is divided by `root` (m,), and slip by `speed` () as well."""
        of_tangents = per_tangent(root, self.slip)
        return TangentialBlock(
            self.normal_tangent / (root[:, None] * of_tangents[None]),
            self.tangent / (of_tangents[:, None] * of_tangents[None]),
            self.slip / (of_tangents * speed),
        )


def per_tangent(values: jax.Array, tangential: jax.Array) -> jax.Array:
    """Values (m,) of contacts repeated for each of their tangents, as many as in (t,)."""
    return jnp.repeat(values, len(tangential) // len(values))
