"""Rigid bodies by their shapes: in the plane over the ground, in space over a plane."""

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jimpact.bodies.base import CIRCLE, lengths, number, positive, positives, projected
from jimpact.bodies.rigid import (
    ContactPoints,
    RigidBody,
    Shape,
    place_of,
    quaternion_of,
    rotation,
)
from jimpact.core.scene import check_mass
from jimpact.tools.checks import (
    as_float_array,
    as_numbers,
    as_whole,
    check_choice,
    check_values,
    is_traced,
)
from jimpact.tools.compiling import full_precision

# [rad] of a round coin over its plane: below it the lowest points of its rims turn
# about the axis within a few steps. Ten times more ends motions of coins that fall flat
# earlier.
FLAT = 1e-3
LEVEL = (0.0, 0.0, 1.0)  # the normal of a level ground
# [rad] rounding of the angles of a polygon; ten times more would do as well
_FULL_TURN = 1e-6
_SLACK = 1e-6  # of a moment of inertia: rounding of the largest one, of a thin plate
_CONVEX = "must be those of a convex polygon, in order around it"
_SIGNS = np.array([*itertools.product((-1.0, 1.0), repeat=3)])  # corners of a box


class _PlanarBody(RigidBody):
    """A body over the ground y = 0; q = (x, y, theta) of its centre of mass."""

    def _make(
        self, points: jax.Array, mass: Any, inertia: Any, shape: Shape, rim: Any = 0.0
    ) -> None:
        """Set the fields of a body with points (P, 2) [m] over the ground; see
        `RigidBody._set`.
        """
        moment = positive("inertia", inertia)
        up = (0.0, 1.0)
        self._set(points, mass, moment[None], shape, rim, up)


class Block(_PlanarBody):
    """A rigid rectangle over the ground; q = (x, y, theta) of its centre.

    Equation: `f_{1,2} = y - (l/2) cos(theta) +/- (L/2) sin(theta)`, width L, height l;
    contact 1 is the right lower corner B, contact 2 the left one A. Tangents are the
    corners' positions along the ground, `x + (l/2) sin(theta) +/- (L/2) cos(theta)`.
    Contacts 3 and 4 are the left and the right upper corner: overturned, the block lies
    on another side.

    Args:
        width: L > 0 [m].
        height: l > 0 [m].
        mass: m > 0 [kg].
        inertia: I about the centre [kg m^2]; None: homogeneous, `m (l^2 + L^2) / 12`.
        corners: 'all' four; or 'base', the lower two of the literature on rocking: then
            the gap function holds while no upper corner is below the ground, see
            `valid`.

    Raises:
        ValueError: sizes, mass or inertia not positive, another word for `corners`.

    Source: Brogliato, Nonsmooth Mechanics (2016), (6.74).

    >>> import jimpact as ji
    >>> block = ji.Block(width=1.0, height=2.0, mass=3.0)
    >>> block.scene([0.0, 1.5, 0.0]).gaps.tolist()
    [0.5, 0.5, 2.5, 2.5]
    >>> ji.Block(1.0, 2.0, corners="base").gap_function(block.touching()).tolist()
    [0.0, 0.0]
    """

    def __init__(
        self,
        width: Any,
        height: Any,
        mass: Any = 1.0,
        inertia: Any = None,
        corners: str = "all",
    ):
        """Set the corners `(+/- L/2, +/- l/2)` and the moment of inertia, see the
        class.
        """
        width = positive("width", width)
        height = positive("height", height)
        if inertia is None:
            square = height**2 + width**2
            inertia = positive("mass", mass) * square / 12
        check_choice("corners", corners, ("all", "base"))
        w = 0.5 * width
        h = 0.5 * height
        x = jnp.stack([-w, w, w, -w])
        y = jnp.stack([-h, -h, h, h])
        points = jnp.stack([x, y], axis=1)
        # contact 1 is the right lower corner
        order = (1, 0, 3, 2) if corners == "all" else (1, 0)
        shape = Shape(order, 4, faces=True, centred=False)
        self._make(points, mass, inertia, shape)

    @property
    def range_in_words(self) -> str:  # type: ignore[override]
        """The condition `valid(q) >= 0` in words, for errors."""
        return "no upper corner below the ground: or give corners='all'"

    def valid(self, q: jax.Array) -> jax.Array:
        """With the lower corners only: height () of the lower one of the upper corners
        [m].
        """
        if len(self.shapes[0].order) == 4:
            return super().valid(q)
        corners = self.placed(q).points
        return jnp.min(corners[0, 2:, 1])


