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

    def displaced(s: Float[Array, ""]) -> Float[Array, " n"]:
        """`B y_b(s)` [m]."""
        return _displaced(system, s)

    _, rate = jax.jvp(displaced, (t,), (one,))
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
    y_b = jnp.atleast_1d(system.base(t))
    return system.base_directions @ y_b


@full_precision
def seen_from_base(
    system: System, q: Float[Array, " nq"], t: Float[Array, ""]
) -> Float[Array, " nq"]:
    """Configuration q displaced by `-B y_b(t)`: the one that an observer on the base
    sees.
    """
    if system.base is None:
        return q
    displacement = _displaced(system, t)
    return system.body.moved(q, -displacement)


def gaps(
    system: System, q: Float[Array, " nq"], t: Float[Array, ""]
) -> Float[Array, " m"]:
    """Gaps f [m] of the configuration seen from the base."""
    seen = seen_from_base(system, q, t)
    f = system.body.gap_function(seen)
    return jnp.atleast_1d(f)


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
        seen = seen_from_base(system, q, t)
        smallest = system.body.least_gap(seen)
        return smallest[None]
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
        seen: Float[Array, " nq"],
    ) -> tuple[Float[Array, " t"], Float[Array, "n t"]]:
        """Tangents H (n, t), with 0 for the displacements along them."""
        h = body.tangents(seen)
        assert h is not None
        first = h[0]
        return jnp.zeros_like(first), h

    if not body.has_formulas:
        normal = _differentiated(system, q, v, t)
        if not friction:
            return normal, None
        return normal, _along(system, q, v, t, tangents)

    def all_directions(
        seen: Float[Array, " nq"],
    ) -> tuple[Float[Array, " m"], Float[Array, "n d"]]:
        """Gaps f (m,), and directions [N, H]: normals, then tangents where there is
        friction.
        """
        f, *directions = body.directions(seen, friction)
        known = [x for x in directions if x is not None]
        return f, jnp.concatenate(known, axis=1)

    f, rate, drift, gradient = _along(system, q, v, t, all_directions)
    m = len(f)
    normal = Kinematics(f, rate[:m], drift[:m], gradient[:, :m])
    if not friction:
        return normal, None
    slip = rate[m:]
    zero = jnp.zeros_like(slip)
    tangent = Kinematics(zero, slip, drift[m:], gradient[:, m:])
    return normal, tangent


def _differentiated(
    system: System, q: Float[Array, " nq"], v: Float[Array, " n"], t: Float[Array, ""]
) -> Kinematics:
    """Kinematics of the gaps by differentiation along (v, 1): f, f' and
    `drift = f''`.
    """
    point, along = _in_time(v, t)
    body = system.body

    def value_at(u: Float[Array, " n"], s: Float[Array, ""]) -> Float[Array, " m"]:
        """Gaps f [m] after the displacement u from q and the time s from t."""
        displaced = body.nearby(q, u)
        return gaps(system, displaced, t + s)

    def gaps_and_rates(
        u: Float[Array, " n"], s: Float[Array, ""]
    ) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
        """Gaps f [m] and their derivative f' [m/s] along (v, 1) at this displacement
        and time.
        """
        return jax.jvp(value_at, (u, s), along)

    here, change = jax.jvp(gaps_and_rates, point, along)
    value, rate = here
    _, drift = change
    seen = seen_from_base(system, q, t)
    normals = body.normals(seen)
    return Kinematics(value, rate, drift, normals)


def _in_time(
    v: Float[Array, " n"], t: Float[Array, ""]
) -> tuple[tuple[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
    """Point (u, s) = (0, 0) of displacement and time, and its rate (v, 1), for
    `jax.jvp`.

    Only the rate depends on v, so that different velocities at one q share all other
    operations.
    """
    u = jnp.zeros_like(v)
    s = jnp.zeros_like(t)
    one = jnp.ones_like(t)
    return (u, s), (v, one)


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
    point, along = _in_time(v, t)

    def rates(
        u: Float[Array, " n"], s: Float[Array, ""]
    ) -> tuple[Float[Array, " d"], tuple[Float[Array, " m"], Float[Array, "n d"]]]:
        """Rates `D^T (v - B y_b')` after the displacement u and the time s; values and
        D there.
        """
        time = t + s
        displaced = system.body.nearby(q, u)
        seen = seen_from_base(system, displaced, time)
        value, h = directions(seen)
        carried = base_velocity(system, time)
        relative = v
        if carried is not None:
            relative = v - carried
        return h.T @ relative, (value, h)

    rate, drift, (value, h) = jax.jvp(rates, point, along, has_aux=True)
    return Kinematics(value, rate, drift, h)


def mass_at(system: System, q: Float[Array, " nq"]) -> Mass:
    """Mass matrix M(q) of the body [kg, kg m^2]."""
    return system.body.mass_matrix(q)


def definite(mass: Mass) -> Bool[Array, ""]:
    """True where M is positive definite: its Cholesky factorization is finite."""
    if mass.ndim == 1:
        return jnp.all(mass > 0)
    mass = jax.lax.stop_gradient(mass)
    any_load = mass[:, 0]
    solved = solve_mass_matrix(mass, any_load)
    finite = jnp.isfinite(solved)
    return jnp.all(finite)


@full_precision
def kinetic(
    system: System, q: Float[Array, " nq"], v: Float[Array, " n"]
) -> Float[Array, ""]:
    """`T = v^T M v / 2` [J]."""
    mass = mass_at(system, q)
    if mass.ndim == 1:
        momentum = mass * v
    else:
        momentum = mass @ v
    return 0.5 * v @ momentum


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
    force = system.force(q, v, t)
    return jnp.asarray(force).astype(v.dtype)


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
    body = system.body
    total = force
    if system.potential is not None:
        gradient = jax.grad(system.potential)(q)
        total = total - body.pulled(q, gradient)
    total = total + body.inertial_force(q, v)
    return solve_mass_matrix(mass, total)
