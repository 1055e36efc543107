"""Bodies in space over a plane: boxes, spheres and coins, their orientation a unit quaternion."""

import itertools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import as_float_array, as_whole, check_values, is_traced
from jimpact.bodies.base import CIRCLE, lengths, number, positive, positives, projected
from jimpact.bodies.rigid import LEVEL, Solid, rotation
from jimpact.compiling import full_precision

# [rad] of a round coin over its plane: below it the lowest points of its rims turn about the axis
# within a few steps. Ten times more ends motions of coins that fall flat earlier.
FLAT = 1e-3


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
