"""Ways to integrate the LZB impact: jimpact's own, plain fixed steps, solvers of
diffrax and scipy.

All but the first work on the dimensionless flow of `events/contact_flow.py` in time
form, with c_j = 1 in compression and 1/e_j^2 in expansion, and stored energy x_j^(eta_j
+ 1) / 2:

    x_j' = -omega_j c_j gamma_j,   p_j' = F_j = (eta_j + 1)/2 omega_j x_j^eta_j
    gamma = gamma- + G p + K_nt p_t,   u = u- + K_tn p + K_tt p_t
    p_t,j' = -mu_j F_j u_j / sqrt(|u_j|^2 + s_j^2)
                                          (friction, regularized below a slip s)

None of them looks for events: x_j is only clamped at 0, or the step-size control has to
find the changes of phase. A change of phase within a fixed step costs O(step^2),
whatever the order of the formula. Explicit steps are stable while
`step * sqrt(lambda) < 2.83` (Runge-Kutta 4) or 2 (Verlet) with lambda the largest
eigenvalue of `omega G omega c` (exponent 1): small e is stiff.

The published scheme steps in the impulse of the primary contact i, that with the
largest force:

    dp_j = F_j / F_i dp_i,   dE_j = -c_j gamma_j dp_j

First order in the step; at E_j = 0 the rule is 0/0, and the implicit first step of a
contact that is touched for the first time has a closed form. It has no time, so the
duration is NaN.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact.core.scene import Scene
from jimpact.events.contact_flow import power
from jimpact.events.impact_dynamics import Dynamics, evaluate, first_indentation
from jimpact.laws.lzb import LZB
from jimpact.methods.points import UNCOUNTED, Solution
from jimpact.numerics.dense import unit
from jimpact.numerics.sparse import Neighbours, Sparse
from jimpact.numerics.stepper import STAGES
from jimpact.numerics.tangential import per_tangent
from jimpact.numerics.tridiagonal import Tridiagonal, as_matrix
from jimpact.tools.checks import as_float_array, in_common_dtype, needed
from jimpact.tools.compiling import precise_jit
from jimpact.tools.status import CODE

if TYPE_CHECKING:
    import diffrax
else:  # what impacts do without
    diffrax = needed("diffrax", "pip install diffrax")

# Part of the largest energy below which that of a contact is rounding, and the contact
# unloaded. Ten times more would unload contacts that still push.
EMPTY = 1e-14
FINEST = 100 * float(np.finfo(float).eps)  # scipy takes no smaller rtol
GIVE_UP = 5000  # evaluations a contact: LSODA may creep without end at an opening
FOREVER = 1e6  # in units of the impact's time scale: a contact alone lasts about pi


Solve = Callable[[LZB, Scene, Any, Any], Solution]


# normal forces that an implicit step asks for: a whole one and two halves
_FORCES_A_STEP = 3


class Scaled(NamedTuple):
    """Dimensionless impact of closed contacts; a placeholder if nothing `happens`
    ().
    """

    dynamics: Dynamics
    happens: jax.Array

    def solution(
        self, p: Any, t: Any, evaluations: Any, code: Any, p_t: Any
    ) -> Solution:
        """Solution in SI units of dimensionless p (m,), duration t (), p_t (t,).

        Impulses are 0 if nothing happens; the status is `not_finite` if an impulse is
        not finite.
        """
        units = self.dynamics.units
        tangential = None
        impulse = jnp.where(self.happens, p * units.momentum, 0.0)
        finite = jnp.all(jnp.isfinite(impulse))
        if self.dynamics.problem.tangential is not None:
            in_si_units = p_t * per_tangent(units.momentum, p_t)
            tangential = jnp.where(self.happens, in_si_units, 0.0)
            finite = finite & jnp.all(jnp.isfinite(tangential))
        code = jnp.where(self.happens, code, CODE["ok"])
        status = jnp.where(finite, code, CODE["not_finite"])
        duration = jnp.where(self.happens, t * units.time, 0.0)
        return Solution(
            impulse,
            status.astype(jnp.int32),
            duration,
            jnp.asarray(evaluations, jnp.int32),
            tangential,
        )


def scaled(law: LZB, scene: Scene, velocity: Any, rtol: Any = 1.0) -> Scaled:
    """Dimensionless form of an impact of closed contacts at v- (n,), to be solved to
    `rtol`.
    """
    v = as_float_array("velocity", velocity)
    law, scene, v = in_common_dtype(law, scene, v)
    contact = law.contact(scene, v)
    gamma = contact.gap_velocity
    happens = contact.happens
    # any approach will do for the placeholder, if its numbers are finite
    harmless = jnp.where(happens, gamma, -jnp.ones_like(gamma))
    contact = eqx.tree_at(lambda c: c.gap_velocity, contact, harmless)
    tolerance = jnp.asarray(rtol, v.dtype)
    return Scaled(law.dynamics(contact, tolerance), happens)


def time_scale(law: LZB, scene: Scene, velocity: Any) -> jax.Array:
    """Time [s] that 'step' settings are parts of: that of the fastest contact alone.

    Equation: `min_j x_ref,j / (Q sqrt(W_jj))` (see `events/impact_dynamics.py`); a
    contact alone with exponent 1 and e = 1 lasts pi of its own.

    >>> import jimpact as ji
    >>> from jimpact.methods.schemes import time_scale
    >>> float(
    ...     time_scale(
    ...         ji.LZB(1.0, 4.0, exponent=1.0), ji.chain([1.0], wall=True), [1.0]
    ...     )
    ... )
    0.5
    """
    return scaled(law, scene, velocity).dynamics.units.time


# ------------------------------------------------------------------------------ the
# field


class Field(NamedTuple):
    """Right-hand sides of the dimensionless flow in time (module docstring); JAX or
    NumPy arrays.

    In its methods x (m,) are indentations, p (m,) and p_t (t,) impulses.
    """

    x: Any  # indentations (m,) before the impact
    gamma: Any  # gap velocities gamma- (m,)
    slip: Any  # slip velocities u- (t,)
    coupling: Any  # G (m, m)
    cross: Any  # K_nt (m, t)
    tangent: Any  # K_tt (t, t)
    friction: Any  # mu (m,)
    omega: Any  # frequencies omega_j (m,)
    restitution: Any  # e (m,)
    exponent: Any  # eta () or (m,)

    @property
    def start(self) -> tuple[Any, Any, Any]:
        """Indentations x (m,) and impulses p (m,) and p_t (t,), the impulses 0."""
        return self.x, 0.0 * self.gamma, 0.0 * self.slip

    def gap_velocity(self, p: Any, p_t: Any) -> Any:
        """`gamma = gamma- + G p + K_nt p_t` (m,)."""
        return self.gamma + self.coupling @ p + self.cross @ p_t

    def closing(self, now: Any) -> Any:
        """`x' = -omega c gamma` (m,) at gap velocities `now`; c = 1, or 1/e^2 where
        they open.
        """
        c = _where(now > 0, 1 / self.restitution**2, 1.0)
        return -self.omega * c * now

    def force(self, x: Any) -> Any:
        """`p' = F = (eta + 1)/2 omega x^eta` (m,), 0 where x < 0."""
        if isinstance(x, np.ndarray):
            eta = np.asarray(self.exponent, float)
            factor = (eta + 1) / 2 * self.omega
            return factor * np.maximum(x, 0.0) ** eta
        eta_of_jax = jnp.asarray(self.exponent, x.dtype)
        factor_of_jax = (eta_of_jax + 1) / 2 * self.omega
        return factor_of_jax * power(x, self.exponent)

    def drag(self, force: Any, p: Any, p_t: Any, slow: Any) -> Any:
        """`p_t' = -mu F u / sqrt(|u|^2 + slow^2)` (t,) of normal forces F (m,).

        `u = u- + K_tn p + K_tt p_t`; `slow` (m,) or () is the slip that regularizes it.
        """
        by_normal = self.slip + self.cross.T @ p
        u = (by_normal + self.tangent @ p_t).reshape(len(force), -1)
        square = (u**2).sum(axis=1) + slow**2
        moves = square > 0
        drag = self.friction * force / _where(moves, square, 1.0) ** 0.5
        per_slip = _where(moves, drag, 0.0)
        return -(per_slip[:, None] * u).ravel()

    def rates(self, x: Any, p: Any, p_t: Any, slow: Any) -> tuple[Any, Any, Any]:
        """(x', p', p_t'); an open contact stays at its x <= 0, as solvers cannot
        clamp.
        """
        closing = self.closing(self.gap_velocity(p, p_t))
        force = self.force(x)
        opened = (x <= 0) & (closing < 0)
        inwards = _where(opened, 0.0, closing)
        return inwards, force, self.drag(force, p, p_t, slow)

    def at_work(self, x: Any, p: Any, p_t: Any) -> Any:
        """`max(x_j, -gamma_j)` (): positive while a contact is loaded or approaches."""
        return (-self.gap_velocity(p, p_t)).max().clip(x.max())


def _where(condition: Any, yes: Any, no: Any) -> Any:
    """`where` of JAX or of NumPy."""
    numpy = np if isinstance(condition, np.ndarray) else jnp
    return numpy.where(condition, yes, no)


def field_of(problem: Scaled) -> Field:
    """Right-hand sides of a dimensionless impact; G as sparse as its contacts are
    coupled: tridiagonal of a chain, by neighbours of a packing, else dense. Without
    friction there are no tangents.
    """
    dynamics = problem.dynamics
    inputs = problem.dynamics.problem
    m = len(inputs.gamma)
    off = inputs.off_diagonal
    one = jnp.ones_like(inputs.gamma)
    coupling: Any = Tridiagonal(one, off)
    if isinstance(dynamics.structure, Neighbours):
        coupling = Sparse(one, off, dynamics.structure)
    # dense; its diagonal is 1, `off` the upper triangle by rows
    elif dynamics.structure is None:
        places = jnp.triu_indices(m, 1)
        upper = jnp.zeros((m, m), off.dtype).at[places].set(off)
        coupling = unit(upper) + upper + upper.T
    none = jnp.zeros((m, 0), off.dtype)
    cross = none
    tangent = none[:0]
    slip = none[0]
    friction = jnp.zeros_like(one)
    if inputs.tangential is not None:
        block, friction, _ = inputs.tangential
        cross = block.normal_tangent
        tangent = block.tangent
        slip = block.slip
    eta: Any = dynamics.static_exponent if inputs.exponent is None else inputs.exponent
    return Field(
        first_indentation(inputs, dynamics.static_exponent),
        *(inputs.gamma, slip, coupling, cross, tangent, friction),
        *(inputs.omega, inputs.restitution, eta),
    )


# --------------------------------------------------------------------------- jimpact's
# own


def aligned(law: LZB, scene: Scene, velocity: Any, setting: Any) -> Solution:
    """Event-aligned steps, as in `impact`: none straddles a change of phase; `setting`
    is the rtol.

    Impulses are of the run that ends an isolated contact in closed form; the duration
    takes a second run, without it (which the compiler leaves out where the duration is
    not used).
    """
    problem = scaled(law, scene, velocity, setting)
    dynamics = problem.dynamics._replace(method="time")
    program = dynamics.program()
    leaves = dynamics.columns()[0]
    p, p_t, _, code, passes = evaluate(program, leaves)
    to_the_end = dataclasses.replace(program, with_end_time=True)
    _, _, t, _, _ = evaluate(to_the_end, leaves)
    evaluations = (STAGES + 1) * passes[0, 0]  # of all passes, rejected ones included
    return problem.solution(p[:, 0], t[0, 0], evaluations, code[0, 0], p_t[:, 0])


def implicit(law: LZB, scene: Scene, velocity: Any, setting: Any) -> Solution:
    """The law's method 'implicit', without events; `setting` is the rtol."""
    problem = scaled(law, scene, velocity, setting)
    dynamics = problem.dynamics._replace(method="implicit")
    leaves = dynamics.columns()[0]
    p, p_t, t, code, passes = evaluate(dynamics.program(), leaves)
    forces = _FORCES_A_STEP * passes[0, 0]
    return problem.solution(p[:, 0], t[0, 0], forces, code[0, 0], p_t[:, 0])


# ---------------------------------------------------------------------------- fixed
# steps


class Walk(NamedTuple):
    """State of an integration in time steps, dimensionless."""

    x: jax.Array  # indentations (m,)
    p: jax.Array  # normal impulses (m,)
    p_t: jax.Array  # tangential impulses (t,)
    gamma: jax.Array  # gap velocities (m,)
    force: jax.Array  # contact forces (m,)
    steps: jax.Array  # steps taken ()

    @property
    def at_work(self) -> jax.Array:
        """True while a contact is loaded or approaches."""
        return jnp.any((self.x > 0) | (self.gamma < 0))


class StepEnd(NamedTuple):
    """State at the end of a time step; x (m,) is not clamped at 0 yet."""

    x: jax.Array
    p: jax.Array
    p_t: jax.Array
    force: jax.Array


# of the field, the step size h, the state
Step = Callable[[Field, jax.Array, Walk], StepEnd]


State = TypeVar("State", Walk, "ImpulseWalk")


def until_over(
    advance: Callable[[State], State], walk: State, most: int
) -> tuple[State, jax.Array]:
    """Last state of an integration that advances while it is `at_work`, and its status.

    `walk` is the first state, a `Walk` or `ImpulseWalk`; after `most` steps the status
    is `max_steps`.
    """
    end = jax.lax.while_loop(lambda x: x.at_work & (x.steps < most), advance, walk)
    return end, jnp.where(end.at_work, CODE["max_steps"], CODE["ok"])


def in_time(step: Step, stages: int) -> Solve:
    """Solver with fixed time steps of `stages` evaluations each; the setting is their
    size.
    """

    def solve(law: LZB, scene: Scene, velocity: Any, setting: Any) -> Solution:
        """Impulses at v- (n,) with time steps of `setting`, in units of
        `time_scale`.
        """
        problem = scaled(law, scene, velocity)
        field = field_of(problem)
        h = jnp.asarray(setting, field.gamma.dtype)

        def advance(walk: Walk) -> Walk:
            """State after one step, indentations clamped at 0."""
            x, p, p_t, force = step(field, h, walk)
            gamma = field.gap_velocity(p, p_t)
            clamped = jnp.maximum(x, 0.0)
            return Walk(clamped, p, p_t, gamma, force, walk.steps + 1)

        first_force = field.force(field.x)
        no_steps = jnp.zeros((), jnp.int32)
        first = Walk(*field.start, field.gamma, first_force, no_steps)
        end, code = until_over(advance, first, problem.dynamics.max_steps)
        time = h * end.steps.astype(h.dtype)
        return problem.solution(end.p, time, stages * end.steps, code, end.p_t)

    return solve


def rk4(field: Field, h: jax.Array, walk: Walk) -> StepEnd:
    """A classical Runge-Kutta step h of `x' = -omega c gamma(p)`, `p' = F(x)`, without
    friction.
    """
    start = walk.x, walk.p
    rates = total = jax.tree.map(jnp.zeros_like, start)
    for node, weight in ((0.0, 1 / 6), (0.5, 1 / 3), (0.5, 1 / 3), (1.0, 1 / 6)):
        x, p = (a + node * h * rate for a, rate in zip(start, rates))
        rates = field.closing(field.gap_velocity(p, walk.p_t)), field.force(x)
        total = total[0] + weight * h * rates[0], total[1] + weight * h * rates[1]
    # p_t and the force at the end are not needed by further steps
    return StepEnd(walk.x + total[0], walk.p + total[1], walk.p_t, walk.force)


def verlet(field: Field, h: jax.Array, walk: Walk) -> StepEnd:
    """A step h of velocity Verlet: half a kick `p += h/2 F(x)`, `x += h x'(p)`, half a
    kick.

    Friction acts in both half kicks. It is regularized below the slip that it stops
    within one of them, `mu F h/2 |K_tt|` with the largest absolute row sum: stable for
    whatever step; contacts that should stick creep by O(step).
    """
    of_row = jnp.sum(jnp.abs(field.tangent), axis=1)
    stiffest = jnp.max(of_row, initial=0.0)

    def dragged(force: jax.Array, p: jax.Array, p_t: jax.Array) -> jax.Array:
        """Tangential impulses (t,) after friction has acted for half a step."""
        slow = field.friction * force * 0.5 * h * stiffest
        return p_t + 0.5 * h * field.drag(force, p, p_t, slow)

    p = walk.p + 0.5 * h * walk.force
    p_t = dragged(walk.force, p, walk.p_t)
    closing = field.closing(field.gap_velocity(p, p_t))
    x = jnp.maximum(walk.x + h * closing, 0.0)
    force = field.force(x)
    p = p + 0.5 * h * force
    return StepEnd(x, p, dragged(force, p, p_t), force)


# ------------------------------------------------------------- steps in impulse
# (published)


class ImpulseWalk(NamedTuple):
    """State of an integration in steps of the primary impulse, dimensionless."""

    gamma: jax.Array  # gap velocities (m,)
    energy: jax.Array  # potential energies E_j (m,)
    p: jax.Array  # normal impulses (m,)
    steps: jax.Array  # steps taken ()

    @property
    def at_work(self) -> jax.Array:
        """True while a contact is loaded or approaches."""
        return jnp.any((self.energy > 0) | (self.gamma < 0))


def impulse_euler(law: LZB, scene: Scene, velocity: Any, setting: Any) -> Solution:
    """Explicit steps in the impulse of the primary contact, the published scheme.

    The setting is their size, in units of the impact's momentum.
    """
    problem = scaled(law, scene, velocity, setting)
    inputs = problem.dynamics.problem
    field = field_of(problem)
    none = jnp.zeros_like(inputs.gamma)
    zero = jnp.zeros((), jnp.int32)
    first = ImpulseWalk(inputs.gamma, 0.5 * inputs.energy, none, zero)
    advance = partial(_impulse_step, field, inputs.step[0])
    end, code = until_over(advance, first, problem.dynamics.max_steps)
    return problem.solution(end.p, jnp.nan, end.steps, code, field.slip)


def _impulse_step(field: Field, dp: jax.Array, walk: ImpulseWalk) -> ImpulseWalk:
    """One explicit step of `dp` in the impulse of the primary contact i, that of the
    largest force.

    Equation: `dp_j = F_j / F_i dp`, `F_j(E) = (eta + 1) / 2 omega (2 E)^(eta / (eta +
    1))`, and `E_j` falls by the work of dp_j, `c_j gamma_j dp_j`. A contact with E_j =
    0 that approaches at w_j has `E_j = w_j dp_j` in this step, so that
    `dp_j = ((dp / F_i) F_j(w_j))^(eta + 1)`.
    """
    gamma = walk.gamma
    energy = walk.energy
    eta = jnp.asarray(field.exponent, gamma.dtype)
    approach = jnp.maximum(-gamma, 0.0)

    def force(energy: jax.Array) -> jax.Array:
        """Dimensionless contact force at potential energy E_j."""
        positive = energy > 0
        doubled = jnp.where(positive, 2 * energy, 1.0)
        root = jnp.where(positive, doubled ** (eta / (eta + 1)), 0.0)
        return (eta + 1) / 2 * field.omega * root

    # at the first touch the energy is that of the step itself
    f = force(energy)
    touch = force(approach * dp)
    f_start = jnp.where(jnp.any(energy > 0), f, touch)
    primary = jnp.argmax(f_start)
    scale = dp / f_start[primary]
    approaches = jnp.where(approach > 0, 1.0, 0.0)
    root_of_first = (scale * force(approach)) * approaches
    first = power(root_of_first, eta + 1)
    increment = jnp.where(energy > 0, scale * f, first)
    is_primary = jnp.arange(len(gamma)) == primary  # in batches faster than an index
    increment = jnp.where(is_primary, dp, increment)
    increment = increment * _emptying(field, walk, is_primary, increment)
    after = gamma + field.coupling @ increment
    # exact work of the step; its error is the first-order one of the distributing rule
    # alone
    middle = 0.5 * (gamma + after)
    rate = jnp.where(middle > 0, 1 / field.restitution**2, 1.0)
    left = jnp.maximum(energy - rate * middle * increment, 0.0)
    nothing = EMPTY * jnp.max(energy + approach**2)
    left = jnp.where(left > nothing, left, 0.0)
    return ImpulseWalk(after, left, walk.p + increment, walk.steps + 1)


def _emptying(
    field: Field, walk: ImpulseWalk, is_primary: jax.Array, increment: jax.Array
) -> jax.Array:
    """Fraction s () of the step at which the primary contact is unloaded; 1 if it is
    not.

    Equation: `gamma s + dgamma s^2 / 2 = b`, `b = E e^2 / dp`, dgamma the change of its
    gap velocity in the whole step: `s = 2 b / (gamma + sqrt(gamma^2 + 2 dgamma b))`.
    The derivative of the outcome depends on ending there, not on a fixed step.
    """
    values = (
        walk.gamma,
        walk.energy,
        increment,
        field.coupling @ increment,
        field.restitution,
    )
    # of the primary contact alone
    gamma, energy, dp, dgamma, e = (
        jnp.sum(jnp.where(is_primary, x, 0.0)) for x in values
    )
    b = energy * e**2 / dp
    expands = (gamma + 0.5 * dgamma > 0) & (energy > 0)
    square = jnp.where(expands, gamma**2 + 2 * dgamma * b, 1.0)
    root = jnp.sqrt(jnp.maximum(square, 0.0))
    denominator = jnp.where(expands, gamma + root, 1.0)
    fraction = 2 * b / jnp.where(denominator > 0, denominator, 1.0)
    within = (denominator > 0) & (fraction < 1)
    return jnp.where(expands & within, fraction, 1.0)


# -------------------------------------------------------------------------------
# libraries


def by_diffrax(solver: "diffrax.AbstractSolver", stages: int | None) -> Solve:
    """Solver by diffrax, ended by an event; `stages`: evaluations a step (None: not
    known).
    """

    def solve(law: LZB, scene: Scene, velocity: Any, setting: Any) -> Solution:
        """Impulses at v- (n,) with rtol `setting`, to the end of the step in which it
        is over.

        The rest of that step, after the end, changes no impulse, but the duration is
        not known. The event `max(x, -gamma) = rtol` must be crossed downwards: the
        impact begins at the approach itself.
        """
        problem = scaled(law, scene, velocity)
        field = field_of(problem)
        rtol = jnp.asarray(setting, field.gamma.dtype)
        # without friction: each part more of a state costs time
        x, p, no_friction = field.start

        def rates(t: Any, y: Any, args: Any) -> tuple[Any, Any]:
            """(x', p') at y = (x, p)."""
            field, _ = args
            x_rate, p_rate, _ = field.rates(*y, no_friction, slow=0.0)
            return x_rate, p_rate

        def margin(t: Any, y: Any, args: Any, **_: Any) -> Any:
            """`max(x, -gamma) - rtol`, the largest of all contacts."""
            field, rtol = args
            return field.at_work(*y, no_friction) - rtol

        result = diffrax.diffeqsolve(
            diffrax.ODETerm(rates),
            solver,
            t0=jnp.zeros_like(rtol),
            t1=jnp.full_like(rtol, jnp.inf),
            dt0=None,
            y0=(x, p),
            args=(field, rtol),
            stepsize_controller=diffrax.PIDController(rtol=rtol, atol=rtol),
            event=diffrax.Event(margin, direction=False),
            adjoint=diffrax.ForwardMode(),
            max_steps=problem.dynamics.max_steps,
            throw=False,
        )
        assert result.ys is not None
        steps = result.stats["num_steps"]
        if stages is None:
            evaluations = jnp.full_like(steps, UNCOUNTED)
        else:
            evaluations = stages * steps + 1  # one chooses the first step
        ended = result.result == diffrax.RESULTS.event_occurred
        code = jnp.where(ended, CODE["ok"], CODE["max_steps"])
        impulse = result.ys[1][-1]
        return problem.solution(impulse, jnp.nan, evaluations, code, no_friction)

    return solve


class _GaveUpError(Exception):
    """There were more evaluations than the law allows steps."""


def by_scipy(name: str) -> Solve:
    """Solver by the method `name` of `scipy.integrate.solve_ivp`, ended by an event."""

    def solve(law: LZB, scene: Scene, velocity: Any, setting: Any) -> Solution:
        """Impulses at v- (n,) with rtol `setting`, also the slip that regularizes
        friction.
        """
        from scipy.integrate import solve_ivp  # late: scipy is slow to import

        problem, traced = _on_host(law, scene, velocity)
        field = Field(*(np.asarray(x, float) for x in traced))
        m = len(field.gamma)
        parts = np.cumsum([m, m])
        rtol = max(float(setting), FINEST)
        most = min(problem.dynamics.max_steps, GIVE_UP * m)
        count = 0
        reached = (0.0, np.concatenate(field.start))

        def rates(t: float, y: np.ndarray) -> np.ndarray:
            """Rates of (x, p, p_t) (2 m + t,); counted, as `nfev` omits the solver's
            Jacobians.
            """
            nonlocal count, reached
            count = count + 1
            reached = (t, y)
            if count > most:
                raise _GaveUpError
            x, p, p_t = np.split(y, parts)
            return np.concatenate(field.rates(x, p, p_t, rtol))

        def at_work(_: float, y: np.ndarray) -> float:
            """Event function `max(x, -gamma) - rtol`: positive while the impact
            lasts.
            """
            x, p, p_t = np.split(y, parts)
            return field.at_work(x, p, p_t) - rtol

        at_work.terminal, at_work.direction = True, -1.0  # type: ignore[attr-defined]
        options = {"method": name, "rtol": rtol, "atol": rtol, "events": at_work}
        try:
            result = solve_ivp(rates, (0.0, FOREVER), reached[1], **options)
        except _GaveUpError:
            ended = False
        else:
            ended = result.status == 1
            reached = (float(result.t[-1]), result.y[:, -1])
        time, y = reached
        values = np.split(y, parts)
        _, p, p_t = (jnp.asarray(x, traced.gamma.dtype) for x in values)
        code = CODE["ok" if ended else "max_steps"]
        return problem.solution(p, jnp.asarray(time), count, code, p_t)

    return solve


@precise_jit
def _on_host(law: LZB, scene: Scene, velocity: Any) -> tuple[Scaled, Field]:
    """Dimensionless form of an impact, and its right-hand sides with a dense G, for
    NumPy.
    """
    problem = scaled(law, scene, velocity)
    field = field_of(problem)
    return problem, field._replace(coupling=as_matrix(field.coupling))
