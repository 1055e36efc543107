"""Gaps, their rates and accelerations, and the acceleration that forces alone give."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jimpact.motion.system import System
from jimpact.numerics.dense import solve_mass_matrix
from jimpact.tools.compiling import full_precision
from jimpact.tools.precision import precision


def not_rounding(share: float, dtype: jnp.dtype) -> float:
    """A share that counts as 0, in single precision that of a few roundings."""
    return max(share, precision(dtype).rounding)


class Kinematics(NamedTuple):
    """Of the m contacts at one instant; `rate' = grad^T q'' + drift`."""

    value: jax.Array  # (m,) gaps; 0 of what slides
    rate: jax.Array  # (m,) as seen from the base
    drift: jax.Array  # (m,) second derivative for q'' = 0
    gradient: jax.Array  # (n, m)


def base_velocity(system: System, t: jax.Array) -> jax.Array | None:
    """`B y_b'(t)` (n,), None without a base."""
    if system.base is None:
        return None
    return jax.jvp(lambda s: _displaced(system, s), (t,), (jnp.ones_like(t),))[1]


def carried_along(system: System, v: jax.Array, t: jax.Array) -> jax.Array:
    """Velocity of the base (n,), 0 without one."""
    velocity = base_velocity(system, t)
    return jnp.zeros_like(v) if velocity is None else velocity


@full_precision
def _displaced(system: System, t: jax.Array) -> jax.Array:
    """Displacement of the base `B y_b(t)` (n,)."""
    assert system.base is not None
    assert system.base_directions is not None
    return system.base_directions @ jnp.atleast_1d(system.base(t))


@full_precision
def seen_from_base(system: System, q: jax.Array, t: jax.Array) -> jax.Array:
    """The configuration, displaced by `-B y_b(t)`."""
    return q if system.base is None else system.body.moved(q, -_displaced(system, t))


def gaps(system: System, q: jax.Array, t: jax.Array) -> jax.Array:
    """f (m,) [m]."""
    return jnp.atleast_1d(system.body.gap_function(seen_from_base(system, q, t)))


def is_pile(system: System) -> bool:
    """Whether time stepping takes the closed contacts only."""
    return system.body.pair_count is not None


def recorded_gaps(system: System, q: jax.Array, t: jax.Array) -> jax.Array:
    """Gaps (m,), of a pile the least one (1,)."""
    if is_pile(system):
        return system.body.least_gap(seen_from_base(system, q, t))[None]
    return gaps(system, q, t)


def kinematics(
    system: System, q: jax.Array, v: jax.Array, t: jax.Array, friction: bool = False
) -> tuple[Kinematics, Kinematics | None]:
    """That of the gaps, and with friction that of what slides (its value is 0)."""
    body = system.body

    def tangents(at: jax.Array) -> tuple[jax.Array, jax.Array]:
        """What slides has no value."""
        h = body.tangents(at)
        assert h is not None
        return jnp.zeros_like(h[0]), h

    if not body.has_formulas:
        normal = _differentiated(system, q, v, t)
        return normal, _along(system, q, v, t, tangents) if friction else None

    def all_directions(at: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Gaps; normals, then tangents."""
        known = body.directions(at, friction)
        each = [x for x in known[1:] if x is not None]
        return known.gaps, jnp.concatenate(each, axis=1)

    both = _along(system, q, v, t, all_directions)
    m = len(both.value)
    normal = Kinematics(both.value, both.rate[:m], both.drift[:m], both.gradient[:, :m])
    if not friction:
        return normal, None
    slip = both.rate[m:]
    return normal, Kinematics(jnp.zeros_like(slip), slip, both.drift[m:], both.gradient[:, m:])


def _differentiated(system: System, q: jax.Array, v: jax.Array, t: jax.Array) -> Kinematics:
    """That of the gaps by two derivatives."""
    here, along = _in_time(v, t)

    def value_at(u: jax.Array, s: jax.Array) -> jax.Array:
        """Gaps (m,) after the displacement u and the time s."""
        return gaps(system, system.body.nearby(q, u), t + s)

    def rates(u: jax.Array, s: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Gaps and gap velocities (m,) there."""
        return jax.jvp(value_at, (u, s), along)

    (value, rate), (_, drift) = jax.jvp(rates, here, along)
    return Kinematics(value, rate, drift, system.body.normals(seen_from_base(system, q, t)))


def _in_time(
    v: jax.Array, t: jax.Array
) -> tuple[tuple[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
    """Displacement and time at an instant, 0, and their rates.

    Only the rates depend on v, so that different velocities at one q share all other operations.
    """
    return (jnp.zeros_like(v), jnp.zeros_like(t)), (v, jnp.ones_like(t))


def _along(
    system: System,
    q: jax.Array,
    v: jax.Array,
    t: jax.Array,
    directions: Callable[[jax.Array], tuple[jax.Array, jax.Array]],
) -> Kinematics:
    """Velocities along the directions (n, k) that a function of q gives, with some values."""
    here, along = _in_time(v, t)

    def rates(u: jax.Array, s: jax.Array) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        """Velocities (k,) after the displacement u and the time s; values, directions."""
        value, h = directions(seen_from_base(system, system.body.nearby(q, u), t + s))
        carried = base_velocity(system, t + s)
        rate = h.T @ (v if carried is None else v - carried)
        return rate, (value, h)

    rate, drift, (value, h) = jax.jvp(rates, here, along, has_aux=True)
    return Kinematics(value, rate, drift, h)


def mass_at(system: System, q: jax.Array) -> jax.Array:
    """M (n,) or (n, n)."""
    return system.body.mass_matrix(q)


def definite(mass: jax.Array) -> jax.Array:
    """Whether M is positive definite."""
    if mass.ndim == 1:
        return jnp.all(mass > 0)
    mass = jax.lax.stop_gradient(mass)
    return jnp.all(jnp.isfinite(solve_mass_matrix(mass, mass[:, 0])))


@full_precision
def kinetic(system: System, q: jax.Array, v: jax.Array) -> jax.Array:
    """`T = v^T M v / 2` [J]."""
    mass = mass_at(system, q)
    return 0.5 * v @ (mass * v if mass.ndim == 1 else mass @ v)


def potential(system: System, q: jax.Array) -> jax.Array:
    """V [J]."""
    return jnp.zeros((), q.dtype) if system.potential is None else system.potential(q)


def user_force(system: System, q: jax.Array, v: jax.Array, t: jax.Array) -> jax.Array:
    """F (n,) without the forces of the potential."""
    if system.force is None:
        return jnp.zeros_like(v)
    return jnp.asarray(system.force(q, v, t)).astype(v.dtype)


def free_acceleration(
    system: System, q: jax.Array, v: jax.Array, force: jax.Array, mass: jax.Array
) -> jax.Array:
    """v' (n,) without contact forces: `M v' = F - grad V + inertial forces`."""
    total = force
    if system.potential is not None:
        total = total - system.body.pulled(q, jax.grad(system.potential)(q))
    return solve_mass_matrix(mass, total + system.body.inertial_force(q, v))
