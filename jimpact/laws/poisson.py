"""Poisson's law in the two-stage form of Pfeiffer and Glocker."""

from typing import ClassVar

import jax
import jax.numpy as jnp

from jimpact.contact import Contact
from jimpact.law import Impulses, Law, Values, option, parameter
from jimpact.solvers.lcp import solve_lcp
from jimpact.solvers.linear import null_projector
from jimpact.solvers.tridiagonal import as_matrix, is_regular
from jimpact.status import CODE


class Poisson(Law):
    """Poisson's restitution of impulses: compression to rest, then expansion.

    Equation: compression `0 <= gamma_c = gamma- + W p_c  _|_  p_c >= 0`; expansion
    `p_e = e p_c + s`, `0 <= gamma+ = gamma_c + W p_e  _|_  s >= 0`; `p = p_c + p_e`.

    Args:
        restitution: kinetic coefficient e in [0, 1], scalar or one per contact (m,).
        allow_above_one: let e exceed 1, which dispersion in a chain would need.

    Status: `impulse_not_unique` for redundant contacts; `several_outcomes` where, besides, their e
    differ: v+ then depends on how they share p_c (the least one is taken); `energy_gain` where
    unequal or large e create energy.

    Derivatives are one-sided where a contact is about to take part in either stage.

    Source: Pfeiffer and Glocker (1996); Brogliato, Nonsmooth Mechanics (2016), (6.76)-(6.79) with
    the errata of `docs/equations.md`.

    >>> import jimpact as ji
    >>> law = ji.Poisson([0.4, 1.0])
    >>> out = ji.impact(law, ji.chain([1.0, 1.0, 1.0]), [1.0, 0.0, 0.0])
    >>> [round(float(v), 4) for v in out.velocity]
    [0.0667, 0.2667, 0.6667]
    """

    separable: ClassVar[bool] = True

    restitution: Values = parameter(low=0.0, high=1.0, high_unless="allow_above_one")
    allow_above_one: bool = option(False, converter=bool)

    def impulses(self, contact: Contact) -> Impulses:
        """Two linear complementarity problems."""
        w, regular = as_matrix(contact.delassus), is_regular(contact.delassus)
        compression = solve_lcp(w, contact.gap_velocity, regular=regular)
        returned = self.restitution * compression.z
        supplement = solve_lcp(w, compression.w + w @ returned, regular=regular)
        code = jnp.maximum(compression.code, supplement.code)
        if self.restitution.ndim == 1 and not regular:
            shared = _depends_on_sharing(w, self.restitution, compression.z > 0)
            code = jnp.maximum(code, jnp.where(shared, CODE["several_outcomes"], CODE["ok"]))
        return Impulses(compression.z + returned + supplement.z, None, code)


def _depends_on_sharing(w: jax.Array, e: jax.Array, loaded: jax.Array) -> jax.Array:
    """Whether `W diag(e) p_c` differs among the p_c of loaded contacts with the same `W p_c`."""
    norm = jnp.sqrt(jnp.diagonal(w))
    g = jax.lax.stop_gradient(w / (norm[:, None] * norm[None, :]))
    both = loaded[:, None] & loaded[None, :]
    unit = jnp.eye(len(e), dtype=w.dtype)
    projector, _ = null_projector(jnp.where(both, g, unit))
    returned = g @ (jax.lax.stop_gradient(e)[:, None] * projector)
    return jnp.abs(returned).max() > jnp.sqrt(jnp.finfo(w.dtype).eps)
