"""Bodies on planes and on each other: few with all their contacts, many by a grid."""

import warnings
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact.bodies import grid
from jimpact.bodies.base import as_planes, lengths, number
from jimpact.bodies.closed_pairs import ActivePairs, listed_pairs
from jimpact.bodies.distances import (
    changed_places,
    disc_on_polygon,
    facing_sides,
    from_box,
    margin_of_places,
    polygon_on_polygon,
    round_on_round,
)
from jimpact.bodies.rigid import (
    ContactPoints,
    Placed,
    RigidBodies,
    RigidBody,
    Shape,
    quaternion_of,
    times,
    unit_quaternion,
)
from jimpact.core.scene import Scene
from jimpact.tools.checks import (
    as_float_array,
    as_whole,
    check_choice,
    check_concrete,
    check_shape,
    check_values,
    is_traced,
)
from jimpact.tools.compiling import full_precision, precise_jit

# Bodies above which a grid finds the closed contacts, unless their `pairs` are named.
# Ten times more, and time stepping looks at thousands of pairs in each step.
FEW = 10

# Contacts per body that may be closed by default: equal discs have 3, equal spheres 6,
# and walls; polygons two for each. Ten times more takes ten times the memory.
ROOM = {"discs": 4, "polygons": 6, "spheres": 7}

# Penetration over the least radius with which motions may start: each impact of a step
# leaves up to h v / 2. Ten times more would start with bodies in each other.
_OVERLAP = 0.1

# Gap over the least radius up to which bodies touch but for rounding. Ten times more
# closes gaps of 10 nm of bodies of a metre.
_TOUCHING = 1e-9


