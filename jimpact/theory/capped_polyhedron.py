"""The convex set `{w: A w >= b, |w| <= r}` on the host: extremes, samples, plane
boundary.
"""

from itertools import combinations
from math import comb
from typing import NamedTuple

import numpy as np

# All computations are scaled to r = 1; LP solvers are right to 1e-7.
_FLAT = 1e-6  # a row whose slack stays below this everywhere is an equality
_ROUNDING = 1e-10  # feasibility of points that are computed in closed form
_INDEPENDENT = 1e-8  # relative singular value that counts as nonzero
_MOST_FACETS = 20_000  # bound on the facets of a cone; more take minutes
# distance after which the search for a minimum gives up and takes what it has
_FARTHEST = 1e8
_GRADIENT = 1e-12  # of least squares: a gradient below this is zero
_ROUNDS = 10  # of least squares: rounds per column; two are usual
_MIXING = 30  # hit-and-run steps per dimension; every sample has its own walk


class CappedPolyhedron(NamedTuple):
    """`{w: rows w >= offset, |w| <= radius}`, rows (k, d) of unit length."""

    rows: np.ndarray
    offset: np.ndarray
    radius: float

    def excess(self, w: np.ndarray) -> np.ndarray:
        """Largest violation of a bound at w (..., d),
        `max(|w| - radius, offset_i - rows_i w)`.

        0 or less inside the set.
        """
        length = np.linalg.norm(w, axis=-1)
        beyond_ball = length - self.radius
        missing = self.offset - w @ self.rows.T
        beyond_rows = missing.max(axis=-1, initial=-np.inf)
        return np.maximum(beyond_ball, beyond_rows)

    def project(self, point: np.ndarray) -> np.ndarray:
        """Point w (d,) nearest to `point` with `rows w >= offset`, whatever the radius.

        Least distance programming (Lawson and Hanson 1974, ch. 23): rows with a
        positive multiplier x hold with equality, x the nonnegative least squares
        solution of `[rows, need]^T x = (0, ..., 0, 1)`, `need = offset - rows point`.
        """
        need = self.offset - self.rows @ point
        largest = need.max(initial=0.0)
        if not largest > 0:
            return point
        dimension = self.rows.shape[1]
        target = np.zeros(dimension + 1)
        target[-1] = 1.0
        matrix = np.vstack([self.rows.T, need / largest])
        x = least_squares(matrix, target)
        active = x > 0
        rows = self.rows[active]
        step, *_ = np.linalg.lstsq(rows, need[active], rcond=None)
        return point + step

    def lowest(self, direction: np.ndarray) -> np.ndarray:
        """A point w (d,) of the set where `direction . w` is least.

        Of direction 0, or of a set that is a point, the one nearest to the origin. Else
        `argmin c . w + |w|^2 / (2 s)` of the polyhedron, c the unit direction, with the
        s at which it reaches the ball, or at which c . w has its minimum without one.
        """
        from scipy.optimize import brentq  # late: slow to import

        length = np.linalg.norm(direction)
        if length == 0 or self.radius == 0:
            origin = np.zeros_like(direction)
            return self.project(origin)
        c = direction / length

        # minimizes c.w + |w|^2 / (2 s); |w| grows with s until the ball or a least c.w
        # ends it
        def beyond(s: float) -> float:
            """Distance of the minimizer of this s from the ball; negative inside."""
            minimizer = self.project(-s * c)
            length = np.linalg.norm(minimizer)
            return float(length - self.radius)

        far = self.radius
        while beyond(far) < 0:
            w = self.project(-far * c)
            slack = self.rows @ w - self.offset
            holds = slack <= _ROUNDING * self.radius
            touching = self.rows[holds]
            # c in the cone of the rows that hold with equality: c.w is least here
            # without the ball
            multipliers = least_squares(touching.T, c)
            off = touching.T @ multipliers - c
            in_cone = np.linalg.norm(off) <= _ROUNDING
            if in_cone or far > _FARTHEST * self.radius:
                return w
            far *= 4
        if beyond(0.0) >= 0:
            origin = np.zeros_like(c)
            return self.project(origin)
        precision = 4 * np.finfo(float).eps
        s = brentq(beyond, 0.0, far, xtol=1e-300, rtol=precision)
        return self.project(-s * c)

    def interior(self) -> np.ndarray:
        """A point (d,) with distance to the bounds, to start walks from.

        It lies between `least`, the point nearest to the origin, and `deep`, which has
        the largest slack t in `rows w >= offset + t`, `|w_i| <= radius`: half way, or
        half way to the sphere.
        """
        from scipy.optimize import linprog  # late: slow to import

        dimension = self.rows.shape[1]
        r = self.radius
        within_ball = [(-r, r)] * dimension
        box = [*within_ball, (0.0, r)]
        distances = np.ones((len(self.rows), 1))
        slack = np.hstack([-self.rows, distances])
        origin = np.zeros(dimension)
        cost = np.append(origin, -1.0)  # linprog minimizes -t
        optimum = linprog(cost, slack, -self.offset, bounds=box)
        deep = optimum.x[:-1]
        least = self.project(origin)
        step = deep - least
        if not step.any():
            return least
        _, leaves = _chord(least[None], step[None], r)
        share = min(1.0, leaves[0])
        return least + 0.5 * share * step

    def sample(self, generator: np.random.Generator, count: int) -> np.ndarray:
        """`count` points (count, d), uniform: each the end of its own hit-and-run
        walk.
        """
        dimension = self.rows.shape[1]
        start = self.interior()[None]
        points = np.repeat(start, count, axis=0)
        for _ in range(_MIXING * dimension):
            step = generator.normal(size=points.shape)
            step /= np.linalg.norm(step, axis=1, keepdims=True)
            # along w = point + t step the slack of row i, slack_i + t rate_i, is 0 at t
            # = reach_i
            slack = points @ self.rows.T - self.offset
            slack = np.maximum(slack, 0.0)
            rate = step @ self.rows.T
            with np.errstate(divide="ignore", invalid="ignore"):
                reach = -slack / rate
            low, high = _chord(points, step, self.radius)
            falls = np.where(rate < 0, reach, np.inf)
            first_end = falls.min(1, initial=np.inf)
            high = np.minimum(high, first_end)
            rises = np.where(rate > 0, reach, -np.inf)
            last_begin = rises.max(1, initial=-np.inf)
            low = np.maximum(low, last_begin)
            share = generator.random(count)
            position = low + (high - low) * share
            points = points + position[:, None] * step
        return points

    def arc(self) -> tuple[float, float] | None:
        """First and last angle [rad] of the part of the circle |w| = r in the set; d =
        2 only.

        Row i meets the circle at its own angle +- arccos(offset_i / r). The set is
        expected to have one such part; of several, one is returned.
        """
        x, y = self.rows.T
        angle = np.arctan2(y, x)
        r = self.radius
        circle = 2 * np.pi
        cut = np.abs(self.offset) <= r
        half = np.arccos(self.offset[cut] / r)
        middle = angle[cut]
        both = np.concatenate([middle - half, middle + half])
        ends = np.sort(both % circle)
        if len(ends) == 0:
            first_point = self.on_circle(np.zeros(1))
            excess = self.excess(first_point)
            if excess[0] <= _ROUNDING * r:
                return 0.0, circle
            return None
        # pieces of the circle between neighbouring ends; feasible: its midpoint is in
        # the set
        once_around = ends[0] + circle
        width = np.diff(np.append(ends, once_around))
        middles = self.on_circle(ends + 0.5 * width)
        feasible = self.excess(middles) <= _ROUNDING * r
        if feasible.all():
            return 0.0, circle
        # the feasible pieces that follow one that is not: from `first` to the next that
        # is not
        previous = np.roll(feasible, 1)
        begins = feasible & ~previous
        first = int(np.argmax(begins))
        run = np.roll(feasible, -first)
        widths = np.roll(width, -first)
        if not run[0]:
            return None
        pieces = np.argmin(run)
        begin = ends[first]
        end = begin + widths[:pieces].sum()
        return float(begin), float(end)

    def boundary(self, arc_points: int) -> np.ndarray:
        """Points (k, 2) of the boundary, counter-clockwise, with its corners; d = 2
        only.
        """
        corners = [np.zeros((0, 2))]
        # where two rows hold with equality
        for i, j in combinations(range(len(self.rows)), 2):
            rows = [i, j]
            pair = self.rows[rows]
            determinant = np.linalg.det(pair)
            if abs(determinant) > _INDEPENDENT:
                corner = np.linalg.solve(pair, self.offset[rows])
                corners.append(corner[None])
        arc = self.arc()
        if arc is not None:
            angles = np.linspace(*arc, arc_points)
            corners.append(self.on_circle(angles))
        points = np.concatenate(corners)
        inside = self.excess(points) <= _ROUNDING * self.radius
        points = points[inside]
        relative = points - self.interior()
        x, y = relative.T
        angle = np.arctan2(y, x)
        return points[np.argsort(angle)]

    def on_circle(self, angle: np.ndarray) -> np.ndarray:
        """Points (..., 2) of the circle at angles [rad]."""
        components = [np.cos(angle), np.sin(angle)]
        return self.radius * np.stack(components, axis=-1)


