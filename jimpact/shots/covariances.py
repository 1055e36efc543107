"""Covariances of the velocities (v-, v+) of measured shots: one for each shot, or of
all shots.

Of each shot: (K, N, N) with N = 2n. Of all shots: (M, M) with M = N K, in the order v-,
v+ of shot 1, of shot 2, ...
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from jimpact.tools.checks import as_float_array, check_concrete, check_values

# Share of a variance up to which an eigenvalue of a correlation is rounding, or two
# entries that should be equal differ by it. Ten times more would pass shots whose v-
# and v+ are measured to 8 digits of each other; ten times less would refuse files of 10
# digits.
ROUNDING = 1e-10


def as_covariance(
    value: Any, shape: tuple[int, int]
) -> Float[np.ndarray, "K N N"] | Float[np.ndarray, "M M"]:
    """The checked covariance of the errors of (v-, v+) of K shots of n velocities.

    It must be positive definite for each shot, but for v- of variance 0, which are
    exact. That of all shots may be singular: without a force v+ of an impact is v- of
    the next.

    Args:
        value: of each shot, or of all shots.
        shape: (K, n).

    Returns:
        That of all shots only where errors of different shots are correlated.
    """
    check_concrete("covariance", value)
    as_float_array("covariance", value)  # raises for what are no numbers
    # in double precision, as errors of one impact may be nearly those of another
    count, n = shape
    array = np.asarray(value, float)
    of_each = (count, 2 * n, 2 * n)
    of_all = (2 * n * count, 2 * n * count)
    if array.shape == of_each[1:] and count == 1:
        array = array[None]
    if array.shape not in (of_each, of_all):
        raise ValueError(
            f"Argument `covariance` must have shape {of_each}, (v-, v+) of each shot, "
            f"or {of_all}, of all shots, but has shape {array.shape}. Rows and columns "
            f"of v- are 0 where they have no errors."
        )
    check_values("covariance", array)
    blocks = diagonal_blocks(array, 2 * n)
    for k, block in enumerate(blocks):
        before = np.arange(2 * n) < n
        _check_positive(block, f" in shot {k + 1}", exact=before, least=ROUNDING)
    if array.ndim == 2:
        from scipy.linalg import block_diag  # late: slow to import

        exact = np.tile(np.arange(2 * n) < n, count)
        _check_positive(array, " of all shots", exact, least=-ROUNDING)
        if not (array - block_diag(*blocks)).any():
            array = blocks
    return array


def _check_positive(
    matrix: Float[np.ndarray, "N N"],
    where: str,
    exact: Bool[np.ndarray, " N"],
    least: float,
) -> None:
    """Raise a ValueError unless a covariance is symmetric and its correlation positive
    definite.

    Args:
        matrix: covariance.
        where: end of the message.
        exact: True for entries that may have variance 0.
        least: lowest eigenvalue of the correlation that is allowed.
    """
    must = "Argument `covariance` must be"
    variance = np.diagonal(matrix)
    sizes = np.sqrt(np.abs(np.outer(variance, variance)))
    difference = np.abs(matrix - matrix.T)
    if not (difference <= ROUNDING * sizes).all():
        raise ValueError(f"{must} symmetric, but is not{where}.")
    unused = (variance == 0) & exact & ~matrix.any(axis=1)
    uncertain = ~unused
    if not (variance[uncertain] > 0).all():
        raise ValueError(f"{must} positive definite, but has a variance <= 0{where}.")
    block = np.ix_(uncertain, uncertain)
    correlation = matrix[block] / sizes[block]
    lowest = np.linalg.eigvalsh(correlation)[0]
    if lowest < least:
        raise ValueError(
            f"{must} positive definite, but its correlation has the eigenvalue "
            f"{lowest:.3g}{where}."
        )


def diagonal_blocks(covariance: Any, size: int) -> Float[np.ndarray, "K N N"]:
    """The covariance of each shot: as it is, or the diagonal blocks of that of all
    shots.
    """
    array = np.asarray(covariance, float)
    if array.ndim == 3:
        return array
    count = len(array) // size
    shot = np.arange(count)
    by_shots = array.reshape(count, size, count, size)
    return by_shots[shot, :, shot]


def covariance_of(
    covariance: Any, shots: Int[np.ndarray, " S"], n: int
) -> Float[np.ndarray, "S N N"] | Float[np.ndarray, "M M"]:
    """Covariance of (v-, v+) of some shots (indices from 0) of n velocities, in the
    same form.
    """
    array = np.asarray(covariance, float)
    if array.ndim == 3:
        return array[shots]
    first = 2 * n * np.asarray(shots)[:, None]
    rows = (first + np.arange(2 * n)).ravel()
    return array[np.ix_(rows, rows)]


def joined_covariance(many: Sequence[Any]) -> np.ndarray:
    """Covariance of the shots of several sets, one after the other, with independent
    errors.
    """
    if all(each.ndim == 3 for each in many):
        return np.concatenate(many)
    from scipy.linalg import block_diag  # late: slow to import

    return block_diag(*(block_diag(*each) if each.ndim == 3 else each for each in many))


def moved_covariance(
    covariance: Any, gain: Float[np.ndarray, "K m N"]
) -> Float[np.ndarray, "K m m"] | Float[np.ndarray, "K m K m"]:
    """The covariance `G C G^T` of values `G (v-, v+)` of each shot, or of all, G the
    gain.
    """
    array = np.asarray(covariance, float)
    if array.ndim == 3:
        return gain @ array @ gain.swapaxes(1, 2)
    count, _, size = gain.shape
    blocks = array.reshape(count, size, count, size)
    return np.einsum("kia,kalb,ljb->kilj", gain, blocks, gain, optimize=True)


def whitening(
    covariance: Float[np.ndarray, "K n n"] | Float[np.ndarray, "K n K n"],
    used: Bool[np.ndarray, "K n"],
) -> tuple[
    Float[np.ndarray, "K n"], Float[np.ndarray, "K n n"] | Float[np.ndarray, "K n K n"]
]:
    """Standard errors of values, and the whitening matrices of their errors.

    Equation: `L = F^-1`, F the Cholesky factor of the correlation: `L e / sigma` are
    independent.

    Args:
        covariance: of the values of each shot, or of all.
        used: True for values that take part; others count as independent, of error 1.

    Returns:
        sigma, and L in the shape of the covariance.

    Raises:
        ValueError: a combination of the values has no error.
    """
    if covariance.ndim == 3:
        rows = used
    else:
        rows = used.reshape(1, -1)
    size = rows.shape[1]  # of one matrix for each shot, or of one for all
    matrices = covariance.reshape(-1, size, size)
    both = rows[:, :, None] & rows[:, None, :]
    matrices = np.where(both, matrices, np.eye(size))
    variances = np.diagonal(matrices, axis1=1, axis2=2)
    errors = np.sqrt(variances)
    try:
        sizes = errors[:, :, None] * errors[:, None, :]
        factor = np.linalg.cholesky(matrices / sizes)
    except np.linalg.LinAlgError:
        raise ValueError(
            "Argument `covariance` must leave an error in each velocity after an "
            "impact that the law predicts from those before, but is singular there: "
            "are shots in it twice?"
        ) from None
    inverse = np.linalg.inv(factor)
    return errors.reshape(used.shape), inverse.reshape(covariance.shape)
