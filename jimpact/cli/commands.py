"""What the commands of the command line do: each takes its options, and hands back an answer.

Public names are taken from `jimpact` itself, so that a command imports no more than it needs.
"""

import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from io import BytesIO
from json import dumps
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np

import jimpact as ji
from jimpact.cli import options
from jimpact.cli.program_cache import stored_programs
from jimpact.cli.starting import as_csv
from jimpact.cli.study import Study, read_study
from jimpact.files.records import as_data, table
from jimpact.files.study_file import is_motion
from jimpact.fits.fitting import Fit
from jimpact.progress import Steps, waiting, wrapped
from jimpact.registry import registered_laws

if TYPE_CHECKING:
    from matplotlib.figure import Figure  # which takes long to import

    from jimpact.cli.study_motion import MotionStudy

DPI = 150
Table = tuple[Sequence[str], Sequence[Sequence[Any]]]  # names of columns, rows


class Answer(NamedTuple):
    """What a command found: for --json, for people, as pictures; what went wrong all the same."""

    title: str
    data: dict[str, Any]
    text: str
    pictures: Mapping[Path, "Figure | Callable[[Path], Any]"]  # to be saved, or what draws it
    failure: str = ""
    table: Table | None = None  # for --csv


def run(given: options.Command, steps: Steps, folder: str | None = None) -> str:
    """Do what a command says, and print it; what went wrong all the same, '' if nothing did.

    Programs are kept in the folder, if there is one.
    """
    jax.config.update("jax_enable_x64", True)  # the program's choice; the library sets none
    with stored_programs(folder):
        answer = _COMMANDS[given.name()](given, steps)
    replaced = [path for path in answer.pictures if path.exists()]
    for path, picture in answer.pictures.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        if callable(picture):
            picture(path)
        else:
            whole = BytesIO()  # what is interrupted leaves no half a picture
            picture.savefig(whole, format=path.suffix[1:], dpi=DPI)
            path.write_bytes(whole.getvalue())
        steps(f"picture {path}")
    pictures = [str(path) for path in answer.pictures]
    if given.csv:
        assert answer.table is not None  # every command has one
        print(as_csv(*answer.table))
    elif given.json:
        about = {"title": answer.title, "pictures": pictures} if pictures else {}
        print(dumps(about | answer.data, indent=2))
    else:
        lines = [answer.title, answer.text, *(f"Picture: {path}" for path in pictures)]
        print("\n".join(wrapped(line) for line in lines if line))
    for path in replaced:
        print(f"jimpact {given.name()}: {path} was there before: replaced.", file=sys.stderr)
    return answer.failure


def _shot(given: options.ShotCommand) -> tuple[Study, np.ndarray, np.ndarray | None]:
    """The study, in the scene of the shot where shots have their own, v-, and v+ if measured."""
    study, shot = read_study(given.study), given.shot - 1
    if given.velocity:
        return study, np.asarray(given.velocity, float), None
    data = study.experiments
    assert data is not None  # `ShotCommand.check`
    if shot >= len(data.shots):
        raise ValueError(f"--shot must lie in [1, {len(data.shots)}], but is {given.shot}.")
    study = replace(study, scene=data.scene_of(study.scene, shot))
    return study, np.asarray(data.pre[shot]), np.asarray(data.post[shot])


def _titled(study: Study, before: np.ndarray) -> str:
    """The first line of what is printed of one impact."""
    unit = "m/s" if study.scene.walls is not None else "m/s, rad/s"
    return f"{study.title}: v- = ({', '.join(f'{x:g}' for x in before)}) {unit}"


# -------------------------------------------------------------------------------------------- fit

OF_FRICTION = ("friction", "tangential_restitution")
RAW, CORRECTED, YARDSTICK, ALL_FREE = "as measured", "momentum corrected", "Newton", "all free"