class Polygon(_PlanarBody):
    """A convex polygon over the ground; q = (x, y, theta) of its centre of mass.

    Equation: `f_i = y + (R(theta) c_i)_y`, c_i corner i from the centre of mass;
    tangents are the corners' positions along the ground, `x + (R(theta) c_i)_x`. One
    contact a corner, in the order
    given: a polygon may land on any side, and its gap function holds everywhere.

    Args:
        corners: (k, 2) around the polygon, k >= 3, in a frame of its own [m]. Traced
            ones must be in counter-clockwise order.
        mass: m > 0 [kg].
        inertia: I about the centre of mass [kg m^2]; None: homogeneous.
        centre: (2,) of mass, inside, in the frame of the corners [m]; None:
            homogeneous. With it goes an `inertia`.

    Raises:
        ValueError: corners that are not those of a convex polygon, a mass or an inertia
            that is not positive, a centre of mass that is outside or has no inertia.

    Source: areas and moments by Green's theorem.

    >>> import jimpact as ji
    >>> wedge = ji.Polygon([[0.0, 0.0], [3.0, 0.0], [0.0, 3.0]], mass=2.0)
    >>> wedge.scene(wedge.touching(0.0)).closed.tolist()
    [True, True, False]
    >>> wedge.corners[0].tolist()
    [-1.0, -1.0]
    """

    def __init__(
        self, corners: Any, mass: Any = 1.0, inertia: Any = None, centre: Any = None
    ):
        """Set the corners from the centre of mass, counter-clockwise, and the moment of
        inertia.
        """
        c = as_float_array("corners", corners)
        if c.ndim != 2 or c.shape[-1] != 2 or len(c) < 3:
            raise ValueError(
                f"Argument `corners` must have shape (k, 2), k >= 3, not {c.shape}."
            )
        check_values("corners", c)
        order = _around(c)
        c = c[np.array(order)]
        middle, about_middle = _moments(c)
        homogeneous = positive("mass", mass) * about_middle
        inertia = _given_inertia(inertia, homogeneous, centre)
        if centre is not None:
            middle = as_numbers("centre", centre, (2,), "a vector")
        points = c - middle[None]
        known = not is_traced(points)
        if known and not float(inner_radii(points[None])[0]) > 0:
            raise ValueError(
                f"Argument `centre` must lie inside the polygon, but has value "
                f"{middle.tolist()}."
            )
        shape = Shape(order, len(order), faces=True, centred=False)
        self._make(points, mass, inertia, shape)


class Disc(_PlanarBody):
    """A disc over the ground; q = (x, y, theta) of its centre of mass.

    Equation: `f = y + (R(theta) c)_y - r`, c the middle of the disc from the centre of
    mass; its lowest point slides at `x' + r theta'` where c = 0.

    Args:
        radius: r > 0 [m].
        mass: m > 0 [kg].
        inertia: I about the centre of mass [kg m^2]; None: homogeneous, `m r^2 / 2`.
        centre: (2,) of mass, from the middle of the disc and within it [m]; with it
            goes an `inertia`. None: the middle.

    Raises:
        ValueError: sizes, mass or inertia not positive, a centre of mass that is
            outside or has no inertia.

    >>> import jimpact as ji
    >>> ji.Disc(0.5, mass=2.0).scene([0.0, 0.75, 0.0]).gaps.tolist()
    [0.25]
    """

    def __init__(
        self, radius: Any, mass: Any = 1.0, inertia: Any = None, centre: Any = None
    ):
        radius = positive("radius", radius)
        homogeneous = 0.5 * positive("mass", mass) * radius**2
        inertia = _given_inertia(inertia, homogeneous, centre)
        shape, middle = _round_shape(radius, centre, 2, isotropic=True)
        self._make(middle[None], mass, inertia, shape, radius)


