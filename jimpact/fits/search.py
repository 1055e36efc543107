"""The lowest minimum of a fit, and others: where searches start, and which of their
ends differ.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import chdtrc

from jimpact.fits.observables import Shots
from jimpact.fits.problem import FitProblem, outcome_at
from jimpact.fits.solve import (
    COARSE,
    RANK_TOLERANCE,
    SETTLED,
    Ends,
    Method,
    Solver,
    minimize,
    stacked,
    step_limit,
)
from jimpact.tools.checks import as_whole, check_choice, check_values
from jimpact.tools.compiling import quick_jit
from jimpact.tools.threads import in_parts

# Random starts: a stiffness within this factor of the user's, a parameter without two
# bounds within this many natural scales of the user's.
START_FACTOR = 5.0
START_SCALES = 2.0
# Random coefficients of restitution start above this: below, contacts of a chain
# re-close many times, which takes ten times as long and hardly occurs in hard bodies.
# (Fits do go there.)
START_RESTITUTION = 0.5
# Ends are one minimum if their sums of squares differ by less than this many variances
# of a residual, and their values by less than this share of a standard error, or of a
# natural scale where the data do not determine them. What starts leave is a tenth of
# that.
SAME_COST = 1e-2
SAME_ERRORS = 0.2
SAME_VALUE = 1e-3
# by default, and how often others around the best follow
STARTS = 12
ROUNDS = 8
# What chi^2 rejects at this level is searched for again, with twice as many starts in
# each turn, in so many turns at most. Ten times less: side minima that fit nearly as
# well are taken.
REJECTED = 0.1
TURNS = 3
# a round without a gain is the last one, or the second of more parameters
IDLE_PARAMETERS = 4
# A search of its own choice starts at the lowest of so many points for P parameters,
# and around the best at the lowest of the least number: values alone cost a tenth of
# derivatives. A box of P dimensions with a side minimum in most of its corners needs
# 2^P; ten times more points take longer than all that descends from them.
SCANNED = 128
MOST_SCANNED = 1024
SCANNED_A_CORNER = 16
SCAN_LANES = 8  # of them side by side
# of these values, which need only be told apart; finer ones take twice as long
SCAN_RTOL = 1e-4
# Steps a coordinate of an impact in these values, three times what most take. Shots
# that need more count as failed: they hardly belong to a low point, and all beside them
# would wait up to a hundred times as long. With ten times as many, scans take most of a
# fit again.
SCAN_STEPS = 40
# Several ratios often reproduce the same shots: one or two are scanned up to this
# factor.
SCAN_FACTOR = 100.0
SCANS = 2
# Starts around the best, in standard errors: nearer ones end in it, farther ones
# anywhere.
NEAR_SPREAD = 2.0
FAR_SPREAD = 40.0
ROUGH_STEPS = 16  # of a start, to where minima can be told apart
HUBER = 1.345  # sigmas up to which a residual counts squared: 95 % of the efficiency
STUDENT = 4.0  # degrees of freedom of the tails
LOSS_ROUNDS = 50  # of weights
LEAST_SLOPE = 1e-7  # mean psi' of residuals that all are outliers, in the place of 0
MEDIAN = 1.4826  # sigma of a normal distribution over the median of its absolute values


def _huber(
    u: Float[np.ndarray, "*value"],
) -> tuple[Float[np.ndarray, "*value"], Float[np.ndarray, "*value"]]:
    """`psi(u) / u` and `psi'(u)` of Huber's loss at residuals u:
    `psi = max(-h, min(u, h))`.
    """
    inside = np.abs(u) <= HUBER
    size = np.where(inside, 1.0, np.abs(u))
    weight = np.where(inside, 1.0, HUBER / size)
    return weight, inside.astype(float)


def _student(
    u: Float[np.ndarray, "*value"],
) -> tuple[Float[np.ndarray, "*value"], Float[np.ndarray, "*value"]]:
    """`psi(u) / u` and `psi'(u)` of Student's t with f degrees of freedom at residuals
    u.

    Equation: `psi = -d log(density) / du = (f + 1) u / (f + u^2)`.
    """
    below = STUDENT + u**2
    slope = (STUDENT + 1) * (STUDENT - u**2) / below**2
    return (STUDENT + 1) / below, slope


LOSSES = {"huber": _huber, "student": _student}


@dataclass(frozen=True)
class Search:
    """Options of `fit` for the search: method, loss, limits, progress.

    Args:
        method: 'levenberg-marquardt'; or gradient descent: 'adam', 'sgd', 'lbfgs' or an
            optax transformation.
        loss: 'squares'; or one that outliers move little: 'huber' (beyond 1.345 sigma
            the absolute value), 'student' (the density of Student's t, 4 degrees of
            freedom). Where sigma is not known, it is taken from the median of the
            residuals.
        seed: of the random starts.
        max_steps: iterations per start; None: 100, of 'adam' 500, of 'sgd' 1000.
        limit: seconds after which no further step of the search is begun; None: no
            limit.
        progress: bar on stderr; None: on a terminal, for fits longer than two seconds.

    Raises:
        ValueError: a method or a loss that is not known; a number out of its range.

    >>> import jimpact as ji
    >>> data = ji.Experiments(
    ...     pre=[[1.0, 0.0], [2.0, 0.0]], post=[[0.3, 0.7], [0.6, 1.4]]
    ... )
    >>> fit = ji.fit(
    ...     ji.Newton(0.9), ji.chain([1.0, 1.0]), data, search=ji.Search(method="adam")
    ... )
    >>> round(float(fit.law.restitution), 4)
    0.4
    """

    method: Method = "levenberg-marquardt"
    loss: str = "squares"
    seed: int = 0
    max_steps: int | None = None
    limit: float | None = None
    progress: float | None = None

    @staticmethod
    def _instead_of(value: Any) -> str:
        """Advice for a value that is no search, ending the message of `check_kind`."""
        if isinstance(value, str):
            return f" Give ji.Search({value!r})."
        return ""

    def __post_init__(self) -> None:
        """Raise a ValueError for an unknown method or loss, and for numbers out of
        range.
        """
        as_whole("max_steps", step_limit(self.method, self.max_steps), 1)
        as_whole("seed", self.seed, 0)
        check_values("limit", self.limit, low=0.0)
        check_choice("loss", self.loss, ("squares", *LOSSES))


DEFAULT_SEARCH = Search()


@dataclass(frozen=True, eq=False)
class FitMinimum:
    """A minimum: sum of squared (weighted) residuals, parameters, number of starts that
    end in it.

    `standard_error` is None where it fits so much worse that it does not matter.
    `residual` is that of what was measured, then that of the priors; `jacobian` its
    derivatives in the scaled parameters; None in the results of `fit`.
    """

    sum_of_squares: float
    value: Float[np.ndarray, " P"]
    count: int
    standard_error: Float[np.ndarray, " P"] | None = None
    jacobian: Float[np.ndarray, "R P"] = None  # type: ignore[assignment]
    residual: Float[np.ndarray, " R"] = None  # type: ignore[assignment]


@dataclass(frozen=True, eq=False, kw_only=True)
class Solution:
    """All distinct minima, and what the law predicts at the best; `Fit` says what each
    field is.
    """

    starts: tuple[FitMinimum, ...]
    predicted: Float[np.ndarray, "*value"]
    status: Int[np.ndarray, " K"]
    slopes: Float[np.ndarray, "K n n"] | None = None
    pre: Float[np.ndarray, "K n"] | None = None
    converged: bool
    stuck: bool = False
    at_bound: Bool[np.ndarray, " P"]
    steps: int
    lost_starts: int

    @property
    def value(self) -> Float[np.ndarray, " P"]:
        """The parameters of the best minimum."""
        return self.starts[0].value


def solution_of(
    problem: FitProblem,
    ends: Ends,
    counts: Int[np.ndarray, " S"] | None = None,
    lost: int = 0,
) -> Solution:
    """The distinct minima among the ends of S solves, the best one first.

    Args:
        problem: that was solved.
        ends: of the solves.
        counts: number of starts that each end stands for; None: one each.
        lost: starts that were given up before.
    """
    if counts is None:
        counts = np.ones(len(ends.y), int)
    count = len(problem.names)
    measured = problem.measured
    # a residual has R rows: measured values, copies that fill up the shots, Q priors;
    # those in use
    first_prior = ends.residual.shape[1] - len(problem.variables.low)
    used = [
        *range(measured.size),
        *(first_prior + prior.parameter for prior in problem.priors),
    ]
    groups = _groups(problem, ends)
    minima = []
    best = groups[0][0]
    end = ends.rows(best)
    for group in groups:
        # starts that did not converge have no minimum to report, unless they are the
        # best there is
        kept = [i for i in group if ends.converged[i] or i == best]
        for i in kept[:1]:
            squares = float(ends.squares[i])
            value = problem.values_at(ends.y[i])
            jacobian = ends.jacobian[i][used, :count]
            residual = ends.residual[i][used]
            starts = int(counts[kept].sum())
            minima.append(FitMinimum(squares, value, starts, None, jacobian, residual))
    shots = slice(len(measured)) if measured.ndim else ...  # without copies
    return Solution(
        starts=tuple(minima),
        predicted=end.predicted[shots],
        status=end.status[shots],
        slopes=None if end.slopes is None else end.slopes[shots],
        pre=None if end.pre is None else end.pre[shots],
        converged=bool(end.converged),
        stuck=bool(end.stuck),
        at_bound=((end.y <= problem.variables.low) | (end.y >= problem.variables.high))[
            :count
        ],
        steps=int(np.max(ends.steps)),
        lost_starts=lost + int(counts.sum()) - sum(minimum.count for minimum in minima),
    )


def find_minima(
    problem: FitProblem, starts: int | None, seed: int, solver: Solver
) -> Solution:
    """The distinct minima of a problem by multistart; the best one is solved to full
    accuracy.

    Two thirds of the start points are random in the box. The law is only piecewise
    smooth, so that the sum of squares has side minima close to a minimum: the others
    lie around the best end. With `starts` None, start points are the lowest of many
    points, further ones around the best follow as long as they lower the sum of
    squares, and the search is repeated with twice as many other points where chi^2
    rejects the best minimum, as long as that helps.

    Args:
        problem: least squares.
        starts: number of start points, or None; one: the law's own values.
        seed: of the random points.
        solver: options.
    """
    rng = np.random.default_rng(seed)
    if starts == 1:
        points = start_points(problem, 1, rng)
        return solution_of(
            problem, minimize([problem.least_squares()], points, solver, what="starts")
        )

    def repeated(ends: Ends, turn: int) -> Ends | None:
        """Ends of twice as many other starts; None unless chi^2 rejects the best end so
        far.
        """
        least = np.nanmin(ends.squares)
        freedom = problem.values - len(problem.names)
        if problem.sigma is None or freedom < 1 or chdtrc(freedom, least) > REJECTED:
            return None
        return _rough_ends(problem, None, rng, solver, STARTS * 2 ** (turn + 1))

    ends = _rough_ends(problem, starts, rng, solver)
    rounds = 0 if starts else TURNS - 1
    ends = _extended(ends, rounds, len(problem.names), repeated)
    best = _groups(problem, ends)[0][:1]
    fine = minimize([problem.least_squares()], ends.y[best], solver, what="minima")
    fine = fine._replace(steps=fine.steps + ends.steps[best])
    # in the place of the rough end
    leaves = zip(jax.tree.leaves(ends), jax.tree.leaves(fine))
    for leaf, value in leaves:
        leaf[best] = value
    total = len(ends.y)
    solver.show(f"fit: {total} of {total} starts done", total, total)
    return solution_of(problem, ends)


def _rough_ends(
    problem: FitProblem,
    starts: int | None,
    rng: np.random.Generator,
    solver: Solver,
    most: int = STARTS,
) -> Ends:
    """Ends of random starts, then of starts around the best end, solved to the accuracy
    `COARSE`.

    That is enough to tell minima apart.

    Args:
        problem: least squares.
        starts: their number; None: `most`, chosen among many points by their sums of
            squares, and up to `ROUNDS` rounds around the best.
        rng: of the points.
        solver: options; Levenberg-Marquardt takes at most `ROUGH_STEPS`.
        most: number of starts in each round where `starts` is None.
    """
    count = starts or most
    if problem.sigma is None:
        noise = 0.0
    else:
        noise = 1.0
    # two thirds of the starts
    random = count - count // 3
    log = problem.parameters.log
    scanned = starts is None and bool(len(log) > 1 or log.any())
    if solver.method == "levenberg-marquardt":
        solver = solver._replace(max_steps=min(ROUGH_STEPS, solver.max_steps))

    def rough(points: Float[np.ndarray, "S Q"]) -> Ends:
        """Ends of solves from these points, to the accuracy `COARSE`."""
        return minimize(
            [problem.least_squares()], points, solver, COARSE, noise, "starts"
        )

    def around(ends: Ends, _: int) -> Ends | None:
        """Ends of starts around the best end; None if no such point is lower than those
        near it.
        """
        points = _near(
            problem, ends, SCANNED if scanned else count - random, noise, rng
        )
        if scanned:
            points = _lowest(problem, points, count - random)
        if len(points):
            return rough(points)
        return None

    ends = rough((_first_points if scanned else start_points)(problem, random, rng))
    if starts:
        rounds = 1
    else:
        rounds = ROUNDS
    return _extended(ends, rounds if count > random else 0, len(log), around)


def _extended(
    ends: Ends, rounds: int, parameters: int, search: Callable[[Ends, int], Ends | None]
) -> Ends:
    """The ends, and those of up to `rounds` further searches,
    `search(ends, number of the round)`.

    It stops where a search gives None, and after k rounds in a row that do not lower
    the least sum of squares by the variance of a residual, 1 / R of it; k = parameters
    / `IDLE_PARAMETERS`, rounded up.
    """
    idle = 0  # rounds without a gain, one after the other
    for k in range(rounds):
        more = search(ends, k)
        if more is None:
            break
        falls_by_chance = 1 - 1 / more.jacobian.shape[1]
        least = np.nanmin(ends.squares) * falls_by_chance
        if np.nanmin(more.squares) < least:
            idle = 0
        else:
            idle = idle + 1
        ends = jax.tree.map(lambda a, b: np.concatenate([a, b]), ends, more)
        if idle * IDLE_PARAMETERS >= parameters:
            break
    return ends


def _box(problem: FitProblem) -> Float[np.ndarray, "2 P"]:
    """Lowest and highest values of the variables y of random starts.

    The bounds; where there is none, and for ratios (fitted in their logarithm),
    `START_SCALES` or `log(START_FACTOR)` to each side of the law's own value at most. A
    restitution starts above `START_RESTITUTION`.
    """
    log = problem.parameters.log
    count = len(problem.names)
    start = problem.variables.point(problem.start)[:count]
    low, high = (
        np.array(end, float)[:count]
        for end in (problem.variables.low, problem.variables.high)
    )
    reach = np.where(log, np.log(START_FACTOR), START_SCALES)
    unbounded_low = log | np.isinf(low)
    low = np.where(unbounded_low, np.maximum(low, start - reach), low)
    unbounded_high = log | np.isinf(high)
    high = np.where(unbounded_high, np.minimum(high, start + reach), high)
    elastic = np.array(problem.parameters.of_fields) == "restitution"
    above = elastic & (high > START_RESTITUTION)
    low = np.where(above, np.maximum(low, START_RESTITUTION), low)
    return np.stack([low, high])


def start_points(
    problem: FitProblem, starts: int, rng: np.random.Generator
) -> Float[np.ndarray, "S Q"]:
    """Start points y: the law's own values, then S - 1 points of a Latin hypercube in
    `_box`.

    Equation: `y_ki = low_i + (high_i - low_i) (slice_ki + u_ki) / S`, each slice 0 .. S
    - 1 once for each variable, u uniform in [0, 1).
    """
    low, high = _box(problem)
    numbers = np.tile(np.arange(starts), (len(low), 1))
    slices = rng.permuted(numbers, axis=1).T
    first = problem.variables.point(problem.start)
    points = np.tile(first, (starts, 1))
    points[1:, : len(low)] = (
        low + (high - low) * (slices + rng.random(slices.shape)) / starts
    )[1:]
    return points


def _first_points(
    problem: FitProblem, count: int, rng: np.random.Generator
) -> Float[np.ndarray, "S Q"]:
    """Start points y: the law's own, and the lowest `count - 1` points of a Latin
    hypercube.

    With up to `SCANS` free ratios (fitted in their logarithm) also the lowest
    `count / 2` points of a line on which one ratio changes by up to `SCAN_FACTOR`.
    """
    ratios = np.flatnonzero(problem.parameters.log)
    corners = 2 ** len(problem.parameters.log)  # of the box of parameters
    scanned = max(SCANNED, SCANNED_A_CORNER * corners)
    points = start_points(problem, min(scanned, MOST_SCANNED), rng)
    lowest = _lowest(problem, points[1:], count - 1)
    chosen = [points[:1], lowest]
    for i in ratios if len(ratios) <= SCANS else ():
        line = np.tile(points[0], (SCANNED // 2, 1))
        reach = np.log(SCAN_FACTOR)
        line[:, i] += np.linspace(-reach, reach, len(line))
        chosen.append(
            _lowest(
                problem,
                np.clip(line, problem.variables.low, problem.variables.high),
                count // 2,
            )
        )
    return np.concatenate(chosen)


def _lowest(
    problem: FitProblem, points: Float[np.ndarray, "S Q"], count: int
) -> Float[np.ndarray, "L Q"]:
    """The points with lower sums of squares than their P + 1 nearest neighbours, lowest
    first.

    At most `count` of them. The impacts are computed with a coarse tolerance and few
    steps.
    """
    law = problem.law
    parameters = len(problem.names)
    if getattr(law, "rtol", SCAN_RTOL) is None:
        law = replace(law, rtol=SCAN_RTOL)  # type: ignore[call-arg]
    if isinstance(problem.observe, Shots) and hasattr(law, "max_steps"):
        steps = min(SCAN_STEPS * problem.observe.bodies, law.max_steps)
        law = replace(law, max_steps=steps)  # type: ignore[call-arg]
    one = replace(problem, law=law).for_compiled()
    many = stacked([one], len(points))
    squares = np.empty(len(points))
    for rows, part in in_parts(
        _squares, (many, points), SCAN_LANES, np.arange(len(points))
    ):
        squares[rows] = np.nan_to_num(part, nan=np.inf)
    width = np.ptp(points[:, :parameters], axis=0)  # distances are in units of it
    unit = np.where(width > 0, width, 1.0)
    apart = (points[:, None] - points)[..., :parameters] / unit
    # indices (S, P + 1) of the neighbours of each point, without itself
    squared_distance = np.sum(apart**2, axis=-1)
    nearest = np.argsort(squared_distance, axis=1)[:, 1 : parameters + 2]
    lowest = np.flatnonzero(squares < squares[nearest].min(axis=1))
    return points[lowest[np.argsort(squares[lowest])][:count]]


@quick_jit
def _squares(problems: Any, points: jax.Array) -> jax.Array:
    """`|r|^2` (S,) of S problems at y (S, Q), r scaled by `size` as in
    `LeastSquares`.
    """
    return eqx.filter_vmap(lambda problem, y: problem.squares(y))(problems, points)


def _near(
    problem: FitProblem, ends: Ends, count: int, noise: float, rng: np.random.Generator
) -> Float[np.ndarray, "S Q"]:
    """Random points y around the best end, and by turns around others that fit as well.

    Equation: `y = y_best + min(a error, START_SCALES) z`, cut at the bounds, with z
    standard normal, a between `NEAR_SPREAD` and `FAR_SPREAD` (log-uniform), and the
    standard errors `error^2 = s^2 diag((J^T J)^+)`, where s^2 is the mean squared
    residual, `noise^2` at least.
    """
    measured = int(np.sum(problem.measurement.weight > 0))
    variance = max(np.nanmin(ends.squares) / measured, noise**2)
    distinct = [group[0] for group in _groups(problem, ends)]
    as_good = ends.squares[distinct[0]] + variance
    best = [i for i in distinct if ends.squares[i] <= as_good]
    # directions that the data do not determine are not searched
    least = RANK_TOLERANCE[problem.precision] ** 2
    jacobian = np.nan_to_num(ends.jacobian[best])
    curvature = np.swapaxes(jacobian, 1, 2) @ jacobian
    inverse = np.linalg.pinv(curvature, rcond=least, hermitian=True)
    diagonal = np.diagonal(inverse, axis1=1, axis2=2)
    error = np.sqrt(variance * diagonal)
    # by turns: the index in `best` of each point's centre
    centre = np.arange(count) % len(best)
    logs = (np.log(NEAR_SPREAD), np.log(FAR_SPREAD))
    spread = np.exp(rng.uniform(*logs, (count, 1)))
    z = rng.normal(size=(count, len(error[0])))
    move = np.minimum(spread * error[centre], START_SCALES) * z
    moved = ends.y[best][centre] + move
    return np.clip(moved, problem.variables.low, problem.variables.high)


def _groups(problem: FitProblem, ends: Ends) -> list[list[int]]:
    """Indices of ends, grouped by the minimum they are in, the best minimum first.

    Two ends are one minimum if both sums of squares and parameters are equal, up to
    `SAME_COST` and `_same_values`. In a group a converged end comes first among equally
    good ones, then the earliest start: the first start is the law's own.
    """
    squares = ends.squares
    y = ends.y[:, : len(problem.names)]
    least = np.nanmin(ends.squares)
    unit = SAME_COST / ends.jacobian.shape[1]
    exact = problem.exact_squares
    equal = squares <= least * (1 + unit) + exact
    not_converged = ~ends.converged
    of_equal = np.where(equal, least, squares)
    order = np.lexsort((np.arange(len(y)), not_converged, of_equal))
    groups: list[list[int]] = []
    for i in order:
        for group in groups:
            first = group[0]
            allowed = unit * squares[first] + exact
            close = abs(squares[i] - squares[first]) <= allowed
            apart = y[i] - y[first]
            if close and _same_values(problem, ends, first, apart):
                group.append(int(i))
                break
        else:
            groups.append([int(i)])
    return groups


def _same_values(
    problem: FitProblem, ends: Ends, first: int, apart: Float[np.ndarray, " P"]
) -> bool:
    """True if scaled parameters that differ by `apart` from the end `first` are the
    same minimum.

    Along each right singular direction v of its Jacobian, of singular value s_v, they
    may differ by `max(SAME_ERRORS noise / s_v, SAME_VALUE)`: by a share of a standard
    error.
    """
    if np.abs(apart).max() < SAME_VALUE:
        return True
    jacobian = ends.jacobian[first][:, : len(apart)]
    if not np.isfinite(jacobian).all():
        return False
    _, singular, directions = np.linalg.svd(jacobian, full_matrices=False)
    determined = singular > RANK_TOLERANCE[problem.precision] * singular[0]
    noise = np.sqrt(ends.squares[first] / len(jacobian))
    divisor = np.where(determined, singular, 1.0)
    errors = np.where(determined, noise / divisor, 0.0)
    allowed = np.maximum(SAME_ERRORS * errors, SAME_VALUE)
    return bool((np.abs(directions @ apart) <= allowed).all())


def solved(
    problems: list[FitProblem],
    points: Float[np.ndarray, "S Q"],
    solver: Solver,
    stop: float = 0.0,
) -> tuple[list[FitProblem], Ends]:
    """Minima from points, as by `minimize`, and the problems with the errors that hold
    there.

    Errors of v- are passed on to v+ by the derivatives `dv+/dv-` of each problem's best
    minimum.
    """
    least_squares = [problem.least_squares() for problem in problems]
    ends = minimize(least_squares, points, solver, stop)
    if ends.slopes is None:
        return problems, ends
    starts = len(points) // len(problems)
    by_problem = ends.squares.reshape(-1, starts)
    best = np.nanargmin(by_problem, axis=1)
    first = np.arange(0, len(points), starts)
    slopes = ends.slopes[first + best]
    pairs = zip(problems, slopes)
    return [p.with_errors_before(slope) for p, slope in pairs], ends


# ---------------------------------------------------------------------------- robust
# losses


def robust_minimum(
    problem: FitProblem, solution: Solution, loss: str, solver: Solver
) -> tuple[FitProblem, Solution, float]:
    """M-estimate of a loss, by iteratively reweighted least squares: problem, solution,
    and noise.

    Equation: weights `psi(u) / u` of the last residuals `u = r / s`, s = 1 or, of
    unknown sigma, `MEDIAN median|r|`. The covariance is
    `s^2 mean(psi^2) / mean(psi')^2 (J^T J)^-1` (Huber, 1981); the noise returned is
    `s |psi| / mean(psi')`, a noise times the root of the degrees of freedom.
    """
    for _ in range(LOSS_ROUNDS):
        problem = problem.with_errors_before(solution.slopes)
        residuals = _robust_residuals(problem, solution, loss)
        point = problem.variables.point(solution.value)
        solution = _reweighted(problem, solution, np.sqrt(residuals.weight), solver)
        moved = np.abs(problem.variables.point(solution.value) - point).max()
        if moved <= SETTLED:
            break
    else:
        solution = replace(solution, converged=False)
    problem = problem.with_errors_before(solution.slopes)
    measured = ~np.isnan(problem.measured)
    psi = (residuals.weight * residuals.error / residuals.scale)[measured]
    slope = max(residuals.slope[measured].mean(), LEAST_SLOPE)
    noise = residuals.scale * np.sqrt(np.sum(psi**2)) / slope
    # weighted as in the problem, without the factors of the loss
    starts = solution_of(problem, outcome_at(problem, solution.value)).starts
    return problem, replace(solution, starts=starts), float(noise)


class _RobustResiduals(NamedTuple):
    """Residuals r `error` (K, n) of variance 1, their scale s, and `psi(u) / u`
    `weight`, `psi'(u)` `slope` (K, n) of a loss at u = r / s.
    """

    error: np.ndarray
    scale: float
    weight: np.ndarray
    slope: np.ndarray


def _robust_residuals(
    problem: FitProblem, solution: Solution, loss: str
) -> _RobustResiduals:
    """Residuals at a solution, s = 1 or, of unknown sigma, `MEDIAN median|r|`, and what
    the loss makes of them.
    """
    error = problem.measurement.independent(problem.measured - solution.predicted)
    scale = 1.0
    if problem.sigma is None:
        size = np.abs(error[~np.isnan(problem.measured)])
        median = float(np.median(size))
        scale = max(MEDIAN * median, np.finfo(float).tiny)
    weight, slope = LOSSES[loss](error / scale)
    return _RobustResiduals(error, scale, weight, slope)


def _reweighted(
    problem: FitProblem, solution: Solution, factor: np.ndarray, solver: Solver
) -> Solution:
    """Least squares from a solution on, with residuals `factor` (K, n) times as large.

    The true v- of the last solution are held meanwhile, if v- have errors; afterwards
    they follow the parameters.
    """
    held = problem
    if solution.pre is not None and solution.slopes is not None:
        held = problem.held(solution.pre, solution.slopes)
    weighed = held.weighed(factor)
    point = problem.variables.point(solution.value)
    ends = minimize([weighed.least_squares()], point[None], solver)
    new = solution_of(weighed, ends)
    if problem.before is None:
        return new
    there = solution_of(problem, outcome_at(problem, new.value))
    return replace(
        new,
        predicted=there.predicted,
        status=there.status,
        slopes=there.slopes,
        pre=there.pre,
    )
