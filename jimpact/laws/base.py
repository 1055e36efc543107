"""The contract of a law: `(W, gamma-) -> (p, status)`, its fields are its parameters."""

import abc
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from jimpact.numerics.tridiagonal import Symmetric


class Law(eqx.Module):
    """An impact law. A law is a pytree: grad of a law is a law, vmap over a law is a batch.

    `impact()` has already left out open contacts (their rows of W are decoupled, gamma = 0)
    and short-cut the case in which nothing happens; it adds to the status what it sees itself
    (not finite, negative impulse, inadmissible velocity, energy gain).
    """

    uses_gaps: ClassVar[bool] = False

    @abc.abstractmethod
    def impulse(self, delassus: Symmetric, gap_velocity: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Contact impulses p (m,) [N s] and the law's own status code ()."""

    def stored_energy(self, contacts: int) -> jax.Array:
        """Energy (m,) [J] stored in the contacts before the impact."""
        return jnp.zeros(contacts)

    def check_options(self, dtype: jnp.dtype, contacts: int) -> None:
        """Raise where an option does not fit the floating-point precision or the contacts."""
