"""Which law, restitution by speed, scatter between shots, the posterior."""

import json
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize, stats
from scipy.special import chdtrc
from selection_cases import PAIR, PRE, SPEED, after

import jimpact as ji
from jimpact import Scatter, read_study


@pytest.fixture(scope="module")
def found():
    return ji.fit(
        ji.Newton(0.5), PAIR, ji.Experiments(PRE, after(np.full(12, 0.7), 0.01), sigma=0.01)
    )


@pytest.fixture
def lenient():
    """The sampler mixes types and ranks, which the suite's flags forbid."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


@pytest.fixture(scope="module")
def every():
    data = ji.Experiments(PRE, after(np.full(12, 0.8), 0.01), sigma=0.01)
    return ji.fit_laws(PAIR, data, ["moreau", "newton", "restitution_matrix"], speed=True)


@pytest.mark.slow
def test_laws_that_agree_are_listed_by_what_they_must_know(every):
    assert list(every.entries) == ["newton", "moreau"]
    newton, moreau = every.entries.values()
    assert newton.adequate
    assert moreau.adequate
    assert newton.left_out_error == pytest.approx(moreau.left_out_error, rel=1e-5)
    assert newton.aicc == pytest.approx(newton.fit.starts[0].sum_of_squares + 2)
    assert every.left_out == {"restitution_matrix": "needs `matrix`"}
    assert not every.speed.needed
    assert every.verdict.startswith("The simplest law that fits is newton: restitution = 0.8")
    assert "predict" not in str(every)
    reported = json.loads(json.dumps(every.to_dict(), allow_nan=False))
    assert reported["best"] == "newton"
    assert len(reported["laws"]["moreau"]["fit"]["shots"]) == 12
    heads, rows = every.rows()
    assert len(heads) == len(rows[0])
    assert [row[0] for row in rows] == ["newton", "moreau"]


def test_the_criterion_without_sigma_is_corrected_for_few_values():
    """AICc of 24 values, one parameter and the noise (Hurvich and Tsai)."""
    data = ji.Experiments(PRE, after(np.full(12, 0.8), 0.01))
    best = ji.fit_laws(PAIR, data, ["newton"]).best
    n, k, squares = 24, 2, float(np.sum(best.fit.residual**2))
    assert best.aicc == pytest.approx(n * np.log(squares / n) + 2 * k * n / (n - k - 1))


def test_a_law_that_fails_is_named_and_comes_last():
    """Newton pulls at a contact that separates."""
    balls = ji.chain([1.0, 1.0, 1.0])
    data = ji.Experiments([[1.0, 0.0, 1.0], [2.0, 0.0, 1.5]], [[0.1, 0.9, 1.0], [0.2, 1.8, 1.9]])
    reported = []
    found = ji.fit_laws(
        balls,
        data,
        {"newton": ji.Newton(0.5), "moreau": ji.Moreau(0.5)},
        starts=1,
        done=lambda name, fit: reported.append(name),
    )
    assert list(found.entries) == ["moreau", "newton"] == reported[::-1]
    assert found.entries["newton"].verdict.startswith("fails in ")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"laws": ["aristotle"]}, "`laws` must be one of"),
        ({"laws": ["compliant"]}, "needs `stiffness`"),
        ({"laws": {"mine": 3}}, "mine"),
    ],
)
def test_bad_laws(change, message):
    data = ji.Experiments(PRE, after(np.full(12, 0.8)))
    with pytest.raises((ValueError, TypeError), match=message):
        ji.fit_laws(PAIR, data, **change)


@pytest.mark.slow
def test_the_law_that_made_the_data_is_found():
    """Of three balls: dispersion that only LZB has; the simpler laws predict worse."""
    balls, rng = ji.chain([1.0, 1.0, 1.0]), np.random.default_rng(2)
    pre = np.zeros((8, 3))
    pre[:, 0], pre[:4, 2] = rng.uniform(1, 2, 8), -rng.uniform(0.2, 1, 4)
    truth = ji.LZB(0.9, [1.0, 2.0])
    post = np.array([ji.impact(truth, balls, v).velocity for v in pre])
    post += 0.004 * rng.normal(size=post.shape)
    laws = ["newton", "moreau", "lzb"]
    found = ji.fit_laws(balls, ji.Experiments(pre, post), laws, starts=2)
    assert found.best.name == "lzb, free stiffness ratios"
    assert not found.entries["moreau"].adequate
    assert "worse than lzb" in found.entries["newton, e per contact"].verdict


def test_restitution_by_speed_is_what_it_says():
    law = ji.VelocityDependent(
        ji.Newton(0.5), speed_exponent=0.25, yield_speed=0.1, reference_speed=2.0
    )
    speed = np.array([1e-3, 0.05, 0.1, 0.1 + 1e-12, 0.5, 2.0, 32.0])
    power = np.minimum(0.5 * (speed / 2.0) ** -0.25, 1.0)
    y = np.minimum(0.1 / speed, 1.0)
    e = np.asarray(law.restitution_at(speed))
    np.testing.assert_allclose(e, np.sqrt(y**2 + (1 - y**2) * power**2), rtol=1e-12)
    assert (e[:3] == 1.0).all()
    assert (np.diff(e) <= 0).all()
    assert float(law.restitution_at(0.0)) == 0.5
    plastic = ji.VelocityDependent(ji.Newton(0.0), yield_speed=0.0)
    assert float(plastic.restitution_at(1.0)) == 0.0
    none = ji.VelocityDependent(ji.Newton(0.3))
    assert float(none.restitution_at(7.0)) == 0.3


def test_slopes_of_restitution_by_speed_at_its_edges_are_whole():
    """Where e reaches 1, at the yield speed, at e = 0: one side's, not the mean of two."""

    def found(e, k, v_y, v):
        law = ji.VelocityDependent(ji.Newton(e), speed_exponent=k, yield_speed=v_y)
        return law.restitution_at(v)

    cases = {
        (1.0, 0.25, 0.0, 1.0): (1.0, 0.0, 0.0, -0.25),
        (0.5, 0.25, 1.0, 1.0): (0.0, 0.0, 0.75, -0.75),
        (0.0, 0.25, 0.0, 1.0): (1.0, 0.0, 0.0, 0.0),
    }
    at = jnp.array(list(cases))
    slopes = jax.vmap(jax.jacrev(lambda x: found(*x)))(at)
    np.testing.assert_allclose(slopes, list(cases.values()), atol=1e-15)


