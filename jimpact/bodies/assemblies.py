"""Several planar bodies: on planes of any slope, and on each other."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact.bodies.base import as_planes, lengths, number
from jimpact.bodies.contacts import (
    ContactPoints,
    joined,
    on_planes,
    placed,
    round_on_round,
)
from jimpact.bodies.polygon_contacts import (
    FacingSides,
    disc_on_polygon,
    facing_now,
    facing_sides,
    outward,
    side_of,
)
from jimpact.bodies.polygons import Cornered, Disc
from jimpact.bodies.rigid import FewBodies, OnGround
from jimpact.compiling import full_precision

# [rad] Direction between two polygons, of which one has an odd number of sides, at which their two
# contacts change places, see `_facing`: none of the usual slopes.
_CUT = 2.0
# 1 - cos of the angle to that direction, within which they must not touch: .8 degrees. Ten times
# less, and steps of a motion may pass over it.
_NEAR_CUT = 1e-4
_TOUCHING = 1e-6  # [m] gap from which they may pass it; ten times more would do


class PlanarBodies(FewBodies):
    """Planar bodies on planes and on each other; q = (x, y, theta) of each centre of mass.

    Equation: on a plane with normal n = (-sin a, cos a), at offset d from the origin, each contact
    point of a body has `f = n . (x + R c_i) - r - d`. Two discs have `f = |x_1 - x_2| - r_1 - r_2`,
    a disc and a polygon `f = dist(x_1, polygon) - r_1`. Two polygons have the two contacts of two
    sides that face each other: at each end of the first side, the distance of its corner from the
    second side, or, if that is less, that of the second side's end from the first side; the least
    of both is the distance of the polygons. Normals are
    unit vectors n from the second body to the first, tangents (n_y, -n_x); both as rates of q.

    Contacts, in order: for each plane and body, its contact points; then the pairs of discs; discs
    on polygons, polygon by polygon; polygons, two contacts a pair.
    `between` names their bodies.

    Polygons choose their sides as they move, so that they may roll over their corners, slide off
    each other and meet again anywhere. Of two in touch, one with an odd number of sides, one with
    an even number, the normal from the first to the second must not pass 2 rad (`valid`). Gaps of
    discs hold while their centres are outside the other body. Bodies that are no pair do not feel
    each other.

    Args:
        bodies: `Polygon`, `Block`, `Disc`; `Dimer` on planes only.
        planes: as of `as_planes`; angle 0: the ground, pi/2: a wall on the right.
        pairs: (i, j) of bodies, counted from 0, in contact with each other; None: all.

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

    range_in_words = "see `PlanarBodies`: no centre of a disc in another body"

    bodies: tuple[OnGround, ...]
    planes: jax.Array  # (k, 3) unit normal, distance
    between: tuple[tuple[int, int], ...] = eqx.field(static=True)  # bodies of contacts; plane: -1
    pairs: "_Pairs" = eqx.field(static=True)

    def __init__(
        self,
        bodies: Sequence[OnGround],
        planes: Any = None,
        pairs: Sequence[Any] | None = None,
    ):
        self.bodies = tuple(bodies)
        for body in self.bodies:
            if not isinstance(body, OnGround):
                raise TypeError(
                    f"Argument `bodies` must hold planar bodies, but holds a {type(body).__name__}."
                )
        self.planes = as_planes(planes, 2)
        on_each = [(b, -1) for b in self.owner.tolist()]
        self.pairs = _sorted_pairs(self.bodies, pairs)
        self.between = (*on_each * len(self.planes), *self.pairs.between)
        if not self.between:
            raise ValueError("Arguments `bodies`, `planes` and `pairs` must give a contact.")

    def contacts(self, q: jax.Array) -> ContactPoints:
        """Gaps, points and normals at q (3 b,); `between` says of which bodies."""
        places, parts = self._places(q), []
        if self.planes.shape[0]:
            parts.append(on_planes(self.planes, places.points, places.rim[places.owner]))
        if self.pairs.discs:
            i, j = np.array(self.pairs.discs).T
            middle, rim = places.middle, places.rim
            parts.append(round_on_round(middle[i], middle[j], rim[i], rim[j]))
        parts += [_on_polygon(places, *pairs) for pairs in self.pairs.rolling]
        if self.pairs.polygons:
            parts.append(facing_sides(_facing(places, self.pairs.polygons)))
        return joined(parts)

    @full_precision
    def valid(self, q: jax.Array) -> jax.Array:
        """The least of the margins () [m], see the class."""
        places, margins = self._places(q), [super().valid(q)[None]]
        if self.pairs.discs:
            i, j = np.array(self.pairs.discs).T
            margins.append(lengths(places.middle[i] - places.middle[j])[0])
        for polygon, discs in self.pairs.rolling:
            contacts = _on_polygon(places, polygon, discs)
            margins.append(contacts.gap + places.rim[np.array(discs)])
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

    def _places(self, q: jax.Array) -> "_Places":
        """Contact points and corners at q (3 b,)."""
        at = q.reshape(-1, 3)
        owner = self.owner
        points = placed(jnp.concatenate([body.points for body in self.bodies]), at[owner])
        rim = jnp.stack([jnp.asarray(body.rim, q.dtype) for body in self.bodies])
        polygons = {
            b: placed(body.corners[np.array(body.ring)], at[b][None])
            for b, body in enumerate(self.bodies)
            if isinstance(body, Cornered)
        }
        return _Places(
            at[:, 2], owner, points, points[np.unique(owner, return_index=True)[1]], rim, polygons
        )


