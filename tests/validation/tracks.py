"""Figures of docs/from_the_camera.md and docs/recordings.md: `python tests/validation/tracks.py`, in six minutes.

Of a ball that falls from half a metre: bias, scatter, stated error and coverage of e against the
bound of Cramer and Rao, what people usually do, what goes wrong with cameras and how often it is
told; three coordinates with lost frames; the time for long tracks; measured drops of a square.
"""

import time
from collections.abc import Callable

import numpy as np
from scipy.interpolate import make_smoothing_spline
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation

import jimpact as ji

G, HEIGHT, E, NOISE = 9.80665, 0.5, 0.8, 1e-3  # [m/s^2], [m], 1, [m]
TRACKS = 400  # the bias is known to a twentieth of the scatter
TRAPPED = 200  # tracks of each trap: shares are known within 3 %
SPEED = np.sqrt(2 * G * HEIGHT)
FIRST = SPEED / G  # instant of the bounce [s]
NEAR = 0.02  # [s] from the bounce, where its impact is looked for


def frames(rng: np.random.Generator, fps: int) -> np.ndarray:
    """Times of the frames: one fall, and most of the flight after it."""
    return (np.arange(int(fps * FIRST * (1 + 1.8 * E))) + rng.random()) / fps


def height(t: np.ndarray) -> np.ndarray:
    """Of the ball at these times."""
    since = t - FIRST
    return np.where(since < 0, -SPEED * since, E * SPEED * since) - G * since**2 / 2


