"""`fit`: parameters of a law from measured velocities, with their errors."""

import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jimpact._checks import as_whole, check_choice
from jimpact.files.records import listed
from jimpact.fits.adequacy import reproduced, stretch, unusable, weighted
from jimpact.fits.experiments import Experiments
from jimpact.fits.intervals import Profile
from jimpact.fits.parameters import DEFAULT_FREE, AnyLaw
from jimpact.fits.prediction import Predicted, jacobian_of, predicted, tied_values
from jimpact.fits.problem import FitProblem, of_shots
from jimpact.fits.profiles import needs_profiles, profile, quick_profiles
from jimpact.fits.report import report, verdict
from jimpact.fits.result import FitMinimum, FitResult
from jimpact.fits.robust import LOSSES, RobustSolution, robust_solution
from jimpact.fits.saved import read_fit, write_fit
from jimpact.fits.scene_parameters import plain_law
from jimpact.fits.search import Minimum, SearchResult, ends, find_minima, settled
from jimpact.fits.solve import Method, Search, check_method, default_steps
from jimpact.fits.tables import as_dict, dataset, parameters_frame, write_parameters
from jimpact.fits.uncertainty import RANK_TOLERANCE, Uncertainty, uncertainty
from jimpact.fits.verdicts import fit_warnings
from jimpact.progress import progress_bar
from jimpact.scene import Scene

if TYPE_CHECKING:
    from matplotlib.figure import Figure  # which takes long to import

# A minimum gets standard errors up to a sum of squares this many noise standard deviations above
# the best: intervals of all levels end before. With ten times more, only time is lost.
HARDLY_WORSE = 10.0


class Fit(FitResult[AnyLaw]):
    """See `FitResult`."""

    __doc__ = FitResult.__doc__

    def to_dict(self) -> dict[str, Any]:
        """Everything a JSON file can hold; numbers that are not finite become None."""
        return as_dict(self)

    @property
    def verdict(self) -> str:
        """The result in one sentence that can be quoted: the first one of `print(fit)`.

        Values with their errors, what they assume, and what speaks against them.
        """
        return verdict(self)

    @property
    def tied(self) -> dict[str, tuple[float, float]]:
        """What is tied to parameters, by name: values with their standard errors."""
        return tied_values(self)

    def predict(self, shots: Any, scene: Scene | None = None, level: float = 0.95) -> Predicted:
        """Velocities after further shots, with the errors that the parameters leave in them.

        Equation: `sqrt(J C J^T)`, J derivatives in the parameters, C their covariance; a
        measurement, with its own standard error s, lies within `q sqrt(J C J^T + s^2)`, q the
        quantile as in `intervals`.

        Args:
            shots: v- (K, n) [m/s], or `Experiments`, of which v- and scenes count.
            scene: of all shots; None: that of the fit, or those of the shots.
            level: of the band.

        Returns:
            `velocity` (K, n) [m/s], `standard_error` (K, n): inf where it depends on what the data
            do not determine, NaN where the errors are unknown; `status` (K,); `noise` (K, n) of a
            measurement: the `sigma` of the shots if they have one, else as in the fit; `low` and
            `high` (K, n), the band of a measurement.

        Raises:
            ValueError: a fit of something else than shots; velocities that do not fit the scene, a
                scene that does not fit the law; a level outside (0, 1).
        """
        return predicted(self, shots, scene, level)

    def save(self, path: str | Path) -> Path:
        """Write the fit to a file (JSON) that `ji.load_fit` reads: problem, result, versions.

        Args:
            path: the file; an existing file is replaced.

        Returns:
            The path.

        Raises:
            ValueError: a fit of something else than shots, or with ties: functions cannot be saved.
        """
        return write_fit(self, Path(path))

    def plot(self) -> "Figure":
        """The picture of `ji.plot.fit`: measured and fitted velocities, and the residuals."""
        from jimpact import plot

        return plot.fit(self)

    def to_csv(self, path: str | Path) -> Path:
        """Write a row a parameter: value, standard error, ends of its 95 % interval, whether seen.

        Args:
            path: the file; an existing file is replaced.

        Returns:
            The path.
        """
        return write_parameters(self, Path(path))

    def to_pandas(self) -> Any:
        """The parameters as a `pandas.DataFrame`, which must be installed."""
        return parameters_frame(self)

    def to_xarray(self) -> Any:
        """Parameters, covariance, every shot as an `xarray.Dataset`, which must be installed."""
        return dataset(self)

    def __str__(self) -> str:
        return report(self)


