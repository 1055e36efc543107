"""Batched LCPs beside enumeration and qpax: `python tests/benchmarks/lcp.py`.

Medians of repeats, side by side in one run, compile time apart; ratios are what counts.
"""

import itertools
import time

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

from jimpact.numerics.lcp import solve_lcp  # noqa: E402

BATCH, REPEATS = 10_000, 9


def problems(m, seed=0):
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(BATCH, m + 1, m))
    w = np.einsum("kri,krj->kij", normals, normals)
    return jnp.asarray(w), jnp.asarray(rng.normal(size=(BATCH, m)))


def enumeration(w, q):
    """Every support at once, the first that fits."""
    m = q.shape[0]
    masks = jnp.asarray(list(itertools.product([False, True], repeat=m)))

    def on(mask):
        both = mask[:, None] & mask[None, :]
        z = jnp.linalg.solve(jnp.where(both, w, jnp.eye(m)), jnp.where(mask, -q, 0.0))
        return z, jnp.minimum(z.min(), jnp.where(mask, 0.0, w @ z + q).min())

    z, worst = jax.vmap(on)(masks)
    return z[jnp.argmax(worst)]


def qpax_solver():
    try:
        import qpax
    except ImportError:
        return None

    def solve(w, q):
        m = q.shape[0]
        empty, none = jnp.zeros((0, m)), jnp.zeros(0)
        return qpax.solve_qp_primal(w, q, empty, none, -jnp.eye(m), jnp.zeros(m))

    return solve


def timed(f, *args):
    start = time.perf_counter()
    jax.block_until_ready(f(*args))
    first = time.perf_counter() - start
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        jax.block_until_ready(f(*args))
        times.append(time.perf_counter() - start)
    return np.median(times) / BATCH * 1e6, first


def main():
    solvers = {
        "lemke (ours)": lambda w, q: solve_lcp(w, q).z,
        "ours, W known regular": lambda w, q: solve_lcp(w, q, regular=True).z,
        "enumeration": enumeration,
        "qpax": qpax_solver(),
    }
    print(
        f"{'m':>2} {'solver':24} {'µs':>8} {'ratio':>7} {'compile s':>9} {'max |w-|, |z-|':>15} jvp µs"
    )
    for m in (2, 3, 5, 8):
        w, q = problems(m)
        ours = None
        for name, solver in solvers.items():
            if solver is None or (name == "enumeration" and m > 5):
                continue
            cost, first = timed(jax.jit(jax.vmap(solver)), w, q)
            z = jax.jit(jax.vmap(solver))(w, q)
            worst = -float(
                jnp.minimum(z.min(), (jnp.einsum("kij,kj->ki", w, z) + q).min())
            )
            slope = np.nan
            if name != "qpax":  # it has no forward mode
                jvp = jax.jit(
                    jax.vmap(
                        lambda w, q, f=solver: jax.jvp(lambda b: f(w, b), (q,), (q,))[1]
                    )
                )
                slope, _ = timed(jvp, w, q)
            ours = ours or cost
            print(
                f"{m:2d} {name:24} {cost:8.2f} {cost / ours:7.2f} {first:9.2f} {worst:15.1e} {slope:6.2f}"
            )


if __name__ == "__main__":
    main()
