"""Material data of two bodies to stiffness (Hertz) and restitution of their contact."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jimpact.tools.checks import as_float_array, check_choice, check_values

# What engines make of the coefficients of two materials
_RULES: dict[str, Callable[[jax.Array, jax.Array], jax.Array]] = {
    "product": lambda e1, e2: e1 * e2,
    "mean": lambda e1, e2: (e1 + e2) / 2,
    "geometric_mean": lambda e1, e2: jnp.sqrt(e1 * e2),
    "minimum": jnp.minimum,
    "maximum": jnp.maximum,
}


def hertz_stiffness(
    modulus: Any,
    poisson: Any,
    radius: Any,
    modulus2: Any = None,
    poisson2: Any = None,
    radius2: Any = None,
) -> jax.Array:
    """Stiffness k of `F = k x^1.5` of two elastic spheres, or sphere and plane.

    Equation: `k = (4/3) E* sqrt(R*)`, `1/E* = (1 - nu1^2)/E1 + (1 - nu2^2)/E2`,
    `1/R* = 1/R1 + 1/R2`.

    Args:
        modulus: Young's modulus E1 > 0 [Pa].
        poisson: Poisson ratio nu1 in [-1, 0.5].
        radius: R1 > 0 [m].
        modulus2: of the other body [Pa]; None: the same material; `inf`: rigid.
        poisson2: of the other body; None: the same material.
        radius2: R2 [m]; None: an equal sphere; `inf`: a plane.

    Returns:
        k [N / m^1.5], of the common shape. Valid for x much smaller than R and no
        plastic flow.

    Raises:
        ValueError: modulus or radius not positive, Poisson ratio out of range.

    Source: Hertz (1882); Johnson, Contact Mechanics (1985), (4.22)-(4.23).

    >>> import jimpact as ji
    >>> k = ji.theory.hertz_stiffness(216e9, 0.276, 4e-3)  # two steel beads of 8 mm
    >>> f"{float(k):.3e}"
    '6.971e+09'
    >>> plane = ji.theory.hertz_stiffness(216e9, 0.276, 4e-3, radius2=float("inf"))
    >>> round(float(plane / k), 6)  # a plane is stiffer by sqrt(2)
    1.414214
    """
    e1 = as_float_array("modulus", modulus)
    nu1 = as_float_array("poisson", poisson)
    r1 = as_float_array("radius", radius)
    if modulus2 is None:
        e2 = e1
    else:
        e2 = as_float_array("modulus2", modulus2)
    if poisson2 is None:
        nu2 = nu1
    else:
        nu2 = as_float_array("poisson2", poisson2)
    if radius2 is None:
        r2 = r1
    else:
        r2 = as_float_array("radius2", radius2)
    for name, value in (("modulus", e1), ("radius", r1)):
        check_values(name, value, low=0.0, open_low=True)
    for name, value in (("modulus2", e2), ("radius2", r2)):  # infinite: rigid, plane
        finite = jnp.minimum(value, jnp.finfo(value.dtype).max)
        check_values(name, finite, low=0.0, open_low=True)
    for name, value in (("poisson", nu1), ("poisson2", nu2)):
        check_values(name, value, low=-1.0, high=0.5)
    of_first = (1 - nu1**2) / e1
    compliance = of_first + (1 - nu2**2) / e2
    curvature = 1 / r1 + 1 / r2
    return 4 / 3 / (compliance * jnp.sqrt(curvature))


def mindlin_ratio(
    poisson: Any, modulus: Any = None, poisson2: Any = None, modulus2: Any = None
) -> jax.Array:
    """Ratio kappa of tangential to normal stiffness of two spheres, before any slip.

    Equation: `kappa = 2 (1 - nu) / (2 - nu)` of one material, 2/3 to 1 for nu from 1/2
    to 0. Of two, `kappa = 4 G* / E*`, `1/E* = (1 - nu1^2)/E1 + (1 - nu2^2)/E2`,
    `1/G* = 2 (1 + nu1) (2 - nu1)/E1 + 2 (1 + nu2) (2 -
    nu2)/E2`: the `tangential_stiffness` of `LZB` and `Compliant`.

    Args:
        poisson: Poisson ratio nu1 in [-1, 0.5].
        modulus: Young's modulus E1 > 0 [Pa]; needed with another material.
        poisson2: of the other body; None: the same material.
        modulus2: of the other body [Pa]; None: the same material; `inf`: rigid.

    Returns:
        kappa, of the common shape.

    Raises:
        ValueError: Poisson ratio out of range, a modulus not positive, or one of the
            two without the other.

    Source: Mindlin, J. Appl. Mech. 16 (1949) 259; Johnson, Contact Mechanics (1985),
    7.2.

    >>> import jimpact as ji
    >>> round(float(ji.theory.mindlin_ratio(0.3)), 4)  # steel
    0.8235
    >>> round(
    ...     float(ji.theory.mindlin_ratio(0.25, 70e9, 0.3, 210e9)), 4
    ... )  # glass on steel
    0.8487
    """
    nu1 = as_float_array("poisson", poisson)
    if poisson2 is None:
        nu2 = nu1
    else:
        nu2 = as_float_array("poisson2", poisson2)
    for name, nu in (("poisson", nu1), ("poisson2", nu2)):
        check_values(name, nu, low=-1.0, high=0.5)
    given = {"modulus": modulus, "modulus2": modulus2, "poisson2": poisson2}
    missing = [name for name, value in given.items() if value is None]
    if len(missing) == len(given):
        return 2 * (1 - nu1) / (2 - nu1)
    if "modulus" in missing:
        raise ValueError("Argument `modulus` must be given with another material.")
    e1 = as_float_array("modulus", modulus)
    if modulus2 is None:
        e2 = e1
    else:
        e2 = as_float_array("modulus2", modulus2)
    check_values("modulus", e1, low=0.0, open_low=True)
    finite = jnp.minimum(e2, jnp.finfo(e2.dtype).max)
    check_values("modulus2", finite, low=0.0, open_low=True)
    of_first = (1 - nu1**2) / e1
    normal = of_first + (1 - nu2**2) / e2
    shear = (1 + nu1) * (2 - nu1) / e1
    tangential = shear + (1 + nu2) * (2 - nu2) / e2
    return 2 * normal / tangential


def pair_restitution(
    first: Any, second: Any, rule: str, stiffness: Any = None, stiffness2: Any = None
) -> jax.Array:
    """Restitution e of a contact from those of its two materials.

    Equation: rule 'energy' is `e^2 = (e1^2 / k1 + e2^2 / k2) / (1 / k1 + 1 / k2)`. The
    bodies are in series: at the same force F a deformation `x_i` proportional to
    `1 / k_i` gives body i the share `(1 / k_i) / (1 / k1 + 1 / k2)` of the energy of
    compression, of which it returns `e_i^2`. So a soft body decides, and equal bodies
    keep their e. The other rules are those of physics engines, and have no derivation:
    'product', 'mean', 'geometric_mean', 'minimum', 'maximum'.

    Args:
        first: e1 in [0, 1] of a material against itself (or against a rigid body).
        second: e2 in [0, 1].
        rule: one of the six names; there is no default, as they differ.
        stiffness: k1 > 0 of the first body, for rule 'energy' only; in a Hertz contact
            `E / (1 - nu^2)`. Only the ratio k1 / k2 matters.
        stiffness2: k2 > 0; `inf` for a rigid body, which stores no energy, of either.

    Returns:
        e, of the common shape. Derivatives: of the geometric mean infinite at e = 0;
        one-sided of minimum and maximum at equal values, and of rule 'energy' at e1 =
        e2 = 0.

    Raises:
        ValueError: another rule, e outside [0, 1], stiffnesses not positive, missing,
            or given for a rule that has none, both infinite.

    Source: Coaplen, Stronge and Ravani, Int. J. Impact Engineering 30 (2004), 581
    (energy).

    >>> import jimpact as ji
    >>> round(float(ji.theory.pair_restitution(0.9, 0.5, "geometric_mean")), 4)
    0.6708
    >>> stiff, soft = 100e9, 1e9
    >>> round(float(ji.theory.pair_restitution(0.9, 0.5, "energy", stiff, soft)), 4)
    0.5055
    """
    check_choice("rule", rule, (*_RULES, "energy"))
    e1 = as_float_array("first", first)
    e2 = as_float_array("second", second)
    for name, e in (("first", e1), ("second", e2)):
        check_values(name, e, low=0.0, high=1.0)
    both = (("stiffness", stiffness), ("stiffness2", stiffness2))
    given = [name for name, k in both if k is not None]
    if rule != "energy":
        if given:
            raise ValueError(
                f"Argument `{given[0]}` must be left out for rule {rule!r}."
            )
        return _RULES[rule](e1, e2)
    if len(given) < 2:
        raise ValueError(
            "Arguments `stiffness` and `stiffness2` must be given for rule 'energy'."
        )
    k1 = as_float_array("stiffness", stiffness)
    k2 = as_float_array("stiffness2", stiffness2)
    for name, k in (("stiffness", k1), ("stiffness2", k2)):  # infinite: rigid
        finite = jnp.minimum(k, jnp.finfo(k.dtype).max)
        check_values(name, finite, low=0.0, open_low=True)
    check_values("stiffness", jnp.minimum(k1, k2))  # one of them is finite
    share = (1 / k1) / (1 / k1 + 1 / k2)  # of the energy, that of the first body
    square = share * e1**2 + (1 - share) * e2**2
    roots = (jnp.sqrt(share), jnp.sqrt(1 - share))
    own, other = jax.lax.stop_gradient(roots)
    # at e1 = e2 = 0 the root has a slope to each side only
    root = jnp.sqrt(jnp.where(square > 0, square, 1.0))
    return jnp.where(square > 0, root, own * e1 + other * e2)
