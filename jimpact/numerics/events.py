"""Changes of phase of the contacts: where a trial step meets one, and what it does to the state.

A margin is the distance to a change of phase, >= 0 while the phase lasts: minus the gap velocity
in compression, gap velocity and indentation in expansion, gap velocity of an open contact.
Nothing here is differentiated but `change_phase`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jimpact.numerics.contacts import any_of, first_least, least
from jimpact.numerics.flow import (
    COMPRESSION,
    EXPANSION,
    ONSET,
    OPEN,
    ROOT_X,
    ZERO_G,
    Flow,
    State,
    apply,
    field,
    lands,
    rates_of,
)
from jimpact.numerics.powers import plus_one, power

SNAP = 1e-2  # events closer than this part of the tolerance are simultaneous
NEGLIGIBLE = 0.1  # approach below this part of the tolerance does not close a contact
CREEP = 0.5  # part of its indentation that a contact loses at most before a foreseen turning
IN_DOUBT = 0.01  # part of a step's change of slope that its minimum may lie lower than it seems
SHORTEST = 1e-13  # a step this small cannot be resolved: the pending event is taken at once


class Margin(NamedTuple):
    """Distances (m,) to a change of phase by indentation and by gap velocity."""

    x: jax.Array
    g: jax.Array


class Events(NamedTuple):
    """What a trial step of length `span` in time has met."""

    inside: jax.Array  # an event lies inside the step
    at_once: jax.Array  # (m,) these contacts change phase where the step begins
    opens: jax.Array  # (m,) of those and of the landing target: changes by opening
    first: jax.Array  # fraction of the step up to the earliest event
    by_opening: jax.Array  # the earliest event is an opening
    target: jax.Array  # (m,) one-hot, its contact
    monotone: jax.Array  # its variable runs towards it from the beginning of the step


def matters(
    flow: Flow, tolerance: jax.Array, state: State, part: float = NEGLIGIBLE + 2 * SNAP
) -> jax.Array:
    """Whether load and velocity of each contact are more than `part` of the tolerance."""
    total = power(state.x, plus_one(flow.exponent)) + state.g**2
    return jax.lax.stop_gradient(total > (part * tolerance) ** 2)


def find(
    flow: Flow,
    tolerance: jax.Array,
    phase: jax.Array,
    kind: jax.Array,
    target: jax.Array,
    span: jax.Array,
    state: State,
    new: State,
) -> Events:
    """Events between `state` and `new`; the one a landing step ends on is not among them."""
    snap = SNAP * tolerance
    slack = (phase == OPEN) & (state.x > 0)  # where the step begins: not a gap that closes
    before, after = (_margins(flow, tolerance, phase, slack, y) for y in (state, new))
    slope, slope_end = (_slopes(flow, phase, slack, y) for y in (state, new))
    landing = lands(kind)
    crossed_g = ~(target & (kind == ZERO_G)) & (after.g < -snap)
    crossed_x = ~(target & landing & (kind != ZERO_G)) & (after.x < -snap)
    dipped = ~(target & landing) & dips(before.g, after.g, slope.g * span, slope_end.g * span, snap)
    idle = ~matters(flow, tolerance, state) & ~matters(flow, tolerance, new)
    at_once = (crossed_g & (before.g <= snap) & (slope.g <= 0)) | (
        (crossed_g | crossed_x) & ((span < SHORTEST) | idle)
    )
    if flow.gapped:  # gaps that close together
        at_once |= crossed_x & (phase == OPEN) & (before.x <= snap) & (slope.x <= 0)
    at_g = jnp.where(crossed_g, crossing_at(before.g, after.g, slope.g * span), jnp.inf)
    at_x = jnp.where(crossed_x, crossing_at(before.x, after.x, slope.x * span), jnp.inf)
    at_dip = jnp.where(dipped, dip_at(before.g, after.g, slope.g * span), jnp.inf)
    soonest_x, soonest_g, dip = least(at_x), least(at_g), least(at_dip)
    by_opening = soonest_x <= soonest_g
    crossing = jnp.minimum(soonest_x, soonest_g)
    next_target = first_least(jnp.where(by_opening, at_x, at_g))
    heads_x = next_target & (slope.x < 0)
    heads_g = next_target & (slope.g < 0) & (before.g > snap)
    return Events(
        inside=any_of(crossed_g | crossed_x | dipped),
        at_once=at_once,
        opens=(phase == EXPANSION)
        & jnp.where(at_once, crossed_x, target & ((kind == ROOT_X) | (kind == ONSET))),
        first=jnp.minimum(crossing, dip),
        by_opening=by_opening,
        target=next_target,
        monotone=any_of(jnp.where(by_opening, heads_x, heads_g))
        & jnp.isfinite(crossing)
        & (crossing <= dip),
    )


def change_phase(
    flow: Flow, phase: jax.Array, state: State, arrived: jax.Array, opened: jax.Array
) -> tuple[State, jax.Array, jax.Array]:
    """State and phases once the contacts `arrived` have changed theirs, and which closed.

    `gamma` stays continuous: an opening contact returns from `g = gamma / e` to `gamma`.
    """
    opened = arrived & opened
    turned = jnp.where(state.x > 0, EXPANSION, OPEN)
    following = jnp.where(phase == COMPRESSION, turned, COMPRESSION)
    if flow.slackens:  # a slack contact may be loaded again while it still expands
        still = (phase == OPEN) & (state.x > 0) & (state.g > 0)
        following = jnp.where(still, EXPANSION, following)
    following = jnp.where(opened, OPEN, following)
    closed = arrived & (phase == OPEN)
    new_phase = jnp.where(arrived, following, phase).astype(jnp.int32)
    e = flow.restitution
    g = jnp.where(opened, e * state.g, state.g)
    at_rest = arrived & ~opened & (phase != OPEN)
    # of events that coincide one is landed on: the others are 0, too, but not their derivatives
    along = jnp.where(phase == EXPANSION, e, jnp.where(e > 0, 1 / jnp.where(e > 0, e, 1.0), 0.0))
    along = jnp.where(new_phase == OPEN, 1.0, along)
    g = jnp.where(at_rest, along * (state.g - jax.lax.stop_gradient(state.g)), g)
    if not flow.gapped:
        return state._replace(x=jnp.where(new_phase == OPEN, 0.0, state.x), g=g), new_phase, closed
    ahead = state.x - jax.lax.stop_gradient(state.x)
    if not flow.slackens:
        reset = arrived & (opened | (phase == OPEN))
        x = jnp.where(reset, jnp.where(opened, e**2, 1.0) * ahead, state.x)
        return state._replace(x=x, g=g), new_phase, closed
    x = jnp.where(closed & (state.x <= 0), ahead, state.x)
    return jumped(flow, state._replace(x=x, g=g), closed), new_phase, closed


def jumped(flow: Flow, state: State, closed: jax.Array) -> State:
    """Adds what a force that jumps at closing has done while x differs from 0: derivatives only."""
    moves = closed & (state.g < 0)
    ahead = state.x - jax.lax.stop_gradient(state.x)
    rate = jnp.where(moves, -flow.omega * state.g, 1.0)
    push = flow.viscous.push(state.x, state.g)  # type: ignore[union-attr]
    dp = jnp.where(moves, push * ahead / rate, 0.0)
    return state._replace(g=state.g + apply(flow.coupling, dp), p=state.p + dp)


def ahead(
    flow: Flow, tolerance: jax.Array, phase: jax.Array, state: State
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Expected time to the next event, its contact (m,) one-hot, and whether it is an opening.

    Openings by a parabola: a contact that only creeps towards its own, as behind a wave, has none.
    """
    rates = rates_of(flow, phase)
    dx, dg, _ = field(flow, phase, rates, state.x, state.g)
    x = jnp.maximum(state.x, 0.0)
    left = dx**2 - 2 * x * rates.closing * dg
    opens = (phase == EXPANSION) & (dx < 0) & (left >= 0)
    speed = jnp.sqrt(jnp.where(opens, left, 1.0)) - dx
    at_x = jnp.where(opens, 2 * x / jnp.where(opens, speed, 1.0), jnp.inf)
    margin, slope = margin_signs(phase) * state.g, margin_signs(phase) * dg
    # the indentation is to change little until then: a contact that creeps has no turning either
    turns = (margin > tolerance) & (slope < 0) & (margin * jnp.abs(dx) < -CREEP * slope * x)
    at_g = jnp.where(turns, margin / jnp.where(turns, -slope, 1.0), jnp.inf)
    by_opening = least(at_x) <= least(at_g)
    due = jnp.where(by_opening, at_x, at_g)
    return least(due), first_least(due), by_opening


