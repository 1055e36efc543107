"""Restitution with friction: the normal-cone inclusion; bounds for dissipation (Theorem
6.2).
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jimpact.core.contact import (
    kinetic_norm,
    normalized_delassus,
    normalized_gap_velocity,
)
from jimpact.core.scene import Scene, velocity_change
from jimpact.numerics.dense import unit_outside
from jimpact.numerics.lcp import solve_lcp
from jimpact.numerics.tridiagonal import as_matrix
from jimpact.theory.quasi_velocities import quasi_basis, to_quasi_velocities
from jimpact.tools.checks import as_float_array, as_numbers, check_shape
from jimpact.tools.compiling import full_precision


class InclusionOutcome(NamedTuple):
    """Solution of `restitution_inclusion`.

    `velocity`: quasi-velocities v+ (n,) [sqrt(J)]; `percussion` (c,) along the columns
    of the coupling; `status` (), a code of `jimpact.STATUS`.
    """

    velocity: jax.Array
    percussion: jax.Array
    status: jax.Array


@full_precision
def contact_coupling(scene: Scene) -> jax.Array:
    """Matrix Gbar (n, m + t) from impulses (pbar, p_t) to changes of (qn, qt).

    Equation: `Gbar = [[G, n_q^T H], [0, t_q^T H]]`, H the tangents (n, t),
    `pbar = |grad f| p`.

    Args:
        scene: n coordinates, m contacts, t tangents.

    Returns:
        Gbar (n, m + t).

    Raises:
        ValueError: redundant contacts, no tangents.

    Source: Brogliato (2016), (6.53), (6.64).

    >>> import jimpact as ji
    >>> rough = ji.Scene([2.0, 2.0], [[0.0], [1.0]], tangents=[[1.0], [0.0]])
    >>> ji.theory.contact_coupling(rough).shape
    (2, 2)
    """
    n_q, t_q = quasi_basis(scene)
    g = as_matrix(normalized_delassus(scene))
    none = jnp.zeros((t_q.shape[1], g.shape[1]), g.dtype)
    of_normal = jnp.concatenate([g, none])
    if scene.tangents is None:
        return of_normal
    h = scene.tangents
    of_tangential = jnp.concatenate([n_q.T @ h, t_q.T @ h])
    return jnp.concatenate([of_normal, of_tangential], axis=1)


@full_precision
def restitution_inclusion(
    coupling: Any,
    metric: Any,
    restitution: Any,
    velocity: Any,
    low: Any = 0.0,
    high: Any = jnp.inf,
) -> InclusionOutcome:
    """Solve `v+ - v- in -Gbar N_V(Gamma (v+ + Lambda v-))`, V a box.

    N_V is the normal cone of V, the box of all y with `low <= y <= high`.

    Equation: `v+ = -Lambda v- + R^-1 proj[{x: Gbar^T R x in V}; R (Lambda + I)
    v-]`, `R^2 = P`. With the multipliers of the projection, y = Gamma (v+ + Lambda v-),
    it reads `v+ = v- + Gbar p`, `p_i >= 0` where y_i is at its lower bound, `<= 0` at
    its upper one, else 0: one linear complementarity problem, and no square root.

    Args:
        coupling: Gbar (n, c), see `contact_coupling`.
        metric: P (n, n), symmetric positive definite.
        restitution: Lambda, a scalar or (n, n).
        velocity: v- (n,), quasi-velocities [m/s times sqrt(kg)]
            (`to_quasi_velocities`).
        low: lower bounds of V, scalar or (c,); -inf for none.
        high: upper bounds.

    Returns:
        `InclusionOutcome`; `status` is `infeasible` where V cannot be met.

    Raises:
        ValueError: shapes that do not fit, NaN.

    Derivatives are one-sided where a percussion sets in.
    Source: Brogliato, Nonsmooth Mechanics (2016), (6.63)-(6.65).

    >>> import jimpact as ji
    >>> out = ji.theory.restitution_inclusion(
    ...     [[1.0]], [[1.0]], 0.5, [-2.0]
    ... )  # Newton's law
    >>> float(out.velocity[0])
    1.0
    """
    gbar = as_numbers("coupling", coupling)
    lam = as_numbers("restitution", restitution)
    if gbar.ndim != 2:
        raise ValueError(
            f"Argument `coupling` must be a matrix, but has shape {gbar.shape}."
        )
    n, c = gbar.shape
    v = as_numbers("velocity", velocity, (n,), "one per row of `coupling`")
    metric_p = as_numbers(
        "metric", metric, (n, n), "square, one row per row of `coupling`"
    )
    if lam.ndim == 0:
        lam = lam * jnp.eye(n, dtype=lam.dtype)
    check_shape("restitution", lam, (n, n), "or a scalar")
    low = jnp.broadcast_to(as_float_array("low", low), (c,))
    high = jnp.broadcast_to(as_float_array("high", high), (c,))
    gamma = gbar.T @ metric_p
    y = gamma @ (v + lam @ v)  # Gamma (v+ + Lambda v-) without percussion, v+ = v-
    percussion, code = _box_multipliers(gamma @ gbar, y, low, high)
    return InclusionOutcome(v + gbar @ percussion, percussion, code.astype(jnp.int32))


def _box_multipliers(
    s: jax.Array, y: jax.Array, low: jax.Array, high: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Multipliers p (c,) with `low <= y + S p <= high`, and the code of the status.

    Equation: `p = p_low - p_high`, `0 <= p_low _|_ y + S p - low >= 0`,
    `0 <= p_high _|_ high - y - S p >= 0`: one LCP in (p_low, p_high) (2 c,). S (c, c)
    is symmetric positive semidefinite.
    """
    bounded = jnp.isfinite(jnp.concatenate([low, high]))
    slack = jnp.concatenate([y - low, high - y])
    slack = jnp.where(bounded, slack, 1.0)  # a bound at infinity never binds
    matrix = jnp.block([[s, -s], [-s, s]])
    matrix = unit_outside(matrix, bounded)
    # The matrix is singular, but only p_low - p_high is used. It is unique where S is
    # regular; elsewhere any that keeps the bounds will do.
    solution = solve_lcp(matrix, slack, regular=True)
    of_low = solution.z[: len(y)]
    return of_low - solution.z[len(y) :], solution.code


