"""Advice: each reason on a scene built for it, against the facts; validity map; the command."""

import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import jimpact as ji
from jimpact.commands.advise import run as run_command
from jimpact.methods.advice import advise
from jimpact.methods.advice_evidence import outcomes, situation
from jimpact.methods.advice_report import share
from jimpact.methods.validity import validity_map
from jimpact.theory.linear_chain import newby_ratio

BALLS, V = ji.chain([1.0, 1.0, 1.0]), [1.0, 0.0, 0.0]
EQUAL = ji.LZB(jnp.ones(2), jnp.ones(2))


def quick(scene, velocity, tolerance=1e-2, **options):
    return advise(scene, velocity, tolerance, timing=False, **options)


def error_of(law, found, reference):
    """Error of v+ of a law on the advised scene, relative to max |v-|."""
    v = np.asarray(ji.impact(law, found.scene, found.velocity).velocity)
    return np.abs(v - reference).max() / np.abs(found.velocity).max()


@pytest.fixture(scope="module")
def unknown():
    return quick(BALLS, V)


def test_unknown_ratio_decides(unknown):
    """Nothing is within 1 % where k2/k1 is anywhere in [0.1, 10]; LZB is told, and what it lacks."""
    assert (unknown.name, unknown.within, unknown.reference) == ("lzb", False, "lzb")
    assert "stiffness ratio k2/k1 in [0.1, 10] decides" in unknown.reason
    assert unknown.law.rtol == 1e-3
    nominal = [-0.070952353651436871, 0.076403039071206993, 0.99454931458022988]
    np.testing.assert_allclose(unknown.candidates["lzb"].velocity, nominal, atol=1e-7)
    for name, c in unknown.candidates.items():
        assert c.usable, name
        assert c.worst > 0.1, name
        assert c.median <= c.worst


def test_effects_of_a_ratio(unknown):
    """`alone` is what the ends of the range do, `needed` moves v+ by the tolerance."""
    (effect,) = unknown.effects
    at = situation(BALLS, np.array(V))
    low, high = 1 - effect.needed, 1 + effect.needed
    tried = np.array([[1.0, 1.0], [1.0, 0.1], [1.0, 10.0], [1.0, low], [1.0, high]])
    v = outcomes(EQUAL, at, BALLS, tried, None).velocity
    moved = np.abs(v - v[0]).max(axis=1)
    assert effect.alone == pytest.approx(max(moved[1:3]), rel=1e-6)
    assert unknown.candidates["lzb"].worst >= effect.alone
    np.testing.assert_allclose(moved[3:], 0.01, rtol=0.1)


# known ratio, tolerance: law; at 1e3 the contacts act together, at 0.01 one after the other
KNOWN = [(1e3, 0.02, "newton"), (50.0, 0.02, "lzb"), (1.0, 0.02, "lzb"), (0.01, 0.02, "binary")]


@pytest.mark.parametrize(("ratio", "tolerance", "name"), KNOWN)
def test_known_ratio(ratio, tolerance, name):
    found = quick(BALLS, V, tolerance, stiffness=[1.0, ratio])
    exact = found.candidates["lzb"].velocity
    assert (found.name, found.within, found.unknown) == (name, True, ())
    assert error_of(found.law, found, exact) <= tolerance
    simpler = {"newton": [], "binary": ["newton", "moreau", "poisson"]}.get(
        name, ["newton", "moreau", "poisson", "binary"]
    )
    for other in simpler:
        assert np.abs(found.candidates[other].velocity - exact).max() > tolerance
    assert f"k2/k1 = {ratio:.3g}" in found.reason


def test_tolerance_from_both_sides():
    """At the error of binary collisions the advice changes, and nowhere near it."""
    known = {"stiffness": [1.0, 0.5]}
    edge = quick(BALLS, V, 0.5, **known).candidates["binary"].worst
    assert 0.02 < edge < 0.05
    assert quick(BALLS, V, 1.001 * edge, **known).name == "binary"
    below = quick(BALLS, V, 0.999 * edge, **known)
    assert (below.name, below.within) == ("lzb", True)
    assert f"binary comes closest and is off by {share(edge)}" in below.reason


