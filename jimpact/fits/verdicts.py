"""Warnings that decide whether to trust a fit: defects of the data, of the law, of the search."""

import numpy as np

from jimpact.files.records import listed
from jimpact.fits.adequacy import adequacy, reproduced
from jimpact.fits.defects import find_defects
from jimpact.fits.experiments import kept_by_corrections
from jimpact.fits.findings import Finding
from jimpact.fits.matrix_fit import boundary, encloses
from jimpact.fits.problem import FitProblem
from jimpact.fits.search import SearchResult
from jimpact.fits.solve import EXACT
from jimpact.fits.uncertainty import Uncertainty
from jimpact.laws.kinematic import RestitutionMatrix
from jimpact.status import STATUS

# Minima whose sums of squares differ by less than this many noise variances fit equally well:
# the difference is what moving by one standard error costs.
EQUALLY_GOOD = 1.0


def fit_warnings(
    problem: FitProblem, solution: SearchResult, errors: Uncertainty, robust: bool
) -> list[Finding]:
    """All warnings, those about the data first."""
    data, found = problem.experiments, [Finding(line, _left_out(line)) for line in problem.left_out]
    if data is not None:
        contacts = data.largest_scene(problem.scene).contacts
        stored = float(np.sum(np.broadcast_to(np.asarray(problem.law.stored), contacts)))
        found += find_defects(data, problem.scene, stored)
        found += map(Finding, _unknown_corrections(problem))
    lines: list[str] = []
    if solution.stuck:
        lines.append(
            "The minimum is a kink of the law (the sequence of contacts changes there, or its "
            "derivatives are wrong): standard errors do not hold."
        )
    if not solution.converged:
        lines.append(
            "The fit has not converged: allow more `max_steps`, `starts` or time (`limit`)."
        )
    if data is not None:
        lines += _statuses(solution.status, data.shots)
        lines += _matrix(problem, solution, contacts)
    lines += _not_finite(problem, solution)
    found += map(Finding, lines)
    found += adequacy(problem, solution, errors.rank, robust)
    return [*found, *map(Finding, _of_parameters(problem, solution, errors))]


def _of_parameters(problem: FitProblem, solution: SearchResult, errors: Uncertainty) -> list[str]:
    """What the data do not tell about the parameters and their errors."""
    lines, data = [], problem.experiments
    if data is not None and problem.sigma is None and len(set(data.units)) > 1:
        lines.append(
            "Without sigma, velocities in rad/s weigh like those in m/s of the same kinetic energy."
        )
    names = problem.names
    for i in np.flatnonzero(solution.at_bound):
        _, high = problem.domains[i]
        end, towards = ("upper", "smaller") if solution.value[i] >= high else ("lower", "larger")
        lines.append(
            f"{names[i]} is at its {end} bound {solution.value[i]:g}; its standard error only "
            f"holds towards {towards} values."
        )
    if errors.rank < len(names):
        lines.append(
            f"The data determine {errors.rank} of {len(names)} parameters (rank "
            f"{errors.rank} of {len(names)}); the values given are one choice of many."
        )
    elif (several := _equally_good(problem, solution, errors)) > 1:
        lines.append(f"{several} different minima fit equally well: see the starts.")
    if errors.degrees_of_freedom < 1 and problem.sigma is None:
        lines.append(
            "No degree of freedom is left to estimate the noise: errors are unknown without sigma."
        )
    elif problem.sigma is None and reproduced(problem, solution.minima[0]):
        lines.append(
            "The data are reproduced to the last digit and do not show their noise: errors are "
            "unknown without `sigma` or `resolution`."
        )
    if problem.precision == "float32":
        lines.append(
            "Computed in float32: values are good to about 1e-3, and the rank is judged coarsely. "
            'jax.config.update("jax_enable_x64", True) gives float64.'
        )
    return lines


def _left_out(line: str) -> str:
    """Of a line on shots that are left out, what a quoted value has to say."""
    return f"{line.removeprefix('Left out: ').split(' (')[0]} are left out"


def _unknown_corrections(problem: FitProblem) -> list[str]:
    """Shots with `sigma_pre` and a correction that is not that of momentum."""
    data = problem.experiments
    assert data is not None
    if data.sigma_pre is None:
        return []
    kept = kept_by_corrections(data, problem.scene)
    unknown = [data.shots[k] for k, one in enumerate(kept) if data.lost[k] and one is None]
    if not unknown:
        return []
    return [
        f"The fit weighs shots {listed(unknown)} as if they were not corrected: they have "
        "`lost_freedom`, but do not conserve momentum, so that the errors that `sigma_pre` leaves "
        "in them are unknown; chi^2 and standard errors are approximate."
    ]


def _statuses(status: np.ndarray, shots: tuple[str, ...]) -> list[str]:
    """The shots in which the fitted law fails."""
    lines = []
    for code in np.unique(status):
        if STATUS[code].failure:
            labels = [shots[k] for k in np.flatnonzero(status == code)]
            lines.append(
                f"The fitted law fails in {len(labels)} of {len(shots)} shots ({listed(labels)}): "
                f"{STATUS[code].name}, {STATUS[code].message}."
            )
    return lines


def _not_finite(problem: FitProblem, solution: SearchResult) -> list[str]:
    """Which values of a user's own function are not finite at the fitted parameters."""
    if problem.experiments is not None:
        return []
    lost = np.flatnonzero(np.isfinite(problem.measured) & ~np.isfinite(solution.predicted))
    if not len(lost):
        return []
    which, values = listed([str(i + 1) for i in lost]), problem.values - len(problem.priors)
    return [
        f"The fitted law fails in {len(lost)} of {values} values ({which}): they are not "
        "finite there and count as large errors."
    ]


def _matrix(problem: FitProblem, solution: SearchResult, contacts: int) -> list[str]:
    """Which conditions on a restitution matrix it ends at, or that it need not fulfil them."""
    edges = boundary(problem.residuals.region, solution.entries)
    if edges:
        return [
            f"The matrix ends at the edge of the admissible ones ({'; '.join(edges)}): the errors "
            "hold for the side inside."
        ]
    if isinstance(problem.law, RestitutionMatrix) and not encloses(problem.law, contacts):
        return [
            "Nothing keeps this matrix consistent for other approach velocities than the measured: "
            "the conditions are for (m, m) matrices with admissible=True."
        ]
    return []


def _equally_good(problem: FitProblem, solution: SearchResult, errors: Uncertainty) -> int:
    """How many minima fit as well as the best."""
    noise = errors.noise / problem.size if np.isfinite(errors.noise) else 0.0
    more = max(EQUALLY_GOOD * noise**2, EXACT[problem.precision])
    return sum(end.squares <= solution.minima[0].squares + more for end in solution.minima)
