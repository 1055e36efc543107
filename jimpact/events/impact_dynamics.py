"""The dynamics of an impact in its natural units: results do not depend on the user's
units.

With Q the largest normalized approach velocity (or stored energy) of the impact,
contact j has

    x_ref,j = ((eta_j + 1) Q^2 / (2 k_j))^(1 / (eta_j + 1)),
    t_ref,j = x_ref,j / (Q sqrt(W_jj))

and omega_j = T / t_ref,j with T the smallest t_ref: the flow of `contact_flow.py`.
"""

import dataclasses
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jimpact.core.contact import Contact
from jimpact.events import implicit_steps
from jimpact.events.contact_flow import (
    SNAP,
    Chain,
    ContactEquations,
    ContactFlow,
    Coupling,
    Dense,
    Exponent,
    Packing,
    Viscous,
    per_row,
)
from jimpact.events.friction_flow import FrictionFlow
from jimpact.events.implicit_steps import ImplicitSteps
from jimpact.events.plastic_limit import final_impulses
from jimpact.events.run import run
from jimpact.events.slip import SlipFlow
from jimpact.events.tangential_spring import SpringFlow
from jimpact.events.wedged_limit import inspect
from jimpact.numerics.dense import unit
from jimpact.numerics.derive import Arrays, Kind, in_lanes, without_derivatives
from jimpact.numerics.sparse import Neighbours
from jimpact.numerics.step_impulses import descent_lengths
from jimpact.numerics.stepper import any_of
from jimpact.numerics.tangential import TangentialBlock
from jimpact.numerics.tangents import (
    Dual,
    is_dual,
    pushforward,
    value_of,
    without_slope,
)
from jimpact.numerics.tridiagonal import (
    Structure,
    Symmetric,
    diagonal,
    off_diagonal,
    scaled,
)
from jimpact.tools.precision import precision
from jimpact.tools.status import CODE

# Tolerance of a run with derivatives, as a multiple of that of values: derivatives are
# one or two digits worse at the same one. At order 8 these two digits cost a third more
# steps; ten times more would lose one of them.
GRADIENT_TIGHTENING = 0.01
NO_SECOND = (
    "Argument `method` must be 'time' for second derivatives, but has value "
    "'implicit', or 'auto', which is 'implicit' for several contacts with friction in "
    "space: steps that do not end at events have first derivatives only."
)
IMPLICIT_TIGHTENING = 0.1  # the same of method 'implicit', whose steps cost more
# A contact slower than the fastest by more than this factor sees many of its periods,
# whose errors add up, so the tolerance falls with their number. Ten times more: it
# begins to fall too late.
WIDE_SPREAD = 5.0
METHODS = ("auto", "time", "implicit")
# Contacts with friction in space up to which 'auto' is 'time'. More of them change
# between stick and slip thousands of times, one after the other: already of two, some
# impacts do not end.
EXACT_CONTACTS = 1
# Tolerance of the second run that shows how well an outcome is conditioned, as a
# multiple of that of the first one: FINER, or APART coarser where the precision allows
# none so fine. Ten times more: runs that differ too little, or the error of a coarse
# one.
FINER = 0.01
APART = 3.0
# Difference between the two runs, in `rtol`, from which on an outcome is
# ill-conditioned. Ten times more: errors of 100 tolerances are not reported.
ILL = 10.0
# contacts up to which a dense product is faster than shifts by one contact
DENSE_CHAIN = 4


class Problem(NamedTuple):
    """Data of the dimensionless outcome, of one impact or of a batch in the last
    axis.
    """

    off_diagonal: Float[Array, "..."]  # of G, see `off_diagonal`
    omega: Float[Array, "m *B"]
    restitution: Float[Array, "m *B"]
    exponent: Float[Array, "m *B"] | None
    gamma: Float[Array, "m *B"]
    energy: Float[Array, "m *B"]  # x^(eta + 1) of contacts loaded beforehand
    gap: Float[Array, "m *B"] | None  # in units of the indentation
    tolerance: Float[Array, "1 *B"]
    taking_part: Float[Array, "1 *B"]  # contacts that are not open for good
    # of the impulse form: the tolerance, whatever the stiffnesses
    step: Float[Array, "1 *B"]
    viscous: Viscous | None = None
    tangential: "Tangential | None" = None
    limit: Float[Array, "m *B"] | None = None  # indentation at which the force stays


