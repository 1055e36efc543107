"""Pictures of motions: coordinates over time, phase portraits."""

import re
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jimpact.bodies.base import Body, rate_of, split_name
from jimpact.motion.dynamics import kinetic, potential
from jimpact.motion.record import Motion, contact_shares
from jimpact.motion.system import System
from jimpact.plot.style import (
    COLOURS,
    GREY,
    colour_of,
    legend_below,
    new_figure,
    styled,
)
from jimpact.tools.checks import check_kind

POINT = 0.02  # radius in which a point mass is drawn, of the range of its coordinates
# events with a line style of their kind
_MARKED = ("accumulation", "detachment", "friction")
# up to this number of impacts each is marked by a line; more are a grey block
_MANY = 20
_BASEPOINTS = 1000  # at which a base is drawn
_LONG = 10  # letters of a word in a legend above a panel of which three take its width
_FEW = 6  # curves that one panel shows by default, each with its entry in the legend
# Share of the scale of its unit below which what a panel shows is rounding. Ten times
# more would flatten motions that a thousandth of a hair's width is a lot for.
_FLAT = 1e-9


def one_motion(motion: Motion) -> None:
    """Raise a ValueError for a batch, a TypeError for something else."""
    check_kind("motion", motion, Motion)
    if np.ndim(motion.status):
        raise ValueError(
            "Argument `motion` must be one motion, but is a batch: pick one of it."
        )


@styled()
def motion(
    motion: Motion,
    title: str = "",
    names: Sequence[str] = (),
    system: System | None = None,
    *,
    bodies: Sequence[int] | None = None,
    contacts: Sequence[int] | None = None,
) -> Figure:
    """Coordinates, velocities and gaps against time, events, and where the energy goes.

    Each unit has axes of its own. Curves go through the states before and after every
    event, so that a jump stands upright at its time. Of more than six curves a panel
    shows the six that move most (all of the `bodies` that are given), of more than six
    contacts those with the most events;
    its legend says of how many. The potential energy counts from its least value. What
    moves by rounding only is a flat line.

    Args:
        motion: one motion (of a batch: `jax.tree.map(lambda x: x[i], motion)`).
        title: of the picture.
        names: of the coordinates, with their units as in "x [m]"; default: those of the
            body.
        system: that moved: its body names the coordinates, and its base is shown;
            without it and without names they are q1, q2, ...
        bodies: the ones to show, counted from 0, of a system whose coordinates are
            numbered by body (x1, y1, ...).
        contacts: the ones whose gaps to show, counted from 0; None: those of `bodies`,
            if the system says which these are (`between` of `Bodies`).

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    Raises:
        ValueError: a batch of motions, or names of another number; no such body or
            contact.

    >>> import jimpact as ji
    >>> ball = ji.System(ji.Column([1.0]), gravity=True)
    >>> motion = ji.simulate(ball, ji.Newton(0.5), [1.0], [0.0], 1.0, samples=21)
    >>> [axes.get_ylabel() for axes in ji.plot.motion(motion, system=ball).axes]
    ['height [m]', "height' [m/s]", 'gaps [m]', 'energy [J]']
    """
    one_motion(motion)
    labels, rates = _labels(motion, names, system)
    course = course_of(motion)
    columns = [_by_unit(labels, bodies), _by_unit(rates, bodies)]
    rows = max(map(len, columns)) + 1
    # left coordinates, right velocities, a row for each unit; in the last row gaps and
    # energy
    height = 2.7 * rows + 0.4
    figure, panels = new_figure(height, title, rows, 2, sharex=True, squeeze=False)
    scales = _scales(labels, motion)
    for j, (units, values) in enumerate(
        zip(columns, (course.q, course.v), strict=True)
    ):
        axes_and_units = zip(panels[:, j], units.items(), strict=False)
        for axes, (unit, which) in axes_and_units:
            count = len(which)
            too_many = bodies is None and count > _FEW
            if too_many:
                ranges = [_range(values[:, i]) for i, _ in which]
                which = _largest(which, ranges)
            at, words = zip(*which, strict=True)
            axes.plot(course.time, values[:, at], label=words)
            if j == 0 and unit == "m" and system is not None:
                _draw_base(axes, system, motion)
            if len(which) == 1:
                what = words[0]
            else:
                what = ("coordinates", "velocities")[j]
            axes.set_ylabel(f"{what} [{unit}]" if unit else what)
            _finish_panel(
                axes,
                scales.get(unit, 1.0),
                f"{_FEW} of {count}" if too_many else "",
            )
        for axes in panels[len(units) : -1, j]:
            axes.remove()
    shown = _shown_contacts(motion, system, bodies, contacts)
    note = _draw_gaps(panels[-1, 0], motion, shown)
    _finish_panel(panels[-1, 0], scales["m"], note)
    _draw_energies(panels[-1, 1], motion, course, system)
    largest = float(np.nanmax(np.abs(motion.energy), initial=0.0))
    _finish_panel(panels[-1, 1], largest or 1.0)
    for axes in figure.axes:
        if axes is not panels[-1, 1]:
            _draw_events(axes, motion)
    for axes in panels[-1]:
        axes.set_xlabel("time [s]")
    lines = [Line2D([], [], label=x, **y) for x, y in _event_styles(motion)]
    legend_below(figure, 4, lines)
    return figure


