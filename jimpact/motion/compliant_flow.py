"""Motion under the contact forces of a `Compliant` law, between events, and when these come."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jimpact.events.contact_flow import Phase
from jimpact.laws.forces import Force
from jimpact.motion.dynamics import kinematics, user_force
from jimpact.motion.flow import (
    MotionFlow,
    State,
    friction_margins,
    longest_step,
    packed,
    roundings,
    unpacked,
)
from jimpact.motion.persistent_contact import (
    BEGINS,
    Contacts,
    Forces,
    Modes,
    by_contact,
    constraint_impulse,
    contact_powers,
    contacts_at,
    forces,
    friction_acceleration,
    no_modes,
    rest_acceleration,
    slip_frames,
    with_normal_forces,
)
from jimpact.motion.slip_in_space import slip_axes, straightened
from jimpact.motion.tables import MotionProblem
from jimpact.motion.transitions import velocity_noise
from jimpact.numerics.stepper import any_of

# Of the errors allowed: margins closer to 0 are 0. Ten times more, and events are off by a tenth
# of the tolerance.
SNAP = 1e-2
# Longest step, in the time in which the stiffest or most damped contact moves by one radian. Of a
# body at rest on its springs steps see no error. Ten times more: derivatives of its oscillations
# are wrong; a hundred times more: they grow by 1e11 in a step.
STABLE = 0.5
SLOWEST = 1e-12  # [m/s] scale of contacts that have not moved yet; any small one would do


class ContactScales(NamedTuple):
    """Scales of each contact (m,), from its fastest approach so far."""

    speed: jax.Array  # [m/s]
    depth: jax.Array  # [m] indentation at that speed
    force: jax.Array  # [N] at that indentation
    onset: jax.Array  # of `Force.onset`, of the dimension that it has
    impulse: jax.Array  # [N s]
    slip: jax.Array  # () [m/s] of the whole motion so far


class Phases(NamedTuple):
    """Of each contact (m,): its phase, and how it slides or sticks while its force acts."""

    phase: jax.Array
    side: Modes


def _contact_scales(force: Force, contacts: Contacts, fastest: jax.Array) -> ContactScales:
    """The scales that belong to these speeds (m,) of approach, and of slip after them."""
    m = len(contacts.normal.rate)
    w, slip = jnp.diagonal(contacts.delassus)[:m], jnp.maximum(jnp.max(fastest), SLOWEST)
    speed = jnp.maximum(fastest[:m], SLOWEST)
    depth = force.indentation_scale(0.5 * speed**2 / w)
    push, onset = force.force(depth, jnp.zeros_like(depth)), force.onset_scale(depth, speed)
    return jax.lax.stop_gradient(ContactScales(speed, depth, push, onset, speed / w, slip))


class CompliantFlow(MotionFlow):
    """Forces of contacts of which each is open, in compression, in expansion, or slack.

    Equation: `M q'' = (loads) + N F(x, x') + H lambda_t`, `x' = -f'` (in expansion `-f' / e^2`);
    `lambda_t` holds contacts that stick (`h'' = 0`), and is `-mu F u / |u|` at those that slide.

    The indentation x is a row of the state, -gap before the contact first closes: a plastic contact
    keeps a residual indentation, at which it closes again. Modes (rows): the phase of each contact,
    as in `events/contact_flow.py`; with friction whether it sticks and the sign of its sliding.
    Margins: by indentation, then by velocity, then what is left of the cone or of slip.
    """

    force: Force
    scales: ContactScales

    @property
    def speed_scale(self) -> jax.Array:
        """The largest gap velocity or slip so far."""
        return self.scales.slip

    def constants(self, modes: jax.Array) -> Phases:
        """Phases and friction."""
        return phases_of(modes, self.like)

    def pushed(self, const: Phases, at: State) -> tuple[Contacts, Forces]:
        """Contact space with the normal forces that act, and the forces."""
        contacts = self.contacts(at)
        push = normal_forces(self.force, const.phase, contacts, at)
        if self.mu is None:
            return contacts, Forces(push, None, contacts.free + contacts.moved @ push)
        known = with_normal_forces(contacts, push)
        return known, forces(known, self.mu, const.side, self.slip(const.side, known))

    def field(self, const: Phases, modes: jax.Array, y: jax.Array) -> jax.Array:
        """Rates of the state."""
        at = unpacked(self.like, y)
        contacts, force = self.pushed(const, at)
        gamma, push = contacts.normal.rate, force.normal
        closing = _unloading(self.force, const.phase, -gamma)
        friction, base = contact_powers(self.system, contacts, force, at.t)
        remembered = [closing, push]
        if force.tangential is not None:
            remembered.extend(by_contact(self.along_tangents(force.tangential), len(push)).T)
        rates = State(
            q=self.system.body.rates(at.q, at.v),
            v=force.acceleration,
            t=jnp.ones_like(at.t),
            work=user_force(self.system, at.q, at.v, at.t) @ at.v,
            base_work=base,
            contact_work=jnp.stack([push * gamma, friction]),
            contact=jnp.stack(remembered),
        )
        return jnp.concatenate(self.rows_of(rates, at, const.side, contacts, force))

    def along_tangents(self, tangential: jax.Array) -> jax.Array:
        """Tangential forces, in space along the tangents of the body."""
        if self.axes is None:
            return tangential
        each = by_contact(tangential, len(self.axes.along))
        return jnp.einsum("mj,mjk->mk", each, slip_frames(self.axes.along)).reshape(-1)

    def margins(self, const: Phases, modes: jax.Array, y: jax.Array) -> jax.Array:
        """Where a gap closes, a force ends or returns; where compression or friction turns."""
        at = unpacked(self.like, y)
        if self.mu is None:
            rate = kinematics(self.system, at.q, at.v, at.t)[0].rate
            return self.from_margins(self._normal_margins(const.phase, rate, at.contact[0]), at)
        contacts, force = self.pushed(const, at)
        normal = self._normal_margins(const.phase, contacts.normal.rate, at.contact[0])
        zero = jnp.zeros_like(at.t)
        side = friction_margins(
            contacts, self.mu, const.side, force, zero + 1, zero, self.scales.slip
        )
        return self.from_margins(jnp.concatenate([normal, side]), at)

    def _normal_margins(self, const: jax.Array, rate: jax.Array, x: jax.Array) -> jax.Array:
        """By indentation, then by velocity (2 m,)."""
        gamma, depth = rate / self.scales.speed, x / self.scales.depth
        if self.force.slackens:
            onset = self.force.onset(jnp.where(x >= 0, x, 0.0), -rate) / self.scales.onset
            by_x = jnp.where(const == Phase.COMPRESSION, onset, -onset)
            by_g = depth
        else:
            by_x = jnp.where(const == Phase.EXPANSION, depth, 1.0)
            by_g = jnp.where(const == Phase.COMPRESSION, -gamma, gamma)
        by_x = jnp.where(const == Phase.OPEN, -depth, by_x)
        return jnp.concatenate([by_x, jnp.where(const == Phase.OPEN, 1.0, by_g)])

    def rooted(self, modes: jax.Array) -> jax.Array:
        """Openings, by the root of the indentation."""
        phase = self.constants(modes).phase[:, None]
        opens = phase == Phase.EXPANSION
        by_g = (phase == Phase.COMPRESSION) & self.force.slackens
        rest = jnp.zeros((self.rounding.shape[0] - 2 * opens.shape[0], 1), bool)
        return jnp.concatenate([opens, by_g, rest])

    def switch(
        self, modes: jax.Array, y: jax.Array, which: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Phases after an event; a contact that closes or opens has no indentation."""
        at, (phase, side) = unpacked(self.like, y), self.constants(modes)
        m = len(phase)
        by_x, by_g = which[:m, 0], which[m : 2 * m, 0]
        closed = by_x & (phase == Phase.OPEN)
        if self.force.slackens:
            after = jnp.where(by_x & (phase == Phase.COMPRESSION), Phase.SLACK, phase)
            after = jnp.where(by_x & (phase == Phase.SLACK), Phase.COMPRESSION, after)
            opened = by_g
        else:
            turned = by_g & (phase == Phase.COMPRESSION)
            after = jnp.where(turned, Phase.EXPANSION, phase)
            after = jnp.where(by_g & (phase == Phase.EXPANSION), Phase.COMPRESSION, after)
            opened = by_x & (phase == Phase.EXPANSION)
            if self.force.bistiffness is not None:  # e = 0 returns nothing
                opened = opened | (turned & (self.force.bistiffness.restitution == 0))
        after = jnp.where(opened, Phase.OPEN, jnp.where(closed, Phase.COMPRESSION, after))
        x, impulses = at.contact[:1], at.contact[1:]
        indentation = jnp.where(opened | closed, 0.0, x)
        contact = jnp.concatenate([indentation, jnp.where(closed, 0.0, impulses)])
        rows = after
        if self.mu is not None:  # friction starts anew with the force
            keeps = loaded(phase) & loaded(after)
            rows = mode_rows(Phases(after, side._replace(active=keeps)))
        state = packed(at._replace(contact=contact))
        state = jnp.concatenate([state, y[len(state) :]])  # and spare rows as they are
        return rows[:, None].astype(modes.dtype), state

    def begins(self, before: jax.Array, after: jax.Array) -> jax.Array:
        """Where a force sets in."""
        before, after = (self.constants(x).phase[:, None] for x in (before, after))
        free = (before == Phase.OPEN) | (before == Phase.SLACK)
        return any_of((after == Phase.COMPRESSION) & free)

    def projected(self, const: Phases, at: State) -> tuple[State, jax.Array]:
        """Slip of contacts that stick set to 0, in the metric of M; normals may turn."""
        new = at if self.mu is None else self.without_slip(const.side, at)
        return new, jnp.zeros(0, bool)

    def stopped(self, which: jax.Array, at: State) -> State:
        """Slip of contacts (m,) set to 0."""
        one = jnp.ones_like(at.contact_work[0])
        return self.without_slip(Modes(which, which, one), at, straight=False)

    def without_slip(self, modes: Modes, at: State, straight: bool = True) -> State:
        """Slip of contacts that stick set to 0, and what of it is across where it ends."""
        contacts = self.contacts(at)
        known = with_normal_forces(contacts, jnp.zeros_like(contacts.normal.rate))
        assert known.tangent is not None
        rates = jnp.concatenate([jnp.zeros_like(contacts.normal.rate), known.tangent.rate])
        if straight and self.axes is not None:
            modes = straightened(self.axes, modes, known.tangent.rate)
        acts = modes.stick | (modes.sign == BEGINS) if straight else modes.stick
        p = constraint_impulse(known, self.mu, modes._replace(active=modes.active & acts), rates)
        return at._replace(v=at.v + contacts.moved @ p)


