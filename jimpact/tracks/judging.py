"""Findings: sentences that say why a track may not be one of ballistic flights."""

from collections.abc import Sequence

import numpy as np
from scipy.stats import chi2, norm

from jimpact.tools.records import counted, listed
from jimpact.tracks.arcs import Arcs
from jimpact.tracks.division import divided
from jimpact.tracks.frames import Frames, differences, median, neighbours
from jimpact.tracks.held import excess_of
from jimpact.tracks.search import Search, curvature

# Chance that a good track has a warning: half by curvatures, half by sizes of
# residuals. Ten times more would warn of one good track in ten.
FALSE_ALARMS = 0.01
# Share of the frames, lost ones aside, that fit no flight, from which on it is said.
# Good frames are left out once in 1000.
UNUSED = 0.03
# Frames in a row that fit no flight at an end of the track, from which on it is said.
AT_AN_END = 2
# Share of the moving frames that repeat the one before to the last digit; noise does it
# hardly ever, but for positions in whole pixels.
DOUBLED = 0.05
# Error of an angle [rad], 6 degrees, from which on degrees are suspected: trackers have
# a tenth of it and less. Ten times more is half a turn; ten times less would warn of
# many good tracks.
COARSE_ANGLE = 0.1
# Residuals in units of the noise from frame to frame from which on flights do not
# explain them. White noise stays below 1.3; ten times more would pass impacts that were
# not found.
UNEXPLAINED = 3.0
# Frames from the first one on in which signs of accelerations are looked at. Ten times
# more takes ten times as long.
LOOKED_AT = 400
# Bodies whose rows may alternate in a table, and how much larger the noise from row to
# row is then than that of one body. Ten times more would pass bodies that are near one
# another.
MOST_BODIES = 6
ALTERNATING = 10.0
# Rows of each body that are needed: four have a third difference, one more a median.
ROWS_OF_A_BODY = 5

# Share of the flights on both sides that flights within one contact last at most. Three
# times more: any impacts are one.
WITHIN = 0.3
# Share of all changes of velocity, by jumps and in flights between, that the pushes
# of one contact leave at least; two bounces leave a third. Half of it: bounces pass.
ONWARD = 0.5
# Contact that a finding names, in the time from the first to the last of its pushes:
# forces begin before the first one and end after the last. Of ten times more no frames
# would be left.
WHOLE_CONTACT = 1.5

NO_IMPACT = "No impact was found"  # how its finding begins


def findings_of_input(
    q: np.ndarray, sigma: np.ndarray, units: tuple[str, ...]
) -> list[str]:
    """Findings in the frames q (T, n) alone: repeated ones, angles that are perhaps in
    degrees.

    Steps of angles between frames seen in a row must stay below a quarter of a turn.
    """
    found = []
    seen = np.isfinite(q).all(axis=1)
    places = q[seen]
    if len(places) > 2:
        steps = np.diff(places, axis=0)
        same = (steps == 0).all(axis=1)
        if DOUBLED <= same.mean() < 1:
            found.append(
                f"{int(same.sum())} of {len(places)} frames repeat the one before to "
                f"the last digit: a film converted to another rate has frames twice, "
                f"and its times are wrong."
            )
    for c in np.flatnonzero(np.array(units) == "rad"):
        if len(places) > 1:
            steps = np.abs(np.diff(places[:, c]))
        else:
            steps = np.zeros(1)
        # turns of 2 pi are unwrapped; what is left tells how far a frame turns
        half_turn = np.pi
        turned = np.abs((steps + half_turn) % (2 * half_turn) - half_turn)
        many = np.quantile(turned, 0.9) > half_turn / 2
        if many or (steps > 3 * half_turn).any():
            found.append(
                f"Coordinate {c + 1} turns by more than a quarter of a turn from frame "
                f"to frame: is it in degrees, or do the frames miss turns?"
            )
        elif sigma[c] > COARSE_ANGLE:
            found.append(
                f"Coordinate {c + 1} has a standard error of {sigma[c]:.2g} rad, or "
                f"{np.degrees(sigma[c]):.0f} degrees: is it in degrees?"
            )
    return found


