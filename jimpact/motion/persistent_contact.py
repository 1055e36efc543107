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
    unit,
    unit_outside,
)
from jimpact.numerics.friction import FrictionImpulses, solve
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
    sign = jnp.zeros(m, dtype)
    return Modes(none, none, sign)


def by_contact(rows: Float[Array, " t"], m: int) -> Float[Array, "m r"]:
    """Tangential rows (t,) by contact (m, r): r = 1 in the plane, 2 in space."""
    return rows.reshape(m, -1)


def length(rows: Float[Array, "m r"]) -> Float[Array, " m"]:
    """Lengths |u_j| of the vectors u (m, r), with derivative 0 at u_j = 0."""
    _, directions = rows.shape
    if directions == 1:
        return jnp.abs(rows[:, 0])
    square = jnp.sum(rows**2, axis=1)
    moves = square > 0
    positive = jnp.where(moves, square, 1.0)
    size = jnp.sqrt(positive)
    return jnp.where(moves, size, 0.0)


def direction(rows: Float[Array, "m r"]) -> Float[Array, "m r"]:
    """Unit vectors u_j / |u_j| of u (m, r), 0 where u_j = 0."""
    _, directions = rows.shape
    if directions == 1:
        return jnp.sign(rows)
    size = length(rows)
    size = size[:, None]
    return quotient(rows, size, where=size > 0)


def in_space(contacts: Contacts) -> bool:
    """True where each contact has two tangents."""
    tangent = contacts.tangent
    if tangent is None:
        return False
    m = len(contacts.normal.rate)
    return len(tangent.rate) == 2 * m


def held_rows(modes: Modes, size: int) -> Bool[Array, " size"]:
    """True in rows of contact space whose acceleration the modes hold at 0, the first
    `size` rows.

    Normal rows of persistent contacts, tangential ones of those that stick. In space
    the first row of a contact is along its slip, the second one across it: where slip
    begins the latter is held.
    """
    m = len(modes.active)
    stick = modes.active & modes.stick
    if size == m:
        return modes.active
    if size == 2 * m:
        return jnp.concatenate([modes.active, stick])
    begins = modes.sign == BEGINS
    across = stick | (modes.active & begins)
    tangential = jnp.stack([stick, across], axis=1)
    rows = tangential.reshape(-1)
    return jnp.concatenate([modes.active, rows])


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
    w = contacts.delassus
    size = jnp.diagonal(w)[:m]
    of_push = w[:, :m] @ push
    pushed = contacts.approach + of_push
    no_columns = w.at[:, :m].set(0.0)
    decoupled = no_columns.at[:m].set(0.0)
    delassus = decoupled.at[:m, :m].set(jnp.diag(size))
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
        split = rows.reshape(*rows.shape[:-1], -1, 2)
        along_axes = jnp.einsum("...mk,mjk->...mj", split, axes)
        return along_axes.reshape(rows.shape)

    return Kinematics(*map(turned, tangent))


def friction_acceleration(
    contacts: Contacts, mu: Float[Array, " m"], normal: Float[Array, " m"]
) -> Float[Array, " m"]:
    """Slip acceleration `mu lambda_n W_tt` [m/s^2] that friction can give each contact
    itself.

    `normal` are forces lambda_n [N]; W_tt is the mean over the tangents of the contact.
    """
    m = len(mu)
    w = jnp.diagonal(contacts.delassus)[m:]
    w_tt = by_contact(w, m).mean(axis=1)
    return mu * normal * w_tt


