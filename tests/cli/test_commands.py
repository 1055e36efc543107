"""One end-to-end call a command; what is refused is one line on stderr and exit code 2."""

import csv
import json
import re
import signal
import subprocess
import sys
import time
from importlib.resources import files
from pathlib import Path

import nbclient
import nbformat
import numpy as np
import pytest
from commands_cases import BODIES, SAMPLED, SHOTS, STUDY, VERBS, call, written

import jimpact as ji

MOTION = """
[system]
kind = "block"
width_m = 0.2
height_m = 0.6
[base]
amplitude_m = 0.01
frequency_hz = 1.0
direction = "horizontal"
[law]
name = "moreau"
restitution = 0.5
[motion]
q0 = [0.0, 0.3, 0.0]
v0 = [0.0, 0.0, 0.0]
t_end_s = 0.2
samples = 5
"""


@pytest.fixture(autouse=True)
def in_its_own_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def test_a_study_knows_priors_and_names_of_entries(tmp_path):
    text = STUDY.replace("restitution = 0.9", "restitution = [0.9, 0.8]")
    text = text.replace("[1.0, 1.0]", "[1.0, 1.0, 1.0]") + (
        '\n[law.priors]\n"restitution[2]" = [0.85, 0.01]\n[law.bounds]\n"restitution[1]" = [0.5, 1]\n'
    )
    shots = SHOTS.replace(
        "post_2[m/s]",
        "post_2[m/s],pre_3[m/s],post_3[m/s],sigma_1[m/s],sigma_2[m/s],sigma_3[m/s]",
    )
    shots = shots.replace("0.83", "0.83,0,0.1,1,1,1").replace(
        "1.62", "1.62,0,0.2,1,1,1"
    )
    problem = ji.read_study(written(tmp_path, text, shots)).problem
    assert problem.priors == ((1, 0.85, 0.01),)
    np.testing.assert_array_equal(problem.domains, [[0.5, 1.0], [0.0, 1.0]])
    of_scene = text.replace(
        '"restitution[2]" =', '"mass[2]" = [1.0, 0.1]\n"restitution[2]" ='
    )
    of_scene = of_scene.replace(
        'free = ["restitution"]', 'free = ["restitution", "mass[2]"]'
    )
    assert "mass[2]" in ji.read_study(written(tmp_path, of_scene, shots)).problem.names
    with pytest.raises(ValueError, match=r"\[law.priors\].*frictoin"):
        ji.read_study(
            written(tmp_path, text.replace('"restitution[2]"', '"frictoin[2]"'), shots)
        )


def test_a_study_of_a_motion_may_fit_its_start(tmp_path):
    path = tmp_path / "study.toml"
    path.write_text(MOTION + '[fit]\nfree = ["restitution", "q0", "floor"]\n')
    assert list(ji.read_study(path).free) == ["restitution", "q0", "floor"]


def test_fit_of_a_study(tmp_path, capsys):
    picture = tmp_path / "deep" / "a.svg"
    options = ["--out", picture, "--seed", "1"]
    code, said = call(capsys, "fit", written(tmp_path), *options)
    assert code == 0
    for words in (
        "study",
        "as measured",
        "corrected ",
        "Rank: ",
        "Warnings",
        "Picture: ",
    ):
        assert words in said.out
    assert picture.read_text().startswith("<?xml")
    assert f"folder {picture.parent} was made." in said.err
    options = ["--law", "newton", "--method", "adam", "--starts", "1", "--json"]
    code, said = call(capsys, "fit", "study.toml", "--out", tmp_path, *options)
    result = json.loads(said.out)["fits"]["as measured"]
    assert (code, result["method"]) == (0, "adam")
    np.testing.assert_allclose(result["parameters"][0]["value"], 0.604, atol=2e-3)


@pytest.mark.release
def test_every_law_is_fitted(tmp_path, capsys):
    study = written(tmp_path)
    code, said = call(
        capsys, "fit", study, "--law", "all", "--starts", "1", "--out", tmp_path
    )
    assert code == 0
    for words in (
        "newton",
        "lzb",
        "left out",
        "verdict",
        "The simplest law that fits is newton",
    ):
        assert words in said.out
    code, said = call(
        capsys,
        "fit",
        study,
        "--law",
        "all",
        "--starts",
        "1",
        "--csv",
        "--out",
        tmp_path,
    )
    lines = said.out.splitlines()
    assert lines[0] == "law,parameters,rms_m_per_s,left_out_m_per_s,aicc,verdict"
    assert lines[1].startswith("newton,1,")


