"""jimpact's own integrator, and plain schemes with fixed steps in time and in impulse.

**Event-aligned** (`events/stepper.py`): no step straddles a change of phase. Impulses come from the
run that finishes an isolated contact in closed form, as `impact` does; the duration needs that
stroke integrated too, by a second run (which the compiler leaves out where the duration is not
used). Evaluations: stages of all passes, rejected ones included.

**Fixed steps in time** do not look for events, x_j is only clamped at 0. A change of phase anywhere
in a step costs O(step^2), whatever the order of the formula. Explicit steps are stable while `step
* sqrt(lambda) < 2.83` (Runge-Kutta 4) or 2 (Verlet) with lambda the largest eigenvalue of `omega G
omega c` (exponent 1), c = 1/e^2 in expansion: small e is stiff.

**Steps in impulse** integrate the distributing rule. With primary contact i (the one with the
largest force; it may change from step to step),

    dp_j = F_j / F_i dp_i,   dE_j = -c_j gamma_j dp_j,   gamma = gamma- + G p

`impulse_euler` is the published scheme (`events/impulse_form.py`). `impulse_rk4` advances the same
equations by the classical Runge-Kutta formula, with the same primary contact, the same closed-form
first step of a contact that is touched for the first time (0/0 of the rule) and the same shortened
step where the primary contact is unloaded. It stays far below order 4: the rule is not Lipschitz at
E_j = 0, where every contact begins and ends.

The impulse form has no time, so the duration is NaN.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jimpact.events import impulse_form
from jimpact.events.contact_flow import power
from jimpact.events.impact_dynamics import Outcome, outcome
from jimpact.events.impulse_form import EMPTY, Rule, Walk, force
from jimpact.events.stepper import STAGES
from jimpact.laws.lzb import LZB
from jimpact.methods.contenders.base import (
    GivenImpact,
    Method,
    MethodResult,
    finite_rate,
    in_si,
    lzb_only,
    problem,
    time_form,
)
from jimpact.scene import Scene
from jimpact.status import CODE

_NODES = (0.0, 0.5, 0.5, 1.0)  # of the classical Runge-Kutta formula
_WEIGHTS = (1 / 6, 1 / 3, 1 / 3, 1 / 6)


def _solve_aligned(law: LZB, scene: Scene, velocity: Any, setting: Any) -> MethodResult:
    given = problem(law, scene, velocity, setting)
    leaves, tree = given.dynamics.columns()
    function = Outcome(tree, given.dynamics.static_exponent, given.dynamics.chain, given.max_steps)
    p, _, _, code, passes = outcome(function, leaves)
    _, _, t, _, _ = outcome(dataclasses.replace(function, whole=True), leaves)
    return in_si(given, p[:, 0], t[0, 0], (STAGES + 1) * passes[0, 0], code[0, 0])


DOP853_ALIGNED = Method(
    name="dop853",
    label="event-aligned Dormand-Prince 8 (default)",
    setting="rtol",
    ladder=(1e-3, 1e-5, 1e-7, 1e-9, 1e-11),
    jax=True,
    supports=lzb_only,
    solve=_solve_aligned,
    duration_apart=True,
)


class _TimeWalk(NamedTuple):
    """Indentation, impulse, gap velocity and force (m,), steps taken."""

    x: jax.Array
    p: jax.Array
    gamma: jax.Array
    force: jax.Array
    steps: jax.Array


def _solve_time_rk4(law: LZB, scene: Scene, velocity: Any, setting: Any) -> MethodResult:
    given = problem(law, scene, velocity)
    flow, before = given.flow, given.inputs.gamma
    h = jnp.asarray(setting, before.dtype)

    def advance(walk: _TimeWalk) -> _TimeWalk:
        def at(part: jax.Array, dx: jax.Array, dp: jax.Array) -> tuple[jax.Array, jax.Array]:
            return time_form(flow, before, walk.x + part * dx, walk.p + part * dp)

        a = time_form(flow, before, walk.x, walk.p)
        b = at(0.5 * h, *a)
        c = at(0.5 * h, *b)
        d = at(h, *c)
        dx, dp = (
            (h / 6) * (first + 2 * (second + third) + last)
            for first, second, third, last in zip(a, b, c, d)
        )
        p = walk.p + dp
        x = jnp.maximum(walk.x + dx, 0.0)
        return _TimeWalk(x, p, before + flow.coupling @ p, walk.force, walk.steps + 1)

    end = _run(given, advance)
    return in_si(given, end.p, h * end.steps.astype(h.dtype), 4 * end.steps, _code(end))


def _solve_verlet(law: LZB, scene: Scene, velocity: Any, setting: Any) -> MethodResult:
    given = problem(law, scene, velocity)
    flow, before = given.flow, given.inputs.gamma
    h = jnp.asarray(setting, before.dtype)

    def advance(walk: _TimeWalk) -> _TimeWalk:
        p = walk.p + 0.5 * h * walk.force
        closing, _ = time_form(flow, before, walk.x, p)  # compression or expansion: at mid-step
        x = jnp.maximum(walk.x + h * closing, 0.0)
        _, force = time_form(flow, before, x, p)
        p = p + 0.5 * h * force
        return _TimeWalk(x, p, before + flow.coupling @ p, force, walk.steps + 1)

    end = _run(given, advance)
    return in_si(
        given, end.p, h * end.steps.astype(h.dtype), end.steps + 1, _code(end)
    )  # one force a step


def _run(given: GivenImpact, advance: Any) -> _TimeWalk:
    x, gamma, zero = given.x, given.inputs.gamma, jnp.zeros_like(given.inputs.gamma)
    _, force = time_form(given.flow, gamma, x, zero)
    return jax.lax.while_loop(
        lambda w: _at_work(w) & (w.steps < given.max_steps),
        advance,
        _TimeWalk(x, zero, gamma, force, jnp.zeros((), jnp.int32)),
    )


def _at_work(walk: _TimeWalk) -> jax.Array:
    return jnp.any((walk.x > 0) | (walk.gamma < 0))


def _code(end: _TimeWalk) -> jax.Array:
    return jnp.where(_at_work(end), CODE["max_steps"], CODE["ok"])


TIME_RK4 = Method(
    name="rk4",
    label="time, fixed Runge-Kutta 4",
    setting="step",
    ladder=(0.2, 0.1, 0.03, 0.01, 0.003),
    jax=True,
    supports=finite_rate,
    solve=_solve_time_rk4,
)
VERLET = Method(
    name="verlet",
    label="time, velocity Verlet",
    setting="step",
    ladder=(0.2, 0.1, 0.03, 0.01, 0.003),
    jax=True,
    supports=finite_rate,
    solve=_solve_verlet,
)


def _solve_euler(law: LZB, scene: Scene, velocity: Any, setting: Any) -> MethodResult:
    given = problem(law, scene, velocity, setting)
    gamma, energy, dp = _start(given)
    end = impulse_form.walk(given.flow, dp, given.max_steps, gamma, energy)
    return _result(given, end, 1)


def _solve_impulse_rk4(law: LZB, scene: Scene, velocity: Any, setting: Any) -> MethodResult:
    given = problem(law, scene, velocity, setting)
    gamma, energy, dp = _start(given)
    end = jax.lax.while_loop(
        lambda w: impulse_form.at_work(w) & (w.steps < given.max_steps),
        lambda w: _advance(given.flow, dp, w),
        Walk(gamma, energy, jnp.zeros_like(gamma), jnp.zeros((), jnp.int32)),
    )
    return _result(given, end, len(_NODES))


def _start(given: GivenImpact) -> tuple[jax.Array, jax.Array, jax.Array]:
    x = given.x
    eta = jnp.asarray(given.flow.exponent, x.dtype)
    energy = 0.5 * jnp.where(x > 0, jnp.where(x > 0, x, 1.0) ** (eta + 1), 0.0)
    return given.inputs.gamma, energy, given.inputs.step[0]


def _result(given: GivenImpact, end: Walk, stages: int) -> MethodResult:
    code = jnp.where(impulse_form.at_work(end), CODE["max_steps"], CODE["ok"])
    return in_si(given, end.p, jnp.full_like(end.p[0], jnp.nan), stages * end.steps, code)


def _advance(flow: Rule, dp: jax.Array, walk: Walk) -> Walk:
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

    def rates(de: jax.Array, push: jax.Array) -> tuple[jax.Array, jax.Array]:
        at = force(flow, energy + de)
        leading = jnp.sum(jnp.where(primary, at, 0.0))
        # as the primary contact is unloaded the rule has a pole; a force that outgrows its own
        # is primary from the next step on
        slope = jnp.minimum(at / jnp.where(leading > 0, leading, 1.0), 1.0)
        slope = jnp.where(primary, 1.0, jnp.where(loaded & (leading > 0), slope, fresh))
        now = gamma + flow.coupling @ push
        return -jnp.where(now > 0, 1 / flow.restitution**2, 1.0) * now * slope, slope

    de, push = jnp.zeros_like(energy), jnp.zeros_like(energy)
    change, increment = de, push
    for node, weight in zip(_NODES, _WEIGHTS):
        de, push = rates(node * dp * de, node * dp * push)
        change, increment = change + weight * dp * de, increment + weight * dp * push
    left = jnp.maximum(energy + change, 0.0)
    return Walk(
        gamma + flow.coupling @ increment,
        jnp.where(left > EMPTY * jnp.max(energy + approach**2), left, 0.0),
        walk.p + increment,
        walk.steps + 1,
    )


IMPULSE_EULER = Method(
    name="impulse_euler",
    label="impulse, Euler (published)",
    setting="impulse step",
    ladder=(1e-2, 3e-3, 1e-3, 3e-4),
    jax=True,
    supports=lzb_only,
    solve=_solve_euler,
)
IMPULSE_RK4 = Method(
    name="impulse_rk4",
    label="impulse, Runge-Kutta 4",
    setting="impulse step",
    ladder=(3e-2, 1e-2, 3e-3, 1e-3),
    jax=True,
    supports=finite_rate,
    solve=_solve_impulse_rk4,
)
