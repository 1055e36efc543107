# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3 (ipykernel)
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Which law does your engine realise?
#
# *Course, part 18. Before: [measured drops](17_measured_drops.ipynb).*
#
# You will find the impact law that a physics engine obeys, from three velocities of balls that
# touch; see that three balls do not tell what five do; and compare the engine with a measured shot.
#
# A user asks an engine for a coefficient of restitution. What several contacts at once make of it
# is up to the engine's solver.

# %%
# %matplotlib inline
from importlib.resources import files

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np

import jimpact as ji

three, five = ji.chain([1.0] * 3), ji.chain([1.0] * 5)
ji.plot.system(three, [1.0, 0.0, 0.0], "Three equal balls that touch")

# %% [markdown]
# ## Three balls
#
# Let your engine compute this impact with e = 1, without gravity, friction and damping, and put its
# velocities here. These are pymunk's, from the table of some fifty engines that comes with jimpact
# (`docs/engines.md` says how each was asked).

# %%
ENGINE = "pymunk"
yours = {row.scene: row.velocity for row in ji.data.engine_impacts(ENGINE).rows}
yours["S1"]

# %%
LAWS = {
    "Moreau": ji.Moreau,
    "Binary": ji.Binary,
    "LZB, Hertz": lambda e: ji.LZB(e, exponent=1.5),
    "LZB, springs": lambda e: ji.LZB(e, exponent=1.0),
}


def beside(scene, measured, e=1.0, title=""):
    """The table of laws, and their picture, beside measured velocities."""
    before = np.eye(scene.size)[0]
    laws = {name: make(e) for name, make in LAWS.items()}
    table = ji.compare(scene, before, laws)
    for name, entry in table.entries.items():
        off = np.linalg.norm(np.asarray(entry.outcome.velocity) - measured)
        print(
            f"{name:13} {np.round(entry.outcome.velocity, 3) + 0.0}  off by {off:.3f}"
        )
    return ji.plot.comparison(table, measured, title=title)


beside(three, yours["S1"], title=f"Three balls, e = 1: laws, and {ENGINE} (dashed)")

# %% [markdown]
# pymunk gives (0, 0, 1): one contact after another, `Binary`. Engines that solve all contacts at
# once give Moreau's (-1/3, 2/3, 2/3), codes that integrate contact forces one of the others. Which
# engines do what?

# %%
for law in ("Moreau", "Binary", "LZB, Hertz", "LZB, linear springs", "plastic"):
    rows = ji.data.engine_impacts(scene="S1").rows
    names = dict.fromkeys(
        r.engine for r in rows if r.nearest_law == law and r.distance < 0.03
    )
    print(f"{law:20} {', '.join(names)}")

# %% [markdown]
# "Plastic" are engines below a threshold of speed, 1 or 2 m/s by default: nothing bounces there,
# whatever e is. Try your engine at 1 and at 10 m/s.
#
# ## With losses
#
# Three balls with e = .5. Which e fits the engine best? It need not be the one you asked for: some
# engines multiply the values of both bodies, some take the mean or the larger one.

# %%
es = np.linspace(0, 1, 101)
for name, make in LAWS.items():
    impact = jax.vmap(
        lambda e, make=make: ji.impact(make(e), three, [1.0, 0.0, 0.0]).velocity
    )
    after = jax.jit(impact)(es)
    off = np.linalg.norm(after - np.array(yours["S3"]), axis=1)
    print(f"{name:13} e = {es[off.argmin()]:.2f}, off by {off.min():.4f}")

# %% [markdown]
# Binary with e = .5 is right to rounding. But look at the others: linear springs with another e are
# nearly as good. One scene does not prove a law.
#
# ## Five balls
#
# So the engine is `Binary`? Then the fifth of five balls takes the whole blow.

# %%
beside(five, yours["S2"], title=f"Five balls, e = 1: laws, and {ENGINE} (dashed)")

# %% [markdown]
# It does not: the outcome is (-1/3, 0, 0, 2/3, 2/3), which is none of these laws. A law that was
# fitted to three balls of this engine is wrong for five. Box2D 2 and ODE's QuickStep do the same with
# five balls, although they obey Moreau's law with three.
#
# ## A wall
#
# Two balls and a wall, e = 1. Moreau and Binary agree here, so that a wall does not tell them apart.

# %%
wall = ji.chain([1.0, 1.0], wall=True)
beside(
    wall, yours["S4"], title=f"Two balls and a wall, e = 1: laws, and {ENGINE} (dashed)"
)

# %% [markdown]
# ## Beside steel balls
#
# A measured shot of three equal hard balls. Its errors are about .014 (`jimpact/data/README.md`).

# %%
path = files("jimpact") / "data" / "three_balls.csv"
measured = np.asarray(ji.read_experiments(path).post[0])
rows = ji.data.engine_impacts(scene="S1").rows
ranked = sorted(
    (float(np.linalg.norm(measured - r.velocity)), r.engine, r.setting) for r in rows
)
print("measured", measured)
for off, engine, setting in [*ranked[:6], *ranked[-3:]]:
    print(f"off by {off:.2f}: {engine}, {setting}")

# %% [markdown]
# DEM codes and Simbody, which integrate Hertz' contact force, are near; impulse solvers are not,
# and no coefficient of restitution mends that. So let the engine move the bodies, and `ji.impact`
# decide what happens in an impact: `docs/inside_your_engine.md` has recipes.

# %%
nearest = {r.engine: r.nearest_law for r in rows}
assert nearest["pymunk"] == "Binary"
assert nearest["simbody"] == "LZB, Hertz"

# %% [markdown]
# *Next: [spheres at an angle](19_spheres_at_an_angle.ipynb).*
