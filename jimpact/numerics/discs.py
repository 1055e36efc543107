"""Vectors of N states of m contacts in their planes: lengths, directions, discs of
friction.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float


def length_of(vectors: Float[Array, "m rows N"]) -> Float[Array, "m N"]:
    """Lengths |v|; the derivative of 0 is 0."""
    squares = jnp.sum(vectors**2, axis=1)
    return jnp.where(squares > 0, jnp.sqrt(jnp.where(squares > 0, squares, 1.0)), 0.0)


def over(
    vectors: Float[Array, "m rows N"], length: Float[Array, "m #N"]
) -> Float[Array, "m rows N"]:
    """Vectors over lengths, v / length; 0 where the length is 0."""
    return (
        jnp.where(length > 0, 1 / jnp.where(length > 0, length, 1.0), 0.0)[:, None]
        * vectors
    )


def in_disc(
    side: Float[Array, "m rows N"], radius: Float[Array, "m #N"]
) -> Float[Array, "m rows N"]:
    """Projections on discs: the points with |v| <= radius nearest to `side`."""
    length = length_of(side)
    return jnp.where(
        (length > radius)[:, None], over(side, length) * radius[:, None], side
    )
