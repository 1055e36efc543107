"""The rocking block over its shape: outcomes of its impacts, and the angles that decide them."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import as_float_array, check_values
from jimpact.theory.rocking_ratios import housner_restitution

# After the impact a corner counts as staying on the ground where its gap velocity is at most this
# part of the approach of B: real corners are not sharp, and slow ones touch down again at once.
STAYS = 0.05
OUTCOMES = ("rest", "rocking", "half-rocking", "free", "unresolved")


class RockingDispersion(eqx.Module):
    """Impacts of a block that rocks about A and hits with B; arrays (aspects, mu, e, ...).

    Args:
        aspect: a = height / width (A,).
        friction: mu (B,).
        restitution: energetic e (C,).
        gap_velocity: gamma+ / |gamma_B-| (A, B, C, 2), of B and A.
        angular_ratio: theta'+ / theta'- (A, B, C); beside `housner_restitution(aspect)`.
        slip_velocity: of both corners after, / |gamma_B-| (A, B, C).
        energy_ratio: T+ / T- (A, B, C).
        status: codes (A, B, C); values of failures are NaN.
    """

    aspect: jax.Array
    friction: jax.Array
    restitution: jax.Array
    gap_velocity: jax.Array
    angular_ratio: jax.Array
    slip_velocity: jax.Array
    energy_ratio: jax.Array
    status: jax.Array

    @property
    def kinetic_angle(self) -> jax.Array:
        """theta_12 (A,) [rad]."""
        return rocking_kinetic_angle(self.aspect)

    @property
    def dispersion(self) -> jax.Array:
        """d = y_A'+ / y_B'- <= 0 (A, B, C)."""
        return -self.gap_velocity[..., 1]

    @property
    def over_housner(self) -> jax.Array:
        """theta'+ / theta'- over Housner's value (A, B, C)."""
        return self.angular_ratio / housner_restitution(self.aspect)[:, None, None]

    def outcomes(self, stays: float = STAYS) -> np.ndarray:
        """Rows of `OUTCOMES` (A, B, C): which corners leave, faster than `stays` |gamma_B-|.

        rest: none; rocking: A only, the block goes on about B; half-rocking: B only, it turns
        back about A; free: both; unresolved: the law failed.
        """
        leaves = np.asarray(self.gap_velocity) > stays
        codes = leaves[..., 1] + 2 * leaves[..., 0]
        return np.where(np.isnan(np.asarray(self.gap_velocity[..., 0])), 4, codes)

    def __str__(self) -> str:
        theta, found = np.degrees(self.kinetic_angle), self.outcomes()
        lines = [
            f"rocking block, kinetic angle {theta.min():.1f} to {theta.max():.1f} degrees "
            f"({len(theta)} shapes), {len(self.restitution)} e",
        ]
        for j, mu in enumerate(np.asarray(self.friction)):
            counts = np.bincount(found[:, j].ravel(), minlength=len(OUTCOMES))
            told = ", ".join(f"{n} {name}" for name, n in zip(OUTCOMES, counts) if n)
            critical = float(np.degrees(critical_kinetic_angle(mu)))
            lines.append(f"mu = {mu:g}: critical angle {critical:.2f} degrees; {told}")
        return "\n".join(lines)


def rocking_kinetic_angle(aspect: Any) -> jax.Array:
    """theta_12 [rad] of a homogeneous block flat on the ground, between its two corners.

    Equation: `cos(theta_12) = -(a^2 - 2) / (a^2 + 4)`, a = height / width: pi / 3 flat, pi slender.

    Source: Brogliato (2016), section 6.3.2.2.

    >>> import jimpact as ji
    >>> round(float(ji.theory.rocking_kinetic_angle(2.0**0.5)), 6)
    1.570796
    """
    a = as_float_array("aspect", aspect)
    check_values("aspect", a, low=0.0, open_low=True)
    return jnp.arccos(-(a**2 - 2) / (a**2 + 4))


def critical_kinetic_angle(friction: Any) -> jax.Array:
    """Kinetic angle [rad] at which the hit at B leaves corner A alone: the tip of the V.

    Equation: B alone is pressed, slips at mu < 3 a / (4 a^2 + 1) and sticks otherwise; A gets no
    acceleration where `a^2 - 2 + 3 mu a = 0`, or where it sticks at `2 a^2 = 1`, Housner's zero:
    `a_c = (sqrt(9 mu^2 + 8) - 3 mu) / 2` for mu <= 1 / sqrt(2), else 1 / sqrt(2). No restitution,
    stiffness or exponent is in it. Above a_c, `gamma_B+ = e`, `gamma_A+ = (1 + e) r` in units of
    the approach, `r = (a^2 - 2 + 3 mu a) / (a^2 + 4 - 3 mu a)` slipping, Housner's value sticking.

    Args:
        friction: mu >= 0, scalar or array.

    >>> import jimpact as ji
    >>> [round(float(ji.theory.critical_kinetic_angle(mu)), 4) for mu in (0.0, 0.3, 1.0)]
    [1.5708, 1.3862, 1.231]
    """
    mu = as_float_array("friction", friction)
    check_values("friction", mu, low=0.0)
    slips = jnp.minimum(mu, 0.5**0.5)  # beyond, B sticks
    return rocking_kinetic_angle((jnp.sqrt(9 * slips**2 + 8) - 3 * slips) / 2)
