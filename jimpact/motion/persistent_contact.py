"""Persistent contact: its modes (open, sliding, sticking), and the forces that keep
them.

The modes are frozen between events, so that forces are one linear solve: `rate' = 0` at
every active contact, and at sticking ones tangentially, too;
`lambda_t = -mu lambda_n d` at sliding ones, in the direction d of slip. Which modes
hold after an event is decided by complementarity of forces and accelerations. A contact
in space has two rows of slip where one in the plane has one.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

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
from jimpact.tools.masks import quotient
from jimpact.tools.precision import precision
from jimpact.tools.status import CODE

# Beside a matrix with unit diagonal: it decides where that is singular (redundant
# contacts that stick), and refinements remove what it changes elsewhere. Much less, and
# rounding decides, too.
_RIDGE = 1e-7
_REFINEMENTS = 3
# Part of its diagonal entry that friction leaves a contact which is about to jam. Ten
# times more: redundant contacts share by their slip, which derivatives do not see; ten
# times less: the ridge is felt for longer.
_JAMS = 1e-2
# Without friction masses may differ by as much as rounding lets them; how redundant
# contacts share the load may err by rounding over this.
_THIN_RIDGE = 1e-9
# frictionless contacts that are taken not to be redundant: legs of a table
_INDEPENDENT = 3
# of the pressing force: keeps the weights of contacts without load regular
_LEAST_SHARE = 1e-3
# Contacts with |lambda_n| and |rate'| below this share of the largest gap acceleration
# of the motion stay together: bodies that move side by side press on each other by
# rounding only.
_REST_ACCELERATION = 1e-11
BEGINS = 2  # `Modes.sign` of a contact in space whose slip begins
# Slip in space that grows from rest slower than this part of what friction changes it
# by only begins: see `slip_in_space.py`. Ten times more: errors a thousand times as
# large, steps a tenth.
_BEGINNING = 2e-3
# Part of the cone that may hold a contact across its slip, as long as that begins. Ten
# times more: the contact may be held by all of it.
_LEANING = 0.1
_PASSES = 3  # choices: contacts whose slip contradicts their choice are re-evaluated
# A power of rounding: a ridge that redundant contacts need to share their forces. Ten
# times more would be seen in the forces.
_FAINT_RIDGE = 3 / 4


class Modes(NamedTuple):
    """Mode of each contact: open, or persistent and sticking or sliding.

    `sign` is that of the slip in the plane, -1, 0 or 1. In space, where
    `slip_in_space.py` has the directions, it is 1 of contacts that slide, and `BEGINS`
    of those that begin to.
    """

    active: Bool[Array, " m"]  # persistent: gap and gap velocity stay 0
    stick: Bool[Array, " m"]  # the slip stays 0, too
    sign: Float[Array, " m"]


class Contacts(NamedTuple):
    """Contact space at one instant: normals first, then tangents where there is
    friction.
    """

    normal: Kinematics
    tangent: Kinematics | None
    directions: Float[Array, "n k"]  # [N, H]
    moved: Float[Array, "n k"]  # M^-1 [N, H]
    delassus: Float[Array, "k k"]  # W = [N, H]^T M^-1 [N, H]
    free: Float[Array, " n"]  # v' without contact forces
    # gap and slip accelerations without contact forces [m/s^2]
    approach: Float[Array, " k"]


class Forces(NamedTuple):
    """Contact forces lambda [N], and the acceleration v' with them."""

    normal: Float[Array, " m"]
    tangential: Float[Array, " t"] | None
    acceleration: Float[Array, " n"]


def no_modes(m: int, dtype: jnp.dtype) -> Modes:
    """Modes of m open contacts."""
    none = jnp.zeros(m, bool)
    return Modes(none, none, jnp.zeros(m, dtype))


def by_contact(rows: Float[Array, " t"], m: int) -> Float[Array, "m r"]:
    """Tangential rows (t,) by contact (m, r): r = 1 in the plane, 2 in space."""
    return rows.reshape(m, -1)


