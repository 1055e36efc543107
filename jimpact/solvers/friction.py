"""Coulomb friction: who sticks, who slides and where to."""

import jax
import jax.numpy as jnp

SWEEPS = 60  # of the projected Gauss-Seidel iteration
INSIDE = 1e-9  # part of the limit below which a force is inside the disc


def distribute(
    matrix: jax.Array, rate: jax.Array, limit: jax.Array, asked: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Of the contacts `asked` (m, B): whether they stick, else the direction (t, B) of slip.

    `matrix` (t, t, B), `rate` (t, B) of slip without their forces, `limit` mu F (m, B).
    """
    m, rate = len(limit), jnp.where(asked, rate, 0.0)

    def slip(side: jax.Array) -> jax.Array:
        return sum(matrix[:, i] * side[i : i + 1] for i in range(m)) + rate

    def sweep(_: int, side: jax.Array) -> jax.Array:
        for j in range(m):
            tried = side[j : j + 1] - slip(side)[j : j + 1] / matrix[j : j + 1, j]
            tried = jnp.clip(tried, -limit[j : j + 1], limit[j : j + 1])
            side = side.at[j : j + 1].set(jnp.where(asked[j : j + 1], tried, 0.0))
        return side

    side = jax.lax.fori_loop(0, SWEEPS, sweep, jnp.zeros_like(rate))
    left = jnp.where(asked, slip(side), 0.0)
    scale = jnp.max(jnp.abs(rate), axis=0, keepdims=True)
    stick = (jnp.abs(side) < (1 - INSIDE) * limit) | (jnp.abs(left) <= INSIDE * scale)
    return asked & stick, jnp.where(jnp.abs(side) > 0, -side, left)
