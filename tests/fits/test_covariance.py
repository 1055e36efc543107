"""Shots with a covariance of (v-, v+): one mechanism with sigma and sigma_pre, and bad input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares

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
    for covariance in (
        np.tile(diagonal, (COUNT, 1, 1)),
        np.kron(np.eye(COUNT), diagonal),
    ):
        result = ji.fit(ji.Newton(0.8), PAIR, shots(covariance=covariance))
        np.testing.assert_allclose(result.value, stated.value, rtol=1e-9)
        np.testing.assert_allclose(
            result.standard_error, stated.standard_error, rtol=1e-9
        )


def law(e: float) -> np.ndarray:
    """v+ = law v- of the pair, by Newton's law."""
    common = np.outer([1.0, 1.0], [0.4, 0.6])
    return common + e * np.outer([-0.6, 0.4], [1.0, -1.0])


def errors_in_both(
    data: ji.Experiments, covariance: np.ndarray, shots: list[int]
) -> np.ndarray:
    """(e, standard error, chi^2) of the least joint misfit, over e and all true velocities."""
    pre, post = np.asarray(data.pre), np.asarray(data.post)
    measured = np.concatenate([pre, post], axis=1)[shots].ravel()
    rows = (4 * np.array(shots)[:, None] + np.arange(4)).ravel()
    factor = np.linalg.cholesky(covariance[np.ix_(rows, rows)])

    def misfit(unknown: np.ndarray) -> np.ndarray:
        e, true = unknown[0], unknown[1:].reshape(-1, 2)
        expected = np.concatenate([true, true @ law(e).T], axis=1).ravel()
        return np.linalg.solve(factor, measured - expected)

    start = np.append(0.5, pre[shots].ravel())
    end = least_squares(
        misfit, start, x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    error = np.sqrt(np.linalg.inv(end.jac.T @ end.jac)[0, 0])
    return np.array([end.x[0], error, 2 * end.cost])


def test_fit_is_that_of_errors_in_both_variables():
    neighbours = 0.3 * np.eye(COUNT, k=1) + 0.3 * np.eye(COUNT, k=-1)
    whole = np.kron(np.eye(COUNT) + neighbours, ONE)
    data = shots(covariance=whole)
    result = ji.fit(ji.Newton(0.8), PAIR, data)
    expected = errors_in_both(data, whole, [0, 1, 2, 3])
    found = [result.value[0], result.standard_error[0], result.chi_squared]
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    # the same without shot 2: its errors leave the covariance
    without = ji.leave_one_out(result).value[1, 0]
    np.testing.assert_allclose(
        without, errors_in_both(data, whole, [0, 2, 3])[0], rtol=1e-4
    )
    assert 0.5 < ji.bootstrap(result, 60).value.std() / result.standard_error[0] < 1.5
    # one bracket of the profile, where the misfit is larger by 3.84
    ((low, _),) = ji.profile(result)[0].intervals
    problem = ji.FitProblem.from_shots(ji.Newton(float(low)), PAIR, data)
    more = float(np.sum(np.asarray(problem.residual([low])) ** 2)) - result.chi_squared
    np.testing.assert_allclose(more, 3.8415, rtol=1e-2)


def test_errors_before_do_not_draw_e_down():
    """200 shots, errors of a tenth: without the true v- e would be too low by .8 of its errors."""
    rng = np.random.default_rng(3)
    sets = []
    for _ in range(40):
        before = -rng.uniform(0.5, 1.5, 200)
        x = before + 0.1 * rng.normal(size=200)
        y = -0.7 * before + 0.1 * rng.normal(size=200)
        sets.append(ji.Experiments(x[:, None], y[:, None], sigma=0.1, sigma_pre=0.1))
    fits = ji.fit_many(ji.Newton(0.5), ji.chain([1.0], "left"), sets)
    for data, e in zip(sets, fits.value[:, 0]):
        x, y = np.asarray(data.pre)[:, 0], np.asarray(data.post)[:, 0]
        # the least of sum (y + e x)^2 / (1 + e^2) in closed form
        xx, yy, xy = x @ x, y @ y, x @ y
        expected = (yy - xx + np.hypot(yy - xx, 2 * xy)) / (-2 * xy)
        np.testing.assert_allclose(e, expected, rtol=1e-6)
    mean = fits.value.mean() - 0.7
    assert abs(mean) < 3 * fits.value.std() / np.sqrt(40)


def test_derivatives_of_a_problem_with_errors_before():
    """The gradient is exact beside differences; a second derivative is refused."""
    problem = ji.FitProblem.from_shots(
        ji.Newton(0.8), PAIR, shots(sigma=0.2, sigma_pre=0.3)
    )
    at = jnp.array([0.55])
    slope = jax.grad(problem.log_density)(at)[0]
    density = [float(problem.log_density(at + h)) for h in (-1e-5, 1e-5)]
    np.testing.assert_allclose(slope, np.diff(density)[0] / 2e-5, rtol=1e-6)
    with pytest.raises(NotImplementedError, match="once only"):
        jax.hessian(problem.log_density)(at)


def test_momentum_is_judged_by_the_covariance():
    # errors that v- and v+ share cannot break the momentum; independent ones of that size can
    offset = np.array([0.05, 0.0])
    data = {"pre": PRE + offset, "post": POST}
    against = ONE.copy() * 0.01
    alarmed = ji.fit(
        ji.Newton(0.8),
        PAIR,
        ji.Experiments(**data, covariance=np.tile(against, (COUNT, 1, 1))),
    )
    assert alarmed.found("momentum")
    loose = ji.Experiments(**data, covariance=np.tile(1e-2 * np.eye(4), (COUNT, 1, 1)))
    calm = ji.fit(ji.Newton(0.8), PAIR, loose)
    assert not calm.found("momentum")


@pytest.mark.parametrize(
    ("errors", "words"),
    [
        ({"covariance": np.tile(ONE, (COUNT, 1, 1)), "sigma": 0.1}, "left out"),
        ({"covariance": np.tile(ONE, (COUNT, 1, 1)), "sigma_pre": 0.1}, "left out"),
        ({"covariance": ONE}, "shape"),
        ({"covariance": np.full((COUNT, 4, 4), np.nan)}, "finite"),
        ({"covariance": np.tile(-ONE, (COUNT, 1, 1))}, "positive definite"),
        ({"covariance": np.ones((COUNT, 4, 4))}, "positive definite"),
        (
            {"covariance": np.tile(ONE + 1e-5 * np.eye(4, k=1), (COUNT, 1, 1))},
            "symmetric",
        ),
        (
            {"covariance": np.kron(np.ones((4, 4)) - 2 * np.eye(4), -ONE)},
            "positive definite",
        ),
    ],
)
def test_bad_covariances_are_refused(errors, words):
    with pytest.raises(ValueError, match=words):
        shots(**errors)
