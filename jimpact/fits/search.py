"""Where starts begin, and the distinct minima they end in."""

from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from jimpact.fits.problem import FitProblem, Residuals, filled_up, from_scaled
from jimpact.fits.solve import COARSE, EXACT, BoxRegion, Search, SolverState, minimize

# Random starts: a stiffness within this factor of the user's, a parameter without two bounds
# within this many natural scales of the user's.
START_FACTOR = 5.0
START_SCALES = 2.0
# Random coefficients of restitution start above this: below, contacts of a chain re-close many
# times, which takes ten times as long and hardly occurs in hard bodies. (Fits do go there.)
START_RESTITUTION = 0.5
# Ends are one minimum if their sums of squares differ by less than this many variances of a
# residual, and their values by less than this share of a standard error, or of a natural scale
# where the data do not determine them. What starts leave is a tenth of that.
SAME_COST, SAME_ERRORS, SAME_VALUE = 1e-2, 0.2, 1e-3
FLAT = 1e-6  # share of the largest singular value below which data do not determine a direction
# Starts up to so many variances above the best are solved to their ends, the others only to
# where minima can be told apart: intervals of all levels end before.
HARDLY_WORSE = 100.0
STARTS, ROUNDS = 12, 6  # by default, and how often others around the best follow
# Several stiffness ratios often reproduce the same shots. Where one or two are free, a search of
# its own choice also starts from SCANNED values of each, up to this factor from the user's; ten
# times more values take ten times as long, ten times fewer step over minima.
SCANNED, SCAN_FACTOR, SCANS = 24, 100.0, 2
NEAR_SPREAD = 2.0  # of starts around the best, in standard errors
NEAR_RCOND = 1e-10  # directions that the data do not determine are not searched
SETTLED, SETTLING = 1e-5, 10  # change (natural scales) and rounds, where errors of v- are passed on


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
    stuck: bool  # no step lowers the sum of squares, although derivatives promise it
    at_bound: np.ndarray
    steps: int
    minima: list[Minimum]
    lost: int  # starts that did not converge


def find_minima(problem: FitProblem, starts: int | None, seed: int, search: Search) -> SearchResult:
    """All starts to where their minima can be told apart, and the best of these to their ends.

    Two thirds of the starts are those of `start_points`. The law is only piecewise smooth, so
    that the sum of squares has side minima close to a minimum: the others begin around the best.
    None: STARTS, others along the ratios of stiffness, and further ones around the best as long as
    they lower it.
    """
    rounds, starts = (ROUNDS, STARTS) if starts is None else (1, starts)
    residuals, rng = filled_up(problem.residuals), np.random.default_rng(seed)
    if starts == 1:
        points = start_points(problem, 1, rng)
        return ends(problem, minimize(repeated(residuals, 1), points, search, what="starts"))
    far = starts - starts // 3
    points = start_points(problem, far, rng)
    if rounds > 1:
        points = np.concatenate([points, _scanned(problem)])
    states = minimize(repeated(residuals, len(points)), points, search, COARSE, True, "starts")
    for _ in range(rounds if starts > far else 0):
        least = np.nanmin(states.squares)
        points = _near(residuals, states, starts - far, rng)
        more = minimize(repeated(residuals, len(points)), points, search, COARSE, True, "starts")
        states = jax.tree.map(lambda a, b: np.concatenate([a, b]), states, more)
        if not np.nanmin(more.squares) < least * (1 - 1 / states.residual.shape[1]):
            break
    starts = len(states.y)
    groups = _groups(states, len(problem.names))
    firsts = np.array([group[0] for group in groups])
    variance = states.squares[firsts[0]] / states.residual.shape[1]
    near = states.squares[firsts] <= states.squares[firsts[0]] + HARDLY_WORSE * variance
    near &= states.converged[firsts] | (firsts == firsts[0])
    best = minimize(
        repeated(residuals, int(near.sum())),
        np.asarray(states.y)[firsts[near]],
        search,
        what="minima",
    )
    search.show(f"fit: {starts} of {starts} starts done", starts, starts)
    steps = states.steps.max() + best.steps.max()
    for leaf, value in zip(jax.tree.leaves(states), jax.tree.leaves(best)):
        leaf[firsts[near]] = value
    counts = np.zeros(starts, int)
    counts[firsts] = [states.converged[group].sum() for group in groups]
    counts[firsts[0]] = max(counts[firsts[0]], 1)
    kept = firsts[states.converged[firsts] | (firsts == firsts[0])]
    lost = starts - int(counts[kept].sum())
    states = jax.tree.map(lambda x: x[kept], states)
    return ends(problem, states, counts[kept], lost)._replace(steps=int(steps))


