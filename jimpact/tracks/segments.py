"""Flights of a track: the cheapest partition of its frames into ballistic flights and lost ones.

A flight is a straight line in each coordinate once its acceleration is taken away. Its cost is
chi^2 and a price for beginning one; dynamic programming finds the partition of least cost (Jackson
et al., IEEE Signal Processing Letters 12, 2005).
"""

from itertools import pairwise

import numpy as np
from scipy.stats import chi2

from jimpact.tracks.drag import straightened

# A frame that fits no flight costs what one good frame in so many exceeds. Ten times more would
# keep more false points in flights, ten times less would lose more good frames.
LOST_SHARE = 1e-3
# Jump of a velocity, in standard errors, from which on it is an impact. Ten times more would miss
# soft impacts; of noise alone five or more is found once in a million.
SMALLEST_JUMP = 5.0
# Frames of a flight that the partition looks back over, so that its time is linear in the frames.
# Longer flights are parted, and joined again. Ten times more takes ten times as long.
LOOK_BACK = 400
# Share of the extent of a track below which noise is not looked for: positions with that many
# digits. Ten times less would lose digits of chi^2 to rounding in flights of LOOK_BACK frames.
LEAST_NOISE = 1e-7
ROUNDS = 4  # of flights and one unknown acceleration in turn; both have settled in two


def noise(q: np.ndarray) -> np.ndarray:
    """Standard errors (n,) of positions (T, n), from their third differences.

    They vanish for a constant acceleration; the median of their sizes, times 1.4826 (normal
    errors), does not see the few at impacts. The variance of a third difference is 20 sigma^2.
    """
    sizes = np.array([_median(np.abs(_differences(x, 3))) for x in q.T])
    extent = (np.nanmax(q, axis=0) - np.nanmin(q, axis=0)).max()
    least = LEAST_NOISE * (extent if extent > 0 else 1.0)  # where nothing moves any is little
    return np.maximum(1.4826 * sizes / np.sqrt(20), least)


def _differences(x: np.ndarray, order: int, step: int = 1) -> np.ndarray:
    """Differences of this order, over `step` frames, of positions (T,), without those that are NaN.

    Where all are, as every other frame is lost, differences of the frames that were seen.
    """

    def all_of(x: np.ndarray) -> np.ndarray:
        """Differences of x that are not NaN."""
        for _ in range(order):
            x = x[step:] - x[:-step]
        return x[np.isfinite(x)]

    found = all_of(x)
    return found if found.size else all_of(x[np.isfinite(x)])


def _median(x: np.ndarray) -> float:
    """The median; 0 of nothing."""
    return float(np.median(x)) if x.size else 0.0


def price(frames: int, n: int) -> float:
    """Price of a flight in chi^2: `(2n + 1) ln T` (BIC of 2n values and an instant) of T `frames`.

    At least `SMALLEST_JUMP^2`.
    """
    return max(float((2 * n + 1) * np.log(frames)), SMALLEST_JUMP**2)


def flights_of(
    t: np.ndarray, q: np.ndarray, sigma: np.ndarray, acceleration: np.ndarray, shortest: int
) -> list[np.ndarray]:
    """Frames of each flight of the cheapest partition, neighbours joined where that is cheaper.

    A flight has at least `shortest` frames seen in every coordinate.
    """
    _, come = _partition(t, q, sigma, acceleration, shortest)
    ends = [len(q)]
    while ends[-1] > 0:
        ends.append(int(come[ends[-1]]))
    pairs = list(zip(ends[1:], ends))[::-1]
    flights = [np.arange(i, j) for i, j in pairs if j - i >= shortest]
    return _joined(t, q, sigma, acceleration, flights, price(*q.shape))


def cost_of_flights(
    t: np.ndarray, q: np.ndarray, sigma: np.ndarray, acceleration: np.ndarray, shortest: int
) -> float:
    """Cost of the cheapest partition: chi^2, the prices of flights and of lost frames."""
    return float(_partition(t, q, sigma, acceleration, shortest)[0][-1])


def _partition(
    t: np.ndarray, q: np.ndarray, sigma: np.ndarray, acceleration: np.ndarray, shortest: int
) -> tuple[np.ndarray, np.ndarray]:
    """Least cost (T + 1,) of the first j frames, and the frame at which their last part begins.

    Equation: `best_j = min(best_(j-1) + lost, min_i best_i + price + chi^2(i..j))`: frame j is
    lost, or the last one of a flight from i; dynamic programming.
    """
    frames, n = q.shape
    good = np.isfinite(q)
    lost, start = chi2.isf(LOST_SHARE, n) * good.any(axis=1), price(frames, n)
    best, come = np.zeros(frames + 1), np.zeros(frames + 1, int)
    for j in range(1, frames + 1):
        best[j], come[j] = best[j - 1] + lost[j - 1], j - 1
        if j < shortest:
            continue
        first = max(0, j - LOOK_BACK)
        costs = _costs(t[first:j], q[first:j], good[first:j], sigma, acceleration, shortest)
        total = costs[: j - first] + best[first:j]
        k = int(np.argmin(total))
        if total[k] + start < best[j]:
            best[j], come[j] = total[k] + start, first + k
    return best, come