class Bodies(RigidBodies):
    """Bodies on planes and on each other, in plane or space, one after the other.

    Equation: on a plane `n . x >= c` each contact point of a body has
    `f = n . (x + R c_i) - r - c`,
    round bodies `f = |x_1 - x_2| - r_1 - r_2`; a disc or sphere has its distance from a
    polygon or box. Two polygons have the two contacts of two sides that face each
    other: at each end of the first side, the distance of its corner from the second
    side, or, if that is less, that of the second side's end from the first side; the
    least of both is the distance of the polygons. Normals are unit vectors n from the
    second body to the first one, in the plane tangents are (n_y, -n_x); both as rates
    of q. Contacts, in order: for each plane and body, its contact points; then pairs of
    round bodies; round ones on those with faces; polygons, two contacts a pair.
    `between` names their bodies.

    Few bodies have all their contacts. Polygons choose their sides as they move, so
    that they may roll over their corners, slide off each other and meet again anywhere.
    Of two in touch, one with an odd number of sides, one with an even number, the
    normal from the first to the second must not pass 2 rad (`valid`). In the plane gaps
    of discs hold while their centres are outside other bodies; inside a box `f < 0` is
    the depth below its nearest face. Bodies that are no pair do not feel each other.

    Many discs, polygons and spheres are a pile: a grid finds closed contacts in
    `simulate(method="time_stepping")`, `closed_scene(q)` is the scene of those at q,
    and spheres keep three turns [rad] in the place of a quaternion, in the axes of
    space. `at(positions)` gives q, not turned.

    Args:
        bodies: in the plane `Polygon`, `Block`, `Disc`, on planes only `Dimer`; in
            space `Box`, `Sphere`, on planes only `SpatialDimer` and a `Coin` with
            corners (their own `normal` does not count).
        planes: rows (n_x, n_y, c), in space (n_x, n_y, n_z, c) [m]; n is made a unit
            vector. In the plane also an angle a [rad], or (a, c): 0 is level, pi/2 a
            wall on the right. None: the ground; (): none.
        pairs: (i, j) of bodies, counted from 0, the fixed ones after the others, in
            contact with each other; None: all of which one moves. Two boxes have no gap
            function: `from_mujoco` finds their contacts at one instant, or at each time
            step.
        fixed: bodies that do not move, or only with the base: finite walls, tables.
        places: q of each fixed one, a row each.
        room: of many bodies, the largest number of closed contacts at once; given,
            bodies are many whatever their number. None: 4 a disc, 6 a polygon, 7 a
            sphere. Without it there are many from 11 on, unless `pairs` or `fixed` are
            given.

    Raises:
        ValueError: no bodies or contacts, planes or places that are not finite, planes
            without a normal, pairs that do not exist or of two boxes, `room` besides
            pairs or fixed bodies.
        TypeError: other bodies, or some in the plane and some in space.

    Source: Ericson, Real-Time Collision Detection (2005), ch. 5 (nearest points,
    separating axes) and 7 (grids).

    >>> import jimpact as ji
    >>> slope = ji.Bodies([ji.Block(0.2, 0.1)], planes=[0.3])
    >>> slope.scene(slope.touching()).closed.tolist()
    [True, True, False, False]
    >>> stack = ji.Bodies([ji.Block(1.0, 1.0), ji.Block(1.0, 1.0)])
    >>> stack.scene([0.0, 0.5, 0.0, 0.3, 1.5, 0.0]).gaps[-2:].tolist()
    [0.0, 0.0]
    >>> wall = ji.Box([0.1, 2.0, 1.0])
    >>> ball = ji.Bodies(
    ...     [ji.Sphere(0.1)], fixed=[wall], places=[wall.at([0.55, 0.0, 0.5])]
    ... )
    >>> q = ball.at([[0.2, 0.0, 0.3]])
    >>> [round(float(f), 6) for f in ball.scene(q).gaps]  # over the ground, to the wall
    [0.2, 0.2]
    >>> pile = ji.Bodies([ji.Disc(0.1)] * 20, planes=[0.0, [1.0, 0.0, -0.5]])
    >>> q = pile.at([[0.0, 0.1 + 0.2 * i] for i in range(20)])
    >>> pile.closed_scene(q).contacts
    20
    """

    places: jax.Array  # (f, ..) coordinates of the fixed bodies
    # None: by the grid
    pairs: tuple[tuple[int, int], ...] | None = eqx.field(static=True)
    room: int = eqx.field(static=True)  # 0 of few
    crowd: int = eqx.field(static=True)  # see `near_pairs`; 0: every pair is looked at

    def __init__(
        self,
        bodies: Sequence[RigidBody],
        planes: Any = None,
        pairs: Sequence[Any] | None = None,
        fixed: Sequence[RigidBody] = (),
        places: Any = (),
        room: int | None = None,
    ):
        """Check the arguments, stack the arrays of all bodies, and choose the pairs or
        the grid.
        """
        bodies = _as_list("bodies", bodies)
        fixed = _as_list("fixed", fixed)
        every = (*bodies, *fixed)
        if not bodies:
            raise ValueError("Argument `bodies` must hold one or more, but is empty.")
        _check_kinds(bodies, fixed)
        d = bodies[0].dimension
        named = pairs is not None or len(fixed) > 0
        if room is not None and named:
            raise ValueError(
                "Argument `room` must be left out with `pairs` or `fixed`."
            )
        self.shapes = tuple(body.shapes[0] for body in every)
        asked = room is not None or len(bodies) > FEW
        many = asked and not named and self._may_be_many(d)
        if room is not None and not many:
            classes = {type(body).__name__ for body in bodies}
            names = ", ".join(sorted(classes))
            raise TypeError(
                f"Argument `bodies` must be discs, polygons or spheres, not {names}."
            )
        self.masses = _stacked([body.masses[0] for body in bodies])
        inertias = [body.inertias[0] for body in bodies]
        self.inertias = _stacked(_alike(inertias))
        points = _padded(every)
        self.points = _stacked(points)
        self.rims = _stacked([body.rims[0] for body in every])
        of_planes = as_planes(planes, d)
        self.planes = of_planes.astype(self.points.dtype)
        self.room = 0
        self.pairs = None
        self.crowd = 0
        entries = 3 if d == 2 else 7
        of_fixed = as_float_array("places", places)
        self.places = of_fixed.reshape(-1, entries)
        if many:
            if room is None:
                self.room = self._usual_room(d)
            else:
                self.room = as_whole("room", room, 1)
            self.crowd = grid.crowd_of_cells(self)
            return
        _check_places(self.places, len(fixed), d)
        self.pairs = _as_pairs(every, self.shapes, len(bodies), d, pairs)
        if not len(self.pairs_in_contact()):
            raise ValueError(
                "Arguments `bodies`, `planes` and `pairs` must give a contact."
            )

    def _may_be_many(self, d: int) -> bool:
        """True if the grid can find their contacts: discs and polygons, or centred
        spheres.
        """
        if d == 3:
            return all(shape.centred for shape in self.shapes)
        return all(shape.faces or shape.is_round for shape in self.shapes)

    def _usual_room(self, d: int) -> int:
        """Contacts that may be closed at once, where the argument `room` is None."""
        _, points, _ = self.points.shape
        if d == 3:
            kind = "spheres"
        elif points == 1:
            kind = "discs"
        else:
            kind = "polygons"
        return ROOM[kind] * self.count

    @property
    def quaternions(self) -> bool:
        """In space, unless they are many."""
        return self.dimension == 3 and not self.room

    # ---- all contacts

    @property
    def _kinds(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pairs (g, 2) of bodies in contact by kind: two round ones; a round one first
        and one with faces (polygon, box); two with faces.
        """
        if self.pairs is None:
            every_pair = np.triu_indices(self.count, 1)
            all_pairs = np.stack(every_pair, axis=1).astype(np.int32)
        else:
            pairs = np.array(self.pairs, np.int32)
            all_pairs = pairs.reshape(-1, 2)
        round_bodies = np.array([shape.is_round for shape in self.shapes])
        if round_bodies.all():  # of thousands there are millions of pairs
            none = all_pairs[:0]
            return all_pairs, none, none
        is_round = round_bodies[all_pairs]
        rounds = is_round.sum(axis=1)
        one_round = rounds == 1
        mixed = all_pairs[one_round]
        first_is_round, _ = is_round[one_round].T
        swapped = mixed[:, ::-1]
        mixed = np.where(first_is_round[:, None], mixed, swapped)
        both_round = all_pairs[rounds == 2]
        both_faces = all_pairs[rounds == 0]
        return both_round, mixed, both_faces

    def pairs_in_contact(self) -> np.ndarray:
        """Bodies i and j (m, 2) of each contact; j of a plane is -1."""
        discs, mixed, faces = self._kinds
        two_each = np.repeat(faces, 2, axis=0)
        on_planes = super().pairs_in_contact()
        return np.concatenate([on_planes, discs, mixed, two_each])

    def all_bodies(self, q: jax.Array) -> jax.Array:
        """Coordinates (b, ..) of each body, the fixed ones last."""
        if not len(self.places):
            return self.of_bodies(q)
        moving = self.of_bodies(q)
        places = self.places.astype(q.dtype)
        return jnp.concatenate([moving, places])

    def contacts(self, q: jax.Array) -> ContactPoints:
        """Gaps (m,), points and normals (m, ..) at q, in the order of
        `pairs_in_contact`: with planes, of two round bodies, of a round one and one
        with faces, and two of each pair with faces.
        """
        placed = self.placed(q)
        rims = self.rims
        points = placed.points
        parts = [self.on_planes(points)]
        discs, mixed, faces = self._kinds
        if len(discs):
            i, j = discs.T
            first = points[i, 0]
            second = points[j, 0]
            discs_in_contact = round_on_round(first, second, rims[i], rims[j])
            parts.append(discs_in_contact)
        if len(mixed):
            i, j = mixed.T
            parts.append(self._round_on_faces(placed, i, j))
        if len(faces):
            i, j = faces.T
            a = points[i]
            b = points[j]
            facing = facing_sides(*jax.lax.stop_gradient((a, b)))  # indices of sides
            counts = self._counts
            coordinates = self.all_bodies(q)  # (x, y, theta) of discs and polygons
            theta = coordinates[:, -1]
            angles = (theta[i], theta[j])
            sizes = (counts[i], counts[j])
            # which of the two contacts of a pair comes first, so that one keeps its
            # place where a body rolls over a corner and another side faces the other
            # body
            swapped = changed_places((a, b), angles, sizes, facing)
            two_each = polygon_on_polygon(a, b, facing, swapped)  # (g, 2, ..)
            flat = (x.reshape(-1, *x.shape[2:]) for x in two_each)
            parts.append(ContactPoints(*flat))
        whole = (jnp.concatenate(rows) for rows in zip(*parts))
        return ContactPoints(*whole)

    @property
    def _counts(self) -> np.ndarray:
        """Points (b,) of each body."""
        return np.array([shape.size for shape in self.shapes])

    def _round_on_faces(
        self, placed: Placed, i: np.ndarray, j: np.ndarray
    ) -> ContactPoints:
        """Contacts (g,) of discs i with polygons j, in space of spheres i with boxes j.

        A box is rounded by its rim r_j, a sphere has the radius r_i:
        `f = d - r_j - r_i`, d the distance of the sphere's middle from the box of the
        points.
        """
        points = placed.points
        turns = placed.turns
        rims = self.rims
        p = points[i, 0]
        if self.dimension == 2:
            return disc_on_polygon(p, rims[i], points[j])
        turn = turns[j]
        middle = 0.5 * (points[j, 0] + points[j, -1])
        corners = self.points[j]
        diagonal = corners[:, -1] - corners[:, 0]
        half = 0.5 * diagonal  # sizes of the boxes
        # in their axes
        to_axes = jnp.swapaxes(turn, 1, 2)
        from_middle = times(to_axes, p - middle)
        distance, n = from_box(from_middle, half)
        normal = times(turn, n)
        away = distance - rims[j]
        point = p - away[:, None] * normal
        return ContactPoints(away - rims[i], point, normal)

    @full_precision
    def valid(self, q: jax.Array) -> jax.Array:
        """The least margin (): >= 0 where the gap function holds at q, see the class.

        In the plane margins are distances [m] of the centres of discs from each other
        and from polygons, and `margin_of_places`. Many bodies, and bodies in space,
        have none of these.
        """
        margin = super().valid(q)
        if self.room or self.dimension == 3:
            return margin
        placed = self.placed(q)
        margins = [margin[None]]
        points = placed.points
        discs, mixed, faces = self._kinds
        if len(discs):
            i, j = discs.T
            apart = points[i, 0] - points[j, 0]
            distance, _ = lengths(apart)
            margins.append(distance)
        if len(mixed):
            discs_of_mixed, polygons = mixed.T
            contacts = self._round_on_faces(placed, discs_of_mixed, polygons)
            margins.append(contacts.gap + self.rims[discs_of_mixed])
        corners = self._counts[faces].sum(axis=1)
        odd = corners % 2 == 1
        if odd.any():
            i, j = faces[odd].T
            a = points[i]
            b = points[j]
            facing = facing_sides(a, b)
            margins.append(margin_of_places((a, b), facing))
        all_margins = jnp.concatenate(margins)
        return jnp.min(all_margins)

    @property
    def range_in_words(self) -> str:  # type: ignore[override]
        """The condition `valid(q) >= 0` in words, for errors."""
        if self.dimension == 3:
            return super().range_in_words
        return "see `Bodies`: no centre of a disc in another body"

    def touching(
        self, angle: Any = 0.0, along: Any = 0.0, body: int = 0, plane: int = 0
    ) -> jax.Array:
        """(x, y, theta) of one body that touches one plane, turned by `angle` [rad]
        against it.

        Its centre of mass is at the distance `along` [m] from the foot of the origin on
        the plane.
        """
        if self.dimension == 3 or not len(self.planes):
            raise TypeError(
                "Bodies in space or without planes have no `touching`: give `q` "
                "yourself, see `at`."
            )
        check_choice("body", body, range(self.count))
        check_choice("plane", plane, range(len(self.planes)))
        turn = number("angle", angle)
        distance = number("along", along)
        n_x, n_y, offset = self.planes[plane]
        # heights of its points over the centre of mass, along the normal
        x, y = self.points[body].T
        heights = jnp.sin(turn) * x + jnp.cos(turn) * y
        lowest = jnp.min(heights)
        up = offset + self.rims[body] - lowest
        place_x = n_y * distance + n_x * up
        place_y = n_y * up - n_x * distance
        inclination = jnp.arctan2(-n_x, n_y)
        theta = turn + inclination
        return jnp.stack([place_x, place_y, theta])

    # ---- many bodies: closed contacts only

    @property
    def pair_count(self) -> int | None:
        """Number of contacts of pairs (i, j), in both orders, and of corners with
        planes.
        """
        if self.room:
            of_body = grid.slots(self) * self.count
            return of_body * grid.stride(self)
        return None

    @property
    def overlap(self) -> Any:
        """Penetration () [m] with which a motion may start."""
        if self.room:
            return _OVERLAP * grid.least_radius(self)
        return 0.0

    def active_pairs(
        self, q: jax.Array, later: jax.Array, below: jax.Array
    ) -> ActivePairs:
        """The contacts, at q, with gaps up to `below` () [m] at q or `later`."""
        return grid.active_pairs(self, q, later, below)

    def least_gap(self, q: jax.Array) -> jax.Array:
        """The least gap () [m]; of many, of bodies that are near each other if there
        are any.
        """
        if self.room:
            return grid.least_gap(self, q)
        return super().least_gap(q)

    def closed_scene(self, q: Any, below: Any = None) -> Scene:
        """The contacts of many bodies at q that are closed, as a scene without
        friction.

        Only normals of two bodies each are stored, and W has few entries in a row: an
        impact of `Moreau`, `Poisson`, `LZB` or `Compliant` costs what the contacts
        cost. (`scene` holds all pairs and every gap.) Which bodies touch is compiled
        in: every packing compiles anew. `TimeStepping.contacts` has friction.

        Args:
            q: (n,), see `at`; not traced.
            below: gap >= 0 [m] up to which contacts count as closed; None: 1e-9 of the
                least radius.

        Returns:
            `Scene` of n velocities; contacts of bodies i < j first, then those with
            planes.

        Raises:
            ValueError: nothing touches, more than `room` do, a bad `below`, two bodies
                in one place. A warning says where bodies overlap by more than a tenth
                of the least radius.
            TypeError: few bodies, which have `scene`.
        """
        if not self.room:
            raise TypeError(
                "Few bodies have no `closed_scene`: take `scene`, or give `room`."
            )
        q = as_float_array("q", q)
        check_concrete("q", q)
        check_shape("q", q, self.mass.shape, "one number per velocity")
        check_values("q", q)
        if below is None:
            radius = float(grid.least_radius(self))
            below = _TOUCHING * radius
        check_values("below", below, low=0.0)
        closed_below = jnp.asarray(below, q.dtype)
        pairs, least = jax.device_get(_active_pairs(self, q, closed_below))
        if least < -float(self.overlap):
            warnings.warn(
                f"Argument `q` holds bodies that overlap by {-least:.3g} m; normals "
                f"mean little there.",
                stacklevel=2,
            )
        if not pairs.filled:
            raise ValueError(
                f"Argument `q` must hold bodies that touch, but no gap is up to "
                f"{below:g}."
            )
        if pairs.overflows:
            raise ValueError(
                f"Argument `q` must hold at most {self.room} contacts (the argument "
                f"`room` of `Bodies`), but holds more."
            )
        listed = listed_pairs(pairs, self.mass)
        normals = listed.directions[:, 0]
        moves = normals.any(axis=(1, 2))
        if not moves.all():
            raise ValueError("Argument `q` must hold bodies with different centres.")
        return listed.scene


@precise_jit
def _active_pairs(
    bodies: Bodies, q: jax.Array, below: jax.Array
) -> tuple[ActivePairs, jax.Array]:
    """The contacts with gaps up to `below` () [m] at q, and the least gap () [m]."""
    closed = bodies.active_pairs(q, q, below)
    return closed, bodies.least_gap(q)


def _as_list(name: str, bodies: Any) -> tuple[Any, ...]:
    """The bodies of an argument; a TypeError for what is no list."""
    if not np.iterable(bodies):
        raise TypeError(
            f"Argument `{name}` must be a list of bodies, but is {bodies!r}."
        )
    return tuple(bodies)


def _check_places(places: jax.Array, fixed: int, d: int) -> None:
    """Raise a ValueError unless there is a place for each of the `fixed` bodies, in
    space with a unit quaternion.
    """
    _, entries = places.shape
    check_shape("places", places, (fixed, entries), "one for each of `fixed`")
    check_values("places", places)
    if d == 3:
        for place in places:
            unit_quaternion(quaternion_of(place))


# ------------------------------------------------------------------------------
# construction


def _stacked(rows: Sequence[jax.Array]) -> jax.Array:
    """Arrays of one shape; on the host where they are known: JAX takes long to stack
    thousands.
    """
    if is_traced(rows):
        return jnp.stack(rows)
    return jnp.asarray(np.array(rows))


def _alike(inertias: Sequence[jax.Array]) -> list[jax.Array]:
    """Moments of inertia, all of them matrices if one is."""
    dimensions = {inertia.ndim for inertia in inertias}
    if len(dimensions) == 1:
        return list(inertias)
    return [jnp.diag(x) if x.ndim == 1 else x for x in inertias]


def _padded(bodies: Sequence[RigidBody]) -> list[Any]:
    """Points (P, d) [m] of each body, its last one repeated up to the largest number
    P.
    """
    points = [body.points[0] for body in bodies]
    numpy: Any = jnp if is_traced(points) else np
    largest = max(map(len, points))

    def padded(p: jax.Array) -> Any:
        """Points (P, d) of one body."""
        missing = largest - len(p)
        return numpy.pad(p, ((0, missing), (0, 0)), mode="edge")

    return list(map(padded, points))


def _check_kinds(bodies: tuple[Any, ...], fixed: tuple[Any, ...]) -> None:
    """Raise a TypeError for entries without contact points, or of another dimension
    than others.
    """
    for name, some in (("bodies", bodies), ("fixed", fixed)):
        for body in some:
            kind = type(body).__name__
            if not isinstance(body, RigidBody):
                raise TypeError(
                    f"Argument `{name}` must hold bodies with contact points "
                    f"(`RigidBody`), but holds one of type {kind}."
                )
            if body.dimension != bodies[0].dimension:
                raise TypeError(
                    f"Argument `{name}` must hold planar bodies, or bodies in space "
                    f"only, but holds a {kind}."
                )
            if not body.points.shape[1]:
                raise TypeError(
                    f"Argument `{name}` must hold bodies with contact points, but "
                    f"holds a {kind} with round rims: give it `corners`."
                )


def _joins(pair: Any, count: int, moving: int) -> bool:
    """True for the indices of two of `count` bodies, one of them of the first `moving`
    ones, which move.
    """
    if np.shape(pair) != (2,) or not all(hasattr(i, "__index__") for i in pair):
        return False
    first, second = sorted(pair)
    return 0 <= first < moving and first < second < count


def _as_pairs(
    every: tuple[RigidBody, ...],
    shapes: Sequence[Shape],
    moving: int,
    d: int,
    pairs: Sequence[Any] | None,
) -> tuple[tuple[int, int], ...]:
    """Pairs (i, j) of bodies that have a gap function: both have faces or are round.

    Raise a ValueError for a pair that does not join two bodies one of which moves
    (`_joins`), for one with another body, such as a dimer, and for two boxes in
    space.

    Args:
        every: bodies, the first `moving` ones of which move, others are fixed.
        shapes: their shapes.
        moving: number of bodies that move.
        d: 2 or 3, in the plane or in space.
        pairs: the argument of `Bodies`; None: all pairs one of which moves, of bodies
            that have faces or are round; others are left out.
    """
    count = len(every)
    has_gap = [bool(shape.faces) or shape.is_round for shape in shapes]
    if pairs is None:
        ready = [i for i in range(count) if has_gap[i]]
        ready_pairs = [(i, j) for i in ready for j in ready]
        pairs = [(i, j) for i, j in ready_pairs if i < j and i < moving]
    for pair in pairs:
        if not _joins(pair, count, moving):
            if count > moving:
                fixed = f", one of which moves (0 to {moving - 1})"
            else:
                fixed = ""
            raise ValueError(
                f"Argument `pairs` must join different bodies, bodies 0 to "
                f"{count - 1}{fixed}, but holds {pair!r}."
            )
        for i in pair:
            if not has_gap[i]:
                raise ValueError(
                    f"Argument `pairs` must join discs, polygons, spheres and boxes, "
                    f"but body {i} is a {type(every[i]).__name__}."
                )
        if d == 3 and all(shapes[i].faces for i in pair):
            raise ValueError(
                f"Argument `pairs` must leave out the pair {tuple(pair)!r}: two boxes "
                f"have no gap function. Contacts of boxes come from "
                f"`jimpact.from_mujoco`, in motion at each step (docs/mujoco.md)."
            )
    return tuple((int(i), int(j)) for i, j in pairs)
