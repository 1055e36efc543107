"""Picture: error against time and against work, of every method side by side."""

from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jimpact.methods.charts.record import Point, Timing, WorkPrecision
from jimpact.plot.fits import COLOURS
from jimpact.status import CODE, STATUS

_GREY = "#777777"
_MARKERS = "osD^vP"
_LEAST = 1e-16  # errors below are drawn here: rounding
_OWN = ("dop853", "dop5", "propagator")  # jimpact's own methods: thick lines


def work_precision(found: WorkPrecision, title: str = "") -> Figure:
    """Panels: error of v+ against time and against evaluations, and that of the gradient if known.

    Times are per impact in a batch, with error bars from quartile to quartile; a hollow marker is
    a failure by status; laws are stars at their model error; below the grey band's edge the
    reference is no better.
    """
    figure = Figure(figsize=(11.5, 8.5))
    figure.set_layout_engine("constrained")
    gradients = any(point.gradient is not None for row in found.points.values() for point in row)
    if gradients:
        (left, right), (below, corner) = figure.subplots(2, 2)
    else:
        below = None
        (left, right), (corner, other) = figure.subplots(2, 2)
        other.remove()
        corner.set_subplotspec(corner.get_gridspec()[1, :])
    handles: dict[str, Any] = {}
    for number, (name, row) in enumerate(found.points.items()):
        style = _style(name, number, row)
        for axes, quantity, place in (
            (left, "velocity", lambda point: _times(point.batched)),
            (right, "velocity", lambda point: (point.evaluations, None)),
            (below, "gradient", lambda point: _times(point.gradient)),
        ):
            if axes is None:
                continue
            drawn = _draw(axes, row, quantity, place, style)
            if drawn is not None:
                handles.setdefault(row[0].label, drawn)
    labels = (
        (left, "velocity", "time per impact in a batch [µs]", "error of v⁺, relative"),
        (right, "velocity", "field evaluations per impact", "error of v⁺, relative"),
        (below, "gradient", "time per impact with its gradient [µs]", "error of ∂v⁺/∂(ln k, e)"),
    )
    for axes, quantity, x, y in labels:
        if axes is not None:
            _finish(axes, found.reference.uncertainty[quantity], x, y)
    corner.axis("off")
    corner.legend(
        handles.values(),
        handles.keys(),
        loc="upper center",
        frameon=False,
        fontsize="small",
    )
    corner.text(0.5, 0.02, _note(found), ha="center", fontsize="small", color=_GREY)
    left.set_title(title, loc="left")
    return figure


def _style(name: str, number: int, row: tuple[Point, ...]) -> dict[str, Any]:
    colour = COLOURS[number % len(COLOURS)]
    if row[0].setting is None:
        return {"marker": "*", "ms": 11, "ls": "none", "color": colour}
    marker = _MARKERS[number % len(_MARKERS)]
    line = "-" if number < len(COLOURS) else "--"
    return {
        "marker": marker,
        "ms": 5,
        "ls": line,
        "lw": 2.6 if name in _OWN else 1.2,
        "color": colour,
        "zorder": 3 if name in _OWN else 2,
    }


def _times(timing: Timing | None) -> tuple[float, tuple[float, float] | None]:
    """Median [us] and the lengths of its error bar."""
    if timing is None:
        return float("nan"), None
    return 1e6 * timing.median, (
        1e6 * (timing.median - timing.low),
        1e6 * (timing.high - timing.median),
    )


def _draw(
    axes: Axes,
    row: tuple[Point, ...],
    quantity: str,
    place: Callable[[Point], tuple[float, Any]],
    style: dict[str, Any],
) -> Any:
    """One line; None where no point of it has a place."""
    points = [(point, *place(point)) for point in row]
    kept = [
        (x, max(point.error[quantity], _LEAST), bar, STATUS[CODE[point.status]].failure)
        for point, x, bar in points
        if np.isfinite(x) and np.isfinite(point.error[quantity])
    ]
    if not kept:
        return None
    x, y, bars, failed = zip(*kept)
    spread = None if bars[0] is None else np.array(bars).T
    drawn = axes.plot(x, y, **style)[0]
    bar = {"elinewidth": 1, "capsize": 2, "color": style["color"]}
    axes.errorbar(x, y, xerr=spread, fmt="none", **bar)
    wrong = np.array(failed)
    axes.plot(
        np.array(x)[wrong],
        np.array(y)[wrong],
        style["marker"],
        mfc="white",
        color=style["color"],
        ms=style["ms"],
        zorder=4,
    )
    return drawn


def _finish(axes: Axes, uncertainty: float, x: str, y: str) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    low, high = axes.get_ylim()
    if np.isfinite(uncertainty) and uncertainty > 0:
        low = min(low, 0.3 * uncertainty)
        axes.axhspan(low, uncertainty, color=_GREY, alpha=0.25, lw=0)
    axes.set_ylim(low, high)
    axes.grid(lw=0.4, alpha=0.5)
    axes.spines[["top", "right"]].set_visible(False)


def _note(found: WorkPrecision) -> str:
    return (
        f"errors: largest of {found.sample} impacts, stiffness spread over a factor "
        f"{found.spread:g}\ntimes: median and quartiles of {found.repeats}, batch of "
        f"{found.batch}\ngrey: uncertainty of the reference "
        "· hollow: failed by status"
    )
