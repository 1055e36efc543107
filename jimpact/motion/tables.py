"""What determines a motion, what a run writes down, and the derivatives of that.

JAX pushes tangents through the loop of a run: all that is decided (lengths of steps, events, modes)
has none. Both modes then follow from its Jacobian (`derive.py`).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from jimpact.motion.flow import Settings, State, packed, unpacked
from jimpact.motion.record import KIND_CODE, Events
from jimpact.motion.system import System
from jimpact.motion.transitions import After, tangent_count_of
from jimpact.numerics.derive import by_jacobian

# Power of the largest number that makes tangents of 1e-31 (float32) infinite the second time, but
# none below 1e3 the first time.
LARGE = 0.9


class Past(NamedTuple):
    """What a run takes over from the one before it."""

    most: jax.Array  # () events that are still allowed
    numbers: jax.Array  # (k,) see `_pack_checkpoint`; 0 where the motion begins


class MotionProblem(NamedTuple):
    """What determines a motion."""

    system: System
    law: Any  # `Law` of impacts, or the `Force` of contacts that acts throughout
    mu: jax.Array | None
    settings: Settings
    q0: jax.Array
    v0: jax.Array
    times: jax.Array  # (S,)
    contacts: int  # m
    past: Past | None = None  # where the motion may go on, run after run

    @property
    def tangents(self) -> int:
        """The number of tangential impulses."""
        return tangent_count_of(self.system, self.q0, self.contacts)

    @property
    def start(self) -> State:
        """The state at the beginning."""
        zero = jnp.zeros((), self.q0.dtype)
        rest = jnp.zeros((2, self.contacts), self.q0.dtype)
        return State(self.q0, self.v0, self.times[0], zero, zero, rest, rest[:0])


class Course(NamedTuple):
    """A whole motion: states at the sampled times (NaN: not reached), events, steps, status."""

    samples: State
    events: Events
    steps: jax.Array
    status: jax.Array


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
    smooth: jax.Array  # (2,) samples and events before normals jumped
    more: jax.Array | None  # what the next run takes over


def differentiable(problem: Any, run: Callable[[Any], MotionEnd]) -> MotionEnd:
    """`run(problem)` with derivatives in both modes; NaN of what is not reached, or not smooth."""
    end: MotionEnd = by_jacobian(run, problem)

    def known(rows: jax.Array, count: jax.Array) -> jax.Array:
        """Rows, of which the first `count` () and the last one have derivatives, others NaN."""
        index = jnp.arange(len(rows), dtype=count.dtype)
        there = (index < count) | (index == len(rows) - 1)
        some = jnp.where(there[:, None], rows, jax.lax.stop_gradient(rows))
        return some + nan_derivatives(problem, there).astype(rows.dtype)

    samples, events = (
        known(end.table.samples, jnp.minimum(end.reached, end.smooth[0])),
        known(end.table.events, jnp.minimum(end.event_count, end.smooth[1])),
    )
    return end._replace(table=MotionTable(samples, events, end.table.marks))


def empty_table(problem: MotionProblem, start: State, max_events: int) -> MotionTable:
    """The table of a motion that begins in this state."""
    return MotionTable(
        no_samples(start, problem.times),
        jnp.zeros((max_events + 1, event_width(problem)), start.q.dtype),
        jnp.zeros((max_events + 1, 2 + problem.contacts), jnp.int32),
    )


def put(rows: jax.Array, value: jax.Array, index: jax.Array) -> jax.Array:
    """The table with a row written."""
    return jax.lax.dynamic_update_index_in_dim(rows, value.astype(rows.dtype), index, 0)


def no_samples(start: State, targets: jax.Array) -> jax.Array:
    """A table of the states at the samples, and a last row for discarded entries."""
    row = packed(start)[:, 0]
    return jnp.zeros((targets.shape[0] + 1, len(row)), row.dtype).at[0].set(row)


def nan_unless(known: jax.Array, rows: jax.Array) -> jax.Array:
    """Rows (r, w), NaN where not `known` (r,); other than those of `where`, derivatives pass."""
    return rows + jnp.where(known, 0.0, jnp.nan).astype(rows.dtype)[:, None]


def nan_derivatives(inputs: Any, known: jax.Array) -> jax.Array:
    """Zeros (r, 1); where not `known` (r,) all their derivatives by all inputs are NaN.

    A motion that has ended does not determine what would come later. In reverse mode what nobody
    differentiates (a cotangent of 0) leaves the gradient as it is.
    """
    arrays = [x for x in jax.tree.leaves(inputs) if eqx.is_inexact_array(x)]
    return _undetermined(arrays, ~known)[:, None]


@jax.custom_jvp
def _undetermined(arrays: list[jax.Array], unknown: jax.Array) -> jax.Array:
    """Zeros (r,), of which the `unknown` (r,) have derivatives NaN, of every order.

    As those of a sine of all inputs, multiplied by something infinite: they are not 0.
    """
    return jnp.where(unknown, 0.0, 0.0)


@_undetermined.defjvp
def _undetermined_tangent(primals: Any, tangents: Any) -> tuple[jax.Array, jax.Array]:
    """Of the sine. What has a tangent or cotangent of 0 remains 0."""
    arrays, unknown = primals
    flat = jnp.concatenate([jnp.where(jnp.isfinite(x), x, 0.0).ravel() for x in arrays])
    flat = _reversed(flat)  # and an infinite cotangent becomes NaN
    slope = jnp.cos(1 + flat @ _weights(flat.size))
    some = jnp.any(unknown)
    # large, not yet NaN, on either side of the slope: its own derivative may be multiplied by 0
    total = sum(jnp.sum(_enlarged(slope * _enlarged(x, some), some)) for x in tangents[0])
    each = jnp.where(unknown, total * _weights(unknown.size), 0.0)
    return jnp.where(unknown, 0.0, 0.0), each.astype(float)


def _weights(count: int) -> np.ndarray:
    """Numbers of which no usual combination is 0."""
    return np.sqrt(np.arange(2.0, 2 + count))


def _enlarged(x: jax.Array, chosen: jax.Array) -> jax.Array:
    """x times a number so large, where `chosen`, that the second time gives infinity: NaN."""
    factor = jnp.where(chosen, float(jnp.finfo(x.dtype).max) ** LARGE, 1.0).astype(x.dtype)
    return _reversed(factor * _reversed(x))  # and so is its transpose


def _reversed(x: jax.Array) -> jax.Array:
    """-x, NaN of infinity; so is its transpose."""
    return x + (-2) * x


def sampled_states(samples: jax.Array, start: State, reached: jax.Array) -> State:
    """States of a table, NaN where they were not reached."""
    is_reached = jnp.arange(samples.shape[0] - 1, dtype=reached.dtype) < reached
    rows = nan_unless(is_reached, samples[:-1])
    return jax.vmap(lambda row: unpacked(start, row[:, None]))(rows)


def event_width(problem: MotionProblem) -> int:
    """Numbers of an event."""
    return 3 + problem.q0.size + 2 * problem.v0.size + 3 * problem.contacts + problem.tangents


def event_numbers(before: State, after: After) -> jax.Array:
    """Those of one event, in a row."""
    jump = after.jump
    parts = (before.t, before.q, before.v, jump.v, jump.impulse, jump.tangential, jump.energy)
    return ravel_pytree((parts, after.passed))[0]


def recorded_events(table: MotionTable, count: jax.Array, problem: MotionProblem) -> Events:
    """The record of events; NaN or 0 in rows that are not used."""
    used = jnp.arange(len(table.events) - 1, dtype=count.dtype) < count
    marks = jnp.where(used[:, None], table.marks[:-1], 0)
    rows = nan_unless(used, table.events[:-1])
    n, m = problem.v0.size, problem.contacts
    sizes = np.cumsum([1, problem.q0.size, n, n, m, problem.tangents, 2 * m])
    time, q, before, after, impulse, side, energy, passed = jnp.split(rows, sizes, axis=1)
    ends = marks[:, 0] == KIND_CODE["accumulation"]
    return Events(
        count=count,
        time=time[:, 0],
        kind=marks[:, 0],
        contacts=marks[:, 2:] > 0,
        q=q,
        velocity_before=before,
        velocity_after=after,
        impulse=impulse,
        tangential_impulse=side,
        energy=energy.reshape(-1, 2, m),
        status=marks[:, 1],
        accumulation_end=jnp.where(ends, time[:, 0] + passed[:, 0], jnp.nan),
        accumulation_gap=jnp.where(ends, passed[:, 1], jnp.nan),
    )
