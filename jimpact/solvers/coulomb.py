"""Planar Coulomb impulses at impulse level: which contacts stick, which slide, and p of both.

With D = [N, H_t] scaled to unit normals, A = D^T M^-1 D and x = (p, p_t) the problem is

    normal      r = a + A_nn p + A_nt p_t:  r = 0, or  0 <= r _|_ p >= 0
    tangential  s = b + A_tn p + A_tt p_t,  p_t,i in -mu_i max(p_i, 0) Sgn(s_i)

Which contacts take part, stick or slide, and x itself, are found with derivatives switched off;
chord steps on the equations of that pattern then carry derivatives up to the third. A_tt may be
singular (both corners of a block lying flat slide alike): of all p_t that of least norm is given,
where friction allows it; derivatives hold the null space.
"""

import itertools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jimpact.solvers.lcp import solve_lcp
from jimpact.status import CODE

ENUMERATED = 3  # up to so many contacts all 4^m patterns are looked at
_TOGETHER, _SINGLY = 4, 20  # beyond, changes of a pattern per contact: all at once, then singly
_PULLS = 2.0  # in the place of a slip: a contact that pulls, without friction
_POWER = 2 / 3  # what a solve may gather in rounding, as in `lcp`: m eps^(2/3)
_SINGULAR = 100.0  # singular values below this times eps m, of the largest, are zero


class Problem(NamedTuple):
    """A (2 m, 2 m), a (m,), b (m,), mu (m,)."""

    matrix: jax.Array
    normal: jax.Array
    tangential: jax.Array
    friction: jax.Array

    @property
    def contacts(self) -> int:
        """Number m of contacts."""
        return self.normal.shape[0]

    @property
    def size(self) -> jax.Array:
        """The largest given velocity, 1 where there is none."""
        given = jnp.abs(jnp.concatenate([self.normal, self.tangential])).max()
        return jnp.where(given > 0, given, 1.0)


class Pattern(NamedTuple):
    """`taking` (m,): contacts with r = 0, not p = 0; `slip` (m,): xi in {0, 1, -1} or `_PULLS`."""

    taking: jax.Array
    slip: jax.Array


class Impulses(NamedTuple):
    """p (m,), p_t (m,) and the status code ()."""

    normal: jax.Array
    tangential: jax.Array
    code: jax.Array


class _Solved(NamedTuple):
    """x of least norm for a pattern, the pseudoinverse of its equations, whether it is singular."""

    x: jax.Array
    inverse: jax.Array
    singular: jax.Array


def solve_prescribed(problem: Problem) -> Impulses:
    """Impulses with r = 0 at every contact: the normal velocities are prescribed.

    p may be negative there (the caller flags it); such a contact has no friction. Code:
    `infeasible` where no pattern of sticking and sliding is consistent, `several_outcomes` where
    several are and their velocities differ (that which sticks most is given),
    `impulse_not_unique` where only the impulses do. Above 3 contacts not all patterns are looked
    at: `max_steps` where none was found, and no `several_outcomes`.
    """
    choose = _enumerate if problem.contacts <= ENUMERATED else _search
    pattern, solved, code = choose(jax.lax.stop_gradient(problem))
    return _finish(problem, pattern, solved, code)


def solve_complementary(problem: Problem) -> Impulses:
    """Impulses with `0 <= r _|_ p >= 0`, by Lemke's method on 4 m unknowns.

    Code: `infeasible` where it ends on a ray. That needs impulses which move nothing, N p + H p_t
    = 0 (jamming): otherwise there is a solution for every mu.
    """
    fixed = jax.lax.stop_gradient(problem)
    vertex, code = _by_lemke(fixed)
    rate, slip = _rates(fixed, vertex)
    taking = rate <= _tolerance(problem) * problem.size
    slides = jnp.abs(slip) > _tolerance(problem) * (problem.size + jnp.abs(vertex).max())
    pattern = Pattern(taking, jnp.where(slides, jnp.sign(slip), 0.0))
    solved = _on_pattern(fixed, pattern)
    allowed = _violation(fixed, pattern, solved.x) <= _tolerance(problem)
    x = jnp.where(allowed, solved.x, vertex)
    x = jnp.where(jnp.concatenate([taking, taking]), x, 0.0)
    return _finish(problem, pattern, solved._replace(x=x), code)


