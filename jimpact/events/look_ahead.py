"""Do the contacts of a long chain come to rest together? A look ahead.

A chain that loses much energy ends as a block. Waves run back and forth in it, each
contact closes hundreds of times, and no state returns as a multiple of an earlier one.
But momentum is conserved: let dp_j be the impulse that contact j still has to carry in
the plastic limit. Contact j transfers all the momentum between the two parts of the
chain that it joins, so that with the impulse p_j(t) that it has carried since

    dp_j - p_j(t) > 0   always: the parts come to rest relative to each other,
    dp_j - p_j(t) < 0   once: they separate.

A look ahead follows p_j(t) by steps without events (`implicit_steps.py`), with errors
that are a part COARSE of the velocities that are left. Its errors do not matter where
p_j never comes close to dp_j: where what is left is at least MARGIN times what the
contact can deliver alone, out of its approach and its stored energy. Then the end is
the plastic limit of the state at hand, to all digits. Otherwise nothing is concluded,
and the law's own steps go on.
"""

import dataclasses
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jimpact.events.implicit_steps import (
    FIRST,
    ImplicitState,
    ImplicitSteps,
    attempt,
    descent_of,
)
from jimpact.numerics.driver import until_over
from jimpact.numerics.stepper import any_of

# Error of a step, as a part of the largest velocity (or root of energy) that is left.
# Ten times more: looks see no margin where there is one; ten times less: twice the
# passes.
COARSE = 0.03
# Approach (or root of energy) of a contact over what it has left to carry; alone, it
# would carry at most twice its approach. Blocks of 12 to 200 equal balls have 2 to 7,
# chains of random bodies that were taken for blocks .6. Ten times more: no block is
# found.
MARGIN = 2.0
# What is left at the end, and what is compared by MARGIN, in errors that the law's
# tolerance allows in the outcome. Ten times more: contacts that separate by the
# tolerance count as at rest.
LEFT = 0.25
COMPARED = 4.0
# Passes per contact after which nothing is concluded; blocks of 12 to 200 balls took
# 150 to 400. Ten times more: what does not come to rest is looked at for longer than it
# is computed.
LONGEST = 1000


class _Look(NamedTuple):
    """A look ahead on its way."""

    state: ImplicitState
    length: Float[Array, "1 B"]  # of the next step
    passes: Int[Array, "1 B"]  # steps tried
    clear: Bool[Array, "1 B"]  # dp_j - p_j was far enough from 0 in all states


def _steps_of(flow: Any, x: Float[Array, "m B"]) -> ImplicitSteps:
    """The impacts of a flow with indentations x by implicit steps, without friction."""
    return ImplicitSteps(
        coupling=flow.coupling,
        equations=flow.equations,
        omega=flow.omega,
        restitution=flow.restitution,
        exponent_array=flow.exponent_array,
        friction=jnp.zeros_like(x),
        descent=descent_of(flow.coupling, flow.contacts),
        tolerance=flow.tolerance,
        exponent_static=flow.exponent_static,
    )


def comes_to_rest(
    flow: Any,
    modes: Int[Array, "modes B"],
    y: Float[Array, "n B"],
    block: Bool[Array, "m B"],
    dp: Float[Array, "m B"],
    asked: Bool[Array, "1 B"],
) -> Bool[Array, "1 B"]:
    """Mask of the impacts whose contacts of the `block` come to rest, with the impulses
    dp: the look remained clear, what is left is below the tolerance, and so are the
    velocities of the block.

    No other contact then carries anything. Only the impacts `asked` are looked at.
    """
    m = flow.contacts
    x, g, _ = flow.rows(y)
    # error that the law's tolerance allows in the outcome, see `dimensionless`
    visible = flow.tolerance * jnp.maximum(flow.taking_part, 2) / 2
    steps = _steps_of(flow, x)

    def holds(s: ImplicitState) -> Float[Array, "m B"]:
        """Approach, or root of the stored energy if that is more, of each contact."""
        stored = jnp.sqrt(steps.energy(s.indentation))
        return jnp.maximum(stored, -s.velocity)

    def size(s: ImplicitState) -> Float[Array, "1 B"]:
        """Largest approach or root of the energy of all contacts."""
        return jnp.max(holds(s), axis=0, keepdims=True)

    def goes_on(steps: ImplicitSteps, look: _Look) -> Bool[Array, "1 B"]:
        """Mask of the looks that are not over."""
        left = size(look.state) > LEFT * visible
        return asked & look.clear & left & (look.passes < LONGEST * m)

    def is_clear(s: ImplicitState) -> Bool[Array, "1 B"]:
        """Mask: no contact of the block is close to separating, and no other one
        carries more than the tolerance.

        Close: `dp - p < MARGIN` times its approach or root of the energy, if that is
        more than COMPARED visible errors.
        """
        held = holds(s)
        carries_on = held > COMPARED * visible
        close = carries_on & (dp - s.impulse < MARGIN * held)
        carries = s.impulse > flow.tolerance
        return ~any_of(jnp.where(block, close, carries))

    def coarse_step(steps: ImplicitSteps, look: _Look) -> _Look:
        """The look after one step tried, with errors that are a part COARSE of what is
        left.
        """
        live = goes_on(steps, look)
        coarse = dataclasses.replace(steps, tolerance=COARSE * size(look.state))
        state, length, _ = attempt(coarse, look.state, look.length, live)
        clear = look.clear & is_clear(state)
        passes = look.passes + live.astype(jnp.int32)
        return _Look(state, length, passes, clear)

    start = steps.start(x, flow.scales(modes) * g)
    first = _Look(
        state=start,
        length=FIRST * jnp.ones_like(visible),
        passes=jnp.zeros(visible.shape, jnp.int32),
        clear=is_clear(start),
    )
    end = until_over(goes_on, coarse_step, steps, first)
    moves = jnp.abs(end.state.velocity) > visible
    rests = any_of(block) & ~any_of(block & moves)
    over = size(end.state) <= LEFT * visible
    return asked & end.clear & over & rests
