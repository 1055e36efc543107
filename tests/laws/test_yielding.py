"""Contacts with a bounded force: against closed forms and Verlet's method, their slopes, bad input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jimpact as ji

K, ETA = np.array([1.0, 2.0, 1.5]), 1.5
NORMALS = np.diff(np.eye(4), axis=0).T


@jax.jit
@jax.vmap
def outcome(masses, gaps, before, yields):
    """v+, status, energy change and slope of v+ by the yield force, of four balls."""

    def after(bound):
        law = ji.Compliant(ji.ElastoPlastic(K, bound, ETA))
        out = ji.impact(law, ji.chain(masses, gaps=gaps), before)
        return out.velocity, (out.status, out.energy_change)

    v, slope, rest = jax.jvp(after, (yields,), (jnp.ones_like(yields),), has_aux=True)
    return v, slope, *rest


def verlet(masses, gaps, v, bound, step=2e-4):
    """The same, with the elastic indentation cut where its force is the bound."""
    x, most = -np.asarray(gaps), (bound / K) ** (1 / ETA)

    def pushed(v, x):
        return v + step / 2 * NORMALS @ (K * np.maximum(x, 0.0) ** ETA) / masses

    for _ in range(200_000):
        v = pushed(v, x)
        x = np.minimum(x - step * (NORMALS.T @ v), most)
        v = pushed(v, x)
        if (x <= 0).all() and (NORMALS.T @ v >= 0).all():
            return v
    raise RuntimeError


SPEEDS = np.array([0.1, 0.5, 1.0, 3.0])
MASSES, GAPS, STRIKE = [1.0, 2.0, 1.0, 50.0], [0.0, 0.1, 0.0], [1.0, 0.5, -0.3, -0.3]
STATES = [
    *[([1.0] * 4, [0.0, 1.0, 1.0], [v, 0.0, 4.0, 5.0], 0.2) for v in SPEEDS],
    ([1.0] * 4, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0, 5.0], 0.25),
    *[(MASSES, GAPS, STRIKE, 0.3 + step) for step in (0.0, 1e-4, -1e-4)],
]


@pytest.fixture(scope="module")
def found():
    columns = [np.array(column) for column in zip(*STATES)]
    return [np.asarray(x) for x in outcome(*columns)]


@pytest.mark.slow
def test_restitution_falls_with_the_speed(found):
    """e = 1 up to v_y, then v_y / v: a pair of reduced mass 1/2, the others are fast."""
    v, _, _, change = found
    energy = 0.2 ** (2.5 / 1.5) / 2.5  # at the yield force, k = 1
    e = np.minimum(1.0, np.sqrt(4 * energy) / SPEEDS)
    assert e[0] == 1 > e[1] > 0.5
    v_1 = SPEEDS * (1 - e) / 2
    np.testing.assert_allclose(v[:4, 0], v_1, atol=1e-7)
    np.testing.assert_allclose(
        [
            float(ji.measured_restitution(ji.ElastoPlastic(1.0, 0.2), 0.5, x))
            for x in SPEEDS
        ],
        e,
    )
    assert (change[1:4] < -1e-3).all()


@pytest.mark.slow
def test_chains_with_gaps(found):
    v, slope, status, change = found
    assert (status[4:] == 0).all()
    for i in (4, 5):
        masses, gaps, before, bound = (np.array(x) for x in STATES[i])
        np.testing.assert_allclose(v[i], verlet(masses, gaps, before, bound), atol=1e-6)
        energy = (masses * (v[i] ** 2 - before**2)).sum() / 2
        np.testing.assert_allclose(change[i], energy, rtol=1e-9)
    np.testing.assert_allclose(slope[5], (v[6] - v[7]) / 2e-4, atol=1e-5)


@pytest.mark.slow
def test_the_loop_is_flat_at_the_yield_force():
    """Force .2 from x_y = .2^(2/3) on; unloading along another branch to a residual indentation."""
    law = ji.Compliant(ji.ElastoPlastic(1.0, 0.2))
    h = ji.history(law, ji.chain([1.0, 1.0]), [1.0, 0.0], samples=101)
    x, f = np.asarray(h.approach[:, 0]), np.asarray(h.force[:, 0])
    at_yield = 0.2 ** (2 / 3)
    rising = np.arange(101) <= x.argmax()
    np.testing.assert_allclose(
        f[rising], np.minimum(np.maximum(x[rising], 0) ** 1.5, 0.2), atol=1e-4
    )
    residual = x.max() - at_yield
    np.testing.assert_allclose(x[-1], residual, atol=1e-3)
    elastic = np.maximum(x[~rising] - residual, 0.0)
    np.testing.assert_allclose(f[~rising], elastic**1.5, atol=2e-3)
    lost = 0.25 * (
        1 - float(ji.measured_restitution(ji.ElastoPlastic(1.0, 0.2), 0.5, 1.0)) ** 2
    )
    assert 0.2 * residual == pytest.approx(lost, rel=1e-2)
