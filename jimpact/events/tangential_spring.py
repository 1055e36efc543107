"""Contacts with a tangential spring below Coulomb's limit, in the plane and in space.

With the normal force F of the indentation x a contact j has a spring of stiffness
`k_t = kappa dF/dx(x)` and elongation xi:

    holds    xi' = u,  lambda = -k_t xi,                 while |lambda| <= mu F
    slides   xi = mu F / k_t n,  lambda = -mu F n,       while n . (u - xi') >= 0

where n is the direction of xi, and u - xi' is the slip. In the units of
`contact_flow.py`, with F = (eta + 1)/2 omega x^eta and xi in those of x,
`k_t = kappa eta F / x`: the cone is

    kappa eta |xi| <= mu x,

linear in the state. So nothing here is singular or redundant: forces follow from x and
xi whatever the contacts share, and exact events end the modes. A contact that closes
with u and gamma slides at once if `kappa eta |u| > mu |gamma|`. The cone closes as x
falls to 0: a spring that is still loaded then slides. A contact closes with xi = 0.

In space n turns while the contact slides: xi' has no component across n but that of u,
so

    angle' = A / x sin(phi - angle),   A = kappa eta omega |u| / mu,

phi the angle of u.

This is stiff where x is small. A loaded contact has therefore one of three modes:

    HOLDS    xi is a state
    SLIDES   the angle is a state, and the whole field advances in a time that is
             shortened by one and the sum of the rates A / x
    DRAGS    A / x is so large that n follows u, behind it by phi' x / (A + x'), exact
             where phi' is steady and x a power of time: a contact that closes while it
             slides

STATE   x, g, p (m each), u, xi, impulse of lambda (t each), time. In space the rows of
        xi are 0 and the angle while a contact slides.
MODES   phase, closings, slip (m each): 0 holds; in the plane +-1, the direction in
        which it slides; in space 1 slides, 2 drags.
"""

import dataclasses
import enum
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jimpact.events.contact_flow import (
    ContactFlow,
    ContactStates,
    Frozen,
    as_pytree,
    largest_of,
    per_row,
)
from jimpact.events.friction_flow import FrictionFlow
from jimpact.events.slip import (
    STABLE,
    angle_of,
    dot,
    length,
    parts,
    perpendicular_to,
    towards,
    turned,
)
from jimpact.numerics.dense import times
from jimpact.numerics.driver import SLOTS, SLOTS_IN_SPACE
from jimpact.numerics.stepper import total
from jimpact.tools.masks import quotient

# Longest step in the time in which a spring moves by one radian. Errors of a spring
# without load show in derivatives only: ten times more, and these are wrong.
RADIAN = 1.0
# Of the tolerance: a contact that holds slides from this far beyond its cone, where the
# direction of its spring is known also if it began at rest. Ten times more would be
# seen in the outcome.
BEYOND = 0.05
# A contact drags where the rate A / x of its direction is this over the cube root of
# the tolerance, and slides again from a quarter of that on. Impulses err by its inverse
# cube times (1 / A)^2. Ten times more: half as many steps again; ten times less: errors
# of five tolerances.
SWIFT = 10.0
QUARTER = 0.25


class Slide(enum.IntEnum):
    """Motion of a contact along its plane, in space."""

    HOLDS = 0
    SLIDES = 1
    DRAGS = 2


class SpringConstants(NamedTuple):
    """Factors of the field that do not change while the modes last."""

    frozen: Frozen
    loaded: Bool[Array, "m B"]
    slides: Bool[Array, "m B"]


class SpringForces(NamedTuple):
    """Forces of the contacts and how their springs change, b tangents each."""

    normal: Float[Array, "m B"]  # F
    side: Float[Array, "t B"]  # lambda
    # rates of the rows of xi, in time that is not shortened
    elongation: Float[Array, "m b B"]
    direction: Float[Array, "m b B"]  # n of those that slide
    slip: Float[Array, "m B"]  # kappa eta (slip rate along n), of those that slide
    haste: Float[Array, "1 B"]  # >= 1: by how much time is shortened


