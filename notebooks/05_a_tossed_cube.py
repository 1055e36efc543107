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
# # A tossed cube
#
# *Course, part 5. Before: [a restitution matrix](04_restitution_matrix.ipynb). Next: [the simplest
# law](06_the_simplest_law.ipynb).*
#
# An acrylic cube of 10 cm was tossed on a board 456 times and filmed 148 times a second
# (ContactNets, Pfrommer, Halm and Posa, 2020). For 400 impacts, on one, two or four corners and
# with friction, the velocities before and after are known with their errors. You will fit impact
# laws to a few of these impacts, **predict the others**, and see how accurate the laws are.

# %%
# %matplotlib inline
import time

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np
from matplotlib.figure import Figure

import jimpact as ji

began = time.perf_counter()
cube = ji.Box(
    [0.102] * 3,
    0.37,
    [9.57e-4, 9.57e-4, 9.09e-4],
    centre=[0, 0, 0.0057],
    rounding=0.0036,
)
figure = Figure(figsize=(6, 2.4), layout="constrained")
poses = {
    "one corner": [0.87, 0.34, 0.33, 0.13],
    "two corners": [0.92, 0.39, 0, 0],
    "four": [1, 0, 0, 0],
}
for axes, (name, e) in zip(figure.subplots(1, 3), poses.items()):
    pose = np.asarray(cube.touching(np.array(e) / np.linalg.norm(e)))
    (box,) = cube.outlines(pose, 0.0)
    (shadow,) = cube.shadows(pose)
    axes.plot(*shadow.T, color="0.85")
    axes.plot(*box.T, color="#0072B2")
    axes.set(aspect="equal", title=name)
    axes.set_axis_off()
figure

# %% [markdown]
# ## The data
#
# Each shot has its own scene: the pose determines which corners touch (those up to 2 mm above the
# lowest one) and the directions of inertia. Velocities are those of the centre of mass (m/s) and
# the angular velocity (rad/s), with standard errors before and after.
#
# Some tosses are in the source twice, rotated about the vertical. Such copies must not be predicted
# from each other. They have equal vertical velocities.

# %%
shots = ji.data.cube_impacts()
vertical = np.stack([shots.pre[:, 2], shots.post[:, 2]], axis=1)
close = np.abs(vertical[:, None] - vertical).max(axis=2) < 2e-4
copies = np.triu(close, 1).any(axis=0)
print(f"{len(shots.shots)} impacts, {copies.sum()} of them copies")
shots = shots.only(~copies)
one, two = (shots.only(shots.contacts == m) for m in (1, 2))
print(
    f"one corner {len(one.shots)}, two corners {len(two.shots)}; errors {one.sigma[0]}"
)
print(f"energy left: {np.quantile(one.energy_ratio(), [0.1, 0.5, 0.9]).round(2)}")

# %% [markdown]
# ## Fit eight impacts, predict the others
#
# Divide the tosses into four groups. Fit eight impacts on one corner of each group, and predict all
# impacts of the *other* groups. The parameters are a coefficient of restitution and one of
# friction. The laws are LZB, the law of Liu, Zhao and Brogliato (energetic restitution, slip may
# stop or reverse during the impact), and Moreau (kinematic restitution, Coulomb's law for the
# impulse; for one contact this is Newton's law).

# %%
groups = {
    m: np.array([int(s.split(":")[0]) % 5 for s in d.shots])
    for m, d in ((1, one), (2, two))
}
both = ("restitution", "friction")
# errors before the impact are small compared with those of the laws; without them the fit is faster
plain = ji.Experiments(
    one.pre, one.post, one.sigma, one.scenes, one.shots, units=one.units
)
few = [plain.only(np.flatnonzero(groups[1] == g)[:8]) for g in range(4)]
fits = {
    type(law).__name__: ji.fit_many(law, None, few, both)
    for law in (ji.LZB(0.5, friction=0.3), ji.Moreau(0.5, friction=0.3))
}
for name, found in fits.items():
    print(name, *(f"e = {f.value[0]:.3f}, mu = {f.value[1]:.3f};" for f in found))


# %% [markdown]
# The error of a prediction is its norm in the kinetic metric, relative to that of the velocity
# jump: $\|v^+_{law} - v^+\|_M / \|v^+ - v^-\|_M$.


# %%
def predicted(laws, data, group):
    """Errors (laws, impacts); nan where a law was fitted to the group of the impact."""
    scenes = jax.tree.map(lambda *x: np.stack(x), *data.scenes)
    after = [
        jax.vmap(ji.impact, in_axes=(None, 0, 0))(law, scenes, data.pre).velocity
        for law in laws
    ]
    mass = np.stack([np.diag(m) if m.ndim == 1 else m for m in scenes.mass])

    def size(v):
        return np.sqrt(np.einsum("ki,kij,kj->k", v, mass, v))

    off = np.array([size(v - data.post) for v in after]) / size(data.post - data.pre)
    return np.where(np.arange(len(laws))[:, None] != group, off, np.nan)


laws = {name: [f.law for f in found] for name, found in fits.items()}
errors = {name: predicted(own, one, groups[1]) for name, own in laws.items()}
apart = np.isin(
    one.shots, ji.data.cube_impacts(1, near=0.01).shots
)  # the next corner far away
for name, off in errors.items():
    alone = np.nanmedian(off[:, apart])
    print(
        f"{name}: median error {np.nanmedian(off):.1%}; the next corner 1 cm away: {alone:.1%}"
    )

# %%
figure = Figure(figsize=(6, 3), layout="constrained")
axes = figure.subplots()
for (name, off), colour in zip(errors.items(), ("#0072B2", "#D55E00")):
    off = np.sort(off[~np.isnan(off)])
    axes.plot(100 * off, np.linspace(0, 100, len(off)), color=colour, label=name)
axes.set(
    xlim=(0, 20),
    xlabel="error of a prediction [%]",
    ylabel="share of the impacts below [%]",
)
axes.legend(frameon=False)
figure

# %% [markdown]
# ## Two corners
#
# The same laws, without new parameters. Newton's law now prescribes the restitution of each corner,
# also of one that the other corner lifts. These few impacts (19) do not rank laws that differ by a
# percent: the page `docs/cube.md` compares laws on 105 impacts on two corners, with intervals.

# %%
laws["Newton"] = [ji.Newton(law.restitution, law.friction) for law in laws["Moreau"]]
for name, own in laws.items():
    print(f"{name}: median error {np.nanmedian(predicted(own, two, groups[2])):.1%}")

# %% [markdown]
# ## Is the law right?
#
# No: predictions have errors of a few percent, and the measurements are more accurate. `fit` reports
# this, and increases the standard errors. The scatter comes from the cube and the board (and from the
# 2 mm that decide which corners touch), not from the camera. Compare the increased errors with the
# scatter of the four fits, to impacts of different tosses. For the restitution they agree. The friction
# scatters three times as much as stated.

# %%
lzb = fits["LZB"]
print(*lzb[0].warnings, sep="\n")
values = np.array([f.value for f in lzb])
stated = np.array([f.standard_error for f in lzb])
print(
    "scatter of the four fits",
    values.std(axis=0, ddof=1),
    "stated",
    np.median(stated, axis=0),
)

# %%
assert np.nanmedian(errors["LZB"]) < np.nanmedian(errors["Moreau"]) < 0.07
assert any("Lack of fit" in line for line in lzb[0].warnings)
print(f"run time {time.perf_counter() - began:.0f} s")

# %% [markdown]
# *Next: [do you need such a law at all?](06_the_simplest_law.ipynb)*
