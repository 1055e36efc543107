"""Han and Gilmore's exhaustive tree: every outcome that their three rules allow."""

import dataclasses
import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np

from jimpact.core.scene import Scene, as_velocity, dense_mass
from jimpact.tools.checks import as_whole, check_per_contact, check_values, is_traced

# Relative to the largest normalized approach velocity at the start: smaller gap
# velocities and impulses are zero, velocities that differ by less are the same. Ten
# times more would merge branches that differ in the eighth digit.
ZERO = 1e-9
SINGULAR = 1e-14  # singular values of G_SS below this are zero: redundant contacts
# An approach left at the end, relative as ZERO, that is no rounding: the sequence of
# impacts has no end. Ten times more would begin to hide sequences whose approaches fall
# a hundredfold at once.
ROUNDING = 1e-12


@dataclasses.dataclass(frozen=True)
class HanGilmoreOutcome:
    """v+ (n,) [m/s], impulses p (m,) and p_t (t,) [N s], the outcome of rule (iii) at
    each impact.

    `endless`: a sequence of impacts without end leads there, cut off at 1e-9 of the
    approach.
    """

    velocity: np.ndarray
    impulse: np.ndarray
    rules: tuple[str, ...]
    tangential_impulse: np.ndarray
    endless: bool = False


@dataclasses.dataclass
class _Node:
    """A velocity that the tree has reached, in normalized components along normals and
    tangents.
    """

    state: np.ndarray  # gap and slip velocities (m + t,) over sqrt(W_jj)
    p: np.ndarray  # sum of the impulses (m + t,) from the start, times sqrt(W_jj)
    rules: tuple[str, ...] = ()  # rule (iii) at each impact of the branch
    endless: bool = False  # a sequence of impacts without end leads here


@dataclasses.dataclass(frozen=True)
class _Problem:
    """Contact matrices of a scene with m contacts and t tangents (0, or m with
    friction).
    """

    matrix: np.ndarray  # W_ij / sqrt(W_ii W_jj) of normals and tangents (m + t, m + t)
    restitution: np.ndarray  # e (m,)
    friction: np.ndarray | None  # mu (m,)
    closed: np.ndarray  # mask (m,)
    rows: np.ndarray  # normals and tangents (n, m + t)
    mobility: np.ndarray  # M^-1 rows (n, m + t), with bilateral constraints kept
    root: np.ndarray  # sqrt(W_jj) of the normals (m + t,), for the tangents once more

    @property
    def contacts(self) -> int:
        """Number m of contacts."""
        return len(self.closed)

    @property
    def coupled(self) -> np.ndarray:
        """Mask (m, m): an impulse at contact j changes a gap or slip velocity at
        contact i.
        """
        m = self.contacts
        each = len(self.matrix) // self.contacts
        # axes: normal or tangent, contact; once for rows and once for columns
        axes = (each, m, each, m)
        blocks = np.abs(self.matrix).reshape(axes)
        coupled: np.ndarray = blocks.max(axis=(0, 2)) > SINGULAR
        return coupled

    def approach(self, node: _Node) -> float:
        """Largest normalized approach velocity -qn of a closed contact, 0 where none
        approaches.
        """
        qn = node.state[: self.contacts]
        return float(np.max(-qn[self.closed], initial=0.0))


# States of the tree (m + t,) by the whole number that `_is_new` gives them.
Cells = dict[int, list[np.ndarray]]


def _is_new(state: np.ndarray, visited: Cells) -> bool:
    """True for a state that differs by more than `ZERO` from all visited ones; it
    becomes visited.

    States are kept in cells of their weighted sum `sum_i w_i s_i`, `2 ZERO sum_i w_i`
    wide: equal states lie in the same cell or in neighbours, so that few have to be
    compared.
    """
    weights = np.sqrt(np.arange(2.0, len(state) + 2))
    size = 2 * ZERO * weights.sum()
    cell = int(np.floor(state @ weights / size))
    cells = (cell - 1, cell, cell + 1)
    near = [old for k in cells for old in visited.get(k, [])]
    distances = (np.abs(old - state).max() for old in near)
    if any(distance <= ZERO for distance in distances):
        return False
    visited.setdefault(cell, []).append(state)
    return True


