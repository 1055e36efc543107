"""Compliant chains with random gaps beside a fixed-step Verlet loop: `python tests/benchmarks/gapped_chain.py`.

Three Hertz balls, struck at one end, both gaps random, at equal true error (median over the batch
of the largest velocity error against a run at 1e-12). Side by side in one run, medians of
alternating repeats, compile time apart. The Verlet loop is numba, compiled and on all cores.
"""

import os
import time

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

import jimpact as ji  # noqa: E402

try:
    import numba
except ImportError as missing:
    raise SystemExit("this benchmark needs numba: pip install numba") from missing

BATCH, REPEATS = 4096, 7
V = jnp.array([1.0, 0.0, 0.0])


@numba.njit
def _verlet(g1, g2, h, out):
    """Velocity Verlet from touch to the end of the last contact; free flight is skipped."""
    x1, x2 = -g1, -g2  # indentations
    v1, v2, v3 = 1.0, 0.0, 0.0
    steps = 0
    while steps < 100_000_000:
        u1, u2 = v1 - v2, v2 - v3
        if x1 <= 0.0 and x2 <= 0.0:  # flight: to the next closing, exactly
            t1 = -x1 / u1 if u1 > 0.0 else np.inf
            t2 = -x2 / u2 if u2 > 0.0 else np.inf
            t = min(t1, t2)
            if t == np.inf:
                break
            x1 += u1 * t
            x2 += u2 * t
            if t1 <= t2:
                x1 = 1e-300
            if t2 <= t1:
                x2 = 1e-300
        f1 = x1 * np.sqrt(x1) if x1 > 0.0 else 0.0
        f2 = x2 * np.sqrt(x2) if x2 > 0.0 else 0.0
        while x1 > 0.0 or x2 > 0.0:
            v1 -= 0.5 * h * f1
            v2 += 0.5 * h * (f1 - f2)
            v3 += 0.5 * h * f2
            x1 += h * (v1 - v2)
            x2 += h * (v2 - v3)
            f1 = x1 * np.sqrt(x1) if x1 > 0.0 else 0.0
            f2 = x2 * np.sqrt(x2) if x2 > 0.0 else 0.0
            v1 -= 0.5 * h * f1
            v2 += 0.5 * h * (f1 - f2)
            v3 += 0.5 * h * f2
            steps += 1
    out[0], out[1], out[2] = v1, v2, v3


@numba.njit(parallel=True)
def verlet(gaps, h):
    out = np.empty((gaps.shape[0], 3))
    for i in numba.prange(gaps.shape[0]):
        _verlet(gaps[i, 0], gaps[i, 1], h, out[i])
    return out


def ours(rtol):
    def velocity(g):
        law = ji.Compliant(ji.Hertz(1.0), rtol=rtol)
        return ji.impact(law, ji.chain(jnp.ones(3), gaps=g), V).velocity

    return (
        jax.jit(jax.vmap(velocity)),
        jax.jit(jax.vmap(lambda g: jax.jvp(velocity, (g,), (jnp.ones_like(g),))[1])),
        jax.jit(jax.vmap(jax.jacfwd(velocity))),
    )


def split(f, gaps):
    """One shard a device: XLA's own loops use a single core for a batch this small."""
    return f(gaps)


def seconds(runs):
    """Medians of alternating repeats, after a first call each whose time is told apart."""
    first = []
    for run in runs:
        start = time.perf_counter()
        run()
        first.append(time.perf_counter() - start)
    times = [[] for _ in runs]
    for _ in range(REPEATS):
        for run, kept in zip(runs, times):
            start = time.perf_counter()
            run()
            kept.append(time.perf_counter() - start)
    return [float(np.median(t)) for t in times], first


def error_of(v, exact):
    return float(np.median(np.abs(np.asarray(v) - exact).max(axis=1)))


def tuned(solve, exact, settings, target):
    """The coarsest setting whose median error is no more than the target."""
    for setting in settings:
        error = error_of(solve(setting), exact)
        if error <= target:
            return setting, error
    raise RuntimeError("no setting reaches the target")


def main():
    gaps = np.random.default_rng(0).uniform(0, 2, (BATCH, 2))
    gaps[:, 0] = 0.0
    on_device = jnp.asarray(gaps)
    exact = np.asarray(ours(1e-12)[0](on_device))
    print(f"{os.cpu_count()} cores, batch {BATCH}, load {os.getloadavg()[0]:.1f}")
    print(
        f"{'target':>7} {'':12} {'setting':>9} {'error':>8} {'us/impact':>10} {'ratio':>6} {'first s':>8}"
    )
    for target in (1e-5, 1e-7):
        rtol, e_ours = tuned(
            lambda r: ours(r)[0](on_device),
            exact,
            [10.0**-p for p in np.arange(3.0, 11.0, 0.5)],
            target,
        )
        h, e_verlet = tuned(
            lambda h: verlet(gaps, h), exact, [0.2 / 2 ** (p / 2) for p in range(30)], target
        )
        value, _, jacobian = ours(rtol)
        runs = [
            lambda f=value: jax.block_until_ready(f(on_device)),
            lambda h=h: verlet(gaps, h),
            lambda f=jacobian: jax.block_until_ready(f(on_device)),
        ]
        (a, b, c), first = seconds(runs)
        rows = (
            ("ours", rtol, e_ours, a, b / a),
            ("verlet", h, e_verlet, b, 1.0),
            ("ours + d/dgap", rtol, e_ours, c, a / c),
        )
        for (name, setting, error, t, ratio), start in zip(rows, first):
            print(
                f"{target:7.0e} {name:13} {setting:8.1e} {error:8.1e} {t / BATCH * 1e6:10.2f} "
                f"{ratio:6.2f} {start:8.2f}"
            )


if __name__ == "__main__":
    main()
