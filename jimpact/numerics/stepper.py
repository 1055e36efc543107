"""One event-aligned stepper for every flow with modes: no step straddles a change of
mode.

LAYOUT   Rows first, batch last: state y (n, B), margins (k, B), modes (m, B) whole
numbers; per-impact scalars have shape (1, B). One impact is a batch of one.

PROTOCOL   A flow is a pytree of parameters (arrays (.., B)): see `Flow`. It defines
`field`, `margins`, `switch`, `over` and a tolerance, and overrides the defaults that do
not fit.

ONE FORMULA FOR A STEP   Steps advance in xi with dt/dxi = N(xi) / R,

    N = 2 xi where xi is a root, else 1;   R = dc_k/dt on landings, else 1.

A landing on margin k runs from xi = c_k (or its root) to exactly 0 (M. Henon, On the
numerical computation of Poincare maps, Physica D 5, 1982): no root is searched for, and
the length of the step has derivatives. An event where a step begins is a landing of
length 0; an explicit Runge-Kutta step of length 0 has the right derivatives up to its
order, so there are no jump rules, also where events coincide.

WHAT COMES NEXT   Each margin gets an intention (SHORTEN, LAND, AHEAD) and a distance in
units of the step just tried; the most urgent one decides (`advance`).

DERIVATIVES   In forward mode the state carries tangents (`tangents.py`); step sizes and
events depend on values, not on tangents. `step_again` is an accepted step once more,
with all decisions fixed.

COMPILING costs some 20 ms a kernel, and a kernel starts at every shared root or
quotient, every reduction, every array that a loop carries. So the field occurs once (a
13th stage with the weights b gives margins and their rates at the end of a step), and
per-impact scalars are rows of two arrays, `Step.clock` and `StepperState.progress`.
"""

import abc
import enum
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Integer, Num, Shaped

from jimpact.numerics.driver import SLOTS
from jimpact.numerics.tableaux import DOP853
from jimpact.numerics.tangents import Dual, dual_like, is_dual, pushforward, value_of
from jimpact.tools.loops import cond, in_a_branch, scan
from jimpact.tools.precision import precision

# Step-size control: a step is at most GROWTH times and at least SHRINK times the one
# before it, and SAFETY times what its error allows. More growth or less safety: more
# rejected steps.
GROWTH = 6.0
SHRINK = 0.2
SAFETY = 0.8
# First step, in the time of the fastest contact, which cannot turn around so soon. Ten
# times more could step over its first event.
FIRST = 0.05
# First rooted step after a contact has closed, as a part of the step before; ten times
# more: rejected.
RESTART = 0.1
# Part of the way to an event that a step is shortened to where it cannot land on it. At
# 1 it ends at the event and may step over it again.
CUT = 0.7
# A flow with `near` lands where the event is at most this many times `near` ahead, in
# steps. Such a landing evaluates costly margins in each stage; ten times more makes it
# longer.
REACH = 5
# Part of a step's change of slope by which its minimum may lie lower than its cubic.
# Ten times more: steps are shortened for margins that do not dip.
DOUBT = 0.01
# Step that cannot be distinguished from none, in the flow's own time; ten times more
# gives up earlier.
SHORTEST = 1e-13
# Part of a step within which events are simultaneous, and are taken in the order of
# their rows. Ten times more is still far below the tolerance.
TIE = 1e-13
# Passes per contact at the full local tolerance, which ordinary impacts end within.
# Then it falls with the number of passes, or the errors of N steps would add up to N
# tolerances.
FULL = 30
# Newton steps to a root of the cubic of a step: from the chord they leave about 1e-3.
POLISH = 2
# The error is no less than this part of the third-order estimate squared. Ten times
# more: steps half as long.
COARSE = 0.3

STAGES = len(DOP853.c)
_TABLE = np.array(
    [[*row, *[0.0] * (STAGES - len(row))] for row in (*DOP853.a, DOP853.b)]
)
_NODES = np.array([*DOP853.c, 1.0])
_WEIGHTS = np.array([DOP853.b, DOP853.error_high, DOP853.error_low])


