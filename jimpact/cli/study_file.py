"""Common parts of studies of impacts and of motions: file, keys of its tables, law and
body.
"""

import dataclasses
import importlib.util
import sys
import tomllib
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from jimpact.core.law import Law
from jimpact.core.scene import Scene
from jimpact.fits.parameters import OF_A_SCENE, entry_of, free_parameters
from jimpact.fits.parts_of_motion import OF_A_MOTION
from jimpact.laws import REGISTRY
from jimpact.laws.kinematic import RestitutionMatrix
from jimpact.tools.checks import check_choice, check_word, suggestion
from jimpact.tools.study_tables import check_keys, check_kind

if TYPE_CHECKING:
    from jimpact.fits.search import Search

STUDY = "study.toml"  # in a folder that `jimpact new` has made
NO_DATA = (
    "a study must have shots to be fitted, of [data], [track] or [bounces], but "
    "has none."
)

# -------------------------------------------------------------------------- locating
# and reading


class WrongOption(ValueError):
    """An argument beside the study is wrong, not the study."""


def located(path: Path, table: str) -> Path:
    """Path of a study: the file, `study.toml` in the folder, or the bundled study of
    this name.

    `table` is the head of a table: if there is no such study, the error lists the
    bundled studies that have it.
    """
    if path.is_file():
        return path
    if (path / STUDY).is_file():
        return path / STUDY
    bundled = Path(str(files("jimpact") / "data"))
    if path.parent == Path() and (bundled / path).is_file():
        return bundled / path
    if path.is_dir():
        raise FileNotFoundError(
            f"Folder '{path}' holds no study: it has no {STUDY} (`jimpact new` writes "
            f"one)."
        )
    tables = sorted(bundled.glob("*.toml"))
    choices = [x.name for x in tables if table in x.read_text(encoding="utf-8")]
    raise FileNotFoundError(
        f"Study '{path}' does not exist; bundled studies are {', '.join(choices)}."
        f"{suggestion(path, choices)}"
    )


def read_tables(path: Path) -> dict[str, Any]:
    """The tables of a TOML file; an error says where it is none."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        if path.suffix == ".csv":
            raise ValueError(
                "a study must be a TOML file, but this is a CSV file. `jimpact new fit "
                "my_fit` writes a study; name this file under [data] in it."
            ) from None
        raise ValueError(
            f"the study must be a TOML file: {_position(error)}."
        ) from None


def _position(error: Exception) -> str:
    """Phrase: place and reason of an error of the TOML parser.

    >>> from jimpact.cli.study_file import _position
    >>> _position(ValueError("Expected ']' (at line 9, column 7)"))
    "line 9, column 7: expected ']'"
    """
    reason, _, place = str(error).rstrip(")").partition(" (at ")
    reason = reason[:1].lower() + reason[1:]
    if place:
        return f"{place}: {reason}"
    return reason


# --------------------------------------------------------------------------------------
# keys


def check_tables(
    study: Mapping[str, Any], required: tuple[str, ...], others: tuple[str, ...]
) -> None:
    """Raise a ValueError unless a study has the `required` tables, and besides only
    `others`.

    A title is allowed, too.
    """
    for scene, system, kind in (
        ("scene", "system", "a motion"),
        ("system", "scene", "one impact"),
    ):
        if system in required and system not in study and scene in study:
            raise ValueError(
                f"the study must be of {kind}, with [{system}], but has [{scene}]: "
                "`jimpact simulate` takes [system], other commands [scene]."
            )
    check_keys("the study", study, ("title", *required, *others), required)
    for name in (*required, *others):
        if not isinstance(study.get(name, {}), dict):
            raise ValueError(f"`{name}` must be a table, but is {study[name]!r}.")


# ------------------------------------------------------------------------- tables of
# every study

# Keys of [fit], all of which are arguments of `fit` or `Search`; `method` is of impacts
# only.
FIT = ("free", "method", "loss", "starts", "seed", "max_steps", "profiles")


class Fitted(NamedTuple):
    """Statements of a study on its fit, by name of the parameter."""

    free: dict[str, Any]  # True, or a mask over contacts
    bounds: dict[str, Any]  # (low, high)
    priors: dict[str, Any]  # (mean, standard deviation)
    options: dict[str, Any]  # of `fit`, by name of the argument


def law_of(
    tables: Mapping[str, Any],
    other_law: str | None,
    folder: Path,
    scene: Scene | None = None,
) -> tuple[Law, dict[str, Any], Fitted]:
    """Law of a study, values of its parameters, and what it says on its fit.

    The tables [law], [law.bounds], [law.priors] and [fit] are checked on the way.

    Args:
        tables: of the study.
        other_law: name of a law in the place of the study's; values that it does not
            take are left out.
        folder: of the study, in which a module may lie that registers its law.
        scene: for a `RestitutionMatrix` without its matrix, which starts from an
            admissible one.

    Raises:
        ValueError: keys, or values, that the law or the fit does not have.
        WrongOption: `other_law` is no law.
    """
    table = tables["law"]
    # that it has a name; its other keys once the law is known
    check_keys("[law]", table, tuple(table), required=("name",))
    if "module" in table:
        import_laws(str(table["module"]), folder)
    study_law = str(table["name"]).lower()
    name = (other_law or study_law).lower()
    check_word("the law", study_law, REGISTRY)
    try:
        check_choice("law", name, REGISTRY)
    except ValueError as error:
        raise WrongOption(str(error)) from None
    not_of_law = (*OF_A_SCENE, *OF_A_MOTION)
    _check_table_of_law(table, study_law, not_of_law)
    row = REGISTRY[name]
    values = {key: x for key, x in table.items() if key in row.arguments}
    if row.law is RestitutionMatrix and "matrix" not in values and scene is not None:
        from jimpact.fits.matrices import admissible_start

        values["matrix"] = admissible_start([scene])
    options = dict(tables.get("fit", {}))
    check_keys("[fit]", options, FIT)
    free = _masks(options.pop("free", []))
    values = _with_exponent_as_used(values, free)

    def kept(pairs: Mapping[str, Any]) -> dict[str, Any]:
        """The pairs whose parameter the law has; all if it is the study's own."""
        fields = (*row.parameters, *not_of_law)
        return {
            x: y
            for x, y in pairs.items()
            if other_law is None or entry_of(x)[0] in fields
        }

    law = row.build(**values)
    free = kept(free)
    free_of_law = {
        x: choice for x, choice in free.items() if entry_of(x)[0] not in not_of_law
    }
    # refuses what this law does not have, whether or not it will be fitted
    if free_of_law:
        free_parameters(law, free_of_law, absolute=True)
    bounds = kept(table.get("bounds", {}))
    priors = kept(table.get("priors", {}))
    return law, values, Fitted(free, bounds, priors, options)


