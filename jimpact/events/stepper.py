"""One event-aligned stepper for every flow with modes: no step straddles a change of mode.

LAYOUT   Rows first, batch last: state y (n, B), margins (k, B), modes (m, B) whole numbers; what is
one number an impact is (1, B). One impact is a batch of one.

PROTOCOL   A flow is a pytree of parameters (arrays (.., B)) with

    constants(modes)           what of the field does not change while the modes last
    field(const, modes, y)     -> dy (n, B), in the flow's own time
    margins(const, modes, y)   -> c (k, B): each is >= 0 while its mode lasts
    rooted(modes)              -> (k, B): margins whose root is the variable of a landing
    switch(modes, y, which)    -> (modes, y) after the events `which` (k, B), one-hot
    begins(before, after)      -> (1, B): forces set in like powers of t, so steps begin in its root
    coasts(modes)              -> (1, B): the field is constant, steps of any length are exact
    over(modes, y, passes)     -> (1, B): nothing is left to integrate
    pauses(before, after, passes)  -> (1, B): the caller wants to look now; None: never
    finish(modes, y)           -> (modes, y) where it is over
    allowance(modes, y)        -> (n, B) or 1: tolerances that the error of each row may be
    driving, adding            blocks of rows (none: one block); those that only add up come last
    longest                    the longest step in the flow's own time that is stable
    tolerance (1, B), snap (1, B)
    taking_part (1, B)             contacts, of which some may be open for good
    near                       share of a step from which landings start, 0: from anywhere

ONE FORMULA FOR A STEP   Steps advance in xi with dt/dxi = N(xi) / R,

    N = 2 xi where xi is a root, else 1;   R = dc_k/dt on landings, else 1.

A landing on margin k runs from xi = c_k (or its root) to exactly 0 (Henon): no root is searched
for, and its length is differentiated. An event where a step begins is a landing of length 0; an
explicit Runge-Kutta step of length 0 has the right derivatives up to its order, so there are no
jump rules, also where events coincide.

WHAT COMES NEXT   Every margin gets one number, in units of the step just tried, and the least of
them decides (`advance`).

DERIVATIVES   Forward ones go along with the steps: the state carries tangents (`tangents.py`) while
values alone decide. For the reverse mode the run records its accepted steps, and `repeat` walks
through them once more as a scan in which nothing is decided. JAX differentiates both: any order.

COMPILING costs some 20 ms a kernel, and a kernel starts at every shared root or quotient, every
reduction, every array that a loop carries. So the field occurs once (a 13th stage with the weights
b gives margins and their rates at the end of a step), and what is one number an impact is rows of
two arrays.
"""

from itertools import pairwise
from typing import Any, NamedTuple, Protocol, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from jimpact.events.tableaux import DOP853
from jimpact.events.tangents import Dual, dual_like, pushforward, value_of

GROWTH, SHRINK, SAFETY = 6.0, 0.2, 0.8  # of the step-size control
FIRST = 0.05  # first step, in the time of the fastest contact: none can turn around so soon
RESTART = 0.1  # first rooted step after a contact has closed, as a part of the step before it
CUT = 0.7  # part of the way to an event that a step is shortened to where it cannot land
DOUBT = 0.01  # part of a step's change of slope that its minimum may lie lower than it seems
SHORTEST = 1e-13  # step: a shorter one cannot be told from none
TIE = 1e-13  # of a step: events of one moment are taken in the order of their rows
# Passes per contact at the full local tolerance, which ordinary impacts end within. Then it falls
# with the number of passes, or the errors of N steps would add up to N tolerances.
FULL = 30
POLISH = 2  # Newton steps to a root of the cubic of a step: from the chord they leave about 1e-3
FINEST = 16  # roundings: an error estimate below them is noise
COARSE = 0.3  # the error is no less than this part of the third-order estimate squared
COARSE_ROUNDING = 64  # roundings of a state that is large itself: a wide gap

# Accepted steps kept for the reverse mode: blocks of steps; where nothing is kept one is skipped.
# An impact of more steps has no derivative there: NaN, whatever its status.
BLOCKS, BLOCK = 64, 16

