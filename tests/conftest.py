"""Strict JAX flags for every test; the package itself sets none."""

import os
import tempfile
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


# Most of the time is compilation: processes side by side share what takes longer than this.
WORTH_SHARING = "0.3"  # seconds


def pytest_configure(config):
    """Compiled programs are kept for this run only, by the first process (not one of xdist's)."""
    if not hasattr(config, "workerinput") and "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        folder = tempfile.TemporaryDirectory(prefix="jimpact-tests-")
        config.add_cleanup(folder.cleanup)
        os.environ["JAX_COMPILATION_CACHE_DIR"] = folder.name
        os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = WORTH_SHARING
        jax.config.update("jax_compilation_cache_dir", folder.name)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", float(WORTH_SHARING))


@pytest.fixture(autouse=True)
def few_memory_maps():
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > MANY_MAPS:
        jax.clear_caches()