def test_advice_holds_for_ratios_it_has_not_seen():
    options = {"stiffness": [1.0, 0.2], "stiffness_range": (0.5, 2.0)}
    found = quick(BALLS, V, 0.03, **options)
    assert (found.name, found.within) == ("binary", True)
    ratio = np.exp(np.random.default_rng(7).uniform(np.log(0.1), np.log(0.4), 256))
    at = situation(BALLS, np.array(V))
    tried = np.stack([np.ones(256), ratio], axis=1)
    seen = outcomes(EQUAL, at, BALLS, tried, None).velocity
    error = np.abs(seen - found.candidates["binary"].velocity).max(axis=1)
    assert error.max() <= found.candidates["binary"].worst * (1 + 1e-9)
    assert (np.abs(seen - found.candidates["moreau"].velocity).max(axis=1) > 0.03).all()
    again, other = quick(BALLS, V, 0.03, **options), quick(BALLS, V, 0.03, seed=1, **options)
    assert again.to_dict() == found.to_dict()
    assert other.candidates["binary"].median != found.candidates["binary"].median


def test_nominal_ratio_may_be_enough():
    options = {"stiffness": [1.0, 1.0], "stiffness_range": (0.9, 1.1)}
    found = quick(BALLS, V, 0.02, **options)
    assert (found.name, found.within) == ("lzb", True)
    assert "whatever they are" in found.reason
    assert 0.001 < found.candidates["lzb"].worst < 0.02


def test_plastic_contacts():
    found = quick(BALLS, V, restitution=0.0)
    assert (found.name, found.within) == ("newton", True)
    assert "plastic contacts" in found.reason
    np.testing.assert_allclose(ji.impact(found.law, found.scene, V).velocity, 1 / 3, atol=1e-12)


@pytest.mark.parametrize("velocity", [[-1.0, 0.0, 2.0], [0.0, 0.0, 0.0]])
def test_no_approach(velocity):
    found = quick(BALLS, velocity)
    assert found.reason.startswith("no approach: nothing happens")
    assert found.name == "newton"
    np.testing.assert_array_equal(ji.impact(found.law, BALLS, velocity).velocity, velocity)


def test_law_that_breaks_a_property_is_not_advised():
    """Unequal e let Moreau's law gain energy; equally fast coupled contacts have no order."""
    gain = quick(BALLS, [1.0, 0.0, -0.8], 0.5, restitution=[0.0, 1.0], stiffness=[1.0, 1.0])
    for c in gain.candidates.values():
        assert c.usable == (c.status in ("ok", "impulse_not_unique", "plastic_limit"))
    both = quick(ji.chain([0.25, 1.0, 0.25]), [1.0, 0.0, -1.0], 0.9, stiffness=[1.0, 1.0])
    assert both.candidates["binary"].status == "order_dependent"
    assert not both.candidates["binary"].usable
    assert both.candidates["binary"].worst < 0.9
    assert both.name == "newton"


# --- gaps


GAPPED = ji.chain([1.0, 1.0, 1.0], gaps=[0.0, 2e-3])


@pytest.mark.slow
def test_wide_gap():
    found = quick(GAPPED, V, 1e-3, stiffness=1.2e8)
    law = ji.Compliant(ji.Bistiffness(1.2e8, 1.5, 1.0))
    ratio = float(ji.gap_scale(GAPPED, law, V).ratio[1])
    assert (found.name, found.reference) == ("binary", "compliant")
    assert f"gaps exceed 2 delta_c (they are {ratio:.3g} delta_c)" in found.reason
    assert ratio > 2
    assert found.law.order == "earliest"
    assert found.scene is GAPPED
    assert error_of(found.law, found, found.candidates["compliant"].velocity) < 1e-3
    assert found.candidates["lzb"].worst > 0.05