class FrictionBounds(NamedTuple):
    """Matrices and bounds of Prop. 6.6 and Theorem 6.2; `print` says them in words.

    `g_mu`, `k`, `m_bar` are the matrices G^mu, K and Mbar of (6.56) and (6.59) (all (m,
    m)). Prop. 6.6 (1): `g_mu_bound` < 1 makes G^mu positive definite for every slip
    direction;
    (3), sharpened: `restitution_bound` < 1 makes Mbar positive definite.
    Theorem 6.2 (i): `m_bar_least` > `k_largest`, both eigenvalues; (ii): |qn-| / |qt-|
    at least `least_ratio`, which is infinite where (i) fails, and 0 where friction does
    not couple.
    """

    g_mu: np.ndarray
    k: np.ndarray
    m_bar: np.ndarray
    g_mu_bound: float
    restitution_bound: float
    m_bar_least: float
    k_largest: float
    least_ratio: float

    @property
    def condition_i(self) -> bool:
        """Theorem 6.2 (i)."""
        return self.m_bar_least > self.k_largest

    def dissipates(self, scene: Scene, velocity: Any) -> bool:
        """True where Theorem 6.2 (sufficient) promises T+ <= T- of a scene at velocity
        v- (n,).
        """
        qn, qt = to_quasi_velocities(scene, velocity)
        least = self.least_ratio * jnp.linalg.norm(qt)
        return self.condition_i and bool(jnp.linalg.norm(qn) >= least)

    def __str__(self) -> str:
        """Report: the four conditions with their numbers, a line each."""
        words = {True: "holds", False: "does not hold, which decides nothing"}
        first = words[self.g_mu_bound < 1]
        third = words[self.restitution_bound < 1]
        if self.condition_i:
            ratio = f"|qn-| / |qt-| >= {self.least_ratio:.6g}"
        else:
            ratio = "no bound"
        return (
            f"Prop. 6.6 (1)    {self.g_mu_bound:.6g} < 1, so that G^mu > 0: {first}\n"
            f"Prop. 6.6 (3)    {self.restitution_bound:.6g} < 1, so that Mbar > 0: "
            f"{third}\n"
            f"Theorem 6.2 (i)  lambda_min(Mbar) = {self.m_bar_least:.6g} > "
            f"lambda_max(K) = "
            f"{self.k_largest:.6g}: {words[self.condition_i]}\n"
            f"Theorem 6.2 (ii) energy surely decreases where: {ratio}"
        )


