"""Ballistic arcs through common points: flights and instants of all impacts at once.

Between the instants tau_i and tau_(i+1) of two impacts the places are
`P_i (1 - s) + P_(i+1) s - a (t - tau_i) (tau_(i+1) - t) / 2`, s = (t - tau_i) / h, h the duration:
v+ = (P_(i+1) - P_i) / h - a h / 2 after the first, v- = (P_(i+1) - P_i) / h + a h / 2 before the
second. Places and instants are found by Gauss-Newton; an arc meets its neighbours only, so that the
normal matrix is banded.

K impacts have K + 2 ends of K + 1 flights: the impacts, the first and the last frame. The unknowns
of the fit are (P_i, tau_i) of each end in turn, n + 1 values, then those of acceleration (n) and
drag (1) that are free. Slopes of one flight are in 3 n + 3 values: P_i, tau_i, P_(i+1), tau_(i+1),
a, k.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.linalg import solveh_banded

from jimpact.tracks.drag import bent, bent_slopes, between

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

    Fields: instants tau (K + 2,) [s], places P (K + 2, n) [m, rad], acceleration a (n,) [m/s^2],
    drag k [1/m]; free: (acceleration, drag), true for unknown ones; covariance of the unknowns;
    members: frames of each flight; residual (T, n) in units of sigma, NaN where no frame was used.
    """

    instants: np.ndarray
    places: np.ndarray
    acceleration: np.ndarray
    drag: float
    free: tuple[bool, bool]
    covariance: np.ndarray
    members: list[np.ndarray]
    residual: np.ndarray

    def velocities(self) -> tuple[np.ndarray, np.ndarray]:
        """Velocities v- (K, n) and v+ (K, n) [m/s, rad/s] of each impact, see the head of the file.

        Drag adds the end rates of `bent` to those of parabolas.
        """
        h = np.diff(self.instants)
        mean, bend = np.diff(self.places, axis=0) / h[:, None], self.acceleration / 2
        first, last = mean - bend * h[:, None], mean + bend * h[:, None]
        if self.drag:
            ends, both = _pairs(self.instants), _pairs(self.places)
            a, k = np.tile(self.acceleration, (len(h), 1)), np.full(len(h), self.drag)
            _, rates = bent(np.zeros(1), ends, both, a, k)
            first, last = first + rates[:, 0], last + rates[:, 1]
        return last[:-1], first[1:]

    def gain(self) -> np.ndarray:
        """Derivatives (K, 2, n, N) of v- and v+ in the N unknowns of `covariance`.

        Of a flight with duration h and mean velocity w: `v = w -/+ a h / 2` at its first and last
        end, w = (P_1 - P_0) / h, dw/dtau_1 = -w / h.
        """
        K, n = len(self.instants) - 2, self.places.shape[1]
        h, columns = np.diff(self.instants), _columns(n, self.free)
        mean, bend = np.diff(self.places, axis=0) / h[:, None], self.acceleration / 2
        gain, size = np.zeros((K, 2, n, len(self.covariance))), n + 1
        for i in range(K + 1):  # flight i has v+ of the impact before it, v- of the one after it
            slopes, each = np.zeros((2, n, 3 * n + 3)), np.arange(n)
            for end, sign in ((0, -1.0), (1, 1.0)):
                slope = mean[i] / h[i] - sign * bend  # of the velocity in -h
                slopes[end, each, each] = -1 / h[i]
                slopes[end, each, size + each] = 1 / h[i]
                slopes[end, :, n], slopes[end, :, size + n] = slope, -slope
                slopes[end, each, 2 * size + each] = sign * h[i] / 2
            if self.drag or self.free[1]:
                pair = slice(i, i + 2)
                where = (self.instants[pair], self.places[pair], self.acceleration, self.drag)
                slopes += bent_slopes(np.zeros(1), *where)[3]
            for k, side, end in ((i - 1, 1, 0), (i, 0, 1)):
                if 0 <= k < K:
                    gain[k, side, :, i * size : (i + 2) * size] = slopes[end, :, : 2 * size]
                    gain[k, side, :, (K + 2) * size :] = slopes[end][:, 2 * size + columns]
        return gain

    @property
    def drag_error(self) -> float:
        """Standard error of an unknown drag, 0 of a known one [1/m]."""
        return float(np.sqrt(self.covariance[-1, -1])) if self.free[1] else 0.0

    def covariance_of_velocities(self) -> np.ndarray:
        """Covariance `G C G^T` (2nK, 2nK) of (v-, v+) of each impact in turn, G of `gain`."""
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
    drag: float = 0.0,
    free_drag: bool = False,
) -> Arcs:
    """The arcs of these flights by maximum likelihood: least squares of (q - arc) / sigma.

    Gauss-Newton steps in places, instants and what is free, each instant bounded; after every step
    frames are divided among the flights anew.

    Args:
        t: (T,) times.
        q: (T, n), NaN where lost.
        sigma: (n,).
        flights: frames of each.
        acceleration: known, or a first value.
        free: whether it is unknown.
        drag: known, or a first value.
        free_drag: whether it is unknown.
        contact: duration of a contact, whose frames are left out.
        instants: first values for the impacts (K,).
        frozen: whether these stay, so that places alone are found.
    """
    pool = np.concatenate(flights)
    if instants is None:
        instants = np.array([(t[f[-1]] + t[g[0]]) / 2 for f, g in pairwise(flights)])
    tau = np.concatenate([[t[pool[0]]], instants, [t[pool[-1]]]])
    last = np.array([t[f[-1]] for f in flights[:-1]])
    first = np.array([t[f[0]] for f in flights[1:]])
    a, step, unknown = acceleration.copy(), float(np.median(np.diff(t))), (free, free_drag)
    places = between(tau, t, q)
    members, moving = _members(t, pool, tau, contact, flights), False
    for k in range(1 if frozen else STEPS):
        values = ArcValues(tau, places, a, drag)
        _, change = _step(t, q, sigma, members, values, unknown, moving)
        new = tau + change.tau
        room = LARGEST_MOVE * np.diff(tau)
        new[1:-1] = np.clip(new[1:-1], tau[1:-1] - room[:-1], tau[1:-1] + room[1:])
        new[1:-1] = np.clip(new[1:-1], last - BEYOND * step, first + BEYOND * step)
        moved, moving = np.abs(new - tau).max(initial=0.0), True
        tau, places = new, places + change.places
        a, drag = a + change.a, drag + change.drag
        if k < SETTLING and not frozen:
            members = _members(t, pool, tau, contact, flights)
        if k > 0 and moved <= SETTLED * step:
            break
    values = ArcValues(tau, places, a, drag)
    normal, _ = _step(t, q, sigma, members, values, unknown, not frozen)
    residual = np.full(q.shape, np.nan)
    for i, frames in enumerate(members):
        residual[frames] = (q[frames] - _arc(t[frames], i, values)) / sigma
    ends = np.arange(len(tau))
    covariance = _inverse(normal, ends if frozen else ends[[0, -1]])
    return Arcs(*values, unknown, covariance, members, residual)


