"""What is wrong with a fit: tests, each with the sentence that it puts into the report.

Every law leaves a momentum unchanged that the contacts cannot change, and predicts the same for
shots that began alike: residuals in these directions are noise. The other residuals are compared
with it, or with the stated sigma.
"""

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from scipy.sparse import block_diag, coo_array
from scipy.special import chdtrc, fdtrc

from jimpact.core.law import free_parameters_of
from jimpact.fits.data import ROUNDING, kept_by_corrections
from jimpact.fits.data_checks import DATA_CHECKS, LISTED, DataBalances
from jimpact.fits.findings import Finding, findings
from jimpact.fits.matrices import boundary, encloses
from jimpact.fits.observables import UNUSABLE, Shots
from jimpact.fits.problem import FitProblem
from jimpact.fits.search import MEDIAN, Solution
from jimpact.fits.solve import RANK_TOLERANCE
from jimpact.fits.uncertainty import uncertainty
from jimpact.laws.kinematic import RestitutionMatrix
from jimpact.tools.records import counted, degrees, listed
from jimpact.tools.status import STATUS

# ------------------------------------------------------------------ thresholds of the fit
LEVEL = 0.01  # of each test: how often it flags data that the law itself made
_LEAST = 3  # degrees of freedom of the noise too few to test against
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


# ------------------------------------------------------------------ what the residuals show


class Judged:
    """A fit before it is reported, with its residuals as the tests need them.

    Attributes:
        residual: (R,) of the measured values in units of sigma, those of the priors last.
        jacobian: (R, P) derivatives.
        shot: (R,) shots, `NO_SHOT` of priors; `shots`: those that have residuals.
        squares: the sum of squared residuals.
        stretch: by how much errors are larger than stated, 1 where chi^2 does not reject them.
        errors: of the parameters; with known errors of the data wider where the law does not fit.
        freedom: degrees of freedom.
    """

    def __init__(self, problem: FitProblem, solution: Solution, loss_noise: float | None):
        """`loss_noise`: noise times the root of the degrees of freedom, of a robust loss."""
        self.problem, self.solution, self.robust = problem, solution, loss_noise is not None
        minimum, here = solution.starts[0], ~np.isnan(problem.measured).ravel()
        of_value = np.nonzero(~np.isnan(np.atleast_1d(problem.measured)))[0]
        self.shot = np.append(of_value, np.full(len(problem.priors), NO_SHOT))
        self.shots = np.unique(of_value)
        self.used = used = np.append(here, np.ones(len(problem.priors), bool))
        # where the law fails, what a search takes for the residual is no error
        errors = problem.measurement.independent(problem.measured - solution.predicted)
        self.residual = np.append(errors, -minimum.residual[errors.size :])[used]
        self.jacobian = minimum.jacobian[used]
        self.squares = float(self.residual @ self.residual)
        self.errors = uncertainty(problem, minimum)
        self.freedom = self.errors.degrees_of_freedom
        self.stretch = 1.0 if problem.sigma is None else self._stretch()
        noise = self.stretch
        if loss_noise is not None:
            unknown = np.nan if problem.sigma is None else 1.0
            noise = loss_noise / np.sqrt(self.freedom) if self.freedom > 0 else unknown
        if noise != 1:
            self.errors = uncertainty(problem, minimum, noise)

    def _stretch(self) -> float:
        """`stretch` of known errors.

        Equation: `sqrt(chi^2 / freedom)`, of all residuals, or of those that are not momentum if
        that is more: the errors of a law or its parameters are in these.
        """
        squares, freedom, data = self.squares, self.freedom, self.problem.experiments
        tests = [(squares, freedom)]
        if data is not None and not data.lost_freedom:
            momentum = self.momentum
            squares -= float(np.sum((momentum.T @ self.residual) ** 2))
            tests.append((max(squares, 0.0), freedom - momentum.shape[1]))
        rejected = [s / f for s, f in tests if f > 0 and chdtrc(f, s) < LEVEL]
        return float(np.sqrt(max(rejected, default=1.0)))

    @property
    def momentum(self) -> Any:
        """(R, C) of shots: the directions in which residuals are momentum, a sparse matrix."""
        of_priors = np.zeros((len(self.problem.priors), 0))
        blocks = [coo_array(block) for block in (*_conserved(self.problem), of_priors)]
        return block_diag(blocks, format="csr")[self.used]

    @property
    def inexact(self) -> bool:
        """Whether there are residuals to test."""
        return self.freedom >= 1 and self.squares > self.problem.exact_squares

    @property
    def shows_noise(self) -> bool:
        """Whether residuals have to show the noise: those of shots without sigma."""
        problem = self.problem
        return self.inexact and problem.sigma is None and problem.experiments is not None


