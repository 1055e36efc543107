"""Forces and motion of contacts over the time of an impact, sampled between the steps
of a flow.

A first run tells how long the impact takes. A second one keeps, for each sample, the
state before the step that contains it; the sample is one more step from there.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped

from jimpact.events import implicit_steps
from jimpact.events.contact_flow import ContactStates
from jimpact.events.impact_dynamics import ImplicitProgram, ImpulseProgram
from jimpact.events.implicit_steps import ImplicitState
from jimpact.events.run import run
from jimpact.events.wedged_limit import inspect
from jimpact.numerics import stepper


def history_program(outcome: ImpulseProgram, samples: int) -> "HistoryProgram":
    """The program of the samples by the method of the outcome."""
    if isinstance(outcome, ImplicitProgram):
        return ImplicitHistoryProgram(outcome, samples)
    return HistoryProgram(outcome, samples)


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

    def fractions(self, dtype: Any) -> Float[Array, " s"]:
        """Times of the samples over the duration, from 0 to 1."""
        return jnp.linspace(0.0, 1.0, self.samples, dtype=dtype)

    def __call__(self, *leaves: jax.Array) -> tuple[jax.Array, ...]:
        """The results from the leaves of a problem; see the class."""
        problem = jax.tree.unflatten(self.outcome.tree, leaves)
        flow, modes, y = self.outcome.flow(problem, 1.0)
        gamma = problem.gamma
        most = self.outcome.most
        checkpoints = self.outcome.checkpoints
        constant = jax.lax.stop_gradient((flow, gamma, modes, y))
        duration = run(*constant, most, inspect, checkpoints).reached[-1:]
        t = (
            self.fractions(y.dtype)[:, None, None]
            * jax.lax.stop_gradient(duration)[None]
        )

        def observe(
            seen: Seen, now: stepper.StepperState, accept: Bool[Array, "1 B"]
        ) -> Seen:
            """The steps that may contain samples, this one included, and the largest
            forces.
            """
            force = flow.contact_states(now.step.modes, now.y).force
            may_hold_sample = accept[None] & (now.y[None, -1:] <= t)
            return Seen(
                jnp.where(may_hold_sample, now.y[None], seen.states),
                jnp.where(may_hold_sample, now.step.modes[None], seen.modes),
                jnp.where(may_hold_sample, now.step.clock[None], seen.clock),
                jnp.where(accept & (force > seen.force), force, seen.force),
            )

        first = flow.contact_states(modes, y).force
        clock = jnp.zeros((4, *y.shape[1:]), y.dtype)
        seen = Seen(
            self.one_per_sample(y),
            self.one_per_sample(modes),
            self.one_per_sample(clock),
            first,
        )
        end = run(flow, gamma, modes, y, most, inspect, checkpoints, observe, seen)
        last = flow.contact_states(end.carry.step.modes, end.reached).force
        no_target = jnp.zeros(end.carry.step.target.shape, bool)

        def at(
            sample: Any,
        ) -> tuple[Float[Array, "1 B"], Float[Array, "m B"], ContactStates]:
            """Time, twice the energy and contact states of a sample, by one more
            step.
            """
            part, state, now, clock = sample
            rate = flow.contact_states(now, state).rate
            since = part * end.reached[-1:] - state[-1:]
            ahead = jnp.where(rate > 0, since / jnp.where(rate > 0, rate, 1.0), 0.0)
            state = stepper.between(
                flow, stepper.Step(now, no_target, clock), state, ahead
            )
            sample = flow.contact_states(now, state)
            x = jnp.maximum(sample.indentation, 0.0)
            return (
                state[-1:],
                flow.energy(x, jnp.zeros_like(x)),
                sample._replace(indentation=x),
            )

        over = t >= end.reached[None, -1:]
        states = jnp.where(over, end.reached[None], end.seen.states)
        now = jnp.where(over, end.carry.step.modes[None], end.seen.modes)
        clock = jnp.where(over, 0.0, end.seen.clock)
        rows = self.fractions(y.dtype), states, now, clock
        time, energy, states_at = jax.lax.map(at, rows)
        force = jnp.where(last > end.seen.force, last, end.seen.force)
        return time, energy, *states_at, force, end.status.astype(y.dtype)


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
        flow, start = outcome.steps(jax.tree.unflatten(outcome.tree, leaves))
        m = flow.contacts
        most = outcome.most
        checkpoints = outcome.checkpoints
        constant = jax.lax.stop_gradient((flow, start))
        duration = implicit_steps.run(*constant, most, checkpoints).state.time
        # it only chooses the step of a sample; the time in the step is that of the
        # second run
        t = (
            self.fractions(duration.dtype)[:, None, None]
            * jax.lax.stop_gradient(duration)[None]
        )

        def force(s: ImplicitState) -> Float[Array, "m B"]:
            """Normal forces in a state."""
            return flow.force_of(s.indentation, s.velocity[:m])

        def observe(
            seen: Any, before: ImplicitState, accept: Bool[Array, "1 B"]
        ) -> Any:
            """The last state before each sample, and the largest forces, up to this
            step.
            """
            states, largest = seen
            earlier = accept[None] & (before.time[None] <= t)
            kept = jax.tree.map(
                lambda a, b: jnp.where(earlier, a[None], b), before, states
            )
            return kept, jnp.where(accept, jnp.maximum(force(before), largest), largest)

        seen = jax.tree.map(self.one_per_sample, start), force(start)
        run = implicit_steps.run(flow, start, most, checkpoints, observe, seen)
        states, largest = run.seen

        def at(
            sample: Any,
        ) -> tuple[Float[Array, "1 B"], Float[Array, "m B"], ContactStates]:
            """Time, twice the energy and contact states of a sample, by one more
            step.
            """
            fraction, before = sample
            ahead = fraction * run.state.time - before.time
            s = implicit_steps.between(flow, before, ahead)
            x = jnp.maximum(s.indentation, 0.0)
            gamma = s.velocity[:m]
            sample = ContactStates(
                force=flow.force_of(x, gamma),
                indentation=x,
                impulse=s.impulse[:m],
                gap_velocity=gamma,
                tangential_force=s.rate[m:],
                tangential_impulse=s.impulse[m:],
                slip=s.velocity[m:],
                tangential_energy=s.velocity[:0],
                # of time: these steps advance in time itself
                rate=jnp.ones_like(s.time),
            )
            return s.time, flow.energy(x), sample

        time, energy, states_at = jax.lax.map(at, (self.fractions(t.dtype), states))
        code = outcome.code(flow, run).astype(t.dtype)
        return time, energy, *states_at, jnp.maximum(largest, force(run.state)), code
