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
# # The simplest law that is accurate enough
#
# *Course, part 6. Before: [a tossed cube](05_a_tossed_cube.ipynb). Next: [methods of
# integration](07_methods_of_integration.ipynb).*
#
# You will find the simplest law for a scene and a tolerance, and learn when the stiffness ratio
# does not matter.
#
# `LZB`, the law of Liu, Zhao and Brogliato, is accurate for touching contacts with known stiffness
# ratios. It is also the most expensive of the instantaneous laws. Which scenes need it?

# %%
# %matplotlib inline
import jax

jax.config.update("jax_enable_x64", True)

import numpy as np

import jimpact as ji

balls, v = ji.chain([1.0, 1.0, 1.0]), [1.0, 0.0, 0.0]
ji.plot.system(balls, v, "Three equal balls")

# %% [markdown]
# ## Advice
#
# Suppose that only the range of the stiffness ratio of a cradle is known, [0.1, 10]. The outcome
# then varies so much that no law is within 1 %, LZB included. You have to measure the ratio.

# %%
cradle = ji.advise(balls, v, 0.01, timing=False)
print(cradle)

# %%
ji.plot.advice(cradle, "Three equal balls, stiffness ratio unknown")

# %% [markdown]
# With a known ratio the answer changes. If the stiffness falls steeply along the chain, the balls
# collide one after another. If it rises steeply, the two struck balls move together. In between LZB
# is needed.

# %%
for ratio in (0.01, 1.0, 50.0, 1000.0):
    advice = ji.advise(balls, v, 0.02, stiffness=[1.0, ratio], timing=False)
    print(f"{advice.name:8s} {advice.reason}")

# %% [markdown]
# Contacts with a kinetic angle of 90 degrees do not interact. A gap wider than two indentations
# separates the collisions of steel balls.

# %%
corner = ji.Scene([1.0, 1.0], np.eye(2))  # a ball that hits two perpendicular walls
steel = ji.chain([0.0665] * 3, gaps=[0.0, 1e-4])  # one-inch balls, 0.1 mm apart
for scene, velocity, options in (
    (corner, [-1.0, -2.0], {"restitution": 0.5}),
    (steel, v, {"stiffness": 1.2e10, "tolerance": 1e-3}),
):
    advice = ji.advise(scene, velocity, timing=False, **options)
    print(f"{advice.name:8s} {advice.reason}")

# %% [markdown]
# ## When the stiffness ratio does not matter
#
# The map shows how evenly LZB distributes the energy over three balls, against k2/k1 and for three
# exponents. On the left it approaches the binary outcome (one ball takes all), on the right
# Moreau's, in waves. The larger the exponent, the further right is the transition.

# %%
valid = ji.validity_map(balls, v, exponents=(1.0, 1.5, 3.0))
print(valid)
ji.plot.validity_map(valid)

# %% [markdown]
# *Next: [methods of integration](07_methods_of_integration.ipynb).*
