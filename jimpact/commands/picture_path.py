"""Where a command writes its picture."""

from pathlib import Path

KINDS = (".png", ".pdf", ".svg")


def picture_path(out: Path, name: str) -> Path:
    """The file `out`, or `name` in the directory `out`; other endings are refused."""
    path = out if out.suffix else out / name
    if path.suffix not in KINDS:
        raise ValueError(f"--out must end in .png, .pdf or .svg or be a directory, but is '{out}'.")
    return path
