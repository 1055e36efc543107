"""Piles in the plane of many discs and convex polygons between straight walls."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import check_concrete
from jimpact.bodies.assemblies import (
    FacingSides,
    facing_now,
    facing_sides,
    from_polygon,
    placed,
    side_of,
)
from jimpact.bodies.base import (
    BLOCK,
    ContactPoints,
    OnGround,
    block,
    lengths,
    over_blocks,
    turned,
    wheel,
    with_block,
)
from jimpact.bodies.piles import InPlane, chosen_rows
from jimpact.bodies.polygons import Cornered
from jimpact.compiling import full_precision

_SLOTS = 2  # contacts of a pair: at both ends of the sides that face each other
# Contacts, and pairs whose circles around them meet, of each body by default. Ten times more takes
# ten times the memory.
_ROOM, _NEAR = 6, 8


class PlanarPile(InPlane):
    """Many discs and convex polygons in a plane between walls; q = (x, y, theta) of each.

    Equation: as of `PlanarBodies`. Two discs have `f = |x_1 - x_2| - r_1 - r_2`, a disc and a
    polygon `f = dist(x_1, polygon) - r_1`, two polygons the two contacts at the ends of the sides
    that face each other; a corner and a wall `f = n . x - d`. As a `Scene` it has two contacts for
    every pair (with a disc the second one is always open), then body by body and wall by wall those
    of the corners. `simulate(method="time_stepping")` finds closed contacts by a grid and takes no
    others.

    Source: Ericson, Real-Time Collision Detection (2005), ch. 5 and 7.

    >>> import jimpact as ji
    >>> pile = ji.Bodies([ji.Block(0.2, 0.1), ji.Disc(0.1)], room=8)
    >>> pile.touching([0.0, 0.05, 0.0, 0.0, 0.2, 0.0], below=1e-6).contacts
    3
    """

    # (k, K, 2) from the centre of mass, counter-clockwise, the last one repeated
    corners: jax.Array
    rims: jax.Array  # (k,) of discs, 0 of polygons
    inner: jax.Array  # (k,) radius of a disc about the centre of mass within the body

    def __init__(self, bodies: Sequence[OnGround], planes: Any = None, room: int | None = None):
        check_concrete("bodies", list(bodies))
        rings = [
            np.asarray(x.corners)[np.array(x.ring)] if isinstance(x, Cornered) else x.points
            for x in bodies
        ]
        most = max(map(len, rings))
        padded = [np.pad(ring, ((0, most - len(ring)), (0, 0)), mode="edge") for ring in rings]
        self.corners = jnp.asarray(np.stack(padded))
        self.rims = jnp.asarray(np.array([body.rim for body in bodies], self.corners.dtype))
        far = np.linalg.norm(np.stack(padded), axis=2)
        self.radii = jnp.asarray(far.max(axis=1)) + self.rims
        inner = [
            float(body.inner_radius()) if isinstance(body, Cornered) else float(body.rim) - r[0]
            for body, r in zip(bodies, far)
        ]
        self.inner = jnp.asarray(np.array(inner, self.corners.dtype))
        mass = np.stack([body.mass for body in bodies])
        self.masses, self.turning = jnp.asarray(mass[:, 0]), jnp.asarray(mass[:, 2])
        self._have_planes(planes, room, _ROOM)

    @property
    def _least(self) -> jax.Array:
        """The least radius () of a disc within a body."""
        return jnp.min(self.inner)

    @property
    def _stride(self) -> int:
        """Partners of a body: the others, and each wall once for each corner."""
        return self.count + len(self.planes) * self.corners.shape[1]

    @property
    def pair_count(self) -> int:
        """Two contacts of every pair (i, j), and every corner with every wall."""
        return _SLOTS * self.count * self._stride

    # ---- contacts

    def _placed(self, q: jax.Array, which: Any) -> jax.Array:
        """Corners (g, K, 2) of these bodies at q."""
        return jax.vmap(lambda corners, at: placed(corners, at[None]))(
            self.corners[which], self._of_bodies(q)[which]
        )

    def _pairs(self, q: jax.Array, i: Any, j: Any) -> ContactPoints:
        """Two contacts of each pair: gaps (g, 2), points (g, 2, 2), normals from j to i."""
        a, b = self._placed(q, i), self._placed(q, j)
        side_a, side_b, _ = jax.vmap(facing_now)(a, b)
        ends = [jax.vmap(side_of)(x, side) for x, side in ((a, side_a), (b, side_b))]
        flat = facing_sides(FacingSides(ends[0], ends[1], jnp.zeros(len(a), bool)))
        of_sides = [x.reshape(len(a), _SLOTS, *x.shape[1:]) for x in flat]
        first, second = self.rims[i] > 0, self.rims[j] > 0
        both, swap = first & second, first[:, None, None]
        disc, polygon = jnp.where(swap, a[:, :1], b[:, :1]), jnp.where(swap, b, a)
        away, n = (x[:, 0] for x in jax.vmap(from_polygon)(disc, polygon))
        on_polygon = disc[:, 0] - away[:, None] * n
        length, apart = lengths(a[:, 0] - b[:, 0])
        n = jnp.where(both[:, None], apart, jnp.where(first[:, None], n, -n))
        gap = jnp.where(both, length, away) - self.rims[i] - self.rims[j]
        between = b[:, 0] + (self.rims[j] + 0.5 * gap)[:, None] * n
        point = jnp.where(both[:, None], between, on_polygon)
        with_disc = first | second
        of_disc = (
            jnp.stack([gap, jnp.full_like(gap, jnp.inf)], axis=1),
            jnp.stack([point, point], axis=1),
            jnp.stack([n, n], axis=1),
        )
        chosen = [
            jnp.where(with_disc.reshape(-1, *[1] * (x.ndim - 1)), x, y)
            for x, y in zip(of_disc, of_sides)
        ]
        return ContactPoints(*chosen)

    @full_precision
    def _wall_gaps(self, q: jax.Array) -> jax.Array:
        """Gaps (k, w, K) of all corners; infinite of those that only fill a row."""
        x = self._placed(q, np.arange(self.count))
        n, offset = self.planes[:, :2], self.planes[:, 2]
        height = jnp.einsum("kcx,wx->kwc", x, n) - offset[None, :, None] - self.rims[:, None, None]
        again = jnp.all(self.corners[:, 1:] == self.corners[:, :-1], axis=2)
        again = jnp.pad(again, ((0, 0), (1, 0)))
        return jnp.where(again[:, None], jnp.inf, height)

    def gap_function(self, q: jax.Array) -> jax.Array:
        """Gaps of all pairs, two each, then those with walls."""
        pairs = self._pairs(q, *np.triu_indices(self.count, 1)).gap
        return jnp.concatenate([pairs.reshape(-1), self._wall_gaps(q).reshape(-1)])

    def gaps_and_normals(self, q: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Gaps (m,) and N (n, m)."""
        return self.gap_function(q), self._all_directions(q, slice(0, 1))

    def tangents(self, q: jax.Array) -> jax.Array:
        """H_t (n, m): how fast body i slides along body j, to the left of the normal."""
        return self._all_directions(q, slice(1, 2))

    def _all_directions(self, q: jax.Array, which: slice) -> jax.Array:
        """(n, m) of all contacts."""
        i, j = np.triu_indices(self.count, 1)
        pairs = np.repeat((i * self._stride + j) * _SLOTS, _SLOTS) + np.tile([0, 1], len(i))
        number = np.concatenate([pairs, self._numbers_at_walls()]).astype(np.int32)
        i, j = np.divmod(number // _SLOTS, self._stride)
        return self._dense(self._of_contacts(q, jnp.asarray(number))[2][:, which], i, j)

    def _numbers_at_walls(self) -> np.ndarray:
        """Of all contacts with walls (k w K,)."""
        partner = np.arange(self.count, self._stride, dtype=np.int32)
        body = np.arange(self.count, dtype=np.int32)[:, None]
        return (_SLOTS * (body * self._stride + partner)).reshape(-1)

    def _near_rows(
        self, q: jax.Array, later: jax.Array, below: jax.Array
    ) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        """Bodies i and j (P,) whose circles are up to `below` apart, how many, and if some miss."""
        near = self._near(q, later, below)
        circles = [self._pair_gaps(x, near.first, near.second) for x in (q, later)]
        so_far = jnp.cumsum(near.used & (jnp.minimum(*circles) <= below), dtype=jnp.int32)
        rows = -(-_NEAR * self.count // BLOCK) * BLOCK
        count = jnp.minimum(so_far[-1], rows)

        def one(first: jax.Array, filled: Any) -> Any:
            """The next pairs."""
            used, place = chosen_rows(so_far, first, count)
            new = (jnp.where(used, x[place], 0) for x in (near.first, near.second))
            return tuple(with_block(x, part, first) for x, part in zip(filled, new))

        i, j = over_blocks(count, one, (jnp.zeros(rows, jnp.int32), jnp.zeros(rows, jnp.int32)))
        return i, j, count, near.overflows | (so_far[-1] > rows)

    def _gaps_of_rows(self, at: list[jax.Array], i: Any, j: Any, count: jax.Array) -> jax.Array:
        """The least gaps (P, 2), at these q, of the first `count` pairs; infinite of the others."""
        every = jnp.stack(at)

        def one(first: jax.Array, gaps: jax.Array) -> jax.Array:
            """Those of the next pairs."""
            row = first + np.arange(BLOCK, dtype=np.int32)
            pairs = block(i, first), block(j, first)
            new = jnp.min(jax.vmap(lambda q: self._pairs(q, *pairs).gap)(every), axis=0)
            return with_block(gaps, jnp.where((row < count)[:, None], new, jnp.inf), first)

        return over_blocks(count, one, jnp.full((i.size, _SLOTS), jnp.inf, every.dtype))

    def _gaps_between(self, q: jax.Array, i: jax.Array, j: jax.Array) -> jax.Array:
        """Gaps (g,) of bodies i and j."""
        return jnp.min(self._pairs(q, i, j).gap, axis=1)

    def _least_of_near(self, q: jax.Array, margin: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The least gap () of pairs with gaps up to `margin`; whether some are missing."""
        i, j, count, overflows = self._near_rows(q, q, margin)
        return jnp.min(self._gaps_of_rows([q], i, j, count)), overflows

    def _closed(
        self, q: jax.Array, later: jax.Array, below: jax.Array
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Numbers of contacts (C,), which of them are closed, and whether some are missing."""
        i, j, count, overflows = self._near_rows(q, later, below)
        gaps = self._gaps_of_rows([q, later], i, j, count)
        to_walls = jnp.minimum(self._wall_gaps(q), self._wall_gaps(later)).reshape(-1)
        slot = np.arange(_SLOTS, dtype=np.int32)[None]
        number = _SLOTS * (i * self._stride + j)[:, None] + slot
        numbers = jnp.concatenate([number.reshape(-1), self._numbers_at_walls()])
        return numbers, jnp.concatenate([gaps.reshape(-1), to_walls]) <= below, overflows

    def _of_contacts(
        self, q: jax.Array, number: jax.Array
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Bodies i and j (K,) of contacts of these numbers, j = `count` for walls; directions."""
        pair, slot = jnp.divmod(number, jnp.int32(_SLOTS))
        i, partner = jnp.divmod(pair, jnp.int32(self._stride))
        other, row = jnp.minimum(partner, self.count - 1), np.arange(len(number))
        _, points, normals = self._pairs(q, i, other)
        point, normal = points[row, slot], normals[row, slot]
        if len(self.planes):
            at_wall = partner >= self.count
            wall, corner = jnp.divmod(
                jnp.maximum(partner - self.count, 0), jnp.int32(self.corners.shape[1])
            )
            n, x = self.planes[wall, :2], self._placed(q, i)[row, corner]
            on_wall = x - (jnp.sum(n * x, axis=1) - self.planes[wall, 2])[:, None] * n
            point = jnp.where(at_wall[:, None], on_wall, point)
            normal = jnp.where(at_wall[:, None], n, normal)
        ways = jnp.stack([normal, jnp.stack([-normal[:, 1], normal[:, 0]], axis=1)], axis=1)
        sides = []
        for sign, body in ((1.0, i), (-1.0, other)):
            lever = (point - self._of_bodies(q)[body, :2])[:, None]
            turn = lever[..., 0] * ways[..., 1] - lever[..., 1] * ways[..., 0]
            sides.append(sign * jnp.concatenate([ways, turn[..., None]], axis=2))
        return i, jnp.minimum(partner, self.count), jnp.stack(sides, axis=2)

    def outlines(self, q: np.ndarray, point: float) -> list[np.ndarray]:
        """Polygons, and circles with the radius that shows how far they have turned."""
        corners, rims = np.asarray(self.corners), np.asarray(self.rims)
        return [
            wheel(rim, at, own[0]) if rim > 0 else turned(np.concatenate([own, own[:1]]), at)
            for own, rim, at in zip(corners, rims, np.reshape(q, (-1, 3)))
        ]
