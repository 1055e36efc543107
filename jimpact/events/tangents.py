"""Tangents side by side: many directions at one point, beside the lanes of a batch.

`vmap` over the directions of a derivative puts them first, before the stages of a step. Every sum
over stages then has to turn the whole table of slopes. Here tangents lie next to the batch,
(.., D, B) beside values (.., B): a loop is written once, for values alone or with tangents, and
what is inside of it goes `through`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.interpreters import ad

BESIDE = -2  # the axis of the directions


class Moving(NamedTuple):
    """A value (.., B) with its tangents (.., D, B)."""

    value: jax.Array
    along: jax.Array


def moves(x: Any) -> bool:
    """Whether it has tangents."""
    return isinstance(x, Moving)


def value_of(tree: Any) -> Any:
    """Values alone."""
    return jax.tree.map(lambda x: x.value if moves(x) else x, tree, is_leaf=moves)


def through(function: Callable[..., Any], *args: Any) -> Any:
    """`function(*args)`; where leaves of args are `Moving`, so are those that depend on them."""
    leaves, tree = jax.tree.flatten(args, is_leaf=moves)
    at = [i for i, x in enumerate(leaves) if moves(x)]
    if not at:
        return function(*args)
    carried: list[bool] = []

    def smooth(*values: jax.Array) -> tuple[list[Any], Any]:
        given = dict(zip(at, values))
        outs = function(*jax.tree.unflatten(tree, [given.get(i, x) for i, x in enumerate(leaves)]))
        flat, after = jax.tree.flatten(outs)
        flat = [jnp.asarray(x) for x in flat]
        carried[:] = [isinstance(x, ad.JVPTracer) and _smooth(x) for x in flat]
        return flat, after

    values = tuple(leaves[i].value for i in at)

    def push(*along: jax.Array) -> list[jax.Array]:
        rates = jax.jvp(lambda *v: smooth(*v)[0], values, along)[1]
        return [rate for rate, moved in zip(rates, carried) if moved]

    outs, after = smooth(*values)
    rates = iter(jax.vmap(push, BESIDE, BESIDE)(*(leaves[i].along for i in at)))
    return jax.tree.unflatten(
        after, [Moving(x, next(rates)) if moved else x for x, moved in zip(outs, carried)]
    )


def _smooth(x: jax.Array) -> bool:
    return bool(jnp.issubdtype(x.dtype, jnp.floating))


def moving_with(tree: Any, x: jax.Array | Moving) -> Any:
    """x with tangents, of 0, if anything in the tree has some."""
    found = [leaf for leaf in jax.tree.leaves(tree, is_leaf=moves) if moves(leaf)]
    if not found or isinstance(x, Moving):
        return x
    many = found[0].along.shape[BESIDE]
    return Moving(x, jnp.zeros((*x.shape[:-1], many, x.shape[-1]), x.dtype))
