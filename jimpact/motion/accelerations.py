"""The dynamics between impacts in kinetic quasi-velocities, and the contact problem of
forces.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jimpact.core.quasi_space import quasi_basis
from jimpact.core.scene import Scene, momentum
from jimpact.motion.dynamics import free_acceleration, mass_at, user_force
from jimpact.motion.persistent_contact import contacts_at
from jimpact.motion.system import System
from jimpact.numerics.dense import unit_outside
from jimpact.numerics.lcp import solve_lcp
from jimpact.tools.checks import as_float_array, as_numbers
from jimpact.tools.compiling import full_precision, quick_jit

Constraint = Callable[[jax.Array], jax.Array]  # q -> h(q) (b,), 0 at all times


class QuasiLagrange(NamedTuple):
    """The terms of `qn' + F_norm = G lambda_bar`, `qt' + F_tan = 0`.

    d = b + m: b bilateral constraints, which come first, then m contacts. `normal`
    F_norm and `tangential` F_tan [N / sqrt(kg)]; `matrix` G = n_q^T M n_q, not reduced;
    `norm` |grad h|, |grad f| in the metric M^-1: `lambda_bar = norm * lambda`;
    `bilateral` b.
    """

    normal: Float[Array, " d"]
    tangential: Float[Array, " tangential"]
    matrix: Float[Array, "d d"]
    norm: Float[Array, " d"]
    bilateral: int

    @full_precision
    def bilateral_forces(self, force: Any = 0.0) -> Float[Array, " b"]:
        """Forces lambda_b that hold the constraints while contacts push with `force`
        (m,) [N].

        Equation: `F_norm^b = G_bb lambda_bar_b + G_bu lambda_bar_u`, (6.29) with qn_b'
        = 0.
        """
        b = self.bilateral
        norm = self.norm
        lambda_u = as_float_array("force", force)
        lambda_bar_u = lambda_u * norm[b:]
        of_bilateral = self.matrix[:b]
        g_bb = of_bilateral[:, :b]
        g_bu = of_bilateral[:, b:]
        rest = self.normal[:b] - g_bu @ lambda_bar_u
        lambda_bar_b = jnp.linalg.solve(g_bb, rest)
        return lambda_bar_b / norm[:b]

    @full_precision
    def rates(
        self, force: Any = 0.0
    ) -> tuple[Float[Array, " d"], Float[Array, " tangential"]]:
        """Rates qn' and qt' while contacts push with `force` (m,) [N], constraints
        kept.

        Equation: `qn' = G lambda_bar - F_norm`, `qt' = -F_tan`.
        """
        b = self.bilateral
        one = jnp.ones_like(self.norm[b:])
        lambda_u = as_float_array("force", force) * one
        lambda_b = self.bilateral_forces(lambda_u)
        forces = jnp.concatenate([lambda_b, lambda_u])
        lambda_bar = forces * self.norm
        normal = self.matrix @ lambda_bar - self.normal
        return normal, -self.tangential


def quasi_lagrange(
    system: System,
    q: Any,
    velocity: Any,
    time: Any = 0.0,
    constraints: Constraint | None = None,
    contacts: Sequence[int] | None = None,
) -> QuasiLagrange:
    """The quasi-Lagrange equations of a system at one instant.

    Equation: with `v = (qn, qt) = Xi(q) M(q) q'` of `ji.theory.quasi_basis`, and the
    acceleration q''_0 without contacts, `(F_norm, F_tan) = -Xi M q''_0 - d/dt(Xi M)
    q'`. Contact forces change qn alone; tangential ones add `n_q^T H_t lambda_t` and
    `t_q^T H_t lambda_t` (6.30), see `ji.theory.contact_coupling`.

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
        ValueError: redundant contacts and constraints (NaN or noise); a moving base;
            sizes.

    Source: Brogliato, Nonsmooth Mechanics (2016), (6.24)-(6.30).

    >>> import jimpact as ji
    >>> block = ji.System(ji.Block(1.0, 2.0**0.5, corners="base"), gravity=10.0)
    >>> terms = ji.theory.quasi_lagrange(block, [0.0, 0.5**0.5, 0.0], [1.0, 0.0, 0.0])
    >>> [
    ...     round(float(f), 6) for f in terms.normal
    ... ]  # g / sqrt(W_jj), W_jj = 2: kinetic angle pi/2
    [7.071068, 7.071068]
    """
    if system.base is not None:
        raise ValueError(
            "Argument `system` must not have a moving base for quasi-velocities."
        )
    place = as_numbers("q", q)
    v = as_numbers("velocity", velocity)
    t = as_numbers("time", time, (), "one instant; vmap over many")
    if constraints is None:
        fixed = 0
    else:
        fixed = jax.eval_shape(constraints, place).shape[0]
    if contacts is None:
        chosen = None
    else:
        chosen = tuple(contacts)
    terms = _terms(system, constraints, chosen, place, v, t)
    return terms._replace(bilateral=fixed)  # an int: what is jitted returns arrays


@quick_jit
def _terms(
    system: System,
    constraints: Constraint | None,
    contacts: tuple[int, ...] | None,
    q: Float[Array, " nq"],
    v: Float[Array, " n"],
    t: Float[Array, ""],
) -> QuasiLagrange:
    """Terms F_norm, F_tan, G and norms of `QuasiLagrange`.

    Equation: `(F_norm, F_tan) = -d/dt (Xi(q) M(q) q')` along q' = v, q'' = that without
    contacts; `norm = grad f . n_q`, with n_q = `M^-1 grad f / |grad f|`.
    """
    body = system.body

    def scene_at(displacement: Float[Array, " n"]) -> Scene:
        """Mass and directions [grad h, grad f] after a displacement from q."""
        displaced = body.nearby(q, displacement)
        normals = body.normals(displaced)
        if contacts is not None:
            chosen = jnp.array(contacts)
            normals = normals[:, chosen]
        if constraints is not None:

            def h(u: Float[Array, " n"]) -> Float[Array, " b"]:
                """Constraints after a further displacement u."""
                return constraints(body.nearby(displaced, u))

            gradient = jax.jacfwd(h)(jnp.zeros_like(v))
            normals = jnp.concatenate([gradient.T, normals], axis=1)
        mass = body.mass_matrix(displaced)
        return Scene(mass, normals)

    def quasi(s: Float[Array, ""], w: Float[Array, " n"]) -> Float[Array, " n"]:
        """Quasi-velocities `Xi M w` after the time s at the velocity v, first order in
        s.
        """
        scene = scene_at(s * v)
        basis = jnp.concatenate(quasi_basis(scene), axis=1)
        return basis.T @ momentum(scene, w)

    rest = jnp.zeros_like(v)
    scene = scene_at(rest)
    push = user_force(system, q, v, t)
    mass = mass_at(system, q)
    free = free_acceleration(system, q, v, push, mass)
    zero = jnp.zeros((), v.dtype)
    one = jnp.ones_like(zero)
    # derivative at s = 0 along (1, q''): d/dt (Xi M q')
    _, rate = jax.jvp(quasi, (zero, v), (one, free))
    normal, _ = quasi_basis(scene)
    metric = jax.vmap(lambda x: momentum(scene, x), 1, 1)(normal)
    directions = scene.normals
    norms = directions * normal
    norm = norms.sum(axis=0)  # grad f^T M^-1 grad f / |grad f|
    d = directions.shape[1]
    coupling = normal.T @ metric
    f_norm = -rate[:d]
    f_tan = -rate[d:]
    return QuasiLagrange(f_norm, f_tan, coupling, norm, 0)


class ContactProblem(NamedTuple):
    """`0 <= lambda  _|_  f'' = D lambda + B >= 0` at contacts that stay closed.

    `delassus` D [1/kg]; `free` B(q, q') [m/s^2], gap accelerations without contact
    forces.
    """

    delassus: Float[Array, "m m"]
    free: Float[Array, " m"]

    def forces(self, closed: Any = True) -> Float[Array, " m"]:
        """Forces lambda [N] at the contacts that are `closed` (m,), with gap velocity
        0.
        """
        mask = jnp.asarray(closed, bool)
        held = jnp.broadcast_to(mask, self.free.shape)
        return _forces(self.delassus, self.free, held)


@quick_jit
def _forces(
    delassus: Float[Array, "m m"], free: Float[Array, " m"], held: Bool[Array, " m"]
) -> Float[Array, " m"]:
    """Forces of `0 <= lambda _|_ D lambda + B >= 0` over held contacts, 0 at others
    [N].
    """
    matrix = unit_outside(delassus, held)
    offset = jnp.where(held, free, 1.0)
    solution = solve_lcp(matrix, offset)
    return solution.z
    return solve_lcp(matrix, offset).z


def contact_problem(
    system: System, q: Any, velocity: Any, time: Any = 0.0
) -> ContactProblem:
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

    Source: Brogliato, Nonsmooth Mechanics (2016), 6.3.2.2 (the contact LCP of the
    rocking block).

    >>> import jimpact as ji
    >>> block = ji.System(ji.Block(1.0, 2.0, corners="base"), gravity=10.0)
    >>> problem = ji.theory.contact_problem(block, [0.0, 1.0, 0.0], [0.0, 0.0, 0.0])
    >>> problem.forces().round(6).tolist()  # half of its weight each
    [5.0, 5.0]
    """
    arguments = {"q": q, "velocity": velocity, "time": time}
    state = (as_numbers(name, x) for name, x in arguments.items())
    return _problem(system, *state)


@quick_jit
def _problem(
    system: System, q: Float[Array, " nq"], v: Float[Array, " n"], t: Float[Array, ""]
) -> ContactProblem:
    """D and B of all contacts."""
    contacts = contacts_at(system, q, v, t, friction=False)
    return ContactProblem(contacts.delassus, contacts.approach)
