"""Pictures of motions: coordinates over time, phase portraits, animations."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jimpact._checks import check_kind
from jimpact.bodies.base import Body, projected, rate_of, split_name
from jimpact.motion.dynamics import kinetic, potential, seen_from_base
from jimpact.motion.record import Motion
from jimpact.motion.system import System
from jimpact.plot.style import COLOURS, GREY, finish, heading, legend_within, new_figure
from jimpact.progress import counting_bar

_FRAMES_PER_SECOND = 25  # of animations
_POINT = 0.02  # radius in which a point mass is drawn, of the range of its coordinates
_MARKED = ("accumulation", "detachment", "friction")  # events with a line style of their kind
_MANY = 60  # up to this number of impacts each is marked by a line
_PLACE = (0.12, 0.08, 0.84, 0.8)  # of the axes in a film, for all frames
_BASE_POINTS = 1000  # at which a base is drawn
_LEGEND = 6  # coordinates that get an entry in the legend


def one_motion(motion: Motion) -> None:
    """Raise a ValueError for a batch, a TypeError for something else."""
    check_kind("motion", motion, Motion)
    if np.ndim(motion.status):
        raise ValueError("Argument `motion` must be one motion, but is a batch: pick one of it.")


def motion(
    motion: Motion, title: str = "", names: Sequence[str] = (), system: System | None = None
) -> Figure:
    """Coordinates, velocities and gaps against time, events, and where the energy goes.

    Each unit has axes of its own. Curves go through the states before and after every event, so
    that a jump stands upright at its time. Gaps far above all of contacts that closed are left out,
    and the potential energy counts from its least value.

    Args:
        motion: one motion (of a batch: `jax.tree.map(lambda x: x[i], motion)`).
        title: of the picture.
        names: of the coordinates, with their units as in "x [m]"; default: those of the body.
        system: that moved: its body names the coordinates, and its base is shown; without it and
            without names they are q1, q2, ...

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    Raises:
        ValueError: a batch of motions, or names of another number.

    >>> import jimpact as ji
    >>> ball = ji.ball_system()
    >>> motion = ji.simulate(ball, ji.Newton(0.5), [1.0], [0.0], 1.0, samples=21)
    >>> [axes.get_ylabel() for axes in ji.plot.motion(motion, system=ball).axes]
    ['height [m]', "height' [m/s]", 'gaps [m]', 'energy [J]']
    """
    one_motion(motion)
    labels, rates = _labels(motion, names, system)
    course = _course(motion)
    columns = [_by_unit(labels), _by_unit(rates)]
    rows = max(map(len, columns)) + 1
    figure = new_figure(2.5 * rows)
    panels = figure.subplots(rows, 2, sharex=True, squeeze=False)
    for j, (units, values) in enumerate(zip(columns, (course.q, course.v), strict=True)):
        for axes, (unit, which) in zip(panels[:, j], units.items(), strict=False):
            for c, (i, word) in enumerate(which):
                label = word if c < _LEGEND else None
                axes.plot(course.time, values[:, i], color=COLOURS[c % len(COLOURS)], label=label)
            if j == 0 and unit == "m" and system is not None:
                _moving_base(axes, system, motion)
            what = which[0][1] if len(which) == 1 else ("coordinates", "velocities")[j]
            axes.set_ylabel(f"{what} [{unit}]" if unit else what)
        for axes in panels[len(units) : -1, j]:
            axes.remove()
    _gaps(panels[-1, 0], motion)
    _ledger(panels[-1, 1], motion, course, system)
    heading(figure, title)
    for axes in figure.axes:
        if axes is not panels[-1, 1]:
            _event_lines(axes, motion)
        finish(axes, grid="y")
        if len(axes.get_legend_handles_labels()[0]) > 1:
            legend_within(axes, 2)
    for axes in panels[-1]:
        axes.set_xlabel("time [s]")
    return figure


def _labels(
    motion: Motion, names: Sequence[str], system: System | None
) -> tuple[list[str], list[str]]:
    """Names, with units, of coordinates and velocities."""
    n, rates = motion.q.shape[-1], motion.velocity.shape[-1]
    known = () if system is None else system.body.names
    labels = [*known, *(f"q{i + 1}" for i in range(len(known), n))]
    for i, name in enumerate(names[:n]):
        unit = split_name(labels[i])[1]
        labels[i] = f"{name} [{unit}]" if unit and not split_name(name)[1] else name
    if n == rates:
        return labels, [rate_of(name) for name in labels]
    velocities = () if system is None else system.body.velocity_names
    return labels, [*velocities] or [f"v{i + 1}" for i in range(rates)]


def _by_unit(names: list[str]) -> dict[str, list[tuple[int, str]]]:
    """Index and word of the names by their unit."""
    by_unit: dict[str, list[tuple[int, str]]] = {}
    for i, name in enumerate(names):
        word, unit = split_name(name)
        by_unit.setdefault(unit, []).append((i, word))
    return by_unit


class _Course(NamedTuple):
    """The samples, and the states before and after every event, in time."""

    time: np.ndarray  # (S,)
    q: np.ndarray  # (S, n)
    v: np.ndarray  # (S, n)
    after: np.ndarray  # (S,) whether it is the state after an event


def _course(motion: Motion) -> _Course:
    """The samples and events of a motion in the order of time."""
    events, rows = motion.events, np.asarray(motion.events.kind) > 0
    at, place = np.asarray(events.time)[rows], np.asarray(events.q)[rows]
    jumps = [np.asarray(x)[rows] for x in (events.velocity_before, events.velocity_after)]
    time = np.concatenate([motion.time, at, at])
    q = np.concatenate([motion.q, place, place])
    v = np.concatenate([motion.velocity, *jumps])
    state = np.repeat([0, 1, 2], [len(motion.time), rows.sum(), rows.sum()])
    # events at one time: before and after of the first, then of the second
    number = np.concatenate([np.full(len(motion.time), -1), *(2 * [np.arange(rows.sum())])])
    order = np.lexsort((state, number, time))
    return _Course(time[order], q[order], v[order], state[order] == 2)


def _base_path(system: System, time: np.ndarray) -> np.ndarray:
    """Displacement of the base (S, d) along the directions of the body, where it has them."""
    assert system.base is not None
    path = np.asarray(jax.vmap(lambda t: jnp.atleast_1d(system.base(t)))(jnp.asarray(time)))  # type: ignore[misc]
    directions = system.body.base_directions
    if directions is None:
        return path
    moved = path @ np.asarray(system.base_directions).T
    return np.linalg.lstsq(np.asarray(directions), moved.T, rcond=None)[0].T


def _moving_base(axes: Axes, system: System, motion: Motion) -> None:
    """Where the base is, along the directions in which it moves."""
    if system.base is None:
        return
    reached = np.asarray(motion.time)[np.isfinite(np.asarray(motion.energy))]
    if not len(reached):
        return
    time = np.linspace(reached[0], reached[-1], _BASE_POINTS)
    path = _base_path(system, time)
    words = ("",) if path.shape[1] == 1 else (" x", " y", " z")
    for values, word, style in zip(path.T, words, ("--", ":", "-."), strict=False):
        if np.ptp(values) > 0:
            axes.plot(time, values, style, color="black", lw=0.8, label=f"base{word}")


def _gaps(axes: Axes, motion: Motion) -> None:
    """Gaps, 0 at the events of their contacts; not those far above all of contacts that closed."""
    values, events = np.asarray(motion.gaps), motion.events
    single = events.contacts.shape[-1] == values.shape[1]
    closed = np.zeros((len(events.time), values.shape[1]), bool)
    if single:
        closed = (np.asarray(events.kind) > 0)[:, None] & np.asarray(events.contacts)
    ever = closed.any(axis=0)
    far = np.nanmax(values[:, ever], initial=-np.inf) if ever.any() else np.inf
    for j in np.flatnonzero(np.nanmin(values, axis=0, initial=np.inf) <= far):
        rows = closed[:, j]
        time = np.concatenate([motion.time, np.asarray(events.time)[rows]])
        order = np.argsort(time, kind="stable")
        gap = np.concatenate([values[:, j], np.zeros(rows.sum())])[order]
        label = f"contact {j + 1}" if j < _LEGEND else None
        axes.plot(time[order], gap, color=COLOURS[j % len(COLOURS)], label=label)
    axes.set_ylabel("gaps [m]" if single else "least gap [m]")


def _event_lines(axes: Axes, motion: Motion) -> None:
    """A line at each impact, and at events of the marked kinds."""
    impacts = motion.event_times("impact")
    if len(impacts) <= _MANY:
        for t in impacts:
            axes.axvline(t, color=GREY, lw=0.4, zorder=0)
    for kind, style in zip(_MARKED, ("--", ":", "-."), strict=True):
        for t in motion.event_times(kind)[:_MANY]:
            axes.axvline(t, color="black", lw=0.8, ls=style, zorder=0)


def _ledger(axes: Axes, motion: Motion, course: _Course, system: System | None) -> None:
    """Energy, and what has gone where since the start; of a known system with its jumps.

    V counts from its least value, so that losses can be seen.
    """
    time = np.asarray(motion.time)
    if system is None:
        drawn = time, motion.kinetic_energy, motion.energy
    else:
        q, v = jnp.asarray(course.q), jnp.asarray(course.v)
        moving = jax.vmap(partial(kinetic, system))(q, v)
        drawn = course.time, moving, moving + jax.vmap(partial(potential, system))(q)
    least = np.nanmin(drawn[2] - drawn[1], initial=np.inf)
    axes.plot(drawn[0], drawn[2] - least, color="black", label="T + V − min V")
    axes.plot(drawn[0], drawn[1], color=GREY, lw=0.8, label="T")
    # the sum: in a multiple impact the shares of single contacts may have either sign
    normal, tangential = np.asarray(motion.contact_work).sum(axis=-1).T
    axes.plot(time, -normal, color=COLOURS[0], label="contacts took")
    others = (
        ("friction took", -tangential),
        ("the base gave", motion.base_work),
        ("forces gave", motion.force_work),
    )
    for (label, value), colour in zip(others, COLOURS[1:], strict=False):
        if np.nanmax(np.abs(np.asarray(value)), initial=0.0) > 0:
            axes.plot(time, value, "--", color=colour, label=label)
    axes.set_ylabel("energy [J]")


def phase_portrait(
    motion: Motion,
    coordinate: int | None = None,
    title: str = "",
    names: Sequence[str] = (),
    system: System | None = None,
) -> Figure:
    """Velocity against one coordinate; impacts are the dashed jumps.

    Args:
        motion: one motion.
        coordinate: which, counted from 0; None: the one with the largest range times range of
            its velocity, in SI units.
        title: of the picture.
        names: of the coordinates, as in `motion`.
        system: that moved, as in `motion`; needed where velocities are not the rates of q.

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    Raises:
        ValueError: a batch, no such coordinate, velocities that are not rates of q.

    >>> import jimpact as ji
    >>> dimer = ji.dimer_system(0.1, 1.0)
    >>> motion = ji.simulate(dimer, ji.Newton(0.5), [0.0, 0.3, 0.1], [0.0] * 3, 0.3, samples=21)
    >>> ji.plot.phase_portrait(motion, system=dimer).axes[0].get_xlabel()
    'angle [rad]'
    """
    one_motion(motion)
    labels, rates = _labels(motion, names, system)
    course = _course(motion)
    # coordinate -> its velocity
    pairs = {i: i for i in range(len(labels))}
    if len(labels) != len(rates):
        pairs = {i: rates.index(x) for i, x in enumerate(map(rate_of, labels)) if x in rates}
    if not pairs:
        raise ValueError("Argument `system` must be given where velocities are not rates of q.")
    if coordinate is None:
        size = {i: _range(course.q[:, i]) * _range(course.v[:, j]) for i, j in pairs.items()}
        coordinate = max(size, key=lambda i: size[i])
    if coordinate not in pairs:
        raise ValueError(
            f"Argument `coordinate` must lie in [{min(pairs)}, {max(pairs)}], but is {coordinate}."
        )
    rate = pairs[coordinate]
    figure = new_figure(5.0)
    axes = figure.subplots()
    position, speed = course.q[:, coordinate], course.v[:, rate]
    cut = np.flatnonzero(course.after)
    axes.plot(np.insert(position, cut, np.nan), np.insert(speed, cut, np.nan), color=COLOURS[0])
    jumps = np.stack([cut - 1, cut])
    axes.plot(position[jumps], speed[jumps], "--", color=COLOURS[1], lw=0.8, zorder=0)
    axes.set_xlabel(labels[coordinate])
    axes.set_ylabel(rates[rate])
    heading(figure, title)
    finish(axes)
    return figure


def _range(values: np.ndarray) -> float:
    """Range of the finite values, 0 without any."""
    finite = values[np.isfinite(values)]
    return float(np.ptp(finite)) if len(finite) else 0.0


def animation(
    system: System,
    motion: Motion,
    path: str | Path,
    title: str = "",
    progress: float | None = None,
) -> Path:
    """The motion as an animated GIF, one frame a sample (those that were reached).

    Bodies in space are shown in parallel projection, with their shadows. What moves with the base
    moves in the picture.

    Args:
        system: that moved.
        motion: one motion.
        path: the file, ending in .gif.
        title: of the picture; the time stands below it.
        progress: a bar on stderr; None: on a terminal, where it takes long.

    Returns:
        The path of the file that was written.

    Raises:
        ValueError: another ending, a batch, no sample; TypeError: a body without outlines.

    >>> import tempfile, pathlib, jimpact as ji
    >>> ball = ji.ball_system()
    >>> motion = ji.simulate(ball, ji.Newton(0.5), [1.0], [0.0], 1.0, samples=21)
    >>> place = pathlib.Path(tempfile.mkdtemp())
    >>> ji.plot.animation(ball, motion, place / "ball.gif").name
    'ball.gif'
    """
    one_motion(motion)
    path = Path(path)
    if path.suffix != ".gif":
        raise ValueError(f"Argument `path` must end in .gif, but is '{path}'.")
    q = np.asarray(motion.q)
    reached = np.isfinite(q).all(axis=1)
    q, time = q[reached], np.asarray(motion.time)[reached]
    if not len(q):
        raise ValueError("Argument `motion` must have a sample that was reached, but has none.")
    ground = _grounds(system, time)
    curves = _curves(system, q, time, ground)
    figure = Figure(figsize=(4.8, 4.8), dpi=80)
    axes = figure.add_axes(_PLACE)
    floors = [_plane(angle, offset) for angle, offset in system.body.floors]
    _limits(axes, curves, ground, floors)
    lines = [
        axes.plot([], [], color=COLOURS[i // 2 % len(COLOURS)])[0] for i in range(len(curves[0]))
    ]
    drawn = [axes.plot([], [], color=GREY, lw=2)[0] for _ in floors]
    view = np.array([axes.get_xlim(), axes.get_ylim()])

    def draw(k: int) -> list[Any]:
        """Frame k."""
        for line, points in zip(lines, curves[k], strict=True):
            line.set_data(points[:, 0], points[:, 1])
        for line, (n, offset) in zip(drawn, floors, strict=True):
            line.set_data(*_stretch(n, offset, view, ground[k]))
        axes.set_title(f"{title}\n{time[k]:.2f} s" if title else f"{time[k]:.2f} s", loc="left")
        return [*lines, *drawn]

    path.parent.mkdir(parents=True, exist_ok=True)
    film = FuncAnimation(figure, draw, frames=len(q))
    with counting_bar(len(q), "frames", progress) as advance:
        writer = PillowWriter(fps=_FRAMES_PER_SECOND)
        film.save(path, writer=writer, progress_callback=lambda i, n: advance(1))
    return path


def draw_body(axes: Axes, body: Body, q: np.ndarray) -> None:
    """A body at q, with what it stands on."""
    curves = [body.outlines(q, _POINT * (np.ptp(q) or 1.0))]
    floors, ground = [_plane(*floor) for floor in body.floors], np.zeros((1, 2))
    _limits(axes, curves, ground, floors)
    for i, points in enumerate(curves[0]):
        axes.plot(*points.T, color=COLOURS[i // 2 % len(COLOURS)])
    view = np.array([axes.get_xlim(), axes.get_ylim()])
    for n, offset in floors:
        axes.plot(*_stretch(n, offset, view, ground[0]), color=GREY, lw=2)
    axes.set_xlim(view[0])
    axes.set_ylim(view[1])


def _stretch(n: np.ndarray, offset: float, view: np.ndarray, ground: np.ndarray) -> np.ndarray:
    """A piece (2, 2) of a plane that reaches across the view."""
    middle, reach = view.mean(axis=1), np.ptp(view[0])
    foot = middle - (n @ (middle - ground) - offset) * n
    return foot[:, None] + reach * np.array([-1, 1]) * np.array([n[1], -n[0]])[:, None]


def _curves(
    system: System, q: np.ndarray, time: np.ndarray, ground: np.ndarray
) -> list[list[np.ndarray]]:
    """Outlines of the body, of every sample, where they are in space."""
    point = _POINT * (np.ptp(q) or 1.0)
    if system.base is not None:
        q = np.asarray(jax.vmap(partial(seen_from_base, system))(jnp.asarray(q), jnp.asarray(time)))
    return [
        [curve + moved for curve in system.body.outlines(x, point)]
        for x, moved in zip(q, ground, strict=True)
    ]


def _grounds(system: System, time: np.ndarray) -> np.ndarray:
    """Displacement of the base in the picture (S, 2)."""
    if system.base is None:
        return np.zeros((len(time), 2))
    path = _base_path(system, time)
    if path.shape[1] == 3:
        return projected(path)
    return np.insert(path, 0, 0.0, axis=1) if path.shape[1] == 1 else path


def _plane(angle: Any, offset: Any) -> tuple[np.ndarray, float]:
    """Normal (2,) and offset of a plane."""
    return np.array([-np.sin(angle), np.cos(angle)]), float(offset)


def _limits(axes: Axes, curves: list[Any], ground: np.ndarray, floors: list[Any]) -> None:
    """Equal limits that hold all curves and a point of each plane."""
    points = np.concatenate([curve for frame in curves for curve in frame])
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    feet = [middle - (n @ (middle - ground[0]) - offset) * n for n, offset in floors]
    points = np.concatenate([points, *(foot[None] for foot in feet)])
    low, high = points.min(axis=0), points.max(axis=0)
    half = 0.55 * float((high - low).max()) or 1.0
    centre = (low + high) / 2
    axes.set_xlim(centre[0] - half, centre[0] + half)
    axes.set_ylim(centre[1] - half, centre[1] + half)
    axes.set_aspect("equal")
    axes.locator_params(nbins=5)
    axes.spines[["top", "right"]].set_visible(False)