def _scanned(problem: FitProblem) -> np.ndarray:
    """Points (S, Q) with other ratios of stiffness, if few are free: each one in turn."""
    fields = map(problem.parameters.field_of, range(len(problem.names)))
    ratios = [i for i, field in enumerate(fields) if field == "stiffness" and problem.log[i]]
    own = problem.point(problem.start)
    if len(ratios) > SCANS:
        return np.zeros((0, len(own)))
    points = np.tile(own, (len(ratios), SCANNED, 1))
    for row, i in zip(points, ratios, strict=True):
        row[:, i] += np.linspace(-np.log(SCAN_FACTOR), np.log(SCAN_FACTOR), SCANNED)
    low, high = np.asarray(problem.residuals.low), np.asarray(problem.residuals.high)
    return np.clip(points.reshape(-1, len(own)), low, high)


def _near(
    residuals: Residuals, states: SolverState, count: int, rng: np.random.Generator
) -> np.ndarray:
    """Points (count, Q) around the best, as far off as its standard errors, inside the bounds."""
    best = int(np.nanargmin(states.cost))
    jacobian = np.nan_to_num(np.asarray(states.jacobian[best], float))
    measured = int(np.sum(np.asarray(residuals.weight) > 0))
    inverse = np.linalg.pinv(jacobian.T @ jacobian, rcond=NEAR_RCOND, hermitian=True)
    spread = NEAR_SPREAD * np.sqrt(states.squares[best] / measured * np.diag(inverse))
    y = np.asarray(states.y[best], float)
    points = y + np.minimum(spread, START_SCALES) * rng.normal(size=(count, len(y)))
    return np.clip(points, np.asarray(residuals.low), np.asarray(residuals.high))


def find_near(problem: FitProblem, y: np.ndarray, search: Search) -> SearchResult:
    """The minimum next to y (Q,)."""
    return ends(problem, minimize(repeated(filled_up(problem.residuals), 1), y[None], search))


def evaluated(problem: FitProblem, y: np.ndarray) -> SearchResult:
    """Predictions and derivatives at y (Q,), by the program that searches for minima."""
    box: Any = BoxRegion(*np.broadcast_to(y.astype(problem.residuals.offset.dtype), (2, len(y))))
    fixed = eqx.tree_at(
        lambda r: (r.low, r.high, r.region), problem.residuals, (box.low, box.high, box)
    )
    return find_near(replace(problem, residuals=fixed), y, Search(max_steps=1))


def repeated(residuals: Residuals, count: int) -> Residuals:
    """So many times the same problem, without copies."""

    def each(leaf: Any) -> Any:
        """The array without copies."""
        return np.broadcast_to(leaf, (count, *np.shape(leaf))) if eqx.is_array(leaf) else leaf

    return jax.tree.map(each, residuals)


def stacked(problems: list[FitProblem]) -> Residuals:
    """The problems side by side."""
    filled = [filled_up(problem.residuals) for problem in problems]
    return jax.tree.map(lambda *x: np.stack([np.asarray(leaf) for leaf in x]), *filled)


def settled(
    problems: list[FitProblem],
    points: np.ndarray,
    search: Search,
    many: Residuals | None = None,
    slopes: list[np.ndarray | None] | None = None,
) -> tuple[list[FitProblem], SolverState]:
    """Minima next to points (S, Q), equally many of each problem, its best one first.

    Errors of v- are passed on by the law of the best minimum, until both agree. `many`: other
    residuals (S, ...) than the problems', whose weights alone are taken. `slopes`: `dv+/dv-` of
    each problem at its best point; None: the problems pass errors on by them already.
    """
    each = len(points) // len(problems)
    if many is None:
        many = stacked([problem for problem in problems for _ in range(each)])
    for _ in range(SETTLING):
        if slopes is not None:
            problems, many = _weighted(problems, many, slopes)
        states = minimize(many, points, search)
        before, points = points, np.asarray(states.y, float)
        moved = np.abs(points - before).max(axis=1) > SETTLED
        if many.mixing is None:
            return problems, states
        best = np.nanargmin(states.cost.reshape(-1, each), axis=1)
        last = list(states.aux[-1][np.arange(0, len(points), each) + best])
        if not moved.any():
            if slopes is not None:  # residuals and Jacobians with the weights of the final law
                problems, many = _weighted(problems, many, last)
                states = minimize(many, points, search._replace(max_steps=1))
            return problems, states
        slopes = last
    return problems, eqx.tree_at(lambda s: s.gain, states, np.where(moved, np.inf, states.gain))


