"""How well data are fitted with some parameters fixed: profiles, from the minima
outwards.

A standard error is half the width of a parabola. Where the sum of squares is not a
parabola (at a bound, in a flat valley, with several minima), the profile gives the
interval: one-sided, or of several pieces. Profiles and contours are one search: a grid
of fixed values, on a line or in a plane, is filled from the minima outwards.
"""

from collections.abc import Iterator, Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jimpact.fits.estimate import Estimate
from jimpact.fits.findings import Finding
from jimpact.fits.intervals import Profile
from jimpact.fits.parameters import unscaled
from jimpact.fits.search import (
    SAME_VALUE,
    START_SCALES,
    FitMinimum,
    find_minima,
    solution_of,
)
from jimpact.fits.solve import RANK_TOLERANCE, Ends, Solver, minimize
from jimpact.tools.progress import Show, progress_bar

# Deviances are right to this (see `solve.FINE`): the ends of an interval move by less
# than END. A search that goes on after so many passes creeps along a kink. It begins
# near its end.
_STOP = 1e-4
PASSES = 16
NEAR = 1e-6
# Values beside a minimum: the first raises the root of the deviance of a parabola by
# STEP of the limit's, each further one is GROWTH times as far from its neighbour.
STEP = 0.4
GROWTH = 1.5
# of what can be reached: the first value where the error is infinite
FIRST_SHARE = 1 / 16
# Share of the root of the limit, or of the values inside, to which an end is searched
# for.
END = 1e-3
# of the search for an end: it is then right to a millionth of a step, mostly
ROUNDS = 8
PROFILE_STARTS = 17  # by default, of a search for more minima
_FROM_BEST = -1  # the branch of what was searched from the best minimum


class Lowest(NamedTuple):
    """A minimum with some parameters fixed: |r|^2, at y, and the start that it descends
    from.

    `branch` is the index of that start, `_FROM_BEST` of the best minimum.
    """

    squares: float
    y: Float[np.ndarray, " Q"]
    branch: int = _FROM_BEST


Index = tuple[int, ...]


class Grid(NamedTuple):
    """A grid of fixed values of the parameters `which`, in the solver's scale.

    `values` are the rising coordinates on each axis; a cell is an index on each axis.
    """

    which: tuple[int, ...]
    values: tuple[np.ndarray, ...]

    def at(self, cell: Index) -> list[float]:
        """The values of the parameters at a cell."""
        places = zip(self.values, cell)
        return [float(values[k]) for values, k in places]

    def nearest(self, y: Float[np.ndarray, " Q"]) -> Index:
        """The cell nearest to y."""
        axes = zip(self.which, self.values)
        return tuple(int(np.abs(v - y[i]).argmin()) for i, v in axes)

    def neighbours(self, cell: Index) -> list[Index]:
        """Cells adjacent to one, diagonal ones too."""
        axes = [
            range(max(k - 1, 0), min(k + 2, len(v))) for k, v in zip(cell, self.values)
        ]
        return [near for near in product(*axes) if near != cell]


