"""Poses of a body in space: shots of its velocities (x', omega), omega in its own axes.

The arcs of its places and the free rotation of each flight are known first, each by
itself. At an impact the orientations of both flights meet: under this condition places,
instants and rotations have their most likely values, and their covariance, all at once.
"""

from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from jimpact.bodies.rigid import place_of, turning_of
from jimpact.shots.covariances import diagonal_blocks
from jimpact.shots.shots_file import ANGULAR, LINEAR
from jimpact.tracks.arcs import Arcs
from jimpact.tracks.frames import noise
from jimpact.tracks.judging import findings_of_noise, findings_of_turns
from jimpact.tracks.quaternions import turns_since_first
from jimpact.tracks.track import Track, TrackImpact
from jimpact.tracks.turning import Turning, fit_turning

# times that the condition is taken anew; the third changes nothing that is seen
MEETINGS = 5


def with_turns(
    track: Track, e: np.ndarray, sigma: np.ndarray | None, inertia: np.ndarray | None
) -> Track:
    """Track of places with orientations e (T, 4): impacts with velocities (x', omega).

    Each flight is fitted as a free rotation; then flights are made to meet at impacts.
    sigma (3,) of turns about the axes of the body [rad]; None: taken from the
    residuals.
    """
    seen = np.isfinite(e[:, 0])
    frames = [rows[seen[rows]] for rows in track.flights]
    for k, some in enumerate(frames, 1):
        if len(some) < 2:
            raise ValueError(
                f"Argument `q` must have an orientation in 2 frames or more of each "
                f"flight, but in flight {k} it has {len(some)}."
            )
    turns = [Rotation.from_quat(e[some], scalar_first=True) for some in frames]
    if sigma is None:
        given = np.ones(3)
    else:
        given = sigma
    notes = []
    times = [track.t[rows] for rows in frames]
    measured = list(zip(times, turns))
    fitted = [fit_turning(t, turn, given, inertia) for t, turn in measured]
    if sigma is None:  # each flight takes two values of each axis
        squares = [(rest**2).sum(axis=0) for _, rest in fitted]
        count = sum(map(len, frames)) - 2 * len(frames)
        given = np.sqrt(sum(squares) / max(count, 1))
        rounding = np.finfo(float).eps ** 0.5
        given = np.maximum(given, rounding)
        fitted = [fit_turning(t, turn, given, inertia) for t, turn in measured]
        jitter = noise(track.t, turns_since_first(e))
        notes = findings_of_noise(jitter, given, first=4)
    of_fits = [flight for flight, _ in fitted]
    arcs, flights, covariance, p_values = _met(track, of_fits)
    residual = np.full((len(e), 3), np.nan)
    for flight, rows, (t, turn) in zip(flights, frames, measured):
        to_measured = flight.at(t).turn.inv() * turn
        residual[rows] = to_measured.as_rotvec() / given
    of_all = np.hstack([track.residual, residual])
    arcs = replace(arcs, residual=of_all)
    # meetings give back three, for half an instant
    taken = 6 * len(flights) - 2 * len(p_values)
    notes += findings_of_turns(e, given, residual, p_values, taken)
    return replace(
        _with_velocities(track, arcs, flights, covariance),
        sigma=np.concatenate([track.sigma, given]),
        warnings=(*track.warnings, *notes),
        units=(LINEAR,) * 3 + (ANGULAR,) * 3,
        q=np.hstack([track.q, e]),
    )


def _met(
    track: Track, flights: list[Turning]
) -> tuple[Arcs, list[Turning], np.ndarray, np.ndarray]:
    """Arcs and rotations whose orientations meet at impacts, their covariance, p-values
    (K,).

    K impacts lie between K + 1 flights. The values x are those of the arcs, then of
    each flight its turn and angular velocity (3 + 3), as `Turning.moved` takes their
    changes.

    Equation: with the values x_0 of the fits, their covariance C and the turns g(x)
    between the flights of each impact, the least `(x - x_0)^T C^-1 (x - x_0)` with g =
    0:
    `x - x_0 = C H^T S^-1 (H (x - x_0) - g)`, H = dg/dx, `S = H C H^T`, repeated;
    covariance `C - C H^T S^-1 H C`. The p-value of an impact is that of chi^2 = g S^-1
    g of its turn at x_0.
    """
    first = track.arcs
    impacts = first.impacts
    # values of the arcs: places and instant of each end, acceleration
    free = len(first.covariance)
    of_flights = (flight.covariance for flight in flights)
    C = block_diag(first.covariance, *of_flights)
    change = np.zeros(len(C))
    arcs = first
    turned = flights
    p_values = np.ones(impacts)
    if not impacts:
        return arcs, turned, C, p_values
    for k in range(MEETINGS):
        apart, H = _apart(arcs, turned, track.t.mean(), free)
        S = H @ C @ H.T
        if k == 0:
            of_impacts = zip(apart.reshape(-1, 3), diagonal_blocks(S, 3))
            squares = [x @ np.linalg.solve(A, x) for x, A in of_impacts]
            p_values = np.array([chi2.sf(square, 3) for square in squares])
        multipliers = np.linalg.solve(S, H @ change - apart)
        change = C @ H.T @ multipliers
        arcs = first.changed(change[:free])
        changes = change[free:].reshape(-1, 6)
        turned = [flight.moved(x) for flight, x in zip(flights, changes)]
    taken = C @ H.T @ np.linalg.solve(S, H @ C)
    return arcs, turned, C - taken, p_values


