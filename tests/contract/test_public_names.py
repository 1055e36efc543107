"""Contract tests know the package by its public names only."""

import ast
from pathlib import Path

import pytest

import jimpact as ji

PUBLIC = {
    "jimpact": {*ji.__all__, "data", "plot", "theory", "tracks"},
    "jimpact.plot": set(ji.plot.__all__),
    "jimpact.theory": set(ji.theory.__all__),
    "jimpact.data": set(ji.data.__all__),
    "jimpact.tracks": set(ji.tracks.__all__),
}
MOST = 100  # names at the top
FILES = sorted(Path(__file__).parent.glob("*.py"))
HELPERS = Path(__file__).parents[1]


def imported(tree):
    """Pairs (module, name) of everything that a file imports."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            yield from ((node.module, alias.name) for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from ((alias.name, None) for alias in node.names)


def test_the_top_is_read_in_one_look():
    count = sum(not name.startswith("_") for name in ji.__all__)
    assert count <= MOST, "a new name takes the place of another one, or stays in its module"


def with_helpers(path):
    """The file and the modules of tests that it imports, directly or not; not the programs."""
    files, waiting = set(), [path]
    while waiting:
        files.add(each := waiting.pop())
        names = {module for module, _ in imported(ast.parse(each.read_text(encoding="utf-8")))}
        helpers = {HELPERS / f"{name}.py" for name in names} - files
        waiting += [
            helper for helper in helpers if helper.exists() and helper.stem != "command_line"
        ]
    return files


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_nothing_of_ours_is_reached_by_an_underscore(path):
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Attribute) and node.attr.startswith("_"):
            assert node.attr.endswith("__") or ast.unparse(node.value) == "self", ast.unparse(node)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_imports_are_public(path):
    trees = [ast.parse(each.read_text(encoding="utf-8")) for each in with_helpers(path)]
    own = [x for tree in trees for x in imported(tree) if x[0].partition(".")[0] == "jimpact"]
    private = [x for x in own if x[0] not in PUBLIC or x[1] not in {None, *PUBLIC[x[0]]}]
    assert not private
