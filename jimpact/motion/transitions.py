"""What happens at an event: the impact, the end of an accumulation, new modes of contact."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

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
from jimpact.motion.flow import Scales, Settings, State, selected, speed_of
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
from jimpact.tools.precision import precision
from jimpact.tools.status import CODE, STATUS

# A contact that still approaches is no failure: it has another impact at the same instant.
FAILS = tuple(row.failure and row.name != "inadmissible_velocity" for row in STATUS)
# Gap velocities below this share of what the kinetic energy could give are 0: rounding.
REST_SPEED = 1e-9
LEAST_COUPLING = 1e-9  # |W_ij| / sqrt(W_ii W_jj) of two contacts: less is rounding
# An impact without collision is that of contacts that approach at the root of rounding, of the
# slip: it errs by about as much. MORE times what is left of `regularity` is added to this, or
# contacts would part before they are wedged.
MORE = 10.0
# Slips that change by less than SUPPLIED approaches change by what any impact does.
SUPPLIED = 100.0
# Of the speed scale of the motion: slip in space below it has stopped where a step landed on its
# end. Ten times more: slip that turns round as slowly as this is taken to stop.
STOPPED = 1e-7


class Jump(NamedTuple):
    """What the contacts do to the velocities at one event; all impulses [N s]."""

    v: jax.Array
    impulse: jax.Array  # (m,)
    tangential: jax.Array  # (m,), in space (2 m,)
    energy: jax.Array  # (2, m): change by each contact, normal and tangential
    base_work: jax.Array
    code: jax.Array  # of the law


def no_jump(state: State, m: int, tangents: int) -> Jump:
    """Nothing happens, at m contacts with so many tangential impulses."""
    zero = jnp.zeros_like(state.work)
    none, side = jnp.zeros(m, state.v.dtype), jnp.zeros(tangents, state.v.dtype)
    return Jump(state.v, none, side, jnp.zeros((2, m), none.dtype), zero, jnp.int32(CODE["ok"]))


def scene_at(system: System, q: jax.Array, t: jax.Array, closed: jax.Array) -> Scene:
    """The scene that a law sees: normals and tangents at q; open contacts are out of reach."""
    _, normals, tangents = system.body.directions(seen_from_base(system, q, t))
    away = jnp.where(closed, 0.0, jnp.inf).astype(q.dtype)
    return Scene(mass_at(system, q), normals, tangents, away)


def impact_jump(
    system: System,
    law: Law,
    t: jax.Array,
    state: State,
    closed: jax.Array,
    noise: jax.Array,
    approach: jax.Array | None,
) -> Jump:
    """`impact` in the frame of the base, and what it does to energies.

    Gap velocities up to `noise` are rounding, on the scale of the motion; `approach`: see `impact`.
    """
    m = closed.shape[0]
    scene = scene_at(system, state.q, t, closed)
    carried = carried_along(system, state.v, t)
    relative = state.v - carried
    out = impact(law, scene, relative, noise, approach)
    mean = 0.5 * (out.velocity + relative)
    push = scene.normals @ out.impulse
    normal = (scene.normals.T @ mean) * out.impulse
    tangential, side = jnp.zeros(m, normal.dtype), jnp.zeros(m, normal.dtype)
    if scene.tangents is not None:
        tangential = out.tangential_impulse
        side = by_contact((scene.tangents.T @ mean) * tangential, m).sum(axis=1)
        push = push + scene.tangents @ tangential
    energy = jnp.stack([normal, side])
    return Jump(out.velocity + carried, out.impulse, tangential, energy, push @ carried, out.status)


def tangent_count_of(system: System, q: jax.Array, m: int) -> int:
    """The number of tangential impulses of m contacts; m without tangents, too."""
    tangents = jax.eval_shape(system.body.tangents, q)
    return m if tangents is None else int(tangents.shape[1])


class Passed(NamedTuple):
    """What of an accumulation is passed at once, as estimated; 0 where there is none."""

    time: jax.Array  # () [s]
    gap: jax.Array  # () [m] to which its contacts might open within it


class After(NamedTuple):
    """The smooth part of an event."""

    state: State
    jump: Jump
    passed: Passed


class Outcome(NamedTuple):
    """What happens at an event, and how it goes on."""

    after: After
    strikes: jax.Array  # () whether there is an impact
    scales: Scales
    modes: Modes
    kind: jax.Array
    contacts: jax.Array  # (m,)
    code: jax.Array  # of the law, or that there are several solutions
    status: jax.Array
    approach: jax.Array  # where there are no contact forces: of the impact without collision next
    several: jax.Array  # whether there are several


def resolve(
    system: System,
    law: Law,
    mu: jax.Array | None,
    settings: Settings,
    state: State,
    before: Modes,
    fired: jax.Array,
    scales: Scales,
    struck: jax.Array,
    approach: jax.Array,
) -> Outcome:
    """Impact if a closed contact approaches; contacts come to rest; new modes.

    A closed contact remains closed if it leaves by no more than rounding, or slower than
    `settings.accumulation` and would be pressed back: the rest of its infinite sequence of
    impacts is then passed at once (its gap velocity is set to 0, energy is lost).

    Where friction leaves no contact forces, the next event, at the same instant, is an impact
    without collision: the limit of that of contacts that approach ever more slowly. `approach` ()
    is how fast they do at this one, 0 where it is an ordinary event.

    Clusters: where contacts share bodies, accumulations are nested: their numbers of impacts
    multiply. A contact that shares a body with another one that is closed or was `struck` before
    remains closed below the square root of that share of velocity, which is that share of height.
    That is done for all of them at once, and only if no other contact is reached within the time
    that is passed: the state after it is then that at the end of the sequence.
    """
    strike = _impact_first(system, law, settings, state, scales, approach)
    tight = strike.closed & (jnp.abs(strike.contacts.normal.rate) <= strike.rest)
    m = before.active.shape[0]
    stopped = jnp.zeros(m, bool)
    if settings.spatial:
        fired, stopped = _fired_in_space(settings, strike, before, fired)
    result = _brought_slow_to_rest(system, mu, settings, strike, struck, tight, stopped)
    jump = result.jump
    at_rest = state._replace(v=jump.v)
    choice, held, released = _next_modes(
        system, mu, settings, strike, result, at_rest, before, fired
    )
    status, code, wedges = _status(strike, jump, choice, held)
    took = jnp.where(strike.happens, jump.impulse != 0, jnp.any(fired.reshape(-1, m), axis=0))
    took = took | choice.parts
    after = After(_with_jump(state, jump), jump, result.passed)
    parts = released[:m] | choice.parts
    kind = _kind(strike.happens, strike.jams, jnp.any(result.ends), parts, fired)
    return Outcome(
        after, strike.happens, strike.scales, choice.modes, kind, took, code, status, wedges,
        choice.several,
    )  # fmt: skip


def slip_stops(
    settings: Settings, before: Modes, fired: jax.Array, speed: jax.Array, speed_scale: jax.Array
) -> jax.Array:
    """Which contacts (m,) that slid, and whose margin has `fired`, have stopped at this `speed`.

    In space a step may turn slip by so much that it lands although slip goes on.
    """
    slid = fired & ~before.stick
    return slid & (speed <= STOPPED * speed_scale) if settings.spatial else slid


def _fired_in_space(
    settings: Settings, strike: "_Strike", before: Modes, fired: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """What has `fired` (2 m,), and where slip in space has stopped (m,).

    A step may turn slip by so much that it lands although slip goes on, or slip may no longer
    only begin: these are no events.
    """
    assert strike.contacts.tangent is not None
    m = before.active.shape[0]
    speed = length(by_contact(strike.contacts.tangent.rate, m))
    stopped = slip_stops(settings, before, fired[m:], speed, strike.scales.speed)
    return fired.at[m:].set(fired[m:] & (before.stick | stopped)), stopped


class _Strike(NamedTuple):
    """An event after its impact, if there is one."""

    t: jax.Array  # ()
    before: Contacts
    contacts: Contacts  # with the velocities after it
    closed: jax.Array  # (m,)
    happens: jax.Array  # () whether there is an impact
    jams: jax.Array  # () whether it is one without collision
    approach: jax.Array  # () of that one, else 0
    scales: Scales
    rest: jax.Array  # () gap velocities that are rounding
    jump: Jump


def _impact_first(
    system: System,
    law: Law,
    settings: Settings,
    state: State,
    scales: Scales,
    approach: jax.Array,
) -> _Strike:
    """The impact, where a closed contact approaches or one without collision is due."""
    t = state.t
    before = contacts_at(system, state.q, state.v, t, settings.friction)
    closed = before.normal.value <= settings.closed_below
    scales = _grown(system, settings, scales, before, state)
    rest = _rest(settings, scales)
    jams = approach > 0
    strikes = jnp.any(closed & (before.normal.rate < -rest)) | jams
    jump = _struck(system, law, settings, state, strikes, approach, closed, scales)
    contacts = contacts_at(system, state.q, jump.v, t, settings.friction)
    return _Strike(t, before, contacts, closed, strikes, jams, approach, scales, rest, jump)


def _brought_slow_to_rest(
    system: System,
    mu: jax.Array | None,
    settings: Settings,
    strike: _Strike,
    struck: jax.Array,
    tight: jax.Array,
    stopped: jax.Array,
) -> "_Resting":
    """What comes to rest: contacts (m,) that are `tight`, and slow ones.

    Slip comes to rest where it has `stopped` (m,) or is slow.
    """
    contacts, scales, closed = strike.contacts, strike.scales, strike.closed
    m, gamma = tight.shape[0], contacts.normal.rate
    slowly = settings.accumulation * scales.gap_velocity
    # a hop below the rounding of gaps is none: it would strike faster than it left
    least_hop = 2 * scales.acceleration * settings.gap_rounding
    slowly = jnp.maximum(slowly, jnp.sqrt(least_hop))
    slowly = jnp.maximum(slowly, SUPPLIED * strike.approach)
    stick = jnp.zeros(m, bool)
    if contacts.tangent is not None:
        stick = stopped | (length(by_contact(contacts.tangent.rate, m)) <= slowly)

    def resting(slow: jax.Array) -> _Resting:
        """What comes to rest if `slow` contacts (m,) may.

        A slow contact stops where its normal force in `0 <= lambda _|_ W lambda + approach >= 0`
        is positive: it would come back.
        """
        pressed, kept_closed, force = pressed_together(contacts, slow, _slack(strike))
        stopped = tight | (slow & pressed)
        stop = _brought_to_rest(system, contacts, mu, stopped, stick, strike.t, strike.jump)
        # redundant contacts come to rest with others
        left = gamma + contacts.delassus[:m] @ stop.impulse
        at_rest = closed & (jnp.abs(left) <= strike.rest)
        # a contact accumulates if it was brought to rest from more than rounding
        ends = at_rest & ~tight & strike.happens & ~strike.jams
        passed = _passed(stop, ends, -jnp.sum(strike.jump.energy))
        return _Resting(pressed, kept_closed, at_rest, force, ends, stop.jump, passed)

    slow = closed & (jnp.abs(gamma) <= slowly)
    if m == 1:
        return resting(slow)
    nested = closed & strike.happens & ~strike.jams & _share_bodies(contacts, closed | struck)
    nested = nested & (jnp.abs(gamma) <= jnp.sqrt(settings.accumulation) * scales.gap_velocity)
    both = jax.lax.map(resting, jnp.stack([slow, slow | nested]))
    alone, cluster = (jax.tree.map(lambda x, i=i: x[i], both) for i in (0, 1))
    undisturbed = _undisturbed(system, contacts, cluster, strike.t)
    return selected(undisturbed, cluster, alone)


def _slack(strike: _Strike) -> jax.Array:
    """Gap accelerations () that are rounding."""
    return rest_acceleration(strike.rest.dtype) * strike.scales.acceleration


def _next_modes(
    system: System,
    mu: jax.Array | None,
    settings: Settings,
    strike: _Strike,
    result: "_Resting",
    state: State,
    before: Modes,
    fired: jax.Array,
) -> tuple[ModeChoice, jax.Array, jax.Array]:
    """The modes after the event at this state, contacts (m,) at rest, and constraints released."""
    contacts, rest = strike.contacts, strike.rest
    if mu is not None:  # what velocities before the rest would still turn, redundant contacts fight
        contacts = contacts_at(system, state.q, state.v, strike.t, True)
    held = result.at_rest
    held_before = before.active if not settings.friction else jnp.tile(before.active, 2)
    released = fired & held_before & ~strike.happens
    if mu is not None:
        choice = _with_friction(contacts, mu, before, held, released, rest, _slack(strike))
        return choice, held, released
    m = held.shape[0]
    active = result.pressed | (held & result.kept_closed & ~released)
    no = jnp.asarray(False)
    modes = no_modes(m, rest.dtype)._replace(active=active)
    return ModeChoice(modes, ~no, rest, no, jnp.zeros(m, bool)), held, released


def _status(
    strike: _Strike, jump: Jump, choice: ModeChoice, held: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Status of the motion, that of the law, and the approach of an impact without collision."""
    fails = jnp.asarray(FAILS)[jump.code]
    status = jnp.where(fails, CODE["law_failed"], CODE["ok"])
    code, wedges = jump.code, jnp.zeros_like(strike.rest)
    now, earlier = strike.contacts.tangent, strike.before.tangent
    if now is not None and earlier is not None:
        change = jnp.max(jnp.abs(now.rate - earlier.rate))
        if not in_space(strike.contacts):
            wedges = jnp.where(choice.consistent, 0.0, _approach(choice, now.rate, held))
        jammed = strike.jams & (change <= SUPPLIED * strike.approach)
        none = jammed | (~choice.consistent & (wedges == 0))
        status = jnp.where(none, CODE["no_contact_force"], status)
        code = jnp.where(choice.several, jnp.maximum(code, CODE["several_outcomes"]), code)
    return status, code, wedges


