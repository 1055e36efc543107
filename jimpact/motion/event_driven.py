"""Event by event: resolve what happens, write it down, fly on."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jimpact.law import Law
from jimpact.motion.dynamics import free_acceleration, gaps, mass_at, user_force
from jimpact.motion.flow import Course, Flight, Scales, Settings, State, encoded, first_flight, fly
from jimpact.motion.persistent_contact import Modes, no_modes
from jimpact.motion.record import KIND_CODE, MOTION_CODE, Events, no_events, with_row
from jimpact.motion.system import System
from jimpact.motion.transitions import Outcome, resolve

# M is singular where its scaled least eigenvalue is below this share of that at the start
_SINGULAR = 1e-6
AHEAD = 1e-13  # of the duration: some hundred times the least step of a flight


class _Run(NamedTuple):
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
) -> Course:
    """The motion from `times[0]` to `times[-1]`, sampled at `times` (S,)."""
    n = q0.shape[0]
    m = gaps(system, q0, times[0]).shape[0]
    zero, dtype = jnp.zeros((), q0.dtype), q0.dtype
    rest = jnp.zeros((2, m), dtype)
    state = State(q0, v0, times[0], zero, zero, rest, rest[:0])
    watched = 2 * m if settings.friction else m
    begin = first_flight(state, encoded(no_modes(m, dtype)), watched, times)
    events = no_events(max_events, n, m, q0.dtype)
    penetrates = jnp.any(gaps(system, q0, times[0]) < -settings.closed_below)
    status = jnp.where(penetrates, MOTION_CODE["penetration"], MOTION_CODE["ok"])
    finite = jnp.all(jnp.isfinite(q0)) & jnp.all(jnp.isfinite(v0)) & jnp.isfinite(times[-1])
    status = jnp.where(finite, status, MOTION_CODE["not_finite"]).astype(jnp.int32)
    start = _Run(
        begin,
        no_modes(m, q0.dtype),
        Scales(zero, zero, zero),
        jnp.full((2, m), -jnp.inf, q0.dtype),
        events,
        status,
    )

    def going(run: _Run) -> jax.Array:
        return (run.status == MOTION_CODE["ok"]) & (run.flight.sample < times.shape[0])

    def one(run: _Run) -> _Run:
        return _next_event(system, law, mu, settings, times, max_events, run)

    end = jax.lax.while_loop(going, one, start)
    return Course(end.flight.samples, end.events, end.flight.steps, end.status)


def _next_event(
    system: System,
    law: Law,
    mu: jax.Array | None,
    settings: Settings,
    times: jax.Array,
    max_events: int,
    run: _Run,
) -> _Run:
    """Resolve the event that ended the last flight (or the beginning), then fly to the next."""
    flight = run.flight
    found = resolve(
        system,
        law,
        mu,
        settings,
        flight.state,
        run.modes,
        flight.event,
        run.scales,
        run.struck,
    )
    full = (run.events.count >= max_events) & (found.kind != KIND_CODE["none"])
    events = _written(run.events, flight, found)
    status = jnp.where(full, MOTION_CODE["max_events"], found.status).astype(jnp.int32)
    # after a failure the flight is over at once
    over = status != MOTION_CODE["ok"]
    ready = flight._replace(state=found.state, event=jnp.zeros_like(flight.event), stuck=over)
    flown = fly(system, mu, settings, found.modes, found.scales, times, ready)
    stuck = flown.stuck & ~over
    status = jnp.where(
        stuck, why_stuck(system, flown, jax.lax.stop_gradient(times)), status
    ).astype(jnp.int32)
    return _Run(flown, found.modes, found.scales, found.struck, events, status)


def why_stuck(system: System, flight: Flight, times: jax.Array) -> jax.Array:
    """The status of a motion whose steps vanish or are too many."""
    state = jax.lax.stop_gradient(flight.state)
    # where steps vanish before something that is not a number, it is a few roundings ahead
    ahead = AHEAD * (times[-1] - times[0])
    q, t = state.q + ahead * state.v, state.t + ahead
    force = user_force(system, q, state.v, t)
    rates = free_acceleration(system, q, state.v, force, mass_at(system, q))
    parts = (state.q, state.v, rates, gaps(system, q, t))
    finite = jnp.all(jnp.isfinite(jnp.concatenate(parts)))
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


def _written(events: Events, flight: Flight, found: Outcome) -> Events:
    values = {
        "time": flight.state.t,
        "kind": found.kind,
        "contacts": found.contacts,
        "q": flight.state.q,
        "velocity_before": flight.state.v,
        "velocity_after": found.jump.v,
        "impulse": found.jump.impulse,
        "tangential_impulse": found.jump.tangential,
        "energy": found.jump.energy,
        "status": found.jump.code,
        "accumulation_end": found.accumulation_end,
    }
    return with_row(events, found.kind != KIND_CODE["none"], values)
