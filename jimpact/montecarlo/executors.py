"""Where chunks are computed: in turn, on all devices of the process, or on a Dask cluster.

An executor is any object with this `run`; which one is used never changes a result.
"""

import functools
import itertools
import pickle
import queue
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import jax

from jimpact.montecarlo.planning import SamplingPlan
from jimpact.montecarlo.statistics import Chunk, Task

# Chunks enqueued for each thread of a cluster: with one, threads wait for the network; ten times
# more costs memory.
AHEAD = 3


@runtime_checkable
class Executor(Protocol):
    """Computes chunks; pulls tasks only as fast as it works, so that memory stays bounded."""

    def run(self, plan: SamplingPlan, tasks: Iterator[Task]) -> Iterator[Chunk]:
        """`plan(task)` for every task, in any order."""
        ...


def as_executor(value: Any) -> Executor:
    """An executor by its name, or itself."""
    if isinstance(value, str) and value in EXECUTORS:
        return EXECUTORS[value]()
    if isinstance(value, str) or not isinstance(value, Executor):
        raise ValueError(
            f"Argument `executor` must be one of {', '.join(EXECUTORS)}, or an object with a "
            f"method `run`, but is {value!r}."
        )
    return value


@dataclass(frozen=True)
class Serial:
    """The default: the device computes the next chunk while the host reduces the last one."""

    def run(self, plan: SamplingPlan, tasks: Iterator[Task]) -> Iterator[Chunk]:
        """Chunks in order."""
        end: list[Any] = [None]
        under_way = itertools.chain(map(plan.start, tasks), end)
        for finish, _ in itertools.pairwise(under_way):  # the next one has been started
            yield finish()


@dataclass(frozen=True)
class Devices:
    """One thread a device, chunk by chunk, on `devices` (None: `jax.devices()`).

    Whole chunks, not their parts, are shared out: the program of a device is the same for any
    number of them, and hence so is the result, bit by bit. Each device compiles it once.
    """

    devices: Sequence[jax.Device] | None = None

    def run(self, plan: SamplingPlan, tasks: Iterator[Task]) -> Iterator[Chunk]:
        """Chunks in order."""
        devices = list(self.devices or jax.devices())
        free: queue.SimpleQueue[jax.Device] = queue.SimpleQueue()
        for device in devices:
            free.put(device)

        def compute(task: Task) -> Chunk:
            """One chunk on a device that is free."""
            device = free.get()
            try:
                return plan(task, device)
            finally:
                free.put(device)

        under_way: deque[Future[Chunk]] = deque()
        with ThreadPoolExecutor(len(devices)) as pool:
            try:
                for task in tasks:
                    under_way.append(pool.submit(compute, task))
                    if len(under_way) > len(devices):  # one waits, so that no device does
                        yield under_way.popleft().result()
                while under_way:
                    yield under_way.popleft().result()
            finally:  # the caller stopped: finish what runs, drop what waits
                for future in under_way:
                    future.cancel()


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

    def run(self, plan: SamplingPlan, tasks: Iterator[Task]) -> Iterator[Chunk]:
        """Chunks as they are completed."""
        try:
            import cloudpickle  # type: ignore[import-untyped]
            from distributed import Client, as_completed
        except ImportError:
            raise ImportError(
                "The executor 'dask' needs the extra `distributed`: "
                "pip install 'jimpact[distributed]'"
            ) from None
        client = self.client
        if client is None:
            client = Client(threads_per_worker=1, dashboard_address=None)
        elif isinstance(client, str):
            client = Client(client)
        try:
            shipped = cloudpickle.dumps(plan)
            window = AHEAD * max(1, sum(client.nthreads().values()))
            running = as_completed()
            for task in tasks:
                running.add(client.submit(_compute, shipped, plan.x64, task, pure=False))
                if running.count() >= window:
                    yield next(running).result()
            for future in running:
                yield future.result()
        finally:
            if client is not self.client:
                client.close()  # and with it the cluster that it started


def _compute(shipped: bytes, x64: bool, task: Task) -> Chunk:
    """One chunk, on a worker."""
    return _plan(shipped, x64)(task)


@functools.lru_cache(maxsize=4)
def _plan(shipped: bytes, x64: bool) -> SamplingPlan:
    """The same object for the same bytes, so that a worker compiles a run only once."""
    with jax.enable_x64(x64):  # else a worker would read float64 arrays as float32
        return pickle.loads(shipped)


EXECUTORS: dict[str, Callable[[], Executor]] = {
    "serial": Serial,
    "devices": Devices,
    "dask": DaskExecutor,
}
