"""What is right at a point of a stability map, and how sure that is."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jimpact.laws.lzb import LZB
from jimpact.methods.contenders import METHODS
from jimpact.methods.contenders.base import Method, outcome
from jimpact.methods.stability.causes import RECLOSING, frequencies
from jimpact.methods.stability.points import AXES, chain_of
from jimpact.methods.stability.runs import DEFAULT, Found, runner
from jimpact.scene import chain
from jimpact.status import CODE

REFERENCE_RTOL = 1e-12
CHECK_RTOL = 1e-11  # of the run by scipy
CONFIRMED = 1e-7  # difference from it up to which the reference counts as confirmed
CHECKED = 12  # points
QUICK_UP_TO, QUICK_BALLS = 1e3, 10  # frequencies over the slowest contact's, size of a chain


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
