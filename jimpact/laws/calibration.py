"""Requested against measured restitution: the damping that gives a pair its
coefficient.

A pair's coefficient of restitution does not determine what a chain does: forces with
the same e at the same speed spread an impact differently (docs/compliant.md).
"""

import warnings
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from jimpact.core.impacts import impact
from jimpact.core.law import with_parameter
from jimpact.core.scene import chain
from jimpact.laws.compliant import Compliant
from jimpact.laws.forces import Force, UserForce
from jimpact.tools.checks import as_float_array, check_values
from jimpact.tools.compiling import precise_jit
from jimpact.tools.status import CODE, STATUS

# Tolerance of the pair's impact (else the law's default): the calibrated e is right to
# as many digits. Ten times more loses one of them.
RTOL = {"float64": 1e-11}
# ... of forces that cannot be followed so finely, one after the other. Ten times the
# last one:
# e would have four digits.
COARSER = (1e-8, 1e-7, 1e-6, 1e-5)
LEAST = 0.05  # restitution; below, e hardly depends on the damping any more
STRONGEST = 0.99  # s = d / (1 + d) of the largest dimensionless damping d that is tried
# share of `STRONGEST` within which a bisection has met no root; ten times more: as well
END = 1e-9
BISECTIONS = 60  # halvings of s, to rounding in double precision


def measured_restitution(force: Force, mass: Any, speed: Any) -> jax.Array:
    """Coefficient of restitution `e` of one pair: separation over approach speed.

    Equation: `m x'' = -F(x, x')`, `x(0) = 0`, `x'(0) = v`, until the force ends;
    `e = -x'/v`.

    Args:
        force: a contact force; its parameters broadcast with `mass` and `speed`, but
            those of a `UserForce` are passed on as they are.
        mass: reduced mass m > 0 [kg]: `m1 m2 / (m1 + m2)`, or `1 / W_jj` of a contact.
        speed: approach v > 0 [m/s].

    Returns:
        e, of the common shape, right to `RTOL`; where a force cannot be followed so
        finely, to the first of `COARSER` that can be held (inside jit NaN). NaN where
        the impact has no end, with a warning.

    Raises:
        ValueError: mass or speed not positive.

    >>> import jimpact as ji
    >>> round(
    ...     float(
    ...         ji.measured_restitution(ji.KelvinVoigt(1.0, 0.2), mass=1.0, speed=1.0)
    ...     ),
    ...     5,
    ... )
    0.74408
    """
    m = as_float_array("mass", mass)
    v = as_float_array("speed", speed)
    check_values("mass", m, low=0.0, open_low=True)
    check_values("speed", v, low=0.0, open_low=True)
    known = force.pair_restitution(m, v)
    if known is not None:
        return known
    restitution, status = _each(_integrated, force, m, v)
    if isinstance(status, jax.core.Tracer):
        return restitution
    for rtol in COARSER:
        failed = status != CODE["ok"]
        if not failed.any():
            return restitution
        coarser = jnp.asarray(rtol, v.dtype)
        coarse, status_coarse = _each(_bounce, force, m, v, coarser)
        restitution = jnp.where(failed, coarse, restitution)
        status = jnp.where(failed, status_coarse, status)
    codes = set(status.ravel().tolist()) - {CODE["ok"]}
    if codes:
        reasons = {STATUS[code].name for code in codes}
        warnings.warn(
            f"The impact of a pair ends with {', '.join(reasons)}.", stacklevel=2
        )
    return restitution


def calibrate(force: Force, restitution: Any, mass: Any, speed: Any) -> Force:
    """The same force with the damping that gives a pair the requested restitution.

    Solves `measured_restitution(force', mass, speed) = restitution` for the damping; a
    `Bistiffness` takes the coefficient as it is. Differentiable in all arguments, by
    the implicit function theorem.

    Args:
        force: `KelvinVoigt`, `HuntCrossley`, `KuwabaraKono` or `Bistiffness`; its own
            damping does not matter. Or a `UserForce` whose parameters are a dict with
            an entry 'damping', of which up to 99 times the value is tried.
        restitution: e in [0.05, 1], scalar or one per contact.
        mass: reduced mass > 0 [kg].
        speed: of approach > 0 [m/s]; at another speed e differs.

    Returns:
        A force of the same kind.

    Raises:
        TypeError: a force without a damping. ValueError: e out of range, or not reached
            by the largest damping (NaN inside jit).

    >>> import jimpact as ji
    >>> force = ji.calibrate(
    ...     ji.KuwabaraKono(1e9, 0.0), restitution=0.9, mass=1e-3, speed=0.5
    ... )
    >>> round(float(ji.measured_restitution(force, 1e-3, 0.5)), 9)
    0.9
    """
    e = as_float_array("restitution", restitution)
    if force.bistiffness is not None and force.bound is None:
        return with_parameter(force.bistiffness, "restitution", e)
    check_values("restitution", e, low=LEAST, high=1.0)
    m = as_float_array("mass", mass)
    v = as_float_array("speed", speed)
    check_values("mass", m, low=0.0, open_low=True)
    check_values("speed", v, low=0.0, open_low=True)
    scale = force.damping_scale(m, v)
    if scale is None:
        raise TypeError(
            f"Argument `force` must have a damping to find, but is {force!r}; a "
            f"`UserForce` has one as the entry 'damping' of a dict of parameters."
        )
    (damping,) = _each(_damping, force, m, v, e)
    if not isinstance(damping, jax.core.Tracer) and jnp.isnan(damping).any():
        raise ValueError(
            f"Argument `restitution` must be one that the force reaches with a damping "
            f"of up to {STRONGEST / (1 - STRONGEST):.0f} times its scale {scale}, but "
            f"has value {e}."
        )
    return force.with_damping(damping)