class Deviances:
    """Deviances `D = (S - S_best) / s^2` of a fit, S = |r|^2 at its least with
    parameters fixed.

    Attributes:
        limit: deviance at the end of the interval, or of the region.
        same: relative difference up to which sums of squares are equal: what impacts
            are good to. Ten times less: profiles find lower minima in rounding.
        variance: s^2 of the noise.
        error: (P,) standard errors in the solver's scale.
        starts: minima that searches start from, the best one first.
        best: the best of the minima known before; `lowest`: of all that have been
            computed.
        in_a_valley: True where the Jacobian at the best minimum has not full rank.
    """

    def __init__(self, fit: Estimate[Any], limit: float, show: Show):
        """Start from the minima of the fit; `limit` is a deviance, `show` displays
        progress.
        """
        self.fit = fit
        self.problem = fit.problem
        self.limit = limit
        self.show = show
        self.same = RANK_TOLERANCE[self.problem.precision]
        has_noise = np.isfinite(fit.noise) and fit.noise > 0
        # of an exact fit: that of rounding
        if has_noise:
            self.variance = float(fit.noise**2)
        else:
            self.variance = self.problem.exact_squares
        self.error = fit.standard_error / self.problem.steps_at(fit.value)
        self.starts: list[Lowest] = []
        self.in_a_valley = fit.rank < len(fit.names)
        self.add_starts(fit.starts)

    def add_starts(self, minima: Sequence[FitMinimum]) -> None:
        """Add minima to `starts`, and keep the best one and all others within the
        limit.

        Of minima that differ by less than `SAME_VALUE` one is kept; in a valley, the
        best one only.
        """
        new = [
            Lowest(end.sum_of_squares, self.problem.variables.point(end.value))
            for end in minima
        ]
        starts = [*self.starts, *new]
        self.best, least = starts[0], RANK_TOLERANCE[self.problem.precision]
        for start, end in zip(new, minima):
            if self._is_below(start.squares, self.best.squares):
                rank = np.linalg.matrix_rank(end.jacobian, rtol=least)
                self.best, self.in_a_valley = start, rank < len(self.fit.names)
        self.lowest = self.best
        self.starts = []
        for start in (self.best, *starts):
            apart = all(
                np.abs(start.y - other.y).max() > SAME_VALUE for other in self.starts
            )
            if apart and self.of(start.squares) <= self.limit:
                self.starts.append(start)
        if self.in_a_valley:  # the others are points of the same valley
            self.starts = [self.best]

    def minimize(
        self,
        trials: Sequence[
            tuple[tuple[int, ...], Sequence[float], Float[np.ndarray, " Q"]]
        ],
    ) -> Ends:
        """Least squares over the parameters that are not fixed, all trials side by
        side.

        A trial holds the indices of the fixed parameters, their values (scaled), and
        the start y. `lowest` is updated.
        """
        points = np.array([y for _, _, y in trials])
        # of the Q entries of y the first P are parameters, and the others stay
        is_constant = np.arange(points.shape[1]) >= len(self.fit.names)
        fixed = np.tile(is_constant, (len(points), 1))
        for k, (which, values, _) in enumerate(trials):
            points[k, which] = values
            fixed[k, which] = True
        solver = Solver(max_steps=PASSES, show=self.show, damping=NEAR)
        ends = minimize(
            [self.problem.least_squares()],
            points,
            solver,
            _STOP,
            what="fixed values",
            fixed=fixed,
        )
        least = int(np.argmin(ends.squares))
        if self._is_below(ends.squares[least], self.lowest.squares):
            squares = float(ends.squares[least])
            self.lowest = Lowest(squares, ends.y[least])
        return ends

    def _is_below(self, squares: float, other: float) -> bool:
        """True if a sum of squares is less than another one by more than rounding."""
        less = other * (1 - self.same)
        return bool(squares < less - self.problem.exact_squares)

    def of(self, squares: float) -> float:
        """The deviance `(S - S_best) / s^2` of a sum of squares, at least 0."""
        return max((squares - self.best.squares) / self.variance, 0.0)

    def values(self, i: int, y: Any) -> Any:
        """Values x_i of the i-th parameter from scaled values y_i."""
        variables = self.problem.variables
        return unscaled(y, float(variables.scale[i]), bool(variables.log[i]))

    def reach(self, i: int) -> tuple[float, float]:
        """Scaled bounds of the i-th parameter; in the place of infinite ones, y_i -+
        START_SCALES.

        y_i is that of the best minimum.
        """
        variables = self.problem.variables
        best = self.best.y[i]
        low = variables.low[i]
        high = variables.high[i]
        if not np.isfinite(low):
            low = best - START_SCALES
        highest = high if np.isfinite(high) else best + START_SCALES
        return float(low), float(highest)

    def fill(self, grids: Sequence[Grid]) -> list[dict[Index, Lowest]]:
        """Minima by cell, for each grid: a flood fill from `starts` until deviances
        pass the limit.

        Each cell below the limit starts its neighbours from its own minimum, also those
        that were reached from another start. One above may lie on a ridge: it is
        repeated from the best minimum. A sweep computes all waiting cells of all grids
        side by side.
        """
        minima: list[dict[Index, Lowest]] = [{} for _ in grids]
        # y to start from, by index of the grid, cell, and index of the start (branch)
        waiting = {
            (g, grid.nearest(start.y), branch): start.y
            for g, grid in enumerate(grids)
            for branch, start in enumerate(self.starts)
        }
        while waiting:
            ends = self.minimize(
                [
                    (grids[g].which, grids[g].at(cell), y)
                    for (g, cell, _), y in waiting.items()
                ]
            )
            trials = list(waiting)
            waiting = {}
            for (g, cell, branch), squares, y in zip(
                trials, ends.squares.tolist(), ends.y
            ):
                cells = minima[g]
                if (
                    cell in cells
                    and not squares < (1 - self.same) * cells[cell].squares
                ):
                    continue  # not lower than from another start
                cells[cell] = Lowest(squares, y, branch)
                if self.of(squares) > self.limit:  # no further in this direction
                    if branch != _FROM_BEST:
                        waiting[g, cell, _FROM_BEST] = self.best.y
                    continue
                for near in grids[g].neighbours(cell):
                    if near not in cells or cells[near].branch != branch:
                        waiting[g, near, branch] = y
        return minima


