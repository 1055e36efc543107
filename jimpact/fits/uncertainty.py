"""Covariance, rank and what the data do not determine, from the Jacobian of weighted residuals."""

from typing import NamedTuple

import numpy as np

# Singular values of the scaled Jacobian below this share of the largest are zero: derivatives of
# an impact are good to about 1e-7 (float64; 1e-4 in float32), so smaller ones may be errors.
RANK_TOLERANCE = {"float64": 1e-6, "float32": 1e-3}

# A parameter takes part in an undetermined combination if its share of that direction exceeds this;
# shares of parameters that take no part are errors of the derivatives, about 1e-6.
TAKES_PART = 1e-3

SMALL_CHANGE = 0.01  # the size, in natural scales, in which undetermined combinations are stated


class Uncertainty(NamedTuple):
    """Errors of P parameters; see `Fit` for the meaning of inf and NaN."""

    rank: int
    singular_values: np.ndarray
    degrees_of_freedom: int
    noise: float
    covariance: np.ndarray
    correlation: np.ndarray
    standard_error: np.ndarray
    undetermined: tuple[str, ...]


def uncertainty(
    names: tuple[str, ...],
    jacobian: np.ndarray,
    scale: np.ndarray,
    log: np.ndarray,
    sum_of_squares: float,
    values: int,
    noise: float | None,
    rank_tolerance: float,
    value_name: str,
) -> Uncertainty:
    """Linearized errors at a minimum.

    Equation: `C = s^2 (J^T J)^-1` on the determined subspace, `s^2 = |r|^2 / (values - rank)`, or
    the known noise (1 where the weights are known errors); rank = number of singular values of J,
    its columns scaled by the natural size of each parameter, above `rank_tolerance` times the
    largest.

    Args:
        names: of the parameters (P,).
        jacobian: (R, P) of the weighted residuals, columns already scaled.
        scale: the natural size (P,) of each parameter.
        log: (P,) whether changes are given in percent.
        sum_of_squares: |r|^2.
        values: independent measured values.
        noise: s; None: from |r|^2.
        rank_tolerance: see `RANK_TOLERANCE`.
        value_name: what a measured value is called.
    """
    _, singular, directions = np.linalg.svd(jacobian, full_matrices=True)
    singular = np.pad(singular, (0, len(names) - len(singular)))
    rank = int(np.sum(singular > rank_tolerance * singular[0]))
    freedom = values - rank
    if noise is None:
        noise = float(np.sqrt(sum_of_squares / freedom)) if freedom > 0 else np.nan
    determined = directions[:rank] / singular[:rank, None]
    covariance = noise**2 * (determined.T @ determined) * np.outer(scale, scale)
    null = directions[rank:]
    lost = np.any(np.abs(null) > TAKES_PART, axis=0)
    covariance[lost, :] = covariance[:, lost] = np.nan
    covariance[lost, lost] = np.inf
    error = np.sqrt(np.diag(covariance))
    with np.errstate(divide="ignore", invalid="ignore"):
        correlation = covariance / np.outer(error, error)
    np.fill_diagonal(correlation, 1.0)
    undetermined = tuple(_in_words(names, row, scale, log, value_name) for row in _reduced(null))
    return Uncertainty(rank, singular, freedom, noise, covariance, correlation, error, undetermined)


def _reduced(null: np.ndarray) -> np.ndarray:
    """The same subspace in reduced row echelon form: each direction with few parameters."""
    rows = null.copy()
    for i in range(len(rows)):
        row, column = divmod(int(np.argmax(np.abs(rows[i:]))), rows.shape[1])
        rows[[i, i + row]] = rows[[i + row, i]]
        rows[i] /= rows[i, column]
        others = np.arange(len(rows)) != i
        rows[others] -= np.outer(rows[others, column], rows[i])
    return rows


def _in_words(
    names: tuple[str, ...],
    direction: np.ndarray,
    scale: np.ndarray,
    log: np.ndarray,
    value_name: str,
) -> str:
    """A direction that leaves all predictions as they are, as small changes of parameters."""
    parts = []
    step = SMALL_CHANGE * direction / np.abs(direction).max()
    for i in np.argsort(-np.abs(step), kind="stable"):
        if abs(step[i]) > TAKES_PART * SMALL_CHANGE:
            change = f"{100 * abs(step[i]):.2g} %" if log[i] else f"{abs(step[i] * scale[i]):.2g}"
            parts.append(f"{names[i]} goes {'up' if step[i] > 0 else 'down'} by {change}")
    if len(parts) == 1:
        name = parts[0].split(" ")[0]
        return (
            f"The data cannot see {name}: no measured {value_name} depends on it (to first order)."
        )
    return (
        f"The data cannot see a combination: no measured {value_name} changes (to first order) "
        f"when {', '.join(parts[:-1])} and {parts[-1]} together."
    )
