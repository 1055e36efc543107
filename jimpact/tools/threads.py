"""Work in threads, one for each core that the process may use: programs of XLA run side by side."""

import os
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from itertools import chain, islice
from typing import Any, TypeVar

import jax

from jimpact.tools.checks import as_whole

Task = TypeVar("Task")
Result = TypeVar("Result")

# Tasks that wait for each thread beside the one that it works on. Ten times more: their results
# fill the memory; none: threads wait for the caller.
_AHEAD = 1


def usable_cores() -> int:
    """Cores that this process may use, which may be fewer than the machine has."""
    if hasattr(os, "sched_getaffinity"):  # on Linux
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def as_workers(workers: Any) -> int:
    """A number of threads, None: one for each core that the process may use."""
    return usable_cores() if workers is None else as_whole("workers", workers, 1)


def in_threads(
    function: Callable[[Task], Result],
    tasks: Iterable[Task],
    workers: Any = None,
    compiles: bool = False,
) -> Generator[Result]:
    """`function(task)` of each task, in their order, whatever the number of threads.

    JAX releases Python's lock while a program runs, and most programs of impacts use one core. An
    error of a task is raised where its result would come; tasks that have not begun are then
    dropped.

    Args:
        function: of one task; it sees the caller's settings of JAX.
        tasks: any iterable; some `workers` of them are taken ahead.
        workers: threads >= 1; None: one for each core that the process may use.
        compiles: whether the first task compiles what the others run: they wait for it, lest each
            thread compiles the same program.

    Yields:
        The results.

    Raises:
        ValueError: no such number of workers.

    >>> from jimpact.tools.threads import in_threads
    >>> list(in_threads(lambda x: x**2, range(4), workers=2))
    [0, 1, 4, 9]
    """
    count, tasks = as_workers(workers), iter(tasks)
    if compiles or count == 1:
        yield from map(function, islice(tasks, None if count == 1 else 1))
    first = list(islice(tasks, 2))
    if len(first) < 2:  # one task needs no thread
        yield from map(function, first)
        return
    as_here = _settings()

    def one(task: Task) -> Result:
        """The task with the caller's settings, which belong to its thread."""
        with as_here():
            return function(task)

    waiting: deque[Future[Result]] = deque()
    with ThreadPoolExecutor(count, thread_name_prefix="jimpact") as pool:
        try:
            for task in chain(first, tasks):
                waiting.append(pool.submit(one, task))
                if len(waiting) > (1 + _AHEAD) * count:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for each in waiting:
                each.cancel()


def _settings() -> Callable[[], Any]:
    """A context with the precision and the device that are set where this is called."""
    x64, device = jax.config.jax_enable_x64, jax.config.jax_default_device  # type: ignore[attr-defined]

    @contextmanager
    def as_there() -> Iterator[None]:
        with ExitStack() as stack:
            stack.enter_context(jax.enable_x64(x64))
            if device is not None:
                stack.enter_context(jax.default_device(device))
            yield

    return as_there
