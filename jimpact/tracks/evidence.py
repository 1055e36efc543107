"""How many impacts a track has evidence for, and how large the errors of its places
are.

A candidate is an impact where its two flights cost less than one:
`r^T C^-1 r + log |C|` of their residuals, C the covariance of the errors, and a price
for each flight. C has waves where residuals show them: then a jump of velocity counts
against what flights do without one. Waves and impacts explain one another, so that both
are found by turns, once from no waves on, once from the largest ones; what costs less
in all is taken.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from jimpact.tracks.division import price
from jimpact.tracks.flight import Flight
from jimpact.tracks.frames import Frames, least_noise, neighbours
from jimpact.tracks.likelihood import (
    SHARES,
    Coordinate,
    Likelihood,
    Likely,
    price_of_waves,
    residual_squares,
)
from jimpact.tracks.waves import Errors, Wave

# Cost by which a flight of another acceleration must be better than an impact to take
# it away, and an impact better than it not to be doubtful; by chance one in a thousand
# gains less. Ten times more would doubt soft impacts; ten times less, and drag would
# pass as impacts.
LEAST_GAIN = 10.8
# Cost that each impact must save beside its price where waves explain the track without
# it. Waves of lenses and tables are smoother than those of the model, so that impacts
# would take their place; ten times more would lose impacts of 15 standard errors.
RATHER_FEW = LEAST_GAIN
ROUNDS = 8  # of impacts and waves by turns; three are common
# Velocity of waves, their size over their time, as a share of the speed of the flights:
# more are no errors of places. Ten times more would take bounces for waves, ten times
# less would take the waves of most lenses for impacts.
WAVE_SPEED = 0.05
# Candidates that the first waves are long, as they part a wave; ten times more part
# none.
WAVED = 3.0
LONG_WAVES = 15.0  # frames of the first waves; of three times fewer they are bounces
# White errors of the start from few impacts where frames are few, in those of the start
# from many. Ten times more would take bounces for errors, ten times less starts alike.
COARSER = 4.0
# Share of the frames in flights that are not held from which on those that bend make
# all bend. A tenth of it would free all flights of a body that slides at times.
MOSTLY = 0.4
# Jump of a velocity, in velocities of the waves, up to which it is theirs: waves move
# places so without an impact. Of a real wave few are larger; ten times more would lose
# impacts of half the speed of the flights.
OF_WAVES = 2.0


@dataclass(frozen=True)
class Verdict:
    """What is left of candidates.

    Fields: flights; their model; errors of places; `bent` (F, n), where a flight has an
    acceleration of its own; how many candidates `errors` alone make, and how many a
    flight of another acceleration explains.
    """

    flights: list[np.ndarray]
    flight: Flight
    errors: Errors
    bent: np.ndarray
    within_errors: int
    bends: int

    def of_flights(self, kept: Sequence[bool]) -> "Verdict":
        """That of some flights, as others lie in a contact; all where none is kept."""
        if not any(kept):
            return self
        flights = [some for some, stays in zip(self.flights, kept) if stays]
        stay = np.array(kept)
        return replace(self, flights=flights, bent=self.bent[stay])


def price_of_bend(frames: int) -> float:
    """Price of an acceleration of a flight's own in one coordinate: `ln T`, and
    LEAST_GAIN.
    """
    return float(np.log(frames)) + LEAST_GAIN


class Costs(NamedTuple):
    """`r^T C^-1 r + log |C|` (F,) of flights: on lines, on parabolas, on the cheaper.

    A parabola of a coordinate has a price in the last. `ends` (F, 2, n) are the
    velocities of the lines at the first and the last frame.
    """

    line: np.ndarray
    parabola: np.ndarray
    least: np.ndarray
    ends: np.ndarray

    def jumps(self) -> np.ndarray:
        """Jumps (F - 1, n) of the velocity from a flight to the next one."""
        first, last = np.moveaxis(self.ends, 1, 0)
        before, _ = neighbours(last)
        _, after = neighbours(first)
        return after - before


class FlightCosts:
    """Costs of flights, each by itself, by a model and errors; each is computed once.

    A flight is known by its first and last frame.
    """

    def __init__(self, frames: Frames, flight: Flight, errors: Errors) -> None:
        self.frames = frames
        self.flight = flight
        self.errors = errors
        self.known: dict[tuple[int, int], Costs] = {}

    def of(self, flights: Sequence[np.ndarray]) -> Costs:
        """Costs of these flights, lists of frames."""
        names = [(int(some[0]), int(some[-1])) for some in flights]
        named = zip(names, flights)
        new = {name: rows for name, rows in named if name not in self.known}
        if new:
            found = zip(*self._computed(list(new.values())))
            costs = (Costs(*of_flight) for of_flight in found)
            self.known.update(zip(new, costs))
        rows = [self.known[name] for name in names]
        columns = map(np.array, zip(*rows))
        return Costs(*columns)

    def of_pairs(self, flights: Sequence[np.ndarray]) -> Costs:
        """Costs (F - 1,) of neighbouring flights as one."""
        joined = map(np.concatenate, pairwise(flights))
        return self.of(list(joined))

    def _computed(self, flights: Sequence[np.ndarray]) -> Costs:
        """Costs of flights that are not known."""
        frames = self.frames
        line = np.zeros(len(flights))
        parabola = np.zeros(len(flights))
        least = np.zeros(len(flights))
        n = frames.q.shape[1]
        ends = np.zeros((len(flights), 2, n))
        own = price_of_bend(len(frames.t))
        for c in range(n):
            some = Coordinate.of(frames, flights, self.flight, c)
            if not len(some.t):
                continue
            acceleration = self.flight.acceleration[c]
            ends[some.flights, :, c] = some.end_velocities(acceleration)
            covariance = self.errors.of(c, some.t, some.starts)
            grams = some.grams(covariance)
            log_det = covariance.log_det()
            straight = residual_squares(grams, 2) + log_det
            bent = residual_squares(grams, 3) + log_det
            line[some.flights] += straight
            parabola[some.flights] += bent
            least[some.flights] += np.minimum(straight, bent + own)
        return Costs(line, parabola, least, ends)


# -------------------------------------------------------------------- errors of places


class Explained(NamedTuple):
    """What explains the residuals of one coordinate in its flights.

    Fields: the most likely errors; `bent` (F,), where flights have an acceleration of
    their own; that of all flights; `most_bend`: most frames are in flights that do.
    """

    errors: Likely
    bent: np.ndarray
    acceleration: float
    most_bend: bool


@dataclass(frozen=True)
class CoordinateTask:
    """One coordinate in all flights, in which errors are looked for.

    Fields: likelihood of errors on lines; its quick waves; the acceleration of the
    lines; the step from frame to frame [s].
    """

    on_lines: Likelihood
    quick: tuple[Wave, ...]
    acceleration: float
    step: float

    @classmethod
    def of(
        cls,
        frames: Frames,
        some: Coordinate,
        flight: Flight,
        c: int,
        known: float | None,
        fastest: float,
    ) -> "CoordinateTask":
        """Coordinate c; `known`: its sigma; `fastest`: velocity of waves at most."""
        acceleration = float(flight.acceleration[c])
        if flight.unknown[c]:
            some, acceleration = some.at_best(acceleration)
        straight = np.zeros(len(some.starts), bool)
        least = float(least_noise(frames.q)[c])
        on_lines = Likelihood(some, known, least, fastest, straight)
        quick = on_lines.quick_waves(frames.step)
        return cls(on_lines, quick, acceleration, frames.step)

    def likely(self, bent: np.ndarray) -> Likely:
        """The most likely errors where these flights (F,) are parabolas, others
        lines.
        """
        likelihood = replace(self.on_lines, bent=bent)
        return likelihood.most_likely(self.step, self.quick)

    def explained(self, held: np.ndarray) -> Explained:
        """Lines, or parabolas in flights that bend, whichever cost less.

        Where flights with MOSTLY of the frames bend, but for those that are `held`
        (F,), all do: a table or drag bends all.
        """
        some = self.on_lines.some
        of_each = price_of_bend(len(some.t))
        curved = self.on_lines.curved(of_each)
        free = ~held[some.flights]
        in_curved = some.counts[curved & free].sum()
        most_bend = bool(in_curved > MOSTLY * some.counts[free].sum())
        if most_bend:
            curved = self.that_can_bend
        straight = self.likely(np.zeros_like(curved))
        if curved.any():
            bent = self.likely(curved)
            price_of_all = curved.sum() * of_each
            if bent.evidence + price_of_all < straight.evidence:
                return Explained(bent, curved, self.acceleration, most_bend)
        none = np.zeros_like(curved)
        return Explained(straight, none, self.acceleration, most_bend)

    @property
    def that_can_bend(self) -> np.ndarray:
        """True (F,) for flights with more frames than a parabola has values."""
        return self.on_lines.some.counts > 3


def likely_errors(
    frames: Frames,
    flights: Sequence[np.ndarray],
    flight: Flight,
    estimated: bool,
    speeds: np.ndarray,
) -> tuple[Errors, Flight, np.ndarray]:
    """Most likely errors of the places, the model, and which flights bend (F, n).

    Errors are waves, and white ones, estimated if `estimated`, else of the known sigma.
    A flight that bends in a coordinate has an acceleration of its own there: a parabola
    in the place of a line. Each coordinate is judged alone, by BIC: errors by the
    restricted likelihood, bending by the likelihood. Then `_bent_alike` compares
    coordinates. One with no more values than two for each flight keeps its sigma, and
    has no waves. `speeds` (n,): root mean squares over the flights, which limit waves.
    """
    n = len(frames.sigma)
    held = held_rather(frames, flights, flight)
    tasks: dict[int, CoordinateTask] = {}
    found: dict[int, Explained] = {}
    for c in range(n):
        coordinate = Coordinate.of(frames, flights, flight, c)
        if len(coordinate.t) <= 2 * len(coordinate.starts):
            continue
        known = None
        if not estimated:
            known = float(frames.sigma[c])
        fastest = WAVE_SPEED * speeds[c]
        tasks[c] = CoordinateTask.of(frames, coordinate, flight, c, known, fastest)
        found[c] = tasks[c].explained(held)
    angles = np.array(frames.angles or (False,) * n)
    found = _bent_alike(found, tasks, angles)
    sigma = frames.sigma.copy()
    waves: list[tuple[Wave, ...]] = [()] * n
    bent = np.zeros((len(flights), n), bool)
    acceleration = flight.acceleration.copy()
    for c, explained in found.items():
        sigma[c] = explained.errors.sigma
        waves[c] = explained.errors.waves
        acceleration[c] = explained.acceleration
        bent[tasks[c].on_lines.some.flights, c] = explained.bent
    model = flight.with_values(acceleration, flight.drag)
    return Errors(sigma, tuple(waves)), model, bent


def held_rather(
    frames: Frames, flights: Sequence[np.ndarray], flight: Flight
) -> np.ndarray:
    """True (F,) for flights nearer to no acceleration than to a known one, in some
    coordinate.
    """
    held = np.zeros(len(flights), bool)
    given = flight.acceleration * ~flight.unknown
    for c in map(int, np.flatnonzero(given)):
        some = Coordinate.of(frames, flights, flight, c)
        size = np.add.reduceat(some.curve**2, some.starts)
        along = np.add.reduceat(some.curve * some.rest, some.starts)
        excess = along / np.maximum(size, 1e-300)
        own = flight.acceleration[c]
        from_none = np.abs(excess + own)
        held[some.flights] |= from_none < abs(own) / 2
    return held


# ------------------------------------------------------------------- which are impacts


def judged(
    frames: Frames, flights: Sequence[np.ndarray], flight: Flight, estimated: bool
) -> Verdict:
    """The impacts among candidates, the ends of `flights`, and the errors of the
    places.

    From two starts, no waves and the largest ones, or, of frames that are too few for
    these, an unknown sigma that is COARSER; what costs less is taken.
    """
    speeds = frames.speeds(flights)
    task = _Task(frames, flights, estimated, speeds)
    errors, model, _ = task.likely_errors(flights, flight)
    found = [task.settled(errors, model)]
    if len(flights) > 1:
        largest = largest_waves(frames, flights, speeds)
        if largest.number_of_waves:
            found.append(task.settled(largest, flight, found[0]))
        elif estimated:
            coarse = Errors.white(COARSER * errors.sigma)
            found.append(task.settled(coarse, flight, found[0]))
    return _cheapest(frames, found)


def largest_waves(
    frames: Frames, flights: Sequence[np.ndarray], speeds: np.ndarray
) -> Errors:
    """Waves as fast as WAVE_SPEED allows, over WAVED candidates: a start from few
    impacts.

    None where no flight is long enough for them.
    """
    durations = [np.ptp(frames.t[some]) for some in flights]
    if SHARES.max() * sum(durations) < LONG_WAVES * frames.step:
        return Errors.white(frames.sigma)
    usual = WAVED * float(np.median(durations))
    time = max(usual, LONG_WAVES * frames.step)
    sizes = (WAVE_SPEED * speed * time for speed in speeds)
    waves = tuple((Wave(size, time),) for size in sizes)
    return Errors(frames.sigma, waves)


def _cheapest(frames: Frames, found: Sequence[Verdict]) -> Verdict:
    """The verdict of least cost; where one of them has waves, each flight costs
    RATHER_FEW more.
    """
    if any(verdict.errors.number_of_waves for verdict in found):
        cost_of_flight = RATHER_FEW
    else:
        cost_of_flight = 0.0

    def cost(verdict: Verdict) -> float:
        """The cost of a verdict, that of its flights included."""
        return _cost(frames, verdict) + cost_of_flight * len(verdict.flights)

    return min(found, key=cost)


def _bent_alike(
    found: dict[int, Explained], tasks: dict[int, CoordinateTask], angles: np.ndarray
) -> dict[int, Explained]:
    """What explains each coordinate, once places are compared with places, and
    `angles` (n,) with angles.

    Where most flights bend in one of a kind, all that can bend in the others of that
    kind: drag and spin bend all of them, though one by little.
    """
    bent = dict(found)
    for kind in (angles, ~angles):
        alike = [c for c in found if kind[c]]
        if not any(found[c].most_bend and found[c].bent.any() for c in alike):
            continue
        for c in alike:
            if not found[c].bent.any():
                curved = tasks[c].that_can_bend
                errors = tasks[c].likely(curved)
                bent[c] = found[c]._replace(errors=errors, bent=curved)
    return bent


@dataclass(frozen=True)
class _Task:
    """Candidates to be judged: frames, flights between them, is sigma estimated, their
    speeds.
    """

    frames: Frames
    flights: Sequence[np.ndarray]
    estimated: bool
    speeds: np.ndarray

    def likely_errors(
        self, flights: Sequence[np.ndarray], flight: Flight
    ) -> tuple[Errors, Flight, np.ndarray]:
        """Errors of places, the model and which flights are bent, by some flights."""
        return likely_errors(self.frames, flights, flight, self.estimated, self.speeds)

    def settled(
        self, errors: Errors, model: Flight, other: Verdict | None = None
    ) -> Verdict:
        """Impacts and errors that agree, from these errors on; `other` where impacts
        are the same.

        Of the rounds that which costs least: joined flights that fit badly would join
        more.
        """
        verdict = _joined(self.frames, self.flights, model, errors)
        if other is not None and len(other.flights) == len(verdict.flights):
            return other
        found = []
        for _ in range(ROUNDS):
            errors, model, bent = self.likely_errors(verdict.flights, model)
            found.append(replace(verdict, errors=errors, flight=model, bent=bent))
            new = _joined(self.frames, self.flights, model, errors)
            same = len(new.flights) == len(verdict.flights)
            verdict = new
            if same:
                break
        return _cheapest(self.frames, found)


def _cost(frames: Frames, verdict: Verdict) -> float:
    """Cost of all flights: of residuals, prices of flights and of waves."""
    known = FlightCosts(frames, verdict.flight, verdict.errors)
    costs = known.of(verdict.flights)
    counts = map(len, verdict.errors.waves)
    of_waves = sum(price_of_waves(len(frames.t), count) for count in counts)
    least = np.minimum(costs.line, costs.parabola)
    of_flights = price(*frames.q.shape) * len(verdict.flights)
    return float(least.sum() + of_waves) + of_flights


def _joined(
    frames: Frames, flights: Sequence[np.ndarray], flight: Flight, errors: Errors
) -> Verdict:
    """Flights, neighbours joined where one costs less than two, until none does.

    In each round the pairs that cost least among their neighbours are joined. The
    verdict counts who explained them: errors of the places (`_Joining.by_line`), or a
    bend of the flight (`by_bend`).
    """
    flights = list(flights)
    by_errors = 0
    by_bends = 0
    costs = FlightCosts(frames, flight, errors)
    while len(flights) > 1:
        joining = _Joining.of(costs, flights, frames, errors)
        pairs = joining.pairs()
        if not pairs:
            break
        for k in reversed(pairs):
            if joining.by_line[k] <= joining.by_bend[k]:
                by_errors += 1
            else:
                by_bends += 1
            both = slice(k, k + 2)
            flights[both] = [np.concatenate(flights[both])]
    n = frames.q.shape[1]
    straight = np.zeros((len(flights), n), bool)
    return Verdict(flights, flight, errors, straight, by_errors, by_bends)


class _Joining(NamedTuple):
    """What neighbours (F - 1,) cost as one flight, more than as two; < 0: less.

    Fields: cost of one line, which saves the price of a flight; of one flight that may
    bend, which must save LEAST_GAIN; and the jump of velocities over OF_WAVES of that
    of waves.
    """

    by_line: np.ndarray
    by_bend: np.ndarray
    jump: np.ndarray

    @classmethod
    def of(
        cls,
        costs: "FlightCosts",
        flights: Sequence[np.ndarray],
        frames: Frames,
        errors: Errors,
    ) -> "_Joining":
        """Costs of joining these flights by these errors."""
        alone = costs.of(flights)
        both = costs.of_pairs(flights)
        apart = np.add(*neighbours(alone.least))
        of_waves = OF_WAVES * errors.speeds_of_waves
        jumps = np.abs(alone.jumps()) / np.maximum(of_waves, 1e-300)
        return cls(
            by_line=both.line - apart - price(*frames.q.shape),
            by_bend=both.least - apart + LEAST_GAIN,
            jump=jumps.max(axis=1),
        )

    def pairs(self) -> list[int]:
        """The first of each two flights that are to be joined: they cost less so, or
        waves explain their jump, and their neighbours cost more; of equal ones the
        first.
        """
        extra_cost = np.minimum(self.by_line, self.by_bend)
        # whatever it costs where the jump is that of waves
        by_waves = np.minimum(extra_cost, self.jump - 1)
        extra_cost = np.where(self.jump < 1, by_waves, extra_cost)
        before = np.append(np.inf, extra_cost)[:-1]
        _, after = neighbours(np.append(extra_cost, np.inf))
        cheapest = (extra_cost <= before) & (extra_cost <= after)
        taken: list[int] = []
        for k in map(int, np.flatnonzero((extra_cost < 0) & cheapest)):
            if not taken or k > taken[-1] + 1:
                taken.append(k)
        return taken


def doubtful(
    frames: Frames, flights: Sequence[np.ndarray], flight: Flight, errors: Errors
) -> np.ndarray:
    """True (K,) for impacts that a flight of another acceleration explains about as
    well.
    """
    if len(flights) < 2:
        return np.zeros(0, bool)
    costs = FlightCosts(frames, flight, errors)
    alone = costs.of(flights)
    both = costs.of_pairs(flights)
    extra = frames.q.shape[1]  # values that lines which do not meet have more
    two = np.add(*neighbours(alone.least))
    return both.least < two + LEAST_GAIN + extra


def as_white(errors: Errors, sigma: np.ndarray) -> Errors:
    """The same waves beside other white errors."""
    return replace(errors, sigma=sigma)