def length(rows: Float[Array, "m r"]) -> Float[Array, " m"]:
    """Lengths |u_j| of the vectors u (m, r), with derivative 0 at u_j = 0."""
    if rows.shape[1] == 1:
        return jnp.abs(rows[:, 0])
    square = jnp.sum(rows**2, axis=1)
    positive = jnp.where(square > 0, square, 1.0)
    return jnp.where(square > 0, jnp.sqrt(positive), 0.0)


def direction(rows: Float[Array, "m r"]) -> Float[Array, "m r"]:
    """Unit vectors u_j / |u_j| of u (m, r), 0 where u_j = 0."""
    if rows.shape[1] == 1:
        return jnp.sign(rows)
    size = length(rows)[:, None]
    return quotient(rows, size, where=size > 0)


def in_space(contacts: Contacts) -> bool:
    """True where each contact has two tangents."""
    tangent = contacts.tangent
    contact_count = len(contacts.normal.rate)
    return tangent is not None and len(tangent.rate) == 2 * contact_count


def held_rows(modes: Modes, size: int) -> Bool[Array, " size"]:
    """True in rows of contact space whose acceleration the modes hold at 0, the first
    `size` rows.

    Normal rows of persistent contacts, tangential ones of those that stick. In space
    the first row of a contact is along its slip, the second one across it: where slip
    begins the latter is held.
    """
    m = modes.active.shape[0]
    stick = modes.active & modes.stick
    if size == m:
        return modes.active
    if size == 2 * m:
        return jnp.concatenate([modes.active, stick])
    across = stick | (modes.active & (modes.sign == BEGINS))
    tangential = jnp.stack([stick, across], axis=1)
    return jnp.concatenate([modes.active, tangential.reshape(-1)])


def contacts_at(
    system: System,
    q: Float[Array, " nq"],
    v: Float[Array, " n"],
    t: Float[Array, ""],
    friction: bool,
    along: Float[Array, "m 2"] | None = None,
) -> Contacts:
    """Contact space at (q, v, t): W = D^T M^-1 D and D^T v' + drift of the directions D
    = [N, H].

    In space, with `along`, tangents are turned: the first one of each contact is along
    this unit vector in its plane of contact.
    """
    mass = mass_at(system, q)
    normal, tangent = kinematics(system, q, v, t, friction)
    directions = normal.gradient
    drift = normal.drift
    if tangent is not None and along is not None:
        tangent = _turned(tangent, along)
    if tangent is not None:
        directions = jnp.concatenate([directions, tangent.gradient], axis=1)
        drift = jnp.concatenate([drift, tangent.drift])
    moved = solve_mass_matrix(mass, directions)
    push = user_force(system, q, v, t)
    free = free_acceleration(system, q, v, push, mass)
    delassus = directions.T @ moved
    approach = directions.T @ free + drift
    return Contacts(normal, tangent, directions, moved, delassus, free, approach)


def with_normal_forces(contacts: Contacts, push: Float[Array, " m"]) -> Contacts:
    """Contact space in which normal forces are `push` [N], whatever friction does.

    Normal rows become `W_jj (lambda_j - push_j) = 0`, without coupling to tangential
    forces; tangential ones have `W_tn push` in their accelerations.
    """
    m = len(push)
    size = jnp.diagonal(contacts.delassus)[:m]
    without_columns = contacts.delassus.at[:, :m].set(0.0)
    w = without_columns.at[:m].set(0.0)
    pushed = contacts.approach + contacts.delassus[:, :m] @ push
    delassus = w.at[:m, :m].set(jnp.diag(size))
    approach = pushed.at[:m].set(-size * push)
    return contacts._replace(delassus=delassus, approach=approach)


def slip_frames(along: Float[Array, "m 2"]) -> Float[Array, "m 2 2"]:
    """Axes (m, axis, component) in each plane of contact: `along`, and at right angles
    to it.
    """
    x, y = along.T
    across = jnp.stack([-y, x], axis=1)
    return jnp.stack([along, across], axis=1)


