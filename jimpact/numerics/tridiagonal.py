"""A symmetric tridiagonal matrix stored as its two diagonals (the Delassus matrix of a
chain).
"""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jimpact.numerics.sparse import Neighbours, Sparse


def tridiagonal_product(
    on_diagonal: Float[Array, "m *#B"],
    off_diagonal: Float[Array, "m-1 *#B"],
    vector: Float[Array, "m *#B"],
) -> Float[Array, "m *#B"]:
    """`(A x)_j = d_j x_j + o_j-1 x_j-1 + o_j x_j+1`, given d_j x_j: symmetric
    tridiagonal A.
    """
    none = jnp.zeros_like(vector[:1])
    lower = jnp.concatenate([none, off_diagonal * vector[:-1]])
    upper = jnp.concatenate([off_diagonal * vector[1:], none])
    return on_diagonal + lower + upper


class Tridiagonal(eqx.Module):
    """Symmetric tridiagonal matrix.

    `regular`: known to be regular whatever its values (a chain with no more contacts
    than bodies).
    """

    diagonal: Float[Array, "m *B"]
    off_diagonal: Float[Array, "m-1 *B"]
    regular: bool = eqx.field(static=True, default=False)

    def __matmul__(self, vector: Float[ArrayLike, "m *B"]) -> Float[Array, "m *B"]:
        """Product `A x` in O(m); batches in further axes of all three."""
        vector = jnp.asarray(vector)
        return tridiagonal_product(self.diagonal * vector, self.off_diagonal, vector)

    def __abs__(self) -> "Tridiagonal":
        """|A|, entry by entry."""
        entries = jnp.abs(self.off_diagonal)
        return Tridiagonal(jnp.abs(self.diagonal), entries, self.regular)

    def as_matrix(self) -> Float[Array, "m m *B"]:
        """The dense matrix."""
        m = self.diagonal.shape[0]
        i = jnp.arange(m)
        batch = self.diagonal.shape[1:]
        dense = jnp.zeros((m, m, *batch), self.diagonal.dtype)
        dense = dense.at[i, i].set(self.diagonal)
        upper = i[:-1], i[1:]
        dense = dense.at[upper].set(self.off_diagonal)
        lower = i[1:], i[:-1]
        return dense.at[lower].set(self.off_diagonal)

    def scaled(self, scale: Float[Array, " m"]) -> "Tridiagonal":
        """`diag(scale) A diag(scale)`."""
        off = self.off_diagonal * scale[:-1] * scale[1:]
        return Tridiagonal(self.diagonal * scale**2, off, self.regular)


Symmetric = jax.Array | Tridiagonal | Sparse

# Which entries off the diagonal are stored: all (None), those of a chain, or those of
# neighbours.
Structure = Literal["chain"] | Neighbours | None


def structure_of(matrix: Symmetric) -> Structure:
    """The structure in which a matrix is stored."""
    if isinstance(matrix, Sparse):
        return matrix.neighbours
    if isinstance(matrix, Tridiagonal):
        return "chain"
    return None


def off_diagonal(matrix: Symmetric) -> Float[Array, "..."]:
    """Entries off the diagonal: (m, K) of neighbours, (m - 1,) of a chain, upper
    triangle else.
    """
    if isinstance(matrix, Sparse):
        return matrix.entries
    if isinstance(matrix, Tridiagonal):
        return matrix.off_diagonal
    return matrix[jnp.triu_indices(len(matrix), 1)]


def as_matrix(matrix: Symmetric) -> Float[Array, "m m *B"]:
    """Dense form of a matrix."""
    if isinstance(matrix, (Tridiagonal, Sparse)):
        return matrix.as_matrix()
    return matrix


def diagonal(matrix: Symmetric) -> Float[Array, "m *B"]:
    """Diagonal of a matrix."""
    if isinstance(matrix, (Tridiagonal, Sparse)):
        return matrix.diagonal
    return jnp.diagonal(matrix)


def is_regular(matrix: Symmetric) -> bool:
    """True if the matrix is known to be regular without looking at its values."""
    return isinstance(matrix, Tridiagonal) and matrix.regular


def scaled(matrix: Symmetric, scale: Float[Array, " m"]) -> Symmetric:
    """`diag(scale) A diag(scale)` in the form `matrix` has."""
    if isinstance(matrix, (Tridiagonal, Sparse)):
        return matrix.scaled(scale)
    return matrix * scale[:, None] * scale[None, :]