REFUSED = [
    ("[scene]", "[scenery]", "the study must have the key `scene`"),
    ("[fit]", "[fit]\ntolerance = 1", "[fit] may have the keys free, method"),
    ("[fit]", "[fit]\nprofiles = 'yes'", "`profiles` in [fit] must be true or false, but is 'yes'"),
    ("[fit]", "[fit]\nseed = -1", "`seed` must be an int >= 0, but has value -1"),
    ("file =", "momentum_corrected = 'no'\nfile =", "`momentum_corrected` in [data] must be true or"),
    ("file =", "near_m = 1.0\nfile =", "`near_m` in [data] is for shots with scenes of their own"),
    ("[scene]", "[system]", "the study must be of one impact, with [scene], but has [system]"),
    ("masses_kg", "masses", "[scene] must have the key `masses_kg`, but has masses"),
    ("[law]", "gravity = 9.81\n[law]", "[scene] may have the keys masses_kg, wall, gaps_m"),
    ('"Newton"', '"Aristotle"', "the law must be one of"),
    ('name = "Newton"', "", "[law] must have the key `name`"),
    ("restitution = 0.9", "restitution = 1.9", "`restitution` must lie in [0, 1], but has value 1.9"),
    ("restitution = 0.9", 'restitution = "high"', "`restitution` must be numeric"),
    ("restitution = 0.9", "restitution = true", "`restitution` must be numeric"),
    ("[1.0, 1.0]", "[1.0, -1.0]", "`masses` must lie in (0, inf), but has value -1 at index 1"),
    ("[1.0, 1.0]", "[1.0, 1.0]\nwall = [1]", "`wall` must be one of False, True, right, left, both, but has"),
    ("[1.0, 1.0]", "[1.0, 1.0, 1.0]", "it has 2 a shot, but the scene has 3"),
    ('["restitution"]', "1", "`free` must be a list of names or a table of masks"),
    ("shots.csv", "none.csv", "none.csv' does not exist"),
    ("file =", "path =", "[data] must have the key `file`"),
    ('"shots.csv"', "3", "`file` in [data] must be a path, but is 3"),
    ("[scene]", "[scene", "must be a TOML file"),
    ("[scene]\nmasses_kg = [1.0, 1.0]\n", "scene = 1\n", "`scene` must be a table, but is 1"),
    ('[data]\nfile = "shots.csv"\n', "", "[data]"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "message"), REFUSED)
def test_fit_refuses(tmp_path, capsys, old, new, message):
    assert old in STUDY
    code, said = call(capsys, "fit", written(tmp_path, STUDY.replace(old, new)))
    assert code == 2
    assert said.err.startswith("jimpact fit: ")
    assert message in said.err
    assert said.err.count("\n") == 1
    assert said.out == ""


def test_fit_refuses_data(tmp_path, capsys):
    path = written(tmp_path, STUDY, SHOTS.replace("0.21,", "fast,"))
    code, said = call(capsys, "fit", path)
    assert code == 2
    assert (
        "shots.csv, line 2, column `post_1[m/s]`: the value must be a number"
        in said.err
    )


@pytest.mark.release
def test_compare(tmp_path, capsys):
    code, said = call(capsys, "compare", "--out", tmp_path, "--json")
    result = json.loads(said.out)
    assert code == 0
    np.testing.assert_allclose(
        result["laws"]["moreau"]["velocity"], [-0.3, 0.65, 0.65], atol=1e-12
    )
    assert set(result["laws"]) >= {"lzb", "newton", "moreau", "poisson", "binary"}
    assert (tmp_path / "jimpact-compare.png").stat().st_size > 10_000
    code, said = call(capsys, "compare", "--csv", "--out", tmp_path / "b.png")
    (row,) = [x for x in csv.DictReader(said.out.splitlines()) if x["law"] == "moreau"]
    np.testing.assert_allclose(float(row["v_3_plus"]), 0.65, atol=1e-12)
    code, said = call(
        capsys, "compare", "--velocity", "2", "0", "0", "--out", tmp_path / "a.svg"
    )
    assert code == 0
    assert "measured" not in said.out
    assert "-0.6000" in said.out
    assert "Dispersion: 0" in said.out
    assert "Rank: " not in said.out


