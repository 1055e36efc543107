"""Ballistic arcs through common points: flights and instants of all impacts at once.

Between the instants tau_i and tau_(i+1) of two impacts the places are
`P_i (1 - s) + P_(i+1) s - a (t - tau_i) (tau_(i+1) - t) / 2`, s = (t - tau_i) / h, h
the duration: v+ = (P_(i+1) - P_i) / h - a h / 2 after the first, v- = (P_(i+1) - P_i) /
h + a h / 2 before the second. Places and instants are found by Gauss-Newton; an arc
meets its neighbours only, so that the normal matrix is banded.

K impacts have K + 2 ends of K + 1 flights: the impacts, the first and the last frame.
The unknowns of the fit are (P_i, tau_i, b_i) of each end in turn, 2 n + 1 values, b_i
the acceleration of the flight's own that begins there (0 unless the model has it), then
those of acceleration (n) and drag (1) that are unknown. Slopes of one flight are in W
values: those of both its ends, a, k.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.linalg import solveh_banded

from jimpact.tracks.drag import between
from jimpact.tracks.flight import Flight
from jimpact.tracks.frames import Frames, neighbours
from jimpact.tracks.likelihood import ROUNDED
from jimpact.tracks.waves import Errors

# of Gauss-Newton; 5 are common. More are not, as frames change flights by turns.
STEPS = 60
SETTLING = 20  # steps after which frames stay in their flights
# Frames that an instant may lie within the flights that were found, as a frame near an
# impact may lie on either arc. Ten times more, and the instant of a jump that is none
# would run away.
BEYOND = 3
# Share of a flight by which an instant moves in a step, below one half, so that two
# never meet.
LARGEST_MOVE = 0.45
# Share of a frame below which the instants have settled, and the places in their parts.
# Ten times more is still far below noise.
SETTLED = 1e-7


@dataclass(frozen=True)
class Arcs:
    """Arcs between K + 2 ends, of which the first and the last are no impacts.

    Fields: instants tau (K + 2,) [s], places P (K + 2, n) [m, rad], accelerations of
    flights' own (K + 2, n), the model of the flights, their errors; covariance of the
    unknowns; members: frames of each flight; residual (T, n) in units of sigma, NaN
    where no frame was used; `bent` (K + 1, n), true where a flight has an acceleration
    of its own.
    """

    instants: np.ndarray
    places: np.ndarray
    own: np.ndarray
    flight: Flight
    errors: Errors
    covariance: np.ndarray
    members: list[np.ndarray]
    residual: np.ndarray
    bent: np.ndarray

    @property
    def acceleration(self) -> np.ndarray:
        """Acceleration a (n,) of all flights [m/s^2]."""
        return self.flight.acceleration

    @property
    def drag(self) -> float:
        """Drag k of all flights [1/m]."""
        return self.flight.drag

    @property
    def impacts(self) -> int:
        """Number K of impacts."""
        return len(self.instants) - 2

    @property
    def instants_of_impacts(self) -> np.ndarray:
        """Instants (K,) of the impacts [s]: all ends but the first and the last."""
        return _inner(self.instants)

    @property
    def places_of_impacts(self) -> np.ndarray:
        """Places (K, n) of the impacts [m, rad]."""
        return _inner(self.places)

    @cached_property
    def end_velocities(self) -> tuple[np.ndarray, np.ndarray]:
        """Velocities (K + 1, n) at the first and at the last end of each flight [m/s,
        rad/s].
        """
        h = np.diff(self.instants)
        duration = h[:, None]
        mean = np.diff(self.places, axis=0) / duration
        of_flights = self.acceleration + self.own[:-1]
        bend = of_flights / 2 * duration
        first = mean - bend
        last = mean + bend
        if self.flight.bends:
            begin = np.zeros(1)
            for i in range(len(h)):
                _, rates = self.flight.deviation(begin, *self.ends(i))
                first[i] += rates[0]
                last[i] += rates[-1]
        return first, last

    @property
    def size(self) -> int:
        """Number of values of an end in `covariance`: place, instant, acceleration of
        its own.
        """
        n = self.places.shape[1]
        return 2 * n + 1

    def rows_of_instants(self) -> np.ndarray:
        """Rows (K,) of the instants of impacts in `covariance`."""
        return _rows_of_instants(*self.places.shape)

    def changed(self, change: np.ndarray) -> "Arcs":
        """Arcs after a change (N,) of the unknowns."""
        count, n = self.places.shape
        of_ends, common = np.split(change, [count * self.size])
        ends = of_ends.reshape(count, self.size)
        places, instants, own = np.split(ends, [n, n + 1], axis=1)
        return replace(
            self,
            instants=self.instants + instants[:, 0],
            places=self.places + places,
            own=self.own + own,
            flight=self.flight.moved(common),
        )

    def ends(self, i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Instants (2,) and places (2, n) of the ends of flight i, its own acceleration
        (n,).
        """
        pair = slice(i, i + 2)
        tau = self.instants[pair]
        places = self.places[pair]
        return tau, places, self.own[i]

    def velocities(self) -> tuple[np.ndarray, np.ndarray]:
        """Velocities v- (K, n) and v+ (K, n) [m/s, rad/s] of each impact, see the head
        of the file.

        Drag adds the end rates of `bent` to those of parabolas.
        """
        first, last = self.end_velocities
        before, _ = neighbours(last)
        _, after = neighbours(first)
        return before, after

    def gain(self) -> np.ndarray:
        """Derivatives (K, 2, n, N) of v- and v+ in the N unknowns of `covariance`.

        Of a flight with duration h and mean velocity w: `v = w -/+ a h / 2` at its
        first and last end, w = (P_1 - P_0) / h, dw/dtau_1 = -w / h.
        """
        K = self.impacts
        n = self.places.shape[1]
        size = self.size
        pair = 2 * size
        unknowns = len(self.covariance)
        gain = np.zeros((K, 2, n, unknowns))
        # flight i has v+ of the impact before it, v- of the one after it
        for i in range(K + 1):
            slopes = self._end_slopes(i)
            own = slice(i * size, (i + 2) * size)
            of_ends = slopes[:, :, :pair]
            of_model = slopes[:, :, pair + self.flight.columns]
            for k, side, end in ((i - 1, 1, 0), (i, 0, 1)):
                if 0 <= k < K:
                    of_impact = gain[k, side]  # a view
                    of_impact[:, own] = of_ends[end]
                    of_impact[:, (K + 2) * size :] = of_model[end]
        return gain

    def gain_with_places(self) -> np.ndarray:
        """Derivatives (K, 3, n, N) of v-, v+ and the place of each impact."""
        K = self.impacts
        n = self.places.shape[1]
        unknowns = len(self.covariance)
        of_places = np.zeros((K, 1, n, unknowns))
        for k in range(K):
            first = (k + 1) * self.size
            own = slice(first, first + n)
            of_places[k, 0, :, own] = np.eye(n)
        of_velocities = self.gain()
        return np.concatenate([of_velocities, of_places], axis=1)

    def _end_slopes(self, i: int) -> np.ndarray:
        """Derivatives (2, n, W) of the velocities at both ends of flight i."""
        tau, places, own = self.ends(i)
        n = places.shape[1]
        size = self.size
        pair = 2 * size
        c = np.arange(n)  # coordinates
        h = tau[-1] - tau[0]
        mean = (places[-1] - places[0]) / h
        a = self.acceleration + own
        slopes = np.zeros((2, n, pair + n + 1))
        for of_end, sign in zip(slopes, (-1.0, 1.0)):
            # of the velocity in -h
            slope = mean / h - sign * a / 2
            of_end[c, c] = -1 / h
            of_end[c, size + c] = 1 / h
            of_end[:, n] = slope
            of_end[:, size + n] = -slope
            of_end[c, pair + c] = sign * h / 2
        if self.flight.bends:
            begin = np.zeros(1)
            *_, moved = self.flight.deviation_slopes(begin, tau, places, own)
            slopes += _in_columns(moved, n)
        of_model = slopes[:, :, pair:-1]
        slopes[:, :, n + 1 : size] = of_model
        return slopes

    @property
    def drag_error(self) -> float:
        """Standard error of an unknown drag, 0 of a known one [1/m]."""
        if self.flight.drag_unknown:
            variance = self.covariance[-1, -1]
            return float(np.sqrt(variance))
        return 0.0

    def instant_errors(self) -> np.ndarray:
        """Standard errors (K,) of the instants [s]."""
        variances = np.diag(self.covariance)
        of_instants = variances[self.rows_of_instants()]
        return np.sqrt(of_instants)

    @cached_property
    def covariance_of_velocities(self) -> np.ndarray:
        """Covariance `G C G^T` (2nK, 2nK) of (v-, v+) of each impact in turn, G of
        `gain`.
        """
        C = self.covariance
        G = self.gain().reshape(-1, len(C))
        return G @ C @ G.T

    @property
    def covariance_with_places(self) -> np.ndarray:
        """Covariance (3nK, 3nK) of (v-, v+, place) of each impact in turn."""
        C = self.covariance
        G = self.gain_with_places().reshape(-1, len(C))
        return G @ C @ G.T

    def jumps(self) -> np.ndarray:
        """Largest `|v+ - v-| / error` over the coordinates of each impact (K,)."""
        pre, post = self.velocities()
        K, n = pre.shape
        blocks = self.covariance_of_velocities.reshape(K, 2, n, K, 2, n)
        k = np.arange(K)
        own = blocks[k, :, :, k]  # (K, 2, n, 2, n)
        of_pre = own[:, 0, :, 0]
        of_post = own[:, -1, :, -1]
        between = own[:, 0, :, -1]
        covariance = of_pre + of_post - between - between.swapaxes(1, 2)
        variances = np.diagonal(covariance, axis1=1, axis2=2)
        errors = np.sqrt(np.maximum(variances, 1e-300))
        jumps = np.abs((post - pre) / errors)
        return jumps.max(axis=1, initial=0.0)

    def with_members(self, members: list[np.ndarray]) -> "Arcs":
        """The same arcs by other frames, before they are fitted."""
        return replace(self, members=members)


