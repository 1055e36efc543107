"""Impulse ratios: the interval of correlations."""

import numpy as np
import pytest

import jimpact as ji


def test_the_interval_ends_where_a_contact_stays_closed():
    """Below: contact 2 approaches; above: contact 1 would, after all it has lost."""
    rng = np.random.default_rng(5)
    for _ in range(20):
        masses, e = rng.uniform(0.3, 3, 3), rng.uniform(0.2, 1)
        w = np.array([[1 / masses[0] + 1 / masses[1], -1 / masses[1]],
                      [-1 / masses[1], 1 / masses[1] + 1 / masses[2]]])  # fmt: skip
        low, high = (
            x[0, 1] for x in ji.theory.correlation_interval(ji.chain(masses), e)
        )
        assert np.isnan(ji.theory.correlation_interval(ji.chain(masses), e)[0][0, 0])
        for r, closed in ((low, 1), (high, 0)):
            d = np.array([1.0, r])
            a = w @ d
            lost = (1 - e**2) / (2 * a[0])
            p = (1 + np.sqrt(1 - 2 * (d @ a) * lost)) / (d @ a)
            gamma = np.array([-1.0, 0]) + a * p
            assert abs(gamma[closed]) < 1e-9
            assert gamma[1 - closed] > -1e-9
    with pytest.raises(ValueError, match="`restitution`"):
        ji.theory.correlation_interval(ji.chain([1.0] * 3), 1.1)
