"""Methods of integration: their order, speed against accuracy, hard points, the advice."""

import math

import jax
import numpy as np
import pytest
from friction_reference import routh
from methods_cases import BALLS, DISC, HERTZ, SLIDES, SLIP, STRIKE, rod
from refusals import argument

import jimpact as ji
from jimpact.methods.advice import situation_of
from jimpact.methods.contenders import CONTENDERS, Solution, outcome
from jimpact.methods.points import EnergyNorm
from jimpact.methods.stability import chain_of
from jimpact.methods.validity import ValidityMap


def test_verlet_with_friction():
    """A disc in closed form: slip is a step of order 2, what sticks creeps by O(step)."""

    @jax.jit
    @jax.vmap
    def run(mu, step):
        law = ji.LZB(0.6, friction=mu)
        return outcome(
            law, DISC, SLIDES, CONTENDERS["verlet"].solve(law, DISC, SLIDES, step)
        )

    steps, mu = np.array([0.03, 0.003]), np.array([0.1, 2.0])
    out = run(np.repeat(mu, 2), np.tile(steps, 2))
    normal = 2.0 * 1.6
    side = np.array([-0.1 * normal, -SLIP / (1 / 2.0 + 0.5**2 / 0.2)])
    error = np.abs(np.asarray(out.tangential_impulse).reshape(2, 2) - side[:, None])
    assert (np.asarray(out.status) == 0).all()
    np.testing.assert_allclose(out.impulse, normal, atol=0.01)
    assert (error[0] < [2e-3, 2e-5]).all()
    assert (error[1] < 0.5 * steps).all()


@pytest.mark.parametrize("angle", [0.3, 1.2])
def test_scipy_with_friction(angle):
    """A rod in Routh's closed form; between slip and stick friction is regularized."""
    v = [0.5, -1.0, 0.0]
    result = CONTENDERS["scipy_radau"].solve(
        ji.LZB(0.5, friction=0.3), rod(angle), v, 1e-6
    )
    normal, side = routh(rod(angle), v, 0.3, 0.5)
    np.testing.assert_allclose(result.impulse, [normal], atol=1e-5)
    np.testing.assert_allclose(result.tangential, [side], atol=1e-5)


def test_halves_of_a_chain():
    """Of N balls the ball N // 2 + 1 is the middle one, and contact j > N // 2 in the right half."""
    for balls, mass, stiffness in (
        (4, [1.0, 1.0, 0.5, 1.0], [1.0, 1.0, 10.0]),
        (5, [1.0, 1.0, 0.5, 1.0, 1.0], [1.0, 1.0, 10.0, 10.0]),
    ):
        result = chain_of(10.0, 0.5, balls)
        assert [x.tolist() for x in result] == [mass, stiffness]


def _random_chains(bodies, wall, count, seed):
    rng = np.random.default_rng(seed)
    m = bodies - 1 + bool(wall)
    masses = np.exp(rng.uniform(0, np.log(10), (count, bodies)))
    k = np.exp(rng.uniform(np.log(0.05), np.log(20), (count, m)))
    e, v = rng.uniform(0.3, 1, (count, m)), rng.uniform(-1, 1, (count, bodies))
    v[::3] = np.eye(bodies)[0]
    return masses, k, e, v


@pytest.mark.long_run
@pytest.mark.parametrize(
    "rtol",
    [
        pytest.param(1e-6, marks=pytest.mark.release),
        pytest.param(1e-8, marks=pytest.mark.release),
        pytest.param(1e-10, marks=pytest.mark.release),
    ],
)
def test_honest_tolerance_over_random_scenes(rtol):
    """99 % within 10 rtol; the worst within 100 rtol or flagged."""
    errors = []
    for seed, (bodies, wall, exponent) in enumerate(
        [
            (2, True, 1.0),
            (3, False, 1.3),
            (4, True, 1.5),
            (5, False, 2.0),
            (6, True, 1.5),
        ]
    ):
        if rtol != 1e-8 and bodies not in (3, 4):
            continue
        args = _random_chains(bodies, wall, 104, seed)

        def outcome(rtol, exponent=exponent, wall=wall, args=args):
            def one(masses, k, e, v):
                law = ji.LZB(e, k, exponent, rtol=rtol)
                return ji.impact(law, ji.chain(masses, wall=wall), v)

            return jax.jit(jax.vmap(one))(*args)

        exact, got = outcome(1e-13), outcome(rtol)
        error = np.abs(got.velocity - exact.velocity).max(axis=1)
        flagged = (np.asarray(got.status) > 0) | (np.asarray(exact.status) > 0)
        assert flagged.mean() < 0.1
        errors += list((error / np.abs(args[3]).max(axis=1) / rtol)[~flagged])
    quantiles = np.quantile(errors, [0.5, 0.9, 0.99, 1.0])
    print(
        f"error/rtol over {len(errors)} scenes at {rtol:g}: 50/90/99/100 % {quantiles}"
    )
    assert quantiles[2] < 10
    assert quantiles[3] < 100


