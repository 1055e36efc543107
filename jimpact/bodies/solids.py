"""Bodies in space over a plane: boxes, spheres and coins, their orientation a unit quaternion."""

import itertools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import as_float_array, as_whole, check_shape, check_values, is_traced
from jimpact.bodies.base import (
    CIRCLE,
    Body,
    LinearPotential,
    inertia_of,
    lengths,
    number,
    positive,
    positives,
    projected,
)
from jimpact.compiling import full_precision
from jimpact.scene import check_mass

# How far a quaternion may be from length 1. Numbers written with six digits are within; ten times
# more, and a motion could turn a body by a visible angle before it says so.
UNIT_WITHIN = 1e-6
# [rad] of a round coin over its plane: below it the lowest points of its rims turn about the axis
# within a few steps. Ten times more ends motions of coins that fall flat earlier.
FLAT = 1e-3
_SLACK = 1e-6  # of a moment of inertia: rounding of the largest one, of a thin plate
_SERIES = 1e-2  # squares of angles below it go through the series: there the formula is 0/0
_UPRIGHT = (1.0, 0.0, 0.0, 0.0)  # the quaternion of no rotation
LEVEL = (0.0, 0.0, 1.0)  # the normal of a level ground


def _quaternion_product() -> np.ndarray:
    """(4, 4, 4): `(e f)_i = sum_jk table_ijk e_j f_k`; the last three of each form a vector."""
    table = np.zeros((4, 4, 4))
    table[0] = np.diag([1.0, -1.0, -1.0, -1.0])
    table[1:, 0, 1:] = table[1:, 1:, 0] = np.eye(3)
    table[1:, 1:, 1:] = _CROSS
    return table


_CROSS = np.cross(np.eye(3)[:, None], np.eye(3)[None]).transpose(2, 0, 1)  # of j and k, by i
_QUATERNION_PRODUCT = _quaternion_product()


