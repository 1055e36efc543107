"""How the library compiles the programs that it owns: soon done, a few percent slower."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import numpy as np

# XLA's newer emitters of fused loops on CPUs make code that runs 4 % faster in large batches, and
# take twice as long to compile a program of many small loops.
QUICK = {"xla_cpu_use_fusion_emitters": False}

Function = TypeVar("Function", bound=Callable[..., Any])


@functools.cache
def known_options() -> dict[str, Any]:
    """The options of `QUICK`, none where this compiler does not know them."""
    try:
        jax.jit(lambda x: x, compiler_options=QUICK)(np.float32(0))
    except Exception:
        return {}
    return QUICK


@functools.cache
def _asks() -> Callable[..., Any]:
    return jax.jit(lambda *x: x, compiler_options=known_options())


def is_own(args: Any) -> bool:
    """Whether what is called with these is a program of its own, now: JAX itself is asked.

    JAX refuses options of a program that becomes part of another one: under jit, in loops, and in
    reverse mode. Forward mode and vmap run it at once.
    """
    traced = [x for x in jax.tree.leaves(args) if isinstance(x, jax.core.Tracer)]
    try:
        _asks()(*traced)
    except ValueError:
        return False
    return True


def quick_jit(function: Function) -> Function:
    """`eqx.filter_jit(function)`, compiled quickly where it is a program of its own."""
    inside = eqx.filter_jit(function)

    @functools.cache
    def own() -> Callable[..., Any]:
        def of_arrays(rest: Any, arrays: list[Any]) -> Any:
            tree, fixed = rest
            values = iter(arrays)
            leaves = [next(values) if x is None else x[0] for x in fixed]
            args, given = jax.tree.unflatten(tree, leaves)
            return function(*args, **given)

        of_arrays.__name__ = function.__name__
        return jax.jit(of_arrays, static_argnums=0, compiler_options=known_options())

    @functools.wraps(function)
    def call(*args: Any, **given: Any) -> Any:
        if not is_own((args, given)):
            return inside(*args, **given)
        leaves, tree = jax.tree.flatten((args, given))
        fixed = tuple(None if eqx.is_array(x) else (x,) for x in leaves)
        return own()((tree, fixed), [x for x in leaves if eqx.is_array(x)])

    return call  # type: ignore[return-value]
