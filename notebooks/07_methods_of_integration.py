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
# # Methods of integration: accuracy, speed, and where they fail
#
# *Course, part 7. Before: [the simplest law](06_the_simplest_law.ipynb). Next: [Monte Carlo over
# gaps](08_monte_carlo_gaps.ipynb).*
#
# You will read a chart of error against time, and a map of the settings at which a method fails.
#
# `LZB`, the law of Liu, Zhao and Brogliato, is a differential equation. Its right-hand side changes
# when a contact closes, turns from compression to expansion, or opens. The default method ends its
# steps at these events. What does that accuracy cost, compared with fixed steps?

# %%
# %matplotlib inline
import jax

jax.config.update("jax_enable_x64", True)

import numpy as np

import jimpact as ji

balls, v = ji.chain([1.0, 1.0, 1.0]), [1.0, 0.0, 0.0]
ji.plot.system(balls, v, "Three equal balls")

# %% [markdown]
# ## Error against time
#
# The chart shows the error against the time of one impact in a batch, and against evaluations of
# the force. Laws without stiffness appear as points: their error is that of the model, and no step
# size reduces it.

# %%
law = ji.LZB(0.9, [1.0, 1.0], 1.5)
settings = {"time": [1e-4, 1e-6, 1e-8], "rk4": [0.1, 0.03, 0.01]}
laws = {"moreau": ji.Moreau(0.9), "binary": ji.Binary(0.9)}
options = {"batch": 64, "repeats": 3, "gradients": False, "durations": False}
chart = ji.work_precision(law, balls, v, list(settings), settings, laws, **options)
print(chart)

# %%
ji.plot.work_precision(chart)

# %% [markdown]
# ## Where methods fail
#
# A stability map varies one property at a time, starting from three Hertz balls with e = 0.9. Each
# point is right, flagged by a status, or wrong.

# %%
axes = {
    "restitution": [0.0, 1e-3, 0.05, 0.3, 0.9, 1.0],
    "stiffness_ratio": np.logspace(-6, 6, 7),
}
stable = ji.stability_map(["time", "rk4"], axes, max_steps=3000)
print(stable)

# %%
ji.plot.stability_map(stable)

# %% [markdown]
# Fixed steps fail for small restitution and for stiff contacts. The default method is right, or
# reports a status.
#
# *Next: [gaps of micrometres that decide](08_monte_carlo_gaps.ipynb).*
