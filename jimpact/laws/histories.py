"""Histories of an impact: forces, indentations, energies and velocities over its
time.
"""

import dataclasses
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from jimpact.core.impacts import NOTHING_GIVEN, Traced, check_constrained
from jimpact.core.law import Law, check_law
from jimpact.core.scene import Scene, as_velocity, gap_velocity, velocity_change
from jimpact.events.contact_flow import ContactStates
from jimpact.events.impact_dynamics import Dynamics
from jimpact.events.impact_history import history_program
from jimpact.numerics.derive import in_lanes, naming_the_adjoint
from jimpact.tools.checks import as_whole, check_kind, check_values, in_common_dtype
from jimpact.tools.compiling import full_precision, quick_jit


class History(eqx.Module):
    """Histories over impact time: rows are samples; SI units.

    `time` (s,), `force`, `indentation`, `energy`, `impulse`, `gap_velocity`, `approach`
    (s, m), `velocity` (s, n); with friction `tangential_force`, `tangential_impulse`
    and `slip` (s, t), else t = 0; `tangential_energy` (s, m), `k_t xi^2 / 2` of
    tangential springs, else (s, 0); `duration` (), `maximum_force` (m,) and `status` of
    the whole impact.
    `indentation` is the effective one, `E = k x^(eta + 1) / (eta + 1)`, of the loading
    curve: it ends at 0. `approach` is the true one, `-int gamma dt`: where the force
    ends it is the residual indentation, and force against it encloses the energy lost
    (`ji.plot.contact_loop`).
    """

    time: jax.Array
    force: jax.Array
    indentation: jax.Array
    energy: jax.Array
    impulse: jax.Array
    gap_velocity: jax.Array
    approach: jax.Array
    velocity: jax.Array
    tangential_force: jax.Array
    tangential_impulse: jax.Array
    slip: jax.Array
    tangential_energy: jax.Array
    duration: jax.Array
    maximum_force: jax.Array
    status: jax.Array


@full_precision
def history(law: Law, scene: Scene, velocity: Any, samples: int = 200) -> History:
    """Sample the impact of a law that has a history at equal intervals of impact time.

    Equation: `gamma' = W F`, `p' = F`, `F_j = k_j x_j^eta_j`; between the steps of the
    integrator a sample is one more step of the same method. (With friction in space the
    intervals are only nearly equal: see `time`.)

    Args:
        law: an `LZB`, a `Compliant` with a power law or a `Bistiffness`
            (gaps included: `indentation` is 0 while a contact is open), a
            `VelocityDependent` of these, or a law of your own with `has_history` and
            `dynamics`; a stiffness in SI units makes time and force SI.
        scene: n coordinates, m contacts.
        velocity: v- (n,) [m/s].
        samples: number of rows, first before and last after the impact.

    Returns:
        `History`: rows are samples; `status` () as of `impact`.

    Differentiable in both modes: `duration` and `maximum_force` too.

    Raises:
        TypeError: a law without impact dynamics. ValueError: what `impact` refuses.

    >>> import jimpact as ji
    >>> h = ji.history(
    ...     ji.LZB(1.0, 2.0, exponent=1.0), ji.chain([1.0], wall=True), [1.0]
    ... )
    >>> (
    ...     round(float(h.duration), 3),
    ...     round(float(h.maximum_force[0]), 3),
    ... )  # pi/sqrt(k), sqrt(k)
    (2.221, 1.414)
    """
    check_kind("law", law, Law)
    if not law.has_history:
        raise TypeError(
            "Argument `law` must have a history (`has_history`: LZB, a "
            "Compliant with a Bistiffness force, a law of your own with `dynamics`), "
            f"but is {law!r}."
        )
    as_whole("samples", samples, 2)
    v = as_velocity(scene, velocity)
    check_values("velocity", v)
    if scene.constraints is not None:
        check_constrained(scene, v)
    law, scene, v = in_common_dtype(law, scene, v)
    check_law(law, scene, v.dtype)
    with naming_the_adjoint():
        return _history(law, scene, v, samples, Traced.of(law, scene, v))


