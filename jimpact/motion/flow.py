"""Flights and persistent contact: an instance of the event-aligned stepper, `events/stepper.py`."""

import abc
import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from jimpact.bodies.base import Body
from jimpact.motion.dynamics import (
    definite,
    free_acceleration,
    gaps,
    kinematics,
    kinetic,
    mass_at,
    not_rounding,
    recorded_gaps,
    seen_from_base,
    user_force,
)
from jimpact.motion.persistent_contact import (
    BEGINS,
    Contacts,
    Forces,
    Modes,
    cone_margins,
    constraint_impulse,
    contact_powers,
    contacts_at,
    forces,
    regularity,
    rest_acceleration,
    slip_margins,
)
from jimpact.motion.slip_in_space import (
    SlipAxes,
    log_rates,
    slip_axes,
    slip_within,
    straightened,
    turning_errors,
)
from jimpact.motion.system import System
from jimpact.numerics import stepper
from jimpact.tools.loops import any_lane
from jimpact.tools.precision import precision
from jimpact.tools.status import CODE

SMALLEST_STEP = 1e-15  # of the time: below it a step does not move time any more
# Error allowed in the ledger, as a share of the work of the errors allowed in q and v: ten times
# more, and
# the steps of a body that rests on a moving base are those of the base's motion only.
LEDGER = 0.01
# Share of the speed scale: a persistent contact that has more gap velocity after a step has got
# another normal, as a corner that slides over an edge has. Steps themselves leave some roundings,
# and at most MORE_THAN_STEPS times their relative tolerance. Ten times more: a hundred times the
# energy, 1e-12 of it here, is lost unseen where normals turn by less.
JUMP, MORE_THAN_STEPS = 1e-6, 1e3
FORGET = 0.5  # of the last free step, that shorter ones leave of it each
# Steps at least that the duration is cut into where loads or a base may depend on time, each seen
# at 12 instants: a pulse shorter than about a 200th of the duration may be missed.
LOOKS = 64


class State(NamedTuple):
    """What is integrated: q, v, t, and work of forces, of the base, of each contact [J]."""

    q: jax.Array
    v: jax.Array
    t: jax.Array  # ()
    work: jax.Array  # ()
    base_work: jax.Array  # ()
    contact_work: jax.Array  # (2, m): normal, tangential
    contact: jax.Array  # (2, m): indentation, impulse of compliant contacts; (0, m) of rigid ones


class Settings(NamedTuple):
    """Tolerances of a motion."""

    rtol: float
    atol: float
    closed_below: jax.Array
    gap_rounding: jax.Array  # gaps below it are rounding
    max_steps: int
    friction: bool
    spatial: bool  # friction has two rows a contact
    duration: jax.Array
    accumulation: jax.Array  # `slow`: see `transitions.resolve`


def speed_of(energy: jax.Array, w: jax.Array) -> jax.Array:
    """The largest gap velocity () that a kinetic energy could give a contact, `sqrt(2 T W_jj)`."""
    return jnp.sqrt(2 * energy * jnp.max(w))


class Scales(NamedTuple):
    """Largest values of the motion so far."""

    gap_velocity: jax.Array
    # gap velocity that all kinetic energy could give a contact; at least what bodies at rest gain
    # while a closed gap opens
    speed: jax.Array
    acceleration: jax.Array


def watched(
    contacts: Contacts,
    mu: jax.Array | None,
    modes: Modes,
    scales: Scales,
    below: jax.Array,
    slip: jax.Array | None = None,
) -> jax.Array:
    """What must stay positive (k,): gaps or normal forces, then friction.

    `below`: (m,) gaps <= 0 that steps begin with. `slip`: as in `forces`.
    """
    m = modes.active.shape[0]
    force = forces(contacts, mu, modes, slip)
    w = jnp.diagonal(contacts.delassus)
    slack = rest_acceleration(w.dtype) * scales.acceleration
    gap = contacts.normal.value - below
    normal = jnp.where(modes.active, force.normal * w[:m] + slack, gap)
    if contacts.tangent is None or mu is None or force.tangential is None:
        return normal
    # sliding ends where slip does, and where its forces stop to exist: both may be in one step
    slides = any_lane(jnp.any(modes.active & ~modes.stick))  # else its product with slip is 0
    lasts = (
        jax.lax.cond(
            slides, lambda: regularity(contacts, mu, modes, slip), lambda: jnp.ones((), w.dtype)
        )
        - precision(w.dtype).root
    )
    side = friction_margins(contacts, mu, modes, force, lasts, slack, scales.speed)
    return jnp.concatenate([normal, side])


