"""Loops that `shard_map` takes with its default check of which values vary among
devices.

Inside `shard_map` the type of an array names the mesh axes that it varies over, and a
loop must begin with the types that its passes end with. A state that starts from
constants varies over no axis yet: the loops here make it vary over those that a pass
adds. Elsewhere nothing changes.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp

State = TypeVar("State")


@jax.custom_batching.custom_vmap
def over_lanes(count: jax.Array) -> jax.Array:
    """The sum of a whole number () over all lanes of `vmap`, that is its batch entries.

    It is the same in all lanes: a condition or a loop on it is not turned into a
    selection.
    """
    return count


@over_lanes.def_vmap
def _over_lanes(size: int, batched: Any, count: jax.Array) -> tuple[jax.Array, bool]:
    """Rule of `vmap` for `over_lanes`: the sum over its lanes (size,), the same in
    each.
    """
    return over_lanes(jnp.sum(count, axis=0, dtype=count.dtype)), False


def any_lane(happens: jax.Array) -> jax.Array:
    """True () if `happens` () is true in any lane of `vmap`."""
    return over_lanes(happens.astype(jnp.int32)) > 0


def while_loop(
    goes_on: Callable[[State], jax.Array],
    one_pass: Callable[[State], State],
    start: State,
) -> State:
    """`jax.lax.while_loop` whose start varies over all mesh axes that a pass adds."""
    return jax.lax.while_loop(goes_on, one_pass, _begin(one_pass, start))


def fori_loop(
    first: int, last: Any, one_pass: Callable[[Any, State], State], start: State
) -> State:
    """`jax.lax.fori_loop` whose start varies over all mesh axes that a pass adds."""
    return jax.lax.fori_loop(
        first, last, one_pass, _begin(lambda s: one_pass(first, s), start)
    )


def scan(
    one: Callable[[State, Any], tuple[State, Any]],
    start: State,
    rows: Any,
    length: int | None = None,
) -> tuple[State, Any]:
    """`jax.lax.scan` over `rows` whose start varies over all mesh axes that a pass
    adds.
    """
    first = jax.tree.map(lambda x: x[0], rows)
    return jax.lax.scan(one, _begin(lambda s: one(s, first)[0], start), rows, length)


def cond(
    which: jax.Array, then: Callable[[], State], otherwise: Callable[[], State]
) -> State:
    """`jax.lax.cond` of branches whose results may vary over different mesh axes."""
    if not jax.sharding.get_abstract_mesh().manual_axes:
        return jax.lax.cond(which, then, otherwise)
    both = [jax.make_jaxpr(branch)().out_avals for branch in (then, otherwise)]
    axes = [axes_of(a) | axes_of(b) for a, b in zip(*both)]

    def varying(branch: Callable[[], State]) -> Callable[[], State]:
        """The branch with results that vary over the mesh axes of both branches."""

        def call() -> State:
            """Results of the branch, marked as varying."""
            leaves, tree = jax.tree.flatten(branch())
            return jax.tree.unflatten(tree, map(_varying, leaves, axes))

        return call

    return jax.lax.cond(which, varying(then), varying(otherwise))


def in_a_branch(always: jax.Array, function: Callable[[], State]) -> State:
    """`function()`, on a CPU in a branch that is `always` taken, which changes no
    value.

    XLA's CPU runs the kernels of a loop's body as they become ready, and wakes a second
    thread where more than eight are: for kernels of some microseconds that costs a
    third more CPU time than it saves (jaxlib 0.10.2, batches of three balls and of
    blocks). A branch is a sequence of its own, so that fewer are ready at once.

    Args:
        always: True (), as a result of data: the compiler takes out what it knows.
        function: of no arguments; its result is a tree of arrays.
    """
    if jax.default_backend() != "cpu":
        return function()
    shapes = jax.eval_shape(function)

    def never() -> State:
        """Zeros in the place of the result."""
        return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)

    return cond(any_lane(always), function, never)


def _begin(one_pass: Callable[[Any], Any], start: Any) -> Any:
    """The start of a loop, marked as varying over all mesh axes that its passes make it
    vary over.

    Repeated until nothing changes: an array that varies may make others of the state
    vary.
    """
    if not jax.sharding.get_abstract_mesh().manual_axes:
        return start
    leaves, tree = jax.tree.flatten(start)
    kinds = jax.make_jaxpr(one_pass)(start).out_avals
    marked = [_varying(x, axes_of(kind)) for x, kind in zip(leaves, kinds)]
    same = all(a is b for a, b in zip(marked, leaves))
    if same:
        return start
    return _begin(one_pass, jax.tree.unflatten(tree, marked))


def varying_like(tree: Any, *like: Any) -> Any:
    """The arrays of `tree`, varying over all mesh axes that an array of `like` varies
    over.
    """
    kinds = [jax.typeof(x) for x in jax.tree.leaves(like) if eqx.is_array(x)]
    axes = frozenset().union(*map(axes_of, kinds))
    return jax.tree.map(lambda x: _varying(x, axes), tree)


def _varying(x: Any, axes: frozenset[Any]) -> Any:
    """The array x, marked as varying over these mesh axes, too."""
    missing = axes and axes - axes_of(jax.typeof(x))
    if missing:
        return jax.lax.pcast(x, tuple(missing), to="varying")
    return x


def axes_of(kind: Any) -> frozenset[Any]:
    """Mesh axes over which arrays of an abstract value (`jax.typeof(x)`) vary.

    Versions of JAX keep them under one of two names.
    """
    manual = getattr(kind, "manual_axis_type", None)
    if manual is None:
        return getattr(kind, "vma", frozenset())
    return manual.varying