class Flow(abc.ABC):
    """A differential equation to be integrated: a state y, and modes that change at
    events.
    """

    tolerance: Float[Array, "1 B"]  # error of a step
    # contacts, without those that are open for good
    taking_part: Float[Array, "1 B"] | int
    longest: Any  # the longest step in the flow's own time that is stable, or inf

    near: float = 0.0  # share of a step from which landings start, 0: from anywhere
    slots: int = SLOTS  # impacts that a CPU computes side by side, others wait

    @property
    def driving(self) -> tuple[int, ...]:
        """Sizes of the blocks of rows that the field depends on; () is one block."""
        return ()

    @property
    def adding(self) -> tuple[int, ...]:
        """Sizes of the blocks of rows that only add up; they come last."""
        return ()

    @property
    @abc.abstractmethod
    def zero_margin(self) -> Float[Array, "1 B"]:
        """Margins closer to 0 than this count as 0."""

    @abc.abstractmethod
    def field(
        self, const: Any, modes: Int[Array, "modes B"], y: Float[Array, "driving B"]
    ) -> Float[Array, "n B"]:
        """Rates dy in the flow's own time, from the rows of y that drive them."""

    @abc.abstractmethod
    def margins(
        self, const: Any, modes: Int[Array, "modes B"], y: Float[Array, "driving B"]
    ) -> Float[Array, "k B"]:
        """Margins: each is >= 0 while its mode lasts."""

    def margins_with_rates(
        self,
        const: Any,
        modes: Int[Array, "modes B"],
        y: Float[Array, "driving B"],
        dy: Float[Array, "driving B"],
        target: Bool[Array, "k B"],
    ) -> tuple[Float[Array, "k B"], Float[Array, "k B"]]:
        """Margins c(y) and their rates (dc/dy) dy while y changes at the rates dy.

        Those of the `target` of a landing have to be exact, others are looked at to
        predict events.
        """
        margins_at = partial(self.margins, const, modes)
        return jax.jvp(margins_at, (y,), (dy,))

    @abc.abstractmethod
    def switch(
        self,
        modes: Int[Array, "modes B"],
        y: Float[Array, "n B"],
        which: Bool[Array, "k B"],
    ) -> tuple[Int[Array, "modes B"], Float[Array, "n B"]]:
        """Modes and state after the events `which`, one-hot."""

    @abc.abstractmethod
    def over(
        self,
        modes: Int[Array, "modes B"],
        y: Float[Array, "n B"],
        passes: Float[Array, "1 B"],
    ) -> Bool[Array, "1 B"]:
        """Mask of the impacts in which nothing is left to integrate."""

    def constants(self, modes: Int[Array, "modes B"]) -> Any:
        """The parts of the field that do not change while the modes last."""
        return None

    def allowance(
        self, modes: Int[Array, "modes B"], y: Float[Array, "n B"]
    ) -> Float[Array, "#n #B"] | float:
        """Allowed error of each row, in tolerances."""
        return 1.0

    def rooted(self, modes: Int[Array, "modes B"]) -> Bool[Array, "#k #B"]:
        """Mask of the margins whose root is the variable of a landing: by default
        none.
        """
        return jnp.zeros((1, 1), bool)

    def begins(
        self, before: Int[Array, "modes B"], after: Int[Array, "modes B"]
    ) -> Bool[Array, "1 #B"]:
        """Mask: forces start as a power of time, so that steps advance in its root."""
        return jnp.zeros((1, 1), bool)

    def coasts(self, modes: Int[Array, "modes B"]) -> Bool[Array, "1 B"] | None:
        """Mask: the field is constant, so that steps of any length are exact; None: it
        never is.
        """
        return None

    def pauses(
        self,
        before: Int[Array, "modes B"],
        after: Int[Array, "modes B"],
        passes: Float[Array, "1 B"],
    ) -> Bool[Array, "1 B"] | None:
        """Mask of the impacts that the caller has to inspect after this pass; None:
        none, ever.
        """
        return None

    def finish(
        self, modes: Int[Array, "modes B"], y: Float[Array, "n B"]
    ) -> tuple[Int[Array, "modes B"], Float[Array, "n B"]]:
        """Modes and state at the end of the impact, where `over` is True."""
        return modes, y


def total(x: Num[Array, "k *B"]) -> Num[Array, "1 *B"]:
    """Sum over the rows, as one row."""
    return jnp.sum(x, axis=0, keepdims=True)


def any_of(x: Bool[Array, "k *B"]) -> Bool[Array, "1 *B"]:
    """True, in one row, where any row is True."""
    return jnp.any(x, axis=0, keepdims=True)


def _row(x: Float[Array, "k B"], i: int) -> Float[Array, "1 B"]:
    """Row i of an array, as an array of one row."""
    return x[i : i + 1]


def put(
    buffer: Shaped[Array, "count *rows"],
    value: Shaped[Array, "*rows"],
    index: Integer[Array, ""],
) -> Shaped[Array, "count *rows"]:
    """The buffer with `value` in the row `index`."""
    row = value[None]
    return jax.lax.dynamic_update_slice_in_dim(
        buffer, row, index, 0, allow_negative_indices=False
    )


class Clock(enum.IntEnum):
    """Rows of the clock of a step."""

    START = 0
    LENGTH = 1
    IN_ROOT = 2
    LANDS = 3


class Step(NamedTuple):
    """A step without its state: enough to repeat it."""

    modes: Int[Array, "modes B"]
    target: Bool[Array, "k B"]  # one-hot: the margin it lands on; none: a step in time
    clock: Float[Array, "4 B"]  # rows: see `Clock`

    @property
    def start(self) -> Float[Array, "1 B"]:
        """The variable xi at the beginning."""
        return _row(self.clock, Clock.START)

    @property
    def length(self) -> Float[Array, "1 B"]:
        """The length of the step in xi; a landing has its own, from its margin."""
        return _row(self.clock, Clock.LENGTH)

    @property
    def in_root(self) -> Float[Array, "1 B"]:
        """1 where xi is the root of time, else 0."""
        return _row(self.clock, Clock.IN_ROOT)

    @property
    def lands(self) -> Float[Array, "1 B"]:
        """1 where the step lands on its target, else 0."""
        return _row(self.clock, Clock.LANDS)


class _StepVariable(NamedTuple):
    """The variable xi of a step, (1, B) each."""

    start: Any  # xi at the beginning
    length: Any  # of the step in xi
    rooted: Any  # 1 where xi is a root, 0 elsewhere
    zero_length: Any  # mask of landings on a margin that is 0
    in_time: Any  # 1 where the step is no landing, 0 elsewhere


