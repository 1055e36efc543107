"""Errors of places: white ones, and waves beside them.

A table that is not level, a lens, drag that is not known move places slowly beside an
arc. Such *waves* are errors, too, that neighbouring frames share. In a flight the
errors of one coordinate have the covariance `C = sigma^2 1 + w^2 k(|t_i - t_j| / T)`. k
is that of an oscillator of damping DAMPING that noise drives: `k(x) = exp(-b x) (cos(c
x) + b / c sin(c x))`, c^2 = 1 - b^2. Its spectrum is flat below the frequency 1 / T,
and falls as its fourth power above: waves are as slow as T, and not slower, as drifts
are the business of the flights' lines and parabolas. Waves of different flights are
independent.

The oscillator has a place f and a velocity g: C^-1 of N frames takes a banded matrix of
2 N rows (Hartikainen and Saerkkae, MLSP 2010; Foreman-Mackey et al., AJ 154, 2017), at
any times.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial import Chebyshev
from scipy.linalg import cho_solve_banded, cholesky_banded

BANDS = 3  # above the diagonal: (f, g) of a frame and of the next one
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


@dataclass(frozen=True)
class Errors:
    """Standard errors (n,) of each coordinate: white sigma, waves w, and their time T
    [s].

    `clock`: standard error of the times of frames [s], which is part of sigma.
    """

    sigma: np.ndarray
    waves: np.ndarray
    times: np.ndarray
    clock: float = 0.0

    @classmethod
    def white(cls, sigma: np.ndarray) -> "Errors":
        """Errors without waves."""
        return cls(sigma, np.zeros_like(sigma), np.ones_like(sigma))

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
        return Covariance(
            t, starts, self.sigma[c], self.waves[c], self.times[c], relative
        )


@dataclass(frozen=True)
class Covariance:
    """Covariance C of the errors of one coordinate in the frames t (N,) of F flights in
    turn.

    Fields: `starts` (F,), the first frame of each flight; white sigma; waves w; their
    time T [s]; `relative` (N,): white errors of frames in sigma; None: 1.
    """

    t: np.ndarray
    starts: np.ndarray
    sigma: float
    wave: float
    time: float
    relative: np.ndarray | None = None

    @property
    def weights(self) -> np.ndarray:
        """`1 / relative^2` (N,)."""
        return np.ones(len(self.t)) if self.relative is None else self.relative**-2.0

    def solve(self, x: np.ndarray) -> np.ndarray:
        """`C^-1 x` (N, m) of columns x.

        Equation: with f the most likely waves and the weights u, `u (x - f) / sigma^2`.
        """
        weights = self.weights[:, None]
        if not self.wave:
            return weights * x / self.sigma**2
        sides = np.zeros((2 * len(x), x.shape[1]))
        sides[::2] = weights * x
        waves = cho_solve_banded((self._factor, False), sides, check_finite=False)
        return weights * (x - waves[::2]) / self.sigma**2

    def log_det(self) -> np.ndarray:
        """`log |C|` (F,) of each flight.

        Equation: `log |S| + log |P / w^2 + S^-1| - log |P / w^2|`, P the precision of
        unit (f, g), S = sigma^2 / u the white variances.
        """
        own = 2 * np.log(self.sigma) - np.log(self.weights)
        if not self.wave:
            return np.add.reduceat(own, self.starts)
        white = 4 * np.log(self.wave) - 4 * np.log(self.sigma) + own
        diagonal = 2 * np.log(self._factor[-1]).reshape(-1, 2).sum(axis=1)
        return np.add.reduceat(white + diagonal + self._steps.log_det, self.starts)

    @cached_property
    def _steps(self) -> "Steps":
        """The process from frame to frame."""
        return steps_of(self.t, self.starts, self.time)

    @cached_property
    def _factor(self) -> np.ndarray:
        """Cholesky factor of `(sigma / w)^2 P + u`, u the weights of f: upper bands (4,
        2 N)."""
        ratio = (self.sigma / self.wave) ** 2
        bands = ratio * self._steps.bands
        bands[-1, ::2] += self.weights
        return cholesky_banded(bands, check_finite=False)


@dataclass(frozen=True)
class Steps:
    """Unit waves: bands (4, 2 N) of their precision P, and `log |Q|` (N,) of each
    step.
    """

    bands: np.ndarray
    log_det: np.ndarray


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
    moved, still = _free(z)
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
    following = slice(1, None)
    own_ff[:-1] -= (a_ff * m_ff + a_gf * m_gf)[following]
    own_fg[:-1] -= (a_ff * m_fg + a_gf * m_gg)[following]
    own_gg[:-1] -= (a_fg * m_fg + a_gg * m_gg)[following]
    bands = np.zeros((BANDS + 1, 2 * len(t)))
    main, one, two, three = bands[::-1]
    f = slice(0, None, 2)  # rows of the values f of frames
    g = slice(1, None, 2)
    next_f = slice(2, None, 2)
    next_g = slice(3, None, 2)
    main[f] = own_ff
    main[g] = own_gg
    one[g] = own_fg
    one[next_f] = m_fg[following]  # g of a frame with f of the next one
    two[next_f] = m_ff[following]
    two[next_g] = m_gg[following]
    three[next_g] = m_gf[following]
    return Steps(bands, np.log(det))


def _free(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`exp(-b z) sin(c z) / c` and `exp(-b z) cos(c z)` of steps z of a free
    oscillator."""
    decay = np.exp(-DAMPING * z)
    return decay * np.sin(FREQUENCY * z) / FREQUENCY, decay * np.cos(FREQUENCY * z)


def _noise(z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Covariance (ff, fg, gg) of what noise adds to (f, g) over steps z (N,).

    Equation: with h = `exp(-b u) sin(c u) / c` it is `4 b int_0^z (h^2, h h', h'^2)
    du`, the second `2 b h(z)^2`: by polynomials up to SHORT, `1 - A A^T` beyond.
    """
    h, still = _free(z)
    up = still + DAMPING * h
    down = still - DAMPING * h
    far = z > SHORT
    near = np.minimum(z, SHORT)
    ff = np.where(far, 1 - up**2 - h**2, near**3 * _PLACES(near))
    gg = np.where(far, 1 - down**2 - h**2, near * _RATES(near))
    return ff, 2 * DAMPING * h**2, gg


def _integrals(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`4 b int_0^z h^2 du / z^3` and `4 b int_0^z h'^2 du / z` of `_noise`, by
    quadrature."""
    points, weights = np.polynomial.legendre.leggauss(DEGREE)
    share = (1 + points) / 2
    h, still = _free(z[:, None] * share)
    rate = still - DAMPING * h
    scale = 2 * DAMPING * weights
    return (scale * h**2).sum(axis=1) / z**2, (scale * rate**2).sum(axis=1)


_PLACES = Chebyshev.interpolate(lambda z: _integrals(z)[0], DEGREE, (0.0, SHORT))
_RATES = Chebyshev.interpolate(lambda z: _integrals(z)[1], DEGREE, (0.0, SHORT))
