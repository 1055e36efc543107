"""A motion from a TOML study: system, base, law, initial state."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jimpact.law import Law
from jimpact.motion.record import Motion
from jimpact.motion.simulate import simulate
from jimpact.motion.system import (
    HarmonicBase,
    System,
    ball_system,
    block_system,
    column_system,
    cradle_system,
    dimer_system,
)
from jimpact.study import check_keys, check_tables, from_file, law_table

# kind -> builder, {key of the study: its argument}
_SYSTEMS: dict[str, tuple[Any, dict[str, str]]] = {
    "ball": (ball_system, {"mass_kg": "mass"}),
    "column": (column_system, {"masses_kg": "masses", "radii_m": "radii"}),
    "cradle": (
        cradle_system,
        {"masses_kg": "masses", "length_m": "length", "diameter_m": "diameter", "gap_m": "gap"},
    ),
    "block": (block_system, {"width_m": "width", "height_m": "height", "mass_kg": "mass"}),
    "dimer": (
        dimer_system,
        {
            "radius_m": "radius",
            "length_m": "length",
            "sphere_mass_kg": "sphere_mass",
            "rod_mass_kg": "rod_mass",
        },
    ),
}
_MOTION = {
    "q0": "q0",
    "v0": "v0",
    "t_end_s": "t_end",
    "t_start_s": "t_start",
    "samples": "samples",
    "method": "method",
    "step_s": "step",
    "friction": "friction",
    "max_events": "max_events",
    "rtol": "rtol",
    "slow": "slow",
}
_BASE = {
    "amplitude_m": "amplitude",
    "frequency_hz": "frequency",
    "phase_rad": "phase",
    "direction": "direction",
}


@dataclass(frozen=True)
class MotionStudy:
    """What `read_motion_study` found; `run` simulates it."""

    title: str
    system: System
    law: Law
    arguments: dict[str, Any]

    def run(self, **options: Any) -> Motion:
        """`simulate` with the study's arguments; options that are not None go first."""
        given = {key: value for key, value in options.items() if value is not None}
        return simulate(self.system, self.law, **(self.arguments | given))


def read_motion_study(path: str | Path) -> MotionStudy:
    """Read the study of a motion.

    Tables: `[system]` kind (ball, column, cradle, block, dimer), its dimensions and
    gravity_m_per_s2; `[base]` amplitude_m, frequency_hz, phase_rad, direction; `[law]` as in other
    studies; `[motion]` q0, v0, t_end_s and the options of `simulate`.

    Raises:
        FileNotFoundError: no such study; ValueError: no TOML, unknown or missing keys, and what
            system and law refuse.

    >>> from jimpact.motion.study_motion import read_motion_study
    >>> read_motion_study("cradle_motion.toml").title
    "Newton's cradle, three balls"
    """
    return from_file(path, "[system]", _study)


def _study(tables: Mapping[str, Any], path: Path) -> MotionStudy:
    check_tables(tables, ("system", "law", "motion"), ("base",))
    row, values, _ = law_table(tables["law"], None, path.parent)
    if isinstance(values.get("exponent"), list):
        values["exponent"] = tuple(values["exponent"])
    motion = tables["motion"]
    check_keys("[motion]", motion, tuple(_MOTION), required=("q0", "v0", "t_end_s"))
    arguments = {_MOTION[key]: value for key, value in motion.items()}
    system = _system(tables["system"], tables.get("base"))
    return MotionStudy(str(tables.get("title", path.stem)), system, row.build(**values), arguments)


def _system(table: Mapping[str, Any], base: Mapping[str, Any] | None) -> System:
    check_keys("[system]", table, tuple(table), required=("kind",))
    kind = table["kind"]
    if kind not in _SYSTEMS:
        raise ValueError(f"`kind` must be one of {', '.join(_SYSTEMS)}, but is {kind!r}.")
    build, names = _SYSTEMS[kind]
    names = names | {"gravity_m_per_s2": "acceleration"}
    check_keys("[system]", table, ("kind", *names))
    given = {names[key]: value for key, value in table.items() if key != "kind"}
    if base is None:
        return build(**given)
    if kind == "cradle":
        raise ValueError("[base] is not known to a cradle.")
    check_keys("[base]", base, tuple(_BASE), required=("amplitude_m", "frequency_hz"))
    told = {_BASE[key]: value for key, value in base.items()}
    line = kind in ("ball", "column")
    told.setdefault("direction", "line" if line else "vertical")
    if line != (told["direction"] == "line"):
        raise ValueError(
            f"`direction` of a {kind} must be {'line' if line else 'vertical or horizontal'}, "
            f"but is {told['direction']!r}."
        )
    return build(**given, base=HarmonicBase(**told))
