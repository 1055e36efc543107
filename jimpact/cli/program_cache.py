"""Compiled programs on the disk: a program that was compiled once is not even traced again.

JAX's own cache stores what XLA makes of a program, but the program must be traced and lowered
before it can be looked up, which takes three times as long as reading it. Here the key of a
program is what it was made of: the function, everything static, shapes and kinds of the arrays,
the settings of JAX, the source of this library and the versions it runs with. Programs made of
anything else, for example of a user's own law, are not stored.
"""

import hashlib
import io
import math
import os
import pickle
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache, partial
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.experimental import serialize_executable

from jimpact.compiling import run_programs_with

# Packages whose code is identified by their version, or, for this library, by its source.
IDENTIFIED = ("jimpact", "jax", "jaxlib", "equinox", "numpy", "builtins")
# Bytes; beyond, the least recently used files go. A program takes about 0.2 MB, so this holds
# several thousand; ten times more would fill the quota of a small home folder.
LARGEST_FOLDER = 1_000_000_000


class _IdentifiedCode(pickle.Unpickler):
    """Refuses what comes from a package whose version is not part of the key."""

    def find_class(self, module: str, name: str) -> Any:
        """The named object, or an UnpicklingError."""
        if module.partition(".")[0] not in IDENTIFIED:
            raise pickle.UnpicklingError(module)
        return super().find_class(module, name)


def _fingerprint(parts: Any) -> bytes | None:
    """The same bytes for equal parts in every process; None where their code is not identified."""
    text = io.BytesIO()
    pickler = pickle.Pickler(text)
    pickler.fast = True  # else the bytes depend on which equal parts are one object
    try:
        pickler.dump(parts)
        _IdentifiedCode(io.BytesIO(text.getvalue())).load()
    except Exception:  # objects refuse to be pickled in many ways
        return None
    return text.getvalue()


@cache
def _source_hash() -> bytes:
    """Hash of this library's source, and of the versions of what it runs with."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.parent.rglob("*.py")):
        digest.update(path.read_bytes())
    for name in IDENTIFIED[1:-1]:
        digest.update(f"{name} {metadata.version(name)}".encode())
    return digest.digest()


class ProgramCache:
    """Programs in a folder; those that are missing there are compiled and written.

    Args:
        folder: reserved for programs; created if missing.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.loaded: dict[Any, Callable[..., Any]] = {}

    def run(
        self,
        program: Callable[..., Any],
        function: Callable[..., Any],
        static: Any,
        arrays: list[jax.Array],
    ) -> Any:
        """The value of the program, which is loaded, read or compiled.

        Args:
            program: the jitted function of `static` and the arrays.
            function: the public function that the program computes; its name is part of the key.
            static: all arguments that are no arrays.
            arrays: the others.
        """
        kinds = tuple((x.shape, str(x.dtype), x.weak_type) for x in map(jax.typeof, arrays))
        parts = function, static, kinds
        if parts in self.loaded:
            return self.loaded[parts](arrays)
        fingerprint = _fingerprint(parts)
        if fingerprint is None:
            self.loaded[parts] = partial(program, static)
            return program(static, arrays)
        settings = f"{jax.config.values} {os.environ.get('XLA_FLAGS')}".encode()
        path = self.folder / hashlib.sha256(_source_hash() + settings + fingerprint).hexdigest()
        with suppress(Exception):  # missing or damaged: compiled anew, and replaced
            executable = _read(path, arrays)
            result = jax.block_until_ready(executable(arrays))
            self.loaded[parts] = executable
            return result
        compiled = self.loaded[parts] = _compile(program, static, arrays)
        with suppress(Exception):  # without a file the next run is only slower
            _write(path, compiled)
        return compiled(arrays)


@contextmanager
def stored_programs(folder: str | Path | None) -> Iterator[None]:
    """Within, the library's programs are taken from this folder and stored there; None: nowhere.

    At the end the folder is cut down to `LARGEST_FOLDER`, with JAX's own cache if that is in it.
    """
    if folder is None:
        yield
        return
    with run_programs_with(ProgramCache(Path(folder)).run):
        yield
    limit_size(folder)


def limit_size(folder: str | Path, largest: int = LARGEST_FOLDER) -> None:
    """Delete the least recently used files of a folder down to a total size [bytes].

    Where the disk does not record reading, the oldest go.
    """
    files = []
    for path in Path(folder).rglob("*"):
        with suppress(OSError):  # another process may delete it meanwhile
            status = path.stat()
            if path.is_file():
                files.append((max(status.st_atime, status.st_mtime), status.st_size, path))
    total = sum(size for _, size, _ in files)
    for _, size, path in sorted(files):
        if total <= largest:
            break
        with suppress(OSError):
            path.unlink()
        total -= size


def _compile(
    program: Callable[..., Any], static: Any, arrays: list[jax.Array]
) -> jax.stages.Compiled:
    """The compiled program, without JAX's cache: what JAX reads from it cannot be stored again."""
    name = "jax_persistent_cache_min_compile_time_secs"
    before = getattr(jax.config, name)
    jax.config.update(name, math.inf)
    try:
        return program.lower(static, arrays).compile()  # type: ignore[attr-defined]
    finally:
        jax.config.update(name, before)


@cache
def _load_lapack() -> None:
    """JAX loads it when it lowers a use of it; programs that are read crash without it."""
    jax.jit(jax.lax.linalg.lu).lower(np.eye(1, dtype=np.float32))


def _read(path: Path, arrays: list[jax.Array]) -> Callable[..., Any]:
    """The program in a file, for these arrays."""
    code, result = pickle.loads(path.read_bytes())
    _load_lapack()
    trees = jax.tree.structure(((arrays,), {})), jax.tree.structure(result)
    return serialize_executable.deserialize_and_load(code, *trees)


def _write(path: Path, compiled: jax.stages.Compiled) -> None:
    """Write a program, whole or not at all: others may read it, or interrupt."""
    code, _, tree = serialize_executable.serialize(compiled)
    result = jax.tree.unflatten(tree, range(tree.num_leaves))  # pickled trees lose marks
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
        pickle.dump((code, result), file)
    os.replace(file.name, path)
