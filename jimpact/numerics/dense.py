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
    n = len(matrix)
    identity = jnp.eye(n, dtype=matrix.dtype)
    return identity.reshape(n, n, *axes_of_batch)


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
    count = matrix.shape[1]
    if count > COLUMNS_WRITTEN_OUT:
        terms = matrix * vector[None]
        return jnp.sum(terms, axis=1)
    columns = [matrix[:, j] * vector[j : j + 1] for j in range(count)]
    return functools.reduce(jnp.add, columns)


def product(
    a: Float[Array, "n k *#B"], b: Float[Array, "k l *#B"]
) -> Float[Array, "n l *#B"]:
    """Products of matrices, `A B = sum_j A_j b_j`, of columns A_j of A and rows b_j of
    B.
    """
    count = a.shape[1]
    if count > COLUMNS_WRITTEN_OUT:
        terms = a[:, :, None] * b[None]
        return jnp.sum(terms, axis=1)
    rank_one = [a[:, j, None] * b[j][None] for j in range(count)]
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
        pivot = jax.lax.dynamic_index_in_dim(row, k, 1)
        row = row * inverted(pivot)
        factor = jax.lax.dynamic_index_in_dim(rows, k, 1)
        cleared = rows - factor * row
        return jnp.where(number == k, row, cleared)

    both = jnp.concatenate([matrix, right], axis=1)
    last = fori_loop(0, n, eliminate, both)
    return last[:, n:]


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
    last_scale = 1 / last_pivot
    rest = right[1] - factor * x
    last = rest * last_scale
    first = x - above * last
    return jnp.stack([first, last])


def inverse(matrix: Float[Array, "n n *B"]) -> Float[Array, "n n *B"]:
    """A^-1 by Gauss-Jordan in place of A, without a choice of pivots as in `solve`."""
    n = len(matrix)
    if n <= 2:
        identity = jnp.broadcast_to(unit(matrix), matrix.shape)
        return solve(matrix, identity)
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
        pivot = jax.lax.dynamic_index_in_dim(row, k, 1)
        scale = 1 / pivot
        row = jnp.where(in_column, scale, row * scale)
        others = jnp.where(in_column, 0.0, rows)
        cleared = others - column * row
        return jnp.where(in_row, row, cleared)

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
    solution = solve(g[..., None], columns)
    return solution.reshape(right.shape)


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
        diagonal = mass.reshape(-1, *axes_of_columns)
        return right / diagonal
    if len(mass) > _BY_LOOP:
        return jax.scipy.linalg.solve(mass, right, assume_a="pos")
    columns = right.reshape(len(mass), -1, 1)

    def inverted(pivot: jax.Array) -> jax.Array:
        """1 / pivot, NaN where it is not positive."""
        positive = pivot > 0
        return 1 / jnp.where(positive, pivot, jnp.nan)

    solved = _eliminated(mass[..., None], columns, inverted)
    return solved.reshape(right.shape)


def block_inverse(matrix: Float[Array, "m b m b N"]) -> Float[Array, "m b m b N"]:
    """Inverses of N matrices of m by m blocks, block by block, b = 2 or 3, without
    pivots.

    A singular block is perturbed by eps^(2/3), which refinements by the caller undo.
    More would perturb regular blocks, too, in single precision.
    """
    eps = precision(matrix.dtype).eps
    perturbation = eps ** (2 / 3)
    m, b, *_ = matrix.shape
    eye = jnp.eye(b, dtype=matrix.dtype)[..., None]

    def eliminate(
        i: Int[Array, ""] | int, inverse: Float[Array, "m b m b N"]
    ) -> Float[Array, "m b m b N"]:
        """Matrices after Gauss-Jordan elimination in place, with diagonal block i as
        pivot.
        """
        is_pivot = jnp.arange(m) == i
        pivot = is_pivot[:, None, None, None]
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
        in_row = pivot[..., None]
        in_column = pivot[None, None, :, 0]
        replaced = in_row | in_column
        # column times row
        terms = column[:, :, :, None, None] * row[None, None]
        spread = jnp.sum(terms, axis=2)
        others = jnp.where(replaced, 0.0, inverse)
        return others - spread

    return fori_loop(0, m, eliminate, matrix)


