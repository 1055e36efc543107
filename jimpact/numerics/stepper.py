"""Event-aligned integration of the LZB flow: no step ever straddles a change of phase.

Each pass of the loop tries one step with frozen phases. It is accepted (and the phase of the
contact it landed on is changed), or it shows an event in its middle and the next pass lands on
it, or its error is too large and it is shortened. As soon as the contacts at work are decoupled
from each other and press no other contact, the rest follows from the energy in closed form.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jimpact.numerics.flow import (
    COMPRESSION,
    EXPANSION,
    OPEN,
    ROOT_X,
    START,
    TIME,
    ZERO_G,
    Flow,
    State,
    field,
    frozen,
    plus_one,
    power,
    root_order,
    scales,
    step,
)
from jimpact.numerics.tridiagonal import Tridiagonal

FIRST_TIME = 0.05  # of the fastest contact's time scale: no contact can turn around so soon
RESTART = 0.1  # first START step after a closing, as a part of the step before it
GROWTH, SHRINK, SAFETY = 6.0, 0.2, 0.9  # of the step-size control
SNAP = 1e-2  # events closer than this part of the tolerance are simultaneous
NEGLIGIBLE = 0.1  # approach below this part of the tolerance does not close a contact
RESIDUAL = 1.0  # loads and velocities below this part of the tolerance end the impact
NEAR_OPENING = 1.5  # an expansion expected to end within so many steps is landed on
SHORTEST = 1e-13  # a step this small cannot be resolved: the pending event is taken at once


class Carry(NamedTuple):
    """What one pass hands to the next."""

    state: State
    phase: jax.Array  # (m,)
    kind: jax.Array  # variable of the next step
    target: jax.Array  # (m,) one-hot: event it lands on
    h: jax.Array  # time step to try; in START a step of xi
    due: jax.Array  # estimated time to the event of a landing step
    begun: jax.Array  # xi reached by START steps
    retargeted: jax.Array
    passes: jax.Array
    accepted: jax.Array
    closures: jax.Array
    done: jax.Array


def explicit_step(
    flow: Flow,
    phase: jax.Array,
    state: State,
    kind: jax.Array,
    target: jax.Array,
    start: jax.Array,
    length: jax.Array,
    due: jax.Array,
    tolerance: jax.Array,
) -> tuple[State, State, State]:
    """`flow.step`, which needs neither the expected time of the event nor the tolerance."""
    return step(flow, phase, state, kind, target, start, length)


class Control(NamedTuple):
    """Local tolerance (m,) of each contact, pass limit, and how to step and to finish."""

    tolerance: jax.Array
    max_steps: int
    step: Callable[..., tuple[State, State, State]] = explicit_step
    closed_form: bool = True


def begin(flow: Flow, control: Control, gamma: jax.Array, x: jax.Array) -> Carry:
    """State before the impact; a touching contact at rest starts in compression."""
    m, dtype = gamma.shape[0], gamma.dtype
    phase = jnp.where((gamma <= 0) | (x > 0), COMPRESSION, OPEN).astype(jnp.int32)
    phase = jnp.where((x > 0) & (gamma > 0), EXPANSION, phase)
    s = jnp.where(phase == EXPANSION, flow.restitution, 1.0)
    g = jnp.where(s > 0, gamma / jnp.where(s > 0, s, 1.0), 0.0)
    zero, count = jnp.zeros((), dtype), jnp.zeros((), jnp.int32)
    carry = Carry(
        state=State(x, g, jnp.zeros(m, dtype), zero),
        phase=phase,
        kind=jnp.asarray(START, jnp.int32),
        target=jnp.zeros(m, bool),
        h=jnp.asarray(FIRST_TIME ** (1 / root_order(flow.exponent)), dtype),
        due=zero,
        begun=zero,
        retargeted=jnp.zeros((), bool),
        passes=count,
        accepted=count,
        closures=jnp.zeros(m, jnp.int32),
        done=jnp.zeros((), bool),
    )
    return _finish(flow, control, carry)


def advance(flow: Flow, control: Control, carry: Carry) -> Carry:
    """One pass of the loop."""
    phase, kind, target = carry.phase, carry.kind, carry.target
    h, due, begun = jax.lax.stop_gradient((carry.h, carry.due, carry.begun))
    carry = carry._replace(h=h, due=due, begun=begun)
    start, length = _interval(flow, control, carry)
    reached, high, low = control.step(
        flow, phase, carry.state, kind, target, start, length, due, control.tolerance
    )
    # what follows decides where events lie and how long steps are: it is not differentiated
    exact_flow, exact_state = flow, carry.state
    flow = frozen(flow)
    state, new, high, low = jax.lax.stop_gradient((carry.state, reached, high, low))
    error = _error(control, high, low)
    exact = jnp.isfinite(error) & (error <= 1)

    before = _margins(control, phase, state)
    after = _margins(control, phase, new)
    slope = _margin_slopes(flow, phase, state)
    slope_end = _margin_slopes(flow, phase, new)
    landing = (kind == ZERO_G) | (kind == ROOT_X)
    snap = SNAP * control.tolerance
    crossed_g = ~(target & (kind == ZERO_G)) & (after.g < -snap)
    crossed_x = ~(target & (kind == ROOT_X)) & (after.x < -snap)
    # time the step takes, or is expected to take
    r = root_order(flow.exponent)
    in_start = (begun + h) ** r - begun**r
    span = jnp.select([landing, kind == START], [due, in_start], h)
    dipped = ~landing & _dips(before.g, after.g, slope.g * span, slope_end.g * span, snap)
    idle = ~_matters(flow, control, state) & ~_matters(flow, control, new)
    at_once = (crossed_g & (before.g <= snap) & (slope.g <= 0)) | (
        (crossed_g | crossed_x) & ((span < SHORTEST) | idle)
    )
    flips = exact & jnp.any(at_once)
    event = exact & ~flips & jnp.any(crossed_g | crossed_x | dipped)
    accept = exact & ~flips & ~event

    # accepted: move, and change the phase of the contact landed on
    arrived = jnp.where(flips, at_once, accept & landing & target)
    moved = State(*(jnp.where(accept, b, a) for a, b in zip(exact_state, reached)))
    opened = arrived & (phase == EXPANSION) & jnp.where(flips, crossed_x, kind == ROOT_X)
    moved, new_phase, closed = _change_phase(exact_flow, phase, moved, arrived, opened)

    fraction_g = jnp.where(crossed_g, _crossing(before.g, after.g, slope.g * span), jnp.inf)
    fraction_x = jnp.where(crossed_x, _crossing(before.x, after.x, slope.x * span), jnp.inf)
    fraction_dip = jnp.where(dipped, _dip_at(before.g, after.g, slope.g * span), jnp.inf)
    first_g, first_x = jnp.min(fraction_g), jnp.min(fraction_x)
    first = jnp.minimum(jnp.minimum(first_g, first_x), jnp.min(fraction_dip))

    factor = jnp.where(
        jnp.isfinite(error), jnp.clip(SAFETY * (error + 1e-10) ** (-1 / 8), SHRINK, GROWTH), SHRINK
    )
    # an event inside the step: land on it where its variable runs monotonically towards it
    opens = first_x <= first_g
    next_target = jnp.arange(phase.shape[0]) == jnp.where(
        opens, jnp.argmin(fraction_x), jnp.argmin(fraction_g)
    )
    heads_there = jnp.where(
        opens,
        jnp.any(next_target & (slope.x < 0)),
        jnp.any(next_target & (slope.g < 0) & (before.g > snap)),
    )
    can_land = (
        heads_there
        & jnp.isfinite(jnp.minimum(first_g, first_x))
        & ~((kind == START) & (begun == 0))
        & ~carry.retargeted
        & (first == jnp.minimum(first_g, first_x))
    )
    land = event & can_land
    short = jnp.where(landing, 0.5 * first, 0.7 * first) * span
    # START ends with the first event; until then h is a step of xi
    leaves = (kind == START) & event & (begun > 0)
    keeps = flips | (accept & landing)
    next_h = jnp.select(
        [keeps, accept, land, event & (kind == START) & ~leaves, event, landing],
        [h, factor * h, jnp.where(leaves, span, h), 0.7 * first * h, short, 0.5 * span],
        factor * h,
    )
    next_kind = jnp.where(
        land, jnp.where(opens, ROOT_X, ZERO_G), jnp.where((kind == START) & ~leaves, START, TIME)
    )
    begun = begun + jnp.where(accept & (kind == START), h, 0.0)
    if r > 2:  # x ~ t^2 after a closing, so t^(2 eta) is smooth enough only where 2 eta is whole
        begins = jnp.any(closed > 0)
        next_kind = jnp.where(begins, START, next_kind)
        next_h = jnp.where(begins, (RESTART * span) ** (1 / r), next_h)
        begun = jnp.where(begins, 0.0, begun)
    out = Carry(
        state=moved,
        phase=new_phase,
        kind=next_kind.astype(jnp.int32),
        target=next_target & land,
        h=next_h,
        due=jnp.where(land, first * span, 0.0),
        begun=begun,
        retargeted=land & landing,
        passes=carry.passes + 1,
        accepted=carry.accepted + accept.astype(jnp.int32),
        closures=carry.closures + closed,
        done=carry.done,
    )
    out = _aim_at_opening(flow, out, accept)
    return _finish(exact_flow, control, out)


def _interval(flow: Flow, control: Control, carry: Carry) -> tuple[jax.Array, jax.Array]:
    """Start and length of the next step in its own variable."""
    r = root_order(flow.exponent)
    x = jnp.sum(jnp.where(carry.target, carry.state.x, 0.0))
    g = jnp.sum(jnp.where(carry.target, carry.state.g, 0.0))
    closing = carry.target & (carry.phase == OPEN)  # closes once its approach matters
    g_end = -NEGLIGIBLE * jnp.sum(jnp.where(closing, control.tolerance, 0.0))
    safe = jnp.where(x > 0, x, 1.0)
    root = jnp.sqrt(safe) if r == 2 else jnp.sqrt(jnp.sqrt(jnp.sqrt(safe)))
    root = jnp.where(x > 0, root, 0.0)
    kinds = [carry.kind == START, carry.kind == ZERO_G, carry.kind == ROOT_X]
    start = jnp.select(kinds, [carry.begun, g, root], 0.0)
    length = jnp.select(kinds, [carry.h, g_end - g, -root], carry.h)
    return start, length


def _error(control: Control, high: State, low: State) -> jax.Array:
    """Hairer's combination of the two estimates, in units of the tolerance."""

    def size(estimate: State) -> jax.Array:
        rows = [jnp.abs(row) for row in (estimate.x, estimate.g, estimate.p)]
        return jnp.max(jnp.maximum(jnp.maximum(rows[0], rows[1]), rows[2]) / control.tolerance)

    fifth, third = size(high), size(low)
    scale = jnp.sqrt(fifth**2 + 0.01 * third**2)
    return jnp.where(scale > 0, fifth**2 / jnp.where(scale > 0, scale, 1.0), fifth)


