"""Several bodies in space: on planes, on each other and on bodies that do not move."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import as_float_array, check_shape, check_values
from jimpact.bodies.base import LinearPotential, as_planes, lengths, numbered
from jimpact.bodies.contacts import ContactPoints, joined, on_planes, round_on_round
from jimpact.bodies.rigid import FewBodies, Solid, rotation
from jimpact.bodies.solids import Box, Sphere


class SpatialBodies(FewBodies):
    """Boxes and spheres on planes and on each other; q = 7 numbers of each, as of a `Solid`.

    Equation: on a plane each contact point of a body has `f = n . (x + R c_i) - r - d`. Two spheres
    have `f = |x_1 - x_2| - r_1 - r_2`; a sphere and a box `f = dist(x_1, box) - r_1`, to the
    nearest point of a face, an edge or a corner. Normals n are unit vectors from the second body to
    the first, `N = (n, R^T (s x n))` with the lever s of the contact from the centre of mass.
    Velocities are (x', omega) of each body. Contacts, in order: for each plane and body, its
    contact points; pairs of spheres; spheres on boxes. `between` names their bodies.

    The gap functions hold everywhere; `f < 0` inside a box is the depth below its nearest face. Two
    boxes have none: `ji.from_mujoco` finds their contacts at one instant, or at each time step.

    Args:
        bodies: `Box`, `Sphere`; their own `normal` does not count.
        planes: as of `as_planes`.
        pairs: (i, j) of bodies, counted from 0, the fixed ones after the others, in contact with
            each other; None: all of which one moves.
        fixed: `Box`, `Sphere` that do not move, or only with the base: finite walls, tables.
        places: (f, 7) where the fixed ones are.

    Raises:
        ValueError: no bodies or contacts, planes or places that are not finite, pairs
            that do not exist or of two boxes.
        TypeError: other bodies.

    Source: Ericson, Real-Time Collision Detection (2005), ch. 5.1 (nearest points).

    >>> import jimpact as ji
    >>> wall = ji.Box([0.1, 2.0, 1.0])
    >>> ball = ji.Bodies([ji.Sphere(0.1)], fixed=[wall], places=[wall.at([0.55, 0.0, 0.5])])
    >>> q = ball.at([[0.2, 0.0, 0.3]])
    >>> [round(float(f), 6) for f in ball.scene(q).gaps]  # over the ground, to the wall
    [0.2, 0.2]
    """

    range_in_words = "quaternions of length 1"

    bodies: tuple[Solid, ...]
    fixed: tuple[Solid, ...]
    planes: jax.Array  # (k, 4) unit normal, offset
    places: jax.Array  # (f, 7)
    between: tuple[tuple[int, int], ...] = eqx.field(static=True)  # bodies of contacts; plane: -1
    pairs: "_SpatialPairs" = eqx.field(static=True)

    def __init__(
        self,
        bodies: Sequence[Solid],
        planes: Any = None,
        pairs: Sequence[Any] | None = None,
        fixed: Sequence[Solid] = (),
        places: Any = (),
    ):
        self.bodies, self.fixed = tuple(bodies), tuple(fixed)
        if not self.bodies:
            raise ValueError("Argument `bodies` must hold one or more, but is empty.")
        _check_solids("bodies", self.bodies)
        _check_solids("fixed", self.fixed)
        self.planes = as_planes(planes, 3)
        self.places = as_float_array("places", places).reshape(-1, 7)
        check_shape("places", self.places, (len(self.fixed), 7), "one for each of `fixed`")
        check_values("places", self.places)
        self.pairs = _pairs((*self.bodies, *self.fixed), len(self.bodies), pairs)
        on_each_plane = [(b, -1) for b in self.owner.tolist()]
        self.between = (*on_each_plane * len(self.planes), *self.pairs.spheres, *self.pairs.boxes)
        if not self.between:
            raise ValueError("Arguments `bodies`, `planes` and `pairs` must give a contact.")

    @property
    def coordinates(self) -> int:
        """Seven of each body, with six velocities."""
        return 7 * len(self.bodies)

    def valid(self, q: jax.Array) -> jax.Array:
        """How much farther from 1 the quaternions' lengths may be ()."""
        return jnp.min(jax.vmap(self.bodies[0].valid)(q.reshape(-1, 7)))

    def moved(self, q: jax.Array, u: jax.Array) -> jax.Array:
        """Each body displaced and turned."""
        move = jax.vmap(self.bodies[0].moved)
        return move(q.reshape(-1, 7), u.reshape(-1, 6)).reshape(-1)

    def nearby(self, q: jax.Array, u: jax.Array) -> jax.Array:
        """q after the displacement u, to second order in u."""
        move = jax.vmap(self.bodies[0].nearby)
        return move(q.reshape(-1, 7), u.reshape(-1, 6)).reshape(-1)

    def inertial_force(self, q: jax.Array, v: jax.Array) -> jax.Array:
        """Those of all bodies (n,)."""
        each = zip(self.bodies, q.reshape(-1, 7), v.reshape(-1, 6))
        return jnp.concatenate([body.inertial_force(*state) for body, *state in each])

    def gravity(self, acceleration: Any) -> LinearPotential:
        """`V = g sum m_i z_i`."""
        return LinearPotential(
            jnp.concatenate([body.gravity(acceleration).weights for body in self.bodies])
        )

    def at(self, positions: Any, quaternions: Any = None) -> jax.Array:
        """q, the middles of the bodies at `positions` (b, 3) [m], by `quaternions` (b, 4)."""
        count = len(self.bodies)
        if np.shape(positions) != (count, 3):
            raise ValueError(
                f"Argument `positions` must have shape ({count}, 3), not {np.shape(positions)}."
            )
        turns = [()] * count if quaternions is None else [(e,) for e in quaternions]
        each = zip(self.bodies, positions, turns, strict=True)
        return jnp.concatenate([body.at(place, *turn) for body, place, turn in each])

    def contacts(self, q: jax.Array) -> ContactPoints:
        """Gaps, points and normals at q (7 b,); `between` says of which bodies."""
        places, parts = self._placed(q), []
        if len(self.planes):
            owner, middle = self.owner, places.centre
            arm = jnp.concatenate([body.points for body in self.bodies])
            points = middle[owner] + _times(places.turns[owner], arm)
            parts.append(on_planes(self.planes, points, places.rim[owner]))
        if self.pairs.spheres:
            i, j = np.array(self.pairs.spheres).T
            middle, rim = places.middle, places.rim
            parts.append(round_on_round(middle[i], middle[j], rim[i], rim[j]))
        if self.pairs.boxes:
            parts.append(_sphere_on_box(places, *np.array(self.pairs.boxes).T))
        return joined(parts)

    def in_axes(self, q: jax.Array, body: Any, around: jax.Array) -> jax.Array:
        """Those of the bodies."""
        turns = jax.vmap(rotation)(self.of_bodies(q)[body])
        return jnp.einsum("mkx,mxy->mky", around, turns)

    def outlines(self, q: np.ndarray, point: float) -> list[np.ndarray]:
        """Those of all bodies, the fixed ones last."""
        still = zip(self.fixed, np.asarray(self.places))
        curves = [curve for body, x in still for curve in body.outlines(x, point)]
        return super().outlines(q, point) + curves

    @property
    def names(self) -> tuple[str, ...]:
        """x, y, z and the quaternion of each body."""
        return numbered(self.bodies[0].names, len(self.bodies))

    @property
    def velocity_names(self) -> tuple[str, ...]:
        """x', y', z' and the angular velocity of each body."""
        return numbered(self.bodies[0].velocity_names, len(self.bodies))

    @property
    def floors(self) -> list[tuple[float, float]]:
        """None, as of a `Solid`."""
        return []

    def _placed(self, q: jax.Array) -> "_Placed":
        """All bodies at q, the fixed ones last."""
        every = (*self.bodies, *self.fixed)
        at = jnp.concatenate([q.reshape(-1, 7), self.places.astype(q.dtype)])
        turns = jax.vmap(rotation)(at)
        middle = at[:, :3] + _times(turns, jnp.stack([body.middle for body in every]))
        rim = jnp.stack([jnp.asarray(body.rim, q.dtype) for body in every])
        half = [0.5 * x.sizes - x.rim if isinstance(x, Box) else jnp.zeros(3) for x in every]
        return _Placed(at[:, :3], turns, middle, rim, jnp.stack(half).astype(q.dtype))


class _SpatialPairs(NamedTuple):
    """Pairs by what they are."""

    spheres: tuple[tuple[int, int], ...]  # on each other
    boxes: tuple[tuple[int, int], ...]  # a sphere on a box


class _Placed(NamedTuple):
    """Bodies where they are."""

    centre: jax.Array  # (b, 3) of mass
    turns: jax.Array  # (b, 3, 3)
    middle: jax.Array  # (b, 3) of their shapes
    rim: jax.Array  # (b,) radius of a sphere, rounding of a box
    half: jax.Array  # (b, 3) half the sizes of a box without its rounding; of a sphere 0


def _times(matrices: jax.Array, vectors: jax.Array) -> jax.Array:
    """Matrices (.., 3, 3) times vectors (.., 3)."""
    return jnp.sum(matrices * vectors[..., None, :], axis=-1)


def _sphere_on_box(places: _Placed, i: np.ndarray, j: np.ndarray) -> ContactPoints:
    """One contact for each sphere i and box j, at the nearest point of the box."""
    turns = places.turns[j]
    x = _times(jnp.swapaxes(turns, 1, 2), places.middle[i] - places.middle[j])
    distance, n = _from_box(x, places.half[j])
    normal = _times(turns, n)
    away = distance - places.rim[j]
    point = places.middle[i] - away[:, None] * normal
    return ContactPoints(away - places.rim[i], point, normal)


def _from_box(x: jax.Array, half: jax.Array) -> tuple[jax.Array, jax.Array]:
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


# ------------------------------------------------------------------------------ construction


def _check_solids(name: str, bodies: tuple[Solid, ...]) -> None:
    """Raise for what is no body in space."""
    for body in bodies:
        if not isinstance(body, (Box, Sphere)):
            raise TypeError(
                f"Argument `{name}` must hold boxes and spheres, but holds a {type(body).__name__}."
            )


def _pairs(every: tuple[Solid, ...], moving: int, pairs: Sequence[Any] | None) -> _SpatialPairs:
    """Pairs by the shapes of their bodies, of which the first `moving` ones move."""
    count = len(every)
    if pairs is None:
        pairs = [(i, j) for i in range(moving) for j in range(i + 1, count)]
    spheres: list[tuple[int, int]] = []
    boxes: list[tuple[int, int]] = []
    for pair in pairs:
        i, j = (int(x) for x in pair)
        if i == j or not (0 <= min(i, j) < moving and max(i, j) < count):
            raise ValueError(
                f"Argument `pairs` must join different bodies 0 to {count - 1}, one of which moves "
                f"(0 to {moving - 1}), but holds {pair!r}."
            )
        if isinstance(every[i], Sphere) and isinstance(every[j], Sphere):
            spheres.append((i, j))
        elif isinstance(every[i], Sphere):
            boxes.append((i, j))
        elif isinstance(every[j], Sphere):
            boxes.append((j, i))
        else:
            raise ValueError(
                f"Argument `pairs` must leave out the pair {pair!r}: two boxes have no gap "
                "function. Contacts of boxes come from `jimpact.from_mujoco`, in motion at each "
                "step (docs/mujoco.md)."
            )
    return _SpatialPairs(tuple(spheres), tuple(boxes))
