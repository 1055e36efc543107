"""Events of rigid contacts: the impact, the end of an accumulation, new modes of
contact.

*Fired* are the margins that a step has brought to 0: m of gaps or normal forces, with
friction m more of the cone or the slip. An *accumulation* is an infinite sequence of
impacts in finite time. An *impact without collision* (`paroxysm`) is that of contacts
which friction jams: no contact forces exist, although no contact approaches.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jimpact.core.impacts import impact
from jimpact.core.law import Law
from jimpact.core.scene import Scene
from jimpact.motion.dynamics import (
    carried_along,
    kinetic,
    mass_at,
    not_rounding,
    seen_from_base,
)
from jimpact.motion.flow import Scales, Settings, State, speed_of
from jimpact.motion.persistent_contact import (
    Contacts,
    ModeChoice,
    Modes,
    by_contact,
    choose_with_friction,
    constraint_impulse,
    contacts_at,
    in_space,
    length,
    no_modes,
    pressed_together,
    rest_acceleration,
)
from jimpact.motion.record import KIND_CODE
from jimpact.motion.system import System
from jimpact.tools.masks import choose, quotient
from jimpact.tools.precision import precision
from jimpact.tools.status import CODE, STATUS

# A contact that still approaches is no failure: it has another impact at the same
# instant.
FAILS = tuple(row.failure and row.name != "inadmissible_velocity" for row in STATUS)
# Gap velocities below this share of what the kinetic energy could give are 0: rounding.
REST_SPEED = 1e-9
LEAST_COUPLING = 1e-9  # |W_ij| / sqrt(W_ii W_jj) of two contacts: less is rounding
# An impact without collision is that of contacts that approach at the root of rounding,
# of the slip: it errs by about as much. MORE times what is left of `regularity` is
# added to this, or contacts would part before they are wedged.
MORE = 10.0
# Slips that change by less than SUPPLIED approaches change by what any impact does.
SUPPLIED = 100.0
# Of the speed scale of the motion: slip in space below it has stopped where a step
# landed on its end. Ten times more: slip that turns round as slowly as this is taken to
# stop.
STOPPED = 1e-7


class Jump(NamedTuple):
    """Velocities after an event, and the impulses, energies and status that belong to
    them.
    """

    v: Float[Array, " n"]
    impulse: Float[Array, " m"]  # [N s] normal
    tangential: Float[Array, " t"]  # [N s]
    energy: Float[Array, "2 m"]  # [J] change by each contact, normal and tangential
    base_work: Float[Array, ""]  # [J]
    code: Int[Array, ""]  # status of the law


def no_jump(state: State, m: int, tangents: int) -> Jump:
    """Jump with the velocities of the state and impulses 0, m normal and `tangents`
    others.
    """
    dtype = state.v.dtype
    return Jump(
        v=state.v,
        impulse=jnp.zeros(m, dtype),
        tangential=jnp.zeros(tangents, dtype),
        energy=jnp.zeros((2, m), dtype),
        base_work=jnp.zeros_like(state.work),
        code=jnp.int32(CODE["ok"]),
    )


def scene_at(
    system: System,
    q: Float[Array, " nq"],
    t: Float[Array, ""],
    closed: Bool[Array, " m"],
) -> Scene:
    """Scene of an impact at q: mass, normals, tangents; gap 0 of closed contacts, inf
    of others.
    """
    seen = seen_from_base(system, q, t)
    _, normals, tangents = system.body.directions(seen)
    away = jnp.where(closed, 0.0, jnp.inf)
    gap = away.astype(q.dtype)
    mass = mass_at(system, q)
    return Scene(mass, normals, tangents, gap)


def impact_jump(
    system: System,
    law: Law,
    t: Float[Array, ""],
    state: State,
    closed: Bool[Array, " m"],
    noise: Float[Array, ""],
    approach: Float[Array, ""] | None,
) -> Jump:
    """Jump by `impact` in the frame of the base: v is seen as `v - B y_b'`.

    Equation: a contact gives `p N^T (v- + v+) / 2` [J], tangentially
    `p_t . H^T (v- + v+) / 2`, the base `(N p + H p_t) . B y_b'`. Gap velocities up to
    `noise` [m/s] are rounding; `approach`: see `impact`.
    """
    m = len(closed)
    scene = scene_at(system, state.q, t, closed)
    normals = scene.normals
    carried = carried_along(system, state.v, t)
    relative = state.v - carried
    out = impact(law, scene, relative, noise, approach)
    p = out.impulse
    mean = 0.5 * (out.velocity + relative)
    push = normals @ p
    normal = (normals.T @ mean) * p
    p_t = jnp.zeros(m, normal.dtype)
    friction = jnp.zeros(m, normal.dtype)
    if scene.tangents is not None:
        p_t = out.tangential_impulse
        slip = scene.tangents.T @ mean
        work = slip * p_t
        friction = by_contact(work, m).sum(axis=1)
        push = push + scene.tangents @ p_t
    energy = jnp.stack([normal, friction])
    v = out.velocity + carried
    base_work = push @ carried
    return Jump(v, p, p_t, energy, base_work, out.status)


def tangent_count_of(system: System, q: Float[Array, " nq"], m: int) -> int:
    """Number t of tangential impulses of m contacts; m for a body without tangents."""
    tangents = jax.eval_shape(system.body.tangents, q)
    if tangents is None:
        return m
    _, count = tangents.shape
    return int(count)


class Passed(NamedTuple):
    """Rest of an accumulation that is passed at once, as estimated; 0 where there is
    none.
    """

    time: Float[Array, ""]  # [s] that the impacts left out would take
    gap: Float[Array, ""]  # [m] to which contacts might open within it


class After(NamedTuple):
    """Parts of an event that have derivatives."""

    state: State
    jump: Jump
    passed: Passed


class Outcome(NamedTuple):
    """An event: state and modes after it, and the numbers that the record holds."""

    after: After
    strikes: Bool[Array, ""]  # there is an impact
    scales: Scales
    modes: Modes
    kind: Int[Array, ""]  # index of `record.EVENT_KINDS`
    contacts: Bool[Array, " m"]  # that take part
    code: Int[Array, ""]  # status of the law, or that there are several solutions
    status: Int[Array, ""]  # of the motion
    # [m/s] gap velocity of the impact without collision that must come next, 0 where
    # none must
    approach: Float[Array, ""]
    several: Bool[Array, ""]  # contact forces are not unique


def resolve(
    system: System,
    law: Law,
    mu: Float[Array, " m"] | None,
    settings: Settings,
    state: State,
    old: Modes,
    fired: Bool[Array, " f"],
    scales: Scales,
    struck: Bool[Array, " m"],
    approach: Float[Array, ""],
) -> Outcome:
    """Resolve an event: impact if a closed contact approaches; contacts come to rest;
    new modes.

    Args:
        old: modes up to now.
        fired: (m,), with friction (2 m,) margins that have come to 0.
        scales: largest values of the motion so far.
        struck: contacts that had an impact before.
        approach: [m/s] of an impact without collision that is due, else 0.

    A closed contact remains closed if it leaves by no more than rounding, or slower
    than `settings.accumulation` and would be pressed back: the rest of its infinite
    sequence of impacts is then passed at once (its gap velocity is set to 0, energy is
    lost).

    Where friction leaves no contact forces, the next event, at the same instant, is an
    impact without collision: the limit of that of contacts that approach ever more
    slowly. They do at `approach` here.

    Clusters: where contacts share bodies, accumulations are nested: their numbers of
    impacts multiply. A contact that shares a body with another one that is closed or
    was `struck` before remains closed below the square root of that share of velocity,
    which is that share of height. That is done for all of them at once, and only if no
    other contact is reached within the time that is passed: the state after it is then
    that at the end of the sequence.
    """
    strike = _impact_if_any(system, law, settings, state, scales, approach)
    gamma = strike.contacts.normal.rate
    rests = jnp.abs(gamma) <= strike.rest  # f' = 0
    tight = strike.closed & rests
    m = len(gamma)
    stopped = jnp.zeros(m, bool)
    if settings.spatial:
        fired, stopped = _fired_in_space(settings, strike, old, fired)
    result = _brought_slow_to_rest(system, mu, settings, strike, struck, tight, stopped)
    jump = result.jump
    at_rest = state._replace(v=jump.v)
    choice, held, released = _next_modes(
        system, mu, settings, strike, result, at_rest, old, fired
    )
    status, code, next_approach = _status(strike, jump, choice, held)
    of_contacts = fired.reshape(-1, m)
    any_fired = jnp.any(of_contacts, axis=0)
    pushed = jump.impulse != 0
    takes_part = jnp.where(strike.happens, pushed, any_fired)
    taking_part = takes_part | choice.parts
    end = _with_jump(state, jump)
    after = After(end, jump, result.passed)
    parts = released[:m] | choice.parts
    any_ends = jnp.any(result.ends)
    kind = _kind(strike.happens, strike.jams, any_ends, parts, fired)
    return Outcome(
        after=after,
        strikes=strike.happens,
        scales=strike.scales,
        modes=choice.modes,
        kind=kind,
        contacts=taking_part,
        code=code,
        status=status,
        approach=next_approach,
        several=choice.several,
    )


def slip_stops(
    settings: Settings,
    old: Modes,
    fired: Bool[Array, " m"],
    speed: Float[Array, " m"],
    speed_scale: Float[Array, ""],
) -> Bool[Array, " m"]:
    """True where a contact that slid, and whose margin of friction has `fired`, has
    stopped.

    In space only where its slip `speed` [m/s] is at most STOPPED of the scale: a step
    may turn slip by so much that it lands on `u . d = 0` although slip goes on.
    """
    slid = fired & ~old.stick
    if not settings.spatial:
        return slid
    slow = speed <= STOPPED * speed_scale
    return slid & slow


def _fired_in_space(
    settings: Settings, strike: "_Strike", old: Modes, fired: Bool[Array, " f"]
) -> tuple[Bool[Array, " f"], Bool[Array, " m"]]:
    """Margins that have fired (2 m,) without those that are no events, and stopped
    contacts (m,).

    A step may turn slip by so much that it lands although slip goes on, or slip may no
    longer only begin: these are no events.
    """
    assert strike.contacts.tangent is not None
    m = len(old.active)
    u = by_contact(strike.contacts.tangent.rate, m)
    margins = fired[m:]
    stopped = slip_stops(settings, old, margins, length(u), strike.scales.speed)
    changes = old.stick | stopped
    of_friction = margins & changes
    return fired.at[m:].set(of_friction), stopped


class _Strike(NamedTuple):
    """An event after its impact, if there is one."""

    t: Float[Array, ""]
    earlier: Contacts  # with the velocities before it
    contacts: Contacts  # with the velocities after it
    closed: Bool[Array, " m"]
    happens: Bool[Array, ""]  # there is an impact
    jams: Bool[Array, ""]  # it is one without collision
    approach: Float[Array, ""]  # [m/s] of that one, else 0
    scales: Scales
    rest: Float[Array, ""]  # [m/s] smaller gap velocities are rounding
    jump: Jump


def _impact_if_any(
    system: System,
    law: Law,
    settings: Settings,
    state: State,
    scales: Scales,
    approach: Float[Array, ""],
) -> _Strike:
    """The impact of contacts with f' < -rest at closed gaps, or one without collision
    if due.

    Its jump is empty where neither is so.
    """
    t = state.t
    contacts = contacts_at(system, state.q, state.v, t, settings.friction)
    normal = contacts.normal
    closed = normal.value <= settings.closed_below
    scales = _largest_scales(system, settings, scales, contacts, state)
    rest = _rest_speed(settings, scales)
    jams = approach > 0
    approaches = normal.rate < -rest
    strikes = jnp.any(closed & approaches) | jams
    jump = _jump_if(strikes, system, law, settings, state, approach, closed, scales)
    after = contacts_at(system, state.q, jump.v, t, settings.friction)
    return _Strike(
        t=t,
        earlier=contacts,
        contacts=after,
        closed=closed,
        happens=strikes,
        jams=jams,
        approach=approach,
        scales=scales,
        rest=rest,
        jump=jump,
    )


def _brought_slow_to_rest(
    system: System,
    mu: Float[Array, " m"] | None,
    settings: Settings,
    strike: _Strike,
    struck: Bool[Array, " m"],
    tight: Bool[Array, " m"],
    stopped: Bool[Array, " m"],
) -> "_Resting":
    """Contacts brought to rest: `tight` ones (f' = 0), and slow ones that would be
    pressed back.

    Slow: |f'| at most `accumulation` times the largest gap velocity, or a hop within
    the rounding of gaps. Slip comes to rest, too, where it has `stopped` or is as slow.
    """
    contacts = strike.contacts
    scales = strike.scales
    closed = strike.closed
    m = len(tight)
    through = ~strike.jams
    gamma = contacts.normal.rate
    slowly = settings.accumulation * scales.gap_velocity
    # a hop below the rounding of gaps is none: it would strike faster than it left
    smallest_hop = 2 * scales.acceleration * settings.gap_rounding
    of_hop = jnp.sqrt(smallest_hop)
    slowly = jnp.maximum(slowly, of_hop)
    supplied = SUPPLIED * strike.approach
    slowly = jnp.maximum(slowly, supplied)
    stick = jnp.zeros(m, bool)
    if contacts.tangent is not None:
        u = by_contact(contacts.tangent.rate, m)
        stick = stopped | (length(u) <= slowly)

    def resting(slow: Bool[Array, " m"]) -> _Resting:
        """Velocities after the `slow` contacts that would come back are stopped.

        These have a positive force in `0 <= lambda _|_ W lambda + approach >= 0`.
        """
        slack = _slack(strike)
        pressed, kept_closed, force = pressed_together(contacts, slow, slack)
        stopped = tight | (slow & pressed)
        stop = _brought_to_rest(
            system, contacts, mu, stopped, stick, strike.t, strike.jump
        )
        # redundant contacts come to rest with others
        left = gamma + contacts.delassus[:m] @ stop.impulse  # gap velocities after it
        rests = jnp.abs(left) <= strike.rest
        at_rest = closed & rests
        # a contact accumulates if it was brought to rest from more than rounding
        moved = at_rest & ~tight
        ends = moved & strike.happens & through
        lost = -jnp.sum(strike.jump.energy)
        passed = _passed(stop, ends, lost)
        return _Resting(pressed, kept_closed, at_rest, force, ends, stop.jump, passed)

    size = jnp.abs(gamma)
    slow = closed & (size <= slowly)
    if m == 1:
        return resting(slow)
    shares = _share_bodies(contacts, closed | struck)
    faster = jnp.sqrt(settings.accumulation) * scales.gap_velocity
    struck_now = closed & strike.happens & through
    nested = struck_now & shares & (size <= faster)
    both = jax.lax.map(resting, jnp.stack([slow, slow | nested]))
    alone = jax.tree.map(lambda x: x[0], both)
    cluster = jax.tree.map(lambda x: x[-1], both)
    undisturbed = _undisturbed(system, contacts, cluster, strike.t)

    return choose(undisturbed, cluster, alone)


def _slack(strike: _Strike) -> Float[Array, ""]:
    """Gap acceleration [m/s^2] below which it is rounding: a share of the largest
    one.
    """
    share = rest_acceleration(strike.rest.dtype)
    return share * strike.scales.acceleration


def _next_modes(
    system: System,
    mu: Float[Array, " m"] | None,
    settings: Settings,
    strike: _Strike,
    result: "_Resting",
    state: State,
    old: Modes,
    fired: Bool[Array, " f"],
) -> tuple[ModeChoice, Bool[Array, " m"], Bool[Array, " f"]]:
    """Modes after an event, by complementarity of forces and accelerations at resting
    contacts.

    Equation: `0 <= lambda_n _|_ a_n >= 0` with `a = W lambda + approach` at `state`;
    with friction `|lambda_t| <= mu lambda_n`, and equality against the slip, see
    `choose_with_friction`. Without friction `pressed_together` has solved it; a contact
    that neither presses nor parts stays closed unless its force has just fallen to 0.

    Returns modes; contacts at rest; constraints (normal, with friction tangential) that
    the step has `fired` and that held before: they are released.
    """
    contacts = strike.contacts
    rest = strike.rest
    # what velocities before the rest would still turn, redundant contacts fight
    if mu is not None:
        contacts = contacts_at(system, state.q, state.v, strike.t, friction=True)
    held = result.at_rest
    active = old.active
    if settings.friction:
        active = jnp.tile(active, 2)
    released = fired & active & ~strike.happens
    if mu is not None:
        slack = _slack(strike)
        choice = _with_friction(contacts, mu, old, held, released, rest, slack)
        return choice, held, released
    m = len(held)
    stays = held & result.kept_closed & ~released
    persistent = result.pressed | stays
    no = jnp.asarray(False)
    modes = no_modes(m, rest.dtype)
    modes = modes._replace(active=persistent)
    none = jnp.zeros(m, bool)
    choice = ModeChoice(modes, ~no, rest, no, none)
    return choice, held, released


def _status(
    strike: _Strike, jump: Jump, choice: ModeChoice, held: Bool[Array, " m"]
) -> tuple[Int[Array, ""], Int[Array, ""], Float[Array, ""]]:
    """Status of the motion, that of the law, and approach [m/s] of a following
    paroxysm.

    A paroxysm is an impact without collision: in the plane it is due where the modes
    are not consistent and a contact at rest (`held`) slips. Where it changed nothing,
    or none is possible, the status is `no_contact_force`.
    """
    failures = jnp.asarray(FAILS)
    fails = failures[jump.code]
    status = jnp.where(fails, CODE["law_failed"], CODE["ok"])
    code = jump.code
    next_approach = jnp.zeros_like(strike.rest)
    now = strike.contacts.tangent
    earlier = strike.earlier.tangent
    if now is not None and earlier is not None:
        change = jnp.max(jnp.abs(now.rate - earlier.rate))
        if not in_space(strike.contacts):
            approach = _approach(choice, now.rate, held)
            next_approach = jnp.where(choice.consistent, 0.0, approach)
        in_vain = change <= SUPPLIED * strike.approach
        jammed = strike.jams & in_vain
        no_impact = next_approach == 0
        stuck = ~choice.consistent & no_impact
        status = jnp.where(jammed | stuck, CODE["no_contact_force"], status)
        with_several = jnp.maximum(code, CODE["several_outcomes"])
        code = jnp.where(choice.several, with_several, code)
    return status, code, next_approach


class _Resting(NamedTuple):
    """Contacts at rest after slow ones were stopped, and the jump with that."""

    pressed: Bool[Array, " m"]  # with a normal force
    kept_closed: Bool[Array, " m"]  # neither force nor gap acceleration
    at_rest: Bool[Array, " m"]  # closed, without gap velocity
    force: Float[Array, " m"]  # normal forces [N]
    ends: Bool[Array, " m"]  # contacts whose impacts accumulate here
    jump: Jump
    passed: Passed


def _share_bodies(contacts: Contacts, touched: Bool[Array, " m"]) -> Bool[Array, " m"]:
    """True where a contact i is coupled to a `touched` one j:
    `|W_ij| > eps sqrt(W_ii W_jj)`.
    """
    m = len(touched)
    w = jnp.abs(contacts.delassus[:m, :m])
    size = jnp.sqrt(jnp.diagonal(w))
    itself = jnp.eye(m, dtype=bool)
    others = touched[None] & ~itself
    scale = jnp.outer(size, size)
    coupled = w > LEAST_COUPLING * scale
    to_touched = others & coupled
    return jnp.any(to_touched, axis=1)


def _undisturbed(
    system: System, contacts: Contacts, result: _Resting, t: Float[Array, ""]
) -> Bool[Array, ""]:
    """True where no other contact closes within the time that an accumulation takes.

    Gaps fall as parabolas `f + f' s + f'' s^2 / 2` with the forces of the resting
    contacts.
    """
    m = len(result.at_rest)
    v = result.jump.v
    gap = jnp.maximum(contacts.normal.value, 0.0)
    normals = contacts.normal.gradient
    carried = carried_along(system, v, t)
    rate = normals.T @ (v - carried)
    by_force = contacts.delassus[:m, :m] @ result.force
    fall = contacts.approach[:m] + by_force
    square = rate * rate - 2 * fall * gap
    root = jnp.sqrt(jnp.maximum(square, 0.0))
    # time of the zero: with f' < 0 in a form without cancellation
    falls = fall < 0
    falling = jnp.where(falls, -fall, 1.0)
    later = (rate + root) / falling
    approaches = rate < 0
    reached = quotient(2 * gap, root - rate, where=approaches, otherwise=later)
    rises = (rate >= 0) & (fall >= 0)
    never = (square < 0) | rises
    too_late = reached > result.passed.time
    free = result.at_rest | never | too_late
    return jnp.all(free)


def _approach(
    choice: ModeChoice, slip: Float[Array, " m"], held: Bool[Array, " m"]
) -> Float[Array, ""]:
    """Gap velocity [m/s] of an impact without collision: a share of the largest slip of
    `held`.

    The share is the root of rounding, and MORE of what is left of the regularity.
    """
    root = precision(slip.dtype).root
    left = jnp.clip(choice.regularity, 0.0, 2 * root)
    share = root + MORE * left
    speed = jnp.abs(slip)
    of_held = jnp.where(held, speed, 0.0)
    fastest = jnp.max(of_held)
    return jax.lax.stop_gradient(share * fastest)


def velocity_noise(
    settings: Settings, acceleration: Float[Array, ""]
) -> Float[Array, ""]:
    """Velocity [m/s] that this acceleration [m/s^2] gives within the rounding of
    time.
    """
    duration = jnp.abs(jax.lax.stop_gradient(settings.duration))
    rounding = precision(duration.dtype).accumulated
    return rounding * duration * acceleration


def _rest_speed(settings: Settings, scales: Scales) -> Float[Array, ""]:
    """Gap velocity [m/s] below which it is 0: a share of `scales.speed`, and
    `velocity_noise`.
    """
    rounding = velocity_noise(settings, scales.acceleration)
    share = not_rounding(REST_SPEED, rounding.dtype)
    return share * scales.speed + rounding


def _jump_if(
    strikes: Bool[Array, ""],
    system: System,
    law: Law,
    settings: Settings,
    state: State,
    approach: Float[Array, ""],
    closed: Bool[Array, " m"],
    scales: Scales,
) -> Jump:
    """`impact_jump` of the closed contacts if one `strikes`, else `no_jump`."""
    if settings.friction:
        lead = approach
    else:
        lead = None
    noise = _rest_speed(settings, scales)
    m = len(closed)
    tangents = tangent_count_of(system, state.q, m)
    return jax.lax.cond(
        strikes,
        lambda: impact_jump(system, law, state.t, state, closed, noise, lead),
        lambda: no_jump(state, m, tangents),
    )


def _with_jump(state: State, jump: Jump) -> State:
    """State with the velocities after a jump, and the works that it did."""
    return state._replace(
        v=jump.v,
        base_work=state.base_work + jump.base_work,
        contact_work=state.contact_work + jump.energy,
    )


def _with_friction(
    contacts: Contacts,
    mu: Float[Array, " m"],
    old: Modes,
    held: Bool[Array, " m"],
    released: Bool[Array, " 2*m"],
    rest: Float[Array, ""],
    slack: Float[Array, ""],
) -> ModeChoice:
    """`choose_with_friction` of the `held` contacts; slips above `rest` [m/s] slide."""
    assert contacts.tangent is not None
    u = by_contact(contacts.tangent.rate, len(mu))
    slides = length(u) > rest
    return choose_with_friction(contacts, mu, old, held, released, slides, slack)


def _largest_scales(
    system: System, settings: Settings, scales: Scales, contacts: Contacts, state: State
) -> Scales:
    """Largest values of the motion so far, those of this state included; without
    derivatives.

    Equation: `max |f'|`; `speed_of` the kinetic energy, absolute and seen from the
    base, at least `sqrt(a closed_below)`; a, the largest of |f''| without contact
    forces, the sum of the sizes of its terms, and the speed over the duration.
    """
    q = state.q
    v = state.v
    rate = contacts.normal.rate
    m = len(rate)
    relative = v - carried_along(system, v, state.t)
    absolute = kinetic(system, q, v)
    from_base = kinetic(system, q, relative)
    energy = jnp.maximum(absolute, from_base)
    w = jnp.diagonal(contacts.delassus)
    speed = speed_of(energy, w)
    # the terms of an acceleration may cancel: what bodies side by side leave of it is
    # rounding, and so is what does not change the speed within the motion
    normals = jnp.abs(contacts.directions[:, :m])
    terms = normals.T @ jnp.abs(contacts.free)
    approach = jnp.abs(contacts.approach[:m])
    acceleration = jnp.maximum(approach, terms).max()
    steady = speed / settings.duration
    acceleration = jnp.maximum(acceleration, steady)
    square = acceleration * settings.closed_below
    speed = jnp.maximum(speed, jnp.sqrt(square))
    fastest = jnp.abs(rate).max()
    now = Scales(fastest, speed, acceleration)
    largest = jax.tree.map(jnp.maximum, scales, now)
    return jax.lax.stop_gradient(largest)


class _Stop(NamedTuple):
    """Contacts that are brought to rest."""

    jump: Jump  # with the velocities after it
    impulse: Float[Array, " k"]  # that does it [N s]
    force: Float[Array, " m"]  # that will keep contacts closed [N]
    energy: Float[Array, ""]  # that it takes [J]


def _brought_to_rest(
    system: System,
    contacts: Contacts,
    mu: Float[Array, " m"] | None,
    held: Bool[Array, " m"],
    stick: Bool[Array, " m"],
    t: Float[Array, ""],
    jump: Jump,
) -> _Stop:
    """Gap velocities of `held` contacts set to 0, and the slip of those that `stick`.

    Equation: `W p = -rates` and `W force = -approach` in these rows, `v += M^-1 D p`;
    the contacts give the energy `p rates / 2`, as their mean velocity is half of that
    before.
    """
    m = len(held)
    open_modes = no_modes(m, jump.v.dtype)
    modes = open_modes._replace(active=held, stick=stick)
    rates = contacts.normal.rate
    if contacts.tangent is not None:
        rates = jnp.concatenate([rates, contacts.tangent.rate])
    size = rates.shape[0]
    approach = contacts.approach[:size]
    columns = jnp.stack([rates, approach], axis=1)
    p, force = constraint_impulse(contacts, mu, modes, columns).T
    # work at the mean velocity: half of that before, 0 after
    work = 0.5 * p * rates
    tangential = jnp.zeros_like(jump.tangential)
    by_normal = work[:m]
    no_friction = jnp.zeros_like(by_normal)
    energy = jnp.stack([by_normal, no_friction])
    if contacts.tangent is not None:
        by_friction = by_contact(work[m:], m).sum(axis=1)
        energy = energy.at[1].set(by_friction)
        tangential = p[m:]
    # the gaps, up to `closed_below`, are closed by the flight that follows
    push = force[:m]
    lost = jnp.maximum(push, 0.0) * contacts.normal.value
    fallen = jnp.where(held, lost, 0.0)
    carried = carried_along(system, jump.v, t)
    impulse = contacts.directions @ p
    given = jump.energy + energy
    stopped = jump._replace(
        v=jump.v + contacts.moved @ p,
        impulse=jump.impulse + p[:m],
        tangential=jump.tangential + tangential,
        energy=given.at[0].add(-fallen),
        base_work=jump.base_work + impulse @ carried,
    )
    energy_before = -jnp.sum(work)
    return _Stop(stopped, p, push, energy_before)


def _passed(stop: _Stop, ends: Bool[Array, " m"], lost: Float[Array, ""]) -> Passed:
    """Time [s] and height [m] of the hops that a stop leaves out.

    `ends`: the k contacts that stop. Under the force F that will keep one closed a hop
    takes 2 p / F, and the energy E that the stop takes lifts it by E / F at most; the
    longest hop and the highest lift count. `lost` [J] is the loss of the last impact:
    an impact keeps `r^2 = E / (E + lost)` of the energy. Hops of k contacts that strike
    in turn take `2 k p / F (1 + r + r^2 + ..) = 2 k p / F / (1 - r)`: exact for one
    contact. Both are 0 where nothing is pressed, or no energy is left.
    """
    p = stop.impulse[: len(ends)]  # those along the normals come first
    energy = stop.energy
    has_force = stop.force > 0
    pressed = ends & has_force
    force = jnp.where(pressed, stop.force, 1.0)
    some = jnp.any(pressed) & (energy > 0)
    # energy before the last impact
    earlier = energy + jnp.maximum(lost, 0)
    divisor = jnp.where(some, earlier, 1.0)
    # 1/2 where nothing is passed: not used
    left = jnp.where(some, energy, 0.25)
    r = jnp.sqrt(left / divisor)
    duration = 2 * jnp.abs(p) / force
    height = energy / force
    hops = jnp.where(pressed, duration, 0.0)
    lifts = jnp.where(pressed, height, 0.0)
    hop = jnp.max(hops)
    lift = jnp.max(lifts)
    k = jnp.sum(ends.astype(p.dtype))
    time = k * hop / (1 - r)
    return Passed(time, lift)


def _kind(
    strikes: Bool[Array, ""],
    jams: Bool[Array, ""],
    ends: Bool[Array, ""],
    parts: Bool[Array, " m"],
    fired: Bool[Array, " f"],
) -> Int[Array, ""]:
    """Kind of the event; the later of these that holds.

    none (at the start), contact, friction: a margin has `fired`; detachment: a contact
    `parts`; impact where one `strikes`: accumulation if it `ends` one, paroxysm if it
    `jams`.
    """
    m = len(parts)
    meets = jnp.any(fired[:m])
    kind = jnp.where(meets, KIND_CODE["contact"], KIND_CODE["none"])
    rubs = jnp.any(fired[m:])
    kind = jnp.where(rubs, KIND_CODE["friction"], kind)
    kind = jnp.where(jnp.any(parts), KIND_CODE["detachment"], kind)
    hit = jnp.where(ends, KIND_CODE["accumulation"], KIND_CODE["impact"])
    hit = jnp.where(jams, KIND_CODE["paroxysm"], hit)
    return jnp.where(strikes, hit, kind).astype(jnp.int32)