def load_fit(path: str | Path) -> Fit[Any]:
    """The fit that `Fit.save` has written, with all that one can do with a fit.

    The classes of laws and scenes are imported by name, so read only files that you trust.

    Args:
        path: the file.

    Returns:
        `Fit`.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no saved fit, one of another format, a law that cannot be imported.

    >>> import tempfile
    >>> from pathlib import Path
    >>> import jimpact as ji
    >>> data = ji.Experiments([[1.0, 0.0], [2.0, 0.0]], [[0.3, 0.7], [0.6, 1.4]], sigma=0.02)
    >>> result = ji.fit(ji.Newton(0.9), ji.chain([1.0, 1.0]), data)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     again = ji.load_fit(result.save(Path(folder) / "fit.json"))
    >>> again.verdict == result.verdict
    True
    """
    return Fit(**read_fit(Path(path)))


def fit(
    law: AnyLaw | FitProblem,
    scene: Scene | None = None,
    experiments: Experiments | None = None,
    free: Any = DEFAULT_FREE,
    *,
    bounds: Mapping[str, Any] | None = None,
    priors: Mapping[str, Any] | None = None,
    ties: Mapping[str, Any] | None = None,
    method: Method = "levenberg-marquardt",
    loss: str = "squares",
    starts: int | None = None,
    seed: int = 0,
    max_steps: int | None = None,
    profiles: bool | None = None,
    progress: float | None = None,
    limit: float | None = None,
) -> Fit[AnyLaw]:
    """Fit parameters of a law to measured velocities by weighted least squares.

    Equation: minimize `sum ((v+(law) - v+ measured) / sigma)^2` over the measured values, and, with
    priors, `+ sum ((x - mean) / std)^2`.

    Args:
        law: the law to fit; its parameters are the start values. All contacts share one value of
            a scalar field; an (m,) field is free contact by contact. The stiffnesses of `LZB` with
            equal exponents: only their ratios matter, so that of contact 1 is fixed; a scalar
            stiffness is fixed by default, and naming it in `free` is an error.
            The (m, m) matrix of a `RestitutionMatrix` stays admissible in all its scenes for every
            approach velocity, at every evaluation and with every method; the start must be so.
            Or a `FitProblem`, which holds the next three arguments, `bounds`, `priors`, `ties`.
        scene: the scene of all shots; ignored if each shot has its own scene.
        experiments: measured shots.
        free: names of fields or entries ('restitution[2]'), or {field: True, or a boolean mask over
            contacts, or numbers of groups}: contacts with equal numbers share one value, 0 is
            fixed. Also parts of the scene that all shots share, each with a prior: 'mass[2]' [kg],
            'gaps[1]' [m], 'tilt[1]' [rad], by which the normal of a planar contact turns towards
            its tangent; `Fit.scene` has them. Momentum and energy are judged with them.
        bounds: {field or entry: (low, high)}; default [0, 1] for restitution, > 0 for
            stiffness, ...
        priors: {parameter or field: (mean, standard deviation), or `ji.Normal`}: what is known of a
            parameter besides the data; each counts as one more measured value. The data need a
            `sigma` (or `resolution`), which priors weigh against. Parts of a scene are searched
            within ten standard deviations.
        ties: {field or entry: function}: what is not fitted but follows from other values, as in
            {"stiffness[2]": lambda p: 2 * p["restitution"]}; `p` has all fields and entries of the
            law by name. `Fit.tied` has the values with their errors. Functions must be
            differentiable by JAX; each compiles a program of its own.
        method: 'levenberg-marquardt'; or gradient descent: 'adam', 'sgd', 'lbfgs' or an optax
            transformation.
        loss: 'squares'; or one that outliers move little: 'huber' (beyond 1.345 sigma the absolute
            value), 'student' (the density of Student's t, 4 degrees of freedom). Where sigma is
            not known, it is taken from the median of the residuals.
        starts: number of starts: the first from the law's values, then random ones, the last third
            around the best of these. None: 12, and further ones around the best as long as they
            lower the sum of squares by more than the noise of a value.
        seed: of the random starts.
        max_steps: iterations per start.
        profiles: whether intervals are those of `profile`; None: where standard errors cannot be
            trusted (at a bound, in a valley, with several minima, or for weakly determined
            parameters) and the law fits, of up to 3 parameters and 256 shots (64 with one start);
            else the report says how to get them.
        progress: bar on stderr; None: on a terminal, for fits longer than two seconds.
        limit: seconds after which no further step of the search is begun; None: no limit.

    Returns:
        `Fit`; `print` gives its report, `ji.plot.fit` a picture.

    Shots whose impact fails at the best parameters, or whose derivatives are not finite or
    absurdly large, are left out, and `Fit.warnings` names them. `Fit.warnings` also says whether
    the law fits at all ("Lack of fit"), which shots are suspicious, and what is wrong with the
    data.

    Raises:
        ValueError: unknown field, no free parameter, masks or bounds that do not fit, priors
            outside bounds or without sigma, parts of a scene without a prior, ties in a circle or
            outside a domain, bodies of scene and experiments that differ in number, derivatives
            that are not finite.

    >>> import jimpact as ji
    >>> data = ji.Experiments(pre=[[1.0, 0.0], [2.0, 0.0]], post=[[0.3, 0.7], [0.6, 1.4]])
    >>> result = ji.fit(ji.Newton(0.9), ji.chain([1.0, 1.0]), data)
    >>> round(float(result.law.restitution), 4)
    0.4
    """
    check_method(method)
    steps = default_steps(method) if max_steps is None else max_steps
    if starts is not None:
        as_whole("starts", starts, 1)
    for name, count, least in (("max_steps", steps, 1), ("seed", seed, 0)):
        as_whole(name, count, least)
    check_choice("loss", loss, ("squares", *LOSSES))
    if isinstance(law, FitProblem):
        if not (scene is experiments is bounds is priors is ties is None and free is DEFAULT_FREE):
            raise ValueError(
                "Arguments `scene`, `experiments`, `free`, `bounds`, `priors` and `ties` must be "
                "left out where a FitProblem is given, which holds its own."
            )
        problem = law
    else:
        problem = of_shots(law, scene, experiments, free, bounds, priors, ties)  # type: ignore[arg-type]
    deadline = np.inf if limit is None else time.monotonic() + limit
    with progress_bar(progress) as show:
        search = Search(method, steps, show, deadline)
        solution = find_minima(problem, starts, seed, search)
        while (lost := unusable(problem, solution)).any() and not lost.all():
            problem = _without(problem, lost)
            solution = find_minima(problem, starts, seed, search)
        _check_derivatives(problem, solution)
        if problem.residuals.mixing is not None:
            points = problem.point(np.array([minimum.value for minimum in solution.minima]))
            (problem,), states = settled([problem], points, search, slopes=[solution.slopes])
            counts = np.array([minimum.starts for minimum in solution.minima])
            solution = ends(problem, states, counts, solution.lost)
        robust = None
        if loss != "squares":
            problem, robust = robust_solution(problem, solution, loss, search)
    result = replace(as_fit(problem, solution, method, robust), loss=loss, seed=seed)
    if profiles:
        return _with_profiles(result, profile(result, progress=progress))
    if profiles is None and needs_profiles(result):
        return _with_profiles(result, quick_profiles(result, progress))
    return result


