"""What is wrong with data or a fit: rows of a test and the sentence that it puts into the report.

Every law leaves a momentum unchanged that the contacts cannot change, and predicts the same for
shots that began alike: residuals in these directions are noise. The other residuals are compared
with it, or with the stated sigma.
"""

import functools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.special import chdtrc, fdtrc, ndtri, stdtr

from jimpact.files.records import listed
from jimpact.fits.data import ROUNDING, Experiments, closed_normals, kept_by_corrections
from jimpact.fits.matrices import boundary, encloses
from jimpact.fits.problem import UNUSABLE, FitProblem, Shots
from jimpact.fits.search import Solution
from jimpact.fits.solve import RANK_TOLERANCE
from jimpact.fits.uncertainty import Uncertainty
from jimpact.laws.kinematic import RestitutionMatrix
from jimpact.scene import Scene, dense_mass
from jimpact.status import STATUS

# ------------------------------------------------------------------ thresholds of the data
# Defects below this share of the momentum or energy before are not reported: a good measurement of
# a velocity is accurate to a tenth of a percent. Ten times more would hide defects of a percent.
DEFECT_TOLERANCE = 1e-3
# With `sigma`, a defect is reported beyond this many of its standard errors, ...
DEFECT_SIGMAS = 3.0
# ... or beyond more, so that all shots together show one by chance at most this often.
DEFECT_LEVEL = 0.02
# Beyond this share of the momentum or energy before, in half of the shots or more, a defect needs
# no test: no noise of a useful measurement is as large, but a wrong unit is. With ten times more, a
# factor of 3.6 (km/h) in two shots would go unseen.
GROSS = 0.5
# Factors that a wrong unit leaves in velocities: cm/s or mm/s for m/s, km/h, a decimal slip. A
# median ratio of velocities within UNIT_NEAR of one (or of its inverse) is reported. Ten times
# nearer, and noise of a percent would hide it.
UNIT_FACTORS, UNIT_NEAR = {10.0: "a decimal point", 100.0: "cm/s", 1000.0: "mm/s", 3.6: "km/h"}, 0.1

# ------------------------------------------------------------------ thresholds of the fit
LEVEL = 0.01  # of each test: how often it flags data that the law itself made
_LEAST = 3  # degrees of freedom of the noise too few to test against
_LISTED = 6  # shots named one by one (with their ratios); of more, how many there are
MEDIAN = 1.4826  # sigma of a normal distribution over the median of its absolute values
# A median of absolute values is as uncertain as a standard deviation of this share of the values
# (Huber, 1981). Ten times more would make honest shots of small sets suspicious.
MEDIAN_FREEDOM = 0.37
# Largest derivative of a velocity, over the largest velocity and a natural step of a parameter (as
# far as from 0 to 1 for a restitution): those beyond are errors and would shorten every step.
ABSURD = 1e3
# Minima whose sums of squares differ by less than this many noise variances fit equally well:
# the difference is what moving by one standard error costs.
EQUALLY_GOOD = 1.0
NO_SHOT = -1  # the place of a shot where a value belongs to none: a prior


class Finding(NamedTuple):
    """A line of the warnings, and what a sentence that quotes the fit has to say about it."""

    line: str
    reservation: str = ""


class Check(NamedTuple):
    """A row: its test yields the numbers of each finding, for the sentences to format."""

    test: Callable[[Any], Iterable[dict[str, Any]]]
    sentence: str
    reservation: str = ""


def findings(rows: Sequence[Check], judged: Any) -> list[Finding]:
    """What the tests of these rows find, in words."""
    return [
        Finding(row.sentence.format(**each), row.reservation.format(**each))
        for row in rows
        for each in row.test(judged)
    ]


def share(count: int, total: int) -> str:
    """So many of all shots, in words.

    >>> from jimpact.fits.checks import share
    >>> share(1, 1), share(6, 6), share(2, 6)
    ('this shot', 'all 6 shots', '2 of 6 shots')
    """
    if count == total < 3:
        return "this shot" if total == 1 else "both shots"
    return f"all {total} shots" if count == total else f"{count} of {total} shots"


# ------------------------------------------------------------------ what the data break


