"""Contact-space algebra of a scene: gap velocities, Delassus matrix, energy, kinetic angles."""

import operator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import as_float_array, check_shape
from jimpact.scene import Scene
from jimpact.solvers.tridiagonal import Symmetric, Tridiagonal, as_matrix, diagonal, scaled

_CONSTRAINTS = operator.attrgetter("constraints")


def as_velocity(scene: Scene, velocity: Any) -> jax.Array:
    """`velocity` as an array; raise a ValueError unless it has one entry per coordinate."""
    v = as_float_array("velocity", velocity)
    check_shape("velocity", v, (scene.size,), "one per coordinate of the scene")
    return v


def gap_velocity(scene: Scene, velocity: Any) -> jax.Array:
    """Gap velocities `gamma = N^T v` (m,) [m/s] of velocities (n,); negative on approach.

    Raises:
        ValueError: not one velocity per coordinate.

    Source: Brogliato (2016), (6.24) before normalization.

    >>> import jimpact as ji
    >>> ji.gap_velocity(ji.chain([1.0, 1.0, 1.0]), [1.0, 0.0, 0.5]).tolist()
    [-1.0, 0.5]
    """
    v = as_velocity(scene, velocity)
    if scene.walls is None:
        return scene.normals.T @ v
    left, right = scene.walls
    return jnp.diff(jnp.pad(v, (int(left), int(right))))


def momentum(scene: Scene, velocity: Any) -> jax.Array:
    """Generalized momenta `M v` (n,); for a chain without walls their sum is conserved.

    Raises:
        ValueError: not one velocity per coordinate.

    >>> import jimpact as ji
    >>> ji.momentum(ji.chain([1.0, 2.0]), [1.0, 0.5]).tolist()
    [1.0, 1.0]
    """
    v = as_velocity(scene, velocity)
    return scene.mass * v if scene.mass.ndim == 1 else scene.mass @ v


def kinetic_energy(scene: Scene, velocity: Any) -> jax.Array:
    """Kinetic energy `T = v^T M v / 2` [J] of velocities (n,).

    Raises:
        ValueError: not one velocity per coordinate.

    >>> import jimpact as ji
    >>> float(ji.kinetic_energy(ji.chain([1.0, 2.0]), [1.0, 0.5]))
    0.75
    """
    v = as_velocity(scene, velocity)
    return 0.5 * v @ momentum(scene, v)


def dense_mass(scene: Scene) -> np.ndarray:
    """M (n, n) on the host, in double precision."""
    mass = np.asarray(scene.mass, float)
    return np.diag(mass) if mass.ndim == 1 else mass


def solve_mass(scene: Scene, right: jax.Array) -> jax.Array:
    """`M^-1 right`, with the reactions of bilateral constraints where the scene has some."""
    if scene.mass.ndim == 1:
        shape = (-1,) + (1,) * (right.ndim - 1)
        free = right / scene.mass.reshape(shape)
    else:
        free = jax.scipy.linalg.solve(scene.mass, right, assume_a="pos")
    if scene.constraints is None:
        return free
    h = scene.constraints
    m_inv_h = solve_mass(without_constraints(scene), h)
    return free - m_inv_h @ jnp.linalg.solve(h.T @ m_inv_h, h.T @ free)


def velocity_change(scene: Scene, impulse: Any, tangential: Any = None) -> jax.Array:
    """What contact impulses change: `v+ - v- = M^-1 (N p + H p_t)` (n,) [m/s].

    Args:
        scene: n coordinates, m contacts.
        impulse: p (m,) [N s].
        tangential: p_t, one per tangent of the scene [N s]; None: 0.

    Raises:
        ValueError: not one impulse per contact, or per tangent.

    >>> import jimpact as ji
    >>> ji.velocity_change(ji.chain([1.0, 2.0]), [1.0]).tolist()
    [-1.0, 0.5]
    """
    impulse = as_float_array("impulse", impulse)
    check_shape("impulse", impulse, (scene.contacts,), "one per contact")
    if tangential is not None and scene.tangents is not None:
        tangential = as_float_array("tangential", tangential)
        check_shape("tangential", tangential, scene.tangents.shape[1:], "one per tangent")
    if scene.walls is None:
        push = scene.normals @ impulse
        if scene.tangents is not None and tangential is not None:
            push = push + scene.tangents @ tangential
        return solve_mass(scene, push)
    left, right = scene.walls
    padded = jnp.pad(impulse, (int(not left), int(not right)))
    return -jnp.diff(padded) / scene.mass


