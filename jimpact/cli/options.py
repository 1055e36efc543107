"""Options of `jimpact fit`, `compare`, `montecarlo` and so on, a class a command.

`check` refuses what is wrong before JAX is imported, that is at once.
"""

import dataclasses
import json
import os
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import tyro

from jimpact._checks import check_choice
from jimpact.cli import starting
from jimpact.files import study_file

Method = Literal["levenberg-marquardt", "adam", "sgd", "lbfgs"]
EVERY_LAW = "all"  # in the place of a law's name
PICTURES = (".png", ".pdf", ".svg")


def _own(shown: str, kind: Any = None) -> Any:
    """How an option is shown whose text tells its default, and what makes its value of text."""
    return tyro.conf.arg(metavar=shown, constructor=kind, help_behavior_hint="")


StudyFile = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="[STUDY.toml]")]
Flag = Annotated[bool, tyro.conf.arg(help_behavior_hint="")]
File = Annotated[Path | None, _own("FILE", Path)]
Count = Annotated[int | None, _own("N", int)]


@dataclasses.dataclass(frozen=True)
class Command:
    """Options of every command."""

    light: ClassVar[bool] = False  # whether it has a `run` of its own

    json: Flag = False
    """Print JSON instead of text."""
    csv: Flag = False
    """Print the table as CSV instead of text."""
    # Compile anew. Else compiled programs are kept whole in the user's cache folder, or in the
    # folder that the environment variable JIMPACT_CACHE names (empty: nowhere).
    no_cache: Flag = False

    @classmethod
    def name(cls) -> str:
        """The command's name."""
        return cls.__name__.removesuffix("Command").lower()

    def check(self) -> None:
        """Raise a ValueError or OSError for options or a study that are wrong."""
        if self.json and self.csv:
            raise ValueError("--json and --csv must not both be given.")

    def kept(self) -> str:
        """What is left of an interrupted command."""
        cached = os.environ.get("JAX_COMPILATION_CACHE_DIR") and not self.no_cache
        return "Compiled programs are kept, nothing else." if cached else "Nothing is kept."


@dataclasses.dataclass(frozen=True)
class DrawingCommand(Command):
    """Options of a command that draws a picture."""

    # Picture (.png, .pdf, .svg), or a folder for it; default: ./jimpact-<command>.png,
    # with a study named ./jimpact-<command>-<study>.png. What is there is replaced, and told.
    out: Annotated[Path, _own("FILE", Path)] = Path()

    def check(self) -> None:
        """Also the picture's kind."""
        super().check()
        self.picture()

    def picture(self) -> Path:
        """The file --out, or the command's own in the directory --out, named after the study."""
        if self.out.suffix:
            return checked_picture(self.out)
        study, default = (getattr(x, "study", None) for x in (self, type(self)))
        named = "" if study is None or study == default else f"-{study.absolute().stem}"
        return self.out / f"jimpact-{self.name()}{named}.png"


def checked_picture(path: Path, option: str = "--out") -> Path:
    """The path of a picture; other endings are refused."""
    if path.suffix not in PICTURES:
        raise ValueError(
            f"{option} must end in .png, .pdf or .svg or be a directory, but is '{path}'."
        )
    return path


def check_methods(methods: tuple[str, ...], known: tuple[str, ...]) -> None:
    """Raise a ValueError unless all methods are known."""
    for method in methods:
        check_choice("methods", method, known)


@dataclasses.dataclass(frozen=True)
class ShotCommand(DrawingCommand):
    """Options of a command about one impact."""

    study: StudyFile = Path("three_balls.toml")
    """Study file, or the name of a bundled one; its [data] may be missing."""
    velocity: Annotated[tuple[float, ...], _own("V ...")] = ()
    """Velocities before the impact [m/s], one a body; default: those of a measured shot."""
    shot: int = 1
    """Which measured shot, counted from 1."""

    def check(self) -> None:
        """Also the study, and whether it has velocities."""
        super().check()
        _, shots = study_file.check_study(self.study)
        if self.velocity:
            return
        if not shots:
            raise ValueError("--velocity must be given, because the study has no [data].")
        if not 1 <= self.shot <= shots:
            raise ValueError(f"--shot must lie in [1, {shots}], but is {self.shot}.")


