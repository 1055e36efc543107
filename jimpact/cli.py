"""The command line: options of `jimpact fit`, `compare`, `montecarlo` and so on.

Heavy imports wait until a command runs.
"""

import dataclasses
import json as json_module
import sys
from importlib import import_module
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import tyro

from jimpact import __version__

Method = Literal["levenberg-marquardt", "adam", "sgd", "lbfgs"]


class _Command:
    """Options of a command; `jimpact.commands.<name>` runs it, and imports what it needs."""

    name: ClassVar[str]

    def run(self) -> int:
        """The exit code."""
        return import_module(f"jimpact.commands.{self.name}").run(**vars(self))


@dataclasses.dataclass(frozen=True)
class FitCommand(_Command):
    """Fit a law to measured velocities; without a file: the bundled three balls."""

    name: ClassVar[str] = "fit"

    study: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="STUDY.toml")] = Path(
        "three_balls.toml"
    )
    """Study file, or the name of a bundled one (three_balls.toml, air_track.toml)."""
    law: str | None = None
    """Law in the place of the study's (see `jimpact laws`)."""
    method: Method | None = None
    """Solver; default: the study's, or levenberg-marquardt."""
    starts: int | None = None
    """Number of starts; default: the study's, or 8."""
    seed: int | None = None
    """Seed of the random starts."""
    out: Path = Path("jimpact-fit.png")
    """Picture (.png, .pdf, .svg), or a directory for it."""
    json: bool = False
    """Print JSON instead of tables."""


@dataclasses.dataclass(frozen=True)
class CompareCommand(_Command):
    """Every law on one scene, side by side: velocities, energy, dispersion, audit, time."""

    name: ClassVar[str] = "compare"

    study: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="STUDY.toml")] = Path(
        "three_balls.toml"
    )
    """Study file, or the name of a bundled one; its [data] may be missing."""
    velocity: tuple[float, ...] | None = None
    """Velocities before the impact [m/s], one a body; default: those of a measured shot."""
    shot: int = 1
    """Which measured shot, counted from 1."""
    fit: bool = False
    """Fit every law to the data too, with one coefficient and with one per contact."""
    out: Path = Path("jimpact-compare.png")
    """Picture (.png, .pdf, .svg), or a directory for it."""
    json: bool = False
    """Print JSON instead of tables."""


@dataclasses.dataclass(frozen=True)
class MonteCarloCommand(_Command):
    """Velocities after an impact whose gaps are random: statistics, histograms, outcome map."""

    name: ClassVar[str] = "montecarlo"

    study: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="STUDY.toml")] = Path(
        "three_balls_gaps.toml"
    )
    """Study file with a [monte_carlo] table, or the name of a bundled one."""
    samples: int | None = None
    """Number of samples; default: the study's, or 100000."""
    seed: int | None = None
    """Seed; default: the study's, or 0."""
    executor: Literal["serial", "devices", "dask"] = "serial"
    """Where: one chunk after another, all devices of the process, or Dask workers."""
    scheduler: str | None = None
    """Address of a Dask scheduler; default: workers on this machine."""
    folder: Path | None = None
    """Where finished chunks are kept; the same command again continues there."""
    keep_samples: bool = False
    """Keep the raw samples in the folder, too."""
    out: Path = Path("jimpact-montecarlo.png")
    """Picture (.png, .pdf, .svg), or a directory for it."""
    json: bool = False
    """Print JSON instead of a report."""


@dataclasses.dataclass(frozen=True)
class ChartCommand(_Command):
    """Speed against accuracy: methods of integration and laws on one scene."""

    name: ClassVar[str] = "chart"

    study: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="STUDY.toml")] = Path(
        "three_balls.toml"
    )
    """Study file, or the name of a bundled one; its [data] may be missing."""
    velocity: tuple[float, ...] | None = None
    """Velocities before the impact [m/s], one a body; default: those of a measured shot."""
    shot: int = 1
    """Which measured shot, counted from 1."""
    methods: tuple[str, ...] | None = None
    """Methods by name; default: those that the scene allows and that compile fast."""
    full: bool = False
    """The methods that compile slowly, too."""
    no_gradients: bool = False
    """Leave out the errors of the derivatives."""
    batch: int = 256
    """Impacts solved side by side."""
    repeats: int = 5
    """Timings of each entry, taken in turn."""
    out: Path = Path("jimpact-chart.png")
    """Picture (.png, .pdf, .svg), or a directory for it."""
    json: bool = False
    """Print JSON instead of tables."""


@dataclasses.dataclass(frozen=True)
class StabilityCommand(_Command):
    """Where methods of integration are right, wrong, gain energy or do not end."""

    name: ClassVar[str] = "stability"

    methods: tuple[str, ...] | None = None
    """Methods by name; default: all that run in batches."""
    full: bool = False
    """All pairs of axes and 300 points over all of them besides."""
    out: Path = Path("jimpact-stability.png")
    """Picture (.png, .pdf, .svg), or a directory for it; pairs go beside it."""
    json: bool = False
    """Print JSON instead of tables."""


