"""Discs: a disc with balls around its rim, in a plane."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import as_float_array, check_shape, check_values
from jimpact.bodies.base import PLANAR, Body, numbered, positive, positives, wheel
from jimpact.scene import Scene


class DiskBalls(Body):
    """A disk with balls around its rim, in a plane; q = (x, y, turn) of the disk, then each ball.

    Equation: `f_i = |c_i - c_0| - R - r_i`; at rest `W_ij = cos(phi_i - phi_j) / m_0 + delta_ij /
    m_i`. Sliding: `(v_i - v_0) . t_i - r_i omega_i - R omega_0`, t_i counter-clockwise. Inertia of
    the disk `m_0 R^2 / 2`, of a ball `(2/5) m_i r_i^2`.

    Args:
        disk_radius: R > 0 [m].
        ball_radius: r > 0, scalar or (m,) [m].
        disk_mass: m_0 > 0 [kg].
        ball_masses: m_i > 0 (m,) [kg].

    >>> import jimpact as ji
    >>> ji.DiskBalls(0.05, 0.01, 1.0, [0.1, 0.1]).mass.shape
    (9,)
    """

    disk_radius: jax.Array
    ball_radius: jax.Array
    disk_mass: jax.Array
    ball_masses: jax.Array

    def __init__(self, disk_radius: Any, ball_radius: Any, disk_mass: Any, ball_masses: Any):
        self.disk_radius = positive("disk_radius", disk_radius)
        self.disk_mass = positive("disk_mass", disk_mass)
        self.ball_masses = positives("ball_masses", ball_masses)
        self.ball_radius = positives("ball_radius", ball_radius, self.ball_masses.shape[0])

    @property
    def mass(self) -> jax.Array:
        """M, its diagonal (n,)."""
        disk = jnp.stack([self.disk_mass, self.disk_mass, self.disk_mass * self.disk_radius**2 / 2])
        turning = 0.4 * self.ball_masses * self.ball_radius**2
        balls = jnp.stack([self.ball_masses, self.ball_masses, turning], axis=1)
        return jnp.concatenate([disk, balls.reshape(-1)])

    def gap_function(self, q: jax.Array) -> jax.Array:
        """Distances between the disk and the balls."""
        way = self._apart(q)
        return jnp.sqrt(jnp.sum(way**2, axis=1)) - self.disk_radius - self.ball_radius

    def tangent_function(self, q: jax.Array) -> jax.Array:
        """Ways that the balls slide around the disk."""
        way = self._apart(q)
        around = (self.disk_radius + self.ball_radius) * jnp.arctan2(way[:, 1], way[:, 0])
        return around - self.ball_radius * q[5::3] - self.disk_radius * q[2]

    def touching(self, angles: Any, gaps: Any = None) -> jax.Array:
        """q (n,) with the disk at the origin and the balls at these angles (m,), gaps (m,) off."""
        m = self.ball_masses.shape[0]
        phi = as_float_array("angles", angles)
        check_shape("angles", phi, (m,), "one per ball")
        check_values("angles", phi)
        far = self.disk_radius + self.ball_radius
        if gaps is not None:
            off = as_float_array("gaps", gaps)
            check_shape("gaps", off, (m,), "one per ball")
            check_values("gaps", off, low=0.0)
            far = far + off
        balls = jnp.stack([far * jnp.cos(phi), far * jnp.sin(phi), jnp.zeros_like(phi)], axis=1)
        return jnp.concatenate([jnp.zeros(3, balls.dtype), balls.reshape(-1)])

    @property
    def names(self) -> tuple[str, ...]:
        """x, y, angle of the disk, as number 1, and of each ball."""
        return numbered(PLANAR, 1 + self.ball_masses.shape[0])

    @property
    def floors(self) -> tuple[()]:
        """None."""
        return ()

    def outlines(self, q: np.ndarray, point: float) -> list[np.ndarray]:
        """Circles, each with the radius that shows how far it has turned."""
        radii = [self.disk_radius, *self.ball_radius]
        return [wheel(r, at) for r, at in zip(radii, q.reshape(-1, 3))]

    def _apart(self, q: jax.Array) -> jax.Array:
        """Centres of the balls from that of the disk (m, 2)."""
        return q.reshape(-1, 3)[1:, :2] - q[None, :2]


def disk_balls(
    angles: Any,
    ball_masses: Any = 1.0,
    disk_mass: Any = 1.0,
    disk_radius: Any = 1.0,
    ball_radius: Any = 1.0,
    gaps: Any = None,
) -> Scene:
    """Scene of a disk with m balls around it, contact i with ball i; see `DiskBalls`.

    Velocities are (x', y', omega) of the disk and then of each ball. Two balls at angles pi and 0
    are a chain of three.

    Args:
        angles: phi (m,) of the balls around the disk [rad].
        ball_masses: scalar or (m,) > 0 [kg].
        disk_mass: > 0 [kg].
        disk_radius: > 0 [m].
        ball_radius: scalar or (m,) > 0 [m].
        gaps: (m,) >= 0 [m]; None: all touch.

    Returns:
        `Scene` of 3 (m + 1) coordinates and m contacts, with tangents.

    Raises:
        ValueError: sizes or masses out of range, wrong shapes. Whether balls overlap each other
            is not checked: they have no contacts among them.

    >>> import jimpact as ji
    >>> round(float(ji.kinetic_angles(ji.disk_balls([0.0, 3.14159265]))[0, 1]), 6)
    1.047198
    """
    phi = as_float_array("angles", angles)
    if phi.ndim != 1 or phi.shape[0] == 0:
        raise ValueError(f"Argument `angles` must have shape (m,), m >= 1, but has {phi.shape}.")
    masses = positives("ball_masses", ball_masses, phi.shape[0])
    system = DiskBalls(disk_radius, ball_radius, disk_mass, masses)
    return system.scene(system.touching(phi, gaps))
