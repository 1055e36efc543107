"""A study file before anything is built of it: located, read, its keys, words and ranges checked.

JAX is not needed for that, so the command line answers a typo at once. The names of laws, bodies
and methods, their arguments and ranges stand in `data/names.json`, which `tests/names.py` writes
from the declarations of the classes.
"""

import functools
import json
import sys
import tomllib
from collections.abc import Callable, Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from jimpact._checks import (
    ABBREVIATIONS,
    as_whole,
    check_choice,
    check_values,
    check_word,
    suggestion,
)
from jimpact.files.shots_file import read_positions, read_shots

STUDY = "study.toml"  # in a folder that `jimpact new` has made
OF_A_SCENE = ("mass", "gaps", "tilt")  # parts of a scene that a fit may have as parameters


Check = Callable[[str, str, Any], Any]  # of a table's head, a key and its value; raises ValueError


class Schema(NamedTuple):
    """The keys that a table of a study may have, with what is checked at once, and must have."""

    keys: Mapping[str, Check]
    required: tuple[str, ...] = ()


def anything(where: str, key: str, value: Any) -> None:
    """Nothing is checked: what gets the value does it."""


def flag(where: str, key: str, value: Any) -> None:
    """True or false."""
    if not isinstance(value, bool):
        raise ValueError(f"`{key}` in {where} must be true or false, but is {value!r}.")


def file_name(where: str, key: str, value: Any) -> None:
    """Text."""
    if not isinstance(value, str):
        raise ValueError(f"`{key}` in {where} must be a path, but is {value!r}.")


def side(where: str, key: str, value: Any) -> None:
    """Whether, or on which side, there is a wall."""
    if not isinstance(value, bool | str):
        raise ValueError(f"`{key}` must be true, false or a side, but is {value!r}.")


def sampled(where: str, key: str, value: Any) -> None:
    """A constant, or a table that is a distribution."""
    if isinstance(value, dict):
        distribution(key, value)


def sampled_law(where: str, key: str, value: Any) -> None:
    """A distribution for each parameter."""
    if not isinstance(value, dict):
        raise ValueError(f"[monte_carlo.law] must be a table, but is {value!r}.")
    for name, each in value.items():
        distribution(f"law.{name}", each)


def whole(low: int) -> Check:
    """An int of at least `low`."""
    return lambda where, key, value: as_whole(key, value, low)


def word(group: str) -> Check:
    """A word of this group of `names`."""
    return lambda where, key, value: check_choice(key, value, names()[group])


CHAIN = Schema({"masses_kg": anything, "wall": side, "gaps_m": anything}, ("masses_kg",))
AT_KEYS = ("q", "closed_below_m")  # of a scene that is a body in a configuration
SEARCH: dict[str, Check] = {"starts": whole(1), "seed": whole(0), "max_steps": whole(1)}
FIT_MOTION = Schema({"free": anything, "loss": word("losses"), **SEARCH, "profiles": flag})
FIT = Schema({"free": anything, "method": word("fit_methods"), **FIT_MOTION.keys})
DATA = Schema(
    {"file": file_name, "momentum_corrected": flag, "near_m": anything, "contacts": anything},
    ("file",),
)
SAMPLING = Schema(
    {
        **{"velocity_m_per_s": sampled, "gaps_m": sampled, "law": sampled_law},
        **{"samples": whole(1), "seed": anything, "chunk": whole(1), "bins": whole(1)},
    },
    ("velocity_m_per_s",),
)
DISTRIBUTIONS = {("high", "low"): "Uniform", ("mean", "std"): "Normal"}
GRAVITY = "gravity_m_per_s2"
MOTION_KEYS = {  # and the arguments of `simulate` that they give
    "q0": "q0",
    "v0": "v0",
    "t_end_s": "t_end",
    "samples": "samples",
    "method": "method",
    "max_events": "max_events",
}
METHOD_KEYS = {  # and the options of a method that they give
    "step_s": "step",
    "closed_below_m": "closed_below",
    "max_steps": "max_steps",
    "rtol": "rtol",
    "slow": "slow",
}
MOTION = Schema(
    dict.fromkeys((*MOTION_KEYS, *METHOD_KEYS, "t_start_s", "friction"), anything)
    | {"method": word("motion_methods")},
    ("q0", "v0", "t_end_s"),
)
BASE_KEYS = {"amplitude_m": "amplitude", "frequency_hz": "frequency", "phase_rad": "phase"}
BASE = Schema(dict.fromkeys((*BASE_KEYS, "direction"), anything), ("amplitude_m", "frequency_hz"))
# Tables of a study besides title, [law] and [scene] or [system], whose keys depend on their kind.
IMPACT_TABLES = {"fit": FIT, "data": DATA, "monte_carlo": SAMPLING}
MOTION_DATA = Schema({"file": file_name}, ("file",))
MOTION_TABLES = {"motion": MOTION, "base": BASE, "fit": FIT_MOTION, "data": MOTION_DATA}
# Units of the bodies' arguments, which a study writes behind their names. Words and directions have
# no unit here, nor have lists of points [m] or of mixed units (`corners` of a Polygon, `planes`,
# `at`), which the classes document.
_UNITS = {
    **dict.fromkeys(("mass", "masses", "sphere_mass", "rod_mass"), "kg"),
    **dict.fromkeys(
        ("width", "height", "length", "thickness", "radius", "radii", "gaps", "sizes"), "m"
    ),
    **dict.fromkeys(("centre", "rounding"), "m"),
    "inertia": "kg_m2",
    "angle": "rad",
}
NO_DATA = "a study must have a [data] table to be fitted, but has none."