def _turned(tangent: Kinematics, along: Float[Array, "m 2"]) -> Kinematics:
    """Kinematics along tangents of which the first is `along`, the second at right
    angles.
    """
    axes = slip_frames(along)

    def turned(rows: Float[Array, "*n t"]) -> Float[Array, "*n t"]:
        """Components of (.., 2 m) along the axes of each contact."""
        each = rows.reshape(*rows.shape[:-1], -1, 2)
        return jnp.einsum("...mk,mjk->...mj", each, axes).reshape(rows.shape)

    return Kinematics(*(turned(x) for x in tangent))


def friction_acceleration(
    contacts: Contacts, mu: Float[Array, " m"], normal: Float[Array, " m"]
) -> Float[Array, " m"]:
    """Slip acceleration `mu lambda_n W_tt` [m/s^2] that friction can give each contact
    itself.

    `normal` are forces lambda_n [N]; W_tt is the mean over the tangents of the contact.
    """
    m = len(mu)
    w = jnp.diagonal(contacts.delassus)[m:]
    return mu * normal * by_contact(w, m).mean(axis=1)


def cone_margins(
    contacts: Contacts, mu: Float[Array, " m"], force: Forces
) -> Float[Array, " m"]:
    """Distances `(mu lambda_n - |lambda_t|) W_tt` from the rim of the friction cone
    [m/s^2].
    """
    assert force.tangential is not None
    m = len(mu)
    w = jnp.diagonal(contacts.delassus)[m:]
    sizes = by_contact(w, m).mean(axis=1)
    drag = length(by_contact(force.tangential, m))
    return (mu * force.normal - drag) * sizes


def slip_begins(
    contacts: Contacts,
    mu: Float[Array, " m"],
    normal: Float[Array, " m"],
    growth: Float[Array, " m"],
) -> Float[Array, " m"]:
    """Margins `_BEGINNING mu lambda_n W_tt - growth` [m/s^2]: slip begins while they
    are positive.

    `normal` are forces [N], `growth` is the acceleration of the slip [m/s^2].
    """
    return _BEGINNING * friction_acceleration(contacts, mu, normal) - growth


def forces(
    contacts: Contacts,
    mu: Float[Array, " m"] | None,
    modes: Modes,
    slip: Float[Array, "m r"] | None = None,
) -> Forces:
    """The contact forces that keep the modes, and the acceleration v' with them.

    Equation: `W lambda + approach = 0` in the rows that the modes hold (`held_rows`),
    `lambda_t = -mu lambda_n d` at contacts that slide (`drag` is mu d), lambda = 0 at
    open ones. Redundant contacts that stick share tangential forces in proportion to
    mu lambda_n, as in `numerics/friction.py`: they break loose together.

    `slip`: directions d, unit vectors; None: in the plane, `modes.sign`.
    """
    m = contacts.normal.value.shape[0]
    if contacts.tangent is None or mu is None:
        approach = contacts.approach[:, None]
        normal = _without_friction(contacts.delassus, -approach, modes.active)[:, 0]
        return Forces(normal, None, contacts.free + contacts.moved @ normal)
    w, held, drag = _dragged(contacts, mu, modes, slip)
    right = -contacts.approach

    def shared(_: Int[Array, ""], known: Float[Array, " k"]) -> Float[Array, " k"]:
        """Forces of held rows; redundant sticking contacts share what they hold in
        proportion to mu lambda_n of the last pass, equally where that is 0.
        """
        last_push = jax.lax.stop_gradient(known[:m])
        press = mu * jnp.maximum(last_push, 0.0)
        share = jnp.repeat(load_shares(press, _LEAST_SHARE), drag.shape[1])
        weight = jnp.concatenate([jnp.ones(m, w.dtype), share])
        sizes = _sizes(w, contacts.delassus, m)
        return _least(w, right[:, None], held, weight, sizes)[:, 0]

    # first equal shares, then those by the normal forces that these give
    held_forces = jax.lax.fori_loop(0, 2, shared, jnp.zeros_like(right))
    sliding_forces = -(drag * held_forces[:m, None]).reshape(-1)
    every_force = held_forces.at[m:].add(sliding_forces)
    acceleration = contacts.free + contacts.moved @ every_force
    return Forces(every_force[:m], every_force[m:], acceleration)


