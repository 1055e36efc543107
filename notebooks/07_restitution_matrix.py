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
# # A restitution matrix
#
# *Course, part 7. Before: [what the data can tell](06_what_the_data_can_tell.ipynb). Next:
# [a tossed cube](08_a_tossed_cube.ipynb).*
#
# Newton's law says $\gamma^+ = -e\gamma^-$ contact by contact; a **restitution matrix** $E$ lets
# every contact answer to every other, $q_n^+ = -E q_n^-$. It can describe any shot. You will fit
# one to a measured shot, read what the shot leaves open, see what keeps $E$ from creating energy,
# and find out for which other shots it is worth nothing.

# %%
# %matplotlib inline
import time

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np
from matplotlib.figure import Figure

import jimpact as ji

began = time.perf_counter()
np.set_printoptions(precision=3, suppress=True)

balls = ji.chain([1.0, 1.0, 1.0])
ji.plot.system(balls, [1.0, 0.0, 0.0], "Three equal balls, measured once")

# %% [markdown]
# ## One measured shot
#
# The study gives no matrix: the fit starts from an admissible one of its own and frees all entries.
# The command `jimpact fit restitution_matrix.toml` does the same.

# %%
study = ji.read_study("restitution_matrix.toml")
print("start\n", study.law.matrix)
found = study.run()
print(found)

# %% [markdown]
# Only contact 1 approaches, so only the first column of $E$ answers: rank 2 of 4, and the report
# says which combination the data cannot see.
#
# ## What keeps $E$ honest
#
# Whatever the approach, contacts must separate afterwards and energy must not grow. The fit
# searches among matrices that promise both; `audit_matrix` checks any other.

# %%
print(ji.theory.audit_matrix(balls, found.law.matrix))
print(ji.theory.audit_matrix(balls, [[1.0, 0.5], [0.0, 1.0]]))

# %% [markdown]
# ## More kinds of shots
#
# From here on data are **simulated**: balls with stiffnesses and restitutions (the LZB law,
# $e = 0.9$), struck from one side, from the other, from both; errors of 0.01 m/s.

# %%
truth, sigma = ji.LZB([0.9, 0.9], [1.0, 1.0]), 0.01
kinds = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, -1.0], [1.0, 0.0, -0.3]])


def shots(scene, pre, seed):
    exact = np.array([ji.impact(truth, scene, v).velocity for v in pre])
    noise = np.random.default_rng(seed).normal(size=exact.shape)
    return ji.Experiments(pre, exact + sigma * noise, sigma)


start = study.law
one_side = ji.fit(start, balls, shots(balls, kinds[[0, 0, 0, 0]], 0), starts=1)
two_sides = ji.fit(start, balls, shots(balls, kinds[[0, 0, 1, 1]], 1), starts=1)
all_kinds = ji.fit(start, balls, shots(balls, kinds, 2), starts=1)
for name, fit in (("one side", one_side), ("two sides", two_sides), ("all kinds", all_kinds)):
    print(f"{name}: rank {fit.rank} of 4\n{np.asarray(fit.law.matrix)}\n{fit.warnings}\n")

# %% [markdown]
# Two kinds of shots determine $E$. A third is one too many: $E$ acts linearly on the velocities of
# approach, and balls do not. The fit says so.
#
# ## Other balls
#
# $E$ belongs to these masses. Take what was found from both sides to a heavier middle ball:

# %%
figure = Figure(figsize=(6, 3), layout="constrained")
axes = figure.subplots()
masses = np.linspace(0.3, 3.0, 28)
for law, colour, label in ((truth, "black", "LZB"), (two_sides.law, "#D55E00", "E of equal balls")):
    v = [np.asarray(ji.impact(law, ji.chain([1.0, m, 1.0]), kinds[0]).velocity) for m in masses]
    axes.plot(masses, np.array(v)[:, 2], color=colour, label=label)
axes.axvline(1.0, color="gray", lw=0.8)
axes.set(xlabel="mass of the middle ball [kg]", ylabel="third ball after [m/s]")
axes.legend(frameon=False)
figure

# %%
assert found.rank == 2
assert two_sides.rank == 4
assert any("lack of fit" in line.lower() for line in all_kinds.warnings)
print(f"run time {time.perf_counter() - began:.0f} s")

# %% [markdown]
# *Next: [400 measured impacts of a cube](08_a_tossed_cube.ipynb).*
