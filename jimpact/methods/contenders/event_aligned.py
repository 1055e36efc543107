"""jimpact's own integrator: no step straddles a change of phase (`numerics/stepper.py`).

Impulses come from the run that finishes an isolated contact in closed form, as `impact` does; the
duration needs that stroke integrated too, by a second run (which the compiler leaves out where
the duration is not used). Evaluations: stages of all passes, rejected ones included.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax

from jimpact.events.tableaux import DOP853, DOPRI5
from jimpact.law import Law, StaticNumber
from jimpact.laws.lzb import LZB
from jimpact.methods.contenders.base import Method, MethodResult, in_si, lzb_only, problem
from jimpact.numerics import stepper, windows
from jimpact.numerics.dimensionless import (
    Inputs,
    control_of,
    flow_of,
    indentation,
    settled,
    status_of,
)
from jimpact.numerics.flow import step
from jimpact.numerics.propagator import TERMS
from jimpact.numerics.sensitivity import both_modes
from jimpact.scene import Scene

_DOPRI5_STEP = functools.partial(step, tableau=DOPRI5)
RTOL = (1e-3, 1e-5, 1e-7, 1e-9, 1e-11)


def _solver(
    name: str, evaluations: int, **options: Any
) -> Callable[[LZB, Scene, Any, Any], MethodResult]:
    """`solve` of LZB's own method `name`: so many field evaluations a pass; `stepper.Control`'s."""

    def solve(law: LZB, scene: Scene, velocity: Any, setting: Any) -> MethodResult:
        given = problem(law, scene, velocity, setting)
        static = None if isinstance(given.exponent, jax.Array) else given.exponent

        def run(inputs: Inputs, differentiated: bool) -> tuple[Any, Any]:
            flow = flow_of(inputs, static, given.chain)  # type: ignore[arg-type]
            control = control_of(inputs, given.max_steps, name, differentiated)._replace(**options)
            x = indentation(inputs, flow.exponent)
            start = stepper.begin(flow, control, inputs.gamma, x)
            end = windows.run(flow, control, start)
            whole = control._replace(closed_form=False)
            last = windows.run(flow, whole, stepper.begin(flow, whole, inputs.gamma, x))
            p, at_rest = settled(flow, inputs.gamma, inputs.tolerance, end)
            return (p, last.state.t[0]), (status_of(end, at_rest), end.passes[0])

        (p, t), (code, passes) = both_modes(run)(given.inputs)
        return in_si(given, p, t, evaluations * passes, code)

    return solve


def _linear_only(law: Law, scene: Scene) -> str | None:
    reason = lzb_only(law, scene)
    if reason is None and isinstance(law, LZB) and law.exponent != StaticNumber(1.0):
        return "it is exact for the exponent 1.0 (a number, not an array) only"
    return reason


DOP853_ALIGNED = Method(
    name="dop853",
    label="event-aligned Dormand-Prince 8 (default)",
    setting="rtol",
    ladder=RTOL,
    jax=True,
    supports=lzb_only,
    solve=_solver("time", len(DOP853.c)),
    duration_apart=True,
)
DOPRI5_ALIGNED = Method(
    name="dop5",
    label="event-aligned Dormand-Prince 5",
    setting="rtol",
    ladder=RTOL,
    jax=True,
    supports=lzb_only,
    solve=_solver("time", len(DOPRI5.c), step=_DOPRI5_STEP, order=DOPRI5.order),
    duration_apart=True,
)
PROPAGATOR = Method(
    name="propagator",
    label="exact propagator",
    setting="rtol",
    ladder=(1e-3, 1e-7, 1e-11),
    jax=True,
    supports=_linear_only,
    # a Taylor term applies the field twice: once from either side of x = 0
    solve=_solver("propagator", 2 * (TERMS - 1)),
    duration_apart=True,
)
METHODS = (DOP853_ALIGNED, DOPRI5_ALIGNED, PROPAGATOR)
