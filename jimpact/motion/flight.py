"""From one event to the next: diffrax steps, landed on samples and events.

A step is a trial. It is taken again, shorter, where its error is too large; where something
watched crosses zero in it (seen on cubics), the step is aimed at the crossing until it lands there.
The last remainder is a Newton step whose derivative is that of the event time: `dt = -g / g'`. Step
lengths themselves are no part of the derivative.
"""

import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp

from jimpact.motion.contact_forces import (
    Contacts,
    Modes,
    constraint_impulse,
    contacts_at,
    forces,
    powers,
)
from jimpact.motion.dynamics import definite, mass_at, user_force
from jimpact.motion.modes import REST_ACCELERATION
from jimpact.motion.record import Events
from jimpact.motion.system import System

LANDED = 1e-8  # of the step: a landing this near is finished by one Newton step (error: squared)
LANDINGS = 25  # trials to land on a crossing; it was none if that fails (the gap only grazes 0)
SAFETY, SHRINK, GROW = 0.9, 0.2, 5.0  # step-size control, as usual
SMALLEST_STEP = 1e-15  # of the time: below it the step does not move time any more
ROUNDING_GAP = 1e-5  # of the gap that counts as closed: below it a gap is rounding
_CELLS = 16  # of a step, in which a cubic is looked at for signs
_POLISH = 3  # Newton steps on the cubic, from the chord of the cell


class State(NamedTuple):
    """What is integrated: q, v, work of forces, of the base, of each contact [J]."""

    q: jax.Array
    v: jax.Array
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
    solver: Any
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


class Flight(NamedTuple):
    """A flight under way."""

    t: jax.Array
    state: State
    step: jax.Array  # of the error control
    aim: jax.Array  # length of the next trial where it is aimed at something, else inf
    aimed: jax.Array  # (k,) one-hot: what the trial is to land on
    landings: jax.Array
    event: jax.Array  # (k,) one-hot: what has happened
    sample: jax.Array  # number of samples reached
    samples: State
    steps: jax.Array
    stuck: jax.Array
    undefined: jax.Array  # the last trial was not a number


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


class Seen(NamedTuple):
    """Watched values (k,), their rates, and the rates of the state."""

    value: jax.Array
    rate: jax.Array
    slope: State


class Along(NamedTuple):
    """Functions of (t, state) for one set of modes."""

    rates: Callable[[jax.Array, State], State]
    watch: Callable[[jax.Array, State], Seen]
    project: Callable[[jax.Array, State], State]


def along(
    system: System, mu: jax.Array | None, settings: Settings, modes: Modes, scales: Scales
) -> Along:
    """The functions for one set of modes."""

    def contacts(t: jax.Array, y: State) -> Contacts:
        return contacts_at(system, y.q, y.v, t, settings.friction)

    def rates(t: jax.Array, y: State, args: Any = None) -> State:
        given = contacts(t, y)
        found = forces(given, mu, modes)
        friction, base = powers(system, given, found, t)
        power = user_force(system, y.q, y.v, t) @ y.v
        per_contact = jnp.stack([jnp.zeros_like(friction), friction])
        return State(y.v, found.acceleration, power, base, per_contact)

    def watch(t: jax.Array, y: State) -> Seen:
        slope = rates(t, y)
        see = lambda t, y: watched(contacts(t, y), mu, modes, scales)  # noqa: E731
        value, rate = jax.jvp(see, (t, y), (jnp.ones_like(t), slope))
        return Seen(value, rate, slope)

    def project(t: jax.Array, y: State) -> State:
        given = contacts(t, y)
        value, rate = given.normal.value, given.normal.rate
        if given.tangent is not None:  # tangentially only velocities drift
            value = jnp.concatenate([value, jnp.zeros_like(value)])
            rate = jnp.concatenate([rate, given.tangent.rate])
        p = constraint_impulse(given, mu, modes, jnp.stack([value, rate], axis=1))
        move = given.moved @ p
        return y._replace(q=y.q + move[:, 0], v=y.v + move[:, 1])

    return Along(rates, watch, project)


class Crossing(NamedTuple):
    """The first crossing in a step: whether there is one, of which quantity, when, or too short."""

    found: jax.Array  # ()
    which: jax.Array  # (k,) one-hot
    time: jax.Array  # () after the beginning of the step
    unseen: jax.Array  # () something rose and fell between the looks: a shorter step is needed


def cubic(s: jax.Array, h: jax.Array, ends: tuple[jax.Array, ...]) -> jax.Array:
    """The cubic with values g0, g1 and slopes d0, d1 at s = 0, 1 (time s h)."""
    g0, d0, g1, d1 = ends
    a, b = h * d0 - (g1 - g0), -h * d1 + (g1 - g0)
    return (1 - s) * g0 + s * g1 + s * (1 - s) * ((1 - s) * a + s * b)


