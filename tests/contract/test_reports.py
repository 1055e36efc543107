"""Reports and pictures of canned results: no impact is computed."""

import numpy as np

import jimpact as ji


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