def _inner(ends: np.ndarray) -> np.ndarray:
    """The values at impacts: those of all ends but the first and the last."""
    return ends[1:-1]


def _in_columns(slopes: np.ndarray, n: int) -> np.ndarray:
    """Slopes (.., 3 n + 3) of `bent_slopes` in the W columns of the unknowns of a
    flight.
    """
    size = 2 * n + 1
    own = n + 1  # place and instant of an end
    pair = 2 * size
    ends = np.arange(own)
    found = np.zeros((*slopes.shape[:-1], pair + own))
    first, second, model = np.split(slopes, [own, 2 * own], axis=-1)
    found[..., ends] = first
    found[..., size + ends] = second
    found[..., pair:] = model
    return found


def _rows_of_instants(ends: int, n: int) -> np.ndarray:
    """Rows (ends - 2,) of the instants of impacts among (place, instant, own
    acceleration).
    """
    size = 2 * n + 1
    ends_of_impacts = np.arange(ends - 2) + 1
    return ends_of_impacts * size + n


class _Ends(NamedTuple):
    """Instants, places and accelerations of flights' own (K + 2, ..), and the model:
    all values.
    """

    tau: np.ndarray
    places: np.ndarray
    own: np.ndarray
    flight: Flight


@dataclass(frozen=True)
class Start:
    """What a fit starts from.

    Fields: frames of each flight; the model with first values; errors; `bent` (K + 1,
    n), true where a flight has an acceleration of its own beside that of the model; the
    duration of a contact, whose frames are left out [s]; first values of the instants
    (K,), None: where arcs cross; instant_errors (K,): instants are known, with these
    standard errors, and stay, where they are not NaN.
    """

    flights: list[np.ndarray]
    flight: Flight
    errors: Errors
    bent: np.ndarray
    contact: float = 0.0
    instants: np.ndarray | None = None
    instant_errors: np.ndarray | None = None

    def without(self, k: int) -> "Start":
        """The same without flight k, whose frames are left out."""
        flights = list(self.flights)
        del flights[k]
        bent = np.delete(self.bent, k, axis=0)
        return replace(self, flights=flights, bent=bent)

    def joined_at(self, k: int) -> "Start":
        """The same with flights k and k + 1 as one."""
        two = slice(k, k + 2)
        flights = list(self.flights)
        flights[two] = [np.concatenate(flights[two])]
        bent = np.delete(self.bent, k, axis=0)
        bent[k] |= self.bent[k]
        return replace(self, flights=flights, bent=bent)


