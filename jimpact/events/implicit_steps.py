"""Impacts by a step without events: `LZB` and `Compliant` with method 'implicit'.

A step of length h advances indentations x and velocities w = (gamma, u) by Verlet's
method along the normals, and by one convex problem in each of two stages of friction
(`step_impulses.py`):

    x_half = x - h/2 omega c(gamma) gamma
    f      = h (eta + 1)/2 omega x_half^eta
    y1     in the discs mu f, against u at the end of a first stage of length PART h
    y2     in the discs mu f, against u at the end of the step,
           after (1 - PART) y1 + PART y2
    w     <- w + K (f, (1 - PART) y1 + PART y2)
    x     <- x_half - h/2 omega c(gamma) gamma

with c = 1 in compression, 1 / e^2 in expansion, and f the impulses of normal forces.
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
    ContactEquations,
    Coupling,
    Dense,
    Exponent,
    Viscous,
    as_pytree,
    largest_of,
    per_row,
    power,
)
from jimpact.numerics.driver import SLOTS_IN_SPACE, until_over
from jimpact.numerics.step_impulses import StepProblem, descent_lengths, solve
from jimpact.numerics.stepper import any_of
from jimpact.numerics.tangents import dual_like, is_dual, pushforward, value_of
from jimpact.tools.loops import cond, scan
from jimpact.tools.masks import choose, quotient
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
    equations: ContactEquations
    omega: Float[Array, "m B"]
    restitution: Float[Array, "m B"]
    exponent_array: Float[Array, "m B"] | None
    friction: Float[Array, "m B"]
    descent: Float[Array, "n B"]  # see `descent_lengths`
    tolerance: Float[Array, "1 B"]
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
        tolerance = jax.lax.stop_gradient(self.tolerance)
        return self.restitution + LEAST_RESTITUTION * tolerance

    @property
    def returned(self) -> Float[Array, "m B"]:
        """e^2: in expansion `x' = -omega gamma / e^2`; 1 of a viscous force."""
        if self.viscous is not None:
            return jnp.ones_like(self.omega)
        return self.least**2

    def parts(
        self, rows: Float[Array, "n B"]
    ) -> tuple[Float[Array, "m B"], Float[Array, "t B"]]:
        """The normal rows of velocities or impulses, and the tangential ones."""
        m = self.contacts
        return rows[:m], rows[m:]

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
        positive = jnp.where(x > 0, x, 0.0)
        return power(x, self.exponent) * positive

    def busy(self, s: ImplicitState) -> Bool[Array, "1 B"]:
        """Mask of the impacts that go on: a contact is loaded, or approaches."""
        idle = NEGLIGIBLE * self.tolerance
        gamma, _ = self.parts(s.velocity)
        loaded = self.energy(s.indentation) > idle**2
        return any_of(loaded | (gamma < -idle))

    def coasted(self, s: ImplicitState) -> ImplicitState:
        """The state when the next gap closes, x - omega gamma t = 0; s where a contact
        is loaded or begins to be, or no gap closes.
        """
        x = s.indentation
        gamma, _ = self.parts(s.velocity)
        closes = (x < 0) & (gamma < 0)
        rate = self.omega * jnp.where(closes, gamma, -1.0)
        waits = jnp.where(closes, x / rate, jnp.inf)
        wait = jnp.min(waits, axis=0, keepdims=True)
        begins = (x >= 0) & (gamma < 0)
        loaded = (x > 0) | begins
        free = ~any_of(loaded)
        wait = jnp.where(free & (wait < jnp.inf), wait, 0.0)
        coasted = x - wait * self.omega * gamma
        x = jnp.where(wait > 0, coasted, x)
        return s._replace(indentation=x, time=s.time + wait)

    # ---- one step

    def force_of(
        self, x: Float[Array, "m B"], gamma: Float[Array, "m B"]
    ) -> Float[Array, "m B"]:
        """Normal forces `(eta + 1) / 2 omega x^eta`, or those of a viscous model."""
        if self.viscous is None:
            return self.equations.force(x, self.force_scale, self.exponent)
        push = self.viscous.push(x, gamma)
        return jnp.where(x > 0, push, 0.0)

    def unloading(
        self, x: Float[Array, "m B"], h: Float[Array, "1 B"]
    ) -> Float[Array, "m B"]:
        """Rate a at which a step's normal impulse falls with the velocity of
        separation.

        Equation: `a = h^2 F'(x) omega / e^2`, as x falls by `h omega gamma / e^2`
        within the step, `F' = eta (eta + 1)/2 omega x^eta / x`; 0 of a viscous force.
        """
        if self.viscous is not None:
            return jnp.zeros_like(x)
        # the derivative divides by the square
        some = x > precision(x.dtype).tiny ** 0.5
        eta_f = self.eta * self.force_scale * power(x, self.exponent)
        slope = eta_f / jnp.where(some, x, 1.0)
        return h**2 * slope * self.omega / self.returned

    def moved(
        self,
        x: Float[Array, "m B"],
        gamma: Float[Array, "m B"],
        h: Float[Array, "1 B"],
        stiff: Bool[Array, "m B"],
    ) -> Float[Array, "m B"]:
        """Indentations after the time h.

            x - h omega c gamma       c = 1 / e^2 where a contact expands, else 1
            e^2 x - h omega gamma     where that is below 0: from x = 0 on c = 1
            x                         of one that is `stiff` and expands

        Without gaps they are at least 0.
        """
        expands = (x > 0) & (gamma > 0)
        e_squared = self.returned
        way = h * self.omega * gamma
        after = x - way / jnp.where(expands, e_squared, 1.0)
        opened = expands & (after < 0)
        after = jnp.where(opened, x * e_squared - way, after)
        after = jnp.where(stiff & expands, x, after)
        if self.gapped:
            return after
        return jnp.maximum(after, 0.0)

    def problem(
        self,
        velocity: Float[Array, "n B"],
        load: Float[Array, "m B"],
        unloading: Float[Array, "m B"],
        friction: Float[Array, "m B"],
    ) -> StepProblem:
        """The convex problem of a stage.

        Its lengths of descent are those of friction alone, `sliding`, in impacts in
        which no contact unloads implicitly, a = `unloading` = 0; else `descent`.
        """
        descent = self.descent
        if self.sliding is not None:
            descent = jnp.where(any_of(unloading > 0), descent, self.sliding)
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
        gamma, _ = self.parts(s.velocity)
        stiff = jax.lax.stop_gradient(self.unloading(x, h)) > STIFF
        half = self.moved(x, gamma, h / 2, stiff)
        load = h * self.force_of(half, gamma)
        unloading = jnp.where(stiff, self.unloading(half, h), 0.0)
        if len(s.velocity) > m:
            impulses = self.frictional_impulses
        else:
            impulses = self.normal_impulses
        in_the_middle = Middle(half, load, unloading)
        impulse, rate, load, error = impulses(s, h, in_the_middle)
        velocity = s.velocity + self.coupling.times(impulse)
        normal, _ = self.parts(impulse)
        after, _ = self.parts(velocity)

        # where unloading has reduced the impulse, x in the middle is that of the
        # reduced force
        cut = stiff & (normal < load)

        def reduced() -> Float[Array, "m B"]:
            """x in the middle, of the reduced force where it is."""
            return jnp.where(cut, self.indentation_of(normal, h), half)

        middle = cond(jnp.any(cut), reduced, lambda: half)
        end = self.moved(middle, after, h / 2, stiff)
        turning = self.turned(x, half, gamma, after, h)
        end = end + jnp.where(stiff, 0.0, turning)
        opened = cut & (normal <= 0) & (after > 0)
        opening = jnp.zeros_like(x)
        if self.gapped:
            opening = -h / 2 * self.omega * after
        end = jnp.where(opened, opening, end)
        begin = jnp.where(stiff, x, half)
        loss = self.lost(x, begin, end, after)
        loss = loss + error + self.dropped(load, opened, gamma, after)
        loss = loss + self.slackened(x, end, gamma, after, h)
        # no tangents: where nothing is stored, the slope of a root would be infinite
        loss = jax.lax.stop_gradient(loss)
        total = s.impulse + impulse
        return ImplicitState(end, velocity, rate, total, s.time + h), loss

    def frictional_impulses(
        self, s: ImplicitState, h: Float[Array, "1 B"], middle: Middle
    ) -> StageImpulses:
        """Impulses of a step with friction: y1 and y2 of both stages, see above."""
        inner = INNER * self.tolerance
        gamma, u = self.parts(s.velocity)
        half, load, unloading = middle

        def load_after(impulse: Float[Array, "n B"]) -> Float[Array, "m B"]:
            """f at the velocity after half of this impulse of the step."""
            change, _ = self.parts(self.coupling.times(impulse))
            return h * self.force_of(half, gamma + change / 2)

        # about the force in the middle, with friction as it was
        if self.viscous is not None:
            load = load_after(self.guess(s.rate, load))
        # first stage of friction; the normal rows are those at the end of the step
        ahead = jnp.concatenate([gamma, u / PART])
        stage = self.problem(ahead, load, unloading, self.friction)
        first_guess = self.guess(s.rate, load)
        first, first_error = solve(stage, first_guess, inner)
        f1, y1 = self.parts(first)
        if self.viscous is not None:
            load = load_after(first)
        side = (1 - PART) * y1
        none = jnp.zeros_like(gamma)
        impulses = jnp.concatenate([none, side])
        base = s.velocity + self.coupling.times(impulses)
        # second stage, in units in which both rows have the weight PART
        friction = self.friction * PART
        stage = self.problem(base / PART, load / PART, unloading, friction)
        guess = jnp.concatenate([f1 / PART, y1])
        second, second_error = solve(stage, guess, inner)
        f2, y2 = self.parts(second)
        normal = PART * f2
        whole_side = side + PART * y2
        return StageImpulses(
            impulse=jnp.concatenate([normal, whole_side]),
            rate=jnp.concatenate([normal, y2]) / h,
            load=load,
            error=(1 - PART) * first_error + PART * second_error,
        )

    def guess(
        self, rate: Float[Array, "n B"], load: Float[Array, "m B"]
    ) -> Float[Array, "n B"]:
        """Impulses (f, y): f is this load, `y = side / normal f` with the impulses
        `normal` and `side` in `rate` of the last step; y = 0 of a contact that was not
        pressed.
        """
        tangents = len(rate) // self.contacts - 1  # of a contact
        normal, side = self.parts(rate)
        pressed = normal > 0
        divisor = jnp.where(pressed, normal, 1.0)
        divisors = jnp.repeat(divisor, tangents, axis=0)
        load_of_pressed = jnp.where(pressed, load, 0.0)
        loads = jnp.repeat(load_of_pressed, tangents, axis=0)
        return jnp.concatenate([load, side / divisors * loads])

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
            gamma = s.velocity + self.coupling.times(load) / 2
            load = h * self.force_of(half, gamma)
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
        gamma: Float[Array, "m B"],
        after: Float[Array, "m B"],
        h: Float[Array, "1 B"],
    ) -> Float[Array, "m B"]:
        """Change of x by the moment at which gamma changes its sign within a step.

        With gamma linear in time up to gamma' = `after`, the integral of -omega c gamma
        differs from the mean of both ends by
        `h/2 omega (c' - c) |gamma gamma'| / (|gamma| + |gamma'|)`, where c = 1 holds
        while gamma < 0 and c' while gamma > 0: 1 / e^2 of a contact that is loaded (at
        x and `half`), 0 of an open one that closes, without gaps, and 1 of others.
        """
        turns = gamma * after < 0
        both = jnp.abs(gamma) + jnp.abs(after)
        part = quotient(-gamma * after, both, where=turns)
        loaded = (x > 0) & (half > 0)
        approaching = 1.0  # c
        separating = jnp.ones_like(x)  # c'
        if not self.gapped:
            separating = jnp.where(gamma > 0, 0.0, separating)
        separating = jnp.where(loaded, 1 / self.returned, separating)
        return h / 2 * self.omega * (separating - approaching) * part

    def indentation_of(
        self, impulse: Float[Array, "m B"], h: Float[Array, "1 B"]
    ) -> Float[Array, "m B"]:
        """Indentations whose force gives this normal impulse in the time h:
        `h F(x) = impulse`.
        """
        x_to_eta = impulse / (h * self.force_scale)
        positive = x_to_eta > 0
        power_of_x = jnp.where(positive, x_to_eta, 1.0)
        log_x = jnp.log(power_of_x) / self.eta
        x = jnp.exp(log_x)
        return jnp.where(positive, x, 0.0)

    def lost(
        self,
        x_before: Float[Array, "m B"],
        last: Float[Array, "m B"],
        x: Float[Array, "m B"],
        gamma: Float[Array, "m B"],
    ) -> Float[Array, "1 B"]:
        """Largest speed over e that contacts would still have gained from what they
        stored last, x^(eta + 1), in opening within the step.

        Equation: `min(sqrt(E), e E / gamma)`, E from `last`, or from `x_before` where
        that is 0; 0 of a viscous force. Not the speed itself: where others push a
        contact open, at e = 0, its expansion decides.
        """
        if self.viscous is not None:
            return jnp.zeros_like(self.tolerance)
        left = self.energy(jnp.where(last > 0, last, x_before))
        gone = (x_before > 0) & (x <= 0) & (gamma > 0)
        root = jnp.sqrt(left)
        faster = quotient(self.least * left, gamma, where=gamma > 0)
        speed = jnp.minimum(root, faster)
        return largest_of(jnp.where(gone, speed, 0.0))

    def dropped(
        self,
        load: Float[Array, "m B"],
        opened: Bool[Array, "m B"],
        gamma: Float[Array, "m B"],
        after: Float[Array, "m B"],
    ) -> Float[Array, "1 B"]:
        """Largest impulse until gamma is 0 of contacts that have `opened` as the step
        begins: `-gamma / (gamma' - gamma)` of the load, gamma' = `after`.

        While they approach, their force still acts; others then push them open.
        """
        turns = opened & (gamma < 0)
        part = quotient(-gamma, after - gamma, where=turns)
        return largest_of(jnp.where(turns, part * load, 0.0))

    def slackened(
        self,
        x_before: Float[Array, "m B"],
        x: Float[Array, "m B"],
        gamma: Float[Array, "m B"],
        after: Float[Array, "m B"],
        h: Float[Array, "1 B"],
    ) -> Float[Array, "1 B"]:
        """Largest impulse `h/2 (F + F')` of a viscous force that ends, or sets in
        again, within the step; 0 of others.

        It has a kink at x > 0, which the difference between one step and two halves may
        not show.
        """
        if self.viscous is None:
            return jnp.zeros_like(self.tolerance)
        first = self.force_of(x_before, gamma)
        last = self.force_of(x, after)
        changes = (first > 0) != (last > 0)
        turns = (x_before > 0) & (x > 0) & changes
        impulse = jnp.where(turns, h / 2 * (first + last), 0.0)
        return largest_of(impulse)

    def unseen(
        self, s: ImplicitState, end: ImplicitState, h: Float[Array, "1 B"]
    ) -> Float[Array, "1 B"]:
        """Largest part `h F / 2` of a force that begins with a jump: the estimate may
        miss it.
        """
        closes = (s.indentation <= 0) & (end.indentation > 0)
        gamma, _ = self.parts(end.velocity)
        force = self.force_of(end.indentation, gamma)
        return largest_of(jnp.where(closes, h * force / 2, 0.0))

    def step(
        self, s: ImplicitState, h: Float[Array, "1 B"]
    ) -> tuple[ImplicitState, Float[Array, "1 B"]]:
        """The state after the time h, whole and in halves, and its error in tolerances.

        Equation: `end + (end - whole) / 3`, `end` after both halves, but `end` alone of
        indentations of contacts that are not loaded after both, of `rate` and of the
        time; error `|end - whole| / 3`, without gaps of loaded contacts, and what the
        difference does not show (`substep`, `unseen`).
        """
        # a scan, so that `substep` is compiled once: the whole step, then both halves
        lengths = jnp.stack([h, h / 2, h / 2])
        wholes = jnp.asarray([True, False, False])

        def part(
            carry: tuple[ImplicitState, ImplicitState],
            which: tuple[Float[Array, "1 B"], Bool[Array, ""]],
        ) -> tuple[tuple[ImplicitState, ImplicitState], jax.Array]:
            """States after the halves so far and after the whole step; the loss of a
            half.
            """
            halves, whole = carry
            length, is_whole = which
            after, loss = self.substep(halves, length)
            # guesses of impulses have no tangents
            after = after._replace(rate=jax.lax.stop_gradient(after.rate))
            halves = choose(is_whole, halves, after)
            whole = choose(is_whole, after, whole)
            return (halves, whole), jnp.where(is_whole, 0.0, loss)

        (end, whole), losses = scan(part, (s, s), (lengths, wholes))
        difference = jnp.abs(end.indentation - whole.indentation)
        if not self.gapped:
            difference = jnp.where(end.indentation > 0, difference, 0.0)
        changed = jnp.abs(end.velocity - whole.velocity)
        differences = jnp.concatenate([difference, changed])
        error = largest_of(differences) / 3
        if self.viscous is not None:
            error = error + self.unseen(s, end, h)
        size = largest_of(jnp.abs(end.velocity))
        allowed = ALLOWED * self.tolerance + precision(h.dtype).accumulated * size
        better = jax.tree.map(lambda a, b: a + (a - b) / 3, end, whole)
        loaded = (end.indentation > 0) & (whole.indentation > 0)
        at_least = jnp.maximum(better.indentation, 0.0)
        x = jnp.where(loaded, at_least, end.indentation)
        new = better._replace(indentation=x, rate=end.rate, time=end.time)
        return new, (error + jnp.sum(losses, axis=0)) / allowed


def descent_of(coupling: Coupling, contacts: int) -> Float[Array, "n B"]:
    """Lengths of descent of a coupling; see `descent_lengths`.

    Of a chain or a packing 1 over the largest sum of |G_ij| of a row, for all.
    """
    if isinstance(coupling, Dense):
        return descent_lengths(coupling.matrix, contacts)
    entries, *_ = jax.tree.leaves(coupling)
    batch = entries.shape[-1]
    ones = jnp.ones((contacts, batch), entries.dtype)
    sums = coupling.magnitude().times(ones)
    largest = jnp.max(sums, axis=0, keepdims=True)
    return ones / largest * jnp.ones_like(sums)


class ImplicitRun(NamedTuple):
    """An impact on its way."""

    state: ImplicitState
    length: Float[Array, "1 B"]  # of the next step
    passes: Int[Array, "1 B"]  # steps tried
    seen: Any  # by `observe`, see `run`

    def over(self, flow: ImplicitSteps, max_passes: int) -> Bool[Array, "1 B"]:
        """Mask of the impacts that have ended or are given up."""
        stalled = (self.length < SHORTEST) | (self.passes >= max_passes)
        return stalled | ~flow.busy(value_of(self.state))


def next_length(
    length: Float[Array, "1 B"], error: Float[Array, "1 B"]
) -> Float[Array, "1 B"]:
    """Length `SAFETY error^(-1/3) length` of the next step, as the error falls with
    h^3.
    """
    # 1e-12 keeps the root from 0, far beyond GROWTH
    root = jnp.cbrt(error + 1e-12)
    factor = jnp.clip(SAFETY / root, SHRINK, GROWTH)
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
    state = choose(accepted, new, state)
    return state, jnp.where(live, next_length(length, error), length), accepted


def with_tangents_of(flow: Any, state: ImplicitState) -> ImplicitState:
    """The state with tangents where `flow` has some; guesses of impulses have none."""
    dual = jax.tree.map(lambda x: dual_like(flow, x), state, is_leaf=is_dual)
    return dual._replace(rate=value_of(state.rate))


def run(
    flow: ImplicitSteps,
    start: ImplicitState,
    max_passes: int,
    checkpoints: bool = False,
    observe: Callable[[Any, ImplicitState, jax.Array], Any] | None = None,
    seen: Any = None,
) -> ImplicitRun:
    """The impact from its start to its end, in at most so many passes.

    `flow` and `start` may have tangents (`Dual`), which are carried along. With
    `checkpoints` the loop has a reverse mode, and no forward mode.
    `observe(seen, state, accepted)` follows the states before each step, and which
    impacts (1, B) accept it, from `seen` on; without it an impact that is over makes
    room for the next one of a batch.
    """
    start = with_tangents_of((flow, start), start)
    length = FIRST * jnp.ones_like(value_of(flow.tolerance))
    no_passes = jnp.zeros(length.shape, jnp.int32)
    first = ImplicitRun(start, length, no_passes, seen)

    def goes_on(flow: ImplicitSteps, run: ImplicitRun) -> Bool[Array, "1 B"]:
        """Mask of the impacts that are not over."""
        return ~run.over(value_of(flow), max_passes)

    def attempt_all(flow: ImplicitSteps, run: ImplicitRun) -> ImplicitRun:
        """The impacts after one step tried in all that go on."""
        live = goes_on(flow, run)
        state, length, accepted = attempt(flow, run.state, run.length, live)
        if observe is None:
            seen = run.seen
        else:
            seen = observe(run.seen, run.state, accepted)
        passes = run.passes + live.astype(jnp.int32)
        return ImplicitRun(state, length, passes, seen)

    if observe is None:
        slots = SLOTS_IN_SPACE
    else:
        slots = None
    return until_over(goes_on, attempt_all, flow, first, checkpoints, slots)


def between(
    flow: ImplicitSteps, s: ImplicitState, ahead: Float[Array, "1 B"]
) -> ImplicitState:
    """The state at the time `ahead` after s, within the step that follows it.

    Until the next gap closes indentations change by `-omega gamma ahead` alone.
    """
    coasted = flow.coasted(s)
    gamma, _ = flow.parts(s.velocity)
    wait = coasted.time - s.time
    waits = ahead < wait
    drifted = s.indentation - ahead * flow.omega * gamma
    length = ahead - wait
    steps = ~waits & (length > 0)
    some_time = jnp.where(steps, length, FIRST)
    new, _ = flow.substep(coasted, some_time)
    new = choose(steps, new, s)
    x = jnp.where(waits, drifted, new.indentation)
    return new._replace(indentation=x, time=s.time + ahead)
