"""Scales of compliant contacts: gaps, materials, chains that stay together, impulse ratios."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import jimpact as ji

STRIKE = jnp.array([1.0, 0.0, 0.0])


def test_bilateral_chain_and_newby():
    """(6.15) and the first openings (corrected 6.16); Newby's contacts open together."""
    motion = jax.jit(
        lambda ratio, t: ji.theory.bilateral_motion(
            ji.chain(jnp.ones(3)), jnp.stack([jnp.ones(()), ratio]), STRIKE, t
        )
    )
    x, v = motion(2.7, 2.1)
    held = (1.05643885373854550, 0.620228862850967355, 0.423332283410487146)
    np.testing.assert_allclose(x, held, atol=1e-13)
    held = (-0.142478983904997473, 0.444517042135023372, 0.697961941769974101)
    np.testing.assert_allclose(v, held, atol=1e-13)
    table = {
        0.3: (2.3104357319154176423, 4.5785561388309801779),
        1: (2.5548129111974902502, 3.3820850513035804078),
        2: (2.75461756179146516, 2.8391414082694387567),
        2.7: (2.7494001239988592829, 2.6351145226216572429),
        5: (2.6536174294728242085, 2.334964664586246076),
    }

    def opening(ratio, j, low, high):
        squeeze = lambda t: float(motion(ratio, t)[0][j] - motion(ratio, t)[0][j + 1])  # noqa: E731
        return brentq(squeeze, low, high, xtol=1e-14)

    for ratio, times in table.items():
        for j, t in enumerate(times):
            assert opening(float(ratio), j, t - 0.1, t + 0.1) == pytest.approx(
                t, rel=1e-12
            )
    exact = (2.241337913521566978102, 6.171292729553324410933, 11.45961201072390584258)
    for n, value in zip((2, 3, 4), exact):
        assert ji.theory.newby_ratio(n) == pytest.approx(value, rel=1e-14)
    both = [opening(ji.theory.newby_ratio(2), j, 2.5, 3.0) for j in (0, 1)]
    assert both[0] == pytest.approx(both[1], rel=1e-11)


def test_distributing_rule():
    rule = ji.theory.distributing_rule([0.2, 0.3], [1.0, 2.0], [1.0, 1.5])
    np.testing.assert_allclose(rule[1, 0], 1.7555724651363151, rtol=1e-14)
    np.testing.assert_allclose(rule * rule.T, 1.0, rtol=1e-14)
    rule = ji.theory.distributing_rule([1.0, 0.3], [1.0, 2.0], 1.5)
    np.testing.assert_allclose(rule[1, 0], 0.640744299507361192, rtol=1e-14)


def test_precompression_energy():
    """`k x^(eta + 1) / (eta + 1)` at the x of the force; the chapter's number."""
    energy = ji.theory.precompression_energy(0.328633534503099668, 2.0, 1.5)
    np.testing.assert_allclose(energy, 0.0394360241403719602, rtol=1e-14)
    x, k, eta = np.array([0.1, 2.0]), np.array([3.0, 0.7]), np.array([1.0, 3.0])
    energy = ji.theory.precompression_energy(k * x**eta, k, eta)
    np.testing.assert_allclose(energy, k * x ** (eta + 1) / (eta + 1), rtol=1e-14)


def test_restitution_of_two_materials_in_series():
    """Energy: by the work of two springs in series that unload with e^2 of their own energy."""
    e1, e2, k1, k2, force = 0.9, 0.4, 3.0, 7.0, 2.0
    stored = np.array([force**2 / k1, force**2 / k2]) / 2
    expected = np.sqrt(stored @ [e1**2, e2**2] / stored.sum())
    rule = ji.theory.pair_restitution
    assert float(rule(e1, e2, "energy", k1, k2)) == pytest.approx(expected)
    assert float(rule(e2, e1, "energy", k2, k1)) == pytest.approx(expected)
    assert float(rule(e1, e2, "energy", k1, np.inf)) == pytest.approx(e1)
    assert float(rule(e1, e2, "energy", np.inf, k2)) == pytest.approx(e2)
    assert float(rule(0.7, 0.7, "energy", k1, k2)) == pytest.approx(0.7)
    assert float(jax.grad(rule)(0.0, 0.3, "energy", k1, np.inf)) == pytest.approx(1.0)
    rigid_first = jax.grad(lambda k2: rule(e1, e2, "energy", np.inf, k2))
    assert float(rigid_first(k2)) == pytest.approx(0.0)
    others = {
        "product": 0.36,
        "mean": 0.65,
        "geometric_mean": 0.6,
        "minimum": 0.4,
        "maximum": 0.9,
    }
    for name, value in others.items():
        assert float(rule(e1, e2, name)) == pytest.approx(value)
    np.testing.assert_allclose(rule([0.9, 0.1], [0.4, 0.4], "minimum"), [0.4, 0.1])


