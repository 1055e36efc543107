"""Compiled programs in a folder: a later process loads them, and neither traces nor
compiles.

A program is found by all that determines it: the sources of jimpact, the versions of
jax, jaxlib and equinox, the processor, JAX's settings, the function, the shapes of its
arrays and everything in its arguments that is no array. What cannot be named so (a
user's own functions and classes) is not kept. A file that is damaged, or of another
user, counts as none: the program is compiled anew.
"""

import dataclasses
import enum
import functools
import hashlib
import importlib
import os
import pickle
import re
import secrets
import sys
import tempfile
import types
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import jax
import numpy as np
from jax.experimental import serialize_executable

from jimpact.tools.checks import check_kind, needed
from jimpact.tools.processor import INFO, processor

SUFFIX = ".program"
# Bytes [B] that the files of a folder may take together; the ones not used for longest
# go first. An impact takes 1 MB, a fit 3 MB: ten times less would hold a day's work of
# one study.
LARGEST = 1_000_000_000
# Settings of JAX's that change a compiled program.
SETTINGS = (
    "jax_enable_x64",
    "jax_default_matmul_precision",
    "jax_numpy_dtype_promotion",
    "jax_numpy_rank_promotion",
    "jax_debug_nans",
    "jax_debug_infs",
    "jax_disable_jit",
    "jax_threefry_partitionable",
    "jax_default_prng_impl",
    "jax_disable_most_optimizations",
    "jax_exec_time_optimization_effort",
    "jax_memory_fitting_effort",
    "jax_enable_checks",
)
# of the environment
OPTIONS_OF_XLA = ("XLA_FLAGS", "JAX_PLATFORMS", "LIBTPU_INIT_ARGS")


KNOWN = (
    "jimpact",
    "jax",
    "jaxlib",
    "equinox",
    "numpy",
    "builtins",
    "functools",
    "collections",
)
CALLS = re.compile(r'custom_call_target="([^"]*)"')  # of functions outside of a program
LAPACK = "lapack_"
LENGTH = 8  # bytes of the length of a payload
OTHERS_WRITE = 0o022  # bits of a file's mode
Program: TypeAlias = Callable[[list[Any]], Any]
Compiler: TypeAlias = Callable[[str], Program]  # of a name


class Unnamed(Exception):
    """A value that determines a program, and has no name that another process would
    give it.
    """


class Keeper:
    """A folder of compiled programs, and those that this process has loaded or
    compiled.

    Attributes:
        folder: where the files are.
        ground: what determines all programs: sources, versions, processor, settings of
            XLA.
        programs: by function and arguments; None where a program cannot be kept.
    """

    def __init__(self, folder: Path):
        """Nothing is read or written before a program is asked for."""
        self.folder = folder
        self.ground = _ground()
        self.programs: dict[Any, Program | None] = {}

    def program(
        self,
        function: Callable[..., Any],
        compiled: Compiler,
        fixed: Any,
        arrays: Sequence[Any],
    ) -> Program | None:
        """The compiled program of a function for these arguments: of the folder, or
        made anew.

        Args:
            function: of jimpact, which names the program.
            compiled: compiles it, under the name that it is given.
            fixed: structure and other leaves of the arguments, (tree, leaves).
            arrays: the leaves that are arrays.

        Returns:
            A function of the list of arrays; None where it cannot be kept.
        """
        kinds = tuple(map(_kind_of_array, arrays))
        settings = _settings()
        key = function, fixed, kinds, settings
        if key not in self.programs:
            name = self._name(function, fixed, kinds, settings)
            self.programs[key] = None
            if name is not None:
                path = self.folder / (name + SUFFIX)
                self.programs[key] = _KeptProgram(path, len(arrays), compiled)
        return self.programs[key]

    def _name(
        self,
        function: Callable[..., Any],
        fixed: Any,
        kinds: tuple[Any, ...],
        settings: Any,
    ) -> str | None:
        """Digest of all that determines a program; None where a part of it has no
        name.
        """
        tree, leaves = fixed
        if None in kinds or not _is_on_host():
            return None
        places = [
            _Array(i) if leaf is None else leaf[0] for i, leaf in enumerate(leaves)
        ]
        try:
            named = name_of(jax.tree.unflatten(tree, places))
            name = _name_of_function(function)
        except (Unnamed, AttributeError):
            return None
        text = "|".join([self.ground, name, named, repr(kinds), repr(settings)])
        return hashlib.sha256(text.encode()).hexdigest()


