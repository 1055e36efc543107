"""Runs of an impact with a reverse mode: each step's transposed derivative, the last one first.

A run gives the state that it reaches and, where a history is wanted, samples: the states before
the steps that contain equally spaced times, and the largest forces.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero

from jimpact.events.kept_steps import KeptStep, backwards
from jimpact.events.plastic_limit import ImpactEnd, to_the_end
from jimpact.events.stepper import Flow, Step, step_again


class Samples(NamedTuple):
    """States (s, n, B) before the steps to the times of samples, and largest forces (m, B)."""

    states: jax.Array
    force: jax.Array


class Places(NamedTuple):
    """Where samples are taken."""

    number: jax.Array  # (s, 1, B) of the step, or END
    modes: jax.Array  # (s, .., B)
    clock: jax.Array  # (s, 4, B) zeros at the end
    strongest: jax.Array  # (m, B) number of the step that begins with the largest force, or END


END = -1  # number of a step where the last state is meant


def run(
    flow: Any, gamma: jax.Array, modes: jax.Array, y: jax.Array, most: int, samples: int
) -> tuple[tuple[jax.Array, Any], tuple[ImpactEnd, Any]]:
    """State (n, B) that `to_the_end` reaches, not yet finished, and `Samples`, with derivatives;
    the end and the `Places` of samples, for values. `samples` 0: None of both."""
    end = to_the_end(flow, gamma, modes, y, most, keeps=True)
    found, places = _samples(flow, end, most, samples) if samples else (None, None)
    return (end.reached, found), (end, places)


def _samples(flow: Any, end: ImpactEnd, most: int, samples: int) -> tuple[Samples, Places]:
    """What a sample needs of the last step that begins before it."""
    y, modes, clock = end.reached, end.carry.step.modes, end.carry.step.clock

    def rows(x: jax.Array) -> jax.Array:
        """x (k, B) in each sample."""
        return jnp.broadcast_to(x, (samples, *x.shape))

    parts = jnp.linspace(0.0, 1.0, samples, dtype=y.dtype)[:, None, None]
    t = jax.lax.stop_gradient(parts * y[None, -1:])
    force = flow.contact_states(modes, y).force
    ends = jnp.full((samples, 1, y.shape[-1]), END, jnp.int32)
    last = Places(
        ends, rows(modes), rows(jnp.zeros_like(clock)), jnp.full(force.shape, END, jnp.int32)
    )
    start = Samples(rows(y), force), last, t >= y[None, -1:]

    def visit(so_far: Any, kept: KeptStep) -> Any:
        """With this step where a sample has none yet, and none behind it does."""
        (states, force), (number, modes, clock, strongest), known = so_far
        now = flow.contact_states(kept.step.modes, kept.y).force
        stronger = kept.accepted & (now > force)
        fits = kept.accepted[None] & ~known & (kept.y[None, -1:] <= t)
        found = Samples(jnp.where(fits, kept.y[None], states), jnp.where(stronger, now, force))
        places = Places(
            jnp.where(fits, kept.number, number),
            jnp.where(fits, kept.step.modes[None], modes),
            jnp.where(fits, kept.step.clock[None], clock),
            jnp.where(stronger, kept.number, strongest),
        )
        return found, places, known | fits

    assert end.kept is not None
    found, places, _ = backwards(flow, end.carry, end.kept, most, visit, start)
    return found, places


reversible_run = jax.custom_vjp(run, nondiff_argnums=(4, 5))


def _forward(flow: Any, gamma: Any, modes: Any, y: Any, most: int, samples: int) -> tuple[Any, Any]:
    """The run, and what its transpose needs: the parts of the flow with derivatives, and others."""
    moving = jax.tree.map(lambda x: x.value if x.perturbed else None, flow)
    fixed = jax.tree.map(lambda x: None if x.perturbed else x.value, flow)
    whole = eqx.combine(moving, fixed)
    results, (end, places) = run(whole, gamma.value, modes.value, y.value, most, samples)
    return (results, (end, places)), (moving, fixed, end, places)


def _transpose(most: int, samples: int, residual: Any, cotangents: Any) -> tuple[Any, ...]:
    """Cotangents of the flow and of the first state."""
    moving, fixed, end, places = residual
    wanted = jax.tree.map(_filled, cotangents[0], is_leaf=_is_zero)
    (reached, found), flow = wanted, eqx.combine(moving, fixed)

    def of_sample(moving: Any, modes: jax.Array, y: jax.Array) -> Any:
        """What samples see of a state."""
        return y, eqx.combine(moving, fixed).contact_states(modes, y).force

    def seen_by(number: Any) -> Any:
        """Cotangents of what samples see of this state."""
        states = jnp.where(places.number == number, found.states, 0.0)
        return jnp.sum(states, axis=0), jnp.where(places.strongest == number, found.force, 0.0)

    def visit(so_far: Any, kept: KeptStep) -> Any:
        """The cotangents before a step, from those after it."""
        sums, after = so_far

        def step(moving: Any, y: jax.Array) -> Any:
            """The state after it, and what samples see of the state before it."""
            seen = of_sample(moving, kept.step.modes, y) if samples else ()
            return _state_after(eqx.combine(moving, fixed), kept, y), seen

        seen = seen_by(kept.number) if samples else ()
        change, before = jax.vjp(step, moving, kept.y)[1]((after, seen))
        return jax.tree.map(jnp.add, sums, change), before

    start = jax.tree.map(jnp.zeros_like, moving), reached
    if samples:
        modes = end.carry.step.modes
        _, back = jax.vjp(lambda moving, y: of_sample(moving, modes, y), moving, end.reached)
        sums, before = back(seen_by(END))
        start = sums, reached + before
    sums, y = backwards(flow, end.carry, end.kept, most, visit, start)
    return sums, None, None, y


def _is_zero(x: Any) -> bool:
    """Whether x is a cotangent that is known to be 0."""
    return isinstance(x, SymbolicZero)


def _filled(x: Any) -> jax.Array:
    """A cotangent as an array."""
    return jnp.zeros(x.shape, x.dtype) if _is_zero(x) else x


def _state_after(flow: Flow, kept: KeptStep, y: jax.Array) -> jax.Array:
    """The state after a step of a run, as a smooth function of `flow` and of the state before."""
    s: Step = kept.step
    end = flow.switch(s.modes, step_again(flow, s, y), s.target)[1]
    return jnp.where(kept.accepted, end, y)


reversible_run.defvjp(_forward, _transpose, symbolic_zeros=True)
