"""Which law, restitution by speed, scatter between shots, the posterior."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import erf
from selection_cases import PAIR, PRE, after

import jimpact as ji
from jimpact.core.law import with_parameter
from jimpact.fits.posterior import _priors
from jimpact.fits.selection import _candidates
from jimpact.laws.velocity_dependent import approach_speed


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


def test_compliant_is_compared_where_gaps_matter():
    """At a wall LZB lets contacts close again at once, Compliant when their gap is closed."""
    values = {"stiffness": 1.0}
    free, wall = ji.chain([1.0, 1.0]), ji.chain([1.0, 1.0], wall=True)
    candidates, left_out = _candidates([free], None, dict(values), ())
    assert "compliant" not in candidates
    assert "close again (as at a wall)" in left_out["compliant"]
    assert "moreau with one restitution" in left_out["routh"]
    for scenes, laws in (([wall], None), ([free], ["lzb", "compliant"])):
        candidates, left_out = _candidates(scenes, laws, dict(values), ())
        assert any(name.startswith("compliant") for name in candidates)
        assert "compliant" not in left_out


def test_contacts_that_feel_each_other_share_a_speed():
    w = np.diag([2.0, 2.0, 2.0, 1.0, 1.0])
    w[0, 1] = w[1, 0] = w[1, 2] = w[2, 1] = -1.0  # a chain of three, and two apart
    speed = approach_speed(ji.Contact(w, [0.0, -0.2, 0.3, -2.0, 1.0]))
    assert speed.tolist() == [0.2, 0.2, 0.2, 2.0, 0.0]


@pytest.mark.slow
def test_lzb_and_compliant_take_the_option():
    balls, v = ji.chain([1.0, 1.0, 1.0]), [2.0, 0.0, 0.0]
    for base in (ji.LZB(0.5, [1.0, 2.0]), ji.Compliant(ji.Bistiffness(1.0, 1.5, 0.5))):
        law = ji.VelocityDependent(base, speed_exponent=0.25, yield_speed=0.01)
        e = law.restitution_at(jnp.full(2, 2.0))
        expected = ji.impact(with_parameter(base, "restitution", e), balls, v).velocity
        np.testing.assert_allclose(
            ji.impact(law, balls, v).velocity, expected, atol=1e-9
        )
        slow = ji.impact(law, balls, [0.01, 0.0, 0.0])
        assert abs(float(slow.energy_change)) < 1e-10


@pytest.mark.slow
@pytest.mark.usefixtures("lenient")
def test_priors_are_declared_like_domains(found):
    kinds = pytest.importorskip("numpyro.distributions")
    problem = found.problem
    for given, low, high in (
        ({}, 0.0, 1.0),
        ({"restitution": ji.Uniform(0.2, 0.4)}, 0.2, 0.4),
    ):
        prior = _priors(problem, given, kinds)["restitution"]
        assert (float(prior.low), float(prior.high)) == pytest.approx((low, high))
    normal = _priors(problem, {"restitution": ji.Normal(0.9, 0.1)}, kinds)[
        "restitution"
    ]
    inside = 0.5 * (
        1 + erf(1 / np.sqrt(2))
    )  # truncated at 1, one standard deviation above
    top = np.exp(float(normal.log_prob(0.9)))
    assert top == pytest.approx(1 / (0.1 * np.sqrt(2 * np.pi) * inside), rel=1e-6)
    beta = kinds.Beta(2.0, 2.0)
    assert _priors(problem, {"restitution": beta}, kinds)["restitution"] is beta
    data = ji.Experiments([1.0, 0.0], [-0.2, 0.6], 0.01)
    given = {"restitution": (0.8, 0.05)}
    known = ji.FitProblem.from_shots(ji.Newton(0.9), PAIR, data, priors=given)
    own = _priors(known, {}, kinds)[
        "restitution"
    ]  # of the fit, unless others are given
    assert float(own.log_prob(0.8) - own.log_prob(0.85)) == pytest.approx(0.5)
    assert (
        type(
            _priors(known, {"restitution": ji.Uniform(0.2, 0.4)}, kinds)["restitution"]
        )
        is kinds.Uniform
    )
    lzb = ji.FitProblem.from_shots(
        ji.LZB(0.9, [1.0, 2.0]),
        ji.chain([1.0, 1.0, 1.0]),
        ji.Experiments([1.0, 0.0, 0.0], [-0.06, 0.1, 0.96]),
    )
    assert type(_priors(lzb, {}, kinds)["stiffness[2]"]) is kinds.LogUniform
