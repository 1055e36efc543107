"""A progress bar on stderr for runs that turn out to be long, with rate and remaining time."""

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from jimpact.progress import BAR_AFTER


@contextlib.contextmanager
def sample_bar(samples: int, done: int, progress: bool | None) -> Iterator[Callable[[int], None]]:
    """Yield `advance(samples)`; `done` of them were there before and count for no rate.

    `progress` None: only on a terminal, and only once the run turns out to be long.
    """
    if not (sys.stderr.isatty() if progress is None else progress):
        yield lambda more: None
        return
    console = Console(stderr=True, force_terminal=True if progress else None)
    columns = (
        TextColumn("{task.fields[count]}"),
        BarColumn(),
        TaskProgressColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
    )
    bar = Progress(*columns, console=console, transient=True)
    count = f"{done:,} of {samples:,} samples"
    task = bar.add_task("samples", total=samples, completed=done, count=count, rate="")
    timer = threading.Timer(BAR_AFTER, bar.start)
    (bar if progress else timer).start()
    begin, new = time.perf_counter(), 0

    def advance(more: int) -> None:
        nonlocal new
        new += more
        rate = new / max(time.perf_counter() - begin, 1e-9)
        count = f"{done + new:,} of {samples:,} samples"
        bar.update(task, advance=more, count=count, rate=f"{rate:,.0f}/s")

    try:
        yield advance
    finally:
        timer.cancel()
        bar.stop()
