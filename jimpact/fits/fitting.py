"""`fit`: parameters of a law from measured velocities, with errors; many fits side by
side.
"""

import functools
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import numpy as np

from jimpact.core.law import AnyLaw
from jimpact.core.scene import Scene
from jimpact.fits.checks import Judged, unusable
from jimpact.fits.data_checks import wrong_unit
from jimpact.fits.estimate import in_own_precision
from jimpact.fits.intervals import check_level
from jimpact.fits.observables import COARSE_RTOL
from jimpact.fits.parameters import DEFAULT_FREE
from jimpact.fits.problem import FitProblem, of_shots
from jimpact.fits.report import Fit, check_squares
from jimpact.fits.search import (
    DEFAULT_SEARCH,
    FitMinimum,
    Search,
    Solution,
    find_minima,
    robust_minimum,
    solution_of,
    solved,
    start_points,
)
from jimpact.fits.solve import (
    DEFAULT_STEPS,
    FINE_OF_MANY,
    HARDLY_WORSE,
    Ends,
    Solver,
    step_limit,
)
from jimpact.fits.uncertainty import uncertainty
from jimpact.shots.data import Experiments
from jimpact.tools.checks import as_whole, check_kind
from jimpact.tools.progress import progress_bar
from jimpact.tools.records import listed
from jimpact.tools.threads import as_workers


