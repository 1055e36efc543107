"""The programs that ask engines: what each states, and rows of another engine."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1] / "validation" / "engines"


@pytest.fixture
def run(monkeypatch):
    """The module of the command."""
    monkeypatch.syspath_prepend(str(FOLDER))
    return __import__("run")


def test_each_program_pins_its_engine_and_says_how_it_is_asked(run):
    assert len(run.PROGRAMS) >= 10
    for path in run.PROGRAMS.values():
        assert "==" in run.packages(path)[0], path
        tree = ast.parse(path.read_text(encoding="utf-8"))
        assert ast.get_docstring(tree), path
        functions = [line for line in tree.body if isinstance(line, ast.FunctionDef)]
        after = next(each for each in functions if each.name == "after")
        assert [x.arg for x in after.args.args[:3]] == [
            "masses",
            "wall",
            "restitution",
        ], path


def test_an_engine_that_is_not_installed_is_named(run, tmp_path, monkeypatch, capsys):
    missing = tmp_path / "engine_missing.py"
    missing.write_text(
        '# dependencies = ["no_such_engine==1.0"]\nimport no_such_engine\n'
    )
    monkeypatch.setitem(run.PROGRAMS, "missing", missing)
    assert run.measured("missing", sys.executable) == []
    assert 'pip install "no_such_engine==1.0"' in capsys.readouterr().out


HEAD = "engine,version,scene,setting,v1,v2,v3,v4,v5\n"


@pytest.mark.parametrize(
    ("line", "told"),
    [
        (
            "mine,1.0,S4,fine,-0.99,,,,",
            "line 2: S4 has 2 balls, but 1 velocities are given",
        ),
        (
            "mine,1.0,S9,fine,-0.99,0,,,",
            "line 2: `scene` must be one of .* but is 'S9'",
        ),
        ("mine,1.0,S4,fine,-0.99,nan,,,", "line 2: velocities must be finite numbers"),
        ("mine,1.0,S4,fine,-0.99,fast,,,", "line 2: velocities must be finite numbers"),
    ],
)
def test_a_row_that_does_not_fit_its_scene_is_named(run, tmp_path, line, told):
    path = tmp_path / "mine.csv"
    path.write_text(HEAD + line + "\n")
    with pytest.raises(SystemExit, match=told):
        run.added(path)


@pytest.mark.slow
def test_rows_of_another_engine_get_their_nearest_law(tmp_path):
    """Three balls by Moreau's law with e = .8: v- + 1.8 (1/3 - v-)."""
    path = tmp_path / "mine.csv"
    path.write_text(HEAD + "mine,1.0,S1,fine,-0.2,0.6,0.6,,\n")
    command = [sys.executable, FOLDER / "run.py", "--add", path]
    told = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert "Moreau, e = 0.80, off by 0.0000   not in the table" in told