class _KeptProgram:
    """A program that is loaded from a file, or compiled and written to it, when it is
    called.

    A program that JAX has loaded from its own cache may lack functions once it is
    written and loaded again. So a program is written after it has run from the bytes of
    its file; if it cannot, it is compiled under another name, by which JAX's cache does
    not find it.
    """

    def __init__(self, path: Path, arrays: int, compiled: Compiler):
        """Of a file, a number of arrays, and what compiles it by a name."""
        self.path = path
        self.arrays = arrays
        self.compiled = compiled
        self.program: Program | None = None  # none before the first call

    def __call__(self, arrays: list[Any]) -> Any:
        """The results of the program."""
        if self.program is not None:
            return self.program(arrays)
        kept = _read(self.path)
        if kept is not None and (results := self._tried(kept, arrays)) is not None:
            return results
        for name in ("", f"_{secrets.token_hex(4)}"):
            program = self.compiled(name)
            new = _serialized(program)
            if new is None:
                break
            if (results := self._tried(new, arrays)) is not None:
                _write(self.path, new)
                return results
        self.program = program
        return program(arrays)

    def _tried(self, kept: "_Bytes", arrays: list[Any]) -> Any:
        """The results by the program of these bytes, which is used from now on; None if
        it fails.

        The results of programs are never None.
        """
        try:
            program = kept.loaded(self.arrays)
            results = jax.block_until_ready(program(arrays))
        except Exception:  # JAX has no class for bytes that it cannot load or run
            return None
        self.program = program
        return results


class _Array(NamedTuple):
    """The place of an array in the arguments of a program."""

    place: int


_keeper: list[Keeper] = []  # none, or the one that `keep_programs` has set


def keeper() -> Keeper | None:
    """The keeper that `keep_programs` has set; None: programs are not kept."""
    if _keeper:
        return _keeper[0]
    return None


class KeptPrograms(NamedTuple):
    """The compiled programs in a `folder`; `print` says how many and how large."""

    folder: Path

    @property
    def files(self) -> list[Path]:
        """The files, the ones used last first."""
        return sorted(self.folder.glob("*" + SUFFIX), key=_last_use, reverse=True)

    def __str__(self) -> str:
        """Folder, number and size."""
        size = sum(path.stat().st_size for path in self.files)
        return (
            f"{self.folder}: {len(self.files)} compiled programs, {size / 1e6:.1f} MB"
        )

    def clear(self) -> None:
        """Remove all of them."""
        for path in self.files:
            path.unlink(missing_ok=True)


def keep_programs(folder: str | Path | None = None) -> KeptPrograms:
    """Keep compiled programs in a folder, from which later processes load them.

    A process that computes an impact, a fit or a motion as an earlier one did then
    neither traces nor compiles: it starts in a quarter of the time. Results are the
    same to the last bit. Programs of `jax.jit`, `vmap` and `grad` around jimpact's
    functions are JAX's own, and not kept; no setting of JAX's is changed. What is kept
    belongs to this build of jimpact, JAX and the processor; anything else, a damaged
    file or one of another user is compiled anew. A user's own laws and functions are
    compiled as before. Only on the CPU, under Linux.

    Args:
        folder: where; it is created. None: the user's cache folder (platformdirs).

    Returns:
        What the folder holds; `print` says how much, `.clear()` empties it.

    Raises:
        TypeError: a folder that is no path. OSError: a folder that cannot be made.

    >>> import tempfile
    >>> import jimpact as ji
    >>> kept = ji.keep_programs(tempfile.mkdtemp())
    >>> out = ji.impact(ji.Newton(0.5), ji.chain([1.0, 1.0]), [1.0, 0.0])
    >>> len(kept.files)
    1
    >>> kept.clear()
    """
    if folder is None:
        platformdirs = needed("platformdirs", "pip install platformdirs")
        folder = Path(platformdirs.user_cache_dir("jimpact")) / "programs"
    if not isinstance(folder, str | Path):
        check_kind("folder", folder, Path)
    path = Path(folder)
    path.mkdir(parents=True, exist_ok=True, mode=0o700)
    if INFO.exists():
        _keeper[:] = [Keeper(path)]
    else:
        warnings.warn(
            "Programs are kept under Linux only: elsewhere the instruction set of a "
            "processor is not known.",
            stacklevel=2,
        )
    return KeptPrograms(path)


