"""The least-squares problem of a fit: weighted residuals of a law and their Jacobian."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact.experiments import Experiments
from jimpact.impacts import impact
from jimpact.laws.base import Law
from jimpact.numerics.bijections import Interval
from jimpact.numerics.least_squares import Method, minimize
from jimpact.parameters import LOGARITHMIC, Parameters
from jimpact.scene import Scene, kinetic_energy
from jimpact.status import CODE

# Outcomes whose velocities mean nothing. A trial that meets one gets a residual far above any
# honest one, so that a solver turns back; inadmissible or energetic outcomes are only reported.
UNUSABLE = ("infeasible", "max_steps", "not_finite")
PENALTY = 1e3  # times the largest weighted velocity


class Problem(eqx.Module):
    """Shots and law of one fit as arrays: a pytree that compiled functions take as argument."""

    law: Law
    parameters: Parameters
    interval: Interval
    scenes: Scene  # one, or stacked one a shot
    pre: jax.Array
    post: jax.Array  # 0 where not measured
    weight: jax.Array  # 1 / sigma, or 1 / unit; 0 where not measured
    scale: np.ndarray  # natural size (P,) of a change of each parameter
    unit: np.ndarray  # () the largest velocity [m/s]: makes residuals of order 1
    scene_per_shot: bool = eqx.field(static=True)


class Evaluation(NamedTuple):
    """Residuals of one parameter vector, on the host."""

    value: np.ndarray
    residual: np.ndarray
    jacobian: np.ndarray
    velocity: np.ndarray
    status: np.ndarray

    @property
    def sum_of_squares(self) -> float:
        """`|r|^2` of the weighted residuals."""
        return float(self.residual @ self.residual)


def build_problem(
    law: Law,
    scene: Scene | None,
    experiments: Experiments,
    parameters: Parameters,
    limits: tuple[np.ndarray, np.ndarray],
) -> Problem:
    """Arrays, weights and natural scales of a fit."""
    own = [experiments.scene_of(scene, k) for k in range(len(experiments.shots))]
    per_shot = experiments.scenes is not None
    measured = jnp.asarray(experiments.measured)
    speeds = [jnp.abs(experiments.pre).max(), jnp.nanmax(jnp.abs(experiments.post))]
    dtype = experiments.pre.dtype
    unit = float(max(speeds)) or 1.0
    sigma = unit if experiments.sigma is None else experiments.sigma
    energy = max(float(kinetic_energy(s, v)) for s, v in zip(own, experiments.pre)) or 1.0
    scale = _natural_scales(parameters, law, energy)
    return Problem(
        law=law,
        parameters=parameters,
        interval=_interval(parameters, limits, scale, dtype),
        scenes=jax.tree.map(lambda *x: jnp.stack(x), *own) if per_shot else own[0],
        pre=experiments.pre,
        post=jnp.where(measured, experiments.post, 0.0),
        weight=jnp.where(measured, 1.0 / sigma, 0.0),
        scale=scale,
        unit=np.asarray(unit, dtype),
        scene_per_shot=per_shot,
    )


def _natural_scales(parameters: Parameters, law: Law, energy: float) -> np.ndarray:
    """What counts as a change of order 1: the value (stiffness), an energy, else 1 or |value|."""
    scale = np.maximum(np.abs(parameters.of(law)), 1.0)
    for i, field, _ in parameters.each():
        if field in LOGARITHMIC:
            scale[i] = parameters.of(law)[i]
        elif field == "initial_energy":
            scale[i] = energy
    return scale


def _interval(
    parameters: Parameters, limits: tuple[np.ndarray, np.ndarray], scale: np.ndarray, dtype: Any
) -> Interval:
    log = np.array([field in LOGARITHMIC for _, field, _ in parameters.each()])
    with np.errstate(divide="ignore", invalid="ignore"):
        low, high = (np.where(log, np.log(end), end) for end in limits)
    arrays = (low, high, np.where(log, 1.0, scale))
    return Interval(*(jnp.asarray(x, dtype) for x in arrays), jnp.asarray(log))


def residual_and_jacobian(problem: Problem, x: jax.Array) -> tuple[jax.Array, ...]:
    """Weighted residual (K n,), its Jacobian (K n, P), v+ (K, n), status (K,)."""

    def outcome(x: jax.Array) -> tuple[jax.Array, tuple[jax.Array, ...]]:
        law = problem.parameters.put(problem.law, x)
        axes = (None, 0 if problem.scene_per_shot else None, 0)
        out = jax.vmap(impact, in_axes=axes)(law, problem.scenes, problem.pre)
        residual = (out.velocity - problem.post) * problem.weight
        codes = jnp.asarray([CODE[name] for name in UNUSABLE])
        bad = jnp.any(out.status[:, None] == codes[None, :], axis=1)
        residual = jnp.where(bad[:, None], PENALTY * problem.unit * problem.weight, residual)
        return residual.reshape(-1), (residual.reshape(-1), out.velocity, out.status)

    jacobian, (residual, velocity, status) = jax.jacfwd(outcome, has_aux=True)(x)
    return residual, jacobian, velocity, status


@eqx.filter_jit
def evaluate(problem: Problem, x: jax.Array) -> tuple[jax.Array, ...]:
    """`residual_and_jacobian` of a batch of parameter vectors (B, P)."""
    return jax.vmap(residual_and_jacobian, in_axes=(None, 0))(problem, x)


@eqx.filter_jit
def solve(
    problem: Problem,
    z: jax.Array,
    held: jax.Array,
    held_value: jax.Array,
    method: Method,
    max_steps: int,
) -> tuple[jax.Array, jax.Array]:
    """Minimize from a batch of starts z (B, P); entries `held` (B, P) stay at `held_value`.

    Returns the parameters (B, P) and the number of steps (B,).
    """

    # gradient descent has step sizes: |r|^2 becomes the mean square relative to the velocities
    size = 1 / (problem.unit * jnp.linalg.norm(problem.weight))

    def weighted(z: jax.Array, args: Any) -> tuple[jax.Array, jax.Array]:
        held, held_value = args
        to_bounded = problem.interval.to_bounded
        x, slope = jax.jvp(to_bounded, (z,), (jnp.where(held, 0.0, jnp.ones_like(z)),))
        residual, jacobian, *_ = residual_and_jacobian(problem, jnp.where(held, held_value, x))
        return size * residual, size * jacobian * slope[None, :]

    def one(z: jax.Array, held: jax.Array, held_value: jax.Array) -> tuple[jax.Array, jax.Array]:
        z, steps = minimize(weighted, z, (held, held_value), method, max_steps)
        return jnp.where(held, held_value, problem.interval.to_bounded(z)), steps

    return jax.vmap(one)(z, held, held_value)