def fit(given: options.FitCommand, steps: Steps) -> Answer:
    """The study's fit and its yardsticks; or every law, side by side."""
    if given.law == options.EVERY_LAW:
        return _every_law(given, steps)
    path = given.picture()
    chosen = {"starts": given.starts, "seed": given.seed, "progress": steps.patience}
    study: Study | MotionStudy
    if is_motion(given.study):
        from jimpact.cli.study_motion import read_motion_study

        study = read_motion_study(given.study, given.law)
        fits = {RAW: study.fit(**chosen)}
        steps(_in_words(RAW, fits[RAW]))
    else:
        study = read_study(given.study, given.law)
        fits = _all_fits(study, chosen | {"method": given.method}, steps)
    others = {"Newton fitted": fits[YARDSTICK]} if YARDSTICK in fits else None
    picture = ji.plot.fit(fits[RAW], others, study.title)
    text = "\n".join([*_summary(fits), "", str(fits[RAW]), ""])
    heads = ["fit", "law", "parameter", "value", "standard_error", "rms_m_per_s", "rank"]
    rows = [
        [what, type(x.law).__name__, name, x.value[i], x.standard_error[i], x.rms, x.rank]
        for what, x in fits.items()
        for i, name in enumerate(x.names)
    ]
    pictures = {path: picture} | _page(fits[RAW], given.report)
    return Answer(study.title, as_data({"fits": fits}), text, pictures, table=(heads, rows))


def _page(found: Fit, path: Path | None) -> dict[Path, Any]:
    return {} if path is None else {path: found.report}


def _every_law(given: options.FitCommand, steps: Steps) -> Answer:
    """All laws on the study's data; picture and page are those of the first one."""
    path, study = given.picture(), read_study(given.study)
    found = _laws_fitted(study, steps, given.starts, given.seed)
    picture = ji.plot.fit(found.best.fit, None, f"{study.title}: {found.best.name}")
    pictures = {path: picture} | _page(found.best.fit, given.report)
    return Answer(study.title, found.to_dict(), str(found), pictures, table=found.rows())


def _laws_fitted(
    study: Study, steps: Steps, starts: int | None = None, seed: int | None = None
) -> ji.LawFits:
    """Every law on the study's data, and whether e depends on the speed."""
    assert study.experiments is not None  # `FitCommand.check`
    kept = {key: x for key, x in study.parameters.items() if key != "restitution"}
    given = {"starts": starts, "seed": seed}
    chosen = {key: study.options.get(key) if x is None else x for key, x in given.items()}
    chosen = {key: x for key, x in chosen.items() if x is not None}

    def done(name: str, fit: Fit) -> None:
        steps(_in_words(name, fit))

    also = [name for name in study.free if name in OF_FRICTION]
    return ji.fit_laws(
        study.scene, study.experiments, free=also, speed=True, done=done, **(kept | chosen)
    )


def _all_fits(study: Study, options: dict[str, Any], steps: Steps) -> dict[str, Fit]:
    """The study's fit and its yardsticks; fits of one law share one compiled program."""
    own, everything = _per_contact(study)
    fits: dict[str, Fit] = {}

    def run(name: str, study: Study) -> None:
        profiles = None if name == RAW else False  # which only the report of this one tells
        fits[name] = study.run(**options, profiles=profiles)
        steps(_in_words(name, fits[name]))

    run(RAW, own)
    if study.measured is not None:  # other laws know no forces, and no times
        return fits
    if any("break momentum" in line for line in fits[RAW].warnings):
        assert study.experiments is not None  # it was fitted
        data = study.experiments.momentum_corrected(study.scene)
        run(CORRECTED, replace(own, experiments=data))
    if not isinstance(study.law, ji.Newton):
        friction = getattr(study.law, "friction", None)
        shared = [name for name in ("restitution", "friction") if name in study.free]
        free: dict[str, Any] = dict.fromkeys(shared or ["restitution"], True)
        newton = replace(study, law=ji.Newton(0.5, friction), free=free, bounds={})
        run(YARDSTICK, newton)
    if everything is not None:
        run(ALL_FREE, everything)
    return fits


