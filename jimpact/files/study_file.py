"""A study file before anything is built of it: found, read, its tables and words checked.

JAX is not needed for that, so the command line answers a typo at once. What laws, bodies and
methods are called and take is read from `data/names.json`, which `tests/names.py` writes from the
classes themselves.
"""

import functools
import json
import sys
import tomllib
from collections.abc import Callable, Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from jimpact._checks import as_whole, check_choice, check_values
from jimpact.files.shots_file import read_positions, read_shots

STUDY = "study.toml"  # of a folder that `jimpact new` has made
STUDY_TABLES = ("fit", "data", "observe", "monte_carlo")
SCENE_KEYS = ("masses_kg", "wall", "gaps_m")
AT_KEYS = ("q", "closed_below_m")  # of a scene that is a body in a configuration
FIT_KEYS = ("free", "method", "loss", "starts", "seed", "max_steps", "profiles")
MOTION_FIT_KEYS = tuple(key for key in FIT_KEYS if key != "method")
DATA_KEYS = ("file", "momentum_corrected", "near_m", "contacts")
OBSERVE_KEYS = ("quantity", "value", "sigma", "relative", "contact", "body", "bodies")
OBSERVE_SHOTS = ("velocity_m_per_s", "drop_height_m")  # one of them says what happens
SAMPLING_KEYS = ("velocity_m_per_s", "gaps_m", "law", "samples", "seed", "chunk", "bins")
DISTRIBUTIONS = {("high", "low"): "Uniform", ("mean", "std"): "Normal"}
FIT_METHODS = ("levenberg-marquardt", "adam", "sgd", "lbfgs")
GRAVITY = "gravity_m_per_s2"
MOTION_KEYS = {  # and what `simulate` calls them
    "q0": "q0",
    "v0": "v0",
    "t_end_s": "t_end",
    "t_start_s": "t_start",
    "samples": "samples",
    "method": "method",
    "step_s": "step",
    "friction": "friction",
    "max_events": "max_events",
    "closed_below_m": "closed_below",
    "max_steps": "max_steps",
    "rtol": "rtol",
    "slow": "slow",
}
BASE_KEYS = {"amplitude_m": "amplitude", "frequency_hz": "frequency", "phase_rad": "phase"}
# Units of the bodies' parameters, which stand behind their names in a study. Without one are words
# and directions, and lists that are points [m] or mix units, as the classes say: `corners` of a
# Polygon, `planes`, `walls`, `at`.
_UNITS = {
    **dict.fromkeys(("mass", "masses", "sphere_mass", "rod_mass"), "kg"),
    **dict.fromkeys(("disk_mass", "ball_masses"), "kg"),
    **dict.fromkeys(("width", "height", "length", "radius", "radii", "gaps", "sizes"), "m"),
    **dict.fromkeys(("centre", "rounding", "disk_radius", "ball_radius"), "m"),
    "inertia": "kg_m2",
    "angle": "rad",
}
NO_DATA = "a study must have a [data] table or [[observe]] to be fitted, but has none."

T = TypeVar("T")


@functools.cache
def names() -> dict[str, Any]:
    """Laws, bodies and methods by name, as the classes of this version have them."""
    return json.loads((files("jimpact") / "data" / "names.json").read_text(encoding="utf-8"))


class Words(NamedTuple):
    """What the [law] table of a law may hold."""

    arguments: tuple[str, ...]
    parameters: tuple[str, ...]


def known_laws() -> dict[str, Words]:
    """Those of the package by name; others are registered by modules."""
    rows = names()["laws"].items()
    return {name: Words(tuple(x["arguments"]), tuple(x["parameters"])) for name, x in rows}


def callers_laws() -> set[str]:
    """Names of laws that who calls this from Python has registered."""
    registry = sys.modules.get("jimpact.registry")
    return set() if registry is None else registry.REGISTRY.keys() - known_laws().keys()


# ------------------------------------------------------------------------------- finding, reading


def from_file(path: str | Path, table: str, build: Callable[[dict[str, Any], Path], T]) -> T:
    """What `build` makes of a study file's tables; studies of a kind have this `table`."""
    path = located(Path(path), table)
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: the study must be a TOML file, but {error}.") from None
    try:
        return build(tables, path)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: {error}") from None


def located(path: Path, table: str) -> Path:
    """The file, that of a folder (`jimpact new`), or the bundled study of this name."""
    if path.is_file() or (path / STUDY).is_file():
        return path if path.is_file() else path / STUDY
    bundled = Path(str(files("jimpact") / "data"))
    if path.parent == Path() and (bundled / path).is_file():
        return bundled / path
    tables = sorted(bundled.glob("*.toml"))
    found = ", ".join(p.name for p in tables if table in p.read_text(encoding="utf-8"))
    raise FileNotFoundError(f"Study '{path}' does not exist; bundled studies are {found}.")


# -------------------------------------------------------------------------------------- whole files


class Found(NamedTuple):
    """What a study holds: number of measured shots, whether it is for sampling, for fitting."""

    shots: int
    sampled: bool
    fitted: bool


