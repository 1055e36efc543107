"""`simulate`: whole motions."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp

from jimpact._checks import as_float_array, as_whole, check_kind, check_values
from jimpact.law import Law
from jimpact.laws.lzb import FINEST_RTOL_IN_EPS
from jimpact.motion.event_driven import event_driven
from jimpact.motion.flight_records import Settings
from jimpact.motion.motion_input import check_motion, friction_of, substeps_of
from jimpact.motion.record import Motion
from jimpact.motion.system import System
from jimpact.motion.time_stepping import time_stepping

CLOSED_BELOW = 1e-9  # [m] contacts with smaller gaps take part in an impact
RTOL, ATOL = 1e-10, 1e-12  # of the flights
SLOW = 1e-6  # of the largest gap velocity: what leaves slower and is pressed back stays
MAX_EVENTS, MAX_STEPS = 500, 100_000
METHODS = ("events", "time_stepping")


def simulate(
    system: System,
    law: Law,
    q0: Any,
    v0: Any,
    t_end: Any,
    *,
    t_start: Any = 0.0,
    samples: int = 201,
    method: str = "events",
    step: float | None = None,
    friction: Any = None,
    max_events: int = MAX_EVENTS,
    rtol: float = RTOL,
    atol: float = ATOL,
    closed_below: float = CLOSED_BELOW,
    slow: float = SLOW,
    max_steps: int = MAX_STEPS,
    solver: diffrax.AbstractERK | None = None,
) -> Motion:
    """The whole motion of a system: flights, impacts by `law`, persistent contact.

    Equation: between impacts that of `System`, with `0 <= lambda_n _|_ f'' >= 0` at contacts that
    are closed and at rest; at an impact `v+` of `ji.impact` in the frame of the base.

    Args:
        system: gaps, mass, forces, base.
        law: any impact law.
        q0: (n,) at the start, without penetration.
        v0: (n,).
        t_end: [s] > t_start.
        t_start: [s].
        samples: number of equally spaced instants in the record, both ends included.
        method: 'events' (flights by diffrax up to located events), or 'time_stepping'
            (Moreau-Jean, for many contacts; needs `step` [s]).
        step: of the time stepping [s].
        friction: coefficient mu of persistent contacts, scalar or (m,), for systems with a
            `tangent_function`; None: that of the law, if it has a field `friction`. Not in time
            stepping.
        max_events: rows for events; one more ends the motion with the status `max_events`.
        rtol, atol: tolerances of the flights.
        closed_below: contacts with smaller gaps [m] take part in an impact.
        slow: accumulations are passed: a contact that leaves slower than this share of the largest
            gap velocity of the motion, and would be pressed back, stays closed.
        max_steps: of the integrator, in all.
        solver: any explicit Runge-Kutta method of diffrax; default `Dopri8`.

    Returns:
        `Motion`. Pure: jit, vmap, and forward derivatives (jvp, jacfwd) in everything that is an
        array, event times included. A bad motion of a batch ends alone, with its status.

    Raises:
        ValueError: shapes, t_end <= t_start, penetration, a base or a mass that is not a number, on
            the host; inside jit only the status speaks (`raise_on_failed_motion`).

    Source: Brogliato, Nonsmooth Mechanics (2016), Remark 6.9 for the time stepping.

    >>> import jimpact as ji
    >>> motion = ji.simulate(ji.ball_system(), ji.Newton(0.8), [1.0], [0.0], 5.0, samples=21)
    >>> [round(float(t), 6) for t in motion.event_times()[:3]]
    [0.451601, 1.174162, 1.752211]
    >>> [round(float(t), 6) for t in motion.events.accumulation_end[motion.events.count - 1 :][:1]]
    [4.064407]
    """
    check_kind("system", system, System)
    check_kind("law", law, Law)
    q, v = as_float_array("q0", q0), as_float_array("v0", v0)
    dtype = jnp.result_type(q, v)
    start, end = (as_float_array(k, x) for k, x in (("t_start", t_start), ("t_end", t_end)))
    check_motion(system, q, v, start, end, closed_below)
    count = as_whole("samples", samples, 2)
    as_whole("max_events", max_events, 1)
    as_whole("max_steps", max_steps, 1)
    for name, value in (("rtol", rtol), ("atol", atol), ("closed_below", closed_below)):
        check_values(name, value, low=0.0, open_low=True)
    check_values("slow", slow, low=0.0, high=1.0)
    if method not in METHODS:
        raise ValueError(f"Argument `method` must be one of {METHODS}, but has value {method!r}.")
    if method == "events" and rtol < FINEST_RTOL_IN_EPS * float(jnp.finfo(dtype).eps):
        raise ValueError(
            f"Argument `rtol` must be at least {FINEST_RTOL_IN_EPS} roundings of {dtype}, but has "
            f"value {rtol:g}: enable jax_enable_x64, or give a coarser one."
        )
    mu = friction_of(system, law, friction, q)
    q, v, start, end = (x.astype(dtype) for x in (q, v, start, end))
    settings = Settings(
        rtol,
        atol,
        jnp.asarray(closed_below, dtype),
        max_steps,
        mu is not None,
        diffrax.Dopri8(scan_kind="lax") if solver is None else solver,
        end - start,
        jnp.asarray(slow, dtype),
    )
    if method == "time_stepping":
        substeps = substeps_of(step, t_start, t_end, count)
        closed = settings.closed_below
        return _stepped(system, law, q, v, start, end, count, substeps, closed, max_events)
    return _events(system, law, mu, settings, q, v, start, end, count, max_events)


@eqx.filter_jit
def _events(
    system: System,
    law: Law,
    mu: jax.Array | None,
    settings: Settings,
    q: jax.Array,
    v: jax.Array,
    start: jax.Array,
    end: jax.Array,
    samples: int,
    max_events: int,
) -> Motion:
    times = equal_times(start, end, samples)
    return event_driven(system, law, mu, settings, q, v, times, max_events)


@eqx.filter_jit
def _stepped(
    system: System,
    law: Law,
    q: jax.Array,
    v: jax.Array,
    start: jax.Array,
    end: jax.Array,
    samples: int,
    substeps: int,
    closed_below: jax.Array,
    max_events: int,
) -> Motion:
    times = equal_times(start, end, samples)
    return time_stepping(system, law, q, v, times, substeps, closed_below, max_events)


def equal_times(start: jax.Array, end: jax.Array, samples: int) -> jax.Array:
    """`samples` instants from start to end."""
    share = jnp.arange(samples, dtype=start.dtype) / (samples - 1)
    return start + share * (end - start)
