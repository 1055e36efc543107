"""Motions in which contact forces of a `Compliant` law act, instead of impacts at an instant."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jimpact.core.law import Law
from jimpact.events.contact_flow import Phase
from jimpact.laws.forces import Force
from jimpact.motion.compliant_flow import (
    Phases,
    compliant_flow,
    loaded,
    mode_rows,
    normal_forces,
    phases_of,
    stable_step,
)
from jimpact.motion.dynamics import gaps, kinematics, not_rounding
from jimpact.motion.event_driven import why_stuck
from jimpact.motion.flow import (
    Flight,
    State,
    allowed_errors,
    first_flight,
    one_pass,
    packed,
    selected,
    status_at_start,
    toward_sample,
)
from jimpact.motion.persistent_contact import (
    Modes,
    by_contact,
    choose_with_friction,
    cone_margins,
    contacts_at,
    direction,
    forces,
    friction_acceleration,
    length,
    no_modes,
    rest_acceleration,
    with_normal_forces,
)
from jimpact.motion.record import KIND_CODE
from jimpact.motion.tables import (
    Course,
    MotionEnd,
    MotionProblem,
    MotionTable,
    differentiable,
    empty_table,
    event_numbers,
    put,
    recorded_events,
    sampled_states,
)
from jimpact.motion.transitions import (
    REST_SPEED,
    STOPPED,
    After,
    Passed,
    no_jump,
    slip_stops,
    velocity_noise,
)
from jimpact.numerics.driver import until_over
from jimpact.tools.loops import any_lane
from jimpact.tools.status import CODE

# Of the cone: contacts that have reached its rim stick only if others take over more than this.
# Ten times more: contacts that share what they hold slide one after the other.
WITHIN = 1e-6


class _CompliantRun(NamedTuple):
    """A motion with contact forces up to now."""

    flight: Flight
    fastest: jax.Array  # approach (m,) [m/s] so far, with friction slip (m,), too
    table: MotionTable
    event_count: jax.Array
    status: jax.Array
    apart: jax.Array  # whether all contacts are open and none closes
    vanished: jax.Array  # () [s] when steps last vanished at an end of slip, -inf before


def force_of(law: Law) -> Force:
    """The contact force of a law, for motions.

    Raises:
        TypeError: a law without one, or whose force yields: motions do not keep what that depends
            on.
    """
    force: Force | None = law.contact_force
    if force is None or not law.uses_gaps:
        raise TypeError(
            "Argument `law` must use gaps and have a `contact_force` (Compliant) for "
            f"method='contact_forces', but is {law!r}."
        )
    if force.bound is not None:
        raise TypeError(
            "Argument `law` must have a force without bound in a motion: what yields is for "
            f"`impact`, but the force is {force!r}."
        )
    return force


def compliant_motion(problem: MotionProblem, max_events: int, until_apart: bool) -> Course:
    """The motion from `times[0]` to `times[-1]`, or until all contacts are open and none closes."""
    end = differentiable(problem, lambda problem: _run(problem, max_events, until_apart))
    start = _start(problem)
    samples = sampled_states(end.table.samples, start, end.reached)
    events = recorded_events(end.table, end.event_count, problem)
    return Course(samples, events, end.steps, end.status)


def _start(problem: MotionProblem) -> State:
    """The state at the beginning: contacts are as deep as their gaps say."""
    gap = gaps(problem.system, problem.q0, problem.times[0])
    x = jnp.where(jnp.abs(gap) <= problem.settings.closed_below, 0.0, -gap)
    each = 0 if problem.mu is None else problem.tangents // problem.contacts
    impulses = jnp.zeros((1 + each, len(x)), x.dtype)
    return problem.start._replace(contact=jnp.concatenate([x[None], impulses]))


def _run(problem: MotionProblem, max_events: int, until_apart: bool) -> MotionEnd:
    """From pass to pass."""

    def goes_on(problem: MotionProblem, run: _CompliantRun) -> jax.Array:
        on = (run.status == CODE["ok"]) & (run.flight.sample < problem.times.shape[0])
        return on & ~run.apart if until_apart else on

    one = partial(_one_pass, max_events)
    end = until_over(goes_on, one, problem, _begin(problem, max_events))
    flight = end.flight
    counts = jnp.stack([flight.sample, end.event_count])
    return MotionEnd(
        end.table, flight.sample, end.event_count, flight.steps, end.status, counts, None
    )


def _begin(problem: MotionProblem, max_events: int) -> _CompliantRun:
    """The run before its first pass: phases follow from gaps and their rates."""
    system, force, mu, _, _, _, times, m, _ = problem
    state = _start(problem)
    gamma, slip = _rates(problem, state)
    x = state.contact[0]
    phase = jnp.where((x > 0) | ((x == 0) & (gamma <= 0)), Phase.COMPRESSION, Phase.OPEN)
    if not force.slackens:
        phase = jnp.where((x > 0) & (gamma > 0), Phase.EXPANSION, phase)
    phase, watched, fastest = phase.astype(jnp.int32), 2 * m, jnp.maximum(-gamma, 0.0)
    if mu is not None:
        phase = mode_rows(Phases(phase, no_modes(m, x.dtype)))
        watched, fastest = 3 * m, jnp.concatenate([fastest, slip])
    flight = first_flight(system, state, phase[:, None], watched, times)
    contacts = contacts_at(system, state.q, state.v, state.t, False)
    stable = stable_step(force, flight.aim.modes, contacts, state)
    flight = toward_sample(flight, times, jnp.minimum(flight.free, stable))
    flight = flight._replace(event=flight.event.at[:m].set(True))  # friction is to be decided
    return _CompliantRun(
        flight,
        jax.lax.stop_gradient(fastest),
        empty_table(problem, state, max_events),
        jnp.int32(0),
        status_at_start(system, state, times[-1], jnp.inf),
        jnp.all((phase[:m] == Phase.OPEN) & (gamma >= 0)),
        jnp.full_like(state.t, -jnp.inf),
    )


def _rates(problem: MotionProblem, at: State) -> tuple[jax.Array, jax.Array]:
    """Gap velocities (m,) and speeds of slip (m,), 0 without friction."""
    normal, tangent = kinematics(problem.system, at.q, at.v, at.t, problem.mu is not None)
    if tangent is None:
        return normal.rate, jnp.zeros_like(normal.rate)
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
        known = with_normal_forces(contacts, normal_forces(force, phase, contacts, at))
        scale, slip = jnp.max(run.fastest), _rates(problem, at)[1]
        stopped = slip_stops(settings, side, event[2 * m :], slip, scale)
        let_go = (event[2 * m :] & side.stick) | stopped
        released = jnp.concatenate([jnp.zeros_like(let_go), let_go])
        fastest = jnp.max(jnp.abs(known.approach))
        rest = not_rounding(REST_SPEED, slip.dtype) * scale + velocity_noise(settings, fastest)
        slides, slack = (slip > rest) & ~stopped, rest_acceleration(slip.dtype) * fastest
        acts = loaded(phase)
        choice = choose_with_friction(known, mu, side, acts, released, slides, slack)
        # corners that sink in differently are nearly redundant: they stick where the forces of the
        # flow, which share what they hold, can hold them
        assert known.tangent is not None
        moves = direction(by_contact(known.tangent.rate, m))
        sticking = Modes(acts, acts & ~slides, jnp.where(slides, moves[:, 0], 1.0))
        if settings.spatial:
            sticking = sticking._replace(sign=jnp.ones_like(sticking.sign))
        held = forces(known, mu, sticking, jnp.where(slides[:, None], moves, 0.0))
        left = cone_margins(known, mu, held)
        within = WITHIN * friction_acceleration(known, mu, held.normal)
        # what passes the flat position turns: no forces hold both of its corners
        assert held.tangential is not None
        both = jnp.concatenate([held.normal, held.tangential])
        growth = length(by_contact((known.approach + known.delassus @ both)[m:], m))
        holds = (growth <= within) & (left >= jnp.where(let_go, within, 0.0))
        sticks = jnp.all(~sticking.stick | holds)
        chosen = selected(sticks, sticking, choice.modes)
        if settings.spatial:  # a force that changes as fast as in a contact has slip begin at once
            chosen = chosen._replace(sign=jnp.ones_like(chosen.sign))
        return mode_rows(Phases(phase, chosen))[:, None], choice.consistent | sticks

    old = run.flight.aim.modes, jnp.asarray(True)
    asked = jnp.any(event)
    modes, found = selected(asked, jax.lax.cond(any_lane(asked), decided, lambda: old), old)
    status = jnp.where(found, run.status, CODE["no_contact_force"]).astype(jnp.int32)
    aim = run.flight.aim._replace(modes=modes)
    return run._replace(flight=run.flight._replace(aim=aim), status=status)


def _one_pass(max_events: int, problem: MotionProblem, run: _CompliantRun) -> _CompliantRun:
    """One pass of the stepper, and what it shows."""
    run = _with_friction(problem, run)
    system, times, flight, m = problem.system, problem.times, run.flight, problem.contacts
    flow = compliant_flow(problem, flight.state, flight.aim.modes, run.fastest)
    settings = problem.settings
    ledger = allowed_errors(system, settings, flight.state, 1.0)[: -flight.state.contact.size]
    depth, impulse = flow.scales.depth, flow.scales.impulse
    sizes = [depth, *[impulse] * (len(flight.state.contact) - 1)]
    rows = jnp.concatenate([ledger, settings.rtol * jnp.concatenate(sizes)])
    flown, _ = one_pass(flow, settings, rows, times, flight)
    before, after = flight.aim.modes[:m, 0], flown.aim.modes[:m, 0]
    was_open, is_open = before == Phase.OPEN, after == Phase.OPEN
    closed, opened = was_open & ~is_open, ~was_open & is_open
    gamma, slip = _rates(problem, flown.state)
    fastest, none = jnp.maximum(-gamma, 0.0), jnp.zeros(m, bool)
    turned, stopped, vanished = none, none, run.vanished
    if problem.mu is not None:
        side = phases_of(flight.aim.modes, flown.state).side
        flown, vanished = _ended_slip(problem, run, flown, side, slip)
        fired = flown.event[2 * m :]
        stopped = slip_stops(settings, side, fired, slip, flow.scales.slip)
        turned, fastest = (fired & side.stick) | stopped, jnp.concatenate([fastest, slip])
        flown = flown._replace(state=flow.stopped(stopped, flown.state))
    at = flown.state
    happened = jnp.any(closed | opened | turned)
    full = happened & (run.event_count >= max_events)
    written = happened & ~full
    status = jnp.where(full, CODE["max_events"], run.status)
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
    return _CompliantRun(
        flown,
        jax.lax.stop_gradient(jnp.maximum(run.fastest, fastest)),
        table,
        run.event_count + written.astype(jnp.int32),
        status.astype(jnp.int32),
        jnp.all((after == Phase.OPEN) & (gamma >= 0)),
        vanished,
    )


def _ended_slip(
    problem: MotionProblem, run: _CompliantRun, flown: Flight, side: Modes, slip: jax.Array
) -> tuple[Flight, jax.Array]:
    """Slip (m,) that has nearly ended where steps vanish ends, and when () [s] that last was so.

    A body that turns on one corner drags another through its end of slip. There friction turns
    round at once, and with it the force that holds the first corner: no step lands on its cone.
    """
    m, most = problem.contacts, problem.settings.max_steps
    scale = jnp.maximum(jnp.max(run.fastest), jnp.max(slip))
    ends = side.active & ~side.stick & (slip <= STOPPED * scale)
    vanished = flown.stuck & (flown.steps < most) & (flown.state.t > run.vanished)
    here = vanished & jnp.any(ends)
    event = flown.event.at[2 * m :].set(ends)
    goes_on = flown._replace(event=event, stuck=jnp.asarray(False))
    again = toward_sample(goes_on, problem.times, flown.free)
    return selected(here, again, flown), jnp.where(here, flown.state.t, run.vanished)


def _event(problem: MotionProblem, at: State, opened: jax.Array) -> jax.Array:
    """Numbers of an event: the impulse of contacts that have `opened` (m,); velocities go on."""
    none = no_jump(at, problem.contacts, problem.tangents)
    zero, (push, *tangential) = jnp.zeros_like(at.t), jnp.where(opened, at.contact[1:], 0.0)
    jump = none._replace(impulse=push)
    if tangential:
        jump = jump._replace(tangential=jnp.stack(tangential, axis=1).reshape(-1))
    return event_numbers(at, After(at, jump, Passed(zero, zero)))
