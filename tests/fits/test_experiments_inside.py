"""Reading shots, what is refused, and what the data break."""

import re
from importlib.resources import files
from pathlib import Path

import numpy as np

import jimpact as ji
from jimpact.fits.data_checks import DATA_CHECKS, DataBalances
from jimpact.fits.findings import KINDS, findings

DATA = files("jimpact") / "data"


CHAIN = ji.chain([1.0, 1.0, 1.0])


def written(tmp_path, text, encoding="utf-8"):
    path = tmp_path / "shots.csv"
    path.write_bytes(text.encode(encoding))
    return path


def data_defects(experiments, scene, stored_energy=0.0):
    """What the data break beyond their error, a line each."""
    balances = DataBalances(experiments, scene, stored_energy, uses_gaps=False)
    return [found.line for found in findings(DATA_CHECKS, balances)]


def test_momentum_of_the_measured_balls():
    data = ji.read_experiments(DATA / "three_balls.csv")
    np.testing.assert_allclose(data.momentum_excess(CHAIN), [[0.0422]], atol=1e-15)
    np.testing.assert_allclose(data.momentum_ratio(CHAIN), [[1.0422]], atol=1e-15)
    np.testing.assert_allclose(data.energy_ratio(CHAIN), [1.01026910], atol=1e-8)
    corrected = data.momentum_corrected(CHAIN)
    np.testing.assert_allclose(corrected.post, data.post - 0.0422 / 3, atol=1e-15)
    assert corrected.lost_freedom == 1
    assert [corrected.only(which).lost_freedom for which in ([0], [0, 0])] == [1, 2]
    assert data_defects(data, CHAIN) == [
        "The data violate conservation of momentum (1 = conserved): shot 1: 1.0422; no law can reproduce that part "
        "(rms 0.0141 m/s).",
        "The data gain energy (1 = conserved): shot 1: 1.0103.",
    ]
    assert data_defects(corrected, CHAIN) == []


def test_incomplete_shots_are_neither_judged_nor_corrected():
    data = ji.Experiments([[1.0, 0.0]] * 2, [[0.0, np.nan], [0.0, 1.1]])
    scene = ji.chain([1.0, 1.0])
    assert np.isnan(data.momentum_excess(scene)[0, 0])
    corrected = data.momentum_corrected(scene)
    np.testing.assert_allclose(
        corrected.post, [[0.0, np.nan], [-0.05, 1.05]], atol=1e-15
    )
    assert "shot 2: 1.1000" in data_defects(data, scene)[0]


def test_defects_are_held_against_sigma():
    scene = ji.chain([1.0, 1.0])
    inside = ji.Experiments(
        [1.0, 0.0], [0.1, 0.95], sigma=0.02
    )  # excess 0.05, error 0.028
    outside = ji.Experiments([1.0, 0.0], [0.1, 0.95], sigma=0.01)
    assert data_defects(inside, scene) == []
    assert len(data_defects(outside, scene)) == 1
    stored = ji.Experiments([1.0, 0.0], [-0.1, 1.1])  # gains 0.11 J
    assert "gain energy" in data_defects(stored, scene)[0]
    assert data_defects(stored, scene, stored_energy=0.2) == []


def test_no_momentum_before_leaves_no_ratio():
    data = ji.Experiments([0.1, -0.3 + 0.2], [0.2, 0.1])
    assert data.momentum_ratio(ji.chain([1.0, 1.0]))[0, 0] == np.inf
    assert "shot 1: 2.5000" in data_defects(data, ji.chain([1.0, 1.0]))[0]


def test_many_defects_are_summed_up():
    data = ji.Experiments([[1.0, 0.0]] * 9, [[0.0, 1.1]] * 8 + [[0.0, 1.3]])
    line = data_defects(data, ji.chain([1.0, 1.0]))[0]
    assert "9 of 9 shots, 1.1000 to 1.3000" in line


def test_momentum_lost_from_both_ends_is_seen():
    """Signed excesses cancel; as shares of the momentum they do not."""
    pre = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0]] * 4)
    exact = np.array(
        [ji.impact(ji.Newton(0.9), CHAIN, v).velocity for v in pre[:2]] * 4
    )
    noise = 0.003 * np.random.default_rng(0).normal(size=pre.shape)
    assert data_defects(ji.Experiments(pre, exact + noise), CHAIN) == []
    (line,) = data_defects(ji.Experiments(pre, 0.8 * exact + noise), CHAIN)
    assert "8 of 8 shots, 0.7" in line
    offset = ji.Experiments(pre, exact + noise + [0.01, 0.01, 0.01])
    assert "violate conservation of momentum" in data_defects(offset, CHAIN)[0]


def test_gross_defects_need_no_test():
    pre, exact = np.array([[1.0, 0.0], [2.0, 0.0]]), np.array([[0.1, 0.9], [0.2, 1.8]])
    post = 100 * exact + np.array([[5.0, 3.0], [-6.0, -10.0]])  # cm/s
    lines = data_defects(ji.Experiments(pre, post), ji.chain([1.0, 1.0]))
    assert [line.split(" (")[0] for line in lines] == [
        "Units? The momentum after is 100 times that before: cm/s in one of the columns?",
        "The data violate conservation of momentum",
        "The data gain energy",
    ]


def test_honest_momentum_is_seldom_reported():
    """The level of 2 % holds for both tests together: 200 sets of 6 shots."""
    rng, pair = np.random.default_rng(0), ji.chain([1.0, 2.0])
    pre = np.stack([rng.uniform(-1, 1, (200, 6)), np.zeros((200, 6))], axis=2)
    post = pre @ np.array([[-0.2, 0.6], [1.2, 0.4]]) + 0.01 * rng.normal(size=pre.shape)
    sets = [ji.Experiments(a, b) for a, b in zip(pre, post)]
    alarms = sum("momentum" in " ".join(data_defects(data, pair)) for data in sets)
    assert 1 <= alarms <= 10


def test_kinds_of_findings_are_those_of_the_table():
    folder = Path(ji.__file__).parent / "fits"
    used = set(
        re.findall(
            r'Finding\(\s*"(\w+)"', "".join(p.read_text() for p in folder.glob("*.py"))
        )
    )
    assert used == set(KINDS)
