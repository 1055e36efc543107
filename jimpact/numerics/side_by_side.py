"""Some of the impacts of a batch, the last axis, picked out and put back."""

from typing import TypeVar

import jax
import jax.numpy as jnp

Tree = TypeVar("Tree")


def take(tree: Tree, index: jax.Array, size: int) -> Tree:
    """The impacts `index` of a tree whose arrays have a last axis of `size`, or none."""

    def some(x: jax.Array) -> jax.Array:
        has_batch = isinstance(x, jax.Array) and x.ndim > 1 and x.shape[-1] == size
        return x.take(index, axis=-1, mode="clip") if has_batch else x

    return jax.tree.map(some, tree)


def put(tree: Tree, some: Tree, order: jax.Array) -> Tree:
    """`tree` with the impacts `order[: s]` replaced by those of `some`, which has s of them."""
    place = jnp.argsort(order)
    size = jax.tree.leaves(some)[0].shape[-1]
    return jax.tree.map(
        lambda old, new: jnp.where(place < size, new.take(place, axis=-1, mode="clip"), old),
        tree,
        some,
    )
