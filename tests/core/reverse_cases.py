"""What tests of reverse share."""

import jax
import jax.numpy as jnp

import jimpact as ji


def both_modes(law, scene, v, e, k, adjoint="jacobian"):
    """Derivatives along 1 in e (B,) and a direction in k (m,), in forward mode and by `adjoint`."""
    weight = jnp.cos(jnp.arange(len(v), dtype=v.dtype))
    way = jnp.sin(jnp.arange(1, len(k) + 1, dtype=v.dtype))

    def after(e, k, adjoint):
        return ji.impact(law(e, k, adjoint), scene, v).velocity @ weight

    def forward(e):
        return jax.jvp(
            lambda e, k: after(e, k, "forward"), (e, k), (jnp.ones_like(e), way)
        )[1]

    def reverse(e):
        de, dk = jax.grad(lambda e, k: after(e, k, adjoint), argnums=(0, 1))(e, k)
        return de + dk @ way

    return jax.jit(jax.vmap(forward))(e), jax.jit(jax.vmap(reverse))(e)
