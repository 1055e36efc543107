"""Motions with friction in space, event by event: closed forms and time stepping."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from motion_in_space_cases import BRICK, SYSTEM, thrown

import jimpact as ji
from jimpact.bodies.base import STANDARD_GRAVITY as G
from jimpact.motion.flow import Scales, Settings, State, flow_of, packed
from jimpact.motion.persistent_contact import (
    Modes,
    by_contact,
    choose_with_friction,
    contacts_at,
    direction,
    forces,
    no_modes,
)
from jimpact.motion.record import EVENT_KINDS

pytestmark = pytest.mark.release  # they compile programs of their own

RADIUS = 0.1


class Pull(eqx.Module):
    """A force on the middle that grows with time and turns: rate [N/s], turning [rad/s]."""

    rate: jax.Array
    turning: jax.Array

    def __call__(self, q, v, t):
        angle = self.turning * t
        push = self.rate * t * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        return jnp.concatenate([push, jnp.zeros(4, t.dtype)])


def on_slope(speed, across, mu, tilt, rate, turning, duration=0.6):
    """A sphere of 1 kg that slides down (x) and `across` (y, rad) a slope, and is pulled."""
    normal = jnp.stack([jnp.sin(tilt), 0 * tilt, jnp.cos(tilt)])
    ball = ji.Sphere(RADIUS, normal=normal)
    system = ji.System(ball, force=Pull(rate, turning), potential=ji.gravity(ball))
    down = jnp.stack([jnp.cos(tilt), 0 * tilt, -jnp.sin(tilt)])
    velocity = speed * (jnp.cos(across) * down + jnp.sin(across) * jnp.eye(3)[1])
    q0 = jnp.concatenate([RADIUS * normal, jnp.array([1.0, 0, 0, 0])])
    v0 = jnp.concatenate([velocity, jnp.zeros(3)])
    return ji.simulate(
        system, ji.Moreau(0.5, friction=mu), q0, v0, duration, samples=3, max_events=5
    )  # fmt: skip


def rolls(x):
    """When a sphere begins to roll, how fast, and what friction took; u' = g e_x - c u / |u|.

    `c |u| + g u_x` changes at the rate g^2 - c^2, whichever way u turns.
    """
    speed, across, mu, tilt = x[:4]
    g, c = G * jnp.sin(tilt), 3.5 * mu * G * jnp.cos(tilt)
    time = (c * speed + g * speed * jnp.cos(across)) / (c**2 - g**2)
    e = jnp.stack([jnp.cos(across), jnp.sin(across)])
    down = jnp.array([1.0, 0.0])
    return time, 5 / 7 * speed * e + 5 / 7 * g * time * down


ROWS = [
    (0.7, 0.3, 0.3, 0.0, 0.0, 0.0),  # level
    (0.7, 0.0, 0.3, 0.2, 0.0, 0.0),  # straight down
    (0.7, 2.0, 0.3, 0.2, 0.0, 0.0),  # across: slip turns
    (
        0.0,
        0.0,
        0.3,
        np.arctan(1.2),
        0.0,
        0.0,
    ),  # from rest, steeper than 7/2 mu: it slides on
    (0.0, 0.0, 0.3, np.arctan(0.9), 0.0, 0.0),  # it rolls
    (0.0, 0.0, 0.1, 0.0, 14.0, 0.0),  # pulled until it slides
    (0.0, 0.0, 0.1, 0.0, 14.0, 3.0),  # while the pull turns
]


@pytest.fixture(scope="module")
def spheres():
    return jax.jit(jax.vmap(on_slope))(*np.array(ROWS).T)


def lane(motions, i):
    return jax.tree.map(lambda x: x[i], motions)


def kinds(motion):
    return [EVENT_KINDS[k] for k in motion.events.kind[: int(motion.events.count)]]


def on_plane(v, tilt):
    """Velocities (.., 2) down and across a slope."""
    return np.stack(
        [v[..., 0] * np.cos(tilt) - v[..., 2] * np.sin(tilt), v[..., 1]], axis=-1
    )


@pytest.mark.slow
@pytest.mark.parametrize("row", [0, 1, 2])
def test_a_sphere_slides_until_it_rolls(spheres, row):
    motion, (time, velocity) = lane(spheres, row), rolls(jnp.array(ROWS[row]))
    assert kinds(motion) == ["friction"]
    np.testing.assert_allclose(motion.events.time[0], time, rtol=1e-9)
    after = on_plane(np.asarray(motion.events.velocity_after[0]), ROWS[row][3])
    np.testing.assert_allclose(after, velocity, atol=1e-9)
    np.testing.assert_allclose(motion.ledger_residual, 0, atol=1e-11)


@pytest.mark.slow
def test_a_level_sphere_keeps_five_sevenths(spheres):
    motion = lane(spheres, 0)
    np.testing.assert_allclose(
        motion.events.time[0], 2 * 0.7 / (7 * 0.3 * G), rtol=1e-13
    )
    np.testing.assert_allclose(np.linalg.norm(motion.velocity[-1, :2]), 0.5, rtol=1e-14)


@pytest.mark.slow
def test_a_sphere_slides_or_rolls_from_rest(spheres):
    for row, share in ((3, 1.2 - 0.3), (4, 0.9 * 5 / 7)):
        motion, tilt = lane(spheres, row), ROWS[row][3]
        way = 0.5 * share * G * np.cos(tilt) * 0.6**2
        assert kinds(motion) == []
        np.testing.assert_allclose(
            motion.q[-1, 0] - motion.q[0, 0], way * np.cos(tilt), rtol=1e-12
        )


@pytest.mark.slow
def test_a_sphere_that_is_pulled_begins_to_slide(spheres):
    """At 2/7 of the pull = mu m g; then v' = (pull - mu m g) / m."""
    motion, start = lane(spheres, 5), 0.1 * G * 3.5 / 14
    assert kinds(motion) == ["friction"]
    np.testing.assert_allclose(motion.events.time[0], start, rtol=1e-9)
    speed = 5 / 7 * 7 * start**2 + 7 * (0.6**2 - start**2) - 0.1 * G * (0.6 - start)
    np.testing.assert_allclose(motion.velocity[-1, 0], speed, rtol=1e-9)
    np.testing.assert_allclose(motion.ledger_residual, 0, atol=1e-10)