def block_solve(
    matrix: Float[Array, "m b m b"], right: Float[Array, "m b c"]
) -> Float[Array, "m b c"]:
    """`A^-1 right` of one matrix A of m by m blocks, block by block, without pivots.

    Of more than `_BLOCKS` rows by LAPACK.
    """
    m, b, *_ = matrix.shape
    n = m * b
    if n > _BLOCKS:
        square = matrix.reshape(n, n)
        columns = right.reshape(n, -1)
        solution = jnp.linalg.solve(square, columns)
        return solution.reshape(right.shape)
    eps = precision(matrix.dtype).eps
    perturbation = eps**2  # of a block that is singular
    flat_rows = matrix.reshape(m, b, n)
    rows = jnp.concatenate([flat_rows, right], axis=2)

    def eliminate(
        i: Int[Array, ""] | int, rows: Float[Array, "m b w"]
    ) -> Float[Array, "m b w"]:
        """Rows of [A, right] after elimination with the diagonal block i as pivot."""
        row = jax.lax.dynamic_index_in_dim(rows, i, 0, keepdims=False)
        first = i * b
        block = jax.lax.dynamic_slice_in_dim(row, first, b, axis=1)
        inverse = _small_inverse(block[..., None], perturbation)
        row = inverse[..., 0] @ row
        column = jax.lax.dynamic_slice_in_dim(rows, first, b, axis=2)
        rows = rows - jnp.einsum("jab,bk->jak", column, row)
        return jax.lax.dynamic_update_index_in_dim(rows, row, i, 0)

    last = fori_loop(0, m, eliminate, rows)
    return last[..., n:]


def _small_inverse(
    block: Float[Array, "b b N"], perturbation: float
) -> Float[Array, "b b N"]:
    """Inverses `adj(A) / det(A)` of blocks, b = 2 or 3, perturbed where they are
    singular.
    """
    size = jnp.abs(_small_determinant(block))
    singular = size < perturbation
    b = len(block)
    eye = jnp.eye(b, dtype=block.dtype)[..., None]
    shift = jnp.where(singular, perturbation, 0.0)
    block = block + shift[None, None] * eye
    determinant = _small_determinant(block)
    is_zero = determinant == 0
    divisor = jnp.where(is_zero, 1.0, determinant)
    adjugate = _cofactors(block)
    return adjugate / divisor[None, None]


def _small_determinant(a: Float[Array, "b b N"]) -> Float[Array, " N"]:
    """Determinants of blocks, b = 2 or 3: the first row times its cofactors."""
    cofactors = _cofactors(a)[:, 0]
    products = a[0] * cofactors
    return jnp.sum(products, axis=0)


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
        below = number >= k
        size = jnp.where(below, jnp.abs(column), -1.0)
        largest = jnp.argmax(size, axis=0)[0]
        # the rows k and `largest` change places
        row_of = functools.partial(jax.lax.dynamic_index_in_dim, rows, axis=0)
        row_k = row_of(k)
        chosen = row_of(largest)
        pivot = jax.lax.dynamic_index_in_dim(chosen, k, 1)
        rows = jnp.where(number == largest, row_k, rows)
        row = chosen / pivot
        factor = jax.lax.dynamic_index_in_dim(rows, k, 1)
        stays = largest == k
        signed = jnp.where(stays, pivot, -pivot)[0, 0]
        # NaN after 0
        singular = determinant == 0
        determinant = jnp.where(singular, 0.0, determinant * signed)
        cleared = rows - factor * row
        return jnp.where(number == k, row, cleared), determinant

    one = jnp.ones((), matrix.dtype)
    both = jnp.concatenate([matrix, right], axis=1)
    start = both, one
    rows, determinant = fori_loop(0, n, eliminate, start)
    return rows[:, n:], determinant


def determinants(k: Float[Array, "N n n"]) -> Float[Array, " N"]:
    """Determinants of N matrices.

    Those of four rows are sums of products of minors of two rows (Laplace), quicker to
    compile.
    """
    n = k.shape[-1]
    if n != 4:
        none = jnp.zeros((n, 0), k.dtype)

        def determinant(matrix: Float[Array, "n n"]) -> Float[Array, ""]:
            """Determinant of one matrix, by pivots."""
            _, value = solve_by_pivots(matrix, none)
            return value

        return jax.vmap(determinant)(k)
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
    terms = minors[:, 0] * opposite * signs[None]
    return jnp.sum(terms, axis=-1)


# ---- singular matrices: redundant contacts


