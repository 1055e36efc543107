"""A motion as an animated GIF."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jimpact.bodies.pendulums import PendulumCradle
from jimpact.motion.dynamics import seen_from_base
from jimpact.motion.record import Motion
from jimpact.motion.system import System
from jimpact.plot.fits import COLOURS
from jimpact.plot.motions import one_motion

# q (n,) -> curves (k, 2) of points (x, y) in metres
Outlines = Callable[[np.ndarray], Sequence[np.ndarray]]

_GREY = "#777777"
_POINT = 0.02  # radius in which a point mass is drawn, of the range of its coordinates


def animate_motion(
    system: System,
    motion: Motion,
    path: str | Path,
    outlines: Outlines | None = None,
    frames_per_second: float = 25.0,
    title: str = "",
) -> Path:
    """The motion as an animated GIF, one frame a sample (those that were reached).

    Args:
        system: that moved.
        motion: one motion.
        path: the file, ending in .gif.
        outlines: q (n,) -> curves (k, 2) [m]; None: those of the body.
        frames_per_second: of the GIF.
        title: of the picture; the time stands below it.

    Raises:
        ValueError: another ending, a batch; TypeError: a body without outlines.

    >>> import jimpact as ji
    >>> ball = ji.ball_system()
    >>> motion = ji.simulate(ball, ji.Newton(0.5), [1.0], [0.0], 1.0, samples=21)
    >>> ji.animate_motion(ball, motion, "ball.gif").name
    'ball.gif'
    """
    one_motion(motion)
    path = Path(path)
    if path.suffix != ".gif":
        raise ValueError(f"Argument `path` must end in .gif, but is '{path}'.")
    q = np.asarray(motion.q)
    reached = np.isfinite(q).all(axis=1)
    q, time = q[reached], np.asarray(motion.time)[reached]
    point = _POINT * (np.nanmax(q) - np.nanmin(q) or 1.0)
    curves = [system.body.outlines(x, point) if outlines is None else outlines(x) for x in q]
    ground = _grounds(system, q, time)
    figure = Figure(figsize=(4.8, 4.8), layout="constrained", dpi=80)
    axes = figure.subplots()
    _limits(axes, curves, ground)
    lines = [
        axes.plot([], [], color=COLOURS[i // 2 % len(COLOURS)])[0] for i in range(len(curves[0]))
    ]
    floor = axes.plot([], [], color=_GREY, lw=2)[0]

    def draw(k: int) -> list[Any]:
        for line, points in zip(lines, curves[k], strict=True):
            line.set_data(points[:, 0], points[:, 1])
        if ground is not None:
            x, y = ground[k]
            low, high = axes.get_xlim()
            floor.set_data([low + x, high + x], [y, y])
        axes.set_title(f"{title}\n{time[k]:.2f} s" if title else f"{time[k]:.2f} s", loc="left")
        return [*lines, floor]

    path.parent.mkdir(parents=True, exist_ok=True)
    shown = FuncAnimation(figure, draw, frames=len(q))
    shown.save(path, writer=PillowWriter(fps=round(frames_per_second)))
    return path


def _grounds(system: System, q: np.ndarray, time: np.ndarray) -> np.ndarray | None:
    """Where the base is (S, 2); None for a system that hangs."""
    if isinstance(system.body, PendulumCradle):
        return None
    moved = q - np.asarray(
        jax.vmap(lambda x, t: seen_from_base(system, x, t))(jnp.asarray(q), jnp.asarray(time))
    )
    return moved[:, :2] if moved.shape[1] == 3 else np.stack([0 * moved[:, 0], moved[:, 0]], axis=1)


def _limits(axes: Axes, curves: list[Any], ground: np.ndarray | None) -> None:
    every = np.concatenate([points for frame in curves for points in frame])
    if ground is not None:
        every = np.concatenate([every, np.stack([every[:1, 0], ground[:1, 1]], axis=1)])
    low, high = every.min(axis=0), every.max(axis=0)
    half = 0.55 * float((high - low).max()) or 1.0
    centre = (low + high) / 2
    axes.set_xlim(centre[0] - half, centre[0] + half)
    axes.set_ylim(centre[1] - half, centre[1] + half)
    axes.set_aspect("equal")
    axes.spines[["top", "right"]].set_visible(False)
