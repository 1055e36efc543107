"""`monte_carlo`: the distribution of outcomes over gaps, velocities and parameters."""

import functools
import itertools
import pickle
import time
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jimpact.core.law import Law
from jimpact.core.scene import Scene
from jimpact.laws.gap_scale import gap_scale
from jimpact.montecarlo.result import MonteCarlo, result_of
from jimpact.montecarlo.samples import Run, Sources, planned_run
from jimpact.montecarlo.statistics import Chunk, Task, Tolerance, joined
from jimpact.montecarlo.store import Store
from jimpact.montecarlo.tolerance import SHARE, first_chunk
from jimpact.tools.checks import check_executor, in_common_dtype, needed
from jimpact.tools.progress import counting_bar
from jimpact.tools.threads import as_workers, in_threads

CHUNK = 4096  # samples: fast on a CPU for cheap and costly laws alike; a GPU wants more
# of a histogram; ten times more: quantiles finer than 100 000 samples determine them
BINS = 1000
# Chunks that a `map` gets at once. Ten times more: their results fill the memory of the
# workers; ten times less: workers wait for the last chunk of each part.
WINDOW = 512

Work = Callable[[Task], Chunk]


def monte_carlo(
    law: Law | Callable[[jax.Array], Law],
    scene: Scene,
    velocity: Any,
    gaps: Any = None,
    samples: int | None = None,
    key: Any = 0,
    *,
    chunk: int = CHUNK,
    executor: Any = "threads",
    workers: int | None = None,
    folder: str | Path | None = None,
    keep_samples: bool = False,
    bins: int = BINS,
    progress: float | None = None,
) -> MonteCarlo:
    """Statistics of velocities after an impact with random gaps, velocities or law.

    Equation: moments are merged chunk by chunk in float64 (Chan et al. 1983); quantiles
    come from histograms. The result is the same, bit by bit, for every executor and
    number of devices (on machines of one kind), and after a resume; memory does not
    grow with `samples`.

    A law whose `rtol` is None is integrated as finely as the standard errors need: to
    the coarsest tolerance whose error, measured on the first chunk, is at most a tenth
    of those of means and deviations. The report says it. Short runs, and samples that
    are kept, have the law's default.

    Args:
        law: a law, `RandomLaw`, or a function `key -> Law`.
        scene: n coordinates, m contacts.
        velocity: v- (n,) [m/s], or random (n entries): `Uniform`, `Normal`, a function
            `key -> (n,)`, an array of samples (S, n).
        gaps: likewise (m entries) [m], none negative: `Normal` is truncated at 0; None:
            the scene's.
        samples: number of samples; default: that of the passed samples, or 100 000.
        key: a JAX random key, or an integer seed.
        chunk: samples computed together; changing it changes the random samples.
        executor: 'threads', 'serial' (one chunk after another), 'devices' (all JAX
            devices), 'dask' (processes on this machine), the address of a Dask
            scheduler, or anything with a `map` (a Dask client, an executor of
            `concurrent.futures`).
        workers: threads >= 1 of 'threads'; None: one for each core that the process may
            use.
        folder: where every finished chunk is stored; the same call again continues from
            it, and may ask for more samples, at the tolerance of those that are there.
        keep_samples: store the raw samples in the folder, too (`read_samples`).
        bins: of the histograms, over the range of the first chunk, widened by 10 % of
            its width at each end.
        progress: a progress bar on stderr; None: on a terminal, for long runs.

    Returns:
        `MonteCarlo`. Samples whose status is a failure are counted, listed and left
        out.

    Raises:
        ValueError: bad arguments, gaps that can be negative or that the law does not
            use, a folder that holds a different run.
        RuntimeError: no sample of the first chunk could be used.
        OSError: the folder cannot be written; what was written before is intact.
        KeyboardInterrupt: with a message that says how to continue.

    Warns: where samples failed, a file of the folder is damaged or foreign (not used),
        or the tolerance of its samples is too coarse for so many.

    >>> import jimpact as ji
    >>> balls = ji.chain([0.25, 1.0, 0.25])
    >>> law = ji.Binary(1.0, order="earliest")
    >>> gaps = ji.Uniform(0.0, 1e-5)
    >>> result = ji.monte_carlo(law, balls, [1.0, 0.0, -1.0], gaps=gaps, samples=1000)
    >>> [round(float(v), 2) for v in result.quantile(0.9)]  # one of two mirror images
    [-0.6, 0.16, 1.24]
    """
    sources = Sources(law, velocity, gaps)
    run = planned_run(sources, scene, samples, key, chunk, bins, keep_samples)
    check_executor(executor)
    if workers is not None and executor != "threads":
        raise ValueError(
            f"Argument `workers` must be left out but for executor='threads', but has "
            f"value {workers!r} for {executor!r}."
        )
    workers = as_workers(workers)
    if keep_samples and folder is None:
        raise ValueError(
            "Argument `folder` must be given to keep samples, but is None."
        )
    if folder is None:
        store = None
    else:
        store = Store(folder, run.identity)
    total, resumed, rate = _all_chunks(run, executor, workers, store, progress)
    scale = _gap_scale(run.sources, scene)
    result = result_of(run, total, resumed, rate, scale)
    failed = result.samples - result.count
    if failed:
        text = ", ".join(f"{count} {name}" for name, count in result.statuses.items())
        warnings.warn(
            f"{failed} of {result.samples} samples failed and are left out of the "
            f"statistics ({text}); see `bad` and `replay`.",
            stacklevel=2,
        )
    if result.rtol_error > SHARE:
        warnings.warn(
            f"Folder '{folder}' holds a run at rtol = {result.rtol:g}, whose error is "
            f"{result.rtol_error:.2g} standard errors of {samples} samples: begin "
            f"another folder.",
            stacklevel=2,
        )
    return result


