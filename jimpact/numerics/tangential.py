"""The tangential rows of the Delassus matrix and the slip velocities: what friction
acts on.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Shaped


class TangentialBlock(NamedTuple):
    """Blocks of the Delassus matrix of m contacts with t tangents:
    `u+ = u- + W_nt^T p + W_tt p_t`.

    t = m in the plane, 2 m in space, contact by contact; of N groups with an axis in
    front.
    """

    normal_tangent: Float[Array, "*N m t"]  # W_nt [1/kg]
    tangent: Float[Array, "*N t t"]  # W_tt [1/kg]
    slip: Float[Array, "*N t"]  # u- [m/s]

    def scaled(
        self, root: Float[Array, " m"], speed: Float[Array, ""] | float = 1.0
    ) -> "TangentialBlock":
        """The block where contact j is divided by `root`, and slip by `speed` as
        well.
        """
        of_tangents = per_tangent(root, self.slip)
        of_pairs = root[:, None] * of_tangents[None]
        squares = of_tangents[:, None] * of_tangents[None]
        slip = self.slip / (of_tangents * speed)
        return TangentialBlock(
            self.normal_tangent / of_pairs, self.tangent / squares, slip
        )


def per_tangent(
    values: Float[Array, " m"], tangential: Shaped[Array, "t *B"]
) -> Float[Array, " t"]:
    """Values of contacts repeated for each of their tangents, as many as in rows t."""
    return jnp.repeat(values, len(tangential) // len(values))