def test_montecarlo(tmp_path, capsys):
    path = written(tmp_path, SAMPLED)
    code, said = call(capsys, "montecarlo", path, "--out", tmp_path / "new")
    assert code == 0
    assert "600 samples of Binary, 3 coordinates, 2 contacts" in said.out
    assert "v- = (1, 0, -1) m/s" in " ".join(said.out.split())
    assert "ok: 600" in said.out
    assert (tmp_path / "new" / "jimpact-montecarlo-study.png").stat().st_size > 10_000
    options = ["--json", "--out", "a.svg", "--folder", "run", "--keep-samples"]
    first = json.loads(call(capsys, "montecarlo", path, *options)[1].out)
    more = json.loads(
        call(capsys, "montecarlo", path, *options, "--samples", "700")[1].out
    )
    assert (first["samples"], more["samples"], more["resumed"]) == (600, 700, 512)
    code, said = call(capsys, "montecarlo", path, *options, "--seed", "6")
    assert code == 2
    assert "holds another run, which differs in key" in said.err


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("seed = 5", "seeds = 5", "[monte_carlo] may have the keys velocity_m_per_s"),
        (
            "velocity_m_per_s = [1.0, 0.0, -1.0]",
            "",
            "must have the key `velocity_m_per_s`",
        ),
        (
            "low = 0.0",
            "least = 0.0",
            "`gaps_m` in [monte_carlo] must have low and high, or mean",
        ),
        ("low = 0.0", "low = -1.0", "initial_energy"),
        ("samples = 600", "samples = 0", "`samples` must be an int >= 1"),
        ("samples = 600", "law = 3", "[monte_carlo.law] must be a table"),
        ('order = "earliest"', 'order = "latest"', "`order` must be"),
        ("[monte_carlo]\n", "[montecarlo]\n", "may have the keys"),
    ],
)
def test_montecarlo_refuses(tmp_path, capsys, old, new, message):
    assert old in SAMPLED
    code, said = call(
        capsys, "montecarlo", written(tmp_path, SAMPLED.replace(old, new))
    )
    assert code == 2
    assert said.err.startswith("jimpact montecarlo: ")
    assert message in said.err


def test_failed_samples_are_reported_on_stderr(tmp_path, capsys):
    """Newton's law lets contacts pull, for some of these velocities."""
    text = SAMPLED[: SAMPLED.index("[monte_carlo.gaps_m]")].replace("binary", "newton")
    text = text.replace('order = "earliest"', "").replace(
        "[1.0, 0.0, -1.0]", "{ mean = [1.0, 0.0, -1.0], std = 1.0 }"
    )
    code, said = call(capsys, "montecarlo", written(tmp_path, text), "--out", tmp_path)
    assert code == 0
    assert "of 600 samples failed and are left out of the statistics" in said.err
    assert ", left out (" in said.out


@pytest.mark.release
def test_simulate(tmp_path, capsys):
    options = ["--out", "m.png", "--gif", "m.gif", "--portrait", "p.svg", "--json"]
    short = ["--t-end", "0.3", "--samples", "11", "--coordinate", "3"]
    code, said = call(capsys, "simulate", "shaken_dimer.toml", *options, *short)
    result = json.loads(said.out)
    assert (code, result["status"]) == (0, "ok")
    assert np.shape(result["q"]) == (11, 3)
    assert len(result["events"]["time"]) == len(result["events"]["kind"]) > 3
    assert "impact" in result["events"]["kind"]
    assert (tmp_path / "m.png").stat().st_size > 10_000
    assert (tmp_path / "m.gif").read_bytes().startswith(b"GIF89a")
    assert "svg" in (tmp_path / "p.svg").read_text()[:200]


@pytest.mark.slow
def test_the_study_of_the_documents(tmp_path):
    text = (Path(__file__).parents[2] / "docs" / "motions.md").read_text(
        encoding="utf-8"
    )
    (block,) = re.findall(r"```toml\n(.*?)```", text, re.S)
    study = ji.read_study(written(tmp_path, block))
    gaps = study.system.body.gap_function(np.array(study.arguments["q0"]))
    np.testing.assert_allclose(gaps, [0.0, 0.0, 0.6, 0.6, 0.0, 0.1], atol=1e-12)


@pytest.mark.parametrize("name", ["rocking_block", "discs_in_a_box", "tossed_brick"])
def test_bundled_motions_begin_without_penetration(name):
    study = ji.read_study(f"{name}.toml")
    q = np.array(study.arguments["q0"])
    assert study.system.body.gap_function(q).min() >= 0
    assert len(study.arguments["v0"]) == len(study.system.body.velocity_names)


