"""Fits in a file: values of JSON from which each is made again, bit by bit."""

import dataclasses
import platform
from collections.abc import Mapping
from importlib import import_module
from operator import attrgetter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jimpact
from jimpact.core.law import StaticNumber, StaticNumbers
from jimpact.core.scene import PairNormals
from jimpact.fits.errors_before import ErrorsBefore
from jimpact.fits.findings import Finding
from jimpact.fits.intervals import Profile
from jimpact.fits.matrices import AdmissibleMatrices
from jimpact.fits.measurement import Measurement
from jimpact.fits.observables import Shots
from jimpact.fits.parameters import LawInScene, Parameters, Prior
from jimpact.fits.parts_of_motion import LawInMotion
from jimpact.fits.problem import FitProblem
from jimpact.fits.search import FitMinimum, Solution
from jimpact.fits.uncertainty import Uncertainty
from jimpact.fits.variables import Variables
from jimpact.numerics.sparse import Neighbours

_PACKAGES = ("jimpact", "jax", "jaxlib", "equinox", "numpy", "scipy")
# of values in the file that are not arrays, mappings or classes with fields
_KINDS: dict[str, Any] = {
    kind.__name__: kind
    for kind in (StaticNumber, StaticNumbers, float, np.float64, tuple, list)
} | {"Prior": Prior._make}
# Fields that files of earlier builds may lack. Their fits with errors of v- hold these
# errors as they were passed on, which `before` = None keeps: profiles belong to what
# was minimized then.
_LATER = {"covariance", "curve", "pre", "before", "tangential_stiffness"}
# classes of a fit that have no public name, by their own
_PARTS = {
    kind.__name__: kind
    for kind in (
        *(
            AdmissibleMatrices,
            ErrorsBefore,
            Finding,
            FitMinimum,
            FitProblem,
            LawInMotion,
            LawInScene,
        ),
        *(Measurement, Neighbours, PairNormals, Parameters, Profile, Shots, Solution),
        *(Uncertainty, Variables),
    )
}


def versions() -> dict[str, str]:
    """Versions of jimpact, of what it computes with, and of Python."""
    numbers = {name: import_module(name).__version__ for name in _PACKAGES}
    return numbers | {"Python": f"{platform.python_version()}, {platform.system()}"}


def encoded(value: Any) -> Any:
    """A value as JSON data, from which `decoded` makes it again, bit by bit.

    Arrays, mappings, tuples and dataclasses become dictionaries that name their kind.
    """
    if value is None or isinstance(value, bool | str | int):
        return value
    if isinstance(value, float):
        plain = type(value) is float and np.isfinite(value)
        if plain:
            return value
        return {type(value).__name__: repr(float(value))}
    if isinstance(value, jax.Array | np.ndarray | np.generic):
        array = np.asarray(value)
        entries = [encoded(x) for x in array.ravel().tolist()]
        kind = {"dtype": str(array.dtype), "device": isinstance(value, jax.Array)}
        return {"array": entries, "shape": list(array.shape), **kind}
    if dataclasses.is_dataclass(value):
        fields = {
            name: encoded(getattr(value, name)) for name in _saved_fields(type(value))
        }
        return {"class": _name_of(type(value)), "fields": fields}
    if isinstance(value, Mapping):
        return {"dict": {key: encoded(each) for key, each in value.items()}}
    if isinstance(value, list | tuple):
        return {type(value).__name__: [encoded(each) for each in value]}
    raise ValueError(
        f"Argument `fit` must hold numbers and words to be saved, but has {value!r}."
    )


def decoded(data: Any) -> Any:
    """The value of data that `encoded` has made: a dictionary names the kind of its
    content.
    """
    if not isinstance(data, dict):
        return data
    if "class" in data:
        return instance_of(_class_of(data["class"]), data["fields"])
    if "array" in data:
        entries = [decoded(x) for x in data["array"]]
        array = np.array(entries, data["dtype"]).reshape(data["shape"])
        if data["device"]:
            return jnp.asarray(array)
        return array
    ((kind, content),) = data.items()
    if kind == "dict":
        return {key: decoded(each) for key, each in content.items()}
    return _KINDS[kind](map(decoded, content) if isinstance(content, list) else content)


def _name_of(cls: type) -> str:
    """`ji.LZB` of a public class, its own name of a part of a fit, else module and
    name.
    """
    name = cls.__qualname__
    if name in dir(jimpact) and getattr(jimpact, name) is cls:
        return f"ji.{name}"
    if _PARTS.get(name) is cls:
        return name
    return f"{cls.__module__}:{name}"


def _class_of(place: str) -> Any:
    """The class of a name that `_name_of` gave: 'ji.LZB', 'Solution' or 'module:Name'.

    Names of jimpact's own modules, as builds before 0.2 gave them, count without the
    module.
    """
    module, _, name = place.rpartition(":")
    if module and module.partition(".")[0] != "jimpact":
        return attrgetter(name)(import_module(module))
    name = name.removeprefix("ji.")
    if name in _PARTS:
        return _PARTS[name]
    if name not in dir(jimpact):
        raise TypeError(f"{name} is no class of jimpact {jimpact.__version__}")
    return getattr(jimpact, name)


def _saved_fields(cls: Any) -> list[str]:
    """Names of the fields of a class that a file holds."""
    return [
        field.name
        for field in dataclasses.fields(cls)
        if field.metadata.get("saved", True)
    ]


def grouped(fields: dict[str, Any], parts: Mapping[str, Any]) -> dict[str, Any]:
    """Encoded fields, with those that belong to a class in `parts` moved into a field
    of that name.

    Older files hold all of them side by side.
    """
    others = dict(fields)
    groups = {}
    for name, part in parts.items():
        of_part = {key: others.pop(key) for key in _saved_fields(part) if key in others}
        groups[name] = {"class": part.__name__, "fields": of_part}
    return others | groups


def instance_of(cls: Any, fields: dict[str, Any]) -> Any:
    """An instance of a dataclass with these encoded fields; a TypeError unless it has
    just these.

    Fields of older files get their present names.
    """
    if not dataclasses.is_dataclass(cls):
        raise TypeError(f"{cls!r} is no class of a law, scene or result")
    names = set(_saved_fields(cls))
    fields = dict.fromkeys(names & _LATER) | fields
    if cls is FitProblem and "owner" in fields:
        fields["value"] = fields.pop("measured")  # its older name
        fields = grouped(fields, {"variables": Variables, "measurement": Measurement})
    if names != set(fields):
        name = getattr(cls, "__name__", cls)
        raise TypeError(
            f"{name} has the fields {sorted(names)}, the file {sorted(fields)}"
        )
    # as it was: its fields have been checked and converted
    instance: Any = object.__new__(cls)
    for key, value in fields.items():
        object.__setattr__(instance, key, decoded(value))
    return instance
