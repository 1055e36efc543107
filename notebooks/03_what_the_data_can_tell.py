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
# # What the data can tell
#
# *Course, part 3. Before: [your own CSV file](02_your_own_csv.ipynb). Next: [a restitution
# matrix](04_restitution_matrix.ipynb).*
#
# One ball strikes two others. The velocities after the impact depend on the restitution and on the
# ratio of the two stiffnesses. How well does a shot determine them, and which shot should be next?
# You will read **profile likelihoods**, see a shot that several stiffness ratios reproduce equally
# well, and let the fit **design** the next experiment.

# %%
# %matplotlib inline
import time

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import jimpact as ji

began = time.perf_counter()
balls = ji.chain([1.0, 1.0, 1.0])
ji.plot.system(balls, [1.0, 0.0, 0.0], "A striker, two balls at rest that touch")

# %% [markdown]
# ## A profile is the interval
#
# All shots here are **simulated**, with an error of 0.01 m/s, so that we know the truth: $e = 0.95$
# at both contacts, $k_2/k_1 = 3$. The fit has two parameters: one $e$ for both contacts, and the
# ratio.

# %%
sigma = 0.01
both = {"restitution": [1, 1], "stiffness": [0, 1]}  # one e; the ratio


def law(e, ratio):
    return ji.LZB(e * np.ones(2), jnp.stack([1.0, ratio]))


def shots(law, pre, seed=0):
    """Simulated shots with errors."""
    pre = np.atleast_2d(pre)
    exact = np.array([ji.impact(law, balls, v).velocity for v in pre])
    noise = np.random.default_rng(seed).normal(size=exact.shape)
    return ji.Experiments(pre, exact + sigma * noise, sigma)


one = shots(law(0.95, 3.0), [1.0, 0.0, 0.0])
fit = ji.fit(law(0.9, 1.0), balls, one, both)
print(fit)

# %% [markdown]
# Standard errors assume that the sum of squares is a parabola. A profile does not: it fixes one
# parameter, fits the other, and shows how much worse the fit becomes. The values below the line are
# the 95 % interval.


# %%
def picture(profiles, truths):
    figure = ji.plot.profiles(profiles)
    for axes, truth in zip(figure.axes, truths):
        axes.axvline(truth, color="#D55E00", lw=1)
    return figure


profiles = ji.profile(fit)
picture(profiles, [0.95, 3.0])

# %% [markdown]
# ## Several ratios for one shot
#
# The velocities are not monotonic functions of the stiffness ratio: if the second contact is much
# stiffer, the balls separate and strike again, in another order. Let $e = 1$ be known, and suppose
# that the camera saw only the ball in the middle. The band shows its measured velocity.

# %%
ratios = np.geomspace(0.5, 100, 256)
strike = np.array([1.0, 0.0, 0.0])
v_plus = jax.vmap(lambda r: ji.impact(law(1.0, r), balls, strike).velocity)(ratios)
truth = 20.0
full = shots(law(1.0, truth), strike)
partial = ji.Experiments(full.pre, [[np.nan, full.post[0, 1], np.nan]], sigma)
figure = Figure(figsize=(6, 3), layout="constrained")
axes = figure.subplots()
for i, colour in enumerate(("#0072B2", "#D55E00", "#009E73")):
    axes.semilogx(ratios, v_plus[:, i], color=colour, label=f"ball {i + 1}")
axes.axhspan(
    *(partial.post[0, 1] + np.array([-2, 2]) * sigma), color="#D55E00", alpha=0.2, lw=0
)
axes.set(xlabel="stiffness ratio $k_2/k_1$", ylabel="velocity after [m/s]")
axes.legend(frameon=False)
figure

# %%
ratio_only = {"restitution": [0, 0], "stiffness": [0, 1]}
limits = {"stiffness": (0.5, 100.0)}
partial_fit = ji.fit(law(1.0, 5.0), balls, partial, ratio_only, bounds=limits)
low, high = partial_fit.confidence_interval()[0]
(union,) = ji.profile(partial_fit)
print(
    f"standard error: {low:.1f} to {high:.1f};  profile: {union.words};  truth {truth}"
)
assert any(low <= truth <= high for low, high in union.intervals)
picture([union], [truth])

# %% [markdown]
# All ratios in these pieces reproduce the shot within its error. More shots of the same kind would
# make the pieces narrower, but would not remove one. A camera for the other balls would.
#
# ## The next experiment
#
# Which shot would help most? A shot has the information `J^T J`, J the derivatives of its residuals
# over their errors. Of 64 candidates of at most 1 m/s we take the one that leaves the smallest error
# of the ratio, then the best second one. (Directions that the data do not see yet get a trace of
# information, so that matrices can be inverted.)

# %%
rng = np.random.default_rng(1)
candidates = rng.uniform(-1, 1, (64, 3)).round(2)
candidates[
    np.argsort(-candidates, axis=1)[:, 0] == 2
] *= -1  # the last must not run away
pool = ji.Experiments(candidates, np.zeros_like(candidates), sigma)
problem = ji.FitProblem.from_shots(fit.law, balls, pool, both)
rows = np.asarray(problem.jacobian(fit.value)).reshape(64, 3, -1)  # of each candidate
each = np.einsum("kip,kiq->kpq", rows, rows)
known = np.asarray(fit.problem.jacobian(fit.value))
known = known.T @ known + 1e-9 * each.sum(axis=0)
plan = []
for _ in range(2):
    errors = np.sqrt(np.linalg.inv(known + each)[:, 1, 1])
    plan.append(int(errors.argmin()))
    known = known + each[plan[-1]]
    print(f"then shot {plan[-1] + 1}: stiffness[2] +- {errors.min():.2g}")

# %%
more = np.concatenate([one.pre, candidates[plan]])
after = ji.fit(fit.law, balls, shots(law(0.95, 3.0), more, seed=1), both)
print(
    f"shot 1 alone {fit.standard_error}, with the two planned ones {after.standard_error}"
)
print("values", after.value, "truth", [0.95, 3.0])
assert after.standard_error[1] < 0.7 * fit.standard_error[1]
ji.plot.system(balls, candidates[plan[0]], "The shot to do next")

# %%
print(f"run time {time.perf_counter() - began:.0f} s")

# %% [markdown]
# ## Exercises
#
# 1. How exact a camera determines the ratio to 0.05 with the first shot alone?
# 2. Would ten repetitions of that shot do the same?
#
# Answers:

# %%
needed = sigma * 0.05 / fit.standard_error[1]
print(f"1. errors are proportional to sigma: {needed:.4f} m/s")
ten = ji.fit(fit.law, balls, shots(law(0.95, 3.0), np.tile(strike, (10, 1))), both)
print(
    f"2. {ten.standard_error[1]:.3f}: as the root of their number, if errors are independent"
)

# %% [markdown]
# *Next: [a law that can describe any shot, and its limits](04_restitution_matrix.ipynb).*
