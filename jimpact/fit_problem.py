"""The least-squares problem of a fit: residuals of a law in scaled parameters, as arrays."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact.experiments import Experiments
from jimpact.impacts import impact
from jimpact.laws.base import Law
from jimpact.numerics.least_squares import Method, State, advance, begin
from jimpact.parameters import LOGARITHMIC, Parameters
from jimpact.scene import Scene, kinetic_energy
from jimpact.status import CODE

# Outcomes whose velocities mean nothing. A trial that meets one gets a residual far above any
# honest one, so that a solver turns back; inadmissible or energetic outcomes are only reported.
UNUSABLE = ("infeasible", "max_steps", "not_finite")
PENALTY = 1e3  # times the largest velocity


class Scaling(eqx.Module):
    """Scaled parameters `y = x / scale`, or `y = log x` where `log` is set: of order 1."""

    scale: jax.Array
    log: jax.Array

    def to_value(self, y: jax.Array) -> jax.Array:
        """x (P,) of y (P,)."""
        return jnp.where(self.log, jnp.exp(jnp.where(self.log, y, 0.0)), y * self.scale)

    def from_value(self, x: np.ndarray) -> np.ndarray:
        """y of x, (..., P), on the host."""
        log = np.asarray(self.log)
        with np.errstate(divide="ignore"):
            return np.where(log, np.log(np.where(log, x, 1.0)), x / np.asarray(self.scale, float))


class Problem(eqx.Module):
    """Law, shots and box of one fit: a pytree that compiled functions take as argument."""

    law: Law
    parameters: Parameters
    scaling: Scaling
    low: jax.Array  # bounds of y
    high: jax.Array
    scenes: Scene  # one, or stacked one a shot
    pre: jax.Array
    post: jax.Array  # 0 where not measured
    weight: jax.Array  # 0 where not measured; makes |r|^2 a mean square relative to `unit`
    size: jax.Array  # () size r is (v+ - measured) / sigma, with sigma = 1 m/s where unknown
    unit: jax.Array  # () the largest velocity [m/s]
    scene_per_shot: bool = eqx.field(static=True)


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
    dtype = experiments.pre.dtype
    pre, post = np.asarray(experiments.pre), np.nan_to_num(np.asarray(experiments.post))
    unit = max(np.abs(pre).max(), np.abs(post).max()) or 1.0
    sigma = np.ones_like(post) if experiments.sigma is None else np.asarray(experiments.sigma)
    weight = np.where(experiments.measured, 1 / sigma, 0.0)
    size = unit * np.linalg.norm(weight)
    energy = max(float(kinetic_energy(s, v)) for s, v in zip(own, experiments.pre)) or 1.0
    scaling = _scaling(parameters, law, energy, dtype)
    low, high = (jnp.asarray(scaling.from_value(end), dtype) for end in limits)
    return Problem(
        law=law,
        parameters=parameters,
        scaling=scaling,
        low=low,
        high=high,
        scenes=jax.tree.map(lambda *x: jnp.stack(x), *own) if per_shot else own[0],
        pre=experiments.pre,
        post=jnp.asarray(post),
        weight=jnp.asarray(weight / size, dtype),
        size=jnp.asarray(size, dtype),
        unit=jnp.asarray(unit, dtype),
        scene_per_shot=per_shot,
    )


def _scaling(parameters: Parameters, law: Law, energy: float, dtype: Any) -> Scaling:
    """What counts as a change of order 1: an energy, or else 1 or |value|; stiffness in its log."""
    scale = np.maximum(np.abs(parameters.of(law)), 1.0)
    log = np.zeros(len(scale), bool)
    for i, field, _ in parameters.each():
        log[i] = field in LOGARITHMIC
        if field == "initial_energy":
            scale[i] = energy
    return Scaling(jnp.asarray(scale, dtype), jnp.asarray(log))


def _evaluate(problem: Problem, y: jax.Array) -> tuple[jax.Array, jax.Array, Any]:
    """Weighted residual (K n,), its Jacobian (K n, P), and v+ (K, n), status (K,)."""

    def outcome(y: jax.Array) -> tuple[jax.Array, Any]:
        law = problem.parameters.put(problem.law, problem.scaling.to_value(y))
        axes = (None, 0 if problem.scene_per_shot else None, 0)
        out = jax.vmap(impact, in_axes=axes)(law, problem.scenes, problem.pre)
        codes = jnp.asarray([CODE[name] for name in UNUSABLE])
        bad = jnp.any(out.status[:, None] == codes[None, :], axis=1)
        error = jnp.where(bad[:, None], PENALTY * problem.unit, out.velocity - problem.post)
        residual = (error * problem.weight).reshape(-1)
        return residual, (residual, out.velocity, out.status)

    jacobian, (residual, velocity, status) = jax.jacfwd(outcome, has_aux=True)(y)
    return residual, jacobian, (velocity, status)


@eqx.filter_jit
def begin_all(problem: Problem, starts: jax.Array, method: Method, max_steps: int) -> State:
    """States of a batch of starts y (S, P)."""
    shots, bodies = problem.pre.shape

    def one(y: jax.Array) -> State:
        velocity, status = jnp.zeros_like(problem.pre), jnp.zeros(shots, jnp.int32)
        residual = jnp.zeros(shots * bodies, y.dtype)
        jacobian = jnp.zeros((shots * bodies, y.shape[0]), y.dtype)
        return begin(y, (residual, jacobian, (velocity, status)), method, max_steps)

    return jax.vmap(one)(starts)


@eqx.filter_jit
def advance_all(
    problem: Problem, states: State, method: Method, max_steps: int, passes: int
) -> State:
    """Up to `passes` passes more of every start."""

    def one(state: State) -> State:
        return advance(
            lambda y: _evaluate(problem, y),
            problem.low,
            problem.high,
            method,
            max_steps,
            state,
            passes,
        )

    return jax.vmap(one)(states)
