"""Does the law fit at all: lack of fit, suspicious shots, shots that cannot be used.

Every law leaves a momentum unchanged that the contacts cannot change, and predicts the same for
shots that began alike: residuals in these directions are noise. The other residuals are compared
with it, or with the stated sigma.
"""

from typing import Any, NamedTuple

import numpy as np
from scipy.special import chdtrc, fdtrc

from jimpact.fits.findings import Finding
from jimpact.fits.problem import UNUSABLE, FitProblem, Shots
from jimpact.fits.search import Minimum, SearchResult
from jimpact.status import STATUS

NO_SHOT = -1  # the place of a shot where a value belongs to none: a prior
LEVEL = 0.01  # of each test: how often it flags data that the law itself made
_LEAST = 3  # degrees of freedom of the noise too few to test against
_RANGE = 1e-6  # singular values below this share count as 0 (derivatives are good to 1e-7)
_LISTED = 6  # shots named one by one
MEDIAN = 1.4826  # sigma of a normal distribution over the median of its absolute values
# A median of absolute values is as uncertain as a standard deviation of this share of the values
# (Huber, 1981). Ten times more would make honest shots of small sets suspicious.
MEDIAN_FREEDOM = 0.37
# Largest derivative of a velocity, over the largest velocity and a natural step of a parameter (as
# far as from 0 to 1 for a restitution): those beyond are errors and would shorten every step.
ABSURD = 1e3


class Weighted(NamedTuple):
    """Residuals (R,) of the measured values in units of sigma, derivatives (R, P), shots (R,).

    Those of the priors come last, their shot is `NO_SHOT`.
    """

    residual: np.ndarray
    jacobian: np.ndarray
    shot: np.ndarray


def unusable(problem: FitProblem, solution: SearchResult) -> np.ndarray:
    """Shots (K,) whose impacts fail, or whose derivatives are not finite or absurdly large."""
    if not isinstance(problem.residuals.observe, Shots):
        return np.zeros(1, bool)
    shots, bodies = problem.measured.shape
    weight = np.asarray(problem.residuals.weight, float)[..., None]
    slope = np.abs(solution.jacobian.reshape(shots, bodies, -1))
    allowed = ABSURD * float(problem.residuals.unit) * weight
    fails = [STATUS[code].name in UNUSABLE for code in solution.status]
    used = ~np.isnan(problem.measured).all(axis=1)
    return used & (np.array(fails) | ~(slope <= allowed).all(axis=(1, 2)))


def weighted(problem: FitProblem, solution: SearchResult) -> Weighted:
    """Residuals and derivatives as the tests need them."""
    here = ~np.isnan(problem.measured)
    residual, slope = problem.prior_errors(solution.value)
    return Weighted(
        np.append(problem.independent(problem.measured - solution.predicted)[here], residual),
        np.vstack([problem.size * solution.jacobian[here.ravel()], slope * solution.scale]),
        np.append(problem.shot_of_value, np.full(len(residual), NO_SHOT)),
    )


def reproduced(problem: FitProblem, minimum: Minimum) -> bool:
    """Whether all measured values are reproduced to the last digit."""
    return problem.size**2 * minimum.squares <= problem.exact_squares


def adequacy(problem: FitProblem, solution: SearchResult, rank: int, robust: bool) -> list[Finding]:
    """Lack of fit and suspicious shots, in words; none if the data are reproduced exactly."""
    data = weighted(problem, solution)
    squares, freedom = float(data.residual @ data.residual), problem.values - rank
    if freedom < 1 or squares <= problem.exact_squares:
        return []
    lines: list[str] = []
    if problem.sigma is not None:
        if (times := stretch(problem, data, rank)) > 1:
            lines.append(
                f"Lack of fit: the residuals are {times:.2g} times what sigma allows (chi^2 = "
                f"{squares:.4g} with {freedom} degrees of freedom): the law or the stated errors "
                "are wrong, or the parameters scatter; the standard errors "
                f"{'are those of the loss' if robust else 'are stretched by that'}."
            )
    elif problem.experiments is not None:
        lines += _beyond_noise(problem, data, freedom) or _pattern(problem, data, freedom)
    found = [Finding(line) for line in lines] + _contradicted_priors(problem, data)
    if problem.experiments is not None:
        found += _suspicious(problem, data, freedom, robust)
    return found


def stretch(problem: FitProblem, data: Weighted, rank: int) -> float:
    """By how much errors are larger than stated, 1 where chi^2 does not reject them.

    Equation: `sqrt(chi^2 / freedom)`, of all residuals, or of those that are not momentum if that
    is more: the errors of a law or its parameters are in these.
    """
    squares, freedom = float(data.residual @ data.residual), problem.values - rank
    tests = [(squares, freedom)]
    if problem.experiments is not None and not problem.experiments.lost_freedom:
        for k, basis in enumerate(_conserved(problem)):
            if basis.shape[1]:
                squares -= float(np.sum((basis.T @ data.residual[data.shot == k]) ** 2))
                freedom -= basis.shape[1]
        tests.append((max(squares, 0.0), freedom))
    rejected = [s / f for s, f in tests if f > 0 and chdtrc(f, s) < LEVEL]
    return float(np.sqrt(max(rejected, default=1.0)))


