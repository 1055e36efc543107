"""The loop of impacts and motions: side by side, or in a queue with room for the next one."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import equinox.internal as eqxi
import jax
import jax.numpy as jnp

from jimpact.tools.loops import cond, while_loop

# Impacts with friction that a CPU computes side by side, whatever the size of the batch; and slots
# that are free before they are filled with waiting impacts. Ten times more slots: more of them idle
# while the last impacts end; ten times fewer: each operation has too few numbers to work on. Ten
# times more free slots: all wait for the slowest impact again.
SLOTS, FREE = 64, 4
# States that the reverse mode of a loop keeps at a time. Ten times more: ten times its memory; ten
# times fewer: steps are run again more often.
CHECKPOINTS = 64

Carry = TypeVar("Carry")


class _Slots(NamedTuple):
    """Impacts that are being computed, one in each slot, and those that are over."""

    impact: jax.Array  # (SLOTS,) the impact that is in each slot
    following: jax.Array  # () the first impact that still waits
    flow: Any
    carry: Any
    ends: Any  # of all impacts, as far as they have left their slots


def until_over(
    goes_on: Callable[[Any, Any], jax.Array],
    advance: Callable[[Any, Any], Any],
    flow: Any,
    carry: Carry,
    checkpoints: bool = False,
    queues: bool = False,
) -> Carry:
    """All impacts, or one motion, to their ends.

    `goes_on(flow, carry)` says which (1, B) are not over, `advance(flow, carry)` makes one pass;
    the batch B of impacts is the last axis of all arrays. With `checkpoints` the loop has a reverse
    mode, in the place of a forward mode. If it `queues`, a CPU has at most SLOTS impacts side by
    side.
    """

    def at_once(flow: Any, carry: Any) -> Any:
        """All impacts side by side: they wait for the slowest one."""

        def busy(carry: Any) -> jax.Array:
            """Whether () any goes on."""
            return jnp.any(goes_on(flow, carry))

        if checkpoints:
            one = lambda carry: advance(flow, carry)  # noqa: E731
            return eqxi.while_loop(busy, one, carry, kind="checkpointed", checkpoints=CHECKPOINTS)
        return while_loop(busy, lambda carry: advance(flow, carry), carry)

    def in_slots(flow: Any, carry: Any) -> Any:
        """As a queue, in slots."""
        return _in_slots(goes_on, advance, flow, carry)

    if checkpoints or not queues or jax.tree.leaves(carry)[0].shape[-1] <= SLOTS:
        return at_once(flow, carry)
    return jax.lax.platform_dependent(flow, carry, cpu=in_slots, default=at_once)


def _in_slots(
    goes_on: Callable[[Any, Any], jax.Array],
    advance: Callable[[Any, Any], Any],
    flow: Any,
    carry: Any,
) -> Any:
    """`until_over` of more impacts than there are slots."""
    count = jax.tree.leaves(carry)[0].shape[-1]

    def picked(tree: Any, impact: jax.Array) -> Any:
        """The arrays (.., B) of these impacts."""
        return jax.tree.map(lambda x: jnp.take(x, impact, axis=-1, mode="clip"), tree)

    def stored(s: _Slots) -> Any:
        """All ends, those of the slots included."""
        return jax.tree.map(lambda x, new: x.at[..., s.impact].set(new), s.ends, s.carry)

    def refilled(s: _Slots) -> _Slots:
        """The next impacts in place of those that are over."""
        free = ~goes_on(s.flow, s.carry)[0]
        next_one = s.following + jnp.cumsum(free, dtype=jnp.int32) - 1
        enters = free & (next_one < count)
        impact = jnp.where(enters, next_one, s.impact)
        new_flow, new = picked((flow, carry), impact)
        new = jax.tree.map(lambda a, b: jnp.where(enters, a, b), new, s.carry)
        following = s.following + jnp.sum(enters, dtype=jnp.int32)
        return _Slots(impact, following, new_flow, new, stored(s))

    def one_pass(s: _Slots) -> _Slots:
        """One pass in each slot; enough of those that are free are filled first."""
        free = jnp.sum(~goes_on(s.flow, s.carry), dtype=jnp.int32)
        fills = (free >= FREE) & (s.following < count)
        s = cond(fills, lambda: refilled(s), lambda: s)
        return s._replace(carry=advance(s.flow, s.carry))

    def open_work(s: _Slots) -> jax.Array:
        """Whether () an impact goes on or waits."""
        return jnp.any(goes_on(s.flow, s.carry)) | (s.following < count)

    first = jnp.arange(SLOTS, dtype=jnp.int32)
    own, here = picked((flow, carry), first)
    slots = _Slots(first, jnp.asarray(SLOTS, jnp.int32), own, here, carry)
    return stored(while_loop(open_work, one_pass, slots))