@pytest.mark.slow
def test_slip_that_begins_turns_with_the_forces(spheres):
    """Radau's method for `u / sqrt(u^2 + 1e-20)`."""
    from scipy.integrate import solve_ivp

    start, friction = 0.1 * G * 3.5 / 14, 0.1 * G

    def pull(t):
        return 14 * t * np.array([np.cos(3 * t), np.sin(3 * t)])

    def rates(t, y):
        d = y[2:] / np.sqrt(y[2:] @ y[2:] + 1e-20)
        return np.concatenate([pull(t) - friction * d, pull(t) - 3.5 * friction * d])

    options = {"method": "Radau", "rtol": 1e-11, "atol": 1e-13}
    stick = solve_ivp(
        lambda t, y: 5 / 7 * pull(t), (0, start), [0.0, 0.0], **options
    ).y[:, -1]
    first = np.concatenate([stick, 1e-14 * pull(start)])
    end = solve_ivp(rates, (start, 0.6), first, **options).y[:2, -1]
    np.testing.assert_allclose(lane(spheres, 6).velocity[-1, :2], end, atol=3e-8)


@pytest.mark.release
def test_derivatives_of_a_sphere_that_begins_to_roll():
    """Both modes, at slip that turns until it ends; those of the closed form are exact."""
    x = jnp.array(ROWS[2][:4])

    def ends(x):
        motion = on_slope(*x, 0.0, 0.0)
        v, tilt = motion.events.velocity_after[0], x[3]
        down = v[0] * jnp.cos(tilt) - v[2] * jnp.sin(tilt)
        return jnp.stack([motion.events.time[0], down, v[1]])

    exact = jax.jacfwd(lambda x: jnp.append(rolls(x)[0], rolls(x)[1]))(x)
    np.testing.assert_allclose(jax.jacfwd(ends)(x), exact, atol=1e-6)
    np.testing.assert_allclose(jax.jacrev(ends)(x), exact, atol=1e-6)


@pytest.mark.release
def test_a_box_slides_to_rest():
    motion = thrown(BRICK.touching(), [1.0, 0.5, 0, 0, 0, 0], 0.6)
    speed = np.hypot(1.0, 0.5)
    assert kinds(motion) == ["friction"]
    np.testing.assert_allclose(motion.events.time[0], speed / (0.4 * G), rtol=1e-9)
    way = speed**2 / (2 * 0.4 * G)
    np.testing.assert_allclose(
        motion.q[-1, :2], way * np.array([1.0, 0.5]) / speed, atol=1e-10
    )


COIN = ji.Coin(0.1, 0.02, mass=0.5)


ROLLS = ji.System(COIN, gravity=True)


TILT, TURNS = 0.9, 5.0  # [rad] between coin and ground, [rad/s] about the vertical