class _Pairs(NamedTuple):
    """Pairs by what they are."""

    discs: tuple[tuple[int, int], ...]
    rolling: tuple[tuple[int, tuple[int, ...]], ...]  # a polygon and its discs
    polygons: tuple[tuple[int, int], ...]

    @property
    def between(self) -> list[tuple[int, int]]:
        """Bodies of each contact."""
        discs = [*self.discs, *((i, polygon) for polygon, some in self.rolling for i in some)]
        return discs + [pair for pair in self.polygons for _ in (0, 1)]


class _Places(NamedTuple):
    """Bodies where they are."""

    angle: jax.Array  # (b,)
    owner: np.ndarray  # (p,) body of each contact point
    points: jax.Array  # (p, 2)
    middle: jax.Array  # (b, 2) first contact point: the middle of a disc
    rim: jax.Array  # (b,)
    polygons: dict[int, jax.Array]  # corners (k, 2), counter-clockwise


def _on_polygon(places: _Places, polygon: int, discs: tuple[int, ...]) -> ContactPoints:
    """Contacts of discs with a polygon."""
    some = np.array(discs)
    return disc_on_polygon(places.middle[some], places.rim[some], places.polygons[polygon])


def _facing(places: _Places, pairs: tuple[tuple[int, int], ...]) -> FacingSides:
    """The sides of pairs of polygons that face each other now.

    Where a body rolls over a corner, one of the sides gives way to its neighbour, which has the
    corner at its other end. The contact there keeps its place among the two because they are
    swapped where the numbers of both sides have an odd sum. An odd number of sides counts on
    through full turns, of the body and of the direction between the bodies; the latter begin anew
    at `_CUT`.
    """
    rows: list[Any] = []
    for pair in pairs:
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
    own = outward(jnp.roll(corners, -1, axis=0) - corners)
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


# ------------------------------------------------------------------------------ construction


def _sorted_pairs(bodies: tuple[OnGround, ...], pairs: Sequence[Any] | None) -> _Pairs:
    """Pairs by the shapes of their bodies."""
    if pairs is None:
        shapes = [b for b, body in enumerate(bodies) if isinstance(body, Cornered | Disc)]
        pairs = [(i, j) for i in shapes for j in shapes if i > j]
    discs: list[tuple[int, int]] = []
    rolling: dict[int, list[int]] = {}
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
        else:
            polygons.append((i, j))
    grouped = tuple((polygon, tuple(some)) for polygon, some in rolling.items())
    return _Pairs(tuple(discs), grouped, tuple(polygons))


def _body_of(body: Any, bodies: tuple[OnGround, ...]) -> int:
    """The body of this number."""
    if np.ndim(body) or not 0 <= body < len(bodies):
        raise ValueError(
            f"Argument `pairs` must hold bodies 0 to {len(bodies) - 1}, but holds {body!r}."
        )
    if not isinstance(bodies[body], Cornered | Disc):
        raise ValueError(
            f"Argument `pairs` must join polygons and discs, but body {body} is a "
            f"{type(bodies[body]).__name__}."
        )
    return int(body)