def _masks(free: Any) -> dict[str, Any]:
    """Free parameters by name: True, or a mask over contacts; `free` is a list or such
    a table.
    """
    if isinstance(free, dict):
        return free
    if isinstance(free, list) and all(isinstance(name, str) for name in free):
        return dict.fromkeys(free, True)
    raise ValueError(
        f"`free` must be a list of names or a table of masks, but is {free!r}."
    )


def _check_table_of_law(
    table: Mapping[str, Any], law: str, not_of_law: Sequence[str]
) -> None:
    """Raise a ValueError for keys of [law], [law.bounds] and [law.priors] that a law of
    this name does not have; `not_of_law`: what bounds and priors may have besides.
    """
    not_parameters = ("name", "module", "bounds", "priors")
    check_keys("[law]", table, (*REGISTRY[law].arguments, *not_parameters))
    allowed = (*REGISTRY[law].parameters, *not_of_law)
    for key in ("bounds", "priors"):
        pairs = table.get(key, {})
        if isinstance(pairs, dict):
            fields = {entry_of(x)[0]: x for x in pairs}
        else:
            fields = pairs  # no table, which `check_keys` refuses
        check_keys(f"[law.{key}]", fields, allowed)


def _with_exponent_as_used(
    values: dict[str, Any], free: Mapping[str, Any]
) -> dict[str, Any]:
    """A law's values with the exponent as an array if it is free, else as numbers:
    faster.
    """
    if "exponent" not in values:
        return values
    exponent = values["exponent"]
    if "exponent" in free:
        return values | {"exponent": np.asarray(exponent, float)}
    return values | {
        "exponent": tuple(exponent) if isinstance(exponent, list) else exponent
    }


def without_none(options: Mapping[str, Any]) -> dict[str, Any]:
    """The options that are not None; None means: as the study says."""
    return {key: value for key, value in options.items() if value is not None}


def fit_arguments(options: Mapping[str, Any], search: "Search") -> dict[str, Any]:
    """Arguments of `fit` from the options of a study: `starts`, `profiles`, and
    `search`.

    All other options replace entries of `search`.
    """
    own = {name: options[name] for name in ("starts", "profiles") if name in options}
    check_kind("[fit]", "profiles", own.get("profiles", False), bool, "true or false")
    others = {name: value for name, value in options.items() if name not in own}
    return own | {"search": dataclasses.replace(search, **others)}


def import_laws(module: str, folder: Path) -> None:
    """Import a module that registers laws: a file (.py, relative to the folder), or by
    its name.
    """
    if not module.endswith(".py"):
        importlib.import_module(module)
        return
    path = (folder / module).resolve()
    if not path.is_file():
        raise ValueError(
            f"`module` must be a file or an importable module, but '{path}' does not "
            f"exist."
        )
    imported = sys.modules.get(path.stem)
    if imported is not None:
        if Path(getattr(imported, "__file__", None) or "").resolve() == path:
            return
        raise ValueError(
            f"`module` must have a new name, but another '{path.stem}' is imported."
        )
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    loaded = importlib.util.module_from_spec(spec)
    # before it runs: classes are looked up there by name
    sys.modules[path.stem] = loaded
    try:
        spec.loader.exec_module(loaded)
    except BaseException:
        del sys.modules[path.stem]
        raise
