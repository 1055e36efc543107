"""Entries of a law that follow from others: ties, by functions of the user."""

import re
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import jax.numpy as jnp
import numpy as np

from jimpact.law import Law, free_parameters_of, parameters_of, with_parameter

AnyLaw = TypeVar("AnyLaw", bound=Law)
Ties = tuple[tuple[str, Callable[["Values"], Any]], ...]  # names, and what they follow from

_ENTRY = re.compile(r"(\w+)\[([1-9]\d*(?:[,=][1-9]\d*)*)\]")  # a name with entries, from 1


def entry_of(name: str) -> tuple[str, str | None]:
    """The field of a name as in `Parameters.names`, and what is in its brackets.

    >>> from jimpact.fits.ties import entry_of
    >>> entry_of("restitution"), entry_of("restitution[1=3]")
    (('restitution', None), ('restitution', '1=3'))
    """
    found = _ENTRY.fullmatch(name)
    return (found[1], found[2]) if found else (name, None)


def places(argument: str, name: str, entry: str, shape: tuple[int, ...]) -> list[int]:
    """Where in the flattened field the entries of a name are, counted from 0."""
    members = [tuple(int(i) - 1 for i in part.split(",")) for part in entry.split("=")]
    for index in members:
        inside = len(index) == len(shape) and all(0 <= i < n for i, n in zip(index, shape))
        if not inside:
            kind = f"of shape {shape}" if shape else "one value for all contacts"
            raise ValueError(
                f"Argument `{argument}` must name entries that the field has, counted from 1, but "
                f"has {name!r} of a field that is {kind}."
            )
    return [int(np.ravel_multi_index(index, shape)) for index in members]


class Values:
    """What a tie's function is given: values of a law by name, those that are tied included."""

    def __init__(self, law: Law, ties: Ties):
        self.law, self.functions = law, dict(ties)
        self.places = tied_places(law, ties)
        self.waiting: list[str] = []  # ties that have begun, each needed by the one before
        self.known: dict[str, Any] = {}

    def __getitem__(self, name: str) -> Any:
        """The value of an entry, or of a whole field in its shape."""
        field, entry = entry_of(name)
        value, at = _value(self.law, name), _places(self.law, name)
        flat = value.ravel()
        for other, tied in self.places.items():
            if entry_of(other)[0] == field and set(at) & set(tied):
                flat = flat.at[np.array(tied)].set(self._follow(other))
        return flat.reshape(value.shape) if entry is None else flat[at[0]]

    def _follow(self, name: str) -> Any:
        """The value of what is tied, by its function."""
        if name in self.known:
            return self.known[name]
        if name in self.waiting:
            circle = [*self.waiting[self.waiting.index(name) :], name]
            way = f"{circle[0]} needs {', which needs '.join(circle[1:])}"
            raise ValueError(f"Argument `ties` must not go in a circle, but {way}.")
        self.waiting.append(name)
        old = _value(self.law, name)
        value = jnp.asarray(self.functions[name](self)).astype(old.dtype)
        self.waiting.pop()
        whole = entry_of(name)[1] is None
        if value.shape not in ((), old.shape if whole else ()):
            raise ValueError(
                f"Argument `ties` must give one number for `{name}`{_or_shape(whole, old.shape)}, "
                f"but its function gives shape {value.shape}."
            )
        self.known[name] = value.ravel() if value.ndim else value
        return self.known[name]


def tied(law: AnyLaw, ties: Ties) -> AnyLaw:
    """The law with the tied entries as their functions say."""
    values = Values(law, ties)
    for field in dict.fromkeys(entry_of(name)[0] for name, _ in ties):
        law = with_parameter(law, field, values[field])
    return law


def checked_ties(law: Law, ties: Mapping[str, Any] | None) -> Ties:
    """The user's ties, tried at the law's own values."""
    pairs = tuple((ties or {}).items())
    owner: dict[tuple[str, int], str] = {}
    for name, function in pairs:
        if not callable(function):
            raise ValueError(
                f"Argument `ties` must map `{name}` to a function of the other values, as in "
                f"lambda p: 2 * p['restitution'], but has {function!r}."
            )
        for place in _places(law, name):
            other = owner.setdefault((entry_of(name)[0], place), name)
            if other != name:
                raise ValueError(
                    f"Argument `ties` must tie an entry once, but {other} and {name} overlap."
                )
    start = tied(law, pairs)
    for name, at in tied_places(law, pairs).items():
        field, _ = entry_of(name)
        value = np.asarray(_value(start, name)).ravel()[at]
        domain = parameters_of(start)[field].domain
        if not bool(np.asarray(domain.holds(jnp.asarray(value)))):
            low, high = domain.bounds
            raise ValueError(
                f"Argument `ties` must keep `{name}` in [{low:g}, {high:g}], but its function "
                f"gives {value.tolist()} at the start."
            )
    return pairs


def tied_names(law: Law, ties: Ties) -> list[str]:
    """Names of the tied entries, one by one."""
    names = []
    for name, at in tied_places(law, ties).items():
        field, entry = entry_of(name)
        shape = _value(law, name).shape
        if entry is None and shape:
            indices = (np.unravel_index(i, shape) for i in at)
            names += [f"{field}[{','.join(str(k + 1) for k in index)}]" for index in indices]
        else:
            names.append(name)
    return names


def tied_places(law: Law, ties: Ties) -> dict[str, list[int]]:
    """Where in their flattened fields the tied entries are, by name."""
    return {name: _places(law, name) for name, _ in ties}


def _value(law: Law, name: str) -> Any:
    """The field of a name, a parameter that is an array."""
    known = free_parameters_of(law)
    field, _ = entry_of(name)
    if field not in known:
        raise ValueError(
            f"Argument `ties` must use parameters of {type(law).__name__}, one of "
            f"{', '.join(known)}, but uses {name!r}."
        )
    return jnp.asarray(known[field].value)


def _places(law: Law, name: str) -> list[int]:
    """Where in its flattened field the entries of a name are."""
    shape, (_, entry) = _value(law, name).shape, entry_of(name)
    size = int(np.prod(shape, dtype=int))
    return list(range(size)) if entry is None else places("ties", name, entry, shape)


def _or_shape(whole: bool, shape: tuple[int, ...]) -> str:
    """That a whole field may have its own shape."""
    return f" or shape {shape}" if whole and shape else ""
