"""Forces and motion of contacts over the time of an impact, sampled between the steps
of a flow.

A first run tells how long the impact takes. A second one keeps, for each sample, the
state before the step that contains it; the sample is one more step from there.
"""

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped

from jimpact.events import implicit_steps
from jimpact.events.contact_flow import ContactFlow, ContactStates
from jimpact.events.impact_dynamics import ImplicitProgram, ImpulseProgram
from jimpact.events.implicit_steps import ImplicitState, ImplicitSteps
from jimpact.events.run import ImpactEnd, run
from jimpact.events.wedged_limit import inspect
from jimpact.numerics import stepper
from jimpact.tools.masks import quotient


def history_program(outcome: ImpulseProgram, samples: int) -> "HistoryProgram":
    """The program of the samples by the method of the outcome."""
    if isinstance(outcome, ImplicitProgram):
        return ImplicitHistoryProgram(outcome, samples)
    return HistoryProgram(outcome, samples)


def time_of(y: Float[Array, "n B"]) -> Float[Array, "1 B"]:
    """The time of a state, its last row."""
    return y[-1:]


class Seen(NamedTuple):
    """The step that contains each sample, as far as seen: state and modes before it,
    its clock.
    """

    states: Float[Array, "s n B"]
    modes: Int[Array, "s modes B"]
    clock: Float[Array, "s 4 B"]
    force: Float[Array, "m B"]  # the largest so far


@dataclasses.dataclass(frozen=True)
class HistoryProgram:
    """Samples (s, .., B) in time, from the leaves of a `Problem` with a batch in the
    last axis.

    Results: the times (s, 1, B), twice the energy (s, m, B), the rows of
    `ContactStates`, the largest force of each contact (m, B), the status (1, B) as a
    floating-point number.
    """

    outcome: ImpulseProgram  # `with_end_time`: no closed form ends it
    samples: int

    def one_per_sample(self, x: Shaped[Array, "rows B"]) -> Shaped[Array, "s rows B"]:
        """x, once for each sample."""
        return jnp.broadcast_to(x, (self.samples, *x.shape))

    def times(self, duration: Float[Array, "1 B"]) -> Float[Array, "s 1 B"]:
        """Times of the samples, which only choose the step of each: no tangents."""
        fraction = self.fractions(duration.dtype)[:, None, None]
        return fraction * jax.lax.stop_gradient(duration)[None]

    def fractions(self, dtype: Any) -> Float[Array, " s"]:
        """Times of the samples over the duration, from 0 to 1."""
        return jnp.linspace(0.0, 1.0, self.samples, dtype=dtype)

    def __call__(self, *leaves: jax.Array) -> tuple[jax.Array, ...]:
        """The results from the leaves of a problem; see the class.

        A first run finds the duration, without tangents: the times of the samples only
        choose their steps. A second one keeps for each sample the step that contains
        it, and the largest forces. Samples at the end are the state reached there.
        """
        problem = jax.tree.unflatten(self.outcome.tree, leaves)
        flow, modes, y = self.outcome.flow(problem, with_slopes=False)
        gamma = problem.gamma
        max_passes = self.outcome.max_passes
        checkpoints = self.outcome.checkpoints
        constant = jax.lax.stop_gradient((flow, gamma, modes, y))
        duration = time_of(run(*constant, max_passes, inspect, checkpoints).reached)
        t = self.times(duration)

        def observe(
            seen: Seen, now: stepper.StepperState, accept: Bool[Array, "1 B"]
        ) -> Seen:
            """The steps that may contain samples, this one included, and the largest
            forces.
            """
            force = flow.contact_states(now.step.modes, now.y).force
            may_hold_sample = accept[None] & (time_of(now.y)[None] <= t)
            return Seen(
                jnp.where(may_hold_sample, now.y[None], seen.states),
                jnp.where(may_hold_sample, now.step.modes[None], seen.modes),
                jnp.where(may_hold_sample, now.step.clock[None], seen.clock),
                jnp.where(accept & (force > seen.force), force, seen.force),
            )

        first = flow.contact_states(modes, y).force
        clock = jnp.zeros((len(stepper.Clock), *y.shape[1:]), y.dtype)
        seen = Seen(
            self.one_per_sample(y),
            self.one_per_sample(modes),
            self.one_per_sample(clock),
            first,
        )
        end = run(
            flow, gamma, modes, y, max_passes, inspect, checkpoints, observe, seen
        )
        last = flow.contact_states(end.carry.step.modes, end.reached).force
        over = t >= time_of(end.reached)[None]
        samples = Sample(
            fraction=self.fractions(y.dtype),
            begin=jnp.where(over, end.reached[None], end.seen.states),
            modes=jnp.where(over, end.carry.step.modes[None], end.seen.modes),
            clock=jnp.where(over, 0.0, end.seen.clock),
        )
        time, energy, contacts = jax.lax.map(partial(_sampled, flow, end), samples)
        is_last = last > end.seen.force
        force = jnp.where(is_last, last, end.seen.force)
        return time, energy, *contacts, force, end.status.astype(y.dtype)


