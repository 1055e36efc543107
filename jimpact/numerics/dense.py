"""Small dense systems: elimination, singular matrices, and how redundant contacts share
forces.

LAYOUT   Flows keep the batch in the last axis: matrices (n, n, B), vectors (n, B). The
functions `solve_definite`, `solve_mass_matrix`, `solve_by_pivots`, `singular_values`,
`eigenvectors`, `null_projector`, `solve_symmetric` and `determinants` have no batch.

WHICH ONE

    solve, inverse          regular by themselves or by a ridge: batches, without pivots
    solve_definite          symmetric positive definite, one matrix
    solve_mass_matrix       M, a diagonal or a matrix
    block_inverse, _solve   blocks of 2 or 3 rows of many contacts
    solve_by_pivots         any one matrix, with its determinant
    regularized, _once      singular symmetric ones of redundant contacts
    pseudoinverse           the same, with the least forces
    singular_values,        one matrix whose rank is asked for
    eigenvectors
    elsewhere               `sparse.conjugate_gradients` for packings

LAPACK   Its kernels go through a batch one by one. So they factor single matrices; in
batches, loops of our own do, up to `_BY_LOOP` rows.

COMPILING   Elimination of more than two rows is a loop over the pivots, and products of
more than `COLUMNS_WRITTEN_OUT` columns are reductions: programs do not grow with the
number of contacts.

SINGULAR MATRICES   Where contacts are redundant, many forces give the same motion.
Velocities never depend on the choice; it decides which contact reaches its friction
cone first:

    sticking contacts, in the plane   in proportion to mu F: `load_shares` weight a
                                      `regularized` system. They break loose together.
    sticking contacts, in space       least sum of squares: `pseudoinverse`, taken once
                                      a step, when the normal forces of its stages are
                                      not known yet
    normal forces and impulses        least sum of squares, in the scaling with unit
                                      diagonal
"""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jimpact.tools.compiling import full_precision
from jimpact.tools.loops import cond, fori_loop, while_loop
from jimpact.tools.masks import quotient
from jimpact.tools.precision import precision

# Rows up to which a loop of our own factors a matrix, not LAPACK: in a batch that is
# three to six times as fast for 4 rows. With ten times more the cubic cost of many
# contacts would not be blocked.
_BY_LOOP = 16
# Rows up to which a loop of our own eliminates block by block: as many again take eight
# times as long, which LAPACK does in half of that.
_BLOCKS = 64
# Columns up to which products are written out: a reduction does not fuse with what
# follows it, and is no vector operation: four times as long for the 12 of four contacts
# with friction in space. Ten times more would make large programs of long chains.
COLUMNS_WRITTEN_OUT = 12
# Parts of a matrix below this multiple of sqrt(eps) of its largest entry are none in
# its pseudoinverse. Ten times more would drop small, regular parts.
_NEGLIGIBLE_PART = 4.0
# over all pairs of up to 16 columns; 10 are enough, more only cost time
_JACOBI_SWEEPS = 12
# iterations, each of which squares the error; ten times more only cost time
_NEWTON_SCHULZ = 3


# ---- products


def unit(matrix: Float[Array, "n n *B"]) -> Float[Array, "n n ..."]:
    """The unit matrix, with an axis of length 1 for each batch axis of the matrix."""
    axes_of_batch = [1] * (matrix.ndim - 2)
    identity = jnp.eye(len(matrix), dtype=matrix.dtype)
    return identity.reshape(*matrix.shape[:2], *axes_of_batch)


def unit_outside(
    matrix: Float[Array, "n n"], held: Bool[Array, " n"]
) -> Float[Array, "n n"]:
    """The matrix in the rows and columns `held`, the unit matrix elsewhere."""
    in_row = held[:, None]
    in_column = held[None, :]
    both = in_row & in_column
    return jnp.where(both, matrix, unit(matrix))


