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
# # The chapter: its systems, its figures, its question
#
# *Course, part 16. Before: [robots from MuJoCo](15_robots_from_mujoco.ipynb). Next:
# [measured drops](17_measured_drops.ipynb).*
#
# You will walk through the chapter that the laws are from (B. Brogliato, *Nonsmooth Mechanics*,
# 2016, chapter 6), run its systems and draw its figures. Its question: one coefficient of
# restitution does not determine what several simultaneous contacts do; what else is necessary?
# The page `docs/chapter.md` has every formula, with the number printed there beside ours.

# %%
# %matplotlib inline
import jax

jax.config.update("jax_enable_x64", True)

import chapter_figures
import numpy as np

import jimpact as ji

three, hit = ji.chain([1.0, 1.0, 1.0]), [1.0, 0.0, 0.0]
chapter_figures.draw("6.4")

# %% [markdown]
# ## Momentum and energy are not sufficient (6.1.1.3)
#
# Two balls: the line of momentum meets the circle of energy in one admissible point. Three balls: an
# arc remains, from A, where the last ball takes all, to B, where the two targets stay together.

# %%
ends = ji.theory.admissible_set(three, hit).conserving_arc(2)
print("A and B:", ends.round(4).tolist())
chapter_figures.draw("6.3b")

# %% [markdown]
# ## Laws differ by how they spread the energy (6.3.3)
#
# C_KE is the standard deviation of the kinetic energies over their mean: sqrt(2) at A, 0.47 at B.
# With losses, laws differ in the energy that they keep, too.

# %%
laws = {
    "Moreau": ji.Moreau(0.5),
    "Poisson": ji.Poisson([0.5, 0.8]),
    "binary": ji.Binary(0.5),
    "LZB, k2/k1 = 1": ji.LZB(0.5, [1.0, 1.0]),
    "LZB, k2/k1 = 5": ji.LZB(0.5, [1.0, 5.0]),
}
result = ji.compare(three, hit, laws)
for name, entry in result.entries.items():
    kept = entry.energy_ratio
    spread = float(ji.theory.energy_dispersion(three, entry.outcome.velocity))
    print(f"{name:15s} K_ER {kept:.4f}  C_KE {spread:.4f}")
ji.plot.energy_plane(result, "Three equal balls, e = 0.5")

# %% [markdown]
# What moves an outcome of LZB along the arc is the ratio of the stiffnesses, and the exponent of
# the contacts. Figure 6.9: binary collisions on the left, Moreau's law on the right.

# %%
chapter_figures.draw("6.9")

# %% [markdown]
# ## The force at a wall does not grow with the column (6.1.1)
#
# A column of beads falls on the ground. More beads press longer, not harder: the wave passes through
# the column, and the wall feels only its first part.

# %%
chapter_figures.draw("6.2")

# %% [markdown]
# ## Inside a contact (6.3.1)
#
# A contact may be compressed again while it expands. The area of the loop is the energy that it
# takes; B is the indentation that remains.

# %%
chapter_figures.draw("6.6")

# %% [markdown]
# ## The rocking block (6.3.2.2)
#
# How much of the impact of one corner reaches the other one depends on the kinetic angle and on
# friction: where a curve touches zero, the other corner is left alone, for every restitution.

# %%
chapter_figures.draw("6.8b")

# %% [markdown]
# ## Waves (6.1.1.4, Remark 6.4)
#
# M of ten balls hit the other N. About M + 2 of them move forward, with 99 % of the energy; glued
# trains would do something else.

# %%
for m in range(1, 7):
    before = np.arange(10) < m
    out = ji.impact(
        ji.LZB(1.0, np.ones(9)), ji.chain(np.ones(10)), before.astype(float)
    )
    forward = np.asarray(out.velocity)[np.asarray(out.velocity) > 0]
    print(
        f"{m} hit {10 - m}: {len(forward)} move forward, with {sum(forward**2) / m:.1%} of the energy"
    )

# %% [markdown]
# And there are chains that disperse nothing: the last ball takes the whole blow.

# %%
masses, stiffness = ji.theory.reinsch_chain(6)
out = ji.impact(ji.LZB(1.0, stiffness, exponent=1.0), ji.chain(masses), np.eye(6)[0])
print("masses   ", np.round(masses, 4))
print("stiffness", np.round(stiffness, 4))
print("v+       ", np.round(out.velocity, 6) + 0.0)

# %% [markdown]
# The file `chapter_figures.py` beside this notebook draws every figure with public functions of
# jimpact. The others: the systems as the chapter draws them, and what laws can reach.

# %%
from IPython.display import display

for number in ("5.5", "6.1", "6.3a", "6.5", "6.7a", "6.7b", "6.8a"):
    display(chapter_figures.draw(number))

# %% [markdown]
# *Next: [measured drops](17_measured_drops.ipynb).*
