"""Linear complementarity: `0 <= z  _|_  A z + q >= 0`, differentiable, batched,
singular A too.

Lemke's method finds which z are positive, with derivatives switched off; one linear
solve on that support then gives values and derivatives of any order. At a kink (a
contact about to take an impulse or to give one up) the derivatives are those of one
side.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jimpact.numerics.dense import (
    null_projector,
    solve_by_pivots,
    solve_definite,
    unit_outside,
)
from jimpact.numerics.many_contacts import solve_many
from jimpact.numerics.sparse import Sparse, conjugate_gradients
from jimpact.numerics.tridiagonal import Symmetric, as_matrix, is_regular
from jimpact.tools.compiling import full_precision
from jimpact.tools.loops import while_loop
from jimpact.tools.masks import choose, quotient
from jimpact.tools.precision import precision
from jimpact.tools.status import CODE

# The matrix is scaled to a diagonal of 1 and q to a largest entry of 1. Entries below
# this times eps m are rounding, and no pivots. Ten times more: small pivots of very
# light bodies are missed; ten times less: pivots at the level of rounding spoil one in
# a thousand degenerate problems.
_ROUNDING = 640.0
_POWER = 2 / 3  # of eps: see `gathered_rounding`
_PIVOTS = 10  # pivots allowed per unknown; 1 or 2 are usual

# A sparse problem is solved by descent until it moves less than this many roundings,
# relative to the largest q. Ten times more: velocities lose a digit.
_DESCENT_ROUNDINGS = 256
# steps of descent at most; packings of 3000 spheres take some thousand
_DESCENTS = 100_000


class LCP(NamedTuple):
    """Solution z and `w = A z + q`; `code`: ok, impulse_not_unique, infeasible,
    max_steps.
    """

    z: Float[Array, " m"]
    w: Float[Array, " m"]
    code: Int[Array, ""]


class _Tableau(NamedTuple):
    """Tableau of Lemke's method for `w - A z - z_0 1 = q`, and the number of pivots."""

    # w = 2 m + 2 columns: w, z, the artificial variable, right-hand side
    rows: Float[Array, "m w"]
    basis: Int[Array, " m"]  # number of the variable that each row stands for
    entering: Int[Array, ""]  # number of the variable that enters the basis next
    ray: Bool[Array, ""]  # no row limits the entering variable: there is no solution
    pivots: Int[Array, ""]  # so far


@full_precision
def solve_lcp(
    matrix: Symmetric,
    q: Float[Array, " m"],
    *,
    symmetric: bool = True,
    regular: bool | None = None,
) -> LCP:
    """Solve `0 <= z _|_ A z + q >= 0`.

    Args:
        matrix: A: symmetric positive semidefinite, stored in any way, or not symmetric
            (`symmetric=False`) and such that Lemke's method applies (positive
            semidefinite, copositive plus, P).
        q: the constant term.
        symmetric: w is then unique; where z is not, the z of least norm (in the scaling
            that makes the diagonal 1) is returned, with the code `impulse_not_unique`.
        regular: A is known to be regular, which saves the search for its null space;
            None: as its structure says.

    Source: Lemke (1965); Cottle, Pang and Stone, The Linear Complementarity Problem
    (2009), 4.4.

    >>> import jax.numpy as jnp
    >>> from jimpact.numerics.lcp import solve_lcp
    >>> solution = solve_lcp(
    ...     jnp.array([[2.0, -1.0], [-1.0, 2.0]]), jnp.array([-1.0, 3.0])
    ... )
    >>> [round(float(z), 6) for z in solution.z]
    [0.5, 0.0]
    """
    if isinstance(matrix, Sparse):
        return _solve_sparse(matrix, q)
    if regular is None:
        regular = is_regular(matrix)
    matrix = as_matrix(matrix)
    diagonal = jax.lax.stop_gradient(jnp.diagonal(matrix))
    positive = jnp.where(diagonal > 0, diagonal, 1.0)
    scale = jnp.where(diagonal > 0, 1 / jnp.sqrt(positive), 1.0)
    a = matrix * scale[:, None] * scale[None, :]
    b = q * scale
    largest = jax.lax.stop_gradient(jnp.abs(b).max())
    size = jnp.where(largest > 0, largest, 1.0)
    b = b / size
    constant = jax.lax.stop_gradient((a, b))
    support, code = _support(*constant)
    z = _solve_on(support, a, -b, symmetric)
    wrong = _wrong(*constant, support, jax.lax.stop_gradient(z))
    unsolved = (code == CODE["ok"]) & wrong
    code = jnp.where(unsolved, CODE["max_steps"], code)
    if symmetric and not regular:
        z, singular = _least_norm(a, b, z)
        gravest = jnp.maximum(code, CODE["impulse_not_unique"])
        code = jnp.where(singular, gravest, code)
    z = jnp.where(z < 0, 0.0, z)  # only rounding is negative
    w = jnp.where(support, 0.0, a @ z + b)
    return LCP(z * scale * size, w / scale * size, code)


