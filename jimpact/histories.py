"""What happens during an impact: forces, indentations, energies and velocities over its time."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from jimpact._checks import check_values, in_common_dtype, is_traced
from jimpact.law import Law, check_law
from jimpact.laws.compliant import Compliant
from jimpact.laws.forces import Bistiffness
from jimpact.laws.lzb import LZB, default_rtol
from jimpact.numerics import stepper
from jimpact.numerics.dimensionless import (
    Units,
    control_of,
    flow_of,
    indentation,
    reclosing,
    status_of,
    to_dimensionless,
)
from jimpact.numerics.flow import START, TIME, Flow, State, scales, step
from jimpact.numerics.powers import factor, plus_one, power
from jimpact.numerics.steps import Carry, Control
from jimpact.scene import Scene, as_velocity, velocity_change
from jimpact.solvers.tridiagonal import Tridiagonal

TRACED_RECORDS = 512  # passes kept when the number needed cannot be looked up (inside jit, grad)


class History(eqx.Module):
    """Histories over impact time: rows are samples; SI units.

    `time` (s,), `force`, `indentation`, `energy`, `impulse`, `gap_velocity` (s, m), `velocity`
    (s, n); `duration` (), `maximum_force` (m,) and `status` of the whole impact.
    `indentation` is the effective one, `E = k x^(eta + 1) / (eta + 1)`, of the loading curve.
    """

    time: jax.Array
    force: jax.Array
    indentation: jax.Array
    energy: jax.Array
    impulse: jax.Array
    gap_velocity: jax.Array
    velocity: jax.Array
    duration: jax.Array
    maximum_force: jax.Array
    status: jax.Array


def history(
    law: Law, scene: Scene, velocity: Any, samples: int = 200, records: int | None = None
) -> History:
    """Sample the impact of an `LZB` or `Compliant` law at equal intervals of impact time.

    Equation: `gamma' = W F`, `p' = F`, `F_j = k_j x_j^eta_j`; between the steps of the
    integrator a sample is one more step of the same method.

    Args:
        law: an `LZB` with method 'time', or a `Compliant` with a power law or a `Bistiffness`
            (gaps included: `indentation` is 0 while a contact is open); stiffness in SI units
            makes time and force SI.
        scene: n coordinates, m contacts.
        velocity: v- (n,) [m/s].
        samples: number of rows, first before and last after the impact.
        records: steps kept; None: as many as it takes (512 inside jit or grad, where
            `status` says max_steps if that is too few).

    Differentiable in both modes: `duration` and `maximum_force` too.

    Raises:
        TypeError: a law without impact dynamics. ValueError: what `impact` refuses.

    >>> import jimpact as ji
    >>> h = ji.history(ji.LZB(1.0, 2.0, exponent=1.0), ji.chain([1.0], wall=True), [1.0])
    >>> round(float(h.duration), 3), round(float(h.maximum_force[0]), 3)  # pi/sqrt(k), sqrt(k)
    (2.221, 1.414)
    """
    compliant = isinstance(law, Compliant) and isinstance(law.force, Bistiffness)
    if not compliant and not (isinstance(law, LZB) and law.method == "time"):
        raise TypeError(
            "Argument `law` must be an LZB law with method='time' or a Compliant law with a "
            "Bistiffness force (others have no impact dynamics that are sampled), "
            f"but is {law!r}."
        )
    if isinstance(law, LZB) and law.friction is not None:
        raise TypeError("Argument `law` must have no friction: its history is not sampled yet.")
    if samples < 2:
        raise ValueError(f"Argument `samples` must be at least 2, but has value {samples}.")
    v = as_velocity(scene, velocity)
    check_values("velocity", v)
    law, scene, v = in_common_dtype(law, scene, v)
    check_law(law, scene, v.dtype)
    if records is None and is_traced((law, scene, v)):
        records = TRACED_RECORDS
    elif records is None:
        passes = int(_passes(law, scene, v))  # type: ignore[arg-type]
        records = 1 << max(4, (passes - 1).bit_length())  # few sizes, few compilations
    return _history(law, scene, v, samples, records)  # type: ignore[arg-type]


Sampled = LZB | Compliant


def _contact(law: Sampled) -> Bistiffness:
    """Stiffness, exponent and restitution of the contacts."""
    if isinstance(law, Compliant):
        return law.force  # type: ignore[return-value]
    return Bistiffness(law.stiffness, law.exponent, law.restitution)


def _setup(law: Sampled, scene: Scene, v: jax.Array) -> tuple[Flow, Control, Carry, Units]:
    given, contact = law.contact(scene, v), _contact(law)
    w, gamma, happens = given.delassus, given.gap_velocity, given.happens
    inputs, units = to_dimensionless(
        w,
        jnp.where(happens, gamma, -jnp.ones_like(gamma)),
        contact.restitution,
        contact.stiffness,
        contact.exponent,
        given.stored,
        law.rtol or default_rtol("time", v.dtype),
        given.gaps if law.uses_gaps else None,
    )
    flow = flow_of(inputs, contact.exponent, isinstance(w, Tridiagonal))
    control = control_of(inputs, law.max_steps, "time")._replace(closed_form=False)
    x = indentation(inputs, flow.exponent)
    start = stepper.begin(flow, control, inputs.gamma, x)
    # nothing happens: over before it begins
    return flow, control, start._replace(done=start.done | ~happens), units


@eqx.filter_jit
def _passes(law: Sampled, scene: Scene, v: jax.Array) -> jax.Array:
    flow, control, start, _ = _setup(law, scene, v)
    return stepper.run(flow, control, start).passes[0]


@eqx.filter_jit
def _history(law: Sampled, scene: Scene, v: jax.Array, samples: int, records: int) -> History:
    flow, control, start, units = _setup(law, scene, v)

    def keep(carry: Carry, _: None) -> tuple[Carry, Carry]:
        after = stepper.advance(flow, control, carry, ~carry.done)
        return after, after

    end, rest = jax.lax.scan(keep, start, None, length=records)
    kept = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), start, rest)
    times = jnp.linspace(0.0, 1.0, samples, dtype=v.dtype) * end.state.t[0]
    at = jax.lax.stop_gradient(
        jnp.clip(jnp.searchsorted(kept.state.t[:, 0], times, side="right") - 1, 0, records)
    )

    def sample(index: jax.Array, t: jax.Array) -> tuple[State, jax.Array]:
        carry = jax.tree.map(lambda a: a[index], kept)
        return _between(flow, control, carry, t[None])

    states, gammas = jax.vmap(sample)(at, times)
    omega_force = units.velocity / (units.root * units.time)  # dp/dt: dimensionless -> SI
    eta = _contact(law).exponent
    rates = factor(eta, flow.omega) * flow.omega

    def force(x: jax.Array) -> jax.Array:
        return rates * power(x, eta) * omega_force

    def energy(x: jax.Array) -> jax.Array:
        return 0.5 * units.velocity**2 * power(x, plus_one(eta))

    impulse = states.p * (units.velocity / units.root)[None, :]
    return History(
        time=times * units.time,
        force=jax.vmap(force)(states.x),
        indentation=states.x * units.indentation[None, :],
        energy=jax.vmap(energy)(states.x),
        impulse=impulse,
        gap_velocity=gammas * (units.velocity * units.root)[None, :],
        velocity=jax.vmap(lambda p: v + velocity_change(scene, p))(impulse),
        duration=end.state.t[0] * units.time,
        maximum_force=jnp.max(jax.vmap(force)(kept.state.x), axis=0),
        status=status_of(end, reclosing(end, control.tolerance)).astype(jnp.int32),
    )


def _between(flow: Flow, control: Control, carry: Carry, t: jax.Array) -> tuple[State, jax.Array]:
    """State and gap velocities at time `t`, by one step from the record before it."""
    s, unit, _ = scales(flow, carry.phase)
    r = flow.root
    starting = carry.kind == START
    xi = jnp.where(starting, carry.begun, 0.0)
    ahead = jnp.where(unit > 0, (t - carry.state.t) / jnp.where(unit > 0, unit, 1.0), 0.0)
    reached = xi**r + ahead
    positive = reached > 0
    root = jnp.where(positive, jnp.where(positive, reached, 1.0) ** (1 / r), 0.0)
    length = jnp.where(starting, root - xi, ahead)
    kind = jnp.where(starting, START, TIME)
    none = jnp.zeros_like(carry.target)
    state, _, _ = step(
        flow, carry.phase, carry.state, kind, none, xi, length, ahead, control.tolerance
    )
    return state._replace(x=jnp.maximum(state.x, 0.0)), s * state.g