def unusable(problem: FitProblem, solution: Solution) -> np.ndarray:
    """Shots (K,) whose impacts fail, or whose derivatives are not finite or absurdly large."""
    if not isinstance(problem.observe, Shots):
        return np.zeros(1, bool)
    slope = np.abs(problem.of_data(solution.starts[0].jacobian))
    allowed = (
        ABSURD
        * float(problem.measurement.unit)
        * np.asarray(problem.measurement.weight, float)[..., None]
    )
    fails = [STATUS[code].name in UNUSABLE for code in solution.status]
    used = ~np.isnan(problem.measured).all(axis=1)
    return used & (np.array(fails) | ~(slope <= allowed).all(axis=(1, 2)))


def _conserved(problem: FitProblem) -> list[np.ndarray]:
    """Of every shot the directions (n, c) in which residuals are momentum: orthonormal columns."""
    assert problem.experiments is not None
    bases, balances = [], problem.experiments.balances(problem.scene)
    for k, ((rows, _, _), w) in enumerate(
        zip(balances, np.asarray(problem.measurement.weight, float))
    ):
        whole = (w > 0).all() and len(rows)
        back = (rows / w).T if whole else np.zeros((len(w), 0))
        if whole and problem.measurement.mixing is not None:
            own = (
                problem.measurement.mixing[k]
                if problem.measurement.mixing.ndim == 3
                else problem.measurement.mixing[k, :, k]
            )
            back = np.linalg.solve(np.asarray(own, float).T, back)
        bases.append(np.linalg.qr(back)[0])
    return bases


def _noise(judged: Judged) -> tuple[float, int]:
    """Sum of squares that no law can change, and its degrees of freedom."""
    problem, experiments = judged.problem, judged.problem.experiments
    assert experiments is not None
    groups: dict[Any, list[int]] = {}
    for k, pre in enumerate(np.asarray(experiments.pre)):
        # shots in scenes of their own are not repetitions
        groups.setdefault((0 if experiments.scenes is None else k, pre.tobytes()), []).append(k)
    conserved, bodies = _conserved(problem), problem.measured.shape[1]
    squares, count = 0.0, 0
    for shots in groups.values():
        blocks = [judged.residual[judged.shot == k] for k in shots]
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
            return float(problem.measurement.weight.max()) ** 2 * 10.0 ** (-2 * digits) / 12
    return 0.0


def _range(problem: FitProblem, matrix: np.ndarray, size: float | None = None) -> np.ndarray:
    """Orthonormal columns that span those of the matrix, but for what is small against `size`."""
    u, singular, _ = np.linalg.svd(matrix, full_matrices=False)
    size = singular[0] if size is None else size
    return u[:, singular > RANK_TOLERANCE[problem.precision] * size]


# ------------------------------------------------------------------ what is wrong with the fit


def _left_out(judged: Judged) -> Iterator[Finding]:
    """Shots that were left out."""
    if labels := judged.problem.left_out:
        count = f"{len(labels)} of {len(judged.problem.measured)} shots"
        yield Finding(
            "left_out",
            f"Left out: {count} ({listed(labels)}), whose impacts fail, or whose derivatives "
            "cannot be used.",
            f"{count} are left out",
            labels,
        )


def _unknown_corrections(judged: Judged) -> Iterator[Finding]:
    """Shots with `sigma_pre` and a correction that is not that of momentum."""
    data = judged.problem.experiments
    if data is None or data.sigma_pre is None:
        return
    whole = kept_by_corrections(data, judged.problem.scene) == np.eye(data.pre.shape[1])
    unknown = np.flatnonzero((np.array(data.lost) > 0) & whole.all(axis=(1, 2)))
    if unknown.size:
        labels = tuple(data.shots[k] for k in unknown)
        yield Finding(
            "unknown_correction",
            f"The fit weighs shots {listed(labels)} as if they were not "
            "corrected: they have `lost_freedom`, but do not conserve momentum, so that the errors "
            "that `sigma_pre` leaves in them are unknown; chi^2 and standard errors are "
            "approximate.",
            shots=labels,
        )


