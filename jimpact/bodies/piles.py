"""Piles: many discs or spheres between walls, each contact between two of them or with a wall."""

import abc
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
    BLOCK,
    CIRCLE,
    PLANAR,
    ActivePairs,
    Body,
    LinearPotential,
    as_planes,
    floors_of,
    listed_pairs,
    numbered,
    over_blocks,
    wheel,
    with_block,
)
from jimpact.bodies.neighbours import Candidates, all_pairs, crowd_of, near_pairs
from jimpact.compiling import full_precision, precise_jit
from jimpact.scene import Scene

# Contacts per body that may be closed by default, by dimension: equal discs have 3, equal spheres
# 6, and walls. Ten times more takes ten times the memory.
ROOM = {2: 4, 3: 7}

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


class Pile(Body):
    """Bodies between flat walls: d places and the turns of each, d = 2 or 3; here they are round.

    A kind of pile gives `dimension` and `tangents_of`.
    """

    masses: jax.Array
    radii: jax.Array
    turning: jax.Array  # (k,) moments of inertia
    planes: jax.Array  # (w, d + 1) unit normal, distance
    room: int = eqx.field(static=True)
    crowd: int = eqx.field(static=True)  # see `near_pairs`; 0: every pair is looked at

    dimension = 0  # d

    def __init__(self, bodies: Sequence[Any], planes: Any = None, room: int | None = None):
        self.masses = stacked([body.total_mass for body in bodies])
        self.radii = stacked([body.rim for body in bodies])
        self.turning = stacked([jnp.ravel(body.inertia)[0] for body in bodies])
        self._have_planes(planes, room, ROOM[self.dimension])

    def _have_planes(self, planes: Any, room: int | None, room_of_each: int) -> None:
        """Set the planes, the room for contacts, and whether there is a grid."""
        self.planes = as_planes(planes, self.dimension).astype(self.radii.dtype)
        self.room = room_of_each * self.count if room is None else as_whole("room", room, 1)
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
        return jnp.min(self.radii)

    @property
    def count(self) -> int:
        """Number of bodies."""
        return self.radii.shape[0]

    @property
    def mass(self) -> jax.Array:
        """M, its diagonal (n,)."""
        d = self.dimension
        each = [self.masses] * d + [self.turning] * _turns(d)
        return jnp.stack(each, axis=1).reshape(-1)

    def at(self, centres: Any) -> jax.Array:
        """q (n,) with the bodies, not turned, at these centres (k, d) [m]."""
        places = as_float_array("centres", centres)
        if places.shape != (self.count, self.dimension):
            raise ValueError(
                f"Argument `centres` must have shape ({self.count}, {self.dimension}), but has "
                f"{places.shape}."
            )
        return jnp.pad(places, ((0, 0), (0, _turns(self.dimension)))).reshape(-1)

    def gravity(self, acceleration: Any) -> LinearPotential:
        """`V = g sum m_i h_i`, h the last place: y in a plane, z in space."""
        return LinearPotential(self.mass * self.base_directions[:, -1] * acceleration)

    @property
    def base_directions(self) -> jax.Array:
        """The walls move along each axis (n, d)."""
        d, dtype = self.dimension, self.radii.dtype
        return jnp.tile(jnp.eye(d + _turns(d), d, dtype=dtype), (self.count, 1))

    def _of_bodies(self, q: jax.Array) -> jax.Array:
        """Coordinates or velocities (k, d + turns) of each body."""
        return q.reshape(self.count, -1)

    # ---- all contacts

    def gap_function(self, q: jax.Array) -> jax.Array:
        """Gaps of all pairs, then of each body with every wall."""
        first, second = np.triu_indices(self.count, 1)
        to_walls = self._wall_gaps(q).reshape(-1)
        return jnp.concatenate([self._pair_gaps(q, first, second), to_walls])

    def _pair_gaps(self, q: jax.Array, first: Any, second: Any) -> jax.Array:
        """Gaps of these pairs (C,)."""
        columns = self._of_bodies(q)[:, : self.dimension].T  # one by one: five times faster
        squares = sum((x[first] - x[second]) ** 2 for x in columns)
        return jnp.sqrt(squares) - self.radii[first] - self.radii[second]

    @full_precision
    def _wall_gaps(self, q: jax.Array) -> jax.Array:
        """Gaps (k, w) of each body with every wall."""
        d = self.dimension
        centres = self._of_bodies(q)[:, :d]
        return centres @ self.planes[:, :d].T - self.planes[None, :, d] - self.radii[:, None]

    def _at_walls(self) -> tuple[np.ndarray, np.ndarray]:
        """Bodies i and walls j of every contact with a wall; j counts walls after the bodies."""
        walls = len(self.planes)
        body, wall = np.divmod(np.arange(self.count * walls, dtype=np.int32), max(walls, 1))
        return body, self.count + wall

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
        """Every pair (i, j), in both orders, and every body with every wall."""
        return self.count * (self.count + len(self.planes))

    def _candidates(self, q: jax.Array, margin: jax.Array) -> Candidates:
        """Pairs of bodies, all those with gaps up to `margin` among them."""
        if self.crowd == 0:
            return all_pairs(self.count)
        distance = 2 * jnp.max(self.radii) + margin
        return near_pairs(self._of_bodies(q)[:, : self.dimension], distance, self.crowd)

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
        return self._pair_gaps(q, i, j)

    def _least_of_near(self, q: jax.Array, margin: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The least gap () of pairs with gaps up to `margin`; whether some are missing."""
        near = self._candidates(q, margin)
        gaps = jnp.where(near.used, self._pair_gaps(q, near.first, near.second), jnp.inf)
        return jnp.min(gaps, initial=jnp.inf), near.overflows

    def _near(self, q: jax.Array, later: jax.Array, below: jax.Array) -> Candidates:
        """Pairs of bodies, all those with gaps up to `below` at q or `later` among them."""
        way = jnp.abs(self._of_bodies(later - q)[:, : self.dimension])
        # each moves by half of its way from the middle; what moves farther is a `coarse_step`
        farther = jnp.minimum(jnp.max(jnp.sum(way, axis=1)), MARGIN * self._least)
        return self._candidates(0.5 * (q + later), below + farther)

    def _closed(
        self, q: jax.Array, later: jax.Array, below: jax.Array
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Numbers of contacts (C,), which of them are closed, and whether some are missing.

        A contact is closed whose gap is at most `below` at q or `later`.
        """
        near = self._near(q, later, below)
        gaps = [self._pair_gaps(x, near.first, near.second) for x in (q, later)]
        closed = near.used & (jnp.minimum(*gaps) <= below)
        to_walls = jnp.minimum(self._wall_gaps(q), self._wall_gaps(later)).reshape(-1)
        stride = self.count + len(self.planes)
        body, wall = self._at_walls()
        number = jnp.concatenate([near.first * stride + near.second, body * stride + wall])
        return number, jnp.concatenate([closed, to_walls <= below]), near.overflows

    def active_pairs(self, q: jax.Array, later: jax.Array, below: jax.Array) -> ActivePairs:
        """The contacts, at q, with gaps up to `below` at q or `later`."""
        numbers, closed, overflows = self._closed(q, later, below)
        rows = -(-self.room // BLOCK) * BLOCK
        so_far = jnp.cumsum(closed, dtype=jnp.int32)
        count = jnp.minimum(so_far[-1], rows)
        number = jnp.full(rows, self.pair_count, jnp.int32)
        bodies = jnp.zeros((rows, 2), jnp.int32)
        d = self.dimension
        directions = jnp.zeros((rows, d, 2, d + _turns(d)), q.dtype)

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
        """Bodies i and j (K,) of contacts of these numbers, j = `count` for walls; see `_along`."""
        i, j = jnp.divmod(number, jnp.int32(self.count + len(self.planes)))
        return i, jnp.minimum(j, self.count), self._along(q, i, j)

    def _along(self, q: jax.Array, i: jax.Array, j: jax.Array) -> jax.Array:
        """Normal and tangents (K, d, 2, d + turns) of contacts of body i with body or wall j."""
        other, bodies = jnp.minimum(j, self.count - 1), j < self.count
        # forces act at one point of both bodies, in the middle of a gap or an overlap: only so do
        # they keep the angular momentum
        half = jnp.where(bodies, 0.5 * self._pair_gaps(q, i, other), 0.0)
        first, second = self.radii[i] + half, jnp.where(bodies, self.radii[other] + half, 0.0)
        return self._directions(self._normals(q, i, other, j - self.count), first, second)

    def _normals(self, q: jax.Array, i: Any, other: Any, wall: Any) -> jax.Array:
        """Unit normals (K, d) towards body i, of a wall where its number is not negative."""
        at, d = self._of_bodies(q)[:, : self.dimension], self.dimension
        way = at[i] - at[other]
        length = jnp.sqrt(jnp.sum(way**2, axis=1, keepdims=True))
        normal = way / jnp.where(length > 0, length, 1.0)
        if len(self.planes) == 0:
            return normal
        of_wall = self.planes[jnp.maximum(wall, 0), :d]
        return jnp.where((wall >= 0)[:, None], of_wall, normal)

    def _directions(self, normal: jax.Array, first: jax.Array, second: jax.Array) -> jax.Array:
        """Normal and tangents (K, d, 2, d + turns) of both bodies with these arms (K,) [m].

        Equation: along a direction t the bodies slide at
        `(v_i - v_j) . t - (R_i omega_i + R_j omega_j) . (n x t)`; of the normal that is 0.
        """
        ways, turns = self.tangents_of(normal)
        along = jnp.concatenate([normal[:, None], ways], axis=1)
        around = jnp.pad(turns, ((0, 0), (1, 0), (0, 0)))
        both = [
            jnp.concatenate([sign * along, -arm[:, None, None] * around], axis=2)
            for sign, arm in ((1.0, first), (-1.0, second))
        ]
        return jnp.stack(both, axis=2)

    def _dense(self, directions: jax.Array, i: np.ndarray, j: np.ndarray) -> jax.Array:
        """(n, m r): r directions (m, r, 2, ..) each of contacts of body i with body or wall j."""
        (m, r), k, row = directions.shape[:2], self.count, np.arange(i.size)
        still = (j >= k)[:, None, None]
        every = jnp.zeros((m, r, k, directions.shape[3]), directions.dtype)
        every = every.at[row, :, i].add(directions[:, :, 0])
        other = jnp.where(still, 0.0, directions[:, :, 1])
        return every.at[row, :, np.minimum(j, k - 1)].add(other).reshape(m * r, -1).T

    @abc.abstractmethod
    def tangents_of(self, normal: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Tangents t (K, d - 1, d) of normals n (K, d), and `n x t` (K, d - 1, turns)."""


@precise_jit
def _active_pairs(pile: Pile, q: jax.Array, below: jax.Array) -> tuple[ActivePairs, jax.Array]:
    """The contacts that are closed at q, and the least gap."""
    return pile.active_pairs(q, q, below), pile.least_gap(q)


def stacked(numbers: Sequence[jax.Array]) -> jax.Array:
    """Numbers (k,); on the host where they are known: JAX takes long to stack thousands."""
    return jnp.stack(numbers) if is_traced(numbers) else jnp.asarray(np.array(numbers))


def _turns(d: int) -> int:
    """Number of turns of a body in a plane (1) or in space (3)."""
    return d * (d - 1) // 2


def chosen_rows(
    so_far: jax.Array, first: jax.Array, count: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Of the next block of `count` () rows: which are used, and where they are found (BLOCK,).

    `so_far` (C,) is how many have been found up to each place.
    """
    row = first + np.arange(BLOCK, dtype=np.int32)
    place = jnp.minimum(jnp.searchsorted(so_far, row + 1), so_far.size - 1)
    return row < count, place


class InPlane(Pile):
    """A pile in a plane."""

    dimension = 2

    def tangents_of(self, normal: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The normal turned by a quarter, and 1."""
        x, y = normal.T
        return jnp.stack([-y, x], axis=1)[:, None], jnp.ones_like(x)[:, None, None]

    @property
    def names(self) -> tuple[str, ...]:
        """x, y, angle of each body."""
        return numbered(PLANAR, self.count)

    @property
    def floors(self) -> list[tuple[float, float]]:
        """The walls."""
        return floors_of(self.planes)


class Discs(InPlane):
    """Discs in a plane between straight walls; q = (x, y, turn) of each in turn.

    Equation: `f = |c_i - c_j| - R_i - R_j`, and `f = n_w . c_i - d_w - R_i` at wall w; sliding
    `(v_i - v_j) . t - R_i omega_i - R_j omega_j`, t = n turned by a quarter counter-clockwise.
    As a `Scene` it has a contact for every pair, those of disc 1 first, and
    for each disc and wall, disc by disc. Motions of many discs are those of
    `simulate(method="time_stepping")`, which finds closed contacts by a grid and takes no others.

    >>> import jimpact as ji
    >>> discs = ji.Bodies([ji.Disc(0.1)] * 2, room=8)
    >>> [round(float(f), 6) for f in discs.gap_function(discs.at([[0.0, 0.1], [0.5, 0.1]]))]
    [0.3, 0.0, 0.0]
    """

    @full_precision
    def tangent_function(self, q: jax.Array) -> jax.Array:
        """Ways that the discs slide on each other and along the walls."""
        at = q.reshape(-1, 3)
        first, second = np.triu_indices(self.count, 1)
        way = at[first, :2] - at[second, :2]
        rolled = self.radii * at[:, 2]
        both = self.radii[first] + self.radii[second]
        around = both * jnp.arctan2(way[:, 1], way[:, 0]) - rolled[first] - rolled[second]
        slid = at[:, :2] @ jnp.stack([-self.planes[:, 1], self.planes[:, 0]]) - rolled[:, None]
        return jnp.concatenate([around, slid.reshape(-1)])

    def outlines(self, q: np.ndarray, point: float) -> list[np.ndarray]:
        """Circles, each with the radius that shows how far it has turned."""
        return [wheel(r, at) for r, at in zip(self.radii, q.reshape(-1, 3))]


class Spheres(Pile):
    """Spheres in space between flat walls; q = (x, y, z) and three turns of each.

    Equation: `f = |c_i - c_j| - R_i - R_j`, and `f = n_w . c_i - d_w - R_i` at wall w; sliding
    `v_i - v_j - (R_i omega_i + R_j omega_j) x n` along two tangents. A
    sphere looks the same from all sides, so no orientation is kept: turns are the integrals of the
    angular velocity omega (in the axes of space). As a `Scene` it has a contact for every pair,
    those of sphere 1 first, and for each sphere and wall; `simulate(method="time_stepping")` finds
    closed contacts by a grid and takes no others.

    Source: Ericson, Real-Time Collision Detection (2005), ch. 7.1 (the grid).

    >>> import jimpact as ji
    >>> spheres = ji.Bodies([ji.Sphere(0.1)] * 2, room=8)
    >>> q = spheres.at([[0.0, 0.0, 0.1], [0.0, 0.3, 0.5]])
    >>> [round(float(f), 6) for f in spheres.gap_function(q)]
    [0.3, 0.0, 0.4]
    """

    dimension = 3

    def tangents(self, q: jax.Array) -> jax.Array:
        """H_t (n, 2 m): two directions of sliding for each contact of the scene."""
        k = self.count
        pairs = np.triu_indices(k, 1), self._at_walls()
        i, j = (np.concatenate(each) for each in zip(*pairs))
        directions = self._along(q, jnp.asarray(i), jnp.asarray(j))[:, 1:]  # (m, 2, 2, 6)
        return self._dense(directions, i, j)

    def tangents_of(self, normal: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Two unit vectors at right angles to each normal, and to each other.

        Source: Duff et al., Building an orthonormal basis, revisited, JCGT 6 (2017).
        """
        x, y, z = normal.T
        sign = jnp.where(z >= 0, 1.0, -1.0)
        a = -1 / (sign + z)
        b = x * y * a
        t1 = jnp.stack([1 + sign * x**2 * a, sign * b, -sign * x], axis=1)
        t2 = jnp.stack([b, sign + y**2 * a, -y], axis=1)
        return jnp.stack([t1, t2], axis=1), jnp.stack([t2, -t1], axis=1)

    @property
    def names(self) -> tuple[str, ...]:
        """Place and turns of each sphere."""
        places = ("x [m]", "y [m]", "z [m]")
        return numbered((*places, "turn x [rad]", "turn y [rad]", "turn z [rad]"), self.count)

    @property
    def floors(self) -> list[tuple[float, float]]:
        """The walls that are seen edge-on from the side, along y."""
        return [
            (float(np.arctan2(-x, z)), float(d)) for x, y, z, d in np.asarray(self.planes) if y == 0
        ]

    def outlines(self, q: np.ndarray, point: float) -> list[np.ndarray]:
        """Circles, seen from the side, along y."""
        return [r * CIRCLE + at[[0, 2]] for r, at in zip(self.radii, q.reshape(-1, 6))]
