"""Pictures of the uncertainty of a fit: profiles, correlations, residuals."""

from collections.abc import Sequence
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.special import chdtri, ndtri

from jimpact.fits.intervals import Profile
from jimpact.fits.report import Fit
from jimpact.plot.style import (
    COLOURS,
    GREY,
    SMALL,
    new_figure,
    new_panels,
    styled,
    write,
)
from jimpact.tools.checks import check_choice, check_kind

_TITLE = 45  # letters of a line of a panel's title
_PARTS = 16  # of a profile between two of its points, as straight lines
_TOP = 3.0  # of a profile's axis, over the limit: only what is below matters
MOST = 6  # parameters of a corner plot: more panels could not be read
_WIDE = 3.5  # standard errors to each side in a corner plot
_SHARES = (0.68, 0.95)  # of the regions in it
_TWO_SIDED = 1.96  # standard errors: 95 % of normal noise lies within


@styled()
def profiles(result: tuple[Profile, ...] | list[Profile]) -> Figure:
    """Deviance over each parameter, with the limit and the interval below it.

    Between computed points, the dots, its root is drawn as linear: a parabola is one.

    Args:
        result: what `ji.profile` returned.

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    Raises:
        TypeError: something else than profiles.

    >>> import jimpact as ji
    >>> data = ji.Experiments(
    ...     [[1.0, 0.0], [2.0, 0.0]], [[0.3, 0.7], [0.6, 1.4]], sigma=0.02
    ... )
    >>> fit = ji.fit(ji.Newton(0.5), ji.chain([1.0, 1.0]), data)
    >>> len(ji.plot.profiles(ji.profile(fit)).axes)
    1
    """
    for each in result:
        check_kind("result", each, Profile)
    figure, grid = new_panels(len(result), 2.8)
    for axes, each in zip(grid, result):
        # sqrt(deviance) is linear between computed points: a parabola is drawn as one
        steps = len(each.value) - 1
        places = np.linspace(0, steps, _PARTS * steps + 1)
        index = range(len(each.value))
        between = np.interp(places, index, each.value)
        roots = np.sqrt(each.deviance)
        root = np.interp(between, each.value, roots)
        axes.plot(between, root**2, color=COLOURS[0], lw=1)
        axes.plot(each.value, each.deviance, ".", color=COLOURS[0], ms=4)
        axes.axhline(each.limit, color=GREY, lw=0.8, ls="--")
        for low, high in each.intervals:
            axes.axvspan(low, high, color=COLOURS[4], alpha=0.25, lw=0)
        near = each.value[each.deviance <= _TOP * each.limit]
        if np.ptp(near) > 0:
            edge = 0.15 * np.ptp(near)
            axes.set_xlim(near.min() - edge, near.max() + edge)
        axes.set_ylim(0, _TOP * each.limit)
        axes.set_xlabel(each.name)
        words = f"{each.words} ({100 * each.level:g} %)"
        axes.set_title(fill(words, _TITLE), fontsize=SMALL)
        axes.set_ylabel("deviance")
    return figure


@styled(Fit)
def correlation(fit: Fit) -> Figure:
    """Correlations of the parameters' errors; empty where the data see none.

    Args:
        fit: of several parameters.

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    Raises:
        TypeError: no fit.

    >>> import jimpact as ji
    >>> data = ji.Experiments([1.0, 0.0, 0.0], [-0.06, 0.1, 0.97], sigma=0.02)
    >>> result = ji.fit(
    ...     ji.LZB(0.9, [1.0, 2.0]), ji.chain([1.0, 1.0, 1.0]), data, starts=1
    ... )
    >>> len(ji.plot.correlation(result).axes)
    2
    """
    count = len(fit.names)
    width = np.clip(1.8 + 0.5 * count, 3.0, 7.2)
    figure, axes = new_figure(float(width))
    finite: Any = np.ma.masked_invalid(fit.correlation)
    axes.grid(visible=False)
    image = axes.imshow(finite, vmin=-1, vmax=1, cmap="RdBu_r")
    axes.set_xticks(range(count), fit.names, rotation=90)
    axes.set_yticks(range(count), fit.names)
    if count <= 8:  # numbers fit into the cells, white on dark ones
        for i, j in np.argwhere(np.isfinite(fit.correlation)):
            if abs(fit.correlation[i, j]) > 0.6:
                colour = "white"
            else:
                colour = "black"
            write(axes, (j, i), f"{fit.correlation[i, j]:.2f}", color=colour)
    figure.colorbar(image, ax=axes, shrink=0.8, label="correlation")
    return figure


