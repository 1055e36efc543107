"""A study: one TOML file with scene, law, what is free, and the data file."""

import importlib.util
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from jimpact.bodies.assemblies import PlanarBodies
from jimpact.bodies.base import CLOSED_BELOW, Body
from jimpact.bodies.blocks import Block
from jimpact.bodies.dimers import Dimer, SpatialDimer
from jimpact.bodies.discs import DiskBalls
from jimpact.bodies.particles import Column, Corner
from jimpact.bodies.pendulums import PendulumCradle
from jimpact.bodies.piles import Discs
from jimpact.bodies.polygons import Disc, Polygon
from jimpact.bodies.solids import Box, Sphere
from jimpact.files.study_file import (
    AT_KEYS,
    NO_DATA,
    STUDY_TABLES,
    body_keys,
    check_data,
    check_fit,
    check_observed,
    check_sampling,
    check_scene,
    check_tables,
    distribution,
    from_file,
    law_values,
)
from jimpact.fits.experiments import Experiments, read_experiments
from jimpact.fits.fitting import Fit, fit
from jimpact.fits.matrix_fit import admissible_start
from jimpact.fits.observables import Measured, observations
from jimpact.fits.parameters import OF_SPEED, default_free
from jimpact.fits.problem import FitProblem
from jimpact.law import Law, free_parameters_of
from jimpact.laws import REGISTRY
from jimpact.laws.kinematic import RestitutionMatrix
from jimpact.montecarlo.distributions import Distribution, Normal, RandomLaw, Uniform
from jimpact.registry import Row
from jimpact.scene import Scene, chain

_ARGUMENTS = {"velocity_m_per_s": "velocity", "gaps_m": "gaps", "seed": "key"}
_DISTRIBUTIONS: dict[str, Any] = {"Uniform": Uniform, "Normal": Normal}
_BODIES: dict[str, type[Body]] = {
    body.__name__: body
    for body in (
        *(Block, Polygon, Disc, Dimer, PlanarBodies),
        *(Box, Sphere, SpatialDimer),
        *(Column, Corner, PendulumCradle, Discs, DiskBalls),
    )
}


@dataclass(frozen=True)
class Study:
    """What `read_study` found; `run` fits it, `monte_carlo(**study.monte_carlo)` samples it.

    Attributes:
        title: of pictures and reports.
        scene: what collides.
        law: with the study's values.
        free: names -> masks of the parameters that `run` fits.
        bounds: names -> (low, high).
        experiments: the shots, None without `[data]`.
        parameters: the law's values as the file gives them.
        options: of `fit`, by name.
        monte_carlo: arguments of `monte_carlo`, empty without `[monte_carlo]`.
        measured: what `[[observe]]` tells, else None.
    """

    title: str
    scene: Scene
    law: Law
    free: dict[str, Any]
    bounds: dict[str, Any]
    experiments: Experiments | None
    parameters: dict[str, Any]
    options: dict[str, Any] = field(default_factory=dict)
    monte_carlo: dict[str, Any] = field(default_factory=dict)
    measured: Measured | None = None

    def run(self, **options: Any) -> Fit:
        """`fit` with the study's options; keyword arguments that are not None go first."""
        given = {key: value for key, value in options.items() if value is not None}
        return fit(self.problem, **(self.options | given))

    @property
    def problem(self) -> FitProblem:
        """What `run` solves: of the shots, or of the observables."""
        parameters: dict[str, Any] = {"free": self.free, "bounds": self.bounds}
        if self.measured is not None:
            value, sigma, observe = self.measured
            return FitProblem.from_observable(self.law, observe, value, sigma, **parameters)
        if self.experiments is None:
            raise ValueError(NO_DATA)
        return FitProblem.from_shots(self.law, self.scene, self.experiments, **parameters)