def findings_of_turns(
    e: np.ndarray,
    sigma: np.ndarray,
    residual: np.ndarray,
    p_values: np.ndarray,
    taken: float,
) -> list[str]:
    """Findings in the orientations of poses, quaternions e (T, 4).

    Turns between frames above a quarter; a large sigma (3,) [rad]; chi^2 of `residual`
    (T, 3), in units of sigma, above what the frames less `taken` fitted values allow;
    `p_values` (K,) of orientations that meet at impacts.
    """
    found = []
    seen = np.isfinite(e).all(axis=1)
    now, then = neighbours(e[seen])
    products = np.abs((then * now).sum(axis=1))
    turned = 2 * np.arccos(np.minimum(products, 1.0))
    if len(turned) and np.quantile(turned, 0.9) > np.pi / 2:
        found.append(
            "The body turns by more than a quarter of a turn from frame to frame: do "
            "the frames miss turns?"
        )
    if (sigma > COARSE_ANGLE).any():
        found.append(
            f"The orientations have a standard error of {sigma.max():.2g} rad: is "
            f"`sigma` in degrees, or does the body not turn freely between impacts "
            f"(`inertia`)?"
        )
    freedom = max(np.isfinite(residual).sum() - taken, 1.0)
    square = float(np.nansum(residual**2))
    if chi2.sf(square, freedom) < FALSE_ALARMS / 4:
        found.append(
            f"The body does not turn freely within sigma: residuals are "
            f"{np.sqrt(square / freedom):.2g} times as large. Perhaps `inertia` is "
            f"another, an impact was not found, or the orientations were smoothed."
        )
    limit = FALSE_ALARMS / 4 / max(len(p_values), 1)
    apart = np.flatnonzero(p_values < limit)
    if apart.size:
        numbers = ", ".join(str(k + 1) for k in apart)
        found.append(
            f"The turns before and after impact {numbers} do not meet at the instant "
            f"of the places: are there two impacts in one, or were orientations "
            f"smoothed across it?"
        )
    return found


