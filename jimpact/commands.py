"""What the commands of the command line do: each takes its options, and hands back an answer.

Public names are taken from `jimpact` itself, so that a command imports no more than it needs.
"""

import sys
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np
from rich.console import Console
from rich.table import Table

import jimpact as ji
from jimpact import options
from jimpact.comparison import registered_laws
from jimpact.fits.fitting import Fit
from jimpact.progress import waiting
from jimpact.records import as_data, table
from jimpact.study import Study, import_laws, read_study

if TYPE_CHECKING:
    from matplotlib.figure import Figure  # which takes long to import

KINDS = (".png", ".pdf", ".svg")
DPI = 150
BAD_INPUT, FAILURE = 2, 1  # exit codes
INTERRUPTED = 130  # what a shell expects of a program that ctrl-C ended


class Answer(NamedTuple):
    """What a command found: for --json, for people, as pictures; what went wrong all the same."""

    title: str
    data: dict[str, Any]
    text: str
    pictures: Mapping[Path, "Figure | Callable[[Path], Any]"]  # to be saved, or what draws it
    failure: str = ""


def run(given: options.Command) -> int:
    """The exit code of a command: 0; wrong input 2, a method or law that fails 1, ctrl-C 130."""
    jax.config.update("jax_enable_x64", True)  # the program's choice; the library sets none
    try:
        answer = _COMMANDS[given.name()](given)
        replaced = [path for path in answer.pictures if path.exists()]
        for path, picture in answer.pictures.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            if callable(picture):
                picture(path)
            else:
                picture.savefig(path, dpi=DPI)
    except KeyboardInterrupt as stop:
        return _refuse(given, str(stop) or "stopped.", INTERRUPTED)
    except (ValueError, TypeError, OSError, ImportError) as error:
        return _refuse(given, str(error), BAD_INPUT)
    except RuntimeError as error:
        return _refuse(given, str(error), FAILURE)
    pictures = [str(path) for path in answer.pictures]
    if given.json:
        about = {"title": answer.title, "pictures": pictures} if pictures else {}
        print(dumps(about | answer.data, indent=2))
    else:
        lines = [answer.title, answer.text, *(f"Picture: {path}" for path in pictures)]
        print("\n".join(line for line in lines if line))
    for path in replaced:
        print(f"jimpact {given.name()}: {path} was there before: replaced.", file=sys.stderr)
    return _refuse(given, answer.failure, FAILURE) if answer.failure else 0


def _refuse(given: options.Command, reason: str, code: int) -> int:
    print(f"jimpact {given.name()}: {reason}", file=sys.stderr)
    return code


def _picture(given: options.DrawingCommand) -> Path:
    """The file --out, or the command's own in the directory --out, named after the study."""
    if given.out.suffix:
        return _checked(given.out)
    study, default = (getattr(x, "study", None) for x in (given, type(given)))
    named = "" if study is None or study == default else f"-{study.stem}"
    return given.out / f"jimpact-{given.name()}{named}.png"


def _checked(path: Path, option: str = "--out") -> Path:
    """The path of a picture; other endings are refused."""
    if path.suffix not in KINDS:
        raise ValueError(
            f"{option} must end in .png, .pdf or .svg or be a directory, but is '{path}'."
        )
    return path


def _velocities(study: Study, given: options.ShotCommand) -> tuple[np.ndarray, np.ndarray | None]:
    """Velocities before the impact, and after it where they were measured."""
    if given.velocity is not None:
        return np.asarray(given.velocity, float), None
    data = study.experiments
    if data is None:
        raise ValueError("--velocity must be given, because the study has no [data].")
    if not 1 <= given.shot <= len(data.shots):
        raise ValueError(f"--shot must lie in [1, {len(data.shots)}], but is {given.shot}.")
    return np.asarray(data.pre[given.shot - 1]), np.asarray(data.post[given.shot - 1])


def _titled(study: Study, before: np.ndarray) -> str:
    """The first line of what is printed of one impact."""
    unit = "m/s" if study.scene.walls is not None else "m/s, rad/s"
    return f"{study.title}: v- = ({', '.join(f'{x:g}' for x in before)}) {unit}"