@pytest.mark.parametrize("base", [ji.Newton, ji.Moreau, ji.Poisson, ji.Binary])
def test_every_law_takes_the_option(base):
    """It acts as with the e of that speed; a study knows it by name."""
    law = ji.VelocityDependent(base(0.5), speed_exponent=0.25, yield_speed=0.1)
    out = ji.impact(law, PAIR, [3.0, 0.5])
    e = law.restitution_at(2.5)
    np.testing.assert_allclose(out.velocity, ji.impact(base(e), PAIR, [3.0, 0.5]).velocity)
    slow = ji.impact(law, PAIR, [0.05, 0.0])
    assert abs(float(slow.energy_change)) < 1e-15


def test_a_study_names_the_option(tmp_path):
    (tmp_path / "study.toml").write_text(
        "[scene]\nmasses_kg = [1.0, 2.0]\n[law]\nname = 'velocity_dependent'\nbase = 'lzb'\n"
        "restitution = 0.9\nstiffness = 2.0\nyield_speed = 0.1\nreference_speed = 2.0\n"
    )
    study = read_study(tmp_path / "study.toml")
    assert isinstance(study.law.law, ji.LZB)
    assert float(study.law.yield_speed) == 0.1
    assert study.free == {"restitution": True, "yield_speed": True}


def test_a_page_of_something_else_than_shots(tmp_path):
    problem = ji.FitProblem.from_observable(
        ji.Newton(0.9), lambda law: law.restitution ** jnp.array([2.0, 4.0]), [0.49, 0.25], 0.01
    )
    text = ji.fit(problem).report(tmp_path / "fit.html").read_text(encoding="utf-8")
    assert "restitution = 0.70" in text
    assert text.count("<img") == 2


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ji.VelocityDependent(ji.RestitutionMatrix(np.eye(2))), "`law` must have `rest"),
        (lambda: ji.VelocityDependent(ji.VelocityDependent(ji.Newton(0.5))), "already"),
        (lambda: ji.VelocityDependent(ji.Newton(0.5), speed_exponent=3.0), r"lie in \[-1, 1\]"),
        (lambda: ji.VelocityDependent(ji.Newton(0.5), yield_speed=-1.0), "`yield_speed`"),
        (
            lambda: ji.REGISTRY["velocity_dependent"].build(base="magic", restitution=0.9),
            "`base` must be one of",
        ),
        (
            lambda: ji.REGISTRY["velocity_dependent"].build(
                base="newton", restitution=0.9, stiffness=1.0
            ),
            "newton does not have it",
        ),
    ],
)
def test_bad_dependence_on_speed(make, message):
    with pytest.raises((TypeError, ValueError), match=message):
        make()


