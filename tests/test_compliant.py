"""The compliant law: gaps, closed forms, chapter values, derivatives, units, residual indentation."""

import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compliant_reference import elastic_plastic
from reference import chain_matrices
from scipy.optimize import brentq

from jimpact.impacts import impact
from jimpact.laws.compliant import Compliant
from jimpact.laws.forces import Bistiffness, Hertz, LinearSpring, PowerLaw
from jimpact.laws.lzb import LZB
from jimpact.scene import Scene, chain
from jimpact.status import CODE
from jimpact.theory.linear_chain import bilateral_motion, newby_ratio

B = (-1 / 3, 2 / 3, 2 / 3)  # outcome of k2/k1 = infinity
STRIKE = jnp.array([1.0, 0.0, 0.0])


def make(exponent, wall=False, rtol=None):
    """(masses, v, k, e, gaps) -> (v+, status), compiled, and the same over a batch."""

    def run(mass, v, k, e, gaps):
        law = Compliant(Bistiffness(k, exponent, e), rtol=rtol)
        out = impact(law, chain(mass, wall=wall, gaps=gaps), v)
        return out.velocity, out.status

    return jax.jit(jax.vmap(run))


LINEAR, HERTZ = make(1.0), make(1.5)  # three balls, shared below


def three(run, ratio=1.0, gaps=(0.0, 0.0), v=STRIKE, e=1.0, mass=(1.0, 1.0, 1.0)):
    """Batch over any argument: scalar ratio (b,), gaps (b, 2), v (b, 3) ... -> v+ (b, 3)."""
    ratio, e = (np.asarray(z, float)[..., None] * np.ones(2) for z in (ratio, e))
    k = np.stack([np.ones_like(ratio[..., 0]), ratio[..., 0]], -1)
    args = [np.asarray(z, float) for z in (mass, v, k, e, gaps)]
    b = max(z.shape[0] if z.ndim == 2 else 1 for z in args)
    b = max(b, 32)  # one shape, one compilation
    args = [jnp.asarray(np.resize(np.atleast_2d(z), (b, z.shape[-1]))) for z in args]
    return run(*args)


def held_out(n, wall, number, seed, e_least=1.0):
    rng = np.random.default_rng(seed)
    m = n - 1 + int(wall)
    return {
        "mass": 10 ** rng.uniform(-0.7, 0.7, (number, n)),
        "v": np.sort(rng.normal(size=(number, n)))[:, ::-1].copy(),
        "k": 10 ** rng.uniform(-1, 1, (number, m)),
        "e": rng.uniform(e_least, 1.0, (number, m)),
        "gaps": np.where(
            rng.uniform(size=(number, m)) < 0.3, 0, 10 ** rng.uniform(-2, 1, (number, m))
        ),
    }


@pytest.mark.parametrize(
    ("n", "wall", "eta"),
    [
        (3, False, 1.5),
        *(pytest.param(*x, marks=pytest.mark.slow) for x in ((4, False, 1.0), (2, True, 1.5))),
    ],
)
@pytest.mark.parametrize("e_least", [1.0, 0.3])
def test_held_out_gapped_chains(n, wall, eta, e_least):
    """1e-6 at the default tolerance, 1e-9 at rtol = 1e-10, against scipy; elastic and plastic."""
    data = held_out(n, wall, 8, seed=11 * n, e_least=e_least)
    expected = [
        elastic_plastic(*chain_matrices(mass, wall), v, k, eta, e, gaps)[0]
        for mass, v, k, e, gaps in zip(*data.values())
    ]
    scale = np.abs(data["v"]).max(axis=1, keepdims=True)
    for rtol, allowed in ((None, 1e-6), (1e-10, 1e-9)):
        run = _MADE.setdefault((eta, wall, rtol), make(eta, wall, rtol))
        got, status = run(*map(jnp.asarray, data.values()))
        assert (np.abs(got - np.array(expected)) / scale).max() < allowed
        assert (np.asarray(status) == 0).all()


_MADE = {}


