"""Findings: sentences that say why a track may not be one of ballistic flights.

*Held* is a body that has no acceleration where a flight has a known one: it rests, slides or rolls.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from scipy.stats import chi2, norm

from jimpact.tracks.arcs import Arcs
from jimpact.tracks.segments import (
    LOOK_BACK,
    SMALLEST_JUMP,
    chi_squared,
    cost_of_flights,
    curvature,
    price,
    without_polynomial,
)

# Chance that a good track has a warning: half by curvatures, half by sizes of residuals. Ten times
# more would warn of one good track in ten.
FALSE_ALARMS = 0.01
# Share of the frames, lost ones aside, that fit no flight, from which on it is said. Good frames
# are left out once in 1000.
UNUSED = 0.03
# Frames in a row that fit no flight at an end of the track, from which on it is said.
AT_AN_END = 2
# Share of the moving frames that repeat the one before to the last digit; noise does it hardly
# ever, but for positions in whole pixels.
DOUBLED = 0.05
# Error of an angle [rad], 6 degrees, from which on degrees are suspected: trackers have a tenth of
# it and less. Ten times more is half a turn; ten times less would warn of many good tracks.
COARSE_ANGLE = 0.1
# Residuals in units of the noise from frame to frame from which on flights do not explain them.
# White noise stays below 1.3; ten times more would pass impacts that were not found.
UNEXPLAINED = 3.0
# chi^2 by which an impact must explain frames better than one parabola without it; by chance one
# impact in a thousand gains less. Ten times more would doubt soft impacts; ten times less, and
# drag or a wrong acceleration would pass as impacts.
LEAST_GAIN = 10.8
# Logarithm of the odds, 20 to 1, from which on a body is held in one flight. Ten times more would
# keep most false flights of a body that slides, of a few frames each.
HELD_ODDS = 3.0
# Logarithm of the likelihood of "held" over "free" from which on flights at an end are left out:
# half of the square of SMALLEST_JUMP. Ten times more would keep 10 false impacts.
HELD = SMALLEST_JUMP**2 / 2


def findings_of_input(q: np.ndarray, sigma: np.ndarray, units: tuple[str, ...]) -> list[str]:
    """Findings in the frames q (T, n) alone: repeated ones, angles that are perhaps in degrees.

    Steps of angles between frames seen in a row must stay below a quarter of a turn.
    """
    found, seen = [], np.isfinite(q).all(axis=1)
    places = q[seen]
    if len(places) > 2:
        same = (np.diff(places, axis=0) == 0).all(axis=1)
        if DOUBLED <= same.mean() < 1:
            found.append(
                f"{int(same.sum())} of {len(places)} frames repeat the one before to the last "
                "digit: a film converted to another rate has frames twice, and its times are wrong."
            )
    for c in np.flatnonzero(np.array(units) == "rad"):
        steps = np.abs(np.diff(places[:, c])) if len(places) > 1 else np.zeros(1)
        # turns of 2 pi are unwrapped; what is left tells how far a frame turns
        turned = np.abs((steps + np.pi) % (2 * np.pi) - np.pi)
        if (steps > 3 * np.pi).any() or np.quantile(turned, 0.9) > np.pi / 2:
            found.append(
                f"Coordinate {c + 1} turns by more than a quarter of a turn from frame to frame: "
                "is it in degrees, or do the frames miss turns?"
            )
        elif sigma[c] > COARSE_ANGLE:
            found.append(
                f"Coordinate {c + 1} has a standard error of {sigma[c]:.2g} rad, or "
                f"{np.degrees(sigma[c]):.0f} degrees: is it in degrees?"
            )
    return found


def findings_of_turns(
    e: np.ndarray, sigma: np.ndarray, residual: np.ndarray, p_values: np.ndarray, taken: float
) -> list[str]:
    """Findings in the orientations of poses, quaternions e (T, 4).

    Turns between frames above a quarter; a large sigma (3,) [rad]; chi^2 of `residual` (T, 3), in
    units of sigma, above what the frames less `taken` fitted values allow; `p_values` (K,) of
    orientations that meet at impacts.
    """
    found, seen = [], e[np.isfinite(e).all(axis=1)]
    cosines = np.minimum(np.abs((seen[1:] * seen[:-1]).sum(axis=1)), 1.0)
    if len(cosines) and np.quantile(2 * np.arccos(cosines), 0.9) > np.pi / 2:
        found.append(
            "The body turns by more than a quarter of a turn from frame to frame: do the frames "
            "miss turns?"
        )
    if (sigma > COARSE_ANGLE).any():
        found.append(
            f"The orientations have a standard error of {sigma.max():.2g} rad: is `sigma` in "
            "degrees, or does the body not turn freely between impacts (`inertia`)?"
        )
    freedom = max(np.isfinite(residual).sum() - taken, 1.0)
    square = float(np.nansum(residual**2))
    if chi2.sf(square, freedom) < FALSE_ALARMS / 4:
        found.append(
            f"The body does not turn freely within sigma: residuals are "
            f"{np.sqrt(square / freedom):.2g} times as large. Perhaps `inertia` is another, an "
            "impact was not found, or the orientations were smoothed."
        )
    apart = np.flatnonzero(p_values < FALSE_ALARMS / 4 / max(len(p_values), 1))
    if apart.size:
        numbers = ", ".join(str(k + 1) for k in apart)
        found.append(
            f"The turns before and after impact {numbers} do not meet at the instant of the places:"
            " are there two impacts in one, or were orientations smoothed across it?"
        )
    return found


def findings_of_signs(
    t: np.ndarray, q: np.ndarray, sigma: np.ndarray, acceleration: np.ndarray, shortest: int
) -> list[str]:
    """Findings of coordinates that curve against their known acceleration, as y of pixels does.

    Where the second differences have the other sign: if flights of the first LOOK_BACK frames cost
    less (chi^2 and prices) with the sign of this acceleration changed.
    """
    some, found = slice(0, LOOK_BACK), []
    seen = np.isfinite(q[some]).any(axis=0).all()
    measured = curvature(t[some], q[some], shortest) if seen else np.zeros(len(acceleration))
    for c in np.flatnonzero(measured * acceleration < 0):
        other = np.where(np.arange(len(acceleration)) == c, -acceleration, acceleration)
        stated, mirrored = (
            cost_of_flights(t[some], q[some], sigma, a, shortest) for a in (acceleration, other)
        )
        if mirrored < stated:
            found.append(
                f"Coordinate {c + 1} curves the other way than an acceleration of "
                f"{acceleration[c]:.4g}: does it point down, as y of pixels? Then take -q of it."
            )
    return found


def findings_of_noise(differences: np.ndarray, residuals: np.ndarray, first: int = 1) -> list[str]:
    """Findings of coordinates whose residuals exceed UNEXPLAINED times the noise `differences`.

    Both (n,) are standard errors; coordinates are numbered from `first`.
    """
    return [
        f"Coordinate {c + first} has residuals of {residuals[c]:.2g}, but noise of "
        f"{differences[c]:.2g} from frame to frame: is an impact missing, or do the flights bend?"
        for c in np.flatnonzero(residuals > UNEXPLAINED * differences)
    ]


def findings(t: np.ndarray, q: np.ndarray, sigma: np.ndarray, arcs: Arcs) -> list[str]:
    """Findings in a fitted track: curvatures, large residuals, unused frames, doubtful impacts."""
    found = [*_of_curvatures(t, sigma, arcs), *_of_sizes(arcs), *_unused(t, q, arcs)]
    found += _of_bends(t, q, sigma, arcs)
    if len(arcs.instants) == 2:
        found.insert(0, "No impact was found: one flight explains all frames within sigma.")
    return found


def free_flights(
    t: np.ndarray,
    q: np.ndarray,
    sigma: np.ndarray,
    acceleration: np.ndarray,
    flights: list[np.ndarray],
) -> list[np.ndarray]:
    """The flights without those at both ends in which the body is held; at least one is left.

    Frames of a held body are taken for short flights with impacts between. A run of flights at an
    end is held where one parabola explains it as well (chi^2 and prices of flights), or where the
    sum of `held_rather` over it exceeds HELD.
    """
    if not acceleration.any():
        return flights
    rest = (q - acceleration * t[:, None] ** 2 / 2) / sigma
    held = held_rather(t, rest, sigma, acceleration, flights)
    alone = np.array([chi_squared(t, q, sigma, acceleration, some) for some in flights])
    start = price(*q.shape)  # chi^2 that one more flight must save

    def more(run: np.ndarray) -> float:
        """Increase of chi^2 if one parabola replaces the arcs of a run of flights."""
        frames = np.sort(np.concatenate([flights[k] for k in run]))
        return _of_one_parabola(t, q, sigma, acceleration, frames) - float(alone[run].sum())

    def count(order: np.ndarray) -> int:
        """Number of the first flights in this order that are held, by likelihood or parabola."""
        sums = np.cumsum(held[order])
        curved = int(np.argmax(sums)) + 1 if sums.size and sums.max() > HELD else 0
        few, many = 1, len(order)  # by bisection how many one parabola explains
        while few < many:
            middle = (few + many + 1) // 2
            if more(order[:middle]) < start * (middle - 1):
                few = middle
            else:
                many = middle - 1
        while few > 1 and more(order[:few]) - more(order[: few - 1]) > start:
            few -= 1  # the last one costs more than it would alone
        return max(curved, few if few > 1 else 0)

    last = len(flights) - count(np.arange(len(flights))[::-1])
    first = count(np.arange(last))
    return flights[first:last] if last > first else flights[:1]


def held_flights(
    t: np.ndarray,
    q: np.ndarray,
    sigma: np.ndarray,
    acceleration: np.ndarray,
    flights: Sequence[np.ndarray],
) -> np.ndarray:
    """True (F,) for flights in which the body is held: by `held_rather`, or on one parabola.

    A run of flights is on one parabola as long as each further one, at its price, would cost more
    by itself.
    """
    if not acceleration.any():
        return np.zeros(len(flights), bool)
    rest = (q - acceleration * t[:, None] ** 2 / 2) / sigma
    held = held_rather(t, rest, sigma, acceleration, flights) > HELD_ODDS
    alone = [chi_squared(t, q, sigma, acceleration, frames) for frames in flights]
    start, first = price(*q.shape), 0
    while first < len(flights):
        last, run, sum_of_run = first, flights[first], alone[first]
        while last + 1 < len(flights):
            longer = np.concatenate([run, flights[last + 1]])
            sum_of_longer = _of_one_parabola(t, q, sigma, acceleration, longer)
            if not sum_of_longer < sum_of_run + alone[last + 1] + start:
                break
            last, run, sum_of_run = last + 1, longer, sum_of_longer
        held[first : last + 1] |= last > first
        first = last + 1
    return held


def held_rather(
    t: np.ndarray,
    rest: np.ndarray,
    sigma: np.ndarray,
    acceleration: np.ndarray,
    flights: Sequence[np.ndarray],
) -> np.ndarray:
    """Log likelihood ratio (F,) of "held" over "free" in each flight.

    Equation: with the excess x of its acceleration over the known a, and the error s of x, the sum
    of `(x^2 - (x + a)^2) / (2 s^2)` over coordinates. `rest` (T, n) is what a fit leaves, in sigma.
    """
    excess, error = _excess(t, rest, sigma, flights)
    return np.asarray(((excess**2 - (excess + acceleration) ** 2) / (2 * error**2)).sum(axis=1))


def _of_one_parabola(
    t: np.ndarray, q: np.ndarray, sigma: np.ndarray, acceleration: np.ndarray, frames: np.ndarray
) -> float:
    """chi^2 of frames on one free parabola in each coordinate; inf if it curves like a flight.

    That is: its acceleration is nearer to the known one than to 0.
    """
    x, total = t[frames] - t[frames].mean(), 0.0
    for c, known in enumerate(acceleration):
        ok = np.isfinite(q[frames, c])
        if ok.sum() < 3:
            continue
        curve = np.vander(x[ok], 3)
        best = np.linalg.lstsq(curve, q[frames[ok], c], rcond=None)[0]
        if 2 * best[0] * known > known**2 / 2:
            return np.inf
        total += float(np.sum((q[frames[ok], c] - curve @ best) ** 2)) / sigma[c] ** 2
    return total


def findings_of_held(t: np.ndarray, flights: Sequence[np.ndarray]) -> list[str]:
    """Findings of frames before the first and after the last free flight, which are left out."""
    why = (
        "there are no flights of this acceleration. Perhaps the body rests, slides, rolls or is "
        "held, it bounces faster than frames show, or the acceleration is wrong."
    )
    found, start, end = [], flights[0][0], flights[-1][-1]
    if start > 0:
        found.append(f"Up to {t[start]:.4g} s nothing is used: {why}")
    if end < len(t) - 1:
        found.append(f"From {t[end + 1]:.4g} s on nothing is used: {why}")
    return found


def _of_curvatures(t: np.ndarray, sigma: np.ndarray, arcs: Arcs) -> list[str]:
    """Findings of flights with an acceleration beyond that of the fit, by its standard error.

    The limit keeps false alarms over all flights and coordinates below a quarter of FALSE_ALARMS
    on each side.
    """
    excess, error = _excess(t, arcs.residual, sigma, arcs.members)
    limit = norm.isf(FALSE_ALARMS / 4 / excess.size)
    far = np.abs(excess) > limit * error
    found = []
    for i, c in zip(*np.nonzero(far)):
        same = far[:, c].sum() > 1 and len(set(np.sign(excess[far[:, c], c]))) == 1
        why = (
            "the acceleration, the scale of lengths or of times, or a rolling shutter"
            if same
            else "drag, a rolling shutter, a moving camera, or an impact that was not found"
        )
        found.append(
            f"Flight {i + 1} is not ballistic: coordinate {c + 1} has an acceleration of "
            f"{excess[i, c]:.3g} ± {error[i, c]:.2g} beyond that of the fit. Perhaps {why}."
        )
    return found


def _excess(
    t: np.ndarray, rest: np.ndarray, sigma: np.ndarray, flights: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Acceleration x (F, n) of the residuals of each flight, and its standard error s.

    Equation: least squares of `rest sigma = x c`, c = t^2 / 2 without its best line:
    `x = c . rest sigma / |c|^2`, `s = sigma / |c|`. `rest` (T, n) is in units of sigma.
    """
    excess, error = np.zeros((2, len(flights), len(sigma)))
    for i, frames in enumerate(flights):
        for c, scale in enumerate(sigma):
            ok = frames[np.isfinite(rest[frames, c])]
            x = t[ok] - t[ok].mean()
            curve = without_polynomial(x, x**2 / 2, 2)
            size = float(np.linalg.norm(curve))
            error[i, c] = scale / size if size > 0 else np.inf
            excess[i, c] = scale * float(curve @ rest[ok, c]) / size**2 if size else 0.0
    return excess, error