def margin_signs(phase: jax.Array) -> jax.Array:
    """`g` times it is the distance to a change of phase by gap velocity."""
    return jnp.where(phase == COMPRESSION, -1.0, 1.0)


def _margins(
    flow: Flow, tolerance: jax.Array, phase: jax.Array, slack: jax.Array, state: State
) -> Margin:
    if flow.gapped:
        g = jnp.where(phase == OPEN, 1.0, margin_signs(phase) * state.g)
        x = jnp.where(phase == OPEN, -state.x, state.x)
        if flow.slackens:
            onset = flow.viscous.onset(state.x, state.g)  # type: ignore[union-attr]
            x = jnp.where(phase == EXPANSION, onset, jnp.where(slack, -onset, x))
        return Margin(jnp.where(phase == COMPRESSION, 1.0, x), g)
    slack = jnp.where(phase == OPEN, NEGLIGIBLE * tolerance, 0.0)
    g = margin_signs(phase) * state.g + slack
    return Margin(jnp.where(phase == EXPANSION, state.x, 1.0), g)


def _slopes(flow: Flow, phase: jax.Array, slack: jax.Array, state: State) -> Margin:
    dx, dg, _ = field(flow, phase, rates_of(flow, phase), state.x, state.g)
    if flow.gapped:
        rate = jnp.where(phase == OPEN, -dx, dx)
        if flow.slackens:
            onset = flow.viscous.onset  # type: ignore[union-attr]
            turning = jax.jvp(onset, (state.x, state.g), (dx, dg))[1]
            rate = jnp.where(phase == EXPANSION, turning, jnp.where(slack, -turning, rate))
        rate = jnp.where(phase == COMPRESSION, 0.0, rate)
        return Margin(rate, jnp.where(phase == OPEN, 0.0, margin_signs(phase) * dg))
    return Margin(jnp.where(phase == EXPANSION, dx, 0.0), margin_signs(phase) * dg)


