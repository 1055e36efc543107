"""Which law, restitution by speed, scatter between shots, the posterior."""

import json
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import argument
from scipy import stats
from scipy.special import chdtrc
from selection_cases import PAIR, PRE, SPEED, after

import jimpact as ji
from jimpact import read_study


@pytest.fixture(scope="module")
def found():
    return ji.fit(
        ji.Newton(0.5),
        PAIR,
        ji.Experiments(PRE, after(np.full(12, 0.7), 0.01), sigma=0.01),
    )


@pytest.fixture
def lenient():
    """The sampler mixes types and ranks, which the suite's flags forbid."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


@pytest.fixture(scope="module")
def every():
    data = ji.Experiments(PRE, after(np.full(12, 0.8), 0.01), sigma=0.01)
    return ji.fit_laws(
        PAIR, data, ["moreau", "newton", "restitution_matrix"], speed=True
    )


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
    assert every.verdict.startswith(
        "The simplest law that fits is newton: restitution = 0.8"
    )
    assert "predict" not in str(every)
    reported = json.loads(json.dumps(every.to_dict(), allow_nan=False))
    assert reported["best"] == "newton"
    assert len(reported["laws"]["moreau"]["fit"]["shots"]) == 12
    assert [row[0] for row in every.table.rows] == ["newton", "moreau"]
    assert every.to_csv().startswith("law,parameters,rms_m_per_s,")


def test_the_criterion_without_sigma_is_corrected_for_few_values():
    """AICc of 24 values, one parameter and the noise (Hurvich and Tsai)."""
    data = ji.Experiments(PRE, after(np.full(12, 0.8), 0.01))
    best = ji.fit_laws(PAIR, data, ["newton"]).best
    n, k, squares = 24, 2, float(np.sum(best.fit.residual**2))
    assert best.aicc == pytest.approx(n * np.log(squares / n) + 2 * k * n / (n - k - 1))


@pytest.mark.slow
def test_a_law_that_fails_is_named_and_comes_last():
    """Newton pulls at a contact that separates."""
    balls = ji.chain([1.0, 1.0, 1.0])
    data = ji.Experiments(
        [[1.0, 0.0, 1.0], [2.0, 0.0, 1.5]], [[0.1, 0.9, 1.0], [0.2, 1.8, 1.9]]
    )
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


@pytest.mark.slow
def test_restitution_by_a_table_and_by_a_function_of_the_speed():
    speeds, values = [0.5, 1.0, 4.0], [0.9, 0.8, 0.5]
    table = ji.VelocityDependent(ji.Newton(0.9), curve=(speeds, values))
    v = np.array([0.1, 0.75, 2.5, 9.0])
    np.testing.assert_allclose(
        table.restitution_at(v), 0.9 * np.interp(v, speeds, values)
    )
    above = ji.VelocityDependent(ji.Newton(0.9), curve=lambda v: 2.0 / (1.0 + v))
    np.testing.assert_allclose(above.restitution_at(v), np.minimum(1.8 / (1 + v), 1.0))
    slope = jax.grad(lambda v: table.restitution_at(v))(2.0)
    assert float(slope) == pytest.approx(-0.09)


def power(v):
    return 0.8 * v**-0.1


@pytest.mark.slow
def test_the_exponent_of_the_speed_is_said_with_its_error():
    data = ji.Experiments(PRE, after(0.7 * PRE[:, 0] ** -0.1, 0.01), sigma=0.01)
    laws = ji.fit_laws(PAIR, data, ["newton"], speed=True)
    assert laws.speed.needed
    at = laws.speed_fit.names.index("speed_exponent")
    assert abs(laws.speed_fit.value[at] - 0.1) < 4 * laws.speed_fit.standard_error[at]
    assert f"speed_exponent = {laws.speed_fit.value[at]:.4g} ± " in str(laws)
    assert "the data then fit" in str(laws)
    assert json.loads(json.dumps(laws.to_dict(), allow_nan=False))["speed_fit"]


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
    np.testing.assert_allclose(
        out.velocity, ji.impact(base(e), PAIR, [3.0, 0.5]).velocity
    )
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


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: ji.VelocityDependent(ji.RestitutionMatrix(np.eye(2))),
            "`law` must have `rest",
        ),
        (lambda: ji.VelocityDependent(ji.VelocityDependent(ji.Newton(0.5))), "already"),
        (
            lambda: ji.VelocityDependent(ji.Newton(0.5), speed_exponent=3.0),
            r"lie in \[-1, 1\]",
        ),
        (
            lambda: ji.VelocityDependent(ji.Newton(0.5), yield_speed=-1.0),
            "`yield_speed`",
        ),
        (
            lambda: ji.VelocityDependent(ji.Newton(0.5), curve=([1, 2], [0.5])),
            "`curve`.*two or",
        ),
        (
            lambda: ji.VelocityDependent(ji.Newton(0.5), curve=([2, 1], [0.5, 0.5])),
            "speeds that rise",
        ),
        (
            lambda: ji.VelocityDependent(ji.Newton(0.5), curve=([1, 2], [0.5, -1])),
            "`curve`.*-1",
        ),
        (
            lambda: ji.VelocityDependent(ji.Newton(0.5), curve=lambda v: 1.0),
            "`curve`.*shape",
        ),
        (
            lambda: ji.VelocityDependent(
                ji.Newton(0.5), speed_exponent=0.1, curve=([1, 2], [0.5, 0.4])
            ),
            "must not both",
        ),
        (
            lambda: ji.REGISTRY["velocity_dependent"].build(
                base="magic", restitution=0.9
            ),
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


@pytest.mark.slow
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
    with pytest.raises(ValueError, match=argument("full")):
        ji.nested_test(full, constant)


def test_exponents_are_sought_where_they_mean_something():
    law = ji.LZB(0.9, [1.0, 2.0], exponent=jnp.asarray([1.5, 7.0]))
    balls = ji.chain([1.0, 1.0, 1.0])
    data = ji.Experiments([1.0, 0.0, 0.0], [-0.06, 0.1, 0.96])
    problem = ji.FitProblem.from_shots(law, balls, data, "exponent")
    assert problem.domains.tolist() == [[1.0, 5.0], [1.0, 7.0]]


def test_a_posterior_by_an_arviz_that_is_too_new_is_refused_before_it_is_drawn(
    monkeypatch,
):
    """Version 1 has no `InferenceData`: the message says so at once."""
    monkeypatch.setitem(sys.modules, "numpyro", SimpleNamespace())
    monkeypatch.setitem(sys.modules, "arviz", SimpleNamespace(__version__="1.3.0"))
    with pytest.raises(
        ImportError, match=r"arviz must be older than 1 .* is 1\.3\.0: pip install"
    ):
        ji.posterior(None)


def test_values_with_an_exponent_are_printed():
    post = [[0.49999999, 0.50000001], [0.99999, 1.00001]]
    data = ji.Experiments(pre=[[1.0, 0.0], [2.0, 0.0]], post=post, sigma=1e-6)
    report = str(ji.fit_laws(ji.chain([1.0, 1.0]), data, ["newton", "moreau"]))
    assert report.count("restitution 8.004e-06") == 2


def disc_at_angles(law):
    """A disc on the ground, shots at four angles, and v+ by the law."""
    scene = ji.Disc(0.5, mass=2.0, inertia=0.2).scene([0.0, 0.5, 0.0])
    angles = np.radians([4.0, 9.0, 15.0, 30.0, 50.0])
    before = np.stack([np.sin(angles), -np.cos(angles), 0 * angles], axis=1)
    after = [ji.impact(law, scene, v).velocity for v in before]
    return scene, ji.Experiments(before, np.array(after), sigma=1e-3)


@pytest.mark.slow
def test_a_spring_is_chosen_where_the_shots_tell_it():
    springs = ji.LZB(0.8, friction=0.2, tangential_stiffness=0.7)
    scene, shots = disc_at_angles(springs)
    laws = {
        "rigid": ji.LZB(0.7, friction=0.3),
        "springs": ji.LZB(0.7, friction=0.3, tangential_stiffness=1.0),
    }
    found = ji.fit_laws(
        scene, shots, laws, free=["friction", "tangential_stiffness"], starts=8
    )
    best = next(iter(found.entries))
    assert best == "springs"
    law = found.entries[best].fit.law
    assert float(law.tangential_stiffness) == pytest.approx(0.7, abs=0.01)


def test_free_parameters_that_no_law_has_are_refused():
    scene, shots = disc_at_angles(ji.Newton(0.5, friction=0.2))
    with pytest.raises(ValueError, match="tangential_stiffness"):
        ji.fit_laws(scene, shots, ["newton"], free=["tangential_stiffness"])
    with pytest.raises(ValueError, match="tangential_stiffness"):
        ji.fit_laws(scene, shots, ["newton"], free=iter(["tangential_stiffness"]))
