"""Picture: distributions of the velocities, and a map of the outcome over two gaps."""

import textwrap

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jimpact._checks import check_kind
from jimpact.files.records import readable_unit
from jimpact.montecarlo.results import MonteCarlo
from jimpact.montecarlo.statistics import FAILURE
from jimpact.plot.style import COLOURS, SMALL, finish, heading, new_figure

_BARS = 100  # of a histogram in the picture
_BODIES = 6  # with a histogram of their own; of more only the most scattered are shown
_DOT = 4.0  # area of a sample in the map [points^2]
_TITLE = 80  # letters of a line of the title


def monte_carlo(found: MonteCarlo, title: str = "") -> Figure:
    """Histograms of every body, and the first samples over two gaps, coloured by the outcome.

    The map shows the two gaps that vary most and the most scattered velocity; with one random
    gap, that velocity against it; without, no map.

    Args:
        found: what `ji.monte_carlo` returned.
        title: above the picture.

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    Raises:
        TypeError: something else.

    >>> import jimpact as ji
    >>> law, balls = ji.Binary(1.0, order="earliest"), ji.chain([1.0, 1.0, 1.0])
    >>> gaps = ji.Uniform(0.0, 1e-5)
    >>> found = ji.monte_carlo(law, balls, [1.0, 0.0, -1.0], gaps=gaps, samples=100)
    >>> len(ji.plot.monte_carlo(found).axes)  # three bodies, map, its colour bar
    5
    """
    check_kind("found", found, MonteCarlo)
    scattered = np.argsort(-found.std, kind="stable")
    bodies = sorted(scattered[:_BODIES].tolist())
    mapped = found.first["gaps"].shape[1] > 0
    figure = new_figure(max(4.8, 1.5 * len(bodies)))
    grid = figure.add_gridspec(len(bodies), 2 if mapped else 1)
    shared: Axes | None = None
    for row, body in enumerate(bodies):
        axes = figure.add_subplot(grid[row, 0], sharex=shared)
        shared = shared or axes
        _histogram(axes, found, body)
        axes.tick_params(labelbottom=row == len(bodies) - 1)
    axes.set_xlabel("velocity after the impact [m/s]\n(line: mean, dotted: 5 % and 95 %)")
    heading(figure, title or textwrap.fill(found.description, _TITLE))
    if mapped:
        _map(figure.add_subplot(grid[:, 1]), found, int(scattered[0]))
    return figure


def _histogram(axes: Axes, found: MonteCarlo, body: int) -> None:
    """Share of the samples by velocity; mean, and the 5 % and 95 % quantiles."""
    counts, edges = found.counts[body, 1:-1], found.edges[body]
    each = max(1, len(counts) // _BARS)
    whole = len(counts) // each * each
    bars = counts[:whole].reshape(-1, each).sum(axis=1)
    bars[-1] += counts[whole:].sum()
    colour = COLOURS[body % len(COLOURS)]
    ends = np.append(edges[:whole:each], edges[-1])
    axes.stairs(100 * bars / max(found.count, 1), ends, color=colour, fill=True, alpha=0.75)
    axes.axvline(found.mean[body], color="black", lw=1)
    for limit in found.quantile([0.05, 0.95])[:, body]:
        axes.axvline(limit, color="black", lw=0.8, ls=":")
    label = f"body {body + 1}: {found.mean[body]:.3f} ± {found.std[body]:.3f} m/s"
    axes.set_title(label, loc="left", fontsize=SMALL, color=colour)
    axes.set_ylabel("samples [%]")
    finish(axes, grid="y")


def _map(axes: Axes, found: MonteCarlo, body: int) -> None:
    first = found.first
    fine = np.isfinite(first["velocity"]).all(axis=1) & ~FAILURE[first["status"]]
    velocity = first["velocity"][fine, body]
    vary = np.argsort(-np.diag(found.gap_covariance), kind="stable")[:2]
    gaps = sorted(vary.tolist())
    x = [_in_units(found, first["gaps"][fine, gap], gap) for gap in gaps]
    axes.set_xlabel(x[0][1])
    axes.set_title(f"{fine.sum():,} samples", loc="left", fontsize=SMALL)
    axes.spines[["top", "right"]].set_visible(False)
    label = f"velocity of body {body + 1} [m/s]"
    if len(gaps) == 1:
        axes.plot(x[0][0], velocity, ".", ms=3, color=COLOURS[body % len(COLOURS)])
        axes.set_ylabel(label)
        return
    axes.set_ylabel(x[1][1])
    colours = matplotlib.colormaps["cividis"]
    dots = axes.scatter(x[0][0], x[1][0], s=_DOT, c=velocity, cmap=colours, lw=0, rasterized=True)
    axes.figure.colorbar(dots, ax=axes, label=label)
    axes.set_aspect("equal" if _alike(x[0][0], x[1][0]) else "auto")


def _in_units(found: MonteCarlo, gap: np.ndarray, contact: int) -> tuple[np.ndarray, str]:
    """Gaps in gap scales where there are such, else in the metric unit that fits, and the label."""
    name = f"gap {contact + 1}"
    if found.gap_scale is not None:
        scale = found.gap_scale[contact]
        return gap / scale, f"{name} / {scale * 1e6:.3g} µm (gap scale)"
    unit, size = readable_unit("m", np.max(gap, initial=0.0))
    return gap / size, f"{name} [{unit}]"


def _alike(x: np.ndarray, y: np.ndarray) -> bool:
    """Whether both axes reach over similar ranges."""
    a, b = np.ptp(x), np.ptp(y)
    return bool(0.5 < a / b < 2) if b > 0 else False
