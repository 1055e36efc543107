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
# *Course, part 4. Before: [what the data can tell](03_what_the_data_can_tell.ipynb). Next: [a
# tossed cube](05_a_tossed_cube.ipynb).*
#
# Newton's law is $\gamma^+ = -e\gamma^-$ for each contact. A **restitution matrix** $E$ couples the
# contacts, $q_n^+ = -E q_n^-$, and can describe any shot. You will fit one to a measured shot, see
# which entries the shot does not determine, check that $E$ cannot create energy, and find out for
# which other shots it fails.

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
# The study contains no matrix: the fit starts from an admissible one and fits all entries. The
# command `jimpact fit restitution_matrix.toml` does the same.

# %%
study = ji.read_study("restitution_matrix.toml")
print("start\n", study.law.matrix)
first_fit = study.run()
print(first_fit)

# %% [markdown]
# Only contact 1 approaches, so the shot determines only the first column of $E$: rank 2 of 4. The
# report names the combinations that the data cannot determine.
#
# ## Which matrices are admissible
#
# For any approach, contacts must separate afterwards, and the energy must not grow. The fit
# searches only among matrices that guarantee both. `audit_matrix` checks any matrix.

# %%
print(ji.theory.audit_matrix(balls, first_fit.law.matrix))
print(ji.theory.audit_matrix(balls, [[1.0, 0.5], [0.0, 1.0]]))

# %% [markdown]
# ## More kinds of shots
#
# All further data are **simulated**, by the law of Liu, Zhao and Brogliato (LZB) with $e = 0.9$:
# balls struck from one side, from the other, and from both, with errors of 0.01 m/s.

# %%
truth, sigma = ji.LZB([0.9, 0.9], [1.0, 1.0]), 0.01
kinds = np.array(
    [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, -1.0], [1.0, 0.0, -0.3]]
)


def shots(scene, pre, seed):
    exact = np.array([ji.impact(truth, scene, v).velocity for v in pre])
    noise = np.random.default_rng(seed).normal(size=exact.shape)
    return ji.Experiments(pre, exact + sigma * noise, sigma)


start = study.law
one_side = ji.fit(start, balls, shots(balls, kinds[[0, 0, 0, 0]], 0), starts=1)
two_sides = ji.fit(start, balls, shots(balls, kinds[[0, 0, 1, 1]], 1), starts=1)
all_kinds = ji.fit(start, balls, shots(balls, kinds, 2), starts=1)
for name, fit in (
    ("one side", one_side),
    ("two sides", two_sides),
    ("all kinds", all_kinds),
):
    print(
        f"{name}: rank {fit.rank} of 4\n{np.asarray(fit.law.matrix)}\n{fit.warnings}\n"
    )

# %% [markdown]
# Two kinds of shots determine $E$. A third kind contradicts them, because $E$ is linear in the
# velocities of approach, and the balls are not. The fit reports a lack of fit.
#
# ## Other balls
#
# $E$ is valid for these masses only. Apply the matrix fitted to two sides to other masses of the
# middle ball:

# %%
figure = Figure(figsize=(6, 3), layout="constrained")
axes = figure.subplots()
masses = np.linspace(0.3, 3.0, 28)
for law, colour, label in (
    (truth, "black", "LZB"),
    (two_sides.law, "#D55E00", "E of equal balls"),
):
    v = [
        np.asarray(ji.impact(law, ji.chain([1.0, m, 1.0]), kinds[0]).velocity)
        for m in masses
    ]
    axes.plot(masses, np.array(v)[:, 2], color=colour, label=label)
axes.axvline(1.0, color="gray", lw=0.8)
axes.set(xlabel="mass of the middle ball [kg]", ylabel="third ball after [m/s]")
axes.legend(frameon=False)
figure

# %%
assert first_fit.rank == 2
assert two_sides.rank == 4
assert any("lack of fit" in line.lower() for line in all_kinds.warnings)
print(f"run time {time.perf_counter() - began:.0f} s")

# %% [markdown]
# ## Exercises
#
# 1. Newton's law is $E = e I$. For three equal balls it cannot create energy: check $e = 1$.
# 2. And if the contacts differ, $E = \mathrm{diag}(1, 0)$?
#
# Answers:

# %%
for name, matrix in (("1. e = 1", np.eye(2)), ("2. diag(1, 0)", np.diag([1.0, 0.0]))):
    print(name, "\n", ji.theory.audit_matrix(balls, matrix), "\n")

# %% [markdown]
# *Next: [400 measured impacts of a cube](05_a_tossed_cube.ipynb).*
