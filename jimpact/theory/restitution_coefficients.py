"""Which unequal coefficients of restitution can create energy by Moreau's law."""

from typing import Any, NamedTuple

import numpy as np

from jimpact._checks import as_numbers
from jimpact.contact import normalized_delassus
from jimpact.scene import Scene
from jimpact.solvers.tridiagonal import as_matrix
from jimpact.theory.restitution_matrices import Copositivity, copositivity


class CoefficientAudit(NamedTuple):
    """Result of `audit_coefficients`: whether no impact by Moreau's law can gain energy.

    `energetic` is true where none gains, else with a witness pbar >= 0, normalized impulses of an
    impact that does. `spread` <= `spread_allowed` suffices for that.
    """

    energetic: Copositivity
    spread: float
    spread_allowed: float

    def __str__(self) -> str:
        """The verdict, and the sufficient condition."""
        verdict = "no impact gains energy" if self.energetic else "some impacts GAIN energy"
        holds = "holds" if self.spread <= self.spread_allowed else "does not, which decides nothing"
        return (
            f"Moreau's law with these coefficients: {verdict}\n"
            f"sufficient: {self.spread:.4g} <= {self.spread_allowed:.4g}: {holds}"
        )


def audit_coefficients(scene: Scene, restitution: Any) -> CoefficientAudit:
    """Whether Moreau's law with these e_j can gain energy in any frictionless impact.

    Equation: it changes the energy by `-pbar^T D G pbar / 2`, `D = diag(d_j)`,
    `d_j = (1 - e_j) / (1 + e_j)`, and every pbar >= 0 occurs in some impact: none gains exactly
    where the symmetric part of D G is copositive. It suffices that
    `(d_max - d_min) / (d_max + d_min) <= 1 / cond(G)`. One e for all contacts never gains.
    (Poisson's law never does up to e = 1: see `Poisson`.)

    Args:
        scene: up to 12 contacts; open ones are left out.
        restitution: e in [0, 1], scalar or (m,).

    Returns:
        `CoefficientAudit`; `print` says it in words.

    Raises:
        ValueError: restitution out of range or of a wrong size, no closed contact, too many.

    Host function, not differentiable.

    Source: own derivation from Brogliato (2016), (6.51); Leine and van de Wouw, Stability and
    Convergence of Mechanical Systems with Unilateral Constraints (2008), give such conditions.

    >>> import jimpact as ji
    >>> print(ji.theory.audit_coefficients(ji.chain([1.0, 1.0, 1.0]), [1.0, 0.0]))
    Moreau's law with these coefficients: some impacts GAIN energy
    sufficient: 1 <= 0.3333: does not, which decides nothing
    """
    e = as_numbers("restitution", restitution, low=0.0, high=1.0, contacts=scene.contacts)
    closed = np.flatnonzero(np.asarray(scene.closed))
    if not closed.size:
        raise ValueError("Argument `scene` must have a closed contact, but all gaps are open.")
    each = np.broadcast_to(np.asarray(e, float), (scene.contacts,))[closed]
    g = np.asarray(as_matrix(normalized_delassus(scene)), float)[np.ix_(closed, closed)]
    d = (1 - each) / (1 + each)
    whole = d[:, None] * g
    low, high = float(d.min()), float(d.max())
    return CoefficientAudit(
        energetic=copositivity((whole + whole.T) / 2, scale=float(np.abs(g).max())),
        spread=(high - low) / (high + low) if high > 0 else 0.0,
        spread_allowed=1 / float(np.linalg.cond(g)),
    )
