"""Histories of impacts and their pictures."""

import jax.numpy as jnp
import numpy as np
import pytest

import jimpact as ji

STRIKE = jnp.array([1.0, 0.0, 0.0])


@pytest.mark.slow
def test_a_contact_that_is_compressed_twice():
    """Figure 6.6: two balls at a wall; approach and force at its turns, by another integration."""
    law, scene = ji.LZB([0.9, 0.8], [1.0, 2**0.5], 1.5), ji.chain([1.0, 1.0], wall=True)
    h = ji.history(law, scene, [1.0, 1.0], samples=800)
    force, approach = np.asarray(h.force[:, 1]), np.asarray(h.approach[:, 1])
    peak, valley, again = np.flatnonzero(np.diff(np.asarray(h.gap_velocity[:, 1]) > 0))[
        :3
    ]
    assert float(h.maximum_force[1]) == pytest.approx(1.344782, abs=1e-6)
    assert force[peak - 1 : peak + 3].max() == pytest.approx(1.344782, abs=1e-5)
    assert force[valley - 1 : valley + 3].min() == pytest.approx(0.6709, abs=1e-4)
    assert float(h.time[valley]) == pytest.approx(2.628, abs=5e-3)
    end = np.flatnonzero(force > 0)[-1]
    assert end > again
    x = (force[end] / 2**0.5) ** (
        2 / 3
    )  # the effective one; the true one unloads e^2 of it
    assert approach[end] - 0.8**2 * x == pytest.approx(0.3917, abs=5e-5)
    # the two loops enclose what is lost; the kinetic energies say how much that is
    lost = np.trapezoid(h.force, h.approach, axis=0).sum()
    assert lost == pytest.approx(
        1.0 - 0.5 * float(np.sum(h.velocity[-1] ** 2)), rel=1e-4
    )
    marks = ji.plot.contact_loop(h).axes[0].texts
    assert [text.get_text() for text in marks] == ["O", "M1", "R1", "M2", "B"]


@pytest.mark.slow
def test_history_across_gaps():
    scene, law = (
        ji.chain(jnp.ones(3), gaps=jnp.array([0.3, 4.0])),
        ji.Compliant(ji.Hertz(1.0)),
    )
    h = ji.history(law, scene, STRIKE, samples=400)
    out = ji.impact(law, scene, STRIKE)
    np.testing.assert_allclose(h.velocity[-1], out.velocity, atol=1e-7)
    np.testing.assert_allclose(
        np.trapezoid(h.force, h.time, axis=0), h.impulse[-1], rtol=2e-3
    )
    assert not np.asarray(h.force)[np.asarray(h.time) < 0.29].any()  # still flying
    pair = (1.25 * 0.5) ** 0.4  # deepest indentation of one pair
    assert float(h.indentation[:, 0].max()) == pytest.approx(pair, rel=1e-3)
    np.testing.assert_allclose(np.asarray(h.velocity).sum(axis=1), 1.0, atol=1e-12)
    assert ji.plot.forces({"balls": h}).axes[0].get_ylabel() == "force [N]"
