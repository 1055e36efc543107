"""Contacts with Coulomb friction in space: the flow of `friction_flow.py` with two
tangents each.

With c = mu F, the direction d of slip, and n at right angles to it, slip u = r d obeys

    r' = d . a,   r angle' = n . a,   a = K_tn F + K_tt lambda,   lambda = -c d

whose angle turns at a rate ~ c K_tt / r: stiff where slip is slow. A loaded contact has
therefore one of three modes, and its two rows of slip mean

    STICKS   0
    SLIPS    ln r and angle, while the whole field advances in a time that is shortened
    by
             1 + sum (|a| + c K_tt) / r over the contacts that slip: no rate is large
             then, and slip comes to a stop at the FLOOR after a few steps, as ln r
             falls at a steady rate
    CREEPS   r and angle, 0 included: r is so small that the direction follows from the
        forces, to
             first order in r. It obeys n . a = r angle': the angle is a state that
             drifts as the solution drifts, and one Newton step corrects the direction.

and of a contact without load the Cartesian slip velocity. Slip sets in by creeping,
from r = 0 where stick ends; where the stiffness c K_tt / r has fallen enough, it SLIPS.
Where several contacts stick redundantly (two corners of one body) one may reach its
cone while others hold it: it
creeps with r = 0. Sticking forces are eliminated from the field once a step.
"""

import dataclasses
import enum
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from jimpact.events.contact_flow import ContactStates, Frozen, as_pytree
from jimpact.events.friction_flow import FrictionFlow
from jimpact.numerics.dense import product, pseudoinverse, solve, times, unit
from jimpact.numerics.driver import SLOTS_IN_SPACE
from jimpact.numerics.friction import distribute
from jimpact.numerics.stepper import any_of, total
from jimpact.tools.loops import cond


class Slip(enum.IntEnum):
    """Motion of a contact with friction along its plane, see above."""

    STICKS = 0
    SLIPS = 1
    CREEPS = 2


# Speeds in tolerances: slip below FLOOR has stopped; contacts below REST may stick when
# others stop. Ten times more would lose a hundredth, a tenth of the tolerance.
FLOOR = 1e-3
REST = 1e-2
# Creep ends where the rate c K_tt / r has fallen to tolerance^-1/2 / CREEP: its
# direction is wrong by the square of r over that. Ten times more: some real impacts err
# by 60 tolerances.
CREEP = 0.1
# Longest step, over the largest rate. A step of order 8 is stable up to 6; beyond,
# values do not show it, derivatives do.
STABLE = 4.0
# Errors that rows of slip may have: of ln r and angle, however slow the slip; of the
# angle of creep, in square roots of the tolerance, as it is corrected soon. Ten times
# more: directions of slow slip become visible in the velocities.
LOOSE = 1e-3
SLOW_ANGLE = 1e-2
# Added to the scaled matrix of creep, which is singular where friction does not turn
# directions back. Ten times more would change regular directions by 1e-9.
LEAST_STIFFNESS = 1e-10


class Reduced(NamedTuple):
    """The field with sticking forces eliminated: `a = pull F + tangent lambda` of those
    that slide.

    gamma' = coupling F + normal_tangent lambda;  forces of sticking -(held F + carried
    lambda).
    """

    frozen: Frozen
    coupling: Float[Array, "m m B"]  # (m, m, B)
    normal_tangent: Float[Array, "m t B"]  # (m, t, B)
    pull: Float[Array, "t m B"]  # (t, m, B)
    tangent: Float[Array, "t t B"]  # (t, t, B)
    held: Float[Array, "t m B"]  # (t, m, B)
    carried: Float[Array, "t t B"]  # (t, t, B)


