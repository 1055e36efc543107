"""Batches with friction in space work through a queue: impacts that end make room for others."""

import jax
import numpy as np
import pytest

import jimpact as ji
from jimpact.numerics import driver


@pytest.mark.release
def test_a_queue_gives_the_outcomes_of_single_impacts(monkeypatch):
    monkeypatch.setattr(driver, "SLOTS", 4)
    monkeypatch.setattr(driver, "FREE", 2)
    box = ji.Box([0.3, 0.4, 0.5], mass=1.3)
    scene = box.scene(box.touching())
    v = np.random.default_rng(0).normal(size=(16, 6)) * [1, 1, 0, 1, 1, 1] - [0, 0, 2, 0, 0, 0]
    law = ji.LZB(0.6, friction=0.3, rtol=1e-6)
    impact = lambda v: ji.impact(law, scene, v).velocity  # noqa: E731
    alone = np.stack([impact(x) for x in v[:3]])
    np.testing.assert_allclose(jax.vmap(impact)(v)[:3], alone, atol=1e-4)
