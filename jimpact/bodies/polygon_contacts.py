"""Contacts of convex polygons with discs and with each other, in the plane."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jimpact.bodies.base import dot, lengths
from jimpact.bodies.contacts import ContactPoints
from jimpact.compiling import full_precision

# [m] More than rounding: it decides neither between parallel sides nor whether a point at the end
# of a side is over it.
PARALLEL = 1e-9


def outward(side: jax.Array) -> jax.Array:
    """Unit normals (.., 2) of counter-clockwise sides (.., 2); 0 of one without length."""
    square = dot(side, side)[..., None]
    turned = jnp.stack([side[..., 1], -side[..., 0]], axis=-1)
    return turned / jnp.sqrt(jnp.where(square > 0, square, 1.0))


def disc_on_polygon(middle: jax.Array, rim: jax.Array, corners: jax.Array) -> ContactPoints:
    """Contacts of discs about points (g, 2) of radii (g,) with a polygon of corners (k, 2)."""
    away, n = from_polygon(middle, corners)
    return ContactPoints(away - rim, middle - away[:, None] * n, n)


def from_polygon(middle: jax.Array, begin: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Distances (g,) of points (g, 2) from a polygon of corners (k, 2), and unit vectors from it.

    Sides without length do not count.
    """
    side = jnp.roll(begin, -1, axis=0) - begin
    normals = outward(side)
    heights = _of_sides(jnp.sum((middle[:, None] - begin[None]) * normals[None], axis=2), normals)
    nearest = jnp.argmax(heights, axis=1)  # outside, its side or one of its ends is the nearest
    distance, _, n = _from_side(middle, begin[nearest], side[nearest], normals[nearest])
    return distance, n