def _per_contact(study: Study) -> tuple[Study, Study | None]:
    """The study of an LZB law with one value per contact, tied where it had one for all.

    And the study with every e and stiffness ratio free, None where that is no LZB or no more.
    """
    law, contacts = study.law, study.scene.contacts
    fields = ("restitution", "stiffness")
    if not isinstance(law, ji.LZB) or contacts < 2 or not set(study.free) <= set(fields):
        return study, None
    tied = {}
    for name in fields:
        choice = np.asarray(study.free.get(name, False))
        one_each = np.arange(1, contacts + 1) if np.ndim(getattr(law, name)) else 1
        labels = np.where(choice, one_each, 0) if choice.dtype == bool else choice
        tied[name] = np.broadcast_to(labels, (contacts,))
    e, k = (np.broadcast_to(getattr(law, name), (contacts,)) for name in fields)
    law = ji.LZB(e, k, exponent=law.exponent, initial_energy=law.initial_energy)
    own = replace(study, law=law, free=tied)
    if len(np.unique(tied["restitution"])) == contacts and tied["stiffness"].all():
        return own, None
    return own, replace(own, free=dict.fromkeys(fields, True))


def _summary(fits: dict[str, Fit]) -> list[str]:
    """A line a parameter of each fit, and what the data see of all parameters."""
    rows = []
    for what, found in fits.items():
        data = "corrected" if what == CORRECTED else RAW
        last = [
            f"{found.rms:.4f}" if found.experiments is not None else f"{found.rms:.4g}",
            f"{found.rank} of {len(found.names)}",
        ]
        for i, name in enumerate(found.names):
            first = [type(found.law).__name__, data] if i == 0 else ["", ""]
            rows.append([*first, name, _value(found, i), *(last if i == 0 else ["", ""])])
    speeds = all(found.experiments is not None for found in fits.values())
    rms = "rms [m/s]" if speeds else "rms"
    heads = ["law", "data", "parameter", "value", rms, "rank"]
    lines = table(heads, rows, left=["data", "parameter", "value"])
    if CORRECTED in fits:
        lines.append("corrected: changed as little as possible so that momentum is conserved")
    if everything := fits.get(ALL_FREE):
        names = everything.names
        lines.append(f"With {', '.join(names)} free the rank is {everything.rank} of {len(names)}.")
        lines += everything.identifiability
    return lines


def _in_words(name: str, found: Fit) -> str:
    values = ", ".join(f"{x} {_value(found, i)}" for i, x in enumerate(found.names))
    unit = "" if found.experiments is None else " m/s"
    return f"{name}: {values}, rms {found.rms:.4g}{unit}"


def _value(found: Fit, i: int) -> str:
    error = found.standard_error[i]
    if found.at_bound[i]:
        return f"{found.value[i]:.5g} (bound)"
    spread = "unseen" if np.isinf(error) else "± unknown" if np.isnan(error) else f"± {error:.2g}"
    return f"{found.value[i]:.5g} {spread}"


# ---------------------------------------------------------------------------------------- compare


def compare(given: options.CompareCommand, steps: Steps) -> Answer:
    """Every law on one scene."""
    path = given.picture()
    study, before, measured = _shot(given)
    laws, left_out = registered_laws(study.parameters)
    with waiting("comparing laws", steps.patience):
        found = ji.compare(study.scene, before, laws)
    steps(f"{len(laws)} laws compared")
    found = replace(found, left_out=left_out, measured=measured)
    fits = _laws_fitted(study, steps) if given.fit and study.experiments is not None else None
    values = ", ".join(f"{key} = {value}" for key, value in study.parameters.items())
    lines = [
        str(found),
        *([] if fits is None else ["", "Fitted to all shots:", str(fits), ""]),
        f"Parameters: {values}.",
        "Dispersion: 0 all energy in one body, 1 equal shares. Time: one compiled call, its "
        "argument checks included.",
    ]
    data = {"velocity": before, "laws": found, "fits": fits, "left_out": left_out}
    picture = ji.plot.comparison(found, measured, study.title)
    bodies = [f"v_{i + 1}_plus" for i in range(len(before))]
    heads = ["law", *bodies, "energy_ratio", "dispersion", "time_s", "audit"]
    told = attrgetter("energy_ratio", "dispersion_index", "time", "verdict")
    rows = [[name, *np.asarray(x.outcome.velocity), *told(x)] for name, x in found.entries.items()]
    text = "\n".join(lines)
    return Answer(_titled(study, before), as_data(data), text, {path: picture}, table=(heads, rows))


