"""What commands have in common: where pictures go, and the exit code of an interrupted one."""

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure  # which takes long to import

KINDS = (".png", ".pdf", ".svg")
DPI = 150
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
