"""No more model than a scene needs: `python tests/benchmarks/economy.py`.

Each row holds the time of what a scene needs (`lean`) beside the time of a larger model of the same
impact (`full`), batches in alternating repeats, LZB with Hertz contacts at the default tolerance
unless said otherwise. `saving` = full / lean, median and quartiles of the repeats; where the two
should cost the same (what is not asked for costs nothing) the aim is 1.
"""

import functools
from unittest import mock

from harness import (
    alternating,
    arguments,
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
from three_balls import DOP853, aligned

import jimpact as ji
from jimpact.events import impact_dynamics

REPEATS, BATCH = 9, 128
QUICK_REPEATS, QUICK_BATCH = 2, 4
FEW = 4  # impacts of many coupled contacts in a batch
LONGEST = 5.0  # seconds for the repeats of one comparison
E = 0.9


def stiffnesses(batch, m):
    return jnp.asarray(10 ** np.random.default_rng(0).uniform(-0.5, 0.5, (batch, m)))


def batched(scene, v, e=E):
    """`run(k (B, m))`: LZB impacts of one scene with many stiffnesses."""
    return jax.jit(jax.vmap(lambda k: ji.impact(ji.LZB(e, k, 1.5), scene, v).velocity))


def struck(n):
    return jnp.zeros(n).at[0].set(1.0)


def dense(n):
    """A chain of n equal balls without the structure of a chain."""
    return ji.Scene(jnp.ones(n), ji.chain(jnp.ones(n)).normals)


def contact_space(batch):
    """Three contacts among 4 and among 300 coordinates, all of which take part."""
    small, n = dense(4), 300
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(n, 4)))[0]
    large = ji.Scene(jnp.ones(n), jnp.asarray(turn) @ small.normals)
    k = stiffnesses(batch, 3)
    few, many = batched(small, struck(4)), batched(large, jnp.asarray(turn) @ struck(4))
    as_many = batched(ji.chain(jnp.ones(64)), struck(64))
    wide = stiffnesses(FEW, 63)
    return [
        ("3 contacts: 4 / 300 coordinates", lambda: few(k), lambda: many(k), "1"),
        ("3 / 63 contacts", lambda: many(k[:FEW]), lambda: as_many(wide), "> 1"),
    ]


def open_contacts():
    """Three closed contacts at the struck end of 31 balls, the other 27 open; dense scene."""
    gaps = jnp.where(jnp.arange(30) < 3, 0.0, 1.0)
    normals = ji.chain(jnp.ones(31)).normals
    some = ji.Scene(jnp.ones(31), normals, gaps=gaps)
    alone, part = batched(dense(4), struck(4)), batched(some, struck(31))
    everything = batched(dense(31), struck(31))
    k, wide = stiffnesses(FEW, 3), stiffnesses(FEW, 30)
    return [
        (
            "30 contacts: 3 closed / all closed",
            lambda: part(wide),
            lambda: everything(wide),
            "> 1",
        ),
        ("3 contacts / 3 closed of 30", lambda: alone(k), lambda: part(wide), "1"),
    ]


def beside(balls, count):
    """`count` separate chains of `balls` equal balls in one scene, each struck at its end."""
    one = np.asarray(ji.chain(jnp.ones(balls)).normals)
    scene = ji.Scene(jnp.ones(balls * count), np.kron(np.eye(count), one))
    return scene, jnp.tile(struck(balls), count)


def independent_pairs(batch, pairs):
    """`pairs` pairs of balls in one scene; the same as single pairs in a batch."""
    together, single = (
        batched(*beside(2, pairs)),
        batched(ji.chain(jnp.ones(2)), struck(2)),
    )
    coupled = batched(dense(pairs + 1), struck(pairs + 1))
    k = stiffnesses(batch, pairs)
    each = k.reshape(-1, 1)
    return [
        (
            f"{pairs} single pairs / one scene of them",
            lambda: single(each),
            lambda: together(k),
            "1",
        ),
        (
            f"{pairs} pairs / {pairs} coupled contacts",
            lambda: together(k[:1]),
            lambda: coupled(k[:1]),
            "> 1",
        ),
    ]