class _Defect(NamedTuple):
    """By how much a balance of the k-th shot fails, its scale, the momentum or energy before,
    derivatives in v+ (and v-), their errors, a ratio."""

    k: int
    excess: float
    scale: float
    before: float
    slope: np.ndarray
    sigma: np.ndarray | None
    ratio: float


class _Data:
    """Measured shots with the balances of each."""

    def __init__(self, experiments: Experiments, scene: Scene | None, stored_energy: float):
        self.experiments, self.scene, self.stored_energy = experiments, scene, stored_energy
        self.total = len(experiments.shots)
        self.momenta: dict[int, list[_Defect]] = {}  # by the momentum that is conserved
        self.energies: list[_Defect] = []
        self.resting: list[int] = []  # shots in which no contact approaches
        errors = None if experiments.sigma is None else np.asarray(experiments.sigma, float)
        if errors is not None and experiments.sigma_pre is not None:
            errors = np.hstack([errors, np.asarray(experiments.sigma_pre, float)])
        normals, masses = (experiments.each(scene, f) for f in (closed_normals, dense_mass))
        for k, (rows, pre, post) in enumerate(experiments.balances(scene)):
            slowest = -ROUNDING * np.abs(normals[k]).T @ np.abs(pre)
            if stored_energy == 0 and (normals[k].T @ pre >= slowest).all():
                self.resting.append(k)
            if not np.isnan(post).any():
                self._judge(k, rows, pre, post, masses[k], None if errors is None else errors[k])

    def _judge(
        self, k: int, rows: Any, pre: Any, post: Any, mass: np.ndarray, sigma: np.ndarray | None
    ) -> None:
        """Momentum and energy of a shot before and after."""
        used = slice(len(post) if sigma is None else len(sigma))
        for j, row in enumerate(rows):
            excess, scale, before = row @ (post - pre), np.abs(row) @ np.abs(pre), row @ pre
            back = before < -ROUNDING * scale
            ratio = 1 + (-excess if back else excess) / scale if scale else np.inf
            slope = np.append(row, -row)[used]
            defect = _Defect(k, excess, scale, before, slope, sigma, ratio)
            self.momenta.setdefault(j, []).append(defect)
        t_minus, t_plus = 0.5 * pre @ mass @ pre, 0.5 * post @ mass @ post
        gain = t_plus - t_minus - self.stored_energy
        slope = np.append(mass @ post, -mass @ pre)[used]
        ratio = t_plus / t_minus if t_minus > 0 else np.nan
        self.energies.append(_Defect(k, gain, t_minus, t_minus, slope, sigma, ratio))

    def listed(self, ratios: dict[int, float]) -> dict[str, Any]:
        """Shots with their ratios, or the range of the ratios of many."""
        shots = self.experiments.shots
        text = ", ".join(f"shot {shots[k]}: {r:.4f}" for k, r in ratios.items())
        if len(ratios) > _LISTED:
            values = list(ratios.values())
            text = f"{len(values)} of {self.total} shots, {min(values):.4f} to {max(values):.4f}"
        return {"shots": text, "share": share(len(ratios), self.total)}


def _units(data: _Data) -> Iterable[dict[str, Any]]:
    """Whether velocities after are those before but for a factor that a wrong unit leaves.

    By the momentum that is conserved; where none is, by the energy where it grows.
    """
    ratios = [d.ratio for each in data.momenta.values() for d in each]
    gains = [np.sqrt(d.ratio) for d in data.energies if d.ratio > 1]
    what, values = ("momentum", ratios) if ratios else ("root of the energy", gains)
    if not values or len(values) < 0.5 * max(len(ratios), len(data.energies)):
        return
    ratio = float(np.median(values))
    for factor, unit in UNIT_FACTORS.items():
        near = (factor, 1 / factor) if what == "momentum" else (factor,)
        if any(abs(ratio / value - 1) < UNIT_NEAR for value in near):
            yield {"what": what, "ratio": ratio, "unit": unit}
            return


def _momentum(data: _Data) -> Iterable[dict[str, Any]]:
    """Shots that break a momentum beyond their noise, and the rms that this alone leaves."""
    level = DEFECT_LEVEL / max(len(data.momenta), 1)
    ratios = {k: r for each in data.momenta.values() for k, r in _beyond(each, level).items()}
    if not ratios:
        return
    floor, experiments = "", data.experiments
    if experiments.sigma is None:
        corrected = experiments.momentum_corrected(data.scene)
        change = np.asarray(experiments.post) - np.asarray(corrected.post)
        floor = f" (rms {np.sqrt(np.nanmean(change**2)):.3g} m/s)"
    yield data.listed(ratios) | {"floor": floor}


