"""Base motions."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from jimpact._checks import as_float_array, check_values

DIRECTIONS = ("line", "vertical", "horizontal")


class HarmonicBase(eqx.Module):
    """A base that vibrates: `y_b = A sin(2 pi f t + phase)`.

    Args:
        amplitude: A [m].
        frequency: f [Hz].
        phase: [rad].
        direction: 'line' for systems that move along one (`ball_system`, `column_system`);
            'vertical' or 'horizontal' for bodies in the plane.

    >>> import jimpact as ji
    >>> ji.HarmonicBase(0.1, 1.0, direction="horizontal")(0.25).tolist()
    [0.1, 0.0]
    """

    amplitude: jax.Array
    frequency: jax.Array
    phase: jax.Array
    direction: str = eqx.field(static=True)

    def __init__(self, amplitude: Any, frequency: Any, phase: Any = 0.0, direction: str = "line"):
        self.amplitude = as_float_array("amplitude", amplitude)
        self.frequency = as_float_array("frequency", frequency)
        self.phase = as_float_array("phase", phase)
        for name in ("amplitude", "frequency", "phase"):
            check_values(name, getattr(self, name))
        if direction not in DIRECTIONS:
            raise ValueError(
                f"Argument `direction` must be one of {DIRECTIONS}, but has value {direction!r}."
            )
        self.direction = direction

    def __call__(self, t: jax.Array) -> jax.Array:
        """Displacement (1,) or (2,) [m]."""
        y = self.amplitude * jnp.sin(2 * jnp.pi * self.frequency * t + self.phase)
        if self.direction == "line":
            return y[None]
        pair = (0 * y, y) if self.direction == "vertical" else (y, 0 * y)
        return jnp.stack(pair)
