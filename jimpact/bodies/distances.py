"""Contacts of two bodies: discs, spheres, boxes and convex polygons, pair by pair."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jimpact.bodies.base import dot, lengths
from jimpact.bodies.rigid import ContactPoints

# [m] More than rounding: it decides neither between parallel sides nor whether a point at the end
# of a side is over it.
PARALLEL = 1e-9
# [rad] Direction between two polygons, of which one has an odd number of sides, at which their two
# contacts change places, see `changed_places`: none of the usual slopes.
_CUT = 2.0
# 1 - cos of the angle to that direction, within which they must not touch: .8 degrees. Ten times
# less, and steps of a motion may pass over it.
_NEAR_CUT = 1e-4
_TOUCHING = 1e-6  # [m] gap from which they may pass it; ten times more would do


def round_on_round(a: jax.Array, b: jax.Array, r: jax.Array, s: jax.Array) -> ContactPoints:
    """Contacts (g,) of discs or spheres about a, b (g, d) of radii r, s (g,).

    Forces act in the middle of the gap or overlap, one point of both bodies: only so do they keep
    the angular momentum.
    """
    length, n = lengths(a - b)
    gap = length - r - s
    return ContactPoints(gap, b + (s + 0.5 * gap)[:, None] * n, n)


def from_box(x: jax.Array, half: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Distances (g,) of points (g, 3) from boxes about the origin, and their gradients (g, 3).

    Beyond one face, or inside, it is that from the face; beyond several, that from their edge or
    corner.
    """
    sign = jnp.where(x < 0, -1.0, 1.0).astype(x.dtype)
    beyond = sign * x - half
    face = jnp.argmax(beyond, axis=1)
    over_face = jnp.sum(beyond > 0, axis=1) < 2
    length, toward = lengths(jnp.maximum(beyond, 0.0))
    n = jnp.where(over_face[:, None], jax.nn.one_hot(face, 3, dtype=x.dtype), toward)
    return jnp.where(over_face, jnp.max(beyond, axis=1), length), sign * n


# ------------------------------------------------------------------------- polygons (g, K, 2)


