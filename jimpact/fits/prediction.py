"""What a fitted law predicts for further shots, with errors of its parameters."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import check_kind, check_values
from jimpact.fits.experiments import Experiments
from jimpact.fits.parameters import value_of
from jimpact.fits.problem import FitProblem
from jimpact.fits.result import FitResult
from jimpact.fits.scene_parameters import LawInScene
from jimpact.fits.search import SearchResult, evaluated
from jimpact.fits.ties import entry_of, tied_names, tied_places
from jimpact.law import Law, parameters_of
from jimpact.scene import Scene


class Predicted(NamedTuple):
    """Velocities after each shot (K, n) [m/s], their standard errors (K, n), status codes (K,).

    `noise` (K, n) is the standard error of a measurement of them. `low` and `high` (K, n) are the
    ends of the band in which such a measurement lies.
    """

    velocity: np.ndarray
    standard_error: np.ndarray
    status: np.ndarray
    noise: np.ndarray
    low: np.ndarray
    high: np.ndarray


def predicted(fit: FitResult, shots: Any, scene: Scene | None, level: float) -> Predicted:
    """Values at the fitted parameters, and `sqrt(J C J^T)` with their covariance C."""
    quantile = fit.quantile(level)
    if fit.experiments is None:
        raise ValueError("Argument `fit` must be to shots.")
    data, scenes, units = shots, None, fit.experiments.units
    if isinstance(shots, Experiments):
        data, scenes, units = shots.pre, shots.scenes, shots.units
    if np.ndim(data) != 2 or np.shape(data)[1] != len(units):
        raise ValueError(
            f"Argument `shots` must have shape (K, {len(units)}), velocities of the bodies of the "
            f"fit, but has shape {np.shape(data)}."
        )
    check_values("shots", data)
    data = Experiments(data, np.zeros_like(np.asarray(data, float)), scenes=scenes, units=units)
    law, own = placed_fit(fit, scene)
    largest = own if scenes is None else max(scenes, key=lambda each: each.contacts)
    _check_scene(fit, largest, len(units))
    ties = dict(fit.problem.ties)
    problem = FitProblem.from_shots(law, own, data, fit.problem.parameters.labels, ties=ties)
    solution = evaluated(problem, problem.point(problem.start))
    error = fit.errors_of(jacobian_of(problem, solution))
    value, noise = solution.predicted, _noise_of(fit, shots)
    half = quantile * np.hypot(error, noise)
    return Predicted(value, error, np.asarray(solution.status), noise, value - half, value + half)


def placed_fit(fit: FitResult, scene: Scene | None) -> tuple[Law, Scene | None]:
    """The law of a fit, with the parts of the scene that were fitted, and the scene of new shots.

    Raises:
        ValueError: another scene than that of which parts were fitted.
    """
    law = fit.law_in_scene
    if isinstance(law, LawInScene) and scene is not None:
        raise ValueError(
            "Argument `scene` must be left out where parts of the scene were fitted: they hold for "
            "that of the fit only."
        )
    return law, fit.problem.scene if scene is None else scene


def _check_scene(fit: FitResult, scene: Any, size: int) -> None:
    """Raise unless this is a scene for the law that was fitted and velocities of this size."""
    check_kind("scene", scene, Scene)
    values = [x.value for x in parameters_of(fit.law).values() if x.domain.per_contact]
    counts = {np.shape(value)[0] for value in values if np.ndim(value) == 1}
    if scene.size != size or counts - {scene.contacts}:
        contacts = f" and {min(counts)} contacts, one for each value of the law" if counts else ""
        raise ValueError(
            f"Argument `scene` must have {size} velocities as the fit{contacts}, but has "
            f"{scene.size} and {scene.contacts}."
        )


def _noise_of(fit: FitResult, shots: Any) -> np.ndarray:
    """Standard errors (K, n) of measured velocities: of the shots, or as those of the fit (rms)."""
    if isinstance(shots, Experiments) and shots.sigma is not None:
        stretched = 1.0 if fit.problem.sigma is None else fit.noise
        return stretched * np.asarray(shots.sigma, float)
    pre = shots.pre if isinstance(shots, Experiments) else shots
    weight = fit.problem.weight
    variance = np.where(weight > 0, 1 / np.where(weight > 0, weight, 1.0) ** 2, 0.0).sum(axis=0)
    count = (weight > 0).sum(axis=0)
    each = np.sqrt(variance / np.where(count > 0, count, np.nan))  # NaN: never measured
    return np.broadcast_to(fit.noise * each, np.shape(pre))


def jacobian_of(problem: FitProblem, solution: SearchResult) -> np.ndarray:
    """Derivatives (K, n, P) of what was measured in the parameters; NaN where none was measured."""
    shape = (*problem.measured.shape, len(problem.names))
    slope = solution.jacobian.reshape(shape) / solution.scale
    return problem.errors_of(problem.size * slope)


def tied_values(fit: FitResult) -> dict[str, tuple[float, float]]:
    """What follows from the parameters by ties: values and standard errors, by name of the entry.

    The errors are those that the derivatives of the ties leave.
    """
    problem, ties = fit.problem, fit.problem.ties

    def values(x: jax.Array) -> jax.Array:
        """The tied entries of parameters x."""
        law = problem.law_in_scene(x)
        parts = [jnp.ravel(value_of(law, entry_of(name)[0])) for name, _ in ties]
        places = tied_places(law, ties).values()
        return jnp.concatenate([part[np.array(at)] for part, at in zip(parts, places)])

    if not ties:
        return {}
    x = jnp.asarray(fit.value, problem.precision)
    errors = fit.errors_of(np.asarray(jax.jacfwd(values)(x), float))
    pairs = zip(np.asarray(values(x), float).tolist(), errors.tolist())
    return dict(zip(tied_names(problem.law, ties), pairs))
