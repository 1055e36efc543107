"""Bilateral linear chains: the closed form that unilateral springs follow until one opens."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import as_float_array, as_whole, check_per_contact, check_shape, check_values
from jimpact.scene import Scene, as_velocity, gap_velocity, velocity_change


def bilateral_motion(
    scene: Scene, stiffness: Any, velocity: Any, time: Any
) -> tuple[jax.Array, jax.Array]:
    """Displacements and velocities of a system whose contacts are springs that also pull.

    Equation: `M x'' = -N K N^T x`, `x(0) = 0`, `x'(0) = v-`. It is the motion of `Compliant`
    with `LinearSpring` at touching contacts until the first of them opens, which is when an entry
    of `N^T x` returns to 0.

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
    >>> x, v = ji.theory.bilateral_motion(ji.chain([1.0, 1.0]), 0.5, [1.0, 0.0], 3.141592653589793)
    >>> [round(abs(float(a)), 5) for a in v]  # half a period: exchanged
    [0.0, 1.0]
    """
    v = as_velocity(scene, velocity)
    k = as_float_array("stiffness", stiffness)
    check_values("stiffness", k, low=0.0)
    check_per_contact("stiffness", k, scene.contacts)
    t = as_float_array("time", time)
    check_shape("time", t, (), "one instant; vmap over many")
    n = scene.size

    def acceleration(x: jax.Array) -> jax.Array:
        """x'' at displacements x."""
        return velocity_change(scene, -k * gap_velocity(scene, x))

    pull = jax.vmap(acceleration, out_axes=1)(jnp.eye(n, dtype=v.dtype))
    zero = jnp.zeros((n, n), v.dtype)
    flow = jnp.block([[zero, jnp.eye(n, dtype=v.dtype)], [pull, zero]])
    # expm, not eigenvectors: those of equal frequencies have no derivative
    end = jax.scipy.linalg.expm(t * flow, max_squarings=64) @ jnp.concatenate(
        [jnp.zeros_like(v), v]
    )
    return end[:n], end[n:]


def newby_ratio(n: int) -> float:
    """Stiffness ratio k2/k1 at which both contacts of three equal balls open at the same time.

    Equation: `(3 n^4 - 2 n^2 + 3 + sqrt(9 n^8 - 12 n^6 - 42 n^4 - 12 n^2 + 9)) / (8 n^2)`: the two
    frequencies of (6.15) are then in the ratio n. For odd n the outcome is (-1/3, 2/3, 2/3) v.

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
    root = float(np.sqrt(9 * n**8 - 12 * n**6 - 42 * n**4 - 12 * n**2 + 9))
    return (3 * n**4 - 2 * n**2 + 3 + root) / (8 * n**2)