def _with_profiles(result: Fit[AnyLaw], profiles: tuple[Profile, ...]) -> Fit[AnyLaw]:
    """The fit with its profiles, and a warning if they found a lower minimum."""
    if (better := profiles[0].better) is not None:
        values = ", ".join(f"{name} {x:.4g}" for name, x in zip(result.names, better))
        line = f"A profile found a lower minimum than the fit ({values}): allow more `starts`."
        short = "a profile found a lower minimum"
        result = replace(
            result,
            warnings=(*result.warnings, line),
            reservations=(*result.reservations, short),
        )
    return replace(result, profiles=profiles)


def _check_derivatives(problem: FitProblem, solution: SearchResult) -> None:
    """Raise a ValueError where derivatives are not finite, whichever shots are left out."""
    lost = np.flatnonzero(~np.isfinite(solution.jacobian).all(axis=1))
    if len(lost):
        at = ", ".join(f"{name} = {x:g}" for name, x in zip(problem.names, solution.value))
        which = listed([str(i + 1) for i in lost])
        raise ValueError(
            f"Argument `law` must have finite derivatives, but at {at} those of "
            f"{len(lost)} measured values ({which}) are not."
        )


def _rms(problem: FitProblem, residual: np.ndarray) -> float:
    """The root mean square of residuals, those in rad/s by kinetic energy [m/s]."""
    data = problem.experiments
    natural_error = 1.0 if data is None else data.natural_errors(problem.scene)
    known = (residual / natural_error)[np.isfinite(residual)]
    return float(np.sqrt(np.mean(known**2))) if known.size else np.nan


def _without(problem: FitProblem, lost: np.ndarray) -> FitProblem:
    """The problem without these shots (K,), which it names."""
    assert problem.experiments is not None
    labels = [problem.experiments.shots[k] for k in np.flatnonzero(lost)]
    line = (
        f"Left out: {len(labels)} of {len(lost)} shots ({listed(labels)}), whose impacts fail, or "
        "whose derivatives cannot be used."
    )
    used = np.broadcast_to(~lost[:, None], problem.measured.shape).astype(float)
    return replace(problem.weighed(used), left_out=(*problem.left_out, line))


