"""Motions under contact forces: a ball on a spring in closed form, losses, bad input."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import argument

import jimpact as ji

G, HEIGHT = 9.80665, 1.0


def bounces(stiffness):
    """Times of two closings and openings of a ball of 1 kg on a linear spring, and its impulses."""
    speed, w = np.sqrt(2 * G * HEIGHT), jnp.sqrt(stiffness)
    lasts = (
        2 * (np.pi - jnp.arctan(speed * w / G)) / w
    )  # x'' = g - w^2 x, back to x = 0
    first, push = speed / G, 2 * speed + G * lasts
    later = 3 * first + lasts
    return jnp.stack([first, first + lasts, later, later + lasts, push, push])


def dropped(force, end=1.0, **options):
    options = {"samples": 11, "max_events": 20} | options
    given = (
        ji.System(ji.Column([1.0]), gravity=True),
        ji.Compliant(force),
        [HEIGHT],
        [0.0],
    )
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
    np.testing.assert_allclose(
        [*rows.time[:4], *rows.impulse[1:4:2, 0]], exact, rtol=1e-9
    )
    np.testing.assert_allclose(slope, exact_slope, rtol=1e-8, atol=1e-14)
    assert motion.to_dict()["events"]["kind"] == ["contact", "detachment"] * 2
    np.testing.assert_allclose(motion.ledger_residual, 0, atol=1e-9)
    np.testing.assert_allclose(motion.energy, motion.energy[0], atol=1e-8)


@pytest.mark.slow
def test_a_plastic_contact_returns_its_share():
    """e of the speed, from the residual indentation, but for the work of the weight."""
    motion = dropped(ji.Bistiffness(1e8, 1.5, 0.8))
    speed = np.abs(np.asarray(motion.events.velocity_after)[:2, 0])
    assert speed[1] / speed[0] == pytest.approx(0.8, rel=1e-3)
    lost = 0.5 * (speed[0] ** 2 - speed[1] ** 2) - G * float(motion.events.q[1, 0])
    assert -float(jnp.sum(motion.contact_work[-1])) == pytest.approx(lost, rel=1e-9)
    np.testing.assert_allclose(motion.ledger_residual, 0, atol=1e-9)


@pytest.mark.slow
def test_a_dashpot_may_slacken_before_its_spring():
    force = ji.KelvinVoigt(1e6, 200.0)
    motion = dropped(force)
    speed = np.abs(np.asarray(motion.events.velocity_after)[:2, 0])
    assert speed[1] / speed[0] == pytest.approx(
        float(ji.measured_restitution(force, 1.0, speed[0])), rel=2e-3
    )


@pytest.mark.slow
def test_a_body_may_rest_on_its_springs():
    """Two springs carry the weight m g: nothing moves, and what is disturbed oscillates."""
    block = ji.Block(width=0.2, height=0.4, mass=2.0)
    sunk = 2.0 * G / 2 / 1e4
    given = (ji.System(block, gravity=True), ji.Compliant(ji.LinearSpring(1e4)))
    options = {"samples": 3, "method": "contact_forces", "max_events": 8}

    def run(height):
        start = (jnp.stack([0 * height, height, 0 * height]), [0.0] * 3)
        return ji.simulate(*given, *start, 0.1, **options).q

    height = jnp.asarray(0.2 - sunk)
    q, slope = jax.jit(lambda x: jax.jvp(run, (x,), (jnp.ones_like(x),)))(height)
    np.testing.assert_allclose(q, [[0.0, height, 0.0]] * 3, atol=1e-12)
    np.testing.assert_allclose(
        slope[:, 1], np.cos(100 * np.array([0, 0.05, 0.1])), atol=1e-6
    )


def on_a_slope(mu, angle):
    """A point of 1 kg that is pushed up a slope at 1 m/s, on a spring that carries it."""

    def height(q):
        return G * (q[1] * jnp.cos(angle) - q[0] * jnp.sin(angle))

    functions = {"potential": height, "tangent_function": lambda q: q[:1]}
    system = ji.System(lambda q: q[1:], [1.0, 1.0], **functions)
    law, sunk = (
        ji.Compliant(ji.LinearSpring(1e4), friction=mu),
        G * jnp.cos(angle) / 1e4,
    )
    start = jnp.stack([0 * sunk, -sunk]), jnp.stack([0 * sunk - 1, 0 * sunk])
    options = {"samples": 3, "max_events": 8, "method": "contact_forces"}
    motion = ji.simulate(system, law, *start, 1.0, **options)
    return motion.q[-1, 0], motion


def slid(mu, angle):
    """Where it is after 1 s: up to a stop, and down again unless mu > tan(angle)."""
    up = G * (jnp.sin(angle) + mu * jnp.cos(angle))
    down = jnp.maximum(G * (jnp.sin(angle) - mu * jnp.cos(angle)), 0.0)
    return -0.5 / up + 0.5 * down * (1 - 1 / up) ** 2


@pytest.mark.release
def test_friction_on_a_slope():
    """Sliding, sticking and work in closed form."""
    run = jax.jit(on_a_slope)
    for mu, angle in ((0.35, 0.3), (0.2, 0.3)):
        place, motion = run(mu, angle)
        assert float(place) == pytest.approx(float(slid(mu, angle)), abs=1e-12)
        turn = 1 / (G * (np.sin(angle) + mu * np.cos(angle)))
        assert motion.to_dict()["events"]["kind"] == ["friction"]
        assert float(motion.events.time[0]) == pytest.approx(turn, rel=1e-9)
        path = turn + float(place)  # up by turn / 2, then down to its place
        work = -mu * G * np.cos(angle) * path
        np.testing.assert_allclose(motion.contact_work[-1], [[0], [work]], atol=1e-9)
        np.testing.assert_allclose(motion.ledger_residual, 0, atol=1e-9)


@pytest.mark.release
def test_derivatives_of_friction_on_a_slope():
    """In reverse mode, of the rest on its spring too."""
    run = jax.jit(jax.grad(on_a_slope, (0, 1), has_aux=True))
    for start in ((0.35, 0.3), (0.2, 0.3)):
        np.testing.assert_allclose(
            run(*start)[0], jax.grad(slid, (0, 1))(*start), atol=1e-8
        )


@pytest.mark.release
def test_a_ball_in_space_slides_and_rolls():
    """Slip at 1.25 m/s ends at 2 u / (7 mu g), in rolling at 5/7 of it; a bounce gives mu p."""
    ball, stiffness, mu = ji.Sphere(0.1), 1e3, 0.2
    system, law = ji.System(ball, gravity=True), ji.LinearSpring(stiffness)
    law = ji.Compliant(law, friction=mu)
    options = {"samples": 3, "max_events": 8, "method": "contact_forces"}
    at, along = (
        [0.0, 0.0, 0.1 - G / stiffness, 1.0, 0.0, 0.0, 0.0],
        np.array([0.75, 1.0]),
    )
    motion = ji.simulate(system, law, at, [*along, 0, 0, 0, 0], 1.0, **options)
    assert float(motion.events.time[0]) == pytest.approx(
        2 * 1.25 / (7 * mu * G), rel=1e-9
    )
    rolls = [*along * 5 / 7, 0, *np.array([-along[1], along[0]]) * 50 / 7, 0]
    np.testing.assert_allclose(motion.velocity[-1], rolls, atol=1e-9)
    np.testing.assert_allclose(motion.ledger_residual, 0, atol=1e-9)
    at[2], along = 0.11, 2 * along
    motion = ji.simulate(system, law, at, [*along, -0.2, 0, 0, 0], 0.2, **options)
    push, side = (
        x[1] for x in (motion.events.impulse, motion.events.tangential_impulse)
    )
    lost = mu * push[0] * along / np.linalg.norm(along)
    np.testing.assert_allclose(side, -lost, rtol=1e-9)
    np.testing.assert_allclose(
        motion.events.velocity_after[1, :2], along - lost, atol=1e-9
    )


@pytest.mark.release
def test_a_block_comes_to_rest_with_friction():
    """On its side, on two damped springs that sink in differently until then."""
    law = ji.Compliant(ji.KelvinVoigt(1e5, 100.0), friction=0.6)
    options = {"samples": 11, "max_events": 1000, "method": "contact_forces"}
    motion = ji.simulate(
        ji.System(ji.Block(0.2, 0.3), gravity=True),
        law,
        [0, 0.4, 0.3],
        [1.0, 0, 2.0],
        3.0,
        **options,
    )
    ji.raise_on_failure(motion)
    np.testing.assert_allclose(motion.velocity[-1], 0, atol=1e-12)
    assert float(motion.q[-1, 1]) == pytest.approx(0.1 - G / 2e5, abs=1e-9)
    np.testing.assert_allclose(motion.ledger_residual, 0, atol=1e-9)


@pytest.mark.release
def test_a_box_strikes_on_its_corners_with_friction():
    """In space: no energy is gained, and friction takes what the ledger says."""
    box = ji.Box([0.2, 0.3, 0.1])
    system = ji.System(box, gravity=True)
    law = ji.Compliant(ji.Bistiffness(1e7, 1.5, 0.5), friction=0.4)
    at = [0, 0, 0.3, 0.9, 0.1, 0.3, 0.09**0.5]
    options = {"samples": 5, "max_events": 400, "method": "contact_forces"}
    motion = ji.simulate(system, law, at, [1.0, 0, 0, 1.0, 2.0, 3.0], 0.6, **options)
    ji.raise_on_failure(motion)
    assert int(motion.events.count) > 10
    assert float(jnp.max(jnp.diff(motion.energy))) < 1e-9
    np.testing.assert_allclose(motion.ledger_residual, 0, atol=1e-9)


@pytest.mark.release
def test_a_box_that_lands_flat_drags_a_corner_through_its_end_of_slip():
    """Beside Radau with regularized friction, eps = 1e-7 m/s (scipy), of which 1e-6 are left."""
    size, turn = [0.2, 0.14, 0.1], 0.26
    system = ji.System(ji.Box(size, mass=1.7), gravity=True)
    law = ji.Compliant(ji.HuntCrossley(3.56e4, 0.83), friction=0.24)
    q = [0, 0, 0.0501, math.cos(turn), 0, 0, math.sin(turn)]
    v = [0.26, 0.12, -0.86, 0.39, 0.52, -3.57]
    motion = ji.simulate(
        system,
        law,
        q,
        v,
        0.03,
        method=ji.ContactForces(max_steps=5000),
        samples=3,
        max_events=50,
    )
    ji.raise_on_failure(motion)
    end = [-0.015664, -0.00104, 0.498739, -0.127854, -0.290198, -0.000231]
    np.testing.assert_allclose(motion.velocity[-1], end, atol=3e-6)
    np.testing.assert_allclose(motion.ledger_residual, 0, atol=1e-11)


def test_what_contact_forces_need():
    ball = (
        ji.System(ji.Column([1.0]), gravity=True),
        ji.Newton(0.5),
        [1.0],
        [0.0],
        1.0,
    )
    with pytest.raises(TypeError, match=argument("law")):
        ji.simulate(*ball, method="contact_forces")


def test_a_body_under_loads_is_a_system():
    """The ready systems are bodies under gravity; functions make a body, too."""
    block = ji.Block(width=0.2, height=0.6, mass=2.0)
    system, q = (
        ji.System(ji.Block(0.2, 0.6, 2.0), gravity=True),
        jnp.array([0.1, 0.7, 0.3]),
    )

    def slid(q):
        c = block.corners
        return q[0] + jnp.cos(q[2]) * c[:, 0] - jnp.sin(q[2]) * c[:, 1]

    given = ji.System(block.gap_function, block.mass, tangent_function=slid)
    for body in (system.body, given.body):
        scene = body.scene(q)
        for found, own in zip(
            jax.tree.leaves(scene), jax.tree.leaves(block.scene(q)), strict=True
        ):
            np.testing.assert_allclose(found, own, atol=1e-15)
    assert float(system.potential(q)) == pytest.approx(2.0 * G * 0.7)
    with pytest.raises(ValueError, match=argument("mass")):
        ji.System(block, block.mass)
    with pytest.raises(TypeError, match="FunctionBody has no vertical"):
        ji.System(block.gap_function, block.mass, gravity=True)
    with pytest.raises(ValueError, match="`potential`"):
        ji.System(block, potential=ji.gravity(block), gravity=True)


@pytest.mark.slow
def test_a_contact_opens_where_a_force_that_is_positive_at_touch_ends():
    """An elastic force of 5 N + k x: from .2 m a ball comes back to .2 m, however often it bounces."""
    ball = ji.System(ji.Column([0.7]), gravity=9.81)
    law = ji.Compliant(ji.UserForce(lambda x, rate, p: 5.0 + 800.0 * x))
    motion = ji.simulate(
        ball, law, [0.2], [0.0], 1.3, samples=131, method="contact_forces"
    )
    assert ji.STATUS[int(motion.status)].name == "ok"
    energy = np.asarray(motion.kinetic_energy + motion.potential_energy)
    free = np.asarray(motion.q[:, 0]) > 0
    np.testing.assert_allclose(energy[free], 0.7 * 9.81 * 0.2, rtol=1e-6)
