"""Many starts at once, and the distinct minima they end in."""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from jimpact.fits.least_squares import BoxRegion, Method, SolverState
from jimpact.fits.problem import (
    EXACT,
    FEW,
    FitProblem,
    Residuals,
    Shots,
    advance_all,
    begin_all,
    filled_up,
    from_scaled,
)
from jimpact.progress import Show, progress_bar

# Starts that run together. With more of them, those that are done wait for the slowest; with fewer,
# the operations of a pass are too small to be worth their calls.
LANES = 4
PASSES = 4  # until starts that are done are replaced
# A Levenberg-Marquardt start that gains less than this share in this number of passes sits on a
# kink of the law (a change in the sequence of contacts), where steps zigzag: it is given up.
SLOW, SLOW_PASSES = 1e-3, 12
# One whose sum of squares is this far above the best must gain this share to go on, and sooner.
BEHIND, SLOW_BEHIND, BEHIND_PASSES = 10.0, 0.1, 8

# Random starts: a stiffness within this factor of the user's, a parameter without two bounds
# within this many natural scales of the user's.
START_FACTOR = 20.0
START_SCALES = 2.0
# Random coefficients of restitution start above this: below, contacts of a chain re-close many
# times, which takes ten times as long and hardly occurs in hard bodies. (Fits do go there.)
START_RESTITUTION = 0.3

# The law is only piecewise smooth, so that the sum of squares has side minima close to a minimum.
# Starts around the best find lower ones; they repeat while they gain.
ROUNDS, NEAR = 5, 8  # of so many starts
NEAR_SPREAD = 2.0  # standard errors
SETTLED, SETTLING = 1e-5, 10  # change (natural scales) and rounds, where errors of v- are passed on
NEAR_RCOND = 1e-10  # directions that the data do not determine are not searched

# Impacts map a stiffness ratio many to one: three balls of ratio 40 come apart as those of up to
# nine other ratios do. So each such parameter is scanned: SCANNED values within SCAN_FACTOR of the
# user's own, the others following by a Gauss-Newton step; the FOLLOWED best valleys are followed.
SCANNED, SCAN_FACTOR, FOLLOWED = 64, 300.0, 16
DEEP = 0.5  # a valley is deeper than this share of the ridges on both sides
WITHIN = 8  # points of the scan's cubics between two of its values
FLAT = 1e-6  # singular values below this share: the data leave a valley, and no scan is made

# Relative sums of squares, and values in natural scales, closer than this are one minimum: a
# hundred times what solvers leave, and far below what a measurement resolves.
SAME_COST = 1e-6
SAME_VALUE = 1e-3
# A start has converged when a full Gauss-Newton step would lower the sum of squares by less than
# this share: it is then a thousandth of a standard error away from the minimum.
CONVERGED = 1e-6


class Minimum(NamedTuple):
    """A point that starts ended in (weighted as in `Residuals`)."""

    squares: float  # |r|^2
    value: np.ndarray  # of the parameters (P,)
    starts: int  # how many
    jacobian: np.ndarray  # (R, P), of the scaled parameters


class SearchResult(NamedTuple):
    """The best end point (weighted as in `Residuals`), and all distinct minima, best first."""

    value: np.ndarray  # of the parameters (P,)
    y: np.ndarray  # the same in scaled form, (Q,)
    entries: np.ndarray  # of all entries (Q,) of the named fields
    scale: np.ndarray  # natural size of a change of each parameter, at the value found
    log: np.ndarray  # whether it is fitted in its logarithm
    jacobian: np.ndarray  # (R, P), of the scaled parameters
    predicted: np.ndarray  # shaped like what was measured
    status: np.ndarray
    slopes: np.ndarray | None  # `dv+/dv-` of the shots, where errors of v- are passed on
    converged: bool
    at_bound: np.ndarray
    steps: int
    minima: list[Minimum]
    lost: int  # starts that did not converge