def han_gilmore(
    scene: Scene,
    velocity: Any,
    restitution: Any = 1.0,
    friction: Any = None,
    *,
    max_depth: int = 100,
) -> list[HanGilmoreOutcome]:
    """All outcomes of an impact by the rules of Han and Gilmore; a host function.

    Equation: at each impact of a branch, S is the set of contacts with p_j > 0; there
    `gamma_S+ = -e gamma_S`, without friction `p_S = -W_SS^-1 (1 + e) gamma_S`. Rules:
    (i) energy is conserved, where e = 1; (ii) a branch ends where `gamma+ >= 0`, else
    another impact follows; (iii) `p_j > 0` where `gamma_j < 0`, `p_j = 0` where
    `gamma_j > 0`, both are tried where `gamma_j = 0` (to 1e-9 of the largest approach).
    With friction each contact of S also sticks, `u+ = 0` and `|p_t| <= mu p`, or slides
    to either side, `p_t = -mu p sgn(u+)`: all are tried.

    Args:
        scene: its open contacts (gap > 0) take no part; planar tangents where there is
            friction.
        velocity: v- (n,) [m/s].
        restitution: kinematic coefficient e in [0, 1], scalar or (m,).
        friction: Coulomb's mu >= 0, scalar or (m,); None: no friction.
        max_depth: longest branch, in impacts. The tree grows exponentially with the
            contacts at rest: one of eight equal balls hits the others, 1894 outcomes, a
            second.

    Returns:
        The distinct outcomes in float64, the shortest branches first (`velocity`,
        `impulse`,
        `tangential_impulse`, `rules`: one text an impact, contacts counted from 0; the
        branch of fewest impacts where several lead to the same v+). `endless` where one
        of these branches has no end: its approaches decay, as with e = 0, and it is cut
        off at 1e-9. Empty where the rules contradict each other (an approaching contact
        would have to pull) or bounce between the same velocities for ever. For
        redundant contacts the impulse is the one of least norm.

    Raises:
        ValueError, TypeError: bad input, traced values.
        RuntimeError: a branch is longer than `max_depth`.

    Source: Han and Gilmore, J. Mech. Design 115 (1993) 412; Brogliato, Nonsmooth
    Mechanics (2016), (6.9)-(6.12).

    >>> import jimpact as ji
    >>> for outcome in ji.han_gilmore(ji.chain([1.0, 1.0, 1.0]), [1.0, 0.0, 0.0]):
    ...     print(outcome.velocity.round(6) + 0.0, len(outcome.rules))
    [-0.333333  0.666667  0.666667] 1
    [0. 0. 1.] 2
    """
    if is_traced((scene, velocity)):
        raise TypeError(
            "`han_gilmore` is a host function: it cannot be traced (jit, vmap, grad)."
        )
    check_values("velocity", as_velocity(scene, velocity))
    as_whole("max_depth", max_depth, 1)
    v = np.asarray(velocity, float)
    problem = _problem(scene, restitution, friction)
    m = problem.contacts
    state = problem.rows.T @ v / problem.root
    start = _Node(state, np.zeros_like(state))
    size = problem.approach(start)
    if size == 0.0:
        nothing = HanGilmoreOutcome(v, start.p[:m], (), start.p[m:])
        return [nothing]
    start.state = state / size
    found: list[_Node] = []  # ends of branches: nothing approaches
    # nodes after equally many impacts, and all so far
    frontier = [start]
    visited = Cells()
    _is_new(start.state, visited)
    while frontier:
        following: list[_Node] = []
        for node in frontier:
            for child in _impacts(problem, node):
                approach = problem.approach(child)
                if _is_new(child.state, visited):
                    (found if approach <= ZERO else following).append(child)
                # such an approach decays through a sequence of impacts without end, cut
                # off here
                if ROUNDING < approach <= ZERO:
                    for other in found:
                        difference = np.abs(other.state - child.state)
                        near = difference.max() <= 2 * ZERO
                        other.endless |= bool(near)
        if following and len(following[0].rules) >= max_depth:
            raise RuntimeError(
                f"A branch of the tree has more than `max_depth` = {max_depth} impacts "
                f"({len(found)} outcomes found so far)."
            )
        frontier = following
    outcomes = []
    for node in found:
        p = node.p * size / problem.root
        after = v + problem.mobility @ p
        outcome = HanGilmoreOutcome(after, p[:m], node.rules, p[m:], node.endless)
        outcomes.append(outcome)
    return outcomes


