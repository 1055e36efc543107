"""Motions under contact forces with tangential springs: closed forms, impacts, Radau."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import argument
from spring_cases import G, SpringBox

import jimpact as ji

MASS = 1.3  # [kg]
STIFFNESS = 1e5  # [N/m] of the normal springs


def moved(system, law, q, v, end, **options):
    """The motion by contact forces, which must be `ok`."""
    given = {"samples": 5, "max_events": 40, "method": "contact_forces"}
    motion = ji.simulate(system, law, q, v, end, **(given | options))
    return motion


def slid_point(speed, mu, kappa):
    """A point that is pushed along a floor, on a spring that carries it."""
    functions = {"tangent_function": lambda q: q[:1]}
    system = ji.System(
        lambda q: q[1:], [MASS, MASS], potential=lambda q: MASS * G * q[1], **functions
    )
    law = ji.Compliant(
        ji.LinearSpring(STIFFNESS), friction=mu, tangential_stiffness=kappa
    )
    sunk = MASS * G / STIFFNESS + 0 * speed
    start = jnp.stack([0 * speed, -sunk]), jnp.stack([speed, 0 * speed])
    return moved(system, law, *start, 0.5)


def slid(speed, mu, kappa, t, inertia=1.0):
    """Time of its stop, place and speed: the spring is charged, slides, swings.

    `inertia`: W_tt m, by which slip is easier to stop.
    """
    stiffness = kappa * STIFFNESS
    frequency = jnp.sqrt(inertia * stiffness / MASS)
    limit = mu * MASS * G / stiffness
    gives_way = jnp.arcsin(frequency * limit / speed) / frequency
    left = jnp.sqrt(speed**2 - (frequency * limit) ** 2)
    stop = gives_way + left / (inertia * mu * G)
    slides = left**2 / (2 * inertia * mu * G)  # speed^2 / (2 mu g) of a stiff spring
    phase = frequency * (t - stop)
    return stop, slides + limit * jnp.cos(phase), -limit * frequency * jnp.sin(phase)


@pytest.mark.slow
def test_a_point_slides_to_rest_and_swings_on_its_spring():
    """Place, speed and work in closed form, with derivatives in speed, mu and kappa."""

    def run(speed, mu, kappa):
        motion = slid_point(speed, mu, kappa)
        end = jnp.stack(
            [motion.events.time[1], motion.q[-1, 0], motion.velocity[-1, 0]]
        )
        return end, (end, motion)

    given = jnp.asarray(1.0), jnp.asarray(0.35), jnp.asarray(0.8)
    slopes, aux = jax.jit(jax.jacrev(run, (0, 1, 2), has_aux=True))(*given)
    found, motion = aux
    assert ji.STATUS[int(motion.status)].name == "ok"
    assert motion.to_dict()["events"]["kind"] == ["friction"] * 2

    def closed(*given):
        return jnp.stack(slid(*given, 0.5))

    np.testing.assert_allclose(found, closed(*given), rtol=1e-8)
    exact = jax.jacrev(closed, (0, 1, 2))(*given)
    np.testing.assert_allclose(slopes, exact, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(motion.ledger_residual, 0, atol=1e-12)
    _, place, _ = slid(*given, 0.5)
    limit = 0.35 * MASS * G / (0.8 * STIFFNESS)
    rests = place - slid_limit(*given)
    lost = 0.35 * MASS * G * slid_limit(*given) + 0.4 * STIFFNESS * rests**2
    assert float(motion.contact_work[-1, 1, 0]) == pytest.approx(-float(lost), rel=1e-7)
    assert abs(float(rests)) <= limit
    # stiff springs: speed^2 / (2 mu g)
    assert float(place) == pytest.approx(1 / (2 * 0.35 * G), rel=1e-3)


def slid_limit(speed, mu, kappa):
    """Distance [m] on which friction dissipates."""
    stiffness = kappa * STIFFNESS
    square = speed**2 - (mu * G) ** 2 * MASS / stiffness
    return square / (2 * mu * G)


@pytest.mark.slow
def test_a_ball_in_space_slides_until_it_rolls():
    """Slip of 1.25 m/s ends at 2 u / (7 mu g), but for the spring; with 5/7 of the speed."""
    mu = 0.2
    kappa = 0.8
    law = ji.Compliant(
        ji.LinearSpring(STIFFNESS), friction=mu, tangential_stiffness=kappa
    )
    at = [0.0, 0.0, 0.1 - MASS * G / STIFFNESS, 1.0, 0.0, 0.0, 0.0]
    along = np.array([0.75, 1.0])
    system = ji.System(ji.Sphere(0.1, mass=MASS), gravity=True)
    motion = moved(system, law, at, [*along, 0, 0, 0, 0], 0.19, samples=2)
    assert ji.STATUS[int(motion.status)].name == "ok"
    assert motion.to_dict()["events"]["kind"] == ["friction"] * 2
    stop, _, _ = slid(1.25, mu, kappa, 0.19, inertia=3.5)
    assert float(motion.events.time[1]) == pytest.approx(float(stop), rel=1e-8)
    assert float(stop) == pytest.approx(2 * 1.25 / (7 * mu * G), rel=2e-3)
    np.testing.assert_allclose(
        motion.events.velocity_after[1, :2], along * 5 / 7, atol=1e-8
    )


@pytest.mark.slow
def test_springs_hold_a_box_that_turns_back_and_forth():
    """About the vertical: `Omega^2 = 4 k_t rho^2 / I`, of four springs rho from the axis."""
    size = np.array([0.2, 0.1, 0.06])
    kappa = 0.7
    law = ji.Compliant(
        ji.LinearSpring(STIFFNESS), friction=0.5, tangential_stiffness=kappa
    )
    reach = 0.25 * (size[0] ** 2 + size[1] ** 2)  # rho^2
    inertia = MASS * (size[0] ** 2 + size[1] ** 2) / 12
    frequency = np.sqrt(4 * kappa * STIFFNESS * reach / inertia)
    period = 2 * np.pi / frequency
    at = [0.0, 0.0, 0.03 - MASS * G / (4 * STIFFNESS), 1.0, 0.0, 0.0, 0.0]
    spin = 1e-3  # [rad/s]; it holds, and turns by too little to be seen
    system = ji.System(ji.Box(size, mass=MASS), gravity=True)
    motion = moved(system, law, at, [0, 0, 0, 0, 0, spin], 10.25 * period, samples=42)
    assert ji.STATUS[int(motion.status)].name == "ok"
    assert int(motion.events.count) == 0
    exact = spin * np.cos(frequency * motion.time)
    np.testing.assert_allclose(motion.velocity[:, 5], exact, atol=1e-6 * spin)


@pytest.mark.parametrize("speed", [0.3, 1.5, 8.0])
def test_a_ball_bounces_as_by_an_impact(speed):
    """Its spring holds, or slides from the beginning and holds before it opens, or slides throughout."""
    law = ji.Compliant(ji.Hertz(1e7), friction=0.3, tangential_stiffness=0.8)
    ball = ji.Sphere(0.1, mass=MASS)
    system = ji.System(ball)
    q = np.array([0.0, 0.0, 0.1, 1.0, 0.0, 0.0, 0.0])
    v = np.array([0.6 * speed, -0.8 * speed, -1.0, 0.0, 0.0, 0.5])
    motion = moved(system, law, q, v, 0.02, samples=2)
    assert ji.STATUS[int(motion.status)].name == "ok"
    out = ji.impact(law, ball.scene(q), v)
    # angular velocities are along axes of the ball, which turns meanwhile
    np.testing.assert_allclose(motion.velocity[-1, :3], out.velocity[:3], atol=2e-6)
    lifted = motion.to_dict()["events"]["kind"].index("detachment")
    side = np.linalg.norm(motion.events.tangential_impulse[lifted])
    assert side <= 0.3 * float(motion.events.impulse[lifted, 0]) * (1 + 1e-9)


@pytest.mark.parametrize("speed", [0.3, 1.5, 8.0])
def test_a_disc_bounces_as_by_an_impact(speed):
    """In the plane, with e < 1; it may slide from the first instant of the motion."""
    force = ji.Bistiffness(1e6, 1.5, 0.8)
    law = ji.Compliant(force, friction=0.3, tangential_stiffness=0.8)
    disc = ji.Disc(0.1, MASS)
    q = np.array([0.0, 0.1, 0.0])
    v = np.array([speed, -1.0, 0.5])
    motion = moved(ji.System(disc), law, q, v, 0.02, samples=2)
    assert ji.STATUS[int(motion.status)].name == "ok"
    out = ji.impact(law, disc.scene(q), v)
    np.testing.assert_allclose(motion.velocity[-1], out.velocity, atol=2e-6)


def test_springs_are_refused_where_tangents_turn():
    balls = ji.Bodies([ji.Sphere(0.1), ji.Sphere(0.1)], pairs=[(0, 1)])
    law = ji.Compliant(ji.Hertz(1e7), friction=0.3, tangential_stiffness=0.8)
    q = balls.at([[0.0, 0.0, 0.2], [0.0, 0.3, 0.2]])
    with pytest.raises(ValueError, match=argument("tangential_stiffness")):
        moved(ji.System(balls), law, q, np.zeros(12), 0.1)


SIZE = np.array([0.15, 0.1, 0.06])
MU = 0.4
KAPPA = 0.8
SPEED = [0.4, 0.2, -0.6, 1.5, -2.0, 3.0]
TURN = [0.97, 0.1, 0.2, 0.05]


@pytest.mark.slow
def test_a_box_that_strikes_on_its_corners_agrees_with_radau():
    law = ji.Compliant(
        ji.LinearSpring(STIFFNESS), friction=MU, tangential_stiffness=KAPPA
    )
    turn = np.array(TURN) / np.linalg.norm(TURN)
    box = ji.Box(SIZE, mass=MASS)
    q = np.array([0.0, 0.0, 0.075, *turn])
    motion = moved(ji.System(box, gravity=True), law, q, SPEED, 0.08, max_events=200)
    assert ji.STATUS[int(motion.status)].name == "ok"
    assert int(motion.events.count) > 8
    reference = SpringBox(SIZE, MASS, STIFFNESS, MU, KAPPA)
    exact = reference.velocity(q, np.array(SPEED), 0.08)
    np.testing.assert_allclose(motion.velocity[-1], exact, atol=5e-5)
    np.testing.assert_allclose(motion.ledger_residual, 0, atol=1e-11)
    other = ji.Compliant(
        ji.LinearSpring(STIFFNESS), friction=MU, tangential_stiffness=0.5
    )
    wrong = moved(ji.System(box, gravity=True), other, q, SPEED, 0.08, max_events=200)
    assert np.abs(wrong.velocity[-1] - exact).max() > 1e-2


@pytest.mark.release
def test_derivatives_of_a_box_with_springs_agree_with_differences():
    """Along mu, kappa, e and k at once, of springs that hold, slide and drag."""
    turn = np.array(TURN) / np.linalg.norm(TURN)
    q = np.array([0.0, 0.0, 0.075, *turn])
    system = ji.System(ji.Box(SIZE, mass=MASS), gravity=True)

    def run(change):
        force = ji.Bistiffness(STIFFNESS * (1 + change), 1.0, 0.7 + change)
        law = ji.Compliant(
            force, friction=MU + change, tangential_stiffness=KAPPA + change
        )
        return moved(system, law, q, SPEED, 0.045).velocity[-1]

    def with_slope(change):
        return jax.jvp(run, (change,), (jnp.ones_like(change),))

    both = jax.jit(with_slope)
    _, slope = both(jnp.asarray(0.0))
    step = 1e-5
    above, _ = both(jnp.asarray(step))
    below, _ = both(jnp.asarray(-step))
    difference = (above - below) / (2 * step)
    size = float(jnp.max(jnp.abs(slope)))
    np.testing.assert_allclose(slope, difference, atol=1e-6 * size)