def check_study(path: str | Path, law: str | None = None) -> Found:
    """Refuse a study whose tables, words or shots are wrong; see `read_study`."""

    def check(tables: dict[str, Any], file: Path) -> Found:
        check_tables(tables, ("scene", "law"), STUDY_TABLES)
        check_scene(tables["scene"])
        _check_law(tables["law"], law, check_fit(tables.get("fit", {})))
        shots = 0
        if "data" in tables:
            check_data(tables["data"])
            shots = len(read_shots(file.parent / tables["data"]["file"]).values["pre"])
        if "observe" in tables:
            check_observed(tables["observe"], shots)
        if "monte_carlo" in tables:
            check_sampling(tables["monte_carlo"])
        return Found(shots, "monte_carlo" in tables, bool(shots) or "observe" in tables)

    return from_file(path, "[scene]", check)


def check_motion_study(path: str | Path, law: str | None = None) -> bool:
    """Refuse the study of a motion whose tables or words are wrong; see `read_motion_study`.

    And whether there is something to fit.
    """

    def check(tables: dict[str, Any], file: Path) -> bool:
        check_motion_tables(tables)
        _check_law(tables["law"], law, check_fit(tables.get("fit", {})))
        body_keys("[system]", tables["system"], (GRAVITY,))
        if "data" in tables:
            read_positions(file.parent / tables["data"]["file"])
        return "data" in tables

    return from_file(path, "[system]", check)


def is_motion(path: str | Path) -> bool:
    """Whether a study is of a motion."""
    return from_file(path, "[law]", lambda tables, _: "motion" in tables)


# ------------------------------------------------------------------------------------ single tables


def check_motion_tables(tables: Mapping[str, Any]) -> None:
    """Those that do not depend on law and body."""
    check_tables(tables, ("system", "law", "motion"), ("base", "fit", "data"))
    check_keys("[motion]", tables["motion"], tuple(MOTION_KEYS), ("q0", "v0", "t_end_s"))
    if "base" in tables:
        keys = (*BASE_KEYS, "direction")
        check_keys("[base]", tables["base"], keys, ("amplitude_m", "frequency_hz"))
    if "fit" in tables:
        check_fit(tables["fit"], MOTION_FIT_KEYS)
    if "data" in tables:
        check_keys("[data]", tables["data"], ("file",), required=("file",))


def check_scene(table: Mapping[str, Any]) -> None:
    """A chain, or a body in a configuration."""
    if "kind" in table:
        body_keys("[scene]", table, AT_KEYS)
        check_keys("[scene]", table, tuple(table), required=("q",))
        return
    check_keys("[scene]", table, SCENE_KEYS, required=("masses_kg",))
    wall = table.get("wall", False)
    if not isinstance(wall, bool | str):
        raise ValueError(f"`wall` must be true, false or a side, but is {wall!r}.")


def body_keys(
    where: str, table: Mapping[str, Any], others: tuple[str, ...] = ()
) -> tuple[str, dict[str, str]]:
    """The class of a body, and its arguments' names by key; `others` belong to somebody else."""
    check_keys(where, table, tuple(table), required=("kind",))
    bodies = {name.lower(): name for name in names()["bodies"]}
    kind = bodies.get(str(table["kind"]).lower())
    if kind is None:
        known = ", ".join(bodies.values())
        raise ValueError(f"`kind` in {where} must be one of {known}, but is {table['kind']!r}.")
    arguments = names()["bodies"][kind]
    keys = {f"{name}_{_UNITS[name]}" if name in _UNITS else name: name for name in arguments}
    needed = tuple(key for key, name in keys.items() if arguments[name])
    check_keys(where, table, ("kind", *keys, *others), needed)
    if "bodies" in table and "bodies" in keys:
        within = f"{where.removesuffix(']')}.bodies]"
        if not isinstance(table["bodies"], list):
            raise ValueError(f"[{within}] must be tables, each headed by [{within}].")
        for part in table["bodies"]:
            body_keys(within, part)
    return kind, keys


def law_values(
    table: Mapping[str, Any], other: str | None, laws: Mapping[str, Any]
) -> tuple[str, dict[str, Any], dict[str, Any]]:
    """Name of the law, start values and bounds; of another law only what both have is kept."""
    table = dict(table)
    check_keys("[law]", table, tuple(table), required=("name",))
    own = str(table.pop("name")).lower()
    name = (other or own).lower()
    for key in (own, name):
        if key not in laws:
            raise ValueError(f"the law must be one of {', '.join(laws)}, but is {key!r}.")
    bounds = table.pop("bounds", {})
    check_keys("[law]", table, (*laws[own].arguments, "name", "module", "bounds"))
    check_keys("[law.bounds]", bounds, laws[own].parameters)
    kept = {k: v for k, v in table.items() if k in laws[name].arguments}
    return name, kept, {k: v for k, v in bounds.items() if k in laws[name].parameters}


