"""Tracks like those that people record, simulated: `python tests/validation/recordings.py [200]`.

Of each setting so many tracks: impacts found, lost and false ones (doubtful ones are neither), and
the errors of all velocities in the stated ones: largest mean, scatter, share within 95 % intervals.
A coordinate without noise has no errors to scatter: those stated are those of rounding.
"""

import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

import jimpact as ji

G = 9.80665  # [m/s^2]
FALL = np.sqrt(2 * G * 0.5)  # speed after half a metre [m/s]
EXACT = 1e-3  # in stated errors: errors of a coordinate without noise are smaller in all tracks
NEAR = 0.02  # [s] from an instant, or two frames, where its impact is looked for


class Recording(NamedTuple):
    """A track, arguments of `find_impacts`, instants (K,), velocities before and after (K, n)."""

    t: np.ndarray
    q: np.ndarray
    options: dict[str, Any]
    instants: np.ndarray
    before: np.ndarray
    after: np.ndarray


def ball(rng: np.random.Generator, fps: float = 120, noise: float = 1e-3) -> Recording:
    """A ball that falls from half a metre and bounces once, e = .8."""
    first = FALL / G
    t = (np.arange(int(fps * first * 2.4)) + rng.random()) / fps
    since = t - first
    y = np.where(since < 0, -FALL * since, 0.8 * FALL * since) - G * since**2 / 2
    q = (y + noise * rng.normal(size=t.size))[:, None]
    options = {"acceleration": -G}
    return Recording(
        t, q, options, np.array([first]), *np.array([[[-FALL]], [[0.8 * FALL]]])
    )


# ------------------------------------------------------------------------------- bends and waves


def lens(rng: np.random.Generator, q: np.ndarray, size: float) -> np.ndarray:
    """Errors of a lens in places q (T,): eight waves of .1 to .3 m, of this size in all [m]."""
    lengths = rng.uniform(0.1, 0.3, 8)
    phases = rng.uniform(0, 2 * np.pi, 8)
    waves = np.sin(2 * np.pi * q[:, None] / lengths + phases)
    return size * np.sqrt(2 / 8) * waves.sum(axis=1)


def gliders(
    rng: np.random.Generator,
    fps: float,
    noise: float,
    slope: float = 0.0,
    waves: float = 0.0,
    wobble: float = 0.0,
) -> Recording:
    """Two gliders of .2 and .3 kg, 2.4 s; a table with a slope [m/s^2], waves of a lens [m].

    And gliders that wobble by so much at 16 Hz [m].
    """
    at, masses = 1.2 + 0.1 * rng.random(), np.array([0.2, 0.3])
    v = np.array([0.5, -0.3])
    impulse = 1.8 * (v[0] - v[1]) / (1 / masses).sum()
    w = v + np.array([-1, 1]) * impulse / masses
    t = np.arange(int(2.4 * fps)) / fps
    since = (t - at)[:, None]
    q = np.where(since < 0, v, w) * since + slope * since**2 / 2
    seen = q + noise * rng.normal(size=q.shape)
    if waves:
        seen += np.stack([lens(rng, x, waves) for x in q.T], axis=1)
    if wobble:
        phases = rng.uniform(0, 2 * np.pi, 2)
        turned = -np.abs(since)  # the impact turns its velocity round
        seen += wobble * np.sin(2 * np.pi * 16 * turned + phases)
    return Recording(t, seen, {}, np.array([at]), v[None], w[None])


# ------------------------------------------------------------------------------ frames and times


def hidden(rng: np.random.Generator, lost: int) -> Recording:
    """The ball, and so many frames in a row lost around its impact, from a random one on."""
    one = ball(rng)
    q = one.q.copy()
    hit = int(np.searchsorted(one.t, one.instants[0]))
    first = hit - int(rng.integers(0, lost + 1))
    q[first : first + lost] = np.nan
    return one._replace(q=q)


def jittered(rng: np.random.Generator, jitter: float) -> Recording:
    """The ball by a clock that errs [s]."""
    one = ball(rng)
    t = np.sort(one.t + jitter * rng.normal(size=one.t.size))
    return one._replace(t=t)


