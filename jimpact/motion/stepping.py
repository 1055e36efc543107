"""Moreau-Jean time stepping with any impact law: for many contacts, no event is located.

One step of length h (after Remark 6.9 of Brogliato):

    q_m = q + h/2 v                              closed: here, or at the end by forces alone
    v'  = v + h M^-1 F + M^-1 (N p + H p_t)      0 <= p _|_ gamma' + w >= 0
    q'  = q_m + h/2 v'                           p_t in -mu p Sgn(u' + w_t)

with `w = e gamma` of a contact that approaches by Moreau's law, which so joins the problem. Any
other law acts before it, in the middle of the forces, `v+ = impact(law, scene(q_m), v + h/2 M^-1
F)`, and slow approach (within what forces give in two steps) is rest, `w = 0`. Order 1: an impact
is early or late by up to h / 2.

ENERGY. A contact gives `p (gamma' + gamma) / 2`: no energy where `w >= gamma`. So what leaves may
come back as fast as it leaves, `w = gamma`, and is at rest two steps later. Friction is against the
slip at the end, `w_t = 0` (`e_t u` in an impact). That may give energy where the slip reverses
within the step, up to (h g)^2 in a stop on a slope, and more in Kane's paradox; such a step is
solved again with all friction against the mean slip, `w_t = u`, which cannot.

DERIVATIVES of such a step do not converge: with h the time of an impact is constant, while its
derivative is not. They are refused.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jimpact.bodies.piles import Discs, Near
from jimpact.impacts import impact
from jimpact.law import Law, within_domains
from jimpact.laws.kinematic import Moreau
from jimpact.motion.dynamics import (
    carried_along,
    definite,
    free_acceleration,
    gaps,
    kinematics,
    mass_at,
    seen_from_base,
    solve_mass,
    user_force,
)
from jimpact.motion.flow import Course, State, out_of_range, status_at_start
from jimpact.motion.record import KIND_CODE, MOTION_CODE, Events, no_events, with_row
from jimpact.motion.system import System
from jimpact.motion.transitions import FAILS, scene_at
from jimpact.scene import Scene
from jimpact.solvers.many_contacts import Many, solve_many
from jimpact.solvers.sensitivity import without_derivatives
from jimpact.status import CODE

# Gap velocities below this share of the largest speed of the motion, or below so many roundings of
# it, are what solving for contacts at rest leaves. Ten times less, and resting beads strike in
# every step; ten times more, and slow impacts come a step later.
_ROUNDING, _ROUNDINGS = 1e-12, 64
SLOW = 2.0  # steps of the free acceleration: slower approach is rest, not an impact
# Misfit of a step's impulses, of its velocities: wanted of a few contacts, of a pile; in float32
# so many roundings at least. A step that misses by more than OFF is told.
FEW, PILE, ROUNDINGS, OFF = 1e-9, 1e-6, 32, 1e-2
ITERATIONS = 1000
MEAN = 4  # tries for the mean velocity that forces depend on; each gains h omega, of spin omega
APART = 3  # steps: a contact that is struck again before is told

WHY = (
    "Argument `method` must not be 'time_stepping' where derivatives are taken: with the step the "
    "times of impacts are fixed, so that derivatives do not converge. method='events' has them."
)


class _Few(NamedTuple):
    """The contacts of a body, all of them, in one step."""

    there: jax.Array  # (m,) closed
    directions: jax.Array  # (n, m, b): normals, tangents
    moved: jax.Array  # M^-1 of them
    matrix: jax.Array  # (m, b, m, b); 0 where open

    def rates(self, v: jax.Array) -> jax.Array:
        """Gap velocities and slips (m, b) of v (n,)."""
        return jnp.tensordot(v, self.directions, axes=1)

    def fastest(self, v: jax.Array) -> jax.Array:
        """Gap velocity () that the speeds of v could give."""
        return jnp.max(jnp.abs(v) @ jnp.abs(self.directions[:, :, 0]))

    def push(self, x: jax.Array) -> jax.Array:
        """Change of velocity (n,) by impulses x (m, b)."""
        return jnp.tensordot(self.moved, x, axes=2)

    def pull(self, x: jax.Array) -> jax.Array:
        """Generalized impulse (n,)."""
        return jnp.tensordot(self.directions, x, axes=2)

    def product(self, x: jax.Array) -> jax.Array:
        """Rates (m, b) that impulses give."""
        return jnp.tensordot(self.matrix, x, axes=2)

    @property
    def diagonal(self) -> jax.Array:
        """Of the matrix (m, b)."""
        m, b = self.matrix.shape[:2]
        return jnp.diagonal(self.matrix.reshape(m * b, m * b)).reshape(m, b)

    def recall(self, memory: jax.Array) -> jax.Array:
        """Impulses (m, b) of the last step."""
        return jnp.where(self.there[:, None], memory, 0.0)

    def keep(self, memory: jax.Array, x: jax.Array) -> jax.Array:
        """The memory, for the next step."""
        return x

    def seen(self, values: jax.Array) -> jax.Array:
        """What of contacts (.., m) is recorded."""
        return values


class _Heap(NamedTuple):
    """The closed contacts of a pile in one step; as `_Few`."""

    near: Near
    inverse: jax.Array  # 1 / M (k + 1, 3), 0 of walls

    @property
    def there(self) -> jax.Array:
        return self.near.there

    def rates(self, v: jax.Array) -> jax.Array:
        at = jnp.pad(v.reshape(-1, 3), ((0, 1), (0, 0)))[self.near.bodies]
        return jnp.sum(self.near.directions * at[:, None], axis=(2, 3))

    def fastest(self, v: jax.Array) -> jax.Array:
        return 2 * jnp.max(jnp.abs(v))

    def push(self, x: jax.Array) -> jax.Array:
        return self.pull(x) * self.inverse[:-1].reshape(-1)

    def pull(self, x: jax.Array) -> jax.Array:
        each = jnp.sum(self.near.directions * x[:, :, None, None], axis=1)
        return jnp.zeros_like(self.inverse).at[self.near.bodies].add(each)[:-1].reshape(-1)

    def product(self, x: jax.Array) -> jax.Array:
        return self.rates(self.push(x))

    @property
    def diagonal(self) -> jax.Array:
        return jnp.sum(self.near.directions**2 * self.inverse[self.near.bodies][:, None], (2, 3))

    def recall(self, memory: jax.Array) -> jax.Array:
        return memory.at[self.near.number].get(mode="fill", fill_value=0.0)

    def keep(self, memory: jax.Array, x: jax.Array) -> jax.Array:
        return jnp.zeros_like(memory).at[self.near.number].set(x, mode="drop")

    def seen(self, values: jax.Array) -> jax.Array:
        return jnp.sum(values, axis=-1, keepdims=True)


class _Tried(NamedTuple):
    """One try of a step: velocity at its end, mean velocity, forces taken, impulses."""

    v: jax.Array
    mean: jax.Array
    force: jax.Array
    found: Many
    gains: jax.Array  # () whether the impulses give energy
    tries: jax.Array  # () so far, this one included


class _Progress(NamedTuple):
    state: State
    speed: jax.Array  # the largest that velocities could give a gap so far
    memory: jax.Array  # impulses of the last step
    missed: jax.Array  # gap velocity () that they miss
    steepness: jax.Array
    since: jax.Array  # (m,) steps since each was struck
    events: Events
    status: jax.Array
    told: jax.Array  # what is no failure


def is_pile(system: System) -> bool:
    """Whether only closed contacts are looked at."""
    return isinstance(system.body, Discs)


def recorded_gaps(system: System, q: jax.Array, t: jax.Array) -> jax.Array:
    """Gaps (m,), of a pile the least one (1,)."""
    found = gaps(system, q, t)
    return jnp.min(found, keepdims=True) if is_pile(system) else found


def time_stepping(
    system: System,
    law: Law,
    mu: jax.Array | None,
    q0: jax.Array,
    v0: jax.Array,
    times: jax.Array,
    closed_below: jax.Array,
    substeps: jax.Array,
    joint: bool,
    max_events: int,
) -> Course:
    """The motion with `substeps` () steps between neighbours of `times` (S,).

    `joint`: the law is a condition on v' that joins the problem of the step (`joins_step`).
    """
    system, law, mu, q0, v0, times = without_derivatives(
        (system, law, mu, q0, v0, times), NotImplementedError(WHY)
    )
    zero, dtype = jnp.zeros((), q0.dtype), q0.dtype
    m = recorded_gaps(system, q0, times[0]).shape[0]

    def rates_at(q: jax.Array) -> jax.Array:
        t = times[0]
        return _contacts(system, q, t, q, t, closed_below, mu is not None).rates(v0)

    contacts, b = jax.eval_shape(rates_at, q0).shape
    kept = _numbers(system.body) if isinstance(system.body, Discs) else contacts
    rest = jnp.zeros((2, m), dtype)
    begin = State(q0, v0, times[0], zero, zero, rest, rest[:0])
    rows = 1 if is_pile(system) else max_events
    events = no_events(rows, q0, v0, m, sides=m * max(b - 1, 1))
    status = status_at_start(system, begin, times[-1], closed_below)
    fails = (status == MOTION_CODE["ok"]) & ~within_domains(law)
    status = jnp.where(fails, MOTION_CODE["law_failed"], status).astype(jnp.int32)
    h = (times[1] - times[0]) / substeps.astype(dtype)
    start = _Progress(
        begin,
        zero,
        jnp.zeros((kept, b), dtype),
        zero,
        jnp.ones((), dtype),
        jnp.full(contacts, substeps * len(times)),
        events,
        status,
        jnp.int32(MOTION_CODE["ok"]),
    )

    def to_sample(course: _Progress, t: jax.Array) -> tuple[_Progress, State]:
        def one(i: jax.Array, course: _Progress) -> _Progress:
            def go() -> _Progress:
                now = t + i.astype(dtype) * h
                return _one_step(system, law, mu, h, closed_below, joint, course, now)

            return jax.lax.cond(course.status == MOTION_CODE["ok"], go, lambda: course)

        course = jax.lax.fori_loop(0, substeps, one, course)
        fine = course.status == MOTION_CODE["ok"]
        return course, jax.tree.map(lambda x: jnp.where(fine, x, jnp.nan), course.state)

    end, later = jax.lax.scan(to_sample, start, times[:-1])
    samples = jax.tree.map(lambda x, rest: jnp.concatenate([x[None], rest]), begin, later)
    steps = substeps * (times.shape[0] - 1)
    status = jnp.where(end.status == MOTION_CODE["ok"], end.told, end.status)
    return Course(samples, end.events, steps, status)


def _numbers(pile: Discs) -> int:
    return pile.count * (pile.count + len(pile.walls))


def _contacts(
    system: System,
    q: jax.Array,
    t: jax.Array,
    q_end: jax.Array,
    t_end: jax.Array,
    closed_below: jax.Array,
    friction: bool,
) -> _Few | _Heap:
    """The contacts of a step whose middle is at (q, t), and its end, without contacts, at q_end."""
    at, end = seen_from_base(system, q, t), seen_from_base(system, q_end, t_end)
    mass = mass_at(system, q)
    if isinstance(system.body, Discs):
        near = system.body.near(at, end, closed_below)
        near = near if friction else near._replace(directions=near.directions[:, :1])
        return _Heap(near, jnp.pad(1 / mass.reshape(-1, 3), ((0, 1), (0, 0))))
    given = kinematics(system, q, jnp.zeros(mass.shape[:1], q.dtype), t)
    gap, normals = given.value, given.gradient
    n, m = normals.shape
    directions = (normals + 0 * gap[None])[:, :, None]  # NaN where the gap is
    if friction:
        sides = system.body.tangents(at)
        assert sides is not None
        directions = jnp.concatenate([directions, sides.reshape(n, m, -1)], axis=2)
    least = jnp.minimum(gap, jnp.atleast_1d(system.body.gap_function(end)))
    there = ~(least > closed_below)  # NaN does not pass for open
    directions = jnp.where(there[:, None], directions, 0.0)
    moved = solve_mass(mass, directions.reshape(n, -1)).reshape(directions.shape)
    return _Few(there, directions, moved, jnp.tensordot(directions, moved, axes=([0], [0])))


def _one_step(
    system: System,
    law: Law,
    mu: jax.Array | None,
    h: jax.Array,
    closed_below: jax.Array,
    joint: bool,
    course: _Progress,
    t: jax.Array,
) -> _Progress:
    state, dtype, body = course.state, course.state.q.dtype, system.body
    middle = t + 0.5 * h
    q = body.moved(state.q, 0.5 * h * state.v)
    carried = carried_along(system, state.v, middle)
    mass = mass_at(system, q)

    def pushed(v: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Forces, and the acceleration without contacts, at the velocity v."""
        force = user_force(system, q, v, middle)
        return force, free_acceleration(system, q, v, force, mass)

    free_before = pushed(state.v)[1]
    falls = body.moved(q, 0.5 * h * (state.v + h * free_before))
    close = _contacts(system, q, middle, falls, t + h, closed_below, mu is not None)
    before = close.rates(state.v - carried)
    eps = float(jnp.finfo(dtype).eps)
    speed = jnp.maximum(course.speed, close.fastest(state.v))
    tolerance = max(PILE if isinstance(close, _Heap) else FEW, ROUNDINGS * eps)
    noise = max(_ROUNDING, _ROUNDINGS * eps) * speed + course.missed
    noise += tolerance * close.fastest(h * free_before)
    slow = noise + SLOW * h * jnp.abs(close.rates(free_before)[:, 0])
    strikes = close.there & (before[:, 0] < -slow)
    struck, code = jnp.zeros_like(before), jnp.int32(CODE["ok"])
    e, e_t = jnp.zeros((), dtype), jnp.zeros((), dtype)
    # half of the forces before an impact, half after it: over the whole step they take as much
    # energy from the velocities as the potential gains
    met = state.v if joint else state.v + 0.5 * h * free_before
    if joint:
        assert isinstance(law, Moreau)
        e = law.restitution
        e_t = e_t if law.tangential_restitution is None else law.tangential_restitution
    else:
        scene = scene_at(system, q, state.v, middle, close.there)
        struck, code = jax.lax.cond(
            jnp.any(strikes),
            lambda: _struck(law, scene, met - carried, noise, before.shape),
            lambda: (struck, code),
        )
    rates = before + close.product(struck)
    late = jnp.where(strikes, 0.5 * h * close.rates(free_before)[:, 0], 0.0)
    wanted, against_mean = _wanted(e, jnp.where(strikes, e_t, 0.0), rates, late)

    def solved(tried: _Tried) -> _Tried:
        """The step with the forces at its mean velocity, as far as that is known."""
        force, free = pushed(tried.mean)
        pulled = rates + h * close.rates(free)
        goal = pulled + jnp.where(tried.tries < least, wanted, against_mean)
        found = solve_many(
            close.product,
            close.diagonal,
            jnp.where(close.there[:, None], goal, 0.0),
            jnp.zeros((), dtype) if mu is None else mu,
            tried.found.impulse,
            tried.found.steepness,
            tolerance,
            ITERATIONS,
        )
        v = state.v + h * free + close.push(struck + found.impulse)
        after = pulled + close.product(found.impulse)
        gained = 0.5 * jnp.vdot(found.impulse, rates + after)
        gains = gained > (noise + found.missed) * jnp.sum(jnp.abs(found.impulse))
        return _Tried(v, 0.5 * (state.v + v), force, found, gains, tried.tries + 1)

    def goes_on(tried: _Tried) -> jax.Array:
        return (tried.tries < least) | (tried.gains & (tried.tries < 2 * least))

    begun = Many(close.recall(course.memory), 0 * speed, 0 * speed, jnp.int32(0), course.steepness)
    start = _Tried(
        state.v, state.v, jnp.zeros_like(state.v), begun, jnp.asarray(False), jnp.int32(0)
    )
    constant = system.force is None and not callable(system.mass) and body.coordinates is None
    least = 1 if constant else MEAN
    end = jax.lax.while_loop(goes_on, solved, start)
    found, v, mean = end.found, end.v, end.mean
    x = struck + found.impulse
    energy = x * close.rates(mean - carried)
    sides = jnp.sum(energy[:, 1:], axis=1)
    moved = state._replace(
        q=body.moved(q, 0.5 * h * v),
        v=v,
        t=t + h,
        work=state.work + h * end.force @ mean,
        base_work=state.base_work + close.pull(x) @ carried,
        contact_work=state.contact_work + close.seen(jnp.stack([energy[:, 0], sides])),
    )
    fails = jnp.asarray(FAILS)[code]
    status = jnp.where(fails, MOTION_CODE["law_failed"], course.status)
    status = jnp.where(out_of_range(system, moved), MOTION_CODE["out_of_range"], status)
    if isinstance(close, _Heap):
        status = jnp.where(close.near.lost, MOTION_CODE["room"], status)
    # a base that is NaN shows in its work, a coefficient in that of the contacts
    finite = jnp.all(jnp.isfinite(v)) & jnp.isfinite(moved.base_work)
    finite &= jnp.all(jnp.isfinite(moved.contact_work))
    status = jnp.where(finite, status, MOTION_CODE["not_finite"])
    if callable(system.mass):
        sound = definite(mass) | ~jnp.all(jnp.isfinite(mass))
        status = jnp.where(sound, status, MOTION_CODE["singular_mass"])
    status = status.astype(jnp.int32)
    if isinstance(body, Discs):  # two of them may pass through each other between two looks
        far = h * jnp.sqrt(jnp.max(jnp.sum(v.reshape(-1, 3)[:, :2] ** 2, axis=1)))
        long = far > jnp.min(body.radii)
    else:
        long = jnp.any(strikes & (course.since < APART))
    coarse = jnp.where(long, MOTION_CODE["coarse_step"], 0)
    missed = jnp.where(found.misfit > OFF, MOTION_CODE["unsolved_step"], 0)
    told = jnp.maximum(course.told, jnp.maximum(coarse, missed)).astype(jnp.int32)
    events = course.events
    if isinstance(close, _Few):
        given = x if joint else struck
        row = {
            "time": middle,
            "kind": jnp.int32(KIND_CODE["impact"]),
            "contacts": strikes,
            "q": q,
            "velocity_before": met,
            "velocity_after": v if joint else met + close.push(struck),
            "impulse": given[:, 0],
            "energy": jnp.stack([energy[:, 0], sides]),
            "status": code,
        }
        if before.shape[1] > 1:
            row["tangential_impulse"] = given[:, 1:].reshape(-1)
        events = with_row(events, jnp.any(strikes), row)
    return _Progress(
        moved,
        speed,
        close.keep(course.memory, found.impulse),
        found.missed,
        found.steepness,
        jnp.where(strikes, 1, course.since + 1),
        events,
        status,
        told,
    )


