"""Along a flight with frozen modes: rates, what is watched, projection onto the constraints."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jimpact.motion.contact_forces import (
    Contacts,
    Modes,
    constraint_impulse,
    contacts_at,
    forces,
    powers,
)
from jimpact.motion.dynamics import user_force
from jimpact.motion.flight_records import Scales, Settings, State
from jimpact.motion.modes import REST_ACCELERATION
from jimpact.motion.system import System


def watched(given: Contacts, mu: jax.Array | None, modes: Modes, scales: Scales) -> jax.Array:
    """What must stay positive (k,): gaps or normal forces, then friction."""
    m = modes.active.shape[0]
    found = forces(given, mu, modes)
    w = jnp.diagonal(given.delassus)
    slack = REST_ACCELERATION * scales.acceleration
    normal = jnp.where(modes.active, found.normal * w[:m] + slack, given.normal.value)
    if given.tangent is None or mu is None or found.tangential is None:
        return normal
    cone = (mu * found.normal - jnp.abs(found.tangential)) * w[m:] + slack
    slip = modes.sign * given.tangent.rate
    side = jnp.where(modes.active, jnp.where(modes.stick, cone, slip), 1.0)
    return jnp.concatenate([normal, side])


class Seen(NamedTuple):
    """Watched values (k,), their rates, and the rates of the state."""

    value: jax.Array
    rate: jax.Array
    slope: State


class Along(NamedTuple):
    """Functions of (t, state) for one set of modes."""

    rates: Callable[[jax.Array, State], State]
    watch: Callable[[jax.Array, State], Seen]
    project: Callable[[jax.Array, State], State]


def along(
    system: System, mu: jax.Array | None, settings: Settings, modes: Modes, scales: Scales
) -> Along:
    """The functions for one set of modes."""

    def contacts(t: jax.Array, y: State) -> Contacts:
        return contacts_at(system, y.q, y.v, t, settings.friction)

    def rates(t: jax.Array, y: State, args: Any = None) -> State:
        given = contacts(t, y)
        found = forces(given, mu, modes)
        friction, base = powers(system, given, found, t)
        power = user_force(system, y.q, y.v, t) @ y.v
        per_contact = jnp.stack([jnp.zeros_like(friction), friction])
        return State(y.v, found.acceleration, power, base, per_contact)

    def watch(t: jax.Array, y: State) -> Seen:
        slope = rates(t, y)
        see = lambda t, y: watched(contacts(t, y), mu, modes, scales)  # noqa: E731
        value, rate = jax.jvp(see, (t, y), (jnp.ones_like(t), slope))
        return Seen(value, rate, slope)

    def project(t: jax.Array, y: State) -> State:
        given = contacts(t, y)
        value, rate = given.normal.value, given.normal.rate
        if given.tangent is not None:  # tangentially only velocities drift
            value = jnp.concatenate([value, jnp.zeros_like(value)])
            rate = jnp.concatenate([rate, given.tangent.rate])
        p = constraint_impulse(given, mu, modes, jnp.stack([value, rate], axis=1))
        move = given.moved @ p
        return y._replace(q=y.q + move[:, 0], v=y.v + move[:, 1])

    return Along(rates, watch, project)