@dataclasses.dataclass(frozen=True)
class FitCommand(DrawingCommand):
    """Fit a law to measured velocities, forces, times or a motion."""

    # Study file, its folder, or a bundled one (three_balls.toml, air_track.toml, tossed_cube.toml,
    # bead_column.toml, ...); also the study of a motion with [data].
    study: StudyFile = Path("three_balls.toml")
    law: Annotated[str | None, _own("NAME", str)] = None
    """Law in the place of the study's (see `jimpact laws`), or all: every law, side by side."""
    method: Annotated[Method | None, _own("METHOD", Method)] = None
    """levenberg-marquardt, adam, sgd or lbfgs; default: the study's, or the first."""
    starts: Count = None
    """Number of starts; default: the study's, or 8."""
    seed: Count = None
    """Seed of the random starts."""
    report: File = None
    """One page (.html) with all of the fit: intervals, profiles, pictures, versions."""

    def check(self) -> None:
        """Also the study, which must have data, and the report's kind."""
        super().check()
        if self.report is not None and self.report.suffix not in (".html", ".htm"):
            raise ValueError(f"--report must end in .html, but is '{self.report}'.")
        law = None if self.law == EVERY_LAW else self.law
        if study_file.is_motion(self.study):
            if self.method is not None or self.law == EVERY_LAW:
                raise ValueError("--method and --law all must be left out for a motion.")
            study = study_file.check_motion_study(self.study, law)
        else:
            study, shots = study_file.check_study(self.study, law)
            if self.law == EVERY_LAW and not shots:
                raise ValueError("--law all must be left out where no shots are fitted.")
        if not study.fitted:
            raise ValueError(study_file.NO_DATA)


@dataclasses.dataclass(frozen=True)
class CompareCommand(ShotCommand):
    """Every law on one scene, side by side: velocities, energy, audit, time."""

    fit: Flag = False
    """Fit every law to the data too, as `jimpact fit --law all` does."""


@dataclasses.dataclass(frozen=True)
class MonteCarloCommand(DrawingCommand):
    """Velocities after an impact with random gaps: statistics, histograms, outcomes."""

    study: StudyFile = Path("three_balls_gaps.toml")
    """Study file with a [monte_carlo] table, or the name of a bundled one."""
    samples: Count = None
    """Number of samples; default: the study's, or 100000."""
    seed: Count = None
    """Seed; default: the study's, or 0."""
    executor: Literal["serial", "devices", "dask"] = "serial"
    """Where: one chunk after another, all devices of the process, or Dask workers."""
    scheduler: Annotated[str | None, _own("ADDRESS", str)] = None
    """Address of a Dask scheduler; default: workers on this machine."""
    folder: Annotated[Path | None, _own("DIR", Path)] = None
    """Where finished chunks are kept; the same command again continues there."""
    keep_samples: Flag = False
    """Keep the raw samples in the folder, too."""

    def check(self) -> None:
        """Also the study, which must say what is random."""
        super().check()
        study, _ = study_file.check_study(self.study)
        if "monte_carlo" not in study.tables:
            raise ValueError(f"the study '{self.study}' must have a [monte_carlo] table.")
        if self.scheduler is not None and self.executor != "dask":
            raise ValueError(f"--scheduler needs --executor dask, but it is {self.executor}.")

    def kept(self) -> str:
        """Finished chunks are."""
        if self.folder is None:
            return "Nothing is kept, because no --folder was given."
        return f"Finished chunks are in '{self.folder}': the same command continues from there."


@dataclasses.dataclass(frozen=True)
class ChartCommand(ShotCommand):
    """Speed against accuracy: methods of integration and laws on one scene."""

    methods: Annotated[tuple[str, ...], _own("NAME ...")] = ()
    """Methods by name; default: three that compile soon, as far as the scene allows."""
    full: Flag = False
    """Every method and algebraic law, durations, and the errors of the derivatives."""
    batch: int = 256
    """Impacts solved side by side."""
    repeats: int = 5
    """Timings of each entry, taken in turn."""

    def check(self) -> None:
        """Also the methods' names."""
        super().check()
        check_methods(self.methods, tuple(study_file.names()["methods"]))


@dataclasses.dataclass(frozen=True)
class StabilityCommand(DrawingCommand):
    """Where methods of integration are right, wrong, gain energy or do not end."""

    methods: Annotated[tuple[str, ...], _own("NAME ...")] = ()
    """Methods by name; default: default, rk4, verlet and impulse_euler."""
    full: Flag = False
    """Also other numbers of balls, all pairs of axes, 300 points between them."""

    def check(self) -> None:
        """Also the methods' names."""
        super().check()
        batched = [name for name, jax in study_file.names()["methods"].items() if jax]
        check_methods(self.methods, ("default", *batched))