def _dragged(
    contacts: Contacts,
    mu: Float[Array, " m"],
    modes: Modes,
    slip: Float[Array, "m r"] | None,
) -> tuple[Float[Array, "k k"], Bool[Array, " k"], Float[Array, "m r"]]:
    """Delassus matrix with sliding friction, held rows (k,), and
    `drag = -lambda_t / lambda_n`.

    Equation: the normal force of a contact that slides brings
    `lambda_t = -mu lambda_n d`: its column of the matrix is `W_n - sum_r W_t mu d`.
    `drag` is mu d where it slides, else 0.
    """
    m = modes.active.shape[0]
    k = contacts.delassus.shape[0]
    slides = (modes.active & ~modes.stick)[:, None]
    if slip is None:
        along = modes.sign[:, None]
    else:
        along = slip
    drag = jnp.where(slides, along * mu[:, None], 0.0)
    dragged = contacts.delassus[:, m:] * drag.reshape(-1)[None]
    pull = dragged.reshape(k, m, -1).sum(axis=2)
    w = contacts.delassus.at[:, :m].add(-pull)
    return w, held_rows(modes, k), drag


def regularity(
    contacts: Contacts,
    mu: Float[Array, " m"],
    modes: Modes,
    slip: Float[Array, "m r"] | None = None,
) -> Float[Array, ""]:
    """Determinant of the held rows of `_dragged`, divided by that of W: 1 without
    sliding friction.

    Of one contact `1 - mu s W_nt / W_nn`, with s the sign of slip. Where it has fallen
    to 0 forces that keep the modes do not exist, or elastic contacts would not settle
    at them; below the root of rounding it counts as 0.
    """
    w, held, _ = _dragged(contacts, mu, modes, slip)
    size = jnp.where(held, jnp.diagonal(contacts.delassus), 1.0)
    scale = 1 / jnp.sqrt(size)
    finite = jnp.where(scale < jnp.inf, scale, 1.0)
    scale = jax.lax.stop_gradient(finite)
    both = (held[:, None] & held[None, :])[None]
    both_matrices = jnp.stack([w, contacts.delassus])
    k = both_matrices * jnp.outer(scale, scale)[None]
    eye = jnp.eye(len(held), dtype=w.dtype)[None]
    ridge = precision(w.dtype).eps ** _FAINT_RIDGE
    regular = jnp.where(both, k, eye) + ridge * eye
    with_friction, without = determinants(regular)
    return with_friction / without


def rest_acceleration(dtype: jnp.dtype) -> float:
    """`_REST_ACCELERATION`, in single precision a few roundings."""
    return not_rounding(_REST_ACCELERATION, dtype)


def _sizes(
    dragged: Float[Array, "k k"], delassus: Float[Array, "k k"], m: int
) -> Float[Array, " k"]:
    """Diagonal that scales the equations of `_least`: W_jj, which slip does not change.

    A contact about to jam has that with friction, `dragged`: it would be less than the
    ridge beside W_jj.
    """
    with_friction = jnp.diagonal(dragged)
    without = jnp.diagonal(delassus)
    sizes = jnp.where(with_friction < _JAMS * without, with_friction, without)
    # both rows of slip of a contact alike: else its share would depend on how they are
    # turned
    rows = by_contact(sizes[m:], m)
    by_mean = jnp.repeat(rows.mean(axis=1), rows.shape[1])
    return jnp.concatenate([sizes[:m], by_mean])


def _without_friction(
    w: Float[Array, "k k"], right: Float[Array, "k c"], held: Bool[Array, " k"]
) -> Float[Array, "k c"]:
    """Solution x of `w x = right` on held rows, 0 elsewhere; w is symmetric.

    Up to `_INDEPENDENT` contacts are taken not to be redundant and solved directly,
    others by `_least`.
    """
    if len(held) > _INDEPENDENT:
        one = jnp.ones_like(right[:, 0])
        return _least(w, right, held, one, jnp.diagonal(w), _THIN_RIDGE)
    both = held[:, None] & held[None, :]
    k = jnp.where(both, w, jnp.eye(len(held), dtype=w.dtype))
    of_held = jnp.where(held[:, None], right, 0.0)
    return solve_definite(k, of_held)


