"""`fit`: parameters of a law from measured velocities, with their errors and what stays unseen."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, NamedTuple

import numpy as np

from jimpact._checks import as_whole, check_choice, check_kind
from jimpact.fits.adequacy import stretch, unusable, weighted
from jimpact.fits.experiments import Experiments
from jimpact.fits.least_squares import Method, check_method, default_steps
from jimpact.fits.multistart import Minimum, Search, ends, search, search_near, settled
from jimpact.fits.parameters import DEFAULT_FREE, AnyLaw, with_entries
from jimpact.fits.problem import FitProblem
from jimpact.fits.profiles import (
    Profile,
    linearized,
    needs_profiles,
    profile,
    quantile,
    quick_profiles,
)
from jimpact.fits.report import fit_warnings, report, to_json, verdict
from jimpact.fits.uncertainty import RANK_TOLERANCE, Uncertainty, uncertainty
from jimpact.scene import Scene

HARDLY_WORSE = 10.0  # standard errors: intervals of all levels end before

LISTED = 10  # shots that were left out, named one by one
HUBER = 1.345  # sigmas up to which a residual counts squared: 95 % of the efficiency
STUDENT = 4.0  # degrees of freedom of the tails
MEDIAN = 1.4826  # sigma of a normal distribution over the median of its absolute values
ROUNDS = 50  # of weights
SAME = 1e-7  # in natural scales of the parameters: the weights have settled


@dataclass(frozen=True, eq=False)
class Start:
    """A minimum that starts ended in: sum of squared (weighted) residuals, values, how many.

    `standard_error` is None where it fits so much worse that it does not matter.
    """

    sum_of_squares: float
    value: np.ndarray
    count: int
    standard_error: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Fit(Generic[AnyLaw]):
    """What `fit` found. `print(fit)` is a report.

    P free parameters, K shots of n velocities.

    Attributes:
        law: with the parameters found.
        method: of minimizing, see `fit`.
        names: of the parameters, contacts numbered from 1.
        value: (P,) in the units of each parameter, as the next two.
        standard_error: (P,); inf where the data cannot see a parameter, NaN where no degree of
            freedom is left to estimate the noise from.
        covariance: (P, P).
        correlation: (P, P), in [-1, 1].
        bounds: lowest and highest values (P,), (P,).
        at_bound: (P,) boolean.
        predicted: shaped like what was measured, (K, n) [m/s].
        residual: measured less predicted (K, n) [m/s]; NaN where nothing was measured.
        rms: of the residual.
        noise: estimated standard error of one value; NaN where no degree of freedom is left, 1
            where `sigma` was given, or, where chi^2 says that it is too small, by how much:
            the standard errors are stretched by that.
        degrees_of_freedom: independent measured values less `rank`.
        rank: of the Jacobian; below P: see `identifiability`.
        singular_values: (P,) of the scaled Jacobian.
        identifiability: in words, what the data cannot tell apart.
        starts: the distinct minima, best first.
        status: (K,) codes of `jimpact.STATUS` at the minimum.
        converged: whether the best start did.
        steps: iterations of the best start.
        lost_starts: how many did not converge.
        warnings: what is wrong with data or fit, in words.
        problem: what was solved.
        jacobian: derivatives of what was measured in the parameters (K, n, P), NaN where nothing
            was measured.
        loss: see `fit`.
        seed: of the random starts.
        profiles: where `fit` was asked for them.
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
    problem: FitProblem
    jacobian: np.ndarray
    loss: str = "squares"
    seed: int = 0
    profiles: tuple[Profile, ...] = ()

    @property
    def experiments(self) -> Experiments | None:
        """The shots; None where something else was fitted."""
        return self.problem.experiments

    def intervals(self, level: float = 0.95) -> tuple[tuple[tuple[float, float], ...], ...]:
        """The pieces, in order, of the confidence interval of each of the P parameters.

        Those of `profiles`, if there are some of this level. Else linearized, cut at the bounds, a
        piece for every minimum that fits well enough.

        Equation: `value -+ q standard_error`, q the quantile of Student's t with the degrees of
        freedom that are left, or of the normal law where `sigma` was given; of what is fitted in
        its logarithm `value exp(-+ q standard_error / value)`; at a minimum whose sum of squares
        is higher by d, q^2 - d / noise^2 in place of q^2.
        """
        if self.profiles and self.profiles[0].level == level:
            return tuple(scan.intervals for scan in self.profiles)
        return tuple(linearized(self, i, quantile(self, level)) for i in range(len(self.names)))

    def confidence_interval(self, level: float = 0.95) -> np.ndarray:
        """The outermost ends (P, 2) of `intervals` at a level in (0, 1)."""
        return np.array([(pieces[0][0], pieces[-1][1]) for pieces in self.intervals(level)])

    def to_dict(self) -> dict[str, Any]:
        """Everything a JSON file can hold; numbers that are not finite become None."""
        return to_json(self)

    @property
    def verdict(self) -> str:
        """What was found, in one sentence: the last one of `print(fit)`."""
        return verdict(self)

    def report(self, path: str | Path, profiles: bool = True) -> Path:
        """Write one self-contained page (HTML): everything of `print(fit)`, and the pictures.

        Parameters and intervals, profiles, correlations, residuals, what the data cannot see, what
        is wrong with them, versions and seed.

        Args:
            path: the file, ending in .html; what is there is replaced.
            profiles: find the profile likelihoods, too, unless the fit has them; some seconds.

        Returns:
            The path.
        """
        from jimpact.fits.page import write_page

        return write_page(self, Path(path), profiles)

    def to_pandas(self) -> Any:
        """The parameters as a `pandas.DataFrame`, which must be installed."""
        from jimpact.fits.tables import parameters_frame

        return parameters_frame(self)

    def to_xarray(self) -> Any:
        """Parameters, covariance, every shot as an `xarray.Dataset`, which must be installed."""
        from jimpact.fits.tables import dataset

        return dataset(self)

    def __str__(self) -> str:
        return report(self)