def read_study(path: str | Path, law: str | None = None) -> Study:
    """A study from its TOML file: scene, law, what is free, and the data, ready to be fitted.

    Args:
        path: of the file, or the name of a bundled study (`three_balls.toml`).
        law: name of another law in the place of the study's.

    The tables of the file:

    - `[scene]`: masses_kg, wall, gaps_m (a chain, see `chain`); or kind, the name of a body, with
      its arguments (`width_m`, `mass_kg`, ...), q, its configuration at the impact, closed_below_m.
    - `[law]`: name (`jimpact laws`), start values (a number for all contacts or a list with one
      each), options, module (a file or module that registers the law, see `register`). A
      `restitution_matrix` without its matrix starts from an admissible one.
    - `[law.bounds]`: pairs, as `restitution = [0, 1]`.
    - `[fit]`: free (a list of names, or a table of masks), method, loss, starts, seed, max_steps,
      profiles.
    - `[data]`: file (relative to the study, see `read_experiments`), momentum_corrected; of shots
      with scenes of their own near_m, contacts (only shots with so many). Without data a study
      can be compared, not fitted.
    - `[[observe]]`, in the place of `[data]`: quantity (peak_force [N], arrival_time [s] of a
      contact; duration [s] of a contact or of all; energy_ratio; bounce_height [m] of a body),
      contact or body (from 1), value and sigma, numbers or lists, with relative = true those over
      the first one; velocity_m_per_s, one a body, or drop_height_m; bodies (so many, those next to
      the wall), a number or one a value.
    - `[monte_carlo]`: velocity_m_per_s, gaps_m, law, samples, seed, chunk, bins; see
      `monte_carlo`.

    Returns:
        A `Study`.

    Raises:
        FileNotFoundError: no such study or data file.
        ValueError: no TOML, unknown or missing keys, and whatever scene, law or data refuse.

    >>> import jimpact as ji
    >>> ji.read_study("three_balls.toml").title
    'Three equal hard balls, one shot'
    """
    return from_file(path, "[scene]", lambda tables, file: _study(tables, file, law))


def _study(tables: Mapping[str, Any], path: Path, other_law: str | None) -> Study:
    check_tables(tables, ("scene", "law"), STUDY_TABLES)
    scene, body = _scene(tables["scene"])
    free = check_fit(tables.get("fit", {}))
    options = {key: x for key, x in tables.get("fit", {}).items() if key != "free"}
    row, values, bounds = law_table(tables["law"], other_law, path.parent)
    if other_law is not None:
        free = {name: mask for name, mask in free.items() if name in row.parameters}
    if row.law is RestitutionMatrix and "matrix" not in values:
        values["matrix"] = admissible_start([scene])
    values = with_exponent(values, free)
    law = row.build(**values)
    known = free_parameters_of(law)
    bounce = [name for name in ("restitution", *OF_SPEED) if name in known]
    free = free or dict.fromkeys(bounce or default_free(known), True)
    experiments = _experiments(tables["data"], path, body or scene) if "data" in tables else None
    title = str(tables.get("title", path.stem))
    sampled = _sampling(tables["monte_carlo"], law, scene) if "monte_carlo" in tables else {}
    seen = tables.get("observe")
    if seen is not None:
        check_observed(seen, 0 if experiments is None else len(experiments.shots))
    measured = None if seen is None else observations(scene, seen)
    parts = (scene, law, free, bounds, experiments, values, options, sampled, measured)
    return Study(title, *parts)


def with_exponent(values: dict[str, Any], free: Mapping[str, Any]) -> dict[str, Any]:
    """A law's values: fixed exponents are fast as numbers, free ones must be arrays."""
    if "exponent" not in values:
        return values
    given = values["exponent"]
    fixed = tuple(given) if isinstance(given, list) else given
    return values | {"exponent": np.asarray(given, float) if "exponent" in free else fixed}


def _experiments(table: Mapping[str, Any], path: Path, place: Scene | Body) -> Experiments:
    """The shots of the table [data], with the scenes that they have of their own."""
    check_data(table)
    found = read_experiments(path.parent / table["file"], place, table.get("near_m", CLOSED_BELOW))
    if found.scenes is None and isinstance(place, Scene):
        found.scene_of(place, 0)
    for key in ("contacts", "near_m"):
        if key in table and found.scenes is None:
            raise ValueError(f"`{key}` in [data] is for shots with scenes of their own.")
    if "contacts" in table:
        kept = np.isin(found.contacts, table["contacts"])
        if not kept.any():
            raise ValueError(
                f"`contacts` in [data] must be one of {', '.join(map(str, set(found.contacts)))}, "
                f"but is {table['contacts']}."
            )
        found = found.only(kept)
    corrected = table.get("momentum_corrected", False)
    scene = place if isinstance(place, Scene) else None
    return found.momentum_corrected(scene) if corrected else found


