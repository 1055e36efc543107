"""Persistent contact: its modes (open, sliding, sticking), and the forces that keep them.

The modes are frozen between events, so that forces are one linear solve: `rate' = 0` at every
active contact, and at sticking ones tangentially, too; `lambda_t = -mu lambda_n d` at sliding ones,
in the direction d of slip. Which modes hold after an event is decided by complementarity of forces
and accelerations. A contact in space has two rows of slip where one in the plane has one.
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
    user_force,
)
from jimpact.motion.system import System
from jimpact.numerics.dense import (
    determinants,
    load_shares,
    regularized,
    solve_definite,
    solve_mass_matrix,
)
from jimpact.numerics.friction import solve
from jimpact.numerics.lcp import solve_lcp
from jimpact.tools.precision import precision
from jimpact.tools.status import CODE

# Beside a matrix with unit diagonal: it decides where that is singular (redundant contacts that
# stick), and refinements remove what it changes elsewhere. Much less, and rounding decides, too.
_RIDGE, _REFINEMENTS = 1e-7, 3
# Part of its diagonal entry that friction leaves a contact which is about to jam. Ten times more:
# redundant contacts share by their slip, which derivatives do not see; ten times less: the ridge is
# felt for longer.
_JAMS = 1e-2
# Without friction masses may differ by as much as rounding lets them; how redundant contacts share
# the load may err by rounding over this.
_THIN_RIDGE = 1e-9
_INDEPENDENT = 3  # frictionless contacts that are taken not to be redundant: legs of a table
_LEAST_SHARE = 1e-3  # of the pressing force: keeps the weights of contacts without load regular
# Contacts with |lambda_n| and |rate'| below this share of the largest gap acceleration of the
# motion stay together: bodies that move side by side press on each other by rounding only.
_REST_ACCELERATION = 1e-11
BEGINS = 2  # `Modes.sign` of a contact in space whose slip begins
# Slip in space that grows from rest slower than this part of what friction changes it by only
# begins: see `slip_in_space.py`. Ten times more: errors a thousand times as large, steps a tenth.
_BEGINNING = 2e-3
# Part of the cone that may hold a contact across its slip, as long as that begins. Ten times more:
# the contact may be held by all of it.
_LEANING = 0.1
_PASSES = 3  # choices: contacts whose slip contradicts their choice are re-evaluated
# A power of rounding: a ridge that redundant contacts need to share their forces. Ten times more
# would be seen in the forces.
_FAINT_RIDGE = 3 / 4


class Modes(NamedTuple):
    """Of the m contacts: `active` (persistent), `stick`, `sign` (of sliding: -1, 0, 1).

    In space, where `slip_in_space.py` has the directions, `sign` is 1 of those that slide, and
    `BEGINS` of those that begin to.
    """

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


def by_contact(rows: jax.Array, m: int) -> jax.Array:
    """Tangential rows (t,) as (m, rows)."""
    return rows.reshape(m, -1)


def length(rows: jax.Array) -> jax.Array:
    """|u_j| (m,) of (m, rows), with derivative 0 at 0."""
    if rows.shape[1] == 1:
        return jnp.abs(rows[:, 0])
    square = jnp.sum(rows**2, axis=1)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)


def direction(rows: jax.Array) -> jax.Array:
    """Unit vectors of (m, rows), 0 of 0."""
    if rows.shape[1] == 1:
        return jnp.sign(rows)
    size = length(rows)[:, None]
    return jnp.where(size > 0, rows / jnp.where(size > 0, size, 1.0), 0.0)


def in_space(contacts: Contacts) -> bool:
    """Whether slip has two rows a contact."""
    tangent = contacts.tangent
    return tangent is not None and len(tangent.rate) == 2 * len(contacts.normal.rate)


def held_rows(modes: Modes, size: int) -> jax.Array:
    """Which of the first `size` rows (normals, then tangents) the modes hold.

    In space the first row of a contact is along its slip: where slip begins the other one is held.
    """
    m, stick = modes.active.shape[0], modes.active & modes.stick
    if size == m:
        return modes.active
    if size == 2 * m:
        return jnp.concatenate([modes.active, stick])
    across = stick | (modes.active & (modes.sign == BEGINS))
    return jnp.concatenate([modes.active, jnp.stack([stick, across], axis=1).reshape(-1)])


def contacts_at(
    system: System,
    q: jax.Array,
    v: jax.Array,
    t: jax.Array,
    friction: bool,
    along: jax.Array | None = None,
) -> Contacts:
    """Contact space of the system at (q, v, t); in space with tangents `along` (m, 2)."""
    mass = mass_at(system, q)
    normal, tangent = kinematics(system, q, v, t, friction)
    directions, drift = normal.gradient, normal.drift
    if tangent is not None and along is not None:
        tangent = _turned(tangent, along)
    if tangent is not None:
        directions = jnp.concatenate([directions, tangent.gradient], axis=1)
        drift = jnp.concatenate([drift, tangent.drift])
    moved = solve_mass_matrix(mass, directions)
    free = free_acceleration(system, q, v, user_force(system, q, v, t), mass)
    return Contacts(
        normal, tangent, directions, moved, directions.T @ moved, free, directions.T @ free + drift
    )


def with_normal_forces(contacts: Contacts, push: jax.Array) -> Contacts:
    """Contact space in which normal forces are `push` (m,), whatever friction does."""
    m = len(push)
    size = jnp.diagonal(contacts.delassus)[:m]
    w = contacts.delassus.at[:, :m].set(0.0).at[:m].set(0.0)
    pushed = contacts.approach + contacts.delassus[:, :m] @ push
    return contacts._replace(
        delassus=w.at[:m, :m].set(jnp.diag(size)), approach=pushed.at[:m].set(-size * push)
    )


def slip_frames(along: jax.Array) -> jax.Array:
    """Axes (m, 2, 2) in the tangent plane of each contact: `along` (m, 2), and at right angles."""
    return jnp.stack([along, jnp.stack([-along[:, 1], along[:, 0]], axis=1)], axis=1)


def _turned(tangent: Kinematics, along: jax.Array) -> Kinematics:
    """What slides in space, along (m, 2) and at right angles to it."""
    axes = slip_frames(along)

    def turned(rows: jax.Array) -> jax.Array:
        """Rows (.., 2 m) along the axes."""
        each = rows.reshape(*rows.shape[:-1], -1, 2)
        return jnp.einsum("...mk,mjk->...mj", each, axes).reshape(rows.shape)

    return Kinematics(*(turned(x) for x in tangent))


def friction_acceleration(contacts: Contacts, mu: jax.Array, normal: jax.Array) -> jax.Array:
    """How much friction can change the slip of each contact itself (m,) [m/s^2]."""
    m = len(mu)
    return mu * normal * by_contact(jnp.diagonal(contacts.delassus)[m:], m).mean(axis=1)


def cone_margins(contacts: Contacts, mu: jax.Array, force: Forces) -> jax.Array:
    """What the forces leave of the friction cones (m,) [m/s^2], 0 at the rim."""
    assert force.tangential is not None
    m = len(mu)
    sizes = by_contact(jnp.diagonal(contacts.delassus)[m:], m).mean(axis=1)
    return (mu * force.normal - length(by_contact(force.tangential, m))) * sizes


def slip_begins(
    contacts: Contacts, mu: jax.Array, normal: jax.Array, growth: jax.Array
) -> jax.Array:
    """How much faster (m,) slip may grow, than at the rate `growth` (m,), and yet only begin."""
    return _BEGINNING * friction_acceleration(contacts, mu, normal) - growth


def forces(
    contacts: Contacts, mu: jax.Array | None, modes: Modes, slip: jax.Array | None = None
) -> Forces:
    """The forces that keep the modes, and the acceleration with them.

    `slip` (m, rows): unit vectors of those that slide; None: in the plane, `modes.sign`.
    """
    m = contacts.normal.value.shape[0]
    if contacts.tangent is None or mu is None:
        normal = _without_friction(contacts.delassus, -contacts.approach[:, None], modes.active)[
            :, 0
        ]
        return Forces(normal, None, contacts.free + contacts.moved @ normal)
    w, held, drag = _dragged(contacts, mu, modes, slip)
    right = -contacts.approach
    none = jnp.zeros(m, w.dtype)

    def shared(_: int, known: jax.Array) -> jax.Array:
        """Forces (k,), shared by the normal forces of the last pass."""
        # redundant sticking contacts share what they hold in proportion to mu lambda_n, as in
        # `solvers.friction`: they break loose together
        press = mu * jnp.maximum(jax.lax.stop_gradient(known[:m]), 0.0)
        share = jnp.repeat(load_shares(press, _LEAST_SHARE), drag.shape[1])
        weight = jnp.concatenate([none + 1, share])
        return _least(w, right[:, None], held, weight, _sizes(w, contacts.delassus, m))[:, 0]

    both = jax.lax.fori_loop(0, 2, shared, jnp.zeros_like(right))
    both = both.at[m:].add(-(drag * both[:m, None]).reshape(-1))
    return Forces(both[:m], both[m:], contacts.free + contacts.moved @ both)


def _dragged(
    contacts: Contacts, mu: jax.Array, modes: Modes, slip: jax.Array | None
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """What forces do to accelerations (k, k), friction going with the normal force where it slides.

    Beside it, which rows are held (k,), and `-lambda_t / lambda_n` of what slides (m, rows).
    """
    m, k = modes.active.shape[0], contacts.delassus.shape[0]
    slides = (modes.active & ~modes.stick)[:, None]
    along = modes.sign[:, None] if slip is None else slip
    drag = jnp.where(slides, along * mu[:, None], 0.0)
    pull = (contacts.delassus[:, m:] * drag.reshape(-1)[None]).reshape(k, m, -1).sum(axis=2)
    return contacts.delassus.at[:, :m].add(-pull), held_rows(modes, k), drag


def regularity(
    contacts: Contacts, mu: jax.Array, modes: Modes, slip: jax.Array | None = None
) -> jax.Array:
    """Determinant () of the matrix of the forces, over what it is if nothing slides with friction.

    Of one contact `1 - mu s W_nt / W_nn`, with s the sign of slip. Where it has fallen to 0 forces
    that keep the modes do not exist, or elastic contacts would not settle at them; below the root
    of rounding it counts as 0.
    """
    w, held, _ = _dragged(contacts, mu, modes, slip)
    scale = 1 / jnp.sqrt(jnp.where(held, jnp.diagonal(contacts.delassus), 1.0))
    scale = jax.lax.stop_gradient(jnp.where(scale < jnp.inf, scale, 1.0))
    both = (held[:, None] & held[None, :])[None]
    k = jnp.stack([w, contacts.delassus]) * jnp.outer(scale, scale)[None]
    eye = jnp.eye(len(held), dtype=w.dtype)[None]
    ridge = precision(w.dtype).eps ** _FAINT_RIDGE
    with_friction, without = determinants(jnp.where(both, k, eye) + ridge * eye)
    return with_friction / without


def rest_acceleration(dtype: jnp.dtype) -> float:
    """See `_REST_ACCELERATION`."""
    return not_rounding(_REST_ACCELERATION, dtype)


def _sizes(dragged: jax.Array, delassus: jax.Array, m: int) -> jax.Array:
    """Diagonal (k,) that scales forces at m contacts: without friction, as slip does not change it.

    Where a contact jams, that with friction: beside the other one it would be less than the ridge.
    """
    with_friction, without = jnp.diagonal(dragged), jnp.diagonal(delassus)
    sizes = jnp.where(with_friction < _JAMS * without, with_friction, without)
    # both rows of slip of a contact alike: else its share would depend on how they are turned
    rows = by_contact(sizes[m:], m)
    return jnp.concatenate([sizes[:m], jnp.repeat(rows.mean(axis=1), rows.shape[1])])


def _without_friction(w: jax.Array, right: jax.Array, held: jax.Array) -> jax.Array:
    """As `_least`; few contacts are taken not to be redundant."""
    if len(held) > _INDEPENDENT:
        return _least(w, right, held, jnp.ones_like(right[:, 0]), jnp.diagonal(w), _THIN_RIDGE)
    k = jnp.where(held[:, None] & held[None, :], w, jnp.eye(len(held), dtype=w.dtype))
    return solve_definite(k, jnp.where(held[:, None], right, 0.0))


def _least(
    w: jax.Array,
    right: jax.Array,
    held: jax.Array,
    weight: jax.Array,
    size: jax.Array,
    ridge: float = _RIDGE,
) -> jax.Array:
    """`w x = right` (k, columns) on the rows that are held; 0 elsewhere.

    Where that has many solutions, the one of least `sum size_j x_j^2 / weight_j` if w is symmetric.
    Derivatives take `size` for constant: it must not change with slip.
    """
    scale = jnp.where(held, 1 / jnp.sqrt(size), 1.0)
    scale = jax.lax.stop_gradient(jnp.where(scale < jnp.inf, scale, 1.0))
    both = held[:, None] & held[None, :]
    scaled = w * scale[:, None] * (scale * weight)[None]
    k = jnp.where(both, scaled, jnp.eye(len(held), dtype=w.dtype))
    right = jnp.where(held[:, None], right * scale[:, None], 0.0)
    ridges = jnp.where(held, ridge, 0.0)[:, None]
    z = regularized(k, right, ridges, _REFINEMENTS, without_null=True)
    return (scale * weight)[:, None] * z


def constraint_impulse(
    contacts: Contacts, mu: jax.Array | None, modes: Modes, rates: jax.Array
) -> jax.Array:
    """Impulses p that take `rates` to 0 where the modes hold them, the least ones.

    Rates and impulses are (k,) or (k, columns); of normals alone, rates may have m rows.
    `contacts.moved @ p` is the change of velocity; of position, if `rates` are gaps (first order).
    """
    friction = contacts.tangent is not None and mu is not None
    size = rates.shape[0]
    held = held_rows(modes, size if friction else len(modes.active))[:size]
    w, columns = contacts.delassus[:size, :size], rates.reshape(size, -1)
    if friction:
        p = _least(w, -columns, held, jnp.ones_like(columns[:, 0]), jnp.diagonal(w))
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
        powers = result.tangential * contacts.tangent.rate
        friction = by_contact(powers, len(result.normal)).sum(axis=1)
        push = push + contacts.tangent.gradient @ result.tangential
    carried = base_velocity(system, t)
    return friction, jnp.zeros_like(t) if carried is None else push @ carried


def slip_margins(
    contacts: Contacts,
    mu: jax.Array,
    modes: Modes,
    force: Forces,
    lasts: jax.Array,
    speed_scale: jax.Array,
) -> jax.Array:
    """What must stay positive (m,) of contacts that slide, in space along the first of their rows.

    Slip times what `lasts` of the regularity of the forces. Where slip begins, accelerations: that
    ends where slip grows faster or falls back to 0, or where the contact leans aside.
    """
    m = len(mu)
    assert contacts.tangent is not None
    assert force.tangential is not None
    slip = by_contact(contacts.tangent.rate, m)[:, 0]
    if not in_space(contacts):
        slip = modes.sign * slip
    ends = slip * jnp.where(slip < 0, jnp.abs(lasts), lasts)
    if not in_space(contacts):
        return ends
    both = jnp.concatenate([force.normal, force.tangential])
    growth = by_contact((contacts.approach + contacts.delassus @ both)[m:], m)[:, 0]
    by_friction = friction_acceleration(contacts, mu, force.normal)
    some = speed_scale > 0
    falls = by_friction * slip / jnp.where(some, speed_scale, 1.0) + jnp.maximum(growth, 0.0)
    across = by_contact(force.tangential, m)[:, 1] / jnp.where(force.normal > 0, force.normal, 1.0)
    aside = by_friction - jnp.abs(across) * by_friction / (_LEANING * jnp.where(mu > 0, mu, 1.0))
    faster = slip_begins(contacts, mu, force.normal, growth)
    return jnp.where(modes.sign == BEGINS, jnp.minimum(jnp.minimum(falls, faster), aside), ends)


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
    slip_began = jnp.any(before.active & ~before.stick & (before.sign == BEGINS))
    asked = _ModeQuestion(contacts, mu, touching, released, sliding, slip_began, slack)
    now, direction_now = _expected(asked, before)
    no, one = jnp.asarray(False), jnp.ones_like(slack)
    start = _ModeTrial(now, direction_now, touching, one, no, no, no, jnp.asarray(0))
    end = jax.lax.while_loop(
        lambda tried: ~tried.done & (tried.passes < _PASSES),
        lambda tried: _next_trial(asked, tried),
        start,
    )
    parts, several = touching & ~end.allowed, end.several & end.solved
    return ModeChoice(end.modes, end.solved, end.regularity, several, parts)


class _ModeQuestion(NamedTuple):
    """What `choose_with_friction` is asked, without derivatives."""

    contacts: Contacts
    mu: jax.Array
    touching: jax.Array  # (m,)
    released: jax.Array  # (2 m,)
    sliding: jax.Array  # (m,)
    slip_began: jax.Array  # () slip that only began before: now it slides or sticks, nothing begins
    slack: jax.Array

    @property
    def sticking_modes(self) -> Modes:
        """What touches and does not slide sticks."""
        ones = jnp.ones(len(self.mu), self.mu.dtype)
        return Modes(self.touching, self.touching & ~self.sliding, ones)


class _ModeTrial(NamedTuple):
    """One try of `choose_with_friction`."""

    modes: Modes
    known: jax.Array  # (m, rows) directions of slip that are fixed, 0 where they are solved for
    allowed: jax.Array  # (m,) contacts that may be pressed
    regularity: jax.Array
    several: jax.Array
    solved: jax.Array
    done: jax.Array
    passes: jax.Array


def _expected(asked: _ModeQuestion, before: Modes) -> tuple[Modes, jax.Array]:
    """Modes as they were but for what has let go; directions (m, rows) of slip that is known."""
    contacts, mu, touching, released, sliding, _, slack = asked
    assert contacts.tangent is not None
    m, spatial = len(mu), in_space(contacts)
    slid = before.active & ~before.stick
    broken = released[m:] & before.stick & ~sliding
    ended = jnp.any(released[m:] & slid)
    # where sticking breaks at one contact of a body, those that began to slide before go on
    goes_on = slid & jnp.any(released[m:] & before.stick) & ~ended & ~sliding
    starts = broken | goes_on if spatial else broken  # in space directions are not remembered
    now = Modes(touching, ~sliding & (starts | ~goes_on), jnp.where(goes_on, before.sign, 0.0))
    moves = direction(by_contact(contacts.tangent.rate, m))
    slides = jnp.where(sliding[:, None], moves, 0.0 if spatial else now.sign[:, None])
    # sliding begins against the last force of sticking
    held_on = now._replace(active=touching & ~released[:m])
    tries = jax.tree.map(lambda *x: jnp.stack(x), held_on, asked.sticking_modes)
    both = jax.lax.map(lambda modes: forces(contacts, mu, modes, slides), tries)
    held, stuck = (jax.tree.map(lambda x, i=i: x[i], both) for i in (0, 1))
    assert held.tangential is not None
    against = by_contact(held.tangential, m)
    against = -direction(against) if spatial else jnp.where(against > 0, -1.0, 1.0)
    if spatial:  # redundant contacts that share equally break loose together
        at_rim = (
            before.active & before.stick & ~sliding & (cone_margins(contacts, mu, stuck) <= slack)
        )
        starts = starts | (at_rim & jnp.any(broken))
    return now, jnp.where(starts[:, None], against, slides)


def _next_trial(asked: _ModeQuestion, tried: _ModeTrial) -> _ModeTrial:
    """Modes by a complementarity problem, and what the next try must change."""
    contacts, mu, touching, released, sliding, slip_began, slack = asked
    m, known = len(mu), tried.known
    dtype, diagonal = known.dtype, jnp.diagonal(contacts.delassus)[:m]
    rows = jnp.concatenate([tried.allowed, jnp.repeat(tried.allowed, known.shape[1])])
    eye = jnp.eye(len(rows), dtype=dtype)
    w = jnp.where(rows[:, None] & rows[None], contacts.delassus, eye)
    free = jnp.where(rows, contacts.approach, 0.0)
    solution = solve(
        w, free[:m], free[m:], mu * jnp.ones(m, dtype), complementary=True,
        sliding=known.reshape(-1),
    )  # fmt: skip
    rate = contacts.approach + contacts.delassus @ jnp.concatenate(
        [solution.normal, solution.tangential]
    )
    turns, is_known = by_contact(rate[m:], m), length(known) > 0
    active = tried.allowed & (rate[:m] <= slack)
    active = active & (~released[:m] | (solution.normal * diagonal > slack))
    slips = is_known | (length(turns) > slack)
    slide = jnp.where(is_known[:, None], known, direction(turns))
    sign = slide[:, 0]
    if in_space(contacts):
        growth = jnp.sum(turns * slide, axis=1)
        slow = slip_begins(contacts, mu, solution.normal, growth) > 0
        sign = jnp.where(slow & ~sliding & ~slip_began, float(BEGINS), 1.0)
    modes = Modes(active, active & ~slips, sign)
    # what was taken to slide from rest must do so
    returns = active & is_known & ~sliding & (jnp.sum(known * turns, axis=1) < -slack)
    several = solution.status == CODE["several_outcomes"]
    solved = solution.status <= CODE["several_outcomes"]
    given = jnp.where(solved, returns, ~sliding)[:, None]
    # what would go on sliding though it cannot parts, where that is a solution, too
    pressed = jnp.where(solved, active, tried.allowed)
    pressing = modes._replace(active=pressed, stick=pressed & ~slips)
    regular = regularity(contacts, mu, pressing, slide)
    # twice: flights end at once it
    wedged = active & slips & (regular <= 2 * precision(dtype).root)
    open_ones_part = jnp.all(~touching | tried.allowed | (rate[:m] >= -slack))
    return _ModeTrial(
        modes,
        jnp.where(given, 0.0, known),
        tried.allowed & ~(wedged & several),
        regular,
        several | tried.several,
        solved & open_ones_part & ~jnp.any(wedged),
        solved & open_ones_part & ~jnp.any(wedged | returns),
        tried.passes + 1,
    )


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