def _pairs(x: np.ndarray) -> np.ndarray:
    """Neighbours (K - 1, 2, ..) of x (K, ..)."""
    return np.stack([x[:-1], x[1:]], axis=1)


def _columns(n: int, free: tuple[bool, bool]) -> np.ndarray:
    """Indices of the free ones among acceleration (n) and drag (1)."""
    return np.flatnonzero([free[0]] * n + [free[1]])


def _members(
    t: np.ndarray, pool: np.ndarray, tau: np.ndarray, contact: float, flights: list[np.ndarray]
) -> list[np.ndarray]:
    """Frames of each flight by the instants tau: those in contact, tau_i +/- contact / 2, are out.

    If a flight had less than 3 frames so, all of them stay as they are in `flights`.
    """
    low = np.concatenate([[-np.inf], tau[1:-1] + contact / 2])
    high = np.concatenate([tau[1:-1] - contact / 2, [np.inf]])
    x = t[pool]
    inside = [pool[np.searchsorted(x, i) : np.searchsorted(x, j)] for i, j in zip(low, high)]
    return inside if min(map(len, inside)) >= 3 else flights


class ArcValues(NamedTuple):
    """Values of all arcs, or a step in them."""

    tau: np.ndarray  # instants (K + 2,) [s]
    places: np.ndarray  # P (K + 2, n)
    a: np.ndarray  # acceleration (n,)
    drag: float  # k [1/m]