def first_crossing(
    h: jax.Array,
    before: tuple[jax.Array, jax.Array],
    after: tuple[jax.Array, jax.Array],
    rounding: jax.Array,
) -> Crossing:
    """First crossing below `-rounding` in a step of length h.

    Args:
        h: length of the step.
        before: values (k,) and rates (k,) at its beginning.
        after: the same at its end.
        rounding: (k,) values between `-rounding` and `rounding` are zero.

    What begins at zero (a contact just left) is no crossing until it has been above zero.
    """
    ends = tuple(x[None, :] for x in (*before, *after))
    s = jnp.linspace(0.0, 1.0, _CELLS + 1, dtype=h.dtype)[:, None]
    values = cubic(s, h, ends)
    above = jax.lax.cummax((values > rounding[None, :]).astype(jnp.int32), axis=0) > 0
    below = values < -rounding[None, :]
    earlier_above = jnp.concatenate([jnp.zeros_like(above[:1]), above[:-1]])
    crossed = below & earlier_above
    never = jnp.any(below, axis=0) & ~jnp.any(crossed, axis=0)
    at_once = never & (before[1] <= 0)
    cell = jnp.argmax(crossed, axis=0)
    index = jnp.arange(values.shape[1])
    left, right = values[cell - 1, index], values[cell, index]
    share = jnp.clip(left / jnp.where(left > right, left - right, 1.0), 0.0, 1.0)
    low, high = ((cell + i).astype(h.dtype) / _CELLS for i in (-1, 0))
    at = low + share / _CELLS
    found = jnp.any(crossed, axis=0) | at_once
    flat = tuple(x[0] for x in ends)
    for _ in range(_POLISH):
        value, slope = jax.jvp(lambda x: cubic(x, h, flat), (at,), (jnp.ones_like(at),))
        falls = slope < 0  # before the top of a short hop Newton has no direction
        newton = at - value / jnp.where(falls, slope, -1.0)
        at = jnp.clip(jnp.where(falls, newton, 0.5 * (at + high)), low, high)
    at = jnp.where(at_once, 0.0, at)
    when = jnp.where(found, at * h, jnp.inf)
    which = (index == jnp.argmin(when)) & jnp.any(found)
    return Crossing(jnp.any(found), which, jnp.min(when), jnp.any(never & ~at_once))


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
    n_targets, m = targets.shape[0], modes.active.shape[0]
    at = along(system, mu, settings, modes, scales)
    floor = ROUNDING_GAP * settings.closed_below
    small = jnp.where(modes.active, 0.0, jnp.broadcast_to(floor, (m,)))
    slip_rounding = jnp.full(m, REST_ACCELERATION) * scales.speed
    rounding = jnp.concatenate([small, slip_rounding]) if settings.friction else small

    def going(flight: Flight) -> jax.Array:
        return ~jnp.any(flight.event) & (flight.sample < n_targets) & ~flight.stuck

    def one(flight: Flight) -> Flight:
        return _trial(system, at, settings, targets, rounding, flight)

    return jax.lax.while_loop(going, one, begin)


class _Verdict(NamedTuple):
    """What becomes of a trial."""

    again: jax.Array  # not taken
    lands: jax.Array  # taken, an event
    which: jax.Array  # (k,) one-hot: the event, or what is aimed at
    step: jax.Array  # of the error control
    aim: jax.Array  # length of the next trial, inf if it is not aimed


def _trial(
    system: System,
    at: Along,
    settings: Settings,
    targets: jax.Array,
    rounding: jax.Array,
    flight: Flight,
) -> Flight:
    t, y = flight.t, flight.state
    remaining = targets[jnp.minimum(flight.sample, targets.shape[0] - 1)] - t
    free = jax.lax.stop_gradient(jnp.minimum(flight.step, flight.aim))
    at_sample = free >= remaining * (1 - LANDED)
    h = jnp.where(at_sample, remaining, free)
    new, error = _step(system, at, settings, t, h, y)
    new = at.project(t + h, new)
    both = jax.tree.map(lambda *x: jnp.stack(x), (t, y), (t + h, new))
    seen = jax.vmap(at.watch)(*both)  # one program for both ends
    before, after = (jax.tree.map(operator.itemgetter(i), seen) for i in (0, 1))
    plain = jax.lax.stop_gradient((h, before[:2], after[:2], error))
    verdict = _judge(settings, flight, plain, rounding, at_sample)
    kept = _taken(flight, verdict, t + h, new, after, at_sample, targets)
    span = jnp.abs(t) + jnp.abs(targets[-1])
    tiny = verdict.again & (verdict.step < SMALLEST_STEP * span)
    steps = flight.steps + 1
    stuck = tiny | (steps >= settings.max_steps)
    return kept._replace(steps=steps, stuck=stuck, undefined=jnp.isnan(error))


