"""Convex polygons and discs over the ground, in the plane."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import as_float_array, check_shape, check_values, is_traced
from jimpact.bodies.base import inertia_of, positive, turned, wheel
from jimpact.bodies.rigid import OnGround

_CONVEX = "must be those of a convex polygon, in order around it"
_FULL_TURN = 1e-6  # [rad] rounding of the angles of a polygon; ten times more would do as well


class Cornered(OnGround):
    """A convex body with sharp corners: `corners` (k, 2) from the centre of mass, and their `ring`.

    Contacts are its `points`, by default all corners.
    """

    ring: eqx.AbstractVar[tuple[int, ...]]  # corners in counter-clockwise order

    @property
    def corners(self) -> jax.Array:
        """(k, 2) from the centre of mass [m]."""
        raise NotImplementedError(f"{type(self).__name__} must define `corners`.")

    @property
    def points(self) -> jax.Array:
        """The corners."""
        return self.corners

    def inner_radius(self) -> jax.Array:
        """Distance of the centre of mass from the nearest side [m]."""
        return _distance_to_sides(self.corners, jnp.array(self.ring))

    def outlines(self, q: np.ndarray, point: float) -> list[np.ndarray]:
        """The polygon."""
        ring = [*self.ring, self.ring[0]]
        return [turned(np.asarray(self.corners)[ring], q)]


class Polygon(Cornered):
    """A convex polygon over the ground; q = (x, y, theta) of its centre of mass.

    Equation: `f_i = y + (R(theta) c_i)_y`, c_i corner i from the centre of mass; tangents are the
    corners' positions along the ground, `x + (R(theta) c_i)_x`. One contact a corner, in the order
    given: a polygon may land on any side, and its gap function holds everywhere.

    Args:
        corners: (k, 2) around the polygon, k >= 3, in a frame of its own [m]. Traced ones must
            be in counter-clockwise order.
        mass: m > 0 [kg].
        inertia: I about the centre of mass [kg m^2]; None: homogeneous.
        centre: (2,) of mass, inside, in the frame of the corners [m]; None: homogeneous. With it
            goes an `inertia`.

    Raises:
        ValueError: corners that are not those of a convex polygon, a mass or an inertia that is not
            positive, a centre of mass that is outside or has no inertia.

    Source: areas and moments by Green's theorem.

    >>> import jimpact as ji
    >>> wedge = ji.Polygon([[0.0, 0.0], [3.0, 0.0], [0.0, 3.0]], mass=2.0)
    >>> wedge.scene(wedge.touching(0.0)).closed.tolist()
    [True, True, False]
    >>> wedge.corners[0].tolist()
    [-1.0, -1.0]
    """

    placed: jax.Array  # corners (k, 2) from the centre of mass
    total_mass: jax.Array
    inertia: jax.Array
    ring: tuple[int, ...] = eqx.field(static=True)

    def __init__(self, corners: Any, mass: Any = 1.0, inertia: Any = None, centre: Any = None):
        c = as_float_array("corners", corners)
        if c.ndim != 2 or c.shape[1] != 2 or c.shape[0] < 3:
            raise ValueError(f"Argument `corners` must have shape (k, 2), k >= 3, not {c.shape}.")
        check_values("corners", c)
        self.ring = _ring(c)
        self.total_mass = positive("mass", mass)
        middle, about_middle = _moments(c, jnp.array(self.ring))
        inertia = inertia_of(inertia, self.total_mass * about_middle, centre)
        if centre is not None:
            middle = as_float_array("centre", centre)
            check_shape("centre", middle, (2,), "a point in the frame of the corners")
            check_values("centre", middle)
        self.inertia, self.placed = positive("inertia", inertia), c - middle[None, :]
        if not is_traced(self.placed) and not (self.inner_radius() > 0):
            raise ValueError(
                f"Argument `centre` must lie inside the polygon, but has value {middle.tolist()}."
            )

    @property
    def corners(self) -> jax.Array:
        """(k, 2) from the centre of mass [m], in the order given."""
        return self.placed


class Disc(OnGround):
    """A disc over the ground; q = (x, y, theta) of its centre of mass.

    Equation: `f = y + (R(theta) c)_y - r`, c the middle of the disc from the centre of mass; its
    lowest point slides at `x' + r theta'` where c = 0.

    Args:
        radius: r > 0 [m].
        mass: m > 0 [kg].
        inertia: I about the centre of mass [kg m^2]; None: homogeneous, `m r^2 / 2`.
        centre: (2,) of mass, from the middle of the disc and within it [m]; with it goes an
            `inertia`. None: the middle.

    Raises:
        ValueError: sizes, mass or inertia not positive, a centre of mass that is outside or has no
            inertia.

    >>> import jimpact as ji
    >>> ji.Disc(0.5, mass=2.0).scene([0.0, 0.75, 0.0]).gaps.tolist()
    [0.25]
    """

    radius: jax.Array
    total_mass: jax.Array
    inertia: jax.Array
    middle: jax.Array  # (2,) from the centre of mass
    is_round: bool = eqx.field(static=True)  # the same from all sides

    def __init__(self, radius: Any, mass: Any = 1.0, inertia: Any = None, centre: Any = None):
        self.radius, self.total_mass = positive("radius", radius), positive("mass", mass)
        self.middle, self.is_round = jnp.zeros(2, self.radius.dtype), centre is None
        if centre is not None:
            self.middle = -as_float_array("centre", centre)
            check_shape("centre", self.middle, (2,), "a point from the middle of the disc")
            check_values("centre", self.middle)
            far = jnp.sqrt(jnp.sum(self.middle**2))
            check_values("centre", far, high=np.inf if is_traced(radius) else float(radius))
        inertia = inertia_of(inertia, 0.5 * self.total_mass * self.radius**2, centre)
        self.inertia = positive("inertia", inertia)

    @property
    def points(self) -> jax.Array:
        """The middle (1, 2)."""
        return self.middle[None, :]

    @property
    def rim(self) -> jax.Array:
        """The radius."""
        return self.radius

    def outlines(self, q: np.ndarray, point: float) -> list[np.ndarray]:
        """The circle, with the radius that shows how far it has turned."""
        return [wheel(self.radius, q, self.middle)]


def _cross(a: jax.Array, b: jax.Array) -> jax.Array:
    """Cross products (k,) of vectors (k, 2) in the plane."""
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _ring(corners: jax.Array) -> tuple[int, ...]:
    """Counter-clockwise order of the corners of a convex polygon."""
    k = corners.shape[0]
    if is_traced(corners):
        return tuple(range(k))
    c = np.asarray(corners, float)
    side = np.roll(c, -1, axis=0) - c
    after = np.roll(side, -1, axis=0)
    turn = np.arctan2(
        side[:, 0] * after[:, 1] - side[:, 1] * after[:, 0], np.sum(side * after, axis=1)
    )
    around = np.sign(turn.sum())
    bad = np.flatnonzero(~((turn * around > 0) & (turn * around < np.pi)))
    if bad.size:
        worst = int(bad[0] + 1) % k
        raise ValueError(
            f"Argument `corners` {_CONVEX}, but it does not turn the same way at corner {worst}, "
            f"{c[worst].tolist()}."
        )
    if abs(abs(turn.sum()) - 2 * np.pi) > _FULL_TURN:
        raise ValueError(f"Argument `corners` {_CONVEX}, but they go around it more than once.")
    return tuple(range(k)) if around > 0 else tuple(reversed(range(k)))


@jax.jit  # operation by operation JAX would compile thirty programs
def _distance_to_sides(corners: jax.Array, order: jax.Array) -> jax.Array:
    """Of the origin from the nearest side of a polygon."""
    c = corners[order]
    side = jnp.roll(c, -1, axis=0) - c
    return jnp.min(_cross(c, side) / jnp.sqrt(jnp.sum(side**2, axis=1)))


@jax.jit
def _moments(corners: jax.Array, order: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Centroid (2,), and moment of inertia about it over the mass, of a homogeneous polygon."""
    ring = corners[order]
    start = ring - ring[:1]  # about a corner: far from the origin, areas would cancel
    end = jnp.roll(start, -1, axis=0)
    twice = _cross(start, end)
    area = jnp.sum(twice)
    middle = jnp.sum((start + end) * twice[:, None], axis=0) / (3 * area)
    squares = jnp.sum(start**2 + start * end + end**2, axis=1)
    about_corner = jnp.sum(twice * squares) / (6 * area)
    return ring[0] + middle, about_corner - jnp.sum(middle**2)
