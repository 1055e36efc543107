"""What is wrong with a fit: tests, each with the sentence that it puts into the report.

Every law leaves a momentum unchanged that the contacts cannot change, and predicts the
same for shots that began alike: residuals in these directions are noise. The other
residuals are compared with it, or with the stated sigma.
"""

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from scipy.special import chdtrc, fdtrc

from jimpact.core.law import free_parameters_of, value_of
from jimpact.fits.data_checks import DATA_CHECKS, LISTED, DataBalances
from jimpact.fits.findings import Finding, findings
from jimpact.fits.matrices import boundary, encloses
from jimpact.fits.observables import UNUSABLE, Shots
from jimpact.fits.problem import FitProblem
from jimpact.fits.search import MEDIAN, Solution
from jimpact.fits.solve import RANK_TOLERANCE
from jimpact.fits.uncertainty import uncertainty
from jimpact.laws.kinematic import RestitutionMatrix
from jimpact.shots.data import ROUNDING, kept_by_corrections
from jimpact.tools.records import counted, degrees, listed
from jimpact.tools.status import STATUS

# ------------------------------------------------------------------ thresholds of the
# fit
LEVEL = 0.01  # of each test: how often it flags data that the law itself made
_LEAST = 3  # degrees of freedom of the noise too few to test against
# A median of absolute values is as uncertain as a standard deviation of this share of
# the values (Huber, 1981). Ten times more would make honest shots of small sets
# suspicious.
MEDIAN_FREEDOM = 0.37
# Largest derivative of a velocity, over the largest velocity and a natural step of a
# parameter (as far as from 0 to 1 for a restitution): those beyond are errors and would
# shorten every step.
ABSURD = 1e3
# Minima whose sums of squares differ by less than this many noise variances fit equally
# well:
# the difference is what moving by one standard error costs.
EQUALLY_GOOD = 1.0
NO_SHOT = -1  # the place of a shot where a value belongs to none: a prior


# ------------------------------------------------------------------ what the residuals
# show


