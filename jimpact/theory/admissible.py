"""All outcomes of an impact that mechanics allows, whatever the law."""

from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any

import numpy as np

from jimpact.core.scene import (
    Scene,
    as_velocity,
    dense_mass,
    gap_velocity,
    kinetic_energy,
)
from jimpact.theory.capped_polyhedron import (
    CappedPolyhedron,
    capped_polyhedron,
    cone_facets,
)
from jimpact.tools.checks import as_float_array, as_whole, check_values
from jimpact.tools.status import sign_tolerance

# Contacts count as redundant when the matrix of their cosines has an eigenvalue below
# this multiple of eps * m.
_SINGULAR = 100.0
# A contact approaches when |qn-| exceeds this multiple of eps times the speed sqrt(2
# T). Ten times more would leave slow approaches out of the set.
_APPROACH = 64.0
_ZERO = 1e-12  # printed as 0 below this multiple of the largest velocity


@dataclass(frozen=True)
class AdmissibleSet:
    """The outcomes v+ of `admissible_set`; `print(result)` describes them.

    Every outcome is v = `centre` + `axes` u, u (d,) in a convex set `coordinates`, with
    `axes^T M axes = I`, and has the energy `T(centre) + |u|^2 / 2`: u are kinetic
    coordinates [sqrt(J)]. `dimension` d is 0 where only one outcome is possible.
    `plastic` v+ (n,) has the `least_energy` [J]; `energy` is T-. `scene` and `velocity`
    v- (n,) [m/s] are the arguments, `tolerance` that of `contains`.
    """

    scene: Scene
    velocity: np.ndarray
    centre: np.ndarray
    axes: np.ndarray
    coordinates: CappedPolyhedron = field(repr=False)
    energy: float
    tolerance: float

    @property
    def dimension(self) -> int:
        """Dimension d of the set."""
        return self.axes.shape[1]

    @cached_property
    def plastic(self) -> np.ndarray:
        """v+ (n,) [m/s] of least energy: every contact that carries an impulse remains
        closed.
        """
        origin = np.zeros(self.dimension)
        nearest = self.coordinates.project(origin)
        return self._velocity(nearest)

    @property
    def least_energy(self) -> float:
        """Least possible T+ [J]."""
        energy = kinetic_energy(self.scene, self.plastic)
        return float(energy)

    @cached_property
    def bounds(self) -> np.ndarray:
        """Least and greatest value of every coordinate of v+, (n, 2) [m/s].

        Each is a linear function over the convex set, solved to rounding (about 1e-9 of
        the impact's size).
        """
        # v_i = centre_i + c . u with row c of the axes: v+ where it is least, and
        # greatest
        lowest = self.coordinates.lowest
        ranges = []
        for i, c in enumerate(self.axes):
            low = self._velocity(lowest(c))
            high = self._velocity(lowest(-c))
            ranges.append([low[i], high[i]])
        return np.array(ranges)

    def contains(
        self, velocity: Any, tolerance: float | None = None
    ) -> bool | np.ndarray:
        """True for a velocity v+ (n,) [m/s], or each of (k, n), that is admissible up
        to an error.

        Equation: with `v - centre = axes u + w`, `u = axes^T M (v - centre)`, the error
        is the larger of `sqrt(w^T M w)`, which violates the balance of momentum, and of
        how much u violates a facet or the cap of the convex set [sqrt(J)]. It may be
        `tolerance` times the size of the impact, `sqrt(2 (T- - T(centre)))`, the
        largest |u|; None: that of `audit`.
        """
        given = as_float_array("velocity", velocity)
        v = np.asarray(given, float)
        if v.ndim not in (1, 2) or v.shape[-1] != self.scene.size:
            raise ValueError(
                f"Argument `velocity` must have shape ({self.scene.size},) or "
                f"(k, {self.scene.size}), but has shape {v.shape}."
            )
        check_values("velocity", v)
        check_values("tolerance", tolerance, low=0.0)
        allowed = self.tolerance
        if tolerance is not None:
            allowed = tolerance
        offset = v - self.centre
        mass = dense_mass(self.scene)
        u = offset @ mass @ self.axes
        w = offset - u @ self.axes.T  # violates the momentum balance
        square = np.einsum("...i,ij,...j->...", w, mass, w)
        violation = np.sqrt(np.maximum(square, 0.0))
        outside = self.coordinates.excess(u)
        error = np.maximum(outside, violation)
        inside = error <= allowed * self._size
        if v.ndim == 1:
            return bool(inside)
        return inside

    def sample(self, seed: int, count: int) -> np.ndarray:
        """`count` outcomes v+ (count, n) [m/s], uniform in kinetic coordinates; fixed
        by the seed.

        Hit-and-run from an interior point, one walk a sample. For independent contacts,
        uniform in impulse space too.
        """
        as_whole("count", count, 1)
        if self.dimension == 0:
            return np.repeat(self.centre[None], count, axis=0)
        generator = np.random.default_rng(seed)
        points = self.coordinates.sample(generator, count)
        return self._velocity(points)

    def conserving_arc(self, points: int = 100) -> np.ndarray:
        """Outcomes v+ with T+ = T- of two contacts: an arc (points, n) [m/s] from A to
        B.

        Evenly spaced in the angle of the circle |u| = sqrt(2 (T- - T(centre))). At A
        the normalized gap velocity of the first closed contact is smaller. Shape (0, n)
        if redundant contacts leave no such outcome.

        Raises:
            ValueError: the set is not two-dimensional.
        """
        self._check_plane()
        as_whole("points", points, 1)
        ends = self.coordinates.arc()
        if ends is None:
            return np.zeros((0, self.scene.size))
        angles = np.linspace(*ends, points)
        circle = self.coordinates.on_circle(angles)
        arc = self._velocity(circle)
        contact = int(np.argmax(self.scene.closed))
        normals = np.asarray(self.scene.normals)
        n = normals[:, contact]
        if arc[0] @ n > arc[-1] @ n:
            return arc[::-1]
        return arc

    def boundary(self, points: int = 100) -> np.ndarray:
        """Velocities v+ (k, n) [m/s] around the boundary of a plane set, corners
        included.

        On a straight side one gap velocity gamma+ or one impulse is 0; `points` lie on
        the arc T+ = T-.

        Raises:
            ValueError: the set is not two-dimensional.
        """
        self._check_plane()
        as_whole("points", points, 2)
        around = self.coordinates.boundary(points)
        return self._velocity(around)

    def __str__(self) -> str:
        """Table of the set: T+ [J] and, for each coordinate, v- and the range of v+
        [m/s].
        """
        closed = np.asarray(self.scene.closed)
        gamma = gap_velocity(self.scene, self.velocity)
        approaching = np.asarray(gamma)[closed] < 0
        head = (
            f"closed contacts: {int(closed.sum())}, approaching: "
            f"{int(approaching.sum())};"
        )
        fastest = float(np.abs(self.velocity).max())
        smallest = _ZERO * max(1e-300, fastest)

        def show(x: float, width: int = 0) -> str:
            """A velocity [m/s] with six digits; 0 within rounding."""
            return f"{x if abs(x) > smallest else 0.0:{width}.6g}"

        if self.dimension == 0:
            return (
                f"{head} one admissible outcome, v+ = "
                f"({', '.join(map(show, self.centre))})"
            )
        lines = [
            f"{head} admissible outcomes of dimension {self.dimension}",
            (
                f"energy       from {self.least_energy:.6g} J (plastic) to "
                f"{self.energy:.6g} J (T-)"
            ),
            "coordinate          v-         least       plastic      greatest   [m/s]",
        ]
        least, greatest = self.bounds.T
        columns = zip(self.velocity, least, self.plastic, greatest)
        for i, (before, *after) in enumerate(columns):
            results = "".join(show(x, 14) for x in after)
            lines.append(f"{i + 1:10d}{show(before, 12)}" + results)
        if self.dimension == 2:
            for name, v in zip("AB", self.conserving_arc(2)):
                lines.append(f"T+ = T- at {name} ({', '.join(map(show, v))})")
        return "\n".join(lines)

    @property
    def _size(self) -> float:
        """Size of the impact, the largest |u| = sqrt(2 (T- - T(centre))) [sqrt(J)];
        never 0.
        """
        return self.coordinates.radius or float(np.sqrt(2 * self.energy)) or 1.0

    def _velocity(self, u: np.ndarray) -> np.ndarray:
        """v+ (..., n) of kinetic coordinates u."""
        return self.centre + u @ self.axes.T

    def _check_plane(self) -> None:
        """Raise a ValueError unless the set is two-dimensional."""
        if self.dimension != 2:
            raise ValueError(
                f"An arc and a boundary need a set of dimension 2 (two independent "
                f"contacts), but this one has dimension {self.dimension}."
            )


