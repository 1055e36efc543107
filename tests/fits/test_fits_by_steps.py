"""Fits through impacts by steps without events."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import argument
from spatial_scenes import NAMED

import jimpact as ji

# v+ by method 'time' at rtol 1e-11, k = 1, eta = 1.5, mu = .3, by name and e
EDGE = [
    0.7057231279,
    0.3448930544,
    0.0365790838,
    -2.9887916746,
    -0.3493685294,
    -0.0909271875,
]


def pressed(name):
    """Scene and velocity of a body on the ground."""
    body = NAMED[name]()
    return ji.Scene(body.mass, body.normals, body.tangents), jnp.asarray(body.velocity)


def edge_problem(sigma=0.01, name="edge", **options):
    """Restitution and friction of four impacts of a box on its edge, not yet at the fit."""
    scene, velocity = pressed(name)
    shots = np.outer([0.8, 1.0, 1.2, 1.4], velocity)
    after = np.outer([0.8, 1.0, 1.2, 1.4], EDGE)
    data = ji.Experiments(shots, after, sigma=sigma)
    law = ji.LZB(0.4, friction=0.25, **options)
    return ji.FitProblem.from_shots(law, scene, data, ("restitution", "friction"))


@pytest.mark.release
def test_gradient_of_a_fit():
    """Of the sum of squares, in both modes 2 J^T r; and the fit finds what the impacts had."""
    problem = edge_problem()

    def cost(x):
        return jnp.sum(problem.residual(x) ** 2)

    x = jnp.asarray(problem.start)
    wanted = 2 * problem.residual(x) @ problem.jacobian(x)
    for mode in (jax.grad, jax.jacfwd):
        np.testing.assert_allclose(jax.jit(mode(cost))(x), wanted, rtol=1e-4)
    found = ji.fit(problem, starts=1, profiles=False)
    np.testing.assert_allclose(found.value, 0.3, atol=1e-3)
    fine = ji.fit(edge_problem(rtol=1e-5), starts=1, profiles=False)
    assert np.abs(found.value - fine.value).max() < 0.01 * found.standard_error.min()
    np.testing.assert_allclose(found.standard_error, fine.standard_error, rtol=0.02)


@pytest.mark.slow
def test_second_derivatives_of_a_fit_say_what_auto_is():
    """The error names what the user may not have asked for; nothing is compiled."""
    problem = edge_problem()

    def cost(x):
        return jnp.sum(problem.residual(x) ** 2)

    with pytest.raises(NotImplementedError, match=argument("method", "'implicit'")):
        jax.jit(jax.hessian(cost)).lower(jnp.asarray(problem.start))


def test_a_fit_takes_the_tolerance_that_the_noise_allows():
    """Coarse under the noise; the usual one where it is smaller, unknown, or no error is seen."""
    problem = edge_problem()
    assert problem.law.rtol == 1e-4
    assert any("`rtol` = 0.0001" in note for note in problem.notes)
    gaps = np.abs(pressed("edge")[0].normals.T @ problem.experiments.pre[-1]).max()
    for others in ({"sigma": None}, {"sigma": 1e-4 * gaps}, {"name": "corner"}):
        assert edge_problem(**others).law.rtol is None, others
    assert edge_problem(rtol=1e-6).law.rtol == 1e-6
