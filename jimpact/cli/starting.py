"""What the command line does without JAX: begin a study of one's own, list the laws."""

import csv
import io
import json
import shutil
import textwrap
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jimpact.files.study_file import STUDY, located

WIDEST = 100  # characters; longer lines of text are hard to read


class Start(NamedTuple):
    """What a study of one's own begins with: a bundled study, cells of a notebook."""

    study: str
    table: str  # which studies of this kind have
    title: str
    cells: tuple[str, ...]


_SETUP = """\
import jax

jax.config.update("jax_enable_x64", True)  # double precision; jimpact never sets it itself
# keeps what is compiled, so that it need not be compiled again tomorrow:
# jax.config.update("jax_compilation_cache_dir", "/home/me/.cache/jax")

import jimpact as ji
"""
_READ = """\
study = ji.read_study("study.toml")
study.scene, study.law"""
STARTS = {
    "fit": Start(
        "three_balls.toml",
        "[scene]",
        "Fit a law to measured velocities",
        (
            _READ,
            "found = study.run()\nprint(found)  # values, errors, what the data cannot tell",
            "ji.plot.fit(found, title=study.title)",
            "found.law  # the law itself: use it in `ji.impact`, differentiate it",
        ),
    ),
    "compare": Start(
        "three_balls.toml",
        "[scene]",
        "Every law on one impact",
        (
            _READ,
            "shot = study.experiments.pre[0]  # velocities before the impact [m/s]\n"
            "found = ji.compare(study.scene, shot, **study.parameters)\nprint(found)",
            "ji.plot.comparison(found, study.experiments.post[0], study.title)",
        ),
    ),
    "montecarlo": Start(
        "three_balls_gaps.toml",
        "[monte_carlo]",
        "Velocities after an impact whose gaps are random",
        (
            _READ,
            "found = ji.monte_carlo(**study.monte_carlo)\nprint(found)",
            "ji.plot.monte_carlo(found, study.title)",
        ),
    ),
    "simulate": Start(
        "cradle_motion.toml",
        "[system]",
        "A whole motion",
        (
            'study = ji.read_motion_study("study.toml")\nstudy.law',
            "motion = study.run()\nji.raise_on_failed_motion(motion)\nprint(motion)",
            "ji.plot.motion(motion, study.title, system=study.system)",
        ),
    ),
}
_HEAD = """\
# A study of your own: change the numbers, then run
#     jimpact {kind} study.toml
# Every key carries its unit. All keys: `help(jimpact.read_study)`, of a motion
# `help(jimpact.read_motion_study)`.
"""
DATA = "shots.csv"


def begin(kind: str, folder: Path, like: str | None = None) -> list[Path]:
    """Write study, data and notebook, as in the study `like`; the files.

    Raises:
        FileNotFoundError: there is no such study. ValueError: a file is there already.
    """
    start = STARTS[kind]
    path = located(Path(like or start.study), start.table)
    study = path.read_text(encoding="utf-8")
    data = tomllib.loads(study).get("data", {}).get("file")
    texts = {folder / STUDY: _HEAD.format(kind=kind) + "\n" + study}
    if data is not None:
        texts[folder / STUDY] = texts[folder / STUDY].replace(data, DATA)
        texts[folder / DATA] = (path.parent / data).read_text(encoding="utf-8")
    texts[folder / "study.ipynb"] = _notebook(start)
    there = [str(path) for path in texts if path.exists()]
    if there:
        raise ValueError(f"{', '.join(there)} must not exist, but is there: take another folder.")
    folder.mkdir(parents=True, exist_ok=True)
    for path, text in texts.items():
        path.write_text(text, encoding="utf-8")
    return list(texts)


def _notebook(start: Start) -> str:
    """A Jupyter notebook, as text."""
    about = f"# {start.title}\n\nIt reads `study.toml` beside it. Run the cells from top to bottom."
    cells: list[dict[str, Any]] = [
        {"id": "about", "cell_type": "markdown", "metadata": {}, "source": about}
    ]
    for i, code in enumerate((_SETUP.strip(), *start.cells)):
        cell = {"id": f"cell-{i}", "cell_type": "code", "metadata": {}, "source": code}
        cells.append(cell | {"execution_count": None, "outputs": []})
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    about_all = {"cells": cells, "metadata": {"kernelspec": kernel}}
    return json.dumps(about_all | {"nbformat": 4, "nbformat_minor": 5}, indent=1) + "\n"


def laws_as_text(rows: Mapping[str, Mapping[str, Any]]) -> str:
    """Laws one below the other, in lines that fit the terminal."""
    width = min(shutil.get_terminal_size((80, 24)).columns, WIDEST)
    lines = []
    for name, row in rows.items():
        lines += textwrap.wrap(f"{name}: {row['summary']}", width, subsequent_indent=" " * 14)
        friction = "friction" in row["parameters"]
        told = {
            "parameters": ", ".join(row["parameters"]),
            "friction": "yes, planar and in space" if friction else "no",
            "right when": row["right_when"],
            "fails when": row["fails_when"],
            "source": row["source"],
        }
        for head, text in told.items():
            lines += textwrap.wrap(
                text, width, initial_indent=f"  {head:<12}", subsequent_indent=" " * 14
            )
        lines.append("")
    return "\n".join(lines).rstrip()


def as_csv(heads: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Lines of a CSV file, the names of the columns first; None is an empty cell."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(heads)
    writer.writerows(rows)
    return text.getvalue().rstrip("\n")
