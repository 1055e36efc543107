"""Bodies that are given by functions: gaps, mass and, for friction, displacements."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jimpact.bodies.base import CLOSED_BELOW, Body, Parts, parts_at
from jimpact.core.scene import Scene, check_mass
from jimpact.tools.checks import as_float_array
from jimpact.tools.compiling import full_precision


class FunctionBody(Body):
    """A body given by functions of its configuration q (n,), see `System` and
    `scene_from_gaps`.

    Args:
        gap_function: q -> gaps f(q) (m,) [m].
        mass: M (n,), its diagonal, or (n, n), or a function q -> M(q).
        tangent_function: q -> displacements (m,) [m] along the contact planes; None: no
            friction.
    """

    gaps: Callable[[jax.Array], jax.Array]
    mass_argument: Any
    sliding: Callable[[jax.Array], jax.Array | None] | None

    def __init__(self, gap_function: Any, mass: Any, tangent_function: Any = None):
        """Keep the functions; raise a TypeError for what is no function, check a
        constant mass.
        """
        for name, function in (
            ("gap_function", gap_function),
            ("tangent_function", tangent_function),
        ):
            if not (
                callable(function) or (function is None and name != "gap_function")
            ):
                if name == "gap_function":
                    kinds = "a body or a function"
                else:
                    kinds = "a function"
                raise TypeError(
                    f"Argument `{name}` must be {kinds}, but is {function!r}."
                )
        self.gaps = gap_function
        self.sliding = tangent_function
        if callable(mass):
            self.mass_argument = mass
        else:
            self.mass_argument = as_float_array("mass", mass)
            check_mass(self.mass_argument)

    @property
    def functions(self) -> tuple[Any, ...]:
        """The functions of the gaps and of the displacements, and the mass."""
        return self.gaps, self.sliding, self.mass_argument

    @property
    def mass(self) -> Any:
        """M or q -> M(q), the argument `mass`."""
        return self.mass_argument

    def gap_function(self, q: jax.Array) -> jax.Array:
        """Gaps f(q) (m,) [m]."""
        return jnp.atleast_1d(self.gaps(q))

    def tangent_function(self, q: jax.Array) -> jax.Array | None:
        """Displacements (m,) [m] along the contact planes."""
        if self.sliding is None:
            displacements = None
        else:
            displacements = self.sliding(q)
        if displacements is None:
            return None
        return jnp.atleast_1d(displacements)

    def _parts(self, q: jax.Array) -> Parts:
        """Mass, normals, tangents and gaps at q, not compiled."""
        return parts_at(self, q)  # each new lambda would be compiled anew


@full_precision
def scene_from_gaps(
    gap_function: Callable[[jax.Array], jax.Array],
    mass: Any,
    q: Any,
    closed_below: float = CLOSED_BELOW,
) -> Scene:
    """Scene of bodies at `q`; the normals are the gradients of their gaps.

    Equation: `N = grad f(q)`, `M = M(q)`, gaps `f(q)`.

    Args:
        gap_function: q (n,) -> gaps f(q) (m,) [m], written with jax.numpy.
        mass: M (n,) or (n, n), or a function q -> M(q).
        q: (n,) configuration.
        closed_below: gaps with |f| up to this count as closed [m].

    Returns:
        `Scene` of n coordinates and m contacts, without tangents.

    Raises:
        ValueError: penetration (f < -closed_below), or what `Scene` refuses.

    >>> import jax.numpy as jnp, jimpact as ji
    >>> bouncing = ji.scene_from_gaps(lambda q: q[1:] - 0.5, [1.0, 1.0], [0.0, 0.5])
    >>> bouncing.normals.tolist()
    [[0.0], [1.0]]
    """
    return FunctionBody(gap_function, mass).scene(q, closed_below)
