"""Fits of a restitution matrix: the region in which it is consistent for every
approach.

The set `{E : E >= 0, G^-1 (I + E) >= 0, G^-1 - E^T G^-1 E
copositive}` is convex (each x >= 0 asks `|E x| <= |x|` in the norm of G^-1). Residuals
are linear in E, so a fit goes where it likes and then to the admissible matrix of the
least sum of squares.

Axes: S scenes, m contacts, E = m m entries, Q variables y of the solver, F = 2^m - 1
faces (supports) of the cone of approaches x >= 0, C conditions `slack(y) >= 0`. G is
the Delassus matrix in units of `kinetic_norm`.
"""

from itertools import product
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jimpact.core.contact import decoupled, delassus_matrix, kinetic_norm
from jimpact.core.law import Law
from jimpact.core.scene import Scene
from jimpact.fits.parameters import Ties
from jimpact.fits.variables import Variables
from jimpact.laws.kinematic import RestitutionMatrix
from jimpact.numerics.lcp import solve_lcp
from jimpact.numerics.tridiagonal import as_matrix, scaled
from jimpact.tools.compiling import full_precision, quick_jit
from jimpact.tools.masks import quotient
from jimpact.tools.status import CODE

# A point drawn back stops short of the boundary by this share of the way, times eps.
_SHORT = 16.0
# Least damping, relative to the largest curvature: keeps the matrix of the dual problem
# regular where shots are too few to determine E.
_LEAST_DAMPING = {"float64": 1e-8, "float32": 1e-4}
_SCALINGS = 60  # of the ray: each closes in on the boundary quadratically

# Every support of m contacts gives a condition on the energy, 2^m - 1 conditions.
LARGEST = 6
# Conditions may be broken by rounding, in units of the entries of G^-1.
_ROUNDING = {"float64": 1e-9, "float32": 1e-4}
_REDUNDANT = 100.0  # G with an eigenvalue below this multiple of m eps has no inverse
_CUTS = 60  # rounds of cutting planes, mostly 10 to 20
# share of the longest derivative below which a condition does not depend on y
_FLAT = 1e-9
_WORST = 2  # new cuts of each scene and contact
_FACES = ("E >= 0", "G^-1 (I + E) >= 0", "G^-1 - E^T G^-1 E copositive (energy)")


# share of the way, True if it fell, passes
_Share = tuple[Float[Array, ""], Bool[Array, ""], Int[Array, ""]]


class _Cut(NamedTuple):
    """State of a search by cutting planes: the point z, and the Q active cuts that hold
    it.

    `slacks` are those of the cuts at the first point y, `slopes` their derivatives.
    """

    z: Float[Array, " Q"]
    slacks: Float[Array, " Q"]
    slopes: Float[Array, "Q Q"]
    goes_on: Bool[Array, ""]
    steps: Int[Array, ""]


