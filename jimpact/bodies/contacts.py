"""Bodies on planes and on each other: gaps, normals and tangents from the points that touch."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import as_float_array, check_shape
from jimpact.bodies.base import (
    PLANAR,
    Body,
    LinearPotential,
    dot,
    floors_of,
    lengths,
    numbered,
)
from jimpact.compiling import full_precision

# Tangents in space begin with the direction nearest to this one. No axis: contacts with a normal
# along it have no first tangent, and normals along axes are frequent.
_ASIDE = (0.7, -0.6, 0.387)

CROSS = np.cross(np.eye(3)[:, None], np.eye(3)[None]).transpose(2, 0, 1)  # of j and k, by i


class ContactPoints(NamedTuple):
    """Of m contacts: gap [m], where it is [m], and the unit normal from body 2 to body 1."""

    gap: jax.Array  # (m,)
    point: jax.Array  # (m, 2 or 3)
    normal: jax.Array  # (m, 2 or 3)


class Assembly(Body):
    """Rigid bodies on planes and on each other, in the plane or in space.

    Equation: at a contact of bodies i and j in the point x, along a direction t,
    `v_t = t . (x_i' + omega_i x (x - x_i)) - t . (x_j' + omega_j x (x - x_j))`, in the plane
    tangents are the normal turned to the right, in space two at right angles. An assembly gives
    `count`, `contacts(q)` and `between`.
    """

    planes: eqx.AbstractVar[jax.Array]  # (w, d + 1) unit normal, distance
    between: eqx.AbstractVar[
        Any
    ]  # bodies (i, j) of each contact, j of a plane is -1; one row: of all

    @property
    def dimension(self) -> int:
        """d = 2 or 3."""
        return self.planes.shape[1] - 1

    @property
    def count(self) -> int:
        """Number of bodies that move."""
        raise NotImplementedError(f"{type(self).__name__} must define `count`.")

    @property
    def turns(self) -> int:
        """Angular velocities of a body: 1 in the plane, 3 in space."""
        return 2 * self.dimension - 3

    def contacts(self, q: jax.Array) -> ContactPoints:
        """Gaps, points and normals at q; `between` says of which bodies."""
        raise NotImplementedError(f"{type(self).__name__} must define `contacts`.")

    def of_bodies(self, q: jax.Array) -> jax.Array:
        """Coordinates or velocities (b, ..) of each body."""
        return q.reshape(self.count, -1)

    @full_precision
    def gap_function(self, q: jax.Array) -> jax.Array:
        """Gaps f(q) (m,) [m]."""
        return self.contacts(q).gap

    @full_precision
    def gaps_and_normals(self, q: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Gaps (m,) and N (n, m)."""
        gap, point, normal = self.contacts(q)
        return gap, self._of_all(q, point, normal[:, None])

    @full_precision
    def tangents(self, q: jax.Array) -> jax.Array:
        """H_t (n, m), in space (n, 2 m): how fast body i slides along body j."""
        _, point, normal = self.contacts(q)
        return self._of_all(q, point, self.ways(normal))

    def directions(
        self, q: jax.Array, point: jax.Array, ways: jax.Array, i: Any, j: Any
    ) -> jax.Array:
        """(m, k, 2, velocities of a body): of bodies i, less those of j, along ways (m, k, d)."""
        sides = self._speeds(q, point, ways, i), -self._speeds(q, point, ways, j)
        return jnp.stack(sides, axis=2)

    def _speeds(self, q: jax.Array, point: jax.Array, ways: jax.Array, body: Any) -> jax.Array:
        """(m, k, velocities of a body): of points (m, d) of these bodies along ways (m, k, d)."""
        lever = (point - self.of_bodies(q)[body, : self.dimension])[:, None]
        return jnp.concatenate([ways, self.in_axes(q, body, _around(lever, ways))], axis=2)

    def ways(self, normal: jax.Array) -> jax.Array:
        """Unit tangents (m, d - 1, d) of normals (m, d)."""
        return tangents_of(normal)

    def in_axes(self, q: jax.Array, body: Any, around: jax.Array) -> jax.Array:
        """Vectors (m, k, turns) in the axes in which the angular velocities of these bodies are."""
        return around

    def _of_all(self, q: jax.Array, point: jax.Array, ways: jax.Array) -> jax.Array:
        """(n, m k): velocities along ways (m, k, d) of all bodies."""
        velocities = self.dimension + self.turns
        rows = jnp.zeros((*ways.shape[:2], self.count, velocities), q.dtype)
        between = np.broadcast_to(np.array(self.between, np.int32), (len(ways), 2))
        for sign, body in zip((1.0, -1.0), between.T):
            if (body >= 0).any():  # a plane does not move
                own = jnp.asarray(body)[:, None] == np.arange(self.count, dtype=np.int32)[None]
                speeds = sign * self._speeds(q, point, ways, body)[:, :, None]
                rows = rows + jnp.where(own[:, None, :, None], speeds, 0.0)
        return rows.reshape(-1, self.count * velocities).T

    @property
    def base_directions(self) -> jax.Array:
        """All planes move along each axis (n, d)."""
        d = self.dimension
        return jnp.tile(jnp.eye(d + self.turns, d, dtype=self.mass.dtype), (self.count, 1))

    def gravity(self, acceleration: Any) -> LinearPotential:
        """`V = g sum m_i h_i`, h the last place: y in the plane, z in space."""
        return LinearPotential(self.mass * self.base_directions[:, -1] * acceleration)

    def at(self, centres: Any) -> jax.Array:
        """q (n,) with the bodies, not turned, at these centres (b, d) [m]."""
        places = as_float_array("centres", centres)
        check_shape("centres", places, (self.count, self.dimension), "one for each body")
        return jnp.pad(places, ((0, 0), (0, self.turns))).reshape(-1)

    @property
    def names(self) -> tuple[str, ...]:
        """x, y, angle of each body."""
        return numbered(PLANAR, self.count)

    @property
    def floors(self) -> list[tuple[float, float]]:
        """The planes."""
        return floors_of(self.planes)