# -------------------------------------------------------------------------------------------- fit

RAW, CORRECTED, YARDSTICK, ALL_FREE = "as measured", "momentum corrected", "Newton", "all free"


def fit(given: options.FitCommand) -> Answer:
    """The study's fit and its yardsticks."""
    path = _picture(given)
    study = read_study(given.study, given.law)
    fits = _all_fits(study, {"method": given.method, "starts": given.starts, "seed": given.seed})
    others = {"Newton fitted": fits[YARDSTICK]} if YARDSTICK in fits else None
    picture = ji.plot.fit(fits[RAW], others, study.title)
    text = "\n".join([*_summary(fits), "", str(fits[RAW]), ""])
    return Answer(study.title, as_data({"fits": fits}), text, {path: picture})


def _all_fits(study: Study, options: dict[str, Any]) -> dict[str, Fit]:
    """The study's fit and its yardsticks; fits of one law share one compiled program."""
    own, everything = _per_contact(study)
    fits = {RAW: own.run(**options)}
    if any("break momentum" in line for line in fits[RAW].warnings):
        assert study.experiments is not None  # it was fitted
        data = study.experiments.momentum_corrected(study.scene)
        fits[CORRECTED] = replace(own, experiments=data).run(**options)
    if not isinstance(study.law, ji.Newton):
        newton = replace(study, law=ji.Newton(0.5), free={"restitution": True}, bounds={})
        fits[YARDSTICK] = newton.run(**options)
    if everything is not None:
        fits[ALL_FREE] = everything.run(**options)
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
        last = [f"{found.rms:.4f}", f"{found.rank} of {len(found.names)}"]
        for i, name in enumerate(found.names):
            first = [type(found.law).__name__, data] if i == 0 else ["", ""]
            rows.append([*first, name, _value(found, i), *(last if i == 0 else ["", ""])])
    heads = ["law", "data", "parameter", "value", "rms [m/s]", "rank"]
    lines = table(heads, rows, left=["data", "parameter", "value"])
    if CORRECTED in fits:
        lines.append("corrected: changed as little as possible so that momentum is conserved")
    if everything := fits.get(ALL_FREE):
        names = everything.names
        lines.append(f"With {', '.join(names)} free the rank is {everything.rank} of {len(names)}.")
        lines += everything.identifiability
    return lines


def _value(found: Fit, i: int) -> str:
    error = found.standard_error[i]
    if found.at_bound[i]:
        return f"{found.value[i]:.5g} (bound)"
    spread = "unseen" if np.isinf(error) else "± unknown" if np.isnan(error) else f"± {error:.2g}"
    return f"{found.value[i]:.5g} {spread}"


# ---------------------------------------------------------------------------------------- compare


def compare(given: options.CompareCommand) -> Answer:
    """Every law on one scene."""
    path = _picture(given)
    study = read_study(given.study)
    before, measured = _velocities(study, given)
    laws, left_out = registered_laws(study.parameters)
    with waiting("laws"):
        found = ji.compare(study.scene, before, laws)
    found = replace(found, left_out=left_out, measured=measured)
    fits = _fits_of_all(study) if given.fit else {}
    values = ", ".join(f"{key} = {value}" for key, value in study.parameters.items())
    lines = [
        str(found),
        *(_fit_table(fits) if fits else []),
        f"Parameters: {values}.",
        "Dispersion: 0 all energy in one body, 1 equal shares. Time: one compiled call, its "
        "argument checks included.",
    ]
    data = {"velocity": before, "laws": found, "fits": fits, "left_out": left_out}
    picture = ji.plot.comparison(found, measured, study.title)
    return Answer(_titled(study, before), as_data(data), "\n".join(lines), {path: picture})


def _fits_of_all(study: Study) -> dict[str, Fit]:
    """Every law with restitution coefficients at its best, one for all contacts and one each."""
    start = {**study.parameters, "restitution": 0.9}
    each = {**start, "restitution": np.full(study.scene.contacts, 0.9)}
    fits = {}
    for label, values in (("one e", start), ("e per contact", each)):
        for name, law in registered_laws(values)[0].items():
            if hasattr(law, "restitution") and (label == "one e" or study.scene.contacts > 1):
                own = replace(study, law=law, free={"restitution": True}, bounds={})
                fits[f"{name}, {label}"] = own.run()
    return fits


