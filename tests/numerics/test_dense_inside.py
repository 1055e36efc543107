"""Small dense systems: pivots that must be chosen, singular matrices, indefinite mass matrices."""

import jax
import jax.numpy as jnp
import numpy as np

from jimpact.numerics.dense import determinants, solve_by_pivots, solve_mass_matrix

RNG = np.random.default_rng(0)
SIZE = 5
MATRIX, RIGHT, CHANGE = (RNG.normal(size=(SIZE, k)) for k in (SIZE, 2, SIZE))
MATRIX[0, 0] = 0.0  # no pivot without an exchange of rows


def test_solution_and_determinant_with_their_derivatives():
    """`dx = -K^-1 dK x` and `d det K = det K tr(K^-1 dK)`; rounding grows with the condition."""
    (x, size), (dx, rate) = jax.jvp(
        lambda k: solve_by_pivots(k, RIGHT), (MATRIX,), (CHANGE,)
    )
    inverse, det = np.linalg.inv(MATRIX), np.linalg.det(MATRIX)
    np.testing.assert_allclose(x, inverse @ RIGHT, rtol=1e-12)
    np.testing.assert_allclose(size, det, rtol=1e-12)
    np.testing.assert_allclose(dx, -inverse @ CHANGE @ inverse @ RIGHT, rtol=1e-11)
    np.testing.assert_allclose(rate, det * np.trace(inverse @ CHANGE), rtol=1e-11)
    pair = jnp.stack([MATRIX, CHANGE])
    np.testing.assert_allclose(determinants(pair), np.linalg.det(pair), rtol=1e-12)


def test_a_singular_matrix_has_no_solution():
    singular = np.diag([1.0, 0.0, 2.0, 3.0, 4.0])
    x, size = solve_by_pivots(singular, RIGHT)
    assert size == 0
    assert not np.isfinite(x).all()


def test_a_mass_matrix_must_be_definite():
    mass = MATRIX @ MATRIX.T
    np.testing.assert_allclose(
        solve_mass_matrix(mass, RIGHT), np.linalg.solve(mass, RIGHT), rtol=1e-10
    )
    assert np.isnan(solve_mass_matrix(mass - 2 * np.eye(SIZE), RIGHT[:, 0])).any()