class _Coupling(NamedTuple):
    """Matrices of a planar scene with m closed contacts and as many tangents H_t."""

    delassus: jax.Array  # G (m, m)
    normal: jax.Array  # n_q^T H_t (m, m)
    tangential: jax.Array  # t_q^T H_t (n - m - b, m)
    friction: jax.Array  # mu_j xi_j / |grad f_j| (m,)

    @property
    def g_mu(self) -> jax.Array:
        """G^mu = G - n_q^T H_t [mubar][xi] (m, m)."""
        return self.delassus - self.normal * self.friction[None, :]


@full_precision
def friction_bounds(
    scene: Scene, matrix: Any, friction: Any, slip: Any = 1.0
) -> FrictionBounds:
    """Conditions for `qn+ = -E qn-`, `p_t = -[mubar][xi] pbar` to dissipate.

    Equation: `G^mu = G - n_q^T H_t [mubar][xi]`, `mubar_i = mu_i / |grad f_i|`, and the
    bounds `|G^-1| |n_q^T H_t| |mubar| < 1`, `|E|^2 cond(G) < 1`,
    `lambda_min(Mbar) > lambda_max(K)`, `|qn-| / |qt-| >= 2 |t_q^T H_t| |mubar|
    |(G^mu)^-1| |I + E| / (lambda_min - lambda_max)`, where `Mbar = (I - E)^T G^-1 (I +
    E)` and `K = B^T B`, `B = t_q^T H_t [mubar][xi] (G^mu)^-1 (I + E)`. Spectral norms;
    eigenvalues of symmetric parts; [x] is the diagonal matrix of x, G the normalized
    Delassus matrix, n_q and t_q the basis of `quasi_basis`, `pbar = |grad f| p`.

    Args:
        scene: n coordinates, m closed contacts, planar tangents H_t (n, m).
        matrix: E (m, m).
        friction: mu >= 0, scalar or (m,).
        slip: xi in [-1, 1], scalar or (m,): the sign of sliding along H_t, inside it
            sticking.

    Returns:
        `FrictionBounds`; `print` says them in words.

    Raises:
        ValueError: shapes, ranges; no tangents, spatial ones, an open contact,
            redundant ones; friction so large that G^mu is singular.

    Source: Brogliato, Nonsmooth Mechanics (2016), Prop. 6.6 and Theorem 6.2, corrected:
    with G^-1 in (6.58) the matrix M of (6.59) is G^-1 itself, which empties Prop. 6.6
    (2), turns (3) into that of Prop. 6.5, and (6.61)(ii) lacks the factor |(G^mu)^-1|.

    >>> import jimpact as ji
    >>> particle = ji.Scene([2.0, 2.0], [[0.0], [1.0]], tangents=[[1.0], [0.0]])
    >>> round(friction_bounds(particle, [[0.5]], 0.3).least_ratio, 6)
    1.643836
    """
    e = _restitution(scene, matrix)
    coupling = _coupling(scene, friction, slip)
    mu = as_float_array("friction", friction)
    mubar = mu * jnp.ones(scene.contacts) / kinetic_norm(scene)
    one_plus = np.eye(len(e)) + e  # I + E
    g = np.asarray(coupling.delassus, float)
    g_mu = np.asarray(coupling.g_mu, float)
    rounding = len(g) * np.finfo(scene.mass.dtype).eps
    if np.linalg.cond(g_mu) > 1 / rounding:
        raise ValueError(
            f"Argument `friction` must leave G^mu regular, but {np.asarray(friction)} "
            f"makes it singular."
        )
    inverse = np.linalg.inv(g)
    one_minus = np.eye(len(e)) - e
    m_bar = one_minus.T @ inverse @ one_plus
    # t_q^T H_t [mubar][xi]
    along = np.asarray(coupling.tangential, float)
    slide = along * np.asarray(coupling.friction)[None, :]
    b = slide @ np.linalg.solve(g_mu, one_plus)
    k = b.T @ b
    symmetric = 0.5 * (m_bar + m_bar.T)
    least = float(np.linalg.eigvalsh(symmetric)[0])
    largest = float(np.linalg.eigvalsh(k)[-1])
    largest_mu = float(jnp.abs(mubar).max())
    # numerator of Theorem 6.2 (ii)
    numerator = 2 * _norm(coupling.tangential) * largest_mu
    numerator *= _norm(np.linalg.inv(g_mu)) * _norm(one_plus)
    return FrictionBounds(
        g_mu=g_mu,
        k=k,
        m_bar=m_bar,
        g_mu_bound=_norm(inverse) * _norm(coupling.normal) * largest_mu,
        restitution_bound=_norm(e) ** 2 * float(np.linalg.cond(g)),
        m_bar_least=least,
        k_largest=largest,
        least_ratio=numerator / (least - largest) if least > largest else float("inf"),
    )