def profiles_of(
    fit: Estimate[Any],
    which: Sequence[int],
    level: float,
    points: int,
    progress: float | None,
) -> tuple[Profile, ...]:
    """Profiles of the parameters of these indices, repeated where they find a lower
    minimum.

    Args:
        fit: by least squares.
        which: indices of parameters.
        level: of the confidence intervals.
        points: number of starts of a search for more minima, after a fit from one
            start.
        progress: bar on stderr; None: on a terminal.
    """
    with progress_bar(progress) as show:
        lines = Lines(fit, fit.quantile(level) ** 2, show)
        if points and fit.start_count == 1:
            solver = Solver(show=show)
            minima = find_minima(fit.problem, points, fit.seed, solver)
            lines.add_starts(minima.starts)
        for _ in range(ROUNDS):
            profiles = lines.profiles(which, level)
            if lines.lowest is lines.best:
                break
            end = lines.minimize([((), (), lines.lowest.y)])
            lines.add_starts(solution_of(fit.problem, end).starts)
    return profiles


class _Crossing(NamedTuple):
    """Two neighbouring fixed values (scaled), one below the limit of the deviance, one
    above.

    `below` and `above` are `sqrt(D / limit) - 1` there.
    """

    inside: float
    outside: float
    below: float
    above: float


