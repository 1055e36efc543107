"""The next experiment: which shots would determine the parameters of a fit best."""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import numpy as np

from jimpact._checks import as_whole, check_choice, check_kind
from jimpact.fits.experiments import Experiments
from jimpact.fits.fitting import Fit
from jimpact.fits.least_squares import BoxRegion
from jimpact.fits.multistart import quiet, repeated, run
from jimpact.fits.prediction import placed_fit
from jimpact.fits.problem import FitProblem, filled_up
from jimpact.scene import Scene

# Information that is added to that of the data, as a share of it: a combination of parameters that
# the data do not determine yet comes first.
_RIDGE = 1e-12


@dataclass(frozen=True, eq=False)
class Design:
    """Shots to do next, in order: their labels `shots` and places `index` among the candidates.

    `standard_error` (count, P) of the parameters `names` after each of them.
    """

    shots: tuple[str, ...]
    index: np.ndarray
    names: tuple[str, ...]
    standard_error: np.ndarray

    def __str__(self) -> str:
        lines = []
        for shot, errors in zip(self.shots, self.standard_error):
            text = ", ".join(f"{name} +- {x:.2g}" for name, x in zip(self.names, errors))
            lines.append(f"shot {shot}: {text}")
        return "\n".join(lines)


def design(
    fit: Fit,
    candidates: Experiments,
    scene: Scene | None = None,
    count: int = 1,
    target: str | None = None,
) -> Design:
    """The candidate shots that determine the parameters best, chosen one after another.

    Equation: a shot has the information `J^T J / sigma^2`. Each choice makes the determinant of the
    sum, earlier shots included, as large as possible, or the variance of the `target` as small as
    possible. This assumes that the fitted law is right. One program computes all candidates.

    Args:
        fit: to shots, with a known noise.
        candidates: velocities before (K, n), and scenes if they differ; `post` only marks what will
            be measured (NaN: will not). Without sigma, the noise of the fit, or the median of
            its sigma (stretched as the fit's errors are).
        scene: of the candidates; None: that of the fit.
        count: how many to choose; one may be chosen several times.
        target: name of the parameter that is wanted; None: all.

    Returns:
        `Design`; `print` lists the shots and the errors after each.

    Raises:
        ValueError: no shots or no known noise, count, target, scenes that do not fit.

    >>> import jimpact as ji
    >>> balls = ji.chain([1.0, 1.0, 1.0])
    >>> data = ji.Experiments([[1.0, 0.0, 0.0]], [[-0.2, 0.6, 0.6]], sigma=0.01)
    >>> result = ji.fit(ji.Newton([0.8, 0.8]), balls, data, starts=1)  # contact 2 is not seen
    >>> print(ji.design(result, ji.Experiments([[2.0, 0, 0], [0, 0, -1.0]], [[0.0] * 3] * 2)))
    shot 2: restitution[1] +- 0.012, restitution[2] +- 0.012
    """
    check_kind("fit", fit, Fit)
    check_kind("candidates", candidates, Experiments)
    as_whole("count", count, 1)
    if fit.experiments is None or not np.isfinite(fit.noise):
        raise ValueError("Argument `fit` must be to shots, with a known noise.")
    if target is not None:
        check_choice("target", target, fit.names)
    law, own = placed_fit(fit, scene)
    labels, ties = fit.problem.parameters.labels, dict(fit.problem.ties)
    problem = FitProblem.from_shots(law, own, candidates, labels, ties=ties)
    scale = np.where(fit.problem.log, fit.value, fit.problem.scale)
    known = _information(fit.problem, fit, fit.noise).sum(axis=0)
    from_priors = fit.problem.prior_errors(fit.value)[1] * scale / fit.noise
    known = known + from_priors.T @ from_priors
    noise = fit.noise
    if fit.experiments.sigma is not None:  # which weigh candidates of other units as `fit` does
        natural_error = fit.experiments.natural_errors(fit.problem.scene)
        noise *= float(np.nanmedian(np.asarray(fit.problem.sigma) / natural_error))
    each = _information(problem, fit, 1.0 if candidates.sigma is not None else noise)
    known = known + _RIDGE * np.trace(known + each.sum(axis=0)) * np.eye(len(known))
    chosen: list[int] = []
    errors = []
    for _ in range(count):
        after = known + each
        if target is None:
            merit = np.linalg.slogdet(after)[1]
        else:
            i = fit.names.index(target)
            merit = -np.linalg.inv(after)[:, i, i]
        chosen.append(int(np.argmax(merit)))
        known = after[chosen[-1]]
        errors.append(scale * np.sqrt(np.diag(np.linalg.inv(known))))
    shots = tuple(candidates.shots[k] for k in chosen)
    return Design(shots, np.array(chosen), fit.names, np.array(errors))


def _information(problem: FitProblem, fit: Fit, noise: float) -> np.ndarray:
    """`J^T J / noise^2` (K, P, P) of every shot at the parameters of the fit, in scaled form."""
    residuals, r = filled_up(problem.residuals), fit.problem.residuals
    y = fit.problem.point(fit.value)
    ends: Any = BoxRegion(*np.broadcast_to(y.astype(r.offset.dtype), (2, len(y))))  # fixed there
    parts = (r.mix, r.offset, r.scale, ends.low, ends.high, ends)
    here = eqx.tree_at(
        lambda r: (r.mix, r.offset, r.scale, r.low, r.high, r.region), residuals, parts
    )
    states = run(repeated(here, 1), y[None], "levenberg-marquardt", 1, quiet)
    shape = (*problem.measured.shape, -1)
    slopes = np.asarray(states.jacobian[0][: problem.measured.size], float)
    rows = slopes.reshape(shape)[..., : len(fit.names)] * problem.size / noise
    return np.einsum("kip,kiq->kpq", rows, rows)
