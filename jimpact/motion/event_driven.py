"""Event by event: resolve what happens, write it down, fly on.

One loop, one pass: where an event waits it is resolved, then a step is tried. Lanes of a batch
advance independently; an event waits until as many lanes wait as fly.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jimpact.core.law import forward_only
from jimpact.motion.dynamics import free_acceleration, gaps, mass_at, user_force
from jimpact.motion.flow import (
    Flight,
    Scales,
    allowed_errors,
    decoded,
    encoded,
    first_flight,
    flow_of,
    one_pass,
    out_of_range,
    packed,
    selected,
    status_at_start,
    toward_sample,
)
from jimpact.motion.persistent_contact import no_modes
from jimpact.motion.record import KIND_CODE
from jimpact.motion.system import System
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
from jimpact.motion.transitions import resolve
from jimpact.numerics.driver import until_over
from jimpact.tools.loops import any_lane, over_lanes
from jimpact.tools.status import CODE

# M is singular where its scaled least eigenvalue is below this share of that at the start
_SINGULAR = 1e-6
AHEAD = 1e-13  # of the duration: some hundred times the least step of a flight
ROOM = 32  # numbers a contact that a run may hand over, in addition to states


class _EventRun(NamedTuple):
    """A run up to now."""

    flight: Flight
    struck: jax.Array  # (m,) contacts that had an impact
    allowed: jax.Array  # errors of the ledger
    waits: jax.Array  # whether an event is to be resolved
    approach: jax.Array  # of an impact without collision, 0 where another event waits
    several: jax.Array  # whether there were several solutions at an event
    scales: Scales
    table: MotionTable
    event_count: jax.Array
    smooth: jax.Array  # (2,) samples and events before normals jumped
    status: jax.Array


def empty_checkpoint(q: jax.Array, v: jax.Array, contacts: int, samples: int) -> jax.Array:
    """Numbers of a `Past` for a motion that begins."""
    state = q.shape[0] + v.shape[0] + 2 * contacts + 3
    return jnp.asarray(np.zeros((samples + 2) * state + ROOM * (contacts + 2), q.dtype))


def event_driven(problem: MotionProblem, max_events: int) -> tuple[Course, jax.Array | None]:
    """The motion from `times[0]` to `times[-1]`, sampled at `times`; it has both derivatives.

    With it, where there is a `problem.past`, what the next run takes over, which goes on after the
    last of `max_events`.
    """
    problem = problem._replace(law=forward_only(problem.law))
    end = differentiable(problem, lambda problem: _run(problem, max_events))
    samples = sampled_states(end.table.samples, problem.start, end.reached)
    events = recorded_events(end.table, end.event_count, problem)
    return Course(samples, events, end.steps, end.status), end.more


# ------------------------------------------------------------------------------ the run


def _run(problem: MotionProblem, max_events: int) -> MotionEnd:
    """From event to event."""
    start = _begin(problem, max_events)
    if problem.past is not None:
        start = _unpack_checkpoint(start, problem.past.numbers)

    def goes_on(problem: MotionProblem, run: _EventRun) -> jax.Array:
        flight = run.flight
        reached = flight.sample >= problem.times.shape[0]
        return (run.status == CODE["ok"]) & ~flight.stuck & ~reached

    def one(problem: MotionProblem, run: _EventRun) -> _EventRun:
        on = goes_on(problem, run)
        waiting, flying = on & run.waits, on & ~run.waits
        due = over_lanes(waiting.astype(jnp.int32)) >= over_lanes(flying.astype(jnp.int32))
        run = _resolved(problem, max_events, run, waiting, due)
        return _flown(problem, run, goes_on(problem, run) & ~run.waits)

    def any_goes_on(problem: MotionProblem, run: _EventRun) -> jax.Array:
        return any_lane(goes_on(problem, run))

    end = until_over(any_goes_on, one, problem, start)
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
        end.table, flight.sample, end.event_count, flight.steps, status, end.smooth, past
    )


def _remembered(run: _EventRun) -> Any:
    """What a run must know of the one before it."""
    waits = run.waits, run.approach, run.several
    return run.flight, run.struck, run.allowed, waits, run.scales, run.table.samples


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
    flight, struck, allowed, waits, scales, samples = last_run
    return start._replace(
        flight=flight,
        struck=struck,
        allowed=allowed,
        waits=waits[0],
        approach=waits[1],
        several=waits[2],
        scales=scales,
        table=start.table._replace(samples=samples),
        status=jnp.where(on, CODE["ok"], start.status).astype(jnp.int32),
    )


def _begin(problem: MotionProblem, max_events: int) -> _EventRun:
    """The run before its first event."""
    system, _, mu, settings, q0, v0, times, *_ = problem
    m, dtype = problem.contacts, q0.dtype
    state = problem.start
    watched = 2 * m if settings.friction else m
    flight = first_flight(system, state, encoded(no_modes(m, dtype)), watched, times)
    zero, no = jnp.zeros((), dtype), jnp.asarray(False)
    status = status_at_start(system, state, times[-1], settings.closed_below)
    if mu is not None:
        known = jnp.all(jnp.isfinite(mu))
        status = jnp.where(known, status, CODE["not_finite"]).astype(jnp.int32)
    return _EventRun(
        flight=flight,
        struck=jnp.zeros(m, bool),
        allowed=packed(state)[q0.size + v0.size :, 0],
        waits=~no,
        approach=zero,
        several=no,
        scales=Scales(zero, zero, zero),
        table=empty_table(problem, state, max_events),
        event_count=jnp.int32(0),
        smooth=jnp.stack([flight.sample, jnp.int32(0)]),
        status=status,
    )


def _resolved(
    problem: MotionProblem, max_events: int, run: _EventRun, mine: jax.Array, due: jax.Array
) -> _EventRun:
    """The event resolved and written down in lanes where it is `mine`, if it is `due`."""
    system, law, mu, settings, *_ = problem
    flight, old = run.flight, run.flight.state

    def now(run: _EventRun) -> tuple[_EventRun, jax.Array, jax.Array]:
        """The run after the event, and the row of the event."""
        modes, fired = decoded(flight.aim.modes, old.q.dtype), flight.event & mine
        outcome = resolve(
            system, law, mu, settings, old, modes, fired, run.scales, run.struck, run.approach
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
            struck=run.struck | (outcome.contacts & outcome.strikes),
            allowed=jax.lax.stop_gradient(allowed_errors(system, settings, state)),
            waits=outcome.approach > 0,
            approach=outcome.approach,
            several=run.several | outcome.several,
            scales=outcome.scales,
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

    table = run.table
    light = run._replace(table=MotionTable(table.samples[:1], *(x[:1] for x in table[1:])))
    new, numbers, marks = jax.lax.cond(due, now, later, light)
    index = jnp.where(new.event_count > run.event_count, run.event_count, max_events)
    table = table._replace(events=put(table.events, numbers, index))
    table = table._replace(marks=put(table.marks, marks, index))
    return new._replace(table=table)


def _flown(problem: MotionProblem, run: _EventRun, flies: jax.Array) -> _EventRun:
    """One pass of the stepper in lanes that fly."""
    system, _, mu, settings, *_ = problem
    times = problem.times
    begin, last = run.flight, times.shape[0]
    modes = decoded(begin.aim.modes, begin.state.q.dtype)
    flow = flow_of(system, mu, settings, modes, run.scales, times, begin.state)
    flight, _ = one_pass(flow, settings, run.allowed, times, begin, flies)
    samples = put(
        run.table.samples, packed(flight.state)[:, 0], jnp.where(flies, begin.sample, last)
    )
    counts = jnp.stack([flight.sample, run.event_count])
    return run._replace(
        flight=flight,
        waits=run.waits | (flies & jnp.any(flight.event)),
        smooth=jnp.where(flight.jumped, run.smooth, counts),
        table=run.table._replace(samples=samples),
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
