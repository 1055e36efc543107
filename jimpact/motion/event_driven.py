"""Event by event: resolve what happens, write it down, fly on; and the same once more, smoothly.

One loop, one pass: where an event waits it is resolved, then a step is tried. Lanes of a batch
advance independently; an event waits until as many lanes wait as fly.

Its derivatives are those of a second walk, `replays.py`.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from jimpact.events import stepper
from jimpact.events.batches import any_lane, over_lanes
from jimpact.motion.dynamics import free_acceleration, gaps, mass_at, user_force
from jimpact.motion.flow import (
    Course,
    Flight,
    Scales,
    Settings,
    State,
    allowed_errors,
    decoded,
    encoded,
    first_flight,
    flow_of,
    nan_unless,
    no_samples,
    one_pass,
    out_of_range,
    packed,
    put,
    sampled_states,
    selected,
    status_at_start,
    step_again,
    toward_sample,
)
from jimpact.motion.persistent_contact import no_modes
from jimpact.motion.record import KIND_CODE, Events
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
from jimpact.motion.transitions import After, Decision, resolve, resolved_again, sides_of
from jimpact.status import CODE

# M is singular where its scaled least eigenvalue is below this share of that at the start
_SINGULAR = 1e-6
AHEAD = 1e-13  # of the duration: some hundred times the least step of a flight
ROWS_PER_EVENT = 16  # of a plan; ten times more takes ten times the memory of derivatives
ROOM = 32  # numbers a contact that a run may hand over, in addition to states


class Past(NamedTuple):
    """What a run takes over from the one before it."""

    most: jax.Array  # () events that are still allowed
    numbers: jax.Array  # (k,) see `_pack_checkpoint`; 0 where the motion begins


class MotionProblem(NamedTuple):
    """What determines a motion."""

    system: System
    law: Any  # `Law` of impacts, or the `Force` of contacts that acts throughout
    mu: jax.Array | None
    settings: Settings
    q0: jax.Array
    v0: jax.Array
    times: jax.Array  # (S,)
    contacts: int  # m
    past: Past | None = None  # where the motion may go on, run after run

    @property
    def sides(self) -> int:
        """The number of tangential impulses."""
        return sides_of(self.system, self.q0, self.contacts)

    @property
    def start(self) -> State:
        """The state at the beginning."""
        zero = jnp.zeros((), self.q0.dtype)
        rest = jnp.zeros((2, self.contacts), self.q0.dtype)
        return State(self.q0, self.v0, self.times[0], zero, zero, rest, rest[:0])


class Event(NamedTuple):
    """Record of an event."""

    happens: jax.Array  # () whether there is one
    written: jax.Array  # () whether it has a row in the record
    decision: Decision


class PlanRow(NamedTuple):
    """Of a plan: an event perhaps, a step after it perhaps."""

    event: Event
    accepted: jax.Array  # ()
    aim: stepper.Step


class _EventRun(NamedTuple):
    """A run up to now."""

    flight: Flight
    struck: jax.Array  # (m,) contacts that had an impact
    allowed: jax.Array  # errors of the ledger
    waits: jax.Array  # whether an event is to be resolved
    approach: jax.Array  # of an impact without collision, 0 where another event waits
    several: jax.Array  # whether there were several solutions at an event
    last: Event  # before the next step, or a longer time ago
    table: MotionTable
    event_count: jax.Array
    status: jax.Array
    plan: MotionPlan | None


def empty_checkpoint(q: jax.Array, v: jax.Array, contacts: int, samples: int) -> jax.Array:
    """Numbers of a `Past` for a motion that begins."""
    state = q.shape[0] + v.shape[0] + 2 * contacts + 3
    return jnp.asarray(np.zeros((samples + 2) * state + ROOM * (contacts + 2), q.dtype))


def event_driven(problem: MotionProblem, max_events: int) -> tuple[Course, jax.Array | None]:
    """The motion from `times[0]` to `times[-1]`, sampled at `times`; it has both derivatives.

    With it, where there is a `problem.past`, what the next run takes over, which goes on after the
    last of `max_events`.
    """
    end = differentiable(
        problem,
        lambda problem, records: _run(problem, max_events, records),
        lambda problem, plan: _again(problem, plan, max_events),
    )
    samples = sampled_states(end.table.samples, problem.start, end.reached)
    events = recorded_events(end.table, end.event_count, problem)
    return Course(samples, events, end.steps, end.status), end.more


# ------------------------------------------------------------------------------ the run


def empty_table(problem: MotionProblem, start: State, max_events: int) -> MotionTable:
    """The table of a motion that begins in this state."""
    return MotionTable(
        no_samples(start, problem.times),
        jnp.zeros((max_events + 1, event_width(problem)), start.q.dtype),
        jnp.zeros((max_events + 1, 2 + problem.contacts), jnp.int32),
    )


def _run(problem: MotionProblem, max_events: int, records: bool) -> MotionEnd:
    """From event to event; with its plan, if it `records`."""
    start = _begin(problem, max_events, records)
    if problem.past is not None:
        start = _unpack_checkpoint(start, problem.past.numbers)

    def goes_on(run: _EventRun) -> jax.Array:
        flight = run.flight
        reached = flight.sample >= problem.times.shape[0]
        return (run.status == CODE["ok"]) & ~flight.stuck & ~reached

    def one(run: _EventRun) -> _EventRun:
        on = goes_on(run)
        waiting, flying = on & run.waits, on & ~run.waits
        due = over_lanes(waiting.astype(jnp.int32)) >= over_lanes(flying.astype(jnp.int32))
        run = _resolved(problem, max_events, run, waiting, due)
        return _flown(problem, run, goes_on(run) & ~run.waits)

    end = jax.lax.while_loop(lambda run: any_lane(goes_on(run)), one, start)
    stuck = end.flight.stuck & (end.status == CODE["ok"])
    status = jnp.where(
        stuck, why_stuck(problem.system, end.flight, problem.q0, problem.times), end.status
    ).astype(jnp.int32)
    reported = end.several & (status == CODE["ok"])
    status = jnp.where(reported, CODE["several_outcomes"], status).astype(jnp.int32)
    flight, past = end.flight, None
    if problem.past is not None:
        past = _pack_checkpoint(end, problem.past.numbers.shape[0])
    return MotionEnd(
        end.table, flight.sample, end.event_count, flight.steps, status, end.plan, past
    )


def _remembered(run: _EventRun) -> Any:
    """What a run must know of the one before it."""
    waits = run.waits, run.approach, run.several
    return run.flight, run.struck, run.allowed, waits, run.last, run.table.samples


def _pack_checkpoint(run: _EventRun, size: int) -> jax.Array:
    """1, and what is remembered, as numbers (size,)."""
    parts = [jnp.ravel(x).astype(run.allowed.dtype) for x in jax.tree.leaves(_remembered(run))]
    flat = jnp.concatenate([jnp.ones(1, run.allowed.dtype), *parts])
    return jnp.pad(flat, (0, size - flat.shape[0]))


def _unpack_checkpoint(start: _EventRun, past: jax.Array) -> _EventRun:
    """The run that goes on from `past`, or `start` if there is none."""
    leaves, tree = jax.tree.flatten(_remembered(start))
    ends = np.cumsum([1] + [x.size for x in leaves])
    parts = jnp.split(past, ends)[1:-1]
    known = [x.reshape(like.shape).astype(like.dtype) for x, like in zip(parts, leaves)]
    on = past[0] > 0
    last_run = selected(on, jax.tree.unflatten(tree, known), _remembered(start))
    flight, struck, allowed, waits, last, samples = last_run
    return start._replace(
        flight=flight,
        struck=struck,
        allowed=allowed,
        waits=waits[0],
        approach=waits[1],
        several=waits[2],
        last=last,
        table=start.table._replace(samples=samples),
        status=jnp.where(on, CODE["ok"], start.status).astype(jnp.int32),
    )


def _begin(problem: MotionProblem, max_events: int, records: bool) -> _EventRun:
    """The run before its first event; with an empty plan, if it `records`."""
    system, _, mu, settings, q0, v0, times, *_ = problem
    m, dtype = problem.contacts, q0.dtype
    state = problem.start
    watched = 2 * m if settings.friction else m
    flight = first_flight(system, state, encoded(no_modes(m, dtype)), watched, times)
    table = empty_table(problem, state, max_events)
    zero, no, none = jnp.zeros((), dtype), jnp.asarray(False), jnp.zeros(m, bool)
    decision = Decision(no, zero, none, none, none, none, Scales(zero, zero, zero))
    last = Event(no, no, decision)
    plan = None
    if records:
        row = PlanRow(last, no, flight.aim)
        plan = empty_plan(row, times.shape[0], max_events, ROWS_PER_EVENT, settings.max_steps)
    status = status_at_start(system, state, times[-1], settings.closed_below)
    if mu is not None:
        known = jnp.all(jnp.isfinite(mu))
        status = jnp.where(known, status, CODE["not_finite"]).astype(jnp.int32)
    return _EventRun(
        flight,
        none,
        packed(state)[q0.size + v0.size :, 0],
        jnp.asarray(True),
        zero,
        no,
        last,
        table,
        jnp.int32(0),
        status,
        plan,
    )


def _resolved(
    problem: MotionProblem, max_events: int, run: _EventRun, mine: jax.Array, due: jax.Array
) -> _EventRun:
    """The event resolved and written down in lanes where it is `mine`, if it is `due`."""
    system, law, mu, settings, *_ = problem
    flight, old = run.flight, run.flight.state

    def now(run: _EventRun) -> tuple[_EventRun, jax.Array, jax.Array]:
        """The run after the event, and the row of the event."""
        scales, modes = run.last.decision.scales, decoded(flight.aim.modes, old.q.dtype)
        fired = flight.event & mine
        outcome = resolve(
            system, law, mu, settings, old, modes, fired, scales, run.struck, run.approach
        )
        happened = outcome.kind != KIND_CODE["none"]
        most = max_events if problem.past is None else jnp.minimum(problem.past.most, max_events)
        full = (run.event_count >= most) & happened
        status = jnp.where(full, CODE["max_events"], outcome.status).astype(jnp.int32)
        written = mine & happened & ~full
        state = outcome.after.state
        ready = flight._replace(
            state=state,
            aim=flight.aim._replace(modes=encoded(outcome.modes)),
            event=jnp.zeros_like(flight.event),
        )
        new = run._replace(
            flight=toward_sample(ready, problem.times, flight.free),
            struck=run.struck | (outcome.contacts & outcome.decision.strikes),
            allowed=allowed_errors(system, settings, state),
            waits=outcome.approach > 0,
            approach=outcome.approach,
            several=run.several | outcome.several,
            last=Event(jnp.asarray(True), written, outcome.decision),
            event_count=run.event_count + written.astype(jnp.int32),
            status=status,
        )
        codes = jnp.stack([outcome.kind, outcome.code])
        marks = jnp.concatenate([codes.astype(jnp.int32), outcome.contacts.astype(jnp.int32)])
        numbers = event_numbers(old, outcome.after)
        # one that has no row any more is not resolved
        return selected(mine, selected(full, run._replace(status=status), new), run), numbers, marks

    def later(run: _EventRun) -> tuple[_EventRun, jax.Array, jax.Array]:
        """Nothing yet."""
        events, marks = (jnp.zeros_like(x[0]) for x in run.table[1:])
        return run, events, marks

    table, plan = run.table, run.plan
    light = run._replace(
        table=MotionTable(table.samples[:1], *(x[:1] for x in table[1:])), plan=None
    )
    new, numbers, marks = jax.lax.cond(due, now, later, light)
    index = jnp.where(new.event_count > run.event_count, run.event_count, max_events)
    table = table._replace(events=put(table.events, numbers, index))
    table = table._replace(marks=put(table.marks, marks, index))
    return new._replace(table=table, plan=plan)


def _flown(problem: MotionProblem, run: _EventRun, flies: jax.Array) -> _EventRun:
    """One pass of the stepper in lanes that fly."""
    system, _, mu, settings, *_ = problem
    times = problem.times
    begin, last = run.flight, times.shape[0]
    scales = run.last.decision.scales
    modes = decoded(begin.aim.modes, begin.state.q.dtype)
    flow = flow_of(system, mu, settings, modes, scales, times, begin.state)
    flight, accept = one_pass(flow, settings, run.allowed, times, begin, flies)
    samples = put(
        run.table.samples, packed(flight.state)[:, 0], jnp.where(flies, begin.sample, last)
    )
    # an event that another one follows at once has a row of its own
    plan, still = run.plan, jnp.asarray(False)
    recorded = accept | (run.waits & run.last.happens)
    if plan is not None:
        plan = plan.with_row(PlanRow(run.last, accept, begin.aim), recorded)
    return run._replace(
        flight=flight,
        waits=run.waits | (flies & jnp.any(flight.event)),
        last=run.last._replace(happens=jnp.where(recorded, still, run.last.happens)),
        table=run.table._replace(samples=samples),
        plan=plan,
    )


def why_stuck(system: System, flight: Flight, q0: jax.Array, times: jax.Array) -> jax.Array:
    """The status of a motion whose steps vanish or are too many."""
    state, q0, times = jax.lax.stop_gradient((flight.state, q0, times))
    # where steps vanish before something that is not a number, it is a few roundings ahead
    ahead = AHEAD * (times[-1] - times[0])
    q, t = system.body.moved(state.q, ahead * state.v), state.t + ahead
    force = user_force(system, q, state.v, t)
    rates = free_acceleration(system, q, state.v, force, mass_at(system, q))
    parts = (state.q, state.v, rates, gaps(system, q, t))
    finite = jnp.all(jnp.isfinite(jnp.concatenate(parts)))
    code = jnp.where(finite, CODE["max_steps"], CODE["not_finite"])
    code = jnp.where(out_of_range(system, state), CODE["out_of_range"], code)
    if not callable(system.mass):
        return code
    begin, now = (jax.lax.stop_gradient(mass_at(system, q)) for q in (q0, state.q))
    if begin.ndim == 1:
        least = jnp.min(now / begin)
    else:
        scale = 1 / jnp.sqrt(jnp.diagonal(begin))
        least = jnp.linalg.eigvalsh(now * scale[:, None] * scale[None, :])[0]
    return jnp.where(~(least > _SINGULAR), CODE["singular_mass"], code)


# ------------------------------------------------------------------------------ the record


def event_width(problem: MotionProblem) -> int:
    """Numbers of an event."""
    return 3 + problem.q0.size + 2 * problem.v0.size + 3 * problem.contacts + problem.sides


def event_numbers(before: State, after: After) -> jax.Array:
    """Those of one event, in a row."""
    jump = after.jump
    parts = (before.t, before.q, before.v, jump.v, jump.impulse, jump.tangential, jump.energy)
    return ravel_pytree((parts, after.passed))[0]


def recorded_events(table: MotionTable, count: jax.Array, problem: MotionProblem) -> Events:
    """The record of events; NaN or 0 in rows that are not used."""
    used = jnp.arange(len(table.events) - 1, dtype=count.dtype) < count
    marks = jnp.where(used[:, None], table.marks[:-1], 0)
    rows = nan_unless(used, table.events[:-1])
    n, m = problem.v0.size, problem.contacts
    sizes = np.cumsum([1, problem.q0.size, n, n, m, problem.sides, 2 * m])
    time, q, before, after, impulse, side, energy, passed = jnp.split(rows, sizes, axis=1)
    ends = marks[:, 0] == KIND_CODE["accumulation"]
    return Events(
        count=count,
        time=time[:, 0],
        kind=marks[:, 0],
        contacts=marks[:, 2:] > 0,
        q=q,
        velocity_before=before,
        velocity_after=after,
        impulse=impulse,
        tangential_impulse=side,
        energy=energy.reshape(-1, 2, m),
        status=marks[:, 1],
        accumulation_end=jnp.where(ends, time[:, 0] + passed[:, 0], jnp.nan),
        accumulation_gap=jnp.where(ends, passed[:, 1], jnp.nan),
    )


# ------------------------------------------------------------------------------ once more


def _again(
    problem: MotionProblem, plan: MotionPlan, max_events: int
) -> tuple[jax.Array, jax.Array]:
    """Samples and events of a run, as a smooth function of `problem`."""
    system, law, mu, settings, *_ = problem
    times = problem.times
    start = problem.start
    width = event_width(problem)
    rows: PlanRow = jax.tree.map(lambda x: x[: plan.size], plan.rows)
    index = jnp.arange(plan.size, dtype=jnp.int32)
    # what an event without a step leaves is in the row after the last step
    used = index <= plan.used
    happens, accepted = rows.event.happens & used, rows.accepted & (index < plan.used)
    sampled = accepted & rows.aim.target[:, -1, 0]
    written = rows.event.written & happens

    def event(state: State, now: Event) -> tuple[State, jax.Array]:
        """The state after an event, and its numbers."""
        after = resolved_again(system, law, mu, settings, state, now.decision)
        new = selected(now.happens, after.state, state)
        return new, jnp.where(now.happens, event_numbers(state, after), 0.0)

    def step(state: State, row: PlanRow, sample: jax.Array) -> State:
        """The state after an accepted step toward this sample."""
        aim = row.aim._replace(modes=row.aim.modes.astype(jnp.int32))
        modes, scales = decoded(aim.modes, state.q.dtype), row.event.decision.scales
        flow = flow_of(system, mu, settings, modes, scales, times, state)
        flow = eqx.tree_at(lambda f: f.sample, flow, times[sample])
        return selected(row.accepted, step_again(flow, aim, state), state)

    def one(state: State, x: Any) -> tuple[State, Any]:
        """One row of the plan."""
        row, sample = x
        nothing = jnp.zeros(width, start.q.dtype)
        state, numbers = jax.lax.cond(
            any_lane(row.event.happens), event, lambda y, _: (y, nothing), state, row.event
        )
        state = jax.lax.cond(any_lane(row.accepted), step, lambda y, *_: y, state, row, sample)
        return state, (packed(state)[:, 0], numbers)

    todo = PlanRow(rows.event._replace(happens=happens), accepted, rows.aim)
    went = walk(one, start, (todo, samples_before(sampled)), happens | accepted, width)
    sizes = times.shape[0], max_events + 1
    return tables_of(problem, plan, start, went, sampled, written, sizes)
