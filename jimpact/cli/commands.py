"""Commands of the command line: each takes its options and returns a result.

Public names are taken from `jimpact` itself, so that a command imports no more than it
needs.
"""

import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from io import BytesIO
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jimpact as ji
from jimpact.cli import options
from jimpact.cli.study import Study, impact_study, motion_study, read_study
from jimpact.cli.study_file import NO_DATA, without_none
from jimpact.core.law import with_parameter
from jimpact.core.registry import registered_laws
from jimpact.tools.progress import Steps, waiting, wrapped
from jimpact.tools.records import Column, Table, as_data

if TYPE_CHECKING:
    from matplotlib.figure import Figure  # which takes long to import

    from jimpact.fits.report import Fit
    from jimpact.fits.selection import LawFits
    from jimpact.motion.record import Motion

DPI = 150  # of pictures that are pixels: readable on paper, a few hundred kB

# Words of the printed results (regular expressions), and the sentences that explain
# them there.
GLOSSARY = {
    r"\brank\b": (
        "Rank: how many combinations of the free parameters the data determine."
    ),
    r"\(bound\)": "(bound): the fit ended at a bound of the parameter's range.",
    r"\bAICc\b": "AICc: Akaike's information criterion, misfit against number of "
    "parameters; lower is better, differences below 2 mean little.",
    r"\bcorrected\b": "Corrected: the data, changed as little as possible so that they "
    "conserve momentum.",
    r"\baccumulation\b": "Accumulation: infinitely many impacts in a finite time.",
    r"\d friction\b": "Friction: a contact begins to stick or to slip.",
    r"\bparoxysm\b": (
        "Paroxysm: friction jams a sliding contact, an impact without collision."
    ),
    r"\bdispersion\b": "Dispersion: 0 all energy in one body, 1 equal shares.",
}


class CommandResult(NamedTuple):
    """The result of a command, in all forms in which it may be printed."""

    title: str
    data: Any  # for --json, see `as_data`; for people too, where there is no `text`
    picture: "Figure"
    table: Table  # for --csv
    text: str | None = None
    # further pictures, or what writes
    more: Mapping[Path, "Figure | Callable[[Path], Any]"] = {}
    failure: str = ""  # what went wrong


def run(command: options.DrawingCommand, steps: Steps) -> str:
    """Run a command and print its result; returns what went wrong, '' if nothing
    did.
    """
    # the program's choice; the library sets none
    jax.config.update("jax_enable_x64", True)
    result = _COMMANDS[command.name()](command, steps)
    _show(command, result, steps)
    return result.failure


def _show(command: options.DrawingCommand, result: CommandResult, steps: Steps) -> None:
    """Write the pictures of a result, and print it as text, CSV or JSON, as the options
    say.
    """
    pictures: dict[Path, Any] = {command.picture(): result.picture, **result.more}
    replaced = [path for path in pictures if path.exists()]
    for path, picture in pictures.items():
        _write_picture(path, picture)
        steps(f"picture {path}")
    if command.csv:
        print(result.table.to_csv())
    elif command.json:
        data = {"title": result.title, "pictures": [str(path) for path in pictures]}
        print(dumps(data | as_data(result.data), indent=2))
    else:
        if result.text is None:
            text = str(result.data)
        else:
            text = result.text
        notes = [note for word, note in GLOSSARY.items() if re.search(word, text)]
        places = [f"Picture: {path}" for path in pictures]
        lines = [result.title, text, *notes, *places]
        print("\n".join(wrapped(line) for line in lines if line))
    for path in replaced:
        print(
            f"jimpact {command.name()}: {path} existed and was replaced.",
            file=sys.stderr,
        )


def _write_picture(path: Path, picture: "Figure | Callable[[Path], Any]") -> None:
    """Save a figure, whole or not at all; or call the function that writes the file."""
    if not path.parent.exists():
        path.parent.mkdir(parents=True)
        print(f"jimpact: folder {path.parent} was made.", file=sys.stderr)
    if callable(picture):
        picture(path)
        return
    content = BytesIO()
    picture.savefig(content, format=path.suffix[1:], dpi=DPI)
    path.write_bytes(content.getvalue())


