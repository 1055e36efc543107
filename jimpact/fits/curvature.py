"""Bias of fitted parameters where the law bends within the errors of the velocities
before.

True v- are found by a law that is linearized at them (`errors_before`). Where it is
curved, or has a kink, residuals have a mean that is not 0, and parameters follow it.
"""

from collections.abc import Iterator

import jax
import numpy as np
from jaxtyping import Array, Float

from jimpact.fits.checks import Judged
from jimpact.fits.findings import Finding
from jimpact.fits.problem import FitProblem
from jimpact.fits.solve import AnyArray
from jimpact.tools.compiling import quick_jit

# Bias from which on the report names it, in standard errors: an interval of 95 % then
# holds the truth in 94 % of sets. Ten times more: in 15 %.
WORTH_NAMING = 0.3


@quick_jit
def _predicted(
    problem: FitProblem, x: Float[AnyArray, " P"], pre: Float[AnyArray, "K N"]
) -> Float[Array, "K n"]:
    """v+ of shots with these v-, by the law with parameters x; NaN where it fails."""
    prediction = problem.with_velocities(pre).observe(problem.law_in_scene(x))
    return jax.numpy.where(prediction.bad, np.nan, prediction.value)


def mean_of_residuals(judged: Judged) -> Float[np.ndarray, "K n"]:
    """The mean that residuals have by the curvature of the law, to second order.

    Equation: `-1/2 sum_i (f(a + s_i) - 2 f(a) + f(a - s_i))`, where `V = sum_i s_i
    s_i^T` is the covariance of the true v- of a shot, a. Where the law fails beside a,
    the mean is 0.
    """
    problem = judged.problem
    solution = judged.solution
    assert problem.before is not None
    assert solution.pre is not None
    assert solution.slopes is not None
    covariance = problem.before.covariance_of_true(solution.slopes)
    variances, directions = np.linalg.eigh(covariance)
    deviations = np.sqrt(np.maximum(variances, 0.0))
    steps = directions * deviations[:, None, :]
    x = np.asarray(solution.value, problem.dtype)
    bare = problem.without_host()

    def law_at(pre: np.ndarray) -> np.ndarray:
        """v+ (K, n) of the fitted law."""
        velocities = problem.with_velocities_before(pre).observe.pre  # type: ignore[attr-defined]
        return np.asarray(_predicted(bare, x, velocities), float)

    middle = law_at(solution.pre)
    bends = np.zeros_like(middle)
    for i in range(steps.shape[2]):
        step = steps[:, :, i]
        ahead = law_at(solution.pre + step)
        bends += ahead - 2 * middle + law_at(solution.pre - step)
    return np.nan_to_num(-0.5 * bends)


def bias(judged: Judged) -> Float[np.ndarray, " P"]:
    """Bias of the parameters by `mean_of_residuals`, by linear propagation."""
    mean = judged.problem.measurement.independent(mean_of_residuals(judged))
    # residuals are predicted less measured; those of priors have no mean
    of_priors = np.zeros(len(judged.problem.priors))
    rows = np.append(-mean.ravel(), of_priors)[judged.used]
    solved = np.linalg.lstsq(judged.jacobian, -rows, rcond=1e-9)
    scaled = solved[0]
    return scaled * judged.problem.steps_at(judged.solution.value)


def bent_within_errors(judged: Judged) -> Iterator[Finding]:
    """Yield `bent` where the law bends within the errors of v-, so that parameters are
    biased.
    """
    if judged.problem.before is None or judged.solution.pre is None:
        return
    size = bias(judged)
    error = judged.errors.standard_error
    known = np.isfinite(error) & (error > 0)
    allowed = WORTH_NAMING * np.where(known, error, np.inf)
    worth = known & (np.abs(size) > allowed)
    names = judged.problem.names
    parts = [f"{names[i]} by about {size[i]:+.2g}" for i in np.flatnonzero(worth)]
    if parts:
        yield Finding(
            "bent",
            f"The law bends within the errors of v-, which moves {', '.join(parts)}: "
            f"measure v- better, or state `sigma_pre` = 0 where they are exact, as of "
            f"bodies at rest.",
            "the law bends within the errors of v-",
            numbers={names[i]: float(size[i]) for i in np.flatnonzero(worth)},
        )
