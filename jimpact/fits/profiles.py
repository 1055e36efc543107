"""Profiles and contours of a fit: intervals and regions without the assumption of a
parabola.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from jimpact.fits.deviances import PROFILE_STARTS, Deviances, Grid, profiles_of
from jimpact.fits.estimate import LEVEL, in_own_precision
from jimpact.fits.intervals import Profile, check_level
from jimpact.fits.parameters import as_names, scaled
from jimpact.fits.report import Fit
from jimpact.tools.checks import as_whole, check_choice, check_kind
from jimpact.tools.progress import progress_bar

# how far a contour's picture goes, in half-widths of the region of a parabola
_BEYOND = 1.3


def _check_profiled(fit: Fit, level: float, points: int) -> None:
    """Raise an error unless the fit can be profiled, and level and points are in their
    ranges.
    """
    check_level(level)
    as_whole("points", points, 3)
    check_kind("fit", fit, Fit)
    if not fit.can_be_profiled:
        raise ValueError(
            "Argument `fit` must be by least squares, and not of a matrix that must be "
            "admissible."
        )


@in_own_precision
def profile(
    fit: Fit,
    names: str | Iterable[str] | None = None,
    *,
    level: float = LEVEL,
    points: int = PROFILE_STARTS,
    progress: float | None = None,
) -> tuple[Profile, ...]:
    """Profile likelihoods of parameters: intervals that assume no parabola.

    Equation: `D(x_i) = (min over the others of |r|^2 - least |r|^2) / s^2 <= q^2`, q
    the quantile of the normal law where sigma is known (s = 1), else of Student's t (s
    = `fit.noise`).

    From each minimum values are fixed in both directions, each searched from its
    neighbour's minimum, until D is above the limit; then its ends are searched for. All
    parameters go side by side. Of a fit from one start, which has not searched for
    other minima, these are searched for first, as `fit` does.
    Without sigma and with no degree of freedom left, the interval is that of the values
    which reproduce the data exactly.

    Args:
        fit: by least squares.
        names: of parameters; None: all.
        level: of the confidence intervals, in (0, 1).
        points: starts of that search, at least 3; after a fit from several starts there
            are none.
        progress: bar on stderr; None: on a terminal, once it takes longer than two
            seconds.

    Returns:
        A `Profile` for each name; `print` says its interval.

    Raises:
        ValueError: level, points or names; a robust loss; a matrix that must be
            admissible.

    >>> import jimpact as ji
    >>> data = ji.Experiments(
    ...     [[1.0, 0.0], [2.0, 0.0]], [[0.01, 0.98], [0.0, 2.01]], sigma=0.02
    ... )
    >>> result = ji.fit(ji.Newton(0.9), ji.chain([1.0, 1.0]), data)
    >>> print(*ji.profile(result))
    restitution: at least 0.97321 (95 %)
    """
    _check_profiled(fit, level, points)
    if names is None:
        wanted = fit.names
    else:
        wanted = as_names("names", names)
    for name in wanted:
        check_choice("names", name, fit.names)
    return profiles_of(
        fit, [fit.names.index(name) for name in wanted], level, points, progress
    )


@dataclass(frozen=True, eq=False)
class Contour:
    """`deviance` (A, B) over `x` (A,) of one parameter and `y` (B,) of another one.

    `names` are those of the two parameters.

    The confidence region at `level` is where it is at most `limit`; inf where no
    neighbour is inside, which was not computed. `best`: the values of the fit. `log`:
    which of the two is fitted in its logarithm.
    """

    names: tuple[str, str]
    x: np.ndarray
    y: np.ndarray
    deviance: np.ndarray
    limit: float
    level: float
    best: tuple[float, float]
    log: tuple[bool, bool]


@in_own_precision
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

    Equation: `D(x, y) = (min over the others of |r|^2 - least |r|^2) / s^2 <= q`, where
    sigma is known s = 1 and q the quantile of chi^2 with 2 degrees of freedom, else s =
    `fit.noise` and q twice that of F with 2 and the degrees of freedom that are left.

    The values cover somewhat more than the region of a parabola, cut at the bounds; the
    whole domain of what the data cannot see. The region is filled from the minima of
    the fit outwards, from neighbour to neighbour, many side by side. `ji.plot.contour`
    draws it.

    Args:
        fit: by least squares.
        first, second: names of two of its parameters.
        level: of the region, in (0, 1).
        points: values of each, at least 3.
        progress: bar on stderr; None: on a terminal, once it takes longer than two
            seconds.

    Returns:
        `Contour` with `deviance` (points, points).

    Raises:
        ValueError: level, points or names; a robust loss; a matrix that must be
            admissible; a region so thin that no fixed value lies inside.

    >>> import jimpact as ji
    >>> pre, post = (
    ...     [[1.0, 0.0, -1.0], [2.0, 0.0, 0.0]],
    ...     [[-0.8, 0.1, 0.7], [0.1, 1.8, 0.1]],
    ... )
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
        raise ValueError(
            f"Arguments `first` and `second` must differ, but both are {first!r}."
        )
    freedom = fit.degrees_of_freedom
    pair = (fit.names.index(first), fit.names.index(second))
    limit = float(-2 * np.log(1 - level))
    if fit.problem.sigma is None and freedom > 0:
        limit = float(freedom * ((1 - level) ** (-2 / freedom) - 1))
    with progress_bar(progress) as show:
        deviances = Deviances(fit, limit, show)
        width = _BEYOND * np.sqrt(limit)
        values = []
        for i in pair:
            pieces = fit.linearized_interval(i, width)
            scale = np.asarray(fit.problem.variables.scale)[i]
            outer = np.array([pieces[0][0], pieces[-1][1]])
            outer = scaled(outer, scale, fit.problem.parameters.log[i])
            low, high = np.clip(outer, *deviances.reach(i)).tolist()
            values.append(np.linspace(low, high, points))
        (cells,) = deviances.fill([Grid(pair, (values[0], values[1]))])
    squares = np.full((points, points), np.inf)
    for cell, minimum in cells.items():
        squares[cell] = minimum.squares
    deviance = np.maximum(
        (squares - deviances.lowest.squares) / deviances.variance, 0.0
    )
    if deviance.min() > limit:
        raise ValueError(
            f"Argument `points` must be larger: the region falls between {points} "
            f"values of {first} and of {second} (or take `profile`, which needs no "
            f"grid)."
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
