"""The measurements that come with the package."""

import numpy as np
import pytest

import jimpact as ji
from jimpact import read_study


@pytest.mark.slow
def test_the_cube():
    data = ji.data.cube_impacts()
    assert (
        read_study("tossed_cube.toml").experiments.shots
        == data.only(data.contacts == 1).shots
    )
    assert [int((data.contacts == m).sum()) for m in (1, 2, 4)] == [377, 21, 2]
    assert data.units == ("m/s",) * 3 + ("rad/s",) * 3
    assert 0 < np.median(data.energy_ratio()) < 1
    heavy = data.scenes[0]
    np.testing.assert_allclose(np.asarray(heavy.normals)[:3, 0], [0, 0, 1], atol=1e-12)
    with pytest.raises(
        ValueError, match=r"`contacts` in \[data\] must be one of 1, 2, 4, but is 3"
    ):
        ji.data.cube_impacts(3)


@pytest.mark.slow
def test_nearly_clean_impacts_of_the_cube():
    """Two corners: the clean impacts and 84 more, none twice."""
    two = ji.data.cube_impacts(2, nearly_clean=True)
    assert len(set(two.shots)) == len(two.shots) == 105
    assert two.shots[:21] == ji.data.cube_impacts(2).shots


@pytest.mark.slow
def test_measured_drops():
    """Geometry in closed form: an ellipse's contact is where its outline is lowest."""
    ellipse, square = ji.data.ellipse_impacts(), ji.data.square_impacts()
    turn = np.linspace(0, 2 * np.pi, 100_001)
    angle = (
        -1.514224
    )  # of the first row of the source, whose lever arm is 1.110112 mm, height 34.96396
    outline = np.stack([0.035 * np.cos(turn), 0.025 * np.sin(turn)])
    c, s = np.cos(angle), np.sin(angle)
    x, y = np.array([[c, -s], [s, c]]) @ outline
    scene = ellipse.scenes[0]
    np.testing.assert_allclose(scene.normals[2, 0], x[y.argmin()], atol=2e-6)
    np.testing.assert_allclose(scene.tangents[2, 0], -y.min(), atol=2e-6)
    np.testing.assert_allclose(scene.normals[2, 0], 1.110112e-3, atol=2e-4)
    assert ellipse.pre.shape == (1378, 3)
    assert [int((square.contacts == m).sum()) for m in (1, 2)] == [250, 15]
    numbers, time, q = ji.data.square_drops()
    assert q.shape == (len(numbers), len(time), 3) == (100, 200, 3)
    np.testing.assert_allclose(
        np.median(q[:, -1, 1]), 0.03, atol=2e-4
    )  # at rest, half of a side
    fourth = q[list(numbers).index(6)]  # impact 6:12.6 lies between frames 12 and 13
    low = np.asarray(ji.Block(0.06, 0.06).gap_function(fourth[13])).min()
    assert "6:12.6" in square.shots
    assert abs(low) < 4e-3
