"""Contacts of two bodies: discs, spheres, boxes and convex polygons, pair by pair."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jimpact.bodies.base import dot, lengths
from jimpact.bodies.rigid import ContactPoints

# [m] More than rounding: it decides neither between parallel sides nor whether a point
# at the end of a side is over it.
PARALLEL = 1e-9
# [rad] Direction between two polygons, of which one has an odd number of sides, at
# which their two contacts change places, see `changed_places`: none of the usual
# slopes.
_CUT = 2.0
# 1 - cos of the angle to that direction, within which they must not touch: .8 degrees.
# Ten times less, and steps of a motion may pass over it.
_NEAR_CUT = 1e-4
_TOUCHING = 1e-6  # [m] gap from which they may pass it; ten times more would do


def round_on_round(
    a: jax.Array, b: jax.Array, r: jax.Array, s: jax.Array
) -> ContactPoints:
    """Contacts (g,) of discs or spheres about a, b (g, d) [m] of radii r, s (g,) [m].

    Equation: `f = |a - b| - r - s`, `n = (a - b) / |a - b|`, from the second to the
    first one. Forces act in the middle of the gap or overlap, `b + (s + f / 2) n`, one
    point of both bodies: only so do they keep the angular momentum.
    """
    length, n = lengths(a - b)
    gap = length - r - s
    height = s + 0.5 * gap
    point = b + height[:, None] * n
    return ContactPoints(gap, point, n)


def from_box(x: jax.Array, half: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Distances (g,) [m] of points x (g, 3) from boxes `|x_i| <= half_i`, and gradients
    (g, 3).

    Equation: `max(|x_i| - half_i)`, the distance from a face, where at most one of
    these is positive (negative inside); `|max(|x_i| - half_i, 0)|`, that from an edge
    or corner, elsewhere.
    """
    negative = x < 0
    signs = jnp.where(negative, -1.0, 1.0)
    sign = signs.astype(x.dtype)
    beyond = sign * x - half
    face = jnp.argmax(beyond, axis=1)
    faces_passed = jnp.sum(beyond > 0, axis=1)
    over_face = faces_passed < 2
    length, toward = lengths(jnp.maximum(beyond, 0.0))
    of_face = jax.nn.one_hot(face, 3, dtype=x.dtype)
    n = jnp.where(over_face[:, None], of_face, toward)
    depth = jnp.max(beyond, axis=1)
    distance = jnp.where(over_face, depth, length)
    return distance, sign * n


# ------------------------------------------------------------------------- polygons (g,
# K, 2)


