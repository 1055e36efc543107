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
from jimpact.tracks.frames import Frames, least_noise, neighbours, noise
from jimpact.tracks.waves import Covariance, Errors

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
# Smallest size of waves, in sigma, and their times as shares of the longest flight.
# Shares of ten in the place of three miss waves by half of their likelihood.
SMALLEST_WAVES = 0.3
SHARES = 0.3 * 3.0 ** -np.arange(5)
FINER = (3.0**-0.5, 3.0**0.5)  # of the best size, the same of its time
# Velocity of waves, their size over their time, as a share of the speed of the flights:
# more are no errors of places. Ten times more would take bounces for waves, ten times
# less would take the waves of most lenses for impacts.
WAVE_SPEED = 0.05
WAVED = (
    # candidates that the first waves are long, as they part a wave; ten times more part
    # none
    3.0
)
# Least time of waves, in frames: shorter ones are white, as a period has 2 pi times.
# Ten times more is a flight.
LEAST_TIME = 5.0
LONG_WAVES = 15.0  # frames of the first waves; of three times fewer they are bounces
# White errors of the start from few impacts where frames are few, in those of the start
# from many. Ten times more would take bounces for errors, ten times less starts alike.
COARSER = 4.0
# Of means of frames; ten times more would miss waves of half a flight.
LEAST_MEANS = 2.0
# Share of the frames in flights that are not held from which on those that bend make
# all bend. A tenth of it would free all flights of a body that slides at times.
MOSTLY = 0.4
TURNS = 2  # of white errors beside waves; more change them by less than a hundredth
# Share of the diagonal of normal matrices by which they are kept from being singular
# where a flight has one frame. Ten times more is still far below noise.
ROUNDED = 1e-12
# Frames by which waves are looked for; more are taken together. Ten times more take ten
# times as long, and waves are slow.
MOST_FRAMES = 150
# Frames whose means are looked at for waves, and standard deviations by which they must
# be larger than those of white errors. Twice as many would miss waves as large as the
# noise.
BINS = (4, 16, 64, 256)
SHOWN = 2.5
# Cost that waves must save: BIC of their size and time, and what one good track in a
# hundred saves.
LEAST_SAVED = 4.0


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
        return replace(self, flights=flights, bent=self.bent[np.array(kept)])


def price_of_bend(frames: int) -> float:
    """Price of an acceleration of a flight's own in one coordinate: `ln T`, and
    LEAST_GAIN.
    """
    return float(np.log(frames)) + LEAST_GAIN


class Costs(NamedTuple):
    """`r^T C^-1 r + log |C|` (F,) of flights: on lines, on parabolas, on the cheaper.

    A parabola of a coordinate has a price in the last.
    """

    line: np.ndarray
    parabola: np.ndarray
    least: np.ndarray


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
        new = {
            name: some for name, some in zip(names, flights) if name not in self.known
        }
        if new:
            found = self._computed(list(new.values()))
            self.known |= {name: Costs(*x) for name, x in zip(new, zip(*found))}
        return Costs(*np.array([self.known[name] for name in names]).reshape(-1, 3).T)

    def of_pairs(self, flights: Sequence[np.ndarray]) -> Costs:
        """Costs (F - 1,) of neighbouring flights as one."""
        return self.of([np.concatenate(two) for two in pairwise(flights)])

    def _computed(self, flights: Sequence[np.ndarray]) -> Costs:
        """Costs of flights that are not known."""
        frames = self.frames
        line = np.zeros(len(flights))
        parabola = np.zeros(len(flights))
        least = np.zeros(len(flights))
        own = price_of_bend(len(frames.t))
        for c in range(frames.q.shape[1]):
            some = Coordinate.of(frames, flights, self.flight, c)
            if not len(some.t):
                continue
            covariance = self.errors.of(c, some.t, some.starts)
            grams = some.grams(covariance)
            log_det = covariance.log_det()
            straight = _rest(grams, 2) + log_det
            bent = _rest(grams, 3) + log_det
            line[some.flights] += straight
            parabola[some.flights] += bent
            least[some.flights] += np.minimum(straight, bent + own)
        return Costs(line, parabola, least)


