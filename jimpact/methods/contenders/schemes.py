"""jimpact's own integrator, and plain schemes with fixed steps in time and in impulse.

**Event-aligned** (`events/stepper.py`): no step straddles a change of phase. Impulses come from the
run that finishes an isolated contact in closed form, as `impact` does; the duration needs that
stroke integrated too, by a second run (which the compiler leaves out where the duration is not
used). Evaluations: stages of all passes, rejected ones included. **Implicit friction** is the law's
own method without events, where this version of the package has it.

**Fixed steps in time** do not look for events, x_j is only clamped at 0. A change of phase anywhere
in a step costs O(step^2), whatever the order of the formula. Explicit steps are stable while `step
* sqrt(lambda) < 2.83` (Runge-Kutta 4) or 2 (Verlet) with lambda the largest eigenvalue of `omega G
omega c` (exponent 1), c = 1/e^2 in expansion: small e is stiff. Verlet has friction, regularized
below the slip that it stops within half a step: contacts that should stick creep by O(step).

**Steps in impulse** integrate the distributing rule. With primary contact i (the one with the
largest force; it may change from step to step),

    dp_j = F_j / F_i dp_i,   dE_j = -c_j gamma_j dp_j,   gamma = gamma- + G p

`impulse_euler` is the published scheme (`impulse_form.py`). `impulse_rk4` advances the same
equations by the classical Runge-Kutta formula, with the same primary contact, the same closed-form
first step of a contact that is touched for the first time (0/0 of the rule) and the same shortened
step where the primary contact is unloaded. It stays far below order 4: the rule is not Lipschitz at
E_j = 0, where every contact begins and ends.

The impulse form has no time, so the duration is NaN.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jimpact.events.contact_flow import power
from jimpact.events.impact_dynamics import Sides, evaluate
from jimpact.events.implicit_steps import FORCES_A_STEP
from jimpact.events.stepper import STAGES
from jimpact.laws.lzb import LZB
from jimpact.methods.contenders import impulse_form
from jimpact.methods.contenders.base import (
    Method,
    MethodResult,
    Solve,
    in_si,
    problem,
    pull,
    regularized,
    slip,
    stopped_within,
    time_form,
)
from jimpact.methods.contenders.impulse_form import EMPTY, Rule, Walk, force
from jimpact.scene import Scene
from jimpact.status import CODE


def _solve_aligned(law: LZB, scene: Scene, velocity: Any, setting: Any) -> MethodResult:
    """What `impact` does, with its duration."""
    scaled = problem(law, scene, velocity, setting, friction=True)
    dynamics = scaled.dynamics._replace(method="time")
    program, leaves = dynamics.program(), dynamics.columns()[0]
    p, side, _, code, passes = evaluate(program, leaves)
    _, _, t, _, _ = evaluate(dataclasses.replace(program, whole=True), leaves)
    return in_si(scaled, p[:, 0], t[0, 0], (STAGES + 1) * passes[0, 0], code[0, 0], side[:, 0])


def _solve_implicit(law: LZB, scene: Scene, velocity: Any, setting: Any) -> MethodResult:
    """The law's own method without events."""
    scaled = problem(law, scene, velocity, setting, friction=True)
    dynamics = scaled.dynamics._replace(method="implicit")
    p, side, t, code, passes = evaluate(dynamics.program(), dynamics.columns()[0])
    forces = FORCES_A_STEP * passes[0, 0]
    return in_si(scaled, p[:, 0], t[0, 0], forces, code[0, 0], side[:, 0])


Pair = tuple[jax.Array, jax.Array]


def _runge_kutta(rates: Callable[[Pair], Pair], h: jax.Array, zero: jax.Array) -> Pair:
    """The change over a step by the classical formula; `rates` at a change of the state."""
    change, total = (zero, zero), (zero, zero)
    for node, weight in ((0.0, 1 / 6), (0.5, 1 / 3), (0.5, 1 / 3), (1.0, 1 / 6)):
        slope = rates((node * h * change[0], node * h * change[1]))
        total = total[0] + weight * h * slope[0], total[1] + weight * h * slope[1]
        change = slope
    return total


# ----------------------------------------------------------------------------- steps in time


