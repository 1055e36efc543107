"""Nonlinear least squares in a region: Levenberg-Marquardt, or gradient descent with optax.

Minimize `|r(y)|^2 / 2` for y in a `Region`, mostly the `BoxRegion` `low <= y <= high`. Steps are
cut at the box, and a variable on a bound whose gradient points outward is left out of the step, so
minima on a bound are found exactly. (Smooth maps of the box onto the real line put them at
infinity: Levenberg-Marquardt then still crawled after 100 steps, every start ending elsewhere.) One
pass evaluates residual and Jacobian together once, so that the impact is compiled once; a solve can
be continued.
"""

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp

if TYPE_CHECKING:
    import optax  # which takes long to import

# y (P,) -> residual (R,), Jacobian (R, P), anything else to keep of the best point
Evaluate = Callable[[jax.Array], tuple[jax.Array, jax.Array, Any]]
Method: TypeAlias = "str | optax.GradientTransformation"

# Steps of one start before the solver gives up: more only costs time.
DEFAULT_STEPS = {"levenberg-marquardt": 100, "lbfgs": 100, "adam": 500, "sgd": 1000}

# Done when an undamped Gauss-Newton step promises less than this share of the sum of squares:
# the distance to the minimum is then its root, a hundred-thousandth of the standard error.
STOP_GAIN = {"float64": 1e-10, "float32": 1e-6}
# ... or less than this: residuals are of order 1, and impacts are good to 1e-8 (1e-5).
STOP_EXACT = {"float64": 1e-18, "float32": 1e-11}

_DAMPING = 1e-2  # first Levenberg-Marquardt damping, relative to the curvatures
# Nielsen (1999): the damping falls by this factor at most after a step that gains what it promised,
# and grows by a factor that doubles with each step that does not.
_LEAST_FACTOR, _FIRST_GROWTH = 1 / 3, 2.0
_LEAST = {"float64": 1e-10, "float32": 1e-5}  # smallest damping: keeps the matrix positive
_STUCK = 1e6  # above this damping a kink of the law lets nothing pass
_FLAT = 1e-10  # curvatures below this share of the largest are damped as if they had it
_ADAM_RATE, _SGD_RATE, _SGD_MOMENTUM = 0.1, 0.3, 0.9  # in y, where ranges are of order 1