def _search(judged: Judged) -> Iterator[Finding]:
    """A kink for a minimum; a search that has not ended."""
    if judged.solution.stuck:
        yield Finding(
            "kink",
            "The minimum is a kink of the law (the sequence of contacts changes there, or its "
            "derivatives are wrong): standard errors do not hold.",
        )
    if not judged.solution.converged:
        yield Finding(
            "not_converged",
            "The fit has not converged: allow more `max_steps`, `starts` or time (`limit`).",
        )


def _statuses(judged: Judged) -> Iterator[Finding]:
    """The shots in which the fitted law fails."""
    data, status = judged.problem.experiments, judged.solution.status
    for code in np.unique(status) if data is not None else ():
        if STATUS[code].failure:
            labels = tuple(data.shots[k] for k in np.flatnonzero(status == code))  # type: ignore[union-attr]
            count = f"{len(labels)} of {len(status)} shots ({listed(labels)})"
            name, message = STATUS[code].name, STATUS[code].message
            line = f"The fitted law fails in {count}: {name}, {message}."
            yield Finding("law_fails", line, shots=labels)


def _matrix(judged: Judged) -> Iterator[Finding]:
    """Conditions on a restitution matrix that it ends at, or that it need not satisfy."""
    problem, law, data = judged.problem, judged.problem.law, judged.problem.experiments
    if edges := boundary(problem.matrix, problem.variables.point(judged.solution.value)):
        yield Finding(
            "matrix_edge",
            f"The matrix ends at the edge of the admissible ones ({'; '.join(edges)}): the errors "
            "hold for the side inside.",
        )
    if data is None or not isinstance(law, RestitutionMatrix):
        return
    if not encloses(law, data.largest_scene(problem.scene).contacts):
        yield Finding(
            "matrix_free",
            "Nothing keeps this matrix consistent for other approach velocities than the measured: "
            "the conditions are for (m, m) matrices with admissible=True.",
        )


def _not_finite(judged: Judged) -> Iterator[Finding]:
    """Which values of a user's own function are not finite at the fitted parameters."""
    problem = judged.problem
    lost = np.isfinite(problem.measured) & ~np.isfinite(judged.solution.predicted)
    if problem.experiments is None and lost.any():
        which, values = np.flatnonzero(lost), problem.values - len(problem.priors)
        yield Finding(
            "law_fails",
            f"The fitted law fails in {len(which)} of {values} values "
            f"({listed([str(i + 1) for i in which])}): they are not finite there and count as "
            "large errors.",
        )


def _beyond_sigma(judged: Judged) -> Iterator[Finding]:
    """Residuals larger than sigma allows."""
    if judged.inexact and judged.stretch > 1:
        how = "are those of the loss" if judged.robust else "are stretched by that"
        yield Finding(
            "lack_of_fit",
            f"Lack of fit: the residuals are {judged.stretch:.2g} times what sigma allows (chi^2 = "
            f"{judged.squares:.4g} with {degrees(judged.freedom)}): the law or "
            "the stated errors are wrong, or the parameters scatter; the standard errors "
            f"{how}.{_held(judged.problem)}",
            numbers={"ratio": judged.stretch, "chi_squared": judged.squares},
        )


def _held(problem: FitProblem) -> str:
    """Says that friction of the law is not fitted, which may be why the law does not fit."""
    if "friction" not in free_parameters_of(problem.law) or "friction" in problem.fields:
        return ""
    return " The law's `friction` is held at its start: name it in `free` to fit it."


def _beyond_noise(judged: Judged) -> Iterator[Finding]:
    """What the law leaves over, against the noise of momentum and of repeated shots."""
    problem = judged.problem
    if not judged.shows_noise:
        return
    noise, count = _noise(judged)
    rest = judged.freedom - count
    if count < _LEAST or rest < 1:
        return
    left = max(judged.squares - noise, 0.0)
    ratio = left / rest / max(noise / count, _reading_variance(problem))
    if fdtrc(rest, count, ratio) < LEVEL:
        yield Finding(
            "lack_of_fit",
            f"Lack of fit: the residuals are {np.sqrt(ratio):.2g} times the noise that momentum "
            f"and repeated shots show ({rest} and {degrees(count)}): the law does not "
            f"fit, and the standard errors mean little.{_held(problem)}",
            numbers={"ratio": float(np.sqrt(ratio))},
        )


