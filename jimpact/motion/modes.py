"""Which contacts persist, stick or slide: acceleration-level complementarity."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jimpact.motion.contact_forces import Contacts, Modes, forces
from jimpact.solvers.friction import solve
from jimpact.solvers.lcp import solve_lcp
from jimpact.status import CODE

# Contacts with |lambda_n| and |rate'| below this share of the largest gap acceleration of the
# motion stay together: bodies that move side by side press on each other by rounding only.
REST_ACCELERATION = 1e-11
_PASSES = 3  # choices: contacts that would not slide as they are taken to are asked again


class Choice(NamedTuple):
    """Modes, and whether they are consistent (friction only: they may not exist)."""

    modes: Modes
    consistent: jax.Array


def choose_with_friction(
    given: Contacts,
    mu: jax.Array,
    before: Modes,
    touching: jax.Array,
    released: jax.Array,
    sliding: jax.Array,
    slack: jax.Array,
) -> Choice:
    """Modes of the contacts that touch at rest.

    Args:
        given: contact space.
        mu: coefficients of friction (m,).
        before: modes up to now.
        touching: (m,) gap and gap velocity are 0.
        released: (2 m,) what has just let go: it is held again only by a force, not by rounding.
        sliding: (m,) whether the tangential velocity is not 0.
        slack: gap accelerations below it are rounding.
    """
    given, mu = jax.lax.stop_gradient((given, mu))
    assert given.tangent is not None
    m = touching.shape[0]
    slid = before.active & ~before.stick
    broken = released[m:] & before.stick & ~sliding
    ended = jnp.any(released[m:] & slid)
    # where sticking breaks at one contact of a body, those that began to slide before go on
    goes_on = slid & jnp.any(released[m:] & before.stick) & ~ended & ~sliding
    now = Modes(touching, ~sliding & ~goes_on, jnp.where(goes_on, before.sign, 0.0))
    now = now._replace(sign=jnp.where(sliding, jnp.sign(given.tangent.rate), now.sign))
    # sliding begins against the last force of sticking
    held = forces(given, mu, now._replace(active=touching & ~released[:m]))
    assert held.tangential is not None
    sign = jnp.where(broken, jnp.where(held.tangential > 0, -1.0, 1.0), now.sign)
    there = jnp.tile(touching, 2)
    w = jnp.where(there[:, None] & there[None], given.delassus, jnp.eye(2 * m, dtype=sign.dtype))
    free = jnp.where(there, given.approach, 0.0)
    diagonal = jnp.diagonal(w)[:m]

    def choose(tried: _Tried) -> _Tried:
        known = tried.known
        found = solve(
            w, free[:m], free[m:], mu * jnp.ones(m, sign.dtype), complementary=True, sliding=known
        )
        rate = free + w @ jnp.concatenate([found.normal, found.tangential])
        active = touching & (rate[:m] <= slack)
        active = active & (~released[:m] | (found.normal * diagonal > slack))
        slips = (known != 0) | (jnp.abs(rate[m:]) > slack)
        modes = Modes(active, active & ~slips, jnp.where(known != 0, known, jnp.sign(rate[m:])))
        # what was taken to slide from rest must do so
        returns = active & (known != 0) & ~sliding & (known * rate[m:] < -slack)
        solved = found.status <= CODE["several_outcomes"]
        known = jnp.where(jnp.where(solved, returns, ~sliding), 0.0, known)
        return _Tried(modes, known, solved, solved & ~jnp.any(returns), tried.passes + 1)

    no = jnp.asarray(False)
    start = _Tried(now, sign, no, no, jnp.asarray(0))
    end = jax.lax.while_loop(lambda t: ~t.done & (t.passes < _PASSES), choose, start)
    return Choice(end.modes, end.solved)


class _Tried(NamedTuple):
    modes: Modes
    known: jax.Array  # directions of slip that are not asked for
    solved: jax.Array
    done: jax.Array
    passes: jax.Array


def pressed_together(
    given: Contacts, touching: jax.Array, slack: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """`0 <= lambda _|_ W lambda + approach >= 0` over touching contacts, without friction.

    Returns:
        Which contacts (m,) are pressed, and which (m,) neither press nor part.
    """
    given = jax.lax.stop_gradient(given)
    m = touching.shape[0]
    w, b = given.delassus[:m, :m], jnp.where(touching, given.approach[:m], 0.0)
    both = touching[:, None] & touching[None, :]
    eye = jnp.eye(m, dtype=w.dtype)
    # redundant contacts: any of the solutions will do
    found = solve_lcp(jnp.where(both, w, eye), b, regular=True)
    pressed = touching & (found.z * jnp.diagonal(w) > slack)
    return pressed, touching & ~pressed & (found.w <= slack)
