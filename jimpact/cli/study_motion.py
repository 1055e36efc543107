"""A motion from a TOML study: system, base, law, initial state."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jimpact.bodies.base import STANDARD_GRAVITY
from jimpact.cli.study import body_of, law_table, with_exponent
from jimpact.files.shots_file import Positions, read_positions
from jimpact.files.study_file import (
    BASE_KEYS,
    GRAVITY,
    MOTION_FIT_KEYS,
    MOTION_KEYS,
    NO_DATA,
    check_fit,
    check_motion_tables,
    from_file,
)
from jimpact.fits.fitting import Fit
from jimpact.fits.parameters import default_free
from jimpact.law import Law, free_parameters_of
from jimpact.motion.fitting_motion import fit_motion
from jimpact.motion.record import Motion
from jimpact.motion.simulate import simulate
from jimpact.motion.system import HarmonicBase, System, gravity

# directions of a base by how many a body has
_DIRECTIONS = {1: ("vertical",), 2: ("horizontal", "vertical"), 3: ("x", "y", "vertical")}


@dataclass(frozen=True)
class MotionStudy:
    """What `read_motion_study` found; `run` simulates it, `fit` fits it to its data.

    Attributes:
        title: of pictures and reports.
        system: what moves, under its loads.
        law: with the study's values.
        arguments: of `simulate`, by name.
        measured: times, positions and their errors of `[data]`, else None.
        free: names -> masks of the parameters that `fit` finds.
        bounds: names -> (low, high).
        options: of `fit_motion`, by name.
    """

    title: str
    system: System
    law: Law
    arguments: dict[str, Any]
    measured: Positions | None = None
    free: dict[str, Any] = field(default_factory=dict)
    bounds: dict[str, Any] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)

    def fit(self, **options: Any) -> Fit:
        """`fit_motion` with the study's data and options; those not None here go first."""
        if self.measured is None:
            raise ValueError(NO_DATA)
        given = {key: value for key, value in options.items() if value is not None}
        start = float(self.arguments.get("t_start", 0.0))
        times, q, sigma = self.measured
        if abs(times[0] - start) > 1e-3 * (times[1] - times[0]):
            raise ValueError(f"`t` in [data] must begin at {start:g} s, but does at {times[0]:g}.")
        arguments = {key: x for key, x in self.arguments.items() if key != "samples"}
        arguments["t_end"] = float(times[-1])
        # `fit` and `simulate` both know limits of steps
        if "max_steps" in arguments:
            raise ValueError("`max_steps` in [motion] must be left out where a motion is fitted.")
        both = arguments | self.options | given
        return fit_motion(
            self.system, self.law, q, free=self.free, sigma=sigma, bounds=self.bounds, **both
        )

    def run(self, **options: Any) -> Motion:
        """`simulate` with the study's arguments; options that are not None go first."""
        given = {key: value for key, value in options.items() if value is not None}
        return simulate(self.system, self.law, **(self.arguments | given))


def read_motion_study(path: str | Path, law: str | None = None) -> MotionStudy:
    """The study of a motion from its TOML file: system, law, initial state, perhaps data.

    Args:
        path: of the file, or the name of a bundled study (`cradle_motion.toml`).
        law: name of another law in the place of the study's.

    The tables of the file:

    - `[system]`: kind, the name of a body, with its arguments (`width_m`, `mass_kg`, ...), and
      gravity_m_per_s2, 0 for none.
    - `[base]`: amplitude_m, frequency_hz, phase_rad, direction (vertical; in the plane also
      horizontal, in space x or y).
    - `[law]`, `[law.bounds]`: as in other studies, see `read_study`.
    - `[motion]`: q0, v0, t_end_s and the options of `simulate`.
    - `[data]`: file, a CSV file with columns t[s] in equal steps, q_1[m], q_2[rad], ... and perhaps
      sigma_q_1[m], ...; `[fit]` (without method): what is free. With these it can be fitted.

    Returns:
        A `MotionStudy`.

    Raises:
        FileNotFoundError: no such study or data file.
        ValueError: no TOML, unknown or missing keys, and what system and law refuse.

    >>> import jimpact as ji
    >>> ji.read_motion_study("cradle_motion.toml").title
    "Newton's cradle, three balls"
    """
    return from_file(path, "[system]", lambda tables, file: _study(tables, file, law))


def _study(tables: Mapping[str, Any], path: Path, other_law: str | None) -> MotionStudy:
    check_motion_tables(tables)
    row, values, bounds = law_table(tables["law"], other_law, path.parent)
    free = check_fit(tables.get("fit", {}), MOTION_FIT_KEYS)
    if other_law is not None:
        free = {name: mask for name, mask in free.items() if name in row.parameters}
    law = row.build(**with_exponent(values, free))
    free = free or dict.fromkeys(default_free(free_parameters_of(law))[:1], True)
    arguments = {MOTION_KEYS[key]: value for key, value in tables["motion"].items()}
    system = _system(tables["system"], tables.get("base"))
    seen = read_positions(path.parent / tables["data"]["file"]) if "data" in tables else None
    options = {key: x for key, x in tables.get("fit", {}).items() if key != "free"}
    title = str(tables.get("title", path.stem))
    return MotionStudy(title, system, law, arguments, seen, free, bounds, options)


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