def _energy(data: _Data) -> Iterable[dict[str, Any]]:
    """Shots that gain energy beyond their noise."""
    ratios = _beyond(data.energies, DEFECT_LEVEL, gains=True)
    return [data.listed(ratios)] if ratios else []


def _resting(data: _Data) -> Iterable[dict[str, Any]]:
    """Shots in which no contact approaches."""
    count = len(data.resting)
    if count:
        labels = listed([data.experiments.shots[k] for k in data.resting])
        which = share(count, data.total)
        yield {"count": count, "total": data.total, "labels": labels, "share": which}


def _copies(data: _Data) -> Iterable[dict[str, Any]]:
    """Whether most shots of a scene are one, several times or scaled, with no sigma."""
    experiments = data.experiments
    if experiments.scenes is not None or experiments.sigma is not None:
        return
    rows = np.hstack([np.asarray(experiments.pre, float), np.asarray(experiments.post, float)])
    size = np.sqrt(np.nansum(rows**2, axis=1, keepdims=True))
    unit = np.nan_to_num(rows / np.where(size > 0, size, 1.0), nan=np.inf)
    # what more than half have in common is the median
    same = np.isclose(unit, np.median(unit, axis=0), rtol=0, atol=ROUNDING).all(axis=1)
    count, total = int(same.sum()), data.total
    if 2 * count > total > 1:
        which, some = f"All {total}", "the"
        if count < total:
            which, some = f"{count} of {total}", f"{count} of"
        yield {"which": which, "some": some, "total": total}


DATA_ROWS = (
    Check(
        _units,
        "Units? The {what} after is {ratio:.3g} times that before: {unit} in one of the columns?",
        "the units are suspect",
    ),
    Check(
        _momentum,
        "The data violate conservation of momentum (1 = conserved): {shots}; no law can reproduce "
        "that part{floor}.",
        "the data violate conservation of momentum in {share}",
    ),
    Check(
        _energy,
        "The data gain energy (1 = conserved): {shots}.",
        "kinetic energy grows in {share}",
    ),
    Check(
        _resting,
        "No contact approaches in {count} of {total} shots ({labels}): are pre and post swapped, "
        "or is a sign wrong?",
        "no contact approaches in {share}",
    ),
    Check(
        _copies,
        "{which} shots are equal to the last digit, but for a factor: they carry no more "
        "information than one of them, and none on the noise; without `sigma` or `resolution` the "
        "errors are meaningless.",
        "{some} {total} shots are copies of one",
    ),
)


def data_defects(
    experiments: Experiments, scene: Scene | None = None, stored_energy: float = 0.0
) -> list[str]:
    """What the data break beyond their error, a line each: momentum, energy, approach; copies.

    Momentum is reported as `1 + excess / sum |m v-|`, the excess in the direction of the momentum
    before: after over before where all bodies move one way. Without `sigma` the shots show their
    noise: a defect is one that they have in common, the same excess or the same share of the
    momentum before, whichever way that points (t tests), or one of half of the momentum in half of
    the shots; of a single shot any above a tenth of a percent.

    Args:
        experiments: the shots; those with missing values are not judged.
        scene: the common scene, None where the shots carry their own.
        stored_energy: what the law may add to the energy (precompression) [J].

    >>> import jimpact as ji
    >>> from jimpact.fits.checks import data_defects
    >>> data_defects(ji.Experiments([1.0, 0.0], [0.0, 1.2]), ji.chain([1.0, 1.0]))[1]
    'The data gain energy (1 = conserved): shot 1: 1.4400.'
    """
    data = _Data(experiments, scene, stored_energy)
    return [found.line for found in findings(DATA_ROWS, data)]


