"""Shots with a covariance of (v-, v+): one mechanism with sigma and sigma_pre, and bad input."""

import numpy as np
import pytest

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


def test_independent_errors_are_a_covariance():
    stated = ji.fit(ji.Newton(0.8), PAIR, shots(sigma=0.02, sigma_pre=0.01))
    diagonal = np.diag([1e-4, 1e-4, 4e-4, 4e-4])
    for covariance in (np.tile(diagonal, (COUNT, 1, 1)), np.kron(np.eye(COUNT), diagonal)):
        result = ji.fit(ji.Newton(0.8), PAIR, shots(covariance=covariance))
        np.testing.assert_allclose(result.value, stated.value, rtol=1e-9)
        np.testing.assert_allclose(result.standard_error, stated.standard_error, rtol=1e-9)


def test_fit_is_that_of_generalized_least_squares():
    # e by itself: residual of the relative velocity and of the momentum, whose errors G C G^T has
    whole = np.kron(np.eye(COUNT) + 0.3 * np.eye(COUNT, k=1) + 0.3 * np.eye(COUNT, k=-1), ONE)
    data = shots(covariance=whole)
    result = ji.fit(ji.Newton(0.8), PAIR, data)
    e, masses = float(result.law.restitution), np.array([1.0, 1.5])
    direction = np.array([-0.6, 0.4])  # of v+ from the common velocity, for e and v1 - v2 = 1
    common = np.outer([1.0, 1.0], masses / masses.sum())
    before = np.asarray(data.pre)
    slope = common + e * np.outer(direction, [1.0, -1.0])
    gain = np.kron(np.eye(COUNT), np.hstack([-slope, np.eye(2)]))
    inverse = np.linalg.inv(gain @ whole @ gain.T)
    derivative = ((before[:, :1] - before[:, 1:]) * direction).ravel()
    rest = (np.asarray(data.post) - before @ common.T).ravel()
    expected = derivative @ inverse @ rest / (derivative @ inverse @ derivative)
    np.testing.assert_allclose(e, expected, rtol=1e-6)
    error = (derivative @ inverse @ derivative) ** -0.5
    np.testing.assert_allclose(result.standard_error, [error], rtol=1e-6)
    left = rest - derivative * e
    np.testing.assert_allclose(result.chi_squared, left @ inverse @ left, rtol=1e-6)
    # the same without shot 2: its errors leave the covariance
    keep = np.repeat(np.arange(COUNT) != 1, 2)
    some = np.linalg.inv((gain @ whole @ gain.T)[np.ix_(keep, keep)])
    d, r = derivative[keep], rest[keep]
    without = ji.leave_one_out(result).value[1, 0]
    np.testing.assert_allclose(without, d @ some @ r / (d @ some @ d), rtol=1e-4)
    assert 0.5 < ji.bootstrap(result, 60).value.std() / result.standard_error[0] < 1.5


def test_momentum_is_judged_by_the_covariance():
    # errors that v- and v+ share cannot break the momentum; independent ones of that size can
    offset = np.array([0.05, 0.0])
    data = {"pre": PRE + offset, "post": POST}
    against = ONE.copy() * 0.01
    alarmed = ji.fit(
        ji.Newton(0.8), PAIR, ji.Experiments(**data, covariance=np.tile(against, (COUNT, 1, 1)))
    )
    assert any("conservation of momentum" in line for line in alarmed.warnings)
    loose = ji.Experiments(**data, covariance=np.tile(1e-2 * np.eye(4), (COUNT, 1, 1)))
    calm = ji.fit(ji.Newton(0.8), PAIR, loose)
    assert not any("conservation of momentum" in line for line in calm.warnings)


@pytest.mark.parametrize(
    ("errors", "words"),
    [
        ({"covariance": np.tile(ONE, (COUNT, 1, 1)), "sigma": 0.1}, "left out"),
        ({"covariance": np.tile(ONE, (COUNT, 1, 1)), "sigma_pre": 0.1}, "left out"),
        ({"covariance": ONE}, "shape"),
        ({"covariance": np.full((COUNT, 4, 4), np.nan)}, "finite"),
        ({"covariance": np.tile(-ONE, (COUNT, 1, 1))}, "positive definite"),
        ({"covariance": np.ones((COUNT, 4, 4))}, "positive definite"),
        ({"covariance": np.tile(ONE + 1e-5 * np.eye(4, k=1), (COUNT, 1, 1))}, "symmetric"),
        ({"covariance": np.kron(np.ones((4, 4)) - 2 * np.eye(4), -ONE)}, "positive definite"),
    ],
)
def test_bad_covariances_are_refused(errors, words):
    with pytest.raises(ValueError, match=words):
        shots(**errors)
