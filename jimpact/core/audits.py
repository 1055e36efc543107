"""Consistency of an outcome: kinematic, kinetic and energetic, and the momentum
balance.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact.core.contact import contact_of
from jimpact.core.impacts import Impact, judged_beyond
from jimpact.core.scene import (
    Scene,
    as_velocity,
    gap_velocity,
    kinetic_energy,
    momentum,
    velocity_unit,
)
from jimpact.numerics.tridiagonal import diagonal
from jimpact.tools.checks import check_kind, check_shape
from jimpact.tools.compiling import full_precision, quick_jit
from jimpact.tools.records import formatted
from jimpact.tools.status import STATUS, sign_tolerance

CONSISTENCIES = ("kinematic", "kinetic", "energetic", "momentum")


class Audit(eqx.Module):
    """Four conditions on an outcome, and their numbers over the impact's size.

    Attributes:
        kinematic: whether gamma+ >= 0 at closed contacts ().
        kinetic: whether p >= 0 ().
        energetic: whether no energy is gained ().
        momentum: whether contact impulses explain the change ().
        worst_gap_velocity: the least gamma+ ().
        worst_impulse: the least p ().
        energy_gain: T+ - T- less what was stored ().
        momentum_residual: largest entry of M (v+ - v-) - N p - H p_t, over that of M v-
            ().
    """

    kinematic: jax.Array
    kinetic: jax.Array
    energetic: jax.Array
    momentum: jax.Array
    worst_gap_velocity: jax.Array
    worst_impulse: jax.Array
    energy_gain: jax.Array
    momentum_residual: jax.Array

    @property
    def consistent(self) -> jax.Array:
        """True () if all four conditions hold."""
        return self.kinematic & self.kinetic & self.energetic & self.momentum

    @property
    def broken(self) -> list[str]:
        """Names of the conditions that do not hold."""
        return [name for name in CONSISTENCIES if not bool(getattr(self, name))]


@full_precision
def audit(out: Impact, scene: Scene, velocity: Any) -> Audit:
    """Check an outcome against what every impact must satisfy, whatever the law.

    Equation: closed contacts `gamma+ >= 0` (kinematic), `p >= 0` (kinetic),
    `T+ - T- <= sum U_0` (energetic), `M (v+ - v-) = N p + H p_t` (momentum), but for
    reactions of bilateral constraints.

    Args:
        out: what `impact` returned, or an `Impact` filled by hand from measurements.
        scene: the scene of the impact.
        velocity: v- (n,) [m/s].

    Returns:
        `Audit`: a boolean () for each of the four, `consistent` for all; `print` says
            it in words.

    Raises:
        ValueError: the number of velocities is not that of coordinates. TypeError:
            arguments in another order.

    Source: Brogliato (2016), section 6.2.4.

    >>> import jimpact as ji
    >>> scene, v = ji.chain([1.0, 1.0]), [1.0, 0.0]
    >>> bool(ji.audit(ji.impact(ji.Newton(0.5), scene, v), scene, v).consistent)
    True
    """
    check_kind("scene", scene, Scene, "audit(out, scene, velocity)")
    v = as_velocity(scene, velocity)
    contact = contact_of(scene, v, uses_gaps=True)
    root = jnp.sqrt(diagonal(contact.delassus))
    gamma = jnp.where(scene.closed, contact.gap_velocity, 0.0)
    gamma_plus = gap_velocity(scene, out.velocity)
    approach = jnp.sum((jnp.minimum(gamma, 0.0) / root) ** 2)
    size = jnp.sqrt(approach + 2 * out.initial_energy)  # scale of the impact [sqrt(J)]
    size = jnp.where(size > 0, size, 1.0)
    momentum_change = momentum(scene, out.velocity - v)
    # T+ - T- without their cancellation
    change = 0.5 * momentum_change @ (out.velocity + v)
    residual = momentum_change - scene.normals @ out.impulse
    if scene.tangents is not None:
        residual = residual - scene.tangents @ out.tangential_impulse
    # reactions of the constraints are not listed in `out`
    if scene.constraints is not None:
        basis, _ = jnp.linalg.qr(scene.constraints)
        residual = residual - basis @ (basis.T @ residual)
    # as `impact` judges: an approach within rounding is not the law's
    rounding = contact.rounding(out.impulse, out.tangential_impulse)
    within = jnp.clip(gamma_plus, -rounding, 0.0)
    qn_plus = jnp.where(scene.closed, (gamma_plus - within) / root, jnp.inf)
    worst_gap_velocity = jnp.min(qn_plus) / size
    worst_impulse = jnp.min(out.impulse * root) / size
    gain = (change - out.initial_energy) / size**2
    largest = jnp.abs(momentum(scene, v)).max()
    off = jnp.abs(residual).max() / jnp.maximum(largest, 1e-300)
    tolerance = judged_beyond(out.velocity.dtype, jnp.asarray(out.accuracy))
    return Audit(
        kinematic=worst_gap_velocity >= -tolerance,
        kinetic=worst_impulse >= -tolerance,
        energetic=gain <= tolerance,
        momentum=off <= sign_tolerance(out.velocity.dtype),
        worst_gap_velocity=worst_gap_velocity,
        worst_impulse=worst_impulse,
        energy_gain=gain,
        momentum_residual=off,
    )


def nothing_approaches(scene: Scene, velocity: Any) -> str | None:
    """A sentence for summaries if no contact approaches, so that no impact happens;
    else None.
    """
    approaches = np.asarray(_approaching(scene, as_velocity(scene, velocity)))
    if (approaches & np.asarray(scene.closed)).any():
        return None
    if approaches.any():
        return (
            "no closed contact approaches (gamma- < 0), only open ones do: laws that "
            "use gaps are Compliant and Binary"
        )
    return (
        "nothing approaches (gamma- < 0 at no contact): is the sign of the "
        "velocities as meant?"
    )


@quick_jit
def _approaching(scene: Scene, velocity: jax.Array) -> jax.Array:
    """Mask (m,) of contacts that approach, beyond rounding."""
    return contact_of(scene, velocity, uses_gaps=True).gap_velocity < 0


@full_precision
def summary(out: Impact, scene: Scene, velocity: Any, names: Sequence[str] = ()) -> str:
    """A printable report of one impact (or, for a batch, of its status codes).

    Args:
        out: what `impact` returned, one or a batch.
        scene: of the impact.
        velocity: v- (n,) [m/s, rad/s].
        names: of the velocities with their units (n,), as `body.velocity_names`.

    Returns:
        Text of several lines: status, energy, audit, velocities and impulses of all
            contacts.

    Raises:
        ValueError: not one velocity, or name, per coordinate; another scene.

    >>> import jimpact as ji
    >>> scene, v = ji.chain([1.0, 1.0]), [1.0, 0.0]
    >>> print(ji.summary(ji.impact(ji.Newton(0.5), scene, v), scene, v).splitlines()[0])
    status         ok: resolved within tolerance
    """
    check_kind("out", out, Impact)
    check_kind("scene", scene, Scene)
    codes = np.asarray(out.status)
    if codes.ndim:
        counts = zip(*np.unique(codes, return_counts=True))
        rows = [f"{STATUS[c].name:24s}{k:10d}" for c, k in counts]
        return "\n".join([f"{codes.size} impacts by status", *rows])
    size = out.velocity.shape[-1]
    if size != scene.size:
        raise ValueError(
            f"Argument `scene` must be that of the impact, of {size} coordinates, but "
            f"has {scene.size}."
        )
    if names:
        check_shape("names", np.empty(len(names)), (scene.size,), "one per velocity")
    row = STATUS[int(codes)]
    energy = float(kinetic_energy(scene, velocity))
    change = float(out.energy_change)
    remaining = float("nan")
    if energy:
        remaining = (energy + change) / energy
    lines = [f"status         {row.name}: {row.message}"]
    reason = nothing_approaches(scene, velocity)
    if reason is not None and not np.asarray(out.impulse).any():
        lines.append(f"impact         none: {reason}")
    words = dict.fromkeys(CONSISTENCIES, "ok")
    words |= dict.fromkeys(audit(out, scene, velocity).broken, "VIOLATED")
    judged = ", ".join(f"{name} {word}" for name, word in words.items())
    unit = f"[{velocity_unit(scene)}]"
    if names:
        unit = "velocity"
    lines += [
        f"energy         {energy:.6g} J before, change {formatted(change, '.6g')} J "
        f"({100 * remaining:.4g} % kept)",
        f"audit          {judged}",
        f"coordinate          v-             v+   {unit}",
    ]
    pairs = zip(np.asarray(velocity, float), np.asarray(out.velocity, float))
    for i, (a, b) in enumerate(pairs):
        numbers = f"{formatted(a, '14.6g')} {formatted(b, '14.6g')}"
        lines.append(f"{i + 1:10d} {numbers}{f'   {names[i]}' if names else ''}")
    lines.append("contact          gamma-         gamma+   [m/s]     impulse [N s]")
    gamma = np.asarray(gap_velocity(scene, velocity))
    gamma_plus = np.asarray(gap_velocity(scene, out.velocity))
    contacts = zip(gamma, gamma_plus, np.asarray(out.impulse), scene.closed)
    for j, (a, b, p, closed) in enumerate(contacts):
        if closed:
            note = ""
        elif p == 0:
            note = "   open: takes no part"
        else:
            note = "   open before"
        numbers = (
            f"{formatted(a, '15.6g')} {formatted(b, '14.6g')} {formatted(p, '21.6g')}"
        )
        lines.append(f"{j + 1:7d} {numbers}{note}")
    return "\n".join(lines)
