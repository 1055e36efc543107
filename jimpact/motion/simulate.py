"""`simulate`: whole motions."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import (
    as_float_array,
    as_whole,
    check_kind,
    check_per_contact,
    check_shape,
    check_values,
    in_common_dtype,
    is_traced,
)
from jimpact.compiling import is_top_level_call, quick_jit
from jimpact.law import Law
from jimpact.laws.compliant import Compliant
from jimpact.laws.forces import Force
from jimpact.laws.lzb import FINEST_RTOL_IN_EPS
from jimpact.motion.compliant_contact import compliant_motion
from jimpact.motion.dynamics import gaps, kinetic, mass_at, potential, seen_from_base
from jimpact.motion.event_driven import Given, Past, event_driven, no_past
from jimpact.motion.flow import Course, Settings
from jimpact.motion.record import MOTION_CODE, Events, Motion, joined
from jimpact.motion.stepping import is_pile, joins_step, recorded_gaps, time_stepping
from jimpact.motion.system import System
from jimpact.progress import progress_bar, waiting
from jimpact.scene import check_mass

CLOSED_BELOW = 1e-9  # [m] contacts with smaller gaps take part in an impact
ROUNDING_GAP = 1e-5  # of the gap that counts as closed: below it a gap is rounding
# Roundings that a gap may be off by, of the largest coordinate or gap at the start; what counts as
# closed is so many times more. In metres and double precision neither of them matters.
GAP_ROUNDINGS, MORE_CLOSED = 8, 10
TOLERANCES = {"float64": (1e-10, 1e-12), "float32": (1e-5, 1e-7)}  # rtol, atol of the flights
SLOW = 1e-6  # of the largest gap velocity: what leaves slower and is pressed back stays
MAX_STEPS = 100_000
CHUNK = 500  # events of one run of the program
MOST_EVENTS = 100_000  # that a motion has on the host where nothing is said
METHODS = ("events", "time_stepping", "contact_forces")
MOST_STEPS = np.iinfo(np.int32).max  # they are counted in 32 bits
_BASE_LOOKS = 64  # times at which the base is looked at before the motion starts


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
    progress: float | None = None,
) -> Motion:
    """The whole motion of a system: flights, impacts by `law`, persistent contact.

    Equation: between impacts that of `System`, with `0 <= lambda_n _|_ f'' >= 0` at contacts that
    are closed and at rest; at an impact `v+` of `ji.impact` in the frame of the base. Where
    friction leaves no such lambda, an impact without collision stops the slip, if the law has one.

    Args:
        system: gaps, mass, forces, base.
        law: any impact law.
        q0: (n,) at the start, without penetration.
        v0: (n,); of bodies in space `(x', omega)`.
        t_end: [s] > t_start.
        t_start: [s].
        samples: number of equally spaced instants in the record, both ends included.
        method: 'events' (flights that land on each event), or 'time_stepping'
            (Moreau-Jean, for many contacts; needs `step` [s]), or 'contact_forces' (the forces of
            a `Compliant` law act throughout: contacts take time, and may start in penetration).
        step: of the time stepping [s].
        friction: coefficient mu of persistent contacts, scalar or (m,), for systems with a
            `tangent_function`, in time stepping with any tangents; None: that of the law, if it
            has a field `friction`.
        max_events: one more ends the motion with the status `max_events` (in time stepping it is
            not written). None: 500; with method 'events' outside jit, vmap and derivatives 100 000,
            found by the program for 500 in as many runs as needed.
        rtol: relative tolerance of the flights; None: 1e-10, in single precision 1e-5.
        atol: absolute one [m, m/s, rad, ..]; None: 1e-12, in single precision 1e-7.
        closed_below: contacts with smaller gaps [m] take part in an impact; None: 1e-9, or 80
            roundings of the largest coordinate or gap at the start, if that is more.
        slow: accumulations are passed: a contact that leaves slower than this share of the largest
            gap velocity of the motion, and would be pressed back, stays closed; contacts that share
            bodies below the root of that share (docs/motions.md). `events` tells what is passed.
        max_steps: of the integrator, in all.
        progress: bar on stderr, after each of those runs with the share of the duration that is
            done; None: on a terminal, for long motions.

    Returns:
        `Motion`. Pure: jit and vmap; a bad motion of a batch ends alone, with its status.
        Method 'events' has derivatives in both modes (grad, jvp, hessian) of everything in it,
        event times and ledger included, in everything that is an array, and in what functions of
        the system close over. They are those of the order of events that occurs, one-sided where
        two events change places or a contact is only grazed; NaN for motions of more steps than
        samples + 16 `max_events` + 1024. Method 'contact_forces' has forward ones (jvp, jacfwd).

    Raises:
        NotImplementedError: derivatives of time stepping, which do not converge with the step.
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
    start, end = (as_float_array(k, x) for k, x in (("t_start", t_start), ("t_end", t_end)))
    system, law, q, v = in_common_dtype(system, law, q, v)
    dtype = q.dtype
    start, end = start.astype(dtype), end.astype(dtype)
    f = _check_motion(system, q, v, start, end)
    count = as_whole("samples", samples, 2)
    if max_events is not None:
        as_whole("max_events", max_events, 1)
    rows = CHUNK if max_events is None else max_events
    as_whole("max_steps", max_steps, 1)
    usual = TOLERANCES.get(str(dtype), TOLERANCES["float32"])
    rtol, atol = usual[0] if rtol is None else rtol, usual[1] if atol is None else atol
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
    mu = _friction_of(system, law, friction, q, in_space=method == "time_stepping")
    system = _opened(system, q, v, start)
    size = jax.lax.stop_gradient(jnp.maximum(jnp.abs(q).max(), jnp.abs(f).max()))
    off = GAP_ROUNDINGS * float(jnp.finfo(dtype).eps) * size
    default = jnp.maximum(CLOSED_BELOW, MORE_CLOSED * off)
    below = default if closed_below is None else jnp.asarray(closed_below, dtype)
    if method != "contact_forces":
        _check_penetration(f, below)
    settings = Settings(
        rtol,
        atol,
        below.astype(dtype),
        jnp.maximum(ROUNDING_GAP * below, off).astype(dtype),
        max_steps,
        mu is not None,
        end - start,
        jnp.asarray(slow, dtype),
    )
    if method == "time_stepping":
        substeps = _substeps_of(step, t_start, t_end, count)
        joint = joins_step(law) and friction is None
        if joint:
            _check_coefficients(system, law, q)
        elif is_pile(system):
            raise ValueError(
                "Argument `law` must be Moreau's, with its own `friction` and without a matrix, "
                f"for the many contacts of {type(system.body).__name__}, but is {law!r}."
            )
        sizes = substeps, count, joint, rows
        given: Any = system, law, mu, q, v, start, end, settings.closed_below, *sizes
        return _waited(_stepped, given, progress)
    if method == "contact_forces":
        force = _force_of(law, mu)
        given = system, force, settings, q, v, start, end, count, rows
        return _waited(_forced, given, progress)
    given = system, law, mu, settings, q, v, start, end
    if _on_host(given):
        return _in_runs(given, count, MOST_EVENTS if max_events is None else max_events, progress)
    return _events(*(*given, None, count, rows))[0]