def test_gap_without_stiffness():
    with pytest.raises(ValueError, match=r"`stiffness` must be given .* \(contact 2\)"):
        quick(GAPPED, V)
    with pytest.raises(ValueError, match="`stiffness` must be given where exponents differ"):
        quick(BALLS, V, exponent=(1.0, 1.5))


@pytest.mark.slow
def test_gap_that_cannot_matter():
    """A lone contact closes sooner or later: its gap plays no part."""
    found = quick(ji.chain([1.0, 2.0], gaps=[0.1]), V[:2], restitution=0.5)
    assert (found.reference, found.reason) == ("lzb", "single contact: every law is Newton's")
    np.testing.assert_allclose(ji.impact(found.law, found.scene, V[:2]).velocity, [0.0, 0.5])
    idle = situation(ji.chain(np.ones(3), gaps=[0.0, 0.1]), np.array([-1.0, 0.0, 0.0]))
    assert not idle.gapped.any()


@pytest.mark.slow
@pytest.mark.parametrize(("gap", "name"), [(1e-6, "lzb"), (1e-4, "compliant")])
def test_narrow_gaps(gap, name):
    scene = ji.chain([1.0, 1.0, 1.0], gaps=[0.0, gap])
    found = quick(scene, V, 1e-2, stiffness=1.2e8)
    exact = ji.impact(ji.Compliant(ji.Bistiffness(1.2e8, 1.5, 1.0)), scene, V).velocity
    assert (found.name, found.within) == (name, True)
    assert error_of(found.law, found, np.asarray(exact)) <= 1e-2
    assert ("much as if touching" in found.reason) == (name == "lzb")
    assert (found.candidates["lzb"].worst > 1e-2) == (name == "compliant")


# --- blocks: one shape of scene, (4, 3), dense M


def three_contacts(normals, mass=None):
    return ji.Scene(np.eye(4) if mass is None else mass, np.array(normals, float).T)


def test_blocks():
    """Contacts are coupled where their kinetic angle is not 90 degrees, over others too."""
    scene = three_contacts([[-1, 1, 0, 0], [0, 0, 0, 1], [0, -1, 1, 0]])
    blocks = situation(scene, np.array([0.0, 0.0, 0.0, -1.0])).blocks
    assert [(b.contacts, b.approaches) for b in blocks] == [((0, 2), False), ((1,), True)]
    np.testing.assert_allclose(blocks[0].angles, 60.0)
    assert blocks[1].angles is None
    row = situation(ji.chain(np.ones(5)), np.array([1.0, 0, 0, 0, 0])).blocks
    assert [b.contacts for b in row] == [(0, 1, 2, 3)]
    turned = [[np.cos(a), np.sin(a), 0, 0] for a in (0.3, 0.3 + np.pi / 2, 0.3)]
    assert [b.contacts for b in situation(three_contacts(turned), np.ones(4)).blocks] == [
        (0, 2),
        (1,),
    ]


APART = three_contacts([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]])


@pytest.mark.slow
def test_decoupled():
    found = quick(APART, [-1.0, -2.0, -0.5, 3.0], restitution=0.5)
    assert found.reason == "contacts decoupled: kinetic angle 90 degrees, all laws agree"
    assert [block.contacts for block in found.blocks] == [(0,), (1,), (2,)]
    assert found.rows == 1
    for c in found.candidates.values():
        np.testing.assert_allclose(c.velocity, [0.5, 1.0, 0.25, 3.0], atol=1e-12)


@pytest.mark.slow
def test_separating_contact():
    """Newton's law would pull at contact 2; the next simpler law does not."""
    found = quick(APART, [-1.0, 2.0, 0.0, 0.0], restitution=0.5)
    assert found.name == "moreau"
    assert "only contact 1 takes part" in found.reason
    assert "Newton fails: negative_impulse" in found.reason
    assert found.blocks[0].law == "newton"
    assert [block.approaches for block in found.blocks] == [True, False, False]


