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
# # Five minutes with jimpact
#
# *Course, part 0. Next: [fit a law to a measured cradle](01_fit_newtons_cradle.ipynb).*
#
# One ball strikes two that touch. You will predict the outcome, see why the coefficient of
# restitution alone does not determine it, differentiate it, and fit a law to a measurement.

# %%
# %matplotlib inline
import jax

jax.config.update("jax_enable_x64", True)  # jimpact never changes JAX's settings itself

import jax.numpy as jnp

import jimpact as ji

balls, before = ji.chain([1.0, 1.0, 1.0]), jnp.array([1.0, 0.0, 0.0])  # kg, m/s
ji.plot.system(balls, before, "Newton's cradle: before the impact")

# %% [markdown]
# ## Predict
#
# `chain` describes which bodies touch, a *law* describes the contacts. In the law of Liu, Zhao and
# Brogliato, `LZB`, the contacts are springs during the impact. `restitution` is the square root of
# the share of energy that each returns, only ratios of `stiffness` matter, and `exponent` 1.5 is
# Hertz's contact of spheres.

# %%
law = ji.LZB(restitution=0.95, stiffness=[1.0, 1.0], exponent=1.5)
out = ji.impact(law, balls, before)
print(ji.summary(out, balls, before))

# %% [markdown]
# What are the forces during the impact? With stiffnesses in SI units the history has a time scale:
# two hard balls of 1 kg touch for a quarter of a millisecond, and the second contact opens a little
# later.

# %%
hard = ji.LZB(restitution=0.95, stiffness=[1e10, 1e10], exponent=1.5)  # N / m^1.5
ji.plot.history(ji.history(hard, balls, before), "Forces during the impact")

# %% [markdown]
# ## Compare
#
# Four laws with the same coefficient, and a measured shot (dashed lines). With Newton's law the two
# struck balls leave together. In binary collisions, one pair after another, almost all momentum
# goes to the last ball.

# %%
laws = {
    "LZB": law,
    "Newton": ji.Newton(0.95),
    "Moreau": ji.Moreau(0.95),
    "Binary": ji.Binary(0.95),
}
measured = [-0.0605, 0.1049, 0.9978]  # m/s
comparison = ji.compare(balls, before, laws)
print(comparison)
ji.plot.comparison(comparison, measured, "One shot, four laws")

# %% [markdown]
# ## Differentiate
#
# Laws, scenes and velocities are pytrees: `jax.jit`, `jax.vmap` and `jax.grad` work with all of
# them. How does the velocity of the last ball change with the stiffness ratio of the two contacts?


# %%
@jax.jit
@jax.vmap
@jax.value_and_grad
def last(ratio):
    return ji.impact(ji.LZB(0.95, jnp.stack([1.0, ratio])), balls, before).velocity[2]


ratios = jnp.array([0.25, 1.0, 4.0])
for ratio, v, slope in zip(ratios, *last(ratios)):
    print(f"k2/k1 = {ratio:4.2f}: v3 = {v:.4f} m/s, d v3 / d(k2/k1) = {slope:+.4f} m/s")

# %% [markdown]
# ## Fit
#
# Which coefficient reproduces the measurement best, and how accurately is it known? `print` shows a
# report. It warns that these data break the conservation of momentum by 4 %.

# %%
shots = ji.Experiments(pre=[before], post=[measured])
fit = ji.fit(ji.LZB(0.9), balls, shots, free="restitution", starts=1)
print(fit)

# %% [markdown]
# ## Next steps
#
# For your own data start with `jimpact new fit`, which creates a study, or with the notebook [your
# own CSV file](02_your_own_csv.ipynb). The course has four parts:
#
# - **Fits**: [this fit in detail](01_fit_newtons_cradle.ipynb), [your own CSV
#   file](02_your_own_csv.ipynb), [what the data can tell](03_what_the_data_can_tell.ipynb), [a
#   restitution matrix](04_restitution_matrix.ipynb), [a tossed cube](05_a_tossed_cube.ipynb)
# - **Choices**: [the simplest law](06_the_simplest_law.ipynb), [methods of
#   integration](07_methods_of_integration.ipynb)
# - **Uncertainty**: [random gaps](08_monte_carlo_gaps.ipynb), [parameters and
#   gaps](09_parameters_and_gaps.ipynb), [a large run on Dask](10_a_large_run_on_dask.ipynb)
# - **Motions**: [the rocking block](11_rocking_block.ipynb), [whole
#   motions](12_whole_motions.ipynb), [a fit to a motion](13_fit_a_motion.ipynb), [a shaken
#   block](14_a_shaken_block.ipynb)
