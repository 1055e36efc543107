"""Derivatives of whole motions: a run writes down what it decides, and a second walk repeats it.

The run writes down its accepted steps and what was decided at its events (`MotionPlan`). A second
walk through them, with all decisions fixed, is a scan: JAX differentiates it in both modes and any
order. Its blocks of rows are checkpoints, and blocks without a step are skipped.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

from jimpact.compiling import full_precision
from jimpact.events.batches import any_lane
from jimpact.motion.flow import State, nan_derivatives, packed, put, selected
from jimpact.status import CODE

# Rows of a plan, in addition to one a sample: accepted steps of a motion with derivatives. Those
# of a motion of more steps are NaN. Ten times more takes ten times the memory of derivatives.
ROWS_MORE = 1024
BLOCK = 16  # rows between two checkpoints


class MotionPlan(NamedTuple):
    """Rows of a run; those beyond `used` are not to be read."""

    rows: Any  # (R, ..)
    used: jax.Array
    lost: jax.Array  # whether there were too few

    @property
    def size(self) -> int:
        """How many rows it keeps; one more is for discarded entries."""
        return int(jax.tree.leaves(self.rows)[0].shape[0]) - 1

    def with_row(self, row: Any, recorded: jax.Array) -> "MotionPlan":
        """With this row, if it is to be `recorded` ()."""
        rows = jax.tree.map(lambda every, x: put(every, x, self.used), self.rows, row)
        used = jnp.minimum(self.used + recorded.astype(jnp.int32), self.size)
        return MotionPlan(rows, used, self.lost | (used == self.size))


class MotionTable(NamedTuple):
    """What a motion writes down; rows beyond those reached hold anything."""

    samples: jax.Array  # (S + 1, rows of the state)
    events: jax.Array  # (E + 1, w)
    marks: jax.Array  # (E + 1, 2 + m) kind, status of the law, contacts


class MotionEnd(NamedTuple):
    """A run at its end."""

    table: MotionTable
    reached: jax.Array  # samples
    event_count: jax.Array
    steps: jax.Array
    status: jax.Array
    plan: MotionPlan | None
    more: jax.Array | None  # what else the run tells


def empty_plan(row: Any, samples: int, events: int, per_event: int, max_steps: int) -> MotionPlan:
    """A plan without rows, which are like `row`: so many for each event."""
    size = min(samples + per_event * events + ROWS_MORE, max_steps)
    size = -(-size // BLOCK) * BLOCK + 1
    rows = jax.tree.map(lambda x: jnp.zeros((size, *x.shape), _short(x)), row)
    return MotionPlan(rows, jnp.int32(0), jnp.asarray(False))


def _short(x: jax.Array) -> Any:
    """Modes are small numbers."""
    return jnp.int8 if jnp.issubdtype(x.dtype, jnp.integer) else x.dtype


def differentiable(
    problem: Any,
    run: Callable[[Any, bool], MotionEnd],
    again: Callable[[Any, MotionPlan], tuple[jax.Array, jax.Array]],
) -> MotionEnd:
    """`run(problem, records)`; samples and events have derivatives, of `again(problem, plan)`."""
    leaves, tree = jax.tree.flatten(problem)
    fixed = [None if eqx.is_array(x) else x for x in leaves]

    def rebuilt(arrays: tuple[jax.Array, ...]) -> Any:
        """The problem with these arrays."""
        values = iter(arrays)
        return jax.tree.unflatten(tree, [next(values) if x is None else x for x in fixed])

    @jax.custom_jvp
    def value(*arrays: jax.Array) -> MotionEnd:
        return run(rebuilt(arrays), False)

    @full_precision
    def rule(arrays: Any, tangents: Any) -> Any:
        """Values by the run, tangents by walking through its plan again."""
        marked = [not isinstance(t, SymbolicZero) for t in tangents]
        end = run(rebuilt(jax.lax.stop_gradient(arrays)), True)
        assert end.plan is not None
        plan: MotionPlan = end.plan

        def smooth(*moved: jax.Array) -> tuple[jax.Array, jax.Array]:
            some = iter(moved)
            inputs = [next(some) if mark else x for x, mark in zip(arrays, marked)]
            return again(rebuilt(tuple(inputs)), plan)

        values = tuple(x for x, mark in zip(arrays, marked) if mark)
        rates = tuple(t for t, mark in zip(tangents, marked) if mark)
        results, slopes = jax.jvp(smooth, values, rates)
        recorded = end.table.samples, end.table.events
        samples, events = selected(plan.lost, recorded, results)
        lost = plan.lost & (end.status == CODE["ok"])
        status = jnp.where(lost, CODE["no_derivatives"], end.status).astype(jnp.int32)
        table = MotionTable(samples, events, end.table.marks)
        end = end._replace(table=table, status=status, plan=None)
        none = jax.tree.map(lambda x: np.zeros(x.shape, jax.dtypes.float0), end)
        return end, none._replace(table=MotionTable(slopes[0], slopes[1], none.table.marks))

    value.defjvp(rule, symbolic_zeros=True)
    return value(*(x for x, y in zip(leaves, fixed) if y is None))


class Retraced(NamedTuple):
    """What a second walk through a plan gives."""

    states: jax.Array  # (R, rows of the state) after each row of the plan
    numbers: jax.Array  # (R, w) of its event


def walk(
    one: Callable[[State, Any], tuple[State, Any]],
    start: State,
    rows: Any,
    busy: jax.Array,
    width: int,
) -> Retraced:
    """What `one(state, row)` gives, row by row: the state and `width` numbers.

    Between two blocks of rows lies a checkpoint; a block in which none is `busy` is left out.
    """
    sizes = len(packed(start)), width

    def block(state: State, xs: Any) -> tuple[State, Any]:
        def through(state: State) -> tuple[State, Any]:
            return jax.lax.scan(jax.checkpoint(one), state, xs[0])

        def stay(state: State) -> tuple[State, Any]:
            return state, tuple(jnp.zeros((BLOCK, size), start.q.dtype) for size in sizes)

        return jax.lax.cond(any_lane(jnp.any(xs[1])), through, stay, state)

    blocks = jax.tree.map(lambda x: x.reshape(-1, BLOCK, *x.shape[1:]), (rows, busy))
    values = jax.lax.scan(jax.checkpoint(block), start, blocks)[1]
    return Retraced(*jax.tree.map(lambda x: x.reshape(-1, x.shape[-1]), values))


def tables_of(
    problem: Any, plan: MotionPlan, start: State, went: Retraced, sampled: jax.Array,
    written: jax.Array, sizes: tuple[int, int],
) -> tuple[jax.Array, jax.Array]:  # fmt: skip
    """Samples and events, so many rows, of a walk: those of the rows (R,) `sampled`, `written`.

    Derivatives of what a motion does not reach are NaN; all are if rows of the plan ran out.
    """

    def at(flags: jax.Array, values: jax.Array, count: int) -> jax.Array:
        """The values in the first rows with a flag; derivatives of further ones are NaN."""
        values, known = _first_rows(flags, values, count)
        return values + nan_derivatives(problem, known).astype(values.dtype)

    first = packed(start)[:, 0][None]
    samples = jnp.concatenate([first, at(sampled, went.states, sizes[0])])
    events = at(written, went.numbers, sizes[1])
    inputs = [x for x in jax.tree.leaves(problem) if eqx.is_inexact_array(x)]
    finite = [jnp.sum(jnp.where(jnp.isfinite(x), x, 0.0)).astype(first.dtype) for x in inputs]
    unknown = jnp.where(plan.lost, jnp.nan, 0.0) * jnp.sum(jnp.stack(finite))
    return samples + unknown, events + unknown


def samples_before(sampled: jax.Array) -> jax.Array:
    """How many samples (R,) are reached before the step of each row, the first one included."""
    return jnp.cumsum(sampled, dtype=jnp.int32) + (~sampled).astype(jnp.int32)


def _first_rows(flags: jax.Array, values: jax.Array, count: int) -> tuple[jax.Array, jax.Array]:
    """Values (count, k) of the first rows with a flag, else 0; and which of them there are."""
    so_far, wanted = jnp.cumsum(flags, dtype=jnp.int32), jnp.arange(count, dtype=jnp.int32)
    row = jnp.minimum(jnp.searchsorted(so_far, wanted + 1), len(flags) - 1)
    known = wanted < so_far[-1]
    return jnp.where(known[:, None], values[row], 0.0), known
