"""A Dask cluster: worker processes, on this machine or on many (extra `distributed`)."""

import functools
import pickle
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import jax

from jimpact.montecarlo.planning import Plan
from jimpact.montecarlo.statistics import Chunk, Task

AHEAD = 3  # chunks enqueued for each thread of the cluster


@dataclass(frozen=True)
class DaskExecutor:
    """One task a chunk on the workers of `client`; a worker that dies costs only its chunks.

    Args:
        client: a `distributed.Client`, or the address of a scheduler; None: a cluster of processes
            on this machine, for the time of the run.

    Workers need this package with the same versions; the files of a run are written by the
    process that called `monte_carlo`, so that no shared disk is needed.
    """

    client: Any = None

    def run(self, plan: Plan, tasks: Iterator[Task]) -> Iterator[Chunk]:
        """Chunks as they are completed."""
        try:
            import cloudpickle  # type: ignore[import-untyped]
            from distributed import Client, as_completed
        except ImportError:
            raise ImportError(
                "The executor 'dask' needs the extra `distributed`: "
                "pip install 'jimpact[distributed]'"
            ) from None
        own = self.client is None or isinstance(self.client, str)
        client = self.client
        if self.client is None:
            client = Client(threads_per_worker=1, dashboard_address=None)
        elif own:
            client = Client(self.client)
        try:
            shipped = cloudpickle.dumps(plan)
            window = AHEAD * max(1, sum(client.nthreads().values()))
            running = as_completed()
            for task in tasks:
                running.add(client.submit(_compute, shipped, plan.x64, task, pure=False))
                if running.count() >= window:
                    yield _result(running)
            while running.count():
                yield _result(running)
        finally:
            if own:
                client.close()  # and with it the cluster that it started


def _result(running: Any) -> Chunk:
    future = next(running)
    chunk = future.result()
    future.release()
    return chunk


def _compute(shipped: bytes, x64: bool, task: Task) -> Chunk:
    return _plan(shipped, x64)(task)


@functools.lru_cache(maxsize=4)
def _plan(shipped: bytes, x64: bool) -> Plan:
    """The same object for the same bytes, so that a worker compiles a run only once."""
    with jax.enable_x64(x64):  # else a worker would read float64 arrays as float32
        return pickle.loads(shipped)
