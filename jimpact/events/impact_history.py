"""What a flow of contacts does over the time of an impact, sampled between its steps."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from jimpact.events import stepper
from jimpact.events.contact_flow import ContactStates
from jimpact.events.impact_dynamics import ImpulseProgram
from jimpact.events.reverse_mode import reversible_run, run


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
