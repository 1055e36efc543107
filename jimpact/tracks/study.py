"""Shots of a study from what was seen or heard: its tables [track] and [bounces]."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import jimpact as ji
from jimpact.bodies.base import Body
from jimpact.core.scene import Scene
from jimpact.shots.data import Experiments
from jimpact.tools.study_tables import check_keys, check_kind
from jimpact.tracks.tables_of_tracks import stated_unit
from jimpact.tracks.track import Track

# Keys of [track]: the arguments of `ji.tracks.read` and of `find_impacts`, by their
# names, and those of `Track.experiments`; of [bounces]: the arguments of
# `ji.tracks.bounce_times`.
READ = ("columns", "time", "frame", "rate", "unit", "decimal", "where")
FOUND = (
    "sigma",
    "acceleration",
    "drag",
    "contact",
    "shortest",
    "window",
    "quaternion",
    "inertia",
)
SHOTS = ("near_m", "label", "doubtful")
TRACK = ("file", *READ, *FOUND, *SHOTS)
BOUNCES = ("times", "sigma", "gravity")
UNKNOWN = "unknown"  # what a study writes where an acceleration or a drag is None
_NUMBER = (int | float, "a number")
_NUMBERS = (int | float | list, "a number or a list of numbers")
_KINDS = {
    **dict.fromkeys(("file", "decimal", "quaternion", "label"), (str, "a text")),
    **dict.fromkeys(("time", "frame"), (str | int, "a text or a number of a column")),
    **dict.fromkeys(("columns", "unit"), (str | list, "a text or a list of texts")),
    **dict.fromkeys(
        ("rate", "drag", "contact", "window", "near_m", "gravity"), _NUMBER
    ),
    **dict.fromkeys(("sigma", "acceleration", "inertia"), _NUMBERS),
    **{"shortest": (int, "a whole number"), "times": (list, "a list of numbers")},
    "where": (dict, "a table {column = value}"),
}


def track_of(table: Mapping[str, Any], study: Path) -> Track:
    """Track in the file of the table [track], with its impacts; `study` is the path of
    the study.

    Angles are in rad, whatever their unit in the file.
    """
    check_keys("[track]", table, TRACK, ("file", "columns"))
    choice = dict(table)
    choice |= {
        key: None for key in ("acceleration", "drag") if choice.get(key) == UNKNOWN
    }
    if isinstance(choice.get("acceleration"), list):
        choice["acceleration"] = [
            None if x == UNKNOWN else x for x in choice["acceleration"]
        ]
    doubtful = choice.pop("doubtful", False)
    if not isinstance(doubtful, bool):
        raise ValueError(
            f"`doubtful` in [track] must be true or false, but is {doubtful!r}."
        )
    _check_kinds("[track]", {key: x for key, x in choice.items() if x is not None})
    try:
        path = study.parent / choice["file"]
        t, q = ji.tracks.read(path, **_entries(choice, READ))
        if "quaternion" in choice:
            units = None
        else:
            units = _units(choice, q.shape[1])
        track = ji.tracks.find_impacts(t, q, units=units, **_entries(choice, FOUND))
        return replace(track, name=choice.get("label", path.stem))
    except (ValueError, TypeError) as error:
        raise ValueError(f"[track]: {error}") from None


def _units(choice: Mapping[str, Any], count: int) -> list[str]:
    """'m' or 'rad' of each of `count` columns: by `unit`, or as their names state."""
    names = choice["columns"]
    if isinstance(names, str):
        names = [names]
    unit = choice.get("unit") or [stated_unit(str(name)) for name in names]
    if isinstance(unit, str):
        stated = [unit] * count
    else:
        stated = unit
    return ["rad" if each in ("rad", "deg") else "m" for each in stated]


def shots_of_track(
    track: Track, table: Mapping[str, Any], owner: Scene | Body
) -> Experiments:
    """Shots of a track's impacts in the study's scene `owner`, or in those of the
    body's poses.
    """
    if isinstance(owner, Scene):
        if "near_m" in table:
            raise ValueError("`near_m` in [track] is for bodies, which have poses.")
        if len(track.units) != owner.size:
            raise ValueError(
                f"`columns` in [track] must be those of {owner.size} coordinates, one "
                f"of each body of the scene, but are {len(track.units)}."
            )
    if "near_m" in table:
        options = {"near": table["near_m"]}
    else:
        options = {}
    options["doubtful"] = table.get("doubtful", False)
    try:
        return track.experiments(owner, **options)
    except ValueError as error:
        raise ValueError(f"[track]: {error}") from None


def shots_of_bounces(table: Mapping[str, Any]) -> Experiments:
    """Shots of a ball that bounces at the times that the table [bounces] lists."""
    check_keys("[bounces]", table, BOUNCES, ("times", "sigma"))
    _check_kinds("[bounces]", table)
    try:
        return ji.tracks.bounce_times(**table)
    except (ValueError, TypeError) as error:
        raise ValueError(f"[bounces]: {error}") from None


def _check_kinds(where: str, table: Mapping[str, Any]) -> None:
    """Raise a ValueError for a value whose type is not that of its key in `_KINDS`."""
    for key, value in table.items():
        kind, words = _KINDS[key]
        check_kind(where, key, None if isinstance(value, bool) else value, kind, words)


def _entries(table: Mapping[str, Any], keys: tuple[str, ...]) -> dict[str, Any]:
    """The entries of a table with these keys; missing keys are left out."""
    return {key: table[key] for key in keys if key in table}