T = TypeVar("T")


@functools.cache
def names() -> dict[str, Any]:
    """Names of this version: laws, bodies and methods with what they take, words of options."""
    return json.loads((files("jimpact") / "data" / "names.json").read_text(encoding="utf-8"))


def declared_laws() -> dict[str, dict[str, Any]]:
    """Declarations of the laws by name; users' laws too, where they are registered already."""
    registry = sys.modules.get("jimpact.registry")
    rows = {} if registry is None else registry.REGISTRY
    ours = names()["laws"]
    return ours | {name: row.declaration for name, row in rows.items() if name not in ours}


class LawTable(NamedTuple):
    """The table [law] of a study: the law's name, its arguments, what `fit` knows of them.

    `free` maps names to masks.
    """

    name: str
    arguments: dict[str, Any]
    bounds: dict[str, Any]
    priors: dict[str, Any]
    free: dict[str, Any]


class CheckedStudy(NamedTuple):
    """A study whose keys, words and ranges are right."""

    path: Path
    tables: dict[str, Any]
    law: LawTable
    motion: bool  # whether it is of a motion, else of one impact
    rows: int = 0  # shots or samples of its data, where these have been read

    @property
    def fit_options(self) -> dict[str, Any]:
        """The table [fit] without what is free."""
        return {key: x for key, x in self.tables.get("fit", {}).items() if key != "free"}

    @property
    def title(self) -> str:
        """The title, else the name of the file."""
        return str(self.tables.get("title", self.path.stem))

    @property
    def data_file(self) -> Path:
        """The file of the table [data]."""
        return self.path.parent / self.tables["data"]["file"]


# -------------------------------------------------------------------------- locating and reading


def from_file(
    path: str | Path,
    law: str | None,
    motion: bool | None,
    build: Callable[[CheckedStudy], T],
    prepare: Callable[[dict[str, Any], Path], None] | None = None,
) -> T:
    """What `build` makes of a study file, checked.

    Args:
        path: of the file, its folder, or the name of a bundled study.
        law: name of a law in the place of the study's; values that it does not take are left out.
        motion: whether it must be of a motion or of an impact; None: what it is.
        build: of the checked study.
        prepare: called before with the tables and the folder, to import the module that the study
            names; None: a law that may be registered there is not checked.
    """
    path = located(Path(path), {True: "[system]", False: "[scene]", None: "[law]"}[motion])
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        if path.suffix == ".csv":
            raise ValueError(
                f"{path}: a study must be a TOML file, but this is a CSV file. `jimpact new fit "
                "my_fit` writes a study; name this file under [data] in it."
            ) from None
        raise ValueError(f"{path}: the study must be a TOML file: {_position(error)}.") from None
    moves = "motion" in tables if motion is None else motion
    try:
        if prepare is not None:
            prepare(tables, path.parent)
        if moves:
            check_tables(tables, ("system", "law", "motion"), MOTION_TABLES)
            body_keys("[system]", tables["system"], (GRAVITY,))
        else:
            check_tables(tables, ("scene", "law"), IMPACT_TABLES)
            check_scene(tables["scene"])
        free = masks(tables.get("fit", {}).get("free", []))
        checked = check_law(tables["law"], law, free, prepare is not None)
        return build(CheckedStudy(path, tables, checked, moves))
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: {error}") from None


