"""Pictures: the validity map, and the evidence behind an advice."""

import numpy as np
from matplotlib.figure import Figure

from jimpact.methods.advice.report import Advice
from jimpact.methods.advice.validity import ValidityMap
from jimpact.methods.advice.words import as_code, share
from jimpact.plot.fits import COLOURS

_STYLES = {"moreau": "--", "binary": ":"}
_GREY = "#777777"
_SPREAD = 0.6  # width that the bodies of one law take, of the distance between laws
_FLOOR = 1e-9  # errors below are drawn here


def validity_map(found: ValidityMap, tolerance: float = 1e-2, title: str = "") -> Figure:
    """Dispersion against the stiffness ratio, and the errors of the laws that do not know it.

    Above one curve an exponent, between the levels of binary collisions and Moreau's law; below
    how far off they are, with the tolerance.

    >>> import jimpact as ji
    >>> found = ji.validity_map(ji.chain([1.0, 1.0, 1.0]), [1, 0, 0], [1e-3, 1.0, 1e3], [1.0])
    >>> len(ji.plot.validity_map(found).axes)
    2
    """
    figure = Figure(figsize=(7.5, 7.0), layout="constrained")
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
    bottom.axhline(tolerance, color=_GREY, lw=1, label=f"tolerance {share(tolerance)}")
    top.set_ylabel("dispersion index (0: one body has it all)")
    bottom.set_ylabel("error of v+, relative to max |v-|")
    bottom.set_yscale("log")
    bottom.set_ylim(bottom=1e-5)
    bottom.set_xscale("log")
    two = found.scene.contacts == 2
    bottom.set_xlabel("stiffness ratio k2/k1" if two else "stiffness ratio of neighbours")
    top.set_title(title or "Where the stiffness ratio may be left out", loc="left")
    for axes in (top, bottom):
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(lw=0.4, alpha=0.5)
        axes.legend(frameon=False, fontsize="small")
    return figure


def advice(found: Advice, title: str = "") -> Figure:
    """Outcomes of every law, with their range over the unknown ratios, above their errors.

    >>> import jimpact as ji
    >>> found = ji.advise(ji.chain([1.0, 1.0]), [1.0, 0.0], restitution=0.9, timing=False)
    >>> len(ji.plot.advice(found).axes)
    2
    """
    names, rows = list(found.candidates), list(found.candidates.values())
    bodies, x = len(found.velocity), np.arange(len(names))
    dodge = (np.arange(bodies) - (bodies - 1) / 2) * _SPREAD / bodies
    figure = Figure(figsize=(7.5, 6.5), layout="constrained")
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    for i in range(bodies):
        colour = COLOURS[i % len(COLOURS)]
        v = np.array([c.velocity[i] for c in rows])
        range_ = np.array([[c.low[i], c.high[i]] for c in rows])
        top.vlines(x + dodge[i], range_[:, 0], range_[:, 1], color=colour, lw=4, alpha=0.4)
        top.plot(x + dodge[i], v, "o", color=colour, label=f"body {i + 1}")
    worst = np.maximum([c.worst for c in rows], _FLOOR)
    colours = [COLOURS[2] if name == found.name else _GREY for name in names]
    bottom.bar(x, worst, 0.5, color=colours, label="worst")
    bottom.plot(x, np.maximum([c.median for c in rows], _FLOOR), "k_", ms=18, label="median")
    bottom.axhline(found.tolerance, color=COLOURS[1], lw=1, label="tolerance")
    bottom.set_yscale("log")
    bottom.set_ylim(found.tolerance / 1000, 30)  # room above for the legend
    bottom.set_ylabel("error of v+ / max |v-|")
    top.set_ylabel("velocity after the impact [m/s]")
    unusable = [name if c.usable else f"{name}\n({c.status})" for name, c in zip(names, rows)]
    bottom.set_xticks(x, unusable)
    verdict = "within" if found.within else "not within"
    top.set_title(f"{title}\n{as_code(found.law)}: {verdict} {share(found.tolerance)}", loc="left")
    for axes in (top, bottom):
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="y", lw=0.4, alpha=0.5)
    if bodies <= len(COLOURS):
        top.legend(frameon=False, fontsize="small")
    bottom.legend(frameon=False, fontsize="small", ncols=3, loc="upper right")
    return figure
