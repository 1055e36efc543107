"""Profile likelihoods: how well the data are fitted with one parameter fixed, all others free.

A standard error is half the width of a parabola. Where the sum of squares is not a parabola (at a
bound, in a flat valley, with several minima), the profile gives the interval: one-sided, or of
several pieces.
"""

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from jimpact._checks import as_whole, check_choice
from jimpact.fits.intervals import Profile, check_level
from jimpact.fits.problem import FEW
from jimpact.fits.result import FitResult
from jimpact.fits.scaled import ScaledFit, check_profiled, with_entry
from jimpact.fits.solve import DEFAULT_STEPS, SolverState
from jimpact.progress import Show, progress_bar

NEAR = np.array([-2, -1.5, -1, -0.5, 0.5, 1, 1.5, 2])  # half-widths of the interval of a parabola
SAME = 1e-6  # relative sums of squares that are equal
END = 1e-3  # of the root of the limit: how near to it an end is searched for
FAR, ROUGH = 2.0, 2  # times the limit beyond which only ROUGH passes are spent
MANY = 256  # shots up to which they take half as long as a fit with eight starts
# Parameters up to which `fit` profiles of itself: with four of LZB that takes several times as long
# as the search, and the report names `ji.profile` in its place.
MOST_PARAMETERS = 3
QUICK_POINTS, QUICK_LEVEL = 17, 0.95  # of the profiles that `fit` computes by default: fixed values
LONGEST = 2.0  # steps by which a scan is extrapolated
ROUNDS = 8  # of the search for an end: it is then right to a millionth of a grid cell, mostly


def profile(
    fit: FitResult,
    names: str | Iterable[str] | None = None,
    *,
    level: float = 0.95,
    points: int = 33,
    progress: float | None = None,
) -> tuple[Profile, ...]:
    """Profile likelihoods of parameters: intervals without the assumption of a parabola.

    Equation: `D(x_i) = (min over the others of |r|^2 - least |r|^2) / s^2 <= q^2`, q the quantile
    of the normal law where sigma is known (s = 1), else of Student's t (s = `fit.noise`).

    Fixed values cover the whole domain and the neighbourhood of the minima; from each minimum they
    are reached one after the other in both directions, all parameters side by side; far above the
    limit they are computed only roughly. Where a scan finds a further valley, it is followed to its
    minimum. Without sigma and with no degree of freedom left, the interval is that of the values
    which reproduce the data exactly.

    Args:
        fit: by least squares.
        names: of parameters; None: all.
        level: of the confidence intervals, in (0, 1).
        points: fixed values across the domain, besides those near the minimum, at least 3.
        progress: bar on stderr; None: on a terminal, once it takes longer than two seconds.

    Returns:
        A `Profile` for each name; `print` says its interval.

    Raises:
        ValueError: level, points or names; a robust loss; a matrix that must be admissible.

    >>> import jimpact as ji
    >>> data = ji.Experiments([[1.0, 0.0], [2.0, 0.0]], [[0.01, 0.98], [0.0, 2.01]], sigma=0.02)
    >>> result = ji.fit(ji.Newton(0.9), ji.chain([1.0, 1.0]), data)
    >>> print(*ji.profile(result))
    restitution: at least 0.97321 (95 %)
    """
    check_level(level)
    as_whole("points", points, 3)
    check_profiled(fit)
    wanted = fit.names if names is None else (names,) if isinstance(names, str) else tuple(names)
    for name in wanted:
        check_choice("names", name, fit.names)
    with progress_bar(progress) as show:
        scans = _Scans(fit, [fit.names.index(name) for name in wanted], level, show)
        scans.scan(points, FAR, whole=True)
        scans.follow_valleys()
        scans.finish(FAR)
    return tuple(scans.profile(i) for i in scans.which)


def quick_profiles(fit: FitResult, progress: float | None) -> tuple[Profile, ...]:
    """Profiles of all parameters around the minima that are known, no farther than is needed."""
    with progress_bar(progress) as show:
        scans = _Scans(fit, range(len(fit.names)), QUICK_LEVEL, show)
        scans.scan(QUICK_POINTS, 1.0)
        scans.finish(1.0)
    return tuple(scans.profile(i) for i in scans.which)