@full_precision
def friction_impulses(
    scene: Scene, matrix: Any, friction: Any, slip: Any, velocity: Any
) -> tuple[jax.Array, jax.Array]:
    """Normal and tangential impulses p, p_t (m,) [N s] of the law for a slip xi.

    Equation: `pbar = -(G^mu)^-1 (I + E) qn-`, `p_t = -[mubar][xi] pbar`,
    `p = pbar / |grad f|`, with G^mu and mubar of `friction_bounds`. The slip is taken
    as given: whether it agrees with the sliding after it is the caller's.

    Args:
        scene: n coordinates, m closed contacts, planar tangents.
        matrix: E (m, m).
        friction: mu >= 0, scalar or (m,).
        slip: xi in [-1, 1], scalar or (m,).
        velocity: v- (n,) [m/s].

    Returns:
        p (m,) and p_t (m,) [N s].

    Raises:
        ValueError: as of `friction_bounds`; not one velocity per coordinate.

    Source: Brogliato (2016), (6.54)-(6.56).

    >>> import jimpact as ji
    >>> particle = ji.Scene([2.0, 2.0], [[0.0], [1.0]], tangents=[[1.0], [0.0]])
    >>> p, side = friction_impulses(particle, [[0.5]], 0.3, 1.0, [1.0, -1.0])
    >>> round(float(p[0]), 6), round(float(side[0]), 6)
    (3.0, -0.9)
    """
    e = _restitution(scene, matrix)
    coupling = _coupling(scene, friction, slip)
    qn = normalized_gap_velocity(scene, velocity)
    returned = jnp.asarray(e, qn.dtype) @ qn
    pbar = -jnp.linalg.solve(coupling.g_mu, qn + returned)
    return pbar / kinetic_norm(scene), -coupling.friction * pbar


