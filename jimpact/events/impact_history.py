"""What a flow of contacts does over the time of an impact, sampled between its steps."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from jimpact.events import implicit_steps, stepper
from jimpact.events.contact_flow import ContactStates
from jimpact.events.impact_dynamics import ImplicitProgram, ImpulseProgram
from jimpact.events.reverse_mode import reversible_run, run


def history_program(outcome: ImpulseProgram, samples: int) -> "HistoryProgram":
    """The program of the samples by the method of the outcome."""
    if isinstance(outcome, ImplicitProgram):
        return ImplicitHistoryProgram(outcome, samples)
    return HistoryProgram(outcome, samples)


@dataclasses.dataclass(frozen=True)
class HistoryProgram:
    """From the leaves of a `Problem` in columns to rows of samples (s, .., B) in time.

    Results: the times (s, 1, B), twice the energy (s, m, B), the rows of `ContactStates`, the
    largest force of each contact (m, B), the status (1, B) as a floating-point number.
    """

    outcome: ImpulseProgram  # `whole`: no closed form ends it
    samples: int
    reverses: bool = False  # in a form that has a reverse mode

    def reversible(self) -> "HistoryProgram":
        """The same in a form that the reverse mode goes through, too."""
        return dataclasses.replace(self, reverses=True)

    def __call__(self, *leaves: jax.Array) -> tuple[jax.Array, ...]:
        """The results from the leaves of a problem; see the class."""
        problem = jax.tree.unflatten(self.outcome.tree, leaves)
        flow, modes, y = self.outcome.flow(problem, 1.0)
        gamma, most = problem.gamma, self.outcome.most
        way = reversible_run if self.reverses else run
        (end, found), (ended, places) = way(flow, gamma, modes, y, most, self.samples)
        ended, places = jax.lax.stop_gradient((ended, places))
        no_target = jnp.zeros(ended.carry.step.target.shape, bool)

        def at(sample: Any) -> tuple[jax.Array, jax.Array, ContactStates]:
            """A sample is one more step, in time, from the state before it."""
            part, state, now, clock = sample
            rate = flow.contact_states(now, state).rate
            since = part * end[-1:] - state[-1:]
            ahead = jnp.where(rate > 0, since / jnp.where(rate > 0, rate, 1.0), 0.0)
            state = stepper.between(flow, stepper.Step(now, no_target, clock), state, ahead)
            sample = flow.contact_states(now, state)
            x = jnp.maximum(sample.indentation, 0.0)
            return state[-1:], flow.energy(x, jnp.zeros_like(x)), sample._replace(indentation=x)

        parts = jnp.linspace(0.0, 1.0, self.samples, dtype=y.dtype)
        samples = parts, found.states, places.modes, places.clock
        time, energy, states_at = jax.lax.map(at, samples)
        return time, energy, *states_at, found.force, ended.status.astype(y.dtype)


@dataclasses.dataclass(frozen=True)
class ImplicitHistoryProgram(HistoryProgram):
    """As `HistoryProgram`, of the steps of method 'implicit'.

    Tangential forces are the means of the steps that the samples are in.
    """

    outcome: ImplicitProgram

    def reversible(self) -> "ImplicitHistoryProgram":
        """Itself."""
        return self

    def __call__(self, *leaves: jax.Array) -> tuple[jax.Array, ...]:
        """The results from the leaves of a problem; see `HistoryProgram`."""
        problem = jax.tree.unflatten(self.outcome.tree, leaves)
        flow, start = self.outcome.steps(jax.lax.stop_gradient(problem))
        run = implicit_steps.to_the_end(flow, start, self.outcome.most, keeps=True)
        assert run.plan is not None
        flow, start = self.outcome.steps(problem)
        states, m = implicit_steps.path(flow, start, run.plan), flow.contacts
        times = states.time  # (steps + 1, 1, B)

        def at(part: jax.Array) -> tuple[jax.Array, jax.Array, ContactStates]:
            """A sample is one more step from the state before it."""
            t = part * times[-1]
            reached = times <= jax.lax.stop_gradient(t)[None]
            before = jnp.sum(reached.astype(jnp.int32), axis=0) - 1

            def of(rows: jax.Array) -> jax.Array:
                """Rows of the state before the sample."""
                return jnp.take_along_axis(rows, before[None], axis=0)[0]

            state = jax.tree.map(of, states)
            s = implicit_steps.between(flow, state, t - state.time)
            x, gamma = jnp.maximum(s.indentation, 0.0), s.velocity[:m]
            sample = ContactStates(
                force=flow.force_of(x, gamma),
                indentation=x,
                impulse=s.impulse[:m],
                gap_velocity=gamma,
                tangential_force=s.rate[m:],
                tangential_impulse=s.impulse[m:],
                slip=s.velocity[m:],
                rate=jnp.ones_like(s.time),
            )
            return s.time, flow.energy(x), sample

        parts = jnp.linspace(0.0, 1.0, self.samples, dtype=times.dtype)
        time, energy, states_at = jax.lax.map(at, parts)
        force = jax.vmap(flow.force_of)(states.indentation, states.velocity[:, :m])
        code = self.outcome.code(flow, run).astype(times.dtype)
        return time, energy, *states_at, jnp.max(force, axis=0), code