class Lines(Deviances):
    """Profiles: deviances over the values of one parameter, and where they pass the
    limit.
    """

    def grid(self, i: int) -> Grid:
        """Fixed values of the i-th parameter, scaled: its bounds, and around the
        minima.

        Equation: at distances `d (a^k - 1) / (a - 1)`, k = 1, 2, .., to both sides of
        each start, with a = `GROWTH`, `d = STEP sqrt(limit) error`, as far as no other
        start is nearer.
        """
        low, high = self.reach(i)
        centres = np.array([start.y[i] for start in self.starts])
        first = STEP * np.sqrt(self.limit) * self.error[i]
        widest = FIRST_SHARE * (high - low)
        if not 0 < first < widest:
            first = widest
        growths = (GROWTH - 1) * (high - low) / first
        count = np.log(1 + growths) / np.log(GROWTH)
        powers = GROWTH ** np.arange(1, count + 1)
        away = first * (powers - 1) / (GROWTH - 1)
        near = centres[:, None] + np.concatenate([-away, away])  # a row for each start
        distances = np.abs(near[..., None] - centres)
        owner = distances.argmin(axis=-1)  # the nearest start
        own = owner == np.arange(len(centres))[:, None]
        near = near[own & (near > low) & (near < high)]
        values = np.unique([*centres, low, high, *near])
        return Grid((i,), (values,))

    def profiles(self, which: Sequence[int], level: float) -> tuple[Profile, ...]:
        """Profiles of the parameters of these indices.

        The values at which the deviance D passes the limit are found by regula falsi on
        `sqrt(D / limit) - 1` (every third step by bisection), all ends side by side.
        Each value is solved from the minima of both neighbours, as minima may change
        places between them.
        """
        grids = [self.grid(i) for i in which]
        lines = [
            {float(grid.values[0][k]): cell for (k,), cell in cells.items()}
            for grid, cells in zip(grids, self.fill(grids))
        ]
        for turn in range(ROUNDS):
            trials = []  # index of the line, fixed value, start y
            for n, line in enumerate(lines):
                for inside, outside, below, above in self._crossings(line):
                    # not at the ends
                    falsi = np.clip(below / (below - above), 0.02, 0.98)
                    if turn % 3 < 2:
                        share = falsi
                    else:
                        share = 0.5
                    value = float(inside + share * (outside - inside))
                    trials += [(n, value, line[end].y) for end in (inside, outside)]
            if not trials:
                break
            trials_of_lines = [((which[n],), (value,), y) for n, value, y in trials]
            ends = self.minimize(trials_of_lines)
            for (n, value, _), squares, y in zip(trials, ends.squares.tolist(), ends.y):
                end = Lowest(squares, y)
                lines[n][value] = min(
                    lines[n].get(value, end), end, key=lambda e: e.squares
                )
        lines_of_parameters = zip(which, lines)
        return tuple(self.profile(i, line, level) for i, line in lines_of_parameters)

    def _crossings(self, line: dict[float, Lowest]) -> Iterator[_Crossing]:
        """Neighbouring values between which the deviance passes the limit, if not near
        enough yet.

        Near enough: `sqrt(D / limit) - 1` is within `END` at one of them, or they are
        close.
        """
        values, deviance = self.deviance(line)
        height = np.sqrt(deviance / self.limit) - 1
        inside = values[deviance <= self.limit]
        width = np.ptp(inside)
        least = END * max(width, END * abs(inside[0]))
        below = height <= 0
        for k in np.flatnonzero(below[:-1] != below[1:]):
            if height[k] <= 0:
                a = k
                b = k + 1
            else:
                a = k + 1
                b = k
            if min(-height[a], height[b]) > END and abs(values[b] - values[a]) > least:
                yield _Crossing(values[a], values[b], height[a], height[b])

    def deviance(
        self, line: dict[float, Lowest]
    ) -> tuple[Float[np.ndarray, " G"], Float[np.ndarray, " G"]]:
        """Fixed values in order, and their deviances."""
        values = sorted(line)
        deviances = [self.of(line[y].squares) for y in values]
        return np.array(values), np.array(deviances)

    def profile(self, i: int, line: dict[float, Lowest], level: float) -> Profile:
        """The profile of parameter i from the minima at its fixed values, `line`.

        Each run of neighbouring values below the limit is a piece of the confidence
        interval.
        """
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
        point = self.problem.variables.point(self.fit.value)
        is_of_fit = np.array_equal(self.best.y, point)
        return Profile(
            name=self.fit.names[i],
            value=self.values(i, y),
            deviance=deviance,
            limit=self.limit,
            level=level,
            intervals=intervals,
            domain=(low, high),
            better=None if is_of_fit else self.problem.values_at(self.best.y),
        )

    def _end(
        self,
        i: int,
        y: Float[np.ndarray, " G"],
        deviance: Float[np.ndarray, " G"],
        k: int,
        step: int,
    ) -> float:
        """End of an interval: where the deviance D passes the limit, or the end of the
        domain.

        By linear interpolation of sqrt(D) between the values k and k + step.

        Args:
            i: index of the parameter.
            y: fixed values, scaled.
            deviance: of each value.
            k: index of the last value below the limit.
            step: -1 for the lower end, 1 for the upper.
        """
        beyond = k + step
        if not 0 <= beyond < len(y):
            return float(self.problem.domains[i][(step + 1) // 2])
        root = np.sqrt(deviance[k])
        root_beyond = np.sqrt(deviance[beyond])
        share = (np.sqrt(self.limit) - root) / (root_beyond - root)
        crossing = y[k] + share * (y[beyond] - y[k])
        return float(self.values(i, crossing))


def lower_minimum(
    names: tuple[str, ...], profiles: Sequence[Profile]
) -> Iterator[Finding]:
    """Yield `lower_minimum` where profiles have found a minimum below that of the
    fit.
    """
    if profiles and (better := profiles[0].better) is not None:
        values = ", ".join(f"{name} {x:.4g}" for name, x in zip(names, better))
        line = (
            f"A profile found a lower minimum than the fit ({values}): allow more "
            f"`starts`."
        )
        yield Finding("lower_minimum", line, "a profile found a lower minimum")
