"""A motion from a TOML study: system, base, law, initial state."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jimpact.bodies.base import STANDARD_GRAVITY
from jimpact.law import Law
from jimpact.motion.record import Motion
from jimpact.motion.simulate import simulate
from jimpact.motion.system import HarmonicBase, System, gravity
from jimpact.study import body_of, law_table
from jimpact.study_file import (
    BASE_KEYS,
    GRAVITY,
    MOTION_KEYS,
    check_motion_tables,
    from_file,
)

# directions of a base by how many a body has
_DIRECTIONS = {1: ("vertical",), 2: ("horizontal", "vertical"), 3: ("x", "y", "vertical")}


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

    Tables: `[system]` a body (see `jimpact.study.body_of`) and gravity_m_per_s2, 0 for none;
    `[base]` amplitude_m, frequency_hz, phase_rad, direction (vertical; in the plane also
    horizontal, in space x or y); `[law]` as in other studies; `[motion]` q0, v0, t_end_s and the
    options of `simulate`.

    Raises:
        FileNotFoundError: no such study; ValueError: no TOML, unknown or missing keys, and what
            system and law refuse.

    >>> from jimpact.motion.study_motion import read_motion_study
    >>> read_motion_study("cradle_motion.toml").title
    "Newton's cradle, three balls"
    """
    return from_file(path, "[system]", _study)


def _study(tables: Mapping[str, Any], path: Path) -> MotionStudy:
    check_motion_tables(tables)
    row, values, _ = law_table(tables["law"], None, path.parent)
    if isinstance(values.get("exponent"), list):
        values["exponent"] = tuple(values["exponent"])
    arguments = {MOTION_KEYS[key]: value for key, value in tables["motion"].items()}
    system = _system(tables["system"], tables.get("base"))
    return MotionStudy(str(tables.get("title", path.stem)), system, row.build(**values), arguments)


def _system(table: Mapping[str, Any], base: Mapping[str, Any] | None) -> System:
    body = body_of("[system]", table, (GRAVITY,))
    acceleration = table.get(GRAVITY, STANDARD_GRAVITY)
    weight = gravity(body, acceleration) if acceleration else None
    if base is None:
        return System(body, potential=weight)
    ways = body.base_directions
    if ways is None:
        raise ValueError(f"[base] must be left out: a {type(body).__name__} has no base.")
    names = _DIRECTIONS[ways.shape[1]]
    chosen = base.get("direction", "vertical")
    if chosen not in names:
        raise ValueError(
            f"`direction` of a {type(body).__name__} must be {' or '.join(names)}, "
            f"but is {chosen!r}."
        )
    moves = HarmonicBase(**{BASE_KEYS[key]: x for key, x in base.items() if key != "direction"})
    along = ways[:, names.index(chosen), None]
    return System(body, potential=weight, base=moves, base_directions=along)