def times(
    matrix: Float[Array, "a b *#B"], vector: Float[Array, "b *#B"]
) -> Float[Array, "a *#B"]:
    """Products `A x = sum_j A_j x_j` of columns A_j; one matrix without batch serves
    all x.
    """
    if matrix.ndim == 2:
        return matrix @ vector
    if matrix.shape[1] > COLUMNS_WRITTEN_OUT:
        return jnp.sum(matrix * vector[None], axis=1)
    count = matrix.shape[1]
    columns = [matrix[:, j] * vector[j : j + 1] for j in range(count)]
    return functools.reduce(jnp.add, columns)


def product(
    a: Float[Array, "n k *#B"], b: Float[Array, "k l *#B"]
) -> Float[Array, "n l *#B"]:
    """Products of matrices, `A B = sum_j A_j b_j`, of columns A_j of A and rows b_j of
    B.
    """
    if a.shape[1] > COLUMNS_WRITTEN_OUT:
        terms = a[:, :, None] * b[None]
        return jnp.sum(terms, axis=1)
    rank_one = [a[:, j, None] * b[j][None] for j in range(a.shape[1])]
    return functools.reduce(jnp.add, rank_one)


# ---- elimination


def solve(
    matrix: Float[Array, "n n *#B"], right: Float[Array, "n c *#B"]
) -> Float[Array, "n c *#B"]:
    """`A^-1 right` for c right sides of each matrix A.

    Gauss-Jordan in a loop over the pivots, which are not chosen: matrices that are
    similar to a positive definite one do not need that.
    """
    n = len(matrix)
    if n == 1:
        return right / matrix
    # written out: the loop takes 8 % of a batch of impacts with planar friction
    if n == 2:
        return _solve_two(matrix, right)
    return _eliminated(matrix, right, lambda pivot: 1 / pivot)


def _eliminated(
    matrix: Float[Array, "n n *#B"],
    right: Float[Array, "n c *#B"],
    inverted: Callable[[jax.Array], jax.Array],
) -> Float[Array, "n c *#B"]:
    """`A^-1 right` by Gauss-Jordan in a loop over the pivots; `inverted` gives 1 /
    pivot.
    """
    n = len(matrix)
    axes_of_batch = [1] * (matrix.ndim - 2)
    number = jnp.arange(n).reshape(n, 1, *axes_of_batch)

    def eliminate(
        k: Int[Array, ""] | int, rows: Float[Array, "n w *B"]
    ) -> Float[Array, "n w *B"]:
        """Rows of [A, right] after pivot k: row k is divided by it, other a_jk are
        0.
        """
        row = jax.lax.dynamic_index_in_dim(rows, k, 0)
        row = row * inverted(jax.lax.dynamic_index_in_dim(row, k, 1))
        factor = jax.lax.dynamic_index_in_dim(rows, k, 1)
        return jnp.where(number == k, row, rows - factor * row)

    both = jnp.concatenate([matrix, right], axis=1)
    return fori_loop(0, n, eliminate, both)[:, n:]


def _solve_two(
    matrix: Float[Array, "2 2 *#B"], right: Float[Array, "2 c *#B"]
) -> Float[Array, "2 c *#B"]:
    """`A^-1 right` for two rows, by the operations of `_eliminated`, written out."""
    # of row 0, 1 / a_00 and a_10
    scale = 1 / matrix[0, :1]
    factor = matrix[1, :1]
    above = matrix[0, 1:] * scale
    x = right[0] * scale
    last_pivot = matrix[1, 1:] - factor * above
    last = (right[1] - factor * x) * (1 / last_pivot)
    return jnp.stack([x - above * last, last])