def phone(rng: np.random.Generator) -> Recording:
    """The ball at a rate that varies between 40 and 60 frames a second, times as in the file."""
    first = FALL / G
    t = np.cumsum(rng.uniform(1 / 60, 1 / 40, 80))
    t = t[t < 2.4 * first]
    since = t - first
    y = np.where(since < 0, -FALL * since, 0.8 * FALL * since) - G * since**2 / 2
    one = ball(rng)
    return one._replace(t=t, q=(y + 1e-3 * rng.normal(size=t.size))[:, None])


# ------------------------------------------------------------------------------------- rounding


def exact(rng: np.random.Generator) -> Recording:
    """A ball in the plane; the coordinate along the rail has no noise."""
    one = ball(rng)
    q = np.column_stack([0.1 + 0.3 * one.t, one.q[:, 0]])
    before, after = (np.column_stack([[0.3], v]) for v in (one.before, one.after))
    return one._replace(
        q=q, options={"acceleration": [0, -G]}, before=before, after=after
    )


def rounded(rng: np.random.Generator, pixel: float) -> Recording:
    """The ball in whole pixels [m]."""
    one = ball(rng, noise=0.0)
    return one._replace(q=pixel * np.round(one.q / pixel + rng.random()))


# ---------------------------------------------------------------------------------- spin and drag


def spinning(rng: np.random.Generator, known: bool) -> Recording:
    """A table-tennis ball with drag and side spin that bounces once, 150 frames a second."""
    drag, magnus = (
        0.12,
        0.004 * np.array([0.0, rng.uniform(50, 150), 0.0]),
    )  # [1/m], [1/s]

    def air(v: np.ndarray) -> np.ndarray:
        """Acceleration by velocity."""
        speed = np.linalg.norm(v, axis=-1, keepdims=True)
        return np.array([0, 0, -G]) - drag * speed * v + np.cross(magnus, v)

    def flown(begin: np.ndarray, times: np.ndarray) -> np.ndarray:
        """Places at times from 0."""
        path = solve_ivp(
            lambda _, x: np.append(x[3:], air(x[3:])), (0, times[-1]), begin, t_eval=times,
            rtol=1e-10, atol=1e-12,
        )  # fmt: skip
        return path.y[:3].T

    before = np.array([rng.uniform(3, 5), rng.uniform(-1, 1), -3.0])
    after = before * [0.8, 0.8, -0.9]
    t = np.arange(90) / 150 + rng.random() / 150
    at = 0.3
    q = np.zeros((90, 3))
    late = t >= at
    backwards = flown_backwards(before, air, at - t[~late][::-1])
    q[~late] = backwards[::-1]
    q[late] = flown(np.append(np.zeros(3), after), t[late] - at)
    options: dict[str, Any] = {"acceleration": air if known else [0, 0, -G]}
    seen = q + 5e-4 * rng.normal(size=q.shape)
    return Recording(t, seen, options, np.array([at]), before[None], after[None])


def flown_backwards(
    v: np.ndarray, air: Callable[[np.ndarray], np.ndarray], times: np.ndarray
) -> np.ndarray:
    """Places so long before a body passes 0 with a velocity."""
    path = solve_ivp(
        lambda _, x: -np.append(x[3:], air(x[3:])), (0, times[-1]), np.append(np.zeros(3), v),
        t_eval=times, rtol=1e-10, atol=1e-12,
    )  # fmt: skip
    return path.y[:3].T