def _impact_of(
    command: options.ShotCommand,
) -> tuple[Study, np.ndarray, np.ndarray | None]:
    """Study, v- (n,) [m/s, rad/s] and measured v+ (n,), None without one, of a
    command's impact.

    v- is --velocity; without it v- and v+ are those of the study's shot --shot, and the
    study gets the scene of this shot where shots have their own.
    """
    study = impact_study(command.study)
    shot = command.shot - 1
    if command.velocity:  # given: it need not be one of the study's shots
        before = np.asarray(command.velocity, float)
        separates = np.asarray(ji.gap_velocity(study.scene, before)) >= 0
        if separates.all() and "initial_energy" not in study.parameters:
            raise ValueError(
                "--velocity must let bodies approach each other, but no contact "
                "closes: there is no impact (positive velocities of a chain point to "
                "the right)."
            )
        return study, before, None
    data = study.experiments
    if data is None:
        raise ValueError("--velocity must be given, because the study has no shots.")
    if not 0 <= shot < len(data.shots):
        raise ValueError(
            f"--shot must lie in [1, {len(data.shots)}], but is {command.shot}."
        )
    study = replace(study, scene=data.scene_of(study.scene, shot))
    return study, np.asarray(data.pre[shot]), np.asarray(data.post[shot])


def _titled(study: Study, before: np.ndarray) -> str:
    """The first line of what is printed: the study and its velocities before the
    impact.
    """
    if study.scene.walls is not None:
        unit = "m/s"
    else:
        unit = "m/s, rad/s"
    return f"{study.title}: v- = ({', '.join(f'{x:g}' for x in before)}) {unit}"


# --------------------------------------------------------------------------------------
# fit

FRICTION_PARAMETERS = ("friction", "tangential_restitution")
RAW = "as measured"
CORRECTED = "momentum corrected"
ALL_FREE = "all free"


def fit(command: options.FitCommand, steps: Steps) -> CommandResult:
    """`jimpact fit`: fit the study's law to its data; with --law all every law.

    Shots are fitted up to three times, see `_fits_of`, until the time limit --limit
    [s].
    """
    if command.law == options.EVERY_LAW:
        return _fit_every_law(command, steps)
    chosen: dict[str, Any] = {
        "starts": command.starts,
        "seed": command.seed,
        "progress": steps.patience,
    }
    study = read_study(command.study, command.law)
    fits: dict[str, Fit] = {}
    if not isinstance(study, Study):  # of a motion
        if command.method is not None or command.all_free:
            raise ValueError(
                "--method, --law all, --all-free must be left out for a motion."
            )
        fits[RAW] = study.fit(**chosen, limit=command.limit)
        steps(_fit_in_words(RAW, fits[RAW]))
        return _fits_result(study.title, fits)

    def result() -> CommandResult:
        """The result with the fits that are done so far."""
        return _with_track(_fits_result(study.title, fits), study, command)

    if command.limit is None:
        end = np.inf
    else:
        end = time.monotonic() + command.limit
    chosen |= {"method": command.method}
    for name, each in _fits_of(study, command.all_free, fits):
        left = max(end - time.monotonic(), 0.0)
        if name != RAW and left == 0.0:
            steps(f"{name}: left out, the time limit is reached")
            continue
        # only the report of this fit shows them
        if name == RAW:
            profiles = None
        else:
            profiles = False
        if command.limit is None:
            limit = None
        else:
            limit = left
        fits[name] = each.run(**chosen, profiles=profiles, limit=limit)
        steps(_fit_in_words(name, fits[name]))
        steps.show_finished = lambda: _show(command, result(), steps)
    steps.show_finished = None
    return result()