def _least(
    w: Float[Array, "k k"],
    right: Float[Array, "k c"],
    held: Bool[Array, " k"],
    weight: Float[Array, " k"],
    size: Float[Array, " k"],
    ridge: float = _RIDGE,
) -> Float[Array, "k c"]:
    """Solution x (k, c) of `w x = right` on the rows that are held; 0 elsewhere.

    Where that has many solutions, the one of least `sum size_j x_j^2 / weight_j` if w
    is symmetric: by a `ridge` beside the matrix scaled to unit diagonal, whose effect
    refinements remove. Derivatives take `size` for constant: it must not change with
    slip.
    """
    scale = jnp.where(held, 1 / jnp.sqrt(size), 1.0)
    finite = jnp.where(scale < jnp.inf, scale, 1.0)
    scale = jax.lax.stop_gradient(finite)
    both = held[:, None] & held[None, :]
    scaled = w * scale[:, None] * (scale * weight)[None]
    eye = jnp.eye(len(held), dtype=w.dtype)
    k = jnp.where(both, scaled, eye)
    scaled_right = right * scale[:, None]
    right = jnp.where(held[:, None], scaled_right, 0.0)
    ridges = jnp.where(held, ridge, 0.0)[:, None]
    z = regularized(k, right, ridges, _REFINEMENTS, without_null=True)
    return (scale * weight)[:, None] * z


def constraint_impulse(
    contacts: Contacts,
    mu: Float[Array, " m"] | None,
    modes: Modes,
    rates: Float[Array, "rows ..."],
) -> Float[Array, "k ..."]:
    """Impulses p that bring `rates` to 0: `W p = -rates` in held rows, the least ones.

    Rates have k rows, or m of normals alone; impulses have k. `contacts.moved @ p` is
    the change of velocity, or of position where `rates` are gaps (to first order).
    """
    friction = contacts.tangent is not None and mu is not None
    size = rates.shape[0]
    held = held_rows(modes, size if friction else len(modes.active))[:size]
    w = contacts.delassus[:size, :size]
    columns = rates.reshape(size, -1)
    if friction:
        one = jnp.ones_like(columns[:, 0])
        p = _least(w, -columns, held, one, jnp.diagonal(w))
    else:
        p = _without_friction(w, -columns, held)
    rest = contacts.delassus.shape[0] - size
    padding = ((0, rest),) + ((0, 0),) * (rates.ndim - 1)
    return jnp.pad(p.reshape(rates.shape), padding)


def contact_powers(
    system: System, contacts: Contacts, result: Forces, t: Float[Array, ""]
) -> tuple[Float[Array, " m"], Float[Array, ""]]:
    """Power of friction at every contact `lambda_t . u` and of the base [W].

    The base moves the contact forces: `(N lambda_n + H lambda_t) . B y_b'`.
    """
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
    mu: Float[Array, " m"],
    modes: Modes,
    force: Forces,
    lasts: Float[Array, ""],
    speed_scale: Float[Array, ""],
) -> Float[Array, " m"]:
    """Margins that are positive while a contact slides: `u_1 lasts`, slip times
    `regularity`.

    u_1 is the slip along its direction, in space the first tangential row; `lasts` is
    what is left of `regularity` above its bound. Where slip only begins (`BEGINS`),
    with its growth u_1' and `c = mu lambda_n W_tt`, the least of three accelerations
    [m/s^2]; that mode ends where

    - slip falls back to 0: `c u_1 / speed_scale + max(u_1', 0)`;
    - it grows faster: `_BEGINNING c - u_1'`;
    - the contact leans aside: `c (1 - |lambda_t2| / (_LEANING mu lambda_n))`, lambda_t2
      the force across the slip.
    """
    m = len(mu)
    assert contacts.tangent is not None
    assert force.tangential is not None
    slip = by_contact(contacts.tangent.rate, m)[:, 0]
    if not in_space(contacts):
        slip = modes.sign * slip
    duration = jnp.where(slip < 0, jnp.abs(lasts), lasts)
    ends = slip * duration
    if not in_space(contacts):
        return ends
    both = jnp.concatenate([force.normal, force.tangential])
    acceleration = contacts.approach + contacts.delassus @ both
    growth = by_contact(acceleration[m:], m)[:, 0]
    by_friction = friction_acceleration(contacts, mu, force.normal)
    some = speed_scale > 0
    relative = by_friction * slip / jnp.where(some, speed_scale, 1.0)
    falls = relative + jnp.maximum(growth, 0.0)
    push = jnp.where(force.normal > 0, force.normal, 1.0)
    across = by_contact(force.tangential, m)[:, 1] / push
    leaning = _LEANING * jnp.where(mu > 0, mu, 1.0)
    aside = by_friction - jnp.abs(across) * by_friction / leaning
    faster = slip_begins(contacts, mu, force.normal, growth)
    begins = jnp.minimum(jnp.minimum(falls, faster), aside)
    return jnp.where(modes.sign == BEGINS, begins, ends)


