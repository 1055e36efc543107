"""Steps of the event-aligned stepper: what it carries, how long the next is, in what variable."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jimpact.numerics import events
from jimpact.numerics.contacts import any_of, largest, of
from jimpact.numerics.flow import (
    FROM_GAP,
    ONSET,
    OPEN,
    ROOT_X,
    START,
    TIME,
    ZERO_G,
    Flow,
    Slopes,
    State,
    frozen,
    lands,
    step,
)
from jimpact.numerics.powers import root_of

FIRST_TIME = 0.05  # of the fastest contact's time scale: no contact can turn around so soon
RESTART = 0.1  # first START step after a closing, as a part of the step before it
GROWTH, SHRINK, SAFETY = 6.0, 0.2, 0.8  # of the step-size control
FINEST = 16  # eps: a local tolerance below it asks for less than rounding
LEAST_ERROR = 1e-10  # in tolerances; keeps the growth factor finite
WIDE_GAP = 64  # eps of a gap: its error estimate is no more than rounding
NEAR = 1.0  # an event expected within so many steps is landed on
PATIENCE = 2000  # passes per contact after which an impact is let end at WIDENED tolerances
WIDENED = 100.0
# Passes per contact at the full local tolerance, which ordinary impacts end within. Then it falls
# with the number of passes, or the errors of N steps would add up to N tolerances.
FULL = 30
CUT_SHORT = 0.7  # part of the way to an event that a step stops at where it cannot land


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
    closures: jax.Array  # (m,)
    done: jax.Array


class Control(NamedTuple):
    """Local tolerance (m,) of each contact, pass limit, and how to step and to finish."""

    tolerance: jax.Array
    max_steps: int
    contacts: int  # of the impact; those that are stepped may be fewer
    step: Callable[..., tuple[State, Slopes, Slopes]] = step
    closed_form: bool = True
    halving: bool = True
    order: int = 8
    beyond: jax.Array | None = None  # contacts whose neighbours are left out (`windows.py`)


class Verdict(NamedTuple):
    """What becomes of a trial step."""

    found: events.Events
    span: jax.Array
    flips: jax.Array  # phases change where the step begins: nothing is gained by shortening it
    inside: jax.Array  # an event lies inside
    accept: jax.Array
    broken: jax.Array  # however short the step, the force has no value


def interval(flow: Flow, control: Control, carry: Carry) -> tuple[jax.Array, jax.Array]:
    """Start and length of the next step in its own variable."""
    x, g = of(carry.target, carry.state.x), of(carry.target, carry.state.g)
    closing = carry.target & (carry.phase == OPEN)  # closes once its approach matters
    g_end = -events.NEGLIGIBLE * of(closing, control.tolerance)
    safe = jnp.where(x > 0, x, 1.0)
    root = root_of(safe, flow.root)
    root = jnp.where(x > 0, root, 0.0)
    onset = jnp.zeros_like(x)
    if flow.slackens:
        values = flow.viscous.onset(carry.state.x, carry.state.g)  # type: ignore[union-attr]
        onset = of(carry.target, values)
    kinds = [carry.kind == kind for kind in (START, ZERO_G, ROOT_X, FROM_GAP, ONSET)]
    start = jnp.select(kinds, [carry.begun, g, root, x, onset], 0.0)
    length = jnp.select(kinds, [carry.h, g_end - g, -root, -x, -onset], carry.h)
    return start, length


def time_span(flow: Flow, carry: Carry) -> jax.Array:
    """Time the step takes, or is expected to take."""
    r = flow.root
    in_start = (carry.begun + carry.h) ** r - carry.begun**r
    landing = lands(carry.kind)
    return jnp.select([landing, carry.kind == START], [carry.due, in_start], carry.h)


def error_of(control: Control, least: jax.Array, high: Slopes, low: Slopes) -> jax.Array:
    """Hairer's combination of the two estimates, in units of the tolerance; `least` x: gaps."""
    gap = jnp.where(least < 0, -least, 0.0)
    rounding = WIDE_GAP * float(jnp.finfo(gap.dtype).eps) * gap

    def size(estimate: Slopes) -> jax.Array:
        x = jnp.abs(estimate.x) / (control.tolerance + rounding)
        rest = jnp.maximum(jnp.abs(estimate.g), jnp.abs(estimate.p)) / control.tolerance
        return largest(jnp.maximum(x, rest))

    return combined(size(high), size(low))


