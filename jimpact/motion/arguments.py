"""What a motion is refused for on the host, and what its arguments become."""

import warnings
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact.bodies.base import check_range
from jimpact.core.law import Law
from jimpact.core.scene import check_mass
from jimpact.laws.forces import Force
from jimpact.motion.dynamics import is_pile, mass_at, recorded_gaps, seen_from_base
from jimpact.motion.system import System
from jimpact.tools.checks import (
    check_per_contact,
    check_shape,
    check_values,
    is_traced,
)
from jimpact.tools.compiling import precise_jit
from jimpact.tools.precision import precision

MOST_STEPS = np.iinfo(np.int32).max  # they are counted in 32 bits
# Instants at which the base must be finite before a motion starts; what is not finite in between
# ends the motion with the status `not_finite`.
BASE_INSTANTS = 64
# Contacts of a pile above which motions by events warn: 1 100 compile for more than two minutes.
# Ten times more, and nobody is warned of that.
MANY = 200
# [m] Contacts with smaller gaps take part in an impact. Ten times more, and balls a few nanometres
# apart are struck together.
CLOSED_BELOW = 1e-9
ROUNDING_GAP = 1e-5  # of the gap that counts as closed: smaller gaps are rounding, hops as well
# What counts as closed is so many times more than what a gap may be off by. In metres and double
# precision it does not matter.
MORE_CLOSED = 10
DIFFERENTIATED = ("gap_function", "tangent_function", "potential", "base")


def as_times(t_end: Any) -> tuple[Any, Any]:
    """Start and end of a motion, which begins at 0 where only its end is said."""
    if not isinstance(t_end, tuple | list) and np.ndim(t_end) == 0:
        return 0.0, t_end
    if len(t_end) != 2:
        raise ValueError(
            f"Argument `t_end` must be a time or a pair (t_start, t_end), but has value {t_end!r}."
        )
    start, end = t_end
    return start, end


def check_motion(
    system: System,
    q: jax.Array,
    v: jax.Array,
    start: jax.Array,
    end: jax.Array,
) -> jax.Array:
    """Raise a ValueError for a bad start, end or system; the gaps at the start (m,)."""
    if q.ndim != 1:
        raise ValueError(f"Argument `q0` must have shape (n,), but has shape {q.shape}.")
    coordinates, mass = system.body.coordinates, system.body.mass
    if coordinates is not None:
        check_shape("q0", q, (coordinates,), "the coordinates of the body")
    elif not callable(mass):
        check_shape("q0", q, mass.shape[:1], "the coordinates of the body, as many as its mass has")
    if coordinates is None:
        check_shape("v0", v, q.shape, "one velocity per coordinate of `q0`")
    elif not callable(mass):
        check_shape("v0", v, mass.shape[:1], "the velocities of the body, as many as its mass has")
    for time in (start, end):
        check_shape("t_end", time, (), "a time, or a pair (t_start, t_end)")
    for name, value in (("q0", q), ("v0", v), ("t_end", start), ("t_end", end)):
        check_values(name, value)
    if not is_traced((start, end)) and not float(end) > float(start):
        raise ValueError(
            f"Argument `t_end` must be after the start at {float(start):g} s, "
            f"but has value {float(end):g}."
        )
    _check_functions(system, q, v, start)
    return _check_system(system, q, v, start, end)


def closed_gaps(
    q: jax.Array, f: jax.Array, closed_below: float | None
) -> tuple[jax.Array, jax.Array]:
    """Gaps () [m] below which a contact is closed, and below which a gap is rounding."""
    q, f = jax.lax.stop_gradient((q, f))
    numpy: Any = jnp if is_traced((q, f)) else np  # on the host nothing is compiled
    off = precision(q.dtype).noise * numpy.maximum(numpy.abs(q).max(), numpy.abs(f).max())
    below = numpy.maximum(CLOSED_BELOW, MORE_CLOSED * off) if closed_below is None else closed_below
    rounding = numpy.maximum(ROUNDING_GAP * below, off)
    return jnp.asarray(below, q.dtype), jnp.asarray(rounding, q.dtype)


