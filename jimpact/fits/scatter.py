"""Does a parameter differ from shot to shot: a random effect, estimated next to the fit."""

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc, stdtr

from jimpact._checks import check_choice
from jimpact.files.records import with_error
from jimpact.fits.adequacy import NO_SHOT
from jimpact.fits.result import FitResult

LEAST_SHOTS = 4  # of which the scatter of one number can be estimated
SHOWN_FROM = 8  # number of shots from which a report includes it
SURE = 0.01  # p-value below which scatter counts as detected
_SMALLEST = 1e-4  # scatter looked for, in standard errors of one shot
_LARGEST = 1e4  # likewise, the upper end of the search
_NO_CHANCE = 1e-15  # smaller p-values are rounding, and printed as "below"


@dataclass(frozen=True, eq=False)
class Scatter:
    """Scatter `value` of the parameter `name` between shots, and the fit with it.

    `chance` is the p-value of no scatter; `mean` (P,) and `standard_error` (P,) of all parameters
    `names`, `squares` and `degrees_of_freedom` of what is left; `each` (K,) the value
    of every single shot and its error `each_error` (inf where a shot does not see it).
    """

    name: str
    value: float
    chance: float
    names: tuple[str, ...]
    mean: np.ndarray
    standard_error: np.ndarray
    squares: float
    degrees_of_freedom: int
    each: np.ndarray
    each_error: np.ndarray

    def __str__(self) -> str:
        i = self.names.index(self.name)
        mean, error = self.mean[i], self.standard_error[i]
        if self.chance > SURE:
            return (
                f"{self.name} shows no scatter from shot to shot (p-value {self.chance:.2g}): "
                f"{with_error(mean, error)}."
            )
        chance = f"{self.chance:.1g}" if self.chance > _NO_CHANCE else f"below {_NO_CHANCE:g}"
        return (
            f"{self.name} scatters by {self.value:.2g} from shot to shot (p-value of no "
            f"scatter {chance}): its mean is {with_error(mean, error)}, in the next shot it is "
            f"{with_error(mean, float(np.hypot(self.value, error)))}."
        )

    @property
    def explains(self) -> bool:
        """Whether what is left is no larger than sigma allows."""
        freedom = self.degrees_of_freedom
        return freedom > 0 and float(chdtrc(freedom, self.squares)) >= SURE

    def trend(self, over: np.ndarray) -> float:
        """P-value of a trend of the shots over these values (K,).

        Equation: t test of the slope, each shot weighing `1 / (error^2 + value^2)`.
        """
        informative = np.isfinite(self.each) & np.isfinite(self.each_error)
        x, y = over[informative], self.each[informative]
        if len(x) < LEAST_SHOTS or np.ptp(x) == 0:
            return 1.0
        root = 1 / np.hypot(self.each_error[informative], self.value)
        design = root[:, None] * np.stack([np.ones_like(x), x], axis=1)
        slope, left = np.linalg.lstsq(design, root * y, rcond=None)[:2]
        if left.size == 0 or left[0] == 0:
            return 1.0
        error = np.sqrt(left[0] / (len(x) - 2) * np.linalg.inv(design.T @ design)[1, 1])
        return 2 * float(stdtr(len(x) - 2, -abs(slope[1]) / error))


def scatter(fit: FitResult, name: str | None = None) -> Scatter:
    """A parameter that each shot draws anew, and the standard errors that follow.

    Equation: `r_k = J_k (x - x_fit) + j_k b_k + noise`, `b_k ~ N(0, value^2)`, j_k the column of
    the parameter in J_k; `value` maximizes the restricted likelihood, linearized at the fit, with
    the noise of sigma, or estimated with it. The p-value is that of the likelihood ratio, whose
    distribution at 0 is half that of chi^2 with one degree of freedom.

    Args:
        fit: of at least 4 shots.
        name: of the parameter; None: the restitution, or else the first.

    Returns:
        `Scatter`; `print` says it in words.

    Raises:
        ValueError: too few shots, an unknown name, or one that the data cannot see.

    >>> import numpy as np
    >>> import jimpact as ji
    >>> e = 0.7 + 0.05 * np.random.default_rng(0).normal(size=40)
    >>> data = ji.Experiments(np.tile([1.0, 0.0], (40, 1)), np.stack([1 - e, 1 + e], 1) / 2, 0.002)
    >>> result = ji.scatter(ji.fit(ji.Newton(0.9), ji.chain([1.0, 1.0]), data))
    >>> bool(0.035 < result.value < 0.065), result.chance < 1e-6
    (True, True)
    """
    from scipy.optimize import minimize_scalar  # late: slow to import

    which = _which(fit, name)
    residual, jacobian, shot = _weighted(fit)
    shots = np.unique(shot[shot != NO_SHOT])
    if len(shots) < LEAST_SHOTS:
        raise ValueError(
            f"Argument `fit` must be of at least {LEAST_SHOTS} shots, but has {len(shots)}."
        )
    known = fit.problem.sigma is not None
    model = _Model(residual, jacobian, shot, shots, which, fit.problem.values, known)
    typical = 1 / np.sqrt(np.mean(model.seen))  # error of one shot
    ends = np.log([_SMALLEST * typical, _LARGEST * typical])
    best = minimize_scalar(
        lambda log: model.deviance(float(np.exp(log))), bounds=tuple(ends), method="bounded"
    )
    least, none = float(best.fun), model.deviance(0.0)
    gain = max(none - least, 0.0)
    ratio = float(np.exp(best.x)) if gain > 0 else 0.0  # over the noise
    change, covariance, squares, freedom = model.solve(ratio)
    noise = 1.0 if known else float(np.sqrt(squares / freedom)) if freedom > 0 else np.nan
    change_of_each = model.projected / np.where(model.seen > 0, model.seen, np.nan)
    with np.errstate(divide="ignore"):
        each_error = noise / np.sqrt(model.seen)
    return Scatter(
        name=fit.names[which],
        value=ratio * noise,
        chance=0.5 * float(chdtrc(1, gain)) if gain > 0 else 1.0,
        names=fit.names,
        mean=fit.value + change,
        standard_error=noise * np.sqrt(np.diag(covariance)),
        squares=squares,
        degrees_of_freedom=freedom,
        each=fit.value[which] + change_of_each,
        each_error=each_error,
    )


