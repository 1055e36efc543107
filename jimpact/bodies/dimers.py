"""Dimers: two spheres and a rod, in a vertical plane and in space."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import check_values, is_traced
from jimpact.bodies.base import (
    CIRCLE,
    Body,
    LinearPotential,
    OnGround,
    number,
    positive,
    projected,
    turned,
)


class Dimer(OnGround):
    """Two equal spheres on the ends of a rod, in a vertical plane; q = (x, y, theta).

    Equation: `f_{1,2} = y +/- (L/2 + R) sin(theta) - R`, contact 1 the right sphere. The lowest
    point of a sphere slides at `v_t = x' -/+ (L/2 + R) sin(theta) theta' + R theta'`.

    Args:
        radius: R >= 0 of the spheres [m].
        length: L >= 0 of the rod between their surfaces [m]; 0: the spheres touch (R > 0).
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
        self.length = positive("length", length, low_allowed=True)
        if not is_traced(self.arm) and self.arm <= 0:
            raise ValueError("Argument `length` must be > 0 where `radius` is 0, but has value 0.")
        self.sphere_mass = positive("sphere_mass", sphere_mass)
        self.rod_mass = positive("rod_mass", rod_mass, low_allowed=True)

    @property
    def arm(self) -> jax.Array:
        """Distance of a sphere's centre from the middle, L/2 + R."""
        return 0.5 * self.length + self.radius

    @property  # type: ignore[misc]
    def total_mass(self) -> jax.Array:  # type: ignore[override]
        """Of both spheres and the rod."""
        return 2 * self.sphere_mass + self.rod_mass

    @property  # type: ignore[misc]
    def inertia(self) -> jax.Array:  # type: ignore[override]
        """About an axis through the middle, across the rod."""
        sphere = self.sphere_mass * (0.4 * self.radius**2 + self.arm**2)
        return 2 * sphere + self.rod_mass * self.length**2 / 12

    @property
    def rim(self) -> jax.Array:
        """The radius of the spheres."""
        return self.radius

    @property
    def points(self) -> jax.Array:
        """Centres of the spheres (2, 2)."""
        none = jnp.zeros_like(self.arm)
        return jnp.stack([jnp.stack([self.arm, none]), jnp.stack([-self.arm, none])])

    def outlines(self, q: np.ndarray, point: float) -> list[np.ndarray]:
        """The rod between the centres, and the spheres."""
        radius, arm = float(self.radius), float(self.arm)
        ends = turned(np.array([[arm, 0.0], [-arm, 0.0]]), q)
        return [ends, *(end + radius * CIRCLE for end in ends)]


