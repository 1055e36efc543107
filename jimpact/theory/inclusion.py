"""Restitution, tangential too, as a normal-cone inclusion in quasi-velocities."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jimpact._checks import as_float_array, check_shape, check_values
from jimpact.contact import normalized_delassus
from jimpact.scene import Scene
from jimpact.solvers.lcp import solve_lcp
from jimpact.solvers.tridiagonal import as_matrix
from jimpact.theory.quasi_velocities import quasi_basis


class InclusionOutcome(NamedTuple):
    """Quasi-velocities v+ (n,), percussions (c,) along the columns of the coupling, status ()."""

    velocity: jax.Array
    percussion: jax.Array
    status: jax.Array


def contact_coupling(scene: Scene) -> jax.Array:
    """`Gbar = [[G, n_q^T H], [0, t_q^T H]]` (n, m + t): what (pbar, p_t) do to (qn, qt).

    Source: Brogliato (2016), (6.53), (6.64).

    >>> import jimpact as ji
    >>> ji.contact_coupling(ji.Scene([2.0, 2.0], [[0.0], [1.0]], tangents=[[1.0], [0.0]])).shape
    (2, 2)
    """
    n_q, t_q = quasi_basis(scene)
    g = as_matrix(normalized_delassus(scene))
    if scene.tangents is None:
        return jnp.concatenate([g, jnp.zeros((t_q.shape[1], g.shape[1]), g.dtype)])
    right = jnp.concatenate([n_q.T @ scene.tangents, t_q.T @ scene.tangents])
    left = jnp.concatenate([g, jnp.zeros((t_q.shape[1], g.shape[1]), g.dtype)])
    return jnp.concatenate([left, right], axis=1)


def restitution_inclusion(
    coupling: Any, metric: Any, restitution: Any, velocity: Any, low: Any = 0.0, high: Any = jnp.inf
) -> InclusionOutcome:
    """Solve `v+ - v- in -Gbar N_V(Gamma (v+ + Lambda v-))` with `Gamma = Gbar^T P`, V a box.

    Equation: `v+ = -Lambda v- + R^-1 proj[{x: Gbar^T R x in V}; R (Lambda + I) v-]`, `R^2 = P`.
    With the multipliers of the projection, y = Gamma (v+ + Lambda v-), it reads `v+ = v- + Gbar p`,
    `p_i >= 0` where y_i is at its lower bound, `<= 0` at its upper one, else 0: one linear
    complementarity problem, and no square root.

    Args:
        coupling: Gbar (n, c), see `contact_coupling`.
        metric: P (n, n), symmetric positive definite.
        restitution: Lambda, a scalar or (n, n).
        velocity: v- (n,), quasi-velocities (`to_quasi_velocities`).
        low: lower bounds of V, scalar or (c,); -inf for none.
        high: upper bounds.

    Returns:
        `InclusionOutcome`; `status` is `infeasible` where V cannot be met.

    Derivatives are one-sided where a percussion sets in.
    Source: Brogliato, Nonsmooth Mechanics (2016), (6.63)-(6.65).

    >>> import jimpact as ji
    >>> out = ji.restitution_inclusion([[1.0]], [[1.0]], 0.5, [-2.0])  # Newton's law
    >>> float(out.velocity[0])
    1.0
    """
    gbar, p = as_float_array("coupling", coupling), as_float_array("metric", metric)
    v, lam = as_float_array("velocity", velocity), as_float_array("restitution", restitution)
    low, high = as_float_array("low", low), as_float_array("high", high)
    if gbar.ndim != 2:
        raise ValueError(f"Argument `coupling` must be a matrix, but has shape {gbar.shape}.")
    n, c = gbar.shape
    check_shape("velocity", v, (n,), "one per row of `coupling`")
    check_shape("metric", p, (n, n), "square, one row per row of `coupling`")
    for name, value in (("coupling", gbar), ("metric", p), ("restitution", lam), ("velocity", v)):
        check_values(name, value)
    lam = lam * jnp.eye(n, dtype=lam.dtype) if lam.ndim == 0 else lam
    check_shape("restitution", lam, (n, n), "or a scalar")
    low, high = jnp.broadcast_to(low, (c,)), jnp.broadcast_to(high, (c,))
    gamma = gbar.T @ p
    y = gamma @ (v + lam @ v)
    percussion, code = _in_box(gamma @ gbar, y, low, high)
    return InclusionOutcome(v + gbar @ percussion, percussion, code.astype(jnp.int32))


def _in_box(
    s: jax.Array, y: jax.Array, low: jax.Array, high: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Multipliers that bring `y + S p` into the box; S symmetric positive semidefinite."""
    bounded = jnp.isfinite(jnp.concatenate([low, high]))
    room = jnp.concatenate([y - low, high - y])
    room = jnp.where(bounded, room, 1.0)  # a bound at infinity never binds
    matrix = jnp.concatenate([jnp.concatenate([s, -s], axis=1), jnp.concatenate([-s, s], axis=1)])
    both = bounded[:, None] & bounded[None, :]
    matrix = jnp.where(both, matrix, jnp.eye(2 * len(y), dtype=s.dtype))
    # p = p_low - p_high is unique where S is regular, whatever the two parts are
    found = solve_lcp(matrix, room, regular=True)
    return found.z[: len(y)] - found.z[len(y) :], found.code