def _of_bends(t: np.ndarray, q: np.ndarray, sigma: np.ndarray, arcs: Arcs) -> list[str]:
    """Finding of impacts whose flights one parabola explains within LEAST_GAIN of their chi^2."""
    doubtful = []
    for k, both in enumerate(map(np.concatenate, pairwise(arcs.members)), 1):
        with_impact = np.nansum(arcs.residual[both] ** 2)
        if chi_squared(t, q, sigma, None, both) < with_impact + LEAST_GAIN:
            doubtful.append(str(k))
    if not doubtful:
        return []
    return [
        f"Impact {', '.join(doubtful)} may be none: a flight of another acceleration explains its "
        "frames as well. Perhaps drag, a rolling shutter, or the acceleration is wrong."
    ]


def _of_sizes(arcs: Arcs) -> list[str]:
    """Findings of flights whose chi^2 has a p-value below FALSE_ALARMS / 2 / (their number)."""
    n, flights, found = arcs.places.shape[1], len(arcs.members), []
    # parameters of a flight: places and instants are shared with its neighbours
    taken = (n * (flights + 1) + flights - 1) / flights
    for i, frames in enumerate(arcs.members):
        rest = arcs.residual[frames]
        freedom = max(np.isfinite(rest).sum() - taken, 1.0)
        p_value = chi2.sf(np.nansum(rest**2), freedom)
        if p_value < FALSE_ALARMS / 2 / flights:
            found.append(
                f"Flight {i + 1} is not ballistic within sigma: its residuals are "
                f"{np.sqrt(np.nansum(rest**2) / freedom):.2g} times as large (p-value "
                f"{p_value:.1g}). Perhaps times jitter, frames are there twice, or a false point "
                "was tracked."
            )
    return found


def _unused(t: np.ndarray, q: np.ndarray, arcs: Arcs) -> list[str]:
    """Findings of seen frames that no flight uses: at both ends, and between."""
    seen, used = np.isfinite(q).any(axis=1), np.zeros(len(q), bool)
    used[np.concatenate(arcs.members)] = True
    found, order = [], np.flatnonzero(used)
    for where, frames in (("first", seen[: order[0]]), ("last", seen[order[-1] + 1 :])):
        if frames.sum() >= AT_AN_END:
            found.append(
                f"The {where} {len(frames)} frames are too few for a flight, and fit no other: an "
                "impact there is not found."
            )
    inner = slice(order[0], order[-1] + 1)
    lost = int((seen[inner] & ~used[inner]).sum())
    if lost > UNUSED * seen[inner].sum() + 1:
        found.append(
            f"{lost} of {int(seen[inner].sum())} frames are left out: they fit no flight, or lie "
            "in a contact."
        )
    return found
