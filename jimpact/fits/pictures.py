"""Pictures: measured against fitted velocities, with residuals."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jimpact.fits.profiles import Contour
from jimpact.fits.report import Fit, of_bodies
from jimpact.plot.style import (
    COLOURS,
    GREY,
    SPREAD,
    colour_of,
    legend_below,
    logarithmic,
    new_figure,
    side_by_side,
    styled,
)

_LABELLED = 16  # up to this number of shots each has a label


@styled(Fit)
def fit(fit: Fit, others: Mapping[str, Fit] | None = None, title: str = "") -> Figure:
    """Values after every shot, measured and fitted, above the residuals.

    Error bars are sigma where the data state it, else the estimated noise. `others` are
    further fits of the same data, by label, drawn in grey. Each unit has a column of
    its own.

    Args:
        fit: of shots, of a motion, or of what else was measured.
        others: label -> another fit of the same data.
        title: above the picture.

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    Raises:
        TypeError: something else than a fit.

    >>> import jimpact as ji
    >>> data = ji.Experiments(pre=[1.0, 0.0], post=[0.3, 0.7])
    >>> figure = ji.plot.fit(ji.fit(ji.Newton(0.5), ji.chain([1.0, 1.0]), data))
    >>> len(figure.axes)
    2
    """
    data = fit.experiments
    measured = _in_rows(fit.problem.measured)
    predicted = _in_rows(fit.predicted)
    shots, bodies = predicted.shape
    dodge = side_by_side(bodies)
    x = np.arange(shots)[:, None] + dodge[None, :]  # (shots, bodies)
    size_for_all = 220 / (shots * bodies)
    size = float(np.clip(size_for_all, 3, 8))
    if data is None:
        speed = ""
    else:
        speed = " m/s"
    heading = title or f"{type(fit.law).__name__}, rms {fit.rms:.3g}{speed}"
    if data is None:
        what = "measured value"
    else:
        what = "velocity after the impact"
    if data is None:
        each = [""] * bodies
    else:
        each = list(data.units)
    units = list(dict.fromkeys(each))
    error = _error_bars(fit)
    grid: Any = {"sharex": True, "squeeze": False, "height_ratios": (3, 1.4)}
    figure, panels = new_figure(6.0, heading, 2, len(units), **grid)
    for (top, bottom), unit in zip(panels.T, units):  # a column of panels for each unit
        members = [i for i, own in enumerate(each) if own == unit]
        for i in members:
            if error is None:
                bars = None
            else:
                bars = error[:, i]
            style: dict[str, Any] = {"fmt": "o", "mfc": "none", "ms": size, "lw": 1}
            style["color"] = colour_of(i)
            top.errorbar(x[:, i], measured[:, i], bars, **style)
            style_of_fit = {"color": colour_of(i), "ms": 2.2 * size, "mew": 2}
            top.plot(x[:, i], predicted[:, i], "_", **style_of_fit)
            off = (measured - predicted)[:, i]
            bottom.errorbar(x[:, i], off, bars, **style)
        for j, other in enumerate((others or {}).values()):
            values = _in_rows(other.predicted)[:, members]
            top.plot(x[:, members], values, "x+*"[j % 3], color=GREY, ms=0.8 * size)
        top.set_ylabel(f"{what} [{unit}]" if unit else what)
        bottom.set_ylabel(
            f"measured − fitted [{unit}]" if unit else "measured − fitted"
        )
        bottom.axhline(0, color=GREY, lw=0.8)
        _label_shots(bottom, fit, dodge)
    _draw_legend(figure, fit, others or {}, error is not None)
    for axes in figure.axes:
        axes.grid(visible=False, axis="x")
    return figure


@styled(Contour)
def contour(result: Contour, title: str = "") -> Figure:
    """The confidence region of two parameters, and the deviance around the fit.

    Args:
        result: what `ji.contour` returned.
        title: above the picture.

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    Raises:
        TypeError: something else.

    >>> import numpy as np
    >>> import jimpact as ji
    >>> from jimpact.fits.profiles import Contour
    >>> x = np.linspace(0.4, 0.6, 5)
    >>> d = ((x - 0.5) / 0.03)[:, None] ** 2 + ((x - 0.5) / 0.02) ** 2
    >>> region = Contour(
    ...     ("e[1]", "e[2]"), x, x, d, 5.99, 0.95, (0.5, 0.5), (False, False)
    ... )
    >>> ji.plot.contour(region).axes[0].get_xlabel()
    'e[1]'
    """
    figure, axes = new_figure(5.0, title)
    finite = np.isfinite(result.deviance)
    d = np.where(finite, result.deviance, np.nan).T
    limit = result.limit
    axes.contourf(result.x, result.y, d, [0.0, limit], colors=[COLOURS[0]], alpha=0.25)
    axes.contour(result.x, result.y, d, [limit], colors=[COLOURS[0]], linewidths=1.5)
    axes.contour(result.x, result.y, d, [limit / 4], colors=GREY, linewidths=0.7)
    axes.plot(*result.best, "+", color="black", ms=9, label="fit")
    for which, log in zip("xy", result.log, strict=True):
        if log:
            logarithmic(axes, which)
    axes.set(xlabel=result.names[0], ylabel=result.names[1])
    label = f"{100 * result.level:g} % region"
    axes.fill([], [], color=COLOURS[0], alpha=0.25, label=label)
    legend_below(figure, 2)
    return figure


def _in_rows(values: np.ndarray) -> np.ndarray:
    """Values as an array of two axes, with a row for each shot, sample of a motion, or
    value.
    """
    values = np.asarray(values, float)
    return values.reshape(len(values) if values.ndim else 1, -1)


def _error_bars(fit: Fit) -> np.ndarray | None:
    """Error bars, in the rows of `_in_rows`: sigma, else the noise; None if neither is
    known.
    """
    shape = fit.predicted.shape
    if fit.problem.sigma is not None:
        sigma = np.asarray(fit.problem.sigma, float)
        return _in_rows(np.broadcast_to(sigma, shape))
    if np.isfinite(fit.noise):
        return _in_rows(np.full(shape, fit.noise))
    return None


def _label_shots(axes: Axes, fit: Fit, dodge: np.ndarray) -> None:
    """Label the x axis: of a single shot bodies, or coordinates, at the offsets
    `dodge`; else shots, or values.

    At most `_LABELLED` of them have a label.
    """
    data = fit.experiments
    labels = fit.problem.labels
    if data is not None and len(labels) == 1:
        axes.set_xticks(dodge, [f"{i + 1}" for i in range(len(dodge))])
        axes.set_xlabel("body" if of_bodies(fit) else "coordinate")
        axes.set_xlim(-SPREAD * 0.5, SPREAD * 0.5)
        return
    stride = -(-len(labels) // _LABELLED)
    ticks = range(0, len(labels), stride)
    longest = max(len(labels[k]) for k in ticks)
    angle = 90 if longest > 4 else 0
    axes.set_xticks(list(ticks), [labels[k] for k in ticks], rotation=angle)
    axes.set_xlabel("shot" if data is not None else "value")
    axes.set_xlim(-0.6, len(labels) - 0.4)


def _draw_legend(
    figure: Figure, fit: Fit, others: Mapping[str, Fit], has_bars: bool
) -> None:
    """Draw a legend: markers of measured and fitted values and of other fits, colours
    of bodies.
    """
    bars = ""
    if has_bars:
        if fit.problem.sigma is None:
            bars = ", ± noise"
        else:
            bars = ", ± sigma"
    fitted = f"{type(fit.law).__name__} fitted"
    axes = figure.axes[0]
    axes.plot([], [], "o", color="black", mfc="none", label=f"measured{bars}")
    axes.plot([], [], "_", color="black", ms=14, mew=2, label=fitted)
    for j, label in enumerate(others):
        axes.plot([], [], "x+*"[j % 3], color=GREY, label=label)
    shots, bodies = _in_rows(fit.predicted).shape
    if shots > 1 and bodies > 1:  # of a single shot the axis names the bodies
        for i, colour in enumerate(COLOURS[:bodies]):
            axes.plot([], [], "s", color=colour, label=f"body {i + 1}")
    legend_below(figure, 4)