def _all_chunks(
    run: Run, executor: Any, workers: int, store: Store | None, progress: float | None
) -> tuple[Chunk, int, float]:
    """Statistics of all chunks, joined in their order, samples that were read, samples
    a second.

    The first chunk sets the histograms and the tolerance of all. If it is computed it
    compiles the program, and does not count for the rate.
    """

    def read(number: int) -> Chunk | None:
        """Statistics of a chunk from the folder; None if it is not stored."""
        if store:
            return store.read(number, run.count(number), run.keep_samples)
        return None

    # numbers of stored chunks, and their tolerance
    stored = set()
    recorded = None
    for number in range(run.chunks):
        if chunk := read(number):
            stored.add(number)
            recorded = Tolerance(*map(float, chunk["tolerance"]))
    resumed = finished = sum(map(run.count, stored))
    times = [(resumed, time.perf_counter())]

    def new(chunk: Chunk) -> Chunk:
        """Store a computed chunk, count its samples and note the time; returns it."""
        nonlocal finished
        if store:
            store.write(chunk)
        finished += int(chunk["count"])
        times.append((finished, time.perf_counter()))
        advance(int(chunk["count"]))
        return chunk

    try:
        with counting_bar(run.samples, "samples", progress, resumed) as advance:
            total = read(0) or new(first_chunk(run, recorded))
            tolerance = Tolerance(*map(float, total["tolerance"]))
            numbers = range(1, run.chunks)
            missing = (n for n in numbers if n not in stored)
            ends = total["ends"]
            tasks = (run.task(number, tolerance, ends) for number in missing)
            with closing(_computed_chunks(executor, workers, run, tasks)) as chunks:
                for number in range(1, run.chunks):
                    if number in stored:
                        chunk = read(number)
                    else:
                        chunk = new(next(chunks))
                    if chunk is None:
                        raise OSError(
                            f"Chunk {number} changed during the run: run again."
                        )
                    total = joined(total, chunk)
    except KeyboardInterrupt:
        text = f"stopped after {finished:,} of {run.samples:,} samples; "
        if store is None:
            text += "nothing is stored, because no `folder` was given."
        else:
            text += f"they are in '{store.folder}': the same call continues from there."
        raise KeyboardInterrupt(text) from None
    # samples and time after the first computed chunk, and at the end
    before, begin = times[1 if len(times) > 2 else 0]
    after, end = times[-1]
    rate = 0.0
    if after > before:
        rate = (after - before) / (end - begin)
    return total, resumed, rate


