"""Errors of fitted parameters: covariance, rank, what is not determined; intervals; the result."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import qr
from scipy.special import ndtri, stdtrit

from jimpact.core.law import AnyLaw, parameters_of
from jimpact.core.scene import Scene
from jimpact.fits.data import Experiments
from jimpact.fits.findings import Finding
from jimpact.fits.parameters import LawInScene, tied_names, tied_value
from jimpact.fits.problem import FitProblem, outcome_at
from jimpact.fits.search import FitMinimum, Solution, solution_of
from jimpact.fits.solve import RANK_TOLERANCE
from jimpact.tools.checks import check_choice, check_kind, check_shape, check_values
from jimpact.tools.records import Column, Table, Tabular, counted, plain
from jimpact.tools.status import STATUS

_PRINTED_SHOTS = 12  # of predictions; ten times more fill pages

# A parameter takes part in an undetermined combination if its share of that direction exceeds this;
# shares of parameters that take no part are errors of the derivatives, about 1e-6.
TAKES_PART = 1e-3

SMALL_CHANGE = 0.01  # the size, in natural scales, in which undetermined combinations are stated
# Relative standard error of a stiffness beyond which its linearized interval is not believed.
HARDLY_SEEN = 0.2

# Share of a prior's standard deviation from which on a standard error is the prior's: the data have
# then less than a tenth of the information. Ten times as much would call priors of half of it so.
PRIOR_ALONE = 0.95


# ---------------------------------------------------------------------------- linearized errors


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Errors of P parameters; see `Fit`."""

    rank: int
    singular_values: np.ndarray
    degrees_of_freedom: int
    noise: float
    covariance: np.ndarray
    correlation: np.ndarray
    standard_error: np.ndarray
    identifiability: tuple[str, ...]


def uncertainty(
    problem: FitProblem, minimum: FitMinimum, noise: float | None = None
) -> Uncertainty:
    """Linearized errors at a minimum.

    Equation: `C = s^2 (J^T J)^-1` on the determined subspace, `s^2 = |r|^2 / (values - rank)`, or
    the known noise (1 where the weights are known errors); rank = number of singular values of J,
    its columns scaled by the natural size of each parameter, above `RANK_TOLERANCE` times the
    largest. Data without sigma that are reproduced to the last digit do not show their noise.

    Args:
        problem: that was solved.
        minimum: of it.
        noise: s; None: as stated, or from |r|^2.
    """
    scale = problem.steps_at(minimum.value)
    _, singular, directions = np.linalg.svd(minimum.jacobian, full_matrices=True)
    singular = np.pad(singular, (0, len(scale) - len(singular)))
    rank = int(np.sum(singular > RANK_TOLERANCE[problem.precision] * singular[0]))
    freedom = problem.values - rank
    if noise is None:
        shown = freedom >= 1 and minimum.sum_of_squares > problem.exact_squares
        estimated = float(np.sqrt(minimum.sum_of_squares / freedom)) if shown else np.nan
        noise = estimated if problem.sigma is None else 1.0
    determined = directions[:rank] / singular[:rank, None]
    covariance = noise**2 * (determined.T @ determined) * np.outer(scale, scale)
    null = directions[rank:]
    lost = np.any(np.abs(null) > TAKES_PART, axis=0)
    covariance[lost, :] = covariance[:, lost] = np.nan
    covariance[lost, lost] = np.inf
    error = np.sqrt(np.diag(covariance))
    with np.errstate(divide="ignore", invalid="ignore"):
        correlation = covariance / np.outer(error, error)
    np.fill_diagonal(correlation, 1.0)
    unseen = _reduced(null) if len(null) else null
    words = (*problem.notes, *(_in_words(problem, row, scale) for row in unseen))
    return Uncertainty(rank, singular, freedom, noise, covariance, correlation, error, words)


def _reduced(null: np.ndarray) -> np.ndarray:
    """The same subspace in reduced row echelon form: each direction with few parameters."""
    _, rows, pivots = qr(null, mode="economic", pivoting=True)
    rows[:, pivots] = np.linalg.solve(rows[:, : len(rows)], rows)
    return np.asarray(rows)