def steadily():
    """q0, v0, radius of the circle and speed of the centre of a coin that rolls steadily.

    With d from the lowest point of the rim up the face, n along the axis, spin w about n and
    precession W about the vertical: `L = I_1 W sin(tilt) d + I_3 w n`, and `L' = W z x L` is the
    moment of the forces at the lowest point, `m g z` and `m W^2 r` toward the axis of precession.
    """
    a, b, m, (across, _, along) = 0.1, 0.01, 0.5, np.asarray(COIN.inertia)
    sine, cosine = np.sin(TILT), np.cos(TILT)
    high, inward = (
        a * sine + b * cosine,
        a * cosine - b * sine,
    )  # centre from the lowest point
    moment = (
        across * TURNS**2 * sine * cosine
        + m * b * TURNS**2 * sine * high
        - m * G * inward
    )
    spin = moment / (TURNS * (along * sine + m * a * high))
    speed = a * spin - b * TURNS * sine
    q0 = COIN.touching([np.cos(TILT / 2), 0.0, -np.sin(TILT / 2), 0.0])
    v0 = [0.0, speed, 0.0, TURNS * sine, 0.0, spin]
    return q0, np.array(v0), speed / TURNS, speed


def test_forces_of_a_coin_that_rolls_steadily():
    """Its centre is drawn to the axis of precession; its axes turn as the spin says."""
    q, v, _, speed = steadily()

    @jax.jit
    def held(q, v):
        contacts = contacts_at(ROLLS, q, v, jnp.zeros(()), True)
        touch = contacts.normal.value < 1e-9
        force = forces(
            contacts, jnp.ones(2), Modes(touch, touch, jnp.ones(2)), jnp.zeros((2, 2))
        )
        return contacts.normal, force.normal, force.acceleration

    normal, push, acceleration = held(q, v)
    np.testing.assert_allclose(normal.value, [0, 0.02 * np.cos(TILT)], atol=1e-15)
    np.testing.assert_allclose(normal.rate, 0, atol=1e-15)
    np.testing.assert_allclose(push, [0.5 * G, 0], rtol=1e-12, atol=1e-12)
    turn = (v[5] - TURNS * np.cos(TILT)) * TURNS * np.sin(TILT)
    expected = [-TURNS * speed, 0, 0, 0, -turn, 0]
    np.testing.assert_allclose(acceleration, expected, atol=1e-11)


@pytest.mark.release
def test_a_coin_rolls_in_a_circle():
    q0, v0, radius, _ = steadily()
    law = ji.Moreau(0.0, friction=0.9)
    motion = ji.simulate(ROLLS, law, q0, v0, 1.0, samples=5, max_events=5)
    assert ji.STATUS[int(motion.status)].name == "ok"
    assert kinds(motion) == []
    angle = TURNS * np.asarray(motion.time)
    x, y = radius * (np.cos(angle) - 1), radius * np.sin(angle)
    way = np.stack([x, y, 0 * x], axis=1) + np.asarray(q0[:3])
    np.testing.assert_allclose(motion.q[:, :3], way, atol=1e-9)
    np.testing.assert_allclose(motion.contact_work, 0, atol=1e-12)


def sliding(x):
    """Contact forces on a brick flat on the ground at x = (v_x, v_y, omega_z, mu)."""
    q, still = BRICK.touching(), jnp.zeros(())
    contacts = contacts_at(
        SYSTEM, q, jnp.zeros(6).at[jnp.array([0, 1, 5])].set(x[:3]), still, True
    )
    touch = contacts.normal.value < 1e-9
    slip = direction(by_contact(contacts.tangent.rate, 8))
    modes = Modes(touch, touch & False, jnp.ones(8))
    return forces(contacts, x[3] * jnp.ones(8), modes, slip).normal


def test_forces_of_a_brick_that_slides_flat_have_derivatives():
    """Redundant contacts share the load in a way that does not depend on their slip."""
    x, h = jnp.array([0.9, -0.2, 3.0, 0.15]), 1e-4
    share = jax.jit(lambda x: (sliding(x), jax.jacfwd(sliding)(x)))
    normal, slope = share(x)
    np.testing.assert_allclose(normal.sum(), 0.5 * G, rtol=1e-12)
    # least squares: no part along the load of corners that cancels itself
    np.testing.assert_allclose(
        normal @ jnp.array([1.0, 0, -1, 0, -1, 0, 1, 0]), 0, atol=1e-11
    )
    central = [
        (share(x + h * e)[0] - share(x - h * e)[0]) / (2 * h) for e in jnp.eye(4)
    ]
    np.testing.assert_allclose(slope, jnp.stack(central, axis=1), atol=1e-6)


