"""One planar contact with friction, in closed form: no stiffness decides, nothing is integrated.

While slip keeps its direction, velocities are linear in the normal impulse p and the work done on
the contact is quadratic (Routh 1860; Keller 1986; Stronge 1990):

    gamma' = 1 + K_nt r,  u' = K_nt + K_tt r,  r = -mu sign(u), or -K_nt / K_tt while it sticks
    E' = -gamma in compression, -gamma / e^2 in expansion; the impact ends with E = 0

Pieces end where slip stops, gamma changes its sign, or the energy is spent.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

# slip that drives a loaded, separating contact back, then stops in compression: the longest case
PIECES = 4


class Contact(NamedTuple):
    """Dimensionless K_nt, K_tt (K_nn = 1), mu and e."""

    across: jax.Array
    along: jax.Array
    friction: jax.Array
    restitution: jax.Array


class Progress(NamedTuple):
    """Velocities, direction of slip (0: stick), impulses and stored energy so far."""

    gamma: jax.Array
    u: jax.Array
    slips: jax.Array
    p: jax.Array
    side: jax.Array
    energy: jax.Array
    done: jax.Array


def solve(
    contact: Contact, gamma: jax.Array, u: jax.Array, energy: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Impulses p and p_t, and whether the impact came to its end."""
    slips = jnp.where(u == 0, _from_rest(contact), jnp.sign(u))
    none = jnp.zeros_like(gamma)
    at = Progress(gamma, u, slips, none, none, energy, jnp.zeros(gamma.shape, bool))
    for _ in range(PIECES):
        at = _piece(contact, at)
    return at.p, at.side, at.done


def _from_rest(contact: Contact) -> jax.Array:
    """Direction of the slip that friction cannot hold, or 0: it sticks."""
    holds = jnp.abs(contact.across) <= contact.friction * contact.along
    return jnp.where(holds, 0.0, jnp.sign(contact.across))


def _piece(contact: Contact, at: Progress) -> Progress:
    """To the next event."""
    across, along, mu, e = contact
    sticks = at.slips == 0
    fixed = jnp.where(along > 0, -across / jnp.where(along > 0, along, 1.0), 0.0)
    ratio = jnp.where(sticks, fixed, -mu * at.slips)
    dg, du = 1 + across * ratio, jnp.where(sticks, 0.0, across + along * ratio)
    expands = (at.gamma > 0) | ((at.gamma == 0) & (dg > 0))
    stop = _until(at.u * du < 0, at.u, du)
    turn = _until(at.gamma * dg < 0, at.gamma, dg)
    step = jnp.minimum(jnp.minimum(stop, turn), _end(at, e, dg, expands))
    goes_on = ~at.done & jnp.isfinite(step)
    stops, turns = goes_on & (step == stop), goes_on & (step == turn)
    step = jnp.where(goes_on, step, 0.0)
    work = at.gamma * step + 0.5 * dg * step**2
    back = jnp.where(e > 0, jnp.where(e > 0, e, 1.0) ** -2, 0.0)  # e = 0: it ends at once
    return Progress(
        gamma=jnp.where(turns, 0.0, at.gamma + dg * step),
        u=jnp.where(stops, 0.0, at.u + du * step),
        slips=jnp.where(stops, _from_rest(contact), at.slips),
        p=at.p + step,
        side=at.side + ratio * step,
        energy=at.energy - jnp.where(expands, back, 1.0) * work,
        done=at.done | (goes_on & ~stops & ~turns),
    )


def _until(happens: jax.Array, value: jax.Array, rate: jax.Array) -> jax.Array:
    """Impulse after which `value` is 0."""
    return jnp.where(happens, -value / jnp.where(happens, rate, 1.0), jnp.inf)


def _end(at: Progress, e: jax.Array, dg: jax.Array, expands: jax.Array) -> jax.Array:
    """Impulse in which expansion spends the energy: e^2 E = gamma p + gamma' p^2 / 2."""
    begins = at.gamma == 0
    left = 2 * e**2 * at.energy
    inside = at.gamma**2 + dg * left
    spent = expands & (inside > 0) & ~begins
    root = jnp.sqrt(jnp.where(spent, inside, 1.0))
    later = jnp.where(spent, left / jnp.where(spent, at.gamma + root, 1.0), jnp.inf)
    stored = expands & begins & (at.energy > 0)
    whole = e * jnp.sqrt(jnp.where(stored, 2 * at.energy / jnp.where(stored, dg, 1.0), 1.0))
    return jnp.where(stored, whole, later)
