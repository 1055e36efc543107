"""Oblique impacts in closed form, and kappa of materials."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jimpact as ji

close = np.testing.assert_allclose
SPHERE = ([1.0, 1.0, 0.4], [[0.0], [1.0], [0.0]], [[1.0], [0.0], [1.0]])  # W_tt = 3.5


def test_superballs_return_their_slip():
    """Linear springs that hold: u+ = u- cos(...), and their slope in kappa."""

    def slip(kappa, mu, e):
        mass, normals, tangents = (jnp.asarray(x) for x in SPHERE)
        law = ji.LZB(e, 1.0, 1.0, friction=mu, tangential_stiffness=kappa)
        out = ji.impact(
            law, ji.Scene(mass, normals, tangents=tangents), jnp.array([0.4, -1.0, 0.0])
        )
        return (tangents.T @ out.velocity)[0]

    run = jax.jit(jax.value_and_grad(slip, argnums=(0, 2)))
    value, _ = run(2 / 7, 0.5, 1.0)
    close(value, -0.4, rtol=1e-8)
    for kappa, e in ((0.1, 0.8), (0.3, 0.5), (0.6, 1.0)):  # with hardly a limit
        value, slopes = run(kappa, 1e7, e)
        closed = jax.value_and_grad(
            lambda k, e: ji.theory.spring_slip(0.4, e, k), argnums=(0, 1)
        )
        expected, expected_slopes = closed(kappa, e)
        close(value, expected, atol=1e-6)
        close(slopes, expected_slopes, atol=1e-5)


def test_waltons_constants():
    """Gross sliding, then the constant ratio -beta_0, with the slope in mu."""
    close(ji.theory.walton_slip(3.0, -1.0, 0.9, 0.1, 0.4), 3.0 - 0.1 * 1.9 * 3.5)
    close(ji.theory.walton_slip(-0.2, 1.0, 0.9, 0.1, 0.4), 0.08)
    slope = jax.grad(lambda mu: ji.theory.walton_slip(3.0, 1.0, 0.9, mu, 0.4))(0.1)
    close(slope, -1.9 * 3.5)


def test_kappa_of_materials():
    """Mindlin's ratio, also of one material given twice, and beside a rigid body."""
    close(ji.theory.mindlin_ratio(0.3), 2 * 0.7 / 1.7)
    close(ji.theory.mindlin_ratio(0.3, 2e11, 0.3, 2e11), 2 * 0.7 / 1.7)
    close(ji.theory.mindlin_ratio(0.3, 2e11, 0.2, np.inf), 2 * 0.7 / 1.7)
    with pytest.raises(ValueError, match="`modulus`"):
        ji.theory.mindlin_ratio(0.3, poisson2=0.2)