def _check_functions(system: System, q: jax.Array, v: jax.Array, t: jax.Array) -> None:
    """Raise where a function of the system cannot be called, or returns what cannot be used."""
    body, n, precision = system.body, v.shape[0], q.dtype
    mass = _shape_of("mass", body.mass_matrix, {"q": q}, precision)
    if mass not in ((n,), (n, n)):
        raise ValueError(
            f"Argument `system` must have a mass of shape ({n},) or ({n}, {n}) as `v0` has {n} "
            f"velocities, but has one of shape {mass}."
        )
    f = _shape_of("gap_function", body.gap_function, {"q": q}, precision)
    fits = len(f) == 1 and f[0] > 0
    _check_returned("gap_function", f, "(m,), a gap for each of m >= 1 contacts", fits)
    h = _shape_of("tangent_function", body.tangent_function, {"q": q}, precision)
    if h is not None:
        _check_returned("tangent_function", h, "(m,), one displacement a contact", len(h) == 1)
    if system.force is not None:
        force = _shape_of("force", system.force, {"q": q, "v": v, "t": t}, precision)
        _check_returned("force", force, f"({n},), one per velocity", force == (n,))
    if system.potential is not None:
        energy = _shape_of("potential", system.potential, {"q": q}, precision)
        _check_returned("potential", energy, "(), an energy", energy == ())
    if system.base is not None:
        assert system.base_directions is not None
        d = system.base_directions.shape[1]
        check_shape("base_directions", system.base_directions, (n, d), "a row for each velocity")
        place = _shape_of("base", system.base, {"t": t}, precision)
        fits = place == (d,) or (place == () and d == 1)
        _check_returned("base", place, f"({d},), as `base_directions` has {d} columns", fits)


def _shape_of(name: str, function: Any, values: dict[str, jax.Array], precision: Any) -> Any:
    """The shape that a function of the system returns; None where that is None."""

    def call(*traced: jax.Array) -> jax.Array | None:
        out = function(*traced)
        return None if out is None else jnp.asarray(out)

    try:
        out = jax.eval_shape(call, *values.values())
    except Exception as error:
        reason = next(iter(str(error).splitlines()), "")
        raise TypeError(
            f"Argument `system` must have a `{name}` that takes JAX arrays ({', '.join(values)}) "
            f"and returns one, but it raises {type(error).__name__}: {reason}"
        ) from error
    if out is None:
        return None
    whole = not jnp.issubdtype(out.dtype, jnp.floating)
    if whole and name in DIFFERENTIATED:
        raise TypeError(
            f"Argument `system` must have a `{name}` that returns floating numbers, but it "
            f"returns {out.dtype}."
        )
    if not whole and jnp.finfo(out.dtype).bits > jnp.finfo(precision).bits:
        raise TypeError(
            f"Argument `system` must compute in the precision of `q0`, {precision}, but its "
            f"`{name}` returns {out.dtype}: give `q0` in it, too."
        )
    return out.shape


def _check_returned(name: str, shape: Any, allowed: str, fits: bool) -> None:
    """Raise unless what a function of the system returns `fits`."""
    if not fits:
        raise ValueError(
            f"Argument `system` must have a `{name}` that returns shape {allowed}, "
            f"but it returns {shape}."
        )


def _check_system(
    system: System,
    q: jax.Array,
    v: jax.Array,
    start: jax.Array,
    end: jax.Array,
) -> jax.Array:
    """Raise for values that cannot be used, where they are known; the gaps (m,) at the start."""
    mass, f, valid = _at_start(system, q, start)
    # functions of a system may close over traced numbers
    if is_traced((system, q, v, start, end, mass, f)):
        return f
    if callable(system.mass):
        check_mass(mass)
    if system.base is not None:
        instants = np.linspace(float(start), float(end), BASE_INSTANTS)
        displacement = system.base
        base = jax.vmap(lambda t: jnp.atleast_1d(displacement(t)))(jnp.asarray(instants, q.dtype))
        if is_traced(base):
            return f
        bad = ~np.isfinite(np.asarray(base)).all(axis=1)
        if bad.any():
            raise ValueError(
                "Argument `system` must have a finite base motion, but base(t) has value "
                f"{np.asarray(base)[bad][0]} at t = {instants[bad][0]:g} s."
            )
    check_range("q0", system.body, valid)
    return f


@precise_jit
def _at_start(system: System, q: jax.Array, t: jax.Array) -> tuple[jax.Array, ...]:
    """M, gaps (m,), of a pile the least one, and which coordinates are in range."""
    valid = system.body.valid(seen_from_base(system, q, t))
    return mass_at(system, q), recorded_gaps(system, q, t), valid


def without_closures(system: System, q: jax.Array, v: jax.Array, t: jax.Array) -> System:
    """The system; where functions close over traced arrays these become its leaves."""

    def converted(function: Any, *args: jax.Array) -> Any:
        """The function as a pytree of the arrays that it closes over, if they are traced."""
        if isinstance(function, eqx.Module) or not callable(function):
            return function
        args = tuple(jnp.zeros(x.shape, x.dtype) for x in args)
        if not is_traced(function(*args)):
            return function
        new = eqx.filter_closure_convert(function, *args)
        return new if is_traced(new) else function

    def parts(s: System) -> list[Any]:
        """All functions of a system."""
        return [s.force, s.potential, s.base, *s.body.functions]

    args = [(q, v, t), (q,), (t,), *[(q,)] * len(system.body.functions)]
    new = [converted(function, *x) for function, x in zip(parts(system), args)]
    return eqx.tree_at(parts, system, new, is_leaf=lambda x: x is None)


