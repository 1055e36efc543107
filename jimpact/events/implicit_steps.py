"""Impacts by a step without events: `LZB` and `Compliant` with method 'implicit'.

A step of length h advances indentations x and velocities w = (gamma, u) by Verlet's method along
the normals, and by one convex problem in each of two stages of friction (`step_impulses.py`):

    x_half = x - h/2 omega c(gamma) gamma              c = 1 in compression, 1 / e^2 in expansion
    f      = h (eta + 1)/2 omega x_half^eta            impulses of the normal forces
    y1     in the discs mu f, against u at the end of a first stage of length PART h
    y2     in the discs mu f, against u at the end of the step, after (1 - PART) y1 + PART y2
    w     <- w + K (f, (1 - PART) y1 + PART y2)
    x     <- x_half - h/2 omega c(gamma) gamma

The stages are the two of an L-stable Runge-Kutta method of order 2, so that slip which stops, or
creeps in balance with its forces, does not oscillate. An expansion much faster than the step is
implicit, too: the force that it takes away within the step is part of the convex problem.

Each step is done once whole and once in halves. The difference is its error and, added by a third,
makes smooth steps one order better. The errors of the few dozen steps of an impact stay together
at about twice the one allowed in a step, but nothing bounds them where an outcome depends on its
course without limit: a second run shows that (`check_conditioning`).

Units are those of `impact_dynamics.py`. Derivatives are those of the accepted steps with their
lengths fixed, and converge with the tolerance; the loop carries all directions along (`Dual`).
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

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

# The stages of friction: with 1 - 1/sqrt(2) two implicit stages are of order 2 and L-stable. No
# other value is both.
PART = 1 - 2**-0.5
# First step, in units of the shortest time of loading; ten times more: it is rejected.
FIRST = 0.02
# The next step aims at SAFETY^3 of the error allowed, and changes by these factors at most; the
# values of other adaptive methods. Ten times more: rejected steps.
SAFETY, SHRINK, GROWTH = 0.85, 0.2, 2.5
# Error allowed in a step, in tolerances of the outcome: those of all steps came to at most twice
# the one allowed. Ten times more: tolerances are not kept.
ALLOWED = 0.3
# A step in units of the shortest time of loading that cannot be distinguished from none. Jumps of
# the forces at e = 0 are found by steps of about e_min^2. Ten times more: these end as `max_steps`.
SHORTEST = 1e-24
# Velocity and square root of energy, in tolerances, that do nothing more. Ten times more would lose
# what the tolerance promises.
NEGLIGIBLE = 0.1
# Least restitution, in tolerances: e = 0 is the limit e -> 0+, which selects who carries what where
# contacts are redundant. Ten times more changes velocities by a tolerance; ten times less takes a
# third more steps at e = 0, and finds the limit less surely.
LEAST_RESTITUTION = 0.1
# Error of the velocities of a convex problem, in tolerances. Ten times more: its noise is taken for
# an error of the step, which becomes shorter.
INNER = 1e-2
# A contact unloads implicitly where explicit expansion changes its force within a step by more than
# this part. Ten times more is unstable.
STIFF = 0.5


class ImplicitState(NamedTuple):
    """x (m, B), w (n, B), impulses in unit time of the last step and in all (n, B), time (1, B)."""

    indentation: jax.Array
    velocity: jax.Array
    rate: jax.Array
    impulse: jax.Array
    time: jax.Array


class Middle(NamedTuple):
    """The contacts (m, B) in the middle of a step: x, normal impulse, and how fast it falls."""

    indentation: jax.Array
    load: jax.Array
    unloading: jax.Array


@as_pytree
@dataclasses.dataclass
class ImplicitSteps:
    """Contacts with or without friction, arrays with the batch last; n = m + t rows."""

    coupling: Coupling  # K (n, n, B): G and the tangential block
    omega: jax.Array  # (m, B)
    restitution: jax.Array  # (m, B)
    exponent_array: jax.Array | None  # (m, B)
    friction: jax.Array  # (m, B)
    descent: jax.Array  # (n, B), see `descent_lengths`
    tolerance: jax.Array  # (1, B)
    sliding: jax.Array | None = None  # (n, B), the same where no normal impulse is unknown
    viscous: Viscous | None = None
    exponent_static: float | tuple[float, ...] | None = None
    gapped: bool = False

    @property
    def contacts(self) -> int:
        """Number m of contacts."""
        return self.omega.shape[0]

    @property
    def exponent(self) -> Exponent:
        """Exponents of the contacts: compiled in, or an array (m, B)."""
        static = self.exponent_static
        return static if static is not None else self.exponent_array  # type: ignore[return-value]

    @property
    def eta(self) -> jax.Array:
        """Exponents as rows that broadcast against (m, B)."""
        return per_row(self.exponent, self.omega)

    @property
    def least(self) -> jax.Array:
        """e (m, B), not below the least one."""
        return self.restitution + LEAST_RESTITUTION * jax.lax.stop_gradient(self.tolerance)

    @property
    def force_scale(self) -> jax.Array:
        """Force over x^eta (m, B)."""
        return (self.eta + 1) / 2 * self.omega

    def start(self, x: jax.Array, velocity: jax.Array) -> ImplicitState:
        """The state before the impact."""
        none = jnp.zeros_like(velocity)
        return ImplicitState(x, velocity, none, none, jnp.zeros_like(self.tolerance))

    def energy(self, x: jax.Array) -> jax.Array:
        """Twice the stored energy (m, B)."""
        return power(x, self.exponent) * jnp.where(x > 0, x, 0.0)

    def busy(self, s: ImplicitState) -> jax.Array:
        """Whether (1, B) the impact goes on: a contact is loaded, or approaches."""
        idle = NEGLIGIBLE * self.tolerance
        loaded = self.energy(s.indentation) > idle**2
        return jnp.any(loaded | (s.velocity[: self.contacts] < -idle), axis=0, keepdims=True)

    def coasted(self, s: ImplicitState) -> ImplicitState:
        """The state when the next gap closes, if no contact is loaded."""
        x, gamma = s.indentation, s.velocity[: self.contacts]
        closes = (x < 0) & (gamma < 0)
        rate = self.omega * jnp.where(closes, gamma, -1.0)
        wait = jnp.min(jnp.where(closes, x / rate, jnp.inf), axis=0, keepdims=True)
        free = ~jnp.any((x > 0) | ((x >= 0) & (gamma < 0)), axis=0, keepdims=True)
        wait = jnp.where(free & (wait < jnp.inf), wait, 0.0)
        ahead = x - wait * self.omega * gamma
        return s._replace(indentation=jnp.where(wait > 0, ahead, x), time=s.time + wait)

    # ---- one step

    def force_of(self, x: jax.Array, gamma: jax.Array) -> jax.Array:
        """Normal forces (m, B)."""
        if self.viscous is None:
            return self.force_scale * power(x, self.exponent)
        return jnp.where(x > 0, self.viscous.push(x, gamma), 0.0)

    def unloading(self, x: jax.Array, h: jax.Array) -> jax.Array:
        """By how much (m, B) a step's normal impulse falls with the velocity of separation."""
        if self.viscous is not None:
            return jnp.zeros_like(x)
        some = x > precision(x.dtype).tiny ** 0.5  # the derivative divides by the square
        slope = self.eta * self.force_scale * power(x, self.exponent) / jnp.where(some, x, 1.0)
        return h**2 * slope * self.omega / self.least**2

    def moved(self, x: jax.Array, gamma: jax.Array, h: jax.Array, stiff: jax.Array) -> jax.Array:
        """Indentations (m, B) after the time h; those that expand implicitly (`stiff`) stay.

        A contact that opens within this time goes on as a gap: `e^2` as fast.
        """
        expands = (x > 0) & (gamma > 0)
        square = self.least**2 if self.viscous is None else jnp.ones_like(x)
        way = h * self.omega * gamma
        ahead = x - way / jnp.where(expands, square, 1.0)
        ahead = jnp.where(expands & (ahead < 0), x * square - way, ahead)
        ahead = jnp.where(stiff & expands, x, ahead)
        return ahead if self.gapped else jnp.maximum(ahead, 0.0)

    def problem(
        self, velocity: jax.Array, load: jax.Array, unloading: jax.Array, friction: jax.Array
    ) -> StepProblem:
        """The convex problem of a stage."""
        descent = self.descent
        if self.sliding is not None:
            unloads = jnp.any(unloading > 0, axis=0, keepdims=True)
            descent = jnp.where(unloads, descent, self.sliding)
        return StepProblem(self.coupling, velocity, load, unloading, friction, descent)

    def substep(self, s: ImplicitState, h: jax.Array) -> tuple[ImplicitState, jax.Array]:
        """The state after h (1, B), and its errors (1, B) that halves may not show: what it loses
        by opening within the step, what its impulses leave, and what they drop too early."""
        m = self.contacts
        x, gamma = s.indentation, s.velocity[:m]
        stiff = jax.lax.stop_gradient(self.unloading(x, h)) > STIFF
        half = self.moved(x, gamma, h / 2, stiff)
        load = h * self.force_of(half, gamma)
        unloading = jnp.where(stiff, self.unloading(half, h), 0.0)
        impulses = self.frictional_impulses if len(s.velocity) > m else self.normal_impulses
        impulse, rate, load, left = impulses(s, h, Middle(half, load, unloading))
        velocity = s.velocity + self.coupling.times(impulse)
        normal, after = impulse[:m], velocity[:m]

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
        loss = loss + left + self.dropped(load, opened, gamma, after)
        loss = loss + self.slackened(s.indentation, x, gamma, after, h)
        # no tangents: where nothing is stored, the slope of a root would be infinite
        loss = jax.lax.stop_gradient(loss)
        return ImplicitState(x, velocity, rate, s.impulse + impulse, s.time + h), loss

    def frictional_impulses(
        self, s: ImplicitState, h: jax.Array, middle: Middle
    ) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        """Impulses (n, B) of both stages, those in unit time of the last one, the load, and the
        error (1, B) of the velocities that the two solves leave."""
        m, inner = self.contacts, INNER * self.tolerance
        gamma = s.velocity[:m]
        half, load, unloading = middle
        if self.viscous is not None:  # about the force in the middle, with friction as it was
            middle_gamma = gamma + self.coupling.times(self.guess(s.rate, load))[:m] / 2
            load = h * self.force_of(half, middle_gamma)
        # first stage of friction; the normal rows are those at the end of the step
        ahead = jnp.concatenate([gamma, s.velocity[m:] / PART])
        stage = self.problem(ahead, load, unloading, self.friction)
        first, left = solve(stage, self.guess(s.rate, load), inner)
        if self.viscous is not None:  # the force at the velocity in the middle of the step
            load = h * self.force_of(half, gamma + self.coupling.times(first)[:m] / 2)
        side = (1 - PART) * first[m:]
        none = jnp.zeros_like(gamma)
        base = s.velocity + self.coupling.times(jnp.concatenate([none, side]))
        # second stage, in units in which both rows have the weight PART
        stage = self.problem(base / PART, load / PART, unloading, self.friction * PART)
        guess = jnp.concatenate([first[:m] / PART, first[m:]])
        second, left_then = solve(stage, guess, inner)
        normal = PART * second[:m]
        impulse = jnp.concatenate([normal, side + PART * second[m:]])
        left = (1 - PART) * left + PART * left_then
        return impulse, jnp.concatenate([normal, second[m:]]) / h, load, left

    def guess(self, rate: jax.Array, load: jax.Array) -> jax.Array:
        """Impulses (n, B): this load, and the parts of it that friction had in the last step."""
        m = self.contacts
        rows = len(rate) // m - 1
        pressed = rate[:m] > 0
        carried = jnp.repeat(jnp.where(pressed, rate[:m], 1.0), rows, axis=0)
        loads = jnp.repeat(jnp.where(pressed, load, 0.0), rows, axis=0)
        return jnp.concatenate([load, rate[m:] / carried * loads])

    def normal_impulses(
        self, s: ImplicitState, h: jax.Array, middle: Middle
    ) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        """As `frictional_impulses`, without friction: the load, where nothing expands too fast."""
        half, load, unloading = middle
        none = jnp.zeros_like(self.tolerance)
        if self.viscous is not None:  # never stiff; the force at the velocity in the middle
            load = h * self.force_of(half, s.velocity + self.coupling.times(load) / 2)
            return load, load / h, load, none

        def cut() -> tuple[jax.Array, jax.Array]:
            """What fast expansions leave of the load."""
            problem = self.problem(s.velocity, load, unloading, self.friction)
            return solve(problem, h * s.rate, INNER * self.tolerance)

        some = jnp.any(unloading > 0)
        normal, left = cond(some, cut, lambda: (load, none))
        return normal, normal / h, load, left

    def turned(
        self, x: jax.Array, half: jax.Array, before: jax.Array, after: jax.Array, h: jax.Array
    ) -> jax.Array:
        """What (m, B) the moment at which gamma changes its sign within a step adds to x.

        With gamma linear in time, the integral of c gamma differs from h/2 (c gamma + c' gamma')
        by h/2 (c - c') |gamma gamma'| / (|gamma| + |gamma'|): compression and expansion; or, where
        an open contact closes, nothing and compression.
        """
        turns = before * after < 0
        size = jnp.where(turns, jnp.abs(before) + jnp.abs(after), 1.0)
        part = jnp.where(turns, -before * after / size, 0.0)
        loaded = (x > 0) & (half > 0)
        square = self.least**2 if self.viscous is None else jnp.ones_like(x)
        closes = 0.0 if self.gapped else jnp.where(before > 0, -1.0, 0.0)
        kink = jnp.where(loaded, 1 / square - 1, closes)
        return h / 2 * self.omega * kink * part

    def indentation_of(self, impulse: jax.Array, h: jax.Array) -> jax.Array:
        """Where (m, B) the force gives this normal impulse in h."""
        part = impulse / (h * self.force_scale)
        some = part > 0
        root = jnp.exp(jnp.log(jnp.where(some, part, 1.0)) / self.eta)
        return jnp.where(some, root, 0.0)

    def lost(
        self, x_before: jax.Array, last: jax.Array, x: jax.Array, gamma: jax.Array
    ) -> jax.Array:
        """Speed over e (1, B) that contacts would still have gained from what they stored last.

        Not the speed itself: where others push a contact open, at e = 0, its expansion decides.
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
        self, load: jax.Array, opened: jax.Array, before: jax.Array, after: jax.Array
    ) -> jax.Array:
        """Impulse (1, B) until gamma is 0, where contacts have `opened` (m, B) from the beginning.

        While they approach, their force still acts; others then push them open.
        """
        turns = opened & (before < 0)
        part = -before / jnp.where(turns, after - before, 1.0)
        return jnp.max(jnp.where(turns, part * load, 0.0), axis=0, keepdims=True)

    def slackened(
        self, x_before: jax.Array, x: jax.Array, before: jax.Array, after: jax.Array, h: jax.Array
    ) -> jax.Array:
        """Impulse (1, B) of a damped force that ends, or sets in again, within the step.

        It has a kink at x > 0, which the difference between one step and two halves may not show.
        """
        if self.viscous is None:
            return jnp.zeros_like(self.tolerance)
        first, last = self.force_of(x_before, before), self.force_of(x, after)
        turns = (x_before > 0) & (x > 0) & ((first > 0) != (last > 0))
        return jnp.max(jnp.where(turns, h / 2 * (first + last), 0.0), axis=0, keepdims=True)

    def unseen(self, s: ImplicitState, end: ImplicitState, h: jax.Array) -> jax.Array:
        """Part (1, B) of a force that sets in with a jump which a step may miss by its estimate."""
        closes = (s.indentation <= 0) & (end.indentation > 0)
        force = self.force_of(end.indentation, end.velocity[: self.contacts])
        return jnp.max(jnp.where(closes, h * force / 2, 0.0), axis=0, keepdims=True)

    def step(self, s: ImplicitState, h: jax.Array) -> tuple[ImplicitState, jax.Array]:
        """The state after h (1, B), whole and in halves, and its error (1, B) in tolerances."""
        lengths = jnp.stack([h, h / 2, h / 2])
        whole = jnp.asarray([True, False, False])

        def part(
            carry: tuple[ImplicitState, ImplicitState], which: tuple[jax.Array, jax.Array]
        ) -> tuple[tuple[ImplicitState, ImplicitState], jax.Array]:
            """The whole step first, then both halves from the same start."""
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
        counts = jnp.ones_like(loaded) if self.gapped else end.indentation > 0
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


def descent_of(coupling: Coupling, contacts: int) -> jax.Array:
    """Lengths (n, B) of descent of a coupling; see `descent_lengths`."""
    if isinstance(coupling, Dense):
        return descent_lengths(coupling.matrix, contacts)
    batch = jax.tree.leaves(coupling)[0].shape[-1]
    ones = jnp.ones((contacts, batch), jax.tree.leaves(coupling)[0].dtype)
    row_sums = coupling.magnitude().times(ones)
    return ones / jnp.max(row_sums, axis=0, keepdims=True) * jnp.ones_like(row_sums)


class ImplicitRun(NamedTuple):
    """An impact on its way: its state, the next step (1, B), attempts (1, B), what steps showed."""

    state: ImplicitState
    length: jax.Array
    passes: jax.Array
    seen: Any

    def over(self, flow: ImplicitSteps, most: int) -> jax.Array:
        """Whether (1, B) it has ended or is given up."""
        stalled = (self.length < SHORTEST) | (self.passes >= most)
        return stalled | ~flow.busy(value_of(self.state))


def next_length(length: jax.Array, error: jax.Array) -> jax.Array:
    """The length (1, B) of the step after one of this error (1, B), which falls with h^3."""
    # 1e-12 keeps the root from 0, far beyond GROWTH
    factor = jnp.clip(SAFETY / jnp.cbrt(error + 1e-12), SHRINK, GROWTH)
    return jnp.where(error < jnp.inf, factor, SHRINK) * length


def attempt(
    flow: ImplicitSteps, state: ImplicitState, length: jax.Array, live: jax.Array
) -> tuple[ImplicitState, jax.Array, jax.Array]:
    """State, next length and acceptance (1, B) after one step tried in `live` (1, B) runs.

    `flow` and `state` may have tangents (`Dual`); the length of the step has none.
    """
    new, error = pushforward(lambda flow, s: flow.step(flow.coasted(s), length), flow, state)
    new, error = with_tangents_of(state, new), jax.lax.stop_gradient(value_of(error))
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
    """From the start to the end of the impact, in at most so many passes.

    `flow` and `start` may have tangents (`Dual`), which are carried along. With `checkpoints` the
    loop has a reverse mode, and no forward mode. `observe(seen, state, accepted)` follows the
    states before each step, and which impacts (1, B) accept it.
    """
    start = with_tangents_of((flow, start), start)
    length = FIRST * jnp.ones_like(value_of(flow.tolerance))
    first = ImplicitRun(start, length, jnp.zeros(length.shape, jnp.int32), seen)

    def goes_on(flow: ImplicitSteps, run: ImplicitRun) -> jax.Array:
        """Which impacts (1, B) are not over."""
        return ~run.over(value_of(flow), most)

    def attempt_all(flow: ImplicitSteps, run: ImplicitRun) -> ImplicitRun:
        """One step tried in all impacts that go on."""
        live = goes_on(flow, run)
        state, length, accepted = attempt(flow, run.state, run.length, live)
        seen = run.seen if observe is None else observe(run.seen, run.state, accepted)
        return ImplicitRun(state, length, run.passes + live.astype(jnp.int32), seen)

    slots = SLOTS_IN_SPACE if observe is None else None
    return until_over(goes_on, attempt_all, flow, first, checkpoints, slots)


def between(flow: ImplicitSteps, s: ImplicitState, ahead: jax.Array) -> ImplicitState:
    """The state at `ahead` (1, B) after s, within the step that follows it."""
    coasted = flow.coasted(s)
    waits = ahead < coasted.time - s.time
    drifted = s.indentation - ahead * flow.omega * s.velocity[: flow.contacts]
    length = ahead - (coasted.time - s.time)
    steps = ~waits & (length > 0)
    new, _ = flow.substep(coasted, jnp.where(steps, length, FIRST))
    new = jax.tree.map(lambda a, b: jnp.where(steps, a, b), new, s)
    at = jnp.where(waits, drifted, new.indentation)
    return new._replace(indentation=at, time=s.time + ahead)
