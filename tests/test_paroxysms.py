"""Painleve's rod: contact forces with friction that do not exist, or of which there are several."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jimpact as ji
from jimpact.motion.record import EVENT_KINDS, MOTION_STATUS

pytestmark = pytest.mark.slow  # they share a program, a dear one

G = 9.81  # of a rod of mass 1 and length 2, whose end slides on the floor
INERTIA = np.array([1.0, 1.0, 1 / 3])
MU, T_END = 2.0, 0.1
# e, mu of the law, angle, its rate, slip
STARTS = {
    "inconsistent": (0.5, MU, 0.7, 0.0, -1.0),
    "turning": (0.5, MU, 1.3, -2.0, -10.0),
    "elastic": (1.0, MU, 0.9, 1.0, -3.0),
    "indeterminate": (0.5, MU, 0.7, 5.0, -1.0),
    "regular": (0.5, MU, 0.7, 0.0, 1.0),
    "jamming": (0.0, MU, 0.6, 3.0, -8.0),
    "not supplied": (0.5, 0.0, 0.7, 0.0, -1.0),
}


def gap(q):
    return jnp.stack([q[1] - jnp.sin(q[2])])


def sliding(q):
    return jnp.stack([q[0] - jnp.cos(q[2])])


ROD = ji.System(gap, INERTIA, potential=ji.gravity([0.0, 1.0, 0.0], G), tangent_function=sliding)


def directions(theta):
    """Normal and tangent of the end (3, 2)."""
    return np.array([[0.0, 1.0], [1.0, 0.0], [-np.cos(theta), np.sin(theta)]])


def delassus(theta):
    """W_nn, W_nt, W_tt."""
    d = directions(theta)
    w = d.T @ (d / INERTIA[:, None])
    return w[0, 0], w[0, 1], w[1, 1]


def moves(given, law=ji.LZB):
    e, friction, theta, rate, slip = given
    q = jnp.stack([jnp.zeros_like(theta), jnp.sin(theta), theta])
    v = jnp.stack([slip - jnp.sin(theta) * rate, jnp.cos(theta) * rate, rate])
    law, mu = law(e, friction=friction), jnp.asarray(MU)
    return ji.simulate(ROD, law, q, v, T_END, samples=2, friction=mu, max_events=30)


@functools.cache
def motions():
    found = {name: moves(jnp.array(given)) for name, given in STARTS.items()}
    return jax.tree.map(np.asarray, found)


def reported(name):
    """Status, kinds of events."""
    motion = motions()[name]
    kinds = [EVENT_KINDS[k] for k in motion.events.kind[: int(motion.events.count)]]
    return MOTION_STATUS[int(motion.status)].name, kinds


def without_collision(e, theta, slip):
    """gamma+ and the impulse: it slides until the slip has stopped, then sticks."""
    normal, both, along = delassus(theta)
    pull = normal - MU * abs(both)
    slides = abs(slip) / (MU * along - abs(both))
    sticks = normal - both**2 / along
    approach = -pull * slides
    work = 0.5 * approach * slides + 0.5 * approach**2 / sticks
    leaves = e * np.sqrt(2 * sticks * work)
    return leaves, slides + (approach + leaves) / sticks


@pytest.mark.parametrize("name", ["inconsistent", "turning", "elastic"])
def test_impact_without_collision(name):
    e, _, theta, _, slip = STARTS[name]
    events = motions()[name].events
    status, kinds = reported(name)
    assert status == "ok"
    assert kinds[0] == "paroxysm"
    leaves, p = without_collision(e, theta, slip)
    gamma, u = directions(theta).T @ events.velocity_after[0]
    np.testing.assert_allclose([gamma, events.impulse[0, 0]], [leaves, p], rtol=1e-6)
    np.testing.assert_allclose(u, 0, atol=1e-9)
    before, after = events.velocity_before[0], events.velocity_after[0]
    change = 0.5 * INERTIA @ (after**2 - before**2)
    np.testing.assert_allclose(events.energy[0].sum(), change, rtol=1e-9)
    assert change < 0


def test_its_outcome_is_the_limit_of_a_stiff_contact():
    """A rod on a spring, its own integration: the error falls with the time of the impact."""
    e, _, theta, rate, slip = STARTS["elastic"]
    assert e == 1

    def field(stiffness, sticks, _, y):
        q, v = y[:3], y[3:]
        d = directions(q[2])
        drift = v[2] ** 2 * np.array([np.sin(q[2]), np.cos(q[2])])
        f = stiffness * max(np.sin(q[2]) - q[1], 0.0)
        _, both, along = delassus(q[2])
        # held at its slip of 0: gravity has no part in it
        side = -(both * f + drift[1]) / along if sticks else MU * f
        return [*v, *((d @ [f, side]) / INERTIA - [0, G, 0])]

    def outcome(stiffness):
        def stops(_, y):
            return directions(y[2])[:, 1] @ y[3:]

        def opens(_, y):
            return np.sin(y[2]) - y[1]

        stops.terminal, stops.direction = True, 1
        opens.terminal, opens.direction = True, -1
        y = np.array(
            [0, np.sin(theta), theta, slip - np.sin(theta) * rate, np.cos(theta) * rate, rate]
        )
        for sticks, event in ((False, stops), (True, opens)):
            y = solve_ivp(
                functools.partial(field, stiffness, sticks), (0, 1), y, "DOP853", events=event,
                rtol=1e-10, atol=1e-13,
            ).y[:, -1]  # fmt: skip
        return y[3:]

    exact = motions()["elastic"].events.velocity_after[0]
    errors = [np.abs(outcome(k) - exact).max() for k in (1e8, 1e10)]
    assert errors[1] < 2e-3
    assert errors[1] < 0.2 * errors[0]


def test_several_solutions_are_reported():
    status, kinds = reported("indeterminate")
    motion = motions()["indeterminate"]
    assert status == "several_outcomes"
    assert not MOTION_STATUS[int(motion.status)].failure
    assert kinds == ["detachment"]
    assert motion.events.status[0] == ji.status.CODE["several_outcomes"]
    np.testing.assert_allclose(motion.energy[-1], motion.energy[0], rtol=1e-12)
    np.testing.assert_allclose(  # it flies
        motion.q[-1, 1], np.sin(0.7) + 5 * np.cos(0.7) * T_END - G * T_END**2 / 2, rtol=1e-9
    )


def test_sliding_the_other_way_is_regular():
    assert reported("regular") == ("ok", [])


def test_a_law_without_friction_has_no_such_impact():
    assert reported("not supplied") == ("no_contact_force", ["paroxysm"])


def test_a_sliding_rod_jams():
    """Where force and room run out together: integrated in time over the room, which is regular."""
    _, _, theta, rate, slip = STARTS["jamming"]

    def field(_, y):
        _, theta, rate, _ = y
        c, s = np.cos(theta), np.sin(theta)
        room = 1 + 3 * c**2 - 3 * MU * s * c
        press = G - rate**2 * s
        turn = 3 * press * (MU * s - c)
        return [room, room * rate, turn, MU * press + room * c * rate**2 + s * turn]

    y = solve_ivp(field, (0, 20), [0, theta, rate, slip], "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    status, kinds = reported("jamming")
    assert status == "ok"
    assert kinds[:2] == ["friction", "paroxysm"]
    events = motions()["jamming"].events
    np.testing.assert_allclose(events.time[:2], y[0], rtol=1e-6)
    # how far it had come when the impact began does not matter
    v = np.array([y[3] - np.sin(y[1]) * y[2], np.cos(y[1]) * y[2], y[2]])
    p = -y[3] / (MU * delassus(y[1])[2] - abs(delassus(y[1])[1]))
    v = v + directions(y[1]) @ [p, MU * p] / INERTIA
    np.testing.assert_allclose(events.velocity_after[1], v, atol=1e-5)


@pytest.mark.parametrize("name", ["inconsistent", "jamming"])
def test_its_derivatives(name):
    """Of the motion, along a direction of all that it starts with; its outcome is smooth."""
    given, along = jnp.array(STARTS[name]), jnp.array([0.0, 0.0, 0.2, 0.5, -0.4])
    slope = differentiated(given, along)[1]
    ends = [differentiated(given + h * along, along)[0] for h in (1e-4, -1e-4, 1e-3, -1e-3)]
    fine, coarse = (ends[0] - ends[1]) / 2e-4, (ends[2] - ends[3]) / 2e-3
    assert np.abs(slope).max() > 0.01
    np.testing.assert_allclose(slope, fine + (fine - coarse) / 99, atol=1e-6)


@jax.jit
def differentiated(given, along):
    """End and its derivative, by a law that is quick to compile."""
    return jax.jvp(lambda x: moves(x, ji.Moreau).q[-1], (given,), (along,))
