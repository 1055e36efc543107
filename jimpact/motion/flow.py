"""Flights and persistent contact: flows of the event-aligned stepper,
`numerics/stepper.py`.

A *flight* is the motion between two events. A *sample* is an instant at which the state
is recorded; steps land on it. *Modes* are frozen in a step: see
`persistent_contact.Modes`. *Margins* are quantities that stay positive while the modes
hold; one that falls to 0 is an event. Rows of the stepper have a last axis for a batch,
here of length 1.
"""

import abc
import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

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
from jimpact.tools.masks import choose
from jimpact.tools.precision import precision
from jimpact.tools.status import CODE

SMALLEST_STEP = 1e-15  # of the time: below it a step does not move time any more
# Error allowed in the ledger, as a share of the work of the errors allowed in q and v:
# ten times more, and
# the steps of a body that rests on a moving base are those of the base's motion only.
LEDGER = 0.01
# Share of the speed scale: a persistent contact that has more gap velocity after a step
# has got another normal, as a corner that slides over an edge has. Steps themselves
# leave some roundings, and at most MORE_THAN_STEPS times their relative tolerance. Ten
# times more: a hundred times the energy, 1e-12 of it here, is lost unseen where normals
# turn by less.
JUMP = 1e-6
MORE_THAN_STEPS = 1e3
FORGET = 0.5  # of the last free step, that shorter ones leave of it each
# Steps at least that the duration is cut into where loads or a base may depend on time,
# each seen at 12 instants: a pulse shorter than about a 200th of the duration may be
# missed.
LOOKS = 64


class State(NamedTuple):
    """State of a motion: q, v, t, and the work of forces, base and contacts since the
    start [J].
    """

    q: Float[Array, " nq"]
    v: Float[Array, " n"]
    t: Float[Array, ""]
    work: Float[Array, ""]
    base_work: Float[Array, ""]
    contact_work: Float[Array, "2 m"]  # normal, tangential
    # of compliant contacts: indentation [m], then impulses [N s], normal and tangential
    # (none without friction); of rigid ones no rows
    contact: Float[Array, "c m"]
    # of contacts with tangential springs: elongation xi [m] while they hold, the
    # direction n while they slide; of others none
    spring: Float[Array, "b m"] | tuple[()] = ()


class Settings(NamedTuple):
    """Tolerances and options of a motion."""

    rtol: float
    atol: float
    closed_below: Float[Array, ""]  # [m] contacts with smaller gaps are closed
    gap_rounding: Float[Array, ""]  # [m] smaller gaps are rounding
    max_steps: int
    friction: bool
    spatial: bool  # friction has two rows a contact
    duration: Float[Array, ""]  # [s]
    accumulation: Float[Array, ""]  # `slow`: see `transitions.resolve`


def speed_of(energy: Float[Array, ""], w: Float[Array, " k"]) -> Float[Array, ""]:
    """Largest gap velocity `max_j sqrt(2 T W_jj)` [m/s] that a kinetic energy T could
    give.

    `w` is the diagonal W_jj of the Delassus matrix.
    """
    largest = jnp.max(w)
    return jnp.sqrt(2 * energy * largest)


class Scales(NamedTuple):
    """Largest values of the motion so far."""

    gap_velocity: Float[Array, ""]  # [m/s]
    # [m/s] gap velocity that all kinetic energy could give a contact; at least what
    # bodies at rest gain while a closed gap opens
    speed: Float[Array, ""]
    acceleration: Float[Array, ""]  # [m/s^2] of a gap


