"""Where chunks are computed: in turn, on all devices of the process, or on a Dask cluster.

An executor is any object with this `run`; which one is used never changes a result.
"""

from collections.abc import Iterator
from typing import Any, Protocol, runtime_checkable

from jimpact.montecarlo.planning import Plan
from jimpact.montecarlo.statistics import Chunk, Task

NAMES = ("serial", "devices", "dask")


@runtime_checkable
class Executor(Protocol):
    """Computes chunks; pulls tasks only as fast as it works, so that memory stays bounded."""

    def run(self, plan: Plan, tasks: Iterator[Task]) -> Iterator[Chunk]:
        """`plan(task)` for every task, in any order."""
        ...


def as_executor(value: Any) -> Executor:
    """An executor by its name, or itself."""
    if isinstance(value, str) and value in NAMES:
        if value == "serial":
            from jimpact.montecarlo.executors.serial import Serial

            return Serial()
        if value == "devices":
            from jimpact.montecarlo.executors.devices import Devices

            return Devices()
        from jimpact.montecarlo.executors.dask_cluster import DaskExecutor

        return DaskExecutor()
    if isinstance(value, str) or not isinstance(value, Executor):
        raise ValueError(
            f"Argument `executor` must be one of {', '.join(NAMES)}, or an object with a method "
            f"`run`, but is {value!r}."
        )
    return value