def _fits_of(
    study: Study, all_free: bool, fits: Mapping[str, "Fit"]
) -> Iterator[tuple[str, Study]]:
    """Studies to fit one after the other, by name: variants of one study of shots.

    `RAW` as it is; `CORRECTED` with velocities changed to conserve momentum, if the
    report of the first of the `fits` finds that they do not; `ALL_FREE` with every e
    and stiffness ratio free, if asked for.
    """
    with_all_free = None
    if all_free:  # fits of one law share one compiled program
        study, with_all_free = _per_contact(study)
    yield RAW, study
    if fits[RAW].found("momentum"):
        assert study.experiments is not None  # it was fitted
        data = study.experiments.momentum_corrected(study.scene)
        yield CORRECTED, replace(study, experiments=data)
    if with_all_free is not None:
        yield ALL_FREE, with_all_free


def _fits_result(title: str, fits: dict[str, "Fit"]) -> CommandResult:
    """Fits by name as a result: the first one's report and picture, a table of all."""
    text = "\n".join([str(fits[RAW]), "", *_fits_table(fits), ""])
    heads = (
        "fit",
        "law",
        "parameter",
        "value",
        "standard_error",
        "rms_m_per_s",
        "rank",
    )
    rows = [
        [
            name,
            type(x.law).__name__,
            parameter,
            x.value[i],
            x.standard_error[i],
            x.rms,
            x.rank,
        ]
        for name, x in fits.items()
        for i, parameter in enumerate(x.names)
    ]
    picture = ji.plot.fit(fits[RAW], None, title)
    return CommandResult(
        title, {"fits": dict(fits)}, picture, _plain_table(heads, rows), text
    )


def _with_track(
    result: CommandResult, study: Study, command: options.FitCommand
) -> CommandResult:
    """The result, and the impacts, warnings and picture of the track that the shots are
    from.
    """
    if study.track is None:
        return result
    if result.text is None:
        text = str(result.data)
    else:
        text = result.text
    found = {"impacts": study.track.impacts, "warnings": study.track.warnings}
    data = as_data(result.data) | {"track": found}
    place = command.picture()
    picture = {place.with_stem(f"{place.stem}-track"): study.track.plot(study.title)}
    return result._replace(data=data, text=f"{study.track}\n\n{text}", more=picture)


def _plain_table(heads: Iterable[str], rows: Sequence[Sequence[Any]]) -> Table:
    """A table of plain columns, without formats and notes."""
    return Table([Column(name) for name in heads], rows)


def _fit_every_law(command: options.FitCommand, steps: Steps) -> CommandResult:
    """`jimpact fit --law all`: fits of every law to the study's shots; the picture has
    the best.
    """
    study = impact_study(command.study)
    if study.experiments is None:
        raise ValueError(NO_DATA)
    fits = _laws_fitted(study, steps, starts=command.starts, seed=command.seed)
    best = fits.best
    picture = ji.plot.fit(best.fit, None, f"{study.title}: {best.name}")
    result = CommandResult(study.title, fits, picture, fits.table)
    return _with_track(result, study, command)


def _laws_fitted(study: Study, steps: Steps, **chosen: int | None) -> "LawFits":
    """Fits of every law to the study's shots, also with e as a function of the speed.

    `chosen`: starts and seed in the place of the study's; None: the study's.
    """
    assert study.experiments is not None  # the callers have seen to it
    values = {key: x for key, x in study.parameters.items() if key != "restitution"}
    searches = {key: x for key, x in study.options.items() if key in ("starts", "seed")}
    friction = [name for name in study.free if name in FRICTION_PARAMETERS]

    def done(name: str, fit: "Fit") -> None:
        """Report a law that is fitted as a step of the command."""
        steps(_fit_in_words(name, fit))

    return ji.fit_laws(
        study.scene,
        study.experiments,
        free=friction,
        speed=True,
        done=done,
        **(values | searches | without_none(chosen)),
    )


