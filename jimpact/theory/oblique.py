"""Slip after oblique impacts of one contact: springs that hold, and Walton's
constants.
"""

from typing import Any

import jax
import jax.numpy as jnp

from jimpact.tools.checks import as_float_array, check_values

# W_tt / W_nn of a homogeneous sphere of mass m on a fixed plane: (1 + m R^2 / I), I =
# 2/5 m R^2.
SPHERE = 3.5


def spring_slip(
    slip: Any, restitution: Any, tangential_stiffness: Any, ratio: Any = SPHERE
) -> jax.Array:
    """Slip after an impact whose linear tangential spring holds to the end.

    Equation: `u+ = u- cos(pi/2 (1 + e) sqrt(kappa W_tt / W_nn))`: the impact of a
    linear bistiffness contact lasts a quarter of its period, and e times that in
    expansion. A superball, `u+ = -u-`, has e = 1 and `kappa = W_nn / W_tt`; there it
    holds at any `mu |gamma-| >= kappa |u-|`. Elsewhere a spring that is still loaded as
    F ends slides then; with mu -> inf that takes no time.

    Args:
        slip: u- [m/s].
        restitution: e in [0, 1].
        tangential_stiffness: kappa > 0, that of `LZB`, with exponent 1.
        ratio: W_tt / W_nn, 7/2 of a homogeneous sphere on a plane; W_nt = 0.

    Returns:
        u+ [m/s], of the common shape.

    Raises:
        ValueError: e outside [0, 1]; kappa or ratio not positive.

    Source: Maw, Barber and Fawcett, Wear 38 (1976) 101, for a linear spring.

    >>> import jimpact as ji
    >>> round(float(ji.theory.spring_slip(0.4, 1.0, 2 / 7)), 6)
    -0.4
    """
    u = as_float_array("slip", slip)
    e = as_float_array("restitution", restitution)
    kappa = as_float_array("tangential_stiffness", tangential_stiffness)
    w = as_float_array("ratio", ratio)
    check_values("slip", u)
    check_values("restitution", e, low=0.0, high=1.0)
    check_values("tangential_stiffness", kappa, low=0.0, open_low=True)
    check_values("ratio", w, low=0.0, open_low=True)
    phase = jnp.pi / 2 * (1 + e) * jnp.sqrt(kappa * w)
    return u * jnp.cos(phase)


def walton_slip(
    slip: Any,
    approach: Any,
    restitution: Any,
    friction: Any,
    tangential_restitution: Any,
    ratio: Any = SPHERE,
) -> jax.Array:
    """Slip after an impact by Walton's three constants e, mu and beta_0.

    Equation: `u+ = u- max(-beta_0, 1 - mu (1 + e) (W_tt / W_nn) |gamma-| / |u-|)`:
    gross sliding at large angles, beyond it a constant ratio of slips; W_nt = 0.

    Args:
        slip: u- [m/s], of one direction.
        approach: |gamma-| [m/s], or gamma- itself.
        restitution: e in [0, 1].
        friction: Coulomb's mu >= 0.
        tangential_restitution: beta_0 in [-1, 1]: -1 without friction, 0 rolling, 1 all
            returned.
        ratio: W_tt / W_nn, 7/2 of a homogeneous sphere on a plane.

    Returns:
        u+ [m/s], of the common shape. The slope jumps where sliding ends; at u- = 0 it
        is -beta_0.

    Raises:
        ValueError: values outside these ranges.

    Source: Walton (1993) in Roco, Particulate Two-Phase Flow; Foerster, Louge, Chang
    and Allia, Phys. Fluids 6 (1994) 1108.

    >>> import jimpact as ji
    >>> [
    ...     round(float(ji.theory.walton_slip(u, 1.0, 0.9, 0.1, 0.5)), 3)
    ...     for u in (0.2, 2.0)
    ... ]
    [-0.1, 1.335]
    """
    u, gamma, e, mu, beta, w = (
        as_float_array(name, value)
        for name, value in (
            ("slip", slip),
            ("approach", approach),
            ("restitution", restitution),
            ("friction", friction),
            ("tangential_restitution", tangential_restitution),
            ("ratio", ratio),
        )
    )
    check_values("slip", u)
    check_values("approach", gamma)
    check_values("restitution", e, low=0.0, high=1.0)
    check_values("friction", mu, low=0.0)
    check_values("tangential_restitution", beta, low=-1.0, high=1.0)
    check_values("ratio", w, low=0.0, open_low=True)
    loss = mu * (1 + e) * w * jnp.abs(gamma)
    sticks = (1 + beta) * jnp.abs(u) <= loss
    slid = u - loss * jnp.sign(u)
    return jnp.where(sticks, -beta * u, slid)
