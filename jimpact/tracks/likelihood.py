"""How likely errors of places are: white ones, and waves beside them.

`-2 log` of the restricted likelihood of the residuals that lines, or parabolas, leave
in flights. Slow waves are looked for by means of frames, quick ones by pieces of
flights, as many frames take long.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from jimpact.tracks.flight import Flight
from jimpact.tracks.frames import Frames, median, noise
from jimpact.tracks.waves import Covariance, Flights, Wave

# Smallest size of waves, in sigma, and their times as shares of the longest flight.
# Shares of ten in the place of three miss waves by half of their likelihood.
SMALLEST_WAVES = 0.3
SHARES = 0.3 * 3.0 ** -np.arange(5)
FINER = (3.0**-0.5, 3.0**0.5)  # of the best size, the same of its time
# Least time of waves, in frames: shorter ones are white, as a period has 2 pi times.
# Ten times more is a flight.
LEAST_TIME = 5.0
# Of means of frames; ten times more would miss waves of half a flight.
LEAST_MEANS = 2.0
TURNS = 2  # of white errors beside waves; more change them by less than a hundredth
# Share of the diagonal of normal matrices by which they are kept from being singular
# where a flight has one frame, or two instants none between them. Ten times more is
# still far below noise.
ROUNDED = 1e-12
# Frames by which slow waves are looked for; more are taken together. Ten times more
# take ten times as long, and waves are slow.
MOST_FRAMES = 150
# Frames by which quick waves are looked for, in pieces of flights of four periods of
# the shortest ones: their parabolas take slow waves away. Of ten times more they do
# not, and take ten times as long.
QUICK_FRAMES = 1024
PIECE = 128
# Least time of slow waves beside quick ones, in times of these. Of ten times more few
# are slow; of equal times there is one wave.
SLOWER = 3.0
# Frames whose means are looked at for waves, and standard deviations by which they must
# be larger than those of white errors. Twice as many would miss waves as large as the
# noise.
BINS = (4, 16, 64, 256)
SHOWN = 2.5
# Cost that waves must save: BIC of their size and time, and what one good track in a
# hundred saves.
LEAST_SAVED = 4.0


def price_of_waves(frames: int, count: int) -> float:
    """Cost that so many waves of a coordinate of so many frames must save.

    Those beside others LEAST_SAVED only: where the first ones are, others are likely,
    and without them errors of velocities would be too small.
    """
    if not count:
        return 0.0
    return 2 * math.log(frames) + count * LEAST_SAVED


@dataclass(frozen=True)
class Coordinate:
    """Frames of one coordinate in all flights, in turn: what a line leaves of them.

    Fields: times t (N,), and `since` (N,) the mean of their flight; `rest` (N,) of the
    least squares of a line in each flight; `curve` (N,), t^2 / 2 without its line;
    `starts` (F,); `flights` (F,), their numbers; `slopes` (F,) of the lines, 0 where
    frames are means.
    """

    t: np.ndarray
    since: np.ndarray
    curve: np.ndarray
    rest: np.ndarray
    starts: np.ndarray
    flights: np.ndarray
    slopes: np.ndarray | float = 0.0

    @classmethod
    def of(
        cls, frames: Frames, flights: Sequence[np.ndarray], flight: Flight, c: int
    ) -> "Coordinate":
        """Coordinate c of these flights, acceleration taken away."""
        rows = np.concatenate(flights)
        lengths = list(map(len, flights))
        number = np.repeat(np.arange(len(flights)), lengths)
        ok = np.isfinite(frames.q[rows, c])
        rows = rows[ok]
        number = number[ok]
        starts = np.flatnonzero(np.diff(number, prepend=-1))
        t = frames.t[rows]
        since = t - _mean(t, starts)
        bend = flight.acceleration[c] * since**2 / 2
        places = frames.q[rows, c] - bend
        curve = _without_line(since, since**2 / 2, starts)
        rest = _without_line(since, places, starts)
        slopes = _slopes(since, places, starts)
        return cls(t, since, curve, rest, starts, number[starts], slopes)

    def end_velocities(self, acceleration: float) -> np.ndarray:
        """Velocities (F, 2) at the first and the last frame of each flight: the slope
        of its line, and what the `acceleration` of the model adds.
        """
        stops = np.append(self.starts[1:], len(self.t))
        ends = np.column_stack([self.starts, stops - 1])
        of_lines = np.broadcast_to(self.slopes, len(stops))
        return of_lines[:, None] + acceleration * self.since[ends]

    @property
    def counts(self) -> np.ndarray:
        """Frames (F,) of each flight."""
        stops = np.append(self.starts, len(self.t))
        return np.diff(stops)

    @cached_property
    def frames(self) -> Flights:
        """Times and first frames of the flights."""
        return Flights(self.t, self.starts)

    def grams(self, covariance: Covariance) -> np.ndarray:
        """`X^T C^-1 X` (F, 4, 4) of each flight, X of (1, t, curve, rest)."""
        one = np.ones_like(self.t)
        terms = np.column_stack([one, self.since, self.curve, self.rest])
        weighted = covariance.solve(terms)
        products = terms[:, :, None] * weighted[:, None]
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
        rest = self.rest - more * self.curve
        return replace(self, rest=rest), acceleration + more

    def of_long_flights(self, least: int) -> tuple["Coordinate", np.ndarray]:
        """The flights of so many frames or more, and which they are (F,)."""
        long = self.counts >= least
        rows = np.repeat(long, self.counts)
        ends = np.cumsum(self.counts[long])
        starts = ends - self.counts[long]
        columns = (self.t, self.since, self.curve, self.rest)
        t, since, curve, rest = (x[rows] for x in columns)
        flights = self.flights[long]
        return Coordinate(t, since, curve, rest, starts, flights), long

    def in_pieces(self, length: int, most: int) -> "Coordinate":
        """Pieces of flights, of `length` frames at most, each with a line of its own.

        Pieces of 3 frames or fewer are left out: a parabola fits them whatever their
        errors are. Of N > `most` frames in all only each k-th piece remains, with
        k = N / `most` rounded up. `rest` and `curve` lose their lines in each piece.
        """
        numbers = np.arange(len(self.starts))
        of_frame = np.repeat(numbers, self.counts)
        place = np.arange(len(self.t)) - self.starts[of_frame]
        begins = np.flatnonzero(place % length == 0)
        ends = np.append(begins[1:], len(self.t))
        enough = ends - begins > 3
        k = -(-len(self.t) // most)
        begins = begins[enough][::k]
        ends = ends[enough][::k]
        pieces = [np.arange(*pair) for pair in zip(begins, ends)]
        rows = np.concatenate(pieces)
        lengths = ends - begins
        starts = np.cumsum(lengths) - lengths
        t = self.t[rows]
        since = t - _mean(t, starts)
        curve = _without_line(since, since**2 / 2, starts)
        rest = _without_line(since, self.rest[rows], starts)
        flights = self.flights[of_frame[begins]]
        return Coordinate(t, since, curve, rest, starts, flights)

    def together(self, most: int) -> tuple["Coordinate", int]:
        """Means of so many frames in a row that `most` are left, and of how many each
        is.
        """
        size = max(1, len(self.t) // most)
        smallest = int(self.counts.min())
        size = min(size, max(1, smallest // 4))
        if size == 1:
            return self, 1
        counts = self.counts // size
        groups = [first + size * np.arange(k) for first, k in zip(self.starts, counts)]
        begin = np.concatenate(groups)
        rows = begin[:, None] + np.arange(size)
        number = np.repeat(np.arange(len(counts)), counts)
        starts = np.flatnonzero(np.diff(number, prepend=-1))
        columns = (self.t, self.since, self.curve, self.rest)
        t, since, curve, rest = (x[rows].mean(axis=1) for x in columns)
        return Coordinate(t, since, curve, rest, starts, self.flights), size


def _mean(x: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Mean of x (N,) in each flight, (N,)."""
    counts = np.diff(np.append(starts, len(x)))
    return np.repeat(np.add.reduceat(x, starts) / counts, counts)


