"""Nonlinear least squares in a region, from many starts or of many problems at once.

Minimize `|r(y)|^2 / 2` for y in a `Region`, mostly the `BoxRegion` `low <= y <= high`, by
Levenberg-Marquardt or by gradient descent with optax. Steps are cut at the box, and a variable on a
bound whose gradient points outward is left out of the step, so minima on a bound are found exactly.
One pass evaluates residual and Jacobian together, so that an impact is compiled once.
"""

import time
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact.compiling import full_precision, quick_jit
from jimpact.progress import Show

if TYPE_CHECKING:
    import optax  # which takes long to import

# y (P,) -> residual (R,), Jacobian (R, P), anything else to keep of the best point
Evaluate = Callable[[jax.Array], tuple[jax.Array, jax.Array, Any]]
Method: TypeAlias = "str | optax.GradientTransformation"

# Steps of one start before the solver gives up: more only costs time.
DEFAULT_STEPS = {"levenberg-marquardt": 100, "lbfgs": 100, "adam": 500, "sgd": 1000}

# What an undamped Gauss-Newton step still promises, in variances of one residual (|r|^2 / R): the
# distance to the minimum is its root, in standard errors. A solve is done at FINE, or at ROUNDING
# where no lower point is found: sums of squares are right to so much; one of many starts at COARSE,
# which is enough to tell minima apart; and the answer stands below CONVERGED, a tenth of a
# standard error.
FINE = {"float64": 1e-17, "float32": 1e-4}
ROUNDING = {"float64": 1e-7, "float32": 1e-3}
COARSE, CONVERGED = 1e-3, 1e-2
DESCENDED = 1e-6  # the same for gradient descent, which has no step that would make up for it
# ... or less than this: residuals are of order 1, and impacts are good to 1e-8 (1e-5), which
# counts where no lower point is found.
STOP_EXACT = {"float64": 1e-24, "float32": 1e-12}
ROUNDING_EXACT = {"float64": 1e-18, "float32": 1e-11}
# Mean squares (relative to the velocities) below this are a perfect fit: rounding and the
# tolerance of the impact.
EXACT = {"float64": 1e-14, "float32": 1e-8}

_DAMPING = 1e-2  # first Levenberg-Marquardt damping, relative to the curvatures
# Nielsen (1999): the damping falls by this factor at most after a step that gains what it promised,
# and grows by a factor that doubles with each step that does not.
_LEAST_FACTOR, _FIRST_GROWTH = 1 / 3, 2.0
_LEAST = {"float64": 1e-10, "float32": 1e-5}  # smallest damping: keeps the matrix positive
_STUCK = 1e6  # above this damping no step, however small, lowers the sum of squares
_SHORT = 10.0  # damping from which on steps shorten, perhaps towards a kink that is the minimum
_FLAT = 1e-10  # curvatures below this share of the largest are damped as if they had it
_ADAM_RATE, _SGD_RATE, _SGD_MOMENTUM = 0.1, 0.3, 0.9  # in y, where ranges are of order 1

PASSES = 4  # of a program, between two looks at the clock
# A solve that lowers its sum of squares by less than this share in PASSES passes, although its
# derivatives promise more, creeps along a kink of the law, where the sequence of contacts changes,
# and is given up; one of several starts sooner, and the more if it is BEHIND times above the best.
CREEPS, START_CREEPS, BEHIND, FALLS = 1e-3, 0.01, 10.0, 0.5


def quiet(step: str, done: float, total: float | None) -> None:
    """No progress is shown."""


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
    stuck: jax.Array  # no step lowers the cost

    @property
    def squares(self) -> np.ndarray:
        """`|r|^2` at the best points (S,), on the host."""
        return 2 * np.asarray(self.cost, float)

    @property
    def converged(self) -> np.ndarray:
        """Which of the points (S,) are so close to a minimum that they stand, on the host."""
        promised, squares = 2 * np.asarray(self.gain, float), self.squares
        enough = CONVERGED if isinstance(self.memory, Damping) else DESCENDED
        small = promised <= enough * squares / self.residual.shape[-1]
        return small | (squares <= EXACT[str(self.y.dtype)]) | np.asarray(self.stuck)


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


def begin(y: Any, first: tuple[Any, Any, Any], method: Method, max_steps: int) -> SolverState:
    """States before the first pass from y (S, P); `first`: arrays like what `evaluate` returns."""
    count, dtype = len(y), y.dtype

    def all_are(value: Any, dtype: Any = dtype) -> Any:
        """The value of every state."""
        return np.full(count, value, dtype)

    if method == "levenberg-marquardt":
        memory: Any = Damping(*map(all_are, (_DAMPING, _FIRST_GROWTH, np.inf)))
    else:
        memory = jax.device_get(jax.vmap(_transformation(method, max_steps).init)(y))
    costs = all_are(np.inf), all_are(np.inf)
    ends = all_are(0, int), all_are(False, bool), all_are(False, bool)
    # copies: states are written in place
    return jax.tree.map(np.array, SolverState(y, *first, *costs, y, memory, *ends))