class AdmissibleMatrices(eqx.Module):
    """The set of y whose matrix `E = origin + map y` is admissible in S scenes and
    within bounds.

    Source: Brogliato, Nonsmooth Mechanics (2016), Prop. 6.2 and 6.3.
    """

    origin: Float[Array, " E"]
    map: Float[Array, "E Q"]
    inverse: Float[Array, "S m m"]  # G^-1, the identity for open contacts
    closed: Float[Array, "S m"]  # ones, zeros for open contacts
    bounds: Float[Array, "2 Q"] | None  # of y
    center: Float[Array, " Q"]  # y strictly inside

    def matrices(self, y: Float[Array, " Q"]) -> Float[Array, "S m m"]:
        """`E = origin + map y` of each scene, with zeros for open contacts."""
        m = self.closed.shape[1]
        e = (self.origin + self.map @ y).reshape(m, m)
        both = self.closed[:, :, None] * self.closed[:, None, :]
        return e[None] * both

    def elementwise(self, y: Float[Array, " Q"]) -> Float[Array, " L"]:
        """Slacks of the conditions linear in y: `E`, `G^-1 (I + E)`, `y - low`,
        `high - y`.

        They must be >= 0; 1 where there is no bound.
        """
        e = self.matrices(y)
        m = e.shape[1]
        identity = jnp.eye(m, dtype=e.dtype)[None]
        impulses = self.inverse @ (identity + e)
        entries = self.origin + self.map @ y
        slack = [entries, impulses.reshape(-1)]
        if self.bounds is not None:
            slack += [y - self.bounds[0], self.bounds[1] - y]
        slacks = jnp.concatenate(slack)
        return jnp.where(jnp.isfinite(slacks), slacks, 1.0)

    @property
    def faces(self) -> int:
        """Number of conditions on the energy."""
        scenes, m = self.closed.shape
        return scenes * (2**m - 1)

    def worst(self, y: Float[Array, " Q"]) -> Float[Array, "S F m"]:
        """Approaches x >= 0 of length 1, one for each face, that lose the least energy.

        On each face, of the approaches with a given support, the minimizer of `x^T Q x`
        with `Q = G^-1 - E^T G^-1 E` is an eigenvector of the smallest eigenvalue of
        that block of Q, if it is positive (see `jimpact.theory.restitution_matrices`).
        Otherwise its positive part is an approach all the same, with a condition of its
        own.
        """
        m = self.closed.shape[1]
        q = self._dissipation(y)
        # (F, m) supports
        supports = list(product((0, 1), repeat=m))[1:]
        faces = jnp.asarray(supports, q.dtype)
        # larger than all eigenvalues: contacts outside of the support do not take part
        largest = jnp.abs(q).max() + jnp.abs(self.inverse).max()
        above = (m + 1.0) * largest
        inside = faces[:, :, None] * faces[:, None, :]
        identity = jnp.eye(m, dtype=q.dtype)[None]
        outside = above * (1 - faces)[:, :, None] * identity
        blocks = q[:, None] * inside[None] + outside[None]
        _, vectors = jnp.linalg.eigh(blocks)
        smallest = vectors[..., 0] * faces[None]
        signs = jnp.where(jnp.sum(smallest, axis=-1) < 0, -1.0, 1.0)
        positive = jnp.maximum(smallest * signs[..., None], 0.0)
        x = positive * self.closed[:, None, :]
        squares = jnp.sum(x**2, axis=-1, keepdims=True)
        norm = jnp.sqrt(squares)
        x = x / jnp.where(norm > 0, norm, 1.0)
        return jax.lax.stop_gradient(x)

    def _dissipation(self, y: Float[Array, " Q"]) -> Float[Array, "S m m"]:
        """`G^-1 - E^T G^-1 E` of each scene."""
        e = self.matrices(y)
        gained = jnp.swapaxes(e, 1, 2) @ self.inverse @ e
        return self.inverse - gained

    @full_precision
    def nearest(
        self,
        y: Float[Array, " Q"],
        hessian: Float[Array, "Q Q"],
        gradient: Float[Array, " Q"],
    ) -> Float[Array, " Q"]:
        """The admissible z of the least `g^T (z - y) + (z - y)^T H (z - y) / 2`.

        By cutting planes: conditions on the energy are concave, so that they lie below
        all their tangents. Each step solves the quadratic program with the linear
        conditions, the cuts that were active before, and the tangents at z of the
        conditions that are violated most.
        """
        size = y.shape[0]
        dtype = y.dtype
        largest = jnp.max(jnp.diagonal(hessian))
        positive = jnp.where(largest > 0, largest, 1.0)
        weight = _LEAST_DAMPING[str(dtype)] * positive
        hessian = hessian + weight * jnp.eye(size, dtype=dtype)
        size_of_entries = jnp.abs(self.inverse).max()
        rounding = _SHORT * jnp.finfo(dtype).eps * size_of_entries
        slack, rows = self.conditions(y)
        linear_count = len(slack) - self.faces  # those on the energy come last
        linear = slack[:linear_count], rows[:linear_count]
        worst = min(self.faces, _WORST * self.closed.size)  # number of new cuts

        def add_cuts(state: _Cut) -> _Cut:
            """Cut at z, solve the quadratic program, and keep the cuts of the largest
            multipliers.

            It ends where z satisfies all conditions on the energy: it is then the best
            of a set that contains the admissible one.
            """
            z = state.z
            slack, slope = (x[linear_count:] for x in self.conditions(z))
            which = jnp.argsort(slack)[:worst]
            # of the tangents at y, from which the program starts
            slack_at_y = slack[which] + slope[which] @ (y - z)
            new = slack_at_y, slope[which]
            parts = zip(linear, (state.slacks, state.slopes), new)
            slacks, slopes = map(jnp.concatenate, parts)
            move, multipliers, solved = _quadratic(hessian, gradient, slacks, slopes)
            active = linear_count + jnp.argsort(-multipliers[linear_count:])[:size]
            # y itself has not been through the program yet
            inside = (slack.min() >= -rounding) & (state.steps > 0)
            goes_on = solved & ~inside
            z = jnp.where(goes_on, y + move, z)
            next_step = state.steps + 1
            return _Cut(z, slacks[active], slopes[active], goes_on, next_step)

        no_slack = jnp.ones(size, dtype)
        no_cuts = no_slack, jnp.zeros((size, size), dtype)
        start = _Cut(y, *no_cuts, jnp.asarray(True), jnp.asarray(0))
        z = jax.lax.while_loop(
            lambda s: s.goes_on & (s.steps < _CUTS), add_cuts, start
        ).z
        # cutting planes leave rounding
        share = self.share(z)
        within = (1 - _SHORT * jnp.finfo(dtype).eps) * share
        inside = self.center + within * (z - self.center)
        return jnp.where(share < 1, inside, z)

    def share(self, y: Float[Array, " Q"]) -> Float[Array, ""]:
        """The largest s <= 1 with which `center + s (y - center)` is admissible.

        First by the linear conditions; then it is shortened until the approaches of
        `worst`, which change with s, gain no energy.
        """
        slack = self.elementwise(self.center)
        target = self.elementwise(y)
        # the others do not change along the ray
        crossed = (target < 0) & (target < slack)
        shares = quotient(slack, slack - target, where=crossed, otherwise=1.0)
        share = shares.min()

        def shortened(state: _Share) -> _Share:
            """The share at which the approaches that are worst at the last one gain no
            energy.
            """
            share, _, passes = state
            x = self.worst(self.center + share * (y - self.center))
            shares = self._energy_share(y, x)
            nearer = jnp.minimum(share, shares.min())
            return nearer, nearer < share, passes + 1

        first = (share, jnp.asarray(True), jnp.asarray(0))
        return jax.lax.while_loop(
            lambda s: s[1] & (s[2] < _SCALINGS), shortened, first
        )[0]

    def _energy_share(
        self, y: Float[Array, " Q"], x: Float[Array, "S F m"]
    ) -> Float[Array, "S F"]:
        """Shares s of the ray from the center to y at which `|E(s) x| = |x|`, of
        approaches x.

        Equation: `E(s) x = u + s w`, u = E(center) x, w = E(y) x - u, in the norm of
        G^-1: the positive root of `|w|^2 s^2 + 2 (u, w) s = |x|^2 - |u|^2`; inf where
        there is none.
        """
        start = jnp.einsum("sij,sfj->sfi", self.matrices(self.center), x)
        rate = jnp.einsum("sij,sfj->sfi", self.matrices(y), x) - start
        a = _square(self.inverse, rate)
        b = jnp.einsum("sfi,sij,sfj->sf", start, self.inverse, rate)
        c = _square(self.inverse, x) - _square(self.inverse, start)  # > 0
        root = jnp.sqrt(jnp.maximum(b**2 + a * c, 0.0))
        # of a s^2 + 2 b s = c, in the form that does not cancel
        above = jnp.where(b > 0, c, root - b)
        below = jnp.where(b > 0, root + b, a)
        return quotient(above, below, where=below > 0, otherwise=jnp.inf)

    def conditions(
        self, y: Float[Array, " Q"]
    ) -> tuple[Float[Array, " C"], Float[Array, "C Q"]]:
        """Slacks of all conditions, >= 0 where admissible, and their derivatives.

        First those of `elementwise`, then `x^T Q x` of the worst approach on each face,
        twice the energy that is lost, with `Q = G^-1 - E^T G^-1 E`.
        """
        x = self.worst(y)

        def slacks(y: jax.Array) -> tuple[jax.Array, jax.Array]:
            """The slacks (C,) at y, to be differentiated, and again as they are."""
            lost = _square(self._dissipation(y), x)
            energies = lost.reshape(-1)
            value = jnp.concatenate([self.elementwise(y), energies])
            return value, value

        rows, slack = jax.jacfwd(slacks, has_aux=True)(y)
        return slack, rows


