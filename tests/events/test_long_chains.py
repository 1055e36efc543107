"""Chains of so many bodies that a look ahead tells whether they come to rest together."""

import jax
import jax.numpy as jnp
import numpy as np
import programs
import pytest

import jimpact as ji

ROW = 12  # balls in a row: more contacts than return as multiples of themselves


def row(e, k, masses):
    """v+ and status of a row of balls that the first one hits."""
    first = jnp.zeros(ROW).at[0].set(1.0)
    out = ji.impact(ji.LZB(e, k, 1.5), ji.chain(masses), first)
    return out.velocity, out.status


@pytest.mark.release
def test_a_row_of_balls_ends_as_a_block_or_apart():
    """e = .5: the common velocity, long before all closings are over; e = .9: v+ as it is without
    looks ahead."""
    e = jnp.stack([jnp.full(ROW - 1, 0.5), jnp.full(ROW - 1, 0.9)])
    ones = jnp.ones((2, ROW))
    after, status = jax.jit(jax.vmap(row))(e, ones[:, 1:], ones)
    assert programs.names(status) == ["plastic_limit", "ok"]
    np.testing.assert_allclose(after[0], 1 / ROW, rtol=1e-12)
    apart = [-0.00867063, 0.02377687, 0.03518528, 0.03571521, 0.09872827, 0.61727936]
    np.testing.assert_allclose(
        after[1][jnp.array([0, 1, 8, 9, 10, 11])], apart, atol=2e-8
    )


@pytest.mark.release
def test_bodies_at_the_end_of_a_row_may_separate_slowly():
    """Ten bodies come to rest, two separate at 1e-4: steps without events at rtol 1e-7 say so."""
    masses = [8.52, 2.61, 0.268, 1.23, 2.58, 0.127, 2.29, 0.545, 1.51, 2.18, 2.18, 1.11]
    k = [0.0255, 0.0396, 20.6, 42.2, 0.0547, 98.2, 27.6, 0.208, 0.016, 0.0403, 0.557]
    e = [0.0711, 0.0991, 0.573, 0.932, 0.556, 0.962, 0.319, 0.992, 0.212, 0.773, 0.335]
    after, status = jax.jit(row)(*map(jnp.array, (e, k, masses)))
    assert programs.names(status[None]) == ["plastic_limit"]
    np.testing.assert_allclose(after[:10], 0.33875938, atol=2e-8)
    np.testing.assert_allclose(after[10:], [0.33881464, 0.33883242], atol=4e-8)


@pytest.mark.release
def test_slopes_of_a_block():
    """d v+ / d masses of 12 balls that end as a block, by momentum, in both modes."""
    rest = (0.5 * jnp.ones(ROW - 1), jnp.ones(ROW - 1))
    exact = np.full((ROW, ROW), -1 / ROW**2)
    exact[:, 0] += 1 / ROW
    for mode in (jax.jacfwd, jax.jacrev):
        slopes = mode(lambda masses: row(*rest, masses)[0])(jnp.ones(ROW))
        np.testing.assert_allclose(slopes, exact, atol=1e-8)