def search(
    problem: FitProblem,
    method: Method,
    starts: int,
    seed: int,
    max_steps: int,
    progress: float | None,
) -> SearchResult:
    """Run all starts to their ends, then a few near the best as long as they improve it."""
    rng = np.random.default_rng(seed)
    points, residuals, lost = start_points(problem, starts, rng), filled_up(problem.residuals), 0
    with progress_bar(progress) as show:
        states = run(repeated(residuals, len(points)), points, method, max_steps, show)
        for _ in range(ROUNDS if starts > 1 else 0):
            best = int(np.nanargmin(states.cost))
            least = float(states.cost[best])
            if 2 * least <= EXACT[str(states.y.dtype)] or not _smooth(states, best):
                break
            points = _near(residuals, states, best, min(starts, NEAR), rng)
            more = run(
                repeated(residuals, len(points)), points, method, max_steps, show, len(states.y)
            )
            states = _joined(states, more)
            if np.nanmin(more.cost) > (1 - SLOW) * least:
                break
        if starts > 1 and method == "levenberg-marquardt":
            points = _valleys(problem, residuals, states, show)
            if len(points):
                more = run(
                    repeated(residuals, len(points)), points, method, max_steps, show, len(states.y)
                )
                converged = at_minimum(more)
                states = _joined(states, jax.tree.map(lambda x: x[converged], more))
                lost = int(np.sum(~converged))
    return ends(problem, states, lost=lost)


def _joined(states: SolverState, more: SolverState) -> SolverState:
    """Both batches of states, one after the other."""
    return jax.tree.map(lambda a, b: np.concatenate([a, b]), states, more)


def quiet(what: str, done: float, total: float | None) -> None:
    """No progress is shown."""


def search_near(problem: FitProblem, y: np.ndarray, method: Method, max_steps: int) -> SearchResult:
    """The minimum next to y (Q,)."""
    residuals = repeated(filled_up(problem.residuals), 1)
    return ends(problem, run(residuals, y[None], method, max_steps, quiet))


def settled(
    problems: list[FitProblem],
    points: np.ndarray,
    method: Method,
    max_steps: int,
    show: Show = quiet,
    many: Residuals | None = None,
    slopes: Sequence[np.ndarray | None] | None = None,
) -> tuple[list[FitProblem], SolverState]:
    """Minima next to points (S, Q), equally many of each problem, its best one first.

    Errors of v- are passed on by the law of the best minimum, until both agree. `many`: other
    residuals (S, ...) than the problems', whose weights alone are taken. `slopes`: `dv+/dv-` of
    each problem at its best point; None: the problems pass errors on by them already.
    """
    each = len(points) // len(problems)
    if many is None:
        copies = [filled_up(problem.residuals) for problem in problems for _ in range(each)]
        many = jax.tree.map(lambda *x: np.stack([np.asarray(leaf) for leaf in x]), *copies)
    for _ in range(SETTLING):
        if slopes is not None:
            problems = [p.with_errors_before(slope) for p, slope in zip(problems, slopes)]
            weights = [_weights(filled_up(p.residuals)) for p in problems]
            stacked = (np.repeat(np.stack(x), each, axis=0) for x in zip(*weights))
            many = eqx.tree_at(_weights, many, tuple(stacked))
        states = run(many, points, method, max_steps, show, rivals=False)
        before, points = points, np.asarray(states.y, float)
        moved = np.abs(points - before).max(axis=1) > SETTLED
        if many.mixing is None or not moved.any():
            return problems, states
        cost = states.cost.reshape(-1, each)
        slopes = states.aux[-1][np.arange(0, len(points), each) + np.nanargmin(cost, axis=1)]
    return problems, eqx.tree_at(lambda s: s.gain, states, np.where(moved, np.inf, states.gain))


def _weights(residuals: Residuals) -> tuple[Any, ...]:
    """The parts of residuals that errors of v- change."""
    return residuals.weight, residuals.size, residuals.mixing


def repeated(residuals: Residuals, count: int) -> Residuals:
    """So many times the same problem, without copies."""

    def each(leaf: Any) -> Any:
        """The array without copies."""
        return np.broadcast_to(leaf, (count, *np.shape(leaf))) if eqx.is_array(leaf) else leaf

    return jax.tree.map(each, residuals)


