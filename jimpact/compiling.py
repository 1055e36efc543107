"""How the library compiles the programs that it owns: soon done, a few percent slower."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import numpy as np

from jimpact._checks import is_traced

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


def staged() -> bool:
    """Whether a program of somebody else's is being traced: it is compiled with their options."""
    return isinstance(jax.lax.add(np.float32(0), np.float32(0)), jax.core.Tracer)


def quick_jit(function: Function) -> Function:
    """`eqx.filter_jit(function)`, compiled quickly where it is a program of its own.

    JAX refuses options of a function that is traced: under jit, and where it is differentiated.
    """
    inside = eqx.filter_jit(function)

    @functools.cache
    def own() -> Callable[..., Any]:
        jit: Any = eqx.filter_jit  # its types do not name what it hands on to jax.jit
        return jit(function, compiler_options=known_options())

    @functools.wraps(function)
    def call(*args: Any, **given: Any) -> Any:
        free = not is_traced((args, given)) and not staged()
        return (own() if free else inside)(*args, **given)

    return call  # type: ignore[return-value]
