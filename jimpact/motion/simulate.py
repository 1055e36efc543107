"""`simulate`: whole motions."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Shaped

from jimpact.core.law import Law
from jimpact.laws.forces import Force
from jimpact.motion.compliant_contact import (
    compliant_motion,
    force_of,
    tangential_stiffness_of,
)
from jimpact.motion.dynamics import is_pile, kinetic, potential, recorded_gaps
from jimpact.motion.event_driven import empty_checkpoint, event_driven
from jimpact.motion.flow import Settings
from jimpact.motion.methods import (
    SLOW,
    ContactForces,
    Method,
    TimeStepping,
    as_method,
    start_by,
    substeps_of,
    tolerances,
)
from jimpact.motion.record import Events, Motion, joined
from jimpact.motion.start import Start, as_times
from jimpact.motion.step_contacts import check_stepped_law
from jimpact.motion.stepping import time_stepping
from jimpact.motion.system import System
from jimpact.motion.tables import Course, MotionProblem, Past
from jimpact.tools.checks import (
    as_float_array,
    as_whole,
    check_kind,
    in_common_dtype,
    is_traced,
)
from jimpact.tools.compiling import full_precision, is_top_level_call, quick_jit
from jimpact.tools.progress import progress_bar, waiting
from jimpact.tools.status import CODE

CHUNK = 500  # events of one run of the program; more take memory in short motions
# default `max_events` on the host; more only delays the status `max_events`
MOST_EVENTS = 100_000


@full_precision
def simulate(
    system: System,
    law: Law,
    q0: Any,
    v0: Any,
    t_end: Any,
    *,
    samples: int = 201,
    method: str | Method = "events",
    step: float | None = None,
    max_events: int | None = None,
) -> Motion:
    """The whole motion of a system: flights, impacts by `law`, persistent contact.

    Equation: between impacts that of `System`, with `0 <= lambda_n _|_ f'' >= 0` at
    contacts that are closed and at rest; f are the gaps, lambda_n the normal contact
    forces. At an impact `v+` of `ji.impact` in the frame of the base. If friction
    admits no solution (Painleve paradox), a tangential impact stops the slip, provided
    that the law supports it.

    Args:
        system: gaps, mass, forces, base; its `friction` is that of persistent contacts,
            or else the law's.
        law: any impact law.
        q0: (n,) [m, rad] at the start, without penetration.
        v0: (n,) [m/s, rad/s] at the start; of bodies in space `(x', omega)`.
        t_end: [s] > 0; or the pair of times (t_start, t_end) of a motion that does not
            begin at 0.
        samples: number of equally spaced instants in the record, both ends included.
        method: 'events' (flights that land on each event), 'contact_forces' (the forces
            of a `Compliant` law act throughout: contacts take time, and may start in
            penetration), or 'time_stepping' (Moreau-Jean, for many contacts; needs
            `step`). With tolerances and other options of its own: `EventDriven`,
            `ContactForces`, `TimeStepping`.
        step: of method 'time_stepping' [s].
        max_events: largest number of recorded events; the next one ends the motion with
            status `max_events` (time stepping goes on without recording). None: 500;
            for a direct call with method 'events' (outside jit, vmap, derivatives)
            100 000, computed in runs of 500.

    Returns:
        `Motion`. Pure: jit and vmap; a bad motion of a batch ends alone, with its
        status. Methods 'events' and 'contact_forces' have derivatives in both modes
        (grad, jvp, hessian) of everything in it, event times and accumulated works
        included, in all arrays, also those captured by the system's functions. They
        hold for the order of events that occurs: one-sided where two events change
        places or a contact is grazed; NaN of what a motion does not reach.

    Raises:
        NotImplementedError: derivatives of time stepping, which do not converge with
            the step.
        ValueError: shapes, t_end <= t_start, penetration, NaN in base motion or mass,
            on the host; inside jit the status reports them (`raise_on_failure`).

    >>> import jimpact as ji
    >>> ball = ji.System(ji.Column([1.0]), gravity=True)
    >>> motion = ji.simulate(ball, ji.Newton(0.8), [1.0], [0.0], 5.0, samples=21)
    >>> [round(float(t), 6) for t in motion.event_times()[:3]]
    [0.451601, 1.174162, 1.752211]
    >>> [
    ...     round(float(t), 6)
    ...     for t in motion.events.accumulation_end[motion.events.count - 1 :][:1]
    ... ]
    [4.064407]
    """
    check_kind("system", system, System)
    check_kind("law", law, Law)
    q = as_float_array("q0", q0)
    v = as_float_array("v0", v0)
    system, law, q, v = in_common_dtype(system, law, q, v)
    method = as_method(method, step)
    start = start_by(method, system, law, q, v, t_end)
    count = as_whole("samples", samples, 2)
    if max_events is None:
        rows = CHUNK
    else:
        rows = as_whole("max_events", max_events, 1)
    arguments: Any
    if isinstance(method, TimeStepping):
        substeps = substeps_of(method, *as_times(t_end), count)
        joint = law.joins_step and system.friction is None
        check_stepped_law(system, law, start.contacts, joint)
        stepped_with = (start, law, substeps, count, joint, rows)
        return _waited(_stepped, stepped_with, method.progress)
    if isinstance(method, ContactForces):
        slow = SLOW
    else:
        slow = method.slow
    settings = Settings(
        *tolerances(method, q.dtype),
        start.closed_below,
        start.gap_rounding,
        method.max_steps,
        start.friction is not None,
        start.in_space,
        start.end - start.time,
        jnp.asarray(slow, q.dtype),
    )
    if isinstance(method, ContactForces):
        force = force_of(law)
        kappa = tangential_stiffness_of(law, start)
        arguments = start, force, kappa, settings, count, rows, method.until_apart
        return _waited(_forced, arguments, method.progress)
    if _on_host((start, law, settings)):
        if max_events is None:
            most = MOST_EVENTS
        else:
            most = max_events
        return _in_runs(start, law, settings, count, most, method.progress)
    return _events(start, law, settings, None, count, rows)[0]


def _on_host(arguments: Any) -> bool:
    """True where the motion runs at once: not within jit, vmap or derivatives."""
    return not is_traced(arguments) and is_top_level_call()


def _waited(
    run: Callable[..., Motion], arguments: Any, progress: float | None
) -> Motion:
    """The motion by one program, with a message on stderr while it runs on the host."""
    if not _on_host(arguments):
        return run(*arguments)
    with waiting("motion", progress):
        return jax.block_until_ready(run(*arguments))


def _in_runs(
    start: Start,
    law: Law,
    settings: Settings,
    samples: int,
    most: int,
    progress: float | None,
) -> Motion:
    """Motion in runs of `CHUNK` events, each of which goes on where the last one ended.

    `most`: events in all; `progress` as of `EventDriven`.
    """
    numbers: Any = empty_checkpoint(start.q, start.v, start.contacts, samples)
    parts: list[Events] = []
    duration = float(settings.duration)
    with progress_bar(progress) as show:
        show("motion", 0.0, duration)
        while True:
            left = jnp.asarray(np.int32(most - CHUNK * len(parts)))
            goes_on = Past(left, numbers)
            motion, numbers = _events(start, law, settings, goes_on, samples, CHUNK)
            parts.append(motion.events)
            too_many = CHUNK * len(parts) >= most
            if int(motion.status) != CODE["max_events"] or too_many:
                return dataclasses.replace(motion, events=joined(parts, most))
            reached = float(motion.events.time[-1] - start.time)
            show("motion", reached, duration)


@quick_jit
def _events(
    start: Start,
    law: Law,
    settings: Settings,
    past: Past | None,
    samples: int,
    max_events: int,
) -> tuple[Motion, Float[Array, " size"] | None]:
    """Motion by events, and with a `past` the numbers of the next one."""
    problem = _problem(start, law, settings, samples, past)
    course, numbers = event_driven(problem, max_events)
    return _recorded(start.system, problem.times, course), numbers


@quick_jit
def _forced(
    start: Start,
    force: Force,
    tangential_stiffness: Float[Array, " m"] | None,
    settings: Settings,
    samples: int,
    max_events: int,
    until_apart: bool,
) -> Motion:
    """Motion in which contact forces act throughout."""
    problem = _problem(start, force, settings, samples)
    problem = problem._replace(tangential_stiffness=tangential_stiffness)
    course = compliant_motion(problem, max_events, until_apart)
    return _recorded(start.system, problem.times, course)


@quick_jit
def _stepped(
    start: Start,
    law: Law,
    substeps: Int[Array, ""],
    samples: int,
    joint: bool,
    max_events: int,
) -> Motion:
    """Motion by time stepping, `substeps` between two samples."""
    times = _equal_times(start, samples)
    course = time_stepping(start, law, times, substeps, joint, max_events)
    return _recorded(start.system, times, course)


def _problem(
    start: Start,
    law: Law | Force,
    settings: Settings,
    samples: int,
    past: Past | None = None,
) -> MotionProblem:
    """Data of a motion in flights, sampled at equally spaced instants."""
    times = _equal_times(start, samples)
    system = start.system
    mu = start.friction
    begin = (start.q, start.v, times)
    return MotionProblem(system, law, mu, settings, *begin, start.contacts, past)


def _recorded(system: System, times: Float[Array, " S"], course: Course) -> Motion:
    """Record of a course: its samples, energies T and V, gaps, events and status."""
    at = course.samples
    reached = jnp.isfinite(at.t)
    over = _one_by_one if is_pile(system) else jax.vmap

    def at_samples(
        function: Callable[..., jax.Array], *args: Float[Array, "S ..."]
    ) -> Float[Array, "S ..."]:
        """Values of a function at all samples, NaN where they were not reached.

        There it is evaluated at the first sample, so that no NaN reaches derivatives of
        others.
        """

        def by_sample(values: Shaped[Array, " S"], ndim: int) -> Shaped[Array, "S ..."]:
            """Values (S,) with axes of length 1 behind, `ndim` in all."""
            return values.reshape(-1, *[1] * (ndim - 1))

        rows = (jnp.where(by_sample(reached, x.ndim), x, x[:1]) for x in args)
        values = over(function)(*rows)
        # times that were not reached are NaN, and so are their derivatives
        where = by_sample(reached, values.ndim)
        return jnp.where(where, values, by_sample(at.t, values.ndim))

    return Motion(
        time=times,
        q=at.q,
        velocity=at.v,
        kinetic_energy=at_samples(lambda q, v: kinetic(system, q, v), at.q, at.v),
        potential_energy=at_samples(lambda q: potential(system, q), at.q),
        force_work=at.work,
        base_work=at.base_work,
        contact_work=at.contact_work,
        gaps=at_samples(lambda q, t: recorded_gaps(system, q, t), at.q, times),
        events=course.events,
        steps=course.steps,
        status=course.status,
    )


def _one_by_one(function: Callable[..., jax.Array]) -> Callable[..., jax.Array]:
    """The function over rows, as `jax.vmap`, but in turn: a branch not taken costs
    nothing.
    """
    return lambda *rows: jax.lax.map(lambda row: function(*row), rows)


def _equal_times(start: Start, samples: int) -> Float[Array, " S"]:
    """Times [s] of samples equally spaced from start to end, both included."""
    index = jnp.arange(samples, dtype=start.time.dtype)
    share = index / (samples - 1)
    return start.time + share * (start.end - start.time)
