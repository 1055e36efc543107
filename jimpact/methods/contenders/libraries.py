"""The plain time form handed to diffrax and to scipy, ended by an event, as without jimpact.

Steps do not know of the changes of phase: the step-size control has to find them. The impact is
over when no contact holds or approaches by more than the tolerance; the event must be crossed
downwards, for it begins at the approach itself. Friction (scipy) is regularized below a slip of the
tolerance, over the fastest approach: what sticks is stiff.
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
    ScaledImpact,
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


class _HostField:
    """The field in NumPy at y = (x, p, p_t); friction is regularized below the slip `slow`."""

    def __init__(self, scaled: ScaledImpact, slow: float):
        inputs, flow, m = scaled.inputs, scaled.flow, len(scaled.inputs.gamma)
        arrays = (inputs.gamma, flow.omega, flow.restitution, flow.exponent)
        self.gamma, self.omega, self.e, self.eta = (np.asarray(a, float) for a in arrays)
        self.coupling, self.slow = np.asarray(as_matrix(flow.coupling), float), slow
        block = (np.zeros((m, 0)), np.zeros((0, 0)), np.zeros(0)), np.zeros(m)
        if scaled.sides is not None:
            block = jax.tree.map(np.asarray, scaled.sides)
        (self.cross, self.tangent, self.slip), self.friction = block

    @property
    def start(self) -> np.ndarray:
        """Zeros for (p, p_t)."""
        return np.zeros(len(self.gamma) + len(self.slip))

    def parts(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """x (m,), p (m,) and p_t (t,)."""
        m = len(self.gamma)
        return y[:m], y[m : 2 * m], y[2 * m :]

    def gap_velocity(self, y: np.ndarray) -> np.ndarray:
        """gamma (m,)."""
        _, p, side = self.parts(y)
        return self.gamma + self.coupling @ p + self.cross @ side

    def rates(self, y: np.ndarray) -> np.ndarray:
        """(x', p', p_t')."""
        (x, p, side), now = self.parts(y), self.gap_velocity(y)
        closing = -self.omega * np.where(now > 0, 1 / self.e**2, 1.0) * now
        closing = np.where((x <= 0) & (closing < 0), 0.0, closing)
        force = (self.eta + 1) / 2 * self.omega * np.maximum(x, 0.0) ** self.eta
        u = (self.slip + self.cross.T @ p + self.tangent @ side).reshape(len(x), -1)
        drag = self.friction * force / np.sqrt(np.sum(u**2, axis=1) + self.slow**2)
        return np.concatenate([closing, force, -(drag[:, None] * u).ravel()])


def _scipy_solver(name: str) -> Solve:
    """`solve` by one of the solvers of `scipy.integrate.solve_ivp`."""

    def solve(law: LZB, scene: Scene, velocity: Any, setting: Any) -> MethodResult:
        """The impact at this rtol."""
        from scipy.integrate import solve_ivp  # late: scipy is slow to import

        scaled = setup(law, scene, velocity, friction=True)
        m, dtype = len(scaled.inputs.gamma), scaled.inputs.gamma.dtype
        rtol = max(float(setting), FINEST)
        field = _HostField(scaled, rtol)
        start = np.concatenate([np.asarray(scaled.x, float), field.start])
        count, reached = 0, (0.0, start)

        def rates(t: float, y: np.ndarray) -> np.ndarray:
            """The field, counted."""
            nonlocal count, reached
            count, reached = count + 1, (t, y)
            if count > min(scaled.max_steps, GIVE_UP * m):
                raise _GaveUpError
            return field.rates(y)

        def at_work(_: float, y: np.ndarray) -> float:
            """Positive while a contact is loaded or approaches."""
            return max(y[:m].max(), -field.gap_velocity(y).min()) - rtol

        at_work.terminal, at_work.direction = True, -1.0  # type: ignore[attr-defined]
        options = {"method": name, "rtol": rtol, "atol": rtol, "events": at_work}
        try:
            result = solve_ivp(rates, (0.0, FOREVER), start, **options)
        except _GaveUpError:
            (t, y), code = reached, CODE["max_steps"]
        else:
            code = CODE["ok"] if result.status == 1 else CODE["max_steps"]
            t, y = result.t[-1], result.y[:, -1]
        # `nfev`, and what the solver's own differences take
        p, side, duration = (jnp.asarray(a, dtype) for a in (*field.parts(y)[1:], t))
        return in_si(scaled, p, duration, jnp.asarray(count), jnp.asarray(code), side)

    return solve


def _scipy_method(name: str, solver: str, ladder: tuple[float, ...]) -> Method:
    """The row of a solver of scipy."""
    label = f"scipy {solver} with event"
    solve = _scipy_solver(solver)
    return Method(name, label, "rtol", ladder, solve, jax=False, friction=True)


SCIPY = (
    _scipy_method("scipy_dop853", "DOP853", (1e-3, 1e-5, 1e-7, 1e-9)),
    _scipy_method("scipy_lsoda", "LSODA", (1e-3, 1e-4, 1e-5)),
    _scipy_method("scipy_radau", "Radau", (1e-3, 1e-5, 1e-7)),
)
