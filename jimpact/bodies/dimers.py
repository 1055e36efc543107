"""Dimers: two spheres and a rod, in a vertical plane and in space."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import is_traced
from jimpact.bodies.base import (
    CIRCLE,
    positive,
    turned,
)
from jimpact.bodies.rigid import LEVEL, OnGround, Solid


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
    >>> dimer = ji.Dimer(radius=5 / 24, length=1.0)  # where the kinetic angle is least
    >>> round(float(ji.kinetic_angles(dimer.scene())[0, 1]), 6)
    1.424204
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


class SpatialDimer(Solid):
    """Two equal spheres on the ends of a rod in space over a plane, see `Solid`; two contacts.

    Equation: the rod lies along the first axis of the body, `c_{1,2} = (+/- (L/2 + R), 0, 0)`;
    `I = diag(I_a, I_t, I_t)`, `I_a = (4/5) m_s R^2`, I_t that of the planar `Dimer`.

    Args:
        radius: R > 0 of the spheres [m].
        length: L >= 0 of the rod between their surfaces [m]; 0: the spheres touch.
        sphere_mass: of one sphere, > 0 [kg].
        rod_mass: of the thin rod, >= 0 [kg].
        normal: of the plane (3,), z > 0: (0, 0, 1) is level.

    Source: own derivation; the planar case is Brogliato, Nonsmooth Mechanics (2016), Remark 6.11.

    >>> import jimpact as ji
    >>> dimer = ji.SpatialDimer(radius=5 / 24, length=1.0)
    >>> round(float(ji.kinetic_angles(dimer.scene())[0, 1]), 6)
    1.424204
    """

    planar: Dimer

    def __init__(
        self,
        radius: Any,
        length: Any,
        sphere_mass: Any = 1.0,
        rod_mass: Any = 1.0,
        normal: Any = LEVEL,
    ):
        radius = positive("radius", radius)  # without radius no inertia about the axis
        self.planar = body = Dimer(radius, length, sphere_mass, rod_mass)
        about_axis = 0.8 * body.sphere_mass * radius**2
        inertia = jnp.stack([about_axis, body.inertia, body.inertia])
        self._weigh(body.total_mass, inertia, None, None, normal)

    @property
    def points(self) -> jax.Array:
        """Centres of the spheres (2, 3)."""
        return jnp.pad(self.planar.points, ((0, 0), (0, 1)))

    @property
    def rim(self) -> jax.Array:
        """The radius of the spheres."""
        return self.planar.radius

    def outlines(self, q: np.ndarray, point: float) -> list[np.ndarray]:
        """The rod between the centres, its shadow, and the spheres, in projection."""
        rod, shadow = self._drawn(q, np.asarray(self.points))
        return [rod, shadow, *(end + float(self.rim) * CIRCLE for end in rod)]
