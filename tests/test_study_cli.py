"""Studies, the command line, pictures."""

import json
import subprocess
import sys

import numpy as np
import pytest

import jimpact as ji
from jimpact.cli import main
from jimpact.study import read_study

SHOTS = "pre_1[m/s],pre_2[m/s],post_1[m/s],post_2[m/s]\n1,0,0.2,0.8\n2,0,0.4,1.6\n"
STUDY = """
[scene]
masses_kg = [1.0, 1.0]
[law]
name = "Newton"
restitution = 0.9
[fit]
free = ["restitution"]
starts = 2
[data]
file = "shots.csv"
"""


def written(tmp_path, study=STUDY, shots=SHOTS):
    (tmp_path / "shots.csv").write_text(shots)
    path = tmp_path / "study.toml"
    path.write_text(study)
    return path


# --------------------------------------------------------------------- studies


def test_a_study_is_read_and_run(tmp_path):
    study = read_study(written(tmp_path))
    assert study.title == "study"
    assert study.options == {"starts": 2}
    found = study.run()
    np.testing.assert_allclose(found.value, [0.6], rtol=1e-8)
    assert sum(start.count for start in found.starts) == 2
    assert sum(start.count for start in study.run(starts=3, method=None).starts) == 3


def test_everything_a_study_can_say(tmp_path):
    text = """
    title = "column"
    [scene]
    masses_kg = [1, 2]
    wall = true
    gaps_m = [0.0, 1e-6]
    [law]
    name = "lzb"
    restitution = [0.9, 0.8]
    stiffness = [1.0, 3.0]
    exponent = [1.5, 1.0]
    initial_energy = 0.0
    [law.bounds]
    stiffness = [0.5, 5.0]
    [fit]
    free = { restitution = [1, 1], stiffness = [false, true] }
    method = "adam"
    seed = 3
    max_steps = 20
    [data]
    file = "shots.csv"
    momentum_corrected = true
    """
    study = read_study(written(tmp_path, text))
    assert study.scene.contacts == 2
    assert study.law.exponent == (1.5, 1.0)
    np.testing.assert_array_equal(study.law.restitution, [0.9, 0.8])
    assert study.bounds == {"stiffness": [0.5, 5.0]}
    assert study.options == {"method": "adam", "seed": 3, "max_steps": 20}
    assert study.free == {"restitution": [1, 1], "stiffness": [False, True]}


def test_a_free_exponent_becomes_a_parameter(tmp_path):
    text = STUDY.replace('"Newton"', '"lzb"\nexponent = 1.4').replace(
        "free = [", 'free = ["exponent", '
    )
    study = read_study(written(tmp_path, text))
    assert study.law.exponent.shape == ()
    assert float(study.law.exponent) == 1.4


def test_momentum_corrected(tmp_path):
    shots = SHOTS.replace("0.2,0.8", "0.3,0.9")
    path = written(tmp_path, STUDY + "momentum_corrected = true\n", shots)
    np.testing.assert_allclose(read_study(path).experiments.post[0], [0.2, 0.8], atol=1e-15)


def test_another_law_takes_what_it_knows():
    study = read_study("three_balls.toml", law="newton")
    assert isinstance(study.law, ji.Newton)
    assert float(study.law.restitution) == 0.95
    assert study.free == {"restitution": True}


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[scene]", "[scenery]", r"the study must have the key `scene`"),
        ("[fit]", "[fit]\ntolerance = 1", r"\[fit\] may have the keys free, method, .*`tolerance`"),
        ("masses_kg", "masses", r"\[scene\] must have the key `masses_kg`, but has masses"),
        ("[law]", "gravity = 9.81\n[law]", r"\[scene\] may have the keys masses_kg, wall, gaps_m, but has `gravity`"),
        ("restitution = 0.9", "restitution = 0.9\nstiffness = 1.0", r"\[law\] may have the keys restitution, name, bounds"),
        ('"Newton"', '"Aristotle"', r"the law must be one of .*newton.*'aristotle'"),
        ('name = "Newton"', "", r"\[law\] must have the key `name`"),
        ("restitution = 0.9", "restitution = 1.9", r"`restitution` must lie in \[0, 1\], but has value 1.9"),
        ("restitution = 0.9", 'restitution = "high"', r"`restitution` must be numeric"),
        ("[1.0, 1.0]", "[1.0, -1.0]", r"`masses` must lie in \(0, inf\), but has value -1 at index 1"),
        ("[1.0, 1.0]", "[1.0, 1.0]\nwall = [1]", r"`wall` must be true, false or a side"),
        ("[1.0, 1.0]", "[1.0, 1.0, 1.0]", r"it has 2 a shot, but the scene has 3"),
        ('["restitution"]', "1", r"`free` must be a list of names or a table of masks"),
        ("shots.csv", "none.csv", r"none.csv' does not exist"),
        ("file =", "path =", r"\[data\] must have the key `file`"),
        ("[scene]", "[scene", r"must be a TOML file"),
        ("[fit]", "[law.bounds]\nmass = [0, 1]\n[fit]", r"\[law.bounds\] may have the keys restitution, but has `mass`"),
        ("[scene]\nmasses_kg = [1.0, 1.0]\n", "scene = 1\n", r"`scene` must be a table, but is 1"),
    ],
)  # fmt: skip
def test_bad_studies(tmp_path, old, new, message):
    assert old in STUDY
    path = written(tmp_path, STUDY.replace(old, new))
    with pytest.raises((ValueError, TypeError, FileNotFoundError), match=message):
        read_study(path)


