"""What the pictures share: sizes, colours, frames, legends, logarithmic axes."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

# Okabe and Ito's palette without yellow, distinct with every common colour blindness; then three of
# Paul Tol's muted colours, for charts of more than seven lines.
COLOURS = (
    *("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000"),
    *("#882255", "#999933", "#332288"),
)
MARKERS = "osD^vP*X"
GREY = "#777777"
HIGHLIGHT = "#FFF3C4"  # behind what a picture points out
PLATE = "white"  # behind every picture: axes and words are dark, so that dark pages need a plate
ON_LINES = {"fc": "white", "ec": "none", "pad": 1, "alpha": 0.8}  # behind a text on lines
SPREAD = 0.6  # width that the bodies of one group take, of the distance between groups

WIDTH = 7.2  # of every picture [in]: legible at half a page's width
COLUMNS = 2  # panels side by side
SMALL = 8.5  # smallest font [points]

_DECADES = 100.0  # an axis that spans less is labelled within its decades, too
_PLAIN = (1e-3, 1e5)  # numbers within are written without a power of ten


def new_figure(height: float) -> Figure:
    """A figure of the common width, `height` [in] high."""
    return Figure(figsize=(WIDTH, height), facecolor=PLATE, layout="constrained")


def new_panels(count: int, height: float, more: float = 0.0, **shared: Any) -> tuple[Figure, Any]:
    """A figure of `count` panels, two side by side; a row is `height` [in] high."""
    columns = min(COLUMNS, count)
    rows = -(-count // columns)
    figure = new_figure(more + height * rows)
    panels = figure.subplots(rows, columns, squeeze=False, **shared).ravel()
    for spare in panels[count:]:
        spare.remove()
    return figure, panels[:count]


def side_by_side(bodies: int) -> np.ndarray:
    """Offsets (bodies,) of the bodies of one group from its place."""
    return (np.arange(bodies) - (bodies - 1) / 2) * SPREAD / bodies


def finish(*panels: Axes, grid: Any = "both") -> None:
    """The frame of panels: two spines, a thin grid along `grid`."""
    for axes in panels:
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis=grid, lw=0.4, alpha=0.5)
        axes.set_axisbelow(True)


def heading(figure: Figure, title: str) -> None:
    """The title of a figure, on its left; none where it is empty."""
    if title:
        figure.suptitle(title, x=0.01, ha="left", fontsize="large")


def legend_below(figure: Figure, handles: Sequence[Any], columns: int, note: str = "") -> None:
    """One legend for all panels, below them, with a note on how to read them."""
    figure.legend(
        handles=list(handles),
        loc="outside lower center",
        frameon=False,
        fontsize=SMALL,
        ncols=max(min(columns, len(handles)), 1),
        title=note or None,
        title_fontsize=SMALL,
    )


def legend_within(axes: Axes, columns: int = 1, note: str = "") -> None:
    """The legend of one panel, where it hides little, below a note."""
    axes.legend(
        frameon=False,
        fontsize=SMALL,
        ncols=columns,
        handlelength=1.4,
        columnspacing=1.0,
        title=note or None,
        title_fontsize=SMALL,
    )


def mark(axes: Axes, point: Any, name: str, i: int, admissible: bool) -> None:
    """Outcome number i, hollow unless admissible; later ones smaller, so that equal ones show."""
    colour = GREY if i < 0 else COLOURS[i % len(COLOURS)]
    axes.plot(
        *point,
        "s" if i < 0 else MARKERS[i % len(MARKERS)],
        color=colour,
        mfc=colour if admissible else "none",
        ms=max(10 - i, 4),
        mew=1.6,
        ls="none",
        label=name if admissible else f"{name} (not admissible)",
    )


def write(axes: Axes, at: Any, text: str, **style: Any) -> None:
    """A small text, centred at a point (2,)."""
    centred: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": SMALL}
    axes.annotate(text, (at[0], at[1]), **centred | style)


def logarithmic(axes: Axes, which: str) -> None:
    """Axis 'x' or 'y' by powers of ten; labels never stand closer than they are long."""
    getattr(axes, f"set_{which}scale")("log")
    axis = getattr(axes, f"{which}axis")
    low, high = sorted(axis.get_view_interval())
    if high / low < 5:
        axis.set_major_locator(MaxNLocator(4))
    else:
        few = high / low < _DECADES
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if few else (1.0,), numticks=7))
    axis.set_major_formatter(FuncFormatter(lambda x, _: in_words(x)))
    axis.set_minor_formatter(NullFormatter())


def in_words(x: float) -> str:
    """A number for an axis; powers of ten as such."""
    if x == 0 or _PLAIN[0] <= abs(x) < _PLAIN[1]:
        return f"{x:g}"
    power = int(np.floor(np.log10(abs(x)) + 1e-9))
    factor = x / 10.0**power
    head = "" if abs(factor - 1) < 1e-6 else f"{factor:.3g}\\cdot"
    return f"${head}10^{{{power}}}$"


def wrapped(name: str) -> str:
    """A label in lines, for a narrow place."""
    return name.replace(", ", ",\n").replace("_", "\n")