def fit_arcs(frames: Frames, start: Start) -> Arcs:
    """The arcs of these flights by maximum likelihood: least squares of (q - arc), by
    their errors.

    Gauss-Newton steps in places, instants and what is unknown, each instant bounded by
    the last frame seen before and the first one seen after it; after every step frames
    are divided among the flights anew.
    """
    t = frames.t
    seen = np.isfinite(frames.q).any(axis=1)
    flights = [rows[seen[rows]] for rows in start.flights]
    pool = np.concatenate(flights)
    pairs = list(pairwise(flights))
    last = np.array([t[earlier[-1]] for earlier, _ in pairs])
    first = np.array([t[later[0]] for _, later in pairs])
    low = last - BEYOND * frames.step
    high = first + BEYOND * frames.step
    instants = start.instants
    if instants is None:
        instants = crossings(frames, flights, start.flight)
    tau = _with_ends(t[pool], instants)
    places = between(tau, t, frames.q)
    no_own = np.zeros_like(places)
    ends = _Ends(tau, places, no_own, start.flight)
    division = _Members(t, pool, start.contact, flights)
    problem = _Problem(frames, start.errors, start.bent, division.at(tau))
    known = start.instant_errors
    if known is None:
        known = np.full(len(instants), np.nan)
    moving = np.isnan(known)
    for k in range(STEPS):
        _, change = problem.step(ends, moving & (k > 0))
        new = tau + change.tau
        room = LARGEST_MOVE * np.diff(tau)
        earlier, later = neighbours(room)
        inner = _inner(tau)
        inner = np.clip(_inner(new), inner - earlier, inner + later)
        new = _with_ends(new, np.clip(inner, low, high))
        moved = change.seconds(new - tau, ends)
        tau = new
        model = ends.flight.moved(change.common)
        places = ends.places + change.places
        own = ends.own + change.own
        ends = _Ends(tau, places, own, model)
        if k < SETTLING and moving.any():
            problem = problem.with_members(division.at(tau))
        if k > 0 and moved <= SETTLED * frames.step:
            break
    normal, _ = problem.step(ends, moving)
    covariance = _inverse(normal)
    every_row = _rows_of_instants(*ends.places.shape)
    given = every_row[~moving]
    covariance[given, given] = known[~moving] ** 2
    covariance = _of_places(covariance, problem.drift(ends))
    residual = problem.residual(ends)
    return Arcs(*ends, start.errors, covariance, problem.members, residual, start.bent)


