"""A study: one TOML file with scene, law, what is free, and the data file."""

import importlib.util
import inspect
import sys
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any, TypeVar

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
from jimpact.experiments import Experiments, read_experiments
from jimpact.fits.fitting import Fit, fit
from jimpact.fits.matrix_fit import admissible_start
from jimpact.fits.parameters import default_free
from jimpact.law import Law, free_parameters_of
from jimpact.laws import REGISTRY
from jimpact.laws.kinematic import RestitutionMatrix
from jimpact.montecarlo.distributions import Distribution, Normal, RandomLaw, Uniform
from jimpact.registry import Row
from jimpact.scene import Scene, chain

_SCENE_KEYS = ("masses_kg", "wall", "gaps_m")
_AT_KEYS = ("q", "closed_below_m")  # of a scene that is a body in a configuration
_FIT_KEYS = ("free", "method", "starts", "seed", "max_steps")
_DATA_KEYS = ("file", "momentum_corrected")
_SAMPLING_KEYS = ("velocity_m_per_s", "gaps_m", "law", "samples", "seed", "chunk", "bins")
_ARGUMENTS = {"velocity_m_per_s": "velocity", "gaps_m": "gaps", "seed": "key"}
_DISTRIBUTIONS: dict[tuple[str, ...], Any] = {("high", "low"): Uniform, ("mean", "std"): Normal}
_BODIES: dict[str, type[Body]] = {
    body.__name__.lower(): body
    for body in (
        *(Block, Polygon, Disc, Dimer, PlanarBodies),
        *(Box, Sphere, SpatialDimer),
        *(Column, Corner, PendulumCradle, Discs, DiskBalls),
    )
}
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

T = TypeVar("T")


@dataclass(frozen=True)
class Study:
    """What `read_study` found; `run` fits it, `monte_carlo(**study.monte_carlo)` samples it.

    `parameters` are the law's values as the file gives them; `experiments` is None without data.
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

    def run(self, **options: Any) -> Fit:
        """`fit` with the study's options; keyword arguments that are not None go first."""
        if self.experiments is None:
            raise ValueError("a study must have a [data] table to be fitted, but has none.")
        given = {key: value for key, value in options.items() if value is not None}
        return fit(
            self.law,
            self.scene,
            self.experiments,
            self.free,
            bounds=self.bounds,
            **(self.options | given),
        )


def read_study(path: str | Path, law: str | None = None) -> Study:
    """Read a study file; `law` puts another law in the place of the study's.

    Tables: `[scene]` masses_kg, wall, gaps_m (a chain, see `chain`), or a body (see `body_of`) and
    q, its configuration at the impact, closed_below_m; `[law]` name, options and
    start values, a number for all contacts or a list with one each (a `restitution_matrix` without
    its `matrix` starts from an admissible one), module (a file or module that
    registers the law, see `ji.register`), and `[law.bounds]`; `[fit]` free (a
    list of names, or a table of masks), method, starts, seed, max_steps; `[data]` file (relative
    to the study), momentum_corrected; without data a study can be compared, not fitted;
    `[monte_carlo]` velocity_m_per_s, gaps_m, law, samples, seed (see `jimpact.montecarlo`). A name
    of a bundled study is found where no such file is.

    Raises:
        FileNotFoundError: no such study or data file.
        ValueError: no TOML, unknown or missing keys, and whatever scene, law or data refuse.

    >>> from jimpact.study import read_study
    >>> read_study("three_balls.toml").title
    'Three equal hard balls, one shot'
    """
    return from_file(path, "[scene]", lambda tables, file: _study(tables, file, law))


def from_file(path: str | Path, table: str, build: Callable[[dict[str, Any], Path], T]) -> T:
    """What `build` makes of a study file's tables; studies of a kind have this `table`."""
    path = _located(Path(path), table)
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: the study must be a TOML file, but {error}.") from None
    try:
        return build(tables, path)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: {error}") from None


def _located(path: Path, table: str) -> Path:
    """The file, or the bundled study of this name."""
    if path.is_file():
        return path
    bundled = Path(str(files("jimpact") / "data" / path.name))
    if path.parent == Path() and bundled.is_file():
        return bundled
    tables = sorted(bundled.parent.glob("*.toml"))
    names = ", ".join(p.name for p in tables if table in p.read_text(encoding="utf-8"))
    raise FileNotFoundError(f"Study '{path}' does not exist; bundled studies are {names}.")


def _study(tables: Mapping[str, Any], path: Path, other_law: str | None) -> Study:
    check_tables(tables, ("scene", "law"), ("fit", "data", "monte_carlo"))
    scene = _scene(tables["scene"])
    options = dict(tables.get("fit", {}))
    check_keys("[fit]", options, _FIT_KEYS)
    row, values, bounds = law_table(tables["law"], other_law, path.parent)
    free = options.pop("free", [])
    free = free if isinstance(free, dict) else dict.fromkeys(_as_names(free), True)
    if other_law is not None:
        free = {name: mask for name, mask in free.items() if name in row.parameters}
    if row.law is RestitutionMatrix and "matrix" not in values:
        values["matrix"] = admissible_start([scene])
    if "exponent" in values:  # fixed exponents are fast as numbers, free ones must be arrays
        given = values["exponent"]
        fixed = tuple(given) if isinstance(given, list) else given
        values["exponent"] = np.asarray(given, float) if "exponent" in free else fixed
    law = row.build(**values)
    known = free_parameters_of(law)
    free = free or dict.fromkeys({"restitution"} & set(known) or default_free(known), True)
    experiments = _experiments(tables["data"], path, scene) if "data" in tables else None
    title = str(tables.get("title", path.stem))
    sampled = _sampling(tables["monte_carlo"], law, scene) if "monte_carlo" in tables else {}
    return Study(title, scene, law, free, bounds, experiments, values, options, sampled)