def _costs(
    t: np.ndarray,
    q: np.ndarray,
    good: np.ndarray,
    sigma: np.ndarray,
    acceleration: np.ndarray,
    shortest: int,
) -> np.ndarray:
    """chi^2 (L,) of one flight from each of L frames to the last one; inf where too short.

    Equation: of a line through y = (q - a t^2 / 2) / sigma in every coordinate,
    `S_yy - S_y^2 / S - (S_xy - S_x S_y / S)^2 / (S_xx - S_x^2 / S)`, S sums from the last frame on.
    `good` (L, n): seen frames.
    """
    x = (t - t[-1])[::-1, None]
    y = (q[::-1] - np.where(good, q, 0.0).sum(axis=0) / np.maximum(good.sum(axis=0), 1)) / sigma
    y = np.where(good[::-1], y - acceleration / sigma * x**2 / 2, 0.0)
    w = good[::-1].astype(float)
    wx, xy = w * x, x * y
    terms = np.stack([w, wx, wx * x, y, xy, y * y])
    s, sx, sxx, sy, sxy, syy = np.cumsum(terms, axis=1)
    enough = s.min(axis=1) >= max(shortest, 2) - 0.5
    s = np.maximum(s, 1.0)
    spread = np.maximum(sxx - sx * sx / s, 1e-300)  # 0 for one frame, which is not enough
    cost = (syy - sy * sy / s - (sxy - sx * sy / s) ** 2 / spread).sum(axis=1)
    return np.where(enough, np.maximum(cost, 0.0), np.inf)[::-1]


def _joined(
    t: np.ndarray,
    q: np.ndarray,
    sigma: np.ndarray,
    acceleration: np.ndarray,
    flights: list[np.ndarray],
    start: float,
) -> list[np.ndarray]:
    """Flights, neighbours joined where chi^2 of both as one is less than of two, plus `start`."""
    joined: list[np.ndarray] = []
    for flight in flights:
        if joined:
            both = np.concatenate([joined[-1], flight])
            alone = sum(chi_squared(t, q, sigma, acceleration, f) for f in (joined[-1], flight))
            if chi_squared(t, q, sigma, acceleration, both) < alone + start:
                joined[-1] = both
                continue
        joined.append(flight)
    return joined


def without_polynomial(x: np.ndarray, y: np.ndarray, terms: int) -> np.ndarray:
    """Residual of y (F,) or (F, k) by least squares of polynomials of so many terms in x (F,)."""
    basis = np.linalg.qr(np.vander(x, terms))[0]
    return np.asarray(y - basis @ (basis.T @ y))


def chi_squared(
    t: np.ndarray,
    q: np.ndarray,
    sigma: np.ndarray,
    acceleration: np.ndarray | None,
    frames: np.ndarray,
) -> float:
    """chi^2 of frames as one flight of this acceleration (n,), or None: of the best one."""
    x, total = t[frames] - t[frames].mean(), 0.0
    for c, scale in enumerate(sigma):
        ok = np.isfinite(q[frames, c])
        known = 0.0 if acceleration is None else acceleration[c]
        y = q[frames[ok], c] - known * x[ok] ** 2 / 2
        rest = without_polynomial(x[ok], y, 3 if acceleration is None else 2)
        total += float(rest @ rest) / scale**2
    return total


def flights_and_acceleration(
    t: np.ndarray,
    q: np.ndarray,
    sigma: np.ndarray,
    known: np.ndarray | None,
    shortest: int,
    drag: float | None = 0.0,
) -> tuple[list[np.ndarray], np.ndarray, float]:
    """Flights, their acceleration (n,) [m/s^2] and drag k [1/m].

    `known` None, or `drag` None: found, as one that is common to all flights. By turns, `ROUNDS`
    times: `q - k s` is divided into flights; where the acceleration is unknown, neighbours that one
    flight of a better acceleration explains are joined, and it is fitted; then k. What a drag of
    1/m adds to the places is s; its effect is taken as proportional to k. `shortest`: frames of a
    flight.
    """
    acceleration = curvature(t, q, shortest) if known is None else known
    added_by_drag = q - straightened(t, q, 1.0) if drag != 0 else np.zeros_like(q)
    flights: list[np.ndarray] = []
    k = 0.0 if drag is None else drag
    for _ in range(ROUNDS if known is None or drag is None else 1):
        without_drag = q - k * added_by_drag
        flights = flights_of(t, without_drag, sigma, acceleration, shortest)
        if flights and known is None:
            flights = _joined_at_any(t, without_drag, sigma, acceleration, flights)
            acceleration = common_acceleration(t, without_drag, flights)
        if flights and drag is None:
            k = _common_drag(t, q, added_by_drag, sigma, known, flights)
    return flights, acceleration, k