class ModeChoice(NamedTuple):
    """Modes of the contacts after an event, as complementarity of forces and
    accelerations asks.

    Of several solutions that one is taken which sticks most. But a contact does not go
    on sliding where elastic contacts would not settle at such forces (see
    `regularity`): it parts.
    """

    modes: Modes
    consistent: Bool[
        Array, ""
    ]  # the modes solve the problem; with friction it may have no solution
    regularity: Float[Array, ""]  # of the modes
    several: Bool[Array, ""]  # the problem has several solutions
    parts: Bool[Array, " m"]  # touching contacts that are taken to open


def choose_with_friction(
    contacts: Contacts,
    mu: Float[Array, " m"],
    before: Modes,
    touching: Bool[Array, " m"],
    released: Bool[Array, " 2*m"],
    sliding: Bool[Array, " m"],
    slack: Float[Array, ""],
) -> ModeChoice:
    """Modes of the contacts that touch at rest, with Coulomb's friction.

    Equation: `a = W lambda + approach`, `0 <= a_n _|_ lambda_n >= 0`, and tangentially
    `lambda_t = -mu lambda_n u / |u|` where a contact slides, elsewhere
    `|lambda_t| <= mu lambda_n` with `lambda_t = -mu lambda_n a_t / |a_t|` where slip
    starts. Up to `_PASSES` problems are solved: a contact whose slip contradicts the
    direction assumed for it is left free in the next.

    Args:
        contacts: contact space.
        mu: coefficients of friction.
        before: modes up to now.
        touching: gap and gap velocity are 0.
        released: (2 m,) normal, then tangential constraints that have just ended: they
            hold again only with a force, not by rounding.
        sliding: the slip is not 0.
        slack: gap accelerations [m/s^2] below it are rounding.
    """
    contacts, mu = jax.lax.stop_gradient((contacts, mu))
    assert contacts.tangent is not None
    slid = before.active & ~before.stick
    slip_began = jnp.any(slid & (before.sign == BEGINS))
    problem = _ModeProblem(contacts, mu, touching, released, sliding, slip_began, slack)
    expected, directions = _expected_modes(problem, before)
    no = jnp.asarray(False)
    one = jnp.ones_like(slack)
    passes = jnp.asarray(0)
    start = _ModeTrial(expected, directions, touching, one, no, no, no, passes)
    end = jax.lax.while_loop(
        lambda trial: ~trial.done & (trial.passes < _PASSES),
        lambda trial: _next_trial(problem, trial),
        start,
    )
    parts = touching & ~end.may_press
    several = end.several & end.solved
    return ModeChoice(end.modes, end.solved, end.regularity, several, parts)