def _with_ends(times: np.ndarray, inner: np.ndarray) -> np.ndarray:
    """The first of the times, the `inner` ones, and the last of the times."""
    first = times[:1]
    last = times[-1:]
    return np.concatenate([first, inner, last])


def crossings(frames: Frames, flights: list[np.ndarray], flight: Flight) -> np.ndarray:
    """Instants (K,) at which the lines of neighbouring flights cross, acceleration
    taken away.

    Equation: lines `p + v (t - t_0)` of both: the least `|dp + dv (t - t_0)|` in sigma,
    between the last frame before and the first one after.
    """
    instants = np.zeros(len(flights) - 1)
    straight = flight.straight(frames)
    a = flight.acceleration
    t = frames.t
    sigma = frames.sigma
    lines = [_line(straight, rows, a) for rows in flights]
    for k, (line, next_line) in enumerate(pairwise(lines)):
        middle, p, v = line
        next_middle, p_after, v_after = next_line
        low = t[flights[k][-1]]
        high = t[flights[k + 1][0]]
        # of the parabola around one middle, the line around the other one
        shift = next_middle - middle
        p_here = p_after - v_after * shift + a * shift**2 / 2
        v_here = v_after - a * shift
        dp = (p_here - p) / sigma
        dv = (v_here - v) / sigma
        size = float(dv @ dv)
        since = np.inf
        if size > 0:
            since = -float(dp @ dv) / size
        crossing = middle + since
        if not low <= crossing <= high:
            crossing = (low + high) / 2
        instants[k] = crossing
    return instants