def load_shares(
    limit: Float[Array, "m *B"], least: float = 0.0
) -> Float[Array, "m *B"]:
    """Weights `limit_j / max_k limit_k` of the contacts in the sharing of redundant
    forces.

    `limit` >= 0: the largest force of each contact, mu F of friction. No weight is
    below `least`, which keeps those of contacts without load regular; all are `least`
    where none has a load.
    """
    largest = jnp.max(limit, axis=0, keepdims=True)
    # forces are shared alike whatever all weights are multiplied by
    largest = jax.lax.stop_gradient(largest)
    some = largest > 0
    share = limit / jnp.where(some, largest, 1.0)
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
    once = jax.lax.optimization_barrier  # computed once, see above
    # apart: only the right side is linear in tangents
    matrix = once(matrix)
    right = once(right)
    if matrix.ndim == 2:
        on_diagonal = ridge
    else:
        on_diagonal = ridge[:, None]
    with_ridge = matrix + unit(matrix) * on_diagonal
    inverted = jax.lax.stop_gradient(inverse(with_ridge))

    def solved(right: Float[Array, "n *#B"]) -> Float[Array, "n *#B"]:
        """`z = (A + ridge)^-1 right`, `without_null` less `(A + ridge)^-1 ridge z`."""
        z = times(inverted, right)
        if without_null:
            of_null = times(inverted, ridge * z)
            return z - of_null
        return z

    z = solved(right)
    for _ in range(refinements):
        z = once(z)
        rest = right - times(matrix, z)
        z = z + solved(once(rest))
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
    rest = dright - times(dmatrix, z)
    return z, regularized_once(matrix, ridge, rest)


def pseudoinverse(
    matrix: Float[Array, "n n *B"], held: Bool[Array, "n *B"]
) -> Float[Array, "n n *B"]:
    """Pseudoinverses of positive semidefinite K in the rows and columns `held`; 0
    elsewhere.

    It starts with a ridge, which Newton and Schulz's iteration `Z <- 2 Z - Z K Z`
    removes from what K transmits, to rounding; in the null space of K, forces are the
    least ones to some percent.
    """
    rows = held[:, None]
    both = rows & held[None]
    k = jnp.where(both, matrix, 0.0)
    entries = jnp.abs(k)
    size = jnp.max(entries, axis=(0, 1), keepdims=True)
    eps = float(jnp.finfo(k.dtype).eps)
    some = size > 0
    positive = jnp.where(some, size, 1.0)
    part = _NEGLIGIBLE_PART * math.sqrt(eps) * positive
    ridge = jnp.where(rows, part, 1.0)
    damped = inverse(k + unit(k) * ridge)
    of_k = product(k, damped)
    z = product(damped, of_k)
    for _ in range(_NEWTON_SCHULZ):
        k_z = product(k, z)
        z = 2 * z - product(z, k_z)
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
    null = _are_null(values)
    return SingularValues(left, values, right, null)


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
        null = _are_null(values.T)
        found = SingularValues(left, values, right, null.T)
        return found, all_batched
    matrix = jnp.moveaxis(matrices, 0, -1)
    images, right, values = _orthogonal(matrix)
    null = _are_null(values)
    divisor = jnp.where(null, 1.0, values)
    left = images / divisor[None]

    def with_null() -> Float[Array, "n n N"]:
        """U whose columns of values 0 come from the rotations of A^T."""
        _, of_transposed, _ = _orthogonal(matrix.swapaxes(0, 1))
        return jnp.where(null[None], of_transposed, left)

    left = cond(jnp.any(null), with_null, lambda: left)
    rows = right.swapaxes(0, 1)
    parts = left, values, rows, null
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
    matrix = jnp.moveaxis(matrices, 0, -1)
    _, vectors, values = _orthogonal(matrix)
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
    rounding = n * precision(matrix.dtype).eps
    entries_squared = matrix**2
    whole = jnp.sum(entries_squared, axis=(0, 1), keepdims=True)

    def rotate(_: Any, state: _Sweep) -> _Sweep:
        """State after one round: the columns of each pair are turned, and move on."""
        x, y, largest, done = state
        x, y, cosine = _turned(x, y, n, rounding**2 * whole)
        largest = jnp.maximum(largest, jnp.max(cosine))
        if places > 2:
            x, y = _moved_on(x, y)
        return _Sweep(x, y, largest, done)

    def sweep(state: _Sweep) -> _Sweep:
        """State after a sweep: as many rounds as make each column meet each other
        one.
        """
        none = jnp.zeros_like(state.cosine)
        start = state._replace(cosine=none)
        end = fori_loop(0, places - 1, rotate, start)
        return end._replace(done=state.done + 1)

    def goes_on(state: _Sweep) -> Bool[Array, ""]:
        """True until all columns are orthogonal but for rounding."""
        oblique = state.cosine > rounding**2
        some_left = state.done < _JACOBI_SWEEPS
        return oblique & some_left

    first, second = jnp.split(both, 2, axis=1)
    one = jnp.ones((), matrix.dtype)
    start = _Sweep(first, second, one, jnp.int32(0))
    end = while_loop(goes_on, sweep, start)
    with_padding = jnp.concatenate([end.first, end.second], axis=1)
    both = with_padding[:, :n]
    images = both[:n]
    vectors = both[n:]
    return _by_falling_length(images, vectors)