def _wanted(
    e: jax.Array, e_t: jax.Array, rates: jax.Array, late: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """w (m, b) of `0 <= p _|_ gamma' + w >= 0` and of friction; also with that for the mean slip.

    `rates` (m, b) without the forces of the step, which give struck contacts `late` until they
    strike. Where `w >= rates`, as always in normal direction, impulses give no energy.
    """
    gamma = rates[:, 0]
    normal = jnp.where(gamma < 0, e * (gamma + late) - late, gamma)[:, None]
    slip = rates[:, 1:]
    return (
        jnp.concatenate([normal, e_t[:, None] * slip], axis=1),
        jnp.concatenate([normal, slip], axis=1),
    )


def joins_step(law: Law) -> bool:
    """Whether the law is a condition on v' contact by contact: Moreau's, without a matrix."""
    return isinstance(law, Moreau) and law.restitution.ndim < 2


def _struck(
    law: Law, scene: Scene, v: jax.Array, noise: jax.Array, shape: tuple[int, ...]
) -> tuple[jax.Array, jax.Array]:
    """Impulses (m, b) of the law, and its status."""
    out: Any = impact(law, scene, v, noise)
    x = out.impulse[:, None]
    if shape[1] > 1:
        x = jnp.concatenate([x, out.tangential_impulse.reshape(shape[0], -1)], axis=1)
    return x, out.status
