"""The stability suite: 300 points against an oracle, theoretical limits from both sides, the map.

Elsewhere: Zeno of binary collisions (test_binary), the two slopes at Newby's ratio and at e = 0
(test_gradients), degenerate LCPs (test_lcp), the order of the impulse Euler (test_lzb_values),
redundant and contradictory contacts (test_algebraic_laws).
"""

import functools
import json
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jimpact as ji
from jimpact.methods.contenders import METHODS
from jimpact.methods.stability.causes import frequencies
from jimpact.methods.stability.mapping import stability_map
from jimpact.methods.stability.points import chain_of, setting_of
from jimpact.methods.stability.runs import CLASSES
from jimpact.status import STATUS

sys.path.insert(0, str(Path(__file__).parent / "benchmarks"))
import stability_reference

HELD = np.load(Path(__file__).parent / "data" / "stability_points.npz")
RTOL, HONEST = 1e-8, 10  # the default tolerance; right is within ten times of it
STEPS, MANY_STEPS = 4000, 20_000  # in the default tests, in the slow ones
# right only because the tolerance falls with the number of steps and with slow contacts
HARD = {
    151: "mass ratio 2e-4, e = 1, six balls",
    168: "stiffness ratio 1.7e-8, three balls",
}
HARD_LATER = {  # these take more than STEPS
    4: "stiffness ratio 7e-6, e = 1, twenty balls: slow ones are not at rest",
    22: "stiffness ratio 1.4e6, three balls",
    209: "stiffness ratio 1.4e-4, mass ratio 5e-3, e = 9e-3",
}
LANES = 32


@functools.cache
def batch(n, steps):
    """`run(mass (L, n), k (L, n-1), e, eta (L,), v (L, n))` -> Impact of `ji.impact`, consistent."""

    @jax.jit
    @jax.vmap
    def lanes(mass, k, e, eta, v):
        scene = ji.chain(mass)
        out = ji.impact(ji.LZB(e, k, eta, max_steps=steps), scene, v)
        return out, ji.audit(scene, v, out).consistent

    def run(*columns):
        count, parts = len(columns[0]), []
        for begin in range(0, count, LANES):
            at = np.arange(begin, begin + LANES).clip(max=count - 1)
            part = lanes(*(jnp.asarray(np.asarray(c, float)[at]) for c in columns))
            parts.append(jax.tree.map(lambda x, b=begin: np.asarray(x)[: count - b], part))
        return jax.tree.map(lambda *x: np.concatenate(x), *parts)

    return run


def impacts(n, mass, k, e, eta=1.5, v=None):
    """A few impacts by the batch that is compiled anyway."""
    count = max(np.size(e), np.size(eta), 1 if v is None else np.size(np.asarray(v)[..., 0]))
    v = np.eye(n)[0] if v is None else v
    shapes = ((mass, (n,)), (k, (n - 1,)), (e, ()), (eta, ()), (v, (n,)))
    return batch(n, STEPS)(*(np.broadcast_to(np.asarray(x, float), (count, *s)) for x, s in shapes))


@functools.cache
def hypercube(n, steps):
    """Indices of the points with n balls; outcome, consistency, and error by the oracle there."""
    at = np.flatnonzero(HELD["points"][:, 4] == n)
    kappa, mu, e, eta, _ = HELD["points"][at].T
    chains = [stability_reference.chain_of(a, b, n) for a, b in zip(kappa, mu)]
    mass, k = (np.array(rows) for rows in zip(*chains))
    out, consistent = batch(n, steps)(mass, k, e, eta, np.tile(np.eye(n)[0], (len(at), 1)))
    return at, out, consistent, np.abs(out.velocity - HELD["velocity"][at, :n]).max(axis=1)


def check_hypercube(n, steps):
    """Right or flagged everywhere; what the oracle could not solve is consistent."""
    at, out, consistent, error = hypercube(n, steps)
    failed = np.array([row.failure for row in STATUS])[out.status]
    known = np.isfinite(HELD["uncertainty"][at])
    assert HELD["uncertainty"][at][known].max(initial=0) < 0.1 * HONEST * RTOL
    wrong = known & ~failed & ~(error <= HONEST * RTOL)
    assert not wrong.any(), list(zip(at[wrong], error[wrong]))
    assert consistent[~failed].all()
    lossless = ~failed & (HELD["points"][at, 2] == 1)
    assert np.abs(out.energy_change[lossless]).max(initial=0) < HONEST * RTOL
    return np.mean(~failed)