def test_motions_of_several_bodies_and_a_base_in_space(tmp_path):
    bodies = MOTION.replace("width_m = 0.2\nheight_m = 0.6\n", f"{BODIES['Bodies']}\n")
    bodies = bodies.replace('kind = "block"', 'kind = "Bodies"').replace(
        "horizontal", "vertical"
    )
    system = ji.read_study(written(tmp_path, bodies)).system
    assert system.body.rims[0] == 0.1
    np.testing.assert_array_equal(system.base_directions, [[0.0], [1.0], [0.0]])
    floating = MOTION.replace("block", "sphere").replace(
        "width_m = 0.2\nheight_m = 0.6", "radius_m = 1"
    )
    floating = floating.replace('"horizontal"', '"y"').replace(
        "[base]", "gravity_m_per_s2 = 0\n[base]"
    )
    system = ji.read_study(written(tmp_path, floating)).system
    assert system.potential is None
    np.testing.assert_array_equal(system.base_directions, np.eye(6)[:, 1:2])
    hanging = "kind = 'pendulumcradle'\n" + BODIES["PendulumCradle"]
    hanging = MOTION.replace('kind = "block"\nwidth_m = 0.2\nheight_m = 0.6', hanging)
    with pytest.raises(ValueError, match="a PendulumCradle has no base"):
        ji.read_study(written(tmp_path, hanging))


ON_GROUND = STUDY.replace("masses_kg = [1.0, 1.0]", """
kind = "Block"
width_m = 0.2
height_m = 0.6
q = [0.0, 0.3, 0.0]""")  # fmt: skip


TILTED = """pre_1[m/s],pre_2[m/s],pre_3[rad/s],post_1[m/s],post_2[m/s],post_3[rad/s]
0,-1,0,0,0.5,0\n0,-2,0,0,1.0,0
"""


@pytest.mark.slow
def test_fit_of_a_body(tmp_path, capsys):
    """A block that falls flat on its base, e = 0.5; the same tables as of a motion."""
    path = written(tmp_path, ON_GROUND, TILTED)
    block = ji.Block(0.2, 0.6)
    np.testing.assert_array_equal(
        ji.read_study(path).scene.normals, block.scene(block.touching()).normals
    )
    code, said = call(capsys, "fit", path, "--json")
    assert code == 0
    parameter = json.loads(said.out)["fits"]["as measured"]["parameters"][0]
    np.testing.assert_allclose(parameter["value"], 0.5, atol=1e-6)
    for old, new, message in (
        ("q = [0.0, 0.3, 0.0]", "", "[scene] must have the key `q`"),
        ("width_m = 0.2", "masses_kg = 1", "[scene] must have the key `width_m`"),
        ("0.3, 0.0]", "0.2, 0.0]", "must have no penetration"),
    ):
        code, said = call(
            capsys, "fit", written(tmp_path, ON_GROUND.replace(old, new), TILTED)
        )
        assert code == 2
        assert message in said.err


@pytest.mark.release
def test_compare_of_a_body(tmp_path, capsys):
    code, said = call(capsys, "compare", written(tmp_path, ON_GROUND, TILTED), "--json")
    assert code == 0
    result = json.loads(said.out)["laws"]["newton"]["velocity"]
    np.testing.assert_allclose(result, [0.0, 0.9, 0.0], atol=1e-9)


@pytest.mark.release
def test_simulate_in_space(tmp_path, capsys):
    """A bundled study by time stepping: the picture has its name; replacing it is reported."""
    study = (files("jimpact") / "data" / "tossed_brick.toml").read_text()
    path = written(tmp_path, study.replace("t_end_s = 1.5", "t_end_s = 0.02"))
    options = ["--samples", "3", "--gif", "m.gif", "--portrait", "p.svg"]
    code, said = call(capsys, "simulate", path, *options)
    assert code == 0
    assert "replaced" not in said.err
    assert "nothing did work" in said.out
    assert "Picture: jimpact-simulate-study.png" in said.out
    assert (tmp_path / "m.gif").read_bytes().startswith(b"GIF89a")
    code, said = call(capsys, "simulate", path, "--samples", "3")
    assert code == 0
    assert (
        "jimpact simulate: jimpact-simulate-study.png existed and was replaced.\n"
        in said.err
    )


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            'kind = "block"',
            'kind = "car"',
            "must be one of Block, Bodies, Box,",
        ),
        ('kind = "block"', 'kind = "bodies"', "[system] must have the key `bodies`"),
        ('kind = "block"', 'kind = "pendulumcradle"', "must have the key `masses_kg`"),
        (
            "width_m",
            "width",
            "[system] must have the key `width_m`, but has kind, width",
        ),
        (
            "width_m",
            "depth_m = 1.0\nwidth_m",
            "may have the keys kind, width_m, height_m, mass_kg",
        ),
        (
            '"horizontal"',
            '"line"',
            "`direction` of a Block must be horizontal or vertical",
        ),
        ("amplitude_m", "size_m", "[base] must have the key `amplitude_m`"),
        ("t_end_s", "t_end", "must have the key `t_end_s`"),
        ("[law]", "[laws]", "must have the key `law`"),
        ("[law]", "[fit]\nfree = ['restituton']\n[law]", "Did you mean restitution?"),
        ("0.2\nheight", "-0.2\nheight", "`width` must lie in"),
        ("0.3, 0.0]", "0.2, 0.0]", "must have no penetration"),
    ],
)
def test_simulate_refuses(tmp_path, capsys, old, new, message):
    assert old in MOTION
    code, said = call(capsys, "simulate", written(tmp_path, MOTION.replace(old, new)))
    assert code == 2
    assert message in said.err