def _fit_table(fits: dict[str, Fit]) -> list[str]:
    rows = [
        [name, ", ".join(f"{x:.4f}" for x in found.value), f"{found.rms:.4f}"]
        for name, found in fits.items()
    ]
    return table(["fitted law", "restitution", "rms [m/s]"], rows, left=["restitution"])


# ------------------------------------------------------------------------------------- montecarlo


def montecarlo(given: options.MonteCarloCommand) -> Answer:
    """Random gaps, velocities, parameters."""
    path = _picture(given)
    study = read_study(given.study)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        found = ji.monte_carlo(**_sampling(study, given))
    for warning in caught:
        print(f"jimpact montecarlo: {warning.message}", file=sys.stderr)
    picture = ji.plot.monte_carlo(found, study.title)
    return Answer(study.title, found.to_dict(), str(found), {path: picture})


def _sampling(study: Study, given: options.MonteCarloCommand) -> dict[str, Any]:
    """Of `monte_carlo`: those of the study, or in their place those of the command line."""
    if not study.monte_carlo:
        raise ValueError(f"the study '{given.study}' must have a [monte_carlo] table.")
    executor: Any = given.executor
    if given.scheduler is not None:
        if executor != "dask":
            raise ValueError(f"--scheduler needs --executor dask, but it is {executor}.")
        from jimpact.montecarlo.executors import DaskExecutor

        executor = DaskExecutor(given.scheduler)
    options = {"samples": given.samples, "key": given.seed, "folder": given.folder}
    chosen = {name: value for name, value in options.items() if value is not None}
    return study.monte_carlo | chosen | {"executor": executor, "keep_samples": given.keep_samples}


# ------------------------------------------------------------------------------------------ chart

SLOW_TO_COMPILE = ("tsit5", "kvaerno5")  # left to --full


def chart(given: options.ChartCommand) -> Answer:
    """Speed against accuracy on one scene."""
    path = _picture(given)
    study = read_study(given.study)
    law = _lzb(study)
    before, _ = _velocities(study, given)
    found = ji.work_precision(
        study.scene,
        before,
        law,
        given.methods or _able(law, study, given.full),
        batch=given.batch,
        repeats=given.repeats,
        gradients=not given.no_gradients,
    )
    picture = ji.plot.work_precision(found, study.title)
    return Answer(_titled(study, before), found.to_dict(), str(found), {path: picture})


def _lzb(study: Study) -> ji.LZB:
    """The study's law, or LZB with what the study says of its parameters (restitution: 1)."""
    if isinstance(study.law, ji.LZB):
        return study.law
    known = {"restitution": 1.0} | study.parameters
    return ji.LZB(**{key: known[key] for key in ji.REGISTRY["lzb"].parameters if key in known})


def _able(law: ji.LZB, study: Study, full: bool) -> tuple[str, ...]:
    """Methods that can solve the study's impact, without those that compile for long."""
    from jimpact.methods.contenders import METHODS

    left_out = () if full else SLOW_TO_COMPILE
    return tuple(
        name
        for name, method in METHODS.items()
        if name not in left_out and method.supports(law, study.scene) is None
    )


# -------------------------------------------------------------------------------------- stability

STEPS = 5_000  # of a run
QUICK_RESOLUTION, FULL_RESOLUTION, FULL_SAMPLES = 7, 9, 300
TITLE = "LZB, three equal Hertz balls, e = 0.9 (triangles), one axis changed at a time"


def stability(given: options.StabilityCommand) -> Answer:
    """Maps of methods; the picture of single axes, and of pairs, one more beside it a method."""
    path = _picture(given)
    size: dict[str, Any] = {"resolution": QUICK_RESOLUTION}
    if given.full:
        size = {"resolution": FULL_RESOLUTION, "slices": "pairs", "samples": FULL_SAMPLES}
    found = ji.stability_map(given.methods, **size, max_steps=STEPS)
    pictures = {path: ji.plot.stability_map(found, TITLE)}
    for name in found.methods if given.full else ():
        beside = path.with_name(f"{path.stem}-{name.replace('_', '-')}{path.suffix}")
        pictures[beside] = ji.plot.stability_pairs(found, name)
    return Answer("", found.to_dict(), str(found), pictures)