def _arc(x: np.ndarray, i: int, values: ArcValues) -> np.ndarray:
    """Places (F, n) of flight i at times x (F,).

    Equation: `P_i (1 - s) + P_(i+1) s - a (x - tau_i) (tau_(i+1) - x) / 2`, and D of `bent`.
    """
    tau, places, a, drag = values
    s = ((x - tau[i]) / (tau[i + 1] - tau[i]))[:, None]
    bend = ((x - tau[i]) * (tau[i + 1] - x) / 2)[:, None]
    arc = places[i] * (1 - s) + places[i + 1] * s - a * bend
    if drag:
        pair = slice(i, i + 2)
        arc += bent(x, tau[None, pair], places[None, pair], a[None], np.array([drag]))[0][0]
    return arc


def _slopes(x: np.ndarray, i: int, values: ArcValues, with_drag: bool) -> np.ndarray:
    """Derivatives (F, n, 3 n + 3) of `_arc` in the ends of flight i, acceleration and drag."""
    (tau, places, a, drag), n = values, values.places.shape[1]
    h, each, size = tau[i + 1] - tau[i], np.arange(n), n + 1
    s, slopes = (x - tau[i]) / h, np.zeros((len(x), n, 3 * n + 3))
    rise = (places[i + 1] - places[i]) / h
    slopes[:, each, each], slopes[:, each, size + each] = (1 - s)[:, None], s[:, None]
    slopes[:, :, n] = -rise * (1 - s)[:, None] + a * (tau[i + 1] - x)[:, None] / 2
    slopes[:, :, size + n] = -rise * s[:, None] - a * (x - tau[i])[:, None] / 2
    slopes[:, each, 2 * size + each] = -((x - tau[i]) * (tau[i + 1] - x) / 2)[:, None]
    if with_drag:
        slopes += bent_slopes(x, tau[i : i + 2], places[i : i + 2], a, drag)[2]
    return slopes


class NormalMatrix(NamedTuple):
    """Normal matrix J^T J of the fit: banded for the ends (N values), bordered by b common ones."""

    bands: np.ndarray  # (width + 1, N) upper bands, as `scipy.linalg.solveh_banded` takes them
    border: np.ndarray  # (N, b)
    corner: np.ndarray  # (b, b)


def _step(
    t: np.ndarray,
    q: np.ndarray,
    sigma: np.ndarray,
    members: list[np.ndarray],
    values: ArcValues,
    free: tuple[bool, bool],
    moving: bool,
) -> tuple[NormalMatrix, ArcValues]:
    """Normal matrix at these values, and the Gauss-Newton step from them.

    Equation: `J^T J step = J^T r`, r = (q - arc) / sigma over frames that were seen, J the
    derivatives of arc / sigma. Instants stay unless `moving`, those of the first and the last end
    always. `members`: frames of each flight; `free`: acceleration, drag are unknown.
    """
    (tau, *_, drag), n = values, q.shape[1]
    size, columns = n + 1, _columns(n, free)
    blocks = np.zeros((len(tau), 2 * size, 2 * size))  # J^T J of each flight in its two ends
    border = np.zeros((len(tau) * size, len(columns)))
    corner, right_b = np.zeros((len(columns), len(columns))), np.zeros(len(columns))
    right = np.zeros(len(tau) * size)
    used = np.concatenate([np.arange(2 * size), 2 * size + columns])  # of the 3 n + 3 slopes
    for i, frames in enumerate(members):
        x = t[frames]
        rest = (q[frames] - _arc(x, i, values)) / sigma
        slopes = _slopes(x, i, values, bool(drag) or free[1])[:, :, used] / sigma[:, None]
        ok = np.isfinite(rest)
        J, rows = slopes[ok], slice(i * size, (i + 2) * size)
        square, gradient = J.T @ J, J.T @ rest[ok]
        blocks[i] = square[: 2 * size, : 2 * size]
        right[rows] += gradient[: 2 * size]
        border[rows] += square[: 2 * size, 2 * size :]
        corner, right_b = corner + square[2 * size :, 2 * size :], right_b + gradient[2 * size :]
    instants = np.arange(len(tau)) * size + n
    fixed = instants[[0, -1]] if moving else instants
    normal = NormalMatrix(_banded(blocks, len(tau), size, fixed), border, corner)
    border[fixed], right[fixed] = 0.0, 0.0
    solved, common = _solve(normal, right, right_b)
    of_ends, shared = solved.reshape(len(tau), size), np.zeros(n + 1)
    shared[columns] = common
    return normal, ArcValues(of_ends[:, n], of_ends[:, :n], shared[:n], float(shared[n]))


