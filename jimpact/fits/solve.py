"""Nonlinear least squares in a box, from many starts or of many problems at once.

Minimize `|r(y)|^2 / 2` for `low <= y <= high`, by
Levenberg-Marquardt or by gradient descent with optax. Steps are cut at the box, and a variable on a
bound whose gradient points outward is left out of the step, so minima on a bound are found exactly.
One pass evaluates residual and Jacobian together, so that an impact is compiled once.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact.tools.checks import needed, suggestion
from jimpact.tools.compiling import quick_jit
from jimpact.tools.progress import Show
from jimpact.tools.threads import in_parts

if TYPE_CHECKING:
    import optax  # which takes long to import

HOW = "pip install optax"
Method: TypeAlias = "str | optax.GradientTransformation"

# Steps of one start before the solver gives up: more only costs time.
DEFAULT_STEPS = {"levenberg-marquardt": 100, "lbfgs": 100, "adam": 500, "sgd": 1000}

# What an undamped Gauss-Newton step still promises, in variances of one residual (|r|^2 / R): the
# distance to the minimum is its root, in standard errors. A solve is done at FINE, or at ROUNDING
# where no lower point is found: sums of squares are right to so much; one of many starts at COARSE,
# which is enough to tell minima apart; one of many data sets at FINE_OF_MANY, a ten-thousandth of a
# standard error, with two thirds of the steps; and the answer stands below CONVERGED, a tenth.
FINE = {"float64": 1e-17, "float32": 1e-4}
ROUNDING = {"float64": 1e-7, "float32": 1e-3}
COARSE, FINE_OF_MANY, CONVERGED = 1e-3, 1e-8, 1e-2
DESCENDED = 1e-6  # the same for gradient descent, which has no step that would make up for it
# ... or less than this: residuals are of order 1, and impacts are good to 1e-8 (1e-5), which
# counts where no lower point is found.
STOP_EXACT = {"float64": 1e-24, "float32": 1e-12}
ROUNDING_EXACT = {"float64": 1e-18, "float32": 1e-11}
# Mean squares (relative to the velocities) below this are a perfect fit: rounding and the
# tolerance of the impact.
EXACT = {"float64": 1e-14, "float32": 1e-8}

DAMPING = 1e-2  # first Levenberg-Marquardt damping, relative to the curvatures
# Nielsen (1999): the damping falls by this factor at most after a step that gains what it promised,
# and grows by a factor that doubles with each step that does not.
_LEAST_FACTOR, _FIRST_GROWTH = 1 / 3, 2.0
_LEAST = {"float64": 1e-10, "float32": 1e-5}  # smallest damping: keeps the matrix positive
_STUCK = 1e6  # above this damping no step, however small, lowers the sum of squares
_SHORT = 10.0  # damping from which on steps shorten, perhaps towards a kink that is the minimum
_FLAT = 1e-10  # curvatures below this share of the largest are damped as if they had it
_ADAM_RATE, _SGD_RATE, _SGD_MOMENTUM = 0.1, 0.3, 0.9  # in y, where ranges are of order 1

# Problems that a program solves side by side: starts of one, and many problems. With ten times
# more of them, all wait for the one whose impacts take longest; an accelerator has idle cores.
LANES, LANES_OF_MANY, LANES_ON_ACCELERATOR = 2, 64, 1024
PASSES = 4  # of a program, between two looks at the clock
# A solve that lowers its sum of squares by less than this share in PASSES passes, although its
# derivatives promise more, creeps along a kink of the law, where the sequence of contacts changes,
# and is given up.
CREEPS = 1e-4
# Starts up to so many variances above the best go on: intervals of all levels end before.
HARDLY_WORSE = 30.0
# Singular values of the scaled Jacobian below this share of the largest are zero: derivatives of
# an impact are good to about 1e-7 (float64; 1e-4 in float32), so smaller ones may be errors.
RANK_TOLERANCE = {"float64": 1e-6, "float32": 1e-3}
SETTLED, SETTLING = 1e-5, 10  # change (natural scales) and rounds, where errors of v- are passed on


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class LeastSquares:
    """Minimize `|r(y)|^2 / 2` for `low <= y <= high`: all that a solver knows of a fit.

    Attributes:
        evaluate: y (Q,) -> r (R,), dr/dy (R, Q), and what is kept of the best point; a pytree.
        low, high: (Q,) the box.
        size: () what r was divided by.
        project: (y, H, g) -> allowed z of the least `g^T (z - y) + (z - y)^T H (z - y) / 2`; None:
            all of the box is allowed.
        zeros: shaped like what `evaluate` gives.
        short: whether `evaluate` takes so little time that many problems may wait for each other.
    """

    evaluate: Callable[[jax.Array], tuple[jax.Array, jax.Array, Any]]
    low: Any
    high: Any
    size: Any
    project: Callable[[jax.Array, jax.Array, jax.Array], jax.Array] | None
    zeros: Any
    short: bool = field(metadata={"static": True})

    def lanes(self, count: int) -> int:
        """How many of `count` such problems are solved side by side."""
        if not self.short:
            return LANES if count > 1 else 1
        many = LANES_OF_MANY if jax.default_backend() == "cpu" else LANES_ON_ACCELERATOR
        return LANES if count <= LANES_OF_MANY else many


def _free_gradient(problem: LeastSquares, y: jax.Array, gradient: jax.Array) -> jax.Array:
    """The gradient without variables that sit on a bound and are pushed against it."""
    pushed = ((y <= problem.low) & (gradient > 0)) | ((y >= problem.high) & (gradient < 0))
    return jnp.where(pushed, 0.0, gradient)


def _damped_step(
    gradient: jax.Array, jacobian: jax.Array, damping: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Damped Gauss-Newton step, and the decrease it promises."""
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


