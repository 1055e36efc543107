"""Restitution matrices of a block on two corners that are admissible for every approach."""

from typing import Any, NamedTuple

import numpy as np

from jimpact._checks import as_numbers
from jimpact.theory.rocking import housner_restitution


class RockingDomain(NamedTuple):
    """Admissible `E = [[own, cross], [cross, own]]` of a block flat on the ground.

    `aspect`, `sliding`; `coupling` g: G = [[1, g], [g, 1]]; `corners` (k, 2): the vertices of the
    domain in the plane (own, cross).
    """

    aspect: float
    sliding: bool
    coupling: float
    corners: np.ndarray

    def contains(self, own: Any, cross: Any) -> np.ndarray:
        """Whether entries `own` and `cross` are admissible, ends included; arrays broadcast."""
        a, b = np.asarray(own, float), np.asarray(cross, float)
        inside: np.ndarray = (a >= 0) & (b >= 0) & (a + b <= 1) & (b >= self.coupling * (1 + a))
        return inside

    @property
    def rocking(self) -> tuple[float, float]:
        """Least and largest `cross` at own = 0: the corner that hits stays, the other leaves."""
        return max(self.coupling, 0.0), 1.0

    @property
    def half_rocking(self) -> tuple[float, float] | None:
        """Least and largest `own` at cross = 0: the corner that hits leaves, the other stays."""
        return (0.0, 1.0) if self.coupling <= 0 else None


def rocking_domain(aspect: Any, sliding: bool = True) -> RockingDomain:
    """Restitution matrices of a homogeneous block, alike at both corners, that mechanics allows.

    Equation: with `E = [[a, b], [b, a]]` for (qn_1, qn_2), where a corner hits alone it returns a
    of its velocity and the other one gets b of it. Prop. 6.2: a, b >= 0 and `b >= g (1 + a)`;
    Prop. 6.4: `a + b <= 1`. Free (both corners leave): a, b > 0; half-rocking (it turns back
    about the same corner): b = 0; rocking (from corner to corner): a = 0.
    `g = (A^2 - 2) / (A^2 + 4)` of the aspect A where both corners slide without friction, and
    Housner's value `(2 A^2 - 1) / (2 A^2 + 2)` where they stick before and after.

    Args:
        aspect: A = height / width > 0.
        sliding: True: without tangential impulses (E_33 = -1); False: both corners stick.

    Returns:
        `RockingDomain`.

    Raises:
        ValueError: an aspect that is not positive.

    Host function, not differentiable.

    Source: own derivation from Brogliato (2016), Props. 6.2 and 6.4; the admissible entries of the
    source's reference [228] were not at hand.

    >>> import jimpact as ji
    >>> domain = ji.theory.rocking_domain(2.0)
    >>> domain.corners.round(4).tolist()  # slender: it never turns back about the same corner
    [[0.0, 0.25], [0.6, 0.4], [0.0, 1.0]]
    >>> domain.half_rocking, ji.theory.rocking_domain(2.0, sliding=False).rocking
    (None, (0.7, 1.0))
    """
    a = as_numbers("aspect", aspect, (), "one block", low=0.0, open_low=True)
    slenderness = float(a)
    if sliding:
        g = (slenderness**2 - 2) / (slenderness**2 + 4)
    else:
        g = float(housner_restitution(slenderness))
    wide = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]
    slender = [[0.0, g], [(1 - g) / (1 + g), 2 * g / (1 + g)], [0.0, 1.0]]
    return RockingDomain(slenderness, sliding, g, np.array(wide if g <= 0 else slender))