def test_bad_study_path():
    with pytest.raises(FileNotFoundError, match=r"bundled studies are air_track.toml, three_balls"):
        read_study("nowhere.toml")


# --------------------------------------------------------------------- command line


@pytest.fixture(scope="module")
def bundled(tmp_path_factory):
    """`jimpact fit --json` on the bundled balls, run as a user runs it."""
    folder = tmp_path_factory.mktemp("bundled")
    command = [sys.executable, "-m", "jimpact.cli", "fit", "--json"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    return json.loads(done.stdout), folder


def test_bundled_fit(bundled):
    told, folder = bundled
    fits = told["fits"]
    measured, corrected = fits["as measured"], fits["momentum corrected"]
    for fit, rms in ((measured, 0.0166), (corrected, 0.0089)):
        np.testing.assert_allclose(fit["parameters"][0]["value"], 0.9911, atol=1e-4)
        np.testing.assert_allclose(fit["rms"], rms, atol=5e-5)
    assert fits["all free"]["rank"] == 2
    assert len(fits["all free"]["parameters"]) == 3
    np.testing.assert_allclose(fits["Newton"]["parameters"][0]["value"], 0.61185, atol=1e-5)
    assert "1.0422" in measured["warnings"][0]
    assert "1.0103" in measured["warnings"][1]
    assert (folder / "jimpact-fit.png").stat().st_size > 10_000


def test_report_and_picture_of_a_study(tmp_path, capsys):
    path = written(tmp_path, STUDY, SHOTS.replace("0.2,0.8", "0.21,0.83"))
    assert main(["fit", str(path), "--out", str(tmp_path / "deep" / "a.svg"), "--seed", "1"]) == 0
    out = capsys.readouterr().out
    for words in ("study", "as measured", "corrected ", "restitution", "Warnings", "Picture: "):
        assert words in out
    assert (tmp_path / "deep" / "a.svg").read_text().startswith("<?xml")


def test_command_line_options(tmp_path, capsys):
    path = written(tmp_path)
    arguments = ["--law", "newton", "--method", "adam", "--starts", "1", "--json"]
    assert main(["fit", str(path), "--out", str(tmp_path), *arguments]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["fits"]["as measured"]["method"] == "adam"
    assert (tmp_path / "jimpact-fit.png").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere.toml"], "Study 'nowhere.toml' does not exist"),
        (["--out", "fit.docx"], "--out must end in .png, .pdf or .svg"),
        (["--law", "aristotle"], "the law must be one of"),
    ],
)
def test_bad_calls_are_one_line_and_exit_2(arguments, message, capsys):
    assert main(["fit", *arguments]) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.startswith("jimpact fit: ")
    assert message in told.err
    assert told.err.count("\n") == 1


def test_bad_data_are_one_line_and_exit_2(tmp_path, capsys):
    path = written(tmp_path, STUDY, SHOTS.replace("0.2,", "fast,"))
    assert main(["fit", str(path), "--out", str(tmp_path)]) == 2
    told = capsys.readouterr().err
    assert "shots.csv, line 2, column `post_1[m/s]`: the value must be a number" in told


def test_laws(capsys):
    assert main(["laws"]) == 0
    assert "restitution" in capsys.readouterr().out
    assert main(["laws", "--json"]) == 0
    assert set(json.loads(capsys.readouterr().out)) == set(ji.REGISTRY)
    assert main(["laws", "--bibtex"]) == 0
    assert capsys.readouterr().out.count("@book{brogliato2016") == 1


def test_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"jimpact {ji.__version__}\n"


def test_help_does_not_import_jax():
    code = (
        "import sys\nfrom jimpact.cli import main\n"
        "try: main(['--help'])\n"
        "except SystemExit: pass\n"
        "print([m for m in ('jax', 'matplotlib', 'numpy', 'scipy') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "fit" in done.stdout
    assert done.stdout.splitlines()[-1] == "[]"


# --------------------------------------------------------------------- pictures


@pytest.mark.parametrize("shots", [1, 2, 50])
def test_pictures_are_drawn_for_few_and_many_shots(shots, tmp_path):
    rng = np.random.default_rng(0)
    pre = np.stack([rng.uniform(1, 2, shots), np.zeros(shots)], axis=1)
    post = np.array([ji.impact(ji.Newton(0.6), ji.chain([1.0, 1.0]), v).velocity for v in pre])
    post = post + 0.01 * rng.normal(size=post.shape)
    if shots > 1:
        post[0, 0] = np.nan
    found = ji.fit(ji.Newton(0.5), ji.chain([1.0, 1.0]), ji.Experiments(pre, post), starts=1)
    figure = ji.plot.fit(found, {"the same": found}, title="simulated")
    top, bottom = figure.axes
    assert top.get_ylabel().endswith("[m/s]")
    assert bottom.get_ylabel().endswith("[m/s]")
    labels = bottom.get_xticklabels()
    assert len(labels) == {1: 2, 2: 2, 50: 13}[shots]
    figure.savefig(tmp_path / "fit.png")