def friction_margins(
    contacts: Contacts,
    mu: jax.Array,
    modes: Modes,
    force: Forces,
    lasts: jax.Array,
    slack: jax.Array,
    speed_scale: jax.Array,
) -> jax.Array:
    """What must stay positive (m,): the rest of the cone (and `slack`) of what sticks, or slip."""
    cone = cone_margins(contacts, mu, force) + slack
    ends = slip_margins(contacts, mu, modes, force, lasts, speed_scale)
    return jnp.where(modes.active, jnp.where(modes.stick, cone, ends), 1.0)


class MotionFlow(eqx.Module, stepper.Flow):
    """What flights have in common.

    State (rows): q, v, t, the ledger, and what contacts remember. The last of the margins is the
    time left to the next sample. Margins are in units of their rounding. In space tangents are
    along the `axes` of the step.
    """

    system: System
    rounding: jax.Array  # (k,)
    sample: jax.Array  # time of the next sample ()
    rtol: float
    sizes: jax.Array  # (rows, 1): a step may make errors of `rtol` of them
    like: State  # of its shapes
    longest: jax.Array  # step ()
    mu: jax.Array | None
    axes: SlipAxes | None

    @property
    def error_only_rows(self) -> int:
        """Rows in addition to those of the state, which only limit the length of steps.

        In space logarithms of slip: steps follow it until little is left.
        """
        return 0 if self.axes is None else len(self.axes.speed)

    @property
    def taking_part(self) -> int:  # type: ignore[override]
        """One: the number of passes does not matter here."""
        return 1

    @property
    def tolerance(self) -> jax.Array:  # type: ignore[override]
        """`rtol`."""
        return jnp.full((1, 1), self.rtol, self.sizes.dtype)

    def allowance(self, modes: jax.Array, y: jax.Array) -> jax.Array:
        """Errors that a step may make in each row (rows, 1), in tolerances."""
        return self.sizes

    @property
    def zero_margin(self) -> jax.Array:
        """Margins are in units of their rounding."""
        return jnp.ones((1, 1), self.sizes.dtype)

    def from_margins(self, margins: jax.Array, at: State) -> jax.Array:
        """Rows (k, 1) of margins, with that of the next sample."""
        return (jnp.append(margins, self.sample - at.t) / self.rounding)[:, None]

    def errors_of_error_only_rows(
        self, settings: Settings, state: State, h: jax.Array, of_q: jax.Array
    ) -> list[jax.Array]:
        """Errors that a step of length h may make in its spare rows; `of_q`: sizes of q in it."""
        if self.axes is None:
            return []
        return [turning_errors(self.axes, settings.rtol, self.speed_scale)]

    @property
    @abc.abstractmethod
    def speed_scale(self) -> jax.Array:
        """Speed () of the motion so far."""

    def contacts(self, at: State) -> Contacts:
        """Contact space at this state."""
        along = None if self.axes is None else self.axes.along
        return contacts_at(self.system, at.q, at.v, at.t, self.mu is not None, along)

    def slip(self, modes: Modes, contacts: Contacts) -> jax.Array | None:
        """Directions of slip (m, 2) in space."""
        if self.axes is None or contacts.tangent is None:
            return None
        return slip_within(self.axes, modes, contacts.tangent.rate)

    def rows_of(
        self, rates: State, at: State, modes: Modes, contacts: Contacts, force: Forces
    ) -> list[jax.Array]:
        """Rows of the rates, and in space those of logarithms of slip."""
        rows = [self.regular(rates, at)]
        if self.axes is not None:
            rows.append(log_rates(self.axes, modes, contacts, force)[:, None])
        return rows

    def projected(self, const: Any, at: State) -> tuple[State, jax.Array]:
        """The state back on the constraints of its modes; which contacts have another normal."""
        return at, jnp.zeros(0, bool)

    def switch(
        self, modes: jax.Array, y: jax.Array, which: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Nothing: what happens at events is decided between flights."""
        return modes, y

    def over(self, modes: jax.Array, y: jax.Array, passes: jax.Array) -> jax.Array:
        """Never: the loop of the motion decides."""
        return jnp.zeros((1, 1), bool)

    def regular(self, rates: State, at: State) -> jax.Array:
        """Rows of rates; NaN where M is not positive definite."""
        if callable(self.system.mass):
            return jnp.where(definite(mass_at(self.system, at.q)), packed(rates), jnp.nan)
        return packed(rates)


class MechanicalFlow(MotionFlow):
    """Rigid contacts with frozen modes: open, or persistent and sticking or sliding.

    Modes (rows): for each contact, whether it is persistent, whether it sticks, the sign of its
    sliding. Margins: gaps of open contacts, normal forces of persistent ones, then friction (the
    cone, or the speed of sliding times what is left of `regularity`).
    """

    scales: Scales
    below: jax.Array  # (m,) gaps that the step begins with, 0 where they are positive

    near = 0.01  # steps in time are exact for parabolas: only the last of a landing is not in time

    @property
    def error_only_rows(self) -> int:
        """Gaps by integration, too: steps follow them where the base moves faster than the body."""
        return self.like.contact_work.shape[1] + super().error_only_rows

    @property
    def speed_scale(self) -> jax.Array:
        """That of all kinetic energy."""
        return self.scales.speed

    def errors_of_error_only_rows(
        self, settings: Settings, state: State, h: jax.Array, of_q: jax.Array
    ) -> list[jax.Array]:
        """Those of gaps first."""
        of_u = of_q if self.system.body.coordinates is None else h * jnp.abs(state.v)
        normal, _ = kinematics(self.system, state.q, state.v, state.t)
        of_gap = (
            jnp.abs(normal.value) + h * jnp.abs(normal.rate) + jnp.abs(normal.gradient).T @ of_u
        )
        errors = settings.atol + settings.rtol * of_gap
        return [errors, *super().errors_of_error_only_rows(settings, state, h, of_q)]

    def constants(self, modes: jax.Array) -> Modes:
        """The modes, of each contact."""
        return decoded(modes, self.sizes.dtype)

    def field(self, const: Modes, modes: jax.Array, y: jax.Array) -> jax.Array:
        """Rates of the state."""
        at = unpacked(self.like, y)
        contacts = self.contacts(at)
        force = forces(contacts, self.mu, const, self.slip(const, contacts))
        friction, base = contact_powers(self.system, contacts, force, at.t)
        power = user_force(self.system, at.q, at.v, at.t) @ at.v
        per_contact = jnp.stack([jnp.zeros_like(friction), friction])
        still = jnp.zeros_like(at.contact)
        one = jnp.ones_like(at.t)
        moves = self.system.body.rates(at.q, at.v)
        rates = State(moves, force.acceleration, one, power, base, per_contact, still)
        gaps_by_steps = jnp.where(const.active, 0.0, contacts.normal.rate)[:, None]
        rows, *logs = self.rows_of(rates, at, const, contacts, force)
        return jnp.concatenate([rows, gaps_by_steps, *logs])

    def margins(self, const: Modes, modes: jax.Array, y: jax.Array) -> jax.Array:
        """What must stay positive."""
        at = unpacked(self.like, y)
        contacts = self.contacts(at)
        slip = self.slip(const, contacts)
        margins = watched(contacts, self.mu, const, self.scales, self.below, slip)
        return self.from_margins(margins, at)

    def projected(self, const: Modes, at: State) -> tuple[State, jax.Array]:
        """Gaps and velocities of persistent contacts set to 0, in the metric of M.

        But not where one of them has another normal since the step began: which (m,) have.
        """
        contacts = self.contacts(at)
        value, rate = contacts.normal.value, contacts.normal.rate
        most = max(not_rounding(JUMP, rate.dtype), MORE_THAN_STEPS * self.rtol)
        # a motion that began at rest had no speed before this step
        energy, w = kinetic(self.system, at.q, at.v), jnp.diagonal(contacts.delassus)
        speed = jnp.maximum(self.scales.speed, speed_of(energy, w[: len(rate)]))
        jumps = const.active & (jnp.abs(rate) > most * speed)
        if contacts.tangent is not None:  # tangentially only velocities drift
            value = jnp.concatenate([value, jnp.zeros_like(contacts.tangent.rate)])
            rate = jnp.concatenate([rate, contacts.tangent.rate])
            if self.axes is not None:
                const = straightened(self.axes, const, contacts.tangent.rate)
        p = constraint_impulse(contacts, self.mu, const, jnp.stack([value, rate], axis=1))
        move = contacts.moved @ p
        back = at._replace(q=self.system.body.moved(at.q, move[:, 0]), v=at.v + move[:, 1])
        return selected(jnp.any(jumps), at, back), jumps


def packed(state: State) -> jax.Array:
    """Rows (.., 1) of a state."""
    return ravel_pytree(state)[0][:, None]


def unpacked(like: State, y: jax.Array) -> State:
    """The state of rows (.., 1); `error_only_rows` ones come last."""
    flat, back = ravel_pytree(like)
    return back(y[: len(flat), 0])


def decoded(rows: jax.Array, dtype: Any) -> Modes:
    """The modes of such rows."""
    active, stick, sign = rows[:, 0].reshape(3, -1)
    return Modes(active > 0, stick > 0, sign.astype(dtype))


def encoded(modes: Modes) -> jax.Array:
    """Modes as rows (3 m, 1) of whole numbers."""
    rows = [modes.active, modes.stick, modes.sign]
    return jnp.concatenate([x.astype(jnp.int32) for x in rows])[:, None]


class Flight(NamedTuple):
    """A flight under way."""

    state: State
    aim: stepper.Step  # the step to try
    plan: jax.Array  # and what the stepper expects of it
    free: jax.Array  # length of steps that nothing shortens [s]
    event: jax.Array  # (k,) what has happened
    jumped: jax.Array  # () whether a normal has jumped: no derivatives from then on
    sample: jax.Array  # number of samples reached
    steps: jax.Array
    stuck: jax.Array


def longest_step(system: System, targets: jax.Array) -> jax.Array:
    """How long a step may be () [s]: a bound only where something may depend on time."""
    if system.base is None and system.force is None:
        return jnp.full((), jnp.inf, targets.dtype)
    return jax.lax.stop_gradient(targets[-1] - targets[0]) / LOOKS


def first_flight(
    system: System, state: State, rows: jax.Array, events: int, targets: jax.Array
) -> Flight:
    """A flight at the beginning: `rows` of modes, number of `events`; one sample is reached."""
    step = jnp.minimum(
        jax.lax.stop_gradient(targets[1] - targets[0]), longest_step(system, targets)
    )
    clock = jnp.stack([0 * step, step, 0 * step, 0 * step])[:, None]
    aim = stepper.Step(rows, jnp.zeros((events + 1, 1), bool), clock)
    one, none, no = jnp.int32(1), jnp.int32(0), jnp.asarray(False)
    event = jnp.zeros(events, bool)
    return Flight(state, aim, jnp.zeros((4, 1), step.dtype), step, event, no, one, none, no)


def next_sample(targets: jax.Array, reached: jax.Array) -> jax.Array:
    """The time of the next sample, after `reached` () samples."""
    return targets[jnp.minimum(reached, targets.shape[0] - 1)]


def toward_sample(flight: Flight, targets: jax.Array, h: jax.Array) -> Flight:
    """The next step, of length h, lands on the sample if it reaches it."""
    left = next_sample(targets, flight.sample) - flight.state.t
    lands = left <= h
    target = jnp.zeros_like(flight.aim.target).at[-1].set(lands)
    clock = jnp.stack([0 * h, h, 0 * h, lands.astype(h.dtype)])[:, None]
    plan = flight.plan.at[0, 0].set(jnp.where(lands, left, h)).at[1].set(0.0)
    aim = flight.aim._replace(target=target, clock=clock)
    aim, plan = jax.lax.stop_gradient((aim, plan))
    return flight._replace(aim=aim, plan=plan)


def selected(which: jax.Array, new: Any, old: Any) -> Any:
    """Leaf by leaf, `new` where `which`."""
    return jax.tree.map(lambda a, b: jnp.where(which, a, b), new, old)


def one_pass(
    flow: MotionFlow,
    settings: Settings,
    allowed: jax.Array,
    targets: jax.Array,
    flight: Flight,
    flies: jax.Array | bool = True,
) -> tuple[Flight, jax.Array]:
    """One pass of the stepper, and whether its step is accepted.

    `allowed` are the errors of all rows of the state but q and v. In a lane without flight
    only the step to try changes, which `toward_sample` then sets anew.
    """
    state = flight.state
    flow = dataclasses.replace(
        flow,
        sample=next_sample(targets, flight.sample),
        sizes=jax.lax.stop_gradient(_errors(flow, settings, allowed, flight) / flow.rtol)[:, None],
    )
    # passes are counted here: their number does not lower the tolerance
    carry = stepper.StepperState(_rows(flow, state), flight.aim, flight.plan.at[2:].set(0.0))
    after, accept = stepper.advance(flow, carry, 2)
    accept = accept[0, 0] & flies
    landed = flight.aim.target[:, 0] & accept
    sampled = landed[-1]
    new, jumps = _reached(flow, flight.aim, after.y)
    state = selected(accept, new, state)
    jumps = jumps & accept
    event = landed[:-1].at[: len(jumps)].max(jumps)
    steps = flight.steps + jnp.asarray(flies).astype(flight.steps.dtype)
    vanishes = flies & ~accept & (after.step.clock[1, 0] < _smallest_step(targets))
    # what an event or a sample shortens says nothing of the steps after it
    tried, lands = flight.aim.clock[1, 0], flight.aim.clock[3, 0] > 0
    proposed = after.step.clock[1, 0]
    longer = jnp.where(tried < flight.free, jnp.maximum(proposed, FORGET * flight.free), proposed)
    free = jnp.where(accept & ~lands, jax.lax.stop_gradient(longer), flight.free)
    moved = flight._replace(
        state=state,
        free=free,
        aim=jax.lax.stop_gradient(after.step),
        plan=jax.lax.stop_gradient(after.progress),
        event=jnp.where(flies, event, flight.event),
        jumped=flight.jumped | jnp.any(jumps),
        sample=flight.sample + sampled.astype(flight.sample.dtype),
        steps=steps,
        stuck=flight.stuck
        | vanishes
        | (steps >= settings.max_steps)
        | out_of_range(flow.system, state),
    )
    begins = jnp.minimum(free, flow.longest)  # forces may have set in since `free`
    aimed = toward_sample(moved, targets, jnp.where(sampled, begins, proposed))
    in_time = (after.step.clock[2, 0] == 0) & (after.step.clock[3, 0] == 0)
    plain = sampled | (accept & in_time)
    aim, plan = selected(plain, (aimed.aim, aimed.plan), (moved.aim, moved.plan))
    return moved._replace(aim=aim, plan=plan), accept


def out_of_range(system: System, at: State) -> jax.Array:
    """Whether () the gap function does not hold here any more."""
    if type(system.body).valid is Body.valid:
        return jnp.asarray(False)
    return ~(system.body.valid(seen_from_base(system, at.q, at.t)) >= 0)


def status_at_start(system: System, at: State, end: jax.Array, closed_below: Any) -> jax.Array:
    """MotionStatus () of a motion that begins here and shall last until `end`."""
    allowed = jnp.maximum(closed_below, system.body.overlap)
    penetrates = jnp.any(recorded_gaps(system, at.q, at.t) < -allowed)
    status = jnp.where(penetrates, CODE["penetration"], CODE["ok"])
    status = jnp.where(out_of_range(system, at), CODE["out_of_range"], status)
    status = jnp.where(end <= at.t, CODE["backward"], status)
    finite = jnp.all(jnp.isfinite(at.q)) & jnp.all(jnp.isfinite(at.v)) & jnp.isfinite(end)
    return jnp.where(finite, status, CODE["not_finite"]).astype(jnp.int32)


def _rows(flow: MotionFlow, state: State) -> jax.Array:
    """Rows (.., 1) of the state, with spare ones that are 0."""
    return jnp.pad(packed(state), ((0, flow.error_only_rows), (0, 0)))


def _reached(flow: MotionFlow, aim: stepper.Step, y: jax.Array) -> tuple[State, jax.Array]:
    """The state of rows at the end of a step, at a sample with its time to the last digit.

    And which contacts have another normal than at its beginning: velocities are as they were.
    """
    new, jumps = flow.projected(flow.constants(aim.modes), unpacked(flow.like, y))
    return new._replace(t=jnp.where(aim.target[-1, 0], flow.sample, new.t)), jumps


def _errors(flow: MotionFlow, settings: Settings, allowed: jax.Array, flight: Flight) -> jax.Array:
    """Errors (rows,) that a step may make, by the sizes within it of q and v (they cross 0)."""
    system, state, h = flow.system, flight.state, flight.plan[0, 0]
    push = user_force(system, state.q, state.v, state.t)
    rates = free_acceleration(system, state.q, state.v, push, mass_at(system, state.q))
    of_q = jnp.abs(state.q) + h * jnp.abs(system.body.rates(state.q, state.v))
    of_v = jnp.abs(state.v) + h * jnp.abs(rates)
    errors = [settings.atol + settings.rtol * jnp.concatenate([of_q, of_v]), allowed]
    return jnp.concatenate([*errors, *flow.errors_of_error_only_rows(settings, state, h, of_q)])


def _smallest_step(targets: jax.Array) -> jax.Array:
    """Length () [s] below which a step does not move time any more."""
    return not_rounding(SMALLEST_STEP, targets.dtype) * (jnp.abs(targets[0]) + jnp.abs(targets[-1]))


def allowed_errors(
    system: System, settings: Settings, at: State, share: float = LEDGER
) -> jax.Array:
    """Errors allowed in all rows of the state but q and v; in the ledger a `share` of theirs."""
    mass = mass_at(system, at.q)
    free = free_acceleration(system, at.q, at.v, user_force(system, at.q, at.v, at.t), mass)
    both = jnp.stack([free, at.v], axis=1)
    pushed = jnp.abs(mass[:, None] * both if mass.ndim == 1 else mass @ both)
    of_q, of_v = (settings.atol + settings.rtol * jnp.abs(x) for x in (at.q, at.v))
    if system.body.coordinates is not None:  # of displacements
        of_q = jnp.broadcast_to(jnp.max(of_q), at.v.shape)
    ledger = share * (of_q @ pushed[:, 0] + of_v @ pushed[:, 1])
    rows = packed(at).shape[0] - at.q.shape[0] - at.v.shape[0]
    # positive even without motion or forces
    return jnp.full(rows, jnp.maximum(ledger, settings.atol)).at[0].set(jnp.inf)  # time: none


def roundings(settings: Settings, margins: jax.Array, targets: jax.Array) -> jax.Array:
    """Roundings of these margins and of the time to the next sample (k,)."""
    least = precision(targets.dtype).tiny ** 0.5
    each = jnp.append(margins, _smallest_step(targets))
    return jax.lax.stop_gradient(jnp.maximum(each, least))


def flow_of(
    system: System,
    mu: jax.Array | None,
    settings: Settings,
    modes: Modes,
    scales: Scales,
    targets: jax.Array,
    state: State,
) -> MechanicalFlow:
    """The flow with these modes; `one_pass` sets the time of the next sample, and the errors."""
    share = rest_acceleration(state.q.dtype)
    slack = share * scales.acceleration
    normal = jnp.where(modes.active, slack, settings.gap_rounding)
    stuck = modes.stick | (modes.sign == BEGINS)
    side = jnp.where(stuck, slack, share * scales.speed)
    margins = jnp.concatenate([normal, side]) if settings.friction else normal
    rounded, longest = roundings(settings, margins, targets), longest_step(system, targets)
    blank = jnp.zeros((1, 1), state.q.dtype)
    # where contacts that were held not quite closed are closed, redundant ones come to lie below
    below = jax.lax.stop_gradient(jnp.minimum(gaps(system, state.q, state.t), 0.0))
    axes = None
    if mu is not None and settings.spatial:
        contacts = contacts_at(system, state.q, state.v, state.t, True)
        axes = slip_axes(contacts, mu, modes, scales.speed)
    return MechanicalFlow(
        *(system, rounded, state.t, settings.rtol, blank, state, longest, mu, axes),
        *(scales, below),
    )
