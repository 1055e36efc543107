"""Restitution by speed in impacts, fits and files."""

import jax
import jax.numpy as jnp
import pytest
from selection_cases import PAIR, PRE, after

import jimpact as ji


def power(v):
    return 0.8 * v**-0.1


@pytest.mark.slow
@pytest.mark.parametrize("curve", [power, (PRE[:, 0], power(PRE[:, 0]))])
def test_a_curve_of_the_speed_in_impacts_their_derivatives_and_fits(curve, tmp_path):
    law = ji.VelocityDependent(ji.Newton(1.0), curve=curve)

    def struck(v):
        return ji.impact(law, PAIR, jnp.stack([v, jnp.zeros_like(v)])).velocity[1]

    v = jnp.asarray(PRE[3, 0])
    e = 0.8 * PRE[3, 0] ** -0.1
    assert float(jax.jit(struck)(v)) == pytest.approx(PRE[3, 0] * (1 + e) / 3)
    if callable(curve):  # a table has a kink there
        assert float(jax.jit(jax.grad(struck))(v)) == pytest.approx((1 + 0.9 * e) / 3)
    data = ji.Experiments(PRE, after(0.9 * 0.8 * PRE[:, 0] ** -0.1, 1e-6), sigma=0.01)
    fit = ji.fit(law, PAIR, data)
    assert fit.value[0] == pytest.approx(0.9, abs=1e-4)
    if not callable(curve):
        fit.save(tmp_path / "fit.json")
        assert ji.load(tmp_path / "fit.json").law.curve == fit.law.curve