def chord_steps(
    equations: Callable[[jax.Array], jax.Array], inverse: jax.Array, x: jax.Array
) -> jax.Array:
    """x, with the derivatives (up to the third) of the solution that it is."""
    x, inverse = jax.lax.stop_gradient((x, inverse))
    for _ in range(3):
        x = x - inverse @ equations(x)
    return x


def pseudoinverse(matrix: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The pseudoinverse of a square matrix with entries of order 1, and whether it is singular."""
    left, values, right = jnp.linalg.svd(matrix)
    floor = _SINGULAR * float(jnp.finfo(matrix.dtype).eps) * len(values) * values[0]
    kept = values > floor
    inverse = jnp.where(kept, 1 / jnp.where(kept, values, 1.0), 0.0)
    return (right.T * inverse[None, :]) @ left.T, ~jnp.all(kept)


def _finish(problem: Problem, pattern: Pattern, solved: _Solved, code: jax.Array) -> Impulses:
    matrix, right = _equations(problem, pattern)
    x = chord_steps(lambda x: matrix @ x - right, solved.inverse, solved.x)
    shared = jnp.where(solved.singular, CODE["impulse_not_unique"], CODE["ok"])
    m = problem.contacts
    return Impulses(x[:m], x[m:], jnp.maximum(code, shared))


def _tolerance(problem: Problem) -> float:
    return problem.contacts * float(jnp.finfo(problem.matrix.dtype).eps) ** _POWER


def _rates(problem: Problem, x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """r and s of impulses x."""
    rate = jnp.concatenate([problem.normal, problem.tangential]) + problem.matrix @ x
    return rate[: problem.contacts], rate[problem.contacts :]


def _equations(problem: Problem, pattern: Pattern) -> tuple[jax.Array, jax.Array]:
    """The linear equations of a pattern: r = 0 or p = 0; s = 0 or p_t + mu xi p = 0."""
    m, dtype = problem.contacts, problem.matrix.dtype
    unit, none = jnp.eye(m, dtype=dtype), jnp.zeros((m, m), dtype)
    no_normal = jnp.concatenate([unit, none], axis=1)
    xi = jnp.where(pattern.slip == _PULLS, 0.0, pattern.slip)
    sliding = jnp.concatenate([jnp.diag(problem.friction * xi), unit], axis=1)
    sticks = pattern.taking & (pattern.slip == 0)
    use = jnp.concatenate([pattern.taking, sticks])
    matrix = jnp.where(use[:, None], problem.matrix, jnp.concatenate([no_normal, sliding]))
    given = jnp.concatenate([problem.normal, problem.tangential])
    return matrix, jnp.where(use, -given, 0.0)


def _on_pattern(problem: Problem, pattern: Pattern) -> _Solved:
    matrix, right = _equations(problem, pattern)
    inverse, singular = pseudoinverse(matrix)
    return _Solved(inverse @ right, inverse, singular)


def _violation(problem: Problem, pattern: Pattern, x: jax.Array) -> jax.Array:
    """By how much x breaks the law under this pattern, in parts of its size."""
    p, side = x[: problem.contacts], x[problem.contacts :]
    matrix, right = _equations(problem, pattern)
    missed = jnp.abs(matrix @ x - right).max()
    _, rate = _rates(problem, x)
    pulls = pattern.slip == _PULLS
    beyond = jnp.abs(side) - problem.friction * jnp.abs(p)
    wrong = jnp.where(pattern.slip == 0, beyond, jnp.where(pulls, 0.0, -pattern.slip * rate))
    wrong = jnp.maximum(wrong, jnp.where(pulls, p, -p))
    return jnp.maximum(missed, wrong.max()) / (problem.size + jnp.abs(x).max())


def _enumerate(problem: Problem) -> tuple[Pattern, _Solved, jax.Array]:
    """The consistent pattern with most sticking contacts, its x, and the code."""
    m = problem.contacts
    slips = itertools.product((0.0, 1.0, -1.0, _PULLS), repeat=m)
    ordered = sorted(slips, key=np.count_nonzero)
    taking = jnp.ones(m, bool)

    def candidate(slip: jax.Array) -> tuple[jax.Array, jax.Array, _Solved]:
        pattern = Pattern(taking, slip)
        solved = _on_pattern(problem, pattern)
        return problem.matrix @ solved.x, _violation(problem, pattern, solved.x), solved

    table = jnp.asarray(np.array(ordered), problem.matrix.dtype)
    moved, violation, solved = jax.vmap(candidate)(table)
    good = violation <= _tolerance(problem)
    best = jnp.where(jnp.any(good), jnp.argmax(good), jnp.argmin(violation))

    def differ(x: jax.Array) -> jax.Array:
        apart = jnp.abs(x - x[best][None, :]).max(axis=1)
        scale = problem.size + jnp.abs(x[best]).max()
        return jnp.any(good & (apart > jnp.sqrt(jnp.finfo(x.dtype).eps) * scale))

    code = jnp.where(differ(solved.x), CODE["impulse_not_unique"], CODE["ok"])
    code = jnp.where(differ(moved), CODE["several_outcomes"], code)
    code = jnp.where(jnp.any(good), code, CODE["infeasible"])
    return Pattern(taking, table[best]), jax.tree.map(lambda x: x[best], solved), code


def _search(problem: Problem) -> tuple[Pattern, _Solved, jax.Array]:
    """A consistent pattern by changing what is inconsistent, from sticking everywhere.

    All inconsistent contacts change at once; later, lest it cycles, only the first of them.
    """
    m, dtype = problem.contacts, problem.matrix.dtype
    taking, mu = jnp.ones(m, bool), problem.friction
    State = tuple[jax.Array, jax.Array, jax.Array]

    def going(state: State) -> jax.Array:
        _, consistent, count = state
        return ~consistent & (count < _TOGETHER * m + _SINGLY * m)

    def change(state: State) -> State:
        slip, _, count = state
        pattern = Pattern(taking, slip)
        x = _on_pattern(problem, pattern).x
        p, side = x[:m], x[m:]
        _, rate = _rates(problem, x)
        room = _tolerance(problem) * (problem.size + jnp.abs(x).max())
        pulls = slip == _PULLS
        turns = jnp.where(pulls, p > room, p < -room)  # between pushing and pulling
        slides = (slip == 0) & (jnp.abs(side) > mu * jnp.abs(p) + room)
        wrong = turns | slides | (~pulls & (slip * rate < -room))
        first = wrong & (jnp.cumsum(wrong) == 1)
        changing = jnp.where(count < _TOGETHER * m, wrong, first)
        other = jnp.where(slides, -jnp.sign(side), 0.0)
        other = jnp.where(turns & ~pulls, _PULLS, other)
        consistent = _violation(problem, pattern, x) <= _tolerance(problem)
        return jnp.where(changing & ~consistent, other, slip), consistent, count + 1

    start = (jnp.zeros(m, dtype), jnp.asarray(False), jnp.asarray(0))
    slip, consistent, _ = jax.lax.while_loop(going, change, start)
    found = Pattern(taking, slip)
    code = jnp.where(consistent, CODE["ok"], CODE["max_steps"])
    return found, _on_pattern(problem, found), code


def _by_lemke(problem: Problem) -> tuple[jax.Array, jax.Array]:
    """x from the complementarity problem of (p, p_t+, p_t-, lambda); lambda is |s| where sliding.

    Source: Anitescu and Potra, Nonlinear Dynamics 14 (1997) 231-247.
    """
    m, matrix = problem.contacts, problem.matrix
    nn, nt, tn, tt = matrix[:m, :m], matrix[:m, m:], matrix[m:, :m], matrix[m:, m:]
    unit, none = jnp.eye(m, dtype=matrix.dtype), jnp.zeros((m, m), matrix.dtype)
    whole = jnp.block(
        [
            [nn, nt, -nt, none],
            [tn, tt, -tt, unit],
            [-tn, -tt, tt, unit],
            [jnp.diag(problem.friction), -unit, -unit, none],
        ]
    )
    a, b = problem.normal, problem.tangential
    found = solve_lcp(whole, jnp.concatenate([a, b, -b, jnp.zeros_like(a)]), symmetric=False)
    z = found.z.reshape(4, m)
    return jnp.concatenate([z[0], z[1] - z[2]]), found.code
