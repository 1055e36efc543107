"""A mechanical system in motion: gaps, mass, forces, base."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from jimpact._checks import as_float_array, check_values
from jimpact.scene import check_mass

STANDARD_GRAVITY = 9.80665  # m/s^2


class System(eqx.Module):
    """Everything that moves a system but its impacts; a pytree, as far as its functions are.

    Equation: `M(q) q'' = F(q, q', t) - grad V(q) - (Coriolis terms) + N lambda_n + H lambda_t`
    with `N = grad f(q_r)`, `H = grad h(q_r)`, `q_r = q - B y_b(t)` the position seen from the base.

    Args:
        gap_function: q_r (n,) -> gaps f (m,) [m], written with jax.numpy.
        mass: M: (n,), (n, n), or a function q -> M(q); its Coriolis terms follow by
            differentiation of `T = v^T M(q) v / 2`.
        force: (q, v, t) -> generalized forces (n,); None: none.
        potential: q -> V () [J], its forces are `-grad V`; None: 0 (see `gravity`).
        tangent_function: q_r -> tangential displacements h (m,) [m] of the contacts (planar);
            their gradients are the tangents. None: no friction possible.
        base: t -> displacement y_b (d,) [m] of a moving base, written with jax.numpy.
        base_directions: B (n, d): how q changes when everything moves with the base.

    Functions that are `equinox.Module`s may hold arrays: `simulate` is differentiable in them. A
    new lambda is a new function to JAX, and compiled anew.

    Raises:
        ValueError: a mass that is not positive definite, a base without its directions.

    >>> import jax.numpy as jnp, jimpact as ji
    >>> ball = ji.System(lambda q: q[1:] - 0.5, [2.0, 2.0], potential=ji.gravity([0.0, 2.0]))
    >>> float(ball.potential(jnp.array([0.0, 1.0])))
    19.6133
    """

    gap_function: Callable[[jax.Array], jax.Array]
    mass: Any
    force: Callable[[jax.Array, jax.Array, jax.Array], jax.Array] | None
    potential: Callable[[jax.Array], jax.Array] | None
    tangent_function: Callable[[jax.Array], jax.Array] | None
    base: Callable[[jax.Array], jax.Array] | None
    base_directions: jax.Array | None

    def __init__(
        self,
        gap_function: Callable[[jax.Array], jax.Array],
        mass: Any,
        force: Callable[[jax.Array, jax.Array, jax.Array], jax.Array] | None = None,
        potential: Callable[[jax.Array], jax.Array] | None = None,
        tangent_function: Callable[[jax.Array], jax.Array] | None = None,
        base: Callable[[jax.Array], jax.Array] | None = None,
        base_directions: Any = None,
    ):
        given = {
            "gap_function": gap_function,
            "force": force,
            "potential": potential,
            "tangent_function": tangent_function,
            "base": base,
        }
        for name, function in given.items():
            if not (callable(function) or (function is None and name != "gap_function")):
                raise TypeError(f"Argument `{name}` must be a function, but is {function!r}.")
        self.gap_function, self.force, self.potential = gap_function, force, potential
        self.tangent_function, self.base = tangent_function, base
        if callable(mass):
            self.mass = mass
        else:
            self.mass = as_float_array("mass", mass)
            check_mass(self.mass)
        if (base is None) != (base_directions is None):
            raise ValueError(
                "Argument `base_directions` must be given with `base`, and only with it."
            )
        self.base_directions = None
        if base_directions is not None:
            self.base_directions = as_float_array("base_directions", base_directions)
            check_values("base_directions", self.base_directions)
            if self.base_directions.ndim != 2:
                raise ValueError(
                    "Argument `base_directions` must have shape (n, d), but has shape "
                    f"{self.base_directions.shape}."
                )


class LinearPotential(eqx.Module):
    """`V = w^T q`: constant forces -w."""

    weights: jax.Array

    def __call__(self, q: jax.Array) -> jax.Array:
        """V () [J]."""
        return self.weights @ q


def gravity(mass_along_up: Any, acceleration: Any = STANDARD_GRAVITY) -> LinearPotential:
    """Potential of gravity for coordinates in which heights are linear.

    Equation: `V = g sum_i m_i q_i`.

    Args:
        mass_along_up: (n,): the mass that each coordinate lifts [kg], 0 for horizontal ones and
            angles, negative where the coordinate points down.
        acceleration: g [m/s^2].

    >>> import jimpact as ji
    >>> ji.gravity([0.0, 2.0], acceleration=10.0).weights.tolist()
    [0.0, 20.0]
    """
    weights = as_float_array("mass_along_up", mass_along_up)
    check_values("mass_along_up", weights)
    check_values("acceleration", acceleration)
    return LinearPotential(weights * jnp.asarray(acceleration, weights.dtype))
