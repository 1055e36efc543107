"""Laws side by side: indices, table, command, and the chooser table of the README."""

import json
from pathlib import Path

import numpy as np
import pytest

import jimpact as ji
from jimpact.cli import main
from jimpact.comparison import registered_laws

BALLS = ji.chain([1.0, 1.0, 1.0])
README = Path(__file__).parent.parent / "README.md"


def test_dispersion_index_and_energy_ratio():
    for v, index in (([0, 0, 1.0], 0.0), ([-1 / 3, 2 / 3, 2 / 3], 2 / 3), ([1, -1, 1.0], 1.0)):
        assert float(ji.dispersion_index(BALLS, v)) == pytest.approx(index, abs=1e-14)
    heavy = ji.chain([4.0, 1.0])
    assert float(ji.dispersion_index(heavy, [1.0, -2.0])) == pytest.approx(1.0)
    assert float(ji.energy_ratio(heavy, [1.0, 0.0], [0.5, 0.0])) == pytest.approx(0.25)


def test_compare_gives_every_law_its_outcome():
    found = ji.compare(BALLS, [1.0, 0.0, 0.0], restitution=0.9, stiffness=[1.0, 2.0])
    assert set(found.entries) == {
        name
        for name, row in ji.REGISTRY.items()
        if row.parameters[0] in ("restitution", "stiffness")
    }
    for name, entry in found.entries.items():
        same = ji.impact(entry.law, BALLS, [1.0, 0.0, 0.0])
        np.testing.assert_array_equal(entry.outcome.velocity, same.velocity)
        assert entry.energy_ratio == pytest.approx(2 * (0.5 + float(same.energy_change)))
        assert entry.time > 0
        assert name in str(found)
    assert float(found.entries["lzb"].law.stiffness[1]) == 2.0
    told = json.loads(json.dumps(found.to_dict()))
    assert told["moreau"]["consistent"] is True


def test_compare_tells_what_is_violated():
    slender = ji.Scene(np.linalg.inv([[1.0, 0.25], [0.25, 1.0]]), np.eye(2))
    table = str(ji.compare(slender, [0.0, -1.0], {"mine": ji.Newton(0.5)}))
    assert "kinetic violated, negative_impulse" in table


def test_laws_without_their_parameter_are_left_out():
    assert "restitution_matrix" not in registered_laws({"restitution": 0.5})[0]
    given = registered_laws({"matrix": np.eye(2)})[0]
    assert list(given) == ["restitution_matrix"]


def run(capsys, *arguments):
    code = main(["compare", *arguments])
    return code, capsys.readouterr()


def test_command(capsys, tmp_path):
    code, said = run(capsys, "--out", str(tmp_path), "--json")
    told = json.loads(said.out)
    assert code == 0
    np.testing.assert_allclose(told["laws"]["moreau"]["velocity"], [-0.3, 0.65, 0.65], atol=1e-12)
    assert (tmp_path / "jimpact-compare.png").stat().st_size > 10_000
    code, said = run(capsys, "--velocity", "2", "0", "0", "--out", str(tmp_path / "a.svg"))
    assert code == 0
    assert "measured" not in said.out
    assert "-0.6000" in said.out


def test_command_on_a_study_without_data(capsys, tmp_path):
    study = tmp_path / "mine.toml"
    study.write_text('[scene]\nmasses_kg = [1, 2]\n[law]\nname = "newton"\nrestitution = 0.5\n')
    code, said = run(capsys, str(study), "--out", str(tmp_path))
    assert (code, "no [data]" in said.err) == (2, True)
    code, said = run(capsys, str(study), "--velocity", "1", "0", "--out", str(tmp_path))
    assert code == 0
    assert main(["fit", str(study)]) == 2
    assert "[data]" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--shot", "2"], "--shot must lie in [1, 1], but is 2"),
        (["--velocity", "1", "0"], "`velocity` must have shape (3,)"),
        (["--velocity", "1", "nan", "0"], "`velocity` must be finite"),
        (["--out", "a.txt"], "--out must end in"),
        (["nowhere.toml"], "does not exist"),
    ],
)
def test_bad_input(capsys, tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    code, said = run(capsys, *arguments)
    assert code == 2
    assert message in said.err


# one coefficient for all contacts, and one each; as measured, and momentum corrected
FITTED = [
    (ji.Moreau(0.9), 0.364, [0.612]),
    (ji.Binary(0.9), 0.0675, [0.983]),
    (ji.Binary([0.9, 0.9]), 0.053, [1.0, 0.89]),
    (ji.Poisson([0.9, 0.9]), 0.224, [0.37, 1.0]),
    # the only one to meet it exactly: 1 + e1 = 3/2 (1 - v1), 1 + e2 = 3 v3
    (ji.Poisson([0.9, 1.5], allow_above_one=True), 0.0, [0.612, 1.951]),
]


@pytest.mark.parametrize(("law", "rms", "restitution"), FITTED)
def test_laws_fitted_to_the_measured_balls(law, rms, restitution):
    shot = ji.Experiments(pre=[[1.0, 0, 0]], post=[[-0.0605, 0.1049, 0.9978]])
    corrected = shot.momentum_corrected(BALLS)
    found = ji.fit(law, BALLS, corrected, ("restitution",), starts=2)
    np.testing.assert_allclose(np.atleast_1d(found.law.restitution), restitution, atol=6e-3)
    assert found.rms == pytest.approx(rms, abs=6e-4)


@pytest.mark.slow
def test_readme_holds_the_chooser_table():
    import chooser

    lines, silent = chooser.table()
    assert silent == 0  # whatever a law breaks, a status tells
    text = README.read_text()
    for line in lines:
        assert line in text
