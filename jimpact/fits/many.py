"""Many fits side by side in the lanes of one program: data sets, bootstrap, shots left out."""

import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import numpy as np

from jimpact._checks import as_whole
from jimpact.fits.adequacy import unusable
from jimpact.fits.experiments import Experiments
from jimpact.fits.fitting import Fit, as_fit, fit
from jimpact.fits.intervals import check_level
from jimpact.fits.parameters import DEFAULT_FREE, AnyLaw
from jimpact.fits.problem import FitProblem, Residuals, filled_up, of_shots
from jimpact.fits.result import check_squares
from jimpact.fits.search import SearchResult, ends, repeated, settled, stacked, start_points
from jimpact.fits.solve import DEFAULT_STEPS, Search, SolverState, minimize
from jimpact.progress import progress_bar
from jimpact.scene import Scene


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
    progress: float | None = None,
) -> list[Fit[AnyLaw]]:
    """`fit` of one law to each of many data sets, side by side in one compiled program.

    Data sets of up to 4, 8, 16, ... shots share a program. Arguments and errors as of `fit`;
    `starts` are those of each data set; around the best, and in scans, none are added.

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
        progress: a bar on stderr; None: on a terminal.

    Returns:
        A `Fit` for each data set, in their order.

    Raises:
        ValueError: as of `fit`.

    >>> import jimpact as ji
    >>> sets = [ji.Experiments([1.0, 0.0], [0.5 - 0.5 * e, 0.5 + 0.5 * e]) for e in (0.4, 0.8)]
    >>> fits = ji.fit_many(ji.Newton(0.9), ji.chain([1.0, 1.0]), sets)
    >>> [round(float(each.law.restitution), 6) for each in fits]
    [0.4, 0.8]
    """
    as_whole("starts", starts, 1)
    choice = (free, bounds, priors, ties)
    problems = [of_shots(law, scene, data, *choice) for data in many]
    filled = [filled_up(problem.residuals) for problem in problems]
    groups: dict[str, list[int]] = {}
    for k, residuals in enumerate(filled):
        shape = (jax.tree.structure(residuals), [np.shape(x) for x in jax.tree.leaves(residuals)])
        groups.setdefault(str(shape), []).append(k)
    fits: dict[int, Fit[AnyLaw]] = {}
    with progress_bar(progress) as show:
        for group in groups.values():
            rng = np.random.default_rng(seed)
            points = np.concatenate([start_points(problems[k], starts, rng) for k in group])
            chosen = [problems[k] for k in group]
            all_starts = stacked([problem for problem in chosen for _ in range(starts)])
            search = Search(max_steps=max_steps, show=show)
            ended = _ends_of(chosen, minimize(all_starts, points, search))
            if all_starts.mixing is not None:
                best, slopes = (np.array([x.y for x in ended]), [x.slopes for x in ended])
                chosen, states = settled(chosen, best, search, slopes=slopes)
                ended = _ends_of(chosen, states)
            for k, problem, solution in zip(group, chosen, ended):
                if unusable(problem, solution).any():  # what is left is another problem
                    options: dict[str, Any] = {"starts": starts, "seed": seed, "profiles": False}
                    fits[k] = fit(problems[k], max_steps=max_steps, progress=False, **options)
                else:
                    fits[k] = as_fit(problem, solution, search.method)
    return [fits[k] for k in range(len(problems))]


def _ends_of(problems: list[FitProblem], states: SolverState) -> list[SearchResult]:
    """The ends of each problem, all of which have equally many starts."""
    each = len(states.y) // len(problems)
    rows = [slice(i * each, (i + 1) * each) for i in range(len(problems))]
    return [ends(p, jax.tree.map(operator.itemgetter(r), states)) for p, r in zip(problems, rows)]


@dataclass(frozen=True, eq=False)
class Refits:
    """Parameters `value` (B, P), by `names`, of fits to changed data.

    `predicted` (B, ...) is what each predicts, shaped like what was measured [m/s]; `converged`
    (B,) which of the fits have.
    """

    names: tuple[str, ...]
    value: np.ndarray
    predicted: np.ndarray
    converged: np.ndarray

    def interval(self, level: float = 0.95) -> np.ndarray:
        """Quantiles (P, 2) between which the share `level` of the values lies."""
        check_level(level)
        return np.quantile(self.value, [0.5 - 0.5 * level, 0.5 + 0.5 * level], axis=0).T


