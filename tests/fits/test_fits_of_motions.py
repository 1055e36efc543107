"""Fits of motions: event times, start, gravity, floor, friction, any method."""

import numpy as np
import pytest
from motion_cases import G

import jimpact as ji


@pytest.mark.slow  # the only derivative of a batch of motions
def test_fit_through_event_times():
    """Two balls dropped from 1 and .25 m: each bounces in the times of its own height."""
    heights = np.array([[1.0], [0.25]])
    times = np.sqrt(2 * heights / G) * (
        1 + 2 * np.cumsum(np.r_[0, 0.75 ** np.arange(1, 6)])
    )
    given = (
        ji.System(ji.Column([1.0]), gravity=True),
        ji.Newton(0.7),
        times,
        heights,
        np.zeros((2, 1)),
        3.0,
    )
    found = ji.fit_motion(*given, observe=lambda m: m.events.time[:6], sigma=1e-3)
    np.testing.assert_allclose(found.value, 0.75, atol=1e-9)
    assert found.degrees_of_freedom == 11
    assert found.rank == 1


HARD = ji.Newton(0.8)


@pytest.mark.slow
def test_a_motion_is_fitted_by_any_method():
    method = ji.TimeStepping(1e-3)
    pushed = ji.System(ji.Column([1.0]), gravity=True)
    start = [0.1], [0.0], 0.25
    measured = ji.simulate(
        pushed, HARD, *start, samples=6, method=ji.EventDriven(rtol=1e-9)
    ).q
    found = ji.fit_motion(
        pushed,
        ji.Newton(0.7),
        measured,
        *start,
        method=ji.EventDriven(rtol=1e-9),
        max_events=20,
    )
    np.testing.assert_allclose(found.value, [0.8], atol=1e-7)
    with pytest.raises(NotImplementedError, match="time_stepping"):
        ji.fit_motion(pushed, ji.Newton(0.7), measured, *start, method=method)


@pytest.mark.release
def test_start_gravity_and_floor_of_a_motion_are_fitted_by_name():
    """A ball over a floor 5 cm above the zero of its heights, in two motions too."""
    rng, true = np.random.default_rng(0), ji.System(ji.Column([1.0]), gravity=9.7)
    starts, speeds = np.array([[1.0], [0.8]]), np.array([[0.3], [-0.2]])
    seen = [
        ji.simulate(true, ji.Newton(0.8), *x, 1.5, samples=46).q
        for x in zip(starts, speeds)
    ]
    seen = np.array(seen) + 0.05
    seen += 1e-3 * rng.normal(size=seen.shape)
    ball, guess = ji.System(ji.Column([1.0]), gravity=True), ji.Newton(0.76)
    free = ("restitution", "q0", "v0", "gravity", "floor")
    expected = {
        "restitution": 0.8,
        "q0[1]": 1.05,
        "v0[1]": 0.3,
        "gravity": 9.7,
        "floor": 0.05,
    }
    one = ji.fit_motion(ball, guess, seen[0], [1.03], [0.2], 1.5, free, sigma=1e-3)
    assert one.names == tuple(expected)
    assert one.rank == 5
    assert (np.abs(one.value - [*expected.values()]) < 4 * one.standard_error).all()
    assert isinstance(one.law, ji.Newton)
    both = ji.fit_motion(
        *(ball, guess, seen, starts + 0.04, speeds + 0.1, 1.5),
        {"restitution": True, "v0": True, "q0[2,1]": True, "floor": True, "gravity": True},
        sigma=1e-3, bounds={"gravity": (9.0, 10.5)},
    )  # fmt: skip
    values = dict(zip(both.names, both.value))
    assert set(values) == {
        "restitution",
        "v0[1,1]",
        "v0[2,1]",
        "q0[2,1]",
        "floor",
        "gravity",
    }
    for system, name, words in (
        (ji.System(ji.Column([1.0])), "gravity", "whose one potential is its weight"),
        (ji.System(lambda q: q, [1.0]), "floor", "over a floor at rest"),
    ):
        with pytest.raises(ValueError, match=f"`{name}` only of .*{words}"):
            ji.fit_motion(system, guess, np.ones((3, 1)), [1.0], [0.0], 0.3, [name])


@pytest.mark.release
def test_fit_through_a_simulated_motion():
    """Restitutions and stiffness ratio of a cradle, from angles with (simulated) noise."""
    system = ji.System(ji.PendulumCradle([0.1] * 3, 0.15, 0.0125), gravity=True)
    true = ji.LZB([0.95, 0.9], stiffness=[1.0, 2.0], exponent=1.5)
    start = ([-0.5, 0, 0], [0.0] * 3, 2.0)
    seen = np.asarray(ji.simulate(system, true, *start, samples=81).q)
    noisy = seen + 1e-3 * np.random.default_rng(0).normal(size=seen.shape)
    guess = ji.LZB([0.9, 0.9], stiffness=[1.0, 1.0], exponent=1.5)
    free = ("restitution", "stiffness")
    found = ji.fit_motion(system, guess, noisy, *start, free, sigma=1e-3)
    assert found.converged
    assert found.rank == 3
    assert found.names == ("restitution[1]", "restitution[2]", "stiffness[2]")
    error = np.abs(found.value - [0.95, 0.9, 2.0])
    assert (error < 3 * found.standard_error).all()
    assert (found.standard_error < [3e-3, 3e-3, 0.03]).all()
    np.testing.assert_allclose(found.residual.std(), 1e-3, rtol=0.15)
    assert "stiffness[2]" in str(found)


@pytest.mark.release
def test_friction_is_fitted_through_a_motion():
    """A dimer that is thrown; positions with (simulated) noise."""
    dimer, start = (
        ji.System(ji.Dimer(0.01, 0.04), gravity=True),
        ([0.0, 0.1, 0.2], [0.5, 0.0, 0.0], 0.25),
    )
    seen = np.asarray(
        ji.simulate(dimer, ji.Moreau(0.8, friction=0.2), *start, samples=41).q
    )
    noisy = seen + 1e-4 * np.random.default_rng(0).normal(size=seen.shape)
    free = ("restitution", "friction")
    guess = ji.Moreau(0.7, friction=0.3)
    found = ji.fit_motion(dimer, guess, noisy, *start, free, sigma=1e-4)
    assert found.converged
    assert (np.abs(found.value - [0.8, 0.2]) < 3 * found.standard_error).all()
    assert (found.standard_error < 1e-3).all()


@pytest.mark.release
def test_a_motion_that_sees_nothing():
    before = ji.fit_motion(
        ji.System(ji.Column([1.0]), gravity=True), ji.Newton(0.7), [[1.0], [0.9]], [1.0], [0.0], 0.1,
        bounds={"restitution": (0.1, 0.9)},
    )  # fmt: skip
    assert before.rank == 0
    assert np.isinf(before.standard_error[0])
    assert "cannot see restitution" in str(before)
