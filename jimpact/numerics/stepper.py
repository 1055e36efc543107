"""Event-aligned integration of the LZB flow: no step ever straddles a change of phase.

Each pass of the loop tries one step with frozen phases. It is accepted (and the phase of the
contact it landed on is changed), or it shows an event in its middle and the next pass lands on
it, or its error is too large and it is shortened. As soon as the contacts at work are decoupled
from each other and press no other contact, the rest follows from the energy in closed form.
"""

import jax
import jax.numpy as jnp

from jimpact.numerics import columns, events, flow as flows, isolated
from jimpact.numerics.columns import by_itself
from jimpact.numerics.contacts import all_of, any_of, first_least, least
from jimpact.numerics.flow import (
    COMPRESSION,
    EXPANSION,
    FROM_GAP,
    OPEN,
    START,
    Flow,
    State,
    lands,
    rates_of,
)
from jimpact.numerics.steps import (
    FIRST_TIME,
    Carry,
    Control,
    Verdict,
    error_of,
    interval,
    local_tolerance,
    next_step,
    patience,
    time_span,
)

WORTH_HALVING = 600  # impacts of a batch: fewer gain less than a second loop takes to compile


def begin(flow: Flow, control: Control, gamma: jax.Array, x: jax.Array) -> Carry:
    """State before the impact; a touching contact at rest starts in compression."""
    phase = jnp.where((gamma <= 0) | (x > 0), COMPRESSION, OPEN).astype(jnp.int32)
    phase = jnp.where(x < 0, OPEN, phase)
    phase = jnp.where((x > 0) & (gamma > 0), EXPANSION, phase)
    # loaded, separating and e = 0: it opens at once and returns nothing
    spent = (phase == EXPANSION) & (flow.restitution == 0)
    phase, x = jnp.where(spent, OPEN, phase), jnp.where(spent, 0.0, x)
    s = jnp.where(phase == EXPANSION, flow.restitution, 1.0)
    g = gamma / s
    zero, no = jnp.zeros_like(gamma[:1]), jnp.zeros(gamma[:1].shape, bool)
    state = State(x, g, jnp.zeros_like(gamma), zero)
    if flow.slackens:
        state = events.jumped(flow, state, (x == 0) & (gamma < 0))
    first = FIRST_TIME ** (1 / flow.root)
    carry = Carry(
        state=state,
        phase=phase,
        kind=jnp.full(no.shape, START, jnp.int32),
        target=jnp.zeros(gamma.shape, bool),
        h=jnp.full_like(zero, first),
        due=zero,
        begun=zero,
        retargeted=no,
        passes=jnp.zeros(no.shape, jnp.int32),
        closures=jnp.zeros(gamma.shape, jnp.int32),
        done=no,
    )
    return _finish(flow, control, _fly(flow, carry) if flow.gapped else carry)


def run(flow: Flow, control: Control, carry: Carry) -> Carry:
    """Run impacts from `begin` to their end, or to the pass limit."""

    def active(c: Carry) -> jax.Array:
        return ~c.done & (c.passes < control.max_steps)

    def passes(flow: Flow, control: Control, carry: Carry, up_to: int) -> Carry:
        """Until no more than `up_to` impacts are active."""
        return jax.lax.while_loop(
            lambda c: jnp.sum(active(c)) > up_to,
            lambda c: advance(flow, control, c, active(c)),
            carry,
        )

    batch = carry.h.shape[1:]
    if not batch or batch[0] < WORTH_HALVING or not control.halving:
        return passes(flow, control, carry, 0)
    # half of a batch takes a third longer than the other one, which does not wait for it
    size, half = batch[0], batch[0] // 2
    carry = passes(flow, control, carry, half)
    order = jnp.argsort(~active(carry)[0])
    tolerance = columns.take(control.tolerance, order[:half], size)
    rest = run(
        columns.take(flow, order[:half], size),
        control._replace(tolerance=tolerance),
        columns.take(carry, order[:half], size),
    )
    return columns.put(carry, rest, order)