def sides(corners: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Sides (.., K, 2) of counter-clockwise polygons with `corners` (.., K, 2), and
    unit normals.

    Side i goes from corner i to the next one; one without length has the normal 0.
    """
    following = jnp.roll(corners, -1, axis=-2)
    side = following - corners
    return side, outward(side)


def angle_in_plane(vector: jax.Array) -> jax.Array:
    """Angles (..) [rad] of vectors (.., 2) from the x axis, in (-pi, pi]."""
    x = vector[..., 0]
    y = vector[..., -1]
    return jnp.arctan2(y, x)


def outward(side: jax.Array) -> jax.Array:
    """Outward unit normals (s_y, -s_x) / |s| of counter-clockwise sides s (.., 2); 0 of
    s = 0.
    """
    square = dot(side, side)[..., None]
    x = side[..., 0]
    y = side[..., -1]
    turned = jnp.stack([y, -x], axis=-1)
    has_length = square > 0
    positive = jnp.where(has_length, square, 1.0)
    return turned / jnp.sqrt(positive)


def disc_on_polygon(
    middle: jax.Array, rim: jax.Array, corners: jax.Array
) -> ContactPoints:
    """Contacts (g,) of discs about points (g, 2) of radii (g,) with polygons (g, K, 2),
    all in [m].

    Equation: `f = d - r` with the distance d of the middle from the polygon.
    """
    side, normals = sides(corners)
    from_corners = middle[:, None] - corners
    over_lines = dot(from_corners, normals)
    heights = _without_points(over_lines, normals)
    # outside, its side or one of its ends is the nearest
    nearest = jnp.argmax(heights, axis=1)
    row = np.arange(len(corners))
    at_nearest = (x[row, nearest] for x in (corners, side, normals))
    away, _, n = _from_side(middle, *at_nearest)
    point = middle - away[:, None] * n
    return ContactPoints(away - rim, point, n)


def _from_side(
    point: jax.Array, begin: jax.Array, side: jax.Array, n: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Distances d (..) [m] of points from sides, contact points (.., 2), and normals
    (.., 2).

    A `side` (.., 2) starts at `begin` and has the outward unit normal n; all arrays are
    (.., 2). A point over the side has `d = n . (point - begin)`, negative behind it,
    and itself is the contact point. Beyond an end, d is the distance from this end, the
    contact point is halfway, and the normal points from the end to the point.
    """
    square = dot(side, side)
    from_begin = point - begin
    along = dot(side, from_begin)  # from 0 at the begin to |side|^2 at the end
    slack = PARALLEL * jnp.sqrt(square)
    too_early = along < -slack
    too_late = along > square + slack
    beyond = too_early | too_late
    # the nearer one
    past_middle = along > square
    share = jnp.where(past_middle, 1.0, 0.0)
    end = begin + share[..., None] * side
    length, toward = lengths(point - end)
    height = dot(n, from_begin)
    distance = jnp.where(beyond, length, height)
    beyond = beyond[..., None]
    halfway = 0.5 * (point + end)
    contact = jnp.where(beyond, halfway, point)
    normal = jnp.where(beyond, toward, n)
    return distance, contact, normal


def _without_points(heights: jax.Array, normals: jax.Array) -> jax.Array:
    """Heights (.., k) over sides with these normals (.., k, 2); -inf over those without
    length.
    """
    has_length = jnp.any(normals != 0, axis=-1)
    return jnp.where(has_length, heights, -jnp.inf)


class Facing(NamedTuple):
    """Sides of g pairs of polygons that face each other."""

    first: jax.Array  # (g,) number of the side of the first polygon
    second: jax.Array  # (g,) that of the second one
    normal: jax.Array  # (g, 2) from the first one to the second one


def _at_side(is_chosen: jax.Array, values: jax.Array) -> jax.Array:
    """Entries (2, g, ..) of `values` (2, g, K, ..) at the one chosen side (2, g, K) a
    polygon.
    """
    other_axes = [1] * (values.ndim - 3)
    chosen = is_chosen.reshape(*is_chosen.shape, *other_axes)
    of_chosen = jnp.where(chosen, values, 0.0)
    return jnp.sum(of_chosen, axis=2)


def facing_sides(a: jax.Array, b: jax.Array) -> Facing:
    """Sides of polygons a, b (g, K, 2) that face each other, and unit normals from a to
    b.

    One is the side whose line separates the two polygons most: over all sides of both,
    the least height of the other polygon's corners over the line is largest. The other
    one is the side of the other polygon whose normal is most opposite.
    """
    both = jnp.stack([a, b])
    _, normals = sides(both)
    # (polygon, pair, corner of the other polygon, side)
    of_other = both[::-1, :, :, None]
    from_corners = of_other - both[:, :, None]
    heights = dot(from_corners, normals[:, :, None])
    lowest = jnp.min(heights, axis=2)
    beyond = _without_points(lowest, normals)
    separating = jnp.argmax(beyond, axis=2)
    count = a.shape[1]
    is_separating = jax.nn.one_hot(separating, count, dtype=bool)
    n = _at_side(is_separating, normals)
    # side of the other polygon
    facing = dot(normals[::-1], n[:, :, None])
    opposite = jnp.argmin(facing, axis=2)
    separation = jnp.max(beyond, axis=2)
    of_a, of_b = separation
    by_b = of_b > of_a + PARALLEL  # a side of b separates more
    separating_a, separating_b = separating
    opposite_b, opposite_a = opposite
    first = jnp.where(by_b, opposite_a, separating_a)
    second = jnp.where(by_b, separating_b, opposite_b)
    n_a, n_b = n
    normal = jnp.where(by_b[:, None], -n_b, n_a)
    return Facing(first, second, normal)


def polygon_on_polygon(
    a: jax.Array, b: jax.Array, facing: Facing, swapped: jax.Array
) -> ContactPoints:
    """Two contacts (g, 2) a pair of polygons (g, K, 2), at both ends of the facing
    sides.

    At each end the gap is the lesser of two distances: of the end of the first side
    from the second side, and of the opposite end of the second side from the first
    side. So it has no jumps. The contact at the end of the first side comes first where
    `swapped` (g,), else that at its begin.
    """
    corners = jnp.stack([a, b])
    numbers = jnp.stack([facing.first, facing.second])
    count = a.shape[1]
    is_facing = jax.nn.one_hot(numbers, count, dtype=bool)
    next_corners = jnp.roll(corners, -1, axis=2)
    ends = jnp.stack([corners, next_corners], axis=3)
    ends = _at_side(is_facing, ends)  # (body, pair, begin or end, x or y)
    begin = ends[:, :, 0]
    end = ends[:, :, -1]
    side = end - begin
    # the ends of each body's side in the order of the contacts, against the other
    # body's side
    both_swapped = jnp.stack([swapped, ~swapped])
    reverse = both_swapped[:, :, None, None]
    reversed_ends = ends[:, :, ::-1]
    ends = jnp.where(reverse, reversed_ends, ends)
    n = outward(side)
    others = (x[::-1, :, None] for x in (begin, side, n))
    gaps, points, normals = _from_side(ends, *others)  # (body, pair, contact, ..)
    gap_a, gap_b = gaps
    point_a, point_b = points
    normal_a, normal_b = normals
    nearer = gap_a <= gap_b  # the end of the first side
    at_end = nearer[..., None]
    gap = jnp.where(nearer, gap_a, gap_b)
    point = jnp.where(at_end, point_a, point_b)
    normal = jnp.where(at_end, normal_a, -normal_b)
    return ContactPoints(gap, point, normal)


def changed_places(
    polygons: tuple[jax.Array, jax.Array],
    angles: tuple[jax.Array, jax.Array],
    counts: tuple[np.ndarray, np.ndarray],
    facing: Facing,
) -> jax.Array:
    """True (g,) for pairs whose contact at the end of the first side counts as the
    first contact.

    Where a body rolls over a corner, one of the facing sides gives way to its
    neighbour, which has the corner at its other end. The contact there keeps its place
    among the two because they are swapped where the numbers of both sides have an odd
    sum. Numbers of an odd polygon count on through full turns, of the body and of the
    direction between the bodies, whose angle jumps by 2 pi at `_CUT`.

    Args:
        polygons: corners (g, K, 2) of the first and of the second ones.
        angles: theta (g,) [rad] of these bodies.
        counts: numbers of their corners (g,).
        facing: their facing sides.
    """
    angle_of_normal = angle_in_plane(facing.normal)
    angle_of_normal = angle_in_plane(facing.normal)
    turn = 2 * np.pi
    direction = _CUT + (angle_of_normal - _CUT) % turn
    number = jnp.zeros(len(direction), jnp.int32)
    # seen from the second polygon, the direction between both is turned by pi
    directions = (direction, direction + np.pi)
    facing_sides_of_both = (facing.first, facing.second)
    both = zip(polygons, angles, counts, facing_sides_of_both, directions)
    for corners, angle, count, side, toward_other in both:
        last = count - 1
        number += jnp.int32(jnp.minimum(side, last))
        is_odd = count % 2 == 1
        if is_odd.any():
            full = _full_turns(corners, side, angle, toward_other)
            number += jnp.where(is_odd, full, 0)
    return number % 2 == 1


def _full_turns(
    corners: jax.Array, side: jax.Array, angle: jax.Array, direction: jax.Array
) -> jax.Array:
    """Full turns (g,) to add to the angle phi of a facing side's normal, so that it is
    within half a turn of the `direction` (g,) [rad] to the other body.

    Equation: `round((direction - phi) / 2 pi)`. phi has no jumps while the body turns:
    it begins at the body's `angle` (g,) [rad], which has none, goes on to the normal of
    side 0, and from there to that of `side` (g,), each time by less than a turn. Of g
    pairs; `corners` (g, K, 2) [m] of polygons of K corners.
    """
    _, normals = sides(corners)
    angles = angle_in_plane(normals)  # (g, K)
    first = angles[:, 0]
    row = np.arange(len(angles))
    facing = angles[row, side]
    turn = 2 * np.pi
    to_first = (first - angle) % turn
    to_facing = (facing - first) % turn
    phi = angle + to_first + to_facing
    turns = jnp.round((direction - phi) / turn)
    return turns.astype(jnp.int32)


def margin_of_places(
    polygons: tuple[jax.Array, jax.Array], facing: Facing
) -> jax.Array:
    """Margins (g,) that are >= 0 while contacts of an odd and an even polygon keep
    their order.

    Equation: `max(1 - cos(angle between n and _CUT) - _NEAR_CUT, distance along n -
    _TOUCHING)`: polygons in touch must not have their normal n at `_CUT`, see
    `changed_places`.
    """
    a, b = polygons
    n = facing.normal[:, None]
    nearest_of_b = jnp.min(dot(b, n), axis=1)
    farthest_of_a = jnp.max(dot(a, n), axis=1)
    distance = nearest_of_b - farthest_of_a
    cut = jnp.array([[np.cos(_CUT), np.sin(_CUT)]], n.dtype)
    cosine = dot(n[:, 0], cut)
    off = 1 - cosine - _NEAR_CUT
    return jnp.maximum(off, distance - _TOUCHING)


def any_pair(a: jax.Array, b: jax.Array, r: jax.Array, s: jax.Array) -> ContactPoints:
    """Two contacts (g, 2) of each pair of discs and polygons; with a disc the second
    one is open.

    a, b (g, K, 2) are corners, or the middle of a disc, r, s (g,) radii, 0 of polygons.
    """
    # each pair is taken for two discs, two polygons, and a disc on a polygon: one of
    # these counts
    middle_a = a[:, 0]
    middle_b = b[:, 0]
    discs = round_on_round(middle_a, middle_b, r, s)
    not_swapped = jnp.zeros(len(a), bool)
    facing = facing_sides(a, b)
    polygons = polygon_on_polygon(a, b, facing, not_swapped)
    first_is_disc = r[:, None] > 0
    disc = jnp.where(first_is_disc, middle_a, middle_b)
    polygon = jnp.where(first_is_disc[..., None], b, a)
    radius = jnp.maximum(r, s)
    mixed = disc_on_polygon(disc, radius, polygon)
    sign = jnp.where(first_is_disc, 1.0, -1.0)
    toward_first = sign * mixed.normal
    mixed = mixed._replace(normal=toward_first)
    a_is_disc = r > 0
    b_is_disc = s > 0
    any_disc = a_is_disc | b_is_disc
    both_discs = a_is_disc & b_is_disc

    def chosen(
        of_discs: jax.Array, of_mixed: jax.Array, of_polygons: jax.Array
    ) -> jax.Array:
        """Values (g, 2, ..) by the kind of each pair; those of a disc, (g, ..), are
        repeated.
        """
        other_axes = [1] * (of_discs.ndim - 1)
        is_disc = both_discs.reshape(-1, *other_axes)
        with_disc = jnp.where(is_disc, of_discs, of_mixed)
        with_one_disc = any_disc.reshape(-1, 1, *other_axes)
        return jnp.where(with_one_disc, with_disc[:, None], of_polygons)

    kinds = zip(discs, mixed, polygons)
    gap, point, normal = (chosen(*x) for x in kinds)
    # discs have one contact, polygons two
    never = jnp.where(any_disc, jnp.inf, 0.0)
    gap = gap.at[:, -1].add(never)
    return ContactPoints(gap, point, normal)
