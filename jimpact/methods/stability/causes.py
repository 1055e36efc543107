"""Why a method is not right at a point: the theoretical limit that it is beyond."""

from typing import NamedTuple

import numpy as np

from jimpact.methods.contenders.base import Method
from jimpact.methods.stability.points import AXES, chain_of
from jimpact.methods.stability.runs import CLASSES, RIGHT


class Cause(NamedTuple):
    """A limit, its formula, and what to do about it."""

    name: str
    formula: str
    remedy: str


CAUSES = (
    Cause(
        "refused beforehand",
        "the plain time form divides by e^2; the propagator is exact for exponent 1 only",
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
(_REFUSED, _UNSTABLE, _COARSE, _RECLOSES, _APART, _CLUSTER, _FIRST_ORDER, _STRADDLES) = range(8)
STABLE = {"verlet": 2.0, "rk4": float(np.sqrt(8.0))}  # step sqrt(lambda_max)
RECLOSING = 0.1  # e below which three balls re-close (nearly) without end
_LONG, _CLUSTERED = 10, 0.9  # chains this long stay clustered up to about this e
_FAR = 100.0


def frequencies(point: np.ndarray) -> tuple[float, float]:
    """`sqrt(lambda_max)` of the linearized flow in units of the fastest contact, and the ratio of
    the fastest contact's frequency to the slowest's.

    lambda: eigenvalues of `omega G omega eta (eta + 1) / (2 e^2)`, the slope of the force at x = 1.

    >>> import numpy as np
    >>> from jimpact.methods.stability.causes import frequencies
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
    if name == "flagged" and (e == 0 or method.name == "propagator"):
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
