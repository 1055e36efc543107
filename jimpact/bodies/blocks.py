"""Blocks: the rocking block in the plane."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jimpact.bodies.base import OnGround, positive, turned
from jimpact.scene import Scene


class Block(OnGround):
    """A rigid rectangle over the ground; q = (x, y, theta) of its centre, counter-clockwise.

    Equation: `f_{1,2} = y - (l/2) cos(theta) +/- (L/2) sin(theta)`, width L, height l; contact 1
    is the right lower corner B, contact 2 the left one A. Tangents are the corners' positions
    along the ground, `x + (l/2) sin(theta) +/- (L/2) cos(theta)`.

    Args:
        width: L > 0 [m].
        height: l > 0 [m].
        mass: m > 0 [kg].
        inertia: I about the centre [kg m^2]; None: homogeneous, `m (l^2 + L^2) / 12`.

    Source: Brogliato, Nonsmooth Mechanics (2016), (6.74).

    >>> import jimpact as ji
    >>> ji.Block(width=1.0, height=2.0, mass=3.0).scene([0.0, 1.5, 0.0]).gaps.tolist()
    [0.5, 0.5]
    """

    width: jax.Array
    height: jax.Array
    total_mass: jax.Array
    inertia: jax.Array

    def __init__(self, width: Any, height: Any, mass: Any = 1.0, inertia: Any = None):
        self.width, self.height = positive("width", width), positive("height", height)
        self.total_mass = positive("mass", mass)
        if inertia is None:
            inertia = self.total_mass * (self.height**2 + self.width**2) / 12
        self.inertia = positive("inertia", inertia)

    @property
    def mass(self) -> jax.Array:
        """M = diag(m, m, I)."""
        return jnp.stack([self.total_mass, self.total_mass, self.inertia])

    def gap_function(self, q: jax.Array) -> jax.Array:
        """Heights of the right and the left lower corner."""
        middle = q[1] - 0.5 * self.height * jnp.cos(q[2])
        lift = 0.5 * self.width * jnp.sin(q[2])
        return jnp.stack([middle + lift, middle - lift])

    def tangent_function(self, q: jax.Array) -> jax.Array:
        """Positions of the right and the left lower corner along the ground."""
        middle = q[0] + 0.5 * self.height * jnp.sin(q[2])
        side = 0.5 * self.width * jnp.cos(q[2])
        return jnp.stack([middle + side, middle - side])

    def outlines(self, q: np.ndarray, point: float) -> list[np.ndarray]:
        """The rectangle."""
        w, h = float(self.width) / 2, float(self.height) / 2
        return [turned(np.array([[w, -h], [-w, -h], [-w, h], [w, h], [w, -h]]), q)]


def rocking_block(
    width: Any, height: Any, mass: Any = 1.0, angle: Any = 0.0, inertia: Any = None
) -> Scene:
    """Scene of a block on the ground, at rest on its lower corner; q = (x, y, theta).

    Equation: see `Block`. Contact 1 is the right corner B, contact 2 the left corner A; at angle 0
    both are closed, otherwise the higher one is open. At angle 0 with homogeneous mass
    `cos(theta_12) = -(a^2 - 2) / (a^2 + 4)`, a = height / width.

    Args:
        width: L > 0 [m].
        height: l > 0 [m].
        mass: m > 0 [kg].
        angle: theta [rad], counter-clockwise: > 0 lifts the right corner.
        inertia: I about the centre [kg m^2]; None: homogeneous.

    Raises:
        ValueError: sizes, mass or inertia not positive, an angle that is not finite.

    Source: Brogliato, Nonsmooth Mechanics (2016), (6.74), (6.75).

    >>> import jimpact as ji
    >>> scene = ji.rocking_block(width=1.0, height=2.0)
    >>> round(float(ji.kinetic_angles(scene)[0, 1]), 6)
    1.823477
    """
    block = Block(width, height, mass, inertia)
    return block.scene(block.touching(angle))
