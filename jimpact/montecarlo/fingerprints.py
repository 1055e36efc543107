"""A hash of a value that is the same in every process: arrays, modules, functions, numbers."""

import dataclasses
import functools
import hashlib
import inspect
import pickle
from collections.abc import Iterator, Mapping
from typing import Any

import jax
import numpy as np


def fingerprint(value: Any) -> str:
    """Hexadecimal SHA-256 of everything that `value` holds.

    A function counts as its qualified name, its source (its byte code where there is none), its
    defaults, and the values it closes over; what it reads from globals is not seen.

    >>> from jimpact.montecarlo.fingerprints import fingerprint
    >>> fingerprint([1.0, "a"]) == fingerprint([1.0, "a"]) != fingerprint([2.0, "a"])
    True
    """
    digest = hashlib.sha256()
    for part in _parts(value, ()):
        digest.update(len(part).to_bytes(8, "little") + part)
    return digest.hexdigest()


def _parts(value: Any, inside: tuple[int, ...]) -> Iterator[bytes]:
    """The value as byte strings; `inside` are the ids of what holds it (functions may recur)."""
    if id(value) in inside:
        yield b"itself"
        return
    inside = (*inside, id(value))
    yield _name(type(value)).encode()
    if isinstance(value, jax.Array | np.ndarray | np.generic):
        array = np.asarray(value)
        yield f"{array.dtype} {array.shape}".encode()
        yield np.ascontiguousarray(array).tobytes()
    elif value is None or isinstance(value, str | bytes | int | float | complex):
        yield repr(value).encode()
    elif isinstance(value, type):
        yield _name(value).encode()
    elif isinstance(value, Mapping):
        for key in sorted(value, key=repr):
            yield from _parts(key, inside)
            yield from _parts(value[key], inside)
    elif isinstance(value, list | tuple | set | frozenset):
        for item in sorted(value, key=repr) if isinstance(value, set | frozenset) else value:
            yield from _parts(item, inside)
    elif isinstance(value, functools.partial):
        yield from _parts((value.func, value.args, value.keywords), inside)
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            yield field.name.encode()
            yield from _parts(getattr(value, field.name, None), inside)
    elif inspect.ismethod(value):
        yield from _parts((value.__func__, value.__self__), inside)
    elif inspect.isfunction(value):
        yield from _function(value, inside)
    else:
        yield _pickled(value)


def _function(value: Any, inside: tuple[int, ...]) -> Iterator[bytes]:
    yield _name(value).encode()
    try:
        yield inspect.getsource(value).encode()
    except (OSError, TypeError):
        yield value.__code__.co_code + repr(value.__code__.co_names).encode()
        yield from _parts([c for c in value.__code__.co_consts if not inspect.iscode(c)], inside)
    yield from _parts((value.__defaults__, value.__kwdefaults__), inside)
    for cell in value.__closure__ or ():
        yield from _parts(cell.cell_contents, inside)


def _pickled(value: Any) -> bytes:
    try:
        return pickle.dumps(value, protocol=4)
    except Exception:
        return _name(value).encode()


def _name(value: Any) -> str:
    return f"{getattr(value, '__module__', '')}.{getattr(value, '__qualname__', type(value))}"
