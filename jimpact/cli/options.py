"""Options of `jimpact fit`, `compare`, `montecarlo` and so on, one class for each
command.

`check` refuses options that are wrong before JAX is imported, that is at once.
"""

import dataclasses
import json
import os
import tempfile
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import tyro

from jimpact.tools.checks import check_executor
from jimpact.tools.records import Column, Table

EVERY_LAW = "all"  # in the place of a law's name
PICTURES = (".png", ".pdf", ".svg")


def _option(metavar: str, constructor: Any = None) -> Any:
    """Option of tyro: its value's name in --help, without a default, and its type if
    not plain.
    """
    return tyro.conf.arg(
        metavar=metavar, constructor=constructor, help_behavior_hint=""
    )


StudyFile = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="[STUDY.toml]")]
Flag = Annotated[bool, tyro.conf.arg(help_behavior_hint="")]
File = Annotated[Path | None, _option("FILE", Path)]
Folder = Annotated[Path | None, _option("DIR", Path)]
Count = Annotated[int | None, _option("N", int)]
Seconds = Annotated[float | None, _option("SECONDS", float)]
Name = Annotated[str | None, _option("NAME", str)]
Names = Annotated[tuple[str, ...], _option("NAME ...")]


@dataclasses.dataclass(frozen=True)
class Command:
    """Options of every command."""

    light: ClassVar[bool] = False  # True: it computes nothing, and has a method `run`

    json: Flag = False
    """Print JSON instead of text."""
    csv: Flag = False
    """Print the table as CSV instead of text."""
    # Compile anew, as with an empty environment variable JIMPACT_CACHE. Else compiled
    # programs are stored in the folder that it names, or in the user's cache folder.
    no_cache: Flag = False

    @classmethod
    def name(cls) -> str:
        """The command's name."""
        return cls.__name__.removesuffix("Command").lower()

    def check(self) -> None:
        """Raise a ValueError or OSError for options or a study that are wrong."""
        if self.json and self.csv:
            raise ValueError("--json and --csv must not both be given.")

    def remains(self) -> str:
        """Sentence: the files that remain of an interrupted command."""
        if os.environ.get("JAX_COMPILATION_CACHE_DIR"):
            return "Only compiled programs are stored."
        return "No result is stored."


@dataclasses.dataclass(frozen=True)
class DrawingCommand(Command):
    """Options of a command that draws a picture."""

    # Picture (.png, .pdf, .svg), or a folder for it; default: ./jimpact-<command>.png,
    # with a study named ./jimpact-<command>-<study>.png. A message says if a file is
    # replaced.
    out: Annotated[Path, _option("FILE", Path)] = Path()

    def check(self) -> None:
        """Check the options of every command, and the path of the picture."""
        super().check()
        self.picture()

    def picture(self) -> Path:
        """The file --out, or the command's own in the directory --out, named after the
        study.
        """
        if self.out.suffix and not self.out.is_dir():
            return checked_file("--out", self.out, PICTURES, " or be a directory")
        named = "-".join(x for x in ("jimpact", self.name(), self.subject()) if x)
        return checked_file("--out", self.out / f"{named}.png", PICTURES)

    def subject(self) -> str:
        """Name of the study, to name the file of its picture; '' for the default
        study.
        """
        study, default = (getattr(x, "study", None) for x in (self, type(self)))
        if study is None or study == default:
            return ""
        return study.absolute().stem


def checked_file(
    option: str, path: Path, endings: tuple[str, ...], or_else: str = ""
) -> Path:
    """The path of an option, checked: one of the endings, a place where a file can be
    written.

    `or_else` adds to the error of the ending another thing that the option may be.
    """
    if path.suffix not in endings:
        *others, last = endings
        if others:
            listed = f"{', '.join(others)} or {last}"
        else:
            listed = last
        raise ValueError(f"{option} must end in {listed}{or_else}, but is '{path}'.")
    if path.is_dir():
        raise ValueError(f"{option} must be a file, but '{path}' is a directory.")
    check_writable(option, path.parent)
    if path.exists() and not os.access(path, os.W_OK):
        raise ValueError(f"{option} must be writable, but '{path}' is not.")
    return path


