"""Times of many programs, taken in turns so that whatever else the machine does hits all alike."""

import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from jimpact.methods.charts.record import Timing

SHORT = 2e-3  # seconds; what is faster is run several times for one measurement
MOST_RUNS = 20
LEAST_REPEATS = 3
BUDGET = 2.0  # seconds for one program, after which it is not repeated more than that


def in_turns(
    tasks: list[tuple[Callable[[], Any], int]], repeats: int, advance: Callable[[], None]
) -> list[Timing]:
    """Time per impact of each task `(run, impacts)`: quartiles over the repeats."""
    runs = [_runs(_seconds(run, 1)) for run, _ in tasks]
    taken: list[list[float]] = [[] for _ in tasks]
    for _ in range(repeats):
        for (run, _), count, kept in zip(tasks, runs, taken):
            if len(kept) < LEAST_REPEATS or count * sum(kept) < BUDGET:
                kept.append(_seconds(run, count))
            advance()
    per_impact = [np.array(kept) / impacts for kept, (_, impacts) in zip(taken, tasks)]
    return [Timing(*(float(q) for q in np.quantile(t, (0.5, 0.25, 0.75)))) for t in per_impact]


def _runs(seconds: float) -> int:
    return int(np.clip(SHORT / max(seconds, 1e-9), 1, MOST_RUNS))


def _seconds(run: Callable[[], Any], count: int) -> float:
    begin = time.perf_counter()
    for _ in range(count):
        jax.block_until_ready(run())
    return (time.perf_counter() - begin) / count


@contextlib.contextmanager
def stage_bar(
    progress: bool | None,
) -> Iterator[tuple[Callable[[str, int], None], Callable[[], None]]]:
    """Yield `stage(what, steps)`, which begins something new, and `advance()` by a step of it."""
    if not (sys.stderr.isatty() if progress is None else progress):
        yield lambda what, steps: None, lambda: None
        return
    console = Console(stderr=True, force_terminal=True if progress else None)
    text = TextColumn("{task.description}")
    with Progress(text, BarColumn(), TimeElapsedColumn(), console=console, transient=True) as bar:
        task = bar.add_task("", total=None)

        def stage(what: str, steps: int) -> None:
            bar.reset(task, total=steps, description=what)

        yield stage, lambda: bar.advance(task)
