"""`impact`: the one place that turns a law's impulses into velocities, energy and status."""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import check_kind, check_values, in_common_dtype, is_traced
from jimpact.compiling import is_own, quick_jit
from jimpact.contact import Contact, Groups, contacts_of_groups, coupled_groups
from jimpact.law import Impulses, Law, check_law, is_separable, of_contacts, within_domains
from jimpact.scene import Scene, as_velocity, filled_up, momentum, velocity_change
from jimpact.solvers.tridiagonal import diagonal
from jimpact.status import CODE, STATUS, raise_for, sign_tolerance

# Impulses up to this many times what would undo the noise of gamma- are rounding: up to twice the
# noise is asked for, and contacts that feel each other pass it on a few times.
ROUNDING_PUSHES = 8

# Contacts of the program that single impacts of fewer ones share. Compiling takes a second for each
# number of contacts; contacts that are open cost a tenth of the impact.
SHARED = 8


class Impact(eqx.Module):
    """Outcome of an impact; under `vmap` every field has the axes of the batch first.

    `velocity` v+ (n,) [m/s]; `impulse` p (m,) [N s]; `tangential_impulse` (t,), t = 0 without
    friction [N s]; `energy_change` T+ - T- () [J]; `initial_energy` stored before () [J]; `status`
    () int32, a row of `jimpact.STATUS`, 0 = ok.
    """

    velocity: jax.Array
    impulse: jax.Array
    tangential_impulse: jax.Array
    energy_change: jax.Array
    initial_energy: jax.Array
    status: jax.Array


def impact(
    law: Law, scene: Scene, velocity: Any, noise: Any = None, approach: Any = None
) -> Impact:
    """Velocities after the impact of `law` on `scene`; pure: jit, vmap and grad over all three.

    Equation: `v+ = v- + M^-1 N p`, `T+ - T- = (gamma+ + gamma-)^T p / 2`.

    Contacts that no coordinate joins (two pairs of balls in one scene) are solved apart where the
    scene is known, not traced, and the law allows it (`Law.separable`); the outcome is the same.
    Approach within the rounding of v- (or within `noise`) is none.

    Args:
        law: its parameters are scalars or have one entry per contact.
        scene: n coordinates, m contacts; contacts with gap > 0 take no part in instantaneous laws.
        velocity: v- (n,) [m/s].
        noise: gap velocities () up to which are rounding, too [m/s]: in a motion v- holds the
            rounding of its largest speeds. None: of v- only.
        approach: gap velocity () that the law is shown contacts to approach with beyond that of v-
            [m/s]: a small one starts an impact without collision. None: 0.

    Returns:
        `Impact` with `velocity` (n,), `impulse` (m,), `tangential_impulse`, `energy_change` (),
        `initial_energy` (), `status` () int32, 0 = ok (`raise_on_failure`, `jimpact.STATUS`).

    Raises:
        ValueError: shapes or ranges, on the host; inside jit only the status speaks. NaN in a
            velocity raises when concrete, and is `not_finite` when traced.

    >>> import jimpact as ji
    >>> out = ji.impact(ji.LZB(0.9, stiffness=1.0, exponent=1.5), ji.chain([1, 1, 1]), [1, 0, 0])
    >>> [round(float(v), 4) for v in out.velocity]
    [-0.0086, 0.1041, 0.9045]
    """
    check_kind("law", law, Law)
    check_kind("scene", scene, Scene)
    v = as_velocity(scene, velocity)
    check_values("velocity", v)
    _check_constrained(scene, v)
    law, scene, v = in_common_dtype(law, scene, v)
    check_law(law, scene, v.dtype)
    check_values("noise", noise, low=0.0)
    check_values("approach", approach, low=0.0)
    noise = None if noise is None else jnp.asarray(noise, v.dtype)
    approach = None if approach is None else jnp.asarray(approach, v.dtype)
    shown = noise, approach
    separable = is_separable(law)
    groups = coupled_groups(scene) if separable else None
    few = scene.contacts <= SHARED and scene.walls != (True, True) and scene.tangents is None
    alike = few and groups is None and separable and law.fills_up
    if alike and not is_traced((law, scene, v, shown)) and is_own(()):
        return _filled_up(law, scene, v, shown)
    out = _impact(law, scene, v, groups, shown)
    return _held(law, out) if is_traced(law) else out  # else the law was checked when it was made