class Solid(Body):
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

    @property
    def points(self) -> jax.Array:
        """c_i (m, 3) from the centre of mass [m]."""
        raise NotImplementedError(f"{type(self).__name__} must define `points`.")

    def points_toward(self, down: jax.Array) -> jax.Array:
        """c_i (m, 3) where `-down` (3,) is the normal of the plane in the body's axes."""
        return self.points

    @property
    def rim(self) -> Any:
        """r () of the spheres about them [m]."""
        return 0.0

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

    @property
    def base_directions(self) -> jax.Array:
        """The plane moves in x, y and z (6, 3)."""
        return jnp.eye(6, 3, dtype=self.mass.dtype)

    def gravity(self, acceleration: Any) -> LinearPotential:
        """`V = m g z`."""
        up = jnp.zeros(7, self.mass.dtype).at[2].set(1.0)
        return LinearPotential(self.total_mass * up * acceleration)

    def gap_function(self, q: jax.Array) -> jax.Array:
        """Heights of the contact points over the plane (m,)."""
        return self.gaps_and_normals(q)[0]

    @full_precision
    def gaps_and_normals(self, q: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Heights, and columns `(n, c_i x R^T n)`."""
        up = rotation(q).T @ self.normal
        points = self.points_toward(-up)
        turn = cross(points, up[None])
        still = jnp.broadcast_to(self.normal[None], turn.shape)
        gaps = self.normal @ q[:3] + points @ up - self.rim
        return gaps, jnp.concatenate([still, turn], axis=1).T

    @full_precision
    def tangents(self, q: jax.Array) -> jax.Array:
        """H_t (6, 2 m): two directions in the plane for each contact."""
        n = self.normal
        none = jnp.zeros_like(n[0])
        first = jnp.stack([n[2], none, none - n[0]]) / jnp.sqrt(n[2] ** 2 + n[0] ** 2)
        both = jnp.stack([first, cross(n, first)])
        back = rotation(q).T
        up = back @ n
        lever = self.points_toward(-up) - (self.rim * up)[None, :]
        turn = cross(lever[:, None, :], (both @ back.T)[None, :, :])
        still = jnp.broadcast_to(both[None], turn.shape)
        return jnp.concatenate([still, turn], axis=2).reshape(-1, 6).T

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
    def floors(self) -> tuple[()]:
        """None: outlines have a shadow on the plane instead."""
        return ()

    @full_precision
    def _drawn(self, q: np.ndarray, curve: np.ndarray) -> list[np.ndarray]:
        """A curve (k, 3) of the body in projection, and its shadow."""
        placed = q[:3] + curve @ np.asarray(rotation(jnp.asarray(q))).T
        n = np.asarray(self.normal)
        return [projected(placed), projected(placed - np.outer(placed @ n, n))]


class Box(Solid):
    """A box in space over a plane, see `Solid`; one contact per corner, eight contacts.

    Equation: c_i = middle + (+/- a/2, +/- b/2, +/- c/2), contacts in the order (-,-,-), (-,-,+),
    (-,+,-), ... (+,+,+) of the body's axes; with `rounding` r, spheres that touch the sides.

    Args:
        sizes: (a, b, c) > 0 [m].
        mass: m > 0 [kg].
        inertia: about the centre of mass, (3,) along the body's axes or (3, 3) [kg m^2]; None:
            homogeneous, `m (b^2 + c^2) / 12`, ...
        centre: (3,) of mass, from the middle of the box and inside it [m]; with it goes an
            `inertia`. None: the middle.
        rounding: r >= 0 of the corners, at most half the shortest size [m].
        normal: of the plane (3,), z > 0: (0, 0, 1) is level.

    Raises:
        ValueError: sizes, mass or inertia not positive, moments of inertia that no body has, a
            centre of mass outside or without inertia, a rounding that does not fit.

    Source: own derivation; see `Solid`.

    >>> import jimpact as ji
    >>> box = ji.Box([0.2, 0.1, 0.3], mass=2.0)
    >>> scene = box.scene(box.touching())
    >>> scene.closed.tolist()[:4], scene.tangents.shape
    ([True, False, True, False], (6, 16))
    """

    sizes: jax.Array
    rounding: jax.Array

    def __init__(
        self,
        sizes: Any,
        mass: Any = 1.0,
        inertia: Any = None,
        centre: Any = None,
        rounding: Any = 0.0,
        normal: Any = LEVEL,
    ):
        self.sizes = positives("sizes", as_float_array("sizes", sizes), 3)
        square = self.sizes**2
        self._weigh(mass, inertia, (jnp.sum(square) - square) / 12, centre, normal)
        self.rounding = positive("rounding", rounding, low_allowed=True)
        if not is_traced((self.sizes, self.rounding, self.middle)):
            half = 0.5 * np.asarray(self.sizes)
            check_values("rounding", self.rounding, high=float(half.min()))
            if not (np.abs(self.middle) < half).all():
                raise ValueError(
                    "Argument `centre` must lie inside the box, but has value "
                    f"{(-np.asarray(self.middle)).tolist()}."
                )

    @property
    def points(self) -> jax.Array:
        """Middles of the corners' spheres (8, 3)."""
        signs = jnp.array([*itertools.product((-1.0, 1.0), repeat=3)], self.sizes.dtype)
        return self.middle[None, :] + signs * (0.5 * self.sizes - self.rounding)[None, :]

    @property
    def rim(self) -> jax.Array:
        """The rounding."""
        return self.rounding

    def outlines(self, q: np.ndarray, point: float) -> list[np.ndarray]:
        """Its edges and their shadow, in projection."""
        signs = np.array([*itertools.product((-0.5, 0.5), repeat=3)])
        way = [0, 1, 3, 2, 0, 4, 5, 1, 5, 7, 3, 7, 6, 2, 6, 4]  # a way along all edges
        return self._drawn(q, (np.asarray(self.middle) + signs * np.asarray(self.sizes))[way])


class Sphere(Solid):
    """A sphere in space over a plane, see `Solid`; one contact.

    Equation: `f = n . (x + R c) - r`, c its middle from the centre of mass.

    Args:
        radius: r > 0 [m].
        mass: m > 0 [kg].
        inertia: about the centre of mass, scalar, (3,) along the body's axes or (3, 3) [kg m^2];
            None: homogeneous, `2 m r^2 / 5`.
        centre: (3,) of mass, from the middle and inside [m]; with it goes an `inertia`.
        normal: of the plane (3,), z > 0: (0, 0, 1) is level.

    Raises:
        ValueError: as for `Box`.

    >>> import jimpact as ji
    >>> ball = ji.Sphere(0.1, mass=2.0)
    >>> [round(float(x), 6) for x in ball.scene(ball.touching()).tangents[:, 0]]
    [1.0, 0.0, 0.0, 0.0, -0.1, 0.0]
    """

    radius: jax.Array
    is_round: bool = eqx.field(static=True)  # the same from all sides

    def __init__(
        self,
        radius: Any,
        mass: Any = 1.0,
        inertia: Any = None,
        centre: Any = None,
        normal: Any = LEVEL,
    ):
        self.radius = positive("radius", radius)
        self.is_round = centre is None and np.ndim(0.0 if inertia is None else inertia) == 0
        if inertia is not None and np.ndim(inertia) == 0:
            inertia = jnp.stack([number("inertia", inertia)] * 3)
        self._weigh(mass, inertia, jnp.stack([0.4 * self.radius**2] * 3), centre, normal)
        if not is_traced((self.radius, self.middle)):
            far = np.linalg.norm(np.asarray(self.middle))
            check_values("centre", far, high=float(self.radius))

    @property
    def points(self) -> jax.Array:
        """The middle (1, 3)."""
        return self.middle[None, :]

    @property
    def rim(self) -> jax.Array:
        """The radius."""
        return self.radius

    @full_precision
    def outlines(self, q: np.ndarray, point: float) -> list[np.ndarray]:
        """Its silhouette, and two great circles of the body with their shadow, in projection."""
        flat = np.insert(CIRCLE, 2, 0.0, axis=1)
        rings = np.concatenate([flat, np.roll(flat, 1, axis=1)])
        turning = self._drawn(q, np.asarray(self.middle) + float(self.radius) * rings)
        middle = q[:3] + np.asarray(rotation(jnp.asarray(q)) @ self.middle)
        return [*turning, projected(middle) + float(self.radius) * CIRCLE]


class Coin(Solid):
    """A coin, or wheel, in space over a plane, see `Solid`; its axis is the third one of the body.

    Equation: with `u = R^T n` and `s = |(u_1, u_2)|` each of its two rims, at -h/2 and h/2 on the
    axis, touches with its lowest point `c = (-a u_1 / s, -a u_2 / s, -/+ h/2)`: the coin rolls. A
    coin that lies flat has no such point: with `corners=N` the rims are regular polygons, with a
    contact a corner. So it lands flat and comes to rest, and clatters where the other one rolls.

    Args:
        radius: a > 0 [m].
        thickness: h > 0 [m].
        mass: m > 0 [kg].
        inertia: about the centre of mass, (3,) along the body's axes or (3, 3) [kg m^2]; None:
            homogeneous, `m (3 a^2 + h^2) / 12` about a diameter, `m a^2 / 2` about the axis.
        corners: N >= 3 of each rim, 2 N contacts, those of the rim at -h/2 first; 0: round rims,
            2 contacts, `valid` down to an angle of 1e-3 rad between coin and plane.
        normal: of the plane (3,), z > 0: (0, 0, 1) is level.

    Raises:
        ValueError: sizes, mass or inertia not positive, 1 or 2 corners.

    Source: own derivation; see `Solid`.

    >>> import math, jimpact as ji
    >>> coin, upright = ji.Coin(0.1, 0.02), [math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0]
    >>> coin.scene(coin.touching(upright)).closed.tolist()
    [True, True]
    >>> len(ji.Coin(0.1, 0.02, corners=8).points)
    16
    """

    range_in_words = "a quaternion of length 1, and a round coin that does not lie flat"

    radius: jax.Array
    thickness: jax.Array
    corners: int = eqx.field(static=True)

    def __init__(
        self,
        radius: Any,
        thickness: Any,
        mass: Any = 1.0,
        inertia: Any = None,
        corners: int = 0,
        normal: Any = LEVEL,
    ):
        self.radius, self.thickness = positive("radius", radius), positive("thickness", thickness)
        self.corners = as_whole("corners", corners, 0)
        if self.corners in (1, 2):
            raise ValueError(
                f"Argument `corners` must be 0 or at least 3, but has value {self.corners}."
            )
        across = (3 * self.radius**2 + self.thickness**2) / 12
        homogeneous = jnp.stack([across, across, 0.5 * self.radius**2])
        self._weigh(mass, inertia, homogeneous, None, normal)

    def _rims(self, outward: jax.Array) -> jax.Array:
        """Points (2 k, 3) of both rims in the directions `outward` (k, 2) from the axis."""
        levels = 0.5 * self.thickness * jnp.array([-1.0, 1.0], outward.dtype)
        each = jnp.repeat(levels, len(outward))[:, None]
        return jnp.concatenate([jnp.tile(self.radius * outward, (2, 1)), each], axis=1)

    @property
    def points(self) -> jax.Array:
        """Corners (2 N, 3), the first one along the first axis; none of a round coin."""
        angle = 2 * np.pi / max(self.corners, 1) * np.arange(self.corners)
        corners = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return self._rims(jnp.asarray(corners, self.radius.dtype))

    def points_toward(self, down: jax.Array) -> jax.Array:
        """Corners, or the lowest points (2, 3) of round rims."""
        return self.points if self.corners else self._rims(lengths(down[None, :2])[1])

    @full_precision
    def valid(self, q: jax.Array) -> jax.Array:
        """As of `Solid`; of round coins also the tilt beyond `FLAT`."""
        length = super().valid(q)
        if self.corners:
            return length
        tilt = lengths((rotation(q).T @ self.normal)[None, :2])[0][0]
        return jnp.minimum(length, tilt - FLAT)

    def outlines(self, q: np.ndarray, point: float) -> list[np.ndarray]:
        """Its rims, or their corners, a diameter, and their shadow, in projection."""
        around = np.linspace(0, 2 * np.pi, self.corners + 1) if self.corners else None
        ring = CIRCLE if around is None else np.stack([np.cos(around), np.sin(around)], axis=1)
        rims = np.asarray(self._rims(jnp.asarray(ring))).reshape(2, -1, 3)
        across = np.asarray(self._rims(jnp.asarray([[-1.0, 0.0], [1.0, 0.0]])))
        return [line for curve in (*rims, across[2:]) for line in self._drawn(q, curve)]


@full_precision
def rotation(q: jax.Array) -> jax.Array:
    """R (3, 3) of q (7,), from the body's axes to those of space, whatever the length of e."""
    cross = jnp.asarray(-_CROSS, q.dtype) @ q[4:]
    turn = 2 * (q[3] * cross + cross @ cross) / jnp.sum(q[3:] ** 2)
    return jnp.eye(3, dtype=q.dtype) + turn


@full_precision
def cross(a: jax.Array, b: jax.Array) -> jax.Array:
    """Vector products (.., 3), in fewer operations to compile than `jnp.cross`."""
    return jnp.sum(a[..., None, :] * jnp.tensordot(b, _CROSS.astype(b.dtype), (-1, 2)), axis=-1)


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