STAGES = len(DOP853.c)
_TABLE = np.array([[*row, *[0.0] * (STAGES - len(row))] for row in (*DOP853.a, DOP853.b)])
_NODES = np.array([*DOP853.c, 1.0])
_WEIGHTS = np.array([DOP853.b, DOP853.error_high, DOP853.error_low])


class Flow(Protocol):
    """What the stepper asks of a flow (see above)."""

    longest: Any  # a number, or ()
    near: float

    @property
    def driving(self) -> tuple[int, ...]: ...
    @property
    def adding(self) -> tuple[int, ...]: ...

    @property
    def tolerance(self) -> jax.Array: ...
    @property
    def taking_part(self) -> jax.Array | int: ...
    @property
    def snap(self) -> jax.Array: ...
    def constants(self, modes: jax.Array) -> Any: ...
    def field(self, const: Any, modes: jax.Array, y: jax.Array) -> jax.Array: ...
    def margins(self, const: Any, modes: jax.Array, y: jax.Array) -> jax.Array: ...
    def rooted(self, modes: jax.Array) -> jax.Array: ...
    def switch(
        self, modes: jax.Array, y: jax.Array, which: jax.Array
    ) -> tuple[jax.Array, jax.Array]: ...
    def allowance(self, modes: jax.Array, y: jax.Array) -> jax.Array | float: ...
    def begins(self, before: jax.Array, after: jax.Array) -> jax.Array: ...
    def coasts(self, modes: jax.Array) -> jax.Array | None: ...
    def over(self, modes: jax.Array, y: jax.Array, passes: jax.Array) -> jax.Array: ...
    def pauses(
        self, before: jax.Array, after: jax.Array, passes: jax.Array
    ) -> jax.Array | None: ...
    def finish(self, modes: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]: ...


F = TypeVar("F", bound=Flow)


def total(x: jax.Array) -> jax.Array:
    """Sum over the rows."""
    return jnp.sum(x, axis=0, keepdims=True)


def any_of(x: jax.Array) -> jax.Array:
    """Whether any row."""
    return jnp.any(x, axis=0, keepdims=True)


def _put(buffer: jax.Array, value: jax.Array, index: jax.Array) -> jax.Array:
    return jax.lax.dynamic_update_slice_in_dim(
        buffer, value[None], index, 0, allow_negative_indices=False
    )


class Step(NamedTuple):
    """What a step needs beside the state: enough to repeat it."""

    modes: jax.Array  # (m, B)
    target: jax.Array  # (k, B) one-hot: the margin it lands on; none: a step in time
    clock: jax.Array  # (4, B): xi at the beginning, length, whether xi is a root, whether it lands