def _on_host(given: Any) -> bool:
    """Whether what follows from it is known at once: not within jit, vmap or derivatives."""
    return not is_traced(given) and is_top_level_call()


def _waited(run: Callable[..., Motion], given: Any, progress: float | None) -> Motion:
    if not _on_host(given):
        return run(*given)
    with waiting("motion", progress):
        return jax.block_until_ready(run(*given))


def _in_runs(given: tuple[Any, ...], samples: int, most: int, progress: float | None) -> Motion:
    """The motion in runs of `CHUNK` events, each of which goes on where the last one ended."""
    system, *_, q, v, start, end = given
    numbers: Any = no_past(q, v, _contacts_of(system, q), samples)
    parts: list[Events] = []
    with progress_bar(progress) as show:
        show("motion", 0.0, float(end - start))
        while True:
            left = jnp.asarray(np.int32(most - CHUNK * len(parts)))
            motion, numbers = _events(*(*given, Past(left, numbers), samples, CHUNK))
            parts.append(motion.events)
            if int(motion.status) != MOTION_CODE["max_events"] or CHUNK * len(parts) >= most:
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
    times = _equal_times(start, end, samples)
    given = Given(system, law, mu, settings, q, v, times, _contacts_of(system, q), past)
    course, numbers = event_driven(given, max_events)
    return _recorded(system, times, course), numbers


