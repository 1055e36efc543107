"""Motions in which contact forces of a `Compliant` law act, instead of impacts at an instant."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from jimpact._checks import as_float_array, check_kind, check_shape, check_values, in_common_dtype
from jimpact.bodies.base import Body
from jimpact.compiling import quick_jit
from jimpact.contact import delassus_matrix
from jimpact.events import stepper
from jimpact.events.contact_flow import COMPRESSION, EXPANSION, OPEN, SLACK
from jimpact.events.stepper import any_of
from jimpact.laws.forces import Force
from jimpact.motion.arguments import check_unbounded, contacts_of
from jimpact.motion.dynamics import base_velocity, gaps, kinematics, user_force
from jimpact.motion.event_driven import (
    MotionProblem,
    empty_table,
    event_numbers,
    event_width,
    recorded_events,
    why_stuck,
)
from jimpact.motion.flow import (
    Course,
    Flight,
    MotionFlow,
    Settings,
    State,
    allowed_errors,
    check_rtol,
    first_flight,
    longest_step,
    one_pass,
    packed,
    put,
    roundings,
    sampled_states,
    selected,
    status_at_start,
    step_again,
    toward_sample,
    unpacked,
)
from jimpact.motion.persistent_contact import Contacts, contacts_at
from jimpact.motion.record import KIND_CODE, MOTION_CODE
from jimpact.motion.replays import (
    MotionEnd,
    MotionPlan,
    MotionTable,
    differentiable,
    empty_plan,
    samples_before,
    tables_of,
    walk,
)
from jimpact.motion.system import System
from jimpact.motion.transitions import After, Passed, no_jump
from jimpact.scene import gap_velocity

# Rows of a plan: a contact takes some tens of steps. Ten times more takes ten times the memory of
# derivatives.
ROWS_PER_EVENT = 64
# Of the errors allowed: margins closer to 0 are 0. Ten times more, and events are off by a tenth
# of the tolerance.
SNAP = 1e-2
SLOWEST = 1e-12  # [m/s] scale of contacts that have not moved yet; any small one would do


class ContactScales(NamedTuple):
    """Scales of each contact (m,), from its fastest approach so far."""

    speed: jax.Array  # [m/s]
    depth: jax.Array  # [m] indentation at that speed
    force: jax.Array  # [N] at that indentation
    impulse: jax.Array  # [N s]


def _contact_scales(force: Force, contacts: Contacts, fastest: jax.Array) -> ContactScales:
    """The scales that belong to these speeds (m,)."""
    speed, w = jnp.maximum(fastest, SLOWEST), jnp.diagonal(contacts.delassus)
    depth = force.indentation_scale(0.5 * speed**2 / w)
    return jax.lax.stop_gradient(
        ContactScales(speed, depth, force.force(depth, jnp.zeros_like(depth)), speed / w)
    )


class CompliantFlow(MotionFlow):
    """Forces of contacts of which each is open, in compression, in expansion, or slack.

    Equation: `M q'' = (loads) + N F(x, x')`, `x' = -f'` (in expansion `-f' / e^2`).

    The indentation x is a row of the state, -gap before the contact first closes: a plastic contact
    keeps a residual indentation, at which it closes again. Modes (rows): the phase of each contact,
    as in `events/contact_flow.py`. Margins: by indentation, then by velocity.
    """

    force: Force
    scales: ContactScales

    def constants(self, modes: jax.Array) -> jax.Array:
        """The phase of each contact."""
        return modes[:, 0]

    def field(self, const: jax.Array, modes: jax.Array, y: jax.Array) -> jax.Array:
        """Rates of the state."""
        at = unpacked(self.like, y)
        contacts = contacts_at(self.system, at.q, at.v, at.t, False)
        x, gamma = at.contact[0], contacts.normal.rate
        loaded = (const == COMPRESSION) | (const == EXPANSION)
        push = self.force.force(jnp.where(x >= 0, x, 0.0), -gamma)
        push = jnp.where(loaded, jnp.maximum(push, 0.0), 0.0)
        closing = -gamma
        bistiffness = self.force.bistiffness
        if bistiffness is not None:
            e = jnp.where(bistiffness.restitution > 0, bistiffness.restitution, 1.0)
            closing = jnp.where(const == EXPANSION, closing / e**2, closing)
        carried = base_velocity(self.system, at.t)
        base = jnp.zeros_like(at.t)
        if carried is not None:
            base = (contacts.normal.gradient @ push) @ carried
        rates = State(
            q=self.system.body.rates(at.q, at.v),
            v=contacts.free + contacts.moved @ push,
            t=jnp.ones_like(at.t),
            work=user_force(self.system, at.q, at.v, at.t) @ at.v,
            base_work=base,
            contact_work=jnp.stack([push * gamma, jnp.zeros_like(push)]),
            contact=jnp.stack([closing, push]),
        )
        return self.regular(rates, at)

    def margins(self, const: jax.Array, modes: jax.Array, y: jax.Array) -> jax.Array:
        """Where a gap closes, a force ends or returns; where compression turns."""
        at = unpacked(self.like, y)
        rate, x = kinematics(self.system, at.q, at.v, at.t).rate, at.contact[0]
        gamma, depth = rate / self.scales.speed, x / self.scales.depth
        if self.force.slackens:
            onset = self.force.onset(x, -rate) / self.scales.force
            by_x = jnp.where(const == COMPRESSION, onset, -onset)
            by_g = jnp.where(const == SLACK, depth, 1.0)
        else:
            by_x = jnp.where(const == EXPANSION, depth, 1.0)
            by_g = jnp.where(const == COMPRESSION, -gamma, gamma)
        by_x = jnp.where(const == OPEN, -depth, by_x)
        by_g = jnp.where(const == OPEN, 1.0, by_g)
        return self.from_margins(jnp.concatenate([by_x, by_g]), at)

    def rooted(self, modes: jax.Array) -> jax.Array:
        """Openings, by the root of the indentation."""
        opens = modes == EXPANSION
        rest = jnp.zeros((self.rounding.shape[0] - modes.shape[0], 1), bool)
        return jnp.concatenate([opens, rest])

    def switch(
        self, modes: jax.Array, y: jax.Array, which: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Phases after an event; a contact that closes or opens has no indentation."""
        at, m = unpacked(self.like, y), modes.shape[0]
        phase, by_x, by_g = modes[:, 0], which[:m, 0], which[m : 2 * m, 0]
        closed = by_x & (phase == OPEN)
        if self.force.slackens:
            after = jnp.where(by_x & (phase == COMPRESSION), SLACK, phase)
            after = jnp.where(by_x & (phase == SLACK), COMPRESSION, after)
            opened = by_g & (phase == SLACK)
        else:
            turned = by_g & (phase == COMPRESSION)
            after = jnp.where(turned, EXPANSION, phase)
            after = jnp.where(by_g & (phase == EXPANSION), COMPRESSION, after)
            opened = by_x & (phase == EXPANSION)
            if self.force.bistiffness is not None:  # e = 0 returns nothing
                opened = opened | (turned & (self.force.bistiffness.restitution == 0))
        after = jnp.where(opened, OPEN, jnp.where(closed, COMPRESSION, after))
        x, impulse = at.contact
        contact = jnp.stack([jnp.where(opened | closed, 0.0, x), jnp.where(closed, 0.0, impulse)])
        return after[:, None].astype(modes.dtype), packed(at._replace(contact=contact))

    def begins(self, before: jax.Array, after: jax.Array) -> jax.Array:
        """Where a force sets in."""
        return any_of((after == COMPRESSION) & ((before == OPEN) | (before == SLACK)))


