"""All devices of this process (GPUs, or CPU devices): each works on chunks of its own."""

import queue
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import jax

from jimpact.montecarlo.planning import Plan
from jimpact.montecarlo.statistics import Chunk, Task


@dataclass(frozen=True)
class Devices:
    """One thread a device, chunk by chunk, on `devices` (None: `jax.devices()`).

    Whole chunks, not their parts, are shared out: the program of a device is the same for any
    number of them, and hence so is the result, bit by bit. Each device compiles it once.
    """

    devices: Sequence[jax.Device] | None = None

    def run(self, plan: Plan, tasks: Iterator[Task]) -> Iterator[Chunk]:
        """Chunks in order."""
        devices = list(self.devices or jax.devices())
        free: queue.SimpleQueue[jax.Device] = queue.SimpleQueue()
        for device in devices:
            free.put(device)

        def compute(task: Task) -> Chunk:
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