@quick_jit
def _forced(
    system: System,
    force: Force,
    settings: Settings,
    q: jax.Array,
    v: jax.Array,
    start: jax.Array,
    end: jax.Array,
    samples: int,
    max_events: int,
) -> Motion:
    times = _equal_times(start, end, samples)
    course, *_ = compliant_motion(system, force, settings, q, v, times, max_events)
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
    times = _equal_times(start, end, samples)
    course = time_stepping(system, law, mu, q, v, times, closed_below, substeps, joint, max_events)
    return _recorded(system, times, course)


def _recorded(system: System, times: jax.Array, course: Course) -> Motion:
    """The record of a course, with its energies and gaps."""
    at = course.samples
    there = jnp.isfinite(at.t)

    def seen(function: Callable[..., jax.Array], *args: jax.Array) -> jax.Array:
        """A function of the samples; where one is NaN, that is no derivative of the others."""
        rows = (jnp.where(there.reshape(-1, *[1] * (x.ndim - 1)), x, x[:1]) for x in args)
        found = jax.vmap(function)(*rows)
        return jnp.where(there.reshape(-1, *[1] * (found.ndim - 1)), found, jnp.nan)

    return Motion(
        time=times,
        q=at.q,
        velocity=at.v,
        kinetic_energy=seen(lambda q, v: kinetic(system, q, v), at.q, at.v),
        potential_energy=seen(lambda q: potential(system, q), at.q),
        force_work=at.work,
        base_work=at.base_work,
        contact_work=at.contact_work,
        gaps=seen(lambda q, t: recorded_gaps(system, q, t), at.q, times),
        events=course.events,
        steps=course.steps,
        status=course.status,
    )


def _equal_times(start: jax.Array, end: jax.Array, samples: int) -> jax.Array:
    """`samples` instants from start to end."""
    share = jnp.arange(samples, dtype=start.dtype) / (samples - 1)
    return start + share * (end - start)


def _check_motion(
    system: System,
    q: jax.Array,
    v: jax.Array,
    start: jax.Array,
    end: jax.Array,
) -> jax.Array:
    """Raise a ValueError for a bad start, end or system; the gaps at the start (m,)."""
    if q.ndim != 1:
        raise ValueError(f"Argument `q0` must have shape (n,), but has shape {q.shape}.")
    many = system.body.coordinates
    if many is None:
        check_shape("v0", v, q.shape, "one velocity per coordinate of `q0`")
    else:
        check_shape("q0", q, (many,), "the coordinates of the body")
    for name, value in (("q0", q), ("v0", v), ("t_start", start), ("t_end", end)):
        check_values(name, value)
    check_shape("t_start", start, (), "a time")
    check_shape("t_end", end, (), "a time")
    if not is_traced((start, end)) and not float(end) > float(start):
        raise ValueError(
            f"Argument `t_end` must be larger than `t_start` = {float(start):g}, "
            f"but has value {float(end):g}."
        )
    _check_functions(system, q, v, start)
    return _check_system(system, q, v, start, end)


