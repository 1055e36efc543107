"""Three-ball Hertz impacts at equal true error: `python tests/benchmarks/three_balls.py`.

A batch of LZB impacts (masses 1, v- = (1, 0, 0), e = 0.9, k2 / k1 log-uniform in [0.1, 10]) by
jimpact as it is used, `jit(vmap(impact))`, beside hand-written C++, diffrax, numba and Siconos.
Each method runs at its loosest setting whose largest error of v+ over the batch, against a run at
rtol 1e-13, reaches the target. Alternating repeats, medians with quartiles, compile time apart.
`cpu_us` [µs] is processor time of all threads: C++, numba and XLA's loops each use one core here.
"""

import os
from functools import partial

from harness import (
    alternating,
    arguments,
    columns,
    loosest,
    save_figure,
    show,
    stage,
    write_csv,
)

import jax  # isort: skip
import jax.numpy as jnp
import numpy as np
from kernels import compiled, diffrax_event, siconos

import jimpact as ji
from jimpact import velocity_change
from jimpact.methods.schemes import aligned
from jimpact.numerics.tableaux import DOP853

BATCH, CHUNK, REPEATS = 4096, 256, 11
TRUTH, FINE, COARSE = 1e-13, 3e-8, 1e-6
AT_MOST = {"C++": 1.5}  # aims: jimpact / C++ at most, the others / jimpact at least
AT_LEAST = {
    "diffrax Dopri8": 20.0,
    "numba RK4": 3.0,
    "numba Verlet": 3.0,
    "Siconos": 1000.0,
}


SCENE, V = ji.chain(jnp.ones(3)), jnp.array([1.0, 0.0, 0.0])


def problem(batch):
    """Stiffness (B, 2) and restitution (B, 2)."""
    stiffness = np.ones((batch, 2))
    stiffness[:, 1] = 10 ** np.random.default_rng(0).uniform(-1, 1, batch)
    return stiffness, np.full((batch, 2), 0.9)


def law_of(k, e, rtol=None):
    return ji.LZB(e, k, 1.5, rtol=rtol)


def one_impact(k, e, rtol):
    return ji.impact(law_of(k, e, rtol), SCENE, V).velocity


def at_any_rtol(k, e, rtol):
    """The same v+ and the passes of the integrator, compiled once for all tolerances."""
    result = aligned(law_of(k, e), SCENE, V, rtol)
    return V + velocity_change(SCENE, result.impulse), result.evaluations / len(
        DOP853.c
    )


def jimpact(rtol, chunk=None):
    """`run(k, e)`; `chunk`: so many impacts at a time, which wait for the slowest of them only."""
    one = partial(one_impact, rtol=rtol)
    if chunk is None:
        return jax.jit(jax.vmap(one))
    return jax.jit(
        lambda k, e: jax.lax.map(lambda x: one(*x), (k, e), batch_size=chunk)
    )


def steps(first, last, per_decade):
    """Geometric grid, loose to fine."""
    count = round(per_decade * np.log10(first / last)) + 1
    return [float(f"{x:.2g}") for x in np.geomspace(first, last, count)]


class Bench:
    """The methods on one batch, each tuned to a target."""

    def __init__(self, batch):
        self.k, self.e = problem(batch)
        self.device = jnp.asarray(self.k), jnp.asarray(self.e)
        self.any_rtol = jax.jit(jax.vmap(at_any_rtol, in_axes=(0, 0, None)))
        with stage("reference at rtol 1e-13"):
            self.exact = np.asarray(self.any_rtol(*self.device, TRUTH)[0])

    def error(self, velocity):
        difference = np.abs(np.asarray(velocity) - self.exact)
        return float(difference.max()), float(np.sqrt(np.mean(difference**2)))

    def row(self, name, run, setting, target):
        """A row to be timed: `run()` gives v+ (B, 3)."""
        largest, rms = self.error(run())
        entry = {"method": name, "target": target, "setting": setting}
        return entry | {"error_max": largest, "error_rms": rms, "run": run}

    def tuned(self, name, method, grid, target):
        """The same at the loosest setting of `method(setting)` that reaches the target."""
        with stage(f"tuning {name} to {target:.0e}"):
            setting, _ = loosest(lambda s: self.error(method(s))[0], grid, target)
        return self.row(name, partial(method, setting), setting, target)

    def ours(self, target, grid, chunk=None):
        """jimpact's row, with the passes that an impact takes and the slowest one takes."""
        rtol = grid[0]
        if len(grid) > 1:
            with stage(f"tuning jimpact to {target:.0e}"):
                tried = lambda r: self.error(self.any_rtol(*self.device, r)[0])[0]  # noqa: E731
                rtol, _ = loosest(tried, grid, target)
        with stage(f"compiling jimpact at rtol {rtol:.1e}"):
            run = jimpact(rtol, chunk)
            name = "jimpact" if chunk is None else f"jimpact, {chunk} at a time"
            row = self.row(name, lambda: run(*self.device), rtol, target)
        passes = self.any_rtol(*self.device, rtol)[1]
        return row | {"passes": float(passes.mean()), "passes_max": float(passes.max())}


