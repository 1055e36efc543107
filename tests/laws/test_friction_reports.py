"""What laws with and without friction promise: tolerances, refusals, and errors that say why."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jimpact as ji

MASS = np.diag([1.3, 1.3, 1.3, 0.05, 0.04, 0.03])
ARMS = np.array([[0.15, 0.2, -0.25], [-0.15, 0.2, -0.25]])
VELOCITY = np.array([0.3, 0.2, -1.0, 1.2, -0.4, 0.7])
RTOL = {"time": 1e-11, "implicit": 1e-6}


def rows(way):
    return np.stack([np.concatenate([way, np.cross(arm, way)]) for arm in ARMS])


def on_an_edge(tangents=True):
    x, y, z = np.eye(3)
    sides = np.stack([rows(x), rows(y)], axis=1).reshape(-1, 6).T
    return ji.Scene(MASS, rows(z).T, sides if tangents else None)


@pytest.mark.release
def test_tangents_without_friction_change_nothing():
    law = ji.LZB(0.7, [1.0, 1.7])
    plain, other = (ji.impact(law, on_an_edge(t), VELOCITY) for t in (False, True))
    np.testing.assert_allclose(other.velocity, plain.velocity, atol=1e-12)


@pytest.mark.release
@pytest.mark.parametrize("friction", [None, 0.4])
def test_damped_forces_keep_rtol(friction):
    """A force that ends at an indentation has a kink, and friction needs the force of its step."""
    force = ji.KelvinVoigt([1e4, 1.7e4], 20.0)
    exact, coarse = (
        ji.impact(
            ji.Compliant(force, friction=friction, method=method, rtol=rtol),
            on_an_edge(),
            VELOCITY,
        )
        for method, rtol in RTOL.items()
    )
    speed = np.abs(VELOCITY).max()
    np.testing.assert_allclose(
        coarse.velocity, exact.velocity, atol=2 * RTOL["implicit"] * speed
    )


@pytest.mark.slow
def test_what_rtol_allows_is_no_gain_of_energy():
    """An elastic impact gains a fortieth of this rtol."""
    scene, v = ji.chain([1.0, 3.0, 2.0]), [1.0, 0.0, 0.0]
    out = ji.impact(ji.Compliant(ji.Hertz(1e4), rtol=1e-4), scene, v)
    assert int(out.status) == 0
    assert out.energy_change > 1e-6
    assert float(out.accuracy) == pytest.approx(1e-4)
    assert "VIOLATED" not in ji.summary(out, scene, v)
    gained = ji.Impact(
        out.velocity * 1.001,
        out.impulse,
        out.tangential_impulse,
        1e-3,
        0.0,
        0,
        out.accuracy,
    )
    assert not ji.audit(gained, scene, v).energetic


def test_parameters_of_a_force_of_ones_own_may_be_one_array():
    force = ji.UserForce(
        lambda x, rate, p: p[0] * x + p[1] * rate, jnp.array([1.0, 0.2])
    )
    assert float(ji.measured_restitution(force, 1.0, 1.0)) == pytest.approx(
        0.74408, abs=1e-5
    )


def test_a_law_says_what_it_takes():
    with pytest.raises(TypeError, match=r"LZB takes `restitution`, `stiffness` = 1.0"):
        ji.LZB(e=0.9)
    with pytest.raises(TypeError, match=r"Compliant takes `force`, .*'force'"):
        ji.Compliant(stiffness=1e9)


def test_open_contacts_that_a_law_leaves_out_are_named():
    scene = ji.chain([1.0, 1.0, 1.0], gaps=[1e-5, 0.0])
    with pytest.warns(
        UserWarning, match="only open contacts .* LZB leaves them out"
    ) as caught:
        out = ji.impact(ji.LZB(0.9), scene, [1.0, 0.0, 0.0])
    assert caught[0].filename == __file__
    v = jnp.array(
        [1.0, 0.0, 0.0]
    )  # inside jit the scene is known, its normals are traced
    jax.eval_shape(lambda k: ji.impact(ji.LZB(0.9, k), scene, v).velocity, jnp.ones(2))
    assert "Compliant and Binary" in ji.summary(out, scene, [1.0, 0.0, 0.0])
