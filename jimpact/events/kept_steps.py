"""The accepted steps of a run from the last one to the first: what the reverse mode needs.

A run keeps its accepted steps, each with the state before it, in a fixed number of slots. Once
these are full it keeps every second step, then every fourth, and so on. `backwards` visits all
steps, the last one first; those between two kept ones are run again, into slots that have become
free. So the memory does not grow with the number of steps, and a run of at most KEPT steps repeats
nothing.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jimpact.events import stepper
from jimpact.events.stepper import GOES_ON, OVER, PAUSED, Flow, Step, StepperState

# Accepted steps that a run keeps, a power of 2. Ten times more: ten times the memory of the reverse
# mode.
KEPT = 64
NONE = -1  # number of the step in a slot that holds none
# Difference, in units of the impact, from which on a repeated step is another one than the first
# time: no derivative is then better than a wrong one. Ten times more: worse ones pass.
SAME = 1e-6


class Kept(NamedTuple):
    """Steps in slots, with one slot more for what is not kept, and what is to be kept next.

    A pass that any impact of the batch accepts is one step: all count together.
    """

    numbers: jax.Array  # (KEPT,) of the steps in the slots, or NONE
    state: jax.Array  # (KEPT + 1, n + 8, B): y, clock and progress before the step
    marks: jax.Array  # (KEPT + 1, m + k + 1, B): modes, target, 1 where it is accepted
    # (4,): numbers of the next step and of the first of this run, spacing of the steps to keep, and
    # the number before which the run ends; the step before it is always kept
    plan: jax.Array


class KeptStep(NamedTuple):
    """An accepted step, and the state before it."""

    step: Step  # of length 0 for impacts that do not accept it
    y: jax.Array
    accepted: jax.Array  # (1, B)
    number: jax.Array  # ()


def nothing_kept(carry: StepperState) -> Kept:
    """Empty slots."""
    y, (modes, target, clock), progress = carry
    rows, batch = len(y) + len(clock) + len(progress), clock.shape[1:]
    return Kept(
        jnp.full(KEPT, NONE, jnp.int32),
        jnp.zeros((KEPT + 1, rows, *batch), clock.dtype),
        jnp.zeros((KEPT + 1, len(modes) + len(target) + 1, *batch), jnp.int32),
        jnp.array([0, 0, 1, np.iinfo(np.int32).max], jnp.int32),
    )


def record(flow: Flow, carry: StepperState, kept: Kept, most: int) -> tuple[StepperState, Kept]:
    """As `stepper.run`; it also keeps steps."""
    passes = jnp.full_like(carry.progress[3:4], jnp.inf)
    return jax.lax.while_loop(
        lambda state: stepper.unwatched(state[0], most),
        lambda state: _one_pass(flow, *state, most, passes),
        (carry, kept),
    )


def _one_pass(
    flow: Flow, carry: StepperState, kept: Kept, most: int, passes: jax.Array
) -> tuple[StepperState, Kept]:
    """One of `passes` (1, B); those that are run again do not wait at a pause."""
    mark = carry.progress[2:3]
    resumed = jnp.where(carry.progress[3:4] < passes, GOES_ON, OVER)
    mark = jnp.where(mark == PAUSED, resumed, mark)
    carry = carry._replace(progress=carry.progress.at[2:3].set(mark))
    after, accept = stepper.advance(flow, carry, most)
    return after, _noted(kept, carry, accept)


def _noted(kept: Kept, carry: StepperState, accept: jax.Array) -> Kept:
    """With the step of `carry`, where an impact accepts it and the plan asks for it."""
    numbers, state, marks, (number, first, spacing, end) = kept
    some = jnp.any(accept)
    wanted = some & ((jax.lax.rem(number - first, spacing) == 0) | (number == end - 1))
    full = wanted & (jnp.min(numbers) >= 0)
    spacing = jnp.where(full, 2 * spacing, spacing)
    numbers = jnp.where(full & (jax.lax.rem(numbers, spacing) != 0), NONE, numbers)
    slot = jnp.where(wanted, jnp.argmin(numbers).astype(jnp.int32), KEPT)
    y, (modes, target, clock), progress = carry
    now = jnp.concatenate([modes, target.astype(jnp.int32), accept.astype(jnp.int32)])
    return Kept(
        jnp.where(_is(slot), number, numbers),
        stepper.put(state, jnp.concatenate([y, clock, progress]), slot),
        stepper.put(marks, now, slot),
        jnp.stack([number + some.astype(jnp.int32), first, spacing, end]),
    )


def _is(slot: jax.Array) -> jax.Array:
    """One-hot (KEPT,)."""
    return jnp.arange(KEPT, dtype=jnp.int32) == slot


def _in_slot(like: StepperState, kept: Kept, slot: jax.Array) -> tuple[StepperState, jax.Array]:
    """The state before the step in a slot, and which impacts accept it (1, B)."""
    n, m = len(like.y), len(like.step.modes)
    state, marks = (
        jax.lax.dynamic_index_in_dim(x, slot, keepdims=False, allow_negative_indices=False)
        for x in (kept.state, kept.marks)
    )
    step = Step(marks[:m], marks[m:-1] > 0, state[n : n + 4])
    return StepperState(state[:n], step, state[n + 4 :]), marks[-1:] > 0


def _latest(kept: Kept) -> jax.Array:
    """The slot with the latest step."""
    return jnp.argmax(kept.numbers).astype(jnp.int32)


def _run_again(
    flow: Flow, end: StepperState, kept: Kept, most: int, left: jax.Array
) -> tuple[StepperState, Kept]:
    """From the latest kept step on, up to the step number `left`; nothing if none is missing.

    If not all fit in, this keeps steps in half of the free slots: what is between them has to be
    run again, and needs the others.
    """
    slot = _latest(kept)
    number = kept.numbers[slot]
    missing = left - number
    room = 1 + jnp.sum(kept.numbers < 0, dtype=jnp.int32)
    half = (room + 1) // 2
    spacing = jnp.where(missing > room, (missing + half - 1) // half, 1)
    none = missing == 1
    numbers = jnp.where(_is(slot) & ~none, NONE, kept.numbers)
    plan = jnp.stack([jnp.where(none, left, number), number, spacing, left])
    passes = end.progress[3:4]
    return jax.lax.while_loop(
        lambda state: (state[1].plan[0] < left) & jnp.any(state[0].progress[3:4] < passes),
        lambda state: _one_pass(flow, *state, most, passes),
        (_in_slot(end, kept, slot)[0], kept._replace(numbers=numbers, plan=plan)),
    )


class _Sweep(NamedTuple):
    """What has been visited so far."""

    kept: Kept
    left: jax.Array  # () steps that are still to be visited
    y: jax.Array  # the state before the step that was visited last
    accepted: jax.Array  # (1, B) by which impacts
    result: Any
    failed: jax.Array  # () a repeated step was not what it had been


def backwards(
    flow: Flow,
    end: StepperState,
    kept: Kept,
    most: int,
    visit: Callable[[Any, KeptStep], Any],
    start: Any,
) -> Any:
    """What `visit` makes of `start` at all accepted steps of a run, from the last to the first."""

    def at_hand(sweep: _Sweep) -> jax.Array:
        """Whether the next step to visit is in a slot."""
        return (sweep.left > 0) & (jnp.max(sweep.kept.numbers) == sweep.left - 1)

    def one(sweep: _Sweep) -> _Sweep:
        """Visit it."""
        slot = _latest(sweep.kept)
        carry, accepted = _in_slot(end, sweep.kept, slot)
        step = jax.tree.map(lambda x: jnp.where(accepted, x, jnp.zeros_like(x)), carry.step)
        result = visit(sweep.result, KeptStep(step, carry.y, accepted, sweep.left - 1))
        numbers = jnp.where(_is(slot), NONE, sweep.kept.numbers)
        kept = sweep.kept._replace(numbers=numbers)
        return _Sweep(kept, sweep.left - 1, carry.y, accepted, result, sweep.failed)

    def on(sweep: _Sweep) -> _Sweep:
        """Run steps again if they are missing, and visit those at hand."""
        missing = ~at_hand(sweep)
        carry, kept = _run_again(flow, end, sweep.kept, most, sweep.left)
        other = sweep.accepted & ~(jnp.abs(carry.y - sweep.y) <= SAME)
        failed = missing & (jnp.any(other) | (kept.plan[0] < sweep.left))
        return jax.lax.while_loop(at_hand, one, sweep._replace(kept=kept, failed=failed))

    numbers, spacing, left = kept.numbers, kept.plan[2], kept.plan[0]
    # room for steps that are run again, if any
    sparse = (spacing > 1) & (jax.lax.rem(numbers, 2 * spacing) != 0)
    kept = kept._replace(numbers=jnp.where(sparse, NONE, numbers))
    none = jnp.zeros_like(end.progress[:1], bool)
    sweep = _Sweep(kept, left, end.y, none, start, jnp.asarray(False))
    sweep = jax.lax.while_loop(lambda sweep: (sweep.left > 0) & ~sweep.failed, on, sweep)
    known = jnp.where(sweep.failed, jnp.nan, 1.0)

    def checked(x: jax.Array) -> jax.Array:
        """NaN if a step was another one."""
        return x * known.astype(x.dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x

    return jax.tree.map(checked, sweep.result)
