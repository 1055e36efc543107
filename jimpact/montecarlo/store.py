"""The folder of a run: one file a chunk, written whole or not at all, and a manifest of
hashes.

`manifest.json` names what the run is, by a hash of each thing that determines its
result; every `chunk-0000012.npz` carries the hash of these, and numpy's zip files a
checksum of each array.
"""

import errno
import hashlib
import inspect
import io
import json
import os
import pickle
import warnings
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from types import FunctionType
from typing import Any

import jax
import numpy as np

from jimpact.montecarlo.statistics import Chunk, part

# Of a manifest: 2 names classes of jimpact without their modules, 3 has the tolerance
# of chunks.
FORMAT = {"format": "3"}
MANIFEST = "manifest.json"


def fingerprint(value: Any) -> str:
    """Hexadecimal SHA-256 of everything that `value` holds.

    A function counts as its qualified name, its source (its byte code where there is
    none), its defaults, and the values it closes over; what it reads from globals is
    not seen.

    >>> from jimpact.montecarlo.store import fingerprint
    >>> fingerprint([1.0, "a"]) == fingerprint([1.0, "a"]) != fingerprint([2.0, "a"])
    True
    """
    description = repr(_described(value, ()))
    return hashlib.sha256(description.encode()).hexdigest()


def _described(value: Any, inside: tuple[int, ...]) -> Any:
    """A value as nested tuples of texts and bytes, equal for equal values, to be
    hashed.

    Its type, and by that: numbers and texts, bytes and shape of arrays, the parts of
    collections (sorted where they have no order), of `partial` and bound methods;
    source, defaults and closure of a function; the name of a class; the attributes of
    other objects, else what pickles of them. What cannot be pickled is its type alone.

    `inside` are the ids of the objects that hold it: one that holds itself, as a
    recursive function does, is named there, not entered again.
    """
    name = _name(type(value))
    if id(value) in inside:
        return name, "itself"
    each = partial(_described, inside=(*inside, id(value)))
    if isinstance(value, jax.Array | np.ndarray | np.generic):
        array = np.asarray(value)
        data = np.ascontiguousarray(array).tobytes()
        return name, str(array.dtype), array.shape, data
    if isinstance(value, Mapping):
        pairs = ((each(k), each(x)) for k, x in value.items())
        return name, sorted(pairs, key=repr)
    if isinstance(value, list | tuple):
        return name, [each(x) for x in value]
    if isinstance(value, set | frozenset):
        return name, sorted(map(each, value), key=repr)
    if isinstance(value, partial):
        return name, each((value.func, value.args, value.keywords))
    if inspect.ismethod(value):
        return name, each((value.__func__, value.__self__))
    if inspect.isfunction(value):
        closure = [cell.cell_contents for cell in value.__closure__ or ()]
        parts = value.__defaults__, value.__kwdefaults__, closure
        return name, _name(value), _source(value), each(parts)
    if value is None or isinstance(value, str | bytes | int | float | complex):
        return name, repr(value)
    if isinstance(value, type):
        return name, _name(value)
    # a module of Equinox, a jitted function, a user's object
    if hasattr(value, "__dict__"):
        return name, each(dict(vars(value)))
    try:
        return name, pickle.dumps(value, protocol=4)
    except Exception:  # objects refuse to be pickled in many ways
        return name


def _source(function: FunctionType) -> Any:
    """Source text of a function; if there is none, its byte code with names and
    constants.
    """
    try:
        return inspect.getsource(function)
    except (OSError, TypeError):
        code = function.__code__
        constants = [x for x in code.co_consts if not inspect.iscode(x)]
        return code.co_code, code.co_names, constants


def _name(value: Any) -> str:
    """Module and qualified name; of jimpact's own the name alone, since its files may
    move.
    """
    module = getattr(value, "__module__", "")
    name = getattr(value, "__qualname__", type(value))
    return f"{'ji' if str(module).partition('.')[0] == 'jimpact' else module}.{name}"


