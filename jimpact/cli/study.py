"""Studies of one impact: scene, law, what is free and the data; and `read_study` for
any study.

A study that is not fitted imports no fits, and one of an impact no motions.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import jimpact as ji
from jimpact.bodies.base import CLOSED_BELOW, Body
from jimpact.bodies.study import body_of
from jimpact.cli.study_file import (
    NO_DATA,
    WrongOption,
    check_tables,
    fit_arguments,
    law_of,
    located,
    read_tables,
    without_none,
)
from jimpact.core.law import Law, free_parameters_of
from jimpact.core.scene import Scene, chain
from jimpact.fits.parameters import OF_SPEED, default_free
from jimpact.shots.data import Experiments, read_experiments
from jimpact.tools.checks import missing_room
from jimpact.tools.study_tables import arguments_of, check_keys, check_kind

if TYPE_CHECKING:
    from jimpact.cli.study_motion import MotionStudy
    from jimpact.fits.problem import FitProblem
    from jimpact.fits.report import Fit
    from jimpact.tracks.track import Track

# Rooms that hold the keys of their tables, `jimpact/ROOM/study.py`. One that is left
# out takes them with it: a study with such a table is refused, all others are read.
ROOMS = {"track": "tracks", "bounces": "tracks", "monte_carlo": "montecarlo"}

# Keys of the other tables, and the arguments that they are: of `chain`, of
# `Body.scene`, of `read_experiments`.
CHAIN = {"masses_kg": "masses", "wall": "wall", "gaps_m": "gaps"}
CONFIGURATION = {"q": "q", "closed_below_m": "closed_below"}
DATA = ("file", "momentum_corrected", "near_m", "contacts")
# tables of shots, of which a study has one at most
SHOTS = ("data", "track", "bounces")
AnyStudy = TypeVar("AnyStudy")


@dataclass(frozen=True)
class Study:
    """A study that `read_study` read; `run` fits it, `monte_carlo(**study.monte_carlo)`
    samples it.

    Attributes:
        title: of pictures and reports.
        scene: what collides.
        law: with the study's values.
        free: names -> masks of the parameters that `run` fits.
        bounds: names -> (low, high).
        priors: names -> (mean, standard deviation).
        experiments: the shots, None without `[data]`, `[track]` and `[bounces]`.
        parameters: the law's values as the file states them.
        options: of `fit`, by name.
        monte_carlo: arguments of `monte_carlo`, empty without `[monte_carlo]`.
        velocities: names of the velocities of a body with their units; empty of a
            chain.
        track: that of `[track]` with its impacts and warnings, else None.
    """

    title: str
    scene: Scene
    law: Law
    free: dict[str, Any]
    bounds: dict[str, Any]
    experiments: Experiments | None
    parameters: dict[str, Any]
    options: dict[str, Any] = field(default_factory=dict)
    priors: dict[str, Any] = field(default_factory=dict)
    monte_carlo: dict[str, Any] = field(default_factory=dict)
    velocities: tuple[str, ...] = ()
    track: "Track | None" = None

    def run(self, **options: Any) -> "Fit":
        """`fit` with the study's options, or with those that are passed and not
        None.
        """
        from jimpact.fits.problem import of_shots

        problem = self._problem(of_shots)  # `fit` passes on errors of v-
        chosen = self.options | without_none(options)
        return ji.fit(problem, **fit_arguments(chosen, ji.Search()))

    @property
    def problem(self) -> "FitProblem":
        """The problem that `run` solves."""
        return self._problem(ji.FitProblem.from_shots)

    def _problem(self, of_shots: Callable[..., "FitProblem"]) -> "FitProblem":
        """The problem of the study's shots, made by `of_shots` (law, scene, shots,
        choice).
        """
        choice = self.free, self.bounds, self.priors
        if self.experiments is None:
            raise ValueError(NO_DATA)
        return of_shots(self.law, self.scene, self.experiments, *choice)


def read_study(path: str | Path, law: str | None = None) -> "Study | MotionStudy":
    """A study from its TOML file: of one impact, or with a table [system] of a motion.

    Args:
        path: path of the file or of its folder, or the name of a bundled study
            (`three_balls.toml`, `cradle_motion.toml`).
        law: name of another law in the place of the study's.

    The tables of a file on impacts:

    - `[scene]`: masses_kg, wall, gaps_m (a chain, see `chain`); or kind, the name of a
      body, with its arguments (`width_m`, `mass_kg`, ...), q, its configuration at the
      impact, closed_below_m.
    - `[law]`: name (`jimpact laws`), start values (a number for all contacts or a list
      with one each), options, module (a file or module that registers the law, see
      `register`). A `restitution_matrix` without its matrix starts from an admissible
      one.
    - `[law.bounds]`: pairs, as `restitution = [0, 1]` or `"restitution[2]" = [0.5, 1]`.
    - `[law.priors]`: means with standard deviations, as `restitution = [0.9, 0.02]`,
      see `fit`.
    - `[fit]`: free (a list of names, or a table of masks), method, loss, starts, seed,
      max_steps, profiles.
    - `[data]`: file (relative to the study, see `read_experiments`),
      momentum_corrected; of shots with scenes of their own near_m, contacts (only shots
      with that many). Without shots a study can be compared, not fitted.
    - `[track]`, in the place of `[data]`: file (relative to the study), and the
      arguments of `ji.tracks.read` and `ji.tracks.find_impacts` by their names
      (columns, unit, time, frame or rate, where, decimal; sigma, acceleration, drag,
      contact, shortest, window; of poses quaternion, inertia); "unknown" of
      acceleration or drag is None; of a body near_m; label of the shots, doubtful. The
      study's `track` holds the impacts.
    - `[bounces]`, in the place of `[data]`: times, sigma, gravity, see
      `ji.tracks.bounce_times`.
    - `[monte_carlo]`: velocity_m_per_s, gaps_m, law, samples, seed, chunk, bins; see
      `monte_carlo`.

    On a motion, with [law], [law.bounds], [law.priors] and [fit] (without method) as
    above:

    - `[system]`: kind, the name of a body, with its arguments (`width_m`, `mass_kg`,
      ...), and gravity_m_per_s2, 0 for none.
    - `[base]`: amplitude_m, frequency_hz, phase_rad, direction (vertical; in the plane
      also horizontal, in space x or y).
    - `[motion]`: q0, v0, t_start_s, t_end_s, samples, method, max_events, options of
      the method (step_s, closed_below_m, max_steps, rtol, slow), and friction of the
      system.
    - `[data]`: file, a CSV file with columns t[s] in equal steps, q_1[m], q_2[rad], ...
      and perhaps sigma_q_1[m], ...

    Returns:
        A `Study`, or a `MotionStudy`.

    Raises:
        FileNotFoundError: no such study or data file.
        ValueError: the file is not TOML; a key is unknown or missing; scene, system,
            law or data refuse a value.

    >>> import jimpact as ji
    >>> (
    ...     ji.read_study("three_balls.toml").title,
    ...     ji.read_study("cradle_motion.toml").title,
    ... )
    ('Three equal hard balls, one shot', "Newton's cradle, three balls")
    """

    def build(tables: dict[str, Any], path: Path) -> "Study | MotionStudy":
        """The study of a motion if there is a table [motion], else of an impact."""
        if "motion" in tables:
            return _motion_study(tables, path, law)
        return _impact_study(tables, path, law)

    return _read(path, "[law]", build)


def impact_study(path: str | Path, law: str | None = None) -> Study:
    """The study of one impact, see `read_study`; one of a motion is refused."""
    return _read(path, "[scene]", lambda tables, path: _impact_study(tables, path, law))


def motion_study(path: str | Path) -> "MotionStudy":
    """The study of a motion, see `read_study`; one of an impact is refused."""
    return _read(
        path, "[system]", lambda tables, path: _motion_study(tables, path, None)
    )


def _motion_study(
    tables: Mapping[str, Any], path: Path, law_name: str | None
) -> "MotionStudy":
    """`motion_study_of`."""
    from jimpact.cli.study_motion import motion_study_of

    return motion_study_of(tables, path, law_name)


def _read(
    path: str | Path, table: str, build: Callable[[dict[str, Any], Path], AnyStudy]
) -> AnyStudy:
    """Study that `build(tables, path)` makes of a TOML file; its errors name the file,
    but those of an option.

    `table` is the head of a table that all bundled studies of this kind have: a missing
    file's error lists these.
    """
    file = located(Path(path), table)
    try:
        return build(read_tables(file), file)
    except WrongOption:
        raise
    except (ValueError, TypeError) as error:
        raise ValueError(f"{file}: {error}") from None


def _impact_study(tables: Mapping[str, Any], path: Path, law_name: str | None) -> Study:
    """Study of one impact from the tables of the file `path`, checked.

    `law_name`: a law in the place of the study's, None: its own.
    """
    check_tables(tables, ("scene", "law"), ("fit", *SHOTS, "monte_carlo"))
    scene, body = _scene(tables["scene"])
    law, values, fitted = law_of(tables, law_name, path.parent, scene)
    fittable = free_parameters_of(law)
    # free by default
    bounce = [name for name in ("restitution", *OF_SPEED) if name in fittable]
    track, experiments = _shots(tables, path, body or scene)
    return Study(
        str(tables.get("title", path.stem)),
        scene,
        law,
        free=fitted.free or dict.fromkeys(bounce or default_free(law), True),
        bounds=fitted.bounds,
        experiments=experiments,
        parameters=values,
        options=fitted.options,
        priors=fitted.priors,
        monte_carlo=_sampling(tables, law, scene),
        velocities=() if body is None else tuple(body.velocity_names),
        track=track,
    )


def _scene(table: Mapping[str, Any]) -> tuple[Scene, Body | None]:
    """Scene of the table [scene], and the body whose scene it is; None: a chain."""
    if "kind" not in table:
        check_keys("[scene]", table, CHAIN, ("masses_kg",))
        return chain(**arguments_of(table, CHAIN)), None
    body = body_of("[scene]", table, tuple(CONFIGURATION))
    check_keys("[scene]", table, tuple(table), ("q",))
    return body.scene(**arguments_of(table, CONFIGURATION)), body


def _shots(
    tables: Mapping[str, Any], path: Path, owner: Scene | Body
) -> tuple["Track | None", Experiments | None]:
    """Track and shots of a study from the table [track], [bounces] or [data]; None
    without.

    `path` is that of its file, `owner` the scene or the body of the shots.
    """
    given = [name for name in SHOTS if name in tables]
    if len(given) > 1:
        raise ValueError(
            f"the study must have one table of shots, but has "
            f"{', '.join(f'[{x}]' for x in given)}."
        )
    if "track" in tables:
        tracks = _keys_of("track")
        table = tables["track"]
        track = tracks.track_of(table, path)
        return track, tracks.shots_of_track(track, table, owner)
    if "bounces" in tables:
        return None, _keys_of("bounces").shots_of_bounces(tables["bounces"])
    return None, _experiments(tables["data"], path, owner) if "data" in tables else None


def _experiments(
    table: Mapping[str, Any], path: Path, owner: Scene | Body
) -> Experiments:
    """Shots in the file of the table [data], selected and corrected as the table says.

    `path` is that of the study, `owner` its scene, or its body, which gives each its
    scene.
    """
    check_keys("[data]", table, DATA, ("file",))
    check_kind("[data]", "file", table["file"], str, "a path")
    corrected = table.get("momentum_corrected", False)
    check_kind("[data]", "momentum_corrected", corrected, bool, "true or false")
    near = table.get("near_m", CLOSED_BELOW)
    experiments = read_experiments(path.parent / table["file"], owner, near)
    if experiments.scenes is None:
        for key in ("contacts", "near_m"):
            if key in table:
                raise ValueError(
                    f"`{key}` in [data] is for shots with scenes of their own."
                )
        if isinstance(owner, Scene):
            experiments.scene_of(owner, 0)  # raises where their sizes differ
    if "contacts" in table:
        experiments = experiments.with_contacts(table["contacts"])
    if corrected:
        return experiments.momentum_corrected(
            owner if isinstance(owner, Scene) else None
        )
    return experiments


def _sampling(tables: Mapping[str, Any], law: Law, scene: Scene) -> dict[str, Any]:
    """Arguments of `monte_carlo` from the table [monte_carlo]; without it none."""
    if "monte_carlo" not in tables:
        return {}
    return _keys_of("monte_carlo").sampling_of(tables["monte_carlo"], law, scene)


def _keys_of(table: str) -> Any:
    """The module of the room that holds the keys of a table; a ValueError where it is
    missing.
    """
    try:
        with missing_room(f"[{table}]"):
            return import_module(f"jimpact.{ROOMS[table]}.study")
    except ImportError as error:
        raise ValueError(str(error)) from None