@full_precision
def friction_energy_change(
    scene: Scene, velocity: Any, impulse: Any, tangential_impulse: Any
) -> jax.Array:
    """`T+ - T-` [J] of normal and tangential impulses, in kinetic quasi-velocities.

    Equation: the sum of `(qn+ + qn-)^T (pbar + G^-1 n_q^T H_t p_t) / 2` and
    `(qt+ + qt-)^T t_q^T H_t p_t / 2`, with `pbar = |grad f| p`, H_t the tangents, and
    G, n_q, t_q as in `friction_bounds`.

    Args:
        scene: m contacts, planar tangents.
        velocity: v- (n,) [m/s].
        impulse: p (m,) [N s].
        tangential_impulse: p_t (m,) [N s].

    Returns:
        T+ - T- () [J].

    Raises:
        ValueError: not one impulse per contact, no planar tangents, redundant contacts.

    Source: Brogliato (2016), (6.58) with G^-1 in place of G.

    >>> import jimpact as ji
    >>> particle = ji.Scene([2.0, 2.0], [[0.0], [1.0]], tangents=[[1.0], [0.0]])
    >>> round(float(friction_energy_change(particle, [1.0, -1.0], [3.0], [-0.9])), 6)
    -1.4475
    """
    # of its coefficients nothing is used
    coupling = _coupling(scene, 0.0, 0.0)
    p, p_t = (
        as_numbers(name, value, (scene.contacts,), "one per contact")
        for name, value in (
            ("impulse", impulse),
            ("tangential_impulse", tangential_impulse),
        )
    )
    qn, qt = to_quasi_velocities(scene, velocity)
    pbar = kinetic_norm(scene) * p
    qn_plus = qn + coupling.delassus @ pbar + coupling.normal @ p_t
    qt_change = coupling.tangential @ p_t
    normal = pbar + jnp.linalg.solve(coupling.delassus, coupling.normal @ p_t)
    of_normal = 0.5 * (qn_plus + qn) @ normal
    return of_normal + 0.5 * (2 * qt + qt_change) @ qt_change


def _norm(matrix: jax.Array | np.ndarray) -> float:
    """Largest singular value; 0 of an empty matrix."""
    if np.size(matrix):
        values = np.asarray(matrix, float)
        return float(np.linalg.norm(values, 2))
    return 0.0


def _restitution(scene: Scene, matrix: Any) -> np.ndarray:
    """Restitution matrix E (m, m) as a NumPy array, checked."""
    e = as_numbers(
        "matrix", matrix, (scene.contacts,) * 2, "one row and one column per contact"
    )
    return np.asarray(e, float)


def _coupling(scene: Scene, friction: Any, slip: Any) -> _Coupling:
    """Matrices of a planar scene of closed contacts with friction mu at slip xi,
    checked.
    """
    m = scene.contacts
    if scene.tangents is None or scene.tangents.shape[1] != m:
        raise ValueError(
            f"Argument `scene` must have planar tangents, one column for each of its "
            f"{m} contacts."
        )
    if not bool(np.all(scene.closed)):
        raise ValueError(
            "Argument `scene` must have closed contacts only: leave open ones out."
        )
    mu = as_numbers("friction", friction, contacts=m, low=0.0)
    xi = as_numbers("slip", slip, contacts=m, low=-1.0, high=1.0)
    _, tangent = quasi_basis(scene)
    unit = jnp.eye(m, dtype=scene.mass.dtype)
    none = jnp.zeros(m, scene.mass.dtype)
    # M^-1 H_t (n, m): column j is v+ - v- of a unit tangential impulse at contact j
    change_of = jax.vmap(lambda p_t: velocity_change(scene, none, p_t), 1, 1)
    changes = change_of(unit)
    return _Coupling(
        delassus=as_matrix(normalized_delassus(scene)),
        normal=jax.vmap(partial(normalized_gap_velocity, scene), 1, 1)(changes),
        tangential=tangent.T @ scene.tangents,
        friction=(mu * xi * jnp.ones(m, mu.dtype)) / kinetic_norm(scene),
    )
