"""The reverse mode of impacts of any length: steps that are not kept are run again."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reverse_cases import both_modes

import jimpact as ji


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