class _Frame(NamedTuple):
    """What a step is computed with."""

    const: Any  # constants of the flow
    margins: Float[Array, "k B"]  # at the beginning
    variable: _StepVariable


def _frame(flow: Flow, s: Step, y: Float[Array, "n B"]) -> _Frame:
    """Constants of the flow, margins at the beginning, and the variable xi of the step.

    In time xi runs from the `start` of the clock for its length h; on a landing from c,
    the margin at the beginning, or its root, to 0.
    """
    const = flow.constants(s.modes)
    lands = s.lands > 0
    c0 = flow.margins(const, s.modes, y)
    # a landing from a margin that is already 0 has length 0, and no root
    root = flow.rooted(s.modes) & (c0 > flow.zero_margin)
    positive = jnp.where(root, c0, 1.0)
    xi0 = jnp.where(root, jnp.sqrt(positive), c0)
    xi0 = total(jnp.where(s.target, xi0, 0.0))
    in_root = root.astype(y.dtype)
    rooted = total(jnp.where(s.target, in_root, 0.0)) + s.in_root
    start = jnp.where(lands, xi0, s.start)
    # a margin that counts as 0 takes no time, however slow it is; its derivatives
    # remain
    zero_length = lands & (jnp.abs(xi0) <= flow.zero_margin)
    length = jnp.where(lands, -xi0, s.length)
    no_length = jax.lax.stop_gradient(xi0) - xi0
    length = jnp.where(zero_length, no_length, length)
    variable = _StepVariable(start, length, rooted, zero_length, 1 - s.lands)
    return _Frame(const, jax.lax.stop_gradient(c0), variable)


class _StepResult(NamedTuple):
    """Change over a step, its error, and the margins c with their rates dc/dt at both
    ends.
    """

    change: Any  # of y and of time (n + 1, B)
    errors: Float[Array, "2 n B"]  # both estimates of the error of y
    margins: tuple[Float[Array, "k B"], Float[Array, "k B"]]
    rates: tuple[Float[Array, "k B"], Float[Array, "k B"]]


def _slopes(
    flow: Flow,
    const: Any,
    variable: _StepVariable,
    s: Step,
    y: Float[Array, "n B"],
    stage: Any,
    ends: np.ndarray,
) -> tuple[list[Float[Array, "_ B"]], tuple[Float[Array, "k B"], Float[Array, "k B"]]]:
    """Slopes in a stage: `dy/dxi = dy dt/dxi` in blocks of rows that end at `ends`,
    then dt/dxi.

    And the margins and their rates in the flow's own time. The stage is its number, its
    node c_i, and the sum `sum_j a_ij k_j` of slopes that leads to its state.
    """
    i, node, change = stage
    xi = variable.start + node * variable.length
    now = y[: len(change)] + variable.length * change
    dy = flow.field(const, s.modes, now)

    def rates_of_margins() -> tuple[Float[Array, "k B"], Float[Array, "k B"]]:
        """Margins and their rates in the flow's own time."""
        rates = dy[: len(now)]
        return flow.margins_with_rates(const, s.modes, now, rates, s.target)

    if flow.near:  # of costly margins: steps in time need them at their ends only
        at_an_end = (i == 0) | (i == STAGES)
        needed = jnp.any(s.lands > 0) | at_an_end
        none = jnp.zeros_like(s.target, now.dtype)
        value, dc = cond(needed, rates_of_margins, lambda: (none, none))
    else:
        value, dc = rates_of_margins()
    # dt/dxi = N / R: N = 2 xi of a root, else 1; R = dc_k/dt of a landing, else 1
    of_target = jnp.where(s.target, dc, 0.0)
    rate = total(of_target) + variable.in_time
    never = variable.zero_length & (rate == 0)
    rate = jnp.where(never, jnp.inf, rate)
    dt = (1 + variable.rooted * (2 * xi - 1)) / rate
    rows = [dy[first:last] * dt for first, last in pairwise(ends)]
    return [*rows, dt], jax.lax.stop_gradient((value, dc))


def _stages(flow: Any, s: Step, y: Any, frame: Any, ends: bool) -> _StepResult:
    """One step of the Runge-Kutta method in its `_Frame`; rates and margins at the end
    only where it `ends`.

    Where `flow` or y has tangents (see `tangents.py`) the change has some, too.
    """
    plain, state = value_of((flow, y))
    n = state.shape[0]
    dtype = state.dtype
    batch = state.shape[1:]
    const, c0, variable = frame
    # the 13th evaluation, that of the end, has no weight
    if ends:
        count = STAGES + 1
    else:
        count = STAGES
    adds = sum(plain.adding)
    blocks = plain.driving or (n - adds,)
    ends_of = np.cumsum([0, *blocks, *plain.adding])

    def evaluate(i: Integer[Array, ""], node: Float[Array, ""], change: Any) -> Any:
        """Slopes of a stage as new rows of both tables; margins and their rates."""
        new, margins = pushforward(
            lambda flow, const, variable, y, change: _slopes(
                flow, const, variable, s, y, (i, node, change), ends_of
            ),
            *(flow, const, variable, y, change),
        )
        slopes = new[: len(blocks)]
        return (slopes, new[len(blocks) :]), margins

    row = [
        dual_like((flow, y), jnp.zeros((1, k, *batch), dtype))
        for k in (n - adds, adds + 1)
    ]
    if jax.default_backend() == "cpu":
        stages = _scanned
    else:
        stages = _written_out
    tables, (d0, c1, d1) = stages(evaluate, row, count, c0)
    padded = np.pad(_WEIGHTS, ((0, 0), (0, count - STAGES)))
    weights = jnp.asarray(padded, dtype)
    change, errors = _weighted(tables, weights, variable.length)
    of_state = errors[:, :n]
    return _StepResult(change, of_state, (c0, c1), (d0, d1))


