"""One chunk of samples, reduced to its statistics on the host, in float64."""

import dataclasses
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from jimpact.montecarlo import histograms
from jimpact.montecarlo.drawing import BAD_INPUTS
from jimpact.montecarlo.moments import Moments, moments
from jimpact.status import STATUS, Status

LISTED = 20  # bad samples of a chunk (and of a run) that are listed one by one
SHOWN = 4096  # first samples of a run that are kept in memory for pictures

# name, message and whether it is a failure, of every code
OUTCOMES = [*STATUS, *(Status(*told, True) for told in BAD_INPUTS.values())]
FAILURE = np.array([row.failure for row in OUTCOMES])
_SAMPLE_FIELDS = ("gaps", "velocity_before", "velocity", "status")


@dataclass(frozen=True)
class Task:
    """What a chunk needs beside the plan: its number, how many samples count, bins, given rows."""

    number: int
    count: int
    ends: np.ndarray | None  # (n, 2) of the histograms; None: from this chunk
    rows: dict[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True)
class Chunk:
    """Statistics of one chunk; `values` are the velocities after (n), then the random gaps (m).

    Attributes:
        statuses: how many samples ended with each code.
        moments: of the samples that did not fail.
        low, high: smallest and largest velocities (n,); inf, -inf without any.
        ends, counts: histogram ranges (n, 2) and counts (n, bins + 2).
        bad: lanes, codes, gaps and velocities before of the first failed samples.
        samples: all samples, or the first few (`SHOWN`), or none.
    """

    number: int
    count: int
    statuses: np.ndarray
    moments: Moments
    low: np.ndarray
    high: np.ndarray
    ends: np.ndarray
    counts: np.ndarray
    bad: dict[str, np.ndarray]
    samples: dict[str, np.ndarray]

    def without_samples(self) -> "Chunk":
        """Without raw samples but the few first ones of a run."""
        shown = {k: v[:SHOWN].copy() for k, v in self.samples.items()} if self.number == 0 else {}
        return dataclasses.replace(self, samples=shown)

    def arrays(self) -> dict[str, np.ndarray]:
        """Everything as named arrays, for a file."""
        plain = {name: np.asarray(getattr(self, name)) for name in _PLAIN}
        parts = {f"moments.{k}": np.asarray(v) for k, v in vars(self.moments).items()}
        bad = {f"bad.{k}": v for k, v in self.bad.items()}
        return plain | parts | bad | {f"samples.{k}": v for k, v in self.samples.items()}


_PLAIN = ("number", "count", "statuses", "low", "high", "ends", "counts")


def chunk_from(arrays: dict[str, np.ndarray]) -> Chunk:
    """The inverse of `Chunk.arrays`."""

    def part(prefix: str) -> dict[str, np.ndarray]:
        start = f"{prefix}."
        return {k.removeprefix(start): v for k, v in arrays.items() if k.startswith(start)}

    own: dict[str, Any] = {name: arrays[name] for name in _PLAIN}
    own |= {name: int(own[name]) for name in ("number", "count")}
    m = part("moments")
    whole = Moments(int(m["count"]), m["mean"], m["products"])
    return Chunk(**own, moments=whole, bad=part("bad"), samples=part("samples"))


def reduced(task: Task, samples: dict[str, np.ndarray], bins: int, keep_samples: bool) -> Chunk:
    """The statistics of the first `task.count` samples of a chunk."""
    failed = FAILURE[samples["status"]]
    whole = np.concatenate([samples["velocity"].T, samples["gaps"].T]).astype(np.float64)
    n = samples["velocity"].shape[1]
    ends = task.ends
    if ends is None:
        ends = _first_ends(whole[:n, ~failed], samples["status"])
    count = task.count
    failed = failed[:count]
    used = whole[:, :count] if not failed.any() else whole[:, :count][:, ~failed]
    velocity = used[:n]
    lanes = np.flatnonzero(failed)[:LISTED]
    bad = {"lane": lanes} | {name: samples[name][lanes] for name in _SAMPLE_FIELDS}
    kept = count if keep_samples else (min(count, SHOWN) if task.number == 0 else 0)
    return Chunk(
        number=task.number,
        count=count,
        statuses=np.bincount(samples["status"][:count], minlength=len(FAILURE)),
        moments=moments(used),
        low=velocity.min(axis=1, initial=np.inf),
        high=velocity.max(axis=1, initial=-np.inf),
        ends=ends,
        counts=histograms.bin_counts(velocity, ends, bins),
        bad=bad,
        samples={k: v[:kept].copy() for k, v in samples.items()} if kept else {},
    )


def _first_ends(velocity: np.ndarray, status: np.ndarray) -> np.ndarray:
    """Histogram ranges from the first chunk; an error where not one of its samples is usable."""
    if velocity.shape[1] == 0:
        told = ", ".join(f"{count} {name}" for name, count in named(np.bincount(status)).items())
        raise RuntimeError(
            f"Not one of the first {len(status)} samples gave a usable outcome: {told}."
        )
    return histograms.bin_range(velocity)


def named(counts: np.ndarray) -> dict[str, int]:
    """Status counts by name, those that occurred."""
    return {OUTCOMES[code].name: int(counts[code]) for code in np.flatnonzero(counts)}
