"""A progress bar on stderr for fits that turn out to be long."""

import contextlib
import sys
import threading
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

BAR_AFTER = 2.0  # seconds after which a fit counts as long


@contextlib.contextmanager
def progress_bar(
    starts: int, max_steps: int, progress: bool | None
) -> Iterator[Callable[[int, int], None]]:
    """Yield `show(starts done, steps)`; the bar appears once the fit turns out to be long."""
    if not (sys.stderr.isatty() if progress is None else progress):
        yield lambda done, steps: None
        return
    text = TextColumn("fit: {task.fields[ready]} of {task.fields[starts]} starts done, step")
    count = TextColumn("{task.completed} of at most {task.total}")
    console = Console(stderr=True, force_terminal=True if progress else None)
    bar = Progress(text, count, BarColumn(), TimeElapsedColumn(), console=console, transient=True)
    task = bar.add_task("fit", total=max_steps, ready=0, starts=starts)
    timer = threading.Timer(BAR_AFTER, bar.start)
    (bar if progress else timer).start()
    try:
        yield lambda done, steps: bar.update(task, completed=steps, ready=done)
    finally:
        timer.cancel()
        bar.stop()
