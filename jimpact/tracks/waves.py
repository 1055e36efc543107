"""Errors of places: white ones, and waves beside them.

A table that is not level, a lens, drag that is not known move places slowly beside an
arc. Such *waves* are errors, too, that neighbouring frames share. In a flight the
errors of one coordinate have the covariance `C = sigma^2 1 + w^2 k(|t_i - t_j| / T)`. k
is that of an oscillator of damping DAMPING that noise drives: `k(x) = exp(-b x) (cos(c
x) + b / c sin(c x))`, c^2 = 1 - b^2. Its spectrum is flat below the frequency 1 / T,
and falls as its fourth power above: waves are as slow as T, and not slower, as drifts
are the business of the flights' lines and parabolas. Waves of different flights are
independent.

A coordinate may have slow waves, as of a lens, and quick ones beside them, as of a body
that wobbles: C has a term for each.

The oscillator has a place f and a velocity g: C^-1 of N frames takes a banded matrix of
2 N rows for each wave (Hartikainen and Saerkkae, MLSP 2010; Foreman-Mackey et al., AJ
154, 2017), at any times.
"""

from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.polynomial import Chebyshev
from scipy.linalg import cho_solve_banded, cholesky_banded

# Damping b of waves. Of lenses on level tables errors are then .8 times as large as
# stated, of critical damping, 1, half of that: slow drifts, which are none, make them.
# A third of it is a wave of one length.
DAMPING = 0.5
FREQUENCY = np.sqrt(1 - DAMPING**2)
# Steps z up to which noise is that of a polynomial of this degree, as differences of
# numbers near 1 lose digits there. Ten times more is no polynomial of it; ten times
# less loses four digits.
SHORT = 2.0
DEGREE = 14


class Wave(NamedTuple):
    """Waves of a coordinate: their size w, in the unit that is named, and time T
    [s].
    """

    size: float
    time: float

    def scaled(self, factor: float) -> "Wave":
        """Waves so many times as large."""
        return Wave(factor * self.size, self.time)


@dataclass(frozen=True)
class Errors:
    """Errors of each coordinate: white ones of standard error sigma (n,), and its
    waves.

    `waves` are those of each coordinate, in its unit, the slow ones first; none where
    it is empty. `clock`: standard error of the times of frames [s], which is part of
    sigma.
    """

    sigma: np.ndarray
    waves: tuple[tuple[Wave, ...], ...]
    clock: float = 0.0

    @classmethod
    def white(cls, sigma: np.ndarray) -> "Errors":
        """Errors without waves."""
        return cls(sigma, ((),) * len(sigma))

    @property
    def waving(self) -> np.ndarray:
        """True (n,) for coordinates that have waves."""
        return np.array([bool(some) for some in self.waves])

    @property
    def speeds_of_waves(self) -> np.ndarray:
        """Velocities (n,) of the waves of each coordinate, root mean square: each
        wave's is `w / T`.
        """
        squares = [
            sum((wave.size / wave.time) ** 2 for wave in waves) for waves in self.waves
        ]
        return np.sqrt(np.array(squares, float))

    @property
    def number_of_waves(self) -> int:
        """Number of waves of all coordinates."""
        return sum(map(len, self.waves))

    def of(
        self,
        c: int,
        t: np.ndarray,
        starts: np.ndarray,
        relative: np.ndarray | None = None,
    ) -> "Covariance":
        """Covariance of coordinate c in frames t (N,) of flights that begin at `starts`
        (F,).

        `relative` (N,): white errors of these frames in sigma; None: 1.
        """
        flights = Flights(t, starts)
        return Covariance(flights, self.sigma[c], self.waves[c], relative)


@dataclass(frozen=True)
class Flights:
    """Times t (N,) of the frames of F flights in turn, and their first frames `starts`
    (F,).

    Steps of waves are kept by their time, as waves of several sizes are tried.
    """

    t: np.ndarray
    starts: np.ndarray
    known: dict[float, "Steps"] = field(default_factory=dict, repr=False)

    def steps(self, time: float) -> "Steps":
        """Waves of this time from frame to frame."""
        if time not in self.known:
            self.known[time] = steps_of(self.t, self.starts, time)
        return self.known[time]