def _per_contact(study: Study) -> tuple[Study, Study | None]:
    """The study with e and k of LZB as arrays (m,), and the same with every entry free.

    In the first one, entries that were one number have one label and stay equal. The
    second one is None if the law is not LZB, has other free parameters, or is all free
    already.
    """
    law = study.law
    contacts = study.scene.contacts
    fields = ("restitution", "stiffness")
    if (
        not isinstance(law, ji.LZB)
        or contacts < 2
        or not set(study.free) <= set(fields)
    ):
        return study, None
    groups = {}  # labels (m,): 0 fixed, entries of one label are one free value
    for name in fields:
        # the study's choice: True or False, a mask (m,), or labels (m,)
        value = getattr(law, name)
        choice = np.asarray(study.free.get(name, False))
        one_each = np.arange(1, contacts + 1) if np.ndim(value) else 1
        if choice.dtype == bool:
            labels = np.where(choice, one_each, 0)
        else:
            labels = choice
        groups[name] = np.broadcast_to(labels, (contacts,))
        law = with_parameter(law, name, jnp.broadcast_to(value, (contacts,)))
    study = replace(study, law=law, free=groups)
    if len(np.unique(groups["restitution"])) == contacts and groups["stiffness"].all():
        return study, None
    return study, replace(study, free=dict.fromkeys(fields, True))


def _fits_table(fits: dict[str, "Fit"]) -> list[str]:
    """Lines of a table with a row for each parameter of each fit, and the rank with all
    free.
    """
    rows = []
    for name, fit in fits.items():
        if name == CORRECTED:
            data = "corrected"
        else:
            data = RAW
        if fit.experiments is not None:
            rms = f"{fit.rms:.4f}"
        else:
            rms = f"{fit.rms:.4g}"
        of_fit = [type(fit.law).__name__, data, rms, f"{fit.rank} of {len(fit.names)}"]
        for i, parameter in enumerate(fit.names):
            rows.append(
                [*of_fit[:2], parameter, _value_with_error(fit, i), *of_fit[2:]]
            )
            of_fit = [""] * 4  # in the first row only
    speeds = all(fit.experiments is not None for fit in fits.values())
    heads = [
        "law",
        "data",
        "parameter",
        "value",
        "rms [m/s]" if speeds else "rms",
        "rank",
    ]
    lines = str(_plain_table(heads, rows)).splitlines()
    if ALL_FREE in fits:
        fit = fits[ALL_FREE]
        names = ", ".join(fit.names)
        lines.append(f"With {names} free the rank is {fit.rank} of {len(fit.names)}.")
        lines += fit.identifiability
    return lines


def _fit_in_words(name: str, fit: "Fit") -> str:
    """Fitted values with standard errors, and the rms of the residuals, in one line."""
    values = ", ".join(
        f"{x} {_value_with_error(fit, i)}" for i, x in enumerate(fit.names)
    )
    if fit.experiments is None:
        unit = ""
    else:
        unit = " m/s"
    return f"{name}: {values}, rms {fit.rms:.4g}{unit}"


def _value_with_error(fit: "Fit", i: int) -> str:
    """Fitted value i with its standard error, or a word why it has none."""
    error = fit.standard_error[i]
    if not fit.determined[i]:
        spread = "(not determined)"
    elif fit.at_bound[i]:
        spread = "(bound)"
    elif np.isnan(error):
        spread = "± unknown"
    else:
        spread = f"± {error:.2g}"
    return f"{fit.value[i]:.5g} {spread}"


# --------------------------------------------------------------------------------------
# compare


def compare(command: options.CompareCommand, steps: Steps) -> CommandResult:
    """`jimpact compare`: outcomes of every law on one impact; with --fit fitted laws,
    too.
    """
    study, before, measured = _impact_of(command)
    laws, left_out = registered_laws(study.parameters)
    with waiting("comparing laws", steps.patience):
        result = ji.compare(study.scene, before, laws)
    steps(f"{len(laws)} laws compared")
    result = replace(result, left_out=left_out, measured=measured)
    if command.fit and study.experiments is not None:
        fits = _laws_fitted(study, steps)
    else:
        fits = None
    values = ", ".join(f"{key} = {value}" for key, value in study.parameters.items())
    lines = [
        str(result),
        *([] if fits is None else ["", "Fitted to all shots:", str(fits), ""]),
        f"Parameters: {values}.",
        (
            "T+/T-: kinetic energy after over before. Time: a compiled call, with its "
            "checks."
        ),
    ]
    data = {"velocity": before, "laws": result, "fits": fits, "left_out": left_out}
    picture = ji.plot.comparison(result, measured, study.title, study.velocities)
    return CommandResult(
        _titled(study, before), data, picture, result.table, "\n".join(lines)
    )