def _scanned(
    evaluate: Any, row: list[Any], count: int, c0: Float[Array, "k B"]
) -> tuple[Any, Any]:
    """Slopes of all stages in two tables (count, rows, B), and margins at both ends, by
    a scan.

    `row` has an empty row (1, rows, B) of each table. Of the margins: rates in the
    first stage, values and rates in the last; the margins c0 at the beginning stand for
    those that are not known yet. One kernel for all stages: it compiles quickly.
    """
    dtype = c0.dtype
    padded = np.pad(_TABLE[:count], ((0, 0), (0, count - STAGES)))
    table = jnp.asarray(padded, dtype)

    def stage(carry: Any, at: Any) -> tuple[Any, None]:
        """Tables with the slopes of stage i, whose state follows from those of earlier
        stages.
        """
        slopes, added, first, *_ = carry
        i, weights, node = at
        weighted = partial(jnp.tensordot, weights, axes=1)
        change = jax.tree.map(weighted, slopes)
        (new, new_added), (value, dc) = evaluate(i, node, change)
        slopes = _with_row(slopes, new, i)
        added = _with_row(added, new_added, i)
        first_rates = jnp.where(i == 0, dc, first)
        return (slopes, added, first_rates, value, dc), None

    tables = jax.tree.map(lambda x: jnp.zeros((count, *x.shape[1:]), dtype), row)
    each = (
        jnp.arange(count, dtype=jnp.uint32),
        table,
        jnp.asarray(_NODES[:count], dtype),
    )
    start = (*tables, c0, c0, c0)
    (slopes, added, *margins), _ = scan(stage, start, each)
    return [slopes, added], margins


def _written_out(
    evaluate: Any, row: list[Any], count: int, c0: Float[Array, "k B"]
) -> tuple[Any, Any]:
    """Slopes and margins as `_scanned`, each stage with kernels of its own.

    On a GPU the tables that a scan carries pass through memory in every stage, for
    twice the time of an impact. On a CPU this is no faster, and compiles for two to
    four times as long.
    """
    tables: list[list[Any]] = [[], []]
    margins = []
    for i in range(count):
        used = np.flatnonzero(_TABLE[i, :i])
        change = jax.tree.map(lambda x: x[0], row[0])
        if used.size:
            change = jax.tree.map(
                lambda *k, i=i, used=used: sum(
                    float(_TABLE[i, j]) * x[0] for j, x in zip(used, k)
                ),
                *(tables[0][j] for j in used),
            )
        node = jnp.asarray(_NODES[i], c0.dtype)
        index = jnp.asarray(i, jnp.uint32)
        new, margin = evaluate(index, node, change)
        for table, empty, part in zip(tables, row, new):
            row_of_stage = _with_row(empty, part, jnp.zeros((), jnp.uint32))
            table.append(row_of_stage)
        margins.append(margin)
    whole = [jax.tree.map(lambda *x: jnp.concatenate(x), *table) for table in tables]
    _, first_rates = margins[0]
    return whole, (first_rates, *margins[-1])


def _weighted(
    tables: list[Any], weights: Float[Array, "3 count"], length: Any
) -> tuple[Any, Float[Array, "2 _ B"]]:
    """Change over a step (n + 1, B), and two estimates of its error, from all slopes.

    Equation: `h sum_i b_i k_i`, with the weights b of the method, then of both
    estimates.
    """
    changes = []
    errors = []
    for slopes in tables:
        sums = jnp.tensordot(weights, value_of(slopes), axes=1)
        change: Any = sums[0]
        if is_dual(slopes):
            tangents = jnp.tensordot(weights[0], slopes.tangents, axes=1)
            change = Dual(change, tangents)
        changes.append(change)
        errors.append(sums[1:])
    change = pushforward(lambda h, *k: h * jnp.concatenate(k), length, *changes)
    of_rows = jnp.concatenate(errors, axis=1)
    return change, value_of(length)[None] * of_rows


def _with_row(table: Any, new: list[Any], i: Integer[Array, ""]) -> Any:
    """The table of slopes (count, rows, B) with `new`, a list of blocks of rows, as its
    row i.

    Each block of tangents is a kernel: one for all would compute them entry by entry.
    """
    value = value_of(table)
    value = put(value, jnp.concatenate(value_of(new)), i)
    if not is_dual(table):
        return value
    tangents = table.tangents
    first = 0
    none = jnp.zeros((), i.dtype)
    for block in new:
        if is_dual(block):  # else its tangents are 0
            at = (i, jnp.asarray(first, i.dtype), none, none)
            tangents = jax.lax.dynamic_update_slice(
                tangents, block.tangents[None], at, allow_negative_indices=False
            )
        first += len(value_of(block))
    return Dual(value, tangents)