def advance(
    evaluate: Evaluate,
    region: Region,
    method: Method,
    max_steps: int,
    state: SolverState,
    passes: int,
    stop: Any,
) -> SolverState:
    """Up to `passes` passes more, fewer if done or at the step limit; `stop`: see `FINE`."""
    last = jnp.minimum(state.steps + passes, max_steps)
    state = eqx.tree_at(lambda s: s.trial, state, region.retract(state.trial))

    def one(state: SolverState) -> SolverState:
        """One pass."""
        residual, jacobian, aux = evaluate(state.trial)
        cost = 0.5 * jnp.sum(residual**2)
        better = cost < state.cost
        here = (state.trial, residual, jacobian, aux, cost)
        best = (state.y, state.residual, state.jacobian, state.aux, state.cost)
        best = jax.tree.map(lambda a, b: jnp.where(better, a, b), here, best)
        y, r, jac, aux, least = best
        dtype = str(y.dtype)
        floor = jnp.asarray(_LEAST[dtype], y.dtype)
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
        finest = stop * least / residual.shape[0] + STOP_EXACT[dtype]
        rounding = ROUNDING[dtype] * least / residual.shape[0] + ROUNDING_EXACT[dtype]
        small = gain <= jnp.where(better, finest, jnp.maximum(finest, rounding))
        return SolverState(
            y, r, jac, aux, least, gain, trial, memory, state.steps + 1, small | stuck, stuck
        )

    return jax.lax.while_loop(lambda s: ~s.done & (s.steps < last), one, state)


@full_precision
def nearest(region: Region, y: jax.Array) -> jax.Array:
    """The point of a region nearest to y: least squares of the distance."""
    identity, method = jnp.eye(y.shape[0], dtype=y.dtype), "levenberg-marquardt"
    steps = DEFAULT_STEPS[method]

    def distance(at: jax.Array) -> tuple[jax.Array, jax.Array, tuple[()]]:
        """From y, and its Jacobian."""
        return at - y, identity, ()

    infinite, no = jnp.asarray(jnp.inf, y.dtype), jnp.asarray(False)
    memory = Damping(*jnp.asarray([_DAMPING, _FIRST_GROWTH, jnp.inf], y.dtype))
    first = (region.retract(y), y, identity, (), infinite, infinite, y, memory)
    state = SolverState(*first, jnp.asarray(0), no, no)
    return advance(distance, region, method, steps, state, steps, FINE[str(y.dtype)]).y


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


# ------------------------------------------------------------------------ many at once


class Search(NamedTuple):
    """How minima are searched for: the method, its steps, and how it is watched."""

    method: Method = "levenberg-marquardt"
    max_steps: int = DEFAULT_STEPS["levenberg-marquardt"]
    show: Show = quiet
    deadline: float = np.inf  # of `time.monotonic`, after which no pass is begun


def minimize(
    problems: Any,
    points: np.ndarray,
    search: Search,
    stop: float = 0.0,
    rivals: bool = False,
    what: str = "fits",
) -> SolverState:
    """Minima of S problems (`Residuals` with a leading axis) from y (S, Q), on the host.

    As many as `problems.lanes(S)` are solved side by side; those that are done make room for
    others. `stop`: see `FINE`, which it is at least. `rivals`: all are starts of one problem, and
    those that creep or will not become the best are given up. Progress counts `what`.
    """
    dtype, count = problems.offset.dtype, len(points)
    limit: Any = search.max_steps
    if search.method == "levenberg-marquardt":
        limit = np.asarray(limit)  # one program serves all limits
    rule: Any = (search.method, limit, np.asarray(max(FINE[str(dtype)], stop), dtype))
    points = points.astype(dtype)
    states = begin(points, problems.blank(points), search.method, search.max_steps)
    active, lanes = np.arange(count), problems.lanes(count)
    while len(active):
        before = states.cost.copy()
        for first in range(0, len(active), lanes):
            rows = active[np.minimum(np.arange(first, first + lanes), len(active) - 1)]
            some = advance_all(_rows(problems, rows), _rows(states, rows), *rule)
            for leaf, value in zip(jax.tree.leaves(states), jax.tree.leaves(some)):
                leaf[rows] = value
        ended = states.done | (states.steps >= search.max_steps)
        if search.method == "levenberg-marquardt":
            far = states.cost > (BEHIND if rivals else np.inf) * np.nanmin(states.cost)
            least = np.where(far, FALLS, 1 - (START_CREEPS if rivals else CREEPS))
            slow = (states.cost > least * before) & (states.memory.value < _SHORT)
            ended |= slow & ~states.converged
        active = active[~ended[active]]
        done, steps = count - len(active), int(states.steps.max())
        search.show(f"fit: {done} of {count} {what} done, step {steps}", done, count)
        if time.monotonic() > search.deadline:
            break
    return states


@quick_jit
def advance_all(
    problems: Any, states: SolverState, method: Method, max_steps: int, stop: jax.Array
) -> SolverState:
    """Up to `PASSES` passes more of every problem."""

    def one(problem: Any, state: SolverState) -> SolverState:
        """One problem."""
        region, evaluate = problem.region, problem.evaluate
        return advance(evaluate, region, method, max_steps, state, PASSES, stop)

    return eqx.filter_vmap(one)(problems, states)


def _rows(tree: Any, rows: np.ndarray) -> Any:
    """These rows of all arrays."""
    return jax.tree.map(lambda leaf: leaf[rows] if eqx.is_array(leaf) else leaf, tree)
