"""Pictures: one function for each kind of result; each returns a matplotlib figure.

Each room draws its own results, in its `pictures.py`; here are what all pictures share and the face
`ji.plot`, which finds them by the stub and imports a room's pictures when one is asked for.

>>> import jimpact as ji
>>> result = ji.compare(ji.chain([1.0, 1.0]), [1.0, 0.0], {"Newton": ji.Newton(0.5)})
>>> len(ji.plot.comparison(result).axes)
2
"""

import ast
from importlib import import_module
from pathlib import Path
from typing import Any

from jimpact.tools.checks import missing_room, needed

needed("matplotlib", "pip install matplotlib")  # the first of what all pictures import


def _modules() -> dict[str, str]:
    """The module of each picture, as the stub states it."""
    stub = ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
    lines = [line for line in stub.body if isinstance(line, ast.ImportFrom)]
    return {alias.name: str(line.module) for line in lines for alias in line.names}


_MODULES = _modules()
__all__ = sorted(_MODULES)


def __getattr__(name: str) -> Any:
    """The picture of this name; an ImportError says which room is missing."""
    if name not in _MODULES:
        raise AttributeError(f"jimpact.plot has no name `{name}`")
    with missing_room(f"ji.plot.{name}"):
        return getattr(import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    """The public names."""
    return list(__all__)
