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
# # A block on a shaken base: does it overturn?
#
# *Course, part 14. Before: [fit a motion](13_fit_a_motion.ipynb).*
#
# You will simulate a batch of motions in one call: a block that rocks freely, and blocks on a base
# that shakes with different accelerations.

# %%
# %matplotlib inline
import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import numpy as np

import jimpact as ji

block = ji.Block(0.2, 0.6)
ji.plot.system(block, block.touching(0.15), "A block rocks about one corner")

# %% [markdown]
# ## The batch
#
# A block on one corner falls back, hits the ground with the other corner, and keeps Housner's share
# of its angular velocity. It must not slip, so friction at rest is part of the motion. The base
# swings with 2 Hz and a given acceleration, in multiples of g. The first motion has a tilted block
# on a still base, the others a block at rest on a shaken base.
#
# Below width / height (here 1/3 g) the block does not move. This system has no contacts at the
# upper corners: if one of them reaches the ground, the motion ends with the status `out_of_range`,
# and the block has overturned.

# %%
e = ji.theory.housner_restitution(3.0)


@jax.jit
@jax.vmap
def rock(tilt, acceleration):
    amplitude = -acceleration * 9.80665 / (4 * jnp.pi) ** 2
    base = ji.HarmonicBase(amplitude, 2.0, jnp.pi / 2, "horizontal")
    height = 0.1 * jnp.sin(tilt) + 0.3 * jnp.cos(tilt)
    law = ji.RestitutionMatrix(ji.theory.rocking_matrix(e))
    block = ji.System(
        ji.Block(0.2, 0.6, corners="base"), gravity=True, base=base, friction=5.0
    )
    start = jnp.stack([amplitude, height, tilt])
    return ji.simulate(block, law, start, jnp.zeros(3), 3.0)


levels = np.array([0.0, 0.3, 0.4, 0.6, 0.8, 1.0, 1.4])
motions = rock(np.where(levels == 0, 0.15, 0.0), levels)
free = jax.tree.map(lambda x: x[0], motions)
print(free)
ji.plot.phase_portrait(
    free, 2, "Free rocking, angle", ["x [m]", "y [m]", "angle [rad]"]
)

# %%
for i, level in enumerate(levels[1:], 1):
    lane = jax.tree.map(lambda x, i=i: x[i], motions)
    most = np.degrees(np.nanmax(np.abs(lane.q[:, 2])))
    overturns = lane.to_dict()["status"] == "out_of_range"
    print(
        f"{level:.1f} g: "
        + ("overturns" if overturns else f"at most {most:.2f} degrees")
    )

# %% [markdown]
# Next: [robots from MuJoCo](15_robots_from_mujoco.ipynb).
