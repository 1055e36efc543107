"""Studies of motions: system, base, law, initial state and data, of a checked TOML file."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from jimpact.bodies.base import STANDARD_GRAVITY
from jimpact.cli.study import (
    Study,
    body_of,
    fit_arguments,
    import_module_of,
    study_of,
    with_exponent,
    without_none,
)
from jimpact.files.shots_file import UNEVEN_STEPS, Positions, read_positions
from jimpact.files.study_file import (
    BASE_KEYS,
    GRAVITY,
    METHOD_KEYS,
    MOTION_KEYS,
    NO_DATA,
    CheckedStudy,
    from_file,
)
from jimpact.fits.fitting import Fit
from jimpact.fits.parameters import default_free
from jimpact.law import Law
from jimpact.laws import REGISTRY
from jimpact.motion.fitting_motion import MOTION_SEARCH, fit_motion
from jimpact.motion.methods import METHODS, Method, as_method
from jimpact.motion.record import Motion
from jimpact.motion.simulate import simulate
from jimpact.motion.system import HarmonicBase, System, gravity

# Names of the directions of a base, by how many a body has.
_DIRECTIONS = {1: ("vertical",), 2: ("horizontal", "vertical"), 3: ("x", "y", "vertical")}


@dataclass(frozen=True)
class MotionStudy:
    """A study that `read_study` read; `run` simulates it, `fit` fits it to its data.

    Attributes:
        title: of pictures and reports.
        system: what moves, under its loads.
        law: with the study's values.
        arguments: of `simulate`, by name.
        measured: times, positions and their errors of `[data]`, else None.
        free: names -> masks of the parameters that `fit` fits.
        bounds: names -> (low, high).
        priors: names -> (mean, standard deviation).
        options: of `fit_motion`, by name.
    """

    title: str
    system: System
    law: Law
    arguments: dict[str, Any]
    measured: Positions | None = None
    free: dict[str, Any] = field(default_factory=dict)
    bounds: dict[str, Any] = field(default_factory=dict)
    priors: dict[str, Any] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)

    def fit(self, **options: Any) -> Fit:
        """`fit_motion` with the study's options, or with those that are passed and not None."""
        if self.measured is None:
            raise ValueError(NO_DATA)
        start, _ = self.arguments["t_end"]
        times, q, sigma = self.measured
        if abs(times[0] - start) > UNEVEN_STEPS * (times[1] - times[0]):
            raise ValueError(
                f"`t` in [data] must begin at {start:g} s, but begins at {times[0]:g} s."
            )
        arguments = {key: x for key, x in self.arguments.items() if key != "samples"}
        arguments["t_end"] = start, float(times[-1])
        arguments |= fit_arguments(self.options | without_none(options), MOTION_SEARCH)
        arguments |= {"free": self.free, "bounds": self.bounds, "priors": self.priors}
        return fit_motion(self.system, self.law, q, sigma=sigma, **arguments)

    def run(
        self, t_end: float | None = None, samples: int | None = None, progress: float | None = None
    ) -> Motion:
        """`simulate` with the study's arguments, or with those that are passed and not None."""
        start, end = self.arguments["t_end"]
        changes = {
            "t_end": (start, end if t_end is None else t_end),
            "samples": samples,
            "method": replace(self.arguments["method"], progress=progress),
        }
        return simulate(self.system, self.law, **(self.arguments | without_none(changes)))


def motion_study(path: str | Path, law: str | None = None) -> MotionStudy:
    """The study of a motion, see `read_study`."""
    return from_file(path, law, True, _motion_study_of, import_module_of)


def _motion_study_of(checked: CheckedStudy) -> MotionStudy:
    """The study of checked tables."""
    tables, free = checked.tables, checked.law.free
    values = with_exponent(checked.law.arguments, free)
    law = REGISTRY[checked.law.name].build(**values)
    motion = tables["motion"]
    arguments = {name: motion[key] for key, name in MOTION_KEYS.items() if key in motion}
    arguments["t_end"] = float(motion.get("t_start_s", 0.0)), motion["t_end_s"]
    arguments["method"] = _method(motion)
    return MotionStudy(
        checked.title,
        _system(tables["system"], tables.get("base"), motion.get("friction")),
        law,
        arguments=arguments,
        measured=read_positions(checked.data_file) if "data" in tables else None,
        free=free or dict.fromkeys(default_free(law)[:1], True),
        bounds=checked.law.bounds,
        priors=checked.law.priors,
        options=checked.fit_options,
    )