@pytest.mark.slow
def test_advice_leaves_out_contacts_that_a_chain_does_not_need(tmp_path, capsys):
    study = tmp_path / "light_end.toml"
    study.write_text(
        "[scene]\nmasses_kg = [1.0, 1.2, 1.0, 2e-5]\n"
        '[law]\nname = "lzb"\nrestitution = 0.8\nstiffness = [1.0, 1.0, 1.0]\n'
    )
    speeds = ("--velocity", "1", "0", "0", "0")
    code, said = call(capsys, "advise", str(study), *speeds)
    assert code == 0
    assert re.search(r"2 of 3 contacts suffice within 1 %", said.out)
    code, said = call(capsys, "advise", str(study), *speeds, "--json")
    scene = json.loads(said.out)["simplest_scene"]
    assert (scene["kept"], scene["error"] < 0.01) == ([1, 2], True)


@pytest.mark.slow
def test_advise(tmp_path, capsys):
    code, said = call(capsys, "advise", "--samples", "32", "--out", tmp_path, "--json")
    result = json.loads(said.out)
    assert (code, result["advice"], result["within"]) == (0, "lzb", True)
    assert result["laws"]["binary"]["worst"] > 0.01
    assert (tmp_path / "jimpact-advise.png").stat().st_size > 10_000


@pytest.mark.slow
def test_chart(tmp_path, capsys):
    options = ["--batch", "4", "--repeats", "1", "--methods", "verlet"]
    code, said = call(capsys, "chart", *options, "--out", tmp_path, "--json")
    result = json.loads(said.out)
    assert code == 0
    assert {"verlet", "moreau", "binary"} == set(result["points"])
    assert (tmp_path / "jimpact-chart.png").stat().st_size > 10_000


@pytest.mark.release
def test_stability(tmp_path, capsys):
    code, said = call(
        capsys, "stability", "--methods", "verlet", "--out", tmp_path, "--json"
    )
    assert code == 0
    assert json.loads(said.out)["methods"]["verlet"]["counts"]["right"] > 3


def test_bare_call_greets(capsys):
    code, said = call(capsys)
    assert code == 0
    for verb in (*VERBS, "new", "laws"):
        assert f"{verb}" in said.out
    assert max(map(len, said.out.splitlines())) <= 80


@pytest.mark.parametrize("kind", ["fit", "compare", "montecarlo", "simulate"])
def test_a_new_study(tmp_path, capsys, kind):
    """What `jimpact new` writes is read, runs up to the numbers, and is never replaced."""
    code, said = call(capsys, "new", kind)
    assert (code, f"Next: jimpact {kind} my_{kind}" in said.out) == (0, True)
    study = tmp_path / f"my_{kind}" / "study.toml"
    if kind == "simulate":
        assert ji.read_study(study).title
    else:
        assert (ji.read_study(study).experiments is None) == (kind == "montecarlo")
    cells = nbformat.read(study.with_suffix(".ipynb"), as_version=4).cells
    code_cells = [cell.source for cell in cells if cell.cell_type == "code"]
    for source in code_cells:
        for name in re.findall(r"\bji\.(\w+)", source):
            assert hasattr(ji, name)
    code, said = call(capsys, "new", kind)
    assert code == 2
    assert "exist already" in said.err


def test_a_new_study_like_another(tmp_path, capsys):
    assert (
        call(capsys, "new", "simulate", "block", "--like", "rocking_block.toml")[0] == 0
    )
    assert ji.read_study("block").system.body.names[2] == "angle [rad]"
    assert call(capsys, "new", "fit", "carts", "--like", "air_track.toml")[0] == 0
    assert len(ji.read_study("carts").experiments.shots) == 5
    code, said = call(capsys, "new", "simulate", "--like", "block.toml")
    assert (code, "bundled studies are cradle_motion.toml" in said.err) == (2, True)


