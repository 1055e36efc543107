"""Parts of all pictures: the style sheet, figures of panels, legends, logarithmic
axes.
"""

import functools
import inspect
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, ParamSpec, TypeVar

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.text import Text
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter
from matplotlib.transforms import Bbox

from jimpact.bodies.base import split_name
from jimpact.core.scene import Scene, dense_mass
from jimpact.tools.checks import check_kind

SHEET = Path(__file__).with_name("jimpact.mplstyle")
_SETTINGS = matplotlib.rc_params_from_file(SHEET, use_default_template=False)
COLOURS = tuple(each["color"] for each in _SETTINGS["axes.prop_cycle"])
SMALL = _SETTINGS["legend.fontsize"]
MARKERS = "osD^vP*X"
GREY = "#777777"
HIGHLIGHT = "#FFF3C4"  # behind what a picture points out
SPREAD = 0.6  # width that the bodies of one group take, of the distance between groups

WIDTH = 7.2  # of every picture [in]: legible at half a page's width
COLUMNS = 2  # panels side by side

_UPRIGHT = 8  # names of laws that stand side by side, at most
_DECADES = 100.0  # an axis that spans less is labelled within its decades, too
_MINUS = re.compile(r"(?<![\w)\]}])-(?=\.?\d)")  # a hyphen in the place of a minus sign
_PLAIN = (1e-3, 1e5)  # numbers within are written without a power of ten

P = ParamSpec("P")
R = TypeVar("R")