def _method(motion: Mapping[str, Any]) -> Method:
    """The method of [motion] with its options."""
    word = motion.get("method", "events")
    known = {field.name for field in fields(METHODS[word])}
    for key, name in METHOD_KEYS.items():
        if key in motion and name not in known:
            raise ValueError(f"`{key}` in [motion] must be left out for method {word!r}.")
    options = {name: motion[key] for key, name in METHOD_KEYS.items() if key in motion}
    return as_method(word, **options)


def _system(
    table: Mapping[str, Any], base: Mapping[str, Any] | None, friction: float | None
) -> System:
    """The body under its weight, on a base that shakes if there is one."""
    body = body_of("[system]", table, (GRAVITY,))
    acceleration = table.get(GRAVITY, STANDARD_GRAVITY)
    weight = gravity(body, acceleration) if acceleration else None
    if base is None:
        return System(body, potential=weight, friction=friction)
    directions = body.base_directions
    if directions is None:
        raise ValueError(f"[base] must be left out: a {type(body).__name__} has no base.")
    names = _DIRECTIONS[directions.shape[1]]
    direction = base.get("direction", "vertical")
    if direction not in names:
        raise ValueError(
            f"`direction` of a {type(body).__name__} must be {' or '.join(names)}, "
            f"but is {direction!r}."
        )
    motion = HarmonicBase(**{BASE_KEYS[key]: x for key, x in base.items() if key != "direction"})
    moved = directions[:, names.index(direction), None]
    return System(body, potential=weight, base=motion, base_directions=moved, friction=friction)


def read_study(path: str | Path, law: str | None = None) -> Study | MotionStudy:
    """A study from its TOML file: of one impact, or with a table [system] of a motion.

    Args:
        path: path of the file or of its folder, or the name of a bundled study
            (`three_balls.toml`, `cradle_motion.toml`).
        law: name of another law in the place of the study's.

    The tables of a file on impacts:

    - `[scene]`: masses_kg, wall, gaps_m (a chain, see `chain`); or kind, the name of a body, with
      its arguments (`width_m`, `mass_kg`, ...), q, its configuration at the impact, closed_below_m.
    - `[law]`: name (`jimpact laws`), start values (a number for all contacts or a list with one
      each), options, module (a file or module that registers the law, see `register`). A
      `restitution_matrix` without its matrix starts from an admissible one.
    - `[law.bounds]`: pairs, as `restitution = [0, 1]` or `"restitution[2]" = [0.5, 1]`.
    - `[law.priors]`: means with standard deviations, as `restitution = [0.9, 0.02]`, see `fit`.
    - `[fit]`: free (a list of names, or a table of masks), method, loss, starts, seed, max_steps,
      profiles.
    - `[data]`: file (relative to the study, see `read_experiments`), momentum_corrected; of shots
      with scenes of their own near_m, contacts (only shots with that many). Without data a study
      can be compared, not fitted.
    - `[monte_carlo]`: velocity_m_per_s, gaps_m, law, samples, seed, chunk, bins; see
      `monte_carlo`.

    On a motion, with [law], [law.bounds], [law.priors] and [fit] (without method) as above:

    - `[system]`: kind, the name of a body, with its arguments (`width_m`, `mass_kg`, ...), and
      gravity_m_per_s2, 0 for none.
    - `[base]`: amplitude_m, frequency_hz, phase_rad, direction (vertical; in the plane also
      horizontal, in space x or y).
    - `[motion]`: q0, v0, t_start_s, t_end_s, samples, method, max_events, options of the method
      (step_s, closed_below_m, max_steps, rtol, slow), and friction of the system.
    - `[data]`: file, a CSV file with columns t[s] in equal steps, q_1[m], q_2[rad], ... and perhaps
      sigma_q_1[m], ...

    Returns:
        A `Study`, or a `MotionStudy`.

    Raises:
        FileNotFoundError: no such study or data file.
        ValueError: the file is not TOML; a key is unknown or missing; scene, system, law or data
            refuse a value.

    >>> import jimpact as ji
    >>> ji.read_study("three_balls.toml").title, ji.read_study("cradle_motion.toml").title
    ('Three equal hard balls, one shot', "Newton's cradle, three balls")
    """

    def build(checked: CheckedStudy) -> Study | MotionStudy:
        """The study, of whatever kind it is."""
        return _motion_study_of(checked) if checked.motion else study_of(checked)

    return from_file(path, law, None, build, import_module_of)
