"""Motion under the contact forces of a `Compliant` law, between events, and when these
come.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

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
from jimpact.tools.masks import quotient

# Of the errors allowed: margins closer to 0 are 0. Ten times more, and events are off
# by a tenth of the tolerance.
SNAP = 1e-2
# Longest step, in the time in which the stiffest or most damped contact moves by one
# radian. Of a body at rest on its springs steps see no error. Ten times more:
# derivatives of its oscillations are wrong; a hundred times more: they grow by 1e11 in
# a step.
STABLE = 0.5
# [m/s] scale of contacts that have not moved yet; any small one would do
SLOWEST = 1e-12


class ContactScales(NamedTuple):
    """Scales of each contact, from its fastest approach so far."""

    speed: Float[Array, " m"]  # [m/s]
    depth: Float[Array, " m"]  # [m] indentation at that speed
    force: Float[Array, " m"]  # [N] at that indentation
    onset: Float[Array, " m"]  # of `Force.onset`, of the dimension that it has
    impulse: Float[Array, " m"]  # [N s]
    slip: Float[Array, ""]  # [m/s] of the whole motion so far


class ContactModes(NamedTuple):
    """Phase of each contact, and its mode of friction, which is active while the force
    acts.
    """

    phase: Int[Array, " m"]  # `contact_flow.Phase`: open, compression, expansion, slack
    friction: Modes


def contact_scales(
    force: Force, contacts: Contacts, fastest: Float[Array, " s"]
) -> ContactScales:
    """Scales of contacts from their largest gap velocities, and slips after them [m/s]
    (m or 2 m).

    Equation: the indentation x that stores the energy `speed^2 / (2 W_jj)`, the force
    F(x, 0), the impulse `speed / W_jj`.
    """
    m = len(contacts.normal.rate)
    w = jnp.diagonal(contacts.delassus)[:m]
    slip = jnp.maximum(jnp.max(fastest), SLOWEST)
    speed = jnp.maximum(fastest[:m], SLOWEST)
    depth = force.indentation_scale(0.5 * speed**2 / w)
    push = force.force(depth, jnp.zeros_like(depth))
    onset = force.onset_scale(depth, speed)
    scales = ContactScales(speed, depth, push, onset, speed / w, slip)
    return jax.lax.stop_gradient(scales)


class CompliantFlow(MotionFlow):
    """Flow with contact forces; each contact is open, in compression, in expansion, or
    slack.

    Equation: `M q'' = (loads) + N F(x, x') + H lambda_t`, `x' = -f'` (in expansion
    `-f' / e^2`); `lambda_t` holds contacts that stick (`h'' = 0`), and is
    `-mu F u / |u|` at those that slide.

    The indentation x is a row of the state, -gap before the contact first closes: a
    plastic contact keeps a residual indentation, at which it closes again. Modes
    (rows): the phase of each contact, as in `events/contact_flow.py`; with friction
    whether it sticks and the sign of its sliding. Margins: by indentation, then by
    velocity, then what is left of the cone or of slip.
    """

    force: Force
    scales: ContactScales

    @property
    def speed_scale(self) -> Float[Array, ""]:
        """The largest gap velocity or slip so far."""
        return self.scales.slip

    def constants(self, modes: Int[Array, "k 1"]) -> ContactModes:
        """Phases and modes of friction from their rows."""
        return contact_modes(modes, self.like)

    def contact_forces(self, const: ContactModes, at: State) -> tuple[Contacts, Forces]:
        """Contact space with the normal forces F of the law, and all forces.

        Tangential ones keep the modes of friction, `M v' = (loads) + N F + H lambda_t`.
        """
        contacts = self.contacts(at)
        push = normal_forces(self.force, const.phase, contacts, at)
        if self.mu is None:
            return contacts, Forces(push, None, contacts.free + contacts.moved @ push)
        known = with_normal_forces(contacts, push)
        slip = self.slip(const.friction, known)
        return known, forces(known, self.mu, const.friction, slip)

    def field(
        self, const: ContactModes, modes: Int[Array, "k 1"], y: Float[Array, "some 1"]
    ) -> Float[Array, "rows 1"]:
        """Rates of q, v, t, of the works, and of each contact: indentation, impulses.

        Equation: as of the class; powers `F . v` of loads, `lambda_n f'` and
        `lambda_t . u` of contacts; `x' = -f'`, p' = lambda.
        """
        at = unpacked(self.like, y)
        contacts, force = self.contact_forces(const, at)
        gamma = contacts.normal.rate
        push = force.normal
        closing = unloading(self.force, const.phase, -gamma)
        friction, base = contact_powers(self.system, contacts, force, at.t)
        remembered = [closing, push]
        if force.tangential is not None:
            along = self.along_tangents(force.tangential)
            remembered.extend(by_contact(along, len(push)).T)
        rates = State(
            q=self.system.body.rates(at.q, at.v),
            v=force.acceleration,
            t=jnp.ones_like(at.t),
            work=user_force(self.system, at.q, at.v, at.t) @ at.v,
            base_work=base,
            contact_work=jnp.stack([push * gamma, friction]),
            contact=jnp.stack(remembered),
            spring=self.spring_rates(const, at, contacts, force),
        )
        rows = self.rows_of(rates, at, const.friction, contacts, force)
        return jnp.concatenate(rows)

    def spring_rates(
        self, const: ContactModes, at: State, contacts: Contacts, force: Forces
    ) -> Float[Array, "b m"] | tuple[()]:
        """Rates of tangential springs: none, as contacts stick rigidly."""
        return ()

    def sizes_of_springs(self, at: State) -> list[Float[Array, " m"]]:
        """Sizes of the rows of tangential springs, of which steps may err by `rtol`:
        none.
        """
        return []

    def along_tangents(self, tangential: Float[Array, " t"]) -> Float[Array, " t"]:
        """Tangential forces along the tangents of the body, from those along `axes`."""
        if self.axes is None:
            return tangential
        each = by_contact(tangential, len(self.axes.along))
        frames = slip_frames(self.axes.along)
        return jnp.einsum("mj,mjk->mk", each, frames).reshape(-1)

    def margins(
        self, const: ContactModes, modes: Int[Array, "k 1"], y: Float[Array, "some 1"]
    ) -> Float[Array, "margins 1"]:
        """Rows of `_normal_margins`, with friction of `friction_margins`, and of the
        sample.
        """
        at = unpacked(self.like, y)
        if self.mu is None:
            rates, _ = kinematics(self.system, at.q, at.v, at.t)
            margins = self._normal_margins(const.phase, rates.rate, at.contact[0])
            return self.from_margins(margins, at)
        contacts, force = self.contact_forces(const, at)
        x = at.contact[0]
        normal = self._normal_margins(const.phase, contacts.normal.rate, x)
        zero = jnp.zeros_like(at.t)
        one = zero + 1
        friction = friction_margins(
            contacts, self.mu, const.friction, force, one, zero, self.scales.slip
        )
        return self.from_margins(jnp.concatenate([normal, friction]), at)

    def _normal_margins(
        self, const: Int[Array, " m"], rate: Float[Array, " m"], x: Float[Array, " m"]
    ) -> Float[Array, " 2*m"]:
        """Margins of phases `const`: m by the indentation x [m], then m by the gap
        velocity [m/s].

        | phase | by x | by gap velocity |
        |---|---|---|
        | open | -x: the gap closes | 1 |
        | compression | 1 | -f': it turns to expansion |
        | expansion | x: it opens | f': it is compressed again |

        With a force that may vanish at x > 0 (`slackens`) the first margin is
        `Force.onset` in compression, minus that where slack, and the second one x: the
        contact opens at x = 0. All are in units of the scales.
        """
        gamma = rate / self.scales.speed
        depth = x / self.scales.depth
        if self.force.slackens:
            inside = jnp.where(x >= 0, x, 0.0)
            onset = self.force.onset(inside, -rate) / self.scales.onset
            by_x = jnp.where(const == Phase.COMPRESSION, onset, -onset)
            by_g = depth
        else:
            by_x = jnp.where(const == Phase.EXPANSION, depth, 1.0)
            by_g = jnp.where(const == Phase.COMPRESSION, -gamma, gamma)
        by_x = jnp.where(const == Phase.OPEN, -depth, by_x)
        by_rate = jnp.where(const == Phase.OPEN, 1.0, by_g)
        return jnp.concatenate([by_x, by_rate])

    def rooted(self, modes: Int[Array, "k 1"]) -> Bool[Array, "margins 1"]:
        """True for margins of opening: landings on them step in the root of the
        indentation.
        """
        phase = self.constants(modes).phase[:, None]
        opens = phase == Phase.EXPANSION
        by_g = (phase == Phase.COMPRESSION) & self.force.slackens
        others = self.rounding.shape[0] - 2 * opens.shape[0]
        rest = jnp.zeros((others, 1), bool)
        return jnp.concatenate([opens, by_g, rest])

    def switch(
        self,
        modes: Int[Array, "k 1"],
        y: Float[Array, "rows 1"],
        which: Bool[Array, "margins 1"],
    ) -> tuple[Int[Array, "k 1"], Float[Array, "rows 1"]]:
        """Modes and state after the events `which`; a contact that closes or opens has
        x = 0.

        Phases change as `_normal_margins` says; friction that sets in with a force is
        decided by `compliant_contact`.
        """
        at = unpacked(self.like, y)
        phase, friction = self.constants(modes)
        after, at = self.switched_phases(phase, at, which)
        rows = after
        if self.mu is not None:  # friction starts anew with the force
            keeps = loaded(phase) & loaded(after)
            rows = mode_rows(ContactModes(after, friction._replace(active=keeps)))
        state = packed(at)
        # `error_only_rows` stay as they are
        state = jnp.concatenate([state, y[len(state) :]])
        return rows[:, None].astype(modes.dtype), state

    def switched_phases(
        self, phase: Int[Array, " m"], at: State, which: Bool[Array, "margins 1"]
    ) -> tuple[Int[Array, " m"], State]:
        """Phases after the events `which`, and the state: x = 0 where a contact closed
        or opened, impulses 0 where it closed.
        """
        m = len(phase)
        by_x = which[:m, 0]
        by_g = which[m : 2 * m, 0]
        closed = by_x & (phase == Phase.OPEN)
        if self.force.slackens:
            slackens = by_x & (phase == Phase.COMPRESSION)
            after = jnp.where(slackens, Phase.SLACK, phase)
            tightens = by_x & (phase == Phase.SLACK)
            after = jnp.where(tightens, Phase.COMPRESSION, after)
            opened = by_g
        else:
            turned = by_g & (phase == Phase.COMPRESSION)
            after = jnp.where(turned, Phase.EXPANSION, phase)
            returns = by_g & (phase == Phase.EXPANSION)
            after = jnp.where(returns, Phase.COMPRESSION, after)
            opened = by_x & (phase == Phase.EXPANSION)
            if self.force.bistiffness is not None:  # e = 0 returns nothing
                opened = opened | (turned & (self.force.bistiffness.restitution == 0))
        otherwise = jnp.where(closed, Phase.COMPRESSION, after)
        after = jnp.where(opened, Phase.OPEN, otherwise)
        x = at.contact[:1]
        impulses = at.contact[1:]
        indentation = jnp.where(opened | closed, 0.0, x)
        kept_impulses = jnp.where(closed, 0.0, impulses)
        contact = jnp.concatenate([indentation, kept_impulses])
        return after, at._replace(contact=contact)

    def begins(
        self, before: Int[Array, "k 1"], after: Int[Array, "k 1"]
    ) -> Bool[Array, "1 1"]:
        """True where the force of a contact sets in: it was open or slack, and is
        compressed.
        """
        before, after = (self.constants(x).phase[:, None] for x in (before, after))
        free = (before == Phase.OPEN) | (before == Phase.SLACK)
        return any_of((after == Phase.COMPRESSION) & free)

    def projected(
        self, const: ContactModes, at: State
    ) -> tuple[State, Bool[Array, " none"]]:
        """State without slip of contacts that stick, see `without_slip`; no normal
        jumps here.
        """
        if self.mu is None:
            new = at
        else:
            new = self.without_slip(const.friction, at)
        return new, jnp.zeros(0, bool)

    def stopped(self, which: Bool[Array, " m"], at: State) -> State:
        """State without slip of these contacts, see `without_slip`."""
        one = jnp.ones_like(at.contact_work[0])
        return self.without_slip(Modes(which, which, one), at, straight=False)

    def without_slip(self, modes: Modes, at: State, straight: bool = True) -> State:
        """State in which contacts that stick have slip 0: `v += M^-1 H p`, the least
        change by M.

        Where `straight`, slip across its direction is set to 0, too, of contacts whose
        slip begins or ends in this step.
        """
        contacts = self.contacts(at)
        known = with_normal_forces(contacts, jnp.zeros_like(contacts.normal.rate))
        assert known.tangent is not None
        zero = jnp.zeros_like(contacts.normal.rate)
        rates = jnp.concatenate([zero, known.tangent.rate])
        if straight and self.axes is not None:
            modes = straightened(self.axes, modes, known.tangent.rate)
        if straight:
            acts = modes.stick | (modes.sign == BEGINS)
        else:
            acts = modes.stick
        held = modes._replace(active=modes.active & acts)
        p = constraint_impulse(known, self.mu, held, rates)
        return at._replace(v=at.v + contacts.moved @ p)


def loaded(phase: Int[Array, "*m"]) -> Bool[Array, "*m"]:
    """True where the force of a contact acts: in compression and expansion."""
    return (phase == Phase.COMPRESSION) | (phase == Phase.EXPANSION)


def normal_forces(
    force: Force, phase: Int[Array, " m"], contacts: Contacts, at: State
) -> Float[Array, " m"]:
    """Normal forces F(x, -f') >= 0 [N] of the loaded contacts, 0 of others."""
    x = at.contact[0]
    inside = jnp.where(x >= 0, x, 0.0)
    push = force.force(inside, -contacts.normal.rate)
    pressing = jnp.maximum(push, 0.0)
    return jnp.where(loaded(phase), pressing, 0.0)


def contact_modes(modes: Int[Array, "k 1"], like: State) -> ContactModes:
    """Phases and modes of friction from their rows: phase (m), with friction stick,
    sign (3 m).
    """
    m = like.contact_work.shape[1]
    phase = modes[:m, 0]
    none = no_modes(m, like.q.dtype)
    if len(modes) == m:
        return ContactModes(phase, none)
    stick, sign = modes[m:, 0].reshape(2, -1)
    acts = loaded(phase) & ((stick > 0) | (sign != 0))
    direction_of_slip = sign.astype(none.sign.dtype)
    return ContactModes(phase, Modes(acts, stick > 0, direction_of_slip))


def mode_rows(now: ContactModes) -> Int[Array, " rows"]:
    """Rows (3 m) of phases and of friction: phase, stick, sign; both 0 where no
    friction acts.
    """
    stick_and_sign = now.friction[1:]
    friction = jnp.stack([x.astype(jnp.int32) for x in stick_and_sign])
    friction = jnp.where(now.friction.active, friction, 0)
    phase = now.phase.astype(jnp.int32)
    return jnp.concatenate([phase, *friction])


def compliant_flow(
    problem: MotionProblem,
    at: State,
    modes: Int[Array, "k 1"],
    fastest: Float[Array, " s"],
) -> CompliantFlow:
    """Flow from this state on; `fastest`: largest approach, then slip, of each contact
    [m/s].

    Roundings of margins: SNAP of the tolerance, or velocities that arise within the
    rounding of time; of friction a share of the largest force or slip.
    """
    system = problem.system
    force = problem.law
    mu = problem.mu
    settings = problem.settings
    times = problem.times
    m = problem.contacts
    rubs = mu is not None
    contacts = contacts_at(system, at.q, at.v, at.t, rubs)
    scales = contact_scales(force, contacts, fastest)
    axes = None
    by_depth = jnp.full(m, SNAP * settings.rtol, at.q.dtype)
    noise = velocity_noise(settings, jnp.max(jnp.abs(contacts.approach)))
    by_speed = jnp.maximum(by_depth, noise / scales.speed)
    rounding = jnp.concatenate([by_depth, by_speed])
    if mu is not None:
        phase, now = contact_modes(modes, at)  # now: modes of friction
        push = normal_forces(force, phase, contacts, at)
        known = with_normal_forces(contacts, push)
        if settings.spatial:
            axes = slip_axes(known, mu, now, scales.slip)
        largest = friction_acceleration(known, mu, jnp.maximum(scales.force, push))
        by_slip = now.active & ~now.stick
        rest = rest_acceleration(at.q.dtype)
        of_slip = jnp.maximum(rest * scales.slip, noise)
        friction = jnp.where(by_slip, of_slip, rest * largest)
        rounding = jnp.concatenate([rounding, friction])
    rounded = roundings(rounding, times)
    longest = longest_step(system, times)
    longest = jnp.minimum(longest, stable_step(force, modes, contacts, at))
    rows = len(packed(at))
    blank = jnp.zeros((rows, 1), at.q.dtype)
    return CompliantFlow(
        system=system,
        rounding=rounded,
        sample=times[0],
        rtol=settings.rtol,
        sizes=blank,
        like=at,
        longest=longest,
        mu=mu,
        axes=axes,
        force=force,
        scales=scales,
    )


def stiffness_of(
    force: Force, x: Float[Array, " m"], rate: Float[Array, " m"]
) -> Float[Array, " m"]:
    """dF/dx [N/m] of each contact at the indentation x >= 0 and its rate."""
    one = jnp.ones_like(x)
    _, stiffness = jax.jvp(lambda x: force.force(x, rate), (x,), (one,))
    return stiffness


def stable_step(
    force: Force, modes: Int[Array, "k 1"], contacts: Contacts, at: State
) -> Float[Array, ""]:
    """Longest stable step [s] with the stiffness dF/dx and damping dF/dx' of loaded
    contacts.

    Equation: `STABLE / max(omega, delta)`, bounds by row sums of |W|:
    `omega^2 = max_i sum_j |W_ij| dF_j/dx`, `delta = max_i sum_j |W_ij| dF_j/dx'`.
    """
    x = at.contact[0]
    rate = -contacts.normal.rate
    m = len(at.contact[0])
    phase = modes[:m, 0]
    x = jnp.where(x >= 0, x, 0.0)
    stiffness = stiffness_of(force, x, rate)
    one = jnp.ones_like(x)
    _, damping = jax.jvp(lambda rate: force.force(x, rate), (rate,), (one,))
    steep = unloading(force, phase, stiffness)
    both = jnp.stack([steep, damping], axis=1)
    both = jnp.where(loaded(phase)[:, None], both, 0.0)
    w = jnp.abs(contacts.delassus[:m, :m])
    square, rate = jnp.max(w @ jnp.abs(both), axis=0)
    frequency = jnp.sqrt(square)
    fastest = jax.lax.stop_gradient(jnp.maximum(frequency, rate))
    return quotient(STABLE, fastest, where=fastest > 0, otherwise=jnp.inf)


def unloading(
    force: Force, phase: Int[Array, " m"], rate: Float[Array, " m"]
) -> Float[Array, " m"]:
    """`rate` in compression, `rate / e^2` in plastic expansion: of the indentation or
    stiffness.

    e is the coefficient of the bistiffness, by which unloading is stiffer.
    """
    if force.bistiffness is None:
        return rate
    restitution = force.bistiffness.restitution
    e = jnp.where(restitution > 0, restitution, 1.0)
    return jnp.where(phase == Phase.EXPANSION, rate / e**2, rate)