def _weighted(
    problems: list[FitProblem], many: Residuals, slopes: list[np.ndarray | None]
) -> tuple[list[FitProblem], Residuals]:
    """The problems, and equally many residuals of each, with errors passed on by `slopes`."""
    problems = [p.with_errors_before(slope) for p, slope in zip(problems, slopes)]
    weights = [_weights(filled_up(p.residuals)) for p in problems]
    each = len(many.offset) // len(problems)
    new = (np.repeat(np.stack(x), each, axis=0) for x in zip(*weights))
    return problems, eqx.tree_at(_weights, many, tuple(new))


def _weights(residuals: Residuals) -> tuple[Any, ...]:
    """The parts of residuals that errors of v- change."""
    return residuals.weight, residuals.size, residuals.mixing


def ends(
    problem: FitProblem, states: SolverState, counts: np.ndarray | None = None, lost: int = 0
) -> SearchResult:
    """Pick the best end (the states are on the host); counts: of the starts that a state is for."""
    counts = np.ones(len(states.y), int) if counts is None else counts
    r, count = problem.residuals, len(problem.names)
    y = np.asarray(states.y)[:, :count]
    values, converged = problem.values_at(y), states.converged
    groups = _groups(states, count)
    best = groups[0][0]
    low, high = (np.asarray(end)[:count] for end in (r.low, r.high))
    # starts that did not converge have no minimum to report, unless they are the best there is
    ends = [[i for i in group if converged[i] or i == best] for group in groups]
    predicted, status, *slopes_before = states.aux
    rows = len(problem.measured) if problem.measured.ndim else None  # without what filled up
    scaled = np.asarray(r.offset, float) + np.asarray(r.mix, float) @ np.asarray(states.y)[best]

    def slopes(i: int) -> np.ndarray:
        """The Jacobian at an end, without what filled up."""
        return np.asarray(states.jacobian[i][: problem.measured.size, :count], float)

    return SearchResult(
        value=values[best],
        y=np.asarray(states.y)[best],
        entries=from_scaled(scaled, np.asarray(r.scale, float), np.asarray(r.log)),
        scale=np.where(problem.log, values[best], problem.scale),
        log=problem.log,
        jacobian=slopes(best),
        predicted=np.asarray(predicted[best][:rows] if rows else predicted[best], float),
        status=status[best][:rows],
        slopes=slopes_before[0][best] if slopes_before else None,
        converged=bool(converged[best]),
        stuck=bool(states.stuck[best]),
        at_bound=(y[best] <= low) | (y[best] >= high),
        steps=int(np.max(states.steps)),
        minima=[
            Minimum(float(states.squares[g[0]]), values[g[0]], int(counts[g].sum()), slopes(g[0]))
            for g in ends
            if g
        ],
        lost=lost + int(counts.sum() - sum(counts[g].sum() for g in ends)),
    )


def _groups(states: SolverState, count: int) -> list[list[int]]:
    """Starts that ended in the same minimum, best minimum first.

    Of equally good ends a converged one comes first, then the earliest start: the first start is
    the user's own.
    """
    squares, y = states.squares, np.asarray(states.y, float)[:, :count]
    exact, least = EXACT[str(states.y.dtype)], np.nanmin(squares)
    unit = SAME_COST / states.residual.shape[1]
    equal = squares <= least * (1 + unit) + exact
    order = np.lexsort((np.arange(len(y)), ~states.converged, np.where(equal, least, squares)))
    groups: list[list[int]] = []
    for i in order:
        for group in groups:
            first = group[0]
            close = abs(squares[i] - squares[first]) <= unit * squares[first] + exact
            if close and _same_values(states, first, y[i] - y[first]):
                group.append(int(i))
                break
        else:
            groups.append([int(i)])
    return groups


def _same_values(states: SolverState, first: int, apart: np.ndarray) -> bool:
    """Whether values (P,) so far apart from those of an end are the same."""
    if np.abs(apart).max() < SAME_VALUE:
        return True
    jacobian = np.asarray(states.jacobian[first], float)[:, : len(apart)]
    if not np.isfinite(jacobian).all():
        return False
    _, singular, directions = np.linalg.svd(jacobian, full_matrices=False)
    determined = singular > FLAT * singular[0]
    noise = np.sqrt(states.squares[first] / len(jacobian))
    errors = np.where(determined, noise / np.where(determined, singular, 1.0), 0.0)
    allowed = np.maximum(SAME_ERRORS * errors, SAME_VALUE)
    return bool((np.abs(directions @ apart) <= allowed).all())


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
