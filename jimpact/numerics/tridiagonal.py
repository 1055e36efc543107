"""A symmetric tridiagonal matrix stored as its two diagonals (the Delassus matrix of a chain)."""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp

from jimpact.numerics.sparse import Neighbours, Sparse

Triple = tuple[jax.Array, jax.Array, jax.Array]


def tridiagonal_product(
    on_diagonal: jax.Array, off_diagonal: jax.Array, vector: jax.Array
) -> jax.Array:
    """`A vector` (m, ..) of a symmetric tridiagonal A, given what its diagonal makes of it."""
    none = jnp.zeros_like(vector[:1])
    lower = jnp.concatenate([none, off_diagonal * vector[:-1]])
    upper = jnp.concatenate([off_diagonal * vector[1:], none])
    return on_diagonal + lower + upper


class Tridiagonal(eqx.Module):
    """Symmetric tridiagonal matrix: `diagonal` (m,), `off_diagonal` (m - 1,).

    `regular`: known to be regular whatever its values (a chain with no more contacts than bodies).
    """

    diagonal: jax.Array
    off_diagonal: jax.Array
    regular: bool = eqx.field(static=True, default=False)

    def __matmul__(self, vector: jax.Array) -> jax.Array:
        """Matrix-vector product in O(m); batches in further axes of all three."""
        return tridiagonal_product(self.diagonal * vector, self.off_diagonal, vector)

    def solve(self, vector: jax.Array) -> jax.Array:
        """`A^-1 vector` for a positive definite matrix, in O(m)."""
        none = jnp.zeros_like(vector[:1])
        first = jnp.ones_like(none), none, none

        def eliminate(row: Triple, entries: Triple) -> tuple[Triple, Triple]:
            """A row of the bidiagonal system, from the row above."""
            pivot, right, before = row  # of the row above, and its off-diagonal entry
            diagonal, known, after = entries[0][None], entries[1][None], entries[2][None]
            factor = before / pivot
            reduced = diagonal - factor * before, known - factor * right, after
            return reduced, reduced

        after = jnp.concatenate([self.off_diagonal, none])
        _, (pivot, right, after) = jax.lax.scan(eliminate, first, (self.diagonal, vector, after))

        def substitute(x: jax.Array, row: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array]:
            """An unknown, from the one below."""
            pivot, right, after = row
            x = (right - after * x) / pivot
            return x, x

        rows = pivot, right, after
        return jax.lax.scan(substitute, none, rows, reverse=True)[1].reshape(vector.shape)

    def __abs__(self) -> "Tridiagonal":
        """|A|, entry by entry."""
        return Tridiagonal(jnp.abs(self.diagonal), jnp.abs(self.off_diagonal), self.regular)

    def as_matrix(self) -> jax.Array:
        """The dense (m, m) matrix."""
        m = self.diagonal.shape[0]
        i = jnp.arange(m)
        dense = jnp.zeros((m, m, *self.diagonal.shape[1:]), self.diagonal.dtype)
        dense = dense.at[i, i].set(self.diagonal)
        dense = dense.at[i[:-1], i[1:]].set(self.off_diagonal)
        return dense.at[i[1:], i[:-1]].set(self.off_diagonal)

    def scaled(self, scale: jax.Array) -> "Tridiagonal":
        """`diag(scale) A diag(scale)`."""
        off = self.off_diagonal * scale[:-1] * scale[1:]
        return Tridiagonal(self.diagonal * scale**2, off, self.regular)


Symmetric = jax.Array | Tridiagonal | Sparse

# Which entries off the diagonal are stored: all (None), those of a chain, or those of neighbours.
Structure = Literal["chain"] | Neighbours | None


def structure_of(matrix: Symmetric) -> Structure:
    """The structure in which a matrix is stored."""
    if isinstance(matrix, Sparse):
        return matrix.neighbours
    return "chain" if isinstance(matrix, Tridiagonal) else None


def off_diagonal(matrix: Symmetric) -> jax.Array:
    """Entries off the diagonal: (m, K) of neighbours, (m - 1,) of a chain, the upper triangle."""
    if isinstance(matrix, Sparse):
        return matrix.entries
    if isinstance(matrix, Tridiagonal):
        return matrix.off_diagonal
    return matrix[jnp.triu_indices(len(matrix), 1)]


def as_matrix(matrix: Symmetric) -> jax.Array:
    """Dense form of a matrix."""
    return matrix.as_matrix() if isinstance(matrix, (Tridiagonal, Sparse)) else matrix


def diagonal(matrix: Symmetric) -> jax.Array:
    """Diagonal of a matrix."""
    return matrix.diagonal if isinstance(matrix, (Tridiagonal, Sparse)) else jnp.diagonal(matrix)


def is_regular(matrix: Symmetric) -> bool:
    """Whether the matrix is known to be regular without looking at its values."""
    return isinstance(matrix, Tridiagonal) and matrix.regular


def scaled(matrix: Symmetric, scale: jax.Array) -> Symmetric:
    """`diag(scale) A diag(scale)` in the form `matrix` has."""
    if isinstance(matrix, (Tridiagonal, Sparse)):
        return matrix.scaled(scale)
    return matrix * scale[:, None] * scale[None, :]
