"""Waves in chains: pulses beside closed forms and another integration, trains, design."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from canned import impact_history

import jimpact as ji
from jimpact import Pulses, Trains


def test_pulses_of_half_sines():
    """sin(pi t / T) is above one half for 2/3 of T; the second contact has half the force."""
    seen = ji.pulses(impact_history())
    np.testing.assert_allclose(seen.arrival, 37e-6 / 2)
    np.testing.assert_allclose(seen.amplitude, [900, 450])
    np.testing.assert_allclose(seen.duration, 2 / 3 * 37e-6, rtol=0.02)
    np.testing.assert_allclose(seen.attenuation, 0.5)
    assert str(seen).count("\n") == 2


def test_a_pulse_that_travels():
    """cos^6(sqrt(2/5) s) at 50 contacts/s: as long as Nesterenko's, pi sqrt(5/2)."""
    time = np.linspace(0, 0.4, 2001)
    s = np.clip(
        (time[:, None] - 0.10007 - np.arange(6) / 50) * 50 * np.sqrt(0.4), -np.pi / 2, np.pi / 2
    )
    force = 0.9 ** np.arange(6) * np.cos(s) ** 6
    h = impact_history()
    seen = ji.pulses(type(h)(**(vars(h) | {"time": time, "force": force})))
    np.testing.assert_allclose(seen.arrival, 0.10007 + np.arange(6) / 50, atol=1e-6)
    np.testing.assert_allclose(seen.speed, 50, rtol=1e-4)
    np.testing.assert_allclose(seen.attenuation, 0.9, rtol=1e-5)
    np.testing.assert_allclose(seen.width, np.pi * np.sqrt(2.5), rtol=1e-4)


def test_trains_in_words():
    """Three balls hit two at M = 3, 1, N = 2, 4; glued: (M - N)/(M + N), 2 M/(M + N)."""
    velocity = np.array([[-0.1, 0.2, 0.9, 1.0, 1.0], [-0.1, -0.1, 0.0, 0.2, 0.9]])
    trains = Trains(np.array([3, 1]), velocity, np.array([0, 0]))
    assert trains.forward.tolist() == [4, 2]
    np.testing.assert_allclose(trains.glued, [[0.2, 1.2], [-0.6, 0.4]])
    np.testing.assert_allclose(trains.forward_energy, [2.85 / 3, 0.85])
    np.testing.assert_allclose(trains.glued_forward_energy, [1.0, 0.64])
    assert "3 : 2" in str(trains)
    # the chapter: both agree where N (2 M / (M + N))^2 = 0.99 M and N = M + 2
    m = np.arange(1, 20)
    equal = np.isclose((m + 2) * (2 * m / (2 * m + 2)) ** 2, 0.99 * m)
    assert m[equal].tolist() == [9]


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
        (lambda: ji.colliding_trains(1), "`balls`"),
        (lambda: ji.colliding_trains(10, 0), "`hitting`"),
        (lambda: ji.colliding_trains(10, [3, 10]), "no ball is hit"),
        (lambda: ji.colliding_trains(10, 3, restitution=1.1), "`restitution`"),
        (lambda: ji.pulses(jax.tree.map(lambda x: np.stack([x, x]), impact_history())), "batch"),
    ],
)
def test_bad_input(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def verlet(balls, step, stop):
    """gamma' = W x^1.5, x' = -gamma, x >= 0 of unit balls and springs, the first at 1 m/s: v, F."""
    v, x, force, most = np.eye(balls)[0], np.zeros(balls - 1), np.zeros(balls - 1), np.zeros(balls)
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
    seen, middle = ji.pulses(h), slice(25, 45)
    after, most = verlet(n, 1e-3, 80.0)
    np.testing.assert_allclose(h.velocity[-1], after, atol=1e-6)
    assert isinstance(seen, Pulses)
    speed = float(ji.theory.nesterenko_speed(1.0, 1.0, most[30]))
    np.testing.assert_allclose(seen.speed[middle], speed, rtol=0.01)
    np.testing.assert_allclose(seen.attenuation[middle], 1.0, atol=1e-5)
    np.testing.assert_allclose(seen.width[middle], 5.0, atol=0.3)
    kinetic = np.asarray(h.velocity[np.asarray(h.velocity)[:, 30].argmax()]) ** 2
    assert kinetic[28:33].sum() > 0.9999 * kinetic[20:].sum()


@pytest.mark.slow
def test_trains_of_ten_balls():
    """M + 2 balls forward with 99 % of the energy, as long as there are so many to hit."""
    trains = ji.colliding_trains(10)
    assert trains.forward[:6].tolist() == [3, 4, 5, 6, 7, 8]
    np.testing.assert_allclose(trains.forward_energy[:6], 0.992, atol=0.002)
    np.testing.assert_allclose(trains.velocity.sum(axis=1), trains.hitting, rtol=1e-9)


@pytest.mark.slow
def test_a_dispersion_free_chain_in_an_impact():
    mass, stiffness = ji.theory.reinsch_chain(6)
    out = ji.impact(ji.LZB(1.0, stiffness, 1.0), ji.chain(mass), jnp.eye(6)[0])
    np.testing.assert_allclose(out.velocity, np.eye(6)[-1], atol=1e-7)
