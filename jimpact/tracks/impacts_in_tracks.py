"""Impacts in a track: flights and instants at once, by maximum likelihood."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from jimpact.shots.shots_file import ANGULAR, LINEAR
from jimpact.tools.checks import as_float_array, check_concrete, check_values
from jimpact.tracks.arcs import Arcs, fit_arcs
from jimpact.tracks.drag import straightened
from jimpact.tracks.judging import (
    findings,
    findings_of_held,
    findings_of_input,
    findings_of_noise,
    findings_of_signs,
    free_flights,
)
from jimpact.tracks.poses import with_turns
from jimpact.tracks.quaternions import as_inertia, as_poses
from jimpact.tracks.segments import (
    SMALLEST_JUMP,
    common_acceleration,
    flights_and_acceleration,
    noise,
)
from jimpact.tracks.track import Track, TrackImpact

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
) -> Track:
    """The impacts of a track: instants, velocities before and after, and their covariance.

    Equation: between impacts `q = P + v (t - tau) + a (t - tau)^2 / 2`; the arcs on both sides of
    an impact meet at its instant tau. Places P, velocities and instants of all impacts minimize
    the sum of `((q - measured) / sigma)^2` at once: maximum likelihood for normal errors. Nothing
    is smoothed or differentiated. Where a contact lasts, the arcs meet at the centroid of the pulse
    of its force.

    Args:
        t: times of the frames, rising (T,) [s].
        q: coordinates (T,) or (T, n) [m] or [rad]; NaN where the body was lost. An angle goes on
            beyond pi, or is unwrapped where `units` say 'rad'. The velocities are the rates of q.
        sigma: standard errors of q, a number or (n,), > 0; None: estimated from the residuals.
        acceleration: between impacts, a number or (n,) [m/s^2]; -9.80665 of a height; None: one
            unknown in each coordinate, common to all flights.
        drag: k >= 0 of the air's `-k |v| v`, |v| that of the places [1/m]; .12 of a table-tennis
            ball; None: one unknown for all flights. Between impacts the arcs bend accordingly.
        contact: the longest duration of a contact, whose frames are left out, >= 0 [s].
        shortest: frames of a flight, >= 3.
        window: of each flight use only so long before and after an impact, > 0 [s], where flights
            are not quite ballistic; None: whole flights.
        units: of each coordinate, 'm' or 'rad', or one for all; None: m.
        quaternion: 'wxyz' or 'xyzw', the order in which poses hold it; then q is (T, 7), the centre
            of mass and a unit quaternion of either sign, from the axes of the body to those of
            space. sigma has (6,), places and turns about the axes of the body [rad], acceleration
            (3,). Impacts are found by the places.
        inertia: of a body with poses, (3,) along its axes or (3, 3), about the centre of mass, up
            to a factor: between impacts it turns freely. None: as a sphere or a cube does.

    Returns:
        `Track`, which prints and plots; `warnings` say which flights are not ballistic, and that
        no impact was found. With `quaternion` velocities are (x', omega), omega in the axes of the
        body, as of `ji.Box`, and poses hold the quaternion's scalar first.

    Raises:
        ValueError: fewer frames than a flight and a half, times that do not rise or are not finite,
            sigma <= 0, other shapes; no flight at all; a quaternion whose length is not 1.

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
        }
        return _in_poses(t, q, sigma, acceleration, quaternion, inertia, options)
    t, q, names = _checked(t, q, shortest, units)
    n = q.shape[1]
    raw, q = q, _unwrapped(q, names)
    given = noise(q) if sigma is None else _of_coordinates("sigma", sigma, n)
    check_values("sigma", given, low=0.0, open_low=True)
    notes = findings_of_input(raw, given, names)
    known = None if acceleration is None else _of_coordinates("acceleration", acceleration, n)
    for name, value in (("contact", contact), ("window", 1.0 if window is None else window)):
        check_values(name, np.asarray(value, float), low=0.0, open_low=name == "window")
    if drag is not None:
        check_values("drag", np.asarray(drag, float), low=0.0)
    if drag != 0 and "rad" in names:
        raise ValueError(
            "Argument `drag` must be 0 where q holds angles, as it is of places, but has value "
            f"{drag}."
        )
    arcs, given, more = _arcs_of(t, q, given, sigma is None, known, drag, contact, shortest, window)
    return _as_track(t, _unwrapped(raw, names), given, arcs, names, (*notes, *more))


