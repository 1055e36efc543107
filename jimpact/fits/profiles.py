"""Profiles and contours: how well the data are fitted with one or two parameters fixed.

A standard error is half the width of a parabola. Where the sum of squares is not a parabola (at a
bound, in a flat valley, with several minima), the profile gives the interval: one-sided, or of
several pieces.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from jimpact._checks import as_whole, check_choice, check_kind
from jimpact.fits.problem import scaled
from jimpact.fits.solve import START_SCALES, Ends, Search, minimize_with, repeated
from jimpact.fits.uncertainty import FitResult, Profile, check_level
from jimpact.progress import Show, progress_bar

# Deviances are right to this (see `solve.FINE`): the ends of an interval move by less than END. A
# search that goes on after so many passes creeps along a kink. It begins near its end.
_STOP, PASSES, NEAR = 1e-4, 16, 1e-6
STEP, WIDEST = 0.4, 2.0  # of a walk: rise of the root of the deviance, over the limit's; growth
FIRST_SHARE = 1 / 16  # of what can be reached: the first step where the error is infinite
LONGEST = 2.0  # steps by which a walk is extrapolated
FAR = 2.0  # times the limit, where a walk ends
MOST_STEPS = 40  # of a walk: it then moves along a valley without end
ROUGH = 2  # passes of a value that is only looked at
SAME = 1e-6  # relative sums of squares that are equal
# Share of the root of the limit, or of the values inside, to which an end is searched for.
END = 1e-3
ROUNDS = 8  # of the search for an end: it is then right to a millionth of a step, mostly
# Shots up to which `fit` profiles of itself, with one start and with several: as long as half of
# the fit. Parameters: with four of LZB it takes longer than the search.
FEW_SHOTS, MANY_SHOTS, MOST_PARAMETERS = 64, 256, 3
_BEYOND = 1.3  # how far a contour's picture goes, in half-widths of the region of a parabola


class Deviances:
    """Sums of squares of a fit with some of its parameters fixed, in the solver's scale."""

    def __init__(self, fit: FitResult, show: Show):
        self.fit, self.problem, self.show = fit, fit.problem, show
        self.low, self.high = (np.asarray(x, float) for x in (self.problem.low, self.problem.high))
        # if the noise is undetermined, that of an exact fit up to rounding
        known = np.isfinite(fit.noise) and fit.noise > 0
        self.variance = float(fit.noise**2) if known else self.problem.exact_squares
        self.least = fit.starts[0].sum_of_squares
        self.best = self.problem.point(fit.value)

    def minimize(
        self,
        fixed: Sequence[Sequence[int]],
        y: Sequence[np.ndarray],
        steps: int = PASSES,
    ) -> Ends:
        """Minima from each y (A, Q) with these of its parameters fixed, all side by side."""
        held = np.zeros((len(y), len(self.best)), bool)
        for row, which in zip(held, fixed):
            row[list(which)] = True
        held[:, len(self.fit.names) :] = True
        search = Search(max_steps=steps, show=self.show, damping=NEAR)
        return minimize_with(repeated(self.problem, len(y)), np.array(y), held, search, _STOP)

    def of(self, squares: Any) -> Any:
        """Sums of squares above the least, over the noise variance."""
        return np.maximum((squares - self.least) / self.variance, 0.0)

    def values(self, i: int, y: np.ndarray) -> np.ndarray:
        """Values of the i-th parameter of scaled ones."""
        points = np.tile(self.best, (len(y), 1))
        points[:, i] = y
        return self.problem.values_at(points)[:, i]

    def reach(self, i: int, pieces: Any = None) -> tuple[float, float]:
        """The bounds of the i-th parameter or the outer ends of pieces, scaled.

        An infinite end is cut at as many natural scales as starts reach.
        """
        low, high = self.low[i], self.high[i]
        if pieces is not None:
            outer = np.array([pieces[0][0], pieces[-1][1]])
            outer = scaled(outer, np.asarray(self.problem.scale)[i], self.problem.parameters.log[i])
            low, high = max(low, outer[0]), min(high, outer[1])
        low = low if np.isfinite(low) else self.best[i] - START_SCALES
        return float(low), float(high if np.isfinite(high) else self.best[i] + START_SCALES)


