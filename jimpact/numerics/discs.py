"""Vectors of N states of m contacts in their planes: lengths, directions, discs of
friction.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jimpact.tools.masks import quotient


def normals_of(x: Float[Array, "m b *N"]) -> Float[Array, "m 1 *N"]:
    """The normal rows of impulses or rates x, first of the b rows of each contact."""
    return x[:, :1]


def tangents_of(x: Float[Array, "m b *N"]) -> Float[Array, "m rows *N"]:
    """The tangential rows of impulses or rates x, behind the normal one."""
    return x[:, 1:]


def length_of(vectors: Float[Array, "m rows N"]) -> Float[Array, "m N"]:
    """Lengths |v|; the derivative of 0 is 0."""
    squares = jnp.sum(vectors**2, axis=1)
    positive = jnp.where(squares > 0, squares, 1.0)
    return jnp.where(squares > 0, jnp.sqrt(positive), 0.0)


def over(
    vectors: Float[Array, "m rows N"], length: Float[Array, "m #N"]
) -> Float[Array, "m rows N"]:
    """Vectors over lengths, v / length; 0 where the length is 0."""
    positive = length > 0
    inverse = quotient(1, length, where=positive)
    return inverse[:, None] * vectors


def in_disc(
    side: Float[Array, "m rows N"], radius: Float[Array, "m #N"]
) -> Float[Array, "m rows N"]:
    """Projections on discs: the points with |v| <= radius nearest to `side`."""
    length = length_of(side)
    outside = (length > radius)[:, None]
    on_rim = over(side, length) * radius[:, None]
    return jnp.where(outside, on_rim, side)
