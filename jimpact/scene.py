"""Scene and contact-space algebra: all that an impact needs to know of a mechanical system.

# notation, used in every file:
#   n, m             velocity coordinates, contacts
#   M                mass matrix (n, n)                          [kg]
#   N = grad f       normals (n, m), one column a contact
#   gamma = N^T v    gap velocities (m,); < 0 on approach        [m/s]
#   p                contact impulses (m,), >= 0                 [N s];  v+ = v- + M^-1 N p
#   W = N^T M^-1 N   Delassus matrix (m, m);  gamma+ = gamma- + W p
#   G                W scaled to a unit diagonal;  cos(theta_ij) = -G_ij (kinetic angles)
#   T = v^T M v / 2  kinetic energy                              [J]
"""

import operator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import as_float_array, check_shape, check_values, is_traced
from jimpact.numerics.tridiagonal import Symmetric, Tridiagonal, as_matrix, diagonal, scaled

_CONSTRAINTS = operator.attrgetter("constraints")
_SYMMETRY_TOLERANCE = 1e-6  # relative asymmetry of M that rounding may cause in float32


class Scene(eqx.Module):
    """Mass matrix, contact normals and gaps of a mechanical system at one instant.

    Equation: `gamma = N^T v`, `W = N^T M^-1 N` with `N = grad f(q)`.

    Args:
        mass: `(n, n)` symmetric positive definite, or `(n,)` its diagonal [kg, kg m^2, ...].
        normals: `(n, m)`, column j is the gradient of gap function j.
        tangents: `(n, m)` planar or `(n, 2 m)`, contact-major; None: no friction possible.
        gaps: `(m,)` >= 0 [m]; a contact with gap > 0 is open. None: all closed.
        constraints: `(n, b)` gradients of bilateral constraints h(q) = 0, or None.

    Raises:
        ValueError: wrong shapes, NaN, mass not symmetric or not positive, negative gap,
            a normal that is zero.

    Source: Brogliato, Nonsmooth Mechanics (3rd ed., 2016), (6.22)-(6.35).

    >>> import jimpact as ji
    >>> scene = ji.Scene(mass=[2.0, 1.0], normals=[[-1.0], [1.0]])
    >>> float(ji.gap_velocity(scene, [1.0, 0.0])[0])
    -1.0
    """

    mass: jax.Array
    tangents: jax.Array | None
    gaps: jax.Array | None
    constraints: jax.Array | None
    _normals: jax.Array | None
    walls: tuple[bool, bool] | None = eqx.field(static=True)  # of a chain (left, right)

    def __init__(
        self,
        mass: Any,
        normals: Any,
        tangents: Any = None,
        gaps: Any = None,
        constraints: Any = None,
    ):
        self.mass = as_float_array("mass", mass)
        self._normals = as_float_array("normals", normals)
        self.tangents = None if tangents is None else as_float_array("tangents", tangents)
        self.gaps = None if gaps is None else as_float_array("gaps", gaps)
        self.constraints = (
            None if constraints is None else as_float_array("constraints", constraints)
        )
        self.walls = None
        _check_scene(self)

    @property
    def size(self) -> int:
        """Number n of velocity coordinates."""
        return self.mass.shape[0]

    @property
    def contacts(self) -> int:
        """Number m of contacts."""
        if self.walls is not None:
            return self.size - 1 + sum(self.walls)
        return self.normals.shape[1]

    @property
    def normals(self) -> jax.Array:
        """`grad f`, shape (n, m); a chain builds it on demand."""
        if self._normals is not None:
            return self._normals
        assert self.walls is not None
        left, _ = self.walls
        body = jnp.arange(self.size)[:, None]
        first = jnp.arange(self.contacts)[None, :] - int(left)  # body on the contact's left
        ones = (body == first + 1).astype(self.mass.dtype)
        return ones - (body == first).astype(self.mass.dtype)

    @property
    def closed(self) -> jax.Array:
        """Boolean (m,): contacts without a gap."""
        if self.gaps is None:
            return jnp.ones(self.contacts, bool)
        return self.gaps <= 0


def chain_scene(masses: jax.Array, walls: tuple[bool, bool], gaps: jax.Array | None) -> Scene:
    """A chain: its normals stay implicit, its Delassus matrix tridiagonal (see `ji.chain`)."""
    scene = object.__new__(Scene)
    fields = {
        "mass": masses,
        "tangents": None,
        "gaps": gaps,
        "constraints": None,
        "_normals": None,
        "walls": walls,
    }
    for name, value in fields.items():
        object.__setattr__(scene, name, value)
    return scene


