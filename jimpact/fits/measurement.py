"""What was measured, with its errors: residuals of predictions, independent of each other."""

import math
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jimpact.fits.covariances import whitening
from jimpact.fits.observables import Prediction
from jimpact.tools.compiling import full_precision

# A trial whose outcome is meaningless gets a residual far above any honest one, so that a solver
# turns back; inadmissible or energetic outcomes are only reported.
PENALTY = 1e3  # times the largest measured value


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Measurement:
    """Measured values (K, n), or of any other shape, and their errors.

    Equation: `residual = L (predicted - value) / sigma` with `L^-1 L^-T` the correlation of the
    errors of a shot, or of all shots; L = 1 of independent ones.

    Attributes:
        value: what was measured; NaN where no value was.
        weight: 1 / sigma, shaped like `value`; 0 where no value was measured.
        unit: the largest measured value.
        size: norm of the weights times `unit`: residuals over it are of order 1.
        mixing: L (K, n, n), or (K, n, K, n); None: errors are independent.
        sigma: standard errors, or None where they are not known; unknown on the device.
    """

    value: Any
    weight: Any
    unit: Any
    size: Any
    mixing: Any = None
    sigma: Any = field(default=None, metadata={"static": True})

    @classmethod
    def of(
        cls, value: np.ndarray, sigma: Any, weight: np.ndarray, unit: Any, mixing: Any = None
    ) -> "Measurement":
        """That of weighed values."""
        unit = np.asarray(float(unit) or 1.0)
        return cls(value, weight, unit, np.asarray(unit * np.linalg.norm(weight)), mixing, sigma)

    @property
    def here(self) -> np.ndarray:
        """Where a value was measured, shaped like `value`."""
        return ~np.isnan(self.value)

    def residual(self, prediction: Prediction) -> jax.Array:
        """(R,) of a prediction, 0 where no value was measured; large where the law failed."""
        bad = jnp.broadcast_to(prediction.bad, self.value.shape)
        error = jnp.where(bad, 0.0, prediction.value) - jnp.where(bad, 0.0, self.value)
        error = jnp.where(bad, PENALTY * self.unit, error)
        error = jnp.where(self.weight > 0, error, 0.0)  # its derivatives may be NaN
        return _mixed(error * self.weight, self.mixing, jnp).reshape(-1)

    def weighed(self, factor: np.ndarray) -> "Measurement":
        """With factors, shaped like `value`, on the independent errors; 0 leaves a value out."""
        used, mixing, weight = factor > 0, self.mixing, self.weight * factor
        if mixing is not None:  # which comes before the factors
            weight, scale = self.weight * used, np.where(used, factor, 1.0)
            if mixing.ndim == 4:  # of all shots: those left out leave the covariance, too
                mixing = _without(mixing, used & self.here)
            mixing = scale.reshape(scale.shape + (1,) * (mixing.ndim - 2)) * mixing
        value = np.where(used, self.value, np.nan)
        return Measurement.of(value, self.sigma, weight, self.unit, mixing)

    def with_covariance(self, covariance: np.ndarray) -> "Measurement":
        """With this covariance (K, n, n) of the values of each shot, or (K, n, K, n) of all."""
        here = self.here
        sigma, mixing = whitening(covariance, here)
        # factors that a weight already has (shots left out) stay
        old = np.where(here, np.asarray(self.sigma, float), 1.0)
        weight, sigma = self.weight * old / sigma, np.where(here, sigma, np.nan)
        return Measurement.of(self.value, sigma, weight, self.unit, mixing)

    def filled(self, shots: np.ndarray) -> "Measurement":
        """The shots of these indices, of which those after the last one have no weight."""
        count = len(self.value)
        parts = self.value, self.weight, self.mixing
        value, weight, mixing = jax.tree.map(lambda x: np.asarray(x)[shots], parts)
        weight[count:] = 0.0
        if mixing is not None and mixing.ndim == 4:
            mixing = mixing[:, :, shots]
            mixing[count:] = 0.0  # or a copy would count as the shot
        return replace(self, value=value, weight=weight, mixing=mixing)

    def independent(self, errors: np.ndarray) -> np.ndarray:
        """Errors (K, n, ...) of what was measured, in units of sigma and as independent ones."""
        return _mixed(np.nan_to_num(errors) * self._weight_of(errors), self.mixing)

    def errors_of(self, independent: np.ndarray) -> np.ndarray:
        """The errors (K, n, ...) that are these as independent ones; NaN where not measured."""
        weight = self._weight_of(independent)
        back = None if self.mixing is None else _inverse(np.asarray(self.mixing, float))
        errors = _mixed(independent, back)
        return np.where(weight > 0, errors / np.where(weight > 0, weight, 1.0), np.nan)

    def _weight_of(self, errors: np.ndarray) -> np.ndarray:
        """The weights, with as many axes as these errors."""
        more = (1,) * (errors.ndim - self.value.ndim)
        return np.asarray(self.weight, float).reshape((*self.value.shape, *more))

    def log_of_norm(self) -> float:
        """`sum log(sigma sqrt(2 pi)) - log det L`: of the density of the errors, sigma known."""
        here = self.here
        sigma, other = np.broadcast_to(self.sigma, here.shape), np.zeros(here.shape)
        if self.mixing is not None:
            size = here.size if self.mixing.ndim == 4 else here.shape[1]
            own = np.diagonal(self.mixing.reshape(-1, size, size), axis1=1, axis2=2)
            other = np.log(own.reshape(here.shape))
        return float(np.sum(np.log(sigma[here] * math.sqrt(2 * math.pi)) - other[here]))


@full_precision
def _mixed(errors: Any, mixing: Any, xp: Any = np) -> Any:
    """Weighted errors (K, n, ...) mixed within each shot, or between all shots."""
    if mixing is None:
        return errors
    axes = "kij,kj...->ki..." if mixing.ndim == 3 else "kilj,lj...->ki..."
    return xp.einsum(axes, mixing, errors)


def _inverse(mixing: np.ndarray) -> np.ndarray:
    """The inverse of mixing within shots (K, n, n), or between all (K, n, K, n)."""
    if mixing.ndim == 3:
        return np.linalg.inv(mixing)
    size = mixing.shape[0] * mixing.shape[1]
    return np.linalg.inv(mixing.reshape(size, size)).reshape(mixing.shape)


def _without(mixing: np.ndarray, here: np.ndarray) -> np.ndarray:
    """Mixing between shots where only the values `here` (K, n) take part."""
    back = _inverse(np.asarray(mixing, float)).reshape(here.size, here.size)
    return whitening((back @ back.T).reshape(mixing.shape), here)[1]