@dataclass(frozen=True)
class Coordinate:
    """Frames of one coordinate in all flights, in turn: what a line leaves of them.

    Fields: times t (N,); `rest` (N,) of the least squares of a line in each flight;
    `curve` (N,), t^2 / 2 without its line; `starts` (F,); `flights` (F,), their
    numbers.
    """

    t: np.ndarray
    since: np.ndarray
    curve: np.ndarray
    rest: np.ndarray
    starts: np.ndarray
    flights: np.ndarray

    @classmethod
    def of(
        cls, frames: Frames, flights: Sequence[np.ndarray], flight: Flight, c: int
    ) -> "Coordinate":
        """Coordinate c of these flights, acceleration taken away."""
        rows = np.concatenate(flights)
        number = np.repeat(np.arange(len(flights)), [len(some) for some in flights])
        ok = np.isfinite(frames.q[rows, c])
        rows = rows[ok]
        number = number[ok]
        starts = np.flatnonzero(np.diff(number, prepend=-1))
        t = frames.t[rows]
        since = t - _mean(t, starts)
        places = frames.q[rows, c] - flight.acceleration[c] * since**2 / 2
        curve = _without_line(since, since**2 / 2, starts)
        return cls(
            t,
            since,
            curve,
            _without_line(since, places, starts),
            starts,
            number[starts],
        )

    @property
    def counts(self) -> np.ndarray:
        """Frames (F,) of each flight."""
        return np.diff(np.append(self.starts, len(self.t)))

    def grams(self, covariance: Covariance) -> np.ndarray:
        """`X^T C^-1 X` (F, 4, 4) of each flight, X of (1, t, curve, rest)."""
        terms = np.column_stack(
            [np.ones_like(self.t), self.since, self.curve, self.rest]
        )
        products = terms[:, :, None] * covariance.solve(terms)[:, None]
        return np.add.reduceat(products, self.starts, axis=0)

    def at_best(self, acceleration: float) -> tuple["Coordinate", float]:
        """The same at the best common acceleration, and this; `acceleration`: that
        taken away.
        """
        size = float(self.curve @ self.curve)
        if size > 0:
            more = float(self.curve @ self.rest) / size
        else:
            more = 0.0
        return replace(self, rest=self.rest - more * self.curve), acceleration + more

    def of_long_flights(self, least: int) -> tuple["Coordinate", np.ndarray]:
        """The flights of so many frames or more, and which they are (F,)."""
        long = self.counts >= least
        rows = np.repeat(long, self.counts)
        ends = np.cumsum(self.counts[long])
        starts = np.concatenate([[0], ends[:-1]]).astype(int)
        t, since, curve, rest = (
            x[rows] for x in (self.t, self.since, self.curve, self.rest)
        )
        return Coordinate(t, since, curve, rest, starts, self.flights[long]), long

    def together(self, most: int) -> tuple["Coordinate", int]:
        """Means of so many frames in a row that `most` are left, and of how many each
        is.
        """
        size = max(1, len(self.t) // most)
        size = min(size, max(1, int(self.counts.min()) // 4))
        if size == 1:
            return self, 1
        begin = np.concatenate(
            [
                first + size * np.arange(count // size)
                for first, count in zip(self.starts, self.counts)
            ]
        )
        rows = begin[:, None] + np.arange(size)
        number = np.repeat(np.arange(len(self.starts)), self.counts // size)
        starts = np.flatnonzero(np.diff(number, prepend=-1))
        t, since, curve, rest = (
            x[rows].mean(axis=1) for x in (self.t, self.since, self.curve, self.rest)
        )
        return Coordinate(t, since, curve, rest, starts, self.flights), size


def _mean(x: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Mean of x (N,) in each flight, (N,)."""
    counts = np.diff(np.append(starts, len(x)))
    return np.repeat(np.add.reduceat(x, starts) / counts, counts)


def _without_line(since: np.ndarray, y: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """What least squares of a line in each flight leave of y (N,); `since` has mean 0
    there.
    """
    counts = np.diff(np.append(starts, len(y)))
    y = y - _mean(y, starts)
    size = np.add.reduceat(since * since, starts)
    slope = np.add.reduceat(since * y, starts) / np.where(size > 0, size, 1.0)
    return y - np.repeat(slope, counts) * since


def _rest(grams: np.ndarray, terms: int) -> np.ndarray:
    """`r^T C^-1 r` (F,) that so many terms of `Coordinate.grams` leave, by least
    squares.
    """
    normal = grams[:, :terms, :terms]
    right = grams[:, :terms, -1]
    scale = 1 / np.sqrt(np.maximum(np.diagonal(normal, axis1=1, axis2=2), 1e-300))
    normal = normal * scale[:, :, None] * scale[:, None]
    right = right * scale
    normal = normal + ROUNDED * np.eye(terms)
    explained = (right * np.linalg.solve(normal, right[:, :, None])[:, :, 0]).sum(
        axis=1
    )
    return np.maximum(grams[:, -1, -1] - explained, 0.0)


# ----------------------------------------------------------------------------- errors
# of places


def likely_errors(
    frames: Frames,
    flights: Sequence[np.ndarray],
    flight: Flight,
    estimated: bool,
    speeds: np.ndarray,
) -> tuple[Errors, Flight, np.ndarray]:
    """Most likely errors of places in these flights: white ones, if `estimated`, and
    waves.

    And the model, and the coordinates (F, n) in which flights have accelerations of
    their own, where that costs less. Waves by restricted likelihood, as each flight has
    a line or a parabola; lines or parabolas by the likelihood; the prices are BIC's.
    `speeds` (n,): of the flights.
    """
    n = len(frames.sigma)
    sigma = frames.sigma.copy()
    waves = np.zeros(n)
    times = np.ones(n)
    bent = np.zeros((len(flights), n), bool)
    acceleration = flight.acceleration.copy()
    least = least_noise(frames.q)
    held = held_rather(frames, flights, flight)
    likely: dict[int, Likelihood] = {}
    mostly = np.zeros(n, bool)
    for c in range(n):
        some = Coordinate.of(frames, flights, flight, c)
        if len(some.t) <= 2 * len(some.starts):
            continue
        if flight.unknown[c]:
            some, acceleration[c] = some.at_best(acceleration[c])
        if estimated:
            known = None
        else:
            known = sigma[c]
        none = np.zeros(len(some.starts), bool)
        on_lines = Likelihood(some, known, least[c], WAVE_SPEED * speeds[c], none)
        found = on_lines.most_likely(frames.step)
        curved = on_lines.curved()
        free = ~held[some.flights]
        if some.counts[curved & free].sum() > MOSTLY * some.counts[free].sum():
            curved = some.counts > 3  # what bends most, a table or drag, bends all
            mostly[c] = True
        if curved.any():
            other = replace(on_lines, bent=curved).most_likely(frames.step)
            price_of_curves = curved.sum() * price_of_bend(len(some.t))
            if other.evidence + price_of_curves < found.evidence:
                found = other
                bent[some.flights, c] = curved
        sigma[c] = found.sigma
        waves[c] = found.wave
        times[c] = found.time
        likely[c] = on_lines
    angles = np.array(frames.angles or (False,) * n)
    for kind in (angles, ~angles):
        if not (mostly & bent.any(axis=0))[kind].any():
            continue
        for c in map(int, np.flatnonzero(kind & ~bent.any(axis=0))):
            if c in likely:  # drag and spin bend all places, though one by little
                curved = likely[c].some.counts > 3
                found = replace(likely[c], bent=curved).most_likely(frames.step)
                bent[likely[c].some.flights, c] = curved
                sigma[c] = found.sigma
                waves[c] = found.wave
                times[c] = found.time
    model = flight.with_values(acceleration, flight.drag)
    return Errors(sigma, waves, times), model, bent


def held_rather(
    frames: Frames, flights: Sequence[np.ndarray], flight: Flight
) -> np.ndarray:
    """True (F,) for flights nearer to no acceleration than to a known one, in some
    coordinate.
    """
    held = np.zeros(len(flights), bool)
    for c in map(int, np.flatnonzero(flight.acceleration * ~flight.unknown)):
        some = Coordinate.of(frames, flights, flight, c)
        size = np.add.reduceat(some.curve**2, some.starts)
        excess = np.add.reduceat(some.curve * some.rest, some.starts) / np.maximum(
            size, 1e-300
        )
        own = flight.acceleration[c]
        held[some.flights] |= np.abs(excess + own) < abs(own) / 2
    return held


class Likely(NamedTuple):
    """The most likely errors of a coordinate: white sigma, size and time of waves [s].

    `cost`: -2 log of the restricted likelihood; `evidence`: of the likelihood, with the
    price of waves.
    """

    cost: float
    sigma: float
    wave: float
    time: float
    evidence: float


@dataclass(frozen=True)
class Likelihood:
    """Likelihood of the errors of a coordinate on lines, or parabolas where flights are
    `bent` (F,).

    sigma None: unknown, at least `least`; `fastest`: velocity of waves at most.
    """

    some: Coordinate
    sigma: float | None
    least: float
    fastest: float
    bent: np.ndarray

    @property
    def values(self) -> int:
        """Number of values of lines and parabolas."""
        return 2 * len(self.bent) + int(self.bent.sum())

    def curved(self) -> np.ndarray:
        """True (F,) for flights on parabolas rather than lines, by white errors, at
        their price.
        """
        all_bent = replace(self, bent=self.some.counts > 3)
        sigma = all_bent.white().sigma
        white = Covariance(self.some.t, self.some.starts, sigma, 0.0, 1.0)
        grams = self.some.grams(white)
        gain = _rest(grams, 2) - _rest(grams, 3)
        return all_bent.bent & (gain > price_of_bend(len(self.some.t)))

    def most_likely(self, step: float) -> Likely:
        """The most likely errors; waves of size 0 unless they save their price. `step`:
        [s].
        """
        white = self.at(0.0, 1.0)
        if not self.shows_waves(self.white().sigma):
            return white
        few, size = self.some.together(MOST_FRAMES)
        if self.sigma is None:
            known = None
        else:
            known = self.sigma / size**0.5
        binned = Likelihood(few, known, self.least / size**0.5, self.fastest, self.bent)
        best = binned.best_waves(step * max(LEAST_TIME, LEAST_MEANS * size))
        saved = binned.white().cost - best.cost
        if saved < self.price_of_waves:
            return white
        return self._beside(best)

    def white(self) -> Likely:
        """Errors without waves: sigma as given, unless residuals show clearly larger
        ones.

        Waves must explain more than these.
        """
        given = self.at(0.0, 1.0)
        if self.sigma is None:
            return given
        shown = replace(self, sigma=None).at(0.0, 1.0)
        larger = shown.sigma > self.sigma
        saved = given.cost - shown.cost
        enough = saved > np.log(len(self.some.t)) + LEAST_SAVED
        if larger and enough:
            return shown
        return given

    @property
    def price_of_waves(self) -> float:
        """Cost that waves must save."""
        return 2 * float(np.log(len(self.some.t))) + LEAST_SAVED

    def shows_waves(self, sigma: float) -> bool:
        """True if means of 4, 16, 64, .. frames in a row are larger than white errors
        make them.

        By SHOWN standard deviations of the sum of their squares, in flights that have
        four means or more; else waves are not looked for.
        """
        rest = self.some.rest
        if self.bent.any():
            curve = self.some.curve * np.repeat(self.bent, self.some.counts)
            size = np.add.reduceat(curve * curve, self.some.starts)
            share = np.add.reduceat(curve * rest, self.some.starts) / np.maximum(
                size, 1e-300
            )
            rest = rest - np.repeat(share, self.some.counts) * curve
        some = replace(self.some, rest=rest)
        for frames in BINS:
            enough, taken = some.of_long_flights(4 * frames)
            if not taken.any():
                break
            few, count = enough.together(max(1, len(enough.t) // frames))
            freedom = len(few.t) - 2 * len(few.starts) - int(self.bent[taken].sum())
            if count < frames or freedom <= 0:
                break
            square = float(few.rest @ few.rest) * count / sigma**2
            if square - freedom > SHOWN * np.sqrt(2 * freedom):
                return True
        return False

    def best_waves(self, shortest: float) -> Likely:
        """The most likely waves with a time above `shortest` [s]."""
        spans = np.add.reduceat(
            np.diff(self.some.t, append=self.some.t[-1]), self.some.starts
        )
        longest = min(float(spans.max()), float(np.ptp(self.some.t)))
        times = longest * SHARES
        best = self.at(0.0, 1.0)
        ratio = SMALLEST_WAVES
        for time in times[times > shortest]:
            # from the best size of the last time on, as it changes little
            here = self._best_size(ratio, time)
            ratio = max(here.wave / here.sigma, SMALLEST_WAVES)
            best = min(best, here)
        if not best.wave:
            return best
        for factor in FINER:
            here = self._best_size(best.wave / best.sigma, best.time * factor)
            best = min(best, here)
        return best

    def _best_size(self, ratio: float, time: float) -> Likely:
        """The best size of waves with this time, uphill from `ratio` in steps, then
        within one.

        Their velocity, the size over the time, is `fastest` at most.
        """
        best = self.at(ratio, time)
        while best.wave > self.fastest * time and ratio > SMALLEST_WAVES / 100:
            ratio /= 3.0
            best = self.at(ratio, time)
        for step in (3.0, 1 / 3.0):
            next_one = self.at(ratio * step, time)
            while next_one.cost < best.cost and ratio > SMALLEST_WAVES / 3:
                if next_one.wave > self.fastest * time:
                    break
                best = next_one
                ratio = best.wave / best.sigma
                next_one = self.at(ratio * step, time)
        for step in FINER:
            finer = self.at(best.wave / best.sigma * step, time)
            if finer.wave <= self.fastest * time:
                best = min(best, finer)
        return best

    def at(self, ratio: float, time: float) -> Likely:
        """Cost of waves `ratio` times as large as sigma.

        Equation: -2 log of the restricted likelihood,
        `r^T C^-1 r + log |C| + log |X^T C^-1 X|`, X of the lines or parabolas.
        """
        covariance = Covariance(self.some.t, self.some.starts, 1.0, ratio, time)
        grams = self.some.grams(covariance)
        freedom = max(len(self.some.t) - self.values, 1)
        log_det = covariance.log_det().sum()
        square = 0.0
        for terms, some in ((2, ~self.bent), (3, self.bent)):
            if some.any():
                _, logs = np.linalg.slogdet(grams[some, :terms, :terms])
                log_det += logs.sum()
                square += float(_rest(grams[some], terms).sum())
        sigma = self.sigma
        if sigma is None:
            sigma = max(float(np.sqrt(square / freedom)), self.least)
        chi = square / sigma**2
        cost = chi + 2 * freedom * np.log(sigma) + log_det
        evidence = (
            chi + 2 * len(self.some.t) * np.log(sigma) + covariance.log_det().sum()
        )
        if ratio:
            of_waves = self.price_of_waves
        else:
            of_waves = 0.0
        return Likely(
            float(cost), sigma, ratio * sigma, time, float(evidence) + of_waves
        )

    def _beside(self, best: Likely) -> Likely:
        """White errors beside the waves `best`, by turns from those of differences
        on.
        """
        if self.sigma is not None:
            return self.at(best.wave / self.sigma, best.time)
        free = replace(self, sigma=None)
        sigma = max(float(noise(self.some.t, self.some.rest[:, None])[0]), self.least)
        for _ in range(TURNS):
            sigma = free.at(best.wave / sigma, best.time).sigma
        return replace(self, sigma=sigma).at(best.wave / sigma, best.time)


# ------------------------------------------------------------------------------ which
# are impacts


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
        if largest.waves.any():
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
    time = max(WAVED * float(np.median(durations)), LONG_WAVES * frames.step)
    times = np.full(len(speeds), time)
    return Errors(frames.sigma, WAVE_SPEED * speeds * time, times)


def _cheapest(frames: Frames, found: Sequence[Verdict]) -> Verdict:
    """The verdict of least cost; where one has waves impacts must save RATHER_FEW
    beside.
    """
    waves = any(verdict.errors.waves.any() for verdict in found)
    if waves:
        of_each = RATHER_FEW
    else:
        of_each = 0.0
    return min(
        found, key=lambda some: _cost(frames, some) + of_each * len(some.flights)
    )


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
    costs = FlightCosts(frames, verdict.flight, verdict.errors).of(verdict.flights)
    waves = 2 * np.log(len(frames.t)) + LEAST_SAVED
    of_waves = waves * np.count_nonzero(verdict.errors.waves)
    least = np.minimum(costs.line, costs.parabola)
    of_flights = price(*frames.q.shape) * len(verdict.flights)
    return float(least.sum() + of_waves) + of_flights


def _joined(
    frames: Frames, flights: Sequence[np.ndarray], flight: Flight, errors: Errors
) -> Verdict:
    """Flights, neighbours joined where one costs less than two, until none does.

    Of neighbouring pairs that would be joined the one that saves more is.
    """
    flights = list(flights)
    start = price(*frames.q.shape)
    counts = {"errors": 0, "bends": 0}
    costs = FlightCosts(frames, flight, errors)
    while len(flights) > 1:
        alone = costs.of(flights)
        both = costs.of_pairs(flights)
        two = np.add(*neighbours(alone.least))
        by_line = both.line - two - start
        by_bend = both.least - two + LEAST_GAIN
        saves = np.minimum(by_line, by_bend)
        before = np.append(np.inf, saves)[:-1]
        _, after = neighbours(np.append(saves, np.inf))
        best = (saves <= before) & (saves <= after)
        chosen = np.flatnonzero((saves < 0) & best)
        if not chosen.size:
            break
        taken: list[int] = []
        for k in map(int, chosen):  # of equal neighbours the first
            if not taken or k > taken[-1] + 1:
                taken.append(k)
        for k in reversed(taken):
            counts["errors" if by_line[k] <= by_bend[k] else "bends"] += 1
            flights[k : k + 2] = [np.concatenate(flights[k : k + 2])]
    straight = np.zeros((len(flights), frames.q.shape[1]), bool)
    return Verdict(flights, flight, errors, straight, counts["errors"], counts["bends"])


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
