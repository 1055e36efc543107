"""The distributing rule integrated in the impulse of a primary contact.

With primary contact i (the one with the largest force; it may change from step to step),

    dp_j = F_j / F_i dp_i,   dE_j = -c_j gamma_j dp_j,   gamma = gamma- + G p

`impulse_euler` is the published scheme (`events/impulse_form.py`). `impulse_rk4` advances the
same equations by the classical Runge-Kutta formula, with the same primary contact, the same
closed-form first step of a contact that is touched for the first time (0/0 of the rule) and the
same shortened step where the primary contact is unloaded. It stays far below order 4: the rule is
not Lipschitz at E_j = 0, where every contact begins and ends.

The impulse form has no time, so the duration is NaN.
"""

from typing import Any

import jax
import jax.numpy as jnp

from jimpact.events import impulse_form
from jimpact.events.contact_flow import power
from jimpact.events.impulse_form import EMPTY, Rule, Walk, force
from jimpact.laws.lzb import LZB
from jimpact.methods.contenders.base import (
    Method,
    MethodResult,
    Problem,
    finite_rate,
    in_si,
    lzb_only,
    problem,
)
from jimpact.scene import Scene
from jimpact.status import CODE

_NODES = (0.0, 0.5, 0.5, 1.0)  # of the classical Runge-Kutta formula
_WEIGHTS = (1 / 6, 1 / 3, 1 / 3, 1 / 6)


def _solve_euler(law: LZB, scene: Scene, velocity: Any, setting: Any) -> MethodResult:
    given = problem(law, scene, velocity, setting)
    gamma, energy, dp = _start(given)
    end = impulse_form.walk(given.flow, dp, given.max_steps, gamma, energy)
    return _result(given, end, 1)


def _solve_rk4(law: LZB, scene: Scene, velocity: Any, setting: Any) -> MethodResult:
    given = problem(law, scene, velocity, setting)
    gamma, energy, dp = _start(given)
    end = jax.lax.while_loop(
        lambda w: impulse_form.at_work(w) & (w.steps < given.max_steps),
        lambda w: _advance(given.flow, dp, w),
        Walk(gamma, energy, jnp.zeros_like(gamma), jnp.zeros((), jnp.int32)),
    )
    return _result(given, end, len(_NODES))


def _start(given: Problem) -> tuple[jax.Array, jax.Array, jax.Array]:
    x = given.x
    eta = jnp.asarray(given.flow.exponent, x.dtype)
    energy = 0.5 * jnp.where(x > 0, jnp.where(x > 0, x, 1.0) ** (eta + 1), 0.0)
    return given.inputs.gamma, energy, given.inputs.step[0]


def _result(given: Problem, end: Walk, stages: int) -> MethodResult:
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


EULER = Method(
    name="impulse_euler",
    label="impulse, Euler (published)",
    setting="impulse step",
    ladder=(1e-2, 3e-3, 1e-3, 3e-4),
    jax=True,
    supports=lzb_only,
    solve=_solve_euler,
)
RK4 = Method(
    name="impulse_rk4",
    label="impulse, Runge-Kutta 4",
    setting="impulse step",
    ladder=(3e-2, 1e-2, 3e-3, 1e-3),
    jax=True,
    supports=finite_rate,
    solve=_solve_rk4,
)