def _judge(
    settings: Settings,
    flight: Flight,
    plain: tuple[Any, ...],
    rounding: jax.Array,
    at_sample: jax.Array,
) -> _Verdict:
    length, before, after, error = plain
    crossing = first_crossing(length, before, after, rounding)
    aiming = jnp.any(flight.aimed)
    # where the aimed quantity would cross, seen from the end of the trial
    g, rate = (jnp.sum(jnp.where(flight.aimed, x, 0.0)) for x in after)
    ahead = jnp.where(rate < 0, -g / jnp.where(rate < 0, rate, 1.0), jnp.inf)
    coarse = ~(error <= 1)  # not a number, too
    near = LANDED * length + SMALLEST_STEP * jnp.abs(flight.t)
    seen = crossing.found & (crossing.time < length - near)
    # what fell between the looks fell early: before anything that was found later in the step
    unseen = crossing.unseen & (length > near)
    short = aiming & ~crossing.found & (ahead < jnp.inf)
    zero = jnp.abs(g) <= jnp.sum(jnp.where(flight.aimed, rounding, 0.0))
    arrived = short & ((jnp.abs(ahead) <= near) | zero)
    missed = short & ~arrived & ~at_sample
    again = coarse | ((seen | unseen | missed) & (flight.landings < LANDINGS))
    lands = ~again & ((crossing.found & ~seen) | arrived)
    factor = jnp.clip(SAFETY * error ** (-1 / settings.solver.order(None)), SHRINK, GROW)
    factor = jnp.where(coarse, jnp.where(error > 1, jnp.minimum(factor, 1.0), SHRINK), factor)
    clipped = (length < flight.step) & ~coarse
    step = jnp.where(clipped, jnp.maximum(flight.step, factor * length), factor * length)
    step = jnp.where(again & ~coarse, flight.step, step)
    longer = length + jnp.minimum(ahead, length)
    aim = jnp.where(unseen, length * SHRINK, jnp.where(seen, crossing.time, longer))
    aim = jnp.where(again & ~coarse, aim, jnp.inf)
    which = jnp.where(crossing.found, crossing.which, flight.aimed & short)
    return _Verdict(again, lands, which, step, aim)


def _taken(
    flight: Flight,
    verdict: _Verdict,
    t: jax.Array,
    new: State,
    after: Seen,
    at_sample: jax.Array,
    targets: jax.Array,
) -> Flight:
    """The flight after the trial: moved by the last remainder where it lands on an event."""
    again, lands, which = verdict.again, verdict.lands, verdict.which
    g, rate = (jnp.sum(jnp.where(which, x, 0.0)) for x in after[:2])
    left = jnp.where(lands & (rate < 0), -g / jnp.where(rate < 0, rate, 1.0), 0.0)
    moved = jax.tree.map(lambda x, d: x + left * d, new, after.slope)
    state = jax.tree.map(lambda a, b: jnp.where(again, a, b), flight.state, moved)
    sampled = ~again & at_sample & ~lands
    row = (jnp.arange(targets.shape[0], dtype=flight.sample.dtype) == flight.sample) & sampled
    samples = jax.tree.map(
        lambda all_, x: jnp.where(row.reshape((-1,) + (1,) * x.ndim), x[None], all_),
        flight.samples,
        new,
    )
    return Flight(
        t=jnp.where(again, flight.t, t + left),
        state=state,
        step=verdict.step,
        aim=verdict.aim,
        aimed=which & again,
        landings=jnp.where(again, flight.landings + 1, 0),
        event=which & lands,
        sample=flight.sample + sampled.astype(flight.sample.dtype),
        samples=samples,
        steps=flight.steps,
        stuck=flight.stuck,
        undefined=flight.undefined,
    )


def _step(
    system: System, at: Along, settings: Settings, t: jax.Array, h: jax.Array, y: State
) -> tuple[State, jax.Array]:
    """One step of the solver, and its error over what is allowed."""
    term = diffrax.ODETerm(at.rates)
    solver = settings.solver
    memory = solver.init(term, t, t + h, y, None)
    new, error, _, _, _ = solver.step(term, t, t + h, y, None, memory, False)

    def over(x: jax.Array, before: jax.Array, after: jax.Array) -> jax.Array:
        size = jnp.maximum(jnp.abs(before), jnp.abs(after))
        return jnp.max(jnp.abs(x) / (settings.atol + settings.rtol * size))

    errors = [over(error.q, y.q, new.q), over(error.v, y.v, new.v)]
    largest = jnp.maximum(*errors)
    return new, jnp.where(definite(mass_at(system, new.q)), largest, jnp.nan)