def _in_words(problem: FitProblem, direction: np.ndarray, scale: np.ndarray) -> str:
    """A direction that leaves all predictions as they are, as small changes of parameters."""
    names, log = problem.names, problem.parameters.log
    value_name = "value" if problem.experiments is None else "velocity"
    parts, taking_part = [], []
    step = SMALL_CHANGE * direction / np.abs(direction).max()
    for i in np.argsort(-np.abs(step), kind="stable"):
        if abs(step[i]) > TAKES_PART * SMALL_CHANGE:
            change = f"{100 * abs(step[i]):.2g} %" if log[i] else f"{abs(step[i] * scale[i]):.2g}"
            taking_part.append(names[i])
            parts.append(f"{names[i]} goes {'up' if step[i] > 0 else 'down'} by {change}")
    if len(parts) == 1:
        return (
            f"The data cannot see {taking_part[0]}: no measured {value_name} depends on it (to "
            "first order)."
        )
    return (
        f"The data cannot see a combination: no measured {value_name} changes (to first order) "
        f"when {', '.join(parts[:-1])} and {parts[-1]} together."
    )


# ---------------------------------------------------------------------------- intervals


def check_level(level: float) -> None:
    """Raise a ValueError unless this is a confidence level."""
    check_shape("level", level, (), "one number")
    check_values("level", level)
    if not 0 < level < 1:
        raise ValueError(f"Argument `level` must lie in (0, 1), but has value {level!r}.")


def pieces_in_words(pieces: Iterable[tuple[float, float]], domain: tuple[float, float]) -> str:
    """Pieces of an interval; an end of the domain is left out."""
    return " or ".join(_piece(*ends, domain) for ends in pieces)


def _piece(low: float, high: float, domain: tuple[float, float]) -> str:
    """One piece of an interval in words."""
    open_low, open_high = low <= domain[0], high >= domain[1]
    if open_low and open_high:
        return "anything"
    if open_low or open_high:
        return f"at most {high:.5g}" if open_low else f"at least {low:.5g}"
    return f"{low:.5g} to {high:.5g}"


@dataclass(frozen=True, eq=False)
class Profile:
    """`deviance` (G,) over the `value`s (G,) of parameter `name`, and where it is below `limit`.

    `deviance` is the sum of squares with the parameter fixed, less its least value, over the noise
    variance. `intervals` are the pieces of the confidence interval at `level`, in order; an end at
    `domain` means that the data do not bound the parameter there. `better`: values of a minimum
    below that of the fit, or None.
    """

    name: str
    value: np.ndarray
    deviance: np.ndarray
    limit: float
    level: float
    intervals: tuple[tuple[float, float], ...]
    domain: tuple[float, float]
    better: np.ndarray | None = None

    @property
    def words(self) -> str:
        """The interval in words.

        >>> import numpy as np
        >>> from jimpact.fits.uncertainty import Profile
        >>> first = ("e", np.zeros(1), np.zeros(1), 4.0, 0.95)
        >>> Profile(*first, ((0.25, 0.5), (0.75, 1.0)), (0.0, 1.0)).words
        '0.25 to 0.5 or at least 0.75'
        """
        return pieces_in_words(self.intervals, self.domain)

    @property
    def open_ends(self) -> tuple[bool, bool]:
        """Whether the data leave the parameter unbounded below, and above."""
        return self.intervals[0][0] <= self.domain[0], self.intervals[-1][1] >= self.domain[1]

    @property
    def determines(self) -> bool:
        """Whether the data exclude any value of the domain."""
        return len(self.intervals) > 1 or not all(self.open_ends)

    def __str__(self) -> str:
        return f"{self.name}: {self.words} ({100 * self.level:g} %)"


def joined(pieces: Iterable[tuple[float, float]]) -> tuple[tuple[float, float], ...]:
    """The same set in pieces apart from each other, in order.

    >>> from jimpact.fits.uncertainty import joined
    >>> joined([(3.0, 4.0), (0.0, 1.0), (0.5, 2.0)])
    ((0.0, 2.0), (3.0, 4.0))
    """
    union: list[tuple[float, float]] = []
    for low, high in sorted(pieces):
        if union and low <= union[-1][1]:
            union[-1] = (union[-1][0], max(high, union[-1][1]))
        else:
            union.append((float(low), float(high)))
    return tuple(union)


# ---------------------------------------------------------------------------- the result


class FittedParameter(NamedTuple):
    """A parameter of a fit: its value, standard error, 95 % interval in pieces, and whether the
    data determine it."""

    value: float
    standard_error: float
    intervals: tuple[tuple[float, float], ...]
    determined: bool


