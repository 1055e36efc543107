"""Moving geometry: straight chains are the frozen law; turning blocks converge to it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jimpact as ji
from jimpact import (
    Block,
    Compliant,
    ContactForces,
    Hertz,
    HuntCrossley,
    LinearSpring,
    chain,
    impact,
    scene_from_gaps,
)

GAPS = Block(1.0, 1.0).gap_function
MASS = jnp.array([1.0, 1.0, 1 / 6])
FLAT, LANDING = (
    jnp.array([0.0, 0.5, 0.0]),
    jnp.array([0.0, -0.5, -1.0]),
)  # gap rates (-1, 0)


class Turned(NamedTuple):
    """What a turning impact leaves: the state of its last event."""

    velocity: jax.Array
    position: jax.Array
    ended: jax.Array


def turning_impact(gaps, mass, q, v, force):
    """The impact of a motion by contact forces that ends with it."""
    motion = ji.simulate(
        ji.System(gaps, mass), Compliant(force), q, v, 100.0, samples=2, max_events=100,
        method=ContactForces(rtol=1e-9, until_apart=True),
    )  # fmt: skip
    events, last = motion.events, motion.events.count - 1
    ended = (motion.status == 0) & jnp.isnan(motion.q[-1, 0]) & (last >= 0)
    return Turned(events.velocity_after[last], events.q[last], ended)


@pytest.mark.release
@pytest.mark.parametrize(("force", "power"), [(LinearSpring, 1 / 2), (Hertz, 2 / 5)])
def test_frozen_geometry_is_the_stiff_limit(force, power):
    """The error of frozen geometry is of the order of indentation over size: k^(-1/(eta+1))."""
    moving = [
        turning_impact(GAPS, MASS, FLAT, LANDING, force(k)) for k in (1e6, 1e8, 1e10)
    ]
    assert all(bool(out.ended) for out in moving)
    frozen = impact(
        Compliant(force(1.0)), scene_from_gaps(GAPS, MASS, FLAT), LANDING
    ).velocity
    error = [float(jnp.abs(out.velocity - frozen).max()) for out in moving]
    assert error[1] / error[0] == pytest.approx(100**-power, rel=0.02)
    assert error[2] / error[1] == pytest.approx(100**-power, rel=0.02)
    assert error[2] < 2e-4
    energy = [float(0.5 * MASS @ out.velocity**2) for out in moving]
    np.testing.assert_allclose(energy, 0.5 * (0.25 + 1 / 6), rtol=1e-6)


@pytest.mark.slow
def test_block_on_one_corner():
    """Landing on the right corner, the left one 1e-3 up: it turns before the left one lands."""
    angle = -1e-3
    low = 0.5 * np.cos(angle) + 0.5 * np.sin(-angle)
    q, v = jnp.array([0.0, low, angle]), jnp.array([0.0, -0.5, 0.0])
    force = Hertz(1e9)
    frozen = impact(Compliant(force), scene_from_gaps(GAPS, MASS, q), v).velocity
    moving = turning_impact(GAPS, MASS, q, v, force)
    assert bool(moving.ended)
    assert float(jnp.abs(moving.velocity - frozen).max()) < 5e-3
    assert float(0.5 * MASS @ moving.velocity**2) == pytest.approx(0.125, rel=1e-6)


@pytest.mark.release
@pytest.mark.parametrize("force", [Hertz(jnp.ones(2)), HuntCrossley(1.0, 0.4)])
def test_straight_chain_does_not_turn(force):
    gaps = jnp.array([0.0, 0.2])
    v = jnp.array([1.0, 0.0, 0.0])
    out = turning_impact(
        lambda q: jnp.diff(q), jnp.ones(3), jnp.array([0.0, 0.0, 0.2]), v, force
    )
    wanted = impact(Compliant(force), chain(jnp.ones(3), gaps=gaps), v).velocity
    np.testing.assert_allclose(out.velocity, wanted, atol=1e-6)
    assert bool(out.ended)


@pytest.mark.release
def test_mass_that_depends_on_the_configuration():
    """Polar coordinates of a bouncing point: the same motion as in Cartesian ones."""

    def polar_mass(q):
        return jnp.array([1.0, 1.0]) * jnp.stack([jnp.ones(()), q[0] ** 2])

    def polar_gap(q):
        return q[0] * jnp.sin(q[1])[None] - 0.6

    q, v = jnp.array([1.0, jnp.arcsin(0.6)]), jnp.array([-0.3, -1.0])
    turn = jnp.array(
        [[jnp.cos(q[1]), -q[0] * jnp.sin(q[1])], [jnp.sin(q[1]), q[0] * jnp.cos(q[1])]]
    )
    soft = LinearSpring(20.0)
    polar = turning_impact(polar_gap, polar_mass, q, v, soft)
    cartesian = turning_impact(
        lambda q: q[1:] - 0.6, jnp.ones(2), jnp.array([0.8, 0.6]), turn @ v, soft
    )
    r, phi = polar.position
    end = jnp.array(
        [[jnp.cos(phi), -r * jnp.sin(phi)], [jnp.sin(phi), r * jnp.cos(phi)]]
    )
    np.testing.assert_allclose(end @ polar.velocity, cartesian.velocity, atol=1e-7)
    assert float(cartesian.velocity[1]) == pytest.approx(
        -float((turn @ v)[1]), abs=1e-7
    )


@pytest.mark.release
def test_derivative():
    """Beside the kink at LANDING, where one corner neither approaches nor leaves."""

    def spin(v):
        return turning_impact(GAPS, MASS, FLAT, v, Hertz(1e6)).velocity[2]

    falling = LANDING + jnp.array([0.0, -0.02, 0.0])
    slope = jax.jit(jax.jacfwd(spin))(falling)
    h = 1e-4
    value = jax.jit(spin)
    for i in (1, 2):
        step = h * jnp.eye(3)[i]
        difference = (value(falling + step) - value(falling - step)) / (2 * h)
        assert float(slope[i]) == pytest.approx(float(difference), abs=1e-6)


@pytest.mark.slow
def test_nothing_approaches():
    out = turning_impact(
        GAPS, MASS, FLAT, -LANDING, Hertz(1e6)
    )  # a corner at rest opens at once
    assert bool(out.ended)
    np.testing.assert_allclose(out.velocity, -LANDING, atol=1e-12)