@pytest.mark.slow
def test_blocks_are_told_apart():
    """A coupled pair (three equal balls) and a contact alone: each with what it needs."""
    scene = three_contacts([[-1, 1, 0, 0], [0, 0, 0, 1], [0, -1, 1, 0]])
    found = quick(scene, [1.0, 0.0, 0.0, -1.0], 0.02, stiffness=[1.0, 1.0, 0.01])
    assert found.name == "binary"
    first, second = found.blocks
    assert (first.contacts, first.law) == ((0, 2), "binary")
    np.testing.assert_allclose(first.angles, 60.0)
    assert (second.contacts, second.law) == ((1,), "newton")
    text = str(found)
    assert "contacts 1, 3 are coupled (kinetic angle 60 degrees)" in text
    assert "k3/k1 = 0.01" in text
    unknown = quick(scene, [1.0, 0.0, 0.0, -1.0], 0.02)
    assert [u.name for u in unknown.unknown] == ["k3/k1"]


@pytest.mark.slow
def test_obtuse_angle_needs_no_ratio():
    """Pushing one corner of a slender block opens the other: every law with signs agrees."""
    mass = np.eye(4)
    mass[:2, :2] = np.linalg.inv([[1.0, 0.25], [0.25, 1.0]])
    scene = three_contacts([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]], mass)
    found = quick(scene, [0.0, -1.0, 0.0, 0.0], restitution=0.5)
    assert found.name == "moreau"
    assert "k2/k1 in [0.1, 10] makes no difference (kinetic angle 104.5 degrees" in found.reason
    v = ji.impact(found.law, found.scene, found.velocity).velocity
    np.testing.assert_allclose(v, [0.375, 0.5, 0.0, 0.0], atol=1e-12)


@pytest.mark.slow
def test_several_ratios():
    """Five unknown ratios: which of them matters, and many corners."""
    found = quick(ji.chain(jnp.ones(7)), [1.0, 0, 0, 0, 0, 0, 0], samples=64)
    assert [u.name for u in found.unknown] == [f"k{j}/k1" for j in range(2, 7)]
    strongest = max(found.effects, key=lambda effect: effect.alone)
    assert f"measure {strongest.name} first" in found.reason
    assert found.candidates["lzb"].worst >= strongest.alone
    assert "unknown" in str(found)


# --- input, output


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"tolerance": 0.0}, ValueError, "`tolerance` must lie in"),
        ({"tolerance": 1e-9}, ValueError, "`tolerance` must lie in"),
        ({"tolerance": [0.1]}, ValueError, "`tolerance` must have shape"),
        ({"stiffness_range": (2.0, 1.0)}, ValueError, "`stiffness_range` must have low <= high"),
        ({"stiffness_range": (0.0, 1.0)}, ValueError, "`stiffness_range` must lie in"),
        ({"stiffness_range": 2.0}, ValueError, "`stiffness_range` must have shape"),
        ({"samples": 0}, ValueError, "`samples` must be an int >= 1"),
        ({"seed": -1}, ValueError, "`seed` must be an int >= 0"),
        ({"restitution": 1.5}, ValueError, "`restitution` must lie in"),
        ({"stiffness": [1.0, 2.0, 3.0]}, ValueError, "`stiffness` must be a scalar or"),
        ({"exponent": 0.5}, ValueError, "`exponent` must lie in"),
        ({"law": ji.Newton(0.5)}, TypeError, "`law` must be an LZB"),
        ({"law": ji.LZB(1.0), "exponent": 1.5}, ValueError, "`exponent` must be None"),
        ({"law": ji.LZB(1.0, initial_energy=1.0)}, ValueError, "no initial_energy"),
    ],
)
def test_bad_input(options, error, message):
    with pytest.raises(error, match=message):
        advise(BALLS, V, **options)


