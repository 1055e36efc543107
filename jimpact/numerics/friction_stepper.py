"""Event-aligned integration of the frictional flow: no step straddles a change of modes.

A pass tries one step. It is accepted, or shows an event that the next one lands on, or is
shortened: as in `stepper.py`, without what makes that one fast in batches.
"""

import jax
import jax.numpy as jnp

from jimpact.numerics import friction_events as events
from jimpact.numerics.columns import by_itself
from jimpact.numerics.contacts import all_of, any_of, largest, of
from jimpact.numerics.events import NEGLIGIBLE, SHORTEST, matters
from jimpact.numerics.flow import COMPRESSION, EXPANSION, OPEN, START, rates_of
from jimpact.numerics.friction_flow import (
    HOLDING,
    ROOT_X,
    Frictional,
    Modes,
    State,
    field,
    size,
    slowing,
    speed_of,
    step,
    still,
)
from jimpact.numerics.friction_steps import Carry, Verdict, error_of, interval, next_step, time_span
from jimpact.numerics.steps import FIRST_TIME, WIDENED

PATIENCE = 200  # passes a contact after which what is left may be WIDENED times larger


def begin(
    flow: Frictional, tolerance: jax.Array, gamma: jax.Array, slip: jax.Array, x: jax.Array
) -> Carry:
    """State before the impact."""
    phase = jnp.where((gamma <= 0) | (x > 0), COMPRESSION, OPEN)
    phase = jnp.where((x > 0) & (gamma > 0), EXPANSION, phase).astype(jnp.int32)
    restitution = jnp.broadcast_to(flow.normal.restitution, gamma.shape)
    # loaded, separating and e = 0: it opens at once and returns nothing
    spent = (phase == EXPANSION) & (restitution == 0)
    phase, x = jnp.where(spent, OPEN, phase), jnp.where(spent, 0.0, x)
    s = jnp.where(phase == EXPANSION, restitution, 1.0)
    none, no = jnp.zeros_like(gamma), jnp.zeros(gamma.shape, bool)
    zero = jnp.zeros_like(gamma[:1])
    state = State(x, gamma / s, slip, none, jnp.zeros_like(slip), zero)
    sign = jnp.sign(slip) if flow.rows == 1 else none
    modes = Modes(phase, no, jax.lax.stop_gradient(sign))
    closed = phase != OPEN
    state, modes = events.decided(flow, modes, tolerance, state, no, closed)
    return _over(
        flow,
        tolerance,
        Carry(
            state=state,
            modes=modes,
            kind=jnp.full(zero.shape, START, jnp.int32),
            target=jnp.tile(no, (4,) + (1,) * (gamma.ndim - 1)),
            h=jnp.full_like(zero, FIRST_TIME ** (1 / flow.normal.root)),
            due=zero,
            begun=zero,
            retargeted=no[:1],
            passes=jnp.zeros(zero.shape, jnp.int32),
            closures=jnp.zeros(gamma.shape, jnp.int32),
            done=no[:1],
        ),
    )


def run(flow: Frictional, tolerance: jax.Array, max_steps: int, carry: Carry) -> Carry:
    """To the end, or to the limit of passes."""

    def active(c: Carry) -> jax.Array:
        return ~c.done & (c.passes < max_steps)

    def body(c: Carry) -> Carry:
        after = advance(flow, tolerance, c)
        return jax.tree.map(lambda a, b: jnp.where(active(c), a, b), after, c)

    return jax.lax.while_loop(lambda c: jnp.any(active(c)), body, carry)


def advance(flow: Frictional, tolerance: jax.Array, carry: Carry) -> Carry:
    """One pass."""
    # where events lie and how long steps are is decided, not differentiated
    h, due, begun = jax.lax.stop_gradient((carry.h, carry.due, carry.begun))
    carry = carry._replace(h=h, due=due, begun=begun)

    def attempt() -> tuple[State, State, State]:
        start, length = interval(flow, carry, tolerance)
        return step(flow, carry.modes, carry.state, carry.kind, carry.target, start, length)

    tried = by_itself(attempt, h)
    verdict = by_itself(lambda: _judge(still(flow), tolerance, carry, tried), h)

    def move() -> tuple[State, Modes, jax.Array]:
        moved = State(*(jnp.where(verdict.accept, b, a) for a, b in zip(carry.state, tried[0])))
        moved = moved._replace(p=jnp.where(verdict.broken, jnp.nan, moved.p))
        moved = _on_event(flow, carry.modes, moved, verdict.rates, verdict.arrived)
        return events.change(flow, carry.modes, tolerance, moved, verdict.arrived)

    state, modes, closed = by_itself(move, h)

    def following() -> Carry:
        out = next_step(flow, carry, verdict, closed)
        out = out._replace(state=state, modes=modes, done=carry.done | verdict.broken)
        return _over(flow, tolerance, out)

    return by_itself(following, h)


