"""What is right at a point of a stability map, how sure that is, and why a method is not right."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jimpact.laws.lzb import LZB
from jimpact.methods.contenders import METHODS
from jimpact.methods.contenders.base import Method, outcome
from jimpact.methods.stability_points import AXES, CLASSES, DEFAULT, RIGHT, Found, chain_of, runner
from jimpact.scene import chain
from jimpact.status import CODE

(_REFUSED, _UNSTABLE, _COARSE, _RECLOSES, _APART, _CLUSTER, _FIRST_ORDER, _STRADDLES) = range(8)
STABLE = {"verlet": 2.0, "rk4": float(np.sqrt(8.0))}  # step sqrt(lambda_max)
RECLOSING = 0.1  # e below which three balls re-close (nearly) without end
_LONG, _CLUSTERED = 10, 0.9  # chains this long stay clustered up to about this e
_FAR = 100.0
REFERENCE_RTOL = 1e-12
CHECK_RTOL = 1e-11  # of the run by scipy
CONFIRMED = 1e-7  # difference from it up to which the reference counts as confirmed
CHECKED = 12  # points
QUICK_UP_TO, QUICK_BALLS = 1e3, 10  # frequencies over the slowest contact's, size of a chain


class Cause(NamedTuple):
    """A limit, its formula, and what to do about it."""

    name: str
    formula: str
    remedy: str


CAUSES = (
    Cause(
        "refused beforehand",
        "the plain time form divides by e^2",
        "the default method",
    ),
    Cause(
        "step beyond the linear stability limit",
        "step sqrt(lambda_max) > 2 (Verlet), 2 sqrt 2 (Runge-Kutta 4); lambda grows with 1/e^2",
        "a smaller step, or an adaptive method",
    ),
    Cause(
        "a contact's whole stroke lies within one step",
        "step sqrt(lambda_max) of order 1: the fastest contact opens within the step",
        "a smaller step, or an adaptive method",
    ),
    Cause(
        "contacts re-close without end",
        "z = (1 + e) cos(theta) / (2 sqrt e) >= 1 for binary; LZB: e below 0.07 (three balls)",
        "the default method ends it as plastic_limit, on short chains",
    ),
    Cause(
        "time scales far apart",
        "omega_max / omega_min of the contacts over 100: strokes of one within those of another",
        "more steps (`max_steps`)",
    ),
    Cause(
        "many contacts at once",
        "a loss in every contact of a long chain leaves a cluster that re-closes again and again",
        "more steps (`max_steps`)",
    ),
    Cause(
        "first order at E = 0",
        "dp_j = F_j/F_i dp_i is 0/0 at E_i = 0 and not Lipschitz: error of the order of the step",
        "the time form (default)",
    ),
    Cause(
        "steps straddle changes of phase",
        "a step h across a kink of the right side costs O(h^2) whatever the order",
        "steps that end on events (default)",
    ),
)


def frequencies(point: np.ndarray) -> tuple[float, float]:
    """`sqrt(lambda_max)` of the linearized flow in units of the fastest contact, and the ratio of
    the fastest contact's frequency to the slowest's.

    lambda: eigenvalues of `omega G omega eta (eta + 1) / (2 e^2)`, the slope of the force at x = 1.

    >>> import numpy as np
    >>> from jimpact.methods.stability_references import frequencies
    >>> [round(x, 3) for x in frequencies(np.array([0.5, 1.0, 1.0, 1.0, 1.0, 2]))]
    [1.0, 1.0]
    """
    _, kappa, eta, e, mu, balls = map(float, point)
    mass, k = (np.asarray(x, float) for x in chain_of(kappa, mu, int(balls)))
    w = 1 / mass[:-1] + 1 / mass[1:]
    # 1 / t_ref at the largest normalized speed, up to a common factor
    omega = k ** (1 / (eta + 1)) * np.sqrt(w)
    slowest = omega.max() / omega.min()
    omega = omega / omega.max()
    beside = -1 / mass[1:-1] / np.sqrt(w[:-1] * w[1:])
    g = np.eye(len(w)) + np.diag(beside, 1) + np.diag(beside, -1)
    largest = np.linalg.eigvalsh(omega[:, None] * g * omega[None, :])[-1]
    with np.errstate(divide="ignore"):
        return float(np.sqrt(largest * eta * (eta + 1) / 2) / e) if e else np.inf, float(slowest)


def cause_of(
    method: Method, points: np.ndarray, codes: np.ndarray, setting: np.ndarray
) -> np.ndarray:
    """Index of CAUSES of each point (P,); -1 where it is right."""
    found = np.full(len(points), -1)
    for i in np.flatnonzero(codes != RIGHT):
        found[i] = _cause(method, points[i], CLASSES[codes[i]], float(setting[i]))
    return found


def _cause(method: Method, point: np.ndarray, name: str, setting: float) -> int:
    e, balls = point[AXES.index("restitution")], point[AXES.index("balls")]
    highest, apart = frequencies(point)
    reach = setting * highest
    if name == "flagged" and e == 0:
        return _REFUSED
    if method.setting == "step" and reach > 1:
        return _UNSTABLE if reach > STABLE.get(method.name, np.inf) else _COARSE
    if name in ("does not end", "flagged", "unchecked"):
        if e < RECLOSING:
            return _RECLOSES
        if apart > _FAR or point[AXES.index("mass_ratio")] < 1 / _FAR:
            return _APART
        if balls >= _LONG and e < _CLUSTERED:
            return _CLUSTER
    if method.setting == "impulse step":
        return _FIRST_ORDER
    return _STRADDLES if name in ("wrong", "stalls", "gains energy") else _APART


class Confirmation(NamedTuple):
    """How many references another integrator could confirm, and the largest difference there."""

    points: int
    tried: int
    confirmed: int
    difference: float


class Runners:
    """Compiled batches by method and shape, and the progress of the map."""

    def __init__(self, max_steps: int, advance: Callable[[int], None]):
        self.max_steps, self.advance = max_steps, advance
        self._made: dict[tuple[str, int, bool], Callable[[np.ndarray, np.ndarray], Found]] = {}

    def run(
        self, method: Method, balls: int, linear: bool, points: np.ndarray, setting: Any
    ) -> Found:
        """One method on points of equal shape; setting () or (L,)."""
        key = (method.name, balls, linear)
        if key not in self._made:
            self._made[key] = runner(method, balls, linear, self.max_steps)
        return self._made[key](points, np.broadcast_to(setting, (len(points),)))


def groups(points: np.ndarray) -> list[tuple[np.ndarray, int, bool]]:
    """Points (indices) of equal shapes, their number of balls, whether they are linear."""
    balls, linear = points[:, AXES.index("balls")], points[:, AXES.index("exponent")] == 1.0
    return [
        (np.flatnonzero((balls == n) & (linear == kind)), int(n), bool(kind))
        for n in np.unique(balls)
        for kind in (False, True)
        if np.any((balls == n) & (linear == kind))
    ]


def references(points: np.ndarray, runners: Runners) -> tuple[list[np.ndarray], Confirmation]:
    """v+ of every point (NaN where no run ends), and how many an independent way confirms."""
    exact: list[np.ndarray] = [np.empty(0)] * len(points)
    for at, balls, linear in groups(points):
        unique, back = np.unique(points[at, 1:], axis=0, return_inverse=True)
        rows = np.column_stack([np.zeros(len(unique)), unique])
        found = runners.run(DEFAULT, balls, linear, rows, REFERENCE_RTOL)
        ended = (found.code == CODE["ok"]) | (found.code == CODE["plastic_limit"])
        velocity = np.where(ended[:, None], found.velocity, np.nan)
        for i, k in zip(at, np.ravel(back)):
            exact[i] = velocity[k]
        runners.advance(len(at))
    return exact, _confirm(points, exact)


def _confirm(points: np.ndarray, exact: list[np.ndarray]) -> Confirmation:
    """Differences from scipy's integrator at points spread over those that it solves quickly."""
    ended = np.array([bool(np.isfinite(v).all()) for v in exact])
    quick = np.array([_is_quick(point) for point in points])
    candidates = np.flatnonzero(ended & quick)
    _, first = np.unique(points[candidates, 1:], axis=0, return_index=True)
    candidates = candidates[np.sort(first)]
    every = max(1, -(-len(candidates) // CHECKED))
    apart = np.array([np.abs(_by_scipy(points[i]) - exact[i]).max() for i in candidates[::every]])
    largest = float(apart.max()) if len(apart) else float("nan")
    return Confirmation(len(points), len(apart), int((apart <= CONFIRMED).sum()), largest)


def _is_quick(point: np.ndarray) -> bool:
    highest, apart = frequencies(point)
    parts = point[AXES.index("restitution")] >= RECLOSING  # else scipy may end it too early
    few = point[AXES.index("balls")] <= QUICK_BALLS
    return bool(parts and few and highest * apart < QUICK_UP_TO)


def _by_scipy(point: np.ndarray) -> np.ndarray:
    _, kappa, eta, e, mu, balls = map(float, point)
    mass, stiffness = chain_of(kappa, mu, int(balls))
    scene, v = chain(mass), np.eye(int(balls))[0]
    law = LZB(e, stiffness, eta)
    found = METHODS["scipy_dop853"].solve(law, scene, v, CHECK_RTOL)
    return np.asarray(outcome(law, scene, v, found).velocity)