def test_bad_velocity():
    for velocity, message in (([1.0, 0.0], "shape"), ([1.0, np.nan, 0.0], "finite")):
        with pytest.raises(ValueError, match=message):
            advise(BALLS, velocity)


def test_law_stands_for_its_parameters():
    law = ji.LZB(0.95, [1.0, 0.01], 1.5)
    found = quick(BALLS, V, law=law)
    same = quick(BALLS, V, restitution=0.95, stiffness=[1.0, 0.01])
    assert found.to_dict() == same.to_dict()
    assert found.unknown == ()


def test_report_and_picture(unknown):
    told = json.loads(json.dumps(unknown.to_dict()))
    assert told["laws"]["lzb"]["worst_error"] == unknown.candidates["lzb"].worst
    assert told["unknown"][0]["name"] == "k2/k1"
    text = str(unknown)
    assert max(len(line) for line in text.splitlines()) <= 100
    assert len(text.splitlines()) < 25
    assert "*lzb" in text
    axes = ji.plot.advice(unknown, "balls").axes
    assert len(axes) == 2
    assert "NOT within 1 %" in text
    assert "not within 1 %" in axes[0].get_title(loc="left")


# --- validity map

EXACT = {  # three equal balls, exponent 1, e = 1: unilateral springs, closed form
    0.25: (-0.0301850562872225066, 0.0311254645544743804, 0.99905959173274812616),
    0.5: (-0.0622512845247422379, 0.0664021320771282079, 0.99584915244761403004),
    1.0: (-0.1302616950645210470, 0.1502295694347740893, 0.98003212562972695774),
    2.0: (-0.2454016724823200310, 0.3361128425708038889, 0.90928882991151614209),
    newby_ratio(2): (-0.263586813696557148, 0.374697924807668259, 8 / 9),
    5.0: (-0.3316799532860221818, 0.6252034192231428602, 0.70647653405287932157),
    newby_ratio(3): (-1 / 3, 2 / 3, 2 / 3),
    10.0: (-0.3309938917272272135, 0.6171716226279141425, 0.71382226909931307106),
}
RATIOS = [1e-6, 1e-3, *EXACT, 1e3, 1e6]


@pytest.fixture(scope="module")
def valid():
    return validity_map(BALLS, V, RATIOS, (1.0, 1.5, 2.0, 3.0))


def test_map_meets_the_closed_form(valid):
    assert not valid.status.any()
    np.testing.assert_allclose(valid.velocity[0, 2:-2], list(EXACT.values()), atol=1e-7)
    hertz = [-0.070952353651436871, 0.076403039071206993, 0.99454931458022988]
    np.testing.assert_allclose(valid.velocity[1, RATIOS.index(1.0)], hertz, atol=1e-7)
    assert valid.error("moreau")[0, RATIOS.index(newby_ratio(3))] < 1e-6


def test_limits_of_the_map(valid):
    """k2/k1 -> 0: binary; -> inf: Moreau; the larger the exponent, the later."""
    assert valid.law_dispersion["moreau"] == pytest.approx(2 / 3)
    assert valid.law_dispersion["binary"] == pytest.approx(0.0)
    binary = valid.error("binary")
    np.testing.assert_allclose(binary[:, 0] / binary[:, 1], 1e-3, rtol=0.01)  # first order in k2/k1
    assert (np.diff(binary[:, 1]) < 0).all()
    np.testing.assert_allclose(valid.dispersion[:, 0], 0.0, atol=1e-12)
    moreau = valid.error("moreau")[:, -2:]
    assert (moreau[:, 1] < moreau[:, 0]).all()
    assert (moreau[:, 1] < [1e-6, 1e-4, 1e-3, 1e-2]).all()
    assert (np.diff(moreau[:, 1]) > 0).all()
    np.testing.assert_allclose(valid.dispersion[:, -1], 2 / 3, atol=1e-3)
    assert (np.diff(valid.dispersion[:, RATIOS.index(1.0)]) < 0).all()