def run(
    problems: Residuals,
    points: np.ndarray,
    method: Method,
    max_steps: int,
    show: Show,
    earlier: int = 0,
    rivals: bool = True,
    what: str = "starts",
) -> SolverState:
    """Solve S problems from points (S, Q), a few at a time; the states come back to the host.

    Rivals are starts of one problem: those far behind the best are given up sooner. Progress
    counts `what`, with those of `earlier` runs of the same search.
    """
    # fits of few shots, or of few values in a row, share the program for all lanes; motions take
    # too long for that
    listed = isinstance(problems.observe, Shots) or problems.measured.ndim == 2
    few = listed and problems.measured.shape[1] <= FEW
    lanes = LANES if few or len(points) > 1 else 1  # not a program for each number of points
    points = points.astype(problems.offset.dtype)
    limit: Any = max_steps
    if method == "levenberg-marquardt":
        limit = np.asarray(max_steps)  # one program serves all limits
    begun = [
        begin_all(_rows(problems, rows), points[rows], method, limit)
        for rows in _batches(list(range(len(points))), lanes)
    ]
    states = jax.tree.map(lambda *x: np.concatenate(x)[: len(points)], *begun)
    active = list(range(len(points)))
    before, since = states.cost.copy(), states.steps.copy()

    def show_count() -> None:
        """Show how many are done."""
        count, total = earlier + len(points) - len(active), earlier + len(points)
        steps = int(states.steps.max())
        text = f"fit: {count} of {total} {what} done, step {steps} of at most {max_steps}"
        show(text, steps, max_steps)

    while active:
        for rows in _batches(active, lanes):
            some = advance_all(_rows(problems, rows), _rows(states, rows), method, limit, PASSES)
            states = jax.tree.map(partial(_with_rows, rows), states, jax.device_get(some))
            show_count()
        ended = states.done | (states.steps >= max_steps)
        if method == "levenberg-marquardt":
            behind = rivals & (states.cost > BEHIND * np.nanmin(states.cost))
            share = np.where(behind, SLOW_BEHIND, SLOW)
            due = states.steps >= since + np.where(behind, BEHIND_PASSES, SLOW_PASSES)
            ended |= due & (before - states.cost <= share * before) & np.isfinite(before)
            before = np.where(due, states.cost, before)
            since = np.where(due, states.steps, since)
        active = [i for i in active if not ended[i]]
    show_count()
    return states


def run_fixed(
    residuals: Residuals,
    fixed: Sequence[tuple[Sequence[int] | int, np.ndarray]],
    max_steps: int,
    show: Show,
) -> SolverState:
    """Minima from y (Q,) of each, while its entries of these numbers are fixed."""
    points = np.array([y for _, y in fixed])
    low, high = (
        np.tile(np.asarray(end, float), (len(fixed), 1)) for end in (residuals.low, residuals.high)
    )
    for k, (which, y) in enumerate(fixed):
        at = np.array(which, int)
        low[k, at] = high[k, at] = y[at]
    dtype = residuals.offset.dtype
    box: Any = BoxRegion(low.astype(dtype), high.astype(dtype))  # type: ignore[arg-type]
    many = repeated(residuals, len(fixed))
    many = eqx.tree_at(lambda r: (r.low, r.high, r.region), many, (box.low, box.high, box))
    what = "fixed values"
    return run(many, points, "levenberg-marquardt", max_steps, show, rivals=False, what=what)


def _batches(items: list[int], lanes: int) -> list[list[int]]:
    """Lists of `lanes` items; the last list repeats its last item."""
    firsts = range(0, len(items), lanes)
    return [[items[min(i + j, len(items) - 1)] for j in range(lanes)] for i in firsts]


def _rows(tree: Any, rows: list[int]) -> Any:
    """These rows of all arrays."""
    return jax.tree.map(lambda leaf: leaf[rows] if eqx.is_array(leaf) else leaf, tree)


def _with_rows(rows: list[int], leaf: np.ndarray, new: np.ndarray) -> np.ndarray:
    """The array with new rows, in place."""
    leaf[rows] = new
    return leaf


