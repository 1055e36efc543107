"""The dynamics between impacts in kinetic quasi-velocities, and the contact problem of forces."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jimpact.core.quasi_space import quasi_basis
from jimpact.core.scene import Scene, momentum
from jimpact.motion.dynamics import free_acceleration, mass_at, user_force
from jimpact.motion.persistent_contact import contacts_at
from jimpact.motion.system import System
from jimpact.numerics.lcp import solve_lcp
from jimpact.tools.checks import as_float_array, as_numbers
from jimpact.tools.compiling import full_precision, quick_jit

Constraint = Callable[[jax.Array], jax.Array]  # q -> h(q) (b,), 0 at all times


class QuasiLagrange(NamedTuple):
    """The terms of `qn' + F_norm = G lambda_bar`, `qt' + F_tan = 0`, bilateral constraints first.

    `normal` F_norm (b + m,) and `tangential` F_tan (n - m - b,) [N / sqrt(kg)]; `matrix`
    G = n_q^T M n_q (b + m, b + m), not reduced; `norm` |grad h|, |grad f| (b + m,):
    `lambda_bar = norm * lambda`; `bilateral` b.
    """

    normal: jax.Array
    tangential: jax.Array
    matrix: jax.Array
    norm: jax.Array
    bilateral: int

    @full_precision
    def bilateral_forces(self, force: Any = 0.0) -> jax.Array:
        """lambda_b (b,) that hold the constraints while contacts push with `force` (m,) [N].

        Equation: `F_norm^b = G_bb lambda_bar_b + G_bu lambda_bar_u`, (6.29) with qn_b' = 0.
        """
        b = self.bilateral
        push = as_float_array("force", force) * self.norm[b:]
        rest = self.normal[:b] - self.matrix[:b, b:] @ push
        return jnp.linalg.solve(self.matrix[:b, :b], rest) / self.norm[:b]

    @full_precision
    def rates(self, force: Any = 0.0) -> tuple[jax.Array, jax.Array]:
        """qn' (b + m,) and qt' while contacts push with `force` (m,) [N], constraints kept."""
        push = as_float_array("force", force) * jnp.ones_like(self.norm[self.bilateral :])
        every = jnp.concatenate([self.bilateral_forces(push), push]) * self.norm
        return self.matrix @ every - self.normal, -self.tangential


def quasi_lagrange(
    system: System,
    q: Any,
    velocity: Any,
    time: Any = 0.0,
    constraints: Constraint | None = None,
    contacts: Sequence[int] | None = None,
) -> QuasiLagrange:
    """The quasi-Lagrange equations of a system at one instant.

    Equation: with `v = (qn, qt) = Xi(q) M(q) q'` of `ji.theory.quasi_basis`, and the acceleration
    q''_0 without contacts, `(F_norm, F_tan) = -Xi M q''_0 - d/dt(Xi M) q'`. Contact forces change
    qn alone; tangential ones add `n_q^T H_t lambda_t` and `t_q^T H_t lambda_t` (6.30), see
    `ji.theory.contact_coupling`.

    Args:
        system: a body under loads, without a moving base; its velocities are n.
        q: configuration.
        velocity: (n,) [m/s]; it satisfies the constraints.
        time: t () [s], of time-dependent loads.
        constraints: q -> h(q) (b,), bilateral constraints h = 0; None: none.
        contacts: indices of those that count as closed, m of them; None: all.

    Returns:
        `QuasiLagrange`.

    Raises:
        ValueError: redundant contacts and constraints (NaN or noise); a moving base; sizes.

    Source: Brogliato, Nonsmooth Mechanics (2016), (6.24)-(6.30).

    >>> import jimpact as ji
    >>> block = ji.System(ji.Block(1.0, 2.0**0.5, corners="base"), gravity=10.0)
    >>> terms = ji.theory.quasi_lagrange(block, [0.0, 0.5**0.5, 0.0], [1.0, 0.0, 0.0])
    >>> [round(float(f), 6) for f in terms.normal]  # g / sqrt(W_jj), W_jj = 2: kinetic angle pi/2
    [7.071068, 7.071068]
    """
    if system.base is not None:
        raise ValueError("Argument `system` must not have a moving base for quasi-velocities.")
    at, v = as_numbers("q", q), as_numbers("velocity", velocity)
    t = as_numbers("time", time, (), "one instant; vmap over many")
    fixed = 0 if constraints is None else jax.eval_shape(constraints, at).shape[0]
    chosen = None if contacts is None else tuple(contacts)
    return QuasiLagrange(*_terms(system, constraints, chosen, at, v, t), fixed)


@quick_jit
def _terms(
    system: System,
    constraints: Constraint | None,
    contacts: tuple[int, ...] | None,
    q: jax.Array,
    v: jax.Array,
    t: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """F_norm, F_tan, G and the norms."""
    body = system.body

    def scene_at(displacement: jax.Array) -> Scene:
        """Mass and all directions, those of constraints first, after a displacement of q."""
        at = body.nearby(q, displacement)
        normals = body.normals(at)
        if contacts is not None:
            normals = normals[:, jnp.array(contacts)]
        if constraints is not None:
            gradient = jax.jacfwd(lambda u: constraints(body.nearby(at, u)))(jnp.zeros_like(v))
            normals = jnp.concatenate([gradient.T, normals], axis=1)
        return Scene(body.mass_matrix(at), normals)

    def quasi(s: jax.Array, w: jax.Array) -> jax.Array:
        """Quasi-velocities of w after the time s."""
        scene = scene_at(s * v)
        return jnp.concatenate(quasi_basis(scene), axis=1).T @ momentum(scene, w)

    scene = scene_at(jnp.zeros_like(v))
    free = free_acceleration(system, q, v, user_force(system, q, v, t), mass_at(system, q))
    zero = jnp.zeros((), v.dtype)
    _, rate = jax.jvp(quasi, (zero, v), (jnp.ones_like(zero), free))
    normal, _ = quasi_basis(scene)
    metric = jax.vmap(lambda x: momentum(scene, x), 1, 1)(normal)
    directions = scene.normals
    norm = jnp.sum(directions * normal, axis=0)  # grad f^T M^-1 grad f / |grad f|
    count = directions.shape[1]
    return -rate[:count], -rate[count:], normal.T @ metric, norm


class ContactProblem(NamedTuple):
    """`0 <= lambda  _|_  f'' = D lambda + B >= 0` at contacts that stay closed.

    `delassus` D (m, m) [1/kg]; `free` B(q, q') (m,) [m/s^2], gap accelerations without contacts.
    """

    delassus: jax.Array
    free: jax.Array

    def forces(self, closed: Any = True) -> jax.Array:
        """lambda (m,) [N] at the contacts that are `closed` (m,), with gap velocity 0."""
        held = jnp.broadcast_to(jnp.asarray(closed, bool), self.free.shape)
        return _forces(self.delassus, self.free, held)


@quick_jit
def _forces(delassus: jax.Array, free: jax.Array, held: jax.Array) -> jax.Array:
    """lambda (m,), 0 at contacts that are not held."""
    both = held[:, None] & held[None, :]
    unit = jnp.eye(len(held), dtype=free.dtype)
    return solve_lcp(jnp.where(both, delassus, unit), jnp.where(held, free, 1.0)).z


def contact_problem(system: System, q: Any, velocity: Any, time: Any = 0.0) -> ContactProblem:
    """The complementarity problem of contact forces, without friction.

    Equation: `D = grad f^T M^-1 grad f`,
    `B = grad f^T M^-1 (loads and inertial forces) + (d grad f^T / dt) q'`. For a block:
    `B = -g + (theta'^2 / 2) (l cos theta -/+ L sin theta)`.

    Args:
        system: a body under loads.
        q: configuration.
        velocity: (n,) [m/s].
        time: t () [s].

    Returns:
        `ContactProblem` of all contacts; `.forces(closed)` solves it.

    Raises:
        ValueError: values that are not finite.

    Differentiable where no contact is about to lose its force.

    Source: Brogliato, Nonsmooth Mechanics (2016), 6.3.2.2 (the contact LCP of the rocking block).

    >>> import jimpact as ji
    >>> block = ji.System(ji.Block(1.0, 2.0, corners="base"), gravity=10.0)
    >>> problem = ji.theory.contact_problem(block, [0.0, 1.0, 0.0], [0.0, 0.0, 0.0])
    >>> problem.forces().round(6).tolist()  # half of its weight each
    [5.0, 5.0]
    """
    arguments = {"q": q, "velocity": velocity, "time": time}
    state = (as_numbers(name, x) for name, x in arguments.items())
    return ContactProblem(*_problem(system, *state))


@quick_jit
def _problem(
    system: System, q: jax.Array, v: jax.Array, t: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """D and B."""
    contacts = contacts_at(system, q, v, t, False)
    return contacts.delassus, contacts.approach
