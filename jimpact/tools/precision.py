"""Sizes below which a number counts as 0 in each floating-point type.

A velocity, a cosine or an eigenvalue that should be 0 rarely is. Here are the five
answers of the library to how large it may be, relative to the numbers that it was
computed from. Ten times more of any of them takes small effects for none, in float32
some that can be measured (1e-5); ten times less takes rounding for an impact, a
coupling, or an independent contact.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp


class Precision(NamedTuple):
    """Sizes that count as 0, relative to the numbers that they were computed from.

    `rounding`: one sum of products. `noise`: several of them, one after the other; an
    error estimate below it says nothing. `accumulated`: many of them, over a long sum
    or many steps.
    `singular`: an eigenvalue of a matrix with a unit diagonal, for each of its rows.
    `root`: the residual of a solve, or a number whose square is rounded. `eps` and
    `tiny` are NumPy's.
    """

    eps: float
    tiny: float
    rounding: float
    noise: float
    accumulated: float
    singular: float
    root: float


def without_rounding(values: jax.Array, noise: jax.Array) -> jax.Array:
    """The values, 0 where they are within `noise`; derivatives remain those of the
    values.
    """
    within = jnp.abs(values) <= noise
    return values - jax.lax.stop_gradient(jnp.where(within, values, 0.0))


@functools.cache
def precision(dtype: Any) -> Precision:
    """Sizes that count as 0 in a floating-point type: multiples of its eps, see
    `Precision`.

    >>> import numpy as np
    >>> from jimpact.tools.precision import precision
    >>> f"{precision(np.float64).noise:.1e} {precision(np.float32).root:.1e}"
    '3.6e-15 3.5e-04'
    """
    info = jnp.finfo(dtype)
    eps = float(info.eps)
    tiny = float(info.tiny)
    return Precision(eps, tiny, 4 * eps, 16 * eps, 64 * eps, 100 * eps, eps**0.5)


def check_rtol(rtol: float, dtype: jnp.dtype) -> None:
    """Raise a ValueError for a relative tolerance below the `noise` of this
    floating-point type.
    """
    finest = precision(dtype).noise
    if rtol < finest:
        raise ValueError(
            f"Argument `rtol` must be at least {finest:.2g} in {dtype}, "
            f"but has value {rtol:g}: enable jax_enable_x64 for finer tolerances."
        )