def _matters(
    flow: Flow, control: Control, state: State, part: float = NEGLIGIBLE + 2 * SNAP
) -> jax.Array:
    """Whether load and velocity of a contact are more than `part` of the tolerance."""
    total = power(state.x, plus_one(flow.exponent)) + state.g**2
    return jax.lax.stop_gradient(total > (part * control.tolerance) ** 2)


class Margin(NamedTuple):
    """Distances to a change of phase, >= 0 while it lasts."""

    x: jax.Array
    g: jax.Array


def _signs(phase: jax.Array) -> jax.Array:
    return jnp.where(phase == COMPRESSION, -1.0, 1.0)


def _margins(control: Control, phase: jax.Array, state: State) -> Margin:
    slack = jnp.where(phase == OPEN, NEGLIGIBLE * control.tolerance, 0.0)
    g = _signs(phase) * state.g + slack
    return Margin(jnp.where(phase == EXPANSION, state.x, 1.0), g)


def _margin_slopes(flow: Flow, phase: jax.Array, state: State) -> Margin:
    dx, dg, _, _ = field(flow, phase, state.x, state.g)
    return Margin(jnp.where(phase == EXPANSION, dx, 0.0), _signs(phase) * dg)


def _crossing(f0: jax.Array, f1: jax.Array, slope: jax.Array) -> jax.Array:
    """First root in (0, 1] of the parabola through f0 >= 0, its slope there, and f1 < 0."""
    f0 = jnp.maximum(f0, 0.0)
    a = f1 - f0 - slope
    root = jnp.sqrt(jnp.maximum(slope**2 - 4 * a * f0, 0.0))
    denominator = jnp.where(slope <= 0, -slope + root, root + slope)
    stable = 2 * f0 / jnp.where(denominator == 0, 1.0, denominator)
    other = (slope + root) / jnp.where(a == 0, 1.0, -2 * a)
    return jnp.clip(jnp.where(slope <= 0, stable, other), 0.0, 1.0)


