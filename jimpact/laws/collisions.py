"""Sequential pair collisions in contact space, until no contact approaches.

Everything is in normalized quantities: `qn = gamma / sqrt(W_jj)`, `pbar = sqrt(W_jj) p`
and G with unit diagonal. A collision at contact j adds `pbar_j += s_j` and
`qn += G_j s_j`, with `s_j = -(1 + e_j) qn_j`, so that its own gap velocity becomes
`-e_j qn_j`. With friction it adds a tangential impulse, too: each collision is one
contact's Coulomb problem (`friction.py`). With correlation ratios the closed contacts
beside it get impulses in a given ratio to its own.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jimpact.numerics.derive import by_jacobian
from jimpact.numerics.friction import solve as solve_friction
from jimpact.numerics.tangential import TangentialBlock, per_tangent
from jimpact.numerics.tridiagonal import (
    Symmetric,
    Tridiagonal,
    as_matrix,
    diagonal,
    off_diagonal,
    scaled,
)
from jimpact.tools.loops import while_loop
from jimpact.tools.precision import precision
from jimpact.tools.status import CODE

# eps, relative to the largest normalized approach velocity at the start: slower
# approaches are rounding (no collision), and criteria closer than that are equal.
# Errors of the velocities grow with the root of the number of collisions, so this
# covers some ten thousand; ten times more would lose the last slow collisions of long
# sequences.
REST = 128.0
# Three or more contacts: a last collision slower than this (relative, as REST) that
# leaves an approach is one of an endless sequence; what remains of it is below REST.
# Ten times more would cut off sequences that end.
DECAYED = {"float64": 1e-9, "float32": 3e-4}


class CoulombFriction(NamedTuple):
    """Coulomb friction of m contacts with t tangents."""

    block: TangentialBlock  # normalized by the `sqrt(W_jj)` of each contact in `Inputs`
    coefficient: jax.Array  # mu (m,)
    restitution: jax.Array  # e_t (m,)


class Inputs(NamedTuple):
    """The normalized problem of a sequence of collisions."""

    # entries of G above its unit diagonal, row by row; of a chain beside it
    coupling: jax.Array
    restitution: jax.Array  # e () or (m,): a scalar costs one tangent, not m
    qn: jax.Array  # normalized gap velocities (m,)
    root: jax.Array  # sqrt(W_jj) (m,), only for comparisons
    gaps: jax.Array | None  # (m,) [m]; None: no free flight
    friction: CoulombFriction | None = None
    # p_j of contacts beside the one that collides, over its p_i: (), (m,), or (m, m) in
    # row i
    ratio: jax.Array | None = None


class Options(NamedTuple):
    """Static options: the cyclic order (None: fastest or earliest), the limit, a chain
    or not.
    """

    cycle: tuple[int, ...] | None
    max_collisions: int
    chain: bool


class CollisionState(NamedTuple):
    """State of the sequence between two collisions."""

    qn: jax.Array  # normalized gap velocities (m,)
    p: jax.Array  # normalized impulses so far (m,)
    number: jax.Array  # () of collisions so far
    place: jax.Array  # () next entry of a cyclic order
    speed: jax.Array  # () normalized approach velocity of the last collision
    tied: jax.Array  # () True if some choice of the next collision was tied
    gaps: jax.Array | None  # (m,) [m]
    time: jax.Array  # () [s] of free flight so far
    slip: jax.Array | None  # normalized slip velocities (t,) with friction
    tangential: jax.Array | None  # normalized tangential impulses so far (t,)
    code: jax.Array  # () the worst status of a collision with friction or correlation


class NextCollision(NamedTuple):
    """The contact that collides next."""

    contact: jax.Array  # () its index
    place: jax.Array  # () entry of a cyclic order after it
    wait: jax.Array  # () [s] of free flight until then
    # () True if a contact coupled with it could as well be the next one
    tied: jax.Array


class SequenceEnd(NamedTuple):
    """Status and number of collisions of a finished sequence."""

    code: jax.Array  # () status
    number: jax.Array  # () of collisions; -1: endless


def solve(
    delassus: Symmetric,
    gamma: jax.Array,
    restitution: jax.Array,
    gaps: jax.Array | None,
    cycle: tuple[int, ...] | None,
    max_collisions: int,
    friction: CoulombFriction | None = None,
    ratio: jax.Array | None = None,
) -> tuple[jax.Array, jax.Array | None, SequenceEnd]:
    """Impulses p (m,), p_t (t,) [N s] of a sequence of collisions, and its end.

    Args:
        delassus: W (m, m) [1/kg].
        gamma: gap velocities before the impact (m,) [m/s].
        restitution: e, () or (m,).
        gaps: (m,) [m], which decide the order; None: no free flight.
        cycle: contacts in cyclic order; None: the fastest one, with gaps the first to
            close.
        max_collisions: largest number of collisions.
        friction: friction in SI units; None: none.
        ratio: impulse correlation ratios, see `Inputs`; None: a collision is one
            contact's.

    Differentiable in both modes.
    """
    inputs = to_inputs(delassus, gamma, restitution, gaps, friction)
    inputs = inputs._replace(ratio=ratio)
    options = Options(cycle, max_collisions, isinstance(delassus, Tridiagonal))
    (p, tangential), end = by_jacobian(lambda problem: run(problem, options), inputs)
    return *impulses_of(p, tangential, jnp.sqrt(diagonal(delassus))), end


def impulses_of(
    p: jax.Array, tangential: jax.Array | None, root: jax.Array
) -> tuple[jax.Array, jax.Array | None]:
    """Impulses p (m,), p_t (t,) [N s] of normalized ones: `p_j = pbar_j / root_j`."""
    if tangential is None:
        return p / root, None
    return p / root, tangential / per_tangent(root, tangential)


def to_inputs(
    delassus: Symmetric,
    gamma: jax.Array,
    restitution: jax.Array,
    gaps: jax.Array | None,
    friction: CoulombFriction | None = None,
) -> Inputs:
    """The normalized problem: `qn = gamma / d`, `G = W / (d d^T)`, `d_j = sqrt(W_jj)`
    (root).

    The fields `gaps` and `root` only decide the order of collisions, and have no
    derivatives.
    """
    root = jnp.sqrt(diagonal(delassus))
    g = scaled(delassus, 1 / root)
    if not isinstance(g, Tridiagonal):
        g = as_matrix(g)
    if friction is not None:
        friction = friction._replace(block=friction.block.scaled(root))
    if gaps is not None:
        gaps = jax.lax.stop_gradient(gaps)
    return Inputs(
        coupling=off_diagonal(g),
        restitution=restitution,
        qn=gamma / root,
        root=jax.lax.stop_gradient(root),
        gaps=gaps,
        friction=friction,
    )


def run(
    inputs: Inputs, options: Options
) -> tuple[tuple[jax.Array, jax.Array | None], SequenceEnd]:
    """Normalized impulses (p (m,), p_t (t,)) of all collisions, and the end of the
    sequence.

    Endless sequences end in the plastic limit, gamma = 0: of two contacts by
    `endless_pair`, of more where speeds of collisions have decayed (`DECAYED`).
    """
    g = coupling_matrix(inputs, options)
    start = begin(inputs)
    alone = inputs.friction is None and inputs.ratio is None
    pair = inputs.qn.shape[0] == 2 and alone
    endless = jnp.array(False)
    limit = start.p
    if pair:
        first = choose(inputs, options, g, start).contact
        endless, limit = endless_pair(inputs, first)
        endless = endless & approaches(inputs, start)

    def unfinished(now: CollisionState) -> jax.Array:
        """True () if another collision follows, and the largest number is not
        reached.
        """
        left = now.number < options.max_collisions
        return ~endless & approaches(inputs, now) & left

    end = while_loop(unfinished, lambda now: collide(inputs, options, g, now), start)
    stopped = ~endless & approaches(inputs, end)
    if not pair:
        decayed = DECAYED.get(str(end.qn.dtype), 3e-4)
        slow = end.speed < decayed * scale_of(inputs)
        endless = slow & jnp.any(end.qn < 0) & ~stopped
    code = jnp.where(end.tied, CODE["order_dependent"], CODE["ok"])
    code = jnp.maximum(code, end.code)
    code = jnp.where(endless, CODE["plastic_limit"], code)
    code = jnp.where(stopped, CODE["max_steps"], code)
    p = end.p
    if pair:
        p = jnp.where(endless, limit, p)
    number = jnp.where(endless, -1, end.number)
    return (p, end.tangential), SequenceEnd(code, number)


def coupling_matrix(inputs: Inputs, options: Options) -> Symmetric:
    """G (m, m) of its entries off the unit diagonal, `inputs.coupling`; tridiagonal for
    a chain.
    """
    m = inputs.qn.shape[0]
    dtype = inputs.qn.dtype
    if options.chain:
        return Tridiagonal(jnp.ones(m, dtype), inputs.coupling)
    i, j = jnp.triu_indices(m, 1)
    zero = jnp.zeros((m, m), dtype)
    upper = zero.at[i, j].set(inputs.coupling)
    return jnp.eye(m, dtype=dtype) + upper + upper.T


def scale_of(inputs: Inputs) -> jax.Array:
    """Largest normalized approach velocity at the start () [sqrt(J)]."""
    return jax.lax.stop_gradient(jnp.max(jnp.maximum(-inputs.qn, 0.0)))


def rest_of(inputs: Inputs) -> jax.Array:
    """Largest normalized approach velocity () [sqrt(J)] that counts as rounding."""
    return REST * precision(inputs.qn.dtype).eps * scale_of(inputs)


def approaches(inputs: Inputs, now: CollisionState) -> jax.Array:
    """True () if a contact approaches by more than rounding."""
    return jnp.any(now.qn < -rest_of(inputs))


def begin(inputs: Inputs) -> CollisionState:
    """State before the first collision.

    No collision has been slow so far, and no choice of the next one tied.
    """
    dtype = inputs.qn.dtype
    slip = None
    tangential = None
    if inputs.friction is not None:
        slip = inputs.friction.block.slip
        tangential = jnp.zeros_like(slip)
    return CollisionState(
        qn=inputs.qn,
        p=jnp.zeros_like(inputs.qn),
        number=jnp.array(0, jnp.int32),
        place=jnp.array(0, jnp.int32),  # the first entry
        speed=jnp.array(jnp.inf, dtype),
        tied=jnp.array(False),
        gaps=inputs.gaps,
        time=jnp.array(0, dtype),
        slip=slip,
        tangential=tangential,
        code=jnp.array(CODE["ok"], jnp.int32),
    )


def choose(
    inputs: Inputs, options: Options, g: Symmetric, now: CollisionState
) -> NextCollision:
    """The contact that collides next, at a state with contacts that approach.

    In a cyclic order it is the next one that approaches. Else it is the fastest one
    [m/s], with gaps among those that close first; the lowest index among equals within
    rounding, and `tied` if one of these is coupled with it (G_ij != 0).
    """
    rest = rest_of(inputs)
    approaching = now.qn < -rest
    if options.cycle is not None:
        return next_in_cycle(options.cycle, approaching, now)
    speed = jnp.where(approaching, -now.qn * inputs.root, 0.0)  # m/s
    rivals = approaching
    wait = jnp.zeros_like(speed)
    if now.gaps is not None:
        rivals, wait = first_to_close(inputs, now, approaching, speed)
    noise = rest * inputs.root
    fastest = jnp.max(jnp.where(rivals, speed - noise, -jnp.inf))
    equally_fast = rivals & (speed + noise >= fastest)
    j = jnp.argmax(equally_fast).astype(jnp.int32)
    chosen = jnp.arange(speed.shape[0], dtype=jnp.int32) == j
    floor = precision(speed.dtype).noise
    coupled = jnp.abs(times(g, chosen.astype(speed.dtype))) > floor
    equals = equally_fast
    if now.gaps is not None:
        equals = rivals
    tied = jnp.any(equals & coupled & ~chosen)
    return NextCollision(j, now.place, wait[j], tied)


def next_in_cycle(
    cycle: tuple[int, ...], approaching: jax.Array, now: CollisionState
) -> NextCollision:
    """The first contact `approaching` (m,) from entry `now.place` of the cycle on, else
    from its begin.
    """
    contacts = jnp.array(cycle, jnp.int32)
    entries = jnp.arange(len(cycle), dtype=jnp.int32)
    ready = approaching[contacts]
    ahead = ready & (entries >= now.place)
    k = jnp.where(jnp.any(ahead), jnp.argmax(ahead), jnp.argmax(ready))
    k = k.astype(jnp.int32)
    no_wait = jnp.zeros_like(now.time)
    return NextCollision(contacts[k], k + 1, no_wait, tied=jnp.array(False))


def first_to_close(
    inputs: Inputs, now: CollisionState, approaching: jax.Array, speed: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """True (m,) for the contacts that close first, within rounding, and times (m,) [s]
    until then.

    Equation: `t_j = gap_j / speed_j`, infinite for contacts that do not approach.
    """
    assert now.gaps is not None
    assert inputs.gaps is not None
    safe = jnp.where(approaching, speed, 1.0)
    wait = jnp.where(approaching, now.gaps / safe, jnp.inf)
    first = jnp.min(wait)
    time = now.time + first + inputs.gaps / safe
    rounding = precision(speed.dtype).noise * time
    return approaching & (wait <= first + rounding), wait


def times(g: Symmetric, vector: jax.Array) -> jax.Array:
    """`G vector` without the reduced precision that accelerators use in products."""
    if isinstance(g, jax.Array):
        return jnp.sum(g * vector[None, :], axis=1)
    return g @ vector


def collide(
    inputs: Inputs, options: Options, g: Symmetric, now: CollisionState
) -> CollisionState:
    """State after the free flight to the next collision and this collision.

    Equation: impulse `p_j = -(1 + e_j) qn_j` at the contact j that collides,
    `qn += G_j p_j`; with correlation ratios those of `_correlated`, else with friction
    those of `_with_friction`. Without gaps no time passes between collisions.
    """
    choice = choose(inputs, options, g, jax.lax.stop_gradient(now))
    qn = now.qn
    chosen = jnp.arange(qn.shape[0], dtype=jnp.int32) == choice.contact
    slip = now.slip
    tangential = now.tangential
    code = now.code
    if inputs.ratio is not None:
        p, status = _correlated(inputs, inputs.ratio, g, now, chosen)
        after = qn + times(g, p)
        code = jnp.maximum(code, status)
    elif inputs.friction is None:
        e = inputs.restitution
        p = jnp.where(chosen, -(1 + e) * qn, 0.0)
        after = jnp.where(chosen, -e * qn, qn + times(g, p))
    else:
        assert slip is not None
        assert tangential is not None
        p, p_t, status = _with_friction(inputs, inputs.friction, now, choice.contact)
        g_nt, g_tt, _ = inputs.friction.block
        after = qn + times(g, p) + g_nt @ p_t
        slip = slip + g_nt.T @ p + g_tt @ p_t
        tangential = tangential + p_t
        code = jnp.maximum(code, status)
    gaps = now.gaps
    if gaps is not None:
        gamma = jax.lax.stop_gradient(qn) * inputs.root
        flown = gaps + gamma * choice.wait
        gaps = jnp.where(chosen, 0.0, jnp.maximum(flown, 0.0))
    return CollisionState(
        qn=after,
        p=now.p + p,
        number=now.number + jnp.array(1, jnp.int32),
        place=choice.place,
        speed=jax.lax.stop_gradient(-qn[choice.contact]),
        tied=now.tied | choice.tied,
        gaps=gaps,
        time=now.time + choice.wait,
        slip=slip,
        tangential=tangential,
        code=code,
    )


def _correlated(
    inputs: Inputs,
    ratio: jax.Array,
    g: Symmetric,
    now: CollisionState,
    chosen: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Normalized impulses (m,) of a collision at the `chosen` contact and at those it
    presses.

    They grow in constant ratios, `pbar = s d`: d_i = 1 at the chosen contact i (True in
    (m,)), `d_j = r_j sqrt(W_jj / W_ii)`, r = `ratio` (m,), or its row i of (m, m), at
    contacts beside it that it presses and that do not separate, 0 elsewhere. With a = G
    d contact j is compressed while `qn_j + a_j s < 0`, and returns e_j^2 of this work.
    The loss `L = sum (1 - e_j^2) d_j qn_j^2 / (2 a_j)` is that of kinetic energy:
    `d.a s^2 / 2 + d.qn s + L = 0`, and s is the larger root. The status is `infeasible`
    where there is none, a contact would be compressed for ever (a_j <= 0), or one is
    left approaching. Then, or with none beside it, the chosen contact collides alone.
    """
    qn = now.qn
    e = inputs.restitution
    rest = rest_of(inputs)
    noise = precision(qn.dtype).noise
    # pbar = s d
    root_i = jnp.sum(jnp.where(chosen, inputs.root, 0.0))
    if ratio.ndim == 2:
        of_i = jnp.where(chosen[:, None], ratio, 0.0)
        ratio = jnp.sum(of_i, axis=0)
    pressed = times(g, chosen.astype(qn.dtype)) < -noise
    beside = pressed & (qn <= rest) & ~chosen
    d = jnp.where(beside, ratio * inputs.root / root_i, 0.0)
    d = jnp.where(chosen, 1.0, d)
    a = times(g, d)
    # L
    closing = (d > 0) & (qn < 0)
    stays = closing & (a <= 0)  # it would be compressed for ever
    work = d * qn**2 / (2 * jnp.where(a > 0, a, 1.0))
    work = jnp.where(closing & ~stays, work, 0.0)
    loss = jnp.sum((1 - e**2) * work)
    # d.a s^2 / 2 + d.qn s + L = 0
    da = jnp.sum(d * a)
    slope = -jnp.sum(d * qn)
    square = slope**2 - 2 * da * loss
    allowed = (square >= -noise * slope**2) & ~jnp.any(stays) & (da > 0)
    real = allowed & (square > 0)
    root = jnp.sqrt(jnp.where(real, square, 1.0))
    root = jnp.where(real, root, 0.0)
    s = (slope + root) / jnp.where(da > 0, da, 1.0)
    takes_part = (d > 0) | beside
    approaching = qn + s * a < -rest
    allowed = allowed & ~jnp.any(takes_part & approaching)
    alone = jnp.where(chosen, -(1 + e) * qn, 0.0)
    p = jnp.where(allowed & jnp.any(beside), s * d, alone)
    return p, jnp.where(allowed, CODE["ok"], CODE["infeasible"])


