"""Kinetic quasi-velocities: normal and tangential to the contacts in the kinetic metric."""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import as_float_array, check_shape, is_traced
from jimpact.compiling import quick_jit
from jimpact.contact import kinetic_norm, normalized_delassus, normalized_gap_velocity
from jimpact.scene import Scene, as_velocity, dense_mass, gap_velocity, momentum, velocity_change
from jimpact.solvers.tridiagonal import as_matrix

# Normals count as dependent when the matrix of their cosines has an eigenvalue below this
# multiple of eps times its size.
_SINGULAR = 100.0

# Coordinates whose shares of the tangent space differ by less than this are equal but for
# rounding; the first one is taken, so that a basis does not depend on the last digit.
_EQUAL_SHARE = 1e-3

_REDUNDANT = (
    "Argument `scene` must have independent contact normals and constraints to define "
    "quasi-velocities, but has {}."
)


class ContactPower(eqx.Module):
    """Power of contact forces () [W]: `normal`, `coupling`, `tangential` of (6.40), `total`."""

    normal: jax.Array
    coupling: jax.Array
    tangential: jax.Array
    total: jax.Array


def quasi_basis(scene: Scene) -> tuple[jax.Array, jax.Array]:
    """Bases `n_q` (n, m) and `t_q` (n, n - m - b) of the kinetic quasi-velocities.

    Equation: `n_q = M^-1 N diag(1 / |grad f_j|)`, `t_q^T M n_q = 0`, `t_q^T grad h = 0`,
    `t_q^T M t_q = I` (so that `D_t = I`).

    Column i of t_q comes from a coordinate: the n - m - b coordinates with the largest shares
    (in the kinetic metric) in the tangent space are projected onto it and orthonormalized in
    their order; each column forms an acute angle with what is left of its coordinate. A chain
    without walls: `(1, ..., 1) / sqrt(sum m)`.

    Args:
        scene: n coordinates, m contacts, b bilateral constraints.

    Returns:
        n_q [1 / sqrt(kg)], t_q [1 / sqrt(kg)].

    Raises:
        ValueError: redundant contacts, whose n_q are not independent (NaN or noise if traced).

    Differentiable in the scene, but for the moments when another coordinate takes over.

    Source: Brogliato, Nonsmooth Mechanics (2016), (6.22)-(6.23).

    >>> import jimpact as ji
    >>> normal, tangent = ji.theory.quasi_basis(ji.chain([2.0, 2.0]))
    >>> [round(float(x), 6) for x in normal[:, 0]], [round(float(x), 6) for x in tangent[:, 0]]
    ([-0.5, 0.5], [0.5, 0.5])
    """
    check_independent(scene)
    return _basis(scene)


@quick_jit
def _basis(scene: Scene) -> tuple[jax.Array, jax.Array]:
    fixed = _directions(scene)
    metric = jax.vmap(partial(momentum, scene), 1, 1)  # M X
    gram = as_matrix(normalized_delassus(fixed))
    unit = jnp.eye(fixed.contacts, dtype=gram.dtype) / kinetic_norm(fixed)[:, None]
    held = jax.vmap(partial(velocity_change, fixed), 1, 1)(unit)  # M^-1 (N, grad h), unit columns
    identity = jnp.eye(scene.size, dtype=gram.dtype)
    free = identity - held @ jnp.linalg.solve(gram, metric(held).T)
    chosen = _coordinates(metric(free), metric(identity), scene.size - fixed.contacts)
    tangent = free[:, chosen]
    triangle = jnp.linalg.cholesky(tangent.T @ metric(tangent))
    tangent = jax.scipy.linalg.solve_triangular(triangle, tangent.T, lower=True).T
    return held[:, : scene.contacts], tangent


