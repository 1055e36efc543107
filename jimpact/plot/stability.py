"""Pictures of a stability map: one axis at a time for all methods, pairs of axes for one method."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from jimpact.methods.stability.results import Slice, StabilityMap
from jimpact.methods.stability.runs import CLASSES

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
_LABELS = {
    "setting": "setting, coarse to fine",
    "stiffness_ratio": "stiffness ratio",
    "exponent": "exponent",
    "restitution": "restitution e",
    "mass_ratio": "mass ratio",
    "balls": "balls N",
}
_TICKS = 5  # labelled values along an axis, at most


def stability_map(found: StabilityMap, title: str = "") -> Figure:
    """One panel an axis: a row for each method, a column for each value; other axes at the base.

    Args:
        found: what `stability_map` returned.
        title: above the panels.

    Example: `ji.plot.stability_map(ji.stability_map(["default", "rk4"])).savefig("map.png")`.
    """
    names = list(found.axes)
    columns = min(3, len(names))
    rows = -(-len(names) // columns)
    height = 0.9 + rows * (0.9 + 0.27 * len(found.methods))
    figure = Figure(figsize=(2.2 + 2.9 * columns, height))
    figure.set_layout_engine("constrained")
    grid = figure.subplots(rows, columns, squeeze=False)
    for i, axes in enumerate(grid.flat):
        if i >= len(names):
            axes.remove()
            continue
        codes = [found.slices[name][i].codes for name in found.methods]
        _draw(axes, np.array(codes))
        _ticks(axes, "x", names[i], found.axes[names[i]])
        labels = found.methods if i % columns == 0 else [""] * len(found.methods)
        axes.set_yticks(range(len(found.methods)), labels, fontsize="small")
        _base_mark(axes, found, names[i])
    _finish(figure, found, title)
    return figure


def stability_pairs(found: StabilityMap, method: str, title: str = "") -> Figure:
    """One panel for every pair of axes, for one method; a ring marks the base point.

    Raises:
        ValueError: a map without pairs.
    """
    pairs = [each for each in found.slices[method] if len(each.axes) == 2]
    if not pairs:
        raise ValueError("Argument `found` must be a map with slices='pairs', but has none.")
    names = list(found.axes)
    size = len(names) - 1
    figure = Figure(figsize=(1.6 + 2.1 * size, 1.4 + 1.9 * size))
    figure.set_layout_engine("constrained")
    grid = figure.add_gridspec(size, size)
    for each in pairs:
        column, row = (names.index(name) for name in each.axes)
        axes = figure.add_subplot(grid[row - 1, column])
        _pair(axes, found, each, row == size, column == 0)
    _finish(figure, found, title or method)
    return figure


def _pair(axes: Axes, found: StabilityMap, each: Slice, bottom: bool, left: bool) -> None:
    _draw(axes, each.codes.T)
    axes.invert_yaxis()
    for which, name, labelled in (("x", each.axes[0], bottom), ("y", each.axes[1], left)):
        _ticks(axes, which, name, found.axes[name], labelled)
    x, y = (_place(found.axes[name], found.base[name]) for name in each.axes)
    axes.plot(x, y, "o", ms=7, mfc="none", mec="white", mew=2.5)
    axes.plot(x, y, "o", ms=7, mfc="none", mec="black", mew=1.2)


def _draw(axes: Axes, codes: np.ndarray) -> None:
    colours = ListedColormap(CLASS_COLOURS)
    edges = BoundaryNorm(np.arange(len(CLASSES) + 1) - 0.5, len(CLASSES))
    axes.imshow(codes, cmap=colours, norm=edges, aspect="auto", interpolation="nearest")
    rows, columns = codes.shape
    axes.set_xticks(np.arange(columns + 1) - 0.5, minor=True)
    axes.set_yticks(np.arange(rows + 1) - 0.5, minor=True)
    axes.grid(which="minor", color="white", lw=0.8)
    axes.tick_params(which="both", length=0)
    axes.spines[:].set_visible(False)


def _ticks(axes: Axes, which: str, name: str, values: np.ndarray, labelled: bool = True) -> None:
    step = -(-len(values) // _TICKS)
    at = range(0, len(values), step)
    labels = [_number(values[i]) if labelled else "" for i in at]
    if which == "x":
        axes.set_xticks(at, labels, fontsize="x-small")
        axes.set_xlabel(_LABELS[name] if labelled else "", fontsize="small")
    else:
        axes.set_yticks(at, labels, fontsize="x-small")
        axes.set_ylabel(_LABELS[name] if labelled else "", fontsize="small")


def _number(value: float) -> str:
    """Short: powers of ten as such."""
    power = np.log10(value) if value > 0 else np.nan
    if abs(power) >= 2 and abs(power - round(power)) < 1e-9:
        return f"$10^{{{round(power)}}}$"
    return f"{value:.2g}" if value < 1 or value != round(value) else f"{value:g}"


def _place(values: np.ndarray, value: float) -> float:
    """Where a value lies among the columns."""
    return float(np.interp(value, values, np.arange(len(values))))


def _base_mark(axes: Axes, found: StabilityMap, name: str) -> None:
    place = _place(found.axes[name], found.base[name])
    axes.plot(place, -0.62, "v", color="black", ms=5, clip_on=False)
    axes.set_ylim(len(found.methods) - 0.5, -0.5)


def _finish(figure: Figure, found: StabilityMap, title: str) -> None:
    seen = {
        int(code)
        for name in found.methods
        for each in found.slices[name]
        for code in np.unique(each.codes)
    }
    handles = [Patch(color=CLASS_COLOURS[code], label=CLASSES[code]) for code in sorted(seen)]
    figure.legend(
        handles=handles, loc="outside lower center", frameon=False, fontsize="small", ncols=8
    )
    figure.suptitle(title, x=0.01, ha="left", fontsize="medium")