def ends(
    problem: FitProblem, states: SolverState, counts: np.ndarray | None = None, lost: int = 0
) -> SearchResult:
    """Pick the best end (the states are on the host); counts: of the starts that a state is for."""
    counts = np.ones(len(states.y), int) if counts is None else counts
    r, count = problem.residuals, len(problem.names)
    y = np.asarray(states.y)[:, :count]
    squares = 2 * np.asarray(states.cost, float)
    values = problem.values_at(y)
    exact = EXACT[str(y.dtype)]
    converged = at_minimum(states)
    groups = _groups(squares, y, converged, exact)
    best = groups[0][0]
    low, high = (np.asarray(end)[:count] for end in (r.low, r.high))
    # starts that did not converge have no minimum to report, unless they are the best there is
    ends = [[i for i in g if converged[i] or i == best] for g in groups]
    predicted, status, *slopes_before = states.aux

    def slopes(i: int) -> np.ndarray:
        """The Jacobian at an end, without what filled up."""
        return np.asarray(states.jacobian[i][: problem.measured.size, :count], float)

    rows = len(problem.measured) if problem.measured.ndim else None  # without what filled up
    return SearchResult(
        value=values[best],
        y=np.asarray(states.y)[best],
        entries=_all_entries(r, np.asarray(states.y)[best]),
        scale=np.where(problem.log, values[best], problem.scale),
        log=problem.log,
        jacobian=slopes(best),
        predicted=np.asarray(predicted[best][:rows] if rows else predicted[best], float),
        status=status[best][:rows],
        slopes=slopes_before[0][best] if slopes_before else None,
        converged=bool(converged[best]),
        at_bound=(y[best] <= low) | (y[best] >= high),
        steps=int(np.max(states.steps)),
        minima=[
            Minimum(float(squares[g[0]]), values[g[0]], int(counts[g].sum()), slopes(g[0]))
            for g in ends
            if g
        ],
        lost=lost + int(counts.sum() - sum(counts[g].sum() for g in ends)),
    )


def at_minimum(states: SolverState) -> np.ndarray:
    """Which of the states (S,) are at a minimum."""
    squares = 2 * np.asarray(states.cost, float)
    exact = squares <= EXACT[str(states.y.dtype)]
    return np.asarray((2 * np.asarray(states.gain) <= CONVERGED * squares) | exact)


def _all_entries(residuals: Residuals, y: np.ndarray) -> np.ndarray:
    """All entries (Q,) of the fields at y."""
    scaled = np.asarray(residuals.offset, float) + np.asarray(residuals.mix, float) @ y
    return from_scaled(scaled, np.asarray(residuals.scale, float), np.asarray(residuals.log))


def _groups(
    squares: np.ndarray, y: np.ndarray, converged: np.ndarray, exact: float
) -> list[list[int]]:
    """Starts that ended in the same minimum, best minimum first.

    Of equally good ends a converged one comes first, then the earliest start: the first start is
    the user's own.
    """
    groups: list[list[int]] = []
    least = np.nanmin(squares)
    equal = squares <= least + SAME_COST * least + exact
    for i in np.lexsort((np.arange(len(y)), ~converged, np.where(equal, least, squares))):
        for group in groups:
            first = group[0]
            close = abs(squares[i] - squares[first]) <= SAME_COST * squares[first] + exact
            if close and np.abs(y[i] - y[first]).max() < SAME_VALUE:
                group.append(int(i))
                break
        else:
            groups.append([int(i)])
    return groups


def _smooth(states: SolverState, best: int) -> bool:
    """Whether the derivatives at an end are numbers."""
    return bool(np.isfinite(states.jacobian[best]).all())


def _near(
    problem: Residuals, states: SolverState, best: int, count: int, rng: np.random.Generator
) -> np.ndarray:
    """Points (count, Q) around the best, as far off as its standard errors, inside the bounds."""
    jacobian = np.asarray(states.jacobian[best], float)
    measured = int(np.sum(np.asarray(problem.weight) > 0))
    variance = 2 * float(states.cost[best]) / measured
    spread = np.sqrt(variance * np.diag(np.linalg.pinv(jacobian.T @ jacobian, rcond=NEAR_RCOND)))
    y = np.asarray(states.y[best], float)
    points = y + NEAR_SPREAD * spread * rng.normal(size=(count, len(y)))
    return np.clip(points, np.asarray(problem.low), np.asarray(problem.high))


