"""Picture of what `ji.advise` weighed."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from jimpact.methods.advice_report import ROUNDING, Advice, as_code, share
from jimpact.plot.style import (
    COLOURS,
    GREY,
    HIGHLIGHT,
    colour_of,
    legend_below,
    logarithmic,
    panels_of_laws,
    side_by_side,
    styled,
    write,
)


@styled(Advice)
def advice(result: Advice, title: str = "", names: Sequence[str] = ()) -> Figure:
    """Outcomes of every law over the unknown ratios, above their errors.

    Args:
        result: what `ji.advise` returned.
        title: above the picture.
        names: of the velocities with their units, as `body.velocity_names`: each unit
            has a panel of its own. Without names those of a chain are in m/s; others
            stand times the root of their inertia, in √J.

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    Raises:
        TypeError: something else. ValueError: another number of names.

    >>> import jimpact as ji
    >>> result = ji.advise(
    ...     ji.chain([1.0, 1.0]), [1.0, 0.0], restitution=0.9, timing=False
    ... )
    >>> len(ji.plot.advice(result).axes)
    2
    """
    laws = list(result.candidates)
    rows = list(result.candidates.values())
    named = [
        name if c.usable else f"{name}_({c.status})" for name, c in zip(laws, rows)
    ]
    figure, tops, bottom = panels_of_laws(named, result.scene, names, "", 1.8)
    verdict = f"{'within' if result.within else 'not within'} {share(result.tolerance)}"
    figure.axes[0].set_title(
        f"{title}\n{as_code(result.law)}: {verdict}", fontsize="large"
    )
    x = np.arange(len(laws))
    # a panel for each unit: index, name and factor of each velocity
    for top, velocities in tops:
        places = side_by_side(len(velocities))
        for (i, word, factor), offset in zip(velocities, places):
            if len(velocities) <= len(COLOURS):
                label = word
            else:
                label = None
            spans = np.array([(c.velocity[i], c.low[i], c.high[i]) for c in rows])
            v, low, high = factor * spans.T
            top.vlines(x + offset, low, high, color=colour_of(i), lw=4, alpha=0.4)
            top.plot(x + offset, v, "o", color=colour_of(i), label=label)
    chosen = laws.index(result.name)
    for axes in figure.axes:
        if axes is bottom:
            label = "advised"
        else:
            label = None
        axes.axvspan(chosen - 0.5, chosen + 0.5, color=HIGHLIGHT, lw=0, label=label)
    errors = np.array([(c.worst, c.median) for c in rows]).T
    # what is smaller has no place on a logarithmic axis: words
    beyond = errors > ROUNDING
    least = errors[beyond].min(initial=1.0)
    lowest = min(result.tolerance / 1000, least)
    worst, median = np.where(beyond, errors, np.nan)
    foot = np.where(np.isnan(median), lowest / 2, median)
    bottom.vlines(x, foot, worst, color=GREY, lw=1)
    bottom.plot(x, worst, "s", color="black", label="worst")
    bottom.plot(x, median, "_", color="black", ms=14, label="median")
    for j in np.flatnonzero(~beyond[0]):
        if laws[j] == result.reference:
            what = "reference"
        else:
            what = "rounding"
        write(bottom, (j, lowest), what)
    bottom.axhline(result.tolerance, color=COLOURS[1], lw=1, label="tolerance")
    bottom.set(yscale="log", ylim=(lowest / 2, 10))
    logarithmic(bottom, "y")
    bottom.set_ylabel("error of v+ (energy norm)")
    legend_below(figure, 6)
    return figure
