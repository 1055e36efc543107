"""What commands have in common: pictures, tables, the exit code of an interrupted one."""

from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.measure import Measurement
from rich.table import Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure  # which takes long to import

KINDS = (".png", ".pdf", ".svg")
DPI = 150
WIDEST = 10_000  # columns that a table may ask for
INTERRUPTED = 130  # what a shell expects of a program that ctrl-C ended


def picture_path(out: Path, name: str, option: str = "--out") -> Path:
    """The file `out`, or `name` in the directory `out`; other endings are refused."""
    path = out if out.suffix else out / name
    if path.suffix not in KINDS:
        raise ValueError(
            f"{option} must end in .png, .pdf or .svg or be a directory, but is '{out}'."
        )
    return path


def save_picture(figure: "Figure", path: Path) -> None:
    """Write it; missing folders are made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=DPI)


def console_for(*tables: Table) -> Console:
    """As wide as the terminal, or as the tables: a number cut short tells nothing."""
    console = Console(highlight=False)
    options = console.options.update(max_width=WIDEST)
    needed = [Measurement.get(console, options, table).maximum for table in tables]
    return Console(highlight=False, width=max(console.width, *needed))
