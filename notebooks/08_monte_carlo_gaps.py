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
# # Monte Carlo over initial gaps
#
# *Course, part 8. Before: [methods of integration](07_methods_of_integration.ipynb). Next:
# [parameters and gaps](09_parameters_and_gaps.ipynb).*
#
# You will see how large a gap must be to matter, draw random gaps, read the statistics, and check
# when a linearization is enough.
#
# Two small balls strike a large one from both sides. In rigid-body theory the outcome jumps with
# the order of the two collisions. Real contacts are compliant, and the jump is a smooth crossover,
# about two indentations wide.

# %%
# %matplotlib inline
import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import jimpact as ji

small, large = 0.0167, 0.0669  # kg: steel, radii 8 mm and half an inch
balls = ji.chain([small, large, small], gaps=[0.0, 0.0])
v = jnp.array([1.0, 0.0, -1.0])
law = ji.Compliant(ji.Hertz(1.06e10))  # N/m^1.5
scale = ji.theory.gap_scale(balls, law, v)
print(scale)
ji.plot.system(
    ji.chain([small, large, small], gaps=[1e-5, 1e-5]), v, "Gaps not to scale"
)

# %% [markdown]
# ## The crossover
#
# The horizontal axis is gap 1 minus gap 2 in units of the gap scale. On the left ball 1 has left
# before ball 3 arrives: this is the binary outcome (-3/5, -4/25, 31/25) of masses (m/4, m, m/4). In
# the middle both strike together: (-1, 0, 1).

# %%
delta = float(scale.delta[0])
offset = jnp.linspace(-4.0, 4.0, 161)
curve = ji.theory.crossover(balls, law, v, offset)
velocities = np.asarray(curve.velocity)
figure = Figure(figsize=(7, 4), layout="constrained")
axes = figure.subplots()
for i in range(3):
    axes.plot(offset, velocities[:, i], label=f"ball {i + 1}")
for value in (-0.6, -0.16, 1.24):
    axes.axhline(value, color="0.6", lw=0.8, ls="--")
    axes.axhline(-value, color="0.6", lw=0.8, ls=":")
axes.set_xlabel("(gap 1 - gap 2) / gap scale")
axes.set_ylabel("velocity after the impact [m/s]")
axes.legend(frameon=False)
figure

# %%
print("middle", velocities[80].round(6))
print("left  ", velocities[0].round(4), " binary (-0.6, -0.16, 1.24)")

# %% [markdown]
# ## Gaps known to some micrometres
#
# Let the gaps be random, uniform up to four gap scales. Each sample is one impact; `vmap` computes
# a chunk of samples at once.

# %%
gaps = ji.Uniform(0.0, 4 * delta)
result = ji.monte_carlo(law, balls, v, gaps=gaps, samples=20_000, key=0)
print(result)

# %%
ji.plot.monte_carlo(result, "gaps uniform up to four gap scales")

# %% [markdown]
# ## Where a linearization fails
#
# The Jacobian of the outcome with respect to the gaps gives the spread to first order. It is
# accurate for gaps that scatter by much less than the gap scale, and wrong across a crossover.

# %%
jacobian = jax.jit(
    jax.jacfwd(lambda gaps: ji.impact(law, ji.chain(balls.mass, gaps=gaps), v).velocity)
)
base = 6 * delta  # both open, closing together
centre = jnp.array([base, base])
slope = np.asarray(jacobian(centre)) * delta
print("d v+ / d gap, per gap scale:\n", slope.round(3))
for spread in (0.01, 0.1, 1.0):
    normal = ji.Normal(base, spread * delta)
    sampled = ji.monte_carlo(law, balls, v, gaps=normal, samples=8192, key=1)
    linear = np.sqrt(np.diag(slope @ slope.T)) * spread
    print(
        f"gaps scatter by {spread:4.2f} gap scales: std of v+ sampled",
        np.sqrt(np.diag(sampled.covariance)).round(4),
        "linear",
        linear.round(4),
    )

# %% [markdown]
# *Next: [uncertain parameters and gaps together](09_parameters_and_gaps.ipynb).*
