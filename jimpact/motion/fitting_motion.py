"""Parameters of a law from a measured motion."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import as_float_array, as_whole, check_values
from jimpact.fits.least_squares import Box, SolverState, advance, begin
from jimpact.fits.parameters import (
    Parameters,
    bounds_of,
    entries,
    free_parameters,
    with_entries as law_with,
)
from jimpact.fits.uncertainty import RANK_TOLERANCE, uncertainty
from jimpact.law import Law
from jimpact.motion.record import MOTION_STATUS, Motion
from jimpact.motion.simulate import simulate
from jimpact.motion.system import System

Observe = Callable[[Motion], jax.Array]

MAX_PASSES = 50
_PENALTY = 1e3  # times the largest measured value: residual of a motion that fails
_FAILS = tuple(row.failure for row in MOTION_STATUS)


@dataclass(frozen=True, eq=False)
class MotionFit:
    """What `fit_motion` found; `print(fit)` is a report.

    `standard_error` is inf for parameters that the record does not determine (`unseen` says
    which combinations); `degrees_of_freedom` is measured values less `rank`; `noise` is the
    estimated error of the measurement, or 1 with `sigma`.
    """

    law: Law
    names: tuple[str, ...]
    value: np.ndarray
    standard_error: np.ndarray
    covariance: np.ndarray
    rank: int
    degrees_of_freedom: int
    unseen: tuple[str, ...]
    noise: float
    predicted: np.ndarray
    residual: np.ndarray
    steps: int
    converged: bool

    def __str__(self) -> str:
        rows = [
            f"  {name} = {value:.6g} +- {error:.2g}"
            for name, value, error in zip(self.names, self.value, self.standard_error, strict=True)
        ]
        head = f"{type(self.law).__name__} fitted to a motion in {self.steps} passes"
        end = "" if self.converged else ", not converged"
        rms = float(np.sqrt(np.nanmean(self.residual**2)))
        return "\n".join([head + end, *rows, f"  rms residual {rms:.3g}", *self.unseen])


class _Problem(eqx.Module):
    system: System
    law: Law
    arguments: dict[str, Any]
    observe: Observe
    measured: jax.Array  # 0 where not measured
    weight: jax.Array  # 0 where not measured
    offset: jax.Array  # of all entries, scaled
    scale: jax.Array
    groups: jax.Array  # (Q, P)
    log: jax.Array  # (Q,)
    fields: tuple[str, ...] = eqx.field(static=True)


def fit_motion(
    system: System,
    law: Law,
    measured: Any,
    q0: Any,
    v0: Any,
    t_end: Any,
    free: Any = ("restitution",),
    *,
    sigma: Any = None,
    bounds: Mapping[str, Any] | None = None,
    observe: Observe | None = None,
    max_passes: int = MAX_PASSES,
    **options: Any,
) -> MotionFit:
    """The parameters of `law` with which `simulate` comes nearest to a measured motion.

    Equation: `min sum ((observe(motion) - measured) / sigma)^2` by Levenberg-Marquardt, with the
    exact derivatives of the simulated motion, event times included: forward ones, which cost less
    than reverse ones as long as parameters are fewer than residuals.

    Args:
        system: as in `simulate`.
        law: with start values; near enough that the events come in the right order (a record of
            many impacts has many minima: fit its beginning first).
        measured: positions (S, n) at S equal times from t_start to t_end, or what `observe`
            gives; NaN where nothing was measured.
        q0: (n,) at the start.
        v0: (n,) at the start.
        t_end: [s].
        free: names of the law's parameters, or a mapping to masks over contacts, as in `fit`.
        sigma: standard errors of the measurement, scalar or shaped like it; None: estimated.
        bounds: field -> (low, high).
        observe: Motion -> array; None: the positions. E.g. `lambda m: m.events.time[:10]`.
        max_passes: of the solver.
        options: of `simulate`; `samples` follows from `measured` where `observe` is None.

    Raises:
        ValueError: shapes, unknown parameters, nothing measured.

    >>> import jimpact as ji
    >>> ball = ji.ball_system()
    >>> seen = ji.simulate(ball, ji.Newton(0.8), [1.0], [0.0], 1.5, samples=16).q
    >>> found = ji.fit_motion(ball, ji.Newton(0.7), seen, [1.0], [0.0], 1.5)
    >>> round(float(found.value[0]), 8)
    0.8
    """
    record = np.asarray(measured, float)
    if observe is None:
        if record.ndim != 2 or record.shape[1] != np.shape(q0)[0]:
            raise ValueError(
                f"Argument `measured` must have shape (S, {np.shape(q0)[0]}), "
                f"but has shape {record.shape}."
            )
        options = {"samples": record.shape[0]} | options
    check_values("measured", record, nan_allowed=True)
    as_whole("max_passes", max_passes, 1)
    here = np.isfinite(record)
    if not here.any():
        raise ValueError("Argument `measured` must have at least one value that is not NaN.")
    errors = np.broadcast_to(1.0 if sigma is None else np.asarray(sigma, float), record.shape)
    check_values("sigma", errors, low=0.0, open_low=True)
    contacts = jax.eval_shape(system.body.gap_function, as_float_array("q0", q0)).shape
    parameters, _ = free_parameters(law, contacts[0] if contacts else 1, free)
    limits = bounds_of(parameters, law, bounds)
    arguments = {"q0": q0, "v0": v0, "t_end": t_end} | options
    weight = np.where(here, 1 / errors, 0.0)
    given = (np.nan_to_num(record), weight / np.linalg.norm(weight))
    problem, y, box = _problem(
        system, law, arguments, observe or _positions, given, parameters, limits
    )
    state = _solve(problem, box, y, max_passes)
    size = float(np.linalg.norm(weight))
    return _report(problem, state, parameters, here, size, sigma is not None)


def _positions(motion: Motion) -> jax.Array:
    return motion.q


def _problem(
    system: System,
    law: Law,
    arguments: dict[str, Any],
    observe: Observe,
    given: tuple[np.ndarray, np.ndarray],
    parameters: Parameters,
    limits: tuple[np.ndarray, np.ndarray],
) -> tuple[_Problem, jax.Array, Box]:
    """The problem, its start and its box in scaled parameters."""
    values = entries(law, parameters.fields)
    log = parameters.log
    scale = np.where(log, 1.0, np.maximum(np.abs(values), 1.0))
    scaled = np.where(log, np.log(np.where(log, values, 1.0)), values / scale)
    groups = np.zeros((len(values), len(parameters.names)))
    offset = scaled.copy()
    for i, members in enumerate(parameters.groups):
        groups[list(members), i], offset[list(members)] = 1.0, 0.0
    first = parameters.first
    with np.errstate(divide="ignore", invalid="ignore"):
        low, high = (np.where(log[first], np.log(x), x / scale[first]) for x in limits)
    problem = _Problem(  # type: ignore[call-arg]
        system,
        law,
        arguments,
        observe,
        *(jnp.asarray(x) for x in (*given, offset, scale, groups, log)),  # type: ignore[arg-type]
        parameters.fields,
    )
    return problem, jnp.asarray(scaled[first]), Box(jnp.asarray(low), jnp.asarray(high))


def _values(problem: _Problem, y: jax.Array) -> jax.Array:
    """All entries (Q,) of the free fields."""
    scaled = problem.offset + problem.groups @ y
    exponential = jnp.exp(jnp.where(problem.log, scaled, 0.0))
    return jnp.where(problem.log, exponential, scaled * problem.scale)


def _evaluate(problem: _Problem, y: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Weighted residual (R,), Jacobian (R, P), what was observed."""

    def outcome(y: jax.Array) -> tuple[jax.Array, Any]:
        law = law_with(problem.law, problem.fields, _values(problem, y))
        motion = simulate(problem.system, law, **problem.arguments)
        seen = problem.observe(motion)
        bad = jnp.asarray(_FAILS)[motion.status] | ~jnp.isfinite(seen)
        penalty = _PENALTY * jnp.abs(problem.measured).max()
        error = jnp.where(bad, penalty, jnp.where(bad, 0.0, seen) - problem.measured)
        residual = (error * problem.weight).reshape(-1)
        return residual, (residual, seen)

    jacobian, (residual, seen) = jax.jacfwd(outcome, has_aux=True)(y)
    return residual, jacobian, seen


