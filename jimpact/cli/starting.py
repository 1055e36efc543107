"""Commands that compute nothing: begin a user's own study, print laws."""

import json
import shutil
import textwrap
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jimpact.cli.study_file import STUDY, located

WIDEST = 100  # characters; longer lines of prose are hard to read
TEMPLATES = Path(__file__).with_name("new_studies.toml")
# of the tables of a study that name one
FILES = {"data": "shots.csv", "track": "track.csv"}


def begin(kind: str, folder: Path, like: str | None = None) -> list[Path]:
    """Write a study, its data and a notebook into a folder; returns the paths of the
    files.

    `kind` is the command that they are for, `like` the bundled study to copy (None: its
    default).

    Raises:
        FileNotFoundError: there is no such study. ValueError: a file exists already.
    """
    templates = tomllib.loads(TEMPLATES.read_text(encoding="utf-8"))
    template = templates[kind]
    path = located(Path(like or template["study"]), template["table"])
    study = path.read_text(encoding="utf-8")
    texts = {folder / STUDY: templates["head"].format(kind=kind) + "\n" + study}
    tables = tomllib.loads(study)
    for table, name in FILES.items():  # data files are copied under new names
        data = tables.get(table, {}).get("file")
        if data is not None:
            texts[folder / STUDY] = texts[folder / STUDY].replace(data, name)
            texts[folder / name] = (path.parent / data).read_text(encoding="utf-8")
    cells = [templates["setup"], *template["cells"]]
    texts[folder / "study.ipynb"] = _notebook(template["title"], cells)
    existing = [str(path) for path in texts if path.exists()]  # is never replaced
    if existing:
        other = folder.with_name(f"{folder.name}_2")
        raise ValueError(
            f"These files exist already: {', '.join(existing)}. Name another folder: "
            f"`jimpact new {kind} {other}`."
        )
    folder.mkdir(parents=True, exist_ok=True)
    for path, text in texts.items():
        path.write_text(text, encoding="utf-8")
    return list(texts)


def _notebook(title: str, sources: list[str]) -> str:
    """A Jupyter notebook with these cells of code, as text."""
    head = f"# {title}\n\nReads `study.toml` in this folder. Run the cells in order."
    cells: list[dict[str, Any]] = [
        {"id": "head", "cell_type": "markdown", "metadata": {}, "source": head}
    ]
    for i, code in enumerate(sources):
        cell = {"id": f"cell-{i}", "cell_type": "code", "metadata": {}, "source": code}
        cells.append(cell | {"execution_count": None, "outputs": []})
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    notebook = {"cells": cells, "metadata": {"kernelspec": kernel}}
    return json.dumps(notebook | {"nbformat": 4, "nbformat_minor": 5}, indent=1) + "\n"


def laws_as_text(rows: Mapping[str, Mapping[str, Any]]) -> str:
    """Text on laws one below the other, in lines that fit the terminal, from rows by
    name.
    """
    width = min(shutil.get_terminal_size((80, 24)).columns, WIDEST)
    lines = []
    for name, row in rows.items():
        lines += textwrap.wrap(
            f"{name}: {row['summary']}", width, subsequent_indent=" " * 14
        )
        friction = "friction" in row["parameters"]
        entries = {
            "parameters": ", ".join(row["parameters"]),
            "in Python": row["in_python"],
            "friction": "yes, planar and in space" if friction else "no",
            "right when": row["right_when"],
            "fails when": row["fails_when"],
            "source": row["source"],
        }
        for head, text in entries.items():
            lines += textwrap.wrap(
                text, width, initial_indent=f"  {head:<12}", subsequent_indent=" " * 14
            )
        lines.append("")
    return "\n".join(lines).rstrip()
