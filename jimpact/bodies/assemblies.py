"""Several planar bodies: on planes of any slope, and on each other."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import as_float_array, check_shape, check_values, is_traced
from jimpact.bodies.base import (
    PLANAR,
    Body,
    ContactPoints,
    LinearPotential,
    OnGround,
    as_planes,
    dot,
    floors_of,
    lengths,
    moving,
    number,
    numbered,
    planar_directions,
    planar_weight,
)
from jimpact.bodies.polygons import Cornered, Disc
from jimpact.compiling import full_precision

# [rad] Direction between two polygons, of which one has an odd number of sides, at which their two
# contacts change places, see `_all_sides`: none of the usual slopes.
_CUT = 2.0
# 1 - cos of the angle to that direction, within which they must not touch: .8 degrees. Ten times
# less, and steps of a motion may pass over it.
_NEAR_CUT = 1e-4
_TOUCHING = 1e-6  # [m] gap from which they may pass it; ten times more would do
_PARALLEL = 1e-9  # [m] more than rounding: between parallel sides it does not decide


class PlanarBodies(Body):
    """Planar bodies on planes and on each other; q = (x, y, theta) of each centre of mass.

    Equation: on a plane with normal n = (-sin a, cos a), at offset d from the origin, each contact
    point of a body has `f = n . (x + R c_i) - r - d`. Two discs have `f = |x_1 - x_2| - r_1 - r_2`,
    a disc and a polygon `f = dist(x_1, polygon) - r_1`. Two polygons have the two contacts of two
    sides that face each other: at each end of the first side, the distance of its corner from the
    second side, or, where it overhangs, that of the second side's end from the first side, or, in
    between, that of the two corners; the least of both is the distance of the polygons. Normals are
    unit vectors n from the second body to the first, tangents (n_y, -n_x); both as rates of q.

    Contacts, in order: for each plane and body, its contact points; then the pairs of discs; discs
    on polygons, polygon by polygon; polygons, two contacts a pair, pairs with fixed sides first.
    `between` names their bodies.

    Polygons choose their sides as they move, so that they may roll over their corners, slide off
    each other and meet again anywhere. Of two in touch, one with an odd number of sides, one with
    an even number, the normal from the first to the second must not pass 2 rad (`valid`). Where
    sides are fixed, by `at` or by their numbers, the gap functions hold (`valid`, [m]) while both
    overlap or the line of one of them keeps them apart, turned by less than 90 degrees against each
    other, with no other corner of the first body beyond the second side. Those of discs hold while
    their centres are outside the other body. Bodies that are no pair do not feel each other.

    Args:
        bodies: `Polygon`, `Block`, `Disc`; `Dimer` on planes only.
        planes: as of `as_planes`; angle 0: the ground, pi/2: a wall on the right.
        pairs: (i, j) of bodies, counted from 0, in contact with each other; None: all. Two
            polygons may be given as ((i, side), (j, side)), sides counted counter-clockwise: of a
            `Block` 0 is the base, of a `Polygon` it begins at the first corner.
        at: q (3 b,) at which the sides of two polygons are chosen that face each other, and which
            is the first body, once and for all; None: as they move.

    Raises:
        ValueError: no bodies or contacts, planes that are not finite, pairs that do not exist or
            without a gap function.

    Source: Ericson, Real-Time Collision Detection (2005), ch. 5 and 7 (distances, separating axes).

    >>> import jimpact as ji
    >>> slope = ji.Bodies([ji.Block(0.2, 0.1)], planes=[0.3])
    >>> slope.scene(slope.touching()).closed.tolist()
    [True, True, False, False]
    >>> q = [0.0, 0.5, 0.0, 0.3, 1.5, 0.0]
    >>> stack = ji.Bodies([ji.Block(1.0, 1.0), ji.Block(1.0, 1.0)])
    >>> stack.scene(q).gaps[-2:].tolist()
    [0.0, 0.0]
    """

    range_in_words = "see `PlanarBodies`: no centre in a body, fixed sides face each other"

    bodies: tuple[OnGround, ...]
    planes: jax.Array  # (k, 3) unit normal, distance
    between: tuple[tuple[int, int], ...] = eqx.field(static=True)  # bodies of contacts; plane: -1
    pairs: "_Pairs" = eqx.field(static=True)

    def __init__(
        self,
        bodies: Sequence[OnGround],
        planes: Any = None,
        pairs: Sequence[Any] | None = None,
        at: Any = None,
    ):
        self.bodies = tuple(bodies)
        for body in self.bodies:
            if not isinstance(body, OnGround):
                raise TypeError(
                    f"Argument `bodies` must hold planar bodies, but holds a {type(body).__name__}."
                )
        self.planes = as_planes(planes, 2)
        counts = [body.points.shape[0] for body in self.bodies]
        on_each = [(b, -1) for b, count in enumerate(counts) for _ in range(count)]
        self.pairs = _sorted_pairs(self.bodies, pairs, at)
        self.between = (*on_each * len(self.planes), *self.pairs.between)
        if not self.between:
            raise ValueError("Arguments `bodies`, `planes` and `pairs` must give a contact.")

    @property
    def mass(self) -> jax.Array:
        """M, its diagonal (3 b,)."""
        return jnp.concatenate([body.mass for body in self.bodies])

    @property
    def base_directions(self) -> jax.Array:
        """All planes move in x and y (3 b, 2)."""
        return planar_directions(self.mass)

    def gravity(self, acceleration: Any) -> LinearPotential:
        """`V = g sum m_i y_i`."""
        return planar_weight(self.mass, acceleration)

    @full_precision
    def contacts(self, q: jax.Array) -> ContactPoints:
        """Gaps, points and normals at q (3 b,); `between` says of which bodies."""
        places, parts = self._places(q), []
        if self.planes.shape[0]:
            parts.append(self._on_planes(places))
        if self.pairs.discs:
            parts.append(_discs(places, np.array(self.pairs.discs)))
        for polygon, discs in self.pairs.rolling:
            parts.append(_disc_on_polygon(places, np.array(discs), polygon))
        if self.pairs.sides or self.pairs.polygons:
            parts.append(facing_sides(_all_sides(places, self.pairs)))
        return ContactPoints(*(jnp.concatenate(rows) for rows in zip(*parts)))

    def gap_function(self, q: jax.Array) -> jax.Array:
        """Gaps f(q) (m,) [m]."""
        return self.contacts(q).gap

    def gaps_and_normals(self, q: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Gaps (m,) and N (n, m)."""
        contacts = self.contacts(q)
        return contacts.gap, self._along(q, contacts.point, contacts.normal)

    def tangents(self, q: jax.Array) -> jax.Array:
        """H_t (3 b, m): how fast body 1 slides along body 2, to the right of the normal."""
        contacts = self.contacts(q)
        right = jnp.stack([contacts.normal[:, 1], -contacts.normal[:, 0]], axis=1)
        return self._along(q, contacts.point, right)

    def _along(self, q: jax.Array, point: jax.Array, way: jax.Array) -> jax.Array:
        """(3 b, m): speeds along directions (m, 2) of body 1 from body 2 at points (m, 2)."""
        lever = point[:, None] - q.reshape(-1, 3)[None, :, :2]
        turn = lever[..., 0] * way[:, 1:] - lever[..., 1] * way[:, :1]
        still = jnp.broadcast_to(way[:, None], lever.shape)
        rows = jnp.concatenate([still, turn[..., None]], axis=2)
        moves = moving(self.between, len(self.bodies))[..., None]
        return (jnp.asarray(moves, q.dtype) * rows).reshape(len(moves), -1).T

    @full_precision
    def valid(self, q: jax.Array) -> jax.Array:
        """The least of the margins () [m], see the class."""
        places, margins = self._places(q), [super().valid(q)[None]]
        if self.pairs.discs:
            i, j = np.array(self.pairs.discs).T
            margins.append(lengths(places.middle[i] - places.middle[j])[0])
        for polygon, discs in self.pairs.rolling:
            contacts = _disc_on_polygon(places, np.array(discs), polygon)
            margins.append(contacts.gap + places.rim[np.array(discs)])
        margins += [_overlap(places, *pair)[None] for pair in self.pairs.sides]
        margins += [_off_cut(places, *pair)[None] for pair in self.pairs.polygons]
        return jnp.min(jnp.concatenate(margins))

    def touching(
        self, angle: Any = 0.0, along: Any = 0.0, body: int = 0, plane: int = 0
    ) -> jax.Array:
        """(x, y, theta) of one body on one plane, turned by `angle` from it, `along` it [m]."""
        turn, distance = number("angle", angle), number("along", along)
        (n_x, n_y, offset), (x, y, _) = self.planes[plane], self.bodies[body].touching(turn)
        right, up = x + distance, y + offset
        place = [n_y * right + n_x * up, n_y * up - n_x * right, turn + jnp.arctan2(-n_x, n_y)]
        return jnp.stack(place)

    def at(self, centres: Any) -> jax.Array:
        """q (3 b,) with the bodies, not turned, at these centres (b, 2) [m]."""
        places = as_float_array("centres", centres)
        check_shape("centres", places, (len(self.bodies), 2), "one for each body")
        return jnp.pad(places, ((0, 0), (0, 1))).reshape(-1)

    def outlines(self, q: np.ndarray, point: float) -> list[np.ndarray]:
        """Those of all bodies."""
        each = zip(self.bodies, np.reshape(q, (-1, 3)))
        return [curve for body, x in each for curve in body.outlines(x, point)]

    @property
    def names(self) -> tuple[str, ...]:
        """x, y, angle of each body."""
        return numbered(PLANAR, len(self.bodies))

    @property
    def floors(self) -> list[Any]:
        """The planes."""
        return floors_of(self.planes)

    def _places(self, q: jax.Array) -> "_Places":
        """Contact points and corners at q (3 b,)."""
        at = q.reshape(-1, 3)
        counts = np.array([body.points.shape[0] for body in self.bodies])
        owner = np.repeat(np.arange(len(counts)), counts)
        points = placed(jnp.concatenate([body.points for body in self.bodies]), at[owner])
        rim = jnp.stack([jnp.asarray(body.rim, q.dtype) for body in self.bodies])
        polygons = {
            b: placed(body.corners[np.array(body.ring)], at[b][None])
            for b, body in enumerate(self.bodies)
            if isinstance(body, Cornered)
        }
        return _Places(at[:, 2], owner, points, points[np.cumsum(counts) - counts], rim, polygons)

    def _on_planes(self, places: "_Places") -> ContactPoints:
        """Contacts of all points with all planes."""
        n, offset = self.planes[:, None, :2], self.planes[:, 2]
        height = jnp.sum(n * places.points[None], axis=2) - offset[:, None]
        point = places.points[None] - height[..., None] * n
        gap, normal = height - places.rim[places.owner][None], jnp.broadcast_to(n, point.shape)
        return ContactPoints(gap.reshape(-1), point.reshape(-1, 2), normal.reshape(-1, 2))