@quick_jit
def _dimensionless(
    dynamics: Dynamics, samples: int
) -> tuple[jax.Array, jax.Array, ContactStates, jax.Array, jax.Array]:
    """s samples of an impact: time (s, 1, 1), twice the energy (s, m, 1), and contact
    states (s, m); largest forces (m,) and the status code (1,).
    """
    program = dynamics.program(with_end_time=True)
    leaves, _ = dynamics.columns()
    checkpoints = dynamics.adjoint == "checkpoints"
    differentiated = dataclasses.replace(program, checkpoints=checkpoints)
    programs = (
        history_program(program, samples),
        history_program(differentiated, samples),
    )
    time, energy, *rest = in_lanes(*programs, *leaves, adjoint=dynamics.adjoint)
    *rows, maximum, code = (x[..., 0] for x in rest)
    return time, energy, ContactStates(*rows), maximum, code


def _history(
    law: Law, scene: Scene, v: jax.Array, samples: int, traced: Traced
) -> History:
    """`History` of s = `samples` rows in SI units, from the dimensionless dynamics of
    the law.

    Where nothing happens, the dynamics run from gamma- = -1 m/s, and their samples are
    replaced by values before the impact.
    """
    contact = law.contact(scene, v)
    happens = contact.happens
    gamma = contact.gap_velocity
    harmless = jnp.where(happens, gamma, -jnp.ones_like(gamma))
    dynamics = law.dynamics(eqx.tree_at(lambda c: c.gap_velocity, contact, harmless))
    t = dynamics.tangents
    units = dynamics.units
    time, energy, states, maximum, code = _dimensionless(dynamics, samples)
    unit_force = units.momentum / units.time
    unit_gamma = units.velocity * units.root
    unit_energy = 0.5 * units.velocity**2
    root = jnp.repeat(units.root, t // len(gamma))
    unit_slip = units.velocity * root
    unit_p_t = units.velocity / root
    unit_friction = unit_p_t / units.time

    def sampled(x: jax.Array, otherwise: Any = 0.0) -> jax.Array:
        """Samples x; where nothing happens the value before the impact."""
        return jnp.where(happens, x, otherwise)

    def change(p: jax.Array, p_t: jax.Array) -> jax.Array:
        """Changes of velocity (s, n) by impulses, or accelerations by forces."""
        if t:
            return jax.vmap(partial(velocity_change, scene))(p, p_t)
        return jax.vmap(lambda p: velocity_change(scene, p, None))(p)

    impulse = sampled(states.impulse * units.momentum[None])
    tangential = sampled(states.tangential_impulse * unit_p_t[None])
    slip = jnp.zeros(0, v.dtype)
    if contact.slip is not None and t:
        slip = contact.slip
    seconds = sampled(time[:, 0, 0] * units.time)
    force = sampled(states.force * unit_force[None])
    friction = sampled(states.tangential_force * unit_friction[None])
    rates = sampled(states.gap_velocity * unit_gamma[None], gamma[None])
    # gap accelerations N^T M^-1 (N F + H F_t)
    growth = jax.vmap(partial(gap_velocity, scene))(change(force, friction))
    size = jnp.where(happens, contact.size, 1.0)
    finite = jnp.all(jnp.isfinite(impulse)) & jnp.all(jnp.isfinite(seconds))
    arguments = law, scene, v, NOTHING_GIVEN
    return History(
        time=seconds,
        force=force,
        indentation=sampled(states.indentation * units.indentation[None]),
        energy=sampled(unit_energy * energy[..., 0]),
        impulse=impulse,
        gap_velocity=rates,
        approach=-_integral(seconds, rates, growth),
        velocity=v[None] + change(impulse, tangential),
        tangential_force=friction,
        tangential_impulse=tangential,
        slip=sampled(states.slip * unit_slip[None], slip[None]),
        tangential_energy=sampled(unit_energy * states.tangential_energy),
        duration=sampled(time[-1, 0, 0] * units.time),
        maximum_force=sampled(maximum * unit_force),
        status=traced.status(arguments, sampled(code[0]), size, finite),
    )


def _integral(time: jax.Array, values: jax.Array, rates: jax.Array) -> jax.Array:
    """Integrals (s, m) of `values` y (s, m) over `time` t (s,) from the first one on.

    Equation: per step h, `h (y_1 + y_2) / 2 + h^2 (y'_1 - y'_2) / 12` with their
    derivatives y' = `rates` (s, m): exact for cubics.
    """
    h = jnp.diff(time)[:, None]
    y_1 = values[:-1]
    y_2 = values[1:]
    dy_1 = rates[:-1]
    dy_2 = rates[1:]
    pieces = h / 2 * (y_2 + y_1) + h**2 / 12 * (dy_1 - dy_2)
    return jnp.pad(jnp.cumsum(pieces, axis=0), ((1, 0), (0, 0)))
