"""Impulses in the friction cones of contacts in space, by interior points.

With p = g a_0, p_t = h a_t and h / g = mu the cone |p_t| <= mu p is |a_t| <= a_0. With the rates
scaled alike, b = (g r + |h s|, h s), contact with friction, `0 <= r _|_ p >= 0` and
`p_t in -mu p Sgn(s)`, is

    a and b in this cone,    a o b = (a . b, a_0 b_t + b_0 a_t) = 0.

Were |h s| known, this would be a convex problem. Mehrotra's predictor and corrector solve it in a
few iterations, however redundant the contacts and wherever slip turns to. |h s| is that of the
iteration before as long as contacts might still stick, and changes with b where they slide.

Source: Acary, Cadoux, Lemarechal and Malick, ZAMM 91 (2011) 155-175, for the convex problem.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jimpact.compiling import full_precision
from jimpact.loops import while_loop

# Iterations of an attempt; 10 to 30 are usual. Ten times more: what diverges takes longer.
MOST = 60
# Of the two attempts: a contact counts as sliding whose |h s|^2 is above this multiple of a . b.
# Ten times more: slower where contacts slide; ten times less: contacts that nearly stick turn
# their slip in each iteration, and 2 % of nearly flat boxes have no solution at the first attempt.
_SLIDES = np.array([100.0, 1.0])
# Part of the tolerance at which an attempt ends early: modes are read off what is left. Ten times
# more: contacts that nearly stick count as sliding.
_FINISHED = 1e-2
# Of the way to the boundary of the cones, what an iteration goes at most. Closer to 1: those that
# follow have no room.
_WITHIN = 0.99
# Part of a . b at least that an iteration aims at. Ten times more: slower; ten times less: the
# last digits are those of rounding.
_LEAST_AIM = 1e-6


class _Cones(NamedTuple):
    """b = `constant + coupling a`, up to |h s|, and x = `scale` a."""

    coupling: jax.Array  # (3 m, 3 m)
    constant: jax.Array  # (m, 3)
    scale: jax.Array  # (m, 3)


class _Iterate(NamedTuple):
    """An iteration."""

    impulse: jax.Array  # a (m, 3)
    rate: jax.Array  # b (m, 3)
    best: jax.Array  # x (m, 3) of the least misfit so far
    misfit: jax.Array  # its misfit ()
    tries: jax.Array


@full_precision
def within_cones(
    matrix: jax.Array,
    rate: jax.Array,
    friction: jax.Array,
    misfit: Callable[[jax.Array], jax.Array],
    tolerance: float,
) -> jax.Array:
    """Impulses x = (p, p_t) (m, 3) with `(r, s) = rate + matrix x`.

    Args:
        matrix: (m, 3, m, 3), with a diagonal of order 1.
        rate: (m, 3) of order 1.
        friction: mu (m,).
        misfit: how far x (m, 3) is from the law ().
        tolerance: of the misfit.

    Returns:
        The x of the least misfit.

    >>> import jax.numpy as jnp
    >>> from jimpact.solvers.interior_points import within_cones
    >>> matrix, rate, mu = jnp.eye(3).reshape(1, 3, 1, 3), jnp.array([[-1.0, 3.0, 4.0]]), 0.5
    >>> wrong = lambda x: jnp.abs(x[0] - jnp.array([1.0, -0.3, -0.4])).max()
    >>> x = within_cones(matrix, rate, jnp.array([mu]), wrong, 1e-6)
    >>> [round(float(p), 5) for p in x[0]]
    [1.0, -0.3, -0.4]
    """
    cones = _cones(matrix, rate, friction)
    wide = jnp.zeros_like(rate).at[:, 0].set(1.0) + 0 * rate  # NaN where a rate is not finite

    def going(at: _Iterate) -> jax.Array:
        """Whether the misfit is too large and iterations are left."""
        last = jnp.where(at.misfit <= tolerance, MOST, len(_SLIDES) * MOST)
        return ~(at.misfit <= _FINISHED * tolerance) & (at.tries < last)

    def iterate(at: _Iterate) -> _Iterate:
        """One iteration, from the middle of the cones at the beginning of an attempt."""
        begins = at.tries % MOST == 0
        slides = jnp.asarray(_SLIDES, rate.dtype)[at.tries // MOST]
        a, b = (jnp.where(begins, wide, x) for x in (at.impulse, at.rate))
        a, b = _corrected(cones, a, b, slides)
        x = a * cones.scale
        wrong = misfit(x)
        better = wrong < at.misfit
        best, least = jnp.where(better, x, at.best), jnp.where(better, wrong, at.misfit)
        return _Iterate(a, b, best, least, at.tries + 1)

    start = _Iterate(wide, wide, wide, jnp.asarray(jnp.inf, rate.dtype), jnp.asarray(0))
    return while_loop(going, iterate, start).best


def _cones(matrix: jax.Array, rate: jax.Array, friction: jax.Array) -> _Cones:
    """The scaled problem."""
    m = len(friction)
    large = jnp.maximum(friction, 1.0)
    scale = jnp.stack([1 / large, friction / large, friction / large], axis=1)
    coupling = matrix * scale[:, :, None, None] * scale[None, None]
    # where nothing happens p = 0 = r, to which iterations converge slowly: let such contacts part
    others = jnp.where(jnp.eye(m, dtype=bool)[:, None, :, None], 0.0, matrix)
    alone = jnp.all(others == 0, axis=(1, 2, 3)) & jnp.all(rate == 0, axis=1)
    constant = rate.at[:, 0].add(alone.astype(rate.dtype)) * scale
    return _Cones(coupling.reshape(3 * m, 3 * m), constant, scale)


def _corrected(
    cones: _Cones, a: jax.Array, b: jax.Array, slides: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The next a and b (m, 3): a predictor shows how small a o b may become at once.

    Contacts slide whose |h s|^2 is above `slides` times a . b.
    """
    m = len(a)
    unit = jnp.zeros_like(a).at[:, 0].set(1.0)
    slip = jnp.sqrt(jnp.sum(b[:, 1:] ** 2, axis=1))
    gap = jnp.sum(a * b) / m
    weight = slip / (slip**2 + slides * gap)
    change_of_slip = b.at[:, 0].set(0.0) * weight[:, None]

    def with_slip(rows: jax.Array) -> jax.Array:
        """Changes (m, 3, k) of the rates, and what they change of |h s|."""
        return rows.at[:, 0].add(jnp.einsum("ia,iak->ik", change_of_slip, rows))

    missed = (cones.coupling @ a.reshape(-1)).reshape(m, 3) + cones.constant - b
    missed = with_slip(missed.at[:, 0].add(slip)[..., None])[..., 0]
    moved = with_slip(cones.coupling.reshape(m, 3, 3 * m))
    of_b = _matrices(a)
    own = jnp.eye(m, dtype=a.dtype)[:, None, :, None] * _matrices(b)[:, :, None]
    whole = jnp.einsum("iab,ibk->iak", of_b, moved) + own.reshape(m, 3, 3 * m)
    right = -_product(a, b) - jnp.einsum("iab,ib->ia", of_b, missed)
    both = jnp.stack([right.reshape(-1), unit.reshape(-1)], axis=1)
    moves = jnp.linalg.solve(whole.reshape(3 * m, 3 * m), both)

    def ahead(aim: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The next a and b, if a o b shall be `aim` (), as far as the cones allow."""
        change = moves[:, 0] + aim * moves[:, 1]
        da, db = change.reshape(m, 3), moved @ change + missed
        part = jnp.minimum(1.0, _WITHIN * jnp.minimum(_room(a, da), _room(b, db)))
        return a + part * da, b + part * db

    predicted = jnp.sum(jnp.multiply(*ahead(jnp.zeros_like(gap)))) / m
    share = jnp.maximum(jnp.minimum(predicted / gap, 1.0) ** 2, _LEAST_AIM)
    return ahead(share * gap)


def _product(a: jax.Array, b: jax.Array) -> jax.Array:
    """a o b (m, 3)."""
    first = jnp.sum(a * b, axis=1, keepdims=True)
    return jnp.concatenate([first, a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:]], axis=1)


def _matrices(a: jax.Array) -> jax.Array:
    """(m, 3, 3): what multiplies b in a o b."""
    eye = jnp.eye(3, dtype=a.dtype)[None]
    side = a.at[:, 0].set(0.0)
    arrow = side[:, :, None] * eye[:, :1] + eye[:, 0, :, None] * side[:, None]
    return a[:, :1, None] * eye + arrow


def _room(a: jax.Array, change: jax.Array) -> jax.Array:
    """How many times the change () can be added before one of a (m, 3) leaves the cone.

    With a turned into the middle of the cone, by a hyperbolic rotation.
    """
    square = a[:, 0] ** 2 - jnp.sum(a[:, 1:] ** 2, axis=1)
    root = jnp.sqrt(jnp.maximum(square, jnp.finfo(a.dtype).tiny))
    a = a / root[:, None]
    first = a[:, 0] * change[:, 0] - jnp.sum(a[:, 1:] * change[:, 1:], axis=1)
    turn = (first + change[:, 0]) / (1 + a[:, 0])
    side = change[:, 1:] - turn[:, None] * a[:, 1:]
    out = jnp.max((jnp.sqrt(jnp.sum(side**2, axis=1)) - first) / root)
    return jnp.where(out > 0, 1 / jnp.where(out > 0, out, 1.0), jnp.inf)
