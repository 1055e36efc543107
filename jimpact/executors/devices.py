"""All devices of this process (GPUs, or CPU devices): each works on chunks of its own."""

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import jax

from jimpact.sampling.chunks import Chunk, Task
from jimpact.sampling.plans import Plan, Started

AHEAD = 2  # chunks enqueued on each device, so that none waits for the host


@dataclass(frozen=True)
class Devices:
    """Chunks in turn on `devices` (None: `jax.devices()`).

    Whole chunks, and not their parts, are shared out: the compiled program is the same for any
    number of devices, and hence so is the result, bit by bit; samples that take long delay no
    other device.
    """

    devices: Sequence[jax.Device] | None = None

    def run(self, plan: Plan, tasks: Iterator[Task]) -> Iterator[Chunk]:
        """Chunks in order."""
        devices = list(self.devices or jax.devices())
        under_way: deque[Started] = deque()
        for i, task in enumerate(tasks):
            if len(under_way) == AHEAD * len(devices):
                yield plan.finish(under_way.popleft())
            under_way.append(plan.start(task, devices[i % len(devices)]))
        while under_way:
            yield plan.finish(under_way.popleft())
