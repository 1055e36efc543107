"""The closed contacts of many bodies: a grid finds those that are near each other."""

from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from jimpact.bodies.closed_pairs import (
    BLOCK,
    ActivePairs,
    chosen_rows,
    over_blocks,
    with_block,
)
from jimpact.bodies.distances import any_pair, round_on_round
from jimpact.bodies.neighbours import Candidates, all_pairs, crowd_of, near_pairs
from jimpact.bodies.rigid import ContactPoints, Placed, Shape, tangents_of
from jimpact.bodies.shapes import inner_radii
from jimpact.tools.checks import is_traced
from jimpact.tools.compiling import full_precision

# Pairs of each body whose circles around them meet, of polygons. Ten times more takes ten times the
# memory.
NEAR = 8

# Way of a body within half a step, over the least radius, up to which the grid finds all contacts:
# what moves farther in a step than the least radius is a `coarse_step`. Ten times more makes cells
# hold twenty times more bodies.
MARGIN = 0.5


class Pile(Protocol):
    """What the grid asks of `Bodies`, see there and `RigidBodies`: b bodies, w planes."""

    @property
    def points(self) -> jax.Array:
        """(b, P, d) [m]."""

    @property
    def rims(self) -> jax.Array:
        """(b,) [m] radii about the points."""

    @property
    def planes(self) -> jax.Array:
        """(w, d + 1) unit normal, distance [m]."""

    @property
    def shapes(self) -> tuple[Shape, ...]:
        """One of each kind of body."""

    @property
    def room(self) -> int:
        """Contacts that may be closed at once."""

    @property
    def crowd(self) -> int:
        """Bodies in a cell at most."""

    @property
    def count(self) -> int:
        """Number of bodies b."""

    @property
    def dimension(self) -> int:
        """2 or 3."""

    @property
    def angular(self) -> int:
        """Angular velocities of a body."""

    def of_bodies(self, q: jax.Array) -> jax.Array:
        """q (n,) by body (b, ..)."""

    def placed(self, q: jax.Array) -> Placed:
        """Turns and points in space."""

    def placed_at(self, at: jax.Array, points: jax.Array) -> Placed:
        """The same of some bodies."""

    def contact_jacobian(self, at: jax.Array, point: jax.Array, ways: jax.Array) -> jax.Array:
        """Rows of velocities of points along directions."""


def slots(bodies: Pile) -> int:
    """Contacts of a pair: at both ends of the sides of polygons that face each other."""
    return min(2, bodies.points.shape[1])


def stride(bodies: Pile) -> int:
    """Partners of a body: the others, and each plane once for each corner."""
    return bodies.count + len(bodies.planes) * bodies.points.shape[1]


def outer_radii(bodies: Pile) -> jax.Array:
    """Radii (b,) of discs or balls about the centres of mass, around the bodies."""
    far = jnp.sqrt(jnp.max(jnp.sum(bodies.points**2, axis=2), axis=1))
    return far + bodies.rims


def least_radius(bodies: Pile) -> jax.Array:
    """The least radius () of a disc or ball about a centre of mass, within its body."""
    far = jnp.sqrt(jnp.sum(bodies.points[:, 0] ** 2, axis=1))
    if slots(bodies) == 1:
        return jnp.min(bodies.rims - far)
    of_round = jnp.where(bodies.rims > 0, bodies.rims - far, jnp.inf)
    return jnp.min(jnp.minimum(of_round, inner_radii(bodies.points)))


def crowd_of_cells(bodies: Pile) -> int:
    """How many bodies a row of cells may hold; 0 where looking at every pair is less work."""
    if is_traced((bodies.points, bodies.rims)):
        return 0
    least, largest = float(least_radius(bodies)), float(outer_radii(bodies).max())
    crowd = crowd_of(least, largest + 0.5 * MARGIN * least, bodies.dimension)
    rows = (3 ** (bodies.dimension - 1) + 1) // 2
    return crowd if 2 * rows * crowd < bodies.count else 0


def _circle_gaps(bodies: Pile, q: jax.Array, i: Any, j: Any) -> jax.Array:
    """Gaps (C,) of the discs or balls around these bodies."""
    columns = bodies.of_bodies(q)[:, : bodies.dimension].T  # one by one: five times faster
    squares = sum((x[i] - x[j]) ** 2 for x in columns)
    radii = outer_radii(bodies)
    return jnp.sqrt(squares) - radii[i] - radii[j]


