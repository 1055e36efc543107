"""The contract of a law: `(W, gamma-) -> (p, status)`, its fields are its parameters."""

import abc
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from jimpact.scene import Scene
from jimpact.solvers.tridiagonal import Symmetric


def no_tangential_impulse(scene: Scene, dtype: jnp.dtype) -> jax.Array:
    """p_t of a law without friction: one 0 for each tangent of the scene."""
    return jnp.zeros(0 if scene.tangents is None else scene.tangents.shape[1], dtype)


class Law(eqx.Module):
    """An impact law. A law is a pytree: grad of a law is a law, vmap over a law is a batch.

    `impact()` has already left out open contacts (their rows of W are decoupled, gamma = 0)
    and short-cut the case in which nothing happens; it adds to the status what it sees itself
    (not finite, negative impulse, inadmissible velocity, energy gain).
    """

    uses_gaps: ClassVar[bool] = False
    pulls: ClassVar[bool] = False  # separating contacts, too, if anything happens anywhere

    @abc.abstractmethod
    def impulse(self, delassus: Symmetric, gap_velocity: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Contact impulses p (m,) [N s] and the law's own status code ()."""

    def all_impulses(
        self, scene: Scene, delassus: Symmetric, gap_velocity: jax.Array, velocity: jax.Array
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Normal p (m,) and tangential p_t impulses, and status; what `impact()` calls.

        For laws that need more of the scene than W and gamma-: its gaps, its tangents.
        """
        p, code = self.impulse(delassus, gap_velocity)
        return p, no_tangential_impulse(scene, p.dtype), code

    def by_blocks(self) -> bool:
        """Whether contacts that W does not couple may be solved apart, `impulse` group by group.

        True promises that the law itself couples no contacts, needs nothing but `impulse`, and
        that its arrays (m,) hold one entry per contact.
        """
        return False

    def stored_energy(self, contacts: int) -> jax.Array:
        """Energy (m,) [J] stored in the contacts before the impact."""
        return jnp.zeros(contacts)

    def with_stored(self, energy: jax.Array) -> "Law":
        """The same law with these stored energies (m,), if it knows any: 0 at open contacts."""
        return self

    def check_options(self, dtype: jnp.dtype, scene: Scene) -> None:
        """Raise where an option does not fit the floating-point precision or the scene."""

    def domain(self) -> dict[str, tuple[float, float]]:
        """Where a fit may look for a field's values, if not in the domain its name implies."""
        return {}