def _stages(flow: Any, s: Step, y: Any, ends: bool) -> tuple[Any, ...]:
    """Change of y and of time (n + 1, B); both estimates of its error (2, n, B); margins (k, B) at
    the beginning, and where it `ends`: rates at the beginning, margins and rates at the end.

    What of `flow` and y has tangents (see `tangents.py`) gives a change with tangents.
    """
    plain, state = value_of((flow, y))
    n, dtype, batch = state.shape[0], state.dtype, state.shape[1:]
    begun, h, in_root, lands = (s.clock[i : i + 1] for i in range(4))

    def frame(flow: Flow, y: jax.Array) -> tuple[Any, ...]:
        const = flow.constants(s.modes)
        c0 = flow.margins(const, s.modes, y)
        # from a margin that is 0 already a landing has length 0, and no root
        root = flow.rooted(s.modes) & (c0 > flow.snap)
        xi0 = jnp.where(root, jnp.sqrt(jnp.where(root, c0, 1.0)), c0)
        xi0 = total(jnp.where(s.target, xi0, 0.0))
        rooted = total(jnp.where(s.target, root.astype(dtype), 0.0)) + in_root
        start = jnp.where(lands > 0, xi0, begun)
        # a margin that is as good as 0 takes no time, however slow it is; its derivatives are kept
        nowhere = (lands > 0) & (jnp.abs(xi0) <= flow.snap)
        length = jnp.where(nowhere, jax.lax.stop_gradient(xi0) - xi0, jnp.where(lands > 0, -xi0, h))
        return const, jax.lax.stop_gradient(c0), start, length, rooted, nowhere

    const, c0, start, length, rooted, nowhere = pushforward(frame, flow, y)
    count = STAGES + 1 if ends else STAGES  # the 13th evaluation, that of the end, has no weight
    table = jnp.asarray(np.pad(_TABLE[:count], ((0, 0), (0, count - STAGES))), dtype)
    weights = jnp.asarray(np.pad(_WEIGHTS, ((0, 0), (0, count - STAGES))), dtype)
    adds = sum(plain.adding)
    drives = n - adds
    blocks = plain.driving or (drives,)
    ends_of = np.cumsum([0, *blocks, *plain.adding])

    def evaluated(
        flow: Flow, const: Any, start: Any, length: Any, y: jax.Array, change: jax.Array, at: Any
    ) -> tuple[list[jax.Array], tuple[jax.Array, jax.Array]]:
        i, c = at
        xi = start + c * length
        now = y[:drives] + length * change
        dy = flow.field(const, s.modes, now)

        def seen() -> tuple[jax.Array, jax.Array]:
            return jax.jvp(lambda z: flow.margins(const, s.modes, z), (now,), (dy[:drives],))

        if flow.near:  # of costly margins: steps in time need them at their ends only
            needed = jnp.any(lands > 0) | (i == 0) | (i == STAGES)
            none = jnp.zeros_like(s.target, dtype)
            value, dc = jax.lax.cond(needed, seen, lambda: (none, none))
        else:
            value, dc = seen()
        rate = total(jnp.where(s.target, dc, 0.0)) + (1 - lands)
        rate = jnp.where(nowhere & (rate == 0), jnp.inf, rate)
        dt = (1 + rooted * (2 * xi - 1)) / rate
        rows = [dy[first:last] * dt for first, last in pairwise(ends_of)]
        return [*rows, dt], jax.lax.stop_gradient((value, dc))

    def stage(carry: Any, at: Any) -> tuple[Any, None]:
        slopes, added, *margins = carry
        i, a, c = at
        change = jax.tree.map(lambda k: jnp.tensordot(a, k, axes=1), slopes)
        new, (value, dc) = pushforward(evaluated, flow, const, start, length, y, change, (i, c))
        slopes = _kept(slopes, new[: len(blocks)], i)
        added = _kept(added, new[len(blocks) :], i)
        if ends:
            margins = [jnp.where(i == 0, dc, margins[0]), value, dc]
        return (slopes, added, *margins), None

    none = [jnp.zeros((count, k, *batch), dtype) for k in (drives, adds + 1)]
    carry = [dual_like((flow, y), k) for k in none]
    margins = [jnp.zeros_like(s.target, dtype)] * (3 if ends else 0)
    rows = (jnp.arange(count, dtype=jnp.uint32), table, jnp.asarray(_NODES[:count], dtype))
    (slopes, added, *margins), _ = jax.lax.scan(stage, (*carry, *margins), rows)
    sums = [jnp.tensordot(weights, value_of(k), axes=1) for k in (slopes, added)]
    inner, outer = (
        Dual(x[0], jnp.tensordot(weights[0], k.tangents, axes=1)) if isinstance(k, Dual) else x[0]
        for x, k in zip(sums, (slopes, added))
    )
    change = pushforward(lambda h, *k: h * jnp.concatenate(k), length, inner, outer)
    errors = value_of(length)[None] * jnp.concatenate([x[1:] for x in sums], axis=1)[:, :n]
    return change, errors, c0, margins


def _kept(table: Any, new: list[Any], i: jax.Array) -> Any:
    """The table with a new row of slopes, in blocks.

    Each block of tangents is a kernel: one for all would compute them entry by entry.
    """
    value = value_of(table)
    value = _put(value, jnp.concatenate(value_of(new)), i)
    if not isinstance(table, Dual):
        return value
    along, first, none = table.tangents, 0, jnp.zeros((), i.dtype)
    for block in new:
        if isinstance(block, Dual):  # else its tangents are 0
            at = (i, jnp.asarray(first, i.dtype), none, none)
            along = jax.lax.dynamic_update_slice(
                along, block.tangents[None], at, allow_negative_indices=False
            )
        first += len(value_of(block))
    return Dual(value, along)