def cube_impacts(contacts: int | Sequence[int] | None = None, near: float = 2e-3) -> Experiments:
    """400 measured impacts of a tossed acrylic cube on a board, each in the scene of its pose.

    Velocities are those of the centre of mass (m/s, axes of the board) and the angular velocity
    (rad/s, axes of the cube), before and after, with standard errors; a label is "toss:frame", the
    frame being the last one before the impact. The cube is the `Box` of `tossed_cube.toml`.

    Args:
        contacts: only impacts on so many corners, one number or several; None: all.
        near: corners up to so far above the lowest one touch, too (board and cube are flat to
            1.4 mm) [m].

    Returns:
        `Experiments` of up to 400 shots of 6 velocities, with sigma and scenes.

    Source: ContactNets (Pfrommer, Halm and Posa, CoRL 2020), see `cube_NOTICE.txt` in `data`.

    >>> import jimpact as ji
    >>> two = ji.cube_impacts(contacts=2)
    >>> two.pre.shape, two.scenes[0].contacts, two.units[5]
    ((21, 6), 2, 'rad/s')
    """
    path = Path(str(files("jimpact") / "data" / "tossed_cube.toml"))

    def read(tables: Mapping[str, Any], file: Path) -> Experiments:
        table = {"file": tables["data"]["file"], "near_m": near}
        own = {} if contacts is None else {"contacts": contacts}
        return _experiments(table | own, file, body_of("[scene]", tables["scene"], AT_KEYS))

    return from_file(path, "[scene]", read)


def body_of(where: str, table: Mapping[str, Any], others: tuple[str, ...] = ()) -> Body:
    """The body that a table of a study describes.

    `kind` is the name of a body's class (`Block`, `Box`, `PlanarBodies`, ..., in any case); the
    other keys are the arguments of that class, with their units behind them: `width_m`, `mass_kg`,
    `inertia_kg_m2`, `angle_rad`. Bodies of `PlanarBodies` are tables of this kind themselves.
    `others` are keys of the table that belong to somebody else.

    >>> from jimpact.cli.study import body_of
    >>> body_of("[scene]", {"kind": "Block", "width_m": 0.2, "height_m": 0.6}).names
    ('x [m]', 'y [m]', 'angle [rad]')
    """
    kind, keys = body_keys(where, table, others)
    given = {name: table[key] for key, name in keys.items() if key in table}
    if "bodies" in given:
        within = f"{where.removesuffix(']')}.bodies]"
        given["bodies"] = [body_of(within, x) for x in given["bodies"]]
    return _BODIES[kind](**given)


def _scene(table: Mapping[str, Any]) -> tuple[Scene, Body | None]:
    """The scene of a study, and the body whose scene it is."""
    check_scene(table)
    if "kind" in table:
        body = body_of("[scene]", table, AT_KEYS)
        return body.scene(table["q"], table.get("closed_below_m", CLOSED_BELOW)), body
    return chain(table["masses_kg"], table.get("wall", False), table.get("gaps_m")), None


def law_table(
    table: Mapping[str, Any], other: str | None, folder: Path
) -> tuple[Row, dict[str, Any], dict[str, Any]]:
    """Registry row, start values and bounds; of another law only what both have is kept."""
    if "module" in table:
        import_laws(str(table["module"]), folder)
    name, values, bounds = law_values(table, other, REGISTRY)
    values.pop("module", None)
    return REGISTRY[name], values, bounds


def _sampling(table: Mapping[str, Any], law: Law, scene: Scene) -> dict[str, Any]:
    """Arguments of `monte_carlo` from the table [monte_carlo].

    Keys: velocity_m_per_s and gaps_m, a list, or a table with low and high (uniform) or mean and
    std (normal; gaps truncated at 0); law, a table of such tables by parameter; samples, seed,
    chunk, bins.
    """
    check_sampling(table)
    drawn = {
        name: _distribution(f"law.{name}", value) for name, value in table.get("law", {}).items()
    }
    given = {
        _ARGUMENTS.get(key, key): _distribution(key, value) if isinstance(value, dict) else value
        for key, value in table.items()
        if key != "law"
    }
    return {"scene": scene, "law": RandomLaw(law, **drawn) if drawn else law} | given


def _distribution(name: str, value: Any) -> Distribution:
    return _DISTRIBUTIONS[distribution(name, value)](**value)


def import_laws(module: str, folder: Path) -> None:
    """Import a module that registers laws: a file (.py, relative to the folder), or by its name."""
    if not module.endswith(".py"):
        importlib.import_module(module)
        return
    path = (folder / module).resolve()
    if not path.is_file():
        raise ValueError(f"`module` must be a file or an importable module, but '{path}' is none.")
    known = sys.modules.get(path.stem)
    if known is not None:
        if Path(getattr(known, "__file__", None) or "").resolve() == path:
            return
        raise ValueError(f"`module` must have a new name, but another '{path.stem}' is imported.")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    loaded = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = loaded  # before it runs: classes are looked up there by name
    try:
        spec.loader.exec_module(loaded)
    except BaseException:
        del sys.modules[path.stem]
        raise
