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
    gamma = contacts.normal.rate
    m = len(gamma)
    w = jnp.diagonal(contacts.delassus)[:m]
    slip = jnp.maximum(jnp.max(fastest), SLOWEST)
    speed = jnp.maximum(fastest[:m], SLOWEST)
    energy = 0.5 * speed**2 / w
    depth = force.indentation_scale(energy)
    no_rate = jnp.zeros_like(depth)
    push = force.force(depth, no_rate)
    onset = force.onset_scale(depth, speed)
    impulse = speed / w
    scales = ContactScales(speed, depth, push, onset, impulse, slip)
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

    def contact_forces(
        self, const: ContactModes, state: State
    ) -> tuple[Contacts, Forces]:
        """Contact space with the normal forces F of the law, and all forces.

        Tangential ones keep the modes of friction, `M v' = (loads) + N F + H lambda_t`;
        without friction there are none.
        """
        contacts = self.contacts(state)
        phase, friction = const
        push = normal_forces(self.force, phase, contacts, state)
        mu = self.mu
        if mu is None:
            acceleration = contacts.free + contacts.moved @ push
            return contacts, Forces(push, None, acceleration)
        known = with_normal_forces(contacts, push)
        slip = self.slip(friction, known)
        return known, forces(known, mu, friction, slip)

    def field(
        self, const: ContactModes, modes: Int[Array, "k 1"], y: Float[Array, "some 1"]
    ) -> Float[Array, "rows 1"]:
        """Rates of q, v, t, of the works, and of each contact: indentation, impulses.

        Equation: as of the class; powers `F . v` of loads, `lambda_n f'` and
        `lambda_t . u` of contacts; `x' = -f'`, p' = lambda.
        """
        state = unpacked(self.like, y)
        contacts, force = self.contact_forces(const, state)
        gamma = contacts.normal.rate
        push = force.normal
        system = self.system
        closing = unloading(self.force, const.phase, -gamma)
        friction, base = contact_powers(system, contacts, force, state.t)
        remembered = [closing, push]
        if force.tangential is not None:
            along = self.along_tangents(force.tangential)
            tangential = by_contact(along, len(push))
            remembered.extend(tangential.T)
        rates = State(
            q=system.body.rates(state.q, state.v),
            v=force.acceleration,
            t=jnp.ones_like(state.t),
            work=user_force(system, state.q, state.v, state.t) @ state.v,
            base_work=base,
            contact_work=jnp.stack([push * gamma, friction]),
            contact=jnp.stack(remembered),
            spring=self.spring_rates(const, state, contacts, force),
        )
        rows = self.rows_of(rates, state, const.friction, contacts, force)
        return jnp.concatenate(rows)

    def spring_rates(
        self, const: ContactModes, state: State, contacts: Contacts, force: Forces
    ) -> Float[Array, "b m"] | tuple[()]:
        """Rates of tangential springs: none, as contacts stick rigidly."""
        return ()

    def sizes_of_springs(self, state: State) -> list[Float[Array, " m"]]:
        """Sizes of the rows of tangential springs, of which steps may err by `rtol`:
        none.
        """
        return []

    def along_tangents(self, tangential: Float[Array, " t"]) -> Float[Array, " t"]:
        """Tangential forces along the tangents of the body, from those along `axes`."""
        if self.axes is None:
            return tangential
        along = self.axes.along
        by_axes = by_contact(tangential, len(along))
        frames = slip_frames(along)
        by_tangents = jnp.einsum("mj,mjk->mk", by_axes, frames)
        return by_tangents.reshape(-1)

    def margins(
        self, const: ContactModes, modes: Int[Array, "k 1"], y: Float[Array, "some 1"]
    ) -> Float[Array, "margins 1"]:
        """Margins that are >= 0 while all contacts keep their modes, in `const`: those
        of normals, with friction those of tangents, and that of the next sample.
        """
        state = unpacked(self.like, y)
        x = state.contact[0]
        phase, friction = const
        mu = self.mu
        if mu is None:
            normal, _ = kinematics(self.system, state.q, state.v, state.t)
            margins = self._normal_margins(phase, normal.rate, x)
            return self.with_margin_of_sample(margins, state)
        contacts, force = self.contact_forces(const, state)
        gamma = contacts.normal.rate
        by_normal = self._normal_margins(phase, gamma, x)
        zero = jnp.zeros_like(state.t)
        by_friction = friction_margins(
            contacts,
            mu,
            friction,
            force,
            lasts=zero + 1,
            slack=zero,
            speed_scale=self.scales.slip,
        )
        margins = jnp.concatenate([by_normal, by_friction])
        return self.with_margin_of_sample(margins, state)

    def _normal_margins(
        self, phases: Int[Array, " m"], rate: Float[Array, " m"], x: Float[Array, " m"]
    ) -> Float[Array, " 2*m"]:
        """Margins that are >= 0 while contacts keep their phases: m by the indentation
        x [m], then m by the gap velocity f' [m/s], `rate`.

        | phase | by x | by gap velocity |
        |---|---|---|
        | open | -x: the gap closes | 1 |
        | compression | 1 | -f': it turns to expansion |
        | expansion | x: it opens | f': it is compressed again |

        With a force that may vanish at x > 0 (`slackens`), which has compression and,
        in the place of expansion, slack:

        | phase | by x | by gap velocity |
        |---|---|---|
        | compression | `Force.onset`: it slackens | x: it opens |
        | slack | -`Force.onset`: it presses again | x: it opens |

        All are in units of the scales.
        """
        scales = self.scales
        gamma = rate / scales.speed
        depth = x / scales.depth
        compressed = phases == Phase.COMPRESSION
        if self.force.slackens:
            inside = jnp.where(x >= 0, x, 0.0)
            left = self.force.onset(inside, -rate)
            onset = left / scales.onset
            by_x = jnp.where(compressed, onset, -onset)
            by_g = depth
        else:
            expands = phases == Phase.EXPANSION
            by_x = jnp.where(expands, depth, 1.0)
            by_g = jnp.where(compressed, -gamma, gamma)
        is_open = phases == Phase.OPEN
        by_x = jnp.where(is_open, -depth, by_x)
        by_rate = jnp.where(is_open, 1.0, by_g)
        return jnp.concatenate([by_x, by_rate])

    def rooted(self, modes: Int[Array, "k 1"]) -> Bool[Array, "margins 1"]:
        """True for margins of opening: landings on them step in the root of the
        indentation.
        """
        constants = self.constants(modes)
        phase = constants.phase[:, None]
        opens = phase == Phase.EXPANSION
        compressed = phase == Phase.COMPRESSION
        by_g = compressed & self.force.slackens
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
        state = unpacked(self.like, y)
        phase, friction = self.constants(modes)
        after, state = self.switched_phases(phase, state, which)
        rows = after
        if self.mu is not None:  # friction starts anew with the force
            stays_loaded = loaded(phase) & loaded(after)
            friction = friction._replace(active=stays_loaded)
            new = ContactModes(after, friction)
            rows = mode_rows(new)
        of_state = packed(state)
        error_only = y[len(of_state) :]  # these rows stay as they are
        new_y = jnp.concatenate([of_state, error_only])
        new_modes = rows[:, None]
        return new_modes.astype(modes.dtype), new_y

    def switched_phases(
        self, phase: Int[Array, " m"], state: State, which: Bool[Array, "margins 1"]
    ) -> tuple[Int[Array, " m"], State]:
        """Phases after the events `which`, and the state: x = 0 where a contact closed
        or opened, impulses 0 where it closed.

        With a force that `slackens` compression turns to slack and back by x, and the
        contact opens by its gap velocity. Else compression turns to expansion and back
        by the gap velocity, and the contact opens by x, or, if e = 0, where it would
        expand.
        """
        m = len(phase)
        by_x = which[:m, 0]
        by_g = which[m : 2 * m, 0]
        was_open = phase == Phase.OPEN
        compressed = phase == Phase.COMPRESSION
        closed = by_x & was_open
        if self.force.slackens:
            is_slack = phase == Phase.SLACK
            slackens = by_x & compressed
            tightens = by_x & is_slack
            after = jnp.where(slackens, Phase.SLACK, phase)
            after = jnp.where(tightens, Phase.COMPRESSION, after)
            opened = by_g
        else:
            expands = phase == Phase.EXPANSION
            turned = by_g & compressed
            returns = by_g & expands
            after = jnp.where(turned, Phase.EXPANSION, phase)
            after = jnp.where(returns, Phase.COMPRESSION, after)
            opened = by_x & expands
            plastic = self.force.bistiffness
            if plastic is not None:
                returns_nothing = plastic.restitution == 0
                opened = opened | (turned & returns_nothing)
        otherwise = jnp.where(closed, Phase.COMPRESSION, after)
        after = jnp.where(opened, Phase.OPEN, otherwise)
        x = state.contact[:1]
        impulses = state.contact[1:]
        changed = opened | closed
        indentation = jnp.where(changed, 0.0, x)
        from_now = jnp.where(closed, 0.0, impulses)
        contact = jnp.concatenate([indentation, from_now])
        new = state._replace(contact=contact)
        return after, new

    def begins(
        self, old: Int[Array, "k 1"], new: Int[Array, "k 1"]
    ) -> Bool[Array, "1 1"]:
        """True where the force of a contact sets in: it was open or slack, and is
        compressed.
        """
        constants = self.constants(old)
        old_phase = constants.phase[:, None]
        constants = self.constants(new)
        new_phase = constants.phase[:, None]
        was_open = old_phase == Phase.OPEN
        was_slack = old_phase == Phase.SLACK
        free = was_open | was_slack
        compressed = new_phase == Phase.COMPRESSION
        return any_of(compressed & free)

    def projected(
        self, const: ContactModes, state: State
    ) -> tuple[State, Bool[Array, " none"]]:
        """State without slip of contacts that stick, see `without_slip`, as it is
        without friction; no normal jumps here.
        """
        none = jnp.zeros(0, bool)
        if self.mu is None:
            return state, none
        return self.without_slip(const.friction, state), none

    def stopped(self, which: Bool[Array, " m"], state: State) -> State:
        """State without slip of these contacts, see `without_slip`."""
        one = jnp.ones_like(state.contact_work[0])
        sticking = Modes(which, which, one)
        return self.without_slip(sticking, state, straight=False)

    def without_slip(self, modes: Modes, state: State, straight: bool = True) -> State:
        """State in which contacts that stick have slip 0: `v += M^-1 H p`, the least
        change by M.

        Where `straight`, slip across its direction is set to 0, too, of contacts whose
        slip begins or ends in this step.
        """
        contacts = self.contacts(state)
        zero = jnp.zeros_like(contacts.normal.rate)
        known = with_normal_forces(contacts, zero)
        assert known.tangent is not None
        slip = known.tangent.rate
        rates = jnp.concatenate([zero, slip])
        held = modes.stick
        if straight:
            if self.axes is not None:
                modes = straightened(self.axes, modes, slip)
            begins = modes.sign == BEGINS
            held = modes.stick | begins
        active = modes.active & held
        holding = modes._replace(active=active)
        p = constraint_impulse(known, self.mu, holding, rates)
        v = state.v + contacts.moved @ p
        return state._replace(v=v)


