"""Persistent contact: its modes (open, sliding, sticking), and the forces that keep them.

The modes are frozen between events, so that forces are one linear solve: `rate' = 0` at every
active contact, and at sticking ones tangentially, too; `lambda_t = -sign mu lambda_n` at sliding
ones. Which modes hold after an event is decided by complementarity of forces and accelerations.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jimpact.motion.dynamics import (
    Kinematics,
    base_velocity,
    free_acceleration,
    kinematics,
    mass_at,
    not_rounding,
    solve_mass,
    user_force,
)
from jimpact.motion.system import System
from jimpact.solvers.dense import determinants, load_shares, regularized, solve_definite
from jimpact.solvers.friction import solve
from jimpact.solvers.lcp import solve_lcp
from jimpact.status import CODE

# Beside a matrix with unit diagonal: it decides where that is singular (redundant contacts that
# stick), and refinements remove what it changes elsewhere. Much less, and rounding decides, too.
_RIDGE, _REFINEMENTS = 1e-7, 3
# Without friction masses may differ by as much as rounding lets them; how redundant contacts share
# the load may err by rounding over this.
_THIN_RIDGE = 1e-9
_INDEPENDENT = 3  # frictionless contacts that are taken not to be redundant: legs of a table
_LEAST_SHARE = 1e-3  # of the pressing force: keeps the weights of contacts without load regular
# Contacts with |lambda_n| and |rate'| below this share of the largest gap acceleration of the
# motion stay together: bodies that move side by side press on each other by rounding only.
_REST_ACCELERATION = 1e-11
_PASSES = 3  # choices: contacts whose slip contradicts their choice are re-evaluated
# A power of rounding: of the matrix of the forces the rest would be rounding. What happens until it
# has fallen from there to 0 is as small.
_LEAST_REGULARITY, _FAINT_RIDGE = 1 / 2, 3 / 4  # the second with redundant contacts


class Modes(NamedTuple):
    """Of the m contacts: `active` (persistent), `stick`, `sign` (of sliding: -1, 0, 1)."""

    active: jax.Array
    stick: jax.Array
    sign: jax.Array


class Contacts(NamedTuple):
    """Contact space at one instant: normals first, then tangents where there is friction."""

    normal: Kinematics
    tangent: Kinematics | None
    directions: jax.Array  # [N, H] (n, k)
    moved: jax.Array  # M^-1 [N, H] (n, k)
    delassus: jax.Array  # (k, k)
    free: jax.Array  # M^-1 F: q'' without contacts (n,)
    approach: jax.Array  # (k,) second derivatives of gaps and displacements without contacts


class Forces(NamedTuple):
    """Contact forces (m,) [N], q'' (n,)."""

    normal: jax.Array
    tangential: jax.Array | None
    acceleration: jax.Array


def no_modes(m: int, dtype: jnp.dtype) -> Modes:
    """All contacts open."""
    return Modes(jnp.zeros(m, bool), jnp.zeros(m, bool), jnp.zeros(m, dtype))


def contacts_at(
    system: System, q: jax.Array, v: jax.Array, t: jax.Array, friction: bool
) -> Contacts:
    """Contact space of the system at (q, v, t)."""
    mass = mass_at(system, q)
    normal = kinematics(system, q, v, t)
    tangent = kinematics(system, q, v, t, of_tangents=True) if friction else None
    directions, drift = normal.gradient, normal.drift
    if tangent is not None:
        directions = jnp.concatenate([directions, tangent.gradient], axis=1)
        drift = jnp.concatenate([drift, tangent.drift])
    moved = solve_mass(mass, directions)
    free = free_acceleration(system, q, v, user_force(system, q, v, t), mass)
    return Contacts(
        normal, tangent, directions, moved, directions.T @ moved, free, directions.T @ free + drift
    )


def forces(contacts: Contacts, mu: jax.Array | None, modes: Modes) -> Forces:
    """The forces that keep the modes, and the acceleration with them."""
    m = contacts.normal.value.shape[0]
    if contacts.tangent is None or mu is None:
        normal = _without_friction(contacts.delassus, -contacts.approach[:, None], modes.active)[
            :, 0
        ]
        return Forces(normal, None, contacts.free + contacts.moved @ normal)
    w, held, drag = _dragged(contacts, mu, modes)
    right = -contacts.approach
    none = jnp.zeros(m, w.dtype)

    def shared(_: int, known: jax.Array) -> jax.Array:
        """Forces (k,), shared by the normal forces of the last pass."""
        # redundant sticking contacts share what they hold in proportion to mu lambda_n, as in
        # `solvers.friction`: they break loose together
        press = mu * jnp.maximum(jax.lax.stop_gradient(known[:m]), 0.0)
        weight = jnp.concatenate([none + 1, load_shares(press, _LEAST_SHARE)])
        return _least(w, right[:, None], held, weight)[:, 0]

    both = jax.lax.fori_loop(0, 2, shared, jnp.zeros_like(right))
    both = both.at[m:].add(-drag * both[:m])
    return Forces(both[:m], both[m:], contacts.free + contacts.moved @ both)


def _dragged(
    contacts: Contacts, mu: jax.Array, modes: Modes
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """What forces do to accelerations (k, k), friction going with the normal force where it slides.

    Beside it, which rows are held (k,), and `-lambda_t / lambda_n` of what slides (m,).
    """
    m = modes.active.shape[0]
    held = jnp.concatenate([modes.active, modes.active & modes.stick])
    drag = jnp.where(modes.active & ~modes.stick, modes.sign * mu, 0.0)
    return contacts.delassus.at[:, :m].add(-contacts.delassus[:, m:] * drag[None]), held, drag


def regularity(contacts: Contacts, mu: jax.Array, modes: Modes) -> jax.Array:
    """Determinant () of the matrix of the forces, over what it is if nothing slides with friction.

    Of one contact `1 - mu s W_nt / W_nn`, with s the sign of slip. Where it has fallen to 0 forces
    that keep the modes do not exist, or elastic contacts would not settle at them.
    """
    w, held, _ = _dragged(contacts, mu, modes)
    scale = 1 / jnp.sqrt(jnp.where(held, jnp.diagonal(contacts.delassus), 1.0))
    scale = jax.lax.stop_gradient(jnp.where(scale < jnp.inf, scale, 1.0))
    both = (held[:, None] & held[None, :])[None]
    k = jnp.stack([w, contacts.delassus]) * jnp.outer(scale, scale)[None]
    eye = jnp.eye(len(held), dtype=w.dtype)[None]
    ridge = float(jnp.finfo(w.dtype).eps) ** _FAINT_RIDGE
    with_friction, without = determinants(jnp.where(both, k, eye) + ridge * eye)
    return with_friction / without


def rest_acceleration(dtype: jnp.dtype) -> float:
    """See `_REST_ACCELERATION`."""
    return not_rounding(_REST_ACCELERATION, dtype)


def least_regularity(dtype: jnp.dtype) -> float:
    """What of `regularity` is 0."""
    return float(jnp.finfo(dtype).eps) ** _LEAST_REGULARITY


def _without_friction(w: jax.Array, right: jax.Array, held: jax.Array) -> jax.Array:
    """As `_least`; few contacts are taken not to be redundant."""
    if len(held) > _INDEPENDENT:
        return _least(w, right, held, jnp.ones_like(right[:, 0]), _THIN_RIDGE)
    k = jnp.where(held[:, None] & held[None, :], w, jnp.eye(len(held), dtype=w.dtype))
    return solve_definite(k, jnp.where(held[:, None], right, 0.0))


def _least(
    w: jax.Array, right: jax.Array, held: jax.Array, weight: jax.Array, ridge: float = _RIDGE
) -> jax.Array:
    """`w x = right` (k, columns) on the rows that are held; 0 elsewhere.

    Where that has many solutions, the one of least `sum w_jj x_j^2 / weight_j`.
    """
    scale = jnp.where(held, 1 / jnp.sqrt(jnp.diagonal(w)), 1.0)
    scale = jax.lax.stop_gradient(jnp.where(scale < jnp.inf, scale, 1.0))
    both = held[:, None] & held[None, :]
    scaled = w * scale[:, None] * (scale * weight)[None]
    k = jnp.where(both, scaled, jnp.eye(len(held), dtype=w.dtype))
    right = jnp.where(held[:, None], right * scale[:, None], 0.0)
    z = regularized(k[..., None], right, jnp.where(held, ridge, 0.0)[:, None], _REFINEMENTS)
    return (scale * weight)[:, None] * z


def constraint_impulse(
    contacts: Contacts, mu: jax.Array | None, modes: Modes, rates: jax.Array
) -> jax.Array:
    """Impulses p that take `rates` to 0 where the modes hold them, the least ones.

    Rates and impulses are (k,) or (k, columns); of normals alone, rates may have m rows.
    `contacts.moved @ p` is the change of velocity; of position, if `rates` are gaps (first order).
    """
    friction = contacts.tangent is not None and mu is not None
    held = modes.active
    if friction:
        held = jnp.concatenate([modes.active, modes.active & modes.stick])
    held = held[: rates.shape[0]]
    size = held.shape[0]
    w, columns = contacts.delassus[:size, :size], rates.reshape(size, -1)
    if friction:
        p = _least(w, -columns, held, jnp.ones_like(columns[:, 0]))
    else:
        p = _without_friction(w, -columns, held)
    rest = contacts.delassus.shape[0] - size
    return jnp.pad(p.reshape(rates.shape), ((0, rest),) + ((0, 0),) * (rates.ndim - 1))


def contact_powers(
    system: System, contacts: Contacts, result: Forces, t: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Power of friction at every contact (m,) and of the base () [W]."""
    friction = jnp.zeros_like(result.normal)
    push = contacts.normal.gradient @ result.normal
    if contacts.tangent is not None and result.tangential is not None:
        friction = result.tangential * contacts.tangent.rate
        push = push + contacts.tangent.gradient @ result.tangential
    carried = base_velocity(system, t)
    return friction, jnp.zeros_like(t) if carried is None else push @ carried