class SpatialDimer(Body):
    """Two equal spheres on the ends of a rod over a plane; q = (x, y, z, yaw, pitch, spin).

    Equation: with the rod's axis `a = (cos p cos w, cos p sin w, sin p)`, pitch p, yaw w,
    `f_{1,2} = z +/- (L/2 + R) sin(p) - R`, and a sphere's lowest point slides at the horizontal
    part of `c_i' - R omega x e_z`. The spin about the axis belongs to q: friction across the rod
    changes it. Mass matrix: `m`, and `I |a'|^2 + I_a (omega . a)^2` with `I_a = (4/5) m_s R^2`.

    These angles do not serve an upright rod (pitch pi/2): there M is singular (`valid`: cos p).

    Args:
        radius: R > 0 of the spheres [m].
        length: L >= 0 of the rod between their surfaces [m]; 0: the spheres touch.
        sphere_mass: of one sphere, > 0 [kg].
        rod_mass: of the thin rod, >= 0 [kg].

    Source: own derivation; the planar case is Brogliato, Nonsmooth Mechanics (2016), Remark 6.11.

    >>> import jimpact as ji
    >>> body = ji.SpatialDimer(radius=1.0, length=2.0)
    >>> body.scene(body.touching()).tangents.shape
    (6, 4)
    """

    range_in_words = "a rod that is not upright"

    planar: Dimer

    def __init__(self, radius: Any, length: Any, sphere_mass: Any = 1.0, rod_mass: Any = 1.0):
        radius = positive("radius", radius)  # without radius no inertia about the axis
        self.planar = Dimer(radius, length, sphere_mass, rod_mass)

    @property
    def mass(self) -> Callable[[jax.Array], jax.Array]:
        """q -> M(q) (6, 6)."""
        return self._mass

    @property
    def base_directions(self) -> jax.Array:
        """The plane moves in x, y and z (6, 3)."""
        return jnp.eye(6, 3, dtype=self.planar.mass.dtype)

    def gravity(self, acceleration: Any) -> LinearPotential:
        """`V = m g z`."""
        up = jnp.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0], self.planar.mass.dtype)
        return LinearPotential(self.planar.total_mass * up * acceleration)

    def _mass(self, q: jax.Array) -> jax.Array:
        """M(q) (6, 6)."""
        body = self.planar
        about_axis = 0.8 * body.sphere_mass * body.radius**2
        sine, cosine = jnp.sin(q[4]), jnp.cos(q[4])
        zero, m = jnp.zeros_like(sine), body.total_mass
        turning = [
            [body.inertia * cosine**2 + about_axis * sine**2, zero, about_axis * sine],
            [zero, body.inertia, zero],
            [about_axis * sine, zero, about_axis],
        ]
        rows = [[*([zero] * 3), *row] for row in turning]
        moving = [[m if i == j else zero for j in range(6)] for i in range(3)]
        return jnp.stack([jnp.stack(row) for row in [*moving, *rows]])

    def gap_function(self, q: jax.Array) -> jax.Array:
        """Heights of the two spheres over the plane."""
        lift = self.planar.arm * jnp.sin(q[4])
        return jnp.stack([q[2] + lift, q[2] - lift]) - self.planar.radius

    def valid(self, q: jax.Array) -> jax.Array:
        """cos(pitch) ()."""
        return jnp.cos(q[4])

    def tangents(self, q: jax.Array) -> jax.Array:
        """H_t (6, 4): x and y of sphere 1, x and y of sphere 2."""

        def ends(q: jax.Array) -> jax.Array:
            """x, y of both centres (4,)."""
            level = self.planar.arm * jnp.cos(q[4])
            way = level * jnp.stack([jnp.cos(q[3]), jnp.sin(q[3])])
            return jnp.concatenate([q[:2] + way, q[:2] - way])

        # omega from the rates of yaw, pitch and spin; omega x e_z = (omega_y, -omega_x, 0)
        sine, cosine, level = jnp.sin(q[3]), jnp.cos(q[3]), jnp.cos(q[4])
        zero = jnp.zeros_like(sine)
        x = jnp.stack([zero, zero, zero, zero, sine, level * cosine])
        y = jnp.stack([zero, zero, zero, zero, -cosine, level * sine])
        rolling = self.planar.radius * jnp.stack([-y, x], axis=1)
        return jax.jacobian(ends)(q).T + jnp.concatenate([rolling, rolling], axis=1)

    def touching(self, angle: Any = 0.0, yaw: Any = 0.0) -> jax.Array:
        """q (6,) at the origin at this pitch `angle` and `yaw` [rad]: the lower sphere touches."""
        pitch, turn = number("angle", angle), number("yaw", yaw)
        check_values("angle", pitch, low=-0.5 * jnp.pi, high=0.5 * jnp.pi)
        zero = jnp.zeros_like(pitch)
        low = self.planar.touching(pitch)[1]
        return jnp.stack([zero, zero, low, turn.astype(zero.dtype), pitch, zero])

    @property
    def names(self) -> tuple[str, ...]:
        """x, y, z, yaw, pitch, spin."""
        return ("x [m]", "y [m]", "z [m]", "yaw [rad]", "pitch [rad]", "spin [rad]")

    @property
    def floors(self) -> tuple[()]:
        """None: outlines have a shadow on the plane instead."""
        return ()

    def outlines(self, q: np.ndarray, point: float) -> list[np.ndarray]:
        """The rod between the centres, its shadow, and the spheres, in projection."""
        level = np.array([np.cos(q[3]), np.sin(q[3])]) * np.cos(q[4])
        way = float(self.planar.arm) * np.append(level, np.sin(q[4]))
        ends = np.stack([q[:3] + way, q[:3] - way])
        spheres = (x + float(self.planar.radius) * CIRCLE for x in projected(ends))
        return [projected(ends), projected(ends * [1, 1, 0]), *spheres]