# --------------------------------------------------------------------------------------
# montecarlo


def montecarlo(command: options.MonteCarloCommand, steps: Steps) -> CommandResult:
    """`jimpact montecarlo`: impacts with random gaps, velocities and parameters of the
    law.
    """
    study = impact_study(command.study)
    if not study.monte_carlo:
        raise ValueError(
            f"the study '{command.study}' must have a [monte_carlo] table."
        )
    chosen = {"samples": command.samples, "key": command.seed, "folder": command.folder}
    result = ji.monte_carlo(
        **study.monte_carlo | without_none(chosen),
        executor=command.executor,
        keep_samples=command.keep_samples,
        progress=steps.patience,
    )
    steps(f"{result.samples:,} samples")
    picture = ji.plot.monte_carlo(result, study.title)
    return CommandResult(study.title, result, picture, result.table)


# --------------------------------------------------------------------------------------
# chart

QUICK = "\nThis is the quick look; --full computes everything."
QUICK_METHODS = ("time", "verlet", "impulse_euler")
QUICK_LAWS = ("moreau", "binary")


def chart(command: options.ChartCommand, steps: Steps) -> CommandResult:
    """`jimpact chart`: speed against accuracy of methods and laws on one impact."""
    from jimpact.methods.chart import shared_parameters
    from jimpact.methods.contenders import CONTENDERS

    study, before, _ = _impact_of(command)
    law = _lzb(study)
    laws, _ = registered_laws(shared_parameters(law), QUICK_LAWS)
    quick = [name for name in QUICK_METHODS if CONTENDERS[name].supports(law) is None]
    result = ji.work_precision(
        law,
        study.scene,
        before,
        command.methods or (None if command.full else quick),
        laws=None if command.full else laws,
        batch=command.batch,
        repeats=command.repeats,
        gradients=command.full,
        durations=command.full,
        progress=steps.patience,
    )
    picture = ji.plot.work_precision(result, study.title)
    text = str(result) + ("" if command.full or command.methods else QUICK)
    return CommandResult(_titled(study, before), result, picture, result.table, text)


def _lzb(study: Study) -> "ji.LZB":
    """The study's law, or LZB with the study's values of its parameters (restitution:
    1).
    """
    if isinstance(study.law, ji.LZB):
        return study.law
    values = {"restitution": 1.0} | study.parameters
    return ji.LZB(
        **{key: values[key] for key in ji.REGISTRY["lzb"].parameters if key in values}
    )


# --------------------------------------------------------------------------------------
# stability

# of a run; ten times more would only wait longer for those that do not end
MAX_STEPS = 5_000
QUICK_RESOLUTION = 7
FULL_RESOLUTION = 9
FULL_SAMPLES = 300
TITLE = "LZB, three equal Hertz balls, e = 0.9 (triangles), one axis changed at a time"


def stability(command: options.StabilityCommand, steps: Steps) -> CommandResult:
    """`jimpact stability`: map of methods over single axes; --full: over pairs of axes,
    too.
    """
    if not command.full:  # three balls: one program for each method
        from jimpact.methods.stability import default_axes

        axes = default_axes(QUICK_RESOLUTION).items()
        size: dict[str, Any] = {
            "axes": {name: x for name, x in axes if name != "balls"}
        }
    else:
        size = {
            "resolution": FULL_RESOLUTION,
            "slices": "pairs",
            "samples": FULL_SAMPLES,
        }
    result = ji.stability_map(
        command.methods or None, **size, max_steps=MAX_STEPS, progress=steps.patience
    )
    path = command.picture()
    pairs = {}
    for name in result.methods if command.full else ():
        file = path.with_name(f"{path.stem}-{name.replace('_', '-')}{path.suffix}")
        pairs[file] = ji.plot.stability_pairs(result, name)
    text = str(result) + ("" if command.full else QUICK)
    picture = ji.plot.stability_map(result, TITLE)
    return CommandResult("", result, picture, result.table, text, pairs)