def inverse(matrix: Float[Array, "n n *B"]) -> Float[Array, "n n *B"]:
    """A^-1 by Gauss-Jordan in place of A, without a choice of pivots as in `solve`."""
    n = len(matrix)
    if n <= 2:
        return solve(matrix, jnp.broadcast_to(unit(matrix), matrix.shape))
    axes_of_batch = [1] * (matrix.ndim - 2)
    number = jnp.arange(n).reshape(n, 1, *axes_of_batch)

    def eliminate(
        k: Int[Array, ""] | int, rows: Float[Array, "n n *B"]
    ) -> Float[Array, "n n *B"]:
        """The matrix after pivot k; column k is then that of the eliminations so
        far.
        """
        # masks of row and column k
        in_row = number == k
        in_column = number[:, 0][None] == k
        column = jax.lax.dynamic_index_in_dim(rows, k, 1)
        row = jax.lax.dynamic_index_in_dim(rows, k, 0)
        scale = 1 / jax.lax.dynamic_index_in_dim(row, k, 1)
        row = jnp.where(in_column, scale, row * scale)
        others = jnp.where(in_column, 0.0, rows)
        return jnp.where(in_row, row, others - column * row)

    return fori_loop(0, n, eliminate, matrix)


@jax.jit
def solve_definite(
    g: Float[Array, "m m"], right: Float[Array, "m *c"]
) -> Float[Array, "m *c"]:
    """`G^-1 right` for a symmetric positive definite G and one or several right
    sides.
    """
    if len(g) > _BY_LOOP:
        return jnp.linalg.solve(g, right)
    columns = right.reshape(len(g), -1, 1)
    return solve(g[..., None], columns).reshape(right.shape)


@jax.jit
def solve_mass_matrix(
    mass: Float[Array, " n"] | Float[Array, "n n"], right: Float[Array, "n *c"]
) -> Float[Array, "n *c"]:
    """`M^-1 right` of a mass matrix M, or of its diagonal, for one or several right
    sides.

    NaN where M is a matrix that is not positive definite.
    """
    if mass.ndim == 1:
        axes_of_columns = [1] * (right.ndim - 1)
        return right / mass.reshape(-1, *axes_of_columns)
    if len(mass) > _BY_LOOP:
        return jax.scipy.linalg.solve(mass, right, assume_a="pos")
    columns = right.reshape(len(mass), -1, 1)
    solved = _eliminated(
        mass[..., None], columns, lambda p: 1 / jnp.where(p > 0, p, jnp.nan)
    )
    return solved.reshape(right.shape)


def block_inverse(matrix: Float[Array, "m b m b N"]) -> Float[Array, "m b m b N"]:
    """Inverses of N matrices of m by m blocks, block by block, b = 2 or 3, without
    pivots.

    A singular block is perturbed by eps^(2/3), which refinements by the caller undo.
    More would perturb regular blocks, too, in single precision.
    """
    perturbation = precision(matrix.dtype).eps ** (2 / 3)
    m = len(matrix)
    b = matrix.shape[1]
    eye = jnp.eye(b, dtype=matrix.dtype)[..., None]

    def eliminate(
        i: Int[Array, ""] | int, inverse: Float[Array, "m b m b N"]
    ) -> Float[Array, "m b m b N"]:
        """Matrices after Gauss-Jordan elimination in place, with diagonal block i as
        pivot.
        """
        pivot = (jnp.arange(m) == i)[:, None, None, None]
        # (m, b, b, N) and (b, m, b, N) of blocks
        column = inverse[:, :, i]
        row = inverse[i]
        block = _small_inverse(column[i], perturbation)
        column = jnp.where(pivot, -eye[None], column)
        in_column = pivot[:, 0][None]
        row = jnp.where(in_column, eye[:, None], row)
        terms = block[:, :, None, None] * row[None]
        row = jnp.sum(terms, axis=1)  # block times row
        # row i and column i of blocks
        replaced = pivot[..., None] | pivot[None, None, :, 0]
        # column times row
        terms = column[:, :, :, None, None] * row[None, None]
        spread = jnp.sum(terms, axis=2)
        return jnp.where(replaced, 0.0, inverse) - spread

    return fori_loop(0, m, eliminate, matrix)


