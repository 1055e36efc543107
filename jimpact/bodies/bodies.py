"""Bodies on the ground, planar: the rocking block, and the dimer of two spheres and a rod."""

from typing import Any

import jax
import jax.numpy as jnp

from jimpact.bodies.base import Mechanism, number, positive
from jimpact.scene import Scene


class Block(Mechanism):
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
    mass: jax.Array
    inertia: jax.Array

    def __init__(self, width: Any, height: Any, mass: Any = 1.0, inertia: Any = None):
        self.width, self.height = positive("width", width), positive("height", height)
        self.mass = positive("mass", mass)
        if inertia is None:
            inertia = self.mass * (self.height**2 + self.width**2) / 12
        self.inertia = positive("inertia", inertia)

    @property
    def coordinates(self) -> int:
        """x, y, theta."""
        return 3

    def mass_matrix(self, q: jax.Array) -> jax.Array:
        """diag(m, m, I)."""
        return jnp.stack([self.mass, self.mass, self.inertia])

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

    def touching(self, angle: Any = 0.0) -> jax.Array:
        """q (3,) with x = 0 at which the lower corner (at angle 0: both) touches the ground."""
        return _touching(self, angle)


class Dimer(Mechanism):
    """Two equal spheres on the ends of a rod, in a vertical plane; q = (x, y, theta).

    Equation: `f_{1,2} = y +/- (L/2 + R) sin(theta) - R`, contact 1 the right sphere. The lowest
    point of a sphere slides at `v_t = x' -/+ (L/2 + R) sin(theta) theta' + R theta'`.

    Args:
        radius: R >= 0 of the spheres [m].
        length: L > 0 of the rod between their surfaces [m].
        sphere_mass: of one sphere, > 0 [kg].
        rod_mass: of the thin rod, >= 0 [kg].

    Source: Brogliato, Nonsmooth Mechanics (2016), Remark 6.11.

    >>> import jimpact as ji
    >>> dimer = ji.Dimer(radius=1.0, length=2.0)
    >>> dimer.scene(dimer.touching(0.1)).closed.tolist()
    [False, True]
    """

    radius: jax.Array
    length: jax.Array
    sphere_mass: jax.Array
    rod_mass: jax.Array

    def __init__(self, radius: Any, length: Any, sphere_mass: Any = 1.0, rod_mass: Any = 1.0):
        self.radius = positive("radius", radius, low_allowed=True)
        self.length = positive("length", length)
        self.sphere_mass = positive("sphere_mass", sphere_mass)
        self.rod_mass = positive("rod_mass", rod_mass, low_allowed=True)

    @property
    def coordinates(self) -> int:
        """x, y, theta."""
        return 3

    @property
    def arm(self) -> jax.Array:
        """Distance of a sphere's centre from the middle, L/2 + R."""
        return 0.5 * self.length + self.radius

    @property
    def total_mass(self) -> jax.Array:
        """Of both spheres and the rod."""
        return 2 * self.sphere_mass + self.rod_mass

    @property
    def inertia(self) -> jax.Array:
        """About an axis through the middle, across the rod."""
        sphere = self.sphere_mass * (0.4 * self.radius**2 + self.arm**2)
        return 2 * sphere + self.rod_mass * self.length**2 / 12

    def mass_matrix(self, q: jax.Array) -> jax.Array:
        """diag(m, m, I)."""
        return jnp.stack([self.total_mass, self.total_mass, self.inertia])

    def gap_function(self, q: jax.Array) -> jax.Array:
        """Heights of the right and the left sphere over the ground."""
        lift = self.arm * jnp.sin(q[2])
        return jnp.stack([q[1] + lift, q[1] - lift]) - self.radius

    def tangent_function(self, q: jax.Array) -> jax.Array:
        """Ways that the lowest points of the spheres slide."""
        rolled, side = q[0] + self.radius * q[2], self.arm * jnp.cos(q[2])
        return jnp.stack([rolled + side, rolled - side])

    def touching(self, angle: Any = 0.0) -> jax.Array:
        """q (3,) with x = 0 at which the lower sphere (at angle 0: both) touches the ground."""
        return _touching(self, angle)


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


def dimer(
    radius: Any, length: Any, sphere_mass: Any = 1.0, rod_mass: Any = 1.0, angle: Any = 0.0
) -> Scene:
    """Scene of a planar dimer on the ground; q = (x, y, theta).

    Equation: see `Dimer`. With all masses equal and a = radius / length,
    `alpha = (1 + 2 a)^2 / (16 a^2 / 5 + 1/3 + 2 (1 + 2 a)^2)`,
    `cos(theta_12) = -(1/3 - alpha) / (1/3 + alpha)`; theta_12 is least at a = 5/24.

    Args:
        radius: R >= 0 of the spheres [m].
        length: L > 0 of the rod between their surfaces [m].
        sphere_mass: of one sphere, > 0 [kg].
        rod_mass: of the thin rod, >= 0 [kg].
        angle: theta [rad]: > 0 lifts the right sphere, contact 1.

    Raises:
        ValueError: sizes or masses out of range, an angle that is not finite.

    Source: Brogliato, Nonsmooth Mechanics (2016), Remark 6.11.

    >>> import jimpact as ji
    >>> round(float(ji.kinetic_angles(ji.dimer(radius=5 / 24, length=1.0))[0, 1]), 6)
    1.424204
    """
    body = Dimer(radius, length, sphere_mass, rod_mass)
    return body.scene(body.touching(angle))


def _touching(body: Block | Dimer, angle: Any) -> jax.Array:
    turn = number("angle", angle)
    zero = jnp.zeros_like(turn)
    return jnp.stack([zero, -jnp.min(body.gap_function(jnp.stack([zero, zero, turn]))), turn])
