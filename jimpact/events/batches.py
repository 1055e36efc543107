"""Batches in the last axis: a call that `vmap` makes wider, and both modes of any order go through.

`vmap` puts a batch first. Entries of one impact are then neighbours in memory, and loops over
two or three of them do not fill a vector unit. Functions called by `in_columns` are written for
arrays (..., B) with the batch last; `vmap` only makes B longer, whatever is differentiated inside
or outside of it. One impact is a batch of one: there is no second code path.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from jimpact.events.tangents import BESIDE, Moving, moving_with

# Impacts side by side on a CPU. A piece of a batch ends with its slowest member, and its stages
# should stay in a core's cache: 64 are no faster, 1024 take half as long again.
CHUNK = 256
WITH_TANGENTS = 128  # of those with tangents side by side, which take more room

Arrays = tuple[jax.Array, ...]
columns_p = Primitive("columns")
columns_p.multiple_results = True


def in_columns(function: Callable[..., Arrays], *arrays: jax.Array) -> Arrays:
    """`function(*arrays)`, where all arrays in and out have the batch in their last axis.

    Where it is differentiated all its results are floating-point numbers.
    `function` is hashable and compares equal where it does the same (a function of a module, or a
    frozen dataclass with `__call__`): its derivatives are made and compiled once. Its method
    `shapes`, if it has one, tells the shapes of its results from those of its arguments.
    """
    return tuple(columns_p.bind(*map(jnp.asarray, arrays), function=function))


def _smooth(
    function: Callable[..., Arrays], marked: tuple[bool, ...], given: Arrays
) -> tuple[Callable[..., Arrays], Arrays]:
    """`function` of its marked arguments alone, and their values."""

    def smooth(*values: jax.Array) -> Arrays:
        moved = iter(values)
        every = [next(moved) if mark else x for x, mark in zip(given, marked)]
        return tuple(function(*every))

    return smooth, tuple(x for x, mark in zip(given, marked) if mark)


@dataclasses.dataclass(frozen=True)
class Tangent:
    """Tangents of `function` from its arguments and the tangents of those marked.

    `many`: these have a leading axis, along which the arguments are the same.
    A `function` that is `beside` takes arguments that are `Moving`, and gives such results.
    """

    function: Callable[..., Arrays]
    marked: tuple[bool, ...]
    many: bool = False

    def __call__(self, *arrays: jax.Array) -> Arrays:
        count = len(self.marked)
        given, along = arrays[:count], arrays[count:]
        if getattr(self.function, "beside", False):
            along = along if self.many else tuple(x[None] for x in along)
            beside = iter(jnp.moveaxis(x, 0, BESIDE) for x in along)
            mixed = [Moving(x, next(beside)) if m else x for x, m in zip(given, self.marked)]
            outs = [moving_with(mixed, x) for x in self.function(*mixed)]
            rates = [jnp.moveaxis(x.along, BESIDE, 0) for x in outs]
            return tuple(rates if self.many else (x[0] for x in rates))
        smooth, values = _smooth(self.function, self.marked, given)

        def push(*given: jax.Array) -> Arrays:
            return jax.jvp(smooth, values, given)[1]

        return (jax.vmap(push) if self.many else push)(*along)


def reversible(function: Any) -> Any:
    """The function in a form that the reverse mode goes through, too."""
    if isinstance(function, Tangent | Cotangent):
        return dataclasses.replace(function, function=reversible(function.function))
    form = getattr(function, "reversible", None)
    return function if form is None else form()


@dataclasses.dataclass(frozen=True)
class Cotangent:
    """Cotangents of the marked arguments of `function`, from its arguments and cotangents."""

    function: Callable[..., Arrays]
    marked: tuple[bool, ...]
    many: bool = False

    def __call__(self, *arrays: jax.Array) -> Arrays:
        count = len(self.marked)
        smooth, values = _smooth(reversible(self.function), self.marked, arrays[:count])
        _, back = jax.vjp(smooth, *values)

        def pull(*given: jax.Array) -> Arrays:
            return back(given)

        return (jax.vmap(pull) if self.many else pull)(*arrays[count:])


def tangents_in_columns(
    function: Callable[..., Arrays], arrays: Arrays, tangents: tuple[Any, ...]
) -> Arrays:
    """Tangents of `in_columns(function, *arrays)`, without its value."""
    marked = tuple(not isinstance(t, SymbolicZero) for t in tangents)
    moving = (t for t, mark in zip(tangents, marked) if mark)
    return in_columns(Tangent(function, marked), *arrays, *moving)


def _in_chunks(function: Callable[..., Arrays], *arrays: jax.Array) -> Arrays:
    """On a CPU piece by piece, the last one filled up; on accelerators all at once."""
    size = arrays[0].shape[-1]
    count = -(-size // (WITH_TANGENTS if isinstance(function, Tangent) else CHUNK))
    if count == 1:
        return tuple(function(*arrays))
    width = -(-size // count)

    def pieces(*given: jax.Array) -> Arrays:
        def cut(x: jax.Array) -> jax.Array:
            filled = jnp.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, count * width - size)], mode="edge")
            return jnp.moveaxis(filled.reshape(*x.shape[:-1], count, width), -2, 0)

        def join(x: jax.Array) -> jax.Array:
            joined = jnp.moveaxis(x, 0, -2)
            return joined.reshape(*joined.shape[:-2], count * width)[..., :size]

        mapped = jax.lax.map(lambda piece: tuple(function(*piece)), tuple(map(cut, given)))
        return tuple(map(join, mapped))

    return jax.lax.platform_dependent(
        *arrays, cpu=pieces, default=lambda *given: tuple(function(*given))
    )


@functools.cache
def _compiled(function: Callable[..., Arrays]) -> Callable[..., Arrays]:
    return jax.jit(functools.partial(_in_chunks, function))


@columns_p.def_impl
def _run(*arrays: jax.Array, function: Callable[..., Arrays]) -> Arrays:
    return _compiled(function)(*arrays)


@columns_p.def_abstract_eval
def _shapes(*shapes: Any, function: Callable[..., Arrays]) -> list[Any]:
    """Tracing takes as long as lowering: nothing is traced whose shapes are known without."""
    known = [jax.core.ShapedArray(s.shape, s.dtype) for s in shapes]
    if isinstance(function, Tangent | Cotangent):
        given, along = known[: len(function.marked)], shapes[len(function.marked) :]
        if isinstance(function, Tangent):
            outs = _shapes(*given, function=function.function)
        else:
            outs = [x for x, mark in zip(given, function.marked) if mark]
        many = along[0].shape[:1] if function.many else ()
        return [jax.core.ShapedArray((*many, *x.shape), x.dtype) for x in outs]
    told = getattr(function, "shapes", None) or functools.partial(jax.eval_shape, function)
    return [jax.core.ShapedArray(x.shape, x.dtype) for x in told(*known)]


mlir.register_lowering(columns_p, mlir.lower_fun(_run, multiple_results=True))


def _wider(
    arrays: Any, axes: Any, *, function: Callable[..., Arrays]
) -> tuple[list[jax.Array], list[int]]:
    """The batch of `vmap` becomes part of the last axis."""
    size = next(x.shape[axis] for x, axis in zip(arrays, axes) if axis is not None)
    if isinstance(function, Tangent | Cotangent) and not function.many:
        count = len(function.marked)
        if all(axis is None for axis in axes[:count]):
            # many directions at one point: its steps are found once
            along = [
                jnp.broadcast_to(x, (size, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0)
                for x, axis in zip(arrays[count:], axes[count:])
            ]
            outs = in_columns(dataclasses.replace(function, many=True), *arrays[:count], *along)
            return list(outs), [0] * len(outs)

    def wide(x: jax.Array, axis: int | None) -> jax.Array:
        if axis is None:
            x = jnp.broadcast_to(x[..., None, :], (*x.shape[:-1], size, x.shape[-1]))
        else:
            x = jnp.moveaxis(x, axis, -2)
        return x.reshape(*x.shape[:-2], size * x.shape[-1])

    outs = in_columns(function, *map(wide, arrays, axes))
    apart = [out.reshape(*out.shape[:-1], size, out.shape[-1] // size) for out in outs]
    return [jnp.moveaxis(out, -2, 0) for out in apart], [0] * len(apart)


batching.primitive_batchers[columns_p] = _wider


def _jvp(
    primals: Any, tangents: Any, *, function: Callable[..., Arrays]
) -> tuple[list[Any], list[Any]]:
    outs = columns_p.bind(*primals, function=function)
    marked = tuple(type(t) is not ad.Zero for t in tangents)
    moving = [t for t, mark in zip(tangents, marked) if mark]
    return outs, columns_p.bind(*primals, *moving, function=Tangent(function, marked))


ad.primitive_jvps[columns_p] = _jvp


def _transpose(cotangents: Any, *arrays: Any, function: Callable[..., Arrays]) -> list[Any]:
    linear = tuple(ad.is_undefined_primal(x) for x in arrays)

    def zeros(x: Any) -> jax.Array:
        return jnp.zeros(x.aval.shape, x.aval.dtype)

    filled = [zeros(c) if type(c) is ad.Zero else c for c in cotangents]
    if isinstance(function, Tangent) and linear == (False,) * len(function.marked) + (True,) * sum(
        function.marked
    ):
        # the transpose of a tangent map is the pull back of its function
        given = list(arrays[: len(function.marked)])
        back = Cotangent(function.function, function.marked, function.many)
    else:
        # linear in what is undefined: its derivative at 0 is the map itself
        given = [zeros(x) if undefined else x for x, undefined in zip(arrays, linear)]
        back = Cotangent(function, linear)
    pulled = iter(columns_p.bind(*given, *filled, function=back))
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
    return over_lanes(jnp.sum(count, axis=0, dtype=count.dtype)), False


def any_lane(happens: jax.Array) -> jax.Array:
    """Whether it happens in any lane."""
    return over_lanes(happens.astype(jnp.int32)) > 0