class _ModeProblem(NamedTuple):
    """Data of the problem of `choose_with_friction`, without derivatives; see its
    arguments.
    """

    contacts: Contacts
    mu: Float[Array, " m"]
    touching: Bool[Array, " m"]
    released: Bool[Array, " 2*m"]
    sliding: Bool[Array, " m"]
    # a contact had mode BEGINS: now it slides or sticks, and no other one gets that
    # mode
    slip_began: Bool[Array, ""]
    slack: Float[Array, ""]

    @property
    def sticking_modes(self) -> Modes:
        """Modes in which all touching contacts are persistent, and stick unless they
        slide.
        """
        ones = jnp.ones(len(self.mu), self.mu.dtype)
        return Modes(self.touching, self.touching & ~self.sliding, ones)


class _ModeTrial(NamedTuple):
    """Solution of one complementarity problem of `choose_with_friction`."""

    modes: Modes
    # directions of slip that are assumed, 0 where they are solved for
    known: Float[Array, "m r"]
    may_press: Bool[Array, " m"]  # contacts that take part; others are taken to open
    regularity: Float[Array, ""]
    several: Bool[Array, ""]
    solved: Bool[Array, ""]
    done: Bool[Array, ""]  # solved, and no assumed direction is contradicted
    passes: Int[Array, ""]


def _expected_modes(
    problem: _ModeProblem, before: Modes
) -> tuple[Modes, Float[Array, "m r"]]:
    """Modes to try first: as before, but for constraints that ended; directions of
    known slip.

    The direction of a contact that slides is that of its slip u; slip starts against
    the last force of sticking, `-lambda_t / |lambda_t|`; 0 where the direction is to be
    solved for.
    """
    contacts, mu, touching, released, sliding, _, slack = problem
    assert contacts.tangent is not None
    m = len(mu)
    spatial = in_space(contacts)
    slid = before.active & ~before.stick
    # friction has reached the cone: slip starts
    broken = released[m:] & before.stick & ~sliding
    ended = jnp.any(released[m:] & slid)  # slip of a contact has come to 0
    # where sticking breaks at one contact of a body, those that began to slide before
    # go on
    one_broke = jnp.any(released[m:] & before.stick)
    goes_on = slid & one_broke & ~ended & ~sliding
    # in space directions are not remembered
    if spatial:
        starts = broken | goes_on
    else:
        starts = broken
    stick = ~sliding & (starts | ~goes_on)
    sign = jnp.where(goes_on, before.sign, 0.0)
    now = Modes(touching, stick, sign)
    moves = direction(by_contact(contacts.tangent.rate, m))
    slides = jnp.where(sliding[:, None], moves, 0.0 if spatial else now.sign[:, None])
    # sliding begins against the last force of sticking
    held_on = now._replace(active=touching & ~released[:m])
    # one evaluation of forces for both modes, so that it is compiled once
    two_modes = jax.tree.map(lambda *x: jnp.stack(x), held_on, problem.sticking_modes)
    both = jax.lax.map(lambda modes: forces(contacts, mu, modes, slides), two_modes)
    held, stuck = (jax.tree.map(lambda x, i=i: x[i], both) for i in (0, 1))
    assert held.tangential is not None
    against = by_contact(held.tangential, m)
    if spatial:
        against = -direction(against)
    else:
        against = jnp.where(against > 0, -1.0, 1.0)
    if spatial:  # redundant contacts that share equally break loose together
        rim = cone_margins(contacts, mu, stuck) <= slack
        at_rim = before.active & before.stick & ~sliding & rim
        starts = starts | (at_rim & jnp.any(broken))
    return now, jnp.where(starts[:, None], against, slides)


