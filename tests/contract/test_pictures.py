"""Pictures of every kind, on small records made by hand: nothing overlaps, every axis is labelled.

Nothing is simulated here but some figures of the chapter (slow), so that the layout of all pictures
costs seconds.
"""

import numpy as np
import pytest
from canned import canned
from pictures_cases import block_and_its_pictures, force_chains, samples

import jimpact as ji


def test_force_chains_are_as_thick_as_impulses():
    (lines,) = force_chains().axes[0].collections
    thickness = np.asarray(lines.get_linewidths()) / lines.get_linewidths()[-1]
    np.testing.assert_allclose(thickness, np.array([np.sqrt(0.75), 1, np.sqrt(3), 2]) / 2)
    ends = np.array([sorted(line.round(6).tolist()) for line in lines.get_segments()])
    np.testing.assert_allclose(ends[0], [[2.0, 0.0], [2.0, 1.0]])  # a disc on the floor
    np.testing.assert_allclose(ends[-1], [[0.0, 1.0], [1.0, 1 + np.sqrt(3)]], atol=1e-5)


def test_a_histogram_is_in_per_cent():
    bars = samples(True).axes[0].patches[0].get_data().values
    assert bars.sum() == pytest.approx(100.0)


def test_metres_and_radians_a_second_have_axes_of_their_own():
    block, scene, after, pictures = block_and_its_pictures()
    root = np.sqrt(np.diag(np.asarray(scene.mass)) if scene.mass.ndim == 2 else scene.mass)
    for picture, result in pictures:
        shown, _ = picture(result).axes  # without names: one unit for all
        assert shown.get_ylabel() == "velocity after the impact · √inertia [√J]"
        drawn = [x.get_ydata()[0] for x in shown.lines if x.get_marker() == "o"]
        np.testing.assert_allclose(drawn, root * after)
        moves, turns, _ = picture(result, names=block.velocity_names).axes
        for axes, unit, wanted in ((moves, "m/s", after[:2]), (turns, "rad/s", after[2:])):
            assert axes.get_ylabel() == f"velocity after the impact [{unit}]"
            drawn = [x.get_ydata()[0] for x in axes.lines if x.get_marker() == "o"]
            np.testing.assert_allclose(drawn, wanted)
        with pytest.raises(ValueError, match="`names` must have 3 names"):
            picture(result, names=["x [m]"])


def test_measured_metres_and_radians_a_second_have_columns_of_their_own():
    data = ji.Experiments([1.0, 0.0], [0.2, 0.8], units=["m/s", "rad/s"])
    problem = ji.FitProblem.from_shots(ji.Newton(0.5), ji.chain([1.0, 1.0]), data)
    moves, turns, *residuals = ji.plot.fit(canned(1, problem=problem)).axes
    for axes, unit in ((moves, "m/s"), (turns, "rad/s")):
        assert axes.get_ylabel() == f"velocity after the impact [{unit}]"
    assert residuals[1].get_ylabel() == "measured − fitted [rad/s]"