def is_motion(path: str | Path) -> bool:
    """Whether a study is of a motion."""
    return from_file(path, None, None, lambda study: study.motion)


def check_study(
    path: str | Path, law: str | None = None, motion: bool | None = None
) -> CheckedStudy:
    """A study with its data, all checked; arguments as of `from_file`."""

    def with_data(study: CheckedStudy) -> CheckedStudy:
        """The study, after its data are read."""
        if "data" not in study.tables:
            return study
        file = study.data_file
        rows = read_positions(file).time if study.motion else read_shots(file).values["pre"]
        return study._replace(rows=len(rows))

    return from_file(path, law, motion, with_data)


def _position(error: Exception) -> str:
    """Where a file is not TOML, and why.

    >>> from jimpact.files.study_file import _position
    >>> _position(ValueError("Expected ']' (at line 9, column 7)"))
    "line 9, column 7: expected ']'"
    """
    reason, _, place = str(error).rstrip(")").partition(" (at ")
    reason = reason[:1].lower() + reason[1:]
    return f"{place}: {reason}" if place else reason


def located(path: Path, table: str) -> Path:
    """The file, that of a folder (`jimpact new`), or the bundled study of this name."""
    if path.is_file():
        return path
    if (path / STUDY).is_file():
        return path / STUDY
    bundled = Path(str(files("jimpact") / "data"))
    if path.parent == Path() and (bundled / path).is_file():
        return bundled / path
    if path.is_dir():
        raise FileNotFoundError(
            f"Folder '{path}' holds no study: it has no {STUDY} (`jimpact new` writes one)."
        )
    tables = sorted(bundled.glob("*.toml"))
    choices = [x.name for x in tables if table in x.read_text(encoding="utf-8")]
    raise FileNotFoundError(
        f"Study '{path}' does not exist; bundled studies are {', '.join(choices)}."
        f"{suggestion(path, choices)}"
    )


# ---------------------------------------------------------------------------------- single tables


def check_scene(table: Mapping[str, Any]) -> None:
    """Check the table [scene]: a chain, or a body in a configuration."""
    if "kind" in table:
        body_keys("[scene]", table, AT_KEYS)
        check_keys("[scene]", table, tuple(table), ("q",))
        return
    check_table("[scene]", table, CHAIN)


def body_keys(
    where: str, table: Mapping[str, Any], others: tuple[str, ...] = ()
) -> tuple[str, dict[str, str]]:
    """The class of a body, and its arguments by key; `others` are keys of another meaning."""
    check_keys(where, table, tuple(table), required=("kind",))
    bodies = {name.lower(): name for name in names()["bodies"]}
    kind = bodies.get(str(table["kind"]).lower(), table["kind"])
    check_word(f"`kind` in {where}", kind, bodies.values())
    arguments = names()["bodies"][kind]
    keys = {f"{name}_{_UNITS[name]}" if name in _UNITS else name: name for name in arguments}
    required = tuple(key for key, name in keys.items() if arguments[name])
    check_keys(where, table, ("kind", *keys, *others), required)
    for several in {"bodies", "fixed"} & keys.keys() & table.keys():
        within = f"{where.removesuffix(']')}.{several}]"
        if not isinstance(table[several], list):
            raise ValueError(f"[{within}] must be tables, each headed by [{within}].")
        for part in table[several]:
            body_keys(within, part)
    return kind, keys