class _Sweep(NamedTuple):
    """Columns of [A V; V] in two rows, the largest cos^2 between two of A V, sweeps
    done.
    """

    first: Float[Array, "entries pairs B"]
    second: Float[Array, "entries pairs B"]
    cosine: Float[Array, ""]
    done: Int[Array, ""]


def _turned(
    x: Float[Array, "entries pairs B"],
    y: Float[Array, "entries pairs B"],
    n: int,
    negligible: Float[Array, "1 1 B"],
) -> tuple[
    Float[Array, "entries pairs B"],
    Float[Array, "entries pairs B"],
    Float[Array, "1 pairs B"],
]:
    """Columns x, y of each pair turned until x . y = 0 over their first n entries, and
    cos^2 of the angle that they had.

    The slope t of the turn is the small root of
    `t^2 + (|y|^2 - |x|^2) / (x . y) t = 1`. The angle of columns whose squares are
    `negligible` counts as right.
    """
    product = jnp.sum(x[:n] * y[:n], axis=0, keepdims=True)
    square_x = jnp.sum(x[:n] ** 2, axis=0, keepdims=True)
    square_y = jnp.sum(y[:n] ** 2, axis=0, keepdims=True)
    half = (square_y - square_x) / 2
    real = jnp.minimum(square_x, square_y) > negligible  # other columns are 0
    of_both = square_x * square_y
    square_of_cosine = quotient(product**2, of_both, where=real)
    root = jnp.sqrt(half**2 + product**2)
    positive = half >= 0
    longer = jnp.where(positive, half + root, half - root)
    some = longer != 0
    slope = product / jnp.where(some, longer, 1.0)
    cosine = 1 / jnp.sqrt(1 + slope**2)
    sine = slope * cosine
    turned_x = cosine * x - sine * y
    turned_y = sine * x + cosine * y
    return turned_x, turned_y, square_of_cosine


def _moved_on(
    x: Float[Array, "entries pairs B"], y: Float[Array, "entries pairs B"]
) -> tuple[Float[Array, "entries pairs B"], Float[Array, "entries pairs B"]]:
    """Two rows of columns whose columns but the first move on by one place, round."""
    first_x = x[:, :1]
    last_x = x[:, -1:]
    first_y = y[:, :1]
    first = jnp.concatenate([first_x, first_y, x[:, 1:-1]], axis=1)
    second = jnp.concatenate([y[:, 1:], last_x], axis=1)
    return first, second


def _by_falling_length(
    images: Float[Array, "n n B"], vectors: Float[Array, "n n B"]
) -> tuple[Float[Array, "n n B"], Float[Array, "n n B"], Float[Array, "n B"]]:
    """Columns of A V and of V in the order of the falling lengths of A V, and these."""
    squares = jnp.sum(images**2, axis=0)
    length = jnp.sqrt(squares)
    order = jnp.argsort(-length, axis=0)
    columns = order[None]
    ordered_images = jnp.take_along_axis(images, columns, axis=1)
    ordered_vectors = jnp.take_along_axis(vectors, columns, axis=1)
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
    rounding = precision(g.dtype).singular * len(g)
    null = values < rounding
    basis = jnp.where(null[None, :], vectors, 0.0)
    projector = basis @ basis.T
    return projector, jnp.any(null)


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
    allowed = precision(g.dtype).root * largest
    missed = residual > allowed
    return x, singular, singular & missed