def to_quasi_velocities(scene: Scene, velocity: Any) -> tuple[jax.Array, jax.Array]:
    """Quasi-velocities of a velocity: `qn = n_q^T M v` (m,) and `qt = t_q^T M v` (n - m - b,).

    Args:
        scene: n coordinates, m contacts, b bilateral constraints.
        velocity: (n,) [m/s]; it satisfies the bilateral constraints.

    Returns:
        qn, qt, both [sqrt(kg) m/s]; qn_j = gamma_j / |grad f_j| < 0 on approach.

    Raises:
        ValueError: redundant contacts; a velocity of another size.

    Source: Brogliato (2016), (6.22).

    >>> import jimpact as ji
    >>> four = ji.chain([2.0, 2.0, 2.0, 2.0])
    >>> qn, qt = ji.theory.to_quasi_velocities(four, [0.3, -0.2, 0.5, 0.7])
    >>> [round(float(q), 6) for q in qn], round(float(qt[0]), 6)
    ([-0.5, 0.7, 0.2], 0.919239)
    """
    v = as_velocity(scene, velocity)
    _, tangent = quasi_basis(scene)
    return normalized_gap_velocity(scene, v), tangent.T @ momentum(scene, v)


def from_quasi_velocities(scene: Scene, normal: Any, tangential: Any) -> jax.Array:
    """The velocity (n,) with these quasi-velocities; inverse of `to_quasi_velocities`.

    Equation: `v = n_q G^-1 qn + t_q qt`; n_q without its part along bilateral constraints.

    Args:
        scene: n coordinates, m contacts, b bilateral constraints.
        normal: qn (m,) [sqrt(kg) m/s].
        tangential: qt (n - m - b,) [sqrt(kg) m/s].

    Returns:
        v (n,) [m/s].

    Raises:
        ValueError: redundant contacts; wrong sizes.

    Source: Brogliato (2016), (6.31)-(6.32), with (6.35) for bilateral constraints.

    >>> import jimpact as ji
    >>> v = ji.theory.from_quasi_velocities(ji.chain([2.0, 2.0]), [-1.0], [2.0])
    >>> [round(float(each), 6) for each in v]
    [1.5, 0.5]
    """
    qn, qt = as_float_array("normal", normal), as_float_array("tangential", tangential)
    check_shape("normal", qn, (scene.contacts,), "one per contact")
    _, tangent = quasi_basis(scene)
    check_shape("tangential", qt, tangent.shape[1:], "one per tangent of `quasi_basis`")
    impulse = jnp.linalg.solve(as_matrix(normalized_delassus(scene)), qn) / kinetic_norm(scene)
    return velocity_change(scene, impulse) + tangent @ qt


def kinetic_energy_split(scene: Scene, velocity: Any) -> tuple[jax.Array, jax.Array]:
    """Normal and tangential kinetic energy [J]; their sum is the kinetic energy.

    Equation: `T_n = qn^T G^-1 qn / 2`, `T_t = qt^T qt / 2`. Frictionless impacts change T_n only.

    Args:
        scene: n coordinates, m contacts, b bilateral constraints.
        velocity: (n,) [m/s]; it satisfies the bilateral constraints.

    Returns:
        T_n () and T_t () [J].

    Raises:
        ValueError: redundant contacts; not one velocity per coordinate.

    Source: Brogliato (2016), (6.33)-(6.35).

    >>> import jimpact as ji
    >>> split = ji.theory.kinetic_energy_split(ji.chain([2.0, 2.0]), [1.5, 0.5])
    >>> [round(float(t), 6) for t in split]
    [0.5, 2.0]
    """
    qn, qt = to_quasi_velocities(scene, velocity)
    weighted = jnp.linalg.solve(as_matrix(normalized_delassus(scene)), qn)
    return 0.5 * qn @ weighted, 0.5 * qt @ qt