class Tangential(NamedTuple):
    """The tangential block with friction: normalized as the normal one."""

    block: TangentialBlock  # K_nt (m, t), K_tt (t, t), u- (t,)
    friction: Float[Array, "m *B"]  # mu
    stiffness: Float[Array, "m *B"] | None = None  # kappa; None: contacts stick rigidly


class ImpactUnits(NamedTuple):
    """Scales from dimensionless numbers back to SI."""

    velocity: Float[Array, ""]  # Q [m/s sqrt(kg)]
    time: Float[Array, ""]  # T [s]
    root: Float[Array, " m"]  # sqrt(W_jj) [1/sqrt(kg)]
    indentation: Float[Array, " m"]  # x_ref [m]
    error: Float[Array, ""]  # [m/s] that `rtol` allows

    @property
    def momentum(self) -> Float[Array, " m"]:
        """Unit `Q / sqrt(W_jj)` of the impulses [N s]."""
        return self.velocity / self.root


def dimensionless(
    equations: ContactEquations,
    delassus: Symmetric,
    gamma: Float[Array, " m"],
    restitution: Float[Array, ""] | Float[Array, " m"],
    stiffness: Float[Array, ""] | Float[Array, " m"],
    exponent: Exponent,
    stored: Float[Array, " m"],
    rtol: Float[Array, ""] | float,
    gaps: Float[Array, " m"] | None = None,
    closed: Bool[Array, " m"] | None = None,
) -> tuple[Problem, ImpactUnits]:
    """The dimensionless problem and its units; `stored` energies [J], `closed`: who
    takes part.
    """
    m = gamma.shape[0]
    dtype = gamma.dtype
    eta = jnp.broadcast_to(jnp.asarray(exponent, dtype), (m,))
    root = jnp.sqrt(diagonal(delassus))
    qn = gamma / root
    approach = jnp.where(gamma < 0, qn, 0.0)
    energies = approach**2 + 2 * stored
    q = jax.lax.stop_gradient(jnp.sqrt(jnp.max(energies)))
    x_ref = equations.depth(q, stiffness, eta)
    t_ref = x_ref / (q * root)
    time = jax.lax.stop_gradient(jnp.min(t_ref))
    # the tolerance applies to velocities: where W_jj is large, impulses must be finer
    speed_of_stored = jnp.sqrt(2 * stored) * root
    fastest = jnp.max(jnp.maximum(-gamma, speed_of_stored))
    weight = jnp.maximum(1.0, q * root / fastest)
    omega = time / t_ref
    slowest = WIDE_SPREAD * jnp.min(omega)
    closeness = jax.lax.stop_gradient(jnp.minimum(1.0, slowest))
    g = scaled(delassus, 1 / root)
    ones = jnp.ones_like(gamma)
    # errors of many contacts add up
    if closed is None:
        count = jnp.full((), m, dtype)
    else:
        count = jnp.sum(closed, dtype=dtype)
    count = jnp.maximum(count, 1)
    share = jnp.minimum(1.0, 2 / count)
    step = jax.lax.stop_gradient(rtol * share / jnp.max(weight))
    array = None
    if isinstance(exponent, jax.Array):
        array = exponent * ones
    gap = None
    if gaps is not None:
        gap = gaps / x_ref
    problem = Problem(
        off_diagonal=off_diagonal(g),
        omega=omega,
        restitution=restitution * ones,
        exponent=array,
        gamma=qn / q,
        energy=2 * stored / q**2,
        gap=gap,
        tolerance=(step * closeness)[None],
        taking_part=count[None],
        step=step[None],
    )
    error = jax.lax.stop_gradient(rtol * fastest)
    return problem, ImpactUnits(q, time, root, x_ref, error)


