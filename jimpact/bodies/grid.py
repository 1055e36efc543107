"""The closed contacts of many bodies, found among the pairs that a grid of cells says
are near.
"""

from typing import NamedTuple, Protocol

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

# Pairs of each body whose circles around them meet, of polygons. Ten times more takes
# ten times the memory.
NEAR = 8

# Way of a body within half a step, over the least radius, up to which the grid finds
# all contacts: what moves farther in a step than the least radius is a `coarse_step`.
# Ten times more makes cells hold twenty times more bodies.
MARGIN = 0.5

_Arrays = tuple[jax.Array, ...]


class Pile(Protocol):
    """Members of `Bodies` (see there and `RigidBodies`) that the grid uses: b bodies, w
    planes.
    """

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
        """Most bodies in a row of three cells, see `near_pairs`; 0: every pair is
        looked at.
        """

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
        """Rotation matrices, and points in space, of all bodies."""

    def placed_at(self, at: jax.Array, points: jax.Array) -> Placed:
        """The same of bodies at coordinates (b, ..), with these points (b, P, d)."""

    def contact_jacobian(
        self, at: jax.Array, point: jax.Array, directions: jax.Array
    ) -> jax.Array:
        """Velocities of points along directions, by the velocities of their bodies."""


def slots(bodies: Pile) -> int:
    """Contacts of a pair of bodies: 1 of discs or spheres; 2 of polygons, the ends of a
    side.
    """
    points = bodies.points.shape[1]
    return min(2, points)


def stride(bodies: Pile) -> int:
    """Partners b + w P of a body, by which contacts are numbered: bodies, then planes x
    points.
    """
    points = bodies.points.shape[1]
    planes = len(bodies.planes)
    return bodies.count + planes * points


def outer_radii(bodies: Pile) -> jax.Array:
    """Radii (b,) [m] of discs or balls about the centres of mass that enclose the
    bodies.

    Equation: `R = max |c| + r`, c the points of a body, r its rim.
    """
    squares = jnp.sum(bodies.points**2, axis=2)
    largest = jnp.max(squares, axis=1)
    far = jnp.sqrt(largest)
    return far + bodies.rims


def least_radius(bodies: Pile) -> jax.Array:
    """The least radius () [m] of a disc or ball about a centre of mass, within its
    body.

    Equation: `r - |c|` of a round body of radius r about its point c, of a polygon the
    distance of its nearest side.
    """
    first_points = bodies.points[:, 0]
    squares = jnp.sum(first_points**2, axis=1)
    far = jnp.sqrt(squares)
    inside = bodies.rims - far
    if slots(bodies) == 1:
        return jnp.min(inside)
    is_round = bodies.rims > 0
    of_round = jnp.where(is_round, inside, jnp.inf)
    of_polygons = inner_radii(bodies.points)
    radii = jnp.minimum(of_round, of_polygons)
    return jnp.min(radii)


def crowd_of_cells(bodies: Pile) -> int:
    """Most bodies in a row of three cells; 0: radii are traced, or all pairs are less
    work.

    A body looks for partners among `crowd` bodies in each of `rows` rows of cells, half
    of those around it, so that each pair is found once; of all pairs half as many as
    there are bodies are its own.
    """
    if is_traced((bodies.points, bodies.rims)):
        return 0
    least = float(least_radius(bodies))
    largest = float(outer_radii(bodies).max())
    d = bodies.dimension
    crowd = crowd_of(least, largest + 0.5 * MARGIN * least, d)
    # of cells in which a body looks for partners
    rows = (3 ** (d - 1) + 1) // 2
    if 2 * rows * crowd < bodies.count:
        return crowd
    return 0


def _circle_gaps(bodies: Pile, q: jax.Array, i: jax.Array, j: jax.Array) -> jax.Array:
    """Gaps `|x_i - x_j| - R_i - R_j` (C,) [m] of the discs or balls around bodies i, j
    (C,).
    """
    # one by one: five times faster
    centres = bodies.of_bodies(q)[:, : bodies.dimension]
    squares = sum((x[i] - x[j]) ** 2 for x in centres.T)
    radii = outer_radii(bodies)
    distance = jnp.sqrt(squares)
    return distance - radii[i] - radii[j]