@styled(Fit)
def residuals(fit: Fit) -> Figure:
    """Measured against fitted; residuals over the speed, and their quantiles.

    Without sigma the standard error is the estimated noise. What the law explains
    leaves no trend over the speed, and normal noise lies on the straight line.

    Args:
        fit: of shots, or of anything else that was measured.

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    Raises:
        TypeError: no fit.

    >>> import jimpact as ji
    >>> data = ji.Experiments([[1.0, 0.0], [2.0, 0.0]], [[0.3, 0.7], [0.6, 1.5]])
    >>> result = ji.fit(ji.Newton(0.5), ji.chain([1.0, 1.0]), data)
    >>> len(ji.plot.residuals(result).axes)
    3
    """
    problem = fit.problem
    measured = np.asarray(problem.measured, float)
    is_measured = ~np.isnan(measured)
    sigma = fit.noise if problem.sigma is None else np.asarray(problem.sigma, float)
    noise = np.broadcast_to(sigma, measured.shape)[is_measured]
    known = np.isfinite(noise).all() and (noise > 0).all()
    scaled = fit.residual[is_measured] / (noise if known else 1.0)
    if known:
        unit = "standard errors"
    else:
        unit = "as measured"
    figure, (first, second, third) = new_panels(3, 3.0)
    units = [] if fit.experiments is None else dict.fromkeys(fit.experiments.units)
    if units:
        values = f" [{', '.join(units)}]"
    else:
        values = ""
    style: dict[str, Any] = {"ls": "none", "marker": "o", "mfc": "none", "ms": 4}
    mean = float(measured[is_measured].mean())
    first.axline((mean,) * 2, slope=1.0, color=GREY, lw=0.8)
    fitted = fit.predicted[is_measured]
    first.plot(fitted, measured[is_measured], color=COLOURS[0], **style)
    first.set(xlabel=f"fitted{values}", ylabel=f"measured{values}")
    over, label = _residual_axis(fit)
    second.axhline(0, color=GREY, lw=0.8)
    abscissa = np.broadcast_to(over, is_measured.shape)[is_measured]
    second.plot(abscissa, scaled, color=COLOURS[0], **style)
    second.set(xlabel=label, ylabel=f"residual [{unit}]")
    ordered = np.sort(scaled)
    # expected of normal noise
    count = len(ordered)
    normal = ndtri((np.arange(count) + 0.5) / count)
    third.plot(normal, ordered, color=COLOURS[0], **style)
    third.axline(
        (0.0, 0.0), slope=1.0 if known else float(np.std(scaled)) or 1.0, color=GREY
    )
    third.set(xlabel="normal quantile [standard errors]", ylabel=f"residual [{unit}]")
    if known:
        for y in (-_TWO_SIDED, _TWO_SIDED):
            second.axhline(y, color=GREY, lw=0.6, ls="--")
    return figure


def _residual_axis(fit: Fit) -> tuple[np.ndarray, str]:
    """Values and label of the x axis of residuals.

    The fastest approach (K, 1) [m/s] of K shots; of other data the fitted values.
    """
    data = fit.experiments
    scene = fit.problem.scene
    if data is None:
        return np.asarray(fit.predicted), "fitted"
    return data.approach_speed(scene)[:, None], "fastest approach [m/s]"


