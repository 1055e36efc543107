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
# # Whole motions: between impacts, through them, and to rest
#
# *Course, part 5. Before: [the rocking block](04_rocking_block.ipynb). Next:
# [what the data can tell](06_what_the_data_can_tell.ipynb).*
#
# An impact law is one instant of a motion. `simulate` puts it back in: flights, impacts at located
# times, contacts that stay closed, and a ledger of the energy. You will learn to simulate bodies from
# release to rest, to differentiate the times of events, and to fit a law to a motion.

# %%
# %matplotlib inline
import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import numpy as np

import jimpact as ji

cradle = ji.cradle_system([0.1, 0.1, 0.1], length=0.15, diameter=0.025)
ji.plot.system(cradle, [-0.3, 0.0, 0.0], "One ball is lifted by 0.3 rad")

# %% [markdown]
# ## Newton's cradle over fifty swings
#
# One of three touching balls is lifted. At first the last one flies out; but e < 1, and impacts keep
# only the momentum: in the end all balls swing in phase, with a third of the energy.

# %%
period = 2 * np.pi * np.sqrt(0.15 / 9.80665)
law = ji.LZB(0.95, exponent=1.5)
motion = ji.simulate(cradle, law, [-0.3, 0, 0], [0.0, 0, 0], 50 * period, samples=1501)
print(motion)

# %%
names = ["ball 1", "ball 2", "ball 3"]
ji.plot.motion(motion, "Newton's cradle, 50 swings", names, cradle)

# %% [markdown]
# ## A bouncing ball: exact event times, and their derivative
#
# Infinitely many bounces in finite time: the sum is passed, and its end is known.

# %%
ball = ji.ball_system()


def bounce(e):
    motion = ji.simulate(ball, ji.Newton(e), [1.0], [0.0], 5.0)
    return motion.events.time[:20], motion


(times, motion), (slopes, _) = jax.jit(lambda e: jax.jvp(bounce, (e,), (1.0,)))(0.8)
first = np.sqrt(2 / 9.80665)
k = np.arange(20)
exact = first + 2 * first * np.cumsum(np.where(k > 0, 0.8**k, 0))
exact_slope = 2 * first * np.cumsum(np.where(k > 0, k * 0.8 ** (k - 1.0), 0))
print("event times off by", np.abs(times - exact).max(), "s")
print("their derivative in e by", np.abs(slopes - exact_slope).max(), "s")
end = motion.events.accumulation_end[motion.events.count - 1]
print("accumulation ends at", float(end), "exact", first * 1.8 / 0.2)

# %%
ji.plot.phase_portrait(motion, title="Bouncing ball, e = 0.8", system=ball)

# %% [markdown]
# ## A block rocks to rest, or is shaken: does it overturn?
#
# A block on one corner falls back, hits with the other corner, and keeps Housner's share of its
# angular velocity. It must not slip: friction at rest is part of the motion. The base swings with
# 2 Hz and a given acceleration, in multiples of g. One batch answers for a tilted block on a still
# base and for one that stands on a shaken base, for many accelerations at once. Below width / height
# nothing happens. The upper corners are no contacts of this system: a motion in which one of them
# reaches the ground ends there, `out_of_range`, and the block is overturned.

# %%
e = ji.theory.housner_restitution(3.0)


@jax.jit
@jax.vmap
def rock(tilt, acceleration):
    amplitude = -acceleration * 9.80665 / (4 * jnp.pi) ** 2
    base = ji.HarmonicBase(amplitude, 2.0, jnp.pi / 2, "horizontal")
    height = 0.1 * jnp.sin(tilt) + 0.3 * jnp.cos(tilt)
    law = ji.RestitutionMatrix(ji.theory.rocking_matrix(e))
    block = ji.block_system(0.2, 0.6, base=base, corners="base")
    start = jnp.stack([amplitude, height, tilt])
    return ji.simulate(block, law, start, jnp.zeros(3), 3.0, friction=5.0)


levels = np.array([0.0, 0.3, 0.4, 0.6, 0.8, 1.0, 1.4])
motions = rock(np.where(levels == 0, 0.15, 0.0), levels)
free = jax.tree.map(lambda x: x[0], motions)
print(free)
ji.plot.phase_portrait(free, 2, "Free rocking, angle", ["x [m]", "y [m]", "angle [rad]"])

# %%
for i, level in enumerate(levels[1:], 1):
    lane = jax.tree.map(lambda x, i=i: x[i], motions)
    most = np.degrees(np.nanmax(np.abs(lane.q[:, 2])))
    told = (
        "overturns" if lane.to_dict()["status"] == "out_of_range" else f"at most {most:.2f} degrees"
    )
    print(f"{level:.1f} g: {told}")

# %% [markdown]
# ## A basketball and a tennis ball: the gap decides
#
# Dropped together, the tennis ball on top. With a gap between them they collide one after another,
# without it at once: LZB then asks for the ratio of stiffnesses.

# %%
pair, falling = ji.column([0.06, 0.6]), [4.2, 4.2]  # kg from the top; m/s, downwards
ways = {
    "one after another": ji.Binary(0.9, order=(1, 0)),
    "at once, equally stiff": ji.LZB([0.9, 0.9], stiffness=[1.0, 1.0]),
    "at once, a soft basketball": ji.LZB([0.9, 0.9], stiffness=[1.0, 0.1]),
}
for name, law in ways.items():
    up = -ji.impact(law, pair, falling).velocity
    print(f"{name:27s} tennis ball {up[0]:5.2f} m/s, basketball {up[1]:5.2f} m/s, upwards")

# %% [markdown]
# ## A dimer on a vibrating plate
#
# The plate shakes with 2.5 g. This is the bundled study: `jimpact simulate shaken_dimer.toml --gif
# dimer.gif` animates it.

# %%
plate = ji.HarmonicBase(0.001, 25.0, direction="vertical")  # m, Hz
dimer = ji.dimer_system(radius=0.005, length=0.02, sphere_mass=0.005, rod_mass=0.0, base=plate)
motion = ji.simulate(dimer, ji.Moreau(0.6), [0.0, 0.008, 0.1], [0.0] * 3, 1.0, samples=201)
print(motion)
ji.plot.motion(motion, "Dimer on a vibrating plate", system=dimer)

# %% [markdown]
# ## Parameters from a motion
#
# The record is simulated here, with noise added: heights of a ball, 76 instants over 1.5 s, 2 mm. Event
# times follow the parameter, and so do the residuals: the fit has exact derivatives.

# %%
given = ([1.0], [0.0], 1.5)
seen = np.asarray(ji.simulate(ball, ji.Newton(0.8), *given, samples=76).q)
noisy = seen + 2e-3 * np.random.default_rng(0).normal(size=seen.shape)
print(ji.fit_motion(ball, ji.Newton(0.75), noisy, *given, sigma=2e-3))

# %% [markdown]
# *Next: [how much such data can tell](06_what_the_data_can_tell.ipynb).*
