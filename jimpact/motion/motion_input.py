"""Host-side checks of `simulate`, and what it derives from its arguments."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import as_float_array, check_shape, check_values, is_traced
from jimpact.law import Law
from jimpact.motion.dynamics import gaps, mass_at
from jimpact.motion.system import System
from jimpact.scene import check_mass

_BASE_LOOKS = 64  # times at which the base is looked at before the motion starts


def check_motion(
    system: System,
    q: jax.Array,
    v: jax.Array,
    start: jax.Array,
    end: jax.Array,
    closed_below: float,
) -> None:
    """Raise a ValueError for a bad start, end or system."""
    if q.ndim != 1:
        raise ValueError(f"Argument `q0` must have shape (n,), but has shape {q.shape}.")
    check_shape("v0", v, q.shape, "one velocity per coordinate of `q0`")
    for name, value in (("q0", q), ("v0", v), ("t_start", start), ("t_end", end)):
        check_values(name, value)
    check_shape("t_start", start, (), "a time")
    check_shape("t_end", end, (), "a time")
    if not is_traced((start, end)) and not float(end) > float(start):
        raise ValueError(
            f"Argument `t_end` must be larger than `t_start` = {float(start):g}, "
            f"but has value {float(end):g}."
        )
    _check_system(system, q, v, start, end, closed_below)


def _check_system(
    system: System,
    q: jax.Array,
    v: jax.Array,
    start: jax.Array,
    end: jax.Array,
    closed_below: float,
) -> None:
    n = q.shape[0]
    mass = jax.eval_shape(partial(mass_at, system), q)
    if mass.shape not in ((n,), (n, n)):
        raise ValueError(
            f"Argument `system` must have a mass of shape ({n},) or ({n}, {n}) as `q0` has {n} "
            f"coordinates, but has one of shape {mass.shape}."
        )
    if is_traced((system, q, v, start, end)):
        return
    if callable(system.mass):
        check_mass(mass_at(system, q))
    if system.base is not None:
        looks = np.linspace(float(start), float(end), _BASE_LOOKS)
        moved = system.base
        base = jax.vmap(lambda t: jnp.atleast_1d(moved(t)))(jnp.asarray(looks, q.dtype))
        bad = ~np.isfinite(np.asarray(base)).all(axis=1)
        if bad.any():
            raise ValueError(
                "Argument `system` must have a finite base motion, but base(t) has value "
                f"{np.asarray(base)[bad][0]} at t = {looks[bad][0]:g} s."
            )
    f = np.asarray(gaps(system, q, start))
    if not (f >= -closed_below).all():
        worst = int(np.argmin(f))
        raise ValueError(
            f"Argument `q0` must have no penetration (f >= -{closed_below:g} m), "
            f"but gap {worst} has value {f[worst]:g} m."
        )


def friction_of(system: System, law: Law, given: Any, q: jax.Array) -> jax.Array | None:
    """mu (m,), given or of the law; None without friction."""
    mu = getattr(law, "friction", None) if given is None else given
    if mu is None or (system.tangent_function is None and given is None):
        return None
    if system.tangent_function is None:
        raise ValueError("Argument `friction` needs a system with a `tangent_function`.")
    mu = as_float_array("friction", mu)
    check_values("friction", mu, low=0.0)
    m = jax.eval_shape(lambda x: gaps(system, x, jnp.zeros((), x.dtype)), q).shape[0]
    if not is_traced(mu) and not np.any(mu):
        return None  # frictionless systems pay nothing
    if mu.shape not in ((), (m,)):
        raise ValueError(f"Argument `friction` must have shape () or ({m},), but has {mu.shape}.")
    return jnp.broadcast_to(mu, (m,)).astype(q.dtype)


def substeps_of(step: Any, start: Any, end: Any, samples: int) -> int:
    """Steps between two samples, none longer than `step`."""
    if step is None or is_traced(step):
        raise ValueError("Argument `step` must be given, a number, for method='time_stepping'.")
    check_values("step", step, low=0.0, open_low=True)
    if is_traced((start, end)):
        raise ValueError("Arguments `t_start`, `t_end` must not be traced in time stepping.")
    between = (float(end) - float(start)) / (samples - 1)
    return max(1, int(np.ceil(between / float(step) * (1 - 1e-9))))