def step_limit(method: Any, stated: int | None) -> int:
    """The stated limit of steps, or that of the method; raises a ValueError for an unknown one."""
    known = isinstance(method, str) and method in DEFAULT_STEPS
    if not known:
        optax = needed("optax", HOW)
        if not isinstance(method, optax.GradientTransformation):
            raise ValueError(
                f"Argument `method` must be one of {', '.join(map(repr, DEFAULT_STEPS))} or an "
                f"optax.GradientTransformation, but has value {method!r}."
                f"{suggestion(method, DEFAULT_STEPS)}"
            )
    return DEFAULT_STEPS[method if known else "adam"] if stated is None else stated


def begin(problems: Any, y: Any, solver: "Solver") -> SolverState:
    """States before the first pass of S problems from y (S, Q), on the host."""
    count = len(y)
    all_are: Any = partial(np.full, count, dtype=y.dtype)
    if solver.method == "levenberg-marquardt":
        memory: Any = Damping(*map(all_are, (solver.damping, _FIRST_GROWTH, np.inf)))
    else:
        init = _transformation(solver.method, solver.max_steps).init
        memory = jax.device_get(jax.vmap(init)(y))
    costs = all_are(np.inf), all_are(np.inf)
    ends: Any = np.zeros(count, int), np.zeros(count, bool), np.zeros(count, bool)
    trial = np.clip(y, problems.low, problems.high)
    residual, jacobian, aux = problems.zeros
    state = SolverState(y, residual, jacobian, aux, *costs, trial, memory, *ends)
    return jax.tree.map(np.array, state)  # copies: states are written in place


@quick_jit
def advance_all(
    problems: Any, states: SolverState, method: Method, max_steps: int, stop: jax.Array
) -> SolverState:
    """Every problem by at most `PASSES` trials more, until it is done or has made `max_steps`.

    The host calls it again and again; in between it shows progress and drops what is done. `stop`
    (): a problem is done where a Gauss-Newton step promises less than this part of `|r|^2 / R`.
    """

    def one(problem: Any, state: SolverState) -> SolverState:
        """One problem, until it is done or at the step limit."""
        last = jnp.minimum(state.steps + PASSES, max_steps)
        one_pass = partial(_pass, problem, method, max_steps, stop)
        return jax.lax.while_loop(lambda s: ~s.done & (s.steps < last), one_pass, state)

    return eqx.filter_vmap(one)(problems, states)


def _pass(
    problem: LeastSquares, method: Method, max_steps: int, stop: jax.Array, state: SolverState
) -> SolverState:
    """Residual and Jacobian of the trial, and the next one."""
    residual, jacobian, aux = problem.evaluate(state.trial)
    cost = 0.5 * jnp.sum(residual**2)
    better = cost < state.cost
    here = (state.trial, residual, jacobian, aux, cost)
    best = (state.y, state.residual, state.jacobian, state.aux, state.cost)
    best = jax.tree.map(lambda a, b: jnp.where(better, a, b), here, best)
    y, r, jac, aux, least = best
    dtype = str(y.dtype)
    slope = jac.T @ r
    free = _free_gradient(problem, y, slope)
    of_free = jnp.where((free == 0) & (slope != 0), 0.0, jac)
    floor = jnp.asarray(_LEAST[dtype], y.dtype)
    if method == "levenberg-marquardt":
        memory = state.memory.after(state.cost - cost)
        dampings = jnp.stack([floor, memory.value])  # compiled once
        moves, gains = jax.vmap(partial(_damped_step, free, of_free))(dampings)
        gain, trial = gains[0], jnp.clip(y + moves[1], problem.low, problem.high)
        change = jac @ (trial - y)
        memory = memory._replace(promised=-(r @ change) - 0.5 * jnp.sum(change**2))
        stuck = memory.value > _STUCK
    else:
        gain = _damped_step(free, of_free, floor)[1]
        gradient = _free_gradient(problem, state.trial, jacobian.T @ residual)
        # optax itself mixes integers and floats: it needs the standard promotion
        with jax.numpy_dtype_promotion("standard"):
            move, memory = _transformation(method, max_steps).update(
                gradient,
                state.memory,
                state.trial,
                value=cost,
                grad=gradient,
                value_fn=partial(_cost, problem),
            )
        trial = jnp.clip(state.trial + move, problem.low, problem.high)
        stuck = jnp.asarray(False)
    finest = stop * least / residual.shape[0] + STOP_EXACT[dtype]
    rounding = ROUNDING[dtype] * least / residual.shape[0] + ROUNDING_EXACT[dtype]
    small = gain <= jnp.where(better, finest, jnp.maximum(finest, rounding))
    return SolverState(
        y, r, jac, aux, least, gain, trial, memory, state.steps + 1, small | stuck, stuck
    )