def _dips(f0: jax.Array, f1: jax.Array, d0: jax.Array, d1: jax.Array, snap: jax.Array) -> jax.Array:
    """Whether the cubic through both ends falls below zero between them and returns."""
    candidates = (d0 < 0) & (d1 > 0) & (f0 > snap) & (f1 >= -snap)
    u = _dip_at(f0, f1, d0)
    value = (
        f0 * (1 + 2 * u) * (1 - u) ** 2
        + d0 * u * (1 - u) ** 2
        + f1 * u**2 * (3 - 2 * u)
        + d1 * u**2 * (u - 1)
    )
    return candidates & (value < -snap)


def _dip_at(f0: jax.Array, f1: jax.Array, d0: jax.Array) -> jax.Array:
    """Minimum of the parabola through f0, its slope d0 < 0, and f1."""
    a = f1 - f0 - d0
    return jnp.clip(-d0 / jnp.where(a == 0, 1.0, 2 * a), 0.0, 1.0)


def _change_phase(
    flow: Flow, phase: jax.Array, state: State, arrived: jax.Array, opened: jax.Array
) -> tuple[State, jax.Array, jax.Array]:
    """The next phase of the contacts that `arrived` at an event; gamma stays continuous."""
    turned = jnp.where(state.x > 0, EXPANSION, OPEN)
    following = jnp.where(phase == COMPRESSION, turned, COMPRESSION)
    following = jnp.where(opened, OPEN, following)
    new_phase = jnp.where(arrived, following, phase).astype(jnp.int32)
    g = jnp.where(opened, flow.restitution * state.g, state.g)
    rests = arrived & ~opened & (phase != OPEN)
    g = jnp.where(rests, 0.0, g)
    x = jnp.where(new_phase == OPEN, 0.0, state.x)
    closed = (arrived & (phase == OPEN)).astype(jnp.int32)
    return state._replace(x=x, g=g), new_phase, closed


