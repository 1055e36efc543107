"""Faces: packages that hand on names of other rooms, as `ji.plot` does, when one is
asked for.
"""

import ast
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

from jimpact.tools.checks import missing_room


def face(
    package: str, file: str
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """`__getattr__` and `__dir__` of a package whose stub, beside its `file`, states
    all names.

    `lazy_loader` does the same for packages whose names are all their own. A name whose
    room is missing is an ImportError that says so.

    >>> from jimpact.tools.faces import face
    >>> import jimpact.plot
    >>> find, names = face("jimpact.plot", jimpact.plot.__file__)
    >>> find("fit").__module__, "fit" in names()
    ('jimpact.fits.pictures', True)
    """
    modules = _modules_of_names(package, Path(file).with_suffix(".pyi"))

    def find(name: str) -> Any:
        """The value of a public name."""
        if name not in modules:
            raise AttributeError(f"{package} has no name `{name}`")
        with missing_room(f"{package.replace('jimpact', 'ji')}.{name}"):
            return getattr(import_module(modules[name]), name)

    def names() -> list[str]:
        """The public names."""
        return sorted(modules)

    return find, names


def _modules_of_names(package: str, stub: Path) -> dict[str, str]:
    """The module of each name that a stub states: `from .module import` or
    `from room.module`.
    """
    body = ast.parse(stub.read_text(encoding="utf-8")).body
    lines = [line for line in body if isinstance(line, ast.ImportFrom)]
    return {
        alias.name: f"{package}.{line.module}" if line.level else str(line.module)
        for line in lines
        for alias in line.names
    }