Side = tuple[int, int]  # of which body, and which


class _Pairs(NamedTuple):
    """Pairs by what they are."""

    discs: tuple[tuple[int, int], ...]
    rolling: tuple[tuple[int, tuple[int, ...]], ...]  # a polygon and its discs
    sides: tuple[tuple[Side, Side], ...]  # of polygons in contact there only
    polygons: tuple[tuple[int, int], ...]  # in contact anywhere

    @property
    def between(self) -> list[tuple[int, int]]:
        """Bodies of each contact."""
        discs = [*self.discs, *((i, polygon) for polygon, some in self.rolling for i in some)]
        polygons = [(first[0], second[0]) for first, second in self.sides] + list(self.polygons)
        return discs + [pair for pair in polygons for _ in (0, 1)]


class _Places(NamedTuple):
    """Bodies where they are."""

    angle: jax.Array  # (b,)
    owner: np.ndarray  # (p,) body of each contact point
    points: jax.Array  # (p, 2)
    middle: jax.Array  # (b, 2) first contact point: the middle of a disc
    rim: jax.Array  # (b,)
    polygons: dict[int, jax.Array]  # corners (k, 2), counter-clockwise


def placed(points: jax.Array, at: jax.Array) -> jax.Array:
    """Points (p, 2) of bodies at (p or 1, 3)."""
    c, s = jnp.cos(at[:, 2]), jnp.sin(at[:, 2])
    x, y = points.T
    return at[:, :2] + jnp.stack([c * x - s * y, s * x + c * y], axis=1)


