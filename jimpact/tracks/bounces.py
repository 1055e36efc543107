"""Velocities of a ball from the times of its bounces."""

from typing import Any

import numpy as np

from jimpact.shots.data import Experiments
from jimpact.tools.checks import as_float_array, check_concrete, check_values


def bounce_times(times: Any, sigma: Any, gravity: float = 9.80665) -> Experiments:
    """Shots of a ball that bounces on a plane, from the times at which it does.

    Equation: a flight of duration T between bounces leaves with `g T / 2` and arrives
    with `-g T / 2`: at the inner bounces `v- = -g (t_k - t_(k-1)) / 2`,
    `v+ = g (t_(k+1) - t_k) / 2`. No drag; the plane is as high at each bounce.
    Successive bounces share a flight: the covariance is of all shots, and v+ of one is
    exactly -v- of the next.

    Args:
        times: of N >= 3 successive bounces, rising (N,) [s]; a bounce that was not
            heard must not be left out, but parts the times: call this for each part,
            and join the shots.
        sigma: standard error of a time, a number or (N,), > 0 [s].
        gravity: > 0 [m/s^2].

    Returns:
        `Experiments` of N - 2 shots of one velocity, upwards, with `covariance`. In
        `ji.chain([m], "left")` the ball falls on its wall.

    Raises:
        ValueError: fewer than 3 times, times that do not rise or are not finite, sigma
            <= 0.

    >>> import jimpact as ji
    >>> shots = ji.tracks.bounce_times([0.0, 0.5, 0.9, 1.22], sigma=0.001)
    >>> [round(-float(v[1] / v[0]), 3) for v in zip(shots.pre[:, 0], shots.post[:, 0])]
    [0.8, 0.8]
    """
    for name, value in (("times", times), ("sigma", sigma), ("gravity", gravity)):
        check_concrete(name, value)
        as_float_array(name, value)  # raises for what are no numbers
    times = np.asarray(times, float)
    sigma = np.asarray(sigma, float)
    check_values("times", times)
    check_values("sigma", sigma, low=0.0, open_low=True)
    check_values("gravity", np.asarray(gravity, float), low=0.0, open_low=True)
    if times.ndim != 1 or len(times) < 3:
        raise ValueError(
            f"Argument `times` must be three or more in a row: a bounce needs one "
            f"before and one after, but has shape {times.shape}."
        )
    if not (np.diff(times) > 0).all():
        k = int(np.argmin(np.diff(times) > 0))
        raise ValueError(
            f"Argument `times` must rise, but time {k + 2}, {times[k + 1]:g} s, is not "
            f"after {times[k]:g} s (a bounce that was not heard is often written as 0: "
            f"leave it out, and what is on both sides is two parts)."
        )
    if sigma.shape not in ((), times.shape):
        raise ValueError(
            f"Argument `sigma` must be a number or have shape {times.shape}, but has "
            f"shape {sigma.shape}."
        )
    count = len(times) - 2
    # of each flight: g T / 2
    speed = 0.5 * float(gravity) * np.diff(np.eye(len(times)), axis=0)
    gain = np.stack([-speed[:-1], speed[1:]], axis=1).reshape(2 * count, len(times))
    covariance = gain * np.broadcast_to(sigma, times.shape) ** 2 @ gain.T
    pre, post = (gain @ times).reshape(count, 2).T
    return Experiments(
        pre[:, None],
        post[:, None],
        covariance=covariance,
        shots=[str(k) for k in range(2, count + 2)],
    )
