"""Progress bars on stderr for work that turns out to be long: fits, samples, stages of a chart."""

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

BAR_AFTER = 2.0  # seconds after which work counts as long


@contextlib.contextmanager
def progress_bar(progress: bool | None) -> Iterator[Callable[[str, float, float | None], None]]:
    """Yield `show(what, done, total)`; total None: nobody knows.

    The bar is there at once if `progress`; None: only on a terminal, once the work turns out long.
    """
    if not (sys.stderr.isatty() if progress is None else progress):
        yield lambda what, done, total: None
        return
    console = Console(stderr=True, force_terminal=True if progress else None)
    columns = TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn()
    bar = Progress(*columns, TimeRemainingColumn(), console=console, transient=True)
    task = bar.add_task("", total=None)
    timer = threading.Timer(BAR_AFTER, bar.start)
    (bar if progress else timer).start()
    try:
        yield lambda what, done, total: bar.update(
            task, description=what, completed=done, total=total
        )
    finally:
        timer.cancel()
        bar.stop()


@contextlib.contextmanager
def waiting(what: str, progress: bool | None = None) -> Iterator[None]:
    """A bar for work that does not tell how far it is: only its time runs."""
    with progress_bar(progress) as show:
        show(what, 0.0, None)
        yield


@contextlib.contextmanager
def counting_bar(
    total: int, unit: str, progress: bool | None, done: int = 0
) -> Iterator[Callable[[int], None]]:
    """Yield `advance(more)`: how many of all there are; `done` before count for no rate."""
    begin, new = time.perf_counter(), 0
    with progress_bar(progress) as show:

        def advance(more: int) -> None:
            nonlocal new
            new += more
            rate = new / max(time.perf_counter() - begin, 1e-9)
            show(f"{done + new:,} of {total:,} {unit}, {rate:,.0f}/s", done + new, total)

        yield advance
