"""Piles: many discs and polygons, or spheres, between flat walls; a grid finds what touches."""

import warnings
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import (
    as_float_array,
    as_whole,
    check_concrete,
    check_shape,
    check_values,
    is_traced,
)
from jimpact.bodies.base import (
    CIRCLE,
    as_planes,
    numbered,
    turned,
    wheel,
)
from jimpact.bodies.closed_pairs import (
    BLOCK,
    ActivePairs,
    block,
    chosen_rows,
    listed_pairs,
    over_blocks,
    with_block,
)
from jimpact.bodies.contacts import Assembly, ContactPoints, placed, round_on_round, tangents_of
from jimpact.bodies.neighbours import Candidates, all_pairs, crowd_of, near_pairs
from jimpact.bodies.polygon_contacts import mixed_pairs
from jimpact.bodies.polygons import Cornered
from jimpact.compiling import full_precision, precise_jit
from jimpact.scene import Scene

# Contacts per body that may be closed by default: equal discs have 3, equal spheres 6, and walls;
# polygons two for each. Ten times more takes ten times the memory.
ROOM = {"discs": 4, "polygons": 6, "spheres": 7}

# Pairs of each body whose circles around them meet, of polygons. Ten times more takes ten times the
# memory.
NEAR = 8

# Way of a body within half a step, over the least radius, up to which the grid finds all contacts:
# what moves farther in a step than the least radius is a `coarse_step`. Ten times more makes cells
# hold twenty times more bodies.
MARGIN = 0.5

# Penetration over the least radius with which motions may start: each impact of a step leaves up
# to h v / 2. Ten times more would start with bodies in each other.
_OVERLAP = 0.1

# Gap over the least radius up to which bodies touch but for rounding. Ten times more closes gaps of
# 10 nm of bodies of a metre.
_TOUCHING = 1e-9