@pytest.mark.slow
def test_exact_derivatives():
    """Three touching Hertz balls, e = 1: in the stiffness ratio, the exponent, and gap 2 at 0.1."""

    def velocity(ratio, eta, gap):
        law = Compliant(PowerLaw(jnp.stack([jnp.ones(()), ratio]), eta), rtol=1e-12)
        scene = chain(jnp.ones(3), gaps=jnp.stack([jnp.zeros(()), gap]))
        return impact(law, scene, STRIKE).velocity

    def derivatives(mode):
        along = jax.vmap(mode(velocity, (0, 1, 2)), (None, None, 0))
        return jax.jit(along)(jnp.array(1.0), jnp.array(1.5), jnp.array([0.0, 0.1]))

    forward, reverse = derivatives(jax.jacfwd), derivatives(jax.jacrev)
    ratio, eta, gap = forward
    np.testing.assert_allclose(ratio[0], (-0.08234973, 0.095566227547, -0.01321650), atol=1e-8)
    np.testing.assert_allclose(eta[0], (0.08762267, -0.10168544, 0.01406277), atol=1e-8)
    np.testing.assert_allclose(gap[1], (0.22921446, -0.24948797, 0.02027351), atol=1e-8)
    for a, b in zip(forward, reverse):
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-13)


@pytest.mark.slow
def test_touching_elastic_linear_balls_are_lzb():
    ratio = np.array([0.25, 0.5, 1, 2, 2.7, 5, 10])
    expected = [
        (-0.030185056287222506601, 0.031125464554474380446, 0.99905959173274812616),
        (-0.062251284524742237916, 0.066402132077128207875, 0.99584915244761403004),
        (-0.1302616950645210470456, 0.1502295694347740893071, 0.9800321256297469577386),
        (-0.24540167248232003096, 0.33611284257080388887, 0.90928882991151614209),
        (-0.2892912228260448451, 0.43827863274677279249, 0.85101259007927205261),
        (-0.33167995328602218176, 0.62520341923314286019, 0.70647653405287932157),
        (-0.3309938917272272135, 0.61717162262791414245, 0.71382226909931307106),
    ]
    laws = Compliant(LinearSpring(1.0), rtol=1e-13), LZB(1.0, 1.0, 1.0, rtol=1e-13)
    both = [impact(law, chain(jnp.ones(3)), STRIKE) for law in laws]
    np.testing.assert_allclose(both[0].velocity, both[1].velocity, atol=1e-10)
    np.testing.assert_allclose(both[0].impulse, both[1].impulse, atol=1e-10)
    got, _ = three(LINEAR, ratio)
    np.testing.assert_allclose(got[:7], expected, atol=2e-8)


def test_two_balls_and_a_wall_wait_for_the_gap_where_lzb_does_not():
    scene, v = chain(jnp.ones(2), wall=True), jnp.array([1.0, 0.0])
    lzb = impact(LZB(1.0, 1.0, 1.0), scene, v).velocity
    penalized = impact(Compliant(LinearSpring(1.0)), scene, v).velocity
    np.testing.assert_allclose(lzb, (-0.97547042321005322912, -0.22013053727822418238), atol=1e-8)
    np.testing.assert_allclose(penalized, (-0.976928618648904904, -0.213566088283562787), atol=1e-8)


def test_limits_of_the_stiffness_ratio_newby_and_reinsch():
    """k2/k1 -> 0: binary collisions; -> infinity: B, with an error of the order of k1/k2."""
    ratio = np.array([1e-8, 1e4, 1e6, *(newby_ratio(n) for n in (2, 3, 5))])
    got = np.asarray(three(LINEAR, ratio)[0])
    np.testing.assert_allclose(got[0], (0, 0, 1), atol=1e-7)
    np.testing.assert_allclose(got[1], B, atol=3e-4)
    np.testing.assert_allclose(got[2], B, atol=3e-6)
    np.testing.assert_allclose(
        got[3], (-0.263586813696557148, 0.374697924807668259, 8 / 9), atol=1e-7
    )
    np.testing.assert_allclose(got[4:6], [B, B], atol=1e-7)
    reinsch, _ = three(LINEAR, mass=(1.0, 2 / 3, 1.0))
    np.testing.assert_allclose(reinsch[0], (0, 0, 1), atol=1e-7)


