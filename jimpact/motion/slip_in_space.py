"""Directions of slip of contacts in space; each step has tangents of its own.

The friction of a contact that slides is `-mu lambda_n u / |u|`: smooth but where slip
ends or begins. At the beginning of a step the tangents of each contact are therefore
turned: d is along its slip u_0, n at right angles to it.

SLIP ENDS where `u . d` falls to 0, which a step lands on. The field has to go on behind
it, so the direction is that of `max(|u . d|, AHEAD |u_0|) d + (u . n) n`. Slip that
ends without turning is then as smooth as in the plane.

ERRORS of slip count by what is left of it: a small error of a small slip is a large one
of its direction, and of all derivatives. So steps integrate `ln |u|`, too, whose error
limits their length: each takes a part of the slip, until less than LAST is left for the
landing. This keeps its direction, as a constant: the time until it ends then has the
derivatives of the slip that turns.

SLIP BEGINS, at a contact that stuck, slowly: its rate r' grows from 0, while its
direction follows the forces at a rate c / r, with c the acceleration by friction. As
long as `r' < BEGINNING c` the contact therefore slides along its first direction, and
is held across it. The force for this is too long by the square of the turn, and
velocities err by BEGINNING^3 / 6 of `c^2 / c'`.

THE FIRST DIRECTION of slip, from u = 0, is that of u', which depends on it:
`n . u' = 0`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jimpact.motion.persistent_contact import (
    BEGINS,
    Contacts,
    Forces,
    Modes,
    by_contact,
    direction,
    forces,
    length,
)
from jimpact.numerics.dense import solve_by_pivots
from jimpact.tools.loops import any_lane
from jimpact.tools.masks import quotient

# Least part of the slip at the beginning of a step that lies ahead within it. Ten times
# more, and what a landing leaves of slip that turns is ten times as large.
AHEAD = 1e-2
# Of the speed scale of the motion: less slip is none yet. Ten times more is still
# rounding.
NO_SLIP = 1e-13
# Of the speed scale of the motion: slip that starts keeps its first direction as long
# as it is less: friction turns it within less time than a step. Ten times more: it
# turns ten times later; a thousandth: an error of the first step in its direction ends
# it again.
FIRST = 1e-9
# Of the speed scale of the motion: slip that is left for the landing. Ten times more:
# derivatives of motions err by ten times as much where slip ends, ten times less: by
# rounding.
LAST = 1e-8
# Error of `ln |u|` that a step may make, as a share of the speed scale over the slip,
# in tolerances of the flight, and at most. Ten times more: derivatives err by ten times
# as much.
TURNING = 10.0
MOST_TURNING = 1e-3
# Iterations for first directions: 1 for one contact, 3 to 4 for contacts of one body.
# Ten times more only take time.
_NEWTON = 6
_MOST_TURN = 0.5  # [rad] in one of them; ten times more does not bound it
# Beside a matrix of order 1: contacts of one body turn together, which makes it
# singular. Ten times more: directions converge a tenth as fast.
_RIDGE = 1e-6


class SlipAxes(NamedTuple):
    """Directions and speeds of slip at the beginning of a step, of each contact."""

    along: Float[Array, "m 2"]  # direction d, in the tangents of the body
    speed: Float[Array, " m"]  # |u_0| [m/s], 0 where slip starts
    smallest: Float[Array, " m"]  # [m/s] the slip along d counts as at least that
    # |u_0| <= LAST of the speed scale: the landing on its end is next
    last: Bool[Array, " m"]


def slip_axes(
    contacts: Contacts,
    mu: Float[Array, " m"],
    modes: Modes,
    speed_scale: Float[Array, ""],
) -> SlipAxes:
    """Axes of a step that begins at these contacts: d = u / |u|, or `_first_directions`
    of u = 0.

    `speed_scale`: the largest gap velocity or slip that the motion could have [m/s].
    """
    assert contacts.tangent is not None
    m = len(mu)
    u = by_contact(contacts.tangent.rate, m)
    speed = length(u)
    slides = modes.active & ~modes.stick
    at_rest = speed <= NO_SLIP * speed_scale
    starts = slides & at_rest
    one = jnp.ones_like(mu)
    zero = jnp.zeros_like(mu)
    first = jnp.stack([one, zero], axis=1)
    under_way = (slides & ~starts)[:, None]
    moving = jnp.where(under_way, direction(u), first)
    along = jax.lax.cond(
        any_lane(jnp.any(starts)),
        lambda: _first_directions(contacts, mu, modes, starts, moving),
        lambda: moving,
    )
    last = speed <= LAST * speed_scale
    speed = jnp.where(starts, 0.0, speed)
    # a derivative of the direction that is kept would be that of a turn which goes on
    constant = last & (speed > 0)
    kept_on = jax.lax.stop_gradient(along)
    along = jnp.where(constant[:, None], kept_on, along)
    share = jnp.where(last, 1.0, AHEAD)
    part = share * jax.lax.stop_gradient(speed)
    smallest = jnp.where(starts, FIRST * speed_scale, part)
    return SlipAxes(along, speed, smallest, last)


def slip_within(
    axes: SlipAxes, modes: Modes, rate: Float[Array, " t"]
) -> Float[Array, "m 2"]:
    """Directions of slip in the axes of the step, normalized:
    `max(|u . d|, smallest) d + (u . n) n`.

    It is d where slip begins, or has not started. `rate` is the slip u in these axes
    [m/s].
    """
    u = by_contact(rate, len(axes.speed))
    u_d = u[:, 0]
    u_n = u[:, 1]
    # behind its end slip counts as in front of it: its direction would be stiff at the
    # least one
    size = jnp.abs(u_d)
    ahead = jnp.maximum(size, axes.smallest)
    from_rest = axes.speed == 0
    small = u_d <= axes.smallest
    none = from_rest & small
    begins = modes.sign == BEGINS
    straight = begins | none
    ahead = jnp.where(straight, 1.0, ahead)
    across = jnp.where(straight, 0.0, u_n)
    within = jnp.stack([ahead, across], axis=1)
    return direction(within)


def straightened(axes: SlipAxes, modes: Modes, rate: Float[Array, " t"]) -> Modes:
    """Modes that hold slip across its direction (`BEGINS`) where a step brings it to
    its end.

    `rate` is the slip at the end of the step, in its axes [m/s]. The step before the
    end of a slip knows one direction only, and drifts across it by as much as is left:
    the next step would begin in any direction, and derivatives with it.
    """
    u = by_contact(rate, len(axes.speed))
    size = jnp.abs(u[:, 0])
    slides = modes.active & ~modes.stick
    slower = size < axes.speed
    ends = slides & axes.last & slower
    sign = jnp.where(ends, BEGINS, modes.sign)
    return modes._replace(sign=sign)


def log_rates(
    axes: SlipAxes, modes: Modes, contacts: Contacts, force: Forces
) -> Float[Array, " m"]:
    """Rates `(ln |u|)' = u . u' / |u|^2` [1/s] where contacts slide, |u| at least
    `axes.smallest`.

    0 elsewhere, and where slip is the `last` before its end.
    """
    assert contacts.tangent is not None
    assert force.tangential is not None
    m = len(axes.speed)
    all_forces = jnp.concatenate([force.normal, force.tangential])
    acceleration = contacts.approach + contacts.delassus @ all_forces
    growth = by_contact(acceleration[m:], m)
    u = by_contact(contacts.tangent.rate, m)
    speed_squared = jnp.sum(u * u, axis=1)
    smallest_square = axes.smallest**2
    square = jnp.maximum(speed_squared, smallest_square)
    slides = modes.active & ~modes.stick
    has_begun = modes.sign != BEGINS
    slides = slides & ~axes.last & has_begun
    power = jnp.sum(u * growth, axis=1)
    return quotient(power, square, where=slides)


def turning_errors(
    axes: SlipAxes, rtol: float, speed_scale: Float[Array, ""]
) -> Float[Array, " m"]:
    """Errors of `ln |u|` that a step may make:
    `TURNING rtol max(1, speed_scale / |u_0|)`.

    At most `MOST_TURNING`, and that where the slip is the `last` before its end.
    """
    speed = jnp.where(axes.last, 1.0, axes.speed)
    share = speed_scale / speed
    errors = TURNING * rtol * jnp.maximum(share, 1.0)
    bounded = jnp.minimum(errors, MOST_TURNING)
    return jnp.where(axes.last, MOST_TURNING, bounded)


def _first_directions(
    contacts: Contacts,
    mu: Float[Array, " m"],
    modes: Modes,
    starts: Bool[Array, " m"],
    moving: Float[Array, "m 2"],
) -> Float[Array, "m 2"]:
    """Directions d of slip from rest where it `starts`, elsewhere the `moving` ones.

    Equation: slip starts along its own acceleration, `d x u' = 0` with
    `u' = a + W lambda` and the friction `lambda_t = -mu lambda_n d`: Newton's
    iterations on the angles of d, which begin against the forces that would make the
    contacts stick.
    """
    m = len(mu)
    # slip along d, not against it
    one = jnp.ones_like(modes.sign)
    plain = modes._replace(sign=one)
    sticks = modes.stick | starts
    sticking = plain._replace(stick=sticks)
    stuck = forces(contacts, mu, sticking, moving)
    assert stuck.tangential is not None
    against = -by_contact(stuck.tangential, m)
    has_force = length(against) > 0
    some = starts & has_force
    ahead = jnp.where(some, against[:, 0], 1.0)
    aside = jnp.where(some, against[:, 1], 0.0)
    angle = jnp.arctan2(aside, ahead)

    def unit(angle: Float[Array, " m"]) -> Float[Array, "m 2"]:
        """Directions d = (cos, sin) of the angles where slip starts, else the moving
        ones.
        """
        components = [jnp.cos(angle), jnp.sin(angle)]
        turned = jnp.stack(components, axis=1)
        return jnp.where(starts[:, None], turned, moving)

    def across(
        angle: Float[Array, " m"],
    ) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
        """`d x u'` where slip starts, twice: `jacfwd` returns the second beside the
        Jacobian.
        """
        d = unit(angle)
        sliding = forces(contacts, mu, plain, d)
        assert sliding.tangential is not None
        all_forces = jnp.concatenate([sliding.normal, sliding.tangential])
        acceleration = contacts.approach + contacts.delassus @ all_forces
        u_rate = by_contact(acceleration[m:], m)
        d_1 = d[:, 0]
        d_2 = d[:, 1]
        cross = d_1 * u_rate[:, 1] - d_2 * u_rate[:, 0]
        turn = jnp.where(starts, cross, 0.0)
        return turn, turn

    eye = jnp.eye(m, dtype=mu.dtype)

    def newton(_: Int[Array, ""], angle: Float[Array, " m"]) -> Float[Array, " m"]:
        """Angles after one Newton step on `d x u' = 0`, of at most `_MOST_TURN`."""
        jacobian, turn = jax.jacfwd(across, has_aux=True)(angle)
        largest = jnp.max(jnp.abs(jacobian))
        size = jax.lax.stop_gradient(largest)
        some = size > 0
        size = jnp.where(some, size, 1.0)
        # friction makes the diagonal negative: a little more keeps it regular; other
        # angles stay
        ridge = jnp.where(starts, -_RIDGE, 1.0)
        equations = jacobian / size + eye * ridge[:, None]
        right = -turn[:, None] / size
        solution, _ = solve_by_pivots(equations, right)
        change = solution[:, 0]
        return angle + jnp.clip(change, -_MOST_TURN, _MOST_TURN)

    last_angle = jax.lax.fori_loop(0, _NEWTON, newton, angle)
    return unit(last_angle)
