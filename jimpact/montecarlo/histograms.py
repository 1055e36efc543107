"""Histograms with fixed, equal bins, and quantiles from them."""

import numpy as np

MARGIN = 0.1  # of the first chunk's range, added on both sides: later chunks reach further
FLAT = 1e-6  # relative half width of the range of a quantity that does not vary


def bin_range(values: np.ndarray) -> np.ndarray:
    """Low and high ends (d, 2) for the bins of `values` (d, count), with a margin."""
    low, high = values.min(axis=1).astype(float), values.max(axis=1).astype(float)
    margin = MARGIN * (high - low)
    size = np.maximum(np.abs(low), np.abs(high))
    flat = FLAT * np.where(size > 0, size, 1.0)
    margin = np.maximum(margin, flat)  # also where the range is rounding
    return np.stack([low - margin, high + margin], axis=1)


def bin_counts(values: np.ndarray, ends: np.ndarray, bins: int) -> np.ndarray:
    """Counts (d, bins + 2): below `ends`, in each bin, at or above the upper end.

    >>> import numpy as np
    >>> from jimpact.montecarlo.histograms import bin_counts
    >>> bin_counts(np.array([[-1.0, 0.1, 0.6, 0.7, 1.0]]), np.array([[0.0, 1.0]]), 2).tolist()
    [[1, 1, 2, 1]]
    """
    counts = np.empty((len(values), bins + 2), np.int64)
    for row, (low, high), count in zip(values, ends, counts):
        place = np.floor((np.asarray(row, float) - low) * (bins / (high - low)))
        place = np.clip(place, -1, bins).astype(np.int64) + 1
        count[:] = np.bincount(place, minlength=bins + 2)
    return counts


def edges(ends: np.ndarray, bins: int) -> np.ndarray:
    """Bin edges (d, bins + 1)."""
    return np.linspace(ends[:, 0], ends[:, 1], bins + 1, axis=1)


def quantile(
    q: float, ends: np.ndarray, counts: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """The q-quantiles (d,), right to one bin width where they lie inside the bins.

    Linear inside the bin; `low` and `high` (d,), the smallest and largest values, bound what lies
    outside the bins.

    >>> import numpy as np
    >>> from jimpact.montecarlo.histograms import quantile
    >>> counts, ends = np.array([[0, 1, 1, 0]]), np.array([[0.0, 1.0]])
    >>> quantile(0.75, ends, counts, np.array([0.1]), np.array([0.9])).tolist()
    [0.75]
    """
    inner = edges(ends, counts.shape[1] - 2)
    left = np.concatenate([np.minimum(low, inner[:, 0])[:, None], inner], axis=1)
    right = np.concatenate([inner, np.maximum(high, inner[:, -1])[:, None]], axis=1)
    found = np.empty(len(counts))
    for i, count in enumerate(counts):
        after = np.cumsum(count)
        wanted = q * after[-1]
        k = int(np.searchsorted(after, wanted))
        k = k if count[k] else int(np.flatnonzero(count)[0])  # q = 0: the first bin in use
        part = (wanted - (after[k] - count[k])) / count[k]
        found[i] = left[i, k] + part * (right[i, k] - left[i, k])
    return np.clip(found, low, high)