def _common_drag(
    t: np.ndarray,
    q: np.ndarray,
    added_by_drag: np.ndarray,
    sigma: np.ndarray,
    acceleration: np.ndarray | None,
    flights: list[np.ndarray],
) -> float:
    """Drag k [1/m] common to all flights by least squares: `k = sum s y / sum s^2`.

    s is `added_by_drag` (T, n), the places added by a drag of 1/m, y the places less the known
    acceleration, both without the line of each flight (without its parabola where the acceleration
    is None), weighted by 1 / sigma^2.
    """
    above, below = 0.0, 0.0
    for frames in flights:
        for c, scale in enumerate(sigma):
            ok = frames[np.isfinite(q[frames, c])]
            x, y = t[ok] - t[ok].mean(), q[ok, c]
            if acceleration is not None:
                y = y - acceleration[c] * x**2 / 2
            terms = 2 if acceleration is not None else 3
            drag = without_polynomial(x, added_by_drag[ok, c], terms)
            above, below = above + float(drag @ y) / scale**2, below + float(drag @ drag) / scale**2
    return above / below if below > 0 else 0.0


def _joined_at_any(
    t: np.ndarray,
    q: np.ndarray,
    sigma: np.ndarray,
    acceleration: np.ndarray,
    flights: list[np.ndarray],
) -> list[np.ndarray]:
    """Flights, neighbours joined where the cost of all falls, each time at its best acceleration.

    At a slightly wrong one long flights are parted, and the parts show theirs less well.
    """
    start, flights = price(*q.shape), list(flights)

    def moments(frames: np.ndarray) -> np.ndarray:
        """Sums (n, 3) of r^2, r c, c^2 over a flight; r = q - a c, c = t^2 / 2 without lines."""
        x, sums = t[frames] - t[frames].mean(), np.zeros((q.shape[1], 3))
        for c in range(q.shape[1]):
            ok = np.isfinite(q[frames, c])
            curve = x[ok] ** 2 / 2
            both = np.stack([q[frames[ok], c] - acceleration[c] * curve, curve], axis=1)
            rest, curve = without_polynomial(x[ok], both, 2).T / sigma[c]
            sums[c] = rest @ rest, rest @ curve, curve @ curve
        return sums

    def least(sums: np.ndarray) -> np.ndarray:
        """chi^2 at the best acceleration: `sum r^2 - (sum r c)^2 / sum c^2`, over coordinates."""
        return (sums[..., 0] - sums[..., 1] ** 2 / np.maximum(sums[..., 2], 1e-300)).sum(axis=-1)

    alone = [moments(f) for f in flights]
    pairs = [moments(np.concatenate(two)) for two in pairwise(flights)]
    while pairs:
        whole = np.sum(alone, axis=0)
        after = np.array([least(whole - a - b + p) for (a, b), p in zip(pairwise(alone), pairs)])
        k = int(np.argmin(after))
        if after[k] >= least(whole) + start:
            break
        flights[k : k + 2] = [np.concatenate(flights[k : k + 2])]
        alone[k : k + 2] = [pairs.pop(k)]
        for i in (k - 1, k):
            if 0 <= i < len(pairs):
                pairs[i] = moments(np.concatenate(flights[i : i + 2]))
    return flights


def curvature(t: np.ndarray, q: np.ndarray, shortest: int) -> np.ndarray:
    """First value (n,) of the acceleration: median of second differences over `(step dt)^2`."""
    step = max(shortest, 2)  # over so many frames, of which most lie in one flight
    step = step if len(q) > 2 * step else 1
    found = np.zeros(q.shape[1])
    for c, x in enumerate(q.T):
        whole = np.isfinite(x[2 * step :] + x[step:-step] + x[: -2 * step]).any()
        times = t if whole else t[np.isfinite(x)]
        if len(times) > 2 * step:
            found[c] = _median(_differences(x, 2, step)) / (step * np.median(np.diff(times))) ** 2
    return found


def common_acceleration(t: np.ndarray, q: np.ndarray, flights: list[np.ndarray]) -> np.ndarray:
    """Acceleration (n,) common to all flights by least squares: `a = sum c q / sum c^2`.

    c = t^2 / 2 of a flight without its best line; each flight has a line of its own.
    """
    found = np.zeros(q.shape[1])
    for c in range(q.shape[1]):
        above, below = 0.0, 0.0
        for frames in flights:
            ok = frames[np.isfinite(q[frames, c])]
            x = t[ok] - t[ok].mean()
            curve = without_polynomial(x, x**2 / 2, 2)
            above, below = above + float(curve @ q[ok, c]), below + float(curve @ curve)
        found[c] = above / below if below > 0 else 0.0
    return found