def tangents_of(normal: jax.Array) -> jax.Array:
    """Unit tangents (m, d - 1, d): to the right of normals (m, d), in space two."""
    if normal.shape[1] == 2:
        return jnp.stack([normal[:, 1], -normal[:, 0]], axis=1)[:, None]
    aside = jnp.asarray(_ASIDE, normal.dtype)[None]
    _, first = lengths(aside - dot(aside, normal)[:, None] * normal)
    return jnp.stack([first, cross(normal, first)], axis=1)


def _around(lever: jax.Array, ways: jax.Array) -> jax.Array:
    """`lever x way` (m, k, turns) of levers (m, 1, d) and ways (m, k, d)."""
    if ways.shape[2] == 2:
        return (lever[..., 0] * ways[..., 1] - lever[..., 1] * ways[..., 0])[..., None]
    return cross(lever, ways)


def on_planes(planes: jax.Array, points: jax.Array, rim: jax.Array) -> ContactPoints:
    """Contacts (w p,) of spheres of radius `rim` (p,) about points (p, d) with all planes.

    Equation: `f = n . x - r - c`, at the point of the sphere that is nearest to the plane.
    """
    d = points.shape[1]
    n = jnp.broadcast_to(planes[:, None, :d], (len(planes), *points.shape))
    gap = jnp.sum(n * points[None], axis=2) - planes[:, d:] - rim[None]
    point = points[None] - rim[None, :, None] * n
    return ContactPoints(gap.reshape(-1), point.reshape(-1, d), n.reshape(-1, d))


def round_on_round(a: jax.Array, b: jax.Array, r: jax.Array, s: jax.Array) -> ContactPoints:
    """Contacts (g,) of discs or spheres about a, b (g, d) of radii r, s (g,).

    Forces act in the middle of the gap or overlap, one point of both bodies: only so do they keep
    the angular momentum.
    """
    length, n = lengths(a - b)
    gap = length - r - s
    return ContactPoints(gap, b + (s + 0.5 * gap)[:, None] * n, n)


def joined(parts: Sequence[ContactPoints]) -> ContactPoints:
    """The contacts of all parts."""
    return ContactPoints(*(jnp.concatenate(rows) for rows in zip(*parts)))


def placed(points: jax.Array, at: jax.Array) -> jax.Array:
    """Points (p, 2) of bodies at (p or 1, 3)."""
    c, s = jnp.cos(at[:, 2]), jnp.sin(at[:, 2])
    x, y = points.T
    return at[:, :2] + jnp.stack([c * x - s * y, s * x + c * y], axis=1)


@full_precision
def cross(a: jax.Array, b: jax.Array) -> jax.Array:
    """Vector products (.., 3), in fewer operations to compile than `jnp.cross`."""
    return jnp.sum(a[..., None, :] * jnp.tensordot(b, CROSS.astype(b.dtype), (-1, 2)), axis=-1)