def _beyond(defects: list[_Defect], level: float, gains: bool = False) -> dict[int, float]:
    """Ratios of the shots whose balance fails by more than their noise; gains: upwards only."""
    size = np.array([d.excess if gains else abs(d.excess) for d in defects])
    if any(d.sigma is not None for d in defects):
        sigmas = max(DEFECT_SIGMAS, float(ndtri(1 - 0.5 * level / len(defects))))
        limit = [np.linalg.norm(d.slope * d.sigma) for d in defects]
        return {d.k: d.ratio for d, x, y in zip(defects, size, limit) if x > sigmas * y}
    scale = np.array([d.scale for d in defects])
    flagged = {d.k: d.ratio for d, x in zip(defects, size > DEFECT_TOLERANCE * scale) if x}
    if len(defects) < 2 or not flagged or np.mean(size > GROSS * scale) >= 0.5:
        return flagged
    weight = np.array([1 / np.linalg.norm(d.slope) if d.slope.any() else 0.0 for d in defects])
    excess = weight * [d.excess for d in defects]
    shapes = [np.sign(weight), weight * [d.before for d in defects]]
    chances = [_chance(excess[weight > 0], shape[weight > 0], gains) for shape in shapes]
    return flagged if min(chances) < level / len(shapes) else {}


def _chance(excess: np.ndarray, shape: np.ndarray, gains: bool) -> float:
    """How often noise alone follows a shape as much: Student's t; 1 where it cannot be judged."""
    squares, freedom = float(shape @ shape), len(excess) - 1
    if freedom < 1 or squares == 0:
        return 1.0
    part = float(shape @ excess) / squares
    rest = float(np.sum((excess - part * shape) ** 2))
    error = np.sqrt(rest / freedom / squares)
    t = part / error if error else np.inf * np.sign(part)
    above = float(stdtr(freedom, -t))
    return above if gains else 2 * min(above, 1 - above)


# ------------------------------------------------------------------ what the residuals show


class Weighted(NamedTuple):
    """Residuals (R,) of the measured values in units of sigma, derivatives (R, P), shots (R,).

    Those of the priors come last, their shot is `NO_SHOT`.
    """

    residual: np.ndarray
    jacobian: np.ndarray
    shot: np.ndarray

    @property
    def squares(self) -> float:
        """The sum of squared residuals."""
        return float(self.residual @ self.residual)

    @property
    def shots(self) -> np.ndarray:
        """The shots that have residuals."""
        return np.unique(self.shot[self.shot != NO_SHOT])


def weighted(problem: FitProblem, solution: Solution) -> Weighted:
    """Residuals and derivatives as the tests need them."""
    minimum, here = solution.minima[0], ~np.isnan(problem.measured).ravel()
    shot = np.append(problem.shot_of_value, np.full(len(problem.priors), NO_SHOT))
    used = np.append(here, np.ones(len(problem.priors), bool))
    # where the law fails, what a search takes for the residual is no error
    errors = problem.independent(problem.measured - solution.predicted)
    residual = np.append(errors, -minimum.residual[errors.size :])
    return Weighted(residual[used], minimum.jacobian[used], shot)


def unusable(problem: FitProblem, solution: Solution) -> np.ndarray:
    """Shots (K,) whose impacts fail, or whose derivatives are not finite or absurdly large."""
    if not isinstance(problem.observe, Shots):
        return np.zeros(1, bool)
    slope = np.abs(problem.of_data(solution.jacobian))
    allowed = ABSURD * float(problem.unit) * np.asarray(problem.weight, float)[..., None]
    fails = [STATUS[code].name in UNUSABLE for code in solution.status]
    used = ~np.isnan(problem.measured).all(axis=1)
    return used & (np.array(fails) | ~(slope <= allowed).all(axis=(1, 2)))


def stretch(problem: FitProblem, data: Weighted, rank: int) -> float:
    """By how much errors are larger than stated, 1 where chi^2 does not reject them.

    Equation: `sqrt(chi^2 / freedom)`, of all residuals, or of those that are not momentum if that
    is more: the errors of a law or its parameters are in these.
    """
    squares, freedom = data.squares, problem.values - rank
    tests = [(squares, freedom)]
    if problem.experiments is not None and not problem.experiments.lost_freedom:
        for k, basis in enumerate(_conserved(problem)):
            if basis.shape[1]:
                squares -= float(np.sum((basis.T @ data.residual[data.shot == k]) ** 2))
                freedom -= basis.shape[1]
        tests.append((max(squares, 0.0), freedom))
    rejected = [s / f for s, f in tests if f > 0 and chdtrc(f, s) < LEVEL]
    return float(np.sqrt(max(rejected, default=1.0)))