class Judged:
    """The residuals of a fit at its minimum, with all that the tests of this module
    need.

    Attributes:
        problem, solution: the least-squares problem and its minimum.
        robust: True after a fit by a robust loss.
        residual: (R,) of the measured values in units of sigma, those of the priors
            last.
        jacobian: (R, P) derivatives of the residual in the scaled parameters.
        shot: (R,) index of the shot of each residual, `NO_SHOT` of priors.
        shots: indices of the shots that have residuals.
        used: True for the rows that are in `residual`, of all measured values and
            priors.
        squares: the sum of squared residuals.
        stretch: factor by which errors are larger than stated; 1 where chi^2 does not
            reject them.
        errors: of the parameters; stated errors of the data are multiplied by
            `stretch`.
        freedom: degrees of freedom.
    """

    def __init__(
        self, problem: FitProblem, solution: Solution, loss_noise: float | None
    ):
        """Take residuals and errors from the minimum.

        Args:
            problem: least squares.
            solution: its minimum.
            loss_noise: noise times the root of the degrees of freedom after a robust
                loss, or None.
        """
        self.problem = problem
        self.solution = solution
        self.robust = loss_noise is not None
        minimum = solution.starts[0]
        measured = ~np.isnan(problem.measured).ravel()
        # of each value
        rows = np.atleast_1d(problem.measured)
        shot, *_ = np.nonzero(~np.isnan(rows))
        shot_of_priors = np.full(len(problem.priors), NO_SHOT)
        self.shot = np.append(shot, shot_of_priors)
        self.shots = np.unique(shot)
        self.used = used = np.append(measured, np.ones(len(problem.priors), bool))
        # not the residual of the search, which is a penalty where the law fails
        errors = problem.measurement.independent(problem.measured - solution.predicted)
        errors_of_priors = -minimum.residual[errors.size :]
        self.residual = np.append(errors, errors_of_priors)[used]
        self.jacobian = minimum.jacobian[used]
        self.squares = float(self.residual @ self.residual)
        self.errors = uncertainty(problem, minimum)
        self.freedom = self.errors.degrees_of_freedom
        if problem.sigma is None:
            self.stretch = 1.0
        else:
            self.stretch = self._stretch()
        if loss_noise is None:
            noise = self.stretch
        elif self.freedom > 0:
            noise = loss_noise / np.sqrt(self.freedom)
        elif problem.sigma is None:
            noise = np.nan  # unknown
        else:
            noise = 1.0  # as stated
        if noise != 1:
            self.errors = uncertainty(problem, minimum, noise)

    def _stretch(self) -> float:
        """Factor on stated errors that chi^2 rejects:
        `sqrt(chi^2 / degrees of freedom)`, else 1.

        The larger one of two: that of all residuals, and that of residuals without the
        directions of conserved momentum, as errors of a law are in these only. The
        second one is left out where a correction of the data has already taken these
        directions away (`lost_freedom`), and where there are no shots.
        """
        squares = self.squares
        freedom = self.freedom
        data = self.problem.experiments
        tests = [(squares, freedom)]  # chi^2 and its degrees of freedom
        if data is not None and not data.lost_freedom:
            momentum = self.momentum
            projections = momentum.T @ self.residual
            remaining = squares - float(np.sum(projections**2))
            remaining_freedom = freedom - momentum.shape[1]
            tests.append((max(remaining, 0.0), remaining_freedom))
        rejected = [s / f for s, f in tests if f > 0 and chdtrc(f, s) < LEVEL]
        return float(np.sqrt(max(rejected, default=1.0)))

    @property
    def momentum(self) -> Any:
        """Orthonormal directions (R, C) of residuals that are momentum errors of shots;
        sparse.
        """
        from scipy.sparse import block_diag, coo_array  # late: slow to import

        of_priors = np.zeros((len(self.problem.priors), 0))
        blocks_of_shots = _conserved(self.problem)
        blocks = [coo_array(block) for block in (*blocks_of_shots, of_priors)]
        return block_diag(blocks, format="csr")[self.used]

    @property
    def inexact(self) -> bool:
        """True where residuals can be tested: a degree of freedom is left, the fit is
        not exact.
        """
        return self.freedom >= 1 and self.squares > self.problem.exact_squares

    @property
    def shows_noise(self) -> bool:
        """True where the noise is estimated from the residuals: those of shots without
        sigma.
        """
        problem = self.problem
        return (
            self.inexact and problem.sigma is None and problem.experiments is not None
        )


def unusable(problem: FitProblem, solution: Solution) -> np.ndarray:
    """True for shots (K,) whose impact fails, or has derivatives that are not finite or
    too large.

    Too large: beyond `ABSURD` times the largest velocity over a natural step of a
    parameter.
    """
    if not isinstance(problem.observe, Shots):
        return np.zeros(1, bool)
    # (K, n, P), over sigma
    slope = np.abs(problem.of_data(solution.starts[0].jacobian))
    allowed = (
        ABSURD
        * float(problem.measurement.unit)
        * np.asarray(problem.measurement.weight, float)[..., None]
    )
    fails = [STATUS[code].name in UNUSABLE for code in solution.status]
    used = ~np.isnan(problem.measured).all(axis=1)
    usable_slopes = (slope <= allowed).all(axis=(1, 2))
    return used & (np.array(fails) | ~usable_slopes)


def _conserved(problem: FitProblem) -> list[np.ndarray]:
    """Orthonormal directions (n, c) of each shot's residuals in which they are momentum
    errors.

    Equation: the range of `L^-T diag(sigma) M C`: an error e of v+ changes the
    conserved momenta `C^T M v` by `(L^-T diag(sigma) M C)^T u`, `u = L e / sigma` its
    independent residual. No direction of shots with values that were not measured.
    """
    assert problem.experiments is not None
    bases = []
    balances = problem.experiments.balances(problem.scene)
    mixing = problem.measurement.mixing
    weights = np.asarray(problem.measurement.weight, float)
    # rows = C^T M (c, n)
    both = zip(balances, weights)
    for k, ((rows, _, _), weight) in enumerate(both):
        complete = (weight > 0).all() and len(rows)
        if complete:
            directions = (rows / weight).T
        else:
            directions = np.zeros((len(weight), 0))
        if complete and mixing is not None:
            if mixing.ndim == 3:
                block = mixing[k]
            else:
                block = mixing[k, :, k]
            matrix = np.asarray(block, float).T
            directions = np.linalg.solve(matrix, directions)
        bases.append(np.linalg.qr(directions)[0])
    return bases


