"""Contacts with Coulomb friction in space: the flow of `friction_flow.py` with two
tangents each.

With c = mu F, the direction d of slip, and n at right angles to it, slip u = r d obeys

    r' = d . a,   r angle' = n . a,   a = K_tn F + K_tt lambda,   lambda = -c d

whose angle turns at a rate ~ c K_tt / r: stiff where slip is slow. A loaded contact has
therefore one of three modes, and its two rows of slip mean

    STICKS   0
    SLIPS    ln r and angle, while the whole field advances in a time that is shortened
             by 1 + sum (|a| + c K_tt) / r over the contacts that slip: no rate is large
             then, and slip comes to a stop at the FLOOR after a few steps, as ln r
             falls at a steady rate
    CREEPS   r and angle, 0 included: r is so small that the direction follows from the
             forces, to first order in r. It obeys n . a = r angle': the angle is a
             state that drifts as the solution drifts, and one Newton step corrects the
             direction.

and of a contact without load the Cartesian slip velocity. Slip sets in by creeping,
from r = 0 where stick ends; where the stiffness c K_tt / r has fallen enough, it SLIPS.
Where several contacts stick redundantly (two corners of one body) one may reach its
cone while others hold it: it creeps with r = 0. Sticking forces are eliminated from the
field once a step.
"""

