"""The time form with a fixed step that does not look for events: x_j is only clamped at 0.

A change of phase anywhere in a step costs O(step^2), whatever the order of the formula. Explicit
steps are stable while `step * sqrt(lambda) < 2.83` (Runge-Kutta 4) or 2 (Verlet) with lambda the
largest eigenvalue of `omega G omega c` (exponent 1), c = 1/e^2 in expansion: small e is stiff.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jimpact.laws.lzb import LZB
from jimpact.methods.contenders.base import (
    Method,
    MethodResult,
    Problem,
    finite_rate,
    in_si,
    problem,
    time_form,
)
from jimpact.scene import Scene
from jimpact.status import CODE


class _Walk(NamedTuple):
    """Indentation, impulse, gap velocity and force (m,), steps taken."""

    x: jax.Array
    p: jax.Array
    gamma: jax.Array
    force: jax.Array
    steps: jax.Array


def _solve_rk4(law: LZB, scene: Scene, velocity: Any, setting: Any) -> MethodResult:
    given = problem(law, scene, velocity)
    flow, before = given.flow, given.inputs.gamma
    h = jnp.asarray(setting, before.dtype)

    def advance(walk: _Walk) -> _Walk:
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
        return _Walk(x, p, before + flow.coupling @ p, walk.force, walk.steps + 1)

    end = _walk(given, advance)
    return in_si(given, end.p, h * end.steps.astype(h.dtype), 4 * end.steps, _code(end))


def _solve_verlet(law: LZB, scene: Scene, velocity: Any, setting: Any) -> MethodResult:
    given = problem(law, scene, velocity)
    flow, before = given.flow, given.inputs.gamma
    h = jnp.asarray(setting, before.dtype)

    def advance(walk: _Walk) -> _Walk:
        p = walk.p + 0.5 * h * walk.force
        closing, _ = time_form(flow, before, walk.x, p)  # compression or expansion: at mid-step
        x = jnp.maximum(walk.x + h * closing, 0.0)
        _, force = time_form(flow, before, x, p)
        p = p + 0.5 * h * force
        return _Walk(x, p, before + flow.coupling @ p, force, walk.steps + 1)

    end = _walk(given, advance)
    return in_si(
        given, end.p, h * end.steps.astype(h.dtype), end.steps + 1, _code(end)
    )  # one force a step


def _walk(given: Problem, advance: Any) -> _Walk:
    x, gamma, zero = given.x, given.inputs.gamma, jnp.zeros_like(given.inputs.gamma)
    _, force = time_form(given.flow, gamma, x, zero)
    return jax.lax.while_loop(
        lambda w: _at_work(w) & (w.steps < given.max_steps),
        advance,
        _Walk(x, zero, gamma, force, jnp.zeros((), jnp.int32)),
    )


def _at_work(walk: _Walk) -> jax.Array:
    return jnp.any((walk.x > 0) | (walk.gamma < 0))


def _code(end: _Walk) -> jax.Array:
    return jnp.where(_at_work(end), CODE["max_steps"], CODE["ok"])


RK4 = Method(
    name="rk4",
    label="time, fixed Runge-Kutta 4",
    setting="step",
    ladder=(0.2, 0.1, 0.03, 0.01, 0.003),
    jax=True,
    supports=finite_rate,
    solve=_solve_rk4,
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
