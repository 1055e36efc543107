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
from jimpact.events.batches import any_lane
from jimpact.events.contact_flow import COMPRESSION, EXPANSION, OPEN, SLACK
from jimpact.events.stepper import any_of
from jimpact.laws.forces import Force
from jimpact.motion.arguments import check_unbounded, contacts_of
from jimpact.motion.dynamics import (
    gaps,
    kinematics,
    kinematics_with_tangents,
    not_rounding,
    user_force,
)
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
    friction_margins,
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
from jimpact.motion.persistent_contact import (
    Contacts,
    Forces,
    Modes,
    by_contact,
    choose_with_friction,
    cone_margins,
    constraint_impulse,
    contact_powers,
    contacts_at,
    direction,
    forces,
    friction_acceleration,
    length,
    no_modes,
    rest_acceleration,
    with_normal_forces,
)
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
from jimpact.motion.slip_in_space import slip_axes
from jimpact.motion.system import System
from jimpact.motion.transitions import (
    REST_SPEED,
    After,
    Passed,
    no_jump,
    slip_stops,
    velocity_noise,
)
from jimpact.scene import gap_velocity

# Rows of a plan: a contact takes some tens of steps. Ten times more takes ten times the memory of
# derivatives.
ROWS_PER_EVENT = 64
# Of the errors allowed: margins closer to 0 are 0. Ten times more, and events are off by a tenth
# of the tolerance.
SNAP = 1e-2
# Longest step, in the time in which the stiffest or most damped contact moves by one radian. Of a
# body at rest on its springs steps see no error. Ten times more: derivatives of its oscillations
# are wrong; a hundred times more: they grow by 1e11 in a step.
STABLE = 0.5
# Of the cone: contacts that have reached its rim stick only if others take over more than this.
# Ten times more: contacts that share what they hold slide one after the other.
WITHIN = 1e-6
SLOWEST = 1e-12  # [m/s] scale of contacts that have not moved yet; any small one would do


class ContactScales(NamedTuple):
    """Scales of each contact (m,), from its fastest approach so far."""

    speed: jax.Array  # [m/s]
    depth: jax.Array  # [m] indentation at that speed
    force: jax.Array  # [N] at that indentation
    impulse: jax.Array  # [N s]
    slip: jax.Array  # () [m/s] of the whole motion so far


class Phases(NamedTuple):
    """Of each contact (m,): its phase, and how it slides or sticks while its force acts."""

    phase: jax.Array
    side: Modes


def _contact_scales(force: Force, contacts: Contacts, fastest: jax.Array) -> ContactScales:
    """The scales that belong to these speeds (m,) of approach, and of slip after them."""
    m = len(contacts.normal.rate)
    w, slip = jnp.diagonal(contacts.delassus)[:m], jnp.maximum(jnp.max(fastest), SLOWEST)
    speed = jnp.maximum(fastest[:m], SLOWEST)
    depth = force.indentation_scale(0.5 * speed**2 / w)
    return jax.lax.stop_gradient(
        ContactScales(speed, depth, force.force(depth, jnp.zeros_like(depth)), speed / w, slip)
    )


