"""Pictures of error against time, of stability, of where laws are valid, and of
advice.
"""

from collections.abc import Mapping
from itertools import chain, cycle
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from jimpact.methods.advice_report import share
from jimpact.methods.chart import Point, Timing, WorkPrecision
from jimpact.methods.stability import CLASSES, Slice, StabilityMap
from jimpact.methods.validity import ValidityMap
from jimpact.plot.style import (
    COLOURS,
    COLUMNS,
    GREY,
    MARKERS,
    SMALL,
    LineEnd,
    by_code,
    colour_of,
    in_words,
    label_ends,
    legend_below,
    logarithmic,
    new_figure,
    new_panels,
    styled,
)
from jimpact.tools.status import CODE, STATUS

_LAW_MARKERS = "*phX8d"
_LEAST = 1e-16  # smaller relative errors are drawn here: rounding
_DEFAULT = "time"  # what `impact` does: a thick line

# right, flagged, wrong, gains energy, stalls, does not end, not finite, unchecked:
# colours for returned results, greys for none
CLASS_COLOURS = (
    *(COLOURS[i] for i in (2, 4, 1, 3, 5)),
    "#999999",
    "#000000",
    "#DDDDDD",
)
_LABELS = {
    "setting": "setting, 1 finest",
    "restitution": "restitution e",
    "balls": "balls N",
    "friction": "friction μ",
}
_CLASS_LABELS = {  # where the name of a class does not say why
    "flagged": "flagged by its status, or refused",
    "unchecked": "unchecked: no reference",
    "wrong": "wrong, unnoticed",
}
_TICKS = 5  # labelled values along an axis, at most
_STYLES = {"moreau": "--", "binary": ":"}


@styled(WorkPrecision)
def work_precision(result: WorkPrecision, title: str = "") -> Figure:
    """Error of v+, and of its gradient, against time and against evaluations.

    Times are per impact in a batch, with error bars from quartile to quartile; a hollow
    marker on a line is a failure by status. Lines have their names at their ends; laws
    are grey markers at their model error; below the grey band's edge the reference is
    no better.

    Args:
        result: what `ji.work_precision` returned.
        title: above the picture.

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    Raises:
        TypeError: something else.

    >>> import jimpact as ji
    >>> pair, law, ladder = ji.chain([1.0, 2.0]), ji.LZB(0.5), {"verlet": [0.1, 0.01]}
    >>> options = {"laws": {}, "batch": 4, "gradients": False}
    >>> result = ji.work_precision(law, pair, [1.0, 0.0], ["verlet"], ladder, **options)
    >>> len(ji.plot.work_precision(result).axes)
    2
    """
    every = chain.from_iterable(result.points.values())
    gradients = any(point.gradient is not None for point in every)
    if gradients:
        count = 4
        height = 3.6
    else:
        count = 2
        height = 4.6
    figure, panels = new_panels(count, height, title=title)
    styles = _styles(result.points)
    ends = []
    for axes, (quantity, against, label) in zip(panels, _PANELS):
        for name, row in result.points.items():
            at = _draw_errors(axes, row, quantity, against, styles[name])
            if at is not None and styles[name]["ls"] != "none":
                end = LineEnd(axes, at, name, styles[name]["color"])
                ends.append(end)
        _finish_errors(
            axes, result.reference.uncertainty[quantity], label, _ERRORS[quantity]
        )
    if not gradients:
        legend_below(figure, 2, note=_reading_note(result))
    else:  # next to the three panels
        lines = {
            x.get_label(): x
            for axes in panels
            for x in axes.get_legend_handles_labels()[0]
        }
        panels[3].axis("off")
        handles = list(lines.values())
        panels[3].legend(handles=handles, title=_reading_note(result), loc="center")
    label_ends(figure, ends)
    return figure


def _styles(points: Mapping[str, tuple[Point, ...]]) -> dict[str, dict[str, Any]]:
    """Options of matplotlib by name: methods by colour, laws (one point each) grey by
    marker.
    """
    laws = [name for name, row in points.items() if row[0].setting is None]
    methods = [name for name in points if name not in laws]
    styles: dict[str, dict[str, Any]] = {}
    for i, (name, marker) in enumerate(zip(methods, cycle(MARKERS))):
        if i < len(COLOURS):
            line = "-"
        else:
            line = "--"
        styles[name] = {
            "marker": marker,
            "ms": 5,
            "ls": line,
            "lw": 1.2,
            "color": colour_of(i),
        }
    for name, marker in zip(laws, cycle(_LAW_MARKERS)):
        styles[name] = {"marker": marker, "ms": 8, "ls": "none", "color": GREY}
    if _DEFAULT in styles:
        styles[_DEFAULT] |= {"lw": 2.6, "zorder": 3}
    return styles


_ERRORS = {"velocity": "error of v⁺, relative", "gradient": "error of ∂v⁺/∂(ln k, e)"}
_PANELS = (  # error, and what it is drawn against
    ("velocity", "batched", "time per impact in a batch [µs]"),
    ("velocity", "evaluations", "field evaluations per impact"),
    ("gradient", "gradient", "time per impact with its gradient [µs]"),
)


