"""Whether a batch of motions waits for its slowest: `python tests/benchmarks/batches_of_motions.py`.

Motions of one system from random heights have as many events as it happens. Their CPU times: one
after the other, the slowest by itself, all in one batch, and 32 at a time (`jax.lax.map`). Medians
of alternating repeats, compilation apart.
"""

from harness import alternating, arguments, columns, show, write_csv

import jax  # isort: skip
import numpy as np

import jimpact as ji

jax.config.update("jax_enable_x64", True)

BATCH, REPEATS = 256, 5
QUICK_BATCH, QUICK_REPEATS = 8, 2
LANES = 32  # of `fit_motion`, as docs/motions.md says
MAX_EVENTS = 100
SEED = 0


def ball(height):
    """A ball dropped from a height (1,) [m], for two seconds."""
    falls = ji.System(ji.Column([1.0]), gravity=True)
    return ji.simulate(
        falls, ji.Newton(0.8), height, [0.0], 2.0, samples=11, max_events=MAX_EVENTS
    )


def column(heights):
    """Three balls above each other, dropped from heights (3,) [m], for a second."""
    falls = ji.System(ji.Column([1.0] * 3), gravity=True)
    rest = np.zeros(3)
    return ji.simulate(
        falls, ji.LZB(0.8), heights, rest, 1.0, samples=11, max_events=MAX_EVENTS
    )


def block(angle):
    """A block released on one corner at an angle (1,) [rad], for four seconds."""
    half_width, half_height = 0.15, 0.45
    lowest_corner = half_width * jax.numpy.sin(angle[0]) + half_height * jax.numpy.cos(
        angle[0]
    )
    q0 = jax.numpy.stack([0.0, lowest_corner, angle[0]])
    rocks = ji.System(ji.Block(2 * half_width, 2 * half_height), gravity=True)
    return ji.simulate(
        rocks, ji.Moreau(0.0), q0, [0.0] * 3, 4.0, samples=11, max_events=MAX_EVENTS
    )


def main():
    options = arguments(__doc__)
    count, repeats = (QUICK_BATCH, QUICK_REPEATS) if options.quick else (BATCH, REPEATS)
    random = np.random.default_rng(SEED)
    starts = {
        ball: random.uniform(0.2, 2.0, (count, 1)),
        column: np.cumsum(random.uniform(0.05, 1.0, (count, 3)), axis=1),
        block: random.uniform(0.02, 0.28, (count, 1)),
    }
    rows = []
    for motion, start in starts.items():
        single = jax.jit(motion)
        batch = jax.jit(jax.vmap(motion))
        in_lanes = jax.jit(lambda q, f=motion: jax.lax.map(f, q, batch_size=LANES))
        steps = np.asarray(batch(start).steps)
        slowest = start[np.argmax(steps)]
        runs = {
            "one after the other": lambda f=single, q=start: [f(one).q for one in q],
            "the slowest alone": lambda f=single, q=slowest: f(q).q,
            f"batch of {count}": lambda f=batch, q=start: f(q).q,
            f"{LANES} at a time": lambda f=in_lanes, q=start: f(q).q,
        }
        spread = f"{steps.min()} to {steps.max()}, mean {steps.mean():.0f}"
        rows += [
            {"motion": motion.__name__, "steps": spread, "what": what}
            | columns(timing, count)
            for what, timing in alternating(runs, repeats).items()
        ]
    show(
        f"CPU time over {count} motions",
        rows,
        ("motion", "steps", "what", "us", "cpu_us"),
    )
    write_csv(options.out / "batches_of_motions.csv", rows)


if __name__ == "__main__":
    main()
