"""Flights and persistent contact: an instance of the event-aligned stepper, `events/stepper.py`."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from jimpact.events import stepper
from jimpact.motion.contact_forces import (
    Contacts,
    Modes,
    constraint_impulse,
    contacts_at,
    forces,
    powers,
)
from jimpact.motion.dynamics import definite, free_acceleration, mass_at, user_force
from jimpact.motion.modes import REST_ACCELERATION
from jimpact.motion.record import Events
from jimpact.motion.system import System

SMALLEST_STEP = 1e-15  # of the time: below it a step does not move time any more
ROUNDING_GAP = 1e-5  # of the gap that counts as closed: below it a gap is rounding
# Error allowed in the ledger, of what the errors allowed in q and v are worth: ten times more, and
# the steps of a body that rests on a moving base are those of the base's motion only.
LEDGER = 0.01


class State(NamedTuple):
    """What is integrated: q, v, t, and work of forces, of the base, of each contact [J]."""

    q: jax.Array
    v: jax.Array
    t: jax.Array  # ()
    work: jax.Array  # ()
    base_work: jax.Array  # ()
    contact_work: jax.Array  # (2, m): normal (impacts), tangential


class Settings(NamedTuple):
    """Tolerances of a motion."""

    rtol: float
    atol: float
    closed_below: jax.Array
    max_steps: int
    friction: bool
    duration: jax.Array
    accumulation: jax.Array  # gap velocity that counts as slow, over the largest of the motion


class Scales(NamedTuple):
    """Largest values of the motion so far."""

    gap_velocity: jax.Array
    speed: jax.Array  # gap velocity that all kinetic energy could give a contact
    acceleration: jax.Array


class Course(NamedTuple):
    """A whole motion: states at the sampled times, events, number of steps, status."""

    samples: State
    events: Events
    steps: jax.Array
    status: jax.Array


def watched(given: Contacts, mu: jax.Array | None, modes: Modes, scales: Scales) -> jax.Array:
    """What must stay positive (k,): gaps or normal forces, then friction."""
    m = modes.active.shape[0]
    found = forces(given, mu, modes)
    w = jnp.diagonal(given.delassus)
    slack = REST_ACCELERATION * scales.acceleration
    normal = jnp.where(modes.active, found.normal * w[:m] + slack, given.normal.value)
    if given.tangent is None or mu is None or found.tangential is None:
        return normal
    cone = (mu * found.normal - jnp.abs(found.tangential)) * w[m:] + slack
    slip = modes.sign * given.tangent.rate
    side = jnp.where(modes.active, jnp.where(modes.stick, cone, slip), 1.0)
    return jnp.concatenate([normal, side])


class MechanicalFlow(eqx.Module):
    """A system with frozen modes of contact, an instance of the protocol of the stepper.

    State (rows): q, v, t and the ledger. Modes (rows): for each contact, whether it is persistent,
    whether it sticks, the sign of its sliding. Margins: gaps of open contacts, normal forces of
    persistent ones, then friction (the cone, or the speed of sliding), then the time left to the
    next sample; all in units of their rounding.
    """

    system: System
    mu: jax.Array | None
    scales: Scales
    rounding: jax.Array  # (k,)
    sample: jax.Array  # time of the next sample ()
    tolerance: jax.Array  # (rows, 1)
    like: State  # of its shapes

    root = 1
    contacts = 1
    near = 0.01  # steps in time are exact for parabolas: only the last of a landing is not in time

    @property
    def snap(self) -> jax.Array:
        """Margins are in units of their rounding."""
        return jnp.ones((1, 1), self.tolerance.dtype)

    def constants(self, modes: jax.Array) -> Modes:
        """The modes, of each contact."""
        active, stick, sign = modes[:, 0].reshape(3, -1)
        return Modes(active > 0, stick > 0, sign.astype(self.tolerance.dtype))

    def _contacts(self, at: State) -> Contacts:
        return contacts_at(self.system, at.q, at.v, at.t, self.mu is not None)

    def field(self, const: Modes, modes: jax.Array, y: jax.Array) -> jax.Array:
        """Rates of the state; NaN where M is not positive definite."""
        at = unpacked(self.like, y)
        given = self._contacts(at)
        found = forces(given, self.mu, const)
        friction, base = powers(self.system, given, found, at.t)
        power = user_force(self.system, at.q, at.v, at.t) @ at.v
        per_contact = jnp.stack([jnp.zeros_like(friction), friction])
        rates = State(at.v, found.acceleration, jnp.ones_like(at.t), power, base, per_contact)
        if callable(self.system.mass):
            regular = definite(mass_at(self.system, at.q))
            return jnp.where(regular, packed(rates), jnp.nan)
        return packed(rates)

    def margins(self, const: Modes, modes: jax.Array, y: jax.Array) -> jax.Array:
        """What must stay positive, and the time to the next sample."""
        at = unpacked(self.like, y)
        seen = watched(self._contacts(at), self.mu, const, self.scales)
        return (jnp.append(seen, self.sample - at.t) / self.rounding)[:, None]

    def rooted(self, modes: jax.Array) -> jax.Array:
        """None: forces are smooth where modes change."""
        return jnp.zeros((self.rounding.shape[0], 1), bool)

    def switch(
        self, modes: jax.Array, y: jax.Array, which: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Nothing: what happens at events is decided in `transitions.py`."""
        return modes, y

    def begins(self, before: jax.Array, after: jax.Array) -> jax.Array:
        """Never: see `rooted`."""
        return jnp.zeros((1, 1), bool)

    def coasts(self, modes: jax.Array) -> jax.Array | None:
        """Never: there are loads."""
        return None

    def over(self, modes: jax.Array, y: jax.Array, passes: jax.Array) -> jax.Array:
        """Never: a flight ends at its first event."""
        return jnp.zeros((1, 1), bool)

    def finish(self, modes: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Nothing."""
        return modes, y


def packed(state: State) -> jax.Array:
    """Rows (.., 1) of a state."""
    return ravel_pytree(state)[0][:, None]


def unpacked(like: State, y: jax.Array) -> State:
    """The state of rows (.., 1)."""
    return ravel_pytree(like)[1](y[:, 0])


def encoded(modes: Modes) -> jax.Array:
    """Modes as rows (3 m, 1) of whole numbers."""
    rows = [modes.active, modes.stick, modes.sign]
    return jnp.concatenate([x.astype(jnp.int32) for x in rows])[:, None]


def project(system: System, mu: jax.Array | None, friction: bool, modes: Modes, y: State) -> State:
    """Gaps and velocities of persistent contacts set to 0, in the metric of M."""
    given = contacts_at(system, y.q, y.v, y.t, friction)
    value, rate = given.normal.value, given.normal.rate
    if given.tangent is not None:  # tangentially only velocities drift
        value = jnp.concatenate([value, jnp.zeros_like(value)])
        rate = jnp.concatenate([rate, given.tangent.rate])
    p = constraint_impulse(given, mu, modes, jnp.stack([value, rate], axis=1))
    move = given.moved @ p
    return y._replace(q=y.q + move[:, 0], v=y.v + move[:, 1])


class Flight(NamedTuple):
    """A flight under way."""

    state: State
    plan: stepper.Carry  # the step to try
    event: jax.Array  # (k,) one-hot: what has happened
    sample: jax.Array  # number of samples reached
    samples: State
    steps: jax.Array
    stuck: jax.Array


def first_flight(
    settings: Settings, q0: jax.Array, v0: jax.Array, times: jax.Array, m: int
) -> Flight:
    """A flight at the beginning, with the first of the samples written down."""
    dtype, samples = q0.dtype, times.shape[0]
    zero = jnp.zeros((), dtype)
    state = State(q0, v0, times[0], zero, zero, jnp.zeros((2, m), dtype))
    unknown = jax.tree.map(lambda x: jnp.full((samples, *x.shape), jnp.nan, x.dtype), state)
    first = jax.tree.map(lambda all_, x: all_.at[0].set(x), unknown, state)
    k = 2 * m if settings.friction else m
    step = jax.lax.stop_gradient(times[1] - times[0])
    clock = jnp.stack([0 * step, step, 0 * step, 0 * step])[:, None]
    aim = stepper.Step(jnp.zeros((3 * m, 1), jnp.int32), jnp.zeros((k + 1, 1), bool), clock)
    plan = stepper.Carry(packed(state), aim, jnp.zeros((4, 1), dtype))
    none = jnp.int32(0)
    return Flight(state, plan, jnp.zeros(k, bool), jnp.int32(1), first, none, jnp.asarray(False))


def _loads(system: System, at: State) -> tuple[jax.Array, jax.Array, jax.Array]:
    """(q, v), generalized forces M q'' and momenta M v, without contacts."""
    mass = mass_at(system, at.q)
    free = free_acceleration(system, at.q, at.v, user_force(system, at.q, at.v, at.t), mass)
    both = jnp.stack([free, at.v], axis=1)
    pushed = mass[:, None] * both if mass.ndim == 1 else mass @ both
    return jnp.concatenate([at.q, at.v]), pushed[:, 0], pushed[:, 1]


def fly(
    system: System,
    mu: jax.Array | None,
    settings: Settings,
    modes: Modes,
    scales: Scales,
    targets: jax.Array,
    begin: Flight,
) -> Flight:
    """Integrate until something watched crosses zero, or to the last of `targets` (S,)."""
    n_targets = targets.shape[0]
    n = begin.state.q.shape[0]
    dtype = begin.state.q.dtype
    span = jnp.abs(targets[0]) + jnp.abs(targets[-1])
    slack = REST_ACCELERATION * scales.acceleration
    tiny = jnp.finfo(dtype).tiny
    normal = jnp.where(modes.active, slack, ROUNDING_GAP * settings.closed_below)
    side = jnp.where(modes.stick, slack, REST_ACCELERATION * scales.speed)
    parts = [normal, side] if settings.friction else [normal]
    rounding = jnp.concatenate([*parts, SMALLEST_STEP * span[None]])
    rounding = jax.lax.stop_gradient(jnp.maximum(rounding, jnp.sqrt(tiny)))
    rows = encoded(modes)
    k = rounding.shape[0]

    size, force, momentum = (jnp.abs(x) for x in _loads(system, begin.state))
    allowed = settings.atol + settings.rtol * size
    ledger = LEDGER * (allowed[:n] @ force + allowed[n:] @ momentum) + tiny

    def flow_at(flight: Flight) -> MechanicalFlow:
        state = flight.state
        size = jnp.abs(jnp.concatenate([state.q, state.v]))
        rest = jnp.full(packed(state).shape[0] - 2 * n, ledger).at[0].set(jnp.inf)  # of time: none
        tolerance = jnp.concatenate([settings.atol + settings.rtol * size, rest])[:, None]
        target = targets[jnp.minimum(flight.sample, n_targets - 1)]
        return MechanicalFlow(
            system, mu, scales, rounding, target, jax.lax.stop_gradient(tolerance), state
        )

    def toward_sample(flight: Flight) -> Flight:
        """The next step lands on the sample if it reaches it."""
        _, step, plan = flight.plan
        left = targets[jnp.minimum(flight.sample, n_targets - 1)] - flight.state.t
        h = step.clock[1, 0]
        lands = left <= h
        target = jnp.zeros((k, 1), bool).at[-1].set(lands)
        clock = jnp.stack([0 * h, h, 0 * h, lands.astype(dtype)])[:, None]
        plan = plan.at[0, 0].set(jnp.where(lands, left, h)).at[1].set(0.0)
        new = stepper.Carry(packed(flight.state), stepper.Step(rows, target, clock), plan)
        return flight._replace(plan=jax.lax.stop_gradient(new))

    def going(flight: Flight) -> jax.Array:
        return ~jnp.any(flight.event) & (flight.sample < n_targets) & ~flight.stuck

    def one(flight: Flight) -> Flight:
        flow = flow_at(flight)
        before = flight.plan
        carry = before._replace(y=packed(flight.state), plan=before.plan.at[2:].set(0.0))
        after, accept = stepper.advance(flow, carry, 2)
        accept = accept[0, 0]
        new = project(system, mu, settings.friction, modes, unpacked(flow.like, after.y))
        state = jax.tree.map(lambda a, b: jnp.where(accept, a, b), new, flight.state)
        landed = before.step.target[:, 0] & accept
        sampled = landed[-1]
        state = state._replace(t=jnp.where(sampled, flow.sample, state.t))
        row = (jnp.arange(n_targets, dtype=flight.sample.dtype) == flight.sample) & sampled
        samples = jax.tree.map(
            lambda all_, x: jnp.where(row.reshape((-1,) + (1,) * x.ndim), x[None], all_),
            flight.samples,
            state,
        )
        steps = flight.steps + 1
        short = ~accept & (after.step.clock[1, 0] < SMALLEST_STEP * span)
        moved = flight._replace(
            state=state,
            plan=jax.lax.stop_gradient(after)._replace(y=before.y),
            event=landed[:-1],
            sample=flight.sample + sampled.astype(flight.sample.dtype),
            samples=samples,
            steps=steps,
            stuck=short | (steps >= settings.max_steps),
        )
        aimed = toward_sample(moved)
        plan = jax.tree.map(lambda a, b: jnp.where(sampled, a, b), aimed.plan, moved.plan)
        return moved._replace(plan=plan)

    start = toward_sample(begin)
    return jax.lax.while_loop(going, one, start)
