"""Batches on an accelerator, or on the CPU: `python tests/benchmarks/gpu.py [PART ..]`.

Each row is one program that is called with a batch: seconds of its first call (compiling and one
run), time of one impact (median of the repeats, arguments already on the device), and for chains
the largest error of v+ against the same impacts in double precision at the finest tolerance. Where
no GPU is at hand the script runs on the CPU, and `device` in each row says so. `--largest` bounds
the batches.
"""

import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

from harness import arguments, quartiles, show, stage, timed, write_csv

import jax  # isort: skip
import jax.numpy as jnp
import numpy as np

import jimpact as ji

REPEATS = 5
LARGEST = 1 << 23  # impacts
LARGEST_JACOBIAN = 1 << 20
CHECKED = 256  # impacts of a batch that are compared with the finest tolerance
FINEST = 1e-13

COLUMNS = (
    "name",
    "precision",
    "batch",
    "first_s",
    "ns_each",
    "error",
    "failed",
    "device",
)


def row(
    name: str, precision: str, batch: int, run: Callable[[], Any], exact: Any = None
) -> dict[str, Any]:
    """Times of one program; `run()` gives (v+ (batch, n), status (batch,)), or anything else."""
    with stage(f"{name} {precision} {batch}"):
        first, _, out = timed(run)
        wall = [timed(run)[0] for _ in range(REPEATS)]
    entries = {
        "name": name,
        "precision": precision,
        "batch": batch,
        "first_s": first,
        "ns_each": quartiles(wall)[1] / batch * 1e9,
        "device": jax.devices()[0].device_kind,
    }
    if isinstance(out, tuple):
        failures = jnp.asarray([status.failure for status in ji.STATUS])
        entries["failed"] = int(failures[out[1]].sum())
        if exact is not None:
            entries["error"] = float(
                np.abs(np.asarray(out[0][:CHECKED], float) - exact).max()
            )
    return entries


def sizes(largest: int, *wanted: int) -> list[int]:
    """Sizes of batches, none larger than allowed."""
    return sorted({min(size, largest) for size in wanted})


def stiffnesses(batch: int, contacts: int, dtype: str) -> jax.Array:
    """Ratios from 1/10 to 10, the first contact 1."""
    k = 10 ** np.random.default_rng(0).uniform(-1, 1, (batch, contacts))
    return jnp.asarray(k / k[:, :1], dtype)


def chain_rows(
    name: str,
    scene: ji.Scene,
    make: Callable[..., Any],
    batches: list[int],
    derivative: bool,
) -> Iterator[dict[str, Any]]:
    """A chain that its first ball strikes: values in both precisions, Jacobians in double."""
    count = scene.contacts

    def impact(k: jax.Array, scene: ji.Scene, **options: Any) -> Any:
        v = jnp.zeros(scene.mass.shape[0], k.dtype).at[0].set(1.0)
        out = ji.impact(make(k, **options), scene, v)
        return out.velocity, out.status

    few = stiffnesses(batches[-1], count, "float64")[:CHECKED]
    reference = jax.vmap(lambda k: impact(k, scene, rtol=FINEST))(few)
    exact = np.asarray(reference[0])
    for precision in ("float64", "float32"):
        at = jax.tree.map(lambda x, p=precision: x.astype(p), scene)
        run = jax.jit(jax.vmap(lambda k, at=at: impact(k, at)))
        for batch in batches:
            # the same first impacts in every batch
            k = jnp.resize(stiffnesses(batches[-1], count, precision), (batch, count))
            yield row(name, precision, batch, lambda k=k, run=run: run(k), exact)
    if not derivative:
        return
    slope = jax.jit(jax.vmap(jax.jacfwd(lambda k: impact(k, scene)[0])))
    for batch in batches:
        if batch > LARGEST_JACOBIAN:
            continue
        k = stiffnesses(batch, count, "float64")
        yield row(f"{name}, Jacobian", "float64", batch, lambda k=k: slope(k))


