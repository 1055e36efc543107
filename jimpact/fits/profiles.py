"""Intervals that are true: how well the data are fitted with one parameter held, all others free.

A standard error is half the width of a parabola. Where the sum of squares is none (a bound, a flat
valley, several minima), the profile is the interval: one-sided, or of several pieces.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.special import ndtri, stdtrit

from jimpact._checks import check_kind
from jimpact.fits.least_squares import DEFAULT_STEPS, Box, SolverState
from jimpact.fits.multistart import EXACT, START_SCALES, run_held
from jimpact.fits.problem import FEW, Residuals, filled_up, from_scaled, to_scaled
from jimpact.progress import progress_bar

if TYPE_CHECKING:
    from jimpact.fits.fitting import Fit

NEAR = np.array([-2, -1.5, -1, -0.5, 0.5, 1, 1.5, 2])  # half-widths of the interval of a parabola
SAME = 1e-6  # relative sums of squares that are equal
END = 1e-3  # of the root of the limit: how near to it an end is searched for
FAR, ROUGH = 2.0, 2  # times the limit from which only so many passes are spent
MANY = 256  # shots up to which they take half as long as a fit with eight starts
QUICK_POINTS, QUICK_LEVEL = 17, 0.95  # what `fit` profiles of itself: values across the domain
HARDLY_SEEN = 0.2  # relative error of a stiffness beyond which no parabola is believed
LONGEST = 2.0  # steps by which a scan is extrapolated
ROUNDS = 8  # of the search for an end: it is then right to a millionth of a grid cell, mostly
_METHOD = "levenberg-marquardt"


@dataclass(frozen=True, eq=False)
class Profile:
    """`deviance` (G,) over the `value`s (G,) of parameter `name`, and where it is below `limit`.

    `deviance` is the sum of squares with the parameter held, less its least value, over the noise
    variance. `intervals` are the pieces of the confidence interval at `level`, in order; an end at
    `domain` is none: the data do not bound the parameter there. `better`: values of a minimum below
    that of the fit, or None.
    """

    name: str
    value: np.ndarray
    deviance: np.ndarray
    limit: float
    level: float
    intervals: tuple[tuple[float, float], ...]
    domain: tuple[float, float]
    better: np.ndarray | None = None

    @property
    def words(self) -> str:
        """The interval in words.

        >>> import numpy as np
        >>> from jimpact.fits.profiles import Profile
        >>> given = ("e", np.zeros(1), np.zeros(1), 4.0, 0.95)
        >>> Profile(*given, ((0.25, 0.5), (0.75, 1.0)), (0.0, 1.0)).words
        '0.25 to 0.5 or at least 0.75'
        """
        return in_words(self.intervals, self.domain)

    def __str__(self) -> str:
        return f"{self.name}: {self.words} ({100 * self.level:g} %)"


def profile(
    fit: "Fit",
    names: str | Iterable[str] | None = None,
    *,
    level: float = 0.95,
    points: int = 33,
    progress: float | None = None,
) -> tuple[Profile, ...]:
    """Profile likelihoods of parameters: intervals that need no parabola.

    Equation: `D(x_i) = (min over the others of |r|^2 - least |r|^2) / s^2 <= q^2`, q the quantile
    of the normal law where sigma is known (s = 1), else of Student's t (s = `fit.noise`).

    Held values cover the whole domain and the neighbourhood of the minima; from each minimum they
    are reached one after the other in both directions, all parameters side by side; far above the
    limit they are told only roughly. Where a scan finds a further valley, it is followed to its
    minimum. Without sigma and with no degree of freedom left, the interval is that of the values
    which reproduce the data exactly.

    Args:
        fit: by least squares.
        names: of parameters; None: all.
        level: of the confidence intervals, in (0, 1).
        points: held values across the domain, besides those near the minimum, at least 3.
        progress: bar on stderr; None: on a terminal, once it takes longer than two seconds.

    Returns:
        A `Profile` for each name; `print` says its interval.

    Raises:
        ValueError: level, points or names; a robust loss; a matrix that is kept admissible.

    >>> import jimpact as ji
    >>> data = ji.Experiments([[1.0, 0.0], [2.0, 0.0]], [[0.01, 0.98], [0.0, 2.01]], sigma=0.02)
    >>> found = ji.fit(ji.Newton(0.9), ji.chain([1.0, 1.0]), data)
    >>> print(*ji.profile(found))
    restitution: at least 0.97321 (95 %)
    """
    if not 0 < level < 1:
        raise ValueError(f"Argument `level` must lie in (0, 1), but has value {level}.")
    if points < 3:
        raise ValueError(f"Argument `points` must be at least 3, but has value {points}.")
    check_profiled(fit)
    wanted = fit.names if names is None else (names,) if isinstance(names, str) else tuple(names)
    for name in wanted:
        if name not in fit.names:
            known = ", ".join(fit.names)
            raise ValueError(f"Argument `names` must be among {known}, but has {name!r}.")
    with progress_bar(progress) as show:
        scans = _Scans(fit, [fit.names.index(name) for name in wanted], level, show)
        scans.scan(points, FAR, whole=True)
        scans.follow_valleys()
        scans.find_ends()
    return tuple(scans.profile(i) for i in scans.which)


def quick_profiles(fit: "Fit", progress: float | None) -> tuple[Profile, ...]:
    """Profiles of all parameters around the minima that are known, no farther than is needed."""
    with progress_bar(progress) as show:
        scans = _Scans(fit, range(len(fit.names)), QUICK_LEVEL, show)
        scans.scan(QUICK_POINTS, 1.0)
        scans.find_ends()
    return tuple(scans.profile(i) for i in scans.which)


class Scaled:
    """A fit in scaled parameters y."""

    def __init__(self, fit: "Fit"):
        r, first = fit.problem.residuals, fit.problem.parameters.first
        self.point = fit.problem.point
        self.scale, self.log = np.asarray(r.scale, float)[first], np.asarray(r.log)[first]
        self.low, self.high = np.asarray(r.low, float), np.asarray(r.high, float)
        self.size = float(r.size)
        exact = EXACT[str(r.offset.dtype)] * self.size**2
        stated = np.isfinite(fit.noise) and fit.noise > 0
        # of the weighted residuals; where nothing tells it, what is exact up to rounding
        self.variance = float(fit.noise**2) if stated else exact
        self.best = self.point(fit.value)

    def real(self, i: int, y: np.ndarray) -> np.ndarray:
        """Values of the i-th parameter."""
        return np.asarray(from_scaled(y, self.scale[i], np.broadcast_to(self.log[i], y.shape)))

    def reach(
        self, i: int, pieces: Sequence[tuple[float, float]] | None = None
    ) -> tuple[float, float]:
        """The bounds of the i-th parameter or the outer ends of pieces, scaled.

        What has no end is cut at so many natural scales as starts reach.
        """
        low, high = self.low[i], self.high[i]
        if pieces is not None:
            outer = np.array([pieces[0][0], pieces[-1][1]])
            outer = to_scaled(outer, self.scale[i], np.broadcast_to(self.log[i], 2))
            low, high = max(low, outer[0]), min(high, outer[1])
        low = low if np.isfinite(low) else self.best[i] - START_SCALES
        high = high if np.isfinite(high) else self.best[i] + START_SCALES
        return float(low), float(high)


def can_be_profiled(fit: "Fit") -> bool:
    """Least squares, in a box."""
    return fit.loss == "squares" and isinstance(fit.problem.residuals.region, Box)


def check_profiled(fit: "Fit") -> None:
    """Raise an error unless this is a fit, of parameters that can be held."""
    from jimpact.fits.fitting import Fit  # whose methods profile

    check_kind("fit", fit, Fit)
    if not can_be_profiled(fit):
        raise ValueError(
            "Argument `fit` must be by least squares, and not of a matrix that is kept admissible."
        )


class _Scans(Scaled):
    """Held values of parameters and the minima with them, in scaled form, as far as known."""

    def __init__(self, fit: "Fit", which: Sequence[int], level: float, show: Any):
        super().__init__(fit)
        self.fit, self.which, self.level, self.show = fit, which, level, show
        self.residuals: Residuals = filled_up(fit.problem.residuals)
        self.least = fit.starts[0].sum_of_squares
        # of each parameter: held value -> (sum of squares, y)
        self.found: dict[int, dict[float, tuple[float, np.ndarray]]] = {
            i: {float(self.best[i]): (self.least, self.best)} for i in which
        }
        for start in fit.starts[1:]:
            y = self.point(start.value)
            for i in which:
                self.found[i].setdefault(float(y[i]), (start.sum_of_squares, y))
        self.lower: np.ndarray | None = None
        self.rough: set[tuple[int, float]] = set()  # what was not solved to its end

    def minima(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """y (Q,) of the minima that fit well enough, and scaled standard errors (P,)."""
        fit = self.fit
        found: list[tuple[np.ndarray, np.ndarray | None]] = [(fit.value, fit.standard_error)]
        if fit.rank == len(fit.names):  # else they are ends in one valley
            found += [(end.value, end.standard_error) for end in fit.starts[1:]]
        return [
            (self.point(value), error / np.where(self.log, value, self.scale))
            for value, error in found
            if error is not None
        ]

    def near(self, i: int, y: np.ndarray, error: float) -> np.ndarray:
        """Values to hold near a minimum."""
        if not np.isfinite(error):
            return np.zeros(0)
        reach = error * np.sqrt(self.limit())
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
        alone = len(self.fit.names) == 1  # nothing is left to be solved for
        if not (whole and alone):
            self.advance(fronts, values, far * self.limit())
        if whole:
            left = [(i, x) for i in self.which for x in values[i] if x not in self.found[i]]
            rough = [(i, _with(self._nearest(i, x), i, x)) for i, x in left]
            self._take(rough, None if alone else ROUGH)
            self.rough = set() if alone else {(i, float(x)) for i, x in left}

    def advance(self, fronts: list["_Front"], values: Mapping[int, np.ndarray], far: float) -> None:
        """From value to value, each from the minimum beside it, until others have been there."""
        while True:
            ahead = [(f, f.next(values[f.i], self.low, self.high)) for f in fronts]
            moving = [(f, y) for f, y in ahead if y is not None]
            if not moving:
                return
            known = [self.found[f.i].get(float(y[f.i]), (np.inf, y))[0] for f, y in moving]
            ends = self._take([(f.i, y) for f, y in moving])
            # where a scan leaves the interval it may be on a ridge: once more from the fit
            limit = self.limit()
            leaving = [
                k
                for k, ((f, _), (squares, _)) in enumerate(zip(moving, ends))
                if self._above(squares) > limit >= self._above(self._squares(f))
            ]
            again = [(moving[k][0].i, moving[k][1]) for k in leaving]
            again = [(i, _with(self.best, i, y[i])) for i, y in again]
            for k, end in zip(leaving, self._take(again)):
                ends[k] = min(ends[k], end, key=_first)
            fronts = []
            for (f, _), before, end in zip(moving, known, ends):
                squares, y = end
                first = squares < (1 - SAME) * before and self.found[f.i][float(y[f.i])] is end
                if first and self._above(squares) <= far:
                    fronts.append(_Front(f.i, f.step, y, f.last))

    def _solve(
        self, held: Sequence[tuple[int | None, np.ndarray]], steps: int | None = None
    ) -> SolverState:
        """Minima from y (Q,), with the i-th entry held, None: nothing."""
        which = [(() if i is None else (i,), y) for i, y in held]
        return run_held(self.residuals, which, steps or DEFAULT_STEPS[_METHOD], self.show)

    def _take(
        self, held: Sequence[tuple[int, np.ndarray]], steps: int | None = None
    ) -> list[tuple[float, np.ndarray]]:
        """Solve, and keep what is better than what was known."""
        if not held:
            return []
        states = self._solve(held, steps)
        squares = 2 * np.asarray(states.cost, float) * self.size**2
        ends = []
        for k, (i, y) in enumerate(held):
            end = _with(np.asarray(states.y[k]), i, y[i])
            ends.append((float(squares[k]), end))
            if not squares[k] >= self.found[i].get(float(y[i]), (np.inf, y))[0]:
                self.found[i][float(y[i])] = ends[-1]
        best = min((entry for found in self.found.values() for entry in found.values()), key=_first)
        exact = EXACT[str(self.residuals.offset.dtype)] * self.size**2
        if best[0] < self.least * (1 - 1e-6) - exact:
            self.least, self.lower = best
        return ends

    def _nearest(self, i: int, y: float) -> np.ndarray:
        return self.found[i][min(self.found[i], key=lambda known: abs(known - y))][1]

    def deviance(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        """Held values and their deviances."""
        values = np.array(sorted(self.found[i]))
        squares = np.array([self.found[i][y][0] for y in values])
        return values, np.maximum(squares - self.least, 0.0) / self.variance

    def limit(self) -> float:
        """Deviance at the ends of an interval."""
        return quantile(self.fit, self.level) ** 2

    def _above(self, squares: float) -> float:
        """The deviance of a sum of squares."""
        return (squares - self.least) / self.variance

    def _squares(self, front: "_Front") -> float:
        """The least known where a front has come to."""
        known = self.found[front.i].get(float(front.last[front.i]))
        return self.least if known is None else known[0]

    def follow_valleys(self) -> None:
        """Held values around the minima that further valleys of the scans lead to."""
        starts = []
        for i in self.which:
            values, d = self.deviance(i)
            inside = np.flatnonzero((d[1:-1] < d[:-2]) & (d[1:-1] <= d[2:])) + 1
            starts += [
                (i, self.found[i][values[k]][1])
                for k in inside
                if d[k] > self.limit() or (i, values[k]) in self.rough
            ]
        if not starts:
            return
        states = self._solve([(None, y) for _, y in starts])
        fronts: list[_Front] = []
        near: dict[int, np.ndarray] = {}
        for k, (i, _) in enumerate(starts):
            jacobian = np.asarray(states.jacobian[k], float)[:, : len(self.fit.names)]
            inverse = np.linalg.pinv(self.size**2 * jacobian.T @ jacobian)
            error = np.sqrt(self.variance * inverse[i, i])
            y = np.asarray(states.y[k], float)
            squares = 2 * float(states.cost[k]) * self.size**2
            if self._above(squares) <= self.limit():
                self.found[i].setdefault(float(y[i]), (squares, y))
                more = self.near(i, y, float(error))
                near[i] = np.unique(np.concatenate([near.get(i, np.zeros(0)), more]))
                fronts += [_Front(i, step, y) for step in (-1, 1)]
        self.advance(fronts, near, np.inf)

    def find_ends(self) -> None:
        """Where deviances pass the limit: regula falsi in their roots, all ends side by side."""
        limit = np.sqrt(self.limit())
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
                        trials.append((i, _with(self._nearest(i, y), i, y)))
            if not trials:
                return
            self._take(trials)

    def profile(self, i: int) -> Profile:
        """What is known of a parameter."""
        values, d = self.deviance(i)
        limit, real = self.limit(), self.real(i, values)
        below = np.flatnonzero(d <= limit)
        pieces = np.split(below, np.flatnonzero(np.diff(below) > 1) + 1)
        intervals = []
        for piece in pieces:
            ends = []
            for k, step in ((piece[0], -1), (piece[-1], 1)):
                beyond = k + step
                if not 0 <= beyond < len(values):
                    ends.append(self.fit.problem.domains[i][(step + 1) // 2])
                    continue
                p, q = np.sqrt(d[k]), np.sqrt(d[beyond])
                share = (np.sqrt(limit) - p) / (q - p)
                y = values[k] + share * (values[beyond] - values[k])
                ends.append(float(self.real(i, np.array([y]))[0]))
            intervals.append((float(ends[0]), float(ends[1])))
        low, high = self.fit.problem.domains[i]
        better = None
        if self.lower is not None:
            better = self.fit.problem.values_at(self.lower)
        given = (self.fit.names[i], real, d, limit, self.level, tuple(intervals))
        return Profile(*given, (float(low), float(high)), better)


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
        return _with(y, i, value)


def quantile(fit: "Fit", level: float) -> float:
    """Standard errors to either side that an interval reaches."""
    if not 0 < level < 1:
        raise ValueError(f"Argument `level` must lie in (0, 1), but has value {level}.")
    freedom, tail = fit.degrees_of_freedom, 0.5 + 0.5 * level
    known = fit.problem.sigma is not None or freedom < 1
    return float(ndtri(tail) if known else stdtrit(freedom, tail))


def linearized(fit: "Fit", i: int, q: float) -> tuple[tuple[float, float], ...]:
    """Where parabolas at all minima let the i-th parameter lie within q standard errors."""
    low, high = fit.bounds[0][i], fit.bounds[1][i]
    log = np.asarray(fit.problem.residuals.log)[fit.problem.parameters.first][i]
    minima = [(fit.value[i], fit.standard_error[i], 0.0)]
    for start in fit.starts[1:]:
        if start.standard_error is not None:
            more = start.sum_of_squares - fit.starts[0].sum_of_squares
            minima.append((start.value[i], start.standard_error[i], more))
    pieces: list[tuple[float, float]] = []
    for value, error, more in minima:
        if pieces and not more < (q * fit.noise) ** 2:
            continue
        half = error * np.sqrt(q**2 - (more / fit.noise**2 if more else 0.0))
        if log:
            ends = value * np.exp(np.array([-half, half]) / value)
        else:
            ends = np.array([value - half, value + half])
        pieces.append(tuple(np.clip(ends, low, high)))
    return joined(pieces)


def needs_profiles(fit: "Fit") -> bool:
    """Whether parabolas may mislead, and profiles cost little: no more than the fit did."""
    starts = sum(start.count for start in fit.starts) + fit.lost_starts
    most = FEW if starts == 1 else MANY
    few = fit.experiments is not None and len(fit.predicted) <= most
    return few and misleads(fit)


def misleads(fit: "Fit") -> bool:
    """Whether there are no profiles, though parabolas may mislead."""
    problem = fit.problem
    if fit.profiles or not can_be_profiled(fit) or not fit.converged:
        return False
    if fit.rank < len(fit.names):
        return True
    if not np.isfinite(fit.noise):
        return False  # nothing tells how far a value may be off
    log = np.asarray(problem.residuals.log)[problem.parameters.first]
    q = quantile(fit, 0.95)
    for i in range(len(fit.names)):
        pieces = linearized(fit, i, q)
        at_end = pieces[0][0] <= fit.bounds[0][i] or pieces[-1][1] >= fit.bounds[1][i]
        wide = log[i] and fit.standard_error[i] > HARDLY_SEEN * fit.value[i]
        if len(pieces) > 1 or at_end or wide:
            return True
    return False


def joined(pieces: Iterable[tuple[float, float]]) -> tuple[tuple[float, float], ...]:
    """The same set in pieces apart from each other, in order.

    >>> from jimpact.fits.profiles import joined
    >>> joined([(3.0, 4.0), (0.0, 1.0), (0.5, 2.0)])
    ((0.0, 2.0), (3.0, 4.0))
    """
    found: list[tuple[float, float]] = []
    for low, high in sorted(pieces):
        if found and low <= found[-1][1]:
            found[-1] = (found[-1][0], max(high, found[-1][1]))
        else:
            found.append((float(low), float(high)))
    return tuple(found)


def in_words(pieces: Iterable[tuple[float, float]], domain: tuple[float, float]) -> str:
    """Pieces of an interval; an end at the domain is none."""
    return " or ".join(_piece(*ends, domain) for ends in pieces)


def _piece(low: float, high: float, domain: tuple[float, float]) -> str:
    open_low, open_high = low <= domain[0], high >= domain[1]
    if open_low and open_high:
        return "anything"
    if open_low or open_high:
        return f"at most {high:.5g}" if open_low else f"at least {low:.5g}"
    return f"{low:.5g} to {high:.5g}"


def _first(entry: tuple[float, Any]) -> float:
    return entry[0]


def _with(y: np.ndarray, i: int, value: float) -> np.ndarray:
    changed = np.array(y, float)
    changed[i] = value
    return changed