def test_distance_is_a_ratio_of_energy_norms():
    """sqrt(dv^T M dv) / sqrt(v-^T M v-): no unit of an angle enters."""
    metres = EnergyNorm.of(ji.Scene([4.0, 1.0], np.eye(2)), np.array([1.0, 0.0]))
    assert metres(np.array([0.1, 0.2])) == pytest.approx(math.sqrt(0.04 + 0.04) / 2)
    degrees = ji.Scene(
        [4.0, 0.01], np.diag([1.0, 0.1])
    )  # the second coordinate ten times larger
    scaled = EnergyNorm.of(degrees, np.array([1.0, 0.0]))
    assert scaled(np.array([0.1, 2.0])) == pytest.approx(math.sqrt(0.08) / 2)


def test_far_contacts_take_no_part():
    """The upper corners of a block on its base; the gaps of a chain always count."""
    block = ji.Block(0.2, 0.6, 2.0)
    scene, v, law = (
        block.scene(block.touching()),
        np.array([0.3, -0.1, -1.0]),
        ji.LZB(0.1, 1e8),
    )
    for known in (False, True):
        at = situation_of(scene, v, law, known)
        assert at.far.tolist() == [False, False, True, True]
        assert [b.contacts for b in at.blocks] == [(0, 1)]
        assert not at.gapped.any()
        assert np.isinf(at.touching.gaps[2:]).all()
    tilted = situation_of(
        block.scene(block.touching(1e-5)), v, law, True
    )  # 2 micrometres
    assert tilted.far.tolist() == [False, False, True, True]
    assert tilted.gapped.tolist() == [True, False, False, False]
    chain = ji.chain([1.0] * 3, gaps=[0.0, 5.0])
    assert not situation_of(chain, np.array(STRIKE), HERTZ, True).far.any()


def test_friction_couples_contacts_with_decoupled_normals():
    """A ball in a right corner: friction at one wall loads the other."""
    scene = ji.Scene([1.0, 1.0], np.eye(2), tangents=[[0.0, 1.0], [1.0, 0.0]])
    v = np.array([-1.0, -0.5])
    for friction, blocks in ((None, [(0,), (1,)]), (0.3, [(0, 1)])):
        at = situation_of(scene, v, ji.LZB(0.5, friction=friction), False)
        assert [b.contacts for b in at.blocks] == blocks


def test_limits_are_of_the_unbroken_run_from_their_end():
    """Binary collisions hold for small ratios, Moreau's law for large ones."""
    ratios, after = np.array([0.01, 0.1, 1.0, 10.0, 100.0]), np.zeros((5, 3))
    after[:, 0] = [0.0, 0.001, 0.5, 0.999, 1.0]
    ends = {"binary": np.zeros(3), "moreau": np.array([1.0, 0.0, 0.0])}
    validity = ValidityMap(
        BALLS, np.array(STRIKE), ratios, np.ones(1), after[None], after[None, :, 0],
        np.zeros((1, 5), int), ends, dict.fromkeys(ends, 0.0),
    )  # fmt: skip
    assert validity.limit("binary").tolist() == [0.1]
    assert validity.limit("moreau").tolist() == [10.0]


def test_a_contender_of_ones_own_has_a_name_of_its_own():
    mine = CONTENDERS["rk4"]._replace(divides=False)
    with pytest.raises(ValueError, match=argument("methods")):
        ji.stability_map([mine])


def test_a_contender_with_friction_returns_tangential_impulses():
    law, without = ji.LZB(0.6, friction=0.1), Solution(np.ones(1))
    with pytest.raises(ValueError, match="must return `tangential` impulses"):
        outcome(law, DISC, SLIDES, without)
