"""How the library compiles the programs that it owns: soon done, a few percent slower."""

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import equinox as eqx
import jax
import numpy as np

if TYPE_CHECKING:
    from jimpact.cli.kept import KeptPrograms

# XLA's newer emitters of fused loops on CPUs make code that runs 4 % faster in large batches, and
# take twice as long to compile a program of many small loops.
QUICK = {"xla_cpu_use_fusion_emitters": False}

Function = TypeVar("Function", bound=Callable[..., Any])

_kept: "ContextVar[KeptPrograms | None]" = ContextVar("kept", default=None)


@contextmanager
def kept_in(folder: str | Path | None) -> Iterator[None]:
    """Within, programs of their own are kept in this folder, and taken from it; None: nowhere."""
    from jimpact.cli.kept import KeptPrograms  # which none but the command line needs

    before = _kept.set(None if folder is None else KeptPrograms(Path(folder)))
    try:
        yield
    finally:
        _kept.reset(before)


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
    def own(whole: bool = False) -> Callable[..., Any]:
        def of_arrays(rest: Any, arrays: list[Any]) -> Any:
            tree, fixed = rest
            values = iter(arrays)
            leaves = [next(values) if x is None else x[0] for x in fixed]
            args, given = jax.tree.unflatten(tree, leaves)
            return function(*args, **given)

        # JAX's cache goes by names, too, and must not hand out what is kept whole.
        of_arrays.__name__ = f"whole_{function.__name__}" if whole else function.__name__
        return jax.jit(of_arrays, static_argnums=0, compiler_options=known_options())

    @functools.wraps(function)
    def call(*args: Any, **given: Any) -> Any:
        if not is_own((args, given)):
            return inside(*args, **given)
        leaves, tree = jax.tree.flatten((args, given))
        fixed = tree, tuple(None if eqx.is_array(x) else (x,) for x in leaves)
        arrays = [x for x in leaves if eqx.is_array(x)]
        kept = _kept.get()
        if kept is None or any(isinstance(x, jax.core.Tracer) for x in arrays):
            return own()(fixed, arrays)
        return kept.run(own(whole=True), call, fixed, arrays)

    return call  # type: ignore[return-value]
