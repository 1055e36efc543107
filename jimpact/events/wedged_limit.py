"""Contacts that friction wedges, and the limit of their decay.

Friction may wedge contacts: they stick, slip, close and open in cycles without end,
while their velocities decay like a geometric series. The law is homogeneous: once a
state returns as a multiple s < 1 of itself, in the same phases, it returns so for ever.
With the impulses p and q of that cycle the rest of the impact carries

    (p + q) s / (1 - s)

within every cone of friction, and ends with gamma = 0 of these contacts. Slip that is a
multiple, too, ends with u = 0; other slip keeps its direction.

A cycle may have any length. A state is kept, later ones are compared with it, and after
twice as many passes a new one takes its place (R. P. Brent, BIT 20 (1980) 176).
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jimpact.events import plastic_limit
from jimpact.events.contact_flow import PATIENCE, WIDENED, largest_of
from jimpact.events.friction_flow import Cycle
from jimpact.events.run import Rest
from jimpact.numerics.dense import times
from jimpact.numerics.stepper import Mark, StepperState, any_of
from jimpact.numerics.tangents import value_of
from jimpact.tools.loops import cond
from jimpact.tools.masks import choose, quotient

# Difference between a state and a multiple s of an earlier one, as a part of 1 - s. Ten
# times more: transients are taken for cycles, and slip that goes on for slip that ends;
# ten times less: cycles are found later.
RETURNED = 1e-3
# Slip goes on where it differs by so many times what a return allows; in between it is
# not decided yet. Ten times more: cycles of contacts that slide are found later; ten
# times less: slip that ends is taken for slip that goes on.
CLEARLY = 100.0


def inspect(
    flow: Any,
    gamma: Float[Array, "m B"],
    carry: StepperState,
    rest: Rest,
    which: Bool[Array, "1 B"],
    at_end: bool,
) -> Rest:
    """`plastic_limit.inspect`; of contacts that friction may wedge, `returned` ones.

    At the end contacts that have been wedged count as contacts at rest.
    """
    if rest.cycle is None:
        return plastic_limit.inspect(flow, gamma, carry, rest, which, at_end)
    if at_end:
        end = plastic_limit.inspect(flow, gamma, carry, rest, which, at_end)
        return end._replace(contacts=end.contacts | rest.cycle.wedged)
    values = value_of(flow), carry._replace(y=value_of(carry.y))
    flow, carry = jax.lax.stop_gradient(values)
    which = which | dragged_on(flow, carry, rest)
    return cond(
        jnp.any(which), lambda: returned(flow, carry, rest, which), lambda: rest
    )


def cycle_at(flow: Any, carry: StepperState) -> Cycle:
    """The state of the impact now, as that of a cycle that begins: no contact counts as
    wedged, or as one that stops, yet.
    """
    modes = carry.step.modes
    x, g, p = flow.rows(carry.y)
    no = jnp.zeros(x.shape, bool)
    return Cycle(
        modes=modes,
        passes=carry.passes,
        gamma=flow.scales(modes) * g,
        # of the energy stored by x alone
        root=jnp.sqrt(flow.energy(x, g=jnp.zeros_like(x))),
        slip=flow.slip(carry.y),
        impulse=p,
        side=flow.side_impulse(carry.y),
        wedged=no,
        stops=no,
    )


def returned(
    flow: Any, carry: StepperState, rest: Rest, which: Bool[Array, "1 B"]
) -> Rest:
    """The rest of impacts `which` are at an event: ended where a kept state has
    returned.

    The new state is kept after twice as many passes as the old one.
    """
    now = cycle_at(flow, carry)
    drags = dragged_on(flow, carry, rest)
    found, ended = compared(flow, now, rest.cycle, drags)
    ended = which & ended
    due = which & ~ended & (now.passes >= 2 * rest.cycle.passes)
    cycle = choose(due, now, rest.cycle)
    cycle = choose(ended, found, cycle)
    return rest._replace(cycle=cycle, ended=rest.ended | ended)


def dragged_on(flow: Any, carry: StepperState, rest: Rest) -> Bool[Array, "1 B"]:
    """Mask of impacts that are over by a widened tolerance, without a cycle."""
    late = carry.passes > PATIENCE * flow.taking_part
    return (carry.mark == Mark.OVER) & late & ~rest.ended


def compared(
    flow: Any, now: Cycle, old: Cycle, drags: Bool[Array, "1 B"]
) -> tuple[Cycle, Bool[Array, "1 B"]]:
    """What is left if the state `now` is a multiple s of the `old` one; a mask: it is.

    Contacts that have carried an impulse p since are wedged, and carry `p s / (1 - s)`
    from now on. The others must be open and remain so, and slip that does not stop must
    keep its direction, to the end. In impacts that have dragged on, `drags`, the course
    that decays is no cycle: there all that is within the widened tolerance stops, and
    slip that has fallen by half.
    """
    impulse = now.impulse - old.impulse
    side = now.side - old.side
    wedged = impulse > 0
    size = _size(now, wedged)
    old_size = _size(old, wedged)
    ratio = size / jnp.where(old_size > 0, old_size, size)  # s
    decays = (ratio < 1) & (old_size > 0) & (old.passes > 0)
    allowed = RETURNED * (1 - ratio) * size
    allowed = jnp.where(drags, WIDENED * flow.tolerance, allowed)
    expected = jnp.where(drags, 0.0, ratio)  # of what was
    multiple = jnp.abs(now.gamma - expected * old.gamma) <= allowed
    same_root = jnp.abs(now.root - expected * old.root) <= allowed
    multiple = multiple & same_root
    differs = jnp.abs(now.slip - expected * old.slip)
    half = jnp.abs(old.slip) / 2
    falls = drags & (jnp.abs(now.slip) <= half)
    stops = wedged & ((differs <= allowed) | falls)
    # the sum of what is left, a geometric series
    series = quotient(ratio, 1 - ratio, where=decays)
    left = series * impulse
    left_side = series * side
    dgamma = flow.coupling.times(left) + times(flow.normal_tangent, left_side)
    du = times(jnp.swapaxes(flow.normal_tangent, 0, 1), left)
    du = du + times(flow.tangent, left_side)
    opens = now.gamma + dgamma >= 0
    is_open = (now.gamma >= 0) & opens & (now.root <= 0)
    clear = drags | (differs > CLEARLY * allowed)
    goes_on = (now.slip * (now.slip + du) > 0) & clear
    meets = jnp.where(wedged, multiple & (stops | goes_on), is_open)
    modes = flow.modes(now.modes)
    old_modes = flow.modes(old.modes)
    other_phase = modes.phase != old_modes.phase
    changed = other_phase | (modes.slip != old_modes.slip)
    same = drags | ~any_of(changed)
    ended = decays & any_of(wedged) & ~any_of(~meets) & same
    found = now._replace(impulse=left, side=left_side, wedged=wedged, stops=stops)
    return found, ended


def _size(state: Cycle, wedged: Bool[Array, "m B"]) -> Float[Array, "1 B"]:
    """Largest velocity, or root of an energy, of the contacts that are `wedged`."""
    largest = jnp.maximum(jnp.abs(state.gamma), state.root)
    return largest_of(jnp.where(wedged, largest, 0.0))