class Predicted(NamedTuple):
    """Velocities after each shot (K, n) [m/s], their standard errors (K, n), status codes (K,).

    `noise` (K, n) is the standard error of a measurement of them. `low` and `high` (K, n) are the
    ends of the band in which such a measurement lies. `units` (n,): of the velocities.
    """

    velocity: np.ndarray
    standard_error: np.ndarray
    status: np.ndarray
    noise: np.ndarray
    low: np.ndarray
    high: np.ndarray
    units: tuple[str, ...]

    def __str__(self) -> str:
        """A row for each velocity; a status where it is not ok."""
        columns = (
            *(Column("shot"), Column("coordinate"), Column("velocity", ".5g")),
            *(Column("standard_error", ".2g", "std. error"), Column("low", ".5g")),
            *(Column("high", ".5g"), Column("unit"), Column("status")),
        )
        rows = [
            [
                *(k + 1, i + 1, plain(float(self.velocity[k, i])), self.standard_error[k, i]),
                *(self.low[k, i], self.high[k, i], self.units[i]),
                STATUS[int(self.status[k])].name if self.status[k] else None,
            ]
            for k, i in np.ndindex(*self.velocity[:_PRINTED_SHOTS].shape)
        ]
        more = len(self.velocity) - _PRINTED_SHOTS
        notes = [f"... and {counted(more, 'more shot')}"] if more > 0 else []
        return str(Table(columns, rows, notes=[*notes, "low to high: of a measurement."], keys=2))