# --------------------------------------------------------------------------------------
# advise

# that `ji.advise` takes
_ADVISE_PARAMETERS = (
    "restitution",
    "stiffness",
    "exponent",
    "friction",
    "tangential_stiffness",
)
# these would change the outcome
_ADVISE_REFUSED = ("tangential_restitution", "initial_energy")


# Contacts without friction of which neither is left out: the law compares both already.
# Ten times more: chains of ten balls are modelled in full where three contacts suffice.
PAIR_OF_CONTACTS = 2


def advise(command: options.AdviseCommand, steps: Steps) -> CommandResult:
    """`jimpact advise`: the simplest law, and scene, that suffice for an impact."""
    study, before, _ = _impact_of(command)
    result = ji.advise(
        study.scene,
        before,
        command.tolerance,
        stiffness_range=command.stiffness_range,
        samples=command.samples,
        seed=command.seed,
        progress=steps.patience,
        **_advise_parameters(study),
    )
    picture = ji.plot.advice(result, study.title, study.velocities)
    text = str(result)
    data = result.to_dict()
    scene = study.scene
    if scene.contacts > PAIR_OF_CONTACTS or scene.tangents is not None:
        enough = ji.simplest_scene(result.law, scene, before, command.tolerance)
        text = f"{text}\n\n{enough}"
        data["simplest_scene"] = enough.to_dict()
    return CommandResult(_titled(study, before), data, picture, result.table, text)


def _advise_parameters(study: Study) -> dict[str, Any]:
    """The study's parameters that `ji.advise` takes; a ValueError for others that
    matter.
    """
    rheology = study.parameters.get("rheology", "bistiffness")
    if rheology != "bistiffness":
        raise ValueError(
            f"the study must have bistiffness contacts, but has rheology {rheology!r}: "
            f"only the compliant law handles viscous contacts."
        )
    for key in _ADVISE_REFUSED:
        if np.any(study.parameters.get(key, 0.0)):
            raise ValueError(
                f"the study must not have `{key}`, but has {study.parameters[key]}: "
                f"`jimpact advise` compares laws without it."
            )
    return {
        key: value
        for key, value in study.parameters.items()
        if key in _ADVISE_PARAMETERS
    }


# --------------------------------------------------------------------------------------
# simulate


def simulate(command: options.SimulateCommand, steps: Steps) -> CommandResult:
    """`jimpact simulate`: a whole motion; drawn and printed as far as it goes if it
    fails.
    """
    study = motion_study(command.study)
    system = study.system
    title = study.title
    motion = jax.block_until_ready(
        study.run(t_end=command.t_end, samples=command.samples, progress=steps.patience)
    )
    steps("motion computed")
    more: dict[Path, Any] = {}
    if command.portrait is not None:
        # from 0
        if command.coordinate is None:
            which = None
        else:
            which = command.coordinate - 1
        more[command.portrait] = ji.plot.phase_portrait(
            motion, which, title, system=system
        )
    if command.gif is not None:
        more[command.gif] = partial(
            ji.plot.animation,
            system,
            motion,
            title=title,
            progress=steps.patience,
            speed=command.speed,
        )
    heads = ("time [s]", *system.body.names, *system.body.velocity_names)
    table = _plain_table(
        heads, np.column_stack([motion.time, motion.q, motion.velocity]).tolist()
    )
    picture = ji.plot.motion(motion, title, system=system)
    return CommandResult(
        title, motion, picture, table, more=more, failure=_failure_of(motion)
    )


def _failure_of(motion: "Motion") -> str:
    """Message of the failure of a motion, '' if its status is none."""
    try:
        ji.raise_on_failure(motion)
    except RuntimeError as error:
        return str(error)
    return ""


_COMMANDS: dict[str, Callable[[Any, Steps], CommandResult]] = {
    command.__name__: command
    for command in (fit, compare, montecarlo, chart, stability, advise, simulate)
}
