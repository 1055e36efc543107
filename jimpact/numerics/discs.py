"""Vectors of contacts in their planes: lengths, directions, and discs of friction."""

import jax
import jax.numpy as jnp


def length_of(vectors: jax.Array) -> jax.Array:
    """(m, N) of vectors (m, rows, N); its derivative is 0 at 0."""
    squares = jnp.sum(vectors**2, axis=1)
    return jnp.where(squares > 0, jnp.sqrt(jnp.where(squares > 0, squares, 1.0)), 0.0)


def over(vectors: jax.Array, length: jax.Array) -> jax.Array:
    """Vectors (m, rows, N) over (m, N), 0 over 0."""
    return jnp.where(length > 0, 1 / jnp.where(length > 0, length, 1.0), 0.0)[:, None] * vectors


def in_disc(side: jax.Array, radius: jax.Array) -> jax.Array:
    """The points of discs (m, N) next to `side` (m, rows, N)."""
    length = length_of(side)
    return jnp.where((length > radius)[:, None], over(side, length) * radius[:, None], side)