GOES_ON, OVER, PAUSED = 0.0, 1.0, 2.0


class StepperState(NamedTuple):
    """What one pass hands to the next."""

    y: Any  # (n, B), which may be `Dual`
    step: Step  # the one to try
    # (4, B): time it is expected to take, landing aimed at twice, GOES_ON | OVER | PAUSED, passes
    plan: jax.Array


def begin(flow: Any, modes: jax.Array, start: Any) -> StepperState:
    """The first step: short, in the root of time, for forces set in like a power of it."""
    start = dual_like((flow, start), start)
    flow, y = value_of((flow, start))
    one = jnp.ones_like(y[:1])
    clock = jnp.concatenate([0 * one, FIRST**0.5 * one, one, 0 * one])
    targets = jax.eval_shape(lambda: flow.margins(flow.constants(modes), modes, y)).shape
    step = Step(modes, jnp.zeros(targets, bool), clock)
    over = flow.over(modes, y, 0 * one)
    state = jnp.where(over, OVER, GOES_ON).astype(y.dtype)
    return StepperState(start, step, jnp.concatenate([FIRST * one, 0 * one, state, 0 * one]))


def goes_on(carry: StepperState, most: int) -> jax.Array:
    """Impacts (1, B) that are neither over nor given up nor looked at."""
    return (carry.plan[2:3] == GOES_ON) & (carry.plan[3:4] < most)


def unwatched(carry: StepperState, most: int) -> jax.Array:
    """Whether () some impact goes on and none wants to be looked at."""
    return jnp.any(goes_on(carry, most)) & ~jnp.any(carry.plan[2:3] == PAUSED)