def fit(
    law: AnyLaw | FitProblem,
    scene: Scene | None = None,
    experiments: Experiments | None = None,
    free: Any = DEFAULT_FREE,
    *,
    bounds: Mapping[str, Any] | None = None,
    priors: Mapping[str, Any] | None = None,
    ties: Mapping[str, Any] | None = None,
    starts: int | None = None,
    profiles: bool | None = None,
    search: Search = DEFAULT_SEARCH,
) -> Fit[AnyLaw]:
    """Fit parameters of a law to measured velocities by weighted least squares.

    Equation: minimize `sum ((v+(law) - v+ measured) / sigma)^2` over the measured
    values, and, with priors, `+ sum ((x - mean) / std)^2`. With errors of v-
    (`sigma_pre`, `covariance`) it is the joint misfit of v- and v+, and the true v- of
    each shot are searched for with the parameters (errors in both variables): they do
    not bias them. `search.loss` may take the place of the square.

    Args:
        law: the law to fit; its parameters are the start values. All contacts share one
            value of a scalar field; an (m,) field is free contact by contact. The
            stiffnesses of `LZB` with equal exponents: only their ratios matter, so that
            of contact 1 is fixed; a scalar stiffness is fixed by default, and naming it
            in `free` is an error.
            The (m, m) matrix of a `RestitutionMatrix` is the best one that is
            admissible in all its scenes for every approach velocity; the start must be
            so.
            Or a `FitProblem`, which holds the next three arguments, `bounds`, `priors`,
            `ties`.
        scene: the scene of all shots; ignored if each shot has its own scene.
        experiments: measured shots.
        free: names of fields or entries ('restitution[2]'), or {field: True, or a
            boolean mask over contacts, or numbers of groups}: contacts with equal
            numbers share one value, 0 is fixed. Also parts of the scene that all shots
            share, each with a prior: 'mass[2]' [kg], 'gaps[1]' [m], 'tilt[1]' [rad], by
            which the normal of a planar contact turns towards its tangent; `Fit.scene`
            has them. Momentum and energy are judged with them.
        bounds: {field or entry: (low, high)}; default [0, 1] for restitution, > 0 for
            stiffness, ...
        priors: {parameter or field: (mean, standard deviation), or `ji.Normal`}: what
            is known of a parameter besides the data; each counts as one more measured
            value. The data need a `sigma` (or `resolution`), which priors weigh
            against. Parts of a scene are searched within ten standard deviations.
        ties: {field or entry: function}: what is not fitted but follows from other
            values, as in {"stiffness[2]": lambda p: 2 * p["restitution"]}; `p` has all
            fields and entries of the law by name. `Fit.tied` has the values with their
            errors. Functions must be differentiable by JAX; each compiles a program of
            its own.
        starts: number of starts: the first from the law's values, then random ones, the
            last third around the best of these. None: the lowest of 128 to 1024 points,
            of which only values are computed, and further ones around the best as long
            as they lower the sum of squares by more than the noise of a value. Starts
            that stay behind others are given up.
        profiles: whether intervals are those of `profile`; None: where standard errors
            cannot be trusted (at a bound, in a valley, with several minima, or for
            weakly determined parameters) and the law fits, of up to 3 parameters and
            256 shots (64 with one start); else the report says how to get them. True
            computes them at once, None on first access, as by `print`, `warnings` or
            `intervals`.
        search: method, loss, limits and progress, see `Search`.

    Returns:
        `Fit` (`help("jimpact.fits.report.Fit")`); `print` gives its report,
        `ji.plot.fit` a picture.

    Shots whose impact fails at the best parameters, or whose derivatives are not finite
    or absurdly large, are left out, and `Fit.warnings` names them. `Fit.warnings` also
    says whether the law fits at all ("Lack of fit"), which shots are suspicious, and
    what is wrong with the data.

    Raises:
        ValueError: unknown field, no free parameter, masks or bounds that do not fit,
            priors outside bounds or without sigma, parts of a scene without a prior,
            ties in a circle or outside a domain, bodies of scene and experiments that
            differ in number, derivatives that are not finite.

    >>> import jimpact as ji
    >>> data = ji.Experiments(
    ...     pre=[[1.0, 0.0], [2.0, 0.0]], post=[[0.3, 0.7], [0.6, 1.4]]
    ... )
    >>> result = ji.fit(ji.Newton(0.9), ji.chain([1.0, 1.0]), data)
    >>> round(float(result.law.restitution), 4)
    0.4
    """
    check_kind("search", search, Search)
    method = search.method
    seed = search.seed
    steps = step_limit(method, search.max_steps)
    if starts is not None:
        as_whole("starts", starts, 1)
    if isinstance(law, FitProblem):
        others: tuple[Any, ...] = (scene, experiments, bounds, priors, ties)
        if free is not DEFAULT_FREE or any(each is not None for each in others):
            raise ValueError(
                "Arguments `scene`, `experiments`, `free`, `bounds`, `priors` and "
                "`ties` must be left out where a FitProblem is given, which holds its "
                "own."
            )
        problem = law
    else:
        problem = of_shots(law, scene, experiments, free, bounds, priors, ties)  # type: ignore[arg-type]
    data = problem.experiments
    if data is not None and (doubt := wrong_unit(data, problem.scene)):
        # before a search that may take long and find nothing
        warnings.warn(doubt, stacklevel=2)
    if search.limit is None:
        deadline = np.inf
    else:
        deadline = time.monotonic() + float(search.limit)
    with progress_bar(search.progress) as show:
        solver = Solver(method, steps, show, deadline)
        solution = find_minima(problem, starts, seed, solver)
        while (lost := unusable(problem, solution)).any() and not lost.all():
            problem = _without(problem, lost)
            solution = find_minima(problem, starts, seed, solver)
        _check_derivatives(problem, solution)
        problem = problem.with_errors_before(solution.slopes)
        robust = None
        if search.loss != "squares":
            problem, solution, robust = robust_minimum(
                problem, solution, search.loss, solver
            )
    result = replace(as_fit(problem, solution, search, robust), wants_profiles=profiles)
    if profiles:
        _ = result.profiles  # asked for: computed here
    return result


def _check_derivatives(problem: FitProblem, solution: Solution) -> None:
    """Raise a ValueError if derivatives of measured values at the minimum are not
    finite.
    """
    lost = np.flatnonzero(~np.isfinite(solution.starts[0].jacobian).all(axis=1))
    if len(lost):
        at = ", ".join(
            f"{name} = {x:g}" for name, x in zip(problem.names, solution.value)
        )
        which = listed([str(i + 1) for i in lost])
        raise ValueError(
            f"Argument `law` must have finite derivatives, but at {at} those of "
            f"{len(lost)} measured values ({which}) are not."
        )


def _without(problem: FitProblem, lost: np.ndarray) -> FitProblem:
    """The problem without the shots where `lost` (K,) is True, whose labels go to
    `left_out`.
    """
    assert problem.experiments is not None
    labels = (problem.experiments.shots[k] for k in np.flatnonzero(lost))
    used = np.broadcast_to(~lost[:, None], problem.measured.shape).astype(float)
    return replace(problem.weighed(used), left_out=(*problem.left_out, *labels))


