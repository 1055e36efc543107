"""A symmetric tridiagonal matrix kept as its two diagonals (the Delassus matrix of a chain)."""

import equinox as eqx
import jax
import jax.numpy as jnp


class Tridiagonal(eqx.Module):
    """Symmetric tridiagonal matrix: `diagonal` (m,), `off_diagonal` (m - 1,).

    `regular`: known to be regular whatever its values (a chain with no more contacts than bodies).
    """

    diagonal: jax.Array
    off_diagonal: jax.Array
    regular: bool = eqx.field(static=True, default=False)

    def __matmul__(self, vector: jax.Array) -> jax.Array:
        """Matrix-vector product in O(m)."""
        lower = jnp.pad(self.off_diagonal * vector[:-1], (1, 0))
        upper = jnp.pad(self.off_diagonal * vector[1:], (0, 1))
        return self.diagonal * vector + lower + upper

    def as_matrix(self) -> jax.Array:
        """The dense (m, m) matrix."""
        off = self.off_diagonal
        return jnp.diag(self.diagonal) + jnp.diag(off, 1) + jnp.diag(off, -1)

    def scaled(self, scale: jax.Array) -> "Tridiagonal":
        """`diag(scale) A diag(scale)`."""
        off = self.off_diagonal * scale[:-1] * scale[1:]
        return Tridiagonal(self.diagonal * scale**2, off, self.regular)


Symmetric = jax.Array | Tridiagonal


def as_matrix(matrix: Symmetric) -> jax.Array:
    """Dense form of a `Tridiagonal` or an array."""
    return matrix.as_matrix() if isinstance(matrix, Tridiagonal) else matrix


def diagonal(matrix: Symmetric) -> jax.Array:
    """Diagonal of a `Tridiagonal` or an array."""
    return matrix.diagonal if isinstance(matrix, Tridiagonal) else jnp.diagonal(matrix)


def is_regular(matrix: Symmetric) -> bool:
    """Whether the matrix is known to be regular without looking at its values."""
    return isinstance(matrix, Tridiagonal) and matrix.regular


def scaled(matrix: Symmetric, scale: jax.Array) -> Symmetric:
    """`diag(scale) A diag(scale)` in the form `matrix` has."""
    if isinstance(matrix, Tridiagonal):
        return matrix.scaled(scale)
    return matrix * scale[:, None] * scale[None, :]
