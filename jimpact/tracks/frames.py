"""Frames of a track: when what was seen, and how well."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

# Share of the extent of a coordinate below which its standard error is not taken:
# nothing is measured to more than nine digits. Ten times less, and rounding of sums
# would count.
LEAST_NOISE = 1e-9
# Steps to which values are compared with whole multiples of a step. Ten times more
# would take noise of a tenth of a digit for rounding.
WHOLE = 1e-3
DIGITS = np.arange(-12, 1)  # powers of ten that are tried as steps of the last digit
# Share of the largest value below which no step of the last digit is looked for: tables
# of more digits end with noise. Ten times more would miss steps of five digits.
LEAST_STEP = 1e-6
# pixels: so many steps at most between the lowest and the highest value
FEW_VALUES = 200


@dataclass(frozen=True)
class Frames:
    """Times t (T,) [s], places q (T, n), NaN where lost, and their standard errors
    sigma (n,).

    `angles`: coordinates that are angles; none where it is empty. `relative` (T, n):
    errors of each frame in sigma; None: 1.
    """

    t: np.ndarray
    q: np.ndarray
    sigma: np.ndarray
    angles: tuple[bool, ...] = ()
    relative: np.ndarray | None = None

    @property
    def step(self) -> float:
        """Median duration between frames [s]."""
        return float(np.median(np.diff(self.t)))

    @property
    def seen(self) -> np.ndarray:
        """True (T,) for frames that were seen in every coordinate."""
        return np.isfinite(self.q).all(axis=1)

    def speeds(self, flights: Sequence[np.ndarray]) -> np.ndarray:
        """Speeds (n,) of these flights, root mean square: that of all places, or of all
        angles.
        """
        n = self.q.shape[1]
        square = np.zeros(n)
        frames = 0
        for some in flights:
            rows = some[self.seen[some]]
            if len(rows) > 1:
                rise = self.q[rows[-1]] - self.q[rows[0]]
                square += len(rows) * (rise / (self.t[rows[-1]] - self.t[rows[0]])) ** 2
                frames += len(rows)
        angles = np.array(self.angles or (False,) * n)
        of_angles = square[angles].sum()
        of_places = square[~angles].sum()
        return np.sqrt(np.where(angles, of_angles, of_places) / max(frames, 1))

    def with_sigma(self, sigma: np.ndarray) -> "Frames":
        """The same frames with other standard errors."""
        return replace(self, sigma=sigma)

    def with_relative(self, relative: np.ndarray) -> "Frames":
        """The same frames with errors (T, n) of each in sigma."""
        return replace(self, relative=relative)

    def with_places(self, q: np.ndarray) -> "Frames":
        """The same times with other places."""
        return replace(self, q=q)


def noise(t: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Standard errors (n,) of places (T, n) at times (T,), from four frames in a row.

    A third divided difference `sum w_j q_j`, `w_j = prod_k 1 / (t_j - t_k)`, vanishes
    for a constant acceleration at any times; so an error of a time counts, too. Sizes
    are in `|w|`; their median, times 1.4826 (normal errors), does not see the few at
    impacts. Of frames that were seen where no four in a row were.
    """
    sizes = np.zeros(q.shape[1])
    for c, x in enumerate(q.T):
        found = divided_differences(t, x)
        if not found.size:
            seen = np.isfinite(x)
            found = divided_differences(t[seen], x[seen])
        sizes[c] = median(np.abs(found))
    return np.maximum(1.4826 * sizes, least_noise(q))


def divided_differences(t: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Third divided differences of places (T,) at times (T,), of unit variance for unit
    errors, without those that are NaN.
    """
    windows = max(len(x) - 3, 0)
    rows = np.arange(windows)[:, None] + np.arange(4)
    gaps = t[rows][:, :, None] - t[rows][:, None]
    gaps[:, np.arange(4), np.arange(4)] = 1.0
    weights = 1 / gaps.prod(axis=2)
    weights /= np.linalg.norm(weights, axis=1, keepdims=True)
    found = (weights * x[rows]).sum(axis=1)
    return found[np.isfinite(found)]


def least_noise(q: np.ndarray) -> np.ndarray:
    """Lowest standard errors (n,) of places (T, n): of rounding, and LEAST_NOISE of the
    extent.

    Values rounded to multiples of a step have errors between -step / 2 and step / 2,
    whose standard deviation is `step / sqrt(12)`.
    """
    extent = np.nanmax(q, axis=0) - np.nanmin(q, axis=0)
    # where nothing moves any is little
    if extent.max() > 0:
        whole = extent.max()
    else:
        whole = 1.0
    rounding = np.array([rounding_step(x[np.isfinite(x)]) for x in q.T]) / np.sqrt(12)
    return np.maximum(rounding, LEAST_NOISE * whole)


def rounding_step(x: np.ndarray) -> float:
    """The step of which all values x (T,) are whole multiples; 0 where there is none.

    A power of ten, or the least difference of values of which few differ, as of pixels.
    """
    values = np.unique(x)
    if len(values) < 3:
        return 0.0
    gaps = np.diff(values)
    least = float(gaps.min())
    # of three and more digits that are left the step is at most a hundredth of the
    # extent
    powers = 10.0 ** DIGITS[::-1]
    for step in powers[powers <= 10 * least]:
        if step < LEAST_STEP * np.abs(values).max():
            break
        if np.abs(values / step - np.round(values / step)).max() < WHOLE:
            return float(step)
    steps = gaps / least
    few = (values[-1] - values[0]) / least < FEW_VALUES
    repeated = len(values) < 0.8 * len(x)
    if few and repeated and np.abs(steps - np.round(steps)).max() < WHOLE:
        return least
    return 0.0


def differences(x: np.ndarray, order: int, step: int = 1) -> np.ndarray:
    """Differences of this order, over `step` frames, of places (T,), without those that
    are NaN.

    Where all are, as every other frame is lost, differences of the frames that were
    seen.
    """

    def all_of(x: np.ndarray) -> np.ndarray:
        """Differences of x that are not NaN."""
        for _ in range(order):
            x = x[step:] - x[:-step]
        return x[np.isfinite(x)]

    found = all_of(x)
    if found.size:
        return found
    return all_of(x[np.isfinite(x)])


def neighbours(x: Any) -> tuple[Any, Any]:
    """Entries with a successor, and their successors: x_k and x_(k+1)."""
    return x[:-1], x[1:]


def median(x: np.ndarray) -> float:
    """The median; 0 of nothing."""
    if x.size:
        return float(np.median(x))
    return 0.0
