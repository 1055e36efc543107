"""The loop of every impact: a flow is advanced step by step, from event to event, to
its end.

FLOW    contacts without or with friction (`contact_flow.py`, `friction_flow.py`,
        `slip.py`)
STEP    `numerics/stepper.py` tries one, which ends at an event if one lies within it
PAUSE   where a flow asks for it, `inspect` judges whether the impact will come to rest
        by itself (`plastic_limit.py`), and ends it there
END     all contacts are open and none approaches: the flow finishes the state in closed
        form
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jimpact.numerics import stepper
from jimpact.numerics.driver import SLOTS_WITH_TANGENTS, until_over
from jimpact.numerics.stepper import Mark, any_of
from jimpact.numerics.tangents import dual_like, is_dual, pushforward, value_of
from jimpact.tools.loops import cond
from jimpact.tools.status import CODE


class Rest(NamedTuple):
    """Contacts that come to rest, and the state of the impact at its last
    inspection.
    """

    contacts: Bool[Array, "m B"]  # whose closings have no end
    carries: Bool[Array, "m B"]  # those of them that carry an impulse
    gamma: Float[Array, "m B"]
    root: Float[Array, "m B"]  # of twice the energy stored
    impulse: Float[Array, "m B"]  # dp, which takes what is left of the approach
    closings: Int[Array, "m B"]
    ended: Bool[Array, "1 B"]  # by a state that returned as a part of itself
    # of contacts that friction may wedge: see `wedged_limit.py`
    cycle: Any = None

    @classmethod
    def none(cls, gamma: Float[Array, "m B"], modes: Int[Array, "modes B"]) -> "Rest":
        """The state before the first inspection: no contact is at rest."""
        no = jnp.zeros(gamma.shape, bool)
        zero = jnp.zeros_like(gamma)
        return cls(
            contacts=no,
            carries=no,
            gamma=zero,
            root=zero,
            impulse=zero,
            closings=jnp.zeros(gamma.shape, modes.dtype),
            ended=jnp.zeros((1, *gamma.shape[1:]), bool),
        )


class ImpactEnd(NamedTuple):
    """An impact at its end, finished but for the impulse of the contacts at rest."""

    carry: stepper.StepperState
    reached: Any  # the state (n, B) before it was finished
    rest: Rest
    seen: Any  # what its steps showed

    @property
    def carries(self) -> Bool[Array, "m B"]:
        """Mask of the contacts at rest that carry an impulse."""
        return self.rest.carries & self.rest.contacts

    @property
    def impulse(self) -> Float[Array, "m B"]:
        """Impulses of the contacts at rest that end their approach."""
        return jnp.where(self.carries, self.rest.impulse, 0.0)

    @property
    def over(self) -> Bool[Array, "1 B"]:
        """Mask of the impacts that have ended, not given up."""
        return self.carry.mark == Mark.OVER

    @property
    def finishes(self) -> Bool[Array, "1 B"]:
        """Mask of the impacts that the flow itself has ended."""
        return self.over & ~self.rest.ended

    @property
    def status(self) -> Int[Array, "1 B"]:
        """Status of the run: plastic_limit, ok, or max_steps where it is not over."""
        rests = any_of(self.rest.contacts)
        code = jnp.where(rests, CODE["plastic_limit"], CODE["ok"])
        code_if_over = jnp.where(self.over, code, CODE["max_steps"])
        return code_if_over.astype(jnp.int32)


class _OnItsWay(NamedTuple):
    """An impact on its way: state of the stepper, contacts at rest, what `observe` has
    kept.
    """

    carry: stepper.StepperState
    rest: Rest
    seen: Any


# of flow, gamma, state, rest, which impacts (1, B), whether at the end: see
# `plastic_limit.inspect`
Inspect = Callable[..., Rest]
Observe = Callable[[Any, stepper.StepperState, jax.Array], Any]


def run(
    flow: Any,
    gamma: Float[Array, "m B"],
    modes: Int[Array, "modes B"],
    y: Any,
    max_passes: int,
    inspect: Inspect,
    checkpoints: bool = False,
    observe: Observe | None = None,
    seen: Any = None,
) -> ImpactEnd:
    """The impact from gap velocities gamma to its end, in at most so many passes.

    Parts of `flow` and y that have tangents (see `tangents.py`) give a state with
    tangents. On a CPU at most `slots` impacts of the batch are advanced at once, fewer
    with tangents, and others wait; with `observe` all are.

    Args:
        flow: the contacts, with the batch B of impacts in the last axis of its arrays.
        gamma: gap velocities before the impact.
        modes: of the contacts at first.
        y: the state at first (n, B).
        max_passes: passes after which it is given up.
        inspect: asked where a self-similar flow pauses, and at the end of each.
        checkpoints: the loop has a reverse mode, and no forward mode.
        observe: `observe(seen, state, accept)` follows the states before each step, and
            which impacts (1, B) accept it.
        seen: what `observe` begins with.
    """

    def one_pass(constant: tuple[Any, jax.Array], now: _OnItsWay) -> _OnItsWay:
        """The impact after one step tried; impacts that pause are inspected."""
        flow, gamma = constant
        carry, accept = stepper.advance(flow, now.carry, max_passes)
        if observe is not None:
            new_seen = observe(now.seen, now.carry, accept)
            now = now._replace(seen=new_seen)
        if not value_of(flow).self_similar:
            return now._replace(carry=carry)
        paused = carry.mark == Mark.PAUSED
        rest = inspect(flow, gamma, carry, now.rest, paused, at_end=False)
        settled = jnp.where(rest.ended, Mark.OVER, Mark.GOES_ON)
        return _OnItsWay(carry.marked(paused, settled), rest, now.seen)

    cycle = value_of(flow).first_cycle(gamma, modes)
    rest = Rest.none(gamma, modes)._replace(cycle=cycle)
    start = _OnItsWay(stepper.begin(flow, modes, y), rest, seen)
    slots = value_of(flow).slots
    if is_dual(y):
        slots = min(slots, SLOTS_WITH_TANGENTS)
    if observe is not None:
        slots = None  # all impacts side by side

    def goes_on(_: Any, now: _OnItsWay) -> Bool[Array, "1 B"]:
        """Mask of the impacts that are not over."""
        return stepper.goes_on(now.carry, max_passes)

    last = until_over(goes_on, one_pass, (flow, gamma), start, checkpoints, slots)
    return _finished(flow, gamma, last, inspect)


def _finished(
    flow: Any, gamma: Float[Array, "m B"], last: _OnItsWay, inspect: Inspect
) -> ImpactEnd:
    """The end of the impact.

    Where the flow is over its state is `flow.finished`; where a state has returned as a
    part of itself (`rest.ended`, if cycles are looked for) it is `flow.settled`, the
    limit of the cycle; elsewhere, paused or given up, it stays as it is.
    """
    carry, rest, seen = last
    over = (carry.mark == Mark.OVER) & ~rest.ended

    def at_end(flow: Any, y: Float[Array, "n B"]) -> Float[Array, "n B"]:
        """The state, finished where the impact is over."""
        modes = carry.step.modes
        finished = jnp.where(over, flow.finished(modes, y), y)
        if rest.cycle is None:
            return finished

        def settled() -> Float[Array, "n B"]:
            """The limit of wedged contacts where the impact has ended by it."""
            limit = flow.settled(modes, y, rest.cycle)
            return jnp.where(rest.ended, limit, finished)

        return cond(jnp.any(rest.ended), settled, lambda: finished)

    y = dual_like(carry.y, pushforward(at_end, flow, carry.y))
    end = carry._replace(y=y)
    rest_at_end = inspect(flow, gamma, end, rest, over, at_end=True)
    return ImpactEnd(end, carry.y, rest_at_end, seen)
