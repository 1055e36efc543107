"""The checked start of a motion: who makes a `Start` has had its arguments checked."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jimpact.bodies.base import check_penetration, check_range
from jimpact.core.law import Law
from jimpact.core.scene import check_mass
from jimpact.motion.dynamics import (
    Mass,
    is_pile,
    mass_at,
    recorded_gaps,
    seen_from_base,
)
from jimpact.motion.system import System, check_functions
from jimpact.tools.checks import as_float_array, check_shape, check_values, is_traced
from jimpact.tools.compiling import precise_jit
from jimpact.tools.precision import precision

# Instants at which the base must be finite before a motion starts; what is not finite
# in between ends the motion with the status `not_finite`.
BASE_INSTANTS = 64
# [m] Contacts with smaller gaps take part in an impact. Ten times more, and balls a few
# nanometres apart are struck together.
CLOSED_BELOW = 1e-9
# of the gap that counts as closed: smaller gaps are rounding, hops as well
ROUNDING_GAP = 1e-5
# What counts as closed is so many times more than what a gap may be off by. In metres
# and double precision it does not matter.
MORE_CLOSED = 10


class Start(NamedTuple):
    """Checked start of a motion: system, state, times, friction, and which gaps are
    closed.
    """

    # arrays that its functions close over are leaves, where they are traced
    system: System
    q: Float[Array, " nq"]
    v: Float[Array, " n"]
    time: Float[Array, ""]  # [s]
    end: Float[Array, ""]  # [s]
    # mu (m,), () of a pile; None: no contact has friction
    friction: Float[Array, "..."] | None
    closed_below: Float[Array, ""]  # [m] contacts with smaller gaps are closed
    gap_rounding: Float[Array, ""]  # [m] smaller gaps are rounding
    contacts: int  # m
    in_space: bool  # contacts with friction have two tangents each


def start_of(
    system: System,
    law: Law,
    q: Float[Array, "..."],
    v: Float[Array, "..."],
    t_end: Any,
    closed_below: float | None = None,
    may_penetrate: bool = False,
) -> Start:
    """Start of a motion at q, v that ends at `t_end`, a time or the pair (t_start,
    t_end) [s].

    `closed_below` [m] as of `EventDriven`.

    Raises:
        ValueError: for shapes and values that cannot be used, penetration but where it
            `may` be. TypeError: for functions of the system that JAX cannot trace.
    """
    times = (as_float_array("t_end", t) for t in as_times(t_end))
    start, end = (time.astype(q.dtype) for time in times)
    _check_coordinates(system, q, v, start, end)
    here = _at_start(system, q, v, start, end)
    gap = here.gaps
    # `q`, an array of the system, or one that its functions close over
    if is_traced(here):
        system = _with_closures_as_leaves(system, q, v, start)
    else:
        _check_values_at_start(system, here, start, end)
    below, rounding = _closed_gaps(q, gap, closed_below)
    if not may_penetrate:
        allowed = jnp.maximum(below, system.body.overlap)
        check_penetration("q0", gap, allowed)
    mu = _friction_of(system, law, here)
    m = here.contacts
    two_tangents = here.tangents == 2 * m
    rubs = mu is not None
    in_space = rubs and two_tangents and not is_pile(system)
    return Start(system, q, v, start, end, mu, below, rounding, m, in_space)


def as_times(t_end: Any) -> tuple[Any, Any]:
    """Start and end of a motion, which begins at 0 where only its end is said."""
    if isinstance(t_end, tuple | list) or np.ndim(t_end) > 0:
        if len(t_end) == 2:
            start, end = t_end
            return start, end
        raise ValueError(
            f"Argument `t_end` must be a time or a pair (t_start, t_end), but has "
            f"value {t_end!r}."
        )
    return 0.0, t_end


def _check_coordinates(
    system: System, q: jax.Array, v: jax.Array, start: jax.Array, end: jax.Array
) -> None:
    """Raise for coordinates, velocities and times of wrong shapes or values.

    The body, or else its constant mass, says how many there are; a body with
    quaternions has more coordinates than velocities. With a mass M(q),
    `check_functions` compares v with M.
    """
    if q.ndim != 1:
        raise ValueError(
            f"Argument `q0` must have shape (n,), but has shape {q.shape}."
        )
    coordinates = system.body.coordinates
    mass = system.body.mass
    if coordinates is not None:
        check_shape("q0", q, (coordinates,), "the coordinates of the body")
    elif not callable(mass):
        check_shape(
            "q0",
            q,
            mass.shape[:1],
            "the coordinates of the body, as many as its mass has",
        )
    if coordinates is None:
        check_shape("v0", v, q.shape, "one velocity per coordinate of `q0`")
    elif not callable(mass):
        check_shape(
            "v0",
            v,
            mass.shape[:1],
            "the velocities of the body, as many as its mass has",
        )
    for time in (start, end):
        check_shape("t_end", time, (), "a time, or a pair (t_start, t_end)")
    check_values("q0", q)
    check_values("v0", v)
    check_values("t_end", start)  # which the argument may hold, too
    check_values("t_end", end)
    known = not is_traced((start, end))
    if known and not float(end) > float(start):
        raise ValueError(
            f"Argument `t_end` must be after the start at {float(start):g} s, "
            f"but has value {float(end):g}."
        )


class _AtStart(NamedTuple):
    """Values of the functions of a system at the start."""

    mass: Mass
    gaps: Float[Array, " m"]  # [m], of a pile the least one alone
    valid: Float[Array, ""]  # margin of the range of the gap function
    # [m] displacements at BASE_INSTANTS instants
    base: Float[Array, "instants d"] | None
    # values of all other functions: traced where one closes over traced arrays
    others: list[Any]
    contacts: int  # m
    # number of tangential displacements; None: no friction is possible
    tangents: int | None


@precise_jit
def _at_start(
    system: System,
    q: Float[Array, " nq"],
    v: Float[Array, " n"],
    start: Float[Array, ""],
    end: Float[Array, ""],
) -> _AtStart:
    """Values of the functions of a system at (q, v, start), after `check_functions`;
    loads that it does not have are left out.

    The base is taken at equally spaced instants from start to end, as it must be finite
    all the time.
    """
    check_functions(system, q, v, start)
    body = system.body
    base = None
    if system.base is not None:
        y_b = system.base
        instants = jnp.linspace(start, end, BASE_INSTANTS)
        base = jax.vmap(lambda t: jnp.atleast_1d(y_b(t)))(instants)
    with_time = (q, v, start)
    loads = (system.potential, (q,)), (system.force, with_time)
    of_body = ((function, (q,)) for function in body.functions)
    others = [*loads, *of_body]
    seen = seen_from_base(system, q, start)
    h = jax.eval_shape(body.tangents, q)
    if h is None:
        tangents = None
    else:
        _, tangents = h.shape
    f = jax.eval_shape(body.gap_function, q)
    return _AtStart(
        mass=mass_at(system, q),
        gaps=recorded_gaps(system, q, start),
        valid=body.valid(seen),
        base=base,
        others=[function(*args) for function, args in others if callable(function)],
        contacts=len(f),
        tangents=tangents,
    )


def _check_values_at_start(
    system: System, here: _AtStart, start: Float[Array, ""], end: Float[Array, ""]
) -> None:
    """Raise for a mass, a range or a base motion that no motion can begin with."""
    if callable(system.body.mass):
        check_mass(here.mass)
    check_range("q0", system.body, here.valid)
    if here.base is None:
        return
    base = np.asarray(here.base)
    finite = np.isfinite(base)
    bad = ~finite.all(axis=1)
    if bad.any():
        instants = np.linspace(float(start), float(end), BASE_INSTANTS)
        raise ValueError(
            "Argument `system` must have a finite base motion, but base(t) has value "
            f"{base[bad][0]} at t = {instants[bad][0]:g} s."
        )


def _with_closures_as_leaves(
    system: System, q: Float[Array, " nq"], v: Float[Array, " n"], t: Float[Array, ""]
) -> System:
    """System in which traced arrays that its functions close over are leaves; functions
    that close over none stay as they are.
    """

    def converted(function: Any, *args: jax.Array) -> Any:
        """Function as a pytree of the arrays that it closes over, if they are
        traced; else, and of modules of Equinox, the function.
        """
        if isinstance(function, eqx.Module) or not callable(function):
            return function
        blank = tuple(jnp.zeros(x.shape, x.dtype) for x in args)
        value = function(*blank)
        if not is_traced(value):
            return function
        new = eqx.filter_closure_convert(function, *blank)
        if is_traced(new):
            return new
        return function

    def parts(s: System) -> list[Any]:
        """Functions of a system: force, potential, base, and those of its body."""
        of_loads = (s.force, s.potential, s.base)
        return [*of_loads, *s.body.functions]

    of_body = [(q,)] * len(system.body.functions)
    args = [(q, v, t), (q,), (t,), *of_body]
    calls = zip(parts(system), args)
    new = [converted(function, *x) for function, x in calls]
    return eqx.tree_at(parts, system, new, is_leaf=lambda x: x is None)


def _closed_gaps(
    q: Float[Array, " nq"], f: Float[Array, " m"], closed_below: float | None
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Gap [m] below which a contact is closed, and gap [m] below which it is rounding.

    Equation: `closed_below`, by default `max(CLOSED_BELOW, MORE_CLOSED noise max(|q|,
    |f|))`; and `max(ROUNDING_GAP closed_below, noise max(|q|, |f|))`.
    """
    q, f = jax.lax.stop_gradient((q, f))
    numpy: Any = jnp if is_traced((q, f)) else np  # on the host nothing is compiled
    largest_q = numpy.abs(q).max()
    largest_f = numpy.abs(f).max()
    largest = numpy.maximum(largest_q, largest_f)
    dtype = q.dtype
    off = precision(dtype).noise * largest
    if closed_below is None:
        below = numpy.maximum(CLOSED_BELOW, MORE_CLOSED * off)
    else:
        below = closed_below
    rounding = numpy.maximum(ROUNDING_GAP * below, off)
    return jnp.asarray(below, dtype), jnp.asarray(rounding, dtype)


