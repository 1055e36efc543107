"""Cost against length of a Hertz chain struck at its end: `python tests/benchmarks/long_chains.py`.

N equal balls, the first at unit speed, LZB at rtol 1e-6, one impact at a time. At e = 1 a solitary
wave of about five contacts runs through; at e = 0.9 a cluster of loaded contacts forms behind it.
`loaded` is the number of loaded contacts, averaged over the duration of the impact; memory is what
the compiled program asks for (temporaries, arguments, results). What would take more than a minute
is skipped, and said to be.
"""

import time

from harness import arguments, quartiles, save_figure, show, stage, timed, write_csv

import jax  # isort: skip
import jax.numpy as jnp
import numpy as np

import jimpact as ji
from jimpact.methods.schemes import aligned
from jimpact.numerics.tableaux import DOP853

LENGTHS = (10, 30, 100, 300, 1000)
RESTITUTIONS = (1.0, 0.9)
RTOL = 1e-6
LIMIT = 60.0  # seconds one impact may take
BUDGET = 150.0  # seconds after which no longer chain is begun
LONG, REPEATS = 3.0, 5  # an impact that takes longer than LONG seconds is not repeated
STEEP = 2.5  # exponent assumed until two lengths are measured
FIT_FROM = 30  # lengths below are start-up
LOADED = 1e-6  # of the largest force
RECORDED = 4_000_000  # passes times contacts that a history may record
AIMS = {1.0: 1.3}


def struck(n):
    return ji.chain(jnp.ones(n)), jnp.zeros(n).at[0].set(1.0)


def compiled_impact(n):
    """The compiled impact with e as argument, seconds to compile it, and its memory [MB]."""
    scene, v = struck(n)
    start = time.perf_counter()
    run = jax.jit(lambda e, v: ji.impact(ji.LZB(e, 1.0, 1.5, rtol=RTOL), scene, v))
    run = run.lower(jnp.asarray(1.0), v).compile()
    seconds, need = time.perf_counter() - start, run.memory_analysis()
    sizes = ("temp", "argument", "output")
    bytes_needed = sum(getattr(need, f"{name}_size_in_bytes") for name in sizes)
    return (lambda e: run(jnp.asarray(e), v)), seconds, bytes_needed / 2**20


def counted(n):
    """Passes of the integrator, with e as argument."""
    scene, v = struck(n)

    def passes(e):
        law = ji.LZB(e, 1.0, 1.5, rtol=RTOL)
        return aligned(law, scene, v, RTOL).evaluations / len(DOP853.c)

    return jax.jit(passes)


def mean_loaded(n, e, passes):
    """Loaded contacts, averaged over impact time; NaN where the history would be too large."""
    if not passes * n <= RECORDED:
        return float("nan")
    force = ji.history(ji.LZB(e, 1.0, 1.5, rtol=RTOL), *struck(n), samples=400).force
    return float(jnp.mean(jnp.sum(force > LOADED * jnp.max(force), axis=1)))


def measured(n, e, run, seconds, memory, count):
    times = [timed(lambda: run(e))]
    while len(times) < REPEATS and times[0][0] < LONG:
        times.append(timed(lambda: run(e)))
    low, middle, high = quartiles([wall for wall, _, _ in times])
    status = ji.STATUS[int(times[-1][2].status)].name
    passes = float(count(jnp.asarray(e))) if status != "max_steps" else float("nan")
    return {
        "e": e,
        "N": n,
        "seconds_q1": low,
        "seconds": middle,
        "seconds_q3": high,
        "cpu_seconds": float(np.median([cpu for _, cpu, _ in times])),
        "passes": passes,
        "us_per_pass": middle / passes * 1e6,
        "loaded": mean_loaded(n, e, passes),
        "memory_MB": memory,
        "compile_seconds": seconds,
        "status": status,
    }


def expected(rows, n):
    """Seconds that length n will take, extrapolated from the shorter ones."""
    if not rows:
        return 0.0
    steepness = STEEP
    if len(rows) > 1:
        a, b = rows[-2], rows[-1]
        steepness = max(
            1.0, np.log(b["seconds"] / a["seconds"]) / np.log(b["N"] / a["N"])
        )
    return rows[-1]["seconds"] * (n / rows[-1]["N"]) ** steepness


def all_lengths(lengths):
    kept, begun = {e: [] for e in RESTITUTIONS}, time.perf_counter()
    for n in lengths:
        left = min(LIMIT, BUDGET - (time.perf_counter() - begun))
        wanted = [e for e in RESTITUTIONS if expected(kept[e], n) <= left]
        for e in sorted(set(RESTITUTIONS) - set(wanted)):
            expectation = (
                f"about {expected(kept[e], n):.0f} s an impact, {left:.0f} s left"
            )
            print(f"skipped: N = {n}, e = {e}: {expectation}")
        if not wanted:
            continue
        with stage(f"N = {n}: compiling"):
            program, count = compiled_impact(n), counted(n)
        for e in wanted:
            with stage(f"N = {n}, e = {e}"):
                kept[e].append(measured(n, e, *program, count))
    return kept


def exponent_of(rows, key):
    """Slope of log(key) against log(N) of the impacts that ended; NaN with fewer than two."""
    long = [
        row for row in rows if row["N"] >= FIT_FROM and row["status"] != "max_steps"
    ]
    if len(long) < 2:
        return float("nan")
    return float(
        np.polyfit(np.log([r["N"] for r in long]), np.log([r[key] for r in long]), 1)[0]
    )


def chart(kept, path):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, all_axes = plt.subplots(1, 3, figsize=(10, 3.4), layout="constrained")
    labels = {
        "seconds": "time of one impact [s]",
        "passes": "passes",
        "memory_MB": "memory [MB]",
    }
    for axes, (key, label) in zip(all_axes, labels.items()):
        for e, rows in kept.items():
            slope = exponent_of(rows, key)
            lengths, values = [r["N"] for r in rows], [r[key] for r in rows]
            axes.loglog(lengths, values, "o-", label=f"e = {e}: ~ N^{slope:.2f}")
        axes.set_xlabel("balls N")
        axes.set_ylabel(label)
        axes.legend(fontsize=8)
    figure.suptitle("Hertz chain struck at its end, LZB at rtol 1e-6", fontsize=10)
    save_figure(figure, path)


def main():
    options = arguments(__doc__)
    kept = all_lengths((4, 8) if options.quick else LENGTHS)
    rows = []
    for e, part in kept.items():
        slopes = {
            f"{key}_exponent": exponent_of(part, key) for key in ("seconds", "passes")
        }
        rows += [row | slopes for row in part]
        aim = f"; aim: <= {AIMS[e]}" if e in AIMS else ""
        print(
            f"e = {e}: time ~ N^{slopes['seconds_exponent']:.2f}{aim}; "
            f"passes ~ N^{slopes['passes_exponent']:.2f}, memory ~ "
            f"N^{exponent_of(part, 'memory_MB'):.2f} (N >= {FIT_FROM})"
        )
    keys = (
        "e N seconds_q1 seconds seconds_q3 passes us_per_pass loaded memory_MB status"
    )
    show("one Hertz chain, struck at its end", rows, keys.split())
    write_csv(options.out / "long_chains.csv", rows)
    chart(kept, options.out / "long_chains.png")


if __name__ == "__main__":
    main()