def tangential_of(
    contact: Contact,
    friction: Float[Array, ""] | Float[Array, " m"],
    stiffness: Float[Array, ""] | Float[Array, " m"] | None,
    units: ImpactUnits,
) -> Tangential:
    """The tangential block of the contacts in the units of the normal one, mu, kappa or
    None.
    """
    assert contact.tangential_block is not None  # see `check_law`
    block = contact.tangential_block.scaled(units.root, units.velocity)
    ones = jnp.ones_like(units.root)
    if stiffness is None:
        kappa = None
    else:
        kappa = stiffness * ones
    return Tangential(block, friction * ones, kappa)


def normal_coupling(problem: Problem, structure: Structure) -> Float[Array, "m m B"]:
    """G with unit diagonal, from the entries above it: all, or G_j,j+1 of a chain."""
    m = problem.omega.shape[0]
    _, *batch = problem.omega.shape
    if structure == "chain":
        i = jnp.arange(m - 1)
        j = jnp.arange(1, m)
    else:
        i, j = jnp.triu_indices(m, 1)
    zero = jnp.zeros((m, m, *batch), problem.omega.dtype)
    upper = zero.at[i, j].set(problem.off_diagonal)
    return unit(upper) + upper + jnp.swapaxes(upper, 0, 1)


def coupling_of(problem: Problem, structure: Structure) -> Coupling:
    """G in the form in which it is multiplied."""
    if isinstance(structure, Neighbours):
        return Packing(problem.off_diagonal, structure)
    if structure == "chain" and problem.omega.shape[0] > DENSE_CHAIN:
        return Chain(problem.off_diagonal)
    return Dense(normal_coupling(problem, structure))


def first_indentation(
    problem: Problem, exponent: Exponent | None
) -> Float[Array, "m *B"]:
    """Indentations before the impact: `energy^(1 / (eta + 1))` of loaded contacts, else
    minus the gap, or 0 without gaps.

    eta is that of the problem, where it has one that may be traced, else `exponent`.
    """
    eta: Any = exponent
    if problem.exponent is not None:
        eta = problem.exponent
    loaded = problem.energy > 0
    energy = jnp.where(loaded, problem.energy, 1.0)
    x = energy ** (1 / (per_row(eta, energy) + 1))
    if problem.gap is None:
        return jnp.where(loaded, x, 0.0)
    # at gap 0 the derivative is the one-sided one
    return jnp.where(loaded, x, -problem.gap)


def flow_of(
    problem: Problem,
    equations: ContactEquations,
    exponent: Exponent | None,
    structure: Structure,
    with_slopes: bool,
) -> tuple[ContactFlow, Int[Array, "modes B"], Float[Array, "n B"]]:
    """The flow of a problem with a batch in the last axis, its first modes and state.

    It is a `ContactFlow` without friction, a `SpringFlow` with tangential springs, else
    a `FrictionFlow` in the plane, a `SlipFlow` in space. An exponent is `static` unless
    the problem has it as an array.

    `with_slopes`: the run has derivatives. Its tolerance is tighter, by
    `GRADIENT_TIGHTENING`, and a `ContactFlow` whose exponents are an array `watches`
    them.
    """
    m = problem.omega.shape[0]
    viscous = problem.viscous
    if with_slopes:
        tolerance = GRADIENT_TIGHTENING * problem.tolerance
    else:
        tolerance = problem.tolerance
    static = None
    if problem.exponent is None:
        static = exponent
    parts: dict[str, Any] = dict(
        coupling=coupling_of(problem, structure),
        equations=equations,
        omega=problem.omega,
        restitution=problem.restitution,
        exponent_array=problem.exponent,
        tolerance=tolerance,
        taking_part=problem.taking_part,
        viscous=viscous,
        exponent_static=static,
        gapped=problem.gap is not None,
        closed_form=viscous is None and problem.limit is None,
        limit=problem.limit,
        slopes=with_slopes,
    )
    x = first_indentation(problem, exponent)
    if problem.tangential is None:
        watches = with_slopes and problem.exponent is not None
        flow = ContactFlow(**parts, watches=watches)
        return flow, *flow.start(problem.gamma, x)
    (normal_tangent, tangent, slip), friction, kappa = problem.tangential
    parts |= dict(normal_tangent=normal_tangent, tangent=tangent, friction=friction)
    if kappa is not None:
        springs = SpringFlow(**parts, tangential_stiffness=kappa)
        return springs, *springs.start_with(problem.gamma, x, slip)
    if len(slip) == m:
        kind = FrictionFlow
    else:
        kind = SlipFlow
    frictional = kind(**parts)
    return frictional, *frictional.start_with(problem.gamma, x, slip)