@full_precision
def _plane_gaps(bodies: Pile, q: jax.Array) -> jax.Array:
    """Gaps (b, w, P) of all corners; infinite of those that only fill a row."""
    n, offset = bodies.planes[:, :-1], bodies.planes[:, -1]
    height = jnp.sum(bodies.placed(q).points[:, None] * n[None, :, None], axis=3)
    gap = height - offset[None, :, None] - bodies.rims[:, None, None]
    sizes = np.array([shape.size for shape in bodies.shapes])
    unused = np.arange(bodies.points.shape[1])[None] >= sizes[:, None]
    return jnp.where(unused[:, None], jnp.inf, gap)


def _candidates(bodies: Pile, q: jax.Array, margin: jax.Array) -> Candidates:
    """Pairs of bodies, all those with gaps up to `margin` among them."""
    if bodies.crowd == 0:
        return all_pairs(bodies.count)
    distance = 2 * jnp.max(outer_radii(bodies)) + margin
    return near_pairs(bodies.of_bodies(q)[:, : bodies.dimension], distance, bodies.crowd)


def _of_pairs(bodies: Pile, at: jax.Array, i: Any, j: Any) -> ContactPoints:
    """Contacts of pairs (g,): gaps (g, slots), points (g, slots, d), normals towards i."""
    a, b = (bodies.placed_at(at[x], bodies.points[x]).points for x in (i, j))
    r, s = bodies.rims[i], bodies.rims[j]
    if slots(bodies) > 1:
        return any_pair(a, b, r, s)
    return ContactPoints(*(x[:, None] for x in round_on_round(a[:, 0], b[:, 0], r, s)))


def least_gap(bodies: Pile, q: jax.Array) -> jax.Array:
    """The least gap () [m]; of bodies that are near each other if there are any."""
    others = jnp.asarray(np.arange(bodies.count, dtype=np.int32))
    to_planes = jnp.min(_plane_gaps(bodies, q), initial=jnp.inf)
    at = bodies.of_bodies(q)

    def of_all() -> jax.Array:
        """Body by body, so that no table holds all pairs."""

        def with_one(i: jax.Array, least: jax.Array) -> jax.Array:
            gaps = _of_pairs(bodies, at, jnp.full_like(others, i), others).gap
            alone = (others == i)[:, None]
            return jnp.minimum(least, jnp.min(jnp.where(alone, jnp.inf, gaps)))

        return jax.lax.fori_loop(jnp.int32(0), jnp.int32(bodies.count), with_one, to_planes)

    if bodies.crowd == 0:
        return of_all()
    margin = MARGIN * least_radius(bodies)
    _, _, gaps, overflows = _near_gaps(bodies, q, q, margin)
    least = jnp.minimum(jnp.min(gaps, initial=jnp.inf), to_planes)
    return jax.lax.cond((least <= margin) & ~overflows, lambda: least, of_all)


