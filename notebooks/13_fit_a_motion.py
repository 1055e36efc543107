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
# # Event times, their derivatives, and a fit to a motion
#
# *Course, part 13. Before: [whole motions](12_whole_motions.ipynb). Next: [a shaken
# block](14_a_shaken_block.ipynb).*
#
# You will compare the event times of a bouncing ball and their derivatives with closed forms, and
# use these derivatives to fit the restitution to measured heights.

# %%
# %matplotlib inline
import jax

jax.config.update("jax_enable_x64", True)

import numpy as np

import jimpact as ji

ball = ji.System(ji.Column([1.0]), gravity=True)
ji.plot.system(ball, [1.0], "A ball is dropped from 1 m")

# %% [markdown]
# ## Event times and their derivative
#
# The ball bounces infinitely often in finite time. The simulation ends this sequence with an
# `accumulation` and states when the sequence would end.

# %%


def bounce(e):
    motion = ji.simulate(ball, ji.Newton(e), [1.0], [0.0], 5.0)
    return motion.events.time[:20], motion


(times, motion), (slopes, _) = jax.jit(lambda e: jax.jvp(bounce, (e,), (1.0,)))(0.8)
first = np.sqrt(2 / 9.80665)
k = np.arange(20)
exact = first + 2 * first * np.cumsum(np.where(k > 0, 0.8**k, 0))
exact_slope = 2 * first * np.cumsum(np.where(k > 0, k * 0.8 ** (k - 1.0), 0))
print("largest error of the event times", np.abs(times - exact).max(), "s")
print("largest error of their derivative in e", np.abs(slopes - exact_slope).max(), "s")
end = motion.events.accumulation_end[motion.events.count - 1]
print("accumulation ends at", float(end), "s, exact", first * 1.8 / 0.2)

# %%
ji.plot.phase_portrait(motion, title="Bouncing ball, e = 0.8", system=ball)

# %% [markdown]
# ## Fit the restitution to heights
#
# The record is **simulated**: 76 heights over 1.5 s, with an error of 2 mm. Event times depend on
# the parameter, and so do the residuals; the fit uses exact derivatives.

# %%
start = ([1.0], [0.0], 1.5)
exact_heights = np.asarray(ji.simulate(ball, ji.Newton(0.8), *start, samples=76).q)
measured = exact_heights + 2e-3 * np.random.default_rng(0).normal(
    size=exact_heights.shape
)
fit = ji.fit_motion(ball, ji.Newton(0.75), measured, *start, sigma=2e-3)
print(fit)

# %%
assert np.abs(times - exact).max() < 1e-9
assert abs(fit.value[0] - 0.8) < 4 * fit.standard_error[0]

# %% [markdown]
# *Next: [does a block on a shaken base overturn?](14_a_shaken_block.ipynb)*