class SlipRates(NamedTuple):
    """Forces and the rates of slip in the flow's own time before it is shortened, t = 2
    m.
    """

    force: Float[Array, "m B"]  # F
    sliding: Float[Array, "t B"]  # lambda of those that slide
    holding: Float[Array, "t B"]  # lambda of those that stick
    rate: Float[Array, "m 2 B"]  # of the rows of slip
    direction: Float[Array, "m 2 B"]  # of slip
    # its rate; of those that creep to first order in their deviation
    turning: Float[Array, "m B"]
    haste: Float[Array, "1 B"]  # >= 1: by how much time is shortened


def pairs(rows: Shaped[Array, "t *B"]) -> Shaped[Array, "m 2 *B"]:
    """The two tangential rows of each contact, side by side."""
    return rows.reshape(-1, 2, *rows.shape[1:])


def flat(pair: Shaped[Array, "m 2 *B"]) -> Shaped[Array, "t *B"]:
    """Tangential rows, contact by contact: the inverse of `pairs`."""
    return pair.reshape(-1, *pair.shape[2:])


def twice(rows: Shaped[Array, "m *B"]) -> Shaped[Array, "t *B"]:
    """Values of contacts, for both of their tangents."""
    return jnp.repeat(rows, 2, axis=0)


def length(pair: Float[Array, "m 2 B"]) -> Float[Array, "m B"]:
    """Lengths |u_j|, with derivative 0 at 0."""
    square = pair[:, 0] ** 2 + pair[:, 1] ** 2
    some = square > 0
    return jnp.where(some, jnp.sqrt(jnp.where(some, square, 1.0)), 0.0)


def perpendicular_to(direction: Float[Array, "m 2 B"]) -> Float[Array, "m 2 B"]:
    """Vectors (-y, x): (x, y) turned by a right angle."""
    return jnp.stack([-direction[:, 1], direction[:, 0]], 1)


@jax.custom_jvp
def towards(angle: Float[Array, "m B"]) -> Float[Array, "m 2 B"]:
    """Unit vectors (cos, sin) in this direction; tangents evaluate no cosine again."""
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)], 1)


@towards.defjvp
def _turning(
    angle: Any, rate: Any
) -> tuple[Float[Array, "m 2 B"], Float[Array, "m 2 B"]]:
    """Unit vectors `d`, and their tangents `rate n`, n at right angles to d."""
    direction = towards(*angle)
    return direction, perpendicular_to(direction) * rate[0][:, None]


def polar(
    angle: Float[Array, "m B"],
) -> tuple[Float[Array, "m 2 B"], Float[Array, "m 2 B"]]:
    """Unit vectors in this direction, and at right angles to it."""
    direction = towards(angle)
    return direction, perpendicular_to(direction)


def turned(
    vectors: tuple[Float[Array, "m 2 B"], Float[Array, "m 2 B"]],
    angle: Float[Array, "m B"],
) -> tuple[Float[Array, "m 2 B"], Float[Array, "m 2 B"]]:
    """Unit vectors of `polar`, turned by small angles a, tan(a / 2) ~ a / 2: without a
    cosine.
    """
    direction, perpendicular = vectors
    half = (angle / 2)[:, None]
    cosine = (1 - half**2) / (1 + half**2)
    sine = 2 * half / (1 + half**2)
    return (
        cosine * direction + sine * perpendicular,
        cosine * perpendicular - sine * direction,
    )


def angle_of(pair: Float[Array, "m 2 B"]) -> Float[Array, "m B"]:
    """Angles of directions; 0, without a derivative, of the zero vector."""
    some = (pair[:, 0] != 0) | (pair[:, 1] != 0)
    return jnp.arctan2(
        jnp.where(some, pair[:, 1], 0.0), jnp.where(some, pair[:, 0], 1.0)
    )


def dot(a: Float[Array, "m 2 B"], b: Float[Array, "m 2 B"]) -> Float[Array, "m B"]:
    """Scalar products of the vectors of each contact."""
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1]