def block_solve(
    matrix: Float[Array, "m b m b"], right: Float[Array, "m b c"]
) -> Float[Array, "m b c"]:
    """`A^-1 right` of one matrix A of m by m blocks, block by block, without pivots.

    Of more than `_BLOCKS` rows by LAPACK.
    """
    m, b = matrix.shape[:2]
    if m * b > _BLOCKS:
        square = matrix.reshape(m * b, m * b)
        flat = square, right.reshape(m * b, -1)
        return jnp.linalg.solve(*flat).reshape(right.shape)
    perturbation = precision(matrix.dtype).eps ** 2  # of a block that is singular
    flat_rows = matrix.reshape(m, b, m * b)
    rows = jnp.concatenate([flat_rows, right], axis=2)

    def eliminate(
        i: Int[Array, ""] | int, rows: Float[Array, "m b w"]
    ) -> Float[Array, "m b w"]:
        """Rows of [A, right] after elimination with the diagonal block i as pivot."""
        row = jax.lax.dynamic_index_in_dim(rows, i, 0, keepdims=False)
        block = jax.lax.dynamic_slice_in_dim(row, i * b, b, axis=1)
        row = _small_inverse(block[..., None], perturbation)[..., 0] @ row
        column = jax.lax.dynamic_slice_in_dim(rows, i * b, b, axis=2)
        rows = rows - jnp.einsum("jab,bk->jak", column, row)
        return jax.lax.dynamic_update_index_in_dim(rows, row, i, 0)

    return fori_loop(0, m, eliminate, rows)[..., m * b :]


def _small_inverse(
    block: Float[Array, "b b N"], perturbation: float
) -> Float[Array, "b b N"]:
    """Inverses `adj(A) / det(A)` of blocks, b = 2 or 3, perturbed where they are
    singular.
    """
    singular = jnp.abs(_small_determinant(block)) < perturbation
    b = len(block)
    eye = jnp.eye(b, dtype=block.dtype)[..., None]
    shift = jnp.where(singular, perturbation, 0.0)
    block = block + shift[None, None] * eye
    determinant = _small_determinant(block)
    divisor = jnp.where(determinant == 0, 1.0, determinant)
    return _cofactors(block) / divisor[None, None]


def _small_determinant(a: Float[Array, "b b N"]) -> Float[Array, " N"]:
    """Determinants of blocks, b = 2 or 3: the first row times its cofactors."""
    cofactors = _cofactors(a)[:, 0]
    return jnp.sum(a[0] * cofactors, axis=0)


def _cofactors(a: Float[Array, "b b N"]) -> Float[Array, "b b N"]:
    """Adjugates `adj(A) = det(A) A^-1` of blocks, b = 2 or 3; their columns are cross
    products.
    """
    if len(a) == 2:
        first = jnp.stack([a[1, 1], -a[0, 1]])
        second = jnp.stack([-a[1, 0], a[0, 0]])
        return jnp.stack([first, second])
    cyclic = ((1, 2), (2, 0), (0, 1))
    sides = [jnp.cross(a[i], a[j], axis=0) for i, j in cyclic]
    return jnp.stack(sides, axis=1)