class _CompliantRun(NamedTuple):
    """A motion with contact forces up to now."""

    flight: Flight
    fastest: jax.Array  # (m,) approach so far [m/s]
    table: MotionTable
    event_count: jax.Array
    status: jax.Array
    apart: jax.Array  # whether all contacts are open and none closes
    plan: MotionPlan | None


class _PlanRow(NamedTuple):
    """Of a plan: a pass, perhaps an accepted step, perhaps an event at its end."""

    accepted: jax.Array  # ()
    written: jax.Array  # ()
    aim: stepper.Step
    fastest: jax.Array  # (m,)


def compliant_motion(
    problem: MotionProblem, max_events: int, until_apart: bool = False
) -> tuple[Course, State, jax.Array]:
    """The motion from `times[0]` to `times[-1]`, or until no contact works any more.

    Returns:
        The course, the last state, and whether all contacts are open and none closes in it.
    """
    end = differentiable(
        problem,
        lambda problem, records: _run(problem, max_events, until_apart, records),
        lambda problem, plan: _again(problem, plan, max_events),
    )
    start = _start(problem)
    samples = sampled_states(end.table.samples, start, end.reached)
    events = recorded_events(end.table, end.event_count, problem)
    last = unpacked(start, end.table.samples[-1][:, None])
    assert end.more is not None
    return Course(samples, events, end.steps, end.status), last, end.more


