"""Bodies on planes and on each other: few with all their contacts, many by a grid."""

from collections.abc import Sequence
from typing import Any

from jimpact.bodies.assemblies import PlanarBodies
from jimpact.bodies.base import Body
from jimpact.bodies.piles import Pile
from jimpact.bodies.polygons import Cornered, Disc
from jimpact.bodies.rigid import Solid
from jimpact.bodies.solids import Sphere
from jimpact.bodies.spatial_bodies import SpatialBodies

# Bodies above which a grid finds the closed contacts, unless their `pairs` are named. Ten times
# more, and time stepping looks at thousands of pairs in each step.
FEW = 10


def Bodies(
    bodies: Sequence[Body],
    planes: Any = None,
    pairs: Sequence[Any] | None = None,
    fixed: Sequence[Body] = (),
    places: Any = (),
    room: int | None = None,
) -> PlanarBodies | SpatialBodies | Pile:
    """Bodies on planes and on each other, in the plane or in space; q holds one after the other.

    Equation: on a plane `n . x >= c` each contact point of a body has
    `f = n . (x + R c_i) - r - c`,
    round bodies `f = |x_1 - x_2| - r_1 - r_2`; a disc or sphere has its distance from a polygon or
    box; two polygons have the two contacts of the sides that face each other. Few bodies have all
    their contacts (`jimpact.bodies.assemblies`, `.spatial_bodies`: q as of each body). Many discs,
    polygons and spheres are a pile (`.piles`): a grid finds closed contacts in
    `simulate(method="time_stepping")`, `touching(q)` is the scene of those at q, and spheres keep
    three turns [rad] in the place of a quaternion. `at(centres)` gives q, not turned.

    Args:
        bodies: in the plane `Polygon`, `Block`, `Disc`, on planes only `Dimer`; in space `Box`,
            `Sphere` (their own `normal` does not count).
        planes: rows (n_x, n_y, c), in space (n_x, n_y, n_z, c) [m]; n is made a unit vector. In the
            plane also an angle a [rad], or (a, c): 0 is level, pi/2 a wall on the right. None: the
            ground; (): none.
        pairs: (i, j) of bodies, counted from 0, in contact with each other; None: all but two
            boxes.
        fixed: in space, `Box`, `Sphere` that do not move: finite walls, tables; counted after the
            others.
        places: (f, 7) where the fixed ones are.
        room: of many bodies, the largest number of closed contacts at once; given, bodies are many
            whatever their number. None: 4 a disc, 6 a polygon, 7 a sphere. Without it there are
            many from 11 on, unless `pairs` or `fixed` are given.

    Returns:
        A `Body`; `between` names the bodies of its contacts where they are few.

    Raises:
        ValueError: no bodies or contacts, planes that are not finite or have no normal, pairs that
            do not exist or of two boxes, `room` besides pairs or fixed bodies.
        TypeError: other bodies, or some in the plane and some in space.

    Source: Ericson, Real-Time Collision Detection (2005), ch. 5 and 7.

    >>> import jimpact as ji
    >>> slope = ji.Bodies([ji.Block(0.2, 0.1)], planes=[0.3])
    >>> slope.scene(slope.touching()).closed.tolist()
    [True, True, False, False]
    >>> pile = ji.Bodies([ji.Disc(0.1)] * 20, planes=[0.0, [1.0, 0.0, -0.5]])
    >>> pile.at([[0.0, 0.1 + 0.2 * i] for i in range(20)]).shape
    (60,)
    """
    bodies = tuple(bodies)
    if not bodies:
        raise ValueError("Argument `bodies` must hold one or more, but is empty.")
    named = pairs is not None or len(fixed) > 0
    if room is not None and named:
        raise ValueError("Argument `room` must be left out with `pairs` or `fixed`.")
    many = room is not None or (len(bodies) > FEW and not named)
    dimension = _pile_in(bodies) if many else 0
    if dimension:
        return Pile(bodies, dimension, planes, room)
    if room is not None:
        names = ", ".join(sorted({type(body).__name__ for body in bodies}))
        raise TypeError(f"Argument `bodies` must be discs, polygons or spheres, not {names}.")
    if isinstance(bodies[0], Solid):
        return SpatialBodies(bodies, planes, pairs, fixed, places)  # type: ignore[arg-type]
    if len(fixed):
        raise ValueError("Argument `fixed` must be left out in the plane.")
    return PlanarBodies(bodies, planes, pairs)  # type: ignore[arg-type]


def _pile_in(bodies: tuple[Body, ...]) -> int:
    """2 or 3: these bodies may be a pile in the plane or in space; 0: they may not."""
    if all(isinstance(body, Sphere) and body.is_round for body in bodies):
        return 3
    return 2 if all(isinstance(body, Cornered | Disc) for body in bodies) else 0
