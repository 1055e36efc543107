"""Nonlinear least squares in a box, from many starts or of many problems at once.

Minimize `|r(y)|^2 / 2` for `low <= y <= high`, by Levenberg-Marquardt or by gradient
descent with optax. Steps are cut at the box, and a variable on a bound whose gradient
points outward is left out of the step, so minima on a bound are found exactly. One pass
evaluates residual and Jacobian together, so that an impact is compiled once.

Axes: S problems side by side, Q variables y, R residuals r.
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
from jaxtyping import Array, Bool, Float, Int

from jimpact.tools.checks import needed, suggestion
from jimpact.tools.compiling import quick_jit
from jimpact.tools.masks import choose
from jimpact.tools.progress import Show
from jimpact.tools.threads import in_parts

if TYPE_CHECKING:
    import optax  # which takes long to import

HOW = "pip install optax"
Method: TypeAlias = "str | optax.GradientTransformation"
AnyArray: TypeAlias = Array | np.ndarray  # on the device, or on the host

# Steps of one start before the solver gives up: more only costs time.
DEFAULT_STEPS = {"levenberg-marquardt": 100, "lbfgs": 100, "adam": 500, "sgd": 1000}

# What an undamped Gauss-Newton step still promises, in variances of one residual (|r|^2
# / R): the distance to the minimum is its root, in standard errors. A solve is done at
# FINE, or at ROUNDING where no lower point is found: sums of squares are right to so
# much; one of many starts at COARSE, which is enough to tell minima apart; one of many
# data sets at FINE_OF_MANY, a ten-thousandth of a standard error, with two thirds of
# the steps; and the answer stands below CONVERGED, a tenth.
FINE = {"float64": 1e-17, "float32": 1e-4}
ROUNDING = {"float64": 1e-7, "float32": 1e-3}
COARSE = 1e-3
FINE_OF_MANY = 1e-8
CONVERGED = 1e-2
# the same for gradient descent, which has no step that would make up for it
DESCENDED = 1e-6
# ... or less than this: residuals are of order 1, and impacts are good to 1e-8 (1e-5),
# which counts where no lower point is found.
STOP_EXACT = {"float64": 1e-24, "float32": 1e-12}
ROUNDING_EXACT = {"float64": 1e-18, "float32": 1e-11}
# Mean squares (relative to the velocities) below this are a perfect fit: rounding and
# the tolerance of the impact.
EXACT = {"float64": 1e-14, "float32": 1e-8}

DAMPING = 1e-2  # first Levenberg-Marquardt damping, relative to the curvatures
# Nielsen (1999): the damping falls by this factor at most after a step that gains what
# it promised, and grows by a factor that doubles with each step that does not.
_LEAST_FACTOR = 1 / 3
_FIRST_GROWTH = 2.0
# smallest damping: keeps the matrix positive
_LEAST = {"float64": 1e-10, "float32": 1e-5}
_STUCK = 1e6  # above this damping no step, however small, lowers the sum of squares
# damping from which on steps shorten, perhaps towards a kink that is the minimum
_SHORT = 10.0
_FLAT = 1e-10  # curvatures below this share of the largest are damped as if they had it
# in y, where ranges are of order 1
_ADAM_RATE = 0.1
_SGD_RATE = 0.3
_SGD_MOMENTUM = 0.9

# Problems that a program solves side by side: starts of one, and many problems. With
# ten times more of them, all wait for the one whose impacts take longest; an
# accelerator has idle cores.
LANES = 2
LANES_OF_MANY = 64
LANES_ON_ACCELERATOR = 1024
PASSES = 4  # of a program, between two looks at the clock
# A solve that lowers its sum of squares by less than this share in PASSES passes,
# although its derivatives promise more, creeps along a kink of the law, where the
# sequence of contacts changes, and is given up.
CREEPS = 1e-4
# Starts up to so many variances above the best go on: intervals of all levels end
# before.
HARDLY_WORSE = 30.0
# Singular values of the scaled Jacobian below this share of the largest are zero:
# derivatives of an impact are good to about 1e-7 (float64; 1e-4 in float32), so smaller
# ones may be errors.
RANK_TOLERANCE = {"float64": 1e-6, "float32": 1e-3}
# Change (natural scales) and rounds of what is solved by turns: admissible points,
# robust weights.
SETTLED = 1e-5
SETTLING = 10


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class LeastSquares:
    """Minimize `|r(y)|^2 / 2` for `low <= y <= high`: a fit as a solver sees it.

    S stacked problems have one more axis in front of every array.

    Attributes:
        evaluate: y -> r, dr/dy, and further outcomes (a pytree), kept of the best
            point.
        low, high: bounds of y.
        size: the number that r was divided by: `|r| size` is in units of sigma.
        project: (y, H, g) -> allowed z of the least
            `g^T (z - y) + (z - y)^T H (z - y) / 2`; None: all y within the bounds are
            allowed.
        zeros: arrays of 0 shaped like the results of `evaluate`.
        short: True where `evaluate` is so quick that many problems may wait for each
            other.
    """

    evaluate: Callable[
        [Float[AnyArray, " Q"]], tuple[Float[Array, " R"], Float[Array, "R Q"], Any]
    ]
    low: Float[AnyArray, "*S Q"]
    high: Float[AnyArray, "*S Q"]
    size: Float[AnyArray, "*S"]
    project: (
        Callable[
            [Float[Array, " Q"], Float[Array, "Q Q"], Float[Array, " Q"]],
            Float[Array, " Q"],
        ]
        | None
    )
    zeros: Any
    short: bool = field(metadata={"static": True})

    def lanes(self, count: int) -> int:
        """Number of problems, of `count`, that one program solves at a time.

        All of them wait for the slowest one, so they are many only where `evaluate` is
        quick.
        """
        if not self.short:
            if count > 1:
                return LANES
            return 1
        if jax.default_backend() == "cpu":
            many = LANES_OF_MANY
        else:
            many = LANES_ON_ACCELERATOR
        if count <= LANES_OF_MANY:
            return LANES
        return many


def _free_gradient(
    problem: LeastSquares, y: Float[AnyArray, " Q"], gradient: Float[AnyArray, " Q"]
) -> Float[Array, " Q"]:
    """The projected gradient: 0 for a variable on a bound that a descent would cross.

    Equation: `0 if y_i <= low_i and g_i > 0, or y_i >= high_i and g_i < 0; else g_i`.
    """
    pushed = ((y <= problem.low) & (gradient > 0)) | (
        (y >= problem.high) & (gradient < 0)
    )
    return jnp.where(pushed, 0.0, gradient)


def _damped_step(
    gradient: Float[Array, " Q"],
    jacobian: Float[Array, "R Q"],
    damping: Float[Array, ""],
) -> tuple[Float[Array, " Q"], Float[Array, ""]]:
    """Levenberg-Marquardt step d, and the decrease of `|r|^2 / 2` that the linear model
    promises.

    Equation: `(J^T J + mu D) d = -g` with `g = J^T r`, D the diagonal of `J^T J` (its
    smallest entries raised); the decrease is `-g^T d - |J d|^2 / 2`.
    """
    hessian = jacobian.T @ jacobian
    curvature = jnp.diagonal(hessian)
    largest = jnp.max(curvature)
    curvature = jnp.maximum(curvature, jnp.where(largest > 0, _FLAT * largest, 1.0))
    factor = jax.scipy.linalg.cho_factor(hessian + jnp.diag(damping * curvature))
    move = -jax.scipy.linalg.cho_solve(factor, gradient)
    return move, -(gradient @ move) - 0.5 * jnp.sum((jacobian @ move) ** 2)


class Damping(NamedTuple):
    """The damping mu of Levenberg-Marquardt by Nielsen's rule (1999).

    `growth` is the factor on mu after a step that fails; `promised` is the decrease of
    `|r|^2 / 2` that the linear model promised of the last step.
    """

    value: Float[AnyArray, "*S"]
    growth: Float[AnyArray, "*S"]
    promised: Float[AnyArray, "*S"]

    def after(self, gain: Float[AnyArray, "*S"]) -> "Damping":
        """The damping after a step that has lowered `|r|^2 / 2` by `gain`.

        Equation: with `rho = gain / promised`, `mu max(1/3, 1 - (2 rho - 1)^3)` and
        `growth = 2` where gain > 0; else `mu growth`, and the growth doubles.
        """
        better = gain > 0
        ratio = jnp.where(jnp.isfinite(gain), gain / self.promised, 1.0)
        less = jnp.maximum(_LEAST_FACTOR, 1 - (2 * ratio - 1) ** 3)
        floor = _LEAST[str(self.value.dtype)]
        value = jnp.maximum(self.value * jnp.where(better, less, self.growth), floor)
        return Damping(
            value, jnp.where(better, _FIRST_GROWTH, 2 * self.growth), self.promised
        )


class SolverState(eqx.Module):
    """An iteration: the best point so far, the next trial point, and the memory of the
    method.
    """

    y: Float[AnyArray, "*S Q"]  # the best point
    residual: Float[AnyArray, "*S R"]  # there, as the next two
    jacobian: Float[AnyArray, "*S R Q"]
    aux: Any  # further outcomes of `LeastSquares.evaluate`
    cost: Float[AnyArray, "*S"]  # |r|^2 / 2
    gain: Float[AnyArray, "*S"]  # decrease of it that a Gauss-Newton step promises
    trial: Float[AnyArray, "*S Q"]
    memory: Any  # `Damping`, or the state of an optax transformation
    steps: Int[AnyArray, "*S"]
    done: Bool[AnyArray, "*S"]
    stuck: Bool[AnyArray, "*S"]  # no step lowers the cost


class _Point(NamedTuple):
    """A point y, its residual r, dr/dy, further outcomes of `evaluate`, and
    `|r|^2 / 2`.
    """

    y: Float[AnyArray, " Q"]
    residual: Float[AnyArray, " R"]
    jacobian: Float[AnyArray, "R Q"]
    aux: Any
    cost: Float[AnyArray, ""]


def step_limit(method: Any, stated: int | None) -> int:
    """Largest number of iterations of one start: `stated`, or the default of the
    method.

    Raises:
        ValueError: an unknown method.
    """
    is_named = isinstance(method, str) and method in DEFAULT_STEPS
    if not is_named:
        optax = needed("optax", HOW)
        if not isinstance(method, optax.GradientTransformation):
            raise ValueError(
                f"Argument `method` must be one of "
                f"{', '.join(map(repr, DEFAULT_STEPS))} or an "
                f"optax.GradientTransformation, but has value {method!r}."
                f"{suggestion(method, DEFAULT_STEPS)}"
            )
    if stated is None:
        return DEFAULT_STEPS[method if is_named else "adam"]
    return stated


def begin(
    problems: LeastSquares, y: Float[np.ndarray, "S Q"], solver: "Solver"
) -> SolverState:
    """Initial states of S stacked problems that start from y, on the host: nothing is
    evaluated.
    """
    count = len(y)
    filled: Any = partial(np.full, count, dtype=y.dtype)
    if solver.method == "levenberg-marquardt":
        memory: Any = Damping(*map(filled, (solver.damping, _FIRST_GROWTH, np.inf)))
    else:
        init = _transformation(solver.method, solver.max_steps).init
        memory = jax.device_get(jax.vmap(init)(y))
    residual, jacobian, aux = problems.zeros
    state = SolverState(
        y=y,
        residual=residual,
        jacobian=jacobian,
        aux=aux,
        cost=filled(np.inf),
        gain=filled(np.inf),
        trial=np.clip(y, problems.low, problems.high),
        memory=memory,
        steps=np.zeros(count, int),
        done=np.zeros(count, bool),
        stuck=np.zeros(count, bool),
    )
    return jax.tree.map(np.array, state)  # copies: states are written in place


@quick_jit
def advance_all(
    problems: LeastSquares,
    states: SolverState,
    method: Method,
    max_steps: Any,
    stop: Any,
) -> SolverState:
    """Advance S stacked problems by up to `PASSES` iterations each, at most to
    `max_steps`.

    The host calls it again and again; in between it shows progress and drops what is
    done. `stop` (): a problem is done where a Gauss-Newton step promises less than this
    part of `|r|^2 / R`.
    """

    def advance_one(problem: Any, state: SolverState) -> SolverState:
        """Iterate on one problem until it is done or at its limit of steps."""
        last = jnp.minimum(state.steps + PASSES, max_steps)
        one_pass = partial(_pass, problem, method, max_steps, stop)
        return jax.lax.while_loop(lambda s: ~s.done & (s.steps < last), one_pass, state)

    return eqx.filter_vmap(advance_one)(problems, states)


def _pass(
    problem: LeastSquares, method: Method, max_steps: Any, stop: Any, state: SolverState
) -> SolverState:
    """One iteration: evaluate the trial point, keep the better point, step to the next
    trial.

    The step is that of `_damped_step`, or of an optax transformation. The problem is
    done where a Gauss-Newton step (with the least damping) from the best point promises
    too little.
    """
    residual, jacobian, aux = problem.evaluate(state.trial)
    cost = 0.5 * jnp.sum(residual**2)
    better = cost < state.cost
    tried = _Point(state.trial, residual, jacobian, aux, cost)
    before = _Point(state.y, state.residual, state.jacobian, state.aux, state.cost)
    best: _Point = choose(better, tried, before)
    y = best.y
    r = best.residual
    dtype = str(y.dtype)
    gradient = best.jacobian.T @ r
    projected = _free_gradient(problem, y, gradient)
    # without the columns of variables that are held at a bound
    free_jacobian = jnp.where((projected == 0) & (gradient != 0), 0.0, best.jacobian)
    floor = jnp.asarray(_LEAST[dtype], y.dtype)
    if method == "levenberg-marquardt":
        memory = state.memory.after(state.cost - cost)
        dampings = jnp.stack([floor, memory.value])  # compiled once
        moves, gains = jax.vmap(partial(_damped_step, projected, free_jacobian))(
            dampings
        )
        gain = gains[0]
        trial = jnp.clip(y + moves[1], problem.low, problem.high)
        # of r in the linear model, after the cut at the box
        change = best.jacobian @ (trial - y)
        memory = memory._replace(promised=-(r @ change) - 0.5 * jnp.sum(change**2))
        stuck = memory.value > _STUCK
    else:
        gain = _damped_step(projected, free_jacobian, floor)[1]
        trial_gradient = _free_gradient(problem, state.trial, jacobian.T @ residual)
        # optax itself mixes integers and floats: it needs the standard promotion
        with jax.numpy_dtype_promotion("standard"):
            move, memory = _transformation(method, max_steps).update(
                trial_gradient,
                state.memory,
                state.trial,
                value=cost,
                grad=trial_gradient,
                value_fn=partial(_cost, problem),
            )
        trial = jnp.clip(state.trial + move, problem.low, problem.high)
        stuck = jnp.asarray(False)
    # promises below which the search is done: always, or where no lower point was found
    finest = stop * best.cost / residual.shape[0] + STOP_EXACT[dtype]
    rounding = ROUNDING[dtype] * best.cost / residual.shape[0] + ROUNDING_EXACT[dtype]
    small = gain <= jnp.where(better, finest, jnp.maximum(finest, rounding))
    end: Any = {"steps": state.steps + 1, "done": small | stuck, "stuck": stuck}
    return SolverState(**best._asdict(), gain=gain, trial=trial, memory=memory, **end)


def _cost(problem: LeastSquares, y: Float[Array, " Q"]) -> Float[Array, ""]:
    """`|r|^2 / 2` at the nearest point within the bounds, for line searches of optax.

    Its derivative is taken from the Jacobian that `evaluate` gives.
    """

    @jax.custom_jvp
    def cost(y: jax.Array) -> jax.Array:
        """`|r(y)|^2 / 2`."""
        return 0.5 * jnp.sum(problem.evaluate(y)[0] ** 2)

    @cost.defjvp
    def _rule(primals: Any, tangents: Any) -> tuple[jax.Array, jax.Array]:
        """`|r|^2 / 2` and its change `(J^T r)^T dy` along a tangent dy."""
        residual, jacobian, _ = problem.evaluate(primals[0])
        return 0.5 * jnp.sum(residual**2), (jacobian.T @ residual) @ tangents[0]

    return cost(jnp.clip(y, problem.low, problem.high))


def _transformation(
    method: Method, max_steps: int
) -> "optax.GradientTransformationExtraArgs":
    """The optax transformation of a method: as it is given, or that of its name.

    The learning rate of 'adam' decays as a cosine over `max_steps`.
    """
    optax = needed("optax", HOW)

    if method == "adam":
        method = optax.adam(optax.cosine_decay_schedule(_ADAM_RATE, max_steps))
    elif method == "sgd":
        method = optax.sgd(_SGD_RATE, momentum=_SGD_MOMENTUM)
    elif method == "lbfgs":
        method = optax.lbfgs()
    return optax.with_extra_args_support(method)


# ---------------------------------------------------------------------------- many at
# once


class Solver(NamedTuple):
    """Options of a search for minima: the method, its limits, and the display of
    progress.
    """

    method: Method = "levenberg-marquardt"
    max_steps: int = DEFAULT_STEPS["levenberg-marquardt"]
    show: Show = lambda step, done, total: None
    deadline: float = np.inf  # of `time.monotonic`, after which no pass is begun
    workers: int | None = None  # threads, None: one for each core
    # at first, of Levenberg-Marquardt: less where a minimum is near
    damping: float = DAMPING


class Ends(NamedTuple):
    """End points of S solves, on the host; residuals in units of sigma.

    A single one, `rows(k)`, has no axis S.
    """

    y: Float[np.ndarray, "*S Q"]
    squares: Float[np.ndarray, "*S"]  # |r|^2
    residual: Float[np.ndarray, "*S R"]
    jacobian: Float[np.ndarray, "*S R Q"]
    predicted: Float[np.ndarray, "..."]  # S, and the shape of what was measured
    status: Int[np.ndarray, "*S K"]  # codes of the shots; one of another observable
    # dv+/dv- at true v-, with errors of v-
    slopes: Float[np.ndarray, "*S K n n"] | None
    pre: Float[np.ndarray, "*S K n"] | None  # these true v-
    converged: Bool[np.ndarray, "*S"]  # True close enough to a minimum, see `CONVERGED`
    # no step lowers |r|^2, although derivatives promise it
    stuck: Bool[np.ndarray, "*S"]
    steps: Int[np.ndarray, "*S"]

    def rows(self, which: Any) -> "Ends":
        """The ends of these solves; `which` indexes the axis S."""
        return jax.tree.map(lambda x: x[which], self)


def minimize(
    problems: Sequence[LeastSquares],
    points: Float[np.ndarray, "S Q"],
    solver: Solver,
    stop: float = 0.0,
    noise: float | None = None,
    what: str = "fits",
    fixed: Bool[np.ndarray, "S Q"] | None = None,
) -> Ends:
    """Minima of N problems of one structure, each from S / N of the points, which
    follow in order.

    Up to `lanes(S)` solves run side by side; those that are done make room for others.
    Where a problem allows only a part of its box (`project`), it is solved in all of
    the box first. Then y goes to the allowed point of the least linearized residuals,
    repeatedly, until it stays.

    Args:
        problems: N of them.
        points: y from which the solves start.
        solver: options.
        stop: done where a Gauss-Newton step promises less than this part of
            `|r|^2 / R`; at
            least `FINE`.
        noise: standard error of a residual; with it all points are starts of one
            problem, and every few passes the worse half of them is given up (successive
            halving).
        what: the noun in messages of progress.
        fixed: True for entries of y that stay at their start.
    """
    many = stacked(problems, len(points) // len(problems))
    points = points.astype(many.low.dtype)
    dtype = str(points.dtype)
    project = many.project
    if fixed is not None:
        low, high = (np.where(fixed, points, end) for end in (many.low, many.high))
        many = replace(many, low=low, high=high)
        project = None
    many = replace(many, project=None)
    rule = (max(FINE[dtype], stop), noise, what)
    states, converged = _descended(many, points, solver, *rule)
    y = np.asarray(states.y)
    steps = states.steps
    stuck = states.stuck
    once = solver._replace(max_steps=1)
    moved = np.full(len(y), project is not None)
    # by turns: the best allowed point, residual and Jacobian there
    for _ in range(SETTLING):
        if not moved.any():
            break
        allowed = np.empty_like(y)
        lanes = many.lanes(len(y))
        workers = solver.workers
        for rows, nearest in in_parts(
            best_allowed, (project, states), lanes, workers=workers
        ):
            allowed[rows] = nearest
        states, _ = _descended(many, allowed, once, *rule)
        moved = np.abs(allowed - y).max(axis=1) > SETTLED
        y = allowed
    size = np.asarray(many.size, float)
    before = states.aux[2:]
    return Ends(
        y=np.asarray(states.y, float),
        squares=2 * np.asarray(states.cost, float) * size**2,
        residual=np.asarray(states.residual, float) * size[:, None],
        jacobian=np.asarray(states.jacobian, float) * size[:, None, None],
        predicted=np.asarray(states.aux[0], float),
        status=states.aux[1],
        slopes=before[0] if before else None,
        pre=before[1] if before else None,
        converged=converged & ~moved,
        stuck=np.asarray(stuck),
        steps=np.asarray(steps),
    )


@quick_jit
def best_allowed(project: Any, states: SolverState) -> Float[Array, "S Q"]:
    """The allowed z of the least linearized residuals `|r + J (z - y)|^2`, y the best
    points.
    """

    def nearest(project: Any, state: SolverState) -> Float[Array, " Q"]:
        """`project(y, J^T J, J^T r)` of one problem."""
        jacobian = state.jacobian
        hessian = jacobian.T @ jacobian
        gradient = jacobian.T @ state.residual
        return project(state.y, hessian, gradient)

    return jax.vmap(nearest)(project, states)


def _descended(
    problems: LeastSquares,
    points: Float[np.ndarray, "S Q"],
    solver: Solver,
    stop: float,
    noise: float | None,
    what: str,
) -> tuple[SolverState, Bool[np.ndarray, " S"]]:
    """Last states of S solves within the box, and True for those that converged.

    A solve ends where it converges or is stuck (`SolverState.done`), and after
    `max_steps`; by Levenberg-Marquardt also where it creeps (`_creeps`) and, with
    `noise`, where it is in the worse half (`_better_half`). At the deadline all end.

    Arguments as of `minimize`, but the problems are stacked.
    """
    dtype = points.dtype
    count = len(points)
    limit: Any = solver.max_steps
    by_gradient = solver.method != "levenberg-marquardt"
    if not by_gradient:
        limit = np.asarray(limit)  # an argument of the program, which serves all limits
    rule: Any = {
        "method": solver.method,
        "max_steps": limit,
        "stop": np.asarray(stop, dtype),
    }
    advance = partial(advance_all, **rule)
    states = begin(problems, points, solver)
    problems = replace(problems, zeros=None)  # only `begin` needs them
    converged = np.zeros(count, bool)
    # indices of the solves that go on
    active = np.arange(count)
    lanes = problems.lanes(count)
    compiles = True  # the first time
    while len(active):
        cost_before = states.cost.copy()
        trees = (problems, states)
        for rows, part in in_parts(
            advance, trees, lanes, active, solver.workers, compiles
        ):
            for leaf, value in zip(jax.tree.leaves(states), jax.tree.leaves(part)):
                leaf[rows] = value
        compiles = False
        converged = _converged(states, DESCENDED if by_gradient else CONVERGED)
        ended = states.done | (states.steps >= solver.max_steps)
        if not by_gradient:
            ended |= _creeps(states, cost_before) & ~converged
        active = active[~ended[active]]
        if noise is not None and not by_gradient:
            active = _better_half(states, active, noise / problems.size[0])
        done = count - len(active)
        steps = int(states.steps.max())
        solver.show(f"fit: {done} of {count} {what} done, step {steps}", done, count)
        if time.monotonic() > solver.deadline:
            break
    return states, converged


def _creeps(
    states: SolverState, cost_before: Float[AnyArray, " S"]
) -> Bool[AnyArray, " S"]:
    """True where Levenberg-Marquardt gains too little, see `CREEPS`, by steps that are
    not short.
    """
    damping = states.memory.value
    gains_little = states.cost > (1 - CREEPS) * cost_before
    return gains_little & (damping < _SHORT)


def _better_half(
    states: SolverState, active: Int[np.ndarray, " A"], noise: Any
) -> Int[np.ndarray, " B"]:
    """Indices of the starts that go on, by successive halving: the better half of the
    active ones.

    So do all that are hardly worse than the best start, of the least `c = |r|^2 / 2`:
    `c <= c_min + HARDLY_WORSE max(c_min / R, noise^2 / 2)`.
    """
    order = active[np.argsort(states.cost[active])]
    least = np.nanmin(states.cost)
    variance = max(least / states.residual.shape[-1], 0.5 * noise**2)
    hardly_worse = states.cost[order] <= least + HARDLY_WORSE * variance
    return order[hardly_worse | (np.arange(len(order)) < len(order) // 2)]


def _converged(states: SolverState, enough: float) -> Bool[np.ndarray, " S"]:
    """True where a Gauss-Newton step promises at most the part `enough` of `|r|^2 / R`.

    So it is where the fit is exact up to rounding, and where no step lowers the cost.
    """
    promised, squares = (2 * np.asarray(x, float) for x in (states.gain, states.cost))
    small = promised <= enough * squares / states.residual.shape[-1]
    return small | (squares <= EXACT[str(states.y.dtype)]) | states.stuck


def stacked(problems: Sequence[Any], each: int = 1) -> Any:
    """N problems of one structure as one, with an axis S = N `each` in front: each
    repeated.
    """

    def side_by_side(*leaves: Any) -> Any:
        """A leaf of all problems as one array (S, ...); what is no array is the same in
        all.
        """
        if not eqx.is_array(leaves[0]):
            return leaves[0]
        return np.repeat(np.stack([np.asarray(leaf) for leaf in leaves]), each, axis=0)

    return jax.tree.map(side_by_side, *problems)
