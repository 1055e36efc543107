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
# One ball strikes two that touch. You will predict what follows, see why the coefficient of
# restitution alone does not decide it, differentiate the outcome, and fit a law to a measurement.

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
# `chain` says which bodies touch, a *law* says what a contact does. `LZB` lets the contacts be springs
# for the instant of the impact: `restitution` is the square root of the energy that each gives back,
# `stiffness` only counts in ratios, `exponent` 1.5 is Hertz's contact of spheres.

# %%
law = ji.LZB(restitution=0.95, stiffness=[1.0, 1.0], exponent=1.5)
out = ji.impact(law, balls, before)
print(ji.summary(out, balls, before))

# %% [markdown]
# What happened meanwhile? With stiffnesses in SI units the history has a time scale: two hard balls of
# 1 kg touch for a quarter of a millisecond, and the second contact lets go a tenth later.

# %%
hard = ji.LZB(restitution=0.95, stiffness=[1e10, 1e10], exponent=1.5)  # N / m^1.5
ji.plot.history(ji.history(hard, balls, before), "Forces during the impact")

# %% [markdown]
# ## Compare
#
# The same coefficient, four laws, and what was measured on such a shot (the dashed lines). Newton's law
# lets the two struck balls leave together; colliding pair by pair, all goes to the last one.

# %%
laws = {
    "LZB": law,
    "Newton": ji.Newton(0.95),
    "Moreau": ji.Moreau(0.95),
    "Binary": ji.Binary(0.95),
}
measured = [-0.0605, 0.1049, 0.9978]  # m/s
found = ji.compare(balls, before, laws)
print(found)
ji.plot.comparison(found, measured, "One shot, four laws")

# %% [markdown]
# ## Differentiate
#
# Laws, scenes and velocities are pytrees: `jax.jit`, `jax.vmap` and `jax.grad` go through all of them.
# How does the velocity of the last ball change with the stiffness ratio of the two contacts?


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
# Which coefficient explains the measurement best, and how well is it known? `print` gives a report: it
# says, too, that these data break the conservation of momentum by 4 %.

# %%
shots = ji.Experiments(pre=[before], post=[measured])
fit = ji.fit(ji.LZB(0.9), balls, shots, free="restitution", starts=1)
print(fit)

# %% [markdown]
# ## From here
#
# Your own data: `jimpact new fit` writes a study to start from. The course goes on with
# [this fit in earnest](01_fit_newtons_cradle.ipynb), [random gaps](02_monte_carlo_gaps.ipynb),
# [speed and accuracy](03_speed_accuracy_stability.ipynb), [a rocking block](04_rocking_block.ipynb),
# [whole motions](05_whole_motions.ipynb), [what data can tell](06_what_the_data_can_tell.ipynb),
# [a restitution matrix](07_restitution_matrix.ipynb) and [a tossed cube](08_a_tossed_cube.ipynb).
