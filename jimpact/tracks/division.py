"""Flights of a track: the cheapest division of its frames into ballistic flights and
lost ones.

A flight is a straight line in each coordinate once its acceleration is taken away. Its
cost is chi^2 and a price for beginning one; dynamic programming finds the division of
least cost (Jackson et al., IEEE Signal Processing Letters 12, 2005). The time grows as
T log T, T the frames.
"""

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from jimpact.tracks.frames import Frames

# A frame that fits no flight costs what one good frame in so many exceeds. Ten times
# more would keep more false points in flights, ten times less would lose more good
# frames.
LOST_SHARE = 1e-3
# Jump of a velocity, in standard errors, from which on it is an impact. Ten times more
# would miss soft impacts; of noise alone five or more is found once in a million.
SMALLEST_JUMP = 5.0
# Frames whose costs are computed at once. Ten times more would take as long.
BLOCK = 32
# Frames after which not every frame is kept as a possible beginning of a flight, but
# every other, after twice as many every fourth. Ten times less would blur instants of
# soft impacts.
RECENT = 64
# Share of the extent below which the division takes no noise. Ten times less would lose
# digits of chi^2 to rounding.
LEAST_NOISE = 1e-7


def price(frames: int, n: int) -> float:
    """Price of a flight in chi^2: `(2n + 1) ln T` (BIC of 2n values and an instant) of
    T `frames`.

    At least `SMALLEST_JUMP^2`.
    """
    bic = (2 * n + 1) * np.log(frames)
    return max(float(bic), SMALLEST_JUMP**2)


def price_of_lost(n: int) -> float:
    """Price in chi^2 of a frame of n coordinates that fits no flight."""
    return float(chi2.isf(LOST_SHARE, n))


@dataclass(frozen=True)
class Division:
    """Flights (frames of each), and the cost of the cheapest division: chi^2 and
    prices.
    """

    flights: list[np.ndarray]
    cost: float


def divided(frames: Frames, acceleration: np.ndarray, shortest: int) -> Division:
    """The cheapest division; a flight has at least `shortest` frames seen in every
    coordinate.

    Equation: `c_j = min(c_(j-1) + lost, min_i c_i + price + chi^2(i..j))`:
    frame j is lost, or the last one of a flight from i; dynamic programming.
    """
    search = _Search(frames, acceleration, shortest)
    for first in range(0, len(frames.t), BLOCK):
        search.add_block(first)
    cost = float(search.least_cost[-1])
    return Division(search.flights(), cost)


SUMS = 6  # of each flight, see `_Starts`


@dataclass
class _Starts:
    """Frames i (C,) at which flights may begin, and sums (6, C, n) over the frames
    since then.

    Sums are those of w, w x, w x^2, w y, w x y, w y^2; w is 1 where a frame was seen, x
    the time, y the place less that of the acceleration, in sigma, both from an origin.
    """

    index: np.ndarray
    sums: np.ndarray

    def moved(self, dx: float, slope: np.ndarray, offset: np.ndarray) -> "_Starts":
        """Sums from another origin: `x' = x - dx`, `y' = y + offset + slope x'`."""
        w, x, xx, y, xy, yy = self.sums
        new_x = x - dx * w
        new_xx = xx - 2 * dx * x + dx**2 * w
        old_xy = xy - dx * y
        new_y = y + offset * w + slope * new_x
        new_xy = old_xy + offset * new_x + slope * new_xx
        added = offset**2 * w + 2 * offset * slope * new_x + slope**2 * new_xx
        new_yy = yy + 2 * offset * y + 2 * slope * old_xy + added
        sums = np.stack([w, new_x, new_xx, new_y, new_xy, new_yy])
        return _Starts(self.index, sums)


