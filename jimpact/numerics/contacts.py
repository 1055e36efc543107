"""Reductions over the contacts of an impact, the first axis; further axes are batches.

What is one number an impact has a first axis of length 1: it broadcasts against all contacts,
alone (m,) and in a batch (m, B). Loops over contiguous batches are what vector units are fast at.
"""

import jax
import jax.numpy as jnp


def any_of(x: jax.Array) -> jax.Array:
    """Whether any contact."""
    return jnp.any(x, axis=0, keepdims=True)


def all_of(x: jax.Array) -> jax.Array:
    """Whether all contacts."""
    return jnp.all(x, axis=0, keepdims=True)


def total(x: jax.Array) -> jax.Array:
    """Sum over the contacts."""
    return jnp.sum(x, axis=0, keepdims=True)


def least(x: jax.Array) -> jax.Array:
    """Minimum over the contacts."""
    return jnp.min(x, axis=0, keepdims=True)


def largest(x: jax.Array) -> jax.Array:
    """Maximum over the contacts."""
    return jnp.max(x, axis=0, keepdims=True)


def of(one_hot: jax.Array, x: jax.Array) -> jax.Array:
    """Value of the contact that `one_hot` marks; 0 if it marks none."""
    return total(jnp.where(one_hot, x, jnp.zeros_like(x)))


def first_least(x: jax.Array) -> jax.Array:
    """One-hot mark of the first contact with the least value."""
    index = jax.lax.broadcasted_iota(jnp.int32, x.shape, 0)
    return index == jnp.argmin(x, axis=0, keepdims=True).astype(jnp.int32)


def along_contacts(values: jax.Array, like: jax.Array) -> jax.Array:
    """Values (m,) shaped to broadcast against `like` (m, ...); scalars as they are."""
    return values.reshape(values.shape + (1,) * (like.ndim - values.ndim if values.ndim else 0))
