"""Progress of long work on stderr: a bar on a terminal, elsewhere a line now and
then.
"""

import contextlib
import re
import shutil
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator

from jimpact.tools.checks import check_values

# seconds after which work counts as long: sooner, messages would only flicker
LONG = 2.0
LINE_EVERY = 10.0  # seconds between two lines about one step, a few for each minute

FIRST = "compiling"  # the step until the work reports one

# show(step, done, total), total None: unknown
Show = Callable[[str, float, float | None], None]


class Patience(float):
    """Seconds after which work is reported; lines about it count time from when this
    was made.
    """

    def __init__(self, seconds: float) -> None:
        self.begun = time.monotonic()


@contextlib.contextmanager
def progress_bar(progress: float | None) -> Iterator[Show]:
    """Yield `show(step, done, total)`; total None: not known.

    `progress`: seconds after which the work is long enough to be reported; True: at
    once; False: never; None: after two seconds, and only on a terminal.
    """
    terminal = sys.stderr.isatty()
    if progress is False or (progress is None and not terminal):
        yield lambda step, done, total: None
        return
    check_values("progress", progress, low=0.0)
    if progress is None:
        after = LONG
    elif progress is True:
        after = 0.0
    else:
        after = progress
    with (_bar if terminal and _has_bars() else _lines)(after) as show:
        yield show


def _has_bars() -> bool:
    """True if the package rich is installed; a long run does not fail without it."""
    try:
        import rich.progress  # noqa: F401
    except ImportError:
        return False
    return True


@contextlib.contextmanager
def _bar(after: float) -> Iterator[Show]:
    """Yield `show` of a bar of the package rich, which appears `after` this time
    [s].
    """
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn as Remaining,
    )

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TimeElapsedColumn(),
        Remaining(),
    )
    bar = Progress(*columns, console=Console(stderr=True), transient=True)
    task = bar.add_task(FIRST, total=None)
    timer = threading.Timer(after, bar.start)
    timer.daemon = True
    timer.start()
    try:
        yield lambda step, done, total: bar.update(
            task, description=step, completed=done, total=total
        )
    finally:
        timer.cancel()
        bar.stop()


@contextlib.contextmanager
def _lines(after: float) -> Iterator[Show]:
    """Yield `show` of lines on stderr with the latest step: the first one `after` this
    time [s].

    Others follow each `LINE_EVERY`; where `after` is 0 one more is printed at the end.
    Their seconds count from now, or from when `after` was made, if it is a `Patience`.
    """
    begun = getattr(after, "begun", time.monotonic())
    ended = threading.Event()
    latest = FIRST

    def report() -> None:
        """Print the latest step and the seconds since the work began."""
        print(f"{latest}, {time.monotonic() - begun:.0f} s", file=sys.stderr)

    def run() -> None:
        """Print reports in a thread, until the work has ended."""
        wait = after or LINE_EVERY
        while not ended.wait(wait):
            report()
            wait = LINE_EVERY

    def show(step: str, done: float, total: float | None) -> None:
        """Keep the step for the next line."""
        nonlocal latest
        latest = step

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield show
    finally:
        ended.set()
        thread.join()
        if not after:
            report()


@contextlib.contextmanager
def waiting(step: str, progress: float | None = None) -> Iterator[None]:
    """Progress of work that reports nothing itself: only its time runs."""
    with progress_bar(progress) as show:
        show(step, 0.0, None)
        yield


@contextlib.contextmanager
def counting_bar(
    total: int, unit: str, progress: float | None, done: int = 0
) -> Iterator[Callable[[int], None]]:
    """Yield `advance(more)`, which counts `more` of a `unit` up to a `total` and shows
    the rate.

    `progress` as of `progress_bar`, `done` are finished before. The rate counts from
    the first advance on, which waits for a program to be compiled.
    """
    # when the first advance came, and what was finished then
    began = None
    finished = done
    with progress_bar(progress) as show:

        def advance(more: int) -> None:
            """Add `more` to what is finished, and show it with the rate and the time
            left.
            """
            nonlocal began, finished
            finished += more
            now = time.perf_counter()
            began = began or (now, finished)
            rate = (finished - began[1]) / max(now - began[0], 1e-9)
            text = f"{finished:,} of {total:,} {unit}"
            if rate >= 10:
                text += f", {rate:,.0f}/s"
            if rate and not sys.stderr.isatty():  # a bar shows the time left itself
                text += f", {(total - finished) / rate:,.0f} s left"
            show(text, finished, total)

        yield advance


class Steps:
    """The steps that a command has done, each printed on stderr once the command is
    long.
    """

    def __init__(self, command: str):
        self.command = command
        self.patience = Patience(LONG)
        self.done: list[str] = []
        # prints and writes what is finished; None: nothing is that could be shown
        self.show_finished: Callable[[], None] | None = None

    def __call__(self, step: str) -> None:
        """Record a `step` that is done; print it where the command has run longer than
        `LONG`.
        """
        self.done.append(step)
        seconds = time.monotonic() - self.patience.begun
        if seconds > LONG:
            print(wrapped(f"{self.command}: {step} ({seconds:.0f} s)"), file=sys.stderr)


def wrapped(text: str) -> str:
    """The text with its sentences wrapped to the terminal's width; tables are left
    unchanged.

    A sentence behind a word or two and spaces, such as "status   ok", is wrapped within
    its column.
    """
    width = shutil.get_terminal_size((len(text), 0)).columns
    lines = []
    for line in text.splitlines():
        indent = re.match(r" *(- )?", line)[0]  # type: ignore[index]
        head = re.match(r"\S+(?: \S+)?  +", line)  # one or two words and spaces
        if head is None:
            start = indent
        else:
            start = head[0]
        if len(line) > width and "  " not in line[len(start) :]:  # no columns: no table
            line = textwrap.fill(line, width, subsequent_indent=" " * len(start))
        lines.append(line)
    return "\n".join(lines)
