"""Shots of a study from what was seen or heard: its tables [track] and [bounces]."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jimpact as ji
from jimpact.bodies.base import Body
from jimpact.core.scene import Scene
from jimpact.shots.data import Experiments
from jimpact.tools.study_tables import check_keys, check_kind
from jimpact.tracks.track import Track

# Keys of [track]: the arguments of `ji.tracks.read` and of `find_impacts`, by their names, and that
# of `Track.experiments`; of [bounces]: the arguments of `ji.tracks.bounce_times`.
READ = ("columns", "time", "rate", "unit", "decimal")
FOUND = ("sigma", "acceleration", "drag", "contact", "shortest", "window", "quaternion", "inertia")
TRACK = ("file", *READ, *FOUND, "near_m")
BOUNCES = ("times", "sigma", "gravity")
UNKNOWN = "unknown"  # what a study writes where an acceleration or a drag is None
_NUMBER, _NUMBERS = (int | float, "a number"), (int | float | list, "a number or a list of numbers")
_KINDS = {
    **dict.fromkeys(("file", "time", "decimal", "quaternion"), (str, "a text")),
    **dict.fromkeys(("columns", "unit"), (str | list, "a text or a list of texts")),
    **dict.fromkeys(("rate", "drag", "contact", "window", "near_m", "gravity"), _NUMBER),
    **dict.fromkeys(("sigma", "acceleration", "inertia"), _NUMBERS),
    **{"shortest": (int, "a whole number"), "times": (list, "a list of numbers")},
}


def track_of(table: Mapping[str, Any], study: Path) -> Track:
    """Track in the file of the table [track], with its impacts; `study` is the path of the study.

    Angles are in rad, whatever their unit in the file.
    """
    check_keys("[track]", table, TRACK, ("file", "columns", "unit"))
    choice = dict(table)
    choice |= {key: None for key in ("acceleration", "drag") if choice.get(key) == UNKNOWN}
    _check_kinds("[track]", {key: x for key, x in choice.items() if x is not None})
    try:
        t, q = ji.tracks.read(study.parent / choice["file"], **_entries(choice, READ))
        unit = choice["unit"]
        stated = [unit] * q.shape[1] if isinstance(unit, str) else unit  # of each column
        units = ["rad" if each in ("rad", "deg") else "m" for each in stated]
        of_poses = "quaternion" in choice
        options = _entries(choice, FOUND)
        return ji.tracks.find_impacts(t, q, units=None if of_poses else units, **options)
    except (ValueError, TypeError) as error:
        raise ValueError(f"[track]: {error}") from None


def shots_of_track(track: Track, table: Mapping[str, Any], owner: Scene | Body) -> Experiments:
    """Shots of a track's impacts in the study's scene `owner`, or in those of the body's poses."""
    if isinstance(owner, Scene):
        if "near_m" in table:
            raise ValueError("`near_m` in [track] is for bodies, which have poses.")
        if len(track.units) != owner.size:
            raise ValueError(
                f"`columns` in [track] must be those of {owner.size} coordinates, one of "
                f"each body of the scene, but are {len(track.units)}."
            )
    near = {"near": table["near_m"]} if "near_m" in table else {}
    try:
        return track.experiments(owner, **near)
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
