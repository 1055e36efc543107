"""Picture: outcomes of several laws side by side."""

import numpy as np
from matplotlib.figure import Figure

from jimpact.comparison import Comparison
from jimpact.plot.fits import COLOURS

_SPREAD = 0.6  # width that the bodies of one law take, of the distance between laws


def comparison(found: Comparison, measured: np.ndarray | None = None, title: str = "") -> Figure:
    """Velocities after the impact by law, above the energy kept and how evenly it is spread.

    Measured velocities are horizontal lines; a law whose outcome fails the audit is crossed.

    >>> import jimpact as ji
    >>> found = ji.compare(ji.chain([1.0, 1.0]), [1.0, 0.0], {"Newton": ji.Newton(0.5)})
    >>> len(ji.plot.comparison(found).axes)
    2
    """
    names, entries = list(found.entries), list(found.entries.values())
    bodies = len(found.velocity)
    dodge = (np.arange(bodies) - (bodies - 1) / 2) * _SPREAD / max(bodies, 1)
    figure = Figure(figsize=(float(np.clip(1.5 + 1.1 * len(names), 6.4, 14)), 6.0))
    figure.set_layout_engine("constrained")
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1.4))
    x = np.arange(len(names))
    velocity = np.array([np.asarray(entry.outcome.velocity) for entry in entries])
    fine = np.array([bool(entry.audit.consistent) for entry in entries])
    for i in range(bodies):
        colour = COLOURS[i % len(COLOURS)]
        top.plot(x + dodge[i], velocity[:, i], "o", color=colour, label=f"body {i + 1}")
        if measured is not None and np.isfinite(measured[i]):
            top.axhline(measured[i], color=colour, lw=1, ls="--", zorder=0)
        if not fine.all():
            wrong = (x + dodge[i])[~fine], velocity[~fine, i]
            top.plot(*wrong, "x", color="black", ms=10, label="audit failed" if i == 0 else None)
    if measured is not None:
        top.plot([], [], color="black", lw=1, ls="--", label="measured")
    top.axhline(0, color="black", lw=0.6)
    top.set_ylabel("velocity after the impact [m/s]")
    top.set_title(title, loc="left")
    kept = [entry.energy_ratio for entry in entries]
    spread = [entry.dispersion_index for entry in entries]
    bottom.bar(x - 0.18, kept, 0.32, color="#777777", label="energy kept T+/T-")
    bottom.bar(x + 0.18, spread, 0.32, color="#56B4E9", label="dispersion index")
    bottom.set_xticks(x, names, rotation=30 if len(names) > 6 else 0)
    for axes in (top, bottom):
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="y", lw=0.4, alpha=0.5)
    figure.legend(loc="outside lower center", frameon=False, fontsize="small", ncols=5)
    return figure