class CompliantFlow(MotionFlow):
    """Forces of contacts of which each is open, in compression, in expansion, or slack.

    Equation: `M q'' = (loads) + N F(x, x') + H lambda_t`, `x' = -f'` (in expansion `-f' / e^2`);
    `lambda_t` holds contacts that stick (`h'' = 0`), and is `-mu F u / |u|` at those that slide.

    The indentation x is a row of the state, -gap before the contact first closes: a plastic contact
    keeps a residual indentation, at which it closes again. Modes (rows): the phase of each contact,
    as in `events/contact_flow.py`; with friction whether it sticks and the sign of its sliding.
    Margins: by indentation, then by velocity, then what is left of the cone or of slip.
    """

    force: Force
    scales: ContactScales

    @property
    def speed_scale(self) -> jax.Array:
        """The largest gap velocity or slip so far."""
        return self.scales.slip

    def constants(self, modes: jax.Array) -> Phases:
        """Phases and friction."""
        return phases_of(modes, self.like)

    def pushed(self, const: Phases, at: State) -> tuple[Contacts, Forces]:
        """Contact space with the normal forces that act, and the forces."""
        contacts = self.contacts(at)
        push = _normal_forces(self.force, const.phase, contacts, at)
        if self.mu is None:
            return contacts, Forces(push, None, contacts.free + contacts.moved @ push)
        known = with_normal_forces(contacts, push)
        return known, forces(known, self.mu, const.side, self.slip(const.side, known))

    def field(self, const: Phases, modes: jax.Array, y: jax.Array) -> jax.Array:
        """Rates of the state."""
        at = unpacked(self.like, y)
        contacts, force = self.pushed(const, at)
        gamma, push = contacts.normal.rate, force.normal
        closing = _unloading(self.force, const.phase, -gamma)
        friction, base = contact_powers(self.system, contacts, force, at.t)
        remembered = [closing, push]
        if force.tangential is not None:
            remembered.extend(by_contact(self.along_tangents(force.tangential), len(push)).T)
        rates = State(
            q=self.system.body.rates(at.q, at.v),
            v=force.acceleration,
            t=jnp.ones_like(at.t),
            work=user_force(self.system, at.q, at.v, at.t) @ at.v,
            base_work=base,
            contact_work=jnp.stack([push * gamma, friction]),
            contact=jnp.stack(remembered),
        )
        return jnp.concatenate(self.rows_of(rates, at, const.side, contacts, force))

    def along_tangents(self, tangential: jax.Array) -> jax.Array:
        """Tangential forces, in space along the tangents of the body."""
        if self.axes is None:
            return tangential
        along = self.axes.along
        across = jnp.stack([-along[:, 1], along[:, 0]], axis=1)
        each = by_contact(tangential, len(along))
        return (each[:, :1] * along + each[:, 1:] * across).reshape(-1)

    def margins(self, const: Phases, modes: jax.Array, y: jax.Array) -> jax.Array:
        """Where a gap closes, a force ends or returns; where compression or friction turns."""
        at = unpacked(self.like, y)
        if self.mu is None:
            rate = kinematics(self.system, at.q, at.v, at.t).rate
            return self.from_margins(self._normal_margins(const.phase, rate, at.contact[0]), at)
        contacts, force = self.pushed(const, at)
        normal = self._normal_margins(const.phase, contacts.normal.rate, at.contact[0])
        zero = jnp.zeros_like(at.t)
        side = friction_margins(
            contacts, self.mu, const.side, force, zero + 1, zero, self.scales.slip
        )
        return self.from_margins(jnp.concatenate([normal, side]), at)

    def _normal_margins(self, const: jax.Array, rate: jax.Array, x: jax.Array) -> jax.Array:
        """By indentation, then by velocity (2 m,)."""
        gamma, depth = rate / self.scales.speed, x / self.scales.depth
        if self.force.slackens:
            onset = self.force.onset(x, -rate) / self.scales.force
            by_x = jnp.where(const == COMPRESSION, onset, -onset)
            by_g = jnp.where(const == SLACK, depth, 1.0)
        else:
            by_x = jnp.where(const == EXPANSION, depth, 1.0)
            by_g = jnp.where(const == COMPRESSION, -gamma, gamma)
        by_x = jnp.where(const == OPEN, -depth, by_x)
        return jnp.concatenate([by_x, jnp.where(const == OPEN, 1.0, by_g)])

    def rooted(self, modes: jax.Array) -> jax.Array:
        """Openings, by the root of the indentation."""
        opens = self.constants(modes).phase[:, None] == EXPANSION
        rest = jnp.zeros((self.rounding.shape[0] - opens.shape[0], 1), bool)
        return jnp.concatenate([opens, rest])

    def switch(
        self, modes: jax.Array, y: jax.Array, which: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Phases after an event; a contact that closes or opens has no indentation."""
        at, (phase, side) = unpacked(self.like, y), self.constants(modes)
        m = len(phase)
        by_x, by_g = which[:m, 0], which[m : 2 * m, 0]
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
        x, impulses = at.contact[:1], at.contact[1:]
        indentation = jnp.where(opened | closed, 0.0, x)
        contact = jnp.concatenate([indentation, jnp.where(closed, 0.0, impulses)])
        rows = after
        if self.mu is not None:  # friction starts anew with the force
            keeps = _loaded(phase) & _loaded(after)
            rows = _mode_rows(Phases(after, side._replace(active=keeps)))
        state = packed(at._replace(contact=contact))
        state = jnp.concatenate([state, y[len(state) :]])  # and spare rows as they are
        return rows[:, None].astype(modes.dtype), state

    def begins(self, before: jax.Array, after: jax.Array) -> jax.Array:
        """Where a force sets in."""
        before, after = (self.constants(x).phase[:, None] for x in (before, after))
        return any_of((after == COMPRESSION) & ((before == OPEN) | (before == SLACK)))

    def projected(self, const: Phases, at: State) -> State:
        """Slip of contacts that stick set to 0, in the metric of M."""
        return at if self.mu is None else self.stopped(const.side.active & const.side.stick, at)

    def stopped(self, which: jax.Array, at: State) -> State:
        """Slip of contacts (m,) set to 0."""
        contacts, one = self.contacts(at), jnp.ones_like(at.contact_work[0])
        known = with_normal_forces(contacts, jnp.zeros_like(contacts.normal.rate))
        assert known.tangent is not None
        rates = jnp.concatenate([jnp.zeros_like(contacts.normal.rate), known.tangent.rate])
        p = constraint_impulse(known, self.mu, Modes(which, which, one), rates)
        return at._replace(v=at.v + contacts.moved @ p)


def _loaded(phase: jax.Array) -> jax.Array:
    """Whether the force of a contact acts."""
    return (phase == COMPRESSION) | (phase == EXPANSION)


def _normal_forces(force: Force, phase: jax.Array, contacts: Contacts, at: State) -> jax.Array:
    """Forces (m,) [N] of contacts in these phases."""
    x = at.contact[0]
    push = force.force(jnp.where(x >= 0, x, 0.0), -contacts.normal.rate)
    return jnp.where(_loaded(phase), jnp.maximum(push, 0.0), 0.0)


def phases_of(modes: jax.Array, like: State) -> Phases:
    """The phases of such rows (m, 1) of modes, with friction (3 m, 1)."""
    m = like.contact_work.shape[1]
    phase = modes[:m, 0]
    none = no_modes(m, like.q.dtype)
    if len(modes) == m:
        return Phases(phase, none)
    stick, sign = modes[m:, 0].reshape(2, -1)
    acts = _loaded(phase) & ((stick > 0) | (sign != 0))
    return Phases(phase, Modes(acts, stick > 0, sign.astype(none.sign.dtype)))


def _mode_rows(now: Phases) -> jax.Array:
    """Rows (3 m,) of modes with friction; 0 where none acts."""
    friction = jnp.stack([x.astype(jnp.int32) for x in now.side[1:]])
    friction = jnp.where(now.side.active, friction, 0)
    return jnp.concatenate([now.phase.astype(jnp.int32), *friction])


class _CompliantRun(NamedTuple):
    """A motion with contact forces up to now."""

    flight: Flight
    fastest: jax.Array  # approach (m,) [m/s] so far, with friction slip (m,), too
    table: MotionTable
    event_count: jax.Array
    status: jax.Array
    apart: jax.Array  # whether all contacts are open and none closes
    plan: MotionPlan | None


class _PlanRow(NamedTuple):
    """Of a plan: a pass, perhaps an accepted step, perhaps an event at its end."""

    accepted: jax.Array  # ()
    written: jax.Array  # ()
    stopped: jax.Array  # (m,) contacts whose slip stops at its end
    aim: stepper.Step
    fastest: jax.Array


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
    sides = 0 if problem.mu is None else problem.sides // problem.contacts
    impulses = jnp.zeros((1 + sides, len(x)), x.dtype)
    return problem.start._replace(contact=jnp.concatenate([x[None], impulses]))


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
    system, force, mu, settings, _, _, times, m, _ = problem
    state = _start(problem)
    gamma, slip = _rates(problem, state)
    x = state.contact[0]
    phase = jnp.where((x > 0) | ((x == 0) & (gamma <= 0)), COMPRESSION, OPEN)
    if not force.slackens:
        phase = jnp.where((x > 0) & (gamma > 0), EXPANSION, phase)
    phase, watched, fastest = phase.astype(jnp.int32), 2 * m, jnp.maximum(-gamma, 0.0)
    if mu is not None:
        phase = _mode_rows(Phases(phase, no_modes(m, x.dtype)))
        watched, fastest = 3 * m, jnp.concatenate([fastest, slip])
    flight = first_flight(system, state, phase[:, None], watched, times)
    contacts = contacts_at(system, state.q, state.v, state.t, False)
    stable = _stable_step(force, flight.aim.modes, contacts, state)
    flight = toward_sample(flight, times, jnp.minimum(flight.free, stable))
    flight = flight._replace(event=flight.event.at[:m].set(True))  # friction is to be decided
    no = jnp.asarray(False)
    plan = None
    if records:
        row = _PlanRow(no, no, jnp.zeros(m, bool), flight.aim, fastest)
        steps = settings.max_steps
        plan = empty_plan(row, times.shape[0], max_events, ROWS_PER_EVENT, steps)
    return _CompliantRun(
        flight,
        fastest,
        empty_table(problem, state, max_events),
        jnp.int32(0),
        status_at_start(system, state, times[-1], jnp.inf),
        jnp.all((phase[:m] == OPEN) & (gamma >= 0)),
        plan,
    )


def _rates(problem: MotionProblem, at: State) -> tuple[jax.Array, jax.Array]:
    """Gap velocities (m,) and speeds of slip (m,), 0 without friction."""
    if problem.mu is None:
        gamma = kinematics(problem.system, at.q, at.v, at.t).rate
        return gamma, jnp.zeros_like(gamma)
    normal, tangent = kinematics_with_tangents(problem.system, at.q, at.v, at.t)
    return normal.rate, length(by_contact(tangent.rate, problem.contacts))


def _with_friction(problem: MotionProblem, run: _CompliantRun) -> _CompliantRun:
    """Which contacts stick or slide, decided anew after an event."""
    system, force, mu, settings, *_ = problem
    if mu is None:
        return run
    at, m, event = run.flight.state, problem.contacts, run.flight.event

    def decided() -> tuple[jax.Array, jax.Array]:
        """Modes, and whether they were found."""
        phase, side = phases_of(run.flight.aim.modes, at)
        contacts = contacts_at(system, at.q, at.v, at.t, True)
        known = with_normal_forces(contacts, _normal_forces(force, phase, contacts, at))
        scale, slip = jnp.max(run.fastest), _rates(problem, at)[1]
        stopped = slip_stops(settings, side, event[2 * m :], slip, scale)
        let_go = (event[2 * m :] & side.stick) | stopped
        released = jnp.concatenate([jnp.zeros_like(let_go), let_go])
        fastest = jnp.max(jnp.abs(known.approach))
        rest = not_rounding(REST_SPEED, slip.dtype) * scale + velocity_noise(settings, fastest)
        slides, slack = (slip > rest) & ~stopped, rest_acceleration(slip.dtype) * fastest
        loaded = _loaded(phase)
        choice = choose_with_friction(known, mu, side, loaded, released, slides, slack)
        # corners that sink in differently are nearly redundant: they stick where the forces of the
        # flow, which share what they hold, can hold them
        assert known.tangent is not None
        moves = direction(by_contact(known.tangent.rate, m))
        still = Modes(loaded, loaded & ~slides, jnp.where(slides, moves[:, 0], 1.0))
        if settings.spatial:
            still = still._replace(sign=jnp.ones_like(still.sign))
        held = forces(known, mu, still, jnp.where(slides[:, None], moves, 0.0))
        left = cone_margins(known, mu, held)
        least = jnp.where(let_go, WITHIN * friction_acceleration(known, mu, held.normal), 0.0)
        sticks = jnp.all(~still.stick | (left >= least))
        chosen = selected(sticks, still, choice.modes)
        if settings.spatial:  # a force that changes as fast as in a contact has slip begin at once
            chosen = chosen._replace(sign=jnp.ones_like(chosen.sign))
        return _mode_rows(Phases(phase, chosen))[:, None], choice.consistent | sticks

    old = run.flight.aim.modes, jnp.asarray(True)
    asked = jnp.any(event)
    modes, found = selected(asked, jax.lax.cond(any_lane(asked), decided, lambda: old), old)
    status = jnp.where(found, run.status, MOTION_CODE["no_contact_force"]).astype(jnp.int32)
    aim = run.flight.aim._replace(modes=modes)
    return run._replace(flight=run.flight._replace(aim=aim), status=status)


def _one_pass(problem: MotionProblem, max_events: int, run: _CompliantRun) -> _CompliantRun:
    """One pass of the stepper, and what it shows."""
    run = _with_friction(problem, run)
    system, times, flight, m = problem.system, problem.times, run.flight, problem.contacts
    flow, settings = _flow(problem, flight.state, flight.aim.modes, run.fastest), problem.settings
    ledger = allowed_errors(system, settings, flight.state, 1.0)[: -flight.state.contact.size]
    depth, impulse = flow.scales.depth, flow.scales.impulse
    sizes = [depth, *[impulse] * (len(flight.state.contact) - 1)]
    rows = jnp.concatenate([ledger, settings.rtol * jnp.concatenate(sizes)])
    flown, accept = one_pass(flow, settings, rows, times, flight)
    before, after = flight.aim.modes[:m, 0], flown.aim.modes[:m, 0]
    closed, opened = (before == OPEN) & (after != OPEN), (before != OPEN) & (after == OPEN)
    gamma, slip = _rates(problem, flown.state)
    fastest, turned, stopped = jnp.maximum(-gamma, 0.0), ~closed & closed, ~closed & closed
    if problem.mu is not None:
        side, fired = phases_of(flight.aim.modes, flown.state).side, flown.event[2 * m :]
        stopped = slip_stops(settings, side, fired, slip, flow.scales.slip)
        turned, fastest = (fired & side.stick) | stopped, jnp.concatenate([fastest, slip])
        flown = flown._replace(state=flow.stopped(stopped, flown.state))
    at = flown.state
    happened = jnp.any(closed | opened | turned)
    full = happened & (run.event_count >= max_events)
    written = happened & ~full
    status = jnp.where(full, MOTION_CODE["max_events"], run.status)
    status = jnp.where(flown.stuck, why_stuck(system, flown, problem.q0, times), status)
    kind = jnp.where(jnp.any(opened), KIND_CODE["detachment"], KIND_CODE["friction"])
    kind = jnp.where(jnp.any(closed), KIND_CODE["contact"], kind)
    some = (closed | opened | turned).astype(kind.dtype)
    marks = jnp.concatenate([jnp.stack([kind, 0 * kind]), some])
    index = jnp.where(written, run.event_count, max_events)
    table = MotionTable(
        put(run.table.samples, packed(at)[:, 0], flight.sample),
        put(run.table.events, _event(problem, at, opened), index),
        put(run.table.marks, marks, index),
    )
    plan = run.plan
    if plan is not None:
        plan = plan.with_row(_PlanRow(accept, written, stopped, flight.aim, run.fastest), accept)
    return _CompliantRun(
        flown,
        jnp.maximum(run.fastest, fastest),
        table,
        run.event_count + written.astype(jnp.int32),
        status.astype(jnp.int32),
        jnp.all((after == OPEN) & (gamma >= 0)),
        plan,
    )


def _event(problem: MotionProblem, at: State, opened: jax.Array) -> jax.Array:
    """Numbers of an event: the impulse of contacts that have `opened` (m,); velocities go on."""
    none = no_jump(at, problem.contacts, problem.sides)
    zero, (push, *sides) = jnp.zeros_like(at.t), jnp.where(opened, at.contact[1:], 0.0)
    jump = none._replace(impulse=push)
    if sides:
        jump = jump._replace(tangential=jnp.stack(sides, axis=1).reshape(-1))
    return event_numbers(at, After(at, jump, Passed(zero, zero)))


def _flow(problem: MotionProblem, at: State, modes: jax.Array, fastest: jax.Array) -> CompliantFlow:
    """The flow from this state on, on the scales of the contacts so far."""
    system, force, mu, settings, _, _, times, m, _ = problem
    contacts = contacts_at(system, at.q, at.v, at.t, mu is not None)
    scales = _contact_scales(force, contacts, fastest)
    share, axes = jnp.full(m, SNAP * settings.rtol, at.q.dtype), None
    noise = velocity_noise(settings, jnp.max(jnp.abs(contacts.approach)))
    share = jnp.concatenate([share, jnp.maximum(share, noise / scales.speed)])
    if mu is not None:
        phase, now = phases_of(modes, at)
        push = _normal_forces(force, phase, contacts, at)
        known = with_normal_forces(contacts, push)
        if settings.spatial:
            axes = slip_axes(known, mu, now, scales.slip)
        most = friction_acceleration(known, mu, jnp.maximum(scales.force, push))
        by_slip = now.active & ~now.stick
        rest = rest_acceleration(at.q.dtype)
        side = jnp.where(by_slip, jnp.maximum(rest * scales.slip, noise), rest * most)
        share = jnp.concatenate([share, side])
    rounded, longest = roundings(settings, share, times), longest_step(system, times)
    longest = jnp.minimum(longest, _stable_step(force, modes, contacts, at))
    blank = jnp.zeros((len(packed(at)), 1), at.q.dtype)
    return CompliantFlow(
        system, rounded, times[0], settings.rtol, blank, at, longest, mu, axes, force, scales
    )


def _stable_step(force: Force, modes: jax.Array, contacts: Contacts, at: State) -> jax.Array:
    """How long a step may be () [s] beside the stiffness and damping of the loaded contacts."""
    x, rate, m = at.contact[0], -contacts.normal.rate, len(at.contact[0])
    phase, one = modes[:m, 0], jnp.ones_like(x)
    x = jnp.where(x >= 0, x, 0.0)
    stiffness = jax.jvp(lambda x: force.force(x, rate), (x,), (one,))[1]
    damping = jax.jvp(lambda rate: force.force(x, rate), (rate,), (one,))[1]
    both = jnp.stack([_unloading(force, phase, stiffness), damping], axis=1)
    both = jnp.where(_loaded(phase)[:, None], both, 0.0)
    square, rate = jnp.max(jnp.abs(contacts.delassus[:m, :m]) @ jnp.abs(both), axis=0)
    fastest = jax.lax.stop_gradient(jnp.maximum(jnp.sqrt(square), rate))
    return jnp.where(fastest > 0, STABLE / jnp.where(fastest > 0, fastest, 1.0), jnp.inf)


def _unloading(force: Force, phase: jax.Array, rate: jax.Array) -> jax.Array:
    """Rates (m,) of indentation, or of what goes with it, faster in plastic expansion."""
    if force.bistiffness is None:
        return rate
    e = jnp.where(force.bistiffness.restitution > 0, force.bistiffness.restitution, 1.0)
    return jnp.where(phase == EXPANSION, rate / e**2, rate)


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
        flow = _flow(problem, state, aim.modes, row.fastest)
        flow = eqx.tree_at(lambda f: f.sample, flow, times[sample])
        state = selected(row.accepted, step_again(flow, aim, state), state)
        if problem.mu is not None:
            state = flow.stopped(row.stopped & row.accepted, state)
        after = flow.switch(aim.modes, packed(state), aim.target)[0]
        opened = ((aim.modes != OPEN) & (after == OPEN))[: problem.contacts, 0]
        return state, (packed(state)[:, 0], _event(problem, state, opened))

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