class Region(Protocol):
    """A convex set of y, as far as the methods need it."""

    def retract(self, y: jax.Array) -> jax.Array:
        """y itself, or a point of the region near it."""

    def nearest(self, y: jax.Array) -> jax.Array:
        """The point of the region nearest to y."""

    def free_gradient(self, y: jax.Array, gradient: jax.Array) -> jax.Array:
        """The gradient without what would push y out of the region."""

    def step(
        self, y: jax.Array, residual: jax.Array, jacobian: jax.Array, damping: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Damped Gauss-Newton step inside the region, and the decrease it promises."""


class BoxRegion(eqx.Module):
    """The region `low <= y <= high`."""

    low: jax.Array
    high: jax.Array

    def retract(self, y: jax.Array) -> jax.Array:
        """The nearest point of the box."""
        return jnp.clip(y, self.low, self.high)

    def nearest(self, y: jax.Array) -> jax.Array:
        """The same."""
        return self.retract(y)

    def free_gradient(self, y: jax.Array, gradient: jax.Array) -> jax.Array:
        """The gradient without variables that sit on a bound and are pushed against it."""
        pushed = ((y <= self.low) & (gradient > 0)) | ((y >= self.high) & (gradient < 0))
        return jnp.where(pushed, 0.0, gradient)

    def step(
        self, y: jax.Array, residual: jax.Array, jacobian: jax.Array, damping: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Damped Gauss-Newton step of the free variables, and the decrease it promises."""
        gradient = jacobian.T @ residual
        pushed = (self.free_gradient(y, gradient) == 0) & (gradient != 0)
        jacobian = jnp.where(pushed[None, :], 0.0, jacobian)
        gradient = jnp.where(pushed, 0.0, gradient)
        hessian = jacobian.T @ jacobian
        curvature = jnp.diagonal(hessian)
        largest = jnp.max(curvature)
        curvature = jnp.maximum(curvature, jnp.where(largest > 0, _FLAT * largest, 1.0))
        factor = jax.scipy.linalg.cho_factor(hessian + jnp.diag(damping * curvature))
        move = -jax.scipy.linalg.cho_solve(factor, gradient)
        return move, -(gradient @ move) - 0.5 * jnp.sum((jacobian @ move) ** 2)


class SolverState(eqx.Module):
    """The best point so far, what the next pass tries, and the method's memory."""

    y: jax.Array
    residual: jax.Array
    jacobian: jax.Array
    aux: Any
    cost: jax.Array
    gain: jax.Array  # what a Gauss-Newton step from the best point still promises
    trial: jax.Array
    memory: Any
    steps: jax.Array
    done: jax.Array


class Damping(NamedTuple):
    """The damping of Levenberg-Marquardt, its next growth, and what the last step promised."""

    value: jax.Array
    growth: jax.Array
    promised: jax.Array

    def after(self, gain: jax.Array) -> "Damping":
        """Nielsen's rule after a step that gained so much.

        Equation: `value max(1/3, 1 - (2 gain / promised - 1)^3)` after a gain, else
        `value growth`, and the growth doubles.
        """
        better = gain > 0
        ratio = jnp.where(jnp.isfinite(gain), gain / self.promised, 1.0)
        less = jnp.maximum(_LEAST_FACTOR, 1 - (2 * ratio - 1) ** 3)
        floor = _LEAST[str(self.value.dtype)]
        value = jnp.maximum(self.value * jnp.where(better, less, self.growth), floor)
        return Damping(value, jnp.where(better, _FIRST_GROWTH, 2 * self.growth), self.promised)


def check_method(method: Any) -> None:
    """Raise a ValueError unless `method` is a known name or an optax transformation."""
    if isinstance(method, str) and method in DEFAULT_STEPS:
        return
    import optax

    if not isinstance(method, optax.GradientTransformation):
        raise ValueError(
            f"Argument `method` must be one of {', '.join(map(repr, DEFAULT_STEPS))} or an "
            f"optax.GradientTransformation, but has value {method!r}."
        )


def default_steps(method: Method) -> int:
    """Step limit where the user gives none."""
    return DEFAULT_STEPS[method if isinstance(method, str) else "adam"]


def begin(y: jax.Array, first: tuple[Any, Any, Any], method: Method, max_steps: int) -> SolverState:
    """State before the first pass from y (P,); `first` is shaped like what `evaluate` returns."""
    infinite = jnp.asarray(jnp.inf, y.dtype)
    if method == "levenberg-marquardt":
        memory: Any = Damping(*jnp.asarray([_DAMPING, _FIRST_GROWTH, jnp.inf], y.dtype))
    else:
        memory = _transformation(method, max_steps).init(y)
    steps, done = jnp.asarray(0), jnp.asarray(False)
    return SolverState(y, *first, infinite, infinite, y, memory, steps, done)


def advance(
    evaluate: Evaluate,
    region: Region,
    method: Method,
    max_steps: int,
    state: SolverState,
    passes: int,
) -> SolverState:
    """Up to `passes` passes more, fewer if done or at the step limit."""
    last = jnp.minimum(state.steps + passes, max_steps)

    def one(state: SolverState) -> SolverState:
        """One pass."""
        residual, jacobian, aux = evaluate(state.trial)
        cost = 0.5 * jnp.sum(residual**2)
        better = cost < state.cost
        here = (state.trial, residual, jacobian, aux, cost)
        best = (state.y, state.residual, state.jacobian, state.aux, state.cost)
        best = jax.tree.map(lambda a, b: jnp.where(better, a, b), here, best)
        y, r, jac, aux, least = best
        floor = jnp.asarray(_LEAST[str(y.dtype)], y.dtype)
        if method == "levenberg-marquardt":
            memory = state.memory.after(state.cost - cost)
            step = partial(region.step, y, r, jac)
            moves, gains = jax.vmap(step)(jnp.stack([floor, memory.value]))  # compiled once
            gain, trial = gains[0], region.retract(y + moves[1])
            change = jac @ (trial - y)
            memory = memory._replace(promised=-(r @ change) - 0.5 * jnp.sum(change**2))
            stuck = memory.value > _STUCK
        else:
            gain = region.step(y, r, jac, floor)[1]
            gradient = region.free_gradient(state.trial, jacobian.T @ residual)
            # optax itself mixes integers and floats: it needs the standard promotion
            with jax.numpy_dtype_promotion("standard"):
                move, memory = _transformation(method, max_steps).update(
                    gradient,
                    state.memory,
                    state.trial,
                    value=cost,
                    grad=gradient,
                    value_fn=lambda y: _cost(evaluate, region.retract(y)),
                )
            trial = region.retract(state.trial + move)
            stuck = jnp.asarray(False)
        dtype = str(y.dtype)
        done = stuck | (gain <= STOP_GAIN[dtype] * least + STOP_EXACT[dtype])
        return SolverState(y, r, jac, aux, least, gain, trial, memory, state.steps + 1, done)

    return jax.lax.while_loop(lambda s: ~s.done & (s.steps < last), one, state)


def nearest(region: Region, y: jax.Array) -> jax.Array:
    """The point of a region nearest to y: least squares of the distance."""
    identity, method = jnp.eye(y.shape[0], dtype=y.dtype), "levenberg-marquardt"
    steps = DEFAULT_STEPS[method]

    def distance(at: jax.Array) -> tuple[jax.Array, jax.Array, tuple[()]]:
        """From y, and its Jacobian."""
        return at - y, identity, ()

    state = begin(region.retract(y), (y, identity, ()), method, steps)
    return advance(distance, region, method, steps, state, steps).y


def _cost(evaluate: Evaluate, y: jax.Array) -> jax.Array:
    """`|r|^2 / 2`, its derivative taken from the Jacobian that `evaluate` gives (line searches)."""

    @jax.custom_jvp
    def cost(y: jax.Array) -> jax.Array:
        """Half the sum of squares."""
        return 0.5 * jnp.sum(evaluate(y)[0] ** 2)

    @cost.defjvp
    def _rule(primals: Any, tangents: Any) -> tuple[jax.Array, jax.Array]:
        """The derivative by the Jacobian."""
        residual, jacobian, _ = evaluate(primals[0])
        return 0.5 * jnp.sum(residual**2), (jacobian.T @ residual) @ tangents[0]

    return cost(y)


def _transformation(method: Method, max_steps: int) -> "optax.GradientTransformationExtraArgs":
    """The optax transformation of a method."""
    import optax

    if method == "adam":
        method = optax.adam(optax.cosine_decay_schedule(_ADAM_RATE, max_steps))
    elif method == "sgd":
        method = optax.sgd(_SGD_RATE, momentum=_SGD_MOMENTUM)
    elif method == "lbfgs":
        method = optax.lbfgs()
    return optax.with_extra_args_support(method)
