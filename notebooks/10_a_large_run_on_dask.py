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
# # A large Monte Carlo run on Dask, interrupted and resumed
#
# *Course, part 10. Before: [parameters and gaps](09_parameters_and_gaps.ipynb). Next: [the rocking
# block](11_rocking_block.ipynb).*
#
# You will run two million samples on worker processes, interrupt the run, resume it, damage a file,
# and check that the result is the same, bit by bit.
#
# Two balls strike a larger one from both sides. Unknown gaps decide which strikes first.

# %%
# %matplotlib inline
import logging
import time
import warnings
from pathlib import Path
from tempfile import mkdtemp

import jax

logging.getLogger("distributed").setLevel(
    "ERROR"
)  # how Dask ends its workers is of no interest
jax.config.update("jax_enable_x64", True)

import numpy as np

import jimpact as ji

balls, before = ji.chain([0.25, 1.0, 0.25]), [1.0, 0.0, -1.0]  # kg, m/s
ji.plot.system(
    ji.chain([0.25, 1.0, 0.25], gaps=[1e-5, 1e-5]), before, "Gaps not to scale"
)

# %% [markdown]
# ## The first quarter
#
# `executor="dask"` starts one worker process for each core of this machine. Each finished chunk is
# written to the folder at once. Here the run stops after 500 000 samples; ctrl-C, a crash or a
# power cut have the same effect.

# %%
law = ji.Binary(0.95, order="earliest")
run = {"gaps": ji.Uniform(0.0, 20e-6), "chunk": 16384, "key": 0}
folder = Path(mkdtemp()) / "run"
start = time.perf_counter()
first = ji.monte_carlo(
    law, balls, before, samples=500_000, folder=folder, executor="dask", **run
)
print(f"{first.samples} samples, {len(list(folder.glob('chunk*')))} files")
print(f"{time.perf_counter() - start:.0f} s, most of it to start the workers")

# %% [markdown]
# ## Resume, and extend
#
# The same call with the same folder continues. With more `samples` it extends the run. A changed
# law, scene, key or chunk would be refused with an error that names it.

# %%
whole = ji.monte_carlo(
    law, balls, before, samples=2_000_000, folder=folder, executor="dask", **run
)
print(f"{whole.resumed} of {whole.samples} samples were read from the folder")
print(whole)

# %%
try:
    changed = ji.Binary(0.9, order="earliest")
    ji.monte_carlo(changed, balls, before, samples=2_000_000, folder=folder, **run)
except ValueError as error:
    print(str(error).replace(str(folder.parent) + "/", ""))

# %% [markdown]
# ## A damaged file
#
# Each file has a checksum. Truncate one, as a failing disk might, and call again:
# a warning names the file, and only its chunk is computed again. This time without Dask, because
# the executor does not affect the result.

# %%
damaged = sorted(folder.glob("chunk*"))[7]
damaged.write_bytes(damaged.read_bytes()[:1000])
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    again = ji.monte_carlo(law, balls, before, samples=2_000_000, folder=folder, **run)
for warning in caught:
    print(str(warning.message).replace(str(folder.parent) + "/", ""))

# %% [markdown]
# ## The same bits
#
# Compare with a serial run without a folder.

# %%
serial = ji.monte_carlo(law, balls, before, samples=2_000_000, **run)
for name in ("mean", "covariance", "counts"):
    same = all(
        np.array_equal(getattr(serial, name), getattr(other, name))
        for other in (whole, again)
    )
    print(f"{name:10s} equal, bit by bit: {same}")
    assert same
print(f"standard error of the mean: {serial.standard_error.round(6)} m/s")

# %%
ji.plot.monte_carlo(whole, "Two million impacts, gaps up to 20 micrometres")

# %% [markdown]
# ## Several machines
#
# Start `dask scheduler` on one machine and `dask worker tcp://machine0:8786 --nthreads 1` on the
# others, then run `jimpact montecarlo study.toml --executor tcp://machine0:8786
# --folder run`. The page *Monte Carlo* of the docs lists the details.
#
# *Next: [a block that rocks](11_rocking_block.ipynb).*
