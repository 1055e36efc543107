"""`fit`: parameters of a law from measured velocities, with their errors and what stays unseen."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.special import ndtri, stdtrit

from jimpact.defects import data_defects
from jimpact.experiments import Experiments
from jimpact.fit_problem import Evaluation, Problem, build_problem
from jimpact.fit_report import report, to_json
from jimpact.laws.base import Law
from jimpact.multistart import Search, search
from jimpact.numerics.least_squares import Method, check_method, default_steps
from jimpact.parameters import DEFAULT_FREE, bounds_of, free_parameters
from jimpact.scene import Scene
from jimpact.status import STATUS
from jimpact.uncertainty import Uncertainty, uncertainty

# A fit counts as converged when a full Gauss-Newton step would lower the sum of squares by less
# than this share: a thousandth of a standard error, times what one degree of freedom is worth.
CONVERGED = 1e-6

# Residuals below this share of the measured velocities are rounding and solver tolerance.
EXACT = 1e-7
EXACT_FLOAT32 = 1e-4


class Start(NamedTuple):
    """A minimum that starts ended in: sum of squared (weighted) residuals, values, how many."""

    sum_of_squares: float
    value: np.ndarray
    count: int


@dataclass(frozen=True, eq=False)
class Fit:
    """What `fit` found. `print(fit)` is a report.

    P free parameters `names`, contacts numbered from 1; K shots of n velocities.
    `standard_error` is inf where the data cannot see a parameter, NaN where no degree of freedom
    is left to estimate the noise from. `rank` < P: see `identifiability`. `starts`: the distinct
    minima, best first. `noise`: estimated standard error of one velocity [m/s], 1 where `sigma`
    was given (then it is a multiple of sigma).
    """

    law: Law
    method: str
    names: tuple[str, ...]
    value: np.ndarray
    standard_error: np.ndarray
    covariance: np.ndarray
    correlation: np.ndarray
    bounds: tuple[np.ndarray, np.ndarray]
    at_bound: np.ndarray
    predicted: np.ndarray
    residual: np.ndarray
    rms: float
    sum_of_squares: float
    noise: float
    degrees_of_freedom: int
    noise_is_known: bool
    rank: int
    singular_values: np.ndarray
    identifiability: tuple[str, ...]
    starts: tuple[Start, ...]
    status: np.ndarray
    converged: bool
    steps: int
    warnings: tuple[str, ...]
    experiments: Experiments

    def confidence_interval(self, level: float = 0.95) -> np.ndarray:
        """Two-sided intervals (P, 2), linearized, cut at the bounds.

        Equation: `value -+ q standard_error`, q the quantile of Student's t with the degrees of
        freedom that are left, or of the normal law where `sigma` was given.
        """
        if not 0 < level < 1:
            raise ValueError(f"Argument `level` must lie in (0, 1), but has value {level}.")
        tail = 0.5 + 0.5 * level
        known = self.noise_is_known or self.degrees_of_freedom < 1
        quantile = ndtri(tail) if known else stdtrit(self.degrees_of_freedom, tail)
        half = quantile * self.standard_error
        return np.clip(
            np.stack([self.value - half, self.value + half], axis=1),
            self.bounds[0][:, None],
            self.bounds[1][:, None],
        )

    def to_dict(self) -> dict[str, Any]:
        """Everything a JSON file can hold; numbers that are not finite become None."""
        return to_json(self)

    def __str__(self) -> str:
        return report(self)


def fit(
    law: Law,
    scene: Scene | None,
    experiments: Experiments,
    free: Any = DEFAULT_FREE,
    *,
    bounds: Mapping[str, Any] | None = None,
    method: Method = "levenberg-marquardt",
    starts: int = 8,
    seed: int = 0,
    max_steps: int | None = None,
    progress: bool | None = None,
) -> Fit:
    """Fit parameters of a law to measured velocities by weighted least squares.

    Equation: minimize `sum ((v+(law) - v+ measured) / sigma)^2` over the measured values.

    Args:
        law: start values. A scalar field is one value for all contacts (tied), an (m,) field is
            free contact by contact. The stiffnesses of `LZB` with equal exponents: only their
            ratios matter, so contact 1 is held, and a scalar stiffness cannot be fitted.
        scene: the scene of all shots; None where the experiments carry one a shot.
        experiments: measured shots.
        free: names of fields, or {field: True or a boolean mask over contacts}.
        bounds: {field: (low, high)}; default [0, 1] for restitution, > 0 for stiffness, ...
        method: 'levenberg-marquardt'; or gradient descent: 'adam', 'sgd', 'lbfgs' or an optax
            transformation.
        starts: number of starts, the first from the law's values, the others random (`seed`).
        max_steps: iterations per start.
        progress: bar on stderr; None: on a terminal, for fits longer than two seconds.

    Raises:
        ValueError: unknown field, nothing free, masks or bounds that do not fit, bodies of
            scene and experiments that differ in number.

    >>> import jimpact as ji
    >>> data = ji.Experiments(pre=[[1.0, 0.0], [2.0, 0.0]], post=[[0.3, 0.7], [0.6, 1.4]])
    >>> found = ji.fit(ji.Newton(0.9), ji.chain([1.0, 1.0]), data)
    >>> round(float(found.law.restitution), 6)
    0.4
    """
    check_method(method)
    if not isinstance(starts, int) or starts < 1:
        raise ValueError(f"Argument `starts` must be an integer >= 1, but has value {starts!r}.")
    contacts = experiments.scene_of(scene, 0).contacts
    parameters, notes = free_parameters(law, contacts, free)
    limits = bounds_of(parameters, law, bounds)
    problem = build_problem(law, scene, experiments, parameters, limits)
    steps = max_steps or default_steps(method)
    found = search(problem, limits, method, starts, seed, steps, progress)
    return _as_fit(problem, experiments, scene, found, limits, method, notes)


def _as_fit(
    problem: Problem,
    experiments: Experiments,
    scene: Scene | None,
    found: Search,
    limits: tuple[np.ndarray, np.ndarray],
    method: Method,
    notes: list[str],
) -> Fit:
    best: Evaluation = found.best
    measured = experiments.measured
    sigma_known = experiments.sigma is not None
    total = int(measured.sum()) - experiments.lost_freedom
    spread = uncertainty(
        problem.parameters.names,
        best.jacobian,
        problem.scale,
        np.asarray(problem.interval.log),
        best.sum_of_squares,
        total,
        sigma_known,
    )
    residual = np.where(measured, np.asarray(experiments.post) - best.velocity, np.nan)
    converged = _is_converged(best, problem, found.at_bound)
    law = problem.parameters.put(problem.law, jnp.asarray(best.value))
    fitted = Fit(
        law=law,
        method=method if isinstance(method, str) else "optax transformation",
        names=problem.parameters.names,
        value=best.value,
        standard_error=spread.standard_error,
        covariance=spread.covariance,
        correlation=spread.correlation,
        bounds=limits,
        at_bound=found.at_bound,
        predicted=best.velocity,
        residual=residual,
        rms=float(np.sqrt(np.nanmean(residual**2))),
        sum_of_squares=best.sum_of_squares,
        noise=spread.noise if sigma_known else spread.noise * problem.unit,
        degrees_of_freedom=spread.degrees_of_freedom,
        noise_is_known=sigma_known,
        rank=spread.rank,
        singular_values=spread.singular_values,
        identifiability=spread.unseen,
        starts=tuple(Start(*row) for row in found.minima),
        status=best.status,
        converged=converged,
        steps=found.steps,
        warnings=(),
        experiments=experiments,
    )
    warnings = _warnings(fitted, spread, scene, problem, found, notes)
    return eqx.tree_at(lambda f: f.warnings, fitted, warnings) if False else _with(fitted, warnings)
