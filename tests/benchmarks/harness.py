"""What the benchmarks share: alternating repeats, quartiles, tables on screen and as CSV, charts.

Every figure that matters is a ratio of two medians measured side by side in one run. The load
average is recorded with them: on a machine that does other work the times are not worth much.
"""

import argparse
import contextlib
import csv
import datetime
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402

RESULTS = Path(__file__).parent / "results"
STARTED = time.perf_counter()


class Timing(NamedTuple):
    """Seconds of the repeats: wall clock, and processor over all threads."""

    wall: np.ndarray
    cpu: np.ndarray


def arguments(
    description: str, add: Callable[[argparse.ArgumentParser], None] | None = None
) -> argparse.Namespace:
    """`--quick` (tiny batches: does it run?), `--out`, and what `add` adds."""
    parser = argparse.ArgumentParser(description=description.splitlines()[0])
    if add is not None:
        add(parser)
    parser.add_argument(
        "--quick", action="store_true", help="tiny batches: only whether it runs"
    )
    parser.add_argument(
        "--out", type=Path, default=None, help=f"folder; default {RESULTS.name}/"
    )
    options = parser.parse_args()
    if options.out is None:
        options.out = Path("jimpact-out") if options.quick else RESULTS
    options.out.mkdir(parents=True, exist_ok=True)
    return options


@contextlib.contextmanager
def stage(name: str) -> Iterator[None]:
    """Tells on stderr what runs and how long it took."""
    start = time.perf_counter()
    print(f"[{start - STARTED:6.1f} s] {name} ...", file=sys.stderr, flush=True)
    yield
    print(f"{'':10} {time.perf_counter() - start:.1f} s", file=sys.stderr, flush=True)


def timed(run: Callable[[], Any]) -> tuple[float, float, Any]:
    """Wall and processor seconds of one call that waits for its result, and the result."""
    wall, cpu = time.perf_counter(), time.process_time()
    out = jax.block_until_ready(run())
    return time.perf_counter() - wall, time.process_time() - cpu, out


def alternating(runs: dict[str, Callable[[], Any]], repeats: int) -> dict[str, Timing]:
    """Times of all runs in turn, after one call each for compilation."""
    for run in runs.values():
        timed(run)
    seconds: dict[str, list[tuple[float, float]]] = {name: [] for name in runs}
    for _ in range(repeats):
        for name, run in runs.items():
            seconds[name].append(timed(run)[:2])
    both = {name: np.asarray(pairs) for name, pairs in seconds.items()}
    return {name: Timing(t[:, 0], t[:, 1]) for name, t in both.items()}


def quartiles(values: Any) -> tuple[float, float, float]:
    """Lower quartile, median, upper quartile."""
    low, middle, high = np.percentile(np.asarray(values, float), [25, 50, 75])
    return float(low), float(middle), float(high)


def columns(timing: Timing, per: float, base: Timing | None = None) -> dict[str, float]:
    """Table entries: microseconds of one of `per` items, and the ratio to `base`, repeat by repeat."""
    low, middle, high = quartiles(timing.wall / per * 1e6)
    row = {
        "us": middle,
        "us_q1": low,
        "us_q3": high,
        "cpu_us": float(np.median(timing.cpu)) / per * 1e6,
    }
    if base is not None:
        # processor time: a neighbour on the machine disturbs it less than the wall clock
        row["ratio_cpu"] = float(np.median(timing.cpu / np.maximum(base.cpu, 1e-9)))
        names = ("ratio_q1", "ratio", "ratio_q3")
        row |= dict(zip(names, quartiles(timing.wall / base.wall)))
    return row


def show(title: str, rows: Sequence[dict[str, Any]], keys: Sequence[str]) -> None:
    """The table on screen."""
    table = Table(title=title, title_justify="left")
    for key in keys:
        text = any(isinstance(row.get(key), str) for row in rows)
        table.add_column(key.replace("_", " "), justify="left" if text else "right")
    for row in rows:
        table.add_row(*(_text(row.get(key)) for key in keys))
    Console(width=None if sys.stdout.isatty() else 140).print(table)


def _text(value: Any) -> str:
    if value is None or (isinstance(value, float) and np.isnan(value)):
        return "-"
    if isinstance(value, str | int):
        return str(value)
    if value != 0 and not 1e-2 <= abs(value) < 1e5:
        return f"{value:.2e}"
    return f"{value:.2f}" if abs(value) < 100 else f"{value:.0f}"


def write_csv(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """All entries of all rows, with date and load average of the last minute."""
    stamp = {
        "date": datetime.date.today().isoformat(),
        "load_average": f"{os.getloadavg()[0]:.2f}",
    }
    keys = list(dict.fromkeys(key for row in rows for key in row))
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, [*keys, *stamp], lineterminator="\n")
        writer.writeheader()
        for row in rows:
            kept = {
                k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()
            }
            writer.writerow(kept | stamp)
    print(f"written: {path}")


def save_figure(figure: Any, path: Path) -> None:
    """A picture small enough to be committed."""
    figure.savefig(path, dpi=100)
    print(f"written: {path}")


def loosest(
    error_of: Callable[[float], float], settings: Sequence[float], target: float
) -> tuple[float, float]:
    """First setting, and its error, that reaches the target and whose successor does, too.

    Settings run from loose to fine. Errors are not monotone: one may reach the target by luck.
    Where none does, the last one and its error.
    """
    before: tuple[float, float] | None = None
    for setting in settings:
        now = (setting, error_of(setting))
        if now[1] <= target and before is not None:
            return before
        before = now if now[1] <= target else None
    return now