def contact_margins(
    contacts: Contacts,
    mu: Float[Array, " m"] | None,
    modes: Modes,
    scales: Scales,
    below: Float[Array, " m"],
    slip: Float[Array, "m 2"] | None = None,
) -> Float[Array, " k"]:
    """Margins while the modes hold: gaps or normal forces, then those of friction.

    Equation: `f_j - below_j` of an open contact, `lambda_j W_jj + slack` of a
    persistent one, with a slack for rounding; friction by `friction_margins`.

    `below`: gaps <= 0 that the step begins with [m]. `slip`: directions, as in
    `forces`.
    """
    force = forces(contacts, mu, modes, slip)
    w = jnp.diagonal(contacts.delassus)
    m = len(modes.active)
    dtype = w.dtype
    slack = rest_acceleration(dtype) * scales.acceleration
    gap = contacts.normal.value - below
    push = force.normal * w[:m] + slack
    normal = jnp.where(modes.active, push, gap)
    if contacts.tangent is None or mu is None or force.tangential is None:
        return normal
    # sliding ends where slip does, and where its forces stop to exist: both may be in
    # one step else its product with slip is 0
    sliding = modes.active & ~modes.stick
    slides = any_lane(jnp.any(sliding))
    one = jnp.ones((), dtype)
    regular = jax.lax.cond(
        slides, lambda: regularity(contacts, mu, modes, slip), lambda: one
    )
    lasts = regular - precision(dtype).root
    friction = friction_margins(contacts, mu, modes, force, lasts, slack, scales.speed)
    return jnp.concatenate([normal, friction])


def friction_margins(
    contacts: Contacts,
    mu: Float[Array, " m"],
    modes: Modes,
    force: Forces,
    lasts: Float[Array, ""],
    slack: Float[Array, ""],
    speed_scale: Float[Array, ""],
) -> Float[Array, " m"]:
    """Margins of friction: distance from the rim of the cone plus `slack`, or slip
    times `lasts`.

    The first of contacts that stick, see `cone_margins`; the second of those that
    slide, see `slip_margins`, with `lasts` what is left of the regularity until forces
    count as singular; 1 of open ones.
    """
    to_rim = cone_margins(contacts, mu, force)
    cone = to_rim + slack
    ends = slip_margins(contacts, mu, modes, force, lasts, speed_scale)
    held = jnp.where(modes.stick, cone, ends)
    return jnp.where(modes.active, held, 1.0)