@eqx.filter_jit
def _solve(problem: _Problem, box: Box, y: jax.Array, passes: int) -> SolverState:
    def evaluate(y: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        return _evaluate(problem, y)

    blank = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(evaluate, y))
    method = "levenberg-marquardt"
    start = begin(box.retract(y), blank, method, passes)
    return advance(evaluate, box, method, passes, start, passes)


def _report(
    problem: _Problem,
    state: SolverState,
    parameters: Parameters,
    here: np.ndarray,
    size: float,
    noise_is_known: bool,
) -> MotionFit:
    y = np.asarray(state.y)
    first = parameters.first
    values = np.asarray(_values(problem, state.y))
    log = np.asarray(problem.log)[first]
    # a change of a parameter for one of y
    slope = np.where(log, values[first], np.asarray(problem.scale)[first])
    jacobian = size * np.asarray(state.jacobian)
    lines = uncertainty(
        parameters.names,
        jacobian,
        slope,
        log,
        float(np.sum((size * np.asarray(state.residual)) ** 2)),
        int(here.sum()),
        noise_is_known,
        RANK_TOLERANCE[str(y.dtype)],
    )
    predicted = np.asarray(state.kept)
    return MotionFit(
        law=law_with(problem.law, problem.fields, jnp.asarray(values)),
        names=parameters.names,
        value=values[first],
        standard_error=lines.standard_error,
        covariance=lines.covariance,
        rank=lines.rank,
        degrees_of_freedom=int(here.sum()) - lines.rank,
        unseen=tuple(s.replace("measured velocity", "measured value") for s in lines.unseen),
        noise=lines.noise,
        predicted=predicted,
        residual=np.where(here, predicted - np.asarray(problem.measured), np.nan),
        steps=int(state.steps),
        converged=bool(state.done),
    )
