"""Event by event: resolve what happens, write it down, fly on."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jimpact.law import Law
from jimpact.motion.along import along
from jimpact.motion.contact_forces import Modes, no_modes
from jimpact.motion.dynamics import gaps, kinetic, mass_at, potential
from jimpact.motion.flight import fly
from jimpact.motion.flight_records import Flight, Scales, Settings, State
from jimpact.motion.record import KIND_CODE, MOTION_CODE, Events, Motion
from jimpact.motion.strikes import Outcome, resolve
from jimpact.motion.system import System

# M is singular where its scaled least eigenvalue is below this share of that at the start
_SINGULAR = 1e-6


class _Course(NamedTuple):
    flight: Flight
    modes: Modes
    scales: Scales
    struck: jax.Array
    events: Events
    status: jax.Array


def event_driven(
    system: System,
    law: Law,
    mu: jax.Array | None,
    settings: Settings,
    q0: jax.Array,
    v0: jax.Array,
    times: jax.Array,
    max_events: int,
) -> Motion:
    """The motion from `times[0]` to `times[-1]`, sampled at `times` (S,)."""
    n = q0.shape[0]
    m = gaps(system, q0, times[0]).shape[0]
    begin = _begin(settings, q0, v0, times, m)
    events = no_events(max_events, n, m, q0.dtype)
    zero = jnp.zeros((), q0.dtype)
    penetrates = jnp.any(gaps(system, q0, times[0]) < -settings.closed_below)
    status = jnp.where(penetrates, MOTION_CODE["penetration"], MOTION_CODE["ok"])
    finite = jnp.all(jnp.isfinite(q0)) & jnp.all(jnp.isfinite(v0)) & jnp.isfinite(times[-1])
    status = jnp.where(finite, status, MOTION_CODE["not_finite"]).astype(jnp.int32)
    start = _Course(
        begin,
        no_modes(m, q0.dtype),
        Scales(zero, zero, zero),
        jnp.full((2, m), -jnp.inf, q0.dtype),
        events,
        status,
    )

    def going(course: _Course) -> jax.Array:
        return (course.status == MOTION_CODE["ok"]) & (course.flight.sample < times.shape[0])

    def one(course: _Course) -> _Course:
        return _next_event(system, law, mu, settings, times, max_events, course)

    end = jax.lax.while_loop(going, one, start)
    return energies(system, times, end.flight.samples, end.events, end.flight.steps, end.status)


def _begin(settings: Settings, q0: jax.Array, v0: jax.Array, times: jax.Array, m: int) -> Flight:
    samples = times.shape[0]
    zero = jnp.zeros((), q0.dtype)
    state = State(q0, v0, zero, zero, jnp.zeros((2, m), q0.dtype))
    unknown = jax.tree.map(lambda x: jnp.full((samples, *x.shape), jnp.nan, x.dtype), state)
    first = jax.tree.map(lambda all_, x: all_.at[0].set(x), unknown, state)
    k = 2 * m if settings.friction else m
    no = jnp.zeros(k, bool)
    step = jax.lax.stop_gradient(times[1] - times[0])
    infinite = jnp.full_like(zero, jnp.inf)
    one, none = jnp.int32(1), jnp.int32(0)
    false = jnp.asarray(False)
    return Flight(times[0], state, step, infinite, no, none, no, one, first, none, false, false)


def _next_event(
    system: System,
    law: Law,
    mu: jax.Array | None,
    settings: Settings,
    times: jax.Array,
    max_events: int,
    course: _Course,
) -> _Course:
    """Resolve the event that ended the last flight (or the beginning), then fly to the next."""
    flight = course.flight
    at = along(system, mu, settings, course.modes, course.scales)
    # the last remainder before an event leaves the constraints, by its square
    flight = flight._replace(state=at.project(flight.t, flight.state))
    found = resolve(
        system,
        law,
        mu,
        settings,
        flight.t,
        flight.state,
        course.modes,
        flight.event,
        course.scales,
        course.struck,
    )
    full = (course.events.count >= max_events) & (found.kind != KIND_CODE["none"])
    events = _written(course.events, flight, found)
    status = jnp.where(full, MOTION_CODE["max_events"], found.status).astype(jnp.int32)
    # after a failure the flight is over at once
    over = status != MOTION_CODE["ok"]
    ready = flight._replace(
        state=found.state, event=jnp.zeros_like(flight.event), stuck=over, landings=jnp.int32(0)
    )
    flown = fly(system, mu, settings, found.modes, found.scales, times, ready)
    stuck = flown.stuck & ~over
    status = jnp.where(stuck, _why_stuck(system, flown), status).astype(jnp.int32)
    return _Course(flown, found.modes, found.scales, found.struck, events, status)


def _why_stuck(system: System, flight: Flight) -> jax.Array:
    state = flight.state
    finite = jnp.all(jnp.isfinite(state.q)) & jnp.all(jnp.isfinite(state.v)) & ~flight.undefined
    code = jnp.where(finite, MOTION_CODE["max_steps"], MOTION_CODE["not_finite"])
    if not callable(system.mass):
        return code
    begin, now = (jax.lax.stop_gradient(mass_at(system, q)) for q in (flight.samples.q[0], state.q))
    if begin.ndim == 1:
        least = jnp.min(now / begin)
    else:
        scale = 1 / jnp.sqrt(jnp.diagonal(begin))
        least = jnp.linalg.eigvalsh(now * scale[:, None] * scale[None, :])[0]
    return jnp.where(~(least > _SINGULAR), MOTION_CODE["singular_mass"], code)


def no_events(size: int, n: int, m: int, dtype: Any) -> Events:
    """An empty table of events."""

    def blank(*shape: int) -> jax.Array:
        return jnp.full((size, *shape), jnp.nan, dtype)

    return Events(
        count=jnp.int32(0),
        time=blank(),
        kind=jnp.zeros(size, jnp.int32),
        contacts=jnp.zeros((size, m), bool),
        q=blank(n),
        velocity_before=blank(n),
        velocity_after=blank(n),
        impulse=blank(m),
        tangential_impulse=blank(m),
        energy=blank(2, m),
        status=jnp.zeros(size, jnp.int32),
        accumulation_end=blank(),
    )


def _written(events: Events, flight: Flight, found: Outcome) -> Events:
    """One row more; beyond the last row nothing is written."""
    happened = found.kind != KIND_CODE["none"]
    row = jnp.where(happened, events.count, events.time.shape[0])
    values = {
        "time": flight.t,
        "kind": found.kind,
        "contacts": found.contacts,
        "q": flight.state.q,
        "velocity_before": flight.state.v,
        "velocity_after": found.blow.v,
        "impulse": found.blow.impulse,
        "tangential_impulse": found.blow.tangential,
        "energy": found.blow.energy,
        "status": found.blow.code,
        "accumulation_end": found.accumulation_end,
    }
    new = {k: getattr(events, k).at[row].set(v, mode="drop") for k, v in values.items()}
    fits = happened & (events.count < events.time.shape[0])
    return Events(count=events.count + fits.astype(jnp.int32), **new)


def energies(
    system: System,
    times: jax.Array,
    samples: State,
    events: Events,
    steps: jax.Array,
    status: jax.Array,
) -> Motion:
    """The record of sampled states, with their energies and gaps."""
    return Motion(
        time=times,
        q=samples.q,
        velocity=samples.v,
        kinetic_energy=jax.vmap(lambda q, v: kinetic(system, q, v))(samples.q, samples.v),
        potential_energy=jax.vmap(lambda q: potential(system, q))(samples.q),
        force_work=samples.work,
        base_work=samples.base_work,
        contact_work=samples.contact_work,
        gaps=jax.vmap(lambda q, t: gaps(system, q, t))(samples.q, times),
        events=events,
        steps=steps,
        status=status,
    )
