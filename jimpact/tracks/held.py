"""Flights in which a body is held: it has no acceleration where a flight has a known
one.

It rests, slides or rolls; its frames are taken for short flights with impacts between.
"""

from collections.abc import Sequence

import numpy as np

from jimpact.tracks.division import SMALLEST_JUMP, price
from jimpact.tracks.flight import without_polynomial
from jimpact.tracks.frames import Frames

# Logarithm of the odds, 20 to 1, from which on a body is held in one flight. Ten times
# more would keep most false flights of a body that slides, of a few frames each.
HELD_ODDS = 3.0
# Logarithm of the likelihood of "held" over "free" from which on flights at an end are
# left out: half of the square of SMALLEST_JUMP. Ten times more would keep 10 false
# impacts.
HELD = SMALLEST_JUMP**2 / 2


def free_flights(
    frames: Frames, acceleration: np.ndarray, flights: list[np.ndarray]
) -> list[np.ndarray]:
    """The flights without those at both ends in which the body is held; at least one is
    left.

    A run of flights at an end is held where one parabola explains it as well (chi^2 and
    prices of flights), or where the sum of `held_rather` over it exceeds HELD. The late
    end goes first. Where all are held the first one stays; a single flight, or flights
    without acceleration, are not judged.
    """
    if not acceleration.any() or len(flights) < 2:
        return flights
    held = held_rather(frames, acceleration, flights)
    alone = np.array([chi_squared(frames, acceleration, some) for some in flights])
    price_of_flight = price(*frames.q.shape)  # chi^2 that one more flight must save

    def cost_of_joining(run: np.ndarray) -> float:
        """Increase of chi^2 if one parabola replaces the arcs of a run of flights."""
        whole = np.sort(np.concatenate([flights[k] for k in run]))
        return _of_one_parabola(frames, acceleration, whole) - float(alone[run].sum())

    def joined_by_one_parabola(from_end: np.ndarray) -> int:
        """Number of flights from an end on that one parabola explains as well as their
        arcs do, by bisection; 0 for one.

        Without the last ones, if each costs more than a flight of its own.
        """
        low = 1
        high = len(from_end)
        while low < high:
            middle = (low + high + 1) // 2
            if cost_of_joining(from_end[:middle]) < price_of_flight * (middle - 1):
                low = middle
            else:
                high = middle - 1
        count = low
        while count > 1:
            of_last = cost_of_joining(from_end[:count])
            of_last -= cost_of_joining(from_end[: count - 1])
            if of_last <= price_of_flight:
                return count
            count -= 1
        return 0

    def held_from(from_end: np.ndarray) -> int:
        """Number of held flights from an end on, by likelihood or one parabola."""
        sums = np.cumsum(held[from_end])
        by_likelihood = 0
        if sums.size and sums.max() > HELD:
            by_likelihood = int(np.argmax(sums)) + 1
        return max(by_likelihood, joined_by_one_parabola(from_end))

    last = len(flights) - held_from(np.arange(len(flights))[::-1])
    first = held_from(np.arange(last))
    if last > first:
        return flights[first:last]
    return flights[:1]


def held_flights(
    frames: Frames, acceleration: np.ndarray, flights: Sequence[np.ndarray]
) -> np.ndarray:
    """True (F,) for flights in which the body is held: by `held_rather`, or on one
    parabola.

    A run of flights is on one parabola as long as each further one, at its price, would
    cost more by itself.
    """
    if not acceleration.any():
        return np.zeros(len(flights), bool)
    held = held_rather(frames, acceleration, flights) > HELD_ODDS
    alone = [chi_squared(frames, acceleration, some) for some in flights]
    start = price(*frames.q.shape)
    first = 0
    while first < len(flights):
        last = first
        run = flights[first]
        sum_of_run = alone[first]
        while last + 1 < len(flights):
            longer = np.concatenate([run, flights[last + 1]])
            sum_of_longer = _of_one_parabola(frames, acceleration, longer)
            if not sum_of_longer < sum_of_run + alone[last + 1] + start:
                break
            last += 1
            run = longer
            sum_of_run = sum_of_longer
        held[first : last + 1] |= last > first
        first = last + 1
    return held


def held_rather(
    frames: Frames, acceleration: np.ndarray, flights: Sequence[np.ndarray]
) -> np.ndarray:
    """Log likelihood ratio (F,) of "held" over "free" in each flight.

    Equation: with the excess x of its acceleration over the known a, and the error s of
    x, the sum of `(x^2 - (x + a)^2) / (2 s^2)` over coordinates.
    """
    rest = (frames.q - acceleration * frames.t[:, None] ** 2 / 2) / frames.sigma
    excess, error = excess_of(frames.t, rest, frames.sigma, flights)
    odds = (excess**2 - (excess + acceleration) ** 2) / (2 * error**2)
    return np.asarray(odds.sum(axis=1))


def excess_of(
    t: np.ndarray, rest: np.ndarray, sigma: np.ndarray, flights: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Acceleration x (F, n) of the residuals of each flight, and its standard error s.

    Equation: least squares of `rest sigma = x c`, c = t^2 / 2 without its best line:
    `x = c . rest sigma / |c|^2`, `s = sigma / |c|`. `rest` (T, n) is in units of sigma.
    """
    excess = np.zeros((len(flights), len(sigma)))
    error = np.zeros((len(flights), len(sigma)))
    for i, some in enumerate(flights):
        for c, scale in enumerate(sigma):
            ok = some[np.isfinite(rest[some, c])]
            if len(ok):
                x = t[ok] - t[ok].mean()
            else:
                x = t[ok]
            if len(ok) > 2:
                curve = without_polynomial(x, x**2 / 2, 2)
            else:
                curve = np.zeros(1)
            size = float(np.linalg.norm(curve))
            if size > 0:
                error[i, c] = scale / size
            else:
                error[i, c] = np.inf
            if size > 0:
                excess[i, c] = scale * float(curve @ rest[ok, c]) / size**2
    return excess, error


def chi_squared(frames: Frames, acceleration: np.ndarray, some: np.ndarray) -> float:
    """chi^2 of some frames as one flight of this acceleration (n,)."""
    x = frames.t[some] - frames.t[some].mean()
    total = 0.0
    for c, scale in enumerate(frames.sigma):
        ok = np.isfinite(frames.q[some, c])
        y = frames.q[some[ok], c] - acceleration[c] * x[ok] ** 2 / 2
        rest = without_polynomial(x[ok], y, 2)
        total += float(rest @ rest) / scale**2
    return total


def _of_one_parabola(
    frames: Frames, acceleration: np.ndarray, some: np.ndarray
) -> float:
    """chi^2 of frames on one free parabola in each coordinate; inf if it curves like a
    flight.

    That is: its acceleration is nearer to the known one than to 0.
    """
    x = frames.t[some] - frames.t[some].mean()
    total = 0.0
    for c, known in enumerate(acceleration):
        ok = np.isfinite(frames.q[some, c])
        if ok.sum() < 3:
            continue
        curve = np.vander(x[ok], 3)
        best = np.linalg.lstsq(curve, frames.q[some[ok], c], rcond=None)[0]
        if 2 * best[0] * known > known**2 / 2:
            return np.inf
        rest = frames.q[some[ok], c] - curve @ best
        total += float(rest @ rest) / frames.sigma[c] ** 2
    return total
