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
# # Fit a law to a measured Newton's cradle
#
# *Course, part 1. Before: [five minutes](00_five_minutes.ipynb). Next: [your own CSV
# file](02_your_own_csv.ipynb).*
#
# You will fit a law, read the report, see what one shot cannot determine, and check whether the
# stated errors are right.
#
# A hard ball strikes two equal ones that touch each other at rest. The measured velocities after
# the impact are from Brogliato, *Nonsmooth Mechanics* (2016), section 6.1.2.

# %%
# %matplotlib inline
from importlib.resources import files

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np
from matplotlib.figure import Figure

import jimpact as ji

balls = ji.chain([1.0, 1.0, 1.0])
measured = ji.read_experiments(files("jimpact") / "data" / "three_balls.csv")
print("before", measured.pre[0], "\nafter ", measured.post[0], "m/s")
ji.plot.system(balls, measured.pre[0], "Before the impact")

# %% [markdown]
# ## What is wrong with the data
#
# During the impact only forces between the balls act, so the total momentum is constant, and the
# energy cannot grow. The data violate both: each velocity has an error of at least about 0.014.
# Every law conserves momentum, so none can reproduce this part.

# %%
print("momentum after / before", measured.momentum_ratio(balls)[0])
print("energy   after / before", measured.energy_ratio(balls)[0])

# %% [markdown]
# ## One coefficient of restitution: LZB and Newton
#
# The law of Liu, Zhao and Brogliato (LZB) distributes the impulse over the contacts by their
# stiffness ratio (here 1, Hertz contacts). Its coefficient of restitution $e$ is the energetic one.
# A scalar parameter of a law is one value for all contacts.

# %%
lzb = ji.fit(ji.LZB(0.95), balls, measured, free="restitution")
print(lzb)

# %% [markdown]
# Most of the residual is the violation of momentum. If a third of the excess is subtracted from
# each velocity (the smallest change that restores momentum), the same $e$ leaves half the residual:

# %%
corrected = measured.momentum_corrected(balls)
lzb_corrected = ji.fit(ji.LZB(0.95), balls, corrected, free="restitution")
newton = ji.fit(ji.Newton(0.5), balls, measured)
for name, fit in (("LZB", lzb), ("LZB, corrected", lzb_corrected), ("Newton", newton)):
    print(
        f"{name:16s} e = {fit.value[0]:.4f} ± {fit.standard_error[0]:.4f}   rms {fit.rms:.4f} m/s"
    )

# %% [markdown]
# With Newton's law the two resting balls leave together for any $e$: it cannot disperse the energy
# (grey crosses).

# %%
ji.plot.fit(lzb, {"Newton fitted": newton}, title="Three balls, one shot")

# %% [markdown]
# ## What one shot cannot determine
#
# Give each contact its own $e$, and fit the stiffness ratio $k_2/k_1$, too. The three measured
# velocities satisfy conservation of momentum, so they determine two of the three parameters.

# %%
both_e = ji.LZB([0.95, 0.95], [1.0, 1.0])
three = ji.fit(both_e, balls, corrected)
print(f"rank {three.rank} of {len(three.names)}, rms {three.rms:.1e} m/s")
print("standard errors", three.standard_error)
print("\n".join(three.identifiability))

# %% [markdown]
# A profile shows the valley: fix the ratio, fit both $e$. Any ratio in a whole range reproduces the
# shot exactly; the range ends where an $e$ would exceed 1. The result of the fit above is one point
# of this valley, so its standard errors are infinite.

# %%
ratios = np.linspace(0.9, 1.4, 26)
profile = [
    ji.fit(
        ji.LZB([0.95, 0.95], [1.0, ratio]),
        balls,
        corrected,
        free={"restitution": True, "stiffness": False},
        starts=4,
    )
    for ratio in ratios
]
figure = Figure(figsize=(7, 5), layout="constrained")
top, bottom = figure.subplots(2, 1, sharex=True)
top.plot(ratios, [fit.rms for fit in profile], color="#0072B2")
top.set_ylabel("rms residual [m/s]")
for contact, colour in ((0, "#D55E00"), (1, "#009E73")):
    values = [fit.value[contact] for fit in profile]
    bottom.plot(ratios, values, color=colour, label=f"restitution[{contact + 1}]")