def test_hertz_stiffness_of_the_steel_beads():
    """8 mm beads, E = 216 GPa, nu = 0.276: the constants of the bead column within 0.02 %."""
    radius = 4e-3
    assert float(ji.theory.hertz_stiffness(21.6e10, 0.276, radius)) == pytest.approx(
        6.97089e9, rel=1e-6
    )
    plane = ji.theory.hertz_stiffness(21.6e10, 0.276, radius, radius2=np.inf)
    assert float(plane) == pytest.approx(9.85833e9, rel=1e-6)
    rigid = ji.theory.hertz_stiffness(21.6e10, 0.276, radius, np.inf, 0.276, np.inf)
    assert float(rigid) == pytest.approx(2 * float(plane), rel=1e-12)
    assert float(4 / 3 * np.pi * 7650.0 * radius**3) == pytest.approx(2.05e-3, rel=1e-3)


def test_gap_scale():
    """One-inch steel balls at 1 and 0.1 m/s: 31 and 5 um; the same for every law with this k."""
    scene, k = ji.chain(jnp.full(3, 0.0665), gaps=jnp.array([0.0, 1e-4])), 1.2e10
    for speed in (1.0, 0.1):
        expected = (0.0665 * speed**2 / k) ** 0.4
        for law in (
            ji.Compliant(ji.Hertz(k)),
            ji.LZB(0.9, k),
            ji.Compliant(ji.HuntCrossley(k, 0.1)),
        ):
            found = ji.theory.gap_scale(scene, law, [speed, 0.0, 0.0]).delta
            np.testing.assert_allclose(found, expected, rtol=1e-12)
    linear = (0.0665 / 1e6) ** 0.5
    for force in (ji.LinearSpring(1e6), ji.UserForce(lambda x, r, k: k * x, 1e6)):
        found = ji.theory.gap_scale(scene, ji.Compliant(force), [1.0, 0.0, 0.0]).delta
        np.testing.assert_allclose(found, linear, rtol=1e-12)
    many = ji.chain(jnp.ones(5), gaps=jnp.array([0.0, 0.05, 0.7, 5.0]))
    hertz = ji.Compliant(ji.Hertz(1.0))
    text = str(ji.theory.gap_scale(many, hertz, [1.0, 0, 0, 0, 0])).splitlines()
    assert "gap 1 is closed (delta_c = 1 m)" in text[0]
    assert "touching" in text[1]
    assert "gap 3 is 0.7 delta_c" in text[2]
    assert "one after another" in text[3]
    assert "nothing approaches" in str(
        ji.theory.gap_scale(many, hertz, [-1.0, 0, 0, 0, 0])
    )


@pytest.mark.slow
def test_symmetric_discontinuity_is_a_smooth_crossover():
    """Balls (m/4, m, m/4) at (1, 0, -1): both orders, both at once, and how wide it is."""
    offset = jnp.linspace(-4, 4, 41)
    scene, v = ji.chain(jnp.array([0.25, 1.0, 0.25])), jnp.array([1.0, 0.0, -1.0])
    found = ji.theory.crossover(scene, ji.Compliant(ji.Hertz(1.0)), v, offset)
    w = np.asarray(found.velocity)
    assert (np.asarray(found.status) == 0).all()
    np.testing.assert_allclose(w[0], (-3 / 5, -4 / 25, 31 / 25), atol=1e-7)
    np.testing.assert_allclose(w[20], (-1, 0, 1), atol=1e-7)
    np.testing.assert_allclose(w, -w[::-1, ::-1], atol=1e-7)  # mirror
    assert (np.diff(w[:, 0]) < 1e-8).all()  # monotone
    part = (w[:, 0] + 0.6) / -0.64
    ten, ninety = (np.interp(level, part, offset) for level in (0.1, 0.9))
    assert 1.8 < ninety - ten < 2.2


@pytest.mark.slow
def test_offsets_of_gaps_are_in_units_of_the_larger_indentation():
    """The lighter pair indents less: `delta_c^2.5 = m v^2 / k`, m = 2 m1 m2 / (m1 + m2)."""
    masses, v, offset = (
        [0.25, 1.0, 4.0],
        jnp.array([1.0, 0.0, -1.0]),
        jnp.linspace(-4, 4, 41),
    )
    scene, law = ji.chain(jnp.array(masses)), ji.Compliant(ji.Hertz(1.0))
    outcome = ji.theory.crossover(scene, law, v, offset)
    larger = (2 * 1.0 * 4.0 / 5.0) ** 0.4
    gaps = larger * (2.0 + 0.5 * offset[:, None] * jnp.array([[1.0, -1.0]]))
    direct = jax.vmap(lambda g: ji.impact(law, ji.chain(jnp.array(masses), gaps=g), v))(
        gaps
    )
    np.testing.assert_allclose(outcome.velocity, direct.velocity, rtol=0, atol=1e-9)