# ----------------------------------------------------------------------------------------- advise

_TAKEN = ("restitution", "stiffness", "exponent")  # of the study's parameters


def advise(given: options.AdviseCommand) -> Answer:
    """The simplest law that a scene needs."""
    path = _picture(given)
    study = read_study(given.study)
    before, _ = _velocities(study, given)
    found = ji.advise(
        study.scene,
        before,
        given.tolerance,
        stiffness_range=given.stiffness_range,
        samples=given.samples,
        seed=given.seed,
        **_lzb_parameters(study),
    )
    picture = ji.plot.advice(found, study.title)
    return Answer(_titled(study, before), found.to_dict(), str(found), {path: picture})


def _lzb_parameters(study: Study) -> dict[str, Any]:
    """Of the study's law what LZB has too."""
    rheology = study.parameters.get("rheology", "bistiffness")
    if rheology != "bistiffness":
        raise ValueError(
            f"the study must have bistiffness contacts, but has rheology {rheology!r}: of viscous "
            "contacts only the compliant law knows."
        )
    return {key: value for key, value in study.parameters.items() if key in _TAKEN}


# --------------------------------------------------------------------------------------- simulate


def simulate(given: options.SimulateCommand) -> Answer:
    """A whole motion; one that does not reach its end is drawn and printed as far as it goes."""
    from jimpact.motion.study_motion import read_motion_study

    portrait = None if given.portrait is None else _checked(given.portrait, "--portrait")
    if given.gif is not None and given.gif.suffix != ".gif":
        raise ValueError(f"--gif must end in .gif, but is '{given.gif}'.")
    path = _picture(given)
    if portrait == path:
        raise ValueError(f"--portrait and --out must be two files, but are both '{path}'.")
    study = read_motion_study(given.study)
    system, title = study.system, study.title
    found = jax.block_until_ready(study.run(t_end=given.t_end, samples=given.samples))
    pictures: dict[Path, Any] = {path: ji.plot.motion(found, title, system=system)}
    if portrait is not None:
        which = None if given.coordinate is None else given.coordinate - 1
        pictures[portrait] = ji.plot.phase_portrait(found, which, title, system=system)
    if given.gif is not None:
        pictures[given.gif] = partial(ji.plot.animation, system, found, title=title)
    return Answer(title, found.to_dict(), str(found), pictures, _failure(found))


def _failure(motion: "ji.Motion") -> str:
    try:
        ji.raise_on_failed_motion(motion)
    except RuntimeError as error:
        return str(error)
    return ""


# ------------------------------------------------------------------------------------------- laws

COLUMNS = ("parameters", "summary", "right_when", "fails_when", "source")


def laws(given: options.LawsCommand) -> Answer:
    """The registry as a table, as JSON or as references."""
    if given.module is not None:
        import_laws(given.module, Path())
    rows = {name: {k: getattr(row, k) for k in COLUMNS} for name, row in ji.REGISTRY.items()}
    if given.bibtex:
        entries = dict.fromkeys(row.bibtex for row in ji.REGISTRY.values())
        return Answer("", rows, "\n\n".join(entries), {})
    told = Table()
    for title in ("law", "parameters", "says", "right when", "fails when"):
        told.add_column(title, overflow="fold")
    for name, row in ji.REGISTRY.items():
        parameters = ", ".join(row.parameters)
        told.add_row(name, parameters, row.summary, row.right_when, row.fails_when)
    console = Console()
    with console.capture() as text:
        console.print(told)
    return Answer("", rows, text.get().rstrip(), {})


_COMMANDS: dict[str, Callable[[Any], Answer]] = {
    command.__name__: command
    for command in (fit, compare, montecarlo, chart, stability, advise, simulate, laws)
}
