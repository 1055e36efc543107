"""The variables of a solver: the parameters of a fit in natural scales."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jimpact.fits.parameters import OF_A_SCENE, Limits, Parameters, Prior, scaled, unscaled
from jimpact.tools.compiling import full_precision


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Variables:
    """Variables y (Q,) in their box, the parameters x (P,) that they are, and entries of the law.

    Equation: `x = scale y`, or `x = exp(y)` of a parameter that is fitted in its logarithm.

    There are as many variables as the fitted fields have entries, Q, of which the first P are the
    parameters and the others count for nothing: a compiled program does not depend on which entries
    are free.

    Attributes:
        owner: (Q,) the parameter that each entry of the fields has, -1 where it is fixed.
        fixed: (Q,) the entries at the start.
        scale: (Q,) the size of a change of order 1 of each parameter.
        log: (Q,) whether a parameter is fitted in its logarithm.
        low, high: (Q,) bounds of y.
    """

    owner: Any
    fixed: Any
    scale: Any
    log: Any
    low: Any
    high: Any

    @classmethod
    def of(
        cls,
        fixed: np.ndarray,
        parameters: Parameters,
        limits: Limits,
        priors: tuple[Prior, ...],
        energy: float,
    ) -> "Variables":
        """Those of parameters in these limits, of a law with the entries `fixed` (Q,).

        `energy` [J]: of the measured impacts, the scale of an energy.
        """
        count = len(parameters.names)
        owner, starts = np.full(len(fixed), -1), fixed[parameters.first]
        natural = np.where(parameters.log, 1.0, np.maximum(np.abs(starts), 1.0))
        for i, (group, name) in enumerate(zip(parameters.groups, parameters.of_fields)):
            owner[list(group)] = i
            natural[i] = energy if name == "initial_energy" else natural[i]
        for prior in priors:
            if parameters.of_fields[prior.parameter] in OF_A_SCENE:  # a gap is far smaller than 1 m
                natural[prior.parameter] = prior.std
        low, high = (scaled(end, natural, parameters.log) for end in limits)
        rest = (0, len(fixed) - count)
        log, low, high = (np.pad(array, rest) for array in (parameters.log, low, high))
        return cls(owner, fixed, np.pad(natural, rest, constant_values=1.0), log, low, high)

    @full_precision
    def parameters(self, y: jax.Array) -> jax.Array:
        """x (Q,) of y (Q,), on the device."""
        return unscaled(y, self.scale, self.log, jnp)

    @full_precision
    def of_parameters(self, x: jax.Array) -> jax.Array:
        """y (Q,) of x (P,), on the device."""
        return scaled(jnp.pad(x, (0, len(self.low) - len(x))), self.scale, self.log, jnp)

    @full_precision
    def entries(self, x: jax.Array) -> jax.Array:
        """Entries (Q,) of the fitted fields, of x (P,) or (Q,)."""
        return jnp.where(self.owner >= 0, x[self.owner], self.fixed)

    def point(self, x: np.ndarray) -> np.ndarray:
        """y (..., Q) of x (..., P), on the host."""
        every = np.zeros((*x.shape[:-1], len(self.low)))
        every[..., : x.shape[-1]] = x
        return np.asarray(scaled(every, np.asarray(self.scale, float), np.asarray(self.log)))

    def values_at(self, y: np.ndarray) -> np.ndarray:
        """x (..., Q) of y (..., Q), on the host."""
        scale, log = np.asarray(self.scale, float), np.asarray(self.log)
        return np.asarray(unscaled(np.asarray(y, float), scale, log))
