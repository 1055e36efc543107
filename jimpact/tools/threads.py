"""Work in threads, one for each core that the process may use: programs of XLA run side
by side.
"""

import os
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from functools import partial
from itertools import chain, islice
from typing import Any, TypeVar

import equinox as eqx
import jax
import numpy as np

from jimpact.tools.checks import as_whole

Task = TypeVar("Task")
Result = TypeVar("Result")

# Tasks that wait for each thread beside the one that it works on. Ten times more: their
# results fill the memory; none: threads wait for the caller.
_AHEAD = 1


def usable_cores() -> int:
    """Cores that this process may use, which may be fewer than the machine has."""
    if hasattr(os, "sched_getaffinity"):  # on Linux
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def as_workers(workers: Any) -> int:
    """A number of threads, None: one for each core that the process may use."""
    if workers is None:
        return usable_cores()
    return as_whole("workers", workers, 1)


def in_threads(
    function: Callable[[Task], Result],
    tasks: Iterable[Task],
    workers: Any = None,
    compiles: bool = False,
) -> Generator[Result]:
    """`function(task)` of each task, in their order, whatever the number of threads.

    JAX releases Python's lock while a program runs, and most programs of impacts use
    one core. An error of a task is raised where its result would come; tasks that have
    not begun are then dropped.

    Args:
        function: of one task; it sees the caller's settings of JAX.
        tasks: any iterable; some `workers` of them are taken ahead.
        workers: threads >= 1; None: one for each core that the process may use.
        compiles: whether the first task compiles what the others run: they wait for it,
            lest each thread compiles the same program.

    Yields:
        The results.

    Raises:
        ValueError: no such number of workers.

    >>> from jimpact.tools.threads import in_threads
    >>> list(in_threads(lambda x: x**2, range(4), workers=2))
    [0, 1, 4, 9]
    """
    count = as_workers(workers)
    tasks = iter(tasks)
    if compiles or count == 1:
        yield from map(function, islice(tasks, None if count == 1 else 1))
    first = list(islice(tasks, 2))
    if len(first) < 2:  # one task needs no thread
        yield from map(function, first)
        return
    as_here = _settings()

    def one(task: Task) -> Result:
        """Result of a task with the caller's settings of JAX, which belong to a
        thread.
        """
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


def in_parts(
    function: Callable[..., Any],
    trees: Sequence[Any],
    size: int,
    which: np.ndarray | None = None,
    workers: int | None = None,
    compiles: bool = True,
) -> Iterator[tuple[np.ndarray, Any]]:
    """`function` applied to rows of arrays, `size` rows at a time: one program for all
    parts.

    Args:
        function: of trees like these, with `size` rows each.
        trees: whose arrays have rows in their first axis.
        size: rows of a part; the last row is repeated where one is not full.
        which: rows that are asked for; None: all.
        workers: as of `in_threads`, as the next one.
        compiles: whether the function is compiled by the first part.

    Yields:
        The rows (size,) of a part, and what the function makes of them, on the host.

    >>> import numpy as np
    >>> from jimpact.tools.threads import in_parts
    >>> [
    ...     (rows.tolist(), y.tolist())
    ...     for rows, y in in_parts(lambda x: 2 * x, [np.arange(3)], 2)
    ... ]
    [([0, 1], [0, 2]), ([2, 2], [4, 4])]
    """
    if which is None:
        which = np.arange(len(jax.tree.leaves(trees)[0]))

    def rows(first: int) -> np.ndarray:
        """Numbers (size,) of the rows of the part from `which[first]` on, the last one
        repeated.
        """
        return which[np.minimum(np.arange(first, first + size), len(which) - 1)]

    def result(first: int) -> Any:
        """Result of the function for the part from `which[first]` on, on the host."""
        chosen = rows(first)
        pick = partial(jax.tree.map, lambda x: x[chosen] if eqx.is_array(x) else x)
        return jax.device_get(function(*map(pick, trees)))

    starts = range(0, len(which), size)
    yield from zip(map(rows, starts), in_threads(result, starts, workers, compiles))


def _settings() -> Callable[[], Any]:
    """A context manager that sets JAX's precision and device as they are at this call.

    JAX keeps both for each thread by itself.
    """
    x64, device = jax.config.jax_enable_x64, jax.config.jax_default_device  # type: ignore[attr-defined]

    @contextmanager
    def as_at_call() -> Iterator[None]:
        """Set the precision and the device, and restore both at the end."""
        with ExitStack() as stack:
            stack.enter_context(jax.enable_x64(x64))
            if device is not None:
                stack.enter_context(jax.default_device(device))
            yield

    return as_at_call
