"""How long calls take: in turns, so that a busy machine slows all of them alike."""

import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

SHORT = 2e-3  # seconds; what is faster is run several times for one measurement
MOST_RUNS = 20
LEAST_REPEATS = 3
BUDGET = 2.0  # seconds for one call, after which it is not repeated more than that


def seconds(run: Callable[[], Any], count: int = 1) -> float:
    """Mean time of `count` calls, until their results are there."""
    begin = time.perf_counter()
    for _ in range(count):
        jax.block_until_ready(run())
    return (time.perf_counter() - begin) / count


def in_turns(
    runs: Sequence[Callable[[], Any]], repeats: int, advance: Callable[[], Any] = lambda: None
) -> list[np.ndarray]:
    """Times [s] of each of `runs`, as many as `repeats`, fewer of slow ones; `advance` at each."""
    warm = [min(seconds(run), seconds(run)) for run in runs]  # the first call may compile
    counts = [int(np.clip(SHORT / max(t, 1e-9), 1, MOST_RUNS)) for t in warm]
    taken: list[list[float]] = [[] for _ in runs]
    for _ in range(repeats):
        for run, count, kept in zip(runs, counts, taken):
            if len(kept) < LEAST_REPEATS or count * sum(kept) < BUDGET:
                kept.append(seconds(run, count))
            advance()
    return [np.array(kept) for kept in taken]