class _Resting(NamedTuple):
    """What comes to rest of slow contacts (m,), and the velocities after it."""

    pressed: jax.Array  # (m,) contacts with a normal force
    kept_closed: jax.Array  # (m,) those that neither press nor part
    at_rest: jax.Array  # (m,) closed, without gap velocity
    force: jax.Array  # (m,) normal forces [N]
    ends: jax.Array  # (m,) contacts whose impacts accumulate here
    jump: Jump
    passed: Passed


def _share_bodies(contacts: Contacts, touched: jax.Array) -> jax.Array:
    """Which contacts (m,) feel another one that is `touched`."""
    m = touched.shape[0]
    w = jnp.abs(contacts.delassus[:m, :m])
    size = jnp.sqrt(jnp.diagonal(w))
    others = touched[None] & ~jnp.eye(m, dtype=bool)
    return jnp.any(others & (w > LEAST_COUPLING * jnp.outer(size, size)), axis=1)


def _undisturbed(system: System, contacts: Contacts, result: _Resting, t: jax.Array) -> jax.Array:
    """Whether () no other contact is reached within the time that is passed, by parabolas."""
    m = result.at_rest.shape[0]
    gap, normals = jnp.maximum(contacts.normal.value, 0.0), contacts.normal.gradient
    rate = normals.T @ (result.jump.v - carried_along(system, result.jump.v, t))
    fall = contacts.approach[:m] + contacts.delassus[:m, :m] @ result.force
    square = rate * rate - 2 * fall * gap
    root = jnp.sqrt(jnp.maximum(square, 0.0))
    later = (rate + root) / jnp.where(fall < 0, -fall, 1.0)
    reached = jnp.where(rate < 0, 2 * gap / jnp.where(rate < 0, root - rate, 1.0), later)
    never = (square < 0) | ((rate >= 0) & (fall >= 0))
    return jnp.all(result.at_rest | never | (reached > result.passed.time))


