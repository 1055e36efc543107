"""Han and Gilmore's exhaustive tree: every elastic outcome that their three rules allow."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np

from jimpact._checks import as_whole, check_values, is_traced
from jimpact.scene import Scene, as_velocity, dense_mass

# Relative to the largest normalized approach velocity at the start: smaller gap velocities and
# impulses are zero, velocities that differ by less are the same. Ten times more would merge
# branches that differ in the eighth digit.
ZERO = 1e-9
SINGULAR = 1e-14  # singular values of G_SS below this are zero: redundant contacts


@dataclasses.dataclass(frozen=True)
class HanGilmoreOutcome:
    """v+ (n,) [m/s], total impulse p (m,) [N s], and the outcome of rule (iii) at each impact."""

    velocity: np.ndarray
    impulse: np.ndarray
    rules: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class _Node:
    """Normalized gap velocities and impulses (m,) so far, and the rules applied."""

    qn: np.ndarray
    p: np.ndarray
    rules: tuple[str, ...]


class _VisitedStates:
    """Gap velocities visited so far, sorted into cells by a generic weighted sum."""

    def __init__(self, first: np.ndarray):
        """With one state."""
        self._weights = np.sqrt(np.arange(2.0, len(first) + 2))
        self._width = 2 * ZERO * float(self._weights.sum())  # equal ones are in adjacent cells
        self._cells: dict[int, list[np.ndarray]] = {}
        self.add(first)

    def add(self, qn: np.ndarray) -> bool:
        """Whether `qn` is new; then it is added."""
        cell = int(np.floor(qn @ self._weights / self._width))
        near = [old for k in (cell - 1, cell, cell + 1) for old in self._cells.get(k, [])]
        if any(np.abs(old - qn).max() <= ZERO for old in near):
            return False
        self._cells.setdefault(cell, []).append(qn)
        return True


def han_gilmore(scene: Scene, velocity: Any, *, max_depth: int = 100) -> list[HanGilmoreOutcome]:
    """All elastic outcomes of an impact by the rules of Han and Gilmore; a host function.

    Equation: at each impact of a branch, S is the set of contacts with p_j > 0; there
    `gamma_S+ = -gamma_S`, `p_S = -2 W_SS^-1 gamma_S`. Rules: (i) energy is conserved; (ii) a
    branch ends where `gamma+ >= 0`, else another impact follows; (iii) `p_j > 0` where
    `gamma_j < 0`, `p_j = 0` where `gamma_j > 0`, both are tried where `gamma_j = 0` (to 1e-9 of
    the largest approach).

    Args:
        scene: its open contacts (gap > 0) take no part.
        velocity: v- (n,) [m/s].
        max_depth: longest branch, in impacts. The tree grows exponentially with the contacts at
            rest: one of eight equal balls hits the others, 1894 outcomes, a second.

    Returns:
        The distinct outcomes in float64, the shortest branches first (`velocity`, `impulse`,
        `rules`: one text an impact, contacts counted from 0; the branch of fewest impacts where
        several lead to the same v+). Empty where the rules contradict each other (an approaching
        contact would have to pull) or bounce between the same velocities for ever. For redundant
        contacts the impulse is the one of least norm.

    Raises:
        ValueError, TypeError: bad input, traced values.
        RuntimeError: a branch is longer than `max_depth`.

    Source: Han and Gilmore, J. Mech. Design 115 (1993) 412; Brogliato, Nonsmooth Mechanics
    (2016), (6.9)-(6.12).

    >>> import jimpact as ji
    >>> for outcome in ji.han_gilmore(ji.chain([1.0, 1.0, 1.0]), [1.0, 0.0, 0.0]):
    ...     print(outcome.velocity.round(6) + 0.0, len(outcome.rules))
    [-0.333333  0.666667  0.666667] 1
    [0. 0. 1.] 2
    """
    v = _checked(scene, velocity, max_depth)
    closed, normals, mobility = _on_host(scene)
    w = normals.T @ mobility
    root = np.sqrt(np.diag(w))
    g, qn = w / np.outer(root, root), normals.T @ v / root
    size = float(np.max(-qn[closed], initial=0.0))
    if size == 0.0:
        return [HanGilmoreOutcome(v, np.zeros_like(qn), ())]
    outcomes: list[HanGilmoreOutcome] = []
    frontier = [_Node(qn / size, np.zeros_like(qn), ())]
    visited = _VisitedStates(qn / size)
    while frontier:
        following: list[_Node] = []
        for node in frontier:
            for child in _impacts(g, node, closed):
                if not visited.add(child.qn):
                    continue
                if np.all(child.qn[closed] >= -ZERO):
                    p = child.p * size / root
                    outcomes.append(HanGilmoreOutcome(v + mobility @ p, p, child.rules))
                else:
                    following.append(child)
        if following and len(following[0].rules) >= max_depth:
            raise RuntimeError(
                f"A branch of the tree has more than `max_depth` = {max_depth} impacts "
                f"({len(outcomes)} outcomes found so far)."
            )
        frontier = following
    return outcomes


def _on_host(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Closed contacts, N, and M^-1 N under the bilateral constraints, in double precision always.

    Whether a contact is at rest decides the tree: single precision would not do.
    """
    normals, inverse = np.asarray(scene.normals, float), np.linalg.inv(dense_mass(scene))
    if scene.constraints is not None:
        h = np.asarray(scene.constraints, float)
        inverse_h = inverse @ h
        inverse = inverse - inverse_h @ np.linalg.solve(h.T @ inverse_h, inverse_h.T)
    return np.asarray(scene.closed), normals, inverse @ normals