def _line(
    frames: Frames, rows: np.ndarray, acceleration: np.ndarray
) -> tuple[float, np.ndarray, np.ndarray]:
    """Middle of a flight [s], place (n,) and velocity (n,) there, by lines of least
    squares.

    A coordinate that was seen in no frame of it has place and velocity 0, one that was
    seen in one the velocity 0.
    """
    middle = float(frames.t[rows].mean())
    n = frames.q.shape[1]
    place = np.zeros(n)
    velocity = np.zeros(n)
    for c in range(n):
        of_coordinate = frames.q[rows, c]
        seen = np.isfinite(of_coordinate)
        if not seen.any():
            continue
        x = frames.t[rows[seen]] - middle
        y = of_coordinate[seen] - acceleration[c] * x**2 / 2
        mean = x.mean()
        spread = x - mean
        size = float(spread @ spread)
        if size > 0:
            velocity[c] = float(spread @ y) / size
        place[c] = y.mean() - velocity[c] * mean
    return middle, place, velocity


@dataclass(frozen=True)
class _Members:
    """Division of a pool of frames among flights by instants."""

    t: np.ndarray
    pool: np.ndarray
    contact: float
    flights: list[np.ndarray]

    def at(self, tau: np.ndarray) -> list[np.ndarray]:
        """Frames of each flight by the instants tau; those in contact, tau_i +/-
        contact / 2, are out.

        If a flight had less than 3 frames so, all of them stay as they are in
        `flights`.
        """
        x = self.t[self.pool]
        inner = _inner(tau)
        half = self.contact / 2
        low = np.searchsorted(x, inner + half)
        high = np.searchsorted(x, inner - half)
        starts = np.concatenate([[0], low])
        stops = np.concatenate([high, [len(x)]])
        lengths = stops - starts
        if lengths.min() < 3:
            return self.flights
        return [self.pool[i:j] for i, j in zip(starts, stops)]


class NormalMatrix(NamedTuple):
    """Normal matrix J^T C^-1 J: banded for the ends (N values), bordered by b common
    ones.
    """

    # (width + 1, N) upper bands, as `scipy.linalg.solveh_banded` takes them
    bands: np.ndarray
    border: np.ndarray  # (N, b)
    corner: np.ndarray  # (b, b)
    fixed: np.ndarray  # values that stay


class _Change(NamedTuple):
    """Step in instants (K + 2,), places, own accelerations (K + 2, n), and the model
    (b,).
    """

    tau: np.ndarray
    places: np.ndarray
    own: np.ndarray
    common: np.ndarray

    def seconds(self, moved: np.ndarray, ends: _Ends) -> float:
        """Size of the step [s]: of instants, `moved`, and of places where the model
        bends.
        """
        of_instants = float(np.abs(moved).max(initial=0.0))
        if not ends.flight.bends:
            return of_instants
        duration = ends.tau[-1] - ends.tau[0]
        ways = np.abs(np.diff(ends.places, axis=0))
        length = ways.max(initial=1e-300)
        farthest = float(np.abs(self.places).max())
        of_places = duration * farthest / length
        return max(of_instants, of_places)