def _aim_at_opening(flow: Flow, carry: Carry, accepted: jax.Array) -> Carry:
    """Turn the next step into a landing on the opening that is about to come."""
    x, g = jax.lax.stop_gradient((carry.state.x, carry.state.g))
    dx, _, _, _ = field(flow, carry.phase, x, g)
    expanding = (carry.phase == EXPANSION) & (dx < 0)
    due = jnp.where(expanding, jnp.maximum(x, 0.0) / jnp.where(expanding, -dx, 1.0), jnp.inf)
    soonest = jnp.min(due)
    aim = accepted & (carry.kind == TIME) & (soonest < NEAR_OPENING * carry.h)
    target = jnp.arange(due.shape[0]) == jnp.argmin(due)
    return carry._replace(
        kind=jnp.where(aim, ROOT_X, carry.kind).astype(jnp.int32),
        target=jnp.where(aim, target, carry.target),
        due=jnp.where(aim, soonest, carry.due),
    )


def _finish(flow: Flow, control: Control, carry: Carry) -> Carry:
    """End the impact if nothing is at work, or in closed form if all at work are decoupled."""
    state, phase = carry.state, carry.phase
    s, _, _ = scales(flow, phase)
    gamma = s * state.g
    at_work = ((state.x > 0) | (gamma < 0)) & _matters(flow, control, state, RESIDUAL)
    # of each decoupled contact gamma+ = e sqrt(x^(eta+1) + g^2), since x^(eta+1) + g^2 is kept
    total = power(state.x, plus_one(flow.exponent)) + state.g**2
    rebound = flow.restitution * jnp.sqrt(jnp.where(at_work, total, 1.0))
    dp = jnp.where(at_work, rebound - gamma, 0.0)
    coupling = flow.coupling
    if isinstance(coupling, Tridiagonal):
        off = Tridiagonal(jnp.zeros_like(coupling.diagonal), coupling.off_diagonal)
        strength = Tridiagonal(off.diagonal, jnp.abs(off.off_diagonal))
        pulled = Tridiagonal(off.diagonal, jnp.minimum(off.off_diagonal, 0.0)) @ dp
    else:
        off = coupling * (1 - jnp.eye(coupling.shape[0], dtype=coupling.dtype))
        strength, pulled = jnp.abs(off), jnp.minimum(off, 0.0) @ dp
    coupled = at_work & (strength @ at_work.astype(gamma.dtype) > 0)
    pressed = ~at_work & (gamma + pulled < -RESIDUAL * control.tolerance)
    alone = ~jnp.any(coupled | pressed)
    if not control.closed_form:
        alone = ~jnp.any(at_work)
    over = ~carry.done & alone
    end = State(
        x=jnp.where(over, 0.0, state.x),
        g=jnp.where(over, jnp.where(at_work, rebound, gamma), state.g),
        p=state.p + jnp.where(over, dp, 0.0),
        t=state.t,
    )
    return carry._replace(
        state=end,
        phase=jnp.where(over, OPEN, phase).astype(jnp.int32),
        done=carry.done | over,
    )


def run(flow: Flow, control: Control, carry: Carry) -> Carry:
    """Run an impact from `begin` to its end, or to the pass limit."""
    return jax.lax.while_loop(
        lambda c: ~c.done & (c.passes < control.max_steps),
        lambda c: advance(flow, control, c),
        carry,
    )