class MotionFlow(eqx.Module, stepper.Flow):
    """Flow of the stepper that rigid and compliant contacts have in common.

    Rows y of the state: those of `State`, then `error_only_rows`. The last of the
    margins is the time left to the next sample. Margins are in units of their rounding.
    In space tangents are along the `axes` of the step.
    """

    system: System
    rounding: Float[Array, " margins"]
    sample: Float[Array, ""]  # [s] time of the next sample
    rtol: float
    sizes: Float[Array, "rows 1"]  # a step may make errors of `rtol` of them
    like: State  # of its shapes
    longest: Float[Array, ""]  # [s] longest step
    mu: Float[Array, " m"] | None
    axes: SlipAxes | None

    @property
    def error_only_rows(self) -> int:
        """Number of rows after those of the state, whose errors only limit the length
        of steps.

        In space m: logarithms of slip, so that steps follow it until little is left.
        """
        if self.axes is None:
            return 0
        return len(self.axes.speed)

    @property
    def taking_part(self) -> int:  # type: ignore[override]
        """1: it scales the number of passes that the stepper allows at full
        tolerance.
        """
        return 1

    @property
    def tolerance(self) -> Float[Array, "1 1"]:  # type: ignore[override]
        """`rtol`, as (1, 1)."""
        return jnp.full((1, 1), self.rtol, self.sizes.dtype)

    def allowance(
        self, modes: Int[Array, "k 1"], y: Float[Array, "rows 1"]
    ) -> Float[Array, "rows 1"]:
        """Errors that a step may make in each row, in tolerances."""
        return self.sizes

    @property
    def zero_margin(self) -> Float[Array, "1 1"]:
        """1: margins are in units of their rounding."""
        return jnp.ones((1, 1), self.sizes.dtype)

    def with_margin_of_sample(
        self, margins: Float[Array, " k"], state: State
    ) -> Float[Array, "margins 1"]:
        """Rows of margins, that of the next sample `t_sample - t` last, over their
        rounding.
        """
        time_left = self.sample - state.t
        with_time = jnp.append(margins, time_left)
        scaled = with_time / self.rounding
        return scaled[:, None]

    def errors_of_error_only_rows(
        self,
        settings: Settings,
        state: State,
        h: Float[Array, ""],
        of_q: Float[Array, " nq"],
    ) -> list[Float[Array, " m"]]:
        """Errors that a step of length h [s] may make in `error_only_rows`.

        `of_q`: sizes `|q| + h |q'|` of the coordinates within the step.
        """
        if self.axes is None:
            return []
        errors = turning_errors(self.axes, settings.rtol, self.speed_scale)
        return [errors]

    @property
    @abc.abstractmethod
    def speed_scale(self) -> Float[Array, ""]:
        """Largest speed [m/s] of the motion so far, of which small slip is a share."""

    def contacts(self, state: State) -> Contacts:
        """Contact space at this state, with tangents along the axes of the step."""
        if self.axes is None:
            along = None
        else:
            along = self.axes.along
        rubs = self.mu is not None
        return contacts_at(self.system, state.q, state.v, state.t, rubs, along)

    def slip(self, modes: Modes, contacts: Contacts) -> Float[Array, "m 2"] | None:
        """Directions of slip in space, in the axes of the step; None in the plane."""
        if self.axes is None or contacts.tangent is None:
            return None
        return slip_within(self.axes, modes, contacts.tangent.rate)

    def rows_of(
        self,
        rates: State,
        state: State,
        modes: Modes,
        contacts: Contacts,
        force: Forces,
    ) -> list[Float[Array, "rows 1"]]:
        """Rates (rows, 1) of the state, and in space those of the logarithms of
        slip.
        """
        rows = [self.regular(rates, state)]
        if self.axes is not None:
            growth = log_rates(self.axes, modes, contacts, force)
            rows.append(growth[:, None])
        return rows

    def projected(
        self, const: Any, state: State
    ) -> tuple[State, Bool[Array, " jumps"]]:
        """The state, moved back onto the constraints of its modes; true where a normal
        jumped.
        """
        return state, jnp.zeros(0, bool)

    def switch(
        self,
        modes: Int[Array, "k 1"],
        y: Float[Array, "rows 1"],
        which: Bool[Array, "margins 1"],
    ) -> tuple[Int[Array, "k 1"], Float[Array, "rows 1"]]:
        """Modes and state unchanged: events are resolved between flights."""
        return modes, y

    def over(
        self,
        modes: Int[Array, "k 1"],
        y: Float[Array, "rows 1"],
        passes: Float[Array, "1 1"],
    ) -> Bool[Array, "1 1"]:
        """False: the loop of the motion decides when it ends."""
        return jnp.zeros((1, 1), bool)

    def regular(self, rates: State, state: State) -> Float[Array, "rows 1"]:
        """Rates (rows, 1) of the state; NaN where M is not positive definite."""
        rows = packed(rates)
        if not callable(self.system.mass):
            return rows
        mass = mass_at(self.system, state.q)
        positive = definite(mass)
        return jnp.where(positive, rows, jnp.nan)


