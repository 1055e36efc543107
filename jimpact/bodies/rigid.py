"""Rigid bodies in the plane and in space: positions and velocities of their points."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact.bodies.base import (
    CIRCLE,
    PLANAR,
    Body,
    Directions,
    LinearPotential,
    dot,
    lengths,
    number,
    numbered,
    positive,
    projected,
)
from jimpact.tools.checks import as_float_array, as_numbers, check_shape, is_traced
from jimpact.tools.compiling import full_precision

# How far a quaternion may be from length 1. Numbers written with six digits are within;
# ten times more, and a motion could turn a body by a visible angle before it says so.
UNIT_WITHIN = 1e-6
# squares of angles below it go through the series: there the formula is 0/0
_SERIES = 1e-2
_UPRIGHT = (1.0, 0.0, 0.0, 0.0)  # the quaternion of no rotation

# Tangents in space begin with the direction nearest to this one. No axis: contacts with
# a normal along it have no first tangent, and normals along axes are frequent.
_ASIDE = (0.7, -0.6, 0.387)

# of j and k, by i
_CROSS = np.cross(np.eye(3)[:, None], np.eye(3)[None]).transpose(2, 0, 1)
# a way along all edges of a box
_EDGES = [0, 1, 3, 2, 0, 4, 5, 1, 5, 7, 3, 7, 6, 2, 6, 4]


def _quaternion_product() -> np.ndarray:
    """Table (4, 4, 4) of the product of quaternions:
    `(e f)_i = sum_jk table_ijk e_j f_k`.

    The first entry of each is the scalar.
    """
    table = np.zeros((4, 4, 4))
    table[0] = np.diag([1.0, -1.0, -1.0, -1.0])
    vector = slice(1, None)
    table[vector, 0, vector] = np.eye(3)
    table[vector, vector, 0] = np.eye(3)
    table[vector, vector, vector] = _CROSS
    return table


_QUATERNION_PRODUCT = _quaternion_product()


class ContactPoints(NamedTuple):
    """Of m contacts: gap [m], where it is [m], and the unit normal from body 2 to body
    1.
    """

    gap: jax.Array  # (m,)
    point: jax.Array  # (m, 2 or 3)
    normal: jax.Array  # (m, 2 or 3)


class Shape(NamedTuple):
    """Constants of a body that are part of a compiled program."""

    # numbers of its points that make contact with planes, in order
    order: tuple[int, ...]
    size: int  # number of its points
    faces: bool  # a polygon or a box, which others may touch anywhere
    centred: bool  # a disc or sphere that looks the same from all sides

    @property
    def is_round(self) -> bool:
        """A disc or a sphere."""
        return self.size == 1


class _BodyAt(NamedTuple):
    """A body of points (P, d) [m] with a `rim` [m] that is to be drawn.

    `at` is its configuration, place of the centre of mass first; `turn` (d, d) is R.
    """

    shape: Shape
    points: np.ndarray
    rim: float
    at: np.ndarray
    turn: np.ndarray

    @property
    def middle(self) -> np.ndarray:
        """Point (d,) [m] halfway between the first and the last one."""
        return 0.5 * (self.points[0] + self.points[-1])

    def placed(self, points: np.ndarray) -> np.ndarray:
        """Points (.., d) of the body in the room [m]."""
        place = self.at[: len(self.turn)]
        return place + points @ self.turn.T


class Placed(NamedTuple):
    """Orientations R and points of b bodies in space: `x + R c` for each point c of a
    body.
    """

    turns: jax.Array  # R (b, d, d) from the axes of each body to those of space
    points: jax.Array  # (b, P, d) [m]


class RigidBodies(Body):
    """Rigid bodies in the plane or in space: points with a rim, mass and inertia of
    each.

    Equation: in the plane q holds (x, y, theta) of each body, x its centre of mass; in
    space (x, y, z, e_0, e_1, e_2, e_3), e a unit quaternion, scalar first, and
    velocities are (x', omega), omega in the body's axes: `e' = e (0, omega) / 2`,
    `M v' = F - (0, omega x I omega)`; `moved` turns exactly and keeps the length of e.
    At a contact of bodies i and j in the point x, along a direction t,
    `v_t = t . (x_i' + omega_i x (x - x_i)) - t . (x_j' + omega_j x (x - x_j))`; in the
    plane tangents are the normal turned to the right, in space two at right angles.
    Contact points are discs or spheres of radius r, the rim, about the points c of a
    body; on a plane `n . x >= c_w` they have `f = n . (x + R c) - r - c_w`.

    Source: Featherstone, Rigid Body Dynamics Algorithms (2008), ch. 2 and 4.
    """

    masses: jax.Array  # (b,) [kg]
    # (b, 1) in the plane, in space (b, 3), its diagonal, or (b, 3, 3)
    inertias: jax.Array
    # (b, P, d) from the centres of mass, of polygons counter-clockwise, the last one
    # repeated
    points: jax.Array
    rims: jax.Array  # (b,) radii about the points
    planes: jax.Array  # (w, d + 1) unit normal, distance
    shapes: tuple[Shape, ...] = eqx.field(static=True)

    def __repr__(self) -> str:
        """Numbers of bodies, points and planes, without the arrays."""
        each = self.points.shape[1]
        return (
            f"{type(self).__name__}({self.count} of up to {each} points, "
            f"{len(self.planes)} planes)"
        )

    # ---- sizes

    @property
    def dimension(self) -> int:
        """d = 2 or 3."""
        return self.planes.shape[1] - 1

    @property
    def plane_normals(self) -> jax.Array:
        """Unit normals (w, d) of the planes."""
        return self.planes[:, : self.dimension]

    @property
    def count(self) -> int:
        """Number of bodies that move."""
        return self.masses.shape[0]

    @property
    def angular(self) -> int:
        """Angular velocities of a body: 1 in the plane, 3 in space."""
        return 2 * self.dimension - 3

    @property
    def quaternions(self) -> bool:
        """True if q holds quaternions."""
        return self.dimension == 3

    @property
    def coordinates(self) -> int | None:
        """Seven for each body in space, with six velocities; None: as many as
        velocities.
        """
        if self.quaternions:
            return 7 * self.count
        return None

    @property
    def range_in_words(self) -> str:  # type: ignore[override]
        """The condition `valid(q) >= 0` in words, for errors."""
        if self.quaternions:
            return "a quaternion of length 1 each"
        return super().range_in_words

    def of_bodies(self, q: jax.Array) -> jax.Array:
        """Coordinates or velocities (b, ..) of each body."""
        return q.reshape(self.count, -1)

    def all_bodies(self, q: jax.Array) -> jax.Array:
        """Coordinates (b, ..) of each body, also of those that do not move."""
        return self.of_bodies(q)

    def rows(self) -> tuple[np.ndarray, np.ndarray]:
        """Numbers of body and of point (p,) of every point that makes contact with
        planes.
        """
        orders = [shape.order for shape in self.shapes[: self.count]]
        bodies = np.arange(len(orders))
        counts = [len(x) for x in orders]
        return np.repeat(bodies, counts), np.concatenate(orders)

    def pairs_in_contact(self) -> np.ndarray:
        """Bodies i and j (m, 2) of each contact; j of a plane is -1."""
        of_points, _ = self.rows()
        body = np.tile(of_points.astype(np.int32), len(self.planes))
        plane = np.full_like(body, -1)
        return np.stack([body, plane], axis=1)

    @property
    def between(self) -> tuple[tuple[int, int], ...]:
        """Bodies (i, j) of each contact; j of a plane is -1."""
        pairs = self.pairs_in_contact().tolist()
        return tuple((i, j) for i, j in pairs)

    # ---- mass and coordinates

    @property
    def mass(self) -> jax.Array:
        """M = diag(m, .., m, I) of each body in turn: its diagonal (n,), or (n, n)."""
        shape = (self.count, self.dimension)
        masses = jnp.broadcast_to(self.masses[:, None], shape)
        if self.inertias.ndim == 2:
            of_bodies = jnp.concatenate([masses, self.inertias], axis=1)
            return of_bodies.reshape(-1)
        each = zip(masses, self.inertias)
        blocks = (block for m, i in each for block in (jnp.diag(m), i))
        return jax.scipy.linalg.block_diag(*blocks)

    @full_precision
    def inertial_force(self, q: jax.Array, v: jax.Array) -> jax.Array:
        """Gyroscopic terms `-(0, omega x I omega)` of each body (n,) [N, N m]; 0 in the
        plane.
        """
        if not self.quaternions:
            return jnp.zeros_like(v)
        omega = turning_of(self.of_bodies(v))
        if self.inertias.ndim == 2:
            spin = self.inertias * omega
        else:
            spin = times(self.inertias, omega)
        torque = -cross(omega, spin)
        by_body = jnp.concatenate([jnp.zeros_like(omega), torque], axis=1)
        return by_body.reshape(-1)

    def valid(self, q: jax.Array) -> jax.Array:
        """Margin () of the quaternions' lengths: `UNIT_WITHIN - max | |e| - 1 |`."""
        if not self.quaternions:
            return super().valid(q)
        length, _ = lengths(quaternion_of(self.of_bodies(q)))
        return UNIT_WITHIN - jnp.max(jnp.abs(length - 1))

    @full_precision
    def moved(self, q: jax.Array, u: jax.Array) -> jax.Array:
        """q after the displacement u (n,): each body moved by u_x and turned by u_r, in
        its axes.

        Equation: `x + u_x`, and the quaternion `e (cos |h|, sin |h| h / |h|)`,
        `h = u_r / 2`, of length 1.
        """
        if not self.quaternions:
            return q + u
        half = 0.5 * turning_of(self.of_bodies(u))
        cosine, ratio = _cosine_and_sine_ratio(dot(half, half)[:, None])
        turn = jnp.concatenate([cosine, ratio * half], axis=1)
        return self._turned(q, u, turn)

    @full_precision
    def nearby(self, q: jax.Array, u: jax.Array) -> jax.Array:
        """q after a small displacement u, to second order in u: for derivatives at u =
        0.

        Equation: `x + u_x`, and the quaternion `e (1 - |h|^2 / 2, h)`, h half the turn
        in the axes of the body. First and second derivatives at u = 0 are those of
        `moved`, without its `sin|h| / |h|`, which is 0 / 0 there.
        """
        if not self.quaternions:
            return q + u
        half = 0.5 * turning_of(self.of_bodies(u))
        scalar = 1 - 0.5 * dot(half, half)[:, None]
        turn = jnp.concatenate([scalar, half], axis=1)
        return self._turned(q, u, turn)

    def _turned(self, q: jax.Array, u: jax.Array, turn: jax.Array) -> jax.Array:
        """q moved by the places of u (n,), with quaternions `e f / |e|`, f = `turn` (b,
        4).
        """
        table = _QUATERNION_PRODUCT.astype(q.dtype)
        q = self.of_bodies(q)
        u = self.of_bodies(u)
        _, e = lengths(quaternion_of(q))
        # sum_jk table_ijk e_j f_k
        by_turn = jnp.tensordot(turn, table, (1, 2))
        product = dot(by_turn, e[:, None])
        place = place_of(q) + place_of(u)
        by_body = jnp.concatenate([place, product], axis=1)
        return by_body.reshape(-1)

    @property
    def base_directions(self) -> jax.Array:
        """Velocities (n, d) of all bodies that move with their planes along each
        axis.
        """
        d = self.dimension
        of_body = jnp.eye(d + self.angular, d, dtype=self.masses.dtype)
        return jnp.tile(of_body, (self.count, 1))

    def gravity(self, acceleration: Any) -> LinearPotential:
        """Potential `V = g sum m_i h_i` [J], h the height: y in the plane, z in space
        [m].
        """
        d = self.dimension
        if self.quaternions:
            size = 7
        else:
            size = d + self.angular
        # h among a body's coordinates
        up = jnp.eye(1, size, d - 1, dtype=self.masses.dtype)
        weights = (self.masses[:, None] * up).reshape(-1)
        return LinearPotential(weights * acceleration)

    # ---- positions and velocities of points

    def turns(self, at: jax.Array) -> jax.Array:
        """Rotation matrices R (.., d, d) of bodies at coordinates (.., c), to the axes
        of space.
        """
        if self.quaternions:
            return rotation(quaternion_of(at))
        if self.dimension == 3:  # spheres of a pile: their turns do not matter
            identity = jnp.eye(3, dtype=at.dtype)
            return jnp.broadcast_to(identity, (*at.shape[:-1], 3, 3))
        theta = at[..., -1]
        c = jnp.cos(theta)
        s = jnp.sin(theta)
        entries = jnp.stack([c, -s, s, c], axis=-1)
        return entries.reshape(*c.shape, 2, 2)

    def placed(self, q: jax.Array) -> Placed:
        """Orientations and points of all bodies at q, in a `Bodies` the fixed ones
        last.
        """
        return self.placed_at(self.all_bodies(q), self.points)

    def placed_at(self, at: jax.Array, points: jax.Array) -> Placed:
        """Orientations R and points `x + R c` of bodies with points c (b, P, d) at (b,
        ..).
        """
        turns = self.turns(at)
        centre = at[:, None, : self.dimension]
        if all(shape.centred for shape in self.shapes):
            return Placed(turns, centre)
        return Placed(turns, centre + times(turns[:, None], points))

    def contacts(self, q: jax.Array) -> ContactPoints:
        """Gaps, points and normals (m,) at q; `between` holds the bodies of each
        contact.
        """
        return self.on_planes(self.placed(q).points)

    def on_planes(self, points: jax.Array) -> ContactPoints:
        """Contacts (w p,) of the p contact points among points x (b, P, d) with the w
        planes.

        Equation: `f = n . x - c - r` with the plane's normal n and distance c, and the
        body's rim r; the contact point is `x - r n`.
        """
        body, number = self.rows()
        d = self.dimension
        row = body * points.shape[1] + number
        points = points.reshape(-1, d)[row]
        rim = self.rims[body]
        shape = (len(self.planes), *points.shape)
        n = jnp.broadcast_to(self.plane_normals[:, None], shape)
        height = jnp.sum(n * points[None], axis=2)
        gap = height - self.planes[:, d:] - rim[None]
        point = points[None] - rim[None, :, None] * n
        flat_point = point.reshape(-1, d)
        return ContactPoints(gap.reshape(-1), flat_point, n.reshape(-1, d))

    @full_precision
    def gap_function(self, q: jax.Array) -> jax.Array:
        """Gaps f(q) (m,) [m]."""
        return self.contacts(q).gap

    @full_precision
    def normals(self, q: jax.Array) -> jax.Array:
        """N (n, m): `N^T v` is the velocity of body i away from body j."""
        return self.directions(q, with_tangents=False).normals

    @full_precision
    def tangents(self, q: jax.Array) -> jax.Array | None:
        """H_t (n, m), in space (n, 2 m): `H_t^T v` is the velocity of body i along body
        j.
        """
        return self.directions(q).tangents

    @full_precision
    def directions(self, q: jax.Array, with_tangents: bool = True) -> Directions:
        """f (m,) [m], N (n, m) and, `with_tangents`, H_t (n, m) or (n, 2 m) at q."""
        gap, point, normal = self.contacts(q)
        directions = normal[:, None]
        if not with_tangents:
            normals = self._relative_jacobian(q, point, directions)[..., 0]
            return Directions(gap, normals, None)
        tangents = self.unit_tangents(normal)
        directions = jnp.concatenate([directions, tangents], axis=1)
        jacobian = self._relative_jacobian(q, point, directions)
        along_tangents = jacobian[..., 1:].reshape(len(jacobian), -1)
        return Directions(gap, jacobian[..., 0], along_tangents)

    def unit_tangents(self, normal: jax.Array) -> jax.Array:
        """Unit tangents (m, d - 1, d) of normals (m, d)."""
        return tangents_of(normal)

    def contact_jacobian(
        self, at: jax.Array, point: jax.Array, directions: jax.Array
    ) -> jax.Array:
        """J (.., k, velocities of a body): `J v` is the velocity of its point along k
        directions.

        Equation: row k is `J_k = [d_k, r x d_k]`, r the lever arm from the body to the
        point; with quaternions `r x d_k` in the axes of the body.

        Args:
            at: coordinates of the bodies (.., c); leading axes of all three are
                broadcast.
            point: (.., d) [m].
            directions: unit vectors d_k (.., k, d).
        """
        place = at[..., : self.dimension]
        lever = (point - place)[..., None, :]
        along = directions
        if self.dimension == 2:
            around = (lever[..., 0] * along[..., 1] - lever[..., 1] * along[..., 0])[
                ..., None
            ]
        else:
            around = cross(lever, along)
        if self.quaternions:  # omega is in the axes of the body
            around = times(
                jnp.swapaxes(self.turns(at), -1, -2)[..., None, :, :], around
            )
        along = jnp.broadcast_to(along, (*around.shape[:-1], self.dimension))
        return jnp.concatenate([along, around], axis=-1)

    def _relative_jacobian(
        self, q: jax.Array, point: jax.Array, directions: jax.Array
    ) -> jax.Array:
        """J (n, m, k): `J^T v` are velocities of body i relative to body j at m
        contacts.

        They are taken at contact points `point` (m, d) [m] along unit `directions` (m,
        k, d).
        """
        pairs = self.pairs_in_contact()
        first, second = pairs.T
        if (second >= 0).any():
            movers = pairs
        else:  # planes do not move
            movers = first[:, None]
        at = self.of_bodies(q)[movers]
        jacobian = self.contact_jacobian(at, point[:, None], directions[:, None])
        jacobian = jacobian.at[:, 1:].multiply(-1.0)  # body j: (m, i or j, k, ..)
        # by JAX: of thousands of bodies only the shapes are needed, and this would fill
        # the memory
        own = (
            jnp.asarray(movers)[:, :, None]
            == np.arange(self.count, dtype=np.int32)[None, None]
        )
        # (m, body, k, velocities)
        rows = jnp.sum(
            jnp.where(own[..., None, None], jacobian[:, :, None], 0.0), axis=1
        )
        velocities = self.count * (self.dimension + self.angular)
        return rows.transpose(1, 3, 0, 2).reshape(velocities, *directions.shape[:2])

    @full_precision
    def at(self, positions: Any, turns: Any = None) -> jax.Array:
        """q (n,) of bodies at `positions` (b, d) [m], with angles (b,) [rad] or
        quaternions (b, 4).

        Positions are those of the centres of mass, in space of the middles of the
        shapes:
        `x = position - R middle`. `turns` None: 0, or no rotation.
        """
        d = self.dimension
        count = self.count
        places = as_numbers("positions", positions, (count, d), "one for each body")
        if not self.quaternions:
            if turns is None:
                turning = jnp.zeros((count, self.angular))
            else:
                turning = turns
            turning = as_float_array("turns", turning).reshape(-1, self.angular)
            check_shape("turns", turning, (count, self.angular), "of each body")
            return jnp.concatenate(
                [places, turning.astype(places.dtype)], axis=1
            ).reshape(-1)
        if turns is None:
            unit = [_UPRIGHT] * count
        else:
            unit = turns
        e = jnp.stack([unit_quaternion(x) for x in unit])
        check_shape("turns", e, (count, 4), "a quaternion of each body")
        centre = places - times(rotation(e), self.middles)
        return jnp.concatenate([centre, e.astype(centre.dtype)], axis=1).reshape(-1)

    @property
    def middles(self) -> jax.Array:
        """Middles (b, 3) [m] of shapes in space, from the centres of mass, in the
        bodies' axes.

        Each is halfway between the first and the last point.
        """
        return 0.5 * (self.points[: self.count, 0] + self.points[: self.count, -1])

    # ---- names and pictures

    @property
    def names(self) -> tuple[str, ...]:
        """Names of q: place and angle, quaternion or turns of each body."""
        if self.dimension == 2:
            return numbered(PLANAR, self.count)
        turns = tuple(f"turn {axis} [rad]" for axis in "xyz")
        if self.quaternions:
            turns = tuple(f"e{i} [1]" for i in range(4))
        return numbered(("x [m]", "y [m]", "z [m]", *turns), self.count)

    @property
    def velocity_names(self) -> tuple[str, ...]:
        """Names of v: rates of q, in space angular velocities in the axes of the
        bodies.
        """
        if not self.quaternions:
            return super().velocity_names
        spins = tuple(f"omega{i} [rad/s]" for i in (1, 2, 3))
        return numbered(("x' [m/s]", "y' [m/s]", "z' [m/s]", *spins), self.count)

    @property
    def floors(self) -> list[tuple[float, float]]:
        """(angle, offset) of the planes; in space none: `shadows` show the first."""
        if self.dimension == 3:
            return []
        return [
            (float(np.arctan2(-x, y)), float(c)) for x, y, c in np.asarray(self.planes)
        ]

    def outlines(self, q: np.ndarray, point: float) -> list[np.ndarray]:
        """Curves (k, 2) [m] of all bodies at q; in space projected."""
        return [curve for curves in self.outlines_by_body(q, point) for curve in curves]

    def outlines_by_body(self, q: np.ndarray, point: float) -> list[list[np.ndarray]]:
        """Curves (k, 2) [m] at q by body, see `outlines`; `point` is not used."""
        if self.dimension == 2:
            draw = self._plane_curves
        else:
            draw = self._projected_curves
        return [draw(body) for body in self._bodies_at(q)]

    def shadows(self, q: np.ndarray) -> list[np.ndarray]:
        """Projected shadows (k, 2) [m] on the first plane at q; none in the plane."""
        if self.dimension == 2:
            return []
        curves = [self._space_curve(body) for body in self._bodies_at(q)]
        return [self.shadow(curve) for curve in curves]

    def _bodies_at(self, q: np.ndarray) -> list[_BodyAt]:
        """The bodies at q, for pictures."""
        at = self.all_bodies(jnp.asarray(q, self.points.dtype))
        each = zip(
            self.shapes,
            self.points,
            self.rims,
            np.asarray(at),
            np.asarray(self.turns(at)),
        )
        return [
            _BodyAt(shape, np.asarray(points)[: shape.size], float(rim), at, turn)
            for shape, points, rim, at, turn in each
        ]

    def _plane_curves(self, body: _BodyAt) -> list[np.ndarray]:
        """Curves of a disc and one of its radii, of a polygon, or of a rod between two
        discs.
        """
        if body.shape.is_round:
            spoke = np.concatenate([[[0.0, 0.0]], CIRCLE])
            return [body.placed(body.rim * spoke + body.points[0])]
        ends = body.placed(body.points)
        if body.shape.faces:
            return [np.concatenate([ends, ends[[0]]])]
        return [ends, *(end + body.rim * CIRCLE for end in ends)]

    def _space_curve(self, body: _BodyAt) -> np.ndarray:
        """Curve (k, 3) [m]: two great circles of a ball, edges of a box, or a rod."""
        if body.shape.is_round:
            flat = body.rim * np.insert(CIRCLE, 2, 0.0, axis=1)
            upright = np.roll(flat, 1, axis=1)
            return body.placed(body.middle + np.concatenate([flat, upright]))
        if body.shape.faces:
            outward = np.sign(body.points - body.middle)
            corners = body.points + body.rim * outward
            return body.placed(corners[_EDGES])
        return body.placed(body.points)

    def _projected_curves(self, body: _BodyAt) -> list[np.ndarray]:
        """`_space_curve` projected (k, 2) [m], and the outlines of a ball, or of the
        balls at the ends of a rod.
        """
        curve = projected(self._space_curve(body))
        circle = body.rim * CIRCLE
        if body.shape.is_round:
            return [curve, projected(body.placed(body.middle)) + circle]
        if body.shape.faces:
            return [curve]
        return [curve, *(end + circle for end in curve)]

    def shadow(self, curve: np.ndarray) -> np.ndarray:
        """Projection (k, 2) of the shadow of a curve x (k, 3) [m] on the first plane.

        Equation: the shadow is `x - (n . x - c) n`; without planes on z = 0.
        """
        if len(self.planes):
            plane = np.asarray(self.planes)[0]
        else:
            plane = np.array([0.0, 0, 1, 0])
        *normal, distance = plane
        height = curve @ normal - distance
        return projected(curve - np.outer(height, normal))


class RigidBody(RigidBodies):
    """One rigid body over the ground y = 0, or in space over a plane through the
    origin.
    """

    def _set(
        self,
        points: jax.Array,
        mass: Any,
        inertia: jax.Array,
        shape: Shape,
        rim: Any,
        normal: Any,
    ) -> None:
        """Set the fields of `RigidBodies` for one body and one plane through the
        origin.

        Args:
            points: c (P, d) from the centre of mass [m].
            mass: m > 0 [kg].
            inertia: (1,) in the plane; (3,) or (3, 3) in space [kg m^2].
            shape: numbers and kind of the points.
            rim: radius about the points [m].
            normal: unit normal of the plane (d,).
        """
        self.masses = positive("mass", mass)[None]
        self.inertias = inertia[None]
        self.points = points[None]
        self.shapes = (shape,)
        self.rims = jnp.asarray(rim, points.dtype)[None]
        self.planes = jnp.append(jnp.asarray(normal, points.dtype), 0.0)[None].astype(
            points.dtype
        )

    @property
    def corners(self) -> jax.Array:
        """Its contact points (k, d), in order, from the centre of mass [m]."""
        order = np.array(self.shapes[0].order)
        return self.points[0, order]

    @property
    def radius(self) -> jax.Array:
        """Radius of a disc or sphere, of the ends of a dimer, or rounding of a box ()
        [m].
        """
        return self.rims[0]

    @property
    def inertia(self) -> jax.Array:
        """About the centre of mass, () in the plane, (3,) or (3, 3) in space [kg
        m^2].
        """
        if self.dimension == 2:
            return self.inertias[0, 0]
        return self.inertias[0]

    def unit_tangents(self, normal: jax.Array) -> jax.Array:
        """Unit tangents (m, d - 1, d) of unit normals n (m, d); in space t_1 has no y
        component.

        Equation: `t_1 = (n_z, 0, -n_x) / sqrt(n_x^2 + n_z^2)`, `t_2 = n x t_1`.
        """
        if self.dimension == 2:
            return tangents_of(normal)
        x, y, z = normal.T
        across = jnp.stack([z, 0 * y, 0 * y - x], axis=1)
        first = across / jnp.sqrt(x**2 + z**2)[:, None]
        return jnp.stack([first, cross(normal, first)], axis=1)

    def at(self, position: Any, turn: Any = None) -> jax.Array:
        """q of the body at `position` (d,) [m], turned by an angle [rad] or a
        quaternion (4,).

        The position is that of the centre of mass, in space of the middle of its shape.
        """
        place = as_numbers("position", position, (self.dimension,), "a point")
        return super().at(place[None], None if turn is None else [turn])

    def touching(self, turn: Any = None) -> jax.Array:
        """q at which the lowest contacts touch, turned by an angle [rad] or, in space,
        a quaternion (4,); None: not turned.
        """
        if self.dimension == 2:
            return _lowered(self, number("turn", 0.0 if turn is None else turn)[None])
        if turn is None:
            turn = _UPRIGHT
        return _lowered(self, unit_quaternion(turn, "turn"))


def place_of(x: Any) -> Any:
    """The place (.., 3) of poses (.., 7), or of velocities or displacements (.., 6)."""
    return x[..., :3]


def quaternion_of(q: Any) -> Any:
    """The quaternion (.., 4) of poses (.., 7)."""
    return q[..., 3:]


def turning_of(v: Any) -> Any:
    """The angular part (.., 3) of velocities or displacements (.., 6)."""
    return v[..., 3:]


def _vector_of(e: jax.Array) -> jax.Array:
    """The vector a (.., 3) of quaternions e = (s, a)."""
    return e[..., 1:]


@full_precision
def rotation(e: jax.Array) -> jax.Array:
    """Rotation matrices R (.., 3, 3) of quaternions e = (s, a) (.., 4) of any length.

    Equation: `R = I + 2 (s [a]x + a a^T - |a|^2 I) / |e|^2`, `[a]x b = a x b`.
    """
    s = e[..., 0, None, None]
    a = _vector_of(e)
    square = dot(e, e)[..., None, None]
    table = -_CROSS.astype(e.dtype)
    across = jnp.tensordot(a, table, (-1, 2))  # [a]x
    outer = a[..., :, None] * a[..., None, :]
    identity = jnp.eye(3, dtype=e.dtype)
    one = jnp.broadcast_to(identity, across.shape)
    a_squared = dot(a, a)[..., None, None]
    return one + 2 * (s * across + outer - a_squared * one) / square


def _cosine_and_sine_ratio(square: jax.Array) -> tuple[jax.Array, jax.Array]:
    """`cos(a)` and `sin(a) / a` of `square` a^2, by their series near 0: all
    derivatives exist.
    """
    small = square < _SERIES
    a = jnp.sqrt(jnp.where(small, 1.0, square))
    x = jnp.where(small, square, 0.0)
    cosine = 1 - x / 2 * (1 - x / 12 * (1 - x / 30 * (1 - x / 56 * (1 - x / 90))))
    ratio = 1 - x / 6 * (1 - x / 20 * (1 - x / 42 * (1 - x / 72 * (1 - x / 110))))
    sine_ratio = jnp.where(small, ratio, jnp.sin(a) / a)
    return jnp.where(small, cosine, jnp.cos(a)), sine_ratio


@full_precision
def cross(a: jax.Array, b: jax.Array) -> jax.Array:
    """Vector products `a x b` (.., 3), in fewer operations to compile than
    `jnp.cross`.
    """
    table = _CROSS.astype(b.dtype)
    matrix = jnp.tensordot(b, table, (-1, 2))
    return jnp.sum(a[..., None, :] * matrix, axis=-1)


def tangents_of(normal: jax.Array) -> jax.Array:
    """Unit tangents (m, d - 1, d) of unit normals n (m, d).

    Equation: in the plane `t = (n_y, -n_x)`; in space t_1 is the direction of
    `a - (a . n) n` with a fixed a, `t_2 = n x t_1`.
    """
    if normal.shape[1] == 2:
        x, y = normal.T
        return jnp.stack([y, -x], axis=1)[:, None]
    aside = jnp.asarray(_ASIDE, normal.dtype)[None]
    along = dot(aside, normal)[:, None] * normal
    _, first = lengths(aside - along)
    return jnp.stack([first, cross(normal, first)], axis=1)


def times(matrices: jax.Array, vectors: jax.Array) -> jax.Array:
    """Matrices (.., d, d) times vectors (.., d)."""
    terms = matrices * vectors[..., None, :]
    return jnp.sum(terms, axis=-1)


@jax.jit  # operation by operation JAX would compile thirty programs
def _lowered(body: RigidBody, turn: jax.Array) -> jax.Array:
    """q of a body with the angle (1,) or quaternion (4,) `turn`, whose least gap to its
    plane is 0.

    Equation: `x = -min f n`, f the gaps with the centre of mass at the origin.
    """
    d = body.dimension
    q = jnp.concatenate([jnp.zeros(d, turn.dtype), turn])
    normal = body.planes[0, :d].astype(q.dtype)
    return q.at[:d].set(-jnp.min(body.gap_function(q)) * normal)


def unit_quaternion(quaternion: Any, name: str = "quaternion") -> jax.Array:
    """Argument `name` as a quaternion (4,), scalar first; raise a ValueError unless of
    length 1.
    """
    e = as_numbers(name, quaternion, (4,), "a quaternion, scalar first")
    if not is_traced(e) and abs(float(np.linalg.norm(e)) - 1) > UNIT_WITHIN:
        raise ValueError(
            f"Argument `{name}` must have length 1, but has length "
            f"{np.linalg.norm(e):g}: divide by it."
        )
    return e
