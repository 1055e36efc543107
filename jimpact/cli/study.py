"""Studies of one impact: scene, law, what is free and the data, built of a checked TOML file."""

import importlib.util
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

import jimpact as ji
from jimpact.bodies.base import CLOSED_BELOW, Body
from jimpact.files.study_file import (
    AT_KEYS,
    NO_DATA,
    CheckedStudy,
    body_keys,
    distribution,
    from_file,
)
from jimpact.fits.data import Experiments, read_experiments
from jimpact.fits.fitting import Fit, fit
from jimpact.fits.matrices import admissible_start
from jimpact.fits.parameters import OF_SPEED, default_free
from jimpact.fits.problem import FitProblem, of_shots
from jimpact.fits.search import Search
from jimpact.law import Law, free_parameters_of
from jimpact.laws import REGISTRY
from jimpact.laws.kinematic import RestitutionMatrix
from jimpact.montecarlo.distributions import Distribution, RandomLaw
from jimpact.scene import Scene, chain

# Keys of [monte_carlo] that `monte_carlo` calls otherwise.
SAMPLING_ARGUMENTS = {"velocity_m_per_s": "velocity", "gaps_m": "gaps", "seed": "key"}


def fit_arguments(options: dict[str, Any], search: Search) -> dict[str, Any]:
    """Arguments of `fit` from the options of a study, of which all but two belong to its search."""
    own = {name: options[name] for name in ("starts", "profiles") if name in options}
    others = {name: value for name, value in options.items() if name not in own}
    return own | {"search": replace(search, **others)}


@dataclass(frozen=True)
class Study:
    """A study that `read_study` read; `run` fits it, `monte_carlo(**study.monte_carlo)` samples it.

    Attributes:
        title: of pictures and reports.
        scene: what collides.
        law: with the study's values.
        free: names -> masks of the parameters that `run` fits.
        bounds: names -> (low, high).
        priors: names -> (mean, standard deviation).
        experiments: the shots, None without `[data]`.
        parameters: the law's values as the file states them.
        options: of `fit`, by name.
        monte_carlo: arguments of `monte_carlo`, empty without `[monte_carlo]`.
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

    def run(self, **options: Any) -> Fit:
        """`fit` with the study's options, or with those that are passed and not None."""
        problem = self._problem(of_shots)  # `fit` passes on errors of v-
        return fit(problem, **fit_arguments(self.options | without_none(options), Search()))

    @property
    def problem(self) -> FitProblem:
        """The problem that `run` solves."""
        return self._problem(FitProblem.from_shots)

    def _problem(self, of_shots: Callable[..., FitProblem]) -> FitProblem:
        """The same, that of shots made by this function."""
        choice = self.free, self.bounds, self.priors
        if self.experiments is None:
            raise ValueError(NO_DATA)
        return of_shots(self.law, self.scene, self.experiments, *choice)


def impact_study(path: str | Path, law: str | None = None) -> Study:
    """The study of one impact, see `read_study`."""
    return from_file(path, law, False, study_of, import_module_of)


def study_of(checked: CheckedStudy) -> Study:
    """The study of checked tables."""
    tables, free = checked.tables, checked.law.free
    scene, body = _scene(tables["scene"])
    row, values = REGISTRY[checked.law.name], checked.law.arguments
    if row.law is RestitutionMatrix and "matrix" not in values:
        values = values | {"matrix": admissible_start([scene])}
    values = with_exponent(values, free)
    law = row.build(**values)
    fittable = free_parameters_of(law)
    bounce = [name for name in ("restitution", *OF_SPEED) if name in fittable]
    data = tables.get("data")
    return Study(
        checked.title,
        scene,
        law,
        free=free or dict.fromkeys(bounce or default_free(law), True),
        bounds=checked.law.bounds,
        experiments=None if data is None else _experiments(data, checked.path, body or scene),
        parameters=values,
        options=checked.fit_options,
        priors=checked.law.priors,
        monte_carlo=_sampling(tables["monte_carlo"], law, scene) if "monte_carlo" in tables else {},
    )


def without_none(options: Mapping[str, Any]) -> dict[str, Any]:
    """The options that are not None, which means: as the study says."""
    return {key: value for key, value in options.items() if value is not None}