def _quadratic(
    hessian: Float[Array, "Q Q"],
    gradient: Float[Array, " Q"],
    slack: Float[Array, " C"],
    rows: Float[Array, "C Q"],
) -> tuple[Float[Array, " Q"], Float[Array, " C"], Bool[Array, ""]]:
    """Solve `min d^T H d / 2 + g^T d` with `slack + A d >= 0`, A the rows, by its dual
    LCP.

    Equation: `0 <= l  perp  A H^-1 A^T l + slack - A H^-1 g >= 0`, `d = H^-1 (A^T l -
    g)`; the rows of A are scaled to length 1.

    Returns:
        d, the multipliers l, True if the LCP is solved.
    """
    length = jnp.sqrt(jnp.sum(rows**2, axis=1))
    depends = length > _FLAT * length.max()  # others are rounding
    scale = quotient(1, length, where=depends)
    rows = rows * scale[:, None]
    slack = jnp.where(depends, slack * scale, 1.0)
    factor = jax.scipy.linalg.cho_factor(hessian)
    unconstrained = -jax.scipy.linalg.cho_solve(factor, gradient)
    response = jax.scipy.linalg.cho_solve(factor, rows.T)  # H^-1 A^T
    # positive semidefinite; the multipliers need not be unique, the step is
    dual = solve_lcp(rows @ response, slack + rows @ unconstrained, symmetric=False)
    solved = dual.code == CODE["ok"]
    return unconstrained + response @ dual.z, dual.z * scale, solved