# ---------------------------------------------------------------------------- names


def name_of(value: Any) -> str:
    """What a value is, in words that any process finds; `Unnamed` if there are none.

    Numbers, words and collections of them; enumerations; arrays by their digest;
    functions and classes of jimpact, JAX, Equinox and NumPy by their names; dataclasses
    by class and fields.
    """
    kind = type(value)
    if value is None or kind in (bool, int, str, bytes, complex):
        return repr(value)
    if kind is float:
        return value.hex()
    if isinstance(value, _Array):
        return f"array {value.place}"
    if isinstance(value, enum.Enum):
        return f"{_name_of_class(kind)}.{value.name}"
    if isinstance(value, float | int):
        return f"{_name_of_class(kind)}({value!r})"
    if isinstance(value, np.dtype):
        return f"dtype {value.str}"
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        array = np.asarray(value)
        digest = hashlib.sha256(array.tobytes()).hexdigest()
        return f"{array.dtype.str}{array.shape}{digest}"
    if isinstance(value, type):
        return _name_of_class(value)
    if isinstance(value, dict):
        items = sorted((name_of(key), name_of(each)) for key, each in value.items())
        return f"{_name_of_class(kind)}{items}"
    if isinstance(value, set | frozenset):
        return f"{_name_of_class(kind)}{sorted(map(name_of, value))}"
    if isinstance(value, tuple | list):
        return f"{_name_of_class(kind)}{list(map(name_of, value))}"
    if isinstance(value, functools.partial):
        whole = value.func, value.args, value.keywords
        return f"{_name_of_class(kind)}{name_of(whole)}"
    if isinstance(value, types.MethodType):
        return f"method{_name_of_function(value.__func__)}{name_of(value.__self__)}"
    if isinstance(value, types.FunctionType):
        return _name_of_function(value)
    if dataclasses.is_dataclass(value):
        names = [each.name for each in dataclasses.fields(value)]
        parts = [f"{name}={name_of(getattr(value, name))}" for name in names]
        return f"{_name_of_class(kind)}({', '.join(parts)})"
    raise Unnamed(f"a {kind.__name__}")


def _name_of_class(kind: type) -> str:
    """`module:name` of a class whose source `_ground` stands for."""
    name = f"{kind.__module__}:{kind.__qualname__}"
    if kind.__module__.partition(".")[0] not in KNOWN or "<locals>" in name:
        raise Unnamed(name)
    return name


def _name_of_function(function: Any) -> str:
    """`module:name` of a function of a module that `_ground` stands for."""
    name = f"{function.__module__}:{function.__qualname__}"
    if function.__module__.partition(".")[0] not in KNOWN or "<" in name:
        raise Unnamed(name)
    return name


def _kind_of_array(array: Any) -> tuple[Any, ...] | None:
    """Shape, type and weakness of an array; None if it is not on one device of the
    default kind.
    """
    if isinstance(array, jax.Array):
        is_movable = len(array.devices()) == 1 and not array.committed
        weak = getattr(array, "weak_type", False)  # which random keys do not have
        if is_movable:
            return (array.shape, array.dtype, weak)
        return None
    return array.shape, array.dtype, False


def _is_on_host() -> bool:
    """True where arrays without a device of their own are on the CPU."""
    device = getattr(jax.config, "jax_default_device", None)
    return device is None and jax.default_backend() == "cpu"


def _settings() -> tuple[Any, ...]:
    """JAX's settings that change programs, of this thread and now."""
    return tuple(getattr(jax.config, name, None) for name in SETTINGS)


