"""Systems to begin with: a ball, a column of beads, a cradle of pendulums, a dimer, a block."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from jimpact._checks import as_float_array, check_values
from jimpact.bodies.bodies import Block, Dimer
from jimpact.bodies.pendulums import PendulumCradle
from jimpact.motion.system import STANDARD_GRAVITY, System, gravity


def _checked(name: str, value: Any, *, zero: bool = False) -> jax.Array:
    array = as_float_array(name, value)
    check_values(name, array, low=0.0, open_low=not zero)
    return array


class ColumnGaps(eqx.Module):
    """Gaps of balls above one another."""

    radii: jax.Array

    def __call__(self, q: jax.Array) -> jax.Array:
        """Its values at q."""
        bottom = q - self.radii
        top_below = jnp.concatenate([jnp.zeros(1, q.dtype), (q + self.radii)[:-1]])
        return bottom - top_below


def column_system(
    masses: Any,
    radii: Any = 0.0,
    acceleration: Any = STANDARD_GRAVITY,
    base: Callable[[jax.Array], jax.Array] | None = None,
) -> System:
    """Balls above one another on a floor, or a plate that moves vertically.

    Equation: `f_1 = q_1 - R_1 - y_b`, `f_j = (q_j - R_j) - (q_{j-1} + R_{j-1})`; q are heights,
    ball 1 is the lowest, contact 1 its floor.

    Args:
        masses: (n,) [kg].
        radii: scalar or (n,) [m].
        acceleration: of gravity [m/s^2].
        base: t -> height of the plate () [m].

    >>> import jimpact as ji
    >>> ji.column_system([1.0, 2.0], 0.1).gap_function(ji.gravity([0.1, 0.3]).weights * 0).shape
    (2,)
    """
    mass = _checked("masses", masses)
    radius = jnp.broadcast_to(_checked("radii", radii, zero=True), mass.shape).astype(mass.dtype)
    directions = None if base is None else jnp.ones((mass.shape[0], 1), mass.dtype)
    return System(
        ColumnGaps(radius),
        mass,
        potential=gravity(mass, acceleration),
        base=base,
        base_directions=directions,
    )


def ball_system(
    mass: Any = 1.0,
    acceleration: Any = STANDARD_GRAVITY,
    base: Callable[[jax.Array], jax.Array] | None = None,
) -> System:
    """A ball (a point at height q) above a floor or a vibrating plate.

    >>> import jimpact as ji
    >>> motion = ji.simulate(ji.ball_system(), ji.Newton(0.5), [1.0], [0.0], 1.0, samples=21)
    >>> round(float(motion.events.time[0]), 6)
    0.451601
    """
    return column_system(jnp.atleast_1d(as_float_array("mass", mass)), 0.0, acceleration, base)


class _PendulumPotential(eqx.Module):
    weight_length: jax.Array

    def __call__(self, q: jax.Array) -> jax.Array:
        """Its values at q."""
        return self.weight_length @ (1 - jnp.cos(q))


def cradle_system(
    masses: Any,
    length: Any = 0.1,
    diameter: Any = 0.02,
    gap: Any = 0.0,
    acceleration: Any = STANDARD_GRAVITY,
) -> System:
    """Newton's cradle: a row of pendulums, q their angles; contact j joins balls j and j + 1.

    Equation: `f_j = |r_{j+1} - r_j| - d` with the centres
    `r_j = (j (d + gap) + l sin q_j, -l cos q_j)`.

    Args:
        masses: (n,) [kg], points for the kinetic energy.
        length: l [m], from pivot to centre.
        diameter: d [m].
        gap: distance between hanging balls [m].
        acceleration: of gravity [m/s^2].

    >>> import jimpact as ji, jax.numpy as jnp
    >>> float(ji.cradle_system([1.0, 1.0]).gap_function(jnp.zeros(2))[0])
    0.0
    """
    cradle = PendulumCradle(masses, length, _checked("diameter", diameter) / 2, gap)
    moment = cradle.mass_matrix(jnp.zeros(cradle.coordinates, cradle.masses.dtype))
    weights = moment / cradle.length * jnp.asarray(acceleration, moment.dtype)
    return System(cradle.gap_function, moment, potential=_PendulumPotential(weights))


def _on_ground(
    body: Block | Dimer,
    acceleration: Any,
    base: Callable[[jax.Array], jax.Array] | None,
) -> System:
    """A body with q = (x, y, theta)."""
    mass = body.mass_matrix(jnp.zeros(3))
    up = jnp.array([0.0, 1.0, 0.0], mass.dtype)
    return System(
        body.gap_function,
        mass,
        potential=gravity(mass * up, acceleration),
        tangent_function=body.tangent_function,
        base=base,
        base_directions=None if base is None else jnp.eye(3, 2, dtype=mass.dtype),
    )


def block_system(
    width: Any,
    height: Any,
    mass: Any = 1.0,
    acceleration: Any = STANDARD_GRAVITY,
    base: Callable[[jax.Array], jax.Array] | None = None,
) -> System:
    """A planar block on a plane: q = (x, y, theta); contact 1 is its right corner, 2 the left.

    Equation: `f = y +- (w/2) sin theta - (h/2) cos theta`.

    Args:
        width: w [m].
        height: h [m].
        mass: [kg], homogeneous.
        acceleration: of gravity [m/s^2].
        base: t -> (x_b, y_b) [m], how the plane moves.

    >>> import jimpact as ji, jax.numpy as jnp
    >>> ji.block_system(1.0, 2.0).gap_function(jnp.array([0.0, 1.0, 0.0])).tolist()
    [0.0, 0.0]
    """
    return _on_ground(Block(width, height, mass), acceleration, base)


def dimer_system(
    radius: Any,
    length: Any,
    sphere_mass: Any = 1.0,
    rod_mass: Any = 1.0,
    acceleration: Any = STANDARD_GRAVITY,
    base: Callable[[jax.Array], jax.Array] | None = None,
) -> System:
    """A planar dimer above a plate: q = (x, y, theta); contact 1 is the right sphere.

    Equation: `f = y +- (L/2 + R) sin theta - R`, see `Dimer`.

    Args:
        radius: R of the spheres [m].
        length: L of the rod between their surfaces [m].
        sphere_mass: of one sphere [kg].
        rod_mass: of the rod [kg], 0 for a massless one.
        acceleration: of gravity [m/s^2].
        base: t -> (x_b, y_b) [m], how the plate moves.

    >>> import jimpact as ji, jax.numpy as jnp
    >>> ji.dimer_system(0.1, 1.0).gap_function(jnp.array([0.0, 0.1, 0.0])).tolist()
    [0.0, 0.0]
    """
    return _on_ground(Dimer(radius, length, sphere_mass, rod_mass), acceleration, base)