def _square(a: Float[Array, "S m m"], x: Float[Array, "S F m"]) -> Float[Array, "S F"]:
    """The quadratic forms `x^T A x`."""
    return jnp.einsum("sfi,sij,sfj->sf", x, a, x)


def matrix_region(
    law: Law,
    scenes: list[Scene],
    variables: Variables,
    start: Float[np.ndarray, " P"],
    ties: Ties,
) -> AdmissibleMatrices | None:
    """The set of y whose `RestitutionMatrix` is admissible in each scene; None for
    other laws.

    Args:
        law: at its start values.
        scenes: with m contacts each.
        variables: y of the fit.
        start: values, which must be admissible.
        ties: of the fit.

    Raises:
        ValueError: redundant contacts, too many contacts, a start that is not
            admissible, fixed entries that leave no admissible choice, a tied matrix.
    """
    if not encloses(law, scenes[0].contacts):
        return None
    if any(tie.field == "matrix" for tie in ties):
        raise ValueError(
            "Argument `ties` must not tie a `matrix` that has to stay admissible."
        )
    owner = variables.owner
    # E = origin + moves y: each entry moves with the variable that owns it
    moves = np.where(owner[:, None] == np.arange(len(owner)), variables.scale, 0.0)
    origin = np.where(owner < 0, variables.fixed, 0.0)
    start = variables.point(start)
    bounds = np.stack([variables.low, variables.high])
    moving = np.any(moves != 0, axis=0)
    is_bounded = np.isfinite(bounds[:, moving]).any()
    dtype = variables.low.dtype
    region = _region(
        scenes, dtype, origin, moves, bounds if is_bounded else None, start
    )
    slack, _ = _host_conditions(region, start)
    for name, kind in zip(_FACES, _kinds(region)):
        if slack[kind].min() < -_rounding(region):
            raise ValueError(
                f"Argument `law` must start from an admissible matrix, consistent for "
                f"all approach velocities, but {name} fails by "
                f"{-slack[kind].min():.3g}. RestitutionMatrix(matrix, "
                f"admissible=False) is fitted without that."
            )
    center = _inner_point(region, start)
    if center is None:
        raise ValueError(
            "Argument `free` must leave an admissible choice: with the fixed entries "
            "every free entry is at the edge already."
        )
    return eqx.tree_at(lambda r: r.center, region, jnp.asarray(center, dtype))


