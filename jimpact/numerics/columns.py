"""Batches in the last axis: `vmap` of a function that is written for arrays (k, B) itself.

`vmap` puts the batch first. Entries of one impact are then neighbours in memory, and loops over
two or three of them do not fill a vector unit. Here the batch comes last, in pieces that stay in
a core's cache; each piece ends with its own slowest member.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap

Result = TypeVar("Result")
Tree = TypeVar("Tree")

WORTH_APART = 64  # impacts of a batch: with fewer, compilation counts
CHUNK = 1024  # impacts solved side by side on a CPU: their stages fill about half a megabyte


def in_columns(function: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """The same function of arrays (k,); under `vmap` it is called with arrays (k, B).

    Its results have the batch last, too. Further `vmap`s only make the batch longer.
    """

    @custom_vmap
    def alone(inputs: Any) -> Any:
        return function(inputs)

    @custom_vmap
    def side_by_side(inputs: Any) -> Any:
        return _in_chunks(function, inputs)

    @alone.def_vmap
    def _first(size: int, mapped: tuple[Any], inputs: Any) -> tuple[Any, Any]:
        if not any(jax.tree.leaves(mapped)):
            return _marked(function(inputs), False)
        out = side_by_side(
            jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), _all(size, mapped, inputs))
        )
        return _marked(jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), out), True)

    @side_by_side.def_vmap
    def _more(size: int, mapped: tuple[Any], inputs: Any) -> tuple[Any, Any]:
        if not any(jax.tree.leaves(mapped)):
            return _marked(_in_chunks(function, inputs), False)
        # (size, k, B) -> (k, B * size)
        wide = jax.tree.map(
            lambda x: jnp.moveaxis(x, 0, -1).reshape(*x.shape[1:-1], x.shape[-1] * size),
            _all(size, mapped, inputs),
        )
        out = side_by_side(wide)
        out = jax.tree.map(lambda x: jnp.moveaxis(x.reshape(*x.shape[:-1], -1, size), -1, 0), out)
        return _marked(out, True)

    return alone


def by_itself(function: Callable[[], Result], like: jax.Array) -> Result:
    """`function()`; where `like` (k, B) is a batch, as a computation of its own.

    XLA would compute its results again in each operation that uses them, ten times over in all.
    """
    if like.ndim == 1 or like.shape[-1] < WORTH_APART:
        return function()
    shapes = jax.eval_shape(function)
    always = jnp.any(like != jnp.inf)  # the compiler cannot know
    return jax.lax.cond(
        always, function, lambda: jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    )


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


def _all(size: int, mapped: tuple[Any], inputs: Any) -> Any:
    """All inputs with the batch axis (first)."""
    return jax.tree.map(
        lambda x, has: x if has else jnp.broadcast_to(x, (size, *x.shape)), inputs, mapped[0]
    )


def _marked(out: Any, mapped: bool) -> tuple[Any, Any]:
    return out, jax.tree.map(lambda _: mapped, out)


def _in_chunks(function: Callable[[Any], Any], inputs: Any) -> Any:
    """On a CPU piece by piece, the last one filled up; on accelerators all at once."""
    size = jax.tree.leaves(inputs)[0].shape[-1]
    count = -(-size // CHUNK)
    if count == 1:
        return function(inputs)
    width = -(-size // count)

    def pieces(given: Any) -> Any:
        def cut(x: jax.Array) -> jax.Array:
            filled = jnp.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, count * width - size)], mode="edge")
            return jnp.moveaxis(filled.reshape(*x.shape[:-1], count, width), -2, 0)

        def join(x: jax.Array) -> jax.Array:
            joined = jnp.moveaxis(x, 0, -2)
            return joined.reshape(*joined.shape[:-2], count * width)[..., :size]

        return jax.tree.map(join, jax.lax.map(function, jax.tree.map(cut, given)))

    return jax.lax.platform_dependent(inputs, cpu=pieces, default=function)
