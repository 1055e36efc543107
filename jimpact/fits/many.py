"""Many fits side by side in the lanes of one program: data sets, bootstrap, shots left out."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import numpy as np

from jimpact._checks import as_whole
from jimpact.experiments import Experiments
from jimpact.fits.fitting import Fit, as_fit
from jimpact.fits.least_squares import DEFAULT_STEPS, SolverState
from jimpact.fits.multistart import ends, repeated, run, start_points
from jimpact.fits.parameters import DEFAULT_FREE, AnyLaw
from jimpact.fits.problem import FitProblem, Residuals, filled_up, from_scaled, to_scaled
from jimpact.progress import progress_bar
from jimpact.scene import Scene

_METHOD = "levenberg-marquardt"


def fit_many(
    law: AnyLaw,
    scene: Scene | None,
    many: Sequence[Experiments],
    free: Any = DEFAULT_FREE,
    *,
    bounds: Mapping[str, Any] | None = None,
    starts: int = 1,
    seed: int = 0,
    max_steps: int = DEFAULT_STEPS[_METHOD],
    progress: float | None = None,
) -> list[Fit[AnyLaw]]:
    """`fit` of one law to each of many data sets, side by side in one compiled program.

    Data sets of up to 4, 16, 64, 128, ... shots share a program. Arguments and errors as of `fit`;
    `starts` are those of each data set.

    Args:
        law: start values of all.
        scene: of all shots; None: each of `many` carries its own.
        many: the data sets.
        free: as of `fit`.
        bounds: as of `fit`.
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
    >>> found = ji.fit_many(ji.Newton(0.9), ji.chain([1.0, 1.0]), sets)
    >>> [round(float(each.law.restitution), 6) for each in found]
    [0.4, 0.8]
    """
    as_whole("starts", starts, 1)
    problems = [FitProblem.from_shots(law, scene, data, free, bounds) for data in many]
    filled = [filled_up(problem.residuals) for problem in problems]
    groups: dict[str, list[int]] = {}
    for k, residuals in enumerate(filled):
        shape = (jax.tree.structure(residuals), [np.shape(x) for x in jax.tree.leaves(residuals)])
        groups.setdefault(str(shape), []).append(k)
    found: dict[int, Fit[AnyLaw]] = {}
    with progress_bar(progress) as show:
        for group in groups.values():
            rng = np.random.default_rng(seed)
            points = np.concatenate([start_points(problems[k], starts, rng) for k in group])
            stacked = jax.tree.map(
                lambda *x: np.repeat(np.stack([np.asarray(each) for each in x]), starts, axis=0),
                *(filled[k] for k in group),
            )
            states = run(stacked, points, _METHOD, max_steps, show, rivals=False)
            for i, k in enumerate(group):
                own = jax.tree.map(lambda x, i=i: x[i * starts : (i + 1) * starts], states)
                found[k] = as_fit(problems[k], ends(problems[k], own), _METHOD)
    return [found[k] for k in range(len(problems))]


@dataclass(frozen=True, eq=False)
class Refits:
    """Parameters `value` (B, P), by `names`, of fits to changed data.

    `predicted` (B, ...) is what each predicts, shaped like what was measured [m/s].
    """

    names: tuple[str, ...]
    value: np.ndarray
    predicted: np.ndarray

    def interval(self, level: float = 0.95) -> np.ndarray:
        """Quantiles (P, 2) between which the share `level` of the values lies."""
        if not 0 < level < 1:
            raise ValueError(f"Argument `level` must lie in (0, 1), but has value {level}.")
        return np.quantile(self.value, [0.5 - 0.5 * level, 0.5 + 0.5 * level], axis=0).T


def bootstrap(
    fit: Fit, samples: int = 200, *, seed: int = 0, progress: float | None = None
) -> Refits:
    """Fits to data that the fitted law made, with the noise of the fit (parametric bootstrap).

    Equation: `v+* = v+(law) + sigma z`, z standard normal; sigma as stated, else `fit.noise`.

    Args:
        fit: with a known noise.
        samples: data sets B.
        seed: of z.
        progress: a bar on stderr; None: on a terminal.

    Returns:
        `Refits` with `value` (B, P).

    Raises:
        ValueError: samples < 1; a noise that is not known.

    >>> import jimpact as ji
    >>> data = ji.Experiments([[1.0, 0.0], [2.0, 0.0]], [[0.11, 0.88], [0.2, 1.81]], sigma=0.02)
    >>> found = ji.fit(ji.Newton(0.9), ji.chain([1.0, 1.0]), data)
    >>> spread = ji.bootstrap(found).value.std()
    >>> bool(abs(spread / found.standard_error[0] - 1) < 0.1)
    True
    """
    as_whole("samples", samples, 1)
    if not np.isfinite(fit.noise):
        raise ValueError("Argument `fit` must have a known noise, but its noise is not finite.")
    residuals = filled_up(fit.problem.residuals)
    shape = fit.predicted.shape
    weight = np.asarray(residuals.weight, float) * float(residuals.size)
    measured = np.repeat(np.asarray(residuals.measured, float)[None], samples, axis=0)
    rows = slice(len(fit.predicted)) if shape else ()
    here = weight[rows] > 0
    sigma = fit.noise / np.where(here, weight[rows], 1.0)
    z = np.random.default_rng(seed).normal(size=(samples, *shape))
    measured[(slice(None), rows) if shape else slice(None)] = np.where(
        here, fit.predicted + sigma * z, 0.0
    )
    many = repeated(residuals, samples)
    many = eqx.tree_at(lambda r: r.measured, many, measured.astype(residuals.measured.dtype))
    return _refits(fit, many, samples, progress)


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
        ValueError: a fit to something else than at least two shots.

    >>> import jimpact as ji
    >>> data = ji.Experiments([[1.0, 0.0], [2.0, 0.0]], [[0.1, 0.9], [0.6, 1.4]])
    >>> found = ji.fit(ji.Newton(0.9), ji.chain([1.0, 1.0]), data)
    >>> ji.leave_one_out(found).value.round(6).tolist()
    [[0.4], [0.8]]
    """
    shots = 0 if fit.experiments is None else len(fit.predicted)
    if shots < 2:
        raise ValueError(f"Argument `fit` must be of at least 2 shots, but has {shots}.")
    residuals = filled_up(fit.problem.residuals)
    weight = np.repeat(np.asarray(residuals.weight)[None], shots, axis=0)
    weight[np.arange(shots), np.arange(shots)] = 0.0
    many = eqx.tree_at(lambda r: r.weight, repeated(residuals, shots), weight)
    found = _refits(fit, many, shots, progress)
    one_each = found.predicted[np.arange(shots), np.arange(shots)]
    return Refits(found.names, found.value, one_each)


def _refits(fit: Fit, many: Residuals, count: int, progress: float | None) -> Refits:
    """Minima of so many problems next to a fit."""
    r, first = fit.problem.residuals, fit.problem.parameters.first
    scale, log = np.asarray(r.scale, float)[first], np.asarray(r.log)[first]
    y = np.zeros((count, len(r.offset)))
    y[:, : len(first)] = to_scaled(fit.value, scale, log)
    with progress_bar(progress) as show:
        states: SolverState = run(many, y, _METHOD, DEFAULT_STEPS[_METHOD], show, rivals=False)
    value = from_scaled(np.asarray(states.y, float)[:, : len(first)], scale, log)
    seen = np.asarray(states.kept[0], float)
    return Refits(fit.names, value, seen[:, : len(fit.predicted)] if fit.predicted.ndim else seen)
