"""What forces that depend on velocity add to a ballistic arc between the same ends.

With `a = g - k |v| v + f(v)` a flight is the arc of g plus D, `D'' = -k |v| v + f(v)`,
D = 0 at both ends. D'' is a polynomial through Chebyshev points, found by Picard's
iteration.
"""

from collections.abc import Callable

import numpy as np
from numpy.polynomial import chebyshev
from scipy.integrate import cumulative_trapezoid

# Chebyshev points of a flight. |v| v has a bend where a ball turns: with 24 D is within
# 1e-4 of its size. Ten times more is not seen beside noise.
NODES = 24
ROUNDS = 60  # of Picard; each gains a factor of about 2 / (k |v| h), h the duration
SETTLED = 1e-12  # of the length of a flight; ten times more is still far below noise
# of that length, by which a flight may still move after all ROUNDS; ten times more is
# the noise of good cameras
ALMOST_SETTLED = 1e-6
DIVERGED = 1e6  # lengths of a flight; ten times more would still be far from overflow
# Share of a length, a duration, an acceleration, by which difference quotients move.
# Ten times more makes errors of D of 1e-3 in slopes, which are small beside those of
# the arc.
STEP = 1e-4

_POINTS = chebyshev.chebpts1(NODES)
_FIT = np.linalg.inv(chebyshev.chebvander(_POINTS, NODES - 1))


def _twice_integrated() -> np.ndarray:
    """Matrix (NODES + 2, NODES) from Chebyshev coefficients of D'' to those of D, D(-1)
    = D(1) = 0.

    The line through the ends of the second integral is taken away: coefficients 0 and
    1.
    """
    integrals = chebyshev.chebint(np.eye(NODES), 2)
    left = chebyshev.chebval(-1.0, integrals)
    right = chebyshev.chebval(1.0, integrals)
    integrals[0] -= (left + right) / 2
    integrals[1] -= (right - left) / 2
    return integrals


# Matrices from values of D'' at the points: to coefficients of D and of D', to D' at
# the points and at both ends
_TWICE = _twice_integrated() @ _FIT
_ONCE = chebyshev.chebder(_TWICE)
_RATES = chebyshev.chebvander(_POINTS, NODES) @ _ONCE
_END_RATES = chebyshev.chebvander(np.array([-1.0, 1.0]), NODES) @ _ONCE


def bent(
    x: np.ndarray,
    tau: np.ndarray,
    places: np.ndarray,
    a: np.ndarray,
    k: np.ndarray,
    force: Callable[..., np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Deviation D (B, F, n) [m] of B flights by drag at times x (F,), D' at both ends
    (B, 2, n).

    Equation: `D'' = -k |v| v + f(v)`, v the velocity of the arc without drag plus D',
    at Chebyshev points; Picard: D'' from the last D'.

    Args:
        x: times (F,).
        tau: of both ends (B, 2).
        places: there (B, 2, n).
        a: acceleration without drag (B, n).
        k: drag (B,) [1/m].
        force: f, of velocities (B, N, n), times (B, N) and ends (B, 2) of flights.

    Raises:
        ValueError: drag bends flights too much for the iteration.
    """
    h = np.diff(tau)[:, :, None]
    chord = np.diff(places, axis=1)
    # velocity of the arc at the points
    steady = a[:, None] * h / 2
    arc = chord / h + steady * _POINTS[:, None]
    middle = tau.mean(axis=1)[:, None]
    times = middle + h[:, :, 0] / 2 * _POINTS
    slowing = np.zeros_like(arc)
    length = np.abs(arc).max() * h.max()
    for _ in range(ROUNDS):
        v = arc + h / 2 * (_RATES @ slowing)
        speed = np.linalg.norm(v, axis=2, keepdims=True)
        new = -k[:, None, None] * speed * v
        if force is not None:
            new = new + force(v, times, tau)
        largest = np.abs(new - slowing).max()
        moved = largest * h.max() ** 2
        slowing = new
        if not SETTLED * length < moved < DIVERGED * length:
            break
    if not moved <= ALMOST_SETTLED * length:
        raise ValueError(
            f"Argument `drag` must be a coefficient [1/m], `acceleration` a function, "
            f"that bends flights little, but drag {float(np.max(np.abs(k))):.3g} is "
            f"too much for a flight of {float(h.max()):.3g} s at "
            f"{float(np.linalg.norm(arc, axis=2).max()):.3g} m/s."
        )
    since = x - tau[:, :1]
    u = 2 * since / h[:, 0] - 1
    twice = chebyshev.chebvander(u, NODES + 1)
    D = (h / 2) ** 2 * (twice @ (_TWICE @ slowing))
    return D, h / 2 * (_END_RATES @ slowing)


def bent_slopes(
    x: np.ndarray,
    tau: np.ndarray,
    places: np.ndarray,
    a: np.ndarray,
    k: float,
    force: Callable[..., np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives (F, n, P) of D and (2, n, P) of D' at the ends of one flight.

    In P = 3 n + 3 values: place and instant of the first end, of the last one,
    acceleration, drag. By difference quotients: all P + 1 flights at once, each with
    one value moved.
    """
    n = len(a)
    h = tau[1] - tau[0]
    way = np.linalg.norm(places[1] - places[0])
    length = way + np.linalg.norm(a) * h**2 / 2
    if not (length > 0):
        length = 1.0
    end = [length] * n + [h]
    of_acceleration = [length / h**2] * n
    sizes = STEP * np.array(end + end + of_acceleration + [1 / length])
    none = np.zeros(len(sizes))
    moves = np.vstack([none, np.diag(sizes)])
    first, last, rest = np.split(moves, [n + 1, 2 * n + 2], axis=1)
    moved_tau = np.stack([first[:, n], last[:, n]], axis=1)
    moved_places = np.stack([first[:, :n], last[:, :n]], axis=1)
    moved_a = a + rest[:, :n]
    moved_k = k + rest[:, n]
    D, rates = bent(x, tau + moved_tau, places + moved_places, moved_a, moved_k, force)

    def slopes(values: np.ndarray) -> np.ndarray:
        """Difference quotients (.., P) of values, the first ones not moved."""
        changes = values[1:] - values[0]
        return np.moveaxis(changes, 0, 2) / sizes

    of_places = slopes(D)
    of_rates = slopes(rates)
    return of_places, of_rates


def straightened(
    t: np.ndarray, q: np.ndarray, air: Callable[..., np.ndarray]
) -> np.ndarray:
    """Places (T, n) [m] as they were without the acceleration `air(v, t)`:
    `q - int int air(v, t)`.

    Up to lines. Velocities are those over four frames: good enough to find flights;
    near an impact they are wrong, but only for two frames.
    """
    whole = between(t, t, q)
    frames = np.arange(len(t))
    low = np.maximum(frames - 2, 0)
    high = np.minimum(frames + 2, len(t) - 1)
    way = whole[high] - whole[low]
    duration = t[high] - t[low]
    v = way / duration[:, None]
    faster = cumulative_trapezoid(air(v, t), t, axis=0, initial=0)
    return q - cumulative_trapezoid(faster, t, axis=0, initial=0)


def between(times: np.ndarray, t: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Places (F, n) at `times` (F,), linear between those frames (t, q) that were
    seen.
    """
    seen = np.isfinite(q)
    pairs = zip(q.T, seen.T)
    columns = [np.interp(times, t[ok], x[ok]) for x, ok in pairs]
    return np.stack(columns, axis=1)