class _Problem:
    """Least squares of one division of the frames: residuals, slopes and steps."""

    def __init__(
        self,
        frames: Frames,
        errors: Errors,
        bent: np.ndarray,
        members: list[np.ndarray],
    ) -> None:
        self.frames = frames
        self.errors = errors
        self.bent = bent
        self.members = members
        self.rows = np.concatenate(members)
        lengths = list(map(len, members))
        numbers = np.arange(len(members))
        self.flights = np.repeat(numbers, lengths)
        columns = frames.q[self.rows].T
        self.seen = list(map(np.isfinite, columns))
        self.covariances = [self._covariance(c, ok) for c, ok in enumerate(self.seen)]

    def with_members(self, members: list[np.ndarray]) -> "_Problem":
        """The problem of another division; this one where it is the same."""
        same = map(np.array_equal, members, self.members)
        if all(same):
            return self
        return _Problem(self.frames, self.errors, self.bent, members)

    def _covariance(self, c: int, ok: np.ndarray) -> tuple:
        """Covariance of coordinate c in the frames `ok`, and the flights that have
        any.
        """
        own = self.flights[ok]
        starts = np.flatnonzero(np.diff(own, prepend=-1))
        rows = self.rows[ok]
        relative = None
        if self.frames.relative is not None:
            relative = self.frames.relative[rows, c]
        t = self.frames.t[rows]
        return self.errors.of(c, t, starts, relative), own[starts]

    def arc(self, ends: _Ends) -> np.ndarray:
        """Places (R, n) of all frames in flights.

        Equation: `P_i (1 - s) + P_(i+1) s - a (x - tau_i) (tau_(i+1) - x) /
        2`, and D of `bent`.
        """
        x = self.frames.t[self.rows]
        flight = self.flights
        since = x - ends.tau[flight]
        until = ends.tau[flight + 1] - x
        s = (since / (since + until))[:, None]
        first = ends.places[flight]
        last = ends.places[flight + 1]
        a = ends.flight.acceleration + ends.own[flight]
        sag = (since * until / 2)[:, None]
        arc = first * (1 - s) + last * s - a * sag
        if ends.flight.drag or ends.flight.force is not None:
            for i, some in self._flights():
                pair = slice(i, i + 2)
                tau = ends.tau[pair]
                places = ends.places[pair]
                D, _ = ends.flight.deviation(x[some], tau, places, ends.own[i])
                arc[some] += D
        return arc

    def residual(self, ends: _Ends) -> np.ndarray:
        """Residuals (T, n) in sigma, NaN where a frame is in no flight."""
        found = np.full(self.frames.q.shape, np.nan)
        apart = self.frames.q[self.rows] - self.arc(ends)
        found[self.rows] = apart / self.errors.sigma
        return found

    def slopes(self, ends: _Ends) -> np.ndarray:
        """Derivatives (R, n, W) of the arcs in the ends of each flight and the model.

        Instants take their places along, see `drift`.
        """
        n = ends.places.shape[1]
        size = 2 * n + 1
        two = 2 * size
        c = np.arange(n)  # coordinates
        flight = self.flights
        x = self.frames.t[self.rows]
        since = (x - ends.tau[flight])[:, None]
        until = (ends.tau[flight + 1] - x)[:, None]
        h = since + until
        s = since / h
        a = ends.flight.acceleration + ends.own[flight]
        way = ends.places[flight + 1] - ends.places[flight]
        rise = way / h
        slopes = np.zeros((len(x), n, two + n + 1))
        slopes[:, c, c] = 1 - s
        slopes[:, c, size + c] = s
        slopes[:, :, n] = -rise * (1 - s) + a * until / 2
        slopes[:, :, size + n] = -rise * s - a * since / 2
        slopes[:, c, two + c] = -since * until / 2
        if ends.flight.bends:
            for i, some in self._flights():
                pair = slice(i, i + 2)
                tau = ends.tau[pair]
                places = ends.places[pair]
                own = ends.own[i]
                bent, _ = ends.flight.deviation_slopes(x[some], tau, places, own)
                slopes[some] += _in_columns(bent, n)
        of_model = slopes[:, :, two:-1]
        slopes[:, :, n + 1 : size] = of_model
        drift = self.drift(ends)
        for end in (0, 1):
            first = end * size
            of_places = slopes[:, :, first : first + n]
            moves = drift[flight + end]
            with_places = np.einsum("rcp,rp->rc", of_places, moves)
            slopes[:, :, first + n] += with_places
        return slopes

    def drift(self, ends: _Ends) -> np.ndarray:
        """Velocities u (K + 2, n) of the ends: means of those of the flights on both
        sides.

        A step moves an instant and its place by `u dtau` together: else a coordinate
        without a jump that is seen exactly would hide what the others say of the
        instant.
        """
        duration = np.diff(ends.tau)
        rise = np.diff(ends.places, axis=0) / duration[:, None]
        earlier, later = neighbours(_with_ends(rise, rise))
        return (earlier + later) / 2

    def _flights(self) -> list[tuple[int, slice]]:
        """Number and rows of each flight."""
        lengths = list(map(len, self.members))
        stops = np.cumsum(lengths)
        starts = stops - lengths
        rows = zip(starts, stops)
        return [(i, slice(*of_flight)) for i, of_flight in enumerate(rows)]

    def step(self, ends: _Ends, moving: np.ndarray) -> tuple[NormalMatrix, _Change]:
        """Normal matrix at these values, and the Gauss-Newton step from them.

        Equation: `J^T C^-1 J step = J^T C^-1 r`, r = q - arc over frames that were
        seen, J the derivatives of the arcs, C the covariance of the errors. Instants
        of impacts stay unless `moving` (K,), those of the first and the last end
        always.
        """
        n = ends.places.shape[1]
        size = 2 * n + 1
        pair = 2 * size
        model = pair + ends.flight.columns
        used = np.concatenate([np.arange(pair), model])
        slopes = self.slopes(ends)[:, :, used]
        rest = self.frames.q[self.rows] - self.arc(ends)
        last = len(used)  # the column of the residual
        width = last + 1
        grams = np.zeros((len(self.members), width, width))
        for c, ok in enumerate(self.seen):
            covariance, flights = self.covariances[c]
            # of P only coordinate c of both ends moves this one, unless drag couples
            # them
            own = np.arange(last)
            if not ends.flight.bends:
                common = np.flatnonzero(used == pair + c)
                of_begin = [c, n, n + 1 + c]
                own = np.concatenate([of_begin, [size + c, size + n], common])
            terms = np.column_stack([slopes[ok, c][:, own], rest[ok, c]])
            weighted = covariance.solve(terms)
            products = terms[:, :, None] * weighted[:, None]
            starts = covariance.flights.starts
            where = np.append(own, last)
            block = np.ix_(flights, where, where)
            grams[block] += np.add.reduceat(products, starts, axis=0)
        return self._solved(grams, ends, moving)

    def _solved(
        self, grams: np.ndarray, ends: _Ends, moving: np.ndarray
    ) -> tuple[NormalMatrix, _Change]:
        """Normal matrix and step from products (F, W, W) of slopes and residual in
        flights.
        """
        count, n = ends.places.shape
        size = 2 * n + 1
        pair = 2 * size
        b = grams.shape[1] - 1 - pair
        border = np.zeros((count * size, b))
        right = np.zeros(count * size)
        for i, gram in enumerate(grams):
            rows = slice(i * size, (i + 2) * size)
            border[rows] += gram[:pair, pair:-1]
            right[rows] += gram[:pair, -1]
        of_model = grams[:, pair:-1]
        corner = of_model[:, :, pair:-1].sum(axis=0)
        right_b = of_model[:, :, -1].sum(axis=0)
        instants = np.arange(count) * size + n
        stays = np.concatenate([[True], ~moving, [True]])
        straight = np.ones((count, n), bool)
        straight[:-1] = ~self.bent
        end, coordinate = np.nonzero(straight)
        none = end * size + n + 1 + coordinate
        fixed = np.concatenate([instants[stays], none])
        of_ends = grams[:, :pair, :pair]
        bands = _banded(of_ends, count, size, fixed)
        border[fixed] = 0.0
        right[fixed] = 0.0
        normal = NormalMatrix(bands, border, corner, fixed)
        solved, common = _solve(normal, right, right_b)
        changes = solved.reshape(count, size)
        tau = changes[:, n]
        along = self.drift(ends) * tau[:, None]
        places = changes[:, :n] + along
        own = changes[:, n + 1 :]
        return normal, _Change(tau, places, own, common)