def _pure_error(judged: Judged) -> tuple[float, int]:
    """Pure error: the sum of squared residuals that no law can change, and its degrees
    of freedom.

    Equation: over groups of g shots of n values with equal v-, of residuals r_k in
    units of sigma, their mean m, and the momentum directions B (n, c) of `_conserved`,
    orthonormal in these units: `sum |r_k - m|^2 + g |B^T m|^2` with `(g - 1) n + c`
    degrees, less g c where the momentum of every shot has been corrected (its residuals
    are 0). Readings that are all equal count as one.
    """
    problem = judged.problem
    experiments = judged.problem.experiments
    assert experiments is not None
    groups: dict[Any, list[int]] = {}
    for k, pre in enumerate(np.asarray(experiments.pre)):
        # shots in scenes of their own are not repetitions
        groups.setdefault(
            (0 if experiments.scenes is None else k, pre.tobytes()), []
        ).append(k)
    conserved = _conserved(problem)
    n = problem.measured.shape[1]
    squares = 0.0
    count = 0
    for shots in groups.values():
        blocks = [judged.residual[judged.shot == k] for k in shots]
        whole = [block for block in blocks if len(block) == n]
        complete = np.array(whole)
        if len(complete) == 0:
            continue
        # equal to the last digit: their noise is hidden
        if (complete == complete[0]).all():
            complete = complete[:1]
        mean = complete.mean(axis=0)
        basis = conserved[shots[0]]
        squares += float(np.sum((complete - mean) ** 2))
        conserved_part = basis.T @ mean
        squares += len(complete) * float(np.sum(conserved_part**2))
        count += (len(complete) - 1) * n + basis.shape[1]
        if experiments.lost_freedom:  # the momentum of every shot has been corrected
            count -= len(complete) * basis.shape[1]
    return squares, count


def _reading_variance(problem: FitProblem) -> float:
    """Variance `d^2 / 12` of rounding to the last decimal d that all readings need,
    over sigma^2.

    0 for readings of nine decimals or more.
    """
    measured = np.asarray(problem.measured, float)
    values = measured[~np.isnan(problem.measured)]
    largest = np.abs(values).max()
    for digits in range(9):
        errors = np.abs(values - values.round(digits))
        if errors.max() <= ROUNDING * largest:
            return (
                float(problem.measurement.weight.max()) ** 2
                * 10.0 ** (-2 * digits)
                / 12
            )
    return 0.0


def _range(
    problem: FitProblem, matrix: np.ndarray, size: float | None = None
) -> np.ndarray:
    """Orthonormal basis (R, r) of the range of a matrix (R, C): its left singular
    vectors.

    Without those of singular values below `RANK_TOLERANCE size`; None: `size` is the
    largest one.
    """
    u, singular, _ = np.linalg.svd(matrix, full_matrices=False)
    if size is None:
        size = singular[0]
    return u[:, singular > RANK_TOLERANCE[problem.precision] * size]


# ------------------------------------------------------------------ what is wrong with
# the fit


def _left_out(judged: Judged) -> Iterator[Finding]:
    """Yield `left_out`: labels of the shots that the fit has left out."""
    if labels := judged.problem.left_out:
        count = f"{len(labels)} of {len(judged.problem.measured)} shots"
        yield Finding(
            "left_out",
            f"Left out: {count} ({listed(labels)}), whose impacts fail, or whose "
            f"derivatives cannot be used.",
            f"{count} are left out",
            labels,
        )


def _unknown_corrections(judged: Judged) -> Iterator[Finding]:
    """Yield `unknown_correction`: shots with `sigma_pre` whose correction is not that
    of momentum.

    They have lost degrees of freedom, but `kept_by_corrections` is the identity.
    """
    data = judged.problem.experiments
    if data is None or data.sigma_pre is None:
        return
    identical = kept_by_corrections(data, judged.problem.scene) == np.eye(
        data.pre.shape[1]
    )
    corrected = np.array(data.lost) > 0
    unknown = np.flatnonzero(corrected & identical.all(axis=(1, 2)))
    if unknown.size:
        labels = tuple(data.shots[k] for k in unknown)
        yield Finding(
            "unknown_correction",
            f"The fit weighs shots {listed(labels)} as if they were not corrected: "
            f"they have `lost_freedom`, but do not conserve momentum, so that the "
            f"errors that `sigma_pre` leaves in them are unknown; chi^2 and standard "
            f"errors are approximate.",
            shots=labels,
        )


