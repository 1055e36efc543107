"""The systems of the source chapter as it draws them: letters and lengths are those of its text."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from jimpact.bodies.base import Body
from jimpact.bodies.blocks import Block
from jimpact.bodies.dimers import Dimer
from jimpact.plot.motions import draw_body
from jimpact.plot.style import COLOURS, GREY, ON_LINES, new_figure, write
from jimpact.plot.systems import system
from jimpact.scene import chain

_BEADS = 4  # of the column that is drawn
_COILS = 7  # of a spring that is drawn
_TURNED = 0.2  # of the block that is drawn [rad]


def three_balls() -> Figure:
    """Figure 6.4: ball 1 strikes balls 2 and 3, which touch."""
    return system(chain([1.0, 1.0, 1.0]), [1.0, 0.0, 0.0])


def column() -> Figure:
    """Figure 6.1: touching beads fall from the height h."""
    figure = new_figure(4.4)
    axes = figure.subplots()
    height = 1.6
    for i in range(_BEADS):
        y = height + 1 + 2 * (_BEADS - 1 - i)
        axes.add_patch(Circle((0, y), 1.0, fc=COLOURS[i], alpha=0.35, ec=COLOURS[i]))
        axes.text(0, y, f"$B_{i + 1}$", ha="center", va="center")
    axes.add_patch(Rectangle((-6, -0.4), 12, 0.4, color=GREY, alpha=0.5, lw=0))
    _distance(axes, (1.6, 0), (1.6, height), "h")
    _arrow(axes, (-2.2, 2 * _BEADS), (-2.2, 2 * _BEADS - 2), "g")
    axes.text(-0.3, height / 2, "contact N", va="center", ha="right")
    _only(axes, (-6, 6), (-0.6, height + 2 * _BEADS + 0.4))
    return figure


def springs() -> Figure:
    """Figure 6.5: the balls as masses between springs that push only."""
    figure = new_figure(2.6)
    axes = figure.subplots()
    for i in range(3):
        axes.add_patch(Circle((4 * i, 0), 0.8, fc=COLOURS[i], alpha=0.35, ec=COLOURS[i]))
        axes.text(4 * i, 0, f"$m_{i + 1}$", ha="center", va="center")
        _arrow(axes, (4 * i - 0.6, 1.3), (4 * i + 0.6, 1.3), "")
        axes.text(4 * i, 1.6, f"$x_{i + 1}$", ha="center", va="bottom")
    for i in range(2):
        start, end = 4 * i + 0.8, 4 * i + 3.0
        x = np.concatenate([[start], np.linspace(start + 0.3, end - 0.3, 2 * _COILS), [end]])
        y = np.concatenate([[0], 0.3 * (-1.0) ** np.arange(2 * _COILS), [0]])
        axes.plot(x, y, color="black", lw=1.2)
        axes.plot([end, end], [-0.5, 0.5], color="black", lw=3)  # a plate, which the ball may leave
        axes.text((start + end) / 2, -1.0, f"$k_{i + 1}$", ha="center", va="center")
    _only(axes, (-1.5, 9.5), (-1.4, 2.3))
    return figure


def block() -> Figure:
    """Figure 6.7a: width L, height l, corners A (contact 2) and B (contact 1)."""
    figure = new_figure(4.6)
    axes = figure.subplots()
    body = Block(width=1.0, height=1.6)
    q = np.asarray(body.touching(_TURNED))
    _drawn(axes, body, q)
    along, up = np.array([np.cos(q[2]), np.sin(q[2])]), np.array([-np.sin(q[2]), np.cos(q[2])])
    corners = [q[:2] - 0.8 * up + s * 0.5 * along for s in (-1, 1)]
    for name, at, side in zip("AB", corners, (-2, 1), strict=True):
        write(axes, at + np.array([0.1 * side, 0.08]), name, fontweight="bold", fontsize="medium")
    axes.plot(*q[:2], "o", color="black", ms=4)
    axes.text(q[0] + 0.06, q[1] + 0.04, "G")
    top = q[:2] + 0.8 * up
    _distance(axes, top + 0.1 * up - 0.5 * along, top + 0.1 * up + 0.5 * along, "L")
    left = q[:2] - 0.58 * along
    _distance(axes, left - 0.8 * up, left + 0.8 * up, "l")
    axes.set_ylim(-0.1, 2.0)
    foot, part = corners[0], np.linspace(0, q[2], 30)
    axes.plot(foot[0] + 0.75 * np.cos(part), foot[1] + 0.75 * np.sin(part), color="black", lw=1)
    axes.text(foot[0] + 0.82, foot[1] + 0.05, r"$\theta$")
    return figure


def dimer() -> Figure:
    """Figure 6.8a: two spheres of radius R on a rod of length L."""
    figure = new_figure(3.6)
    axes = figure.subplots()
    body = Dimer(radius=0.25, length=1.0)
    q = np.asarray(body.touching(0.25)) + np.array([0, 0.15, 0])
    _drawn(axes, body, q)
    along, up = np.array([np.cos(q[2]), np.sin(q[2])]), np.array([-np.sin(q[2]), np.cos(q[2])])
    _distance(axes, q[:2] - 0.5 * along + 0.1 * up, q[:2] + 0.5 * along + 0.1 * up, "L")
    centre = q[:2] + 0.75 * along
    _arrow(axes, centre, centre + 0.25 * up, "")
    write(axes, centre + 0.08 * along + 0.12 * up, "R", style="italic", fontsize="medium")
    for name, at in (("2", q[:2] - 0.75 * along), ("1", centre)):
        axes.text(at[0], 0.03, f"$f_{name}$", ha="center")
    axes.set_ylim(-0.15, 1.15)
    return figure


def _drawn(axes: Axes, body: Body, q: Any) -> None:
    """A body above its ground, without axes."""
    draw_body(axes, body, np.asarray(jnp.asarray(q)))
    axes.axis("off")


def _distance(axes: Axes, start: Any, end: Any, name: str) -> None:
    """A length between two arrows, named at its middle."""
    axes.annotate("", end, start, arrowprops={"arrowstyle": "<|-|>", "color": "black", "lw": 1})
    middle = (np.asarray(start) + np.asarray(end)) / 2
    write(axes, middle, name, fontsize="medium", style="italic", bbox=ON_LINES)


def _arrow(axes: Axes, start: Any, end: Any, name: str) -> None:
    """An arrow with a name at its tail."""
    axes.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "color": "black", "lw": 1.2})
    if name:
        write(axes, start, f"{name}  ", ha="right", fontsize="medium", style="italic")


def _only(axes: Axes, x: tuple[float, float], y: tuple[float, float]) -> None:
    """A drawing without axes, to scale."""
    axes.set_xlim(x)
    axes.set_ylim(y)
    axes.set_aspect("equal")
    axes.axis("off")
