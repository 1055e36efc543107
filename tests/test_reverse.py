"""The reverse mode of impacts of any length: steps that are not kept are run again."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jimpact as ji
from jimpact.events import kept_steps


def test_steps_that_are_run_again_have_their_derivatives(monkeypatch):
    """Duration pi sqrt(m/k) of a ball of 1 m/s, largest force sqrt(k m), force sqrt(k m) sin(w t)."""
    monkeypatch.setattr(kept_steps, "KEPT", 4)  # in programs of their own, by `max_steps`
    mass, k, samples = 2.0, 3.0, 5

    def of_spring(k):
        law = ji.LZB(1.0, k, exponent=1.0, rtol=1e-12, max_steps=9_001)
        h = ji.history(law, ji.chain([mass], wall=True), [1.0], samples=samples)
        return h.duration + 10 * h.maximum_force[0] + 100 * h.force[1, 0]

    duration, force = np.pi * np.sqrt(mass / k), np.sqrt(k * mass)
    # samples divide the duration: the force at a quarter of it is sin(pi/4) of the largest
    slope = (-duration + 10 * force + 100 * np.sin(np.pi / 4) * force) / (2 * k)
    assert float(jax.jit(jax.grad(of_spring))(k)) == pytest.approx(slope, rel=1e-9)


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


@pytest.mark.release
@pytest.mark.parametrize("masses", [[1.0] * 5, [1.0, 1e-2, 1.0, 3.0]])
def test_few_kept_steps_in_batches(monkeypatch, masses):
    """Impacts of different length side by side; some pause and end in the plastic limit."""
    monkeypatch.setattr(kept_steps, "KEPT", 16)
    v = jnp.zeros(len(masses)).at[0].set(1.0)
    e = jnp.array([0.2, 0.5, 0.8, 0.9, 0.97])
    k = jnp.linspace(1.0, 2.0, len(masses) - 1)
    scene = ji.chain(masses)
    forward, reverse = both_modes(lambda e, k: ji.LZB(e, k, 1.5, max_steps=9_002), scene, v, e, k)
    np.testing.assert_allclose(reverse, forward, rtol=1e-7, atol=1e-9)


@pytest.mark.release
def test_impacts_of_more_than_a_thousand_steps():
    """Fifty balls; six with a wall, and their second derivative forward over reverse."""
    v = jnp.zeros(50).at[0].set(1.0)
    e = jnp.array([0.9])
    forward, reverse = both_modes(
        lambda e, k: ji.LZB(e, k, 1.5), ji.chain([1.0] * 50), v, e, jnp.ones(49)
    )
    assert abs(float(forward[0])) > 0.1
    np.testing.assert_allclose(reverse, forward, rtol=1e-8)
    wall = ji.chain([1.0] * 6, wall=True)

    def speed(e):
        return ji.impact(ji.LZB(e, jnp.ones(6), 1.3), wall, jnp.eye(6)[0]).velocity[5]

    twice = [jax.jit(mode(jax.grad(speed))) for mode in (jax.jacfwd, jax.grad)]
    exact = jax.jit(jax.jacfwd(jax.jacfwd(speed)))(0.9)
    for second in twice:
        np.testing.assert_allclose(second(0.9), exact, rtol=1e-7)