def _outward(side: jax.Array) -> jax.Array:
    """Unit normals (.., 2) of counter-clockwise sides (.., 2); 0 of one without length."""
    square = dot(side, side)[..., None]
    turned = jnp.stack([side[..., 1], -side[..., 0]], axis=-1)
    return turned / jnp.sqrt(jnp.where(square > 0, square, 1.0))


def _discs(places: _Places, pairs: np.ndarray) -> ContactPoints:
    """One contact for each pair (g, 2) of discs."""
    i, j = pairs.T
    length, n = lengths(places.middle[i] - places.middle[j])
    gap = length - places.rim[i] - places.rim[j]
    return ContactPoints(gap, places.middle[j] + (places.rim[j] + 0.5 * gap)[:, None] * n, n)


def _disc_on_polygon(places: _Places, discs: np.ndarray, polygon: int) -> ContactPoints:
    """Distances of discs from a polygon: from a side, or, beyond its ends, from a corner."""
    middle = places.middle[discs]
    away, n = from_polygon(middle, places.polygons[polygon])
    return ContactPoints(away - places.rim[discs], middle - away[:, None] * n, n)


def from_polygon(middle: jax.Array, begin: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Distances (g,) of points (g, 2) from a polygon of corners (k, 2), and unit vectors from it.

    Sides without length do not count.
    """
    side = jnp.roll(begin, -1, axis=0) - begin
    normals = _outward(side)
    heights = _of_sides(jnp.sum((middle[:, None] - begin[None]) * normals[None], axis=2), normals)
    nearest = jnp.argmax(heights, axis=1)  # outside, its side or one of its ends is the nearest
    a, tangent, n = begin[nearest], side[nearest], normals[nearest]
    share = dot(middle - a, tangent) / dot(tangent, tangent)
    beyond = (share < 0) | (share > 1)
    corner = a + jnp.where(share > 1, 1.0, 0.0)[:, None] * tangent
    length, toward = lengths(middle - corner)
    n = jnp.where(beyond[:, None], toward, n)
    return jnp.where(beyond, length, jnp.max(heights, axis=1)), n


def _of_sides(heights: jax.Array, normals: jax.Array) -> jax.Array:
    """Heights (.., k) over sides of these normals (k, 2), -inf over those without length."""
    return jnp.where(jnp.any(normals != 0, axis=1), heights, -jnp.inf)


class FacingSides(NamedTuple):
    """Sides in contact of pairs of polygons, each from its begin to its end (g, 2)."""

    first: tuple[jax.Array, jax.Array]
    second: tuple[jax.Array, jax.Array]
    swapped: jax.Array  # (g,) whether the contact at the first side's end comes first


def _all_sides(places: _Places, pairs: _Pairs) -> FacingSides:
    """Sides that were chosen at the beginning, then those that face each other now.

    Where a body rolls over a corner, one of the sides gives way to its neighbour, which has the
    corner at its other end. The contact there keeps its place among the two because they are
    swapped where the numbers of both sides have an odd sum. An odd number of sides counts on
    through full turns, of the body and of the direction between the bodies; the latter begin anew
    at `_CUT`.
    """
    rows: list[Any] = [(_side(places, a), _side(places, b), False) for a, b in pairs.sides]
    for pair in pairs.polygons:
        *sides, n = facing_now(*(places.polygons[i] for i in pair))
        number = sides[0] + sides[1]
        for i, side, way in zip(pair, sides, (n, -n)):
            if len(places.polygons[i]) % 2:
                number += _full_turns(places.polygons[i], side, places.angle[i], n, way)
        both = (side_of(places.polygons[i], side) for i, side in zip(pair, sides))
        rows.append((*both, number % 2 == 1))
    first, second, swapped = zip(*rows)

    def ends(sides: tuple[Any, ...]) -> tuple[jax.Array, jax.Array]:
        return jnp.stack([begin for begin, _ in sides]), jnp.stack([end for _, end in sides])

    return FacingSides(ends(first), ends(second), jnp.stack([jnp.asarray(x) for x in swapped]))


def _full_turns(
    corners: jax.Array, side: jax.Array, angle: jax.Array, n: jax.Array, way: jax.Array
) -> jax.Array:
    """How many full turns () a body at this angle has made against the direction to the other.

    `way` is that direction, n or -n; its angle goes on by the one of n, from `_CUT` to there again.
    """
    own = _outward(jnp.roll(corners, -1, axis=0) - corners)
    own = jnp.arctan2(own[:, 1], own[:, 0])
    turned = jnp.arctan2(n[1], n[0])
    turned = _CUT + (turned - _CUT) % (2 * np.pi) + jnp.where(way @ n > 0, 0.0, np.pi)
    first = (own[0] - angle) % (2 * np.pi)
    facing = angle + first + (own[side] - own[0]) % (2 * np.pi)
    return jnp.round((turned - facing) / (2 * np.pi)).astype(side.dtype)


def _off_cut(places: _Places, i: int, j: int) -> jax.Array:
    """Margin () within which the two contacts of polygons i and j keep their places."""
    a, b = places.polygons[i], places.polygons[j]
    if (len(a) + len(b)) % 2 == 0:
        return jnp.ones((), a.dtype)
    _, _, n = facing_now(a, b)
    apart = jnp.min(b @ n) - jnp.max(a @ n)
    off = 1 - n @ jnp.array([np.cos(_CUT), np.sin(_CUT)], n.dtype) - _NEAR_CUT
    return jnp.maximum(off, apart - _TOUCHING)


@full_precision
def facing_now(a: jax.Array, b: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Sides () of two polygons that face each other, and the normal (2,) from a to b.

    The line of one side keeps the polygons apart most. The other polygon's nearest corner to this
    line is an end of its side that is most opposite.
    """
    n_a, n_b = (_outward(jnp.roll(x, -1, axis=0) - x) for x in (a, b))
    beyond_a = _of_sides(jnp.min(jnp.sum((b[:, None] - a[None]) * n_a[None], axis=2), axis=0), n_a)
    beyond_b = _of_sides(jnp.min(jnp.sum((a[:, None] - b[None]) * n_b[None], axis=2), axis=0), n_b)
    side_a, side_b = jnp.argmax(beyond_a), jnp.argmax(beyond_b)
    opposite = n_a @ n_b.T
    by_b = jnp.max(beyond_b) > jnp.max(beyond_a) + _PARALLEL
    side_a = jnp.where(by_b, jnp.argmin(opposite[:, side_b]), side_a)
    side_b = jnp.where(by_b, side_b, jnp.argmin(opposite[side_a]))
    return side_a, side_b, jnp.where(by_b, -n_b[side_b], n_a[side_a])


def facing_sides(sides: FacingSides) -> ContactPoints:
    """Two contacts a pair, at the begin and at the end of the first body's side."""
    (a_begin, a_end), (b_begin, b_end) = sides.first, sides.second
    n_a, n_b = _outward(a_end - a_begin), _outward(b_end - b_begin)

    def at_end(a: jax.Array, other_a: jax.Array, b: jax.Array, other_b: jax.Array) -> ContactPoints:
        """Contacts at the ends a (g, 2) of first sides, which face the ends b of second ones."""
        side = other_a - a
        share = dot(side, b - a) / dot(side, side)
        over = dot(b - other_b, a - b) > 0  # a overhangs: b is under the side, or beyond it
        past = dot(other_b - b, a - other_b) > 0  # the sides do not overlap
        by_side = over & (share >= 0) & (share <= 1)
        by_end = past | (over & ~by_side)
        end = jnp.where((over & (share > 1))[:, None], other_a, a)
        b = jnp.where(past[:, None], other_b, b)
        apart, toward = lengths(end - b)
        gap = jnp.where(by_end, apart, jnp.where(by_side, dot(n_a, b - a), dot(n_b, a - b)))
        n = jnp.where(by_end[:, None], toward, jnp.where(by_side[:, None], -n_a, n_b))
        point = jnp.where(by_end[:, None], 0.5 * (end + b), jnp.where(by_side[:, None], b, a))
        return ContactPoints(gap, point, n)

    both = (at_end(a_begin, a_end, b_end, b_begin), at_end(a_end, a_begin, b_begin, b_end))
    gap, point, n = (jnp.stack(parts, axis=1) for parts in zip(*both))
    swapped = sides.swapped[:, None]
    gap = jnp.where(swapped, gap[:, ::-1], gap)
    point, n = (jnp.where(swapped[..., None], x[:, ::-1], x) for x in (point, n))
    return ContactPoints(gap.reshape(-1), point.reshape(-1, 2), n.reshape(-1, 2))


def _side(places: _Places, side: Side) -> tuple[jax.Array, jax.Array]:
    """Its begin and its end (2,)."""
    return side_of(places.polygons[side[0]], side[1])


def side_of(corners: jax.Array, side: Any) -> tuple[jax.Array, jax.Array]:
    """Begin and end (2,) of a side of a polygon with these corners (k, 2)."""
    return corners[side], corners[(side + 1) % corners.shape[0]]


def _overlap(places: _Places, first: Side, second: Side) -> jax.Array:
    """Margin () [m] of the gaps of two sides, see `PlanarBodies`."""
    (a_begin, a_end), (b_begin, b_end) = _side(places, first), _side(places, second)
    n = _outward(b_end - b_begin)
    tangent = jnp.stack([-n[1], n[0]])  # from begin to end
    corners = places.polygons[first[0]]
    others = [
        c for c in range(corners.shape[0]) if c not in (first[1], (first[1] + 1) % len(corners))
    ]
    beyond = jnp.min((corners[np.array(others)] - b_begin[None]) @ n)
    facing = tangent @ (a_begin - a_end)
    shared = jnp.minimum(tangent @ (a_begin - b_end), 0.0) + tangent @ (b_end - b_begin)
    shared = shared - jnp.maximum(tangent @ (a_end - b_begin), 0.0)
    above = jnp.minimum((a_begin - b_begin) @ n, (a_end - b_begin) @ n)
    n_a = _outward(a_end - a_begin)
    apart = jnp.maximum(above, jnp.minimum((b_begin - a_begin) @ n_a, (b_end - a_begin) @ n_a))
    return jnp.minimum(jnp.minimum(beyond, facing), jnp.maximum(shared, apart))


# ------------------------------------------------------------------------------ construction


def _sorted_pairs(bodies: tuple[OnGround, ...], pairs: Sequence[Any] | None, at: Any) -> _Pairs:
    """Pairs by the shapes of their bodies."""
    if pairs is None:
        shapes = [b for b, body in enumerate(bodies) if isinstance(body, Cornered | Disc)]
        pairs = [(i, j) for i in shapes for j in shapes if i > j]
    discs: list[tuple[int, int]] = []
    rolling: dict[int, list[int]] = {}
    sides: list[tuple[Side, Side]] = []
    polygons: list[tuple[int, int]] = []
    for pair in pairs:
        i, j = (_body_of(x, bodies) for x in pair)
        if i == j:
            raise ValueError(f"Argument `pairs` must join different bodies, but holds {pair!r}.")
        if isinstance(bodies[i], Disc) and isinstance(bodies[j], Disc):
            discs.append((i, j))
        elif isinstance(bodies[i], Disc):
            rolling.setdefault(j, []).append(i)
        elif isinstance(bodies[j], Disc):
            rolling.setdefault(i, []).append(j)
        elif at is None and not all(np.ndim(x) for x in pair):
            polygons.append((i, j))
        else:
            sides.append(_sides_of(pair, i, j, bodies, at))
    grouped = tuple((polygon, tuple(some)) for polygon, some in rolling.items())
    return _Pairs(tuple(discs), grouped, tuple(sides), tuple(polygons))


def _body_of(entry: Any, bodies: tuple[OnGround, ...]) -> int:
    """The body of one half of a pair."""
    body = entry if np.ndim(entry) == 0 else entry[0]
    if not 0 <= body < len(bodies):
        raise ValueError(
            f"Argument `pairs` must hold bodies 0 to {len(bodies) - 1}, but holds {body!r}."
        )
    if not isinstance(bodies[body], Cornered | Disc):
        raise ValueError(
            f"Argument `pairs` must join polygons and discs, but body {body} is a "
            f"{type(bodies[body]).__name__}."
        )
    return int(body)


def _polygon(bodies: tuple[OnGround, ...], which: int) -> Cornered:
    """The body of this number, which has corners."""
    body = bodies[which]
    assert isinstance(body, Cornered)
    return body


def _sides_of(
    pair: Any, i: int, j: int, bodies: tuple[OnGround, ...], at: Any
) -> tuple[Side, Side]:
    """The sides in contact of two polygons: as given, or those that face each other."""
    if all(np.ndim(x) for x in pair):
        for body, side in pair:
            count = len(_polygon(bodies, body).ring)
            if not 0 <= side < count:
                raise ValueError(
                    f"Argument `pairs` must hold sides 0 to {count - 1} of body {body}, but holds "
                    f"{side!r}."
                )
        return (i, int(pair[0][1])), (j, int(pair[1][1]))
    if is_traced((at, bodies)):
        raise ValueError(
            f"Argument `at` must not be traced for the polygons {i} and {j}: leave it out, or give "
            "their sides."
        )
    q = as_float_array("at", at)
    check_shape("at", q, (3 * len(bodies),), "x, y, theta of each body")
    check_values("at", q)

    def shape(which: int) -> tuple[np.ndarray, np.ndarray]:
        """Corners of a body and outward normals of its sides (k, 2)."""
        body = _polygon(bodies, which)
        corners = placed(body.corners[np.array(body.ring)], q.reshape(-1, 3)[which][None])
        return np.asarray(corners), np.asarray(_outward(jnp.roll(corners, -1, axis=0) - corners))

    best = []
    for first, second in ((i, j), (j, i)):
        (a, normals_a), (b, normals_b) = shape(first), shape(second)
        away = np.min(np.sum((a[:, None] - b[None]) * normals_b, axis=2), axis=0)
        widest = int(np.argmax(away))
        facing = int(np.argmin(normals_a @ normals_b[widest]))
        best.append((away[widest], (first, facing), (second, widest)))
    _, first_side, second_side = best[int(best[1][0] > best[0][0] + _PARALLEL)]
    return first_side, second_side