@full_precision
def _plane_gaps(bodies: Pile, q: jax.Array) -> jax.Array:
    """Gaps `n . x - c - r` (b, w, P) [m] of all points x with all planes; infinite of
    padding.
    """
    n = bodies.planes[:, :-1]
    offset = bodies.planes[:, -1]
    placed = bodies.placed(q)
    points = placed.points[:, None]
    height = jnp.sum(points * n[None, :, None], axis=3)
    above_planes = height - offset[None, :, None]
    gap = above_planes - bodies.rims[:, None, None]
    sizes = np.array([shape.size for shape in bodies.shapes])
    number = np.arange(bodies.points.shape[1])
    unused = number[None] >= sizes[:, None]
    is_padding = unused[:, None]
    return jnp.where(is_padding, jnp.inf, gap)


def _candidates(bodies: Pile, q: jax.Array, margin: jax.Array) -> Candidates:
    """Candidates for contact: all pairs of bodies with gaps up to `margin` [m] at q,
    and others.
    """
    if bodies.crowd == 0:
        return all_pairs(bodies.count)
    radii = outer_radii(bodies)
    distance = 2 * jnp.max(radii) + margin
    centres = bodies.of_bodies(q)[:, : bodies.dimension]
    return near_pairs(centres, distance, bodies.crowd)


def _pair_contacts(
    bodies: Pile, places: jax.Array, i: jax.Array, j: jax.Array
) -> ContactPoints:
    """Contacts of bodies i and j (g,), k = `slots` a pair: gaps (g, k), points (g, k,
    d), normals.

    With one slot bodies are discs or spheres about their middles; with two polygons,
    whose corners may be round. `places` (b, ..) are the coordinates of all bodies;
    normals are towards body i.
    """
    placed = (bodies.placed_at(places[x], bodies.points[x]) for x in (i, j))
    a, b = (body.points for body in placed)
    r = bodies.rims[i]
    s = bodies.rims[j]
    if slots(bodies) > 1:
        return any_pair(a, b, r, s)
    of_discs = round_on_round(a[:, 0], b[:, 0], r, s)
    one_each = (x[:, None] for x in of_discs)
    return ContactPoints(*one_each)


def least_gap(bodies: Pile, q: jax.Array) -> jax.Array:
    """The least gap () [m] of all contacts at q.

    If bodies near each other, or planes, have one up to `MARGIN` of the least radius,
    no other pair can have less; else all pairs are tested.
    """
    numbers = np.arange(bodies.count, dtype=np.int32)
    others = jnp.asarray(numbers)
    of_planes = _plane_gaps(bodies, q)
    to_planes = jnp.min(of_planes, initial=jnp.inf)
    places = bodies.of_bodies(q)

    def of_all_pairs() -> jax.Array:
        """The least gap () of all pairs and planes, body by body: no table holds all
        pairs.
        """

        def with_one(i: jax.Array, least: jax.Array) -> jax.Array:
            """The least gap () with those of body i and every other one."""
            this = jnp.full_like(others, i)
            contacts = _pair_contacts(bodies, places, this, others)
            itself = others == i
            of_others = jnp.where(itself[:, None], jnp.inf, contacts.gap)
            return jnp.minimum(least, jnp.min(of_others))

        count = jnp.int32(bodies.count)
        return jax.lax.fori_loop(jnp.int32(0), count, with_one, to_planes)

    if bodies.crowd == 0:
        return of_all_pairs()
    margin = MARGIN * least_radius(bodies)
    near = _near_gaps(bodies, q, q, margin)
    of_near = jnp.min(near.gaps, initial=jnp.inf)
    least = jnp.minimum(of_near, to_planes)
    within = least <= margin
    sufficient = within & ~near.overflows
    return jax.lax.cond(sufficient, lambda: least, of_all_pairs)


class _NearGaps(NamedTuple):
    """Pairs of bodies that may be in contact, and their least gaps at one of two
    configurations.
    """

    first: jax.Array  # (C,) body i
    second: jax.Array  # (C,) body j
    gaps: jax.Array  # (C, slots) [m], infinite in unused rows
    overflows: jax.Array  # () whether pairs are missing