def _solve_sparse(matrix: Sparse, q: Float[Array, " m"]) -> LCP:
    """Solve `0 <= z _|_ A z + q >= 0` by products `A z` only, A symmetric positive
    semidefinite.

    Which of several z is returned is left to the descent. Values are those of the
    descent, and derivatives those of the linear system on its support: where A is
    singular there, they are right for `A z`, and NaN where not even that has any.
    """
    constant, rate = jax.lax.stop_gradient((matrix, q))
    tolerance = _DESCENT_ROUNDINGS * precision(q.dtype).eps
    columns = constant.diagonal[:, None], rate[:, None]
    found = solve_many(
        lambda z: (constant @ z[:, 0])[:, None],
        *columns,
        friction=jnp.zeros_like(rate),
        start=jnp.zeros_like(columns[1]),
        inverse_step_size=jnp.ones_like(rate[0]),
        tolerance=tolerance,
        most=_DESCENTS,
    )
    z = jax.lax.stop_gradient(found.impulse[:, 0])
    support = z > 0
    scale = 1 / jnp.sqrt(constant.diagonal)
    a = matrix.scaled(scale).within(support)
    right = jnp.where(support, -q * scale, 0.0)
    solved = scale * conjugate_gradients(lambda x: a @ x, right)
    z = z + (solved - jax.lax.stop_gradient(solved))
    # A is singular if a right side is not in its range: nearly all have a part in its
    # null space
    index = jnp.arange(1.0, len(q) + 1, dtype=q.dtype)
    other = jnp.where(support, jnp.cos(index**2), 0.0)
    fixed = jax.lax.stop_gradient(a)
    solution = conjugate_gradients(lambda x: fixed @ x, other)
    singular = jnp.any(jnp.isnan(solution))
    code = jnp.where(singular, CODE["impulse_not_unique"], CODE["ok"])
    code = jnp.where(found.misfit > tolerance, CODE["max_steps"], code)
    w = jnp.where(support, 0.0, matrix @ z + q)
    return LCP(z, w, code)


def gathered_rounding(unknowns: int, dtype: Any) -> float:
    """Rounding `m eps^(2/3)` of m unknowns that a whole run may gather.

    A larger artificial variable left at its end means that there is no solution; a
    larger w means that the contact is open.
    """
    return unknowns * precision(dtype).eps ** _POWER


def _solve_on(
    support: Bool[Array, " m"],
    a: Float[Array, "m m"],
    right: Float[Array, " m"],
    symmetric: bool = True,
) -> Float[Array, " m"]:
    """z with `A_SS z_S = right_S` on the support S, z = 0 elsewhere."""
    masked = unit_outside(a, support)
    right = jnp.where(support, right, 0.0)
    if symmetric:
        return solve_definite(masked, right)
    column = right[:, None]
    z, _ = solve_by_pivots(masked, column)
    return z[:, 0]


def _least_norm(
    a: Float[Array, "m m"], b: Float[Array, " m"], z: Float[Array, " m"]
) -> tuple[Float[Array, " m"], Bool[Array, ""]]:
    """Solution of least norm among those with the w of `z`, and whether there are
    several.

    With P the projector on the null space of A where w = 0, they are `r + P y >= 0`, r
    = z - P z; the least has `y >= 0`, complementary to r + P y: one more such problem.
    """
    w = jax.lax.stop_gradient(a @ z + b)
    rounding = gathered_rounding(len(b), b.dtype)
    tight = w <= rounding
    projector, singular = null_projector(unit_outside(a, tight))
    rest = z - projector @ z
    # rounding of `rest` at zero must not start pivots
    noise = jnp.abs(rest) <= rounding * jnp.abs(z).max()
    constant = jax.lax.stop_gradient(rest)
    support, _ = _support(projector, jnp.where(noise, 0.0, constant))
    y = _solve_on(support, projector, -rest)
    return jnp.where(singular, rest + projector @ y, z), singular


def _rounding(unknowns: int, dtype: Any) -> float:
    """Rounding `640 eps m` of entries in a tableau of Lemke's method with m
    unknowns.
    """
    return _ROUNDING * precision(dtype).eps * unknowns