class MechanicalFlow(MotionFlow):
    """Rigid contacts with frozen modes: open, or persistent and sticking or sliding.

    Modes (rows): for each contact, whether it is persistent, whether it sticks, the
    sign of its sliding. Margins: gaps of open contacts, normal forces of persistent
    ones, then friction (the cone, or the speed of sliding times what is left of
    `regularity`).
    """

    scales: Scales
    # [m] gaps that the step begins with, 0 where they are positive
    below: Float[Array, " m"]

    # steps in time are exact for parabolas: only the last of a landing is not in time
    near = 0.01

    @property
    def error_only_rows(self) -> int:
        """Gaps by integration (m), too: steps follow a base that moves faster than the
        body.
        """
        m = self.like.contact_work.shape[1]
        return m + super().error_only_rows

    @property
    def speed_scale(self) -> Float[Array, ""]:
        """Gap velocity [m/s] that all kinetic energy could give a contact."""
        return self.scales.speed

    def errors_of_error_only_rows(
        self,
        settings: Settings,
        state: State,
        h: Float[Array, ""],
        of_q: Float[Array, " nq"],
    ) -> list[Float[Array, " m"]]:
        """Errors `atol + rtol (|f| + h |f'| + |N|^T |u|)` of gaps, then those of slip.

        u: sizes of coordinates in the step, of displacements where the body has
        quaternions.
        """
        if self.system.body.coordinates is None:
            of_u = of_q
        else:
            of_u = h * jnp.abs(state.v)
        normal, _ = kinematics(self.system, state.q, state.v, state.t)
        f = jnp.abs(normal.value)
        rate = jnp.abs(normal.rate)
        gradient = jnp.abs(normal.gradient)
        sizes = f + h * rate + gradient.T @ of_u
        errors = settings.atol + settings.rtol * sizes
        others = super().errors_of_error_only_rows(settings, state, h, of_q)
        return [errors, *others]

    def constants(self, modes: Int[Array, "k 1"]) -> Modes:
        """Modes from their rows."""
        return decoded(modes, self.sizes.dtype)

    def field(
        self, const: Modes, modes: Int[Array, "k 1"], y: Float[Array, "some 1"]
    ) -> Float[Array, "rows 1"]:
        """Rates of q, v, t and the works with the forces that keep the modes.

        Equation: `q' = rates(q, v)`, `M v' = (loads) + N lambda_n + H lambda_t`, powers
        `F . v`, `lambda_t . u` and that of the base; then gap velocities of open
        contacts, in space `(ln |u|)'`.
        """
        state = unpacked(self.like, y)
        system = self.system
        contacts = self.contacts(state)
        slip = self.slip(const, contacts)
        force = forces(contacts, self.mu, const, slip)
        friction, base = contact_powers(system, contacts, force, state.t)
        no_normal = jnp.zeros_like(friction)
        push = user_force(system, state.q, state.v, state.t)
        power = push @ state.v
        rates = State(
            q=system.body.rates(state.q, state.v),
            v=force.acceleration,
            t=jnp.ones_like(state.t),
            work=power,
            base_work=base,
            contact_work=jnp.stack([no_normal, friction]),
            contact=jnp.zeros_like(state.contact),
        )
        gamma = contacts.normal.rate
        by_steps = jnp.where(const.active, 0.0, gamma)
        gaps_by_steps = by_steps[:, None]
        rows, *logs = self.rows_of(rates, state, const, contacts, force)
        return jnp.concatenate([rows, gaps_by_steps, *logs])

    def margins(
        self, const: Modes, modes: Int[Array, "k 1"], y: Float[Array, "some 1"]
    ) -> Float[Array, "margins 1"]:
        """Rows of `contact_margins`, and of the time left to the next sample."""
        state = unpacked(self.like, y)
        contacts = self.contacts(state)
        slip = self.slip(const, contacts)
        margins = contact_margins(
            contacts, self.mu, const, self.scales, self.below, slip
        )
        return self.with_margin_of_sample(margins, state)

    def projected(self, const: Modes, state: State) -> tuple[State, Bool[Array, " m"]]:
        """Gaps, gap velocities and slip that the modes hold set to 0: the least change
        by M.

        Equation: `q += M^-1 D p_q`, `v += M^-1 D p_v` with `W p = -(f, rates)` in held
        rows. A persistent contact whose gap velocity exceeds JUMP of the speed after
        the step has got another normal: then nothing is changed. True (second result)
        where that is so. In space slip across its direction is set to 0, too, of
        contacts whose slip begins or ends.
        """
        contacts = self.contacts(state)
        value = contacts.normal.value
        rate = contacts.normal.rate
        by_steps = MORE_THAN_STEPS * self.rtol
        share = max(not_rounding(JUMP, rate.dtype), by_steps)
        # a motion that began at rest had no speed before this step
        energy = kinetic(self.system, state.q, state.v)
        w = jnp.diagonal(contacts.delassus)
        by_energy = speed_of(energy, w[: len(rate)])
        speed = jnp.maximum(self.scales.speed, by_energy)
        turned = jnp.abs(rate) > share * speed
        jumps = const.active & turned
        if contacts.tangent is not None:  # tangentially only velocities drift
            slip = contacts.tangent.rate
            zero = jnp.zeros_like(slip)
            value = jnp.concatenate([value, zero])
            rate = jnp.concatenate([rate, slip])
            if self.axes is not None:
                const = straightened(self.axes, const, slip)
        drift = jnp.stack([value, rate], axis=1)
        p = constraint_impulse(contacts, self.mu, const, drift)
        move = contacts.moved @ p
        of_gaps, of_rates = move.T
        q = self.system.body.moved(state.q, of_gaps)
        v = state.v + of_rates
        back = state._replace(q=q, v=v)
        jumped = jnp.any(jumps)
        return choose(jumped, state, back), jumps


