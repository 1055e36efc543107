"""Strict JAX flags for every test, quick compilation, and which tests run side by side.

The suite spends most of its time on compiling. So tests compile with little optimization, in half
the time; `programs.values`, the held values and tests marked `long_run` compile with all of it.
Processes share their programs through JAX's cache, and tests that share programs run in one process.
How many programs a call compiles is the business of tests/rules/test_programs.py.
"""

import os
import random
import tempfile
from pathlib import Path

import jax
import matplotlib
import numpy as np
import programs
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")
matplotlib.use("Agg")

# Every compiled program maps memory, and Linux lets a process have 65 530 maps: beyond, the
# compiler aborts. A process that holds three quarters of them forgets its programs. Counting them
# takes 60 ms then, so it is done after every tenth test; a program maps memory up to 60 times.
MANY_MAPS = 50_000
COUNT_MAPS_AFTER = 10  # tests
MAPS = Path("/proc/self/maps")

# Processes side by side share the programs that took longer than this to compile.
WORTH_SHARING = "0.2"  # seconds

# XLA's newer emitters of loops take twice as long to compile; users compile batches with them. A
# program that is cut into parts for several cores takes a fifth longer where each core has a test.
QUICK = (
    "--xla_cpu_use_fusion_emitters=false",
    "--xla_cpu_parallel_codegen_split_count=1",
)
QUICK_IN = [(0, 10)]  # versions of JAX whose compiler is known to have these options

BY_LAW = ("test_contract", "test_systems")  # a law's tests share its programs
OF_LAW = {
    "test_compliant": "compliant",
    "test_complementarity": "moreau",
    "test_fast_paths": "lzb",
    "test_other_laws": "lzb",
    "test_values": "lzb",  # most of it
}
DEAR = (  # groups that take longest begin first, so that no process is left alone at the end
    "test_documents",
    "test_friction",
    "lzb",
    "test_methods",
    "test_motion",
    "test_commands",
    "test_fit",
)

ran = [0]  # tests of this process


def optimize(fully):
    """How programs are compiled from now on, those of what tests run as commands, too."""
    jax.config.update("jax_disable_most_optimizations", not fully)
    os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = str(not fully)


def pytest_configure(config):
    """Compiled programs are kept for this run only, by the first process (not one of xdist's)."""
    optimize(False)
    os.environ.setdefault(
        "JIMPACT_CACHE", ""
    )  # commands keep nothing in the user's folder
    if hasattr(config, "workerinput"):
        return
    flags = os.environ.get("XLA_FLAGS", "")
    quick = " ".join(x for x in QUICK if x.partition("=")[0] not in flags)
    if jax.__version_info__[:2] in QUICK_IN:
        os.environ["XLA_FLAGS"] = f"{flags} {quick}".strip()
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        folder = tempfile.TemporaryDirectory(prefix="jimpact-tests-")
        config.add_cleanup(folder.cleanup)
        os.environ["JAX_COMPILATION_CACHE_DIR"] = folder.name
        os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = WORTH_SHARING
        jax.config.update("jax_compilation_cache_dir", folder.name)
        jax.config.update(
            "jax_persistent_cache_min_compile_time_secs", float(WORTH_SHARING)
        )


def stem_of(nodeid):
    return Path(nodeid.split("::")[0]).stem.removesuffix("_inside")


def group(nodeid):
    """Tests that share programs run in one process: those of a law, else those of a file.

    Documents share few: each may run anywhere, or one process would run all of them.
    """
    stem = stem_of(nodeid)
    if stem == "test_documents":
        return nodeid
    laws = sorted(programs.LAWS, key=len, reverse=True) if stem in BY_LAW else ()
    return next((law for law in laws if law in nodeid), OF_LAW.get(stem, stem))


def pytest_collection_modifyitems(items):
    """The dearest groups first, so that no process is left alone with one at the end."""
    ranks = {name: rank for rank, name in enumerate(DEAR)}

    def rank(item):
        """Place of its group, or of its file, among the dearest."""
        own = ranks.get(group(item.nodeid))
        return ranks.get(stem_of(item.nodeid), len(DEAR)) if own is None else own

    items.sort(key=rank)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Groups of our own: with pytest 9.2 the marks of `--dist loadgroup` have no effect."""
    from xdist.scheduler import LoadScopeScheduling

    class Groups(LoadScopeScheduling):
        def _split_scope(self, nodeid):
            return group(nodeid)

    return Groups(config, log)


@pytest.fixture(autouse=True)
def each_test(request):
    """Fixed seeds; a process does not hold too many programs."""
    random.seed(0)
    np.random.seed(0)  # noqa: NPY002
    optimize(request.node.get_closest_marker("long_run") is not None)
    yield
    ran[0] += 1
    counts = ran[0] % COUNT_MAPS_AFTER == 0 and MAPS.exists()
    if counts and MAPS.read_bytes().count(b"\n") > MANY_MAPS:
        jax.clear_caches()