def contact_power(
    scene: Scene, velocity: Any, force: Any, tangential_force: Any = None
) -> ContactPower:
    """Power that contact forces feed into a motion, split as (6.40).

    Equation: with `F_norm^n = G lambda_bar`, `F_norm^t = n_q^T H lambda_t` and
    `F_tan^t = t_q^T H lambda_t`: `normal = <F_norm^n, qn>_Dn = gamma^T lambda` (6.36)-(6.37),
    `coupling = <qn, F_norm^t>_Dn`, `tangential = <qt, F_tan^t>_Dt` (6.39), where `D_n = G^-1` and
    `D_t = I`. Coupling and tangential together are the local power `v_t^T lambda_t` of (6.41).

    Args:
        scene: n coordinates, m contacts; with tangents where tangential forces act.
        velocity: (n,) [m/s]; it satisfies the bilateral constraints.
        force: normal forces lambda (m,) [N], or impulses for a work.
        tangential_force: lambda_t, one per column of the tangents [N]; None: 0.

    Returns:
        `ContactPower`, each term () [W].

    Raises:
        ValueError: redundant contacts, wrong sizes, tangential forces without tangents.

    Source: Brogliato (2016), (6.36)-(6.41).

    >>> import jimpact as ji
    >>> float(ji.theory.contact_power(ji.chain([2.0, 2.0]), [1.5, 0.5], [3.0]).total)
    -3.0
    """
    v, normal_force = as_float_array("velocity", velocity), as_float_array("force", force)
    check_shape("force", normal_force, (scene.contacts,), "one per contact")
    qn, qt = to_quasi_velocities(scene, v)
    normal = normal_force @ gap_velocity(scene, v)
    if tangential_force is None:
        zero = jnp.zeros_like(normal)
        return ContactPower(normal, zero, zero, normal)
    if scene.tangents is None:
        raise ValueError("Argument `scene` must have tangents where tangential forces act.")
    side = as_float_array("tangential_force", tangential_force)
    check_shape("tangential_force", side, scene.tangents.shape[1:], "one per tangent")
    _, tangent = quasi_basis(scene)
    pushed = velocity_change(scene, jnp.zeros_like(normal_force), side)
    pushed_normal = normalized_gap_velocity(scene, pushed)
    coupling = qn @ jnp.linalg.solve(as_matrix(normalized_delassus(scene)), pushed_normal)
    tangential = qt @ (tangent.T @ (scene.tangents @ side))
    return ContactPower(normal, coupling, tangential, normal + coupling + tangential)


def _directions(scene: Scene) -> Scene:
    """The scene with its bilateral constraints as further contacts."""
    fixed = scene.normals
    if scene.constraints is not None:
        fixed = jnp.concatenate([fixed, scene.constraints], axis=1)
    if fixed.shape[1] > scene.size:
        raise ValueError(_REDUNDANT.format(f"{fixed.shape[1]} of them for {scene.size} velocities"))
    return Scene(scene.mass, fixed)


def check_independent(scene: Scene) -> None:
    """Raise a ValueError where contact normals and constraints are dependent (if concrete)."""
    fixed = _directions(scene)
    if is_traced((fixed.normals, fixed.mass)):
        return
    normals = np.asarray(fixed.normals, float)
    gram = normals.T @ np.linalg.solve(dense_mass(fixed), normals)
    norm = np.sqrt(np.diag(gram))
    smallest = np.linalg.eigvalsh(gram / np.outer(norm, norm))[0]
    if smallest < _SINGULAR * np.finfo(gram.dtype).eps * len(gram):
        raise ValueError(
            _REDUNDANT.format(f"redundant ones: smallest eigenvalue of G {smallest:.3g}")
        )


def _coordinates(shares: jax.Array, mass: jax.Array, count: int) -> jax.Array:
    """The `count` coordinates that span the tangent space best, ascending.

    Pivoted Cholesky factorization of the Gram matrix of the projected coordinate directions.
    """
    scale = 1 / jnp.sqrt(jnp.diagonal(mass))
    gram = jax.lax.stop_gradient(shares * scale[:, None] * scale[None, :])

    def choose(i: jax.Array, state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        rest, chosen = state
        left = jnp.diagonal(rest)
        pivot = jnp.argmax(left >= (1 - _EQUAL_SHARE) * jnp.max(left)).astype(jnp.int32)
        column = rest[:, pivot]
        return rest - jnp.outer(column, column) / left[pivot], chosen.at[i].set(pivot)

    start = (gram, jnp.zeros(count, jnp.int32))
    return jnp.sort(jax.lax.fori_loop(0, count, choose, start)[1])