def with_exponent(values: dict[str, Any], free: Mapping[str, Any]) -> dict[str, Any]:
    """A law's values: fixed exponents are fast as numbers, free ones must be arrays."""
    if "exponent" not in values:
        return values
    exponent = values["exponent"]
    if "exponent" in free:
        return values | {"exponent": np.asarray(exponent, float)}
    return values | {"exponent": tuple(exponent) if isinstance(exponent, list) else exponent}


def _experiments(table: Mapping[str, Any], path: Path, place: Scene | Body) -> Experiments:
    """The shots of the table [data], with the scenes that they have of their own."""
    file, near = path.parent / table["file"], table.get("near_m", CLOSED_BELOW)
    experiments = read_experiments(file, place, near)
    if experiments.scenes is None:
        for key in ("contacts", "near_m"):
            if key in table:
                raise ValueError(f"`{key}` in [data] is for shots with scenes of their own.")
        if isinstance(place, Scene):
            experiments.scene_of(place, 0)  # raises where their sizes differ
    if "contacts" in table:
        experiments = experiments.with_contacts(table["contacts"])
    if table.get("momentum_corrected", False):
        return experiments.momentum_corrected(place if isinstance(place, Scene) else None)
    return experiments


def body_of(where: str, table: Mapping[str, Any], others: tuple[str, ...] = ()) -> Body:
    """The body that a table of a study describes.

    `kind` is the name of a body's class (`Block`, `Box`, `Bodies`, ..., in any case); the
    other keys are the arguments of that class, with their units behind them: `width_m`, `mass_kg`,
    `inertia_kg_m2`, `angle_rad`. Bodies of `Bodies` are tables of this
    kind themselves.
    `others` are keys of the table that mean something else.

    >>> from jimpact.cli.study import body_of
    >>> body_of("[scene]", {"kind": "Block", "width_m": 0.2, "height_m": 0.6}).names
    ('x [m]', 'y [m]', 'angle [rad]')
    """
    kind, keys = body_keys(where, table, others)
    arguments = {name: table[key] for key, name in keys.items() if key in table}
    for several in {"bodies", "fixed"} & set(arguments):
        within = f"{where.removesuffix(']')}.{several}]"
        arguments[several] = [body_of(within, x) for x in arguments[several]]
    return getattr(ji, kind)(**arguments)


def _scene(table: Mapping[str, Any]) -> tuple[Scene, Body | None]:
    """The scene of a study, and the body whose scene it is."""
    if "kind" in table:
        body = body_of("[scene]", table, AT_KEYS)
        return body.scene(table["q"], table.get("closed_below_m", CLOSED_BELOW)), body
    return chain(table["masses_kg"], table.get("wall", False), table.get("gaps_m")), None


def _sampling(table: Mapping[str, Any], law: Law, scene: Scene) -> dict[str, Any]:
    """Arguments of `monte_carlo` from the table [monte_carlo].

    Keys: velocity_m_per_s and gaps_m, a list, or a table with low and high (uniform) or mean and
    std (normal; gaps truncated at 0); law, a table of such tables by parameter; samples, seed,
    chunk, bins.
    """
    laws = table.get("law", {})
    drawn = {name: _distribution(f"law.{name}", value) for name, value in laws.items()}
    arguments = {
        SAMPLING_ARGUMENTS.get(key, key): _distribution(key, value)
        if isinstance(value, dict)
        else value
        for key, value in table.items()
        if key != "law"
    }
    return {"scene": scene, "law": RandomLaw(law, **drawn) if drawn else law} | arguments


def _distribution(name: str, value: Any) -> Distribution:
    """The distribution that a table of a study means."""
    return getattr(ji, distribution(name, value))(**value)


def import_module_of(tables: Mapping[str, Any], folder: Path) -> None:
    """Import the module that the table [law] of a study names, if it names one."""
    law = tables.get("law")
    if isinstance(law, dict) and "module" in law:
        import_laws(str(law["module"]), folder)


def import_laws(module: str, folder: Path) -> None:
    """Import a module that registers laws: a file (.py, relative to the folder), or by its name."""
    if not module.endswith(".py"):
        importlib.import_module(module)
        return
    path = (folder / module).resolve()
    if not path.is_file():
        raise ValueError(
            f"`module` must be a file or an importable module, but '{path}' does not exist."
        )
    imported = sys.modules.get(path.stem)
    if imported is not None:
        if Path(getattr(imported, "__file__", None) or "").resolve() == path:
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