def loaded(phase: jax.Array) -> jax.Array:
    """Whether the force of a contact acts."""
    return (phase == Phase.COMPRESSION) | (phase == Phase.EXPANSION)


def normal_forces(force: Force, phase: jax.Array, contacts: Contacts, at: State) -> jax.Array:
    """Forces (m,) [N] of contacts in these phases."""
    x = at.contact[0]
    push = force.force(jnp.where(x >= 0, x, 0.0), -contacts.normal.rate)
    return jnp.where(loaded(phase), jnp.maximum(push, 0.0), 0.0)


def phases_of(modes: jax.Array, like: State) -> Phases:
    """The phases of such rows (m, 1) of modes, with friction (3 m, 1)."""
    m = like.contact_work.shape[1]
    phase = modes[:m, 0]
    none = no_modes(m, like.q.dtype)
    if len(modes) == m:
        return Phases(phase, none)
    stick, sign = modes[m:, 0].reshape(2, -1)
    acts = loaded(phase) & ((stick > 0) | (sign != 0))
    return Phases(phase, Modes(acts, stick > 0, sign.astype(none.sign.dtype)))


def mode_rows(now: Phases) -> jax.Array:
    """Rows (3 m,) of modes with friction; 0 where none acts."""
    friction = jnp.stack([x.astype(jnp.int32) for x in now.side[1:]])
    friction = jnp.where(now.side.active, friction, 0)
    return jnp.concatenate([now.phase.astype(jnp.int32), *friction])