@pytest.mark.parametrize(("n", "share"), [(3, 0.6), (6, 0.3), (20, 0.1)])
def test_right_or_flagged(n, share):
    assert check_hypercube(n, STEPS) > share  # and not all flagged


@pytest.mark.slow
@pytest.mark.parametrize(("n", "share"), [(2, 0.99), (3, 0.7), (6, 0.6), (20, 0.15), (100, 0.0)])
def test_right_or_flagged_with_more_steps(n, share):
    assert check_hypercube(n, MANY_STEPS) >= share


def check_right(point, steps):
    at, out, _, error = hypercube(int(HELD["points"][point, 4]), steps)
    i = int(np.flatnonzero(at == point)[0])
    assert not STATUS[out.status[i]].failure
    assert error[i] <= HONEST * RTOL


@pytest.mark.parametrize("point", HARD, ids=HARD.get)
def test_hard_points(point):
    check_right(point, STEPS)


@pytest.mark.slow
@pytest.mark.parametrize("point", HARD_LATER, ids=HARD_LATER.get)
def test_hard_points_after_many_steps(point):
    check_right(point, MANY_STEPS)


@pytest.mark.slow
def test_propagator_sees_events_that_no_end_of_a_step_shows():
    """Light or stiff balls: contacts turn back twice within one period of the fastest."""
    rng = np.random.default_rng(1)
    mass, k = 10 ** rng.uniform(-3, 1, (96, 3)), 10 ** rng.uniform(-3, 3, (96, 2))
    e = rng.uniform(0.3, 1, 96)
    mass[0], k[0], e[0] = [1.0, 1e-3, 1.0], 1.0, 0.9

    @jax.jit
    @jax.vmap
    def propagated(mass, k, e):
        law = ji.LZB(e, k, 1.0, method="propagator", max_steps=STEPS)
        out = ji.impact(law, ji.chain(mass), np.eye(3)[0])
        return out.velocity, out.status

    v, code = propagated(mass, k, e)
    known = [0.07522166001736, 0.74823140950437, 0.92403010857313]
    np.testing.assert_allclose(v[0], known, rtol=0, atol=HONEST * RTOL)
    other, _ = impacts(3, mass, k, e, eta=1.0)
    failed = np.array([row.failure for row in STATUS])
    ended = ~failed[code] & ~failed[other.status]
    assert ended.mean() > 0.75
    np.testing.assert_allclose(v[ended], other.velocity[ended], rtol=0, atol=HONEST * RTOL)


def test_points_are_those_of_the_script():
    assert len(HELD["points"]) == 300
    np.testing.assert_allclose(HELD["points"], stability_reference.points(), rtol=1e-12)
    for kappa, mu, n in ((3.0, 0.5, 2), (3.0, 0.5, 5), (7.0, 2.0, 6)):
        for mine, its in zip(chain_of(kappa, mu, n), stability_reference.chain_of(kappa, mu, n)):
            np.testing.assert_array_equal(mine, its)


# --- theoretical limits, from both sides ---


@pytest.mark.parametrize(("name", "limit"), [("verlet", 2.0), ("rk4", np.sqrt(8.0))])
def test_explicit_step_limit(name, limit):
    """A ball between two walls that it presses: x'' = -x with lambda = 2, until a contact opens."""
    scene = ji.chain([1.0], wall="both")
    law = ji.LZB(1.0, 1.0, 1.0, initial_energy=0.5, max_steps=200)  # forces 1, at rest
    speed = 1e-3

    @jax.jit
    def after(step):
        p = METHODS[name].solve(law, scene, [speed], step).impulse
        return jnp.abs(speed + p[0] - p[1])

    # inside it stays of the size of the speed before; outside it grows until a contact opens
    assert after(0.99 * limit / np.sqrt(2)) < 2 * speed
    assert after(1.01 * limit / np.sqrt(2)) > 50 * speed


def test_runge_kutta_limit_is_where_its_polynomial_leaves_the_unit_circle():
    for z, inside in ((0.999, True), (1.001, False)):
        power = 1j * z * np.sqrt(8)
        factor = sum(power**i / np.prod(range(1, i + 1)) for i in range(5))
        assert (abs(factor) < 1) == inside


