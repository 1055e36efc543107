"""Confidence intervals: in pieces, in words, by profiles."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from jimpact.tools.checks import check_shape, check_values


def check_level(level: float) -> None:
    """Raise a ValueError unless this is a confidence level."""
    check_shape("level", level, (), "one number")
    check_values("level", level)
    if not 0 < level < 1:
        raise ValueError(
            f"Argument `level` must lie in (0, 1), but has value {level!r}."
        )


def pieces_in_words(
    pieces: Iterable[tuple[float, float]], domain: tuple[float, float]
) -> str:
    """Pieces (low, high) of a confidence interval as text; ends of the domain are left
    out.
    """
    return " or ".join(_piece(*ends, domain) for ends in pieces)


def _piece(low: float, high: float, domain: tuple[float, float]) -> str:
    """One piece of an interval as text: 'a to b', 'at least a', 'at most b' or
    'anything'.
    """
    open_low = low <= domain[0]
    open_high = high >= domain[1]
    if open_low and open_high:
        return "anything"
    if open_low or open_high:
        if open_low:
            return f"at most {high:.5g}"
        return f"at least {low:.5g}"
    return f"{low:.5g} to {high:.5g}"


@dataclass(frozen=True, eq=False)
class Profile:
    """`deviance` (G,) over the `value`s (G,) of parameter `name`, and where it is below
    `limit`.

    `deviance` is the sum of squares with the parameter fixed, less its least value,
    over the noise variance. `intervals` are the pieces of the confidence interval at
    `level`, in order; an end at `domain` means that the data do not bound the parameter
    there. `better`: values of a minimum below that of the fit, or None.
    """

    name: str
    value: np.ndarray
    deviance: np.ndarray
    limit: float
    level: float
    intervals: tuple[tuple[float, float], ...]
    domain: tuple[float, float]
    better: np.ndarray | None = None

    @property
    def words(self) -> str:
        """The interval in words.

        >>> import numpy as np
        >>> from jimpact.fits.intervals import Profile
        >>> first = ("e", np.zeros(1), np.zeros(1), 4.0, 0.95)
        >>> Profile(*first, ((0.25, 0.5), (0.75, 1.0)), (0.0, 1.0)).words
        '0.25 to 0.5 or at least 0.75'
        """
        return pieces_in_words(self.intervals, self.domain)

    @property
    def open_ends(self) -> tuple[bool, bool]:
        """True where the interval reaches the lower, and the upper end of the
        domain.
        """
        return self.intervals[0][0] <= self.domain[0], self.intervals[-1][
            1
        ] >= self.domain[1]

    @property
    def determines(self) -> bool:
        """True if the interval excludes any value of the domain."""
        return len(self.intervals) > 1 or not all(self.open_ends)

    def __str__(self) -> str:
        return f"{self.name}: {self.words} ({100 * self.level:g} %)"


def joined(pieces: Iterable[tuple[float, float]]) -> tuple[tuple[float, float], ...]:
    """The union of intervals, as disjoint pieces in order.

    >>> from jimpact.fits.intervals import joined
    >>> joined([(3.0, 4.0), (0.0, 1.0), (0.5, 2.0)])
    ((0.0, 2.0), (3.0, 4.0))
    """
    union: list[tuple[float, float]] = []
    for low, high in sorted(pieces):
        if union and low <= union[-1][1]:
            union[-1] = (union[-1][0], max(high, union[-1][1]))
        else:
            union.append((float(low), float(high)))
    return tuple(union)