def loaded(phase: Int[Array, "*m"]) -> Bool[Array, "*m"]:
    """True where the force of a contact acts: in compression and expansion."""
    compressed = phase == Phase.COMPRESSION
    expands = phase == Phase.EXPANSION
    return compressed | expands


def normal_forces(
    force: Force, phase: Int[Array, " m"], contacts: Contacts, state: State
) -> Float[Array, " m"]:
    """Normal forces F(x, -f') >= 0 [N] of the loaded contacts, 0 of others."""
    x = state.contact[0]
    inside = jnp.where(x >= 0, x, 0.0)
    closing = -contacts.normal.rate
    push = force.force(inside, closing)
    pressing = jnp.maximum(push, 0.0)
    acts = loaded(phase)
    return jnp.where(acts, pressing, 0.0)


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
    sticks = stick > 0
    slides = sign != 0
    acts = loaded(phase) & (sticks | slides)
    direction_of_slip = sign.astype(none.sign.dtype)
    friction = Modes(acts, sticks, direction_of_slip)
    return ContactModes(phase, friction)


def mode_rows(now: ContactModes) -> Int[Array, " rows"]:
    """Rows (3 m) of phases and of friction: phase, stick, sign; both 0 where no
    friction acts.
    """
    friction = now.friction
    stick = jnp.int32(friction.stick)
    sign = jnp.int32(friction.sign)
    both = jnp.stack([stick, sign])
    acting = jnp.where(friction.active, both, 0)
    phase = jnp.int32(now.phase)
    return jnp.concatenate([phase, *acting])


