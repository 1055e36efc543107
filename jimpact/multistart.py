"""Many starts at once, and the distinct minima they end in."""

import contextlib
import sys
import threading
from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from jimpact.fit_problem import Problem, advance_all, begin_all
from jimpact.numerics.least_squares import Method, State
from jimpact.parameters import LOGARITHMIC

PASSES = 10  # between two looks at the progress

# Random starts: a stiffness within this factor of the user's, a parameter without two bounds
# within this many natural scales of the user's.
START_FACTOR = 20.0
START_SCALES = 2.0

# Relative sums of squares, and values in natural scales, closer than this are one minimum: a
# hundred times what solvers leave, and far below what a measurement resolves.
SAME_COST = 1e-6
SAME_VALUE = 1e-3
# Mean squares (relative to the velocities) below this are a perfect fit: rounding and the
# tolerance of the impact.
EXACT = {"float64": 1e-14, "float32": 1e-8}

BAR_AFTER = 2.0  # seconds after which a fit counts as long


class Search(NamedTuple):
    """The best end point (weighted as in `Problem`), and all distinct minima, best first."""

    value: np.ndarray
    residual: np.ndarray
    jacobian: np.ndarray  # of the scaled parameters
    velocity: np.ndarray
    status: np.ndarray
    gain: float  # relative decrease of the sum of squares that a further step promises
    at_bound: np.ndarray
    steps: int
    minima: list[tuple[float, np.ndarray, int]]  # |r|^2, values, how many starts
    unfinished: int  # starts that ran out of steps


def search(
    problem: Problem,
    method: Method,
    starts: int,
    seed: int,
    max_steps: int,
    progress: bool | None,
) -> Search:
    """Run all starts to their ends and keep the best."""
    points = jnp.asarray(_start_points(problem, starts, seed), problem.pre.dtype)
    states = begin_all(problem, points, method, max_steps)
    with _bar(starts, max_steps, progress) as show:
        while True:
            states = advance_all(problem, states, method, max_steps, PASSES)
            done, steps = np.asarray(states.done), np.asarray(states.steps)
            show(int(done.sum()), int(steps.max()))
            if (done | (steps >= max_steps)).all():
                return _found(problem, states)


def _found(problem: Problem, states: State) -> Search:
    y, low, high = (np.asarray(x) for x in (states.y, problem.low, problem.high))
    squares = 2 * np.asarray(states.cost, float)
    values = np.array([problem.scaling.to_value(row) for row in states.y], float)
    groups = _groups(squares, y, EXACT[str(y.dtype)])
    best = groups[0][0]
    velocity, status = states.kept
    # starts that ran out of steps have no minimum to tell, unless they are the best there is
    ends = [[i for i in g if bool(states.done[i]) or i == best] for g in groups]
    return Search(
        value=values[best],
        residual=np.asarray(states.residual[best], float),
        jacobian=np.asarray(states.jacobian[best], float),
        velocity=np.asarray(velocity[best], float),
        status=np.asarray(status[best]),
        gain=2 * float(states.gain[best]) / squares[best] if squares[best] > 0 else 0.0,
        at_bound=(y[best] <= low) | (y[best] >= high),
        steps=int(np.max(states.steps)),
        minima=[(float(squares[g[0]]), values[g[0]], len(g)) for g in ends if g],
        unfinished=len(y) - sum(len(g) for g in ends),
    )


def _groups(squares: np.ndarray, y: np.ndarray, exact: float) -> list[list[int]]:
    """Starts that ended in the same minimum, best minimum first.

    Among equally good ones the earliest start comes first: it began at the user's own values.
    """
    groups: list[list[int]] = []
    least = np.nanmin(squares)
    equal = squares <= least + SAME_COST * least + exact
    for i in np.lexsort((np.arange(len(y)), np.where(equal, least, squares))):
        for group in groups:
            first = group[0]
            close = abs(squares[i] - squares[first]) <= SAME_COST * squares[first] + exact
            if close and np.abs(y[i] - y[first]).max() < SAME_VALUE:
                group.append(int(i))
                break
        else:
            groups.append([int(i)])
    return groups


def _start_points(problem: Problem, starts: int, seed: int) -> np.ndarray:
    """Starts y (S, P): the law's own values, then random ones inside the bounds."""
    own = problem.scaling.from_value(problem.parameters.of(problem.law))
    low, high = np.asarray(problem.low, float), np.asarray(problem.high, float)
    first, last = low.copy(), high.copy()
    for i, field, _ in problem.parameters.each():
        reach = np.log(START_FACTOR) if field in LOGARITHMIC else START_SCALES
        if field in LOGARITHMIC or not np.isfinite(low[i]):
            first[i] = max(low[i], own[i] - reach)
        if field in LOGARITHMIC or not np.isfinite(high[i]):
            last[i] = min(high[i], own[i] + reach)
    points = first + (last - first) * np.random.default_rng(seed).random((starts, len(own)))
    points[0] = own
    return points


@contextlib.contextmanager
def _bar(
    starts: int, max_steps: int, progress: bool | None
) -> Iterator[Callable[[int, int], None]]:
    """Yield `show(starts done, steps)`; the bar appears once the fit turns out to be long."""
    if not (sys.stderr.isatty() if progress is None else progress):
        yield lambda done, steps: None
        return
    text = TextColumn("fit: {task.fields[ready]} of {task.fields[starts]} starts done, step")
    count = TextColumn("{task.completed} of at most {task.total}")
    bar = Progress(
        text, count, BarColumn(), TimeElapsedColumn(), console=Console(stderr=True), transient=True
    )
    task = bar.add_task("fit", total=max_steps, ready=0, starts=starts)
    timer = threading.Timer(0.0 if progress else BAR_AFTER, bar.start)
    timer.start()
    try:
        yield lambda done, steps: bar.update(task, completed=steps, ready=done)
    finally:
        timer.cancel()
        bar.stop()