class Mark(enum.IntEnum):
    """State of an impact: it goes on, is over, or waits until the caller has inspected
    it.
    """

    GOES_ON = 0
    OVER = 1
    PAUSED = 2


class Intention(enum.IntEnum):
    """Purpose of the next step for a margin, the most urgent first; the meaning of its
    distance.

    The numbers leave a gap for distances from 0 to 1 between them: their sum is the
    order of urgency.
    """

    SHORTEN = -2  # it dips, or cannot be landed on from here: at this part of the step
    LAND = 0  # it vanishes at this part of the step: repeat the step as a landing on it
    # expected to vanish this many steps ahead: land on it if the next step reaches it
    AHEAD = 1


class Progress(enum.IntEnum):
    """Rows of the progress of an impact."""

    EXPECTED = 0
    AIMED_TWICE = 1
    MARK = 2
    PASSES = 3


class StepperState(NamedTuple):
    """The state after a pass, and the step to try in the next one."""

    y: Any  # (n, B), which may be `Dual`
    step: Step  # the one to try
    progress: Float[Array, "4 B"]  # rows: see `Progress`

    @property
    def expected(self) -> Float[Array, "1 B"]:
        """The time that the step is expected to take."""
        return _row(self.progress, Progress.EXPECTED)

    @property
    def aimed_twice(self) -> Float[Array, "1 B"]:
        """1 where a landing already had to aim at another event, else 0."""
        return _row(self.progress, Progress.AIMED_TWICE)

    @property
    def mark_as_float(self) -> Float[Array, "1 B"]:
        """`Mark` of each impact, as a floating-point number."""
        return _row(self.progress, Progress.MARK)

    @property
    def mark(self) -> Int[Array, "1 B"]:
        """`Mark` of each impact."""
        return self.mark_as_float.astype(jnp.int32)

    @property
    def passes(self) -> Float[Array, "1 B"]:
        """Number of passes so far, a whole floating-point number."""
        return _row(self.progress, Progress.PASSES)

    def marked(self, which: Bool[Array, "1 B"], mark: Any) -> "StepperState":
        """The state with this `Mark` where `which` is True."""
        old = self.mark_as_float
        code = jnp.asarray(mark, old.dtype)
        new = jax.lax.stop_gradient(jnp.where(which, code, old))
        row = slice(Progress.MARK, Progress.MARK + 1)
        marked_progress = self.progress.at[row].set(new)
        return self._replace(progress=marked_progress)


def begin(flow: Any, modes: Int[Array, "modes B"], start: Any) -> StepperState:
    """The state before the first pass.

    The first step is short and advances in the root of time, as forces start as a power
    of it.
    """
    start = dual_like((flow, start), start)
    flow, y = value_of((flow, start))
    one = jnp.ones_like(_row(y, 0))
    # xi = 0, a length in the root of time, no landing
    no = 0 * one
    clock = jnp.concatenate([no, FIRST**0.5 * one, one, no])
    targets = jax.eval_shape(
        lambda: flow.margins(flow.constants(modes), modes, y)
    ).shape
    step = Step(modes, jnp.zeros(targets, bool), clock)
    over = flow.over(modes, y, 0 * one)
    code = jnp.where(over, Mark.OVER, Mark.GOES_ON)
    mark = code.astype(y.dtype)
    none_yet = 0 * one
    progress = jnp.concatenate([FIRST * one, none_yet, mark, none_yet])
    return StepperState(start, step, progress)


def goes_on(carry: StepperState, most: int) -> Bool[Array, "1 B"]:
    """Mask of the impacts that are neither over nor given up nor paused."""
    return (carry.mark == Mark.GOES_ON) & (carry.passes < most)


def _prepared(
    flow: Any, state: StepperState, most: int
) -> tuple[_Frame, Bool[Array, "1 B"], Float[Array, "1 B"]]:
    """The frame of the step to try, which impacts go on, and their local tolerance.

    All of them in a branch, see `in_a_branch`.
    """
    s = state.step
    always = state.passes[0, 0] >= 0
    plain = value_of(flow)

    def all_three(flow: Flow, y: Float[Array, "n B"]) -> Any:
        """The three results, in a branch."""
        return in_a_branch(
            always,
            lambda: (
                _frame(flow, s, y),
                goes_on(state, most),
                _local_tolerance(plain, state.passes, y.dtype),
            ),
        )

    return pushforward(all_three, flow, state.y)


