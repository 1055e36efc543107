"""What fits make of shots: errors before the impact, corrections, padded shots."""

import numpy as np
import pytest
from refusals import argument

import jimpact as ji


@pytest.mark.slow
def test_a_correction_leaves_the_errors_before_in_what_it_conserves():
    """Generalized least squares of the velocity difference alone: a pair, its momentum corrected."""
    m, sigma, before = (
        np.array([1.0, 2.0]),
        np.array([0.02, 0.05]),
        np.array([0.05, 0.03]),
    )
    scene, e = ji.chain(m), 0.5
    pre, post = np.array([[1.0, 0.0], [2.0, -1.0]]), np.array([[0.1, 0.5], [-0.9, 0.6]])
    errors = {"sigma": np.tile(sigma, (2, 1)), "sigma_pre": np.tile(before, (2, 1))}
    data = ji.Experiments(pre, post, **errors).momentum_corrected(scene)
    jacobian = np.array(
        [[m[0] - e * m[1], (1 + e) * m[1]], [(1 + e) * m[0], m[1] - e * m[0]]]
    )
    jacobian /= m.sum()
    moved = sigma**2 * m / (m**2 @ sigma**2)
    seen = np.array([-moved[1], moved[0]])  # blind to what the correction moves
    covariance = np.diag(sigma**2) + jacobian @ np.diag(before**2) @ jacobian.T
    left = (np.asarray(data.post) - pre @ jacobian.T) @ seen
    problem = ji.FitProblem.from_shots(ji.Newton(e), scene, data)
    residual = np.asarray(problem.residual([e]))
    np.testing.assert_allclose(
        residual @ residual, left @ left / (seen @ covariance @ seen), rtol=1e-12
    )
    assert not ji.fit(problem, starts=1).found("unknown_correction")
    own = ji.Experiments(pre, post, **errors, lost_freedom=1)
    found = ji.fit(ji.Newton(e), scene, own, starts=1)
    (weighed,) = (x for x in found.findings if x.kind == "unknown_correction")
    assert weighed.shots == ("1", "2")


def test_a_report_counts_what_was_not_measured():
    data = ji.Experiments([[1.0, 0.0], [2.0, 0.0]], [[0.3, np.nan], [0.6, 1.4]])
    fit = ji.fit(ji.Newton(0.5), ji.chain([1.0, 1.0]), data, starts=1)
    assert "2 shots of 2 bodies (3 of 4 velocities measured)" in str(fit)


@pytest.mark.slow
def test_a_fit_passes_errors_on_by_the_law_it_finds():
    """The covariance, and the true v-, of the minimum itself; the start's are others."""
    m1, m2, before = 1.0, 2.0, np.array([0.05, 0.02])

    def jacobian(e):
        return np.array([[m1 - e * m2, (1 + e) * m2], [(1 + e) * m1, m2 - e * m1]]) / (
            m1 + m2
        )

    def at_true_velocities(e):
        """The inverse of C, the residual, and the slope of v+ in e at the true v-."""
        spread = np.diag(before**2)
        inverse = np.linalg.inv(
            0.02**2 * np.eye(2) + jacobian(e) @ spread @ jacobian(e).T
        )
        left = pre @ jacobian(e).T - post
        true = pre - left @ inverse @ jacobian(e) @ spread
        return inverse, left, true @ (jacobian(1.0) - jacobian(0.0)).T

    rng = np.random.default_rng(4)
    exact = np.array([[1.0, 0.0], [2.0, -1.0], [1.5, 0.5]])
    post = exact @ jacobian(0.6).T + 0.02 * rng.normal(size=(3, 2))
    pre = exact + before * rng.normal(size=(3, 2))
    data = ji.Experiments(pre, post, 0.02, sigma_pre=np.tile(before, (3, 1)))
    found = ji.fit(ji.Newton(0.1), ji.chain([m1, m2]), data, starts=1)
    inverse, left, slope = at_true_velocities(found.value[0])
    information = np.einsum("ki,ij,kj->", slope, inverse, slope)
    step = np.einsum("ki,ij,kj->", slope, inverse, left) / information
    assert abs(step) < 1e-6
    np.testing.assert_allclose(
        found.standard_error / max(found.noise, 1), information**-0.5, rtol=1e-4
    )
    assert "those of the velocities before, whose true values are searched for" in str(
        found
    )
    (many,) = ji.fit_many(ji.Newton(0.1), ji.chain([m1, m2]), [data])
    np.testing.assert_allclose(many.value, found.value, rtol=1e-6)
    np.testing.assert_allclose(many.standard_error, found.standard_error, rtol=1e-4)
    np.testing.assert_allclose(found.jacobian[..., 0], slope, rtol=1e-9)
    spread = ji.bootstrap(found, 400).value.std()
    np.testing.assert_allclose(spread, found.standard_error[0], rtol=0.1)

    robust = ji.fit(
        ji.Newton(0.1),
        ji.chain([m1, m2]),
        data,
        starts=1,
        search=ji.Search(loss="student"),
    )
    inverse, left, slope = at_true_velocities(robust.value[0])
    covariance = np.linalg.inv(inverse)
    size = np.sqrt(np.diag(covariance))
    whiten = np.linalg.inv(np.linalg.cholesky(covariance / np.outer(size, size))) / size
    u = -left @ whiten.T
    psi = u / (4 + u**2)  # of Student's t with 4 degrees of freedom, but for a factor
    gradient = np.sum(psi * (slope @ whiten.T))
    assert abs(gradient) * robust.standard_error[0] < 1e-4


