"""Steps of the frictional stepper: what it carries, how long the next step is, in what variable."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jimpact.numerics import friction_events as events
from jimpact.numerics.contacts import any_of, largest, of
from jimpact.numerics.events import NEGLIGIBLE, margin_signs
from jimpact.numerics.flow import OPEN, START, TIME
from jimpact.numerics.friction_flow import (
    HOLDING,
    MARGIN,
    ROOT_X,
    Frictional,
    Modes,
    State,
    size,
    speed_of,
)
from jimpact.numerics.steps import CUT_SHORT, FIRST_TIME, RESTART, combined, growth


class Carry(NamedTuple):
    """What one pass hands to the next; one number an impact has shape (1,)."""

    state: State
    modes: Modes
    kind: jax.Array
    target: jax.Array  # (4 m,) one-hot
    h: jax.Array  # step to try, in its variable
    due: jax.Array  # expected time to the event of a landing step
    begun: jax.Array  # xi reached by START steps
    retargeted: jax.Array
    passes: jax.Array
    closures: jax.Array  # (m,)
    done: jax.Array


class Verdict(NamedTuple):
    """What becomes of a trial step."""

    found: events.Found
    error: jax.Array
    span: jax.Array
    inside: jax.Array  # an event lies inside
    accept: jax.Array
    flips: jax.Array  # events happen where the step begins
    broken: jax.Array  # however short the step, the force has no value
    arrived: jax.Array  # (4 m,) events that happen now
    rates: State  # where the accepted step ends, or the refused one began


def interval(flow: Frictional, carry: Carry, tolerance: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Start and length of the next step in its own variable."""
    state, modes = carry.state, carry.modes
    opens, turns, stops, _ = jnp.split(carry.target, 4)
    x = of(opens, state.x)
    positive = x > 0
    root = jnp.where(positive, jnp.where(positive, x, 1.0) ** (1 / flow.normal.root), 0.0)
    speed = speed_of(flow, modes, state.u)
    end = events.AT_REST * of(stops, tolerance) if flow.rows == 2 else 0.0
    turning = margin_signs(modes.phase) * state.g
    turning = turning + jnp.where(modes.phase == OPEN, NEGLIGIBLE * tolerance, 0.0)
    margin = of(turns, turning) + of(stops, speed) - end
    kinds = [carry.kind == kind for kind in (START, ROOT_X, MARGIN)]
    start = jnp.select(kinds, [carry.begun, root, margin], 0.0)
    kinds = [*kinds, carry.kind == HOLDING]
    return start, jnp.select(kinds, [carry.h, -root, -margin, carry.due], carry.h)


def time_span(flow: Frictional, carry: Carry, unit: jax.Array, took: jax.Array) -> jax.Array:
    """Time the step takes in units of `s*`; where that is 0 what a landing was expected to."""
    r = flow.normal.root
    in_start = (carry.begun + carry.h) ** r - carry.begun**r
    timed = unit > 0
    landed = jnp.where(timed, took / jnp.where(timed, unit, 1.0), carry.due)
    kinds = [carry.kind == HOLDING, carry.kind >= ROOT_X, carry.kind == START]
    return jnp.select(kinds, [carry.due, landed, in_start], carry.h)


def error_of(flow: Frictional, tolerance: jax.Array, high: State, low: State) -> jax.Array:
    """Hairer's combination of the two estimates, in units of the tolerance."""

    def measure(estimate: State) -> jax.Array:
        slip = size(estimate.u, flow.rows)
        both = jnp.maximum(jnp.abs(estimate.x), jnp.maximum(jnp.abs(estimate.g), slip))
        return largest(jnp.maximum(both, jnp.abs(estimate.p)) / tolerance)

    return combined(measure(high), measure(low))


def next_step(
    flow: Frictional,
    carry: Carry,
    verdict: Verdict,
    closed: jax.Array,
) -> Carry:
    """Variable, target and length of the next step."""
    found, error, span, inside, accept, flips, *_ = verdict
    h, kind, begun, r = carry.h, carry.kind, carry.begun, flow.normal.root
    landing, starting = kind >= ROOT_X, kind == START
    grown = growth(error)
    land = inside & found.monotone & ~(starting & (begun == 0)) & ~carry.retargeted
    leaves = starting & inside & (begun > 0)
    short = CUT_SHORT * found.first
    cases = [
        (flips | (accept & landing), h),
        (accept, grown * h),
        (land, jnp.where(leaves, span, h)),
        (inside & starting & ~leaves, short * h),
        (inside, short * span),
        (landing, 0.5 * carry.due),
    ]
    next_h = jnp.select([case for case, _ in cases], [value for _, value in cases], grown * h)
    opens, breaks = (any_of(jnp.split(found.target, 4)[i]) for i in (0, 3))
    aimed = jnp.where(opens, ROOT_X, jnp.where(breaks, HOLDING, MARGIN))
    next_kind = jnp.where(land, aimed, jnp.where(starting & ~leaves, START, TIME))
    begun = begun + jnp.where(accept & starting, h, 0.0)
    if r > 2:
        begins = any_of(closed)
        fresh = jnp.minimum(RESTART * span, FIRST_TIME)
        next_kind = jnp.where(begins, START, next_kind)
        next_h = jnp.where(begins, fresh ** (1 / r), next_h)
        begun = jnp.where(begins, 0.0, begun)
    return carry._replace(
        kind=next_kind.astype(jnp.int32),
        target=found.target & land,
        h=next_h,
        due=jnp.where(land, found.first * span, 0.0),
        begun=begun,
        retargeted=land & landing,
        passes=carry.passes + 1,
        closures=carry.closures + closed.astype(jnp.int32),
    )