def cone_margins(
    contacts: Contacts, mu: Float[Array, " m"], force: Forces
) -> Float[Array, " m"]:
    """Distances `(mu lambda_n - |lambda_t|) W_tt` from the rim of the friction cone
    [m/s^2].
    """
    tangential = force.tangential
    assert tangential is not None
    m = len(mu)
    w = jnp.diagonal(contacts.delassus)[m:]
    w_tt = by_contact(w, m).mean(axis=1)
    drag = length(by_contact(tangential, m))
    left = mu * force.normal - drag
    return left * w_tt


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
    by_friction = friction_acceleration(contacts, mu, normal)
    return _BEGINNING * by_friction - growth


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
    m = len(contacts.normal.value)
    delassus = contacts.delassus
    if contacts.tangent is None or mu is None:
        approach = contacts.approach[:, None]
        solution = _without_friction(delassus, -approach, modes.active)
        normal = solution[:, 0]
        acceleration = contacts.free + contacts.moved @ normal
        return Forces(normal, None, acceleration)
    w, held, drag = _dragged(contacts, mu, modes, slip)
    _, directions = drag.shape
    right = -contacts.approach

    def shared(_: Int[Array, ""], known: Float[Array, " k"]) -> Float[Array, " k"]:
        """Forces of held rows; redundant sticking contacts share what they hold in
        proportion to mu lambda_n of the last pass, equally where that is 0.
        """
        last_push = jax.lax.stop_gradient(known[:m])
        press = mu * jnp.maximum(last_push, 0.0)
        share = load_shares(press, _LEAST_SHARE)
        of_tangents = jnp.repeat(share, directions)
        of_normals = jnp.ones(m, w.dtype)
        weight = jnp.concatenate([of_normals, of_tangents])
        sizes = _sizes(w, delassus, m)
        solution = _least(w, right[:, None], held, weight, sizes)
        return solution[:, 0]

    # first equal shares, then those by the normal forces that these give
    none = jnp.zeros_like(right)
    held_forces = jax.lax.fori_loop(0, 2, shared, none)
    friction = drag * held_forces[:m, None]
    sliding_forces = -friction.reshape(-1)
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
    delassus = contacts.delassus
    m = len(modes.active)
    k = len(delassus)
    sliding = modes.active & ~modes.stick
    slides = sliding[:, None]
    if slip is None:
        along = modes.sign[:, None]
    else:
        along = slip
    mu_d = along * mu[:, None]
    drag = jnp.where(slides, mu_d, 0.0)
    columns = delassus[:, m:] * drag.reshape(-1)[None]
    by_tangent = columns.reshape(k, m, -1)
    pull = by_tangent.sum(axis=2)
    w = delassus.at[:, :m].add(-pull)
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
    diagonal = jnp.diagonal(contacts.delassus)
    size = jnp.where(held, diagonal, 1.0)
    scale = _finite(1 / jnp.sqrt(size))
    both_matrices = jnp.stack([w, contacts.delassus])
    k = both_matrices * jnp.outer(scale, scale)[None]
    ridge = precision(w.dtype).eps ** _FAINT_RIDGE
    regular = jax.vmap(unit_outside, (0, None))(k, held) + ridge * unit(w)[None]
    with_friction, without = determinants(regular)
    return with_friction / without


def _finite(scale: Float[Array, " k"]) -> Float[Array, " k"]:
    """The scales, 1 where one is not finite, without derivatives."""
    some = scale < jnp.inf
    finite = jnp.where(some, scale, 1.0)
    return jax.lax.stop_gradient(finite)


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
    jams = with_friction < _JAMS * without
    sizes = jnp.where(jams, with_friction, without)
    # both rows of slip of a contact alike: else its share would depend on how they are
    # turned
    rows = by_contact(sizes[m:], m)
    _, directions = rows.shape
    means = rows.mean(axis=1)
    by_mean = jnp.repeat(means, directions)
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
        diagonal = jnp.diagonal(w)
        return _least(w, right, held, one, diagonal, _THIN_RIDGE)
    k = unit_outside(w, held)
    rows = held[:, None]
    of_held = jnp.where(rows, right, 0.0)
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
    rows = held[:, None]
    root = jnp.sqrt(size)
    scale = _finite(jnp.where(held, 1 / root, 1.0))
    weighted = scale * weight
    scaled = w * scale[:, None] * weighted[None]
    k = unit_outside(scaled, held)
    scaled_right = right * scale[:, None]
    right = jnp.where(rows, scaled_right, 0.0)
    ridges = jnp.where(held, ridge, 0.0)
    ridges = ridges[:, None]
    z = regularized(k, right, ridges, _REFINEMENTS, without_null=True)
    return weighted[:, None] * z


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
    size, *columns_of_rates = rates.shape
    w = contacts.delassus[:size, :size]
    columns = rates.reshape(size, -1)
    if contacts.tangent is None or mu is None:
        held = modes.active[:size]
        p = _without_friction(w, -columns, held)
    else:
        held = held_rows(modes, size)[:size]
        one = jnp.ones_like(columns[:, 0])
        diagonal = jnp.diagonal(w)
        p = _least(w, -columns, held, one, diagonal)
    p = p.reshape(rates.shape)
    others = len(contacts.delassus) - size
    after = (0, others)
    padding = [after, *((0, 0) for _ in columns_of_rates)]
    return jnp.pad(p, padding)


