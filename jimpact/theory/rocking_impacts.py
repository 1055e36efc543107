"""The rocking block over its shape: how much of the hit at corner B reaches corner A."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import as_float_array, check_values
from jimpact.bodies.blocks import rocking_block
from jimpact.impacts import impact
from jimpact.laws.lzb import LZB
from jimpact.status import STATUS
from jimpact.theory.rocking_record import RockingDispersion, rocking_kinetic_angle

_FAILS = np.array([row.failure for row in STATUS])
_ZOOMS, _POINTS = 6, 41  # grids of the search, each twenty times finer than the one before


@eqx.filter_jit
def _impacts(a: jax.Array, mu: jax.Array, e: jax.Array, law: LZB) -> tuple[jax.Array, ...]:
    """gamma+ (n, 2), theta'+, slip+, T+ / T-, status, of all (a, mu, e), at unit width and hit."""

    def one(a: jax.Array, mu: jax.Array, e: jax.Array) -> tuple[jax.Array, ...]:
        scene = rocking_block(jnp.ones_like(a), a, jnp.ones_like(a))
        before = jnp.stack([a / 2, jnp.full_like(a, -0.5), jnp.full_like(a, -1.0)])
        fields = (mu, e)
        now = eqx.tree_at(lambda x: (x.friction, x.restitution), law, fields)
        out = impact(now, scene, before)
        after, energy = out.velocity, (before**2 * scene.mass).sum() / 2
        slip = after[0] + a / 2 * after[2]
        kept = 1 + out.energy_change / energy
        return scene.normals.T @ after, -after[2], slip, kept, out.status

    gamma, turns, slip, kept, status = jax.vmap(one)(a, mu, e)
    bad = jnp.asarray(_FAILS)[status]
    parts = [jnp.where(bad, jnp.nan, x) for x in (turns, slip, kept)]
    return jnp.where(bad[:, None], jnp.nan, gamma), *parts, status


def _law(stiffness: Any, exponent: Any, rtol: float | None) -> LZB:
    return LZB(1.0, stiffness, exponent, friction=0.0, rtol=rtol)


def rocking_dispersion(
    aspect: Any,
    friction: Any = 0.0,
    restitution: Any = 1.0,
    stiffness: Any = 1.0,
    exponent: Any = 1.5,
    rtol: float | None = None,
) -> RockingDispersion:
    """A block at theta = 0 that rocks about A and hits with B, by LZB with Coulomb friction.

    Equation: `(gamma_B-, gamma_A-) = (-1, 0)`, no slip before; `d = y_A'+ / y_B'-` is 0 at the
    critical angle (`critical_kinetic_angle`) and grows in size on either side of it: a V.

    Args:
        aspect: a = height / width > 0, scalar or (A,).
        friction: mu >= 0, scalar or (B,), of both corners.
        restitution: energetic e in [0, 1], scalar or (C,), of both corners. At e = 0 no corner
            rebounds, and left of the critical angle d = 0: half a V.
        stiffness: of the corners, scalar or (2,) for B and A.
        exponent: 1 linear, 1.5 Hertz.
        rtol: as in `LZB`.

    Returns:
        `RockingDispersion` over all combinations (A, B, C); NaN where LZB fails: `max_steps`, for a
        few wide blocks left of the critical angle with e below about 0.1.

    Raises:
        ValueError: arguments out of range or with more than one axis.

    Source: Brogliato, Nonsmooth Mechanics (2016), section 6.3.2.2; classes as in
    `RockingDispersion.outcomes`.

    >>> import jimpact as ji
    >>> ji.rocking_dispersion(-1.0)
    Traceback (most recent call last):
    ...
    ValueError: Argument `aspect` must lie in (0, inf), but has value -1 at index 0.
    """
    a, mu, e = (
        _axis("aspect", aspect),
        _axis("friction", friction),
        _axis("restitution", restitution),
    )
    check_values("aspect", a, low=0.0, open_low=True)
    check_values("friction", mu, low=0.0)
    check_values("restitution", e, low=0.0, high=1.0)
    grid = [x.reshape(-1) for x in jnp.meshgrid(a, mu, e, indexing="ij")]
    found = _impacts(*grid, _law(stiffness, exponent, rtol))
    shape = (len(a), len(mu), len(e))
    parts = [x.reshape(shape + x.shape[1:]) for x in found]
    return RockingDispersion(a, mu, e, *parts)


def search_critical_angle(
    friction: Any, restitution: Any, stiffness: Any = 1.0, exponent: Any = 1.5
) -> jax.Array:
    """The kinetic angle [rad] at which |d| is least, by impacts alone: for all (B, C) of mu and e.

    Grids over 0.5 <= a <= 2, each around the best of the one before; to about 1e-7 where e > 0
    (at e = 0 there is no V to search). Arguments as in `rocking_dispersion`.

    >>> import jimpact as ji
    >>> ji.search_critical_angle(0.1, -0.5)
    Traceback (most recent call last):
    ...
    ValueError: Argument `restitution` must lie in (0, 1], but has value -0.5 at index 0.
    """
    mu, e = _axis("friction", friction), _axis("restitution", restitution)
    check_values("friction", mu, low=0.0)
    check_values("restitution", e, low=0.0, high=1.0, open_low=True)
    law = _law(stiffness, exponent, None)
    mus, es = (x.reshape(-1) for x in jnp.meshgrid(mu, e, indexing="ij"))
    low, high = jnp.full_like(mus, 0.5), jnp.full_like(mus, 2.0)
    for _ in range(_ZOOMS):
        a = jnp.linspace(low, high, _POINTS, axis=1)
        sides = [jnp.repeat(x, _POINTS) for x in (mus, es)]
        size = jnp.abs(_impacts(a.reshape(-1), *sides, law)[0][:, 1]).reshape(a.shape)
        best = jnp.take_along_axis(a, jnp.nanargmin(size, axis=1)[:, None], 1)[:, 0]
        step = (high - low) / (_POINTS - 1)
        low, high = best - step, best + step
    return rocking_kinetic_angle(best).reshape(len(mu), len(e))


def _axis(name: str, value: Any) -> jax.Array:
    array = jnp.atleast_1d(as_float_array(name, value))
    if array.ndim != 1 or not array.size:
        raise ValueError(
            f"Argument `{name}` must be a scalar or have one axis, but has shape {array.shape}."
        )
    return array
