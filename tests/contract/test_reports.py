"""Reports and pictures of canned results: no impact is computed."""

import numpy as np
import pytest

import jimpact as ji


@pytest.mark.slow  # audits of two sizes compile
def test_a_summary_says_which_velocities_are_angular():
    """Of a chain all are in m/s; a body's names state the unit of each."""
    block = ji.Block(1.0, 2.0)
    scene, zeros = block.scene(), np.zeros(3)
    p = np.zeros(scene.contacts)
    still = ji.Impact(zeros, p, p, 0.0, 0.0, np.array(0))
    unnamed = ji.summary(still, scene, zeros)
    assert "v+   [m/s, or rad/s of an angle]" in unnamed
    named = ji.summary(still, scene, zeros, block.velocity_names)
    assert [line.split()[-1] for line in named.splitlines()[6:9]] == ["[m/s]", "[m/s]", "[rad/s]"]
    pair = ji.chain([1.0, 1.0])
    out = ji.Impact(zeros[:2], zeros[:1], np.zeros(0), 0.0, 0.0, np.array(0))
    assert "v+   [m/s]\n" in ji.summary(out, pair, zeros[:2])


def test_picture_of_a_rocking_record():
    a, one = np.array([0.4, 1.0, 2.0, 3.0, 4.0]), np.ones((5, 1, 1))
    gamma = np.array([[0.0, 0.0], [0.0, 0.4], [0.5, 0.04], [0.5, 0.4], [np.nan, np.nan]])
    record = ji.theory.RockingDispersion(
        a, np.array([0.3]), np.array([0.5]), gamma[:, None, None], one, one, one, one
    )
    v = ji.plot.rocking_dispersion(record)
    curve = v.axes[0].lines[0]
    np.testing.assert_allclose(curve.get_ydata(), np.abs(gamma[:, 1]))
    assert "critical angle 79.42 degrees" in str(record)