def delassus_matrix(scene: Scene) -> Symmetric:
    """`W = N^T M^-1 N` [1/kg]: (m, m), or `Tridiagonal` for a chain.

    Source: Brogliato (2016), (6.35) where bilateral constraints are present.

    >>> import jimpact as ji
    >>> ji.delassus_matrix(ji.chain([1.0, 2.0, 2.0])).diagonal.tolist()
    [1.5, 1.0]
    """
    if scene.walls is None:
        return scene.normals.T @ solve_mass(scene, scene.normals)
    left, right = scene.walls
    inverse = 1 / scene.mass
    padded = jnp.pad(inverse, (int(left), int(right)))
    shared = inverse[int(not left) : scene.size - int(not right)]
    return Tridiagonal(padded[:-1] + padded[1:], -shared, scene.contacts <= scene.size)


def tangential_delassus(scene: Scene, velocity: jax.Array) -> tuple[jax.Array, ...]:
    """`N^T M^-1 H` (m, t), `H^T M^-1 H` (t, t) and slip velocities `H^T v` (t,).

    Rows of open contacts are 0, but for the diagonal.
    """
    assert scene.tangents is not None
    m, t = scene.contacts, scene.tangents.shape[1]
    moved = solve_mass(scene, scene.tangents)
    across, along = scene.normals.T @ moved, scene.tangents.T @ moved
    if scene.gaps is not None:
        rows = jnp.repeat(scene.closed, t // m)
        across = jnp.where(scene.closed[:, None] & rows[None, :], across, 0.0)
        keep = (rows[:, None] & rows[None, :]) | jnp.eye(t, dtype=bool)
        along = jnp.where(keep, along, 0.0)
    return across, along, scene.tangents.T @ velocity


def without_constraints(scene: Scene) -> Scene:
    """The scene as if it had no bilateral constraints."""
    return scene if scene.constraints is None else eqx.tree_at(_CONSTRAINTS, scene, None)


def without_open_contacts(
    scene: Scene, delassus: Symmetric, gamma: jax.Array
) -> tuple[Symmetric, jax.Array]:
    """W with the rows of open contacts decoupled, and gamma with zeros there (so p_j = 0)."""
    if scene.gaps is None:
        return delassus, gamma
    closed = scene.closed
    gamma = jnp.where(closed, gamma, 0.0)
    if isinstance(delassus, Tridiagonal):
        both = closed[:-1] & closed[1:]
        off = jnp.where(both, delassus.off_diagonal, 0.0)
        return Tridiagonal(delassus.diagonal, off, delassus.regular), gamma
    keep = (closed[:, None] & closed[None, :]) | jnp.eye(closed.shape[0], dtype=bool)
    return jnp.where(keep, delassus, 0.0), gamma


def kinetic_norm(scene: Scene) -> jax.Array:
    """`|grad f_j|` in the metric of M^-1 (m,), the square roots of the free W_jj."""
    return jnp.sqrt(diagonal(delassus_matrix(without_constraints(scene))))


def normalized_delassus(scene: Scene) -> Symmetric:
    """`G = W` between unit normals: unit diagonal, `G_ij = -cos(theta_ij)`.

    Bilateral constraints distort it, its diagonal included: Brogliato (2016), (6.35).

    >>> import jimpact as ji
    >>> ji.normalized_delassus(ji.chain([1.0, 1.0, 1.0])).off_diagonal.round(3).tolist()
    [-0.5]
    """
    return scaled(delassus_matrix(scene), 1 / kinetic_norm(scene))


def normalized_gap_velocity(scene: Scene, velocity: Any) -> jax.Array:
    """`gamma_j / |grad f_j|` (m,) [sqrt(J)], the normal quasi-velocities.

    Source: Brogliato (2016), (6.24).

    >>> import jimpact as ji
    >>> ji.normalized_gap_velocity(ji.chain([0.5, 0.5]), [1.0, 0.0]).tolist()
    [-0.5]
    """
    return gap_velocity(scene, velocity) / kinetic_norm(scene)


def kinetic_angles(scene: Scene) -> jax.Array:
    """Angles `theta_ij = pi - arccos(G_ij)` (m, m) [rad] between contacts; pi/2: decoupled.

    Not differentiable on its diagonal (theta_jj = pi) nor for redundant contacts.
    Source: Brogliato (2016), (6.66).

    >>> import jimpact as ji
    >>> float(ji.kinetic_angles(ji.chain([1.0, 2.0, 3.0]))[0, 1].round(4))
    1.1071
    """
    w = delassus_matrix(scene)
    cosine = as_matrix(scaled(w, 1 / jnp.sqrt(diagonal(w))))
    return jnp.pi - jnp.arccos(jnp.clip(cosine, -1.0, 1.0))