def test_impulse_form_is_not_unique_at_zero_energy():
    """E_2 = 0 for ever solves the distributing rule; any seed however small finds the other branch."""
    eta, p1, steps = 1.5, 1e-3, 4000

    def walk(seed):
        energy, p2, dp = seed, 0.0, p1 / steps
        for i in range(steps):
            before = (i + 0.5) * dp  # E_1 = p V, and ball 2 moves with p
            slope = (energy / before) ** (eta / (eta + 1))
            energy, p2 = energy + before * slope * dp, p2 + slope * dp
        return p2

    branch = p1 ** (eta + 1) / ((eta + 1) * (eta + 2) ** eta)
    assert walk(0.0) == 0.0
    for seed in (1e-40, 1e-25):
        assert walk(seed) == pytest.approx(branch, rel=0.05)
    # the package takes the physical branch: contact 2, at rest before, is loaded
    assert impacts(3, np.ones(3), 1.0, 1.0)[0].impulse[0, 1] > 0.9


def test_impulse_euler_stalls_at_first_order():
    """Ten times the work, a tenth of the error; so no tolerance of the default's is ever reached."""
    scene, v = ji.chain(np.ones(3)), [1.0, 0.0, 0.0]
    law = ji.LZB(0.9, max_steps=20_000)

    @jax.jit
    @jax.vmap
    def solved(step):
        found = METHODS["impulse_euler"].solve(law, scene, v, step)
        return found.impulse, found.evaluations, found.code

    p, work, code = (np.asarray(x) for x in solved(jnp.array([1e-2, 1e-3, 1e-4])))
    exact = impacts(3, np.ones(3), 1.0, 0.9)[0].impulse[0]
    error = np.abs(p - exact).max(axis=1)
    assert code[:2].tolist() == [0, 0]
    assert 3 < error[0] / error[1] < 30
    assert 3 < work[1] / work[0] < 30
    assert error[1] * work[1] / RTOL > 1e7  # steps to the default's tolerance
    assert STATUS[int(solved(jnp.full(3, 1e-5))[2][0])].name == "max_steps"


def test_endless_reclosing_of_three_balls():
    """Below e = (2 - sqrt 3)^2 = 0.0718, where z = 1, three balls end plastic; above they part."""
    e = np.array([0.0, 0.03, 0.06, 0.07, 0.09, 0.1, 0.2])
    out, consistent = impacts(3, np.ones(3), 1.0, e)
    names = [STATUS[code].name for code in out.status]
    assert names == ["plastic_limit"] * 4 + ["ok"] * 3
    np.testing.assert_allclose(out.velocity[:4], 1 / 3, atol=HONEST * RTOL)
    assert (np.diff(out.velocity[4:], axis=1) > 0).all()
    assert consistent.all()


# 10 and 30 equal Hertz balls by the oracle of tests/benchmarks/lzb_oracle.cpp
TEN = {
    1.0: "-0.07108501709 -0.03027378936 -0.01583339716 -0.00888569518 -0.00512658316 "
    "-0.00298597820 -0.00173766842 0.00267195495 0.14739030720 0.98586586642",
    0.9: "-0.00867062941 0.02377686943 0.03273912320 0.03351852905 0.03428229479 "
    "0.03516695506 0.03530119785 0.03580539400 0.10718026205 0.67090000398",
}
THIRTY = {  # the first three and the last three
    1.0: "-0.07108501709 -0.03027378936 -0.01583339716 0.00401251210 0.14860045199 0.98567885884",
    0.9: "-0.00867062941 0.01579664307 0.01617678971 0.03547754352 0.04667986304 0.29175885712",
}


@pytest.mark.slow
def test_ten_balls():
    """Right where Siconos ends with 981 times the energy; long chains re-close below e = 0.5."""

    @jax.jit
    @jax.vmap
    def after(e):
        return ji.impact(ji.LZB(e), ji.chain(np.ones(10)), np.eye(10)[0])

    out = after(jnp.array([1.0, 0.9, 0.5, 0.4]))
    for i, e in enumerate(TEN):
        np.testing.assert_allclose(
            out.velocity[i], np.array(TEN[e].split(), float), rtol=0, atol=HONEST * RTOL
        )
    assert [STATUS[int(code)].name for code in out.status] == ["ok"] * 3 + ["plastic_limit"]
    assert abs(float(out.energy_change[0])) < HONEST * RTOL
    assert (np.asarray(out.energy_change[1:]) < 0).all()