def test_the_need_of_a_dependence_on_speed_is_tested():
    falling = 0.8 * SPEED**-0.2
    law = ji.VelocityDependent(ji.Newton(0.7), speed_exponent=0.1)
    for sigma in (0.01, None):
        for e, needed in ((falling, True), (np.full(12, 0.7), False)):
            data = ji.Experiments(PRE, after(e, 0.01), sigma)
            constant, full = ji.fit(ji.Newton(0.7), PAIR, data), ji.fit(law, PAIR, data)
            assert full.names == ("restitution", "speed_exponent")
            test = ji.nested_test(constant, full)
            assert test.needed is needed, str(test)
            gain = constant.starts[0].sum_of_squares - full.starts[0].sum_of_squares
            if sigma is None:
                assert test.statistic == pytest.approx(gain / full.noise**2)
                # 24 measured velocities, 2 parameters, of which 1 is tested
                chance = stats.f.sf(test.statistic, 1, 22)
                assert test.chance == pytest.approx(chance, rel=1e-9, abs=1e-300)
            elif full.noise == 1:
                assert test.chance == pytest.approx(chdtrc(1, gain))
    with pytest.raises(ValueError, match="more parameters"):
        ji.nested_test(full, constant)


def test_exponents_are_sought_where_they_mean_something():
    law = ji.LZB(0.9, [1.0, 2.0], exponent=jnp.asarray([1.5, 7.0]))
    balls = ji.chain([1.0, 1.0, 1.0])
    data = ji.Experiments([1.0, 0.0, 0.0], [-0.06, 0.1, 0.96])
    problem = ji.FitProblem.from_shots(law, balls, data, "exponent")
    assert problem.domains.tolist() == [[1.0, 5.0], [1.0, 7.0]]


def test_scatter_between_shots():
    """Its size, and the mean's error, which is that of so many draws."""
    rng = np.random.default_rng(3)
    e = 0.7 + 0.05 * rng.normal(size=12)
    found = ji.fit(ji.Newton(0.5), PAIR, ji.Experiments(PRE, after(e, 0.002), sigma=0.002))
    reported = ji.scatter(found)
    assert reported.explains
    assert reported.value == pytest.approx(e.std(ddof=1), rel=0.05)
    assert reported.standard_error[0] == pytest.approx(reported.value / np.sqrt(12), rel=0.05)
    np.testing.assert_allclose(reported.each, e, atol=0.02)
    assert "if restitution scatters by 0.0" in found.verdict
    assert "Scatter from shot to shot" in str(found)
    assert found.noise > 5  # the errors of the plain fit are stretched
    falling = ji.Experiments(PRE, after(0.8 * SPEED**-0.2, 0.002), sigma=0.002)
    assert "It depends on the speed" in str(ji.fit(ji.Newton(0.5), PAIR, falling))
    moved = after(e, 0.002) + 0.1 * rng.normal(size=(12, 1))  # no e makes momentum
    both = ji.fit(ji.Newton(0.5), PAIR, ji.Experiments(PRE, moved, sigma=0.002))
    reported = ji.scatter(both)
    share = 1 - reported.squares / both.starts[0].sum_of_squares
    assert 0.1 < share < 0.9
    assert not reported.explains
    assert f"from shot to shot, which accounts for {100 * share:.2g} % of chi^2" in both.verdict


def test_the_chance_of_scatter_is_half_that_of_chi_squared():
    """Shots alike: `deviance(t) = (K - 1) log(s^2 + t^2) + S / (s^2 + t^2)`, least at S / (K - 1)."""
    sigma, e = 0.02, 0.7 + 0.04 * np.sin(np.arange(12.0))
    pre = np.tile([1.0, 0.0], (12, 1))
    post = np.stack([(1 - 2 * e) / 3, (1 + e) / 3], axis=1)
    s = sigma / np.sqrt((2 / 3) ** 2 + (1 / 3) ** 2)  # error of the e of one shot
    ratio = e.var(ddof=1) / s**2
    gain = 11 * (ratio - 1 - np.log(ratio))
    scatter = ji.scatter(ji.fit(ji.Newton(0.5), PAIR, ji.Experiments(pre, post, sigma)))
    assert scatter.value == pytest.approx(s * np.sqrt(ratio - 1), rel=1e-4)
    assert scatter.chance == pytest.approx(0.5 * stats.chi2.sf(gain, 1), rel=1e-4)


