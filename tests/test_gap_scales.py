"""Gap scale, the crossover of two orders of collision, force histories of gapped contacts."""

import tomllib
from importlib.resources import files

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jimpact.histories import history
from jimpact.impacts import impact
from jimpact.laws.compliant import Compliant
from jimpact.laws.forces import Hertz, HuntCrossley, KelvinVoigt, LinearSpring, UserForce
from jimpact.laws.kinematic import Newton
from jimpact.laws.lzb import LZB
from jimpact.montecarlo.gap_scales import crossover, gap_scale
from jimpact.plot.rheology import plot_forces
from jimpact.scene import chain, column


def test_formula():
    """One-inch steel balls at 1 and 0.1 m/s: 31 and 5 um; the same for every law with this k."""
    scene, k = chain(jnp.full(3, 0.0665), gaps=jnp.array([0.0, 1e-4])), 1.2e10
    for speed in (1.0, 0.1):
        v = jnp.array([speed, 0.0, 0.0])
        expected = (0.0665 * speed**2 / k) ** 0.4
        for law in (Compliant(Hertz(k)), LZB(0.9, k), Compliant(HuntCrossley(k, 0.1))):
            np.testing.assert_allclose(gap_scale(scene, law, v).delta, expected, rtol=1e-12)
    v = jnp.array([1.0, 0.0, 0.0])
    linear = (0.0665 / 1e6) ** 0.5
    for force in (LinearSpring(1e6), KelvinVoigt(1e6, 1.0), UserForce(lambda x, r, k: k * x, 1e6)):
        np.testing.assert_allclose(gap_scale(scene, Compliant(force), v).delta, linear, rtol=1e-12)
    np.testing.assert_allclose(
        gap_scale(chain([1.0, 3.0]), Compliant(LinearSpring(2.0)), jnp.array([1.0, -1.0])).delta,
        np.sqrt(2 * 0.75 * 4 / 2),
    )


def test_words():
    scene = chain(jnp.ones(5), gaps=jnp.array([0.0, 0.05, 0.7, 5.0]))
    text = str(gap_scale(scene, Compliant(Hertz(1.0)), jnp.array([1.0, 0, 0, 0, 0]))).splitlines()
    assert "gap 1 is closed (delta_c = 1 m)" in text[0]
    assert "touching" in text[1]
    assert "gap 3 is 0.7 delta_c" in text[2]
    assert "overlap" in text[2]
    assert "one after another" in text[3]
    scale = gap_scale(scene, Compliant(Hertz(1.0)), jnp.array([-1.0, 0, 0, 0, 0]))
    assert "nothing approaches" in str(scale)
    assert not np.asarray(scale.delta).any()


def test_traced():
    law = Compliant(Hertz(1.0))
    delta = jax.jit(lambda v: gap_scale(chain(jnp.ones(2)), law, v).delta)(jnp.array([2.0, 0.0]))
    np.testing.assert_allclose(delta, 4**0.4, rtol=1e-14)


def test_bad_input():
    with pytest.raises(TypeError, match="`law`"):
        gap_scale(chain([1.0, 1.0]), Newton(1.0), [1.0, 0.0])
    with pytest.raises(ValueError, match="`velocity`"):
        gap_scale(chain([1.0, 1.0]), LZB(1.0), [1.0])
    with pytest.raises(ValueError, match="two contacts"):
        crossover(chain([1.0, 1.0]), Compliant(Hertz(1.0)), [1.0, 0.0], [0.0])
    with pytest.raises(ValueError, match="`offset`"):
        crossover(chain([1.0, 1.0, 1.0]), Compliant(Hertz(1.0)), [1.0, 0.0, 0.0], 0.0)