@dataclass(frozen=True, eq=False, kw_only=True)
class FitResult(Solution, Uncertainty, Tabular, Generic[AnyLaw]):
    """What `fit` finds, in numbers: see `Fit`, which can be printed and saved."""

    law: AnyLaw
    method: str
    names: tuple[str, ...]
    bounds: tuple[np.ndarray, np.ndarray]
    residual: np.ndarray
    rms: float
    findings: tuple[Finding, ...]
    problem: FitProblem
    jacobian: np.ndarray
    loss: str = "squares"
    seed: int = 0
    profiles: tuple[Profile, ...] = ()
    picture = "fit"

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is wrong with data or fit, in words."""
        return tuple(each.line for each in self.findings if each.line)

    @property
    def reservations(self) -> tuple[str, ...]:
        """In words, what has to be said where a value is quoted."""
        return tuple(each.reservation for each in self.findings if each.reservation)

    def found(self, kind: str) -> bool:
        """Whether there is a finding of this kind, one of `jimpact.fits.findings.KINDS`."""
        return any(each.kind == kind for each in self.findings)

    @property
    def table(self) -> Table:
        """A row a parameter: value, standard error, ends of its 95 % interval, whether seen."""
        names = ("value", "standard_error", "low_95", "high_95", "at_bound", "determined")
        ends = self.confidence_interval().T
        columns = (self.value, self.standard_error, *ends, self.at_bound, self.determined)
        rows = list(zip(self.names, *(column.tolist() for column in columns)))
        return Table([Column(name) for name in ("parameter", *names)], rows)

    @property
    def scene(self) -> Scene | None:
        """The scene of all shots, with what was fitted of it; None: the shots have their own."""
        return self.problem.to_scene(self.value)

    @property
    def determined(self) -> np.ndarray:
        """(P,) which parameters the data say anything about; the values of others are starts."""
        seen = ~np.isinf(self.standard_error)
        for i, each in enumerate(self.profiles):
            seen[i] &= each.determines
        return seen

    @property
    def from_prior(self) -> np.ndarray:
        """(P,) which parameters are known from their priors alone: the data add hardly anything."""
        std = np.full(len(self.names), np.inf)
        for prior in self.problem.priors:
            std[prior.parameter] = prior.std
        return self.standard_error > PRIOR_ALONE * self.noise * std

    @property
    def tied(self) -> dict[str, tuple[float, float]]:
        """What is tied to parameters, by name: values with their standard errors."""
        problem, ties = self.problem, self.problem.ties
        if not ties:
            return {}

        def values(x: jax.Array) -> jax.Array:
            """The tied entries of parameters x."""
            law = problem.law_in_scene(x)
            return jnp.concatenate([tied_value(law, tie) for tie in ties])

        x, names = jnp.asarray(self.value, problem.precision), tied_names(problem.law, ties)
        errors = self.errors_of(np.asarray(jax.jacfwd(values)(x), float))
        return dict(zip(names, zip(np.asarray(values(x), float).tolist(), errors.tolist())))

    def errors_of(self, slope: np.ndarray) -> np.ndarray:
        """Standard errors of what depends on the parameters.

        Equation: `sqrt(J C J^T)`; inf where it depends on what the data do not determine.

        Args:
            slope: its derivatives (..., P) in the parameters.
        """
        seen = self.determined
        known = slope[..., seen]
        covariance = self.covariance[np.ix_(seen, seen)]
        variance = np.einsum("...p,pq,...q->...", known, covariance, known)
        blind = (np.abs(slope[..., ~seen]) > 0).any(axis=-1)
        return np.where(blind, np.inf, np.sqrt(variance))

    def predict(self, shots: Any, scene: Scene | None = None, level: float = 0.95) -> Predicted:
        """Velocities after further shots, with the errors that the parameters leave in them.

        Equation: `sqrt(J C J^T)`, J derivatives in the parameters, C their covariance; a
        measurement, with its own standard error s, lies within `q sqrt(J C J^T + s^2)`, q the
        quantile as in `intervals`.

        Args:
            shots: v- (K, n) [m/s], or `Experiments`, of which v- and scenes count.
            scene: of all shots; None: that of the fit, or those of the shots.
            level: of the band.

        Returns:
            `velocity` (K, n) [m/s], `standard_error` (K, n): inf where it depends on what the data
            do not determine, NaN where the errors are unknown; `status` (K,); `noise` (K, n) of a
            measurement: the `sigma` of the shots if they have one, else as in the fit; `low` and
            `high` (K, n), the band of a measurement.

        Raises:
            ValueError: a fit of something else than shots; velocities that do not fit the scene, a
                scene that does not fit the law; a level outside (0, 1).
        """
        quantile = self.quantile(level)
        if self.experiments is None:
            raise ValueError("Argument `fit` must be to shots.")
        data, scenes, units, sigma = shots, None, self.experiments.units, None
        if isinstance(shots, Experiments):
            data, scenes, units, sigma = shots.pre, shots.scenes, shots.units, shots.sigma
        if np.ndim(data) != 2 or np.shape(data)[1] != len(units):
            raise ValueError(
                f"Argument `shots` must have shape (K, {len(units)}), velocities of the bodies of "
                f"the fit, but has shape {np.shape(data)}."
            )
        check_values("shots", data)
        data = Experiments(data, np.zeros_like(np.asarray(data, float)), scenes=scenes, units=units)
        if isinstance(self.problem.law, LawInScene) and scene is not None:
            raise ValueError(
                "Argument `scene` must be left out where parts of the scene were fitted: they hold "
                "for that of the fit only."
            )
        own = self.problem.scene if scene is None else scene
        largest = own if scenes is None else max(scenes, key=lambda each: each.contacts)
        self._check_scene(largest, len(units))
        problem = self.problem.of_other(data, own)
        there = solution_of(problem, outcome_at(problem, self.value))
        error = self.errors_of(problem.derivatives(there.starts[0]))
        value, noise = there.predicted, np.broadcast_to(self._noise_of(sigma), data.pre.shape)
        half = quantile * np.hypot(error, noise)
        band, status = (value - half, value + half), np.asarray(there.status)
        return Predicted(value, error, status, noise, *band, tuple(units))

    def _check_scene(self, scene: Any, size: int) -> None:
        """Raise unless this is a scene for the law that was fitted and velocities of this size."""
        check_kind("scene", scene, Scene)
        values = [x.value for x in parameters_of(self.law).values() if x.domain.per_contact]
        counts = {np.shape(value)[0] for value in values if np.ndim(value) == 1}
        if scene.size != size or counts - {scene.contacts}:
            also = f" and {min(counts)} contacts, one for each value of the law" if counts else ""
            raise ValueError(
                f"Argument `scene` must have {size} velocities as the fit{also}, but has "
                f"{scene.size} and {scene.contacts}."
            )

    def _noise_of(self, sigma: Any) -> np.ndarray:
        """Standard errors of measured velocities: of these, or as in the fit (rms)."""
        if sigma is not None:
            stretched = 1.0 if self.problem.sigma is None else self.noise
            return stretched * np.asarray(sigma, float)
        weight = np.ma.masked_equal(np.asarray(self.problem.measurement.weight, float), 0.0)
        # NaN: never measured
        return self.noise * np.sqrt((1 / weight**2).mean(axis=0)).filled(np.nan)

    @property
    def experiments(self) -> Experiments | None:
        """The shots; None where something else was fitted."""
        return self.problem.experiments

    @property
    def shot_count(self) -> int:
        """Shots (or rows of what was measured) with at least one value that was used."""
        measured = np.isfinite(self.problem.measured)
        return int(measured.any(axis=tuple(range(1, measured.ndim))).sum())

    @property
    def start_count(self) -> int:
        """Starts, those that were given up included."""
        return sum(minimum.count for minimum in self.starts) + self.lost_starts

    def __getitem__(self, name: str) -> FittedParameter:
        """The parameter of this name, as in `names`."""
        check_choice("name", name, self.names)
        i = self.names.index(name)
        value, error = float(self.value[i]), float(self.standard_error[i])
        return FittedParameter(value, error, self.intervals()[i], bool(self.determined[i]))

    @property
    def chi_squared(self) -> float:
        """The sum of squared residuals in units of sigma, those of priors included; NaN where sigma
        is unknown."""
        return np.nan if self.problem.sigma is None else self.starts[0].sum_of_squares

    @property
    def aic(self) -> float:
        """Akaike's criterion of a fit by least squares; NaN of other losses and of exact data.

        Equation: `chi^2 + 2 P`; where sigma is unknown `n log(|r|^2 / n) + 2 (P + 1)`, n values.
        """
        squares, values = self.starts[0].sum_of_squares, self.problem.values
        if self.loss != "squares":
            return np.nan
        if self.problem.sigma is not None:
            return squares + 2 * len(self.names)
        if squares <= self.problem.exact_squares:
            return np.nan
        return float(values * np.log(squares / values) + 2 * (len(self.names) + 1))

    def intervals(self, level: float = 0.95) -> tuple[tuple[tuple[float, float], ...], ...]:
        """The pieces, in order, of the confidence interval of each of the P parameters.

        Those of `profiles`, if there are some of this level. Else linearized, cut at the bounds, a
        piece for every minimum that fits well enough.

        Equation: `value -+ q standard_error`, q the quantile of Student's t with the degrees of
        freedom that are left, or of the normal law if `sigma` is known; of what is fitted in
        its logarithm `value exp(-+ q standard_error / value)`; at a minimum whose sum of squares
        is higher by d, q^2 - d / noise^2 in place of q^2.
        """
        if self.profiles and self.profiles[0].level == level:
            return tuple(profile.intervals for profile in self.profiles)
        q = self.quantile(level)
        return tuple(self.linearized_interval(i, q) for i in range(len(self.names)))

    def confidence_interval(self, level: float = 0.95) -> np.ndarray:
        """The outermost ends (P, 2) of `intervals` at a level in (0, 1)."""
        return np.array([(pieces[0][0], pieces[-1][1]) for pieces in self.intervals(level)])

    def quantile(self, level: float) -> float:
        """Half-width of an interval of this `level` in standard errors."""
        check_level(level)
        freedom, tail = self.degrees_of_freedom, 0.5 + 0.5 * level
        noise_is_known = self.problem.sigma is not None or freedom < 1
        return float(ndtri(tail) if noise_is_known else stdtrit(freedom, tail))

    def linearized_interval(self, i: int, q: float) -> tuple[tuple[float, float], ...]:
        """Where parabolas at all minima let parameter `i` lie within `q` standard errors."""
        low, high = self.bounds[0][i], self.bounds[1][i]
        minima = [(self.value[i], self.standard_error[i], 0.0)]
        for minimum in self.starts[1:]:
            more = minimum.sum_of_squares - self.starts[0].sum_of_squares
            if minimum.standard_error is not None and more < (q * self.noise) ** 2:
                minima.append((minimum.value[i], minimum.standard_error[i], more))
        pieces = []
        for value, error, more in minima:
            half = error * np.sqrt(q**2 - (more / self.noise**2 if more else 0.0))
            ends = value + np.array([-half, half])
            if self.problem.parameters.log[i]:
                ends = value * np.exp(np.array([-half, half]) / value)
            pieces.append(tuple(np.clip(ends, low, high)))
        return joined(pieces)

    @property
    def shows_lack_of_fit(self) -> bool:
        """Whether a test rejects the law."""
        return self.found("lack_of_fit")

    @property
    def can_be_profiled(self) -> bool:
        """Whether parameters can be fixed: least squares in a box, not of an admissible matrix."""
        return self.loss == "squares" and self.problem.matrix is None

    @property
    def linearization_misleads(self) -> bool:
        """Whether standard errors may mislead and the fit has no profiles yet."""
        if self.profiles or not self.can_be_profiled or not self.converged:
            return False
        if self.rank < len(self.names):
            return True
        if not np.isfinite(self.noise):
            return False  # the errors are unknown
        wide = self.problem.parameters.log & (self.standard_error > HARDLY_SEEN * self.value)
        low, high = self.confidence_interval().T
        at_end = (low <= self.bounds[0]) | (high >= self.bounds[1])
        return bool((wide | at_end).any()) or max(map(len, self.intervals())) > 1