def test_a_trend_over_the_shots_has_two_sides():
    """With equal errors it is the t test of a regression line."""
    x = np.arange(8.0)
    y = 0.7 - 0.01 * x + 0.02 * np.cos(3 * x)
    scatter = Scatter("e", 0.0, 1.0, ("e",), y[:1], y[:1], 1.0, 7, y, np.full(8, 0.02))
    assert scatter.trend(x) == pytest.approx(stats.linregress(x, y).pvalue)
    assert scatter.trend(-x) == pytest.approx(stats.linregress(x, y).pvalue)


def test_no_scatter_is_said():
    data = ji.Experiments(PRE, after(np.full(12, 0.7), 0.01))
    found = ji.fit(ji.Newton(0.5), PAIR, data)
    reported = ji.scatter(found)
    assert reported.chance > 0.01
    assert "shows no scatter" in str(reported)
    assert reported.mean[0] == pytest.approx(found.value[0], abs=0.5 * found.standard_error[0])
    with pytest.raises(ValueError, match="`name` must be one of restitution"):
        ji.scatter(found, "friction")


BALLS = ji.chain([1.0, 1.0, 1.0])


def of_both_ends(sets, shots, sds, correlation, sigma):
    """Sets of shots of two balls at a third, from both ends, whose e1 and e2 scatter."""
    rng = np.random.default_rng(7)
    spread = np.outer(sds, sds) * [[1.0, correlation], [correlation, 1.0]]
    e = rng.multivariate_normal([0.7, 0.6], spread, (sets, shots))
    post = np.stack([-2 * e[..., 0] - e[..., 1], e[..., 0] - e[..., 1], e @ [1.0, 2.0]], axis=-1)
    post = post / 3 + sigma * rng.normal(size=post.shape)
    return [ji.Experiments(np.tile([1.0, 0.0, -1.0], (shots, 1)), v, sigma) for v in post]


def test_scatter_of_two_parameters():
    """Shots alike: D is the covariance of their (e1, e2) less S, that of the errors of one.

    `deviance = (K - 1) (log det V + tr(V^-1 C))`, V = D + S, C the covariance of what they show.
    """
    sigma, (data,) = 0.005, of_both_ends(1, 16, [0.06, 0.04], 0.5, 0.005)
    slope = np.array([[-2.0, -1.0], [1.0, -1.0], [1.0, 2.0]]) / 3
    shown = np.cov(np.linalg.pinv(slope) @ np.asarray(data.post).T)
    error = sigma**2 * np.linalg.inv(slope.T @ slope)

    def deviance(sds, correlation):
        v = np.outer(sds, sds) * [[1.0, correlation], [correlation, 1.0]] + error
        return 15 * (np.linalg.slogdet(v)[1] + np.trace(np.linalg.solve(v, shown)))

    fit = ji.fit(ji.Newton([0.9, 0.9]), BALLS, data)
    found = ji.joint_scatter(fit, fit.names)
    spread = shown - error
    np.testing.assert_allclose(found.value, np.sqrt(np.diag(spread)), rtol=1e-3)
    correlation = spread[0, 1] / np.sqrt(spread[0, 0] * spread[1, 1])
    np.testing.assert_allclose(found.correlation, [[1, correlation], [correlation, 1]], atol=1e-3)
    np.testing.assert_allclose(found.standard_error**2, np.diag(shown) / 16, rtol=1e-3)
    least = deviance(found.value, correlation)
    np.testing.assert_allclose(
        found.chance, stats.chi2.sf(deviance([0.0, 0.0], 0.0) - least, 3), rtol=1e-2
    )
    for end in found.interval[0]:

        def others(x, end=end):
            return deviance([end, np.exp(x[0])], np.tanh(x[1]))

        best = optimize.minimize(others, [-3.0, 0.5], method="Nelder-Mead")
        assert best.fun - least == pytest.approx(stats.chi2.isf(0.05, 1), rel=0.01)
    apart = ji.joint_scatter(fit, fit.names, correlated=False)
    assert apart.correlation.tolist() == [[1.0, 0.0], [0.0, 1.0]]
    assert "restitution[2] scatters by" in str(apart)
    with pytest.raises(ValueError, match="at least two parameters"):
        ji.joint_scatter(fit, ["restitution[1]"])