def _start(problem: MotionProblem) -> State:
    """The state at the beginning: contacts are as deep as their gaps say."""
    gap = gaps(problem.system, problem.q0, problem.times[0])
    x = jnp.where(jnp.abs(gap) <= problem.settings.closed_below, 0.0, -gap)
    return problem.start._replace(contact=jnp.stack([x, jnp.zeros_like(x)]))


def _run(problem: MotionProblem, max_events: int, until_apart: bool, records: bool) -> MotionEnd:
    """From pass to pass; with its plan, if it `records`."""
    start = _begin(problem, max_events, records)

    def going(run: _CompliantRun) -> jax.Array:
        on = (run.status == MOTION_CODE["ok"]) & (run.flight.sample < problem.times.shape[0])
        return on & ~run.apart if until_apart else on

    end = jax.lax.while_loop(going, lambda run: _one_pass(problem, max_events, run), start)
    last = packed(end.flight.state)[:, 0]
    table = end.table._replace(samples=end.table.samples.at[-1].set(last))
    flight = end.flight
    return MotionEnd(
        table, flight.sample, end.event_count, flight.steps, end.status, end.plan, end.apart
    )


def _begin(problem: MotionProblem, max_events: int, records: bool) -> _CompliantRun:
    """The run before its first pass: phases follow from gaps and their rates."""
    system, force, _, settings, _, _, times, m, _ = problem
    state = _start(problem)
    x, gamma = state.contact[0], kinematics(system, state.q, state.v, state.t).rate
    phase = jnp.where((x > 0) | ((x == 0) & (gamma <= 0)), COMPRESSION, OPEN)
    if not force.slackens:
        phase = jnp.where((x > 0) & (gamma > 0), EXPANSION, phase)
    flight = first_flight(system, state, phase[:, None].astype(jnp.int32), 2 * m, times)
    flight = toward_sample(flight, times, flight.free)
    fastest, no = jnp.maximum(-gamma, 0.0), jnp.asarray(False)
    plan = None
    if records:
        row = _PlanRow(no, no, flight.aim, fastest)
        steps = settings.max_steps
        plan = empty_plan(row, times.shape[0], max_events, ROWS_PER_EVENT, steps)
    return _CompliantRun(
        flight,
        fastest,
        empty_table(problem, state, max_events),
        jnp.int32(0),
        status_at_start(system, state, times[-1], jnp.inf),
        jnp.all((phase == OPEN) & (gamma >= 0)),
        plan,
    )