def advance(flow: Flow, carry: StepperState, most: int) -> tuple[StepperState, jax.Array]:
    """One pass: try a step; accept it, or aim at what lies in its middle, or shorten it.

    Every margin gets one number, in units of the step tried, and the least one decides:
        -2 .. -1   it dips, or cannot be landed on from here: shorten the step to CUT * (at + 2)
         0 ..  1   it vanishes inside the step: repeat the step as a landing on it
         1 .. inf  it is expected to vanish so far ahead: land on it if the next step reaches it
    """
    moving, start, s = flow, carry.y, carry.step
    flow, y = value_of((flow, start))
    n, dtype = y.shape[0], y.dtype
    expected, again, done, passes = (carry.plan[i : i + 1] for i in range(4))
    begun, h, in_root, lands = (s.clock[i : i + 1] for i in range(4))
    in_root, lands = in_root > 0, lands > 0
    change, errors, c0, (d0, c1, d1) = _stages(moving, s, start, ends=True)
    taken = value_of(change)[n:]
    eps = float(jnp.finfo(dtype).eps)
    full = FULL * flow.taking_part
    local = jnp.maximum(flow.tolerance * (full / jnp.maximum(passes, full)), FINEST * eps)
    # Hairer's error, squared, in tolerances
    scale = local * flow.allowance(s.modes, y) + COARSE_ROUNDING * eps * jnp.abs(y)
    fifth, third = (x[None] for x in jnp.max(jnp.abs(errors) / scale[None], axis=1))
    tiny = float(jnp.finfo(dtype).tiny)  # a landing of length 0 has no errors
    error2 = fifth**4 / (fifth**2 + 0.01 * third**2 + tiny)
    # small by chance where the fifth order is: a landing from a maximum, a step of half a period
    error2 = jnp.maximum(error2, (COARSE * third**2 * local) ** 2)
    ok = error2 <= 1
    factor = jnp.clip(
        SAFETY / jnp.sqrt(jnp.sqrt(jnp.sqrt(jnp.sqrt(error2 + 1e-20)))), SHRINK, GROWTH
    )
    factor = jnp.where(error2 < jnp.inf, factor, SHRINK)
    span = jnp.where(ok & (taken > 0), taken, expected)
    # what each margin does in this step, and after it
    d0, d1 = d0 * span, d1 * span
    snap = flow.snap
    free = ~s.target
    crossed, turns = free & (c1 < -snap), free & (d0 < 0) & (d1 > 0) & (c0 > snap)
    top = jnp.where(crossed, jnp.maximum(c0, 0.0), jnp.where(turns, -d0, c1))
    bottom = jnp.where(crossed, c0 - c1, jnp.where(turns, d1 - d0, -d1))
    u = top / jnp.where(bottom > 0, bottom, jnp.inf)
    # what rises from 0 and falls back: as in a parabola
    u = jnp.where(crossed & (c0 <= snap) & (d0 > 0), d0 / jnp.where(crossed, d0 - c1, 1.0), u)
    if flow.near:
        # steps in time go before: exact in a parabola, where dt/dxi has a singularity at the top
        u = jnp.where(crossed, _root_of_cubic(u, c0, d0, c1, d1), u)
    v = 1 - u
    low = (c0 * (1 + 2 * u) + d0 * u) * v * v + (c1 * (1 + 2 * v) - d1 * v) * u * u
    dipped = turns & (low < DOUBT * (d1 - d0) - snap)
    at_once = (c0 <= snap) & (d0 <= 0)
    direct = at_once if flow.near else at_once | ((d0 < 0) & (c0 > snap))
    # ahead by a parabola: a margin that only creeps towards 0 is not about to reach it
    left = d1 * d1 - 2 * (d1 - d0) * c1
    ahead = free & ~turns & (d1 < 0) & (c1 > snap) & (left > 0) & ~lands
    soon = 2 * c1 / (jnp.sqrt(jnp.where(ahead, left, 1.0)) - jnp.where(ahead, d1, 0.0))
    at = jnp.where(
        crossed,
        jnp.where(direct & (again == 0), jnp.where(at_once, 0.0, u), u - 2),
        jnp.where(dipped, u - 2, jnp.where(ahead, 1 + soon, jnp.inf)),
    )
    at = at + TIE * jnp.arange(c0.shape[0], dtype=dtype)[:, None]
    first = jnp.min(at, axis=0, keepdims=True)
    event = first <= 1
    active = goes_on(carry, most)
    accept = ok & ~event & active
    landed = accept & lands
    which = s.target & landed
    # however short the step, the field has no value: given up, for the status to say
    broken = active & ~lands & ~(error2 < jnp.inf) & (h < SHORTEST)

    def after(flow: Flow, y: jax.Array, change: jax.Array) -> tuple[jax.Array, jax.Array]:
        modes, end = flow.switch(s.modes, y + change[:n], which)
        return modes, jnp.where(accept, end, jnp.where(broken, jnp.nan, y))

    modes, end = pushforward(after, moving, start, change)
    end = dual_like(start, end)
    y = value_of(end)
    # the next step
    in_root = in_root & ~lands
    xi = jnp.where(in_root, begun + jnp.where(accept, h, 0.0), 0.0)
    cut = jnp.where(ok & (first < 0), (1 - flow.near if flow.near else CUT) * (first + 2), 0.5)
    shorter = jnp.where(in_root, jnp.sqrt(cut) * h, cut * jnp.where(lands, span, h))
    kept = jnp.where(first < 0, shorter, h)
    h = jnp.where(ok & event, kept, jnp.where(lands, jnp.where(ok, h, shorter), factor * h))
    fresh = accept & flow.begins(s.modes, modes)
    restart = jnp.sqrt(jnp.minimum(RESTART * span, FIRST))
    in_root, xi = in_root | fresh, jnp.where(fresh, 0.0, xi)
    h = jnp.where(fresh & (restart > 0), restart, h)
    h = jnp.where(in_root, h, jnp.minimum(h, flow.longest))
    new_span = jnp.where(in_root, (xi + h) ** 2 - xi**2, h)
    coasts = flow.coasts(s.modes)
    reached = (first - 1) * span < new_span
    reached = reached if coasts is None else reached | (coasts & (first < jnp.inf))
    if flow.near:
        reached = reached & (first - 1 < 5 * flow.near)
    aim = ok & jnp.where(event, first >= 0, ~lands & reached)
    target = aim & (at == first)
    h = jnp.where(aim & in_root, new_span, h)
    in_root = in_root & ~aim
    due = jnp.where(event, first, first - 1) * span
    clock = jnp.concatenate([xi, h, in_root.astype(dtype), aim.astype(dtype)])
    passes = passes + active.astype(dtype)
    pauses = flow.pauses(s.modes, modes, passes)
    done = done if pauses is None else jnp.where(landed & pauses, PAUSED, done)
    over = flow.over(modes, y, passes) | broken
    plan = jnp.concatenate(
        [
            jnp.where(aim, due, new_span),
            (aim & lands & event).astype(dtype),
            jnp.where(over, OVER, done),
            passes,
        ]
    )
    return StepperState(end, *jax.lax.stop_gradient((Step(modes, target, clock), plan))), accept


