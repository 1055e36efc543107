"""Waves in chains beside closed forms and another integration."""

import jax.numpy as jnp
import numpy as np
import pytest

import jimpact as ji


@pytest.mark.parametrize("balls", [2, 3, 4, 7, 12])
def test_a_chain_that_disperses_nothing(balls):
    """Frequencies 0, w, 2 w, ...; at half a period all contacts open, the last ball has it all."""
    mass, stiffness = (np.asarray(x) for x in ji.theory.reinsch_chain(balls, 2.0, 3.0))
    assert (mass[0], stiffness[0]) == pytest.approx((2.0, 3.0))
    root, pull = np.sqrt(mass), np.zeros((balls, balls))
    for j, k in enumerate(stiffness):
        pull[j : j + 2, j : j + 2] += k * np.array([[1, -1], [-1, 1]])
    squares, modes = np.linalg.eigh(pull / root[:, None] / root[None])
    w = np.sqrt(np.maximum(squares, 0))
    np.testing.assert_allclose(w[1:] / w[1], np.arange(1, balls), rtol=1e-9)
    start = modes.T @ (root * np.eye(balls)[0])
    time = np.linspace(0, np.pi / w[1], 101)[:, None]
    w[0] = 1e-9
    x = (start * np.sin(w * time) / w) @ modes.T / root
    v = (start * np.cos(w * time)) @ modes.T / root
    np.testing.assert_allclose(v[-1], np.eye(balls)[-1], atol=1e-8)
    closed = -np.diff(x, axis=1)
    assert (closed[1:-1] > -1e-14).all()  # unilateral springs do the same
    np.testing.assert_allclose(closed[-1], 0, atol=1e-8)


def test_three_balls_are_those_of_the_chapter():
    mass, stiffness = ji.theory.reinsch_chain(3)
    np.testing.assert_allclose(mass, [1, 2 / 3, 1], rtol=1e-14)
    np.testing.assert_allclose(stiffness, [1, 1], rtol=1e-14)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ji.theory.reinsch_chain(1), "`balls`"),
        (lambda: ji.theory.reinsch_chain(3, mass=0.0), "`mass`"),
        (lambda: ji.theory.reinsch_chain(3, stiffness=-1.0), "`stiffness`"),
        (lambda: ji.theory.nesterenko_speed(0.0, 1.0, 1.0), "`stiffness`"),
        (lambda: ji.theory.nesterenko_speed(1.0, 1.0, -1.0), "`velocity`"),
    ],
)
def test_bad_input(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def verlet(balls, step, stop):
    """gamma' = W x^1.5, x' = -gamma, x >= 0 of unit balls and springs, the first at 1 m/s: v, F."""
    v, x, force, most = (
        np.eye(balls)[0],
        np.zeros(balls - 1),
        np.zeros(balls - 1),
        np.zeros(balls),
    )
    for _ in range(int(stop / step)):
        v[:-1] -= step / 2 * force
        v[1:] += step / 2 * force
        x = np.maximum(x - step * np.diff(v), 0.0)
        force = x * np.sqrt(x)
        v[:-1] -= step / 2 * force
        v[1:] += step / 2 * force
        most = np.maximum(most, v)
    return v, most


@pytest.mark.release
def test_a_solitary_wave():
    """60 Hertz balls: Nesterenko's speed within 1 %, five balls long, and as by Verlet's method."""
    n = 60
    scene, strike = ji.chain(np.ones(n)), np.eye(n)[0]
    h = ji.history(ji.LZB(1.0, np.ones(n - 1)), scene, strike, samples=1500)
    after, most = verlet(n, 1e-3, 80.0)
    np.testing.assert_allclose(h.velocity[-1], after, atol=1e-6)
    speed = float(ji.theory.nesterenko_speed(1.0, 1.0, most[30]))
    time, force = np.asarray(h.time), np.asarray(h.force)
    arrival = time[force.argmax(axis=0)]
    np.testing.assert_allclose(20 / (arrival[45] - arrival[25]), speed, rtol=0.01)
    np.testing.assert_allclose(
        force[:, 26:46].max(axis=0) / force[:, 25].max(), 1.0, atol=2e-3
    )
    kinetic = np.asarray(h.velocity[np.asarray(h.velocity)[:, 30].argmax()]) ** 2
    assert kinetic[28:33].sum() > 0.9999 * kinetic[20:].sum()


@pytest.mark.slow
def test_a_dispersion_free_chain_in_an_impact():
    mass, stiffness = ji.theory.reinsch_chain(6)
    out = ji.impact(ji.LZB(1.0, stiffness, 1.0), ji.chain(mass), jnp.eye(6)[0])
    np.testing.assert_allclose(out.velocity, np.eye(6)[-1], atol=1e-7)