def _held(law: Law, out: Impact) -> Impact:
    """The outcome, told as `out_of_range` where a parameter is outside its domain."""
    told = jnp.maximum(out.status, CODE["out_of_range"])
    return dataclasses.replace(out, status=jnp.where(within_domains(law), out.status, told))


# `noise` and `approach` of an impact.
_Shown = tuple[jax.Array | None, jax.Array | None]


def _seen(contact: Contact, shown: _Shown) -> Contact:
    """The contacts without what is noise, and with the approach that they lack."""
    noise, approach = shown
    contact = contact if noise is None else contact.within(noise)
    return contact if approach is None else contact.approaching(approach)


def _filled_up(law: Law, scene: Scene, v: jax.Array, shown: _Shown) -> Impact:
    """The impact by the program for SHARED contacts, only some of which are closed."""
    filled = filled_up(scene, SHARED)
    velocity: Any = np.zeros(filled.scene.size, v.dtype)
    velocity[filled.coordinates] = v
    on_host = of_contacts(jax.tree.map(np.asarray, law), filled.copied)
    out = _impact(on_host, filled.scene, velocity, None, shown)
    return Impact(
        jnp.asarray(np.asarray(out.velocity)[filled.coordinates]),
        jnp.asarray(np.asarray(out.impulse)[filled.contacts]),
        out.tangential_impulse,
        out.energy_change,
        out.initial_energy,
        out.status,
    )


def _check_constrained(scene: Scene, velocity: jax.Array) -> None:
    """A velocity that breaks a bilateral constraint is an error."""
    if scene.constraints is None or is_traced((scene.constraints, velocity)):
        return
    h, v = np.asarray(scene.constraints), np.asarray(velocity)
    rate, size = np.abs(h.T @ v), np.abs(h).T @ np.abs(v)
    bad = rate > sign_tolerance(v.dtype) * size
    if bad.any():
        j = int(np.argmax(bad))
        raise ValueError(
            "Argument `velocity` must satisfy the bilateral constraints, grad h^T v = 0, but "
            f"constraint {j + 1} has the rate {(h.T @ v)[j]:g}."
        )


@quick_jit
def _impact(law: Law, scene: Scene, v: jax.Array, groups: Groups | None, shown: _Shown) -> Impact:
    if groups is None:
        contact = _seen(law.contact(scene, v), shown)
        happens = contact.happens
        outcome = _resolved(law, contact, happens)
        stored = contact.stored
    else:
        outcome, happens, stored = _in_groups(law, scene, v, groups, shown)
    p, tangential = outcome.normal, outcome.tangential
    jump = velocity_change(scene, p, tangential)
    v_plus = v + jump
    # `(gamma+ + gamma-)^T p / 2`, summed over bodies: beside a light one terms of W p cancel
    change = 0.5 * momentum(scene, jump) @ (v + v_plus)
    total = jnp.sum(stored)
    tolerance = sign_tolerance(v.dtype) * outcome.size**2 + outcome.noise
    code = jnp.where(change > total + tolerance, CODE["energy_gain"], CODE["ok"])
    code = jnp.where(happens, jnp.maximum(code, outcome.status), CODE["ok"])
    finite = jnp.all(jnp.isfinite(v_plus)) & jnp.all(jnp.isfinite(p)) & jnp.isfinite(change)
    code = jnp.where(finite, code, CODE["not_finite"]).astype(jnp.int32)
    return Impact(v_plus, p, tangential, change, total, code)


class _Resolved(NamedTuple):
    """Impulses of contacts, the status of the law and of their signs, and two scales."""

    normal: jax.Array
    tangential: jax.Array
    status: jax.Array
    size: jax.Array  # () of the impact, square root of an energy
    noise: jax.Array  # () energy that the rounding of v- leaves unknown


def _resolved(law: Law, contact: Contact, happens: jax.Array) -> _Resolved:
    """The law's answer; nothing where nothing happens, nor at open contacts."""
    gamma = contact.gap_velocity
    # where nothing happens the law sees a harmless approach, so its gradients stay finite
    harmless = jnp.where(happens, gamma, -jnp.ones_like(gamma))
    shown = eqx.tree_at(lambda c: c.gap_velocity, contact, harmless)
    answer = Impulses(*law.impulses(shown))
    part = happens & (contact.closed | law.uses_gaps)
    p = jnp.where(part, answer.normal, 0.0)
    sides = 0 if contact.slip is None else contact.slip.shape[0]
    tangential = jnp.zeros(sides, p.dtype)
    if answer.tangential is not None:
        rows = jnp.repeat(part, contact.tangents)
        tangential = jnp.where(rows, answer.tangential, 0.0)
    code = jnp.maximum(answer.status, _signs(contact, p, tangential))
    code = jnp.where(happens, code, CODE["ok"])
    noise = jnp.sum(contact.noise * jnp.abs(p))
    return _Resolved(p, tangential, code, contact.size, noise)