def as_fit(
    problem: FitProblem, solution: Solution, search: Search, robust: float | None = None
) -> Fit[Any]:
    """The `Fit` of a solution, with its errors.

    Args:
        problem: that was solved.
        solution: its minima.
        search: options of the search.
        robust: noise times the root of the degrees of freedom after a robust loss, or
            None.
    """
    judged = Judged(
        replace(problem, scene=problem.to_scene(solution.value)), solution, robust
    )
    errors = judged.errors
    starts = []
    limit = solution.starts[0].sum_of_squares + HARDLY_WORSE * errors.noise**2
    for end in solution.starts:
        matters = not end.sum_of_squares > limit  # also where the noise is NaN
        if matters:
            error = uncertainty(problem, end, errors.noise).standard_error
        else:
            error = None
        starts.append(FitMinimum(end.sum_of_squares, end.value, end.count, error))
    return Fit(
        law=problem.to_law(solution.value),
        method=search.method if isinstance(search.method, str) else "optax",
        names=problem.names,
        bounds=(problem.domains[:, 0], problem.domains[:, 1]),
        problem=problem,
        jacobian=problem.derivatives(solution.starts[0]),
        search=replace(solution, starts=tuple(starts)),
        errors=errors,
        loss=search.loss,
        seed=search.seed,
        judged=judged,
        progress=search.progress,
    )


# ---------------------------------------------------------------------------- many fits


def fit_many(
    law: AnyLaw,
    scene: Scene | None,
    many: Sequence[Experiments],
    free: Any = DEFAULT_FREE,
    *,
    bounds: Mapping[str, Any] | None = None,
    priors: Mapping[str, Any] | None = None,
    ties: Mapping[str, Any] | None = None,
    starts: int = 1,
    seed: int = 0,
    max_steps: int = DEFAULT_STEPS["levenberg-marquardt"],
    workers: int | None = None,
    progress: float | None = None,
) -> "Fits[AnyLaw]":
    """`fit` of one law to each of many data sets, side by side in one compiled program.

    Data sets of up to 4, 8, 16, ... shots share a program. Arguments and errors as of
    `fit`; `starts` are those of each data set; around the best, and in scans, none are
    added.

    Args:
        law: start values of all.
        scene: of all shots; None: each of `many` carries its own.
        many: the data sets.
        free: as of `fit`.
        bounds: as of `fit`.
        priors: as of `fit`; of each data set.
        ties: as of `fit`.
        starts: of each data set.
        seed: of the random starts.
        max_steps: iterations per start.
        workers: threads >= 1, which change no bit; None: one for each core.
        progress: a bar on stderr; None: on a terminal.

    Returns:
        `Fits`: arrays of values, and a `Fit` for each data set, in their order, made
        when it is asked for.

    Raises:
        ValueError: as of `fit`.

    >>> import jimpact as ji
    >>> sets = [
    ...     ji.Experiments([1.0, 0.0], [0.5 - 0.5 * e, 0.5 + 0.5 * e])
    ...     for e in (0.4, 0.8)
    ... ]
    >>> fits = ji.fit_many(ji.Newton(0.9), ji.chain([1.0, 1.0]), sets)
    >>> [round(float(each.law.restitution), 6) for each in fits]
    [0.4, 0.8]
    """
    as_whole("starts", starts, 1)
    as_workers(workers)
    check_kind("many", many, Sequence)
    for k, data in enumerate(many):
        check_kind(f"many[{k}]", data, Experiments)
    problems = _problems(law, scene, many, (free, bounds, priors, ties))
    each: dict[int, Ends] = {}  # of the starts of a data set
    with progress_bar(progress) as show:
        for members in _alike(problems):
            first = problems[members[0]]
            solver = Solver(max_steps=max_steps, show=show, workers=workers)
            points = start_points(first, starts, np.random.default_rng(seed))
            points = np.tile(points, (len(members), 1))
            group = [problems[k] for k in members]
            solved_problems, ends = solved(group, points, solver, FINE_OF_MANY)
            for i, (k, problem) in enumerate(zip(members, solved_problems)):
                each[k] = ends.rows(slice(i * starts, (i + 1) * starts))
                problems[k] = problem

    @functools.cache
    def made(k: int) -> Fit[AnyLaw]:
        """The `Fit` of data set k, in the precision of its problem."""
        with jax.enable_x64(problems[k].precision == "float64"):
            return made_now(k)

    def made_now(k: int) -> Fit[AnyLaw]:
        """The `Fit` of data set k; if it has unusable shots, fitted anew without
        these.
        """
        solution = solution_of(problems[k], each[k])
        search = Search(seed=seed, max_steps=max_steps, progress=False)
        if unusable(problems[k], solution).any():
            return fit(problems[k], starts=starts, profiles=False, search=search)
        return as_fit(problems[k], solution, search)

    best = [each[k].rows(np.nanargmin(each[k].squares)) for k in range(len(many))]
    value = problems[0].values_at(np.array([end.y for end in best]))
    squares = np.array([end.squares for end in best])
    converged = np.array([end.converged for end in best])
    return Fits(problems[0].names, value, squares, converged, made)


