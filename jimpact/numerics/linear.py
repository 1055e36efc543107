"""Symmetric positive semidefinite systems that may be singular (redundant contacts)."""

import jax
import jax.numpy as jnp

# With a unit diagonal the matrix counts as singular when it has an eigenvalue below this
# multiple of its rounding errors, eps * m.
_SINGULAR = 100.0


def null_projector(g: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Orthogonal projector (m, m) on the null space of G (unit diagonal), and whether it is not 0.

    Held constant in derivatives: a perturbation is taken to keep the rank.
    """
    eigenvalues, vectors = jnp.linalg.eigh(jax.lax.stop_gradient(g))
    null = eigenvalues < _SINGULAR * jnp.finfo(g.dtype).eps * g.shape[0]
    basis = jnp.where(null[None, :], vectors, 0.0)
    return basis @ basis.T, jnp.any(null)


def solve_symmetric(
    g: jax.Array, right: jax.Array, *, regular: bool = False
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """`G x = right` of least norm (m,), whether G is singular, and whether no x solves it.

    `g` (m, m) is symmetric positive semidefinite with a diagonal of order 1, `regular` if that is
    known beforehand.
    """
    if regular:
        no = jnp.asarray(False)
        return jnp.linalg.solve(g, right), no, no
    projector, singular = null_projector(g)
    x = jnp.linalg.solve(g + projector, right)
    residual = jnp.abs(g @ x - right).max()
    missed = residual > jnp.sqrt(jnp.finfo(g.dtype).eps) * jnp.abs(right).max()
    return x, singular, singular & missed
