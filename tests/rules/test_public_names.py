"""Tests know the package by its public names only, but those of a file X_inside."""

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
TESTS = Path(__file__).parents[1]
# what is named `_inside` tests the inside of a room, and goes with it
FILES = [
    path
    for path in sorted(TESTS.glob("*/test_*.py"))
    if not path.stem.endswith("_inside")
]
PROGRAMS = (
    "benchmarks",
    "chapter",
    "validation",
)  # folders of programs, which may look inside
HELPERS = {
    path.stem: path
    for path in (*TESTS.glob("*.py"), *TESTS.glob("*/*.py"))
    if path.parent.name not in PROGRAMS and path.stem != "command_line"
}


def imported(tree):
    """Pairs (module, name) of everything that a file imports."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            yield from ((node.module, alias.name) for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from ((alias.name, None) for alias in node.names)


def test_the_top_is_read_in_one_look():
    count = sum(not name.startswith("_") for name in ji.__all__)
    assert count <= MOST, (
        "a new name takes the place of another one, or stays in its module"
    )


def with_helpers(path):
    """The file and the modules of tests that it imports, directly or not; not the programs."""
    files, waiting = set(), [path]
    while waiting:
        files.add(each := waiting.pop())
        names = {
            module
            for module, _ in imported(ast.parse(each.read_text(encoding="utf-8")))
        }
        waiting += {HELPERS[name] for name in names & HELPERS.keys()} - files
    return files


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_nothing_of_ours_is_reached_by_an_underscore(path):
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Attribute) and node.attr.startswith("_"):
            assert node.attr.endswith("__") or ast.unparse(node.value) == "self", (
                ast.unparse(node)
            )


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_imports_are_public(path):
    trees = [ast.parse(each.read_text(encoding="utf-8")) for each in with_helpers(path)]
    own = [
        x
        for tree in trees
        for x in imported(tree)
        if x[0].partition(".")[0] == "jimpact"
    ]
    private = [
        x for x in own if x[0] not in PUBLIC or x[1] not in {None, *PUBLIC[x[0]]}
    ]
    assert not private
