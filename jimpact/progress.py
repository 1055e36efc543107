"""Progress bars on stderr for work that turns out to be long: fits, samples, stages of a chart."""

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    ProgressColumn,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

BAR_AFTER = 2.0  # seconds after which work counts as long


@contextlib.contextmanager
def _bar(progress: bool | None, *columns: ProgressColumn) -> Iterator[Progress | None]:
    """A bar, at once if `progress`; None: only on a terminal, once the work turns out long."""
    if not (sys.stderr.isatty() if progress is None else progress):
        yield None
        return
    console = Console(stderr=True, force_terminal=True if progress else None)
    bar = Progress(*columns, console=console, transient=True)
    timer = threading.Timer(BAR_AFTER, bar.start)
    (bar if progress else timer).start()
    try:
        yield bar
    finally:
        timer.cancel()
        bar.stop()


@contextlib.contextmanager
def progress_bar(
    starts: int, max_steps: int, progress: bool | None
) -> Iterator[Callable[[int, int], None]]:
    """Yield `show(starts done, steps)` for a fit."""
    text = TextColumn("fit: {task.fields[ready]} of {task.fields[starts]} starts done, step")
    count = TextColumn("{task.completed} of at most {task.total}")
    with _bar(progress, text, count, BarColumn(), TimeElapsedColumn()) as bar:
        if bar is None:
            yield lambda done, steps: None
            return
        task = bar.add_task("fit", total=max_steps, ready=0, starts=starts)
        yield lambda done, steps: bar.update(task, completed=steps, ready=done)


@contextlib.contextmanager
def sample_bar(samples: int, done: int, progress: bool | None) -> Iterator[Callable[[int], None]]:
    """Yield `advance(samples)`; `done` of them were there before and count for no rate."""
    columns = (
        TextColumn("{task.fields[count]}"),
        BarColumn(),
        TaskProgressColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
    )
    with _bar(progress, *columns) as bar:
        if bar is None:
            yield lambda more: None
            return
        count = f"{done:,} of {samples:,} samples"
        task = bar.add_task("samples", total=samples, completed=done, count=count, rate="")
        begin, new = time.perf_counter(), 0

        def advance(more: int) -> None:
            nonlocal new
            new += more
            rate = new / max(time.perf_counter() - begin, 1e-9)
            count = f"{done + new:,} of {samples:,} samples"
            bar.update(task, advance=more, count=count, rate=f"{rate:,.0f}/s")

        yield advance


@contextlib.contextmanager
def stage_bar(
    progress: bool | None,
) -> Iterator[tuple[Callable[[str, int], None], Callable[[], None]]]:
    """Yield `stage(what, steps)`, which begins something new, and `advance()` by a step of it."""
    with _bar(progress, TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn()) as bar:
        if bar is None:
            yield lambda what, steps: None, lambda: None
            return
        task = bar.add_task("", total=None)
        yield (
            lambda what, steps: bar.reset(task, total=steps, description=what),
            lambda: bar.advance(task),
        )