def _pattern(judged: Judged) -> Iterator[Finding]:
    """Whether the residuals are proportional to the velocities before: by an F test."""
    problem, rest = judged.problem, judged.freedom
    if not judged.shows_noise or list(_beyond_noise(judged)):  # which says enough
        return
    assert problem.experiments is not None
    pre = np.asarray(problem.experiments.pre, float)
    u, singular, _ = np.linalg.svd(pre, full_matrices=False)
    basis = u[:, singular > ROUNDING * singular[0]]
    body = np.broadcast_to(np.arange(pre.shape[1]), problem.measured.shape)
    body = body[~np.isnan(problem.measured)]
    more = np.hstack([basis[judged.shot] * (body == i)[:, None] for i in range(pre.shape[1])])
    momentum, known = judged.momentum, _range(problem, judged.jacobian)
    # no law explains that part
    more, residual = (x - momentum @ (momentum.T @ x) for x in (more, judged.residual))
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
        yield Finding(
            "lack_of_fit",
            f"Lack of fit: the residuals follow the velocities before the impact (F = {ratio:.3g} "
            f"with {count} and {degrees(rest)}): the law does not fit.",
            numbers={"F": ratio},
        )


def _contradicted_priors(judged: Judged) -> Iterator[Finding]:
    """Priors that the data, fitted without them, would not expect: each against N(0, 1)."""
    problem = judged.problem
    if not judged.inexact:
        return
    known = _range(problem, judged.jacobian)
    for row, prior in zip(np.flatnonzero(judged.shot == NO_SHOT), problem.priors):
        left = 1 - float(known[row] @ known[row])  # variance of the residual; 0: the prior decides
        if left <= RANK_TOLERANCE[problem.precision]:
            continue
        far = float(abs(judged.residual[row]) / np.sqrt(left))
        if chdtrc(1, far**2) < LEVEL / len(problem.priors):
            name = problem.names[prior.parameter]
            yield Finding(
                "prior",
                f"The data contradict the prior {name} = {prior.mean:g} ± {prior.std:g}: what they "
                f"say without it is {far:.2g} standard errors off.",
                f"the prior of {name} contradicts the data",
                numbers={name: far},
            )


def _suspicious(judged: Judged) -> Iterator[Finding]:
    """Shots that the others, fitted without them, would not expect."""
    if not judged.inexact or judged.problem.experiments is None:
        return
    labels, count = judged.problem.experiments.shots, len(judged.shots)
    suspects = [
        (squares, labels[k])
        for k, squares, chance in _against_others(judged)
        if squares > 0 and chance < LEVEL / count
    ]
    if not suspects:
        return
    worst = ", ".join(label for _, label in sorted(suspects, reverse=True)[:LISTED])
    worst += f" and {len(suspects) - LISTED} more" if len(suspects) > LISTED else ""
    shots, are = (f"shots {worst}", "are") if len(suspects) > 1 else (f"shot {worst}", "is")
    advice = "" if judged.robust else ", or fit with loss='huber'"
    yield Finding(
        "suspicious",
        f"Suspicious: {shots}, which the others do not expect (of {count}); look there for "
        f"errors{advice}.",
        f"{shots} {are} suspicious",
        tuple(label for _, label in suspects),
    )


