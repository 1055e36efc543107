"""Errors of fitted parameters: covariance, rank, and what the data do not determine."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.linalg import qr

from jimpact.fits.problem import FitProblem
from jimpact.fits.search import FitMinimum
from jimpact.fits.solve import RANK_TOLERANCE

# A parameter takes part in an undetermined combination if its share of that direction
# exceeds this; shares of parameters that take no part are errors of the derivatives,
# about 1e-6.
TAKES_PART = 1e-3

# the size, in natural scales, in which undetermined combinations are stated
SMALL_CHANGE = 0.01


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Errors of P parameters by the linearized law; `Fit` says what each field is."""

    rank: int
    singular_values: Float[np.ndarray, " P"]
    degrees_of_freedom: int
    noise: float
    covariance: Float[np.ndarray, "P P"]
    correlation: Float[np.ndarray, "P P"]
    standard_error: Float[np.ndarray, " P"]
    identifiability: tuple[str, ...]


def uncertainty(
    problem: FitProblem, minimum: FitMinimum, noise: float | None = None
) -> Uncertainty:
    """Linearized errors at a minimum.

    Equation: `C = s^2 (J^T J)^-1` on the determined subspace,
    `s^2 = |r|^2 / (values - rank)`, or the known noise (1 where the weights are known
    errors); rank = number of singular values of J, its columns scaled by the natural
    size of each parameter, above `RANK_TOLERANCE` times the largest. Data without sigma
    that are reproduced to the last digit do not show their noise.

    Args:
        problem: least squares.
        minimum: its residual and Jacobian.
        noise: s; None: 1 where sigma is stated, else from |r|^2.
    """
    scale = problem.steps_at(minimum.value)
    jacobian = minimum.jacobian
    # all P right singular vectors, which the thin form has unless there are fewer rows
    # than P
    _, singular, directions = np.linalg.svd(
        jacobian, full_matrices=len(jacobian) < len(scale)
    )
    singular = np.pad(singular, (0, len(scale) - len(singular)))
    rank = int(np.sum(singular > RANK_TOLERANCE[problem.precision] * singular[0]))
    freedom = problem.values - rank
    if noise is None:
        shown = freedom >= 1 and minimum.sum_of_squares > problem.exact_squares
        if shown:
            estimated = float(np.sqrt(minimum.sum_of_squares / freedom))
        else:
            estimated = np.nan
        if problem.sigma is None:
            noise = estimated
        else:
            noise = 1.0
    determined = directions[:rank] / singular[:rank, None]
    covariance = noise**2 * (determined.T @ determined) * np.outer(scale, scale)
    null = directions[rank:]  # combinations of parameters that change no residual
    lost = np.any(np.abs(null) > TAKES_PART, axis=0)
    covariance[lost, :] = covariance[:, lost] = np.nan
    covariance[lost, lost] = np.inf
    error = np.sqrt(np.diag(covariance))
    with np.errstate(divide="ignore", invalid="ignore"):
        correlation = covariance / np.outer(error, error)
    np.fill_diagonal(correlation, 1.0)
    if len(null):
        unseen = _reduced(null)
    else:
        unseen = null
    words = (*problem.notes, *(_in_words(problem, row, scale) for row in unseen))
    return Uncertainty(
        rank, singular, freedom, noise, covariance, correlation, error, words
    )


def _reduced(null: Float[np.ndarray, "D P"]) -> Float[np.ndarray, "D P"]:
    """The reduced row echelon form of D directions: the same subspace, few parameters
    in each.

    By `N T = Q [R1 R2]` with column pivoting T: the rows `[I, R1^-1 R2] T^T` span what
    N spans.
    """
    _, rows, pivots = qr(null, mode="economic", pivoting=True)
    rows[:, pivots] = np.linalg.solve(rows[:, : len(rows)], rows)
    return np.asarray(rows)


def _in_words(
    problem: FitProblem,
    direction: Float[np.ndarray, " P"],
    scale: Float[np.ndarray, " P"],
) -> str:
    """The sentence for a direction (of scaled parameters) that changes no prediction.

    It names the parameters in it with the changes that belong together, the largest one
    `SMALL_CHANGE` times `scale`.
    """
    names = problem.names
    log = problem.parameters.log
    if problem.experiments is None:
        value_name = "value"
    else:
        value_name = "velocity"
    parts = []
    taking_part = []
    step = SMALL_CHANGE * direction / np.abs(direction).max()
    for i in np.argsort(-np.abs(step), kind="stable"):
        if abs(step[i]) > TAKES_PART * SMALL_CHANGE:
            if log[i]:
                change = f"{100 * abs(step[i]):.2g} %"
            else:
                change = f"{abs(step[i] * scale[i]):.2g}"
            taking_part.append(names[i])
            parts.append(
                f"{names[i]} goes {'up' if step[i] > 0 else 'down'} by {change}"
            )
    if len(parts) == 1:
        return (
            f"The data cannot see {taking_part[0]}: no measured {value_name} depends "
            f"on it (to first order)."
        )
    return (
        f"The data cannot see a combination: no measured {value_name} changes (to "
        f"first order) when {', '.join(parts[:-1])} and {parts[-1]} together."
    )