@pytest.mark.slow
def test_shots_with_different_numbers_of_contacts_are_fitted_together():
    scenes = [
        ji.chain([1.0, 1.0, 2.0]),
        ji.chain([1.0, 1.0, 2.0], wall=True),
        ji.Scene([1.0, 1.0, 2.0], [[-1.0], [1.0], [0.0]]),
    ]
    pre = np.array([[1.0, 0.0, -0.3], [1.0, 0.2, 0.1], [1.0, 0.2, 0.3]])
    true = np.array([0.8, 0.6, 0.5])
    post = [
        ji.impact(ji.Newton(true[: s.contacts]), s, v).velocity
        for s, v in zip(scenes, pre)
    ]
    data = ji.Experiments(pre, np.array(post), scenes=scenes)
    found = ji.fit(ji.Newton([0.7, 0.7, 0.7]), None, data, starts=1)
    np.testing.assert_allclose(found.value, true, atol=1e-9)
    assert not found.status.any()
    assert found.predicted.shape == (3, 3)
    assert len(found.warnings) == 1  # reproduced to the last digit
    excess = data.momentum_excess()
    assert np.isnan(excess[1]).all()
    np.testing.assert_allclose(excess[[0, 2]][:, 0], 0.0, atol=1e-14)


@pytest.mark.slow
def test_padding_with_friction():
    """A cube's corner and its edge in one fit: contacts that are not there change nothing."""
    corner = ji.Scene(
        [1.0, 1.0, 0.5], [[0.0], [1.0], [0.4]], tangents=[[1.0], [0.0], [0.3]]
    )
    both = np.array([[0.0, 0.0], [1.0, 1.0], [0.4, -0.3]])
    edge = ji.Scene(
        [1.0, 1.0, 0.5], both, tangents=[[1.0, 1.0], [0.0, 0.0], [0.3, 0.3]]
    )
    pre = np.array([[0.5, -1.0, 0.1], [0.3, -1.0, 0.0]])
    post = [
        ji.impact(ji.Moreau(0.4, 0.2), s, v).velocity
        for s, v in zip((corner, edge), pre)
    ]
    data = ji.Experiments(pre, np.array(post), scenes=[corner, edge])
    found = ji.fit(
        ji.Moreau(0.6, 0.3), None, data, ("restitution", "friction"), starts=1
    )
    np.testing.assert_allclose(found.value, [0.4, 0.2], atol=1e-8)


def test_scenes_that_cannot_be_fitted_together():
    tangents = [[0.0], [1.0]]
    one = ji.Scene([1.0, 1.0], [[1.0], [0.0]], tangents=tangents)
    with pytest.raises(ValueError, match=argument("scenes")):
        ji.Experiments(
            np.ones((2, 2)), np.ones((2, 2)), scenes=[one, ji.chain([1.0, 1.0])]
        )