def by_groups(balls, count):
    """Separate chains in one scene: group by group, and whole as where the scene is traced."""

    def both(name, make):
        scene, v = beside(balls, count)
        k = stiffnesses(FEW, scene.contacts)
        run = jax.vmap(
            lambda k, s: ji.impact(make(k), s, v).velocity, in_axes=(0, None)
        )
        apart, whole = jax.jit(lambda k: run(k, scene)), jax.jit(run)
        np.testing.assert_allclose(apart(k), whole(k, scene), atol=1e-6)
        row = f"{count} chains of {balls}, {name}: by groups / whole"
        return row, lambda: apart(k), lambda: whole(k, scene), "> 1"

    return [
        both("LZB", lambda k: ji.LZB(E, k, 1.5)),
        both("Newton", lambda k: ji.Newton(E + 0.0 * k)),
        both("Moreau", lambda k: ji.Moreau(E + 0.0 * k)),
    ]


def compiled_without_closed_form(function, k):
    """`function` compiled with every contact integrated to its end."""
    whole = functools.partial(impact_dynamics.ImpulseProgram, whole=True)
    with mock.patch.object(impact_dynamics, "ImpulseProgram", whole):
        jax.clear_caches()
        run = jax.jit(function).lower(k).compile()
    jax.clear_caches()
    return run


def isolated_contact(batch):
    """The last stroke of an impact by the energy, or integrated to its end."""
    k = stiffnesses(batch, 2)
    run = batched(ji.chain(jnp.ones(3)), struck(3))
    whole = compiled_without_closed_form(run, k)
    return [
        (
            "3 balls: closed form / integrated to the end",
            lambda: run(k),
            lambda: whole(k),
            "> 1",
        )
    ]


def passes(batch):
    """Mean passes of the same impacts, with the closed form and without."""
    k = stiffnesses(batch, 2)

    def count(k):
        law = ji.LZB(E, k, 1.5)
        evaluations = aligned(law, ji.chain(jnp.ones(3)), struck(3), 1e-8).evaluations
        return evaluations / len(DOP853.c)

    each = jax.vmap(count)
    return float(jnp.mean(jax.jit(each)(k))), float(
        jnp.mean(compiled_without_closed_form(each, k)(k))
    )


def single_contact(batch):
    """LZB with one contact beside Newton's formula, which is the same outcome."""
    scene, k = ji.chain(jnp.ones(2)), stiffnesses(32 * batch, 1)
    lzb = batched(scene, struck(2))
    newton = jax.jit(
        jax.vmap(lambda k: ji.impact(ji.Newton(E + 0.0 * k), scene, struck(2)).velocity)
    )
    return [("1 contact: Newton / LZB", lambda: newton(k), lambda: lzb(k), "1")]


def tridiagonal(n):
    chain, matrix = (
        batched(ji.chain(jnp.ones(n)), struck(n)),
        batched(dense(n), struck(n)),
    )
    k = jnp.ones((1, n - 1))
    return [
        (
            f"chain of {n}: tridiagonal / dense",
            lambda: chain(k),
            lambda: matrix(k),
            "> 1",
        )
    ]


