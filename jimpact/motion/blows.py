"""An impact in a motion: the law in the frame of the base, and its energies."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jimpact.impacts import impact
from jimpact.law import Law
from jimpact.motion.dynamics import base_velocity, gaps, kinematics, mass_at, seen_from_base
from jimpact.motion.flight_records import State
from jimpact.motion.system import System
from jimpact.scene import Scene
from jimpact.status import CODE, STATUS

# A contact that still approaches is no failure: it has another impact at the same instant.
FAILS = tuple(row.failure and row.name != "inadmissible_velocity" for row in STATUS)


class Blow(NamedTuple):
    """What the contacts do to the velocities at one event; all impulses [N s]."""

    v: jax.Array
    impulse: jax.Array  # (m,)
    tangential: jax.Array  # (m,)
    energy: jax.Array  # (2, m): change by each contact, normal and tangential
    base_work: jax.Array
    code: jax.Array  # of the law


def no_blow(state: State, m: int) -> Blow:
    """Nothing happens."""
    zero = jnp.zeros_like(state.work)
    none = jnp.zeros(m, state.v.dtype)
    return Blow(state.v, none, none, jnp.zeros((2, m), none.dtype), zero, jnp.int32(CODE["ok"]))


def scene_now(system: System, q: jax.Array, v: jax.Array, t: jax.Array, closed: jax.Array) -> Scene:
    """The scene that a law sees: normals and tangents at q, gaps 0 where `closed`."""
    normal = kinematics(system, q, v, t)
    tangents = None
    if system.tangent_function is not None:
        tangents = jax.jacfwd(
            lambda x: jnp.atleast_1d(system.tangent_function(x))  # type: ignore[misc]
        )(seen_from_base(system, q, t)).T
    open_gaps = jnp.where(closed, 0.0, jnp.maximum(gaps(system, q, t), 0.0))
    return Scene(mass_at(system, q), normal.gradient, tangents, open_gaps)


def blow_of(system: System, law: Law, t: jax.Array, state: State, closed: jax.Array) -> Blow:
    """`impact` in the frame of the base, and what it does to energies."""
    m = closed.shape[0]
    scene = scene_now(system, state.q, state.v, t, closed)
    carried = base_velocity(system, t)
    carried = jnp.zeros_like(state.v) if carried is None else carried
    relative = state.v - carried
    out = impact(law, scene, relative)
    mean = 0.5 * (out.velocity + relative)
    push = scene.normals @ out.impulse
    normal = (scene.normals.T @ mean) * out.impulse
    tangential, side = jnp.zeros(m, normal.dtype), jnp.zeros(m, normal.dtype)
    if scene.tangents is not None:
        tangential = out.tangential_impulse
        side = (scene.tangents.T @ mean) * tangential
        push = push + scene.tangents @ tangential
    energy = jnp.stack([normal, side])
    return Blow(out.velocity + carried, out.impulse, tangential, energy, push @ carried, out.status)
