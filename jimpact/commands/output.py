"""What commands have in common: exit codes, pictures, tables."""

import functools
import sys
from collections.abc import Callable
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure  # which takes long to import

KINDS = (".png", ".pdf", ".svg")
DPI = 150
WIDEST = 10_000  # columns that a table may ask for
BAD_INPUT, FAILURE = 2, 1  # exit codes
INTERRUPTED = 130  # what a shell expects of a program that ctrl-C ended


class Answer(NamedTuple):
    """What a command found: for --json, for people, and what went wrong all the same."""

    data: dict[str, Any]
    show: Callable[[], None]
    failure: str = ""


def command(name: str) -> Callable[[Callable[..., Answer]], Callable[..., int]]:
    """Make an exit code of `run(picture, **options)`: 0, and 1, 2 or 130, told on stderr.

    Wrong input is 2, a method or law that fails 1, ctrl-C 130. The options of the command line
    `out` and `json` are dealt with here; `picture` is the file to draw.
    """

    def decorate(run: Callable[..., Answer]) -> Callable[..., int]:
        @functools.wraps(run)
        def exit_code(*given: Any, out: Path, json: bool, **options: Any) -> int:
            jax.config.update("jax_enable_x64", True)  # the program's choice; the library sets none
            try:
                path = picture_path(out, f"jimpact-{name}.png")
                answer = run(*given, picture=path, **options)
            except KeyboardInterrupt as stop:
                return _refuse(name, str(stop) or "stopped.", INTERRUPTED)
            except (ValueError, TypeError, OSError, ImportError) as error:
                return _refuse(name, str(error), BAD_INPUT)
            except RuntimeError as error:
                return _refuse(name, str(error), FAILURE)
            if json:
                print(dumps(answer.data, indent=2))
            else:
                answer.show()
            return _refuse(name, answer.failure, FAILURE) if answer.failure else 0

        return exit_code

    return decorate


def _refuse(name: str, reason: str, code: int) -> int:
    print(f"jimpact {name}: {reason}", file=sys.stderr)
    return code


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
