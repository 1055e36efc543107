"""The data of a motion, the table that a run fills, and the derivatives of that.

JAX pushes tangents through the loop of a run: all that is decided (lengths of steps,
events, modes) has none. Both modes then follow from its Jacobian (`derive.py`).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from jimpact.motion.flow import Settings, State, packed, unpacked
from jimpact.motion.record import KIND_CODE, Events
from jimpact.motion.system import System
from jimpact.motion.transitions import After, tangent_count_of
from jimpact.numerics.derive import by_jacobian
from jimpact.numerics.stepper import put

# Power of the largest number that makes tangents of 1e-31 (float32) infinite the second
# time, but none below 1e3 the first time.
LARGE = 0.9


class Past(NamedTuple):
    """State of a run at its end, from which the next one goes on."""

    most: Int[Array, ""]  # events that are still allowed
    numbers: Float[Array, " size"]  # see `_pack_checkpoint`; 0 where the motion begins


class MotionProblem(NamedTuple):
    """All data of a motion between events."""

    system: System
    law: Any  # `Law` of impacts, or the `Force` of contacts that acts throughout
    mu: Float[Array, " m"] | None
    settings: Settings
    q0: Float[Array, " nq"]
    v0: Float[Array, " n"]
    times: Float[Array, " S"]  # [s] of the samples
    contacts: int  # m
    past: Past | None = None  # where the motion may go on, run after run
    # kappa of tangential springs in motions by contact forces; None: rigid sticking
    tangential_stiffness: Float[Array, " m"] | None = None

    @property
    def tangents(self) -> int:
        """Number t of tangential impulses."""
        return tangent_count_of(self.system, self.q0, self.contacts)

    @property
    def start(self) -> State:
        """State at the beginning, of rigid contacts: no work has been done."""
        q = self.q0
        dtype = q.dtype
        zero = jnp.zeros((), dtype)
        rest = jnp.zeros((2, self.contacts), dtype)
        t = self.times[0]
        return State(q, self.v0, t, zero, zero, rest, rest[:0])


class Course(NamedTuple):
    """A whole motion: states at the sampled times (NaN: not reached), events, steps,
    status.
    """

    samples: State  # of arrays with a first axis S
    events: Events
    steps: Int[Array, ""]
    status: Int[Array, ""]


class MotionTable(NamedTuple):
    """Rows of samples and events that a run fills; rows beyond those reached hold
    anything.

    The last row of each takes what is discarded, as every pass writes one.
    """

    samples: Float[Array, "S+1 rows"]  # of the state, see `flow.packed`
    events: Float[Array, "E+1 w"]  # see `event_numbers`
    marks: Int[Array, "E+1 2+m"]  # kind, status of the law, contacts that take part

    def with_event(
        self,
        numbers: Float[Array, " w"],
        marks: Int[Array, " marks"],
        row: Int[Array, ""],
    ) -> "MotionTable":
        """The table with an event in this row; see `event_numbers` and `marks`."""
        events = put(self.events, numbers, row)
        whole = jnp.int32(marks)
        new_marks = put(self.marks, whole, row)
        return self._replace(events=events, marks=new_marks)

    def with_sample(self, state: State, row: Int[Array, ""]) -> "MotionTable":
        """The table with this state as the sample of this row."""
        state_row = packed(state)[:, 0]
        samples = put(self.samples, state_row, row)
        return self._replace(samples=samples)


class MotionEnd(NamedTuple):
    """A run at its end."""

    table: MotionTable
    reached: Int[Array, ""]  # number of samples
    event_count: Int[Array, ""]
    steps: Int[Array, ""]
    status: Int[Array, ""]
    smooth: Int[Array, "2"]  # numbers of samples and events before a normal jumped
    more: Float[Array, " size"] | None  # `Past.numbers` of the next run


def differentiable(problem: Any, run: Callable[[Any], MotionEnd]) -> MotionEnd:
    """`run(problem)` with derivatives in both modes, of its samples and events.

    They are NaN in rows that the motion does not reach, or that come after a normal has
    jumped.
    """
    end: MotionEnd = by_jacobian(run, problem)

    def known(rows: Float[Array, "r w"], count: Int[Array, ""]) -> Float[Array, "r w"]:
        """Rows, of which the first `count` and the last one have derivatives, others
        NaN.
        """
        index = jnp.arange(len(rows), dtype=count.dtype)
        last = len(rows) - 1
        there = (index < count) | (index == last)
        constant = jax.lax.stop_gradient(rows)
        some = jnp.where(there[:, None], rows, constant)
        unknown = nan_derivatives(problem, there)
        return some + unknown.astype(rows.dtype)

    table = end.table
    sample_count = jnp.minimum(end.reached, end.smooth[0])
    event_count = jnp.minimum(end.event_count, end.smooth[1])
    samples = known(table.samples, sample_count)
    events = known(table.events, event_count)
    known_table = table._replace(samples=samples, events=events)
    return end._replace(table=known_table)


def empty_table(problem: MotionProblem, start: State, max_events: int) -> MotionTable:
    """Table of a motion that begins in this state, its first sample; other rows are
    0.
    """
    rows = max_events + 1
    width = event_width(problem)
    samples = no_samples(start, problem.times)
    events = jnp.zeros((rows, width), start.q.dtype)
    marks = jnp.zeros((rows, 2 + problem.contacts), jnp.int32)
    return MotionTable(samples, events, marks)


def no_samples(start: State, targets: Float[Array, " S"]) -> Float[Array, "S+1 rows"]:
    """Rows of the states at the samples, of which the first is known; the last is for
    discards.
    """
    row = packed(start)[:, 0]
    count = len(targets) + 1
    table = jnp.zeros((count, len(row)), row.dtype)
    return table.at[0].set(row)


def nan_unless(
    known: Bool[Array, " r"], rows: Float[Array, "r w"]
) -> Float[Array, "r w"]:
    """Rows, NaN where not `known`; unlike with `jnp.where`, all derivatives pass."""
    offset = jnp.where(known, 0.0, jnp.nan).astype(rows.dtype)
    return rows + offset[:, None]


def nan_derivatives(inputs: Any, known: Bool[Array, " r"]) -> Float[Array, "r 1"]:
    """Zeros; where not `known` all their derivatives by all inputs are NaN.

    A motion that has ended does not determine what would come later. In reverse mode
    what nobody differentiates (a cotangent of 0) leaves the gradient as it is.
    """
    arrays = [x for x in jax.tree.leaves(inputs) if eqx.is_inexact_array(x)]
    unknown = _undetermined(arrays, ~known)
    return unknown[:, None]


@jax.custom_jvp
def _undetermined(
    arrays: list[Float[Array, "..."]], unknown: Bool[Array, " r"]
) -> Float[Array, " r"]:
    """Zeros, of which the `unknown` have derivatives NaN, of every order.

    As those of a sine of all inputs, multiplied by something infinite: they are not 0.
    """
    return jnp.where(unknown, 0.0, 0.0)


@_undetermined.defjvp
def _undetermined_tangent(primals: Any, tangents: Any) -> tuple[jax.Array, jax.Array]:
    """Zeros and their tangents: large numbers times the cosine of all inputs, where
    unknown.

    Equation: `d = L w_i cos(1 + sum_j w_j x_j) sum_j L dx_j`, L of `_enlarged`:
    infinite or NaN unless all dx_j are 0, as are its own derivatives.
    """
    arrays, unknown = primals
    finite = [jnp.where(jnp.isfinite(x), x, 0.0).ravel() for x in arrays]
    flat = jnp.concatenate(finite)
    flat = _reversed(flat)  # and an infinite cotangent becomes NaN
    weights = _weights(flat.size)
    slope = jnp.cos(1 + flat @ weights)
    some = jnp.any(unknown)
    # large, not yet NaN, on either side of the slope: its own derivative may be
    # multiplied by 0
    large = (_enlarged(x, some) for x in tangents[0])
    parts = (_enlarged(slope * x, some) for x in large)
    total = sum(map(jnp.sum, parts))
    zero = jnp.where(unknown, 0.0, 0.0)
    derivatives = total * _weights(unknown.size)
    tangent = jnp.where(unknown, derivatives, 0.0)
    return zero, tangent.astype(float)


def _weights(count: int) -> np.ndarray:
    """Weights `sqrt(2 + j)`, of which no usual combination is 0."""
    return np.sqrt(np.arange(2.0, 2 + count))


def _enlarged(x: Float[Array, "*d"], chosen: Bool[Array, ""]) -> Float[Array, "*d"]:
    """`L x` where `chosen`, L = max^LARGE: the second time gives infinity, then NaN."""
    largest = float(jnp.finfo(x.dtype).max)
    factor = jnp.where(chosen, largest**LARGE, 1.0).astype(x.dtype)
    return _reversed(factor * _reversed(x))  # and so is its transpose


def _reversed(x: Float[Array, "*d"]) -> Float[Array, "*d"]:
    """-x, NaN of infinity; so is its transpose."""
    return x + (-2) * x


def sampled_states(
    samples: Float[Array, "table rows"], like: State, reached: Int[Array, ""]
) -> State:
    """States (S, ..) from S + 1 rows, NaN beyond the first `reached`; `like` has their
    shapes.
    """
    index = jnp.arange(samples.shape[0] - 1, dtype=reached.dtype)
    is_reached = index < reached
    rows = nan_unless(is_reached, samples[:-1])
    return jax.vmap(lambda row: unpacked(like, row[:, None]))(rows)


def event_width(problem: MotionProblem) -> int:
    """Count of the numbers of `event_numbers`: 3 + nq + 2 n + 3 m + t."""
    return (
        3
        + problem.q0.size
        + 2 * problem.v0.size
        + 3 * problem.contacts
        + problem.tangents
    )


def event_numbers(old: State, after: After) -> Float[Array, " w"]:
    """Row of an event: t, q, v-, v+, impulses (m, then t), energies (2 m), time and gap
    passed.
    """
    jump = after.jump
    velocities = (old.v, jump.v)
    impulses = (jump.impulse, jump.tangential)
    parts = (old.t, old.q, *velocities, *impulses, jump.energy)
    flat, _ = ravel_pytree((parts, after.passed))
    return flat


def recorded_events(
    table: MotionTable, count: Int[Array, ""], problem: MotionProblem
) -> Events:
    """Record of the first `count` events of a table, with the columns of
    `event_width`; NaN or 0 in rows that are not used.
    """
    # the last row of a table takes what no longer fits
    index = jnp.arange(len(table.events) - 1, dtype=count.dtype)
    used = index < count
    marks = jnp.where(used[:, None], table.marks[:-1], 0)
    rows = nan_unless(used, table.events[:-1])
    n = problem.v0.size
    m = problem.contacts
    others = (problem.q0.size, n, n, m, problem.tangents, 2 * m)
    sizes = np.cumsum([1, *others])
    parts = jnp.split(rows, sizes, axis=1)
    time, q, before, after, impulse, side, energy, accumulation = parts
    kind = marks[:, 0]
    ends = kind == KIND_CODE["accumulation"]
    duration, gap = accumulation.T
    later = time[:, 0] + duration
    return Events(
        count=count,
        time=time[:, 0],
        kind=kind,
        contacts=marks[:, 2:] > 0,
        q=q,
        velocity_before=before,
        velocity_after=after,
        impulse=impulse,
        tangential_impulse=side,
        energy=energy.reshape(-1, 2, m),  # of normal and of tangential impulses
        status=marks[:, 1],
        accumulation_end=jnp.where(ends, later, jnp.nan),
        accumulation_gap=jnp.where(ends, gap, jnp.nan),
    )