bottom.set(xlabel="stiffness ratio k2 / k1", ylabel="fitted e")
bottom.legend(frameon=False)
exact = [ratio for ratio, fit in zip(ratios, profile) if fit.rms < 1e-6]
print(f"reproduced exactly for every ratio from {min(exact):.2f} to {max(exact):.2f}")
figure

# %% [markdown]
# ## Known parameters from simulated shots
#
# All further data are **simulated**. Four kinds of shots, in which balls come from both sides,
# determine all three parameters; more shots of the first kind alone would not. The sum of squares
# has other minima, in which the contacts open and close in another order. The fit therefore starts
# from several points and lists where they end.

# %%
truth = ji.LZB([0.9, 0.95], [1.0, 1.5])
kinds = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, -1.0], [1.0, 0.5, 0.0]])
pre = np.tile(kinds, (2, 1))
noise = 0.01  # m/s
exact_post = np.array([ji.impact(truth, balls, v).velocity for v in pre])
start = ji.LZB([0.95, 0.95], [1.0, 1.0])


def simulated_shots(seed):
    error = noise * np.random.default_rng(seed).normal(size=pre.shape)
    return ji.Experiments(pre, exact_post + error)


first = ji.fit(start, balls, simulated_shots(0), starts=8)
print(first)

# %%
same = ji.Experiments(np.tile(kinds[:1], (8, 1)), np.tile(exact_post[:1], (8, 1)))
print("eight shots of the first kind: rank", ji.fit(start, balls, same).rank, "of 3")

# %% [markdown]
# ## Are the stated errors right?
#
# Repeat the simulated experiment, and count how often the 95 % confidence interval contains the
# true value. With 400 repetitions the count itself scatters: 95 % ± 1.1 %. Each fit starts once,
# from the fitted law (a start further away may end in another minimum).

# %%
true_value = np.array([0.9, 0.95, 1.5])
repeats = 400
many = [simulated_shots(seed) for seed in range(1, repeats + 1)]
fits = ji.fit_many(first.law, balls, many)  # side by side, in one compiled program
intervals = np.array([fit.confidence_interval(0.95) for fit in fits])
inside = (intervals[:, :, 0] <= true_value) & (true_value <= intervals[:, :, 1])
values = np.array([fit.value for fit in fits])
stated = np.array([fit.standard_error for fit in fits])
print(
    f"{repeats} simulated experiments, all converged: {all(fit.converged for fit in fits)}"
)
print(
    "parameter        true    mean   scatter  stated error  coverage of the 95 % interval"
)
for i, name in enumerate(fits[0].names):
    print(
        f"{name:15s} {true_value[i]:5.2f} {values[:, i].mean():7.4f} {values[:, i].std(ddof=1):8.4f}"
        f" {np.median(stated[:, i]):12.4f} {100 * inside[:, i].mean():10.1f} %"
    )
assert np.all(
    np.abs(inside.mean(axis=0) - 0.95) < 0.035
)  # three standard deviations of a count

# %%
figure = Figure(figsize=(8, 2.8), layout="constrained")
for i, axes in enumerate(figure.subplots(1, 3)):
    axes.hist(values[:, i], bins=30, color="#56B4E9")
    axes.axvline(true_value[i], color="black", lw=1)
    axes.set_xlabel(fits[0].names[i])
    axes.spines[["top", "right"]].set_visible(False)
figure

# %% [markdown]
# ## Exercises
#
# 1. Fit `ji.Binary`, collisions one after the other, to the measured shot. Which $e$ does it give, and
#    does it reproduce the shot as well as LZB?
# 2. Halve the noise of the simulated shots. What happens to the standard errors?
#
# Answers:

# %%
binary = ji.fit(ji.Binary(0.9), balls, corrected)
print(
    f"1. e = {binary.value[0]:.3f}, rms {binary.rms:.4f} m/s, LZB {lzb_corrected.rms:.4f} m/s"
)
noise = 0.005
finer = ji.fit(start, balls, simulated_shots(0), starts=8)
print(
    "2. errors over those before:",
    (finer.standard_error / first.standard_error).round(2),
)

# %% [markdown]
# *Next: [the same with your own file](02_your_own_csv.ipynb).*