def advance(
    flow: Flow, state: StepperState, most: int
) -> tuple[StepperState, Bool[Array, "1 B"]]:
    """Try one step; accept it, or shorten it, or repeat it so that it ends at an event.

    Returns the state for the next pass, and a mask of the impacts that accept the step.
    """
    duals = flow
    start = state.y
    s = state.step
    flow, y = value_of((flow, start))  # without tangents
    n = y.shape[0]
    lands = s.lands > 0
    frame, active, local = _prepared(duals, state, most)
    change, errors, (c0, c1), (d0, d1) = _stages(duals, s, start, frame, ends=True)
    error2 = _squared_error(flow, s, y, errors, local)
    ok = error2 <= 1
    elapsed = value_of(change)[n:]  # the last row is time
    duration = jnp.where(ok & (elapsed > 0), elapsed, state.expected)
    course = _Course(c0, c1, d0 * duration, d1 * duration)
    urgent = _most_urgent(*_intentions(flow, s, state.aimed_twice, course))
    accept = ok & (urgent.intention == Intention.AHEAD) & active
    events = s.target & (accept & lands)  # one-hot
    # the field has no value, however short the step: given up, and the status reports
    # it
    no_value = ~(error2 < jnp.inf)
    broken = active & ~lands & no_value & (s.length < SHORTEST)

    def after(
        flow: Flow, y: Float[Array, "n B"], change: Float[Array, "_ B"]
    ) -> tuple[Int[Array, "modes B"], Float[Array, "n B"]]:
        """Modes and state after an accepted step; else the state before, or NaN if
        `broken`.
        """
        modes, end = flow.switch(s.modes, y + change[:n], events)
        otherwise = jnp.where(broken, jnp.nan, y)
        return modes, jnp.where(accept, end, otherwise)

    modes, end = pushforward(after, duals, start, change)
    end = dual_like(start, end)
    step, next_duration = _next_step(flow, s, modes, urgent, accept, error2, duration)
    passes = state.passes + active.astype(y.dtype)
    mark = state.mark_as_float
    pauses = flow.pauses(s.modes, modes, passes)
    if pauses is not None:
        mark = jnp.where(active & pauses, Mark.PAUSED, mark)
    over = flow.over(modes, value_of(end), passes) | broken
    not_ahead = urgent.intention < Intention.AHEAD
    aimed_twice = (step.lands > 0) & lands & not_ahead
    mark = jnp.where(over, Mark.OVER, mark)
    rows = [next_duration, aimed_twice.astype(y.dtype), mark, passes]
    progress = jnp.concatenate(rows)
    planned = jax.lax.stop_gradient((step, progress))
    return StepperState(end, *planned), accept


def _local_tolerance(
    flow: Flow, passes: Float[Array, "1 B"], dtype: Any
) -> Float[Array, "1 B"]:
    """The tolerance of one step: it falls with the number of passes beyond FULL for
    each contact.
    """
    full = FULL * flow.taking_part
    share = full / jnp.maximum(passes, full)
    return jnp.maximum(flow.tolerance * share, precision(dtype).noise)


def _squared_error(
    flow: Flow,
    s: Step,
    y: Float[Array, "n B"],
    errors: Float[Array, "2 n B"],
    local: Float[Array, "1 B"],
) -> Float[Array, "1 B"]:
    """Hairer's error of a step, squared, in tolerances.

    Equation: `e5^4 / (e5^2 + 0.01 e3^2)` of the largest scaled errors e5 and e3 of both
    estimates, with the `local` tolerance.
    """
    zero = precision(y.dtype)
    allowed = local * flow.allowance(s.modes, y)
    scale = allowed + zero.accumulated * jnp.abs(y)
    largest = jnp.max(jnp.abs(errors) / scale[None], axis=1)
    fifth, third = (x[None] for x in largest)
    # 0.01 is Hairer's; `tiny`: a landing of length 0 has no errors
    square = fifth**2 + 0.01 * third**2 + zero.tiny
    error2 = fifth**4 / square
    # small by chance where the fifth order is: a landing from a maximum, a step of half
    # a period
    return jnp.maximum(error2, (COARSE * third**2 * local) ** 2)


class _Course(NamedTuple):
    """Margins over a step: values c and slopes d, for a step of length 1, at both ends.

    Within the step a margin is Hermite's cubic, with v = 1 - u

        c(u) = (c0 (1 + 2 u) + d0 u) v^2 + (c1 (1 + 2 v) - d1 v) u^2.
    """

    c0: Float[Array, "k B"]
    c1: Float[Array, "k B"]
    d0: Float[Array, "k B"]
    d1: Float[Array, "k B"]

    def at(self, u: Float[Array, "k B"]) -> Float[Array, "k B"]:
        """Values c(u) at the places u of a step from 0 to 1."""
        c0, c1, d0, d1 = self
        v = 1 - u
        from_start = (c0 * (1 + 2 * u) + d0 * u) * v * v
        from_end = (c1 * (1 + 2 * v) - d1 * v) * u * u
        return from_start + from_end


def _intentions(
    flow: Flow, s: Step, aimed_twice: Float[Array, "1 B"], course: _Course
) -> tuple[Int[Array, "k B"], Float[Array, "k B"]]:
    """Intention and distance of each margin, from its course over the step `s`.

    A margin that has crossed 0 within the step is landed on where that can be done from
    the beginning of the step, else the step is shortened, as for one that dips below 0
    and returns; the distance is the place of the root or of the minimum. Others are
    ahead: distance of the root behind the end, or inf.
    """
    c0, c1, d0, d1 = course
    zero = flow.zero_margin
    free = ~s.target
    crossed = free & (c1 < -zero)
    falls_then_rises = (d0 < 0) & (d1 > 0)
    turns = free & falls_then_rises & (c0 > zero)
    place = _place_within(flow, crossed, course)
    doubtful = DOUBT * (d1 - d0) - zero
    dips = turns & (course.at(place) < doubtful)
    at_once = (c0 <= zero) & (d0 <= 0)
    if flow.near:
        direct = at_once
    else:
        direct = at_once | ((d0 < 0) & (c0 > zero))
    direct = direct & (aimed_twice == 0)
    steps_in_time = ~(s.lands > 0)
    ahead = _distance_ahead(zero, free & ~turns & steps_in_time, course)
    intention = jnp.where(dips, Intention.SHORTEN, Intention.AHEAD)
    crossing = jnp.where(direct, Intention.LAND, Intention.SHORTEN)
    intention = jnp.where(crossed, crossing, intention)
    place = jnp.where(crossed & direct & at_once, 0.0, place)
    return intention, jnp.where(crossed | dips, place, ahead)


