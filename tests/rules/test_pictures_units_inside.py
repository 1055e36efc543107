"""Axes of metres and radians a second, on results as if they had been computed."""

from dataclasses import replace

import numpy as np
import pytest
from canned import canned
from refusals import argument

import jimpact as ji
from jimpact.methods.advice_report import Advice, Candidate


def block_and_its_pictures():
    """A block on both corners, which turns and moves, and the pictures of one law for it."""
    block, before = ji.Block(0.2, 0.6, corners="base"), np.array([0.5, -1.0, 2.0])
    scene, law = block.scene(), ji.Newton(0.5)
    comparison = ji.compare(scene, before, {"newton": law})
    after = np.asarray(comparison.entries["newton"].outcome.velocity)
    row, none = Candidate(law, scene, after, after, after, 0.1, 0.2, "ok"), np.zeros(2)
    advice = Advice(
        "newton",
        0.5,
        True,
        "newton",
        before,
        none,
        {"newton": row},
        (),
        none,
        (),
        1,
        None,
    )
    pictures = (ji.plot.comparison, comparison), (ji.plot.advice, advice)
    return block, scene, after, pictures


@pytest.mark.slow
def test_metres_and_radians_a_second_have_axes_of_their_own():
    block, scene, after, pictures = block_and_its_pictures()
    root = np.sqrt(
        np.diag(np.asarray(scene.mass)) if scene.mass.ndim == 2 else scene.mass
    )
    for picture, result in pictures:
        shown, _ = picture(result).axes  # without names: one unit for all
        assert shown.get_ylabel() == "velocity after the impact · √inertia [√J]"
        drawn = [x.get_ydata()[0] for x in shown.lines if x.get_marker() == "o"]
        np.testing.assert_allclose(drawn, root * after)
        moves, turns, _ = picture(result, names=block.velocity_names).axes
        for axes, unit, wanted in (
            (moves, "m/s", after[:2]),
            (turns, "rad/s", after[2:]),
        ):
            assert axes.get_ylabel() == f"velocity after the impact [{unit}]"
            drawn = [x.get_ydata()[0] for x in axes.lines if x.get_marker() == "o"]
            np.testing.assert_allclose(drawn, wanted)
        with pytest.raises(ValueError, match=argument("names")):
            picture(result, names=["x [m]"])


def test_measured_metres_and_radians_a_second_have_columns_of_their_own():
    data = ji.Experiments([1.0, 0.0], [0.2, 0.8], units=["m/s", "rad/s"])
    problem = ji.FitProblem.from_shots(ji.Newton(0.5), ji.chain([1.0, 1.0]), data)
    moves, turns, *residuals = ji.plot.fit(canned(1, problem=problem)).axes
    for axes, unit in ((moves, "m/s"), (turns, "rad/s")):
        assert axes.get_ylabel() == f"velocity after the impact [{unit}]"
    assert residuals[1].get_ylabel() == "measured − fitted [rad/s]"


def test_errors_of_advice_stand_where_they_are_and_rounding_in_words():
    """1e-9 is no 1e-5; the reference has no error, and so no place on the axis."""
    scene, v, none = ji.chain([1.0, 1.0]), np.array([0.2, 0.8]), np.zeros(1)
    rows = {
        name: Candidate(ji.Newton(0.5), scene, v, v, v, worst, worst, "ok")
        for name, worst in (("newton", 0.3), ("poisson", 1e-9), ("lzb", 0.0))
    }
    result = Advice("poisson", 0.01, True, "lzb", v, none, rows, (), none, (), 1, None)
    bottom = ji.plot.advice(result).axes[-1]
    worst = next(line for line in bottom.lines if line.get_label() == "worst")
    np.testing.assert_array_equal(worst.get_ydata(), [0.3, 1e-9, np.nan])
    assert bottom.get_ylim()[0] < 1e-9
    assert [text.get_text() for text in bottom.texts] == ["reference"]


@pytest.mark.slow
def test_the_map_of_random_gaps_shows_those_that_matter():
    """Equal gaps, of which the middle one matters least; each body has an axis of its own."""
    balls, law = ji.chain([1.0, 1.0, 1.0, 1.0]), ji.Binary(0.9, order="earliest")
    options = {"gaps": ji.Uniform(0.0, 1e-5), "samples": 64, "chunk": 64}
    result = ji.monte_carlo(law, balls, [1.0, 0.0, 0.0, -0.5], **options)
    loud = int(np.argmax(result.std))
    cross = np.zeros((4, 3))
    cross[loud] = [2.0, 0.1, -3.0]
    result = replace(
        result, cross_covariance=cross, gap_covariance=np.diag([1.0, 4.0, 1.0])
    )
    figure = ji.plot.monte_carlo(result)
    labels = [(x.get_xlabel(), x.get_ylabel()) for x in figure.axes]
    assert any(x.startswith("gap 1") and y.startswith("gap 3") for x, y in labels)
    bodies = [axes for axes in figure.axes if axes.get_ylabel() == "samples [%]"]
    for axes, low, high in zip(bodies, result.minimum, result.maximum, strict=True):
        assert np.ptp(axes.get_xlim()) < 2 * (high - low)
