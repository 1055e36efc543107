"""Contacts that close again and again, and the plastic limit that this comes to.

Each closing takes part of the velocities away, so that endless closings end with
`gamma+ = 0` of those contacts. Most contacts soon end below the tolerance. But contacts
of a light body lose only about its part of the mass at each closing: thousands of
closings, all alike. The law is homogeneous: a state multiplied by s takes the same
course, multiplied by s. Once a state returns as a multiple s < 1 of itself, it will
return so for ever, and the limit is known.

This is checked when the number of closings becomes 8, 16, 32, ... Two states one
such number apart are compared by `gamma`, by the energy in each contact, and by the
impulses that would bring the contacts to rest now. These see, as `gamma` alone does
not, how fast heavy bodies on both sides of a light one still approach. A light body
that does not lose its energy may push them apart in the end; meanwhile its states are
no multiples of each other.

The states of many contacts return in no order. There a look ahead decides
(`look_ahead.py`).
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jimpact.events.contact_flow import OFTEN, ContactFlow
from jimpact.events.look_ahead import comes_to_rest
from jimpact.events.run import Rest
from jimpact.numerics import stepper
from jimpact.numerics.sparse import Iterate, conjugate_step
from jimpact.numerics.stepper import Mark, any_of, total
from jimpact.numerics.tangents import value_of
from jimpact.tools.loops import cond, fori_loop, scan

# Velocity in tolerances, below which a contact that re-closed often is at rest once the
# rest of its bounces is neglected. Ten times more: slow contacts of long chains count
# as plastic ones.
QUIET = 2.0
# Closings of a contact at rest, from which on they were endless; ten times more: not
# reported.
ENDLESS = 3
# Rounds of the search for the contacts that carry an impulse in the plastic limit; few
# change any.
CHOICES = 8
# Difference in shape between two states that are multiples of each other, as a part of
# what the size falls by. Ten times more would end impacts whose states are not
# self-similar.
SHAPE = 0.02


def _values(flow: Any, carry: stepper.StepperState) -> tuple[Any, stepper.StepperState]:
    """Flow and state without tangents."""
    values = value_of(flow), carry._replace(y=value_of(carry.y))
    return jax.lax.stop_gradient(values)


def inspect(
    flow: Any,
    gamma: Float[Array, "m B"],
    carry: stepper.StepperState,
    rest: Rest,
    which: Bool[Array, "1 B"],
    at_end: bool,
) -> Rest:
    """Contacts at rest in impacts `which` pause or, `at_end`, are over; else those of
    `rest`.

    Of impacts that are over, where contacts that closed often hardly move.
    """
    flow, values = _values(flow, carry)
    gamma, rest = jax.lax.stop_gradient((gamma, rest))
    if at_end:
        resting = which & at_rest(flow, values)
    else:
        resting = jnp.zeros_like(rest.contacts)
    if at_end:
        due = any_of(resting)
    else:
        due = which
    rest = cond(
        jnp.any(due),
        lambda: contacts_at_rest(flow, gamma, values, rest, resting),
        lambda: rest,
    )
    if not flow.looks_ahead:
        return rest
    look = due & ~rest.ended & ~any_of(resting) & flow.look_due(values.passes)
    return cond(
        jnp.any(look),
        lambda: block_at_rest(flow, gamma, values, rest, look),
        lambda: rest,
    )


def at_rest(flow: ContactFlow, end: stepper.StepperState) -> Bool[Array, "m B"]:
    """Mask of contacts as good as at rest where some of them re-closed again and
    again.
    """
    m = flow.contacts
    modes = end.step.modes
    gamma = flow.scales(modes) * flow.rows(end.y)[1]
    # no wider than what ended the impact: a ball of a long chain may be slower
    resting = jnp.abs(gamma) <= QUIET * flow.patience(end.passes)
    return resting & any_of(resting & (modes[m : 2 * m] >= ENDLESS))


def contacts_at_rest(
    flow: ContactFlow,
    gamma: Float[Array, "m B"],
    carry: stepper.StepperState,
    last: Rest,
    resting: Bool[Array, "m B"],
) -> Rest:
    """Contacts at rest at the end, or that would come to rest after a pause, and their
    impulses.

    Contacts at rest carry what keeps each of them from approaching:
    `0 <= dp _|_ gamma+ >= 0`, on the gamma+ that their impulses give: errors of many
    closings add up.
    """
    m = flow.contacts
    modes = carry.step.modes
    state = carry.y
    count = modes[m : 2 * m]  # closings so far
    since = count - last.closings
    most, before = (jnp.max(x, axis=0, keepdims=True) for x in (count, last.closings))
    paused = (carry.mark == Mark.PAUSED) & (most > before) & (most >= OFTEN)
    # closed since the last inspection at least half as often as any other contact
    often = paused & (2 * since >= jnp.max(since, axis=0, keepdims=True)) & (count > 0)
    rest = resting | often  # contacts asked about
    now = gamma + flow.change(state)

    start = often | (rest & (now < 0))
    carries, dp = plastic_impulses(flow, rest, start, now)

    # is (gamma, root of the energy, dp) a multiple of that at the last inspection?
    root = jnp.sqrt(flow.energy(state[:m], jnp.zeros_like(now)))
    rows = jnp.where(often, jnp.stack([now, root, dp]), 0.0)
    size, old = (jnp.max(jnp.abs(x), axis=1, keepdims=True) for x in (rows, last.rows))
    ratio = size[:1] / jnp.where(old[:1] > 0, old[:1], size[:1])
    returns = jnp.abs(rows - ratio * last.rows) <= SHAPE * (1 - ratio) * size
    after = now + flow.coupling.times(dp)  # gamma+
    # the impact ends if its state returns, and all but those contacts have settled
    settled = ~flow.at_work(modes, state, flow.tolerance)[0] & (
        after >= -flow.tolerance
    )
    meets = jnp.where(often, carries, settled) & jnp.all(returns, axis=0)
    ends = paused & ~any_of(~meets) & any_of(often & (flow.restitution < 1))
    rest = resting | (often & ends)
    new = Rest(rest, rest & carries, rows.at[2].set(dp), count, ends, last.cycle)
    inspected = paused | any_of(resting)
    return jax.tree.map(lambda a, b: jnp.where(inspected, a, b), new, last)


def block_at_rest(
    flow: ContactFlow,
    gamma: Float[Array, "m B"],
    carry: stepper.StepperState,
    rest: Rest,
    due: Bool[Array, "1 B"],
) -> Rest:
    """`rest`, but the contacts of a block where a look ahead is `due` and shows its
    rest.
    """
    now = gamma + flow.change(carry.y)
    everywhere = jnp.ones_like(now, bool)
    block, dp = plastic_impulses(flow, everywhere, everywhere, now)
    after = now + flow.coupling.times(dp)  # gamma+
    admissible = ~any_of((jnp.where(block, dp, 0.0) < 0) | (after < -flow.tolerance))
    ended = comes_to_rest(flow, carry.step.modes, carry.y, block, dp, due & admissible)
    rows = rest.rows.at[2].set(dp)
    new = Rest(block, block, rows, rest.closings, ended, rest.cycle)
    return jax.tree.map(lambda a, b: jnp.where(ended, a, b), new, rest)


def plastic_impulses(
    flow: ContactFlow,
    allowed: Bool[Array, "m B"],
    start: Bool[Array, "m B"],
    now: Float[Array, "m B"],
) -> tuple[Bool[Array, "m B"], Float[Array, "m B"]]:
    """Mask of the `allowed` contacts that carry, and the impulses dp:
    `0 <= dp _|_ gamma+ >= 0`.

    `start`: those that are taken to carry at first; `now`: gamma.
    """

    def choose(
        _: Any, both: tuple[Bool[Array, "m B"], Float[Array, "m B"]]
    ) -> tuple[Bool[Array, "m B"], Float[Array, "m B"]]:
        """Contacts that carry, less those that would pull, and those that still
        approach; dp.
        """
        carries, _ = both
        dp = impulse_of_rest(flow, carries, now)
        after = now + flow.coupling.times(dp)
        return allowed & jnp.where(carries, dp > 0, after < 0), dp

    return fori_loop(0, CHOICES, choose, (start, jnp.zeros_like(now)))


def final_impulses(
    flow: ContactFlow,
    gamma: Float[Array, "m B"],
    state: Float[Array, "n B"],
    carries: Bool[Array, "m B"],
) -> Float[Array, "m B"]:
    """p after the last `state`, from gap velocities gamma before the impact.

    Equation: `gamma_R + (W p)_R = 0` of the contacts R at rest, which `carries` marks,
    with the impulses of the others as they are. So p_R does not depend on the many
    closings before, whose derivatives grow with each of them and would cancel but for
    rounding.
    """
    m = flow.contacts
    p = flow.rows(state)[2]

    def solved() -> Float[Array, "m B"]:
        """Impulses with which contacts R are at rest; those of the others."""
        # the rows of p
        others = state.at[2 * m : 3 * m].set(jnp.where(carries, 0.0, p))
        # gamma + W p
        at_rest = impulse_of_rest(flow, carries, gamma + flow.change(others))
        return jnp.where(carries, at_rest, p)

    return cond(jnp.any(carries), solved, lambda: p)


def impulse_of_rest(
    flow: ContactFlow, carries: Bool[Array, "m B"], after: Float[Array, "m B"]
) -> Float[Array, "m B"]:
    """dp of the contacts R that carry, with which gamma_R + (G dp)_R = 0: conjugate
    gradients.
    """
    right = jnp.where(carries, -after, 0.0)

    def product(x: Float[Array, "m B"]) -> Float[Array, "m B"]:
        """G x in the contacts that carry, 0 elsewhere."""
        return jnp.where(carries, flow.coupling.times(x), 0.0)

    def step(at: Iterate, _: None) -> tuple[Iterate, None]:
        """State after one step of conjugate gradients in each impact."""
        return conjugate_step(product, lambda x, y: total(x * y), at)[0], None

    start = Iterate(jnp.zeros_like(right), right, right, total(right * right))
    return scan(step, start, None, length=2 * right.shape[0])[0].x
