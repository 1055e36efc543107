"""Which of the contacts that do not slide stick, and where the others begin to slip.

With the normal forces known, `u' = K_tn F + K_tt lambda` and Coulomb's law at rest are the
conditions of a convex problem: minimize `lambda^T K_tt lambda / 2 + lambda^T b` over the friction
discs |lambda_j| <= mu_j F_j. Its u' is unique. Only a decision comes out of it: the forces
themselves are computed from the modes, to rounding.
"""

import jax
import jax.numpy as jnp

from jimpact.numerics.contacts import along_contacts
from jimpact.numerics.flow import rates_of
from jimpact.numerics.friction_flow import (
    Frictional,
    Modes,
    State,
    direction,
    normal_force,
    per_row,
    size,
    still,
    times,
)

AHEAD = 1e-6  # forces are those of a moment later: at the first touch there are none yet
SWEEPS = 200  # of the projected Gauss-Seidel iteration
SETTLED = 1e-13  # change of a sweep, in the largest friction, with which it ends
INSIDE = 1e-9  # part of mu F below which a force is inside the disc

Sweep = tuple[jax.Array, jax.Array, jax.Array]  # forces, whether they move, count


def who_sticks(
    flow: Frictional, modes: Modes, state: State, asked_of: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Of the contacts `asked_of` (m,): whether they stick, else the direction (t,) of slip."""
    flow, state = still(flow), jax.lax.stop_gradient(state)
    rows = flow.rows
    rates = rates_of(flow.normal, modes.phase)
    soon = jnp.maximum(state.x + AHEAD * rates.closing * state.g, 0.0)
    force = normal_force(flow, modes, soon)
    largest = jnp.max(force, axis=0, keepdims=True)
    force = force / jnp.where(largest > 0, largest, 1.0)
    most = along_contacts(flow.friction, force) * force
    held = per_row(asked_of, rows)
    slipping = jnp.where(held, 0.0, -per_row(most, rows) * direction(flow, modes, state.u))
    b = times(jnp.swapaxes(flow.across, 0, 1), force) + times(flow.along, slipping)
    side = _gauss_seidel(flow.along, jnp.where(held, b, 0.0), most, asked_of, rows)
    rate = jnp.where(held, times(flow.along, side) + b, 0.0)
    scale = jnp.max(jnp.abs(b), axis=0, keepdims=True)
    stick = (size(side, rows) < (1 - INSIDE) * most) | (size(rate, rows) <= INSIDE * scale)
    pushed = per_row(size(side, rows) > 0, rows)
    return asked_of & stick, jnp.where(pushed, -side, rate)


def _gauss_seidel(
    k: jax.Array, b: jax.Array, most: jax.Array, asked_of: jax.Array, rows: int
) -> jax.Array:
    """lambda (t,) of the convex problem, for the contacts asked of; 0 for others."""
    m = len(asked_of)
    tolerance = SETTLED * jnp.max(most, axis=0, keepdims=True)

    def sweep(carry: Sweep) -> Sweep:
        side, _, count = carry
        before = side
        for j in range(m):
            at = slice(rows * j, rows * (j + 1))
            rate = times(k[at], side) + b[at]
            stiffness = jnp.trace(k[at, at])
            tried = side[at] - rate / stiffness[None]
            length = size(tried, rows)
            allowed = most[j : j + 1]
            shrink = jnp.where(length > allowed, allowed / jnp.where(length > 0, length, 1.0), 1.0)
            tried = jnp.where(asked_of[j : j + 1], shrink * tried, 0.0)
            side = side.at[at].set(tried)
        moving = jnp.any(jnp.abs(side - before) > tolerance)
        return side, moving, count + 1

    start = (jnp.zeros_like(b), jnp.any(asked_of), jnp.asarray(0))
    return jax.lax.while_loop(lambda c: c[1] & (c[2] < SWEEPS), sweep, start)[0]