def check_law(
    table: Mapping[str, Any], other_law: str | None, free: dict[str, Any], modules: bool
) -> LawTable:
    """The table [law], checked by the declaration of its law, and what is free of that law.

    `modules`: whether the module that a study names has been imported.
    """
    check_keys("[law]", table, tuple(table), required=("name",))
    laws = declared_laws()
    study_law = str(table["name"]).lower()
    name = (other_law or study_law).lower()
    others = ("name", "module", "bounds", "priors")
    known = {key: table.get(key, {}) for key in ("bounds", "priors")}
    arguments = {k: x for k, x in table.items() if k not in others}
    for key in (study_law, name):
        if key not in laws and "module" in table and not modules:
            return LawTable(name, arguments, **known, free=free)
        check_word("the law", key, laws)
    check_keys("[law]", table, (*laws[study_law]["arguments"], *others))
    for key, pairs in known.items():
        fields = {_field(k): x for k, x in pairs.items()} if isinstance(pairs, dict) else pairs
        check_keys(f"[law.{key}]", fields, (*laws[study_law]["parameters"], *OF_A_SCENE))
    declared = laws[name]
    fitted = (*declared["parameters"], *OF_A_SCENE)
    arguments = {k: x for k, x in arguments.items() if k in declared["arguments"]}
    known = {
        key: {k: x for k, x in pairs.items() if _field(k) in fitted} for key, pairs in known.items()
    }
    _check_ranges(arguments, declared)
    if other_law is not None:
        free = {k: mask for k, mask in free.items() if _field(k) in fitted}
    elif name in names()["laws"]:  # parts of a user's law may have parameters of their own
        for parameter in free:
            if _field(parameter) not in (*declared["free"], *OF_A_SCENE):
                raise ValueError(
                    f"`free` in [fit] must name parameters of {name}, which has no {parameter!r}; "
                    f"it has {', '.join(declared['free'])}."
                    f"{suggestion(parameter, declared['free'], ABBREVIATIONS)}"
                )
    return LawTable(name, arguments, **known, free=free)


def _field(name: str) -> str:
    """The field of `restitution[2]`, or of a name without brackets."""
    return name.partition("[")[0]


def _check_ranges(arguments: Mapping[str, Any], declared: Mapping[str, Any]) -> None:
    """Check words and numbers that are the arguments of a law."""
    for key, value in arguments.items():
        if key in declared["choices"]:
            check_choice(key, value, declared["choices"][key])
        if key in declared["ranges"] and isinstance(value, bool | str):
            raise ValueError(f"Argument `{key}` must be numeric, but has value {value!r}.")
        if key in declared["ranges"] and isinstance(value, int | float):
            low, high, open_low, high_unless = declared["ranges"][key]
            if high is None or arguments.get(high_unless):
                high = float("inf")
            check_values(key, value, low=low, high=high, open_low=open_low)


def masks(free: Any) -> dict[str, Any]:
    """What is free, by name: True, or a mask over contacts."""
    if isinstance(free, dict):
        return free
    if isinstance(free, list) and all(isinstance(name, str) for name in free):
        return dict.fromkeys(free, True)
    raise ValueError(f"`free` must be a list of names or a table of masks, but is {free!r}.")


def distribution(name: str, value: Any) -> str:
    """Name of the distribution that a table means."""
    kind = DISTRIBUTIONS.get(tuple(sorted(value))) if isinstance(value, dict) else None
    if kind is None:
        raise ValueError(
            f"`{name}` in [monte_carlo] must have low and high, or mean and std, but is {value!r}."
        )
    return kind


def check_table(where: str, table: Mapping[str, Any], schema: Schema) -> None:
    """Raise a ValueError for unknown or missing keys, and for values that are not allowed."""
    check_keys(where, table, tuple(schema.keys), schema.required)
    for key, value in table.items():
        schema.keys[key](where, key, value)


def check_keys(
    where: str, table: Mapping[str, Any], allowed: tuple[str, ...], required: tuple[str, ...] = ()
) -> None:
    """Raise a ValueError for unknown or missing keys of a table."""
    if not isinstance(table, Mapping):
        raise ValueError(f"{where} must be a table, but is {table!r}.")
    for key in required:
        if key not in table:
            raise ValueError(
                f"{where} must have the key `{key}`, but has {', '.join(table) or 'none'}."
            )
    for key in table:
        if key not in allowed:
            raise ValueError(
                f"{where} may have the keys {', '.join(allowed)}, but has `{key}`."
                f"{suggestion(key, allowed)}"
            )


def check_tables(
    study: Mapping[str, Any], required: tuple[str, ...], tables: Mapping[str, Schema]
) -> None:
    """Raise a ValueError for tables that are unknown, missing or wrong; a title is allowed, too."""
    for scene, system, kind in (("scene", "system", "a motion"), ("system", "scene", "one impact")):
        if system in required and system not in study and scene in study:
            raise ValueError(
                f"the study must be of {kind}, with [{system}], but has [{scene}]: "
                "`jimpact simulate` takes [system], other commands [scene]."
            )
    allowed = dict.fromkeys(("title", *required, *tables))
    check_keys("the study", study, tuple(allowed), required)
    for name in (*required, *tables):
        if not isinstance(study.get(name, {}), dict):
            raise ValueError(f"`{name}` must be a table, but is {study[name]!r}.")
    for name, schema in tables.items():
        if name in study:
            check_table(f"[{name}]", study[name], schema)
