"""Ratios of impulses at contacts beside each other, and the energy of
precompression.
"""

from typing import Any

import jax
import numpy as np

from jimpact.core.scene import Scene
from jimpact.laws.impulse_correlation import interval
from jimpact.tools.checks import as_numbers


def distributing_rule(energy: Any, stiffness: Any, exponent: Any) -> jax.Array:
    """`Gamma_ji = dp_j / dp_i` (m, m), the ratio of impulse increments at two contacts.

    Equation: `Gamma_ji = F_j / F_i`, `F_j = ((1 + eta_j) E_j)^(eta_j / (1 + eta_j))
    k_j^(1 / (1 + eta_j))`.

    Args:
        energy: E_j >= 0 (m,) [J], potential energy of each contact.
        stiffness: k_j > 0, scalar or (m,) [N / m^eta_j].
        exponent: eta_j >= 1, scalar or (m,).

    Returns:
        Row j, column i: Gamma_ji; NaN or inf in columns with E_i = 0 (0/0 at the first
        touch: why the law is integrated in time form, see `LZB`).

    Raises:
        ValueError: energy < 0, stiffness <= 0, exponent < 1.

    Source: Liu, Zhao and Brogliato (2008); Brogliato (2016), (6.70).

    >>> import jimpact as ji
    >>> round(float(ji.theory.distributing_rule([1.0, 0.3], [1.0, 2.0], 1.5)[1, 0]), 5)
    0.64074
    """
    energy = as_numbers("energy", energy, low=0.0)
    stiffness = as_numbers("stiffness", stiffness, low=0.0, open_low=True)
    eta = as_numbers("exponent", exponent, low=1.0)
    stored = ((1 + eta) * energy) ** (eta / (1 + eta))
    force = stored * stiffness ** (1 / (1 + eta))
    return force[:, None] / force[None, :]


def correlation_interval(
    scene: Scene, restitution: Any
) -> tuple[np.ndarray, np.ndarray]:
    """Ratios `r_j = dp_j / dp_i` that mechanics allows a contact j beside contact i.

    Equation, with the Delassus matrix W: `r_j >= -W_ij / W_jj`, or contact j would
    approach; and contact i separates only where `W_ii + 2 W_ij r + W_jj r^2 <= (1 +
    e_i^2) (W_ii + W_ij r)`, with `W_ii + W_ij r > 0`. For three equal balls that hit at
    e = 1: 1/2 to 1, the whole arc of outcomes that conserve energy.

    Args:
        scene: m contacts.
        restitution: energetic coefficient e in [0, 1], scalar or (m,).

    Returns:
        Least and largest ratios, each (m, m): row i, column j; NaN where contact i does
        not press contact j (`W_ij >= 0`), which then gets no impulse. Least above
        largest: there is none.

    Raises:
        ValueError: restitution out of range or of a wrong size.

    Host function, not differentiable.

    Source: own derivation, from `ImpulseCorrelation` of two contacts.

    >>> import jimpact as ji
    >>> low, high = ji.theory.correlation_interval(ji.chain([1.0, 1.0, 1.0]), 0.9)
    >>> round(float(low[0, 1]), 6), round(float(high[0, 1]), 6)
    (0.5, 0.948753)
    """
    m = scene.contacts
    e = as_numbers("restitution", restitution, low=0.0, high=1.0, contacts=m)
    return interval(scene, e)


def precompression_energy(force: Any, stiffness: Any, exponent: Any = 1.5) -> jax.Array:
    """Energy stored in contacts that press on each other before an impact.

    Equation: `U_0j = F_0j^((eta_j + 1) / eta_j) / ((eta_j + 1) k_j^(1 /
    eta_j))`, the integral of `F = k x^eta` up to the force F_0.

    Args:
        force: F_0j >= 0, scalar or (m,) [N].
        stiffness: k_j > 0, scalar or (m,) [N / m^eta_j].
        exponent: eta_j >= 1, scalar or (m,).

    Returns:
        U_0 [J], of the common shape, for `LZB` and `Compliant`.

    Raises:
        ValueError: force < 0, stiffness <= 0, exponent < 1.

    Source: Brogliato (2016), 6.3.1, with the exponent 1 / eta of `docs/equations.md`.

    >>> import jimpact as ji
    >>> float(
    ...     ji.theory.precompression_energy(2.0, stiffness=8.0, exponent=1.0)
    ... )  # F^2 / (2 k)
    0.25
    """
    force = as_numbers("force", force, low=0.0)
    stiffness = as_numbers("stiffness", stiffness, low=0.0, open_low=True)
    eta = as_numbers("exponent", exponent, low=1.0)
    work = force ** ((eta + 1) / eta)
    return work / ((eta + 1) * stiffness ** (1 / eta))
