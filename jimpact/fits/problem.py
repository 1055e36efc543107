"""The least-squares problem of a fit: residuals of a law in scaled parameters, as arrays."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact.compiling import quick_jit
from jimpact.experiments import Experiments
from jimpact.fits.least_squares import Box, Method, Region, SolverState, advance, begin
from jimpact.fits.matrix_fit import matrix_region
from jimpact.fits.parameters import Parameters, entries, with_entries
from jimpact.impacts import impact
from jimpact.law import Law
from jimpact.scene import Scene, dense_mass, stackable
from jimpact.status import CODE

# Outcomes whose velocities mean nothing. A trial that meets one gets a residual far above any
# honest one, so that a solver turns back; inadmissible or energetic outcomes are only reported.
UNUSABLE = ("infeasible", "max_steps", "not_finite")
PENALTY = 1e3  # times the largest velocity


class FitProblem(eqx.Module):
    """Law, shots and box of one fit: a pytree that compiled functions take as argument.

    Solvers work on y (Q,), of which the first P count, the rest is 0. The entries of the law's
    fields in scaled form are `offset + mix y`; an entry is `scale` times that, or its exponential
    where `log` is set.
    """

    law: Law
    mix: jax.Array
    offset: jax.Array
    scale: jax.Array
    log: jax.Array
    low: jax.Array  # bounds of y
    high: jax.Array
    region: Region  # where y may lie: the box, or a part of it
    scenes: Scene  # one, or stacked one a shot
    pre: jax.Array  # (K, n), further columns where scenes were made alike
    post: jax.Array  # 0 where not measured
    weight: jax.Array  # 0 where not measured; makes |r|^2 a mean square relative to `unit`
    size: jax.Array  # () size r is (v+ - measured) / sigma, with sigma = 1 m/s where unknown
    unit: jax.Array  # () the largest velocity [m/s]
    fields: tuple[str, ...] = eqx.field(static=True)
    scene_per_shot: bool = eqx.field(static=True)


def build_problem(
    law: Law,
    scene: Scene | None,
    experiments: Experiments,
    parameters: Parameters,
    limits: tuple[np.ndarray, np.ndarray],
) -> FitProblem:
    """Arrays, weights and natural scales of a fit."""
    own = [experiments.scene_of(scene, k) for k in range(len(experiments.shots))]
    per_shot = experiments.scenes is not None
    leaves = jax.tree.leaves((law, own, experiments.pre))
    dtype = np.result_type(*(x.dtype for x in leaves if eqx.is_inexact_array(x)))
    own, extra = stackable(own)
    law, *own = jax.tree.map(
        lambda x: x.astype(dtype) if eqx.is_inexact_array(x) else x, (law, *own)
    )
    pre, post = np.asarray(experiments.pre), np.nan_to_num(np.asarray(experiments.post))
    unit = max(np.abs(pre).max(), np.abs(post).max()) or 1.0
    sigma = np.ones_like(post) if experiments.sigma is None else np.asarray(experiments.sigma)
    weight = np.where(experiments.measured, 1 / sigma, 0.0)
    size = unit * np.linalg.norm(weight)
    n = pre.shape[1]
    energy = max(0.5 * v @ dense_mass(s)[:n, :n] @ v for s, v in zip(own, pre)) or 1.0
    pre = np.pad(pre, ((0, 0), (0, extra)), constant_values=unit)
    values = entries(law, parameters.fields)
    scale, log = _scales(parameters, values, energy)
    offset, mix = to_scaled(values, scale, log), np.zeros((len(values), len(values)))
    for i, group in enumerate(parameters.groups):
        mix[list(group), i], offset[list(group)] = 1.0, 0.0
    bounds = np.zeros((2, len(values)))
    first, count = parameters.first, len(parameters.names)
    bounds[:, :count] = [to_scaled(end, scale[first], log[first]) for end in limits]
    arrays = {"mix": mix, "offset": offset, "scale": scale, "low": bounds[0], "high": bounds[1]}
    arrays |= {"pre": pre, "post": post, "weight": weight / size, "size": size, "unit": unit}
    shown = own if per_shot else own[:1]
    region = matrix_region(law, shown, scale * offset, scale[:, None] * mix, bounds)
    return FitProblem(
        law=law,
        region=region or Box(*(jnp.asarray(end, dtype) for end in bounds)),
        log=jnp.asarray(log),
        scenes=jax.tree.map(lambda *x: jnp.stack(x), *own) if per_shot else own[0],
        fields=parameters.fields,
        scene_per_shot=per_shot,
        **{name: jnp.asarray(array, dtype) for name, array in arrays.items()},
    )


def _scales(
    parameters: Parameters, values: np.ndarray, energy: float
) -> tuple[np.ndarray, np.ndarray]:
    """Of each entry: the size of a change of order 1 (or 1, where fitted in its logarithm), log."""
    log = parameters.log
    of_energy = np.array([field == "initial_energy" for field in parameters.entry_fields])
    scale = np.where(of_energy, energy, np.maximum(np.abs(values), 1.0))
    return np.where(log, 1.0, scale), log


def to_scaled(values: np.ndarray, scale: np.ndarray, log: np.ndarray) -> np.ndarray:
    """Scaled form of entries, on the host."""
    with np.errstate(divide="ignore"):
        return np.where(log, np.log(np.where(log, values, 1.0)), values / scale)


def from_scaled(scaled: np.ndarray, scale: np.ndarray, log: np.ndarray) -> np.ndarray:
    """Entries of their scaled form, on the host."""
    return np.where(log, np.exp(np.where(log, scaled, 0.0)), scaled * scale)


def _evaluate(problem: FitProblem, y: jax.Array) -> tuple[jax.Array, jax.Array, Any]:
    """Weighted residual (K n,), its Jacobian (K n, Q), and v+ (K, n), status (K,)."""

    def outcome(y: jax.Array) -> tuple[jax.Array, Any]:
        scaled = problem.offset + problem.mix @ y
        exponential = jnp.exp(jnp.where(problem.log, scaled, 0.0))
        values = jnp.where(problem.log, exponential, scaled * problem.scale)
        law = with_entries(problem.law, problem.fields, values)
        axes = (None, 0 if problem.scene_per_shot else None, 0)
        out = jax.vmap(impact, in_axes=axes)(law, problem.scenes, problem.pre)
        velocity = out.velocity[:, : problem.post.shape[1]]
        codes = jnp.asarray([CODE[name] for name in UNUSABLE], out.status.dtype)
        bad = jnp.any(out.status[:, None] == codes[None, :], axis=1)
        error = jnp.where(bad[:, None], PENALTY * problem.unit, velocity - problem.post)
        residual = (error * problem.weight).reshape(-1)
        return residual, (residual, velocity, out.status)

    jacobian, (residual, velocity, status) = jax.jacfwd(outcome, has_aux=True)(y)
    return residual, jacobian, (velocity, status)


@quick_jit
def begin_all(
    problem: FitProblem, starts: jax.Array, method: Method, max_steps: int
) -> SolverState:
    """States of a batch of starts y (S, Q)."""
    shots, bodies = problem.post.shape

    def one(y: jax.Array) -> SolverState:
        y = problem.region.retract(y)
        velocity, status = jnp.zeros_like(problem.post), jnp.zeros(shots, jnp.int32)
        residual = jnp.zeros(shots * bodies, y.dtype)
        jacobian = jnp.zeros((shots * bodies, y.shape[0]), y.dtype)
        return begin(y, (residual, jacobian, (velocity, status)), method, max_steps)

    return jax.vmap(one)(starts)


@quick_jit
def advance_all(
    problem: FitProblem, states: SolverState, method: Method, max_steps: int, passes: int
) -> SolverState:
    """Up to `passes` passes more of every start."""

    def one(state: SolverState) -> SolverState:
        return advance(
            lambda y: _evaluate(problem, y),
            problem.region,
            method,
            max_steps,
            state,
            passes,
        )

    return jax.vmap(one)(states)
