"""`fit`: parameters of a law from measured velocities, with their errors and what stays unseen."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Generic

import jax.numpy as jnp
import numpy as np
from scipy.special import ndtri, stdtrit

from jimpact._checks import check_kind
from jimpact.experiments import Experiments
from jimpact.fits.least_squares import Method, check_method, default_steps
from jimpact.fits.multistart import Search, search
from jimpact.fits.parameters import (
    DEFAULT_FREE,
    AnyLaw,
    Parameters,
    bounds_of,
    free_parameters,
    with_entries,
)
from jimpact.fits.problem import FitProblem, build_problem
from jimpact.fits.report import fit_warnings, report, to_json
from jimpact.fits.uncertainty import RANK_TOLERANCE, uncertainty
from jimpact.law import Law
from jimpact.scene import Scene


@dataclass(frozen=True, eq=False)
class Start:
    """A minimum that starts ended in: sum of squared (weighted) residuals, values, how many."""

    sum_of_squares: float
    value: np.ndarray
    count: int


@dataclass(frozen=True, eq=False)
class Fit(Generic[AnyLaw]):
    """What `fit` found. `print(fit)` is a report.

    P free parameters `names`, contacts numbered from 1; K shots of n velocities.
    `standard_error` is inf where the data cannot see a parameter, NaN where no degree of freedom
    is left to estimate the noise from. `rank` < P: see `identifiability`. `starts`: the distinct
    minima, best first. `noise`: estimated standard error of one velocity [m/s], NaN where no
    degree of freedom is left, 1 where `sigma` was given.
    """

    law: AnyLaw
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
    noise: float
    degrees_of_freedom: int
    rank: int
    singular_values: np.ndarray
    identifiability: tuple[str, ...]
    starts: tuple[Start, ...]
    status: np.ndarray
    converged: bool
    steps: int
    lost_starts: int
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
        known = self.experiments.sigma is not None or self.degrees_of_freedom < 1
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
    law: AnyLaw,
    scene: Scene | None,
    experiments: Experiments,
    free: Any = DEFAULT_FREE,
    *,
    bounds: Mapping[str, Any] | None = None,
    method: Method = "levenberg-marquardt",
    starts: int = 8,
    seed: int = 0,
    max_steps: int | None = None,
    progress: float | None = None,
) -> Fit[AnyLaw]:
    """Fit parameters of a law to measured velocities by weighted least squares.

    Equation: minimize `sum ((v+(law) - v+ measured) / sigma)^2` over the measured values.

    Args:
        law: start values. A scalar field is one value for all contacts (tied), an (m,) field is
            free contact by contact. The stiffnesses of `LZB` with equal exponents: only their
            ratios matter, so contact 1 is held, and a scalar stiffness cannot be fitted.
            The (m, m) matrix of a `RestitutionMatrix` stays admissible in all its scenes for every
            approach velocity, at every evaluation and with every method; the start must be so.
        scene: the scene of all shots; not used where the experiments carry one a shot.
        experiments: measured shots.
        free: names of fields, or {field: True, or a boolean mask over contacts, or numbers of
            groups}: contacts with equal numbers are tied, 0 is held.
        bounds: {field: (low, high)}; default [0, 1] for restitution, > 0 for stiffness, ...
        method: 'levenberg-marquardt'; or gradient descent: 'adam', 'sgd', 'lbfgs' or an optax
            transformation.
        starts: number of starts, the first from the law's values, the others random (`seed`); if
            more than one, further ones around the best follow as long as they improve it.
        max_steps: iterations per start.
        progress: bar on stderr; None: on a terminal, for fits longer than two seconds.

    Raises:
        ValueError: unknown field, nothing free, masks or bounds that do not fit, bodies of
            scene and experiments that differ in number.

    >>> import jimpact as ji
    >>> data = ji.Experiments(pre=[[1.0, 0.0], [2.0, 0.0]], post=[[0.3, 0.7], [0.6, 1.4]])
    >>> found = ji.fit(ji.Newton(0.9), ji.chain([1.0, 1.0]), data)
    >>> round(float(found.law.restitution), 4)
    0.4
    """
    check_kind("law", law, Law)
    check_kind("experiments", experiments, Experiments)
    check_method(method)
    steps = default_steps(method) if max_steps is None else max_steps
    for name, count in (("starts", starts), ("max_steps", steps)):
        if not isinstance(count, int) or count < 1:
            raise ValueError(f"Argument `{name}` must be an integer >= 1, but has value {count!r}.")
    contacts = experiments.largest_scene(scene).contacts
    parameters, notes = free_parameters(law, contacts, free)
    limits = bounds_of(parameters, law, bounds)
    problem = build_problem(law, scene, experiments, parameters, limits)
    found = search(problem, parameters, method, starts, seed, steps, progress)
    return _as_fit(problem, parameters, experiments, scene, found, limits, method, notes)


def _as_fit(
    problem: FitProblem,
    parameters: Parameters,
    experiments: Experiments,
    scene: Scene | None,
    found: Search,
    limits: tuple[np.ndarray, np.ndarray],
    method: Method,
    notes: list[str],
) -> Fit[Any]:
    measured, sigma_known = experiments.measured, experiments.sigma is not None
    size = float(problem.size)
    spread = uncertainty(
        names=parameters.names,
        jacobian=size * found.jacobian,
        scale=found.scale,
        log=found.log,
        sum_of_squares=size**2 * found.minima[0][0],
        values=int(measured.sum()) - experiments.lost_freedom,
        noise_is_known=sigma_known,
        rank_tolerance=RANK_TOLERANCE[str(problem.pre.dtype)],
    )
    residual = np.where(measured, np.asarray(experiments.post, float) - found.velocity, np.nan)
    law = with_entries(problem.law, problem.fields, jnp.asarray(found.entries))
    return Fit(
        law=law,
        method=method if isinstance(method, str) else "optax",
        names=parameters.names,
        value=found.value,
        standard_error=spread.standard_error,
        covariance=spread.covariance,
        correlation=spread.correlation,
        bounds=limits,
        at_bound=found.at_bound,
        predicted=found.velocity,
        residual=residual,
        rms=float(np.sqrt(np.nanmean(residual**2))),
        noise=spread.noise,
        degrees_of_freedom=spread.degrees_of_freedom,
        rank=spread.rank,
        singular_values=spread.singular_values,
        identifiability=(*notes, *spread.unseen),
        starts=tuple(Start(size**2 * cost, value, count) for cost, value, count in found.minima),
        status=found.status,
        converged=found.converged,
        steps=found.steps,
        lost_starts=found.lost,
        warnings=tuple(fit_warnings(law, problem, parameters, experiments, scene, found, spread)),
        experiments=experiments,
    )
