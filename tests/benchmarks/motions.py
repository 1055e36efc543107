"""What motions cost, an event: `python tests/benchmarks/motions.py`.

A bouncing ball and a rocking block, one and a batch, and the gradient of one. Medians of
alternating repeats, compilation apart. Aims in a batch: the ball 26 µs, the block 100 µs.
"""

from harness import alternating, arguments, columns, show, write_csv

import jax  # isort: skip
import jax.numpy as jnp
import numpy as np

import jimpact as ji

jax.config.update("jax_enable_x64", True)

BATCH, REPEATS = 200, 7
QUICK_BATCH, QUICK_REPEATS = 2, 2
AIMS = {"ball": 26.0, "block": 100.0}


def ball(e):
    """Dropped from 1 m, to rest."""
    start = (ji.System(ji.Column([1.0]), gravity=True), ji.Newton(e), [1.0], [0.0], 9.0)
    return ji.simulate(*start, samples=11, max_events=200)


def block(e):
    """Released tilted, rocks to rest."""
    law = ji.RestitutionMatrix(ji.theory.rocking_matrix(e))
    q0 = [0.0, 0.1 * np.sin(0.15) + 0.3 * np.cos(0.15), 0.15]
    rocks = ji.System(ji.Block(0.2, 0.6, corners="base"), gravity=True, friction=5.0)
    return ji.simulate(rocks, law, q0, [0.0] * 3, 4.0, samples=11, max_events=200)


def main():
    options = arguments(__doc__)
    batch, repeats = (QUICK_BATCH, QUICK_REPEATS) if options.quick else (BATCH, REPEATS)
    e, one, runs, events = np.linspace(0.85, 0.9, batch), jnp.asarray(0.85), {}, {}
    for name, motion in (("ball", ball), ("block", block)):
        many, single = jax.jit(jax.vmap(motion)), jax.jit(motion)
        slope = jax.jit(jax.grad(lambda e, f=motion: f(e).contact_work[-1].sum()))
        runs[name, "batch"] = lambda f=many: f(e).events.count
        runs[name, "one"] = lambda f=single: f(one).events.count
        runs[name, "gradient"] = lambda f=slope: f(one)
        ji.raise_on_failure(many(e))
        events[name, "batch"] = int(many(e).events.count.sum())
        events[name, "one"] = events[name, "gradient"] = int(single(one).events.count)
    timings = alternating(runs, repeats)
    rows = [
        {"motion": key[0], "what": key[1], "events": events[key]}
        | columns(timing, events[key])
        for key, timing in timings.items()
    ]
    show(
        f"An event of a motion; batches of {batch}",
        rows,
        ("motion", "what", "events", "us", "cpu_us"),
    )
    for row in rows:
        if row["what"] == "batch":
            print(
                f"aim: {row['motion']}, batch: {row['cpu_us']:.0f} µs, {AIMS[row['motion']]:.0f} aimed at"
            )
    write_csv(options.out / "motions.csv", rows)


if __name__ == "__main__":
    main()