@precise_jit
def _each(
    function: Callable[..., tuple[jax.Array, ...]], force: Force, *values: jax.Array
) -> tuple[jax.Array, ...]:
    """`function(force, *values)`, a function of scalars, for each entry of their common
    shape.

    Arrays of the force are broadcast with `values`, but those of a `UserForce` are
    passed on as they are: they need not belong to contacts.
    """
    arrays = eqx.filter(force, eqx.is_array)
    if isinstance(force, UserForce):
        arrays = None
    leaves = jax.tree.leaves((arrays, values))
    shape = jnp.broadcast_shapes(*(jnp.shape(leaf) for leaf in leaves))
    flat = jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf, shape).ravel(), (arrays, values)
    )
    fixed = force
    if arrays is not None:
        fixed = eqx.filter(force, eqx.is_array, inverse=True)

    def of_one(arrays: Any, scalars: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        """The function of one entry."""
        return function(eqx.combine(arrays, fixed), *scalars)

    return tuple(result.reshape(shape) for result in jax.vmap(of_one)(*flat))


def _integrated(
    force: Force, mass: jax.Array, speed: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """e of a mass [kg] that hits a wall at a speed [m/s] to the tolerance `RTOL`, and
    the status.

    Equation: `e = -v+ / v-`; NaN where the impact has no end.
    """
    dtype = str(jnp.result_type(mass, speed))
    return _bounce(force, mass, speed, RTOL.get(dtype))


def _bounce(
    force: Force, mass: jax.Array, speed: jax.Array, rtol: Any
) -> tuple[jax.Array, jax.Array]:
    """e = -v+ / v- () of a mass [kg] that hits a wall at a speed [m/s], and the status.

    e is NaN where the impact has no end. `rtol` None: the default tolerance of the law.
    """
    law = Compliant(force)
    scene = chain(mass[None], wall=True)
    out = impact(law, scene, speed[None], rtol=rtol)
    ended = out.status == CODE["ok"]
    e = -out.velocity[0] / speed
    return jnp.where(ended, e, jnp.nan), out.status


def _damping(
    force: Force, mass: jax.Array, speed: jax.Array, e: jax.Array
) -> tuple[jax.Array]:
    """Damping () with which a pair of reduced `mass` [kg] has the restitution e at a
    speed [m/s].

    Equation: `damping = scale s / (1 - s)` of the force's `damping_scale`, s in [0, 1)
    the root of `e - e(s)`, by bisection; derivatives by the implicit function theorem.
    NaN where no s up to `STRONGEST` is one.
    """
    scale = force.damping_scale(mass, speed)
    assert scale is not None  # `calibrate` has checked

    def excess(s: jax.Array) -> jax.Array:
        """`e - e(s)` (), increasing: restitution asked for less that of this
        damping.
        """
        damped = force.with_damping(scale * s / (1 - s))
        known = damped.pair_restitution(mass, speed)
        if known is None:
            known, _ = _integrated(damped, mass, speed)
        return e - known

    def bisected(f: Callable[[jax.Array], jax.Array], guess: jax.Array) -> jax.Array:
        """The root () of an increasing function f between 0 and `STRONGEST`."""

        def half(
            _: Any, ends: tuple[jax.Array, jax.Array]
        ) -> tuple[jax.Array, jax.Array]:
            """The half of an interval (low, high) in which f changes sign."""
            low, high = ends
            middle = (low + high) / 2
            below = f(middle) < 0
            return jnp.where(below, middle, low), jnp.where(below, high, middle)

        ends = jnp.zeros_like(guess), jnp.full_like(guess, STRONGEST)
        low, high = jax.lax.fori_loop(0, BISECTIONS, half, ends)
        return (low + high) / 2

    def scalar_solve(
        linear: Callable[[jax.Array], jax.Array], right: jax.Array
    ) -> jax.Array:
        """x with `linear(x) = right`, a linear function of a scalar."""
        return right / linear(jnp.ones_like(right))

    s = jax.lax.custom_root(excess, jnp.zeros_like(e), bisected, scalar_solve)
    reached = s < STRONGEST * (1 - END)
    damping = jnp.where(reached, scale * s / (1 - s), jnp.nan)
    return (damping,)