def _problems(
    law: Any, scene: Scene | None, many: Sequence[Experiments], choice: tuple[Any, ...]
) -> list[FitProblem]:
    """Problems of many data sets, `choice` what of the law is free, and how.

    Those of other shots follow from the first one, but where more depends on the data:
    scenes, errors of v-, and the coarse tolerance that their noise allows.
    """
    first = of_shots(law, scene, many[0], *choice)
    coarse = getattr(first.law, "rtol", None) == COARSE_RTOL
    follow = scene is not None and first.before is None and not coarse
    problems = [first]
    for data in many[1:]:
        only_shots = data.scenes is None and data.sigma_pre is None
        if follow and only_shots:
            other = first.of_other(data, scene)
        else:
            other = of_shots(law, scene, data, *choice)
        problems.append(other)
    return problems


def _alike(problems: Sequence[FitProblem]) -> list[list[int]]:
    """Indices of problems, grouped by the shapes of their arrays: a group shares one
    program.
    """
    groups: dict[Any, list[int]] = {}
    for k, problem in enumerate(problems):
        leaves, structure = jax.tree.flatten(problem.for_compiled())
        groups.setdefault((structure, *map(np.shape, leaves)), []).append(k)
    return list(groups.values())


@dataclass(frozen=True, eq=False)
class Fits(Sequence[Fit[AnyLaw]]):
    """Fits of one law to S data sets: `value` (S, P) by `names`, and a `Fit` each when
    asked for.

    `squares` (S,) are the sums of squared weighted residuals, `converged` (S,) which
    searches have ended. `fits[k]` makes errors and report of one; so does a loop over
    all.
    """

    names: tuple[str, ...]
    value: np.ndarray
    squares: np.ndarray
    converged: np.ndarray
    _made: Callable[[int], Fit[AnyLaw]] = field(repr=False)

    def __len__(self) -> int:
        return len(self.value)

    def __getitem__(self, k: Any) -> Any:
        each = range(len(self))[k]
        if isinstance(each, range):
            return [self._made(i) for i in each]
        return self._made(each)


@dataclass(frozen=True, eq=False)
class Refits:
    """Parameters `value` (B, P), by `names`, of fits to changed data.

    `predicted` (B, ...) is what each predicts, shaped like what was measured [m/s];
    `converged` (B,) which of the fits have.
    """

    names: tuple[str, ...]
    value: np.ndarray
    predicted: np.ndarray
    converged: np.ndarray

    def interval(self, level: float = 0.95) -> np.ndarray:
        """Quantiles (P, 2) between which the share `level` of the values lies."""
        check_level(level)
        return np.quantile(self.value, [0.5 - 0.5 * level, 0.5 + 0.5 * level], axis=0).T