def _experiments(table: Mapping[str, Any], path: Path, scene: Scene) -> Experiments:
    check_keys("[data]", table, _DATA_KEYS, required=("file",))
    experiments = read_experiments(path.parent / table["file"])
    experiments.scene_of(scene, 0)
    corrected = table.get("momentum_corrected", False)
    return experiments.momentum_corrected(scene) if corrected else experiments


def body_of(where: str, table: Mapping[str, Any], others: tuple[str, ...] = ()) -> Body:
    """The body that a table of a study describes.

    `kind` is the name of a body's class (`Block`, `Box`, `PlanarBodies`, ..., in any case); the
    other keys are the arguments of that class, with their units behind them: `width_m`, `mass_kg`,
    `inertia_kg_m2`, `angle_rad`. Bodies of `PlanarBodies` are tables of this kind themselves.
    `others` are keys of the table that belong to somebody else.

    >>> from jimpact.study import body_of
    >>> body_of("[scene]", {"kind": "Block", "width_m": 0.2, "height_m": 0.6}).names
    ('x [m]', 'y [m]', 'angle [rad]')
    """
    check_keys(where, table, tuple(table), required=("kind",))
    kind = table["kind"]
    body = _BODIES.get(str(kind).lower())
    if body is None:
        names = ", ".join(row.__name__ for row in _BODIES.values())
        raise ValueError(f"`kind` in {where} must be one of {names}, but is {kind!r}.")
    arguments = list(inspect.signature(body.__init__).parameters.values())[1:]
    keys = {f"{x.name}_{_UNITS[x.name]}" if x.name in _UNITS else x.name: x for x in arguments}
    needed = tuple(key for key, x in keys.items() if x.default is x.empty)
    check_keys(where, table, ("kind", *keys, *others), needed)
    given = {x.name: table[key] for key, x in keys.items() if key in table}
    if "bodies" in given:
        within = f"{where.removesuffix(']')}.bodies]"
        if not isinstance(given["bodies"], list):
            raise ValueError(f"[{within}] must be tables, each headed by [{within}].")
        given["bodies"] = [body_of(within, x) for x in given["bodies"]]
    return body(**given)


def _scene(table: Mapping[str, Any]) -> Scene:
    if "kind" in table:
        body = body_of("[scene]", table, _AT_KEYS)
        check_keys("[scene]", table, tuple(table), required=("q",))
        return body.scene(table["q"], table.get("closed_below_m", CLOSED_BELOW))
    check_keys("[scene]", table, _SCENE_KEYS, required=("masses_kg",))
    wall = table.get("wall", False)
    if not isinstance(wall, bool | str):
        raise ValueError(f"`wall` must be true, false or a side, but is {wall!r}.")
    return chain(table["masses_kg"], wall, table.get("gaps_m"))


def law_table(
    table: Mapping[str, Any], other: str | None, folder: Path
) -> tuple[Row, dict[str, Any], dict[str, Any]]:
    """Registry row, start values and bounds; of another law only what both have is kept."""
    table = dict(table)
    check_keys("[law]", table, tuple(table), required=("name",))
    if "module" in table:
        import_laws(str(table.pop("module")), folder)
    own = str(table.pop("name")).lower()
    name = (other or own).lower()
    for key in (own, name):
        if key not in REGISTRY:
            raise ValueError(f"the law must be one of {', '.join(REGISTRY)}, but is {key!r}.")
    row = REGISTRY[name]
    bounds = table.pop("bounds", {})
    check_keys("[law]", table, (*REGISTRY[own].arguments, "name", "bounds"))
    check_keys("[law.bounds]", bounds, REGISTRY[own].parameters)
    kept = {k: v for k, v in table.items() if k in row.arguments}
    return row, kept, {k: v for k, v in bounds.items() if k in row.parameters}


def _sampling(table: Mapping[str, Any], law: Law, scene: Scene) -> dict[str, Any]:
    """Arguments of `monte_carlo` from the table [monte_carlo].

    Keys: velocity_m_per_s and gaps_m, a list, or a table with low and high (uniform) or mean and
    std (normal; gaps truncated at 0); law, a table of such tables by parameter; samples, seed,
    chunk, bins.
    """
    check_keys("[monte_carlo]", table, _SAMPLING_KEYS, required=("velocity_m_per_s",))
    random = table.get("law", {})
    if not isinstance(random, dict):
        raise ValueError(f"[monte_carlo.law] must be a table, but is {random!r}.")
    drawn = {name: _distribution(f"law.{name}", value) for name, value in random.items()}
    given = {
        _ARGUMENTS.get(key, key): _distribution(key, value) if isinstance(value, dict) else value
        for key, value in table.items()
        if key != "law"
    }
    return {"scene": scene, "law": RandomLaw(law, **drawn) if drawn else law} | given


def _distribution(name: str, value: Any) -> Distribution:
    kind = _DISTRIBUTIONS.get(tuple(sorted(value))) if isinstance(value, dict) else None
    if kind is None:
        raise ValueError(
            f"`{name}` in [monte_carlo] must have low and high, or mean and std, but is {value!r}."
        )
    return kind(**value)


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


def _as_names(free: Any) -> list[str]:
    if isinstance(free, list) and all(isinstance(name, str) for name in free):
        return free
    raise ValueError(f"`free` must be a list of names or a table of masks, but is {free!r}.")


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
    check_keys("the study", study, ("title", *required, *others), required)
    for name in (*required, *others):
        if not isinstance(study.get(name, {}), dict):
            raise ValueError(f"`{name}` must be a table, but is {study[name]!r}.")
