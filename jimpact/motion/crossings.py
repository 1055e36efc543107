"""When does a watched quantity cross zero from above? Found on cubics, landed on by real steps."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

_CELLS = 16  # of a step, in which a cubic is looked at for signs
_POLISH = 3  # Newton steps on the cubic, from the chord of the cell


class Crossing(NamedTuple):
    """The first crossing in a step: whether there is one, of which quantity, when, or too short."""

    found: jax.Array  # ()
    which: jax.Array  # (k,) one-hot
    time: jax.Array  # () after the beginning of the step
    unseen: jax.Array  # () something rose and fell between the looks: a shorter step is needed


def cubic(s: jax.Array, h: jax.Array, ends: tuple[jax.Array, ...]) -> jax.Array:
    """The cubic with values g0, g1 and slopes d0, d1 at s = 0, 1 (time s h)."""
    g0, d0, g1, d1 = ends
    a, b = h * d0 - (g1 - g0), -h * d1 + (g1 - g0)
    return (1 - s) * g0 + s * g1 + s * (1 - s) * ((1 - s) * a + s * b)


def first_crossing(
    h: jax.Array,
    before: tuple[jax.Array, jax.Array],
    after: tuple[jax.Array, jax.Array],
    rounding: jax.Array,
) -> Crossing:
    """First crossing below `-rounding` in a step of length h.

    Args:
        h: length of the step.
        before: values (k,) and rates (k,) at its beginning.
        after: the same at its end.
        rounding: (k,) values between `-rounding` and `rounding` are zero.

    What begins at zero (a contact just left) is no crossing until it has been above zero.
    """
    ends = tuple(x[None, :] for x in (*before, *after))
    s = jnp.linspace(0.0, 1.0, _CELLS + 1, dtype=h.dtype)[:, None]
    values = cubic(s, h, ends)
    above = jax.lax.cummax((values > rounding[None, :]).astype(jnp.int32), axis=0) > 0
    below = values < -rounding[None, :]
    earlier_above = jnp.concatenate([jnp.zeros_like(above[:1]), above[:-1]])
    crossed = below & earlier_above
    never = jnp.any(below, axis=0) & ~jnp.any(crossed, axis=0)
    at_once = never & (before[1] <= 0)
    cell = jnp.argmax(crossed, axis=0)
    index = jnp.arange(values.shape[1])
    left, right = values[cell - 1, index], values[cell, index]
    share = jnp.clip(left / jnp.where(left > right, left - right, 1.0), 0.0, 1.0)
    low, high = ((cell + i).astype(h.dtype) / _CELLS for i in (-1, 0))
    at = low + share / _CELLS
    found = jnp.any(crossed, axis=0) | at_once
    flat = tuple(x[0] for x in ends)
    for _ in range(_POLISH):
        value, slope = jax.jvp(lambda x: cubic(x, h, flat), (at,), (jnp.ones_like(at),))
        falls = slope < 0  # before the top of a short hop Newton has no direction
        newton = at - value / jnp.where(falls, slope, -1.0)
        at = jnp.clip(jnp.where(falls, newton, 0.5 * (at + high)), low, high)
    at = jnp.where(at_once, 0.0, at)
    when = jnp.where(found, at * h, jnp.inf)
    which = (index == jnp.argmin(when)) & jnp.any(found)
    return Crossing(jnp.any(found), which, jnp.min(when), jnp.any(never & ~at_once))
