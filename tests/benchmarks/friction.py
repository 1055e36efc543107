"""What friction costs: impacts with it beside the same without: `python tests/benchmarks/friction.py`.

A block that falls on both corners, at random velocities and friction, Hertz contacts, default
tolerance; and single contacts of a rod. Batches, medians of alternating repeats, compilation apart.
"""

from harness import alternating, arguments, columns, show, write_csv

import jax  # isort: skip
import jax.numpy as jnp
import numpy as np

import jimpact as ji
from jimpact.tools.status import CODE

jax.config.update("jax_enable_x64", True)

BATCH, REPEATS = 1024, 7
QUICK_BATCH, QUICK_REPEATS = 16, 2
E = 0.8


def inputs(batch):
    """v- (B, 3) in which both corners approach, and mu (B,)."""
    rng = np.random.default_rng(0)
    v = rng.normal(size=(batch, 3)) * [1.0, 0.2, 0.5] - [0.0, 1.0, 0.0]
    return jnp.asarray(v), jnp.asarray(rng.uniform(0.05, 1.0, batch))


def laws():
    """name -> (v, mu) -> impact."""
    block = ji.Block(1.0, 1.5, corners="base").scene()
    rod = ji.Scene(block.mass, block.normals[:, :1], tangents=block.tangents[:, :1])
    runs = {}
    for name, scene in (("block", block), ("rod", rod)):
        runs[name, "none"] = lambda v, mu, s=scene: ji.impact(ji.LZB(E), s, v)
        runs[name, "LZB"] = lambda v, mu, s=scene: ji.impact(
            ji.LZB(E, friction=mu), s, v
        )
    runs["block", "Moreau"] = lambda v, mu: ji.impact(
        ji.Moreau(E, friction=mu), block, v
    )
    return runs


def main():
    options = arguments(__doc__)
    batch, repeats = (QUICK_BATCH, QUICK_REPEATS) if options.quick else (BATCH, REPEATS)
    v, mu = inputs(batch)
    programs = {key: jax.jit(jax.vmap(law)) for key, law in laws().items()}
    timings = alternating(
        {key: lambda f=f: f(v, mu) for key, f in programs.items()}, repeats
    )
    rows = []
    for (scene, law), timing in timings.items():
        failed = int(
            (
                np.asarray(programs[scene, law](v, mu).status) >= CODE["energy_gain"]
            ).sum()
        )
        row = {"scene": scene, "friction": law, "failed": failed}
        rows.append(row | columns(timing, batch, timings[scene, "none"]))
    keys = (
        "scene",
        "friction",
        "us",
        "us_q1",
        "us_q3",
        "ratio_q1",
        "ratio",
        "ratio_q3",
        "failed",
    )
    show(f"Cost of friction, {batch} impacts, ratio to the frictionless", rows, keys)
    write_csv(options.out / "friction.csv", rows)


if __name__ == "__main__":
    main()