def _conserved(problem: FitProblem) -> list[np.ndarray]:
    """Of every shot the directions (n, c) in which residuals are momentum: orthonormal columns."""
    assert problem.experiments is not None
    bases, balances = [], problem.experiments.balances(problem.scene)
    for k, ((rows, _, _), w) in enumerate(zip(balances, np.asarray(problem.weight, float))):
        whole = (w > 0).all() and len(rows)
        back = (rows / w).T if whole else np.zeros((len(w), 0))
        if whole and problem.mixing is not None:
            back = np.linalg.solve(np.asarray(problem.mixing[k], float).T, back)
        bases.append(np.linalg.qr(back)[0])
    return bases


def _noise(problem: FitProblem, data: Weighted) -> tuple[float, int]:
    """Sum of squares that no law can change, and its degrees of freedom."""
    experiments = problem.experiments
    assert experiments is not None
    groups: dict[Any, list[int]] = {}
    for k, pre in enumerate(np.asarray(experiments.pre)):
        # shots in scenes of their own are not repetitions
        groups.setdefault((0 if experiments.scenes is None else k, pre.tobytes()), []).append(k)
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


def _reading_variance(problem: FitProblem) -> float:
    """Of readings that were rounded: their last digit squared over 12, in weighted units."""
    values = np.asarray(problem.measured, float)[~np.isnan(problem.measured)]
    largest = np.abs(values).max()
    for digits in range(9):
        if np.abs(values - values.round(digits)).max() <= ROUNDING * largest:
            return float(problem.weight.max()) ** 2 * 10.0 ** (-2 * digits) / 12
    return 0.0


def _range(problem: FitProblem, matrix: np.ndarray, size: float | None = None) -> np.ndarray:
    """Orthonormal columns that span those of the matrix, but for what is small against `size`."""
    u, singular, _ = np.linalg.svd(matrix, full_matrices=False)
    size = singular[0] if size is None else size
    return u[:, singular > RANK_TOLERANCE[problem.precision] * size]


# ------------------------------------------------------------------ what is wrong with the fit


@dataclass(frozen=True)
class _Judged:
    """A fit before it is reported."""

    problem: FitProblem
    solution: Solution
    errors: Uncertainty
    robust: bool

    @functools.cached_property
    def residuals(self) -> Weighted:
        """As the tests need them."""
        return weighted(self.problem, self.solution)

    @property
    def freedom(self) -> int:
        """Degrees of freedom."""
        return self.errors.degrees_of_freedom

    @property
    def inexact(self) -> bool:
        """Whether there are residuals to test."""
        return self.freedom >= 1 and self.residuals.squares > self.problem.exact_squares

    @property
    def shows_noise(self) -> bool:
        """Whether residuals have to show the noise: those of shots without sigma."""
        problem = self.problem
        return self.inexact and problem.sigma is None and problem.experiments is not None


def _left_out(judged: _Judged) -> Iterable[dict[str, Any]]:
    """Shots that were left out."""
    for line in judged.problem.left_out:
        yield {"line": line, "count": line.removeprefix("Left out: ").split(" (")[0]}


def _unknown_corrections(judged: _Judged) -> Iterable[dict[str, Any]]:
    """Shots with `sigma_pre` and a correction that is not that of momentum."""
    data = judged.problem.experiments
    if data is None or data.sigma_pre is None:
        return
    kept = kept_by_corrections(data, judged.problem.scene)
    unknown = [data.shots[k] for k, one in enumerate(kept) if data.lost[k] and one is None]
    if unknown:
        yield {"shots": listed(unknown)}


def _statuses(judged: _Judged) -> Iterable[dict[str, Any]]:
    """The shots in which the fitted law fails."""
    data, status = judged.problem.experiments, judged.solution.status
    for code in np.unique(status) if data is not None else ():
        if STATUS[code].failure:
            labels = [data.shots[k] for k in np.flatnonzero(status == code)]  # type: ignore[union-attr]
            count = f"{len(labels)} of {len(status)} shots ({listed(labels)})"
            yield {"count": count, "name": STATUS[code].name, "message": STATUS[code].message}