@dataclasses.dataclass(frozen=True)
class AdviseCommand(ShotCommand):
    """The simplest law and method that a scene needs, with the evidence."""

    tolerance: float = 1e-2
    """Model error that is allowed, over the largest velocity before."""
    stiffness_range: Annotated[tuple[float, float] | None, _own("LOW HIGH")] = None
    """Factors by which each stiffness may be off; default 0.1 10."""
    samples: int = 128
    """Draws of the unknown stiffnesses."""
    seed: int = 0
    """Seed of the draws."""


@dataclasses.dataclass(frozen=True)
class SimulateCommand(DrawingCommand):
    """A whole motion: flights, impacts by any law, persistent contact, energy ledger."""

    # Study with a [motion], its folder, or a bundled one (cradle_motion.toml, shaken_dimer.toml,
    # rocking_block.toml, tossed_brick.toml, discs_in_a_box.toml).
    study: StudyFile = Path("cradle_motion.toml")
    t_end: Annotated[float | None, _own("TIME", float)] = None
    """End of the motion [s]; default: the study's."""
    samples: Count = None
    """Instants in the record; default: the study's, or 201."""
    gif: File = None
    """Animation (.gif), one frame a sample."""
    portrait: File = None
    """Phase portrait (.png, .pdf, .svg)."""
    coordinate: Count = None
    """Coordinate of the phase portrait, counted from 1; default: one that moves."""

    def check(self) -> None:
        """Also the other pictures and the study."""
        super().check()
        if self.portrait is not None:
            checked_picture(self.portrait, "--portrait")
        if self.gif is not None and self.gif.suffix != ".gif":
            raise ValueError(f"--gif must end in .gif, but is '{self.gif}'.")
        if self.portrait == (path := self.picture()):
            raise ValueError(f"--portrait and --out must be two files, but are both '{path}'.")
        study_file.check_motion_study(self.study)


@dataclasses.dataclass(frozen=True)
class LawsCommand(Command):
    """List the laws: what they say, when they are right and when they fail."""

    module: Annotated[str | None, _own("FILE", str)] = None
    """File (.py) or module that registers further laws, see `ji.register`."""
    bibtex: Flag = False
    """Print the references as BibTeX."""

    light: ClassVar[bool] = True

    def run(self) -> int:
        """Print them; JAX is imported only for a module."""
        if self.module is not None:
            from jimpact.cli.study import import_laws

            import_laws(self.module, Path())
        laws = study_file.declared_laws()
        keys = ("parameters", "summary", "right_when", "fails_when", "source")
        rows = {name: {key: row[key] for key in keys} for name, row in laws.items()}
        if self.json:
            text = json.dumps(rows, indent=2)
        elif self.bibtex:
            text = "\n\n".join(dict.fromkeys(row["bibtex"] for row in laws.values()))
        elif self.csv:
            lines = [[x, " ".join(row.pop("parameters")), *row.values()] for x, row in rows.items()]
            text = starting.as_csv(["law", *keys], lines)
        else:
            text = starting.laws_as_text(rows)
        print(text)
        return 0


@dataclasses.dataclass(frozen=True)
class NewCommand:
    """Begin a study of your own: a commented study file, data, a notebook."""

    kind: Annotated[Literal["fit", "compare", "montecarlo", "simulate"], tyro.conf.Positional]
    """What the study is for."""
    folder: Annotated[Path | None, tyro.conf.Positional, _own("[DIR]")] = None
    """Where it is written; default: ./my_<kind>. What is there is never replaced."""

    like: Annotated[str | None, _own("STUDY.toml", str)] = None
    """A study to begin with, as rocking_block.toml; default: three balls, or a cradle."""

    light: ClassVar[bool] = True

    @classmethod
    def name(cls) -> str:
        """The command's name."""
        return "new"

    def check(self) -> None:
        """Nothing to refuse beforehand."""

    def kept(self) -> str:
        """Files are written whole or not at all."""
        return ""

    def run(self) -> int:
        """Write the files, and say what comes next."""
        folder = self.folder or Path(f"my_{self.kind}")
        for path in starting.begin(self.kind, folder, self.like):
            print(f"written: {path}")
        print(f"Next: jimpact {self.kind} {folder}")
        return 0


COMMANDS: tuple[type[Command] | type[NewCommand], ...] = (
    FitCommand,
    CompareCommand,
    MonteCarloCommand,
    ChartCommand,
    StabilityCommand,
    AdviseCommand,
    SimulateCommand,
    LawsCommand,
    NewCommand,
)