class Dimer(_PlanarBody):
    """Two equal spheres on the ends of a rod, in a vertical plane; q = (x, y, theta).

    Equation: `f_{1,2} = y +/- (L/2 + R) sin(theta) - R`, contact 1 the right sphere.
    The lowest point of a sphere slides at `v_t = x' -/+ (L/2 + R) sin(theta) theta' + R
    theta'`.

    Args:
        radius: R >= 0 of the spheres [m].
        length: L >= 0 of the rod between their surfaces [m]; 0: the spheres touch (R >
            0).
        sphere_mass: of one sphere, > 0 [kg].
        rod_mass: of the thin rod, >= 0 [kg].

    Raises:
        ValueError: a size or mass that is negative, no mass of the spheres, no size at
            all.

    Source: Brogliato, Nonsmooth Mechanics (2016), Remark 6.11.

    >>> import jimpact as ji
    >>> dimer = ji.Dimer(radius=1.0, length=2.0)
    >>> dimer.scene(dimer.touching(0.1)).closed.tolist()
    [False, True]
    >>> dimer = ji.Dimer(radius=5 / 24, length=1.0)  # where the kinetic angle is least
    >>> round(float(ji.theory.kinetic_angles(dimer.scene())[0, 1]), 6)
    1.424204
    """

    def __init__(
        self, radius: Any, length: Any, sphere_mass: Any = 1.0, rod_mass: Any = 1.0
    ):
        radius = positive("radius", radius, low_allowed=True)
        ends, mass, inertia = _dimer(radius, length, sphere_mass, rod_mass)
        shape = Shape((0, 1), 2, faces=False, centred=False)
        self._make(ends, mass, inertia, shape, radius)


# --------------------------------------------------------------------------------- in
# space


class _SpatialBody(RigidBody):
    """A body over a plane through the origin, q = (x, y, z, e_0, e_1, e_2, e_3); see
    `RigidBodies`.

    Contact i slides along two directions in the plane, the first one that of x.
    """

    def _make(
        self,
        points: jax.Array,
        mass: Any,
        inertia: Any,
        homogeneous: jax.Array,
        centre: Any,
        normal: Any,
        shape: Shape,
        rim: Any = 0.0,
    ) -> None:
        """Set the fields of a body, after checks of `inertia`, `centre` and `normal`.

        Args:
            points: c (P, 3) from the centre of mass [m].
            mass: m > 0 [kg].
            inertia: (3,) or (3, 3) about the centre of mass [kg m^2]; None:
                homogeneous.
            homogeneous: moments (3,) of inertia of a homogeneous body, over its mass
                [m^2].
            centre: centre of mass as given; None: the middle of the shape.
            normal: normal of the plane (3,), z > 0, of any length.
            shape: numbers and kind of the points.
            rim: radius about the points [m].
        """
        of_homogeneous = positive("mass", mass) * homogeneous
        inertia = _given_inertia(inertia, of_homogeneous, centre)
        n = as_numbers("normal", normal, (3,), "a vector")
        known = not is_traced(n)
        if known and not float(n[-1]) > 0:
            raise ValueError(
                f"Argument `normal` must point up (its z > 0), but has value "
                f"{n.tolist()}."
            )
        length = jnp.sqrt(jnp.sum(n**2))
        moments = _moments_in_space(inertia)
        self._set(points, mass, moments, shape, rim, n / length)