def _of_places(covariance: np.ndarray, drift: np.ndarray) -> np.ndarray:
    """Covariance of (P, tau) of each end from that of (p, tau), `P = p + drift tau`."""
    count, n = drift.shape
    size = 2 * n + 1
    turned = covariance.copy()
    for i in range(count):
        first = i * size
        places = slice(first, first + n)
        turned[places] += np.outer(drift[i], turned[first + n])
    for i in range(count):
        first = i * size
        places = slice(first, first + n)
        turned[:, places] += np.outer(turned[:, first + n], drift[i])
    return turned


def _banded(blocks: np.ndarray, ends: int, size: int, fixed: np.ndarray) -> np.ndarray:
    """Upper bands (2 size, ends size) of the sum of the blocks of neighbouring ends.

    Row `width - d` holds the d-th diagonal above the main one. Unknowns `fixed` keep 1
    on the diagonal, and 0 elsewhere.
    """
    width = 2 * size - 1
    count = ends * size
    bands = np.zeros((width + 1, count))
    every_end = np.arange(ends - 1) * size
    for i in range(2 * size):
        for j in range(i, 2 * size):
            diagonal = width - (j - i)
            bands[diagonal, every_end + j] += blocks[:, i, j]
    for k in fixed:
        for d in range(width + 1):
            bands[width - d, k] = 0.0
            if k + d < count:
                bands[width - d, k + d] = 0.0
        bands[width, k] = 1.0
    return bands