def _distance_ahead(
    zero: Float[Array, "1 B"], which: Bool[Array, "k B"], course: _Course
) -> Float[Array, "k B"]:
    """Distance w behind the end of a step at which margins vanish, inf for those that
    do not, and for others than `which`.

    There a margin is the parabola `c1 + d1 w + (d1 - d0) w^2 / 2`, which has no root
    where the margin only creeps towards 0.
    """
    _, c1, d0, d1 = course
    discriminant = d1 * d1 - 2 * (d1 - d0) * c1
    falls = (d1 < 0) & (c1 > zero)
    ahead = which & falls & (discriminant > 0)
    root = jnp.sqrt(jnp.where(ahead, discriminant, 1.0))
    w = 2 * c1 / (root - jnp.where(ahead, d1, 0.0))
    return jnp.where(ahead, w, jnp.inf)


def _place_within(
    flow: Flow, crossed: Bool[Array, "k B"], course: _Course
) -> Float[Array, "k B"]:
    """Places u in a step at which margins vanish if they have `crossed` 0, otherwise
    turn.

    The first is the root of the chord `c0 + (c1 - c0) u`, of a margin that rises and
    falls back the root of the parabola `c0 + d0 u + (c1 - c0 - d0) u^2`; the second is
    the root of the slope `d0 + (d1 - d0) u`. A flow with `near` has the root of the
    cubic.
    """
    c0, c1, d0, d1 = course
    above = jnp.maximum(c0, 0.0)
    part = jnp.where(crossed, above, -d0)
    whole = jnp.where(crossed, c0 - c1, d1 - d0)
    u = part / jnp.where(whole > 0, whole, jnp.inf)
    rises = crossed & (d0 > 0)
    bend = jnp.where(rises, above + d0 - c1, 1.0)
    square = jnp.where(rises, d0 * d0 + 4 * bend * above, 1.0)
    root = jnp.sqrt(square)
    zero_of_parabola = (d0 + root) / (2 * bend)
    u = jnp.where(rises, zero_of_parabola, u)
    if flow.near:
        # a step in time precedes the landing: dt/dxi is singular at the top of a
        # parabola
        u = jnp.where(crossed, _root_of_cubic(u, course), u)
    return u


class _Urgent(NamedTuple):
    """The margin that decides about the next step."""

    intention: Int[Array, "1 B"]
    distance: Float[Array, "1 B"]
    target: Bool[Array, "k B"]  # one-hot


def _most_urgent(
    intention: Int[Array, "k B"], distance: Float[Array, "k B"]
) -> _Urgent:
    """The margin of least intention and, of equal ones, of least distance; ties go by
    the row.
    """
    # below 0: SHORTEN; from 0 to 1: LAND at this part of the step; above: AHEAD
    row = jnp.arange(len(distance), dtype=distance.dtype)
    tie = TIE * row[:, None]
    order = intention + distance + tie
    first = jnp.min(order, axis=0, keepdims=True)
    not_before = jnp.where(first <= Intention.AHEAD, Intention.LAND, Intention.AHEAD)
    chosen = jnp.where(first < Intention.LAND, Intention.SHORTEN, not_before)
    return _Urgent(chosen, first - chosen, order == first)


def _next_step(
    flow: Flow,
    s: Step,
    modes: Int[Array, "modes B"],
    urgent: _Urgent,
    accept: Bool[Array, "1 B"],
    error2: Float[Array, "1 B"],
    duration: Float[Array, "1 B"],
) -> tuple[Step, Float[Array, "1 B"]]:
    """The step to try after `s`, and the time it is expected to take.

    `duration` is the time that `s` takes, `error2` its error in tolerances, squared.
    """
    length = s.length
    lands = s.lands > 0
    ok = error2 <= 1
    event = urgent.intention < Intention.AHEAD
    # xi goes on from the end of an accepted step
    in_root = (s.in_root > 0) & ~lands
    passed = jnp.where(accept, length, 0.0)
    start = jnp.where(in_root, s.start + passed, 0.0)
    # the length: shorter before an event or after a failed landing, else by the error
    shorter = _shorter_length(flow, s, in_root, urgent, ok, duration)
    at_event = jnp.where(urgent.intention == Intention.SHORTEN, shorter, length)
    after_landing = jnp.where(ok, length, shorter)
    proposed = jnp.where(lands, after_landing, _length_from_error(length, error2))
    proposed = jnp.where(ok & event, at_event, proposed)
    closed = accept & flow.begins(s.modes, modes)
    in_root = in_root | closed
    start = jnp.where(closed, 0.0, start)
    proposed = _restart_in_root(closed, duration, proposed)
    in_time = jnp.minimum(proposed, flow.longest)
    proposed = jnp.where(in_root, proposed, in_time)
    # xi is the root of time: from `start` on a step takes this long
    time_in_root = (start + proposed) ** 2 - start**2
    expected = jnp.where(in_root, time_in_root, proposed)
    # the next step is a landing, in time, if one is due now or ahead
    reached = _reaches_event(flow, s.modes, urgent.distance, duration, expected)
    due = urgent.intention == Intention.LAND
    aim = ok & jnp.where(event, due, ~lands & reached)
    proposed = jnp.where(aim & in_root, expected, proposed)
    in_root = in_root & ~aim
    flags = [x.astype(length.dtype) for x in (in_root, aim)]
    clock = jnp.concatenate([start, proposed, *flags])
    step = Step(modes, aim & urgent.target, clock)
    return step, jnp.where(aim, urgent.distance * duration, expected)