def _slopes(since: np.ndarray, y: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Slopes (F,) of lines by least squares of y (N,) in each flight; `since` has mean
    0 there.
    """
    size = np.add.reduceat(since * since, starts)
    size = np.where(size > 0, size, 1.0)
    return np.add.reduceat(since * y, starts) / size


def _without_line(since: np.ndarray, y: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """What least squares of a line in each flight leave of y (N,)."""
    counts = np.diff(np.append(starts, len(y)))
    y = y - _mean(y, starts)
    return y - np.repeat(_slopes(since, y, starts), counts) * since


def residual_squares(grams: np.ndarray, terms: int) -> np.ndarray:
    """`r^T C^-1 r` (F,) that so many terms of `Coordinate.grams` leave, by least
    squares.
    """
    normal = grams[:, :terms, :terms]
    right = grams[:, :terms, -1]
    diagonal = np.diagonal(normal, axis1=1, axis2=2)
    scale = 1 / np.sqrt(np.maximum(diagonal, 1e-300))
    normal = normal * scale[:, :, None] * scale[:, None]
    right = right * scale
    normal = normal + ROUNDED * np.eye(terms)
    solution = np.linalg.solve(normal, right[:, :, None])
    explained = (right * solution[:, :, 0]).sum(axis=1)
    return np.maximum(grams[:, -1, -1] - explained, 0.0)


class Likely(NamedTuple):
    """The most likely errors of a coordinate: white sigma, and waves.

    `cost`: -2 log of the restricted likelihood; `evidence`: of the likelihood, with the
    price of waves.
    """

    cost: float
    sigma: float
    waves: tuple[Wave, ...]
    evidence: float

    @property
    def relative(self) -> tuple[Wave, ...]:
        """The waves in units of sigma."""
        return tuple(wave.scaled(1 / self.sigma) for wave in self.waves)


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

    def curved(self, price: float) -> np.ndarray:
        """True (F,) for flights on parabolas rather than lines, by white errors, at
        this price of a parabola.
        """
        all_bent = replace(self, bent=self.some.counts > 3)
        sigma = all_bent.white().sigma
        white = Covariance(self.some.frames, sigma)
        grams = self.some.grams(white)
        gain = residual_squares(grams, 2) - residual_squares(grams, 3)
        return all_bent.bent & (gain > price)

    def most_likely(self, step: float, quick: tuple[Wave, ...]) -> Likely:
        """The most likely errors, without waves that do not save their price. `step`:
        [s].

        Of slow waves, `quick` ones, and slow ones beside quick ones those that cost
        least.
        """
        white = self.white()
        best = self.at(())
        if not self.shows_waves(white.sigma):
            return best
        tried = {quick, self._slow_waves(step)}
        if quick:
            tried.add(self._slow_waves(step, quick) + quick)
        found = [self._beside(waves) for waves in tried if waves]
        paid = white.cost
        for likely in found:
            cost = likely.cost + price_of_waves(len(self.some.t), len(likely.waves))
            if cost < paid:
                paid = cost
                best = likely
        return best

    def _slow_waves(
        self, step: float, beside: tuple[Wave, ...] = ()
    ) -> tuple[Wave, ...]:
        """The most likely waves, slower than those `beside`, by means of frames where
        these are many, in the longer flights; none unless they pay.
        """
        # flights of half of all frames have so many or more
        counts = self.some.counts
        common = int(median(np.repeat(counts, counts)))
        enough, taken = self.some.of_long_flights(common)
        few, size = enough.together(MOST_FRAMES)
        if self.sigma is None and not beside:
            known = None
        else:
            known = self.noise() / size**0.5
        bent = self.bent[taken]
        least = self.least / size**0.5
        binned = Likelihood(few, known, least, self.fastest, bent)
        shortest = step * max(LEAST_TIME, LEAST_MEANS * size)
        for wave in beside:
            shortest = max(shortest, SLOWER * wave.time)
        return binned.best_waves(shortest, beside)

    def quick_waves(self, step: float) -> tuple[Wave, ...]:
        """The most likely waves in pieces of flights; none unless they pay.

        A parabola in each piece takes slow waves away. White errors are those from
        frame to frame.
        """
        if self.some.counts.max() < 4 * min(BINS):
            return ()  # in which waves are not shown
        pieces = self.some.in_pieces(PIECE, QUICK_FRAMES)
        bent = np.ones(len(pieces.starts), bool)
        sigma = self.noise()
        some = Likelihood(pieces, sigma, self.least, self.fastest, bent)
        if not some.shows_waves(sigma):
            return ()
        return some.best_waves(LEAST_TIME * step)

    def noise(self) -> float:
        """White errors as given; unknown ones by the noise from frame to frame."""
        if self.sigma is not None:
            return self.sigma
        by_frame = noise(self.some.t, self.some.rest[:, None])
        shown = float(by_frame[0])
        return max(shown, self.least)

    def white(self) -> Likely:
        """Errors without waves: sigma as given, unless residuals show clearly larger
        ones.

        Waves must explain more than these.
        """
        given = self.at(())
        if self.sigma is None:
            return given
        shown = replace(self, sigma=None).at(())
        larger = shown.sigma > self.sigma
        saved = given.cost - shown.cost
        enough = saved > np.log(len(self.some.t)) + LEAST_SAVED
        if larger and enough:
            return shown
        return given

    def shows_waves(self, sigma: float) -> bool:
        """True if means of 4, 16, 64, .. frames in a row are larger than white errors
        make them.

        By SHOWN standard deviations of the sum of their squares, in flights that have
        four means or more; else waves are not looked for.
        """
        rest = self.some.rest
        if self.bent.any():
            of_frame = np.repeat(self.bent, self.some.counts)
            curve = self.some.curve * of_frame
            starts = self.some.starts
            size = np.add.reduceat(curve * curve, starts)
            along = np.add.reduceat(curve * rest, starts)
            share = along / np.maximum(size, 1e-300)
            rest = rest - np.repeat(share, self.some.counts) * curve
        some = replace(self.some, rest=rest)
        for frames in BINS:
            enough, taken = some.of_long_flights(4 * frames)
            if not taken.any():
                break
            left = max(1, len(enough.t) // frames)
            few, count = enough.together(left)
            bends = int(self.bent[taken].sum())
            freedom = len(few.t) - 2 * len(few.starts) - bends
            if count < frames or freedom <= 0:
                break
            square = float(few.rest @ few.rest) * count / sigma**2
            if square - freedom > SHOWN * np.sqrt(2 * freedom):
                return True
        return False

    def best_waves(
        self, shortest: float, beside: tuple[Wave, ...] = ()
    ) -> tuple[Wave, ...]:
        """The most likely waves with a time above `shortest` [s], beside known ones;
        none unless they pay.
        """
        t = self.some.t
        steps = np.diff(t, append=t[-1])
        spans = np.add.reduceat(steps, self.some.starts)
        span = min(float(spans.max()), float(np.ptp(t)))
        times = span * SHARES
        if beside:
            sigma = self.noise()
            beside = tuple(wave.scaled(1 / sigma) for wave in beside)
            without = self.at(beside)
        else:
            without = self.white()
        best = without
        ratio = SMALLEST_WAVES
        for time in times[times > shortest]:
            # from the best size of the last time on, as it changes little
            here = self._best_size(Wave(ratio, float(time)), beside)
            ratio = max(here.relative[0].size, SMALLEST_WAVES)
            best = min(best, here)
        if len(best.waves) == len(beside):
            return ()
        for factor in FINER:
            here = best
            while here is best and best.waves[0].time >= shortest:
                coarse = best.relative[0]
                finer = Wave(coarse.size, coarse.time * factor)
                here = self._best_size(finer, beside)
                best = min(best, here)
        price = price_of_waves(len(self.some.t), len(best.waves))
        price -= price_of_waves(len(self.some.t), len(beside))
        if without.cost - best.cost < price:
            return ()
        return best.waves[:1]

    def _best_size(self, wave: Wave, beside: tuple[Wave, ...]) -> Likely:
        """The best size of waves of this time, in units of sigma, uphill from `wave` in
        steps, then within one.

        Their velocity, the size over the time, is `fastest` at most.
        """
        time = wave.time
        best = self.at((wave, *beside))
        while self._too_fast(best) and wave.size > SMALLEST_WAVES / 100:
            wave = wave.scaled(1 / 3.0)
            best = self.at((wave, *beside))
        for step in (3.0, 1 / 3.0):
            here = self.at((wave.scaled(step), *beside))
            while here.cost < best.cost and wave.size > SMALLEST_WAVES / 3:
                if self._too_fast(here):
                    break
                best = here
                wave = Wave(best.relative[0].size, time)
                here = self.at((wave.scaled(step), *beside))
        coarse = best.relative[0]
        for step in FINER:
            finer = self.at((coarse.scaled(step), *beside))
            if not self._too_fast(finer):
                best = min(best, finer)
        return best

    def _too_fast(self, found: Likely) -> bool:
        """True if the first waves move places faster than `fastest`."""
        size, time = found.waves[0]
        return size > self.fastest * time

    def at(self, waves: tuple[Wave, ...]) -> Likely:
        """Cost of these waves, their sizes in units of sigma.

        Equation: -2 log of the restricted likelihood,
        `r^T C^-1 r + log |C| + log |X^T C^-1 X|`, X of the lines or parabolas.
        """
        covariance = Covariance(self.some.frames, 1.0, waves)
        grams = self.some.grams(covariance)
        freedom = max(len(self.some.t) - self.values, 1)
        log_det = covariance.log_det().sum()
        square = 0.0
        for terms, some in ((2, ~self.bent), (3, self.bent)):
            if some.any():
                of_flights = grams[some]
                _, logs = np.linalg.slogdet(of_flights[:, :terms, :terms])
                log_det += logs.sum()
                square += float(residual_squares(of_flights, terms).sum())
        sigma = self.sigma
        if sigma is None:
            sigma = max(float(np.sqrt(square / freedom)), self.least)
        chi = square / sigma**2
        cost = chi + 2 * freedom * np.log(sigma) + log_det
        frames = len(self.some.t)
        evidence = chi + 2 * frames * np.log(sigma) + covariance.log_det().sum()
        priced = float(evidence) + price_of_waves(frames, len(waves))
        in_units = tuple(wave.scaled(sigma) for wave in waves)
        return Likely(float(cost), sigma, in_units, priced)

    def _beside(self, waves: tuple[Wave, ...]) -> Likely:
        """White errors beside these waves, by turns from those of differences on."""
        sigma = self.noise()
        if self.sigma is None:
            free = replace(self, sigma=None)
            for _ in range(TURNS):
                in_sigma = tuple(wave.scaled(1 / sigma) for wave in waves)
                sigma = free.at(in_sigma).sigma
        known = replace(self, sigma=sigma)
        in_sigma = tuple(wave.scaled(1 / sigma) for wave in waves)
        return known.at(in_sigma)
