"""What commands have in common: exit codes, pictures, what is printed."""

import sys
from importlib import import_module
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np

from jimpact.cli import Command, DrawingCommand, ShotCommand
from jimpact.study import Study

if TYPE_CHECKING:
    from matplotlib.figure import Figure  # which takes long to import

KINDS = (".png", ".pdf", ".svg")
DPI = 150
BAD_INPUT, FAILURE = 2, 1  # exit codes
INTERRUPTED = 130  # what a shell expects of a program that ctrl-C ended


class Answer(NamedTuple):
    """What a command found: for --json, for people, as pictures; what went wrong all the same."""

    title: str
    data: dict[str, Any]
    text: str
    pictures: dict[Path, "Figure"]
    failure: str = ""


def run(given: Command) -> int:
    """The exit code of a command: 0; wrong input 2, a method or law that fails 1, ctrl-C 130."""
    jax.config.update("jax_enable_x64", True)  # the program's choice; the library sets none
    try:
        answer = import_module(f"jimpact.commands.{given.name}").run(given)
        for path, figure in answer.pictures.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            figure.savefig(path, dpi=DPI)
    except KeyboardInterrupt as stop:
        return _refuse(given, str(stop) or "stopped.", INTERRUPTED)
    except (ValueError, TypeError, OSError, ImportError) as error:
        return _refuse(given, str(error), BAD_INPUT)
    except RuntimeError as error:
        return _refuse(given, str(error), FAILURE)
    pictures = [str(path) for path in answer.pictures]
    if given.json:
        about = {"title": answer.title, "pictures": pictures} if pictures else {}
        print(dumps(about | answer.data, indent=2))
    else:
        lines = [answer.title, answer.text, *(f"Picture: {path}" for path in pictures)]
        print("\n".join(line for line in lines if line))
    return _refuse(given, answer.failure, FAILURE) if answer.failure else 0


def _refuse(given: Command, reason: str, code: int) -> int:
    print(f"jimpact {given.name}: {reason}", file=sys.stderr)
    return code


def picture_path(given: DrawingCommand) -> Path:
    """The file --out, or the command's own in the directory --out."""
    return checked(given.out if given.out.suffix else given.out / f"jimpact-{given.name}.png")


def checked(path: Path, option: str = "--out") -> Path:
    """The path of a picture; other endings are refused."""
    if path.suffix not in KINDS:
        raise ValueError(
            f"{option} must end in .png, .pdf or .svg or be a directory, but is '{path}'."
        )
    return path


def velocities(study: Study, given: ShotCommand) -> tuple[np.ndarray, np.ndarray | None]:
    """Velocities before the impact, and after it where they were measured."""
    if given.velocity is not None:
        return np.asarray(given.velocity, float), None
    data = study.experiments
    if data is None:
        raise ValueError("--velocity must be given, because the study has no [data].")
    if not 1 <= given.shot <= len(data.shots):
        raise ValueError(f"--shot must lie in [1, {len(data.shots)}], but is {given.shot}.")
    return np.asarray(data.pre[given.shot - 1]), np.asarray(data.post[given.shot - 1])


def titled(study: Study, before: np.ndarray) -> str:
    """The first line of what is printed of one impact."""
    return f"{study.title}: v- = ({', '.join(f'{x:g}' for x in before)}) m/s"
