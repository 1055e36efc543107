"""`monte_carlo`: the distribution of outcomes over gaps, velocities and parameters."""

import time
import warnings
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jimpact._checks import in_common_dtype
from jimpact.law import Law
from jimpact.montecarlo.executors import check_executor, computed
from jimpact.montecarlo.gaps import gap_scale
from jimpact.montecarlo.planning import BINS, CHUNK, Run, Sources, planned_run
from jimpact.montecarlo.results import MonteCarlo, result_of
from jimpact.montecarlo.statistics import Chunk, joined
from jimpact.montecarlo.store import Store
from jimpact.progress import counting_bar
from jimpact.scene import Scene


def monte_carlo(
    law: Law | Callable[[jax.Array], Law],
    scene: Scene,
    velocity: Any,
    gaps: Any = None,
    samples: int | None = None,
    key: Any = 0,
    *,
    chunk: int = CHUNK,
    executor: Any = "serial",
    folder: str | Path | None = None,
    keep_samples: bool = False,
    bins: int = BINS,
    progress: float | None = None,
) -> MonteCarlo:
    """Statistics of the velocities after an impact whose gaps (velocities, law) are random.

    Equation: moments are merged chunk by chunk in float64 (Chan et al. 1983); quantiles come from
    histograms. The result is the same, bit by bit, for every executor and number of devices (on
    machines of one kind), and after a resume; memory does not grow with `samples`.

    Args:
        law: a law, `RandomLaw`, or a function `key -> Law`.
        scene: n coordinates, m contacts.
        velocity: v- (n,) [m/s], or random (n entries): `Uniform`, `Normal`, a function
            `key -> (n,)`, an array of samples (S, n).
        gaps: likewise (m entries) [m], none negative: `Normal` is truncated at 0; None: the
            scene's.
        samples: number of samples; default: that of the passed samples, or 100 000.
        key: a JAX random key, or an integer seed.
        chunk: samples computed together; changing it changes the random samples.
        executor: 'serial', 'devices' (all JAX devices), 'dask' (processes on this machine), the
            address of a Dask scheduler, or anything with a `map` (a Dask client, an executor of
            `concurrent.futures`).
        folder: where every finished chunk is stored; the same call again continues from it, and
            may ask for more samples.
        keep_samples: store the raw samples in the folder, too (`read_samples`).
        bins: of the histograms, over the range of the first chunk, widened by 10 % of its width at
            each end.
        progress: a progress bar on stderr; None: on a terminal, for long runs.

    Returns:
        `MonteCarlo`. Samples whose status is a failure are counted, listed and left out.

    Raises:
        ValueError: bad arguments, gaps that can be negative or that the law does not use, a
            folder that holds a different run.
        RuntimeError: no sample of the first chunk could be used.
        OSError: the folder cannot be written; what was written before is intact.
        KeyboardInterrupt: with a message that says how to continue.

    Warns: where samples failed, or a file of the folder is damaged or foreign (not used).

    >>> import jimpact as ji
    >>> balls = ji.chain([0.25, 1.0, 0.25])
    >>> law = ji.Binary(1.0, order="earliest")
    >>> gaps = ji.Uniform(0.0, 1e-5)
    >>> result = ji.monte_carlo(law, balls, [1.0, 0.0, -1.0], gaps=gaps, samples=1000)
    >>> [round(float(v), 2) for v in result.quantile(0.9)]  # one of two mirror images
    [-0.6, 0.16, 1.24]
    """
    run = planned_run(Sources(law, velocity, gaps), scene, samples, key, chunk, bins, keep_samples)
    check_executor(executor)
    if keep_samples and folder is None:
        raise ValueError("Argument `folder` must be given to keep samples, but is None.")
    store = None if folder is None else Store(folder, run.identity)
    begin = time.perf_counter()
    total, resumed = _total(run, executor, store, progress)
    rate = (run.samples - resumed) / (time.perf_counter() - begin)
    result = result_of(run, total, resumed, rate, _gap_scale(run.plan.sources, scene))
    failed = result.samples - result.count
    if failed:
        text = ", ".join(f"{count} {name}" for name, count in result.statuses.items())
        warnings.warn(
            f"{failed} of {result.samples} samples failed and are left out of the statistics "
            f"({text}); see `bad` and `replay`.",
            stacklevel=2,
        )
    return result


def _total(
    run: Run, executor: Any, store: Store | None, progress: float | None
) -> tuple[Chunk, int]:
    """All chunks, read or computed, joined in their order; how many samples were read."""

    def read(number: int) -> Chunk | None:
        """The chunk as it is stored, if it is."""
        count, keep = run.task(number).count, run.plan.keep_samples
        return store.read(number, count, keep) if store is not None else None

    stored = {number for number in range(run.chunks) if read(number) is not None}
    resumed = finished = sum(run.task(number).count for number in stored)
    missing = (n for n in range(1, run.chunks) if n not in stored)

    def new(chunk: Chunk) -> Chunk:
        """A computed chunk, stored and counted."""
        nonlocal finished
        if store is not None:
            store.write(chunk)
        finished += chunk.count
        advance(chunk.count)
        return chunk

    try:
        with counting_bar(run.samples, "samples", progress, resumed) as advance:
            # the first chunk sets the histograms
            first = read(0) or new(run.plan(run.task(0)))
            tasks = (run.task(number, first.ends) for number in missing)
            total = first.without_samples()
            with closing(computed(executor, run.plan, tasks)) as chunks:
                for number in range(1, run.chunks):
                    chunk = read(number) if number in stored else new(next(chunks))
                    if chunk is None:
                        raise OSError(f"Chunk {number} changed during the run: run again.")
                    total = joined(total, chunk)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(_interrupted(run, store, finished)) from None
    return total, resumed


def _interrupted(run: Run, store: Store | None, done: int) -> str:
    """The message of an interrupted run."""
    text = f"stopped after {done:,} of {run.samples:,} samples; "
    if store is None:
        return text + "nothing is stored, because no `folder` was given."
    return text + f"they are in '{store.folder}': the same call continues from there."


def _gap_scale(sources: Sources, scene: Scene) -> np.ndarray | None:
    """delta_c (m,), where law and velocity are constant and the law's contacts indent."""
    law, velocity = sources.law, sources.velocity
    if not (isinstance(law, Law) and isinstance(velocity, jax.Array)):
        return None
    if not law.uses_gaps or law.contact_force is None:
        return None
    law, scene, velocity = in_common_dtype(law, scene, velocity)
    delta = np.asarray(gap_scale(scene, law, velocity).delta, float)
    return delta if (delta > 0).all() else None  # 0: nothing approaches