def chains(largest: int) -> Iterator[dict[str, Any]]:
    """Chains of balls: LZB with Hertz contacts, and Moreau's law."""

    def lzb(e: float) -> Callable[..., Any]:
        return lambda k, **options: ji.LZB(jnp.asarray(e, k.dtype), k, 1.5, **options)

    three, ten = ji.chain(jnp.ones(3)), ji.chain(jnp.ones(10))
    wall = ji.chain(jnp.ones(10), wall=True)
    many = sizes(largest, 1 << 10, 1 << 12, 1 << 20, 1 << 23)
    few = sizes(largest, 1 << 16)
    yield from chain_rows("three balls, LZB(1)", three, lzb(1.0), many, True)
    yield from chain_rows("ten balls, LZB(.9)", ten, lzb(0.9), few, True)
    yield from chain_rows("ten balls and a wall, LZB(.9)", wall, lzb(0.9), few, False)
    v = jnp.zeros(10).at[0].set(1.0)

    def moreau(e: jax.Array) -> Any:
        out = ji.impact(ji.Moreau(e), ten, v)
        return out.velocity, out.status

    run = jax.jit(jax.vmap(moreau))
    for batch in few:
        e = jnp.linspace(0.0, 1.0, batch)
        yield row("ten balls, Moreau", "float64", batch, lambda e=e: run(e))


def dense(largest: int) -> Iterator[dict[str, Any]]:
    """Three contacts of a body with a full mass matrix: single precision beside double."""
    rng = np.random.default_rng(3)
    root = rng.normal(size=(4, 4))
    mass, normals = root @ root.T + np.eye(4), rng.normal(size=(4, 3))
    v = rng.normal(size=(min(largest, 1 << 12), 4))
    v -= np.maximum(v @ normals, 0.0) @ np.linalg.pinv(normals)  # all contacts approach
    laws = {
        "Newton": lambda e: ji.Newton(e),
        "Moreau": lambda e: ji.Moreau(e),
        "Binary": lambda e: ji.Binary(e),
        "RestitutionMatrix": lambda e: ji.RestitutionMatrix(
            e * jnp.eye(3, dtype=e.dtype)
        ),
        "LZB": lambda e: ji.LZB(e, jnp.ones(3, e.dtype), 1.5),
    }

    def impacts(make: Callable[..., Any], dtype: str) -> Any:
        scene = ji.Scene(jnp.asarray(mass, dtype), jnp.asarray(normals, dtype))

        def impact(v: jax.Array) -> Any:
            out = ji.impact(make(jnp.asarray(0.7, dtype)), scene, v)
            return out.velocity, out.status

        return jax.jit(jax.vmap(impact)), jnp.asarray(v, dtype)

    for name, make in laws.items():
        run, exact = impacts(make, "float64")
        found, _ = run(exact)
        for precision in ("float64", "float32"):
            run, at = impacts(make, precision)
            reference = np.asarray(found[:CHECKED])
            yield row(
                f"dense body, {name}", precision, len(v), partial(run, at), reference
            )


def boxes(largest: int) -> Iterator[dict[str, Any]]:
    """A box that falls flat on its four corners, without and with friction, at random velocities."""
    batches = sizes(largest, 1 << 12, 1 << 16)
    scene = ji.Box([0.2, 0.3, 0.1]).scene([0.0, 0.0, 0.05, 1.0, 0.0, 0.0, 0.0])
    v = np.random.default_rng(1).normal(size=(batches[-1], 6)) * 0.1 + [
        0,
        0,
        -1.0,
        0,
        0,
        0,
    ]
    laws = {
        "box on four corners, LZB(.8)": (ji.LZB(0.8, 1.0, 1.5), 1 << 16),
        "box on four corners, Moreau(.5, mu=.3)": (
            ji.Moreau(0.5, friction=0.3),
            1 << 12,
        ),
        "box on four corners, LZB(.8, mu=.3)": (
            ji.LZB(0.8, 1.0, 1.5, friction=0.3),
            1 << 12,
        ),
    }
    for name, (law, most) in laws.items():

        def impact(v: jax.Array, law: Any = law) -> Any:
            out = ji.impact(law, scene, v)
            return out.velocity, out.status

        run = jax.jit(jax.vmap(impact))
        for batch in sizes(most, *batches):
            some = jnp.asarray(v[:batch])
            yield row(name, "float64", batch, lambda some=some, run=run: run(some))