def _cost(problem: LeastSquares, y: jax.Array) -> jax.Array:
    """`|r|^2 / 2` at the nearest point in the bounds, for line searches.

    Its derivative is taken from the Jacobian that `evaluate` gives.
    """

    @jax.custom_jvp
    def cost(y: jax.Array) -> jax.Array:
        """Half the sum of squares."""
        return 0.5 * jnp.sum(problem.evaluate(y)[0] ** 2)

    @cost.defjvp
    def _rule(primals: Any, tangents: Any) -> tuple[jax.Array, jax.Array]:
        """The derivative by the Jacobian."""
        residual, jacobian, _ = problem.evaluate(primals[0])
        return 0.5 * jnp.sum(residual**2), (jacobian.T @ residual) @ tangents[0]

    return cost(jnp.clip(y, problem.low, problem.high))


def _transformation(method: Method, max_steps: int) -> "optax.GradientTransformationExtraArgs":
    """The optax transformation of a method."""
    optax = needed("optax", HOW)

    if method == "adam":
        method = optax.adam(optax.cosine_decay_schedule(_ADAM_RATE, max_steps))
    elif method == "sgd":
        method = optax.sgd(_SGD_RATE, momentum=_SGD_MOMENTUM)
    elif method == "lbfgs":
        method = optax.lbfgs()
    return optax.with_extra_args_support(method)


# ---------------------------------------------------------------------------- many at once


class Solver(NamedTuple):
    """How minima are searched for: the method, its steps, and how it is watched."""

    method: Method = "levenberg-marquardt"
    max_steps: int = DEFAULT_STEPS["levenberg-marquardt"]
    show: Show = lambda step, done, total: None
    deadline: float = np.inf  # of `time.monotonic`, after which no pass is begun
    workers: int | None = None  # threads, None: one for each core
    damping: float = DAMPING  # at first, of Levenberg-Marquardt: less where a minimum is near


class Ends(NamedTuple):
    """Where S solves ended, on the host; residuals in units of sigma."""

    y: np.ndarray  # (S, Q)
    squares: np.ndarray  # (S,) |r|^2
    residual: np.ndarray  # (S, R)
    jacobian: np.ndarray  # (S, R, Q)
    predicted: np.ndarray
    status: np.ndarray
    slopes: Any  # `dv+/dv-` of the shots, where errors of v- are passed on, else None
    converged: np.ndarray  # (S,) whether so close to a minimum that it stands
    stuck: np.ndarray  # (S,) no step lowers the sum of squares, although derivatives promise it
    steps: np.ndarray

    def rows(self, which: Any) -> "Ends":
        """Some of them."""
        return jax.tree.map(lambda x: x[which], self)