def _next_trial(problem: _ModeProblem, last: _ModeTrial) -> _ModeTrial:
    """Modes by the problem of `choose_with_friction`, with directions and contacts of
    `last`.

    Of what it contradicts the next trial is free: assumed directions against which slip
    starts, and a contact that would slide although its forces are singular (it is
    wedged) where another solution exists.
    """
    contacts, mu, touching, released, sliding, slip_began, slack = problem
    m = len(mu)
    known = last.known
    dtype = known.dtype
    diagonal = jnp.diagonal(contacts.delassus)[:m]
    # rows of contacts that take part: normals (m), then their tangents; others get
    # lambda = 0
    tangents = jnp.repeat(last.may_press, known.shape[1])
    rows = jnp.concatenate([last.may_press, tangents])
    eye = jnp.eye(len(rows), dtype=dtype)
    both = rows[:, None] & rows[None]
    w = jnp.where(both, contacts.delassus, eye)
    free = jnp.where(rows, contacts.approach, 0.0)
    solution = solve(
        w,
        free[:m],
        free[m:],
        mu * jnp.ones(m, dtype),
        complementary=True,
        sliding=known.reshape(-1),
    )
    every_force = jnp.concatenate([solution.normal, solution.tangential])
    acceleration = contacts.approach + contacts.delassus @ every_force
    # (m, r) of the slip
    along = by_contact(acceleration[m:], m)
    is_known = length(known) > 0
    active = last.may_press & (acceleration[:m] <= slack)
    # what has just let go needs a force, as an acceleration, that is no rounding
    has_force = solution.normal * diagonal > slack
    active = active & (~released[:m] | has_force)
    slips = is_known | (length(along) > slack)
    slide = jnp.where(is_known[:, None], known, direction(along))
    sign = slide[:, 0]
    if in_space(contacts):
        growth = jnp.sum(along * slide, axis=1)
        slow = slip_begins(contacts, mu, solution.normal, growth) > 0
        from_rest = slow & ~sliding & ~slip_began
        sign = jnp.where(from_rest, float(BEGINS), 1.0)
    modes = Modes(active, active & ~slips, sign)
    # what was taken to slide from rest must do so
    backwards = jnp.sum(known * along, axis=1) < -slack
    returns = active & is_known & ~sliding & backwards
    several = solution.status == CODE["several_outcomes"]
    solved = solution.status <= CODE["several_outcomes"]
    free_again = jnp.where(solved, returns, ~sliding)[:, None]
    # what would go on sliding though it cannot parts, where that is a solution, too
    pressed = jnp.where(solved, active, last.may_press)
    pressing = modes._replace(active=pressed, stick=pressed & ~slips)
    regular = regularity(contacts, mu, pressing, slide)
    # flights end where the regularity falls to `root`: contacts are wedged from twice
    # that on
    wedged = active & slips & (regular <= 2 * precision(dtype).root)
    moves_apart = acceleration[:m] >= -slack
    open_ones_part = jnp.all(~touching | last.may_press | moves_apart)
    return _ModeTrial(
        modes=modes,
        known=jnp.where(free_again, 0.0, known),
        may_press=last.may_press & ~(wedged & several),
        regularity=regular,
        several=several | last.several,
        solved=solved & open_ones_part & ~jnp.any(wedged),
        done=solved & open_ones_part & ~jnp.any(wedged | returns),
        passes=last.passes + 1,
    )


class Pressed(NamedTuple):
    """Contacts that a frictionless contact problem presses together."""

    pressed: Bool[Array, " m"]  # lambda > 0
    kept_closed: Bool[Array, " m"]  # neither force nor gap acceleration
    force: Float[Array, " m"]  # lambda [N]


def pressed_together(
    contacts: Contacts, touching: Bool[Array, " m"], slack: Float[Array, ""]
) -> Pressed:
    """Normal forces of touching contacts: `0 <= lambda _|_ W lambda + approach >= 0`,
    no friction.

    Gap accelerations below `slack` [m/s^2] are rounding.
    """
    contacts = jax.lax.stop_gradient(contacts)
    m = touching.shape[0]
    w = contacts.delassus[:m, :m]
    b = jnp.where(touching, contacts.approach[:m], 0.0)
    both = touching[:, None] & touching[None, :]
    eye = jnp.eye(m, dtype=w.dtype)
    # redundant contacts: any of the solutions will do
    matrix = jnp.where(both, w, eye)
    solution = solve_lcp(matrix, b, regular=True)
    pressed = touching & (solution.z * jnp.diagonal(w) > slack)
    stays = touching & ~pressed & (solution.w <= slack)
    return Pressed(pressed, stays, solution.z)
