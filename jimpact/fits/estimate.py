"""Parameters where a search has ended, with the errors of a linearized law."""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import jax
import numpy as np
from scipy.special import ndtri, stdtrit

from jimpact.core.law import AnyLaw
from jimpact.fits.intervals import check_level, joined
from jimpact.fits.problem import FitProblem
from jimpact.fits.search import FitMinimum, Solution
from jimpact.fits.uncertainty import Uncertainty
from jimpact.shots.data import Experiments

# Relative standard error of a stiffness beyond which its linearized interval is not
# believed.
HARDLY_SEEN = 0.2
LEVEL = 0.95  # of confidence intervals, where none is asked for


Value = TypeVar("Value")
Function = TypeVar("Function", bound=Callable[..., Any])


def in_own_precision(function: Function) -> Function:
    """A function of a fit, computed in the precision in which the fit was made.

    JAX's precision may have changed since: what is computed later belongs to the fit
    all the same.
    """

    @functools.wraps(function)
    def computed(fit: Any, *arguments: Any, **options: Any) -> Any:
        """The function, of the fit and its other arguments; of no fit in JAX's own
        precision.
        """
        if not isinstance(fit, Estimate):
            return function(fit, *arguments, **options)
        with jax.enable_x64(fit.problem.precision == "float64"):
            return function(fit, *arguments, **options)

    return computed  # type: ignore[return-value]


class OfField(Generic[Value]):
    """An attribute of a class that is that of the same name of one of its fields."""

    def __init__(self, field: str):
        """`field` holds the attribute."""
        self.field = field

    def __set_name__(self, owner: type, name: str) -> None:
        """`name` is the one that the class body gives it."""
        self.name = name

    def __get__(self, instance: Any, owner: type) -> Value:
        """The attribute of the field; of a class the descriptor itself."""
        if instance is None:
            return self  # type: ignore[return-value]
        value: Value = getattr(getattr(instance, self.field), self.name)
        return value