def _in_groups(
    law: Law, scene: Scene, v: jax.Array, groups: Groups, shown: _Shown
) -> tuple[_Resolved, jax.Array, jax.Array]:
    """All groups solved side by side; whether anything happens, and the stored energy (m,).

    Signs are judged on the scale of their group. A group in which nothing happens gets p = 0,
    unless the law also pulls at separating contacts.
    """
    m = scene.contacts
    stored = jnp.where(scene.closed, jnp.broadcast_to(law.stored, (m,)).astype(v.dtype), 0.0)
    of_groups = contacts_of_groups(scene, v, stored, groups)
    all_contacts = [_seen(contact, shown) for contact in of_groups]
    own = [jax.vmap(lambda contact: contact.happens)(contacts) for contacts in all_contacts]
    happens = jnp.any(jnp.concatenate(own))
    p = jnp.zeros(m, v.dtype)
    each = 0 if scene.tangents is None else scene.tangents.shape[1] // m
    tangential = jnp.zeros((m, each), v.dtype)
    code, square, unknown = jnp.asarray(CODE["ok"]), jnp.zeros((), v.dtype), jnp.zeros((), v.dtype)
    for filled, contacts, acts in zip(groups, all_contacts, own):
        index = jnp.asarray(filled % m)
        acts = happens & (acts | law.pulls)

        def of_group(index: jax.Array, contact: Contact, acts: jax.Array) -> _Resolved:
            return _resolved(of_contacts(law, index), contact, acts)

        if len(index) == 1:  # without the cost of a batch
            one = of_group(*jax.tree.map(lambda x: x[0], (index, contacts, acts)))
            part = jax.tree.map(lambda x: jnp.asarray(x)[None], one)
        else:
            part = jax.vmap(of_group)(index, contacts, acts)
        at = filled.reshape(-1)
        p = p.at[at].set(part.normal.reshape(-1), mode="drop")
        rows = part.tangential.reshape(len(at), each)
        tangential = tangential.at[at].set(rows, mode="drop")
        code = jnp.maximum(code, jnp.max(part.status))
        square, unknown = square + jnp.sum(part.size**2), unknown + jnp.sum(part.noise)
    found = _Resolved(p, tangential.reshape(-1), code, jnp.sqrt(square), unknown)
    return found, happens, stored


def _signs(contact: Contact, p: jax.Array, tangential: jax.Array) -> jax.Array:
    """negative_impulse or inadmissible_velocity; 0 if neither."""
    tolerance = sign_tolerance(p.dtype) * contact.size
    root = jnp.sqrt(diagonal(contact.delassus))
    # an impulse that only undoes what the rounding of v- may hold has no sign
    floor = tolerance + jnp.sqrt(jnp.sum((ROUNDING_PUSHES * contact.noise / root) ** 2))
    pull = jnp.any(p * root < -floor)
    after = contact.gap_velocity_after(p, tangential) + contact.rounding(p, tangential)
    approach = jnp.any(contact.closed & (after / root < -tolerance))
    code = jnp.where(approach, CODE["inadmissible_velocity"], CODE["ok"])
    return jnp.where(pull, CODE["negative_impulse"], code)


def raise_on_failure(out: Impact) -> Impact:
    """Raise a RuntimeError naming every failed impact of `out` (batched or not); else return it.

    Codes that only inform (`plastic_limit`, `ill_conditioned`, `order_dependent`, ..) pass.

    Args:
        out: what `impact` returned, one or a batch.

    Returns:
        `out` itself.

    Raises:
        RuntimeError: a status that is a failure; with the places in the batch.

    >>> import jimpact as ji
    >>> apart = ji.impact(ji.Newton(0.5), ji.chain([1.0, 1.0, 1.0]), [1.0, 0.0, 1.0])
    >>> ji.raise_on_failure(apart)
    Traceback (most recent call last):
        ...
    RuntimeError: Failed impacts among 1:
      negative_impulse: a contact would have to pull (p < 0) (1)
    """
    raise_for(out.status, STATUS, "impacts", lambda row, at: "")
    return out
