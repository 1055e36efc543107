"""The outcome linearized in the gaps, beside what Monte Carlo finds."""

from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from jimpact._checks import as_float_array, check_shape, check_values
from jimpact.impacts import impact
from jimpact.law import Law
from jimpact.montecarlo.results import MonteCarlo
from jimpact.scene import Scene, with_gaps
from jimpact.status import STATUS

# Linearized and sampled standard deviations that differ by more than this are reported.
AGREES = 0.2
CONSTANT = 1e-12  # a standard deviation below this, relative to the velocities, is rounding


@dataclass(frozen=True, eq=False)
class GapSensitivity:
    """The outcome at given gaps (m,) [m] and its derivatives in them; `print` gives a report.

    Attributes:
        gaps, velocity: (m,) [m], where it is linearized, and (n,) [m/s], the outcome there.
        jacobian: (n, m) [1/s], `d v+_i / d gap_j`.
        status: name of the impact's status.
        sampled: the Monte Carlo run to compare with, or None.
    """

    gaps: np.ndarray
    velocity: np.ndarray
    jacobian: np.ndarray
    status: str
    sampled: MonteCarlo | None = None

    def covariance(self, gap_covariance: Any) -> np.ndarray:
        """Linearized covariance (n, n) of the velocities, `J Sigma J^T`, of gaps with Sigma."""
        sigma = np.asarray(gap_covariance, float)
        m = len(self.gaps)
        check_shape("gap_covariance", sigma, (m, m), "a row and a column per contact")
        return self.jacobian @ sigma @ self.jacobian.T

    @property
    def explained(self) -> np.ndarray:
        """Linearized over sampled standard deviation (n,): 1 where the linearization holds."""
        if self.sampled is None:
            raise ValueError("Argument `sampled` must be given for a comparison, but is None.")
        linear = np.sqrt(np.diag(self.covariance(self.sampled.gap_covariance)))
        with np.errstate(divide="ignore", invalid="ignore"):
            return linear / self.sampled.std

    def __str__(self) -> str:
        m = len(self.gaps)
        at = ", ".join(f"{gap:g}" for gap in self.gaps)
        lines = [f"Linearized at gaps ({at}) m, status {self.status}; d v+ / d gap [1/s]:"]
        for i in range(len(self.velocity)):
            row = "".join(f"{self.jacobian[i, j]:13.5g}" for j in range(m))
            lines.append(f"v{i + 1}+ = {self.velocity[i]:10.6f} m/s: {row}")
        return "\n".join(lines + ([] if self.sampled is None else self._comparison()))

    def _comparison(self) -> list[str]:
        assert self.sampled is not None
        ratio = self.explained
        largest = np.max(np.abs([self.sampled.minimum, self.sampled.maximum]), initial=0.0)
        if np.all(self.sampled.std <= CONSTANT * largest):
            return ["The outcome does not depend on the gaps."]
        lines = ["standard deviations [m/s], linearized against sampled:"]
        for i, (std, part) in enumerate(zip(self.sampled.std, ratio)):
            lines.append(f"v{i + 1}+: {part * std:.3g} against {std:.3g}")
        if np.all(np.abs(ratio - 1) <= AGREES):
            lines.append("The outcome is nearly linear over the spread of the gaps.")
        elif not self.jacobian.any():
            lines.append(
                "The outcome does not change with small changes of the gaps, yet it varies: it "
                "jumps where the order of the collisions changes. Trust the samples."
            )
        else:
            lines.append(
                "The linearization fails over this spread: the gaps reach across a crossover or a "
                "curved part. Trust the samples."
            )
        return lines


def gap_sensitivity(
    law: Law, scene: Scene, velocity: Any, gaps: Any, sampled: MonteCarlo | None = None
) -> GapSensitivity:
    """Jacobian of the outcome in the gaps, and the linearized covariance beside Monte Carlo's.

    Equation: `J = d v+ / d gap`, `cov(v+) ~ J Sigma J^T`. It holds where the outcome is nearly
    linear over the spread of the gaps, so not across a crossover of the order of contacts; for
    laws that see gaps only in the order of collisions (Binary) J = 0, for laws that ignore the
    sizes of gaps too.

    Args:
        law, scene: as in `impact`.
        velocity: v- (n,) [m/s].
        gaps: (m,) >= 0 [m], where to linearize: often `sampled.gap_mean`.
        sampled: a run of `monte_carlo` with random gaps to compare with.

    >>> import jimpact as ji
    >>> law, balls = ji.Binary(1.0, order="earliest"), ji.chain([0.25, 1.0, 0.25])
    >>> ji.gap_sensitivity(law, balls, [1.0, 0.0, -1.0], [1e-6, 2e-6]).velocity.round(6).tolist()
    [-0.6, -0.16, 1.24]
    """
    at, v = as_float_array("gaps", gaps), as_float_array("velocity", velocity)
    check_shape("gaps", at, (scene.contacts,), "one gap per contact")
    check_values("gaps", at, low=0.0)

    def outcome(gaps: jax.Array) -> tuple[jax.Array, Any]:
        out = impact(law, with_gaps(scene, gaps), v)
        return out.velocity, (out.velocity, out.status)

    jacobian, (after, status) = jax.jacfwd(outcome, has_aux=True)(at)
    return GapSensitivity(
        gaps=np.asarray(at),
        velocity=np.asarray(after),
        jacobian=np.asarray(jacobian),
        status=STATUS[int(status)].name,
        sampled=sampled,
    )
