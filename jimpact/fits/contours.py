"""Confidence regions of two parameters at once: how well the data are fitted with both fixed."""

from dataclasses import dataclass

import numpy as np

from jimpact._checks import as_whole, check_choice
from jimpact.fits.fitting import Fit
from jimpact.fits.intervals import check_level
from jimpact.fits.scaled import ScaledFit, check_profiled
from jimpact.progress import Show, progress_bar

_BEYOND = 1.3  # how far the picture goes, in half-widths of the region of a parabola


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
    check_profiled(fit)
    for argument, name in (("first", first), ("second", second)):
        check_choice(argument, name, fit.names)
    if first == second:
        raise ValueError(f"Arguments `first` and `second` must differ, but both are {first!r}.")
    limit, i, j = _limit(fit, level), fit.names.index(first), fit.names.index(second)
    scaled, width = ScaledFit(fit), _BEYOND * np.sqrt(limit)
    x, y = (
        np.linspace(*scaled.reach(k, fit.linearized_interval(k, width)), points) for k in (i, j)
    )
    with progress_bar(progress) as show:
        deviance = _flood(scaled, (i, j), (x, y), limit, show)
    if deviance.min() > limit:
        raise ValueError(
            f"Argument `points` must be larger: the region falls between {points} values of "
            f"{first} and of {second} (or take `profile`, which needs no grid)."
        )
    return Contour(
        names=(first, second),
        x=scaled.values(i, x),
        y=scaled.values(j, y),
        deviance=np.maximum(deviance, 0.0),
        limit=limit,
        level=level,
        best=(float(fit.value[i]), float(fit.value[j])),
        log=(bool(scaled.log[i]), bool(scaled.log[j])),
    )


def _limit(fit: Fit, level: float) -> float:
    """Deviance at the boundary of the region of two parameters."""
    freedom = fit.degrees_of_freedom
    if fit.problem.sigma is not None or freedom < 1:
        return float(-2 * np.log(1 - level))
    return float(freedom * ((1 - level) ** (-2 / freedom) - 1))


def _flood(
    scaled: ScaledFit,
    pair: tuple[int, int],
    values: tuple[np.ndarray, np.ndarray],
    limit: float,
    show: Show,
) -> np.ndarray:
    """Deviances on the grid of fixed values, from the minima outwards; inf where not computed.

    Each cell below the limit starts its neighbours from its own minimum.
    """
    fit, ends = scaled.fit, {}
    squares = np.full((len(values[0]), len(values[1])), np.inf)
    ahead: dict[tuple[int, int], np.ndarray] = {}
    for value in (fit.value, *(minimum.value for minimum in fit.starts[1:])):
        point = scaled.problem.point(value)
        row, column = (int(np.argmin(np.abs(v - point[i]))) for v, i in zip(values, pair))
        ahead[row, column] = point
    while ahead:
        fixed = []
        for cell, near in ahead.items():
            point = near.copy()
            point[list(pair)] = [v[k] for v, k in zip(values, cell)]
            fixed.append((pair, point))
        totals, states = scaled.minimize(fixed, show)
        for k, cell in enumerate(ahead):
            squares[cell], ends[cell] = totals[k], np.asarray(states.y[k], float)
        scaled.least = min(scaled.least, float(totals.min()))
        ahead = {
            neighbour: ends[cell]
            for cell in ahead
            if scaled.deviance_of(squares[cell]) <= limit
            for neighbour in _neighbours(cell, len(squares))
            if neighbour not in ends
        }
    return scaled.deviance_of(squares)


def _neighbours(cell: tuple[int, int], points: int) -> list[tuple[int, int]]:
    """Cells of a square grid next to one, diagonal ones too."""
    near = [(cell[0] + i, cell[1] + j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
    return [(i, j) for i, j in near if 0 <= i < points and 0 <= j < points]