def sides(corners: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Sides of counter-clockwise polygons, and their unit normals, 0 of one without length."""
    side = jnp.roll(corners, -1, axis=-2) - corners
    return side, outward(side)


def outward(side: jax.Array) -> jax.Array:
    """Unit normals (.., 2) of counter-clockwise sides (.., 2); 0 of one without length."""
    square = dot(side, side)[..., None]
    turned = jnp.stack([side[..., 1], -side[..., 0]], axis=-1)
    return turned / jnp.sqrt(jnp.where(square > 0, square, 1.0))


def disc_on_polygon(middle: jax.Array, rim: jax.Array, corners: jax.Array) -> ContactPoints:
    """Contacts (g,) of discs about points (g, 2) of radii (g,) with polygons."""
    side, normals = sides(corners)
    heights = _of_sides(dot(middle[:, None] - corners, normals), normals)
    nearest = jnp.argmax(heights, axis=1)  # outside, its side or one of its ends is the nearest
    row = np.arange(len(corners))
    away, _, n = _from_side(middle, *(x[row, nearest] for x in (corners, side, normals)))
    return ContactPoints(away - rim, middle - away[:, None] * n, n)


def _from_side(
    point: jax.Array, begin: jax.Array, side: jax.Array, n: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Distances (..) of points (.., 2) from sides with normals n, negative behind one of them.

    And where (.., 2) they touch at distance 0, and unit vectors (.., 2) from the side.
    """
    square, from_begin = dot(side, side), point - begin
    along = dot(side, from_begin)
    slack = PARALLEL * jnp.sqrt(square)
    beyond = (along < -slack) | (along > square + slack)
    end = begin + jnp.where(along > square, 1.0, 0.0)[..., None] * side
    length, toward = lengths(point - end)
    distance = jnp.where(beyond, length, dot(n, from_begin))
    beyond = beyond[..., None]
    return distance, jnp.where(beyond, 0.5 * (point + end), point), jnp.where(beyond, toward, n)


def _of_sides(heights: jax.Array, normals: jax.Array) -> jax.Array:
    """Heights (.., k) over sides of these normals, -inf over those without length."""
    return jnp.where(jnp.any(normals != 0, axis=-1), heights, -jnp.inf)


class Facing(NamedTuple):
    """Sides of pairs of polygons that face each other."""

    first: jax.Array  # (g,) number of the side of the first polygon
    second: jax.Array
    normal: jax.Array  # (g, 2) from the first one to the second one


def _of_one(is_chosen: jax.Array, of_sides: jax.Array) -> jax.Array:
    """What belongs (2, g, ..) to the chosen side (2, g, K) of each polygon, of (2, g, K, ..)."""
    chosen = is_chosen.reshape(*is_chosen.shape, *[1] * (of_sides.ndim - 3))
    return jnp.sum(jnp.where(chosen, of_sides, 0.0), axis=2)


def facing_sides(a: jax.Array, b: jax.Array) -> Facing:
    """Sides of pairs of polygons that face each other, and the normal from a to b.

    The line of one side keeps the polygons apart most. The other polygon's nearest corner to this
    line is an end of its side that is most opposite.
    """
    both = jnp.stack([a, b])
    _, normals = sides(both)
    heights = dot(both[::-1, :, :, None] - both[:, :, None], normals[:, :, None])  # corner, side
    beyond = _of_sides(jnp.min(heights, axis=2), normals)
    own = jnp.argmax(beyond, axis=2)
    n = _of_one(jax.nn.one_hot(own, a.shape[1], dtype=bool), normals)
    other = jnp.argmin(dot(normals[::-1], n[:, :, None]), axis=2)
    most = jnp.max(beyond, axis=2)
    by_b = most[1] > most[0] + PARALLEL
    first, second = jnp.where(by_b, other[1], own[0]), jnp.where(by_b, own[1], other[0])
    return Facing(first, second, jnp.where(by_b[:, None], -n[1], n[0]))


def polygon_on_polygon(
    a: jax.Array, b: jax.Array, facing: Facing, swapped: jax.Array
) -> ContactPoints:
    """Two contacts (g, 2) a pair, at the begin and at the end of the first body's side.

    Each is the nearer one of the end of the first side to the second side, and of the end of the
    second side that faces it to the first side: the distance has no jumps. Where `swapped` (g,)
    that at the end comes first.
    """
    corners = jnp.stack([a, b])
    is_facing = jax.nn.one_hot(jnp.stack(facing[:2]), a.shape[1], dtype=bool)
    ends = jnp.stack([corners, jnp.roll(corners, -1, axis=2)], axis=3)
    ends = _of_one(is_facing, ends)  # body, pair, begin and end
    begin, side = ends[:, :, 0], ends[:, :, 1] - ends[:, :, 0]
    # of each body its ends, in the order of the contacts, from the other body's side
    turned = jnp.stack([swapped, ~swapped])[:, :, None, None]
    ends = jnp.where(turned, ends[:, :, ::-1], ends)
    others = (x[::-1, :, None] for x in (begin, side, outward(side)))
    gaps, points, normals = _from_side(ends, *others)
    first = gaps[0] <= gaps[1]
    of_first = first[..., None]
    return ContactPoints(
        jnp.where(first, gaps[0], gaps[1]),
        jnp.where(of_first, points[0], points[1]),
        jnp.where(of_first, normals[0], -normals[1]),
    )


def changed_places(
    polygons: tuple[jax.Array, jax.Array],
    angles: tuple[jax.Array, jax.Array],
    counts: tuple[np.ndarray, np.ndarray],
    facing: Facing,
) -> jax.Array:
    """Whether the contact at the end of the first side is the first one (g,), of pairs.

    Where a body rolls over a corner, one of the sides gives way to its neighbour, which has the
    corner at its other end. The contact there keeps its place among the two because they are
    swapped where the numbers of both sides have an odd sum. An odd number of sides counts on
    through full turns, of the body and of the direction between the bodies; the latter begin anew
    at `_CUT`.
    """
    n = facing.normal
    turned = _CUT + (jnp.arctan2(n[:, 1], n[:, 0]) - _CUT) % (2 * np.pi)
    number = jnp.zeros(len(n), jnp.int32)
    each = zip(polygons, angles, counts, facing[:2], (0.0, np.pi))
    for corners, angle, count, side, opposite in each:
        number += jnp.minimum(side, count - 1).astype(jnp.int32)
        if (count % 2).any():
            full = _full_turns(corners, side, angle, turned + opposite)
            number += jnp.where(count % 2 == 1, full, 0)
    return number % 2 == 1


def _full_turns(
    corners: jax.Array, side: jax.Array, angle: jax.Array, direction: jax.Array
) -> jax.Array:
    """How many full turns (g,) bodies at these angles made against the directions to others."""
    own = sides(corners)[1]
    own = jnp.arctan2(own[..., 1], own[..., 0])
    first, facing = own[:, 0], own[np.arange(len(own)), side]
    at = angle + (first - angle) % (2 * np.pi) + (facing - first) % (2 * np.pi)
    return jnp.round((direction - at) / (2 * np.pi)).astype(jnp.int32)


def margin_of_places(polygons: tuple[jax.Array, jax.Array], facing: Facing) -> jax.Array:
    """Margins (g,) within which contacts keep their places, of an odd and an even polygon each."""
    (a, b), n = polygons, facing.normal[:, None]
    apart = jnp.min(dot(b, n), axis=1) - jnp.max(dot(a, n), axis=1)
    off = 1 - dot(n[:, 0], jnp.array([[np.cos(_CUT), np.sin(_CUT)]], n.dtype)) - _NEAR_CUT
    return jnp.maximum(off, apart - _TOUCHING)


def any_pair(a: jax.Array, b: jax.Array, r: jax.Array, s: jax.Array) -> ContactPoints:
    """Two contacts (g, 2) of each pair of discs and polygons; with a disc the second one is open.

    a, b (g, K, 2) are corners, or the middle of a disc, r, s (g,) radii, 0 of polygons.
    """
    discs = round_on_round(a[:, 0], b[:, 0], r, s)
    faces = polygon_on_polygon(a, b, facing_sides(a, b), jnp.zeros(len(a), bool))
    first = r[:, None] > 0
    disc = jnp.where(first, a[:, 0], b[:, 0])
    rolling = disc_on_polygon(disc, jnp.maximum(r, s), jnp.where(first[..., None], b, a))
    rolling = rolling._replace(normal=jnp.where(first, 1.0, -1.0) * rolling.normal)
    one_disc, both_discs = (r > 0) | (s > 0), (r > 0) & (s > 0)

    def chosen(of_discs: jax.Array, of_one: jax.Array, of_sides: jax.Array) -> jax.Array:
        """What two discs have, a disc and a polygon, or two polygons."""
        each = [1] * (of_discs.ndim - 1)
        one = jnp.where(both_discs.reshape(-1, *each), of_discs, of_one)[:, None]
        return jnp.where(one_disc.reshape(-1, 1, *each), one, of_sides)

    gap, point, normal = (chosen(*x) for x in zip(discs, rolling, faces))
    return ContactPoints(gap.at[:, 1].add(jnp.where(one_disc, jnp.inf, 0.0)), point, normal)
