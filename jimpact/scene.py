"""Scenes: all that an impact needs to know of a mechanical system at one instant.

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

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import as_float_array, check_shape, check_values, is_traced

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
