"""How well data are fitted with some parameters fixed: profiles, from the minima outwards.

A standard error is half the width of a parabola. Where the sum of squares is not a parabola (at a
bound, in a flat valley, with several minima), the profile gives the interval: one-sided, or of
several pieces. Profiles and contours are one search: a grid of fixed values, on a line or in a
plane, is filled from the minima outwards.
"""

from collections.abc import Iterator, Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from jimpact.fits.estimate import Estimate
from jimpact.fits.findings import Finding
from jimpact.fits.intervals import Profile
from jimpact.fits.parameters import unscaled
from jimpact.fits.search import SAME_VALUE, START_SCALES, FitMinimum, find_minima, solution_of
from jimpact.fits.solve import RANK_TOLERANCE, Ends, Solver, minimize
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
PROFILE_STARTS = 17  # by default, of a search for more minima
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

    def __init__(self, fit: Estimate[Any], limit: float, show: Show):
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
        new = [
            Lowest(end.sum_of_squares, self.problem.variables.point(end.value)) for end in minima
        ]
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


def profiles_of(
    fit: Estimate[Any], which: Sequence[int], level: float, points: int, progress: float | None
) -> tuple[Profile, ...]:
    """Profiles of these parameters; points: starts of a search for more minima."""
    with progress_bar(progress) as show:
        lines = Lines(fit, fit.quantile(level) ** 2, show)
        if points and fit.start_count == 1:
            lines.add_starts(find_minima(fit.problem, points, fit.seed, Solver(show=show)).starts)
        for _ in range(ROUNDS):
            profiles = lines.profiles(which, level)
            if lines.lowest is lines.best:
                break
            end = lines.minimize([((), (), lines.lowest.y)])
            lines.add_starts(solution_of(fit.problem, end).starts)
    return profiles


class Lines(Deviances):
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
            (
                self._end(i, y, deviance, int(piece[0]), -1),
                self._end(i, y, deviance, int(piece[-1]), 1),
            )
            for piece in np.split(below, np.flatnonzero(np.diff(below) > 1) + 1)
        )
        is_own = np.array_equal(self.best.y, self.problem.variables.point(self.fit.value))
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


def lower_minimum(names: tuple[str, ...], profiles: Sequence[Profile]) -> Iterator[Finding]:
    """A minimum below that of the fit, which profiles have found."""
    if profiles and (better := profiles[0].better) is not None:
        values = ", ".join(f"{name} {x:.4g}" for name, x in zip(names, better))
        line = f"A profile found a lower minimum than the fit ({values}): allow more `starts`."
        yield Finding("lower_minimum", line, "a profile found a lower minimum")