def shown_scatter(fit: FitResult) -> Scatter | None:
    """The scatter that explains why a fit is worse than sigma allows; None where it does not."""
    stretched = fit.problem.sigma is not None and fit.noise > 1 and fit.loss == "squares"
    if not stretched or fit.experiments is None or not np.isfinite(fit.standard_error).all():
        return None
    if fit.shot_count < SHOWN_FROM or fit.contradicts_priors:
        return None
    try:
        result = scatter(fit)
    except ValueError:
        return None
    return result if result.chance <= SURE else None


def _which(fit: FitResult, name: str | None) -> int:
    """The place of the parameter that may scatter."""
    if fit.experiments is None:
        raise ValueError("Argument `fit` must be of shots.")
    if name is None:
        bounce = [i for i, x in enumerate(fit.names) if x.startswith("restitution")]
        return bounce[0] if bounce else 0
    check_choice("name", name, fit.names)
    i = fit.names.index(name)
    if np.isinf(fit.standard_error[i]):
        raise ValueError(f"Argument `name` must be a parameter that the data see, but is {name!r}.")
    return i


def _weighted(fit: FitResult) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Residuals (R,) in units of sigma, their derivatives (R, P), shots (R,); then the priors'."""
    problem, here = fit.problem, ~np.isnan(fit.problem.measured)
    residual, jacobian = problem.independent(fit.residual), problem.independent(fit.jacobian)
    more, slope = problem.prior_errors(fit.value)
    shot = np.append(problem.shot_of_value, np.full(len(more), NO_SHOT))
    return np.append(residual[here], more), np.vstack([jacobian[here], slope]), shot


class _Model:
    """Shots with noise 1 and an effect of standard deviation t along j_k."""

    def __init__(
        self,
        residual: np.ndarray,
        jacobian: np.ndarray,
        shot: np.ndarray,
        shots: np.ndarray,
        which: int,
        values: int,
        known: bool,
    ):
        column = jacobian[:, which]
        member = shot[None, :] == shots[:, None]
        self.residual, self.jacobian = residual, jacobian
        self.seen = member @ column**2  # |j_k|^2
        self.projected = member @ (column * residual)  # j_k . r_k
        self.crossed = member @ (column[:, None] * jacobian)  # j_k . J_k
        self.values, self.known = values, known

    def solve(self, t: float) -> tuple[np.ndarray, np.ndarray, float, int]:
        """Change of the parameters, covariance, sum of squares, degrees of freedom."""
        less = t**2 / (1 + t**2 * self.seen)
        information = self.jacobian.T @ self.jacobian
        information = information - self.crossed.T @ (less[:, None] * self.crossed)
        right = self.jacobian.T @ self.residual - self.crossed.T @ (less * self.projected)
        covariance = np.linalg.pinv(information, hermitian=True)
        change = covariance @ right
        squares = self.residual @ self.residual - less @ self.projected**2 - right @ change
        rank = np.linalg.matrix_rank(information, hermitian=True)
        return change, covariance, float(squares), int(self.values - rank)

    def deviance(self, t: float) -> float:
        """-2 log of the restricted likelihood, up to a constant."""
        _, covariance, squares, freedom = self.solve(t)
        spread = float(np.sum(np.log1p(t**2 * self.seen)))
        information = -np.linalg.slogdet(covariance)[1]
        if self.known:
            return spread + information + squares
        return spread + information + freedom * float(np.log(max(squares, np.finfo(float).tiny)))