def _arcs_of(
    t: np.ndarray,
    q: np.ndarray,
    given: np.ndarray,
    estimated: bool,
    known: np.ndarray | None,
    drag: float | None,
    contact: float,
    shortest: int,
    window: float | None,
) -> tuple[Arcs, np.ndarray, list[str]]:
    """Arcs of all flights, standard errors sigma (n,), and findings.

    1. Divide the frames into flights; leave out those in which the body is held.
    2. Fit arcs, and join flights until all jumps are impacts.
    3. If sigma is `estimated`, take it from the residuals and repeat 2.
    4. With drag: fit arcs that it bends; of unknown drag divide the frames once more before.
    5. With a `window` [s]: fit by frames near the impacts only.

    `given`: sigma (n,); `known`: acceleration (n,), None: unknown; `drag` None: unknown.
    """
    x, free, q = t - t.mean(), known is None, q.copy()
    flights, a, k = flights_and_acceleration(x, q, given, known, shortest, drag)
    straight = straightened(x, q, k) if k else q
    notes = [] if known is None else findings_of_signs(x, straight, given, known, shortest)
    flights = [f for f in flights if x[f[-1]] - x[f[0]] > contact]
    if not flights:
        raise ValueError(
            "Argument `q` must hold a flight, but no frames in a row lie on an arc within sigma = "
            f"{given.tolist()} at an acceleration of {a.tolist()}: are these the units of q?"
        )
    kept = free_flights(x, straight, given, a, flights)
    if len(kept) < len(flights):
        flights = kept
        notes += findings_of_held(t, flights)
        for places in (q, straight):
            places[: flights[0][0]], places[flights[-1][-1] + 1 :] = np.nan, np.nan
    arcs, flights = _of_true_impacts(x, straight, given, flights, a, free, contact)
    rough = given
    if estimated:  # what the residuals show; jumps are judged anew by it
        given = _of_residuals(given, arcs)
        arcs, flights = _of_true_impacts(x, straight, given, flights, a, free, contact)
    unknown = (free, drag is None)
    if drag is None:  # flights once more, by what is found
        start = (arcs.acceleration, k, arcs.instants[1:-1])
        arcs = _with_drag(x, q, given, flights, start, unknown, contact)
        a, k = arcs.acceleration, arcs.drag
        flights, *_ = flights_and_acceleration(x, q, given, a, shortest, k)
        straight = straightened(x, q, k)
        arcs, flights = _of_true_impacts(x, straight, given, flights, a, False, contact)
    if drag != 0:
        start = (arcs.acceleration, k, arcs.instants[1:-1])
        arcs = _with_drag(x, q, given, flights, start, unknown, contact)
        if estimated:
            given = _of_residuals(given, arcs)
            arcs = _with_drag(x, q, given, flights, start, unknown, contact)
    notes += findings_of_noise(rough, given) if estimated else []
    if window is not None and len(arcs.instants) > 2:
        whole = np.concatenate(arcs.members)
        arcs = _windowed(x, q, given, arcs, contact, window)
        q[np.setdiff1d(whole, np.concatenate(arcs.members))] = np.nan  # no frames that do not fit
    return arcs, given, [*notes, *findings(t, q, given, arcs)]


def _with_drag(
    x: np.ndarray,
    q: np.ndarray,
    sigma: np.ndarray,
    flights: list[np.ndarray],
    start: tuple[np.ndarray, float, np.ndarray],
    free: tuple[bool, bool],
    contact: float,
) -> Arcs:
    """Arcs that drag bends; `start`: first values of acceleration, drag and instants.

    `free`: acceleration and drag are unknown.
    """
    a, k, instants = start
    return fit_arcs(x, q, sigma, flights, a, free[0], contact, instants, drag=k, free_drag=free[1])


