"""Does a parameter differ from shot to shot: a random effect, estimated next to the fit."""

from collections.abc import Sequence
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
_SLOPES = (-1.0, 0.0, 1.0)  # slopes of angles from which correlations are searched
_STEEP = 50.0  # largest slope of a correlation's angle: correlations of +-0.9998
_LIMIT = 3.8415  # chi^2 with one degree of freedom, 95 %
# Of the logarithm of a standard deviation where its interval ends. With ten times more the ends
# would be off by a percent.
_END = 1e-3
_NO_CHANCE = 1e-15  # smaller p-values are rounding, and printed as "below"


@dataclass(frozen=True, eq=False)
class Scatter:
    """Scatter `value` of the parameter `name` between shots, and the fit with it.

    `chance` is the p-value of no scatter; `mean` (P,) and `standard_error` (P,) of all parameters
    `names`, `squares` and `degrees_of_freedom` of what is left; `each` (K,) the value
    of every single shot and its error `each_error` (inf where a shot does not see it); `share` of
    the sum of squares that the scatter accounts for.
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
    share: float = np.nan

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
    which = _which(fit, name)
    model = _Model(fit, [which])
    log = _alone(model, 0)
    least, none = model.deviance(np.exp([[log]])), model.deviance(np.zeros((1, 1)))
    gain = max(none - least, 0.0)
    ratio = float(np.exp(log)) if gain > 0 else 0.0  # over the noise
    change, covariance, squares, freedom = model.solve(np.array([[ratio]]))
    noise, seen = model.noise(squares, freedom), model.seen[:, 0, 0]
    change_of_each = model.projected[:, 0] / np.where(seen > 0, seen, np.nan)
    with np.errstate(divide="ignore"):
        each_error = noise / np.sqrt(seen)
    return Scatter(
        name=fit.names[which],
        value=ratio * noise,
        chance=0.5 * float(chdtrc(1, gain)) if gain > 0 else 1.0,
        names=fit.names,
        mean=fit.value + change,
        standard_error=noise * np.sqrt(np.diag(covariance)),
        squares=squares,
        degrees_of_freedom=freedom,
        share=1 - squares / model.solve(np.zeros((1, 1)))[2],
        each=fit.value[which] + change_of_each,
        each_error=each_error,
    )


@dataclass(frozen=True, eq=False)
class JointScatter:
    """Scatter of several parameters `names` (q) between shots, and the fit with it.

    `value` (q,) their standard deviations, `interval` (q, 2) of these at 95 %, `correlation`
    (q, q); `mean` and `standard_error` (P,) of all parameters of the fit; `chance` is the p-value
    of no scatter at all, at most.
    """

    names: tuple[str, ...]
    value: np.ndarray
    interval: np.ndarray
    correlation: np.ndarray
    mean: np.ndarray
    standard_error: np.ndarray
    chance: float

    def __str__(self) -> str:
        lines = [
            f"{name} scatters by {value:.2g} ({low:.2g} to {high:.2g}, 95 %) from shot to shot."
            for name, value, (low, high) in zip(self.names, self.value, self.interval)
        ]
        pairs = zip(*np.triu_indices(len(self.names), 1))
        lines += [
            f"Correlation of {self.names[i]} and {self.names[j]}: {self.correlation[i, j]:.2f}."
            for i, j in pairs
        ]
        return "\n".join(lines)


def joint_scatter(fit: FitResult, names: Sequence[str], correlated: bool = True) -> JointScatter:
    """Several parameters that each shot draws anew: their standard deviations and correlations.

    Equation: `r_k = J_k (x - x_fit) + Z_k b_k + noise`, `b_k ~ N(0, D)`, Z_k the columns of the
    parameters in J_k; D maximizes the restricted likelihood, linearized at the fit. The interval of
    a standard deviation is where that likelihood, with the best of all others in D, is at most
    1.92 below its maximum in the logarithm. The p-value, of chi^2 with as many degrees of freedom
    as D has numbers, is an upper bound: at 0 the true one is smaller.

    Args:
        fit: of at least 4 shots.
        names: of at least two parameters that the data see.
        correlated: whether they may correlate.

    Returns:
        `JointScatter`; `print` says it in words.

    Raises:
        ValueError: too few shots or names, an unknown name, or one that the data cannot see.

    Source: Pinheiro and Bates, Mixed-Effects Models in S and S-PLUS (2000), chapter 2.

    >>> import numpy as np
    >>> import jimpact as ji
    >>> a, b = np.array([0.65, 0.7, 0.75, 0.6]), np.array([0.62, 0.6, 0.58, 0.57])
    >>> post = np.stack([-2 * a - b, a - b, a + 2 * b], axis=1) / 3
    >>> data = ji.Experiments(np.tile([1.0, 0.0, -1.0], (4, 1)), post, 0.002)
    >>> result = ji.fit(ji.Newton([0.9, 0.9]), ji.chain([1.0, 1.0, 1.0]), data, starts=1)
    >>> print(ji.joint_scatter(result, result.names, correlated=False))
    restitution[1] scatters by 0.064 (0.034 to 0.19, 95 %) from shot to shot.
    restitution[2] scatters by 0.022 (0.011 to 0.065, 95 %) from shot to shot.
    Correlation of restitution[1] and restitution[2]: 0.00.
    """
    if len(set(names)) < 2:
        raise ValueError(f"Argument `names` must have at least two parameters, but is {names!r}.")
    model, count = _Model(fit, [_which(fit, name) for name in names]), len(names)
    free = count + (count * (count - 1) // 2 if correlated else 0)
    best, least = _best(model, free)
    root = _root(model, best)
    change, covariance, squares, freedom = model.solve(root)
    noise, spread = model.noise(squares, freedom), root @ root.T
    ratio = np.sqrt(np.diag(spread))
    gain = max(model.deviance(np.zeros_like(root)) - least, 0.0)
    ends = np.array([_ends(model, best, least, i) for i in range(count)])
    return JointScatter(
        names=tuple(names),
        value=noise * ratio,
        interval=noise * ends,
        correlation=spread / np.outer(ratio, ratio),
        mean=fit.value + change,
        standard_error=noise * np.sqrt(np.diag(covariance)),
        chance=float(chdtrc(free, gain)),
    )


def _root(model: "_Model", x: np.ndarray) -> np.ndarray:
    """L (q, q) of x: logarithms of q standard deviations, then the correlations' angles."""
    q = len(model.typical)
    rows = np.eye(q)
    rows[np.tril_indices(q, -1)] = x[q:] if len(x) > q else 0.0
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    return np.asarray(np.exp(x[:q])[:, None] * rows)