# ------------------------------------------------------------------------------------- montecarlo


def montecarlo(given: options.MonteCarloCommand, steps: Steps) -> Answer:
    """Random gaps, velocities, parameters."""
    path = given.picture()
    study = read_study(given.study)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        found = ji.monte_carlo(**_sampling(study, given), progress=steps.patience)
    steps(f"{found.samples:,} samples")
    for warning in caught:
        print(f"jimpact montecarlo: {warning.message}", file=sys.stderr)
    picture = ji.plot.monte_carlo(found, study.title)
    columns = found.mean, found.standard_error, found.std, found.minimum, found.maximum
    heads = ["coordinate", "mean", "standard_error", "std", "least", "largest"]
    rows = [[i + 1, *row] for i, row in enumerate(zip(*columns))]
    return Answer(study.title, found.to_dict(), str(found), {path: picture}, table=(heads, rows))


def _sampling(study: Study, given: options.MonteCarloCommand) -> dict[str, Any]:
    """Of `monte_carlo`: those of the study, or in their place those of the command line."""
    executor: Any = given.executor
    if given.scheduler is not None:
        from jimpact.montecarlo.executors import DaskExecutor

        executor = DaskExecutor(given.scheduler)
    options = {"samples": given.samples, "key": given.seed, "folder": given.folder}
    chosen = {name: value for name, value in options.items() if value is not None}
    return study.monte_carlo | chosen | {"executor": executor, "keep_samples": given.keep_samples}


# ------------------------------------------------------------------------------------------ chart

QUICK = "\nThis is the quick look; --full does all of it."
QUICK_METHODS = ("dop853", "verlet", "impulse_euler")
QUICK_LAWS = ("moreau", "binary")


def chart(given: options.ChartCommand, steps: Steps) -> Answer:
    """Speed against accuracy on one scene."""
    path = given.picture()
    study, before, _ = _shot(given)
    law = _lzb(study)
    known, _ = registered_laws({"restitution": law.restitution})
    found = ji.work_precision(
        study.scene,
        before,
        law,
        given.methods or (None if given.full else _quick_methods(law)),
        laws=None if given.full else {x: known[x] for x in QUICK_LAWS},
        batch=given.batch,
        repeats=given.repeats,
        gradients=given.full,
        durations=given.full,
        progress=steps.patience,
    )
    picture = ji.plot.work_precision(found, study.title)
    text = str(found) + ("" if given.full or given.methods else QUICK)
    from jimpact.methods.chart import QUANTITIES

    heads = ["method", "setting", *QUANTITIES, "evaluations", "alone_s", "batch_s", "status"]
    told = attrgetter("evaluations", "single.median", "batched.median", "status")
    rows = [
        [name, x.setting, *(x.error[q] for q in QUANTITIES), *told(x)]
        for name, points in found.points.items()
        for x in points
    ]
    title = _titled(study, before)
    return Answer(title, found.to_dict(), text, {path: picture}, table=(heads, rows))


def _lzb(study: Study) -> ji.LZB:
    """The study's law, or LZB with what the study says of its parameters (restitution: 1)."""
    if isinstance(study.law, ji.LZB):
        return study.law
    known = {"restitution": 1.0} | study.parameters
    return ji.LZB(**{key: known[key] for key in ji.REGISTRY["lzb"].parameters if key in known})


def _quick_methods(law: ji.LZB) -> list[str]:
    """Those that compile soon and can solve the impact."""
    from jimpact.methods.contenders import METHODS

    return [name for name in QUICK_METHODS if METHODS[name].supports(law) is None]


# -------------------------------------------------------------------------------------- stability

STEPS = 5_000  # of a run
QUICK_RESOLUTION, FULL_RESOLUTION, FULL_SAMPLES = 7, 9, 300
TITLE = "LZB, three equal Hertz balls, e = 0.9 (triangles), one axis changed at a time"