class Box(_SpatialBody):
    """A box in space over a plane; one contact per corner, eight contacts.

    Equation: c_i = middle + (+/- a/2, +/- b/2, +/- c/2), contacts in the order (-,-,-),
    (-,-,+), (-,+,-), ... (+,+,+) of the body's axes; with `rounding` r, spheres that
    touch the sides.
    `f_i = n . (x + R(e) c_i) - r`; q = (x, y, z, e_0, e_1, e_2, e_3), x the centre of
    mass, e a unit quaternion, scalar first; velocities (x', omega), omega in the body's
    axes.

    Args:
        sizes: (a, b, c) > 0 [m].
        mass: m > 0 [kg].
        inertia: about the centre of mass, (3,) along the body's axes or (3, 3) [kg
            m^2]; None: homogeneous, `m (b^2 + c^2) / 12`, ...
        centre: (3,) of mass, from the middle of the box and inside it [m]; with it goes
            an `inertia`. None: the middle.
        rounding: r >= 0 of the corners, at most half the shortest size [m].
        normal: of the plane (3,), z > 0: (0, 0, 1) is level.

    Raises:
        ValueError: sizes, mass or inertia not positive, moments of inertia that no body
            has, a centre of mass outside or without inertia, a rounding that does not
            fit.

    Source: Featherstone, Rigid Body Dynamics Algorithms (2008), ch. 2 and 4.

    >>> import jimpact as ji
    >>> box = ji.Box([0.2, 0.1, 0.3], mass=2.0)
    >>> scene = box.scene(box.touching())
    >>> scene.closed.tolist()[:4], scene.tangents.shape
    ([True, False, True, False], (6, 16))
    """

    def __init__(
        self,
        sizes: Any,
        mass: Any = 1.0,
        inertia: Any = None,
        centre: Any = None,
        rounding: Any = 0.0,
        normal: Any = LEVEL,
    ):
        """Set the middles of the rounded corners, `middle + (+/- (a/2 - r), ..)`, and
        moments.

        Moments of inertia of a homogeneous box over its mass are `(b^2 + c^2) / 12`,
        ...
        """
        sizes = as_float_array("sizes", sizes)
        sizes = positives("sizes", sizes, 3)
        rounding = positive("rounding", rounding, low_allowed=True)
        if centre is None:
            from_middle = np.zeros(3)
        else:
            from_middle = centre
        middle = -as_numbers("centre", from_middle, (3,), "a vector")
        if not is_traced((sizes, rounding, middle)):
            half = 0.5 * np.asarray(sizes)
            largest = float(half.min())
            check_values("rounding", rounding, high=largest)
            if not (np.abs(middle) < half).all():
                raise ValueError(
                    "Argument `centre` must lie inside the box, but has value "
                    f"{(-np.asarray(middle)).tolist()}."
                )
        from_corners = 0.5 * sizes - rounding
        signs = jnp.asarray(_SIGNS, sizes.dtype)
        points = middle[None] + signs * from_corners[None]
        squares = sizes**2
        homogeneous = (jnp.sum(squares) - squares) / 12
        corners = tuple(range(8))
        shape = Shape(corners, 8, faces=True, centred=False)
        self._make(points, mass, inertia, homogeneous, centre, normal, shape, rounding)

    @property
    def sizes(self) -> jax.Array:
        """(a, b, c) [m]."""
        corners = self.points[0]
        diagonal = corners[-1] - corners[0]
        return diagonal + 2 * self.rims[0]


class Sphere(_SpatialBody):
    """A sphere in space over a plane; one contact; q and velocities as of `Box`.

    Equation: `f = n . (x + R(e) c) - r`, c its middle from the centre of mass.

    Args:
        radius: r > 0 [m].
        mass: m > 0 [kg].
        inertia: about the centre of mass, scalar, (3,) along the body's axes or (3, 3)
            [kg m^2]; None: homogeneous, `2 m r^2 / 5`.
        centre: (3,) of mass, from the middle and inside [m]; with it goes an `inertia`.
        normal: of the plane (3,), z > 0: (0, 0, 1) is level.

    Raises:
        ValueError: as for `Box`.

    >>> import jimpact as ji
    >>> ball = ji.Sphere(0.1, mass=2.0)
    >>> [round(float(x), 6) for x in ball.scene(ball.touching()).tangents[:, 0]]
    [1.0, 0.0, 0.0, 0.0, -0.1, 0.0]
    """

    def __init__(
        self,
        radius: Any,
        mass: Any = 1.0,
        inertia: Any = None,
        centre: Any = None,
        normal: Any = LEVEL,
    ):
        """Set the middle from the centre of mass and the moments of inertia, see the
        class.
        """
        radius = positive("radius", radius)
        isotropic = inertia is None or np.ndim(inertia) == 0
        if inertia is not None and isotropic:
            moment = number("inertia", inertia)
            inertia = jnp.stack([moment] * 3)
        shape, middle = _round_shape(radius, centre, 3, isotropic)
        over_mass = 0.4 * radius**2
        homogeneous = jnp.stack([over_mass] * 3)
        self._make(
            middle[None], mass, inertia, homogeneous, centre, normal, shape, radius
        )