def _checked(scene: Scene, velocity: Any, max_depth: int) -> np.ndarray:
    """v- (n,) on the host, all arguments checked."""
    if is_traced((scene, velocity)):
        raise TypeError("`han_gilmore` is a host function: it cannot be traced (jit, vmap, grad).")
    v = as_velocity(scene, velocity)
    check_values("velocity", v)
    as_whole("max_depth", max_depth, 1)
    return np.asarray(velocity, float)


def _impacts(g: np.ndarray, node: _Node, closed: np.ndarray) -> Iterator[_Node]:
    """Nodes that one impact leads to: one for every allowed set of contacts with p > 0."""
    approaching = closed & (node.qn < -ZERO)
    resting = closed & (np.abs(node.qn) <= ZERO)
    for active in _active_sets(g, approaching, resting):
        block, target = g[np.ix_(active, active)], -2 * node.qn[active]
        p_active = np.linalg.lstsq(block, target, rcond=SINGULAR)[0]
        if np.abs(block @ p_active - target).max() > ZERO or np.any(p_active <= ZERO):
            continue
        p = np.zeros_like(node.qn)
        p[active] = p_active
        qn = np.where(active, -node.qn, node.qn + g @ p)
        rules = (*node.rules, _rule(closed, active, approaching, resting))
        yield _Node(qn, node.p + p, rules)


def _active_sets(
    g: np.ndarray, approaching: np.ndarray, resting: np.ndarray
) -> Iterator[np.ndarray]:
    """The approaching contacts with all sets of resting ones that they reach through G.

    A resting contact that no approaching one pushes through others has p_j = 0: no new set.
    """
    coupled = np.abs(g) > SINGULAR
    sets, known = [approaching], {approaching.tobytes()}
    for active in sets:
        yield active
        for j in np.flatnonzero(resting & ~active & coupled[active].any(axis=0)):
            larger = active.copy()
            larger[j] = True
            if larger.tobytes() not in known:
                known.add(larger.tobytes())
                sets.append(larger)


def _rule(
    closed: np.ndarray, active: np.ndarray, approaching: np.ndarray, resting: np.ndarray
) -> str:
    """What rule (iii) said of every closed contact."""
    why = np.where(approaching, "approaching", np.where(resting, "at rest", "separating"))
    cases = (("p > 0", active), ("p = 0", closed & ~active))
    texts = [
        f"{case} at " + ", ".join(f"{j} ({why[j]})" for j in np.flatnonzero(chosen))
        for case, chosen in cases
        if chosen.any()
    ]
    return "; ".join(texts)
