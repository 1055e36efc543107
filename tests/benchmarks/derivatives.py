"""Cost of derivatives and of compilation: `python tests/benchmarks/derivatives.py`.

The three-ball impacts of `three_balls.py`: the full Jacobian of v+ in (k, e, eta) by forward mode
beside the value with the same array parameters, and beside the value with the exponent static; one
impact with its gradient at touching contact; seconds to compile, in processes of their own.
"""

import subprocess
import sys
import time

from harness import (
    alternating,
    arguments,
    loosest,
    quartiles,
    save_figure,
    show,
    stage,
    timed,
    write_csv,
)

import jax  # isort: skip
import jax.numpy as jnp
import numpy as np
from three_balls import SCENE, V, law_of, one_impact, problem, steps

import jimpact as ji
from jimpact import velocity_change
from jimpact.methods.schemes import aligned

BATCH, REPEATS = 4096, 7
POINTS = 16  # single impacts, one after the other
TRUTH, TIGHT = 1e-13, 1e-12
GRADIENT_ERROR = 1e-8
COMPILED = {"jit(vmap(impact))": 5.0, "its gradient": 10.0}  # seconds, aims


def with_arrays(parameters, rtol=None):
    k, e, eta = parameters
    return ji.impact(ji.LZB(e, k, eta, rtol=rtol), SCENE, V).velocity


def jacobian(batch, repeats):
    """Full Jacobian in k (2,), e (2,), eta () of a batch, in units of the value."""
    k, e = (jnp.asarray(x) for x in problem(batch))
    values = (k, e, jnp.full(batch, 1.5))

    def full(rtol):
        return jax.jit(jax.vmap(jax.jacfwd(lambda p: with_arrays(p, rtol))))

    static = jax.jit(jax.vmap(lambda k, e: one_impact(k, e, None)))
    array, derivative = jax.jit(jax.vmap(with_arrays)), full(None)
    runs = {
        "value, exponent static": lambda: static(k, e),
        "value, exponent array": lambda: array(values),
        "Jacobian (k, e, eta)": lambda: derivative(values),
    }
    with stage("Jacobian: compiling and timing"):
        times = alternating(runs, repeats)
    with stage("Jacobian: error against rtol 1e-12"):
        exact, ours = full(TIGHT)(values), derivative(values)
        difference = jax.tree.map(
            lambda a, b: float(jnp.max(jnp.abs(a - b))), ours, exact
        )
        error = max(jax.tree.leaves(difference))
    rows = []
    for name, timing in times.items():
        row = entry(name, timing.wall / batch * 1e6, "us", batch=batch)
        row["cpu"] = float(np.median(timing.cpu)) / batch * 1e6
        rows.append(row | ({"error_max": error} if "Jacobian" in name else {}))
    last = times["Jacobian (k, e, eta)"]
    for name, aim in (
        ("value, exponent array", "<= 4"),
        ("value, exponent static", ""),
    ):
        row = entry(
            f"Jacobian / {name}", last.wall / times[name].wall, "1", aim, batch=batch
        )
        rows.append(
            row
            | {"cpu": float(np.median(last.cpu / np.maximum(times[name].cpu, 1e-9)))}
        )
    return rows


def entry(quantity, values, unit, aim="", **more):
    low, middle, high = quartiles(values)
    row = {
        "quantity": quantity,
        "q1": low,
        "median": middle,
        "q3": high,
        "unit": unit,
        "aim": aim,
    }
    return row | more