def _check_scene(scene: Scene) -> None:
    mass, normals = scene.mass, scene.normals
    if mass.ndim not in (1, 2) or (mass.ndim == 2 and mass.shape[0] != mass.shape[1]):
        raise ValueError(
            f"Argument `mass` must have shape (n,) or (n, n), but has shape {mass.shape}."
        )
    n = mass.shape[0]
    if normals.ndim != 2 or normals.shape[0] != n or normals.shape[1] == 0:
        raise ValueError(
            f"Argument `normals` must have shape (n, m) with n = {n} as in `mass` and m >= 1, "
            f"but has shape {normals.shape}."
        )
    m = normals.shape[1]
    check_values("normals", normals)
    if not is_traced(normals) and not np.abs(np.asarray(normals)).sum(axis=0).all():
        raise ValueError("Argument `normals` must have no zero column: such a contact has no body.")
    check_mass(mass)
    if scene.gaps is not None:
        check_shape("gaps", scene.gaps, (m,), "one gap per contact")
        check_values("gaps", scene.gaps, low=0.0)
    if scene.tangents is not None:
        if scene.tangents.shape not in ((n, m), (n, 2 * m)):
            raise ValueError(
                f"Argument `tangents` must have shape ({n}, {m}) or ({n}, {2 * m}), "
                f"but has shape {scene.tangents.shape}."
            )
        check_values("tangents", scene.tangents)
    if scene.constraints is not None:
        if scene.constraints.ndim != 2 or scene.constraints.shape[0] != n:
            raise ValueError(
                f"Argument `constraints` must have shape ({n}, b), "
                f"but has shape {scene.constraints.shape}."
            )
        check_values("constraints", scene.constraints)
        _check_independent(scene.constraints)


def _check_independent(constraints: jax.Array) -> None:
    if is_traced(constraints):
        return
    rank, b = np.linalg.matrix_rank(np.asarray(constraints)), constraints.shape[1]
    if rank < b:
        raise ValueError(
            f"Argument `constraints` must have independent columns, but {b} columns have "
            f"rank {rank}."
        )


def check_mass(mass: jax.Array) -> None:
    """Raise a ValueError unless M is (n,) > 0, or (n, n) symmetric positive definite."""
    if mass.ndim == 1:
        check_values("mass", mass, low=0.0, open_low=True)
        return
    check_values("mass", mass)
    if is_traced(mass):
        return
    host = np.asarray(mass, dtype=float)
    if np.abs(host - host.T).max() > _SYMMETRY_TOLERANCE * np.abs(host).max():
        raise ValueError("Argument `mass` must be symmetric, but M - M^T is not zero.")
    smallest = np.linalg.eigvalsh(host)[0]
    if smallest <= np.finfo(mass.dtype).eps * len(host) * np.abs(host).max():
        raise ValueError(
            "Argument `mass` must be positive definite, "
            f"but its smallest eigenvalue is {smallest:.3g}."
        )


def gap_velocity(scene: Scene, velocity: Any) -> jax.Array:
    """Gap velocities `gamma = N^T v` (m,) [m/s]; negative on approach."""
    v = as_float_array("velocity", velocity)
    if scene.walls is None:
        return scene.normals.T @ v
    left, right = scene.walls
    return jnp.diff(jnp.pad(v, (int(left), int(right))))


def momentum(scene: Scene, velocity: Any) -> jax.Array:
    """Generalized momenta `M v` (n,); for a chain without walls their sum is conserved."""
    v = as_float_array("velocity", velocity)
    return scene.mass * v if scene.mass.ndim == 1 else scene.mass @ v


def kinetic_energy(scene: Scene, velocity: Any) -> jax.Array:
    """Kinetic energy `T = v^T M v / 2` [J]."""
    v = as_float_array("velocity", velocity)
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


def velocity_change(
    scene: Scene, impulse: jax.Array, tangential: jax.Array | None = None
) -> jax.Array:
    """`v+ - v- = M^-1 (N p + H p_t)` (n,) [m/s] of contact impulses [N s]; p_t None: 0."""
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


def kinetic_norm(scene: Scene) -> jax.Array:
    """`|grad f_j|` in the metric of M^-1 (m,), the square roots of the free W_jj."""
    return jnp.sqrt(diagonal(delassus_matrix(without_constraints(scene))))


def normalized_delassus(scene: Scene) -> Symmetric:
    """`G = W` between unit normals: unit diagonal, `G_ij = -cos(theta_ij)`.

    Bilateral constraints distort it, its diagonal included: Brogliato (2016), (6.35).
    """
    return scaled(delassus_matrix(scene), 1 / kinetic_norm(scene))


def normalized_gap_velocity(scene: Scene, velocity: Any) -> jax.Array:
    """`gamma_j / |grad f_j|` (m,), the normal quasi-velocities of Brogliato (2016), (6.24)."""
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
