"""Moreau-Jean time stepping with any impact law: for many contacts, no event is located.

One step of length h (Remark 6.9 of Brogliato, with the forces of contact at rest split off):

    q_m = q + h/2 v                            the midpoint says which contacts are closed
    v+  = impact(law, scene(q_m), v)           if a closed contact approaches
    v*  = v+ + h M^-1 F(q_m, v+, t + h/2)
    v'  = v* + M^-1 N p,  0 <= p _|_ gamma(v') >= 0   over closed contacts: no rebound
    q'  = q_m + h/2 v'

The last line but one keeps resting contacts at rest; with the law in its place they would hop with
e h g. Order 1: impacts are late by up to h, gaps negative by up to h times the approach.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jimpact.law import Law
from jimpact.motion.dynamics import base_velocity, gaps, user_force
from jimpact.motion.flow import Course, State
from jimpact.motion.persistent_contact import contacts_at
from jimpact.motion.record import KIND_CODE, MOTION_CODE, Events, no_events, with_row
from jimpact.motion.system import System
from jimpact.motion.transitions import FAILS, impact_jump, no_jump
from jimpact.solvers.lcp import solve_lcp

# Gap velocities below this share of the largest speed of the motion, or below so many roundings of
# it, are what solving for contacts at rest leaves. Ten times less, and resting beads strike in
# every step; ten times more, and slow impacts come a step later.
_ROUNDING, _ROUNDINGS = 1e-12, 64


class _Progress(NamedTuple):
    state: State
    speed: jax.Array  # the largest that velocities could give a gap so far
    events: Events
    status: jax.Array


def time_stepping(
    system: System,
    law: Law,
    q0: jax.Array,
    v0: jax.Array,
    times: jax.Array,
    substeps: int,
    closed_below: jax.Array,
    max_events: int,
) -> Course:
    """The motion with `substeps` steps between neighbours of `times` (S,)."""
    m = gaps(system, q0, times[0]).shape[0]
    zero = jnp.zeros((), q0.dtype)
    rest = jnp.zeros((2, m), q0.dtype)
    begin = State(q0, v0, times[0], zero, zero, rest, rest[:0])
    events = no_events(max_events, q0.shape[0], m, q0.dtype)
    status = jnp.where(
        jnp.all(jnp.isfinite(q0)) & jnp.all(jnp.isfinite(v0)),
        MOTION_CODE["ok"],
        MOTION_CODE["not_finite"],
    )
    penetrates = jnp.any(gaps(system, q0, times[0]) < -closed_below)
    status = jnp.where(penetrates, MOTION_CODE["penetration"], status).astype(jnp.int32)
    h = (times[1] - times[0]) / substeps

    def one(course: _Progress, t: jax.Array) -> tuple[_Progress, None]:
        moved = _one_step(system, law, h, closed_below, course, t)
        going = course.status == MOTION_CODE["ok"]
        return jax.tree.map(lambda a, b: jnp.where(going, a, b), moved, course), None

    def to_sample(course: _Progress, t: jax.Array) -> tuple[_Progress, State]:
        steps = t + h * jnp.arange(substeps, dtype=t.dtype)
        course, _ = jax.lax.scan(one, course, steps)
        fine = course.status == MOTION_CODE["ok"]
        return course, jax.tree.map(lambda x: jnp.where(fine, x, jnp.nan), course.state)

    end, rows = jax.lax.scan(to_sample, _Progress(begin, zero, events, status), times[:-1])
    samples = jax.tree.map(lambda x, rest: jnp.concatenate([x[None], rest]), begin, rows)
    steps = jnp.int32(substeps * (times.shape[0] - 1))
    return Course(samples, end.events, steps, end.status)


def _one_step(
    system: System,
    law: Law,
    h: jax.Array,
    closed_below: jax.Array,
    course: _Progress,
    t: jax.Array,
) -> _Progress:
    state = course.state
    middle = t + 0.5 * h
    q = state.q + 0.5 * h * state.v
    f = gaps(system, q, middle)
    m = f.shape[0]
    closed = f <= closed_below
    given = contacts_at(system, q, state.v, middle, False)
    possible = jnp.max(jnp.abs(given.normal.gradient).T @ jnp.abs(state.v))
    speed = jax.lax.stop_gradient(jnp.maximum(course.speed, possible))
    share = max(_ROUNDING, _ROUNDINGS * float(jnp.finfo(q.dtype).eps))
    noise = share * speed
    strikes = jnp.any(closed & (given.normal.rate < -noise))
    at_middle = state._replace(q=q)
    jump = jax.lax.cond(
        strikes,
        lambda: impact_jump(system, law, middle, at_middle, closed, noise),
        lambda: no_jump(at_middle, m),
    )
    force = user_force(system, q, jump.v, middle)
    v, push, energy = _pressed(system, q, jump.v, middle, h, closed)
    carried = base_velocity(system, middle)
    base = jump.base_work + (0.0 if carried is None else push @ carried)
    work = state._replace(
        q=q + 0.5 * h * v,
        v=v,
        t=t + h,
        work=state.work + h * force @ (0.5 * (jump.v + v)),
        base_work=state.base_work + base,
        contact_work=state.contact_work + jump.energy + energy,
    )
    finite = jnp.all(jnp.isfinite(v))
    fails = jnp.asarray(FAILS)[jump.code]
    status = jnp.where(fails, MOTION_CODE["law_failed"], course.status)
    status = jnp.where(finite, status, MOTION_CODE["not_finite"]).astype(jnp.int32)
    row = {
        "time": middle,
        "kind": jnp.int32(KIND_CODE["impact"]),
        "contacts": jump.impulse != 0,
        "q": q,
        "velocity_before": state.v,
        "velocity_after": jump.v,
        "impulse": jump.impulse,
        "tangential_impulse": jump.tangential,
        "energy": jump.energy,
        "status": jump.code,
    }
    return _Progress(work, speed, with_row(course.events, strikes, row), status)


def _pressed(
    system: System,
    q: jax.Array,
    v: jax.Array,
    t: jax.Array,
    h: jax.Array,
    closed: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Velocity after the forces of the step and of contacts at rest; their push and energy."""
    given = contacts_at(system, q, v, t, False)
    free = v + h * given.free
    carried = base_velocity(system, t)
    gamma = given.normal.gradient.T @ (free if carried is None else free - carried)
    both = closed[:, None] & closed[None, :]
    w = jnp.where(both, given.delassus, jnp.eye(closed.shape[0], dtype=v.dtype))
    p = jnp.where(closed, solve_lcp(w, jnp.where(closed, gamma, 0.0), regular=True).z, 0.0)
    after = gamma + given.delassus @ p
    energy = 0.5 * (gamma + after) * p
    return (
        free + given.moved @ p,
        given.normal.gradient @ p,
        jnp.stack([energy, jnp.zeros_like(energy)]),
    )
