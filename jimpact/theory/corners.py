"""Re-entrant corners: it is enough that one of the contacts does not approach."""

from typing import Any, NamedTuple

import numpy as np

from jimpact.core.contact import kinetic_norm, normalized_gap_velocity
from jimpact.core.scene import Scene, as_velocity, velocity_change
from jimpact.tools.checks import as_numbers

# Normalized approach velocities that differ by less than this, relative to the larger
# one, are equal: then both sides are as near. Ten times more would still be far below
# what is measured.
EQUAL = 1e-9


class CornerOutcome(NamedTuple):
    """`velocity` v+ (n,) [m/s], `contact` that acts, its `impulse` [N s], `nearest`."""

    velocity: np.ndarray
    contact: int
    impulse: float
    nearest: bool


def reentrant_corner(
    scene: Scene, velocity: Any, restitution: Any
) -> list[CornerOutcome]:
    """Outcomes at a corner that points inwards: gaps f_1 >= 0 OR f_2 >= 0, ...

    Equation: a velocity is admissible where any `gamma_j >= 0`, so there is an impact
    only where all approach, and one contact then suffices:
    `p_j = -(1 + e_j) gamma_j / W_jj`. The set of admissible velocities is not convex:
    nearest to v- in the kinetic metric is the one of the contact with the least
    `|gamma_j| / sqrt(W_jj)`; for equal ones there are several.

    Args:
        scene: n coordinates, m closed contacts: the sides of the corner.
        velocity: v- (n,) [m/s].
        restitution: e in [0, 1], scalar or (m,).

    Returns:
        `CornerOutcome` of each contact, the nearest first; empty: v- is admissible.

    Raises:
        ValueError: velocity or restitution of a wrong size or range.

    Host function, not differentiable: the outcome jumps where another contact is
    nearest.

    Source: own derivation; Glocker treats re-entrant corners by Moreau's law, as
    Brogliato, Nonsmooth Mechanics (2016), 6.4.2 says.

    >>> import jimpact as ji
    >>> edge = ji.Scene(
    ...     [1.0, 1.0], [[1.0, 0.0], [0.0, 1.0]]
    ... )  # a point that meets an edge
    >>> for outcome in ji.theory.reentrant_corner(edge, [-1.0, -0.4], 0.5):
    ...     print(outcome.velocity.round(6), outcome.contact, outcome.nearest)
    [-1.   0.2] 1 True
    [ 0.5 -0.4] 0 False
    """
    v = as_velocity(scene, velocity, finite=True)
    m = scene.contacts
    e = as_numbers("restitution", restitution, low=0.0, high=1.0, contacts=m)
    approach = -np.asarray(normalized_gap_velocity(scene, v), float)
    if (approach <= 0).any():
        return []
    each = np.broadcast_to(np.asarray(e, float), approach.shape)
    # row j: contact j acts alone, p_j = (1 + e_j) |gamma_j| / W_jj; approach has
    # |gamma| / sqrt(W)
    root_w = np.asarray(kinetic_norm(scene), float)
    impulses = np.diag((1 + each) * approach / root_w)
    least = approach.min() * (1 + EQUAL)
    return [
        CornerOutcome(
            np.asarray(v + velocity_change(scene, impulses[j])),
            int(j),
            float(impulses[j, j]),
            bool(approach[j] <= least),
        )
        for j in np.argsort(approach, kind="stable")
    ]
