"""Pictures of the rocking block over its shape: the V of its dispersion, and what it does next."""

import numpy as np
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from jimpact.plot.fits import COLOURS
from jimpact.theory.rocking_record import OUTCOMES, STAYS, RockingDispersion, critical_kinetic_angle

_OUTCOME_COLOURS = ("#999999", "#009E73", "#E69F00", "#56B4E9", "#EEEEEE")  # as OUTCOMES


def rocking_dispersion(found: RockingDispersion, title: str = "") -> Figure:
    """|y_A'+ / y_B'-| against the kinetic angle: a panel for each mu, a line for each e.

    The dotted line is `critical_kinetic_angle`.

    >>> import jimpact as ji
    >>> import numpy as np
    >>> zero = np.zeros((2, 1, 1))
    >>> axes = map(np.array, ([1.0, 2], [0.1], [0.5]))
    >>> d = ji.theory.RockingDispersion(*axes, np.zeros((2, 1, 1, 2)), zero, zero, zero, zero)
    >>> len(ji.plot.rocking_dispersion(d).axes)
    1
    """
    figure, panels = _panels(found, title, 3.0)
    theta, size = np.degrees(found.kinetic_angle), np.abs(found.dispersion)
    for j, axes in enumerate(panels):
        for k, e in enumerate(np.asarray(found.restitution)):
            colour = COLOURS[k % len(COLOURS)]
            axes.plot(theta, size[:, j, k], color=colour, lw=1.6, label=f"e = {e:g}")
        axes.axvline(_critical(found, j), color="black", ls=":", lw=1)
        axes.set_xlabel(r"kinetic angle $\theta_{12}$ [degrees]")
        axes.grid(lw=0.4, alpha=0.5)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylim(bottom=0)  # shared by all, so last
    panels[0].set_ylabel(r"$|\dot y_A^+ / \dot y_B^-|$")
    handles = panels[0].get_legend_handles_labels()[0]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    return figure


def rocking_outcomes(found: RockingDispersion, title: str = "", stays: float = STAYS) -> Figure:
    """Rest, rocking, half-rocking, free over the kinetic angle and e: a panel for each mu.

    The dotted line is `critical_kinetic_angle`; `stays` as in `RockingDispersion.outcomes`.

    >>> import jimpact as ji
    >>> import numpy as np
    >>> zero = np.zeros((2, 1, 2))
    >>> axes = map(np.array, ([1.0, 2], [0.1], [0.5, 1]))
    >>> d = ji.theory.RockingDispersion(*axes, np.zeros((2, 1, 2, 2)), zero, zero, zero, zero)
    >>> len(ji.plot.rocking_outcomes(d).axes)
    1
    """
    figure, panels = _panels(found, title, 3.2)
    codes = found.outcomes(stays)
    colours = ListedColormap(_OUTCOME_COLOURS)
    norm = BoundaryNorm(np.arange(len(OUTCOMES) + 1) - 0.5, len(OUTCOMES))
    theta, e = np.degrees(found.kinetic_angle), np.asarray(found.restitution)
    for j, axes in enumerate(panels):
        axes.pcolormesh(theta, e, codes[:, j].T, cmap=colours, norm=norm, shading="nearest")
        axes.axvline(_critical(found, j), color="black", ls=":", lw=1)
        axes.set_xlabel(r"kinetic angle $\theta_{12}$ [degrees]")
    panels[0].set_ylabel("restitution e")
    shown = np.unique(codes)
    handles = [Patch(color=_OUTCOME_COLOURS[i], label=OUTCOMES[i]) for i in shown]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    return figure


def _panels(found: RockingDispersion, title: str, height: float) -> tuple:
    count = len(found.friction)
    figure = Figure(figsize=(1.2 + 2.9 * count, height + 0.5))
    figure.set_layout_engine("constrained")
    panels = figure.subplots(1, count, sharey=True, squeeze=False)[0]
    for axes, mu in zip(panels, np.asarray(found.friction)):
        axes.set_title(f"mu = {mu:g}", loc="left", fontsize="medium")
    if title:
        figure.suptitle(title, x=0.02, ha="left")
    return figure, panels


def _critical(found: RockingDispersion, j: int) -> float:
    return float(np.degrees(critical_kinetic_angle(found.friction[j])))
