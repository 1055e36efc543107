"""Fits of a restitution matrix that stay admissible: all data simulated from known matrices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matrix_fit_cases import CHAIN, E_TRUE, OUTSIDE, PROBLEM, START, after, fitted, shots
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
        ji.Scene([1.0, 1.0], [[1.0, 0.5], [0.0, 1.0]]),  # contacts that push the same way
        ji.Scene([1.0, 1.0], [[1.0, 0.9], [0.0, 0.3]]),
    ],
)
def test_an_admissible_matrix_to_start_from(scene):
    among = np.ix_(scene.closed, scene.closed)
    g = np.asarray(as_matrix(normalized_delassus(scene)))[among]
    assert min(slacks(admissible_start([scene])[among], np.linalg.inv(g))) > -1e-9


@pytest.mark.release
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
    slope = np.stack([np.asarray(residual(unit)) - offset for unit in np.eye(4)], axis=1)

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
    np.testing.assert_allclose(np.sum(np.asarray(found.residual) ** 2), oracle.fun, rtol=1e-8)


RECORD = []


class Watched(RestitutionMatrix):
    """Tells every matrix it is evaluated with."""

    def impulses(self, contact):
        jax.debug.callback(lambda e: RECORD.append(np.array(e)), self.matrix)
        return super().impulses(contact)


@pytest.mark.release
@pytest.mark.parametrize("method", ["levenberg-marquardt", "adam"])
def test_every_iterate_is_admissible(method):
    """... and gradient descent ends where Levenberg-Marquardt does."""
    data = shots(np.array([[0.1, 0.2], [0.95, 0.1]]), noise=0.1, seed=4)
    RECORD.clear()
    found = fit(Watched(START), CHAIN, data, {"matrix": True}, starts=3, method=method)
    jax.effects_barrier()
    tried = np.unique(np.concatenate([e.reshape(-1, 2, 2) for e in RECORD]), axis=0)
    assert len(tried) > 5
    g_inverse = inverse(CHAIN)
    worst = min(min(slacks(e, g_inverse)) for e in tried)
    assert worst > -1e-13
    assert worst < 1e-9  # some were drawn back to the boundary
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