def packed(state: State) -> Float[Array, "rows 1"]:
    """Rows of a state, in the order of its fields."""
    flat, _ = ravel_pytree(state)
    return flat[:, None]


def unpacked(like: State, y: Float[Array, "rows 1"]) -> State:
    """State from its rows; rows after them (`error_only_rows`) are left out."""
    flat, back = ravel_pytree(like)
    n = len(flat)
    return back(y[:n, 0])


def decoded(rows: Int[Array, "k 1"], dtype: Any) -> Modes:
    """Modes from their rows (3 m, 1), see `encoded`."""
    active, stick, sign = rows[:, 0].reshape(3, -1)
    persistent = active > 0
    sticks = stick > 0
    return Modes(persistent, sticks, sign.astype(dtype))


def encoded(modes: Modes) -> Int[Array, "k 1"]:
    """Modes as rows (3 m, 1) of whole numbers: `active`, `stick`, `sign`."""
    rows = [modes.active, modes.stick, modes.sign]
    whole = [jnp.int32(x) for x in rows]
    column = jnp.concatenate(whole)
    return column[:, None]


class Flight(NamedTuple):
    """A flight under way."""

    state: State
    aim: stepper.Step  # the step to try
    # `StepperState.progress`: what the stepper expects of the step
    plan: Float[Array, "4 1"]
    free: Float[Array, ""]  # [s] length of steps that neither event nor sample shortens
    event: Bool[Array, " margins"]  # margins that the last step has brought to 0
    jumped: Bool[Array, ""]  # a normal has jumped: no derivatives from then on
    sample: Int[Array, ""]  # number of samples reached
    steps: Int[Array, ""]
    # steps vanish, are too many, or left the range of the gap function
    stuck: Bool[Array, ""]


def longest_step(system: System, targets: Float[Array, " S"]) -> Float[Array, ""]:
    """Bound of a step [s]: a part of the duration where loads or base may depend on
    time, or inf.

    `targets`: times of the samples.
    """
    if system.base is None and system.force is None:
        return jnp.full((), jnp.inf, targets.dtype)
    begin = targets[0]
    duration = jax.lax.stop_gradient(targets[-1] - begin)
    return duration / LOOKS


def first_flight(
    system: System,
    state: State,
    rows: Int[Array, "k 1"],
    events: int,
    targets: Float[Array, " S"],
) -> Flight:
    """A flight at the start of the motion, where the first sample is reached.

    `rows` of the modes; `events`: number of margins whose zeros are events.
    """
    between = jax.lax.stop_gradient(targets[1] - targets[0])
    step = jnp.minimum(between, longest_step(system, targets))
    # `stepper.Step.clock`: a step in time from 0 of this length, to no target
    no = 0 * step
    clock = jnp.stack([no, step, no, no])
    target = jnp.zeros((events + 1, 1), bool)
    return Flight(
        state=state,
        aim=stepper.Step(rows, target, clock[:, None]),
        plan=jnp.zeros((4, 1), step.dtype),
        free=step,
        event=jnp.zeros(events, bool),
        jumped=jnp.asarray(False),
        sample=jnp.int32(1),
        steps=jnp.int32(0),
        stuck=jnp.asarray(False),
    )


def next_sample(
    targets: Float[Array, " S"], reached: Int[Array, ""]
) -> Float[Array, ""]:
    """Time [s] of the sample that follows the first `reached` ones."""
    last = targets.shape[0] - 1
    following = jnp.minimum(reached, last)
    return targets[following]