@pytest.mark.release
def test_intervals_of_two_scatters_cover():
    """100 sets of 24 shots: 95 % intervals, of which 100 show a standard deviation of 2 %."""
    sds = np.array([0.05, 0.02])
    fits = ji.fit_many(ji.Newton([0.9, 0.9]), BALLS, of_both_ends(100, 24, sds, 0.5, 0.005))
    low, high = np.moveaxis([ji.joint_scatter(x, x.names).interval for x in fits], 2, 0)
    assert (((low <= sds) & (sds <= high)).mean(axis=0) > 0.89).all()


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [0.01, None])
def test_errors_of_the_mean_are_true(sigma):
    """Over many sets of shots whose e scatters: the spread of what is found is what is reported."""
    rng, sets = np.random.default_rng(5), 150
    many = []
    for k in range(sets):
        e = np.clip(0.6 + 0.06 * rng.normal(size=12), 0, 1)
        many.append(ji.Experiments(PRE, after(e, 0.01, seed=k), sigma))
    found = [ji.scatter(fit) for fit in ji.fit_many(ji.Newton(0.5), PAIR, many)]
    mean = np.array([x.mean[0] for x in found])
    error = np.array([x.standard_error[0] for x in found])
    assert mean.std() == pytest.approx(np.sqrt(np.mean(error**2)), rel=0.15)
    inside = np.abs(mean - 0.6) < 2.2 * error  # Student's t of 11 degrees of freedom, 95 %
    assert inside.mean() > 0.9
    assert np.median([x.value for x in found]) == pytest.approx(0.06, rel=0.15)


@pytest.mark.slow
@pytest.mark.usefixtures("lenient")
def test_posterior_is_the_linearized_one_where_it_is_gaussian(found):
    pytest.importorskip("numpyro")
    pytest.importorskip("arviz")
    size = {"samples": 2500, "warmup": 200, "chains": 2}
    flat = ji.posterior(found, **size)
    x = np.asarray(flat.posterior["restitution"])
    assert x.shape == (2, 2500)
    assert x.mean() == pytest.approx(found.value[0], abs=0.1 * found.standard_error[0])
    assert x.std() == pytest.approx(found.standard_error[0], rel=0.05)


@pytest.mark.slow
@pytest.mark.usefixtures("lenient")
def test_posterior_of_an_admissible_matrix_is_that_of_a_grid():
    pytest.importorskip("numpyro")
    pytest.importorskip("arviz")
    balls, law = ji.chain([1.0] * 3), ji.RestitutionMatrix([[0.5, 0.1], [0.15, 0.4]])
    pre = np.array([[1.0, 0, 0], [1, 0, -1], [0, 0, -1], [1, 0.2, -0.5]])
    post = np.array([ji.impact(law, balls, v).velocity for v in pre])
    post += 0.15 * np.random.default_rng(0).normal(size=post.shape)
    free = {"matrix": np.array([[False, True], [True, False]])}
    fitted = ji.fit(law, balls, ji.Experiments(pre, post, 0.15), free, starts=1)
    drawn = ji.posterior(fitted, samples=800, warmup=300, chains=2).posterior
    x = np.stack([np.ravel(drawn[name]) for name in fitted.names])

    problem, region = fitted.problem, fitted.problem.residuals.region
    middle = (np.arange(40) + 0.5) / 40
    grid = np.stack(np.meshgrid(middle, middle), axis=-1).reshape(-1, 2)
    slack, density = jax.jit(
        jax.vmap(lambda y, x: (region.conditions(y)[0].min(), problem.log_density(x)))
    )(problem.point(grid), grid)
    weight = np.where(slack >= 0, np.exp(density - np.max(density)), 0.0)
    weight /= weight.sum()
    mean = weight @ grid
    np.testing.assert_allclose(x.mean(axis=1), mean, atol=0.015)
    np.testing.assert_allclose(x.std(axis=1), np.sqrt(weight @ (grid - mean) ** 2), rtol=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("priors", "message"),
    [
        ({"restitution": ji.Uniform(0.5, 1.5)}, r"`priors` must lie in \[0, 1\]"),
        ({"restitution": ji.Normal(2.0, 0.1)}, "`priors` must have its mean in"),
        ({"restitution": 0.5}, "`priors` must map `restitution`"),
        ({"stiffness": ji.Uniform(0.5, 1.5)}, "`priors` must name parameters, restitution"),
    ],
)
def test_bad_priors(found, priors, message):
    pytest.importorskip("numpyro")
    pytest.importorskip("arviz")
    with pytest.raises(ValueError, match=message):
        ji.posterior(found, priors)


def test_the_extra_is_named_where_it_is_missing(found, monkeypatch):
    monkeypatch.setitem(sys.modules, "numpyro", None)
    with pytest.raises(ImportError, match=r"jimpact\[bayes\]"):
        ji.posterior(found)
