"""Pictures of a system before anything happens, and of the forces in a packing."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from jimpact.bodies.assembly import Bodies
from jimpact.bodies.base import Body, projected
from jimpact.core.scene import PairNormals, Scene, as_velocity
from jimpact.motion.pictures import draw_body
from jimpact.motion.system import System
from jimpact.plot.style import COLOURS, GREY, colour_of, new_figure, styled, write
from jimpact.tools.checks import check_kind, check_shape, check_values

_GAP = 0.5  # how wide an open contact is drawn, in radii of the largest body
_LEAST = 0.35  # radius of a small body, likewise
_ARROW = 2.2  # length of the fastest velocity, likewise
_THICKEST = 8.0  # line of the largest impulse [points]; ten times more hides the bodies
# impulses over the largest one that are not drawn; ten times more breaks chains
_FAINT = 1e-3


@styled()
def system(drawn: Scene | Body | System, state: Any, title: str = "") -> Figure:
    """A system as it is before an impact or a motion.

    A chain is a row of circles, their areas about as the masses, with arrows for the
    velocities; open contacts are drawn apart, not to scale. A body is drawn to scale,
    on what it stands on.

    Args:
        drawn: a chain (`ji.chain`), a body such as `ji.Block`, or a `System` of one.
        state: of a chain v- (n,) [m/s]; of a body its configuration q.
        title: above the picture.

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    Raises:
        TypeError: a scene that is not a chain. ValueError: not one velocity per body.

    >>> import jimpact as ji
    >>> len(ji.plot.system(ji.chain([1.0, 2.0]), [1.0, 0.0]).axes[0].patches)
    2
    """
    if isinstance(drawn, Scene):
        if drawn.walls is None:
            raise TypeError(
                "Argument `drawn` must be a chain, a body or a system; draw the body."
            )
        figure, axes = new_figure(2.4, title)
        _draw_chain(axes, drawn, np.asarray(as_velocity(drawn, state)))
    else:
        if isinstance(drawn, System):
            body = drawn.body
        else:
            body = drawn
        if body.names:
            check_shape(
                "state", state, (len(body.names),), "one per coordinate of the body"
            )
        check_values("state", state)
        figure, axes = new_figure(3.6, title)
        draw_body(axes, body, np.asarray(state, float))
        axes.set(xlabel="x [m]", ylabel="height [m]")
    return figure


@styled()
def force_chains(
    pile: Bodies, q: Any, scene: Scene, impulse: Any, title: str = ""
) -> Figure:
    """The impulses in a packing, lines between the centres as thick as they are large.

    Spheres are seen in projection; large impulses cover small ones.

    Args:
        pile: its bodies.
        q: where they are (n,), as for `pile.closed_scene(q)`.
        scene: `pile.closed_scene(q)`, or the scene of `TimeStepping.contacts`.
        impulse: p (m,) [N s] of an impact on this scene, or of a step.
        title: above the picture.

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    Raises:
        TypeError: another body, or a scene that `closed_scene` did not make.
            ValueError: not one impulse per contact.

    >>> import jimpact as ji
    >>> balls = ji.Bodies([ji.Sphere(0.1)] * 2, (), room=8)
    >>> q = balls.at([[0.0, 0.0, 0.1], [0.0, 0.0, 0.3]])
    >>> figure = ji.plot.force_chains(balls, q, balls.closed_scene(q), [1.0])
    >>> len(figure.axes[0].collections)
    1
    """
    if not (isinstance(pile, Bodies) and pile.room):
        raise TypeError(
            f"Argument `pile` must be `Bodies` with `room` (many), but is {pile!r}."
        )
    check_kind("scene", scene, Scene)
    if scene.pairs is None or scene.size != pile.mass.shape[0]:
        raise TypeError("Argument `scene` must be `pile.closed_scene(q)`.")
    p = np.asarray(impulse, float)
    check_shape("impulse", p, (scene.contacts,), "one per contact")
    d = pile.dimension
    coordinates = np.asarray(q, float).reshape(pile.count, -1)
    centres = coordinates[:, :d]
    # bodies of each contact; second < 0: a wall
    first, second = scene.pairs.neighbours.bodies.T
    on_wall = (second < 0)[:, None]
    at_walls = _points_on_walls(pile, scene.pairs, centres)
    ends = np.where(on_wall, at_walls, centres[second])
    largest = np.abs(p).max() or 1.0
    size = np.abs(p) / largest
    drawn = np.flatnonzero(size > _FAINT)
    drawn = drawn[np.argsort(size[drawn])]
    figure, axes = new_figure(5.0, title)
    for outline in pile.outlines(np.asarray(q, float), 0.0):
        axes.plot(*outline.T, color=GREY, lw=0.4, alpha=0.5)
    every_line = np.stack([centres[first], ends], axis=1)
    lines = every_line[drawn]
    if d != 2:
        lines = projected(lines)
    widths = _THICKEST * size[drawn]
    chains = LineCollection(
        list(lines), linewidths=widths, colors=COLOURS[0], alpha=0.8
    )
    axes.add_collection(chains)
    axes.autoscale_view()
    axes.set(xlabel="x [m]", ylabel="height [m]", aspect="equal")
    return figure


def _points_on_walls(
    pile: Bodies, pairs: PairNormals, centres: np.ndarray
) -> np.ndarray:
    """Points (m, d) [m] at which bodies at `centres` touch walls, if their contact is
    with a wall.

    Equation: `x = c - (n^T c - offset) n`, the foot of the centre c on the wall that
    its normal n is nearest to; in the plane moved along the wall by the lever, the part
    of the normal that turns the body.
    """
    d = pile.dimension
    walls = np.asarray(pile.planes)
    first = pairs.neighbours.bodies[:, 0]
    normal = np.asarray(pairs.directions)[:, 0]
    n = normal[:, :d]
    if not len(walls):
        return centres[first]
    wall = np.argmax(n @ walls[:, :d].T, axis=1)
    offset = walls[wall, d]
    height = np.sum(centres[first] * n, axis=1) - offset
    on_wall = centres[first] - height[:, None] * n
    if d == 2:
        on_wall += normal[:, 2:] * np.stack([n[:, 1], -n[:, 0]], axis=1)
    return on_wall


def _draw_chain(axes: Axes, scene: Scene, velocity: np.ndarray) -> None:
    """Draw a chain as a row of circles with their masses [kg], and arrows for
    velocities [m/s].

    Lengths are in radii of the largest body, `radius = sqrt(m / max m)`.
    """
    mass = np.asarray(scene.mass, float)
    radius = np.maximum((mass / mass.max()) ** 0.5, _LEAST)
    left, right = scene.walls or (False, False)
    # of each contact, walls included
    apart = np.where(np.asarray(scene.closed), 0.0, _GAP)
    # the gap to the left of each body
    inner = apart[left : len(mass) - 1 + left]
    before = np.concatenate([apart[:1] if left else [0.0], inner])
    neighbours = radius[:-1] + radius[1:]
    step = np.concatenate([radius[:1], neighbours])
    centre = np.cumsum(before + step)
    end = centre[-1] + radius[-1]
    fastest = np.abs(velocity).max() or 1.0
    circles = zip(centre, radius, velocity, strict=True)
    for i, (x, r, v) in enumerate(circles):
        colour = colour_of(i)
        circle = Circle((x, 0.0), r, fc=colour, alpha=0.35, ec=colour)
        axes.add_patch(circle)
        write(axes, (x, 0.0), f"{i + 1}", fontsize="medium")
        write(axes, (x, -1.35), f"{mass[i]:.3g} kg")
        write(axes, (x, 1.75), f"{v:.3g} m/s")
        if v:
            tip = x + _ARROW * v / fastest / 2
            arrow = {"arrowstyle": "-|>", "color": colour, "lw": 2}
            tail = (2 * x - tip, 1.3)
            axes.annotate("", (tip, 1.3), tail, arrowprops=arrow)
    for wall, x in ((left, -0.3), (right, end + (apart[-1] if right else 0.0))):
        if wall:
            block = Rectangle((x, -1.1), 0.3, 2.2, color=GREY, alpha=0.5, lw=0)
            axes.add_patch(block)
    margin = max(1.2, (12.0 - end) / 2)  # a single body is not as wide as the picture
    width = (-margin, end + margin)
    axes.set(xlim=width, ylim=(-1.7, 2.1), aspect="equal")
    axes.axis("off")