def _beyond_noise(problem: FitProblem, data: Weighted, freedom: int) -> list[str]:
    """What the law leaves over, against the noise of momentum and of repeated shots."""
    noise, count = _noise(problem, data)
    rest = freedom - count
    if count < _LEAST or rest < 1:
        return []
    left = max(float(data.residual @ data.residual) - noise, 0.0)
    floor = count * _reading_variance(problem)
    ratio = left / rest / max(noise / count, floor / count)
    if fdtrc(rest, count, ratio) >= LEVEL:
        return []
    return [
        f"Lack of fit: the residuals are {np.sqrt(ratio):.2g} times the noise that momentum and "
        f"repeated shots show ({rest} and {count} degrees of freedom): the law does not fit, and "
        "the standard errors mean little."
    ]


def _noise(problem: FitProblem, data: Weighted) -> tuple[float, int]:
    """Sum of squares that no law can change, and its degrees of freedom."""
    experiments = problem.experiments
    assert experiments is not None
    groups: dict[Any, list[int]] = {}
    scenes = experiments.scenes
    for k, pre in enumerate(np.asarray(experiments.pre)):
        # shots in scenes of their own are not repetitions
        groups.setdefault((0 if scenes is None else k, pre.tobytes()), []).append(k)
    conserved, bodies = _conserved(problem), problem.measured.shape[1]
    squares, count = 0.0, 0
    for shots in groups.values():
        blocks = [data.residual[data.shot == k] for k in shots]
        whole = np.array([block for block in blocks if len(block) == bodies])
        if len(whole) == 0:
            continue
        if (whole == whole[0]).all():  # readings that repeat to the last digit: noise is hidden
            whole = whole[:1]
        mean, basis = whole.mean(axis=0), conserved[shots[0]]
        squares += float(np.sum((whole - mean) ** 2))
        squares += len(whole) * float(np.sum((basis.T @ mean) ** 2))
        count += (len(whole) - 1) * bodies + basis.shape[1]
        if experiments.lost_freedom:  # a correction took the momentum of every shot
            count -= len(whole) * basis.shape[1]
    return squares, count


def _conserved(problem: FitProblem) -> list[np.ndarray]:
    """Of every shot the directions (n, c) in which residuals are momentum: orthonormal columns."""
    assert problem.experiments is not None
    bases, mixing = [], problem.residuals.mixing
    balances = problem.experiments.balances(problem.scene)
    for k, ((rows, _, _), w) in enumerate(zip(balances, problem.weight)):
        whole = (w > 0).all() and len(rows)
        back = (rows / w).T if whole else np.zeros((len(w), 0))
        if whole and mixing is not None:
            back = np.linalg.solve(np.asarray(mixing[k], float).T, back)
        bases.append(np.linalg.qr(back)[0])
    return bases


def _reading_variance(problem: FitProblem) -> float:
    """Of readings that were rounded: their last digit squared over 12, in weighted units."""
    values = problem.measured[~np.isnan(problem.measured)]
    largest = np.abs(values).max()
    for digits in range(9):
        if np.abs(values - values.round(digits)).max() <= 1e-9 * largest:
            return float(problem.weight.max()) ** 2 * 10.0 ** (-2 * digits) / 12
    return 0.0


def _pattern(problem: FitProblem, data: Weighted, freedom: int) -> list[str]:
    """Whether the residuals are proportional to the velocities before: by an F test."""
    assert problem.experiments is not None
    pre = np.asarray(problem.experiments.pre, float)
    u, singular, _ = np.linalg.svd(pre, full_matrices=False)
    basis = u[:, singular > 1e-9 * singular[0]]
    body = np.broadcast_to(np.arange(pre.shape[1]), problem.measured.shape)
    body = body[~np.isnan(problem.measured)]
    more = np.hstack([basis[data.shot] * (body == i)[:, None] for i in range(pre.shape[1])])
    residual, known = data.residual.copy(), _range(data.jacobian)
    rest = freedom
    for k, momentum in enumerate(_conserved(problem)):  # no law explains that part
        if momentum.shape[1]:
            rows = data.shot == k
            more[rows] -= momentum @ (momentum.T @ more[rows])
            residual[rows] -= momentum @ (momentum.T @ residual[rows])
            rest -= 0 if problem.experiments.lost_freedom else momentum.shape[1]
    extra = _range(more - known @ (known.T @ more), float(np.linalg.norm(more)))
    rest -= extra.shape[1]
    explained = float(np.sum((extra.T @ residual) ** 2))
    left = float(residual @ residual) - explained
    if rest < _LEAST or left <= 0 or extra.shape[1] == 0:
        return []
    ratio = explained / extra.shape[1] / (left / rest)
    if fdtrc(extra.shape[1], rest, ratio) >= LEVEL:
        return []
    return [
        "Lack of fit: the residuals follow the velocities before the impact (F = "
        f"{ratio:.3g} with {extra.shape[1]} and {rest} degrees of freedom): the law does not fit."
    ]