@pytest.mark.release
@pytest.mark.parametrize("kind", ["fit", "compare", "montecarlo", "simulate"])
def test_the_notebook_of_a_new_study_runs(tmp_path, capsys, kind):
    assert call(capsys, "new", kind, ".")[0] == 0
    place = {"metadata": {"path": str(tmp_path)}}
    notebook = nbformat.read(tmp_path / "study.ipynb", as_version=4)
    nbclient.NotebookClient(
        notebook, timeout=None, kernel_name="python3", resources=place
    ).execute()


def test_messages_name_the_help_of_their_command(capsys):
    for arguments in (["--starts", "x"], ["--nonsense"]):
        with pytest.raises(SystemExit):
            call(capsys, "fit", *arguments)
        assert "jimpact fit --help" in " ".join(capsys.readouterr().err.split())


def test_laws(capsys, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    result = call(capsys, "laws")[1].out
    assert "restitution" in result
    assert max(map(len, result.splitlines())) <= 80
    assert set(json.loads(call(capsys, "laws", "--json")[1].out)) == set(ji.REGISTRY)
    rows = list(csv.DictReader(call(capsys, "laws", "--csv")[1].out.splitlines()))
    assert [row["law"] for row in rows] == list(ji.REGISTRY)
    assert rows[0]["source"] == ji.REGISTRY["lzb"].source
    (tmp_path / "empty_module.py").write_text("")
    again = call(capsys, "laws", "--module", str(tmp_path / "empty_module.py"))[1].out
    assert again == result
    assert call(capsys, "laws", "--bibtex")[1].out.count("@book{brogliato2016") == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["fit", "nowhere.toml"], "Study 'nowhere.toml' does not exist"),
        (["fit", "--out", "fit.docx"], "--out must end in .png, .pdf or .svg"),
        (["fit", "--limit", "0"], "--limit must be > 0 seconds"),
        (["fit", "--json", "--csv"], "--json and --csv must not both be given"),
        (["fit", "--law", "aristotle"], "fit: Argument `law` must be one of"),
        (["compare", "--shot", "2"], "--shot must lie in [1, 1], but is 2"),
        (["compare", "--velocity", "1", "0"], "`velocity` must have shape (3,)"),
        (["compare", "--velocity", "1", "nan", "0"], "`velocity` must be finite"),
        (["compare", "--out", "a.txt"], "--out must end in"),
        (["compare", "nowhere.toml"], "does not exist"),
        (["montecarlo", "three_balls.toml"], "must have a [monte_carlo] table"),
        (
            ["montecarlo", "--executor", "dusk"],
            "`executor` must be one of threads, serial, devices, dask",
        ),
        (["montecarlo", "--out", "picture.txt"], "--out must end in"),
        (["simulate", "nothing.toml"], "cradle_motion.toml, discs_in_a_box.toml"),
        (["simulate", "--out", "picture.jpg"], "--out must end in .png"),
        (["simulate", "--portrait", "portrait.gif"], "--portrait must end in .png"),
        (["simulate", "--portrait", "jimpact-simulate.png"], "must be two files"),
        (["simulate", "--gif", "motion.mp4"], "--gif must end in .gif"),
        (["advise", "--tolerance", "2"], "`tolerance` must lie in"),
        (["advise", "--shot", "2"], "--shot must lie in [1, 1]"),
        (["advise", "--stiffness-range", "2", "1"], "low <= high"),
        (["chart", "--methods", "magic"], "`methods` must be one of"),
        (["chart", "--shot", "2"], "--shot must lie in [1, 1], but is 2"),
        (["chart", "three_balls_gaps.toml"], "--velocity must be given"),
        (["stability", "--methods", "rk5"], "`methods` must be one of"),
    ],
)
def test_refused(capsys, arguments, message):
    code, said = call(capsys, *arguments)
    assert code == 2
    assert said.err.startswith(f"jimpact {arguments[0]}: ")
    assert message in said.err
    assert said.err.count("\n") == 1


MISSPELLED = [
    (["fti"], "jimpact: the command must be one of fit, compare", "Did you mean fit?"),
    (["fit", "--law", "Newtn"], "`law` must be one of lzb", "Did you mean newton?"),
    (["fit", "--method", "adm"], "`method` must be one of", "Did you mean adam?"),
    (["fit", "three_bals.toml"], "does not exist", "Did you mean three_balls.toml?"),
    (
        ["chart", "--methods", "verlt"],
        "`methods` must be one of",
        "Did you mean verlet?",
    ),
]


