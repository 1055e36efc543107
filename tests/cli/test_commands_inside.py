"""One end-to-end call a command; what is refused is one line on stderr and exit code 2."""

import inspect
import os
import tomllib
from pathlib import Path

import numpy as np
import pytest
from commands_cases import BODIES, SHOTS, STUDY, call, written

import jimpact as ji
from jimpact import HarmonicBase
from jimpact.bodies.study import body_of
from jimpact.cli import study, study_file
from jimpact.cli.commands import _per_contact
from jimpact.cli.main import cache_folder
from jimpact.montecarlo.study import SAMPLING
from jimpact.motion import study as motion_keys


@pytest.fixture(autouse=True)
def in_its_own_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def test_a_fit_with_one_value_per_contact_keeps_the_options_of_its_law(tmp_path):
    text = STUDY.replace("[1.0, 1.0]", "[1.0, 1.0, 1.0]").replace(
        '"Newton"', '"lzb"\nrtol = 1e-5'
    )
    shots = SHOTS.replace("0.83", "0.83,0,0.1").replace("1.62", "1.62,0,0.2")
    shots = shots.replace("post_2[m/s]", "post_2[m/s],pre_3[m/s],post_3[m/s]")
    study, all_free = _per_contact(ji.read_study(written(tmp_path, text, shots)))
    assert (study.law.rtol, all_free.law.rtol) == (1e-5, 1e-5)
    np.testing.assert_array_equal(study.law.restitution, [0.9, 0.9])
    np.testing.assert_array_equal(study.free["restitution"], [1, 1])


def test_where_programs_are_kept(tmp_path, monkeypatch):
    folder = "JAX_COMPILATION_CACHE_DIR"
    for name in (
        folder,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS",
        "JIMPACT_CACHE",
    ):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    cache_folder(no_cache=False)
    assert os.environ.pop(folder).startswith(str(tmp_path / "jimpact"))
    monkeypatch.setenv("JIMPACT_CACHE", "")
    assert cache_folder(no_cache=False) is None
    monkeypatch.delenv("JIMPACT_CACHE")
    assert cache_folder(no_cache=True) is None
    assert folder not in os.environ
    monkeypatch.setenv("JIMPACT_CACHE", "mine")
    cache_folder(no_cache=False)
    monkeypatch.setenv("JIMPACT_CACHE", "other")
    cache_folder(no_cache=False)  # what is set already stays
    assert os.environ[folder].startswith("mine")


@pytest.mark.parametrize("kind", BODIES)
def test_every_body_has_a_table(kind):
    """By its constructor's arguments; its coordinates and velocities have names with units."""
    table = tomllib.loads(f"[system]\nkind = '{kind}'\n{BODIES[kind]}")["system"]
    body = body_of("[system]", table)
    assert isinstance(body, ji.Body)
    q = np.zeros(len(body.names))
    velocities = body.mass_matrix(q).shape[0]
    assert len(body.names) == (body.coordinates or velocities)
    assert len(body.velocity_names) == velocities
    assert all(name.endswith("]") for name in (*body.names, *body.velocity_names))


@pytest.mark.parametrize(
    "arguments",
    [
        ["fit", "--out", "file/a.png"],
        ["fit", "--out", "file/deep/a.png"],
        ["simulate", "--gif", "file/a.gif"],
        ["simulate", "--portrait", "file/a.png"],
        ["montecarlo", "--folder", "file/chunks"],
    ],
)
def test_unwritable_places_are_refused_before_anything_is_computed(
    tmp_path, capsys, monkeypatch, arguments
):
    (tmp_path / "file").write_text("")
    (tmp_path / "folder.html").mkdir()
    monkeypatch.setattr(
        "jimpact.cli.main.cache_folder", None
    )  # a command that runs would call it
    code, said = call(capsys, *arguments)
    assert code == 2
    assert f"{arguments[1]} must be" in said.err


@pytest.mark.parametrize(
    ("arguments", "function"),
    [
        (study.CHAIN.values(), ji.chain),
        (study.CONFIGURATION.values(), ji.Body.scene),
        (SAMPLING.values(), ji.monte_carlo),
        (motion_keys.MOTION.values(), ji.simulate),
        (set(motion_keys.METHOD.values()) - {"step"}, ji.EventDriven),
        (motion_keys.BASE.values(), HarmonicBase),
        (set(study_file.FIT) - inspect.signature(ji.Search).parameters.keys(), ji.fit),
    ],
)
def test_keys_of_studies_are_arguments_of_functions(arguments, function):
    parameters = inspect.signature(function).parameters
    passed_on = any(x.kind is x.VAR_KEYWORD for x in parameters.values())
    assert passed_on or set(arguments) <= set(parameters)


def test_nothing_imports_the_command_line():
    """But `python -m jimpact`, which is it."""
    package = Path(ji.__file__).parent
    program = package / "__main__.py"
    for path in package.rglob("*.py"):
        if path.parent.name != "cli" and path != program:
            assert "jimpact.cli" not in path.read_text(encoding="utf-8"), path