class _TimeWalk(NamedTuple):
    """Indentation, impulse, gap velocity and force (m,), steps taken, tangential impulse (t,)."""

    x: jax.Array
    p: jax.Array
    gamma: jax.Array
    force: jax.Array
    steps: jax.Array
    side: jax.Array


class _Field(NamedTuple):
    """The flow, gap velocities (m,) before the impact, and what friction acts on."""

    flow: Rule
    before: jax.Array
    sides: Sides | None


# (field, h, walk) -> x (to be clamped), p, force, tangential impulses
TimeStep = Callable[[_Field, jax.Array, _TimeWalk], tuple[jax.Array, ...]]


def _in_time(step: TimeStep, stages: int, first: int, friction: bool = False) -> Solve:
    """`solve` by fixed steps in time of `stages` evaluations each; `first`: those at the start."""

    def solve(law: LZB, scene: Scene, velocity: Any, setting: Any) -> MethodResult:
        """The impact with this time step."""
        scaled = problem(law, scene, velocity, friction=friction)
        flow, before, start = scaled.flow, scaled.inputs.gamma, scaled.x
        field = _Field(flow, before, scaled.sides)
        h, zero = jnp.asarray(setting, before.dtype), jnp.zeros_like(before)
        none = zero[:0] if scaled.sides is None else jnp.zeros_like(scaled.sides.block.slip)

        def at_work(walk: _TimeWalk) -> jax.Array:
            """Whether a contact is loaded or approaches."""
            return jnp.any((walk.x > 0) | (walk.gamma < 0))

        def advance(walk: _TimeWalk) -> _TimeWalk:
            """One step."""
            x, p, force, side = step(field, h, walk)
            gamma = before + flow.coupling @ p + pull(field.sides, side)
            return _TimeWalk(jnp.maximum(x, 0.0), p, gamma, force, walk.steps + 1, side)

        _, force = time_form(flow, before, start, zero)
        end = jax.lax.while_loop(
            lambda walk: at_work(walk) & (walk.steps < scaled.max_steps),
            advance,
            _TimeWalk(start, zero, before, force, jnp.zeros((), jnp.int32), none),
        )
        code = jnp.where(at_work(end), CODE["max_steps"], CODE["ok"])
        evaluations = stages * end.steps + first
        return in_si(scaled, end.p, h * end.steps.astype(h.dtype), evaluations, code, end.side)

    return solve


def _rk4(field: _Field, h: jax.Array, walk: _TimeWalk) -> tuple[jax.Array, ...]:
    """A classical Runge-Kutta step."""

    def rates(change: Pair) -> Pair:
        """(x', p') at a change of (x, p)."""
        return time_form(field.flow, field.before, walk.x + change[0], walk.p + change[1])

    dx, dp = _runge_kutta(rates, h, jnp.zeros_like(field.before))
    return walk.x + dx, walk.p + dp, walk.force, walk.side


def _verlet(field: _Field, h: jax.Array, walk: _TimeWalk) -> tuple[jax.Array, ...]:
    """A step of velocity Verlet."""
    flow, before, sides = field
    p = walk.p + 0.5 * h * walk.force
    side = _dragged(sides, 0.5 * h, walk.force, p, walk.side)
    now = before + pull(sides, side)
    closing, _ = time_form(flow, now, walk.x, p)  # compression or expansion: at mid-step
    x = jnp.maximum(walk.x + h * closing, 0.0)
    _, force = time_form(flow, now, x, p)
    p = p + 0.5 * h * force
    return x, p, force, _dragged(sides, 0.5 * h, force, p, side)


def _dragged(
    sides: Sides | None, h: jax.Array, force: jax.Array, p: jax.Array, side: jax.Array
) -> jax.Array:
    """Tangential impulses (t,) after friction has acted for a time h."""
    if sides is None:
        return side
    slow = stopped_within(sides, force, h)
    return side + h * regularized(sides, force, slip(sides, p, side), slow)


# -------------------------------------------------------------------------- steps in impulse