def _problem(scene: Scene, restitution: Any, friction: Any) -> _Problem:
    """Contact matrices of a scene, in double precision always, with e and mu checked.

    `W = J M^-1 J^T`, J^T (n, m + t) the normals and, with friction, the tangents.
    Single precision could not tell contacts at rest from slow ones, which decides the
    tree.
    """
    m = scene.contacts
    check_per_contact("restitution", restitution, m)
    check_values("restitution", restitution, low=0.0, high=1.0)
    rows = np.asarray(scene.normals, float)
    mu = None
    if friction is not None:
        check_per_contact("friction", friction, m)
        check_values("friction", friction, low=0.0)
        if scene.tangents is None or scene.tangents.shape[1] != m:
            raise ValueError(
                "Argument `scene` must have one tangent a contact (planar) where there "
                "is friction."
            )
        tangents = np.asarray(scene.tangents, float)
        rows = np.concatenate([rows, tangents], axis=1)
        mu = np.broadcast_to(np.asarray(friction, float), (m,))
    inverse = np.linalg.inv(dense_mass(scene))
    if scene.constraints is not None:  # M^-1 - M^-1 H (H^T M^-1 H)^-1 H^T M^-1
        h = np.asarray(scene.constraints, float)
        inverse_h = inverse @ h
        held = np.linalg.solve(h.T @ inverse_h, inverse_h.T)
        inverse = inverse - inverse_h @ held
    mobility = inverse @ rows
    w = rows.T @ mobility
    of_normals = np.sqrt(np.diag(w)[:m])
    root = np.tile(of_normals, len(w) // m)
    e = np.broadcast_to(np.asarray(restitution, float), (m,))
    closed = np.asarray(scene.closed)
    normalized = w / np.outer(root, root)
    return _Problem(normalized, e, mu, closed, rows, mobility, root)


def _impacts(problem: _Problem, node: _Node) -> Iterator[_Node]:
    """Nodes after one more impact: one for each set of contacts with p > 0 that rule
    (iii) allows.

    With friction one for each way in which these contacts stick or slide, too.
    """
    qn = node.state[: problem.contacts]
    closed = problem.closed
    approaching = closed & (qn < -ZERO)
    resting = closed & (np.abs(qn) <= ZERO)
    for active in _active_sets(problem.coupled, approaching, resting):
        at = np.flatnonzero(active)
        # of u+; 0: it sticks
        signs = (0, 1, -1) if problem.friction is not None else (0,)
        for slides in itertools.product(signs, repeat=len(at)):
            child = _impact(problem, node, at, np.array(slides))
            if child is None:
                continue
            rule = _rule(closed, active, approaching, resting)
            if problem.friction is not None:
                ways = {0: "sticks", 1: "slides forward", -1: "slides backward"}
                rule += "".join(f"; {j} {ways[sign]}" for j, sign in zip(at, slides))
            yield dataclasses.replace(child, rules=(*node.rules, rule))


def _impact(
    problem: _Problem, node: _Node, at: np.ndarray, slides: np.ndarray
) -> _Node | None:
    """The node after an impact with p > 0 at contacts `at` (s,); None if it contradicts
    itself.

    Equation: `gamma+ = -e gamma-`; with friction `u+ = 0` where `slides` (s,) is 0,
    else `p_t = -mu p slides`. It contradicts itself unless p > 0, |p_t| <= mu p where a
    contact sticks, and u+ has the sign `slides`.
    """
    m = problem.contacts
    count = len(at)
    mu = problem.friction
    if mu is None:
        rows = at
    else:
        rows = np.concatenate([at, m + at])
    # block (p, p_t) = target: changes of gap and slip velocity
    block = problem.matrix[np.ix_(rows, rows)].copy()
    target = -node.state[rows]
    target[:count] *= 1 + problem.restitution[at]
    if mu is not None:
        for k in np.flatnonzero(slides):  # p_t + mu p sgn(u+) = 0
            block[count + k] = 0.0
            target[count + k] = 0.0
            block[count + k, [k, count + k]] = mu[at[k]] * slides[k], 1.0
    solved = np.linalg.lstsq(block, target, rcond=SINGULAR)[0]
    pushes = solved[:count]
    p_t = solved[count:]
    residual = np.abs(block @ solved - target).max()
    if residual > ZERO or np.any(pushes <= ZERO):
        return None
    p = np.zeros_like(node.p)
    p[rows] = solved
    state = node.state + problem.matrix @ p
    state[at] = -problem.restitution[at] * node.state[at]
    if mu is not None:
        beyond = np.abs(p_t) > mu[at] * pushes + ZERO
        if np.any((slides == 0) & beyond):
            return None
        if np.any(slides * state[m + at] < -ZERO):
            return None
    return _Node(state, node.p + p)


def _active_sets(
    coupled: np.ndarray, approaching: np.ndarray, resting: np.ndarray
) -> Iterator[np.ndarray]:
    """Masks (m,) of contacts with p > 0: the approaching ones, alone and with resting
    ones.

    `coupled` (m, m), `approaching` and `resting` (m,) are masks. A resting contact
    joins a set only where it is coupled to a contact of the set; else p_j = 0.
    """
    sets = [approaching]
    known = {approaching.tobytes()}
    for active in sets:
        yield active
        touched = coupled[active].any(axis=0)
        for j in np.flatnonzero(resting & ~active & touched):
            larger = active.copy()
            larger[j] = True
            if larger.tobytes() not in known:
                known.add(larger.tobytes())
                sets.append(larger)


def _rule(
    closed: np.ndarray, active: np.ndarray, approaching: np.ndarray, resting: np.ndarray
) -> str:
    """Text of rule (iii) at one impact: closed contacts with p > 0 and with p = 0, and
    why.

    All arguments are masks (m,).
    """
    not_approaching = np.where(resting, "at rest", "separating")
    why = np.where(approaching, "approaching", not_approaching)
    cases = (("p > 0", active), ("p = 0", closed & ~active))
    texts = [
        f"{case} at " + ", ".join(f"{j} ({why[j]})" for j in np.flatnonzero(chosen))
        for case, chosen in cases
        if chosen.any()
    ]
    return "; ".join(texts)
