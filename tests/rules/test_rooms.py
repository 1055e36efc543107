"""The house: each room imports from the storeys below it, by stated names, and can stand alone."""

import ast
import functools
import importlib.util
import json
import re
import shutil
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import pytest

import jimpact as ji

PACKAGE = Path(ji.__file__).parent
ROOT = PACKAGE.parent


def table():
    spec = importlib.util.spec_from_file_location("pages", ROOT / "docs" / "pages.py")
    pages = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(pages)
    return pages


PAGES = table()
STOREY = {room: -row for row, rooms in enumerate(PAGES.ROOMS) for room, _ in rooms}


def room_of(module):
    return module.split(".")[1] if "." in module else ""


@functools.cache
def imports_of(path):
    """(module, name, line) of what a file imports from the package, inside functions, too."""
    return tuple(imports_in(path))


def imports_in(path):
    """The same, one after another."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            rows = [(alias.name, "") for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and not node.level:
            rows = [(node.module, alias.name) for alias in node.names]
        else:
            continue
        for module, name in rows:
            if (
                name
                and (PACKAGE.parent / f"{module}.{name}".replace(".", "/"))
                .with_suffix(".py")
                .exists()
            ):
                module, name = f"{module}.{name}", ""
            if module.partition(".")[0] == "jimpact":
                yield module, name, node.lineno


def modules(folder=PACKAGE):
    """Modules of rooms; what `python -m jimpact` runs lies above them all."""
    program = folder / "__main__.py"
    return {
        ".".join(path.relative_to(folder.parent).with_suffix("").parts): path
        for path in folder.rglob("*.py")
        if path.name != "__init__.py" and path != program
    }


def wrong_imports(files, storey=STOREY):
    """A sentence for each import that goes sideways or up."""
    for module, path in files.items():
        mine = room_of(module)
        for imported, _, line in imports_of(path):
            other = room_of(imported)
            if other not in ("", mine) and storey[other] >= storey[mine]:
                below = sorted(room for room in storey if storey[room] < storey[mine])
                yield (
                    f"{path.name}:{line}: {mine} imports {imported}, but may use only "
                    f"{', '.join(below)}"
                )


def stated_names():
    """(module, name) that the stubs of the package and of its rooms state."""
    for stub in PACKAGE.rglob("__init__.pyi"):
        base = ".".join(stub.parent.relative_to(PACKAGE.parent).parts)
        for node in ast.walk(ast.parse(stub.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom):
                module = f"{base}.{node.module}" if node.level else node.module
                yield from ((module, alias.name) for alias in node.names)


def test_every_module_has_a_room():
    assert {room_of(module) for module in modules()} == set(STOREY)


def test_imports_go_down():
    assert not list(wrong_imports(modules()))


def test_a_room_that_imports_sideways_is_told_where(tmp_path):
    wrong = tmp_path / "gaps.py"
    wrong.write_text(
        "import numpy\nfrom jimpact.core.scene import Scene\nimport jimpact.motion.system\n"
    )
    (said,) = wrong_imports({"jimpact.theory.gaps": wrong})
    assert said.startswith(
        "gaps.py:3: theory imports jimpact.motion.system, but may use only bodies, "
    )


def test_rooms_above_the_laws_use_stated_names():
    stated, above = set(stated_names()), STOREY["laws"]
    assert stated
    unstated = [
        f"{path.name}:{line}: {imported}.{name}"
        for module, path in modules().items()
        if STOREY[room_of(module)] > above
        for imported, name, line in imports_of(path)
        if room_of(imported) in PAGES.STATED and (imported, name) not in stated
    ]
    assert not unstated


def test_the_page_for_writers_of_rooms_lists_the_names_of_the_core():
    page = (ROOT / "docs" / "own_room.md").read_text(encoding="utf-8")
    stub = (PACKAGE / "core" / "__init__.pyi").read_text(encoding="utf-8")
    core = {
        alias.name
        for node in ast.parse(stub).body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    listed = set(re.findall(r"^\|.*\| `(\w+)` \| \S", page, re.MULTILINE))
    assert listed == core


def test_no_file_stands_on_itself():
    uses = defaultdict(set)
    for module, path in modules().items():
        uses[module] = {imported for imported, _, _ in imports_of(path)}
    for module in list(uses):
        reached, waiting = set(), list(uses[module])
        while waiting:
            if (each := waiting.pop()) not in reached:
                reached.add(each)
                waiting += uses[each]
        assert module not in reached


# Tests that name a room above or beside their own, and why.
ABOVE = {
    "test_tracks.py": "studies of tracks are read, their shots fitted: by `cli` and `fits`",
    "test_tracks_in_space.py": "studies of poses are read, their shots fitted: by `cli` and `fits`",
    "test_montecarlo.py": "scatter beside the linearization of `theory`",
    "test_motion_worked.py": "motions of a rocking block end where `theory` says",
}


def rooms_named(path):
    """Rooms of the public names `ji.name`, `ji.room.name`, and of the modules that a file imports."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    spaces = {"ji": PACKAGE} | {
        f"ji.{x}": PACKAGE / x for x in ("plot", "theory", "data", "tracks")
    }
    homes = {
        (space, name): home
        for space in spaces
        for name, home in homes_in(spaces[space])
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            place = ast.unparse(node.value), node.attr
            if place in homes and f"{place[0]}.{place[1]}" not in spaces:
                yield homes[place]
    yield from (room_of(module) for module, _, _ in imports_of(path) if room_of(module))


def homes_in(folder):
    """(name, room) of the names that the stub of a folder states."""
    for node in ast.parse((folder / "__init__.pyi").read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom) and node.module:
            parts = node.module.split(".")
            own = folder.name if folder != PACKAGE else parts[0]
            home = own if node.level else parts[1]
            yield from ((alias.name, home) for alias in node.names)


@pytest.mark.parametrize("room", sorted(STOREY))
def test_tests_of_a_room_name_no_room_above_or_beside_it(room):
    """Laws are the instrument of tests of what they stand on, so those rooms count as one."""
    top = max(STOREY[room], STOREY["laws"])
    allowed = {room} | {x for x in STOREY if STOREY[x] < top or x == "laws"}
    for path in sorted((ROOT / "tests" / room).glob("test_*.py")):
        if path.name not in ABOVE:
            assert set(rooms_named(path)) <= allowed, path.name


def test_loose_files_are_few():
    assert len(list((ROOT / "tests").glob("*.py"))) <= 5


ALONE = """
import importlib, json, os, sys, traceback

import diffrax, equinox, jax, matplotlib, numpy, optax, scipy, tyro  # once for all rooms


class Blocked:
    def __init__(self, rooms):
        self.rooms = rooms

    def find_spec(self, name, path=None, target=None):
        if name.split(".")[:2] in [["jimpact", room] for room in self.rooms]:
            raise ImportError(f"{name} is blocked")


def imported(blocked, modules):
    sys.meta_path.insert(0, Blocked(blocked))
    try:
        for module in modules:
            importlib.import_module(module)
    except BaseException:
        return traceback.format_exc()[-600:]
    return ""


for room, (blocked, modules) in json.loads(sys.argv[1]).items():
    reads, writes = os.pipe()
    if os.fork() == 0:  # a process in which no room has been imported yet
        os.write(writes, imported(blocked, modules).encode())
        os._exit(0)
    os.close(writes)
    with os.fdopen(reads) as said:
        print(json.dumps([room, said.read()]))
    os.wait()
"""


@pytest.fixture(scope="module")
def alone():
    """What each room says when it is imported while those beside and above it are blocked."""
    asked = {}
    for room in STOREY:
        blocked = [
            other for other in STOREY if other != room and STOREY[other] >= STOREY[room]
        ]
        own = sorted(
            m for m in modules() if room_of(m) == room and not m.endswith("__main__")
        )
        asked[room] = blocked, own
    command = [sys.executable, "-W", "ignore", "-c", ALONE, json.dumps(asked)]
    done = subprocess.run(
        command, capture_output=True, text=True, cwd=ROOT, check=False
    )
    assert done.returncode == 0, done.stderr[-600:]
    return dict(map(json.loads, done.stdout.splitlines()))


@pytest.mark.parametrize("room", sorted(STOREY))
def test_a_room_imports_while_those_beside_and_above_it_are_blocked(alone, room):
    assert not alone[room]


BARE = """
import sys

WITHOUT = {without}

class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in WITHOUT:
            raise ImportError(f"{{name}} is blocked")

sys.meta_path.insert(0, Blocked())
import jimpact as ji
from jimpact.cli.main import main

pair = ji.chain([1.0, 3.0])
out = ji.impact(ji.Newton(0.5), pair, [1.0, 0.0])
print([round(float(v), 6) for v in out.velocity])
for ask in (
    lambda: ji.plot.system,
    lambda: ji.stability_map,
    lambda: ji.Search("adagrad"),
    lambda: main(["compare"]),
):
    try:
        ask()
    except ImportError as error:
        print(error)
"""


def test_impacts_need_no_package_but_jax_and_what_it_brings():
    """Pictures, the chart, gradient descent and the command line name what they need."""
    without = ["matplotlib", "diffrax", "optax", "tyro", "rich", "platformdirs"]
    script = BARE.format(without=without)
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, cwd=ROOT
    )
    assert done.returncode == 0, done.stderr[-600:]
    velocity, *said = done.stdout.splitlines()
    assert (
        velocity == "[-0.125, 0.375]"
    )  # (m1 - e m2) / (m1 + m2), m1 (1 + e) / (m1 + m2)
    said.append(done.stderr.strip())
    for module, line in zip(without[:4], said, strict=True):
        assert (
            f"{module} must be installed for this, but is not: pip install {module}."
            in line
        )


