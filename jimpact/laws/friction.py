"""Coulomb friction of the kinematic laws: their fields, checks, and the impulses of a scene."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import as_float_array, check_values, is_traced
from jimpact.contact_space import solve_mass
from jimpact.laws.base import Law
from jimpact.scene import Scene
from jimpact.solvers.friction import FrictionImpulses, solve


def friction_fields(
    friction: Any, tangential_restitution: Any
) -> tuple[jax.Array | None, jax.Array | None]:
    """`(mu, e_t)` as arrays, or `(None, None)` without friction."""
    if friction is None:
        if is_traced(tangential_restitution) or np.any(np.asarray(tangential_restitution) != 0):
            raise ValueError(
                "Argument `tangential_restitution` must be 0 without `friction`: then nothing acts "
                f"along the contacts, but has value {tangential_restitution!r}."
            )
        return None, None
    mu = as_float_array("friction", friction)
    e_t = as_float_array("tangential_restitution", tangential_restitution)
    check_values("friction", mu, low=0.0)
    check_values("tangential_restitution", e_t, low=-1.0, high=1.0)
    return mu, e_t


def check_friction(law: Law, scene: Scene) -> None:
    """Raise where a law with friction meets a scene without tangents."""
    if scene.tangents is None:
        raise ValueError(
            f"Argument `scene` must have tangents where {type(law).__name__} has `friction`: "
            "give Scene(..., tangents=...), or friction=None."
        )


def frictional_impulses(
    scene: Scene,
    velocity: jax.Array,
    normal: jax.Array,
    friction: jax.Array,
    tangential_restitution: jax.Array,
    complementary: bool,
) -> FrictionImpulses:
    """p (m,) and p_t (m,) or (2 m,) with `p_t in -mu p Sgn(v_t+ + e_t v_t-)`.

    `normal` (m,) [m/s] is what gamma+ - gamma- must make up for: `gamma+ - gamma- + normal` is 0,
    or (`complementary`) >= 0 and 0 where p > 0.
    """
    assert scene.tangents is not None  # see `check_friction`
    m, closed = scene.contacts, scene.closed
    each = scene.tangents.shape[1] // m
    both = jnp.concatenate([scene.normals, scene.tangents], axis=1)
    matrix = both.T @ solve_mass(scene, both)
    there = jnp.concatenate([closed, jnp.repeat(closed, each)])
    unit = jnp.eye(len(there), dtype=matrix.dtype)
    e_t = jnp.repeat(tangential_restitution * jnp.ones(m, matrix.dtype), each)
    found = solve(
        jnp.where(there[:, None] & there[None, :], matrix, unit),
        jnp.where(closed, normal, 0.0),
        jnp.where(there[m:], (1 + e_t) * (scene.tangents.T @ velocity), 0.0),
        jnp.where(closed, friction * jnp.ones(m, matrix.dtype), 0.0),
        complementary=complementary,
    )
    p = jnp.where(closed, found.normal, 0.0)  # exactly
    return FrictionImpulses(p, jnp.where(there[m:], found.tangential, 0.0), found.status)
