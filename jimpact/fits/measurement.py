"""What was measured, with its errors: residuals of predictions, independent of each
other.
"""

import math
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jimpact.fits.observables import Prediction
from jimpact.fits.solve import AnyArray
from jimpact.shots.covariances import whitening
from jimpact.tools.compiling import full_precision

# A trial whose outcome is meaningless gets a residual far above any honest one, so that
# a solver turns back; inadmissible or energetic outcomes are only reported.
PENALTY = 1e3  # times the largest measured value


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Measurement:
    """Measured values (K, n) of K shots, or of any other shape, and their errors.

    Equation: `residual = L (predicted - value) / sigma` with `L^-1 L^-T` the
    correlation of the errors of a shot, or of all shots; L = 1 of independent ones.

    Attributes:
        value: what was measured; NaN where no value was.
        weight: 1 / sigma, shaped like `value`; 0 where no value was measured.
        unit: the largest measured value.
        size: `unit |weight|`: residuals over it are of order 1.
        mixing: L (K, n, n) of each shot, or (K, n, K, n) of all; None: errors are
            independent.
        sigma: standard errors, or None where they are not known, and on the device.
    """

    value: Float[AnyArray, "*value"]
    weight: Float[AnyArray, "*value"]
    unit: Float[AnyArray, ""]
    size: Float[AnyArray, ""]
    mixing: Float[AnyArray, "K n n"] | Float[AnyArray, "K n K n"] | None = None
    sigma: Any = field(default=None, metadata={"static": True})

    @classmethod
    def of(
        cls,
        value: Float[AnyArray, "*value"],
        sigma: Any,
        weight: Float[AnyArray, "*value"],
        unit: Any,
        mixing: Any = None,
    ) -> "Measurement":
        """The measurement of values of these weights; its `size` follows from them."""
        unit = np.asarray(float(unit) or 1.0)
        size = np.asarray(unit * np.linalg.norm(weight))
        return cls(value, weight, unit, size, mixing, sigma)

    @property
    def is_measured(self) -> Bool[np.ndarray, "*value"]:
        """True where a value was measured."""
        return np.asarray(~np.isnan(self.value))

    def error(self, prediction: Prediction) -> Float[Array, "*value"]:
        """`predicted - value`; 0 where no value was measured.

        Where the prediction is meaningless, it is off by `PENALTY` times the largest
        value.
        """
        bad = jnp.broadcast_to(prediction.bad, self.value.shape)
        predicted = jnp.where(bad, 0.0, prediction.value)
        error = predicted - jnp.where(bad, 0.0, self.value)
        error = jnp.where(bad, PENALTY * self.unit, error)
        return jnp.where(self.weight > 0, error, 0.0)  # its derivatives may be NaN

    def residual(self, prediction: Prediction) -> Float[Array, " R"]:
        """`L error / sigma` of R values, with `error` as above."""
        error = self.error(prediction)
        weighed = error * self.weight
        return _mixed(weighed, self.mixing, jnp).reshape(-1)

    def weighed(self, factor: Float[np.ndarray, "*value"]) -> "Measurement":
        """The measurement with residuals `factor` times as large; 0 leaves a value out.

        The factors belong to the independent residuals: L becomes `diag(factor) L`.
        """
        used = factor > 0
        mixing = self.mixing
        weight = self.weight * factor
        if mixing is not None:  # factors times L, instead of weights times factors
            weight = self.weight * used
            scale = np.where(used, factor, 1.0)
            # of all shots: those left out leave the covariance, too
            if mixing.ndim == 4:
                mixing = _without(np.asarray(mixing, float), used & self.is_measured)
            mixing = scale.reshape(scale.shape + (1,) * (mixing.ndim - 2)) * mixing
        value = np.where(used, self.value, np.nan)
        return Measurement.of(value, self.sigma, weight, self.unit, mixing)

    def with_covariance(
        self, covariance: Float[np.ndarray, "K n n"] | Float[np.ndarray, "K n K n"]
    ) -> "Measurement":
        """The measurement with this covariance of the values of each shot, or of all
        shots.

        Equation: sigma is the root of its diagonal; `L = F^-1`, F the Cholesky factor
        of the correlation.
        """
        measured = self.is_measured
        sigma, mixing = whitening(covariance, measured)
        # factors that a weight already has (shots left out) stay
        sigma_of_data = np.asarray(self.sigma, float)
        old = np.where(measured, sigma_of_data, 1.0)
        weight = self.weight * old / sigma
        sigma = np.where(measured, sigma, np.nan)
        return Measurement.of(self.value, sigma, weight, self.unit, mixing)

    def filled(self, shots: Int[np.ndarray, " M"]) -> "Measurement":
        """M >= K shots by their indices: all K of them, then copies, which have no
        weight.
        """
        count = len(self.value)
        parts = self.value, self.weight, self.mixing
        value, weight, mixing = jax.tree.map(lambda x: np.asarray(x)[shots], parts)
        weight[count:] = 0.0
        if mixing is not None and mixing.ndim == 4:  # (M, n, K, n) so far
            mixing = mixing[:, :, shots]
            mixing[count:] = 0.0  # or a copy would count as the shot
        return replace(self, value=value, weight=weight, mixing=mixing)

    def independent(self, errors: Any) -> Float[np.ndarray, "..."]:
        """Errors `L e / sigma` (K, n, ...) of variance 1, independent of each other, of
        errors e.

        NaN counts as 0. Further axes hold derivatives, or samples.
        """
        errors = np.asarray(np.nan_to_num(errors))
        weighed = errors * self._weight_of(errors)
        return np.asarray(_mixed(weighed, self.mixing))

    def errors_of(
        self, independent: Float[np.ndarray, "..."]
    ) -> Float[np.ndarray, "..."]:
        """The inverse of `independent`: `e = sigma L^-1 u` (K, n, ...) of independent
        errors u.

        NaN where no value was measured.
        """
        weight = self._weight_of(independent)
        if self.mixing is None:
            back = None
        else:
            back = _inverse(np.asarray(self.mixing, float))
        errors = _mixed(independent, back)
        divisor = np.where(weight > 0, weight, 1.0)
        return np.where(weight > 0, errors / divisor, np.nan)

    def _weight_of(self, errors: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """The weights, with axes of length 1 behind, as many axes as these errors
        have.
        """
        more = (1,) * (errors.ndim - self.value.ndim)
        shape = (*self.value.shape, *more)
        return np.asarray(self.weight, float).reshape(shape)

    def log_of_norm(self) -> float:
        """`sum log(sigma sqrt(2 pi)) - log det L`: minus the logarithm of the density
        at error 0.

        It needs a known sigma. L is triangular: log det L is the sum over its diagonal.
        """
        measured = self.is_measured
        shape = measured.shape
        sigma = np.broadcast_to(self.sigma, shape)
        log_diagonal = np.zeros(shape)
        if self.mixing is not None:
            if self.mixing.ndim == 4:
                size = measured.size
            else:
                size = shape[1]
            blocks = self.mixing.reshape(-1, size, size)
            diagonal = np.diagonal(blocks, axis1=1, axis2=2)
            log_diagonal = np.log(diagonal.reshape(shape))
        root = math.sqrt(2 * math.pi)
        log_sigma = np.log(sigma[measured] * root)
        return float(np.sum(log_sigma - log_diagonal[measured]))


@full_precision
def _mixed(errors: Any, mixing: Any, xp: Any = np) -> Any:
    """`L e` of weighted errors e (K, n, ...) by numpy or jax.numpy, `xp`.

    L is `mixing`, (K, n, n) of each shot or (K, n, K, n) of all shots together; None:
    the identity.
    """
    if mixing is None:
        return errors
    if mixing.ndim == 3:
        axes = "kij,kj...->ki..."
    else:
        axes = "kilj,lj...->ki..."
    return xp.einsum(axes, mixing, errors)


def _inverse(mixing: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """`L^-1` of L (K, n, n) of each shot, or (K, n, K, n) of all, in the same shape."""
    if mixing.ndim == 3:
        return np.linalg.inv(mixing)
    size = mixing.shape[0] * mixing.shape[1]
    square = mixing.reshape(size, size)
    return np.linalg.inv(square).reshape(mixing.shape)


def _without(
    mixing: Float[np.ndarray, "K n K n"], used: Bool[np.ndarray, "K n"]
) -> Float[np.ndarray, "K n K n"]:
    """L of all shots where only the values `used` take part: that of their part of
    `L^-1 L^-T`.
    """
    factor = _inverse(mixing).reshape(used.size, used.size)
    covariance = (factor @ factor.T).reshape(mixing.shape)
    return whitening(covariance, used)[1]