def _with_friction(
    inputs: Inputs, friction: CoulombFriction, now: CollisionState, contact: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Normalized impulses (m,), (t,) of a collision at one `contact` () with friction,
    and status.

    Equation: `qn+ = -e qn-` where this needs an impulse `p >= 0`, and
    `p_t in -mu p Sgn(u+ + e_t u-)`; impulses of other contacts are 0.
    """
    assert now.slip is not None
    m, t = friction.block.normal_tangent.shape
    tangents = t // m
    rows = contact * tangents + jnp.arange(tangents, dtype=contact.dtype)  # its own
    g_nn = jnp.ones((1, 1), now.qn.dtype)
    g_nt = friction.block.normal_tangent[contact, rows][None]
    g_tt = friction.block.tangent[rows[:, None], rows[None]]
    matrix = jnp.block([[g_nn, g_nt], [g_nt.T, g_tt]])
    e = jnp.broadcast_to(inputs.restitution, (m,))[contact]
    e_t = friction.restitution[contact]
    mu = friction.coefficient[contact]
    b = (1 + e) * now.qn[contact]
    b_t = (1 + e_t) * now.slip[rows]
    impulses = solve_friction(matrix, b[None], b_t, mu[None], complementary=True)
    p = jnp.zeros_like(now.qn).at[contact].set(impulses.normal[0])
    p_t = jnp.zeros_like(now.slip).at[rows].set(impulses.tangential)
    return p, p_t, impulses.status


def endless_pair(inputs: Inputs, first: jax.Array) -> tuple[jax.Array, jax.Array]:
    """True () if two contacts collide without end, `first` to begin, and the limit
    impulses (2,).

    Approach speeds of successive collisions at j, k, j, ... obey, c = -G_12,

        s_3 = c (1 + e_k) s_2 - e_j s_1,

    two steps of which have trace `c^2 (1 + e_1) (1 + e_2) - e_1 - e_2` and determinant
    e_1 e_2. They stay positive iff both eigenvalues are (c > 0, trace >= 2 sqrt(det))
    and s_3 / s_1 is not below the smaller one,
    `chi(lambda) = lambda^2 - trace lambda + det = 0`. The limit is gamma = 0. Redundant
    contacts (c = 1) have a series instead, `s_3 = e_1 e_2 s_1`, without a limit where
    e_1 e_2 = 1: then they do not count as endless.
    """
    e = jnp.broadcast_to(inputs.restitution, (2,))
    qn = inputs.qn
    c = -inputs.coupling[0]
    noise = precision(qn.dtype).noise
    e_j = e[first]
    e_k = e[1 - first]
    s_1 = -qn[first]
    s_2 = c * (1 + e_j) * s_1 - qn[1 - first]
    det = e_j * e_k
    trace = c**2 * (1 + e_j) * (1 + e_k) - e_j - e_k
    ratio = c * (1 + e_k) * s_2 / s_1 - e_j  # s_3 / s_1
    chi = ratio**2 - trace * ratio + det
    rounding = noise * (ratio**2 + trace * ratio + det)
    above = (ratio >= trace / 2) | (chi <= rounding)
    root_det = jnp.sqrt(jax.lax.stop_gradient(det))
    possible = (c > 0) & (trace >= 2 * root_det)
    endless = possible & (s_2 > 0) & (ratio >= 0) & above
    # redundant contacts (c = 1) have no inverse: there s_3 = e_1 e_2 s_1, a geometric
    # series
    det_g = 1 - c**2
    redundant = det_g <= noise
    regular = jnp.where(redundant, 1.0, det_g)
    inverse = -(qn + c * jnp.flip(qn)) / regular  # -G^-1 qn
    decay = jnp.where(det < 1, 1 - det, 1.0)
    series_j = (1 + e_j) * s_1 / decay
    series_k = (1 + e_k) * s_2 / decay
    chosen = jnp.arange(2, dtype=jnp.int32) == first
    series = jnp.where(chosen, series_j, series_k)
    p = jnp.where(redundant, series, inverse)
    return endless & ~(redundant & (det >= 1)), p