@jax.jit
def solve_by_pivots(
    matrix: Float[Array, "n n"], right: Float[Array, "n c"]
) -> tuple[Float[Array, "n c"], Float[Array, ""]]:
    """`A^-1 right` of any matrix A, and its determinant.

    Gauss-Jordan with partial pivoting, in a loop over the pivots. Where the matrix is
    singular the determinant is 0 and the solution not finite.
    """
    n = len(matrix)
    number = jnp.arange(n)[:, None]

    def eliminate(
        k: Int[Array, ""] | int, state: tuple[Float[Array, "n w"], Float[Array, ""]]
    ) -> tuple[Float[Array, "n w"], Float[Array, ""]]:
        """Rows of [A, right] after the largest pivot in column k; the product of all
        pivots.
        """
        rows, determinant = state
        column = jax.lax.dynamic_index_in_dim(rows, k, 1)
        size = jnp.where(number >= k, jnp.abs(column), -1.0)
        largest = jnp.argmax(size, axis=0)[0]
        # the rows k and `largest` change places
        row_of = functools.partial(jax.lax.dynamic_index_in_dim, rows, axis=0)
        own, chosen = (row_of(i) for i in (k, largest))
        pivot = jax.lax.dynamic_index_in_dim(chosen, k, 1)
        rows = jnp.where(number == largest, own, rows)
        row = chosen / pivot
        factor = jax.lax.dynamic_index_in_dim(rows, k, 1)
        signed = jnp.where(largest == k, pivot, -pivot)[0, 0]
        # NaN after 0
        determinant = jnp.where(determinant == 0, 0.0, determinant * signed)
        return jnp.where(number == k, row, rows - factor * row), determinant

    one = jnp.ones((), matrix.dtype)
    start = jnp.concatenate([matrix, right], axis=1), one
    rows, determinant = fori_loop(0, n, eliminate, start)
    return rows[:, n:], determinant


def determinants(k: Float[Array, "N n n"]) -> Float[Array, " N"]:
    """Determinants of N matrices.

    Those of four rows are sums of products of minors of two rows (Laplace), quicker to
    compile.
    """
    if k.shape[-1] != 4:
        none = jnp.zeros((k.shape[-1], 0), k.dtype)
        return jax.vmap(lambda matrix: solve_by_pivots(matrix, none)[1])(k)
    left, right = np.triu_indices(4, 1)
    # entries of each row in both columns of a minor
    a = k[..., left]
    b = k[..., right]
    # of rows 1 and 2, of 3 and 4
    products = a[:, ::2] * b[:, 1::2]
    minors = products - b[:, ::2] * a[:, 1::2]
    odd = (left + right) % 2
    signs = jnp.asarray(np.where(odd, 1, -1), k.dtype)
    opposite = minors[:, 1, ::-1]
    return jnp.sum(minors[:, 0] * opposite * signs[None], axis=-1)


# ---- singular matrices: redundant contacts


def load_shares(
    limit: Float[Array, "m *B"], least: float = 0.0
) -> Float[Array, "m *B"]:
    """Weights `limit_j / max_k limit_k` of the contacts in the sharing of redundant
    forces.

    None is below `least`, which keeps the weights of contacts without load regular.
    """
    most = jnp.max(limit, axis=0, keepdims=True)
    largest = jax.lax.stop_gradient(most)
    share = limit / jnp.where(largest > 0, largest, 1.0)
    if least > 0:
        return jnp.maximum(share, least)
    return share


def regularized(
    matrix: Float[Array, "n n *#B"],
    right: Float[Array, "n *#B"],
    ridge: Float[Array, "n *#B"],
    refinements: int,
    without_null: bool = False,
) -> Float[Array, "n *#B"]:
    """z with `A z = right` where A may be singular: `(A + diag(ridge))^-1` and
    refinements.

    One matrix without batch serves all right sides, with a ridge of one column.
    Each refinement `z <- z + (A + ridge)^-1 (right - A z)` removes what the ridge
    changes where A is regular, and makes the derivatives right in one order more: the
    inverse has none. In the null space of A the inverse is large, and so is its
    rounding: `without_null` subtracts that part.

    The barriers keep XLA from computing what is multiplied once more for each column.
    """
    kept = jax.lax.optimization_barrier  # computed once, see above
    # apart: only the right side is linear in tangents
    matrix = kept(matrix)
    right = kept(right)
    if matrix.ndim == 2:
        on_diagonal = ridge
    else:
        on_diagonal = ridge[:, None]
    inverted = jax.lax.stop_gradient(inverse(matrix + unit(matrix) * on_diagonal))

    def solved(right: Float[Array, "n *#B"]) -> Float[Array, "n *#B"]:
        """`z = (A + ridge)^-1 right`, `without_null` less `(A + ridge)^-1 ridge z`."""
        z = times(inverted, right)
        if without_null:
            return z - times(inverted, ridge * z)
        return z

    z = solved(right)
    for _ in range(refinements):
        z = kept(z)
        z = z + solved(kept(right - times(matrix, z)))
    return z