def _valleys(
    problem: FitProblem, residuals: Residuals, states: SolverState, show: Show
) -> np.ndarray:
    """Points (., Q) in the valleys of scans through the best end.

    A parameter that is fitted in its logarithm, or that lacks one of two bounds, is fixed at many
    values while the others follow by a step each. Between two values the residuals are taken for
    cubic, with the slopes that the Jacobian gives: two turns between two of them are seen.
    """
    best, count = int(np.nanargmin(states.cost)), len(problem.names)
    if not _smooth(states, best):
        return np.zeros((0, states.y.shape[1]))
    known = np.asarray(states.jacobian[best], float)[:, :count]
    singular = np.linalg.svd(known, compute_uv=False)
    cheap = isinstance(residuals.observe, Shots) and len(residuals.measured) <= FEW
    in_box = isinstance(residuals.region, BoxRegion)
    if not cheap or not in_box or singular[-1] <= FLAT * singular[0]:
        return np.zeros((0, states.y.shape[1]))
    low, high = (np.asarray(end, float)[:count] for end in (residuals.low, residuals.high))
    log, center = problem.log, problem.point(problem.start)[:count]
    reach = np.where(log, np.log(SCAN_FACTOR), START_SCALES)
    fixed = []
    for i in np.flatnonzero(log | ~np.isfinite(low) | ~np.isfinite(high)):
        ends = np.clip(center[i] + reach[i] * np.array([-1, 1]), low[i], high[i])
        for value in np.linspace(ends[0], ends[1], SCANNED):
            fixed.append((int(i), np.array(states.y[best], float)))
            fixed[-1][1][i] = value
    if not fixed:
        return np.zeros((0, states.y.shape[1]))
    scan = run_fixed(residuals, fixed, 1, show)
    valleys = []
    for k in range(0, len(fixed), SCANNED):
        rows = slice(k, k + SCANNED)
        part = jax.tree.map(lambda x, rows=rows: x[rows], scan)
        valleys += _turns(fixed[k][0], count, part, np.asarray(states.y[best], float))
    valleys.sort(key=lambda valley: valley[0])
    return np.array([y for _, y in valleys[:FOLLOWED]]).reshape(-1, states.y.shape[1])


def _turns(
    i: int, count: int, scan: SolverState, best: np.ndarray
) -> list[tuple[float, np.ndarray]]:
    """Sums of squares in the valleys of a scan of the i-th parameter, and where; not the best."""
    y = np.asarray(scan.trial, float)  # one step ahead, as the Jacobian predicts
    jacobian = np.asarray(scan.jacobian, float)[:, :, :count]
    ahead = (y - np.asarray(scan.y, float))[:, :count]
    r = np.asarray(scan.residual, float) + np.einsum("krp,kp->kr", jacobian, ahead)
    others = np.delete(jacobian, i, axis=2)
    slope = jacobian[:, :, i]
    follow = np.einsum("kor,kr->ko", np.linalg.pinv(others, rcond=FLAT), slope)
    slope = slope - np.einsum("kro,ko->kr", others, follow)
    h = np.diff(y[:, i])[:, None, None]
    t = (np.arange(WITHIN) / WITHIN)[None, :, None]
    a, b, p, q = r[:-1, None], r[1:, None], h * slope[:-1, None], h * slope[1:, None]
    cubic = a + t * p + t**2 * (3 * (b - a) - 2 * p - q) + t**3 * (2 * (a - b) + p + q)
    where = y[:-1, None] + t * np.diff(y, axis=0)[:, None]
    squares = np.append(np.sum(cubic**2, axis=2).ravel(), np.sum(r[-1] ** 2))
    where = np.vstack([where.reshape(-1, y.shape[1]), y[-1:]])
    padded = np.pad(squares, 1, constant_values=np.inf)
    left, right = np.maximum.accumulate(squares), np.maximum.accumulate(squares[::-1])[::-1]
    least = (squares < padded[:-2]) & (squares <= padded[2:])
    deep = squares <= DEEP * np.minimum(left, right)
    new = np.abs(where[:, i] - best[i]) > 0.5 * h.max()
    return [(float(squares[k]), where[k]) for k in np.flatnonzero(least & deep & new)]


def start_points(problem: FitProblem, starts: int, rng: np.random.Generator) -> np.ndarray:
    """Starts y (S, Q): the law's own values, then random ones inside the bounds."""
    count, log, r = len(problem.names), problem.log, problem.residuals
    own_values = problem.point(problem.start)
    low, high = (np.array(end, float)[:count] for end in (r.low, r.high))
    reach = np.where(log, np.log(START_FACTOR), START_SCALES)
    low = np.where(log | np.isinf(low), np.maximum(low, own_values[:count] - reach), low)
    high = np.where(log | np.isinf(high), np.minimum(high, own_values[:count] + reach), high)
    elastic = [problem.parameters.field_of(i) == "restitution" for i in range(count)]
    low = np.where(elastic & (high > START_RESTITUTION), np.maximum(low, START_RESTITUTION), low)
    points = np.zeros((starts, len(own_values)))
    points[:, :count] = low + (high - low) * rng.random((starts, count))
    points[0] = own_values
    return points