def toward_sample(
    flight: Flight, targets: Float[Array, " S"], h: Float[Array, ""]
) -> Flight:
    """The flight with a next step of length h [s], which lands on a nearer sample."""
    t = next_sample(targets, flight.sample)
    left = t - flight.state.t
    lands = left <= h
    # the last margin is the time left; `clock` and `plan`: see `stepper.Step`,
    # `StepperState`
    no_target = jnp.zeros_like(flight.aim.target)
    target = no_target.at[-1].set(lands)
    no = 0 * h
    landing = lands.astype(h.dtype)
    clock = jnp.stack([no, h, no, landing])
    ahead = jnp.where(lands, left, h)
    plan = flight.plan.at[0, 0].set(ahead).at[1].set(0.0)
    aim = flight.aim._replace(target=target, clock=clock[:, None])
    aim, plan = jax.lax.stop_gradient((aim, plan))
    return flight._replace(aim=aim, plan=plan)


def one_pass(
    flow: MotionFlow,
    settings: Settings,
    allowed: Float[Array, " rows"],
    targets: Float[Array, " S"],
    flight: Flight,
    flies: Bool[Array, ""] | bool = True,
) -> tuple[Flight, Bool[Array, ""]]:
    """Flight after one pass of the stepper, and true if its step is accepted.

    `allowed` are the errors of all rows of the state but q and v. A lane of a batch
    that does not fly (`flies` false) keeps its state; only the step to try changes,
    which `toward_sample` then sets anew.
    """
    state = flight.state
    aim = flight.aim
    errors = _errors(flow, settings, allowed, flight)
    tolerances = jax.lax.stop_gradient(errors / flow.rtol)
    flow = dataclasses.replace(
        flow, sample=next_sample(targets, flight.sample), sizes=tolerances[:, None]
    )
    # passes are counted here: their number does not lower the tolerance
    no_passes = flight.plan.at[2:].set(0.0)
    rows = _rows(flow, state)
    carry = stepper.StepperState(rows, aim, no_passes)
    after, accepted = stepper.advance(flow, carry, 2)
    step = after.step
    accept = accepted[0, 0] & flies
    landed = aim.target[:, 0] & accept  # margins that the step has brought to 0
    sampled = landed[-1]
    new, jumps = _reached(flow, aim, after.y)
    state = choose(accept, new, state)
    jumps = jumps & accept
    event = landed[:-1].at[: len(jumps)].max(jumps)  # another normal is an event, too
    counted = jnp.asarray(flies).astype(flight.steps.dtype)
    steps = flight.steps + counted
    proposed = step.length[0, 0]
    shrinks = proposed < _smallest_step(targets)
    # a landing on what is left within rounding is as short, and ends
    lands_not = step.lands[0, 0] == 0
    vanishes = flies & ~accept & shrinks & lands_not
    too_many = steps >= settings.max_steps
    outside = out_of_range(flow.system, state)
    free = _free_step(flight, accept, proposed)
    moved = flight._replace(
        state=state,
        free=free,
        aim=jax.lax.stop_gradient(step),
        plan=jax.lax.stop_gradient(after.progress),
        event=jnp.where(flies, event, flight.event),
        jumped=flight.jumped | jnp.any(jumps),
        sample=flight.sample + sampled.astype(flight.sample.dtype),
        steps=steps,
        stuck=flight.stuck | vanishes | too_many | outside,
    )
    begins = jnp.minimum(free, flow.longest)  # forces may have set in since `free`
    h = jnp.where(sampled, begins, proposed)
    aimed = toward_sample(moved, targets, h)
    in_root = step.in_root[0, 0]
    in_time = (in_root == 0) & lands_not
    # the stepper keeps its plan for a landing, a step in the root of time, and a
    # rejected one
    plain = sampled | (accept & in_time)
    aim, plan = choose(plain, (aimed.aim, aimed.plan), (moved.aim, moved.plan))
    return moved._replace(aim=aim, plan=plan), accept


