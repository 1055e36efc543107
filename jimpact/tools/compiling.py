"""Compiling: `jax.jit` in full precision, and with options that shorten compiling.

Programs that compile in half of the time run a few percent slower.
"""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import numpy as np

from jimpact.tools.kept_programs import keeper

# XLA's newer emitters of fused loops on CPUs make code that runs 4 % faster in large
# batches, and take twice as long to compile a program of many small loops.
QUICK = {"xla_cpu_use_fusion_emitters": False}

Function = TypeVar("Function", bound=Callable[..., Any])


def full_precision(function: Function) -> Function:
    """`function`, whose products of matrices have the precision of their numbers.

    By default JAX lets accelerators multiply float32 matrices with 10 bits (TF32,
    bfloat16): laws are wrong by 5e-4 then, and error estimates never reach a tolerance.
    A product gets its precision where it is traced, so this decorates whatever JAX may
    trace by itself: public functions and methods, compiled programs, rules of
    derivatives.
    """

    @functools.wraps(function)
    def precise(*args: Any, **keywords: Any) -> Any:
        """The function, traced or run where products have the highest precision."""
        with jax.default_matmul_precision("highest"):
            return function(*args, **keywords)

    return precise  # type: ignore[return-value]


@functools.cache
def known_options() -> dict[str, Any]:
    """The options of `QUICK`, none where this compiler does not know them."""
    try:
        jax.jit(lambda x: x, compiler_options=QUICK)(np.float32(0))
    except Exception:
        return {}
    return QUICK


@functools.cache
def _probe() -> Callable[..., Any]:
    """A program that does nothing, with compiler options: JAX refuses them inside
    another one.
    """
    return jax.jit(lambda *x: x, compiler_options=known_options())


def is_top_level_call(*args: Any) -> bool:
    """True where a program called with these arguments now is compiled and run by
    itself.

    It is not where it becomes part of another program: under jit, in loops, in reverse
    mode. Forward mode and vmap run it at once. JAX has no public question for it, but
    it refuses compiler options (ValueError) of a program that becomes part of another
    one: a probe that does nothing is called with those of the arguments that are
    traced.
    """
    traced = [x for x in jax.tree.leaves(args) if isinstance(x, jax.core.Tracer)]
    try:
        _probe()(*traced)
    except ValueError:
        return False
    return True


def precise_jit(function: Function) -> Function:
    """`eqx.filter_jit(function)` in full precision; kept programs are loaded
    (`kept_programs`).
    """
    return _compiled(function, dict, _Results.of, _Results.joined)


def quick_jit(function: Function) -> Function:
    """`precise_jit(function)`, compiled quickly where called at top level."""
    return _compiled(function, known_options, _same, _same)


def _compiled(
    function: Function,
    options: Callable[[], dict[str, Any]],
    packed: Callable[[Any], Any],
    unpacked: Callable[[Any], Any],
) -> Function:
    """The function as a program, by itself where called at top level.

    Args:
        function: to be compiled.
        options: of the compiler, where called at top level.
        packed: the results of the function as those of a program, all leaves of which
            are arrays.
        unpacked: the inverse.
    """
    inside = eqx.filter_jit(function)

    @functools.cache
    def program(name: str = function.__name__) -> Any:
        """The function of (structure, other leaves), arrays, to be compiled under a
        name.
        """

        def of_arrays(rest: Any, arrays: list[Any]) -> Any:
            """`function` of flattened arguments: `rest` is (structure, other
            leaves).
            """
            tree, fixed = rest
            values = iter(arrays)
            leaves = [next(values) if x is None else x[0] for x in fixed]
            args, keywords = jax.tree.unflatten(tree, leaves)
            return packed(function(*args, **keywords))

        of_arrays.__name__ = name
        return jax.jit(of_arrays, static_argnums=0, compiler_options=options())

    @full_precision
    @functools.wraps(function)
    def call(*args: Any, **keywords: Any) -> Any:
        """`function`, compiled by itself or as part of the program that calls it.

        Part of another program, or one that is neither kept nor has options, it is that
        of `eqx.filter_jit`; else it is loaded from the folder of kept programs, or,
        where none are kept, the one that `program` compiles.
        """
        usual = keeper() is None and options is dict  # `dict()`: no options
        if usual or not is_top_level_call(args, keywords):
            return inside(*args, **keywords)
        leaves, tree = jax.tree.flatten((args, keywords))
        # of each leaf that is no array a tuple (x,), as None stands for an array
        fixed = tree, tuple(None if eqx.is_array(x) else (x,) for x in leaves)
        arrays = [x for x in leaves if eqx.is_array(x)]
        kept = _kept(function, program, fixed, arrays)
        if kept is None:
            results = program()(fixed, arrays)
        else:
            results = kept(arrays)
        return unpacked(results)

    return call  # type: ignore[return-value]


class _Results(eqx.Module):
    """The results of a program: arrays, and what is no array as part of the
    structure.
    """

    arrays: Any
    others: Any = eqx.field(static=True)

    @classmethod
    def of(cls, results: Any) -> "_Results":
        """The results in two parts."""
        return cls(*eqx.partition(results, eqx.is_array))

    def joined(self) -> Any:
        """The results as they were."""
        return eqx.combine(self.arrays, self.others)


def _same(results: Any) -> Any:
    """The results, all of which become arrays."""
    return results


def _kept(
    function: Callable[..., Any],
    program: Callable[[str], Any],
    fixed: Any,
    arrays: list[Any],
) -> Callable[[list[Any]], Any] | None:
    """The program of a folder for these arguments; None where programs are not kept."""
    folder = keeper()
    if folder is None or any(isinstance(x, jax.core.Tracer) for x in arrays):
        return None

    def compiled(suffix: str) -> Callable[[list[Any]], Any]:
        """The program, compiled under the name of the function and a suffix."""
        lowered = program(function.__name__ + suffix).lower(fixed, arrays)
        return lowered.compile()

    return folder.program(function, compiled, fixed, arrays)