class SpatialDimer(_SpatialBody):
    """Two equal spheres on the ends of a rod in space over a plane.

    Equation: the rod lies along the first axis of the body,
    `c_{1,2} = (+/- (L/2 + R), 0, 0)`;
    `I = diag(I_a, I_t, I_t)`, `I_a = (4/5) m_s R^2`, I_t that of the planar `Dimer`.

    Args:
        radius: R > 0 of the spheres [m].
        length: L >= 0 of the rod between their surfaces [m]; 0: the spheres touch.
        sphere_mass: of one sphere, > 0 [kg].
        rod_mass: of the thin rod, >= 0 [kg].
        normal: of the plane (3,), z > 0: (0, 0, 1) is level.

    Raises:
        ValueError: a radius or mass that is not positive, a length that is negative.

    Source: own derivation; the planar case is Brogliato, Nonsmooth Mechanics (2016),
    Remark 6.11.

    >>> import jimpact as ji
    >>> dimer = ji.SpatialDimer(radius=5 / 24, length=1.0)
    >>> round(float(ji.theory.kinetic_angles(dimer.scene())[0, 1]), 6)
    1.424204
    """

    def __init__(
        self,
        radius: Any,
        length: Any,
        sphere_mass: Any = 1.0,
        rod_mass: Any = 1.0,
        normal: Any = LEVEL,
    ):
        """Set the middles of the spheres and the inertia `(I_a, I_t, I_t)`, see the
        class.
        """
        radius = positive("radius", radius)  # without radius no inertia about the axis
        ends, mass, across = _dimer(radius, length, sphere_mass, rod_mass)
        along = 0.8 * positive("sphere_mass", sphere_mass) * radius**2
        inertia = jnp.stack([along, across, across])
        shape = Shape((0, 1), 2, faces=False, centred=False)
        points = jnp.pad(ends, ((0, 0), (0, 1)))
        axes_of_moments = jnp.ones(3)
        self._make(points, mass, inertia, axes_of_moments, None, normal, shape, radius)


