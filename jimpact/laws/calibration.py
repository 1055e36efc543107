"""Requested against measured restitution: the damping that gives a pair its coefficient.

A pair's coefficient of restitution does not fix what a chain does: forces with the same e at the
same speed differ in how they spread an impact. `compare_rheologies` shows it.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx

from jimpact._checks import as_float_array, check_per_contact, check_values
from jimpact.contact import delassus_matrix
from jimpact.impacts import impact
from jimpact.law import with_parameter
from jimpact.laws.compliant import Compliant
from jimpact.laws.forces import Bistiffness, Force, HuntCrossley, KelvinVoigt, KuwabaraKono
from jimpact.methods.comparison import Comparison, compare
from jimpact.scene import Scene, chain, gap_velocity
from jimpact.solvers.tridiagonal import diagonal

RTOL = {"float64": 1e-11}  # of the pair's impact; else the law's default
LEAST = 0.05  # restitution: below, the dampers are so strong that e hardly depends on them
STRONGEST = 0.99  # s = d / (1 + d) of the largest dimensionless damping d that is tried
BISECTIONS = 60  # halvings of s, to rounding


def measured_restitution(force: Force, mass: Any, speed: Any) -> jax.Array:
    """Coefficient of restitution `e` of one pair: separation over approach speed.

    Equation: `m x'' = -F(x, x')`, `x(0) = 0`, `x'(0) = v`, until the force ends; `e = -x'/v`.

    Args:
        force: a contact force; its parameters broadcast with `mass` and `speed`.
        mass: reduced mass m > 0 [kg]: `m1 m2 / (m1 + m2)`, or `1 / W_jj` of a contact.
        speed: approach v > 0 [m/s].

    Returns:
        e, of the common shape; NaN where the impact has no end.

    Raises:
        ValueError: mass or speed not positive.

    >>> import jimpact as ji
    >>> round(float(ji.measured_restitution(ji.KelvinVoigt(1.0, 0.2), mass=1.0, speed=1.0)), 5)
    0.74408
    """
    m, v = as_float_array("mass", mass), as_float_array("speed", speed)
    check_values("mass", m, low=0.0, open_low=True)
    check_values("speed", v, low=0.0, open_low=True)
    known = force.pair_restitution(m, v)
    return _each(_integrated, force, m, v) if known is None else known


def calibrate(force: Force, restitution: Any, mass: Any, speed: Any) -> Force:
    """The same force with the damping that gives a pair the requested restitution.

    Solves `measured_restitution(force', mass, speed) = restitution` for the damping; a
    `Bistiffness` takes the coefficient as it is. Differentiable in all arguments, by the implicit
    function theorem.

    Args:
        force: `KelvinVoigt`, `HuntCrossley`, `KuwabaraKono` or `Bistiffness`; its own damping does
            not matter.
        restitution: e in [0.05, 1], scalar or one per contact.
        mass: reduced mass > 0 [kg].
        speed: of approach > 0 [m/s]; at another speed e differs.

    Returns:
        A force of the same kind.

    Raises:
        TypeError: a force without a damping (a user's own). ValueError: e out of range.

    >>> import jimpact as ji
    >>> force = ji.calibrate(ji.KuwabaraKono(1e9, 0.0), restitution=0.9, mass=1e-3, speed=0.5)
    >>> round(float(ji.measured_restitution(force, 1e-3, 0.5)), 9)
    0.9
    """
    e = as_float_array("restitution", restitution)
    if force.bistiffness is not None:
        return with_parameter(force.bistiffness, "restitution", e)
    check_values("restitution", e, low=LEAST, high=1.0)
    m, v = as_float_array("mass", mass), as_float_array("speed", speed)
    check_values("mass", m, low=0.0, open_low=True)
    check_values("speed", v, low=0.0, open_low=True)
    strong = force.damping_scale(m, v)
    if strong is None:
        raise TypeError(f"Argument `force` must have a damping to find, but is {force!r}.")
    undamped = with_parameter(force, "damping", jnp.zeros_like(strong))
    return with_parameter(force, "damping", _each(_damping, undamped, m, v, e))


def compare_rheologies(
    scene: Scene, velocity: Any, restitution: Any, stiffness: Any = 1.0
) -> Comparison:
    """Outcomes of all contact forces whose pairs have the same restitution at this approach.

    Each contact is calibrated at its reduced mass `1/W_jj` and the largest approach speed. The
    linear forces get the stiffness that reaches the same largest indentation as Hertz's:
    `k_linear = 0.8 k sqrt(x_max)`.

    Args:
        scene: n coordinates, m contacts, with gaps or without.
        velocity: v- (n,) [m/s]; something must approach.
        restitution: e in [0.05, 1], scalar or (m,).
        stiffness: Hertz k, scalar or (m,) [N / m^1.5].

    Returns:
        `Comparison` with an entry for each force; `ji.plot.rheologies` draws it.

    Raises:
        ValueError: nothing approaches, restitution or stiffness out of range.

    >>> import jimpact as ji
    >>> found = ji.compare_rheologies(ji.chain([1.0, 1.0, 1.0]), [1.0, 0.0, 0.0], 0.9)
    >>> for name, entry in found.entries.items():
    ...     print(f"{name:20}", *(f"{float(v):7.3f}" for v in entry.outcome.velocity))
    Hertz, bistiffness    -0.009   0.104   0.904
    linear, bistiffness   -0.065   0.167   0.898
    Kelvin-Voigt          -0.098   0.191   0.907
    Hunt-Crossley         -0.039   0.123   0.916
    Kuwabara-Kono         -0.039   0.124   0.916
    """
    k = as_float_array("stiffness", stiffness)
    check_values("stiffness", k, low=0.0, open_low=True)
    forces = forces_of_equal_restitution(scene, velocity, restitution, k)
    return compare(scene, velocity, {name: Compliant(force) for name, force in forces.items()})


def forces_of_equal_restitution(
    scene: Scene, velocity: Any, restitution: Any, stiffness: jax.Array
) -> dict[str, Force]:
    """The forces that `compare_rheologies` compares, each with arrays of shape (m,)."""
    for name, value in (("restitution", restitution), ("stiffness", stiffness)):
        check_per_contact(name, value, scene.contacts)
    mass = 1 / diagonal(delassus_matrix(scene))
    speed = jnp.max(-gap_velocity(scene, velocity))
    check_values("velocity: its largest approach", speed, low=0.0, open_low=True)
    deepest = (1.25 * mass * speed**2 / stiffness) ** 0.4
    k, linear = jnp.broadcast_to(stiffness, mass.shape), 0.8 * stiffness * jnp.sqrt(deepest)
    e = as_float_array("restitution", restitution)
    none = jnp.zeros_like(k)
    undamped: dict[str, Force] = {
        "Hertz, bistiffness": Bistiffness(k, 1.5),
        "linear, bistiffness": Bistiffness(linear, 1.0),
        "Kelvin-Voigt": KelvinVoigt(linear, none),
        "Hunt-Crossley": HuntCrossley(k, none),
        "Kuwabara-Kono": KuwabaraKono(k, none),
    }
    return {name: calibrate(force, e, mass, speed) for name, force in undamped.items()}


@eqx.filter_jit
def _each(function: Any, force: Force, *values: jax.Array) -> jax.Array:
    """`function(force, *values)` of scalars, over their common shape."""
    arrays = eqx.filter(force, eqx.is_array)
    shapes = [leaf.shape for leaf in jax.tree.leaves(arrays)]
    shape = jnp.broadcast_shapes(*shapes, *(jnp.shape(z) for z in values))
    spread = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, shape).ravel(), (arrays, values))
    fixed = eqx.filter(force, eqx.is_array, inverse=True)
    run = jax.vmap(lambda leaves, rest: function(eqx.combine(leaves, fixed), *rest))
    return run(*spread).reshape(shape)


def _integrated(force: Force, mass: jax.Array, speed: jax.Array) -> jax.Array:
    """e of one pair by its impact against a wall; NaN where it does not end."""
    law = Compliant(force, rtol=RTOL.get(str(jnp.result_type(mass, speed))))
    out = impact(law, chain(mass[None], wall=True), speed[None])
    return jnp.where(out.status == 0, -out.velocity[0] / speed, jnp.nan)


def _damping(force: Force, mass: jax.Array, speed: jax.Array, e: jax.Array) -> jax.Array:
    """The damping with which one pair has the restitution e, all arguments scalars."""
    unit = force.damping_scale(mass, speed)

    def excess(s: jax.Array, args: Any) -> jax.Array:
        """e less that of the damping `unit s / (1 - s)`: from 0 on, s from 0 to 1."""
        force, mass, speed, e, unit = args
        damped = with_parameter(force, "damping", unit * s / (1 - s))
        known = damped.pair_restitution(mass, speed)
        return e - (_integrated(damped, mass, speed) if known is None else known)

    solver = optx.Bisection(rtol=0.0, atol=float(jnp.finfo(e.dtype).eps), flip=False)
    ends = {"lower": jnp.zeros_like(e), "upper": jnp.full_like(e, STRONGEST)}
    args = (force, mass, speed, e, unit)
    s = optx.root_find(
        excess, solver, 0.1 * jnp.ones_like(e), args, ends, max_steps=BISECTIONS, throw=False
    ).value
    return unit * s / (1 - s)
