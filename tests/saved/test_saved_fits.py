"""A saved fit is the same fit when it is loaded."""

import json

import jax
import numpy as np
import pytest
from fit_cases import PAIR, SHOTS, simulated

import jimpact as ji


@pytest.mark.parametrize("double", [True, False])
def test_findings_belong_to_the_precision_of_the_fit(double, tmp_path):
    """What is computed on first access does not depend on JAX's precision of then."""
    rng = np.random.default_rng(11)
    pre = np.array([[1.0, 0.0], [1.7, 0.0], [1.4, 0.2]])
    noise = 0.02 * rng.normal(size=(3, 2))
    with jax.enable_x64(double):
        pair = ji.chain([1.0, 3.0])
        after = np.array([ji.impact(ji.Newton(0.985), pair, v).velocity for v in pre])
        noisy = after + noise
        data = ji.Experiments(pre, noisy, sigma=0.02)
        early, late, saved = (ji.fit(ji.Newton(0.9), pair, data) for _ in range(3))
        expected = str(early), early.intervals(), early.predict(data).standard_error
        path = saved.save(tmp_path / "fit.json")
    with jax.enable_x64(not double):
        for fit in (late, ji.load(path)):
            assert str(fit) == expected[0]
            assert fit.intervals() == expected[1]
            np.testing.assert_array_equal(fit.predict(data).standard_error, expected[2])
    assert late.problem.precision == ("float64" if double else "float32")


@pytest.mark.parametrize("options", [{}, {"sigma_pre": 0.01}])
def test_a_saved_fit_is_the_same_fit(tmp_path, options):
    post = simulated(ji.Newton(0.6), PAIR, SHOTS, noise=0.02)
    post[2, 1] = np.nan
    data = ji.Experiments(SHOTS, post, 0.02, shots="abcd", **options)
    found = ji.fit(ji.Newton(0.9), PAIR, data, priors={"restitution": (0.6, 0.1)})
    path = found.save(tmp_path / "fit.json")
    again = ji.load(path)
    assert (str(again), again.to_dict()) == (str(found), found.to_dict())
    assert str(ji.load(path)) == str(found)
    for a, b in zip(*(jax.tree.leaves(x.problem) for x in (found, again))):
        np.testing.assert_allclose(a, b, rtol=1e-12)
    # the weights of the saved problem come from another program: rounding of a few products
    residuals = [x.problem.residual([0.7]) for x in (again, found)]
    np.testing.assert_allclose(*residuals, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(
        again.predict(SHOTS).low, found.predict(SHOTS).low, rtol=1e-12
    )
    record = json.loads(path.read_text())
    assert record["versions"]["jax"] == jax.__version__
    law = record["result"]["law"]
    for change, message in (
        ({"format": 2, "versions": {"jimpact": "9.9"}}, r"format 1, but has format 2 \(written by jimpact 9.9; this"),
        ({"result": record["result"] | {"law": law | {"class": "mine:Law"}}}, "law of your own must be imported"),
        ({"result": record["result"] | {"law": law | {"class": "os:remove"}}}, "is no class of a law"),
        ({"result": record["result"] | {"law": law | {"fields": {}}}}, "Newton has the fields"),
    ):  # fmt: skip
        path.write_text(json.dumps(record | change))
        with pytest.raises(ValueError, match=message):
            ji.load(path)
    for text, message in (
        ("[1]", "has no `format`"),
        ("e = 0.9", "a saved fit or motion .*no JSON"),
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=message):
            ji.load(path)