def bootstrap(
    fit: Fit, samples: int = 200, *, seed: int = 0, progress: float | None = None
) -> Refits:
    """Fits to data that the fitted law made, with the noise of the fit (parametric bootstrap).

    Equation: `v+* = v+(law) + sigma z`, z standard normal; sigma as stated, else `fit.noise`;
    errors of v- are passed on by the law.

    Args:
        fit: with a known noise.
        samples: data sets B.
        seed: of z.
        progress: a bar on stderr; None: on a terminal.

    Returns:
        `Refits` with `value` (B, P).

    Raises:
        ValueError: samples < 1; a noise that is not known; a robust loss.

    >>> import jimpact as ji
    >>> data = ji.Experiments([[1.0, 0.0], [2.0, 0.0]], [[0.11, 0.88], [0.2, 1.81]], sigma=0.02)
    >>> result = ji.fit(ji.Newton(0.9), ji.chain([1.0, 1.0]), data)
    >>> spread = ji.bootstrap(result).value.std()
    >>> bool(abs(spread / result.standard_error[0] - 1) < 0.1)
    True
    """
    as_whole("samples", samples, 1)
    check_squares("fit", fit)
    if not np.isfinite(fit.noise):
        raise ValueError("Argument `fit` must have a known noise, but its noise is not finite.")
    residuals, shape = filled_up(fit.problem.residuals), fit.predicted.shape
    z = np.random.default_rng(seed).normal(size=(samples, *shape))
    errors = fit.problem.errors_of(fit.noise * np.moveaxis(z, 0, -1))
    measured = np.zeros((samples, *residuals.measured.shape), residuals.measured.dtype)
    rows = (slice(None), slice(len(fit.predicted))) if shape else slice(None)
    measured[rows] = np.nan_to_num(fit.predicted + np.moveaxis(errors, -1, 0))
    many = eqx.tree_at(
        lambda r: (r.measured, r.prior_mean),
        repeated(residuals, samples),
        (measured, _drawn_priors(fit, samples, seed)),
    )
    return _refits(fit, [fit.problem] * samples, many, progress)


def _drawn_priors(fit: Fit, samples: int, seed: int) -> np.ndarray:
    """Means (B, Q) of the priors as if they had been measured anew, around what was fitted."""
    r, problem = fit.problem.residuals, fit.problem
    means = np.tile(np.asarray(r.prior_mean), (samples, 1))
    z = np.random.default_rng((seed, 1)).normal(size=(samples, len(problem.priors)))
    for prior, drawn in zip(problem.priors, z.T):
        at = problem.parameters.first[prior.parameter]
        means[:, at] = fit.value[prior.parameter] + fit.noise * prior.std * drawn
    return means


def leave_one_out(fit: Fit, *, progress: float | None = None) -> Refits:
    """A fit without each of the K shots in turn; `predicted` (K, n) is of the shot left out.

    `measured - predicted` is an honest error of prediction: laws with different numbers of
    parameters may be compared by it.

    Args:
        fit: of K >= 2 shots.
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
    check_squares("fit", fit)
    shots = 0 if fit.experiments is None else len(fit.predicted)
    if shots < 2:
        raise ValueError(f"Argument `fit` must be of at least 2 shots, but has {shots}.")
    residuals = filled_up(fit.problem.residuals)
    weight = np.repeat(np.asarray(residuals.weight)[None], shots, axis=0)
    weight[np.arange(shots), np.arange(shots)] = 0.0
    many = eqx.tree_at(lambda r: r.weight, repeated(residuals, shots), weight)
    each = np.eye(shots)[:, :, None] * np.ones(fit.predicted.shape)
    problems = [fit.problem.weighed(1 - shot) for shot in each]
    refits = _refits(fit, problems, many, progress)
    one_each = refits.predicted[np.arange(shots), np.arange(shots)]
    return replace(refits, predicted=one_each)


def _refits(
    fit: Fit, problems: list[FitProblem], many: Residuals, progress: float | None
) -> Refits:
    """Minima of these problems next to a fit."""
    points = np.tile(fit.problem.point(fit.value), (len(problems), 1))
    with progress_bar(progress) as show:
        _, states = settled(problems, points, Search(show=show), many)
    value = fit.problem.values_at(np.asarray(states.y, float))
    predicted = np.asarray(states.aux[0], float)
    predicted = predicted[:, : len(fit.predicted)] if fit.predicted.ndim else predicted
    return Refits(fit.names, value, predicted, states.converged)