def findings_of_signs(
    frames: Frames, acceleration: np.ndarray, shortest: int
) -> list[str]:
    """Findings of coordinates that curve against their known acceleration, as y of
    pixels does.

    Where the second differences have the other sign: if flights of the first LOOKED_AT
    frames cost less (chi^2 and prices) with the sign of this acceleration changed.
    """
    some = slice(0, LOOKED_AT)
    frames = Frames(frames.t[some], frames.q[some], frames.sigma)
    found: list[str] = []
    seen = np.isfinite(frames.q).any(axis=0)
    if len(frames.t) < shortest or not seen.all():
        return found
    stride = max(1, min(shortest, len(frames.t) // 8))
    columns = frames.q.T
    measured = np.array([curvature(frames.t, x, stride) for x in columns])
    for c in np.flatnonzero(measured * acceleration < 0):
        other = acceleration.copy()
        other[c] = -acceleration[c]
        stated = divided(frames, acceleration, shortest).cost
        mirrored = divided(frames, other, shortest).cost
        if mirrored < stated:
            found.append(
                f"Coordinate {c + 1} curves the other way than an acceleration of "
                f"{acceleration[c]:.4g}: does it point down, as y of pixels? Then take "
                f"-q of it."
            )
    return found


def findings_of_noise(
    differences: np.ndarray, residuals: np.ndarray, first: int = 1
) -> list[str]:
    """Findings of coordinates whose residuals exceed UNEXPLAINED times the noise
    `differences`.

    Both (n,) are standard errors; coordinates are numbered from `first`.
    """
    return [
        f"Coordinate {c + first} has residuals of {residuals[c]:.2g}, but noise of "
        f"{differences[c]:.2g} from frame to frame: is an impact missing, or do the "
        f"flights bend?"
        for c in np.flatnonzero(residuals > UNEXPLAINED * differences)
    ]


def findings_of_bodies(q: np.ndarray) -> list[str]:
    """Findings of places q (T, n) that alternate: rows of several bodies, as in a long
    table.

    Third differences of every second, third, .. row are then far smaller than those of
    all, in one coordinate at least.
    """

    def jumps(distance: int) -> np.ndarray:
        """Median third differences (n,) of rows so far from each other."""
        by_coordinate = (differences(x, 3, distance) for x in q.T)
        return np.array([median(np.abs(x)) for x in by_coordinate])

    whole = jumps(1)
    for bodies in range(2, MOST_BODIES + 1):
        if len(q) < ROWS_OF_A_BODY * bodies:
            break
        own = jumps(bodies)
        if (own * ALTERNATING < whole).any():
            return [
                f"Places alternate between {bodies} bodies from row to row: this is a "
                f"long table, "
                "not one track. Read one body, `ji.tracks.read(.., where={'body': "
                "'A'})`."
            ]
    return []


def findings(
    search: Search, arcs: Arcs, used: Sequence[np.ndarray], noise: np.ndarray
) -> list[str]:
    """Findings in a fitted track: curvatures, waves, large residuals, contacts that
    last, unused frames, no impact.

    `used`: frames of flights before a window; `noise` (n,): from frame to frame.
    """
    frames = search.frames
    unused = _unused(frames, used, search.settings.shortest)
    found = [
        *_of_curvatures(frames.t, arcs),
        *_of_waves(arcs),
        *_of_sizes(arcs),
        *_of_lasting_contacts(arcs, frames.step),
        *unused,
    ]
    if search.settings.estimated and not arcs.flight.bends:
        found += findings_of_noise(noise, arcs.errors.sigma)
    if not search.settings.estimated:
        found += _of_a_given_sigma(frames.sigma, arcs.errors.sigma)
    if not arcs.impacts:
        if unused:
            rest = ""
        else:
            rest = ": one flight explains all frames within sigma"
        found.insert(0, f"{NO_IMPACT}{rest}.")
    return found


def _of_a_given_sigma(given: np.ndarray, found: np.ndarray) -> list[str]:
    """Findings of coordinates whose residuals took the place of the given sigma
    (n,).
    """
    return [
        f"Coordinate {c + 1} is not ballistic within sigma: its residuals are "
        f"{found[c] / given[c]:.2g} times as large, and the errors follow them. "
        f"Perhaps times jitter, frames are there twice, or a false point was tracked."
        for c in np.flatnonzero(found > given)
    ]


def notes_of(search: Search, joined: int) -> list[str]:
    """What became of candidates, in lines; `joined`: those with jumps below five
    errors.
    """
    verdict = search.verdict
    found = []
    within = verdict.within_errors + joined
    if within:
        found.append(
            f"{counted(within, 'candidate')} for an impact went: flights make such "
            f"jumps without one, by the size and the waves of their residuals"
        )
    if verdict.bends:
        found.append(
            f"{counted(verdict.bends, 'candidate')} for an impact went: a flight of "
            f"another acceleration explains the frames better"
        )
    return found


def findings_of_doubts(doubts: np.ndarray) -> list[str]:
    """Finding of impacts that are doubtful (K,)."""
    if not doubts.any():
        return []
    numbers = (str(k + 1) for k in np.flatnonzero(doubts))
    impacts = listed(list(numbers))
    return [
        f"Impact {impacts} may be none: a flight of another acceleration explains its "
        f"frames as well. Perhaps drag, a rolling shutter, or the acceleration is "
        f"wrong. `experiments` leaves it out unless `doubtful=True`."
    ]


def findings_of_held(
    t: np.ndarray, flights: Sequence[np.ndarray], candidates: Sequence[np.ndarray]
) -> list[str]:
    """Findings of frames before the first and after the last free flight, which are
    left out.

    `candidates`: flights before those in which the body is held were left out.
    """
    why = (
        "there are no flights of this acceleration. Perhaps the body rests, slides, "
        "rolls or is held, it bounces faster than frames show, or the acceleration is "
        "wrong."
    )
    found = []
    start = flights[0][0]
    end = flights[-1][-1]
    if start > candidates[0][0]:
        found.append(f"Up to {t[start]:.4g} s nothing is used: {why}")
    if end < candidates[-1][-1]:
        found.append(f"From {t[end + 1]:.4g} s on nothing is used: {why}")
    return found


def _of_curvatures(t: np.ndarray, arcs: Arcs) -> list[str]:
    """Findings of flights with an acceleration beyond that of the fit, by its standard
    error.

    The limit keeps false alarms over all flights and coordinates below a quarter of
    FALSE_ALARMS on each side. Coordinates with waves are left out; flights that have an
    acceleration of their own are told.
    """
    n = len(arcs.errors.sigma)
    sigma = arcs.errors.sigma
    excess, error = excess_of(t, arcs.residual, sigma, arcs.members)
    limit = norm.isf(FALSE_ALARMS / 4 / excess.size)
    far = np.abs(excess) > limit * error
    far[:, arcs.errors.waving] = False
    far |= arcs.bent
    excess = np.where(arcs.bent, arcs.own[:-1], excess)
    of_flight = arcs.size * np.arange(len(arcs.members))
    of_coordinate = n + 1 + np.arange(n)
    rows = of_flight[:, None] + of_coordinate
    variances = np.diag(arcs.covariance)[rows]
    own_error = np.sqrt(np.maximum(variances, 0.0))
    error = np.where(arcs.bent, own_error, error)
    found = []
    for i, c in zip(*np.nonzero(far)):
        signs = np.sign(excess[far[:, c], c])
        same = len(signs) > 1 and len(set(signs)) == 1
        if same:
            why = (
                "the acceleration, the scale of lengths or of times, or a rolling "
                "shutter"
            )
        else:
            why = (
                "drag, spin, a rolling shutter, a moving camera, or an impact that "
                "was not found"
            )
        if arcs.bent[i, c]:
            taken = " It is taken as its own."
        else:
            taken = ""
        found.append(
            f"Flight {i + 1} is not ballistic: coordinate {c + 1} has an acceleration "
            f"of {excess[i, c]:.3g} ± {error[i, c]:.2g} beyond that of the fit. "
            f"Perhaps {why}.{taken}"
        )
    return found


def _of_waves(arcs: Arcs) -> list[str]:
    """Findings of coordinates in which flights have waves."""
    errors = arcs.errors
    return [
        f"Flights wave in coordinate {c + 1}, by "
        f"{' and by '.join(f'{w.size:.2g} over {w.time:.2g} s' for w in waves)} beside "
        f"noise of {errors.sigma[c]:.2g}: perhaps a table that is not level, a lens, "
        f"drag, spin, a body that wobbles, a moving camera or times that err. The "
        f"errors hold this."
        for c, waves in enumerate(errors.waves)
        if waves
    ]


def _of_sizes(arcs: Arcs) -> list[str]:
    """Findings of flights whose chi^2 has a p-value below FALSE_ALARMS / 2 / (their
    number).

    Of coordinates without waves. Where residuals grow with speed, or rates vary, times
    are named.
    """
    flights = len(arcs.members)
    plain = ~arcs.errors.waving
    n = int(plain.sum())
    # parameters of a flight: places and instants are shared with its neighbours
    taken = (n * (flights + 1) + flights - 1) / flights
    found = []
    for i, some in enumerate(arcs.members):
        rest = arcs.residual[some][:, plain]
        freedom = max(np.isfinite(rest).sum() - taken, 1.0)
        p_value = chi2.sf(np.nansum(rest**2), freedom)
        if p_value < FALSE_ALARMS / 2 / flights:
            found.append(
                f"Flight {i + 1} is not ballistic within sigma: its residuals are "
                f"{np.sqrt(np.nansum(rest**2) / freedom):.2g} times as large (p-value "
                f"{p_value:.1g}). Perhaps times jitter, frames are there twice, or a "
                f"false point was tracked."
            )
    return found + _of_times(arcs)


def _of_lasting_contacts(arcs: Arcs, step: float) -> list[str]:
    """Findings of impacts that push one after the other, as a spring does while it is
    pressed: the longest runs of them. `step`: from frame to frame [s].
    """
    at = arcs.instants_of_impacts
    found = []
    first = 0
    while first < len(at):
        lasts = range(len(at) - 1, first, -1)
        last = next((k for k in lasts if _is_one_contact(arcs, first, k)), first)
        if last > first:
            lasting = at[last] - at[first]
            contact = WHOLE_CONTACT * lasting + 2 * step
            found.append(
                f"Impacts {first + 1} to {last + 1} are pushes within {lasting:.2g} s: "
                f"perhaps one contact that lasts, as of a spring or magnets. With "
                f"contact={contact:.2g} it is one impact."
            )
        first = last + 1
    return found


def _is_one_contact(arcs: Arcs, first: int, last: int) -> bool:
    """True of a run of impacts that may be pushes of one contact.

    It lasts less than WITHIN of the flights on both sides. Of bounces the velocity
    turns back in the flights between; here the whole run leaves ONWARD of the changes
    of velocity, at impacts and between them, or more.
    """
    at = arcs.instants_of_impacts
    lasting = at[last] - at[first]
    flight_before = at[first] - arcs.instants[first]
    flight_after = arcs.instants[last + 2] - at[last]
    if lasting >= WITHIN * min(flight_before, flight_after):
        return False
    pre, post = arcs.velocities()
    run = slice(first, last + 1)
    leaving = post[first:last]
    arriving = pre[first + 1 : last + 1]
    at_impacts = np.linalg.norm(post[run] - pre[run], axis=1)
    in_flights = np.linalg.norm(arriving - leaving, axis=1)
    path = at_impacts.sum() + in_flights.sum()
    return bool(np.linalg.norm(post[last] - pre[first]) > ONWARD * path)


def _of_times(arcs: Arcs) -> list[str]:
    """Finding of residuals that grow with the speed, as those by errors of times do."""
    if not arcs.errors.clock:
        return []
    return [
        "Residuals grow with the speed, as if times of frames erred by "
        f"{arcs.errors.clock:.2g} s: does the rate vary (phones), are pictures "
        "repeated, or is the clock that of a computer? The errors hold this."
    ]


def _unused(frames: Frames, members: Sequence[np.ndarray], shortest: int) -> list[str]:
    """Findings of seen frames that no flight uses: at both ends, and between."""
    seen = np.isfinite(frames.q).any(axis=1)
    used = np.zeros(len(seen), bool)
    used[np.concatenate(members)] = True
    order = np.flatnonzero(used)
    found = []
    parts = (("first", seen[: order[0]]), ("last", seen[order[-1] + 1 :]))
    for where, rows in parts:
        count = int(rows.sum())
        if count >= shortest:
            found.append(
                f"The {where} {len(rows)} frames fit no flight: their acceleration is "
                f"another, or their errors are larger. An impact there is not found."
            )
        elif count >= AT_AN_END:
            found.append(
                f"The {where} {len(rows)} frames are too few for a flight, and fit no "
                f"other: an impact there is not found."
            )
    inner = slice(order[0], order[-1] + 1)
    left_out = seen[inner] & ~used[inner]
    lost = int(left_out.sum())
    if lost > UNUSED * seen[inner].sum() + 1:
        found.append(
            f"{lost} of {int(seen[inner].sum())} frames are left out: they fit no "
            f"flight, or lie in a contact."
        )
    return found
