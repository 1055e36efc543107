"""Gaps in units of the indentation, and the outcome linearized in the gaps."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact.core.contact import delassus_matrix
from jimpact.core.law import Law, check_law
from jimpact.core.scene import Scene, as_velocity, gap_velocity
from jimpact.numerics.tridiagonal import diagonal
from jimpact.tools.checks import is_traced
from jimpact.tools.records import readable_unit

# Gaps over delta_c that are described as touching (below) and as wide (above): the
# crossover between the two is about 2 delta_c wide.
NEARLY_TOUCHING = 0.1
WIDE = 2.0
DELTA_C = "delta_c: indentation of a contact at the largest approach speed of the scene"


class GapScale(eqx.Module):
    """Indentation scale `delta` (m,) [m] of contacts, and their `gaps` (m,) [m]."""

    delta: jax.Array
    gaps: jax.Array

    @property
    def ratio(self) -> jax.Array:
        """Gaps in units of delta_c (m,)."""
        return self.gaps / self.delta

    def __str__(self) -> str:
        """A line for each gap, and the definition of delta_c."""
        if is_traced(self.delta):
            return repr(self)
        rows = enumerate(zip(np.asarray(self.gaps), np.asarray(self.delta)))
        lines = [f"gap {j + 1} is {_in_words(gap, delta)}" for j, (gap, delta) in rows]
        return "\n".join([*lines, DELTA_C])


def _in_words(gap: float, delta: float) -> str:
    """A gap [m] in units of the indentation `delta` [m], and its effect, in words."""
    if delta == 0:
        return f"{_length(gap)}: nothing approaches"
    scale = f"delta_c = {_length(delta)}"
    if gap == 0:
        return f"closed ({scale})"
    ratio = gap / delta
    if ratio < NEARLY_TOUCHING:
        meaning = "much as if touching"
    elif ratio < WIDE:
        meaning = "the collisions overlap, and the gap decides the outcome"
    else:
        meaning = "wide, its collisions come one after another"
    return f"{ratio:.3g} delta_c ({scale}): {meaning}"


def _length(metres: float) -> str:
    """A length [m] as text, in a unit with one to three digits before the point."""
    unit, size = readable_unit("m", metres or 1.0)
    return f"{metres / size:.3g} {unit}"


def gap_scale(scene: Scene, law: Law, velocity: Any) -> GapScale:
    """Indentation scale `delta_c` of every contact, by which a gap is small or large.

    Equation: `delta_c = (m v^2 / k)^(1 / (eta + 1))` with the largest approach speed v
    of the scene and `m_j = 2 / W_jj`, the mass of two equal balls (in general
    `2 m1 m2 / (m1 + m2)`); for forces other than power laws
    `F(delta_c) delta_c = m v^2`.

    Args:
        scene: its gaps, None: all closed.
        law: a `Compliant`, an `LZB`, or another one with a `contact_force`.
        velocity: v- (n,) [m/s].

    Returns:
        `GapScale`; `print` says it in words. 0 where nothing approaches.

    Raises:
        TypeError: a law without indentation.

    >>> import jimpact as ji
    >>> scene = ji.chain(
    ...     [0.0665, 0.0665, 0.0665], gaps=[0.0, 1e-4]
    ... )  # one-inch steel balls
    >>> print(
    ...     ji.theory.gap_scale(scene, ji.Compliant(ji.Hertz(1.2e10)), [1.0, 0.0, 0.0])
    ... )
    gap 1 is closed (delta_c = 31.4 µm)
    gap 2 is 3.18 delta_c (delta_c = 31.4 µm): wide, its collisions come ...
    delta_c: indentation of a contact at the largest approach speed of the scene
    """
    v = as_velocity(scene, velocity, finite=True)
    force = law.contact_force
    if force is None:
        raise TypeError(
            f"Argument `law` must have a `contact_force`, by which its contacts indent "
            f"(Compliant, LZB), but is {law!r}."
        )
    check_law(law, scene, v.dtype)
    speed = jnp.maximum(jnp.max(-gap_velocity(scene, v)), 0.0)
    work = 2 / diagonal(delassus_matrix(scene)) * speed**2
    if force.bistiffness is not None and force.bound is None:
        eta = jnp.asarray(force.bistiffness.exponent, work.dtype)
        delta = (work / force.bistiffness.stiffness) ** (1 / (eta + 1))
    else:
        delta = force.indentation_scale(0.5 * work)
    if scene.gaps is None:
        gaps = jnp.zeros_like(work)
    else:
        gaps = scene.gaps
    return GapScale(jnp.where(speed > 0, delta, 0.0), gaps)
