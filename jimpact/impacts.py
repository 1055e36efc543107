"""`impact`: the one place that turns a law's impulses into velocities, energy and status."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import (
    check_kind,
    check_shape,
    check_values,
    in_common_dtype,
    is_traced,
)
from jimpact.blocks import Groups, coupled_groups, solve_groups
from jimpact.contact_space import (
    as_velocity,
    delassus_matrix,
    gap_velocity,
    momentum,
    solve_mass,
    velocity_change,
    without_open_contacts,
)
from jimpact.laws.base import Law, no_tangential_impulse
from jimpact.scene import Scene
from jimpact.solvers.tridiagonal import Symmetric, Tridiagonal, diagonal
from jimpact.status import CODE, STATUS, sign_tolerance

ROUNDINGS = 4  # of the largest terms that cancel: each is rounded a few times


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


def impact(law: Law, scene: Scene, velocity: Any) -> Impact:
    """Velocities after the impact of `law` on `scene`; pure: jit, vmap and grad over all three.

    Equation: `v+ = v- + M^-1 N p`, `T+ - T- = (gamma+ + gamma-)^T p / 2`.

    Contacts that no coordinate joins (two pairs of balls in one scene) are solved apart where the
    scene is known, not traced, and the law allows it (`Law.by_blocks`); the outcome is the same.

    Args:
        law: its parameters are scalars or have one entry per contact.
        scene: n coordinates, m contacts; contacts with gap > 0 take no part in instantaneous laws.
        velocity: v- (n,) [m/s].

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
    groups = coupled_groups(scene) if law.by_blocks() else None
    law, scene, v = in_common_dtype(law, scene, v)
    for name, value in vars(law).items():
        if isinstance(value, jax.Array) and value.ndim == 1 and len(value) != scene.contacts:
            check_shape(name, value, (scene.contacts,), "one entry per contact, or a scalar")
    law.check_options(v.dtype, scene)
    return _impact(law, scene, v, groups)


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


@eqx.filter_jit
def _impact(law: Law, scene: Scene, v: jax.Array, groups: Groups | None) -> Impact:
    gamma_all = gap_velocity(scene, v)
    taking_part = jnp.ones_like(scene.closed) if law.uses_gaps else scene.closed
    gamma = jnp.where(taking_part, gamma_all, 0.0)
    stored = jnp.where(taking_part, law.stored_energy(scene.contacts).astype(v.dtype), 0.0)
    law = law.with_stored(stored)
    happens = jnp.any(gamma < 0) | jnp.any(stored > 0) | ~jnp.all(jnp.isfinite(gamma))
    if groups is None:
        w_all = delassus_matrix(scene)
        w = w_all if law.uses_gaps else without_open_contacts(scene, w_all, gamma)[0]
        # where nothing happens the law sees a harmless approach, so its gradients stay finite
        approach = jnp.where(happens, gamma, -jnp.ones_like(gamma))
        p, tangential, code = law.all_impulses(scene, w, approach, v)
        w_diagonal = diagonal(w)
    else:
        p, code, w_diagonal = solve_groups(law, scene, groups, gamma, stored, happens)
        tangential = no_tangential_impulse(scene, p.dtype)
    p, tangential = jnp.where(happens, p, 0.0), jnp.where(happens, tangential, 0.0)
    jump = velocity_change(scene, p, tangential)
    v_plus = v + jump
    by_delassus = groups is None and tangential.size == 0
    gamma_plus = gamma_all + (w_all @ p if by_delassus else gap_velocity(scene, jump))
    # `(gamma+ + gamma-)^T p / 2`, summed over bodies: beside a light one terms of W p cancel
    change = 0.5 * momentum(scene, jump) @ (v + v_plus)
    code = jnp.where(happens, code, CODE["ok"])
    rounding = gap_velocity_rounding(scene, w_all if groups is None else None, gamma_all, p)
    code = jnp.maximum(
        code, _signs(w_diagonal, gamma, gamma_plus, p, change, stored, taking_part, rounding)
    )
    finite = jnp.all(jnp.isfinite(v_plus)) & jnp.all(jnp.isfinite(p)) & jnp.isfinite(change)
    code = jnp.where(finite, code, CODE["not_finite"]).astype(jnp.int32)
    return Impact(v_plus, p, tangential, change, jnp.sum(stored), code)


def gap_velocity_rounding(
    scene: Scene, w: Symmetric | None, gamma: jax.Array, p: jax.Array
) -> jax.Array:
    """Rounding (m,) of gamma+: terms of W p may be large and cancel, as beside a light ball."""
    if w is None:
        moved = solve_mass(scene, scene.normals)
        size = jnp.abs(scene.normals).T @ (jnp.abs(moved) @ jnp.abs(p))
    elif isinstance(w, Tridiagonal):
        size = Tridiagonal(w.diagonal, jnp.abs(w.off_diagonal)) @ jnp.abs(p)
    else:
        size = jnp.abs(w) @ jnp.abs(p)
    return ROUNDINGS * float(jnp.finfo(p.dtype).eps) * (jnp.abs(gamma) + size)


def _signs(
    w_diagonal: jax.Array,
    gamma: jax.Array,
    gamma_plus: jax.Array,
    p: jax.Array,
    change: jax.Array,
    stored: jax.Array,
    closed: jax.Array,
    rounding: jax.Array,
) -> jax.Array:
    """The gravest of negative_impulse, inadmissible_velocity, energy_gain; 0 if none."""
    tolerance = sign_tolerance(p.dtype)
    root = jnp.sqrt(w_diagonal)
    # size of the impact in sqrt(energy): what approaches and what is stored
    size = jnp.sqrt(jnp.sum((jnp.minimum(gamma, 0.0) / root) ** 2) + 2 * jnp.sum(stored))
    pull = jnp.any(p * root < -tolerance * size)
    approach = jnp.any(closed & ((gamma_plus + rounding) / root < -tolerance * size))
    gain = change > jnp.sum(stored) + tolerance * size**2
    code = jnp.where(gain, CODE["energy_gain"], CODE["ok"])
    code = jnp.where(approach, CODE["inadmissible_velocity"], code)
    return jnp.where(pull, CODE["negative_impulse"], code)


def raise_on_failure(out: Impact) -> Impact:
    """Raise a RuntimeError naming every failed impact of `out` (batched or not); else return it.

    Codes that only inform (`plastic_limit`, `impulse_not_unique`, `order_dependent`) pass.
    """
    codes = np.atleast_1d(np.asarray(out.status))
    lines = []
    for code in np.unique(codes):
        if STATUS[code].failure:
            at = np.argwhere(codes == code)
            first = ", ".join(str(tuple(map(int, i)) if len(i) > 1 else int(i[0])) for i in at[:5])
            where = f" at {first}{', ...' if len(at) > 5 else ''}" if codes.size > 1 else ""
            lines.append(f"{STATUS[code].name}: {STATUS[code].message} ({len(at)}{where})")
    if lines:
        raise RuntimeError(f"Failed impacts among {codes.size}:\n  " + "\n  ".join(lines))
    return out
