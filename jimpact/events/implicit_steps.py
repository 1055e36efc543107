"""Impacts by a step without events: `LZB` and `Compliant` with method 'implicit'.

A step of length h advances indentations x and velocities w = (gamma, u) by Verlet's
method along the normals, and by one convex problem in each of two stages of friction
(`step_impulses.py`):

    x_half = x - h/2 omega c(gamma) gamma              c = 1 in compression, 1 / e^2 in
    expansion f      = h (eta + 1)/2 omega x_half^eta            impulses of the normal
    forces
    y1     in the discs mu f, against u at the end of a first stage of length PART h
    y2     in the discs mu f, against u at the end of the step, after (1 - PART) y1 +
    PART y2
    w     <- w + K (f, (1 - PART) y1 + PART y2)
    x     <- x_half - h/2 omega c(gamma) gamma

The stages are the two of an L-stable Runge-Kutta method of order 2, so that slip which
stops, or creeps in balance with its forces, does not oscillate. An expansion much
faster than the step is implicit, too: the force that it takes away within the step is
part of the convex problem.

Each step is done once whole and once in halves. The difference is its error and, added
by a third, makes smooth steps one order better. The errors of the few dozen steps of an
impact stay together at about twice the one allowed in a step, but nothing bounds them
where an outcome depends on its course without limit: a second run shows that
(`check_conditioning`).

Units are those of `impact_dynamics.py`. Derivatives are those of the accepted steps
with their lengths fixed, and converge with the tolerance; the loop carries all
directions along (`Dual`).
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jimpact.events.contact_flow import (
    Coupling,
    Dense,
    Exponent,
    Viscous,
    as_pytree,
    per_row,
    power,
)
from jimpact.numerics.driver import SLOTS_IN_SPACE, until_over
from jimpact.numerics.step_impulses import StepProblem, descent_lengths, solve
from jimpact.numerics.tangents import dual_like, is_dual, pushforward, value_of
from jimpact.tools.loops import cond, scan
from jimpact.tools.precision import precision

# The stages of friction: with 1 - 1/sqrt(2) two implicit stages are of order 2 and
# L-stable. No other value is both.
PART = 1 - 2**-0.5
# First step, in units of the shortest time of loading; ten times more: it is rejected.
FIRST = 0.02
# The next step aims at SAFETY^3 of the error allowed, and changes by these factors at
# most; the values of other adaptive methods. Ten times more: rejected steps.
SAFETY = 0.85
SHRINK = 0.2
GROWTH = 2.5
# Error allowed in a step, in tolerances of the outcome: those of all steps came to at
# most twice the one allowed. Ten times more: tolerances are not kept.
ALLOWED = 0.3
# A step in units of the shortest time of loading that cannot be distinguished from
# none. Jumps of the forces at e = 0 are found by steps of about e_min^2. Ten times
# more: these end as `max_steps`.
SHORTEST = 1e-24
# Velocity and square root of energy, in tolerances, that do nothing more. Ten times
# more would lose what the tolerance promises.
NEGLIGIBLE = 0.1
# Least restitution, in tolerances: e = 0 is the limit e -> 0+, which selects who
# carries what where contacts are redundant. Ten times more changes velocities by a
# tolerance; ten times less takes a third more steps at e = 0, and finds the limit less
# surely.
LEAST_RESTITUTION = 0.1
# Error of the velocities of a convex problem, in tolerances. Ten times more: its noise
# is taken for an error of the step, which becomes shorter.
INNER = 1e-2
# A contact unloads implicitly where explicit expansion changes its force within a step
# by more than this part. Ten times more is unstable.
STIFF = 0.5


class ImplicitState(NamedTuple):
    """State of the contacts between two steps."""

    indentation: Float[Array, "m B"]  # x
    velocity: Float[Array, "n B"]  # w = (gamma, u)
    rate: Float[Array, "n B"]  # impulses of the last step, over its length
    impulse: Float[Array, "n B"]  # of all steps so far
    time: Float[Array, "1 B"]


class Middle(NamedTuple):
    """The contacts in the middle of a step."""

    indentation: Float[Array, "m B"]  # x_half
    load: Float[Array, "m B"]  # f, normal impulse of the step
    unloading: Float[Array, "m B"]  # a: f falls by a gamma


class StageImpulses(NamedTuple):
    """Impulses of a step by its stages."""

    impulse: Float[Array, "n B"]  # of the step
    rate: Float[Array, "n B"]  # those of the last stage, over the length of the step
    load: Float[Array, "m B"]  # f, before unloading
    error: Float[Array, "1 B"]  # of the velocities that the solves leave


@as_pytree
@dataclasses.dataclass
class ImplicitSteps:
    """Contacts with or without friction and their steps; n = m + t rows."""

    coupling: Coupling  # K (n, n, B): G and the tangential block
    omega: Float[Array, "m B"]  # (m, B)
    restitution: Float[Array, "m B"]  # (m, B)
    exponent_array: Float[Array, "m B"] | None  # (m, B)
    friction: Float[Array, "m B"]  # (m, B)
    descent: Float[Array, "n B"]  # see `descent_lengths`
    tolerance: Float[Array, "1 B"]  # (1, B)
    # the same where no normal impulse is unknown
    sliding: Float[Array, "n B"] | None = None
    viscous: Viscous | None = None
    exponent_static: float | tuple[float, ...] | None = None
    gapped: bool = False

    @property
    def contacts(self) -> int:
        """Number m of contacts."""
        return self.omega.shape[0]

    @property
    def exponent(self) -> Exponent:
        """Exponents of the contacts: compiled in, or an array."""
        static = self.exponent_static
        return static if static is not None else self.exponent_array  # type: ignore[return-value]

    @property
    def eta(self) -> Float[Array, "#m #B"]:
        """Exponents as rows that broadcast against those of the contacts."""
        return per_row(self.exponent, self.omega)

    @property
    def least(self) -> Float[Array, "m B"]:
        """Restitution e, not below LEAST_RESTITUTION tolerances."""
        return self.restitution + LEAST_RESTITUTION * jax.lax.stop_gradient(
            self.tolerance
        )

    @property
    def force_scale(self) -> Float[Array, "m B"]:
        """Force over x^eta: `(eta + 1) / 2 omega`."""
        return (self.eta + 1) / 2 * self.omega

    def start(
        self, x: Float[Array, "m B"], velocity: Float[Array, "n B"]
    ) -> ImplicitState:
        """The state before the impact, from indentations and w = (gamma, u)."""
        none = jnp.zeros_like(velocity)
        return ImplicitState(x, velocity, none, none, jnp.zeros_like(self.tolerance))

    def energy(self, x: Float[Array, "m B"]) -> Float[Array, "m B"]:
        """Twice the stored energy, `x^(eta + 1)`."""
        return power(x, self.exponent) * jnp.where(x > 0, x, 0.0)

    def busy(self, s: ImplicitState) -> Bool[Array, "1 B"]:
        """Mask of the impacts that go on: a contact is loaded, or approaches."""
        idle = NEGLIGIBLE * self.tolerance
        loaded = self.energy(s.indentation) > idle**2
        return jnp.any(
            loaded | (s.velocity[: self.contacts] < -idle), axis=0, keepdims=True
        )

    def coasted(self, s: ImplicitState) -> ImplicitState:
        """The state when the next gap closes, x - omega gamma t = 0, if no contact is
        loaded.
        """
        x = s.indentation
        gamma = s.velocity[: self.contacts]
        closes = (x < 0) & (gamma < 0)
        rate = self.omega * jnp.where(closes, gamma, -1.0)
        wait = jnp.min(jnp.where(closes, x / rate, jnp.inf), axis=0, keepdims=True)
        free = ~jnp.any((x > 0) | ((x >= 0) & (gamma < 0)), axis=0, keepdims=True)
        wait = jnp.where(free & (wait < jnp.inf), wait, 0.0)
        ahead = x - wait * self.omega * gamma
        return s._replace(indentation=jnp.where(wait > 0, ahead, x), time=s.time + wait)

    # ---- one step

    def force_of(
        self, x: Float[Array, "m B"], gamma: Float[Array, "m B"]
    ) -> Float[Array, "m B"]:
        """Normal forces `(eta + 1) / 2 omega x^eta`, or those of a viscous model."""
        if self.viscous is None:
            return self.force_scale * power(x, self.exponent)
        return jnp.where(x > 0, self.viscous.push(x, gamma), 0.0)

    def unloading(
        self, x: Float[Array, "m B"], h: Float[Array, "1 B"]
    ) -> Float[Array, "m B"]:
        """Rate a at which a step's normal impulse falls with the velocity of
        separation.

        Equation: `a = h^2 F'(x) omega / e^2`, as x falls by `h omega gamma / e^2`
        within the step.
        """
        if self.viscous is not None:
            return jnp.zeros_like(x)
        # the derivative divides by the square
        some = x > precision(x.dtype).tiny ** 0.5
        slope = (
            self.eta
            * self.force_scale
            * power(x, self.exponent)
            / jnp.where(some, x, 1.0)
        )
        return h**2 * slope * self.omega / self.least**2

    def moved(
        self,
        x: Float[Array, "m B"],
        gamma: Float[Array, "m B"],
        h: Float[Array, "1 B"],
        stiff: Bool[Array, "m B"],
    ) -> Float[Array, "m B"]:
        """Indentations `x - h omega c gamma` after the time h; stiff ones that expand
        stay.

        A contact that opens within this time goes on as a gap: `e^2` as fast.
        """
        expands = (x > 0) & (gamma > 0)
        if self.viscous is None:
            square = self.least**2
        else:
            square = jnp.ones_like(x)
        way = h * self.omega * gamma
        ahead = x - way / jnp.where(expands, square, 1.0)
        ahead = jnp.where(expands & (ahead < 0), x * square - way, ahead)
        ahead = jnp.where(stiff & expands, x, ahead)
        if self.gapped:
            return ahead
        return jnp.maximum(ahead, 0.0)

    def problem(
        self,
        velocity: Float[Array, "n B"],
        load: Float[Array, "m B"],
        unloading: Float[Array, "m B"],
        friction: Float[Array, "m B"],
    ) -> StepProblem:
        """The convex problem of a stage, with the lengths of descent that suit it."""
        descent = self.descent
        if self.sliding is not None:
            unloads = jnp.any(unloading > 0, axis=0, keepdims=True)
            descent = jnp.where(unloads, descent, self.sliding)
        return StepProblem(self.coupling, velocity, load, unloading, friction, descent)

    def substep(
        self, s: ImplicitState, h: Float[Array, "1 B"]
    ) -> tuple[ImplicitState, Float[Array, "1 B"]]:
        """The state after the time h, and its errors that halves of the step may not
        show.

        These are the speed that a contact loses by opening within the step, errors of
        velocities after the solves, and impulses that are dropped too early.
        """
        m = self.contacts
        x = s.indentation
        gamma = s.velocity[:m]
        stiff = jax.lax.stop_gradient(self.unloading(x, h)) > STIFF
        half = self.moved(x, gamma, h / 2, stiff)
        load = h * self.force_of(half, gamma)
        unloading = jnp.where(stiff, self.unloading(half, h), 0.0)
        if len(s.velocity) > m:
            impulses = self.frictional_impulses
        else:
            impulses = self.normal_impulses
        impulse, rate, load, error = impulses(s, h, Middle(half, load, unloading))
        velocity = s.velocity + self.coupling.times(impulse)
        normal = impulse[:m]
        after = velocity[:m]

        # where unloading has reduced the impulse, x in the middle is that of the
        # reduced force
        cut = stiff & (normal < load)
        middle = cond(
            jnp.any(cut),
            lambda: jnp.where(cut, self.indentation_of(normal, h), half),
            lambda: half,
        )
        x = self.moved(middle, after, h / 2, stiff)
        x = x + jnp.where(stiff, 0.0, self.turned(s.indentation, half, gamma, after, h))
        opened = cut & (normal <= 0) & (after > 0)
        x = jnp.where(opened, -h / 2 * self.omega * after if self.gapped else 0.0, x)
        loss = self.lost(s.indentation, jnp.where(stiff, s.indentation, half), x, after)
        loss = loss + error + self.dropped(load, opened, gamma, after)
        loss = loss + self.slackened(s.indentation, x, gamma, after, h)
        # no tangents: where nothing is stored, the slope of a root would be infinite
        loss = jax.lax.stop_gradient(loss)
        return ImplicitState(x, velocity, rate, s.impulse + impulse, s.time + h), loss

    def frictional_impulses(
        self, s: ImplicitState, h: Float[Array, "1 B"], middle: Middle
    ) -> StageImpulses:
        """Impulses of a step with friction: y1 and y2 of both stages, see above."""
        m = self.contacts
        inner = INNER * self.tolerance
        gamma = s.velocity[:m]
        half, load, unloading = middle
        # about the force in the middle, with friction as it was
        if self.viscous is not None:
            middle_gamma = gamma + self.coupling.times(self.guess(s.rate, load))[:m] / 2
            load = h * self.force_of(half, middle_gamma)
        # first stage of friction; the normal rows are those at the end of the step
        ahead = jnp.concatenate([gamma, s.velocity[m:] / PART])
        stage = self.problem(ahead, load, unloading, self.friction)
        first, error = solve(stage, self.guess(s.rate, load), inner)
        # the force at the velocity in the middle of the step
        if self.viscous is not None:
            load = h * self.force_of(half, gamma + self.coupling.times(first)[:m] / 2)
        side = (1 - PART) * first[m:]
        none = jnp.zeros_like(gamma)
        base = s.velocity + self.coupling.times(jnp.concatenate([none, side]))
        # second stage, in units in which both rows have the weight PART
        stage = self.problem(base / PART, load / PART, unloading, self.friction * PART)
        guess = jnp.concatenate([first[:m] / PART, first[m:]])
        second, second_error = solve(stage, guess, inner)
        normal = PART * second[:m]
        impulse = jnp.concatenate([normal, side + PART * second[m:]])
        error = (1 - PART) * error + PART * second_error
        return StageImpulses(
            impulse, jnp.concatenate([normal, second[m:]]) / h, load, error
        )

    def guess(
        self, rate: Float[Array, "n B"], load: Float[Array, "m B"]
    ) -> Float[Array, "n B"]:
        """Impulses (f, y): this load, and the parts of it that friction had in the last
        step.
        """
        m = self.contacts
        rows = len(rate) // m - 1  # tangents of a contact
        pressed = rate[:m] > 0
        carried = jnp.repeat(jnp.where(pressed, rate[:m], 1.0), rows, axis=0)
        loads = jnp.repeat(jnp.where(pressed, load, 0.0), rows, axis=0)
        return jnp.concatenate([load, rate[m:] / carried * loads])

    def normal_impulses(
        self, s: ImplicitState, h: Float[Array, "1 B"], middle: Middle
    ) -> StageImpulses:
        """Impulses of a step without friction: the load, where nothing expands too
        fast.
        """
        half, load, unloading = middle
        none = jnp.zeros_like(self.tolerance)
        # never stiff; the force at the velocity in the middle
        if self.viscous is not None:
            load = h * self.force_of(half, s.velocity + self.coupling.times(load) / 2)
            return StageImpulses(load, load / h, load, none)

        def cut() -> tuple[Float[Array, "n B"], Float[Array, "1 B"]]:
            """Impulses that fast expansions leave of the load, and their error."""
            problem = self.problem(s.velocity, load, unloading, self.friction)
            return solve(problem, h * s.rate, INNER * self.tolerance)

        some = jnp.any(unloading > 0)
        normal, error = cond(some, cut, lambda: (load, none))
        return StageImpulses(normal, normal / h, load, error)

    def turned(
        self,
        x: Float[Array, "m B"],
        half: Float[Array, "m B"],
        before: Float[Array, "m B"],
        after: Float[Array, "m B"],
        h: Float[Array, "1 B"],
    ) -> Float[Array, "m B"]:
        """Change of x by the moment at which gamma changes its sign within a step.

        With gamma linear in time, the integral of c gamma differs from h/2 (c gamma +
        c' gamma') by h/2 (c - c') |gamma gamma'| / (|gamma| + |gamma'|): compression
        and expansion; or, where an open contact closes, nothing and compression.
        """
        turns = before * after < 0
        size = jnp.where(turns, jnp.abs(before) + jnp.abs(after), 1.0)
        part = jnp.where(turns, -before * after / size, 0.0)
        loaded = (x > 0) & (half > 0)
        if self.viscous is None:
            square = self.least**2
        else:
            square = jnp.ones_like(x)
        closes = 0.0 if self.gapped else jnp.where(before > 0, -1.0, 0.0)
        kink = jnp.where(loaded, 1 / square - 1, closes)
        return h / 2 * self.omega * kink * part

    def indentation_of(
        self, impulse: Float[Array, "m B"], h: Float[Array, "1 B"]
    ) -> Float[Array, "m B"]:
        """Indentations whose force gives this normal impulse in the time h:
        `h F(x) = impulse`.
        """
        part = impulse / (h * self.force_scale)
        some = part > 0
        root = jnp.exp(jnp.log(jnp.where(some, part, 1.0)) / self.eta)
        return jnp.where(some, root, 0.0)

    def lost(
        self,
        x_before: Float[Array, "m B"],
        last: Float[Array, "m B"],
        x: Float[Array, "m B"],
        gamma: Float[Array, "m B"],
    ) -> Float[Array, "1 B"]:
        """Largest speed over e that contacts would still have gained from what they
        stored last.

        Not the speed itself: where others push a contact open, at e = 0, its expansion
        decides.
        """
        if self.viscous is not None:
            return jnp.zeros_like(self.tolerance)
        left = self.energy(jnp.where(last > 0, last, x_before))
        gone = (x_before > 0) & (x <= 0) & (gamma > 0)
        root = jnp.sqrt(left)
        faster = self.least * left / jnp.where(gamma > 0, gamma, 1.0)
        speed = jnp.where(gone, jnp.minimum(root, faster), 0.0)
        return jnp.max(speed, axis=0, keepdims=True)

    def dropped(
        self,
        load: Float[Array, "m B"],
        opened: Bool[Array, "m B"],
        before: Float[Array, "m B"],
        after: Float[Array, "m B"],
    ) -> Float[Array, "1 B"]:
        """Largest impulse until gamma is 0 of contacts that have `opened` as the step
        begins.

        While they approach, their force still acts; others then push them open.
        """
        turns = opened & (before < 0)
        part = -before / jnp.where(turns, after - before, 1.0)
        return jnp.max(jnp.where(turns, part * load, 0.0), axis=0, keepdims=True)

    def slackened(
        self,
        x_before: Float[Array, "m B"],
        x: Float[Array, "m B"],
        before: Float[Array, "m B"],
        after: Float[Array, "m B"],
        h: Float[Array, "1 B"],
    ) -> Float[Array, "1 B"]:
        """Largest impulse of a damped force that ends, or sets in again, within the
        step.

        It has a kink at x > 0, which the difference between one step and two halves may
        not show.
        """
        if self.viscous is None:
            return jnp.zeros_like(self.tolerance)
        first = self.force_of(x_before, before)
        last = self.force_of(x, after)
        turns = (x_before > 0) & (x > 0) & ((first > 0) != (last > 0))
        return jnp.max(
            jnp.where(turns, h / 2 * (first + last), 0.0), axis=0, keepdims=True
        )

    def unseen(
        self, s: ImplicitState, end: ImplicitState, h: Float[Array, "1 B"]
    ) -> Float[Array, "1 B"]:
        """Largest part `h F / 2` of a force that begins with a jump: the estimate may
        miss it.
        """
        closes = (s.indentation <= 0) & (end.indentation > 0)
        force = self.force_of(end.indentation, end.velocity[: self.contacts])
        return jnp.max(jnp.where(closes, h * force / 2, 0.0), axis=0, keepdims=True)

    def step(
        self, s: ImplicitState, h: Float[Array, "1 B"]
    ) -> tuple[ImplicitState, Float[Array, "1 B"]]:
        """The state after the time h, whole and in halves, and its error in tolerances.

        Equation: `end + (end - whole) / 3`, `end` after both halves; error
        `|end - whole| / 3`.
        """
        lengths = jnp.stack([h, h / 2, h / 2])
        whole = jnp.asarray([True, False, False])

        def part(
            carry: tuple[ImplicitState, ImplicitState],
            which: tuple[Float[Array, "1 B"], Bool[Array, ""]],
        ) -> tuple[tuple[ImplicitState, ImplicitState], jax.Array]:
            """States after the halves so far and after the whole step; the loss of a
            half.
            """
            at, big = carry
            length, is_whole = which
            after, loss = self.substep(at, length)
            # guesses of impulses have no tangents
            after = after._replace(rate=jax.lax.stop_gradient(after.rate))
            at = jax.tree.map(lambda a, b: jnp.where(is_whole, a, b), at, after)
            big = jax.tree.map(lambda a, b: jnp.where(is_whole, b, a), big, after)
            return (at, big), jnp.where(is_whole, 0.0, loss)

        (end, big), losses = scan(part, (s, s), (lengths, whole))
        loaded = (end.indentation > 0) & (big.indentation > 0)
        if self.gapped:
            counts = jnp.ones_like(loaded)
        else:
            counts = end.indentation > 0
        moved = jnp.where(counts, jnp.abs(end.indentation - big.indentation), 0.0)
        changed = jnp.abs(end.velocity - big.velocity)
        error = jnp.max(jnp.concatenate([moved, changed]), axis=0, keepdims=True) / 3
        size = jnp.max(jnp.abs(end.velocity), axis=0, keepdims=True)
        if self.viscous is not None:
            error = error + self.unseen(s, end, h)
        allowed = ALLOWED * self.tolerance + precision(h.dtype).accumulated * size
        better = jax.tree.map(lambda a, b: a + (a - b) / 3, end, big)
        x = jnp.where(loaded, jnp.maximum(better.indentation, 0.0), end.indentation)
        new = better._replace(indentation=x, rate=end.rate, time=end.time)
        return new, (error + jnp.sum(losses, axis=0)) / allowed


def descent_of(coupling: Coupling, contacts: int) -> Float[Array, "n B"]:
    """Lengths of descent of a coupling; see `descent_lengths`."""
    if isinstance(coupling, Dense):
        return descent_lengths(coupling.matrix, contacts)
    batch = jax.tree.leaves(coupling)[0].shape[-1]
    ones = jnp.ones((contacts, batch), jax.tree.leaves(coupling)[0].dtype)
    row_sums = coupling.magnitude().times(ones)
    return ones / jnp.max(row_sums, axis=0, keepdims=True) * jnp.ones_like(row_sums)


class ImplicitRun(NamedTuple):
    """An impact on its way."""

    state: ImplicitState
    length: Float[Array, "1 B"]  # of the next step
    passes: Int[Array, "1 B"]  # steps tried
    seen: Any  # by `observe`, see `run`

    def over(self, flow: ImplicitSteps, most: int) -> Bool[Array, "1 B"]:
        """Mask of the impacts that have ended or are given up."""
        stalled = (self.length < SHORTEST) | (self.passes >= most)
        return stalled | ~flow.busy(value_of(self.state))


def next_length(
    length: Float[Array, "1 B"], error: Float[Array, "1 B"]
) -> Float[Array, "1 B"]:
    """Length `SAFETY error^(-1/3) length` of the next step, as the error falls with
    h^3.
    """
    # 1e-12 keeps the root from 0, far beyond GROWTH
    factor = jnp.clip(SAFETY / jnp.cbrt(error + 1e-12), SHRINK, GROWTH)
    return jnp.where(error < jnp.inf, factor, SHRINK) * length


def attempt(
    flow: ImplicitSteps,
    state: ImplicitState,
    length: Float[Array, "1 B"],
    live: Bool[Array, "1 B"],
) -> tuple[ImplicitState, Float[Array, "1 B"], Bool[Array, "1 B"]]:
    """State, next length and acceptance after one step tried in the runs `live`.

    `flow` and `state` may have tangents (`Dual`); the length of the step has none.
    """
    new, error = pushforward(
        lambda flow, s: flow.step(flow.coasted(s), length), flow, state
    )
    new = with_tangents_of(state, new)
    error = jax.lax.stop_gradient(value_of(error))
    accepted = live & (error <= 1)
    state = jax.tree.map(lambda a, b: jnp.where(accepted, a, b), new, state)
    return state, jnp.where(live, next_length(length, error), length), accepted


def with_tangents_of(flow: Any, state: ImplicitState) -> ImplicitState:
    """The state with tangents where `flow` has some; guesses of impulses have none."""
    dual = jax.tree.map(lambda x: dual_like(flow, x), state, is_leaf=is_dual)
    return dual._replace(rate=value_of(state.rate))


def run(
    flow: ImplicitSteps,
    start: ImplicitState,
    most: int,
    checkpoints: bool = False,
    observe: Callable[[Any, ImplicitState, jax.Array], Any] | None = None,
    seen: Any = None,
) -> ImplicitRun:
    """The impact from its start to its end, in at most so many passes.

    `flow` and `start` may have tangents (`Dual`), which are carried along. With
    `checkpoints` the loop has a reverse mode, and no forward mode.
    `observe(seen, state, accepted)` follows the states before each step, and which
    impacts (1, B) accept it.
    """
    start = with_tangents_of((flow, start), start)
    length = FIRST * jnp.ones_like(value_of(flow.tolerance))
    first = ImplicitRun(start, length, jnp.zeros(length.shape, jnp.int32), seen)

    def goes_on(flow: ImplicitSteps, run: ImplicitRun) -> Bool[Array, "1 B"]:
        """Mask of the impacts that are not over."""
        return ~run.over(value_of(flow), most)

    def attempt_all(flow: ImplicitSteps, run: ImplicitRun) -> ImplicitRun:
        """The impacts after one step tried in all that go on."""
        live = goes_on(flow, run)
        state, length, accepted = attempt(flow, run.state, run.length, live)
        if observe is None:
            seen = run.seen
        else:
            seen = observe(run.seen, run.state, accepted)
        return ImplicitRun(state, length, run.passes + live.astype(jnp.int32), seen)

    if observe is None:
        slots = SLOTS_IN_SPACE
    else:
        slots = None
    return until_over(goes_on, attempt_all, flow, first, checkpoints, slots)


def between(
    flow: ImplicitSteps, s: ImplicitState, ahead: Float[Array, "1 B"]
) -> ImplicitState:
    """The state at the time `ahead` after s, within the step that follows it."""
    coasted = flow.coasted(s)
    waits = ahead < coasted.time - s.time
    drifted = s.indentation - ahead * flow.omega * s.velocity[: flow.contacts]
    length = ahead - (coasted.time - s.time)
    steps = ~waits & (length > 0)
    new, _ = flow.substep(coasted, jnp.where(steps, length, FIRST))
    new = jax.tree.map(lambda a, b: jnp.where(steps, a, b), new, s)
    at = jnp.where(waits, drifted, new.indentation)
    return new._replace(indentation=at, time=s.time + ahead)
