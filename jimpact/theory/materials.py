"""Material data to contact stiffness: Hertz's elastic spheres and planes."""

from typing import Any

import jax
import jax.numpy as jnp

from jimpact.tools.checks import as_float_array, check_values


def hertz_stiffness(
    modulus: Any,
    poisson: Any,
    radius: Any,
    modulus2: Any = None,
    poisson2: Any = None,
    radius2: Any = None,
) -> jax.Array:
    """Stiffness k of `F = k x^1.5` between two elastic spheres, or a sphere and a plane.

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
        k [N / m^1.5], of the common shape. Valid for x much smaller than R and no plastic flow.

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
    e1, nu1, r1 = (
        as_float_array(name, value)
        for name, value in (("modulus", modulus), ("poisson", poisson), ("radius", radius))
    )
    e2 = e1 if modulus2 is None else as_float_array("modulus2", modulus2)
    nu2 = nu1 if poisson2 is None else as_float_array("poisson2", poisson2)
    r2 = r1 if radius2 is None else as_float_array("radius2", radius2)
    for name, value in (("modulus", e1), ("radius", r1)):
        check_values(name, value, low=0.0, open_low=True)
    for name, value in (("modulus2", e2), ("radius2", r2)):  # infinite: rigid, plane
        check_values(name, jnp.minimum(value, jnp.finfo(value.dtype).max), low=0.0, open_low=True)
    for name, value in (("poisson", nu1), ("poisson2", nu2)):
        check_values(name, value, low=-1.0, high=0.5)
    compliance = (1 - nu1**2) / e1 + (1 - nu2**2) / e2
    curvature = 1 / r1 + 1 / r2
    return 4 / 3 / (compliance * jnp.sqrt(curvature))
