"""Kinetic energy after an impact: the part that is kept, and its spread over the
coordinates.
"""

from typing import Any

import jax
import jax.numpy as jnp

from jimpact.core.scene import Scene, as_velocity, kinetic_energy, momentum


def energy_ratio(scene: Scene, before: Any, after: Any) -> jax.Array:
    """Kinetic-energy ratio `T+ / T-`; 1 conserves, NaN if all bodies rest before.

    Args:
        scene: n coordinates, m contacts.
        before: v- (n,) [m/s].
        after: v+ (n,) [m/s].

    Returns:
        Ratio ().

    Raises:
        ValueError: not one velocity per coordinate.

    Source: Brogliato, Nonsmooth Mechanics (2016), 6.3.3.

    >>> import jimpact as ji
    >>> float(ji.theory.energy_ratio(ji.chain([1.0, 1.0]), [1.0, 0.0], [0.5, 0.5]))
    0.5
    """
    return kinetic_energy(scene, after) / kinetic_energy(scene, before)


def energy_dispersion(scene: Scene, velocity: Any) -> jax.Array:
    """C_KE, how unevenly energy is spread: 0 equal, sqrt(n - 1) all in one.

    Equation: `sd(T_i) / mean(T_i)`, the coefficient of variation of the shares
    `T_i = v_i (M v)_i / 2` of the n coordinates. For equal balls with v- = (1, 0, 0)
    and no loss: sqrt(2) at (0, 0, 1), sqrt(2)/3 at (-1/3, 2/3, 2/3). `dispersion_index`
    is the same quantity the other way round, from 0 to 1: `1 - C_KE / sqrt(n - 1)`.
    NaN at rest. Not differentiable at equal shares.

    Args:
        scene: n coordinates, m contacts.
        velocity: (n,) [m/s].

    Returns:
        C_KE () in [0, sqrt(n - 1)], at most that where all shares are >= 0.

    Raises:
        ValueError: not one velocity per coordinate.

    Source: Brogliato, Nonsmooth Mechanics (2016), 6.3.3.

    >>> import jimpact as ji
    >>> balls = ji.chain([1.0, 1.0, 1.0])
    >>> round(float(ji.theory.energy_dispersion(balls, [-1 / 3, 2 / 3, 2 / 3])), 6)
    0.471405
    """
    v = as_velocity(scene, velocity)
    share = 0.5 * v * momentum(scene, v)
    mean = jnp.mean(share)
    square = jnp.mean((share - mean) ** 2)
    # the inner `where` keeps the derivative of the root finite where all shares are
    # equal
    positive = jnp.where(square > 0, square, 1.0)
    deviation = jnp.where(square > 0, jnp.sqrt(positive), 0.0)
    return deviation / mean


def dispersion_index(scene: Scene, velocity: Any) -> jax.Array:
    """Evenness of kinetic energy over the coordinates: 0 all in one, 1 equal shares.

    Equation: `1 - C_KE / sqrt(n - 1)`: C_KE (`energy_dispersion`) is at most
    `sqrt(n - 1)`. For equal balls with v- = (1, 0, 0) and no loss: 0 at (0, 0, 1), 2/3
    at (-1/3, 2/3, 2/3).
    NaN at rest, and for one coordinate. Not differentiable at equal shares.

    Args:
        scene: n coordinates, m contacts.
        velocity: (n,) [m/s].

    Returns:
        Index () in [0, 1], at most 1 where all shares are >= 0.

    Raises:
        ValueError: not one velocity per coordinate.

    Source: Brogliato, Nonsmooth Mechanics (2016), 6.3.3.

    >>> import jimpact as ji
    >>> balls = ji.chain([1.0, 1.0, 1.0])
    >>> round(float(ji.theory.dispersion_index(balls, [-1 / 3, 2 / 3, 2 / 3])), 6)
    0.666667
    """
    spread = energy_dispersion(scene, velocity)
    others = jnp.asarray(scene.size - 1, spread.dtype)
    return 1 - spread / jnp.sqrt(others)
