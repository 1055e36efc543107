"""Confidence regions of two parameters at once: how well the data are fitted with both held."""

from dataclasses import dataclass

import numpy as np

from jimpact._checks import as_whole
from jimpact.fits.fitting import Fit
from jimpact.fits.least_squares import DEFAULT_STEPS
from jimpact.fits.multistart import run_held
from jimpact.fits.problem import filled_up
from jimpact.fits.profiles import Scaled, check_profiled, linearized
from jimpact.progress import progress_bar

_BEYOND = 1.3  # how far the picture goes, in half-widths of the region of a parabola
_SWEEPS = 4  # of minima handed on to neighbours that have found a worse one


@dataclass(frozen=True, eq=False)
class Contour:
    """`deviance` (A, B) over values `x` (A,) of one parameter and `y` (B,) of another, by `names`.

    The confidence region at `level` is where it is at most `limit`. `best`: the values of the fit.
    `log`: which of the two is fitted in its logarithm.
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
    domain of what the data cannot see. All are solved side by side, from the minima of the fit and
    then from their better neighbours. `ji.plot.contour` draws it.

    Args:
        fit: by least squares.
        first, second: names of two of its parameters.
        level: of the region, in (0, 1).
        points: values of each, at least 3.
        progress: bar on stderr; None: on a terminal, once it takes longer than two seconds.

    Returns:
        `Contour` with `deviance` (points, points).

    Raises:
        ValueError: level, points or names; a robust loss; a matrix that is kept admissible.

    >>> import jimpact as ji
    >>> pre, post = [[1.0, 0.0, -1.0], [2.0, 0.0, 0.0]], [[-0.8, 0.1, 0.7], [0.1, 1.8, 0.1]]
    >>> data = ji.Experiments(pre, post, sigma=0.1)
    >>> found = ji.fit(ji.Newton([0.9, 0.9]), ji.chain([1.0, 1.0, 1.0]), data)
    >>> region = ji.contour(found, "restitution[1]", "restitution[2]", points=5)
    >>> region.deviance.shape, round(region.limit, 2)
    ((5, 5), 5.99)
    """
    if not 0 < level < 1:
        raise ValueError(f"Argument `level` must lie in (0, 1), but has value {level}.")
    as_whole("points", points, 3)
    check_profiled(fit)
    for name in (first, second):
        if name not in fit.names:
            known = ", ".join(fit.names)
            raise ValueError(f"Arguments `first`, `second` must be of {known}, but have {name!r}.")
    if first == second:
        raise ValueError(f"Arguments `first` and `second` must differ, but both are {first!r}.")
    pair = (fit.names.index(first), fit.names.index(second))
    freedom, known_noise = fit.degrees_of_freedom, fit.problem.sigma is not None
    if known_noise or freedom < 1:
        limit = -2 * np.log(1 - level)
    else:
        limit = freedom * ((1 - level) ** (-2 / freedom) - 1)
    scaled = Scaled(fit)
    x, y = (
        np.linspace(*scaled.reach(i, linearized(fit, i, _BEYOND * np.sqrt(limit))), points)
        for i in pair
    )
    minima = [scaled.point(fit.value), *(scaled.point(start.value) for start in fit.starts[1:])]
    held = []
    for a in x:
        for b in y:
            near = min(minima, key=lambda y: (y[pair[0]] - a) ** 2 + (y[pair[1]] - b) ** 2)
            point = near.copy()
            point[list(pair)] = a, b
            held.append((pair, point))
    shape = (points, points)
    residuals = filled_up(fit.problem.residuals)
    alone = len(fit.names) == 2  # nothing is left to be solved for
    with progress_bar(progress) as show:
        steps = 1 if alone else DEFAULT_STEPS["levenberg-marquardt"]
        states = run_held(residuals, held, steps, show)
        squares = 2 * np.asarray(states.cost, float)
        ends = np.asarray(states.y, float)
        for _ in range(0 if alone else _SWEEPS):
            tried = _better_neighbours(squares.reshape(shape))
            if not tried:
                break
            again = []
            for k, other in tried:
                point = ends[other].copy()
                point[list(pair)] = held[k][1][list(pair)]
                again.append((pair, point))
            more = run_held(residuals, again, steps, show)
            cost = 2 * np.asarray(more.cost, float)
            better = [i for i, (k, _) in enumerate(tried) if cost[i] < (1 - 1e-6) * squares[k]]
            for i in better:
                squares[tried[i][0]], ends[tried[i][0]] = cost[i], more.y[i]
            if not better:
                break
    least = min(fit.starts[0].sum_of_squares, float(squares.min()) * scaled.size**2)
    deviance = (squares * scaled.size**2 - least) / scaled.variance
    return Contour(
        names=(first, second),
        x=scaled.real(pair[0], x),
        y=scaled.real(pair[1], y),
        deviance=np.maximum(deviance, 0.0).reshape(shape),
        limit=float(limit),
        level=level,
        best=(float(fit.value[pair[0]]), float(fit.value[pair[1]])),
        log=(bool(scaled.log[pair[0]]), bool(scaled.log[pair[1]])),
    )


def _better_neighbours(squares: np.ndarray) -> list[tuple[int, int]]:
    """Points of a grid, numbered through, each with its best neighbour, if that is better."""
    rows, columns = squares.shape
    found = []
    for k in range(rows * columns):
        i, j = divmod(k, columns)
        beside = [
            (a, b)
            for a, b in ((i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1))
            if 0 <= a < rows and 0 <= b < columns
        ]
        a, b = min(beside, key=lambda at: squares[at])
        if squares[a, b] < squares[i, j]:
            found.append((k, a * columns + b))
    return found
