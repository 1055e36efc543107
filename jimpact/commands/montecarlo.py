"""`jimpact montecarlo`: random gaps, the statistics of the outcome, a picture."""

import sys
import warnings
from typing import Any

from jimpact import plot
from jimpact.cli import MonteCarloCommand
from jimpact.commands.output import Answer, picture_path
from jimpact.montecarlo.executors import DaskExecutor
from jimpact.montecarlo.running import monte_carlo
from jimpact.study import Study, read_study


def run(given: MonteCarloCommand) -> Answer:
    """Sample."""
    path = picture_path(given)
    study = read_study(given.study)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        found = monte_carlo(**_arguments(study, given))
    for warning in caught:
        print(f"jimpact montecarlo: {warning.message}", file=sys.stderr)
    picture = plot.monte_carlo(found, study.title)
    return Answer(study.title, found.to_dict(), str(found), {path: picture})


def _arguments(study: Study, given: MonteCarloCommand) -> dict[str, Any]:
    """Of `monte_carlo`: those of the study, or in their place those of the command line."""
    if not study.monte_carlo:
        raise ValueError(f"the study '{given.study}' must have a [monte_carlo] table.")
    executor: Any = given.executor
    if given.scheduler is not None:
        if executor != "dask":
            raise ValueError(f"--scheduler needs --executor dask, but it is {executor}.")
        executor = DaskExecutor(given.scheduler)
    options = {"samples": given.samples, "key": given.seed, "folder": given.folder}
    chosen = {name: value for name, value in options.items() if value is not None}
    return study.monte_carlo | chosen | {"executor": executor, "keep_samples": given.keep_samples}