def check_writable(option: str, folder: Path) -> None:
    """Raise a ValueError if no file can be made in a folder, or above it if it is
    missing.
    """
    above = next(x for x in (folder, *folder.absolute().parents) if x.exists())
    try:
        with tempfile.TemporaryFile(dir=above):
            pass
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise ValueError(
            f"{option} must be writable, but '{folder}' is not: {reason}."
        ) from None


@dataclasses.dataclass(frozen=True)
class ShotCommand(DrawingCommand):
    """Options of a command about one impact."""

    study: StudyFile = Path("three_balls.toml")
    """Study file, or the name of a bundled one; its [data] may be missing."""
    velocity: Annotated[tuple[float, ...], _option("V ...")] = ()
    """Velocities before the impact [m/s, rad/s], one a coordinate; default: of a
    measured shot.
    """
    shot: int = 1
    """Which measured shot, counted from 1."""


@dataclasses.dataclass(frozen=True)
class FitCommand(DrawingCommand):
    """Fit a law to measured velocities or a motion: what the study says, nothing
    else.
    """

    # Study file, its folder, or a bundled one (three_balls.toml, ball_track.toml,
    # tossed_cube.toml, ...); also the study of a motion with [data].
    study: StudyFile = Path("three_balls.toml")
    law: Name = None
    """Law in the place of the study's (see `jimpact laws`), or all: every law, side by
    side.
    """
    method: Annotated[str | None, _option("METHOD", str)] = None
    """levenberg-marquardt (the default), adam, sgd or lbfgs, in the place of the
    study's.
    """
    starts: Count = None
    """Number of starts; default: the study's, or 12 and more around the best."""
    seed: Count = None
    """Seed of the random starts."""
    all_free: Flag = False
    """Fit a second time, every restitution and stiffness ratio free."""
    limit: Seconds = None
    """Seconds after which no further step is begun; default: no limit."""

    def check(self) -> None:
        """Check the picture, and that the limit is positive."""
        super().check()
        if self.limit is not None and not self.limit > 0:
            raise ValueError(f"--limit must be > 0 seconds, but is {self.limit:g}.")


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
    executor: str = "threads"
    """threads (one a core), serial, devices, dask (here), or the address of a Dask
    scheduler.
    """
    folder: Folder = None
    """Folder of finished chunks; the same command again continues from there."""
    keep_samples: Flag = False
    """Keep the raw samples in the folder, too."""

    def check(self) -> None:
        """Check the picture, the executor, and that the folder is writable."""
        super().check()
        check_executor(self.executor)
        if self.folder is not None:
            check_writable("--folder", self.folder)

    def remains(self) -> str:
        """Sentence: the folder of finished chunks, or that none is stored."""
        if self.folder is None:
            return "No result is stored, because --folder is not set."
        return (
            f"Finished chunks are in '{self.folder}': the same command continues "
            f"from there."
        )


@dataclasses.dataclass(frozen=True)
class ChartCommand(ShotCommand):
    """Speed against accuracy: methods of integration and laws on one scene."""

    methods: Names = ()
    """Methods by name; default: three that compile soon, as far as the scene allows."""
    full: Flag = False
    """Every method and algebraic law, durations, and the errors of the derivatives."""
    batch: int = 256
    """Impacts solved together."""
    repeats: int = 5
    """Timings of each entry, taken in turn."""


@dataclasses.dataclass(frozen=True)
class StabilityCommand(DrawingCommand):
    """Map where methods of integration are right, wrong, gain energy or do not end."""

    methods: Names = ()
    """Methods by name; default: time, rk4, verlet and impulse_euler."""
    full: Flag = False
    """Also other numbers of balls, all pairs of axes, 300 points between them."""


@dataclasses.dataclass(frozen=True)
class AdviseCommand(ShotCommand):
    """The simplest law and method that a scene needs, with the evidence."""

    tolerance: float = 1e-2
    """Model error that is allowed: energy norm of the error of v+ over that of v-."""
    stiffness_range: Annotated[tuple[float, float] | None, _option("LOW HIGH")] = None
    """Factors by which each stiffness may be off; default: 0.1 10, or 1 1 if the study
    has it.
    """
    samples: int = 128
    """Draws of the unknown stiffnesses."""
    seed: int = 0
    """Seed of the draws."""