def capped_polyhedron(
    rows: np.ndarray, offset: np.ndarray, radius: float, may_be_flat: bool
) -> tuple[CappedPolyhedron, np.ndarray, np.ndarray]:
    """`{w: rows w >= offset, |w| <= radius}` in coordinates u of its own dimension,
    centre, axes.

    Equation: `w = centre + axes u`, axes (d, d_u) orthonormal,
    `|w|^2 = |centre|^2 + |u|^2`. Rows that hold with equality all over the set (sought
    where it `may_be_flat`) fix the centre (d,) and the axes; the others bound u.
    """
    from scipy.optimize import linprog  # late: slow to import

    rows, offset = _unit_rows(rows, offset, 0.0)
    box = [(-radius, radius)] * rows.shape[1]
    flat = np.zeros(len(rows), bool)
    if may_be_flat:
        optima = (linprog(-row, -rows, -offset, bounds=box) for row in rows)
        highest = [-optimum.fun for optimum in optima]
        slack = np.array(highest) - offset
        flat = slack <= _FLAT * radius
    equalities = rows[flat]
    _, singular, basis = np.linalg.svd(equalities)
    regular = singular > _INDEPENDENT
    rank = int(regular.sum())
    axes = basis[rank:].T  # null space of the equalities
    centre, *_ = np.linalg.lstsq(equalities, offset[flat], rcond=_INDEPENDENT)
    square = radius**2 - float(centre @ centre)
    inner = float(np.sqrt(max(square, 0.0)))
    bounds = rows[~flat]
    offset_of_u = offset[~flat] - bounds @ centre
    within = _unit_rows(bounds @ axes, offset_of_u, _INDEPENDENT)
    polyhedron = CappedPolyhedron(*within, inner)
    return polyhedron, centre, axes