def not_asked_for(batch):
    """Histories, damping, gaps and tangents: without them, and with them there but idle."""
    scene, v, k = ji.chain(jnp.ones(3)), struck(3), stiffnesses(batch, 2)
    plain = batched(scene, v)
    touching = batched(ji.chain(jnp.ones(3), gaps=jnp.zeros(2)), v)
    rough = ji.Scene(jnp.ones(3), scene.normals, tangents=jnp.zeros((3, 2)))
    smooth, tangents = (
        batched(ji.Scene(jnp.ones(3), scene.normals), v),
        batched(rough, v),
    )

    def forced(force):
        return jax.jit(
            jax.vmap(lambda k: ji.impact(ji.Compliant(force(k)), scene, v).velocity)
        )

    spring, damper = forced(ji.Hertz), forced(lambda k: ji.HuntCrossley(k, 0.0))
    sampled = jax.jit(jax.vmap(lambda k: ji.history(ji.LZB(E, k, 1.5), scene, v).force))
    return [
        ("gaps: none / all zero", lambda: plain(k), lambda: touching(k), "1"),
        (
            "tangents: none / there, no friction",
            lambda: smooth(k),
            lambda: tangents(k),
            "1",
        ),
        (
            "LZB / Compliant, the same outcome at e = 1",
            lambda: plain(k),
            lambda: spring(k),
            "> 1",
        ),
        (
            "damping: none / zero Hunt-Crossley",
            lambda: spring(k),
            lambda: damper(k),
            "> 1",
        ),
        (
            "impact / history of 200 samples",
            lambda: plain(k),
            lambda: sampled(k),
            "> 1",
        ),
    ]


def compared(cases, repeats):
    rows = []
    for name, lean, full, aim in cases:
        with stage(name):
            timed(full)
            fitting = int(LONGEST / timed(full)[0])
            times = alternating(
                {"lean": lean, "full": full}, min(repeats, max(2, fitting))
            )
        low, middle, high = quartiles(times["full"].wall / times["lean"].wall)
        by_cpu = np.median(times["full"].cpu) / max(np.median(times["lean"].cpu), 1e-9)
        milliseconds = {k: float(np.median(t.wall)) * 1e3 for k, t in times.items()}
        row = {"lean / full": name} | {f"{k}_ms": v for k, v in milliseconds.items()}
        row |= {
            "saving_q1": low,
            "saving": middle,
            "saving_q3": high,
            "saving_cpu": float(by_cpu),
        }
        rows.append(row | {"aim": aim})
    return rows


def chart(rows, path):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(
        figsize=(8, 0.4 * len(rows) + 1.2), layout="constrained"
    )
    middle = np.array([row["saving"] for row in rows])
    spread = [
        middle - [row["saving_q1"] for row in rows],
        np.array([row["saving_q3"] for row in rows]) - middle,
    ]
    colours = ["C2" if row["aim"] == "1" else "C0" for row in rows]
    axes.errorbar(
        middle, range(len(rows)), xerr=spread, fmt="none", color="k", capsize=3
    )
    axes.scatter(middle, range(len(rows)), color=colours, zorder=3)
    axes.set_yticks(range(len(rows)), [row["lean / full"] for row in rows])
    axes.axvline(1.0, color="k", lw=0.5)
    axes.set_xscale("log")
    axes.invert_yaxis()
    axes.grid(alpha=0.3, axis="x", which="both")
    axes.set_xlabel("full / lean, time; green: should be 1")
    save_figure(figure, path)


def main():
    options = arguments(__doc__)
    quick = options.quick
    batch, repeats = (QUICK_BATCH, QUICK_REPEATS) if quick else (BATCH, REPEATS)
    long = 8 if quick else 100
    cases = contact_space(batch) + open_contacts() + independent_pairs(batch, long)
    cases += by_groups(2, long) + by_groups(3, 2 if quick else 20)
    cases += isolated_contact(batch) + single_contact(batch) + tridiagonal(long)
    cases += not_asked_for(batch)
    rows = compared(cases[::3] if quick else cases, repeats)
    closed, whole = passes(batch)
    saving = dict.fromkeys(("saving_q1", "saving", "saving_q3"), whole / closed)
    name = {"lean / full": "3 balls: passes by closed form / to the end", "aim": "> 1"}
    rows.append(name | {"lean_passes": closed, "full_passes": whole} | saving)
    keys = "lean / full|lean_ms|full_ms|saving_q1|saving|saving_q3|saving_cpu|aim"
    show("no more model than a scene needs", rows, keys.split("|"))
    write_csv(options.out / "economy.csv", rows)
    chart(rows, options.out / "economy.png")


if __name__ == "__main__":
    main()