def _search(judged: Judged) -> Iterator[Finding]:
    """Yield `kink` where no step lowers the cost, `not_converged` where the search did
    not end.
    """
    if judged.solution.stuck:
        yield Finding(
            "kink",
            "The minimum is a kink of the law (the sequence of contacts changes there, "
            "or its derivatives are wrong): standard errors do not hold.",
        )
    if not judged.solution.converged:
        yield Finding(
            "not_converged",
            (
                "The fit has not converged: allow more `max_steps`, `starts` or time "
                "(`limit`)."
            ),
        )


def _statuses(judged: Judged) -> Iterator[Finding]:
    """Yield `law_fails` for each failure status, with the shots in which the fitted law
    has it.
    """
    data = judged.problem.experiments
    status = judged.solution.status
    for code in np.unique(status) if data is not None else ():
        if STATUS[code].failure:
            labels = tuple(data.shots[k] for k in np.flatnonzero(status == code))  # type: ignore[union-attr]
            count = f"{len(labels)} of {len(status)} shots ({listed(labels)})"
            name = STATUS[code].name
            message = STATUS[code].message
            line = f"The fitted law fails in {count}: {name}, {message}."
            yield Finding("law_fails", line, shots=labels)


def _matrix(judged: Judged) -> Iterator[Finding]:
    """Yield `matrix_edge` for active admissibility conditions, `matrix_free` where none
    are asked.

    Both are of a `RestitutionMatrix`.
    """
    problem = judged.problem
    law = judged.problem.law
    data = judged.problem.experiments
    if edges := boundary(
        problem.matrix, problem.variables.point(judged.solution.value)
    ):
        yield Finding(
            "matrix_edge",
            f"The matrix ends at the edge of the admissible ones ({'; '.join(edges)}): "
            f"the errors hold for the side inside.",
        )
    if data is None or not isinstance(law, RestitutionMatrix):
        return
    if not encloses(law, data.largest_scene(problem.scene).contacts):
        yield Finding(
            "matrix_free",
            "Nothing keeps this matrix consistent for other approach velocities than "
            "the measured: the conditions are for (m, m) matrices with "
            "admissible=True.",
        )


def _not_finite(judged: Judged) -> Iterator[Finding]:
    """Yield `law_fails` for values of a user's observable that are not finite at the
    minimum.
    """
    problem = judged.problem
    predicted = np.isfinite(judged.solution.predicted)
    lost = np.isfinite(problem.measured) & ~predicted
    if problem.experiments is None and lost.any():
        which = np.flatnonzero(lost)
        values = problem.values - len(problem.priors)
        yield Finding(
            "law_fails",
            f"The fitted law fails in {len(which)} of {values} values "
            f"({listed([str(i + 1) for i in which])}): they are not finite there and "
            f"count as large errors.",
        )


def _above_sigma(judged: Judged) -> Iterator[Finding]:
    """Yield `lack_of_fit` where chi^2 rejects the stated sigma, with the factor
    `stretch`.
    """
    if judged.inexact and judged.stretch > 1:
        if judged.robust:
            how = "are those of the loss"
        else:
            how = "are stretched by that"
        yield Finding(
            "lack_of_fit",
            f"Lack of fit: the residuals are {judged.stretch:.2g} times what sigma "
            f"allows (chi^2 = {judged.squares:.4g} with {degrees(judged.freedom)}): "
            f"the law or the stated errors are wrong, or the parameters scatter; the "
            f"standard errors {how}.{_held_notes(judged.problem)}",
            numbers={"ratio": judged.stretch, "chi_squared": judged.squares},
        )