def compliant_flow(
    problem: MotionProblem,
    state: State,
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
    contacts = contacts_at(system, state.q, state.v, state.t, rubs)
    scales = contact_scales(force, contacts, fastest)
    axes = None
    dtype = state.q.dtype
    snap = SNAP * settings.rtol
    by_depth = jnp.full(m, snap, dtype)
    largest = jnp.max(jnp.abs(contacts.approach))
    noise = velocity_noise(settings, largest)
    noise_of_rate = noise / scales.speed
    by_speed = jnp.maximum(by_depth, noise_of_rate)
    rounding = jnp.concatenate([by_depth, by_speed])
    if mu is not None:
        phase, friction = contact_modes(modes, state)
        push = normal_forces(force, phase, contacts, state)
        known = with_normal_forces(contacts, push)
        if settings.spatial:
            axes = slip_axes(known, mu, friction, scales.slip)
        largest_push = jnp.maximum(scales.force, push)
        largest = friction_acceleration(known, mu, largest_push)
        by_slip = friction.active & ~friction.stick
        share = rest_acceleration(dtype)
        of_cone = share * largest
        of_slip = jnp.maximum(share * scales.slip, noise)
        of_friction = jnp.where(by_slip, of_slip, of_cone)
        rounding = jnp.concatenate([rounding, of_friction])
    rounded = roundings(rounding, times)
    stable = stable_step(force, modes, contacts, state)
    longest = jnp.minimum(longest_step(system, times), stable)
    rows = len(packed(state))
    blank = jnp.zeros((rows, 1), dtype)
    return CompliantFlow(
        system=system,
        rounding=rounded,
        sample=times[0],
        rtol=settings.rtol,
        sizes=blank,
        like=state,
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

    def push(x: Float[Array, " m"]) -> Float[Array, " m"]:
        """F [N] at this indentation."""
        return force.force(x, rate)

    _, stiffness = jax.jvp(push, (x,), (one,))
    return stiffness


def stable_step(
    force: Force, modes: Int[Array, "k 1"], contacts: Contacts, state: State
) -> Float[Array, ""]:
    """Longest stable step [s] with the stiffness dF/dx and damping dF/dx' of loaded
    contacts.

    Equation: `STABLE / max(omega, delta)`, bounds by row sums of |W|:
    `omega^2 = max_i sum_j |W_ij| dF_j/dx`, `delta = max_i sum_j |W_ij| dF_j/dx'`.
    """
    indentation = state.contact[0]
    rate = -contacts.normal.rate
    m = len(indentation)
    phase = modes[:m, 0]
    inside = indentation >= 0
    x = jnp.where(inside, indentation, 0.0)
    stiffness = stiffness_of(force, x, rate)
    one = jnp.ones_like(x)

    def push(rate: Float[Array, " m"]) -> Float[Array, " m"]:
        """F [N] at this rate of indentation."""
        return force.force(x, rate)

    _, damping = jax.jvp(push, (rate,), (one,))
    steep = unloading(force, phase, stiffness)
    slopes = jnp.stack([steep, damping], axis=1)
    acts = loaded(phase)[:, None]
    acting = jnp.where(acts, slopes, 0.0)
    w = jnp.abs(contacts.delassus[:m, :m])
    row_sums = w @ jnp.abs(acting)
    square, delta = jnp.max(row_sums, axis=0)
    omega = jnp.sqrt(square)
    fastest = jax.lax.stop_gradient(jnp.maximum(omega, delta))
    moves = fastest > 0
    return quotient(STABLE, fastest, where=moves, otherwise=jnp.inf)


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
    returns = restitution > 0
    e = jnp.where(returns, restitution, 1.0)
    expands = phase == Phase.EXPANSION
    return jnp.where(expands, rate / e**2, rate)
