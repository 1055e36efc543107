"""Rocking blocks: from the loss of angular velocity at an impact to a restitution matrix."""

from importlib.resources import files
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jimpact._checks import as_float_array, check_shape, check_values


class RockingRatio(NamedTuple):
    """A measured restitution of angular velocity, as a multiple of Housner's rigid value."""

    aspect: float
    material: str
    measured_over_housner: float

    @property
    def restitution(self) -> float:
        """e_theta: the ratio times Housner's value. A conversion, not a fit."""
        return self.measured_over_housner * float(housner_restitution(self.aspect))


def housner_restitution(aspect: Any) -> jax.Array:
    """Angular velocity after over before, of a rigid block that rocks from corner to corner.

    Equation: `e_theta = 1 - (3/2) sin^2(alpha)`, `tan(alpha) = 1 / aspect`, which is
    `(2 a^2 - 1) / (2 (a^2 + 1))`: conserved angular momentum about the corner that is hit.

    Args:
        aspect: a = height / width > 0; scalar or array. Below `1 / sqrt(2)` the value is
            negative: such a block does not rock.

    Source: Housner, Bull. Seism. Soc. Am. 53 (1963) 403-417.

    >>> import jimpact as ji
    >>> [round(float(ji.theory.housner_restitution(a)), 6) for a in (1.0, 2.0, 3.0)]
    [0.25, 0.7, 0.85]
    """
    a = as_float_array("aspect", aspect)
    check_values("aspect", a, low=0.0, open_low=True)
    return 1 - 1.5 / (1 + a**2)


def rocking_matrix(restitution: Any) -> jax.Array:
    """Restitution matrix (3, 3) of a block that rocks without slip or rebound.

    Equation: `E = [[0, e, 0], [e, 0, 0], [0, 0, -e]]` in (qn_1, qn_2, qt): rotating about one
    corner and hitting with the other, `gamma_2+ = -e gamma_1-`, `gamma_1+ = 0`, `qt+ = e qt-`,
    so that the angular velocity about the new corner is e times the old one.

    Args:
        restitution: e_theta in [0, 1], the ratio of angular velocities.

    Returns:
        E for `RestitutionMatrix`, on a planar scene of one block with its two corners.

    Source: Brogliato, Nonsmooth Mechanics (2016), section 6.3.2.2, with the signs of
    `v+ = -E v-`.

    >>> import jimpact as ji
    >>> (10 * ji.theory.rocking_matrix(0.7)).round().tolist()
    [[0.0, 7.0, 0.0], [7.0, 0.0, 0.0], [0.0, 0.0, -7.0]]
    """
    e = as_float_array("restitution", restitution)
    check_shape("restitution", e, (), "one ratio of angular velocities")
    check_values("restitution", e, low=0.0, high=1.0)
    return e * jnp.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]], e.dtype)


def rocking_ratios() -> list[RockingRatio]:
    """Measured ratios of freely rocking blocks, bundled with the package.

    Times Housner's value they give e_theta, and with `rocking_matrix` a restitution matrix:
    a conversion of published numbers, not a fit.

    Source: ElGawady et al., as quoted in public abstracts; see data/README.md.

    >>> import jimpact as ji
    >>> for row in ji.theory.rocking_ratios():
    ...     print(row.material, row.aspect, round(row.restitution, 4))
    concrete 5.0 0.8952
    rubber 5.0 0.6313
    concrete 3.0 0.8245
    """
    rows = (files("jimpact") / "data" / "rocking_ratio.csv").read_text(encoding="utf-8")
    lines = [line.split(",") for line in rows.splitlines()[1:]]
    return [RockingRatio(float(a), material, float(ratio)) for a, material, ratio in lines]
