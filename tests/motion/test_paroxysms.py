"""Painleve's rod: contact forces with friction that do not exist, or of which there are several."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from paroxysms_cases import (
    INERTIA,
    MU,
    STARTS,
    G,
    delassus,
    directions,
    motions,
    moves,
)
from scipy.integrate import solve_ivp

import jimpact as ji

pytestmark = pytest.mark.release  # they share a program, a dear one


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
            [
                0,
                np.sin(theta),
                theta,
                slip - np.sin(theta) * rate,
                np.cos(theta) * rate,
                rate,
            ]
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


@pytest.mark.parametrize("name", ["inconsistent", "jamming"])
def test_its_derivatives(name):
    """Of the motion, along a direction of all that it starts with; its outcome is smooth."""
    given, along = jnp.array(STARTS[name]), jnp.array([0.0, 0.0, 0.2, 0.5, -0.4])
    slope = differentiated(given, along)[1]
    ends = [
        differentiated(given + h * along, along)[0] for h in (1e-4, -1e-4, 1e-3, -1e-3)
    ]
    fine, coarse = (ends[0] - ends[1]) / 2e-4, (ends[2] - ends[3]) / 2e-3
    assert np.abs(slope).max() > 0.01
    np.testing.assert_allclose(slope, fine + (fine - coarse) / 99, atol=1e-6)


@jax.jit
def differentiated(given, along):
    """End and its derivative, by a law that is quick to compile."""
    return jax.jvp(lambda x: moves(x, ji.Moreau).q[-1], (given,), (along,))