def compliant_flow(
    problem: MotionProblem, at: State, modes: jax.Array, fastest: jax.Array
) -> CompliantFlow:
    """The flow from this state on, on the scales of the contacts so far."""
    system, force, mu, settings, _, _, times, m, _ = problem
    contacts = contacts_at(system, at.q, at.v, at.t, mu is not None)
    scales = _contact_scales(force, contacts, fastest)
    share, axes = jnp.full(m, SNAP * settings.rtol, at.q.dtype), None
    noise = velocity_noise(settings, jnp.max(jnp.abs(contacts.approach)))
    share = jnp.concatenate([share, jnp.maximum(share, noise / scales.speed)])
    if mu is not None:
        phase, now = phases_of(modes, at)
        push = normal_forces(force, phase, contacts, at)
        known = with_normal_forces(contacts, push)
        if settings.spatial:
            axes = slip_axes(known, mu, now, scales.slip)
        most = friction_acceleration(known, mu, jnp.maximum(scales.force, push))
        by_slip = now.active & ~now.stick
        rest = rest_acceleration(at.q.dtype)
        side = jnp.where(by_slip, jnp.maximum(rest * scales.slip, noise), rest * most)
        share = jnp.concatenate([share, side])
    rounded, longest = roundings(settings, share, times), longest_step(system, times)
    longest = jnp.minimum(longest, stable_step(force, modes, contacts, at))
    blank = jnp.zeros((len(packed(at)), 1), at.q.dtype)
    return CompliantFlow(
        system, rounded, times[0], settings.rtol, blank, at, longest, mu, axes, force, scales
    )