def contact_powers(
    system: System, contacts: Contacts, result: Forces, t: Float[Array, ""]
) -> tuple[Float[Array, " m"], Float[Array, ""]]:
    """Power of friction at every contact `lambda_t . u` and of the base [W].

    The base moves the contact forces: `(N lambda_n + H lambda_t) . B y_b'`.
    """
    tangential = result.tangential
    friction = jnp.zeros_like(result.normal)
    push = contacts.normal.gradient @ result.normal
    if contacts.tangent is not None and tangential is not None:
        m = len(result.normal)
        powers = tangential * contacts.tangent.rate
        friction = by_contact(powers, m).sum(axis=1)
        push = push + contacts.tangent.gradient @ tangential
    carried = base_velocity(system, t)
    if carried is None:
        return friction, jnp.zeros_like(t)
    return friction, push @ carried


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
    backwards = slip < 0
    duration = jnp.where(backwards, jnp.abs(lasts), lasts)
    ends = slip * duration
    if not in_space(contacts):
        return ends
    normal = force.normal
    all_forces = jnp.concatenate([normal, force.tangential])
    acceleration = contacts.approach + contacts.delassus @ all_forces
    growth = by_contact(acceleration[m:], m)[:, 0]
    c = friction_acceleration(contacts, mu, normal)
    some = speed_scale > 0
    scale = jnp.where(some, speed_scale, 1.0)
    relative = c * slip / scale
    falls = relative + jnp.maximum(growth, 0.0)
    pressed = normal > 0
    push = jnp.where(pressed, normal, 1.0)
    lambda_t2 = by_contact(force.tangential, m)[:, 1]
    across = lambda_t2 / push
    rubs = mu > 0
    leaning = _LEANING * jnp.where(rubs, mu, 1.0)
    aside = c - jnp.abs(across) * c / leaning
    faster = slip_begins(contacts, mu, normal, growth)
    smallest = jnp.minimum(falls, faster)
    smallest = jnp.minimum(smallest, aside)
    begins = modes.sign == BEGINS
    return jnp.where(begins, smallest, ends)


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
    old: Modes,
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
        old: modes up to now.
        touching: gap and gap velocity are 0.
        released: (2 m,) normal, then tangential constraints that have just ended: they
            hold again only with a force, not by rounding.
        sliding: the slip is not 0.
        slack: gap accelerations [m/s^2] below it are rounding.
    """
    contacts, mu = jax.lax.stop_gradient((contacts, mu))
    assert contacts.tangent is not None
    slid = old.active & ~old.stick
    had_begun = old.sign == BEGINS
    slip_began = jnp.any(slid & had_begun)
    problem = _ModeProblem(contacts, mu, touching, released, sliding, slip_began, slack)
    expected, directions = _expected_modes(problem, old)
    no = jnp.asarray(False)
    one = jnp.ones_like(slack)
    passes = jnp.asarray(0)
    start = _ModeTrial(expected, directions, touching, one, no, no, no, passes)

    def goes_on(trial: _ModeTrial) -> Bool[Array, ""]:
        """True until a trial is done, at most `_PASSES` times."""
        some_left = trial.passes < _PASSES
        return ~trial.done & some_left

    def following(trial: _ModeTrial) -> _ModeTrial:
        """The next trial of this problem."""
        return _next_trial(problem, trial)

    end = jax.lax.while_loop(goes_on, following, start)
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
        one = jnp.ones_like(self.mu)
        sticks = self.touching & ~self.sliding
        return Modes(self.touching, sticks, one)


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
    problem: _ModeProblem, old: Modes
) -> tuple[Modes, Float[Array, "m r"]]:
    """Modes to try first: the `old` ones, but for constraints that ended; directions of
    known slip.

    The direction of a contact that slides is that of its slip u; slip starts against
    the last force of sticking, `-lambda_t / |lambda_t|`; 0 where the direction is to be
    solved for. In space a contact at the rim of the cone starts to slide where another
    one does.
    """
    contacts, mu, touching, released, sliding, _, slack = problem
    assert contacts.tangent is not None
    m = len(mu)
    spatial = in_space(contacts)
    slid = old.active & ~old.stick
    ends = released[m:]  # of sticking or of slip, just now
    let_go = ends & old.stick  # friction has reached the cone: slip starts
    broken = let_go & ~sliding
    ended = jnp.any(ends & slid)  # slip of a contact has come to 0
    # where sticking breaks at one contact of a body, those that began to slide before
    # go on
    one_broke = jnp.any(let_go)
    goes_on = slid & one_broke & ~ended & ~sliding
    # in space directions are not remembered
    if spatial:
        starts = broken | goes_on
    else:
        starts = broken
    may_stick = starts | ~goes_on
    stick = ~sliding & may_stick
    sign = jnp.where(goes_on, old.sign, 0.0)
    now = Modes(touching, stick, sign)
    of_slip = direction(by_contact(contacts.tangent.rate, m))
    has_slip = sliding[:, None]
    if spatial:
        slides = jnp.where(has_slip, of_slip, 0.0)
    else:
        slides = jnp.where(has_slip, of_slip, sign[:, None])
    # sliding begins against the last force of sticking
    still_held = touching & ~released[:m]
    held_on = now._replace(active=still_held)
    # one evaluation of forces for both modes, so that it is compiled once
    two_modes = jax.tree.map(lambda *x: jnp.stack(x), held_on, problem.sticking_modes)
    both = jax.lax.map(lambda modes: forces(contacts, mu, modes, slides), two_modes)
    held = jax.tree.map(lambda x: x[0], both)
    stuck = jax.tree.map(lambda x: x[-1], both)
    assert held.tangential is not None
    against = by_contact(held.tangential, m)
    if not spatial:
        pushes_ahead = against > 0
        against = jnp.where(pushes_ahead, -1.0, 1.0)
    else:
        against = -direction(against)
        # redundant contacts that share equally break loose together
        left = cone_margins(contacts, mu, stuck)
        stuck_before = old.active & old.stick
        at_rim = stuck_before & ~sliding & (left <= slack)
        starts = starts | (at_rim & jnp.any(broken))
    return now, jnp.where(starts[:, None], against, slides)


def _next_trial(problem: _ModeProblem, last: _ModeTrial) -> _ModeTrial:
    """Modes by the problem of `choose_with_friction`, with directions and contacts of
    `last`.

    Of what it contradicts the next trial is free: assumed directions against which slip
    starts, and a contact that would slide although its forces are singular (it is
    wedged) where another solution exists.
    """
    contacts, mu, touching, released, sliding, _, slack = problem
    m = len(mu)
    known = last.known
    dtype = known.dtype
    diagonal = jnp.diagonal(contacts.delassus)[:m]
    solution = _solved(problem, known, last.may_press)
    every_force = jnp.concatenate([solution.normal, solution.tangential])
    acceleration = contacts.approach + contacts.delassus @ every_force
    of_gap = acceleration[:m]
    along = by_contact(acceleration[m:], m)  # acceleration of the slip
    is_known = length(known) > 0
    stays = of_gap <= slack
    # what has just let go needs a force, as an acceleration, that is no rounding
    has_force = solution.normal * diagonal > slack
    holds = ~released[:m] | has_force
    active = last.may_press & stays & holds
    slip_starts = length(along) > slack
    slips = is_known | slip_starts
    slide = jnp.where(is_known[:, None], known, direction(along))
    sign = _sign_of_slip(problem, solution.normal, along, slide)
    modes = Modes(active, active & ~slips, sign)
    # what was taken to slide from rest must do so
    ahead = jnp.sum(known * along, axis=1)
    backwards = ahead < -slack
    assumed = active & is_known & ~sliding
    returns = assumed & backwards
    status = solution.status
    several = status == CODE["several_outcomes"]
    solved = status <= CODE["several_outcomes"]
    free_again = jnp.where(solved, returns, ~sliding)
    # what would go on sliding though it cannot parts, where that is a solution, too
    pressed = jnp.where(solved, active, last.may_press)
    sticking = pressed & ~slips
    pressing = modes._replace(active=pressed, stick=sticking)
    regular = regularity(contacts, mu, pressing, slide)
    # flights end where the regularity falls to `root`: contacts are wedged from twice
    # that on
    root = precision(dtype).root
    singular = regular <= 2 * root
    wedged = active & slips & singular
    moves_apart = of_gap >= -slack
    fits = ~touching | last.may_press | moves_apart
    consistent = solved & jnp.all(fits)
    contradicted = wedged | returns
    return _ModeTrial(
        modes=modes,
        known=jnp.where(free_again[:, None], 0.0, known),
        may_press=last.may_press & ~(wedged & several),
        regularity=regular,
        several=several | last.several,
        solved=consistent & ~jnp.any(wedged),
        done=consistent & ~jnp.any(contradicted),
        passes=last.passes + 1,
    )


def _solved(
    problem: _ModeProblem, known: Float[Array, "m r"], may_press: Bool[Array, " m"]
) -> FrictionImpulses:
    """Forces of the contacts that `may_press`, which slide along the `known`
    directions, where these are not 0; lambda = 0 of others.
    """
    contacts = problem.contacts
    m, directions = known.shape
    tangents = jnp.repeat(may_press, directions)
    rows = jnp.concatenate([may_press, tangents])  # normals (m), then their tangents
    free = jnp.where(rows, contacts.approach, 0.0)
    one = jnp.ones(m, known.dtype)
    return solve(
        unit_outside(contacts.delassus, rows),
        free[:m],
        free[m:],
        problem.mu * one,
        complementary=True,
        sliding=known.reshape(-1),
    )


def _sign_of_slip(
    problem: _ModeProblem,
    normal: Float[Array, " m"],
    along: Float[Array, "m r"],
    slide: Float[Array, "m r"],
) -> Float[Array, " m"]:
    """`Modes.sign` of contacts that would slide along `slide` under these normal forces
    [N], with the acceleration `along` of their slip [m/s^2].

    In the plane the sign of the direction. In space 1, or `BEGINS` where slip starts
    from rest as slowly as `slip_begins` says, unless a contact had that mode.
    """
    contacts = problem.contacts
    if not in_space(contacts):
        return slide[:, 0]
    growth = jnp.sum(along * slide, axis=1)
    margin = slip_begins(contacts, problem.mu, normal, growth)
    slow = margin > 0
    from_rest = slow & ~problem.sliding & ~problem.slip_began
    return jnp.where(from_rest, float(BEGINS), 1.0)


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
    m = len(touching)
    w = contacts.delassus[:m, :m]
    approach = contacts.approach[:m]
    b = jnp.where(touching, approach, 0.0)
    # redundant contacts: any of the solutions will do
    matrix = unit_outside(w, touching)
    solution = solve_lcp(matrix, b, regular=True)
    force = solution.z
    has_force = force * jnp.diagonal(w) > slack
    pressed = touching & has_force
    at_rest = solution.w <= slack
    stays = touching & ~pressed & at_rest
    return Pressed(pressed, stays, force)
