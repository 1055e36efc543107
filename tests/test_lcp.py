"""The LCP core against enumeration, scipy and closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.optimize import linprog, nnls

from jimpact.solvers.lcp import solve_lcp
from jimpact.status import CODE

batched = jax.jit(jax.vmap(solve_lcp))
one = jax.jit(solve_lcp)


def enumerate_supports(a, q):
    """Oracle: try every support."""
    m, root = len(q), np.sqrt(np.diag(a))
    size = np.abs(q / root).max()
    a, q = a / np.outer(root, root), q / root / size
    for mask in range(2**m):
        on = [i for i in range(m) if mask >> i & 1]
        z = np.zeros(m)
        if on:
            z[on] = np.linalg.lstsq(a[np.ix_(on, on)], -q[on], rcond=1e-15)[0]
        w = a @ z + q
        tolerance = max(1e-9, 8e-16 * np.abs(z).max())  # what rounding of z leaves in w
        if min(z.min(), w.min()) >= -tolerance and np.abs(w[on]).sum() <= tolerance:
            return z / root * size, w * root * size
    return None


def spread(rng, count, m, rank):
    """Random W of contacts in `rank` coordinates with masses over six decades, and q."""
    normals = rng.normal(size=(count, rank, m))
    masses = 10.0 ** rng.uniform(-3, 3, size=(count, rank))
    w = np.einsum("kri,kr,krj->kij", normals, 1 / masses, normals)
    return w, rng.normal(size=(count, m)) * np.sqrt(np.einsum("kii->ki", w))


@pytest.mark.parametrize(("m", "rank"), [(2, 2), (4, 6)])
def test_against_enumeration(m, rank):
    a, q = spread(np.random.default_rng(0), 200, m, rank)
    found = batched(a, q)
    assert not np.asarray(found.code).any()
    for k in range(len(a)):
        z, w = enumerate_supports(a[k], q[k])
        root = np.sqrt(np.diag(a[k]))
        size = np.abs(q[k] / root).max() * max(1, 1e-6 * np.abs(z * root).max())
        np.testing.assert_allclose(found.w[k] / root, w / root, atol=1e-9 * size)
        np.testing.assert_allclose(a[k] @ found.z[k] / root, a[k] @ z / root, atol=1e-9 * size)


def test_is_nonnegative_least_squares():
    rng = np.random.default_rng(1)
    normals, b = rng.normal(size=(50, 8, 5)), rng.normal(size=(50, 8))
    a = np.einsum("kri,krj->kij", normals, normals)
    found = batched(a, -np.einsum("kri,kr->ki", normals, b))
    for k in range(50):
        np.testing.assert_allclose(found.z[k], nnls(normals[k], b[k])[0], atol=1e-12)


def test_singular_and_degenerate_problems():
    """Small integers: ties, redundant and contradictory contacts all occur."""
    rng = np.random.default_rng(2)
    normals = rng.integers(-2, 3, size=(1000, 4, 3)).astype(float)
    a = normals @ normals.transpose(0, 2, 1)
    q = rng.integers(-2, 3, size=(1000, 4)).astype(float)
    z, w, code = map(np.asarray, batched(a, q))
    solved = code != CODE["infeasible"]
    assert (~solved).sum() > 50
    assert (code == CODE["impulse_not_unique"]).sum() > 40
    assert z[solved].min() >= 0
    assert w[solved].min() > -1e-12
    assert np.abs(z * w)[solved].max() < 1e-12
    residual = np.einsum("kij,kj->ki", a, z) + q - w
    assert np.abs(residual)[solved].max() < 1e-12
    for k in range(300):
        feasible = linprog(np.zeros(4), A_ub=-a[k], b_ub=q[k], method="highs").status == 0
        assert feasible == solved[k], (a[k], q[k])
    single = batched(a.astype(np.float32), q.astype(np.float32))
    assert single.z.dtype == jnp.float32
    assert np.array_equal(single.code, code)
    np.testing.assert_allclose(single.w[solved], w[solved], atol=2e-3)


def test_least_norm_of_many():
    legs = jnp.array([[1.0, 1, 1, 1], [1, 1, -1, -1], [1, -1, 1, -1]])  # a table
    found = one(legs.T @ legs, jnp.full(4, -1.0))
    np.testing.assert_allclose(found.z, 0.25, atol=1e-14)
    assert int(found.code) == CODE["impulse_not_unique"]
    order = jnp.array([2, 0, 3, 1])
    q = jnp.array([-1.0, -0.9, -1.0, -0.9])
    plain, swapped = one(legs.T @ legs, q), one((legs.T @ legs)[order][:, order], q[order])
    np.testing.assert_allclose(swapped.z, plain.z[order], atol=1e-14)


def test_a_body_between_two_walls():
    squeezed = jnp.array([[1.0, -1.0], [-1.0, 1.0]])
    assert int(one(squeezed, jnp.array([-1.6, 1.5])).code) == CODE["infeasible"]
    assert int(one(squeezed, jnp.array([-1.5, 1.6])).code) == CODE["ok"]
    assert int(one(squeezed, jnp.array([-1.5, 1.5])).code) == CODE["impulse_not_unique"]


def test_not_symmetric():
    rng = np.random.default_rng(3)
    x = rng.normal(size=(300, 4, 4))
    a = x @ x.transpose(0, 2, 1) + 2 * (x - x.transpose(0, 2, 1))  # P, far from symmetric
    q = rng.normal(size=(300, 4))
    found = jax.jit(jax.vmap(lambda a, q: solve_lcp(a, q, symmetric=False)))(a, q)
    assert not np.asarray(found.code).any()
    for k in range(300):
        z, w = enumerate_supports(a[k], q[k])
        np.testing.assert_allclose(found.z[k], z, atol=1e-9)
        np.testing.assert_allclose(found.w[k], w, atol=1e-9)


@pytest.mark.slow
def test_derivatives_of_every_order():
    """z = (1, a) / (1 - a^2) for A = [[1, -a], [-a, 1]], q = (-1, 0)."""

    def second(a):
        matrix = jnp.stack([jnp.stack([1.0, -a]), jnp.stack([-a, 1.0])])
        return solve_lcp(matrix, jnp.array([-1.0, 0.0])).z[1]

    a = 0.5
    slope, curvature = (1 + a**2) / (1 - a**2) ** 2, 2 * a * (3 + a**2) / (1 - a**2) ** 3
    for first in (jax.jacfwd, jax.jacrev):
        assert jax.jit(first(second))(a) == pytest.approx(slope, rel=1e-13)
        for outer in (jax.jacfwd, jax.jacrev):
            assert jax.jit(outer(first(second)))(a) == pytest.approx(curvature, rel=1e-13)


def test_derivative_of_w_with_redundant_contacts():
    """Three equal contacts and one more: w_4 = q_4 - c (q_1 + q_2 + q_3) / 3."""
    matrix = jnp.array([[1.0, 1, 1, 0.5], [1, 1, 1, 0.5], [1, 1, 1, 0.5], [0.5, 0.5, 0.5, 1]])
    q = jnp.array([-1.0, -1, -1, 2])
    w4 = lambda b: (matrix @ solve_lcp(matrix, b).z + b)[3]  # noqa: E731
    slope = jax.jit(jax.jacfwd(w4))(q)
    assert float(slope[3]) == pytest.approx(1.0)
    assert float(slope[:3].sum()) == pytest.approx(-0.5, abs=1e-12)
    np.testing.assert_allclose(jax.jit(jax.jacrev(w4))(q), slope, atol=1e-14)


ENTRY = st.floats(-3, 3, width=32)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(
    n=st.tuples(*[ENTRY] * 9), q=st.tuples(*[ENTRY] * 3), power=st.tuples(*[st.integers(-6, 6)] * 3)
)
def test_complementarity_holds_or_is_refused(n, q, power):
    mass = 10.0 ** np.array(power)
    normals = np.reshape(n, (3, 3))
    a = normals.T @ (normals / mass[:, None])
    q = np.array(q) * np.sqrt(np.maximum(np.diag(a), 1e-300))
    found = one(a, q)
    if int(found.code) > CODE["impulse_not_unique"]:
        return
    root = np.sqrt(np.where(np.diag(a) > 0, np.diag(a), 1))
    size = np.abs(q / root).max()
    assert (np.asarray(found.z) >= 0).all()
    assert (np.asarray(found.w) / root >= -1e-7 * size).all()
    held = np.asarray(a @ found.z + q - found.w) / root
    assert np.abs(held).max() <= 1e-7 * size