MISSPELLED_KEYS = [
    (
        "restitution =",
        "restituton =",
        "[law] may have the keys",
        "Did you mean restitution?",
    ),
    (
        'free = ["restitution"]',
        "free = ['friktion']",
        "`free` must name",
        "Did you mean friction?",
    ),
    ("starts = 2", "losss = 'huber'", "[fit] may have the keys", "Did you mean loss?"),
    ("starts = 2", "loss = 'hubber'", "`loss` must be one of", "Did you mean huber?"),
    ('"Newton"', '"mureau"', "the law must be one of", "Did you mean moreau?"),
]


@pytest.mark.parametrize(("arguments", "message", "advice"), MISSPELLED)
def test_misspelled_words_get_a_suggestion(capsys, arguments, message, advice):
    code, said = call(capsys, *arguments)
    assert code == 2
    assert message in said.err
    assert said.err.endswith(f"{advice}\n")


@pytest.mark.parametrize(("old", "new", "message", "advice"), MISSPELLED_KEYS)
def test_misspelled_keys_get_a_suggestion(tmp_path, capsys, old, new, message, advice):
    assert old in STUDY
    code, said = call(capsys, "fit", written(tmp_path, STUDY.replace(old, new)))
    assert code == 2
    assert message in said.err
    assert said.err.endswith(f"{advice}\n")


def test_a_folder_without_a_study(tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    code, said = call(capsys, "fit", "empty")
    assert (code, "Folder 'empty' holds no study" in said.err) == (2, True)
    assert "Study 'nowhere' does not exist" in call(capsys, "fit", "nowhere")[1].err


def test_nan_cells_are_reported_once(tmp_path, capsys):
    shots = SHOTS.replace("0.21,", "NaN,")
    path = written(tmp_path, STUDY, shots)
    _, said = call(
        capsys, "compare", path, "--velocity", "0", "0"
    )  # read twice, then refused
    assert (
        said.err.count("shots.csv, line 2, column `post_1[m/s]`: the cell is NaN") == 1
    )


@pytest.mark.parametrize("velocity", [["0", "0", "0"], ["-1", "0", "1"]])
def test_velocities_without_an_impact_are_refused(capsys, velocity):
    code, said = call(capsys, "compare", "--velocity", *velocity)
    assert code == 2
    assert "no contact closes" in said.err


def test_wrong_options_are_reported_before_jax_is_imported(tmp_path):
    """Version, help, and wrong options, one process for all."""
    calls = [
        ["--version"],
        ["--help"],
        ["fti"],
        ["fit", "--limit", "0"],
        ["fit", "--out", "a.txt"],
    ]
    calls += [["montecarlo", "--executor", "dusk"]]
    code = (
        "import sys\nfrom jimpact.cli.main import main\n"
        f"for arguments in {calls}:\n"
        "    try: print(main(arguments))\n"
        "    except SystemExit: pass\n"
        "print([m for m in ('jax', 'matplotlib', 'scipy') if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        cwd=tmp_path,
    )
    assert f"jimpact {ji.__version__}\n" in done.stdout
    assert "montecarlo" in done.stdout
    lines = done.stdout.splitlines()
    assert lines[-1] == "[]"
    assert lines[-len(calls) + 1 : -1] == ["2"] * (len(calls) - 2)
    assert done.stderr.count("\n") == len(calls) - 2


# ------------------------------------------------------------------------------- processes


def interrupted(arguments, folder, moment):
    """Exit code and stderr of a command that gets ctrl-C once `moment(process)` is true.

    The exit code is None if the command ended before.
    """
    command = [sys.executable, "-m", "jimpact.cli", *arguments]
    signal.signal(
        signal.SIGINT, signal.default_int_handler
    )  # an ignored one would be inherited
    process = subprocess.Popen(
        command,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        cwd=folder,
    )
    try:
        while process.poll() is None and not moment(process):
            time.sleep(0.02)
        ended = process.poll() is not None
        process.send_signal(signal.SIGINT)
        message = process.communicate()[1]
    finally:
        process.kill()
    return None if ended else process.returncode, message


@pytest.mark.release
def test_ctrl_c_keeps_finished_chunks(tmp_path):
    path = written(tmp_path, SAMPLED.replace("samples = 600", "samples = 100_000_000"))
    run = tmp_path / "run"
    options = ["montecarlo", path, "--folder", "run"]
    code, message = interrupted(
        options, tmp_path, lambda _: list(run.glob("chunk-*.npz"))
    )
    assert code == 130
    assert (
        "Finished chunks are in 'run': the same command continues from there."
        in message
    )
    assert "Traceback" not in message


def after_jax(seconds):
    """A moment while a command computes: so long after its process has begun to import JAX."""
    begun = []

    def moment(process):
        if not begun and "jaxlib" in Path(f"/proc/{process.pid}/maps").read_text():
            begun.append(time.monotonic())
        return begun and time.monotonic() - begun[0] >= seconds

    return moment


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="it needs /proc")
@pytest.mark.parametrize(
    "verb",
    [
        pytest.param(
            x, marks=pytest.mark.slow if x == "simulate" else pytest.mark.release
        )
        for x in VERBS
    ],
)
def test_ctrl_c_while_importing_and_compiling(verb, tmp_path, monkeypatch):
    """One line and exit code 130, whatever the command is doing then."""
    monkeypatch.delenv(
        "JAX_COMPILATION_CACHE_DIR"
    )  # so that there is something to compile
    monkeypatch.setenv("JIMPACT_CACHE", "")
    for seconds in (0.0, 1.0, 3.0):
        code, message = interrupted([verb], tmp_path, after_jax(seconds))
        if code in (None, 0):
            break  # this machine had done it all before ctrl-C
        assert code == 130
        assert message.splitlines()[-1].startswith("jimpact")
        assert "Traceback" not in message