def _against_others(judged: Judged) -> Iterable[tuple[int, float, float]]:
    """Every shot, its sum of squares, how often the noise of the others is as large: F tests.

    The others are fitted without it; after a robust loss their noise is that of the median
    residual, which many outliers together do not hide in. `sigma`, if known, is the least noise.
    """
    problem, freedom = judged.problem, judged.freedom
    known, reading = _range(problem, judged.jacobian), _reading_variance(problem)
    median = MEDIAN * float(np.median(np.abs(judged.residual)))
    for k in judged.shots:
        rows = judged.shot == k
        r, q, n = judged.residual[rows], known[rows], int(rows.sum())
        rest = MEDIAN_FREEDOM * freedom if judged.robust else freedom - n
        if rest < _LEAST:
            continue
        if judged.robust:
            squares, noise = float(r @ r), median**2 * len(judged.residual) / freedom
        else:
            squares = float(r @ np.linalg.lstsq(np.eye(n) - q @ q.T, r, rcond=1e-9)[0])
            noise = max(judged.squares - squares, 0.0) / rest
        noise = max(noise + reading, 0.0 if problem.sigma is None else 1.0)
        yield int(k), squares, float(fdtrc(n, rest, squares / n / noise)) if noise else 0.0


def _units(judged: Judged) -> Iterator[Finding]:
    """How velocities of different units are weighed without sigma."""
    data = judged.problem.experiments
    if data is not None and data.sigma is None and len(set(data.units)) > 1:
        yield Finding(
            "mixed_units",
            "Without sigma, velocities in rad/s weigh like those in m/s of the same kinetic "
            "energy.",
        )


def _at_bounds(judged: Judged) -> Iterator[Finding]:
    """Parameters at a bound."""
    for i in np.flatnonzero(judged.solution.at_bound):
        name, value = judged.problem.names[i], judged.solution.value[i]
        upper = value >= judged.problem.domains[i, 1]
        end, towards = ("upper", "smaller") if upper else ("lower", "larger")
        yield Finding(
            "at_bound",
            f"{name} is at its {end} bound {value:g}; its standard error only holds towards "
            f"{towards} values.",
            numbers={name: value},
        )


def _choices(judged: Judged) -> Iterator[Finding]:
    """Fewer parameters determined than fitted, or several minima that fit as well as the best."""
    rank, count = judged.errors.rank, len(judged.problem.names)
    minima, noise = judged.solution.starts, np.nan_to_num(judged.errors.noise)
    more = max(EQUALLY_GOOD * noise**2, judged.problem.exact_squares)
    several = sum(end.sum_of_squares <= minima[0].sum_of_squares + more for end in minima)
    if rank < count:
        yield Finding(
            "undetermined",
            f"The data determine {rank} of {counted(count, 'parameter')} (rank {rank} of {count}); "
            "the values given are one choice of many.",
            numbers={"rank": rank, "parameters": count},
        )
    elif several > 1:
        line = f"{several} different minima fit equally well: see the starts."
        yield Finding("several_minima", line, numbers={"minima": several})


def _unknown_errors(judged: Judged) -> Iterator[Finding]:
    """Data without sigma that do not show their noise."""
    if judged.problem.sigma is not None:
        return
    if judged.freedom < 1:
        yield Finding(
            "unknown_errors",
            "No degree of freedom is left to estimate the noise: errors are unknown without sigma.",
        )
    elif judged.solution.starts[0].sum_of_squares <= judged.problem.exact_squares:
        yield Finding(
            "unknown_errors",
            "The data are reproduced to the last digit and do not show their noise: errors are "
            "unknown without `sigma` or `resolution`.",
        )


def _precision(judged: Judged) -> Iterator[Finding]:
    """Fits in single precision."""
    if judged.problem.precision == "float32":
        yield Finding(
            "single_precision",
            "Computed in float32: values are good to about 1e-3, and the rank is judged coarsely. "
            'jax.config.update("jax_enable_x64", True) gives float64.',
        )


FIT_CHECKS = (
    *(_unknown_corrections, _search, _statuses, _matrix, _not_finite),
    *(_beyond_sigma, _beyond_noise, _pattern, _contradicted_priors, _suspicious),
    *(_units, _at_bounds, _choices, _unknown_errors, _precision),
)


def fit_findings(judged: Judged) -> list[Finding]:
    """All findings, those about the data first."""
    problem, data = judged.problem, judged.problem.experiments
    found = list(_left_out(judged))
    if data is not None:
        contacts = data.largest_scene(problem.scene).contacts
        law = problem.law
        stored = float(np.sum(np.broadcast_to(np.asarray(law.stored), contacts)))
        balances = DataBalances(data, problem.scene, stored, law.uses_gaps)
        found += findings(DATA_CHECKS, balances)
    return found + findings(FIT_CHECKS, judged)