def test_corners_of_an_edge_do_not_pull_each_other():
    """A brick that rolls over an edge, which lies across both tangents of its corners."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_euler("z", 0.7) * Rotation.from_euler("x", 0.4)
    q = BRICK.touching(np.roll(turn.as_quat(), 1))

    @jax.jit
    def held(q, v):
        contacts = contacts_at(SYSTEM, q, v, jnp.zeros(()), True)
        touch = contacts.normal.value < 1e-9
        modes = Modes(touch, touch, jnp.ones(8))
        return touch, forces(contacts, jnp.ones(8), modes, jnp.zeros((8, 2))).tangential

    touch, side = held(q, jnp.zeros(6).at[3].set(-3.0))
    assert int(touch.sum()) == 2
    side = np.asarray(side).reshape(8, 2)[np.asarray(touch)]
    assert np.abs(side).min() > 0.01
    np.testing.assert_allclose(side @ [np.cos(0.7), np.sin(0.7)], 0, atol=1e-12)


# Sizes, q, v and mu of boxes that roll over an edge whose two corners are about to slide: one of
# them has reached the rim of its cone, and the other one has within rounding.
ON_EDGES = [
    (
        [0.27385638894701236, 0.04827313083764094, 0.21163731980709835],
        np.array(
            [
                "0.17664360916662908",
                "0.16961887959230457",
                "0.026478372818745186",
                "-0.6988435376023474",
                "0.7005871999809505",
                "-0.09579966191407854",
                "0.10778548117179994",
            ],
            float,
        ),
        [
            -0.03374143210542035,
            0.010029471873898453,
            0.18145677040643354,
            0,
            0,
            -1.3294053587131496,
        ],
        0.424391357989077,
        (2, 3),
    ),
    (
        [0.28474323223990894, 0.17130169986800053, 0.04774195310584188],
        np.array(
            [
                "0.024149991403039084",
                "-0.1273764643609123",
                "0.0623822613904318",
                "0.09590332030213766",
                "-0.3710737243460594",
                "0.8942545030636722",
                "-0.2311184285281369",
            ],
            float,
        ),
        [
            0.3878915399829281,
            -0.3869135591588362,
            -0.5564473205031455,
            -8.782470592250391,
            0,
            0,
        ],
        0.9599740866892964,
        (3, 7),
    ),
]


def chosen(sizes, q, v, mu, before, touch, released):
    """The choice for a box of 1 kg."""
    box = ji.Box(sizes)
    system = ji.System(box, gravity=True)
    contacts = contacts_at(system, q, v, jnp.zeros_like(mu), True)
    slack, slides = jnp.asarray(5e-10), jnp.zeros(8, bool)
    return choose_with_friction(
        contacts, mu * jnp.ones(8), before, touch, released, slides, slack
    )


def test_who_sticks_and_who_slides():
    """A brick that could stay at rest does, at mu = 1; corners on an edge break loose together."""
    rows = [(BRICK.sizes, BRICK.touching(), np.zeros(6), 1.0, (0, 2, 4, 6)), *ON_EDGES]
    touch, released = np.zeros((3, 8), bool), np.zeros((3, 16), bool)
    for i, row in enumerate(rows):
        touch[i, list(row[4])] = True
        released[i, 8 + row[4][0]] = i > 0
    before = Modes(touch & released.any(axis=1)[:, None], touch, np.zeros((3, 8)))
    given = [np.array([np.asarray(row[k], float) for row in rows]) for k in range(4)]
    choice = jax.jit(jax.vmap(chosen))(*given, before, touch, released)
    assert choice.consistent.all()
    assert (choice.modes.active == touch).all()
    assert (choice.modes.stick == touch & [[True], [False], [False]]).all()


def test_a_contact_that_lies_below_the_surface_may_leave_it():
    """Margins of gaps begin at 0 there: one that began below would end each step."""
    below, still, one = jnp.array([0, 0, -1e-10]), jnp.zeros(()), jnp.ones(())
    q = jnp.concatenate([BRICK.touching()[:3] + below, BRICK.touching()[3:]])
    rest = jnp.zeros((2, 8))
    state = State(q, jnp.zeros(6), still, still, still, rest, rest[:0])
    settings = Settings(
        1e-10, 1e-12, 1e-9 * one, 1e-14 * one, 9, False, False, one, 1e-6 * one
    )
    modes, times = no_modes(8, q.dtype), jnp.linspace(0, 1, 2)

    @jax.jit
    def margins(state):
        flow = flow_of(
            SYSTEM, None, settings, modes, Scales(one, one, one), times, state
        )
        return flow.margins(modes, None, packed(state))[:8, 0]

    low = np.asarray(BRICK.gap_function(BRICK.touching())) < 1e-9
    assert (margins(state)[low] == 0).all()
    assert (margins(state)[~low] > 1).all()