def _best(model: "_Model", free: int) -> tuple[np.ndarray, float]:
    """The best x (free,) and its deviance, from each scatter alone and several correlations."""
    alone = [_alone(model, i) for i in range(len(model.typical))]
    starts = [np.append(alone, np.full(free - len(alone), slope)) for slope in _SLOPES]
    return min((_least(model, start) for start in starts), key=lambda found: found[1])


def _alone(model: "_Model", i: int) -> float:
    """Logarithm of the best scatter, over the noise, of the i-th parameter alone."""
    from scipy.optimize import minimize_scalar  # late: slow to import

    only = np.zeros((len(model.typical),) * 2)
    only[i, i] = 1.0
    ends = np.log(model.typical[i]) + np.log([_SMALLEST, _LARGEST])
    found = minimize_scalar(
        lambda log: model.deviance(np.exp(log) * only), bounds=tuple(ends), method="bounded"
    )
    return float(found.x)


def _least(
    model: "_Model", start: np.ndarray, fixed: tuple[int, float] | None = None
) -> tuple[np.ndarray, float]:
    """The best x near a start and its deviance; `fixed`: an entry that has this value."""
    from scipy.optimize import minimize  # late: slow to import

    more, reach = len(start) - len(model.typical), np.log([_SMALLEST, _LARGEST])
    bounds = [*(np.log(model.typical)[:, None] + reach), *[(-_STEEP, _STEEP)] * more]
    if fixed is not None:
        i, value = fixed
        bounds[i], start = (value, value), np.where(np.arange(len(start)) == i, value, start)
    found = minimize(
        lambda x: model.deviance(_root(model, x)), start, method="L-BFGS-B", bounds=bounds
    )
    return found.x, float(found.fun)