def combined(fifth: jax.Array, third: jax.Array) -> jax.Array:
    """Hairer's error of DOP853 from the two estimates."""
    scale = jnp.sqrt(fifth**2 + 0.01 * third**2)
    return jnp.where(scale > 0, fifth**2 / jnp.where(scale > 0, scale, 1.0), fifth)


def growth(error: jax.Array, order: int = 8) -> jax.Array:
    """By what a step of this error, in tolerances, is lengthened or shortened."""
    error = error + LEAST_ERROR
    root = root_of(error, 8) if order == 8 else error ** (1 / order)
    factor = jnp.clip(SAFETY / root, SHRINK, GROWTH)
    return jnp.where(jnp.isfinite(error), factor, SHRINK)


def next_step(
    flow: Flow,
    control: Control,
    carry: Carry,
    verdict: Verdict,
    error: jax.Array,
    moved: State,
    phase: jax.Array,
    closed: jax.Array,
) -> Carry:
    """Variable, target and length of the next step."""
    found, span, flips, inside, accept, broken = verdict
    h, kind, begun, r = carry.h, carry.kind, carry.begun, flow.root
    landing = lands(kind)
    starting = kind == START
    factor = growth(error, control.order)
    # START ends with the first event; until then h is a step of xi
    land = inside & found.monotone & ~(starting & (begun == 0)) & ~carry.retargeted
    leaves = starting & inside & (begun > 0)
    short = CUT_SHORT * found.first
    gap_closes = any_of(found.target & (carry.phase == OPEN) & (carry.state.x <= 0))
    in_x = jnp.where(gap_closes, FROM_GAP, ONSET if flow.slackens else ROOT_X)
    cases = [
        (flips | (accept & landing), h),
        (accept, factor * h),
        (land, jnp.where(leaves, span, h)),
        (inside & starting & ~leaves, short * h),
        (inside, short * span),
        (landing, 0.5 * span),
    ]
    next_h = jnp.select([case for case, _ in cases], [value for _, value in cases], factor * h)
    next_kind = jnp.where(
        land,
        jnp.where(found.by_opening, in_x, ZERO_G),
        jnp.where(starting & ~leaves, START, TIME),
    )
    begun = begun + jnp.where(accept & starting, h, 0.0)
    # x ~ t^2 after a closing, so t^(2 eta) is smooth enough where 2 eta is whole; but a gap closes
    # with x ~ t
    if r > 2 or flow.gapped:
        begins = any_of(closed)
        next_kind = jnp.where(begins, START, next_kind)
        fresh = jnp.minimum(RESTART * span, FIRST_TIME)
        next_h = jnp.where(begins, fresh ** (1 / r), next_h)
        begun = jnp.where(begins, 0.0, begun)
    out = carry._replace(
        state=moved,
        phase=phase,
        passes=carry.passes + 1,
        closures=carry.closures + closed.astype(jnp.int32),
        done=carry.done | broken,
        kind=next_kind.astype(jnp.int32),
        target=found.target & land,
        h=next_h,
        due=jnp.where(land, found.first * span, 0.0),
        begun=begun,
        retargeted=land & landing,
    )
    return _aim(flow, control, out, accept)


def _aim(flow: Flow, control: Control, carry: Carry, accepted: jax.Array) -> Carry:
    """Turn the next step into a landing on the event that is about to come."""
    if flow.slackens:
        return carry
    state = jax.lax.stop_gradient(carry.state)
    due, target, by_opening = events.ahead(frozen(flow), control.tolerance, carry.phase, state)
    aim = accepted & (carry.kind == TIME) & (due < NEAR * carry.h)
    aimed_at = jnp.where(by_opening, ROOT_X, ZERO_G)
    return carry._replace(
        kind=jnp.where(aim, aimed_at, carry.kind).astype(jnp.int32),
        target=jnp.where(aim, target, carry.target),
        due=jnp.where(aim, due, carry.due),
    )


def local_tolerance(control: Control, carry: Carry) -> jax.Array:
    """Local tolerance of the next step, not below rounding."""
    full, tolerance = FULL * control.contacts, control.tolerance
    passes = jnp.maximum(carry.passes, full).astype(tolerance.dtype)
    finest = FINEST * float(jnp.finfo(tolerance.dtype).eps)
    return jnp.maximum(tolerance * (full / passes), jnp.minimum(tolerance, finest))


def patience(carry: Carry, contacts: int) -> jax.Array:
    """Widens what counts as nothing left once an impact drags on."""
    drags = carry.passes > PATIENCE * contacts
    return jnp.where(drags, WIDENED, 1.0).astype(carry.h.dtype)