def _draw_errors(
    axes: Axes,
    row: tuple[Point, ...],
    quantity: str,
    against: str,
    style: dict[str, Any],
) -> tuple[float, float] | None:
    """Draw the error of a `quantity` over times [µs] or counts, one point for each
    setting.

    `against` is the field of `Point` on the x axis. Returns the end (x, y) of the line;
    None if no point has both an error and a time or a count.
    """
    given = [getattr(point, against) for point in row]
    # median and quartiles of a time [µs], or three times the same count
    spans = [
        1e6 * np.array(x)
        if isinstance(x, Timing)
        else np.full(3, np.nan if x is None else x)
        for x in given
    ]
    x, low, high = np.array(spans).T
    errors = [point.error[quantity] for point in row]
    y = np.maximum(errors, _LEAST)
    known = np.isfinite(x) & np.isfinite(y)
    if not known.any():
        return None
    bars = np.array([x - low, high - x])[:, known]
    label = row[int(np.argmax(known))].label
    axes.errorbar(
        x[known],
        y[known],
        xerr=bars if bars.any() else None,
        label=label,
        elinewidth=1,
        capsize=2,
        **style,
    )
    failures = [STATUS[CODE[point.status]].failure for point in row]
    failed = known & failures
    hollow = style | {"ls": "none", "mfc": "white", "zorder": 4}
    axes.plot(x[failed], y[failed], **hollow)
    last = np.flatnonzero(known)[-1]
    return float(x[last]), float(y[last])


def _finish_errors(axes: Axes, uncertainty: float, x: str, y: str) -> None:
    """Logarithmic axes with labels, and the grey band up to the uncertainty of the
    reference.
    """
    axes.set(xlabel=x, ylabel=y, yscale="log")
    low, high = axes.get_ylim()
    if np.isfinite(uncertainty) and uncertainty > 0:
        low = min(low, 0.3 * uncertainty)
        axes.axhspan(low, uncertainty, color=GREY, alpha=0.25, lw=0)
    axes.set_ylim(low, high)
    logarithmic(axes, "x")
    logarithmic(axes, "y")


def _reading_note(result: WorkPrecision) -> str:
    """Note below the chart: how errors and times were measured, and what grey and
    hollow mean.
    """
    return (
        f"errors: largest of {result.sample} impacts, stiffness\nspread over a factor "
        f"{result.spread:g}; times: median\nand quartiles of {result.repeats}, batch "
        f"of "
        f"{result.batch};\ngrey: uncertainty of the reference;\nhollow: failed by "
        f"status"
    )


@styled(StabilityMap)
def stability_map(result: StabilityMap, title: str = "") -> Figure:
    """One panel an axis: a row for each method, a column for each value.

    Args:
        result: what `stability_map` returned.
        title: above the panels.

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    Raises:
        TypeError: something else.

    >>> import jimpact as ji
    >>> axes = {"restitution": [0.5, 1.0]}
    >>> result = ji.stability_map(["verlet"], axes, {"balls": 2, "exponent": 1})
    >>> len(ji.plot.stability_map(result).axes)
    1
    """
    names = list(result.axes)
    height = 0.8 + 0.3 * len(result.methods)
    figure, grid = new_panels(len(names), height, 1.2, title)
    for i, (axes, name) in enumerate(zip(grid, names)):
        codes = [result.slices[method][i].codes for method in result.methods]
        _draw_classes(axes, np.array(codes))
        _ticks(axes, "x", name, result.axes[name])
        positions = range(len(result.methods))
        axes.set_yticks(positions, result.methods, fontsize=SMALL)
        axes.tick_params(labelleft=i % COLUMNS == 0)
        base = _base_position(result, name)
        axes.plot(base, -0.62, "v", color="black", ms=5, clip_on=False)
        axes.set_ylim(len(result.methods) - 0.5, -0.5)
    _legend_of_classes(figure, result)
    return figure


@styled(StabilityMap)
def stability_pairs(result: StabilityMap, method: str, title: str = "") -> Figure:
    """One panel for every pair of axes, for one method; a ring marks the base point.

    Args:
        result: what `ji.stability_map(slices='pairs')` returned.
        method: one of its methods.
        title: above the picture; default: the method's name.

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    Raises:
        ValueError: a map without pairs.

    >>> import jimpact as ji
    >>> axes = {"restitution": [0.5, 1.0], "setting": [0.0, 0.8]}
    >>> options = {"base": {"balls": 2, "exponent": 1}, "slices": "pairs"}
    >>> result = ji.stability_map(["verlet"], axes, **options)
    >>> len(ji.plot.stability_pairs(result, "verlet").axes)
    1
    """
    pairs = [each for each in result.slices[method] if len(each.axes) == 2]
    if not pairs:
        raise ValueError(
            "Argument `result` must be a map with slices='pairs', but has none."
        )
    names = list(result.axes)
    size = len(names) - 1
    width = 1.6 + 1.5 * size
    figure, grid = new_figure(width, title or method, size, size, squeeze=False)
    for each in pairs:
        column, row = (names.index(name) for name in each.axes)
        _draw_pair(grid[row - 1, column], result, each)
    for above in grid[np.triu_indices(size, 1)]:
        above.remove()
    _legend_of_classes(figure, result)
    return figure


