"""Newton's cradle: a row of pendulums whose bobs are balls."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact.bodies.base import CIRCLE, PLANAR, Body, numbered, positive, positives
from jimpact.tools.checks import as_float_array, check_shape, check_values
from jimpact.tools.compiling import full_precision


class PendulumCradle(Body):
    """Balls on parallel strings, side by side; q = the angles of the strings.

    Equation: ball i at `(s_i + l sin(q_i), -l cos(q_i))`,
    `f_j = |c_{j+1} - c_j| - R_j - R_{j+1}`, `M = diag(m_i l^2)`: each ball hangs on two
    strings, so that it does not turn. The suspensions s_i stand so far apart that the
    gaps at rest are `gaps`. At rest with closed gaps `N = l N_chain`, so that W is that
    of `chain(masses)`, and gap velocities are `l` times those.

    Args:
        masses: (n,) > 0 [kg], n >= 2.
        length: l > 0 of the strings, to the centres [m].
        radius: R > 0 of the balls, scalar or (n,) [m].
        gaps: >= 0 at rest, scalar or (n - 1,) [m].

    >>> import jimpact as ji
    >>> cradle = ji.PendulumCradle([1.0, 1.0, 1.0], length=0.3, radius=0.01)
    >>> cradle.scene([-0.5, 0.0, 0.0]).closed.tolist()
    [False, True]
    """

    range_in_words = "no ball in another one but its neighbours"

    masses: jax.Array
    length: jax.Array
    radius: jax.Array
    gaps: jax.Array

    def __init__(self, masses: Any, length: Any, radius: Any, gaps: Any = 0.0):
        """Check the arguments, see the class; a scalar radius or gap is repeated."""
        self.masses = positives("masses", masses)
        n = self.masses.shape[0]
        if n < 2:
            raise ValueError(
                f"Argument `masses` must hold two balls or more, but holds {n}."
            )
        self.length = positive("length", length)
        self.radius = positives("radius", radius, n)
        gaps = as_float_array("gaps", gaps)
        if gaps.ndim == 0:
            self.gaps = jnp.full(n - 1, gaps)
        else:
            self.gaps = gaps
        check_shape("gaps", self.gaps, (n - 1,), "one between each two balls")
        check_values("gaps", self.gaps, low=0.0)

    @property
    def mass(self) -> jax.Array:
        """M, its diagonal (n,): m_i l^2."""
        return self.masses * self.length**2

    def gravity(self, acceleration: Any) -> "PendulumPotential":
        """`V = g l sum m_i (1 - cos q_i)`."""
        return PendulumPotential(self.masses * self.length * acceleration)

    def touching(self) -> jax.Array:
        """Angles (n,) at rest, 0."""
        return jnp.zeros_like(self.masses)

    def gap_function(self, q: jax.Array) -> jax.Array:
        """Gaps f (n - 1,) [m] between neighbouring balls, see the class."""
        touching = self.radius[:-1] + self.radius[1:]
        displacement = jnp.diff(jnp.sin(q))
        right = touching + self.gaps + self.length * displacement
        up = self.length * jnp.diff(jnp.cos(q))
        # with the centres' distance c = (right, up) and d = touching, |c| - d as
        # (|c|^2 - d^2) / (|c| + d): exactly 0 at rest
        across = (right - touching) * (right + touching) + up**2
        return across / (jnp.sqrt(right**2 + up**2) + touching)

    def valid(self, q: jax.Array) -> jax.Array:
        """The least gap () [m] between balls that are no neighbours, which have no
        contact; of fewer than three balls that of any body.
        """
        i, j = np.triu_indices(self.masses.shape[0], 2)
        if not len(i):
            return super().valid(q)
        touching = self.radius[:-1] + self.radius[1:]
        between = touching + self.gaps
        first = jnp.zeros_like(between[:1])
        suspensions = jnp.concatenate([first, jnp.cumsum(between)])
        right = suspensions + self.length * jnp.sin(q)
        down = self.length * jnp.cos(q)
        across = right[i] - right[j]
        drop = down[i] - down[j]
        apart = jnp.sqrt(across**2 + drop**2)
        gaps = apart - self.radius[i] - self.radius[j]
        return jnp.min(gaps)

    @property
    def names(self) -> tuple[str, ...]:
        """Angles of the strings."""
        return numbered(PLANAR[2:], self.masses.shape[0])

    @property
    def floors(self) -> tuple[()]:
        """None: the balls hang."""
        return ()

    def outlines(self, q: np.ndarray, point: float) -> list[np.ndarray]:
        """Strings and balls."""
        return [curve for curves in self.outlines_by_body(q, point) for curve in curves]

    def outlines_by_body(self, q: np.ndarray, point: float) -> list[list[np.ndarray]]:
        """Curves (k, 2) [m] by body: the string and the circle of each ball at angles q
        (n,).
        """
        length = float(self.length)
        radius = np.asarray(self.radius)
        # distances of suspensions
        touching = radius[:-1] + radius[1:]
        between = touching + np.asarray(self.gaps)
        curves = []
        suspensions = np.cumsum([0.0, *between])
        for x, r, angle in zip(suspensions, radius, q):
            pivot = np.array([x, 0.0])
            direction = np.array([np.sin(angle), -np.cos(angle)])
            centre = pivot + length * direction
            string = np.stack([pivot, centre])
            curves.append([string, centre + r * CIRCLE])
        return curves


class PendulumPotential(eqx.Module):
    """`V = sum w_i (1 - cos q_i)`."""

    weight_length: jax.Array

    @full_precision
    def __call__(self, q: jax.Array) -> jax.Array:
        """V () [J]."""
        return self.weight_length @ (1 - jnp.cos(q))