def _gap_scale(sources: Sources, scene: Scene) -> np.ndarray | None:
    """Indentations delta_c (m,) [m] of contacts, see `ji.theory.gap_scale`.

    None if law or velocity is random, or the law has no contact force or does not use
    gaps.
    """
    law = sources.law
    velocity = sources.velocity
    if not (isinstance(law, Law) and isinstance(velocity, jax.Array)):
        return None
    if not law.uses_gaps or law.contact_force is None:
        return None
    law, scene, velocity = in_common_dtype(law, scene, velocity)
    delta = np.asarray(gap_scale(scene, law, velocity).delta, float)
    # 0: nothing approaches
    if (delta > 0).all():
        return delta
    return None


# ------------------------------------------ where chunks are computed, which changes no
# result


def _computed_chunks(
    executor: Any, workers: int, run: Run, tasks: Iterable[Task]
) -> Generator[Chunk]:
    """Chunks `run(task)` of all tasks, in their order: by as many threads as `workers`,
    by one ('serial'), or by the `map` of another executor, WINDOW tasks at a time.
    """
    if executor in ("threads", "serial"):
        yield from in_threads(run, tasks, workers if executor == "threads" else 1)
        return
    remaining = iter(tasks)
    with _mapping_of(executor, run) as (mapped, work):
        while window := list(itertools.islice(remaining, WINDOW)):
            for each in mapped(work, window):
                # Dask maps to futures
                yield each.result() if hasattr(each, "result") else each


@contextmanager
def _mapping_of(executor: Any, run: Run) -> Iterator[tuple[Callable[..., Any], Work]]:
    """The `map` of an executor, and the function to map over tasks, while it is open.

    `executor` is 'devices', 'dask', the address of a Dask scheduler, or an object with
    a `map`.
    """
    if executor == "devices":
        devices = jax.devices()  # each compiles the program once
        with ThreadPoolExecutor(len(devices)) as pool:
            yield pool.map, lambda task: run(task, devices[task.number % len(devices)])
    elif isinstance(executor, str):
        distributed = needed("distributed", "pip install 'jimpact[distributed]'")
        # processes on this machine
        local = {"threads_per_worker": 1, "dashboard_address": None}
        options = local if executor == "dask" else {"address": executor}
        with distributed.Client(**options) as client:
            yield client.map, _picklable(run)
    else:
        yield executor.map, _picklable(run)


def _picklable(run: Run) -> Work:
    """Function of a task that other processes can unpickle; the run itself if it
    refuses pickling.

    Functions in it are pickled if cloudpickle is installed, which Dask brings.
    """
    try:
        from cloudpickle import dumps  # type: ignore[import-untyped]
    except ImportError:
        dumps = pickle.dumps
    try:
        pickled = dumps(replace(run, rows={}))
        return functools.partial(_compute, pickled, run.x64)
    # objects refuse to be pickled in many ways; threads need no pickle
    except Exception:
        return run


def _compute(run: bytes, x64: bool, task: Task) -> Chunk:
    """Statistics of the chunk of a task, by a pickled run in precision x64 or not."""
    return _unpacked(run, x64)(task)


@functools.lru_cache(maxsize=4)
def _unpacked(run: bytes, x64: bool) -> Run:
    """The run of these bytes, the same object each time: a worker compiles it only
    once.
    """
    with jax.enable_x64(x64):  # else a worker would read float64 arrays as float32
        return pickle.loads(run)
