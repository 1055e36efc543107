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
# # Uncertain parameters and unknown gaps together
#
# *Course, part 9. Before: [Monte Carlo over gaps](08_monte_carlo_gaps.ipynb). Next: [a large run on
# Dask](10_a_large_run_on_dask.ipynb).*
#
# You will carry the errors of a fit over to a prediction, add unknown gaps, and find out which of
# the two limits the prediction.
#
# Three steel balls of one inch. A fit to earlier shots gave the restitution 0.92 ± 0.01 and the
# Hertz stiffness (1.20 ± 0.05) 10^10 N/m^1.5, with a correlation of -0.3. The balls were placed by
# hand: between them are gaps of 0 to 5 micrometres. How fast does the last ball leave?

# %%
# %matplotlib inline
import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import jimpact as ji

balls = ji.chain([0.0665] * 3, gaps=[0.0, 0.0])  # kg
before = [1.0, 0.0, 0.0]  # m/s
ji.plot.system(ji.chain([0.0665] * 3, gaps=[1e-6, 1e-6]), before, "Gaps not to scale")

# %% [markdown]
# ## Describe what is uncertain
#
# Gaps matter only for a law in which contacts take time: `Compliant`. The gap scale delta_c is the
# indentation up to which a gap matters. Here it is six times the largest gap, so the gaps are neither
# negligible nor decisive.

# %%
mean = np.array([0.92, 1.2e10])
error = np.array([0.01, 0.05e10])
covariance = np.outer(error, error) * np.array([[1.0, -0.3], [-0.3, 1.0]])
nominal = ji.Compliant(ji.Bistiffness(mean[1], 1.5, mean[0]))
scale = ji.theory.gap_scale(balls, nominal, before)
print(scale)

# %% [markdown]
# Correlated parameters need a function from a random key to a law. It must be written with
# `jax.numpy`, because it is compiled and runs for many keys at once. A restitution above 1 is not a
# law; `minimum` prevents it.

# %%
root = jnp.asarray(np.linalg.cholesky(covariance))


def fitted_law(key):
    e, k = jnp.asarray(mean) + root @ jax.random.normal(key, (2,))
    return ji.Compliant(ji.Bistiffness(k, 1.5, jnp.minimum(e, 1.0)))


gaps = ji.Uniform(0.0, 5e-6)

# %% [markdown]
# ## Three runs
#
# Only the parameters are random, only the gaps, and both. (If the parameters were independent,
# `ji.RandomLaw(law, restitution=...)` would do without a function.)

# %%
runs = {
    "parameters": ji.monte_carlo(fitted_law, balls, before, samples=8192),
    "gaps": ji.monte_carlo(nominal, balls, before, gaps=gaps, samples=8192),
    "both": ji.monte_carlo(fitted_law, balls, before, gaps=gaps, samples=8192),
}
print("random      mean v+ [m/s]              standard deviation [m/s]")
for name, run in runs.items():
    columns = "".join(f"{x:9.4f}" for x in (*run.mean, *run.std))
    print(f"{name:12s}{columns}")

# %% [markdown]
# The variances of small independent causes add up. If they do not, the gaps act differently for
# different parameters.

# %%
parameters, gaps_only, both = (run.std**2 for run in runs.values())
print(
    "sum of the two variances / variance of both:",
    ((parameters + gaps_only) / both).round(2),
)
print("share of the gaps:", (gaps_only / (parameters + gaps_only)).round(3))

# %% [markdown]
# ## The prediction
#
# The distribution of gaps is uniform, so that of the velocities is not normal: quote quantiles
# instead of a standard deviation.

# %%
figure = Figure(figsize=(7, 3), layout="constrained")
panels = figure.subplots(1, 3)
for i, axes in enumerate(panels):
    for (name, run), colour in zip(runs.items(), ("#0072B2", "#D55E00", "black")):
        counts = run.counts[i, 1:-1].reshape(-1, 20).sum(axis=1)  # 50 wide bins of 1000
        edges = run.edges[i, ::20]
        axes.stairs(
            counts / counts.sum() / np.diff(edges), edges, color=colour, label=name
        )
    axes.set(xlabel=f"ball {i + 1} after [m/s]", yticks=[])
panels[0].legend(frameon=False)
figure

# %%
low, high = runs["both"].quantile([0.025, 0.975])[:, 2]
print(f"the last ball leaves with {low:.3f} to {high:.3f} m/s (95 %)")

# %% [markdown]
# The gaps limit the prediction of balls 1 and 2; a better fit would not help there. The last ball hardly
# depends on the gaps: more shots would improve its prediction.
#
# *Next: [millions of samples on several processes](10_a_large_run_on_dask.ipynb).*
