"""Times of calls, measured in turns, so that a busy machine slows all of them alike."""

import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

SHORT = 2e-3  # [s]: calls that are faster are run several times for one measurement, so that the
MOST_RUNS = 20  # clock's resolution does not count, but no more often than this
BUDGET = 2.0  # [s] for one call, after which it is not repeated
LEAST_REPEATS = 3  # more often than this


def seconds(run: Callable[[], Any], count: int = 1) -> float:
    """Mean time [s] of `count` calls, results computed."""
    begin = time.perf_counter()
    for _ in range(count):
        jax.block_until_ready(run())
    return (time.perf_counter() - begin) / count


def in_turns(
    runs: Sequence[Callable[[], Any]], repeats: int, advance: Callable[[], Any] = lambda: None
) -> list[np.ndarray]:
    """`repeats` times [s] of each of `runs`, fewer of slow ones; `advance` is called after each."""
    warm = [min(seconds(run), seconds(run)) for run in runs]  # the first call may compile
    counts = [int(np.clip(SHORT / max(t, 1e-9), 1, MOST_RUNS)) for t in warm]
    times: list[list[float]] = [[] for _ in runs]
    for _ in range(repeats):
        for run, count, measured in zip(runs, counts, times):
            if len(measured) < LEAST_REPEATS or count * sum(measured) < BUDGET:
                measured.append(seconds(run, count))
            advance()
    return [np.array(measured) for measured in times]