def _finish_panel(axes: Axes, scale: float, note: str = "") -> None:
    """Draw a panel's legend with a note, and set limits that do not enlarge rounding of
    `scale`.
    """
    axes.grid(visible=False, axis="x")
    low, high = axes.dataLim.intervaly
    if high - low < _FLAT * scale:
        middle = (low + high) / 2
        axes.set_ylim(middle - scale / 2, middle + scale / 2)
    words = axes.get_legend_handles_labels()[1]
    if len(words) > 1:
        above: Any = {
            "loc": "lower left",
            "bbox_to_anchor": (0, 1),
            "borderaxespad": 0.2,
        }
        if max(map(len, words)) > _LONG:
            columns = 2
        else:
            columns = 3
        axes.legend(ncols=columns, title=note or None, frameon=False, **above)


def _scales(labels: list[str], motion: Motion) -> dict[str, float]:
    """Largest sizes of coordinates and gaps by unit (1 for 0, and in rad); of rates
    over time.
    """
    largest_gap = np.nanmax(np.abs(motion.gaps), initial=0.0)
    scales = {"m": float(largest_gap)}
    largest = np.nanmax(np.abs(motion.q), axis=0, initial=0.0)
    sizes = largest.tolist()
    for label, size in zip(labels, sizes, strict=True):
        unit = split_name(label)[1]
        scales[unit] = max(scales.get(unit, 0.0), size)
    scales = {unit: size or 1.0 for unit, size in scales.items()} | {"rad": 1.0}
    duration = _range(np.asarray(motion.time)) or 1.0
    return scales | {f"{unit}/s": size / duration for unit, size in scales.items()}


def _largest(entries: list[Any], sizes: Sequence[Any]) -> list[Any]:
    """The `_FEW` entries with the largest `sizes`, in their own order."""
    index = range(len(entries))
    best = sorted(index, key=lambda i: sizes[i], reverse=True)[:_FEW]
    return [entries[i] for i in sorted(best)]


def _shown_contacts(
    motion: Motion,
    system: System | None,
    bodies: Sequence[int] | None,
    contacts: Sequence[int] | None,
) -> list[int] | None:
    """Contacts (from 0) that were chosen, by number, else by one of their bodies; None:
    no choice, or a body that does not say which bodies touch.
    """
    count = motion.gaps.shape[1]
    if contacts is not None:
        for contact in contacts:
            if not 0 <= contact < count:
                allowed = f"numbers in [0, {count - 1}]"
                raise ValueError(
                    f"Argument `contacts` must hold {allowed}, but holds {contact}."
                )
        return list(contacts)
    if system is not None:
        between = getattr(system.body, "between", None)
    else:
        between = None
    if bodies is None or between is None:
        return None
    return [j for j, pair in enumerate(between) if set(pair) & set(bodies)]


def _labels(
    motion: Motion, names: Sequence[str], system: System | None
) -> tuple[list[str], list[str]]:
    """Names, with units as in "x [m]", of the coordinates and of the velocities of a
    motion.

    The given names, else those of the system's body, else q1, q2, ... and v1, v2, ...
    """
    n = motion.q.shape[-1]
    rates = motion.velocity.shape[-1]
    known = () if system is None else system.body.names
    unnamed = (f"q{i + 1}" for i in range(len(known), n))
    labels = [*known, *unnamed]
    for i, name in enumerate(names[:n]):
        unit = split_name(labels[i])[1]
        if unit and not split_name(name)[1]:
            labels[i] = f"{name} [{unit}]"
        else:
            labels[i] = name
    if n == rates:
        return labels, [rate_of(name) for name in labels]
    velocities = () if system is None else system.body.velocity_names
    return labels, [*velocities] or [f"v{i + 1}" for i in range(rates)]


