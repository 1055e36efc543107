"""Histories over impact time: closed forms, energy ledger, accuracy between the steps."""

import jax
import numpy as np
import pytest

import jimpact as ji


def test_linear_contact_is_half_a_sine():
    m, k, v = 2.0, 8.0, 3.0
    h = ji.history(ji.LZB(1.0, k, 1.0), ji.chain([m], wall=True), [v], samples=101)
    omega = np.sqrt(k / m)
    np.testing.assert_allclose(h.duration, np.pi / omega, rtol=1e-8)
    np.testing.assert_allclose(h.time[-1], h.duration, rtol=1e-12)
    np.testing.assert_allclose(h.indentation[:, 0], v / omega * np.sin(omega * h.time), atol=2e-7)
    np.testing.assert_allclose(h.force[:, 0], k * h.indentation[:, 0], atol=1e-12)
    np.testing.assert_allclose(h.velocity[:, 0], v * np.cos(omega * h.time), atol=2e-7)
    np.testing.assert_allclose(h.maximum_force[0], v * np.sqrt(k * m), rtol=1e-8)
    assert int(h.status) == 0


@pytest.mark.parametrize("e", [0.0, 0.4, 0.9, 1.0])
@pytest.mark.parametrize("exponent", [1.5, pytest.param(1.3, marks=pytest.mark.slow)])
def test_energy_ledger_and_final_state(e, exponent):
    scene, v = ji.chain([1.0, 2.0, 1.5], wall=True), [1.0, 0.5, 0.2]
    law = ji.LZB([e, 0.8, 0.6], [1.0, 3.0, 2.0], exponent)
    h = ji.history(law, scene, v)
    out = ji.impact(law, scene, v)
    np.testing.assert_allclose(h.velocity[-1], out.velocity, atol=1e-6)
    np.testing.assert_allclose(h.impulse[-1], out.impulse, atol=1e-6)
    kinetic = 0.5 * np.asarray(h.velocity) ** 2 @ np.asarray(scene.mass)
    total = kinetic + np.asarray(h.energy).sum(axis=1)
    assert np.diff(total).max() < 1e-7
    assert total[0] == pytest.approx(float(ji.kinetic_energy(scene, v)), rel=1e-12)
    assert (np.asarray(h.force) >= 0).all()
    assert (np.asarray(h.maximum_force) >= np.asarray(h.force).max(axis=0) - 1e-9).all()


@pytest.mark.slow
def test_samples_are_as_accurate_as_the_steps():
    scene, v = ji.chain([1.0, 1.0, 1.0]), [1.0, 0.0, 0.0]
    got, exact = (ji.history(ji.LZB(0.9, rtol=rtol), scene, v) for rtol in (None, 1e-12))
    assert np.abs(got.force - exact.force).max() < 1e-6
    assert np.abs(got.velocity - exact.velocity).max() < 1e-6
    np.testing.assert_allclose(got.duration, exact.duration, rtol=1e-7)


@pytest.mark.parametrize(
    ("beads", "newton"),
    [(1, 51.66), (2, 52.90), pytest.param(5, 52.90, marks=pytest.mark.slow)],
)
def test_bead_column_maximum_wall_force(beads, newton):
    """Falcon's column: 3.1 mm drop, steel beads; the wall force hardly depends on their number."""
    column = ji.column(np.full(beads, 2.05e-3))
    k = np.append(np.full(beads - 1, 6.9716e9), 9.858e9)
    e = np.append(np.full(beads - 1, 0.96), 0.92)
    speed = np.sqrt(2 * 9.81 * 3.1e-3)
    h = ji.history(ji.LZB(e, k), column, np.full(beads, speed))
    assert float(h.maximum_force[-1]) == pytest.approx(newton, abs=0.01)
    if beads == 1:  # closed form of a Hertz contact; its expansion takes e times the compression
        beta = 1.4716375921623523  # int_0^1 dx / sqrt(1 - x^(5/2))
        deepest = (1.25 * 2.05e-3 * speed**2 / 9.858e9) ** 0.4
        assert float(h.duration) == pytest.approx(1.92 * beta * deepest / speed, rel=1e-7)


def test_nothing_happens():
    h = ji.history(ji.LZB(0.9), ji.chain([1.0, 1.0]), [0.0, 1.0])
    assert float(h.duration) == 0.0
    assert not np.asarray(h.force).any()
    np.testing.assert_array_equal(h.velocity[-1], [0.0, 1.0])


def test_too_few_records_are_flagged():
    h = ji.history(ji.LZB(0.9), ji.chain([1.0] * 3), [1.0, 0.0, 0.0], records=4)
    assert ji.STATUS[int(h.status)].name == "max_steps"


@pytest.mark.slow
def test_inside_jit():
    def peak(e):
        return ji.history(ji.LZB(e), ji.chain([1.0] * 3), [1.0, 0.0, 0.0], records=64).maximum_force

    eager = ji.history(ji.LZB(0.9), ji.chain([1.0] * 3), [1.0, 0.0, 0.0]).maximum_force
    np.testing.assert_allclose(jax.jit(peak)(0.9), eager, rtol=1e-10)