def _held_notes(problem: FitProblem) -> str:
    """Sentences for what is held and may be why the law does not fit: what to type to
    free it.

    Friction that is not fitted; a scalar stiffness of several contacts, whose ratios
    are not.
    """
    notes = []
    available = free_parameters_of(problem.law)
    if "friction" in available and "friction" not in problem.fields:
        notes.append(
            " The law's `friction` is held at its start: name it in `free` to fit it."
        )
    data = problem.experiments
    is_held = "stiffness" in available and "stiffness" not in problem.fields
    if (
        is_held
        and data is not None
        and np.ndim(value_of(problem.law, "stiffness")) == 0
    ):
        contacts = data.largest_scene(problem.scene).contacts
        if contacts > 1:
            one_each = ", ".join(["1"] * contacts)
            notes.append(
                f" The law's `stiffness` is one number, held: give it one for each "
                f"contact, `stiffness=[{one_each}]`, to fit their ratios."
            )
    return "".join(notes)


def _above_pure_error(judged: Judged) -> Iterator[Finding]:
    """Yield `lack_of_fit` by the F test of lack of fit against pure error, without
    sigma.

    Equation: `F = ((S - S_e) / (f - f_e)) / (S_e / f_e)`, S the sum of squares of f
    degrees of freedom, S_e the pure error of f_e (`_pure_error`), not less than the
    rounding of readings.
    """
    problem = judged.problem
    if not judged.shows_noise:
        return
    pure_error, error_freedom = _pure_error(judged)
    law_freedom = judged.freedom - error_freedom
    if error_freedom < _LEAST or law_freedom < 1:
        return
    by_law = max(judged.squares - pure_error, 0.0)
    variance = max(pure_error / error_freedom, _reading_variance(problem))
    ratio = by_law / law_freedom / variance
    if fdtrc(law_freedom, error_freedom, ratio) < LEVEL:
        yield Finding(
            "lack_of_fit",
            f"Lack of fit: the residuals are {np.sqrt(ratio):.2g} times the noise that "
            f"momentum and repeated shots show ({law_freedom} and "
            f"{degrees(error_freedom)}): the law does not fit, and the standard errors "
            f"mean little.{_held_notes(problem)}",
            numbers={"ratio": float(np.sqrt(ratio))},
        )


def _linear_in_velocities(judged: Judged) -> Iterator[Finding]:
    """Yield `lack_of_fit` where residuals are linear in the velocities before, by an F
    test.

    Equation: `F = (|E^T r|^2 / q) / ((|r|^2 - |E^T r|^2) / f)`, r without its momentum
    directions, E (R, q) an orthonormal basis of further regressors: v- of the shots,
    with coefficients of their own for each body, orthogonal to the Jacobian; f degrees
    of freedom left.
    """
    problem = judged.problem
    freedom = judged.freedom
    if not judged.shows_noise or list(_above_pure_error(judged)):  # which says enough
        return
    assert problem.experiments is not None
    pre = np.asarray(problem.experiments.pre, float)
    u, singular, _ = np.linalg.svd(pre, full_matrices=False)
    basis = u[:, singular > ROUNDING * singular[0]]  # of the columns of v-, over shots
    number = np.arange(pre.shape[1])
    body = np.broadcast_to(number, problem.measured.shape)
    body = body[~np.isnan(problem.measured)]  # the body of each residual
    of_shots = basis[judged.shot]
    of_bodies = [of_shots * (body == i)[:, None] for i in range(pre.shape[1])]
    regressors = np.hstack(of_bodies)
    momentum = judged.momentum
    # no law explains momentum errors
    regressors, residual = (
        x - momentum @ (momentum.T @ x) for x in (regressors, judged.residual)
    )
    if problem.experiments.lost_freedom:
        freedom -= 0
    else:
        freedom -= momentum.shape[1]
    fitted = _range(problem, judged.jacobian)
    size = float(np.linalg.norm(regressors))
    extra = _range(problem, regressors - fitted @ (fitted.T @ regressors), size)
    count = extra.shape[1]
    freedom -= count
    explained = float(np.sum((extra.T @ residual) ** 2))
    unexplained = float(residual @ residual) - explained
    if freedom < _LEAST or unexplained <= 0 or count == 0:
        return
    ratio = explained / count / (unexplained / freedom)
    if fdtrc(count, freedom, ratio) < LEVEL:
        yield Finding(
            "lack_of_fit",
            f"Lack of fit: the residuals follow the velocities before the impact (F = "
            f"{ratio:.3g} with {count} and {degrees(freedom)}): the law does not fit.",
            numbers={"F": ratio},
        )