def test_newby_ratios():
    exact = (2.241337913521566978102, 6.171292729553324410933, 11.45961201072390584258)
    for n, value in zip((2, 3, 4), exact):
        assert newby_ratio(n) == pytest.approx(value, rel=1e-14)
    for bad in (1, 2.5, "2"):
        with pytest.raises(ValueError, match="`n`"):
            newby_ratio(bad)


BILATERAL = jax.jit(
    lambda ratio, t: bilateral_motion(
        chain(jnp.ones(3)), jnp.stack([jnp.ones(()), ratio]), STRIKE, t
    )
)


def test_bilateral_chain():
    """(6.15) and the first openings (corrected 6.16); Newby's contacts open together."""
    x, v = BILATERAL(2.7, 2.1)
    expected = (1.05643885373854550, 0.620228862850967355, 0.423332283410487146)
    np.testing.assert_allclose(x, expected, atol=1e-13)
    expected = (-0.142478983904997473, 0.444517042135023372, 0.697961941769974101)
    np.testing.assert_allclose(v, expected, atol=1e-13)
    table = {
        0.3: (2.3104357319154176423, 4.5785561388309801779),
        1: (2.5548129111974902502, 3.3820850513035804078),
        2: (2.75461756179146516, 2.8391414082694387567),
        2.7: (2.7494001239988592829, 2.6351145226216572429),
        5: (2.6536174294728242085, 2.334964664586246076),
    }
    ends = [_opening(newby_ratio(2), j, 2.5, 3.0) for j in (0, 1)]
    assert ends[0] == pytest.approx(ends[1], rel=1e-11)
    for ratio, times in table.items():
        for j, t in enumerate(times):
            assert _opening(ratio, j, t - 0.1, t + 0.1) == pytest.approx(t, rel=1e-12)


def _opening(ratio, j, low, high):
    def squeeze(t):
        x, _ = BILATERAL(ratio, t)
        return float(x[j] - x[j + 1])

    return brentq(squeeze, low, high, xtol=1e-14)


def test_until_the_first_opening_the_law_is_the_closed_form():
    """k2/k1 = 2.7: contact 2 opens first, and ball 3 keeps the velocity it has then."""
    t = 2.6351145226216572429
    _, v = BILATERAL(2.7, t)
    got, _ = three(LINEAR, 2.7)
    assert float(v[2]) == pytest.approx(float(got[0, 2]), abs=1e-8)


def test_many_balls_strike_many():
    """M of ten Hertz balls strike the others: M + 2 go forward with 99 % of the energy, up to M = 6.

    For M = 7 only 8 do.
    """
    v = jnp.asarray([[1.0] * m + [0.0] * (10 - m) for m in range(1, 8)])
    run = jax.jit(
        jax.vmap(lambda v: impact(Compliant(Hertz(1.0)), chain(jnp.ones(10)), v).velocity)
    )
    got = np.asarray(run(v))
    forward = [int((row > 0).sum()) for row in got]
    assert forward == [3, 4, 5, 6, 7, 8, 8]
    for m, row in enumerate(got[:5], start=1):
        tail = row[10 - (m + 2) :]
        assert (tail > 0).all()
        assert 0.989 < tail @ tail / (row @ row) < 0.995
    np.testing.assert_allclose(
        got[0, -3:], (0.00267195494026627602, 0.147390307201133049, 0.985865866417338406), atol=1e-6
    )


def test_gaps_of_any_size_cost_nothing():
    sizes = np.array([10.0**p for p in range(2, 13)])
    gaps = np.stack([sizes, 2 * sizes], -1)
    v = np.array([1.0, 0.0, -0.5])
    got, status = three(HERTZ, gaps=gaps, v=v)
    assert (np.asarray(status) == 0).all()
    np.testing.assert_allclose(got, np.tile((-0.5, 0, 1.0), (32, 1)), atol=1e-7)

    def seconds(gaps):
        three(HERTZ, gaps=gaps, v=v)
        times = []
        for _ in range(5):
            start = time.perf_counter()
            jax.block_until_ready(three(HERTZ, gaps=gaps, v=v))
            times.append(time.perf_counter() - start)
        return min(times)

    assert seconds((1e6, 2e6)) < 2 * seconds((3.0, 6.0)) + 1e-3