def undecided(problem: Problem) -> Bool[Array, "1 B"]:
    """Mask: a contact touches at rest, and its force does not begin at 0.

    It can take any force up to F(0) without motion: whether it moves depends on the
    direction in which anything changes.
    """
    gamma = problem.gamma
    if problem.viscous is None or problem.gap is None:
        return jnp.zeros_like(problem.tolerance, bool)
    none = jnp.zeros_like(gamma)
    at_rest = jnp.abs(gamma) <= SNAP * problem.tolerance
    touches = (problem.gap <= 0) & at_rest
    return any_of(touches & (problem.viscous.push(none, none) > 0))


def begins_with_a_jump(problem: Problem) -> Bool[Array, "1 B"]:
    """Mask: forces jump as a contact closes, or opens, between two steps.

    Its force jumps as a contact opens where F(0, 0) > 0, and as it closes where
    F(0, x') > 0, here with gamma = -1. The only contact of an impact is closed from the
    beginning. Steps of fixed length do not move with the jump, nor do their slopes.
    """
    gamma = problem.gamma
    if problem.viscous is None:
        return jnp.zeros_like(problem.tolerance, bool)
    zero = jnp.zeros_like(gamma)
    jumps = problem.viscous.push(zero, zero) > 0
    if len(gamma) > 1:
        approach = jnp.full_like(gamma, -1.0)
        jumps = jumps | (problem.viscous.push(zero, approach) > 0)
    return any_of(jumps)


def impulses_and_time(
    flow: ContactFlow, y: Float[Array, "n B"]
) -> tuple[Float[Array, "m B"], Float[Array, "t B"], Float[Array, "1 B"]]:
    """p, p_t and the time of a state."""
    time = y[-1:]
    return flow.rows(y).p, flow.side_impulse(y), time


def with_slopes_unless(mask: Bool[Array, "1 B"], p: Any) -> Any:
    """Impulses p, with NaN for each tangent where the `mask` is True."""
    return pushforward(lambda p: without_slope(p, mask), p)


