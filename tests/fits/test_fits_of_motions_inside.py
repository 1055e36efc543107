"""Fits of several motions at once."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

import jimpact as ji
from jimpact.fits import fitting_motion


@pytest.mark.slow  # compiles programs of its own
def test_several_motions_are_fitted_at_once(monkeypatch):
    """A motion of closed form in the place of the simulated one: heights of bounces, h e^2, ..."""

    def bounces(system, law, q0, v0, t_end, samples):
        heights = (q0 + v0)[None] * (law.restitution**2) ** jnp.arange(
            samples, dtype=q0.dtype
        )[:, None]
        return SimpleNamespace(q=heights, status=jnp.asarray(0))

    monkeypatch.setattr(fitting_motion, "simulate", bounces)
    monkeypatch.setattr(fitting_motion, "LANES", 2)  # the second lot has one motion
    own = (
        np.array([1.0, 2.0, 0.5])[:, None, None] * 0.8 ** (2.0 * np.arange(4))[:, None]
    )
    own[1, 2] = np.nan  # was not measured
    given = (
        ji.System(ji.Column([1.0]), gravity=True),
        ji.Newton(0.7),
        own,
        [[1.0], [1.5], [0.5]],
        [[0.0], [0.5], [0.0]],
        1.0,
    )
    found = ji.fit_motion(*given, sigma=1e-3)
    np.testing.assert_allclose(found.value, 0.8, atol=1e-9)
    assert found.degrees_of_freedom == 10
    np.testing.assert_allclose(found.predicted[1, 2], 2 * 0.8**4)
