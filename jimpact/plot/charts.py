"""Pictures of error against time, of stability, of where laws are valid, and of advice."""

from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from jimpact._checks import check_kind
from jimpact.methods.advice_report import Advice, as_code, share
from jimpact.methods.chart import Point, Timing, WorkPrecision
from jimpact.methods.stability import CLASSES, Slice, StabilityMap
from jimpact.methods.validity import ValidityMap
from jimpact.plot.style import (
    COLOURS,
    COLUMNS,
    GREY,
    SMALL,
    finish,
    heading,
    in_words,
    legend_below,
    legend_within,
    logarithmic,
    new_figure,
    new_panels,
    side_by_side,
    wrapped,
)
from jimpact.status import CODE, STATUS

_MARKERS = "osD^vP"
_LEAST = 1e-16  # errors below are drawn here: rounding
_OWN = ("dop853",)  # jimpact's own method: a thick line

# right, flagged, wrong, gains energy, stalls, does not end, not finite, unchecked: Okabe and Ito's
# colours where a result is returned, greys where there is none
CLASS_COLOURS = (
    "#009E73",
    "#56B4E9",
    "#D55E00",
    "#CC79A7",
    "#E69F00",
    "#999999",
    "#000000",
    "#EEEEEE",
)
_LABELS = {"setting": "setting, 1 finest", "restitution": "restitution e", "balls": "balls N"}
_TICKS = 5  # labelled values along an axis, at most
_STYLES = {"moreau": "--", "binary": ":"}
_FLOOR = 1e-9  # errors below are drawn here


def work_precision(found: WorkPrecision, title: str = "") -> Figure:
    """Panels: error of v+ against time and against evaluations, and that of the gradient if known.

    Times are per impact in a batch, with error bars from quartile to quartile; a hollow marker is
    a failure by status; laws are stars at their model error; below the grey band's edge the
    reference is no better.

    Args:
        found: what `ji.work_precision` returned.
        title: above the picture.

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    Raises:
        TypeError: something else.

    >>> import jimpact as ji
    >>> pair, law, ladder = ji.chain([1.0, 2.0]), ji.LZB(0.5), {"verlet": [0.1, 0.01]}
    >>> options = {"laws": {}, "batch": 4, "gradients": False}
    >>> found = ji.work_precision(pair, [1.0, 0.0], law, ["verlet"], ladder, **options)
    >>> len(ji.plot.work_precision(found).axes)
    2
    """
    check_kind("found", found, WorkPrecision)
    gradients = any(point.gradient is not None for row in found.points.values() for point in row)
    figure, panels = new_panels(4, 3.6) if gradients else new_panels(2, 4.6)
    handles: dict[str, Any] = {}
    for axes, (quantity, place, x, y) in zip(panels, _PANELS):
        for number, (name, row) in enumerate(found.points.items()):
            drawn = _draw(axes, row, quantity, place, _style(name, number, row))
            if drawn is not None:
                handles.setdefault(row[0].label, drawn)
        _finish(axes, found.reference.uncertainty[quantity], x, y)
    for label, drawn in handles.items():
        drawn.set_label(label)
    if not gradients:
        legend_below(figure, list(handles.values()), 2, _note(found))
    else:  # beside the three panels
        panels[3].axis("off")
        options: dict[str, Any] = {"title": _note(found), "title_fontsize": SMALL, "loc": "center"}
        panels[3].legend(handles=list(handles.values()), frameon=False, fontsize=SMALL, **options)
    heading(figure, title)
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


