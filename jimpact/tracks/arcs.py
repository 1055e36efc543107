"""Ballistic arcs through common points: flights and instants of all impacts at once.

Between the instants tau_i and tau_(i+1) of two impacts the places are
`P_i (1 - s) + P_(i+1) s - a (t - tau_i) (tau_(i+1) - t) / 2`, s = (t - tau_i) / h, h the duration:
v+ = (P_(i+1) - P_i) / h - a h / 2 after the first, v- = (P_(i+1) - P_i) / h + a h / 2 before the
second. Places and instants are found by Gauss-Newton; an arc meets its neighbours only, so that the
normal matrix is banded.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.linalg import solveh_banded

STEPS = 60  # of Gauss-Newton; 5 are common. More are not, as frames change flights by turns.
SETTLING = 20  # steps after which frames stay in their flights
# Frames that an instant may lie within the flights that were found, as a frame near an impact may
# lie on either arc. Ten times more, and the instant of a jump that is none would run away.
BEYOND = 3
# Share of a flight by which an instant moves in a step, below one half, so that two never meet.
LARGEST_MOVE = 0.45
# Share of a frame below which the instants have settled. Ten times more is still far below noise.
SETTLED = 1e-7


@dataclass(frozen=True)
class Arcs:
    """Arcs between K + 2 ends, of which the first and the last are no impacts.

    Fields: instants (K + 2,), places (K + 2, n), acceleration (n,); covariance of (places, instant)
    of each end in turn, then of the acceleration if it is free; members: frames of each flight;
    residual (T, n) in units of sigma, NaN where no frame was used.
    """

    instants: np.ndarray
    places: np.ndarray
    acceleration: np.ndarray
    covariance: np.ndarray
    members: list[np.ndarray]
    residual: np.ndarray

    def velocities(self) -> tuple[np.ndarray, np.ndarray]:
        """v- (K, n) and v+ (K, n) of each impact."""
        h = np.diff(self.instants)
        mean, bend = np.diff(self.places, axis=0) / h[:, None], self.acceleration / 2
        return mean[:-1] + bend * h[:-1, None], mean[1:] - bend * h[1:, None]

    def gain(self) -> np.ndarray:
        """Derivatives (K, 2, n, N) of v- and v+ in the N values of `covariance`."""
        K, n = len(self.instants) - 2, self.places.shape[1]
        h = np.diff(self.instants)
        mean, bend = np.diff(self.places, axis=0) / h[:, None], self.acceleration / 2
        gain, size = np.zeros((K, 2, n, len(self.covariance))), n + 1
        for k in range(K):
            for side, sign in ((0, 1.0), (1, -1.0)):
                i = k + side  # the flight
                slope = mean[i] / h[i] - sign * bend  # of the velocity in -h
                for c in range(n):
                    row = gain[k, side, c]
                    row[i * size + c], row[(i + 1) * size + c] = -1 / h[i], 1 / h[i]
                    row[i * size + n], row[(i + 1) * size + n] = slope[c], -slope[c]
                    if len(row) > (K + 2) * size:
                        row[(K + 2) * size + c] = sign * h[i] / 2
        return gain

    def covariance_of_velocities(self) -> np.ndarray:
        """(2nK, 2nK), of (v-, v+) of each impact in turn."""
        flat = self.gain().reshape(-1, len(self.covariance))
        return flat @ self.covariance @ flat.T


def fit_arcs(
    t: np.ndarray,
    q: np.ndarray,
    sigma: np.ndarray,
    flights: list[np.ndarray],
    acceleration: np.ndarray,
    free: bool,
    contact: float,
    instants: np.ndarray | None = None,
    frozen: bool = False,
) -> Arcs:
    """The arcs of these flights by maximum likelihood.

    Args:
        t: (T,) times.
        q: (T, n), NaN where lost.
        sigma: (n,).
        flights: frames of each.
        acceleration: known, or a first value.
        free: whether it is unknown.
        contact: duration of a contact, whose frames are left out.
        instants: first values for the impacts (K,).
        frozen: whether these stay, so that places alone are found.
    """
    pool, n = np.concatenate(flights), q.shape[1]
    if instants is None:
        instants = np.array([(t[f[-1]] + t[g[0]]) / 2 for f, g in pairwise(flights)])
    tau = np.concatenate([[t[pool[0]]], instants, [t[pool[-1]]]])
    last = np.array([t[f[-1]] for f in flights[:-1]])
    first = np.array([t[f[0]] for f in flights[1:]])
    places, a, step = np.zeros((len(tau), n)), acceleration.copy(), float(np.median(np.diff(t)))
    members, moving = _members(t, pool, tau, contact, flights), False
    for k in range(1 if frozen else STEPS):
        normal, change = _step(t, q, sigma, members, (tau, places, a), free, moving)
        new = tau + change[0]
        room = LARGEST_MOVE * np.diff(tau)
        new[1:-1] = np.clip(new[1:-1], tau[1:-1] - room[:-1], tau[1:-1] + room[1:])
        new[1:-1] = np.clip(new[1:-1], last - BEYOND * step, first + BEYOND * step)
        moved, moving = np.abs(new - tau).max(initial=0.0), True
        tau, places, a = new, places + change[1], a + change[2]
        if k < SETTLING and not frozen:
            members = _members(t, pool, tau, contact, flights)
        if k > 0 and moved <= SETTLED * step:
            break
    normal, _ = _step(t, q, sigma, members, (tau, places, a), free, not frozen)
    residual = np.full(q.shape, np.nan)
    for i, frames in enumerate(members):
        residual[frames] = (q[frames] - _arc(t[frames], i, tau, places, a)) / sigma
    ends = np.arange(len(tau))
    covariance = _inverse(*normal, free, ends if frozen else ends[[0, -1]])
    return Arcs(tau, places, a, covariance, members, residual)


def _members(
    t: np.ndarray, pool: np.ndarray, tau: np.ndarray, contact: float, flights: list[np.ndarray]
) -> list[np.ndarray]:
    """Frames between the instants, those in contact left out; as they were where few are left."""
    low = np.concatenate([[-np.inf], tau[1:-1] + contact / 2])
    high = np.concatenate([tau[1:-1] - contact / 2, [np.inf]])
    x = t[pool]
    inside = [pool[np.searchsorted(x, i) : np.searchsorted(x, j)] for i, j in zip(low, high)]
    return inside if min(map(len, inside)) >= 3 else flights


def _arc(x: np.ndarray, i: int, tau: np.ndarray, places: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Places (F, n) in flight i."""
    s = ((x - tau[i]) / (tau[i + 1] - tau[i]))[:, None]
    bend = ((x - tau[i]) * (tau[i + 1] - x) / 2)[:, None]
    return places[i] * (1 - s) + places[i + 1] * s - a * bend


