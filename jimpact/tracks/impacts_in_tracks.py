"""Impacts in a track: flights and instants at once, by maximum likelihood."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from jimpact.shots.covariances import diagonal_blocks
from jimpact.shots.shots_file import ANGULAR, LINEAR
from jimpact.tools.checks import as_float_array, check_concrete, check_values
from jimpact.tracks.arcs import Arcs
from jimpact.tracks.flight import Flight, Force
from jimpact.tracks.frames import Frames, noise
from jimpact.tracks.judging import (
    NO_IMPACT,
    findings,
    findings_of_bodies,
    findings_of_doubts,
    findings_of_held,
    findings_of_input,
    findings_of_signs,
    notes_of,
)
from jimpact.tracks.poses import with_turns
from jimpact.tracks.quaternions import as_inertia, as_poses
from jimpact.tracks.search import Settings, doubts, fitted_arcs, searched, windowed
from jimpact.tracks.spin import Spin, spin_of
from jimpact.tracks.track import Track, TrackImpact
from jimpact.tracks.turning_alone import with_impacts_of_turning
from jimpact.tracks.unwrapping import unwrapped

VELOCITY_OF = {"m": LINEAR, "rad": ANGULAR}


def find_impacts(
    t: Any,
    q: Any,
    sigma: Any = None,
    *,
    acceleration: Any = 0.0,
    drag: float | None = 0.0,
    contact: float = 0.0,
    shortest: int = 5,
    window: float | None = None,
    units: str | Sequence[str] | None = None,
    quaternion: str | None = None,
    inertia: Any = None,
    spin: Any = None,
) -> Track:
    """The impacts of a track: instants, velocities before and after, and their
    covariance.

    Equation: between impacts `q = P + v (t - tau) + a (t - tau)^2 / 2`; the arcs on
    both sides of an impact meet at its instant tau. Places P, velocities and instants
    of all impacts are most likely at once for normal errors, of standard error sigma
    and, where residuals show them, with waves that neighbouring frames share; flights
    that bend have accelerations of their own. There are as many impacts as there is
    evidence for beside these. Nothing is smoothed or differentiated. Where a contact
    lasts, the arcs meet at the centroid of the pulse of its force.

    Args:
        t: times of the frames, rising (T,) [s].
        q: coordinates (T,) or (T, n) [m] or [rad]; NaN where the body was lost. An
            angle goes on beyond pi, or is unwrapped where `units` say 'rad', over lost
            frames by the rates beside them. The velocities are the rates of q.
        sigma: standard errors of q, a number or (n,), > 0; None: estimated from the
            residuals. Residuals that are clearly larger than a given sigma take its
            place, and are told.
        acceleration: between impacts, a number or (n,) [m/s^2]; -9.80665 of a height;
            None: one unknown in each coordinate, common to all flights, or an entry of
            a list, `[0, None]`; or a function of velocities (.., n) [m/s] that returns
            accelerations, as of spin.
        drag: k >= 0 of the air's `-k |v| v`, |v| that of the places [1/m]; .12 of a
            table-tennis ball; None: one unknown for all flights. Between impacts the
            arcs bend accordingly.
        contact: the longest duration of a contact, whose frames are left out, >= 0 [s].
        shortest: frames of a flight, >= 3.
        window: of each flight use only so long before and after an impact, > 0 [s],
            where flights are not quite ballistic; None: whole flights.
        units: of each coordinate, 'm' or 'rad', or one for all; None: m.
        quaternion: 'wxyz' or 'xyzw', the order in which poses hold it; then q is (T,
            7), the centre of mass and a unit quaternion of either sign, from the axes
            of the body to those of space. sigma has (6,), places and turns about the
            axes of the body [rad], acceleration (3,). Impacts are found by the
            places, and of a body as a sphere by the turns, too.
        inertia: of a body with poses, (3,) along its axes or (3, 3), about the centre
            of mass, up to a factor: between impacts it turns freely. None: as a sphere
            or a cube does.

        spin: angular velocity (3,), or (T, 3) in each frame, NaN where it is not
            known [rad/s]; `acceleration` is then a function of velocities (.., n) and
            spins (.., 3), as of Magnus: `lambda v, w: g + k * np.cross(w, v)`.

    Returns:
        `Track`, which prints and plots; `warnings` say which flights are not ballistic,
        which impacts are doubtful, and that no impact was found; `candidates` how many
        went, and why. With `quaternion` velocities are (x', omega), omega in the axes
        of the body, as of `ji.Box`, and poses hold the quaternion's scalar first.

    Raises:
        ValueError: fewer frames than a flight and a half, times that do not rise or are
            not finite, sigma <= 0, other shapes; no flight at all; a quaternion whose
            length is not 1.

    >>> import numpy as np
    >>> import jimpact as ji
    >>> t = np.arange(60) / 120
    >>> height = np.where(t < 0.25, 1 - 2 * t, 0.5 + 1.6 * (t - 0.25))
    >>> noise = 0.001 * np.random.default_rng(0).normal(size=60)
    >>> track = ji.tracks.find_impacts(t, height + noise)
    >>> [round(float(track.impacts[0].post[0] / -track.impacts[0].pre[0]), 2)]
    [0.8]
    """
    if quaternion is not None or inertia is not None:
        options = {
            "drag": drag,
            "contact": contact,
            "shortest": shortest,
            "window": window,
            "units": units,
            "spin": spin,
        }
        return _in_poses(t, q, sigma, acceleration, quaternion, inertia, options)
    t, q, names = _checked(t, q, shortest, units)
    n = q.shape[1]
    raw = q
    q = _unwrapped(t, q, names)
    rough = noise(t, q)
    if sigma is None:
        given = rough
    else:
        given = _of_coordinates("sigma", sigma, n)
    check_values("sigma", given, low=0.0, open_low=True)
    check_values("contact", contact, low=0.0)
    check_values("window", window, low=0.0, open_low=True)
    flight = _model(acceleration, drag, names, spin_of(t, spin))
    angles = tuple(name == "rad" for name in names)
    frames = Frames(t - t.mean(), q, given, angles)
    settings = Settings(sigma is None, contact, shortest, window)
    notes = [*findings_of_input(raw, given, names), *findings_of_bodies(raw)]
    if not flight.unknown.any():
        straight = flight.straight(frames)
        notes += findings_of_signs(straight, flight.acceleration, shortest)
    search = searched(frames, flight, settings)
    whole, flights = fitted_arcs(search)
    arcs = whole
    if window is not None and arcs.impacts:
        arcs = windowed(search, arcs, window)
    if acceleration_is_known(flight):
        notes += findings_of_held(t, search.verdict.flights, search.candidates)
    doubtful = doubts(search, arcs)
    notes += findings(search, arcs, whole.members, rough)
    notes += findings_of_doubts(doubtful)
    left_out = len(search.verdict.flights) - len(flights)
    candidates = notes_of(search, left_out)
    track = _as_track(t, _unwrapped(t, raw, names), arcs, names, doubtful)
    return replace(track, warnings=tuple(notes), candidates=tuple(candidates))


def acceleration_is_known(flight: Flight) -> bool:
    """True where an acceleration is given, so that a body without it is held."""
    return bool(flight.known_acceleration.any())


def _model(
    acceleration: Any, drag: float | None, units: tuple[str, ...], spin: Spin | None
) -> Flight:
    """Checked model of flights from the arguments of `find_impacts`."""
    if spin is not None and not callable(acceleration):
        raise ValueError(
            "Argument `acceleration` must be a function of velocity and spin where "
            f"`spin` is given, but is {acceleration!r}."
        )
    n = len(units)
    none = np.zeros(n, bool)
    force = None
    unknown = none
    if callable(acceleration):
        force = _checked_force(acceleration, n, spin)
        known = np.zeros(n)
    elif acceleration is None:
        known = np.zeros(n)
        unknown = ~none
    else:
        values = acceleration
        if isinstance(acceleration, list | tuple) and None in acceleration:
            unknown = np.array([x is None for x in acceleration])
            values = [0.0 if x is None else x for x in acceleration]
        known = _of_coordinates("acceleration", values, n)
    if drag is not None:
        check_values("drag", np.asarray(drag, float), low=0.0)
    if (drag != 0 or force is not None) and "rad" in units:
        raise ValueError(
            f"Argument `drag` must be 0, and `acceleration` no function, where q holds "
            f"angles, as they are of places, but `drag` has value {drag}."
        )
    return Flight(known, unknown, drag or 0.0, drag is None, force)


def _checked_force(function: Any, n: int, spin: Spin | None) -> Force:
    """Acceleration (..., n) as a function of velocity and time, by one trial.

    Of velocities alone, or of velocities and the spin (..., 3) that is given.
    """

    def force(v: np.ndarray, t: np.ndarray, ends: np.ndarray | None) -> np.ndarray:
        """Acceleration of velocities (..., n) at times (...)."""
        if spin is None:
            return np.asarray(function(v), float)
        return np.asarray(function(v, spin.at(t, ends)), float)

    found = force(np.zeros((2, n)), np.zeros(2), None)
    if found.shape != (2, n) or not np.isfinite(found).all():
        raise ValueError(
            f"Argument `acceleration`, a function of velocities (..., {n}), must "
            f"return finite accelerations of the same shape, but of zeros ({2}, {n}) "
            f"returns {found.tolist()}."
        )
    return force


def _in_poses(
    t: Any,
    q: Any,
    sigma: Any,
    acceleration: Any,
    quaternion: str | None,
    inertia: Any,
    options: dict[str, Any],
) -> Track:
    """Track of poses (T, 7): impacts by the places, then angular velocities by the
    quaternions.

    `options`: all other arguments of `find_impacts`.
    """
    if quaternion is None:
        raise ValueError(
            "Argument `inertia` is for poses, whose order `quaternion` must name."
        )
    if options["units"] is not None:
        raise ValueError(
            "Argument `units` is not for poses: places [m] and a quaternion."
        )
    for name, value in (("t", t), ("q", q)):
        check_concrete(name, value)
        as_float_array(name, value)  # raises for what are no numbers
    places, e = as_poses(q, quaternion)
    moments = as_inertia(inertia)
    of_places = None
    of_turns = None
    if sigma is not None:
        both = _of_coordinates("sigma", sigma, 6)
        check_values("sigma", both, low=0.0, open_low=True)
        of_places, of_turns = np.split(both, 2)
    track = find_impacts(t, places, of_places, acceleration=acceleration, **options)
    if moments is None:
        track = _with_turning_alone(track, e, of_turns, options["shortest"])
    return replace(
        with_turns(track, e, of_turns, moments), order=quaternion, inertia=moments
    )


def _with_turning_alone(
    track: Track, e: np.ndarray, sigma: np.ndarray | None, shortest: int
) -> Track:
    """Track of places, with impacts that orientations e (T, 4) alone show."""
    frames = Frames(track.t - track.t.mean(), track.q, track.sigma)
    arcs, alone = with_impacts_of_turning(track.arcs, frames, e, sigma, shortest)
    if not alone.any():
        return track
    doubtful = np.zeros(len(alone), bool)
    doubtful[~alone] = [impact.doubtful for impact in track.impacts]
    found = _as_track(track.t, track.q, arcs, ("m",) * 3, doubtful)
    notes = [note for note in track.warnings if not note.startswith(NO_IMPACT)]
    return replace(found, warnings=tuple(notes), candidates=track.candidates)


def _checked(
    t: Any, q: Any, shortest: int, units: Any
) -> tuple[np.ndarray, np.ndarray, Any]:
    """Checked times (T,) [s], coordinates (T, n) and their units (n,), 'm' or 'rad'."""
    for name, value in (("t", t), ("q", q)):
        check_concrete(name, value)
        as_float_array(name, value)  # raises for what are no numbers
    t = np.asarray(t, float)
    q = np.array(q, float)
    if q.ndim == 1:
        q = q[:, None]
    if t.ndim != 1 or q.ndim != 2 or len(t) != len(q) or q.shape[1] == 0:
        raise ValueError(
            f"Arguments `t` and `q` must have shapes (T,) and (T,) or (T, n), but have "
            f"{t.shape} and {q.shape}."
        )
    if (
        isinstance(shortest, bool)
        or not isinstance(shortest, int | np.integer)
        or shortest < 3
    ):
        raise ValueError(
            f"Argument `shortest` must be a whole number >= 3, but is {shortest!r}."
        )
    check_values("t", t)
    check_values("q", q, nan_allowed=True)
    if len(t) < shortest:
        raise ValueError(
            f"Argument `t` must have {shortest} frames or more, those of a flight "
            f"(`shortest`), but has {len(t)}."
        )
    if not (np.diff(t) > 0).all():
        k = int(np.argmin(np.diff(t) > 0))
        raise ValueError(
            f"Argument `t` must rise, but frame {k + 2} is at {t[k + 1]:g} s, after "
            f"{t[k]:g} s."
        )
    lost = ~np.isfinite(q).any(axis=0)
    if lost.any():
        raise ValueError(
            f"Argument `q` must be seen in each coordinate, but coordinate "
            f"{int(lost.argmax()) + 1} is NaN in all frames."
        )
    seen = int(np.isfinite(q).all(axis=1).sum())
    if np.isfinite(q).any(axis=1).sum() < shortest:
        raise ValueError(
            f"Argument `q` was seen in {seen} frames: {shortest} make a flight."
        )
    n = q.shape[1]
    if units is None:
        names = ("m",) * n
    elif isinstance(units, str):
        names = (units,) * n
    else:
        names = units
    if len(names) != n or not set(names) <= set(VELOCITY_OF):
        raise ValueError(
            f"Argument `units` must have {n} entries, each 'm' or 'rad', but has value "
            f"{units!r}: convert lengths and angles to these."
        )
    return t, q, tuple(names)


def _of_coordinates(name: str, value: Any, n: int) -> np.ndarray:
    """Argument `name`, a number for all coordinates or one for each, checked, as
    (n,).
    """
    check_concrete(name, value)
    as_float_array(name, value)  # raises for what are no numbers
    array = np.asarray(value, float)
    if array.shape not in ((), (n,)):
        raise ValueError(
            f"Argument `{name}` must be a number or have shape ({n},), one for each "
            f"coordinate, but has shape {array.shape}."
        )
    check_values(name, array)
    return np.broadcast_to(array, (n,)).copy()


def _unwrapped(t: np.ndarray, q: np.ndarray, units: tuple[str, ...]) -> np.ndarray:
    """Coordinates (T, n) in which angles, in frames that were seen, have no steps of 2
    pi.
    """
    q = q.copy()
    for c in np.flatnonzero(np.array(units) == "rad"):
        seen = np.isfinite(q[:, c])
        q[seen, c] = unwrapped(t[seen], q[seen, c])
    return q


def _as_track(
    t: np.ndarray,
    q: np.ndarray,
    arcs: Arcs,
    units: tuple[str, ...],
    doubtful: np.ndarray,
) -> Track:
    """Track of these arcs: impacts with velocities and covariance; `doubtful` (K,)."""
    pre, post = arcs.velocities()
    covariance = arcs.covariance_of_velocities
    blocks = diagonal_blocks(covariance, 2 * q.shape[1])
    times = arcs.instants_of_impacts + t.mean()
    errors = arcs.instant_errors()
    places = arcs.places_of_impacts
    impacts = tuple(
        TrackImpact(
            float(times[k]),
            float(errors[k]),
            places[k],
            pre[k],
            post[k],
            blocks[k],
            bool(doubt),
        )
        for k, doubt in enumerate(doubtful)
    )
    return Track(
        impacts,
        tuple(arcs.members),
        arcs.errors.sigma,
        covariance,
        (),
        tuple(VELOCITY_OF[unit] for unit in units),
        t,
        q,
        arcs,
        covariance_with_poses=arcs.covariance_with_places,
    )
