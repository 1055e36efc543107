"""The loop of impacts and motions: side by side, or in a queue with room for the next
one.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeVar

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from jimpact.tools.loops import in_a_branch, while_loop
from jimpact.tools.masks import choose

# Impacts that a CPU computes side by side: 128 and 512 take a tenth longer. Ten times
# more: stages leave a core's cache; ten times fewer: each operation has too few numbers
# to work on.
SLOTS = 256
SLOTS_WITH_TANGENTS = 128  # of impacts with tangents, which take more room in the cache
# with friction in space, where some take many times the passes of others
SLOTS_IN_SPACE = 64
# Part of the slots that are free before they are filled with waiting impacts. Ten times
# more: all wait for the slowest impact again; ten times less: copying what enters takes
# longer than a pass.
FREE = 1 / 16
# States that the reverse mode of a loop keeps at a time. Ten times more: ten times its
# memory; ten times fewer: steps are run again more often.
CHECKPOINTS = 64

Carry = TypeVar("Carry")


class _Slots(NamedTuple):
    """Impacts that are being computed, one in each slot, and those that are over."""

    impact: Int[Array, " slots"]  # the impact that is in each slot
    following: Int[Array, ""]  # the first impact that still waits
    flow: Any  # parameters of the impacts in the slots
    carry: Any  # their states
    ends: Any  # states of all impacts, as far as they have left their slots


def until_over(
    goes_on: Callable[[Any, Any], jax.Array],
    advance: Callable[[Any, Any], Any],
    flow: Any,
    carry: Carry,
    checkpoints: bool = False,
    slots: int | None = None,
) -> Carry:
    """States of all impacts, or of one motion, at their ends: passes until none goes
    on.

    `goes_on(flow, carry)` is a mask (1, B) of those that are not over,
    `advance(flow, carry)` makes one pass; the batch B of impacts is the last axis of
    all arrays. With `checkpoints` the loop has a reverse mode, in the place of a
    forward mode. A CPU has at most so many `slots` of impacts side by side; None: all.
    """

    def at_once(flow: Any, carry: Any) -> Any:
        """The ends of all impacts, side by side: they wait for the slowest one."""

        def busy(carry: Any) -> Bool[Array, ""]:
            """True while an impact goes on."""
            return jnp.any(goes_on(flow, carry))

        if checkpoints:
            one = lambda carry: advance(flow, carry)  # noqa: E731
            return eqxi.while_loop(
                busy, one, carry, kind="checkpointed", checkpoints=CHECKPOINTS
            )
        return while_loop(busy, lambda carry: advance(flow, carry), carry)

    def in_slots(flow: Any, carry: Any) -> Any:
        """The ends of all impacts, as a queue for the slots."""
        return _in_slots(goes_on, advance, flow, carry, slots or count)

    count = jax.tree.leaves(carry)[0].shape[-1]
    if checkpoints or count <= (slots or count):
        return at_once(flow, carry)
    return jax.lax.platform_dependent(flow, carry, cpu=in_slots, default=at_once)


def _in_slots(
    goes_on: Callable[[Any, Any], jax.Array],
    advance: Callable[[Any, Any], Any],
    flow: Any,
    carry: Any,
    size: int,
) -> Any:
    """The ends of more impacts than `size` slots: where one is over, the next one
    enters.
    """
    count = jax.tree.leaves(carry)[0].shape[-1]
    most_free = max(1, round(FREE * size))

    def picked(tree: Any, impact: Int[Array, " slots"]) -> Any:
        """The columns of these impacts in all arrays (.., B) of the tree."""
        taken = partial(jnp.take, indices=impact, axis=-1, mode="clip")
        return jax.tree.map(taken, tree)

    def stored(s: _Slots) -> Any:
        """The states of all impacts, those in slots as they are now."""
        return jax.tree.map(
            lambda x, new: x.at[..., s.impact].set(new), s.ends, s.carry
        )

    def refilled(s: _Slots) -> tuple[jax.Array, jax.Array, Any, Any]:
        """Impacts, the following one, parameters and states of the slots, with the next
        waiting impacts in place of those that are over.
        """
        free = ~goes_on(s.flow, s.carry)[0]
        # the first free slot gets the impact `following`, the second the one after it,
        # ..
        next_one = s.following + jnp.cumsum(free, dtype=jnp.int32) - 1
        enters = free & (next_one < count)
        impact = jnp.where(enters, next_one, s.impact)
        new_flow, new = picked((flow, carry), impact)
        new = choose(enters, new, s.carry)
        following = s.following + jnp.sum(enters, dtype=jnp.int32)
        return impact, following, new_flow, new

    def next_round(s: _Slots) -> _Slots:
        """The slots after passes until enough of them are free, which are then
        filled.
        """

        def continues(carry: Any) -> Bool[Array, ""]:
            """True while too few slots are free to fill them, or some are busy at the
            end.
            """
            going = goes_on(s.flow, carry)
            busy = jnp.sum(going, dtype=jnp.int32)
            return busy > jnp.where(s.following < count, size - most_free, 0)

        carry = while_loop(continues, lambda carry: advance(s.flow, carry), s.carry)
        after = s._replace(carry=carry)
        always = after.following > 0
        entered = in_a_branch(always, lambda: refilled(after))
        # stored apart: in the branch, blocks with friction take 3 % longer
        return _Slots(*entered, stored(after))

    def open_work(s: _Slots) -> Bool[Array, ""]:
        """True while an impact goes on or waits."""
        going = goes_on(s.flow, s.carry)
        return jnp.any(going) | (s.following < count)

    impact = jnp.arange(size, dtype=jnp.int32)
    following = jnp.asarray(size, jnp.int32)
    both = (flow, carry)
    flow_of_slots, carry_of_slots = jax.tree.map(lambda x: x[..., :size], both)
    slots = _Slots(impact, following, flow_of_slots, carry_of_slots, carry)
    return while_loop(open_work, next_round, slots).ends
