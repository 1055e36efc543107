"""The end of an impact: nothing at work, or only contacts that do not feel each other.

A contact j that works alone keeps `x_j^(eta_j+1) + g_j^2`, so its rebound is
`gamma_j+ = e_j sqrt(x_j^(eta_j+1) + g_j^2)`, whatever part of its stroke lies behind it.
"""

import jax
import jax.numpy as jnp

from jimpact.numerics.contacts import any_of
from jimpact.numerics.events import matters
from jimpact.numerics.flow import OPEN, Flow, State, apply, scales
from jimpact.numerics.powers import plus_one, power
from jimpact.solvers.tridiagonal import Symmetric, Tridiagonal

RESIDUAL = 1.0  # loads and velocities below this part of the tolerance end the impact


def at_work(
    flow: Flow, tolerance: jax.Array, phase: jax.Array, state: State, part: float
) -> jax.Array:
    """Contacts (m,) loaded or approaching by more than `part` of the tolerance."""
    s, _, _ = scales(flow, phase)
    loaded = (state.x > 0) & (phase != OPEN)  # a slack contact is not
    return (loaded | (s * state.g < 0)) & matters(flow, tolerance, state, part)


def finish(
    flow: Flow,
    tolerance: jax.Array,
    phase: jax.Array,
    state: State,
    closed_form: bool,
    beyond: jax.Array | None = None,
) -> tuple[jax.Array, State]:
    """Whether the rest follows in closed form (False: only where nothing is left), and the end.

    Contacts marked `beyond` (m,) may press others that are not among these.
    """
    s, _, _ = scales(flow, phase)
    gamma = s * state.g
    works = at_work(flow, tolerance, phase, state, RESIDUAL)
    total = power(state.x, plus_one(flow.exponent)) + state.g**2
    rebound = flow.restitution * jnp.sqrt(jnp.where(works, total, 1.0))
    dp = jnp.where(works, rebound - gamma, 0.0)
    strength, pull = _beside(flow.coupling)
    coupled = works & (apply(strength, works.astype(gamma.dtype)) > 0)
    if beyond is not None:
        coupled |= works & beyond
    pressed = ~works & (gamma + apply(pull, dp) < -RESIDUAL * tolerance)
    alone = ~any_of(coupled | pressed) if closed_form else ~any_of(works)
    end = State(
        x=jnp.zeros_like(state.x),
        g=jnp.where(works, rebound, gamma),
        p=state.p + dp,
        t=state.t,
    )
    return alone, end


def _beside(coupling: Symmetric) -> tuple[Symmetric, Symmetric]:
    """`|G|` and `min(G, 0)` without the diagonal."""
    if isinstance(coupling, Tridiagonal):
        none, off = jnp.zeros_like(coupling.diagonal), coupling.off_diagonal
        return Tridiagonal(none, jnp.abs(off)), Tridiagonal(none, jnp.minimum(off, 0.0))
    beside = 1 - jnp.eye(coupling.shape[0], dtype=coupling.dtype)
    off = coupling * beside.reshape(beside.shape + (1,) * (coupling.ndim - 2))
    return jnp.abs(off), jnp.minimum(off, 0.0)