def _root_of_cubic(
    u: jax.Array, c0: jax.Array, d0: jax.Array, c1: jax.Array, d1: jax.Array
) -> jax.Array:
    """The root in [0, 1] near u of the cubic with values c and slopes d at 0 and 1."""
    rise = c1 - c0
    a, b = d0 - rise, rise - d1
    for _ in range(POLISH):
        v = 1 - u
        bend = v * a + u * b
        value = v * c0 + u * c1 + u * v * bend
        slope = rise + (v - u) * bend + u * v * (b - a)
        u = jnp.clip(u - value / jnp.where(slope < 0, slope, -jnp.inf), 0.0, 1.0)
    return u


def run(flow: Flow, carry: StepperState, most: int) -> StepperState:
    """On to the end, the first pause, or the limit of passes; `finish` is not yet applied."""
    return jax.lax.while_loop(
        lambda c: unwatched(c, most), lambda c: advance(flow, c, most)[0], carry
    )


# ---- derivatives: the accepted steps once more -------------------------------------------------


class AcceptedSteps(NamedTuple):
    """Accepted steps in order, at most BLOCKS * BLOCK; nothing kept: zeros."""

    marks: jax.Array  # (steps, m + k + 1, B) int8: modes, target, 1 where a step is kept
    clock: jax.Array  # (steps, 4, B)
    # (1, B): there were too few rows. Such an impact has no derivative: NaN, no wrong number
    lost: jax.Array


class Recorder(NamedTuple):
    """A plan while it is written, and rows used."""

    plan: AcceptedSteps
    used: jax.Array


def recorder(carry: StepperState) -> Recorder:
    """A plan without a step."""
    modes, target, clock = carry.step
    size, rows = BLOCKS * BLOCK, len(modes) + len(target) + 1
    plan = AcceptedSteps(
        jnp.zeros((size, rows, *clock.shape[1:]), jnp.int8),
        jnp.zeros((size, *clock.shape), clock.dtype),
        jnp.zeros(clock[:1].shape, bool),
    )
    return Recorder(plan, jnp.zeros((), jnp.uint32))


def record(
    flow: Flow, carry: StepperState, pen: Recorder, most: int
) -> tuple[StepperState, Recorder]:
    """As `run`, and the plan of its steps."""
    size = BLOCKS * BLOCK

    def body(state: tuple[StepperState, Recorder]) -> tuple[StepperState, Recorder]:
        carry, (plan, count) = state
        after, accept = advance(flow, carry, most)
        s = carry.step
        marks = jnp.concatenate(
            [s.modes.astype(jnp.int8), s.target.astype(jnp.int8), jnp.ones_like(accept, jnp.int8)]
        )
        # a pass that no impact of the batch accepts leaves its row to the next one
        index = jnp.minimum(count, size - 1)
        plan = AcceptedSteps(
            _put(plan.marks, jnp.where(accept, marks, 0), index),
            _put(plan.clock, jnp.where(accept, s.clock, 0.0), index),
            plan.lost | (accept & (count >= size)),
        )
        count = count + jnp.any(accept).astype(count.dtype)
        return after, Recorder(plan, count)

    return jax.lax.while_loop(lambda state: unwatched(state[0], most), body, (carry, pen))


