"""Theory of impacts with several contacts: admissible sets, audits of matrices, bounds, rocking.

>>> import jimpact as ji
>>> cradle = ji.chain([1.0, 1.0, 1.0])
>>> bool(ji.theory.audit_matrix(cradle, [[0.0, 0.8], [0.9, 0.0]]).admissible)
True
"""

from importlib import import_module
from typing import Any

import lazy_loader

_of_theory, _names, __all__ = lazy_loader.attach_stub(__name__, __file__)
# Two functions of the chapter that need a `System`, which is made in the room of motions.
OF_MOTION = "contact_problem", "quasi_lagrange"
__all__ += OF_MOTION


def __getattr__(name: str) -> Any:
    """A public name: of this room, or of the motions."""
    if name in OF_MOTION:
        return getattr(import_module("jimpact.motion.accelerations"), name)
    return _of_theory(name)


def __dir__() -> list[str]:
    """The public names."""
    return sorted([*_names(), *OF_MOTION])
