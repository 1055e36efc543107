"""Smooth maps of the real line onto intervals, so that a solver without bounds stays inside.

Per parameter, with u = log x where `log` is set and u = x else:
    both ends     u = low + (high - low) / (1 + exp(-z))
    one end       u = low + scale exp(z)   or   u = high - scale exp(z)
    none          u = scale z
The ends themselves lie at z = +-inf; a caller that ends near one tries the end itself.
"""

import equinox as eqx
import jax
import jax.numpy as jnp

# |z| beyond this is cut: exp(-16) = 1e-7 of the interval, about the accuracy of the derivatives
# of an impact; further out a step in z would no longer be felt.
FARTHEST = 16.0


class Interval(eqx.Module):
    """Ends in u (infinite: none), the scale of one-sided and free maps, and whether u = log x."""

    low: jax.Array
    high: jax.Array
    scale: jax.Array
    log: jax.Array

    def to_bounded(self, z: jax.Array) -> jax.Array:
        """x (P,) of z (P,)."""
        below, above = jnp.isfinite(self.low), jnp.isfinite(self.high)
        low, high = jnp.where(below, self.low, 0.0), jnp.where(above, self.high, 0.0)
        near = jnp.clip(z, -FARTHEST, FARTHEST)
        u = jnp.where(below, low + self.scale * jnp.exp(near), self.scale * z)
        u = jnp.where(above, high - self.scale * jnp.exp(near), u)
        u = jnp.where(below & above, low + (high - low) * jax.nn.sigmoid(near), u)
        return jnp.where(self.log, jnp.exp(jnp.where(self.log, u, 0.0)), u)

    def from_bounded(self, x: jax.Array, margin: float) -> jax.Array:
        """z (P,) of x (P,); x is kept `margin` of the interval (or of the scale) inside."""
        below, above = jnp.isfinite(self.low), jnp.isfinite(self.high)
        low, high = jnp.where(below, self.low, 0.0), jnp.where(above, self.high, 0.0)
        u = jnp.where(self.log, jnp.log(jnp.where(self.log, x, 1.0)), x)
        span = jnp.where(below & above, high - low, 1.0)
        share = jnp.clip((u - low) / span, margin, 1 - margin)
        one_sided = jnp.where(below, u - low, high - u) / self.scale
        z = jnp.where(below | above, jnp.log(jnp.maximum(one_sided, margin)), u / self.scale)
        return jnp.where(below & above, jnp.log(share) - jnp.log1p(-share), z)
