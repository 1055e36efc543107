"""Inputs that gave a wrong answer, with the right one. Each stands for its kind."""

import warnings

import pytest

import jimpact as ji


@pytest.mark.slow
def test_elastic_samples_at_a_coarse_tolerance_are_no_failures():
    law = ji.Compliant(ji.Hertz(1e9), rtol=1e-4)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        result = ji.monte_carlo(
            law,
            ji.chain([0.1, 0.2, 0.1]),
            [8.0, 0, 0],
            gaps=ji.Uniform(0.0, 1e-4),
            samples=256,
        )
    assert result.statuses == {"ok": 256}


def test_gaps_of_a_law_that_ignores_them_are_refused():
    with pytest.raises(ValueError, match="Compliant"):
        ji.monte_carlo(
            ji.LZB(0.9),
            ji.chain([1.0] * 3),
            [1.0, 0, 0],
            gaps=ji.Uniform(0.0, 5e-5),
            samples=8,
        )
