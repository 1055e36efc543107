"""Fits that outliers move little: least squares with weights of the last residuals, repeated."""

from typing import NamedTuple

import numpy as np

from jimpact.fits.adequacy import MEDIAN
from jimpact.fits.problem import FitProblem
from jimpact.fits.search import SearchResult, find_near
from jimpact.fits.solve import Search

HUBER = 1.345  # sigmas up to which a residual counts squared: 95 % of the efficiency
STUDENT = 4.0  # degrees of freedom of the tails
ROUNDS = 50  # of weights
SAME = 1e-7  # in natural scales of the parameters: the weights have settled


class RobustSolution(NamedTuple):
    """The end of a search, factors its loss puts on the weights, noise times root of freedom."""

    solution: SearchResult
    factor: np.ndarray
    noise: float


def _huber(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """psi(u) / u and psi'(u)."""
    inside = np.abs(u) <= HUBER
    return np.where(inside, 1.0, HUBER / np.where(inside, 1.0, np.abs(u))), inside.astype(float)


def _student(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """psi(u) / u and psi'(u)."""
    below = STUDENT + u**2
    return (STUDENT + 1) / below, (STUDENT + 1) * (STUDENT - u**2) / below**2


LOSSES = {"huber": _huber, "student": _student}


def robust_solution(
    problem: FitProblem, solution: SearchResult, loss: str, search: Search
) -> tuple[FitProblem, RobustSolution]:
    """Least squares again and again, with weights `psi(u) / u` of the last residuals u.

    Equation: the covariance is `s^2 mean(psi^2) / mean(psi')^2 (J^T J)^-1` (Huber, 1981).
    """
    here = ~np.isnan(problem.measured)
    for _ in range(ROUNDS):
        problem = problem.with_errors_before(solution.slopes)
        error = problem.independent(problem.measured - solution.predicted)
        scale = 1.0
        if problem.sigma is None:
            scale = max(MEDIAN * float(np.median(np.abs(error[here]))), np.finfo(float).tiny)
        share, slope = LOSSES[loss](error / scale)
        factor, before = np.sqrt(share), solution.y
        solution = find_near(problem.weighed(factor), solution.y, search)
        if np.abs(solution.y - before).max() <= SAME:
            break
    else:
        solution = solution._replace(converged=False)
    psi = (share * error / scale)[here]
    noise = scale * np.sqrt(np.sum(psi**2)) / max(slope[here].mean(), SAME)
    return problem, RobustSolution(solution, factor, float(noise))