_PANELS: tuple[tuple[str, Callable[[Point], tuple[float, Any]], str, str], ...] = (
    (
        "velocity",
        lambda point: _times(point.batched),
        "time per impact in a batch [µs]",
        "error of v⁺, relative",
    ),
    (
        "velocity",
        lambda point: (point.evaluations, None),
        "field evaluations per impact",
        "error of v⁺, relative",
    ),
    (
        "gradient",
        lambda point: _times(point.gradient),
        "time per impact with its gradient [µs]",
        "error of ∂v⁺/∂(ln k, e)",
    ),
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
    axes.set_yscale("log")
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    low, high = axes.get_ylim()
    if np.isfinite(uncertainty) and uncertainty > 0:
        low = min(low, 0.3 * uncertainty)
        axes.axhspan(low, uncertainty, color=GREY, alpha=0.25, lw=0)
    axes.set_ylim(low, high)
    logarithmic(axes, "x")
    logarithmic(axes, "y")
    finish(axes)


def _note(found: WorkPrecision) -> str:
    return (
        f"errors: largest of {found.sample} impacts, stiffness\nspread over a factor "
        f"{found.spread:g}; times: median\nand quartiles of {found.repeats}, batch of "
        f"{found.batch};\ngrey: uncertainty of the reference;\nhollow: failed by status"
    )


def stability_map(found: StabilityMap, title: str = "") -> Figure:
    """One panel an axis: a row for each method, a column for each value; other axes at the base.

    Args:
        found: what `stability_map` returned.
        title: above the panels.

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    Raises:
        TypeError: something else.

    >>> import jimpact as ji
    >>> axes = {"restitution": [0.5, 1.0]}
    >>> found = ji.stability_map(["verlet"], axes, {"balls": 2, "exponent": 1})
    >>> len(ji.plot.stability_map(found).axes)
    1
    """
    check_kind("found", found, StabilityMap)
    names = list(found.axes)
    figure, grid = new_panels(len(names), 0.8 + 0.3 * len(found.methods), 1.2)
    for i, (axes, name) in enumerate(zip(grid, names)):
        _draw_classes(axes, np.array([found.slices[method][i].codes for method in found.methods]))
        _ticks(axes, "x", name, found.axes[name])
        labels = found.methods if i % COLUMNS == 0 else [""] * len(found.methods)
        axes.set_yticks(range(len(found.methods)), labels, fontsize=SMALL)
        axes.plot(_place(found, name), -0.62, "v", color="black", ms=5, clip_on=False)
        axes.set_ylim(len(found.methods) - 0.5, -0.5)
    _finish_map(figure, found, title)
    return figure


def stability_pairs(found: StabilityMap, method: str, title: str = "") -> Figure:
    """One panel for every pair of axes, for one method; a ring marks the base point.

    Args:
        found: what `ji.stability_map(slices='pairs')` returned.
        method: one of its methods.
        title: above the picture; default: the method's name.

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    Raises:
        ValueError: a map without pairs.

    >>> import jimpact as ji
    >>> axes = {"restitution": [0.5, 1.0], "setting": [0.0, 0.8]}
    >>> options = {"base": {"balls": 2, "exponent": 1}, "slices": "pairs"}
    >>> found = ji.stability_map(["verlet"], axes, **options)
    >>> len(ji.plot.stability_pairs(found, "verlet").axes)
    1
    """
    pairs = [each for each in found.slices[method] if len(each.axes) == 2]
    if not pairs:
        raise ValueError("Argument `found` must be a map with slices='pairs', but has none.")
    names = list(found.axes)
    size = len(names) - 1
    figure = new_figure(1.6 + 1.5 * size)
    grid = figure.add_gridspec(size, size)
    for each in pairs:
        column, row = (names.index(name) for name in each.axes)
        axes = figure.add_subplot(grid[row - 1, column])
        _pair(axes, found, each, row == size, column == 0)
    _finish_map(figure, found, title or method)
    return figure


def _pair(axes: Axes, found: StabilityMap, each: Slice, bottom: bool, left: bool) -> None:
    _draw_classes(axes, each.codes.T)
    axes.invert_yaxis()
    for which, name, labelled in (("x", each.axes[0], bottom), ("y", each.axes[1], left)):
        _ticks(axes, which, name, found.axes[name], labelled, 3)
    x, y = (_place(found, name) for name in each.axes)
    axes.plot(x, y, "o", ms=7, mfc="none", mec="white", mew=2.5)
    axes.plot(x, y, "o", ms=7, mfc="none", mec="black", mew=1.2)


def _draw_classes(axes: Axes, codes: np.ndarray) -> None:
    colours = ListedColormap(CLASS_COLOURS)
    edges = BoundaryNorm(np.arange(len(CLASSES) + 1) - 0.5, len(CLASSES))
    axes.imshow(codes, cmap=colours, norm=edges, aspect="auto", interpolation="nearest")
    rows, columns = codes.shape
    axes.set_xticks(np.arange(columns + 1) - 0.5, minor=True)
    axes.set_yticks(np.arange(rows + 1) - 0.5, minor=True)
    axes.grid(which="minor", color="white", lw=0.8)
    axes.tick_params(which="both", length=0)
    axes.spines[:].set_visible(False)


def _ticks(
    axes: Axes,
    which: str,
    name: str,
    values: np.ndarray,
    labelled: bool = True,
    most: int = _TICKS,
) -> None:
    step = -(-len(values) // most)
    at = range(0, len(values), step)
    labels = [in_words(float(f"{values[i]:.2g}")) if labelled else "" for i in at]
    axis = axes.xaxis if which == "x" else axes.yaxis
    axis.set_ticks(at, labels, fontsize=SMALL)
    word = _LABELS.get(name, name.replace("_", " ")) if labelled else ""
    axis.set_label_text(word, fontsize=SMALL)


def _place(found: StabilityMap, name: str) -> float:
    """Where the base lies among the values of an axis."""
    values = found.axes[name]
    return float(np.interp(found.base[name], values, np.arange(len(values))))


def _finish_map(figure: Figure, found: StabilityMap, title: str) -> None:
    seen = {
        int(code)
        for name in found.methods
        for each in found.slices[name]
        for code in np.unique(each.codes)
    }
    handles = [Patch(color=CLASS_COLOURS[code], label=CLASSES[code]) for code in sorted(seen)]
    legend_below(figure, handles, 4)
    heading(figure, title)


def validity_map(found: ValidityMap, tolerance: float = 1e-2, title: str = "") -> Figure:
    """Dispersion against the stiffness ratio, and the errors of the laws that do not know it.

    Above one curve an exponent, between the levels of binary collisions and Moreau's law; below
    how far off they are, with the tolerance.

    Args:
        found: what `ji.validity_map` returned.
        tolerance: of v+, relative to max |v-|; a line.
        title: above the picture.

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    Raises:
        TypeError: something else.

    >>> import jimpact as ji
    >>> found = ji.validity_map(ji.chain([1.0, 1.0, 1.0]), [1, 0, 0], [1e-3, 1.0, 1e3], [1.0])
    >>> len(ji.plot.validity_map(found).axes)
    2
    """
    check_kind("found", found, ValidityMap)
    figure = new_figure(6.8)
    top, bottom = figure.subplots(2, 1, sharex=True)
    for i, eta in enumerate(found.exponents):
        colour = COLOURS[i % len(COLOURS)]
        top.plot(found.ratios, found.dispersion[i], color=colour, label=f"LZB, exponent {eta:g}")
        for name, style in _STYLES.items():
            error = np.maximum(found.error(name)[i], _FLOOR)
            bottom.plot(found.ratios, error, style, color=colour)
    for name, style in _STYLES.items():
        top.axhline(found.law_dispersion[name], color="black", ls=style, lw=1, label=name)
        bottom.plot([], [], style, color="black", label=name)
    bottom.axhline(tolerance, color=GREY, lw=1, label=f"tolerance {share(tolerance)}")
    top.set_ylabel("dispersion index (0: one body has it all)")
    bottom.set_ylabel("error of v+, relative to max |v-|")
    bottom.set_yscale("log")
    bottom.set_ylim(bottom=1e-5)
    logarithmic(bottom, "y")
    logarithmic(bottom, "x")
    two = found.scene.contacts == 2
    bottom.set_xlabel("stiffness ratio k2/k1" if two else "stiffness ratio of neighbours")
    top.set_title(title or "Where the stiffness ratio may be left out", loc="left")
    finish(top, bottom)
    legend_within(top)
    legend_within(bottom)
    return figure


def advice(found: Advice, title: str = "") -> Figure:
    """Outcomes of every law, with their range over the unknown ratios, above their errors.

    Args:
        found: what `ji.advise` returned.
        title: above the picture.

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    Raises:
        TypeError: something else.

    >>> import jimpact as ji
    >>> found = ji.advise(ji.chain([1.0, 1.0]), [1.0, 0.0], restitution=0.9, timing=False)
    >>> len(ji.plot.advice(found).axes)
    2
    """
    check_kind("found", found, Advice)
    names, rows = list(found.candidates), list(found.candidates.values())
    bodies, x = len(found.velocity), np.arange(len(names))
    dodge = side_by_side(bodies)
    figure = new_figure(6.5)
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    for i in range(bodies):
        colour = COLOURS[i % len(COLOURS)]
        v = np.array([c.velocity[i] for c in rows])
        range_ = np.array([[c.low[i], c.high[i]] for c in rows])
        top.vlines(x + dodge[i], range_[:, 0], range_[:, 1], color=colour, lw=4, alpha=0.4)
        top.plot(x + dodge[i], v, "o", color=colour, label=f"body {i + 1}")
    worst = np.maximum([c.worst for c in rows], _FLOOR)
    colours = [COLOURS[2] if name == found.name else GREY for name in names]
    bottom.bar(x, worst, 0.5, color=colours, label="worst")
    bottom.plot(x, np.maximum([c.median for c in rows], _FLOOR), "k_", ms=18, label="median")
    bottom.axhline(found.tolerance, color=COLOURS[1], lw=1, label="tolerance")
    bottom.set_yscale("log")
    bottom.set_ylim(found.tolerance / 1000, 30)  # room above for the legend
    logarithmic(bottom, "y")
    bottom.set_ylabel("error of v+ (energy norm)")
    top.set_ylabel("velocity after the impact [m/s]")
    named = [f"{name}{'' if c.usable else f' ({c.status})'}" for name, c in zip(names, rows)]
    bottom.set_xticks(x, [wrapped(name.replace(" ", "_")) for name in named], fontsize=SMALL)
    bottom.set_xlabel("law")
    verdict = "within" if found.within else "not within"
    top.set_title(f"{title}\n{as_code(found.law)}: {verdict} {share(found.tolerance)}", loc="left")
    finish(top, bottom, grid="y")
    handles = top.get_legend_handles_labels()[0] if bodies <= len(COLOURS) else []
    legend_below(figure, [*handles, *bottom.get_legend_handles_labels()[0]], 6)
    return figure