def test_symmetric_discontinuity_is_a_smooth_crossover():
    """Balls (m/4, m, m/4) at (1, 0, -1): both orders, both at once, and how wide it is."""
    offset = jnp.linspace(-4, 4, 81)
    scene, v = chain(jnp.array([0.25, 1.0, 0.25])), jnp.array([1.0, 0.0, -1.0])
    found = crossover(scene, Compliant(Hertz(1.0)), v, offset)
    w = np.asarray(found.velocity)
    assert (np.asarray(found.status) == 0).all()
    np.testing.assert_allclose(w[0], (-3 / 5, -4 / 25, 31 / 25), atol=1e-7)
    np.testing.assert_allclose(w[-1], (-31 / 25, 4 / 25, 3 / 5), atol=1e-7)
    np.testing.assert_allclose(w[40], (-1, 0, 1), atol=1e-7)
    np.testing.assert_allclose(w, -w[::-1, ::-1], atol=1e-7)  # mirror
    assert (np.diff(w[:, 0]) < 1e-8).all()  # monotone
    part = (w[:, 0] + 0.6) / -0.64
    ten, ninety = (np.interp(level, part, offset) for level in (0.1, 0.9))
    assert 1.8 < ninety - ten < 2.2
    # stiffer and faster: the same curve in units of delta_c
    other = crossover(scene, Compliant(Hertz(3e9)), 0.1 * v, offset)
    np.testing.assert_allclose(10 * other.velocity, w, atol=1e-6)


def beads():
    text = (files("jimpact") / "data" / "bead_column.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


@pytest.mark.parametrize(
    "number", [1, 2, *(pytest.param(n, marks=pytest.mark.slow) for n in (5, 8))]
)
def test_bead_column_wall_force(number):
    """Elastic Hertz beads after a fall of 3.1 mm: 51.66 N for one, 52.90 N for more."""
    data = beads()
    scene = column(jnp.full(number, data["bead_mass"]))
    k = np.append(np.full(number - 1, data["bead_bead_stiffness"]), data["bead_wall_stiffness"])
    speed = np.sqrt(2 * 9.81 * data["series"][0]["drop_height"])
    law, v = Compliant(Hertz(k)), jnp.full(number, speed)
    h = history(law, scene, v, records=512)
    assert int(h.status) == 0
    assert float(h.maximum_force[-1]) == pytest.approx(51.66 if number == 1 else 52.90, rel=1e-3)
    assert float(h.maximum_force[-1]) == pytest.approx(
        51.6595 if number == 1 else 52.8996, rel=1e-5
    )
    microseconds = {1: 36.006, 2: 65.812, 5: 149.586, 8: 237.141}  # longer with every bead
    assert 1e6 * float(h.duration) == pytest.approx(microseconds[number], rel=1e-5)
    figure = plot_forces({f"{number} beads": h})
    assert figure.axes[0].get_ylabel() == "force [N]"


@pytest.mark.slow
def test_history_across_gaps():
    scene, v = chain(jnp.ones(3), gaps=jnp.array([0.3, 4.0])), jnp.array([1.0, 0.0, 0.0])
    law = Compliant(Hertz(1.0))
    h = history(law, scene, v, samples=400, records=128)
    out = impact(law, scene, v)
    np.testing.assert_allclose(h.velocity[-1], out.velocity, atol=1e-7)
    np.testing.assert_allclose(h.impulse[-1], out.impulse, atol=1e-7)
    np.testing.assert_allclose(np.trapezoid(h.force, h.time, axis=0), h.impulse[-1], rtol=2e-3)
    t = np.asarray(h.time)
    assert not np.asarray(h.force)[t < 0.29].any()  # still flying
    pair = (1.25 * 0.5) ** 0.4  # deepest indentation of one pair
    assert float(h.indentation[:, 0].max()) == pytest.approx(pair, rel=1e-3)
    momentum = np.asarray(h.velocity).sum(axis=1)
    np.testing.assert_allclose(momentum, 1.0, atol=1e-12)


def test_history_refuses_other_forces():
    with pytest.raises(TypeError, match="`law`"):
        history(Compliant(KelvinVoigt(1.0, 0.1)), chain([1.0, 1.0]), [1.0, 0.0])
