"""Statistics in float64 on the host: of a chunk of samples, and of chunks that are
joined.

A chunk is a mapping of arrays, as its file holds them: `number`, `count` of its
samples, `statuses` (how many ended with each code), `used` of them that did not fail
with their `mean` and `products` of deviations over the velocities after (n) and the
random gaps (m), `low` and `high` (n,), `ends` (n, 2) and `counts` (n, bins + 2) of
histograms; `tolerance` (2,), see `Tolerance`; `bad.*`: numbers, codes, gaps and
velocities of the first failed samples; `raw.*`: all samples, or the first few
(`IN_MEMORY`) of a run, or none.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from jimpact.tools.status import STATUS, Status

# of the first chunk's range, added on both sides: later chunks reach further
MARGIN = 0.1
FLAT = 1e-6  # relative half width of the range of a quantity that does not vary
LISTED = 20  # bad samples of a chunk (and of a run) that are listed one by one
IN_MEMORY = 4096  # first samples of a run that stay in memory, for pictures
# Outcomes of a sample: those of an impact, and further ones where it never reached the
# law.
OUTCOMES = (
    *STATUS,
    Status(
        "bad_gap",
        "a drawn gap is not finite or an overlap: see LZB's `initial_energy`",
        failure=True,
    ),
    Status("bad_velocity", "a drawn velocity is not finite", failure=True),
    Status(
        "bad_law", "a drawn parameter is not finite or outside its domain", failure=True
    ),
)
BAD_GAP, BAD_VELOCITY, BAD_LAW = range(len(STATUS), len(OUTCOMES))
FAILURE = np.array([row.failure for row in OUTCOMES])

Chunk = dict[str, np.ndarray]


class Tolerance(NamedTuple):
    """Tolerance of the impacts of a run, and the error that it makes."""

    rtol: float = 0.0  # of `impact`; 0: the law's own
    # beside the law's default, in standard deviations: see `tolerance.py`
    error: float = 0.0


AS_THE_LAW = Tolerance()


@dataclass(frozen=True)
class Task:
    """Inputs of one chunk, besides those of the run."""

    number: int  # from 0
    count: int  # samples that are used, the first ones
    ends: np.ndarray | None  # (n, 2) of the histograms; None: from this chunk
    rows: dict[str, np.ndarray]  # given samples by name of the source
    tolerance: Tolerance = AS_THE_LAW


def part(chunk: Chunk, prefix: str) -> Chunk:
    """Arrays of a chunk whose names begin with `prefix.`, by the rest of their
    names.
    """
    start = f"{prefix}."
    named_so = {k: v for k, v in chunk.items() if k.startswith(start)}
    return {k.removeprefix(start): v for k, v in named_so.items()}


def moments(values: np.ndarray) -> Chunk:
    """Number, mean (d,) and sums of products of deviations (d, d) of `values` (d,
    count).

    Equation: `mean = sum_k x_k / count`, `products = sum_k (x_k - mean)(x_k - mean)^T`,
    in float64 whatever their type.

    >>> import numpy as np
    >>> from jimpact.montecarlo.statistics import moments
    >>> {name: x.tolist() for name, x in moments(np.array([[1.0, 2.0, 3.0]])).items()}
    {'used': 3, 'mean': [2.0], 'products': [[2.0]]}
    """
    values = np.ascontiguousarray(values, dtype=np.float64)
    count = values.shape[1]
    mean = values.sum(axis=1) / max(count, 1)  # along contiguous rows: pairwise
    deviation = values - mean[:, None]
    # not BLAS: its summation order depends on the number of threads
    products = np.einsum("ik,jk->ij", deviation, deviation)
    return {"used": np.array(count), "mean": mean, "products": products}


def merged(a: Chunk, b: Chunk) -> Chunk:
    """Moments (see `moments`) of the samples of a and b together.

    Equation: `mean = mean_a + d n_b / n`, `S = S_a + S_b + d d^T n_a n_b / n`, with n
    the numbers `used`, S the `products`, `d = mean_b - mean_a`. Not associative in
    floating point: merge in a fixed order.

    Source: Chan, Golub and LeVeque, Am. Statistician 37 (1983) 242.

    >>> import numpy as np
    >>> from jimpact.montecarlo.statistics import merged, moments
    >>> both = merged(moments(np.array([[1.0]])), moments(np.array([[3.0]])))
    >>> {name: x.tolist() for name, x in both.items()}
    {'used': 2, 'mean': [2.0], 'products': [[2.0]]}
    """
    used = a["used"] + b["used"]
    n = max(used, 1)
    d = b["mean"] - a["mean"]
    weight = a["used"] * b["used"] / n
    products = a["products"] + b["products"] + np.outer(d, d) * weight
    # without samples a mean is 0
    mean = a["mean"] + d * (b["used"] / n)
    return {"used": np.array(used), "mean": mean, "products": products}


def bin_range(values: np.ndarray) -> np.ndarray:
    """Low and high ends (d, 2) for the bins of `values` (d, count): the range with a
    margin.

    Equation: `[low - margin, high + margin]`, margin = `MARGIN` (high - low).
    """
    low = values.min(axis=1).astype(float)
    high = values.max(axis=1).astype(float)
    size = np.maximum(np.abs(low), np.abs(high))
    flat = FLAT * np.where(size > 0, size, 1.0)
    margin = np.maximum(MARGIN * (high - low), flat)  # also where the range is rounding
    return np.stack([low - margin, high + margin], axis=1)


def bin_counts(values: np.ndarray, ends: np.ndarray, bins: int) -> np.ndarray:
    """Counts (d, bins + 2): below `ends`, in each bin, at or above the upper end.

    >>> import numpy as np
    >>> from jimpact.montecarlo.statistics import bin_counts
    >>> bin_counts(
    ...     np.array([[-1.0, 0.1, 0.6, 0.7, 1.0]]), np.array([[0.0, 1.0]]), 2
    ... ).tolist()
    [[1, 1, 2, 1]]
    """
    rows = zip(values.astype(float), bin_edges(ends, bins))
    return np.array(
        [np.bincount(np.digitize(x, edges), minlength=bins + 2) for x, edges in rows]
    )


def bin_edges(ends: np.ndarray, bins: int) -> np.ndarray:
    """Bin edges (d, bins + 1), evenly spaced between the ends (d, 2)."""
    low_ends = ends[:, 0]
    high_ends = ends[:, 1]
    return np.linspace(low_ends, high_ends, bins + 1, axis=1)


def binned_quantiles(
    q: Any, ends: np.ndarray, counts: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """The q-quantiles (..., d), right to one bin width where they lie inside the bins.

    The inverse of the cumulated `counts` (d, bins + 2) over the edges, linear inside a
    bin; `low` and `high` (d,), the smallest and largest values, are the ends of the two
    outer bins.

    >>> import numpy as np
    >>> from jimpact.montecarlo.statistics import binned_quantiles
    >>> counts, ends = np.array([[0, 1, 1, 0]]), np.array([[0.0, 1.0]])
    >>> binned_quantiles(0.75, ends, counts, np.array([0.1]), np.array([0.9])).tolist()
    [0.75]
    """
    first = np.minimum(low, ends[:, 0])
    last = np.maximum(high, ends[:, 1])
    inner = bin_edges(ends, counts.shape[1] - 2)
    edges = np.column_stack([first, inner, last])
    # number of values below each edge
    from_zero = np.column_stack([np.zeros(len(counts)), counts])
    below = np.cumsum(from_zero, axis=1)
    # from above: of an empty stretch between two bins the lower end is taken
    quantiles = []
    for b, edge in zip(below, edges):
        wanted = np.asarray(q) * b[-1]
        quantiles.append(np.interp(-wanted, -b[::-1], edge[::-1]))
    joined_quantiles = np.stack(quantiles, axis=-1)
    return np.clip(joined_quantiles, low, high)


def reduced(task: Task, samples: Chunk, bins: int, keep_samples: bool) -> Chunk:
    """Statistics of the first `task.count` of the `samples` of a chunk, see the module
    docstring.

    Failed samples count by status only; `keep_samples`: all raw samples are among them.
    """
    status = samples["status"]
    n = samples["velocity"].shape[1]
    count = task.count
    fine = ~FAILURE[status]
    # (n + m, C): velocities after and random gaps of the C samples
    both = np.concatenate([samples["velocity"].T, samples["gaps"].T])
    values = both.astype(np.float64)
    ends = task.ends
    if ends is None:  # the first chunk sets the histograms
        if not fine.any():
            by_status = named(np.bincount(status)).items()
            counts = ", ".join(f"{k} {name}" for name, k in by_status)
            raise RuntimeError(
                f"None of the first {len(status)} samples gave a usable outcome: "
                f"{counts}."
            )
        ends = bin_range(values[:n, fine])
    used = values[:, :count][:, fine[:count]]
    lanes = np.flatnonzero(~fine[:count])[:LISTED]  # of failed samples
    if keep_samples:
        raw = count
    elif task.number == 0:
        raw = min(count, IN_MEMORY)
    else:
        raw = 0
    return {
        "number": np.array(task.number),
        "count": np.array(count),
        "tolerance": np.array(task.tolerance),
        "statuses": np.bincount(status[:count], minlength=len(FAILURE)),
        **moments(used),
        "low": used[:n].min(axis=1, initial=np.inf),
        "high": used[:n].max(axis=1, initial=-np.inf),
        "ends": ends,
        "counts": bin_counts(used[:n], ends, bins),
        "bad.index": task.number * len(status) + lanes,
        **{f"bad.{name}": x[lanes] for name, x in samples.items()},
        **(
            {f"raw.{name}": x[:raw].copy() for name, x in samples.items()}
            if raw
            else {}
        ),
    }


def joined(before: Chunk, chunk: Chunk) -> Chunk:
    """Statistics of all chunks `before` together with the next one; raw samples of the
    first.
    """
    # floating-point sums depend on the order
    assert chunk["number"] == before["number"] + 1
    bad = {
        k: np.concatenate([v, chunk[k]])[:LISTED]
        for k, v in before.items()
        if k[:4] == "bad."
    }
    return {
        **before,
        **bad,
        **merged(before, chunk),
        **{
            name: before[name] + chunk[name] for name in ("count", "statuses", "counts")
        },
        "number": chunk["number"],
        "low": np.minimum(before["low"], chunk["low"]),
        "high": np.maximum(before["high"], chunk["high"]),
    }


def named(counts: np.ndarray) -> dict[str, int]:
    """Counts of samples by name of the status, from counts by code; without zeros."""
    codes = np.flatnonzero(counts)
    return {OUTCOMES[code].name: int(counts[code]) for code in codes}