@functools.cache
def _ground() -> str:
    """Digest of what determines all programs: sources, versions, processor, options of
    XLA.
    """
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        digest.update(path.read_bytes())
    for name in ("jax", "jaxlib", "equinox", "numpy"):
        digest.update(f"{name} {importlib.import_module(name).__version__}".encode())
    digest.update(sys.version.encode())
    digest.update(processor().encode())
    for name in OPTIONS_OF_XLA:
        digest.update(f"{name}={os.environ.get(name)}".encode())
    return digest.hexdigest()


# ---------------------------------------------------------------------------- files


class _Bytes(NamedTuple):
    """A compiled program, and what loads it: a pickled example of its results, and
    whether it calls LAPACK.
    """

    payload: bytes
    pickled: bytes

    def loaded(self, arrays: int) -> Program:
        """The program, a function of a list of so many arrays."""
        example, calls_lapack = pickle.loads(self.pickled)
        if calls_lapack:
            _load_lapack()
        results = jax.tree.structure(example)
        arguments = jax.tree.structure((([0] * arrays,), {}))
        load: Any = serialize_executable.deserialize_and_load
        program: Program = load(self.payload, arguments, results)
        return program

    def digest(self, name: str) -> bytes:
        """What a file of this name begins with."""
        return hashlib.sha256(name.encode() + self.payload + self.pickled).digest()


def _serialized(compiled: Any) -> _Bytes | None:
    """A compiled program as bytes; None where it calls functions other than those of
    LAPACK.
    """
    try:
        calls = CALLS.findall(compiled.as_text())
        if not all(call.startswith(LAPACK) for call in calls):
            return None
        payload, _, results = serialize_executable.serialize(compiled)
        example = jax.tree.unflatten(results, range(results.num_leaves))
        pickled = pickle.dumps((example, bool(calls)))
        unpickled, _ = pickle.loads(pickled)
        is_same = jax.tree.structure(unpickled) == results
    except Exception:  # results that hold functions, say
        return None
    if is_same:
        return _Bytes(payload, pickled)
    return None


def _read(path: Path) -> _Bytes | None:
    """The program of a file; None if there is none, or one that is not to be
    trusted.
    """
    try:
        if not (_is_own(path) and _is_own(path.parent)):
            return None
        content = path.read_bytes()
        size = hashlib.sha256().digest_size
        begin = size + LENGTH
        end = begin + int.from_bytes(content[size:begin], "big")
        kept = _Bytes(content[begin:end], content[end:])
        if kept.digest(path.name) != content[:size]:
            return None
        os.utime(path)  # used now
    except OSError:
        return None
    return kept


def _write(path: Path, kept: _Bytes) -> None:
    """Write a program, all at once, and remove the programs that exceed `LARGEST`.

    Nothing is written where it cannot be: a full disk, a folder that may only be read.
    """
    length = len(kept.payload).to_bytes(LENGTH, "big")
    content = kept.digest(path.name) + length + kept.payload + kept.pickled
    name = None
    try:
        handle, name = tempfile.mkstemp(dir=path.parent)
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        os.replace(name, path)
        _shrink(path.parent)
    except OSError:
        if name is not None:
            Path(name).unlink(missing_ok=True)


@functools.cache
def _load_lapack() -> None:
    """Let JAX look up the functions of LAPACK, which it does where a call of one is
    lowered.

    A program that is loaded calls them all the same.
    """
    jax.jit(jax.lax.linalg.cholesky).lower(jax.ShapeDtypeStruct((1, 1), np.float32))


def _is_own(path: Path) -> bool:
    """True for what belongs to this user, and nobody else may write."""
    status = path.stat()
    return status.st_uid == os.getuid() and not status.st_mode & OTHERS_WRITE


def _last_use(path: Path) -> float:
    """When a program was written or last loaded [s]; 0 if it is gone."""
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0


def _shrink(folder: Path) -> None:
    """Remove programs, those not used for longest first, beyond `LARGEST`; one always
    stays.
    """
    newest, *others = KeptPrograms(folder).files
    total = newest.stat().st_size
    for path in others:
        total += path.stat().st_size
        if total > LARGEST:
            path.unlink(missing_ok=True)