@as_pytree
@dataclasses.dataclass(kw_only=True)
class SpringFlow(FrictionFlow):
    """The motion of m contacts with tangential springs, b = t / m of each."""

    tangential_stiffness: Float[Array, "m B"]  # kappa

    # ---- the state: x, g, p, slip velocity u, spring xi, impulse of lambda, time

    @property
    def in_space(self) -> bool:
        """True with two tangents a contact."""
        return self.tangents == 2 * self.contacts

    @property
    def slots(self) -> int:  # type: ignore[override]
        """Impacts that a CPU computes side by side: in space some take many more
        passes.
        """
        if self.in_space:
            return SLOTS_IN_SPACE
        return SLOTS

    @property
    def driving(self) -> tuple[int, ...]:
        """Sizes of the blocks x, g, p, u and xi."""
        m = self.contacts
        t = self.tangents
        return m, m, m, t, t

    @property
    def steep(self) -> Float[Array, "m B"]:
        """`kappa eta`: k_t over the secant stiffness F / x."""
        return self.tangential_stiffness * per_row(self.exponent, self.omega)

    @property
    def swift(self) -> Float[Array, "1 B"]:
        """Rate A / x of directions above which a contact drags."""
        return SWIFT / jnp.cbrt(jax.lax.stop_gradient(self.tolerance))

    @property
    def longest(self) -> Float[Array, "1 B"]:  # type: ignore[override]
        """The longest step: RADIAN over the rate of the fastest spring, in space at
        most STABLE.

        Equation: `rate^2 <= max_i sum_j |K_tt|_ij k_t omega_j`, with
        `k_t = kappa eta (eta + 1)/2 omega_j` at x = 1.
        """
        eta = per_row(self.exponent, self.omega)
        k_t = self.steep * (eta + 1) / 2
        k_t_omega = k_t * self.omega * self.omega
        of_rows = jnp.repeat(k_t_omega, self.tangents // self.contacts, axis=0)
        square = largest_of(times(jnp.abs(self.tangent), of_rows))
        if self.in_space:
            square = jnp.maximum(square, (RADIAN / STABLE) ** 2)
        else:
            square = jnp.maximum(square, 0.0)
        return jax.lax.stop_gradient(RADIAN / jnp.sqrt(square))

    def by_contact(self, rows: Float[Array, "t B"]) -> Float[Array, "m b B"]:
        """Tangential rows of each contact side by side."""
        batch = rows.shape[1:]
        return rows.reshape(self.contacts, -1, *batch)

    def slip(self, y: Float[Array, "driving B"]) -> Float[Array, "t B"]:
        """Tangential velocity u."""
        return self.slip_rows(y)

    def spring(self, y: Float[Array, "driving B"]) -> Float[Array, "m b B"]:
        """Rows of xi."""
        begin = 3 * self.contacts + self.tangents
        return self.by_contact(y[begin : begin + self.tangents])

    def elongation(self, y: Float[Array, "driving B"]) -> Float[Array, "m B"]:
        """|xi| of contacts that hold, with derivative 0 at 0."""
        square = jnp.sum(self.spring(y) ** 2, axis=1)
        some = square > 0
        positive = jnp.where(some, square, 1.0)
        return jnp.where(some, jnp.sqrt(positive), 0.0)

    def with_spring(
        self, y: Float[Array, "n B"], xi: Float[Array, "m b B"]
    ) -> Float[Array, "n B"]:
        """The state with these rows of xi."""
        begin = 3 * self.contacts + self.tangents
        end = begin + self.tangents
        rows = xi.reshape(self.tangents, *xi.shape[2:])
        behind = y[end:]
        return jnp.concatenate([y[:begin], rows, behind])

    def start_with(
        self, gamma: Float[Array, "m B"], x: Float[Array, "m B"], u: Float[Array, "t B"]
    ) -> tuple[Int[Array, "modes B"], Float[Array, "n B"]]:
        """Modes and state before the impact, from gamma, indentations x and slip u."""
        modes, y = self.start(gamma, x)
        holds = jnp.full(x.shape, Slide.HOLDS)
        modes = self.with_slip_modes(modes, holds)
        xi = jnp.zeros_like(u)
        side = jnp.zeros_like(u)
        time = y[-1:]
        normal_rows = self.rows(y)
        y = jnp.concatenate([*normal_rows, u, xi, side, time])
        return self.closed(modes, y, self.loaded(modes))

    # ---- the protocol

    def allowance(
        self, modes: Int[Array, "modes B"], y: Float[Array, "n B"]
    ) -> Float[Array, "n #B"] | float:
        """Allowed error of each row, in tolerances; the angle of slip may err by more
        where x is 0.

        Its error counts by the force, so that `1 / x` is allowed.
        """
        if not self.in_space:
            return 1.0
        is_sliding = self.modes(modes).slip == Slide.SLIDES
        slides = self.loaded(modes) & is_sliding
        x = self.rows(y).x
        depth = jnp.clip(x, self.tolerance, 1.0)
        angle = jnp.where(slides, 1 / depth, 1.0)
        ones = jnp.ones_like(y)
        of_spring = jnp.stack([jnp.ones_like(angle), angle], 1)
        return self.with_spring(ones, of_spring)

    def constants(self, modes: Int[Array, "modes B"]) -> Any:
        """Factors of the normal field, and which contacts are loaded and slide."""
        loaded = self.loaded(modes)
        slides = loaded & (self.modes(modes).slip != 0)
        return SpringConstants(self.normal_constants(modes), loaded, slides)

    def aim(self, y: Float[Array, "driving B"]) -> Float[Array, "m B"]:
        """`A mu = kappa eta omega |u|`: how fast directions turn towards u, times mu
        x.
        """
        slip = self.by_contact(self.slip(y))
        return self.steep * self.omega * length(slip)

    def side(
        self,
        const: SpringConstants,
        y: Float[Array, "driving B"],
        f: Float[Array, "m B"],
        n: Float[Array, "m b B"],
    ) -> Float[Array, "t B"]:
        """Tangential forces of contacts with normal forces F (`f`), see above.

        Holding: `-kappa eta F / x xi`, with kappa eta (`steep`), indentation x and
        elongation xi of the spring; sliding: `-mu F n`, n its direction.
        """
        x, *_ = self.rows(y)
        secant = quotient(f, x, where=x > 0)
        stiffness = (self.steep * secant)[:, None]
        held = -stiffness * self.spring(y)
        sliding = -(self.friction * f)[:, None] * n
        tangential = jnp.where(const.slides[:, None], sliding, held)
        return tangential.reshape(self.slip(y).shape)

    def slip_acceleration(
        self, f: Float[Array, "m B"], side: Float[Array, "t B"]
    ) -> Float[Array, "t B"]:
        """`u' = K_tn F + K_tt lambda`."""
        tangent_normal = jnp.swapaxes(self.normal_tangent, 0, 1)
        return times(tangent_normal, f) + times(self.tangent, side)

    def direction(
        self,
        const: SpringConstants,
        modes: Int[Array, "modes B"],
        y: Float[Array, "driving B"],
        f: Float[Array, "m B"],
    ) -> Float[Array, "m b B"]:
        """Directions n of the springs of contacts that slide.

        In the plane the mode; in space of the angle, or, where it drags, that of u
        turned back by `phi' x / (A + x')`, phi' = u x u' / |u|^2 by forces along u.
        """
        slip = self.modes(modes).slip
        if not self.in_space:
            return slip[:, None].astype(y.dtype)
        x, g, _ = self.rows(y)
        mu = self.friction
        u = self.by_contact(self.slip(y))
        drags = slip == Slide.DRAGS
        speed = length(u)
        moves = drags & (speed > 0)
        size = jnp.where(moves, speed, 1.0)
        fixed = jnp.array([1.0, 0.0])[None, :, None]
        of_slip = u / size[:, None]
        along = jnp.where(moves[:, None], of_slip, fixed)
        _, angle = parts(self.spring(y))
        of_angle = towards(jnp.where(slip == Slide.SLIDES, angle, 0.0))
        first = jnp.where(drags[:, None], along, of_angle)
        side = self.side(const, y, f, first)
        du = self.by_contact(self.slip_acceleration(f, side))
        across = dot(perpendicular_to(along), du)
        dphi = jnp.where(moves, across / size, 0.0)
        # x' in time: closing g / unit, but 0 where an expansion takes no time
        unit = const.frozen.unit
        dx = quotient(const.frozen.closing * g, unit, where=unit > 0)
        pace = self.aim(y) + mu * dx  # mu (A + x')
        lags = moves & (pace > 0)
        lag = quotient(mu * x * dphi, pace, where=lags)
        direction, _ = turned((first, perpendicular_to(first)), -lag)
        return direction

    def forces(  # type: ignore[override]
        self,
        const: SpringConstants,
        modes: Int[Array, "modes B"],
        y: Float[Array, "driving B"],
    ) -> SpringForces:
        """Forces F and lambda in a state, and the rates of the springs.

        Holding: `xi' = omega u`. Sliding: slip is
        `n . u - (mu x / (kappa eta))' / omega`, and in space
        `angle' = A / x (n' . u) / |u|`, n' at right angles to n.
        """
        frozen = const.frozen
        x, g, _ = self.rows(y)
        u = self.by_contact(self.slip(y))
        f = self.force(frozen, x, g)
        n = self.direction(const, modes, y, f)
        along = jnp.sum(n * u, axis=1)
        slip = self.steep * frozen.unit * along
        slip = slip + self.friction * frozen.ratio * g
        holds = const.loaded & ~const.slides
        elongates = (frozen.unit * self.omega)[:, None] * u
        rate = jnp.where(holds[:, None], elongates, 0.0)
        haste = jnp.ones_like(frozen.unit)
        if self.in_space:
            slides = const.slides & (self.modes(modes).slip == Slide.SLIDES)
            turns = slides & (self.friction > 0) & (x > 0)
            depth = jnp.where(turns, self.friction * x, 1.0)
            speed_of_turn = self.steep * frozen.unit * self.omega / depth
            swift = jnp.where(turns, speed_of_turn, 0.0)
            turning = swift * dot(perpendicular_to(n), u)
            of_angle = jnp.stack([jnp.zeros_like(turning), turning], 1)
            rate = rate + of_angle
            haste = haste + total(swift * length(u))
        side = self.side(const, y, f, n)
        return SpringForces(f, side, rate, n, slip, haste)

    def field(
        self, const: Any, modes: Int[Array, "modes B"], y: Float[Array, "driving B"]
    ) -> Float[Array, "n B"]:
        """Rates of x, g, p, u, xi, its impulse and time, all over `haste`: in shortened
        time.

        Equation: `g' = ratio (G F + K_nt lambda)`, `u' = unit (K_tn F + K_tt lambda)`.
        """
        frozen = const.frozen
        forces = self.forces(const, modes, y)
        f = forces.normal
        side = forces.side
        dx = frozen.closing * self.rows(y).g
        pull = self.coupling.times(f) + times(self.normal_tangent, side)
        dg = frozen.ratio * pull
        dp = frozen.unit * f
        du = frozen.unit * self.slip_acceleration(f, side)
        dxi = forces.elongation.reshape(side.shape)
        dside = frozen.unit * side
        dy = jnp.concatenate([dx, dg, dp, du, dxi, dside, frozen.unit])
        if self.in_space:
            return dy / forces.haste
        return dy

    def margins(
        self, const: Any, modes: Int[Array, "modes B"], y: Float[Array, "driving B"]
    ) -> Float[Array, "k B"]:
        """Margins of the normal flow; until slip ends; until the spring gives way (m
        each).

        In space the last ones are also those between sliding and dragging.

        slip ends   `slip / (mu + kappa eta)`, the slip rate, see `forces`
        gives way   `(mu x - kappa eta |xi|) / (mu + kappa eta)` + BEYOND tolerance
        drags       `x - A / swift`: A / x rises to `swift`
        slides on   of one that drags `4 A / swift - x`: A / x falls to a quarter of it

        1 where there is no such end.
        """
        mu = self.friction
        steep = self.steep
        x, *_ = self.rows(y)
        slip = self.forces(const, modes, y).slip
        ends = const.slides & (mu > 0)
        elongation = self.elongation(y)
        room = (mu * x - steep * elongation) / (mu + steep)
        room = room + BEYOND * self.tolerance
        room = jnp.where(const.loaded & ~const.slides, room, 1.0)
        if self.in_space:
            rubs = jnp.where(mu > 0, mu, 1.0)
            shallow = self.aim(y) / (self.swift * rubs)  # A / swift
            drags = self.modes(modes).slip == Slide.DRAGS
            between = jnp.where(drags, shallow / QUARTER - x, x - shallow)
            room = jnp.where(ends, between, room)
        normal = self.normal_margins(const.frozen, modes, y)
        stops = jnp.where(ends, slip / (mu + steep), 1.0)
        return jnp.concatenate([normal, stops, room])

    def switch(
        self,
        modes: Int[Array, "modes B"],
        y: Float[Array, "n B"],
        which: Bool[Array, "k B"],
    ) -> tuple[Int[Array, "modes B"], Float[Array, "n B"]]:
        """Modes and state after events: slip that ends, springs that give way,
        openings, closings.

        Slip ends with the spring on its cone, xi = mu x / (kappa eta) n; a contact that
        opens has xi = 0.
        """
        _, _, stopped, ended = self.kinds(which)
        const = self.constants(modes)
        xi = self.spring(y)
        slip = self.modes(modes).slip
        n = self.forces(const, modes, y).direction
        direction = jnp.where(const.slides[:, None], n, xi)
        limit = self.friction * self.rows(y).x / self.steep
        cone = limit[:, None] * n
        xi = jnp.where(stopped[:, None], cone, xi)
        # in space one that slides drags from now on, one that drags slides
        other = Slide.SLIDES + Slide.DRAGS - slip
        xi, slip = self.sliding_from(ended, direction, y, slip, xi)
        slip = jnp.where(const.slides & ended, other, slip)
        slip = jnp.where(stopped, Slide.HOLDS, slip)
        after, y = self.normal_switch(modes, y, which)
        remains = self.loaded(after)
        slip = jnp.where(remains, slip, Slide.HOLDS)
        xi = jnp.where(remains[:, None], xi, 0.0)
        after = self.with_slip_modes(after, slip)
        closed = remains & ~self.loaded(modes)
        return self.closed(after, self.with_spring(y, xi), closed)

    def sliding_from(
        self,
        which: Bool[Array, "m B"],
        direction: Float[Array, "m b B"],
        y: Float[Array, "n B"],
        slip: Int[Array, "m B"],
        xi: Float[Array, "m b B"],
    ) -> tuple[Float[Array, "m b B"], Int[Array, "m B"]]:
        """Rows of xi and modes of slip where the contacts `which` slide in these
        directions.

        In the plane xi stays, and the mode is the sign of the direction. In space the
        rows of xi become 0 and the angle; a contact whose A / x is above half of
        `swift` drags.
        """
        if not self.in_space:
            sign = jnp.sign(direction[:, 0]).astype(slip.dtype)
            return xi, jnp.where(which, sign, slip)
        angle = angle_of(jnp.where(which[:, None], direction, 0.0))
        rows = jnp.stack([jnp.zeros_like(angle), angle], 1)
        half = 2 * QUARTER * self.swift
        depth = self.rows(y).x
        swift = self.aim(y) > half * self.friction * depth
        mode = jnp.where(swift, Slide.DRAGS, Slide.SLIDES)
        new_xi = jnp.where(which[:, None], rows, xi)
        return new_xi, jnp.where(which, mode, slip)

    def closed(
        self,
        modes: Int[Array, "modes B"],
        y: Float[Array, "n B"],
        which: Bool[Array, "m B"],
    ) -> tuple[Int[Array, "modes B"], Float[Array, "n B"]]:
        """Modes and state where the contacts `which` have closed: they hold, or slide
        at once, where they have slip and no friction, or a spring that leaves the cone.

        At x = 0 the cone widens at the rate mu |gamma|, the spring at kappa eta |u|.
        """
        x, g, _ = self.rows(y)
        u = self.by_contact(self.slip(y))
        constant = jax.lax.stop_gradient(u)
        speed = jnp.sqrt(jnp.sum(constant**2, axis=1))
        faster = self.steep * speed > self.friction * jnp.abs(g)
        leaves_cone = (faster & (x <= 0)) | (self.friction <= 0)
        at_once = which & (speed > 0) & leaves_cone
        slip = self.modes(modes).slip
        spring = self.spring(y)
        xi, slip = self.sliding_from(at_once, u, y, slip, spring)
        return self.with_slip_modes(modes, slip), self.with_spring(y, xi)

    def contact_states(
        self, modes: Int[Array, "modes B"], y: Float[Array, "n B"]
    ) -> ContactStates:
        """Forces, velocities, slip and energies of the springs in a state."""
        const = self.constants(modes)
        forces = self.forces(const, modes, y)
        states = ContactFlow.contact_states(self, modes, y)
        side = self.by_contact(forces.side)
        square = jnp.sum(side**2, axis=1)
        # twice the energy, omega k_t xi^2 over omega^2:
        # lambda^2 x / (kappa eta omega F)
        stiffness = self.steep * self.omega * forces.normal
        depth = jnp.maximum(self.rows(y).x, 0.0)
        energy = quotient(square * depth, stiffness, where=stiffness > 0)
        return states._replace(
            tangential_force=forces.side,
            tangential_impulse=self.side_impulse(y),
            slip=self.slip(y),
            tangential_energy=energy,
            rate=const.frozen.unit / forces.haste,
        )

    # ---- the end

    @property
    def at_once(self) -> bool:
        """False: no impact with a spring is in closed form."""
        return False

    @property
    def wedges(self) -> bool:
        """False: `settled` ends contacts that stick rigidly."""
        return False
