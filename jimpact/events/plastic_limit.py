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

from jimpact.events.contact_flow import OFTEN, ContactFlow, largest_of
from jimpact.events.look_ahead import comes_to_rest
from jimpact.events.run import Rest
from jimpact.numerics import stepper
from jimpact.numerics.sparse import Iterate, conjugate_step
from jimpact.numerics.stepper import Mark, any_of, total
from jimpact.numerics.tangents import value_of
from jimpact.tools.loops import cond, fori_loop, scan
from jimpact.tools.masks import choose

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

    Impacts that pause are asked about by `contacts_at_rest`; of those that are over
    those with contacts that closed often and hardly move (`hardly_moving`). Where that
    finds none in a long chain, a look ahead may be due: `block_at_rest`.
    """
    flow, values = _values(flow, carry)
    gamma, rest = jax.lax.stop_gradient((gamma, rest))
    if at_end:
        resting = which & hardly_moving(flow, values)
        due = any_of(resting)
    else:
        resting = jnp.zeros_like(rest.contacts)
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


def hardly_moving(flow: ContactFlow, end: stepper.StepperState) -> Bool[Array, "m B"]:
    """Mask of contacts with |gamma| <= QUIET tolerances, in impacts in which one of
    them has closed ENDLESS times or more.
    """
    modes = end.step.modes
    gamma = flow.scales(modes) * flow.rows(end.y).g
    # no wider than what ended the impact: a ball of a long chain may be slower
    resting = jnp.abs(gamma) <= QUIET * flow.patience(end.passes)
    endless = flow.modes(modes).closings >= ENDLESS
    return resting & any_of(resting & endless)


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
    closings add up. After a pause an impact ends if each contact that closes often
    carries, each other one has settled, and gamma, the root of the energy, and dp of
    those that close often return as a multiple `ratio` of what they were.
    """
    modes = carry.step.modes
    state = carry.y
    closings = flow.modes(modes).closings
    since = closings - last.closings
    now_most = largest_of(closings)
    paused = (carry.mark == Mark.PAUSED) & (now_most >= OFTEN)
    paused = paused & (now_most > largest_of(last.closings))
    # closed since the last inspection at least half as often as any other contact
    often = paused & (2 * since >= largest_of(since)) & (closings > 0)
    asked = resting | often
    gamma = gamma + flow.change(state)  # now

    start = often | (asked & (gamma < 0))
    carries, dp = plastic_impulses(flow, asked, start, gamma)

    of_often = jnp.where(often, gamma, 0.0)
    x, _, _ = flow.rows(state)
    root = jnp.sqrt(flow.energy(x, jnp.zeros_like(x)))
    root = jnp.where(often, root, 0.0)
    dp_often = jnp.where(often, dp, 0.0)
    size = largest_of(jnp.abs(of_often))
    old = largest_of(jnp.abs(last.gamma))
    ratio = size / jnp.where(old > 0, old, size)
    returns = _returns(of_often, last.gamma, ratio)
    returns = returns & _returns(root, last.root, ratio)
    returns = returns & _returns(dp_often, last.impulse, ratio)

    after = gamma + flow.coupling.times(dp)  # gamma+
    works, _, _ = flow.at_work(modes, state, flow.tolerance)
    settled = ~works & (after >= -flow.tolerance)
    meets = jnp.where(often, carries, settled) & returns
    one_loses = any_of(often & (flow.restitution < 1))
    ends = paused & ~any_of(~meets) & one_loses
    rest = resting | (often & ends)
    new = Rest(
        contacts=rest,
        carries=rest & carries,
        gamma=of_often,
        root=root,
        impulse=dp,
        closings=closings,
        ended=ends,
        cycle=last.cycle,
    )
    inspected = paused | any_of(resting)
    return choose(inspected, new, last)


def _returns(
    x: Float[Array, "m B"], old: Float[Array, "m B"], ratio: Float[Array, "1 B"]
) -> Bool[Array, "m B"]:
    """Mask: x is `ratio old`, but for a part SHAPE of what its size falls by."""
    allowed = SHAPE * (1 - ratio) * largest_of(jnp.abs(x))
    return jnp.abs(x - ratio * old) <= allowed


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
    gamma = gamma + flow.change(carry.y)  # now
    everywhere = jnp.ones_like(gamma, bool)
    block, dp = plastic_impulses(flow, everywhere, everywhere, gamma)
    after = gamma + flow.coupling.times(dp)  # gamma+
    pulls = jnp.where(block, dp, 0.0) < 0
    admissible = ~any_of(pulls | (after < -flow.tolerance))
    asked = due & admissible
    ended = comes_to_rest(flow, carry.step.modes, carry.y, block, dp, asked)
    new = rest._replace(contacts=block, carries=block, impulse=dp, ended=ended)
    return choose(ended, new, rest)


def plastic_impulses(
    flow: ContactFlow,
    allowed: Bool[Array, "m B"],
    start: Bool[Array, "m B"],
    gamma: Float[Array, "m B"],
) -> tuple[Bool[Array, "m B"], Float[Array, "m B"]]:
    """Mask of the `allowed` contacts that carry, and the impulses dp with
    `0 <= dp _|_ gamma + G dp >= 0`.

    `start`: those that are taken to carry at first.
    """

    def corrected(
        _: Any, last: tuple[Bool[Array, "m B"], Float[Array, "m B"]]
    ) -> tuple[Bool[Array, "m B"], Float[Array, "m B"]]:
        """Contacts that carry, less those that would pull, and those that still
        approach; dp.
        """
        carries, _ = last
        dp = impulse_of_rest(flow, carries, gamma)
        after = gamma + flow.coupling.times(dp)
        return allowed & jnp.where(carries, dp > 0, after < 0), dp

    return fori_loop(0, CHOICES, corrected, (start, jnp.zeros_like(gamma)))


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
    rows = flow.rows(state)
    p = rows.p

    def solved() -> Float[Array, "m B"]:
        """Impulses with which contacts R are at rest; those of the others."""
        of_others = rows._replace(p=jnp.where(carries, 0.0, p))
        others = flow.with_rows(state, of_others)
        # gamma + W p
        p_rest = impulse_of_rest(flow, carries, gamma + flow.change(others))
        return jnp.where(carries, p_rest, p)

    return cond(jnp.any(carries), solved, lambda: p)


def impulse_of_rest(
    flow: ContactFlow, carries: Bool[Array, "m B"], gamma: Float[Array, "m B"]
) -> Float[Array, "m B"]:
    """dp with `gamma_R + (G dp)_R = 0` of the contacts R that carry, 0 of others.

    By conjugate gradients.
    """
    right = jnp.where(carries, -gamma, 0.0)

    def product(x: Float[Array, "m B"]) -> Float[Array, "m B"]:
        """G x in the contacts that carry, 0 elsewhere."""
        return jnp.where(carries, flow.coupling.times(x), 0.0)

    def scalar(x: Float[Array, "m B"], y: Float[Array, "m B"]) -> Float[Array, "1 B"]:
        """Scalar products of each impact."""
        return total(x * y)

    def step(now: Iterate, _: Any) -> tuple[Iterate, None]:
        """One step of conjugate gradients in each impact."""
        after, _ = conjugate_step(product, scalar, now)
        return after, None

    zero = jnp.zeros_like(right)
    start = Iterate(zero, right, right, scalar(right, right))
    most = 2 * right.shape[0]
    end, _ = scan(step, start, None, length=most)
    return end.x
