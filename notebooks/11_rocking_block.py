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
# # The rocking block
#
# *Course, part 11. Before: [a large run on Dask](10_a_large_run_on_dask.ipynb). Next: [whole
# motions](12_whole_motions.ipynb).*
#
# You will see how the shape of a block determines its motion after an impact, what a kinetic angle
# is, and how Housner's value becomes a restitution matrix.
#
# A block rotates about its left corner A and hits the ground with its right corner B. Both corners
# touch, so this is a multiple impact. Does the block continue about B (rocking), turn back about A
# (half-rocking), or leave the ground (free)?

# %%
# %matplotlib inline
import jax

jax.config.update("jax_enable_x64", True)

import numpy as np

import jimpact as ji

block = ji.Block(width=1.0, height=2.0)
ji.plot.system(
    block, block.touching(0.1), "Rocking about A, the left corner; B comes down"
)

# %% [markdown]
# ## Dispersion is a V over the kinetic angle
#
# One angle describes the shape of the block, a = height / width: $\cos\theta_{12} = -(a^2 - 2) /
# (a^2 + 4)$. It is 60 degrees for a flat sheet and 180 degrees for a standing needle. The law is
# that of Liu, Zhao and Brogliato (LZB) with Hertz contacts of equal stiffness and Coulomb friction
# at both corners. Before the impact B approaches with 1, A rests, and nothing slips.

# %%
mu, e = [0.0, 0.1, 0.3, 0.8], [0.1, 0.3, 0.5, 0.7, 0.9, 1.0]
shapes = np.linspace(0.35, 4.5, 60)
result = ji.theory.rocking_dispersion(shapes, mu, e)
print(result)

# %%
# |d| = |y_A'+ / y_B'-|
ji.plot.rocking_dispersion(
    result, "Velocity of A after over velocity of B before, by LZB"
)

# %% [markdown]
# The curve is a V with two deviations. At the kink on the right (mu = 0.3, 112 degrees) B begins to
# stick. On the left, for e up to about 0.3, A rebounds late and weakly in very wide blocks, so the
# curve turns down again.

# %% [markdown]
# ## Friction alone determines the critical angle at the tip
#
# At the tip the impact at B does not accelerate A, so the contact A is never pressed, and neither e
# nor stiffness nor exponent matters. Without friction this is at 90 degrees; with enough friction
# (B sticks) at 70.5 degrees, where Housner's value is zero. Left of the tip the block is wide: the
# impact at B presses A down, and A rebounds. Right of it the block is slender: the impact at B
# lifts A at once.

# %%
c = np.cos(np.asarray(ji.theory.critical_kinetic_angle(mu)))
tips = np.sqrt((2 - 4 * c) / (1 + c))  # as aspects
off = np.arange(-7, 8) / 7000
near = ji.theory.rocking_dispersion((tips[:, None] * (1 + off)).ravel(), mu, e)
size = np.abs(np.asarray(near.dispersion)).reshape(4, 15, 4, 6)
print(
    "mu   critical angle   a_c      where |d| is least, in (a - a_c) / a_c, by e; |d| there"
)
for j, m in enumerate(mu):
    least = off[size[j, :, j].argmin(axis=0)]
    angle = np.degrees(np.arccos(c[j]))
    print(
        f"{m:3.1f} {angle:9.3f} deg {tips[j]:10.5f}   {least}   {size[j, :, j].min():.0e}"
    )

# %% [markdown]
# The tip is at the same place for all six restitutions. (`ji.theory.search_critical_angle` finds it
# from impacts alone, to 1e-8 rad.)

# %% [markdown]
# ## Rest, rocking, half-rocking, free
#
# By convention a corner stays on the ground if it leaves with at most 5 % of the approach. Another
# value moves the borders. With LZB the striking corner rebounds with about e of its speed, so it
# stays only if e is small. Slender, nearly plastic blocks rock; half-rocking is a band around the
# critical angle; after most impacts both corners leave the ground for a moment.