def _contradicted_priors(judged: Judged) -> Iterator[Finding]:
    """Yield `prior` for priors that a fit to the data without them contradicts.

    Equation: the studentized residual `r_i / sqrt(1 - H_ii)` against the standard
    normal distribution, H = U U^T the hat matrix, U an orthonormal basis of the range
    of the Jacobian; the level is divided by the number of priors (Bonferroni).
    """
    problem = judged.problem
    if not judged.inexact:
        return
    basis = _range(problem, judged.jacobian)
    of_priors = np.flatnonzero(judged.shot == NO_SHOT)
    for row, prior in zip(of_priors, problem.priors):
        # of the residual; 0: the prior decides
        variance = 1 - float(basis[row] @ basis[row])
        if variance <= RANK_TOLERANCE[problem.precision]:
            continue
        distance = abs(judged.residual[row])
        far = float(distance / np.sqrt(variance))
        if chdtrc(1, far**2) < LEVEL / len(problem.priors):
            name = problem.names[prior.parameter]
            yield Finding(
                "prior",
                f"The data contradict the prior {name} = {prior.mean:g} ± "
                f"{prior.std:g}: what they say without it is {far:.2g} standard errors "
                f"off.",
                f"the prior of {name} contradicts the data",
                numbers={name: far},
            )


def _suspicious(judged: Judged) -> Iterator[Finding]:
    """Yield `suspicious`: outliers among the shots, by the F tests of
    `_against_others`.

    Their level is divided by the number of shots (Bonferroni).
    """
    if not judged.inexact or judged.problem.experiments is None:
        return
    labels = judged.problem.experiments.shots
    count = len(judged.shots)
    suspects = [
        (squares, labels[k])
        for k, squares, chance in _against_others(judged)
        if squares > 0 and chance < LEVEL / count
    ]
    if not suspects:
        return
    worst_first = sorted(suspects, reverse=True)[:LISTED]
    worst = ", ".join(label for _, label in worst_first)
    if len(suspects) > LISTED:
        worst += f" and {len(suspects) - LISTED} more"
    else:
        worst += ""
    if len(suspects) > 1:
        shots = f"shots {worst}"
        are = "are"
    else:
        shots = f"shot {worst}"
        are = "is"
    if judged.robust:
        advice = ""
    else:
        advice = ", or fit with loss='huber'"
    yield Finding(
        "suspicious",
        f"Suspicious: {shots}, which the others do not expect (of {count}); look there "
        f"for errors{advice}.",
        f"{shots} {are} suspicious",
        tuple(label for _, label in suspects),
    )


def _against_others(judged: Judged) -> Iterable[tuple[int, float, float]]:
    """Index, sum of squares and p-value of each shot, against a fit to the others: F
    tests.

    Equation: `F = (S_k / n) / ((S - S_k) / (f - n))`, n values of shot k,
    `S_k = r_k^T (I - H_kk)^-1 r_k` what S falls by without it, H the hat matrix, f
    degrees of freedom. After a robust loss `S_k = |r_k|^2`, against the variance by the
    median residual, which many outliers together do not hide in. `sigma`, if known, is
    the least noise; the rounding of readings is added.
    """
    problem = judged.problem
    freedom = judged.freedom
    basis = _range(problem, judged.jacobian)
    reading = _reading_variance(problem)
    median = MEDIAN * float(np.median(np.abs(judged.residual)))
    for k in judged.shots:
        rows = judged.shot == k
        # H_kk = q q^T
        r = judged.residual[rows]
        q = basis[rows]
        n = int(rows.sum())
        if judged.robust:
            freedom_left = MEDIAN_FREEDOM * freedom
        else:
            freedom_left = freedom - n
        if freedom_left < _LEAST:
            continue
        if judged.robust:
            squares = float(r @ r)
            noise = median**2 * len(judged.residual) / freedom
        else:
            projector = np.eye(n) - q @ q.T
            squares = float(r @ np.linalg.lstsq(projector, r, rcond=1e-9)[0])
            noise = max(judged.squares - squares, 0.0) / freedom_left
        noise = max(noise + reading, 0.0 if problem.sigma is None else 1.0)
        yield (
            int(k),
            squares,
            float(fdtrc(n, freedom_left, squares / n / noise)) if noise else 0.0,
        )