def _by_unit(
    names: list[str], bodies: Sequence[int] | None
) -> dict[str, list[tuple[int, str]]]:
    """Names of coordinates grouped by unit, as (index, name without unit).

    Only those of `bodies` (from 0), the numbers at the end of x1, y1, ...; None: all.
    """
    by_unit: dict[str, list[tuple[int, str]]] = {}
    words = [split_name(name)[0] for name in names]
    numbers = [re.search(r"\d*(?='?$)", word) for word in words]
    owners = [int(found[0]) - 1 if found and found[0] else None for found in numbers]
    for body in bodies or ():
        if body not in owners:
            known = sorted({x for x in owners if x is not None})
            raise ValueError(
                f"Argument `bodies` must hold some of {known}, but holds {body!r}."
            )
    for i, name in enumerate(names):
        if bodies is None or owners[i] in bodies:
            word, unit = split_name(name)
            by_unit.setdefault(unit, []).append((i, word))
    return by_unit


class _Course(NamedTuple):
    """States in the order of time: the samples, and those before and after every
    event.
    """

    time: np.ndarray  # (S,) [s]
    q: np.ndarray  # (S, n)
    v: np.ndarray  # (S, n)
    after: np.ndarray  # mask (S,) of the states after an event


def course_of(motion: Motion) -> _Course:
    """States of a motion in the order of time: samples, and before and after each
    event.
    """
    events = motion.events
    rows = np.asarray(motion.events.kind) > 0
    # rows of the record that hold an event: its velocities before and after (E, 2, n)
    velocities = [events.velocity_before, events.velocity_after]
    jumps = np.stack(velocities, axis=1)[rows]
    event_time = np.asarray(events.time)[rows]
    time = np.concatenate([motion.time, np.repeat(event_time, 2)])
    event_q = np.asarray(events.q)[rows]
    q = np.concatenate([motion.q, np.repeat(event_q, 2, axis=0)])
    in_turn = jumps.reshape(-1, jumps.shape[-1])
    v = np.concatenate([motion.velocity, in_turn])
    # samples up to 0, then before an event at 1, 3, ..., after it at 2, 4, ...
    after = np.arange(len(time)) - len(motion.time) + 1
    # stable: of events at one time before and after of the first, then of the second
    order = np.argsort(time, kind="stable")
    number = after[order]
    is_after = (number > 0) & (number % 2 == 0)
    return _Course(time[order], q[order], v[order], is_after)


def base_path(system: System, time: np.ndarray) -> np.ndarray:
    """Displacement of the base (S, d) [m] at times (S,) [s], along directions of the
    body if any.

    Along the body's directions B (columns) the components x solve `B x = D u` in least
    squares, u the displacements along the base's own directions D.
    """
    base = system.base
    assert base is not None
    displacement = jax.vmap(lambda t: jnp.atleast_1d(base(t)))
    path = np.asarray(displacement(jnp.asarray(time)))
    directions = system.body.base_directions
    if directions is None:
        return path
    moved = path @ np.asarray(system.base_directions).T
    solution = np.linalg.lstsq(np.asarray(directions), moved.T, rcond=None)
    return solution[0].T


def _draw_base(axes: Axes, system: System, motion: Motion) -> None:
    """Draw the displacement of the base over time, a line for each direction in which
    it moves; nothing without a base, or where no sample was reached.
    """
    if system.base is None:
        return
    known = np.isfinite(np.asarray(motion.energy))
    reached = np.asarray(motion.time)[known]
    if not len(reached):
        return
    time = np.linspace(reached[0], reached[-1], _BASEPOINTS)
    path = base_path(system, time)
    words = ("",) if path.shape[1] == 1 else (" x", " y", " z")
    styles = ("--", ":", "-.")
    for values, word, style in zip(path.T, words, styles, strict=False):
        if np.ptp(values) > 0:
            label = f"base{word}"
            axes.plot(time, values, style, color="black", lw=0.8, label=label)


