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
    frames = [some[np.isfinite(e[some, 0])] for some in track.flights]
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
    fitted = [fit_turning(track.t[f], r, given, inertia) for f, r in zip(frames, turns)]
    if sigma is None:  # each flight takes two values of each axis
        square = sum((rest**2).sum(axis=0) for _, rest in fitted)
        given = np.sqrt(square / max(sum(map(len, frames)) - 2 * len(frames), 1))
        given = np.maximum(given, np.finfo(float).eps ** 0.5)
        fitted = [
            fit_turning(track.t[f], r, given, inertia) for f, r in zip(frames, turns)
        ]
        notes = findings_of_noise(noise(track.t, turns_since_first(e)), given, first=4)
    arcs, flights, covariance, p_values = _met(track, [flight for flight, _ in fitted])
    residual = np.full((len(e), 3), np.nan)
    for flight, some, measured in zip(flights, frames, turns):
        residual[some] = (
            flight.at(track.t[some]).turn.inv() * measured
        ).as_rotvec() / given
    arcs = replace(arcs, residual=np.hstack([track.residual, residual]))
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
    impacts = len(track.arcs.instants) - 2
    # values of the arcs: places and instant of each end, acceleration
    free = len(first.covariance)
    C = block_diag(first.covariance, *(flight.covariance for flight in flights))
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
            each = apart.reshape(-1, 3), diagonal_blocks(S, 3)
            p_values = np.array(
                [chi2.sf(x @ np.linalg.solve(A, x), 3) for x, A in zip(*each)]
            )
        change = C @ H.T @ np.linalg.solve(S, H @ change - apart)
        arcs = first.changed(change[:free])
        turned = [f.moved(x) for f, x in zip(flights, change[free:].reshape(-1, 6))]
    return arcs, turned, C - C @ H.T @ np.linalg.solve(S, H @ C), p_values


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
    H = np.zeros((3 * impacts, free + 6 * len(flights)))
    columns = arcs.rows_of_instants()
    for i, instant in enumerate(arcs.instants_of_impacts + zero):
        rows = slice(3 * i, 3 * i + 3)
        own = free + 6 * i
        before, after = (
            flight.at(np.array([instant])) for flight in flights[i : i + 2]
        )
        between = before.turn[0].inv() * after.turn[0]
        apart[rows] = between.as_rotvec()
        H[rows, own : own + 6] = -between.as_matrix().T @ before.turn_slopes[0]
        H[rows, own + 6 : own + 12] = after.turn_slopes[0]
        H[rows, columns[i]] = after.omega[0] - before.omega[0]
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
    of_places[:, :, :free] = arcs.gain_with_places().swapaxes(2, 3)
    rows = arcs.rows_of_instants()
    times = arcs.instants_of_impacts + track.t.mean()
    poses = []
    omegas = np.zeros((impacts, 2, 3))
    for k, instant in enumerate(times):
        for side in (0, 1):
            flight = flights[k + side]
            first = free + 6 * (k + side)
            at = flight.at(np.array([instant]))
            omegas[k, side] = at.omega[0]
            values = slice(first, first + 6)
            of_turns[k, side, values] = at.omega_slopes[0].T
            of_turns[k, side, rows[k]] = flight.rate(at.omega[0])
            if side == 0:
                of_turns[k, -1, values] = at.turn_slopes[0].T
                of_turns[k, -1, rows[k]] = at.omega[0]
                quaternion = at.turn[0].as_quat(scalar_first=True)
                poses.append(np.concatenate([arcs.places[k + 1], quaternion]))
    flat = gain.reshape(18 * impacts, len(covariance))
    with_poses = flat @ covariance @ flat.T
    numbers = np.arange(18 * impacts).reshape(impacts, 3, 6)
    velocities = numbers[:, :-1].ravel()  # before and after, without the poses
    whole = with_poses[np.ix_(velocities, velocities)]
    found = []
    for k, (instant, pose) in enumerate(zip(times, poses)):
        own = slice(12 * k, 12 * (k + 1))
        pre, post = (np.append(v[k], w) for v, w in zip((before, after), omegas[k]))
        error = float(np.sqrt(covariance[rows[k], rows[k]]))
        doubt = track.impacts[k].doubtful
        found.append(
            TrackImpact(float(instant), error, pose, pre, post, whole[own, own], doubt)
        )
    return replace(
        track,
        impacts=tuple(found),
        covariance=whole,
        arcs=arcs,
        covariance_with_poses=with_poses,
    )
