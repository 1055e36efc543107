"""Motions by events: flights that land on each event, impacts in no time.

One pass of the loop: where an event waits it is resolved (`transitions.resolve`) and
recorded, then a step is tried. Lanes of a batch advance independently; an event waits
until as many lanes wait as fly, because resolving it costs as much in one lane as in
all.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jimpact.core.law import forward_only
from jimpact.motion.flow import (
    Flight,
    Scales,
    allowed_errors,
    decoded,
    encoded,
    first_flight,
    flow_of,
    one_pass,
    packed,
    status_at_start,
    toward_sample,
)
from jimpact.motion.persistent_contact import no_modes
from jimpact.motion.record import KIND_CODE
from jimpact.motion.run import course_of, end_of, goes_on
from jimpact.motion.tables import (
    Course,
    MotionEnd,
    MotionProblem,
    MotionTable,
    empty_table,
    event_numbers,
)
from jimpact.motion.transitions import resolve
from jimpact.numerics.driver import until_over
from jimpact.tools.loops import any_lane, over_lanes
from jimpact.tools.masks import choose
from jimpact.tools.status import CODE

ROOM = 32  # numbers a contact that a run may hand over, in addition to states


class _EventRun(NamedTuple):
    """A motion by events up to now."""

    flight: Flight
    struck: Bool[Array, " m"]  # contacts that had an impact
    # errors of time, works and contacts, see `allowed_errors`
    allowed: Float[Array, " rows"]
    waits: Bool[Array, ""]  # an event is to be resolved
    # [m/s] of an impact without collision that is due, 0 where another event waits
    approach: Float[Array, ""]
    several: Bool[Array, ""]  # contact forces were not unique at an event
    scales: Scales
    table: MotionTable
    event_count: Int[Array, ""]
    smooth: Int[Array, "2"]  # numbers of samples and events before a normal jumped
    status: Int[Array, ""]


class _Checkpoint(NamedTuple):
    """The part of a run that the next one goes on from; see `_EventRun`."""

    flight: Flight
    struck: Bool[Array, " m"]
    allowed: Float[Array, " rows"]
    waits: Bool[Array, ""]
    approach: Float[Array, ""]
    several: Bool[Array, ""]
    scales: Scales
    samples: Float[Array, "S+1 rows"]


def empty_checkpoint(
    q: Float[Array, " nq"], v: Float[Array, " n"], contacts: int, samples: int
) -> Float[Array, " size"]:
    """`Past.numbers` of a motion that begins: zeros, enough for a `_Checkpoint`."""
    state = len(q) + len(v) + 2 * contacts + 3
    records = (samples + 2) * state
    size = records + ROOM * (contacts + 2)
    return jnp.asarray(np.zeros(size, q.dtype))


def event_driven(
    problem: MotionProblem, max_events: int
) -> tuple[Course, Float[Array, " size"] | None]:
    """The motion from `times[0]` to `times[-1]`, sampled at `times`; it has both
    derivatives.

    Where there is a `problem.past`, also the numbers of the next one, of the run that
    goes on after the last of `max_events`; else None.
    """
    without_derivatives = forward_only(problem.law)
    problem = problem._replace(law=without_derivatives)
    run = partial(_run, max_events)
    return course_of(problem, problem.start, run)


# ------------------------------------------------------------------------------ the run


def _run(max_events: int, problem: MotionProblem) -> MotionEnd:
    """Pass after pass until the last sample, a failure, or one event too many."""
    past = problem.past
    start = _begin(problem, max_events)
    if past is not None:
        start = _unpack_checkpoint(start, past.numbers)

    def one(problem: MotionProblem, run: _EventRun) -> _EventRun:
        """Run after one pass: its event if one waits and is due, then a step unless one
        waits.
        """
        on = goes_on(problem, run)
        waiting = on & run.waits
        flying = on & ~run.waits
        waiting_lanes = over_lanes(jnp.int32(waiting))
        flying_lanes = over_lanes(jnp.int32(flying))
        due = waiting_lanes >= flying_lanes
        run = _resolved(problem, max_events, run, waiting, due)
        still = goes_on(problem, run)
        flies = still & ~run.waits
        return _flown(problem, run, flies)

    def continues(problem: MotionProblem, run: _EventRun) -> Bool[Array, ""]:
        """True while a lane goes on: over all lanes, so that `jax.lax.cond` in a pass
        is not turned into a selection.
        """
        return any_lane(goes_on(problem, run))

    last = until_over(continues, one, problem, start)
    next_past = None
    if past is not None:
        size = past.numbers.shape[0]
        next_past = _pack_checkpoint(last, size)
    end = end_of(problem, last, last.smooth, next_past)
    status = end.status
    ok = status == CODE["ok"]
    reported = last.several & ok
    code = jnp.where(reported, CODE["several_outcomes"], status)
    return end._replace(status=jnp.int32(code))


def _checkpoint(run: _EventRun) -> _Checkpoint:
    """The fields of a run that the next one goes on from."""
    names = (name for name in _Checkpoint._fields if name != "samples")
    fields = {name: getattr(run, name) for name in names}
    samples = run.table.samples
    return _Checkpoint(**fields, samples=samples)


def _pack_checkpoint(run: _EventRun, size: int) -> Float[Array, " size"]:
    """Numbers of `Past`: 1, the leaves of the checkpoint in turn, zeros up to
    `size`.
    """
    checkpoint = _checkpoint(run)
    leaves = jax.tree.leaves(checkpoint)
    dtype = run.allowed.dtype
    one = jnp.ones(1, dtype)
    parts = [jnp.ravel(x).astype(dtype) for x in leaves]
    flat = jnp.concatenate([one, *parts])
    left = size - len(flat)
    return jnp.pad(flat, (0, left))


def _unpack_checkpoint(start: _EventRun, past: Float[Array, " size"]) -> _EventRun:
    """Run that goes on from the numbers of `Past`, or `start` where their first one is
    0.
    """
    new = _checkpoint(start)
    leaves, tree = jax.tree.flatten(new)
    sizes = [x.size for x in leaves]
    ends = np.cumsum([1, *sizes])
    parts = jnp.split(past, ends)[1:-1]
    pairs = zip(parts, leaves)
    known = [x.reshape(like.shape).astype(like.dtype) for x, like in pairs]
    on = past[0] > 0
    past_checkpoint = jax.tree.unflatten(tree, known)
    checkpoint = choose(on, past_checkpoint, new)
    fields = checkpoint._asdict()
    samples = fields.pop("samples")
    table = start.table._replace(samples=samples)
    code = jnp.where(on, CODE["ok"], start.status)
    status = jnp.int32(code)
    return start._replace(**fields, table=table, status=status)


def _begin(problem: MotionProblem, max_events: int) -> _EventRun:
    """Run at the start of the motion: contacts open; an event waits, which finds their
    modes.
    """
    system, _, mu, settings, q0, v0, times, *_ = problem
    m = problem.contacts
    dtype = q0.dtype
    state = problem.start
    if settings.friction:
        margins = 2 * m
    else:
        margins = m
    modes = no_modes(m, dtype)
    rows = encoded(modes)
    flight = first_flight(system, state, rows, margins, times)
    zero = jnp.zeros((), dtype)
    no = jnp.asarray(False)
    end = times[-1]
    status = status_at_start(system, state, end, settings.closed_below)
    if mu is not None:
        finite = jnp.isfinite(mu)
        known = jnp.all(finite)
        code = jnp.where(known, status, CODE["not_finite"])
        status = jnp.int32(code)
    after_v = q0.size + v0.size
    rows_of_state = packed(state)
    return _EventRun(
        flight=flight,
        struck=jnp.zeros(m, bool),
        allowed=rows_of_state[after_v:, 0],
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
    problem: MotionProblem,
    max_events: int,
    run: _EventRun,
    waiting: Bool[Array, ""],
    due: Bool[Array, ""],
) -> _EventRun:
    """Run after its event, resolved and recorded if it is `waiting` here and `due` in
    all lanes.

    Else the run is as it was.
    """

    def later(
        run: _EventRun,
    ) -> tuple[_EventRun, Float[Array, " w"], Int[Array, " marks"]]:
        """The run as it is, and rows of zeros."""
        no_numbers = jnp.zeros_like(table.events[0])
        no_marks = jnp.zeros_like(table.marks[0])
        return run, no_numbers, no_marks

    table = run.table
    # both branches return what they are given: the first row of each table is enough
    first_rows = MotionTable(*(x[:1] for x in table))
    light = run._replace(table=first_rows)
    now = partial(_after_event, problem, max_events, waiting)
    new, numbers, marks = jax.lax.cond(due, now, later, light)
    count = run.event_count
    written = new.event_count > count
    row = jnp.where(written, count, max_events)
    written_table = table.with_event(numbers, marks, row)
    return new._replace(table=written_table)


def _after_event(
    problem: MotionProblem,
    max_events: int,
    waiting: Bool[Array, ""],
    run: _EventRun,
) -> tuple[_EventRun, Float[Array, " w"], Int[Array, " marks"]]:
    """Run after the event if it is `waiting` here, and the rows of the event in the
    table.

    An event more than `max_events` is not resolved: the status says so.
    """
    system, law, mu, settings, *_ = problem
    flight = run.flight
    old = flight.state
    modes = decoded(flight.aim.modes, old.q.dtype)
    fired = flight.event & waiting
    outcome = resolve(
        system,
        law,
        mu,
        settings,
        old,
        modes,
        fired,
        run.scales,
        run.struck,
        run.approach,
    )
    happened = outcome.kind != KIND_CODE["none"]
    limit = jnp.asarray(max_events)
    if problem.past is not None:
        limit = jnp.minimum(problem.past.most, max_events)
    count = run.event_count
    full = (count >= limit) & happened  # no row is left
    code = jnp.where(full, CODE["max_events"], outcome.status)
    status = jnp.int32(code)
    written = waiting & happened & ~full
    state = outcome.after.state
    rows = encoded(outcome.modes)
    aim = flight.aim._replace(modes=rows)
    no_event = jnp.zeros_like(flight.event)
    ready = flight._replace(state=state, aim=aim, event=no_event)
    struck = outcome.contacts & outcome.strikes
    allowed = allowed_errors(system, settings, state)
    new = run._replace(
        flight=toward_sample(ready, problem.times, flight.free),
        struck=run.struck | struck,
        allowed=jax.lax.stop_gradient(allowed),
        waits=outcome.approach > 0,
        approach=outcome.approach,
        several=run.several | outcome.several,
        scales=outcome.scales,
        event_count=count + jnp.int32(written),
        status=status,
    )
    codes = jnp.stack([outcome.kind, outcome.code])
    codes = jnp.int32(codes)
    contacts = jnp.int32(outcome.contacts)
    marks = jnp.concatenate([codes, contacts])
    numbers = event_numbers(old, outcome.after)
    # an event without a row is not resolved
    unresolved = run._replace(status=status)
    new = choose(full, unresolved, new)
    return choose(waiting, new, run), numbers, marks


def _flown(problem: MotionProblem, run: _EventRun, flies: Bool[Array, ""]) -> _EventRun:
    """Run after one pass of the stepper, where it `flies`; its state is recorded as
    next sample.

    That row is overwritten until the sample is reached.
    """
    system, _, mu, settings, *_ = problem
    times = problem.times
    # the last row of samples is discarded
    begin = run.flight
    state = begin.state
    last = len(times)
    modes = decoded(begin.aim.modes, state.q.dtype)
    flow = flow_of(system, mu, settings, modes, run.scales, times, state)
    flight, _ = one_pass(flow, settings, run.allowed, times, begin, flies)
    row = jnp.where(flies, begin.sample, last)
    table = run.table.with_sample(flight.state, row)
    counts = jnp.stack([flight.sample, run.event_count])
    fired = jnp.any(flight.event)
    waits = run.waits | (flies & fired)
    smooth = jnp.where(flight.jumped, run.smooth, counts)
    return run._replace(flight=flight, waits=waits, smooth=smooth, table=table)