def _one_pass(problem: MotionProblem, max_events: int, run: _CompliantRun) -> _CompliantRun:
    """One pass of the stepper, and what it shows."""
    system, times, flight = problem.system, problem.times, run.flight
    flow, settings = _flow(problem, flight.state, run.fastest), problem.settings
    ledger = allowed_errors(system, settings, flight.state, 1.0)[: -2 * problem.contacts]
    depth, impulse = flow.scales.depth, flow.scales.impulse
    rows = jnp.concatenate([ledger, settings.rtol * depth, settings.rtol * impulse])
    flown, accept = one_pass(flow, settings, rows, times, flight)
    at, before, after = flown.state, flight.aim.modes[:, 0], flown.aim.modes[:, 0]
    closed, opened = (before == OPEN) & (after != OPEN), (before != OPEN) & (after == OPEN)
    gamma = kinematics(system, at.q, at.v, at.t).rate
    happened = jnp.any(closed | opened)
    full = happened & (run.event_count >= max_events)
    written = happened & ~full
    status = jnp.where(full, MOTION_CODE["max_events"], run.status)
    status = jnp.where(flown.stuck, why_stuck(system, flown, problem.q0, times), status)
    kind = jnp.where(jnp.any(closed), KIND_CODE["contact"], KIND_CODE["detachment"])
    marks = jnp.concatenate([jnp.stack([kind, 0 * kind]), (closed | opened).astype(kind.dtype)])
    index = jnp.where(written, run.event_count, max_events)
    table = MotionTable(
        put(run.table.samples, packed(at)[:, 0], flight.sample),
        put(run.table.events, _event(problem, at, opened), index),
        put(run.table.marks, marks, index),
    )
    plan = run.plan
    if plan is not None:
        plan = plan.with_row(_PlanRow(accept, written, flight.aim, run.fastest), accept)
    return _CompliantRun(
        flown,
        jnp.maximum(run.fastest, jnp.maximum(-gamma, 0.0)),
        table,
        run.event_count + written.astype(jnp.int32),
        status.astype(jnp.int32),
        jnp.all((after == OPEN) & (gamma >= 0)),
        plan,
    )


def _event(problem: MotionProblem, at: State, opened: jax.Array) -> jax.Array:
    """Numbers of an event: the impulse of contacts that have `opened` (m,); velocities go on."""
    none = no_jump(at, problem.contacts, problem.sides)
    zero = jnp.zeros_like(at.t)
    jump = none._replace(impulse=jnp.where(opened, at.contact[1], 0.0))
    return event_numbers(at, After(at, jump, Passed(zero, zero)))


def _flow(problem: MotionProblem, at: State, fastest: jax.Array) -> CompliantFlow:
    """The flow from this state on, on the scales of the contacts so far."""
    system, force, _, settings, _, _, times, m, _ = problem
    scales = _contact_scales(force, contacts_at(system, at.q, at.v, at.t, False), fastest)
    share = jnp.full(2 * m, SNAP * settings.rtol, at.q.dtype)
    rounded, longest = roundings(settings, share, times), longest_step(system, times)
    blank = jnp.zeros((len(packed(at)), 1), at.q.dtype)
    return CompliantFlow(
        system, rounded, times[0], settings.rtol, blank, at, longest, force, scales
    )


def _again(
    problem: MotionProblem, plan: MotionPlan, max_events: int
) -> tuple[jax.Array, jax.Array]:
    """Samples and events of a run, as a smooth function of the problem and the force."""
    times, start = problem.times, _start(problem)
    rows: _PlanRow = jax.tree.map(lambda x: x[: plan.size], plan.rows)
    used = jnp.arange(plan.size, dtype=jnp.int32) < plan.used
    accepted = rows.accepted & used
    sampled = accepted & rows.aim.target[:, -1, 0]

    def one(state: State, x: Any) -> tuple[State, Any]:
        """One row of the plan."""
        row, sample = x
        aim = row.aim._replace(modes=row.aim.modes.astype(jnp.int32))
        flow = _flow(problem, state, row.fastest)
        flow = eqx.tree_at(lambda f: f.sample, flow, times[sample])
        state = selected(row.accepted, step_again(flow, aim, state), state)
        after = flow.switch(aim.modes, packed(state), aim.target)[0]
        opened = (aim.modes != OPEN) & (after == OPEN)
        return state, (packed(state)[:, 0], _event(problem, state, opened[:, 0]))

    todo = rows._replace(accepted=accepted), samples_before(sampled)
    went = walk(one, start, todo, accepted, event_width(problem))
    sizes = times.shape[0], max_events + 1
    written = rows.written & accepted
    samples, events = tables_of(problem, plan, start, went, sampled, written, sizes)
    last = went.states[jnp.maximum(plan.used - 1, 0)]
    last = jnp.where(plan.used > 0, last, packed(start)[:, 0])
    return samples.at[-1].set(jnp.where(plan.lost, samples[-1], last)), events