def _approach(choice: ModeChoice, slip: jax.Array, held: jax.Array) -> jax.Array:
    """Gap velocity () of the approach to an impact without collision, 0 where nothing slips."""
    left = jnp.clip(choice.regularity, 0.0, 2 * precision(slip.dtype).root)
    share = precision(slip.dtype).root + MORE * left
    return jax.lax.stop_gradient(share * jnp.max(jnp.where(held, jnp.abs(slip), 0.0)))


def velocity_noise(settings: Settings, acceleration: jax.Array) -> jax.Array:
    """Velocities () that arise at this acceleration () within the rounding of time."""
    duration = jnp.abs(jax.lax.stop_gradient(settings.duration))
    return precision(duration.dtype).accumulated * duration * acceleration


def _rest(settings: Settings, scales: Scales) -> jax.Array:
    """Gap velocities () that are rounding."""
    rounding = velocity_noise(settings, scales.acceleration)
    return not_rounding(REST_SPEED, rounding.dtype) * scales.speed + rounding


def _struck(
    system: System,
    law: Law,
    settings: Settings,
    state: State,
    strikes: jax.Array,
    approach: jax.Array,
    closed: jax.Array,
    scales: Scales,
) -> Jump:
    """The impact where it `strikes`, else nothing."""
    lead = approach if settings.friction else None
    noise = _rest(settings, scales)
    m = closed.shape[0]
    return jax.lax.cond(
        strikes,
        lambda: impact_jump(system, law, state.t, state, closed, noise, lead),
        lambda: no_jump(state, m, tangent_count_of(system, state.q, m)),
    )


