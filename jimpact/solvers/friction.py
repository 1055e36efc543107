"""Coulomb friction: who sticks, who slides and where to."""

import jax
import jax.numpy as jnp

SWEEPS = 200  # of the projected Gauss-Seidel iteration, at most
SETTLED = 1e-13  # of the largest limit: a sweep that changes less is the last
INSIDE = 1e-9  # part of the limit below which a force is inside the disc


def _size(side: jax.Array, rows: int) -> jax.Array:
    return jnp.sqrt(jnp.sum(side.reshape(-1, rows, *side.shape[1:]) ** 2, axis=1))


def distribute(
    matrix: jax.Array, rate: jax.Array, limit: jax.Array, asked: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Of the contacts `asked` (m, B): whether they stick, else the direction (t, B) of slip.

    `matrix` (t, t, B), `rate` (t, B) of slip without their forces, `limit` mu F (m, B); t is m in
    the plane, 2 m (contact-major) in space. A contact in space that others hold on the rim of its
    disc counts as sliding, at speed 0; its direction is that against its force.
    """
    m = len(limit)
    rows = len(rate) // m
    every = jnp.repeat(asked, rows, axis=0)
    rate = jnp.where(every, rate, 0.0)
    least = SETTLED * jnp.max(limit, axis=0, keepdims=True)

    def slip(side: jax.Array) -> jax.Array:
        return sum(matrix[:, i] * side[i : i + 1] for i in range(m * rows)) + rate

    def sweep(carry: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, ...]:
        before, _, count = carry
        side = before
        for j in range(m):
            at = slice(rows * j, rows * (j + 1))
            total = sum(matrix[i, i] for i in range(at.start, at.stop))[None]  # no step is too long
            tried = side[at] - slip(side)[at] / total
            length = _size(tried, rows)
            over = length > limit[j : j + 1]
            tried = jnp.where(over, tried * (limit[j : j + 1] / jnp.where(over, length, 1.0)), tried)
            side = side.at[at].set(jnp.where(asked[j : j + 1], tried, 0.0))
        moves = jnp.any(jnp.abs(side - before) > least)
        return side, moves, count + 1

    side, _, _ = jax.lax.while_loop(
        lambda c: c[1] & (c[2] < SWEEPS), sweep, (jnp.zeros_like(rate), jnp.any(asked), 0)
    )
    left = jnp.where(every, slip(side), 0.0)
    stick = _size(side, rows) < (1 - INSIDE) * limit
    if rows == 1:
        scale = jnp.max(jnp.abs(rate), axis=0, keepdims=True)
        stick = stick | (jnp.abs(left) <= INSIDE * scale)
    pushed = jnp.repeat(_size(side, rows) > 0, rows, axis=0)
    return asked & stick, jnp.where(pushed, -side, left)