def _edges(judged: _Judged) -> Iterable[dict[str, Any]]:
    """Conditions on a restitution matrix that it ends at."""
    problem = judged.problem
    edges = boundary(problem.matrix, problem.point(judged.solution.value))
    return [{"edges": "; ".join(edges)}] if edges else []


def _unbound_matrix(judged: _Judged) -> Iterable[dict[str, Any]]:
    """A restitution matrix that need not be consistent."""
    law, data = judged.problem.law, judged.problem.experiments
    if data is None or not isinstance(law, RestitutionMatrix):
        return []
    contacts = data.largest_scene(judged.problem.scene).contacts
    return [] if encloses(law, contacts) else [{}]


def _not_finite(judged: _Judged) -> Iterable[dict[str, Any]]:
    """Which values of a user's own function are not finite at the fitted parameters."""
    problem = judged.problem
    lost = np.isfinite(problem.measured) & ~np.isfinite(judged.solution.predicted)
    if problem.experiments is None and lost.any():
        which, values = np.flatnonzero(lost), problem.values - len(problem.priors)
        yield {"count": len(which), "total": values, "which": listed([str(i + 1) for i in which])}


def _beyond_sigma(judged: _Judged) -> Iterable[dict[str, Any]]:
    """Residuals larger than sigma allows."""
    if not judged.inexact or judged.problem.sigma is None:
        return
    times = stretch(judged.problem, judged.residuals, judged.errors.rank)
    if times > 1:
        how = "are those of the loss" if judged.robust else "are stretched by that"
        squares, freedom = judged.residuals.squares, judged.freedom
        yield {"times": times, "squares": squares, "freedom": freedom, "how": how}


def _beyond_noise(judged: _Judged) -> Iterable[dict[str, Any]]:
    """What the law leaves over, against the noise of momentum and of repeated shots."""
    problem, data = judged.problem, judged.residuals
    if not judged.shows_noise:
        return
    noise, count = _noise(problem, data)
    rest = judged.freedom - count
    if count < _LEAST or rest < 1:
        return
    left = max(data.squares - noise, 0.0)
    ratio = left / rest / max(noise / count, _reading_variance(problem))
    if fdtrc(rest, count, ratio) < LEVEL:
        yield {"times": np.sqrt(ratio), "rest": rest, "count": count}


def _pattern(judged: _Judged) -> Iterable[dict[str, Any]]:
    """Whether the residuals are proportional to the velocities before: by an F test."""
    problem, data, rest = judged.problem, judged.residuals, judged.freedom
    if not judged.shows_noise or list(_beyond_noise(judged)):  # which says enough
        return
    assert problem.experiments is not None
    pre = np.asarray(problem.experiments.pre, float)
    u, singular, _ = np.linalg.svd(pre, full_matrices=False)
    basis = u[:, singular > ROUNDING * singular[0]]
    body = np.broadcast_to(np.arange(pre.shape[1]), problem.measured.shape)
    body = body[~np.isnan(problem.measured)]
    more = np.hstack([basis[data.shot] * (body == i)[:, None] for i in range(pre.shape[1])])
    residual, known = data.residual.copy(), _range(problem, data.jacobian)
    for k, momentum in enumerate(_conserved(problem)):  # no law explains that part
        if momentum.shape[1]:
            rows = data.shot == k
            more[rows] -= momentum @ (momentum.T @ more[rows])
            residual[rows] -= momentum @ (momentum.T @ residual[rows])
            rest -= 0 if problem.experiments.lost_freedom else momentum.shape[1]
    extra = _range(problem, more - known @ (known.T @ more), float(np.linalg.norm(more)))
    count = extra.shape[1]
    rest -= count
    explained = float(np.sum((extra.T @ residual) ** 2))
    left = float(residual @ residual) - explained
    if rest < _LEAST or left <= 0 or count == 0:
        return
    ratio = explained / count / (left / rest)
    if fdtrc(count, rest, ratio) < LEVEL:
        yield {"ratio": ratio, "count": count, "rest": rest}


