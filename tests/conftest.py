"""Strict JAX flags for every test; the package itself sets none."""

from pathlib import Path

import jax
import matplotlib
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")
matplotlib.use("Agg")

# Every compiled program maps memory, and Linux lets a process have 65 530 maps: beyond, the
# compiler aborts. A process that holds half of them forgets its programs.
MANY_MAPS = 30_000


@pytest.fixture(autouse=True)
def few_memory_maps():
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > MANY_MAPS:
        jax.clear_caches()