def gaps(largest: int) -> Iterator[dict[str, Any]]:
    """Monte Carlo over the gaps of three steel balls."""
    scene = ji.chain([0.067, 0.067, 0.067])
    law, between = ji.Compliant(ji.Hertz(1e10)), ji.Uniform(0.0, 50e-6)
    for samples in sizes(largest, 1 << 12, 1 << 20):

        def run(samples: int = samples) -> Any:
            found = ji.monte_carlo(
                law, scene, [0.5, 0.0, 0.0], gaps=between, samples=samples,
                chunk=min(samples, 1 << 16), key=jax.random.key(0),
            )  # fmt: skip
            return found.mean

        yield row("Monte Carlo over gaps, Hertz", "float64", samples, run)


def fits(largest: int) -> Iterator[dict[str, Any]]:
    """Many fits of (e, k2/k1) to 12 shots of three balls each; `ns_each` is that of one fit."""
    scene = ji.chain([1.0, 2.0, 1.5])
    rng = np.random.default_rng(2)
    pre = np.zeros((12, 3))
    pre[:, 0] = rng.uniform(0.5, 1.5, 12)
    pre[:, 2] = -rng.uniform(0.0, 1.0, 12)
    exact = jax.vmap(
        lambda v: ji.impact(ji.LZB(0.9, [1.0, 3.0], 1.5), scene, v).velocity
    )(pre)
    start = ji.LZB(0.8, [1.0, 1.0], 1.5)
    for sets in sizes(largest // 16, 64, 1024, 8192):
        post = np.asarray(exact) + 0.01 * rng.normal(size=(sets, 12, 3))
        data = [ji.Experiments(pre, each, sigma=0.01) for each in post]

        def run(data: list[Any] = data) -> Any:
            return ji.fit_many(
                start, scene, data, free=("restitution", "stiffness")
            ).value

        yield row("fits of 12 shots, LZB", "float64", sets, run)


def motions(largest: int) -> Iterator[dict[str, Any]]:
    """Blocks that rock until they rest: `ns_each` is that of one motion."""
    block = ji.Block(0.2, 0.6)
    system, law = ji.System(block, gravity=True), ji.LZB(0.9, 1.0, 1.5)

    def rock(tilt: jax.Array) -> Any:
        q = block.touching(tilt)
        motion = ji.simulate(
            system, law, q, jnp.zeros(3), 0.5, samples=3, max_events=100
        )
        return motion.q[-1], motion.status

    run = jax.jit(jax.vmap(rock))
    for batch in sizes(largest, 1 << 10, 1 << 14):
        tilts = jnp.linspace(0.05, 0.25, batch)
        yield row(
            "rocking blocks, .5 s", "float64", batch, lambda tilts=tilts: run(tilts)
        )


PARTS = {
    "dense": dense,
    "chains": chains,
    "boxes": boxes,
    "gaps": gaps,
    "fits": fits,
    "motions": motions,
}


def main() -> None:
    """Print the table, part by part, and write it."""

    def add(parser: Any) -> None:
        parser.add_argument(
            "parts", nargs="*", choices=[*PARTS, []], help="default: all"
        )
        parser.add_argument(
            "--largest", type=int, default=LARGEST, help="impacts of a batch"
        )

    options = arguments(__doc__, add)
    largest = 1 << 6 if options.quick else options.largest
    rows, start = [], time.perf_counter()
    for name in options.parts or PARTS:
        rows += PARTS[name](largest)
        show(f"{name}, {time.perf_counter() - start:.0f} s so far", rows, COLUMNS)
        write_csv(options.out / "gpu.csv", rows)


if __name__ == "__main__":
    main()
