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
# # Whole motions: Newton's cradle over fifty swings
#
# *Course, part 12. Before: [the rocking block](11_rocking_block.ipynb). Next: [event times and fits
# to motions](13_fit_a_motion.ipynb).*
#
# You will simulate bodies from release to rest, and read events and the energy ledger.
#
# An impact law describes one instant of a motion. `simulate` adds the rest: flights, impacts at
# located times, contacts that stay closed, and a record of the energy.

# %%
# %matplotlib inline
import jax

jax.config.update("jax_enable_x64", True)

import numpy as np

import jimpact as ji

cradle = ji.System(ji.PendulumCradle([0.1, 0.1, 0.1], 0.15, 0.0125), gravity=True)
ji.plot.system(cradle, [-0.3, 0.0, 0.0], "One ball is lifted by 0.3 rad")

# %% [markdown]
# ## Simulate
#
# One of three touching balls is lifted and released. At first the last ball flies out. But e < 1,
# and impacts conserve only the momentum: at the end all balls swing in phase, with a third of the
# energy.

# %%
period = 2 * np.pi * np.sqrt(0.15 / 9.80665)
law = ji.LZB(0.95, exponent=1.5)
motion = ji.simulate(cradle, law, [-0.3, 0, 0], [0.0, 0, 0], 50 * period, samples=1501)
print(motion)

# %%
names = ["ball 1", "ball 2", "ball 3"]
ji.plot.motion(motion, "Newton's cradle, 50 swings", names, cradle)

# %% [markdown]
# ## Where did the energy go?
#
# The ledger compares the energy with the work of the contacts. What it does not explain is the
# residual, an error of the integration.

# %%
energy = np.asarray(motion.kinetic_energy + motion.potential_energy)
work = np.asarray(motion.contact_work).sum(axis=(1, 2))
print(f"energy at the end {energy[-1] / energy[0]:.3f} of the start")
print(
    f"work of the contacts {work[-1]:.6f} J, change of energy {energy[-1] - energy[0]:.6f} J"
)
print("largest residual", float(np.abs(motion.ledger_residual).max()), "J")

# %% [markdown]
# ## The law matters for the first swing
#
# Newton's law moves the two struck balls together; LZB sends the last one off. After one swing the
# angles differ.

# %%
for law in (ji.LZB(0.95, exponent=1.5), ji.Newton(0.95)):
    swing = ji.simulate(cradle, law, [-0.3, 0, 0], [0.0, 0, 0], period / 2, samples=101)
    print(
        type(law).__name__,
        "largest angles",
        np.asarray(swing.q).max(axis=0).round(3),
        "rad",
    )

# %% [markdown]
# The bundled studies show other motions: `jimpact simulate shaken_dimer.toml --gif dimer.gif`
# animates a dimer on a vibrating plate.
#
# *Next: [event times, and fits to motions](13_fit_a_motion.ipynb).*