def _banded(blocks: np.ndarray, ends: int, size: int, fixed: np.ndarray) -> np.ndarray:
    """Upper bands (2 size, ends size) of the sum of the blocks of neighbouring ends.

    Row `width - d` holds the d-th diagonal above the main one. Unknowns `fixed` keep 1 on the
    diagonal, and 0 elsewhere.
    """
    width, count = 2 * size - 1, ends * size
    bands = np.zeros((width + 1, count))
    for i in range(2 * size):
        for j in range(i, 2 * size):
            columns = np.arange(ends - 1) * size + j
            bands[width - (j - i), columns] += blocks[: ends - 1, i, j]
    for k in fixed:
        for d in range(width + 1):
            bands[width - d, k] = 0.0
            if k + d < count:
                bands[width - d, k + d] = 0.0
        bands[width, k] = 1.0
    return bands


def _solve(
    normal: NormalMatrix, right: np.ndarray, right_b: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Solution (x (N,), y (b,)) of the bordered system, by elimination of x.

    Equation: `A x + B y = right`, `B^T x + C y = right_b`: `(C - B^T A^-1 B) y = right_b - B^T A^-1
    right`. A has the bands, B is the border, C the corner.
    """
    bands, border, corner = normal
    scale = 1 / np.sqrt(np.maximum(bands[-1], 1e-300))
    both = np.column_stack([right, border])
    solved = scale[:, None] * solveh_banded(_scaled(bands, scale), scale[:, None] * both)
    common = np.linalg.pinv(corner - border.T @ solved[:, 1:], hermitian=True) @ (
        right_b - border.T @ solved[:, 0]
    )
    return solved[:, 0] - solved[:, 1:] @ common, common


def _scaled(bands: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Bands of `S A S`, S = diag(scale), so that units do not matter for rounding."""
    width, count = bands.shape[0] - 1, bands.shape[1]
    scaled = np.zeros_like(bands)
    for d in range(width + 1):
        scaled[width - d, d:] = bands[width - d, d:] * scale[d:] * scale[: count - d]
    return scaled


def _inverse(normal: NormalMatrix, fixed: np.ndarray) -> np.ndarray:
    """Covariance: inverse of the normal matrix by blocks; instants of `fixed` ends have variance 0.

    Equation: with `R = (C - B^T A^-1 B)^-1` it is
    `[[A^-1 + A^-1 B R B^T A^-1, -A^-1 B R], [-R B^T A^-1, R]]`.
    """
    bands, border, corner = normal
    scale = 1 / np.sqrt(np.maximum(bands[-1], 1e-300))
    inverse = scale[:, None] * solveh_banded(_scaled(bands, scale), np.diag(scale))
    size = len(bands) // 2
    alone = fixed * size + size - 1
    inverse[alone, alone] = 0.0
    if not corner.size:
        return (inverse + inverse.T) / 2
    own = np.linalg.pinv(corner - border.T @ inverse @ border, hermitian=True)
    cross = -inverse @ border @ own
    return np.block([[inverse - cross @ border.T @ inverse, cross], [cross.T, own]])