@in_own_precision
def bootstrap(
    fit: Fit,
    samples: int = 200,
    *,
    seed: int = 0,
    workers: int | None = None,
    progress: float | None = None,
) -> Refits:
    """Fits to data that the fitted law made, with the noise of the fit.

    Equation: `v+* = v+(law) + sigma z`, z standard normal; sigma as stated, else
    `fit.noise`. With errors of v-, v- and v+ are drawn around the true v- of the fit,
    and v+ of the law there.

    Args:
        fit: with a known noise.
        samples: data sets B.
        seed: of z.
        workers: threads >= 1, which change no bit; None: one for each core.
        progress: a bar on stderr; None: on a terminal.

    Returns:
        `Refits` with `value` (B, P).

    Raises:
        ValueError: samples < 1; a noise that is not known; a robust loss.

    >>> import jimpact as ji
    >>> data = ji.Experiments(
    ...     [[1.0, 0.0], [2.0, 0.0]], [[0.11, 0.88], [0.2, 1.81]], sigma=0.02
    ... )
    >>> result = ji.fit(ji.Newton(0.9), ji.chain([1.0, 1.0]), data)
    >>> spread = ji.bootstrap(result).value.std()
    >>> bool(abs(spread / result.standard_error[0] - 1) < 0.1)
    True
    """
    as_whole("samples", samples, 1)
    as_whole("seed", seed, 0)
    as_workers(workers)
    check_squares("fit", fit)
    if not np.isfinite(fit.noise):
        raise ValueError(
            "Argument `fit` must have a known noise, but its noise is not finite."
        )
    problem = fit.problem
    rng = np.random.default_rng(seed)
    if problem.before is not None:
        measured, before = _measured_again(fit, samples, rng)
    else:
        z = rng.normal(size=(samples, *fit.predicted.shape))
        errors = problem.measurement.errors_of(fit.noise * np.moveaxis(z, 0, -1))
        measured = fit.predicted + np.moveaxis(errors, -1, 0)
        before = [None] * samples
    # means of priors are drawn, too, as if they had been measured again
    means = np.tile(problem.prior_mean, (samples, 1))
    z = np.random.default_rng((seed, 1)).normal(size=(samples, len(problem.priors)))
    for prior, drawn in zip(problem.priors, z.T):
        i = prior.parameter
        means[:, i] = fit.value[i] + fit.noise * prior.std * drawn
    dtype = problem.dtype
    drawn = zip(measured.astype(dtype), means, before)
    resampled = [problem.measured_again(*values) for values in drawn]
    return _refits(fit, resampled, workers, progress)


def _measured_again(
    fit: Fit, samples: int, rng: np.random.Generator
) -> tuple[Any, Any]:
    """v+ and v- (B, K, n) of shots measured again, at the true v- of the fit."""
    problem = fit.problem
    assert problem.before is not None
    assert fit.search.pre is not None
    assert fit.slopes is not None
    shift = np.einsum(
        "kij,kj->ki", fit.slopes, problem.velocities_before - fit.search.pre
    )
    before, after = problem.before.drawn(rng, (samples, *fit.search.pre.shape))
    pre = fit.search.pre + fit.noise * before
    post = problem.before.corrected(pre, fit.predicted - shift + fit.noise * after)
    return np.where(problem.measurement.is_measured, post, np.nan), pre


@in_own_precision
def leave_one_out(
    fit: Fit, *, workers: int | None = None, progress: float | None = None
) -> Refits:
    """A fit without each of the K shots; `predicted` (K, n) is of the shot left out.

    `measured - predicted` is an honest error of prediction: laws with different numbers
    of parameters may be compared by it.

    Args:
        fit: of K >= 2 shots.
        workers: threads >= 1, which change no bit; None: one for each core.
        progress: a bar on stderr; None: on a terminal.

    Returns:
        `Refits` with `value` (K, P).

    Raises:
        ValueError: a fit to something else than at least two shots; a robust loss.

    >>> import jimpact as ji
    >>> data = ji.Experiments([[1.0, 0.0], [2.0, 0.0]], [[0.1, 0.9], [0.6, 1.4]])
    >>> result = ji.fit(ji.Newton(0.9), ji.chain([1.0, 1.0]), data)
    >>> ji.leave_one_out(result).value.round(6).tolist()
    [[0.4], [0.8]]
    """
    as_workers(workers)
    check_squares("fit", fit)
    if fit.experiments is None:
        shots = 0
    else:
        shots = len(fit.predicted)
    if shots < 2:
        raise ValueError(
            f"Argument `fit` must be of at least 2 shots, but has {shots}."
        )
    each = np.eye(shots)[:, :, None] * np.ones(fit.predicted.shape)
    refits = _refits(
        fit, [fit.problem.weighed(1 - shot) for shot in each], workers, progress
    )
    return replace(
        refits, predicted=refits.predicted[np.arange(shots), np.arange(shots)]
    )


def _refits(
    fit: Fit, problems: list[FitProblem], workers: int | None, progress: float | None
) -> Refits:
    """`Refits` of B problems of changed data, each from the parameters of the fit."""
    points = np.tile(fit.problem.variables.point(fit.value), (len(problems), 1))
    with progress_bar(progress) as show:
        solver = Solver(show=show, workers=workers)
        _, ends = solved(problems, points, solver, FINE_OF_MANY)
    if fit.predicted.ndim:
        predicted = ends.predicted[:, : len(fit.predicted)]
    else:
        predicted = ends.predicted
    return Refits(fit.names, fit.problem.values_at(ends.y), predicted, ends.converged)