def advance(flow: Flow, control: Control, carry: Carry, active: jax.Array) -> Carry:
    """One pass of the loop, for the impacts of a batch that are `active`."""
    before = carry
    # where events lie and how long steps are is decided, not differentiated
    h, due, begun = jax.lax.stop_gradient((carry.h, carry.due, carry.begun))
    carry = carry._replace(h=h, due=due, begun=begun)
    reached, error = by_itself(lambda: _try(flow, control, carry), carry.h)
    verdict = by_itself(lambda: _judge(flow, control, carry, reached, error), carry.h)
    moved, new_phase, closed = by_itself(lambda: _move(flow, carry, reached, verdict), carry.h)
    out = by_itself(
        lambda: next_step(flow, control, carry, verdict, error, moved, new_phase, closed), carry.h
    )

    def end() -> Carry:
        after = _finish(flow, control, _fly(flow, out) if flow.gapped else out)
        return jax.tree.map(lambda a, b: jnp.where(active, a, b), after, before)

    return by_itself(end, carry.h)


def _try(flow: Flow, control: Control, carry: Carry) -> tuple[State, jax.Array]:
    """State at the end of a trial step, and its error in tolerances."""
    start, length = interval(flow, control, carry)
    control = control._replace(tolerance=local_tolerance(control, carry))
    reached, high, low = control.step(
        flow,
        carry.phase,
        carry.state,
        carry.kind,
        carry.target,
        start,
        length,
        carry.due,
        control.tolerance,
    )
    old, new, high, low = jax.lax.stop_gradient((carry.state, reached, high, low))
    return reached, error_of(control, jnp.minimum(old.x, new.x), high, low)


def _judge(flow: Flow, control: Control, carry: Carry, reached: State, error: jax.Array) -> Verdict:
    state, new = jax.lax.stop_gradient((carry.state, reached))
    span = time_span(flow, carry)
    unit = rates_of(flows.frozen(flow), carry.phase).unit
    timed = lands(carry.kind) & (unit > 0)  # a landing takes other than the time expected
    took = jnp.where(timed, (new.t - state.t) / jnp.where(timed, unit, 1.0), span)
    found = events.find(
        flows.frozen(flow),
        control.tolerance,
        carry.phase,
        carry.kind,
        carry.target,
        took,
        state,
        new,
    )
    finite = jnp.isfinite(error)
    exact = finite & (error <= 1)
    flips = exact & any_of(found.at_once)
    return Verdict(
        found=found,
        span=span,
        flips=flips,
        inside=exact & ~flips & found.inside,
        accept=exact & ~flips & ~found.inside,
        broken=~finite & ~lands(carry.kind) & (span < events.SHORTEST),
    )


def _move(
    flow: Flow, carry: Carry, reached: State, verdict: Verdict
) -> tuple[State, jax.Array, jax.Array]:
    """State, phases and which contacts closed, once the step is accepted or refused."""
    found, accept, landing = verdict.found, verdict.accept, lands(carry.kind)
    arrived = jnp.where(verdict.flips, found.at_once, accept & landing & carry.target)
    moved = State(*(jnp.where(accept, b, a) for a, b in zip(carry.state, reached)))
    # given up, for the status to say
    moved = moved._replace(p=jnp.where(verdict.broken, jnp.nan, moved.p))
    return events.change_phase(flow, carry.phase, moved, arrived, found.opens)


def _fly(flow: Flow, carry: Carry) -> Carry:
    """While all contacts are open, go to the next closing in one step, however far it is."""
    state = jax.lax.stop_gradient(carry.state)
    dx = rates_of(flows.frozen(flow), carry.phase).closing * state.g
    closing = (carry.phase == OPEN) & (state.x < 0) & (dx > 0)
    due = jnp.where(closing, -state.x / jnp.where(closing, dx, 1.0), jnp.inf)
    flies = all_of(carry.phase == OPEN) & any_of(closing)
    return carry._replace(
        kind=jnp.where(flies, FROM_GAP, carry.kind).astype(jnp.int32),
        target=jnp.where(flies, first_least(due), carry.target),
        due=jnp.where(flies, least(due), carry.due),
        retargeted=carry.retargeted & ~flies,
    )


def _finish(flow: Flow, control: Control, carry: Carry) -> Carry:
    """End the impact if nothing is left to integrate."""
    tolerance = control.tolerance * patience(carry, control.contacts)
    alone, end = isolated.finish(
        flow, tolerance, carry.phase, carry.state, control.closed_form, control.beyond
    )
    over = ~carry.done & alone
    return carry._replace(
        state=State(*(jnp.where(over, b, a) for a, b in zip(carry.state, end))),
        phase=jnp.where(over, OPEN, carry.phase).astype(jnp.int32),
        done=carry.done | over,
    )
