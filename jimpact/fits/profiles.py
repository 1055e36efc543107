"""Profiles and contours: how well the data are fitted with one or two parameters fixed.

A standard error is half the width of a parabola. Where the sum of squares is not a parabola (at a
bound, in a flat valley, with several minima), the profile gives the interval: one-sided, or of
several pieces. Profiles and contours are one search: a grid of fixed values, on a line or in a
plane, is filled from the minima outwards.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from jimpact.fits.parameters import as_names, scaled, unscaled
from jimpact.fits.report import Fit
from jimpact.fits.search import SAME_VALUE, START_SCALES, FitMinimum, find_minima, solution_of
from jimpact.fits.solve import RANK_TOLERANCE, Ends, Solver, minimize
from jimpact.fits.uncertainty import Profile, check_level
from jimpact.tools.checks import as_whole, check_choice, check_kind
from jimpact.tools.progress import Show, progress_bar

# Deviances are right to this (see `solve.FINE`): the ends of an interval move by less than END. A
# search that goes on after so many passes creeps along a kink. It begins near its end.
_STOP, PASSES, NEAR = 1e-4, 16, 1e-6
# Values beside a minimum: the first raises the root of the deviance of a parabola by STEP of the
# limit's, each further one is GROWTH times as far from its neighbour.
STEP, GROWTH = 0.4, 1.5
FIRST_SHARE = 1 / 16  # of what can be reached: the first value where the error is infinite
SAME = 1e-6  # relative sums of squares that are equal
# Share of the root of the limit, or of the values inside, to which an end is searched for.
END = 1e-3
ROUNDS = 8  # of the search for an end: it is then right to a millionth of a step, mostly
# Shots up to which `fit` profiles of itself, with one start and with several: as long as half of
# the fit. Parameters: with four of LZB it takes longer than the search.
FEW_SHOTS, MANY_SHOTS, MOST_PARAMETERS = 64, 256, 3
LEVEL, PROFILE_STARTS = 0.95, 17  # by default
_BEYOND = 1.3  # how far a contour's picture goes, in half-widths of the region of a parabola
_FROM_BEST = -1  # the branch of what was searched from the best minimum


class Lowest(NamedTuple):
    """The least sum of squares that is known with values fixed, where, from which start."""

    squares: float
    y: np.ndarray
    branch: int = _FROM_BEST


Index = tuple[int, ...]


class Grid(NamedTuple):
    """Fixed values of one or several parameters in the solver's scale, in order: all pairs."""

    which: tuple[int, ...]
    values: tuple[np.ndarray, ...]

    def at(self, cell: Index) -> list[float]:
        """The values of a cell."""
        return [float(values[k]) for values, k in zip(self.values, cell)]

    def nearest(self, y: np.ndarray) -> Index:
        """The cell next to y."""
        return tuple(int(np.abs(v - y[i]).argmin()) for i, v in zip(self.which, self.values))

    def neighbours(self, cell: Index) -> list[Index]:
        """Cells next to one, diagonal ones too."""
        sides = [range(max(k - 1, 0), min(k + 2, len(v))) for k, v in zip(cell, self.values)]
        return [near for near in product(*sides) if near != cell]


