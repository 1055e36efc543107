"""Many fits side by side in the lanes of one program: data sets, bootstrap, shots left out."""

import functools
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import equinox as eqx
import jax
import numpy as np

from jimpact._checks import as_whole, check_kind
from jimpact.fits.adequacy import unusable
from jimpact.fits.experiments import Experiments
from jimpact.fits.fitting import Fit, as_fit, fit
from jimpact.fits.intervals import check_level
from jimpact.fits.parameters import DEFAULT_FREE, AnyLaw
from jimpact.fits.problem import FitProblem, Residuals, filled_count, filled_up, of_shots
from jimpact.fits.result import check_squares
from jimpact.fits.search import ends, repeated, settled, stacked, start_points
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
) -> "Fits[AnyLaw]":
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
        `Fits`: arrays of values, and a `Fit` for each data set, in their order, made when it is
        asked for.

    Raises:
        ValueError: as of `fit`.

    >>> import jimpact as ji
    >>> sets = [ji.Experiments([1.0, 0.0], [0.5 - 0.5 * e, 0.5 + 0.5 * e]) for e in (0.4, 0.8)]
    >>> fits = ji.fit_many(ji.Newton(0.9), ji.chain([1.0, 1.0]), sets)
    >>> [round(float(each.law.restitution), 6) for each in fits]
    [0.4, 0.8]
    """
    as_whole("starts", starts, 1)
    check_kind("many", many, Sequence)
    choice = (free, bounds, priors, ties)
    options = {"starts": starts, "seed": seed, "max_steps": max_steps, "profiles": False}

    @functools.cache
    def problem(k: int) -> FitProblem:
        """The problem of one data set."""
        return of_shots(law, scene, many[k], *choice)

    value: Any = [None] * len(many)
    squares, converged = np.zeros(len(many)), np.zeros(len(many), bool)
    makers: list[Callable[[], Fit[AnyLaw]]] = [lambda: fit(problem(0))] * len(many)
    with progress_bar(progress) as show:
        search = Search(max_steps=max_steps, show=show)
        for group in _alike(many):
            rng = np.random.default_rng(seed)
            first = problem(group[0])
            points = [start_points(first, starts, rng) for _ in group]
            side_by_side = _side_by_side(problem, many, group)
            all_starts = jax.tree.map(lambda x: np.repeat(x, starts, axis=0), side_by_side)
            states = minimize(all_starts, np.concatenate(points), search)
            if all_starts.mixing is not None:
                states, group_problems = _with_errors_before(problem, group, states, search)
            each = len(states.y) // len(group)
            for i, k in enumerate(group):
                rows = slice(i * each, (i + 1) * each)
                best = rows.start + int(np.nanargmin(states.squares[rows]))
                ended = jax.tree.map(operator.itemgetter(rows), states)
                one = functools.partial(problem, k)
                if all_starts.mixing is not None:
                    one = functools.partial(group_problems.__getitem__, i)
                makers[k] = functools.partial(_made, one, ended, options)
                value[k] = first.values_at(np.asarray(states.y[best]))
                squares[k], converged[k] = states.squares[best], states.converged[best]
                squares[k] *= float(side_by_side.size[i]) ** 2
    return Fits(problem(0).names, np.array(value), squares, converged, tuple(makers))


def _alike(many: Sequence[Experiments]) -> list[list[int]]:
    """Data sets that share one program: as many shots, filled up, all with or without errors."""
    groups: dict[Any, list[int]] = {}
    for k, data in enumerate(many):
        check_kind(f"many[{k}]", data, Experiments)
        kind = (filled_count(len(data.shots)), data.pre.shape[1], data.sigma is None)
        shapes = None if data.scenes is None else data.largest_scene(None).contacts
        groups.setdefault((*kind, data.sigma_pre is None, shapes), []).append(k)
    return list(groups.values())


def _side_by_side(
    problem: Callable[[int], FitProblem], many: Sequence[Experiments], group: list[int]
) -> Residuals:
    """The residuals of a group, one program's argument.

    Sets of equal shapes in a common scene are stacked as arrays, whose problems nobody needs.
    """
    first = problem(group[0])
    sets = [many[k] for k in group]
    same = all(x.scenes is None and x.sigma_pre is None for x in sets)
    same = same and len({(x.pre.shape, x.units) for x in sets}) == 1
    # of a coarser law, where the noise allows it, each set decides by itself
    if not same or any("computed with `rtol`" in note for note in first.notes):
        return stacked([problem(k) for k in group])
    one = filled_up(first.residuals)
    pre, post = (np.stack([np.asarray(getattr(x, name)) for x in sets]) for name in ("pre", "post"))
    errors = np.broadcast_to(sets[0].natural_errors(first.scene), post.shape)
    if sets[0].sigma is not None:
        errors = np.stack([np.asarray(x.sigma) for x in sets])
    here, dtype = ~np.isnan(post), one.offset.dtype
    weight = np.where(here, 1 / np.where(here, errors, 1.0), 0.0)
    unit = np.maximum(np.abs(pre).max(axis=(1, 2)), np.nanmax(np.abs(post), axis=(1, 2)))
    unit = np.where(unit > 0, unit, 1.0)
    size = unit * np.sqrt(np.sum(weight**2, axis=(1, 2)))
    rows = np.minimum(np.arange(len(one.measured)), post.shape[1] - 1)
    weight = np.where(np.arange(len(rows))[:, None] < post.shape[1], weight[:, rows], 0.0)
    observe: Any = one.observe
    before = np.repeat(np.asarray(observe.pre)[None], len(sets), axis=0)
    before[:, :, : post.shape[2]] = pre[:, rows]
    arrays = (before, np.nan_to_num(post)[:, rows], weight / size[:, None, None], size, unit)
    many_residuals = repeated(one, len(sets))
    return eqx.tree_at(
        lambda r: (r.observe.pre, r.measured, r.weight, r.size, r.unit),
        many_residuals,
        tuple(np.asarray(x, dtype) for x in arrays),
    )


def _with_errors_before(
    problem: Callable[[int], FitProblem], group: list[int], states: SolverState, search: Search
) -> tuple[SolverState, list[FitProblem]]:
    """The best minimum of each problem with errors of v- that its own law passes on."""
    each = len(states.y) // len(group)
    best = np.arange(0, len(states.y), each) + np.nanargmin(states.cost.reshape(-1, each), axis=1)
    slopes = list(states.aux[-1][best])
    points = np.asarray(states.y, float)[best]
    problems, states = settled([problem(k) for k in group], points, search, slopes=slopes)
    return states, problems


def _made(
    problem: Callable[[], FitProblem], states: SolverState, options: Mapping[str, Any]
) -> Fit[Any]:
    """The fit at the best of these ends; shots that cannot be used are left out in a new one."""
    solution = ends(problem(), states)
    if unusable(problem(), solution).any():
        return fit(problem(), progress=False, **options)
    return as_fit(problem(), solution, "levenberg-marquardt")


@dataclass(frozen=True, eq=False)
class Fits(Sequence[Fit[AnyLaw]]):
    """Fits of one law to S data sets: `value` (S, P) by `names`, and a `Fit` each when asked for.

    `squares` (S,) are the sums of squared weighted residuals, `converged` (S,) which searches have
    ended. `fits[k]` makes errors and report of one; so does a loop over all.
    """

    names: tuple[str, ...]
    value: np.ndarray
    squares: np.ndarray
    converged: np.ndarray
    _makers: tuple[Callable[[], Fit[AnyLaw]], ...] = field(repr=False)
    _made: dict[int, Fit[AnyLaw]] = field(default_factory=dict, repr=False)

    def __len__(self) -> int:
        return len(self._makers)

    def __getitem__(self, k: Any) -> Any:
        if isinstance(k, slice):
            return [self[i] for i in range(*k.indices(len(self)))]
        k = range(len(self))[k]
        if k not in self._made:
            self._made[k] = self._makers[k]()
        return self._made[k]


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