def ball(
    rng: np.random.Generator, fps: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, heights with noise, times since the bounce."""
    t = frames(rng, fps)
    return t, height(t) + NOISE * rng.normal(size=t.size), t - FIRST


# ------------------------------------------------------------------------- find_impacts itself


def least_error(since: np.ndarray) -> float:
    """The bound, by the information on place, both velocities and the instant."""
    after = since >= 0
    velocity = np.where(after, E * SPEED, -SPEED) - G * since
    slopes = np.stack(
        [np.ones_like(since), since * ~after, since * after, -velocity], axis=1
    )
    covariance = np.linalg.inv(slopes.T @ slopes) * NOISE**2
    gradient = np.array([0.0, E / SPEED, 1 / SPEED, 0.0])
    return float(np.sqrt(gradient @ covariance @ gradient))


def restitution(impact: ji.tracks.TrackImpact, c: int = -1) -> tuple[float, float]:
    """e of an impact by coordinate c, and its standard error."""
    n = len(impact.pre)
    pre, post = impact.pre[c], impact.post[c]
    slope = np.zeros((2, n))
    slope[:, c] = post / pre**2, -1 / pre
    return -post / pre, float(
        np.sqrt(slope.ravel() @ impact.covariance @ slope.ravel())
    )


def row(fps: int) -> str:
    """A line of the table."""
    rng, values, warned = np.random.default_rng(fps), [], 0
    for _ in range(TRACKS):
        t, y, since = ball(rng, fps)
        track = ji.tracks.find_impacts(t, y, NOISE, acceleration=-G)
        warned += bool(track.warnings)
        if len(track.impacts) == 1:
            values.append((*restitution(track.impacts[0]), least_error(since)))
    e, stated, least = np.array(values).T
    within = np.mean(np.abs(e - E) < 1.96 * stated)
    print(
        f"{fps} frames a second: {len(e)} of {TRACKS} with one impact, {warned} with a warning"
    )
    return (
        f"| {fps} | {e.mean() - E:.5f} | {e.std():.5f} | {stated.mean():.5f} | {least.mean():.5f} "
        f"| {100 * within:.1f} % |"
    )


def in_space() -> str:
    """Three coordinates, a tenth of the frames lost, the noise unknown."""
    rng, found, values = np.random.default_rng(1), 0, []
    for _ in range(TRACKS):
        t, y, since = ball(rng, 120)
        side = np.column_stack([0.3 * t - 0.1 * np.maximum(since, 0), 0.2 - 0.1 * t])
        q = np.column_stack([side + NOISE * rng.normal(size=side.shape), y])
        q[rng.random(len(t)) < 0.1] = np.nan
        track = ji.tracks.find_impacts(t, q, acceleration=[0, 0, -G])
        found += len(track.impacts) == 1
        values += [
            restitution(each)[0]
            for each in track.impacts
            if abs(each.time - FIRST) < NEAR
        ]
    e = np.array(values)
    return (
        f"in space, a tenth of the frames lost, noise unknown: {found} of {TRACKS} with one impact, "
        f"bias {e.mean() - E:.5f}, standard deviation {e.std():.5f}"
    )


# ------------------------------------------------------------------------- what people usually do


def of_slopes(y: np.ndarray, slopes: np.ndarray) -> float:
    """e by the largest slope over the smallest one, next to the lowest frame."""
    low = int(np.argmin(y))
    near = slopes[max(low - 6, 0) : low + 7]
    return float(-near.max() / near.min())


def smoothed(t: np.ndarray, y: np.ndarray) -> float:
    """Savitzky and Golay's filter, seven frames, order 2."""
    return of_slopes(y, savgol_filter(y, 7, 2, deriv=1, delta=t[1] - t[0]))


def splined(t: np.ndarray, y: np.ndarray) -> float:
    """A smoothing spline, by generalized cross-validation."""
    return of_slopes(y, make_smoothing_spline(t, y).derivative()(t))


def lines(t: np.ndarray, y: np.ndarray) -> float:
    """Straight lines through six frames on each side of the lowest one."""
    low = int(np.argmin(y))
    before, after = slice(low - 6, low), slice(low + 1, low + 7)
    return float(
        -np.polyfit(t[after], y[after], 1)[0] / np.polyfit(t[before], y[before], 1)[0]
    )


WAYS: dict[str, Callable[[np.ndarray, np.ndarray], float]] = {
    "Savitzky-Golay, 7 frames, order 2": smoothed,
    "smoothing spline": splined,
    "lines through six frames": lines,
}


def usual(name: str) -> str:
    """Bias and standard deviation of e by a usual way, at three rates."""
    cells = []
    for fps in (60, 120, 240):
        rng = np.random.default_rng(fps)
        e = np.array([WAYS[name](*ball(rng, fps)[:2]) for _ in range(TRACKS)])
        cells.append(f"{e.mean() - E:+.3f}, {e.std():.3f}")
    return f"| {name} | {' | '.join(cells)} |"


# ------------------------------------------------------------------------------------- the traps


def dragged(t: np.ndarray, drag: float = 0.12) -> np.ndarray:
    """Height of a ball under a drag of `drag` v^2, a table-tennis ball's [1/m]."""
    since, terminal = t - FIRST, np.sqrt(G / drag)
    rate = np.sqrt(G * drag)
    # down, with the speed SPEED at the bounce; up, until it turns, and down again
    arrived = np.arctanh(SPEED / terminal) / rate
    before = (
        np.log(np.cosh(rate * arrived) / np.cosh(rate * np.maximum(since + arrived, 0)))
        / drag
    )
    rise = np.arctan(E * SPEED / terminal) / rate
    up = (
        np.log(np.cos(rate * np.clip(rise - since, 0, rise)) / np.cos(rate * rise))
        / drag
    )
    down = np.log(np.cosh(rate * np.maximum(since - rise, 0))) / drag
    return np.where(since < 0, before, up - down)


def trapped(name: str, rng: np.random.Generator) -> dict[str, object]:
    """Arguments of `find_impacts` for a track with this trap."""
    t = frames(rng, 120)
    y = height(t)
    noise = NOISE * rng.normal(size=t.size)
    good: dict[str, object] = {"t": t, "q": y + noise, "acceleration": -G}
    taken = np.arange(len(t)) * 4 // 5  # every fifth frame is there twice
    angle = np.where(t < FIRST, 8.0, -5.0) * (t - FIRST) + 0.005 * rng.normal(
        size=t.size
    )
    changes: dict[str, dict[str, object]] = {
        "nothing": {},
        "times jitter, .2 ms": {
            "q": height(t + 2e-4 * rng.normal(size=t.size)) + noise
        },
        "times jitter, 1 ms": {"q": height(t + 1e-3 * rng.normal(size=t.size)) + noise},
        "rolling shutter, 5 ms a metre": {"q": height(t - 0.005 * y) + noise},
        "rolling shutter, 16 ms a metre": {"q": height(t - 0.016 * y) + noise},
        "lengths 2 % short": {"q": 0.98 * y + noise},
        "the same, acceleration unknown": {"q": 0.98 * y + noise, "acceleration": None},
        "drag of a table-tennis ball": {"q": dragged(t) + noise},
        "the same, drag known": {"q": dragged(t) + noise, "drag": 0.12},
        "the same, drag unknown": {"q": dragged(t) + noise, "drag": None},
        "camera pans, 5 cm/s": {"q": y + 0.05 * t + noise},
        "camera shakes, 3 mm at 3 Hz": {"q": y + 0.003 * np.sin(6 * np.pi * t) + noise},
        "every fifth frame twice": {"q": (y + noise)[taken]},
        "the same, noise added": {
            "q": (y + noise)[taken] + 1e-4 * rng.normal(size=t.size)
        },
        "y points down": {"q": -y + noise},
        "gravity forgotten": {"acceleration": 0.0},
        "degrees for radians": {
            "q": np.degrees(angle),
            "acceleration": 0.0,
            "units": "rad",
        },
    }
    return good | changes[name]


TRAPS = (
    *(
        "nothing",
        "times jitter, .2 ms",
        "times jitter, 1 ms",
        "rolling shutter, 5 ms a metre",
    ),
    *(
        "rolling shutter, 16 ms a metre",
        "lengths 2 % short",
        "the same, acceleration unknown",
    ),
    *("drag of a table-tennis ball", "the same, drag known", "the same, drag unknown"),
    *("camera pans, 5 cm/s", "camera shakes, 3 mm at 3 Hz"),
    *(
        "every fifth frame twice",
        "the same, noise added",
        "y points down",
        "gravity forgotten",
    ),
    "degrees for radians",
)


def told(name: str) -> str:
    """A trap: bias of e, and the share of tracks with a warning, noise known and not."""
    biases, shares = [], []
    for sigma in (NOISE, None):
        rng, e, warned = np.random.default_rng(7), [], 0
        for _ in range(TRAPPED):
            given = 0.3 if name.startswith("degrees") and sigma else sigma
            try:
                track = ji.tracks.find_impacts(sigma=given, **trapped(name, rng))
            except ValueError:
                warned += 1
                continue
            warned += bool(track.warnings)
            near = [each for each in track.impacts if abs(each.time - FIRST) < NEAR]
            e += [restitution(each)[0] - E for each in near[:1]]
        biases.append(f"{np.median(e):+.4f}" if e else "-")
        shares.append(f"{100 * warned / TRAPPED:.0f} %")
    return f"| {name} | {biases[0]} | {shares[0]} | {shares[1]} |"


# ---------------------------------------------------------------------------------- how long it takes


def seconds(count: int) -> str:
    """First and second call of a ball that bounces on, 120 frames a second."""
    rng, t, start, y = (
        np.random.default_rng(0),
        np.arange(count) / 120,
        0.0,
        np.zeros(count),
    )
    while start < t[-1]:
        speed = 2 + 1.5 * rng.random()
        here = (t >= start) & (t < start + 2 * speed / G)
        y[here] = speed * (t[here] - start) - G * (t[here] - start) ** 2 / 2
        start += 2 * speed / G
    y += NOISE * rng.normal(size=count)
    took = []
    for _ in range(2):
        begun = time.perf_counter()
        track = ji.tracks.find_impacts(t, y, acceleration=-G)
        took.append(time.perf_counter() - begun)
    return f"{count} frames, {len(track.impacts)} impacts: {took[0]:.2f} s, then {took[1]:.2f} s"


# --------------------------------------------------------------------- measured drops of a square

SQUARE_ERRORS = [
    2e-4,
    2e-4,
    4e-3,
]  # of a pose [m], [m], [rad]; it is stored in 20 um and .5 mrad
ROUNDED = 5e-3  # [m] by which corners of a perfect square would lie in the table


def gliders() -> str:
    """Two gliders on an air track, 0.2 and 0.3 kg: from the track of both to e and its error.

    The fit knows momentum, which the velocities must conserve.
    """
    rng, (m1, m2), v, found, values = (
        np.random.default_rng(3),
        (0.2, 0.3),
        (0.6, -0.2),
        0,
        [],
    )
    jump = (1 + E) * (v[0] - v[1]) / (1 / m1 + 1 / m2)  # impulse [N s]
    after, scene = (v[0] - jump / m1, v[1] + jump / m2), ji.chain([m1, m2])
    for _ in range(TRACKS):
        t = (np.arange(72) + rng.random()) / 60
        since = t - 0.6
        q = np.stack(
            [np.where(since < 0, a, b) * since for a, b in zip(v, after)], axis=1
        )
        track = ji.tracks.find_impacts(
            t, q + NOISE * rng.normal(size=q.shape), acceleration=0.0
        )
        found += len(track.impacts) == 1
        if len(track.impacts) == 1:
            fit = ji.fit(ji.Newton(0.5), scene, track.experiments(), starts=1)
            values.append((fit.value[0], fit.standard_error[0]))
    e, stated = np.array(values).T
    within = 100 * np.mean(np.abs(e - E) < 1.96 * stated)
    return (
        f"two gliders, 60 frames a second: {found} of {TRACKS} with one impact, bias "
        f"{e.mean() - E:.5f}, standard deviation {e.std():.5f}, stated {stated.mean():.5f}, "
        f"{within:.1f} % within the 95 % interval"
    )


def cube() -> str:
    """A cube that lands on a corner, 148 poses a second: errors in units of the stated ones."""
    rng, body, errors = np.random.default_rng(4), ji.Box([0.1] * 3, 0.3), []
    turn, at = Rotation.from_rotvec([0.5, 0.3, 0.2]), 0.17
    before = np.array([0.3, -0.2, -1.5, 3.0, -2.0, 4.0])
    pose = np.asarray(body.touching(np.roll(turn.as_quat(), 1)))
    law = ji.Newton(E, friction=0.2)
    after = np.asarray(ji.impact(law, body.scenes([pose])[0], before).velocity)
    sigma = np.repeat([1e-4, 1e-3], 3)  # [m], [rad]
    for _ in range(TRACKS):
        t = (np.arange(50) + rng.random()) / 148
        since, noise = (t - at)[:, None], sigma * rng.normal(size=(len(t), 6))
        v = np.where(since < 0, before, after)
        places = (
            pose[:3] + v[:, :3] * since - G / 2 * since**2 * [0, 0, 1] + noise[:, :3]
        )
        turns = (
            turn
            * Rotation.from_rotvec(v[:, 3:] * since)
            * Rotation.from_rotvec(noise[:, 3:])
        )
        q = np.hstack([places, turns.as_quat()])
        track = ji.tracks.find_impacts(
            t, q, sigma, acceleration=[0, 0, -G], quaternion="xyzw"
        )
        if len(track.impacts) == 1:
            (impact,) = track.impacts
            apart = np.concatenate([impact.pre - before, impact.post - after])
            errors.append(np.linalg.solve(np.linalg.cholesky(impact.covariance), apart))
    within = 100 * np.mean(np.abs(errors) < 1.96)
    return (
        f"cube: {len(errors)} of {TRACKS} with one impact, largest bias of 12 velocities "
        f"{np.abs(np.mean(errors, axis=0)).max():.2f} errors, chi^2 "
        f"{np.mean(np.sum(np.square(errors), axis=1)):.2f} of 12, {within:.1f} % within 95 %"
    )


def shots_of(track: ji.tracks.Track, body: ji.Body, near: float) -> set[str]:
    """The numbers of the impacts that are shots of the body."""
    try:
        return set(track.experiments(body, near).shots)
    except ValueError:  # none is
        return set()


def square() -> str:
    """Impacts of `ji.data.square_drops` beside those of `ji.data.square_impacts`."""
    drops, t, poses = ji.data.square_drops()
    body, published = ji.Block(0.06, 0.06), ji.data.square_impacts()
    errors = np.concatenate([published.sigma_pre[0], published.sigma[0]])
    known: dict[int, list[tuple[float, int]]] = {}
    for k, label in enumerate(published.shots):
        drop, frame = label.split(":")
        known.setdefault(int(drop), []).append((float(frame), k))
    found, asked, possible, shots, apart = 0, 0, 0, 0, []
    for drop, q in zip(drops, poses):
        track = ji.tracks.find_impacts(
            t, q, SQUARE_ERRORS, acceleration=[0, -9.81, 0], units=["m", "m", "rad"]
        )
        found += len(track.impacts)
        kept = shots_of(track, body, ROUNDED)
        shots += len(kept)
        times = 250 * np.array([each.time for each in track.impacts])
        for frame, k in known.get(int(drop), []):
            asked, i = asked + 1, int(np.argmin(np.abs(times - frame)))
            if abs(times[i] - frame) < 1:
                each = track.impacts[i]
                possible += str(i + 1) in kept
                theirs = np.concatenate([published.pre[k], published.post[k]])
                apart.append((np.concatenate([each.pre, each.post]) - theirs) / errors)
    middle = ", ".join(f"{x:.1f}" for x in np.median(np.abs(apart), axis=0))
    within = 100 * np.mean(np.abs(apart) < 2)
    return (
        f"square: {found} impacts in {len(drops)} drops, {shots} of them shots; of {asked} "
        f"published ones {len(apart)} are found, {possible} of them as shots; differences in "
        f"published errors, medians of vx, vy, angle before and after: {middle}; {within:.0f} % "
        "within two"
    )


if __name__ == "__main__":
    print("\n".join([seconds(count) for count in (250, 2500, 25000)]))
    print("\n".join([row(fps) for fps in (60, 120, 240)]))
    print(in_space())
    print(gliders())
    print("\n".join([usual(name) for name in WAYS]))
    print("\n".join([told(name) for name in TRAPS]))
    print(cube())
    print(square())