def styled(kind: type = object) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorator of a function that draws: its first argument must be a `kind`, else a
    TypeError.

    It draws in the style sheet, which leaves matplotlib's own settings as they were,
    and writes minus signs in place of hyphens.
    """

    def decorated(picture: Callable[P, R]) -> Callable[P, R]:
        """The function with the check of its first argument and the style."""
        first = next(iter(inspect.signature(picture).parameters), "")

        @functools.wraps(picture)
        def drawn(*args: P.args, **keywords: P.kwargs) -> R:
            """The picture of these arguments."""
            check_kind(first, args[0] if args else keywords.get(first), kind)
            with matplotlib.style.context(SHEET):
                result = picture(*args, **keywords)
            for text in result.findobj(Text) if isinstance(result, Figure) else ():
                text.set_text(_MINUS.sub("\N{MINUS SIGN}", text.get_text()))
            return result

        return drawn

    return decorated


def colour_of(i: int) -> str:
    """The colour of line or body number i; after the last one the first again."""
    return COLOURS[i % len(COLOURS)]


def by_code(colours: tuple[str, ...]) -> dict[str, Any]:
    """Options of an image whose values are whole numbers, the code of a colour each."""
    edges = np.arange(len(colours) + 1) - 0.5
    norm = BoundaryNorm(edges, len(colours))
    return {"cmap": ListedColormap(colours), "norm": norm}


def new_figure(
    height: float, title: str = "", rows: int = 1, columns: int = 1, **grid: Any
) -> tuple[Figure, Any]:
    """A figure of the common width, `height` [in] high, and its axes, see
    `Figure.subplots`.
    """
    figure = Figure(figsize=(WIDTH, height))
    if title:
        figure.suptitle(title, x=0.01, ha="left")
    return figure, figure.subplots(rows, columns, **grid)


def new_panels(
    count: int, height: float, more: float = 0.0, title: str = "", **shared: Any
) -> tuple[Figure, Any]:
    """A figure of `count` panels, two side by side; a row is `height` [in] high."""
    columns = min(COLUMNS, count)
    rows = -(-count // columns)
    total = more + height * rows
    figure, panels = new_figure(total, title, rows, columns, squeeze=False, **shared)
    for spare in panels.ravel()[count:]:
        spare.remove()
    return figure, panels.ravel()[:count]


Velocity = tuple[int, str, float]  # index, name, and what it is multiplied by


def velocities_by_unit(scene: Scene, names: Sequence[str]) -> dict[str, list[Velocity]]:
    """Velocities of a scene grouped by unit; keys are the labels of their axes.

    `names` are those of the n velocities, with units. Without names those of a chain
    are in m/s; others, in m/s or rad/s, are comparable only times the root of their
    inertia M_ii, in √J.
    """
    label = "velocity after the impact"
    n = scene.size
    if names and len(names) != n:
        raise ValueError(
            f"Argument `names` must have {n} names, one a velocity, but has {names}."
        )
    if not names and scene.walls is not None:
        bodies = [(i, f"body {i + 1}", 1.0) for i in range(n)]
        return {f"{label} [m/s]": bodies}
    if not names:
        root = np.sqrt(np.diag(dense_mass(scene))).tolist()
        each = [(i, f"coordinate {i + 1}", root[i]) for i in range(n)]
        return {f"{label} · √inertia [√J]": each}
    by_unit: dict[str, list[Velocity]] = {}
    for i, (word, unit) in enumerate(map(split_name, names)):
        panel = f"{label} [{unit}]" if unit else label
        by_unit.setdefault(panel, []).append((i, word, 1.0))
    return by_unit


def panels_of_laws(
    laws: Sequence[str], scene: Scene, names: Sequence[str], title: str, lowest: float
) -> tuple[Figure, list[tuple[Axes, list[Velocity]]], Axes]:
    """Figure with laws side by side: a panel for the velocities of each unit, and one
    below.

    Returns the figure, the upper panels with their velocities, and the lowest one,
    `lowest` [in] high.
    """
    units = velocities_by_unit(scene, names)
    heights = [2.6] * len(units) + [lowest]
    grid: Any = {"sharex": True, "height_ratios": heights}
    total = sum(heights) + 2.2
    figure, panels = new_figure(total, title, len(heights), 1, **grid)
    for axes, label in zip(panels, units):
        axes.set_ylabel(label)
    for axes in panels:
        axes.grid(visible=False, axis="x")
    many = len(laws) > _UPRIGHT
    if many:
        words = laws
    else:
        words = [law.replace(", ", ",\n").replace("_", "\n") for law in laws]
    at = range(len(laws))
    angle = 90 if many else 0
    panels[-1].set_xticks(at, words, fontsize=SMALL, rotation=angle)
    panels[-1].set_xlabel("law")
    of_units = list(zip(panels, units.values()))
    return figure, of_units, panels[-1]


def side_by_side(bodies: int) -> np.ndarray:
    """Offsets (bodies,) on the x axis of the bodies of one group: evenly over `SPREAD`,
    mean 0.
    """
    place = np.arange(bodies) - (bodies - 1) / 2
    return place * SPREAD / bodies


def legend_below(
    figure: Figure, columns: int, handles: Iterable[Any] | None = None, note: str = ""
) -> None:
    """Draw one legend below all panels, with `note` as its title.

    It has the given `handles`, else those of all panels, each label once.
    """
    if handles is None:
        pairs = [
            pair for x in figure.axes for pair in zip(*x.get_legend_handles_labels())
        ]
        first = {label: handle for handle, label in reversed(pairs)}
        handles = [first[label] for label in dict.fromkeys(label for _, label in pairs)]
    entries = list(handles)
    if entries:
        most = min(columns, len(entries))
        place: Any = {"loc": "outside lower center", "ncols": most}
        figure.legend(handles=entries, title=note or None, **place)


class LineEnd(NamedTuple):
    """End of a line in a panel, for `label_ends`."""

    axes: Axes
    at: tuple[float, float]  # x, y
    name: str
    colour: str


def label_ends(figure: Figure, ends: Iterable[LineEnd]) -> None:
    """Write the names of lines beside their ends, moved up where two would overlap.

    Call it when the panels have their final limits and scales.
    """
    place: dict[str, Any] = {
        "textcoords": "offset points",
        "va": "center",
        "fontsize": SMALL,
    }
    lowest_first = sorted(ends, key=lambda end: end.at[1])
    texts = []
    for axes, at, name, colour in lowest_first:
        style = place | {"color": colour, "zorder": 5}
        text = axes.annotate(name, at, xytext=(5, 0), **style)
        text.set_path_effects([withStroke(linewidth=2, foreground="white")])
        texts.append(text)
    figure.draw_without_rendering()  # the layout decides where points are on the page
    boxes: list[Bbox] = []
    for text in texts:
        box = text.get_window_extent()
        up = 0.0
        moved = box
        while any(moved.overlaps(other) for other in boxes):
            up += box.height / 4
            moved = box.translated(0, up)
        text.xyann = (5, up * 72 / figure.dpi)
        boxes.append(moved)


def mark(axes: Axes, point: Any, name: str, i: int, admissible: bool) -> None:
    """Draw outcome number i at a point (2,), hollow unless admissible; i < 0: a grey
    square.

    Later ones are smaller, so that equal ones show.
    """
    axes.plot(
        *point,
        "s" if i < 0 else MARKERS[i % len(MARKERS)],
        color=GREY if i < 0 else colour_of(i),
        fillstyle="full" if admissible else "none",
        ms=max(10 - i, 4),
        mew=1.6,
        label=name if admissible else f"{name} (not admissible)",
    )


def write(axes: Axes, at: Any, text: str, **style: Any) -> None:
    """Write a small text, centred at a point (2,)."""
    centred: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": SMALL}
    point = (at[0], at[1])
    axes.annotate(text, point, **centred | style)


def logarithmic(axes: Axes, which: str) -> None:
    """Make axis 'x' or 'y' logarithmic, with so few labels that they do not overlap."""
    getattr(axes, f"set_{which}scale")("log")
    axis = getattr(axes, f"{which}axis")
    low, high = sorted(axis.get_view_interval())
    if high / low < 5:
        axis.set_major_locator(MaxNLocator(4))
    else:
        few = high / low < _DECADES
        digits = (1.0, 2.0, 5.0) if few else (1.0,)
        axis.set_major_locator(LogLocator(subs=digits, numticks=7))
    axis.set_major_formatter(
        FuncFormatter(lambda x, _: _tick(x, *axis.get_view_interval()))
    )
    axis.set_minor_formatter(NullFormatter())


def _tick(x: float, first: float, last: float) -> str:
    """Label x of a logarithmic axis from `first` to `last`: a power of ten if one of
    these is.
    """
    plain = all(_PLAIN[0] <= end < _PLAIN[1] for end in (first, last))
    if plain:
        return in_words(x)
    return as_power(x)


def in_words(x: float) -> str:
    """A number for an axis; powers of ten as such."""
    if x == 0 or _PLAIN[0] <= abs(x) < _PLAIN[1]:
        return f"{x:g}"
    return as_power(x)


def as_power(x: float) -> str:
    """A number as a factor, unless it is 1, and a power of ten."""
    magnitude = np.log10(abs(x)) + 1e-9
    power = int(np.floor(magnitude))
    factor = x / 10.0**power
    if abs(factor - 1) < 1e-6:
        head = ""
    else:
        head = f"{factor:.3g}\\cdot"
    return f"${head}10^{{{power}}}$"