def _with_jump(state: State, jump: Jump) -> State:
    """The state after a jump."""
    return state._replace(
        v=jump.v,
        base_work=state.base_work + jump.base_work,
        contact_work=state.contact_work + jump.energy,
    )


def _with_friction(
    contacts: Contacts,
    mu: jax.Array,
    before: Modes,
    held: jax.Array,
    released: jax.Array,
    rest: jax.Array,
    slack: jax.Array,
) -> ModeChoice:
    """Modes with friction."""
    assert contacts.tangent is not None
    slides = length(by_contact(contacts.tangent.rate, len(mu))) > rest
    return choose_with_friction(contacts, mu, before, held, released, slides, slack)


def _grown(
    system: System, settings: Settings, scales: Scales, contacts: Contacts, state: State
) -> Scales:
    """The largest values so far, those of this instant included."""
    m = contacts.normal.rate.shape[0]
    relative = state.v - carried_along(system, state.v, state.t)
    energy = jnp.maximum(kinetic(system, state.q, state.v), kinetic(system, state.q, relative))
    speed = speed_of(energy, jnp.diagonal(contacts.delassus))
    # the terms of an acceleration may cancel: what bodies side by side leave of it is rounding, and
    # so is what does not change the speed within the motion
    terms = jnp.abs(contacts.directions[:, :m]).T @ jnp.abs(contacts.free)
    acceleration = jnp.maximum(jnp.abs(contacts.approach[:m]), terms).max()
    acceleration = jnp.maximum(acceleration, speed / settings.duration)
    at_rest = jnp.sqrt(acceleration * settings.closed_below)
    fastest = jnp.abs(contacts.normal.rate).max()
    now = Scales(fastest, jnp.maximum(speed, at_rest), acceleration)
    return jax.lax.stop_gradient(jax.tree.map(jnp.maximum, scales, now))