def _from_side(
    point: jax.Array, begin: jax.Array, side: jax.Array, n: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Distances (g,) of points (g, 2) from sides with normals n, negative behind one of them.

    And where (g, 2) they touch at distance 0, and unit vectors (g, 2) from the side.
    """
    square = dot(side, side)
    along = dot(side, point - begin)
    slack = PARALLEL * jnp.sqrt(square)
    beyond = (along < -slack) | (along > square + slack)
    end = begin + jnp.where(along > square, 1.0, 0.0)[:, None] * side
    length, toward = lengths(point - end)
    distance = jnp.where(beyond, length, dot(n, point - begin))
    beyond = beyond[:, None]
    return distance, jnp.where(beyond, 0.5 * (point + end), point), jnp.where(beyond, toward, n)


def _of_sides(heights: jax.Array, normals: jax.Array) -> jax.Array:
    """Heights (.., k) over sides of these normals (k, 2), -inf over those without length."""
    return jnp.where(jnp.any(normals != 0, axis=1), heights, -jnp.inf)


class FacingSides(NamedTuple):
    """Sides in contact of pairs of polygons, each from its begin to its end (g, 2)."""

    first: tuple[jax.Array, jax.Array]
    second: tuple[jax.Array, jax.Array]
    swapped: jax.Array  # (g,) whether the contact at the first side's end comes first


@full_precision
def facing_now(a: jax.Array, b: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Sides () of two polygons that face each other, and the normal (2,) from a to b.

    The line of one side keeps the polygons apart most. The other polygon's nearest corner to this
    line is an end of its side that is most opposite.
    """
    n_a, n_b = (outward(jnp.roll(x, -1, axis=0) - x) for x in (a, b))
    beyond_a = _of_sides(jnp.min(jnp.sum((b[:, None] - a[None]) * n_a[None], axis=2), axis=0), n_a)
    beyond_b = _of_sides(jnp.min(jnp.sum((a[:, None] - b[None]) * n_b[None], axis=2), axis=0), n_b)
    side_a, side_b = jnp.argmax(beyond_a), jnp.argmax(beyond_b)
    opposite = n_a @ n_b.T
    by_b = jnp.max(beyond_b) > jnp.max(beyond_a) + PARALLEL
    side_a = jnp.where(by_b, jnp.argmin(opposite[:, side_b]), side_a)
    side_b = jnp.where(by_b, side_b, jnp.argmin(opposite[side_a]))
    return side_a, side_b, jnp.where(by_b, -n_b[side_b], n_a[side_a])


def facing_sides(sides: FacingSides) -> ContactPoints:
    """Two contacts a pair, at the begin and at the end of the first body's side.

    Each is the nearer one of the end of the first side to the second side, and of the end of the
    second side that faces it to the first side: the distance has no jumps.
    """
    (a_begin, a_end), (b_begin, b_end) = sides.first, sides.second
    side_a, side_b = a_end - a_begin, b_end - b_begin
    n_a, n_b = outward(side_a), outward(side_b)

    def at_end(a: jax.Array, b: jax.Array) -> ContactPoints:
        """Contacts at the ends a (g, 2) of first sides, which face the ends b of second ones."""
        gap_a, point_a, from_b = _from_side(a, b_begin, side_b, n_b)
        gap_b, point_b, from_a = _from_side(b, a_begin, side_a, n_a)
        first = (gap_a <= gap_b)[:, None]
        return ContactPoints(
            jnp.minimum(gap_a, gap_b),
            jnp.where(first, point_a, point_b),
            jnp.where(first, from_b, -from_a),
        )

    both = (at_end(a_begin, b_end), at_end(a_end, b_begin))
    gap, point, n = (jnp.stack(parts, axis=1) for parts in zip(*both))
    swapped = sides.swapped[:, None]
    gap = jnp.where(swapped, gap[:, ::-1], gap)
    point, n = (jnp.where(swapped[..., None], x[:, ::-1], x) for x in (point, n))
    return ContactPoints(gap.reshape(-1), point.reshape(-1, 2), n.reshape(-1, 2))


def side_of(corners: jax.Array, side: Any) -> tuple[jax.Array, jax.Array]:
    """Begin and end (2,) of a side of a polygon with these corners (k, 2)."""
    return corners[side], corners[(side + 1) % corners.shape[0]]


def mixed_pairs(
    a: jax.Array, b: jax.Array, r: jax.Array, s: jax.Array, discs: ContactPoints
) -> ContactPoints:
    """Two contacts (g, 2) of each pair of discs and polygons; with a disc the second one is open.

    a, b (g, K, 2) are corners, or first the middle of a disc, r, s (g,) radii, 0 of polygons;
    `discs` (g,) are the contacts where both are discs.
    """
    side_a, side_b, _ = jax.vmap(facing_now)(a, b)
    first_side, second_side = (jax.vmap(side_of)(*x) for x in ((a, side_a), (b, side_b)))
    sides = facing_sides(FacingSides(first_side, second_side, jnp.zeros(len(a), bool)))
    first = r[:, None] > 0
    disc = jnp.where(first, a[:, 0], b[:, 0])[:, None]
    polygon = jnp.where(first[..., None], b, a)
    rolling = jax.vmap(disc_on_polygon)(disc, jnp.maximum(r, s)[:, None], polygon)
    one_disc, both_discs = (r > 0) | (s > 0), (r > 0) & (s > 0)
    rolling = rolling._replace(normal=jnp.where(first, 1.0, -1.0)[..., None] * rolling.normal)

    def chosen(of_discs: jax.Array, of_one: jax.Array, of_sides: jax.Array) -> jax.Array:
        """What two discs have, a disc and a polygon, or two polygons."""
        each = (-1, *[1] * of_discs.ndim)
        one = jnp.where(both_discs.reshape(each), of_discs[:, None], of_one)
        return jnp.where(one_disc.reshape(each), one, of_sides.reshape(len(a), 2, *one.shape[2:]))

    gap, point, normal = (chosen(*x) for x in zip(discs, rolling, sides))
    return ContactPoints(gap.at[:, 1].add(jnp.where(one_disc, jnp.inf, 0.0)), point, normal)