@dataclasses.dataclass(frozen=True)
class SimulateCommand(DrawingCommand):
    """A whole motion: flights, impacts by any law, persistent contact, energy
    ledger.
    """

    # Study with a [motion], its folder, or a bundled one (cradle_motion.toml,
    # shaken_dimer.toml, rocking_block.toml, tossed_brick.toml, discs_in_a_box.toml).
    study: StudyFile = Path("cradle_motion.toml")
    t_end: Annotated[float | None, _option("TIME", float)] = None
    """End of the motion [s]; default: the study's."""
    samples: Count = None
    """Instants in the record; default: the study's, or 201."""
    gif: File = None
    """Animation (.gif) in real time, short motions slower."""
    speed: Annotated[float | None, _option("S", float)] = None
    """Seconds of the motion in a second of the animation."""
    portrait: File = None
    """Phase portrait (.png, .pdf, .svg)."""
    coordinate: Count = None
    """Coordinate of the phase portrait, counted from 1; default: one that moves."""

    def check(self) -> None:
        """Check the picture, the other pictures and the speed."""
        super().check()
        if self.portrait is not None:
            checked_file("--portrait", self.portrait, PICTURES)
        if self.gif is not None:
            checked_file("--gif", self.gif, (".gif",))
        if self.speed is not None and not self.speed > 0:
            raise ValueError(f"--speed must be positive, but is {self.speed:g}.")
        if self.portrait == self.picture():
            raise ValueError(
                f"--portrait and --out must be two files, but are both "
                f"'{self.portrait}'."
            )


@dataclasses.dataclass(frozen=True)
class LawsCommand(Command):
    """List the laws: what they assume, when they are right and when they fail."""

    module: Annotated[str | None, _option("FILE", str)] = None
    """File (.py) or module that registers further laws, see `ji.register`."""
    bibtex: Flag = False
    """Print the references as BibTeX."""

    light: ClassVar[bool] = True

    def run(self) -> int:
        """Print the table of laws as text, JSON, CSV or BibTeX."""
        from jimpact.cli.starting import laws_as_text
        from jimpact.cli.study_file import import_laws
        from jimpact.laws import REGISTRY

        if self.module is not None:
            import_laws(self.module, Path())
        keys = (
            "parameters",
            "in_python",
            "summary",
            "right_when",
            "fails_when",
            "source",
        )
        rows = {
            name: {key: getattr(row, key) for key in keys}
            for name, row in REGISTRY.items()
        }
        if self.json:
            text = json.dumps(rows, indent=2)
        elif self.bibtex:
            text = "\n\n".join(dict.fromkeys(row.bibtex for row in REGISTRY.values()))
        elif self.csv:
            lines = [
                [x, " ".join(row.pop("parameters")), *row.values()]
                for x, row in rows.items()
            ]
            text = Table([Column(key) for key in ("law", *keys)], lines).to_csv()
        else:
            text = laws_as_text(rows)
        print(text)
        return 0


@dataclasses.dataclass(frozen=True)
class NewCommand:
    """Begin a study of your own: a commented study file, data, a notebook."""

    kind: Annotated[
        Literal["fit", "compare", "montecarlo", "simulate"], tyro.conf.Positional
    ]
    """What the study is for."""
    folder: Annotated[Path | None, tyro.conf.Positional, _option("[DIR]")] = None
    """Where it is written; default: ./my_<kind>. Files that exist are never
    replaced.
    """

    like: Annotated[str | None, _option("STUDY.toml", str)] = None
    """Bundled study to begin with (rocking_block.toml, ball_track.toml: a ball that a
    camera saw, ...); default: three balls, or a cradle.
    """

    light: ClassVar[bool] = True

    @classmethod
    def name(cls) -> str:
        """The command's name."""
        return "new"

    def check(self) -> None:
        """No option is refused beforehand."""

    def remains(self) -> str:
        """Files are written whole or not at all."""
        return ""

    def run(self) -> int:
        """Write the files of a new study, and print their names and the next
        command.
        """
        from jimpact.cli.starting import begin

        folder = self.folder or Path(f"my_{self.kind}")
        for path in begin(self.kind, folder, self.like):
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