class _Stop(NamedTuple):
    """Contacts that are brought to rest."""

    jump: Jump  # after it
    impulse: jax.Array  # (k,) that does it [N s]
    force: jax.Array  # (m,) that will keep contacts closed [N]
    energy: jax.Array  # () that it takes [J]


def _brought_to_rest(
    system: System,
    contacts: Contacts,
    mu: jax.Array | None,
    held: jax.Array,
    stick: jax.Array,
    t: jax.Array,
    jump: Jump,
) -> _Stop:
    """Gap velocities of `held` contacts set to 0, tangential ones of those that `stick`, too."""
    m = held.shape[0]
    modes, rates = (
        no_modes(m, jump.v.dtype)._replace(active=held, stick=stick),
        contacts.normal.rate,
    )
    if contacts.tangent is not None:
        rates = jnp.concatenate([rates, contacts.tangent.rate])
    size = rates.shape[0]
    columns = jnp.stack([rates, contacts.approach[:size]], axis=1)
    p, force = constraint_impulse(contacts, mu, modes, columns).T
    # work at the mean velocity: half of that before, 0 after
    work, side = 0.5 * p * rates, jnp.zeros_like(jump.tangential)
    energy = jnp.stack([work[:m], jnp.zeros_like(work[:m])])
    if contacts.tangent is not None:
        energy, side = energy.at[1].set(by_contact(work[m:], m).sum(axis=1)), p[m:]
    # the gaps, up to `closed_below`, are closed by the flight that follows
    fallen = jnp.where(held, jnp.maximum(force[:m], 0.0) * contacts.normal.value, 0.0)
    carried = carried_along(system, jump.v, t)
    jump = jump._replace(
        v=jump.v + contacts.moved @ p,
        impulse=jump.impulse + p[:m],
        tangential=jump.tangential + side,
        energy=(jump.energy + energy).at[0].add(-fallen),
        base_work=jump.base_work + (contacts.directions @ p) @ carried,
    )
    return _Stop(jump, p, force[:m], -jnp.sum(work))


