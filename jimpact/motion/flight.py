"""From one event to the next: diffrax steps, landed on samples and events.

A step is a trial. It is taken again, shorter, where its error is too large; where something
watched crosses zero in it, the step is aimed at the crossing until it lands there. The last
remainder is a Newton step whose derivative is that of the event time: `dt = -g / g'`. Step
lengths themselves are no part of the derivative.
"""

import operator
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp

from jimpact.motion.along import Along, Seen, along
from jimpact.motion.contact_forces import Modes
from jimpact.motion.crossings import first_crossing
from jimpact.motion.dynamics import definite, mass_at
from jimpact.motion.flight_records import Flight, Scales, Settings, State
from jimpact.motion.modes import REST_ACCELERATION
from jimpact.motion.system import System

LANDED = 1e-8  # of the step: a landing this near is finished by one Newton step (error: squared)
LANDINGS = 25  # trials to land on a crossing; it was none if that fails (the gap only grazes 0)
SAFETY, SHRINK, GROW = 0.9, 0.2, 5.0  # step-size control, as usual
SMALLEST_STEP = 1e-15  # of the time: below it the step does not move time any more
ROUNDING_GAP = 1e-5  # of the gap that counts as closed: below it a gap is rounding


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
    term = diffrax.ODETerm(at.rates)  # type: ignore[arg-type]
    solver = settings.solver
    memory = solver.init(term, t, t + h, y, None)
    new, error, _, _, _ = solver.step(term, t, t + h, y, None, memory, False)

    def over(x: jax.Array, before: jax.Array, after: jax.Array) -> jax.Array:
        size = jnp.maximum(jnp.abs(before), jnp.abs(after))
        return jnp.max(jnp.abs(x) / (settings.atol + settings.rtol * size))

    errors = [over(error.q, y.q, new.q), over(error.v, y.v, new.v)]
    largest = jnp.maximum(*errors)
    return new, jnp.where(definite(mass_at(system, new.q)), largest, jnp.nan)