@dataclasses.dataclass(frozen=True)
class AdviseCommand(_Command):
    """The simplest law and method that a scene needs, with the evidence."""

    name: ClassVar[str] = "advise"

    study: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="STUDY.toml")] = Path(
        "three_balls.toml"
    )
    """Study file, or the name of a bundled one; its [data] may be missing."""
    velocity: tuple[float, ...] | None = None
    """Velocities before the impact [m/s], one a body; default: those of a measured shot."""
    shot: int = 1
    """Which measured shot, counted from 1."""
    tolerance: float = 1e-2
    """Model error that is allowed, over the largest velocity before."""
    stiffness_range: tuple[float, float] | None = None
    """Factors by which each stiffness may be off; default 0.1 10."""
    samples: int = 128
    """Draws of the unknown stiffnesses."""
    seed: int = 0
    """Seed of the draws."""
    out: Path = Path("jimpact-advise.png")
    """Picture (.png, .pdf, .svg), or a directory for it."""
    json: bool = False
    """Print JSON instead of text."""


@dataclasses.dataclass(frozen=True)
class SimulateCommand(_Command):
    """A whole motion: flights, impacts by any law, persistent contact, energy ledger."""

    name: ClassVar[str] = "simulate"

    study: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="STUDY.toml")] = Path(
        "cradle_motion.toml"
    )
    """Study with a [motion], or a bundled one (cradle_motion.toml, shaken_dimer.toml)."""
    t_end: float | None = None
    """End of the motion [s]; default: the study's."""
    samples: int | None = None
    """Instants in the record; default: the study's, or 201."""
    gif: Path | None = None
    """Animation (.gif), one frame a sample."""
    portrait: Path | None = None
    """Phase portrait (.png, .pdf, .svg)."""
    coordinate: int = 1
    """Coordinate of the phase portrait, counted from 1."""
    out: Path = Path("jimpact-simulate.png")
    """Picture (.png, .pdf, .svg), or a directory for it."""
    json: bool = False
    """Print JSON instead of a report."""


@dataclasses.dataclass(frozen=True)
class LawsCommand:
    """List the laws: what they say, when they are right and when they fail."""

    module: str | None = None
    """File (.py) or module that registers further laws, see `ji.register`."""
    bibtex: bool = False
    """Print the references as BibTeX."""
    json: bool = False
    """Print JSON instead of a table."""

    def run(self) -> int:
        """Print the registry."""
        from rich.console import Console
        from rich.table import Table

        from jimpact.laws import REGISTRY
        from jimpact.study import import_laws

        if self.module is not None:
            try:
                import_laws(self.module, Path())
            except (ValueError, ImportError) as error:
                print(f"jimpact laws: {error}", file=sys.stderr)
                return 2
        if self.bibtex:
            print("\n\n".join(dict.fromkeys(row.bibtex for row in REGISTRY.values())))
        elif self.json:
            columns = ("parameters", "summary", "right_when", "fails_when", "source")
            rows = {name: {k: getattr(row, k) for k in columns} for name, row in REGISTRY.items()}
            print(json_module.dumps(rows, indent=2))
        else:
            table = Table()
            for title in ("law", "parameters", "says", "right when", "fails when"):
                table.add_column(title, overflow="fold")
            for name, row in REGISTRY.items():
                parameters = ", ".join(row.parameters)
                table.add_row(name, parameters, row.summary, row.right_when, row.fails_when)
            Console().print(table)
        return 0


Command = (
    Annotated[FitCommand, tyro.conf.subcommand(FitCommand.name)]
    | Annotated[CompareCommand, tyro.conf.subcommand(CompareCommand.name)]
    | Annotated[MonteCarloCommand, tyro.conf.subcommand(MonteCarloCommand.name)]
    | Annotated[ChartCommand, tyro.conf.subcommand(ChartCommand.name)]
    | Annotated[StabilityCommand, tyro.conf.subcommand(StabilityCommand.name)]
    | Annotated[AdviseCommand, tyro.conf.subcommand(AdviseCommand.name)]
    | Annotated[SimulateCommand, tyro.conf.subcommand(SimulateCommand.name)]
    | Annotated[LawsCommand, tyro.conf.subcommand("laws")]
)


def main(arguments: list[str] | None = None) -> int:
    """Entry point; exit code 2 for bad input."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments == ["--version"]:
        print(f"jimpact {__version__}")
        return 0
    command = tyro.cli(
        Command,
        prog="jimpact",
        config=(tyro.conf.FlagCreatePairsOff,),
        description="Differentiable impact laws for several simultaneous contacts. "
        "--version prints the version.",
        args=arguments,
    )
    return command.run()


if __name__ == "__main__":
    sys.exit(main())