class _Scans(ScaledFit):
    """Held values of parameters and the minima with them, in scaled form, as far as known."""

    def __init__(self, fit: FitResult, which: Sequence[int], level: float, show: Show):
        super().__init__(fit)
        self.which, self.level, self.show = which, level, show
        self.limit = fit.quantile(level) ** 2  # deviance at the ends of an interval
        # of each parameter: fixed value -> (sum of squares, y)
        self.solved: dict[int, dict[float, tuple[float, np.ndarray]]] = {
            i: {float(self.best[i]): (self.least, self.best)} for i in which
        }
        for start in fit.starts[1:]:
            y = self.problem.point(start.value)
            for i in which:
                self.solved[i].setdefault(float(y[i]), (start.sum_of_squares, y))
        self.lower: np.ndarray | None = None  # a point below the minimum of the fit
        self.grid: dict[int, np.ndarray] = {}  # values to hold
        self.rough: set[tuple[int, float]] = set()  # what was not solved to its end

    def minima(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """y (Q,) of the minima that fit well enough, and scaled standard errors (P,)."""
        fit = self.fit
        minima: list[tuple[np.ndarray, np.ndarray | None]] = [(fit.value, fit.standard_error)]
        if fit.rank == len(fit.names):  # else they are ends in one valley
            minima += [(end.value, end.standard_error) for end in fit.starts[1:]]
        return [
            (self.problem.point(value), error / np.where(self.log, value, self.scale))
            for value, error in minima
            if error is not None
        ]

    def near(self, i: int, y: np.ndarray, error: float) -> np.ndarray:
        """Values to hold near a minimum."""
        if not np.isfinite(error):
            return np.zeros(0)
        reach = error * np.sqrt(self.limit)
        return np.clip(y[i] + reach * NEAR, self.low[i], self.high[i])

    def scan(self, points: int, far: float, whole: bool = False) -> None:
        """Deviances across the domains, as far as they are at most `far` times the limit.

        The whole domain: beyond, too, but only roughly: enough to see other valleys.
        """
        values: dict[int, np.ndarray] = {}
        fronts: list[_Front] = []
        for i in self.which:
            parts = [np.linspace(*self.reach(i), points)]
            for y, error in self.minima():
                parts.append(self.near(i, y, float(error[i])))
                fronts += [_Front(i, step, y) for step in (-1, 1)]
            values[i] = np.unique(np.concatenate(parts))
        self.grid = values
        alone = len(self.fit.names) == 1  # no other parameter to solve for
        if not (whole and alone):
            self.advance(fronts, values, far * self.limit)
        if whole:
            left = [(i, x) for i in self.which for x in values[i] if x not in self.solved[i]]
            rough = [(i, with_entry(self._nearest(i, x), i, x)) for i, x in left]
            if alone:
                self._solve(rough)
            else:
                self._solve(rough, ROUGH)
                self.rough = {(i, float(x)) for i, x in left}

    def advance(self, fronts: list["_Front"], values: Mapping[int, np.ndarray], far: float) -> None:
        """From value to value, each from its neighbour's minimum, until others have been there."""
        while True:
            ahead = [(f, f.next(values[f.i], self.low, self.high)) for f in fronts]
            moving = [(f, y) for f, y in ahead if y is not None]
            if not moving:
                return
            known = [self.solved[f.i].get(float(y[f.i]), (np.inf, y))[0] for f, y in moving]
            ends = self._solve([(f.i, y) for f, y in moving])
            # where a scan leaves the interval it may be on a ridge: once more from the fit
            leaving = [
                k
                for k, ((f, _), (squares, _)) in enumerate(zip(moving, ends))
                if self.deviance_of(squares) > self.limit >= self._deviance_at(f)
            ]
            again = [(moving[k][0].i, moving[k][1]) for k in leaving]
            again = [(i, with_entry(self.best, i, y[i])) for i, y in again]
            for k, end in zip(leaving, self._solve(again)):
                ends[k] = min(ends[k], end, key=_squares)
            fronts = []
            for (f, _), before, end in zip(moving, known, ends):
                squares, y = end
                first = squares < (1 - SAME) * before and self.solved[f.i][float(y[f.i])] is end
                if first and self.deviance_of(squares) <= far:
                    fronts.append(_Front(f.i, f.step, y, f.last))

    def _solve(
        self,
        fixed: Sequence[tuple[int, np.ndarray]],
        steps: int = DEFAULT_STEPS["levenberg-marquardt"],
    ) -> list[tuple[float, np.ndarray]]:
        """Minimize with the i-th entry of each y fixed, and store what improves on the known."""
        if not fixed:
            return []
        squares, states = self.minimize(fixed, self.show, steps)
        ends = []
        for k, (i, y) in enumerate(fixed):
            ends.append((float(squares[k]), with_entry(np.asarray(states.y[k]), i, y[i])))
            if not squares[k] >= self.solved[i].get(float(y[i]), (np.inf, y))[0]:
                self.solved[i][float(y[i])] = ends[-1]
        all_ends = (end for solved in self.solved.values() for end in solved.values())
        best = min(all_ends, key=_squares)
        if best[0] < self.least * (1 - SAME) - self.problem.exact_squares:
            self._lower(*best)
        return ends

    def _lower(self, squares: float, y: np.ndarray) -> None:
        """A point below all others: all parameters get it, whichever's scan found it."""
        self.least, self.lower = squares, y
        for i in self.which:
            self.solved[i][float(y[i])] = (squares, y)

    def _nearest(self, i: int, y: float) -> np.ndarray:
        """The minimum with the fixed value that is nearest to y."""
        return self.solved[i][min(self.solved[i], key=lambda known: abs(known - y))][1]

    def deviance(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        """Fixed values and their deviances."""
        values = np.array(sorted(self.solved[i]))
        squares = np.array([self.solved[i][y][0] for y in values])
        return values, np.maximum(self.deviance_of(squares), 0.0)

    def _deviance_at(self, front: "_Front") -> float:
        """The least deviance known where a front has come to."""
        known = self.solved[front.i].get(float(front.last[front.i]))
        return self.deviance_of(self.least if known is None else known[0])

    def follow_valleys(self) -> None:
        """Held values around the minima that further valleys of the scans lead to."""
        starts = []
        for i in self.which:
            values, d = self.deviance(i)
            inside = np.flatnonzero((d[1:-1] < d[:-2]) & (d[1:-1] <= d[2:])) + 1
            starts += [
                (i, self.solved[i][values[k]][1])
                for k in inside
                if d[k] > self.limit or (i, values[k]) in self.rough
            ]
        if not starts:
            return
        squares, states = self.minimize([((), y) for _, y in starts], self.show)
        fronts: list[_Front] = []
        near: dict[int, np.ndarray] = {}
        for k, (i, _) in enumerate(starts):
            y = np.asarray(states.y[k], float)
            if self.deviance_of(squares[k]) <= self.limit:
                self.solved[i].setdefault(float(y[i]), (float(squares[k]), y))
                more = self.near(i, y, self._error(i, states, k))
                near[i] = np.unique(np.concatenate([near.get(i, np.zeros(0)), more]))
                fronts += [_Front(i, step, y) for step in (-1, 1)]
        self.advance(fronts, near, np.inf)

    def _error(self, i: int, states: SolverState, k: int) -> float:
        """Scaled standard error of the i-th parameter at the k-th of these ends."""
        jacobian = np.asarray(states.jacobian[k], float)[:, : len(self.fit.names)]
        inverse = np.linalg.pinv(self.size**2 * jacobian.T @ jacobian)
        return float(np.sqrt(self.variance * inverse[i, i]))

    def finish(self, far: float) -> None:
        """The ends of the intervals, and what lies around a minimum below that of the fit."""
        followed = None
        for _ in range(ROUNDS):
            if self.lower is not None and self.lower is not followed:
                self._scan_from_lower(far)
                followed = self.lower
            self.find_ends()
            if not self.fill_holes() and self.lower is followed:
                return

    def _scan_from_lower(self, far: float) -> None:
        """Scan all parameters from the minimum that a scan of one of them has led to."""
        assert self.lower is not None
        squares, states = self.minimize([((), self.lower)], self.show)
        if squares[0] < self.least:
            self._lower(float(squares[0]), np.asarray(states.y[0], float))
        fronts, values = [], {}
        for i in self.which:
            near = self.near(i, self.lower, self._error(i, states, 0))
            values[i] = np.unique(np.concatenate([self.grid[i], near]))
            fronts += [_Front(i, step, self.lower) for step in (-1, 1)]
        self.advance(fronts, values, far * self.limit)

    def fill_holes(self) -> bool:
        """Try again between two pieces, from straight lines: whether a hole was an artefact."""
        trials = []
        for i in self.which:
            values, d = self.deviance(i)
            inside = np.flatnonzero(d <= self.limit)
            for a, b in pairwise(inside):
                start, end = (self.solved[i][values[k]][1] for k in (a, b))
                for value in values[a + 1 : b]:
                    share = (value - values[a]) / (values[b] - values[a])
                    trials.append((i, with_entry(start + share * (end - start), i, value)))
        ends = self._solve(trials)
        return any(self.deviance_of(squares) <= self.limit for squares, _ in ends)

    def find_ends(self) -> None:
        """Where deviances pass the limit: regula falsi in their roots, all ends side by side."""
        limit = np.sqrt(self.limit)
        for turn in range(ROUNDS):
            trials = []
            for i in self.which:
                values, d = self.deviance(i)
                height = np.sqrt(d) - limit
                for k in np.flatnonzero((height[:-1] <= 0) != (height[1:] <= 0)):
                    a, b, p, q = values[k], values[k + 1], height[k], height[k + 1]
                    if min(abs(p), abs(q)) <= END * limit:
                        continue
                    share = p / (p - q) if turn % 3 < 2 and np.isfinite(q - p) else 0.5
                    y = a + np.clip(share, 0.02, 0.98) * (b - a)
                    if a < y < b and abs(b - a) > 1e-6 * max(1.0, abs(a)):
                        trials.append((i, with_entry(self._nearest(i, y), i, y)))
            if not trials:
                return
            self._solve(trials)

    def profile(self, i: int) -> Profile:
        """The profile of a parameter from all that was solved."""
        y, deviance = self.deviance(i)
        below = np.flatnonzero(deviance <= self.limit)
        pieces = np.split(below, np.flatnonzero(np.diff(below) > 1) + 1)
        low, high = self.problem.domains[i]
        return Profile(
            name=self.fit.names[i],
            value=self.values(i, y),
            deviance=deviance,
            limit=self.limit,
            level=self.level,
            intervals=tuple(
                (self._end(i, y, deviance, piece[0], -1), self._end(i, y, deviance, piece[-1], 1))
                for piece in pieces
            ),
            domain=(float(low), float(high)),
            better=None if self.lower is None else self.problem.values_at(self.lower),
        )

    def _end(self, i: int, y: np.ndarray, deviance: np.ndarray, k: int, step: int) -> float:
        """Where the deviance passes the limit beyond the k-th fixed value, or the domain's end."""
        beyond = k + step
        if not 0 <= beyond < len(y):
            return float(self.problem.domains[i][(step + 1) // 2])
        p, q = np.sqrt(deviance[k]), np.sqrt(deviance[beyond])
        share = (np.sqrt(self.limit) - p) / (q - p)
        end = y[k] + share * (y[beyond] - y[k])
        return float(self.values(i, np.array([end]))[0])


class _Front(NamedTuple):
    """How far the scan of the i-th parameter has come in one direction."""

    i: int
    step: int  # -1 or 1
    last: np.ndarray
    before: np.ndarray | None = None

    def next(self, values: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray | None:
        """Where to start at the next of the values: on a straight line; None at the end."""
        i, last = self.i, self.last
        ahead = values[(values - last[i]) * self.step > 0]
        if len(ahead) == 0:
            return None
        value = ahead[0] if self.step > 0 else ahead[-1]
        y = last
        if self.before is not None:
            share = (value - last[i]) / (last[i] - self.before[i])
            y = np.clip(last + min(share, LONGEST) * (last - self.before), low, high)
        return with_entry(y, i, value)


def needs_profiles(fit: FitResult) -> bool:
    """Whether standard errors may mislead, and profiles cost no more than the fit did.

    Not after lack of fit: no interval of such a law means anything, and its valleys are rough.
    """
    most = FEW if fit.start_count == 1 else MANY
    few = fit.experiments is not None and len(fit.predicted) <= most
    few &= len(fit.names) <= MOST_PARAMETERS
    return few and fit.linearization_misleads and not fit.shows_lack_of_fit


def _squares(end: tuple[float, np.ndarray]) -> float:
    """Sum of squares of an end, to compare ends by."""
    return end[0]
