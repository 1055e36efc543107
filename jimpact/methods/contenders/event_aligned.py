"""jimpact's own integrator: no step straddles a change of phase (`events/stepper.py`).

Impulses come from the run that finishes an isolated contact in closed form, as `impact` does; the
duration needs that stroke integrated too, by a second run (which the compiler leaves out where
the duration is not used). Evaluations: stages of all passes, rejected ones included.
"""

import dataclasses
from typing import Any

import jax

from jimpact.events import stepper
from jimpact.events.batches import in_columns
from jimpact.events.impact_dynamics import Outcome, flow_of, outcome
from jimpact.laws.lzb import LZB
from jimpact.methods.contenders.base import Method, MethodResult, in_si, lzb_only, problem
from jimpact.scene import Scene

EVALUATIONS = stepper.STAGES + 1  # of the field a pass: the stages, and the end of the step


@dataclasses.dataclass(frozen=True)
class _Duration:
    """From the leaves of a problem in columns to the duration (1, B), in units of the impact."""

    tree: Any
    exponent: float | tuple[float, ...] | None
    chain: bool
    most: int

    def __call__(self, *leaves: jax.Array) -> tuple[jax.Array]:
        problem = jax.tree.unflatten(self.tree, leaves)
        flow, modes, y = flow_of(problem, self.exponent, self.chain)
        flow = dataclasses.replace(flow, closed_form=False)
        return (stepper.run(flow, modes, y, self.most).y[-1:],)


def _solve(law: LZB, scene: Scene, velocity: Any, setting: Any) -> MethodResult:
    given = problem(law, scene, velocity, setting)
    static = None if isinstance(given.exponent, jax.Array) else given.exponent
    leaves, tree = jax.tree.flatten(given.inputs)
    columns = tuple(leaf[..., None] for leaf in leaves)
    shape = (tree, static, given.chain, given.max_steps)
    p, _, code, passes = outcome(Outcome(*shape), columns)
    (duration,) = in_columns(_Duration(*shape), *jax.lax.stop_gradient(columns))
    return in_si(given, p[:, 0], duration[0, 0], EVALUATIONS * passes[0, 0], code[0, 0])


DOP853_ALIGNED = Method(
    name="dop853",
    label="event-aligned Dormand-Prince 8 (default)",
    setting="rtol",
    ladder=(1e-3, 1e-5, 1e-7, 1e-9, 1e-11),
    jax=True,
    supports=lzb_only,
    solve=_solve,
    duration_apart=True,
)
