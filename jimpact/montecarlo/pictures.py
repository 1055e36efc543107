"""Picture: distributions of the velocities, and a map of the outcome over two gaps."""

import textwrap
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jimpact.montecarlo.result import MonteCarlo
from jimpact.montecarlo.statistics import FAILURE
from jimpact.plot.style import SMALL, WIDTH, colour_of, styled
from jimpact.tools.records import readable_unit

_BARS = 30  # of a histogram: each is several pixels wide
# height of the mean, and of the axis, over that of the highest bar
_MEAN_AT = 1.12
_TOP = 1.25
# at most, on the axis of a velocity: those of a narrow range have many digits
_TICKS = 3
_BODIES = 6  # histograms; of more bodies only the most scattered are drawn
_DOT = 4.0  # area of a sample in the map [points^2]
_TITLE = 80  # letters of a line of the title


@styled(MonteCarlo)
def monte_carlo(result: MonteCarlo, title: str = "") -> Figure:
    """Histograms of every body, and the first samples over two gaps.

    Gaps are over the indentation of the contact (delta_c of `ji.theory.gap_scale`),
    where it is known. Each velocity has an axis of its own. The map shows the most
    scattered velocity over the two gaps with which it is most correlated; with one
    random gap, that velocity against it; without, no map.

    Args:
        result: what `ji.monte_carlo` returned.
        title: above the picture.

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    Raises:
        TypeError: something else.

    >>> import jimpact as ji
    >>> law, balls = ji.Binary(1.0, order="earliest"), ji.chain([1.0, 1.0, 1.0])
    >>> gaps = ji.Uniform(0.0, 1e-5)
    >>> result = ji.monte_carlo(law, balls, [1.0, 0.0, -1.0], gaps=gaps, samples=100)
    >>> len(ji.plot.monte_carlo(result).axes)  # three bodies, map, its colour bar
    5
    """
    scattered = np.argsort(-result.std, kind="stable")
    bodies = sorted(scattered[:_BODIES].tolist())
    mapped = result.first["gaps"].shape[1] > 0
    mosaic: Any = [[str(body), "map"] if mapped else [str(body)] for body in bodies]
    height = max(4.8, 2.0 * len(bodies))
    figure = Figure(figsize=(WIDTH, height))
    heading = title or textwrap.fill(result.description, _TITLE)
    figure.suptitle(heading, x=0.01, ha="left")
    panels = figure.subplot_mosaic(mosaic)
    for body in bodies:
        axes = panels[str(body)]
        _draw_histogram(axes, result, body)
    axes.set_xlabel(f"{axes.get_xlabel()}\n(dot: mean, bar: 5 % to 95 %)")
    if mapped:
        _draw_map(panels["map"], result, int(scattered[0]))
    return figure


def _draw_histogram(axes: Axes, result: MonteCarlo, body: int) -> None:
    """Draw the share of the samples [%] by v+ of a body, its mean, and 5 % to 95 % as a
    bar.
    """
    # without the counts below the first edge and above the last one
    counts = result.counts[body, 1:-1]
    edges = result.edges[body]
    each = max(1, len(counts) // _BARS)  # bins of a bar
    # bins in whole bars; the last bar takes the rest
    whole = len(counts) // each * each
    groups = counts[:whole].reshape(-1, each)
    bars = groups.sum(axis=1)
    bars[-1] += counts[whole:].sum()
    share = 100 * bars / max(result.count, 1)
    colour = colour_of(body)
    ends = np.append(edges[:whole:each], edges[-1])
    axes.stairs(share, ends, color=colour, fill=True)
    top = float(share.max())
    mean = result.mean[body]
    low, high = result.quantile([0.05, 0.95])[:, body]
    height = _MEAN_AT * top
    level = [height, height]
    axes.plot([low, high], level, "|-", color="black", ms=7, lw=1)
    axes.plot(mean, height, "o", color="black", ms=4)  # it may lie outside that range
    axes.set_ylim(0, _TOP * top)
    label = (
        f"body {body + 1}: mean {mean:.4g}, std {result.std[body]:.2g} {result.unit}"
    )
    axes.set_title(label, fontsize=SMALL, color=colour)
    axes.set(xlabel=f"velocity after the impact [{result.unit}]", ylabel="samples [%]")
    axes.ticklabel_format(axis="x", useOffset=False)
    axes.locator_params(axis="x", nbins=_TICKS)
    axes.grid(visible=False, axis="x")


def _most_correlated_gaps(result: MonteCarlo, body: int) -> list[int]:
    """Indices of at most two gaps with which v+ of a body is most correlated.

    Equation: the largest `|cov(v+, gap_j)| / std(gap_j)`; of equal ones the larger std.
    """
    std = np.sqrt(np.diag(result.gap_covariance))
    varies = std > 0
    covariance = np.abs(result.cross_covariance[body])
    correlation = covariance / np.where(varies, std, 1.0)
    # by the last key first
    of_varying = np.where(varies, correlation, -1.0)
    best = np.lexsort((-std, -of_varying))[:2]
    return sorted(best.tolist())


def _draw_map(axes: Axes, result: MonteCarlo, body: int) -> None:
    """Draw the first samples over their two most correlated gaps, coloured by v+ of a
    body.

    Of a single random gap: v+ over this gap.
    """
    first = result.first
    finite = np.isfinite(first["velocity"]).all(axis=1)
    fine = finite & ~FAILURE[first["status"]]
    velocity = first["velocity"][fine, body]
    gaps = _most_correlated_gaps(result, body)
    x_gaps = first["gaps"][fine, gaps[0]]
    x, x_label = _in_units(result, x_gaps, gaps[0])
    axes.set_xlabel(x_label)
    axes.set_title(f"{fine.sum():,} samples", fontsize=SMALL)
    axes.grid(visible=False)
    label = f"velocity of body {body + 1} [{result.unit}]"
    if len(gaps) == 1:
        axes.plot(x, velocity, ".", ms=3, color=colour_of(body))
        axes.set_ylabel(label)
        return
    y_gaps = first["gaps"][fine, gaps[1]]
    y, y_label = _in_units(result, y_gaps, gaps[1])
    axes.set_ylabel(y_label)
    colours = matplotlib.colormaps["cividis"]
    coloured = {"c": velocity, "cmap": colours}
    dots = axes.scatter(x, y, s=_DOT, **coloured, lw=0, rasterized=True)
    axes.figure.colorbar(dots, ax=axes, label=label)
    axes.set_aspect("equal" if _alike(x, y) else "auto")


def _in_units(
    result: MonteCarlo, gap: np.ndarray, contact: int
) -> tuple[np.ndarray, str]:
    """Gaps over delta_c of a contact if it is known, else in nm, µm, mm or m; the axis'
    label.
    """
    name = f"gap {contact + 1}"
    if result.gap_scale is not None:
        scale = result.gap_scale[contact]
        unit, size = readable_unit("m", scale)
        return gap / scale, f"{name} / indentation ({scale / size:.3g} {unit})"
    unit, size = readable_unit("m", np.max(gap, initial=0.0))
    return gap / size, f"{name} [{unit}]"


def _alike(x: np.ndarray, y: np.ndarray) -> bool:
    """True if the ranges of x and y differ by less than a factor of 2."""
    a = np.ptp(x)
    b = np.ptp(y)
    if b > 0:
        return bool(0.5 < a / b < 2)
    return False