def _free_step(
    flight: Flight, accept: Bool[Array, ""], proposed: Float[Array, ""]
) -> Float[Array, ""]:
    """Length [s] of steps that neither event nor sample shortens, after a step.

    The `proposed` one after an accepted step; where that step was shortened at least
    FORGET of the old one, as it says nothing of the steps after it; the old one after a
    step that was rejected or is a landing.
    """
    old = flight.free
    tried = flight.aim.length[0, 0]
    lands = flight.aim.lands[0, 0] > 0
    remembered = jnp.maximum(proposed, FORGET * old)
    shortened = tried < old
    longer = jnp.where(shortened, remembered, proposed)
    new = jax.lax.stop_gradient(longer)
    changes = accept & ~lands
    return jnp.where(changes, new, old)


def out_of_range(system: System, state: State) -> Bool[Array, ""]:
    """True where q is outside the range in which the gap function of the body holds.

    False for a body that states no range.
    """
    body = system.body
    if type(body).valid is Body.valid:
        return jnp.asarray(False)
    seen = seen_from_base(system, state.q, state.t)
    margin = body.valid(seen)
    return ~(margin >= 0)


def status_at_start(
    system: System, state: State, end: Float[Array, ""], closed_below: Any
) -> Int[Array, ""]:
    """Status code of a motion that begins in this state and shall last until `end`
    [s].
    """
    allowed = jnp.maximum(closed_below, system.body.overlap)
    gap = recorded_gaps(system, state.q, state.t)
    indented = gap < -allowed
    penetrates = jnp.any(indented)
    outside = out_of_range(system, state)
    backward = end <= state.t
    status = jnp.where(penetrates, CODE["penetration"], CODE["ok"])
    status = jnp.where(outside, CODE["out_of_range"], status)
    status = jnp.where(backward, CODE["backward"], status)
    finite_q = jnp.all(jnp.isfinite(state.q))
    finite_v = jnp.all(jnp.isfinite(state.v))
    finite = finite_q & finite_v & jnp.isfinite(end)
    code = jnp.where(finite, status, CODE["not_finite"])
    return code.astype(jnp.int32)


def _rows(flow: MotionFlow, state: State) -> Float[Array, "rows 1"]:
    """Rows of the state, then `error_only_rows`, which begin at 0."""
    rows = packed(state)
    more = (0, flow.error_only_rows)
    return jnp.pad(rows, (more, (0, 0)))


def _reached(
    flow: MotionFlow, aim: stepper.Step, y: Float[Array, "rows 1"]
) -> tuple[State, Bool[Array, " jumps"]]:
    """State at the end of a step from its rows, `projected`, and contacts whose normal
    jumped.

    On a sample t is that of the sample to the last digit.
    """
    const = flow.constants(aim.modes)
    reached = unpacked(flow.like, y)
    new, jumps = flow.projected(const, reached)
    on_sample = aim.target[-1, 0]
    t = jnp.where(on_sample, flow.sample, new.t)
    return new._replace(t=t), jumps


def _errors(
    flow: MotionFlow,
    settings: Settings,
    allowed: Float[Array, " others"],
    flight: Flight,
) -> Float[Array, " rows"]:
    """Errors that a step of length h may make in each row.

    Equation: `atol + rtol (|q| + h |q'|)`, v likewise, by sizes within the step as they
    may cross 0; then the `allowed` ones of other rows of the state, and those of
    `error_only_rows`.
    """
    system = flow.system
    state = flight.state
    h = flight.plan[0, 0]
    push = user_force(system, state.q, state.v, state.t)
    mass = mass_at(system, state.q)
    rates = free_acceleration(system, state.q, state.v, push, mass)
    q_rates = jnp.abs(system.body.rates(state.q, state.v))
    v_rates = jnp.abs(rates)
    of_q = jnp.abs(state.q) + h * q_rates
    of_v = jnp.abs(state.v) + h * v_rates
    sizes = jnp.concatenate([of_q, of_v])
    errors = settings.atol + settings.rtol * sizes
    others = flow.errors_of_error_only_rows(settings, state, h, of_q)
    return jnp.concatenate([errors, allowed, *others])


