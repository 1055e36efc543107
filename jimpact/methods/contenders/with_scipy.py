"""The plain time form handed to scipy on the host, ended by an event. No derivatives."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from jimpact.laws.lzb import LZB
from jimpact.methods.contenders.base import Method, MethodResult, finite_rate, in_si, setup
from jimpact.scene import Scene
from jimpact.solvers.tridiagonal import as_matrix
from jimpact.status import CODE

FINEST = 100 * float(np.finfo(float).eps)  # scipy takes no smaller rtol
GIVE_UP = 5000  # evaluations a contact: LSODA may creep without end at an opening
FOREVER = 1e6  # in units of the impact's time scale: a contact alone lasts about pi


class _GaveUpError(Exception):
    """More evaluations than the law allows steps."""


def _solver(name: str) -> Callable[[LZB, Scene, Any, Any], MethodResult]:
    """`solve` by one of the solvers of `scipy.integrate.solve_ivp`."""

    def solve(law: LZB, scene: Scene, velocity: Any, setting: Any) -> MethodResult:
        from scipy.integrate import solve_ivp  # late: scipy is slow to import

        given = setup(law, scene, velocity)
        inputs, flow = given.inputs, given.flow
        gamma, omega, e = (
            np.asarray(a, float)
            for a in (
                inputs.gamma,
                flow.omega,
                jnp.broadcast_to(inputs.restitution, inputs.gamma.shape),
            )
        )
        coupling = np.asarray(as_matrix(flow.coupling), float)
        eta = np.asarray(flow.exponent, float)
        m = len(gamma)
        rtol = max(float(setting), FINEST)

        count, reached = 0, (0.0, np.zeros(2 * m))

        def rates(t: float, y: np.ndarray) -> np.ndarray:
            nonlocal count, reached
            count, reached = count + 1, (t, y)
            if count > min(given.max_steps, GIVE_UP * m):
                raise _GaveUpError
            x, now = y[:m], gamma + coupling @ y[m:]
            closing = -omega * np.where(now > 0, 1 / e**2, 1.0) * now
            closing = np.where((x <= 0) & (closing < 0), 0.0, closing)
            return np.concatenate([closing, (eta + 1) / 2 * omega * np.maximum(x, 0.0) ** eta])

        def at_work(_: float, y: np.ndarray) -> float:
            return max(y[:m].max(), -(gamma + coupling @ y[m:]).min()) - rtol

        at_work.terminal, at_work.direction = True, -1.0  # type: ignore[attr-defined]
        start = np.concatenate([np.asarray(given.x, float), np.zeros(m)])
        options = {"method": name, "rtol": rtol, "atol": rtol, "events": at_work}
        try:
            found = solve_ivp(rates, (0.0, FOREVER), start, **options)
        except _GaveUpError:
            p, t, code = reached[1][m:], reached[0], CODE["max_steps"]
        else:
            code = CODE["ok"] if found.status == 1 else CODE["max_steps"]
            p, t = found.y[m:, -1], found.t[-1]
        dtype = inputs.gamma.dtype
        # `nfev`, and what LSODA's own differences take
        return in_si(
            given,
            jnp.asarray(p, dtype),
            jnp.asarray(t, dtype),
            jnp.asarray(count),
            jnp.asarray(code),
        )

    return solve


def _method(name: str, solver: str, ladder: tuple[float, ...]) -> Method:
    return Method(
        name,
        f"scipy {solver} with event",
        "rtol",
        ladder,
        False,
        finite_rate,
        _solver(solver),
        no_gradient="host code: finite differences only",
    )


METHODS = (
    _method("scipy_dop853", "DOP853", (1e-3, 1e-5, 1e-7, 1e-9)),
    _method("scipy_lsoda", "LSODA", (1e-3, 1e-4, 1e-5)),
)
