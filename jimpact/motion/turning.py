"""Impacts whose geometry moves while they last: how good frozen M and N are."""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp

from jimpact._checks import as_float_array, check_shape, check_values, is_traced
from jimpact.bodies.base import scene_from_gaps
from jimpact.contact import delassus_matrix
from jimpact.laws.forces import Bistiffness, Force
from jimpact.scene import gap_velocity
from jimpact.solvers.tridiagonal import diagonal

RTOL = 1e-9
LONGEST_STEP = 0.2  # contact times: no closing is stepped over
HORIZON = 200.0  # contact times after which an impact is given up


class TurningImpact(eqx.Module):
    """`velocity` and `position` (n,) when it is over, `duration` () [s], whether it `ended`."""

    velocity: jax.Array
    position: jax.Array
    duration: jax.Array
    ended: jax.Array


def turning_impact(
    gap_function: Callable[[jax.Array], jax.Array],
    mass: Any,
    q: Any,
    velocity: Any,
    force: Force,
    *,
    rtol: float = RTOL,
    max_steps: int = 20_000,
) -> TurningImpact:
    """Compliant impact with M(q) and the gaps f(q) followed through the motion, by diffrax.

    Equation: `M q'' + M' q' - grad_q(q'^T M q') / 2 = grad f(q) F`, `x_j = -f_j(q)`,
    `F_j = max(force(x_j, x_j'), 0)` where `x_j > 0`, until nothing is loaded and no gap shrinks.
    `impact(Compliant(force), scene_from_gaps(gap_function, mass, q), velocity)` is the same with
    M and grad f frozen at q; they differ by the order of indentation over size.

    Args:
        gap_function: q (n,) -> gaps (m,) [m], written with jax.numpy.
        mass: M (n,) or (n, n), or a function q -> M(q).
        q: (n,) configuration before, with no penetration.
        velocity: (n,).
        force: of `rheology.py`, without memory: a `Bistiffness` must have restitution 1.
        rtol: of diffrax, on q and q'.
        max_steps: of diffrax.

    Returns:
        `TurningImpact`; `ended` False where it went on for 200 contact times or `max_steps`.
        No other forces act (no gravity). Reverse mode only (diffrax's default adjoint).

    >>> import jimpact as ji
    >>> block = ji.Block(1.0, 1.0)
    >>> q, v = [0.0, 0.5, 0.0], [0.0, -0.5, -1.0]
    >>> out = ji.turning_impact(block.gap_function, block.mass, q, v, ji.Hertz(1e8))
    >>> bool(out.ended), [round(float(v), 2) for v in out.velocity[1:]]
    (True, [0.61, 0.49])
    """
    position, v = as_float_array("q", q), as_float_array("velocity", velocity)
    check_values("q", position)
    check_shape("velocity", v, position.shape, "one per coordinate")
    check_values("velocity", v)
    if not isinstance(force, Force):
        raise TypeError(f"Argument `force` must be a contact force, but has value {force!r}.")
    if isinstance(force, Bistiffness) and not is_traced(force.restitution):
        check_values("force: its restitution", force.restitution, low=1.0, high=1.0)
    scene = scene_from_gaps(gap_function, mass, position)  # and its checks
    speed = jnp.max(-gap_velocity(scene, v))
    reduced = jnp.max(1 / diagonal(delassus_matrix(scene)))
    moving = speed > 0
    speed = jnp.where(moving, speed, 1.0)
    depth = force.indentation_scale(0.5 * reduced * speed**2 * jnp.ones(scene.contacts, v.dtype))
    unit = jax.lax.stop_gradient(jnp.max(depth) / speed)
    return _integrate(gap_function, mass, position, v, force, unit, moving, rtol, max_steps)


def _matrix(mass: Any, q: jax.Array) -> jax.Array:
    m = jnp.asarray(mass(q) if callable(mass) else mass, q.dtype)
    return jnp.diag(m) if m.ndim == 1 else m


@eqx.filter_jit
def _integrate(
    gap_function: Callable[[jax.Array], jax.Array],
    mass: Any,
    q: jax.Array,
    v: jax.Array,
    force: Force,
    unit: jax.Array,
    moving: jax.Array,
    rtol: float,
    max_steps: int,
) -> TurningImpact:
    def gaps(q: jax.Array) -> jax.Array:
        return jnp.atleast_1d(gap_function(q))

    def rates(_: Any, y: tuple[jax.Array, jax.Array], args: Any) -> tuple[jax.Array, jax.Array]:
        q, v = y
        f, pull = jax.vjp(gaps, q)
        gamma = jax.jvp(gaps, (q,), (v,))[1]
        push = jnp.where(f < 0, jnp.maximum(force.force(jnp.maximum(-f, 0.0), -gamma), 0.0), 0.0)
        right = pull(push)[0]
        if callable(mass):
            moved = jax.jvp(lambda q: _matrix(mass, q), (q,), (v,))[1] @ v
            right = right - moved + 0.5 * jax.grad(lambda q: v @ _matrix(mass, q) @ v)(q)
        return v, jnp.linalg.solve(_matrix(mass, q), right)

    def over(t: Any, y: tuple[jax.Array, jax.Array], *_: Any, **__: Any) -> jax.Array:
        f, gamma = jax.jvp(gaps, (y[0],), (y[1],))
        return (t > 0) & jnp.all((f >= 0) & (gamma >= 0))

    depth = unit * jnp.max(jnp.abs(jax.jvp(gaps, (q,), (v,))[1]))
    tolerance = (rtol * depth, rtol * jnp.max(jnp.abs(v)))
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(rates),
        diffrax.Dopri8(),
        t0=0.0,
        t1=jnp.where(moving, HORIZON, 0.1) * unit,
        dt0=1e-3 * unit,
        y0=(q, v),
        stepsize_controller=diffrax.PIDController(
            rtol=0.0,
            atol=1.0,
            dtmax=LONGEST_STEP * unit,
            norm=lambda e: jnp.maximum(
                jnp.max(jnp.abs(e[0])) / tolerance[0], jnp.max(jnp.abs(e[1])) / tolerance[1]
            ),
        ),
        event=diffrax.Event(over),
        max_steps=max_steps,
        throw=False,
    )
    (position,), (velocity,) = solution.ys
    ended = over(jnp.asarray(1.0), (position, velocity)) | ~moving
    return TurningImpact(velocity, position, solution.ts[0], ended)