SETTINGS: dict[str, Callable[[np.random.Generator], Recording]] = {
    "nothing: a ball, 120 frames a second": ball,
    "two gliders, 500 Hz, 20 um": lambda rng: gliders(rng, 500, 2e-5),
    "the same, table not level": lambda rng: gliders(rng, 500, 2e-5, slope=0.02),
    "the same, lens of .15 mm": lambda rng: gliders(rng, 500, 2e-5, waves=1.5e-4),
    "the same, lens of .3 mm": lambda rng: gliders(rng, 500, 2e-5, waves=3e-4),
    "the same, both": lambda rng: gliders(rng, 500, 2e-5, slope=0.02, waves=1.5e-4),
    "the same, both, and a wobble of .05 mm": lambda rng: gliders(
        rng, 500, 2e-5, slope=0.02, waves=1.5e-4, wobble=5e-5
    ),
    "pupils' gliders, 25 Hz, 1 mm, not level": lambda rng: gliders(
        rng, 25, 1e-3, slope=0.02
    ),
    "6 frames lost at the impact": lambda rng: hidden(rng, 6),
    "12 frames lost": lambda rng: hidden(rng, 12),
    "20 frames lost": lambda rng: hidden(rng, 20),
    "times err by .2 ms": lambda rng: jittered(rng, 2e-4),
    "times err by 1 ms": lambda rng: jittered(rng, 1e-3),
    "a phone, 40 to 60 frames a second": phone,
    "a coordinate without noise": exact,
    "in pixels of 1 mm": lambda rng: rounded(rng, 1e-3),
    "in pixels of 4 mm": lambda rng: rounded(rng, 4e-3),
    "drag and spin, known": lambda rng: spinning(rng, True),
    "drag and spin, not known": lambda rng: spinning(rng, False),
    "30 frames a second, gravity unknown": lambda rng: ball(rng, 30)._replace(
        options={"acceleration": None}
    ),
}


class Count(NamedTuple):
    """Of one track: impacts found, lost, false and doubtful, and z (.., 2n) of those found."""

    found: int
    lost: int
    false: int
    doubtful: int
    z: list[np.ndarray]
    warned: bool


def counted(one: Recording) -> Count:
    """What is found in a recording; z are the errors of (v-, v+) in the stated ones."""
    track = ji.tracks.find_impacts(one.t, one.q, **one.options)
    near = max(NEAR, 2.5 * float(np.median(np.diff(one.t))))
    seen = one.t[np.isfinite(one.q).all(axis=1)]
    taken: set[int] = set()
    z = []
    for at, before, after in zip(one.instants, one.before, one.after):
        gap = np.diff(seen)[np.clip(np.searchsorted(seen, at) - 1, 0, len(seen) - 2)]
        apart = [abs(impact.time - at) for impact in track.impacts]
        if not apart or min(apart) > near + gap:
            continue
        k = int(np.argmin(apart))
        taken.add(k)
        impact = track.impacts[k]
        error = np.concatenate([impact.pre - before, impact.post - after])
        z.append(error / np.sqrt(np.diag(impact.covariance)))
    others = [impact for k, impact in enumerate(track.impacts) if k not in taken]
    doubtful = sum(impact.doubtful for impact in others)
    lost = len(one.instants) - len(taken)
    return Count(
        len(taken), lost, len(others) - doubtful, doubtful, z, bool(track.warnings)
    )


def row(name: str, count: int) -> str:
    """A line of the table."""
    rng, made, begun = (
        np.random.default_rng(len(name)),
        SETTINGS[name],
        time.process_time(),
    )
    counts = [counted(made(rng)) for _ in range(count)]
    took = (time.process_time() - begun) / count
    z = np.array([x for each in counts for x in each.z])
    sums = [sum(each[k] for each in counts) for k in range(4)]
    noisy = (np.abs(z) > EXACT).any(axis=0)
    moving = z[:, noisy]
    bias = moving.mean(axis=0)
    cells = [
        f"{sums[0]}", f"{sums[1]}", f"{sums[2]}", f"{sums[3]}",
        f"{bias[np.abs(bias).argmax()]:+.2f}", f"{np.sqrt(np.mean(moving**2)):.2f}",
        f"{np.mean(np.abs(moving) < 1.96):.3f}",
        f"{100 * np.mean([each.warned for each in counts]):.0f} %", f"{1000 * took:.0f}",
    ]  # fmt: skip
    return f"| {name} | {' | '.join(cells)} |"


def main(count: int) -> None:
    """Print the table."""
    print(f"{count} tracks a setting; false: not doubtful; errors in the stated ones")
    heads = (
        "found",
        "lost",
        "false",
        "doubtful",
        "bias",
        "scatter",
        "within 95 %",
        "told",
        "ms",
    )
    print(f"| recording | {' | '.join(heads)} |")
    print(f"|{'---|' * (len(heads) + 1)}")
    for name in SETTINGS:
        print(row(name, count), flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 200)