class _Search:
    """State of the search for the cheapest division of T frames of n coordinates.

    `least_cost` (T + 1,) of the first j frames, and `from_frame` (T + 1,), where what
    ends there begins: a flight, or one lost frame.
    """

    def __init__(self, frames: Frames, acceleration: np.ndarray, shortest: int) -> None:
        """Nothing divided yet; `acceleration` (n,) of free flights, `shortest` number
        of frames of a flight.
        """
        count, n = frames.q.shape
        highest = np.nanmax(frames.q, axis=0)
        extent = highest - np.nanmin(frames.q, axis=0)
        largest = max(extent.max(), 1e-300)  # of what does not move, too, > 0
        self.t = frames.t
        self.good = np.isfinite(frames.q)
        self.sigma = np.maximum(frames.sigma, LEAST_NOISE * largest)
        self.q = np.where(self.good, frames.q, 0.0)
        self.scaled_acceleration = acceleration / self.sigma
        self.shortest = shortest
        # sum of squares of times about their mean: that of two frames is twice this
        shortest_step = float(np.diff(frames.t).min())
        self.least_spread = shortest_step**2 / 4
        self.price = price(count, n)
        self.price_if_lost = price_of_lost(n) * self.good.any(axis=1)
        self.least_cost = np.zeros(count + 1)
        self.from_frame = np.zeros(count + 1, int)
        no_index = np.zeros(0, int)
        no_sums = np.zeros((SUMS, 0, n))
        self.starts = _Starts(no_index, no_sums)
        # sums are taken from an origin near their frames: they lose no digits
        self.origin_time = frames.t[0]
        self.origin_place = self._place(0)

    def add_block(self, first: int) -> None:
        """Extend `least_cost` by the frames of a block."""
        end = min(first + BLOCK, len(self.t))
        self._move_origin(first)
        within = self._sums_of(slice(first, end))  # (6, B + 1, n), from its start
        frames = np.arange(first, end)
        new = _Starts(frames, -within[:, :-1])
        index = np.concatenate([self.starts.index, new.index])
        sums = np.concatenate([self.starts.sums, new.sums], axis=1)
        since_starts = sums[:, :, None] + within[:, None, 1:]
        cost = self._costs(since_starts)
        late = index[:, None] > frames
        cost[late] = np.inf
        of_old = self.least_cost[self.starts.index]
        unknown = np.full(len(new.index), np.inf)
        begun = np.concatenate([of_old, unknown])
        old = len(of_old)
        for k, j in enumerate(frames):
            begun[old + k] = self.least_cost[j]
            total = begun + cost[:, k]
            i = int(np.argmin(total))
            left_out = self.least_cost[j] + self.price_if_lost[j]
            flown = total[i] + self.price
            self.least_cost[j + 1] = min(left_out, flown)
            if flown < left_out:
                self.from_frame[j + 1] = index[i]
            else:
                self.from_frame[j + 1] = j
        worse = begun + cost[:, -1] + self.price - self.least_cost[end]
        stays = self._stays(index, worse, end)
        to_end = sums[:, stays] + within[:, None, -1]
        self.starts = _Starts(index[stays], to_end)

    def flights(self) -> list[np.ndarray]:
        """Frames of each flight of the cheapest division."""
        last = len(self.t)
        found = []
        while last > 0:
            first = int(self.from_frame[last])
            if last - first >= self.shortest:
                found.append(np.arange(first, last))
            last = first
        return found[::-1]

    def _place(self, k: int) -> np.ndarray:
        """Place (n,) where each coordinate is seen first from frame k on; the last
        origin else.
        """
        some = slice(k, k + BLOCK)
        first = k + self.good[some].argmax(axis=0)
        c = np.arange(len(first))  # coordinates
        last_origin = getattr(self, "origin_place", np.zeros(len(c)))
        seen = self.good[first, c]
        return np.where(seen, self.q[first, c], last_origin)

    def _move_origin(self, first: int) -> None:
        """Take the first frame of a block as origin of times and places."""
        dx = self.t[first] - self.origin_time
        place = self._place(first)
        moved = (place - self.origin_place) / self.sigma
        offset = self.scaled_acceleration * dx**2 / 2 - moved
        slope = self.scaled_acceleration * dx
        self.starts = self.starts.moved(dx, slope, offset)
        self.origin_time = self.t[first]
        self.origin_place = place

    def _sums_of(self, some: slice) -> np.ndarray:
        """Sums (6, B + 1, n) of `_Starts` from the start of a block to each of its
        frames.
        """
        w = self.good[some].astype(float)
        x = (self.t[some] - self.origin_time)[:, None]
        apart = (self.q[some] - self.origin_place) / self.sigma
        y = w * (apart - self.scaled_acceleration * x**2 / 2)
        terms = np.stack([w, w * x, w * x**2, y, x * y, y * y])
        zero = np.zeros_like(terms[:, :1])
        sums = terms.cumsum(axis=1)
        return np.concatenate([zero, sums], axis=1)

    def _costs(self, sums: np.ndarray) -> np.ndarray:
        """chi^2 (C, B) of flights from their sums (6, C, B, n); inf where too few were
        seen.

        Equation: of a line in every coordinate,
        `S_yy - S_y^2 / S - (S_xy - S_x S_y / S)^2 / (S_xx - S_x^2 / S)`.
        """
        w, x, xx, y, xy, yy = sums
        enough = w.min(axis=2) >= self.shortest - 0.5
        w = np.maximum(w, 1.0)
        # 0 of one frame: not enough
        spread = np.maximum(xx - x * x / w, self.least_spread)
        shared = xy - x * y / w
        of_lines = yy - y * y / w - shared * shared / spread
        cost = of_lines.sum(axis=2)
        positive = np.maximum(cost, 0.0)
        return np.where(enough, positive, np.inf)

    def _stays(self, index: np.ndarray, worse: np.ndarray, end: int) -> np.ndarray:
        """True (C,) for starts that stay: recent ones, good ones, and older ones ever
        more rarely.

        Good: with a flight from there on the cost is `worse` by less than half a price.
        """
        age = end - index
        doublings = np.log2(np.maximum(age / RECENT, 1.0))
        power = np.ceil(doublings).astype(int)
        by_age = index % 2**power == 0
        is_good = worse < self.price / 2
        return by_age | is_good