class Deviances:
    """Deviances of a fit with some of its parameters fixed, in the solver's scale."""

    def __init__(self, fit: Fit, limit: float, show: Show):
        self.fit, self.problem, self.limit, self.show = fit, fit.problem, limit, show
        # if the noise is undetermined, that of an exact fit up to rounding
        known = np.isfinite(fit.noise) and fit.noise > 0
        self.variance = float(fit.noise**2) if known else self.problem.exact_squares
        self.error = fit.standard_error / self.problem.steps_at(fit.value)
        self.starts: list[Lowest] = []
        self.in_a_valley = fit.rank < len(fit.names)  # the best minimum
        self.add_starts(fit.starts)

    def add_starts(self, minima: Sequence[FitMinimum]) -> None:
        """Start from these minima, too: the lowest, and others near it that are apart."""
        new = [Lowest(end.sum_of_squares, self.problem.point(end.value)) for end in minima]
        starts = [*self.starts, *new]
        self.best, least = starts[0], RANK_TOLERANCE[self.problem.precision]
        for start, end in zip(new, minima):
            if self._is_below(start.squares, self.best.squares):
                rank = np.linalg.matrix_rank(end.jacobian, rtol=least)
                self.best, self.in_a_valley = start, rank < len(self.fit.names)
        self.lowest, self.starts = self.best, []
        for start in (self.best, *starts):
            apart = all(np.abs(start.y - other.y).max() > SAME_VALUE for other in self.starts)
            if apart and self.of(start.squares) <= self.limit:
                self.starts.append(start)
        if self.in_a_valley:  # they are ends in it
            self.starts = [self.best]

    def minimize(
        self, trials: Sequence[tuple[tuple[int, ...], Sequence[float], np.ndarray]]
    ) -> Ends:
        """Minima over the other parameters, all side by side; `lowest` becomes the least of them.

        A trial says which parameters are fixed, at which values, and from which y (Q,) it begins.
        """
        points = np.array([y for _, _, y in trials])
        # of the Q entries of y the first P are parameters, and the others stay
        fixed = np.tile(np.arange(points.shape[1]) >= len(self.fit.names), (len(points), 1))
        for k, (which, values, _) in enumerate(trials):
            points[k, which], fixed[k, which] = values, True
        solver = Solver(max_steps=PASSES, show=self.show, damping=NEAR)
        ends = minimize(
            [self.problem.least_squares()], points, solver, _STOP, what="fixed values", fixed=fixed
        )
        least = int(np.argmin(ends.squares))
        if self._is_below(ends.squares[least], self.lowest.squares):
            self.lowest = Lowest(float(ends.squares[least]), ends.y[least])
        return ends

    def _is_below(self, squares: float, other: float) -> bool:
        """Whether a sum of squares is less than another one by more than rounding."""
        return bool(squares < other * (1 - SAME) - self.problem.exact_squares)

    def of(self, squares: float) -> float:
        """Sums of squares above the least, over the noise variance."""
        return max((squares - self.best.squares) / self.variance, 0.0)

    def values(self, i: int, y: Any) -> Any:
        """Values of the i-th parameter of scaled ones."""
        return unscaled(
            y, float(self.problem.variables.scale[i]), bool(self.problem.variables.log[i])
        )

    def reach(self, i: int) -> tuple[float, float]:
        """The bounds of the i-th parameter, scaled; infinite ones as far as starts reach."""
        low, high, best = (
            self.problem.variables.low[i],
            self.problem.variables.high[i],
            self.best.y[i],
        )
        low = low if np.isfinite(low) else best - START_SCALES
        return float(low), float(high if np.isfinite(high) else best + START_SCALES)

    def fill(self, grids: Sequence[Grid]) -> list[dict[Index, Lowest]]:
        """Cells of grids, from the minima outwards until beyond the limit, many side by side.

        Each cell below the limit starts its neighbours from its own minimum, also those that were
        reached from another start. One above may lie on a ridge: once more from the best.
        """
        known: list[dict[Index, Lowest]] = [{} for _ in grids]
        ahead = {
            (g, grid.nearest(start.y), branch): start.y
            for g, grid in enumerate(grids)
            for branch, start in enumerate(self.starts)
        }
        while ahead:
            ends = self.minimize(
                [(grids[g].which, grids[g].at(cell), y) for (g, cell, _), y in ahead.items()]
            )
            trials, ahead = list(ahead), {}
            for (g, cell, branch), squares, y in zip(trials, ends.squares.tolist(), ends.y):
                cells = known[g]
                if cell in cells and not squares < (1 - SAME) * cells[cell].squares:
                    continue
                cells[cell] = Lowest(squares, y, branch)
                if self.of(squares) > self.limit:
                    if branch != _FROM_BEST:
                        ahead[g, cell, _FROM_BEST] = self.best.y
                    continue
                for near in grids[g].neighbours(cell):
                    if near not in cells or cells[near].branch != branch:
                        ahead[g, near, branch] = y
        return known


def _check_profiled(fit: Fit, level: float, points: int) -> None:
    """Raise an error unless these are arguments of profiles or contours of a fit."""
    check_level(level)
    as_whole("points", points, 3)
    check_kind("fit", fit, Fit)
    if not fit.can_be_profiled:
        raise ValueError(
            "Argument `fit` must be by least squares, and not of a matrix that must be admissible."
        )


# ---------------------------------------------------------------------------- profiles


