"""Many starts, the distinct minima they end in, and minima that lie on a bound."""

import contextlib
import sys
import threading
from collections.abc import Iterator
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from jimpact.fit_problem import Evaluation, Problem, evaluate, solve
from jimpact.numerics.least_squares import Method
from jimpact.parameters import LOGARITHMIC, START_FACTOR, START_SCALES

LANES = 4  # starts that run together: compiled once, and a long fit reports between batches

START_MARGIN = 0.01  # share of an interval by which a start is kept off its bounds
RESTART_MARGIN = 1e-6  # the same when a found minimum is refined
NEAR_BOUND = 1e-2  # share of the natural scale within which the bound itself is tried
SAME_COST = 1e-6  # relative sums of squares closer than this are one: the solver stops there
SAME_VALUE = 1e-3  # values closer than this, in natural scales, are one minimum
BAR_AFTER = 2.0  # seconds after which a fit counts as long


class Search(NamedTuple):
    """Best evaluation, which parameters lie on a bound, steps taken, distinct minima."""

    best: Evaluation
    at_bound: np.ndarray
    steps: int
    minima: list[tuple[float, np.ndarray, int]]  # sum of squares, values, starts


def search(
    problem: Problem,
    limits: tuple[np.ndarray, np.ndarray],
    method: Method,
    starts: int,
    seed: int,
    max_steps: int,
    progress: bool | None,
) -> Search:
    """Run all starts, keep the best, then try the bounds it comes near to."""
    points = _start_points(problem, limits, starts, seed)
    free = np.zeros(points.shape[1], bool)
    ends: list[Evaluation] = []
    longest = 0
    with _bar(starts, progress) as advance:
        for first in range(0, starts, LANES):
            batch = points[first : first + LANES]
            found, steps = _run(problem, batch, START_MARGIN, [free] * len(batch), method, max_steps)
            ends += found
            longest = max(longest, steps)
            advance(len(batch))
    best = min(ends, key=lambda end: end.sum_of_squares)
    minima = _distinct(problem, ends)
    best, at_bound = _try_bounds(problem, limits, best, method, max_steps)
    minima[0] = (best.sum_of_squares, best.value, minima[0][2])
    return Search(best, at_bound, longest, minima)


def _start_points(
    problem: Problem, limits: tuple[np.ndarray, np.ndarray], starts: int, seed: int
) -> np.ndarray:
    """Starts (S, P): the law's own values, then random ones inside the bounds."""
    rng = np.random.default_rng(seed)
    own = problem.parameters.of(problem.law)
    share = rng.random((starts, len(own)))
    low, high = (np.array(end) for end in limits)
    points = np.empty_like(share)
    for i, field, _ in problem.parameters.each():
        if field in LOGARITHMIC:
            near = max(low[i], own[i] / START_FACTOR), min(high[i], own[i] * START_FACTOR)
            points[:, i] = near[0] * (near[1] / near[0]) ** share[:, i]
            continue
        around = own[i] + START_SCALES * problem.scale[i] * np.array([-1.0, 1.0])
        ends = [b if np.isfinite(b) else a for a, b in zip(around, (low[i], high[i]))]
        points[:, i] = ends[0] + (ends[1] - ends[0]) * share[:, i]
    points[0] = own
    return points


def _run(
    problem: Problem,
    points: np.ndarray,
    margin: float,
    held: list[np.ndarray],
    method: Method,
    max_steps: int,
) -> tuple[list[Evaluation], int]:
    """Solve from up to LANES points (fewer are padded) and evaluate where they end."""
    rows = [min(i, len(points) - 1) for i in range(LANES)]
    x = jnp.asarray(points[rows], problem.pre.dtype)
    mask = jnp.asarray(np.array(held)[rows])
    z = problem.interval.from_bounded(x, margin)
    x, steps = solve(problem, z, mask, x, method, max_steps)
    results = [np.asarray(a, float) for a in (x, *evaluate(problem, x))]
    ends = [
        Evaluation(value, r, jac, v, status.astype(int))
        for value, r, jac, v, status in zip(*results)
    ]
    return ends[: len(points)], int(np.max(steps))


def _distinct(problem: Problem, ends: list[Evaluation]) -> list[tuple[float, np.ndarray, int]]:
    """Minima with the number of starts that ended in each, best first."""
    minima: list[tuple[float, np.ndarray, int]] = []
    size = float(np.sum((np.asarray(problem.weight) * problem.unit) ** 2))
    for end in sorted(ends, key=lambda end: end.sum_of_squares):
        for i, (cost, value, count) in enumerate(minima):
            same_cost = end.sum_of_squares - cost <= SAME_COST * (cost + SAME_COST * size)
            if same_cost and _apart(problem, end.value, value) < SAME_VALUE:
                minima[i] = (cost, value, count + 1)
                break
        else:
            minima.append((end.sum_of_squares, end.value, 1))
    return minima


def _apart(problem: Problem, a: np.ndarray, b: np.ndarray) -> float:
    """Largest difference in natural scales (of the logarithm where that is fitted)."""
    log = np.asarray(problem.interval.log)
    ratio = np.log(np.where(log, a, 1.0) / np.where(log, b, 1.0))
    return float(np.abs(np.where(log, ratio, (a - b) / problem.scale)).max())


def _try_bounds(
    problem: Problem,
    limits: tuple[np.ndarray, np.ndarray],
    best: Evaluation,
    method: Method,
    max_steps: int,
) -> tuple[Evaluation, np.ndarray]:
    """Put parameters near a bound on it, all or one at a time, where that fits as well."""
    low, high = limits
    nearest = np.where(best.value - low < high - best.value, low, high)
    gap = np.array([_gap(problem, i, best.value, nearest) for i in range(len(nearest))])
    near = np.flatnonzero(gap < NEAR_BOUND)
    if len(near) == 0:
        return best, np.zeros(len(nearest), bool)
    choices = [near, *([i] for i in near if len(near) > 1)][:LANES]
    held = [np.isin(np.arange(len(nearest)), choice) for choice in choices]
    points = np.array([np.where(mask, nearest, best.value) for mask in held])
    ends, _ = _run(problem, points, RESTART_MARGIN, held, method, max_steps)
    order = np.argsort([end.sum_of_squares for end in ends], kind="stable")
    winner = int(order[0])
    if ends[winner].sum_of_squares > (1 + SAME_COST) * best.sum_of_squares:
        return best, np.zeros(len(nearest), bool)
    return ends[winner], held[winner]


def _gap(problem: Problem, i: int, value: np.ndarray, bound: np.ndarray) -> float:
    if not np.isfinite(bound[i]):
        return np.inf
    if bool(problem.interval.log[i]):
        return float(abs(np.log(value[i] / bound[i])))
    return float(abs(value[i] - bound[i]) / problem.scale[i])


@contextlib.contextmanager
def _bar(starts: int, progress: bool | None) -> Iterator:
    """Yield `advance(count)`; the bar appears on a terminal once the fit turns out long."""
    show = sys.stderr.isatty() if progress is None else progress
    if not show:
        yield lambda count: None
        return
    columns = (TextColumn("fit: {task.completed}/{task.total} starts"), BarColumn())
    bar = Progress(*columns, TimeRemainingColumn(), console=Console(stderr=True), transient=True)
    task = bar.add_task("fit", total=starts)
    timer = threading.Timer(0.0 if progress else BAR_AFTER, bar.start)
    timer.start()
    try:
        yield lambda count: bar.advance(task, count)
    finally:
        timer.cancel()
        bar.stop()
