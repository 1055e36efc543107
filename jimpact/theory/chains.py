"""Chains in closed form: linear springs until one opens, no dispersion, a solitary
wave.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import brentq
from scipy.special import gammaln

from jimpact.core.scene import Scene, as_velocity, gap_velocity, velocity_change
from jimpact.tools.checks import as_numbers, as_whole, check_values
from jimpact.tools.compiling import full_precision

# Largest stiffness ratio, and one over the least, whose first opening is searched. Ten
# times more: three times as many periods of the stiff contact to look through, for an
# outcome at its limit.
_STIFFEST = 1e8
# Step [rad] of the stiff contact in that search. Ten times more: two zeros in a step
# are missed.
_GRID = 0.05


@full_precision
def bilateral_motion(
    scene: Scene, stiffness: Any, velocity: Any, time: Any
) -> tuple[jax.Array, jax.Array]:
    """Displacements and velocities where contacts are springs that also pull.

    Equation: `M x'' = -N K N^T x`, `x(0) = 0`, `x'(0) = v-`. It is the motion of
    `Compliant` with `LinearSpring` at touching contacts until the first of them opens,
    which is when an entry of `N^T x` returns to 0.

    Args:
        scene: n coordinates, m contacts; its gaps play no part.
        stiffness: k, scalar or (m,) [N/m].
        velocity: v- (n,) [m/s].
        time: () [s].

    Returns:
        x (n,) [m] and x' (n,) [m/s].

    Raises:
        ValueError: stiffness < 0, sizes, more than one instant.

    Source: Brogliato, Nonsmooth Mechanics (2016), (6.14)-(6.15).

    >>> import jimpact as ji
    >>> x, v = ji.theory.bilateral_motion(
    ...     ji.chain([1.0, 1.0]), 0.5, [1.0, 0.0], 3.141592653589793
    ... )
    >>> [round(abs(float(a)), 5) for a in v]  # half a period: exchanged
    [0.0, 1.0]
    """
    v = as_velocity(scene, velocity)
    k = as_numbers("stiffness", stiffness, low=0.0, contacts=scene.contacts)
    t = as_numbers("time", time, (), "one instant; vmap over many")
    n = scene.size

    def acceleration(x: jax.Array) -> jax.Array:
        """`x'' = -M^-1 N K N^T x` (n,) [m/s^2] at displacements x (n,) [m]."""
        force = -k * gap_velocity(scene, x)
        return velocity_change(scene, force)

    # (x, x')' = flow (x, x')
    dtype = v.dtype
    identity = jnp.eye(n, dtype=dtype)
    pull = jax.vmap(acceleration, out_axes=1)(identity)
    zero = jnp.zeros((n, n), dtype)
    flow = jnp.block([[zero, identity], [pull, zero]])
    # expm, not eigenvectors: those of equal frequencies have no derivative
    at_rest = jnp.zeros_like(v)
    start = jnp.concatenate([at_rest, v])
    transition = jax.scipy.linalg.expm(t * flow, max_squarings=64)
    end = transition @ start
    return end[:n], end[n:]


def newby_ratio(n: int) -> float:
    """Stiffness ratio k2/k1 at which both contacts of three balls open at once.

    Equation: `(3 n^4 - 2 n^2 + 3 + sqrt(9 n^8 - 12 n^6 - 42 n^4 - 12 n^2 + 9)) / (8
    n^2)`: the two frequencies of (6.15) are then in the ratio n. For odd n the outcome
    is (-1/3, 2/3, 2/3) v.

    Args:
        n: whole number >= 2.

    Returns:
        The ratio, a float.

    Raises:
        ValueError: n is not a whole number of at least 2.

    Source: Newby, Am. J. Phys. 52 (1984) 745; Brogliato (2016), after (6.16).

    >>> import jimpact as ji
    >>> round(ji.theory.newby_ratio(2), 6), round(ji.theory.newby_ratio(3), 6)
    (2.241338, 6.171293)
    """
    n = as_whole("n", n, 2)
    square = 9 * n**8 - 12 * n**6 - 42 * n**4 - 12 * n**2 + 9
    root = float(np.sqrt(square))
    numerator = 3 * n**4 - 2 * n**2 + 3 + root
    return numerator / (8 * n**2)


class SeparationTimes(NamedTuple):
    """Times [sqrt(m / k1)] at which two contacts would open, `first` and `second`."""

    first: float
    second: float


def separation_times(stiffness_ratio: float) -> SeparationTimes:
    """Times at which the linear contacts of three equal balls would open.

    Equation: first zeros t > 0 of
    `(Delta - 1 + g) sin(w1 t) / w1 + (Delta + 1 - g) sin(w2 t) / w2` (contact 1) and of
    `sin(w1 t) / w1 - sin(w2 t) / w2` (contact 2), with `g = k2 / k1`,
    `Delta = sqrt(g^2 - g + 1)`, `w1^2 = 1 + g - Delta`, `w2^2 = 1 + g + Delta`. The
    earlier one is that of the impact: contact 1 up to `newby_ratio(2)`, contact 2
    beyond; the other one would follow only if springs pulled.

    Args:
        stiffness_ratio: g from 1e-8 to 1e8, or 0.

    Returns:
        `SeparationTimes` in units of `sqrt(m / k1)`; at g = 0 contact 2 is never
        loaded: infinite.

    Raises:
        ValueError: a ratio out of range.

    Host function, not differentiable.

    Source: Brogliato, Nonsmooth Mechanics (2016), (6.16) with the sign of
    `docs/equations.md`.

    >>> import jimpact as ji
    >>> [round(t, 6) for t in ji.theory.separation_times(1.0)]
    [2.554813, 3.382085]
    """
    check_values("stiffness_ratio", stiffness_ratio, low=0.0, high=_STIFFEST)
    g = float(stiffness_ratio)
    if 0 < g < 1 / _STIFFEST:
        raise ValueError(
            f"Argument `stiffness_ratio` must be 0 or at least {1 / _STIFFEST:g}, "
            f"but has value {g:g}."
        )
    if g == 0:
        first = float(np.pi / np.sqrt(2))
        return SeparationTimes(first, float(np.inf))
    root = float(np.sqrt(g * g - g + 1))
    high = float(np.sqrt(1 + g + root))
    low = float(np.sqrt(3 * g)) / high  # their product; 1 + g - root would cancel

    def zero(slow: float, fast: float) -> float:
        """First zero of `slow sin(w1 t) / w1 + fast sin(w2 t) / w2`."""

        def squeeze(t: Any) -> Any:
            """Indentation of the contact at time t, but for a positive factor."""
            of_slow = slow * np.sin(low * t) / low
            of_fast = fast * np.sin(high * t) / high
            return of_slow + of_fast

        period_of_slow = 2 * np.pi * high / low
        steps = int(period_of_slow / _GRID) + 2
        times = np.arange(1, steps) * _GRID / high
        opened = squeeze(times) <= 0
        number = int(np.argmax(opened))
        begin = times[number - 1]
        end = times[number]
        return float(brentq(squeeze, begin, end, xtol=1e-15, rtol=1e-15))

    # Delta - 1 + g and Delta + 1 - g, written so that nothing cancels; root is Delta
    rising = g + (g * g - g) / (root + 1)
    falling = 1 + (1 - g) / (root + g)
    first = zero(rising, falling)
    second = zero(1.0, -1.0)
    return SeparationTimes(first, second)


def nesterenko_speed(stiffness: Any, mass: Any, velocity: Any) -> jax.Array:
    """Speed [contacts/s] of a solitary wave in a chain of equal Hertz balls.

    Equation: `V = (16 / 25)^(1/5) (k / m)^(2/5) v^(1/5)`, with v the largest velocity
    of a ball in the wave; its length is `pi sqrt(5/2)`, 4.967 contacts. It is the limit
    of long waves: a chain is 0.8 % slower.

    Args:
        stiffness: k > 0 of the contacts [N/m^1.5], scalar or array.
        mass: m > 0 of a ball [kg].
        velocity: v >= 0, the largest of a ball in the wave [m/s]; not that of the
            striker.

    Returns:
        V, of the common shape.

    Raises:
        ValueError: arguments out of range.

    Source: Nesterenko, J. Appl. Mech. Tech. Phys. 24 (1983) 733; Brogliato, Nonsmooth
    Mechanics (2016), 6.1.1.4 and 6.3.2.1.

    >>> import jimpact as ji
    >>> round(float(ji.theory.nesterenko_speed(8.0, 2.0, 3.0)), 6)
    1.983738
    """
    k = as_numbers("stiffness", stiffness, low=0.0, open_low=True)
    m = as_numbers("mass", mass, low=0.0, open_low=True)
    v = as_numbers("velocity", velocity, low=0.0)
    return (16 / 25) ** 0.2 * (k / m) ** 0.4 * v**0.2


def reinsch_chain(
    balls: int, mass: float = 1.0, stiffness: float = 1.0
) -> tuple[jax.Array, jax.Array]:
    """Masses and stiffnesses of a linear chain that passes the whole blow on.

    The first ball strikes, the last one leaves with its velocity, all others rest. The
    frequencies of the chain are 0, w, 2 w, ..., n w, and it is its own mirror image:
    after half a period of w every motion has turned into its mirror image, and all
    contacts open at once.

    Equation: with n = balls - 1 and `c_j = binom(2 j, j) / 4^j`,
    `m_j = m_0 c_j c_(n-j) / c_n`, `k_j = k_0 (m_j / m_0) (j + 1/2) (n - j) / (n / 2)`,
    j = 0, 1, ...

    Args:
        balls: n + 1 >= 2.
        mass: of the first ball, > 0 [kg].
        stiffness: of the first contact, > 0 [N/m].

    Returns:
        Masses (n + 1,) [kg] and stiffnesses (n,) [N/m].

    Raises:
        ValueError: fewer than two balls, a mass or a stiffness that is not positive.

    Source: Reinsch, Am. J. Phys. 62 (1994) 271; Brogliato, Nonsmooth Mechanics (2016),
    Remark 6.4, for three balls. The closed form is an own derivation: the chain has the
    recurrence of dual Hahn polynomials with both parameters -1/2, whose spectrum is 0,
    1, 4, ..., n^2.

    >>> import jimpact as ji
    >>> masses, stiffness = ji.theory.reinsch_chain(4)
    >>> masses.round(6).tolist(), stiffness.round(6).tolist()
    ([1.0, 0.6, 0.6, 1.0], [1.0, 1.2, 1.0])
    """
    n = as_whole("balls", balls, 2) - 1
    for name, value in (("mass", mass), ("stiffness", stiffness)):
        as_numbers(name, value, low=0.0, open_low=True)
    j = np.arange(n + 1)
    # m_j / m_0
    whole = _log_central(np.asarray(n))
    share = np.exp(_log_central(j) + _log_central(n - j) - whole)
    left = share[:-1] * (j[:-1] + 0.5)
    springs = left * (n - j[:-1]) / (n / 2)  # k_j / k_0
    return jnp.asarray(mass * share), jnp.asarray(stiffness * springs)


def _log_central(j: np.ndarray) -> np.ndarray:
    """`ln(binom(2 j, j) / 4^j)` of whole numbers j; without logarithms long chains
    overflow.

    Equation: `binom(2 j, j) / 4^j = Gamma(j + 1/2) / (sqrt(pi) Gamma(j + 1))`.
    """
    gamma_ratio = gammaln(j + 0.5) - gammaln(j + 1)
    return gamma_ratio - 0.5 * np.log(np.pi)
