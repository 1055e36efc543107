"""Particles: in a corner of two walls, and balls above one another."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jimpact.bodies.base import (
    CIRCLE,
    PLANAR,
    Body,
    LinearPotential,
    number,
    numbered,
    positive,
    positives,
)
from jimpact.tools.checks import is_traced


class Corner(Body):
    """A particle between two walls that meet at the origin; q = (x, y).

    Equation: `f_1 = y`, `f_2 = x sin(angle) - y cos(angle)`: wall 1 along +x, wall 2
    along (cos(angle), sin(angle)); tangents point away from the corner.

    Args:
        angle: between the walls, in (0, pi) [rad].
        mass: > 0 [kg].

    Source: Brogliato, Nonsmooth Mechanics (2016), (6.66): the kinetic angle is the
    angle.

    >>> import jimpact as ji
    >>> ji.Corner(angle=1.0).gap_function(ji.Corner(angle=1.0).touching()).tolist()
    [0.0, 0.0]
    """

    angle: jax.Array
    particle_mass: jax.Array

    def __init__(self, angle: Any, mass: Any = 1.0):
        """Check that the angle lies in (0, pi) and the mass is positive."""
        self.angle = number("angle", angle)
        self.particle_mass = positive("mass", mass)
        if not is_traced(self.angle) and not 0 < float(self.angle) < np.pi:
            raise ValueError(
                f"Argument `angle` must lie in (0, pi), but has value "
                f"{float(self.angle):g}."
            )

    @property
    def mass(self) -> jax.Array:
        """M = diag(m, m)."""
        return jnp.stack([self.particle_mass, self.particle_mass])

    @property
    def base_directions(self) -> jax.Array:
        """The walls move in x and y (2, 2)."""
        return jnp.eye(2, dtype=self.mass.dtype)

    def gravity(self, acceleration: Any) -> LinearPotential:
        """`V = m g y`."""
        upwards = jnp.array([0.0, 1.0], self.mass.dtype)
        return LinearPotential(self.mass * upwards * acceleration)

    def gap_function(self, q: jax.Array) -> jax.Array:
        """Distances f (2,) [m] from wall 1 and from wall 2, see the class."""
        x, y = q
        from_second = x * jnp.sin(self.angle) - y * jnp.cos(self.angle)
        return jnp.stack([y, from_second])

    def tangent_function(self, q: jax.Array) -> jax.Array:
        """Positions (2,) [m] along the walls: `x`, and
        `x cos(angle) + y sin(angle)`.
        """
        x, y = q
        along_second = x * jnp.cos(self.angle) + y * jnp.sin(self.angle)
        return jnp.stack([x, along_second])

    def touching(self) -> jax.Array:
        """q (2,) in the corner."""
        return jnp.zeros(2, self.angle.dtype)

    @property
    def names(self) -> tuple[str, ...]:
        """x, y."""
        return PLANAR[:2]

    @property
    def floors(self) -> list[tuple[float, float]]:
        """The walls."""
        return [(0.0, 0.0), (float(self.angle), 0.0)]

    def outlines(self, q: np.ndarray, point: float) -> list[np.ndarray]:
        """The particle."""
        return [q + point * CIRCLE]


class Column(Body):
    """Balls above one another on a floor; q = their heights, ball 1 is the lowest.

    Equation: `f_1 = q_1 - R_1`, `f_j = (q_j - R_j) - (q_{j-1} + R_{j-1})`; contact 1 is
    the floor.

    Args:
        masses: (n,) > 0 [kg].
        radii: >= 0, scalar or (n,) [m]; 0: mass points.

    >>> import jimpact as ji, jax.numpy as jnp
    >>> ji.Column([1.0, 2.0], 0.5).gap_function(jnp.array([0.5, 2.0])).tolist()
    [0.0, 0.5]
    """

    masses: jax.Array
    radii: jax.Array

    def __init__(self, masses: Any, radii: Any = 0.0):
        self.masses = positives("masses", masses)
        count = self.masses.shape[0]
        radii = positives("radii", radii, count, low_allowed=True)
        self.radii = radii.astype(self.masses.dtype)

    @property
    def mass(self) -> jax.Array:
        """M, its diagonal (n,)."""
        return self.masses

    @property
    def base_directions(self) -> jax.Array:
        """The floor moves vertically (n, 1)."""
        bodies = self.masses.shape[0]
        return jnp.ones((bodies, 1), self.masses.dtype)

    def gravity(self, acceleration: Any) -> LinearPotential:
        """`V = g sum m_i q_i`."""
        return LinearPotential(self.masses * acceleration)

    def gap_function(self, q: jax.Array) -> jax.Array:
        """Gaps f (n,) [m] to the floor and between neighbours, see the class."""
        tops = q + self.radii
        top_below = jnp.concatenate([jnp.zeros(1, q.dtype), tops[:-1]])
        return q - self.radii - top_below

    def touching(self) -> jax.Array:
        """Heights (n,) of balls that lie on each other and on the floor."""
        return 2 * jnp.cumsum(self.radii) - self.radii

    @property
    def names(self) -> tuple[str, ...]:
        """Heights."""
        return numbered(("height [m]",), self.masses.shape[0])

    def outlines(self, q: np.ndarray, point: float) -> list[np.ndarray]:
        """Circles (k, 2) [m] about heights q; a mass point has the radius `point` and
        lies on q.
        """
        radii = np.asarray(self.radii)
        shown = np.where(radii > 0, radii, point)
        lift = np.where(radii > 0, 0.0, point)
        return [r * CIRCLE + (0, y + d) for r, y, d in zip(shown, q, lift, strict=True)]