@pytest.mark.slow
def test_thirty_balls():
    @jax.jit
    @jax.vmap
    def after(e):
        return ji.impact(ji.LZB(e), ji.chain(np.ones(30)), np.eye(30)[0])

    out = after(jnp.array(list(THIRTY)))
    assert out.status.tolist() == [0, 0]
    for v, expected in zip(np.asarray(out.velocity), THIRTY.values()):
        ends = v[[0, 1, 2, -3, -2, -1]]
        np.testing.assert_allclose(ends, np.array(expected.split(), float), rtol=0, atol=1e-7)


def test_units_and_a_light_ball():
    """5e-18 J is like 0.5 J; a middle ball of mass 1e-3."""
    for e in (1.0, 0.9):
        small, _ = impacts(3, np.full(3, 1e-8), 7e9, e, v=[3e-5, 0, 0])
        usual, _ = impacts(3, np.ones(3), 1.0, e)
        np.testing.assert_allclose(small.velocity / 3e-5, usual.velocity, rtol=0, atol=1e-12)
        assert small.status[0] == usual.status[0] == 0
    light, _ = impacts(3, [1.0, 1e-3, 1.0], 1.0, np.array([1.0, 0.9]))
    expected = [
        [-0.000497700274514, 0.935501351755378, 0.999562198922759],
        [0.116178842358577, 0.800891058245824, 0.883020266583177],
    ]
    np.testing.assert_allclose(light.velocity, expected, rtol=0, atol=HONEST * RTOL)
    assert light.status.tolist() == [0, 0]


@pytest.mark.parametrize("law", [ji.Newton, ji.Moreau])
def test_newton_is_inadmissible_beyond_a_right_kinetic_angle(law):
    """theta = pi - arccos(g); contact 1 at rest, contact 2 struck: Newton's p_1 = -g p_2."""
    for g, admissible in ((-0.01, True), (0.01, False)):
        scene = ji.Scene(np.linalg.inv([[1.0, g], [g, 1.0]]), np.eye(2))
        assert (float(ji.kinetic_angles(scene)[0, 1]) < np.pi / 2) == admissible
        out = ji.impact(law(0.5), scene, [0.0, -1.0])
        flag = "ok" if admissible or law is ji.Moreau else "negative_impulse"
        assert STATUS[int(out.status)].name == flag


def test_moreau_gains_energy_only_with_unequal_restitution():
    masses, v = [4.8, 0.6, 4.25], [0.7, 2.4, -2.1]
    scene = ji.chain(masses)

    @jax.jit
    @jax.vmap
    def outcome(e1, e2):
        out = ji.impact(ji.Moreau(jnp.stack([e1, e2])), scene, v)
        return out.energy_change, out.status

    e = jnp.linspace(0, 1, 101)
    change, _ = outcome(e, e)
    assert float(change.max()) < 1e-12
    change, status = outcome(jnp.full(101, 0.05), e)
    gains = np.asarray(change) > 1e-6
    edge = int(np.argmax(gains))  # loses below, gains above, and says so
    assert 5 < edge < 95
    assert (gains == (np.arange(101) >= edge)).all()
    assert all(STATUS[code].failure for code in np.asarray(status)[gains])


def test_poisson_draws_on_strain_energy_that_was_never_stored():
    """Contact 2 of three balls rests: compression stores nothing there, expansion does work as
    soon as its coefficient is above that of contact 1.
    """
    scene, v = ji.chain(np.ones(3)), np.array([1.0, 0.0, 0.0])

    def stored(e2):
        compression = np.asarray(ji.impact(ji.Poisson([0.0, 0.0]), scene, v).impulse)
        out = ji.impact(ji.Poisson([0.5, e2]), scene, v)
        before = np.asarray(ji.gap_velocity(scene, v))
        after = np.asarray(ji.gap_velocity(scene, out.velocity))
        assert int(out.status) == 0
        # along straight paths of p: first to the end of compression, where gamma is 0
        return -0.5 * before * compression - 0.5 * after * (np.asarray(out.impulse) - compression)

    assert stored(0.49)[1] == pytest.approx(0.0, abs=1e-14)
    assert stored(0.51)[1] == pytest.approx(-0.51 * 0.02 / 18)
    assert stored(0.51)[0] > 0


def test_kelvin_voigt_pulls_before_it_opens():
    """k x + c x' < 0 for x' < -k x / c; an undamped contact never pulls."""
    x = 0.1
    for c in (0.0, 0.5):
        rate = -2.0 * x / c if c else -10.0  # edge
        force = ji.KelvinVoigt(2.0, c).force
        inside, outside = (float(force(jnp.array(x), jnp.array(f * rate))) for f in (0.9, 1.1))
        assert inside > 0
        assert (outside < 0) == (c > 0)


