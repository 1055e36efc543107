"""The tables of docs/from_the_camera.md: `python tests/validation/tracks.py`, in two minutes.

Bias, scatter, stated error and coverage of e of a ball that falls from half a metre, against the
bound of Cramer and Rao; the time for long tracks.
"""

import time

import numpy as np

import jimpact as ji

G, HEIGHT, E, NOISE = 9.80665, 0.5, 0.8, 1e-3  # [m/s^2], [m], 1, [m]
TRACKS = 400  # the bias is known to a twentieth of the scatter
SPEED = np.sqrt(2 * G * HEIGHT)


def ball(rng: np.random.Generator, fps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, heights with noise, times since the bounce."""
    first = SPEED / G
    t = (np.arange(int(fps * first * (1 + 1.8 * E))) + rng.random()) / fps
    since = t - first
    y = np.where(since < 0, -SPEED * since, E * SPEED * since) - G * since**2 / 2
    return t, y + NOISE * rng.normal(size=t.size), since


def least_error(since: np.ndarray) -> float:
    """The bound, by the information on place, both velocities and the instant."""
    after = since >= 0
    velocity = np.where(after, E * SPEED, -SPEED) - G * since
    slopes = np.stack([np.ones_like(since), since * ~after, since * after, -velocity], axis=1)
    covariance = np.linalg.inv(slopes.T @ slopes) * NOISE**2
    gradient = np.array([0.0, E / SPEED, 1 / SPEED, 0.0])
    return float(np.sqrt(gradient @ covariance @ gradient))


def row(fps: int) -> str:
    """A line of the table."""
    rng, values, warned = np.random.default_rng(fps), [], 0
    for _ in range(TRACKS):
        t, y, since = ball(rng, fps)
        track = ji.tracks.find_impacts(t, y, NOISE, acceleration=-G)
        warned += bool(track.warnings)
        if len(track.impacts) != 1:
            continue
        (impact,) = track.impacts
        pre, post = impact.pre[0], impact.post[0]
        gradient = np.array([post / pre**2, -1 / pre])
        error = np.sqrt(gradient @ impact.covariance @ gradient)
        values.append((-post / pre, error, least_error(since)))
    e, stated, least = np.array(values).T
    within = np.mean(np.abs(e - E) < 1.96 * stated)
    print(f"{fps} frames a second: {len(e)} of {TRACKS} with one impact, {warned} with a warning")
    return (
        f"| {fps} | {e.mean() - E:.5f} | {e.std():.5f} | {stated.mean():.5f} | {least.mean():.5f} "
        f"| {100 * within:.1f} % |"
    )


def seconds(frames: int) -> str:
    """First and second call of a ball that bounces on, 120 frames a second."""
    rng, t, start, y = np.random.default_rng(0), np.arange(frames) / 120, 0.0, np.zeros(frames)
    while start < t[-1]:
        speed = 2 + 1.5 * rng.random()
        here = (t >= start) & (t < start + 2 * speed / G)
        y[here] = speed * (t[here] - start) - G * (t[here] - start) ** 2 / 2
        start += 2 * speed / G
    y += NOISE * rng.normal(size=frames)
    took = []
    for _ in range(2):
        begun = time.perf_counter()
        track = ji.tracks.find_impacts(t, y, acceleration=-G)
        took.append(time.perf_counter() - begun)
    return f"{frames} frames, {len(track.impacts)} impacts: {took[0]:.2f} s, then {took[1]:.2f} s"


if __name__ == "__main__":
    print("\n".join([row(fps) for fps in (60, 120, 240)]))
    print("\n".join([seconds(frames) for frames in (250, 2500, 25000)]))