def _contradicted_priors(judged: _Judged) -> Iterable[dict[str, Any]]:
    """Priors that the data, fitted without them, would not expect: each against N(0, 1)."""
    problem, data = judged.problem, judged.residuals
    if not judged.inexact:
        return
    known = _range(problem, data.jacobian)
    for row, prior in zip(np.flatnonzero(data.shot == NO_SHOT), problem.priors):
        left = 1 - float(known[row] @ known[row])  # variance of the residual; 0: the prior decides
        if left <= RANK_TOLERANCE[problem.precision]:
            continue
        far = float(abs(data.residual[row]) / np.sqrt(left))
        if chdtrc(1, far**2) < LEVEL / len(problem.priors):
            name = problem.names[prior.parameter]
            yield {"name": name, "mean": prior.mean, "std": prior.std, "far": far}


def _suspicious(judged: _Judged) -> Iterable[dict[str, Any]]:
    """Shots that the others, fitted without them, would not expect."""
    if not judged.inexact or judged.problem.experiments is None:
        return
    labels, count = judged.problem.experiments.shots, len(judged.residuals.shots)
    suspects = [
        (squares, labels[k])
        for k, squares, chance in _against_others(judged)
        if squares > 0 and chance < LEVEL / count
    ]
    if not suspects:
        return
    worst = ", ".join(label for _, label in sorted(suspects, reverse=True)[:_LISTED])
    worst += f" and {len(suspects) - _LISTED} more" if len(suspects) > _LISTED else ""
    several = len(suspects) > 1
    yield {
        "shots": f"shot{'s' * several} {worst}",
        "are": "are" if several else "is",
        "count": count,
        "advice": "" if judged.robust else ", or fit with loss='huber'",
    }


def _against_others(judged: _Judged) -> Iterable[tuple[int, float, float]]:
    """Every shot, its sum of squares, how often the noise of the others is as large: F tests.

    The others are fitted without it; after a robust loss their noise is that of the median
    residual, which many outliers together do not hide in. `sigma`, if known, is the least noise.
    """
    problem, data, freedom = judged.problem, judged.residuals, judged.freedom
    known, reading = _range(problem, data.jacobian), _reading_variance(problem)
    median = MEDIAN * float(np.median(np.abs(data.residual)))
    for k in data.shots:
        rows = data.shot == k
        r, q, n = data.residual[rows], known[rows], int(rows.sum())
        rest = MEDIAN_FREEDOM * freedom if judged.robust else freedom - n
        if rest < _LEAST:
            continue
        if judged.robust:
            squares, noise = float(r @ r), median**2 * len(data.residual) / freedom
        else:
            squares = float(r @ np.linalg.lstsq(np.eye(n) - q @ q.T, r, rcond=1e-9)[0])
            noise = max(data.squares - squares, 0.0) / rest
        noise = max(noise + reading, 0.0 if problem.sigma is None else 1.0)
        yield int(k), squares, float(fdtrc(n, rest, squares / n / noise)) if noise else 0.0


def _at_bounds(judged: _Judged) -> Iterable[dict[str, Any]]:
    """Parameters at a bound."""
    for i in np.flatnonzero(judged.solution.at_bound):
        value = judged.solution.value[i]
        upper = value >= judged.problem.domains[i, 1]
        end, towards = ("upper", "smaller") if upper else ("lower", "larger")
        yield {"name": judged.problem.names[i], "end": end, "value": value, "towards": towards}


def _undetermined(judged: _Judged) -> Iterable[dict[str, Any]]:
    """Fewer parameters determined than fitted."""
    rank, count = judged.errors.rank, len(judged.problem.names)
    return [{"rank": rank, "count": count}] if rank < count else []


def _equally_good(judged: _Judged) -> Iterable[dict[str, Any]]:
    """Several minima that fit as well as the best."""
    problem, minima = judged.problem, judged.solution.minima
    noise = judged.errors.noise if np.isfinite(judged.errors.noise) else 0.0
    more = max(EQUALLY_GOOD * noise**2, problem.exact_squares)
    several = sum(end.sum_of_squares <= minima[0].sum_of_squares + more for end in minima)
    return [{"several": several}] if several > 1 and not _undetermined(judged) else []


def _when(condition: Callable[[_Judged], Any]) -> Callable[[_Judged], Iterable[dict[str, Any]]]:
    """A test that yields no numbers."""
    return lambda judged: [{}] if condition(judged) else []


