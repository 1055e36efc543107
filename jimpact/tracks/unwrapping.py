"""Angles without steps of 2 pi, also over frames that were lost."""

import numpy as np

TURN = 2 * np.pi  # [rad]
# Steps beside a gap whose median is the rate there: one false point among them does no
# harm. Ten times more would reach into other flights.
BESIDE = 5
# Of the median duration between frames: what is longer is a gap. Ten times more, and
# gaps of ten frames would count as one step; clocks of phones err by less than half.
LONG = 1.5


def unwrapped(t: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Angles (T,) [rad] that were seen at times t (T,) [s], without steps of 2 pi.

    Equation: from frame to frame the step is the one below half a turn. Over a gap of
    lost frames, of duration d, it is the one nearest to `d (w + w') / 2`, w and w' the
    median rates of the BESIDE steps before and after the gap; of one side where the
    other has no steps, and below half a turn where neither has. Angles that have no
    steps of 2 pi are returned as they are.
    """
    if len(angle) < 2:
        return angle
    duration = np.diff(t)
    step = np.diff(np.unwrap(angle))
    is_gap = duration > LONG * np.median(duration)
    rate = step / duration
    rate[is_gap] = np.nan
    for k in np.flatnonzero(is_gap):
        earlier = rate[max(k - BESIDE, 0) : k]
        later = rate[k + 1 : k + 1 + BESIDE]
        sides = [x[np.isfinite(x)] for x in (earlier, later)]
        medians = [np.median(x) for x in sides if x.size]
        if medians:
            expected = duration[k] * np.mean(medians)
            step[k] += TURN * np.round((expected - step[k]) / TURN)
    turns = np.round((step - np.diff(angle)) / TURN)
    return angle + TURN * np.concatenate([[0.0], np.cumsum(turns)])
