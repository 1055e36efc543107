"""Strict JAX flags for every test, and the count of the programs that the tests compile.

The suite spends most of its time on compiling. So tests compile with little optimization, in half
the time; `programs.values`, the held values and tests marked `long_run` compile with all of it. A
session reports the tests with the largest programs; the whole default suite fails if it compiles
more than BUDGET programs, and a test fails in which the package multiplies matrices with less than
the highest precision.
"""

import hashlib
import os
import random
import re
import sys
import tempfile
from collections import Counter
from pathlib import Path

import jax
import matplotlib
import numpy as np
import programs as programs_of_laws
import pytest

import jimpact

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")
matplotlib.use("Agg")

# Every compiled program maps memory, and Linux lets a process have 65 530 maps: beyond, the
# compiler aborts. A process that holds three quarters of them forgets its programs. Counting them
# takes 60 ms then, so it waits for this many compilations; each maps memory up to 60 times.
MANY_MAPS = 50_000
COUNT_MAPS_AFTER = 100  # compilations

# Processes side by side share the programs that took longer than this to compile.
WORTH_SHARING = "0.2"  # seconds

# A program counts if it has at least this many operations before the compiler optimizes them; single
# operations that run eagerly have a few. Programs are counted by their text, each once, so that
# neither the count nor BUDGET depends on how fast the machine is or which process runs which test:
# names of values and the order of independent lines depend on what a process traced before.
COUNTS_FROM = 200  # operations of StableHLO
NAMES = re.compile(rb"[%@][\w.#:]+")
# Programs of the default suite, over all processes.
BUDGET = 270
COMPILED = "/jax/core/compile/backend_compile_duration"

# XLA's newer emitters of loops take twice as long to compile; users compile batches with them. A
# program that is cut into parts for several cores takes a fifth longer where each core has a test.
QUICK = "--xla_cpu_use_fusion_emitters=false", "--xla_cpu_parallel_codegen_split_count=1"
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

operations = {}  # of each program that counts, by its test and the hash of its text
coarse = []  # lines of the package with products that ask for less than the highest precision
running = ["imports"]  # the test that runs in this process
uncounted = [0]  # compilations of this process since it last counted its maps
texts = tempfile.TemporaryDirectory(prefix="jimpact-programs-")  # where JAX writes programs down


def compiled(event, duration, **_):
    """Take note of the programs that JAX has written down, and remove their texts."""
    if event != COMPILED:
        return
    uncounted[0] += 1
    for path in Path(texts.name).iterdir():
        text = path.read_bytes()
        path.unlink()
        count = text.count(b" = ")  # one a line that computes something
        name = hashlib.sha256(b"\n".join(sorted(NAMES.sub(b"", text).splitlines()))).hexdigest()
        if count >= COUNTS_FROM and name not in operations:
            operations[name] = running[0], count


def watch_products():
    """Take note of products of matrices that the package makes without `full_precision`."""
    bind, package = jax.lax.dot_general_p.bind, str(Path(jimpact.__file__).parent)
    highest = jax.lax.Precision.HIGHEST

    def watched(*args, **options):
        if options["precision"] not in (highest, (highest, highest)):
            frame = sys._getframe(1)
            while frame and is_a_library(frame.f_code.co_filename):
                frame = frame.f_back
            if frame and frame.f_code.co_filename.startswith(package):
                coarse.append(f"{frame.f_code.co_filename}:{frame.f_lineno}")
        return bind(*args, **options)

    def is_a_library(path):
        return "site-packages" in path and not path.startswith(package)

    jax.lax.dot_general_p.bind = watched


def optimize(fully):
    """How programs are compiled from now on, those of what tests run as commands, too."""
    jax.config.update("jax_disable_most_optimizations", not fully)
    os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = str(not fully)


def pytest_configure(config):
    """Compiled programs are kept for this run only, by the first process (not one of xdist's)."""
    jax.config.update("jax_dump_ir_to", texts.name)
    jax.config.update("jax_include_debug_info_in_dumps", False)
    jax.monitoring.register_event_duration_secs_listener(compiled)
    watch_products()
    optimize(False)
    if hasattr(config, "workerinput"):
        return
    flags = os.environ.get("XLA_FLAGS", "")
    quick = " ".join(x for x in QUICK if x.partition("=")[0] not in flags)
    if jax.__version_info__[:2] in QUICK_IN:
        os.environ["XLA_FLAGS"] = f"{flags} {quick}".strip()
    config.pluginmanager.register(Workers())
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        folder = tempfile.TemporaryDirectory(prefix="jimpact-tests-")
        config.add_cleanup(folder.cleanup)
        os.environ["JAX_COMPILATION_CACHE_DIR"] = folder.name
        os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = WORTH_SHARING
        jax.config.update("jax_compilation_cache_dir", folder.name)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", float(WORTH_SHARING))


class Workers:
    """Takes over what the processes of xdist have counted; their plugin calls it."""

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node, error):
        operations.update(getattr(node, "workeroutput", {}).get("operations", {}))


def pytest_sessionfinish(session, exitstatus):
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["operations"] = operations
    elif whole_suite(session.config) and len(operations) > BUDGET:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def whole_suite(config):
    """Whether this is the default call: no files, no selection but the default one."""
    return not config.option.keyword and "not slow" in config.option.markexpr and not files(config)


def files(config):
    return [x for x in config.args if Path(x).name != "tests"]


def pytest_terminal_summary(terminalreporter, config):
    write, programs, size = terminalreporter.write_line, Counter(), Counter()
    for test, count in operations.values():
        programs[test] += 1
        size[test] += count
    terminalreporter.section("programs")
    write(f"{len(operations)} programs of {size.total()} operations (budget {BUDGET} programs)")
    for test, count in size.most_common(10):
        write(f"{count:7d} operations in {programs[test]:3d} programs: {test}")
    if whole_suite(config) and len(operations) > BUDGET:
        write(f"FAILED: {len(operations)} programs are more than the budget of {BUDGET}")


def stem_of(nodeid):
    return Path(nodeid.split("::")[0]).stem.removesuffix("_inside")


def group(nodeid):
    """Tests that share programs run in one process: those of a law, else those of a file.

    Documents share few: each may run anywhere, or one process would run all of them.
    """
    stem = stem_of(nodeid)
    if stem == "test_documents":
        return nodeid
    laws = sorted(programs_of_laws.LAWS, key=len, reverse=True) if stem in BY_LAW else ()
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


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    running[0] = item.nodeid


@pytest.fixture(autouse=True)
def each_test(request):
    """Fixed seeds; a process does not hold too many programs."""
    random.seed(0)
    np.random.seed(0)  # noqa: NPY002
    optimize(request.node.get_closest_marker("long_run") is not None)
    coarse.clear()
    yield
    # what tests of files X_inside call is not public: it need not ask for the precision by itself
    asked = "_inside.py::" in request.node.nodeid or not coarse
    assert asked, f"products without `full_precision`: {sorted(set(coarse))}"
    maps = Path("/proc/self/maps")
    if uncounted[0] < COUNT_MAPS_AFTER or not maps.exists():
        return
    uncounted[0] = 0
    if maps.read_bytes().count(b"\n") > MANY_MAPS:
        jax.clear_caches()