def test_zero_gap_is_touching_and_the_limit_of_small_gaps():
    gaps = np.array([[0, 0], [0, 1e-10], [1e-10, 1e-10]])
    got, _ = three(HERTZ, gaps=gaps)
    none = impact(Compliant(Hertz(1.0)), chain(jnp.ones(3)), STRIKE).velocity
    np.testing.assert_allclose(got[:3], np.tile(none, (3, 1)), atol=1e-8)
    expected = (-0.070952353651436871016, 0.076403039071206993021, 0.994549314580229878)
    np.testing.assert_allclose(none, expected, atol=1e-8)


def test_wide_gaps_are_binary_collisions():
    got, _ = three(HERTZ, gaps=(0.0, 50.0), v=(1.0, 0.0, -1.0), mass=(0.25, 1.0, 0.25))
    np.testing.assert_allclose(got[0], (-3 / 5, -4 / 25, 31 / 25), atol=1e-7)


def test_vmap_equals_loop_and_jit_equals_eager():
    gaps = np.array([[0.0, 0.0], [0.1, 0.0], [0.0, 0.4], [2.0, 1.0]])
    many, _ = three(HERTZ, gaps=gaps)
    for row, g in zip(np.asarray(many), gaps):
        law = Compliant(Bistiffness(jnp.ones(2), 1.5, jnp.ones(2)))
        eager = impact(law, chain(jnp.ones(3), gaps=jnp.asarray(g)), STRIKE)
        np.testing.assert_allclose(row, eager.velocity, atol=1e-13)


def test_float32():
    f = jnp.float32
    scene = chain(jnp.ones(3, f), gaps=jnp.array([0.0, 0.1], f))
    out = impact(Compliant(Hertz(f(1.0))), scene, STRIKE.astype(f))
    assert out.velocity.dtype == f
    got, _ = three(HERTZ, gaps=(0.0, 0.1))
    np.testing.assert_allclose(out.velocity, got[0], atol=2e-5)
    far = chain(jnp.ones(3, f), gaps=jnp.array([1e6, 3e6], f))
    out = impact(Compliant(Hertz(f(1.0))), far, jnp.array([1.0, 0.0, -0.5], f))
    assert int(out.status) == 0
    np.testing.assert_allclose(out.velocity, (-0.5, 0.0, 1.0), atol=1e-4)


def test_unit_systems_do_not_matter():
    """Microns and 1e-18 J as well as metres and joules: only gap over indentation counts."""
    length, mass, speed = 1e-6, 2e-18, 1.0
    plain, _ = three(HERTZ, ratio=2.0, gaps=(0.3, 0.1))
    k = mass * speed**2 / length**2.5
    args = (
        mass * jnp.ones((32, 3)),
        speed * jnp.tile(STRIKE, (32, 1)),
        k * jnp.tile(jnp.array([1.0, 2.0]), (32, 1)),
        jnp.ones((32, 2)),
        length * jnp.tile(jnp.array([0.3, 0.1]), (32, 1)),
    )
    got, status = HERTZ(*args)
    np.testing.assert_allclose(got[0] / speed, plain[0], atol=2e-8)
    assert int(status[0]) == 0


@pytest.mark.slow
def test_a_dense_scene_is_the_chain():
    scene = chain(jnp.array([1.0, 2.0, 0.5]), gaps=jnp.array([0.0, 0.2]))
    dense = Scene(scene.mass, scene.normals, gaps=scene.gaps)
    law = Compliant(Hertz(jnp.array([1.0, 3.0])))
    a, b = (impact(law, s, STRIKE) for s in (scene, dense))
    np.testing.assert_allclose(a.velocity, b.velocity, atol=1e-10)


def test_residual_indentation_must_close_again():
    """A plastic contact that opens leaves its surface e^2 behind: it closes there, not at zero.

    A ball between another one and a wall, the gap wide: each collision is a pair's, with e.
    """
    e = 0.6
    scene = chain(jnp.ones(2), wall=True, gaps=jnp.array([0.0, 30.0]))
    law = Compliant(Bistiffness(1.0, 1.5, e))
    out = impact(law, scene, jnp.array([1.0, 0.0]))
    v1, v2 = (1 - e) / 2, (1 + e) / 2
    v2 = -e * v2  # the wall
    u, w = v1, v2  # ball 2 returns to ball 1, whose surface is dented
    v1, v2 = u - (1 + e) / 2 * (u - w), w + (1 + e) / 2 * (u - w)
    v2 = -e * v2  # the wall again, and then too slow for ball 1
    np.testing.assert_allclose(out.velocity, (v1, v2), atol=1e-7)
    assert int(out.status) == 0


