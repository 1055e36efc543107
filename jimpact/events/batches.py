"""Batches in the last axis: a call that `vmap` makes wider, and both modes of any order go through.

`vmap` puts a batch first. Entries of one impact are then neighbours in memory, and loops over
two or three of them do not fill a vector unit. Functions called by `in_columns` are written for
arrays (..., B) with the batch last; `vmap` only makes B longer, whatever is differentiated inside
or outside of it. One impact is a batch of one: there is no second code path.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir, partial_eval as pe

from jimpact.compiling import full_precision
from jimpact.events.tangents import TANGENT_AXIS, Dual, dual_like, is_dual, value_of
from jimpact.loops import kinds_like, varying_like
from jimpact.solvers.sensitivity import unit_directions

# Impacts that a CPU solves at a time. A chunk ends with its slowest member, and its stages should
# stay in a core's cache: 64 are no faster, 1024 take half as long again.
CHUNK = 256
CHUNK_WITH_TANGENTS = 128  # of impacts with tangents, which take more room in the cache
# Entries of the arguments with derivatives up to which the reverse mode multiplies with a Jacobian
# of the forward mode: compiled in half of the time, and run in two thirds. Ten times more: chains
# of twenty balls take half as long again.
MOST_DIRECTIONS = 16

Arrays = tuple[jax.Array, ...]
columns_p = Primitive("columns")
columns_p.multiple_results = True


def in_columns(function: Callable[..., Arrays], *arrays: jax.Array) -> Arrays:
    """`function(*arrays)`, where all arrays in and out have the batch in their last axis.

    Results that are whole numbers have no derivatives; `function.smoothed()` leaves them out.
    `function` is hashable and compares equal where it does the same (a function of a module, or a
    frozen dataclass with `__call__`): its derivatives are made and compiled once. Its method
    `shapes`, if it has one, returns the shapes of its results from those of its arguments.
    It gets the whole batch if it has a method `queues` that returns True, else chunks of it.
    Inside `shard_map` the results vary over all mesh axes that an array varies over; `function`
    itself does not know of the mesh.
    """
    varying = varying_like([jnp.asarray(x) for x in arrays], arrays)
    return tuple(columns_p.bind(*varying, function=function))


def _partial(
    function: Callable[..., Arrays], marked: tuple[bool, ...], arguments: Arrays
) -> tuple[Callable[..., Arrays], Arrays]:
    """`function` of its marked arguments alone, and their values."""

    def of_marked(*values: jax.Array) -> Arrays:
        """`function` with the marked arguments replaced."""
        replaced = iter(values)
        return tuple(function(*(next(replaced) if m else x for x, m in zip(arguments, marked))))

    return of_marked, tuple(x for x, mark in zip(arguments, marked) if mark)


@dataclasses.dataclass(frozen=True)
class Tangent:
    """Tangents of the results of `function`, from its arguments and the tangents of those marked.

    `many`: the tangents have a leading axis of directions; the arguments have none.
    A `function` that `takes_duals` also returns them.
    """

    function: Callable[..., Arrays]
    marked: tuple[bool, ...]
    many: bool = False

    def __call__(self, *arrays: jax.Array) -> Arrays:
        """Tangents (.., B) of all results; with `many`, directions first."""
        outs = WithTangents(self.function, self.marked, self.many)(*arrays)
        return outs[_count_of_values(outs) :]


@dataclasses.dataclass(frozen=True)
class WithTangents:
    """The results of `function` and, behind them, the tangents of the floating-point ones.

    One program for both: in forward mode nothing is computed or compiled twice. The reverse mode
    takes it apart again, into `function` and its `Tangent`.
    """

    function: Callable[..., Arrays]
    marked: tuple[bool, ...]
    many: bool = False

    def __call__(self, *arrays: jax.Array) -> Arrays:
        """Results (.., B), and tangents (.., B); with `many`, directions first."""
        count = len(self.marked)
        primals, tangents = arrays[:count], arrays[count:]
        if getattr(self.function, "takes_duals", False):
            return sum(_by_duals(self, primals, tangents), ())
        of_marked, values = _partial(self.function, self.marked, primals)

        def push(*tangents: jax.Array) -> tuple[Arrays, Arrays]:
            """Results, and tangents in one direction."""
            outs, rates = jax.jvp(of_marked, values, tangents)
            return outs, tuple(rate for x, rate in zip(outs, rates) if is_smooth(x))

        outs, rates = (jax.vmap(push, out_axes=(None, 0)) if self.many else push)(*tangents)
        return *outs, *rates


@dataclasses.dataclass(frozen=True)
class Contraction:
    """Tangents from a Jacobian: for `results` of its rows (D, .., B) the sum over directions D."""

    results: int

    def __call__(self, *arrays: jax.Array) -> Arrays:
        """Tangents (.., B) of each result, from its Jacobian and then the tangents (.., B)."""
        jacobian, tangents = arrays[: self.results], arrays[self.results :]
        rows = [x.reshape(-1, x.shape[-1]) for x in tangents]
        directions = jnp.concatenate(rows)

        def along(rates: jax.Array) -> jax.Array:
            """The tangent of one result."""
            each = directions.reshape(len(rates), *[1] * (rates.ndim - 2), -1)
            return jnp.sum(rates * each, axis=0)

        return tuple(map(along, jacobian))


def is_smooth(x: Any) -> bool:
    """Whether an array, or its shape, has floating-point numbers, which may have tangents."""
    return bool(jnp.issubdtype(x.dtype, jnp.floating))


def _by_duals(
    derivative: "Tangent | WithTangents", primals: Arrays, tangents: Arrays
) -> tuple[Arrays, Arrays]:
    """Results of a function that takes duals, and the tangents of the floating-point ones."""
    many = derivative.many
    tangents = tangents if many else tuple(x[None] for x in tangents)
    inner = iter(jnp.moveaxis(x, 0, TANGENT_AXIS) for x in tangents)
    duals = [Dual(x, next(inner)) if m else x for x, m in zip(primals, derivative.marked)]
    outs = derivative.function(*duals)
    smooth = [dual_like(duals, x) for x in outs if is_dual(x) or is_smooth(x)]
    rates = [jnp.moveaxis(x.tangents, TANGENT_AXIS, 0) for x in smooth]
    return value_of(tuple(outs)), tuple(rates if many else (x[0] for x in rates))


def smoothed(function: Any) -> Any:
    """The function without results that are no floating-point numbers."""
    if isinstance(function, WithTangents):
        return dataclasses.replace(function, function=smoothed(function.function))
    form = getattr(function, "smoothed", None)
    return function if form is None else form()


def reversible(function: Any) -> Any:
    """The function in a form that the reverse mode goes through, too."""
    form = getattr(function, "reversible", None)
    return function if form is None else form()


@dataclasses.dataclass(frozen=True)
class Cotangent:
    """Cotangents of the marked arguments of `function`, from its arguments and cotangents.

    No derivative is transposed a second time: see `_of_derivative`.
    """

    function: Callable[..., Arrays]
    marked: tuple[bool, ...]
    many: bool = False

    def __call__(self, *arrays: jax.Array) -> Arrays:
        """Cotangents (.., B) of the marked arguments; with `many`, directions first."""
        if isinstance(self.function, WithTangents):
            return self._of_both(self.function, arrays)
        count = len(self.marked)
        primals, cotangents = arrays[:count], arrays[count:]
        if isinstance(self.function, Tangent | Cotangent):

            def pull(*cotangents: jax.Array) -> Arrays:
                """Cotangents for one cotangent of the results."""
                return self._of_derivative(self.function, primals, cotangents)
        else:
            of_marked, values = _partial(reversible(self.function), self.marked, primals)
            _, back = jax.vjp(of_marked, *values)

            def pull(*cotangents: jax.Array) -> Arrays:
                """Cotangents for one cotangent of the results."""
                return back(cotangents)

        return (jax.vmap(pull) if self.many else pull)(*cotangents)

    def _of_derivative(self, inner: Any, arrays: Arrays, cotangents: Arrays) -> Arrays:
        """Of a tangent J(x) t, or of a cotangent J(x)^T t, for one cotangent w.

        Second derivatives are symmetric: with respect to x both are the tangent of J(x)^T w in the
        direction t, or of J(x)^T t in the direction w. With respect to t they are J^T w and J w.
        """
        function, count = inner.function, len(inner.marked)
        at, linear = arrays[:count], arrays[count:]
        of_x, of_t = self.marked[:count], self.marked[count:]
        forward = isinstance(inner, Tangent)
        results: list[jax.Array] = []
        if any(of_x):
            back = Cotangent(function, of_x)
            covectors, directions = (cotangents, linear) if forward else (linear, cotangents)
            tangent = Tangent(back, inner.marked + (False,) * len(covectors))

            def one(covectors: Arrays, directions: Arrays) -> Arrays:
                """Of one direction."""
                return tangent(*at, *covectors, *directions)

            if inner.many:
                each = jax.vmap(one)(covectors, directions)
                results += [jnp.sum(x, axis=0) for x in each]
            else:
                results += one(covectors, directions)
        if any(of_t):
            other = Cotangent(function, inner.marked, inner.many)
            change = other if forward else Tangent(function, inner.marked, inner.many)
            rates = change(*at, *cotangents)
            results += [x for x, mark in zip(rates, of_t) if mark]
        return tuple(results)

    def _of_both(self, both: WithTangents, arrays: Arrays) -> Arrays:
        """Of results and their tangents: the sum of what each of them gives."""
        count, inner = len(self.marked), len(both.marked)
        primals, cotangents = arrays[:count], arrays[count:]
        half = len(cotangents) // 2  # results without tangents have no cotangents
        rates = Tangent(both.function, both.marked, both.many)
        whole = Cotangent(rates, self.marked, self.many)(*primals, *cotangents[half:])
        if not any(self.marked[:inner]):
            return whole
        first = Cotangent(both.function, self.marked[:inner], self.many)
        added = first(*primals[:inner], *cotangents[:half])
        return *(a + b for a, b in zip(whole, added)), *whole[len(added) :]


def with_tangents_in_columns(
    function: Callable[..., Arrays], arrays: Arrays, tangents: tuple[Any, ...]
) -> tuple[Arrays, Arrays]:
    """`in_columns(function, *arrays)`, and the tangents of the results that have some."""
    marked = tuple(not isinstance(t, SymbolicZero) for t in tangents)
    nonzero = (t for t, mark in zip(tangents, marked) if mark)
    return _bind_with_tangents(function, marked, (*arrays, *nonzero))


def _bind_with_tangents(
    function: Callable[..., Arrays], marked: tuple[bool, ...], arrays: Arrays
) -> tuple[Arrays, Arrays]:
    """Results and tangents of `WithTangents`, apart."""
    outs = in_columns(WithTangents(function, marked), *arrays)
    count = _count_of_values(outs)
    return outs[:count], outs[count:]


def _count_of_values(outs: Any) -> int:
    """How many of the results, or shapes, of `WithTangents` are no tangents."""
    smooth = [is_smooth(x) for x in outs]
    return next(n for n in range(len(outs)) if n + sum(smooth[:n]) == len(outs))


def _queues(function: Any, arrays: Arrays) -> bool:
    """Whether the function works through a batch of any size by itself."""
    if isinstance(function, Tangent | WithTangents):
        return _queues(smoothed(function.function), arrays[: len(function.marked)])
    queues = getattr(function, "queues", None)
    return queues is not None and queues(*arrays)


@full_precision
def _in_chunks(function: Callable[..., Arrays], *arrays: jax.Array) -> Arrays:
    """On a CPU piece by piece, the last one filled up; on accelerators all at once."""
    size = arrays[0].shape[-1]
    if _queues(function, arrays):
        return tuple(function(*arrays))
    tangents = isinstance(function, Tangent | WithTangents)
    count = -(-size // (CHUNK_WITH_TANGENTS if tangents else CHUNK))
    if count == 1:
        return tuple(function(*arrays))
    width = -(-size // count)

    def pieces(*whole: jax.Array) -> Arrays:
        """All chunks, one after the other."""

        def cut(x: jax.Array) -> jax.Array:
            """Chunks (count, .., width) of (.., B), the last one filled up with its last impact."""
            filled = jnp.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, count * width - size)], mode="edge")
            return jnp.moveaxis(filled.reshape(*x.shape[:-1], count, width), -2, 0)

        def join(x: jax.Array) -> jax.Array:
            """The inverse of `cut`."""
            joined = jnp.moveaxis(x, 0, -2)
            return joined.reshape(*joined.shape[:-2], count * width)[..., :size]

        mapped = jax.lax.map(lambda piece: tuple(function(*piece)), tuple(map(cut, whole)))
        return tuple(map(join, mapped))

    return jax.lax.platform_dependent(
        *arrays, cpu=pieces, default=lambda *whole: tuple(function(*whole))
    )


@functools.cache
def _compiled(function: Callable[..., Arrays]) -> Callable[..., Arrays]:
    """The function compiled, once for all calls with equal functions."""
    return jax.jit(functools.partial(_in_chunks, function))


@columns_p.def_impl
def _run(*arrays: jax.Array, function: Callable[..., Arrays]) -> Arrays:
    """Values of the primitive."""
    return _compiled(function)(*arrays)


@columns_p.def_abstract_eval
def _kinds(*kinds: Any, function: Callable[..., Arrays]) -> list[Any]:
    """Abstract results: of these shapes, as varying inside `shard_map` as the arguments."""
    return kinds_like(_shapes(*kinds, function=function), kinds[0])


def _shapes(*shapes: Any, function: Callable[..., Arrays]) -> list[Any]:
    """Shapes of the results, without tracing `function` where they are known: it takes long."""
    known = [jax.core.ShapedArray(s.shape, s.dtype) for s in shapes]
    if isinstance(function, Tangent | WithTangents | Cotangent):
        primals, rest = known[: len(function.marked)], shapes[len(function.marked) :]
        values: list[Any] = []
        if isinstance(function, Cotangent):
            outs = [x for x, mark in zip(primals, function.marked) if mark]
        else:
            values = _shapes(*primals, function=function.function)
            outs = [x for x in values if is_smooth(x)]
        many = rest[0].shape[:1] if function.many else ()
        rates = [jax.core.ShapedArray((*many, *x.shape), x.dtype) for x in outs]
        return [*values, *rates] if isinstance(function, WithTangents) else rates
    shapes_of = getattr(function, "shapes", None) or functools.partial(jax.eval_shape, function)
    return [jax.core.ShapedArray(x.shape, x.dtype) for x in shapes_of(*known)]


def _lower(context: Any, *arrays: Any, function: Callable[..., Arrays]) -> Any:
    """Rule of compilation: `function` of arrays that vary over no axis of a mesh."""
    alone = [jax.core.ShapedArray(x.shape, x.dtype) for x in context.avals_in]
    lower = mlir.lower_fun(_run, multiple_results=True)
    return lower(context.replace(avals_in=alone), *arrays, function=function)


mlir.register_lowering(columns_p, _lower)


def _wider(
    arrays: Any, axes: Any, *, function: Callable[..., Arrays]
) -> tuple[list[jax.Array], list[int | None]]:
    """Rule of `vmap`: its batch becomes part of the last axis."""
    size = next(x.shape[axis] for x, axis in zip(arrays, axes) if axis is not None)
    if isinstance(function, Tangent | WithTangents | Cotangent) and not function.many:
        count = len(function.marked)
        if all(axis is None for axis in axes[:count]):
            # many directions at one point: its steps are computed once
            rest = [
                jnp.broadcast_to(x, (size, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0)
                for x, axis in zip(arrays[count:], axes[count:])
            ]
            outs = in_columns(dataclasses.replace(function, many=True), *arrays[:count], *rest)
            both = isinstance(function, WithTangents)
            values = _count_of_values(outs) if both else 0
            return list(outs), [None] * values + [0] * (len(outs) - values)

    def wide(x: jax.Array, axis: int | None) -> jax.Array:
        """The array with the batch of `vmap` in its last axis."""
        if axis is None:
            x = jnp.broadcast_to(x[..., None, :], (*x.shape[:-1], size, x.shape[-1]))
        else:
            x = jnp.moveaxis(x, axis, -2)
        return x.reshape(*x.shape[:-2], size * x.shape[-1])

    outs = in_columns(function, *map(wide, arrays, axes))
    split = [out.reshape(*out.shape[:-1], size, out.shape[-1] // size) for out in outs]
    return [jnp.moveaxis(out, -2, 0) for out in split], [0] * len(split)


batching.primitive_batchers[columns_p] = _wider


def _jvp(
    primals: Any, tangents: Any, *, function: Callable[..., Arrays]
) -> tuple[list[Any], list[Any]]:
    """Rule of the forward mode."""
    marked = tuple(type(t) is not ad.Zero for t in tangents)
    nonzero = [t for t, mark in zip(tangents, marked) if mark]
    outs, rates = _bind_with_tangents(function, marked, (*primals, *nonzero))
    rest = iter(rates)

    def zero(x: Any) -> Any:
        """The tangent of a whole number."""
        return ad.Zero(jax.typeof(x).to_tangent_aval())

    return list(outs), [next(rest) if is_smooth(x) else zero(x) for x in outs]


ad.primitive_jvps[columns_p] = _jvp


def _apart(function: WithTangents) -> tuple[Any, Tangent]:
    """What gives its results, and what its tangents."""
    inner = function.function
    return inner, Tangent(smoothed(inner), function.marked, function.many)


def _directions(function: WithTangents, shapes: Any) -> int:
    """Entries of the marked arguments in each lane."""
    marked = (x.shape for x, mark in zip(shapes, function.marked) if mark)
    return sum(math.prod(shape[:-1]) for shape in marked)


def _with_jacobian(function: WithTangents, arrays: Arrays) -> tuple[Arrays, Arrays]:
    """Results, and rates (D, .., B) of the smooth ones along all entries of marked arguments."""
    moving = [x for x, mark in zip(arrays, function.marked) if mark]
    of_one = unit_directions([x[..., 0] for x in moving])
    units = [jnp.broadcast_to(u[..., None], (len(u), *x.shape)) for u, x in zip(of_one, moving)]
    outs = in_columns(dataclasses.replace(function, many=True), *arrays, *units)
    values = _count_of_values(outs)
    return outs[:values], outs[values:]


def _partial_eval(trace: Any, *arrays: Any, function: Any) -> list[Any]:
    """Rule of the reverse mode: where only tangents are unknown, the results are known.

    So is the Jacobian, if it has few columns: then tangents are its product with theirs.
    """
    known = [x.is_known() for x in arrays]
    count = len(function.marked) if isinstance(function, WithTangents) else 0
    if not count or all(known) or not all(known[:count]):
        return list(trace.default_process_primitive(columns_p, arrays, {"function": function}))
    at, unknown = tuple(x.pval.get_known() for x in arrays[:count]), arrays[count:]
    if not function.many and _directions(function, at) <= MOST_DIRECTIONS:
        outs, jacobian = _with_jacobian(function, at)
        rows = map(trace.new_instantiated_const, jacobian)
        product = {"function": Contraction(len(jacobian))}
        return [*outs, *trace.default_process_primitive(columns_p, [*rows, *unknown], product)]
    inner, tangent = _apart(function)
    values = columns_p.bind(*at, function=inner)
    rates = trace.default_process_primitive(columns_p, arrays, {"function": tangent})
    return [*values, *rates]


pe.custom_partial_eval_rules[columns_p] = _partial_eval


def _partial_eval_of_program(_: Any, unknown: Any, at_hand: Any, eqn: Any) -> Any:
    """The same rule within `jax.checkpoint`. Results are small and dear: they are kept."""
    function, size = eqn.params["function"], len(eqn.outvars)
    if not any(unknown):
        return eqn, None, [False] * size, [False] * size, []
    missing = [x for x, there in zip(eqn.invars, at_hand) if not there and hasattr(x, "count")]
    count = len(function.marked) if isinstance(function, WithTangents) else 0
    if not count or any(unknown[:count]):
        return None, eqn, [True] * size, [True] * size, missing
    inner, tangent = _apart(function)
    whole = _count_of_values([x.aval for x in eqn.outvars])
    first = {"invars": eqn.invars[:count], "outvars": eqn.outvars[:whole]}
    values = eqn.replace(**first, params={"function": inner})
    rates = eqn.replace(outvars=eqn.outvars[whole:], params={"function": tangent})
    late = [False] * whole + [True] * (size - whole)
    return values, rates, late, late, missing


pe.partial_eval_jaxpr_custom_rules[columns_p] = _partial_eval_of_program


def _transpose(cotangents: Any, *arrays: Any, function: Callable[..., Arrays]) -> list[Any]:
    """Rule of the reverse mode: the transpose of a map that is linear in some arguments."""
    linear = tuple(ad.is_undefined_primal(x) for x in arrays)

    def zeros(x: Any) -> jax.Array:
        """Zeros of the shape of an argument."""
        return jnp.zeros(x.aval.shape, x.aval.dtype)

    filled = [zeros(c) if type(c) is ad.Zero else c for c in cotangents]
    if isinstance(function, Tangent) and linear == (False,) * len(function.marked) + (True,) * sum(
        function.marked
    ):
        # the transpose of a tangent map is the pull back of its function
        primals = list(arrays[: len(function.marked)])
        back = Cotangent(function.function, function.marked, function.many)
    else:
        # linear in what is undefined: its derivative at 0 is the map itself
        primals = [zeros(x) if undefined else x for x, undefined in zip(arrays, linear)]
        back = Cotangent(function, linear)
    pulled = iter(in_columns(back, *primals, *filled))
    return [next(pulled) if u else None for u in linear]


ad.primitive_transposes[columns_p] = _transpose


@jax.custom_batching.custom_vmap
def over_lanes(count: jax.Array) -> jax.Array:
    """The sum of whole numbers over all lanes that `vmap` makes of this program.

    It is the same in all lanes: a condition or a loop on it is not turned into a selection.
    """
    return count


@over_lanes.def_vmap
def _over_lanes(size: int, batched: Any, count: jax.Array) -> tuple[jax.Array, bool]:
    """Rule of `vmap`: the sum over its lanes."""
    return over_lanes(jnp.sum(count, axis=0, dtype=count.dtype)), False


def any_lane(happens: jax.Array) -> jax.Array:
    """Whether it happens in any lane."""
    return over_lanes(happens.astype(jnp.int32)) > 0