@dataclasses.dataclass(frozen=True)
class ImpulseProgram:
    """Outcomes from the leaves of a `Problem` with a batch in the last axis.

    Results: p (m, B), p_t (t, B); the time of the last event (of the end where
    `with_end_time`: no closed form ends it), the status and the number of passes (1,
    B).
    """

    tree: Any
    equations: ContactEquations
    exponent: float | tuple[float, ...] | None
    structure: Structure
    max_passes: int
    tangents: int = 0  # tangential impulses
    with_end_time: bool = False
    finely: bool = False  # at the tolerance of derivatives
    # its loops have the reverse mode, in the place of the forward mode
    checkpoints: bool = False
    # its impacts need not wait for the slowest (`until_over`)
    queues: ClassVar[bool] = True

    def flow(
        self, problem: Problem, with_slopes: bool
    ) -> tuple[ContactFlow, Int[Array, "modes B"], Float[Array, "n B"]]:
        """The flow of a problem, its first modes and state; see `flow_of`."""
        compiled_in = self.equations, self.exponent, self.structure
        flow, modes, y = flow_of(problem, *compiled_in, with_slopes)
        closed_form = flow.closed_form and not self.with_end_time
        return dataclasses.replace(flow, closed_form=closed_form), modes, y

    @property
    def takes_duals(self) -> bool:
        """True if its arguments may have tangents (see `tangents.py`)."""
        return self.finely

    def results(self, *kinds: Kind) -> tuple[Kind, ...]:
        """Kinds of the results from leaves of these kinds."""
        normal = jax.tree.unflatten(self.tree, kinds).gamma
        tangential = normal._replace(shape=(self.tangents,))
        time = normal._replace(shape=(1,))
        whole = Kind((1,), jnp.dtype(jnp.int32))  # status, passes
        return normal, tangential, time, whole, whole

    def __call__(self, *leaves: Any) -> tuple[Any, ...]:
        """The results from the leaves of a problem; see the class."""
        problem = jax.tree.unflatten(self.tree, leaves)
        flow, modes, y = pushforward(
            lambda problem: self.flow(problem, self.finely), problem
        )
        gamma = value_of(problem.gamma)
        if value_of(flow).at_once:
            state = pushforward(lambda flow, y: flow.finished(modes, y), flow, y)
            results = pushforward(impulses_and_time, flow, state)
            none = jnp.full(gamma.shape, CODE["ok"], jnp.int32)
            return *results, none, none
        end = run(flow, gamma, modes, y, self.max_passes, inspect, self.checkpoints)
        state = end.carry.y
        reached, _, _ = impulses_and_time(value_of(flow), value_of(state))
        p: Any = reached + end.impulse
        if self.finely:
            plastic = pushforward(
                lambda flow, gamma, y: final_impulses(flow, gamma, y, end.carries),
                flow,
                problem.gamma,
                state,
            )
            if is_dual(plastic):
                p = Dual(p, plastic.tangents)
            else:
                p = plastic
        p = with_slopes_unless(undecided(value_of(problem)), p)
        _, p_t, time = pushforward(impulses_and_time, flow, state)
        return p, p_t, time, end.status, end.carry.passes.astype(jnp.int32)


def with_tangents_like(x: Any, value: jax.Array) -> Any:
    """`value` with the tangents of x, if x has some."""
    if is_dual(x):
        return Dual(value, x.tangents)
    return value


