"""Quotients where they exist: finite values and derivatives beside a division by 0."""

import jax
import jax.numpy as jnp
import numpy as np

from jimpact.tools.masks import choose, quotient


def test_a_quotient_has_finite_derivatives_where_it_divides_by_zero():
    b = jnp.array([0.0, 4.0])

    def sum_of(b):
        return jnp.sum(quotient(2.0, b, where=b > 0, otherwise=7.0))

    np.testing.assert_allclose(quotient(2.0, b, where=b > 0, otherwise=7.0), [7.0, 0.5])
    np.testing.assert_allclose(jax.grad(sum_of)(b), [0.0, -2.0 / 16.0])


def test_choose_takes_every_leaf_from_one_of_two_trees():
    mask = jnp.array([True, False])
    new, old = (
        {"x": jnp.ones(2), "y": 3 * jnp.ones(2)},
        {"x": jnp.zeros(2), "y": -jnp.ones(2)},
    )
    chosen = choose(mask, new, old)
    np.testing.assert_array_equal(chosen["x"], [1.0, 0.0])
    np.testing.assert_array_equal(chosen["y"], [3.0, -1.0])
