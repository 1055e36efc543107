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
# *Course, part 2. Before: [fit a law](01_fit_newtons_cradle.ipynb). Next:
# [speed, accuracy, stability](03_speed_accuracy_stability.ipynb).*
#
# You will learn how large a gap must be to matter, to draw gaps at random and read the statistics, and
# where a linearization is enough.
#
# Two small balls strike a large one from both sides. Rigid-body theory has the outcome jump with
# the order of the two collisions. Real contacts are compliant: the jump is a smooth crossover,
# about two indentations wide. Here is how wide that is for steel, what it does to the
# statistics when gaps are only known to some micrometres, and where a linearization in the gaps
# fails.

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
scale = ji.gap_scale(balls, law, v)
print(scale)
ji.plot.system(ji.chain([small, large, small], gaps=[1e-5, 1e-5]), v, "Gaps not to scale")

# %% [markdown]
# ## The crossover
#
# Gap 1 minus gap 2 in units of the gap scale. Far to the left ball 1 has long finished when
# ball 3 arrives: the binary outcome (-3/5, -4/25, 31/25) of masses (m/4, m, m/4). In the middle
# both strike together: (-1, 0, 1).

# %%
delta = float(scale.delta[0])
offset = jnp.linspace(-4.0, 4.0, 161)
curve = ji.crossover(balls, law, v, offset)
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
# The gaps are random, uniform up to a few gap scales. Every sample is one impact; the chunks are
# computed with `vmap`, their moments merged in float64. With `folder=` a run can be interrupted
# and goes on where it stopped, with the same result bit by bit.

# %%
gaps = ji.Uniform(0.0, 4 * delta)
found = ji.monte_carlo(law, balls, v, gaps=gaps, samples=20_000, key=0)
print(found)

# %%

ji.plot.monte_carlo(found, "gaps uniform up to four gap scales")

# %% [markdown]
# ## Where a linearization fails
#
# The Jacobian of the outcome in the gaps gives the spread to first order. It is right for gaps
# that scatter by much less than the gap scale, and says nothing across a crossover.

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
# *Next: [which law, which method, how exact](03_speed_accuracy_stability.ipynb).*
