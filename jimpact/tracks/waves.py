"""Errors of places: white ones, and waves beside them.

A table that is not level, a lens, drag that is not known move places slowly beside an
arc. Such *waves* are errors, too, that neighbouring frames share. In a flight the
errors of one coordinate have the covariance `C = sigma^2 1 + w^2 k(|t_i - t_j| / T)`,
`k(x) = (1 + x) exp(-x)` (Matern, 3/2: waves with a velocity, which wander within the
time T). Waves of different flights are independent.

`k` is the covariance of a process of second order, of place f and velocity g: C^-1 of N
frames takes a banded matrix of 2 N rows (Hartikainen and Saerkkae, MLSP 2010), at any
times.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.special import gammainc

BANDS = 3  # above the diagonal: (f, g) of a frame and of the next one


@dataclass(frozen=True)
class Errors:
    """Standard errors (n,) of each coordinate: white sigma, waves w, and their time T
    [s].
    """

    sigma: np.ndarray
    waves: np.ndarray
    times: np.ndarray

    @classmethod
    def white(cls, sigma: np.ndarray) -> "Errors":
        """Errors without waves."""
        return cls(sigma, np.zeros_like(sigma), np.ones_like(sigma))

    def of(self, c: int, t: np.ndarray, starts: np.ndarray) -> "Covariance":
        """Covariance of coordinate c in frames t (N,) of flights that begin at `starts`
        (F,).
        """
        return Covariance(t, starts, self.sigma[c], self.waves[c], self.times[c])


@dataclass(frozen=True)
class Covariance:
    """Covariance C of the errors of one coordinate in the frames t (N,) of F flights in
    turn.

    Fields: `starts` (F,), the first frame of each flight; white sigma; waves w; their
    time T [s].
    """

    t: np.ndarray
    starts: np.ndarray
    sigma: float
    wave: float
    time: float

    def solve(self, x: np.ndarray) -> np.ndarray:
        """`C^-1 x` (N, m) of columns x.

        Equation: with f the most likely waves, `(x - f) / sigma^2`.
        """
        if not self.wave:
            return x / self.sigma**2
        sides = np.zeros((2 * len(x), x.shape[1]))
        sides[::2] = x
        waves = cho_solve_banded((self._factor, False), sides, check_finite=False)
        return (x - waves[::2]) / self.sigma**2

    def log_det(self) -> np.ndarray:
        """`log |C|` (F,) of each flight.

        Equation: `N log sigma^2 + log |P / w^2 + E / sigma^2| - log |P / w^2|`, P the
        precision of unit (f, g).
        """
        if not self.wave:
            return np.add.reduceat(
                np.full(len(self.t), 2 * np.log(self.sigma)), self.starts
            )
        white = 4 * np.log(self.wave) - 2 * np.log(self.sigma)
        diagonal = 2 * np.log(self._factor[-1]).reshape(-1, 2).sum(axis=1)
        return np.add.reduceat(white + diagonal + self._steps.log_det, self.starts)

    @cached_property
    def _steps(self) -> "Steps":
        """The process from frame to frame."""
        return steps_of(self.t, self.starts, self.time)

    @cached_property
    def _factor(self) -> np.ndarray:
        """Cholesky factor of `sigma^2 P + E`, E the frames seen: upper bands (4, 2
        N).
        """
        ratio = (self.sigma / self.wave) ** 2
        bands = ratio * self._steps.bands
        bands[-1, ::2] += 1.0
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

    Equation: over a step of z = dt / T, `(f, g)' = A (f, g) + e`,
    `A = exp(-z) [[1 + z, z], [-z, 1 - z]]`, e of covariance `Q = 1 - A A^T`; f and g,
    the velocity times T, have variance 1 at the start of a flight.
    """
    z = np.diff(t, prepend=t[0]) / time
    first = np.zeros(len(t), bool)
    first[starts] = True
    decay = np.exp(-z)
    rest = gammainc(3, 2 * z)  # 1 - exp(-2z) (1 + 2z + 2z^2)
    q_ff = np.where(first, 1.0, rest)
    q_fg = np.where(first, 0.0, 2 * (z * decay) ** 2)
    q_gg = np.where(first, 1.0, rest + 4 * z * decay**2)
    det = q_ff * q_gg - q_fg**2
    w_ff = q_gg / det  # the inverse W of Q
    w_fg = -q_fg / det
    w_gg = q_ff / det
    moves = np.where(first, 0.0, decay)
    a_ff = moves * (1 + z)
    a_fg = moves * z
    a_gf = -moves * z
    a_gg = moves * (1 - z)
    # -W A, of the next frame (rows) and this one (columns)
    m_ff = -(w_ff * a_ff + w_fg * a_gf)
    m_fg = -(w_ff * a_fg + w_fg * a_gg)
    m_gf = -(w_fg * a_ff + w_gg * a_gf)
    m_gg = -(w_fg * a_fg + w_gg * a_gg)
    own_ff = w_ff.copy()
    own_fg = w_fg.copy()
    own_gg = w_gg.copy()
    # A^T W A of the step that follows
    own_ff[:-1] -= (a_ff * m_ff + a_gf * m_gf)[1:]
    own_fg[:-1] -= (a_ff * m_fg + a_gf * m_gg)[1:]
    own_gg[:-1] -= (a_fg * m_fg + a_gg * m_gg)[1:]
    bands = np.zeros((BANDS + 1, 2 * len(t)))
    main, one, two, three = bands[::-1]
    main[::2] = own_ff
    main[1::2] = own_gg
    one[1::2] = own_fg
    one[2::2] = m_fg[1:]  # g of a frame with f of the next one
    two[2::2] = m_ff[1:]
    two[3::2] = m_gg[1:]
    three[3::2] = m_gf[1:]
    return Steps(bands, np.log(det))
