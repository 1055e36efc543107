"""Loops and branches: `jimpact/tools/loops.py`."""

import jax
import jax.numpy as jnp
import pytest

from jimpact.tools.loops import in_a_branch


def square_plus_one(x):
    """x^2 + 1, in a branch where x is a number."""
    return in_a_branch(x == x, lambda: x * x + 1)


def test_a_branch_changes_neither_values_nor_derivatives_of_any_order():
    assert float(square_plus_one(3.0 * jnp.ones(()))) == 10.0
    slope = jax.grad(square_plus_one)
    assert float(slope(3.0)) == 6.0
    assert float(jax.jacfwd(slope)(3.0)) == 2.0


def test_a_batch_takes_one_branch_and_selects_nothing():
    batch = jnp.arange(4.0)
    program = jax.make_jaxpr(jax.vmap(square_plus_one))(batch)
    names = [str(equation.primitive) for equation in program.eqns]
    if jax.default_backend() != "cpu":
        pytest.skip("branches are made on CPUs")
    assert "cond" in names
    assert "select_n" not in names
    assert jax.vmap(square_plus_one)(batch).tolist() == [1.0, 2.0, 5.0, 10.0]
