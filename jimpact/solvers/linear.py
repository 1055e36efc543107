"""Symmetric positive semidefinite systems that may be singular (redundant contacts)."""

import jax
import jax.numpy as jnp

# With a unit diagonal the matrix counts as singular when it has an eigenvalue below this
# multiple of its rounding errors, eps * m.
_SINGULAR = 100.0
_WRITTEN_OUT = 4  # sizes up to it are eliminated by scalars: faster than LAPACK in a batch


def solve_definite(g: jax.Array, right: jax.Array) -> jax.Array:
    """`G x = right` for a symmetric positive definite G: needs no pivots."""
    m = right.shape[0]
    if m > _WRITTEN_OUT:
        return jnp.linalg.solve(g, right)
    rows = [[g[i, j] for j in range(m)] for i in range(m)]
    values = [right[i] for i in range(m)]
    for k in range(m):
        for i in range(k + 1, m):
            factor = rows[i][k] / rows[k][k]
            values[i] = values[i] - factor * values[k]
            for j in range(k + 1, m):
                rows[i][j] = rows[i][j] - factor * rows[k][j]
    found: list[jax.Array] = []
    for i in reversed(range(m)):
        known = sum((rows[i][m - 1 - n] * x for n, x in enumerate(found)), jnp.zeros_like(right[0]))
        found.append((values[i] - known) / rows[i][i])
    return jnp.stack(found[::-1])


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
        return solve_definite(g, right), no, no
    projector, singular = null_projector(g)
    x = solve_definite(g + projector, right)
    residual = jnp.abs(g @ x - right).max()
    missed = residual > jnp.sqrt(jnp.finfo(g.dtype).eps) * jnp.abs(right).max()
    return x, singular, singular & missed
