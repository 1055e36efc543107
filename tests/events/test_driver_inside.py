"""Batches work through a queue: impacts that end make room for others."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jimpact as ji
from jimpact.events.slip import SlipFlow
from jimpact.numerics.driver import until_over


@pytest.mark.parametrize("slots", [1, 7, 32, 60])
def test_each_goes_on_to_its_own_end(slots):
    """Counting, each to its own number: none, one or many passes, more or fewer than slots."""
    ends = jnp.asarray(np.random.default_rng(0).integers(0, 40, (1, 50)))

    def counted(ends):
        once_more = lambda ends, now: jnp.where(now < ends, now + 1, now)  # noqa: E731
        goes_on = lambda ends, now: now < ends  # noqa: E731
        return until_over(goes_on, once_more, ends, jnp.zeros_like(ends), slots=slots)

    np.testing.assert_array_equal(jax.jit(counted)(ends), ends)


@pytest.mark.release
def test_a_queue_gives_the_outcomes_of_single_impacts(monkeypatch):
    monkeypatch.setattr(SlipFlow, "slots", 4)
    box = ji.Box([0.3, 0.4, 0.5], mass=1.3)
    scene = box.scene(box.touching())
    v = np.random.default_rng(0).normal(size=(16, 6)) * [1, 1, 0, 1, 1, 1] - [
        0,
        0,
        2,
        0,
        0,
        0,
    ]
    law = ji.LZB(0.6, friction=0.3, rtol=1e-6)
    impact = lambda v: ji.impact(law, scene, v).velocity  # noqa: E731
    alone = np.stack([impact(x) for x in v[:3]])
    np.testing.assert_allclose(jax.vmap(impact)(v)[:3], alone, atol=1e-4)