def _draw_gaps(axes: Axes, motion: Motion, shown: list[int] | None) -> str:
    """Draw the gaps over time, 0 at events of their contacts; a note says how many are
    shown.

    `shown` None: the `_FEW` contacts with the most events, then the least gaps, without
    those that are always wider open than all that ever closed.
    """
    values = np.asarray(motion.gaps)
    events = motion.events
    # a gap for each contact; else only the least gap is known
    single = events.contacts.shape[-1] == values.shape[1]
    # contacts of each event
    closed = np.zeros((len(events.time), values.shape[1]), bool)
    if single:
        is_event = (np.asarray(events.kind) > 0)[:, None]
        closed = is_event & np.asarray(events.contacts)
    note = ""
    if shown is None:
        ever = closed.any(axis=0)
        least = np.nanmin(values, axis=0, initial=np.inf)
        if ever.any():
            far = np.nanmax(values[:, ever], initial=-np.inf)
        else:
            far = np.inf
        near = list(np.flatnonzero(least <= far))
        weights = [(closed[:, j].sum(), -least[j]) for j in near]
        shown = _largest(near, weights)
        if len(near) > _FEW:
            note = f"{_FEW} of {values.shape[1]}"
        else:
            note = ""
    for j in shown:
        rows = closed[:, j]
        event_time = np.asarray(events.time)[rows]
        time = np.concatenate([motion.time, event_time])
        order = np.argsort(time, kind="stable")
        at_events = np.zeros(rows.sum())
        gap = np.concatenate([values[:, j], at_events])[order]
        axes.plot(time[order], gap, label=f"contact {j + 1}")
    axes.set_ylabel("gaps [m]" if single else "least gap [m]")
    return note


def _event_styles(motion: Motion) -> list[tuple[str, dict[str, Any]]]:
    """Kinds of events to mark, with the style of their lines; impacts if there are
    few.
    """
    styles: dict[str, dict[str, Any]] = {}
    if len(motion.event_times("impact")) <= _MANY:
        styles["impact"] = {"color": GREY, "lw": 0.4}
    dashes = ("--", ":", "-.")
    for kind, style in zip(_MARKED, dashes, strict=True):
        styles[kind] = {"color": "black", "lw": 0.8, "ls": style}
    return [
        (kind, style) for kind, style in styles.items() if len(motion.event_times(kind))
    ]


def _draw_events(axes: Axes, motion: Motion) -> None:
    """Draw a vertical line at each event of the marked kinds."""
    for kind, style in _event_styles(motion):
        for t in motion.event_times(kind)[:_MANY]:
            axes.axvline(t, zorder=0, **style)


def _draw_energies(
    axes: Axes, motion: Motion, course: _Course, system: System | None
) -> None:
    """Draw energies [J] over time: T, T + V, and the work of contacts, base and forces.

    V counts from its least value, so that losses can be seen. T and T + V of a known
    system jump at events, else they are those of the samples.
    """
    time = np.asarray(motion.time)
    if system is None:
        at = time
        kinetic_energy = motion.kinetic_energy
        energy = motion.energy
    else:
        q = jnp.asarray(course.q)
        v = jnp.asarray(course.v)
        at = course.time
        kinetic_energy = jax.vmap(partial(kinetic, system))(q, v)
        energy = kinetic_energy + jax.vmap(partial(potential, system))(q)
    least = np.nanmin(energy - kinetic_energy, initial=np.inf)
    axes.plot(at, energy - least, color="black", label="T + V − min V")
    axes.plot(at, kinetic_energy, color=GREY, lw=0.8, label="T")
    # the sum: in a multiple impact the shares of single contacts may have either sign
    shares = contact_shares(motion)
    first, *more = shares
    label = f"{first.removeprefix('the ')} absorbed"
    axes.plot(time, -shares[first], color=COLOURS[0], label=label)
    others: tuple[tuple[str, Any], ...] = (
        *((f"{name} absorbed", -shares[name]) for name in more),
        ("the base supplied", motion.base_work),
        ("forces supplied", motion.force_work),
    )
    largest = np.nanmax(np.abs(motion.energy), initial=0.0)
    rounding = _FLAT * float(largest)
    for (label, value), colour in zip(others, COLOURS[1:], strict=False):
        size = np.nanmax(np.abs(np.asarray(value)), initial=0.0)
        if size > rounding:
            axes.plot(time, value, "--", color=colour, label=label)
    axes.set_ylabel("energy [J]")


