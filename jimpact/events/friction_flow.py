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
    Contacts,
    ContactStates,
    Frozen,
    Modes,
    Phase,
    as_pytree,
    largest_of,
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
from jimpact.tools.masks import quotient
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
    stick: Bool[Array, "m B"]
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
        return cls(
            modes=modes,
            passes=zero[:1],
            gamma=zero,
            root=zero,
            slip=zero,
            impulse=zero,
            side=zero,
            wedged=no,
            stops=no,
        )


class FrictionRows(NamedTuple):
    """Rows of a state with friction."""

    x: Float[Array, "m B"]  # indentations
    g: Float[Array, "m B"]  # gamma / s
    p: Float[Array, "m B"]  # normal impulses
    u: Float[Array, "t B"]  # slip
    side: Float[Array, "t B"]  # tangential impulses
    time: Float[Array, "1 B"]

    def packed(self) -> Float[Array, "n B"]:
        """The rows as one array."""
        return jnp.concatenate(self)


@as_pytree
@dataclasses.dataclass(kw_only=True)
class FrictionFlow(ContactFlow):
    """The motion of m contacts with planar friction, t = m."""

    normal_tangent: Float[Array, "m t B"]  # K_nt
    tangent: Float[Array, "t t B"]  # K_tt
    friction: Float[Array, "m B"]  # mu

    # ---- the state: x, g, p, slip u, its impulse, time

    @property
    def tangents(self) -> int:
        """Number t of tangential rows."""
        return self.normal_tangent.shape[1]

    @property
    def driving(self) -> tuple[int, ...]:
        """Sizes of the blocks x, g, p and slip."""
        m = self.contacts
        return m, m, m, self.tangents

    @property
    def adding(self) -> tuple[int, ...]:
        """Sizes of the blocks of the tangential impulse and of time."""
        return self.tangents, 1

    def slip_rows(self, y: Float[Array, "driving B"]) -> Float[Array, "t B"]:
        """The rows of slip of a state."""
        m = self.contacts
        return y[3 * m : 3 * m + self.tangents]

    def slip(self, y: Float[Array, "driving B"]) -> Float[Array, "m B"]:
        """Slip u of a state."""
        return self.slip_rows(y)

    def side_impulse(self, y: Float[Array, "n B"]) -> Float[Array, "t B"]:
        """Tangential impulse of a state, its last rows but the time."""
        return y[-1 - self.tangents : -1]

    def with_tangents(
        self, y: Float[Array, "_ B"], u: Float[Array, "t B"]
    ) -> Float[Array, "n B"]:
        """A state without friction, with slip u and no tangential impulse before the
        time.
        """
        x, g, p = self.rows(y)
        no_impulse = jnp.zeros_like(u)
        return FrictionRows(x, g, p, u, no_impulse, time=y[-1:]).packed()

    def friction_rows(self, y: Float[Array, "n B"]) -> FrictionRows:
        """All rows of a state."""
        x, g, p = self.rows(y)
        u = self.slip_rows(y)
        side = self.side_impulse(y)
        return FrictionRows(x, g, p, u, side, time=y[-1:])

    def with_slip_modes(
        self, modes: Int[Array, "_ B"], slip: Int[Array, "m B"]
    ) -> Int[Array, "modes B"]:
        """The modes with these modes of slip."""
        phase, closings, _ = self.modes(modes)
        return Modes(phase, closings, slip.astype(modes.dtype)).packed()

    def start_with(
        self, gamma: Float[Array, "m B"], x: Float[Array, "m B"], u: Float[Array, "t B"]
    ) -> tuple[Int[Array, "modes B"], Float[Array, "n B"]]:
        """Modes and state before the impact, from gamma, indentations x and slip u."""
        modes, y = self.start(gamma, x)
        sign = jnp.sign(u).astype(modes.dtype)
        modes = self.with_slip_modes(modes, sign)
        y = self.with_tangents(y, u)
        closed = self.modes(modes).phase != Phase.OPEN
        return self.decided(modes, y, jnp.zeros_like(closed), closed)

    # ---- the protocol

    def allowance(
        self, modes: Int[Array, "modes B"], y: Float[Array, "n B"]
    ) -> Float[Array, "n #B"] | float:
        """Allowed error of each row, in tolerances: `max(ridge / tolerance, 1)` of the
        tangential impulse, 1 of others.

        The sharing of tangential forces is no more accurate. It changes no velocity,
        and all else of lambda is linear in F while the modes last.
        """
        coarse = jnp.maximum(ridge(y.dtype) / self.tolerance, 1.0)
        ones = self.friction_rows(jnp.ones_like(y))
        return ones._replace(side=coarse * ones.side).packed()

    def constants(self, modes: Int[Array, "modes B"]) -> Any:
        """Factors of the normal field and of friction: who sticks, lambda / F of the
        others.
        """
        slip = self.modes(modes).slip
        stick = (slip == 0) & self.loaded(modes)
        drag = -slip.astype(self.friction.dtype) * self.friction
        both = stick[:, None] & stick[None]
        k = jnp.where(both, self.tangent, 0.0)
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
        j = np.arange(self.contacts)
        k = self.tangent[j, j]  # K_tt jj
        movable = k > 0
        root = jnp.sqrt(jnp.where(movable, k, 1.0))
        return ridge(k.dtype) * jnp.where(movable, root, 1.0)

    def forces(
        self, const: FrictionConstants, y: Float[Array, "driving B"]
    ) -> FrictionForces:
        """Forces F and lambda in a state, rates u' of slip, and margins of sticking.

        Sliding: `lambda = drag F`; sticking: `K_tt lambda = -pull F` for them, shared
        in proportion to mu F where K_tt is singular. With h = |lambda| / (weight mu F)
        of one that sticks, and h_1 = max mu F, `room = (h_1 - h) / (h_1 + h)`; 1 of
        others and where both are 0.
        """
        x, g, _ = self.rows(y)
        f = self.force(const.frozen, x, g)
        cone = self.friction * f
        pull = times(const.pull, f)
        largest = jax.lax.stop_gradient(largest_of(cone))
        weight = load_shares(cone)
        right = jnp.where(const.stick, -pull, 0.0)
        held = regularized_once(const.tangent * weight[None], const.ridge, right)
        hold = weight * held
        size = jnp.abs(held)
        # in parts of the force: those of a contact that opens vanish together
        together = largest + size
        some = const.stick & (together > 0)
        room = quotient(largest - size, together, where=some, otherwise=1.0)
        pulled = pull + times(self.tangent, hold)
        rate = jnp.where(const.stick, 0.0, pulled)
        return FrictionForces(f, const.drag * f + hold, rate, room)

    def field(
        self, const: Any, modes: Int[Array, "modes B"], y: Float[Array, "driving B"]
    ) -> Float[Array, "n B"]:
        """Rates of x, g, p, slip u, its impulse and time.

        Equation: `x' = closing g`, `g' = ratio (G F + K_nt lambda)`, and `unit` times
        F, u' of `forces`, lambda and 1.
        """
        frozen = const.frozen
        forces = self.forces(const, y)
        across = times(self.normal_tangent, forces.side)
        pull = self.coupling.times(forces.normal) + across
        rates = FrictionRows(
            x=frozen.closing * self.rows(y).g,
            g=frozen.ratio * pull,
            p=frozen.unit * forces.normal,
            u=frozen.unit * forces.rate,
            side=frozen.unit * forces.side,
            time=frozen.unit,
        )
        return rates.packed()

    def margins(
        self, const: Any, modes: Int[Array, "modes B"], y: Float[Array, "driving B"]
    ) -> Float[Array, "k B"]:
        """Margins of the normal flow, speeds of slip, distances to the friction cones
        (m each).

        The speed is 1 of a contact that does not slide.
        """
        sign = self.modes(modes).slip
        slides = (sign != 0) & self.loaded(modes)
        speed = sign.astype(y.dtype) * self.slip(y)
        speed = jnp.where(slides, speed, 1.0)
        normal = self.normal_margins(const.frozen, modes, y)
        room = self.forces(const, y).room
        return jnp.concatenate([normal, speed, room])

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

        A contact that breaks loose slides against the force that held it.
        """
        _, _, stopped, broke = self.kinds(which)
        before = self.modes(modes)
        side = self.forces(self.constants(modes), y).side
        direction = -jnp.sign(side).astype(modes.dtype)  # against the force of sticking
        slip = jnp.where(broke, direction, before.slip)
        modes, y = self.normal_switch(modes, y, which)
        modes = self.with_slip_modes(modes, slip)
        closed = self.modes(modes).closings > before.closings
        return self.decided(modes, y, stopped, closed)

    def decided(
        self,
        modes: Int[Array, "modes B"],
        y: Float[Array, "n B"],
        stopped: Bool[Array, "m B"],
        closed: Bool[Array, "m B"],
    ) -> tuple[Int[Array, "modes B"], Float[Array, "n B"]]:
        """Modes and state once it is decided which contacts stick, and where others
        slide to.

        A contact that has `closed` with slip slides along it. `distribute` decides anew
        where slip has `stopped`, or a contact has `closed` without slip, from the
        forces of a moment later: of these contacts, of those that stick, and of those
        at rest.
        """
        u = self.slip(y)
        slip = self.modes(modes).slip
        loaded = self.loaded(modes)
        rests = jnp.abs(u) <= SNAP * self.tolerance
        sign = jnp.sign(u).astype(slip.dtype)
        slip = jnp.where(closed & ~rests, sign, slip)
        resting = loaded & rests & ((slip != 0) | closed)
        check = any_of(stopped | (closed & resting))
        to_check = check & loaded & (stopped | resting | (slip == 0))
        constant, state = jax.lax.stop_gradient((self, y))
        f = constant.soon(modes, state)
        cone = constant.friction * f  # mu F
        # b = u' by normal forces and by the friction of contacts that slide on
        sliding = -slip.astype(u.dtype) * cone
        sliding = jnp.where(to_check | ~loaded, 0.0, sliding)
        tangent_normal = jnp.swapaxes(constant.normal_tangent, 0, 1)
        b = times(tangent_normal, f) + times(constant.tangent, sliding)
        stick, towards = distribute(constant.tangent, b, cone, to_check)
        signs = jnp.sign(towards).astype(slip.dtype)
        towards = jnp.where(stick, 0, signs)
        slip = jnp.where(to_check, towards, slip)
        held_cone = jnp.where(stick, cone, 0.0)
        y = self._at_rest(modes, y, to_check, held_cone)
        return self.with_slip_modes(modes, slip), y

    def _at_rest(
        self,
        modes: Int[Array, "modes B"],
        y: Float[Array, "n B"],
        rests: Bool[Array, "m B"],
        cone: Float[Array, "m B"],
    ) -> Float[Array, "n B"]:
        """The state with slips of 0 at contacts that rest; those with `cone` = mu F > 0
        stick.

        Slips are nothing there, but their tangents are not. Those of contacts that
        stick are taken by a tangential impulse q, `u + K_tt q = 0`, shared in
        proportion to mu F where K_tt is singular: `q = w y`, w the shares of mu F,
        `(K_tt w + ridge) y = -u`. Of one that begins to slide they remain.
        """
        rows = self.friction_rows(y)
        u = rows.u
        w = load_shares(cone)
        sticks = cone > 0
        soft = jnp.where(sticks, ridge(u.dtype), 1.0)
        right = jnp.where(sticks, -u, 0.0)
        q = w * regularized_once(self.tangent * w[None], soft, right)
        dg = self.as_rows(modes, times(self.normal_tangent, q))
        u = u + times(self.tangent, q)
        without_value = u - jax.lax.stop_gradient(u)
        u = jnp.where(rests, without_value, u)
        rows = rows._replace(g=rows.g + dg, u=u, side=rows.side + q)
        return rows.packed()

    def as_rows(
        self, modes: Int[Array, "modes B"], gamma: Float[Array, "m B"]
    ) -> Float[Array, "m B"]:
        """Changes of the rows g = gamma / s from those of gamma; 0 where s = e = 0."""
        s = self.scales(modes)
        return quotient(gamma, s, where=s > 0)

    def soon(
        self, modes: Int[Array, "modes B"], y: Float[Array, "n B"]
    ) -> Float[Array, "m B"]:
        """Normal forces at x a MOMENT later, in parts of the largest; 0 if all are."""
        const = self.normal_constants(modes)
        x, g, _ = self.rows(y)
        x = jnp.maximum(x + MOMENT * const.closing * g, 0.0)
        f = self.force(const, x, g)
        largest = largest_of(f)
        return f / jnp.where(largest > 0, largest, 1.0)

    def contact_states(
        self, modes: Int[Array, "modes B"], y: Float[Array, "n B"]
    ) -> ContactStates:
        """Forces, velocities and slip in a state."""
        states = super().contact_states(modes, y)
        return states._replace(
            tangential_force=self.forces(self.constants(modes), y).side,
            tangential_impulse=self.side_impulse(y),
            slip=self.slip(y),
        )

    def change(self, y: Float[Array, "n B"]) -> Float[Array, "m B"]:
        """Change `G p + K_nt p_t` of the gap velocities by the impulses of a state."""
        side = self.side_impulse(y)
        return super().change(y) + times(self.normal_tangent, side)

    # ---- the end

    @property
    def wedges(self) -> bool:
        """True if rigid contacts in the plane: a state multiplied by s then takes the
        same course, see `wedged_limit.py`.
        """
        planar = self.tangents == self.contacts
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
        """Mask: after an event, where the impact drags on; None where no contacts can
        be wedged.
        """
        if not self.wedges:
            return None
        return any_of(before != after) & (passes > DRAGGING * self.taking_part)

    @property
    def at_once(self) -> bool:
        """True if there is one contact, and it is planar."""
        return super().at_once and self.tangents == 1

    def over(
        self,
        modes: Int[Array, "modes B"],
        y: Float[Array, "n B"],
        passes: Float[Array, "1 B"],
    ) -> Bool[Array, "1 B"]:
        """Mask: no contact is loaded or approaches."""
        left = LEFT * self.patience(passes)
        works, *_ = self.at_work(modes, y, left)
        return ~any_of(works)

    def finish(
        self, modes: Int[Array, "modes B"], y: Float[Array, "n B"]
    ) -> tuple[Int[Array, "modes B"], Float[Array, "n B"]]:
        """Modes and state with indentations of 0; of a single contact in the plane,
        without gaps, after its impulses in closed form.
        """
        if self.at_once:
            return modes, self._after_one(modes, y)
        x, g, p = self.rows(y)
        at_rest = Contacts(jnp.zeros_like(x), g, p)
        return modes, self.with_rows(y, at_rest)

    def settled(
        self, modes: Int[Array, "modes B"], y: Float[Array, "n B"], cycle: Cycle
    ) -> Float[Array, "n B"]:
        """The state in the limit of contacts that friction wedges: see `Cycle`.

        The impulses P and Q that are left solve `_wedged_equations`. Where contacts are
        redundant, they are the solution with the least change from the impulses summed
        over the cycles, `cycle.impulse` and `cycle.side`. Indentations x are 0 in the
        limit.
        """
        m = self.contacts
        rows = self.friction_rows(y)
        gamma = self.scales(modes) * rows.g
        matrix, right = self._wedged_equations(cycle, gamma, rows.u)
        summed = jnp.concatenate([cycle.impulse, cycle.side])
        error = right - times(matrix, summed)
        soft = jnp.full_like(summed, ridge(summed.dtype))
        correction = regularized(matrix, error, soft, refinements=1, without_null=True)
        impulses = summed + correction
        p = impulses[:m]
        q = impulses[m:]
        k_nt = self.normal_tangent
        k_tn = jnp.swapaxes(k_nt, 0, 1)
        gamma_change = times(self.coupling.dense(m), p) + times(k_nt, q)
        dg = self.as_rows(modes, gamma_change)
        limit = FrictionRows(
            x=jnp.zeros_like(rows.x),
            g=rows.g + dg,
            p=rows.p + p,
            u=rows.u + times(k_tn, p) + times(self.tangent, q),
            side=rows.side + q,
            time=rows.time,
        )
        return limit.packed()

    def _wedged_equations(
        self, cycle: Cycle, gamma: Float[Array, "m B"], u: Float[Array, "m B"]
    ) -> tuple[Float[Array, "k k B"], Float[Array, "k B"]]:
        """Matrix A and right side b of `A (P, Q) = b`, the impulses that friction
        wedges.

        Equation: `gamma + G P + K_nt Q = 0` of wedged contacts, P = 0 of others;
        `u + K_tn P + K_tt Q = 0` where slip stops, `Q = -mu P sign(u)` of wedged ones
        that slide, Q = 0 of others.
        """
        g_nn = self.coupling.dense(self.contacts)
        k_nt = self.normal_tangent
        k_tn = jnp.swapaxes(k_nt, 0, 1)
        k_tt = self.tangent
        eye = unit(k_tt)
        drag = -self.friction * jnp.sign(jax.lax.stop_gradient(u))  # Q = drag P
        wedged = cycle.wedged[:, None]
        stops = cycle.stops[:, None]
        slides = jnp.where(wedged, -eye * drag[:, None], 0.0)
        p_in_normal_rows = jnp.where(wedged, g_nn, eye)
        q_in_normal_rows = jnp.where(wedged, k_nt, 0.0)
        normal_rows = jnp.concatenate([p_in_normal_rows, q_in_normal_rows], axis=1)
        p_in_side_rows = jnp.where(stops, k_tn, slides)
        q_in_side_rows = jnp.where(stops, k_tt, eye)
        side_rows = jnp.concatenate([p_in_side_rows, q_in_side_rows], axis=1)
        normal_right = jnp.where(cycle.wedged, -gamma, 0.0)
        side_right = jnp.where(cycle.stops, -u, 0.0)
        matrix = jnp.concatenate([normal_rows, side_rows])
        return matrix, jnp.concatenate([normal_right, side_right])

    def _after_one(
        self, modes: Int[Array, "modes B"], y: Float[Array, "n B"]
    ) -> Float[Array, "n B"]:
        """The state after the impact of a single contact, in closed form.

        With its normal impulse p gamma grows at the rate `1 + K_nt r`, u at
        `K_nt + K_tt r`, where r = lambda / F: `drag` = -mu sign(u) until slip stops,
        from then on `hold`, -K_nt / K_tt, or +-mu where that is beyond the cone: slip
        then begins anew, to the other side. It is a sequence of at most PIECES pieces,
        each of which slides or not, and compresses or expands, by the energy that the
        restitution leaves. A contact that is not at work stays as it is, but for x = 0.
        """
        works, gamma, _ = self.at_work(modes, y, LEFT * self.tolerance)
        rows = self.friction_rows(y)
        x = rows.x
        u = rows.u
        sign = self.modes(modes).slip
        k_nt = self.normal_tangent[0]
        k_tt = self.tangent[0]
        mu = self.friction
        drag = -sign.astype(u.dtype) * mu
        hold = quotient(-k_nt, k_tt, where=k_tt > 0)
        size = jnp.minimum(jnp.abs(hold), mu)
        hold = jnp.sign(hold) * size
        du = k_nt + k_tt * drag  # over dp, while it slides
        stops = (sign != 0) & (u * du < 0)
        # normal impulse until slip stops
        until_stop = quotient(-u, du, where=stops, otherwise=jnp.inf)
        until_stop = jnp.where(sign == 0, 0.0, until_stop)
        stored = power(x, plus_one(self.exponent))
        energy = jnp.where(x > 0, stored, 0.0)
        start = SingleContact(
            # of a contact not at work any: its result is not used
            gap_velocity=jnp.where(works, gamma, -1.0),
            energy=energy,
            left=until_stop,
            sliding=0 * rows.p,
            holding=0 * rows.p,
        )
        slopes = 1 + k_nt * drag, 1 + k_nt * hold

        def next_piece(_: Any, s: SingleContact) -> SingleContact:
            """The contact after one more piece."""
            return _next_piece(s, slopes, self.restitution)

        end = fori_loop(0, PIECES, next_piece, start)
        side = drag * end.sliding + hold * end.holding
        side = jnp.where(works, side, 0.0)
        dp = jnp.where(works, end.sliding + end.holding, 0.0)
        rows = FrictionRows(
            x=jnp.zeros_like(x),
            g=jnp.where(works, end.gap_velocity, gamma),
            p=rows.p + dp,
            u=u + k_nt * dp + k_tt * side,
            side=rows.side + side,
            time=rows.time,
        )
        return rows.packed()


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

    gamma grows with the impulse p at the rates `slopes`, until slip stops and from then
    on; twice the energy changes by `dE = -2 gamma dp` in compression, and by
    `-2 gamma dp / e^2` in expansion. A piece ends where

        slip stops      p = left
        gamma turns     p = -gamma / slope, in compression, or in an expansion whose
                        gamma falls to 0 before the energy does
        it is unloaded  gamma+ = sqrt(gamma^2 + e^2 slope E),
                        p = e^2 E / (gamma + gamma+)

    whichever is first. From gamma = 0 the last one is `gamma+ = e sqrt(slope E)`,
    `p = e sqrt(E / slope)`, regular at e = 0.
    """
    gamma = s.gap_velocity
    energy = s.energy
    slides = s.left > 0
    slope = jnp.where(slides, *slopes)
    until_stop = jnp.where(slides, s.left, jnp.inf)
    begins = (gamma == 0) & (slope < 0)
    closes = (gamma < 0) | begins  # is compressed
    parts = (gamma > 0) | (slope > 0)
    expands = ~closes & (energy > 0) & parts
    turns = closes & (slope > 0)
    from_rest = expands & (gamma == 0)
    moving = expands & ~from_rest
    # where it is unloaded
    stored = jnp.where(expands, energy, 1.0)
    up = jnp.where(turns | from_rest, slope, 1.0)
    square = jnp.where(moving, gamma**2 + e**2 * slope * energy, 1.0)
    falls = square <= 0  # gamma turns before
    end = jnp.sqrt(jnp.where(falls, 1.0, square))
    of_rest = e * jnp.sqrt(up * stored)
    end = jnp.where(from_rest, of_rest, end)
    speeds = jnp.where(moving & ~falls, gamma + end, 1.0)
    unloading = e**2 * stored / speeds
    of_rest_too = e * jnp.sqrt(stored / up)
    unloading = jnp.where(from_rest, of_rest_too, unloading)
    # the piece
    falling = -gamma / jnp.where(falls, slope, 1.0)
    length = jnp.where(falls, falling, unloading)
    length = jnp.where(expands, length, jnp.inf)
    length = jnp.where(turns, -gamma / up, length)
    reached = length <= until_stop
    dp = jnp.where(reached, length, until_stop)
    dp = jnp.where(closes | expands, dp, 0.0)
    unloaded = expands & reached & ~falls
    stands = reached & (turns | falls)
    after = jnp.where(stands, 0.0, gamma + slope * dp)
    after = jnp.where(unloaded, end, after)
    share = jnp.where(expands & ~unloaded, e**2, 1.0)
    left_energy = energy - (gamma + after) * dp / share
    return SingleContact(
        gap_velocity=after,
        energy=jnp.where(unloaded, 0.0, left_energy),
        left=s.left - dp,
        sliding=s.sliding + jnp.where(slides, dp, 0.0),
        holding=s.holding + jnp.where(slides, 0.0, dp),
    )