class Pile(Assembly):
    """Many discs and convex polygons, or spheres, between walls; q = places and turns of each.

    Equation: gaps as of `PlanarBodies` and `SpatialBodies`; a sphere looks the same from all sides,
    so that its turns are the integrals of the angular velocity in the axes of space. As a `Scene`
    it has the contacts of every pair, those of body 1 first, then body by body and wall by wall.
    With polygons there are two for each pair (with a disc the second one is always open), and one
    a corner with each wall. `simulate(method="time_stepping")` finds closed contacts by a grid and
    takes no others.

    Source: Ericson, Real-Time Collision Detection (2005), ch. 5 and 7.

    >>> import jimpact as ji
    >>> discs = ji.Bodies([ji.Disc(0.1)] * 2, room=8)
    >>> [round(float(f), 6) for f in discs.gap_function(discs.at([[0.0, 0.1], [0.5, 0.1]]))]
    [0.3, 0.0, 0.0]
    >>> pile = ji.Bodies([ji.Block(0.2, 0.1), ji.Disc(0.1)], room=8)
    >>> pile.touching([0.0, 0.05, 0.0, 0.0, 0.2, 0.0], below=1e-6).contacts
    3
    """

    masses: jax.Array  # (k,)
    turning: jax.Array  # (k,) moments of inertia
    # (k, K, d) from the centre of mass, counter-clockwise, the last one repeated; of round bodies
    # their middle
    corners: jax.Array
    rims: jax.Array  # (k,) radii of round bodies, 0 of polygons
    radii: jax.Array  # (k,) of discs or spheres about the centres of mass around the bodies
    inner: jax.Array  # (k,) of those within them
    planes: jax.Array  # (w, d + 1) unit normal, distance
    room: int = eqx.field(static=True)
    crowd: int = eqx.field(static=True)  # see `near_pairs`; 0: every pair is looked at

    def __init__(
        self, bodies: Sequence[Any], dimension: int, planes: Any = None, room: int | None = None
    ):
        self.masses = _stacked([body.total_mass for body in bodies])
        self.turning = _stacked([jnp.ravel(body.inertia)[0] for body in bodies])
        self.rims = _stacked([body.rim for body in bodies]).astype(self.masses.dtype)
        if all(not isinstance(body, Cornered) and body.is_round for body in bodies):
            self.corners = jnp.zeros((len(bodies), 1, dimension), self.rims.dtype)
            self.radii = self.inner = self.rims
            kind = "discs" if dimension == 2 else "spheres"
        else:
            check_concrete("bodies", list(bodies))
            self.corners, self.radii, self.inner = _polygons(bodies)
            kind = "polygons"
        self.planes = as_planes(planes, dimension).astype(self.radii.dtype)
        self.room = ROOM[kind] * self.count if room is None else as_whole("room", room, 1)
        self.crowd = self._crowd()

    def _crowd(self) -> int:
        """How many bodies a row of cells may hold; 0 where looking at every pair is less work."""
        if is_traced(self.radii):
            return 0
        least, largest = float(self._least), float(self.radii.max())
        crowd = crowd_of(least, largest + 0.5 * MARGIN * least, self.dimension)
        rows = (3 ** (self.dimension - 1) + 1) // 2
        return crowd if 2 * rows * crowd < self.count else 0

    @property
    def _least(self) -> jax.Array:
        """The least radius () of a disc or ball within a body."""
        return jnp.min(self.inner)

    @property
    def count(self) -> int:
        """Number of bodies."""
        return self.masses.shape[0]

    @property
    def _slots(self) -> int:
        """Contacts of a pair: at both ends of the sides of polygons that face each other."""
        return min(2, self.corners.shape[1])

    @property
    def _stride(self) -> int:
        """Partners of a body: the others, and each wall once for each corner."""
        return self.count + len(self.planes) * self.corners.shape[1]

    @property
    def mass(self) -> jax.Array:
        """M, its diagonal (n,)."""
        each = [self.masses] * self.dimension + [self.turning] * self.turns
        return jnp.stack(each, axis=1).reshape(-1)

    # ---- all contacts

    @property  # type: ignore[misc]
    def between(self) -> np.ndarray:
        """Bodies i and j (m, 2) of all contacts; j of a wall is -1."""
        pairs = np.repeat(np.stack(np.triu_indices(self.count, 1), axis=1), self._slots, axis=0)
        body = np.repeat(np.arange(self.count), self._stride - self.count)
        return np.concatenate([pairs, np.stack([body, np.full_like(body, -1)], axis=1)])

    def contacts(self, q: jax.Array) -> ContactPoints:
        """Those of all pairs, then those with walls."""
        pairs = self._pairs(q, *np.triu_indices(self.count, 1))
        gap = self._wall_gaps(q)
        n = jnp.broadcast_to(self.planes[:, None, :-1], (*gap.shape, self.dimension))
        point = self._placed(q)[:, None] - self.rims[:, None, None, None] * n
        parts = zip(pairs, (gap, point, n), ((), (self.dimension,), (self.dimension,)))
        return ContactPoints(
            *(jnp.concatenate([x.reshape(-1, *d), y.reshape(-1, *d)]) for x, y, d in parts)
        )

    def _placed(self, q: jax.Array, which: Any = slice(None)) -> jax.Array:
        """Corners or middles (g, K, d) of these bodies at q."""
        at = self.of_bodies(q)[which]
        if self._slots == 1:
            return at[:, None, : self.dimension]
        each = jax.vmap(lambda corners, at: placed(corners, at[None]))
        return each(self.corners[which], at)

    def _circle_gaps(self, q: jax.Array, first: Any, second: Any) -> jax.Array:
        """Gaps (C,) of the discs or balls around these bodies."""
        columns = self.of_bodies(q)[:, : self.dimension].T  # one by one: five times faster
        squares = sum((x[first] - x[second]) ** 2 for x in columns)
        return jnp.sqrt(squares) - self.radii[first] - self.radii[second]

    def _pairs(self, q: jax.Array, i: Any, j: Any) -> ContactPoints:
        """Contacts of each pair: gaps (g, slots), points (g, slots, d), normals from j to i."""
        a, b = self._placed(q, i), self._placed(q, j)
        apart = round_on_round(a[:, 0], b[:, 0], self.rims[i], self.rims[j])
        if self._slots == 1:
            return ContactPoints(*(x[:, None] for x in apart))
        return mixed_pairs(a, b, self.rims[i], self.rims[j], apart)

    @full_precision
    def _wall_gaps(self, q: jax.Array) -> jax.Array:
        """Gaps (k, w, K) of all corners; infinite of those that only fill a row."""
        n, offset = self.planes[:, :-1], self.planes[:, -1]
        height = jnp.einsum("kcx,wx->kwc", self._placed(q), n) - offset[None, :, None]
        again = jnp.all(self.corners[:, 1:] == self.corners[:, :-1], axis=2)
        again = jnp.pad(again, ((0, 0), (1, 0)))
        return jnp.where(again[:, None], jnp.inf, height - self.rims[:, None, None])

    # ---- closed contacts only

    def touching(self, q: Any, below: Any = None) -> Scene:
        """The contacts at q that are closed, as a scene without friction of any number of bodies.

        Only normals of two bodies each are stored, and W has few entries in a row: an impact of
        `Moreau`, `Poisson`, `LZB` or `Compliant` costs what the contacts cost. (`scene` holds all
        pairs and every gap.) Which bodies touch is compiled in: every packing compiles anew.
        `TimeStepping.contacts` has friction.

        Args:
            q: (n,), see `at`; not traced.
            below: gap >= 0 [m] up to which contacts count as closed; None: 1e-9 of the least
                radius.

        Returns:
            `Scene` of n velocities; contacts of bodies i < j first, then those with walls.

        Raises:
            ValueError: nothing touches, more than `room` do, a bad `below`, two bodies in one
                place. A warning says where bodies overlap by more than a tenth of the least radius.
        """
        q = as_float_array("q", q)
        check_concrete("q", q)
        check_shape("q", q, self.mass.shape, "one number per velocity")
        check_values("q", q)
        below = _TOUCHING * float(self._least) if below is None else below
        check_values("below", below, low=0.0)
        pairs, least = jax.device_get(_active_pairs(self, q, jnp.asarray(below, q.dtype)))
        if least < -float(self.overlap):
            warnings.warn(
                f"Argument `q` holds bodies that overlap by {-least:.3g} m; normals mean little "
                "there.",
                stacklevel=2,
            )
        if not pairs.filled:
            raise ValueError(
                f"Argument `q` must hold bodies that touch, but no gap is up to {below:g}."
            )
        if pairs.overflows:
            raise ValueError(
                f"Argument `q` must hold at most {self.room} contacts (the argument `room` of "
                "`Bodies`), but holds more."
            )
        _, _, directions, scene = listed_pairs(pairs, self.mass)
        if not directions[:, 0].any(axis=(1, 2)).all():
            raise ValueError("Argument `q` must hold bodies with different centres.")
        return scene

    @property
    def overlap(self) -> jax.Array:
        """Penetration () [m] with which a motion may start."""
        return _OVERLAP * self._least

    @property
    def pair_count(self) -> int:
        """The contacts of every pair (i, j), in both orders, and every corner with every wall."""
        return self._slots * self.count * self._stride

    def _candidates(self, q: jax.Array, margin: jax.Array) -> Candidates:
        """Pairs of bodies, all those with gaps up to `margin` among them."""
        if self.crowd == 0:
            return all_pairs(self.count)
        distance = 2 * jnp.max(self.radii) + margin
        return near_pairs(self.of_bodies(q)[:, : self.dimension], distance, self.crowd)

    def least_gap(self, q: jax.Array) -> jax.Array:
        """The least gap () [m]; of bodies that are near each other if there are any."""
        others = jnp.asarray(np.arange(self.count, dtype=np.int32))
        to_walls = jnp.min(self._wall_gaps(q), initial=jnp.inf)

        def of_all() -> jax.Array:
            """Body by body, so that no table holds all pairs."""

            def with_one(i: jax.Array, least: jax.Array) -> jax.Array:
                gaps = self._gaps_between(q, jnp.full_like(others, i), others)
                return jnp.minimum(least, jnp.min(jnp.where(others == i, jnp.inf, gaps)))

            return jax.lax.fori_loop(jnp.int32(0), jnp.int32(self.count), with_one, to_walls)

        if self.crowd == 0:
            return of_all()
        margin = MARGIN * self._least
        least, overflows = self._least_of_near(q, margin)
        least = jnp.minimum(least, to_walls)
        found = (least <= margin) & ~overflows
        return jax.lax.cond(found, lambda: least, of_all)

    def _gaps_between(self, q: jax.Array, i: jax.Array, j: jax.Array) -> jax.Array:
        """Gaps (g,) of bodies i and j."""
        return jnp.min(self._pairs(q, i, j).gap, axis=1)

    def _least_of_near(self, q: jax.Array, margin: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The least gap () of pairs with gaps up to `margin`; whether some are missing."""
        if self._slots == 1:
            near = self._candidates(q, margin)
            gaps = jnp.where(near.used, self._circle_gaps(q, near.first, near.second), jnp.inf)
            return jnp.min(gaps, initial=jnp.inf), near.overflows
        i, j, count, overflows = self._near_rows(q, q, margin)
        return jnp.min(self._gaps_of_rows([q], i, j, count)), overflows

    def _near(self, q: jax.Array, later: jax.Array, below: jax.Array) -> Candidates:
        """Pairs of bodies, all those with gaps up to `below` at q or `later` among them."""
        way = jnp.abs(self.of_bodies(later - q)[:, : self.dimension])
        # each moves by half of its way from the middle; what moves farther is a `coarse_step`
        farther = jnp.minimum(jnp.max(jnp.sum(way, axis=1)), MARGIN * self._least)
        return self._candidates(0.5 * (q + later), below + farther)

    def _near_rows(
        self, q: jax.Array, later: jax.Array, below: jax.Array
    ) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        """Bodies i and j (P,) whose circles are up to `below` apart, how many, and if some miss."""
        near = self._near(q, later, below)
        circles = [self._circle_gaps(x, near.first, near.second) for x in (q, later)]
        so_far = jnp.cumsum(near.used & (jnp.minimum(*circles) <= below), dtype=jnp.int32)
        rows = -(-NEAR * self.count // BLOCK) * BLOCK
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

        return over_blocks(count, one, jnp.full((i.size, self._slots), jnp.inf, every.dtype))

    def _closed(
        self, q: jax.Array, later: jax.Array, below: jax.Array
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Numbers of contacts (C,), which of them are closed, and whether some are missing.

        A contact is closed whose gap is at most `below` at q or `later`.
        """
        if self._slots == 1:
            i, j, used, overflows = self._near(q, later, below)
            gaps = jnp.minimum(*(self._circle_gaps(x, i, j) for x in (q, later)))
            gaps = jnp.where(used, gaps, jnp.inf)[:, None]
        else:
            i, j, count, overflows = self._near_rows(q, later, below)
            gaps = self._gaps_of_rows([q, later], i, j, count)
        to_walls = jnp.minimum(self._wall_gaps(q), self._wall_gaps(later)).reshape(-1)
        slot = np.arange(self._slots, dtype=np.int32)[None]
        number = self._slots * (i * self._stride + j)[:, None] + slot
        partner = np.arange(self.count, self._stride, dtype=np.int32)
        body = np.arange(self.count, dtype=np.int32)[:, None]
        at_walls = (self._slots * (body * self._stride + partner)).reshape(-1)
        numbers = jnp.concatenate([number.reshape(-1), at_walls])
        return numbers, jnp.concatenate([gaps.reshape(-1), to_walls]) <= below, overflows

    def active_pairs(self, q: jax.Array, later: jax.Array, below: jax.Array) -> ActivePairs:
        """The contacts, at q, with gaps up to `below` at q or `later`."""
        numbers, closed, overflows = self._closed(q, later, below)
        rows = -(-self.room // BLOCK) * BLOCK
        so_far = jnp.cumsum(closed, dtype=jnp.int32)
        count = jnp.minimum(so_far[-1], rows)
        number = jnp.full(rows, self.pair_count, jnp.int32)
        bodies = jnp.zeros((rows, 2), jnp.int32)
        d = self.dimension
        directions = jnp.zeros((rows, d, 2, d + self.turns), q.dtype)

        def one(first: jax.Array, filled: Any) -> Any:
            """The next rows."""
            used, chosen = chosen_rows(so_far, first, count)
            chosen = jnp.where(used, numbers[chosen], 0)
            i, j, ways = self._of_contacts(q, chosen)
            new = (
                jnp.where(used, chosen, self.pair_count),
                jnp.where(used[:, None], jnp.stack([i, j], axis=1), 0),
                jnp.where(used[:, None, None, None], ways, 0.0),
            )
            return tuple(with_block(x, part, first) for x, part in zip(filled, new))

        number, bodies, directions = over_blocks(count, one, (number, bodies, directions))
        return ActivePairs(
            number,
            jnp.asarray(np.arange(rows, dtype=np.int32)) < count,
            count,
            bodies,
            directions,
            overflows | (so_far[-1] > self.room),
            self._least,
        )

    def _of_contacts(
        self, q: jax.Array, number: jax.Array
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Bodies i and j (K,) of contacts of these numbers, j = `count` for walls; directions."""
        pair, slot = jnp.divmod(number, jnp.int32(self._slots))
        i, partner = jnp.divmod(pair, jnp.int32(self._stride))
        other, row = jnp.minimum(partner, self.count - 1), np.arange(len(number))
        _, points, normals = self._pairs(q, i, other)
        point, n = points[row, slot], normals[row, slot]
        if len(self.planes):
            at_wall = (partner >= self.count)[:, None]
            wall, corner = jnp.divmod(
                jnp.maximum(partner - self.count, 0), jnp.int32(self.corners.shape[1])
            )
            n = jnp.where(at_wall, self.planes[wall, :-1], n)
            on_wall = self._placed(q, i)[row, corner] - self.rims[i][:, None] * n
            point = jnp.where(at_wall, on_wall, point)
        ways = jnp.concatenate([n[:, None], tangents_of(n)], axis=1)
        directions = self.directions(q, point, ways, i, other)
        return i, jnp.minimum(partner, self.count), directions

    # ---- pictures

    @property
    def names(self) -> tuple[str, ...]:
        """Place and turns of each body."""
        if self.dimension == 2:
            return super().names
        places = ("x [m]", "y [m]", "z [m]")
        return numbered((*places, "turn x [rad]", "turn y [rad]", "turn z [rad]"), self.count)

    @property
    def floors(self) -> list[tuple[float, float]]:
        """The walls; in space those that are seen edge-on from the side, along y."""
        if self.dimension == 2:
            return super().floors
        return [
            (float(np.arctan2(-x, z)), float(d)) for x, y, z, d in np.asarray(self.planes) if y == 0
        ]

    def outlines(self, q: np.ndarray, point: float) -> list[np.ndarray]:
        """Polygons, circles with the radius that shows how far they turned, spheres along y."""
        bodies = np.reshape(q, (self.count, -1))
        if self.dimension == 3:
            return [r * CIRCLE + at[[0, 2]] for r, at in zip(self.radii, bodies)]
        corners, rims = np.asarray(self.corners), np.asarray(self.rims)
        return [
            wheel(rim, at, own[0]) if rim > 0 else turned(np.concatenate([own, own[:1]]), at)
            for own, rim, at in zip(corners, rims, bodies)
        ]


@precise_jit
def _active_pairs(pile: Pile, q: jax.Array, below: jax.Array) -> tuple[ActivePairs, jax.Array]:
    """The contacts that are closed at q, and the least gap."""
    return pile.active_pairs(q, q, below), pile.least_gap(q)


def _stacked(numbers: Sequence[jax.Array]) -> jax.Array:
    """Numbers (k,); on the host where they are known: JAX takes long to stack thousands."""
    return jnp.stack(numbers) if is_traced(numbers) else jnp.asarray(np.array(numbers))


def _polygons(bodies: Sequence[Any]) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Corners (k, K, 2) of polygons and middles of discs, radii (k,) around and within them."""
    rings = [
        np.asarray(x.corners)[np.array(x.ring)] if isinstance(x, Cornered) else np.asarray(x.points)
        for x in bodies
    ]
    most = max(map(len, rings))
    padded = [np.pad(ring, ((0, most - len(ring)), (0, 0)), mode="edge") for ring in rings]
    corners = np.stack(padded)
    far = np.linalg.norm(corners, axis=2)
    rims = np.array([float(body.rim) for body in bodies], corners.dtype)
    inner = [
        float(body.inner_radius()) if isinstance(body, Cornered) else rim - r[0]
        for body, rim, r in zip(bodies, rims, far)
    ]
    radii = far.max(axis=1) + rims
    return jnp.asarray(corners), jnp.asarray(radii), jnp.asarray(np.array(inner, corners.dtype))