def _friction_of(
    system: System, law: Law, here: _AtStart
) -> Float[Array, "..."] | None:
    """Coefficients mu (m,), () of a pile: of the system, or else of the law; None if
    there are none or all are 0.

    Traced ones below 0 become NaN: the motion is `not_finite` then. ValueError: for
    friction without tangents, or other shapes.
    """
    of_system = system.friction is not None
    if of_system:
        mu = system.friction
    else:
        mu = getattr(law, "friction", None)
    if mu is None:
        return None
    mu = jnp.asarray(mu)
    dtype = here.gaps.dtype
    m = here.contacts
    known = not is_traced(mu)
    if known and not np.asarray(mu).any():
        return None  # frictionless systems pay nothing
    if here.tangents is None:
        raise ValueError(
            "Argument `system` must have tangents for the friction of its "
            f"{'contacts' if of_system else 'law'}, but its `tangent_function` gives "
            "none."
        )
    if is_traced(mu):
        allowed = mu >= 0
        mu = jnp.where(allowed, mu, jnp.nan)  # the motion is `not_finite` then
    if here.tangents not in (m, 2 * m):
        raise ValueError(
            "Argument `system` must have one tangent a contact in the plane, two in "
            "space: "
            f"{m} or {2 * m} for its {m} contacts, but has {here.tangents}."
        )
    if is_pile(system):
        check_shape("friction", mu, (), "one for all contacts of a pile")
        return mu.astype(dtype)
    shape = (m,)
    if mu.shape not in ((), shape):
        raise ValueError(
            f"Argument `friction` must have shape () or ({m},), but has {mu.shape}."
        )
    of_contacts = jnp.broadcast_to(mu, shape)
    return of_contacts.astype(dtype)