class ModeChoice(NamedTuple):
    """Modes; with friction they may not be `consistent`, and there may be `several`.

    Of several that is taken which sticks most. But a contact does not go on sliding where elastic
    contacts would not settle at such forces (see `regularity`): it `parts` (m,).
    """

    modes: Modes
    consistent: jax.Array
    regularity: jax.Array  # of the modes
    several: jax.Array
    parts: jax.Array


def choose_with_friction(
    contacts: Contacts,
    mu: jax.Array,
    before: Modes,
    touching: jax.Array,
    released: jax.Array,
    sliding: jax.Array,
    slack: jax.Array,
) -> ModeChoice:
    """Modes of the contacts that touch at rest.

    Args:
        contacts: contact space.
        mu: coefficients of friction (m,).
        before: modes up to now.
        touching: (m,) gap and gap velocity are 0.
        released: (2 m,) what has just let go: it is held again only by a force, not by rounding.
        sliding: (m,) whether the tangential velocity is not 0.
        slack: gap accelerations below it are rounding.
    """
    contacts, mu = jax.lax.stop_gradient((contacts, mu))
    assert contacts.tangent is not None
    m = touching.shape[0]
    slid = before.active & ~before.stick
    broken = released[m:] & before.stick & ~sliding
    ended = jnp.any(released[m:] & slid)
    # where sticking breaks at one contact of a body, those that began to slide before go on
    goes_on = slid & jnp.any(released[m:] & before.stick) & ~ended & ~sliding
    now = Modes(touching, ~sliding & ~goes_on, jnp.where(goes_on, before.sign, 0.0))
    now = now._replace(sign=jnp.where(sliding, jnp.sign(contacts.tangent.rate), now.sign))
    # sliding begins against the last force of sticking
    held = forces(contacts, mu, now._replace(active=touching & ~released[:m]))
    assert held.tangential is not None
    sign = jnp.where(broken, jnp.where(held.tangential > 0, -1.0, 1.0), now.sign)
    eye, diagonal = jnp.eye(2 * m, dtype=sign.dtype), jnp.diagonal(contacts.delassus)[:m]
    least = 2 * least_regularity(sign.dtype)  # twice: flights end at once it

    def choose(tried: _ModeTrial) -> _ModeTrial:
        """Modes by a complementarity problem, and what the next try must change."""
        known, rows = tried.known, jnp.tile(tried.allowed, 2)
        w = jnp.where(rows[:, None] & rows[None], contacts.delassus, eye)
        free = jnp.where(rows, contacts.approach, 0.0)
        solution = solve(
            w, free[:m], free[m:], mu * jnp.ones(m, sign.dtype), complementary=True, sliding=known
        )
        rate = contacts.approach + contacts.delassus @ jnp.concatenate(
            [solution.normal, solution.tangential]
        )
        active = tried.allowed & (rate[:m] <= slack)
        active = active & (~released[:m] | (solution.normal * diagonal > slack))
        slips = (known != 0) | (jnp.abs(rate[m:]) > slack)
        modes = Modes(active, active & ~slips, jnp.where(known != 0, known, jnp.sign(rate[m:])))
        # what was taken to slide from rest must do so
        returns = active & (known != 0) & ~sliding & (known * rate[m:] < -slack)
        several = solution.status == CODE["several_outcomes"]
        solved = solution.status <= CODE["several_outcomes"]
        known = jnp.where(jnp.where(solved, returns, ~sliding), 0.0, known)
        # what would go on sliding though it cannot parts, where that is a solution, too
        pressed = jnp.where(solved, active, tried.allowed)
        regular = regularity(contacts, mu, modes._replace(active=pressed, stick=pressed & ~slips))
        wedged = active & slips & (regular <= least)
        leaves = wedged & several
        open_ones_part = jnp.all(~touching | tried.allowed | (rate[:m] >= -slack))
        solved = solved & open_ones_part & ~jnp.any(wedged)
        done = solved & ~jnp.any(returns)
        several = several | tried.several
        allowed = tried.allowed & ~leaves
        return _ModeTrial(modes, known, allowed, regular, several, solved, done, tried.passes + 1)

    no = jnp.asarray(False)
    start = _ModeTrial(now, sign, touching, jnp.ones_like(slack), no, no, no, jnp.asarray(0))
    end = jax.lax.while_loop(lambda t: ~t.done & (t.passes < _PASSES), choose, start)
    parts, several = touching & ~end.allowed, end.several & end.solved
    return ModeChoice(end.modes, end.solved, end.regularity, several, parts)


class _ModeTrial(NamedTuple):
    """One try of `choose_with_friction`."""

    modes: Modes
    known: jax.Array  # (m,) directions of slip that are fixed, 0 where they are solved for
    allowed: jax.Array  # (m,) contacts that may be pressed
    regularity: jax.Array
    several: jax.Array
    solved: jax.Array
    done: jax.Array
    passes: jax.Array


def pressed_together(
    contacts: Contacts, touching: jax.Array, slack: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """`0 <= lambda _|_ W lambda + approach >= 0` over touching contacts, without friction.

    Returns:
        Which contacts (m,) are pressed, which (m,) neither press nor part, and lambda (m,).
    """
    contacts = jax.lax.stop_gradient(contacts)
    m = touching.shape[0]
    w, b = contacts.delassus[:m, :m], jnp.where(touching, contacts.approach[:m], 0.0)
    both = touching[:, None] & touching[None, :]
    eye = jnp.eye(m, dtype=w.dtype)
    # redundant contacts: any of the solutions will do
    solution = solve_lcp(jnp.where(both, w, eye), b, regular=True)
    pressed = touching & (solution.z * jnp.diagonal(w) > slack)
    return pressed, touching & ~pressed & (solution.w <= slack), solution.z
