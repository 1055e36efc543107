"""`jimpact montecarlo`: random gaps, the statistics of the outcome, a picture."""

import json
import sys
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax

from jimpact.executors import Executor, as_executor
from jimpact.montecarlo import monte_carlo
from jimpact.sampling.results import MonteCarlo
from jimpact.study import Study, read_study

if TYPE_CHECKING:
    from jimpact.cli import MonteCarloCommand

PICTURE = "jimpact-montecarlo.png"
INTERRUPTED = 130  # what a shell expects of a program that ctrl-C ended


def run(command: "MonteCarloCommand") -> int:
    """Run the command; 2 for bad input, told in one line on stderr; 130 after ctrl-C."""
    jax.config.update("jax_enable_x64", True)  # the program's choice; the library sets nothing
    try:
        path = _picture_path(command.out)
        study = read_study(command.study)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", UserWarning)
            found = monte_carlo(**_arguments(study, command))
        _draw(found, study.title, path)
    except KeyboardInterrupt as stop:
        print(f"jimpact montecarlo: {stop or 'stopped.'}", file=sys.stderr)
        return INTERRUPTED
    except (ValueError, TypeError, OSError, ImportError) as error:
        print(f"jimpact montecarlo: {error}", file=sys.stderr)
        return 2
    except RuntimeError as error:
        print(f"jimpact montecarlo: {error}", file=sys.stderr)
        return 1
    for warning in caught:
        print(f"jimpact montecarlo: {warning.message}", file=sys.stderr)
    if command.json:
        told = {"title": study.title} | found.to_dict() | {"picture": str(path)}
        print(json.dumps(told, indent=2))
    else:
        print(f"{study.title}\n{found}\n\nPicture: {path}")
    return 0


def _arguments(study: Study, command: "MonteCarloCommand") -> dict[str, Any]:
    """Of `monte_carlo`: those of the study, or in their place those of the command line."""
    if not study.monte_carlo:
        raise ValueError(f"the study '{command.study}' must have a [monte_carlo] table.")
    given = {"samples": command.samples, "key": command.seed}
    chosen = {name: value for name, value in given.items() if value is not None}
    own = {"folder": command.folder, "keep_samples": command.keep_samples}
    return study.monte_carlo | chosen | own | {"executor": _executor(command)}


def _executor(command: "MonteCarloCommand") -> Executor:
    if command.scheduler is None:
        return as_executor(command.executor)
    if command.executor != "dask":
        raise ValueError(f"--scheduler needs --executor dask, but it is {command.executor}.")
    from jimpact.executors.dask_cluster import DaskExecutor

    return DaskExecutor(command.scheduler)


def _picture_path(out: Path) -> Path:
    path = out if out.suffix else out / PICTURE
    if path.suffix not in (".png", ".pdf", ".svg"):
        raise ValueError(f"--out must end in .png, .pdf or .svg or be a directory, but is '{out}'.")
    return path


def _draw(found: MonteCarlo, title: str, path: Path) -> None:
    from jimpact.plot_montecarlo import plot_monte_carlo  # matplotlib, late

    path.parent.mkdir(parents=True, exist_ok=True)
    plot_monte_carlo(found, title).savefig(path, dpi=150)
