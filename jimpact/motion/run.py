"""The loop of every motion in flights, by events and by contact forces: when it ends,
and how.
"""

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jimpact.motion.dynamics import free_acceleration, gaps, mass_at, user_force
from jimpact.motion.flow import Flight, State, out_of_range
from jimpact.motion.system import System
from jimpact.motion.tables import (
    Course,
    MotionEnd,
    MotionProblem,
    MotionTable,
    differentiable,
    recorded_events,
    sampled_states,
)
from jimpact.tools.status import CODE

# M is singular where its scaled least eigenvalue is below this share of that at the
# start
_SINGULAR = 1e-6
AHEAD = 1e-13  # of the duration: some hundred times the least step of a flight


@runtime_checkable
class MotionRun(Protocol):
    """A motion up to now; by events and by contact forces it remembers other things
    besides.
    """

    @property
    def flight(self) -> Flight:
        """State, next step and number of samples reached."""

    @property
    def table(self) -> MotionTable:
        """Samples and events so far."""

    @property
    def event_count(self) -> Int[Array, ""]:
        """Number of events so far."""

    @property
    def status(self) -> Int[Array, ""]:
        """Status code; `ok` while the motion goes on."""


def goes_on(problem: MotionProblem, run: MotionRun) -> Bool[Array, ""]:
    """True while the status is ok, steps do not vanish, and a sample is left."""
    flight = run.flight
    reached = flight.sample >= problem.times.shape[0]
    return (run.status == CODE["ok"]) & ~flight.stuck & ~reached


def end_of(
    problem: MotionProblem,
    run: MotionRun,
    smooth: Int[Array, "2"],
    more: Float[Array, " size"] | None = None,
) -> MotionEnd:
    """End of a run: its table and counts, and its status, `why_stuck` where steps
    vanished.

    `smooth`: numbers of samples and events before a normal jumped; `more`: see
    `MotionEnd`.
    """
    flight = run.flight
    stuck = flight.stuck & (run.status == CODE["ok"])
    why = why_stuck(problem.system, flight, problem.q0, problem.times)
    code = jnp.where(stuck, why, run.status)
    status = code.astype(jnp.int32)
    counts = (flight.sample, run.event_count, flight.steps)
    return MotionEnd(run.table, *counts, status, smooth, more)


def course_of(
    problem: MotionProblem, start: State, run: Callable[[MotionProblem], MotionEnd]
) -> tuple[Course, Float[Array, " size"] | None]:
    """Samples, events and status of `run(problem)`, with both derivatives; and
    `MotionEnd.more`.

    `start`: the state at the beginning, for the shapes of samples.
    """
    end = differentiable(problem, run)
    samples = sampled_states(end.table.samples, start, end.reached)
    events = recorded_events(end.table, end.event_count, problem)
    return Course(samples, events, end.steps, end.status), end.more


def why_stuck(
    system: System, flight: Flight, q0: Float[Array, " nq"], times: Float[Array, " S"]
) -> Int[Array, ""]:
    """Status code of a motion whose steps vanish or are too many.

    `not_finite` or `out_of_range` a little AHEAD of its state, `singular_mass` where
    the least eigenvalue of M, scaled by the diagonal at the start, has fallen below
    _SINGULAR; else `max_steps`.
    """
    state, q0, times = jax.lax.stop_gradient((flight.state, q0, times))
    # where steps vanish before something that is not a number, it is a few roundings
    # ahead
    ahead = AHEAD * (times[-1] - times[0])
    q = system.body.moved(state.q, ahead * state.v)
    t = state.t + ahead
    force = user_force(system, q, state.v, t)
    mass = mass_at(system, q)
    rates = free_acceleration(system, q, state.v, force, mass)
    parts = (state.q, state.v, rates, gaps(system, q, t))
    finite = jnp.all(jnp.isfinite(jnp.concatenate(parts)))
    code = jnp.where(finite, CODE["max_steps"], CODE["not_finite"])
    code = jnp.where(out_of_range(system, state), CODE["out_of_range"], code)
    if not callable(system.mass):
        return code
    begin, now = (jax.lax.stop_gradient(mass_at(system, q)) for q in (q0, state.q))
    if begin.ndim == 1:
        smallest = jnp.min(now / begin)
    else:
        scale = 1 / jnp.sqrt(jnp.diagonal(begin))
        scaled = now * scale[:, None] * scale[None, :]
        smallest = jnp.linalg.eigvalsh(scaled)[0]
    return jnp.where(~(smallest > _SINGULAR), CODE["singular_mass"], code)