@dataclasses.dataclass(frozen=True)
class ImplicitProgram(ImpulseProgram):
    """Outcomes as those of `ImpulseProgram`, by steps without events."""

    def only_first(self, values: Arrays) -> Arrays:
        """The values as they are; a second derivative raises."""
        return without_derivatives(values, NotImplementedError(NO_SECOND))

    def steps(
        self, problem: Problem
    ) -> tuple[ImplicitSteps, implicit_steps.ImplicitState]:
        """The contacts of a problem as `ImplicitSteps`, and their state before the
        impact.

        With friction the coupling is `K = [[G, K_nt], [K_tn, K_tt]]`, and the velocity
        (gamma, u); without it G and gamma. The tolerance is finer with derivatives.
        """
        coupling = coupling_of(problem, self.structure)
        m = problem.omega.shape[0]
        friction = jnp.zeros_like(problem.omega)
        velocity = problem.gamma
        sliding = None
        if problem.tangential is not None:
            (k_nt, k_tt, slip), friction, _ = problem.tangential
            k_tn = jnp.swapaxes(k_nt, 0, 1)
            g_nn = normal_coupling(problem, self.structure)
            normal_rows = jnp.concatenate([g_nn, k_nt], axis=1)
            tangential_rows = jnp.concatenate([k_tn, k_tt], axis=1)
            coupling = Dense(jnp.concatenate([normal_rows, tangential_rows]))
            constant = jax.lax.stop_gradient(coupling.matrix)
            sliding = descent_lengths(constant, m, friction_only=True)
            velocity = jnp.concatenate([velocity, slip])
        tolerance = problem.tolerance
        if self.finely:
            tolerance = tolerance * IMPLICIT_TIGHTENING
        static = None
        if problem.exponent is None:
            static = self.exponent
        flow = ImplicitSteps(
            coupling=coupling,
            equations=self.equations,
            omega=problem.omega,
            restitution=problem.restitution,
            exponent_array=problem.exponent,
            friction=friction,
            descent=jax.lax.stop_gradient(implicit_steps.descent_of(coupling, m)),
            sliding=sliding,
            tolerance=tolerance,
            viscous=problem.viscous,
            exponent_static=static,
            gapped=problem.gap is not None,
        )
        return flow, flow.start(first_indentation(problem, self.exponent), velocity)

    def __call__(self, *leaves: Any) -> tuple[Any, ...]:
        """Normal and tangential impulses (m, B), (t, B), time, status and passes (1,
        B).

        The leaves are those of a `Problem`. Tangents that they carry pass, and
        `only_first` marks the values beside them, so that a second derivative raises;
        the reverse mode of kept checkpoints runs the steps again and needs them plain.
        Where forces jump (`begins_with_a_jump`) tangents of the impulses are NaN.
        """
        if self.checkpoints:
            values = value_of(leaves)
        else:
            values = self.only_first(value_of(leaves))
        first_only = [with_tangents_like(x, v) for x, v in zip(leaves, values)]
        problem = jax.tree.unflatten(self.tree, first_only)
        flow, start = pushforward(self.steps, problem)
        run = implicit_steps.run(flow, start, self.max_passes, self.checkpoints)
        jumps = begins_with_a_jump(jax.tree.unflatten(self.tree, values))
        impulse = with_slopes_unless(jumps, run.state.impulse)
        p, p_t = pushforward(value_of(flow).parts, impulse)
        return p, p_t, run.state.time, self.code(flow, run), run.passes

    def code(
        self, flow: ImplicitSteps, run: implicit_steps.ImplicitRun
    ) -> Int[Array, "1 B"]:
        """Status of a run: max_steps where it has not ended."""
        busy = value_of(flow).busy(value_of(run.state))
        code = jnp.where(busy, CODE["max_steps"], CODE["ok"])
        return code.astype(jnp.int32)


def method_for(
    method: str, contact: Contact, friction: bool, springs: bool = False
) -> str:
    """The method; for 'auto' 'implicit' of several contacts with friction in space,
    else 'time'.

    With tangential `springs` it is 'time', too.
    """
    if method != "auto":
        return method
    in_space = friction and contact.tangents == 2 and not springs
    if in_space and contact.contacts > EXACT_CONTACTS:
        return "implicit"
    return "time"


class Dynamics(NamedTuple):
    """Impact dynamics of a law: its problem, the units, and what is compiled in."""

    problem: Problem
    units: ImpactUnits
    equations: ContactEquations
    exponent: Exponent
    structure: Structure
    max_steps: int
    method: str = "time"
    adjoint: str = "jacobian"

    @property
    def static_exponent(self) -> float | tuple[float, ...] | None:
        """The exponent that is compiled in, None for an array."""
        if isinstance(self.exponent, jax.Array):
            return None
        return self.exponent

    @property
    def tangents(self) -> int:
        """Number of tangential rows t."""
        if self.problem.tangential is None:
            return 0
        return self.problem.tangential.block.slip.shape[0]

    def columns(self) -> tuple[tuple[jax.Array, ...], Any]:
        """The arrays of the problem with the batch last, and its structure."""
        leaves, tree = jax.tree.flatten(self.problem)
        return tuple(x[..., None] for x in leaves), tree

    def program(self, with_end_time: bool = False) -> ImpulseProgram:
        """The program from `columns` to impulses; `with_end_time`: no closed form ends
        it.
        """
        kind = ImpulseProgram
        if self.method == "implicit":
            kind = ImplicitProgram
        _, tree = self.columns()
        return kind(
            tree,
            self.equations,
            self.static_exponent,
            self.structure,
            self.max_steps,
            self.tangents,
            with_end_time=with_end_time,
        )