def as_fit(
    problem: FitProblem,
    solution: SearchResult,
    method: Method,
    robust: RobustSolution | None = None,
) -> Fit[Any]:
    """The fit at the end of a search: errors, rank and warnings."""
    if robust is not None:
        solution = _without_robust_factors(problem, robust)
    size = problem.size
    judged = replace(problem, scene=problem.to_scene(solution.value))
    errors = _errors(problem, judged, solution, robust)
    residual = np.asarray(problem.measured, float) - solution.predicted
    findings = fit_warnings(judged, solution, errors, robust is not None)
    return Fit(
        law=plain_law(problem.residuals.law_of(solution.entries)),
        method=method if isinstance(method, str) else "optax",
        names=problem.names,
        value=solution.value,
        standard_error=errors.standard_error,
        covariance=errors.covariance,
        correlation=errors.correlation,
        bounds=(problem.domains[:, 0], problem.domains[:, 1]),
        at_bound=solution.at_bound,
        predicted=solution.predicted,
        residual=residual,
        rms=_rms(problem, residual),
        noise=errors.noise,
        degrees_of_freedom=errors.degrees_of_freedom,
        rank=errors.rank,
        singular_values=errors.singular_values,
        identifiability=(*problem.notes, *errors.undetermined),
        starts=tuple(
            FitMinimum(
                size**2 * minimum.squares,
                minimum.value,
                minimum.starts,
                _standard_error(problem, solution, minimum, errors),
            )
            for minimum in solution.minima
        ),
        status=solution.status,
        converged=solution.converged,
        steps=solution.steps,
        lost_starts=solution.lost,
        warnings=tuple(found.line for found in findings),
        reservations=tuple(found.reservation for found in findings if found.reservation),
        problem=problem,
        jacobian=jacobian_of(problem, solution),
    )


def _without_robust_factors(problem: FitProblem, robust: RobustSolution) -> SearchResult:
    """The minimum that the loss found, its residuals weighted as in `problem`."""
    solution, weighed = robust.solution, problem.weighed(robust.factor).residuals
    size = problem.size
    back = float(weighed.size) / size / robust.factor.reshape(-1, 1)
    residual = problem.independent(problem.measured - solution.predicted)
    from_priors, _ = problem.prior_errors(solution.value)
    squares = float(np.sum(residual**2) + np.sum(from_priors**2)) / size**2
    jacobian = back * solution.jacobian
    minimum = Minimum(squares, solution.value, 1, jacobian)
    return solution._replace(jacobian=jacobian, minima=[minimum])


def _errors(
    problem: FitProblem, judged: FitProblem, solution: SearchResult, robust: RobustSolution | None
) -> Uncertainty:
    """Errors of the parameters; with known errors of the data wider where the law does not fit."""
    best = solution.minima[0]
    errors = _uncertainty(problem, solution, best)
    if robust is not None:
        freedom = errors.degrees_of_freedom
        noise = np.nan if problem.sigma is None else 1.0
        if freedom > 0:
            noise = robust.noise / np.sqrt(freedom)
        return _uncertainty(problem, solution, best, noise)
    if problem.sigma is not None:
        times = stretch(judged, weighted(problem, solution), errors.rank)
        if times > 1:
            return _uncertainty(problem, solution, best, times)
    return errors


def _uncertainty(
    problem: FitProblem, solution: SearchResult, minimum: Minimum, noise: float | None = None
) -> Uncertainty:
    """Linearized errors at a minimum; noise: None: as stated, or of its residuals.

    Data without sigma that are reproduced to the last digit do not show their noise.
    """
    size = problem.size
    if noise is None and problem.sigma is not None:
        noise = 1.0
    elif noise is None and reproduced(problem, minimum):
        noise = np.nan
    scale = np.where(solution.log, minimum.value, solution.scale)
    _, of_priors = problem.prior_errors(minimum.value)
    return uncertainty(
        names=problem.names,
        jacobian=np.vstack([size * minimum.jacobian, of_priors * scale]),
        scale=scale,
        log=solution.log,
        sum_of_squares=size**2 * minimum.squares,
        values=problem.values,
        noise=noise,
        rank_tolerance=RANK_TOLERANCE[problem.precision],
        value_name=problem.value_name,
    )


def _standard_error(
    problem: FitProblem, solution: SearchResult, minimum: Minimum, best: Uncertainty
) -> np.ndarray | None:
    """Standard errors (P,) at a minimum that fits hardly worse than the best; else None."""
    if minimum is solution.minima[0]:
        return best.standard_error
    more = problem.size**2 * (minimum.squares - solution.minima[0].squares)
    if not more <= (HARDLY_WORSE * best.noise) ** 2:
        return None
    return _uncertainty(problem, solution, minimum, best.noise).standard_error