def _in_poses(
    t: Any,
    q: Any,
    sigma: Any,
    acceleration: Any,
    quaternion: str | None,
    inertia: Any,
    options: dict[str, Any],
) -> Track:
    """Track of poses (T, 7): impacts by the places, then angular velocities by the quaternions.

    `options`: all other arguments of `find_impacts`.
    """
    if quaternion is None:
        raise ValueError("Argument `inertia` is for poses, whose order `quaternion` must name.")
    if options["units"] is not None:
        raise ValueError("Argument `units` is not for poses: places [m] and a quaternion.")
    for name, value in (("t", t), ("q", q)):
        check_concrete(name, value)
        as_float_array(name, value)  # raises for what are no numbers
    places, e = as_poses(q, quaternion)
    moments = as_inertia(inertia)
    of_places, of_turns = None, None
    if sigma is not None:
        both = _of_coordinates("sigma", sigma, 6)
        check_values("sigma", both, low=0.0, open_low=True)
        of_places, of_turns = both[:3], both[3:]
    track = find_impacts(t, places, of_places, acceleration=acceleration, **options)
    return replace(with_turns(track, e, of_turns, moments), order=quaternion, inertia=moments)


def _checked(t: Any, q: Any, shortest: int, units: Any) -> tuple[np.ndarray, np.ndarray, Any]:
    """Checked times (T,) [s], coordinates (T, n) and their units (n,), 'm' or 'rad'."""
    for name, value in (("t", t), ("q", q)):
        check_concrete(name, value)
        as_float_array(name, value)  # raises for what are no numbers
    t, q = np.asarray(t, float), np.array(q, float)
    q = q[:, None] if q.ndim == 1 else q
    if t.ndim != 1 or q.ndim != 2 or len(t) != len(q) or q.shape[1] == 0:
        raise ValueError(
            f"Arguments `t` and `q` must have shapes (T,) and (T,) or (T, n), but have {t.shape} "
            f"and {q.shape}."
        )
    if isinstance(shortest, bool) or not isinstance(shortest, int | np.integer) or shortest < 3:
        raise ValueError(f"Argument `shortest` must be a whole number >= 3, but is {shortest!r}.")
    check_values("t", t)
    check_values("q", q, nan_allowed=True)
    if len(t) < shortest:
        raise ValueError(
            f"Argument `t` must have {shortest} frames or more, those of a flight (`shortest`), "
            f"but has {len(t)}."
        )
    if not (np.diff(t) > 0).all():
        k = int(np.argmin(np.diff(t) > 0))
        raise ValueError(
            f"Argument `t` must rise, but frame {k + 2} is at {t[k + 1]:g} s, after {t[k]:g} s."
        )
    lost = ~np.isfinite(q).any(axis=0)
    if lost.any():
        raise ValueError(
            f"Argument `q` must be seen in each coordinate, but coordinate "
            f"{int(lost.argmax()) + 1} is NaN in all frames."
        )
    n = q.shape[1]
    names = ("m",) * n if units is None else (units,) * n if isinstance(units, str) else units
    if len(names) != n or not set(names) <= set(VELOCITY_OF):
        raise ValueError(
            f"Argument `units` must have {n} entries, each 'm' or 'rad', but has value {units!r}: "
            "convert lengths and angles to these."
        )
    return t, q, tuple(names)


def _of_coordinates(name: str, value: Any, n: int) -> np.ndarray:
    """Argument `name`, a number for all coordinates or one for each, checked, as (n,)."""
    check_concrete(name, value)
    as_float_array(name, value)  # raises for what are no numbers
    array = np.asarray(value, float)
    if array.shape not in ((), (n,)):
        raise ValueError(
            f"Argument `{name}` must be a number or have shape ({n},), one for each coordinate, "
            f"but has shape {array.shape}."
        )
    check_values(name, array)
    return np.broadcast_to(array, (n,)).copy()


def _unwrapped(q: np.ndarray, units: tuple[str, ...]) -> np.ndarray:
    """Coordinates (T, n) in which angles, in frames that were seen, have no steps of 2 pi."""
    q = q.copy()
    for c in np.flatnonzero(np.array(units) == "rad"):
        seen = np.isfinite(q[:, c])
        q[seen, c] = np.unwrap(q[seen, c])
    return q