@dataclass(frozen=True)
class Covariance:
    """Covariance C of the errors of one coordinate in the N frames of F flights.

    Fields: the flights; white sigma; `waves`, M of them, in the unit of sigma;
    `relative` (N,): white errors of frames in sigma; None: 1.
    """

    flights: Flights
    sigma: float
    waves: tuple[Wave, ...] = ()
    relative: np.ndarray | None = None

    @property
    def weights(self) -> np.ndarray:
        """`1 / relative^2` (N,)."""
        if self.relative is None:
            return np.ones(len(self.flights.t))
        return self.relative**-2.0

    def solve(self, x: np.ndarray) -> np.ndarray:
        """`C^-1 x` (N, m) of columns x.

        Equation: with f_j the most likely waves and the weights u,
        `u (x - sum_j f_j) / sigma^2`.
        """
        weights = self.weights[:, None]
        if not self.waves:
            return weights * x / self.sigma**2
        count = len(self.waves)
        columns = x.shape[1]
        sides = np.zeros((len(x), count, 2, columns))
        sides[:, :, 0] = (weights * x)[:, None]
        flat = sides.reshape(-1, columns)
        found = cho_solve_banded((self._factor, False), flat, check_finite=False)
        places = found.reshape(sides.shape)[:, :, 0]
        rest = x - places.sum(axis=1)
        return weights * rest / self.sigma**2

    def log_det(self) -> np.ndarray:
        """`log |C|` (F,) of each flight.

        Equation: `log |S| + log |P + S^-1| - log |P|`, P the precision of (f_j, g_j) of
        all waves, S = sigma^2 / u the white variances.
        """
        found = 2 * np.log(self.sigma) - np.log(self.weights)
        if self.waves:
            for wave, steps in zip(self.waves, self._steps):
                size = wave.size / self.sigma
                found = found + 4 * np.log(size) + steps.log_det
            diagonal = np.log(self._factor[-1])
            pivots = diagonal.reshape(len(found), -1)
            found = found + 2 * pivots.sum(axis=1)
        return np.add.reduceat(found, self.flights.starts)

    @property
    def _steps(self) -> list["Steps"]:
        """Each wave from frame to frame."""
        return [self.flights.steps(wave.time) for wave in self.waves]

    @cached_property
    def _factor(self) -> np.ndarray:
        """Cholesky factor of `sigma^2 P + H^T u H`: upper bands (2 M + 2, 2 M N).

        P is the precision of (f_1, g_1, f_2, g_2, ..) of a frame after the other, H
        adds the f_j of a frame, u are its weights.
        """
        rows = 2 * len(self.waves)  # of a frame
        frames = len(self.flights.t)
        bands = np.zeros((rows + 2, rows * frames))
        waves = zip(self.waves, self._steps)
        for j, (wave, steps) in enumerate(waves):
            share = self.sigma / wave.size
            steps.add_to(bands, 2 * j, rows, share**2)
        # f_i with f_j of the same frame
        for j in range(0, rows, 2):
            for i in range(0, j + 2, 2):
                bands[-1 - (j - i), j::rows] += self.weights
        return cholesky_banded(bands, overwrite_ab=True, check_finite=False)


@dataclass(frozen=True)
class Steps:
    """Unit waves: precision P of their (f, g), and `log |Q|` (N,) of each step.

    Fields: P (N, 3) of a frame, `ff, fg, gg`, and (N, 4) of f, g of a frame with f, g
    of the next one, `ff, fg, gf, gg`; the last row is 0.
    """

    of_frame: np.ndarray
    with_next: np.ndarray
    log_det: np.ndarray

    def add_to(self, bands: np.ndarray, first: int, rows: int, factor: float) -> None:
        """Add `factor` P to upper bands of a matrix with so many `rows` a frame, those
        of these waves from `first` on.
        """
        ff, fg, gg = factor * self.of_frame.T
        f = slice(first, None, rows)
        g = slice(first + 1, None, rows)
        bands[-1, f] += ff
        bands[-1, g] += gg
        bands[-2, g] += fg
        ff, fg, gf, gg = factor * self.with_next[:-1].T
        next_f = slice(rows + first, None, rows)
        next_g = slice(rows + first + 1, None, rows)
        bands[-1 - rows, next_f] += ff
        bands[-1 - rows, next_g] += gg
        bands[-rows, next_f] += gf
        bands[-2 - rows, next_g] += fg


