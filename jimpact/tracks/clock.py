"""Times of frames that err: residuals that grow with the speed.

A time that errs by d moves a place by v d along its flight, v its velocity there: the
variance of a residual is `s^2 + d^2 v^2`.
"""

import numpy as np
from scipy.optimize import minimize_scalar

from jimpact.tracks.arcs import Arcs
from jimpact.tracks.frames import Frames

# What errors of times must save of -2 log likelihood, beside the logarithm of the
# frames: of good tracks one in 500. Ten times more would miss clocks that err by a few
# times the noise.
LEAST_SAVED = 4.0
FEWEST = 20  # residuals; of ten times fewer nothing is learned
# Ratio of d v to s at the largest v: ten times less is not seen, ten times more is no
# noise at all.
SMALLEST_RATIO = 0.3
LARGEST_RATIO = 1e4


def velocities(arcs: Arcs, frames: Frames) -> np.ndarray:
    """Velocities (T, n) at all frames of flights, NaN at others; between ends they are
    lines."""
    found = np.full(frames.q.shape, np.nan)
    first, last = arcs.end_velocities
    for i, some in enumerate(arcs.members):
        begin, end = arcs.instants[i : i + 2]
        share = ((frames.t[some] - begin) / (end - begin))[:, None]
        found[some] = first[i] * (1 - share) + last[i] * share
    return found


def with_clock(arcs: Arcs, frames: Frames) -> tuple[Frames, float]:
    """Frames whose errors grow with the speed, and the error of times d [s]; 0: they do
    not.

    Equation: with residuals r and velocities v in sigma their variance is `a (1 + b
    v^2)`; b by the likelihood, a its best for each b, `d^2 = a b`, if this saves
    LEAST_SAVED and BIC's price. What is searched is `log(b max v^2)`, twice that of the
    ratio of d v to sigma. Errors of frames are `sqrt(a (1 + b v^2))` of sigma, those of
    coordinates with waves sigma itself.
    """
    speed = velocities(arcs, frames) / arcs.errors.sigma
    square = speed**2
    rest = arcs.residual**2
    ok = np.isfinite(rest) & np.isfinite(square) & ~arcs.errors.waving
    x = square[ok]
    y = rest[ok]
    if len(y) < FEWEST or not np.ptp(x):
        return frames, 0.0
    x = x / x.max()

    def cost(log_ratio: float) -> float:
        """-2 log likelihood at `log(b max v^2)`, a at its best; x is v^2 / max v^2."""
        spread = 1 + np.exp(log_ratio) * x
        return float(len(y) * np.log(np.mean(y / spread)) + np.log(spread).sum())

    bounds = 2 * np.log([SMALLEST_RATIO, LARGEST_RATIO])
    best = minimize_scalar(cost, bounds=bounds, method="bounded")
    saved = len(y) * np.log(np.mean(y)) - float(best.fun)
    if saved < np.log(len(y)) + LEAST_SAVED:
        return frames, 0.0
    ratio = float(np.exp(best.x)) / square[ok].max()
    size = float(np.mean(y / (1 + ratio * square[ok])))
    spread = size * (1 + ratio * np.nan_to_num(square))
    spread[:, arcs.errors.waving] = 1.0
    return frames.with_relative(np.sqrt(spread)), float(np.sqrt(size * ratio))