LEFT_OUT = """
import importlib
import jax
import jimpact as ji

jax.config.update("jax_enable_x64", True)

assert ji.__file__.startswith({folder!r})
pair = ji.chain([1.0, 3.0])
out = ji.impact(ji.Newton(0.5), pair, [1.0, 0.0])
fit = ji.fit(ji.Newton(0.9), pair, ji.Experiments([[1.0, 0.0]], [out.velocity], sigma=0.01))
print(round(float(fit.value[0]), 6))
for module in {modules}:
    importlib.import_module(module)
for ask in ({asked}):
    try:
        ask()
    except (ImportError, ValueError) as error:
        print(error)
"""
# Rooms that can be left out of a copy, and what is asked for then.
ASKED = {
    "tracks": ("ji.tracks.read", "ji.plot.track", "ji.read_study('study.toml')"),
    "montecarlo": (
        "ji.monte_carlo",
        "ji.plot.monte_carlo",
        "ji.read_study('study.toml')",
    ),
    "methods": ("ji.compare", "ji.plot.comparison"),
    "theory": ("ji.theory.gap_scale", "ji.plot.admissible_set"),
}
STUDY = """
[scene]
masses_kg = [1.0, 1.0]
[law]
name = "newton"
restitution = 0.9
[{table}]
"""
TABLES = {"tracks": "track", "montecarlo": "monte_carlo"}


