"""Dual numbers with many tangents: all directions D of a derivative at one point.

`vmap` over the directions would put their axis first, before the stages of a step, and every sum
over stages would transpose the whole table of slopes. Here values are (.., B) and their tangents
(.., D, B). A loop is written once, for values alone or with tangents; its body calls `pushforward`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.interpreters import ad

TANGENT_AXIS = -2  # the axis of the directions


class Dual(NamedTuple):
    """A value (.., B) with its tangents (.., D, B)."""

    value: jax.Array
    tangents: jax.Array


def is_dual(x: Any) -> bool:
    """Whether x has tangents."""
    return isinstance(x, Dual)


def value_of(tree: Any) -> Any:
    """The tree with each `Dual` replaced by its value."""
    return jax.tree.map(lambda x: x.value if is_dual(x) else x, tree, is_leaf=is_dual)


def pushforward(function: Callable[..., Any], *args: Any) -> Any:
    """`function(*args)`; results that depend on a leaf that is a `Dual` are `Dual`, too."""
    leaves, tree = jax.tree.flatten(args, is_leaf=is_dual)
    duals = [i for i, x in enumerate(leaves) if is_dual(x)]
    if not duals:
        return function(*args)
    depends: list[bool] = []  # of each result, whether it depends on a dual
    trees: list[Any] = []  # the tree of the results

    def of_values(*values: jax.Array) -> list[Any]:
        """Leaves of the results, from the values of the duals."""
        replaced = dict(zip(duals, values))
        args = jax.tree.unflatten(tree, [replaced.get(i, x) for i, x in enumerate(leaves)])
        results, result_tree = jax.tree.flatten(function(*args))
        results = [jnp.asarray(x) for x in results]
        depends[:] = [isinstance(x, ad.JVPTracer) and _is_float(x) for x in results]
        trees[:] = [result_tree]
        return results

    values = tuple(leaves[i].value for i in duals)

    def push(*tangents: jax.Array) -> tuple[list[jax.Array], list[jax.Array]]:
        """Results, and tangents of those that depend on a dual, in one direction."""
        results, rates = jax.jvp(of_values, values, tangents)
        return results, [rate for rate, needed in zip(rates, depends) if needed]

    directions = (leaves[i].tangents for i in duals)
    results, found = jax.vmap(push, TANGENT_AXIS, (None, TANGENT_AXIS))(*directions)
    rates = iter(found)
    return jax.tree.unflatten(
        trees[0], [Dual(x, next(rates)) if needed else x for x, needed in zip(results, depends)]
    )


def _is_float(x: jax.Array) -> bool:
    """Whether x is an array of floating-point numbers."""
    return bool(jnp.issubdtype(x.dtype, jnp.floating))


def dual_like(tree: Any, x: jax.Array | Dual) -> Any:
    """x with tangents of 0 if a leaf of the tree is a `Dual`, otherwise x."""
    duals = [leaf for leaf in jax.tree.leaves(tree, is_leaf=is_dual) if is_dual(leaf)]
    if not duals or isinstance(x, Dual):
        return x
    directions = duals[0].tangents.shape[TANGENT_AXIS]
    return Dual(x, jnp.zeros((*x.shape[:-1], directions, x.shape[-1]), x.dtype))