class Store:
    """Chunks of one run in one folder.

    Raises:
        ValueError: the folder holds another run, or its manifest is damaged.
        OSError: it cannot be written.
    """

    def __init__(self, folder: str | Path, identity: dict[str, str]):
        """Open the folder of a run, or begin it; `identity` are hashes by name, see
        `Run`.
        """
        identity = identity | FORMAT
        if not isinstance(folder, str | Path):
            raise TypeError(f"Argument `folder` must be a path, but is {folder!r}.")
        self.folder = Path(folder)
        self.run = _run(identity)
        self.folder.mkdir(parents=True, exist_ok=True)
        manifest = self.folder / MANIFEST
        if not any(self.folder.glob("chunk-*.npz")):  # nothing of any run is lost
            _write(manifest, json.dumps(identity, indent=2).encode())
            return
        if not manifest.exists():
            raise ValueError(
                f"Folder '{folder}' has chunks but no {MANIFEST}, so the run that they "
                f"belong to is unknown: give another folder, or delete them."
            )
        other = _identity(self.folder)
        names = sorted(identity.keys() | other.keys())
        differ = [name for name in names if identity.get(name) != other.get(name)]
        if FORMAT.items() - other.items():
            raise ValueError(
                f"Folder '{folder}' holds a run that an earlier build of jimpact "
                f"began, which this one cannot continue: give another folder "
                f"(`read_samples` reads raw samples)."
            )
        if differ:
            raise ValueError(
                f"Folder '{folder}' holds another run, which differs in "
                f"{', '.join(differ)}: give another folder (or repeat that run's "
                f"arguments to continue it)."
            )

    def path(self, number: int) -> Path:
        """The file of a chunk."""
        return self.folder / f"chunk-{number:07d}.npz"

    def write(self, chunk: Chunk) -> None:
        """Store a chunk."""
        buffer = io.BytesIO()
        np.savez(buffer, run=np.array(self.run), **chunk)  # type: ignore[arg-type]
        path = self.path(int(chunk["number"]))
        _write(path, buffer.getvalue())

    def read(self, number: int, count: int, all_samples: bool) -> Chunk | None:
        """Statistics of chunk `number` from its file; None if it is missing or cannot
        be used.

        It must have `count` samples, with `all_samples` each of them raw, too. A
        damaged file makes a warning.
        """
        path = self.path(number)
        if not path.exists():
            return None
        try:
            chunk = _checked(path, self.run)
            if chunk["number"] != number:
                raise ValueError(f"it is chunk {chunk['number']} of this run")
        # zip, zlib, numpy: a damaged file makes all of them complain
        except Exception as error:
            text = str(error) or type(error).__name__
            warnings.warn(
                f"'{path}' is not used, its samples are computed again: {text}.",
                stacklevel=2,
            )
            return None
        complete = chunk["count"] == count
        if all_samples:
            complete = complete and len(chunk.get("raw.status", ())) == count
        if complete:
            return chunk
        return None


def read_samples(folder: str | Path) -> Iterator[dict[str, np.ndarray]]:
    """Samples that `monte_carlo(folder=..., keep_samples=True)` stored, by chunk.

    Args:
        folder: of the run.

    Yields:
        `gaps` (C, m), `velocity_before` (C, n) (no columns where they are constant),
        `velocity` (C, n) after the impact, `status` (C,); in the order of the samples.

    Raises:
        FileNotFoundError: no run there. ValueError: a damaged file, or chunks without
            samples.

    >>> import tempfile
    >>> import jimpact as ji
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     options = {
    ...         "samples": 30,
    ...         "chunk": 20,
    ...         "folder": folder,
    ...         "keep_samples": True,
    ...     }
    ...     speeds = ji.Uniform([1.0, 0.0], [2.0, 0.0])
    ...     _ = ji.monte_carlo(ji.Newton(0.5), ji.chain([1.0, 1.0]), speeds, **options)
    ...     [part["velocity"].shape for part in ji.read_samples(folder)]
    [(20, 2), (10, 2)]
    """
    run = _run(_identity(Path(folder)))
    for path in sorted(Path(folder).glob("chunk-*.npz")):
        try:
            chunk = _checked(path, run)
        except Exception as error:
            raise ValueError(f"'{path}' cannot be used: {error}.") from None
        samples = part(chunk, "raw")
        if len(samples.get("status", ())) != chunk["count"]:
            raise ValueError(
                f"'{path}' has no raw samples: run with keep_samples=True."
            )
        yield samples


def _checked(path: Path, run: str) -> Chunk:
    """Arrays of a chunk's file by name; a ValueError unless it is of the run with the
    hash `run`.

    zip checks the sums of their bytes.
    """
    data = io.BytesIO(path.read_bytes())
    with np.load(data, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    owner = str(arrays.pop("run"))
    if owner != run:
        raise ValueError(f"it belongs to another run ({owner[:12]}, not {run[:12]})")
    return arrays


def _run(identity: dict[str, str]) -> str:
    """The hash of a run's identity."""
    text = json.dumps(identity, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _identity(folder: Path) -> dict[str, str]:
    """Hashes by name in the manifest of a folder; a ValueError if it is damaged."""
    path = folder / MANIFEST
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(content, dict):
            raise ValueError("it is no mapping")
    except ValueError as error:
        raise ValueError(
            f"'{path}' is damaged ({error}): give another folder, or delete this one."
        ) from None
    return content


def _write(path: Path, content: bytes) -> None:
    """Replace a file in one step: after a crash it is the old one or the new one."""
    temporary = path.with_name(path.name + ".tmp")
    try:
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        if full:
            what = "the disk is full"
        else:
            what = str(error)
        raise OSError(
            error.errno,
            f"'{path}' could not be written, {what}; what was there before is intact, "
            f"and the same call continues from it",
        ) from error
    except BaseException:  # ctrl-C
        temporary.unlink(missing_ok=True)
        raise