def _near_gaps(
    bodies: Pile, q: jax.Array, later: jax.Array, below: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Bodies i and j (C,), the least gaps (C, slots) at q or `later`, and whether some miss.

    Among them are all pairs with gaps up to `below`.
    """
    way = jnp.abs(bodies.of_bodies(later - q)[:, : bodies.dimension])
    # each moves by half of its way from the middle; what moves farther is a `coarse_step`
    farther = jnp.minimum(jnp.max(jnp.sum(way, axis=1)), MARGIN * least_radius(bodies))
    near = _candidates(bodies, 0.5 * (q + later), below + farther)
    circles = [_circle_gaps(bodies, x, near.first, near.second) for x in (q, later)]
    gaps = jnp.where(near.used, jnp.minimum(*circles), jnp.inf)
    if all(shape.centred for shape in bodies.shapes):
        return near.first, near.second, gaps[:, None], near.overflows
    so_far = jnp.cumsum(gaps <= below, dtype=jnp.int32)
    rows = -(-NEAR * bodies.count // BLOCK) * BLOCK
    count = jnp.minimum(so_far[-1], rows)
    at = jnp.stack([bodies.of_bodies(x) for x in (q, later)])

    def one(first: jax.Array, filled: Any) -> Any:
        """The next pairs."""
        used, place = chosen_rows(so_far, first, count)
        i, j = (jnp.where(used, x[place], 0) for x in (near.first, near.second))
        both = jax.vmap(lambda at: _of_pairs(bodies, at, i, j).gap)(at)
        new = i, j, jnp.where(used[:, None], jnp.min(both, axis=0), jnp.inf)
        return tuple(with_block(x, part, first) for x, part in zip(filled, new))

    none = jnp.zeros(rows, jnp.int32)
    start = none, none, jnp.full((rows, slots(bodies)), jnp.inf, q.dtype)
    i, j, gaps = over_blocks(count, one, start)
    return i, j, gaps, near.overflows | (so_far[-1] > rows)


def _closed(
    bodies: Pile, q: jax.Array, later: jax.Array, below: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Numbers of contacts (C,), which of them are closed, and whether some are missing.

    A contact is closed whose gap is at most `below` at q or `later`.
    """
    i, j, gaps, overflows = _near_gaps(bodies, q, later, below)
    to_planes = jnp.minimum(_plane_gaps(bodies, q), _plane_gaps(bodies, later)).reshape(-1)
    count, partners = slots(bodies), stride(bodies)
    slot = np.arange(count, dtype=np.int32)[None]
    number = count * (i * partners + j)[:, None] + slot
    partner = np.arange(bodies.count, partners, dtype=np.int32)
    body = np.arange(bodies.count, dtype=np.int32)[:, None]
    at_planes = (count * (body * partners + partner)).reshape(-1)
    numbers = jnp.concatenate([number.reshape(-1), at_planes])
    return numbers, jnp.concatenate([gaps.reshape(-1), to_planes]) <= below, overflows


def active_pairs(bodies: Pile, q: jax.Array, later: jax.Array, below: jax.Array) -> ActivePairs:
    """The contacts whose gap is at most `below` at the coordinates q, or `later` at a step's end.

    Of all candidates the closed ones get the rows 0, 1, .. of arrays of fixed length, `bodies.room`
    rounded up to blocks, in the order of their numbers. Rows that are not used are 0, and have the
    number `no_contact`. It overflows where there are more than `bodies.room`, or the grid has no
    room for all pairs that are near.
    """
    numbers, closed, overflows = _closed(bodies, q, later, below)
    rows = -(-bodies.room // BLOCK) * BLOCK
    closed_up_to = jnp.cumsum(closed, dtype=jnp.int32)  # among the first k candidates
    count = jnp.minimum(closed_up_to[-1], rows)
    d = bodies.dimension
    no_contact = jnp.int32(slots(bodies) * bodies.count * stride(bodies))  # above all numbers

    def fill_block(first: jax.Array, filled: Any) -> Any:
        """The arrays with the rows from `first` on, as many as a block has."""
        used, chosen = chosen_rows(closed_up_to, first, count)
        chosen = jnp.where(used, numbers[chosen], 0)
        i, j, directions = _of_contacts(bodies, q, chosen)
        new = (
            jnp.where(used, chosen, no_contact),
            jnp.where(used[:, None], jnp.stack([i, j], axis=1), 0),
            jnp.where(used[:, None, None, None], directions, 0.0),
        )
        return tuple(with_block(x, part, first) for x, part in zip(filled, new))

    start = (
        jnp.full(rows, no_contact, jnp.int32),
        jnp.zeros((rows, 2), jnp.int32),
        jnp.zeros((rows, d, 2, d + bodies.angular), q.dtype),
    )
    number, between, directions = over_blocks(count, fill_block, start)
    return ActivePairs(
        number,
        jnp.asarray(np.arange(rows, dtype=np.int32)) < count,
        count,
        between,
        directions,
        overflows | (closed_up_to[-1] > bodies.room),
        least_radius(bodies),
    )


def _of_contacts(
    bodies: Pile, q: jax.Array, number: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Bodies i and j (K,) of contacts of these numbers, j = `count` for planes; directions."""
    pair, slot = jnp.divmod(number, jnp.int32(slots(bodies)))
    i, partner = jnp.divmod(pair, jnp.int32(stride(bodies)))
    other, row = jnp.minimum(partner, bodies.count - 1), np.arange(len(number))
    at = bodies.of_bodies(q)
    _, points, normals = _of_pairs(bodies, at, i, other)
    point, n = points[row, slot], normals[row, slot]
    if len(bodies.planes):
        on_plane = (partner >= bodies.count)[:, None]
        plane, corner = jnp.divmod(
            jnp.maximum(partner - bodies.count, 0), jnp.int32(bodies.points.shape[1])
        )
        n = jnp.where(on_plane, bodies.planes[plane, :-1], n)
        corners = bodies.placed_at(at[i], bodies.points[i]).points
        lowest = corners[row, corner] - bodies.rims[i][:, None] * n
        point = jnp.where(on_plane, lowest, point)
    ways = jnp.concatenate([n[:, None], tangents_of(n)], axis=1)
    jacobian = bodies.contact_jacobian
    sides = jacobian(at[i], point, ways), -jacobian(at[other], point, ways)
    return i, jnp.minimum(partner, bodies.count), jnp.stack(sides, axis=2)
