"""What fits make of shots: errors before the impact."""

import numpy as np

import jimpact as ji
from jimpact.fits.data_checks import DATA_CHECKS, DataBalances
from jimpact.fits.findings import findings


def data_defects(experiments, scene, stored_energy=0.0):
    """What the data break beyond their error, a line each."""
    balances = DataBalances(experiments, scene, stored_energy, uses_gaps=False)
    return [found.line for found in findings(DATA_CHECKS, balances)]


def test_errors_before_the_impact_are_passed_on():
    """Newton's law is linear in v-: the covariance, and the minimum, in closed form."""
    scene, e = ji.chain([1.0, 2.0]), 0.5
    pre, post, before = (
        [[1.0, 0.0], [2.0, -1.0]],
        [[0.1, 0.5], [-0.9, np.nan]],
        [0.05, 0.0],
    )
    data = ji.Experiments(pre, post, 0.02, sigma_pre=np.tile(before, (2, 1)))
    problem = ji.FitProblem.from_shots(ji.Newton(e), scene, data)
    m1, m2 = 1.0, 2.0
    jacobian = np.array([[m1 - e * m2, (1 + e) * m2], [(1 + e) * m1, m2 - e * m1]]) / (
        m1 + m2
    )
    covariance = (
        0.02**2 * np.eye(2) + jacobian @ np.diag(np.square(before)) @ jacobian.T
    )
    r = jacobian @ pre[0] - post[0]
    second = (jacobian @ pre[1])[0] - post[1][0]
    expected = [r @ np.linalg.solve(covariance, r), second**2 / covariance[0, 0]]
    residual = np.asarray(problem.residual([e]))
    np.testing.assert_allclose(
        [residual[:2] @ residual[:2], residual[2] ** 2], expected, rtol=1e-12
    )
    density = -0.5 * sum(expected) - 0.5 * np.log(np.linalg.det(2 * np.pi * covariance))
    density -= 0.5 * np.log(2 * np.pi * covariance[0, 0])
    np.testing.assert_allclose(problem.log_density([e]), density, rtol=1e-12)
    excess = ji.Experiments(
        [1.0, 0.0], [0.1, 0.98], 0.01, sigma_pre=np.array([[0.05, 0.0]])
    )
    assert data_defects(excess, ji.chain([1.0, 1.0])) == []
