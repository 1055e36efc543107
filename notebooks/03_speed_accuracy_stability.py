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
# # Speed, accuracy, stability: no more model than a scene needs
#
# *Course, part 3. Before: [Monte Carlo over gaps](02_monte_carlo_gaps.ipynb). Next:
# [the rocking block](04_rocking_block.ipynb).*
#
# You will learn to ask for the simplest law that will do, to read a chart of error against time, and
# to see where a method of integration fails before it fails you.
#
# LZB is right for touching contacts with known stiffness ratios, and the costliest of the
# instantaneous laws. Which scenes need it? And where they do: what does accuracy cost, and where
# do methods of integration fail?

# %%
# %matplotlib inline
import jax

jax.config.update("jax_enable_x64", True)

import numpy as np

import jimpact as ji

balls, v = ji.chain([1.0, 1.0, 1.0]), [1.0, 0.0, 0.0]
ji.plot.system(balls, v, "Three equal balls")

# %% [markdown]
# ## The simplest law that will do
#
# Nothing is known of the stiffnesses of a cradle but that their ratio lies in [0.1, 10]. The
# outcome then spreads so much that no law is within 1 %, LZB included: the ratio is what has to
# be measured.

# %%
cradle = ji.advise(balls, v, 0.01, timing=False)
print(cradle)

# %%
ji.plot.advice(cradle, "Three equal balls, stiffness ratio unknown")

# %% [markdown]
# With a known ratio it is another matter. Stiffness that falls steeply lets the balls collide one
# after another, stiffness that rises steeply makes the two struck ones move as one; in between
# LZB is needed.

# %%
for ratio in (0.01, 1.0, 50.0, 1000.0):
    found = ji.advise(balls, v, 0.02, stiffness=[1.0, ratio], timing=False)
    print(f"{found.name:8s} {found.reason}")

# %% [markdown]
# Contacts with a right kinetic angle do not feel each other, and a gap wider than two
# indentations makes collisions of steel balls binary.

# %%
corner = ji.Scene([1.0, 1.0], np.eye(2))  # a ball that hits two perpendicular walls
steel = ji.chain([0.0665] * 3, gaps=[0.0, 1e-4])  # one-inch balls, 0.1 mm apart
for scene, velocity, options in (
    (corner, [-1.0, -2.0], {"restitution": 0.5}),
    (steel, v, {"stiffness": 1.2e10, "tolerance": 1e-3}),
):
    found = ji.advise(scene, velocity, timing=False, **options)
    print(f"{found.name:8s} {found.reason}")

# %% [markdown]
# ## Where the stiffness ratio may be left out
#
# How evenly LZB spreads the energy of three balls, against k2/k1 and for three exponents. To the
# left lies the binary outcome (one ball takes all), to the right Moreau's. The larger the
# exponent, the further right the change; and Moreau's law is approached in waves.

# %%
valid = ji.validity_map(balls, v, exponents=(1.0, 1.5, 3.0))
print(valid)
ji.plot.validity_map(valid)

# %% [markdown]
# ## Speed against accuracy
#
# Error against time per impact in a batch, and against field evaluations, for three Hertz balls.
# The laws without stiffness are points: their error is that of the model, and no step size helps.

# %%
law = ji.LZB(0.9, [1.0, 1.0], 1.5)
ladder = {"dop853": [1e-4, 1e-6, 1e-8], "rk4": [0.1, 0.03, 0.01]}
laws = {"moreau": ji.Moreau(0.9), "binary": ji.Binary(0.9)}
options = {"batch": 64, "repeats": 3, "gradients": False, "durations": False}
chart = ji.work_precision(balls, v, law, list(ladder), ladder, laws, **options)
print(chart)

# %%
ji.plot.work_precision(chart)

# %% [markdown]
# ## Where methods fail
#
# Along each axis through three Hertz balls with e = 0.9: right, flagged by a status, or wrong.

# %%
axes = {
    "restitution": [0.0, 1e-3, 0.05, 0.3, 0.9, 1.0],
    "stiffness_ratio": np.logspace(-6, 6, 7),
}
stable = ji.stability_map(["default", "rk4"], axes, max_steps=3000)
print(stable)

# %%
ji.plot.stability_map(stable)

# %% [markdown]
# *Next: [a block that rocks](04_rocking_block.ipynb).*
