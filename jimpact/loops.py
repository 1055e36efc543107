"""Loops that `shard_map` takes with its default check of what varies among devices.

Inside `shard_map` the type of an array names the mesh axes that it varies over, and a loop must
begin with the types that its passes end with. A state that starts from constants varies over no
axis yet: the loops here make it vary over those that a pass adds. Elsewhere nothing changes.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp

State = TypeVar("State")


def while_loop(
    goes_on: Callable[[State], jax.Array], one_pass: Callable[[State], State], start: State
) -> State:
    """As `jax.lax.while_loop`, from a start of the types that its passes end with."""
    return jax.lax.while_loop(goes_on, one_pass, _begin(one_pass, start))


def fori_loop(
    first: int, last: Any, one_pass: Callable[[Any, State], State], start: State
) -> State:
    """As `jax.lax.fori_loop`, from a start of the types that its passes end with."""
    return jax.lax.fori_loop(first, last, one_pass, _begin(lambda s: one_pass(first, s), start))


def _begin(one_pass: Callable[[Any], Any], start: Any) -> Any:
    """The start of a loop, varying over all mesh axes that its passes make it vary over."""
    if not jax.sharding.get_abstract_mesh().manual_axes:
        return start
    leaves, tree = jax.tree.flatten(start)
    kinds = jax.make_jaxpr(one_pass)(start).out_avals
    begun = [_varying(x, axes_of(kind)) for x, kind in zip(leaves, kinds)]
    # what varies now may make other parts of the state vary
    same = all(a is b for a, b in zip(begun, leaves))
    return start if same else _begin(one_pass, jax.tree.unflatten(tree, begun))


def varying_like(tree: Any, *like: Any) -> Any:
    """The arrays of `tree`, varying over all mesh axes that an array of `like` varies over."""
    kinds = [jax.typeof(x) for x in jax.tree.leaves(like) if eqx.is_array(x)]
    axes = frozenset().union(*map(axes_of, kinds))
    return jax.tree.map(lambda x: _varying(x, axes), tree)


def _varying(x: Any, axes: frozenset[Any]) -> Any:
    """x, varying over these axes, too."""
    missing = axes and axes - axes_of(jax.typeof(x))
    return jax.lax.pcast(x, tuple(missing), to="varying") if missing else x


def kinds_like(kinds: list[Any], like: Any) -> list[Any]:
    """The abstract kinds of arrays, varying over the mesh axes of another one."""
    axes = axes_of(like)
    if not axes:
        return kinds

    def arrays() -> list[jax.Array]:
        """Arrays of these kinds; nothing is computed."""
        return [_varying(jnp.zeros(x.shape, x.dtype), axes) for x in kinds]

    return list(jax.make_jaxpr(arrays)().out_avals)


def axes_of(kind: Any) -> frozenset[Any]:
    """The mesh axes that arrays of this abstract kind vary over.

    Some versions of JAX have the axes themselves, under another name.
    """
    manual = getattr(kind, "manual_axis_type", None)
    return getattr(kind, "vma", frozenset()) if manual is None else manual.varying