def _ends(model: "_Model", best: np.ndarray, least: float, i: int) -> tuple[float, float]:
    """Where the deviance of the i-th standard deviation, over the noise, passes its limit."""
    from scipy.optimize import brentq  # late: slow to import

    def above(log: float) -> float:
        """The deviance with this logarithm, over the limit."""
        return _least(model, best, (i, log))[1] - least - _LIMIT

    ends = []
    for edge, none in ((_SMALLEST, 0.0), (_LARGEST, np.inf)):
        far = float(np.log(edge * model.typical[i]))
        ends.append(
            none if above(far) <= 0 else float(np.exp(brentq(above, best[i], far, xtol=_END)))
        )
    return ends[0], ends[1]


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
    """Shots with noise 1 and effects of covariance L L^T along the columns of Z_k (., q)."""

    def __init__(self, fit: FitResult, which: list[int]):
        residual, jacobian, shot = _weighted(fit)
        shots = np.unique(shot[shot != NO_SHOT])
        if len(shots) < LEAST_SHOTS:
            raise ValueError(
                f"Argument `fit` must be of at least {LEAST_SHOTS} shots, but has {len(shots)}."
            )
        columns, member = jacobian[:, which], (shot[None, :] == shots[:, None]).astype(float)
        self.residual, self.jacobian = residual, jacobian
        self.seen = np.einsum("kr,rp,rq->kpq", member, columns, columns)  # Z_k^T Z_k
        self.projected = np.einsum("kr,rp,r->kp", member, columns, residual)  # Z_k^T r_k
        self.crossed = np.einsum("kr,rp,rq->kpq", member, columns, jacobian)  # Z_k^T J_k
        self.values, self.known = fit.problem.values, fit.problem.sigma is not None
        # scatter is searched around the error that one shot has
        self.typical = 1 / np.sqrt(np.mean(np.diagonal(self.seen, axis1=1, axis2=2), axis=0))

    def solve(self, root: np.ndarray) -> tuple[np.ndarray, np.ndarray, float, int]:
        """Change of the parameters, covariance, sum of squares, degrees of freedom; `root` is L."""
        less = root @ np.linalg.inv(self._inner(root)) @ root.T
        information = self.jacobian.T @ self.jacobian
        information = information - np.einsum("kpi,kpq,kqj", self.crossed, less, self.crossed)
        right = self.jacobian.T @ self.residual
        right = right - np.einsum("kpi,kpq,kq", self.crossed, less, self.projected)
        covariance = np.linalg.pinv(information, hermitian=True)
        change = covariance @ right
        squares = self.residual @ self.residual - right @ change
        squares -= np.einsum("kp,kpq,kq", self.projected, less, self.projected)
        rank = np.linalg.matrix_rank(information, hermitian=True)
        return change, covariance, float(squares), int(self.values - rank)

    def _inner(self, root: np.ndarray) -> np.ndarray:
        """`1 + L^T Z_k^T Z_k L` (K, q, q)."""
        return np.eye(len(root)) + root.T @ self.seen @ root

    def deviance(self, root: np.ndarray) -> float:
        """-2 log of the restricted likelihood, up to a constant."""
        _, covariance, squares, freedom = self.solve(root)
        spread = float(np.sum(np.linalg.slogdet(self._inner(root))[1]))
        information = -np.linalg.slogdet(covariance)[1]
        if self.known:
            return spread + information + squares
        return spread + information + freedom * float(np.log(max(squares, np.finfo(float).tiny)))

    def noise(self, squares: float, freedom: int) -> float:
        """Of one value, in units of sigma."""
        if self.known:
            return 1.0
        return float(np.sqrt(squares / freedom)) if freedom > 0 else np.nan