def test_float32_floor():
    """16 roundings: 1.91e-6. Above a tolerance is taken, below it is an error. (The default there,
    1e-5, is right to 1e-4: test_lzb_values.)
    """
    scene = ji.chain(jnp.ones(3, jnp.float32))
    floor = 16 * float(np.finfo(np.float32).eps)
    ji.LZB(0.9, rtol=1.001 * floor).check(scene, jnp.dtype("float32"))
    with pytest.raises(ValueError, match="rtol"):
        ji.LZB(0.9, rtol=0.999 * floor).check(scene, jnp.dtype("float32"))


# --- the map itself ---


@functools.cache
def small_map():
    axes = {"setting": [0.0, 0.6], "exponent": [1.5, 3.0], "restitution": [0.0, 0.9]}
    return stability_map(("rk4", "verlet"), axes, slices="pairs", samples=3, max_steps=2000)


@pytest.mark.slow
def test_map():
    found = small_map()
    assert found.methods == ("rk4", "verlet")
    for name in found.methods:
        kinds = [each.axes for each in found.slices[name]]
        assert kinds[:3] == [("setting",), ("exponent",), ("restitution",)]
        assert len(kinds) == 6
        setting, exponent, restitution = found.slices[name][:3]
        assert CLASSES[setting.codes[0]] in ("wrong", "gains energy", "not finite")
        assert CLASSES[setting.codes[1]] == "right"
        assert setting.error[1] < 1e-3
        assert (exponent.codes == 0).all()
        assert CLASSES[restitution.codes[0]] == "flagged"  # divides by e^2
        pair = found.slices[name][3]  # setting, exponent
        assert pair.axes == ("setting", "exponent")
        np.testing.assert_array_equal(pair.codes[1], [0, 0])
        assert found.sampled[name].codes.shape == (3,)
        total = sum(found.counts(name).values())
        assert total == 6 + 3 * 4 + 3
        assert sum(found.causes(name).values()) == total - found.counts(name)["right"]
    assert found.confirmation.tried == found.confirmation.confirmed > 0
    assert found.confirmation.difference < 1e-7
    text = str(found)
    assert "step beyond the linear stability limit" in text
    assert json.loads(json.dumps(found.to_dict()))["methods"]["rk4"]["counts"]["right"] > 3


@pytest.mark.slow
def test_pictures(tmp_path):
    from jimpact.commands.stability import draw

    written = draw(small_map(), tmp_path / "a.png")
    assert [path.name for path in written] == ["a.png", "a-rk4.png", "a-verlet.png"]
    assert all(path.stat().st_size > 10_000 for path in written)


def test_settings_and_frequencies():
    assert float(setting_of("rtol", 0.0)) == 1e-2
    assert float(setting_of("step", 1.0)) == pytest.approx(3e-3)
    # two equal linear balls: x'' = -x; e = 0.1 is ten times as fast in expansion
    assert frequencies(np.array([0.6, 1, 1, 0.1, 1, 2]))[0] == pytest.approx(10)
    # three: G = [[1, -1/2], [-1/2, 1]] has 3/2; kappa = 100: the other is ten times slower
    assert frequencies(np.array([0.6, 1, 1, 1, 1, 3]))[0] == pytest.approx(np.sqrt(1.5))
    assert frequencies(np.array([0.6, 100, 1, 1, 1, 3]))[1] == pytest.approx(10)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: stability_map(["rk5"]), "`methods` must name some of"),
        (lambda: stability_map(["scipy_lsoda"]), "`methods` must name some of"),
        (lambda: stability_map(axes={"mass": [1]}), "`axes` must name some of"),
        (lambda: stability_map(axes={"balls": [2.5]}), "whole numbers"),
        (lambda: stability_map(axes={"restitution": [1.1]}), r"lie in \[0, 1\]"),
        (lambda: stability_map(base={"exponent": 0.5}), r"lie in \[1, 5\]"),
        (lambda: stability_map(base={"speed": 1}), "`base` must name some of"),
        (lambda: stability_map(slices="all"), "`slices` must be one of"),
        (lambda: stability_map(samples=-1), "`samples`"),
        (lambda: stability_map(resolution=1), "`resolution`"),
        (lambda: stability_map(max_steps=0), "`max_steps`"),
    ],
)
def test_bad_input(call, message):
    with pytest.raises(ValueError, match=message):
        call()