@as_pytree
@dataclasses.dataclass(kw_only=True)
class SlipFlow(FrictionFlow):
    """The motion of m contacts with friction in space, t = 2 m."""

    # normal_tangent: K_nt (m, 2 m, B); tangent: K_tt (2 m, 2 m, B)

    longest = STABLE
    slots = SLOTS_IN_SPACE

    # ---- the state: x, g, p (m each), slip, its impulse (2 m each), time

    def slip(self, y: Float[Array, "driving B"]) -> Float[Array, "m 2 B"]:
        """Both rows of slip of each contact."""
        m = self.contacts
        return pairs(y[3 * m : 5 * m])

    def with_slip(
        self, y: Float[Array, "n B"], q: Float[Array, "m 2 B"]
    ) -> Float[Array, "n B"]:
        """The state with these rows of slip."""
        m = self.contacts
        return jnp.concatenate([y[: 3 * m], flat(q), y[5 * m :]])

    def start_with(
        self, gamma: Float[Array, "m B"], x: Float[Array, "m B"], u: Float[Array, "t B"]
    ) -> tuple[Int[Array, "modes B"], Float[Array, "n B"]]:
        """Modes and state before the impact, from gamma, indentations x and slip u."""
        m = self.contacts
        modes, y = self.start(gamma, x)
        modes = jnp.concatenate([modes, jnp.zeros_like(modes[:m])])
        y = jnp.concatenate([y[: 3 * m], u, jnp.zeros_like(u), y[3 * m :]])
        loaded = self.loaded(modes)
        return self.decided(modes, y, jnp.zeros_like(loaded), loaded)

    def sliding(
        self, modes: Int[Array, "modes B"]
    ) -> tuple[Bool[Array, "m B"], Bool[Array, "m B"], Bool[Array, "m B"]]:
        """Masks of the loaded contacts that stick, that slip, and that creep."""
        slip = modes[2 * self.contacts :]
        loaded = self.loaded(modes)
        sticks, slips, creeps = (loaded & (slip == kind) for kind in Slip)
        return sticks, slips, creeps

    def speed(
        self, modes: Int[Array, "modes B"], q: Float[Array, "m 2 B"]
    ) -> Float[Array, "m B"]:
        """Speeds r of slip of loaded contacts; 0 of those that stick."""
        _, slips, creeps = self.sliding(modes)
        return jnp.where(
            slips,
            jnp.exp(jnp.where(slips, q[:, 0], 0.0)),
            jnp.where(creeps, q[:, 0], 0.0),
        )

    def allowance(
        self, modes: Int[Array, "modes B"], y: Float[Array, "n B"]
    ) -> Float[Array, "n B"]:
        """Allowed error of each row, in tolerances; of ln r and angle it grows as 1 /
        r.
        """
        m = self.contacts
        one = jnp.ones_like(y[: self.contacts])
        _, slips, creeps = self.sliding(modes)
        relative = LOOSE / self.tolerance
        steep = jnp.where(
            slips, jnp.exp(-jnp.where(slips, self.slip(y)[:, 0], 0.0)), 1.0
        )
        steep = jnp.clip(steep, 1.0, jnp.maximum(relative, 1.0))
        turning = jnp.where(creeps, SLOW_ANGLE / jnp.sqrt(self.tolerance), steep)
        rows = flat(jnp.stack([steep, turning], 1))
        return jnp.concatenate([one, one, one, rows, jnp.ones_like(y[5 * m :])])

    # ---- the protocol

    def constants(self, modes: Int[Array, "modes B"]) -> Any:
        """The field without the forces of sticking, which are
        `-(Z K_tn F + Z K_tt lambda)`.

        Z is the pseudoinverse of K_tt in the contacts that stick; lambda are the
        sliding forces.
        """
        stick, slips, creeps = self.sliding(modes)
        free = twice(slips | creeps | ~self.loaded(modes))
        z = pseudoinverse(self.tangent, twice(stick))
        up = jnp.swapaxes(self.normal_tangent, 0, 1)
        held = product(z, up)
        carried = product(z, self.tangent)
        coupling = self.coupling.matrix  # type: ignore[union-attr]
        pull = up - product(self.tangent, held)
        tangent = self.tangent - product(self.tangent, carried)
        return Reduced(
            frozen=self.normal_constants(modes),
            coupling=coupling - product(self.normal_tangent, held),
            normal_tangent=self.normal_tangent - product(self.normal_tangent, carried),
            pull=jnp.where(free[:, None], pull, 0.0),
            tangent=jnp.where(free[:, None] & free[None], tangent, 0.0),
            held=held,
            carried=carried,
        )

    def motion(
        self, const: Reduced, modes: Int[Array, "modes B"], y: Float[Array, "driving B"]
    ) -> SlipRates:
        """Forces, and the rates of slip `r' = d . a`, `angle' = n . a / r` of those
        that slip.
        """
        frozen = const.frozen
        x, g, _ = self.rows(y)
        stick, slips, creeps = self.sliding(modes)
        slides = slips | creeps
        q = self.slip(y)
        f = self.force(frozen, x, g)
        c = jnp.where(slides, self.friction * f, 0.0)  # mu F
        angle = jnp.where(slides, q[:, 1], 0.0)
        r = self.speed(modes, q)
        over_r = jnp.where(slips, frozen.unit / jnp.where(slips, r, 1.0), 0.0)
        frame = polar(angle)
        drift, correction = self._creep(const, modes, y, f, c, frame, over_r)
        direction, perpendicular = turned(frame, correction)
        side = flat(-c[:, None] * direction)
        a = pairs(times(const.pull, f) + times(const.tangent, side))  # u'
        # r' = d . a and r angle' = n . a
        grows = dot(direction, a)
        turns = dot(perpendicular, a)
        rate = jnp.stack(
            [
                jnp.where(
                    slips, over_r * grows, jnp.where(creeps, frozen.unit * grows, 0.0)
                ),
                jnp.where(slips, over_r * turns, drift + correction),
            ],
            1,
        )
        # rows of contacts without load are u itself
        rate = jnp.where(
            self.loaded(modes)[:, None],
            rate,
            (frozen.unit * jnp.ones_like(x))[:, None] * a,
        )
        haste = 1 + total(over_r * (length(a) + 2 * self._stiffness(const, c)))
        holding = self._holding(const, stick, f, side)
        turning = jnp.where(slips, over_r * turns, drift)
        return SlipRates(f, side, holding, rate, direction, turning, haste)

    def _stiffness(self, const: Reduced, c: Float[Array, "m B"]) -> Float[Array, "m B"]:
        """Stiffness c K_tt of the angle, K_tt the mean of the two directions of a
        contact.
        """
        rows = np.arange(2 * self.contacts)
        diagonal = pairs(const.tangent[rows, rows])
        return c * (diagonal[:, 0] + diagonal[:, 1]) / 2

    def _holding(
        self,
        const: Reduced,
        stick: Bool[Array, "m B"],
        f: Float[Array, "m B"],
        side: Float[Array, "t B"],
    ) -> Float[Array, "t B"]:
        """Forces of sticking `-(held F + carried lambda)`; rates from rates of F and
        lambda.
        """
        holding = times(const.held, f)
        if self.contacts > 1:  # one contact alone sticks or slides
            holding = holding + times(const.carried, side)
        return jnp.where(twice(stick), -holding, 0.0)

    def _blocks(self, const: Reduced) -> Float[Array, "m 2 m 2 B"]:
        """K_tt in blocks of two rows for each contact."""
        m = self.contacts
        return const.tangent.reshape(m, 2, m, 2, *const.tangent.shape[2:])

    def _creep(
        self,
        const: Reduced,
        modes: Int[Array, "modes B"],
        y: Float[Array, "driving B"],
        f: Float[Array, "m B"],
        c: Float[Array, "m B"],
        frame: tuple[Float[Array, "m 2 B"], Float[Array, "m 2 B"]],
        over_r: Float[Array, "m B"],
    ) -> tuple[Float[Array, "m B"], Float[Array, "m B"]]:
        """Rates at which the directions of creep drift, and their deviation from those
        of `frame`.

        `c` is mu F, `frame` the directions d and n, `over_r` 1 / r of the contacts that
        slip. With G = n . a of all contacts that creep, G' at fixed angles and J =
        -dG/d angle, the quasi-static solution G = 0 drifts by J^-1 G'. The directions
        lag behind it by
        (J + diag(r'))^-1 r drift, as r angle' = G and r grows at the rate r'.
        """
        frozen = const.frozen
        x, g, _ = self.rows(y)
        *_, creeps = self.sliding(modes)
        r = jnp.where(creeps, self.slip(y)[:, 0], 0.0)
        direction, perpendicular = frame

        def acceleration(
            f: Float[Array, "m B"], side: Float[Array, "m 2 B"]
        ) -> Float[Array, "m 2 B"]:
            """Accelerations `u' = K_tn F + K_tt lambda` of slip by normal and sliding
            forces.
            """
            return pairs(times(const.pull, f) + times(const.tangent, flat(side)))

        side = -c[:, None] * direction
        a = acceleration(f, side)
        # r' and G
        grows = dot(direction, a)
        turns = dot(perpendicular, a)
        # G' from the rates of F, of the radii c, and of the directions that slip
        pull = times(const.coupling, f) + times(const.normal_tangent, flat(side))
        rates = (frozen.closing * g, frozen.ratio * pull)
        _, df = jax.jvp(lambda x, g: self.force(frozen, x, g), (x, g), rates)
        dc = jnp.where(c > 0, self.friction * df, 0.0)
        swung = (c * over_r * turns)[:, None] * perpendicular
        changes = dot(perpendicular, acceleration(df, -dc[:, None] * direction - swung))
        # J = n K_tt n c + diag(r'), all in units of the largest entry: forces begin at
        # 0
        blocks = self._blocks(const)
        j = sum(
            perpendicular[:, i][:, None]
            * blocks[:, i, :, k]
            * perpendicular[:, k][None]
            for i in range(2)
            for k in range(2)
        )
        j = jnp.where(creeps[:, None] & creeps[None], j * c[None], 0.0)
        size = jnp.max(
            jnp.max(jnp.abs(j), axis=1) + jnp.abs(grows), axis=0, keepdims=True
        )
        size = jnp.where(size > 0, size, 1.0)
        growth = jnp.where(creeps, grows / size, 0.0)
        j, eye = j / size[None], unit(j)
        turns, changes = (jnp.where(creeps, z / size, 0.0) for z in (turns, changes))
        away = jnp.where(creeps, LEAST_STIFFNESS, 1.0)
        jacobian = j + eye * (growth + away)[:, None]
        drift, newton = (solve(jacobian, z[:, None])[:, 0] for z in (changes, turns))
        lagging = jnp.where(creeps, frozen.unit, 1.0)[:, None] * (
            j + eye * (2 * growth + away)[:, None]
        )
        lag = solve(lagging + eye * LEAST_STIFFNESS, (r * drift / size)[:, None])[:, 0]
        correction = jnp.clip(newton - lag, -1.0, 1.0)
        return jnp.where(creeps, drift, 0.0), jnp.where(creeps, correction, 0.0)

    def contact_states(
        self, modes: Int[Array, "modes B"], y: Float[Array, "n B"]
    ) -> ContactStates:
        """Forces, velocities and slip in a state."""
        m = self.contacts
        x, g, p = self.rows(y)
        const = self.constants(modes)
        loaded = self.loaded(modes)
        q = self.slip(y)
        motion = self.motion(const, modes, y)
        cartesian = (
            self.speed(modes, q)[:, None] * polar(jnp.where(loaded, q[:, 1], 0.0))[0]
        )
        return ContactStates(
            force=motion.force,
            indentation=x,
            impulse=p,
            gap_velocity=const.frozen.scale * g,
            tangential_force=motion.sliding + motion.holding,
            tangential_impulse=y[5 * m : 7 * m],
            slip=flat(jnp.where(loaded[:, None], cartesian, q)),
            tangential_energy=y[:0],
            rate=const.frozen.unit / motion.haste,
        )

    def field(
        self, const: Reduced, modes: Int[Array, "modes B"], y: Float[Array, "driving B"]
    ) -> Float[Array, "n B"]:
        """Rates of x, g, p, slip, its impulses and time, all over `haste`: in shortened
        time.

        Equation: `g' = ratio (G F + K_nt lambda)`, without the forces of sticking in K.
        """
        _, g, _ = self.rows(y)
        frozen = const.frozen
        motion = self.motion(const, modes, y)
        pull = times(const.coupling, motion.force) + times(
            const.normal_tangent, motion.sliding
        )
        dy = jnp.concatenate(
            [
                frozen.closing * g,
                frozen.ratio * pull,
                frozen.unit * motion.force,
                flat(motion.rate),
                frozen.unit * (motion.sliding + motion.holding),
                frozen.unit,
            ]
        )
        return dy / motion.haste

    def margins(
        self, const: Reduced, modes: Int[Array, "modes B"], y: Float[Array, "driving B"]
    ) -> Float[Array, "k B"]:
        """Margins of the normal flow; until slip stops; until stick, or creep, ends (m
        each).
        """
        motion = self.motion(const, modes, y)
        return self._margins_of(const, modes, y, motion.force, motion.holding)

    def _margins_of(
        self,
        const: Reduced,
        modes: Int[Array, "modes B"],
        y: Float[Array, "driving B"],
        f: Float[Array, "m B"],
        holding: Float[Array, "t B"],
    ) -> Float[Array, "k B"]:
        """The margins in a state, given its normal forces F and its forces of sticking.

        slip stops   ln r - ln FLOOR tolerance; r + FLOOR tolerance of creep
        stick ends   (mu F - |lambda|) / sum F
        creep ends   (slow - r) / (slow + |r|), r less 2 FLOOR tolerance; see CREEP for
        slow
        """
        r = self.slip(y)[:, 0]
        stick, slips, creeps = self.sliding(modes)
        floor = FLOOR * self.tolerance
        stops = jnp.where(slips, r - jnp.log(floor), jnp.where(creeps, r + floor, 1.0))
        # all forces of an impact vanish together: the room in the cone is one in parts
        # of them
        size = total(f)
        room = self.friction * f - length(pairs(holding))
        room = jnp.where(size > 0, room / jnp.where(size > 0, size, 1.0), 1.0)
        stiffness = self._stiffness(
            const, jnp.where(slips | creeps, self.friction * f, 0.0)
        )
        slow = CREEP * jnp.sqrt(self.tolerance) * const.frozen.unit * stiffness
        creep = jnp.where(creeps, r, 0.0) - 2 * floor
        slow = (slow - creep) / (slow + jnp.abs(creep))
        ends = jnp.where(stick, room, jnp.where(creeps, slow, 1.0))
        return jnp.concatenate(
            [self.normal_margins(const.frozen, modes, y), stops, ends]
        )

    def margins_with_rates(
        self,
        const: Reduced,
        modes: Int[Array, "modes B"],
        y: Float[Array, "driving B"],
        dy: Float[Array, "driving B"],
        target: Bool[Array, "k B"],
    ) -> tuple[Float[Array, "k B"], Float[Array, "k B"]]:
        """The margins, and their rates from those of the forces.

        Forces of sticking depend on the directions of creep, whose rates are those of
        first order, but where a step lands on the rim of a cone.
        """
        m = self.contacts
        motion = self.motion(const, modes, y)
        stick, slips, creeps = self.sliding(modes)
        x, g, _ = self.rows(y)
        dx, dg, _ = self.rows(dy)
        _, df = jax.jvp(lambda x, g: self.force(const.frozen, x, g), (x, g), (dx, dg))
        dc = jnp.where(slips | creeps, self.friction * df, 0.0)[:, None]
        c = jnp.where(slips | creeps, self.friction * motion.force, 0.0)
        turned = (c * motion.turning / motion.haste)[:, None] * perpendicular_to(
            motion.direction
        )
        dside = -flat(dc * motion.direction + turned)
        value, rates = jax.jvp(
            lambda y, f, holding: self._margins_of(const, modes, y, f, holding),
            (y, motion.force, motion.holding),
            (dy, df, self._holding(const, stick, df, dside)),
        )
        if m == 1:
            return value, rates
        needed = jnp.any(target[3 * m :] & stick & any_of(creeps))
        rates = cond(
            needed,
            lambda: jax.jvp(lambda z: self.margins(const, modes, z), (y,), (dy,))[1],
            lambda: rates,
        )
        return value, rates

    def switch(
        self,
        modes: Int[Array, "modes B"],
        y: Float[Array, "n B"],
        which: Bool[Array, "k B"],
    ) -> tuple[Int[Array, "modes B"], Float[Array, "n B"]]:
        """Modes and state after events; slip changes its variables with the mode.

        A contact that opens keeps u = r d, one that breaks loose creeps from r = 0, and
        creep that ends goes on with ln r.
        """
        m = self.contacts
        stopped = which[2 * m : 3 * m]
        ended = which[3 * m :]
        stick, slips, creeps = self.sliding(modes)
        loaded = self.loaded(modes)
        q = self.slip(y)
        slip = modes[2 * m :]
        cartesian = (
            self.speed(modes, q)[:, None] * polar(jnp.where(loaded, q[:, 1], 0.0))[0]
        )
        breaks = stick & ended
        grows = creeps & ended
        # a contact breaks loose against the force that held it, Newton's method sees to
        # the rest
        const = self.constants(modes)
        f = self.force(const.frozen, *self.rows(y)[:2])
        side = (
            jnp.where(slips | creeps, -self.friction * f, 0.0)[:, None]
            * polar(q[:, 1])[0]
        )
        pulled = pairs(times(const.held, f) + times(const.carried, flat(side)))
        away = angle_of(jnp.where(breaks[:, None], pulled, 0.0))
        logarithm = jnp.log(jnp.where(grows, q[:, 0], 1.0))
        q = jnp.where(breaks[:, None], jnp.stack([jnp.zeros_like(away), away], 1), q)
        q = jnp.where(grows[:, None], jnp.stack([logarithm, q[:, 1]], 1), q)
        slip = jnp.where(breaks, Slip.CREEPS, jnp.where(grows, Slip.SLIPS, slip))
        after, y = self.normal_switch(modes, y, which[: 2 * m])
        after = jnp.concatenate([after[: 2 * m], slip.astype(after.dtype)])
        remains = self.loaded(after)
        q = jnp.where((loaded & ~remains)[:, None], cartesian, q)
        return self.decided(
            after, self.with_slip(y, q), stopped & remains, remains & ~loaded
        )

    def decided(
        self,
        modes: Int[Array, "modes B"],
        y: Float[Array, "n B"],
        stopped: Bool[Array, "m B"],
        closed: Bool[Array, "m B"],
    ) -> tuple[Int[Array, "modes B"], Float[Array, "n B"]]:
        """Modes and state once it is decided which contacts stick, and where others
        creep to.

        `distribute` decides anew where slip has `stopped`, or a contact has `closed`
        without slip, from the forces of a moment later.
        """
        m = self.contacts
        q = self.slip(y)
        slip = modes[2 * m :]
        loaded = self.loaded(modes)
        stick = loaded & (slip == Slip.STICKS) & ~closed
        r = jnp.where(closed, length(q), self.speed(modes, q))
        resting = loaded & (r <= REST * self.tolerance) & ~stick
        # contacts that close with slip: its Cartesian rows become ln r and angle
        slips = closed & ~resting
        moving = jnp.where(slips[:, None], q, 1.0)
        q = jnp.where(
            slips[:, None], jnp.stack([jnp.log(length(moving)), angle_of(moving)], 1), q
        )
        slip = jnp.where(slips, Slip.SLIPS, slip)
        check = any_of(stopped | (closed & resting))
        to_check = check & loaded & (stopped | resting | stick)
        constant, state = jax.lax.stop_gradient((self, y))
        f = constant.soon(modes, state)
        most = constant.friction * f
        # b = u' by normal forces and by the friction of contacts that slide on
        slides = jnp.where(
            (to_check | ~loaded)[:, None], 0.0, polar(jax.lax.stop_gradient(q[:, 1]))[0]
        )
        b = times(jnp.swapaxes(constant.normal_tangent, 0, 1), f)
        b = b - times(constant.tangent, flat(most[:, None] * slides))
        inside, towards = distribute(constant.tangent, b, most, to_check)
        towards = angle_of(pairs(towards))
        # stick is (0, 0), creep begins at r = 0
        begins = jnp.stack(
            [jnp.zeros_like(towards), jnp.where(inside, 0.0, towards)], 1
        )
        lost = jnp.where((closed & resting)[:, None], q, 0.0)
        q = jnp.where(to_check[:, None], begins, q)
        checked = jnp.where(inside, Slip.STICKS, Slip.CREEPS)
        slip = jnp.where(to_check, checked, slip).astype(modes.dtype)
        modes = jnp.concatenate([modes[: 2 * m], slip])
        pressed = to_check & (most > 0)
        held = pressed & inside
        begun = pressed & closed & resting & ~inside
        return modes, self._stopped(modes, self.with_slip(y, q), lost, held, begun)

    def _stopped(
        self,
        modes: Int[Array, "modes B"],
        y: Float[Array, "n B"],
        lost: Float[Array, "m 2 B"],
        held: Bool[Array, "m B"],
        begun: Bool[Array, "m B"],
    ) -> Float[Array, "n B"]:
        """The state after slips `lost`, whose values are 0, have been taken from
        contacts `held`.

        As in the plane: the tangents of these slips are taken by a tangential impulse;
        of contacts that have `begun` to slide those across their direction, which
        friction takes at once.
        """
        m = self.contacts
        x, g, p = self.rows(y)
        q = self.slip(y)
        along, across = polar(jnp.where(begun, q[:, 1], 0.0))
        # of each contact; the tangents where it sticks
        frame = jnp.stack([along, across], 2)
        blocks = self.tangent.reshape(m, 2, m, 2, -1)
        blocks = jnp.einsum("iaxB,iajbB,jbyB->ixjyB", frame, blocks, frame)
        rows = flat(jnp.stack([held, held | begun], 1))
        right = flat(-jnp.einsum("iaxB,iaB->ixB", frame, lost))
        taken = times(pseudoinverse(blocks.reshape(self.tangent.shape), rows), right)
        side = flat(jnp.einsum("iaxB,ixB->iaB", frame, pairs(taken)))
        side = side - jax.lax.stop_gradient(side)
        g = g + self.as_rows(modes, times(self.normal_tangent, side))
        du = pairs(times(self.tangent, side))
        _, slips, creeps = self.sliding(modes)
        along, across = polar(jnp.where(slips | creeps, q[:, 1], 0.0))
        r = jnp.where(slips, self.speed(modes, q), 1.0)
        turn = jnp.where(slips, dot(across, du), 0.0)
        polars = jnp.stack([dot(along, du), turn], 1) / r[:, None]
        free = ~self.loaded(modes)
        q = q + jnp.where(
            (slips | creeps)[:, None], polars, jnp.where(free[:, None], du, 0.0)
        )
        return jnp.concatenate([x, g, p, flat(q), y[5 * m : 7 * m] + side, y[7 * m :]])
