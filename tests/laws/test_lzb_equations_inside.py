"""The equations that `laws/lzb.py` states, against those of the paper in energies."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jimpact.laws.lzb import BISTIFFNESS


@pytest.mark.parametrize(("k", "eta"), [(2.0, 1.5), (7.0, 1.0), (0.3, 2.2)])
def test_the_force_at_an_energy_is_that_of_the_distributing_rule(k, eta):
    """Eq. (6.70): F = ((1 + eta) E)^(eta / (1 + eta)) k^(1 / (1 + eta))."""
    energy = 0.4
    x = BISTIFFNESS.depth(jnp.sqrt(2 * energy), jnp.array(k), jnp.array(eta))
    force = BISTIFFNESS.force(x, k, eta)
    rule = ((1 + eta) * energy) ** (eta / (1 + eta)) * k ** (1 / (1 + eta))
    np.testing.assert_allclose(force, rule, rtol=1e-14)


def test_the_energy_changes_by_the_work_in_loading_and_by_more_in_unloading():
    """Eqs. (6.71), (6.72): dE / dt = F x' = -c gamma F, c = 1 or 1 / e^2."""
    k, eta, e, x = 3.0, 1.5, 0.6, jnp.array(0.2)

    def energy(x):
        return k * x ** (eta + 1) / (eta + 1)

    for gamma, c in ((-0.5, 1.0), (0.5, 1 / e**2)):
        rate = -gamma / BISTIFFNESS.scale(gamma > 0, e) ** 2
        change = jax.grad(energy)(x) * rate
        expected = -c * gamma * BISTIFFNESS.force(x, k, eta)
        np.testing.assert_allclose(change, expected, rtol=1e-14)