def solve(
    dynamics: Dynamics, condition_check: Contact | None = None
) -> tuple[Float[Array, " m"], Float[Array, " t"] | None, Int[Array, ""]]:
    """Impulses p and p_t [N s] (None without friction) and the status.

    `condition_check`: the contacts, if a second run is to show whether the outcome is
    `ill_conditioned`. Differentiable in both modes; method 'time' in all orders.
    """
    units = dynamics.units
    problem = dynamics.problem
    leaves, _ = dynamics.columns()
    if condition_check is not None:
        again, _ = dynamics._replace(problem=perturbed(problem)).columns()
        pairs = zip(leaves, again)
        leaves = tuple(jnp.concatenate([x, y], axis=-1) for x, y in pairs)
    program = dynamics.program()
    p, side, _, code, _ = evaluate(program, leaves, dynamics.adjoint)
    p = p * units.momentum[:, None]
    code = code[0]
    p_t = None
    if dynamics.tangents > 0:
        rows = dynamics.tangents // len(units.root)
        p_t = side * jnp.repeat(units.momentum, rows)[:, None]
    if condition_check is not None:
        ill = is_ill_conditioned(condition_check, p, p_t, code, units.error)
        warning = jnp.where(ill, CODE["ill_conditioned"], CODE["ok"])
        code = jnp.maximum(code, warning)
    if p_t is not None:
        p_t = p_t[:, 0]
    return p[:, 0], p_t, code[0]


def is_ill_conditioned(
    contact: Contact,
    p: Float[Array, "m 2"],
    p_t: Float[Array, "t 2"] | None,
    code: Int[Array, "2"],
    error: Float[Array, ""],
) -> Bool[Array, ""]:
    """True if velocities of two runs (columns), the second one at a finer tolerance and
    from data changed in their last digits, differ by more than ILL `error` [m/s], or
    the second one failed.
    """
    first, second = p.T
    difference_t = None
    if p_t is not None:
        first_t, second_t = p_t.T
        difference_t = second_t - first_t
    change = velocity_changes(contact, second - first, difference_t)
    close = jnp.all(jnp.abs(change) <= ILL * error)
    _, second_code = code
    is_resolved = second_code <= CODE["plastic_limit"]  # codes beyond are failures
    return ~(close & is_resolved)


def perturbed(problem: Problem) -> Problem:
    """The problem at another tolerance, gamma- and omega changed in the last digits.

    This shows how far errors grow also where rounding limits them, not the tolerance.
    """
    constant = jax.lax.stop_gradient(problem)
    gamma = constant.gamma
    tolerance = constant.tolerance
    noise = precision(gamma.dtype).noise
    finer = jnp.maximum(FINER * tolerance, noise)
    coarser = APART * jnp.maximum(tolerance, noise)
    odd = jnp.arange(len(gamma), dtype=gamma.dtype) % 2
    change = noise * (1 - 2 * odd)  # contact by contact up and down
    return constant._replace(
        gamma=gamma * (1 + change),
        omega=constant.omega * (1 - change),
        tolerance=jnp.where(APART * finer <= tolerance, finer, coarser),
    )


def velocity_changes(
    contact: Contact, p: Float[Array, " m"], p_t: Float[Array, " t"] | None
) -> Float[Array, " n"]:
    """Changes of gap velocities, `W p + W_nt p_t`, then of slip, `W_nt^T p + W_tt p_t`
    [m/s].
    """
    if p_t is None:
        return contact.delassus @ p
    assert contact.tangential_block is not None
    w = contact.delassus
    w_nt, w_tt, _ = contact.tangential_block
    gamma = w @ p + w_nt @ p_t
    u = w_nt.T @ p + w_tt @ p_t
    return jnp.concatenate([gamma, u])


def evaluate(
    program: ImpulseProgram, leaves: Arrays, adjoint: str = "jacobian"
) -> Arrays:
    """`program(*leaves)` in lanes; its derivatives are those of a run at a finer
    tolerance.
    """
    checkpoints = adjoint == "checkpoints"
    fine = dataclasses.replace(program, finely=True, checkpoints=checkpoints)
    return in_lanes(program, fine, *leaves, adjoint=adjoint)