def minimize(
    problems: Sequence[LeastSquares],
    points: np.ndarray,
    solver: Solver,
    stop: float = 0.0,
    noise: float | None = None,
    what: str = "fits",
    fixed: np.ndarray | None = None,
) -> Ends:
    """Minima of problems from y (S, Q), equally many of each, one after the other.

    As many as `lanes(S)` are solved side by side; those that are done make room for
    others. `stop`: see `FINE`, which it is at least. `noise`: all are starts of one problem, whose
    residuals have this noise at least, and every few passes the worse half of them is given up
    (successive halving). Progress counts `what`. `fixed` (S, Q): which entries of y stay as they
    are. Where not all of the box is allowed, that is left aside at first, and then holds.
    """
    many = stacked(problems, len(points) // len(problems))
    points = points.astype(many.low.dtype)
    dtype, project = str(points.dtype), many.project
    if fixed is not None:
        low, high = (np.where(fixed, points, end) for end in (many.low, many.high))
        many, project = replace(many, low=low, high=high), None
    many = replace(many, project=None)
    rule = (max(FINE[dtype], stop), noise, what)
    states, converged = _descended(many, points, solver, *rule)
    y, steps, stuck = np.asarray(states.y), states.steps, states.stuck
    once, moved = solver._replace(max_steps=1), np.full(len(y), project is not None)
    for _ in range(SETTLING):
        if not moved.any():
            break
        inside = np.empty_like(y)
        lanes, workers = many.lanes(len(y)), solver.workers
        for rows, nearest in in_parts(best_allowed, (project, states), lanes, workers=workers):
            inside[rows] = nearest
        states, _ = _descended(many, inside, once, *rule)
        moved, y = np.abs(inside - y).max(axis=1) > SETTLED, inside
    size = np.asarray(many.size, float)
    return Ends(
        y=np.asarray(states.y, float),
        squares=2 * np.asarray(states.cost, float) * size**2,
        residual=np.asarray(states.residual, float) * size[:, None],
        jacobian=np.asarray(states.jacobian, float) * size[:, None, None],
        predicted=np.asarray(states.aux[0], float),
        status=states.aux[1],
        slopes=states.aux[2] if len(states.aux) > 2 else None,
        converged=converged & ~moved,
        stuck=np.asarray(stuck),
        steps=np.asarray(steps),
    )


@quick_jit
def best_allowed(project: Any, states: SolverState) -> jax.Array:
    """The allowed points where the linearized residuals are least."""

    def one(project: Any, state: SolverState) -> jax.Array:
        """Of one problem."""
        jacobian = state.jacobian
        hessian, gradient = jacobian.T @ jacobian, jacobian.T @ state.residual
        return project(state.y, hessian, gradient)

    return jax.vmap(one)(project, states)


def _descended(
    problems: Any,
    points: np.ndarray,
    solver: Solver,
    stop: float,
    noise: float | None,
    what: str,
) -> tuple[SolverState, np.ndarray]:
    """States where searches from y (S, Q) ended, and which have converged; see `minimize`."""
    dtype, count = points.dtype, len(points)
    limit: Any = solver.max_steps
    descends = solver.method != "levenberg-marquardt"
    if not descends:
        limit = np.asarray(limit)  # one program serves all limits
    rule: Any = {"method": solver.method, "max_steps": limit, "stop": np.asarray(stop, dtype)}
    advance, states = partial(advance_all, **rule), begin(problems, points, solver)
    problems = replace(problems, zeros=None)
    converged = np.zeros(count, bool)
    active, lanes = np.arange(count), problems.lanes(count)
    first = True
    while len(active):
        before, every = states.cost.copy(), (problems, states)
        for rows, some in in_parts(advance, every, lanes, active, solver.workers, first):
            for leaf, value in zip(jax.tree.leaves(states), jax.tree.leaves(some)):
                leaf[rows] = value
        first = False
        converged = _converged(states, DESCENDED if descends else CONVERGED)
        ended = states.done | (states.steps >= solver.max_steps)
        if not descends:
            creeps = (states.cost > (1 - CREEPS) * before) & (states.memory.value < _SHORT)
            ended |= creeps & ~converged
        active = active[~ended[active]]
        if noise is not None and not descends:
            active = _better_half(states, active, noise / problems.size[0])
        done, steps = count - len(active), int(states.steps.max())
        solver.show(f"fit: {done} of {count} {what} done, step {steps}", done, count)
        if time.monotonic() > solver.deadline:
            break
    return states, converged


def _better_half(states: SolverState, active: np.ndarray, noise: float) -> np.ndarray:
    """Of the active starts the better half, and all that are hardly worse than the best of all."""
    order, least = active[np.argsort(states.cost[active])], np.nanmin(states.cost)
    variance = max(least / states.residual.shape[-1], 0.5 * noise**2)
    hardly_worse = states.cost[order] <= least + HARDLY_WORSE * variance
    return order[hardly_worse | (np.arange(len(order)) < len(order) // 2)]


def _converged(states: SolverState, enough: float) -> np.ndarray:
    """Which points (S,) are so close to a minimum that they stand."""
    promised, squares = (2 * np.asarray(x, float) for x in (states.gain, states.cost))
    small = promised <= enough * squares / states.residual.shape[-1]
    return small | (squares <= EXACT[str(states.y.dtype)]) | states.stuck


def stacked(problems: Sequence[Any], each: int = 1) -> Any:
    """Problems of one structure side by side, each so many times."""

    def side_by_side(*leaves: Any) -> Any:
        """Arrays with a leading axis; what is no array is the same for all."""
        if not eqx.is_array(leaves[0]):
            return leaves[0]
        return np.repeat(np.stack([np.asarray(leaf) for leaf in leaves]), each, axis=0)

    return jax.tree.map(side_by_side, *problems)