def _check_law(table: Mapping[str, Any], other: str | None, free: Mapping[str, Any]) -> None:
    """Words and ranges of the law, and what is free of it, but where only its class knows them."""
    wanted = {str(table.get("name", "")).lower(), (other or "").lower()}
    if "module" in table or wanted & callers_laws():
        return
    name, values, _ = law_values(table, other, known_laws())
    row = names()["laws"][name]
    for key, value in values.items():
        if key in row["choices"]:
            check_choice(key, value, row["choices"][key])
        if key in row["ranges"] and isinstance(value, bool | str):
            raise ValueError(f"Argument `{key}` must be numeric, but has value {value!r}.")
        if key in row["ranges"] and isinstance(value, int | float):
            low, high, open_low, high_unless = row["ranges"][key]
            high = float("inf") if high is None or values.get(high_unless) else high
            check_values(key, value, low=low, high=high, open_low=open_low)
    for parameter in free if other is None else ():
        if parameter not in row["free"]:
            raise ValueError(
                f"`free` in [fit] must name parameters of {name}, {', '.join(row['free'])}, "
                f"but has {parameter!r}."
            )


def check_fit(table: Mapping[str, Any], keys: tuple[str, ...] = FIT_KEYS) -> dict[str, Any]:
    """What is free, by name, nothing where nobody says; the table's words are checked."""
    check_keys("[fit]", table, keys)
    _check_flag("[fit]", table, "profiles")
    for key, low in (("starts", 1), ("seed", 0), ("max_steps", 1)):
        as_whole(key, table.get(key, low), low)
    check_choice("method", table.get("method", FIT_METHODS[0]), FIT_METHODS)
    free = table.get("free", [])
    if isinstance(free, dict):
        return free
    if isinstance(free, list) and all(isinstance(name, str) for name in free):
        return dict.fromkeys(free, True)
    raise ValueError(f"`free` must be a list of names or a table of masks, but is {free!r}.")


def check_data(table: Mapping[str, Any]) -> None:
    """The table [data] of shots."""
    check_keys("[data]", table, DATA_KEYS, required=("file",))
    _check_flag("[data]", table, "momentum_corrected")


def _check_flag(where: str, table: Mapping[str, Any], key: str) -> None:
    if not isinstance(table.get(key, False), bool):
        raise ValueError(f"`{key}` in {where} must be true or false, but is {table[key]!r}.")


def check_observed(tables: list[Any], shots: int) -> None:
    """The tables [[observe]] of a study with so many shots in a file."""
    if shots:
        raise ValueError("a study must have [data] or [[observe]], but has both.")
    for number, table in enumerate(tables):
        where = f"[[observe]] {number + 1}"
        check_keys(where, table, (*OBSERVE_KEYS, *OBSERVE_SHOTS), ("quantity", "value"))
        _check_flag(where, table, "relative")
        given = [key for key in OBSERVE_SHOTS if key in table]
        if len(given) != 1:
            told = " and ".join(given) or "none"
            raise ValueError(
                f"{where} must have one of {', '.join(OBSERVE_SHOTS)}, but has {told}."
            )


def check_sampling(table: Mapping[str, Any]) -> None:
    """The table [monte_carlo]."""
    check_keys("[monte_carlo]", table, SAMPLING_KEYS, required=("velocity_m_per_s",))
    random = table.get("law", {})
    if not isinstance(random, dict):
        raise ValueError(f"[monte_carlo.law] must be a table, but is {random!r}.")
    for name, value in random.items():
        distribution(f"law.{name}", value)
    for name, value in table.items():
        if isinstance(value, dict) and name != "law":
            distribution(name, value)


def distribution(name: str, value: Any) -> str:
    """Name of the distribution that a table means."""
    kind = DISTRIBUTIONS.get(tuple(sorted(value))) if isinstance(value, dict) else None
    if kind is None:
        raise ValueError(
            f"`{name}` in [monte_carlo] must have low and high, or mean and std, but is {value!r}."
        )
    return kind


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
            raise ValueError(f"{where} may have the keys {', '.join(allowed)}, but has `{key}`.")


def check_tables(
    study: Mapping[str, Any], required: tuple[str, ...], others: tuple[str, ...]
) -> None:
    """Raise a ValueError unless a study has these tables, and besides them a title at most."""
    for scene, system, kind in (("scene", "system", "a motion"), ("system", "scene", "one impact")):
        if system in required and system not in study and scene in study:
            raise ValueError(
                f"the study must be of {kind}, with [{system}], but has [{scene}]: "
                "`jimpact simulate` takes [system], other commands [scene]."
            )
    check_keys("the study", study, ("title", *required, *others), required)
    for name in (*required, *others):
        given = study.get(name, [] if name == "observe" else {})
        if name == "observe" and not isinstance(given, list):
            raise ValueError("`observe` must be tables, each headed by [[observe]].")
        if name != "observe" and not isinstance(given, dict):
            raise ValueError(f"`{name}` must be a table, but is {given!r}.")