@pytest.mark.release
def test_fit_as_a_user_runs_it(tmp_path, monkeypatch):
    """The bundled three balls: one e; corrected; all free, since asked for; a picture."""
    command = [sys.executable, "-m", "jimpact.cli", "fit", "--json", "--all-free"]
    monkeypatch.delenv("COLUMNS", raising=False)
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert all(len(line) <= 80 for line in done.stderr.splitlines())
    fits = json.loads(done.stdout)["fits"]
    for name, rms in (("as measured", 0.0166), ("momentum corrected", 0.0089)):
        np.testing.assert_allclose(
            fits[name]["parameters"][0]["value"], 0.9911, atol=1e-4
        )
        np.testing.assert_allclose(fits[name]["rms"], rms, atol=5e-5)
    assert fits["all free"]["rank"] == 2
    assert len(fits["all free"]["parameters"]) == 3
    assert "1.0422" in fits["as measured"]["warnings"][0]
    assert "1.0103" in fits["as measured"]["warnings"][1]
    assert (tmp_path / "jimpact-fit.png").stat().st_size > 10_000


def test_the_module_ends_with_the_exit_code_of_the_command():
    command = [sys.executable, "-m", "jimpact", "fti"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "Did you mean fit?" in done.stderr


SPRING = """
title = "A disc at an angle"
[scene]
kind = "Disc"
radius_m = 0.5
mass_kg = 2.0
inertia_kg_m2 = 0.2
q = [0.0, 0.5, 0.0]
[law]
name = "lzb"
restitution = 0.8
friction = 0.3
tangential_stiffness = 0.5
[fit]
free = ["restitution", "friction", "tangential_stiffness"]
starts = 6
[data]
file = "shots.csv"
"""


@pytest.mark.slow
def test_fit_of_a_tangential_spring(tmp_path, capsys):
    """Five shots without noise return e, mu and kappa."""
    scene = ji.Disc(0.5, mass=2.0, inertia=0.2).scene([0.0, 0.5, 0.0])
    law = ji.LZB(0.9, friction=0.15, tangential_stiffness=0.8)
    head = "pre_1[m/s],pre_2[m/s],pre_3[rad/s],post_1[m/s],post_2[m/s],post_3[rad/s]"
    rows = [head]
    for angle in np.radians([4.0, 9.0, 15.0, 30.0, 50.0]):
        before = np.array([np.sin(angle), -np.cos(angle), 0.0])
        after = np.asarray(ji.impact(law, scene, before).velocity)
        rows.append(",".join(f"{x:.8f}" for x in [*before, *after]))
    study = written(tmp_path, SPRING, "\n".join(rows) + "\n")
    code, said = call(capsys, "fit", study, "--json", "--out", tmp_path)
    assert code == 0
    (fit,) = json.loads(said.out)["fits"].values()
    found = [row["value"] for row in fit["parameters"]]
    np.testing.assert_allclose(found, [0.9, 0.15, 0.8], atol=1e-3)
    missing = SPRING.replace("friction = 0.3\n", "")
    code, said = call(capsys, "fit", written(tmp_path, missing, "\n".join(rows)))
    assert code == 2
    assert "friction" in said.err
