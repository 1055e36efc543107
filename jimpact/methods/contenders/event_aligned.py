"""jimpact's own integrator: no step straddles a change of phase (`events/stepper.py`).

Impulses come from the run that finishes an isolated contact in closed form, as `impact` does; the
duration needs that stroke integrated too, by a second run (which the compiler leaves out where
the duration is not used). Evaluations: stages of all passes, rejected ones included.
"""

import dataclasses
from typing import Any

from jimpact.events.impact_dynamics import Outcome, outcome
from jimpact.events.stepper import STAGES
from jimpact.laws.lzb import LZB
from jimpact.methods.contenders.base import Method, MethodResult, in_si, lzb_only, problem
from jimpact.scene import Scene

RTOL = (1e-3, 1e-5, 1e-7, 1e-9, 1e-11)


def _solve(law: LZB, scene: Scene, velocity: Any, setting: Any) -> MethodResult:
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
    ladder=RTOL,
    jax=True,
    supports=lzb_only,
    solve=_solve,
    duration_apart=True,
)
METHODS = (DOP853_ALIGNED,)
