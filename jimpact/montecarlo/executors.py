"""Where chunks are computed: by anything that has a `map`, which never changes a result."""

import functools
import itertools
import pickle
import queue
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import jax

from jimpact.montecarlo.planning import SamplingPlan
from jimpact.montecarlo.statistics import Chunk, Task

EXECUTORS = ("serial", "devices", "dask")
# Chunks that a `map` gets at once. Ten times more: their results fill the memory of the workers;
# ten times less: workers wait for the last chunk of each part.
WINDOW = 512

Work = Callable[[Task], Chunk]
Map = Callable[[Work, list[Task]], Iterable[Any]]


def check_executor(executor: Any) -> None:
    """Raise where nothing can compute chunks with it."""
    if isinstance(executor, str):
        known = executor in EXECUTORS or ":" in executor  # host and port of a scheduler
    else:
        known = callable(getattr(executor, "map", None))
    if not known:
        raise ValueError(
            f"Argument `executor` must be one of {', '.join(EXECUTORS)}, the address of a Dask "
            f"scheduler, or an object with a method `map`, but is {executor!r}."
        )


def computed(executor: Any, plan: SamplingPlan, tasks: Iterable[Task]) -> Generator[Chunk]:
    """`plan(task)` for every task, in order."""
    remaining = iter(tasks)
    with _opened(executor, plan) as (mapped, work):
        while window := list(itertools.islice(remaining, WINDOW)):
            for each in mapped(work, window):
                yield each.result() if hasattr(each, "result") else each  # Dask maps to futures


@contextmanager
def _opened(executor: Any, plan: SamplingPlan) -> Iterator[tuple[Map, Work]]:
    """The `map` of an executor, and what it maps tasks by."""
    if executor == "serial":
        yield map, plan
    elif executor == "devices":
        devices = jax.devices()
        with ThreadPoolExecutor(len(devices)) as pool:
            yield pool.map, _on_free_devices(plan, devices)
    elif isinstance(executor, str):
        with _dask_client(executor) as client:
            yield client.map, _shipped(plan)
    else:
        yield executor.map, _shipped(plan)


def _on_free_devices(plan: SamplingPlan, devices: list[jax.Device]) -> Work:
    """Computes each chunk on a device that is free; each device compiles the program once."""
    free: queue.SimpleQueue[jax.Device] = queue.SimpleQueue()
    for device in devices:
        free.put(device)

    def compute(task: Task) -> Chunk:
        """One chunk."""
        device = free.get()
        try:
            return plan(task, device)
        finally:
            free.put(device)

    return compute


def _dask_client(name: str) -> Any:
    """A client of a scheduler at an address, or of processes on this machine ('dask')."""
    try:
        from distributed import Client
    except ImportError:
        raise ImportError(
            "The executor 'dask' needs the extra `distributed`: pip install 'jimpact[distributed]'"
        ) from None
    if name == "dask":
        return Client(threads_per_worker=1, dashboard_address=None)
    return Client(name)


def _shipped(plan: SamplingPlan) -> Work:
    """A plan that other processes can compute with; as it is where it cannot be pickled.

    Functions in it are pickled where cloudpickle is installed, which Dask brings.
    """
    try:
        from cloudpickle import dumps  # type: ignore[import-untyped]
    except ImportError:
        dumps = pickle.dumps
    try:
        return _Shipped(dumps(plan), plan.x64)
    except Exception:  # objects refuse to be pickled in many ways; threads need no pickle
        return plan


@dataclass(frozen=True)
class _Shipped:
    """A plan as bytes, and its precision."""

    plan: bytes
    x64: bool

    def __call__(self, task: Task) -> Chunk:
        """One chunk."""
        return _plan(self)(task)


@functools.lru_cache(maxsize=4)
def _plan(shipped: _Shipped) -> SamplingPlan:
    """The same object for the same bytes, so that a worker compiles a run only once."""
    with jax.enable_x64(shipped.x64):  # else a worker would read float64 arrays as float32
        return pickle.loads(shipped.plan)
