"""Mean and covariance of a stream, in float64, merged chunk by chunk."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Moments:
    """Count, mean (d,) and the sum of products of deviations from the mean (d, d)."""

    count: int
    mean: np.ndarray
    products: np.ndarray

    @property
    def covariance(self) -> np.ndarray:
        """Sample covariance (d, d), divided by count - 1; NaN for fewer than two."""
        if self.count < 2:
            return np.full(self.products.shape, np.nan)
        return self.products / (self.count - 1)


def moments(values: np.ndarray) -> Moments:
    """Of `values` (d, count), one row a quantity; in float64 whatever their type.

    >>> import numpy as np
    >>> from jimpact.montecarlo.moments import moments
    >>> moments(np.array([[1.0, 2.0, 3.0]])).covariance.tolist()
    [[1.0]]
    """
    values = np.ascontiguousarray(values, dtype=np.float64)
    count = values.shape[1]
    if count == 0:
        return Moments(0, np.zeros(len(values)), np.zeros((len(values),) * 2))
    mean = values.sum(axis=1) / count  # along contiguous rows: pairwise
    deviation = values - mean[:, None]
    # not BLAS: its summation order depends on the number of threads
    return Moments(count, mean, np.einsum("ik,jk->ij", deviation, deviation))


def merged(a: Moments, b: Moments) -> Moments:
    """Moments of both together.

    Equation: `mean = mean_a + d n_b / n`, `S = S_a + S_b + d d^T n_a n_b / n`, with
    `d = mean_b - mean_a`. Not associative in floating point: merge in a fixed order.

    Source: Chan, Golub and LeVeque, Am. Statistician 37 (1983) 242.

    >>> import numpy as np
    >>> from jimpact.montecarlo.moments import merged, moments
    >>> whole = merged(moments(np.array([[1.0]])), moments(np.array([[3.0]])))
    >>> whole.count, whole.mean.tolist(), whole.covariance.tolist()
    (2, [2.0], [[2.0]])
    """
    if a.count == 0 or b.count == 0:
        return a if b.count == 0 else b
    count = a.count + b.count
    d = b.mean - a.mean
    products = a.products + b.products + np.outer(d, d) * (a.count * b.count / count)
    return Moments(count, a.mean + d * (b.count / count), products)