def _check_functions(system: System, q: jax.Array, v: jax.Array, t: jax.Array) -> None:
    """Raise where a function of the system returns what cannot be used, by its shape alone."""
    body, n = system.body, v.shape[0]
    mass = jax.eval_shape(partial(mass_at, system), q)
    if mass.shape not in ((n,), (n, n)):
        raise ValueError(
            f"Argument `system` must have a mass of shape ({n},) or ({n}, {n}) as `v0` has {n} "
            f"velocities, but has one of shape {mass.shape}."
        )

    def returned(name: str, function: Any, *args: jax.Array) -> tuple[int, ...]:
        out = jax.eval_shape(lambda: jnp.asarray(function(*args)))
        if jnp.promote_types(out.dtype, q.dtype) != q.dtype:
            raise TypeError(
                f"Argument `system` must compute in the precision of `q0`, {q.dtype}, but its "
                f"`{name}` returns {out.dtype}: give `q0` in it, too."
            )
        found: tuple[int, ...] = out.shape
        return found

    def check(name: str, found: tuple[int, ...], allowed: str, fine: bool) -> None:
        if not fine:
            raise ValueError(
                f"Argument `system` must have a `{name}` that returns shape {allowed}, "
                f"but it returns {found}."
            )

    f = returned("gap_function", body.gap_function, q)
    check("gap_function", f, "(m,), a gap for each of m >= 1 contacts", len(f) == 1 and f[0] > 0)
    if jax.eval_shape(body.tangent_function, q) is not None:
        h = returned("tangent_function", body.tangent_function, q)
        check("tangent_function", h, "(m,), one displacement a contact", len(h) == 1)
    if system.force is not None:
        force = returned("force", system.force, q, v, t)
        check("force", force, f"({n},), one per velocity", force == (n,))
    if system.potential is not None:
        energy = returned("potential", system.potential, q)
        check("potential", energy, "(), an energy", energy == ())
    if system.base is not None:
        assert system.base_directions is not None
        d = system.base_directions.shape[1]
        check_shape("base_directions", system.base_directions, (n, d), "a row for each velocity")
        place = returned("base", system.base, t)
        check(
            "base",
            place,
            f"({d},), as `base_directions` has {d} columns",
            place == (d,) or (place == () and d == 1),
        )


def _check_system(
    system: System,
    q: jax.Array,
    v: jax.Array,
    start: jax.Array,
    end: jax.Array,
) -> jax.Array:
    # functions of a system may close over traced numbers
    mass, f = mass_at(system, q), gaps(system, q, start)
    if is_traced((system, q, v, start, end, mass, f)):
        return f
    if callable(system.mass):
        check_mass(mass)
    if system.base is not None:
        looks = np.linspace(float(start), float(end), _BASE_LOOKS)
        moved = system.base
        base = jax.vmap(lambda t: jnp.atleast_1d(moved(t)))(jnp.asarray(looks, q.dtype))
        if is_traced(base):
            return f
        bad = ~np.isfinite(np.asarray(base)).all(axis=1)
        if bad.any():
            raise ValueError(
                "Argument `system` must have a finite base motion, but base(t) has value "
                f"{np.asarray(base)[bad][0]} at t = {looks[bad][0]:g} s."
            )
    margin = float(system.body.valid(seen_from_base(system, q, start)))
    if not margin >= 0:
        raise ValueError(
            "Argument `q0` must be in the range of the gap function "
            f"({system.body.range_in_words}), but its margin has value {margin:g}."
        )
    return f


def _check_penetration(f: jax.Array, closed_below: jax.Array) -> None:
    if is_traced((f, closed_below)):
        return
    if not (f >= -closed_below).all():
        worst = int(jnp.argmin(f))
        raise ValueError(
            f"Argument `q0` must have no penetration (f >= {-float(closed_below):g} m), "
            f"but gap {worst} has value {f[worst]:g} m."
        )


