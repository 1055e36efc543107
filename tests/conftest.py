"""Strict JAX flags for every test, and the count of the programs that the tests compile.

Compiling is what the suite's time goes into. So tests compile with little optimization, in half the
time; `programs.values`, the held values and tests marked `long_run` with all of it. A session tells
the tests that compile most; one of the whole default suite fails beyond BUDGET programs.
"""

import os
import random
import tempfile
import time
from collections import Counter
from pathlib import Path

import jax
import matplotlib
import numpy as np
import programs as programs_of_laws
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")
matplotlib.use("Agg")

# Every compiled program maps memory, and Linux lets a process have 65 530 maps: beyond, the
# compiler aborts. A process that holds half of them forgets its programs.
MANY_MAPS = 30_000

# Processes side by side share the programs that took longer than this to compile.
WORTH_SHARING = "0.2"  # seconds

# A program counts if its compilation took longer; single operations, run eagerly, take less.
COUNTS_FROM = 0.2  # CPU seconds, which a busy machine does not change
# Programs of the default suite, over all processes. 250 are aimed at.
BUDGET = 320
LOWERED = "/jax/core/compile/jaxpr_to_mlir_module_duration"  # just before
COMPILED = "/jax/core/compile/backend_compile_duration"

BY_LAW = ("test_contract", "test_systems")  # a law's tests share its programs
OF_LAW = {
    "test_compliant": "compliant",
    "test_complementarity": "moreau",
    "test_fast_paths": "lzb",
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

programs, seconds = Counter(), Counter()  # of each test, in this process
running, begun = ["imports"], [0.0]


def compiled(event, duration, **_):
    if event == LOWERED:
        begun[0] = time.process_time()
    elif event == COMPILED:
        took = time.process_time() - begun[0]
        if took > COUNTS_FROM:
            programs[running[0]] += 1
            seconds[running[0]] += took


def optimize(fully):
    """How programs are compiled from now on, those of what tests run as commands, too."""
    jax.config.update("jax_disable_most_optimizations", not fully)
    os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = str(not fully)


def pytest_configure(config):
    """Compiled programs are kept for this run only, by the first process (not one of xdist's)."""
    jax.monitoring.register_event_duration_secs_listener(compiled)
    optimize(False)
    if hasattr(config, "workerinput"):
        return
    config.pluginmanager.register(Workers())
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        folder = tempfile.TemporaryDirectory(prefix="jimpact-tests-")
        config.add_cleanup(folder.cleanup)
        os.environ["JAX_COMPILATION_CACHE_DIR"] = folder.name
        os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = WORTH_SHARING
        jax.config.update("jax_compilation_cache_dir", folder.name)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", float(WORTH_SHARING))
    os.environ.setdefault("JIMPACT_CACHE", os.environ["JAX_COMPILATION_CACHE_DIR"])


class Workers:
    """Takes over what the processes of xdist have counted; their plugin calls it."""

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node, error):
        told = getattr(node, "workeroutput", {})
        programs.update(told.get("programs", {}))
        seconds.update(told.get("seconds", {}))


def pytest_sessionfinish(session, exitstatus):
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["programs"] = dict(programs)
        session.config.workeroutput["seconds"] = dict(seconds)
    elif whole_suite(session.config) and programs.total() > BUDGET:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def whole_suite(config):
    """Whether this is the default call: no files, no selection but the default one."""
    return not config.option.keyword and "not slow" in config.option.markexpr and not files(config)


def files(config):
    return [x for x in config.args if Path(x).name != "tests"]


def pytest_terminal_summary(terminalreporter, config):
    write, total = terminalreporter.write_line, programs.total()
    terminalreporter.section("programs")
    write(f"{total} programs took {seconds.total():.0f} CPU s to compile (budget {BUDGET})")
    for name, count in sorted(programs.items(), key=lambda item: -seconds[item[0]])[:10]:
        write(f"{seconds[name]:6.1f} s {count:3d}  {name}")
    if whole_suite(config) and total > BUDGET:
        write(f"FAILED: {total} programs are more than the budget of {BUDGET}")


def group(nodeid):
    """Tests that share programs run in one process: those of a law, else those of a file."""
    stem = Path(nodeid.split("::")[0]).stem
    laws = sorted(programs_of_laws.LAWS, key=len, reverse=True) if stem in BY_LAW else ()
    return next((law for law in laws if law in nodeid), OF_LAW.get(stem, stem))


def pytest_collection_modifyitems(items):
    """The dearest groups first, so that no process is left alone with one at the end."""
    items.sort(key=lambda item: [*DEAR, group(item.nodeid)].index(group(item.nodeid)))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Groups of our own: with pytest 9.2 the marks of `--dist loadgroup` have no effect."""
    from xdist.scheduler import LoadScopeScheduling

    class Groups(LoadScopeScheduling):
        def _split_scope(self, nodeid):
            return group(nodeid)

    return Groups(config, log)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    running[0] = item.nodeid


@pytest.fixture(autouse=True)
def each_test(request):
    """Fixed seeds; a process does not hold too many programs."""
    random.seed(0)
    np.random.seed(0)  # noqa: NPY002
    optimize(request.node.get_closest_marker("long_run") is not None)
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > MANY_MAPS:
        jax.clear_caches()
