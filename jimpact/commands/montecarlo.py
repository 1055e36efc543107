"""`jimpact montecarlo`: random gaps, the statistics of the outcome, a picture."""

import sys
import warnings
from pathlib import Path
from typing import Any

from jimpact.commands.output import Answer, command, save_picture
from jimpact.montecarlo.executors import DaskExecutor, Executor, as_executor
from jimpact.montecarlo.results import MonteCarlo
from jimpact.montecarlo.running import monte_carlo
from jimpact.study import Study, read_study


@command("montecarlo")
def run(study: Path, picture: Path, **options: Any) -> Answer:
    """Sample with the options of `MonteCarloCommand`."""
    given = read_study(study)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        found = monte_carlo(**_arguments(given, study, **options))
    for warning in caught:
        print(f"jimpact montecarlo: {warning.message}", file=sys.stderr)
    _draw(found, given.title, picture)
    data = {"title": given.title} | found.to_dict() | {"picture": str(picture)}
    return Answer(data, lambda: print(f"{given.title}\n{found}\n\nPicture: {picture}"))


def _arguments(
    study: Study,
    path: Path,
    samples: int | None,
    seed: int | None,
    executor: str,
    scheduler: str | None,
    folder: Path | None,
    keep_samples: bool,
) -> dict[str, Any]:
    """Of `monte_carlo`: those of the study, or in their place those of the command line."""
    if not study.monte_carlo:
        raise ValueError(f"the study '{path}' must have a [monte_carlo] table.")
    given = {"samples": samples, "key": seed}
    chosen = {name: value for name, value in given.items() if value is not None}
    own = {"folder": folder, "keep_samples": keep_samples}
    return study.monte_carlo | chosen | own | {"executor": _executor(executor, scheduler)}


def _executor(name: str, scheduler: str | None) -> Executor:
    if scheduler is None:
        return as_executor(name)
    if name != "dask":
        raise ValueError(f"--scheduler needs --executor dask, but it is {name}.")
    return DaskExecutor(scheduler)


def _draw(found: MonteCarlo, title: str, path: Path) -> None:
    from jimpact import plot  # matplotlib, late

    save_picture(plot.monte_carlo(found, title), path)
