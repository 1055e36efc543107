"""Coulomb friction of the algebraic laws: their two fields, and the solver behind one function."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import is_traced
from jimpact.contact import Contact
from jimpact.law import Impulses
from jimpact.solvers.coulomb import Problem, solve_complementary, solve_prescribed
from jimpact.solvers.coulomb_disc import DiscProblem, solve_disc


def friction_fields(friction: Any, tangential_restitution: Any) -> tuple[Any, Any]:
    """`(mu, e_t)`, or `(None, None)` without friction."""
    if friction is not None:
        return friction, tangential_restitution
    if is_traced(tangential_restitution) or np.any(np.asarray(tangential_restitution) != 0):
        raise ValueError(
            "Argument `tangential_restitution` must be 0 without `friction`: then nothing acts "
            f"along the contacts, but has value {tangential_restitution!r}."
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
    """p (m,) and p_t (t,) with `p_t in -mu p Sgn(u+ + e_t u-)`.

    `normal` (m,) [m/s] is what gamma+ - gamma- must make up for: `gamma+ - gamma- + normal` is 0,
    or (`complementary`) >= 0 and 0 where p > 0.
    """
    assert contact.slip is not None  # see `check_law`
    ones = jnp.ones_like(contact.gap_velocity)
    slip = (1 + jnp.repeat(tangential_restitution * ones, contact.tangents)) * contact.slip
    return solve(contact.whole_delassus, normal, slip, friction * ones, complementary=complementary)


def solve(
    matrix: jax.Array,
    normal: jax.Array,
    slip: jax.Array,
    friction: jax.Array,
    *,
    complementary: bool,
) -> Impulses:
    """The solvers of `solvers.coulomb` and `coulomb_disc` as one function."""
    m = normal.shape[0]
    each = slip.shape[0] // m
    norm = jnp.sqrt(jnp.diagonal(matrix)[:m])
    scale = jnp.concatenate([1 / norm, jnp.repeat(1 / norm, each)])
    parts = matrix * scale[:, None] * scale[None, :], normal / norm, slip * scale[m:], friction
    if each == 2:
        found = solve_disc(DiscProblem(*parts, complementary))
    else:
        found = (solve_complementary if complementary else solve_prescribed)(Problem(*parts))
    return Impulses(found.normal / norm, found.tangential * scale[m:], found.code)
