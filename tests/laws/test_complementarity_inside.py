"""Moreau's and Poisson's complementarity problems against every support, scipy and closed forms.

The core is seen through the laws: `0 <= W p + (1 + e) gamma- _|_ p >= 0` is Moreau's impulse.
"""

import jax
import jax.numpy as jnp
import numpy as np
import programs
import pytest
from programs import names

from jimpact.numerics import lcp
from jimpact.numerics.lcp import solve_lcp


def test_redundant_contacts_share_in_equal_parts():
    """Three supports of one body, of which any carries it alone: the z of least norm."""
    solution = jax.jit(solve_lcp)(jnp.ones((3, 3)), -jnp.ones(3))
    np.testing.assert_allclose(solution.z, [1 / 3] * 3, rtol=1e-12)
    assert names(solution.code) == ["impulse_not_unique"]


@pytest.mark.slow
@pytest.mark.parametrize("rounding", [lcp._ROUNDING, lcp._ROUNDING / 10])
def test_ties_within_rounding(monkeypatch, rounding):
    """Redundant contacts, masses that are no whole numbers: ties of ratios are ties but for rounding.

    Where less is taken for rounding, some pivots are nothing else: what comes out is right or flagged.
    """
    monkeypatch.setattr(lcp, "_ROUNDING", rounding)
    rng, count, m, r = np.random.default_rng(12), 20_000, 6, 3
    normals = rng.integers(-2, 3, (count, m, r)) * rng.uniform(0.3, 3, (count, m, 1))
    root = rng.normal(size=(count, r, r))
    w = (
        normals
        @ (root @ root.transpose(0, 2, 1) + 0.1 * np.eye(r))
        @ normals.transpose(0, 2, 1)
    )
    v, e = rng.integers(-2, 3, (count, r)), rng.integers(0, 3, (count, m)) / 2
    q = (1 + e) * np.einsum("kmr,kr->km", normals, v)
    there = np.flatnonzero((normals != 0).any(axis=2).all(axis=1))
    solve = jax.jit(
        jax.vmap(lambda matrix, right: solve_lcp(matrix, right))
    )  # compiled anew
    z, rate, code = map(np.asarray, solve(w[there], q[there]))
    solved = code <= programs.CODE["impulse_not_unique"]
    root = np.sqrt(np.diagonal(w[there], axis1=1, axis2=2))
    size = np.abs(q[there] / root).max(axis=1, keepdims=True) + 1e-30
    rate, z = (rate / root / size)[solved], (z * root / size)[solved]
    assert solved.mean() > 0.6
    assert rate.min() > -1e-9
    assert np.abs(rate * z).max() < 1e-9
    assert z.min() >= 0