@styled()
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
        coordinate: which, counted from 0; None: the one with the largest range times
            range of its velocity, in SI units.
        title: of the picture.
        names: of the coordinates, as in `motion`.
        system: that moved, as in `motion`; needed where velocities are not the rates of
            q.

    Returns:
        A matplotlib figure: `.savefig(path)` writes it.

    Raises:
        ValueError: a batch, no such coordinate, velocities that are not rates of q.

    >>> import jimpact as ji
    >>> dimer = ji.System(ji.Dimer(0.1, 1.0), gravity=True)
    >>> motion = ji.simulate(
    ...     dimer, ji.Newton(0.5), [0.0, 0.3, 0.1], [0.0] * 3, 0.3, samples=21
    ... )
    >>> ji.plot.phase_portrait(motion, system=dimer).axes[0].get_xlabel()
    'angle [rad]'
    """
    one_motion(motion)
    labels, rates = _labels(motion, names, system)
    course = course_of(motion)
    # coordinate -> its velocity
    pairs = {i: i for i in range(len(labels))}
    if len(labels) != len(rates):
        pairs = {
            i: rates.index(x) for i, x in enumerate(map(rate_of, labels)) if x in rates
        }
    if not pairs:
        raise ValueError(
            "Argument `system` must be given where velocities are not rates of q."
        )
    if coordinate is None:
        size = {
            i: _range(course.q[:, i]) * _range(course.v[:, j]) for i, j in pairs.items()
        }
        coordinate = max(size, key=lambda i: size[i])
    if coordinate not in pairs:
        raise ValueError(
            f"Argument `coordinate` must lie in [{min(pairs)}, {max(pairs)}], but is "
            f"{coordinate}."
        )
    rate = pairs[coordinate]
    figure, axes = new_figure(5.0, title)
    position = course.q[:, coordinate]
    speed = course.v[:, rate]
    # the line breaks between before and after an event
    cut = np.flatnonzero(course.after)
    with_breaks = [np.insert(x, cut, np.nan) for x in (position, speed)]
    axes.plot(*with_breaks, color=COLOURS[0])
    jumps = np.stack([cut - 1, cut])
    style = {"color": COLOURS[1], "lw": 0.8, "zorder": 0}
    lines = axes.plot(position[jumps], speed[jumps], "--", **style)
    if names or system is not None:
        hint = ""
    else:
        hint = "  (`system=` or `names=` name it)"
    axes.set(xlabel=labels[coordinate] + hint, ylabel=rates[rate])
    if lines:
        lines[0].set_label("jump at an event")
        legend_below(figure, 1)
    return figure


def _range(values: np.ndarray) -> float:
    """Range of the finite values, 0 without any."""
    finite = values[np.isfinite(values)]
    if len(finite):
        return float(np.ptp(finite))
    return 0.0


def draw_body(axes: Axes, body: Body, q: np.ndarray) -> None:
    """Draw a body at its configuration q, and the planes that it stands on."""
    point = POINT * (np.ptp(q) or 1.0)  # radius of a point mass [m]
    curves = body.outlines(q, point)
    shadows = body.shadows(q)
    floors = [plane_of(*floor) for floor in body.floors]
    origin = np.zeros((1, 2))
    set_limits(axes, [[*curves, *shadows]], origin, floors)
    for points in shadows:
        axes.plot(*points.T, color=GREY, lw=0.8)
    colours = colours_of(body, q, point)
    for points, colour in zip(curves, colours, strict=True):
        axes.plot(*points.T, color=colour)
    for angle, offset in body.floors:
        # nearest to the origin
        foot = (-offset * np.sin(angle), offset * np.cos(angle))
        axes.axline(foot, slope=np.tan(angle), color=GREY, lw=2)


def colours_of(body: Body, q: np.ndarray, point: float) -> list[str]:
    """The colour of each outline: one for each body."""
    each = enumerate(body.outlines_by_body(q, point))
    return [colour_of(i) for i, curves in each for _ in curves]


def plane_of(angle: float, offset: float) -> tuple[np.ndarray, float]:
    """Normal n (2,) and offset of the plane `n^T x = offset` inclined by `angle`
    [rad].
    """
    normal = np.array([-np.sin(angle), np.cos(angle)])
    return normal, float(offset)


def set_limits(
    axes: Axes,
    curves: Sequence[Sequence[np.ndarray]],
    ground: np.ndarray,
    floors: Sequence[tuple[np.ndarray, float]],
) -> None:
    """Set equal limits that hold the curves of all frames, and a point of each plane.

    That is the foot, on `n^T (x - ground[0]) = offset`, of the middle of the curves.
    """
    points = np.concatenate([curve for frame in curves for curve in frame])
    lowest = points.min(axis=0)
    middle = (lowest + points.max(axis=0)) / 2
    feet = [middle - (n @ (middle - ground[0]) - offset) * n for n, offset in floors]
    as_points = (foot[None] for foot in feet)
    points = np.concatenate([points, *as_points])
    low = points.min(axis=0)
    high = points.max(axis=0)
    half = 0.55 * float((high - low).max()) or 1.0
    centre = (low + high) / 2
    left, bottom = centre - half
    right, top = centre + half
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
    axes.locator_params(nbins=5)
