"""Keys of a study on a motion: its tables [system], [base] and [motion]."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from jimpact.bodies.base import STANDARD_GRAVITY
from jimpact.bodies.study import body_of
from jimpact.motion.methods import METHODS, Method, as_method
from jimpact.motion.system import HarmonicBase, System, gravity
from jimpact.tools.checks import check_choice
from jimpact.tools.study_tables import arguments_of, check_keys

GRAVITY = "gravity_m_per_s2"
# Keys of the tables [motion] and [base], and the arguments that they are: of
# `simulate`, of a method, of `HarmonicBase`.
MOTION = {
    **{
        "q0": "q0",
        "v0": "v0",
        "t_end_s": "t_end",
        "samples": "samples",
        "method": "method",
    },
    "max_events": "max_events",
}
METHOD = {
    **{"step_s": "step", "closed_below_m": "closed_below", "max_steps": "max_steps"},
    **{"rtol": "rtol", "slow": "slow"},
}
OTHERS = ("t_start_s", "friction")
BASE = {"amplitude_m": "amplitude", "frequency_hz": "frequency", "phase_rad": "phase"}
# Names of the directions of a base, by how many a body has.
_DIRECTIONS = {
    1: ("vertical",),
    2: ("horizontal", "vertical"),
    3: ("x", "y", "vertical"),
}


def run_of(table: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of `simulate` but system and law, from the table [motion]."""
    known = (*MOTION, *METHOD, *OTHERS)
    check_keys("[motion]", table, known, ("q0", "v0", "t_end_s"))
    arguments = arguments_of(table, MOTION)
    arguments["t_end"] = float(table.get("t_start_s", 0.0)), table["t_end_s"]
    arguments["method"] = _method(table)
    return arguments


def _method(motion: Mapping[str, Any]) -> Method:
    """Method of a motion with its options, from the table [motion]; default:
    'events'.
    """
    word = motion.get("method", "events")
    check_choice("method", word, METHODS)
    known = {field.name for field in fields(METHODS[word])}
    for key, name in METHOD.items():
        if key in motion and name not in known:
            raise ValueError(
                f"`{key}` in [motion] must be left out for method {word!r}."
            )
    return as_method(word, **arguments_of(motion, METHOD))


def system_of(
    table: Mapping[str, Any], base: Mapping[str, Any] | None, friction: float | None
) -> System:
    """System of a body under its weight, from the table [system], on the base of [base]
    if any.
    """
    body = body_of("[system]", table, (GRAVITY,))
    acceleration = table.get(GRAVITY, STANDARD_GRAVITY)
    if acceleration:
        weight = gravity(body, acceleration)
    else:
        weight = None
    if base is None:
        return System(body, potential=weight, friction=friction)
    check_keys("[base]", base, (*BASE, "direction"), ("amplitude_m", "frequency_hz"))
    directions = body.base_directions
    if directions is None:
        raise ValueError(
            f"[base] must be left out: a {type(body).__name__} has no base."
        )
    names = _DIRECTIONS[directions.shape[1]]
    direction = base.get("direction", "vertical")
    if direction not in names:
        raise ValueError(
            f"`direction` of a {type(body).__name__} must be {' or '.join(names)}, "
            f"but is {direction!r}."
        )
    motion = HarmonicBase(**arguments_of(base, BASE))
    column = directions[:, names.index(direction), None]
    return System(
        body, potential=weight, base=motion, base_directions=column, friction=friction
    )