def friction_in_space(system: System, mu: jax.Array | None, q: jax.Array) -> bool:
    """Whether contacts with friction have two tangents each."""
    if mu is None or is_pile(system):
        return False
    tangents = jax.eval_shape(system.body.tangents, q)
    return tangents is not None and tangents.shape[1] == 2 * contacts_of(system, q)


def friction_of(system: System, law: Law, q: jax.Array) -> jax.Array | None:
    """mu (m,), () of a pile: that of the system, or of the law; None without friction."""
    own = system.friction is not None
    mu = system.friction if own else getattr(law, "friction", None)
    if mu is None:
        return None
    mu = jnp.asarray(mu)
    if not is_traced(mu) and not np.asarray(mu).any():
        return None  # frictionless systems pay nothing
    tangents = jax.eval_shape(system.body.tangents, q)
    if tangents is None:
        raise ValueError(
            "Argument `system` must have tangents for the friction of its "
            f"{'contacts' if own else 'law'}, but its `tangent_function` gives none."
        )
    if is_traced(mu):
        mu = jnp.where(mu >= 0, mu, jnp.nan)  # the motion is `not_finite` then
    m = contacts_of(system, q)
    if tangents.shape[1] not in (m, 2 * m):
        raise ValueError(
            "Argument `system` must have one tangent a contact in the plane, two in space: "
            f"{m} or {2 * m} for its {m} contacts, but has {tangents.shape[1]}."
        )
    if is_pile(system):
        check_shape("friction", mu, (), "one for all contacts of a pile")
        return mu.astype(q.dtype)
    if mu.shape not in ((), (m,)):
        raise ValueError(f"Argument `friction` must have shape () or ({m},), but has {mu.shape}.")
    return jnp.broadcast_to(mu, (m,)).astype(q.dtype)


def check_pile(system: System, q: jax.Array, mu: jax.Array | None, method: str) -> None:
    """Raise where only time stepping moves a pile, and warn where anything else is too dear."""
    if method == "time_stepping" or not is_pile(system):
        return
    name = type(system.body).__name__
    if mu is not None:
        raise ValueError(
            f"Argument `friction` must be 0 for the contacts of {name} by method={method!r}: use "
            "method='time_stepping', or name the `pairs` of few `Bodies`."
        )
    m = contacts_of(system, q)
    if m > MANY:
        warnings.warn(
            f"Argument `method` {method!r} computes all {m} contacts of {name} at each event, and "
            "compiles for minutes: use method='time_stepping' for many bodies.",
            stacklevel=3,
        )


def check_stepped_law(system: System, law: Law, q: jax.Array, joint: bool) -> None:
    """Raise unless time stepping of the system can use the law; `joint` as in `time_stepping`."""
    if not joint:
        if is_pile(system):
            raise ValueError(
                "Argument `law` must be Moreau's, with its own `friction` and without a matrix, "
                f"for the many contacts of {type(system.body).__name__}, but is {law!r}."
            )
        return
    m = contacts_of(system, q)
    for name in ("restitution", "tangential_restitution"):
        value = getattr(law, name)
        if is_pile(system):
            check_shape(name, value, (), "one for all contacts of a pile")
        elif value is not None:
            check_per_contact(name, value, m)


def contacts_of(system: System, q: jax.Array) -> int:
    """The number of contacts m."""
    count: int = jax.eval_shape(system.body.gap_function, q).shape[0]
    return count


def force_of(law: Law) -> Force:
    """The contact force of a law, for motions."""
    force: Force | None = law.contact_force
    if force is None or not law.uses_gaps:
        raise TypeError(
            "Argument `law` must use gaps and have a `contact_force` (Compliant) for "
            f"method='contact_forces', but is {law!r}."
        )
    check_unbounded("law", force)
    return force


def check_unbounded(name: str, force: Force) -> None:
    """Raise a TypeError for a force that yields: motions do not keep what it depends on."""
    if force.bound is not None:
        raise TypeError(
            f"Argument `{name}` must have a force without bound in a motion: what yields is for "
            f"`impact`, but the force is {force!r}."
        )


def substeps_of(step: Any, start: Any, end: Any, samples: int) -> jax.Array:
    """Steps () between two samples, none longer than `step`."""
    if is_traced((start, end)):
        raise ValueError("Argument `t_end` must not be traced in time stepping.")
    between = (float(end) - float(start)) / (samples - 1)
    count = max(1.0, np.ceil(between / float(step) * (1 - 1e-9)))
    if count * (samples - 1) > MOST_STEPS:
        raise ValueError(
            f"Argument `step` must give at most {MOST_STEPS} steps, but has value {step:g}."
        )
    return jnp.asarray(int(count), jnp.int32)  # an array: one program for all steps