def _length_from_error(
    length: Float[Array, "1 B"], error2: Float[Array, "1 B"]
) -> Float[Array, "1 B"]:
    """The length at which the error would be SAFETY^8 tolerances, as error ~
    length^8.
    """
    # four roots: error^(1/8) = error2^(1/16); 1e-20 keeps it from 0, far beyond GROWTH
    eighth_root = jnp.sqrt(jnp.sqrt(jnp.sqrt(jnp.sqrt(error2 + 1e-20))))
    factor = jnp.clip(SAFETY / eighth_root, SHRINK, GROWTH)
    return jnp.where(error2 < jnp.inf, factor, SHRINK) * length


def _shorter_length(
    flow: Flow,
    s: Step,
    in_root: Bool[Array, "1 B"],
    urgent: _Urgent,
    ok: Bool[Array, "1 B"],
    duration: Float[Array, "1 B"],
) -> Float[Array, "1 B"]:
    """The length that ends before an event, or half of the time of a failed landing."""
    if flow.near:
        part = 1 - flow.near
    else:
        part = CUT
    shortens = ok & (urgent.intention == Intention.SHORTEN)
    cut = jnp.where(shortens, part * urgent.distance, 0.5)
    # a landing is not in time: the shorter step is
    in_time = cut * jnp.where(s.lands > 0, duration, s.length)
    return jnp.where(in_root, jnp.sqrt(cut) * s.length, in_time)


def _restart_in_root(
    closed: Bool[Array, "1 B"],
    duration: Float[Array, "1 B"],
    length: Float[Array, "1 B"],
) -> Float[Array, "1 B"]:
    """The length, but of the first step after a contact has `closed` in the root of
    time.
    """
    restart = jnp.sqrt(jnp.minimum(RESTART * duration, FIRST))
    return jnp.where(closed & (restart > 0), restart, length)


def _reaches_event(
    flow: Flow,
    modes: Int[Array, "modes B"],
    distance: Float[Array, "1 B"],
    duration: Float[Array, "1 B"],
    expected: Float[Array, "1 B"],
) -> Bool[Array, "1 B"]:
    """Mask: the next step, of this expected time, shall land on the event ahead."""
    reached = distance * duration < expected
    coasts = flow.coasts(modes)
    if coasts is not None:
        reached = reached | (coasts & (distance < jnp.inf))
    if flow.near:
        return reached & (distance < REACH * flow.near)
    return reached


def _root_of_cubic(u: Float[Array, "k B"], course: _Course) -> Float[Array, "k B"]:
    """The root in [0, 1] near u of the cubic of the course.

    By Newton's method on `c0 v + c1 u + u v (v a + u b)`, with v = 1 - u,
    a = d0 - (c1 - c0) and b = (c1 - c0) - d1.
    """
    c0, c1, d0, d1 = course
    rise = c1 - c0
    a = d0 - rise
    b = rise - d1
    for _ in range(POLISH):
        v = 1 - u
        bend = v * a + u * b
        value = v * c0 + u * c1 + u * v * bend
        slope = rise + (v - u) * bend + u * v * (b - a)
        falling = jnp.where(slope < 0, slope, -jnp.inf)
        u = jnp.clip(u - value / falling, 0.0, 1.0)
    return u


def between(
    flow: Flow, s: Step, y: Float[Array, "n B"], ahead: Float[Array, "1 B"]
) -> Float[Array, "n B"]:
    """The state within the step from y at the time `ahead` after it, in the flow's own
    time.

    In the root xi of time, `xi^2 = xi_0^2 + ahead`.
    """
    in_root = s.in_root * (1 - s.lands)
    start = s.start * in_root
    reached = start**2 + ahead
    positive = reached > 0
    square = jnp.where(positive, reached, 1.0)
    root = jnp.where(positive, jnp.sqrt(square), 0.0)
    h = jnp.where(in_root > 0, root - start, ahead)
    no_landing = jnp.zeros_like(h)
    clock = jnp.concatenate([start, h, in_root, no_landing])
    no_target = jnp.zeros_like(s.target)
    return step_again(flow, Step(s.modes, no_target, clock), y)


def step_again(flow: Flow, s: Step, y: Float[Array, "n B"]) -> Float[Array, "n B"]:
    """The state after an accepted step, as a smooth function of `flow` and `y`."""
    frame = pushforward(lambda flow, y: _frame(flow, s, y), flow, y)
    return y + _stages(flow, s, y, frame, ends=False).change[:-1]