def _units(judged: Judged) -> Iterator[Finding]:
    """Yield `mixed_units`: velocities in m/s and rad/s without sigma, weighed by
    kinetic energy.
    """
    data = judged.problem.experiments
    if data is not None and data.sigma is None and len(set(data.units)) > 1:
        yield Finding(
            "mixed_units",
            "Without sigma, velocities in rad/s weigh like those in m/s of the same "
            "kinetic energy.",
        )


def _at_bounds(judged: Judged) -> Iterator[Finding]:
    """Yield `at_bound` for each parameter that is at its lower or upper bound."""
    for i in np.flatnonzero(judged.solution.at_bound):
        name = judged.problem.names[i]
        value = judged.solution.value[i]
        upper = value >= judged.problem.domains[i, 1]
        if upper:
            end = "upper"
            towards = "smaller"
        else:
            end = "lower"
            towards = "larger"
        yield Finding(
            "at_bound",
            f"{name} is at its {end} bound {value:g}; its standard error only holds "
            f"towards {towards} values.",
            numbers={name: value},
        )


def _choices(judged: Judged) -> Iterator[Finding]:
    """Yield `undetermined` where the rank is below P, or `several_minima` that fit
    equally well.

    Equally well: the sums of squares differ by less than `EQUALLY_GOOD` variances of
    the noise.
    """
    rank = judged.errors.rank
    count = len(judged.problem.names)
    minima = judged.solution.starts
    noise = np.nan_to_num(judged.errors.noise)
    more = max(EQUALLY_GOOD * noise**2, judged.problem.exact_squares)
    least = minima[0].sum_of_squares
    several = sum(end.sum_of_squares <= least + more for end in minima)
    if rank < count:
        yield Finding(
            "undetermined",
            f"The data determine {rank} of {counted(count, 'parameter')} (rank {rank} "
            f"of {count}); the values given are one choice of many.",
            numbers={"rank": rank, "parameters": count},
        )
    elif several > 1:
        line = f"{several} different minima fit equally well: see the starts."
        yield Finding("several_minima", line, numbers={"minima": several})


def _unknown_errors(judged: Judged) -> Iterator[Finding]:
    """Yield `unknown_errors`: without sigma no degree of freedom is left, or the fit is
    exact.
    """
    if judged.problem.sigma is not None:
        return
    if judged.freedom < 1:
        yield Finding(
            "unknown_errors",
            (
                "No degree of freedom is left to estimate the noise: errors are "
                "unknown without sigma."
            ),
        )
    elif judged.solution.starts[0].sum_of_squares <= judged.problem.exact_squares:
        yield Finding(
            "unknown_errors",
            "The data are reproduced to the last digit and do not show their noise: "
            "errors are unknown without `sigma` or `resolution`.",
        )


def _precision(judged: Judged) -> Iterator[Finding]:
    """Yield `single_precision` for a fit in float32."""
    if judged.problem.precision == "float32":
        yield Finding(
            "single_precision",
            "Computed in float32: values are good to about 1e-3, and the rank is "
            "judged coarsely. "
            'jax.config.update("jax_enable_x64", True) gives float64.',
        )


FIT_CHECKS = (
    *(_unknown_corrections, _search, _statuses, _matrix, _not_finite),
    *(
        _above_sigma,
        _above_pure_error,
        _linear_in_velocities,
        _contradicted_priors,
        _suspicious,
    ),
    *(_units, _at_bounds, _choices, _unknown_errors, _precision),
)


def fit_findings(judged: Judged) -> list[Finding]:
    """All findings of a fit: shots left out, checks of the data, checks of the fit."""
    problem = judged.problem
    data = judged.problem.experiments
    found = list(_left_out(judged))
    if data is not None:
        contacts = data.largest_scene(problem.scene).contacts
        law = problem.law
        stored_of_contacts = np.broadcast_to(np.asarray(law.stored), contacts)
        stored = float(np.sum(stored_of_contacts))
        balances = DataBalances(data, problem.scene, stored, law.uses_gaps)
        found += findings(DATA_CHECKS, balances)
    return found + findings(FIT_CHECKS, judged)
