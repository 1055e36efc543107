"""Contacts with Coulomb friction: the flow of `contact_flow.py` with slip, planar.

    p' = F,   u' = K_tn F + K_tt lambda,   gamma' = G F + K_nt lambda,
    slip:   lambda_j = -mu_j F_j u_j / |u_j|
    stick:  lambda such that u_j' = 0, while |lambda_j| <= mu_j F_j

Which contacts slip and which stick is frozen in the modes (rows: phase, closings, slip:
0 sticks, else the sign of u). Margins of friction are the speed of slip and the
distance to the friction cone. The normal forces follow from the indentations, so that
lambda exists and u' is unique whatever mu is: there is no Painleve paradox. Where K_tt
is singular (both corners of a block lying flat) lambda is shared among the contacts
that stick in proportion to mu F: they then break loose together.

A single contact is not integrated. Against its normal impulse p gap velocity and slip
are straight lines, with one kink where slip stops, and the work of the force is a sum
of parabolas (`_next_piece`; E. J. Routh, Dynamics of a System of Rigid Bodies, 1897,
here with energetic restitution).
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jimpact.events.contact_flow import (
    DRAGGING,
    SNAP,
    ContactFlow,
    ContactStates,
    Frozen,
    Phase,
    as_pytree,
    plus_one,
    power,
)
from jimpact.numerics.dense import (
    load_shares,
    regularized,
    regularized_once,
    times,
    unit,
)
from jimpact.numerics.friction import distribute
from jimpact.numerics.stepper import any_of
from jimpact.tools.loops import fori_loop
from jimpact.tools.precision import precision

# part of the unit of time. At the first touch forces are 0 and cannot decide which
# contacts stick: those of a moment later do. Ten times more would decide by later
# forces.
MOMENT = 1e-6
# Pieces of a single contact's impact, at most: it expands, is compressed, its slip
# stops, it turns. Ten times more would change nothing.
PIECES = 4
# of the tolerance: the impact is over where no contact has more energy, loaded ones
# included. Ten times more is the energy of one tolerance of velocity, which would be
# lost.
LEFT = 0.1


def ridge(dtype: Any) -> float:
    """Weight of sum lambda^2 / (mu F), which forces of sticking minimize, added to
    K_tt.

    It matters only where K_tt is singular. A refinement removes its effect elsewhere,
    so that errors are least at the square root of the machine epsilon.
    """
    return precision(dtype).root


class FrictionConstants(NamedTuple):
    """Factors of the field that do not change while the modes last."""

    frozen: Frozen
    stick: Bool[Array, "m B"]  # (m, B)
    drag: Float[Array, "m B"]  # lambda / F of those that slide
    pull: Float[Array, "m m B"]  # u' = pull F without sticking forces
    tangent: Float[Array, "m m B"]  # K_tt of those that stick
    ridge: Float[Array, "m B"]  # added to the diagonal of K_tt


class FrictionForces(NamedTuple):
    """Forces, rates of slip and margins of sticking."""

    normal: Float[Array, "m B"]  # F
    side: Float[Array, "m B"]  # lambda
    rate: Float[Array, "m B"]  # u'
    # in the cone, of those that stick: 0 on it, 1 without lambda
    room: Float[Array, "m B"]


class Cycle(NamedTuple):
    """A state to which an impact may return, and what is left once it has."""

    modes: Int[Array, "modes B"]  # at that state
    passes: Float[Array, "1 B"]  # until it; 0: there is none
    gamma: Float[Array, "m B"]
    root: Float[Array, "m B"]  # of twice the energy stored
    slip: Float[Array, "m B"]
    impulse: Float[Array, "m B"]  # p, and after the return what is left of it
    side: Float[Array, "m B"]  # q, and after the return what is left of it
    wedged: Bool[Array, "m B"]  # contacts that end with gamma = 0
    stops: Bool[Array, "m B"]  # those of them that end with u = 0

    @classmethod
    def none(cls, gamma: Float[Array, "m B"], modes: Int[Array, "modes B"]) -> "Cycle":
        """The cycle before the first state is kept."""
        zero = jnp.zeros_like(gamma)
        no = jnp.zeros(gamma.shape, bool)
        return cls(modes, zero[:1], zero, zero, zero, zero, zero, no, no)


@as_pytree
@dataclasses.dataclass(kw_only=True)
class FrictionFlow(ContactFlow):
    """The motion of m contacts with planar friction, t = m."""

    normal_tangent: Float[Array, "m t B"]  # K_nt
    tangent: Float[Array, "t t B"]  # K_tt
    friction: Float[Array, "m B"]  # mu

    # ---- the state: x, g, p, slip u, its impulse, time

    @property
    def driving(self) -> tuple[int, ...]:
        """Sizes of the blocks x, g, p and slip."""
        m = self.contacts
        return m, m, m, self.normal_tangent.shape[1]

    @property
    def adding(self) -> tuple[int, ...]:
        """Sizes of the blocks of the tangential impulse and of time."""
        return self.normal_tangent.shape[1], 1

    def slip(self, y: Float[Array, "driving B"]) -> Float[Array, "m B"]:
        """Slip u of a state."""
        m = self.contacts
        return y[3 * m : 4 * m]

    def side_impulse(self, y: Float[Array, "n B"]) -> Float[Array, "t B"]:
        """Tangential impulse of a state, its last rows but the time."""
        t = self.normal_tangent.shape[1]
        return y[-1 - t : -1]

    def start_with(
        self, gamma: Float[Array, "m B"], x: Float[Array, "m B"], u: Float[Array, "t B"]
    ) -> tuple[Int[Array, "modes B"], Float[Array, "n B"]]:
        """Modes and state before the impact, from gamma, indentations x and slip u."""
        m = self.contacts
        modes, y = self.start(gamma, x)
        modes = jnp.concatenate([modes, jnp.sign(u).astype(jnp.int32)])
        y = jnp.concatenate([y[: 3 * m], u, jnp.zeros_like(u), y[3 * m :]])
        closed = modes[:m] != Phase.OPEN
        return self.decided(modes, y, jnp.zeros_like(closed), closed)

    # ---- the protocol

    def allowance(
        self, modes: Int[Array, "modes B"], y: Float[Array, "n B"]
    ) -> Float[Array, "n #B"] | float:
        """Allowed error of each row, in tolerances: more of p_t, rounding / weight
        (`ridge`).

        The sharing of tangential forces is no more accurate. It changes no velocity,
        and all else of lambda is linear in F while the modes last.
        """
        m = self.contacts
        shares = (np.arange(len(y)) // m == 4)[:, None]
        return jnp.where(shares, jnp.maximum(ridge(y.dtype) / self.tolerance, 1.0), 1.0)

    def loaded(self, modes: Int[Array, "modes B"]) -> Bool[Array, "m B"]:
        """Mask of the contacts in compression or expansion."""
        phase = modes[: self.contacts]
        return (phase == Phase.COMPRESSION) | (phase == Phase.EXPANSION)

    def constants(self, modes: Int[Array, "modes B"]) -> Any:
        """Factors of the normal field and of friction: who sticks, lambda / F of the
        others.
        """
        m = self.contacts
        slip = modes[2 * m :]
        stick = (slip == 0) & self.loaded(modes)
        drag = -slip.astype(self.friction.dtype) * self.friction
        k = jnp.where(stick[:, None] & stick[None], self.tangent, 0.0)
        return FrictionConstants(
            frozen=self.normal_constants(modes),
            stick=stick,
            drag=drag,
            pull=jnp.swapaxes(self.normal_tangent, 0, 1) + self.tangent * drag[None],
            tangent=k,
            ridge=jnp.where(stick, self.ridges(), 1.0),
        )

    def ridges(self) -> Float[Array, "m B"]:
        """`ridge sqrt(K_tt jj)`: forces of contacts that move alike are then in
        proportion to mu F.

        Each contact has units of its own (`dimensionless`), in which the rows of K_tt
        of such contacts are multiples of each other.
        """
        rows = np.arange(self.contacts)
        own = self.tangent[rows, rows]
        movable = own > 0
        return ridge(own.dtype) * jnp.where(
            movable, jnp.sqrt(jnp.where(movable, own, 1.0)), 1.0
        )

    def forces(
        self, const: FrictionConstants, y: Float[Array, "driving B"]
    ) -> FrictionForces:
        """Forces F and lambda in a state, rates u' of slip, and margins of sticking.

        Sliding: `lambda = drag F`; sticking: `K_tt lambda = -pull F` for them, shared
        in proportion to mu F where K_tt is singular.
        """
        x, g, _ = self.rows(y)
        f = self.force(const.frozen, x, g)
        most = self.friction * f
        pull = times(const.pull, f)
        largest = jax.lax.stop_gradient(jnp.max(most, axis=0, keepdims=True))
        weight = load_shares(most)
        right = jnp.where(const.stick, -pull, 0.0)
        held = regularized_once(const.tangent * weight[None], const.ridge, right)
        hold = weight * held
        size = jnp.abs(held)
        # in parts of the force: those of a contact that opens vanish together
        some = const.stick & (largest + size > 0)
        room = jnp.where(
            some, (largest - size) / jnp.where(some, largest + size, 1.0), 1.0
        )
        rate = jnp.where(const.stick, 0.0, pull + times(self.tangent, hold))
        return FrictionForces(f, const.drag * f + hold, rate, room)

    def field(
        self, const: Any, modes: Int[Array, "modes B"], y: Float[Array, "driving B"]
    ) -> Float[Array, "n B"]:
        """Rates of x, g, p, slip, its impulse and time:
        `g' = ratio (G F + K_nt lambda)`.
        """
        frozen = const.frozen
        forces = self.forces(const, y)
        pull = self.coupling.times(forces.normal) + times(
            self.normal_tangent, forces.side
        )
        return jnp.concatenate(
            [
                frozen.closing * self.rows(y)[1],
                frozen.ratio * pull,
                frozen.unit * forces.normal,
                frozen.unit * forces.rate,
                frozen.unit * forces.side,
                frozen.unit,
            ]
        )

    def margins(
        self, const: Any, modes: Int[Array, "modes B"], y: Float[Array, "driving B"]
    ) -> Float[Array, "k B"]:
        """Margins of the normal flow, speeds of slip, distances to the friction cones
        (m each).
        """
        m = self.contacts
        slides = (modes[2 * m :] != 0) & self.loaded(modes)
        return jnp.concatenate(
            [
                self.normal_margins(const.frozen, modes, y),
                jnp.where(slides, modes[2 * m :].astype(y.dtype) * self.slip(y), 1.0),
                self.forces(const, y).room,
            ]
        )

    def rooted(self, modes: Int[Array, "modes B"]) -> Bool[Array, "k B"]:
        """Mask of the openings, as in the normal flow; margins of friction have no
        root.
        """
        rooted = super().rooted(modes)
        return jnp.concatenate([rooted, jnp.zeros_like(rooted)])

    def switch(
        self,
        modes: Int[Array, "modes B"],
        y: Float[Array, "n B"],
        which: Bool[Array, "k B"],
    ) -> tuple[Int[Array, "modes B"], Float[Array, "n B"]]:
        """Modes and state after events: slip that stops and stick that breaks
        included.
        """
        m = self.contacts
        stopped = which[2 * m : 3 * m]
        broke = which[3 * m :]
        side = self.forces(self.constants(modes), y).side
        turned = jnp.where(broke, -jnp.sign(side).astype(modes.dtype), modes[2 * m :])
        after, y = self.normal_switch(modes, y, which[: 2 * m])
        after = jnp.concatenate([after[: 2 * m], turned])
        closed = after[m : 2 * m] > modes[m : 2 * m]
        return self.decided(after, y, stopped, closed)

    def decided(
        self,
        modes: Int[Array, "modes B"],
        y: Float[Array, "n B"],
        stopped: Bool[Array, "m B"],
        closed: Bool[Array, "m B"],
    ) -> tuple[Int[Array, "modes B"], Float[Array, "n B"]]:
        """Modes and state once it is decided which contacts stick, and where others
        slide to.

        `distribute` decides anew where slip has `stopped`, or a contact has `closed`
        without slip, from the forces of a moment later.
        """
        m = self.contacts
        u = self.slip(y)
        slip = modes[2 * m :]
        loaded = self.loaded(modes)
        rests = jnp.abs(u) <= SNAP * self.tolerance
        slip = jnp.where(closed & ~rests, jnp.sign(u).astype(slip.dtype), slip)
        resting = loaded & rests & ((slip != 0) | closed)
        check = any_of(stopped | (closed & resting))
        to_check = check & loaded & (stopped | resting | (slip == 0))
        constant, state = jax.lax.stop_gradient((self, y))
        f = constant.soon(modes, state)
        most = constant.friction * f
        # b = u' by normal forces and by the friction of contacts that slide on
        slides = jnp.where(to_check | ~loaded, 0.0, -slip.astype(u.dtype) * most)
        b = times(jnp.swapaxes(constant.normal_tangent, 0, 1), f) + times(
            constant.tangent, slides
        )
        stick, towards = distribute(constant.tangent, b, most, to_check)
        towards = jnp.where(stick, 0, jnp.sign(towards).astype(slip.dtype))
        slip = jnp.where(to_check, towards, slip)
        y = self._at_rest(modes, y, to_check, jnp.where(stick, most, 0.0))
        return jnp.concatenate([modes[: 2 * m], slip]), y

    def _at_rest(
        self,
        modes: Int[Array, "modes B"],
        y: Float[Array, "n B"],
        rests: Bool[Array, "m B"],
        most: Float[Array, "m B"],
    ) -> Float[Array, "n B"]:
        """The state with slips of 0 at contacts that rest; those with `most` = mu F > 0
        stick.

        Slips are nothing there, but their tangents are not: those of a contact that
        sticks are taken by a tangential impulse, of one that begins to slide they
        remain.
        """
        m = self.contacts
        x, g, p = self.rows(y)
        u = self.slip(y)
        weight = load_shares(most)
        holds = most > 0
        soft = jnp.where(holds, ridge(u.dtype), 1.0)
        right = jnp.where(holds, -u, 0.0)
        side = weight * regularized_once(self.tangent * weight[None], soft, right)
        g = g + self.as_rows(modes, times(self.normal_tangent, side))
        u = u + times(self.tangent, side)
        u = jnp.where(rests, u - jax.lax.stop_gradient(u), u)
        return jnp.concatenate([x, g, p, u, y[4 * m : 5 * m] + side, y[5 * m :]])

    def as_rows(
        self, modes: Int[Array, "modes B"], gamma: Float[Array, "m B"]
    ) -> Float[Array, "m B"]:
        """Changes of the rows g = gamma / s from those of gamma; 0 where s = e = 0."""
        scale = self.scales(modes)
        return jnp.where(scale > 0, gamma / jnp.where(scale > 0, scale, 1.0), 0.0)

    def soon(
        self, modes: Int[Array, "modes B"], y: Float[Array, "n B"]
    ) -> Float[Array, "m B"]:
        """Normal forces a MOMENT later, in parts of the largest."""
        const = self.normal_constants(modes)
        x, g, _ = self.rows(y)
        f = self.force(const, jnp.maximum(x + MOMENT * const.closing * g, 0.0), g)
        top = jnp.max(f, axis=0, keepdims=True)
        return f / jnp.where(top > 0, top, 1.0)

    def contact_states(
        self, modes: Int[Array, "modes B"], y: Float[Array, "n B"]
    ) -> ContactStates:
        """Forces, velocities and slip in a state."""
        m = self.contacts
        side = self.forces(self.constants(modes), y).side
        return (
            super()
            .contact_states(modes, y)
            ._replace(
                tangential_force=side,
                tangential_impulse=y[4 * m : 5 * m],
                slip=self.slip(y),
            )
        )

    def change(self, y: Float[Array, "n B"]) -> Float[Array, "m B"]:
        """Change `G p + K_nt p_t` of the gap velocities by the impulses of a state."""
        side = y[-1 - self.normal_tangent.shape[1] : -1]
        return super().change(y) + times(self.normal_tangent, side)

    # ---- the end

    @property
    def wedges(self) -> bool:
        """True if rigid contacts in the plane: a state multiplied by s then takes the
        same course, see `wedged_limit.py`.
        """
        planar = self.normal_tangent.shape[1] == self.contacts
        return planar and not self.gapped and self.viscous is None

    @property
    def self_similar(self) -> bool:
        """True if friction may wedge the contacts."""
        return self.wedges

    def first_cycle(
        self, gamma: Float[Array, "m B"], modes: Int[Array, "modes B"]
    ) -> Any:
        """The cycle before a state is kept; None where no contacts can be wedged."""
        return Cycle.none(gamma, modes) if self.wedges else None

    @property
    def looks_ahead(self) -> bool:
        """False: a look ahead knows no friction."""
        return False

    def pauses(
        self,
        before: Int[Array, "modes B"],
        after: Int[Array, "modes B"],
        passes: Float[Array, "1 B"],
    ) -> Bool[Array, "1 B"] | None:
        """Mask: after an event, where the impact drags on."""
        if not self.wedges:
            return None
        return any_of(before != after) & (passes > DRAGGING * self.taking_part)

    @property
    def at_once(self) -> bool:
        """True if there is one contact, and it is planar."""
        return super().at_once and self.normal_tangent.shape[1] == 1

    def over(
        self,
        modes: Int[Array, "modes B"],
        y: Float[Array, "n B"],
        passes: Float[Array, "1 B"],
    ) -> Bool[Array, "1 B"]:
        """Mask: no contact is loaded or approaches."""
        works, *_ = self.at_work(modes, y, LEFT * self.patience(passes))
        return ~any_of(works)

    def finish(
        self, modes: Int[Array, "modes B"], y: Float[Array, "n B"]
    ) -> tuple[Int[Array, "modes B"], Float[Array, "n B"]]:
        """Modes and state with indentations of 0, after the impulses of a single
        contact.
        """
        if self.at_once:
            return modes, self._after_one(modes, y)
        m = self.contacts
        return modes, jnp.concatenate([jnp.zeros_like(y[:m]), y[m:]])

    def settled(
        self, modes: Int[Array, "modes B"], y: Float[Array, "n B"], cycle: Cycle
    ) -> Float[Array, "n B"]:
        """The state in the limit of contacts that friction wedges: see `Cycle`.

        With the impulses P and Q that are left `gamma + G P + K_nt Q = 0` of these
        contacts, and `u + K_tn P + K_tt Q = 0` where slip stops, else
        `Q = -mu P sign(u)`; P = Q = 0 of others. Where contacts are redundant, P and Q
        are next to those of the series.
        """
        m = self.contacts
        _, g, p = self.rows(y)
        u = self.slip(y)
        gamma = self.scales(modes) * g
        across = self.normal_tangent
        back = jnp.swapaxes(across, 0, 1)
        coupling = self.coupling.dense(m)
        eye = unit(self.tangent)
        drag = -self.friction * jnp.sign(jax.lax.stop_gradient(u))
        # rows of P, then of Q; those of a contact that slides, or is not wedged: of Q -
        # r P
        wedged = cycle.wedged[:, None]
        stops = cycle.stops[:, None]
        rubs = jnp.where(wedged, -eye * drag[:, None], 0.0)
        normal = [jnp.where(wedged, coupling, eye), jnp.where(wedged, across, 0.0)]
        side = [jnp.where(stops, back, rubs), jnp.where(stops, self.tangent, eye)]
        rows = [jnp.concatenate(z, axis=1) for z in (normal, side)]
        matrix = jnp.concatenate(rows)
        right = [
            jnp.where(cycle.wedged, -gamma, 0.0),
            jnp.where(cycle.stops, -u, 0.0),
        ]
        left = jnp.concatenate([cycle.impulse, cycle.side])
        error = jnp.concatenate(right) - times(matrix, left)
        soft = jnp.full_like(left, ridge(u.dtype))
        left = left + regularized(matrix, error, soft, 1, without_null=True)
        dp = left[:m]
        dq = left[m:]
        g = g + self.as_rows(modes, times(coupling, dp) + times(across, dq))
        u = u + times(back, dp) + times(self.tangent, dq)
        none = jnp.zeros_like(g)
        total_side = self.side_impulse(y) + dq
        return jnp.concatenate([none, g, p + dp, u, total_side, y[5 * m :]])

    def _after_one(
        self, modes: Int[Array, "modes B"], y: Float[Array, "n B"]
    ) -> Float[Array, "n B"]:
        """The state after the impact of a single contact, in closed form.

        With its normal impulse p gamma grows at the rate `1 + K_nt r`, u at
        `K_nt + K_tt r`, where r = lambda / F: `drag` until slip stops, from then on
        `hold`, -K_nt / K_tt within the cone.
        """
        works, gamma, _ = self.at_work(modes, y, LEFT * self.tolerance)
        x, _, p = self.rows(y)
        u = self.slip(y)
        slip = modes[2:]
        # K_nt, K_tt, mu
        across = self.normal_tangent[0]
        own = self.tangent[0]
        mu = self.friction
        drag = -slip.astype(u.dtype) * mu
        movable = own > 0
        hold = jnp.where(movable, -across / jnp.where(movable, own, 1.0), 0.0)
        # or slip begins anew, to the other side
        hold = jnp.sign(hold) * jnp.minimum(jnp.abs(hold), mu)
        rate = across + own * drag
        stops = (slip != 0) & (u * rate < 0)
        length = jnp.where(stops, -u / jnp.where(stops, rate, 1.0), jnp.inf)
        length = jnp.where(slip == 0, 0.0, length)
        twice = jnp.where(x > 0, power(x, plus_one(self.exponent)), 0.0)
        slopes = 1 + across * drag, 1 + across * hold
        start = SingleContact(
            jnp.where(works, gamma, -1.0), twice, length, 0 * p, 0 * p
        )
        end = fori_loop(
            0, PIECES, lambda _, s: _next_piece(s, slopes, self.restitution), start
        )
        side = drag * end.sliding + hold * end.holding
        side = jnp.where(works, side, 0.0)
        dp = jnp.where(works, end.sliding + end.holding, 0.0)
        gamma = jnp.where(works, end.gap_velocity, gamma)
        rows = [
            jnp.zeros_like(x),
            gamma,
            p + dp,
            u + across * dp + own * side,
            y[4:5] + side,
        ]
        return jnp.concatenate([*rows, y[5:]])


class SingleContact(NamedTuple):
    """A single contact during its impact, and the normal impulses that it has
    carried.
    """

    gap_velocity: Float[Array, "1 B"]
    energy: Float[Array, "1 B"]  # twice what is stored; 0: it is unloaded
    left: Float[Array, "1 B"]  # impulse until slip stops
    sliding: Float[Array, "1 B"]  # impulse until then
    holding: Float[Array, "1 B"]  # impulse since then


def _next_piece(
    s: SingleContact,
    slopes: tuple[Float[Array, "1 B"], Float[Array, "1 B"]],
    e: Float[Array, "1 B"],
) -> SingleContact:
    """The contact after its slip stops, it turns, or is unloaded; as it is where it is
    unloaded.

    gamma grows with the impulse at the rates `slopes`, until slip stops and from then
    on. While it is compressed, energy grows as -gamma^2 / slope; while it expands, it
    falls e^-2 times as fast.
    """
    gamma = s.gap_velocity
    energy = s.energy
    slides = s.left > 0
    slope = jnp.where(slides, *slopes)
    most = jnp.where(slides, s.left, jnp.inf)
    closes = (gamma < 0) | ((gamma == 0) & (slope < 0))  # is compressed
    expands = ~closes & (energy > 0) & ((gamma > 0) | (slope > 0))
    # gamma reaches 0, and: the expansion starts from gamma = 0
    turns = closes & (slope > 0)
    rising = expands & (gamma == 0)
    some = jnp.where(expands, energy, 1.0)
    up = jnp.where(turns | rising, slope, 1.0)
    square = jnp.where(expands & ~rising, gamma**2 + e**2 * slope * energy, 1.0)
    back = square <= 0  # gamma falls to 0 before the energy does
    # unloaded at gamma = end = sqrt(square), after the impulse e^2 energy / (gamma +
    # end);
    # from gamma = 0 the end is a multiple of e: regular at e = 0
    end = jnp.where(
        rising, e * jnp.sqrt(up * some), jnp.sqrt(jnp.where(back, 1.0, square))
    )
    whole = e**2 * some / jnp.where(expands & ~rising & ~back, gamma + end, 1.0)
    whole = jnp.where(rising, e * jnp.sqrt(some / up), whole)
    length = jnp.where(back, -gamma / jnp.where(back, slope, 1.0), whole)
    length = jnp.where(turns, -gamma / up, jnp.where(expands, length, jnp.inf))
    reached = length <= most
    dp = jnp.where(closes | expands, jnp.where(reached, length, most), 0.0)
    unloaded = expands & reached & ~back
    after = jnp.where(
        unloaded, end, jnp.where(reached & (turns | back), 0.0, gamma + slope * dp)
    )
    share = jnp.where(expands & ~unloaded, e**2, 1.0)
    return SingleContact(
        gap_velocity=after,
        energy=jnp.where(unloaded, 0.0, energy - (gamma + after) * dp / share),
        left=s.left - dp,
        sliding=s.sliding + jnp.where(slides, dp, 0.0),
        holding=s.holding + jnp.where(slides, 0.0, dp),
    )
