"""One compliant impact during which the geometry turns."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from jimpact._checks import as_float_array, check_kind, check_shape, check_values, in_common_dtype
from jimpact.bodies.base import Body
from jimpact.compiling import quick_jit
from jimpact.contact import delassus_matrix
from jimpact.laws.forces import Force
from jimpact.motion.arguments import check_unbounded, contacts_of
from jimpact.motion.compliant_contact import compliant_motion
from jimpact.motion.flow import Settings, check_rtol
from jimpact.motion.system import System
from jimpact.motion.tables import MotionProblem
from jimpact.scene import gap_velocity

RTOL = 1e-9  # of `turning_impact`
HORIZON = 200.0  # contact times after which an impact is given up; more only delays that
MOST_EVENTS = 1000  # contacts that close or open in one impact; ten times more takes memory only
PENETRATION = 1e-12  # [m] gaps this small are closed where an impact starts, as in `Body.scene`


class TurningImpact(eqx.Module):
    """`velocity` and `position` (n,) when it is over, `duration` () [s], whether it `ended`."""

    velocity: jax.Array
    position: jax.Array
    duration: jax.Array
    ended: jax.Array


def turning_impact(
    gap_function: Body | Callable[[jax.Array], jax.Array],
    mass: Any,
    q: Any,
    velocity: Any,
    force: Force,
    *,
    rtol: float = RTOL,
    max_steps: int = 20_000,
) -> TurningImpact:
    """Compliant impact with M(q) and the gaps f(q) followed: a motion without loads.

    Equation: `M q'' + M' q' - grad_q(q'^T M q') / 2 = grad f(q) F`, until nothing is loaded and no
    gap shrinks. `impact(Compliant(force), scene, velocity)` is the same with M and grad f frozen at
    q; they differ by the order of indentation over size.

    Args:
        gap_function: a `Body` (then `mass` is None), or q (n,) -> gaps (m,) [m].
        mass: M (n,) or (n, n), or a function q -> M(q).
        q: (n,) configuration before, with no penetration.
        velocity: (n,) [m/s, rad/s].
        force: as in `Compliant`.
        rtol: of q, q' and the indentations.
        max_steps: of the integrator.

    Returns:
        `TurningImpact`; `ended` False where it went on for 200 contact times or `max_steps`.
        Derivatives in both modes.

    Raises:
        ValueError: sizes, NaN, penetration, a mass that is not positive, an `rtol` that single
            precision cannot reach. TypeError: no `Force`.

    >>> import jimpact as ji
    >>> block, q, v = ji.Block(1.0, 1.0), [0.0, 0.5, 0.0], [0.0, -0.5, -1.0]
    >>> out = ji.turning_impact(block, None, q, v, ji.Hertz(1e8))
    >>> bool(out.ended), [round(float(v), 2) for v in out.velocity[1:]]
    (True, [0.61, 0.49])
    """
    position, v = as_float_array("q", q), as_float_array("velocity", velocity)
    check_shape("velocity", v, position.shape, "one per coordinate")
    check_values("velocity", v)
    check_kind("force", force, Force)
    check_unbounded("force", force)
    system, force, position, v = in_common_dtype(System(gap_function, mass), force, position, v)
    check_rtol(rtol, position.dtype)
    scene = system.body.scene(position)  # and its checks
    gamma = gap_velocity(scene, v)
    speed = jnp.max(jnp.where(gamma < 0, -gamma, 0.0))
    speed = jnp.where(speed > 0, speed, 1.0)
    reduced = jnp.max(1 / jnp.diagonal(jnp.asarray(delassus_matrix(scene))))
    depth = force.indentation_scale(0.5 * reduced * speed**2 * jnp.ones_like(gamma))
    unit = jax.lax.stop_gradient(jnp.max(depth) / speed)
    return _turning(system, force, position, v, HORIZON * unit, rtol, max_steps)


@quick_jit
def _turning(
    system: System,
    force: Force,
    q: jax.Array,
    v: jax.Array,
    horizon: jax.Array,
    rtol: float,
    max_steps: int,
) -> TurningImpact:
    """The impact as one program, from time 0 to `horizon` () [s] at most."""
    zero = jnp.zeros_like(horizon)
    settings = Settings(
        rtol,
        rtol * 1e-3,
        jnp.asarray(PENETRATION),
        zero,
        max_steps,
        False,
        False,
        horizon,
        zero,
    )
    times, m = jnp.stack([zero, horizon]), contacts_of(system, q)
    problem = MotionProblem(system, force, None, settings, q, v, times, m)
    _, end, apart = compliant_motion(problem, MOST_EVENTS, True)
    return TurningImpact(end.v, end.q, end.t, apart)
