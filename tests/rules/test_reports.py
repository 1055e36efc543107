"""Reports and pictures of canned results: no impact is computed."""

import re

import numpy as np
import pytest

import jimpact as ji


@pytest.mark.slow  # audits of two sizes compile
def test_a_summary_says_which_velocities_are_angular():
    """Of a chain all are in m/s; a body's names state the unit of each."""
    block = ji.Block(1.0, 2.0)
    scene, zeros = block.scene(), np.zeros(3)
    p = np.zeros(scene.contacts)
    still = ji.Impact(zeros, p, p, np.zeros(()), np.zeros(()), np.array(0))
    unnamed = ji.summary(still, scene, zeros)
    assert "v+   [m/s, or rad/s of an angle]" in unnamed
    named = ji.summary(still, scene, zeros, block.velocity_names)
    assert [line.split()[-1] for line in named.splitlines()[5:8]] == [
        "[m/s]",
        "[m/s]",
        "[rad/s]",
    ]
    pair = ji.chain([1.0, 1.0])
    one, none = zeros[:1], np.zeros(0)
    out = ji.Impact(zeros[:2], one, none, np.zeros(()), np.zeros(()), np.array(0))
    assert "v+   [m/s]\n" in ji.summary(out, pair, zeros[:2])


def test_picture_of_a_rocking_record():
    a, one = np.array([0.4, 1.0, 2.0, 3.0, 4.0]), np.ones((5, 1, 1))
    gamma = np.array(
        [[0.0, 0.0], [0.0, 0.4], [0.5, 0.04], [0.5, 0.4], [np.nan, np.nan]]
    )
    record = ji.theory.RockingDispersion(
        a, np.array([0.3]), np.array([0.5]), gamma[:, None, None], one, one, one, one
    )
    v = ji.plot.rocking_dispersion(record)
    curve = v.axes[0].lines[0]
    np.testing.assert_allclose(curve.get_ydata(), np.abs(gamma[:, 1]))
    assert "critical angle 79.42 degrees" in str(record)


NOUNS = "bodies coordinates velocities contacts shots starts steps parameters degrees samples impacts"
ONE_OF_MANY = re.compile(rf"(?<![\w.])1 ({NOUNS.replace(' ', '|')})\b")
MINUS_ZERO = re.compile(r"(?<![\w.])-0(\.0+)?(e[-+]\d+)?(?![\w.])")


def one_of_each():
    """Reports of scenes with one contact, one shot, one degree of freedom, one sample."""
    ball = ji.Scene([2.0], [[1.0]])
    yield ball
    before, after = np.array([[-1.0], [-0.0]]), np.array([[0.5], [0.0]])
    yield ji.Experiments(before[:1], after[:1])
    law = ji.Newton(0.4)
    out = ji.impact(law, ball, before[1])
    yield out
    yield ji.summary(out, ball, before[1])
    for shots in (1, 2):
        data = ji.Experiments(
            before[:1].repeat(shots, 0), after[:1].repeat(shots, 0) + 0.01, 0.02
        )
        fit = ji.fit(law, ball, data, starts=1)
        yield fit
        yield fit.predict(before)
        yield ji.fit_laws(ball, data, ["newton", "moreau"])
    yield ji.monte_carlo(law, ball, ji.Normal(before[0], 0.1), samples=1, chunk=1)
    yield ji.compare(ball, before[0], {"newton": law})


def of_bodies_that_turn():
    """Reports of a block that lands on a corner."""
    block = ji.Block(1.0, 2.0)
    scene, law, before = (
        block.scene(block.touching(0.2)),
        ji.Newton(0.4),
        [0.0, -1.0, 0.0],
    )
    out = ji.impact(law, scene, before)
    yield out
    yield ji.summary(out, scene, before)
    units = ["m/s", "m/s", "rad/s"]
    data = ji.Experiments([before], [out.velocity], 0.02, units=units)
    yield data
    yield ji.fit(ji.Newton(0.5), scene, data, starts=1).predict([before])
    yield ji.monte_carlo(law, scene, ji.Normal(before, 0.1), samples=8, chunk=8)
    yield ji.compare(scene, before, {"newton": law})


@pytest.mark.slow
@pytest.mark.parametrize("reports", [one_of_each, of_bodies_that_turn])
def test_reports_count_and_sign_as_people_do(reports):
    for report in map(str, reports()):
        assert not ONE_OF_MANY.search(report), report
        assert not MINUS_ZERO.search(report), report
        if reports is of_bodies_that_turn:
            assert ("m/s" in report) == ("rad/s" in report), report