def crossing_at(f0: jax.Array, f1: jax.Array, slope: jax.Array) -> jax.Array:
    """First root in (0, 1] of the parabola through f0 >= 0, its slope there, and f1 < 0."""
    f0 = jnp.maximum(f0, 0.0)
    a = f1 - f0 - slope
    root = jnp.sqrt(jnp.maximum(slope**2 - 4 * a * f0, 0.0))
    denominator = root - slope
    falling = 2 * f0 / jnp.where(denominator == 0, 1.0, denominator)
    rising = (slope + root) / jnp.where(a == 0, 1.0, -2 * a)
    return jnp.clip(jnp.where(slope <= 0, falling, rising), 0.0, 1.0)


def dips(f0: jax.Array, f1: jax.Array, d0: jax.Array, d1: jax.Array, snap: jax.Array) -> jax.Array:
    """Whether the cubic through both ends may fall below zero between them and return."""
    candidates = (d0 < 0) & (d1 > 0) & (f0 > snap) & (f1 >= -snap)
    u = dip_at(f0, f1, d0)
    value = (
        f0 * (1 + 2 * u) * (1 - u) ** 2
        + d0 * u * (1 - u) ** 2
        + f1 * u**2 * (3 - 2 * u)
        + d1 * u**2 * (u - 1)
    )
    # an error of the cubic: curvature times (omega h)^2 / 384, with steps up to omega h = 2
    doubt = IN_DOUBT * jnp.where(candidates, d1 - d0, 0.0)
    return candidates & (value < doubt - snap)


def dip_at(f0: jax.Array, f1: jax.Array, d0: jax.Array) -> jax.Array:
    """Minimum of the parabola through f0, its slope d0 < 0, and f1."""
    a = f1 - f0 - d0
    return jnp.clip(-d0 / jnp.where(a == 0, 1.0, 2 * a), 0.0, 1.0)
