"""A fit in a file (JSON) and back: what was fitted, what was found, the versions that did it."""

import dataclasses
import json
import platform
import sys
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jimpact
from jimpact.fits.problem import FitProblem
from jimpact.fits.result import FitResult
from jimpact.law import StaticNumber, StaticNumbers

FORMAT = 1  # of the file; it changes where older files could not be read any more
_PACKAGES = ("jax", "jaxlib", "equinox", "numpy", "scipy")
_REBUILT = "problem"  # the field of a fit that is made again from its parts


def versions() -> dict[str, str]:
    """Versions of jimpact, of what it computes with, and of Python."""
    found = {"jimpact": jimpact.__version__}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:  # installed in a way that leaves no record
            continue
    return found | {"Python": f"{platform.python_version()}, {platform.system()}"}


def write_fit(fit: FitResult, path: Path) -> Path:
    """Write a fit to shots without ties."""
    problem = fit.problem
    if fit.experiments is None:
        raise ValueError("Argument `fit` must be to shots to be saved: functions cannot be.")
    if problem.ties:
        raise ValueError("Argument `fit` must have no ties to be saved: functions cannot be.")
    names = [field.name for field in dataclasses.fields(fit) if field.name != _REBUILT]
    record = {
        "format": FORMAT,
        "versions": versions(),
        "problem": {
            "law": _encoded(problem.law),
            "scene": _encoded(problem.scene),
            "experiments": _encoded(fit.experiments),
            "free": {name: label.tolist() for name, label in problem.parameters.labels.items()},
            "bounds": _encoded(dict(zip(problem.names, problem.domains.tolist()))),
            "priors": {problem.names[i]: [mean, std] for i, mean, std in problem.priors},
            "used": (~np.isnan(problem.measured).all(axis=1)).tolist(),
            "notes": list(problem.notes),
            "left_out": list(problem.left_out),
        },
        "result": {name: _encoded(getattr(fit, name)) for name in names},
    }
    path.write_text(json.dumps(record, allow_nan=False, indent=1) + "\n", encoding="utf-8")
    return path


def read_fit(path: Path) -> dict[str, Any]:
    """The fields of a fit that `write_fit` has written."""
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: the file must be a saved fit (JSON), but {error}.") from None
    if not isinstance(record, dict) or "format" not in record:
        raise ValueError(f"{path}: the file must be a saved fit, but has no `format`.")
    if record["format"] != FORMAT:
        writer = record.get("versions", {}).get("jimpact", "an unknown version")
        raise ValueError(
            f"{path}: the file must be a fit saved in format {FORMAT}, but has format "
            f"{record['format']} (written by jimpact {writer}; this is {jimpact.__version__})."
        )
    try:
        result = {name: _decoded(value) for name, value in record["result"].items()}
        return result | {_REBUILT: _problem(record["problem"], result["value"])}
    except (KeyError, AttributeError, ImportError, TypeError) as error:
        writer = record.get("versions", {}).get("jimpact")
        raise ValueError(
            f"{path}: the fit, saved by jimpact {writer}, cannot be read: {error!r}. A law of your "
            "own must be imported before."
        ) from error


def _problem(parts: dict[str, Any], value: np.ndarray) -> FitProblem:
    """The problem that was solved."""
    law, scene, data = (_decoded(parts[name]) for name in ("law", "scene", "experiments"))
    bounds = {name: tuple(pair) for name, pair in _decoded(parts["bounds"]).items()}
    problem = FitProblem.from_shots(law, scene, data, parts["free"], bounds, parts["priors"])
    used = np.broadcast_to(np.array(parts["used"])[:, None], problem.measured.shape)
    if parts["left_out"]:
        problem = problem.weighed(used.astype(float))
    problem = problem.passing_errors_at(problem.point(value))
    notes, left_out = tuple(parts["notes"]), tuple(parts["left_out"])
    return dataclasses.replace(problem, notes=notes, left_out=left_out)


def _encoded(value: Any) -> Any:
    """What a JSON file can hold, from which `_decoded` makes the value again, bit by bit."""
    if isinstance(value, StaticNumber):
        return {"static": float(value)}
    if isinstance(value, StaticNumbers):
        return {"statics": list(value)}
    if value is None or isinstance(value, bool | str | int):
        return value
    if isinstance(value, float):
        return value if np.isfinite(value) else {"number": str(value)}
    if isinstance(value, jax.Array | np.ndarray | np.generic):
        array = np.asarray(value)
        entries = [_encoded(x) for x in array.ravel().tolist()]
        kind = {"dtype": str(array.dtype), "device": isinstance(value, jax.Array)}
        return {"array": entries, "shape": list(array.shape), **kind}
    if dataclasses.is_dataclass(value):
        cls = type(value)
        fields = {f.name: _encoded(getattr(value, f.name)) for f in dataclasses.fields(value)}
        return {"class": f"{cls.__module__}:{cls.__qualname__}", "fields": fields}
    if isinstance(value, dict):
        return {"dict": {key: _encoded(each) for key, each in value.items()}}
    if isinstance(value, list | tuple):
        return {type(value).__name__: [_encoded(each) for each in value]}
    raise ValueError(f"Argument `fit` must hold numbers and words to be saved, but has {value!r}.")


def _decoded(data: Any) -> Any:
    """What `_encoded` has encoded."""
    if not isinstance(data, dict):
        return data
    if "array" in data:
        array = np.array([_decoded(x) for x in data["array"]], data["dtype"])
        array = array.reshape(data["shape"])
        return jnp.asarray(array) if data["device"] else array
    if "class" in data:
        return _instance(data["class"], data["fields"])
    (kind, content) = next(iter(data.items()))
    if kind in ("static", "statics", "number"):
        makers: dict[str, Any] = {"static": StaticNumber, "statics": StaticNumbers, "number": float}
        return makers[kind](content)
    if kind == "dict":
        return {key: _decoded(each) for key, each in content.items()}
    return {"tuple": tuple, "list": list}[kind](_decoded(each) for each in content)


def _instance(place: str, fields: dict[str, Any]) -> Any:
    """An instance of the class at a place with these fields, which are all that it has."""
    module, _, name = place.partition(":")
    found: Any = sys.modules.get(module) or import_module(module)
    for part in name.split("."):
        found = getattr(found, part)
    if not dataclasses.is_dataclass(found):
        raise TypeError(f"{place} is no class of a law, scene or result")
    known = {field.name for field in dataclasses.fields(found)}
    if known != set(fields):
        raise TypeError(f"{name} has the fields {sorted(known)}, the file {sorted(fields)}")
    instance: Any = object.__new__(found)  # type: ignore[arg-type]  # as it was: its fields have been checked and converted
    for key, value in fields.items():
        object.__setattr__(instance, key, _decoded(value))
    return instance
