"""What a user must know before trusting a fit, in words."""

import jax.numpy as jnp
import numpy as np

from jimpact.defects import data_defects
from jimpact.experiments import Experiments
from jimpact.fits.matrix_fit import boundary, encloses
from jimpact.fits.multistart import EXACT, Search
from jimpact.fits.parameters import Parameters
from jimpact.fits.problem import Problem
from jimpact.fits.uncertainty import Uncertainty
from jimpact.law import Law
from jimpact.laws.kinematic import RestitutionMatrix
from jimpact.scene import Scene
from jimpact.status import STATUS

# Minima whose sums of squares differ by less than this many noise variances fit equally well:
# the difference is what moving by one standard error costs.
EQUALLY_GOOD = 1.0

# Scatter beyond the stated sigma is worth a word above this ratio (chi^2 per degree of freedom 4).
TOO_MUCH_SCATTER = 2.0


def fit_warnings(
    law: Law,
    problem: Problem,
    parameters: Parameters,
    experiments: Experiments,
    scene: Scene | None,
    found: Search,
    spread: Uncertainty,
) -> list[str]:
    """All warnings, those about the data first."""
    stored = float(np.sum(jnp.broadcast_to(law.stored, experiments.largest_scene(scene).contacts)))
    lines = data_defects(experiments, scene, stored)
    if not found.converged:
        lines.append(
            "The fit has not converged: allow more `max_steps` or `starts` (or the minimum sits on "
            "a kink of the law, where the sequence of contacts changes)."
        )
    lines += _statuses(found.status, experiments.shots)
    names = parameters.names
    for i in np.flatnonzero(found.at_bound):
        lines.append(
            f"{names[i]} ends at its bound {found.value[i]:g}: its error holds for one side."
        )
    lines += _matrix(law, problem, experiments.largest_scene(scene), found)
    if spread.rank < len(names):
        lines.append(
            f"The data determine {spread.rank} of {len(names)} parameters (rank "
            f"{spread.rank} of {len(names)}); the values given are one choice of many."
        )
    elif (several := _equally_good(problem, found, spread)) > 1:
        lines.append(f"{several} different minima fit equally well: see the starts.")
    if spread.degrees_of_freedom < 1 and experiments.sigma is None:
        lines.append(
            "No degree of freedom is left to estimate the noise: errors are unknown without sigma."
        )
    if experiments.sigma is not None and spread.degrees_of_freedom > 0:
        chi_squared = float(problem.size) ** 2 * found.minima[0][0]
        scatter = np.sqrt(chi_squared / spread.degrees_of_freedom)
        if scatter > TOO_MUCH_SCATTER:
            lines.append(
                f"The residuals are {scatter:.1f} times what sigma allows: the law or the stated "
                "errors are wrong, and the standard errors too small."
            )
    if problem.pre.dtype == np.float32:
        lines.append(
            "Computed in float32: values are good to about 1e-3, and the rank is judged coarsely. "
            'jax.config.update("jax_enable_x64", True) gives float64.'
        )
    return lines


def _statuses(status: np.ndarray, shots: tuple[str, ...]) -> list[str]:
    lines = []
    for code in np.unique(status):
        if STATUS[code].failure:
            at = ", ".join(shots[k] for k in np.flatnonzero(status == code)[:6])
            count = int(np.sum(status == code))
            lines.append(
                f"The fitted law fails in {count} of {len(shots)} shots ({at}): "
                f"{STATUS[code].name}, {STATUS[code].message}."
            )
    return lines


def _matrix(law: Law, problem: Problem, scene: Scene, found: Search) -> list[str]:
    """Where the conditions on a restitution matrix hold it back, or are not asked for."""
    edges = boundary(problem.region, found.entries)
    if edges:
        return [
            f"The matrix ends at the edge of the admissible ones ({'; '.join(edges)}): the errors "
            "hold for the side inside."
        ]
    if isinstance(law, RestitutionMatrix) and not encloses(law, scene):
        return [
            "Nothing keeps this matrix consistent for other approach velocities than the measured: "
            "the conditions are for (m, m) matrices with admissible=True."
        ]
    return []


def _equally_good(problem: Problem, found: Search, spread: Uncertainty) -> int:
    noise = spread.noise / float(problem.size) if np.isfinite(spread.noise) else 0.0
    more = max(EQUALLY_GOOD * noise**2, EXACT[str(problem.pre.dtype)])
    return sum(cost <= found.minima[0][0] + more for cost, _, _ in found.minima)
