"""Compiled programs on the disk, whole: what was compiled once is not even traced again.

JAX's own cache keeps what XLA makes of a program, but the program must be traced and lowered
before it can be looked up, which takes three times as long as to read it. Here a program is
looked up by what it was made of: the function, everything static, shapes and kinds of the
arrays, the settings of JAX, the source of this library and the versions it runs with. What was
made of anything else, as a law of the caller's own, is not kept.
"""

import hashlib
import io
import math
import os
import pickle
import tempfile
from collections.abc import Callable
from contextlib import suppress
from functools import cache, partial
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.experimental import serialize_executable

# Whose code is known by its version, or, of this library, by its source.
KNOWN = ("jimpact", "jax", "jaxlib", "equinox", "numpy", "builtins")


class _OfKnownCode(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if module.partition(".")[0] not in KNOWN:
            raise pickle.UnpicklingError(module)
        return super().find_class(module, name)


def _described(made_of: Any) -> bytes | None:
    """The same bytes for the same things, in every process; None for what cannot be known."""
    text = io.BytesIO()
    pickler = pickle.Pickler(text)
    pickler.fast = True  # else the bytes tell which equal parts are one object
    try:
        pickler.dump(made_of)
        _OfKnownCode(io.BytesIO(text.getvalue())).load()
    except Exception:  # whatever refuses to be written down
        return None
    return text.getvalue()


@cache
def _sources() -> bytes:
    """This library's source, and versions of what it runs with."""
    found = hashlib.sha256()
    for path in sorted(Path(__file__).parent.parent.rglob("*.py")):
        found.update(path.read_bytes())
    for name in KNOWN[1:-1]:
        found.update(f"{name} {metadata.version(name)}".encode())
    return found.digest()


class KeptPrograms:
    """Programs in a folder, compiled where they are not there.

    Args:
        folder: theirs alone; made if need be.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.at_hand: dict[Any, Callable[..., Any]] = {}

    def run(
        self, program: Any, called: Callable[..., Any], fixed: Any, arrays: list[jax.Array]
    ) -> Any:
        """What the program gives.

        Args:
            program: the jitted function of `fixed`, which is static, and the arrays.
            called: by which name it is known.
        """
        kinds = tuple((x.shape, str(x.dtype), x.weak_type) for x in map(jax.typeof, arrays))
        place = called, fixed, kinds
        if place in self.at_hand:
            return self.at_hand[place](arrays)
        described = _described(place)
        if described is None:
            self.at_hand[place] = partial(program, fixed)
            return program(fixed, arrays)
        settings = f"{jax.config.values} {os.environ.get('XLA_FLAGS')}".encode()
        path = self.folder / hashlib.sha256(_sources() + settings + described).hexdigest()
        with suppress(Exception):  # not there, or of no use: compiled anew, and replaced
            loaded = _read(path, arrays)
            result = jax.block_until_ready(loaded(arrays))
            self.at_hand[place] = loaded
            return result
        compiled = self.at_hand[place] = _compiled(program, fixed, arrays)
        with suppress(Exception):  # what cannot be kept, or has no place, only is slower next time
            _write(path, compiled)
        return compiled(arrays)


def _compiled(program: Any, fixed: Any, arrays: list[jax.Array]) -> jax.stages.Compiled:
    """Not taken from JAX's cache, nor kept there: what it reads cannot be written once more."""
    least = "jax_persistent_cache_min_compile_time_secs"
    before = getattr(jax.config, least)
    jax.config.update(least, math.inf)
    try:
        return program.lower(fixed, arrays).compile()
    finally:
        jax.config.update(least, before)


@cache
def _find_lapack() -> None:
    """JAX finds it when it lowers a use of it; programs that are loaded crash without it."""
    jax.jit(jax.lax.linalg.lu).lower(np.eye(1, dtype=np.float32))


def _read(path: Path, arrays: list[jax.Array]) -> Callable[..., Any]:
    code, given = pickle.loads(path.read_bytes())
    _find_lapack()
    trees = jax.tree.structure(((arrays,), {})), jax.tree.structure(given)
    return serialize_executable.deserialize_and_load(code, *trees)


def _write(path: Path, compiled: jax.stages.Compiled) -> None:
    """At once: who reads meanwhile, or interrupts, finds all or nothing."""
    code, _, tree = serialize_executable.serialize(compiled)
    given = jax.tree.unflatten(tree, range(tree.num_leaves))  # pickled trees lose marks
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
        pickle.dump((code, given), file)
    os.replace(file.name, path)