class Coin(_SpatialBody):
    """A coin, or wheel, in space over a plane; its axis is the third one of the body.

    Equation: with `u = R^T n` and `s = |(u_1, u_2)|` each of its two rims, at -h/2 and
    h/2 on the axis, touches with its lowest point
    `c = (-a u_1 / s, -a u_2 / s, -/+ h/2)`: the coin rolls. A coin that lies flat has
    no such point: with `corners=N` the rims are regular polygons, with a contact a
    corner. So it lands flat and comes to rest, and clatters where the other one rolls.
    q and velocities as of `Box`.

    Args:
        radius: a > 0 [m].
        thickness: h > 0 [m].
        mass: m > 0 [kg].
        inertia: about the centre of mass, (3,) along the body's axes or (3, 3) [kg
            m^2]; None: homogeneous, `m (3 a^2 + h^2) / 12` about a diameter,
            `m a^2 / 2` about the axis.
        corners: N >= 3 of each rim, 2 N contacts, those of the rim at -h/2 first; 0:
            round rims, 2 contacts, `valid` down to an angle of 1e-3 rad between coin
            and plane.
        normal: of the plane (3,), z > 0: (0, 0, 1) is level.

    Raises:
        ValueError: sizes, mass or inertia not positive, 1 or 2 corners.

    Source: own derivation.

    >>> import math, jimpact as ji
    >>> coin, upright = ji.Coin(0.1, 0.02), [math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0]
    >>> coin.scene(coin.touching(upright)).closed.tolist()
    [True, True]
    >>> ji.Coin(0.1, 0.02, corners=8).corners.shape
    (16, 3)
    """

    disc: jax.Array  # radius and thickness (2,)

    def __init__(
        self,
        radius: Any,
        thickness: Any,
        mass: Any = 1.0,
        inertia: Any = None,
        corners: int = 0,
        normal: Any = LEVEL,
    ):
        """Set the corners of both rims (round ones have none) and the inertia, see the
        class.
        """
        radius = positive("radius", radius)
        thickness = positive("thickness", thickness)
        self.disc = jnp.stack([radius, thickness])
        corners = as_whole("corners", corners, 0)
        if corners in (1, 2):
            raise ValueError(
                f"Argument `corners` must be 0 or at least 3, but has value {corners}."
            )
        between = 2 * np.pi / max(corners, 1)
        angle = between * np.arange(corners)
        outward = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        points = self._rims(jnp.asarray(outward))
        across = (3 * radius**2 + thickness**2) / 12
        along = 0.5 * radius**2
        homogeneous = jnp.stack([across, across, along])
        # on edge it does not look the same from all sides: not `centred`
        corner_numbers = tuple(range(len(points)))
        shape = Shape(corner_numbers, len(points), faces=False, centred=False)
        in_the_middle = None  # the centre of mass
        self._make(points, mass, inertia, homogeneous, in_the_middle, normal, shape)

    def _rims(self, outward: jax.Array) -> jax.Array:
        """Points (2 k, 3) of both rims in the directions `outward` (k, 2) from the
        axis.
        """
        radius, thickness = self.disc
        outward = outward.astype(self.disc.dtype)
        sides = jnp.array([-1.0, 1.0], outward.dtype)
        levels = 0.5 * thickness * sides
        z = jnp.repeat(levels, len(outward))
        x_y = jnp.tile(radius * outward, (2, 1))
        return jnp.concatenate([x_y, z[:, None]], axis=1)

    @property
    def range_in_words(self) -> str:  # type: ignore[override]
        """The condition `valid(q) >= 0` in words, for errors."""
        return "a quaternion of length 1, and a round coin that does not lie flat"

    @property
    def middles(self) -> jax.Array:
        """Its centre of mass."""
        return jnp.zeros((1, 3), self.points.dtype)

    @full_precision
    def _toward(self, q: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Rotation matrix R (3, 3) at q, and the plane's normal in the body's axes, R^T
        n (3,).
        """
        turn = rotation(quaternion_of(q))
        normal = self.plane_normals[0]
        return turn, normal @ turn

    @full_precision
    def contacts(self, q: jax.Array) -> ContactPoints:
        """Gaps, points and normals (m,) of its corners, or of the lowest point of round
        rims.
        """
        if self.points.size:
            return super().contacts(q)
        turn, up = self._toward(q)
        # direction from the axis to them, -(u_1, u_2) / s
        across = _across_axis(up)
        _, towards = lengths(across[None])
        rims = self._rims(-towards)
        centre = place_of(q)
        points = centre[None] + rims @ turn.T
        n = jnp.broadcast_to(self.plane_normals, points.shape)
        gap = jnp.sum(n * points, axis=1)
        return ContactPoints(gap, points, n)

    def pairs_in_contact(self) -> np.ndarray:
        """Body 0 and the plane, -1, of each contact (m, 2)."""
        contacts = self.points.shape[1] or 2
        return np.array([[0, -1]] * contacts, np.int32)

    def valid(self, q: jax.Array) -> jax.Array:
        """Margin () of the quaternion's length; of a round coin also `s - FLAT`, see
        the class.
        """
        length = super().valid(q)
        if self.points.size:
            return length
        _, up = self._toward(q)
        across = _across_axis(up)
        (s,), _ = lengths(across[None])
        return jnp.minimum(length, s - FLAT)

    def outlines_by_body(self, q: np.ndarray, point: float) -> list[list[np.ndarray]]:
        """Projected curves (k, 2) [m] at q: both rims, a diameter of the upper one."""
        return [[projected(curve) for curve in self._space_curves(q)]]

    def shadows(self, q: np.ndarray) -> list[np.ndarray]:
        """Projected shadows (k, 2) [m] of the rims and of the diameter at q."""
        return [self.shadow(curve) for curve in self._space_curves(q)]

    def _space_curves(self, q: np.ndarray) -> list[np.ndarray]:
        """Curves (k, 3) [m] at q: both rims, and a diameter of the upper one."""
        corners = self.points.shape[1] // 2
        around = np.linspace(0, 2 * np.pi, corners + 1)
        if corners:
            components = [np.cos(around), np.sin(around)]
            ring = np.stack(components, axis=1)
        else:
            ring = CIRCLE
        points = np.asarray(self._rims(jnp.asarray(ring)))
        rims = points.reshape(2, -1, 3)
        ends = jnp.asarray([[-1.0, 0.0], [1.0, 0.0]])
        across = np.asarray(self._rims(ends))
        quaternion = quaternion_of(jnp.asarray(q))
        turn = np.asarray(rotation(quaternion))
        _, diameter = across.reshape(2, -1, 3)  # of the lower and of the upper rim
        in_body = (*rims, diameter)
        return [place_of(q) + curve @ turn.T for curve in in_body]


# -------------------------------------------------------------------------------
# construction


def _given_inertia(inertia: Any, homogeneous: jax.Array, centre: Any) -> Any:
    """The argument `inertia`; None: that of a homogeneous body, where no `centre` is
    given.
    """
    if inertia is None and centre is not None:
        raise ValueError("Argument `inertia` must be given with `centre`.")
    if inertia is None:
        return homogeneous
    return inertia


def _round_shape(
    radius: jax.Array, centre: Any, d: int, isotropic: bool
) -> tuple[Shape, jax.Array]:
    """`Shape` of a disc or sphere, and its middle (d,) [m] from the centre of mass,
    `-centre`.

    `radius` [m], `centre` of mass from the middle (d,) [m], None: the middle;
    `isotropic`: equal moments of inertia about all axes. The shape is `centred` if it
    is isotropic about its middle: no turn changes it then. A ValueError of a centre
    outside the radius, where both are known.
    """
    middle = jnp.zeros(d, radius.dtype)
    if centre is not None:
        middle = -as_numbers("centre", centre, (d,), "a vector")
        known = not is_traced((middle, radius))
        if known and not np.linalg.norm(middle) <= float(radius):
            raise ValueError(
                f"Argument `centre` must be at most {float(radius):g} m from the "
                f"middle, but has value {(-middle).tolist()}."
            )
    centred = isotropic and centre is None
    # its only point is the middle, which touches planes at the distance of the radius
    shape = Shape(order=(0,), size=1, faces=False, centred=centred)
    return shape, middle


def _dimer(
    radius: jax.Array, length: Any, sphere_mass: Any, rod_mass: Any
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Centres (2, 2) [m] of the spheres of a dimer, its mass [kg], and its inertia [kg
    m^2].

    Equation: with the arm `a = L / 2 + R`, about an axis across the rod,
    `I = 2 m_s (2 R^2 / 5 + a^2) + m_r L^2 / 12`.
    """
    length = positive("length", length, low_allowed=True)
    arm = 0.5 * length + radius  # of a sphere's centre from the middle
    if not is_traced(arm) and arm <= 0:
        raise ValueError(
            "Argument `length` must be > 0 where `radius` is 0, but has value 0."
        )
    sphere = positive("sphere_mass", sphere_mass)
    rod = positive("rod_mass", rod_mass, low_allowed=True)
    directions = jnp.array([[1.0, 0.0], [-1.0, 0.0]], arm.dtype)
    ends = arm * directions
    about_own = 0.4 * radius**2
    of_spheres = 2 * sphere * (about_own + arm**2)
    of_rod = rod * length**2 / 12
    mass = 2 * sphere + rod
    return ends, mass, of_spheres + of_rod


def _moments_in_space(value: Any) -> jax.Array:
    """The argument `inertia` as (3,) or (3, 3) [kg m^2]; raise a ValueError where no
    body has it.

    Principal moments obey `I_3 <= I_1 + I_2`.
    """
    inertia = as_float_array("inertia", value)
    if inertia.shape not in ((3,), (3, 3)):
        raise ValueError(
            f"Argument `inertia` must have shape (3,) or (3, 3), not {inertia.shape}."
        )
    if is_traced(inertia):
        return inertia
    try:
        check_mass(inertia)
    except ValueError as error:
        words = str(error).replace("`mass`", "`inertia`")
        raise ValueError(words.replace("M ", "I ")) from None
    principal = np.asarray(inertia)
    if principal.ndim > 1:
        principal = np.linalg.eigvalsh(principal)
    moments = np.sort(principal)
    *others, largest = moments
    if largest > (1 + _SLACK) * sum(others):
        raise ValueError(
            f"Argument `inertia` must have principal moments none of which is more "
            f"than the sum of the others, but has {moments.tolist()}."
        )
    return inertia


def _around(corners: jax.Array) -> tuple[int, ...]:
    """Numbers of the corners (k, 2) of a convex polygon in counter-clockwise order.

    They are those given, or their reverse. Raise a ValueError unless sides turn the
    same way at all corners, by 2 pi in all; corners that are traced are taken as they
    are.
    """
    k = corners.shape[0]
    if is_traced(corners):
        return tuple(range(k))
    c = np.asarray(corners, float)
    following = np.roll(c, -1, axis=0)
    side = following - c
    after = np.roll(side, -1, axis=0)
    # [rad] between sides
    cosine = np.sum(side * after, axis=1)
    sine = _cross(side, after)
    turn = np.arctan2(sine, cosine)
    around = np.sign(turn.sum())  # 1: counter-clockwise
    onward = turn * around
    good = (onward > 0) & (onward < np.pi)
    bad = np.flatnonzero(~good)
    if bad.size:
        worst = int(bad[0] + 1) % k
        raise ValueError(
            f"Argument `corners` {_CONVEX}, but it does not turn the same way at "
            f"corner {worst}, {c[worst].tolist()}."
        )
    full_turn = abs(turn.sum())
    off = full_turn - 2 * np.pi
    if abs(off) > _FULL_TURN:
        raise ValueError(
            f"Argument `corners` {_CONVEX}, but they go around it more than once."
        )
    if around > 0:
        return tuple(range(k))
    return tuple(reversed(range(k)))


def _across_axis(direction: jax.Array) -> jax.Array:
    """The part (2,) of a direction (3,) across the axis of a coin, z of its axes."""
    return direction[:-1]


def _cross(a: Any, b: Any) -> Any:
    """Cross products (..) of vectors (.., 2) in the plane."""
    a_x = a[..., 0]
    a_y = a[..., -1]
    return a_x * b[..., -1] - a_y * b[..., 0]


@jax.jit  # operation by operation JAX would compile thirty programs
def inner_radii(corners: jax.Array) -> jax.Array:
    """Distances (b,) [m] of the origin from the nearest side of counter-clockwise
    polygons.

    Equation: `min(c_i x s_i / |s_i|)` over the sides s_i from `corners` c_i (b, K, 2)
    with a length, negative for an origin outside; infinite for a single point.
    """
    following = jnp.roll(corners, -1, axis=1)
    side = following - corners
    squares = jnp.sum(side**2, axis=2)
    length = jnp.sqrt(squares)
    has_length = length > 0
    divisor = jnp.where(has_length, length, 1.0)
    distance = _cross(corners, side) / divisor
    of_sides = jnp.where(has_length, distance, jnp.inf)
    return jnp.min(of_sides, axis=1)


@jax.jit
def _moments(ring: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Centroid (2,) [m], and moment of inertia about it over the mass () [m^2], of a
    polygon.

    Equation: with corners a_i, b_i of side i from corner 0 of the `ring` (k, 2), and
    `A_i = a_i x b_i`, the centroid is `sum A_i (a_i + b_i) / (3 sum A_i)`, the moment
    about corner 0 is `sum A_i (a_i^2 + a_i . b_i + b_i^2) / (6 sum A_i)`, less the
    centroid's square.
    """
    # about a corner: far from the origin, areas would cancel
    corner = ring[0]
    start = ring - corner[None]
    end = jnp.roll(start, -1, axis=0)
    twice_area = _cross(start, end)  # of the triangles at corner 0
    total = jnp.sum(twice_area)
    both = start + end
    weighted = both * twice_area[:, None]
    middle = jnp.sum(weighted, axis=0) / (3 * total)
    terms = start**2 + start * end + end**2
    squares = jnp.sum(terms, axis=1)
    of_areas = jnp.sum(twice_area * squares)
    about_corner = of_areas / (6 * total)
    about_middle = about_corner - jnp.sum(middle**2)
    return corner + middle, about_middle