def admissible_start(scenes: list[Scene]) -> Float[np.ndarray, "m m"]:
    """A matrix E that is admissible in all scenes.

    `I / 2` where it will do (chains); else one from which all conditions are far.

    Raises:
        ValueError: redundant or too many contacts, or no matrix that is admissible.

    >>> import jimpact as ji
    >>> from jimpact.fits.matrices import admissible_start
    >>> admissible_start([ji.chain([1.0, 1.0, 1.0])]).tolist()
    [[0.5, 0.0], [0.0, 0.5]]
    """
    m = scenes[0].contacts
    half = 0.5 * np.eye(m).ravel()
    region = _region(
        scenes, scenes[0].mass.dtype, np.zeros(m * m), np.eye(m * m), None, half
    )
    slack, _ = _host_conditions(region, half)
    will_do = slack.min() >= -_rounding(region)
    e = half if will_do else _inner_point(region, half)
    if e is None:
        raise ValueError(
            "Argument `scene` must have an admissible restitution matrix to start "
            "from, but none was found: give one, or RestitutionMatrix(matrix, "
            "admissible=False)."
        )
    return e.reshape(m, m)


def _region(
    scenes: list[Scene],
    dtype: Any,
    origin: Float[np.ndarray, " E"],
    mix: Float[np.ndarray, "E Q"],
    bounds: Float[np.ndarray, "2 Q"] | None,
    center: Float[np.ndarray, " Q"],
) -> AdmissibleMatrices:
    """The admissible set of `E = origin + mix y` in these scenes; of equal ones only
    one counts.
    """
    m = scenes[0].contacts
    if m > LARGEST:
        raise ValueError(
            f"Argument `law` must have at most {LARGEST} contacts to keep its matrix "
            f"admissible, but has {m}. RestitutionMatrix(matrix, admissible=False) is "
            f"fitted without that."
        )
    inverses = [_inverse(scene) for scene in scenes]
    distinct = np.unique(inverses, axis=0)
    arrays: Any = (origin, mix, distinct[:, :m], distinct[:, m], bounds, center)
    in_precision = jax.tree.map(lambda x: jnp.asarray(x, dtype), arrays)
    return AdmissibleMatrices(*in_precision)


def encloses(law: Law, contacts: int) -> bool:
    """True if a fit keeps the matrix of this law admissible."""
    return (
        isinstance(law, RestitutionMatrix)
        and law.admissible
        and law.matrix.shape[0] == contacts
    )