def _check_profiled(fit: FitResult) -> None:
    """Raise an error unless this is a fit, of parameters that can be fixed."""
    check_kind("fit", fit, FitResult)
    if not fit.can_be_profiled:
        raise ValueError(
            "Argument `fit` must be by least squares, and not of a matrix that must be admissible."
        )


def with_entry(y: np.ndarray, i: int, value: float) -> np.ndarray:
    """A copy of y with another i-th entry."""
    changed = np.array(y, float)
    changed[i] = value
    return changed


# ---------------------------------------------------------------------------- profiles


def profile(
    fit: FitResult,
    names: str | Iterable[str] | None = None,
    *,
    level: float = 0.95,
    points: int = 17,
    progress: float | None = None,
) -> tuple[Profile, ...]:
    """Profile likelihoods of parameters: intervals without the assumption of a parabola.

    Equation: `D(x_i) = (min over the others of |r|^2 - least |r|^2) / s^2 <= q^2`, q the quantile
    of the normal law where sigma is known (s = 1), else of Student's t (s = `fit.noise`).

    From each minimum a walk goes in both directions, each value from where the last two lead, in
    steps that raise the root of D by .4 of the limit's, all parameters side by side. Of a fit from
    one start, which has not searched for other minima, the rest of the domain is looked at; where
    a further valley shows, it is followed to its minimum.
    Without sigma and with no degree of freedom left, the interval is that of the values which
    reproduce the data exactly.

    Args:
        fit: by least squares.
        names: of parameters; None: all.
        level: of the confidence intervals, in (0, 1).
        points: values across the domain that are looked at, at least 3; after a fit from several
            starts, which have searched the domain, none are.
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
    _check_profiled(fit)
    wanted = fit.names if names is None else (names,) if isinstance(names, str) else tuple(names)
    for name in wanted:
        check_choice("names", name, fit.names)
    return walked_profiles(fit, [fit.names.index(name) for name in wanted], level, points, progress)


def walked_profiles(
    fit: FitResult, which: Sequence[int], level: float, points: int, progress: float | None
) -> tuple[Profile, ...]:
    """Profiles of these parameters; points: looked at across the domain, 0: none."""
    with progress_bar(progress) as show:
        scans = _Scans(fit, which, level, show)
        scans.walk(scans.minima())
        if points and fit.start_count == 1:
            scans.look(points)
        scans.finish()
    return tuple(scans.profile(i) for i in which)


class _Known(NamedTuple):
    """The least sum of squares that is known with a value fixed, and where."""

    squares: float
    y: np.ndarray
    rough: bool = False


class _Walk(NamedTuple):
    """How far the walk along the i-th parameter has come in one direction, and its next step."""

    i: int
    step: float
    last: np.ndarray
    height: float  # the root of the deviance over the limit
    before: np.ndarray | None = None


class _Scans(Deviances):
    """Fixed values of parameters and the minima with them, in scaled form, as far as known."""

    def __init__(self, fit: FitResult, which: Sequence[int], level: float, show: Show):
        super().__init__(fit, show)
        self.which, self.level = which, level
        self.limit = fit.quantile(level) ** 2  # deviance at the ends of an interval
        self.walked: dict[tuple[int, float], float] = {}  # sums of squares where walks have been
        self.lower: np.ndarray | None = None  # a point below the minimum of the fit
        self.known: dict[int, dict[float, _Known]] = {i: {} for i in which}
        for start in fit.starts:
            y = self.problem.point(start.value)
            for i in which:
                self.known[i].setdefault(float(y[i]), _Known(start.sum_of_squares, y))

    def minima(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """y (Q,) of the minima that fit well enough, and scaled standard errors (P,)."""
        fit = self.fit
        minima: list[tuple[Any, Any]] = [(fit.value, fit.standard_error)]
        if fit.rank == len(fit.names):  # else they are ends in one valley
            near = [end for end in fit.starts[1:] if self.of(end.sum_of_squares) <= self.limit]
            minima += [(end.value, end.standard_error) for end in near]
        return [
            (self.problem.point(value), error / self.problem.steps_at(value))
            for value, error in minima
        ]

    def walk(self, starts: Sequence[tuple[np.ndarray, np.ndarray]]) -> None:
        """Walks from these y (Q,), of these scaled errors (P,), along every parameter."""
        walks, height = [], np.sqrt(self.limit)
        for y, error in starts:
            for i in self.which:
                low, high = self.reach(i)
                widest = (high - low) * FIRST_SHARE
                first = STEP * height * error[i] if np.isfinite(error[i]) else widest
                first = min(first, (high - low) / 2) or widest
                walks += [_Walk(i, sign * first, y, 0.0) for sign in (-1, 1)]
        for _ in range(MOST_STEPS):
            aims = [(walk, aim) for walk in walks if (aim := self._next(walk)) is not None]
            if not aims:
                return
            places = [(walk.i, float(y[walk.i])) for walk, y in aims]
            before = [self.walked.get(place, np.inf) for place in places]
            ends = self.solve([(walk.i, y) for walk, y in aims])
            heights = np.sqrt(self.of(np.array([end.squares for end in ends])) / self.limit)
            # where a walk leaves the interval it may be on a ridge: once more from the fit
            leaving = [k for k, (walk, _) in enumerate(aims) if heights[k] > 1 >= walk.height]
            again = [(aims[k][0].i, aims[k][1]) for k in leaving]
            again = [(i, with_entry(self.best, i, y[i])) for i, y in again]
            for k, end in zip(leaving, self.solve(again)):
                ends[k] = min(ends[k], end, key=_squares)
                heights[k] = np.sqrt(self.of(ends[k].squares) / self.limit)
            walks = [
                _Walk(walk.i, walk.step * _growth(h - walk.height), end.y, h, walk.last)
                for (walk, _), known, end, h in zip(aims, before, ends, heights)
                # others have been there, or it is far from the interval
                if h <= np.sqrt(FAR) and end.squares < (1 - SAME) * known
            ]
            self.walked |= dict(zip(places, (end.squares for end in ends)))

    def _next(self, walk: _Walk) -> np.ndarray | None:
        """Where the next minimum of a walk is searched from; None at the end of the domain."""
        i, last = walk.i, walk.last
        low, high = self.reach(i)
        value = float(np.clip(last[i] + walk.step, low, high))
        if value == last[i]:
            return None
        known = [x for j, x in self.walked if j == i]
        between = [x for x in known if 0 < (x - last[i]) / (value - last[i]) < 1]
        value = min(between, key=lambda x: abs(x - last[i]), default=value)
        if walk.before is None:
            return with_entry(last, i, value)
        share = (value - last[i]) / (last[i] - walk.before[i])
        ahead = last + np.clip(share, 0.0, LONGEST) * (last - walk.before)
        return with_entry(np.clip(ahead, self.low, self.high), i, value)

    def solve(
        self, fixed: Sequence[tuple[int, np.ndarray]], steps: int | None = None
    ) -> list[_Known]:
        """Minima with the i-th entry of each y fixed; what improves on the known is kept."""
        if not fixed:
            return []
        rough, limits = steps is not None, {} if steps is None else {"steps": steps}
        solved = self.minimize([(i,) for i, _ in fixed], [y for _, y in fixed], **limits)
        ends = []
        for (i, y), squares, at in zip(fixed, solved.squares, solved.y):
            end = _Known(float(squares), with_entry(at, i, y[i]), rough)
            ends.append(end)
            known = self.known[i].setdefault(float(y[i]), end)
            if end.squares < known.squares:
                self.known[i][float(y[i])] = end
        best = min(ends, key=_squares)
        if best.squares < self.least * (1 - SAME) - self.problem.exact_squares:
            self._lower(best.squares, best.y)
        return ends

    def _lower(self, squares: float, y: np.ndarray) -> None:
        """A point below all others: all parameters get it, whichever's scan found it."""
        self.least, self.lower = squares, y
        for i in self.which:
            self.known[i][float(y[i])] = _Known(squares, y)

    def deviance(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        """Fixed values and their deviances."""
        values = np.array(sorted(self.known[i]))
        return values, self.of(np.array([self.known[i][y].squares for y in values]))

    def look(self, points: int) -> None:
        """Values across the domain, roughly; further valleys are followed."""
        trials = []
        for i in self.which:
            values, d = self.deviance(i)
            inside = [
                (a, b) for (a, p), (b, q) in pairwise(zip(values, d)) if max(p, q) <= self.limit
            ]
            trials += [
                (i, with_entry(self._nearest(i, x), i, x))
                for x in np.linspace(*self.reach(i), points)
                if not any(a <= x <= b for a, b in inside)
            ]
        # of one parameter there are no others to solve for
        self.solve(trials, None if len(self.fit.names) == 1 else ROUGH)
        starts = []
        for i in self.which:
            values, d = self.deviance(i)
            dips = np.flatnonzero((d[1:-1] < d[:-2]) & (d[1:-1] <= d[2:])) + 1
            known = [self.known[i][values[k]] for k in dips]
            starts += [end.y for end, k in zip(known, dips) if end.rough or d[k] > self.limit]
        self._walk_from_minima(starts)

    def _walk_from_minima(self, starts: Sequence[np.ndarray]) -> None:
        """Walks from the minima next to these points that fit well enough."""
        if not starts:
            return
        ends = self.minimize([()] * len(starts), starts)
        best = int(np.argmin(ends.squares))
        if ends.squares[best] < self.least * (1 - SAME) - self.problem.exact_squares:
            self._lower(float(ends.squares[best]), ends.y[best])
        found = []
        for k in np.flatnonzero(self.of(ends.squares) <= self.limit):
            jacobian = ends.jacobian[k][:, : len(self.fit.names)]
            inverse = np.linalg.pinv(jacobian.T @ jacobian)
            found.append((ends.y[k], np.sqrt(self.variance * np.diag(inverse))))
            for i in self.which:
                end = _Known(float(ends.squares[k]), ends.y[k])
                self.known[i].setdefault(float(ends.y[k][i]), end)
        self.walk(found)

    def _nearest(self, i: int, y: float) -> np.ndarray:
        """The minimum with the fixed value that is nearest to y."""
        return self.known[i][min(self.known[i], key=lambda known: abs(known - y))].y

    def finish(self) -> None:
        """The ends of the intervals, and what lies around a minimum below that of the fit."""
        followed = None
        for _ in range(ROUNDS):
            if self.lower is not None and self.lower is not followed:
                followed = self.lower
                self._walk_from_minima([followed])
            self.find_ends()
            if not self.fill_holes() and self.lower is followed:
                return

    def find_ends(self) -> None:
        """Where deviances pass the limit: regula falsi in their roots, all ends side by side.

        Where they jump over it, the minimum outside may have been missed: it is searched for again
        from the one inside.
        """
        again = set()
        for turn in range(ROUNDS):
            trials = []
            for i, (a, b), (p, q), least in self._crossings():
                share = p / (p - q) if turn % 3 < 2 and np.isfinite(q - p) else 0.5
                y = a + np.clip(share, 0.02, 0.98) * (b - a)
                start, end = (self.known[i][x].y for x in (a, b))
                if a < y < b and b - a > least:
                    at = start + (y - a) / (b - a) * (end - start)
                    trials.append((i, with_entry(at, i, y)))
                elif (i, a, b) not in again:
                    again.add((i, a, b))
                    inside, outside = (start, b) if p <= 0 else (end, a)
                    trials.append((i, with_entry(inside, i, outside)))
            if not trials:
                return
            self.solve(trials)

    def _crossings(self) -> Iterator[tuple[int, tuple[float, float], tuple[float, float], float]]:
        """Ends that are not settled.

        Each is a parameter, the fixed values to both sides, by how much the roots of their
        deviances pass that of the limit, and the least distance of fixed values.
        """
        limit = np.sqrt(self.limit)
        for i in self.which:
            values, d = self.deviance(i)
            height, inside = np.sqrt(d) - limit, values[d <= self.limit]
            least = END * max(np.ptp(inside), END * abs(inside[0]))
            for k in np.flatnonzero((height[:-1] <= 0) != (height[1:] <= 0)):
                sides = height[k], height[k + 1]
                if min(map(abs, sides)) > END * limit:
                    yield i, (values[k], values[k + 1]), sides, least

    def fill_holes(self) -> bool:
        """Try again between two pieces, from straight lines: whether a hole was an artefact."""
        trials = []
        for i in self.which:
            values, d = self.deviance(i)
            for a, b in pairwise(np.flatnonzero(d <= self.limit)):
                start, end = (self.known[i][values[k]].y for k in (a, b))
                for value in values[a + 1 : b]:
                    share = (value - values[a]) / (values[b] - values[a])
                    trials.append((i, with_entry(start + share * (end - start), i, value)))
        return any(self.of(end.squares) <= self.limit for end in self.solve(trials))

    def profile(self, i: int) -> Profile:
        """The profile of a parameter from all that was solved."""
        y, deviance = self.deviance(i)
        below = np.flatnonzero(deviance <= self.limit)
        pieces = np.split(below, np.flatnonzero(np.diff(below) > 1) + 1)
        low, high = self.problem.domains[i]
        intervals = tuple(
            (self._end(i, y, deviance, piece[0], -1), self._end(i, y, deviance, piece[-1], 1))
            for piece in pieces
        )
        return Profile(
            name=self.fit.names[i],
            value=self.values(i, y),
            deviance=deviance,
            limit=self.limit,
            level=self.level,
            intervals=intervals,
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
        return float(self.values(i, y[[k]] + share * (y[beyond] - y[k]))[0])


def _squares(end: _Known) -> float:
    """To compare ends by."""
    return end.squares


def _growth(rise: float) -> float:
    """By how much the next step of a walk is longer: so that the height rises by STEP."""
    return float(np.clip(STEP / max(rise, 1e-9), 1 / WIDEST, WIDEST))


def needs_profiles(fit: FitResult) -> bool:
    """Whether standard errors may mislead, and profiles cost no more than the fit did.

    Not after lack of fit: no interval of such a law means anything, and its valleys are rough.
    """
    most = FEW_SHOTS if fit.start_count == 1 else MANY_SHOTS
    few = fit.experiments is not None and len(fit.predicted) <= most
    few &= len(fit.names) <= MOST_PARAMETERS
    return few and fit.linearization_misleads and not fit.shows_lack_of_fit


# ---------------------------------------------------------------------------- contours


@dataclass(frozen=True, eq=False)
class Contour:
    """`deviance` (A, B) over values `x` (A,) of one parameter and `y` (B,) of another, by `names`.

    The confidence region at `level` is where it is at most `limit`; inf where no neighbour is
    inside, which was not computed. `best`: the values of the fit. `log`: which of the two is fitted
    in its logarithm.
    """

    names: tuple[str, str]
    x: np.ndarray
    y: np.ndarray
    deviance: np.ndarray
    limit: float
    level: float
    best: tuple[float, float]
    log: tuple[bool, bool]


def contour(
    fit: FitResult,
    first: str,
    second: str,
    *,
    level: float = 0.95,
    points: int = 21,
    progress: float | None = None,
) -> Contour:
    """The joint confidence region of two parameters, all others free.

    Equation: `D(x, y) = (min over the others of |r|^2 - least |r|^2) / s^2 <= q`, where sigma is
    known s = 1 and q the quantile of chi^2 with 2 degrees of freedom, else s = `fit.noise` and q
    twice that of F with 2 and the degrees of freedom that are left.

    The values cover somewhat more than the region of a parabola, cut at the bounds; the whole
    domain of what the data cannot see. The region is filled from the minima of the fit outwards,
    from neighbour to neighbour, many side by side. `ji.plot.contour` draws it.

    Args:
        fit: by least squares.
        first, second: names of two of its parameters.
        level: of the region, in (0, 1).
        points: values of each, at least 3.
        progress: bar on stderr; None: on a terminal, once it takes longer than two seconds.

    Returns:
        `Contour` with `deviance` (points, points).

    Raises:
        ValueError: level, points or names; a robust loss; a matrix that must be admissible; a
            region so thin that no fixed value lies inside.

    >>> import jimpact as ji
    >>> pre, post = [[1.0, 0.0, -1.0], [2.0, 0.0, 0.0]], [[-0.8, 0.1, 0.7], [0.1, 1.8, 0.1]]
    >>> data = ji.Experiments(pre, post, sigma=0.1)
    >>> result = ji.fit(ji.Newton([0.9, 0.9]), ji.chain([1.0, 1.0, 1.0]), data)
    >>> region = ji.contour(result, "restitution[1]", "restitution[2]", points=5)
    >>> region.deviance.shape, round(region.limit, 2)
    ((5, 5), 5.99)
    """
    check_level(level)
    as_whole("points", points, 3)
    _check_profiled(fit)
    for argument, name in (("first", first), ("second", second)):
        check_choice(argument, name, fit.names)
    if first == second:
        raise ValueError(f"Arguments `first` and `second` must differ, but both are {first!r}.")
    freedom, pair = fit.degrees_of_freedom, (fit.names.index(first), fit.names.index(second))
    limit = float(-2 * np.log(1 - level))
    if fit.problem.sigma is None and freedom > 0:
        limit = float(freedom * ((1 - level) ** (-2 / freedom) - 1))
    with progress_bar(progress) as show:
        deviances, width = Deviances(fit, show), _BEYOND * np.sqrt(limit)
        ends = [deviances.reach(i, fit.linearized_interval(i, width)) for i in pair]
        x, y = (np.linspace(*each, points) for each in ends)
        deviance = _flood(deviances, pair, (x, y), limit)
    if deviance.min() > limit:
        raise ValueError(
            f"Argument `points` must be larger: the region falls between {points} values of "
            f"{first} and of {second} (or take `profile`, which needs no grid)."
        )
    return Contour(
        names=(first, second),
        x=deviances.values(pair[0], x),
        y=deviances.values(pair[1], y),
        deviance=deviance,
        limit=limit,
        level=level,
        best=(float(fit.value[pair[0]]), float(fit.value[pair[1]])),
        log=tuple(bool(fit.problem.parameters.log[i]) for i in pair),  # type: ignore[arg-type]
    )


def _flood(
    deviances: Deviances, pair: tuple[int, int], values: tuple[np.ndarray, np.ndarray], limit: float
) -> np.ndarray:
    """Deviances on the grid of fixed values, from the minima outwards; inf where not computed.

    Each cell below the limit starts its neighbours from its own minimum.
    """
    squares = np.full((len(values[0]), len(values[1])), np.inf)
    known: dict[tuple[int, int], np.ndarray] = {}
    ahead: dict[tuple[int, int], np.ndarray] = {}
    for start in deviances.fit.starts[::-1]:  # the best last: it stays where several meet
        point = deviances.problem.point(start.value)
        row, column = (int(np.argmin(np.abs(v - point[i]))) for v, i in zip(values, pair))
        ahead[row, column] = point
    while ahead:
        points = [near.copy() for near in ahead.values()]
        for point, cell in zip(points, ahead):
            point[list(pair)] = [v[k] for v, k in zip(values, cell)]
        ends = deviances.minimize([pair] * len(points), points)
        for cell, total, y in zip(ahead, ends.squares, ends.y):
            squares[cell], known[cell] = total, y
        deviances.least = min(deviances.least, float(ends.squares.min()))
        ahead = {
            near: known[cell]
            for cell in ahead
            if deviances.of(squares[cell]) <= limit
            for near in _neighbours(cell, len(squares))
            if near not in known
        }
    return deviances.of(squares)


def _neighbours(cell: tuple[int, int], points: int) -> list[tuple[int, int]]:
    """Cells of a square grid next to one, diagonal ones too."""
    near = [(cell[0] + i, cell[1] + j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
    return [(i, j) for i, j in near if 0 <= i < points and 0 <= j < points]