# %%
levels = np.linspace(0.02, 0.24, 12)
field = ji.theory.rocking_dispersion(np.linspace(0.6, 2.5, 40), [0.0, 0.3, 0.8], levels)
print(field)
ji.plot.rocking_outcomes(field, "Motion of the block after the impact")

# %% [markdown]
# ## Housner's value, and a restitution matrix of rocking
#
# Housner assumes that B neither slips nor rebounds. Then angular momentum about B is conserved, and
# $\dot\theta^+ = e_\theta \dot\theta^-$ with $e_\theta = (2 a^2 - 1) / (2 (a^2 + 1))$. LZB with e =
# 0 and enough friction agrees. Without friction the block keeps less. `ji.theory.rocking_matrix`
# puts e_theta into a generalized restitution matrix, $q_n^+ = -E q_n^-$, with the same velocities.

# %%
plastic = ji.theory.rocking_dispersion(np.linspace(1.5, 6.0, 480), [0.0, 0.1, 0.8], 0.0)
print("   a   Housner   e_theta by LZB, mu = 0, 0.1, 0.8")
for i in range(0, 480, 80):
    a = float(plastic.aspect[i])
    ratios = np.asarray(plastic.angular_ratio[i, :, 0])
    print(
        f"{a:5.2f} {float(ji.theory.housner_restitution(a)):8.4f}     {ratios.round(4)}"
    )

before = [1.5, -0.5, -1.0]  # a = 3: rotating about A, corner B comes down with 1
block = ji.Block(1.0, 3.0, corners="base").scene()
out = ji.impact(
    ji.RestitutionMatrix(ji.theory.rocking_matrix(ji.theory.housner_restitution(3.0))),
    block,
    before,
)
print(ji.theory.rocking_matrix(ji.theory.housner_restitution(3.0)))
print(
    "by the matrix, velocity after:",
    out.velocity,
    " gaps open with",
    block.normals.T @ out.velocity,
)

# %% [markdown]
# Measured ratios, relative to Housner's: concrete is close, rubber is not. They are converted from
# published numbers, not fitted.

# %%
for row in ji.theory.rocking_ratios():
    print(
        f"a = {row.aspect:g}, {row.material}: e_theta = {row.restitution:.3f}, ", end=""
    )
    print(f"{row.measured_over_housner:g} of Housner's value")

# %% [markdown]
# ## Rocking to rest, with LZB and friction
#
# Plastic impacts agree with Housner: each keeps 0.85 of the angular velocity (a = 3). With e = 0.1
# an impact becomes a sequence of smaller hops of B, an accumulation, and then rocking continues.
# The whole sequence dissipates as much as one impact of Housner's, because each hop conserves the
# angular momentum about B while B does not slip (except for gravity in the meantime).

# %%
system, theta = ji.System(ji.Block(0.2, 0.6), gravity=True), 0.15
start = [0.0, 0.1 * np.sin(theta) + 0.3 * np.cos(theta), theta]
law = {e_n: ji.LZB(e_n, friction=0.8) for e_n in (0.0, 0.1)}
motions = {
    e_n: ji.simulate(system, law[e_n], start, [0.0] * 3, t_end, samples=601)
    for e_n, t_end in ((0.0, 3.0), (0.1, 1.0))
}
for e_n, motion in motions.items():
    print(f"e = {e_n:g}:", motion)

events = motions[0.0].events
ratios = -events.velocity_after[:4, 2] / -events.velocity_before[:4, 2]
print("e = 0, angular velocity kept by the first four hits:", np.asarray(ratios))
print("Housner's value:", float(ji.theory.housner_restitution(3.0)))
top = {e_n: np.nanmax(-np.asarray(m.q[:, 2])) for e_n, m in motions.items()}
print(
    "largest angle on the other side, e = 0 and 0.1:",
    np.degrees(list(top.values())),
    "degrees",
)

# %%
ji.plot.phase_portrait(
    motions[0.0], 2, "LZB, e = 0, mu = 0.8: free rocking", system=system
)

# %% [markdown]
# *Next: [whole motions](12_whole_motions.ipynb).*
