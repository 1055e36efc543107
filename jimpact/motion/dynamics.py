"""Gaps, their rates and accelerations, and the acceleration that forces alone give.

Dimensions of arrays in this folder: nq coordinates q, n velocities v (nq = n but for
bodies with quaternions), m contacts, t tangential directions (m in the plane, 2 m in
space), k = m + t rows of contact space.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jimpact.motion.system import System
from jimpact.numerics.dense import solve_mass_matrix
from jimpact.tools.compiling import full_precision
from jimpact.tools.precision import precision

Mass = Float[Array, " n"] | Float[Array, "n n"]  # M, its diagonal or all of it


def not_rounding(share: float, dtype: jnp.dtype) -> float:
    """The larger one of `share` and 4 eps: a smaller share of a number is rounding."""
    return max(share, precision(dtype).rounding)


class Kinematics(NamedTuple):
    """Gaps of the contacts, or displacements along their tangents, and derivatives in
    time.

    Equation: `rate = gradient^T (v - B y_b')`, `d rate / dt = gradient^T v' + drift`.
    """

    # gaps [m]; 0 of tangential displacements, of which only rates count
    value: Float[Array, " d"]
    rate: Float[Array, " d"]  # [m/s] as seen from the base
    drift: Float[Array, " d"]  # [m/s^2] derivative of the rate for v' = 0
    gradient: Float[Array, "n d"]


def base_velocity(system: System, t: Float[Array, ""]) -> Float[Array, " n"] | None:
    """Velocity `B y_b'(t)` of a moving base in all coordinates [m/s]; None without a
    base.
    """
    if system.base is None:
        return None
    one = jnp.ones_like(t)
    _, rate = jax.jvp(lambda s: _displaced(system, s), (t,), (one,))
    return rate


def carried_along(
    system: System, v: Float[Array, " n"], t: Float[Array, ""]
) -> Float[Array, " n"]:
    """Velocity `B y_b'(t)` of the base [m/s], 0 without one."""
    velocity = base_velocity(system, t)
    if velocity is None:
        return jnp.zeros_like(v)
    return velocity


@full_precision
def _displaced(system: System, t: Float[Array, ""]) -> Float[Array, " n"]:
    """Displacement `B y_b(t)` of the base in all coordinates [m]."""
    assert system.base is not None
    assert system.base_directions is not None
    return system.base_directions @ jnp.atleast_1d(system.base(t))


@full_precision
def seen_from_base(
    system: System, q: Float[Array, " nq"], t: Float[Array, ""]
) -> Float[Array, " nq"]:
    """Configuration q displaced by `-B y_b(t)`: the one that an observer on the base
    sees.
    """
    if system.base is None:
        return q
    return system.body.moved(q, -_displaced(system, t))


def gaps(
    system: System, q: Float[Array, " nq"], t: Float[Array, ""]
) -> Float[Array, " m"]:
    """Gaps f [m] of the configuration seen from the base."""
    seen = seen_from_base(system, q, t)
    return jnp.atleast_1d(system.body.gap_function(seen))


def is_pile(system: System) -> bool:
    """True for a body of many contacts (`Bodies` with `room`), which stores only closed
    ones.
    """
    return system.body.pair_count is not None


def recorded_gaps(
    system: System, q: Float[Array, " nq"], t: Float[Array, ""]
) -> Float[Array, " m"]:
    """Gaps [m] of all contacts, which the record of a motion holds; of a pile the least
    alone.
    """
    if is_pile(system):
        return system.body.least_gap(seen_from_base(system, q, t))[None]
    return gaps(system, q, t)


def kinematics(
    system: System,
    q: Float[Array, " nq"],
    v: Float[Array, " n"],
    t: Float[Array, ""],
    friction: bool = False,
) -> tuple[Kinematics, Kinematics | None]:
    """Kinematics of the gaps, and with friction of the tangential displacements.

    A body with formulas gives normals and tangents, whose derivative in time is the
    drift; of other bodies gaps are differentiated twice.
    """
    body = system.body

    def tangents(
        at: Float[Array, " nq"],
    ) -> tuple[Float[Array, " t"], Float[Array, "n t"]]:
        """Tangents H (n, t), with 0 for the displacements along them."""
        h = body.tangents(at)
        assert h is not None
        return jnp.zeros_like(h[0]), h

    if not body.has_formulas:
        normal = _differentiated(system, q, v, t)
        return normal, _along(system, q, v, t, tangents) if friction else None

    def all_directions(
        at: Float[Array, " nq"],
    ) -> tuple[Float[Array, " m"], Float[Array, "n d"]]:
        """Gaps f (m,), and directions [N, H]: normals, then tangents where there is
        friction.
        """
        known = body.directions(at, friction)
        each = [x for x in known[1:] if x is not None]
        return known.gaps, jnp.concatenate(each, axis=1)

    both = _along(system, q, v, t, all_directions)
    m = len(both.value)
    gradient = both.gradient[:, :m]
    normal = Kinematics(both.value, both.rate[:m], both.drift[:m], gradient)
    if not friction:
        return normal, None
    slip = both.rate[m:]
    zero = jnp.zeros_like(slip)
    tangent = Kinematics(zero, slip, both.drift[m:], both.gradient[:, m:])
    return normal, tangent


def _differentiated(
    system: System, q: Float[Array, " nq"], v: Float[Array, " n"], t: Float[Array, ""]
) -> Kinematics:
    """Kinematics of the gaps by differentiation along (v, 1): f, f' and
    `drift = f''`.
    """
    here, along = _in_time(v, t)

    def value_at(u: Float[Array, " n"], s: Float[Array, ""]) -> Float[Array, " m"]:
        """Gaps f [m] after the displacement u from q and the time s from t."""
        return gaps(system, system.body.nearby(q, u), t + s)

    def gaps_and_rates(
        u: Float[Array, " n"], s: Float[Array, ""]
    ) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
        """Gaps f [m] and their derivative f' [m/s] along (v, 1) at this displacement
        and time.
        """
        return jax.jvp(value_at, (u, s), along)

    (value, rate), (_, drift) = jax.jvp(gaps_and_rates, here, along)
    normals = system.body.normals(seen_from_base(system, q, t))
    return Kinematics(value, rate, drift, normals)


def _in_time(
    v: Float[Array, " n"], t: Float[Array, ""]
) -> tuple[tuple[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
    """Point (u, s) = (0, 0) of displacement and time, and its rate (v, 1), for
    `jax.jvp`.

    Only the rate depends on v, so that different velocities at one q share all other
    operations.
    """
    point = jnp.zeros_like(v), jnp.zeros_like(t)
    return point, (v, jnp.ones_like(t))


def _along(
    system: System,
    q: Float[Array, " nq"],
    v: Float[Array, " n"],
    t: Float[Array, ""],
    directions: Callable[
        [Float[Array, " nq"]], tuple[Float[Array, " m"], Float[Array, "n d"]]
    ],
) -> Kinematics:
    """Kinematics along directions D (n, d) by one derivative:
    `rate = D^T (v - B y_b')`.

    `directions`: configuration seen from the base -> values (m,), which are passed on,
    and D.
    """
    here, along = _in_time(v, t)

    def rates(
        u: Float[Array, " n"], s: Float[Array, ""]
    ) -> tuple[Float[Array, " d"], tuple[Float[Array, " m"], Float[Array, "n d"]]]:
        """Rates `D^T (v - B y_b')` after the displacement u and the time s; values and
        D there.
        """
        displaced = system.body.nearby(q, u)
        value, h = directions(seen_from_base(system, displaced, t + s))
        carried = base_velocity(system, t + s)
        rate = h.T @ (v if carried is None else v - carried)
        return rate, (value, h)

    rate, drift, (value, h) = jax.jvp(rates, here, along, has_aux=True)
    return Kinematics(value, rate, drift, h)


def mass_at(system: System, q: Float[Array, " nq"]) -> Mass:
    """Mass matrix M(q) of the body [kg, kg m^2]."""
    return system.body.mass_matrix(q)


def definite(mass: Mass) -> Bool[Array, ""]:
    """True where M is positive definite: its Cholesky factorization is finite."""
    if mass.ndim == 1:
        return jnp.all(mass > 0)
    mass = jax.lax.stop_gradient(mass)
    solved = solve_mass_matrix(mass, mass[:, 0])
    return jnp.all(jnp.isfinite(solved))


@full_precision
def kinetic(
    system: System, q: Float[Array, " nq"], v: Float[Array, " n"]
) -> Float[Array, ""]:
    """`T = v^T M v / 2` [J]."""
    mass = mass_at(system, q)
    return 0.5 * v @ (mass * v if mass.ndim == 1 else mass @ v)


def potential(system: System, q: Float[Array, " nq"]) -> Float[Array, ""]:
    """Potential energy V(q) [J], 0 without a potential."""
    if system.potential is None:
        return jnp.zeros((), q.dtype)
    return system.potential(q)


def user_force(
    system: System, q: Float[Array, " nq"], v: Float[Array, " n"], t: Float[Array, ""]
) -> Float[Array, " n"]:
    """Generalized force F(q, v, t) [N, N m] of the argument `force`, without that of
    V.
    """
    if system.force is None:
        return jnp.zeros_like(v)
    force = jnp.asarray(system.force(q, v, t))
    return force.astype(v.dtype)


def free_acceleration(
    system: System,
    q: Float[Array, " nq"],
    v: Float[Array, " n"],
    force: Float[Array, " n"],
    mass: Mass,
) -> Float[Array, " n"]:
    """Acceleration v' [m/s^2] without contact forces:
    `M v' = F - grad V + (inertial forces)`.

    `force` is F, `mass` is M at q.
    """
    total = force
    if system.potential is not None:
        gradient = jax.grad(system.potential)(q)
        total = total - system.body.pulled(q, gradient)
    return solve_mass_matrix(mass, total + system.body.inertial_force(q, v))