def _of_true_impacts(
    x: np.ndarray,
    q: np.ndarray,
    sigma: np.ndarray,
    flights: list[np.ndarray],
    a: np.ndarray,
    free: bool,
    contact: float,
) -> tuple[Arcs, list[np.ndarray]]:
    """Arcs, and the flights joined until every jump of velocity is an impact.

    A jump below SMALLEST_JUMP standard errors is none: the flights on both sides are joined, the
    weaker one of neighbouring jumps first. Instants are fixed until all jumps exceed that, as
    nothing determines an instant without a jump. `a`: acceleration (n,), fitted if `free`.
    """
    frozen = len(flights) > 1
    while True:
        a = common_acceleration(x, q, flights) if free else a
        arcs = fit_arcs(x, q, sigma, flights, a, free, contact, frozen=frozen)
        size = _jumps(arcs)
        weak = np.flatnonzero(size < SMALLEST_JUMP)
        if not weak.size and not frozen:
            return arcs, flights
        frozen = frozen and weak.size > 0
        # of neighbours only the weaker: its joining makes the other clearer
        ends = np.concatenate([[np.inf], size, [np.inf]])
        low = [k for k in weak if ends[k + 1] <= min(ends[k], ends[k + 2])]
        for k in sorted(low, reverse=True):
            flights = [*flights[:k], np.concatenate(flights[k : k + 2]), *flights[k + 2 :]]


def _jumps(arcs: Arcs) -> np.ndarray:
    """Largest of `|v+ - v-| / sigma` over the coordinates of each impact (K,), sigma its error."""
    (pre, post), covariance = arcs.velocities(), arcs.covariance_of_velocities()
    K, n = pre.shape
    signs = np.hstack([-np.eye(n), np.eye(n)])  # v+ - v- = signs (v-, v+)
    sizes = np.zeros(K)
    for k in range(K):
        own = slice(2 * n * k, 2 * n * (k + 1))
        errors = np.sqrt(np.maximum(np.diag(signs @ covariance[own, own] @ signs.T), 1e-300))
        sizes[k] = np.abs((post[k] - pre[k]) / errors).max()
    return sizes


def _windowed(
    x: np.ndarray,
    q: np.ndarray,
    sigma: np.ndarray,
    whole: Arcs,
    contact: float,
    window: float,
) -> Arcs:
    """Arcs by frames of each flight within `window` [s] of its impacts only.

    A flight keeps its one arc, so that velocities of both its ends stay those of one arc.
    """
    near = []
    for i, frames in enumerate(whole.members):
        ends = whole.instants[i + (i == 0) : i + 2 - (i == len(whole.members) - 1)]
        close = (np.abs(x[frames][:, None] - ends) <= window).any(axis=1)
        near.append(frames[close])
    if min(map(len, near)) < 3:
        raise ValueError(
            f"Argument `window` must leave 3 frames or more of each flight, but {window:g} s leave "
            f"{min(map(len, near))}."
        )
    start = (whole.acceleration, whole.drag, whole.instants[1:-1])
    return _with_drag(x, q, sigma, near, start, whole.free, contact)


def _of_residuals(sigma: np.ndarray, arcs: Arcs) -> np.ndarray:
    """Standard errors (n,): `sigma sqrt(chi^2 / freedom)` of the residuals of each coordinate.

    Freedom: frames, less K + 2 places, 1/n of K instants, 1 for a free acceleration.
    """
    n, ends = len(sigma), len(arcs.instants)
    seen = np.isfinite(arcs.residual).sum(axis=0)
    freedom = np.maximum(seen - ends - (ends - 2) / n - arcs.free[0], 1.0)
    scale = np.sqrt(np.nansum(arcs.residual**2, axis=0) / freedom)
    return np.maximum(sigma * scale, np.finfo(float).tiny ** 0.25)


def _as_track(
    t: np.ndarray,
    q: np.ndarray,
    sigma: np.ndarray,
    arcs: Arcs,
    units: tuple[str, ...],
    lines: tuple[str, ...],
) -> Track:
    """Track of these arcs: impacts with velocities and covariance; `lines` are its warnings."""
    (pre, post), covariance = arcs.velocities(), arcs.covariance_of_velocities()
    n, size = q.shape[1], q.shape[1] + 1
    impacts = []
    for k, (before, after) in enumerate(zip(pre, post)):
        own = slice(2 * n * k, 2 * n * (k + 1))
        error = float(np.sqrt(arcs.covariance[(k + 1) * size + n, (k + 1) * size + n]))
        time, place = float(arcs.instants[k + 1] + t.mean()), arcs.places[k + 1]
        impacts.append(TrackImpact(time, error, place, before, after, covariance[own, own]))
    velocity_units = tuple(VELOCITY_OF[unit] for unit in units)
    return Track(
        tuple(impacts), tuple(arcs.members), sigma, covariance, lines, velocity_units, t, q, arcs
    )
