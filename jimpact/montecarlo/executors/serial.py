"""One chunk after another on the default device."""

from collections.abc import Iterator
from dataclasses import dataclass

from jimpact.montecarlo.planning import Plan
from jimpact.montecarlo.statistics import Chunk, Task


@dataclass(frozen=True)
class Serial:
    """The default: the device computes the next chunk while the host reduces the last one."""

    def run(self, plan: Plan, tasks: Iterator[Task]) -> Iterator[Chunk]:
        """Chunks in order."""
        before = None
        for task in tasks:
            started = plan.start(task)
            if before is not None:
                yield plan.finish(before)
            before = started
        if before is not None:
            yield plan.finish(before)