def profile(
    fit: Fit,
    names: str | Iterable[str] | None = None,
    *,
    level: float = LEVEL,
    points: int = PROFILE_STARTS,
    progress: float | None = None,
) -> tuple[Profile, ...]:
    """Profile likelihoods of parameters: intervals without the assumption of a parabola.

    Equation: `D(x_i) = (min over the others of |r|^2 - least |r|^2) / s^2 <= q^2`, q the quantile
    of the normal law where sigma is known (s = 1), else of Student's t (s = `fit.noise`).

    From each minimum values are fixed in both directions, each searched from its neighbour's
    minimum, until D is above the limit; then its ends are searched for. All parameters go side by
    side. Of a fit from one start, which has not searched for other minima, these are searched for
    first, as `fit` does.
    Without sigma and with no degree of freedom left, the interval is that of the values which
    reproduce the data exactly.

    Args:
        fit: by least squares.
        names: of parameters; None: all.
        level: of the confidence intervals, in (0, 1).
        points: starts of that search, at least 3; after a fit from several starts there are none.
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
    _check_profiled(fit, level, points)
    wanted = fit.names if names is None else as_names("names", names)
    for name in wanted:
        check_choice("names", name, fit.names)
    return profiles_of(fit, [fit.names.index(name) for name in wanted], level, points, progress)


def profiles_of(
    fit: Fit, which: Sequence[int], level: float, points: int, progress: float | None
) -> tuple[Profile, ...]:
    """Profiles of these parameters; points: starts of a search for more minima."""
    with progress_bar(progress) as show:
        lines = _Lines(fit, fit.quantile(level) ** 2, show)
        if points and fit.start_count == 1:
            lines.add_starts(find_minima(fit.problem, points, fit.seed, Solver(show=show)).starts)
        for _ in range(ROUNDS):
            profiles = lines.profiles(which, level)
            if lines.lowest is lines.best:
                break
            end = lines.minimize([((), (), lines.lowest.y)])
            lines.add_starts(solution_of(fit.problem, end).starts)
    return profiles


class _Lines(Deviances):
    """Deviances of one parameter each, and where they pass the limit of an interval."""

    def grid(self, i: int) -> Grid:
        """Values of the i-th parameter, the denser the nearer to a start."""
        low, high = self.reach(i)
        centres = np.array([start.y[i] for start in self.starts])
        first, widest = STEP * np.sqrt(self.limit) * self.error[i], FIRST_SHARE * (high - low)
        if not 0 < first < widest:
            first = widest
        count = np.log(1 + (GROWTH - 1) * (high - low) / first) / np.log(GROWTH)
        away = first * (GROWTH ** np.arange(1, count + 1) - 1) / (GROWTH - 1)
        near = centres[:, None] + np.concatenate([-away, away])
        owner = np.abs(near[..., None] - centres).argmin(axis=-1)
        near = near[(owner == np.arange(len(centres))[:, None]) & (near > low) & (near < high)]
        return Grid((i,), (np.unique([*centres, low, high, *near]),))

    def profiles(self, which: Sequence[int], level: float) -> tuple[Profile, ...]:
        """The profiles of these parameters.

        Where deviances pass the limit is found by regula falsi in their roots, all ends side by
        side. Each value is searched from both sides, as minima may change places between them.
        """
        grids = [self.grid(i) for i in which]
        lines = [
            {float(grid.values[0][k]): cell for (k,), cell in cells.items()}
            for grid, cells in zip(grids, self.fill(grids))
        ]
        for turn in range(ROUNDS):
            trials = []
            for n, line in enumerate(lines):
                for inside, outside, p, q in self._crossings(line):
                    share = np.clip(p / (p - q), 0.02, 0.98) if turn % 3 < 2 else 0.5
                    value = float(inside + share * (outside - inside))
                    trials += [(n, value, line[side].y) for side in (inside, outside)]
            if not trials:
                break
            ends = self.minimize([((which[n],), (value,), y) for n, value, y in trials])
            for (n, value, _), squares, y in zip(trials, ends.squares.tolist(), ends.y):
                end = Lowest(squares, y)
                lines[n][value] = min(lines[n].get(value, end), end, key=lambda e: e.squares)
        return tuple(self.profile(i, line, level) for i, line in zip(which, lines))

    def _crossings(self, line: dict[float, Lowest]) -> Iterator[tuple[float, float, float, float]]:
        """Ends that are not settled: values inside and outside, and by how much they pass.

        That is the root of the deviance over that of the limit, less 1.
        """
        values, deviance = self.deviance(line)
        height, inside = np.sqrt(deviance / self.limit) - 1, values[deviance <= self.limit]
        least = END * max(np.ptp(inside), END * abs(inside[0]))
        for k in np.flatnonzero((height[:-1] <= 0) != (height[1:] <= 0)):
            a, b = (k, k + 1) if height[k] <= 0 else (k + 1, k)
            if min(-height[a], height[b]) > END and abs(values[b] - values[a]) > least:
                yield values[a], values[b], height[a], height[b]

    def deviance(self, line: dict[float, Lowest]) -> tuple[np.ndarray, np.ndarray]:
        """Fixed values in order, and their deviances."""
        values = sorted(line)
        return np.array(values), np.array([self.of(line[y].squares) for y in values])

    def profile(self, i: int, line: dict[float, Lowest], level: float) -> Profile:
        """The profile of a parameter from all that was solved."""
        y, deviance = self.deviance(line)
        deviance = deviance - deviance.min()
        below = np.flatnonzero(deviance <= self.limit)
        low, high = self.problem.domains[i].tolist()
        intervals = tuple(
            (self._end(i, y, deviance, piece[0], -1), self._end(i, y, deviance, piece[-1], 1))
            for piece in np.split(below, np.flatnonzero(np.diff(below) > 1) + 1)
        )
        is_own = np.array_equal(self.best.y, self.problem.point(self.fit.value))
        return Profile(
            name=self.fit.names[i],
            value=self.values(i, y),
            deviance=deviance,
            limit=self.limit,
            level=level,
            intervals=intervals,
            domain=(low, high),
            better=None if is_own else self.problem.values_at(self.best.y),
        )

    def _end(self, i: int, y: np.ndarray, deviance: np.ndarray, k: int, step: int) -> float:
        """Where the deviance passes the limit beyond the k-th fixed value, or the domain's end."""
        beyond = k + step
        if not 0 <= beyond < len(y):
            return float(self.problem.domains[i][(step + 1) // 2])
        p, q = np.sqrt(deviance[k]), np.sqrt(deviance[beyond])
        share = (np.sqrt(self.limit) - p) / (q - p)
        return float(self.values(i, y[k] + share * (y[beyond] - y[k])))


def needs_profiles(fit: Fit) -> bool:
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
    fit: Fit,
    first: str,
    second: str,
    *,
    level: float = LEVEL,
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
    _check_profiled(fit, level, points)
    check_choice("first", first, fit.names)
    check_choice("second", second, fit.names)
    if first == second:
        raise ValueError(f"Arguments `first` and `second` must differ, but both are {first!r}.")
    freedom, pair = fit.degrees_of_freedom, (fit.names.index(first), fit.names.index(second))
    limit = float(-2 * np.log(1 - level))
    if fit.problem.sigma is None and freedom > 0:
        limit = float(freedom * ((1 - level) ** (-2 / freedom) - 1))
    with progress_bar(progress) as show:
        deviances, width = Deviances(fit, limit, show), _BEYOND * np.sqrt(limit)
        values = []
        for i in pair:
            pieces, scale = (
                fit.linearized_interval(i, width),
                np.asarray(fit.problem.variables.scale)[i],
            )
            outer = np.array([pieces[0][0], pieces[-1][1]])
            outer = scaled(outer, scale, fit.problem.parameters.log[i])
            low, high = np.clip(outer, *deviances.reach(i)).tolist()
            values.append(np.linspace(low, high, points))
        (cells,) = deviances.fill([Grid(pair, (values[0], values[1]))])
    squares = np.full((points, points), np.inf)
    for cell, known in cells.items():
        squares[cell] = known.squares
    deviance = np.maximum((squares - deviances.lowest.squares) / deviances.variance, 0.0)
    if deviance.min() > limit:
        raise ValueError(
            f"Argument `points` must be larger: the region falls between {points} values of "
            f"{first} and of {second} (or take `profile`, which needs no grid)."
        )
    return Contour(
        names=(first, second),
        x=deviances.values(pair[0], values[0]),
        y=deviances.values(pair[1], values[1]),
        deviance=deviance,
        limit=limit,
        level=level,
        best=(float(fit.value[pair[0]]), float(fit.value[pair[1]])),
        log=tuple(bool(fit.problem.parameters.log[i]) for i in pair),  # type: ignore[arg-type]
    )