def _range(matrix: np.ndarray, size: float | None = None) -> np.ndarray:
    """Orthonormal columns that span those of the matrix, but for what is small against `size`."""
    u, singular, _ = np.linalg.svd(matrix, full_matrices=False)
    return u[:, singular > _RANGE * (singular[0] if size is None else size)]


def _shots_of(data: Weighted) -> np.ndarray:
    """The shots that have residuals."""
    return np.unique(data.shot[data.shot != NO_SHOT])


def _contradicted_priors(problem: FitProblem, data: Weighted) -> list[Finding]:
    """Priors that the data, fitted without them, would not expect: each against N(0, 1)."""
    known = _range(data.jacobian)
    found = []
    for row, prior in zip(np.flatnonzero(data.shot == NO_SHOT), problem.priors):
        left = 1 - float(known[row] @ known[row])  # variance of the residual; 0: the prior decides
        if left <= _RANGE:
            continue
        far = float(abs(data.residual[row]) / np.sqrt(left))
        if chdtrc(1, far**2) < LEVEL / len(problem.priors):
            name = problem.names[prior.parameter]
            found.append(
                Finding(
                    f"The data contradict the prior {name} = {prior.mean:g} ± {prior.std:g}: what "
                    f"they say without it is {far:.2g} standard errors off.",
                    f"the prior of {name} contradicts the data",
                )
            )
    return found


def _suspicious(problem: FitProblem, data: Weighted, freedom: int, robust: bool) -> list[Finding]:
    """Shots that the others, fitted without them, would not expect."""
    assert problem.experiments is not None
    labels = problem.experiments.shots
    shots = _shots_of(data)
    find = _beyond_median if robust else _beyond_others
    suspects = [
        (squares, labels[k])
        for k, squares, chance in find(problem, data, freedom)
        if squares > 0 and chance < LEVEL / len(shots)
    ]
    count = len(shots)
    if not suspects:
        return []
    advice = "" if robust else ", or fit with loss='huber'"
    worst = ", ".join(label for _, label in sorted(suspects, reverse=True)[:_LISTED])
    more = f" and {len(suspects) - _LISTED} more" if len(suspects) > _LISTED else ""
    several = len(suspects) > 1
    return [
        Finding(
            f"Suspicious: shot{'s' * several} {worst}{more}, which the others do not "
            f"expect (of {count}); look there for errors{advice}.",
            f"shot{'s' * several} {worst}{more} {'are' if several else 'is'} suspicious",
        )
    ]


_Chances = list[tuple[int, float, float]]  # shot, its sum of squares, how often it is as large


def _beyond_others(problem: FitProblem, data: Weighted, freedom: int) -> _Chances:
    """Every shot against the noise of the others: F tests."""
    known, reading = _range(data.jacobian), _reading_variance(problem)
    total = float(data.residual @ data.residual)
    found: _Chances = []
    for k in _shots_of(data):
        rows = data.shot == k
        r, q, n = data.residual[rows], known[rows], int(rows.sum())
        rest = freedom - n
        if rest < _LEAST:
            return []
        squares = float(r @ np.linalg.lstsq(np.eye(n) - q @ q.T, r, rcond=1e-9)[0])
        noise = max(total - squares, 0.0) / rest + reading
        if problem.sigma is not None:
            noise = max(noise, 1.0)
        chance = 0.0 if noise == 0 else float(fdtrc(n, rest, squares / n / noise))
        found.append((int(k), squares, chance))
    return found


def _beyond_median(problem: FitProblem, data: Weighted, freedom: int) -> _Chances:
    """Every shot against the median residual, which many outliers together do not hide in."""
    rest = MEDIAN_FREEDOM * freedom
    if rest < _LEAST:
        return []
    scale = MEDIAN * float(np.median(np.abs(data.residual)))
    noise = scale**2 * len(data.residual) / freedom + _reading_variance(problem)
    if problem.sigma is not None:
        noise = max(noise, 1.0)
    found: _Chances = []
    for k in _shots_of(data):
        r = data.residual[data.shot == k]
        squares = float(r @ r)
        chance = 0.0 if noise == 0 else float(fdtrc(len(r), rest, squares / len(r) / noise))
        found.append((int(k), squares, chance))
    return found
