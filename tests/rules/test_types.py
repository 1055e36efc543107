"""Public names are lazy, and type checkers and editors see all of them."""

import ast
import importlib
import json
import pkgutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

import jedi
import pytest

import jimpact as ji

ROOT = Path(__file__).parents[2]
SCRIPT = Path(__file__).with_name("typed_script.py")
PACKAGES = (ji, ji.plot, ji.theory, ji.data, ji.tracks)


def names_in_stub(package):
    stub = ast.parse(Path(package.__file__).with_suffix(".pyi").read_text())
    found = {}
    for node in stub.body:
        if isinstance(node, ast.ImportFrom):
            assert node.level == 1 or package in (ji.plot, ji.theory), (
                "names of other rooms"
            )
            base = [package.__name__] * node.level
            for alias in node.names:
                assert alias.asname == alias.name, (
                    "without `as` a name of a stub is private"
                )
                found[alias.name] = ".".join(
                    [*base, node.module] if node.module else base
                )
    return found


@pytest.mark.parametrize("package", PACKAGES, ids=lambda p: p.__name__)
def test_stub_and_package_have_the_same_names(package):
    """And each is what its module holds, also after every module has been imported."""
    stub = names_in_stub(package)
    own = {"__version__"} if package is ji else set()
    assert set(package.__all__) == set(stub) | own
    assert set(dir(package)) >= set(stub)
    for module in pkgutil.walk_packages(ji.__path__, "jimpact."):
        importlib.import_module(module.name)
    for name, module in stub.items():
        value = getattr(package, name)
        if isinstance(value, ModuleType):
            assert value in PACKAGES
        else:
            assert value is getattr(importlib.import_module(module), name)


def test_a_name_stands_in_one_name_space_only():
    """But for pictures: they are named like the function whose result they draw."""
    assert not set(ji.theory.__all__) & set(ji.__all__)


@pytest.mark.parametrize("package", PACKAGES, ids=lambda p: p.__name__)
def test_no_module_is_named_like_a_public_name(package):
    modules = {module.name for module in pkgutil.iter_modules(package.__path__)}
    assert not modules & set(package.__all__) - {"data", "plot", "theory", "tracks"}


def test_the_registry_holds_our_laws_at_first_use():
    code = "import jimpact as ji; assert 'lzb' in ji.REGISTRY; assert ji.register.__module__"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_unknown_names_are_attribute_errors():
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = ji.no_such_name


@pytest.mark.release
def test_mypy_sees_names_signatures_and_fields():
    command = [
        sys.executable,
        "-m",
        "mypy",
        "--config-file",
        "pyproject.toml",
        str(SCRIPT),
    ]
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.release
@pytest.mark.skipif(
    find_spec("basedpyright") is None, reason="basedpyright is not installed"
)
def test_pyright_sees_names_signatures_and_fields(tmp_path):
    """By basedpyright, which is pyright with a node of its own: nothing is downloaded."""
    reported = {
        "include": [str(SCRIPT)],
        "typeCheckingMode": "standard",
        "enableTypeIgnoreComments": True,
        "reportUnnecessaryTypeIgnoreComment": "error",
        "extraPaths": [str(ROOT)],
    }
    (tmp_path / "pyrightconfig.json").write_text(json.dumps(reported))
    command = [sys.executable, "-m", "basedpyright", "--project", str(tmp_path)]
    command += ["--pythonpath", sys.executable]
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize(
    ("space", "package"),
    [("ji", ji), ("ji.plot", ji.plot), ("ji.theory", ji.theory), ("ji.data", ji.data)],
)
def test_editors_complete_all_names(space, package):
    script = jedi.Script(f"import jimpact as ji\n{space}.", project=jedi.Project(ROOT))
    assert set(package.__all__) <= {found.name for found in script.complete()}


def test_editors_show_signatures():
    script = jedi.Script("import jimpact as ji\nji.impact(", project=jedi.Project(ROOT))
    (shown,) = (signature.to_string() for signature in script.get_signatures())
    assert shown.startswith("impact(law: Law, scene: Scene, velocity: Any")
    assert shown.endswith("-> Impact")