class Sample(NamedTuple):
    """Where a sample lies: its time over the duration; state, modes and clock of the
    step that contains it, at the beginning of that step. Or s of them.
    """

    fraction: Float[Array, "*s"]
    begin: Float[Array, "*s n B"]
    modes: Int[Array, "*s modes B"]
    clock: Float[Array, "*s clock B"]


def _sampled(
    flow: ContactFlow, end: ImpactEnd, sample: Sample
) -> tuple[Float[Array, "1 B"], Float[Array, "m B"], ContactStates]:
    """Time, twice the energy of the springs, and contact states of a sample, by one
    more step.

    The step goes `ahead` in the flow's own time. Indentations of open contacts are 0.
    """
    fraction, begin, modes, clock = sample
    since = fraction * time_of(end.reached) - time_of(begin)
    rate = flow.contact_states(modes, begin).rate
    ahead = quotient(since, rate, where=rate > 0)
    no_target = jnp.zeros(end.carry.step.target.shape, bool)
    step = stepper.Step(modes, no_target, clock)
    state = stepper.between(flow, step, begin, ahead)
    contacts = flow.contact_states(modes, state)
    x = jnp.maximum(contacts.indentation, 0.0)
    energy = flow.energy(x, g=jnp.zeros_like(x))  # without the kinetic one
    return time_of(state), energy, contacts._replace(indentation=x)


@dataclasses.dataclass(frozen=True)
class ImplicitHistoryProgram(HistoryProgram):
    """Samples as those of `HistoryProgram`, of the steps of method 'implicit'.

    Tangential forces are the means of the steps that the samples are in.
    """

    outcome: ImplicitProgram

    def __call__(self, *leaves: jax.Array) -> tuple[jax.Array, ...]:
        """Times, energies, the rows of `ContactStates`, largest forces, status.

        A first run finds the duration T. A second one keeps for each sample the last
        state before its time `fraction T`, from which one more step leads to it, and
        the largest forces.
        """
        outcome = self.outcome
        problem = jax.tree.unflatten(outcome.tree, leaves)
        flow, start = outcome.steps(problem)
        max_passes = outcome.max_passes
        checkpoints = outcome.checkpoints
        constant = jax.lax.stop_gradient((flow, start))
        duration = implicit_steps.run(*constant, max_passes, checkpoints).state.time
        t = self.times(duration)

        def observe(
            seen: _ImplicitSeen, now: ImplicitState, accept: Bool[Array, "1 B"]
        ) -> _ImplicitSeen:
            """The last state before each sample, and the largest forces, up to this
            step.
            """
            earlier = accept[None] & (now.time[None] <= t)
            states = jax.tree.map(
                lambda new, old: jnp.where(earlier, new[None], old), now, seen.states
            )
            larger = jnp.maximum(force_in(flow, now), seen.force)
            return _ImplicitSeen(states, jnp.where(accept, larger, seen.force))

        states = jax.tree.map(self.one_per_sample, start)
        seen = _ImplicitSeen(states, force_in(flow, start))
        run = implicit_steps.run(flow, start, max_passes, checkpoints, observe, seen)

        def sampled(
            sample: tuple[jax.Array, ImplicitState],
        ) -> tuple[Float[Array, "1 B"], Float[Array, "m B"], ContactStates]:
            """Time, twice the energy and contact states of a sample."""
            fraction, state = sample
            ahead = fraction * run.state.time - state.time
            s = implicit_steps.between(flow, state, ahead)
            contacts = contact_states(flow, s)
            return s.time, flow.energy(contacts.indentation), contacts

        samples = self.fractions(t.dtype), run.seen.states
        time, energy, contacts = jax.lax.map(sampled, samples)
        last = force_in(flow, run.state)
        force = jnp.maximum(run.seen.force, last)
        code = outcome.code(flow, run).astype(t.dtype)
        return time, energy, *contacts, force, code


class _ImplicitSeen(NamedTuple):
    """The last state before each sample (s, .., B), and the largest forces so far."""

    states: ImplicitState
    force: Float[Array, "m B"]


def force_in(flow: ImplicitSteps, s: ImplicitState) -> Float[Array, "m B"]:
    """Normal forces in a state."""
    gamma, _ = flow.parts(s.velocity)
    return flow.force_of(s.indentation, gamma)


def contact_states(flow: ImplicitSteps, s: ImplicitState) -> ContactStates:
    """The contacts in a state; of indentations below 0, gaps, those at 0."""
    x = jnp.maximum(s.indentation, 0.0)
    gamma, slip = flow.parts(s.velocity)
    p, p_t = flow.parts(s.impulse)
    _, tangential_force = flow.parts(s.rate)
    return ContactStates(
        force=flow.force_of(x, gamma),
        indentation=x,
        impulse=p,
        gap_velocity=gamma,
        tangential_force=tangential_force,
        tangential_impulse=p_t,
        slip=slip,
        tangential_energy=s.velocity[:0],
        # of time: these steps advance in time itself
        rate=jnp.ones_like(s.time),
    )
