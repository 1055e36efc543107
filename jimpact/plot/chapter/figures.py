"""The figures of the source chapter by number: `ji.plot.chapter_figure`, `jimpact figure`."""

from collections.abc import Callable
from typing import NamedTuple

from matplotlib.figure import Figure

from jimpact._checks import check_choice
from jimpact.plot.chapter import forces, outcomes, systems
from jimpact.plot.style import heading


class _Drawn(NamedTuple):
    """What a figure shows, and the function that draws it."""

    caption: str
    draw: Callable[[], Figure]


_FIGURES = {
    "5.5": _Drawn("outcomes of the 3-ball chain: which part each law can reach", outcomes.reached),
    "6.1": _Drawn("a column of beads falls on the ground", systems.column),
    "6.2": _Drawn("force at the wall under columns of beads", forces.wall_forces),
    "6.3a": _Drawn("outcomes of two balls: a line and a circle meet once", outcomes.two_balls),
    "6.3b": _Drawn("outcomes of three balls: the arc AB of the sphere", outcomes.sphere),
    "6.4": _Drawn("the 3-ball system", systems.three_balls),
    "6.5": _Drawn("three balls with unilateral elastic contacts", systems.springs),
    "6.6": _Drawn("force and indentation of a contact compressed twice", forces.contact_loop),
    "6.7a": _Drawn("the rocking block", systems.block),
    "6.7b": _Drawn("admissible domain of the rocking block", outcomes.block_domain),
    "6.8a": _Drawn("the bouncing dimer", systems.dimer),
    "6.8b": _Drawn("critical kinetic angle of the rocking block", outcomes.critical_angle),
    "6.9": _Drawn("C_KE against k2/k1: Moreau, binary collisions, LZB", outcomes.dispersion),
}

CAPTIONS = {number: row.caption for number, row in _FIGURES.items()}


def chapter_figure(number: str) -> Figure:
    """A figure of chapter 6 of Brogliato's Nonsmooth Mechanics (or 5.5), computed anew.

    Args:
        number: '5.5', '6.1', '6.2', '6.3a', '6.3b', '6.4', '6.5', '6.6', '6.7a', '6.7b', '6.8a',
            '6.8b' or '6.9'; `jimpact figure` lists what they show.

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    Raises:
        ValueError: another number.

    Source: Brogliato, Nonsmooth Mechanics (3rd ed., 2016), chapter 6.

    >>> import jimpact as ji
    >>> ji.plot.chapter_figure("6.4").get_suptitle()
    'Figure 6.4: the 3-ball system'
    """
    check_choice("number", number, CAPTIONS)
    figure = _FIGURES[number].draw()
    heading(figure, f"Figure {number}: {CAPTIONS[number]}")
    return figure
