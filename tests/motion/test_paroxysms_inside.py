"""Painleve's rod: contact forces with friction that do not exist, or of which there are several."""

import numpy as np
import pytest
from paroxysms_cases import INERTIA, MU, STARTS, T_END, G, delassus, directions, motions
from scipy.integrate import solve_ivp

import jimpact as ji
from jimpact.motion.record import EVENT_KINDS
from jimpact.tools.status import CODE

pytestmark = pytest.mark.release  # they share a program, a dear one


def reported(name):
    """Status, kinds of events."""
    motion = motions()[name]
    kinds = [EVENT_KINDS[k] for k in motion.events.kind[: int(motion.events.count)]]
    return ji.STATUS[int(motion.status)].name, kinds


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


def test_several_solutions_are_reported():
    status, kinds = reported("indeterminate")
    motion = motions()["indeterminate"]
    assert status == "several_outcomes"
    assert not ji.STATUS[int(motion.status)].failure
    assert kinds == ["detachment"]
    assert motion.events.status[0] == CODE["several_outcomes"]
    np.testing.assert_allclose(motion.energy[-1], motion.energy[0], rtol=1e-12)
    np.testing.assert_allclose(  # it flies
        motion.q[-1, 1],
        np.sin(0.7) + 5 * np.cos(0.7) * T_END - G * T_END**2 / 2,
        rtol=1e-9,
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

    y = solve_ivp(
        field, (0, 20), [0, theta, rate, slip], "DOP853", rtol=1e-12, atol=1e-13
    ).y[:, -1]
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
