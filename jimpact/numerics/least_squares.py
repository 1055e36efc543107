"""Nonlinear least squares from several starts at once: Levenberg-Marquardt or gradient descent.

The caller evaluates residual and Jacobian together, forward mode. Solvers see a function whose
derivative rule is that Jacobian: an impact is traced and compiled once, whatever the solver asks.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
import optimistix as optx

Evaluate = Callable[[jax.Array, Any], tuple[jax.Array, jax.Array]]
Method = str | optax.GradientTransformation

DEFAULT_STEPS = {"levenberg-marquardt": 100, "lbfgs": 100, "adam": 600, "sgd": 2000}

# Relative change of parameters and residual at which a solver stops: a hundredth of what the
# derivatives of an impact are worth, so that stopping adds no error of its own.
STOP = {"float64": 1e-9, "float32": 1e-4}

_ADAM_RATE = 0.1  # in z, where an interval is a few units long
_SGD_RATE = 0.3


def check_method(method: Any) -> None:
    """Raise a ValueError unless `method` is a known name or an optax transformation."""
    if not isinstance(method, optax.GradientTransformation) and method not in DEFAULT_STEPS:
        raise ValueError(
            f"Argument `method` must be one of {', '.join(map(repr, DEFAULT_STEPS))} or an "
            f"optax.GradientTransformation, but has value {method!r}."
        )


def default_steps(method: Method) -> int:
    """Step limit where the user gives none."""
    return DEFAULT_STEPS[method if isinstance(method, str) else "adam"]


def minimize(
    evaluate: Evaluate, z: jax.Array, args: Any, method: Method, max_steps: int
) -> tuple[jax.Array, jax.Array]:
    """Minimize `|r(z, args)|^2` from one start z (P,); returns the best z and the steps taken."""

    @jax.custom_jvp
    def residual(z: jax.Array, args: Any) -> jax.Array:
        return evaluate(z, args)[0]

    @residual.defjvp
    def _rule(primals: Any, tangents: Any) -> tuple[jax.Array, jax.Array]:
        value, jacobian = evaluate(*primals)
        return value, jacobian @ tangents[0]

    stop = STOP[str(z.dtype)]
    if method == "levenberg-marquardt":
        solver = optx.LevenbergMarquardt(rtol=stop, atol=stop)
        found = optx.least_squares(residual, solver, z, args, max_steps=max_steps, throw=False)
    else:
        descent = _transformation(method, max_steps)
        solver = optx.BestSoFarMinimiser(optx.OptaxMinimiser(descent, rtol=stop, atol=stop))
        found = optx.minimise(
            lambda z, args: 0.5 * jnp.sum(residual(z, args) ** 2),
            solver,
            z,
            args,
            max_steps=max_steps,
            throw=False,
        )
    return found.value, found.stats["num_steps"]


def _transformation(method: Method, max_steps: int) -> optax.GradientTransformation:
    if method == "adam":
        return optax.adam(optax.cosine_decay_schedule(_ADAM_RATE, max_steps))
    if method == "sgd":
        return optax.sgd(_SGD_RATE, momentum=0.9)
    if method == "lbfgs":
        return optax.lbfgs()
    return method