def _opened(system: System, q: jax.Array, v: jax.Array, t: jax.Array) -> System:
    """The system; functions that close over traced arrays have these as arguments instead."""

    def opened(function: Any, *args: jax.Array) -> Any:
        if isinstance(function, eqx.Module) or not callable(function):
            return function
        args = tuple(jnp.zeros(x.shape, x.dtype) for x in args)
        if not is_traced(function(*args)):
            return function
        new = eqx.filter_closure_convert(function, *args)
        return new if is_traced(new) else function

    def parts(s: System) -> list[Any]:
        return [s.force, s.potential, s.base, *s.body.functions]

    args = [(q, v, t), (q,), (t,), *[(q,)] * len(system.body.functions)]
    new = [opened(function, *x) for function, x in zip(parts(system), args)]
    return eqx.tree_at(parts, system, new, is_leaf=lambda x: x is None)


def _friction_of(
    system: System, law: Law, given: Any, q: jax.Array, in_space: bool
) -> jax.Array | None:
    """mu (m,), () of a pile, given or of the law; None without friction."""
    mu = getattr(law, "friction", None) if given is None else given
    tangents = jax.eval_shape(system.body.tangents, q)
    if mu is None or (tangents is None and given is None):
        return None
    if tangents is None:
        raise ValueError("Argument `friction` needs a system with a `tangent_function`.")
    mu = as_float_array("friction", mu)
    check_values("friction", mu, low=0.0)
    if is_traced(mu):
        mu = jnp.where(mu >= 0, mu, jnp.nan)  # the motion is `not_finite` then
    elif not np.asarray(mu).any():
        return None  # frictionless systems pay nothing
    m = _contacts_of(system, q)
    if tangents.shape[1] not in (m, 2 * m):
        raise ValueError(
            "Argument `system` must have one tangent a contact in the plane, two in space: "
            f"{m} or {2 * m} for its {m} contacts, but has {tangents.shape[1]}."
        )
    if not (in_space or tangents.shape[1] == m):
        raise ValueError(
            "Argument `friction` must be 0 for a body with tangents in space: with "
            "method='time_stepping' alone motions know friction in space."
        )
    if is_pile(system):
        check_shape("friction", mu, (), "one for all contacts of a pile")
        return mu.astype(q.dtype)
    if mu.shape not in ((), (m,)):
        raise ValueError(f"Argument `friction` must have shape () or ({m},), but has {mu.shape}.")
    return jnp.broadcast_to(mu, (m,)).astype(q.dtype)


def _check_coefficients(system: System, law: Law, q: jax.Array) -> None:
    """One value of each for all contacts, or one a contact; of a pile one."""
    m = _contacts_of(system, q)
    for name in ("restitution", "tangential_restitution"):
        value = getattr(law, name)
        if is_pile(system):
            check_shape(name, value, (), "one for all contacts of a pile")
        elif value is not None:
            check_per_contact(name, value, m)


def _contacts_of(system: System, q: jax.Array) -> int:
    """m."""
    found: int = jax.eval_shape(system.body.gap_function, q).shape[0]
    return found


def _force_of(law: Law, mu: jax.Array | None) -> Force:
    """The contact force of a `Compliant` law, for motions without friction."""
    check_kind("law", law, Compliant)
    assert isinstance(law, Compliant)
    if mu is not None:
        raise ValueError("Argument `friction` must be 0 for method='contact_forces'.")
    return law.force


def _substeps_of(step: Any, start: Any, end: Any, samples: int) -> jax.Array:
    """Steps () between two samples, none longer than `step`."""
    if step is None or is_traced(step):
        raise ValueError("Argument `step` must be given, a number, for method='time_stepping'.")
    check_values("step", step, low=0.0, open_low=True)
    if is_traced((start, end)):
        raise ValueError("Arguments `t_start`, `t_end` must not be traced in time stepping.")
    between = (float(end) - float(start)) / (samples - 1)
    count = max(1.0, np.ceil(between / float(step) * (1 - 1e-9)))
    if count * (samples - 1) > MOST_STEPS:
        raise ValueError(
            f"Argument `step` must give at most {MOST_STEPS} steps, but has value {step:g}."
        )
    return jnp.asarray(int(count), jnp.int32)  # an array: one program for all steps
