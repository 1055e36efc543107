"""The published impulse-scale integration of the LZB dynamics, in the impulse of a primary contact.

    dp_j = Gamma_ji dp_i,   dE_j = -c_j gamma_j dp_j,   gamma = gamma- + G p

First order in the step. The primary contact i is the one with the largest force; a contact that
is touched for the first time (E_j = 0, where the rule is 0/0 and its solution not unique) takes
the implicit first step that has a closed form. Kept because it is what the literature uses.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jimpact.events.contact_flow import Exponent, power
from jimpact.solvers.sparse import Neighbours, Sparse
from jimpact.solvers.tridiagonal import Structure, Symmetric, Tridiagonal

# Part of the largest energy below which that of a contact is rounding, and the contact unloaded.
# Ten times more would unload contacts that still push.
EMPTY = 1e-14


class Rule(NamedTuple):
    """What the walk depends on: G, and omega, restitution, exponent of each contact."""

    coupling: Symmetric
    omega: jax.Array
    restitution: jax.Array
    exponent: Exponent


class Walk(NamedTuple):
    """Gap velocity, potential energy and impulse (m,), and the steps taken."""

    gamma: jax.Array
    energy: jax.Array
    p: jax.Array
    steps: jax.Array


def force(flow: Rule, energy: jax.Array) -> jax.Array:
    """Dimensionless contact force at potential energy E_j."""
    eta = jnp.asarray(flow.exponent, energy.dtype)
    positive = energy > 0
    root = jnp.where(positive, jnp.where(positive, 2 * energy, 1.0) ** (eta / (eta + 1)), 0.0)
    return (eta + 1) / 2 * flow.omega * root


def advance(flow: Rule, dp: jax.Array, walk: Walk) -> Walk:
    """One explicit step of `dp` in the primary impulse."""
    gamma, energy = walk.gamma, walk.energy
    eta = jnp.asarray(flow.exponent, gamma.dtype)
    approach = jnp.maximum(-gamma, 0.0)
    # at the first touch the energy is that of the step itself
    f = force(flow, energy)
    f_start = jnp.where(jnp.any(energy > 0), f, force(flow, approach * dp))
    primary = jnp.argmax(f_start)
    scale = dp / f_start[primary]
    # implicit first step: dp_j = scale F_j(u_j dp_j)
    first = (scale * force(flow, approach)) * jnp.where(approach > 0, 1.0, 0.0)
    increment = jnp.where(energy > 0, scale * f, power(first, eta + 1))
    is_primary = jnp.arange(gamma.shape[0]) == primary
    increment = jnp.where(is_primary, dp, increment)
    increment = increment * emptying(flow, walk, is_primary, increment)
    after = gamma + flow.coupling @ increment
    # exact work of the step; its error is the first-order one of the distributing rule alone
    middle = 0.5 * (gamma + after)
    rate = jnp.where(middle > 0, 1 / flow.restitution**2, 1.0)
    left = jnp.maximum(energy - rate * middle * increment, 0.0)
    return Walk(
        after,
        jnp.where(left > EMPTY * jnp.max(energy + approach**2), left, 0.0),
        walk.p + increment,
        walk.steps + 1,
    )


def emptying(flow: Rule, walk: Walk, is_primary: jax.Array, increment: jax.Array) -> jax.Array:
    """Fraction of the step at which the primary contact is unloaded; 1 if it is not.

    Ending there, not on a fixed step, is what the derivative of the outcome depends on.
    """

    def of_primary(values: jax.Array) -> jax.Array:
        """The value of the primary contact."""
        return jnp.sum(jnp.where(is_primary, values, 0.0))

    gamma, energy, dp = of_primary(walk.gamma), of_primary(walk.energy), of_primary(increment)
    bend = of_primary(flow.coupling @ increment)
    budget = energy * of_primary(flow.restitution) ** 2 / dp
    expands = (gamma + 0.5 * bend > 0) & (energy > 0)
    root = jnp.sqrt(jnp.maximum(jnp.where(expands, gamma**2 + 2 * bend * budget, 1.0), 0.0))
    denominator = jnp.where(expands, gamma + root, 1.0)
    fraction = 2 * budget / jnp.where(denominator > 0, denominator, 1.0)
    return jnp.where(expands & (denominator > 0) & (fraction < 1), fraction, 1.0)


def at_work(walk: Walk) -> jax.Array:
    """Whether a contact is loaded or approaches."""
    return jnp.any((walk.energy > 0) | (walk.gamma < 0))


def rule_of(problem: Any, exponent: Any, structure: Structure) -> Rule:
    """The rule of a dimensionless problem (see `impact_dynamics.py`)."""
    m, eta = problem.gamma.shape[0], exponent if problem.exponent is None else problem.exponent
    coupling: Symmetric = Tridiagonal(jnp.ones_like(problem.gamma), problem.off_diagonal)
    if isinstance(structure, Neighbours):
        coupling = Sparse(jnp.ones_like(problem.gamma), problem.off_diagonal, structure)
    elif structure is None:
        upper = (
            jnp.zeros((m, m), problem.gamma.dtype)
            .at[jnp.triu_indices(m, 1)]
            .set(problem.off_diagonal)
        )
        coupling = jnp.eye(m, dtype=problem.gamma.dtype) + upper + upper.T
    return Rule(coupling, problem.omega, problem.restitution, eta)