def _near_gaps(
    bodies: Pile, q: jax.Array, later: jax.Array, below: jax.Array
) -> _NearGaps:
    """All pairs of bodies with gaps up to `below` () [m] at q or at `later`, and
    others.

    Pairs from the grid are tested by the discs or balls around them; those of polygons
    that pass get the gaps of their sides, the least one at q and at `later`.
    """
    of_places = bodies.of_bodies(later - q)[:, : bodies.dimension]
    displacement = jnp.abs(of_places)
    # two bodies move by half of theirs from (q + later) / 2; larger ones are a
    # `coarse_step`
    ways = jnp.sum(displacement, axis=1)
    farthest = jnp.max(ways)
    farther = jnp.minimum(farthest, MARGIN * least_radius(bodies))
    middle = 0.5 * (q + later)
    near = _candidates(bodies, middle, below + farther)
    pair = (near.first, near.second)
    circles = [_circle_gaps(bodies, x, *pair) for x in (q, later)]
    least_of_both = jnp.minimum(*circles)
    gaps = jnp.where(near.used, least_of_both, jnp.inf)
    if all(shape.centred for shape in bodies.shapes):
        column = gaps[:, None]
        return _NearGaps(*pair, column, near.overflows)
    # pairs among the candidates 0 to c
    so_far = jnp.cumsum(gaps <= below, dtype=jnp.int32)
    rows = -(-NEAR * bodies.count // BLOCK) * BLOCK  # rounded up to whole blocks
    total = so_far[-1]
    count = jnp.minimum(total, rows)
    both_places = jnp.stack([bodies.of_bodies(x) for x in (q, later)])  # (2, b, ..)

    def fill_block(first: jax.Array, filled: _Arrays) -> _Arrays:
        """The arrays i, j, gaps with the rows of the block from row `first` on."""
        used, place = chosen_rows(so_far, first, count)
        i, j = (jnp.where(used, x[place], 0) for x in pair)

        def gaps_of(places: jax.Array) -> jax.Array:
            """Gaps (BLOCK, slots) [m] of the block's pairs at these places."""
            contacts = _pair_contacts(bodies, places, i, j)
            return contacts.gap

        both = jax.vmap(gaps_of)(both_places)
        least = jnp.min(both, axis=0)
        least = jnp.where(used[:, None], least, jnp.inf)
        return _with_blocks(filled, (i, j, least), first)

    none = jnp.zeros(rows, jnp.int32)
    count_of_slots = slots(bodies)
    unknown = jnp.full((rows, count_of_slots), jnp.inf, q.dtype)
    start: _Arrays = none, none, unknown
    i, j, gaps = over_blocks(count, fill_block, start)
    too_many = total > rows
    overflows = near.overflows | too_many
    return _NearGaps(i, j, gaps, overflows)


def _with_blocks(filled: _Arrays, blocks: _Arrays, first: jax.Array) -> _Arrays:
    """The arrays with the rows of these blocks from row `first` on."""
    pairs = zip(filled, blocks)
    return tuple(with_block(x, block, first) for x, block in pairs)


def _closed(
    bodies: Pile, q: jax.Array, later: jax.Array, below: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Numbers (C,) of contacts, True (C,) for those that are closed, and whether some
    are missing.

    A contact is closed whose gap is at most `below` () [m] at q or `later`. Its number
    is `slots (i stride + partner) + slot`, partner j of body i, or b + corner of each
    plane in turn.
    """
    near = _near_gaps(bodies, q, later, below)
    at_q = _plane_gaps(bodies, q)
    at_later = _plane_gaps(bodies, later)
    smallest = jnp.minimum(at_q, at_later)
    to_planes = smallest.reshape(-1)
    count = slots(bodies)
    partners = stride(bodies)
    slot = np.arange(count, dtype=np.int32)
    pair = near.first * partners + near.second
    of_pairs = count * pair[:, None] + slot[None]
    partner = np.arange(bodies.count, partners, dtype=np.int32)
    number = np.arange(bodies.count, dtype=np.int32)
    body = number[:, None]
    at_planes = count * (body * partners + partner)
    numbers = jnp.concatenate([of_pairs.reshape(-1), at_planes.reshape(-1)])
    to_bodies = near.gaps.reshape(-1)
    gaps = jnp.concatenate([to_bodies, to_planes])
    closed = gaps <= below
    return numbers, closed, near.overflows


def active_pairs(
    bodies: Pile, q: jax.Array, later: jax.Array, below: jax.Array
) -> ActivePairs:
    """The contacts with a gap up to `below` () [m] at coordinates q, or `later` at a
    step's end.

    Of all candidates the closed ones get the rows 0, 1, .. of arrays of fixed length,
    `bodies.room` rounded up to blocks, in the order of their numbers. Rows that are not
    used are 0, and have the number `no_contact`. It overflows where there are more than
    `bodies.room`, or the grid has no room for all pairs that are near.
    """
    numbers, closed, overflows = _closed(bodies, q, later, below)
    rows = -(-bodies.room // BLOCK) * BLOCK
    closed_up_to = jnp.cumsum(closed, dtype=jnp.int32)  # among the first k candidates
    total = closed_up_to[-1]
    count = jnp.minimum(total, rows)
    d = bodies.dimension
    # above all numbers
    no_contact = jnp.int32(slots(bodies) * bodies.count * stride(bodies))

    def fill_block(first: jax.Array, filled: _Arrays) -> _Arrays:
        """The numbers, bodies and directions with the rows of the block from row
        `first` on: those of closed contacts; beyond the last one `no_contact` and 0.
        """
        used, candidate = chosen_rows(closed_up_to, first, count)
        chosen = jnp.where(used, numbers[candidate], 0)
        i, j, directions = _bodies_and_directions(bodies, q, chosen)
        between = jnp.stack([i, j], axis=1)
        number = jnp.where(used, chosen, no_contact)
        between = jnp.where(used[:, None], between, 0)
        directions = jnp.where(used[:, None, None, None], directions, 0.0)
        return _with_blocks(filled, (number, between, directions), first)

    velocities = d + bodies.angular

    start: _Arrays = (
        jnp.full(rows, no_contact, jnp.int32),
        jnp.zeros((rows, 2), jnp.int32),
        jnp.zeros((rows, d, 2, velocities), q.dtype),
    )
    number, between, directions = over_blocks(count, fill_block, start)
    row = jnp.asarray(np.arange(rows, dtype=np.int32))
    too_many = total > bodies.room
    overflows = overflows | too_many
    reach = least_radius(bodies)
    return ActivePairs(
        number, row < count, count, between, directions, overflows, reach
    )


def _bodies_and_directions(
    bodies: Pile, q: jax.Array, number: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Bodies i and j (K,) of the contacts of these numbers (K,), and their directions
    (K, d, 2, velocities) at q.

    A number is `(i stride + partner) slots + slot`: a partner below the number of
    bodies is j, with a slot for each point of the pair; beyond, it counts the corners
    of i at each plane in turn, and j is the number of bodies. Directions are as of
    `ActivePairs`; the second one of a contact with a plane is not used.
    """
    slots_of_pair = jnp.int32(slots(bodies))
    partners = jnp.int32(stride(bodies))
    pair, slot = jnp.divmod(number, slots_of_pair)
    i, partner = jnp.divmod(pair, partners)
    # of a plane the last body, whose direction is not used
    other = jnp.minimum(partner, bodies.count - 1)
    row = np.arange(len(number))
    places = bodies.of_bodies(q)
    _, points, normals = _pair_contacts(bodies, places, i, other)
    point = points[row, slot]
    n = normals[row, slot]
    if len(bodies.planes):
        on_plane = (partner >= bodies.count)[:, None]
        number_at_planes = jnp.maximum(partner - bodies.count, 0)
        corners_of_body = jnp.int32(bodies.points.shape[1])
        plane, corner = jnp.divmod(number_at_planes, corners_of_body)
        normal = bodies.planes[plane, :-1]
        n = jnp.where(on_plane, normal, n)
        placed = bodies.placed_at(places[i], bodies.points[i])
        rim = bodies.rims[i][:, None]
        lowest = placed.points[row, corner] - rim * n
        point = jnp.where(on_plane, lowest, point)
    normal_row = n[:, None]
    tangents = tangents_of(n)
    along = jnp.concatenate([normal_row, tangents], axis=1)
    jacobian = bodies.contact_jacobian
    of_first = jacobian(places[i], point, along)
    of_second = jacobian(places[other], point, along)
    directions = jnp.stack([of_first, -of_second], axis=2)
    second = jnp.minimum(partner, bodies.count)
    return i, second, directions
