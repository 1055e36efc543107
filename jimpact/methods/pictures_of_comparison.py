"""Pictures of laws side by side: their velocities, and energy against its
dispersion.
"""

import dataclasses
from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from jimpact.methods.comparison import Comparison
from jimpact.plot.style import (
    COLOURS,
    GREY,
    HIGHLIGHT,
    colour_of,
    legend_below,
    mark,
    new_figure,
    panels_of_laws,
    side_by_side,
    styled,
)
from jimpact.theory.admissible import admissible_set
from jimpact.theory.dispersion import energy_dispersion, energy_ratio

_OUTCOMES = 4000  # dots of a set of outcomes; ten times more would only be one area


@styled(Comparison)
def comparison(
    result: Comparison,
    measured: np.ndarray | None = None,
    title: str = "",
    names: Sequence[str] = (),
) -> Figure:
    """Velocities after the impact by law, energy ratios T+/T- and dispersion indices.

    Measured velocities are horizontal lines, and the laws closest to them are
    highlighted; a law whose outcome fails the audit is crossed.

    Args:
        result: what `ji.compare` returned.
        measured: v+ (n,) [m/s]; None: those of `result`, if it has any.
        title: above the picture.
        names: of the velocities with their units, as `body.velocity_names`: each unit
            has a panel of its own. Without names those of a chain are in m/s; others
            stand times the root of their inertia, in √J.

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    Raises:
        TypeError: something else. ValueError: another number of names.

    >>> import jimpact as ji
    >>> result = ji.compare(
    ...     ji.chain([1.0, 1.0]), [1.0, 0.0], {"Newton": ji.Newton(0.5)}
    ... )
    >>> len(ji.plot.comparison(result).axes)
    2
    """
    if measured is not None:
        result = dataclasses.replace(result, measured=np.asarray(measured))
    laws = list(result.entries)
    entries = list(result.entries.values())
    figure, tops, bottom = panels_of_laws(laws, result.scene, names, title, 1.2)
    at = np.arange(len(entries))
    velocity = np.array([x.outcome.velocity for x in entries])
    passed = [bool(entry.audit.consistent) for entry in entries]
    wrong = ~np.array(passed)
    # a panel for each unit: index, name and factor of each velocity
    for top, velocities in tops:
        places = side_by_side(len(velocities))
        for (i, label, factor), offset in zip(velocities, places):
            x = at + offset
            y = factor * velocity[:, i]
            colour = colour_of(i)
            top.plot(x, y, "o", color=colour, label=label)
            top.plot(x[wrong], y[wrong], "x", color="black", ms=10)
            if result.measured is not None:
                level = [factor * result.measured[i]] * 2
                ends = [-0.5, len(at) - 0.5]
                top.plot(ends, level, "--", color=colour, lw=1, zorder=0)
        top.axhline(0, color="black", lw=0.6)
    if result.measured is not None:
        bottom.plot([], [], "--", color="black", lw=1, label="measured")
    if wrong.any():
        bottom.plot([], [], "x", color="black", ms=10, label="audit failed")
    kept = [x.energy_ratio for x in entries]
    spread = [x.dispersion_index for x in entries]
    bottom.bar(at - 0.18, kept, 0.32, color=GREY, label="energy ratio T+/T-")
    bottom.bar(at + 0.18, spread, 0.32, color=COLOURS[4], label="dispersion index")
    bottom.set_ylabel("ratio, index")
    for place in map(laws.index, result.closest):
        label = "closest to the measured velocities"
        for axes in figure.axes:
            stretch = (place - 0.48, place + 0.48)
            axes.axvspan(*stretch, color=HIGHLIGHT, lw=0, zorder=-1, label=label)
    legend_below(figure, 4)
    return figure


@styled(Comparison)
def energy_plane(result: Comparison, title: str = "") -> Figure:
    """Every law in the plane of energy kept (K_ER) and of its dispersion (C_KE).

    Dots are samples of the outcomes that mechanics allows; a law whose outcome fails
    the audit is hollow.

    Args:
        result: what `ji.compare` returned.
        title: above the picture.

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    Raises:
        TypeError: something else.

    >>> import jimpact as ji
    >>> result = ji.compare(
    ...     ji.chain([1.0, 1.0]), [1.0, 0.0], {"Newton": ji.Newton(0.5)}
    ... )
    >>> ji.plot.energy_plane(result).axes[0].get_xlabel()
    'energy ratio K_ER = T+/T-'
    """
    figure, axes = new_figure(5.4, title)
    allowed = admissible_set(result.scene, result.velocity).sample(0, _OUTCOMES)
    coordinates = _kept_and_spread(result, allowed)
    axes.plot(*coordinates, ".", color=COLOURS[4], alpha=0.3, ms=3, label="allowed")
    for i, (name, entry) in enumerate(result.entries.items()):
        at = _kept_and_spread(result, np.asarray(entry.outcome.velocity)[None])
        consistent = bool(entry.audit.consistent)
        mark(axes, np.ravel(at), name, i, consistent)
    axes.set(
        xlabel="energy ratio K_ER = T+/T-",
        ylabel="energy dispersion C_KE (0: equal shares)",
    )
    legend_below(figure, 4)
    return figure


def _kept_and_spread(
    result: Comparison, after: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Energy ratio K_ER = T+/T- (k,) and energy dispersion C_KE (k,) of velocities v+
    (k, n).
    """
    v = jnp.asarray(after)
    scene = result.scene
    ratio = partial(energy_ratio, scene, result.velocity)
    kept = jax.vmap(ratio)(v)
    spread = jax.vmap(partial(energy_dispersion, scene))(v)
    return np.asarray(kept), np.asarray(spread)
