"""Pictures of contact forces and of force histories: of laws, on which pictures
stand.
"""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from jimpact.laws.histories import History
from jimpact.plot.style import (
    COLOURS,
    GREY,
    colour_of,
    legend_below,
    new_figure,
    styled,
    write,
)
from jimpact.tools.records import readable_unit


@styled()
def forces(histories: Mapping[str, History], contact: int = -1) -> Figure:
    """Force at one contact over impact time, one line a history.

    Args:
        histories: label -> what `ji.history` returned.
        contact: counted from 0; -1: the last one.

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    >>> import jimpact as ji
    >>> h = ji.history(ji.LZB(1.0), ji.chain([1.0], wall=True), [1.0])
    >>> len(ji.plot.forces({"one ball": h}).axes[0].lines)
    1
    """
    figure, axes = new_figure(4.2)
    longest = max(float(h.duration) for h in histories.values())
    unit, size = readable_unit("s", longest)
    for name, h in histories.items():
        time = np.asarray(h.time) / size
        axes.plot(time, h.force[:, contact], label=name)
    axes.set(xlabel=f"impact time [{unit}]", ylabel="force [N]")
    axes.set_ylim(bottom=0)
    axes.legend()
    return figure


@styled(History)
def contact_loop(result: History, contact: int = -1, title: str = "") -> Figure:
    """Force of a contact against its approach; the loop encloses the lost energy.

    O begins, M1, M2, ... end compressions, R1, R2, ... are where a contact that expands
    is compressed again, B is the end with the residual indentation.

    Args:
        result: what `ji.history` returned, of one impact.
        contact: counted from 0; -1: the last one.
        title: above the picture.

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    Raises:
        ValueError: a batch of impacts. TypeError: something else.

    >>> import jimpact as ji
    >>> h = ji.history(ji.LZB(0.8), ji.chain([1.0], wall=True), [1.0])
    >>> [text.get_text() for text in ji.plot.contact_loop(h).axes[0].texts]
    ['O', 'M1', 'B']
    """
    _check_one(result)
    force = np.asarray(result.force[:, contact])
    rate = np.asarray(result.gap_velocity[:, contact])
    touching = np.flatnonzero(force > 0)
    # to the first state without force
    until = slice(0, touching[-1] + 2 if len(touching) else 1)
    deepest = np.max(np.abs(result.approach[:, contact]))
    unit, size = readable_unit("m", float(deepest))
    x = np.asarray(result.approach[until, contact]) / size
    force = force[until]
    figure, axes = new_figure(4.4, title)
    axes.plot(x, force, color=COLOURS[0], lw=1.8)
    axes.fill(x, force, color=COLOURS[4], alpha=0.2, lw=0)
    # states at which the gap velocity changes sign
    if len(touching):
        turns = np.flatnonzero(np.diff(rate[until] > 0))
    else:
        turns = np.zeros(0, int)
    names = [f"{'MR'[i % 2]}{i // 2 + 1}" for i in range(len(turns))]
    corners = ["O", *names, "B"]
    states = [0, *turns, len(x) - 1]
    for name, i in zip(corners, states, strict=True):
        if name[0] == "R":
            above = (0, -10)
        else:
            above = (0, 10)
        point = (x[i], force[i])
        axes.plot(*point, "o", color="black", ms=4)
        write(axes, point, name, xytext=above, textcoords="offset points")
    axes.margins(y=0.12)
    axes.set(xlabel=f"approach of the bodies [{unit}]", ylabel="force [N]")
    return figure


def _check_one(result: History) -> None:
    """Refuse batches of impacts."""
    if np.ndim(result.status):
        raise ValueError(
            "Argument `result` must be of one impact, but is a batch: pick one of it."
        )


@styled(History)
def history(result: History, title: str = "") -> Figure:
    """One impact over its time: forces, gap velocities, stored energy.

    Args:
        result: what `ji.history` returned, of one impact.
        title: above the picture.

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    Raises:
        ValueError: a batch of impacts. TypeError: something else.

    >>> import jimpact as ji
    >>> h = ji.history(ji.LZB(1.0), ji.chain([1.0], wall=True), [1.0])
    >>> [axes.get_ylabel() for axes in ji.plot.history(h).axes]
    ['force [N]', 'gap velocity [m/s]', 'stored energy [J]']
    """
    _check_one(result)
    unit, size = readable_unit("s", float(result.duration))
    time = np.asarray(result.time) / size
    contacts = result.force.shape[1]
    figure, panels = new_figure(6.8, title, 3, 1, sharex=True)
    rows = {
        "force [N]": result.force,
        "gap velocity [m/s]": result.gap_velocity,
        "stored energy [J]": result.energy,
    }
    for axes, (label, values) in zip(panels, rows.items(), strict=True):
        labels = [f"contact {j + 1}" for j in range(contacts)]
        axes.plot(time, values, label=labels)
        axes.set_ylabel(label)
    for j, y in enumerate(np.asarray(result.tangential_force).T):
        colour = colour_of(j * contacts // result.tangential_force.shape[1])
        name = "tangential" if j == 0 else None
        panels[0].plot(time, y, "--", color=colour, label=name)
    panels[1].axhline(0, color=GREY, lw=0.8)
    panels[-1].set_xlabel(f"impact time [{unit}]")
    handles = panels[0].get_legend_handles_labels()[0]
    legend_below(figure, 5, handles[: len(COLOURS)])
    return figure
