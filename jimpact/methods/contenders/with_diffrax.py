"""The plain time form handed to diffrax, ended by an event, as one would write it without jimpact.

Steps do not know of the changes of phase: the step-size control has to find them. The impact is
over when no contact holds or approaches by more than the tolerance; the event must be crossed
downwards, for it begins at the approach itself.
"""

import functools
from collections.abc import Callable
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import optimistix as optx

from jimpact.laws.lzb import LZB
from jimpact.methods.contenders.base import (
    UNCOUNTED,
    Method,
    MethodResult,
    finite_rate,
    held_open,
    in_si,
    problem,
    time_form,
)
from jimpact.numerics.flow import Flow
from jimpact.scene import Scene
from jimpact.status import CODE

EVENT_TOLERANCE = 1e-10  # of the root finder, in units of the impact's time scale


def _solver(
    solver: diffrax.AbstractSolver,
    stages: int | None,
    tally: Callable[[], None] | None = None,
) -> Callable[[LZB, Scene, Any, Any], MethodResult]:
    """`solve` by a diffrax solver of so many new stages a step (None: not known beforehand)."""

    def solve(law: LZB, scene: Scene, velocity: Any, setting: Any) -> MethodResult:
        given = problem(law, scene, velocity)
        inputs, flow = given.inputs, given.flow
        rtol = jnp.asarray(setting, inputs.gamma.dtype)
        static = None if isinstance(flow.exponent, jax.Array) else flow.exponent
        eta = flow.exponent if static is None else None

        def rates(t: Any, y: Any, args: Any) -> tuple[jax.Array, jax.Array]:
            if tally is not None:
                jax.debug.callback(tally)
            gamma, coupling, omega, restitution, eta, _ = args
            exponent = eta if static is None else static
            flow = Flow(coupling, omega, restitution, exponent)
            closing, force = time_form(flow, gamma, *y)
            return held_open(y[0], closing), force

        def at_work(t: Any, y: Any, args: Any, **_: Any) -> jax.Array:
            x, p = y
            gamma, coupling, rtol = args[0], args[1], args[-1]
            return jnp.maximum(jnp.max(x), jnp.max(-(gamma + coupling @ p))) - rtol

        found = diffrax.diffeqsolve(
            diffrax.ODETerm(rates),
            solver,
            t0=jnp.zeros_like(rtol),
            t1=jnp.full_like(rtol, jnp.inf),
            dt0=None,
            y0=(given.x, jnp.zeros_like(inputs.gamma)),
            args=(inputs.gamma, flow.coupling, flow.omega, flow.restitution, eta, rtol),
            stepsize_controller=diffrax.PIDController(rtol=rtol, atol=rtol),
            event=diffrax.Event(
                at_work,
                optx.Bisection(EVENT_TOLERANCE, EVENT_TOLERANCE, flip="detect"),
                direction=False,
            ),
            adjoint=diffrax.ForwardMode(),
            max_steps=given.max_steps,
            throw=False,
        )
        assert found.ys is not None
        assert found.ts is not None
        ended = found.result == diffrax.RESULTS.event_occurred
        steps = found.stats["num_steps"]
        evaluations = jnp.full_like(steps, UNCOUNTED) if stages is None else stages * steps + 1
        code = jnp.where(ended, CODE["ok"], CODE["max_steps"])
        return in_si(given, found.ys[1][-1], found.ts[-1], evaluations, code)

    return solve


def _method(name: str, solver: Any, stages: int | None, ladder: tuple[float, ...]) -> Method:
    label = f"diffrax {type(solver).__name__} with Event"
    counting = None if stages is not None else functools.partial(_solver, solver, None)
    solve = _solver(solver, stages)
    return Method(name, label, "rtol", ladder, True, finite_rate, solve, counting=counting)


METHODS = (
    _method("tsit5", diffrax.Tsit5(), 6, (1e-3, 1e-5, 1e-7, 1e-9)),
    _method("dopri8", diffrax.Dopri8(), 13, (1e-3, 1e-5, 1e-7, 1e-9, 1e-11)),
    _method("kvaerno5", diffrax.Kvaerno5(), None, (1e-3, 1e-5, 1e-7)),
)