def single(points, repeats, settings):
    """One impact at a time, with the gradient of a combination of v+ in k (2,) and e (2,)."""
    stiffness, restitution = problem(points)
    weight = jnp.array([1.0, -0.5, 2.0])

    def solver(rtol):
        def loss(k, e):
            return one_impact(k, e, rtol) @ weight

        return jax.jit(jax.value_and_grad(loss, argnums=(0, 1)))

    def at_any_rtol(k, e, rtol):
        result = aligned(law_of(k, e), SCENE, V, rtol)
        return (V + velocity_change(SCENE, result.impulse)) @ weight

    k, e = jnp.asarray(stiffness), jnp.asarray(restitution)
    gradient = jax.jit(
        jax.vmap(jax.grad(at_any_rtol, argnums=(0, 1)), in_axes=(0, 0, None))
    )
    with stage("single impact with gradient: tuning"):
        exact = jnp.concatenate(gradient(k, e, TRUTH), axis=1)

        def error_of(parts):
            return float(jnp.max(jnp.abs(jnp.concatenate(parts, axis=1) - exact)))

        rtol, _ = loosest(
            lambda r: error_of(gradient(k, e, r)), settings, GRADIENT_ERROR
        )
        with_gradient = solver(rtol)
        pairs = list(zip(k, e))
        gradients = [with_gradient(*pair)[1] for pair in pairs]
        error = error_of([jnp.stack(part) for part in zip(*gradients)])
    rows = []
    value = jax.jit(lambda k, e: one_impact(k, e, rtol) @ weight)
    value(*pairs[0])
    for name, run, aim in (
        ("single impact", value, ""),
        ("single impact with gradient", with_gradient, "<= 2"),
    ):
        seconds = [
            timed(lambda p=p, f=run: f(*p))[0] for _ in range(repeats) for p in pairs
        ]
        row = entry(name, np.asarray(seconds) * 1e3, "ms", aim, setting=rtol, batch=1)
        rows.append(row | ({"error_max": error} if aim else {}))
    return rows


def compiled_here(name):
    """Seconds to trace, lower and compile in this process."""
    k, e = (jnp.asarray(x) for x in problem(BATCH))

    def outcome(k, e):
        return ji.impact(law_of(k, e), SCENE, V)

    def loss(k, e):
        return outcome(k, e).velocity[2]

    one = outcome if name == "jit(vmap(impact))" else jax.grad(loss, argnums=(0, 1))
    start = time.perf_counter()
    jax.jit(jax.vmap(one)).lower(k, e).compile()
    return time.perf_counter() - start


def compilation(repeats):
    rows = []
    for name, aim in COMPILED.items():
        with stage(f"compiling {name} in processes of their own"):
            command = [sys.executable, __file__, "--compile", name]
            outs = [
                subprocess.run(
                    command, capture_output=True, text=True, check=True
                ).stdout
                for _ in range(repeats)
            ]
        seconds = [float(out.split()[-1]) for out in outs]
        rows.append(entry(f"compile {name}", seconds, "s", f"<= {aim:g}"))
    return rows


def chart(rows, path):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    units = {
        "us": "us per impact, batch",
        "1": "ratio",
        "ms": "ms, one impact",
        "s": "s to compile",
    }
    figure, all_axes = plt.subplots(2, 2, figsize=(10, 4), layout="constrained")
    for axes, (unit, label) in zip(all_axes.flat, units.items()):
        part = [row for row in rows if row["unit"] == unit]
        middle = np.array([row["median"] for row in part])
        spread = [
            middle - [row["q1"] for row in part],
            np.array([row["q3"] for row in part]) - middle,
        ]
        axes.barh([row["quantity"] for row in part], middle, xerr=spread, capsize=3)
        for place, row in enumerate(part):
            if row["aim"]:
                axes.plot(
                    [float(row["aim"].split()[-1])] * 2,
                    [place - 0.4, place + 0.4],
                    "k--",
                )
        axes.set_xlabel(label)
        axes.invert_yaxis()
    figure.suptitle("Derivatives and compilation; dashed: aim", fontsize=10)
    save_figure(figure, path)


def main():
    if "--compile" in sys.argv:
        print(compiled_here(sys.argv[-1]))
        return
    options = arguments(__doc__)
    quick = options.quick
    rows = jacobian(*((32, 2) if quick else (BATCH, REPEATS)))
    rows += single(*((2, 2) if quick else (POINTS, REPEATS)), steps(1e-4, 1e-10, 4))
    if not quick:
        rows += compilation(2)
    keys = "quantity batch setting error_max q1 median q3 cpu unit aim"
    show("derivatives and compilation", rows, keys.split())
    for row in rows:
        if row["aim"]:
            spread = f"{row['q1']:.2f} .. {row['q3']:.2f}"
            print(
                f"{row['quantity']}: {row['median']:.2f} {row['unit']} ({spread}); aim: {row['aim']}"
            )
    write_csv(options.out / "derivatives.csv", rows)
    chart(rows, options.out / "derivatives.png")


if __name__ == "__main__":
    main()