def _in_impulse(step: Callable[[Rule, jax.Array, Walk], Walk], stages: int) -> Solve:
    """`solve` by steps in the primary impulse, of `stages` evaluations each."""

    def solve(law: LZB, scene: Scene, velocity: Any, setting: Any) -> MethodResult:
        """The impact with this step in the primary impulse."""
        scaled = problem(law, scene, velocity, setting)
        inputs, flow = scaled.inputs, scaled.flow
        none, gamma = jnp.zeros_like(inputs.gamma), inputs.gamma
        end = jax.lax.while_loop(
            lambda walk: impulse_form.at_work(walk) & (walk.steps < scaled.max_steps),
            lambda walk: step(flow, inputs.step[0], walk),
            Walk(gamma, 0.5 * inputs.energy, none, jnp.zeros((), jnp.int32)),
        )
        code = jnp.where(impulse_form.at_work(end), CODE["max_steps"], CODE["ok"])
        return in_si(scaled, end.p, jnp.full_like(end.p[0], jnp.nan), stages * end.steps, code)

    return solve


def _impulse_rk4(flow: Rule, dp: jax.Array, walk: Walk) -> Walk:
    """One Runge-Kutta step of `dp` in the primary impulse."""
    gamma, energy = walk.gamma, walk.energy
    eta = jnp.asarray(flow.exponent, gamma.dtype)
    approach, loaded = jnp.maximum(-gamma, 0.0), energy > 0
    f = force(flow, energy)
    f_start = jnp.where(jnp.any(loaded), f, force(flow, approach * dp))
    primary = jnp.arange(gamma.shape[0]) == jnp.argmax(f_start)
    scale = dp / jnp.max(f_start)
    first = (scale * force(flow, approach)) * jnp.where(approach > 0, 1.0, 0.0)
    begun = jnp.where(loaded, scale * f, power(first, eta + 1))
    begun = jnp.where(primary, dp, begun)
    dp = dp * impulse_form.emptying(flow, walk, primary, begun)
    fresh = begun / jnp.max(jnp.where(primary, begun, 0.0))

    def rates(change: Pair) -> Pair:
        """(dE, dp) over the primary impulse at a change of (E, p)."""
        at = force(flow, energy + change[0])
        leading = jnp.sum(jnp.where(primary, at, 0.0))
        # The rule has a pole where the primary contact is unloaded; a larger force is the primary
        # one from the next step on.
        slope = jnp.minimum(at / jnp.where(leading > 0, leading, 1.0), 1.0)
        slope = jnp.where(primary, 1.0, jnp.where(loaded & (leading > 0), slope, fresh))
        now = gamma + flow.coupling @ change[1]
        return -jnp.where(now > 0, 1 / flow.restitution**2, 1.0) * now * slope, slope

    change, increment = _runge_kutta(rates, dp, jnp.zeros_like(energy))
    left = jnp.maximum(energy + change, 0.0)
    return Walk(
        gamma + flow.coupling @ increment,
        jnp.where(left > EMPTY * jnp.max(energy + approach**2), left, 0.0),
        walk.p + increment,
        walk.steps + 1,
    )


_TIME_STEPS = (0.2, 0.1, 0.03, 0.01, 0.003)  # in units of `time_scale`, coarse to fine
DOP853_ALIGNED = Method(
    "dop853",
    "event-aligned Dormand-Prince 8 (default)",
    "rtol",
    (1e-3, 1e-5, 1e-7, 1e-9, 1e-11),
    _solve_aligned,
    divides=False,
    duration_apart=True,
    friction=True,
)
IMPLICIT = Method(
    "implicit",
    "without events, implicit friction",
    "rtol",
    (1e-2, 1e-3, 1e-4, 1e-5),
    _solve_implicit,
    divides=False,
    friction=True,
)
SCHEMES = (
    Method(
        "impulse_euler",
        "impulse, Euler (published)",
        "impulse step",
        (1e-2, 3e-3, 1e-3, 3e-4),
        _in_impulse(impulse_form.advance, 1),
        divides=False,
    ),
    Method(
        "impulse_rk4",
        "impulse, Runge-Kutta 4",
        "impulse step",
        (3e-2, 1e-2, 3e-3, 1e-3),
        _in_impulse(_impulse_rk4, 4),
    ),
    Method("rk4", "time, fixed Runge-Kutta 4", "step", _TIME_STEPS, _in_time(_rk4, 4, 0)),
    Method(
        "verlet",
        "time, velocity Verlet",
        "step",
        _TIME_STEPS,
        _in_time(_verlet, 1, 1, friction=True),
        friction=True,
    ),
    DOP853_ALIGNED,
    IMPLICIT,
)
