"""Tolerance of the impacts of a run: its error may be a small part of the standard
errors.

The samples of the first chunk are computed at the law's default tolerance and at a
coarser one. The differences of each velocity x, and of `(x - mean)^2`, are the errors
of mean and variance that the coarser one makes. An error is its estimate and two
standard errors of this, in standard deviations of the quantity: times the root of the
number of samples it is in standard errors.
"""

from dataclasses import replace

import numpy as np

from jimpact.core.law import open_tolerance
from jimpact.montecarlo.samples import Run
from jimpact.montecarlo.statistics import AS_THE_LAW, FAILURE, Chunk, Tolerance

# Part of a standard error that the tolerance may cost. Ten times more: as large as what
# chance does; ten times less: all runs are as fine as one impact.
SHARE = 0.1
# Multiples of the default tolerance that are tried. Beyond these steps end at events,
# and no fewer of them are needed.
COARSER = (1000.0, 100.0, 10.0)
# Chunks from which on it is looked for. Ten times more: half a minute at the default
# tolerance; ten times fewer: looking takes longer than it saves.
WORTH_LOOKING = 8


def first_chunk(run: Run, recorded: Tolerance | None) -> Chunk:
    """Statistics of chunk 0 at the tolerance of the run: the recorded one, or a coarse
    one.

    That is the coarsest of `COARSER` times the law's default whose error in means and
    variances is at most `SHARE` of their standard errors; the default itself for short
    runs.
    """
    if recorded is not None:
        return run(run.task(0, recorded))
    with run.flags():
        default = open_tolerance(*run.sample(0))
    task = run.task(0, AS_THE_LAW if default is None else Tolerance(default))
    fine = run.outcomes(task)
    # laws with a tolerance of their own, short runs and raw samples keep that of the
    # law
    if default is None or run.chunks < WORTH_LOOKING or run.keep_samples:
        return run.reduced(task, fine)
    for times in COARSER:
        coarser = replace(task, tolerance=Tolerance(times * default))
        coarse = run.outcomes(coarser)
        error = added_error(fine, coarse)
        if error * np.sqrt(run.samples) <= SHARE:
            found = replace(coarser, tolerance=Tolerance(times * default, error))
            return run.reduced(found, coarse)
    return run.reduced(task, fine)


def added_error(fine: Chunk, coarse: Chunk) -> float:
    """Largest error of a mean or a variance of v+ between two tolerances of the same
    samples.

    Equation: for each velocity x, and for `y = (x - mean)^2`, with d the coarse minus
    the fine
    values: `(|mean(d)| + 2 std(d) / sqrt(N)) / std`, std that of the fine values.
    Infinite if statuses differ.

    >>> import numpy as np
    >>> from jimpact.montecarlo.tolerance import added_error
    >>> x = {
    ...     "status": np.zeros(4, int),
    ...     "velocity": np.array([[-3.0], [-1.0], [1.0], [3.0]]),
    ... }
    >>> round(added_error(x, x | {"velocity": x["velocity"] + 0.1}), 3)  # 0.1 / root(5)
    0.045
    """
    if not np.array_equal(fine["status"], coarse["status"]):
        return np.inf
    used = ~FAILURE[fine["status"]]
    velocities = (chunk["velocity"][used] for chunk in (fine, coarse))
    x, y = (velocity.astype(float) for velocity in velocities)
    x_square = (x - x.mean(axis=0)) ** 2
    y_square = (y - y.mean(axis=0)) ** 2
    pairs = [(x, y), (x_square, y_square)]
    errors = []
    for exact, other in pairs:
        difference = other - exact
        count = max(len(x), 1)
        spread = difference.std(axis=0) / np.sqrt(count)
        error = np.abs(difference.mean(axis=0)) + 2 * spread
        size = exact.std(axis=0)
        relative = error / np.where(size > 0, size, 1e-300)
        errors.append(np.where(error > 0, relative, 0.0))
    return float(np.max(errors))
