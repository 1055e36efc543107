"""Contacts that close again and again, and the plastic limit that this comes to.

Each closing takes part of the velocities away, so that endless closings end with `gamma+ = 0` of
those contacts. Most contacts soon end below the tolerance. But contacts of a light body lose only
about its part of the mass at each closing: thousands of closings, all alike. The law is
homogeneous: a state multiplied by s takes the same course, multiplied by s. Once a state returns as
a multiple s < 1 of itself, it will return so for ever, and the limit is known.

This is checked when the number of closings becomes 8, 16, 32, ... Two states one
such number apart are compared by `gamma`, by the energy in each contact, and by the impulses that
would bring the contacts to rest now. These see, as `gamma` alone does not, how fast heavy bodies
on both sides of a light one still approach. A light body that does not lose its energy may push
them apart in the end; meanwhile its states are no multiples of each other.

The states of many contacts return in no order. There a look ahead decides (`look_ahead.py`).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jimpact.events.contact_flow import OFTEN, ContactFlow
from jimpact.events.look_ahead import comes_to_rest
from jimpact.numerics import stepper
from jimpact.numerics.driver import until_over
from jimpact.numerics.stepper import Mark, any_of, total
from jimpact.numerics.tangents import dual_like, pushforward, value_of
from jimpact.tools.loops import cond, fori_loop, scan
from jimpact.tools.status import CODE

# Velocity in tolerances, below which a contact that re-closed often is at rest once the rest of its
# bounces is neglected. Ten times more: slow contacts of long chains count as plastic ones.
QUIET = 2.0
# Closings of a contact at rest, from which on they were endless; ten times more: not reported.
ENDLESS = 3
# Rounds of the search for the contacts that carry an impulse in the plastic limit; few change any.
CHOICES = 8
# Difference in shape between two states that are multiples of each other, as a part of what the
# size falls by. Ten times more would end impacts whose states are not self-similar.
SHAPE = 0.02


class Rest(NamedTuple):
    """Which contacts (m, B) come to rest, and the state of the impact at its last pause."""

    contacts: jax.Array  # whose closings have no end
    carries: jax.Array  # those of them that carry an impulse
    # (3, m, B): gamma, root of the energy stored, impulse that takes what is left of the approach
    rows: jax.Array
    closings: jax.Array
    ended: jax.Array  # (1, B): by a state that returned as a part of itself


class ImpactEnd(NamedTuple):
    """An impact at its end, finished but for the impulse of the contacts at rest."""

    carry: stepper.StepperState
    reached: Any  # the state (n, B) before it was finished
    rest: Rest
    seen: Any  # what its steps showed

    @property
    def carries(self) -> jax.Array:
        """Contacts at rest that carry an impulse (m, B); uses both, see it."""
        return self.rest.carries & self.rest.contacts

    @property
    def impulse(self) -> jax.Array:
        """Of the contacts at rest (m, B)."""
        return jnp.where(self.carries, self.rest.rows[2], 0.0)

    @property
    def over(self) -> jax.Array:
        """Whether (1, B) the impact has ended, not given up."""
        return self.carry.progress[2:3] == Mark.OVER

    @property
    def finishes(self) -> jax.Array:
        """Ended by the flow itself (1, B)."""
        return self.over & ~self.rest.ended

    @property
    def status(self) -> jax.Array:
        """Status (1, B) of the run."""
        code = jnp.where(any_of(self.rest.contacts), CODE["plastic_limit"], CODE["ok"])
        return jnp.where(self.over, code, CODE["max_steps"]).astype(jnp.int32)


class _Run(NamedTuple):
    """An impact on its way."""

    carry: stepper.StepperState
    rest: Rest
    seen: Any


Observe = Callable[[Any, stepper.StepperState, jax.Array], Any]


def to_the_end(
    flow: Any,
    gamma: jax.Array,
    modes: jax.Array,
    y: Any,
    most: int,
    checkpoints: bool = False,
    observe: Observe | None = None,
    seen: Any = None,
) -> ImpactEnd:
    """From gap velocities gamma (m, B) to the end, in at most so many passes.

    What of `flow` and y has tangents (see `tangents.py`) gives a state with tangents. With
    `checkpoints` the loop has a reverse mode, and no forward mode. `observe(seen, state, accept)`
    follows the states before each step, and which impacts (1, B) accept it.
    """
    no = jnp.zeros(gamma.shape, bool)
    rows = jnp.zeros((3, *gamma.shape), gamma.dtype)
    rest = Rest(no, no, rows, jnp.zeros(gamma.shape, modes.dtype), no[:1])

    def one_pass(at: tuple[Any, jax.Array], run: _Run) -> _Run:
        """One step tried; impacts that pause are inspected."""
        flow, gamma = at
        carry, accept = stepper.advance(flow, run.carry, most)
        if observe is not None:
            run = run._replace(seen=observe(run.seen, run.carry, accept))
        paused = carry.progress[2:3] == Mark.PAUSED
        if not value_of(flow).self_similar:
            return run._replace(carry=carry)
        rest = _inspected(flow, gamma, carry, run.rest, paused, jnp.zeros_like(run.rest.contacts))
        settled = jnp.where(rest.ended, Mark.OVER, Mark.GOES_ON)
        mark = jnp.where(paused, settled, carry.progress[2:3])
        progress = carry.progress.at[2:3].set(jax.lax.stop_gradient(mark))
        return _Run(carry._replace(progress=progress), rest, run.seen)

    start = _Run(stepper.begin(flow, modes, y), rest, seen)
    run = until_over(
        lambda _, run: stepper.goes_on(run.carry, most), one_pass, (flow, gamma), start,
        checkpoints, value_of(flow).queues and observe is None,
    )  # fmt: skip
    return _finished(flow, gamma, run)


def _finished(flow: Any, gamma: jax.Array, run: _Run) -> ImpactEnd:
    """The end of a run; the flow finishes the state where it has ended by itself."""
    carry, rest, seen = run
    over = (carry.progress[2:3] == Mark.OVER) & ~rest.ended
    quiet = over & at_rest(*_values(flow, carry))

    def at_end(flow: ContactFlow, y: jax.Array) -> jax.Array:
        """The state, finished where the impact is over."""
        return jnp.where(over, flow.finish(carry.step.modes, y)[1], y)

    y = dual_like(carry.y, pushforward(at_end, flow, carry.y))
    end = carry._replace(y=y)
    rest = _inspected(flow, gamma, end, rest, jnp.any(quiet, axis=0, keepdims=True), quiet)
    return ImpactEnd(end, carry.y, rest, seen)


def _values(flow: Any, carry: stepper.StepperState) -> tuple[Any, stepper.StepperState]:
    """Flow and state without tangents."""
    values = value_of(flow), carry._replace(y=value_of(carry.y))
    return jax.lax.stop_gradient(values)


def _inspected(
    flow: Any, gamma: jax.Array, carry: Any, rest: Rest, due: jax.Array, quiet: jax.Array
) -> Rest:
    """`contacts_at_rest` where any impact (1, B) is `due`, otherwise `rest`."""
    flow, values = _values(flow, carry)
    gamma, rest = jax.lax.stop_gradient((gamma, rest))
    rest = cond(
        jnp.any(due),
        lambda: contacts_at_rest(flow, gamma, values, rest, quiet),
        lambda: rest,
    )
    if not flow.looks_ahead:
        return rest
    look = due & ~rest.ended & ~any_of(quiet) & flow.look_due(values.progress[3:4])
    return cond(
        jnp.any(look),
        lambda: block_at_rest(flow, gamma, values, rest, look),
        lambda: rest,
    )


def at_rest(flow: ContactFlow, end: stepper.StepperState) -> jax.Array:
    """Contacts (m, B) as good as at rest where some of them re-closed again and again."""
    m, modes = flow.contacts, end.step.modes
    gamma = flow.scales(modes) * flow.rows(end.y)[1]
    # no wider than what ended the impact: a ball of a long chain may be slower
    quiet = jnp.abs(gamma) <= QUIET * flow.patience(end.progress[3:4])
    return quiet & any_of(quiet & (modes[m : 2 * m] >= ENDLESS))


def contacts_at_rest(
    flow: ContactFlow, gamma: jax.Array, carry: stepper.StepperState, last: Rest, quiet: jax.Array
) -> Rest:
    """Which contacts are at rest at the end, or would come to rest after a pause.

    Contacts at rest carry what keeps each of them from approaching: `0 <= dp _|_ gamma+ >= 0`, on
    the gamma+ that their impulses give: errors of many closings add up.
    """
    m, modes, state = flow.contacts, carry.step.modes, carry.y
    count = modes[m : 2 * m]
    since = count - last.closings
    most, before = (jnp.max(x, axis=0, keepdims=True) for x in (count, last.closings))
    paused = (carry.progress[2:3] == Mark.PAUSED) & (most > before) & (most >= OFTEN)
    often = paused & (2 * since >= jnp.max(since, axis=0, keepdims=True)) & (count > 0)
    rest = quiet | often
    now = gamma + flow.change(state)

    start = often | (rest & (now < 0))
    carries, dp = plastic_impulses(flow, rest, start, now)

    # is it a multiple of the state at the last check?
    root = jnp.sqrt(flow.energy(state[:m], jnp.zeros_like(now)))
    rows = jnp.where(often, jnp.stack([now, root, dp]), 0.0)
    size, old = (jnp.max(jnp.abs(x), axis=1, keepdims=True) for x in (rows, last.rows))
    ratio = size[:1] / jnp.where(old[:1] > 0, old[:1], size[:1])
    returns = jnp.abs(rows - ratio * last.rows) <= SHAPE * (1 - ratio) * size
    after = now + flow.coupling.times(dp)
    settled = ~flow.at_work(modes, state, flow.tolerance)[0] & (after >= -flow.tolerance)
    meets = jnp.where(often, carries, settled) & jnp.all(returns, axis=0)
    ends = paused & ~any_of(~meets) & any_of(often & (flow.restitution < 1))
    rest = quiet | (often & ends)
    new = Rest(rest, rest & carries, rows.at[2].set(dp), count, ends)
    fresh = paused | any_of(quiet)
    return jax.tree.map(lambda a, b: jnp.where(fresh, a, b), new, last)


def block_at_rest(
    flow: ContactFlow, gamma: jax.Array, carry: stepper.StepperState, rest: Rest, due: jax.Array
) -> Rest:
    """As `rest`; but where a look ahead is `due` (1, B) and shows a block, its contacts."""
    now = gamma + flow.change(carry.y)
    everywhere = jnp.ones_like(now, bool)
    block, dp = plastic_impulses(flow, everywhere, everywhere, now)
    after = now + flow.coupling.times(dp)
    right = ~any_of((jnp.where(block, dp, 0.0) < 0) | (after < -flow.tolerance))
    ended = comes_to_rest(flow, carry.step.modes, carry.y, block, dp, due & right)
    new = Rest(block, block, rest.rows.at[2].set(dp), rest.closings, ended)
    return jax.tree.map(lambda a, b: jnp.where(ended, a, b), new, rest)


def plastic_impulses(
    flow: ContactFlow, allowed: jax.Array, start: jax.Array, now: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Which `allowed` contacts (m, B) carry, and the impulses with which `0 <= dp _|_ gamma+ >= 0`.

    `start`: those that are taken to carry at first; `now` gamma (m, B).
    """

    def choose(_: Any, both: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        """Those that would pull leave, those that still approach carry, too."""
        carries, _ = both
        dp = impulse_of_rest(flow, carries, now)
        after = now + flow.coupling.times(dp)
        return allowed & jnp.where(carries, dp > 0, after < 0), dp

    return fori_loop(0, CHOICES, choose, (start, jnp.zeros_like(now)))


def final_impulses(
    flow: ContactFlow, gamma: jax.Array, state: jax.Array, carries: jax.Array
) -> jax.Array:
    """p (m, B) after the last `state`; that of contacts at rest follows from `gamma+ = 0`.

    Their closings do not matter for it: derivatives of earlier impulses grow with each closing, and
    their rounding would remain where they cancel.
    """
    m, p = flow.contacts, flow.rows(state)[2]

    def some() -> jax.Array:
        """Impulses where a contact carries."""
        others = state.at[2 * m : 3 * m].set(jnp.where(carries, 0.0, p))
        of_rest = impulse_of_rest(flow, carries, gamma + flow.change(others))
        return jnp.where(carries, of_rest, p)

    return cond(jnp.any(carries), some, lambda: p)


def impulse_of_rest(flow: ContactFlow, carries: jax.Array, after: jax.Array) -> jax.Array:
    """dp (m, B) of the contacts that carry, with which their gamma+ is 0: conjugate gradients."""
    right = jnp.where(carries, -after, 0.0)

    def step(carry: Any, _: None) -> tuple[Any, None]:
        """One step of conjugate gradients."""
        z, residual, direction, size = carry
        image = jnp.where(carries, flow.coupling.times(direction), 0.0)
        curvature = total(direction * image)
        length = jnp.where(curvature > 0, size / jnp.where(curvature > 0, curvature, 1.0), 0.0)
        z, residual = z + length * direction, residual - length * image
        new = total(residual * residual)
        ratio = jnp.where(size > 0, new / jnp.where(size > 0, size, 1.0), 0.0)
        return (z, residual, residual + ratio * direction, new), None

    start = (jnp.zeros_like(right), right, right, total(right * right))
    return scan(step, start, None, length=2 * right.shape[0])[0][0]