def rows_of(bench):
    """Every method at every target."""
    rows = [bench.ours("default", [1e-8]), bench.ours(FINE, steps(1e-6, 1e-10, 8))]
    rows.append(bench.ours(FINE, [rows[1]["setting"]], CHUNK))
    at_coarse = [bench.ours(COARSE, steps(1e-4, 1e-8, 8))]
    if (c := compiled.three_balls()) is not None:
        for kept, target, grid in (
            (rows, FINE, steps(1e-6, 1e-10, 8)),
            (at_coarse, COARSE, steps(1e-4, 1e-8, 8)),
        ):
            row = bench.tuned("C++", lambda r: c(bench.k, bench.e, r)[0], grid, target)
            kept.append(row | {"passes": c(bench.k, bench.e, row["setting"])[1]})
    dopri8 = diffrax_event.dopri8()
    solve = lambda r: dopri8(*bench.device, r)  # noqa: E731
    rows.append(bench.tuned("diffrax Dopri8", solve, steps(1e-9, 1e-12, 8), FINE))
    try:
        from kernels import numba_loops
    except ImportError:
        print("skipped: numba is not installed")
        return rows + at_coarse
    for name, run in (
        ("numba RK4", numba_loops.rk4),
        (f"numba RK4, {os.cpu_count()} threads", numba_loops.rk4_threads),
        ("numba Verlet", numba_loops.verlet),
    ):
        loop = lambda h, run=run: run(bench.k, bench.e, h)  # noqa: E731
        at_coarse.append(bench.tuned(name, loop, steps(0.1, 1e-4, 12), COARSE))
    return rows + at_coarse


def measured(rows, batch, repeats):
    """Rows with their times, and ratios to jimpact at the same target."""
    runs = {(row["method"], row["target"]): row.pop("run") for row in rows}
    with stage(f"timing {len(runs)} runs, {repeats} repeats"):
        times = alternating(runs, repeats)
    for row in rows:
        base = times.get(("jimpact", row["target"]))
        row |= columns(times[row["method"], row["target"]], batch, base)
    return rows


def with_siconos(rows, bench, quick):
    """Siconos solves a few impacts one by one: seconds each, at its own largest error."""
    with stage("Siconos 4.4"):
        row = siconos.row(bench.k, bench.exact, quick)
    if row is None:
        return rows
    base = next(r for r in rows if r["method"] == "jimpact" and r["target"] == COARSE)
    return [*rows, row | {"target": COARSE, "ratio": row["us"] / base["us"]}]


def verdicts(rows):
    """What was aimed at beside what was measured."""
    for row in rows:
        name, ratio = row["method"], row.get("ratio")
        spread = [row.get(key, ratio) for key in ("ratio_q1", "ratio_q3")]
        if name in AT_MOST and row["target"] == FINE:
            spread = f"{1 / spread[1]:.1f} .. {1 / spread[0]:.1f}"
            print(
                f"jimpact / {name}: {1 / ratio:.2f} ({spread}); aim: <= {AT_MOST[name]}"
            )
        elif name in AT_LEAST:
            spread = f"{spread[0]:.1f} .. {spread[1]:.1f}"
            print(f"{name} / jimpact: {ratio:.1f} ({spread}); aim: >= {AT_LEAST[name]}")


def chart(rows, path):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(
        figsize=(8, 0.42 * len(rows) + 1.2), layout="constrained"
    )
    labels = [f"{row['method']} at {row['error_max']:.0e}" for row in rows]
    middle = np.array([row["us"] for row in rows])
    low, high = (
        np.array([row.get(key, row["us"]) for row in rows])
        for key in ("us_q1", "us_q3")
    )
    colours = ["C0" if row["method"].startswith("jimpact") else "C7" for row in rows]
    axes.barh(
        labels, middle, xerr=[middle - low, high - middle], color=colours, capsize=3
    )
    for place, value in enumerate(middle):
        axes.annotate(f" {value:.3g}", (value, place), va="center", xytext=(8, 0), textcoords="offset points")  # fmt: skip
    axes.set_xscale("log")
    axes.set_xlim(middle.min() / 2, middle.max() * 4)
    axes.invert_yaxis()
    axes.set_xlabel("time per impact [us], median and quartiles")
    axes.set_title(
        "Three Hertz balls, LZB, e = 0.9: largest error of v+ over the batch",
        fontsize=10,
    )
    save_figure(figure, path)


def main():
    options = arguments(__doc__)
    batch, repeats = (32, 2) if options.quick else (BATCH, REPEATS)
    bench = Bench(batch)
    rows = measured(rows_of(bench), batch, repeats)
    rows = with_siconos(rows, bench, options.quick)
    rows = [{"batch": batch, **row} for row in rows]
    keys = (
        "method target setting error_max passes us_q1 us us_q3 cpu_us ratio ratio_cpu"
    )
    show(
        f"{batch} three-ball impacts, ratios to jimpact at the same target",
        rows,
        keys.split(),
    )
    verdicts(rows)
    write_csv(options.out / "three_balls.csv", rows)
    chart(rows, options.out / "three_balls.png")


if __name__ == "__main__":
    main()
