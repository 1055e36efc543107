"""Gaps, their rates and accelerations, and the acceleration that forces alone give."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jimpact.motion.system import System

_ROUNDINGS = 4  # that a share may be off by in single precision; more would hide slow approach


def not_rounding(share: float, dtype: jnp.dtype) -> float:
    """A share that counts as 0, in single precision that of a few roundings."""
    return max(share, _ROUNDINGS * float(jnp.finfo(dtype).eps))


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


def _displaced(system: System, t: jax.Array) -> jax.Array:
    """Displacement of the base `B y_b(t)` (n,)."""
    assert system.base is not None
    assert system.base_directions is not None
    return system.base_directions @ jnp.atleast_1d(system.base(t))


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
    system: System, q: jax.Array, v: jax.Array, t: jax.Array, *, of_tangents: bool = False
) -> Kinematics:
    """Value, rate, drift and gradient of the gaps, or of what slides (its value is 0)."""
    body, zero, one = system.body, jnp.zeros_like(t), jnp.ones_like(t)

    def place(s: jax.Array) -> jax.Array:
        """The configuration, seen from the base, after the time s."""
        return seen_from_base(system, body.nearby(q, s * v), t + s)

    def along(s: jax.Array) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        """Velocities (k,) along the directions (n, k) after the time s; values, directions."""
        found = (None, body.tangents(place(s))) if of_tangents else body.gaps_and_normals(place(s))
        assert found is not None
        value, h = found
        assert h is not None
        carried = base_velocity(system, t + s)
        rate = h.T @ (v if carried is None else v - carried)
        return rate, (jnp.zeros_like(rate) if value is None else value, h)

    if of_tangents or _has_formula(system, q):
        rate, drift, (value, h) = jax.jvp(along, (zero,), (one,), has_aux=True)
        return Kinematics(value, rate, drift, h)

    def rates(s: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Gaps and gap velocities (m,) after the time s."""
        return jax.jvp(lambda s: jnp.atleast_1d(body.gap_function(place(s))), (s,), (one,))

    (value, rate), (_, drift) = jax.jvp(rates, (zero,), (one,))
    return Kinematics(value, rate, drift, normals_at(system, q, t))


def _has_formula(system: System, q: jax.Array) -> bool:
    """Whether the body's normals need no differentiation."""
    return jax.eval_shape(system.body.gaps_and_normals, q) is not None


def normals_at(system: System, q: jax.Array, t: jax.Array) -> jax.Array:
    """N (n, m); by forward differentiation, as gap functions may have loops."""
    if _has_formula(system, q):
        return system.body.normals(seen_from_base(system, q, t))
    still = jnp.zeros(mass_at(system, q).shape[:1], q.dtype)
    return jax.jacfwd(lambda u: gaps(system, system.body.nearby(q, u), t))(still).T


def mass_at(system: System, q: jax.Array) -> jax.Array:
    """M (n,) or (n, n)."""
    return system.body.mass_matrix(q)


def solve_mass(mass: jax.Array, right: jax.Array) -> jax.Array:
    """`M^-1 right`, (n,) or (n, k)."""
    if mass.ndim == 1:
        return right / (mass if right.ndim == 1 else mass[:, None])
    return jax.scipy.linalg.solve(mass, right, assume_a="pos")


def definite(mass: jax.Array) -> jax.Array:
    """Whether M is positive definite."""
    if mass.ndim == 1:
        return jnp.all(mass > 0)
    return jnp.all(jnp.isfinite(jnp.linalg.cholesky(jax.lax.stop_gradient(mass))))


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
    return solve_mass(mass, total + system.body.inertial_force(q, v))