def _smallest_step(targets: Float[Array, " S"]) -> Float[Array, ""]:
    """Length [s] below which a step does not move time any more."""
    begin = jnp.abs(targets[0])
    end = jnp.abs(targets[-1])
    latest = begin + end
    share = not_rounding(SMALLEST_STEP, targets.dtype)
    return share * latest


def allowed_errors(
    system: System, settings: Settings, state: State, share: float = LEDGER
) -> Float[Array, " rows"]:
    """Errors allowed in all rows of the state but q and v: time, works [J], contacts.

    Equation: `share (|M v'| . e_q + |M v| . e_v)`, the work of the errors
    `e = atol + rtol |.|` of q and v; at least atol; time may err by anything, as it is
    integrated exactly.
    """
    q, v, t, *_ = state
    mass = mass_at(system, q)
    push = user_force(system, q, v, t)
    free = free_acceleration(system, q, v, push, mass)
    both = jnp.stack([free, v], axis=1)
    if mass.ndim == 1:
        product = mass[:, None] * both
    else:
        product = mass @ both
    by_forces, by_velocity = jnp.abs(product).T  # |M v'|, |M v|
    e_q = settings.atol + settings.rtol * jnp.abs(q)
    e_v = settings.atol + settings.rtol * jnp.abs(v)
    if system.body.coordinates is not None:  # of displacements
        e_q = jnp.broadcast_to(jnp.max(e_q), v.shape)
    work = e_q @ by_forces + e_v @ by_velocity
    ledger = share * work
    every_row = len(packed(state))
    others = every_row - len(q) - len(v)
    smallest = jnp.maximum(ledger, settings.atol)  # positive even at rest
    rows = jnp.full(others, smallest)
    return rows.at[0].set(jnp.inf)  # time


def roundings(
    margins: Float[Array, " k"], targets: Float[Array, " S"]
) -> Float[Array, " margins"]:
    """Roundings of margins, and last that of the time to the next sample; none is 0."""
    tiny = precision(targets.dtype).tiny
    smallest = tiny**0.5
    with_time = jnp.append(margins, _smallest_step(targets))
    return jax.lax.stop_gradient(jnp.maximum(with_time, smallest))


def flow_of(
    system: System,
    mu: Float[Array, " m"] | None,
    settings: Settings,
    modes: Modes,
    scales: Scales,
    targets: Float[Array, " S"],
    state: State,
) -> MechanicalFlow:
    """Flow from this state with these modes; `one_pass` sets `sample` and `sizes`.

    Roundings of margins: `gap_rounding` of gaps [m], a share of the acceleration of
    normal forces and of the cone, of the speed of slip.
    """
    dtype = state.q.dtype
    share = rest_acceleration(dtype)
    slack = share * scales.acceleration
    normal = jnp.where(modes.active, slack, settings.gap_rounding)
    begins = modes.sign == BEGINS
    stuck = modes.stick | begins
    of_slip = share * scales.speed
    friction = jnp.where(stuck, slack, of_slip)
    if settings.friction:
        margins = jnp.concatenate([normal, friction])
    else:
        margins = normal
    rounded = roundings(margins, targets)
    longest = longest_step(system, targets)
    blank = jnp.zeros((1, 1), dtype)
    # where contacts that were held not quite closed are closed, redundant ones come to
    # lie below
    gap = gaps(system, state.q, state.t)
    below = jax.lax.stop_gradient(jnp.minimum(gap, 0.0))
    axes = None
    if mu is not None and settings.spatial:
        contacts = contacts_at(system, state.q, state.v, state.t, friction=True)
        axes = slip_axes(contacts, mu, modes, scales.speed)
    return MechanicalFlow(
        system=system,
        rounding=rounded,
        sample=state.t,
        rtol=settings.rtol,
        sizes=blank,
        like=state,
        longest=longest,
        mu=mu,
        axes=axes,
        scales=scales,
        below=below,
    )