def _unit_rows(
    rows: np.ndarray, offset: np.ndarray, least: float
) -> tuple[np.ndarray, np.ndarray]:
    """The rows longer than `least` and their offsets, scaled to unit length."""
    length = np.linalg.norm(rows, axis=1)
    chosen = length > least
    size = length[chosen]
    unit = rows[chosen] / size[:, None]
    return unit, offset[chosen] / size


def least_squares(matrix: np.ndarray, target: np.ndarray) -> np.ndarray:
    """`x >= 0` of least `|matrix x - target|` (Lawson and Hanson 1974, ch. 23).

    Of scipy (1.17), `nnls` and the method `bvls` of `lsq_linear` both miss the minimum
    of some degenerate problems met here: with `nnls`,
    `test_random_scenes_against_oracles` fails.
    """
    count = matrix.shape[1]
    # passive: columns with x > 0; barred: columns that rounding keeps from growing
    x = np.zeros(count)
    passive = np.zeros(count, bool)
    barred = np.zeros(count, bool)
    for _ in range(_ROUNDS * count):
        residual = target - matrix @ x
        gradient = matrix.T @ residual
        gradient[passive | barred] = 0.0
        new = int(np.argmax(gradient))
        if gradient[new] <= _GRADIENT:
            break
        passive[new] = True
        trial = _on_support(matrix, target, passive)
        if trial[new] <= 0:  # rounding: this column would not grow
            passive[new] = False
            barred[new] = True
            continue
        # go towards the trial until the first x is 0
        while (trial[passive] <= 0).any():
            falls = passive & (trial <= 0)
            low = np.flatnonzero(falls)
            change = x[low] - trial[low]
            steps = x[low] / change
            shortest = steps.min()
            x = x + shortest * (trial - x)
            reached = low[steps == shortest]
            passive[reached] = False
            trial = _on_support(matrix, target, passive)
        x = trial
        barred[:] = False
    return x


