"""What the command line does without JAX: begin a user's own study, print laws."""

import json
import shutil
import textwrap
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from jimpact.files.study_file import STUDY, located

WIDEST = 100  # characters; longer lines of prose are hard to read


class Template(NamedTuple):
    """What a user's own study begins with: a bundled study, and the cells of a notebook."""

    study: str
    table: str  # by which studies of this kind are recognized
    title: str
    cells: tuple[str, ...]


_SETUP = """\
import jax

jax.config.update("jax_enable_x64", True)  # double precision; jimpact never sets it itself
# stores what is compiled, so that the next session starts sooner:
# jax.config.update("jax_compilation_cache_dir", "/home/me/.cache/jax")

import jimpact as ji
"""
_READ = """\
study = ji.read_study("study.toml")
study.scene, study.law"""
TEMPLATES = {
    "fit": Template(
        "three_balls.toml",
        "[scene]",
        "Fit a law to measured velocities",
        (
            _READ,
            "fit = study.run()\nprint(fit)  # values, errors, what the data do not determine",
            "ji.plot.fit(fit, title=study.title)",
            "fit.law  # the law itself: use it in `ji.impact`, differentiate it",
        ),
    ),
    "compare": Template(
        "three_balls.toml",
        "[scene]",
        "Every law on one impact",
        (
            _READ,
            "shot = study.experiments.pre[0]  # velocities before the impact [m/s]\n"
            "comparison = ji.compare(study.scene, shot, **study.parameters)\nprint(comparison)",
            "ji.plot.comparison(comparison, study.experiments.post[0], study.title)",
        ),
    ),
    "montecarlo": Template(
        "three_balls_gaps.toml",
        "[monte_carlo]",
        "Velocities after an impact whose gaps are random",
        (
            _READ,
            "result = ji.monte_carlo(**study.monte_carlo)\nprint(result)",
            "ji.plot.monte_carlo(result, study.title)",
        ),
    ),
    "simulate": Template(
        "cradle_motion.toml",
        "[system]",
        "A whole motion",
        (
            'study = ji.read_study("study.toml")\nstudy.law',
            "motion = study.run()\nji.raise_on_failure(motion)\nprint(motion)",
            "ji.plot.motion(motion, study.title, system=study.system)",
        ),
    ),
}
_HEAD = """\
# A study of your own: change the numbers, then run
#     jimpact {kind} study.toml
# Every key carries its unit. All keys: `help(jimpact.read_study)`.
"""
DATA = "shots.csv"


def begin(kind: str, folder: Path, like: str | None = None) -> list[Path]:
    """Write study, data and notebook, as in the study `like`; returns the files.

    Raises:
        FileNotFoundError: there is no such study. ValueError: a file exists already.
    """
    template = TEMPLATES[kind]
    path = located(Path(like or template.study), template.table)
    study = path.read_text(encoding="utf-8")
    data = tomllib.loads(study).get("data", {}).get("file")
    texts = {folder / STUDY: _HEAD.format(kind=kind) + "\n" + study}
    if data is not None:
        texts[folder / STUDY] = texts[folder / STUDY].replace(data, DATA)
        texts[folder / DATA] = (path.parent / data).read_text(encoding="utf-8")
    texts[folder / "study.ipynb"] = _notebook(template)
    existing = [str(path) for path in texts if path.exists()]
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


def _notebook(template: Template) -> str:
    """A Jupyter notebook, as text."""
    head = f"# {template.title}\n\nReads `study.toml` in this folder. Run the cells in order."
    cells: list[dict[str, Any]] = [
        {"id": "head", "cell_type": "markdown", "metadata": {}, "source": head}
    ]
    for i, code in enumerate((_SETUP.strip(), *template.cells)):
        cell = {"id": f"cell-{i}", "cell_type": "code", "metadata": {}, "source": code}
        cells.append(cell | {"execution_count": None, "outputs": []})
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    notebook = {"cells": cells, "metadata": {"kernelspec": kernel}}
    return json.dumps(notebook | {"nbformat": 4, "nbformat_minor": 5}, indent=1) + "\n"


def laws_as_text(rows: Mapping[str, Mapping[str, Any]]) -> str:
    """Laws one below the other, in lines that fit the terminal."""
    width = min(shutil.get_terminal_size((80, 24)).columns, WIDEST)
    lines = []
    for name, row in rows.items():
        lines += textwrap.wrap(f"{name}: {row['summary']}", width, subsequent_indent=" " * 14)
        friction = "friction" in row["parameters"]
        entries = {
            "parameters": ", ".join(row["parameters"]),
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