Normal = tuple[np.ndarray, np.ndarray, np.ndarray]  # banded (upper), border (N, n), corner (n, n)


def _step(
    t: np.ndarray,
    q: np.ndarray,
    sigma: np.ndarray,
    members: list[np.ndarray],
    at: tuple[np.ndarray, np.ndarray, np.ndarray],
    free: bool,
    moving: bool,
) -> tuple[Normal, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """The normal matrix, and a step of Gauss-Newton of instants, places and acceleration.

    `moving`: whether instants are; places alone are a linear problem.
    """
    (tau, places, a), n = at, q.shape[1]
    size = n + 1
    whole = np.zeros((len(tau), 2 * size, 2 * size))  # of each flight
    border, corner = np.zeros((len(tau) * size, n)), np.zeros((n, n))
    right, right_a = np.zeros(len(tau) * size), np.zeros(n)
    for i, frames in enumerate(members):
        x, h = t[frames], tau[i + 1] - tau[i]
        s, bend = (x - tau[i]) / h, (x - tau[i]) * (tau[i + 1] - x) / 2
        rest = q[frames] - _arc(x, i, tau, places, a)
        for c in range(n):
            ok = np.isfinite(rest[:, c])
            u, rise = s[ok], (places[i + 1, c] - places[i, c]) / h
            first = -rise * (1 - u) + a[c] * (tau[i + 1] - x[ok]) / 2
            last = -rise * u - a[c] * (x[ok] - tau[i]) / 2
            J = np.stack([1 - u, first, u, last, -bend[ok]], axis=1) / sigma[c]
            square, gradient = J.T @ J, J.T @ (rest[ok, c] / sigma[c])
            local = np.array([c, n, size + c, size + n])
            rows = i * size + local
            whole[i][np.ix_(local, local)] += square[:4, :4]
            right[rows] += gradient[:4]
            border[rows, c] += square[:4, 4]
            corner[c, c], right_a[c] = corner[c, c] + square[4, 4], right_a[c] + gradient[4]
    instants = np.arange(len(tau)) * size + n
    fixed = instants[[0, -1]] if moving else instants
    normal = _banded(whole, len(tau), size, fixed), border, corner
    border[fixed], right[fixed] = 0.0, 0.0
    solved = _solve(normal, right, right_a, free)
    values = solved[0].reshape(len(tau), size)
    return normal, (values[:, n], values[:, :n], solved[1])


def _banded(whole: np.ndarray, ends: int, size: int, fixed: np.ndarray) -> np.ndarray:
    """The upper bands of the normal matrix; `fixed` parameters have 1 on the diagonal alone."""
    width, count = 2 * size - 1, ends * size
    bands = np.zeros((width + 1, count))
    for i in range(2 * size):
        for j in range(i, 2 * size):
            columns = np.arange(ends - 1) * size + j
            bands[width - (j - i), columns] += whole[: ends - 1, i, j]
    for k in fixed:
        for d in range(width + 1):
            bands[width - d, k] = 0.0
            if k + d < count:
                bands[width - d, k + d] = 0.0
        bands[width, k] = 1.0
    return bands


def _solve(
    normal: Normal, right: np.ndarray, right_a: np.ndarray, free: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Both parts of the step, by elimination of the banded one."""
    bands, border, corner = normal
    scale = 1 / np.sqrt(np.maximum(bands[-1], 1e-300))
    scaled = _scaled(bands, scale)
    if not free:
        return scale * solveh_banded(scaled, scale * right), np.zeros(len(right_a))
    both = np.column_stack([right, border])
    solved = scale[:, None] * solveh_banded(scaled, scale[:, None] * both)
    a = np.linalg.pinv(corner - border.T @ solved[:, 1:], hermitian=True) @ (
        right_a - border.T @ solved[:, 0]
    )
    return solved[:, 0] - solved[:, 1:] @ a, a


def _scaled(bands: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """The bands of S A S, S = diag(scale), so that units do not matter for rounding."""
    width, count = bands.shape[0] - 1, bands.shape[1]
    scaled = np.zeros_like(bands)
    for d in range(width + 1):
        scaled[width - d, d:] = bands[width - d, d:] * scale[d:] * scale[: count - d]
    return scaled


def _inverse(
    bands: np.ndarray, border: np.ndarray, corner: np.ndarray, free: bool, fixed: np.ndarray
) -> np.ndarray:
    """The covariance; `fixed` instants have none."""
    scale = 1 / np.sqrt(np.maximum(bands[-1], 1e-300))
    inverse = scale[:, None] * solveh_banded(_scaled(bands, scale), np.diag(scale))
    n = corner.shape[0]
    alone = fixed * (n + 1) + n
    inverse[alone, alone] = 0.0
    if not free:
        return (inverse + inverse.T) / 2
    own = np.linalg.pinv(corner - border.T @ inverse @ border, hermitian=True)
    cross = -inverse @ border @ own
    return np.block([[inverse - cross @ border.T @ inverse, cross], [cross.T, own]])