@dataclass(frozen=True, eq=False, kw_only=True)
class Estimate(Generic[AnyLaw]):
    """P fitted parameters of a law, the minima of the search, and linearized errors;
    see `Fit`.
    """

    law: AnyLaw
    method: str
    names: tuple[str, ...]
    bounds: tuple[np.ndarray, np.ndarray]
    problem: FitProblem
    jacobian: np.ndarray
    search: Solution
    errors: Uncertainty
    loss: str = "squares"
    seed: int = 0

    value = OfField[np.ndarray]("search")
    starts = OfField[tuple[FitMinimum, ...]]("search")
    predicted = OfField[np.ndarray]("search")
    status = OfField[np.ndarray]("search")
    slopes = OfField[np.ndarray | None]("search")
    pre = OfField[np.ndarray | None]("search")
    converged = OfField[bool]("search")
    stuck = OfField[bool]("search")
    at_bound = OfField[np.ndarray]("search")
    steps = OfField[int]("search")
    lost_starts = OfField[int]("search")
    rank = OfField[int]("errors")
    singular_values = OfField[np.ndarray]("errors")
    degrees_of_freedom = OfField[int]("errors")
    noise = OfField[float]("errors")
    covariance = OfField[np.ndarray]("errors")
    correlation = OfField[np.ndarray]("errors")
    standard_error = OfField[np.ndarray]("errors")
    identifiability = OfField[tuple[str, ...]]("errors")

    @property
    def residual(self) -> np.ndarray:
        """Measured less predicted, shaped like what was measured; NaN where no value
        was.
        """
        return np.asarray(self.problem.measured, float) - self.predicted

    @property
    def rms(self) -> float:
        """Root mean square of the residual, of rad/s by kinetic energy [m/s]."""
        return self.problem.rms(self.residual)

    @property
    def experiments(self) -> Experiments | None:
        """The shots; None where something else was fitted."""
        return self.problem.experiments

    @property
    def shot_count(self) -> int:
        """Shots (or rows of what was measured) with at least one value that was
        used.
        """
        measured = np.isfinite(self.problem.measured)
        axes = tuple(range(1, measured.ndim))
        return int(measured.any(axis=axes).sum())

    @property
    def start_count(self) -> int:
        """Number of starts, those that were given up included."""
        return sum(minimum.count for minimum in self.starts) + self.lost_starts

    @property
    def chi_squared(self) -> float:
        """The sum of squared residuals in units of sigma, those of priors included; NaN
        where sigma is unknown.
        """
        if self.problem.sigma is None:
            return np.nan
        return self.starts[0].sum_of_squares

    @property
    def aic(self) -> float:
        """Akaike's information criterion of a fit by least squares; else, and of exact
        data, NaN.

        Equation: `chi^2 + 2 P`; where sigma is unknown `n log(|r|^2 / n) + 2 (P + 1)`,
        n values.
        """
        squares = self.starts[0].sum_of_squares
        values = self.problem.values
        if self.loss != "squares":
            return np.nan
        if self.problem.sigma is not None:
            return squares + 2 * len(self.names)
        if squares <= self.problem.exact_squares:
            return np.nan
        parameters = len(self.names) + 1
        return float(values * np.log(squares / values) + 2 * parameters)

    def quantile(self, level: float) -> float:
        """Half-width of a confidence interval of this `level`, in standard errors.

        The quantile at `(1 + level) / 2` of the normal distribution where sigma is
        known, else of Student's t.
        """
        check_level(level)
        freedom = self.degrees_of_freedom
        tail = 0.5 + 0.5 * level
        noise_is_known = self.problem.sigma is not None or freedom < 1
        return float(ndtri(tail) if noise_is_known else stdtrit(freedom, tail))

    def linearized_interval(self, i: int, q: float) -> tuple[tuple[float, float], ...]:
        """Pieces of the interval of parameter `i`, within `q` standard errors at each
        minimum.

        Equation: `x -+ error sqrt(q^2 - (S - S_best) / s^2)` at a minimum x of sum of
        squares S, s the noise; of what is fitted in its logarithm `x exp(-+ .. / x)`;
        cut at the bounds.
        """
        low = self.bounds[0][i]
        high = self.bounds[1][i]
        # the last one: S - S_best
        minima = [(self.value[i], self.standard_error[i], 0.0)]
        for minimum in self.starts[1:]:
            more = minimum.sum_of_squares - self.starts[0].sum_of_squares
            if minimum.standard_error is not None and more < (q * self.noise) ** 2:
                minimum_and_error = (minimum.value[i], minimum.standard_error[i], more)
                minima.append(minimum_and_error)
        pieces = []
        for value, error, more in minima:
            share = more / self.noise**2 if more else 0.0
            half = error * np.sqrt(q**2 - share)
            ends = value + np.array([-half, half])
            if self.problem.parameters.log[i]:
                both_sides = np.array([-half, half]) / value
                ends = value * np.exp(both_sides)
            pieces.append(tuple(np.clip(ends, low, high)))
        return joined(pieces)

    def linearized_intervals(
        self, level: float
    ) -> tuple[tuple[tuple[float, float], ...], ...]:
        """The pieces of `linearized_interval` of each of the P parameters."""
        q = self.quantile(level)
        return tuple(self.linearized_interval(i, q) for i in range(len(self.names)))

    @property
    def can_be_profiled(self) -> bool:
        """True for least squares within bounds: not for an admissible matrix or a
        robust loss.
        """
        return self.loss == "squares" and self.problem.matrix is None

    @property
    def linearization_misleads(self) -> bool:
        """True where the sum of squares is visibly no parabola: standard errors may
        mislead.

        That is in a valley, at a bound, with several minima, of a stiffness that is
        hardly seen.
        """
        if not self.can_be_profiled or not self.converged:
            return False
        if self.rank < len(self.names):
            return True
        if not np.isfinite(self.noise):
            return False  # the errors are unknown
        hardly = HARDLY_SEEN * self.value
        wide = self.problem.parameters.log & (self.standard_error > hardly)
        pieces = self.linearized_intervals(LEVEL)
        ends = [(each[0][0], each[-1][1]) for each in pieces]
        low, high = np.array(ends).T
        at_low_end = low <= self.bounds[0]
        at_end = at_low_end | (high >= self.bounds[1])
        in_pieces = max(map(len, pieces)) > 1
        return bool((wide | at_end).any()) or in_pieces