def stable_step(force: Force, modes: jax.Array, contacts: Contacts, at: State) -> jax.Array:
    """How long a step may be () [s] beside the stiffness and damping of the loaded contacts."""
    x, rate, m = at.contact[0], -contacts.normal.rate, len(at.contact[0])
    phase, one = modes[:m, 0], jnp.ones_like(x)
    x = jnp.where(x >= 0, x, 0.0)
    stiffness = jax.jvp(lambda x: force.force(x, rate), (x,), (one,))[1]
    damping = jax.jvp(lambda rate: force.force(x, rate), (rate,), (one,))[1]
    both = jnp.stack([_unloading(force, phase, stiffness), damping], axis=1)
    both = jnp.where(loaded(phase)[:, None], both, 0.0)
    square, rate = jnp.max(jnp.abs(contacts.delassus[:m, :m]) @ jnp.abs(both), axis=0)
    fastest = jax.lax.stop_gradient(jnp.maximum(jnp.sqrt(square), rate))
    return jnp.where(fastest > 0, STABLE / jnp.where(fastest > 0, fastest, 1.0), jnp.inf)


def _unloading(force: Force, phase: jax.Array, rate: jax.Array) -> jax.Array:
    """Rates (m,) of indentation, or of what goes with it, faster in plastic expansion."""
    if force.bistiffness is None:
        return rate
    e = jnp.where(force.bistiffness.restitution > 0, force.bistiffness.restitution, 1.0)
    return jnp.where(phase == Phase.EXPANSION, rate / e**2, rate)
