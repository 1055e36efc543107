"""Coulomb friction of the algebraic laws: their two fields, and the solver behind one
function.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jimpact.core.contact import Contact
from jimpact.core.law import Impulses
from jimpact.numerics.friction import solve
from jimpact.tools.checks import is_traced


def friction_fields(friction: Any, tangential_restitution: Any) -> tuple[Any, Any]:
    """The fields `(mu, e_t)` of a law, `(None, None)` without friction.

    Raise a ValueError for an e_t that is not 0, or traced, without friction.
    """
    if friction is not None:
        return friction, tangential_restitution
    if is_traced(tangential_restitution) or np.any(
        np.asarray(tangential_restitution) != 0
    ):
        raise ValueError(
            f"Argument `tangential_restitution` must be 0 without `friction`: then "
            f"nothing acts along the contacts, but has value "
            f"{tangential_restitution!r}."
        )
    return None, None


def frictional_impulses(
    contact: Contact,
    normal: jax.Array,
    friction: jax.Array,
    tangential_restitution: jax.Array,
    *,
    complementary: bool,
) -> Impulses:
    """Impulses p (m,), p_t (t,) [N s] of a law that prescribes gap velocities, with
    friction.

    Equation: `W p + W_nt p_t + b = 0`, or (`complementary`)
    `0 <= W p + W_nt p_t + b  _|_  p >= 0`, b = `normal` (m,) [m/s], and
    `p_t in -mu p Sgn(u+ + e_t u-)`, mu = `friction`, e_t = `tangential_restitution`, ()
    or (m,).
    """
    assert contact.slip is not None  # see `check_law`
    ones = jnp.ones_like(contact.gap_velocity)
    mu = friction * ones
    # Eq. (6.54): sticking is u+ = -e_t u-, and u+ + e_t u- = W_tn p + W_tt p_t + b_t
    e_t = jnp.repeat(tangential_restitution * ones, contact.tangents)
    b_t = (1 + e_t) * contact.slip
    # Coulomb: p_t in -mu p Sgn(W_tn p + W_tt p_t + b_t)
    a = contact.whole_delassus  # [[W, W_nt], [W_tn, W_tt]]
    solution = solve(a, normal, b_t, mu, complementary=complementary)
    return Impulses(solution.normal, solution.tangential, solution.status)
