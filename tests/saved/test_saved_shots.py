"""Correlated shots are joined, parted, saved and shown."""

import numpy as np

import jimpact as ji

PAIR = ji.chain([1.0, 1.5])
PRE = np.array([[1.2, 0.1], [1.5, 0.3], [0.9, -0.2], [2.0, 0.4]])
POST = np.array([ji.impact(ji.Newton(0.6), PAIR, v).velocity for v in PRE])
COUNT = len(PRE)
NOISE = 0.01 * np.random.default_rng(5).normal(size=(COUNT, 4))
# v- and v+ of a body err oppositely, as those that share the instant of the impact
ONE = 1e-4 * np.kron([[1.0, -0.9], [-0.9, 1.0]], np.eye(2))


def shots(**errors) -> ji.Experiments:
    return ji.Experiments(PRE + NOISE[:, :2], POST + NOISE[:, 2:], **errors)


def test_correlated_shots_join_part_save_and_show(tmp_path):
    data = shots(covariance=np.tile(ONE, (COUNT, 1, 1)))
    both = data + data.only([2, 0])
    np.testing.assert_array_equal(both.covariance[-1], ONE)
    result = ji.fit(ji.Newton(0.8), PAIR, data)
    result.save(tmp_path / "fit")
    again = ji.load(tmp_path / "fit")
    np.testing.assert_array_equal(again.experiments.covariance, data.covariance)
    np.testing.assert_allclose(again.standard_error, result.standard_error)
    assert "covariance" in str(result)
    assert ji.plot.residuals(result).axes
