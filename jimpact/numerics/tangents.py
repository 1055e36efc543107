"""Dual numbers with many tangents: all directions D of a derivative at one point.

`vmap` over the directions would put their axis first, before the stages of a step, and
every sum over stages would transpose the whole table of slopes. Here values are (.., B)
and their tangents (.., D, B). A loop is written once, for values alone or with
tangents; its body calls `pushforward`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool, Float, Shaped

from jimpact.tools.loops import varying_like

TANGENT_AXIS = -2  # the axis of the directions


class Dual(NamedTuple):
    """A value (.., B) with its tangents (.., D, B) in D directions."""

    value: Shaped[Array, "*rows B"]
    tangents: Shaped[Array, "*rows D B"]


def is_dual(x: Any) -> bool:
    """True if x has tangents."""
    return isinstance(x, Dual)


def value_of(tree: Any) -> Any:
    """The tree with each `Dual` replaced by its value."""
    return jax.tree.map(lambda x: x.value if is_dual(x) else x, tree, is_leaf=is_dual)


def pushforward(function: Callable[..., Any], *args: Any) -> Any:
    """`function(*args)`; results that depend on a leaf that is a `Dual` are `Dual`,
    too.
    """
    leaves, tree = jax.tree.flatten(args, is_leaf=is_dual)
    duals = [i for i, x in enumerate(leaves) if is_dual(x)]
    if not duals:
        return function(*args)
    depends: list[bool] = []  # of each result, whether it depends on a dual
    trees: list[Any] = []  # the tree of the results

    @jax.custom_jvp
    def observed(results: list[jax.Array]) -> list[jax.Array]:
        """The results as they are; its rule notes which of them have tangents."""
        return results

    def note(results: Any, tangents: Any) -> tuple[Any, Any]:
        """Results and tangents as they are; notes in `depends` which results have
        tangents.

        A tangent that is known to be 0 is symbolic.
        """
        depends[:] = [
            is_smooth(x) and not isinstance(t, SymbolicZero)
            for x, t in zip(results[0], tangents[0])
        ]
        return results[0], tangents[0]

    observed.defjvp(note, symbolic_zeros=True)

    def of_values(*values: jax.Array) -> list[Any]:
        """Leaves of the results, as a function of the values of the duals alone."""
        replaced = dict(zip(duals, values))
        replaced_leaves = [replaced.get(i, x) for i, x in enumerate(leaves)]
        args = jax.tree.unflatten(tree, replaced_leaves)
        results, result_tree = jax.tree.flatten(function(*args))
        trees[:] = [result_tree]
        depends[:] = [False] * len(results)
        return observed([jnp.asarray(x) for x in results])

    values = tuple(leaves[i].value for i in duals)

    def push(*tangents: jax.Array) -> tuple[list[jax.Array], list[jax.Array]]:
        """Results, and tangents `sum_i (df / dx_i) dx_i` of those that depend on a
        dual.
        """
        results, rates = jax.jvp(of_values, values, tangents)
        return results, [rate for rate, needed in zip(rates, depends) if needed]

    directions = (leaves[i].tangents for i in duals)
    in_lanes = jax.vmap(push, TANGENT_AXIS, (None, TANGENT_AXIS))
    results, found = in_lanes(*directions)
    rates = iter(found)
    return jax.tree.unflatten(
        trees[0],
        [Dual(x, next(rates)) if needed else x for x, needed in zip(results, depends)],
    )


def is_smooth(x: Any) -> bool:
    """True if x is an array, or a shape, of floating-point numbers: it may have
    tangents.
    """
    return bool(jnp.issubdtype(x.dtype, jnp.floating))


def dual_like(tree: Any, x: jax.Array | Dual) -> Any:
    """x as a `Dual` with tangents of 0, in the directions of those in the tree.

    x itself if it is a `Dual` already, or no leaf of the tree is one.
    """
    leaves = jax.tree.leaves(tree, is_leaf=is_dual)
    duals = [leaf for leaf in leaves if is_dual(leaf)]
    if not duals or isinstance(x, Dual):
        return x
    directions = duals[0].tangents.shape[TANGENT_AXIS]
    shape = (*x.shape[:-1], directions, x.shape[-1])
    no_tangents = jnp.zeros(shape, x.dtype)
    return Dual(x, varying_like(no_tangents, duals))


@jax.custom_jvp
def without_slope(
    x: Float[Array, "*rows"], where: Bool[Array, "*lanes"]
) -> Float[Array, "*rows"]:
    """x as it is, without a derivative `where` it has none: its tangents are NaN there.

    A choice between two x by `jnp.where` would be NaN everywhere in reverse mode.
    """
    return x


@without_slope.defjvp
def _no_slope(primals: tuple[Any, Any], tangents: tuple[Any, Any]) -> tuple[Any, Any]:
    """x, and its tangent times NaN, or 1."""
    x, where = primals
    rate, _ = tangents
    factor = jnp.where(where, jnp.nan, jnp.ones((), x.dtype))
    return without_slope(x, where), factor * rate