def _wrong(
    a: Float[Array, "m m"],
    b: Float[Array, " m"],
    support: Bool[Array, " m"],
    z: Float[Array, " m"],
) -> Bool[Array, ""]:
    """True if z or w has a wrong sign, or z is so large that the rounding of A z hides
    b.
    """
    size = jnp.max(jnp.abs(z))
    gathered = gathered_rounding(len(b), b.dtype)
    noise = _rounding(len(b), b.dtype) * size  # of A z, where the largest q is 1
    w = jnp.where(support, 0.0, a @ z + b)
    right_z = z >= -gathered * jnp.maximum(1.0, size)
    signs = right_z & (w >= -gathered - noise)
    return ~(jnp.all(signs) & (noise < 1))  # True where z is NaN


def _support(
    a: Float[Array, "m m"], b: Float[Array, " m"]
) -> tuple[Bool[Array, " m"], Int[Array, ""]]:
    """Mask of the positive z in `0 <= z _|_ A z + b >= 0`, and the code: Lemke's
    method.
    """
    m = b.shape[0]
    dtype = b.dtype
    tolerance = _rounding(m, dtype)
    ones = jnp.ones((m, 1), dtype)
    identity = jnp.eye(m, dtype=dtype)
    rows = jnp.concatenate([identity, -a, -ones, b[:, None]], axis=1)
    artificial = 2 * m
    basis = jnp.arange(m)
    entering = jnp.asarray(artificial)
    start = _Tableau(rows, basis, entering, jnp.asarray(False), jnp.asarray(0))
    # z = 0 solves it; else the artificial variable enters at the most negative row
    needed = jnp.min(b) < -tolerance
    first = _pivot(start, jnp.argmin(b))
    limit = _PIVOTS * (m + 1)

    def going(state: _Tableau) -> Bool[Array, ""]:
        """True while the artificial variable is basic, no ray was found and pivots are
        left.
        """
        inside = jnp.any(state.basis == artificial)
        return needed & inside & ~state.ray & (state.pivots < limit)

    def one(state: _Tableau) -> _Tableau:
        """Tableau after one pivot, or as it is if a ray shows that there is no
        solution.
        """
        row, ray = _leaving(state, tolerance)
        moved = _pivot(state, row)
        return choose(ray, state, moved)._replace(ray=ray)

    end = while_loop(going, one, first)
    number = jnp.arange(m)
    basic = end.basis[:, None] == (m + number)[None, :]
    support = needed & jnp.any(basic, axis=0)
    of_artificial = jnp.where(end.basis == artificial, end.rows[:, -1], 0.0)
    left = jnp.max(of_artificial)
    stuck = needed & (left > gathered_rounding(len(b), b.dtype))
    reason = jnp.where(end.ray, CODE["infeasible"], CODE["max_steps"])
    return support, jnp.where(stuck, reason, CODE["ok"])


def _leaving(
    state: _Tableau, tolerance: float
) -> tuple[Int[Array, ""], Bool[Array, ""]]:
    """Row of the least ratio of right side to entering column, and whether there is
    none (a ray).

    No order among ties (lexicographic, say) changed any of over 80 000 degenerate
    problems; a cycle would end as `max_steps`.
    """
    m = state.basis.shape[0]
    enters = jnp.arange(2 * m + 2) == state.entering
    column = state.rows @ enters.astype(state.rows.dtype)
    candidates = column > tolerance
    right = state.rows[:, -1]
    ratio = quotient(right, column, where=candidates, otherwise=jnp.inf)
    return jnp.argmin(ratio), ~jnp.any(candidates)


def _pivot(state: _Tableau, row: Int[Array, ""]) -> _Tableau:
    """Tableau in which the entering variable replaces that of `row`; its complement
    enters next.
    """
    m = state.basis.shape[0]
    dtype = state.rows.dtype
    enters = jnp.arange(2 * m + 2) == state.entering
    column = state.rows @ enters.astype(dtype)
    chosen = jnp.arange(m) == row
    pivot_row = chosen.astype(dtype) @ state.rows
    pivot_row = pivot_row / jnp.sum(jnp.where(chosen, column, 0.0))
    eliminated = state.rows - column[:, None] * pivot_row[None, :]
    rows = jnp.where(chosen[:, None], pivot_row[None, :], eliminated)
    leaving = jnp.sum(jnp.where(chosen, state.basis, 0))
    basis = jnp.where(chosen, state.entering, state.basis)
    entering = jnp.where(leaving < m, leaving + m, leaving - m)
    return _Tableau(rows, basis, entering, state.ray, state.pivots + 1)