def test_where_a_law_may_be_used(valid):
    """`limit` is the last ratio of the unbroken run within tolerance from that end of the map."""
    for law, step in (("binary", 1), ("moreau", -1)):
        error, limit = valid.error(law), valid.limit(law, 0.05)
        for i in range(4):
            at = RATIOS.index(limit[i])
            run = error[i, : at + 1] if step == 1 else error[i, at:]
            assert (run <= 0.05).all()
            assert error[i, at + step] > 0.05
    assert np.isnan(valid.limit("moreau", 1e-6)[1:]).all()
    assert "ratio <= 0.001" in str(valid).splitlines()[1]
    figure = ji.plot.validity_map(valid)
    assert len(figure.axes) == 2
    json.dumps(valid.to_dict())
    with pytest.raises(ValueError, match="`law` must be one of moreau, binary"):
        valid.error("newton")


@pytest.mark.slow
def test_map_of_a_longer_chain():
    balls, v = ji.chain([1.0, 2.0, 1.0, 3.0]), [1.0, 0.0, 0.0, -0.5]
    found = validity_map(balls, v, [0.5, 3.0], [1.5], restitution=[0.9, 0.8, 0.7])
    law = ji.LZB([0.9, 0.8, 0.7], [1.0, 3.0, 9.0], 1.5)
    np.testing.assert_allclose(found.velocity[0, 1], ji.impact(law, balls, v).velocity, atol=1e-7)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((ji.chain([1.0, 1.0]), [1.0, 0.0]), "`scene` must have two or more contacts"),
        ((GAPPED, V), "all closed"),
        ((BALLS, [0.0, 0.0, 0.0]), "`velocity` must not be zero"),
        ((BALLS, V, [2.0, 1.0]), "`ratios` must rise"),
        ((BALLS, V, [0.0, 1.0]), "`ratios` must lie in"),
        ((BALLS, V, 1.0), "`ratios` must have shape"),
        ((BALLS, V, [1.0], [0.5]), "`exponents` must lie in"),
        ((BALLS, V, [1.0], [1.0], 2.0), "`restitution` must lie in"),
    ],
)
def test_bad_map(arguments, message):
    with pytest.raises(ValueError, match=message):
        validity_map(*arguments)


# --- the command


def command(capsys, study="three_balls.toml", **options):
    given = {
        "velocity": None,
        "shot": 1,
        "tolerance": 0.01,
        "stiffness_range": None,
        "samples": 128,
        "seed": 0,
        "out": Path("."),
        "json": False,
    }
    code = run_command(Path(study), **(given | options))
    return code, capsys.readouterr()


def test_command(capsys, tmp_path):
    code, said = command(capsys, out=tmp_path, json=True)
    told = json.loads(said.out)
    assert code == 0
    assert (told["advice"], told["within"]) == ("lzb", True)
    assert told["laws"]["binary"]["worst_error"] > 0.01
    assert min(row["cost"] for row in told["laws"].values()) >= 1.0
    assert Path(told["picture"]).stat().st_size > 10_000
    code, said = command(capsys, tolerance=0.2, out=tmp_path / "a.svg")
    assert code == 0
    assert "Advice: Binary(0.95), within 20 %" in said.out
    assert (tmp_path / "a.svg").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tolerance": 2.0}, "`tolerance` must lie in"),
        ({"shot": 2}, "--shot must lie in [1, 1]"),
        ({"study": "nowhere.toml"}, "does not exist"),
        ({"out": Path("a.txt")}, "--out must end in"),
        ({"stiffness_range": (2.0, 1.0)}, "low <= high"),
    ],
)
def test_command_refuses(capsys, tmp_path, monkeypatch, options, message):
    monkeypatch.chdir(tmp_path)
    code, said = command(capsys, **options)
    assert code == 2
    assert message in said.err
