"""Motions under contact forces: a ball on a spring in closed form, losses, bad input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jimpact as ji

G, HEIGHT = 9.80665, 1.0


def bounces(stiffness):
    """Times of two closings and openings of a ball of 1 kg on a linear spring, and its impulses."""
    speed, w = np.sqrt(2 * G * HEIGHT), jnp.sqrt(stiffness)
    lasts = 2 * (np.pi - jnp.arctan(speed * w / G)) / w  # x'' = g - w^2 x, back to x = 0
    first, push = speed / G, 2 * speed + G * lasts
    later = 3 * first + lasts
    return jnp.stack([first, first + lasts, later, later + lasts, push, push])


def dropped(force, end=1.0, **options):
    options = {"samples": 11, "max_events": 20} | options
    given = (ji.ball_system(), ji.Compliant(force), [HEIGHT], [0.0])
    return ji.simulate(*given, end, method="contact_forces", **options)


def test_ball_on_a_linear_spring():
    """Values, and derivatives in reverse mode."""

    def run(stiffness):
        motion = dropped(ji.LinearSpring(stiffness), 1.6, samples=6)
        rows = motion.events
        return jnp.stack([*rows.time[:4], *rows.impulse[1:4:2, 0]]), motion

    stiffness = jnp.asarray(1e4)
    slope, motion = jax.jit(jax.jacrev(run, has_aux=True))(stiffness)
    exact, exact_slope = jax.jvp(bounces, (stiffness,), (1.0,))
    rows = motion.events
    np.testing.assert_allclose([*rows.time[:4], *rows.impulse[1:4:2, 0]], exact, rtol=1e-9)
    np.testing.assert_allclose(slope, exact_slope, rtol=1e-8, atol=1e-14)
    assert motion.to_dict()["events"]["kind"] == ["contact", "detachment"] * 2
    np.testing.assert_allclose(motion.ledger_residual, 0, atol=1e-9)
    np.testing.assert_allclose(motion.energy, motion.energy[0], atol=1e-8)


def test_a_plastic_contact_returns_its_share():
    """e of the speed, from the residual indentation, but for the work of the weight."""
    motion = dropped(ji.Bistiffness(1e8, 1.5, 0.8))
    speed = np.abs(np.asarray(motion.events.velocity_after)[:2, 0])
    assert speed[1] / speed[0] == pytest.approx(0.8, rel=1e-3)
    lost = 0.5 * (speed[0] ** 2 - speed[1] ** 2) - G * float(motion.events.q[1, 0])
    assert -float(jnp.sum(motion.contact_work[-1])) == pytest.approx(lost, rel=1e-9)
    np.testing.assert_allclose(motion.ledger_residual, 0, atol=1e-9)


def test_a_dashpot_may_slacken_before_its_spring():
    force = ji.KelvinVoigt(1e6, 200.0)
    motion = dropped(force)
    speed = np.abs(np.asarray(motion.events.velocity_after)[:2, 0])
    assert speed[1] / speed[0] == pytest.approx(
        float(ji.measured_restitution(force, 1.0, speed[0])), rel=2e-3
    )


def test_a_body_may_rest_on_its_springs():
    """Two springs carry the weight m g: nothing moves."""
    block = ji.Block(width=0.2, height=0.4, mass=2.0)
    sunk = 2.0 * G / 2 / 1e4
    given = (ji.System(block, potential=ji.gravity(block)), ji.Compliant(ji.LinearSpring(1e4)))
    start = ([0.0, 0.2 - sunk, 0.0], [0.0] * 3)
    motion = ji.simulate(*given, *start, 0.1, samples=3, method="contact_forces")
    np.testing.assert_allclose(motion.q, [start[0]] * 3, atol=1e-12)


def test_what_contact_forces_need():
    ball = (ji.ball_system(), ji.Newton(0.5), [1.0], [0.0], 1.0)
    with pytest.raises(TypeError, match="`law` must use gaps and have a `contact_force`"):
        ji.simulate(*ball, method="contact_forces")
    block, law = ji.block_system(1.0, 1.0), ji.Compliant(ji.Hertz(1e6))
    with pytest.raises(ValueError, match="`friction` must be 0"):
        ji.simulate(block, law, [0, 1, 0], [0] * 3, 1.0, friction=0.1, method="contact_forces")


def test_a_body_under_loads_is_a_system():
    """The ready systems are bodies under gravity; functions make a body, too."""
    block = ji.Block(width=0.2, height=0.6, mass=2.0)
    system, q = ji.block_system(0.2, 0.6, 2.0), jnp.array([0.1, 0.7, 0.3])
    given = ji.System(block.gap_function, block.mass, tangent_function=block.tangent_function)
    for body in (system.body, given.body):
        scene = body.scene(q)
        for found, own in zip(jax.tree.leaves(scene), jax.tree.leaves(block.scene(q)), strict=True):
            np.testing.assert_allclose(found, own, atol=1e-15)
    assert float(system.potential(q)) == pytest.approx(2.0 * G * 0.7)
    with pytest.raises(ValueError, match="must not be given with a body"):
        ji.System(block, block.mass)
    with pytest.raises(TypeError, match="DiskBalls has no vertical"):
        ji.gravity(ji.DiskBalls(1.0, 0.1, 1.0, [1.0]))
