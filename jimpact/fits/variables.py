"""The variables of a solver: the parameters of a fit in natural scales."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jimpact.fits.parameters import (
    OF_A_SCENE,
    Limits,
    Parameters,
    Prior,
    scaled,
    unscaled,
)
from jimpact.fits.solve import AnyArray
from jimpact.tools.compiling import full_precision


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Variables:
    """Scaled variables y of a solver, within bounds; the parameters x and the law's
    entries.

    Equation: `x = scale y`, or `x = exp(y)` of a parameter that is fitted in its
    logarithm.

    There are as many variables as the fitted fields have entries, Q, of which the first
    P are the parameters and the others count for nothing: a compiled program does not
    depend on which entries are free. (Variables of S problems side by side have one
    more axis in front.)

    Attributes:
        owner: the index of the parameter that each entry of the fields has, -1 where it
            is fixed.
        fixed: the entries at the start.
        scale: the size of a change of order 1 of each parameter, in its unit.
        log: True where a parameter is fitted in its logarithm.
        low, high: bounds of y.
    """

    owner: Int[AnyArray, "*S Q"]
    fixed: Float[AnyArray, "*S Q"]
    scale: Float[AnyArray, "*S Q"]
    log: Bool[AnyArray, "*S Q"]
    low: Float[AnyArray, "*S Q"]
    high: Float[AnyArray, "*S Q"]

    @classmethod
    def of(
        cls,
        fixed: Float[np.ndarray, " Q"],
        parameters: Parameters,
        limits: Limits,
        priors: tuple[Prior, ...],
        energy: float,
    ) -> "Variables":
        """Variables of these parameters; the scale of each is max(|start|, 1).

        That of an energy is `energy`; of a part of the scene, its prior's standard
        deviation.

        Args:
            fixed: entries of the law at the start.
            parameters: which entries are free.
            limits: lowest and highest values of the parameters.
            priors: of some parameters.
            energy: the largest kinetic energy before a measured impact [J].
        """
        count = len(parameters.names)
        owner = np.full(len(fixed), -1)
        starts = fixed[parameters.first]
        natural = np.where(parameters.log, 1.0, np.maximum(np.abs(starts), 1.0))
        for i, (group, name) in enumerate(zip(parameters.groups, parameters.of_fields)):
            owner[list(group)] = i
            if name == "initial_energy":
                natural[i] = energy
        for prior in priors:
            # a gap is far smaller than 1 m
            if parameters.of_fields[prior.parameter] in OF_A_SCENE:
                natural[prior.parameter] = prior.std
        low, high = (scaled(end, natural, parameters.log) for end in limits)
        padding = (0, len(fixed) - count)  # behind the P parameters, Q - P entries
        log, low, high = (
            np.pad(array, padding) for array in (parameters.log, low, high)
        )
        return cls(
            owner, fixed, np.pad(natural, padding, constant_values=1.0), log, low, high
        )

    @full_precision
    def parameters(self, y: Float[AnyArray, " Q"]) -> Float[Array, " Q"]:
        """Values x of variables y, on the device: `scale y`, or `exp(y)`; zeros behind
        the P.
        """
        return unscaled(y, self.scale, self.log, jnp)

    @full_precision
    def of_parameters(self, x: Float[Array, " P"]) -> Float[Array, " Q"]:
        """Variables y of values x, on the device: `x / scale`, or `log(x)`; zeros
        behind the P.
        """
        return scaled(
            jnp.pad(x, (0, len(self.low) - len(x))), self.scale, self.log, jnp
        )

    @full_precision
    def entries(self, x: Float[AnyArray, " _"]) -> Float[AnyArray, " Q"]:
        """Entries of the fitted fields at x (P,), or (Q,) as `parameters` gives it: on
        the device, or on the host, where no operation is compiled.
        """
        if isinstance(x, jax.Array):
            return jnp.where(self.owner >= 0, x[self.owner], self.fixed)
        return np.where(self.owner >= 0, x[self.owner], self.fixed)

    def point(self, x: Float[np.ndarray, "*S P"]) -> Float[np.ndarray, "*S Q"]:
        """Variables y of values x, on the host: `x / scale`, or `log(x)`; zeros behind
        the P.
        """
        every = np.zeros((*x.shape[:-1], len(self.low)))
        every[..., : x.shape[-1]] = x
        return np.asarray(
            scaled(every, np.asarray(self.scale, float), np.asarray(self.log))
        )

    def values_at(self, y: Float[np.ndarray, "*S Q"]) -> Float[np.ndarray, "*S Q"]:
        """Values x of variables y, on the host: `scale y`, or `exp(y)`; zeros behind
        the P.
        """
        scale = np.asarray(self.scale, float)
        log = np.asarray(self.log)
        return np.asarray(unscaled(np.asarray(y, float), scale, log))
