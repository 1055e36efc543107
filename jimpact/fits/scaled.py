"""A fit in the scaled parameters of its solver, some fixed and the others fitted."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import numpy as np

from jimpact._checks import check_kind
from jimpact.fits.problem import filled_up, from_scaled, to_scaled
from jimpact.fits.result import FitResult
from jimpact.fits.search import START_SCALES, repeated
from jimpact.fits.solve import DEFAULT_STEPS, BoxRegion, Search, SolverState, minimize
from jimpact.progress import Show

# Deviances are right to this (see `solve.FINE`): an interval's ends move by a millionth.
_STOP = 1e-7


class ScaledFit:
    """A fit in scaled parameters y (Q,), and the minima with some of them fixed."""

    def __init__(self, fit: FitResult):
        self.fit, self.problem = fit, fit.problem
        self.residuals = filled_up(fit.problem.residuals)
        r, self.scale, self.log = self.residuals, fit.problem.scale, fit.problem.log
        self.low, self.high = np.asarray(r.low, float), np.asarray(r.high, float)
        self.size = self.problem.size
        # of the weighted residuals; if it is undetermined, that of an exact fit up to rounding
        known = np.isfinite(fit.noise) and fit.noise > 0
        self.variance = float(fit.noise**2) if known else self.problem.exact_squares
        self.least = fit.starts[0].sum_of_squares
        self.best = self.problem.point(fit.value)

    def values(self, i: int, y: np.ndarray) -> np.ndarray:
        """Values of the i-th parameter of scaled ones."""
        return from_scaled(y, self.scale[i], np.broadcast_to(self.log[i], y.shape))

    def reach(
        self, i: int, pieces: Sequence[tuple[float, float]] | None = None
    ) -> tuple[float, float]:
        """The bounds of the i-th parameter or the outer ends of pieces, scaled.

        An infinite end is cut at as many natural scales as starts reach.
        """
        low, high = self.low[i], self.high[i]
        if pieces is not None:
            outer = np.array([pieces[0][0], pieces[-1][1]])
            outer = to_scaled(outer, self.scale[i], np.broadcast_to(self.log[i], 2))
            low, high = max(low, outer[0]), min(high, outer[1])
        low = low if np.isfinite(low) else self.best[i] - START_SCALES
        high = high if np.isfinite(high) else self.best[i] + START_SCALES
        return float(low), float(high)

    def deviance_of(self, squares: Any) -> Any:
        """Sums of squares above the least, over the noise variance."""
        return (squares - self.least) / self.variance

    def minimize(
        self,
        fixed: Sequence[tuple[Sequence[int] | int, np.ndarray]],
        show: Show,
        steps: int = DEFAULT_STEPS["levenberg-marquardt"],
    ) -> tuple[np.ndarray, SolverState]:
        """Sums of squares at the minima from each y (Q,) with these of its entries fixed."""
        points = np.array([y for _, y in fixed])
        low, high = np.tile(self.low, (len(fixed), 1)), np.tile(self.high, (len(fixed), 1))
        for k, (which, y) in enumerate(fixed):
            at = np.array(which, int)
            low[k, at] = high[k, at] = y[at]
        dtype = self.residuals.offset.dtype
        box: Any = BoxRegion(low.astype(dtype), high.astype(dtype))  # type: ignore[arg-type]
        many = repeated(self.residuals, len(fixed))
        many = eqx.tree_at(lambda r: (r.low, r.high, r.region), many, (box.low, box.high, box))
        search = Search(max_steps=steps, show=show)
        states = minimize(many, points, search, _STOP, what="fixed values")
        return 2 * np.asarray(states.cost, float) * self.size**2, states


def check_profiled(fit: FitResult) -> None:
    """Raise an error unless this is a fit, of parameters that can be fixed."""
    check_kind("fit", fit, FitResult)
    if not fit.can_be_profiled:
        raise ValueError(
            "Argument `fit` must be by least squares, and not of a matrix that must be admissible."
        )


def with_entry(y: np.ndarray, i: int, value: float) -> np.ndarray:
    """A copy of y with another i-th entry."""
    changed = np.array(y, float)
    changed[i] = value
    return changed