@jax.custom_jvp
def regularized_once(
    matrix: Float[Array, "n n *#B"],
    ridge: Float[Array, "n *#B"],
    right: Float[Array, "n *#B"],
) -> Float[Array, "n *#B"]:
    """`regularized` with one refinement; tangents solve the same equations."""
    return regularized(matrix, right, ridge, 1)


@regularized_once.defjvp
@full_precision
def _regularized_tangent(
    primals: Any, tangents: Any
) -> tuple[Float[Array, "n *#B"], Float[Array, "n *#B"]]:
    """z with `A z = right`, and its tangent dz, which solves
    `A dz = d right - dA z`.
    """
    matrix, ridge, right = primals
    dmatrix, _, dright = tangents
    z = regularized_once(matrix, ridge, right)
    return z, regularized_once(matrix, ridge, dright - times(dmatrix, z))


def pseudoinverse(
    matrix: Float[Array, "n n *B"], held: Bool[Array, "n *B"]
) -> Float[Array, "n n *B"]:
    """Pseudoinverses of positive semidefinite K in the rows and columns `held`; 0
    elsewhere.

    It starts with a ridge, which Newton and Schulz's iteration `Z <- 2 Z - Z K Z`
    removes from what K transmits, to rounding; in the null space of K, forces are the
    least ones to some percent.
    """
    both = held[:, None] & held[None]
    k = jnp.where(both, matrix, 0.0)
    entries = jnp.abs(k)
    size = jnp.max(entries, axis=(0, 1), keepdims=True)
    eps = float(jnp.finfo(k.dtype).eps)
    positive = jnp.where(size > 0, size, 1.0)
    part = _NEGLIGIBLE_PART * math.sqrt(eps) * positive
    ridge = jnp.where(held[:, None], part, 1.0)
    damped = inverse(k + unit(k) * ridge)
    z = product(damped, product(k, damped))
    for _ in range(_NEWTON_SCHULZ):
        z = 2 * z - product(z, product(k, z))
    return z


class SingularValues(NamedTuple):
    """Singular value decomposition `A = left diag(values) right`, values falling, of N
    matrices.

    `null` marks the values that are 0; their vectors are an orthonormal basis of the
    null space.
    """

    left: Float[Array, "*N n n"]
    values: Float[Array, "*N n"]
    right: Float[Array, "*N n n"]
    null: Bool[Array, "*N n"]


def _are_null(values: Float[Array, "n *N"]) -> Bool[Array, "n *N"]:
    """Mask of singular values that are rounding: `<= precision.singular n` times the
    largest.
    """
    rounding = precision(values.dtype).singular * len(values)
    return values <= rounding * values[:1]


@jax.custom_batching.custom_vmap
def singular_values(matrix: Float[Array, "n n"]) -> SingularValues:
    """Singular value decomposition of one matrix, without derivatives."""
    left, values, right = jnp.linalg.svd(matrix)
    return SingularValues(left, values, right, _are_null(values))