def _judge(
    flow: Frictional, tolerance: jax.Array, carry: Carry, tried: tuple[State, State, State]
) -> Verdict:
    old = jax.lax.stop_gradient(carry.state)
    new, high, low = jax.lax.stop_gradient(tried)
    error = error_of(flow, tolerance, high, low)
    unit = rates_of(flow.normal, carry.modes.phase).unit
    span = time_span(flow, carry, unit, new.t - old.t)
    rates, before, slope, turns = _along(flow, carry.modes, tolerance, old)
    rates_end, after, slope_end, turns_end = _along(flow, carry.modes, tolerance, new)
    if flow.rows == 2:
        slow = jnp.minimum(size(old.u, 2), size(new.u, 2))
        angle = span * jnp.maximum(turns, turns_end) / jnp.where(slow > 0, slow, 1.0)
        error = jnp.maximum(error, largest((angle / events.STABLE) ** 8))
    values = (before, slope, after, slope_end)
    landing = (carry.kind, carry.target)
    found = events.find(flow, carry.modes, tolerance, landing, span, (old, new), values, turns)
    exact = jnp.isfinite(error) & (error <= 1)
    flips = exact & any_of(found.at_once)
    accept = exact & ~flips & ~found.inside
    there = (carry.kind != HOLDING) | (jnp.abs(after) <= events.beside(tolerance))
    ends = accept & (carry.kind >= ROOT_X) & there & carry.target
    return Verdict(
        found=found,
        error=error,
        span=span,
        inside=exact & ~flips & found.inside,
        accept=accept,
        flips=flips,
        broken=~jnp.isfinite(error) & (carry.kind < ROOT_X) & (span < SHORTEST),
        arrived=jnp.where(flips, found.at_once, ends),
        rates=State(*(jnp.where(accept, b, a) for a, b in zip(rates, rates_end))),
    )


def _on_event(
    flow: Frictional, modes: Modes, state: State, rates: State, arrived: jax.Array
) -> State:
    """The state with the derivatives it has where slip ends: forces jump there.

    A step that was aimed at the event has them; one that came to lie on it has not.
    """
    m = len(state.x)
    stops = arrived[2 * m : 3 * m]
    mark = stops & (jnp.cumsum(stops, axis=0) == 1)
    slope = of(
        mark, slowing(flow, jax.lax.stop_gradient(modes), jax.lax.stop_gradient(state.u), rates.u)
    )
    speed = speed_of(flow, modes, state.u)
    missed = of(mark, speed - jax.lax.stop_gradient(speed))
    wait = jnp.where(slope == 0, 0.0, -missed / jnp.where(slope == 0, 1.0, slope))
    return State(*(y + wait * dy for y, dy in zip(state, rates)))


def _along(
    flow: Frictional, modes: Modes, tolerance: jax.Array, state: State
) -> tuple[State, jax.Array, jax.Array, jax.Array]:
    """Rates of the state, margins and their slopes, and how fast directions of slip turn."""
    rates = field(flow, modes, rates_of(flow.normal, modes.phase), state)
    values, slopes = jax.jvp(
        lambda y: events.margins(flow, modes, tolerance, y), (state,), (rates,)
    )
    turns = events.turning(flow, modes, state, rates) if flow.rows == 2 else state.x
    return rates, values, slopes, turns


def _over(flow: Frictional, tolerance: jax.Array, carry: Carry) -> Carry:
    """Whether nothing is left to integrate."""
    drags = carry.passes > PATIENCE * len(carry.closures)
    wide = tolerance * jnp.where(drags, WIDENED, 1.0).astype(tolerance.dtype)
    loaded = matters(flow.normal, wide, carry.state, NEGLIGIBLE)  # type: ignore[arg-type]
    return carry._replace(done=carry.done | all_of((carry.modes.phase == OPEN) | ~loaded))