import dataclasses
import enum
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from jimpact.events.contact_flow import ContactStates, Frozen, as_pytree, largest_of
from jimpact.events.friction_flow import FrictionFlow, FrictionRows
from jimpact.numerics.dense import product, pseudoinverse, solve, times, unit
from jimpact.numerics.driver import SLOTS_IN_SPACE
from jimpact.numerics.friction import distribute
from jimpact.numerics.stepper import any_of, total
from jimpact.tools.loops import cond
from jimpact.tools.masks import quotient


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

    `gamma' = coupling F + normal_tangent lambda`; forces of sticking are
    `-(held F + carried lambda)`.
    """

    frozen: Frozen
    coupling: Float[Array, "m m B"]
    normal_tangent: Float[Array, "m t B"]
    pull: Float[Array, "t m B"]
    tangent: Float[Array, "t t B"]
    held: Float[Array, "t m B"]
    carried: Float[Array, "t t B"]


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


def parts(
    pair: Shaped[Array, "m 2 *B"],
) -> tuple[Shaped[Array, "m *B"], Shaped[Array, "m *B"]]:
    """Both rows of each contact, apart."""
    return pair[:, 0], pair[:, 1]


def length(pair: Float[Array, "m 2 B"]) -> Float[Array, "m B"]:
    """Lengths |u_j|, with derivative 0 at 0."""
    x, y = parts(pair)
    square = x**2 + y**2
    some = square > 0
    positive = jnp.where(some, square, 1.0)
    return jnp.where(some, jnp.sqrt(positive), 0.0)


def perpendicular_to(direction: Float[Array, "m 2 B"]) -> Float[Array, "m 2 B"]:
    """Vectors (-y, x): (x, y) turned by a right angle."""
    x, y = parts(direction)
    return jnp.stack([-y, x], 1)


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
    x, y = parts(pair)
    some = (x != 0) | (y != 0)
    ahead = jnp.where(some, x, 1.0)
    return jnp.arctan2(jnp.where(some, y, 0.0), ahead)


def dot(a: Float[Array, "m 2 B"], b: Float[Array, "m 2 B"]) -> Float[Array, "m B"]:
    """Scalar products of the vectors of each contact."""
    x_a, y_a = parts(a)
    x_b, y_b = parts(b)
    return x_a * x_b + y_a * y_b


def _solved(
    matrix: Float[Array, "m m B"], right: Float[Array, "m B"]
) -> Float[Array, "m B"]:
    """x with `matrix x = right`."""
    return solve(matrix, right[:, None])[:, 0]


@as_pytree
@dataclasses.dataclass(kw_only=True)
class SlipFlow(FrictionFlow):
    """The motion of m contacts with friction in space, t = 2 m."""

    # normal_tangent: K_nt (m, 2 m, B); tangent: K_tt (2 m, 2 m, B)

    longest = STABLE
    slots = SLOTS_IN_SPACE

    # ---- the state: x, g, p (m each), slip, its impulse (2 m each), time

    def slip(self, y: Float[Array, "driving B"]) -> Float[Array, "m 2 B"]:
        """Both rows of slip of each contact: r or ln r, and angle; see above."""
        return pairs(self.slip_rows(y))

    def with_slip(
        self, y: Float[Array, "n B"], q: Float[Array, "m 2 B"]
    ) -> Float[Array, "n B"]:
        """The state with these rows of slip."""
        new = self.friction_rows(y)._replace(u=flat(q))
        return new.packed()

    def start_with(
        self, gamma: Float[Array, "m B"], x: Float[Array, "m B"], u: Float[Array, "t B"]
    ) -> tuple[Int[Array, "modes B"], Float[Array, "n B"]]:
        """Modes and state before the impact, from gamma, indentations x and slip u."""
        modes, y = self.start(gamma, x)
        modes = self.with_slip_modes(modes, jnp.full(x.shape, Slip.STICKS))
        y = self.with_tangents(y, u)
        loaded = self.loaded(modes)
        return self.decided(modes, y, jnp.zeros_like(loaded), loaded)

    def sliding(
        self, modes: Int[Array, "modes B"]
    ) -> tuple[Bool[Array, "m B"], Bool[Array, "m B"], Bool[Array, "m B"]]:
        """Masks of the loaded contacts that stick, that slip, and that creep."""
        slip = self.modes(modes).slip
        loaded = self.loaded(modes)
        sticks, slips, creeps = (loaded & (slip == kind) for kind in Slip)
        return sticks, slips, creeps

    def speed(
        self, modes: Int[Array, "modes B"], q: Float[Array, "m 2 B"]
    ) -> Float[Array, "m B"]:
        """Speeds r of slip of loaded contacts, of rows q; 0 of those that stick, or are
        not loaded.
        """
        _, slips, creeps = self.sliding(modes)
        r, _ = parts(q)  # ln r of those that slip
        creep = jnp.where(creeps, r, 0.0)
        speed = jnp.exp(jnp.where(slips, r, 0.0))
        return jnp.where(slips, speed, creep)

    def cartesian(
        self, modes: Int[Array, "modes B"], q: Float[Array, "m 2 B"]
    ) -> Float[Array, "m 2 B"]:
        """Slip u = r d of loaded contacts, of rows q."""
        _, angle = parts(q)
        angle_of_loaded = jnp.where(self.loaded(modes), angle, 0.0)
        along, _ = polar(angle_of_loaded)
        return self.speed(modes, q)[:, None] * along

    def allowance(
        self, modes: Int[Array, "modes B"], y: Float[Array, "n B"]
    ) -> Float[Array, "n B"]:
        """Allowed error of each row, in tolerances: 1, but of ln r and angle 1 / r, at
        most LOOSE / tolerance, and of the angle of creep SLOW_ANGLE / sqrt(tolerance).
        """
        _, slips, creeps = self.sliding(modes)
        log_r, _ = parts(self.slip(y))
        log_of_sliding = jnp.where(slips, log_r, 0.0)
        inverse = jnp.where(slips, jnp.exp(-log_of_sliding), 1.0)
        most = jnp.maximum(LOOSE / self.tolerance, 1.0)
        inverse = jnp.clip(inverse, 1.0, most)
        slow = SLOW_ANGLE / jnp.sqrt(self.tolerance)
        angle = jnp.where(creeps, slow, inverse)
        of_slip = jnp.stack([inverse, angle], 1)
        return self.with_slip(jnp.ones_like(y), of_slip)

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
        """Forces, and the rates of slip in time over `unit`, a = u'.

        slips     (ln r)' = d . a / r,   angle' = n . a / r
        creeps    r' = d . a,            angle' = drift + correction, see `_creep`
        unloaded  u' = a
        """
        frozen = const.frozen
        x, g, _ = self.rows(y)
        stick, slips, creeps = self.sliding(modes)
        slides = slips | creeps
        q = self.slip(y)
        f = self.force(frozen, x, g)
        c = jnp.where(slides, self.friction * f, 0.0)  # mu F
        _, angle = parts(q)
        angle = jnp.where(slides, angle, 0.0)
        r = self.speed(modes, q)
        over_r = quotient(frozen.unit, r, where=slips)
        frame = polar(angle)
        drift, correction = self._creep(const, modes, y, f, c, frame, over_r)
        direction, perpendicular = turned(frame, correction)
        side = flat(-c[:, None] * direction)
        a = pairs(times(const.pull, f) + times(const.tangent, side))  # u'
        # r' = d . a and r angle' = n . a
        grows = dot(direction, a)
        turns = dot(perpendicular, a)
        creep = jnp.where(creeps, frozen.unit * grows, 0.0)
        dr = jnp.where(slips, over_r * grows, creep)
        dangle = jnp.where(slips, over_r * turns, drift + correction)
        rate_of_time = frozen.unit * jnp.ones_like(x)
        du = rate_of_time[:, None] * a
        loaded = self.loaded(modes)[:, None]
        speed_of_change = length(a) + 2 * self._stiffness(const, c)
        fastest = over_r * speed_of_change
        return SlipRates(
            force=f,
            sliding=side,
            holding=self._holding(const, stick, f, side),
            rate=jnp.where(loaded, jnp.stack([dr, dangle], 1), du),
            direction=direction,
            turning=jnp.where(slips, over_r * turns, drift),
            haste=1 + total(fastest),
        )

    def _stiffness(self, const: Reduced, c: Float[Array, "m B"]) -> Float[Array, "m B"]:
        """Stiffness c K_tt of the angle, K_tt the mean of the two directions of a
        contact.
        """
        rows = np.arange(2 * self.contacts)
        k_1, k_2 = parts(pairs(const.tangent[rows, rows]))
        return c * (k_1 + k_2) / 2

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
        slip. With G = n . a of all contacts that creep, G' at fixed angles and
        J = -dG/d angle, the quasi-static solution G = 0 drifts by J^-1 G'. Newton's
        step J^-1 G leads to it, and the directions lag behind it by
        `(J + diag(r'))^-1 r drift`, as r angle' = G and r grows at the rate r'. The
        deviation is Newton's step less the lag, at most one radian. Of other contacts
        both are 0.
        """
        frozen = const.frozen
        x, g, _ = self.rows(y)
        *_, creeps = self.sliding(modes)
        r, _ = parts(self.slip(y))
        r = jnp.where(creeps, r, 0.0)
        direction, perpendicular = frame

        def acceleration(
            f: Float[Array, "m B"], side: Float[Array, "m 2 B"]
        ) -> Float[Array, "m 2 B"]:
            """Accelerations `u' = K_tn F + K_tt lambda` of slip by normal and sliding
            forces.
            """
            by_side = times(const.tangent, flat(side))
            return pairs(times(const.pull, f) + by_side)

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
        dside = -dc[:, None] * direction - swung
        changes = dot(perpendicular, acceleration(df, dside))
        # J = n K_tt n c + diag(r'), all in units of the largest entry: forces begin at
        # 0
        both_creep = creeps[:, None] & creeps[None]
        n_k_n = self._across(const, perpendicular)
        j = jnp.where(both_creep, n_k_n * c[None], 0.0)
        rows = jnp.max(jnp.abs(j), axis=1)
        size = largest_of(rows + jnp.abs(grows))
        size = jnp.where(size > 0, size, 1.0)
        growth = jnp.where(creeps, grows / size, 0.0)
        eye = unit(j)
        j = j / size[None]
        turns = jnp.where(creeps, turns / size, 0.0)
        changes = jnp.where(creeps, changes / size, 0.0)
        away = jnp.where(creeps, LEAST_STIFFNESS, 1.0)
        jacobian = j + eye * (growth + away)[:, None]
        drift = _solved(jacobian, changes)
        newton = _solved(jacobian, turns)
        lagging = j + eye * (2 * growth + away)[:, None]
        rate_of_time = jnp.where(creeps, frozen.unit, 1.0)
        lagging = rate_of_time[:, None] * lagging
        lag = _solved(lagging + eye * LEAST_STIFFNESS, r * drift / size)
        correction = jnp.clip(newton - lag, -1.0, 1.0)
        drift_of_creep = jnp.where(creeps, drift, 0.0)
        return drift_of_creep, jnp.where(creeps, correction, 0.0)

    def _across(
        self, const: Reduced, perpendicular: Float[Array, "m 2 B"]
    ) -> Float[Array, "m m B"]:
        """`n_i . K_tt,ij n_j` of all pairs of contacts, n the `perpendicular`."""
        blocks = self._blocks(const)
        components = [
            perpendicular[:, i][:, None]
            * blocks[:, i, :, k]
            * perpendicular[:, k][None]
            for i in range(2)
            for k in range(2)
        ]
        total: Any = sum(components)
        return total

    def contact_states(
        self, modes: Int[Array, "modes B"], y: Float[Array, "n B"]
    ) -> ContactStates:
        """Forces, velocities and slip in a state; there are no springs, nor energy of
        them.

        Of loaded contacts the rows of slip stand for its speed r and direction d (see
        `cartesian`), of open ones they are u itself.
        """
        x, g, p = self.rows(y)
        const = self.constants(modes)
        loaded = self.loaded(modes)
        q = self.slip(y)
        motion = self.motion(const, modes, y)
        cartesian = self.cartesian(modes, q)
        u = jnp.where(loaded[:, None], cartesian, q)
        return ContactStates(
            force=motion.force,
            indentation=x,
            impulse=p,
            gap_velocity=const.frozen.scale * g,
            tangential_force=motion.sliding + motion.holding,
            tangential_impulse=self.side_impulse(y),
            slip=flat(u),
            tangential_energy=y[:0],  # no rows
            # as that of time in `field`, whose independent variable runs ahead
            rate=const.frozen.unit / motion.haste,
        )

    def field(
        self, const: Reduced, modes: Int[Array, "modes B"], y: Float[Array, "driving B"]
    ) -> Float[Array, "n B"]:
        """Rates of x, g, p, slip, its impulses and time, all over `haste`: in shortened
        time.

        Equation: `g' = ratio (G F + K_nt lambda)`, without the forces of sticking in K.
        """
        frozen = const.frozen
        motion = self.motion(const, modes, y)
        across = times(const.normal_tangent, motion.sliding)
        pull = times(const.coupling, motion.force) + across
        rates = FrictionRows(
            x=frozen.closing * self.rows(y).g,
            g=frozen.ratio * pull,
            p=frozen.unit * motion.force,
            u=flat(motion.rate),
            side=frozen.unit * (motion.sliding + motion.holding),
            time=frozen.unit,
        )
        return rates.packed() / motion.haste

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
        r, _ = parts(self.slip(y))  # ln r of those that slip
        stick, slips, creeps = self.sliding(modes)
        floor = FLOOR * self.tolerance
        stops = jnp.where(creeps, r + floor, 1.0)
        stops = jnp.where(slips, r - jnp.log(floor), stops)
        # all forces of an impact vanish together: the room in the cone is one in parts
        # of them
        size = total(f)
        room = self.friction * f - length(pairs(holding))
        room = quotient(room, size, where=size > 0, otherwise=1.0)
        c = jnp.where(slips | creeps, self.friction * f, 0.0)
        stiffness = self._stiffness(const, c)
        slow = CREEP * jnp.sqrt(self.tolerance) * const.frozen.unit * stiffness
        creep = jnp.where(creeps, r, 0.0) - 2 * floor
        slow = (slow - creep) / (slow + jnp.abs(creep))
        otherwise = jnp.where(creeps, slow, 1.0)
        ends = jnp.where(stick, room, otherwise)
        normal = self.normal_margins(const.frozen, modes, y)
        return jnp.concatenate([normal, stops, ends])

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
        motion = self.motion(const, modes, y)
        f = motion.force
        stick, slips, creeps = self.sliding(modes)
        x, g, _ = self.rows(y)
        dx, dg, _ = self.rows(dy)
        _, df = jax.jvp(lambda x, g: self.force(const.frozen, x, g), (x, g), (dx, dg))
        rate_of_cone = self.friction * df
        dc = jnp.where(slips | creeps, rate_of_cone, 0.0)[:, None]
        c = jnp.where(slips | creeps, self.friction * f, 0.0)
        dangle = (c * motion.turning / motion.haste)[:, None]
        swung = dangle * perpendicular_to(motion.direction)
        dside = -flat(dc * motion.direction + swung)
        dholding = self._holding(const, stick, df, dside)
        value, rates = jax.jvp(
            lambda y, f, holding: self._margins_of(const, modes, y, f, holding),
            (y, f, motion.holding),
            (dy, df, dholding),
        )
        if self.contacts == 1:
            return value, rates

        def exact() -> Float[Array, "k B"]:
            """Rates with those of the directions of creep."""
            _, rates = jax.jvp(lambda y: self.margins(const, modes, y), (y,), (dy,))
            return rates

        on_rim = self.kinds(target).cone & stick & any_of(creeps)
        return value, cond(jnp.any(on_rim), exact, lambda: rates)

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
        _, _, stopped, ended = self.kinds(which)
        stick, slips, creeps = self.sliding(modes)
        loaded = self.loaded(modes)
        q = self.slip(y)
        r, angle = parts(q)
        u = self.cartesian(modes, q)
        breaks = stick & ended
        grows = creeps & ended
        # a contact breaks loose against the force that held it, Newton's method sees to
        # the rest
        const = self.constants(modes)
        x, g, _ = self.rows(y)
        f = self.force(const.frozen, x, g)
        direction, _ = polar(angle)
        cone = jnp.where(slips | creeps, -self.friction * f, 0.0)
        side = cone[:, None] * direction
        by_side = times(const.carried, flat(side))
        pulled = pairs(times(const.held, f) + by_side)
        away = angle_of(jnp.where(breaks[:, None], pulled, 0.0))
        log_r = jnp.log(jnp.where(grows, r, 1.0))
        of_creep = jnp.stack([jnp.zeros_like(away), away], 1)
        q = jnp.where(breaks[:, None], of_creep, q)
        of_slip = jnp.stack([log_r, angle], 1)
        q = jnp.where(grows[:, None], of_slip, q)
        slip = self.modes(modes).slip
        slip = jnp.where(grows, Slip.SLIPS, slip)
        slip = jnp.where(breaks, Slip.CREEPS, slip)
        after, y = self.normal_switch(modes, y, which)
        after = self.with_slip_modes(after, slip)
        remains = self.loaded(after)
        let_go = (loaded & ~remains)[:, None]
        q = jnp.where(let_go, u, q)
        y = self.with_slip(y, q)
        return self.decided(after, y, stopped & remains, remains & ~loaded)

    def decided(
        self,
        modes: Int[Array, "modes B"],
        y: Float[Array, "n B"],
        stopped: Bool[Array, "m B"],
        closed: Bool[Array, "m B"],
    ) -> tuple[Int[Array, "modes B"], Float[Array, "n B"]]:
        """Modes and state after contacts have `closed`, or their slip has `stopped`.

        A contact that closed with slip slips along it: its Cartesian rows become ln r
        and angle. If any contact of an impact stopped, or closed at rest (slip up to
        REST of the tolerance), all its loaded contacts that stopped, rest or stick are
        asked: by the forces of a moment later they stick, or creep in the direction of
        u'. The slip of a contact that closed at rest is taken by an impulse at once.
        Decisions have no derivatives.
        """
        q = self.slip(y)
        slip = self.modes(modes).slip
        loaded = self.loaded(modes)
        stick = loaded & (slip == Slip.STICKS) & ~closed
        slip_speed = jnp.where(closed, length(q), self.speed(modes, q))
        resting = loaded & (slip_speed <= REST * self.tolerance) & ~stick
        slips = closed & ~resting
        q = _slipping(q, slips)
        slip = jnp.where(slips, Slip.SLIPS, slip)
        closed_at_rest = closed & resting
        decides = any_of(stopped | closed_at_rest)
        asked = decides & loaded & (stopped | resting | stick)
        cone, inside, angle = self._distributed(modes, y, q, asked)
        begins = jnp.stack([jnp.zeros_like(angle), angle], 1)  # r = 0
        lost = jnp.where(closed_at_rest[:, None], q, 0.0)
        q = jnp.where(asked[:, None], begins, q)
        answer = jnp.where(inside, Slip.STICKS, Slip.CREEPS)
        modes = self.with_slip_modes(modes, jnp.where(asked, answer, slip))
        pressed = asked & (cone > 0)
        held = pressed & inside
        begun = pressed & closed_at_rest & ~inside
        with_slip = self.with_slip(y, q)
        return modes, self._without_slip(modes, with_slip, lost, held, begun)

    def _distributed(
        self,
        modes: Int[Array, "modes B"],
        y: Float[Array, "n B"],
        q: Float[Array, "m 2 B"],
        asked: Bool[Array, "m B"],
    ) -> tuple[Float[Array, "m B"], Bool[Array, "m B"], Float[Array, "m B"]]:
        """Of the contacts that are `asked`, by the forces of a moment later: mu F, who
        sticks (`inside` the cone), and the angle of u' of those that do not.

        Contacts that slide on keep their direction, the angle in `q`. Constants: which
        contacts stick has no derivative.
        """
        constant, state = jax.lax.stop_gradient((self, y))
        f = constant.soon(modes, state)
        cone = constant.friction * f  # mu F
        # b = u' by normal forces and by the friction of contacts that slide on
        _, angle = parts(q)
        along, _ = polar(jax.lax.stop_gradient(angle))
        not_sliding = (asked | ~self.loaded(modes))[:, None]
        sliding = jnp.where(not_sliding, 0.0, along)
        b = times(jnp.swapaxes(constant.normal_tangent, 0, 1), f)
        force_of_sliding = flat(cone[:, None] * sliding)
        b = b - times(constant.tangent, force_of_sliding)
        inside, towards = distribute(constant.tangent, b, cone, asked)
        return cone, inside, jnp.where(inside, 0.0, angle_of(pairs(towards)))

    def _without_slip(
        self,
        modes: Int[Array, "modes B"],
        y: Float[Array, "n B"],
        lost: Float[Array, "m 2 B"],
        held: Bool[Array, "m B"],
        begun: Bool[Array, "m B"],
    ) -> Float[Array, "n B"]:
        """The state after friction has taken the slips `lost` at once, see
        `_impulse_that_takes_slip`: `dgamma = K_nt p_t`, `du = K_tt p_t`.

        Of contacts `held`, and of those that have `begun` to slide. The slips are below
        the tolerance, so their values count as 0; as in the plane it is derivatives
        that the impulse changes.
        """
        state = self.friction_rows(y)
        q = self.slip(y)
        p_t = self._impulse_that_takes_slip(q, lost, held, begun)
        p_t = p_t - jax.lax.stop_gradient(p_t)
        dg = self.as_rows(modes, times(self.normal_tangent, p_t))
        du = pairs(times(self.tangent, p_t))
        dq = self._changes_of_slip(modes, q, du)
        u = flat(q + dq)
        state = state._replace(g=state.g + dg, u=u, side=state.side + p_t)
        return state.packed()

    def _impulse_that_takes_slip(
        self,
        q: Float[Array, "m 2 B"],
        lost: Float[Array, "m 2 B"],
        held: Bool[Array, "m B"],
        begun: Bool[Array, "m B"],
    ) -> Float[Array, "t B"]:
        """Tangential impulse p_t of friction that takes the slip `lost` at once.

        Contacts `held` come to rest, `lost + K_tt p_t = 0` along both tangents. Those
        that have `begun` to slide keep what they have along their direction (the angle
        in `q`), and lose what is across it. In the basis E of each contact, (along,
        across) of one that has begun, else its tangents: `p_t = E z`,
        `z = -(E^T K_tt E)^+ E^T lost` in these rows.
        """
        m = self.contacts
        _, angle = parts(q)
        along, across = polar(jnp.where(begun, angle, 0.0))
        basis = jnp.stack([along, across], 2)
        k = self.tangent.reshape(m, 2, m, 2, -1)
        k = jnp.einsum("iaxB,iajbB,jbyB->ixjyB", basis, k, basis)
        rows = flat(jnp.stack([held, held | begun], 1))
        inverse = pseudoinverse(k.reshape(self.tangent.shape), rows)
        along_basis = jnp.einsum("iaxB,iaB->ixB", basis, lost)
        z = times(inverse, flat(-along_basis))
        return flat(jnp.einsum("iaxB,ixB->iaB", basis, pairs(z)))

    def _changes_of_slip(
        self,
        modes: Int[Array, "modes B"],
        q: Float[Array, "m 2 B"],
        du: Float[Array, "m 2 B"],
    ) -> Float[Array, "m 2 B"]:
        """Changes of the rows q of slip by du, to first order.

        slips     ln r by d . du / r, angle by n . du / r
        creeps    r by d . du
        unloaded  u by du
        sticks    none
        """
        _, slips, creeps = self.sliding(modes)
        slides = slips | creeps
        _, angle = parts(q)
        along, across = polar(jnp.where(slides, angle, 0.0))
        r = jnp.where(slips, self.speed(modes, q), 1.0)
        turn = jnp.where(slips, dot(across, du), 0.0)
        change = jnp.stack([dot(along, du), turn], 1)
        polars = change / r[:, None]
        free = ~self.loaded(modes)
        dq = jnp.where(free[:, None], du, 0.0)
        return jnp.where(slides[:, None], polars, dq)


def _slipping(
    q: Float[Array, "m 2 B"], slips: Bool[Array, "m B"]
) -> Float[Array, "m 2 B"]:
    """Rows of slip in which the Cartesian slip u of contacts that begin to slip becomes
    ln |u| and its angle.
    """
    u = jnp.where(slips[:, None], q, 1.0)
    of_slip = jnp.stack([jnp.log(length(u)), angle_of(u)], 1)
    return jnp.where(slips[:, None], of_slip, q)