def _apart(
    arcs: Arcs, flights: list[Turning], zero: float, free: int
) -> tuple[np.ndarray, np.ndarray]:
    """Turns g (3K,) [rad] from the flight before each impact to that after it, and H =
    dg/dx.

    Columns of H: `free` values of the arcs, those of each end first; then 6 of each
    flight (turn, omega). `zero`: time of the zero of instants [s].
    """
    impacts = len(flights) - 1
    apart = np.zeros(3 * impacts)
    values = free + 6 * len(flights)
    H = np.zeros((3 * impacts, values))
    columns = arcs.rows_of_instants()
    for i, instant in enumerate(arcs.instants_of_impacts + zero):
        rows = slice(3 * i, 3 * i + 3)
        own = free + 6 * i
        of_earlier = slice(own, own + 6)
        of_later = slice(own + 6, own + 12)
        at_instant = np.array([instant])
        earlier = flights[i].at(at_instant)
        later = flights[i + 1].at(at_instant)
        between = earlier.turn[0].inv() * later.turn[0]
        apart[rows] = between.as_rotvec()
        H[rows, of_earlier] = -between.as_matrix().T @ earlier.turn_slopes[0]
        H[rows, of_later] = later.turn_slopes[0]
        H[rows, columns[i]] = later.omega[0] - earlier.omega[0]
    return apart, H


def _with_velocities(
    track: Track, arcs: Arcs, flights: list[Turning], covariance: np.ndarray
) -> Track:
    """Track whose impacts have velocities (x', omega) of these arcs and rotations.

    Equation: covariance `G C G^T` of (v-, v+, pose) of all impacts, G the derivatives
    in the values of arcs and flights; `covariance` is C. An instant moves omega by
    omega', and the orientation by omega, turns about the axes of the body.
    """
    free = len(arcs.covariance)
    before, after = arcs.velocities()
    impacts = len(before)
    gain = np.zeros((impacts, 3, 6, len(covariance)))
    by_column = gain.swapaxes(2, 3)
    of_places = place_of(by_column)  # views of it
    of_turns = turning_of(by_column)
    with_places = arcs.gain_with_places()
    of_places[:, :, :free] = with_places.swapaxes(2, 3)
    rows = arcs.rows_of_instants()
    times = arcs.instants_of_impacts + track.t.mean()
    poses = []
    omegas = np.zeros((impacts, 2, 3))
    for k, instant in enumerate(times):
        for side in (0, 1):
            flight = flights[k + side]
            first = free + 6 * (k + side)
            there = flight.at(np.array([instant]))
            omega = there.omega[0]
            turn_slopes = there.turn_slopes[0]
            omegas[k, side] = omega
            values = slice(first, first + 6)
            of_turns[k, side, values] = there.omega_slopes[0].T
            of_turns[k, side, rows[k]] = flight.rate(omega)
            if side == 0:
                of_turns[k, -1, values] = turn_slopes.T
                of_turns[k, -1, rows[k]] = omega
                quaternion = there.turn[0].as_quat(scalar_first=True)
                place = arcs.places[k + 1]
                poses.append(np.concatenate([place, quaternion]))
    flat = gain.reshape(18 * impacts, len(covariance))
    with_poses = flat @ covariance @ flat.T
    numbers = np.arange(18 * impacts).reshape(impacts, 3, 6)
    velocities = numbers[:, :-1].ravel()  # before and after, without the poses
    whole = with_poses[np.ix_(velocities, velocities)]
    found = []
    for k, (instant, pose) in enumerate(zip(times, poses)):
        own = slice(12 * k, 12 * (k + 1))
        omega_before, omega_after = omegas[k]
        pre = np.append(before[k], omega_before)
        post = np.append(after[k], omega_after)
        row = rows[k]
        error = float(np.sqrt(covariance[row, row]))
        doubt = track.impacts[k].doubtful
        of_impact = whole[own, own]
        impact = TrackImpact(float(instant), error, pose, pre, post, of_impact, doubt)
        found.append(impact)
    return replace(
        track,
        impacts=tuple(found),
        covariance=whole,
        arcs=arcs,
        covariance_with_poses=with_poses,
    )