def _passed(stop: _Stop, ends: jax.Array, lost: jax.Array) -> Passed:
    """By the energy in hops that the stop takes, and what the impact took.

    Under the force F that will keep a contact closed a hop takes 2 p / F, and energy E lifts it by
    E / F at most. If each impact keeps r^2 of the energy, and k contacts strike in turn, hops
    take `2 k p / F (1 + r + ..)` together: exact for a single contact.
    """
    p, left = stop.impulse[: len(ends)], stop.energy
    pressed = ends & (stop.force > 0)
    safe, some = jnp.where(pressed, stop.force, 1.0), jnp.any(pressed) & (left > 0)
    r = jnp.sqrt(jnp.where(some, left, 0.25) / jnp.where(some, left + jnp.maximum(lost, 0), 1.0))
    hop = jnp.max(jnp.where(pressed, 2 * jnp.abs(p) / safe, 0.0))
    lift = jnp.max(jnp.where(pressed, left / safe, 0.0))
    return Passed(jnp.sum(ends.astype(p.dtype)) * hop / (1 - r), lift)


def _kind(
    strikes: jax.Array, jams: jax.Array, ends: jax.Array, parts: jax.Array, fired: jax.Array
) -> jax.Array:
    """The kind of event, `none` at a beginning without impact."""
    m = len(parts)
    kind = jnp.where(jnp.any(fired[:m]), KIND_CODE["contact"], KIND_CODE["none"])
    kind = jnp.where(jnp.any(fired[m:]), KIND_CODE["friction"], kind)
    kind = jnp.where(jnp.any(parts), KIND_CODE["detachment"], kind)
    hit = jnp.where(ends, KIND_CODE["accumulation"], KIND_CODE["impact"])
    hit = jnp.where(jams, KIND_CODE["paroxysm"], hit)
    return jnp.where(strikes, hit, kind).astype(jnp.int32)