@styled(Fit)
def corner(fit: Fit, draws: Any = None, names: Sequence[str] | None = None) -> Figure:
    """Every parameter and every pair: intervals and regions of the fit, or draws.

    Lines are the normal density of each parameter and the ellipses in which two of them
    lie with 68 and 95 %, from values and covariance; draws are histograms and points.

    Args:
        fit: with standard errors; what the data do not determine is left out.
        draws: of the parameters: `ji.bootstrap(fit)`, `ji.posterior(fit)`, or an array
            (N, P).
        names: of the parameters to show, at most `MOST`; None: the first ones.

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    Raises:
        TypeError: no fit.
        ValueError: unknown names; no standard error is known; draws of other
            parameters.

    >>> import jimpact as ji
    >>> after = [[0.1, 0.2, 0.7], [-0.6, -0.3, -0.1]]
    >>> data = ji.Experiments([[1.0, 0, 0], [0, 0, -1.0]], after, sigma=0.02)
    >>> result = ji.fit(
    ...     ji.Newton([0.9, 0.9]), ji.chain([1.0, 1.0, 1.0]), data, starts=1
    ... )
    >>> len(ji.plot.corner(result).axes)
    3
    """
    for name in names or ():
        check_choice("names", name, fit.names)
    known = np.isfinite(fit.standard_error) & (fit.standard_error > 0)
    usable = np.flatnonzero(known).tolist()
    shown = [i for i in usable if names is None or fit.names[i] in names][:MOST]
    if not shown:
        raise ValueError(
            "Argument `fit` must have a standard error to show, but has none."
        )
    if draws is None:
        values = None
    else:
        values = _draws_of(fit, draws)
    count = len(shown)
    height = float(np.clip(1.6 * count + 0.8, 3.0, 7.2))
    figure, grid = new_figure(height, "", count, count, squeeze=False, sharex="col")
    for above in grid[np.triu_indices(count, 1)]:
        above.remove()
    for k, i in enumerate(shown):  # densities on the diagonal, pairs below it
        _draw_density(grid[k, k], fit, i, values)
        for axes, j in zip(grid[k, :k], shown):
            _draw_ellipses(axes, fit, j, i, values)
    for axes, i in zip(grid[-1], shown):
        axes.set_xlabel(fit.names[i])
    densities = ["density", *(fit.names[i] for i in shown[1:])]
    for axes, name in zip(grid[:, 0], densities):
        axes.set_ylabel(name)
    return figure


def _draws_of(fit: Fit, draws: Any) -> np.ndarray:
    """Draws (N, P) of a fit's P parameters, from an array, a bootstrap or ArviZ's
    posterior.
    """
    if hasattr(draws, "posterior"):
        columns = [np.ravel(draws.posterior[name]) for name in fit.names]
        return np.stack(columns, axis=1)
    values = np.asarray(getattr(draws, "value", draws), float)
    if values.ndim != 2 or values.shape[1] != len(fit.names):
        raise ValueError(
            f"Argument `draws` must have shape (N, {len(fit.names)}), parameters of "
            f"the fit, but has shape {values.shape}."
        )
    return values


def _draw_density(axes: Axes, fit: Fit, i: int, values: np.ndarray | None) -> None:
    """Draw the normal density of parameter i from value and standard error; draws: a
    histogram.

    `values` are draws (N, P) of all parameters, if any.
    """
    z = np.linspace(-_WIDE, _WIDE, 121)
    error = fit.standard_error[i]
    normalization = error * np.sqrt(2 * np.pi)
    density = np.exp(-0.5 * z**2) / normalization
    if values is not None:
        axes.hist(values[:, i], bins="auto", density=True, color=COLOURS[4], alpha=0.5)
    x = fit.value[i] + error * z
    axes.plot(x, density, color=COLOURS[0], lw=1.2)
    axes.set_yticks([])


def _draw_ellipses(
    axes: Axes, fit: Fit, i: int, j: int, values: np.ndarray | None
) -> None:
    """Draw the ellipses in which parameters i and j lie with 68 and 95 %; draws:
    points.

    Equation: `(x - x_fit)^T C^-1 (x - x_fit) = chi^2`, C their covariance and chi^2 the
    quantile of two degrees of freedom; on it
    `x = x_fit + sqrt(chi^2) L (cos a, sin a)`, `L L^T = C`.
    """
    if values is not None:
        axes.plot(values[:, i], values[:, j], ".", ms=2, color=COLOURS[4], alpha=0.5)
    block = fit.covariance[np.ix_([i, j], [i, j])]
    factor = np.linalg.cholesky(block)
    angle = np.linspace(0, 2 * np.pi, 181)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    for share in _SHARES:
        edge = np.sqrt(chdtri(2, 1 - share)) * factor @ circle
        axes.plot(
            fit.value[i] + edge[0], fit.value[j] + edge[1], color=COLOURS[0], lw=1.2
        )
    axes.plot(fit.value[i], fit.value[j], "+", color="black", ms=7)