def with_plan(x: jax.Array, plan: AcceptedSteps) -> jax.Array:
    """x, of a program that has to keep the plan although nothing else is asked of it.

    Values and their derivatives record the same steps. The compiler makes one loop of two that are
    the same; it would strip one of them of the plan first.
    """
    marks, clock = plan.marks[0, -1:], plan.clock[0, 2:3]  # each is 0 or 1
    return jnp.where((marks < 0) | (clock < 0), jnp.nan, x)


def repeat(flow: Flow, modes: jax.Array, y: jax.Array, plan: AcceptedSteps) -> jax.Array:
    """The state that `run` ends with, as a smooth function of `flow` and `y`."""
    return _walk(flow, modes, y, plan, states=False)[0]


def path(flow: Flow, modes: jax.Array, y: jax.Array, plan: AcceptedSteps) -> jax.Array:
    """States (steps + 1, n, B) at the beginning and after each step of the plan, smooth as well."""
    after: Any = _walk(flow, modes, y, plan, states=True)[1]
    return jnp.concatenate([y[None], after.reshape(-1, *y.shape)])


def between(flow: Flow, s: Step, y: jax.Array, ahead: jax.Array) -> jax.Array:
    """The state so long (1, B) after y, in the flow's own time, within the step from there."""
    begun, in_root, lands = s.clock[:1], s.clock[2:3], s.clock[3:4]
    in_root = in_root * (1 - lands)
    begun = begun * in_root
    reached = begun**2 + ahead
    positive = reached > 0
    root = jnp.where(positive, jnp.sqrt(jnp.where(positive, reached, 1.0)), 0.0)
    h = jnp.where(in_root > 0, root - begun, ahead)
    clock = jnp.concatenate([begun, h, in_root, jnp.zeros_like(h)])
    return step_again(flow, Step(s.modes, jnp.zeros_like(s.target), clock), y)


def step_again(flow: Flow, s: Step, y: jax.Array) -> jax.Array:
    """The state after an accepted step, as a smooth function of `flow` and `y`."""
    change, *_ = _stages(flow, s, y, ends=False)
    return y + change[:-1]


Row = tuple[jax.Array, jax.Array]  # marks and clock of a step of the plan


def step_of(row: Row, modes: int) -> tuple[Step, jax.Array]:
    """A step of the plan, and whether (1, B) there is one."""
    marks, clock = row
    return Step(marks[:modes].astype(jnp.int32), marks[modes:-1] > 0, clock), marks[-1:] > 0


def _walk(
    flow: Flow, modes: jax.Array, y: jax.Array, plan: AcceptedSteps, states: bool
) -> tuple[jax.Array, jax.Array | None]:
    """Through all steps of the plan; blocks in which nothing is kept cost nothing."""
    y = jnp.where(plan.lost, jnp.nan, 1.0) * y

    def step(y: jax.Array, row: Row) -> tuple[jax.Array, jax.Array | None]:
        s, accept = step_of(row, modes.shape[0])

        def walk(y: jax.Array) -> jax.Array:
            end = flow.switch(s.modes, step_again(flow, s, y), s.target)[1]
            return jnp.where(accept, end, y)

        y = jax.lax.cond(jnp.any(accept), walk, lambda y: y, y)
        return y, y if states else None

    def block(y: jax.Array, rows: Row) -> tuple[jax.Array, jax.Array | None]:
        def walk(y: jax.Array) -> tuple[jax.Array, jax.Array | None]:
            return jax.lax.scan(jax.checkpoint(step), y, rows)

        def stay(y: jax.Array) -> tuple[jax.Array, jax.Array | None]:
            return y, jnp.broadcast_to(y, (BLOCK, *y.shape)) if states else None

        return jax.lax.cond(jnp.any(rows[0][:, -1] > 0), walk, stay, y)

    rows = tuple(x.reshape(BLOCKS, BLOCK, *x.shape[1:]) for x in (plan.marks, plan.clock))
    return jax.lax.scan(jax.checkpoint(block), y, rows)