FIT_ROWS = (
    Check(
        _unknown_corrections,
        "The fit weighs shots {shots} as if they were not corrected: they have `lost_freedom`, but "
        "do not conserve momentum, so that the errors that `sigma_pre` leaves in them are unknown; "
        "chi^2 and standard errors are approximate.",
    ),
    Check(
        _when(lambda judged: judged.solution.stuck),
        "The minimum is a kink of the law (the sequence of contacts changes there, or its "
        "derivatives are wrong): standard errors do not hold.",
    ),
    Check(
        _when(lambda judged: not judged.solution.converged),
        "The fit has not converged: allow more `max_steps`, `starts` or time (`limit`).",
    ),
    Check(_statuses, "The fitted law fails in {count}: {name}, {message}."),
    Check(
        _edges,
        "The matrix ends at the edge of the admissible ones ({edges}): the errors hold for the "
        "side inside.",
    ),
    Check(
        _unbound_matrix,
        "Nothing keeps this matrix consistent for other approach velocities than the measured: the "
        "conditions are for (m, m) matrices with admissible=True.",
    ),
    Check(
        _not_finite,
        "The fitted law fails in {count} of {total} values ({which}): they are not finite there "
        "and count as large errors.",
    ),
    Check(
        _beyond_sigma,
        "Lack of fit: the residuals are {times:.2g} times what sigma allows (chi^2 = {squares:.4g} "
        "with {freedom} degrees of freedom): the law or the stated errors are wrong, or the "
        "parameters scatter; the standard errors {how}.",
    ),
    Check(
        _beyond_noise,
        "Lack of fit: the residuals are {times:.2g} times the noise that momentum and repeated "
        "shots show ({rest} and {count} degrees of freedom): the law does not fit, and the "
        "standard errors mean little.",
    ),
    Check(
        _pattern,
        "Lack of fit: the residuals follow the velocities before the impact (F = {ratio:.3g} with "
        "{count} and {rest} degrees of freedom): the law does not fit.",
    ),
    Check(
        _contradicted_priors,
        "The data contradict the prior {name} = {mean:g} ± {std:g}: what they say without it is "
        "{far:.2g} standard errors off.",
        "the prior of {name} contradicts the data",
    ),
    Check(
        _suspicious,
        "Suspicious: {shots}, which the others do not expect (of {count}); look there for "
        "errors{advice}.",
        "{shots} {are} suspicious",
    ),
    Check(
        _when(
            lambda judged: (
                judged.problem.experiments is not None
                and judged.problem.sigma is None
                and len(set(judged.problem.experiments.units)) > 1
            )
        ),
        "Without sigma, velocities in rad/s weigh like those in m/s of the same kinetic energy.",
    ),
    Check(
        _at_bounds,
        "{name} is at its {end} bound {value:g}; its standard error only holds towards {towards} "
        "values.",
    ),
    Check(
        _undetermined,
        "The data determine {rank} of {count} parameters (rank {rank} of {count}); the values "
        "given are one choice of many.",
    ),
    Check(_equally_good, "{several} different minima fit equally well: see the starts."),
    Check(
        _when(lambda judged: judged.freedom < 1 and judged.problem.sigma is None),
        "No degree of freedom is left to estimate the noise: errors are unknown without sigma.",
    ),
    Check(
        _when(
            lambda judged: (
                judged.freedom >= 1
                and judged.problem.sigma is None
                and judged.solution.minima[0].sum_of_squares <= judged.problem.exact_squares
            )
        ),
        "The data are reproduced to the last digit and do not show their noise: errors are unknown "
        "without `sigma` or `resolution`.",
    ),
    Check(
        _when(lambda judged: judged.problem.precision == "float32"),
        "Computed in float32: values are good to about 1e-3, and the rank is judged coarsely. "
        'jax.config.update("jax_enable_x64", True) gives float64.',
    ),
)


def fit_warnings(
    problem: FitProblem, solution: Solution, errors: Uncertainty, robust: bool
) -> list[Finding]:
    """All warnings, those about the data first."""
    judged, data = _Judged(problem, solution, errors, robust), problem.experiments
    found = findings([Check(_left_out, "{line}", "{count} are left out")], judged)
    if data is not None:
        contacts = data.largest_scene(problem.scene).contacts
        stored = float(np.sum(np.broadcast_to(np.asarray(problem.law.stored), contacts)))
        found += findings(DATA_ROWS, _Data(data, problem.scene, stored))
    return found + findings(FIT_ROWS, judged)
