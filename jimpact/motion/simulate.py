"""`simulate`: whole motions."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import (
    as_float_array,
    as_whole,
    check_choice,
    check_kind,
    check_values,
    in_common_dtype,
    is_traced,
)
from jimpact.bodies.base import check_penetration
from jimpact.compiling import full_precision, is_top_level_call, quick_jit
from jimpact.law import Law
from jimpact.laws.forces import Force
from jimpact.motion.arguments import (
    check_motion,
    check_pile,
    check_stepped_law,
    contacts_of,
    force_of,
    friction_in_space,
    friction_of,
    substeps_of,
    without_closures,
)
from jimpact.motion.compliant_contact import compliant_motion
from jimpact.motion.dynamics import is_pile, kinetic, potential, recorded_gaps
from jimpact.motion.event_driven import empty_checkpoint, event_driven
from jimpact.motion.flow import Settings, check_rtol
from jimpact.motion.record import Events, Motion, joined
from jimpact.motion.stepping import time_stepping
from jimpact.motion.system import System
from jimpact.motion.tables import Course, MotionProblem, Past
from jimpact.progress import progress_bar, waiting
from jimpact.status import CODE

# [m] Contacts with smaller gaps take part in an impact. Ten times more, and balls a few nanometres
# apart are struck together.
CLOSED_BELOW = 1e-9
ROUNDING_GAP = 1e-5  # of the gap that counts as closed: smaller gaps are rounding, hops as well
# Roundings that a gap may be off by, of the largest coordinate or gap at the start; what counts as
# closed is MORE_CLOSED times more. In metres and double precision neither of them matters.
GAP_ROUNDINGS, MORE_CLOSED = 8, 10
TOLERANCES = {"float64": (1e-10, 1e-12), "float32": (1e-5, 1e-7)}  # rtol, atol of the flights
# Share of the largest gap velocity: a slower contact that is pressed back remains closed. Ten times
# more passes an accumulation a few impacts earlier, and loses a hundred times the energy there.
SLOW = 1e-6
MAX_STEPS = 100_000  # of the flights by default; ten times more only delays the status `max_steps`
CHUNK = 500  # events of one run of the program; more take memory in short motions
MOST_EVENTS = 100_000  # default `max_events` on the host; more only delays the status `max_events`
METHODS = ("events", "time_stepping", "contact_forces")


@full_precision
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
    max_events: int | None = None,
    rtol: float | None = None,
    atol: float | None = None,
    closed_below: float | None = None,
    slow: float = SLOW,
    max_steps: int = MAX_STEPS,
    until_apart: bool = False,
    progress: float | None = None,
) -> Motion:
    """The whole motion of a system: flights, impacts by `law`, persistent contact.

    Equation: between impacts that of `System`, with `0 <= lambda_n _|_ f'' >= 0` at contacts that
    are closed and at rest; f are the gaps, lambda_n the normal contact forces. At an impact `v+` of
    `ji.impact` in the frame of the base. If friction admits no solution (Painleve paradox), a
    tangential impact stops the slip, provided that the law supports it.

    Args:
        system: gaps, mass, forces, base.
        law: any impact law.
        q0: (n,) [m, rad] at the start, without penetration.
        v0: (n,) [m/s, rad/s] at the start; of bodies in space `(x', omega)`.
        t_end: [s] > t_start.
        t_start: [s].
        samples: number of equally spaced instants in the record, both ends included.
        method: 'events' (flights that land on each event), or 'time_stepping'
            (Moreau-Jean, for many contacts; needs `step` [s]), or 'contact_forces' (the forces of
            a `Compliant` law act throughout: contacts take time, and may start in penetration).
        step: of the time stepping [s].
        friction: coefficient mu of persistent contacts, scalar or (m,), for systems with a
            `tangent_function` and for bodies with tangents, in the plane or in space; None: that
            of the law, if it has a field `friction`.
        max_events: largest number of recorded events; the next one ends the motion with status
            `max_events` (time stepping goes on without recording). None: 500; for a direct call
            with method 'events' (outside jit, vmap, derivatives) 100 000, computed in runs of 500.
        rtol: relative tolerance of the flights; None: 1e-10, in single precision 1e-5.
        atol: absolute one [m, m/s, rad, ..]; None: 1e-12, in single precision 1e-7.
        closed_below: contacts with smaller gaps [m] take part in an impact; None: 1e-9, or 80
            roundings of the largest coordinate or gap at the start, if that is more.
        slow: repeated impacts with decreasing speed (accumulations) are cut short: a contact that
            leaves slower than this share of the largest gap velocity so far, and would be pressed
            back, remains closed. For contacts that share a body the limit is `sqrt(slow)`
            (docs/motions_reference.md). `events` estimates the skipped time.
        max_steps: total integrator steps.
        until_apart: by contact forces, end where all contacts are open and none closes, with status
            `ok`: an impact whose geometry turns. Its outcome is that of the last event.
        progress: bar on stderr with the share of the duration that is done, after each run; None:
            on a terminal, for long motions.

    Returns:
        `Motion`. Pure: jit and vmap; a bad motion of a batch ends alone, with its status.
        Methods 'events' and 'contact_forces' have derivatives in both modes (grad, jvp, hessian)
        of everything in it, event times and accumulated works included, in all arrays, also those
        captured by the system's functions. They hold for the order of events that occurs:
        one-sided where two events change places or a contact is grazed; NaN of what a motion does
        not reach.

    Raises:
        NotImplementedError: derivatives of time stepping, which do not converge with the step.
        ValueError: shapes, t_end <= t_start, penetration, NaN in base motion or mass, on the
            host; inside jit the status reports them (`raise_on_failure`).

    Source: Brogliato, Nonsmooth Mechanics (2016), Remark 6.9 for the time stepping.

    >>> import jimpact as ji
    >>> ball = ji.System(ji.Column([1.0]), gravity=True)
    >>> motion = ji.simulate(ball, ji.Newton(0.8), [1.0], [0.0], 5.0, samples=21)
    >>> [round(float(t), 6) for t in motion.event_times()[:3]]
    [0.451601, 1.174162, 1.752211]
    >>> [round(float(t), 6) for t in motion.events.accumulation_end[motion.events.count - 1 :][:1]]
    [4.064407]
    """
    check_kind("system", system, System)
    check_kind("law", law, Law)
    q, v = as_float_array("q0", q0), as_float_array("v0", v0)
    system, law, q, v = in_common_dtype(system, law, q, v)
    dtype = q.dtype
    start = as_float_array("t_start", t_start).astype(dtype)
    end = as_float_array("t_end", t_end).astype(dtype)
    f = check_motion(system, q, v, start, end)
    count = as_whole("samples", samples, 2)
    rows = CHUNK if max_events is None else as_whole("max_events", max_events, 1)
    _check_options(method, until_apart, slow, max_steps)
    rtol, atol = _tolerances(method, dtype, rtol, atol)
    mu = friction_of(system, law, friction, q)
    check_pile(system, q, mu, method)
    system = without_closures(system, q, v, start)
    below, rounding = closed_gaps(q, f, closed_below)
    if method != "contact_forces":
        check_penetration("q0", f, jnp.maximum(below, system.body.overlap))
    share = jnp.asarray(slow, dtype)
    settings = Settings(
        rtol, atol, below, rounding, max_steps, mu is not None, friction_in_space(system, mu, q),
        end - start, share,
    )  # fmt: skip
    arguments: Any
    if method == "time_stepping":
        substeps = substeps_of(step, t_start, t_end, count)
        joint = law.joins_step and friction is None
        check_stepped_law(system, law, q, joint)
        arguments = system, law, mu, q, v, start, end, below, substeps, count, joint, rows
        return _waited(_stepped, arguments, progress)
    if method == "contact_forces":
        force = force_of(law)
        arguments = system, force, mu, settings, q, v, start, end, count, rows, until_apart
        return _waited(_forced, arguments, progress)
    arguments = system, law, mu, settings, q, v, start, end
    if _on_host(arguments):
        most = MOST_EVENTS if max_events is None else max_events
        return _in_runs(arguments, count, most, progress)
    return _events(*(*arguments, None, count, rows))[0]


def _check_options(method: str, until_apart: bool, slow: float, max_steps: int) -> None:
    """Raise a ValueError for options that a motion does not have."""
    as_whole("max_steps", max_steps, 1)
    check_values("slow", slow, low=0.0, high=1.0)
    check_choice("method", method, METHODS)
    if until_apart and method != "contact_forces":
        raise ValueError(
            "Argument `until_apart` must be False for motions by other methods than "
            f"'contact_forces', but `method` has value {method!r}."
        )


def _tolerances(
    method: str, dtype: jnp.dtype, rtol: float | None, atol: float | None
) -> tuple[float, float]:
    """Relative and absolute tolerance of the flights, those of the precision by default."""
    check_values("rtol", rtol, low=0.0, open_low=True)
    check_values("atol", atol, low=0.0, open_low=True)
    default = TOLERANCES.get(str(dtype), TOLERANCES["float32"])
    rtol, atol = default[0] if rtol is None else rtol, default[1] if atol is None else atol
    if method == "events":
        check_rtol(rtol, dtype)
    return rtol, atol


def closed_gaps(
    q: jax.Array, f: jax.Array, closed_below: float | None
) -> tuple[jax.Array, jax.Array]:
    """Gaps () [m] below which a contact is closed, and below which a gap is rounding."""
    check_values("closed_below", closed_below, low=0.0, open_low=True)
    size = jax.lax.stop_gradient(jnp.maximum(jnp.abs(q).max(), jnp.abs(f).max()))
    off = GAP_ROUNDINGS * float(jnp.finfo(q.dtype).eps) * size
    default = jnp.maximum(CLOSED_BELOW, MORE_CLOSED * off)
    below = default if closed_below is None else jnp.asarray(closed_below, q.dtype)
    return below.astype(q.dtype), jnp.maximum(ROUNDING_GAP * below, off).astype(q.dtype)


def _on_host(arguments: Any) -> bool:
    """Whether the motion runs at once: not within jit, vmap or derivatives."""
    return not is_traced(arguments) and is_top_level_call()


def _waited(run: Callable[..., Motion], arguments: Any, progress: float | None) -> Motion:
    """The motion by one program, with a message on stderr while it runs on the host."""
    if not _on_host(arguments):
        return run(*arguments)
    with waiting("motion", progress):
        return jax.block_until_ready(run(*arguments))


def _in_runs(arguments: tuple[Any, ...], samples: int, most: int, progress: float | None) -> Motion:
    """The motion in runs of `CHUNK` events, each of which goes on where the last one ended."""
    system, *_, q, v, start, end = arguments
    numbers: Any = empty_checkpoint(q, v, contacts_of(system, q), samples)
    parts: list[Events] = []
    with progress_bar(progress) as show:
        show("motion", 0.0, float(end - start))
        while True:
            left = jnp.asarray(np.int32(most - CHUNK * len(parts)))
            motion, numbers = _events(*(*arguments, Past(left, numbers), samples, CHUNK))
            parts.append(motion.events)
            if int(motion.status) != CODE["max_events"] or CHUNK * len(parts) >= most:
                return dataclasses.replace(motion, events=joined(parts, most))
            show("motion", float(motion.events.time[-1] - start), float(end - start))


@quick_jit
def _events(
    system: System,
    law: Law,
    mu: jax.Array | None,
    settings: Settings,
    q: jax.Array,
    v: jax.Array,
    start: jax.Array,
    end: jax.Array,
    past: Past | None,
    samples: int,
    max_events: int,
) -> tuple[Motion, jax.Array | None]:
    """The motion by events, and what the next run takes over."""
    times = _equal_times(start, end, samples)
    problem = MotionProblem(system, law, mu, settings, q, v, times, contacts_of(system, q), past)
    course, numbers = event_driven(problem, max_events)
    return _recorded(system, times, course), numbers


@quick_jit
def _forced(
    system: System,
    force: Force,
    mu: jax.Array | None,
    settings: Settings,
    q: jax.Array,
    v: jax.Array,
    start: jax.Array,
    end: jax.Array,
    samples: int,
    max_events: int,
    until_apart: bool,
) -> Motion:
    """The motion with contact forces."""
    times = _equal_times(start, end, samples)
    m = contacts_of(system, q)
    problem = MotionProblem(system, force, mu, settings, q, v, times, m)
    course = compliant_motion(problem, max_events, until_apart)
    return _recorded(system, times, course)


@quick_jit
def _stepped(
    system: System,
    law: Law,
    mu: jax.Array | None,
    q: jax.Array,
    v: jax.Array,
    start: jax.Array,
    end: jax.Array,
    closed_below: jax.Array,
    substeps: jax.Array,
    samples: int,
    joint: bool,
    max_events: int,
) -> Motion:
    """The motion by time stepping."""
    times = _equal_times(start, end, samples)
    course = time_stepping(system, law, mu, q, v, times, closed_below, substeps, joint, max_events)
    return _recorded(system, times, course)


def _recorded(system: System, times: jax.Array, course: Course) -> Motion:
    """The record of a course, with its energies and gaps."""
    at = course.samples
    reached = jnp.isfinite(at.t)
    over = _one_by_one if is_pile(system) else jax.vmap

    def sampled(function: Callable[..., jax.Array], *args: jax.Array) -> jax.Array:
        """A function of the samples; a NaN does not reach the derivatives of other samples."""
        rows = (jnp.where(reached.reshape(-1, *[1] * (x.ndim - 1)), x, x[:1]) for x in args)
        values = over(function)(*rows)
        each = (-1, *[1] * (values.ndim - 1))
        # times that were not reached are NaN, and so are their derivatives
        return jnp.where(reached.reshape(each), values, at.t.reshape(each))

    return Motion(
        time=times,
        q=at.q,
        velocity=at.v,
        kinetic_energy=sampled(lambda q, v: kinetic(system, q, v), at.q, at.v),
        potential_energy=sampled(lambda q: potential(system, q), at.q),
        force_work=at.work,
        base_work=at.base_work,
        contact_work=at.contact_work,
        gaps=sampled(lambda q, t: recorded_gaps(system, q, t), at.q, times),
        events=course.events,
        steps=course.steps,
        status=course.status,
    )


def _one_by_one(function: Callable[..., jax.Array]) -> Callable[..., jax.Array]:
    """As `jax.vmap`, in turn: branches that one sample does not take cost nothing."""
    return lambda *rows: jax.lax.map(lambda row: function(*row), rows)


def _equal_times(start: jax.Array, end: jax.Array, samples: int) -> jax.Array:
    """`samples` instants from start to end."""
    share = jnp.arange(samples, dtype=start.dtype) / (samples - 1)
    return start + share * (end - start)
