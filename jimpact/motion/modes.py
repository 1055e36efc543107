"""Which contacts persist, stick or slide: acceleration-level complementarity."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jimpact.motion.contact_forces import Contacts, Modes, forces
from jimpact.solvers.lcp import solve_lcp

# Contacts with |lambda_n| and |rate'| below this share of the largest gap acceleration of the
# motion stay together: bodies that move side by side press on each other by rounding only.
REST_ACCELERATION = 1e-11
_PASSES = 6  # changes of mode tried per contact with friction, before giving up


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
    broken = released[m:] & before.stick
    ended = jnp.any(released[m:] & slid)
    # where sticking breaks at one contact of a body, those that began to slide before go on
    goes_on = slid & jnp.any(broken) & ~ended & ~sliding
    start = Modes(touching & ~released[:m], ~sliding & ~broken & ~goes_on, before.sign)
    # sliding begins against the last force of sticking
    held = forces(given, mu, start._replace(stick=start.stick | (broken & ~sliding)))
    assert held.tangential is not None
    begun = jnp.where(goes_on, before.sign, jnp.where(held.tangential > 0, -1.0, 1.0))
    sign = jnp.where(sliding, jnp.sign(given.tangent.rate), begun)
    start = start._replace(sign=sign)
    return _pivot(given, mu, start, touching, sliding, slack)


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


class _Search(NamedTuple):
    modes: Modes
    worst: jax.Array
    passes: jax.Array


def _pivot(
    given: Contacts,
    mu: jax.Array,
    start: Modes,
    touching: jax.Array,
    sliding: jax.Array,
    slack: jax.Array,
) -> Choice:
    """Change the worst violation until none is left."""
    m = touching.shape[0]
    w = jnp.diagonal(given.delassus)
    number = jnp.arange(m)

    def violations(modes: Modes) -> tuple[jax.Array, jax.Array]:
        found = forces(given, mu, modes)
        assert found.tangential is not None
        rate = given.approach + given.directions.T @ (found.acceleration - given.free)
        pulls = jnp.where(modes.active, -found.normal * w[:m], 0.0)
        sinks = jnp.where(touching & ~modes.active, -rate[:m], 0.0)
        excess = (jnp.abs(found.tangential) - mu * found.normal) * w[m:]
        breaks = jnp.where(modes.active & modes.stick, excess, 0.0)
        # sliding from rest must move the way it was assumed to
        back = modes.active & ~modes.stick & ~sliding
        returns = jnp.where(back, -modes.sign * rate[m:], 0.0)
        # what pulls or sinks is settled first: cones of pulling contacts mean nothing
        settled = ~jnp.any(jnp.maximum(pulls, sinks) > slack)
        sides = jnp.where(settled, jnp.stack([breaks, returns]), 0.0)
        return jnp.concatenate([jnp.stack([pulls, sinks]), sides]), found.tangential

    def one(state: _Search) -> _Search:
        modes = state.modes
        size, tangential = violations(modes)
        worst = jnp.max(size)
        at = jnp.argmax(size)
        kind, contact = at // m, at % m
        here = (number == contact) & (worst > slack)
        active = jnp.where(here & (kind == 0), False, modes.active)
        active = jnp.where(here & (kind == 1), True, active)
        stick = jnp.where(here & (kind == 2), False, modes.stick)
        stick = jnp.where(here & (kind == 3), True, stick)
        sign = jnp.where(here & (kind == 2), -jnp.sign(tangential), modes.sign)
        return _Search(Modes(active, stick, sign), worst, state.passes + 1)

    begin = one(_Search(start, jnp.asarray(jnp.inf, w.dtype), jnp.asarray(0)))
    end = jax.lax.while_loop(lambda s: (s.worst > slack) & (s.passes < _PASSES * m + 2), one, begin)
    return Choice(end.modes, end.worst <= slack)
