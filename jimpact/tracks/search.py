"""The search for impacts: division into flights, evidence, arcs, until they agree."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from jimpact.tracks.arcs import Arcs, Start, crossings, fit_arcs
from jimpact.tracks.clock import with_clock
from jimpact.tracks.division import SMALLEST_JUMP, divided, price_of_lost
from jimpact.tracks.evidence import Verdict, doubtful, judged, likely_errors
from jimpact.tracks.flight import Flight
from jimpact.tracks.frames import Frames, least_noise, median
from jimpact.tracks.held import free_flights
from jimpact.tracks.waves import Errors

# Times that frames are divided, each time by errors and a model that the last one gave.
# Three are common; where they do not agree after so many, the last ones are taken.
ROUNDS = 8
# Share by which the acceleration of frames may differ from the given one, or 100 or
# 1 000 times it, where a wrong sign or unit is named. Ten times more: any number is.
SAME_SIZE = 0.2
# Share by which sigma may differ from that which divided the frames. Ten times more
# would leave impacts of a wrong sigma; ten times less divides most tracks once more.
AGREEING = 0.1
# Factor of an unknown sigma where no flight was found, or a flight of frames fits none;
# and how often it is tried. Ten times would take all frames for one flight.
LARGER = 2.0
ENLARGED = 3
# Standard deviations of chi by which residuals must exceed a given sigma to take its
# place: of good tracks one in a thousand. Twice as many would leave stated errors half
# too small.
BEYOND_SIGMA = 3.3
# Frames on each side by which the instant of an impact is found where flights have
# waves, as a share of the time of the waves. Ten times more are waves themselves.
LOCAL = 0.1
FEWEST_LOCAL = 4
# Share of the windows by which a first acceleration is found. Three times more would
# take windows with an impact, a third of it would leave few.
BEST_WINDOWS = 0.25
# Residuals of arcs that meet, in errors of the flights alone, from which on one flight
# is none. Ten times more would pass arcs that miss one another.
UNMET = 2.0
# Of windows by which a first acceleration is found: their five frames lie this part of
# the track apart, at most as many frames as a flight has. Ten times less: they are next
# to each other, and noise hides the parabola; ten times more: windows hold impacts.
MOST_STRIDES = 32


@dataclass(frozen=True)
class Settings:
    """What `find_impacts` is told: whether sigma is `estimated`, and its arguments by
    name.
    """

    estimated: bool
    contact: float
    shortest: int
    window: float | None


@dataclass(frozen=True)
class Search:
    """State of the search: frames with their sigma, the model, and what was found by
    them.

    `candidates` are flights of the division, `verdict` those of them that there is
    evidence for.
    """

    frames: Frames
    flight: Flight
    settings: Settings
    candidates: list[np.ndarray]
    verdict: Verdict

    @property
    def straight(self) -> Frames:
        """Frames without what depends on velocity."""
        return self.flight.straight(self.frames)

    @property
    def leaves_a_flight(self) -> bool:
        """True if so many frames in a row as a flight has, between flights, fit none.

        Those of a contact aside.
        """
        flights = self.verdict.flights
        contact = self.settings.contact
        for before, after in pairwise(flights):
            between = slice(before[-1] + 1, after[0])
            lost = int(self.frames.seen[between].sum())
            t = self.frames.t
            lasting = t[after[0]] - t[before[-1]]
            if lost >= self.settings.shortest and lasting > contact:
                return True
        return False

    def agrees_with(self, flight: Flight, least: np.ndarray) -> bool:
        """True if frames were divided by the errors, `least` or more, and the model
        they gave.

        Accelerations agree where they bend flights by less than sigma, or a tenth of
        the waves; of flights that all have their own any do.
        """
        used = self.frames.sigma
        errors = self.verdict.errors
        given = np.maximum(errors.sigma, least)
        same = (np.abs(given - used) <= AGREEING * used).all()
        durations = [np.ptp(self.frames.t[rows]) for rows in self.verdict.flights]
        longest = max(durations)
        change = np.abs(flight.acceleration - self.flight.acceleration)
        bend = change * longest**2 / 8
        bend[self.verdict.bent.all(axis=0)] = 0.0
        sizes = ([wave.size for wave in waves] for waves in errors.waves)
        largest = [max(of_coordinate, default=0.0) for of_coordinate in sizes]
        unseen = np.maximum(used, AGREEING * np.array(largest))
        if self.frames.seen.any():
            speed = np.ptp(self.frames.q[self.frames.seen], axis=0)
        else:
            speed = 0.0
        change_of_drag = abs(flight.drag - self.flight.drag)
        slowing = change_of_drag * np.max(speed) ** 2 / 8
        unbent = (bend < unseen).all()
        return bool(same and unbent and slowing < used.max())


def first_flight(frames: Frames, flight: Flight, shortest: int) -> Flight:
    """The model with a first value of an unknown acceleration.

    Of three values, by windows of frames of three lengths, that by which a division
    costs less.
    """
    if not flight.unknown.any():
        return flight
    stride = _stride(frames, shortest)
    tried = []
    for k in {max(1, stride // 2), stride, 2 * stride}:
        found = np.array([curvature(frames.t, x, k) for x in frames.q.T])
        tried.append(np.where(flight.unknown, found, flight.acceleration))
    if len(tried) > 1:
        tried.sort(key=lambda a: divided(frames, a, shortest).cost)
    return flight.with_values(tried[0], flight.drag)


def _stride(frames: Frames, shortest: int) -> int:
    """Number of frames from one to the next of the five of a window."""
    stride = round(len(frames.t) / MOST_STRIDES)
    return min(max(1, stride), shortest)


def curvature(t: np.ndarray, x: np.ndarray, stride: int) -> float:
    """Median acceleration of parabolas through five frames in a row that are `stride`
    apart.

    Of frames that were seen, and of the quarter of windows that lie on their parabolas
    best, as many of the others have an impact in them; 0 of too few frames.
    """
    seen = np.isfinite(x)
    t = t[seen]
    x = x[seen]
    windows = len(x) - 4 * stride
    if windows < 1:
        return 0.0
    rows = np.arange(windows)[:, None] + stride * np.arange(5)
    times = t[rows]
    since = times - times.mean(axis=1, keepdims=True)
    size = (since**2).sum(axis=1)
    curve = since**2 / 2
    curve = curve - curve.mean(axis=1, keepdims=True)
    slope = (curve * since).sum(axis=1) / size
    curve = curve - slope[:, None] * since
    places = x[rows]
    along = (curve * places).sum(axis=1)
    found = along / (curve**2).sum(axis=1)
    rest = places - places.mean(axis=1, keepdims=True)
    rate = (rest * since).sum(axis=1) / size
    rest = rest - rate[:, None] * since - found[:, None] * curve
    square = (rest**2).sum(axis=1)
    return median(found[square <= np.quantile(square, BEST_WINDOWS)])


def searched(frames: Frames, flight: Flight, settings: Settings) -> Search:
    """Flights, model and errors that agree.

    1. Divide the frames into flights; leave out those in which the body is held.
    2. Take those for which there is evidence; find errors and what is unknown of the
    model.
    3. Again by these, until frames are divided by what they gave.
    """
    flight = first_flight(frames, flight, settings.shortest)
    found = _agreed(frames, flight, settings, np.zeros_like(frames.sigma))
    if not settings.estimated:
        return found
    least = found.frames.sigma
    for _ in range(ENLARGED):
        if not found.leaves_a_flight:
            return found
        least = LARGER * least
        larger = _agreed(frames, found.flight, settings, least)
        if not larger.leaves_a_flight:
            return larger
    return found


def _agreed(
    frames: Frames, flight: Flight, settings: Settings, least: np.ndarray
) -> Search:
    """Rounds of the search until they agree, or come back to what an earlier one used;
    frames are divided by `least` sigma (n,) or more.
    """
    sigma = np.maximum(frames.sigma, least)
    search = _divided(frames.with_sigma(sigma), flight, settings)
    earlier: list[np.ndarray] = []
    for _ in range(ROUNDS):
        fitted = flight.fitted_to(search.frames, search.verdict.flights)
        if search.agrees_with(fitted, least):
            break
        flight = fitted
        sigma = np.maximum(search.verdict.errors.sigma, least)
        if any(np.allclose(sigma, used, AGREEING, 0.0) for used in earlier):
            break
        earlier.append(search.frames.sigma)
        search = _divided(frames.with_sigma(sigma), flight, settings)
    return search


def _divided(frames: Frames, flight: Flight, settings: Settings) -> Search:
    """One round, by this sigma; by a larger one where it is unknown and none flies."""
    for _ in range(ROUNDS):
        straight = flight.straight(frames)
        flights = divided(straight, flight.acceleration, settings.shortest).flights
        if flights or not settings.estimated:
            break
        frames = frames.with_sigma(LARGER * frames.sigma)
    if not flights:
        raise ValueError(
            f"Argument `q` must hold a flight, but no frames in a row lie on an arc "
            f"within sigma = {[float(f'{x:.2g}') for x in frames.sigma]} at an "
            f"acceleration of {flight.acceleration.tolist()}: "
            f"{_likely_cause(frames, flight, settings.shortest)}"
        )
    free = free_flights(straight, flight.known_acceleration, flights)
    verdict = judged(straight, free, flight, settings.estimated)
    durations = [np.ptp(frames.t[rows]) for rows in verdict.flights]
    verdict = verdict.of_flights([x > settings.contact for x in durations])
    return Search(frames, flight, settings, flights, verdict)


def _likely_cause(frames: Frames, flight: Flight, shortest: int) -> str:
    """Question about t, the sign or the unit: by the `curvature` of frames.

    It is that along the axis of the largest given acceleration. Its opposite: the sign;
    100 or 1 000 times it: the unit. Steps dt of a whole number of seconds, one or more:
    t may count frames.
    """
    step = frames.step
    axis = int(np.argmax(np.abs(flight.acceleration)))
    given = float(flight.acceleration[axis])
    if step >= 1 and step == round(step):
        return f"are the steps of t, {step:g} s, numbers of frames?"
    stride = _stride(frames, shortest)
    seen = curvature(frames.t, frames.q[:, axis], stride)
    if given == 0 or seen == 0:
        return "are these the units of q and t?"
    ratio = seen / given
    if abs(ratio + 1) < SAME_SIZE:
        return f"frames show {seen:.3g}: is the sign of the acceleration right?"
    for unit, size in (("cm", 100.0), ("mm", 1000.0)):
        if abs(abs(ratio) / size - 1) < SAME_SIZE:
            return f"frames show {seen:.3g}: is q in {unit}?"
    return f"frames show {seen:.3g} (median): are these the units of q and t?"


def fitted_arcs(search: Search) -> tuple[Arcs, list[np.ndarray]]:
    """Arcs of the flights of a search, and these, joined where arcs show no impact.

    1. Fit the arcs; first at fixed instants, as nothing determines one without a jump.
    2. Join two flights without a jump of SMALLEST_JUMP, or as `_without_false` says;
       fit again.
    3. Find the errors again, where flights with waves were joined; fit again.
    4. Take the errors of the residuals, where they are unknown, or clearly larger in
       most flights; then also those of times, where residuals grow with the speed; fit
       again.

    A coordinate in which all flights bend has no acceleration in common.
    """
    verdict = search.verdict
    contact = search.settings.contact
    bent_in_all = np.all(verdict.bent, axis=0)
    flight = verdict.flight.without_common(bent_in_all)
    start = Start(verdict.flights, flight, verdict.errors, verdict.bent, contact)
    moving = False
    while True:
        arcs = _arcs(search.frames, start, moving)
        jumps = arcs.jumps()
        if jumps.size and jumps.min() < SMALLEST_JUMP:
            start = start.joined_at(int(np.argmin(jumps)))
            continue
        if jumps.size and not moving:
            moving = True
            continue
        joined = _without_false(search, arcs, start)
        if joined is None:
            break
        start = joined
    fewer = len(start.flights) < len(verdict.flights)
    if fewer and verdict.errors.number_of_waves:
        start = with_likely_errors(search, start)
        arcs = _arcs(search.frames, start)
    sigma = of_residuals(arcs, search.frames)
    given = start.errors.sigma
    relative_error = BEYOND_SIGMA / np.sqrt(2 * _freedom(arcs))
    larger = of_most_flights(arcs) > given * (1 + relative_error)
    if search.settings.estimated or larger.any():
        if not search.settings.estimated:
            sigma = np.where(larger, sigma, given)
        frames, clock = with_clock(arcs, search.frames)
        errors = replace(start.errors, sigma=sigma, clock=clock)
        instants = arcs.instants_of_impacts
        again = replace(start, errors=errors, flight=arcs.flight, instants=instants)
        arcs = _arcs(frames, again)
    return arcs, start.flights


def with_likely_errors(search: Search, start: Start) -> Start:
    """The start with the most likely errors, model and bends of its flights."""
    straight = search.straight
    speeds = straight.speeds(start.flights)
    estimated = search.settings.estimated
    errors, flight, bent = likely_errors(
        straight, start.flights, start.flight, estimated, speeds
    )
    flight = flight.without_common(np.all(bent, axis=0))
    return replace(start, errors=errors, flight=flight, bent=bent)


def _without_false(search: Search, arcs: Arcs, start: Start) -> Start | None:
    """The start with a flight that is none joined to a neighbour, or left out; None:
    all are.

    A flight between two impacts whose instants leave it fewer frames than a flight has,
    by more than one at each end; it is left out where its frames as lost ones cost
    less. And where residuals are UNMET times the errors that
    flights alone have, that with the largest ones, if residuals are smaller without it:
    its arc misses others.
    """
    if not arcs.impacts:
        return None
    t = search.frames.t
    enough = max(search.settings.shortest - 2, 2)
    for i, some in enumerate(arcs.members):
        if i in (0, arcs.impacts):
            continue  # the first and the last flight
        first, last = arcs.instants[i : i + 2]
        within = (t[some] >= first) & (t[some] <= last)
        if within.sum() < enough:
            square, joined = _joined_best(search.frames, start, i)
            without = start.without(i)
            rest = _arcs(search.frames, without).residual
            n = len(arcs.errors.sigma)
            left_out = price_of_lost(n) * len(some)
            if np.nansum(rest**2) + left_out < square:
                return without
            return joined
    unmet = of_residuals(arcs, search.frames) > UNMET * arcs.errors.sigma
    if unmet.any():
        sizes = [np.nanmean(arcs.residual[rows] ** 2) for rows in arcs.members]
        worst = int(np.argmax(sizes))
        square, joined = _joined_best(search.frames, start, worst)
        if square < np.nansum(arcs.residual**2):
            return joined
    return None


def _joined_best(frames: Frames, start: Start, flight: int) -> tuple[float, Start]:
    """chi^2 of all arcs, and a flight joined to the neighbour that makes it least."""
    tried = []
    for k in (flight - 1, flight):
        if 0 <= k < len(start.flights) - 1:
            joined = start.joined_at(k)
            rest = _arcs(frames, joined).residual
            tried.append((float(np.nansum(rest**2)), k))
    square, k = min(tried)
    return square, start.joined_at(k)


def _arcs(frames: Frames, start: Start, moving: bool = True) -> Arcs:
    """Arcs of flights; where these have waves, instants are found by frames near them
    alone.

    Unless `moving` instants stay where lines cross. Waves go on across an impact, so
    that measured places meet there, though arcs are uncertain by the waves; but where a
    contact lasts longer they do not meet.
    """
    if not moving and start.instants is None:
        instants = crossings(frames, start.flights, start.flight)
        still = replace(
            start, instants=instants, instant_errors=np.zeros_like(instants)
        )
        return fit_arcs(frames, still)
    waves = start.errors.waving
    if not waves.any() or len(start.flights) < 2:
        return fit_arcs(frames, start)
    shortest = min(wave.time for some in start.errors.waves for wave in some)
    near = max(FEWEST_LOCAL, int(LOCAL * shortest / frames.step))
    if start.contact > near * frames.step:
        return fit_arcs(frames, start)  # frames that near would lie in the contact
    white = Errors.white(start.errors.sigma)
    nothing = np.zeros_like(waves)
    model = replace(start.flight, drag_unknown=False, unknown=nothing)
    bent = np.ones((2, len(waves)), bool)
    at: list[float] = []
    within: list[float] = []
    for before, after in pairwise(start.flights):
        two = [before[-near:], after[:near]]
        start_here = Start(two, model, white, bent, start.contact)
        local = fit_arcs(frames, start_here)
        at.extend(local.instants_of_impacts)
        within.extend(local.instant_errors())
    instants = np.array(at)
    known = replace(start, instants=instants, instant_errors=np.array(within))
    return fit_arcs(frames, known)


def windowed(search: Search, arcs: Arcs, window: float) -> Arcs:
    """Arcs by frames of each flight within `window` [s] of its impacts only.

    A flight keeps its one arc, so that velocities of both its ends stay those of one
    arc.
    """
    near = []
    last = len(arcs.members) - 1
    for i, some in enumerate(arcs.members):
        first_end = i + (i == 0)
        last_end = i + 1 - (i == last)
        ends = arcs.instants[first_end : last_end + 1]
        t = search.frames.t[some]
        distance = np.abs(t[:, None] - ends)
        near.append(some[(distance <= window).any(axis=1)])
    if min(map(len, near)) < 3:
        raise ValueError(
            f"Argument `window` must leave 3 frames or more of each flight, but "
            f"{window:g} s leave {min(map(len, near))}."
        )
    contact = search.settings.contact
    instants = arcs.instants_of_impacts
    start = Start(near, arcs.flight, arcs.errors, arcs.bent, contact, instants)
    return _arcs(search.frames, start)


def of_residuals(arcs: Arcs, frames: Frames) -> np.ndarray:
    """Standard errors (n,) of residuals of coordinates without waves.

    Equation: `sigma^2 chi^2 / (freedom - 2)`, the mean of the square of sigma where all
    its logarithms were as likely before: of few frames sigma itself errs, and errors
    that are normal with this sigma scatter by 1. Of four degrees of freedom or fewer
    chi^2 / 2.

    Freedom: frames, less K + 2 places, 1/n of K instants, accelerations that were
    found.
    """
    sigma = arcs.errors.sigma
    freedom = np.maximum(_freedom(arcs) - 2, 2.0)
    square = np.nansum(arcs.residual**2, axis=0)
    scale = np.sqrt(square / freedom)
    found = np.maximum(sigma * scale, least_noise(frames.q))
    return np.where(arcs.errors.waving, sigma, found)


def of_most_flights(arcs: Arcs) -> np.ndarray:
    """Standard errors (n,) that residuals exceed in flights of half of all frames.

    A body that slides between flights leaves large residuals there, but not in the
    others.
    """
    squares = arcs.residual**2
    sizes = np.array([np.nanmean(squares[rows], axis=0) for rows in arcs.members])
    counts = [len(rows) for rows in arcs.members]
    by_frame = np.repeat(sizes, counts, axis=0)
    middle = np.nanmedian(by_frame, axis=0)
    return arcs.errors.sigma * np.sqrt(middle)


def _freedom(arcs: Arcs) -> np.ndarray:
    """Frames (n,) less what was fitted to them, see `of_residuals`; 1 at least."""
    n = len(arcs.errors.sigma)
    ends = len(arcs.instants)
    seen = np.isfinite(arcs.residual).sum(axis=0)
    own = arcs.bent.sum(axis=0) + arcs.flight.unknown
    of_instants = (ends - 2) / n
    return np.maximum(seen - ends - of_instants - own, 1.0)


def doubts(search: Search, arcs: Arcs) -> np.ndarray:
    """True (K,) for impacts that a flight of another acceleration explains about as
    well.
    """
    members: Sequence[np.ndarray] = arcs.members
    return doubtful(search.straight, members, arcs.flight, arcs.errors)