RTOL = 1e-9  # of `turning_impact`
HORIZON = 200.0  # contact times after which an impact is given up; more only delays that
MOST_EVENTS = 1000  # contacts that close or open in one impact; ten times more takes memory only
PENETRATION = 1e-12  # [m] gaps this small are closed where an impact starts, as in `Body.scene`


class TurningImpact(eqx.Module):
    """`velocity` and `position` (n,) when it is over, `duration` () [s], whether it `ended`."""

    velocity: jax.Array
    position: jax.Array
    duration: jax.Array
    ended: jax.Array


def turning_impact(
    gap_function: Body | Callable[[jax.Array], jax.Array],
    mass: Any,
    q: Any,
    velocity: Any,
    force: Force,
    *,
    rtol: float = RTOL,
    max_steps: int = 20_000,
) -> TurningImpact:
    """Compliant impact with M(q) and the gaps f(q) followed: a motion without loads.

    Equation: `M q'' + M' q' - grad_q(q'^T M q') / 2 = grad f(q) F`, until nothing is loaded and no
    gap shrinks. `impact(Compliant(force), scene, velocity)` is the same with M and grad f frozen at
    q; they differ by the order of indentation over size.

    Args:
        gap_function: a `Body` (then `mass` is None), or q (n,) -> gaps (m,) [m].
        mass: M (n,) or (n, n), or a function q -> M(q).
        q: (n,) configuration before, with no penetration.
        velocity: (n,) [m/s, rad/s].
        force: as in `Compliant`.
        rtol: of q, q' and the indentations.
        max_steps: of the integrator.

    Returns:
        `TurningImpact`; `ended` False where it went on for 200 contact times or `max_steps`.
        Derivatives in both modes.

    Raises:
        ValueError: sizes, NaN, penetration, a mass that is not positive, an `rtol` that single
            precision cannot reach. TypeError: no `Force`.

    >>> import jimpact as ji
    >>> block, q, v = ji.Block(1.0, 1.0), [0.0, 0.5, 0.0], [0.0, -0.5, -1.0]
    >>> out = ji.turning_impact(block, None, q, v, ji.Hertz(1e8))
    >>> bool(out.ended), [round(float(v), 2) for v in out.velocity[1:]]
    (True, [0.61, 0.49])
    """
    position, v = as_float_array("q", q), as_float_array("velocity", velocity)
    check_shape("velocity", v, position.shape, "one per coordinate")
    check_values("velocity", v)
    check_kind("force", force, Force)
    check_unbounded("force", force)
    system, force, position, v = in_common_dtype(System(gap_function, mass), force, position, v)
    check_rtol(rtol, position.dtype)
    scene = system.body.scene(position)  # and its checks
    gamma = gap_velocity(scene, v)
    speed = jnp.max(jnp.where(gamma < 0, -gamma, 0.0))
    speed = jnp.where(speed > 0, speed, 1.0)
    reduced = jnp.max(1 / jnp.diagonal(jnp.asarray(delassus_matrix(scene))))
    depth = force.indentation_scale(0.5 * reduced * speed**2 * jnp.ones_like(gamma))
    unit = jax.lax.stop_gradient(jnp.max(depth) / speed)
    return _turning(system, force, position, v, HORIZON * unit, rtol, max_steps)


@quick_jit
def _turning(
    system: System,
    force: Force,
    q: jax.Array,
    v: jax.Array,
    horizon: jax.Array,
    rtol: float,
    max_steps: int,
) -> TurningImpact:
    """The impact as one program, from time 0 to `horizon` () [s] at most."""
    zero = jnp.zeros_like(horizon)
    settings = Settings(
        rtol,
        rtol * 1e-3,
        jnp.asarray(PENETRATION),
        zero,
        max_steps,
        False,
        False,
        horizon,
        zero,
    )
    times, m = jnp.stack([zero, horizon]), contacts_of(system, q)
    problem = MotionProblem(system, force, None, settings, q, v, times, m)
    _, end, apart = compliant_motion(problem, MOST_EVENTS, True)
    return TurningImpact(end.v, end.q, end.t, apart)
