"""Compliant chains with random gaps beside a Verlet loop: `tests/benchmarks/gapped_chain.py`.

Three Hertz balls, struck at one end, the gap between the others random (0 to 2 delta_c), at equal
true error over the batch (root mean square, or largest) against a run at 1e-12. Side by side in
one run, medians of alternating repeats, compile time apart, both on all cores.
"""

import os
import time

# one device a core: XLA runs the loops of one device on one core, numba uses them all
os.environ["XLA_FLAGS"] = f"--xla_force_host_platform_device_count={os.cpu_count()}"

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
CHUNK = 64
WIDEST = 2.0  # gap; delta_c is 1
SLOW = 1e-9  # approach of Verlet that is left alone: its collision would take thousands of steps
MOST = 10_000_000  # Verlet steps of one impact
V = jnp.array([1.0, 0.0, 0.0])


@numba.njit
def _verlet(g1, g2, h, out):
    """Velocity Verlet from touch to the end of the last contact; free flight is skipped."""
    x1, x2 = -g1, -g2  # indentations
    v1, v2, v3 = 1.0, 0.0, 0.0
    steps = 0
    while steps < MOST:
        u1, u2 = v1 - v2, v2 - v3
        if x1 <= 0.0 and x2 <= 0.0:  # flight: to the next closing, exactly
            t1 = -x1 / u1 if u1 > SLOW else np.inf
            t2 = -x2 / u2 if u2 > SLOW else np.inf
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
        while (x1 > 0.0 or x2 > 0.0) and steps < MOST:
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
    """Outcome and its Jacobian in the gaps, in small batches (a batch waits for its slowest)."""

    def velocity(g):
        law = ji.Compliant(ji.Hertz(1.0), rtol=rtol)
        return ji.impact(law, ji.chain(jnp.ones(3), gaps=g), V).velocity

    def spread(f):
        def shard(g):
            return jax.lax.map(f, g, batch_size=CHUNK)

        mesh = jax.make_mesh((len(jax.devices()),), ("core",))
        along = jax.sharding.PartitionSpec("core")
        sharding = jax.sharding.NamedSharding(mesh, along)
        run = jax.shard_map(
            shard, mesh=mesh, in_specs=along, out_specs=along, check_vma=False
        )
        compiled = jax.jit(run)
        return lambda g: compiled(jax.device_put(g, sharding))

    return spread(velocity), spread(jax.jacfwd(velocity))


def seconds(runs):
    """Medians of alternating repeats, after a first call each, timed by itself."""
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


def error_of(v, exact, measure):
    error = np.abs(np.asarray(v) - exact).max(axis=1)
    return float(error.max() if measure == "max" else np.sqrt(np.mean(error**2)))


def tuned(solve, exact, settings, target, measure):
    """The coarsest setting whose error is no more than the target."""
    for setting in settings:
        error = error_of(solve(setting), exact, measure)
        if error <= target:
            return setting, error
    raise RuntimeError("no setting reaches the target")


def main():
    gaps = np.random.default_rng(0).uniform(0, WIDEST, (BATCH, 2))
    gaps[:, 0] = 0.0
    on_device = jnp.asarray(gaps)
    exact = np.asarray(ours(1e-12)[0](on_device))
    made = {rtol: ours(rtol) for rtol in (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9)}
    print(f"{os.cpu_count()} cores, batch {BATCH}, load {os.getloadavg()[0]:.1f}")
    print("measure  target               setting    error µs/impact  ratio  first s")
    for measure, target in (("rms", 1e-5), ("rms", 1e-7), ("max", 1e-5), ("max", 1e-7)):
        rtol, e_ours = tuned(
            lambda r: made[r][0](on_device), exact, made, target, measure
        )
        steps = [0.2 / 2 ** (p / 2) for p in range(30)]
        h, e_verlet = tuned(lambda h: verlet(gaps, h), exact, steps, target, measure)
        value, jacobian = made[rtol]
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
                f"{measure:7} {target:7.0e} {name:13} {setting:8.1e} {error:8.1e} {t / BATCH * 1e6:10.2f} "
                f"{ratio:6.2f} {start:8.2f}"
            )


if __name__ == "__main__":
    main()