def rooms_that_stand_on(room):
    """The room, and all whose files import it, directly or not."""
    uses = {x: set() for x in STOREY}
    for module, path in modules().items():
        if module.endswith("__main__"):
            continue
        uses[room_of(module)] |= {
            room_of(imported) for imported, _, _ in imports_of(path)
        }
    found = {room}
    while more := {x for x in uses if uses[x] & found} - found:
        found |= more
    return found


@pytest.mark.slow
@pytest.mark.parametrize("room", ASKED)
def test_a_room_can_be_left_out(room, tmp_path):
    """The rest imports, an impact and a fit run, and what is missing says which room it needs."""
    leave = shutil.ignore_patterns("__pycache__")
    copy = shutil.copytree(PACKAGE, tmp_path / "jimpact", ignore=leave)
    shutil.rmtree(copy / room)
    (tmp_path / "study.toml").write_text(STUDY.format(table=TABLES.get(room, "data")))
    gone = rooms_that_stand_on(room)
    left = sorted(
        m for m in modules() if room_of(m) not in gone and not m.endswith("__main__")
    )
    asked = "".join(f"lambda: {each}, " for each in ASKED[room])
    script = LEFT_OUT.format(folder=str(tmp_path), modules=left, asked=asked)
    run = {"capture_output": True, "text": True, "cwd": tmp_path, "check": False}
    done = subprocess.run([sys.executable, "-c", script], **run)
    assert done.returncode == 0, done.stderr[-600:]
    restitution, *said = done.stdout.splitlines()
    assert restitution == "0.5"
    assert len(said) == len(ASKED[room])
    assert all(
        f"needs the room jimpact/{room}, which is missing here" in line for line in said
    )
