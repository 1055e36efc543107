"""Events of the frictional flow: changes of normal phase, ends and beginnings of slip.

The margins (4 m,) of a state, >= 0 while its modes last, are those of
    0: opening          x in expansion
    1: gap velocity     -g in compression, g in expansion or open
    2: end of slip      u along the direction of planar slip; |u| less a part of the tolerance
    3: end of stick     mu F - |lambda|
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jimpact.numerics.contacts import any_of, first_least, largest, least
from jimpact.numerics.events import (
    NEGLIGIBLE,
    SHORTEST,
    SNAP,
    crossing_at,
    dip_at,
    dips,
    margin_signs,
    matters,
)
from jimpact.numerics.flow import COMPRESSION, EXPANSION, OPEN
from jimpact.numerics.friction_flow import (
    HOLDING,
    Frictional,
    Modes,
    State,
    normal_force,
    per_row,
    size,
    speed_of,
    tangential_force,
    times,
)
from jimpact.solvers.friction_modes import who_sticks

AT_REST = 0.5  # part of the tolerance below which a spatial slip velocity counts as 0
NEW_SLIP = 4.0  # tolerances, with which it begins along its direction: the less the stiffer
# Forces are continuous where a contact breaks loose: a landing beside it by part delta of the stick
# costs delta^2. This part of the square root of the tolerance.
BESIDE = 0.01
EARLY = 10.0  # slopes, in those parts, of the slip of a contact that was let go as much too early
RETRY = 0.1  # part of a step after which an event at its very beginning is looked for again
BROKEN = 1e-7  # of mu F, beside that: what holds contacts that break loose together

# A spatial direction of slip turns at a rate ~ 1 / |u|. Values hide when an explicit step is longer
# than its stability allows, derivatives do not: the steps are bounded. (The bound of order 8 is 6.)
STABLE = 4.0

Margins = Callable[[State], jax.Array]


class Found(NamedTuple):
    """What a trial step has met."""

    inside: jax.Array  # (1,) an event lies inside the step
    at_once: jax.Array  # (4 m,) these happen where the step begins
    first: jax.Array  # (1,) fraction of the step up to the earliest
    target: jax.Array  # (4 m,) one-hot, which it is
    monotone: jax.Array  # (1,) its margin falls from the beginning of the step on


def margins(flow: Frictional, modes: Modes, tolerance: jax.Array, state: State) -> jax.Array:
    """Distances (4 m,) to events."""
    none = jnp.ones_like(state.x)
    is_open = modes.phase == OPEN
    slack = jnp.where(is_open, NEGLIGIBLE * tolerance, 0.0)
    slips = ~modes.stick & ~is_open
    ahead = speed_of(flow, modes, state.u)
    if flow.rows == 2:
        ahead = ahead - AT_REST * tolerance
    force = normal_force(flow, modes, state.x)
    side, most = tangential_force(flow, modes, force, state.u)
    holds = most - size(side, flow.rows)
    return jnp.concatenate(
        [
            jnp.where(modes.phase == EXPANSION, state.x, none),
            margin_signs(modes.phase) * state.g + slack,
            jnp.where(slips, ahead, none),
            jnp.where(modes.stick & ~is_open, holds, none),
        ]
    )


def tile(values: jax.Array) -> jax.Array:
    """Values (m, ...) of contacts for all their margins (4 m, ...)."""
    return jnp.concatenate([values] * 4)


def beside(tolerance: jax.Array) -> jax.Array:
    """How far (4 m,) from the end of stick a landing may be."""
    return BESIDE * jnp.sqrt(tile(tolerance))


def find(
    flow: Frictional,
    modes: Modes,
    tolerance: jax.Array,
    landing: tuple[jax.Array, jax.Array],
    span: jax.Array,
    ends: tuple[State, State],
    values: tuple[jax.Array, jax.Array, jax.Array, jax.Array],
    turning: jax.Array,
) -> Found:
    """Events between two states; the one a step is `landing` on (kind, target) is not among them.

    `values` are margins and their slopes at both ends, `turning` is that of `turning`.
    """
    kind, target = landing
    snap = SNAP * tile(tolerance)
    before, slope, after, slope_end = values
    crossed = jnp.where(target, (kind == HOLDING) & (after < -beside(tolerance)), after < -snap)
    dipped = ~target & dips(before, after, slope * span, slope_end * span, snap)
    idle = ~matters(flow.normal, tolerance, ends[0]) & ~matters(flow.normal, tolerance, ends[1])  # type: ignore[arg-type]
    # a contact that broke loose a little early is pulled back for as little
    m = len(tolerance)
    falls = slope <= jnp.where(jnp.arange(4 * m) < 2 * m, 0.0, -1.0).reshape(
        (4 * m,) + (1,) * (slope.ndim - 1)
    ) * EARLY * beside(tolerance)
    at_once = crossed & (((before <= snap) & falls) | (span < SHORTEST) | tile(idle))
    at = jnp.where(crossed, crossing_at(before, after, slope * span), jnp.inf)
    at = jnp.maximum(at, jnp.where(before <= snap, RETRY, 0.0))
    dip = least(jnp.where(dipped, dip_at(before, after, slope * span), jnp.inf))
    soonest, mark = least(at), first_least(at)
    heads = mark & (slope < 0) & (before > snap)
    if flow.rows == 2:  # a stop is approached step by step where the direction turns
        smooth = turning * least(at) * span <= STABLE * AT_REST * tolerance
        heads = heads & jnp.concatenate([*[jnp.ones_like(smooth)] * 2, smooth, smooth | True])
    return Found(
        inside=any_of(crossed | dipped),
        at_once=at_once,
        first=jnp.minimum(soonest, dip),
        target=mark,
        monotone=any_of(heads) & jnp.isfinite(soonest) & (soonest <= dip),
    )


def turning(flow: Frictional, modes: Modes, state: State, rates: State) -> jax.Array:
    """How fast (m,) the direction of spatial slip turns, times |u|; `rates` of the state."""
    m = len(state.x)
    force = normal_force(flow, modes, state.x)
    side, most = tangential_force(flow, modes, force, state.u)
    unit = rates.t
    found = []
    for j in range(m):
        at = slice(2 * j, 2 * j + 2)
        k = flow.along[at, at]
        others = rates.u[at] - unit * times(k, side[at])
        spread = jnp.sqrt((k[0, 0] - k[1, 1]) ** 2 + 4 * k[0, 1] ** 2)[None]
        found.append(size(others, 2) + unit * spread * most[j : j + 1])
    slips = ~modes.stick & (modes.phase != OPEN)
    return jnp.where(slips, jnp.concatenate(found), 0.0)


def change(
    flow: Frictional, modes: Modes, tolerance: jax.Array, state: State, arrived: jax.Array
) -> tuple[State, Modes, jax.Array]:
    """State and modes after the events `arrived` (4 m,), and which contacts closed."""
    opened, turned, stopped, broke = jnp.split(arrived, 4)
    phase, e = modes.phase, flow.normal.restitution
    turned = turned & ~opened
    closed = turned & (phase == OPEN)
    loaded = jnp.where(state.x > 0, EXPANSION, OPEN)
    following = jnp.where(phase == COMPRESSION, loaded, COMPRESSION)
    new = jnp.where(opened, OPEN, jnp.where(turned, following, phase)).astype(jnp.int32)
    # gamma = g s is continuous; a value that is 0 at an event keeps its derivative
    along = jnp.where(phase == EXPANSION, e, jnp.where(e > 0, 1 / jnp.where(e > 0, e, 1.0), 0.0))
    along = jnp.where((new == OPEN) | (phase == OPEN), 1.0, along)
    at_rest = turned & (phase != OPEN)
    g = jnp.where(opened, e * state.g, state.g)
    g = jnp.where(at_rest, along * (state.g - jax.lax.stop_gradient(state.g)), g)
    state = state._replace(x=jnp.where(new == OPEN, 0.0, state.x), g=g)
    force = normal_force(flow, modes, state.x)
    side, most = tangential_force(flow, modes, force, state.u)
    spare = 1 - size(side, flow.rows) / jnp.where(most > 0, most, 1.0)
    together = modes.stick & (spare <= largest(jnp.where(broke, spare, -jnp.inf)) + BROKEN)
    loose = broke | (any_of(broke) & together)
    state, modes = _slip(flow, modes._replace(phase=new), tolerance, state, loose, side)
    state, modes = decided(flow, modes, tolerance, state, stopped, closed)
    return state, modes, closed


def _slip(
    flow: Frictional,
    modes: Modes,
    tolerance: jax.Array,
    state: State,
    loose: jax.Array,
    side: jax.Array,
) -> tuple[State, Modes]:
    """Contacts `loose` begin to slip against the force that held them."""
    modes = modes._replace(stick=modes.stick & ~loose)
    if flow.rows == 1:
        return state, modes._replace(sign=jnp.where(loose, -jnp.sign(side), modes.sign))
    return _begins(state, tolerance, loose, -side), modes


def _begins(state: State, tolerance: jax.Array, begins: jax.Array, along: jax.Array) -> State:
    """Spatial slip begins in a direction."""
    length = per_row(size(along, 2), 2)
    unit = along / jnp.where(length > 0, length, 1.0)
    u = NEW_SLIP * per_row(tolerance, 2) * unit
    return state._replace(u=jnp.where(per_row(begins, 2), jax.lax.stop_gradient(u), state.u))


def decided(
    flow: Frictional,
    modes: Modes,
    tolerance: jax.Array,
    state: State,
    stopped: jax.Array,
    closed: jax.Array,
) -> tuple[State, Modes]:
    """Who sticks once contacts have stopped to slip, or have closed."""
    rows = flow.rows
    small = SNAP if rows == 1 else AT_REST + 2 * SNAP
    slips = ~modes.stick & (modes.phase != OPEN)
    resting = slips & (size(state.u, rows) <= small * tolerance)
    asked = any_of(stopped | (closed & resting))
    asked_of = (stopped | resting | (modes.stick & (modes.phase != OPEN))) & asked
    stopping = stopped | (resting & asked)
    u = jnp.where(per_row(stopping, rows), 0.0, state.u)
    # a contact that closes slips as it is moving
    fresh = closed & ~resting
    sign = jnp.where(fresh & (rows == 1), jnp.sign(u[: len(fresh)]), modes.sign)
    state, modes = state._replace(u=u), modes._replace(sign=sign, stick=modes.stick & ~fresh)
    stick, along = who_sticks(flow, modes, state, asked_of)
    begins = asked_of & ~stick
    modes = modes._replace(stick=jnp.where(asked_of, stick, modes.stick))
    if rows == 1:
        return state, modes._replace(sign=jnp.where(begins, jnp.sign(along), modes.sign))
    return _begins(state, tolerance, begins, along), modes