def steps_of(t: np.ndarray, starts: np.ndarray, time: float) -> Steps:
    """Precision of (f, g) of unit waves with time T, at frames t (N,) of flights from
    `starts` on.

    Equation: over a step of z = dt / T, `(f, g)' = A (f, g) + e`, A that of a free
    oscillator with damping b, e of covariance `Q = 1 - A A^T`; f and g, the velocity
    times T, have variance 1 at the start of a flight.
    """
    z = np.diff(t, prepend=t[0]) / time
    first = np.zeros(len(t), bool)
    first[starts] = True
    z[first] = 0.0
    moved, still = _free_oscillation(z)
    noise_ff, noise_fg, noise_gg = _noise(z)
    q_ff = np.where(first, 1.0, noise_ff)
    q_fg = np.where(first, 0.0, noise_fg)
    q_gg = np.where(first, 1.0, noise_gg)
    det = q_ff * q_gg - q_fg**2
    w_ff = q_gg / det  # the inverse W of Q
    w_fg = -q_fg / det
    w_gg = q_ff / det
    onward = np.where(first, 0.0, 1.0)
    a_ff = onward * (still + DAMPING * moved)
    a_fg = onward * moved
    a_gf = -onward * moved
    a_gg = onward * (still - DAMPING * moved)
    # -W A, of the next frame (rows) and this one (columns)
    m_ff = -(w_ff * a_ff + w_fg * a_gf)
    m_fg = -(w_ff * a_fg + w_fg * a_gg)
    m_gf = -(w_fg * a_ff + w_gg * a_gf)
    m_gg = -(w_fg * a_fg + w_gg * a_gg)
    own_ff = w_ff.copy()
    own_fg = w_fg.copy()
    own_gg = w_gg.copy()
    # A^T W A of the step that follows
    rest_ff = a_ff * m_ff + a_gf * m_gf
    rest_fg = a_ff * m_fg + a_gf * m_gg
    rest_gg = a_fg * m_fg + a_gg * m_gg
    own_ff[:-1] -= rest_ff[1:]
    own_fg[:-1] -= rest_fg[1:]
    own_gg[:-1] -= rest_gg[1:]
    of_frame = np.column_stack([own_ff, own_fg, own_gg])
    with_next = np.zeros((len(t), 4))
    # the rows of m are those of the next frame
    of_next = np.column_stack([m_ff, m_gf, m_fg, m_gg])
    with_next[:-1] = of_next[1:]
    return Steps(of_frame, with_next, np.log(det))


def _free_oscillation(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`h = exp(-b z) sin(c z) / c` and `exp(-b z) cos(c z) = h' + b h` of steps z (..)
    of a free oscillator after a push; b = DAMPING, c = FREQUENCY.
    """
    decay = np.exp(-DAMPING * z)
    angle = FREQUENCY * z
    sine = decay * np.sin(angle) / FREQUENCY
    return sine, decay * np.cos(angle)


def _noise(z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Covariance (ff, fg, gg) of what noise adds to (f, g) over steps z (N,).

    Equation: with h = `exp(-b u) sin(c u) / c` it is `4 b int_0^z (h^2, h h', h'^2)
    du`, the second `2 b h(z)^2`: by polynomials up to SHORT, `1 - A A^T` beyond.
    """
    h, still = _free_oscillation(z)
    up = still + DAMPING * h
    down = still - DAMPING * h
    far = z > SHORT
    near = np.minimum(z, SHORT)
    ff_near = near**3 * _PLACES(near)
    gg_near = near * _RATES(near)
    ff = np.where(far, 1 - up**2 - h**2, ff_near)
    gg = np.where(far, 1 - down**2 - h**2, gg_near)
    fg = 2 * DAMPING * h**2
    return ff, fg, gg


def _integrals(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`4 b int_0^z h^2 du / z^3` and `4 b int_0^z h'^2 du / z` of `_noise`, by
    quadrature; of z (k,) without unit, b = DAMPING.
    """
    points, weights = np.polynomial.legendre.leggauss(DEGREE)
    share = (1 + points) / 2
    h, still = _free_oscillation(z[:, None] * share)
    rate = still - DAMPING * h
    scale = 2 * DAMPING * weights
    of_places = (scale * h**2).sum(axis=1)
    of_rates = (scale * rate**2).sum(axis=1)
    return of_places / z**2, of_rates


_PLACES = Chebyshev.interpolate(lambda z: _integrals(z)[0], DEGREE, (0.0, SHORT))
_RATES = Chebyshev.interpolate(lambda z: _integrals(z)[1], DEGREE, (0.0, SHORT))
