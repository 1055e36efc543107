"""Pictures of motions: coordinates over time, phase portraits, animations."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jimpact.motion.record import Motion
from jimpact.motion.system import System
from jimpact.plot.style import COLOURS, GREY

# q (n,) -> curves (k, 2) of points (x, y) in metres
Outlines = Callable[[np.ndarray], Sequence[np.ndarray]]
_POINT = 0.02  # radius in which a point mass is drawn, of the range of its coordinates
_MARKED = ("accumulation", "detachment", "friction")  # events with a mark of their own
_MANY = 60  # impacts up to which each gets its line
_LEGEND = 6  # coordinates that get an entry in the legend


def one_motion(motion: Motion) -> None:
    """Raise a ValueError for a batch."""
    if np.ndim(motion.status):
        raise ValueError("Argument `motion` must be one motion, but is a batch: pick one of it.")


def motion(motion: Motion, title: str = "", names: Sequence[str] = ()) -> Figure:
    """Coordinates and velocities against time, events, and where the energy goes.

    Args:
        motion: one motion (of a batch: `jax.tree.map(lambda x: x[i], motion)`).
        title: of the picture.
        names: of the coordinates; default q1, q2, ...

    >>> import jimpact as ji
    >>> motion = ji.simulate(ji.ball_system(), ji.Newton(0.5), [1.0], [0.0], 1.0, samples=21)
    >>> len(ji.plot.motion(motion).axes)
    3
    """
    one_motion(motion)
    figure = Figure(figsize=(7.5, 7.5), layout="constrained")
    top, middle, bottom = figure.subplots(3, 1, sharex=True)
    time, q, v = (np.asarray(x) for x in (motion.time, motion.q, motion.velocity))
    for i in range(q.shape[1]):
        colour = COLOURS[i % len(COLOURS)]
        label = names[i] if i < len(names) else f"q{i + 1}"
        top.plot(time, q[:, i], color=colour, label=label if i < _LEGEND else None)
    for i in range(v.shape[1]):
        middle.plot(time, v[:, i], color=COLOURS[i % len(COLOURS)])
    top.set_ylabel("coordinates [m, rad]")
    middle.set_ylabel("velocities [m/s, rad/s]")
    for axes in (top, middle):
        _event_lines(axes, motion)
    _ledger(bottom, motion)
    bottom.set_xlabel("time [s]")
    top.set_title(title, loc="left")
    for axes in (top, middle, bottom):
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="y", lw=0.4, alpha=0.5)
    top.legend(frameon=False, fontsize="small", ncols=3, loc="best")
    bottom.legend(frameon=False, fontsize="small", ncols=2, loc="best")
    return figure


def _event_lines(axes: Axes, motion: Motion) -> None:
    impacts = motion.event_times("impact")
    if len(impacts) <= _MANY:
        for t in impacts:
            axes.axvline(t, color=GREY, lw=0.4, zorder=0)
    for kind, style in zip(_MARKED, ("--", ":", "-."), strict=True):
        for t in motion.event_times(kind)[:_MANY]:
            axes.axvline(t, color="black", lw=0.8, ls=style, zorder=0)


def _ledger(axes: Axes, motion: Motion) -> None:
    """Energy, and what has gone where since the start."""
    time, energy = np.asarray(motion.time), np.asarray(motion.energy)
    axes.plot(time, energy, color="black", label="T + V")
    axes.plot(time, motion.kinetic_energy, color=GREY, lw=0.8, label="T")
    work = np.asarray(motion.contact_work)
    # the shares of single contacts in a multiple impact may have either sign: their sum is shown
    axes.plot(time, -work[:, 0].sum(axis=1), color=COLOURS[0], label="taken by impacts")
    if np.nanmax(np.abs(work[:, 1]), initial=0.0) > 0:
        axes.plot(time, -work[:, 1].sum(axis=1), color=COLOURS[1], label="taken by friction")
    for name, value in (("base", motion.base_work), ("forces", motion.force_work)):
        if np.nanmax(np.abs(np.asarray(value)), initial=0.0) > 0:
            axes.plot(time, value, "--", color=COLOURS[2], label=f"work of the {name}")
    axes.set_ylabel("energy [J]")


def phase_portrait(motion: Motion, coordinate: int = 0, title: str = "") -> Figure:
    """Velocity against one coordinate; impacts are the dashed jumps.

    Args:
        motion: one motion.
        coordinate: which, counted from 0.
        title: of the picture.

    >>> import jimpact as ji
    >>> motion = ji.simulate(ji.ball_system(), ji.Newton(0.5), [1.0], [0.0], 1.0, samples=21)
    >>> len(ji.plot.phase_portrait(motion).axes)
    1
    """
    one_motion(motion)
    n = motion.q.shape[-1]
    n = n if n == motion.velocity.shape[-1] else 3  # in space: of the position only
    if not 0 <= coordinate < n:
        raise ValueError(f"Argument `coordinate` must lie in [0, {n - 1}], but is {coordinate}.")
    figure = Figure(figsize=(6.0, 5.0), layout="constrained")
    axes = figure.subplots()
    rows = np.asarray(motion.events.kind) > 0
    jumps = [
        np.asarray(x)[rows, coordinate]
        for x in (motion.events.q, motion.events.velocity_before, motion.events.velocity_after)
    ]
    # the curve passes through the states before and after every event
    time = np.concatenate([motion.time, *(2 * [np.asarray(motion.events.time)[rows]])])
    position = np.concatenate([motion.q[:, coordinate], jumps[0], jumps[0]])
    speed = np.concatenate([motion.velocity[:, coordinate], jumps[1], jumps[2]])
    event = np.concatenate(
        [np.zeros(len(motion.time)), np.ones(rows.sum()), np.full(rows.sum(), 2)]
    )
    order = np.lexsort((event, time))
    position, speed, event = position[order], speed[order], event[order]
    cut = np.flatnonzero(event == 2)
    axes.plot(np.insert(position, cut, np.nan), np.insert(speed, cut, np.nan), color=COLOURS[0])
    axes.plot(
        np.stack([jumps[0]] * 2), np.stack(jumps[1:]), "--", color=COLOURS[1], lw=0.8, zorder=0
    )
    axes.set_xlabel(f"q{coordinate + 1} [m, rad]")
    axes.set_ylabel(f"velocity of q{coordinate + 1} [m/s, rad/s]")
    axes.set_title(title, loc="left")
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(lw=0.4, alpha=0.5)
    return figure


def animation(
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
    >>> ji.plot.animation(ball, motion, "ball.gif").name
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
    ground = _grounds(system, time)
    figure = Figure(figsize=(4.8, 4.8), layout="constrained", dpi=80)
    axes = figure.subplots()
    _limits(axes, curves, ground, bool(system.body.floors))
    lines = [
        axes.plot([], [], color=COLOURS[i // 2 % len(COLOURS)])[0] for i in range(len(curves[0]))
    ]
    floors = [axes.plot([], [], color=GREY, lw=2)[0] for _ in system.body.floors]
    view = np.array([axes.get_xlim(), axes.get_ylim()])

    def draw(k: int) -> list[Any]:
        for line, points in zip(lines, curves[k], strict=True):
            line.set_data(points[:, 0], points[:, 1])
        for floor, (angle, offset) in zip(floors, system.body.floors, strict=True):
            n, along = np.array([[-np.sin(angle), np.cos(angle)], [np.cos(angle), np.sin(angle)]])
            middle, half = view.mean(axis=1), 0.5 * np.ptp(view[0])
            middle = (n @ ground[k] + offset) * n + along @ (middle + ground[k]) * along
            floor.set_data(*(middle[:, None] + half * np.array([-1, 1]) * along[:, None]))
        axes.set_title(f"{title}\n{time[k]:.2f} s" if title else f"{time[k]:.2f} s", loc="left")
        return [*lines, *floors]

    path.parent.mkdir(parents=True, exist_ok=True)
    shown = FuncAnimation(figure, draw, frames=len(q))
    shown.save(path, writer=PillowWriter(fps=round(frames_per_second)))
    return path


def _grounds(system: System, time: np.ndarray) -> np.ndarray:
    """Where the base is (S, 2)."""
    base = system.base
    if base is None:
        return np.zeros((len(time), 2))
    moved = np.asarray(jax.vmap(lambda t: jnp.atleast_1d(base(t)))(jnp.asarray(time)))
    return np.insert(moved, 0, 0.0, axis=1) if moved.shape[1] == 1 else moved[:, :2]


def _limits(axes: Axes, curves: list[Any], ground: np.ndarray, floors: bool) -> None:
    every = np.concatenate([points for frame in curves for points in frame])
    if floors:
        every = np.concatenate([every, np.stack([every[:1, 0], ground[:1, 1]], axis=1)])
    low, high = every.min(axis=0), every.max(axis=0)
    half = 0.55 * float((high - low).max()) or 1.0
    centre = (low + high) / 2
    axes.set_xlim(centre[0] - half, centre[0] + half)
    axes.set_ylim(centre[1] - half, centre[1] + half)
    axes.set_aspect("equal")
    axes.spines[["top", "right"]].set_visible(False)