def _draw_pair(axes: Axes, result: StabilityMap, each: Slice) -> None:
    """Draw the classes of a slice over two axes; a ring marks the base point."""
    _draw_classes(axes, each.codes.T)
    axes.invert_yaxis()
    for which, name in zip("xy", each.axes):
        _ticks(axes, which, name, result.axes[name], 3)
    axes.label_outer()
    x, y = (_base_position(result, name) for name in each.axes)
    axes.plot(x, y, "o", ms=7, mfc="none", mec="white", mew=2.5)
    axes.plot(x, y, "o", ms=7, mfc="none", mec="black", mew=1.2)


def _draw_classes(axes: Axes, codes: np.ndarray) -> None:
    """Draw a cell for each code (rows, columns) in the colour of its class, white lines
    between.
    """
    axes.imshow(codes, aspect="auto", interpolation="nearest", **by_code(CLASS_COLOURS))
    rows, columns = codes.shape
    axes.set_xticks(np.arange(columns + 1) - 0.5, minor=True)
    axes.set_yticks(np.arange(rows + 1) - 0.5, minor=True)
    axes.tick_params(which="both", length=0)
    axes.grid(visible=False)
    axes.grid(which="minor", color="white", lw=0.8, alpha=1.0)
    axes.spines[:].set_visible(False)


def _ticks(
    axes: Axes, which: str, name: str, values: np.ndarray, most: int = _TICKS
) -> None:
    """Label at most `most` values of a map's axis `name` on a panel's axis 'x' or
    'y'.
    """
    stride = -(-len(values) // most)
    at = range(0, len(values), stride)
    axis = axes.xaxis if which == "x" else axes.yaxis
    words = [in_words(float(f"{values[i]:.2g}")) for i in at]
    axis.set_ticks(at, words, fontsize=SMALL)
    label = _LABELS.get(name, name.replace("_", " "))
    axis.set_label_text(label, fontsize=SMALL)


def _base_position(result: StabilityMap, name: str) -> float:
    """Position of the base point on a panel's axis: its index among the values,
    interpolated.
    """
    values = result.axes[name]
    index = np.arange(len(values))
    return float(np.interp(result.base[name], values, index))


def _legend_of_classes(figure: Figure, result: StabilityMap) -> None:
    """Draw a legend of the classes that occur in the slices."""
    slices = chain.from_iterable(result.slices[x] for x in result.methods)
    codes = [part.codes.ravel() for part in slices]
    labels = [_CLASS_LABELS.get(name, name) for name in CLASSES]
    occurring = np.unique(np.concatenate(codes))
    patches = [Patch(color=CLASS_COLOURS[i], label=labels[i]) for i in occurring]
    legend_below(figure, columns=4, handles=patches)


@styled(ValidityMap)
def validity_map(
    result: ValidityMap, tolerance: float = 1e-2, title: str = ""
) -> Figure:
    """Dispersion against the stiffness ratio, and errors of laws that do not know it.

    Above one curve an exponent, between the levels of binary collisions and Moreau's
    law; below how far off they are, with the tolerance.

    Args:
        result: what `ji.validity_map` returned.
        tolerance: of v+, relative to max |v-|; a line.
        title: above the picture.

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    Raises:
        TypeError: something else.

    >>> import jimpact as ji
    >>> result = ji.validity_map(
    ...     ji.chain([1.0, 1.0, 1.0]), [1, 0, 0], [1e-3, 1.0, 1e3], [1.0]
    ... )
    >>> len(ji.plot.validity_map(result).axes)
    2
    """
    default = "Where the stiffness ratio may be left out"
    figure, (top, bottom) = new_figure(6.8, title or default, 2, 1, sharex=True)
    # a colour an exponent, a line style a law
    for i, eta in enumerate(result.exponents):
        top.plot(result.ratios, result.dispersion[i], label=f"LZB, exponent {eta:g}")
        for name, style in _STYLES.items():
            error = np.maximum(result.error(name)[i], _LEAST)
            bottom.plot(result.ratios, error, style, color=colour_of(i))
    for name, style in _STYLES.items():
        limit = result.law_dispersion[name]
        top.axhline(limit, color="black", ls=style, lw=1, label=name)
        bottom.plot([], [], style, color="black", label=name)
    bottom.axhline(tolerance, color=GREY, lw=1, label=f"tolerance {share(tolerance)}")
    top.set_ylabel("dispersion index (0: one body has it all)")
    if result.scene.contacts == 2:
        ratio = "k2/k1"
    else:
        ratio = "of neighbours"
    bottom.set(
        xlabel=f"stiffness ratio {ratio}", ylabel="error of v+, relative to max |v-|"
    )
    bottom.set(yscale="log", ylim=(1e-5, None))
    logarithmic(bottom, "y")
    logarithmic(bottom, "x")
    top.legend()
    bottom.legend()
    return figure