@singular_values.def_vmap
def _batch_of_singular_values(
    size: int, batched: Any, matrices: Float[Array, "N n n"]
) -> tuple[SingularValues, Any]:
    """Rule of `vmap`: Jacobi's rotations give `A V = U diag(values)` with orthogonal V.

    Columns of U that belong to values of 0 come from the same rotations of A^T.
    """
    yes: Any = True
    all_batched = SingularValues(left=yes, values=yes, right=yes, null=yes)
    if matrices.shape[-1] > _BY_LOOP:
        left, values, right = jnp.linalg.svd(matrices)
        return SingularValues(left, values, right, _are_null(values.T).T), all_batched
    matrix = jnp.moveaxis(matrices, 0, -1)
    images, right, values = _orthogonal(matrix)
    null = _are_null(values)
    left = images / jnp.where(null, 1.0, values)[None]
    left = cond(
        jnp.any(null),
        lambda: jnp.where(null[None], _orthogonal(matrix.swapaxes(0, 1))[1], left),
        lambda: left,
    )
    parts = left, values, right.swapaxes(0, 1), null
    in_front = (jnp.moveaxis(x, -1, 0) for x in parts)
    return SingularValues(*in_front), all_batched


@jax.custom_batching.custom_vmap
def eigenvectors(
    matrix: Float[Array, "n n"],
) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """Eigenvalues and, in columns, eigenvectors of one positive semidefinite matrix,
    without derivatives.
    """
    values, vectors = jnp.linalg.eigh(matrix)
    return values, vectors


@eigenvectors.def_vmap
def _batch_of_eigenvectors(
    size: int, batched: Any, matrices: Float[Array, "N n n"]
) -> tuple[tuple[Float[Array, "N n"], Float[Array, "N n n"]], tuple[bool, bool]]:
    """Rule of `vmap`: V by Jacobi's rotations, eigenvalues as the lengths of columns of
    A V.
    """
    if matrices.shape[-1] > _BY_LOOP:
        values, vectors = jnp.linalg.eigh(matrices)
        return (values, vectors), (True, True)
    _, vectors, values = _orthogonal(jnp.moveaxis(matrices, 0, -1))
    in_front = jnp.moveaxis(vectors, -1, 0)
    return (values.T, in_front), (True, True)


def _orthogonal(
    matrix: Float[Array, "n n B"],
) -> tuple[Float[Array, "n n B"], Float[Array, "n n B"], Float[Array, "n B"]]:
    """`A V` with orthogonal columns, the orthogonal V, and the falling lengths of
    columns of A V.

    In each round, columns at the same place of two rows are rotated. Then all but the
    first move on by one place, so that after a sweep each has met each.

    Source: Hestenes, J. SIAM 6 (1958); Brent and Luk, SIAM J. Sci. Stat. Comput. 6
    (1985).
    """
    n = len(matrix)
    # an odd number of columns: one of zeros, which no rotation changes
    places = n + n % 2
    identity = jnp.broadcast_to(unit(matrix), matrix.shape)
    both = jnp.concatenate([matrix, identity])
    missing = (0, places - n)
    both = jnp.pad(both, ((0, 0), missing, (0, 0)))

    class Sweep(NamedTuple):
        """Columns of [A V; V] in two rows, the largest cos^2 between two of A V, sweeps
        done.
        """

        first: Float[Array, "entries pairs B"]
        second: Float[Array, "entries pairs B"]
        cosine: Float[Array, ""]
        done: Int[Array, ""]

    def rotate(_: Any, at: Sweep) -> Sweep:
        """State after one round: columns x, y of a pair are turned until x . y = 0, and
        move on.

        The slope t of the angle is the small root of
        `t^2 + (|y|^2 - |x|^2) / (x . y) t = 1`.
        """
        x, y, largest, done = at
        terms = x[:n] * y[:n]
        product = jnp.sum(terms, axis=0, keepdims=True)
        squares = [
            jnp.sum(columns[:n] ** 2, axis=0, keepdims=True) for columns in (x, y)
        ]
        half = (squares[1] - squares[0]) / 2
        real = jnp.minimum(*squares) > (rounding**2) * whole  # other columns are 0
        of_both = squares[0] * squares[1]
        angle = quotient(product**2, of_both, where=real)
        root = jnp.sqrt(half**2 + product**2)
        longer = jnp.where(half >= 0, half + root, half - root)
        slope = product / jnp.where(longer != 0, longer, 1.0)
        cosine = 1 / jnp.sqrt(1 + slope**2)
        sine = slope * cosine
        x, y = cosine * x - sine * y, sine * x + cosine * y
        largest = jnp.maximum(largest, jnp.max(angle))
        if places == 2:
            return Sweep(x, y, largest, done)
        x, y = _moved_on(x, y)
        return Sweep(x, y, largest, done)

    def sweep(at: Sweep) -> Sweep:
        """State after a sweep: as many rounds as make each column meet each other
        one.
        """
        start = at._replace(cosine=jnp.zeros_like(at.cosine))
        end = fori_loop(0, places - 1, rotate, start)
        return end._replace(done=at.done + 1)

    rounding = n * precision(matrix.dtype).eps
    entries_squared = matrix**2
    whole = jnp.sum(entries_squared, axis=(0, 1), keepdims=True)
    first, second = jnp.split(both, 2, axis=1)
    one = jnp.ones((), matrix.dtype)
    start = Sweep(first, second, one, jnp.int32(0))
    end = while_loop(
        lambda at: (at.cosine > rounding**2) & (at.done < _JACOBI_SWEEPS), sweep, start
    )
    with_padding = jnp.concatenate([end.first, end.second], axis=1)
    both = with_padding[:, :n]
    return _by_falling_length(both[:n], both[n:])


