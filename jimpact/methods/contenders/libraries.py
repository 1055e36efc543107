"""The plain time form handed to diffrax and to scipy, ended by an event, as without jimpact.

Steps do not know of the changes of phase: the step-size control has to find them. The impact is
over when no contact holds or approaches by more than the tolerance; the event must be crossed
downwards, for it begins at the approach itself.
"""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from jimpact.laws.lzb import LZB
from jimpact.methods.contenders.base import (
    UNCOUNTED,
    Method,
    MethodResult,
    Solve,
    in_si,
    problem,
    setup,
    time_form,
)
from jimpact.scene import Scene
from jimpact.solvers.tridiagonal import as_matrix
from jimpact.status import CODE

EVENT_TOLERANCE = 1e-10  # of the root finder, in units of the impact's time scale

FINEST = 100 * float(np.finfo(float).eps)  # scipy takes no smaller rtol
GIVE_UP = 5000  # evaluations a contact: LSODA may creep without end at an opening
FOREVER = 1e6  # in units of the impact's time scale: a contact alone lasts about pi


def _diffrax_solver(solver: diffrax.AbstractSolver, stages: int | None) -> Solve:
    """`solve` by a diffrax solver; `stages`: new ones a step (None: not known beforehand)."""

    def solve(law: LZB, scene: Scene, velocity: Any, setting: Any) -> MethodResult:
        """The impact at this rtol."""
        scaled = problem(law, scene, velocity)
        inputs = scaled.inputs
        rtol = jnp.asarray(setting, inputs.gamma.dtype)

        def rates(t: Any, y: Any, args: Any) -> tuple[jax.Array, jax.Array]:
            """(x', p') at y = (x, p)."""
            flow, gamma, _ = args
            closing, force = time_form(flow, gamma, *y)
            # diffrax cannot clamp: an open contact stays at its x <= 0
            return jnp.where((y[0] <= 0) & (closing < 0), 0.0, closing), force

        def at_work(t: Any, y: Any, args: Any, **_: Any) -> jax.Array:
            """Positive while a contact is loaded or approaches."""
            (flow, gamma, rtol), (x, p) = args, y
            return jnp.maximum(jnp.max(x), jnp.max(-(gamma + flow.coupling @ p))) - rtol

        result = diffrax.diffeqsolve(
            diffrax.ODETerm(rates),
            solver,
            t0=jnp.zeros_like(rtol),
            t1=jnp.full_like(rtol, jnp.inf),
            dt0=None,
            y0=(scaled.x, jnp.zeros_like(inputs.gamma)),
            args=(scaled.flow, inputs.gamma, rtol),
            stepsize_controller=diffrax.PIDController(rtol=rtol, atol=rtol),
            event=diffrax.Event(
                at_work,
                optx.Bisection(EVENT_TOLERANCE, EVENT_TOLERANCE, flip="detect"),
                direction=False,
            ),
            adjoint=diffrax.ForwardMode(),
            max_steps=scaled.max_steps,
            throw=False,
        )
        assert result.ys is not None
        assert result.ts is not None
        ended = result.result == diffrax.RESULTS.event_occurred
        steps = result.stats["num_steps"]
        evaluations = jnp.full_like(steps, UNCOUNTED) if stages is None else stages * steps + 1
        code = jnp.where(ended, CODE["ok"], CODE["max_steps"])
        return in_si(scaled, result.ys[1][-1], result.ts[-1], evaluations, code)

    return solve


def _diffrax_method(
    name: str, solver: Any, stages: int | None, ladder: tuple[float, ...]
) -> Method:
    """The row of a diffrax solver."""
    label = f"diffrax {type(solver).__name__} with Event"
    return Method(name, label, "rtol", ladder, _diffrax_solver(solver, stages))


DIFFRAX = (
    _diffrax_method("tsit5", diffrax.Tsit5(), 6, (1e-3, 1e-5, 1e-7, 1e-9)),
    _diffrax_method("dopri8", diffrax.Dopri8(), 13, (1e-3, 1e-5, 1e-7, 1e-9, 1e-11)),
    _diffrax_method("kvaerno5", diffrax.Kvaerno5(), None, (1e-3, 1e-5, 1e-7)),
)


class _GaveUpError(Exception):
    """There were more evaluations than the law allows steps."""


def _scipy_solver(name: str) -> Solve:
    """`solve` by one of the solvers of `scipy.integrate.solve_ivp`."""

    def solve(law: LZB, scene: Scene, velocity: Any, setting: Any) -> MethodResult:
        """The impact at this rtol."""
        from scipy.integrate import solve_ivp  # late: scipy is slow to import

        scaled = setup(law, scene, velocity)
        inputs, flow = scaled.inputs, scaled.flow
        gamma, omega, e = (
            np.asarray(a, float) for a in (inputs.gamma, flow.omega, flow.restitution)
        )
        coupling = np.asarray(as_matrix(flow.coupling), float)
        eta = np.asarray(flow.exponent, float)
        m = len(gamma)
        rtol = max(float(setting), FINEST)

        count, reached = 0, (0.0, np.zeros(2 * m))

        def rates(t: float, y: np.ndarray) -> np.ndarray:
            """(x', p') (2 m,) at y = (x, p)."""
            nonlocal count, reached
            count, reached = count + 1, (t, y)
            if count > min(scaled.max_steps, GIVE_UP * m):
                raise _GaveUpError
            x, now = y[:m], gamma + coupling @ y[m:]
            closing = -omega * np.where(now > 0, 1 / e**2, 1.0) * now
            closing = np.where((x <= 0) & (closing < 0), 0.0, closing)
            return np.concatenate([closing, (eta + 1) / 2 * omega * np.maximum(x, 0.0) ** eta])

        def at_work(_: float, y: np.ndarray) -> float:
            """Positive while a contact is loaded or approaches."""
            return max(y[:m].max(), -(gamma + coupling @ y[m:]).min()) - rtol

        at_work.terminal, at_work.direction = True, -1.0  # type: ignore[attr-defined]
        start = np.concatenate([np.asarray(scaled.x, float), np.zeros(m)])
        options = {"method": name, "rtol": rtol, "atol": rtol, "events": at_work}
        try:
            result = solve_ivp(rates, (0.0, FOREVER), start, **options)
        except _GaveUpError:
            p, t, code = reached[1][m:], reached[0], CODE["max_steps"]
        else:
            code = CODE["ok"] if result.status == 1 else CODE["max_steps"]
            p, t = result.y[m:, -1], result.t[-1]
        # `nfev`, and what LSODA's own differences take
        impulse, duration = (jnp.asarray(x, inputs.gamma.dtype) for x in (p, t))
        return in_si(scaled, impulse, duration, jnp.asarray(count), jnp.asarray(code))

    return solve


def _scipy_method(name: str, solver: str, ladder: tuple[float, ...]) -> Method:
    """The row of a solver of scipy."""
    label = f"scipy {solver} with event"
    return Method(name, label, "rtol", ladder, _scipy_solver(solver), jax=False)


SCIPY = (
    _scipy_method("scipy_dop853", "DOP853", (1e-3, 1e-5, 1e-7, 1e-9)),
    _scipy_method("scipy_lsoda", "LSODA", (1e-3, 1e-4, 1e-5)),
)
