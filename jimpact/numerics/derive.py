"""Lanes and derivatives of programs with loops.

LANES   A function of arrays (.., B) has its batch in the last axis: entries of one
impact would otherwise be neighbours in memory, and loops over two or three of them do
not fill a vector unit. `vmap` only makes B longer. One impact is a batch of one: there
is no second code path. The function is an operation of JAX: levels of `vmap` (impacts,
shots, starts) see its shapes only, and its loop is traced once, at the batch that is
compiled. Its results are as the function states them.

DERIVATIVES   A loop of unknown length has no reverse mode. So a derivative is the
contraction of the Jacobian with tangents, which JAX transposes, and the Jacobian is a
function of the same form: both modes, every order, under jit and vmap in any nesting. A
rule cannot tell which mode asks, so that the Jacobian in all numbers of an impact is
computed for a single direction, too. Who needs one mode only says so: `ADJOINTS`.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir
from jaxtyping import Array, Float, Shaped

from jimpact.numerics.tangents import (
    TANGENT_AXIS,
    Dual,
    dual_like,
    is_dual,
    is_smooth,
    value_of,
)
from jimpact.tools.compiling import full_precision
from jimpact.tools.loops import varying_like

# Impacts that a CPU solves at a time. A chunk ends with its slowest member, and its
# stages should stay in a core's cache: 64 are no faster, 1024 take half as long again.
CHUNK = 256
# The same where impacts that are over make room for others: slots idle only at the end
# of a chunk. Ten times more: ten times the memory for what enters and leaves.
QUEUE = 4096
# Numbers in the arguments of a batch from which a queue pays for being compiled, a
# third more than without: 6 000 impacts of three balls, 2 000 of five at a wall. Ten
# times more: 4 096 impacts of five at a wall, random velocities, take a third longer.
QUEUE_FROM = 2**16
# Both of impacts with tangents, which take more room in the cache and in memory.
CHUNK_WITH_TANGENTS = 128
QUEUE_WITH_TANGENTS = 512
# Rows of a Jacobian that one run computes; further ones run it again. Ten times more:
# chains of fifty balls take ten times the memory, and no less time.
DIRECTIONS = 64
# 'jacobian': both modes; 'forward': forward mode only, along the directions that are
# asked for; 'checkpoints': reverse mode only, by running steps again from states that
# were kept.
ADJOINTS = ("jacobian", "forward", "checkpoints")
REVERSE_ONLY = (
    "Argument `adjoint` must be 'jacobian' or 'forward' for derivatives in forward "
    "mode (jvp, jacfwd, hessian), but has value 'checkpoints', which has the reverse "
    "mode only (grad, vjp)."
)


class Kind(NamedTuple):
    """Shape of an array but for the batch in its last axis, and type of its numbers."""

    shape: tuple[int, ...]
    dtype: Any

    @property
    def smooth(self) -> bool:
        """True if arrays of this kind have derivatives."""
        return jnp.issubdtype(self.dtype, jnp.inexact)


Arrays = tuple[jax.Array, ...]
Function = Callable[..., Arrays]


def in_lanes(
    function: Function, fine: Function, *arrays: jax.Array, adjoint: str = "jacobian"
) -> Arrays:
    """`function(*arrays)`, where all arrays in and out have the batch in their last
    axis.

    Results that are whole numbers have no derivatives; the others have those of `fine`,
    which is the same at a finer tolerance, with loops of `until_over` by `checkpoints`
    if these are the `adjoint`. Functions are hashable and equal where they do the same:
    each is compiled once. One that `takes_duals` gets `Dual` arguments where it is
    differentiated. One that `queues` gets larger chunks of a large batch: there impacts
    that are over make room for others.
    """
    inputs = [jnp.asarray(x) for x in arrays]
    arrays = tuple(varying_like(inputs, arrays))
    if adjoint == "checkpoints":
        return _reversible(function, fine)(*arrays)
    return _differentiable_lanes(function, fine, adjoint)(*arrays)


@contextmanager
def naming_the_adjoint() -> Iterator[None]:
    """Context in which JAX's refusal of a forward mode names the option that forbids
    it.
    """
    try:
        yield
    except TypeError as error:
        if "custom_vjp" not in str(error):
            raise
        raise TypeError(REVERSE_ONLY) from error


def by_jacobian(function: Callable[[Any], Any], argument: Any) -> Any:
    """`function(argument)` with derivatives in both modes of every order.

    Both are trees; arrays in them may have any shape. `vmap` makes it a batch of runs
    side by side, as of any function.
    """
    leaves, tree = jax.tree.flatten(argument)
    # leaves that are no arrays; None in the place of an array
    others = [None if eqx.is_array(x) else x for x in leaves]
    structures: list[Any] = []  # that of the result, once it is traced

    def of_arrays(*arrays: jax.Array) -> Arrays:
        """The leaves of the result, from the arrays in the argument; notes its
        structure.
        """
        values = iter(arrays)
        rebuilt = [next(values) if x is None else x for x in others]
        outcome = function(jax.tree.unflatten(tree, rebuilt))
        results, structure = jax.tree.flatten(outcome)
        structures[:] = [structure]
        return tuple(results)

    wide = _OneLane(of_arrays)
    lanes = (x[..., None] for x, other in zip(leaves, others) if other is None)
    results = _as_it_is(wide, wide, "jacobian")(*lanes)
    alone = [x[..., 0] for x in results]
    return jax.tree.unflatten(structures[0], alone)


def without_derivatives(values: Any, why: Exception) -> Any:
    """`values` as they are; `why` is raised where one of them is differentiated."""

    @jax.custom_jvp
    def same(numbers: list[Any]) -> list[Any]:
        """The numbers as they are."""
        return numbers

    def rule(primals: Any, tangents: Any) -> Any:
        """The values and their tangents of 0; raises `why` where a tangent is not known
        to be 0.
        """
        rates = jax.tree.leaves(tangents, is_leaf=lambda t: isinstance(t, SymbolicZero))
        if any(not isinstance(rate, SymbolicZero) for rate in rates):
            raise why
        return primals[0], tangents[0]

    same.defjvp(rule, symbolic_zeros=True)
    leaves, tree = jax.tree.flatten(values)
    moving = [i for i, x in enumerate(leaves) if eqx.is_inexact_array(x)]
    same_values = same([leaves[i] for i in moving])
    replaced = dict(zip(moving, same_values))
    new_leaves = [replaced.get(i, x) for i, x in enumerate(leaves)]
    return jax.tree.unflatten(tree, new_leaves)


@dataclasses.dataclass(frozen=True)
class _OneLane:
    """A function of arrays (..), as a function of arrays (.., 1): a batch of one."""

    function: Function

    def __call__(self, *arrays: jax.Array) -> Arrays:
        """Results (.., 1) of the function, from arrays (.., 1)."""
        alone = (x[..., 0] for x in arrays)
        return tuple(x[..., None] for x in self.function(*alone))


@dataclasses.dataclass(frozen=True)
class _WithTangents:
    """Results (.., B) of a function f, then rates `sum_i (df / dx_i) t_i` of the smooth
    ones.

    Arguments: those of the function, then tangents t_i of those `marked`. With `many`,
    tangents and rates have an axis of D directions in front: (D, .., B).
    """

    function: Function
    marked: tuple[bool, ...]
    many: bool = False

    def results(self, *kinds: Kind) -> Iterator[Kind]:
        """Kinds of the results of the function, then of the rates."""
        at = kinds[: len(self.marked)]
        directions = kinds[len(self.marked) :]
        if self.many:
            many = directions[0].shape[:1]
        else:
            many = ()
        return _with_rates(results_of(self.function, *at), many)

    def __call__(self, *arrays: jax.Array) -> Arrays:
        """f(x), then the rates `sum_i (df / dx_i) t_i` in each direction t (a tangent
        of JAX): `many` (D, .., B) of them, or one (.., B).
        """
        values = arrays[: len(self.marked)]
        directions = arrays[len(self.marked) :]
        if not self.many:
            directions = tuple(x[None] for x in directions)
        # a function that takes `Dual`s pushes tangents through its loops itself
        if getattr(self.function, "takes_duals", False):
            push = _push_duals
        else:
            push = _push
        outs, rates = push(self.function, self.marked, values, directions)
        return *outs, *(rates if self.many else (x[0] for x in rates))


@dataclasses.dataclass(frozen=True)
class _WithJacobian:
    """Results (.., B) of a function f, then rates (D, .., B) of the smooth ones: their
    Jacobian.

    D counts the entries of the `marked` arguments in a lane: rate d is the derivative
    in entry d.
    """

    function: Function
    marked: tuple[bool, ...]

    def results(self, *kinds: Kind) -> Iterator[Kind]:
        """Kinds of the results of the function, then of the rates."""
        moving = [kind for kind, mark in zip(kinds, self.marked) if mark]
        count = sum(math.prod(kind.shape) for kind in moving)
        return _with_rates(results_of(self.function, *kinds), (count,))

    def __call__(self, *arrays: jax.Array) -> Arrays:
        """f(x), then its Jacobian: rates along the unit vectors, DIRECTIONS of them in
        each run.
        """
        push = _WithTangents(self.function, self.marked, many=True)
        moving = [x for x, mark in zip(arrays, self.marked) if mark]
        sizes = [math.prod(x.shape[:-1]) for x in moving]
        count = -(-sum(sizes) // DIRECTIONS)  # runs, rounded up
        size = -(-sum(sizes) // count)  # directions of a run
        dtype = moving[0].dtype
        unit = jnp.eye(count * size, sum(sizes), dtype=dtype)

        def along(rows: Float[Array, "d D"]) -> tuple[Arrays, Arrays]:
            """Results, and rates (d, .., B) in d directions, given by entries in all
            arguments.
            """
            directions = []
            first = 0
            for x, n in zip(moving, sizes):  # entries first .. first + n are those of x
                entries = rows[:, first : first + n]
                own = entries.reshape(len(rows), *x.shape[:-1], 1)
                own = jnp.broadcast_to(own, (len(rows), *x.shape))
                directions.append(varying_like(own, x))
                first += n
            outs = push(*arrays, *directions)
            values = _count_of_values(outs)
            return outs[:values], outs[values:]

        if count == 1:
            outs, rates = along(unit)
            return *outs, *rates
        runs = unit.reshape(count, size, -1)
        outs, rates = jax.lax.map(along, runs)
        whole = sum(sizes)
        joined = (jnp.concatenate(x)[:whole] for x in rates)
        return *(x[0] for x in outs), *joined


def _with_rates(results: tuple[Kind, ...], many: tuple[int, ...]) -> Iterator[Kind]:
    """Kinds of results, then of the rates of the smooth ones, with the axes `many` in
    front.
    """
    yield from results
    for kind in results:
        if kind.smooth:
            yield kind._replace(shape=(*many, *kind.shape))


def _count_of_values(outs: Arrays) -> int:
    """Number of the results in a list of results and rates, in which each smooth one
    has a rate.
    """
    smooth = [is_smooth(x) for x in outs]
    return next(n for n in range(len(outs)) if n + sum(smooth[:n]) == len(outs))


def _push(
    function: Function, marked: tuple[bool, ...], arrays: Arrays, directions: Arrays
) -> tuple[Arrays, Arrays]:
    """Results, and rates (d, .., B) of the smooth ones along d directions of the
    `marked` arrays.

    Equation: `rate = sum_i (df / dx_i) t_i`, by one forward derivative (jvp) for each
    direction.
    """

    def of_marked(*values: jax.Array) -> Arrays:
        """`function` of its marked arguments, the others as they are."""
        replaced = iter(values)
        whole = (next(replaced) if m else x for x, m in zip(arrays, marked))
        return tuple(function(*whole))

    def one(*directions: jax.Array) -> tuple[Arrays, Arrays]:
        """Results, and rates (.., B) of the smooth ones, in one direction."""
        outs, rates = jax.jvp(of_marked, moving, directions)
        pairs = zip(outs, rates)
        return outs, tuple(rate for x, rate in pairs if is_smooth(x))

    moving = tuple(x for x, mark in zip(arrays, marked) if mark)
    return jax.vmap(one, out_axes=(None, 0))(*directions)


def _push_duals(
    function: Function, marked: tuple[bool, ...], arrays: Arrays, directions: Arrays
) -> tuple[Arrays, Arrays]:
    """Results and rates as `_push`, of a function that takes `Dual` arguments."""
    inner = iter(jnp.moveaxis(x, 0, TANGENT_AXIS) for x in directions)
    duals = [Dual(x, next(inner)) if mark else x for x, mark in zip(arrays, marked)]
    outs = tuple(function(*duals))
    smooth = [dual_like(duals, x) for x in outs if is_dual(x) or is_smooth(x)]
    rates = tuple(jnp.moveaxis(x.tangents, TANGENT_AXIS, 0) for x in smooth)
    return value_of(outs), rates


@functools.cache
def _differentiable_lanes(function: Function, fine: Function, adjoint: str) -> Function:
    """`function` in lanes with the derivatives of `fine`, made once for equal
    functions.
    """
    return _differentiable(_lanes(function), fine, adjoint, _differentiable_lanes)


def _as_it_is(function: Function, fine: Function, adjoint: str) -> Function:
    """`function` with the derivatives of `fine`, not in lanes."""
    return _differentiable(function, fine, adjoint, _as_it_is)


def _differentiable(
    run: Function,
    fine: Function,
    adjoint: str,
    again: Callable[[Any, Any, str], Function],
) -> Function:
    """`run` with the derivatives of `fine`, to which `again` gives derivatives of their
    own.
    """

    @jax.custom_jvp
    def value(*arrays: jax.Array) -> Arrays:
        """The results of `run`."""
        return full_precision(run)(*arrays)

    def derivative(
        kind: Any, marked: tuple[bool, ...], *arrays: jax.Array
    ) -> tuple[Arrays, Any]:
        """Results of `fine` and their rates, both with derivatives again.

        `kind`: `_WithTangents` (arrays: arguments, tangents) or `_WithJacobian`
        (arguments).
        """
        with_rates = kind(fine, marked)
        outs = again(with_rates, with_rates, adjoint)(*arrays)
        count = _count_of_values(outs)
        return outs[:count], iter(outs[count:])

    @full_precision
    def rule(
        primals: Arrays, tangents: tuple[Any, ...]
    ) -> tuple[Arrays, tuple[Any, ...]]:
        """Results of `fine` and their tangents: Jacobian times direction, or `forward`
        along it.
        """
        marked = tuple(not isinstance(t, SymbolicZero) for t in tangents)
        moving = [t for t, mark in zip(tangents, marked) if mark]
        if isinstance(fine, _WithTangents):
            return _second_order(fine, marked, primals, tuple(moving))
        if adjoint == "forward":
            outs, rates = derivative(_WithTangents, marked, *primals, *moving)
        else:
            outs, jacobian = derivative(_WithJacobian, marked, *primals)
            flat = [t.reshape(-1, t.shape[-1]) for t in moving]
            direction = jnp.concatenate(flat)
            rates = iter([_contracted(x, direction) for x in jacobian])
        return outs, _with_zeros(outs, rates)

    value.defjvp(rule, symbolic_zeros=True)
    return value


def _second_order(
    first: _WithTangents, marked: tuple[bool, ...], primals: Arrays, moving: Arrays
) -> tuple[Arrays, tuple[Any, ...]]:
    """Results of `first`, and their tangents: derivatives of its product with the
    Jacobian.

    `first` is f'(x) t; its tangent is that of `J(x) t`, with J a function that has
    derivatives.
    """

    def by_jacobian(*values: jax.Array) -> tuple[Arrays, Arrays]:
        """Smooth results of `first`, then all, at its `marked` arguments x and t:
        `J(x) t`.
        """
        replaced = iter(values)
        arrays = [next(replaced) if mark else x for x, mark in zip(primals, marked)]
        count = len(first.marked)
        jacobian = _WithJacobian(first.function, first.marked)
        outs = _differentiable_lanes(jacobian, jacobian, "jacobian")(*arrays[:count])
        n = _count_of_values(outs)
        flat = [t.reshape(-1, t.shape[-1]) for t in arrays[count:]]
        direction = jnp.concatenate(flat)
        along = (_contracted(x, direction) for x in outs[n:])
        whole = *outs[:n], *along
        return tuple(x for x in whole if is_smooth(x)), whole

    values = tuple(x for x, mark in zip(primals, marked) if mark)
    _, rates, outs = jax.jvp(by_jacobian, values, moving, has_aux=True)
    return outs, _with_zeros(outs, iter(rates))


def _with_zeros(outs: Arrays, rates: Iterator[jax.Array]) -> tuple[Any, ...]:
    """Tangents of all results: the `rates` of the smooth ones, symbolic zeros of the
    others.
    """
    none = (SymbolicZero(jax.typeof(x).to_tangent_aval()) for x in outs)
    return tuple(next(rates) if is_smooth(x) else zero for x, zero in zip(outs, none))


def _contracted(
    rates: Float[Array, "D *rows B"], direction: Float[Array, "D B"]
) -> Float[Array, "*rows B"]:
    """Tangent `sum_d rates_d direction_d` of a result: its Jacobian times a
    direction.
    """
    return jnp.einsum("d...b,db->...b", rates, direction)


@functools.cache
def _reversible(function: Function, fine: Function) -> Function:
    """`function` in lanes; for derivatives `fine` as it is, with the reverse mode of
    its loops.
    """

    @jax.custom_vjp
    def value(*arrays: jax.Array) -> Arrays:
        """The results of `function`, without derivatives."""
        return _lanes(function)(*arrays)

    @full_precision
    def forward(*arrays: jax.Array) -> tuple[Arrays, Any]:
        """Results of `fine`, and the product of cotangents with its transposed
        Jacobian.
        """
        if hasattr(fine, "only_first"):
            arrays = fine.only_first(arrays)

        def run(*arrays: jax.Array) -> tuple[Arrays, Arrays]:
            """Results that have derivatives, and all results."""
            outs = fine(*arrays)
            return tuple(x for x in outs if is_smooth(x)), outs

        _, back, outs = jax.vjp(run, *arrays, has_aux=True)
        return outs, back

    def backward(back: Any, cotangents: Arrays) -> Any:
        """Cotangents of the arrays, `J^T c`, from those of the results."""
        return full_precision(back)(tuple(c for c in cotangents if is_smooth(c)))

    value.defvjp(forward, backward)
    return value


def _chunk_of(function: Any, arrays: Arrays) -> int:
    """Number of impacts of a batch that a CPU gets at a time.

    More for a function that `queues`, where the batch is large or there is friction,
    with which some impacts take many times the steps of others.
    """
    differentiated = isinstance(function, _WithTangents | _WithJacobian)
    while isinstance(function, _WithTangents | _WithJacobian):
        function = function.function
    large = sum(x.size for x in arrays) >= QUEUE_FROM
    # `tangents` of a program are its tangential impulses
    if getattr(function, "queues", False) and (large or function.tangents > 0):
        if differentiated:
            return QUEUE_WITH_TANGENTS
        return QUEUE
    if differentiated:
        return CHUNK_WITH_TANGENTS
    return CHUNK


@functools.cache
def _lanes(function: Function) -> Function:
    """`function` as one operation of JAX, of arrays whose last axis is that of a batch.

    `vmap` makes this axis longer. Only where the operation is compiled is `function`
    traced, once, at the batch that there is.
    """

    def bind(*arrays: jax.Array) -> Arrays:
        """Results (.., B) of arrays (.., B)."""
        arrays = tuple(varying_like(arrays, arrays))  # all over the same axes of a mesh
        one = (Kind(x.shape[:-1], x.dtype) for x in arrays)  # of a batch
        kinds = results_of(function, *one)
        return tuple(_lanes_p.bind(*arrays, function=function, results=kinds))

    return bind


@functools.cache
def results_of(function: Function, *kinds: Kind) -> tuple[Kind, ...]:
    """Kinds of the results at arguments of these `kinds`: as the function says, or by a
    trace.
    """
    if hasattr(function, "results"):
        return tuple(function.results(*kinds))
    one = [jax.ShapeDtypeStruct((*kind.shape, 1), kind.dtype) for kind in kinds]
    outs = jax.eval_shape(_compiled(function), *one)
    return tuple(Kind(x.shape[:-1], x.dtype) for x in outs)


@functools.cache
def _compiled(function: Function) -> Function:
    """`function` in chunks of the batch, compiled."""
    return jax.jit(functools.partial(_in_chunks, function))


# A function in lanes as one operation: see above.
_lanes_p = Primitive("lanes")
_lanes_p.multiple_results = True


def _run_lanes(*arrays: jax.Array, function: Function, results: Any) -> Arrays:
    """Results of the operation as it is compiled, and run."""
    return tuple(_compiled(function)(*arrays))


_lanes_p.def_impl(_run_lanes)
mlir.register_lowering(_lanes_p, mlir.lower_fun(_run_lanes, multiple_results=True))


def _kinds_of_results(*arguments: Any, function: Function, results: Any) -> list[Any]:
    """Abstract arrays of the results: their kinds with the batch of the arguments
    behind.
    """
    first = arguments[0]
    batch = first.shape[-1]

    def like_first(kind: Kind) -> Any:
        """An array of this kind that varies over the same axes of a mesh as the first
        argument.
        """
        shape = (*kind.shape, batch)
        whole = jax.sharding.PartitionSpec(*[None] * len(shape))
        sharding = jax.sharding.NamedSharding(first.sharding.mesh, whole)
        return first.update(
            shape=shape, dtype=kind.dtype, weak_type=False, sharding=sharding
        )

    return [like_first(kind) for kind in results]


_lanes_p.def_abstract_eval(_kinds_of_results)


def _batching_rule(
    arrays: Any, axes: Any, *, function: Function, results: Any
) -> tuple[Arrays, tuple[Any, ...]]:
    """Rule of `vmap` for `_lanes_p`: the results, and the axis of their batch (None: no
    batch).

    `axes`: of the batch in each array, None where it has none. Arrays (.., B) with a
    batch of `size` become (.., size B), and the results are split again. But a batch of
    tangents alone, at values that have none, becomes the directions of `_WithTangents`,
    which computes values once.
    """
    batched = [axis is not None for axis in axes]
    pairs = list(zip(arrays, axes))
    size = next(x.shape[axis] for x, axis in pairs if axis is not None)
    arrays = [
        x if axis is None else jnp.moveaxis(x, axis, 0) for x, axis in zip(arrays, axes)
    ]
    count = len(getattr(function, "marked", ()))  # of values, before their tangents
    if (
        isinstance(function, _WithTangents)
        and not function.many
        and not any(batched[:count])
    ):
        # many directions at one point: its steps are computed once
        along = [
            x if is_batched else jnp.broadcast_to(x, (size, *x.shape))
            for x, is_batched in zip(arrays[count:], batched[count:])
        ]
        many = dataclasses.replace(function, many=True)
        outs = _lanes(many)(*arrays[:count], *along)
        values = _count_of_values(outs)
        return outs, tuple(None if i < values else 0 for i in range(len(outs)))

    def wide(x: Shaped[Array, "..."], is_batched: bool) -> Shaped[Array, "..."]:
        """An array with the batch of `vmap` and its own, one after the other, in its
        last axis.
        """
        if is_batched:
            x = jnp.moveaxis(x, 0, -2)
        else:
            every_lane = (*x.shape[:-1], size, x.shape[-1])
            x = jnp.broadcast_to(x[..., None, :], every_lane)
        lanes = size * x.shape[-1]
        return x.reshape(*x.shape[:-2], lanes)

    outs = _lanes(function)(*map(wide, arrays, batched))
    split = [x.reshape(*x.shape[:-1], size, x.shape[-1] // size) for x in outs]
    in_front = tuple(jnp.moveaxis(x, -2, 0) for x in split)
    return in_front, (0,) * len(split)


batching.primitive_batchers[_lanes_p] = _batching_rule


@full_precision
def _in_chunks(function: Function, *arrays: jax.Array) -> Arrays:
    """Results of a function: chunk after chunk of the batch on a CPU, all at once
    elsewhere.
    """
    size = arrays[0].shape[-1]
    count = -(-size // _chunk_of(function, arrays))
    if count == 1:
        return tuple(function(*arrays))
    width = -(-size // count)

    def pieces(*whole: jax.Array) -> Arrays:
        """Results of all chunks, computed one after the other and joined."""

        def cut(x: Shaped[Array, "*rows B"]) -> Shaped[Array, "count *rows width"]:
            """Chunks of the batch, the last one filled up with its last impact."""
            more = (0, count * width - size)
            filled = jnp.pad(x, [*[(0, 0)] * (x.ndim - 1), more], mode="edge")
            chunks = filled.reshape(*x.shape[:-1], count, width)
            return jnp.moveaxis(chunks, -2, 0)

        def join(x: Shaped[Array, "count *rows width"]) -> Shaped[Array, "*rows B"]:
            """The chunks side by side, without what fills up the last one: the inverse
            of `cut`.
            """
            joined = jnp.moveaxis(x, 0, -2)
            side_by_side = joined.reshape(*joined.shape[:-2], count * width)
            return side_by_side[..., :size]

        chunks = tuple(map(cut, whole))
        mapped = jax.lax.map(lambda piece: tuple(function(*piece)), chunks)
        return tuple(map(join, mapped))

    return jax.lax.platform_dependent(
        *arrays, cpu=pieces, default=lambda *whole: tuple(function(*whole))
    )