def _moved_on(
    x: Float[Array, "entries pairs B"], y: Float[Array, "entries pairs B"]
) -> tuple[Float[Array, "entries pairs B"], Float[Array, "entries pairs B"]]:
    """Two rows of columns whose columns but the first move on by one place, round."""
    kept_places = x[:, 1:-1]
    first = jnp.concatenate([x[:, :1], y[:, :1], kept_places], axis=1)
    second = jnp.concatenate([y[:, 1:], x[:, -1:]], axis=1)
    return first, second


def _by_falling_length(
    images: Float[Array, "n n B"], vectors: Float[Array, "n n B"]
) -> tuple[Float[Array, "n n B"], Float[Array, "n n B"], Float[Array, "n B"]]:
    """Columns of A V and of V in the order of the falling lengths of A V, and these."""
    length = jnp.sqrt(jnp.sum(images**2, axis=0))
    order = jnp.argsort(-length, axis=0)
    ordered_images = jnp.take_along_axis(images, order[None], axis=1)
    ordered_vectors = jnp.take_along_axis(vectors, order[None], axis=1)
    falling = jnp.take_along_axis(length, order, axis=0)
    return ordered_images, ordered_vectors, falling


def null_projector(
    g: Float[Array, "m m"],
) -> tuple[Float[Array, "m m"], Bool[Array, ""]]:
    """Orthogonal projector on the null space of G (unit diagonal), and whether it is
    not 0.

    Held constant in derivatives: a perturbation is taken to keep the rank.
    """
    values, vectors = eigenvectors(jax.lax.stop_gradient(g))
    null = values < precision(g.dtype).singular * len(g)
    basis = jnp.where(null[None, :], vectors, 0.0)
    return basis @ basis.T, jnp.any(null)


def solve_symmetric(
    g: Float[Array, "m m"], right: Float[Array, " m"], *, regular: bool = False
) -> tuple[Float[Array, " m"], Bool[Array, ""], Bool[Array, ""]]:
    """x of least norm with `G x = right`, whether G is singular, and whether no x
    solves it.

    G is symmetric positive semidefinite with a diagonal of order 1; `regular` if that
    is known beforehand. With P the projector on its null space, `(G + P) x = right`.
    """
    if regular:
        no = jnp.asarray(False)
        return solve_definite(g, right), no, no
    projector, singular = null_projector(g)
    x = solve_definite(g + projector, right)
    residual = jnp.abs(g @ x - right).max()
    largest = jnp.abs(right).max()
    missed = residual > precision(g.dtype).root * largest
    return x, singular, singular & missed
