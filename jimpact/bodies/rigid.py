"""One rigid body over a plane: what bodies in the plane and in space have in common."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import as_float_array, check_shape, check_values, is_traced
from jimpact.bodies.base import LinearPotential, inertia_of, number, positive, projected
from jimpact.bodies.contacts import CROSS, Assembly, ContactPoints, cross, on_planes, placed
from jimpact.compiling import full_precision
from jimpact.scene import check_mass

# How far a quaternion may be from length 1. Numbers written with six digits are within; ten times
# more, and a motion could turn a body by a visible angle before it says so.
UNIT_WITHIN = 1e-6
_SLACK = 1e-6  # of a moment of inertia: rounding of the largest one, of a thin plate
_SERIES = 1e-2  # squares of angles below it go through the series: there the formula is 0/0
_UPRIGHT = (1.0, 0.0, 0.0, 0.0)  # the quaternion of no rotation
LEVEL = (0.0, 0.0, 1.0)  # the normal of a level ground


def _quaternion_product() -> np.ndarray:
    """(4, 4, 4): `(e f)_i = sum_jk table_ijk e_j f_k`; the last three of each form a vector."""
    table = np.zeros((4, 4, 4))
    table[0] = np.diag([1.0, -1.0, -1.0, -1.0])
    table[1:, 0, 1:] = table[1:, 1:, 0] = np.eye(3)
    table[1:, 1:, 1:] = CROSS
    return table


_QUATERNION_PRODUCT = _quaternion_product()


class RigidBody(Assembly):
    """One rigid body over a plane; contact i is a circle or a sphere about one of its points.

    A body of this kind gives `points` (m, d) from its centre of mass and, unless it is 0, `rim`.
    """

    @property
    def points(self) -> jax.Array:
        """c_i (m, d) from the centre of mass [m]."""
        raise NotImplementedError(f"{type(self).__name__} must define `points`.")

    @property
    def rim(self) -> Any:
        """r () of the circles or spheres about them [m]."""
        return 0.0

    @property
    def count(self) -> int:
        """One."""
        return 1

    @property  # type: ignore[misc]
    def between(self) -> list[tuple[int, int]]:
        """Of all contacts: it and the plane."""
        return [(0, -1)]

    def _on_plane(self, points: jax.Array) -> ContactPoints:
        """Contacts of its points (m, d), where they are, with the plane."""
        rim = jnp.broadcast_to(jnp.asarray(self.rim, points.dtype), len(points))
        return on_planes(jnp.asarray(self.planes, points.dtype), points, rim)


class FewBodies(Assembly):
    """Rigid bodies with all their contacts."""

    bodies: eqx.AbstractVar[tuple[Any, ...]]

    @property
    def count(self) -> int:
        """Number of bodies that move."""
        return len(self.bodies)

    @property
    def mass(self) -> jax.Array:
        """M (n,), its diagonal, or (n, n)."""
        each = [body.mass for body in self.bodies]
        if all(mass.ndim == 1 for mass in each):
            return jnp.concatenate(each)
        return jax.scipy.linalg.block_diag(*(jnp.diag(m) if m.ndim == 1 else m for m in each))

    @property
    def owner(self) -> np.ndarray:
        """Bodies (p,) of all contact points with planes."""
        counts = [body.points.shape[0] for body in self.bodies]
        return np.repeat(np.arange(len(counts)), counts)

    def outlines(self, q: np.ndarray, point: float) -> list[np.ndarray]:
        """Those of all bodies."""
        each = zip(self.bodies, np.reshape(q, (self.count, -1)))
        return [curve for body, x in each for curve in body.outlines(x, point)]


class OnGround(RigidBody):
    """A rigid planar body above the ground y = 0; q = (x, y, theta) of its centre of mass.

    Equation: contact i is a circle of radius r about the point c_i of the body,
    `f_i = y + (R(theta) c_i)_y - r`, its lowest point slides at the rate of
    `x + (R(theta) c_i)_x + r theta`. A body of this kind gives `points` (m, 2), `total_mass` [kg],
    `inertia` [kg m^2] and, unless it is 0, `rim`.
    """

    total_mass: eqx.AbstractVar[jax.Array]
    inertia: eqx.AbstractVar[jax.Array]

    @property
    def mass(self) -> jax.Array:
        """M = diag(m, m, I)."""
        return jnp.stack([self.total_mass, self.total_mass, self.inertia])

    @property  # type: ignore[misc]
    def planes(self) -> np.ndarray:  # type: ignore[override]
        """The ground y = 0."""
        return np.eye(1, 3, 1)

    def contacts(self, q: jax.Array) -> ContactPoints:
        """Those of its points, where they are, with the ground."""
        return self._on_plane(placed(self.points, q[None]))

    def touching(self, angle: Any = 0.0) -> jax.Array:
        """q (3,) with x = 0, turned by `angle`, at which its lowest contacts touch the ground."""
        turn = number("angle", angle)
        zero = jnp.zeros_like(turn)
        return jnp.stack([zero, -jnp.min(self.gap_function(jnp.stack([zero, zero, turn]))), turn])


class Solid(RigidBody):
    """A rigid body in space over a plane through the origin; q = (x, y, z, e_0, e_1, e_2, e_3).

    Equation: x is the centre of mass, e a unit quaternion (scalar first), R(e) turns the body's
    axes into those of space. Velocities are v = (x', omega), omega in the body's axes:
    `e' = e (0, omega) / 2`, `M = diag(m, m, m) + I`,
    `M v' = F - (0, omega x I omega)`. Contact i is
    a sphere of radius r about the point c_i of the body: `f_i = n . (x + R c_i) - r`, its lowest
    point slides at `t . (x' + R (omega x d_i))`, `d_i = c_i - r R^T n`, along two directions t,
    the first one that of x, both in the plane. Turning is exact: `moved` keeps the length of e.
    A body of this kind gives `points` (m, 3), or `points_toward`, and, unless it is 0, `rim`; it
    holds `total_mass` [kg], `inertia` (3,) or (3, 3) [kg m^2], the `middle` of its shape from the
    centre of mass (3,) [m], and the `normal` of the plane (3,).

    Source: Featherstone, Rigid Body Dynamics Algorithms (2008), ch. 2 and 4.
    """

    range_in_words = "a quaternion of length 1"

    total_mass: jax.Array
    inertia: jax.Array  # (3,) its diagonal, or (3, 3)
    middle: jax.Array  # (3,) of the body's shape, from the centre of mass
    normal: jax.Array  # (3,)

    def _weigh(self, mass: Any, inertia: Any, homogeneous: Any, centre: Any, normal: Any) -> None:
        """Set what all bodies have; `homogeneous` are the moments of inertia over the mass."""
        self.total_mass = positive("mass", mass)
        self.middle = -_vector("centre", (0.0,) * 3 if centre is None else centre)
        if inertia is None:
            homogeneous = self.total_mass * homogeneous
        self.inertia = _inertia(inertia_of(inertia, homogeneous, centre))
        n = _vector("normal", normal)
        if not is_traced(n) and not float(n[2]) > 0:
            raise ValueError(
                f"Argument `normal` must point up (its z > 0), but has value {n.tolist()}."
            )
        self.normal = n / jnp.sqrt(jnp.sum(n**2))

    def points_toward(self, down: jax.Array) -> jax.Array:
        """c_i (m, 3) where `-down` (3,) is the normal of the plane in the body's axes."""
        return self.points

    @property  # type: ignore[misc]
    def planes(self) -> jax.Array:  # type: ignore[override]
        """Its plane, through the origin."""
        return jnp.append(self.normal, jnp.zeros((), self.normal.dtype))[None]

    @full_precision
    def contacts(self, q: jax.Array) -> ContactPoints:
        """Those of its points, where they are, with the plane."""
        turn = rotation(q)
        return self._on_plane(q[None, :3] + self.points_toward(-self.normal @ turn) @ turn.T)

    def ways(self, normal: jax.Array) -> jax.Array:
        """Two directions in the plane (m, 2, 3), the first one that of x."""
        x, y, z = normal.T
        first = jnp.stack([z, 0 * y, 0 * y - x], axis=1) / jnp.sqrt(x**2 + z**2)[:, None]
        return jnp.stack([first, cross(normal, first)], axis=1)

    def in_axes(self, q: jax.Array, body: Any, around: jax.Array) -> jax.Array:
        """Those of the body."""
        return around @ rotation(q)

    @property
    def coordinates(self) -> int:
        """Seven, with six velocities."""
        return 7

    @property
    def mass(self) -> jax.Array:
        """M (6,), its diagonal, or (6, 6)."""
        still = jnp.stack([self.total_mass] * 3)
        if self.inertia.ndim == 1:
            return jnp.concatenate([still, self.inertia])
        return jax.scipy.linalg.block_diag(jnp.diag(still), self.inertia)

    def valid(self, q: jax.Array) -> jax.Array:
        """How much farther from 1 the quaternion's length may be ()."""
        return UNIT_WITHIN - jnp.abs(jnp.sqrt(jnp.sum(q[3:] ** 2)) - 1)

    @full_precision
    def moved(self, q: jax.Array, u: jax.Array) -> jax.Array:
        """q displaced by u[:3] and turned by the vector u[3:] of the body's axes; |e| = 1."""
        e = q[3:] / jnp.sqrt(jnp.sum(q[3:] ** 2))
        half = 0.5 * u[3:]
        cosine, ratio = _cosine_and_sine_ratio(half @ half)
        turn = jnp.concatenate([cosine[None], ratio * half])
        return jnp.concatenate([q[:3] + u[:3], _product(e, turn)])

    @full_precision
    def nearby(self, q: jax.Array, u: jax.Array) -> jax.Array:
        """q after the displacement u, to second order in u: without sine and cosine."""
        e = q[3:] / jnp.sqrt(jnp.sum(q[3:] ** 2))
        half = 0.5 * u[3:]
        turn = jnp.concatenate([(1 - 0.5 * (half @ half))[None], half])
        return jnp.concatenate([q[:3] + u[:3], _product(e, turn)])

    @full_precision
    def pulled(self, q: jax.Array, gradient: jax.Array) -> jax.Array:
        """Gradient (7,) in q as one (6,) in the displacements, by `e' = e (0, omega) / 2`."""
        e = q[3:] / jnp.sqrt(jnp.sum(q[3:] ** 2))
        turns = 0.5 * jnp.tensordot(e, jnp.asarray(_QUATERNION_PRODUCT, e.dtype), (0, 1))[:, 1:]
        return jnp.concatenate([gradient[:3], gradient[3:] @ turns])

    @full_precision
    def inertial_force(self, q: jax.Array, v: jax.Array) -> jax.Array:
        """`-(0, omega x I omega)` (6,)."""
        omega = v[3:]
        spin = self.inertia * omega if self.inertia.ndim == 1 else self.inertia @ omega
        return jnp.concatenate([jnp.zeros_like(omega), -cross(omega, spin)])

    def gravity(self, acceleration: Any) -> LinearPotential:
        """`V = m g z`."""
        up = jnp.zeros(7, self.mass.dtype).at[2].set(1.0)
        return LinearPotential(self.total_mass * up * acceleration)

    @full_precision
    def at(self, position: Any, quaternion: Any = _UPRIGHT) -> jax.Array:
        """q (7,), the middle of its shape at `position` (3,) [m], turned by `quaternion` (4,)."""
        place, e = _vector("position", position), _unit(quaternion)
        away = jnp.concatenate([place, e])
        return away.at[:3].add(-rotation(away) @ self.middle)

    def touching(self, quaternion: Any = _UPRIGHT) -> jax.Array:
        """q (7,), turned by `quaternion` (4,), at which its lowest contacts touch the plane."""
        return _lowered(self, _unit(quaternion))

    @property
    def names(self) -> tuple[str, ...]:
        """x, y, z and the quaternion."""
        return ("x [m]", "y [m]", "z [m]", "e0 [1]", "e1 [1]", "e2 [1]", "e3 [1]")

    @property
    def velocity_names(self) -> tuple[str, ...]:
        """x', y', z' and the angular velocity in the body's axes."""
        return ("x' [m/s]", "y' [m/s]", "z' [m/s]", *(f"omega{i} [rad/s]" for i in (1, 2, 3)))

    @property
    def floors(self) -> list[tuple[float, float]]:
        """None: outlines have a shadow on the plane instead."""
        return []

    @full_precision
    def _drawn(self, q: np.ndarray, curve: np.ndarray) -> list[np.ndarray]:
        """A curve (k, 3) of the body in projection, and its shadow."""
        placed = q[:3] + curve @ np.asarray(rotation(jnp.asarray(q))).T
        n = np.asarray(self.normal)
        return [projected(placed), projected(placed - np.outer(placed @ n, n))]


@full_precision
def rotation(q: jax.Array) -> jax.Array:
    """R (3, 3) of q (7,), from the body's axes to those of space, whatever the length of e."""
    cross = jnp.asarray(-CROSS, q.dtype) @ q[4:]
    turn = 2 * (q[3] * cross + cross @ cross) / jnp.sum(q[3:] ** 2)
    return jnp.eye(3, dtype=q.dtype) + turn


@full_precision
def _product(e: jax.Array, other: jax.Array) -> jax.Array:
    """Product (4,) of the quaternions e and `other`."""
    return (jnp.asarray(_QUATERNION_PRODUCT, e.dtype) @ other) @ e


def _cosine_and_sine_ratio(square: jax.Array) -> tuple[jax.Array, jax.Array]:
    """`cos(a)` and `sin(a) / a` of `a^2`, with all derivatives at 0."""
    small = square < _SERIES
    a = jnp.sqrt(jnp.where(small, 1.0, square))
    x = jnp.where(small, square, 0.0)
    cosine = 1 - x / 2 * (1 - x / 12 * (1 - x / 30 * (1 - x / 56 * (1 - x / 90))))
    ratio = 1 - x / 6 * (1 - x / 20 * (1 - x / 42 * (1 - x / 72 * (1 - x / 110))))
    return jnp.where(small, cosine, jnp.cos(a)), jnp.where(small, ratio, jnp.sin(a) / a)


def _vector(name: str, value: Any) -> jax.Array:
    """A finite vector (3,)."""
    vector = as_float_array(name, value)
    check_shape(name, vector, (3,), "a vector in space")
    check_values(name, vector)
    return vector


@jax.jit  # operation by operation JAX would compile thirty programs
def _lowered(solid: Solid, quaternion: jax.Array) -> jax.Array:
    """q (7,) of a solid, turned like this, at which its lowest contacts touch the plane."""
    q = jnp.concatenate([jnp.zeros(3, solid.mass.dtype), quaternion])
    return q.at[:3].set(-jnp.min(solid.gap_function(q)) * solid.normal)


def _unit(quaternion: Any) -> jax.Array:
    """A quaternion (4,) of length 1."""
    e = as_float_array("quaternion", quaternion)
    check_shape("quaternion", e, (4,), "scalar first")
    check_values("quaternion", e)
    if not is_traced(e) and abs(float(np.linalg.norm(e)) - 1) > UNIT_WITHIN:
        raise ValueError(
            f"Argument `quaternion` must have length 1, but has length {np.linalg.norm(e):g}."
        )
    return e


def _inertia(value: Any) -> jax.Array:
    """Moments of inertia (3,), or their matrix (3, 3), that some body has [kg m^2]."""
    inertia = as_float_array("inertia", value)
    if inertia.shape not in ((3,), (3, 3)):
        raise ValueError(f"Argument `inertia` must have shape (3,) or (3, 3), not {inertia.shape}.")
    if is_traced(inertia):
        return inertia
    try:
        check_mass(inertia)
    except ValueError as error:
        raise ValueError(str(error).replace("`mass`", "`inertia`").replace("M ", "I ")) from None
    least = np.sort(inertia if inertia.ndim == 1 else np.linalg.eigvalsh(inertia))
    if least[2] > (1 + _SLACK) * (least[0] + least[1]):
        raise ValueError(
            "Argument `inertia` must have principal moments none of which is more than the sum of "
            f"the others, but has {least.tolist()}."
        )
    return inertia
