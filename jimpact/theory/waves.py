"""Waves in chains in closed form: the speed of a solitary wave, chains that disperse nothing."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import gammaln

from jimpact._checks import as_numbers, as_whole


def nesterenko_speed(stiffness: Any, mass: Any, velocity: Any) -> jax.Array:
    """Speed [contacts/s] of a solitary wave in a long chain of equal Hertz balls at rest.

    Equation: `V = (16 / 25)^(1/5) (k / m)^(2/5) v^(1/5)`, with v the largest velocity of a ball in
    the wave; its length is `pi sqrt(5/2)`, 4.967 contacts. It is the limit of long waves: a chain
    is 0.8 % slower.

    Args:
        stiffness: k > 0 of the contacts [N/m^1.5], scalar or array.
        mass: m > 0 of a ball [kg].
        velocity: v >= 0, the largest of a ball in the wave [m/s]; not that of the striker.

    Returns:
        V, of the common shape.

    Raises:
        ValueError: arguments out of range.

    Source: Nesterenko, J. Appl. Mech. Tech. Phys. 24 (1983) 733; Brogliato, Nonsmooth Mechanics
    (2016), 6.1.1.4 and 6.3.2.1.

    >>> import jimpact as ji
    >>> round(float(ji.theory.nesterenko_speed(8.0, 2.0, 3.0)), 6)
    1.983738
    """
    k = as_numbers("stiffness", stiffness, low=0.0, open_low=True)
    m = as_numbers("mass", mass, low=0.0, open_low=True)
    v = as_numbers("velocity", velocity, low=0.0)
    return (16 / 25) ** 0.2 * (k / m) ** 0.4 * v**0.2


def reinsch_chain(balls: int, mass: float = 1.0, stiffness: float = 1.0) -> tuple[Any, Any]:
    """Masses and stiffnesses of a chain with linear contacts that passes the whole blow on.

    The first ball strikes, the last one leaves with its velocity, all others rest. The frequencies
    of the chain are 0, w, 2 w, ..., n w, and it is its own mirror image: after half a period of w
    every motion has turned into its mirror image, and all contacts open at once.

    Equation: with n = balls - 1 and `c_j = binom(2 j, j) / 4^j`, `m_j = m_0 c_j c_(n-j) / c_n`,
    `k_j = k_0 (m_j / m_0) (j + 1/2) (n - j) / (n / 2)`, j = 0, 1, ...

    Args:
        balls: n + 1 >= 2.
        mass: of the first ball, > 0 [kg].
        stiffness: of the first contact, > 0 [N/m].

    Returns:
        Masses (n + 1,) [kg] and stiffnesses (n,) [N/m].

    Raises:
        ValueError: fewer than two balls, a mass or a stiffness that is not positive.

    Source: Reinsch, Am. J. Phys. 62 (1994) 271; Brogliato, Nonsmooth Mechanics (2016), Remark 6.4,
    for three balls. The closed form is an own derivation: the chain has the recurrence of dual Hahn
    polynomials with both parameters -1/2, whose spectrum is 0, 1, 4, ..., n^2.

    >>> import jimpact as ji
    >>> masses, stiffness = ji.theory.reinsch_chain(4)
    >>> masses.round(6).tolist(), stiffness.round(6).tolist()
    ([1.0, 0.6, 0.6, 1.0], [1.0, 1.2, 1.0])
    """
    n = as_whole("balls", balls, 2) - 1
    for name, value in (("mass", mass), ("stiffness", stiffness)):
        as_numbers(name, value, low=0.0, open_low=True)
    j = np.arange(n + 1)
    share = np.exp(_log_central(j) + _log_central(n - j) - _log_central(n))
    springs = share[:-1] * (j[:-1] + 0.5) * (n - j[:-1]) / (n / 2)
    return jnp.asarray(mass * share), jnp.asarray(stiffness * springs)


def _log_central(j: Any) -> np.ndarray:
    """Logarithm of binom(2 j, j) / 4^j: of long chains the numbers themselves overflow."""
    return gammaln(j + 0.5) - gammaln(j + 1) - 0.5 * np.log(np.pi)
