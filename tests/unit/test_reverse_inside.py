"""The reverse mode of impacts of any length: steps that are not kept are run again."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reverse_cases import both_modes

import jimpact as ji
from jimpact.events import kept_steps

pytestmark = pytest.mark.release  # they compile programs of their own


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