def _on_support(
    matrix: np.ndarray, target: np.ndarray, support: np.ndarray
) -> np.ndarray:
    """Minimizer x of `|matrix x - target|` with x = 0 off the support (a mask of
    columns).
    """
    x = np.zeros(matrix.shape[1])
    columns = matrix[:, support]
    solution, *_ = np.linalg.lstsq(columns, target, rcond=None)
    x[support] = solution
    return x


def cone_facets(generators: np.ndarray) -> np.ndarray:
    """Rows F (f, r) of unit length with `{w: F w >= 0}` the cone of m generators (r, m)
    of rank r.

    They are the facets through the origin of the convex hull of the origin and the
    generators.

    Raises:
        ValueError: m > r and too many facets are possible.
    """
    from scipy.spatial import ConvexHull  # late: slow to import

    rank, m = generators.shape
    if m == rank:
        inverse = np.linalg.inv(generators)
        return inverse / np.linalg.norm(inverse, axis=1, keepdims=True)
    if comb(m, rank - 1) > _MOST_FACETS:
        raise ValueError(
            f"Argument `scene` must have fewer redundant contacts: {m} contacts of "
            f"rank {rank} have more than {_MOST_FACETS} candidate facets."
        )
    unit = generators / np.linalg.norm(generators, axis=0)
    if rank == 1:  # hulls begin with two dimensions
        if np.ptp(unit) == 0:
            return unit[:, :1]
        return np.zeros((0, 1))
    apex = np.zeros(rank)
    corners = np.vstack([apex, unit.T])
    outward = ConvexHull(corners).equations
    through_apex = np.abs(outward[:, -1]) <= _INDEPENDENT
    normals = -outward[through_apex, :-1]
    # a facet that is no simplex is reported in parts; one that stays twice does no harm
    rounded = np.round(normals / _INDEPENDENT)
    _, first = np.unique(rounded, axis=0, return_index=True)
    return normals[np.sort(first)]


def _chord(
    points: np.ndarray, steps: np.ndarray, radius: float
) -> tuple[np.ndarray, np.ndarray]:
    """Parameters t (k,), (k,) at which lines `points + t steps` (k, d) enter and leave
    the ball.

    Equation: roots of `|s|^2 t^2 + 2 p.s t + |p|^2 = radius^2`.
    """
    a = (steps**2).sum(1)
    b = (points * steps).sum(1)
    c = radius**2 - (points**2).sum(1)
    square = b**2 + a * c
    root = np.sqrt(np.maximum(square, 0.0))
    enters = (-b - root) / a
    leaves = (-b + root) / a
    return enters, leaves