def test_where_no_contact_opens_twice_it_is_lzb():
    e, scene, v = jnp.array([0.9, 0.8]), chain(jnp.ones(2), wall=True), jnp.array([1.0, 1.0])
    a = impact(Compliant(Bistiffness(jnp.array([1.0, np.sqrt(2)]), 1.5, e)), scene, v).velocity
    np.testing.assert_allclose(a, (-0.98216523452194494662, -0.57257380387873722818), atol=1e-7)


def test_energy_is_what_the_restitution_leaves():
    """Equal e at every contact, work of compression W: the loss is (1 - e^2) W >= 0; e = 1: none."""
    data = held_out(3, False, 32, seed=5, e_least=0.2)
    got, status = HERTZ(*map(jnp.asarray, data.values()))
    before = (data["mass"] * data["v"] ** 2).sum(1)
    after = (data["mass"] * np.asarray(got) ** 2).sum(1)
    assert (after < before).all()
    assert np.isin(status, [0, CODE["plastic_limit"]]).all()
    momentum = (data["mass"] * (np.asarray(got) - data["v"])).sum(1)
    np.testing.assert_allclose(momentum, 0, atol=1e-12)
    data["e"][:] = 1.0
    got, _ = HERTZ(*map(jnp.asarray, data.values()))
    np.testing.assert_allclose((data["mass"] * np.asarray(got) ** 2).sum(1), before, rtol=1e-7)


def test_status():
    law = Compliant(Bistiffness(1.0, 1.5, 0.03))
    out = impact(law, chain(jnp.ones(3)), STRIKE)
    assert int(out.status) == CODE["plastic_limit"]
    np.testing.assert_allclose(out.velocity, 1 / 3, atol=1e-3)
    out = impact(Compliant(Hertz(1.0), max_steps=5), chain(jnp.ones(3)), STRIKE)
    assert int(out.status) == CODE["max_steps"]


def test_nothing_approaches():
    out = impact(Compliant(Hertz(1.0)), chain(jnp.ones(3), gaps=[0.0, 1.0]), -STRIKE)
    np.testing.assert_array_equal(out.velocity, -STRIKE)
    assert int(out.status) == 0


@pytest.mark.slow
def test_one_sided_derivative_at_a_touching_contact():
    """The derivative in a gap at 0 is the limit from above, not 0."""

    def v3(gap):
        scene = chain(jnp.ones(3), gaps=jnp.stack([jnp.zeros(()), gap]))
        return impact(Compliant(Hertz(1.0), rtol=1e-12), scene, STRIKE).velocity

    slope = jax.jit(jax.jacfwd(v3))
    at, near = slope(jnp.array(0.0)), slope(jnp.array(1e-6))
    value = jax.jit(v3)
    h = 1e-5
    difference = (4 * value(h) - value(2 * h) - 3 * value(0.0)) / (2 * h)
    np.testing.assert_allclose(near, difference, rtol=1e-3, atol=1e-4)
    assert np.abs(at).max() > 0.1, at
    np.testing.assert_allclose(at, near, rtol=1e-2, atol=1e-3)


@pytest.mark.parametrize(
    ("make_law", "name"),
    [
        (lambda: Compliant(1.0), "force"),
        (lambda: Compliant(Hertz(1.0), rtol=0.0), "rtol"),
        (lambda: impact(Compliant(Hertz(1.0), rtol=1e-20), chain([1.0, 1.0]), [1.0, 0.0]), "rtol"),
        (lambda: impact(Compliant(Hertz([1.0, 1.0])), chain([1.0, 1.0]), [1.0, 0.0]), "stiffness"),
        (lambda: chain([1.0, 1.0], gaps=[-1.0]), "gaps"),
    ],
)
def test_bad_input(make_law, name):
    with pytest.raises((ValueError, TypeError), match=f"`{name}`"):
        make_law()