def fit(
    law: AnyLaw | FitProblem,
    scene: Scene | None = None,
    experiments: Experiments | None = None,
    free: Any = DEFAULT_FREE,
    *,
    bounds: Mapping[str, Any] | None = None,
    method: Method = "levenberg-marquardt",
    loss: str = "squares",
    starts: int = 8,
    seed: int = 0,
    max_steps: int | None = None,
    profiles: bool | None = None,
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
            Or a `FitProblem`, which holds the next three arguments and `bounds`.
        scene: the scene of all shots; not used where the experiments carry one a shot.
        experiments: measured shots.
        free: names of fields, or {field: True, or a boolean mask over contacts, or numbers of
            groups}: contacts with equal numbers are tied, 0 is held.
        bounds: {field: (low, high)}; default [0, 1] for restitution, > 0 for stiffness, ...
        method: 'levenberg-marquardt'; or gradient descent: 'adam', 'sgd', 'lbfgs' or an optax
            transformation.
        loss: 'squares'; or one that outliers move little: 'huber' (beyond 1.345 sigma the absolute
            value), 'student' (the density of Student's t, 4 degrees of freedom). Where sigma is
            not known, it is taken from the median of the residuals.
        starts: number of starts, the first from the law's values, the others random; if
            more than one, further ones around the best follow as long as they improve it, and,
            of up to 64 shots, scans for other minima of what is fitted in its logarithm.
        seed: of the random starts.
        max_steps: iterations per start.
        profiles: whether intervals are those of `profile`; None: where standard errors cannot be
            trusted (at a bound, in a valley, with several minima, or where the data hardly see a
            parameter), of up to 256 shots, with a single start of up to 64; else the report says
            how to get them.
        progress: bar on stderr; None: on a terminal, for fits longer than two seconds.

    Returns:
        `Fit`; `print` gives its report, `ji.plot.fit` a picture.

    Shots whose impact fails at the best parameters found, or whose derivatives are no numbers or
    absurd, are left out, and `Fit.warnings` names them. There is told, too, whether the law fits
    at all ("Lack of fit"), which shots are suspicious, and what is wrong with the data.

    Raises:
        ValueError: unknown field, nothing free, masks or bounds that do not fit, bodies of
            scene and experiments that differ in number, derivatives that are no numbers.

    >>> import jimpact as ji
    >>> data = ji.Experiments(pre=[[1.0, 0.0], [2.0, 0.0]], post=[[0.3, 0.7], [0.6, 1.4]])
    >>> found = ji.fit(ji.Newton(0.9), ji.chain([1.0, 1.0]), data)
    >>> round(float(found.law.restitution), 4)
    0.4
    """
    check_method(method)
    steps = default_steps(method) if max_steps is None else max_steps
    for name, count, least in (("starts", starts, 1), ("max_steps", steps, 1), ("seed", seed, 0)):
        as_whole(name, count, least)
    check_choice("loss", loss, ("squares", *LOSSES))
    if isinstance(law, FitProblem):
        if not (scene is experiments is bounds is None and free is DEFAULT_FREE):
            raise ValueError(
                "Arguments `scene`, `experiments`, `free` and `bounds` must be left out where a "
                "FitProblem is given, which holds its own."
            )
        problem = law
    else:
        problem = FitProblem.from_shots(law, scene, experiments, free, bounds)  # type: ignore[arg-type]
    found = search(problem, method, starts, seed, steps, progress)
    while (lost := unusable(problem, found)).any() and not lost.all():
        problem = _without(problem, lost)
        found = search(problem, method, starts, seed, steps, progress)
    _check_derivatives(problem, found)
    if problem.residuals.mixing is not None:
        points = problem.point(np.array([end.value for end in found.minima]))
        (problem,), states = settled([problem], points, method, steps)
        found = ends(problem, states, np.array([end.starts for end in found.minima]), found.lost)
    robust = None
    if loss != "squares":
        problem, robust = _robust(problem, found, loss, method, steps)
    end = replace(as_fit(problem, found, method, robust), loss=loss, seed=seed)
    if profiles:
        return replace(end, profiles=profile(end, progress=progress))
    if profiles is None and needs_profiles(end):
        return replace(end, profiles=quick_profiles(end, progress))
    return end


def _check_derivatives(problem: FitProblem, found: Search) -> None:
    """Raise a ValueError where they are no numbers, which no shots left out could mend."""
    lost = np.flatnonzero(~np.isfinite(found.jacobian).all(axis=1))
    if len(lost):
        at = ", ".join(f"{name} = {x:g}" for name, x in zip(problem.names, found.value))
        which = ", ".join(str(i + 1) for i in lost[:LISTED]) + ", ..." * (len(lost) > LISTED)
        raise ValueError(
            f"Argument `law` must have derivatives that are numbers, but at {at} those of "
            f"{len(lost)} measured values ({which}) are not."
        )


def check_squares(name: str, found: Any) -> None:
    """Raise an error unless this is a fit by least squares."""
    check_kind(name, found, Fit)
    if found.loss != "squares":
        raise ValueError(
            f"Argument `{name}` must be by least squares, but has loss {found.loss!r}."
        )


def _rms(problem: FitProblem, residual: np.ndarray) -> float:
    """The root mean square of residuals, those in rad/s by kinetic energy [m/s]."""
    data = problem.experiments
    worth = 1.0 if data is None else data.natural_errors(problem.scene)
    known = (residual / worth)[np.isfinite(residual)]
    return float(np.sqrt(np.mean(known**2))) if known.size else np.nan


def _without(problem: FitProblem, lost: np.ndarray) -> FitProblem:
    """The problem without these shots (K,), which it names."""
    assert problem.experiments is not None
    labels = [problem.experiments.shots[k] for k in np.flatnonzero(lost)]
    line = (
        f"Left out: {len(labels)} of {len(lost)} shots ({', '.join(labels[:LISTED])}"
        f"{', ...' * (len(labels) > LISTED)}), whose impacts fail, or whose derivatives cannot be "
        "used."
    )
    kept = np.broadcast_to(~lost[:, None], problem.measured.shape).astype(float)
    return replace(problem.weighed(kept), left_out=(*problem.left_out, line))


class Robust(NamedTuple):
    """The end of a search, factors its loss puts on the weights, noise times root of freedom."""

    found: Search
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


def _robust(
    problem: FitProblem, found: Search, loss: str, method: Method, max_steps: int
) -> tuple[FitProblem, Robust]:
    """Least squares again and again, with weights `psi(u) / u` of the last residuals u.

    Equation: the covariance is `s^2 mean(psi^2) / mean(psi')^2 (J^T J)^-1` (Huber, 1981).
    """
    here = ~np.isnan(problem.measured)
    for _ in range(ROUNDS):
        problem = problem.passing_errors_at(found.y)
        error = problem.independent(problem.measured - found.seen)
        scale = 1.0
        if problem.sigma is None:
            scale = max(MEDIAN * float(np.median(np.abs(error[here]))), np.finfo(float).tiny)
        share, slope = LOSSES[loss](error / scale)
        factor, before = np.sqrt(share), found.y
        found = search_near(problem.weighed(factor), found.y, method, max_steps)
        if np.abs(found.y - before).max() <= SAME:
            break
    else:
        found = found._replace(converged=False)
    psi = (share * error / scale)[here]
    noise = scale * np.sqrt(np.sum(psi**2)) / max(slope[here].mean(), SAME)
    return problem, Robust(found, factor, float(noise))


def as_fit(
    problem: FitProblem, found: Search, method: Method, robust: Robust | None = None
) -> Fit[Any]:
    """Errors, rank and warnings at the end of a search."""
    if robust is not None:  # as without the factors, but for the place
        found, weighed = robust.found, problem.weighed(robust.factor).residuals
        back = float(weighed.size) / float(problem.residuals.size) / robust.factor.reshape(-1, 1)
        left = problem.independent(problem.measured - found.seen) / float(problem.residuals.size)
        end = Minimum(float(np.sum(left**2)), found.value, 1, back * found.jacobian)
        found = found._replace(jacobian=end.jacobian, minima=[end])
    residuals, names = problem.residuals, problem.names
    size = float(residuals.size)
    spread = _spread(problem, found, found.minima[0])
    if robust is not None:
        freedom, unknown = spread.degrees_of_freedom, np.nan if problem.sigma is None else 1.0
        noise = robust.noise / np.sqrt(freedom) if freedom > 0 else unknown
        spread = _spread(problem, found, found.minima[0], noise)
    elif problem.sigma is not None:
        times = stretch(problem, weighted(problem, found), spread.rank)
        spread = _spread(problem, found, found.minima[0], times) if times > 1 else spread
    residual = np.asarray(problem.measured, float) - found.seen
    return Fit(
        law=with_entries(problem.law, residuals.fields, found.entries),
        method=method if isinstance(method, str) else "optax",
        names=names,
        value=found.value,
        standard_error=spread.standard_error,
        covariance=spread.covariance,
        correlation=spread.correlation,
        bounds=(problem.domains[:, 0], problem.domains[:, 1]),
        at_bound=found.at_bound,
        predicted=found.seen,
        residual=residual,
        rms=_rms(problem, residual),
        noise=spread.noise,
        degrees_of_freedom=spread.degrees_of_freedom,
        rank=spread.rank,
        singular_values=spread.singular_values,
        identifiability=(*problem.notes, *spread.unseen),
        starts=tuple(
            Start(size**2 * end.squares, end.value, end.starts, _error(problem, found, end, spread))
            for end in found.minima
        ),
        status=found.status,
        converged=found.converged,
        steps=found.steps,
        lost_starts=found.lost,
        warnings=tuple(fit_warnings(problem, found, spread, robust is not None)),
        problem=problem,
        jacobian=_slopes(problem, found),
    )


def _slopes(problem: FitProblem, found: Search) -> np.ndarray:
    """Derivatives of what was measured in the parameters themselves; NaN where nothing was."""
    slope = found.jacobian.reshape(*problem.measured.shape, len(problem.names)) / found.scale
    return problem.errors_of(float(problem.residuals.size) * slope)


def _spread(
    problem: FitProblem, found: Search, end: Minimum, noise: float | None = None
) -> Uncertainty:
    """Linearized errors at a minimum; noise: None: as stated, or of its residuals."""
    residuals = problem.residuals
    size = float(residuals.size)
    return uncertainty(
        names=problem.names,
        jacobian=size * end.jacobian,
        scale=np.where(found.log, end.value, found.scale),
        log=found.log,
        sum_of_squares=size**2 * end.squares,
        values=problem.values,
        noise=noise if noise is not None else None if problem.sigma is None else 1.0,
        rank_tolerance=RANK_TOLERANCE[str(residuals.offset.dtype)],
        value_name=problem.value_name,
    )


def _error(
    problem: FitProblem, found: Search, end: Minimum, spread: Uncertainty
) -> np.ndarray | None:
    """Standard errors (P,) at a minimum that fits hardly worse than the best; else None."""
    if end is found.minima[0]:
        return spread.standard_error
    noise, size = spread.noise, float(problem.residuals.size)
    more = size**2 * (end.squares - found.minima[0].squares)
    if not more <= (HARDLY_WORSE * noise) ** 2:
        return None
    return _spread(problem, found, end, noise).standard_error