def admissible_set(scene: Scene, velocity: Any) -> AdmissibleSet:
    """All v+ that are kinematically, kinetically, energetically consistent.

    Equation: `v+ = v- + M^-1 N p` with `p >= 0`, `gamma+ >= 0` at closed contacts (p =
    0 at open ones) and `T+ <= T-`. In kinetic coordinates the set is the part of a ball
    between flat walls; for two contacts, the region under an arc A-B of the circle of
    equal energy.

    Args:
        scene: n coordinates, m contacts, redundant ones included.
        velocity: v- (n,) [m/s].

    Returns:
        `AdmissibleSet`: `contains`, `bounds`, `plastic`, `least_energy`, `sample`, and
        for two contacts `conserving_arc`, `boundary`. Without an approaching contact it
        is v- alone.

    Raises:
        ValueError: shape, NaN, a velocity against the bilateral constraints; too many
            redundant contacts, so that the cone of impulses cannot be enumerated.

    Host function, not differentiable.

    Source: Brogliato, Nonsmooth Mechanics (2016), 6.1.1.2-6.1.1.3, (6.5)-(6.8), Fig.
    6.3.

    >>> import jimpact as ji
    >>> result = admissible_set(ji.chain([1.0, 1.0, 1.0]), [1.0, 0.0, 0.0])
    >>> (result.conserving_arc(2).round(4) + 0.0).tolist()
    [[0.0, 0.0, 1.0], [-0.3333, 0.6667, 0.6667]]
    >>> result.contains([0.1, 0.3, 0.6]), result.contains([0.5, 0.25, 0.25])
    (True, False)
    """
    v = as_velocity(scene, velocity, finite=True)
    tolerance = sign_tolerance(scene.mass.dtype)
    start = np.asarray(v, float)
    closed = np.asarray(scene.closed)
    root = np.linalg.cholesky(dense_mass(scene))  # y = root^T v has T = |y|^2 / 2
    y = root.T @ start
    free = _constraint_projector(scene, root, y, tolerance)
    # one column for each closed contact: qn = unit^T y, its normal in the coordinates y
    normals = np.asarray(scene.normals, float)[:, closed]
    unit = np.linalg.solve(root, normals)
    length = np.linalg.norm(unit, axis=0)
    unit = unit / length
    size = np.linalg.norm(y)
    eps = np.finfo(scene.mass.dtype).eps
    rounding = _APPROACH * eps
    approach = unit.T @ y < -rounding * size
    energy = 0.5 * float(y @ y)
    outcomes = partial(AdmissibleSet, scene, start, energy=energy, tolerance=tolerance)
    if not approach.any():
        no_rows = np.zeros((0, 0))
        no_bounds = np.zeros(0)
        alone = CappedPolyhedron(no_rows, no_bounds, 0.0)
        no_axes = np.zeros((len(start), 0))
        return outcomes(centre=start, axes=no_axes, coordinates=alone)
    unit = free @ unit
    count = unit.shape[1]
    floor = _SINGULAR * eps * count
    # not contacts that constraints hold
    square = np.sum(unit**2, axis=0)
    unit = unit[:, square > floor]
    basis, singular, _ = np.linalg.svd(unit, full_matrices=False)
    regular = singular**2 > floor
    basis = basis[:, regular]
    normal = basis.T @ unit  # contacts in the coordinates z = basis^T y
    z = basis.T @ y  # before the impact
    # gamma+ >= 0: normal^T z >= 0; p >= 0: z - z- in the cone of the normals, facets (z
    # - z-) >= 0
    facets = cone_facets(normal)
    rows = np.vstack([normal.T, facets])
    rank, contacts = normal.shape
    of_contacts = np.zeros(contacts)
    offset = np.append(of_contacts, facets @ z)
    redundant = rank < contacts
    radius = float(np.linalg.norm(z))
    part, centre, axes = capped_polyhedron(rows, offset, radius, redundant)
    rest = y - basis @ z + basis @ centre  # impulses leave y - basis z- as it is
    centre = np.linalg.solve(root.T, rest)
    axes = np.linalg.solve(root.T, basis @ axes)
    return outcomes(centre=centre, axes=axes, coordinates=part)


def _constraint_projector(
    scene: Scene, root: np.ndarray, y: np.ndarray, tolerance: float
) -> np.ndarray:
    """Projector `I - Q Q^T` (n, n) onto directions y that bilateral constraints H leave
    free.

    y = root^T v are coordinates with T = |y|^2 / 2, `root root^T = M`, and the columns
    of Q are an orthonormal basis of root^-1 H: `H^T v = 0` is `Q^T y = 0`, to
    `tolerance` |y|.
    """
    if scene.constraints is None:
        return np.eye(len(y))
    constraints = np.asarray(scene.constraints, float)
    directions = np.linalg.solve(root, constraints)
    basis, _ = np.linalg.qr(directions)
    violation = np.linalg.norm(basis.T @ y)
    size = np.linalg.norm(y)
    if violation > tolerance * size:
        raise ValueError(
            f"Argument `velocity` must satisfy the bilateral constraints, grad h^T v = "
            f"0, but is {violation:.3g} off in the kinetic norm."
        )
    identity = np.eye(len(y))
    return identity - basis @ basis.T
