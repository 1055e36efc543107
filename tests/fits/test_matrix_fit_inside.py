"""Fits of a restitution matrix that stay admissible: all data simulated from known matrices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matrix_fit_cases import CHAIN, E_TRUE, OUTSIDE, PROBLEM, after, fitted, shots
from programs import as_matrix
from scipy.optimize import minimize

import jimpact as ji
from jimpact import RestitutionMatrix, fit
from jimpact.fits.matrices import admissible_start
from jimpact.theory import normalized_delassus
from jimpact.theory.restitution_matrices import margin

least_margin = jax.jit(margin)


def inverse(scene):
    return np.linalg.inv(np.asarray(as_matrix(normalized_delassus(scene))))


def slacks(e, g_inverse):
    """Of the three conditions, computed from their definitions."""
    energy = float(least_margin(jnp.asarray(g_inverse - e.T @ g_inverse @ e))[0])
    return e.min(), (g_inverse @ (np.eye(len(e)) + e)).min(), energy


@pytest.mark.parametrize(
    "scene",
    [
        CHAIN,
        ji.chain([1.0, 5.0, 0.1], wall=True, gaps=[0.0, 0.1, 0.0]),
        ji.Scene(
            [1.0, 1.0], [[1.0, 0.5], [0.0, 1.0]]
        ),  # contacts that push the same way
        ji.Scene([1.0, 1.0], [[1.0, 0.9], [0.0, 0.3]]),
    ],
)
def test_an_admissible_matrix_to_start_from(scene):
    among = np.ix_(scene.closed, scene.closed)
    g = np.asarray(as_matrix(normalized_delassus(scene)))[among]
    assert min(slacks(admissible_start([scene])[among], np.linalg.inv(g))) > -1e-9


@pytest.mark.slow
def test_the_admissible_least_squares_solution_is_found():
    """Noisy data that gain energy: the constrained minimum, against scipy."""
    data = shots(np.array([[0.1, 0.2], [0.95, 0.1]]), noise=0.1, seed=4)
    found = fitted(data)
    g_inverse = inverse(CHAIN)
    assert min(slacks(np.asarray(found.law.matrix), g_inverse)) > -1e-13
    assert any("copositive (energy)" in line for line in found.warnings)
    assert found.converged
    assert found.rank == 4
    pre, post = jnp.asarray(data.pre), data.post

    def residual(e):
        return (after(jnp.asarray(e).reshape(2, 2), pre) - post).reshape(-1)

    offset = np.asarray(residual(np.zeros(4)))
    slope = np.stack(
        [np.asarray(residual(unit)) - offset for unit in np.eye(4)], axis=1
    )

    def conditions(e):  # copositive 2 x 2: closed form
        q = g_inverse - e.reshape(2, 2).T @ g_inverse @ e.reshape(2, 2)
        root = np.sqrt(max(q[0, 0], 0) * max(q[1, 1], 0))
        impulses = (g_inverse @ (np.eye(2) + e.reshape(2, 2))).ravel()
        return np.array([*e, *impulses, q[0, 0], q[1, 1], q[0, 1] + root])

    oracle = minimize(
        lambda e: np.sum((slope @ e + offset) ** 2),
        E_TRUE.ravel(),
        constraints={"type": "ineq", "fun": conditions},
        method="SLSQP",
        options={"ftol": 1e-15, "maxiter": 500},
    )
    free = np.linalg.lstsq(slope, -offset, rcond=None)[0]
    assert min(conditions(free)) < -0.01  # the conditions matter
    np.testing.assert_allclose(found.law.matrix.ravel(), oracle.x, atol=3e-6)
    np.testing.assert_allclose(
        np.sum(np.asarray(found.residual) ** 2), oracle.fun, rtol=1e-8
    )


@pytest.mark.release
def test_the_best_admissible_matrix_is_found_at_many_edges():
    """Three contacts, where the conditions meet at edges: no admissible matrix nearby is better."""
    scene, rng = ji.chain([1.0, 2.0, 0.7, 1.5]), np.random.default_rng(1)
    g_inverse, start = inverse(scene), RestitutionMatrix(0.3 * np.eye(3))
    for _ in range(2):
        pre = np.sort(rng.normal(size=(8, 4)))[:, ::-1]
        post = pre[:, ::-1] + 0.3 * rng.normal(size=pre.shape)
        found = fit(start, scene, ji.Experiments(pre, post, 0.1), "matrix", starts=2)
        assert found.converged
        assert any("edge" in line for line in found.warnings)
        best = found.value
        assert min(slacks(best.reshape(3, 3), g_inverse)) > -1e-12
        slope = found.problem.jacobian(best).T @ found.problem.residual(best)
        nearest = jax.jit(jax.vmap(found.problem.project))
        others = np.asarray(nearest(best + 0.1 * rng.normal(size=(32, 9))))
        assert ((others - best) @ np.asarray(slope)).min() > -1e-6 * np.abs(slope).max()


@pytest.mark.slow
def test_gradient_descent_ends_at_the_same_matrix():
    data = shots(np.array([[0.1, 0.2], [0.95, 0.1]]), noise=0.1, seed=4)
    found = fitted(data, search=ji.Search(method="adam"))
    assert min(slacks(np.asarray(found.law.matrix), inverse(CHAIN))) > -1e-13
    np.testing.assert_allclose(found.law.matrix, fitted(data).law.matrix, atol=1e-5)


project = jax.jit(jax.vmap(PROBLEM.project))


@pytest.mark.slow
def test_the_projection_is_the_nearest_admissible_matrix():
    """Of a convex set: it is seen from the point at no acute angle with any other member."""
    rng, g_inverse = np.random.default_rng(0), inverse(CHAIN)
    points = OUTSIDE + 0.5 * rng.normal(size=(64, 4))
    nearest = np.asarray(project(points))
    inside = [min(slacks(x.reshape(2, 2), g_inverse)) >= 0 for x in points]
    assert 0 < sum(inside) < 32
    np.testing.assert_allclose(nearest[inside], points[inside], atol=1e-12)
    assert min(min(slacks(x.reshape(2, 2), g_inverse)) for x in nearest) > -1e-9
    out, to_others = points - nearest, nearest[None] - nearest[:, None]
    assert np.einsum("ki,kji->kj", out, to_others).max() < 1e-3
