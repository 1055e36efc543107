"""What tests of reverse share."""

import jax
import jax.numpy as jnp

import jimpact as ji


def both_modes(law, scene, v, e, k):
    """Derivatives along 1 in e (B,) and a direction in k (m,), in forward and in reverse mode."""
    weight = jnp.cos(jnp.arange(len(v), dtype=v.dtype))
    way = jnp.sin(jnp.arange(1, len(k) + 1, dtype=v.dtype))

    def after(e, k):
        return ji.impact(law(e, k), scene, v).velocity @ weight

    def forward(e):
        return jax.jvp(after, (e, k), (jnp.ones_like(e), way))[1]

    def reverse(e):
        de, dk = jax.grad(after, argnums=(0, 1))(e, k)
        return de + dk @ way

    return jax.jit(jax.vmap(forward))(e), jax.jit(jax.vmap(reverse))(e)