def _inverse(scene: Scene) -> Float[np.ndarray, "rows m"]:
    """G^-1 and one more row: 1 for closed contacts, 0 for open ones, which are
    decoupled.

    Equation: `G_ij = W_ij / (s_i s_j)`, W the Delassus matrix, s the `kinetic_norm`.
    """
    w = decoupled(delassus_matrix(scene), scene.closed)
    normalized = scaled(w, 1 / kinetic_norm(scene))
    g = np.asarray(as_matrix(normalized))
    smallest = np.linalg.eigvalsh(g)[0]
    rounding = _REDUNDANT * len(g) * np.finfo(g.dtype).eps
    if smallest < rounding:
        raise ValueError(
            f"Argument `scene` must have no redundant contacts to keep a restitution "
            f"matrix admissible, but the smallest eigenvalue of G is {smallest:.3g}. "
            f"RestitutionMatrix(matrix, admissible=False) is fitted without that."
        )
    closed = np.asarray(scene.closed, g.dtype)
    return np.vstack([np.linalg.inv(g), closed])


_conditions = quick_jit(AdmissibleMatrices.conditions)


def _host_conditions(
    region: AdmissibleMatrices, y: Any
) -> tuple[Float[np.ndarray, " C"], Float[np.ndarray, "C Q"]]:
    """`AdmissibleMatrices.conditions` on the host, in double precision."""
    point = jnp.asarray(y, region.center.dtype)
    slack, rows = _conditions(region, point)
    return np.asarray(slack, float), np.asarray(rows, float)


def _kinds(region: AdmissibleMatrices) -> tuple[slice, slice, slice]:
    """Slices of the list of all conditions for each kind in `_FACES`, in their
    order.
    """
    entries = len(region.origin)
    impulses = entries * (1 + len(region.inverse))
    of_faces = slice(-region.faces, None)
    return slice(entries), slice(entries, impulses), of_faces


def _rounding(region: AdmissibleMatrices) -> float:
    """By how much rounding may break a condition."""
    largest = np.abs(np.asarray(region.inverse)).max()
    return _ROUNDING[str(region.center.dtype)] * float(largest)


def _inner_point(
    region: AdmissibleMatrices, start: Float[np.ndarray, " Q"]
) -> Float[np.ndarray, " Q"] | None:
    """A y near the start whose least slack is at least half of the largest possible;
    None: none.

    Kelley's cutting planes: the least slack is concave in y, so it lies below all
    tangents so far; the next y maximizes t under these (a linear program), in a box of
    1 around the start.
    """
    from scipy.optimize import linprog  # late: slow to import

    columns = np.asarray(region.map) != 0
    free = np.any(columns, axis=0)
    box = [*((x - moves, x + moves) for x, moves in zip(start, free)), (None, 1.0)]
    # rows: A, 1 of t, right side
    y = start
    most = np.inf
    planes = np.zeros((0, len(start) + 2))
    for _ in range(_CUTS):
        slack, rows = _host_conditions(region, y)
        moving = np.any(rows[:, free] != 0, axis=1)
        allowed = max(0.5 * most, _rounding(region))
        if slack[moving].min() > allowed:
            return y
        # t <= slack + rows (z - y) for the next point z
        ones = np.ones(len(rows))
        new = np.column_stack([-rows, ones, slack - rows @ y])[moving]
        planes = np.vstack([planes, new])
        cost = np.append(np.zeros(len(start)), -1.0)
        farthest = linprog(cost, A_ub=planes[:, :-1], b_ub=planes[:, -1], bounds=box)
        if not farthest.success or farthest.x[-1] <= 0:
            return None
        y = farthest.x[:-1]
        most = farthest.x[-1]
    return None


def boundary(
    region: AdmissibleMatrices | None, y: Float[np.ndarray, " Q"]
) -> tuple[str, ...]:
    """Names of the admissibility conditions that are active at y, other than by fixed
    entries.
    """
    if region is None:
        return ()
    slack, rows = _host_conditions(region, y)
    moves = np.any(rows != 0, axis=1)
    at = (slack < _rounding(region)) & moves
    kinds = zip(_FACES, _kinds(region))
    return tuple(name for name, kind in kinds if at[kind].any())
