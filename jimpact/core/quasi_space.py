"""A basis of velocities normal and tangential to the contacts, in the kinetic
metric.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from jimpact.core.contact import kinetic_norm, normalized_delassus
from jimpact.core.scene import Scene, dense_mass, momentum, velocity_change
from jimpact.numerics.tridiagonal import as_matrix
from jimpact.tools.checks import is_traced
from jimpact.tools.compiling import quick_jit
from jimpact.tools.precision import precision

# Relative difference below which shares of coordinates in the tangent space count as
# equal: the first one is taken, so that a basis does not depend on the last digit. Ten
# times more would take coordinates that span the space less well.
_EQUAL_SHARE = 1e-3

_REDUNDANT = (
    "Argument `scene` must have independent contact normals and constraints to define "
    "quasi-velocities, but has {}."
)


def quasi_basis(scene: Scene) -> tuple[jax.Array, jax.Array]:
    """Bases `n_q` (n, m) and `t_q` (n, n - m - b) of the kinetic quasi-velocities.

    Equation: `n_q = M^-1 N diag(1 / |grad f_j|)`, `t_q^T M n_q = 0`,
    `t_q^T grad h = 0`, `t_q^T M t_q = I` (so that `D_t = I`).

    Column i of t_q comes from a coordinate: the n - m - b coordinates with the largest
    shares (in the kinetic metric) in the tangent space are projected onto it and
    orthonormalized in their order; each column forms an acute angle with what is left
    of its coordinate. A chain without walls: `(1, ..., 1) / sqrt(sum m)`.

    Args:
        scene: n coordinates, m contacts, b bilateral constraints.

    Returns:
        n_q [1 / sqrt(kg)], t_q [1 / sqrt(kg)].

    Raises:
        ValueError: redundant contacts, whose n_q are not independent (NaN or noise if
            traced).

    Differentiable in the scene, but for the moments when another coordinate takes over.

    Source: Brogliato, Nonsmooth Mechanics (2016), (6.22)-(6.23).

    >>> import jimpact as ji
    >>> normal, tangent = ji.theory.quasi_basis(ji.chain([2.0, 2.0]))
    >>> (
    ...     [round(float(x), 6) for x in normal[:, 0]],
    ...     [round(float(x), 6) for x in tangent[:, 0]],
    ... )
    ([-0.5, 0.5], [0.5, 0.5])
    """
    check_independent(scene)
    return _basis(scene)


@quick_jit
def _basis(scene: Scene) -> tuple[jax.Array, jax.Array]:
    """n_q (n, m) and t_q (n, k), k = n - m - b, of a scene whose contacts are
    independent.

    Equation: with D = (N, grad h) and its unit columns `n = M^-1 D diag(1 / |D_j|)`,
    `G = n^T M n`, the projector on the tangent space is `P = I - n G^-1 n^T M`; t_q are
    k columns of P (see `_coordinates`), orthonormalized in the metric of M by
    Cholesky's factorization.
    """
    all_contacts = _with_constraints_as_contacts(scene)
    metric = jax.vmap(partial(momentum, scene), 1, 1)  # M X
    gram = as_matrix(normalized_delassus(all_contacts))
    one = jnp.eye(all_contacts.contacts, dtype=gram.dtype)
    unit = one / kinetic_norm(all_contacts)[:, None]
    normal = jax.vmap(partial(velocity_change, all_contacts), 1, 1)(unit)
    identity = jnp.eye(scene.size, dtype=gram.dtype)
    projector = identity - normal @ jnp.linalg.solve(gram, metric(normal).T)
    count = scene.size - all_contacts.contacts
    coordinates = _coordinates(metric(projector), metric(identity), count)
    tangent = projector[:, coordinates]
    triangle = jnp.linalg.cholesky(tangent.T @ metric(tangent))
    tangent = jax.scipy.linalg.solve_triangular(triangle, tangent.T, lower=True).T
    return normal[:, : scene.contacts], tangent


def _with_constraints_as_contacts(scene: Scene) -> Scene:
    """The scene whose normals are (N, grad h) (n, m + b): constraints are further
    contacts.

    Raise a ValueError for more of them than velocities.
    """
    normals = scene.normals
    if scene.constraints is not None:
        normals = jnp.concatenate([normals, scene.constraints], axis=1)
    if normals.shape[1] > scene.size:
        given = f"{normals.shape[1]} of them for {scene.size} velocities"
        raise ValueError(_REDUNDANT.format(given))
    return Scene(scene.mass, normals)


def check_independent(scene: Scene) -> None:
    """Raise a ValueError where contact normals and constraints are dependent (if
    concrete).

    They are where the least eigenvalue of their Gram matrix D^T M^-1 D, with a unit
    diagonal, is rounding.
    """
    all_contacts = _with_constraints_as_contacts(scene)
    if is_traced((all_contacts.normals, all_contacts.mass)):
        return
    normals = np.asarray(all_contacts.normals, float)
    gram = normals.T @ np.linalg.solve(dense_mass(all_contacts), normals)
    norm = np.sqrt(np.diag(gram))
    smallest = np.linalg.eigvalsh(gram / np.outer(norm, norm))[0]
    if smallest < precision(gram.dtype).singular * len(gram):
        given = f"redundant ones: smallest eigenvalue of G {smallest:.3g}"
        raise ValueError(_REDUNDANT.format(given))


def _coordinates(shares: jax.Array, mass: jax.Array, count: int) -> jax.Array:
    """Indices (count,), ascending, of the coordinates that span the tangent space best.

    Pivots of the Cholesky factorization of the Gram matrix of the projected coordinate
    directions, of unit length in the metric of M = `mass` (n, n); `shares` is M P (n,
    n), P the projector on the tangent space.
    """
    if count == 0:
        return jnp.zeros(0, jnp.int32)
    scale = 1 / jnp.sqrt(jnp.diagonal(mass))
    gram = jax.lax.stop_gradient(shares * scale[:, None] * scale[None, :])

    def choose(
        i: jax.Array, state: tuple[jax.Array, jax.Array]
    ) -> tuple[jax.Array, jax.Array]:
        """The Gram matrix without the direction of the next pivot, and pivots (count,)
        so far.
        """
        rest, chosen = state
        squares = jnp.diagonal(rest)  # of what no chosen direction spans
        equal = squares >= (1 - _EQUAL_SHARE) * jnp.max(squares)
        pivot = jnp.argmax(equal).astype(jnp.int32)
        column = rest[:, pivot]
        rest = rest - jnp.outer(column, column) / squares[pivot]
        return rest, chosen.at[i].set(pivot)

    start = (gram, jnp.zeros(count, jnp.int32))
    _, chosen = jax.lax.fori_loop(0, count, choose, start)
    return jnp.sort(chosen)