def _solve(
    normal: NormalMatrix, right: np.ndarray, right_b: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Solution (x (N,), y (b,)) of the bordered system, by elimination of x.

    Equation: `A x + B y = right`, `B^T x + C y = right_b`: `(C - B^T A^-1 B) y =
    right_b - B^T A^-1 right`. A has the bands, B is the border, C the corner.
    """
    bands, border, corner, _ = normal
    scale = _scale(bands)
    both = np.column_stack([right, border])
    column = scale[:, None]
    solved = column * solveh_banded(_scaled(bands, scale), column * both)
    alone = solved[:, 0]
    by_border = solved[:, 1:]
    schur = corner - border.T @ by_border
    rest = right_b - border.T @ alone
    common = np.linalg.pinv(schur, hermitian=True) @ rest
    return alone - by_border @ common, common


def _scale(bands: np.ndarray) -> np.ndarray:
    """Scale (N,) that brings the diagonal of these upper bands to 1."""
    diagonal = np.maximum(bands[-1], 1e-300)
    return 1 / np.sqrt(diagonal)


def _scaled(bands: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Bands of `S A S`, S = diag(scale), so that units do not matter for rounding.

    ROUNDED is added to their diagonal, which is 1.
    """
    width = bands.shape[0] - 1
    count = bands.shape[1]
    scaled = np.zeros_like(bands)
    for d in range(width + 1):
        of_row = scale[d:]
        of_column = scale[: count - d]
        diagonal = bands[width - d, d:]
        scaled[width - d, d:] = diagonal * of_row * of_column
    scaled[width] += ROUNDED
    return scaled


def _inverse(normal: NormalMatrix) -> np.ndarray:
    """Covariance: inverse of the normal matrix by blocks; values that stay have
    variance 0.

    Equation: with `R = (C - B^T A^-1 B)^-1` it is
    `[[A^-1 + A^-1 B R B^T A^-1, -A^-1 B R], [-R B^T A^-1, R]]`.
    """
    bands, border, corner, fixed = normal
    scale = _scale(bands)
    solved = solveh_banded(_scaled(bands, scale), np.diag(scale))
    inverse = scale[:, None] * solved
    inverse[fixed, fixed] = 0.0
    if not corner.size:
        return (inverse + inverse.T) / 2
    schur = corner - border.T @ inverse @ border
    R = np.linalg.pinv(schur, hermitian=True)
    cross = -inverse @ border @ R
    of_ends = inverse - cross @ border.T @ inverse
    return np.block([[of_ends, cross], [cross.T, R]])