def stability(given: options.StabilityCommand, steps: Steps) -> Answer:
    """Maps of methods; the picture of single axes, and of pairs, one more beside it a method."""
    path = given.picture()
    if not given.full:  # three balls: a program a method
        from jimpact.methods.stability import default_axes

        axes = default_axes(QUICK_RESOLUTION).items()
        size: dict[str, Any] = {"axes": {name: x for name, x in axes if name != "balls"}}
    else:
        size = {"resolution": FULL_RESOLUTION, "slices": "pairs", "samples": FULL_SAMPLES}
    found = ji.stability_map(
        given.methods or None, **size, max_steps=STEPS, progress=steps.patience
    )
    pictures = {path: ji.plot.stability_map(found, TITLE)}
    for name in found.methods if given.full else ():
        beside = path.with_name(f"{path.stem}-{name.replace('_', '-')}{path.suffix}")
        pictures[beside] = ji.plot.stability_pairs(found, name)
    text = str(found) + ("" if given.full else QUICK)
    counts = [[name, *found.counts(name).values()] for name in found.methods]
    table = ["method", *found.counts(found.methods[0])], counts
    return Answer("", found.to_dict(), text, pictures, table=table)


# ----------------------------------------------------------------------------------------- advise

_TAKEN = ("restitution", "stiffness", "exponent", "friction")  # of the study's parameters
_REFUSED = ("tangential_restitution", "initial_energy")  # these would change the outcome


def advise(given: options.AdviseCommand, steps: Steps) -> Answer:
    """The simplest law that a scene needs."""
    path = given.picture()
    study, before, _ = _shot(given)
    found = ji.advise(
        study.scene,
        before,
        given.tolerance,
        stiffness_range=given.stiffness_range,
        samples=given.samples,
        seed=given.seed,
        progress=steps.patience,
        **_lzb_parameters(study),
    )
    picture = ji.plot.advice(found, study.title)
    title, heads = _titled(study, before), ["law", "worst", "chosen"]
    rows = [[name, x.worst, name == found.name] for name, x in found.candidates.items()]
    return Answer(title, found.to_dict(), str(found), {path: picture}, table=(heads, rows))


def _lzb_parameters(study: Study) -> dict[str, Any]:
    """Of the study's law what LZB has too."""
    rheology = study.parameters.get("rheology", "bistiffness")
    if rheology != "bistiffness":
        raise ValueError(
            f"the study must have bistiffness contacts, but has rheology {rheology!r}: of viscous "
            "contacts only the compliant law knows."
        )
    for key in _REFUSED:
        if np.any(study.parameters.get(key, 0.0)):
            raise ValueError(
                f"the study must not have `{key}`, but has {study.parameters[key]}: `jimpact "
                "advise` compares laws without it."
            )
    return {key: value for key, value in study.parameters.items() if key in _TAKEN}


# --------------------------------------------------------------------------------------- simulate


def simulate(given: options.SimulateCommand, steps: Steps) -> Answer:
    """A whole motion; one that does not reach its end is drawn and printed as far as it goes."""
    from jimpact.cli.study_motion import read_motion_study

    path, portrait = given.picture(), given.portrait
    study = read_motion_study(given.study)
    system, title = study.system, study.title
    run = study.run(t_end=given.t_end, samples=given.samples, progress=steps.patience)
    found = jax.block_until_ready(run)
    steps("motion computed")
    pictures: dict[Path, Any] = {path: ji.plot.motion(found, title, system=system)}
    if portrait is not None:
        which = None if given.coordinate is None else given.coordinate - 1
        pictures[portrait] = ji.plot.phase_portrait(found, which, title, system=system)
    if given.gif is not None:
        pictures[given.gif] = partial(
            ji.plot.animation, system, found, title=title, progress=steps.patience
        )
    heads = ["time [s]", *system.body.names, *system.body.velocity_names]
    table = heads, np.column_stack([found.time, found.q, found.velocity]).tolist()
    return Answer(title, found.to_dict(), str(found), pictures, _failure(found), table)


def _failure(motion: "ji.Motion") -> str:
    try:
        ji.raise_on_failed_motion(motion)
    except RuntimeError as error:
        return str(error)
    return ""


_COMMANDS: dict[str, Callable[[Any, Steps], Answer]] = {
    command.__name__: command
    for command in (fit, compare, montecarlo, chart, stability, advise, simulate)
}
