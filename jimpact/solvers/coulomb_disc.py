"""Coulomb impulses in space, at impulse level: the friction disc |p_t| <= mu p, not a polygon.

The problem of `coulomb`, with two tangents a contact: P_i = -mu_i p_i s_i / |s_i| where contact i
slides, |P_i| <= mu_i p_i where it sticks. Projected Gauss-Seidel sweeps find which contacts take
part, stick or slide; Newton's method on that pattern finishes; both are repeated with finer sweeps
until the outcome satisfies the law. Chord steps then carry derivatives up to the third.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jimpact.solvers.coulomb import Impulses, chord_steps, pseudoinverse
from jimpact.status import CODE

_SWEEPS = 2000  # at each of the tolerances
_COARSEST, _FINER = 1e-4, 1e-3  # change of x in a sweep that ends them, and its steps
_LEVELS = 8  # each tolerance twice, with either room; float32: the later ones end at its rounding
# What counts as no impulse and as no slip, in parts of that tolerance. The slow room is for
# contacts that reach their cone while others hold them: sweeps bring those to rest slowly.
_ROOM, _SLOW_ROOM = 10.0, 100.0
_STEPS = 8  # of Newton's method on a pattern
_POWER = 2 / 3  # what a solve may gather in rounding, as in `lcp`: m eps^(2/3)


class DiscProblem(NamedTuple):
    """A (3 m, 3 m) over x = (p (m,), p_t (2 m,) contact-major); a (m,), b (2 m,), mu (m,)."""

    matrix: jax.Array
    normal: jax.Array
    tangential: jax.Array
    friction: jax.Array
    complementary: bool  # 0 <= r _|_ p >= 0, else r = 0

    @property
    def contacts(self) -> int:
        """Number m of contacts."""
        return self.normal.shape[0]

    @property
    def given(self) -> jax.Array:
        """(a, b)."""
        return jnp.concatenate([self.normal, self.tangential])


class _State(NamedTuple):
    x: jax.Array
    taking: jax.Array
    sticks: jax.Array
    done: jax.Array
    level: jax.Array


def solve_disc(problem: DiscProblem) -> Impulses:
    """p (m,), p_t (2 m,) of the law; code `max_steps` where no solution was found.

    `impulse_not_unique` where sticking contacts share what they do.
    """
    m = problem.contacts
    still = DiscProblem(*jax.lax.stop_gradient(problem[:-1]), problem.complementary)
    end = _search(still)
    fixed = jax.lax.stop_gradient(end.x)
    inverse, singular = pseudoinverse(jax.jacfwd(lambda x: _equations(still, end, x))(fixed))
    x = chord_steps(lambda x: _equations(problem, end, x), inverse, fixed)
    x = jnp.where(end.done, x, end.x)
    solved = _misfit(still, jax.lax.stop_gradient(x)) <= m * float(jnp.finfo(x.dtype).eps) ** _POWER
    code = jnp.where(singular, CODE["impulse_not_unique"], CODE["ok"])
    return Impulses(x[:m], x[m:], jnp.where(solved, code, CODE["max_steps"]))


def _size(problem: DiscProblem, x: jax.Array) -> jax.Array:
    given = jnp.abs(problem.given).max()
    return jnp.where(given > 0, given, 1.0) + jnp.abs(x).max()


def _lengths(pairs: jax.Array) -> jax.Array:
    """Of the vectors (m, 2) in an array (2 m,)."""
    return jnp.sqrt(jnp.sum(pairs.reshape(-1, 2) ** 2, axis=1))


def _in_disc(side: jax.Array, radius: jax.Array) -> jax.Array:
    """The point of the disc next to `side` (..., 2)."""
    length = jnp.sqrt(jnp.sum(side**2, axis=-1))
    shrink = jnp.where(length > radius, radius / jnp.where(length > 0, length, 1.0), 1.0)
    return side * shrink[..., None]


def _search(problem: DiscProblem) -> _State:
    m, eps = problem.contacts, float(jnp.finfo(problem.matrix.dtype).eps)
    enough = m * eps**_POWER

    def refine(state: _State) -> _State:
        level = (state.level // 2).astype(problem.matrix.dtype)
        tolerance = jnp.maximum(_COARSEST * _FINER**level, 4 * eps)
        x = _sweeps(problem, state.x, tolerance)
        rate = problem.given + problem.matrix @ x
        size = _size(problem, x)
        pushes = x[:m] > _ROOM * tolerance * size
        taking = pushes if problem.complementary else jnp.ones(m, bool)
        slip = _lengths(rate[m:])
        room = jnp.where(state.level % 2 == 0, _ROOM, _SLOW_ROOM)
        sticks = pushes & (slip <= room.astype(x.dtype) * tolerance * size)
        found = _State(x, taking, sticks, jnp.asarray(False), state.level + 1)
        better = _polish(problem, found, enough)
        good = _misfit(problem, better) <= enough
        # the equations of sliding also hold at rest: such a contact sticks
        rest = _lengths((problem.given + problem.matrix @ better)[m:])
        found = found._replace(sticks=sticks | (good & pushes & (rest <= enough * size)))
        # or x itself, on the edge of its pattern
        off = jnp.abs(_equations(problem, found, x)).max() / size
        as_swept = jnp.maximum(_misfit(problem, x), off) <= enough
        return found._replace(x=jnp.where(good, better, x), done=good | as_swept)

    none = jnp.zeros(m, bool)
    start = _State(jnp.zeros_like(problem.given), none, none, jnp.asarray(False), jnp.asarray(0))
    return jax.lax.while_loop(lambda s: ~s.done & (s.level < _LEVELS), refine, start)


def _sweeps(problem: DiscProblem, x: jax.Array, tolerance: jax.Array) -> jax.Array:
    """Projected Gauss-Seidel, contact by contact, until x changes by less than the tolerance."""
    m, matrix, given = problem.contacts, problem.matrix, problem.given
    first = m + 2 * jnp.arange(m)
    xx, yy, xy = matrix[first, first], matrix[first + 1, first + 1], matrix[first, first + 1]
    stiffest = 0.5 * (xx + yy) + jnp.sqrt(0.25 * (xx - yy) ** 2 + xy**2)
    stiffest = jnp.where(stiffest > 0, stiffest, 1.0)

    def contact(i: jax.Array, x: jax.Array) -> jax.Array:
        p = x[i] - (given[i] + matrix[i] @ x) / matrix[i, i]
        x = x.at[i].set(jnp.maximum(p, 0.0) if problem.complementary else p)
        at = (m + 2 * i, jnp.zeros_like(i))
        rows = jax.lax.dynamic_slice(matrix, at, (2, 3 * m))
        rate = jax.lax.dynamic_slice(given, at[:1], (2,)) + rows @ x
        side = jax.lax.dynamic_slice(x, at[:1], (2,)) - rate / stiffest[i]
        side = _in_disc(side, problem.friction[i] * jnp.maximum(x[i], 0.0))
        return jax.lax.dynamic_update_slice(x, side, at[:1])

    def going(state: tuple[jax.Array, jax.Array, jax.Array]) -> jax.Array:
        x, change, count = state
        return (change > tolerance * _size(problem, x)) & (count < _SWEEPS)

    def sweep(
        state: tuple[jax.Array, jax.Array, jax.Array],
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        x, _, count = state
        new = jax.lax.fori_loop(0, m, contact, x)
        return new, jnp.abs(new - x).max(), count + 1

    start = (x, jnp.full((), jnp.inf, x.dtype), jnp.asarray(0))
    return jax.lax.while_loop(going, sweep, start)[0]


def _polish(problem: DiscProblem, pattern: _State, enough: float) -> jax.Array:
    """Newton's method on a pattern, until the law is satisfied or the steps are used up."""

    def going(state: tuple[jax.Array, jax.Array]) -> jax.Array:
        x, count = state
        return (_misfit(problem, x) > enough) & (count < _STEPS)

    def step(state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        return _newton(problem, pattern, state[0]), state[1] + 1

    # one more step than needed brings x from within the tolerance to rounding
    x, _ = jax.lax.while_loop(going, step, (pattern.x, jnp.asarray(0)))
    return _newton(problem, pattern, x)


def _newton(problem: DiscProblem, pattern: _State, x: jax.Array) -> jax.Array:
    """One step (of least norm) on the equations of a pattern."""
    inverse, _ = pseudoinverse(jax.jacfwd(lambda x: _equations(problem, pattern, x))(x))
    return x - inverse @ _equations(problem, pattern, x)


def _equations(problem: DiscProblem, pattern: _State, x: jax.Array) -> jax.Array:
    """r or p; s where a contact sticks, P |s| + mu p s (in parts of |s| + mu p) where it slides."""
    m = problem.contacts
    rate = problem.given + problem.matrix @ x
    side, slip = x[m:].reshape(m, 2), rate[m:].reshape(m, 2)
    square = jnp.sum(slip**2, axis=1)
    moves = ~pattern.sticks & (square > 0)
    length = jnp.sqrt(jnp.where(moves, square, 1.0))
    bound = jnp.where(moves, problem.friction * jnp.maximum(x[:m], 0.0), 0.0)
    scale = jax.lax.stop_gradient(length + bound)
    slides = (side * length[:, None] + slip * bound[:, None]) / scale[:, None]
    normal = jnp.where(pattern.taking, rate[:m], x[:m])
    tangential = jnp.where(pattern.sticks[:, None], slip, slides)
    return jnp.concatenate([normal, tangential.reshape(-1)])


def _misfit(problem: DiscProblem, x: jax.Array) -> jax.Array:
    """How far x is from what the law makes of it, in parts of its size."""
    m = problem.contacts
    rate = problem.given + problem.matrix @ x
    p, side, slip = x[:m], x[m:].reshape(m, 2), rate[m:].reshape(m, 2)
    normal = p - jnp.maximum(p - rate[:m], 0.0) if problem.complementary else rate[:m]
    bound = problem.friction * jnp.maximum(p, 0.0)
    tangential = side - _in_disc(side - slip, bound)
    return jnp.maximum(jnp.abs(normal).max(), jnp.abs(tangential).max()) / _size(problem, x)
