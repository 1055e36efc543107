"""Forces in contacts as a flow: LZB, gaps and viscous forces, with and without planar
friction.

With sqrt-energy units (see `impact_dynamics.py`) and frozen geometry the law reads

    x_j' = -omega_j c_j gamma_j,   p_j' = F_j = (eta_j + 1)/2 omega_j x_j^eta_j,
    gamma' = G F + K_nt lambda,    u' = K_tn F + K_tt lambda

with stored energy x_j^(eta_j + 1) / 2. A law states F and c (`ContactEquations`); LZB
has c_j = 1 in compression and 1/e_j^2 in expansion. In expansion g_j = gamma_j / e_j
takes the place of gamma_j, and time runs in units of the smallest e of these contacts:
nothing is then divided by e, so that e = 0 is an ordinary, differentiable case (the
whole expansion takes no time; derivatives in e there are one-sided).

STATE (rows)   x, g, p (m each, `Contacts`), time; with friction slip u and its impulse
               (t each). A flow that `watches` its exponents has one more before the
               time.
MODES (rows)   phase, how often each contact has closed, with friction the slip: 0
               sticks, +-1 the direction (m each, `Modes`).

A contact is OPEN, in COMPRESSION or in EXPANSION. Without gaps the geometry is frozen:
an open contact closes as soon as gamma < 0. With gaps (`gapped`) it keeps track of x =
-gap and closes when that returns to 0. A `viscous` force replaces the power law; it
never pulls, so that a contact may be SLACK: x > 0, and no force. It opens at x = 0,
from SLACK or, with what force it has there, from COMPRESSION. With a `limit` of x the
force is bounded: the contact YIELDS at x = limit until it expands, and what it takes up
meanwhile is lost.
"""

import dataclasses
import enum
import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped

from jimpact.numerics.dense import COLUMNS_WRITTEN_OUT, times, unit
from jimpact.numerics.sparse import Neighbours, neighbour_sum
from jimpact.numerics.stepper import Flow, any_of, total
from jimpact.numerics.tangents import without_slope
from jimpact.numerics.tridiagonal import tridiagonal_product
from jimpact.tools.masks import quotient


class Phase(enum.IntEnum):
    """Phase of a contact, which lasts for whole steps."""

    OPEN = 0
    COMPRESSION = 1
    EXPANSION = 2
    SLACK = 3
    YIELD = 4


# The first two are in tolerances of velocity. Margins closer to 0 than SNAP are 0; ten
# times more would move events by a tenth of the tolerance. An approach or a load below
# NEGLIGIBLE does nothing more; ten times more would lose what the tolerance promises.
SNAP = 1e-2
NEGLIGIBLE = 0.1
# Passes per contact after which an impact may end at WIDENED times the tolerance: some
# re-close so often that they would not end. Ten times more passes: such impacts take
# ten times longer; ten times wider: they end with errors of 1000 tolerances.
PATIENCE = 2000
WIDENED = 100.0  # tolerances, at which an impact may end after PATIENCE passes
# Passes per contact, which few impacts need, before endless closings are checked for;
# ten times more: they are detected later.
DRAGGING = 100
# Closings of a contact, from which on they may be endless, a power of 2: ten times
# more:
# detected later.
OFTEN = 8
# Contacts of a chain, more of which may come to rest together in no order that returns;
# passes per contact after which a look ahead decides (`look_ahead.py`), again after
# twice, four times as many. Ten times more contacts: chains of 20 take 30 times as
# long; ten times more passes: as much later.
MANY = 8
LOOKS = 15
# Tolerances within which a flow watches the derivative of its forces in the exponents;
# the tolerance is then that of derivatives, a hundred times finer than the law's. Ten
# times more: such derivatives are ten times coarser than the others.
WATCHED = 100.0
# Whole and half exponents below it are products, not powers. Ten times more: longer
# products.
LARGE = 6.0

T = TypeVar("T")
Exponent = float | tuple[float, ...] | jax.Array


def power(x: Float[Array, "m *B"], exponent: Exponent) -> Float[Array, "m *B"]:
    """`max(x, 0)^exponent` of exponents >= 1, with finite derivatives at 0.

    A static one, or a tuple of equal ones, that is a multiple of 1/2 below LARGE is a
    product of factors x and sqrt(x), which is faster than `exp(eta log x)`.
    """
    if isinstance(exponent, tuple) and len(set(exponent)) == 1:
        exponent = exponent[0]
    if isinstance(exponent, float) and exponent == 1.0:
        return jnp.where(x >= 0, x, 0.0)  # at 0 the derivative of a contact that closes
    positive = x > 0
    safe = jnp.where(positive, x, 1.0)
    if isinstance(exponent, float) and exponent < LARGE and (2 * exponent).is_integer():
        x = jnp.where(positive, x, 0.0)
        whole = [x] * int(exponent)
        if exponent.is_integer():
            factors = whole
        else:
            factors = [*whole, jnp.sqrt(safe)]
        return functools.reduce(jnp.multiply, factors)
    eta = per_row(exponent, x)
    raised = jnp.exp(eta * jnp.log(safe))
    return jnp.where(positive, raised, 0.0)


def per_row(values: Exponent, like: Float[Array, "m *B"]) -> Float[Array, "#m *#B"]:
    """Values of contacts, (m,) or one, with axes of length 1 to broadcast against
    `like`.
    """
    values = jnp.asarray(values, like.dtype)
    if values.ndim == like.ndim:
        return values
    axes_of_batch = [1] * (like.ndim - 1)
    return values.reshape(-1, *axes_of_batch)


def smallest_of(s: Float[Array, "m B"]) -> Float[Array, "1 B"]:
    """The smallest s_j; of several equal ones, one has the whole derivative."""
    m = s.shape[0]
    if m <= COLUMNS_WRITTEN_OUT:
        rows = [s[j : j + 1] for j in range(m)]
        return functools.reduce(lambda a, b: jnp.where(b < a, b, a), rows)
    j = jnp.argmin(s, axis=0, keepdims=True)
    return jnp.take_along_axis(s, j, axis=0)


def largest_of(x: Shaped[Array, "k *B"]) -> Shaped[Array, "1 *B"]:
    """The largest of the rows."""
    return jnp.max(x, axis=0, keepdims=True)


def plus_one(exponent: Exponent) -> Exponent:
    """`exponent + 1`, static where `exponent` is."""
    if isinstance(exponent, tuple):
        return tuple(e + 1 for e in exponent)
    return exponent + 1


class ContactEquations(NamedTuple):
    """The equations of a contact that stores and returns energy; a law states them.

    They are functions of module level, which programs are compiled for; see
    `laws/lzb.py`. Units are their arguments' own: a flow calls them without dimension.
    """

    force: Callable[..., Any]  # F(x, k, eta)
    scale: Callable[..., Any]  # s(expands, e): x' = -gamma / s^2
    depth: Callable[..., Any]  # x(q, k, eta) at which the energy q^2 / 2 is stored


def is_power_of_two(n: Int[Array, "1 *B"]) -> Bool[Array, "1 *B"]:
    """Mask: n is 1, 2, 4, 8, ..."""
    return (n > 0) & (n & (n - 1) == 0)


class Viscous(NamedTuple):
    """A force `model` (see `laws/forces.py`), and the units that make it
    dimensionless.
    """

    model: Any
    indentation: Float[Array, "m *B"]  # X [m]
    speed: Float[Array, "m *B"]  # V [m/s]
    force: Float[Array, "m *B"]  # F_0 [N]
    onset_unit: Float[Array, "m *B"]  # of `onset`, whose dimension is the model's own

    def push(
        self, x: Float[Array, "m B"], gamma: Float[Array, "m B"]
    ) -> Float[Array, "m B"]:
        """Dimensionless force `max(F(X x, -V gamma), 0) / F_0`: it never pulls."""
        x = jnp.where(x >= 0, x, 0.0) * self.indentation
        force = self._value("force", x, gamma)
        return jnp.maximum(force / self.force, 0.0)

    def onset(
        self, x: Float[Array, "m B"], gamma: Float[Array, "m B"]
    ) -> Float[Array, "m B"]:
        """Smooth function of order 1 with the sign of the force, which says where it
        sets in.
        """
        x = jnp.where(x >= 0, x, 0.0) * self.indentation
        return self._value("onset", x, gamma) / self.onset_unit

    def _value(
        self, name: str, x: Float[Array, "m B"], gamma: Float[Array, "m B"]
    ) -> Float[Array, "m B"]:
        """Method `name` of the model at x [m] and -V gamma [m/s]; it knows one impact,
        no batch.
        """

        def of_one(
            model: Any, x: Float[Array, " m"], rate: Float[Array, " m"]
        ) -> Float[Array, " m"]:
            """The method's values in the contacts of one impact."""
            return getattr(model, name)(x, rate)

        of_batch = jax.vmap(of_one, in_axes=-1, out_axes=-1)
        return of_batch(self.model, x, -gamma * self.speed)


# fields of flows and couplings that are no arrays: they belong to the program
COMPILED_IN = (
    "equations",
    "exponent_static",
    "gapped",
    "closed_form",
    "watches",
    "slopes",
    "neighbours",
)


def as_pytree(kind: type[T]) -> type[T]:
    """A dataclass of arrays as a pytree; the fields COMPILED_IN belong to its
    structure.

    JAX rebuilds it without its constructor, whose annotations hold for arrays only: in
    between the leaves are `Dual`s, axes or placeholders.
    """
    names = [field.name for field in dataclasses.fields(kind)]  # type: ignore[arg-type]
    arrays = [name for name in names if name not in COMPILED_IN]
    fixed = [name for name in names if name in COMPILED_IN]

    def flatten(tree: T) -> tuple[list[Any], tuple[Any, ...]]:
        """Values of the fields that are arrays, and of the others."""
        leaves = [getattr(tree, name) for name in arrays]
        structure = tuple(getattr(tree, name) for name in fixed)
        return leaves, structure

    def unflatten(structure: tuple[Any, ...], leaves: Any) -> T:
        """The inverse of `flatten`."""
        tree = object.__new__(kind)
        for name, value in zip(arrays, leaves):
            object.__setattr__(tree, name, value)
        for name, value in zip(fixed, structure):
            object.__setattr__(tree, name, value)
        return tree

    jax.tree_util.register_pytree_node(kind, flatten, unflatten)
    return kind


def written_out(coupling: Any, n: int) -> Float[Array, "n n B"]:
    """The matrix of n rows of a coupling that multiplies: its products with unit
    vectors.
    """
    entries = jax.tree.leaves(coupling)[0]
    one = jnp.eye(n, dtype=entries.dtype)[..., None]
    batch = entries.shape[-1]
    columns = jnp.broadcast_to(one, (n, n, batch))
    return jax.vmap(coupling.times, out_axes=1)(columns)


class Chain(NamedTuple):
    """The coupling of a chain: a tridiagonal G with unit diagonal."""

    off_diagonal: Float[Array, "_ B"]  # m - 1 entries G_j,j+1

    def dense(self, n: int) -> Float[Array, "n n B"]:
        """The matrix G of n rows."""
        return written_out(self, n)

    def times(self, f: Float[Array, "m B"]) -> Float[Array, "m B"]:
        """Products `G f`."""
        return tridiagonal_product(f, self.off_diagonal, f)

    def magnitude(self) -> "Chain":
        """|G|, entry by entry."""
        return Chain(jnp.abs(self.off_diagonal))

    def pull(self) -> "Chain":
        """min(G, 0) with its unit diagonal."""
        return Chain(jnp.minimum(self.off_diagonal, 0.0))


class Dense(NamedTuple):
    """A coupling matrix that is stored whole."""

    matrix: Float[Array, "m m B"]

    def dense(self, _: int) -> Float[Array, "m m B"]:
        """The matrix."""
        return self.matrix

    def times(self, f: Float[Array, "m B"]) -> Float[Array, "m B"]:
        """Products `G f`."""
        return times(self.matrix, f)

    def _off_diagonal(self) -> Float[Array, "m m B"]:
        """G without its diagonal."""
        return self.matrix * (1 - unit(self.matrix))

    def magnitude(self) -> "Dense":
        """|G|, entry by entry, with a unit diagonal."""
        others = jnp.abs(self._off_diagonal())
        return Dense(others + unit(self.matrix))

    def pull(self) -> "Dense":
        """min(G, 0) with a unit diagonal."""
        others = jnp.minimum(self._off_diagonal(), 0.0)
        return Dense(others + unit(self.matrix))


@as_pytree
@dataclasses.dataclass(frozen=True)
class Packing:
    """The coupling of a packing: entries of G off its unit diagonal, at neighbours of
    each row.
    """

    entries: Float[Array, "m K B"]
    neighbours: Neighbours

    def dense(self, n: int) -> Float[Array, "n n B"]:
        """The matrix G of n rows."""
        return written_out(self, n)

    def times(self, f: Float[Array, "m B"]) -> Float[Array, "m B"]:
        """Products `G f`."""
        return f + neighbour_sum(self.entries, f, self.neighbours)

    def magnitude(self) -> "Packing":
        """|G|, entry by entry."""
        return dataclasses.replace(self, entries=jnp.abs(self.entries))

    def pull(self) -> "Packing":
        """min(G, 0) with its unit diagonal."""
        return dataclasses.replace(self, entries=jnp.minimum(self.entries, 0.0))


Coupling = Chain | Dense | Packing


class Frozen(NamedTuple):
    """Factors of the normal field that do not change while the modes last."""

    unit: Float[Array, "1 B"]  # time unit s*: the smallest s_j
    ratio: Float[Array, "m B"]  # s* / s_j
    closing: Float[Array, "m B"]  # x' / g
    stiffness: Float[Array, "m B"]  # force / x^eta
    scale: Float[Array, "m B"]  # s_j = gamma / g


class Contacts(NamedTuple):
    """Rows of a state, or of its rates, that all flows have: m of each kind."""

    x: Float[Array, "m B"]  # indentations
    g: Float[Array, "m B"]  # gamma / s
    p: Float[Array, "_ B"]  # impulses; none within a step without friction


class Modes(NamedTuple):
    """Rows of modes: m of each kind."""

    phase: Int[Array, "m B"]
    closings: Int[Array, "m B"]  # how often each contact has closed
    slip: Int[Array, "_ B"]  # none without friction

    def packed(self) -> Int[Array, "modes B"]:
        """The rows as one array."""
        return jnp.concatenate(self)


class Margins(NamedTuple):
    """Rows of margins, or of the mask of those that are events: m of each kind.

    What the rows mean depends on the mode of each contact, see `normal_margins`.
    """

    by_x: Shaped[Array, "m B"]  # by indentation
    by_g: Shaped[Array, "m B"]  # by velocity
    slip: Shaped[Array, "_ B"]  # slip stops; none without friction
    cone: Shaped[Array, "_ B"]  # stick, or creep, ends; none without friction

    def packed(self) -> Shaped[Array, "k B"]:
        """The rows as one array."""
        return jnp.concatenate(self)


class ContactStates(NamedTuple):
    """Forces and motion of the contacts in a state, dimensionless."""

    force: Float[Array, "m B"]  # F
    indentation: Float[Array, "m B"]  # x
    impulse: Float[Array, "m B"]  # p
    gap_velocity: Float[Array, "m B"]  # gamma
    tangential_force: Float[Array, "t B"]  # lambda
    tangential_impulse: Float[Array, "t B"]  # its integral
    slip: Float[Array, "t B"]  # u
    # twice that of tangential springs (m), or none
    tangential_energy: Float[Array, "_ B"]
    rate: Float[Array, "1 B"]  # of time, in the flow's own time


@as_pytree
@dataclasses.dataclass
class ContactFlow(Flow):
    """The motion of m contacts without friction; see above for its state and its
    modes.
    """

    coupling: Coupling
    equations: ContactEquations
    omega: Float[Array, "m B"]
    restitution: Float[Array, "m B"]
    exponent_array: Float[Array, "m B"] | None
    tolerance: Float[Array, "1 B"]
    taking_part: Float[Array, "1 B"]  # contacts that are not open for good
    viscous: Viscous | None = None
    limit: Float[Array, "m B"] | None = None  # indentation at which the force stays
    exponent_static: float | tuple[float, ...] | None = None
    gapped: bool = False
    # an impact may end by the energy of contacts that work alone
    closed_form: bool = True
    # Steps are also short enough for the derivative in the exponents, F log x: it is
    # less smooth at x = 0 than F. At exponent 1 F is linear, and steps of any length
    # would do for it alone.
    watches: bool = False
    slopes: bool = False  # the run has derivatives: states without any are marked

    longest = math.inf  # no rate is much larger than the others

    @property
    def exponent(self) -> Exponent:
        """Exponents of the contacts: compiled in, or an array."""
        static = self.exponent_static
        return static if static is not None else self.exponent_array  # type: ignore[return-value]

    @property
    def contacts(self) -> int:
        """Number m of contacts."""
        return self.omega.shape[0]

    @property
    def zero_margin(self) -> Float[Array, "1 B"]:
        """Margins below this are 0."""
        return SNAP * self.tolerance

    @property
    def slackens(self) -> bool:
        """True if a contact may lose its force before its indentation."""
        return self.viscous is not None and self.viscous.model.slackens

    # ---- the state

    @property
    def driving(self) -> tuple[int, ...]:
        """Sizes of the blocks of rows that the field depends on: x and g."""
        return self.contacts, self.contacts

    @property
    def adding(self) -> tuple[int, ...]:
        """Sizes of the blocks of rows that only add up: p, the watching row, time."""
        if self.watches:
            return (self.contacts, 1, 1)
        return (self.contacts, 1)

    def rows(self, y: Float[Array, "driving B"]) -> Contacts:
        """Rows of a state: indentations x, g = gamma / s, impulses p."""
        m = self.contacts
        return Contacts(x=y[:m], g=y[m : 2 * m], p=y[2 * m : 3 * m])

    def with_rows(self, y: Float[Array, "n B"], rows: Contacts) -> Float[Array, "n B"]:
        """The state with these rows x, g and p, its other rows as they are."""
        return jnp.concatenate([*rows, y[3 * self.contacts :]])

    def modes(self, modes: Int[Array, "modes B"]) -> Modes:
        """Rows of modes: phases, closings, slip."""
        m = self.contacts
        return Modes(phase=modes[:m], closings=modes[m : 2 * m], slip=modes[2 * m :])

    def kinds(self, margins: Shaped[Array, "k B"]) -> Margins:
        """Rows of margins, or of the mask of events, by kind."""
        m = self.contacts
        return Margins(
            by_x=margins[:m],
            by_g=margins[m : 2 * m],
            slip=margins[2 * m : 3 * m],
            cone=margins[3 * m :],
        )

    def side_impulse(self, y: Float[Array, "n B"]) -> Float[Array, "t B"]:
        """Tangential impulse of a state: none without friction."""
        return y[:0]

    def start(
        self, gamma: Float[Array, "m B"], x: Float[Array, "m B"]
    ) -> tuple[Int[Array, "modes B"], Float[Array, "n B"]]:
        """Modes and state before the impact: no contact has closed, no impulse acted.

        A contact starts OPEN where it is apart, x < 0, or separates without load; in
        EXPANSION, if forces do not slacken, where it separates under load, but OPEN and
        unloaded there if e = 0; else, also touching at rest, in COMPRESSION.
        """
        closed = (gamma <= 0) | (x > 0)
        phase = jnp.where(closed, Phase.COMPRESSION, Phase.OPEN)
        phase = jnp.where(x < 0, Phase.OPEN, phase)
        expands = (x > 0) & (gamma > 0)
        if not self.slackens:
            phase = jnp.where(expands, Phase.EXPANSION, phase)
        # loaded, separating and e = 0: it opens at once and returns nothing
        spent = (phase == Phase.EXPANSION) & (self.restitution == 0)
        phase = jnp.where(spent, Phase.OPEN, phase)
        x = jnp.where(spent, 0.0, x)
        g = gamma / self.equations.scale(phase == Phase.EXPANSION, self.restitution)
        no_closings = jnp.zeros_like(phase)
        modes = jnp.concatenate([phase, no_closings]).astype(jnp.int32)
        p = jnp.zeros_like(g)
        time = jnp.zeros_like(self.tolerance)
        watched = time
        if self.watches:
            return modes, jnp.concatenate([x, g, p, watched, time])
        return modes, jnp.concatenate([x, g, p, time])

    def scales(self, modes: Int[Array, "modes B"]) -> Float[Array, "m B"]:
        """`s_j = gamma_j / g_j`: of LZB's equations e_j in expansion, otherwise 1."""
        expands = self.modes(modes).phase == Phase.EXPANSION
        return self.equations.scale(expands, self.restitution)

    def loaded(self, modes: Int[Array, "modes B"]) -> Bool[Array, "m B"]:
        """Mask of the contacts in compression or expansion."""
        phase = self.modes(modes).phase
        return (phase == Phase.COMPRESSION) | (phase == Phase.EXPANSION)

    # ---- the protocol

    def constants(self, modes: Int[Array, "modes B"]) -> Any:
        """Constants of the field in these modes; without friction its normal factors
        alone.
        """
        return self.normal_constants(modes)

    def normal_constants(self, modes: Int[Array, "modes B"]) -> Frozen:
        """Factors of the normal field in the phases of the contacts."""
        phase = self.modes(modes).phase
        s = self.scales(modes)
        # time in units of the smallest s makes e = 0 regular
        unit = smallest_of(s)
        ratio = quotient(unit, s, where=s > 0, otherwise=1.0)
        if self.gapped:
            moves = jnp.ones_like(phase, bool)
        else:
            moves = phase != Phase.OPEN
        loaded = (phase == Phase.COMPRESSION) | (phase == Phase.EXPANSION)
        if self.limit is not None:
            moves = moves & (phase != Phase.YIELD)
            loaded = loaded | (phase == Phase.YIELD)
        closing = jnp.where(moves, -ratio * self.omega, 0.0)
        eta = per_row(self.exponent, self.omega)
        stiffness = (eta + 1) / 2 * self.omega
        stiffness = jnp.where(loaded, stiffness, 0.0)
        return Frozen(unit, ratio, closing, stiffness, scale=s)

    def force(
        self, const: Frozen, x: Float[Array, "m B"], g: Float[Array, "m B"]
    ) -> Float[Array, "m B"]:
        """Normal forces F(x, stiffness, eta) of the law's equations, `p' = unit F`.

        Of a viscous model `F(x, -g)` while the contact is loaded, otherwise 0.
        """
        if self.viscous is None:
            return self.equations.force(x, const.stiffness, self.exponent)
        push = self.viscous.push(x, g)
        return jnp.where(const.stiffness > 0, push, 0.0)

    def field(
        self, const: Any, modes: Int[Array, "modes B"], y: Float[Array, "driving B"]
    ) -> Float[Array, "n B"]:
        """Rates `x' = closing g`, `g' = ratio G F`, `p' = unit F` and of time, `unit`.

        The watching row before the time has the rate `unit sum_j F_j log x_j`.
        """
        x, g, _ = self.rows(y)
        f = self.force(const, x, g)
        dx = const.closing * g
        dg = const.ratio * self.coupling.times(f)
        dp = const.unit * f
        if not self.watches:
            return jnp.concatenate([dx, dg, dp, const.unit])
        positive = jnp.where(x > 0, x, 1.0)
        slope = f * jnp.log(positive)
        watched = jax.lax.stop_gradient(const.unit * total(slope))
        return jnp.concatenate([dx, dg, dp, watched, const.unit])

    def allowance(
        self, modes: Int[Array, "modes B"], y: Float[Array, "n B"]
    ) -> Float[Array, "n #B"] | float:
        """Allowed error of each row, in tolerances: more in the row that only
        watches.
        """
        if not self.watches:
            return 1.0
        one = jnp.ones((3 * self.contacts, 1), y.dtype)
        watched = jnp.full((1, 1), WATCHED, y.dtype)
        time = jnp.ones((1, 1), y.dtype)
        return jnp.concatenate([one, watched, time])

    def margins(
        self, const: Any, modes: Int[Array, "modes B"], y: Float[Array, "driving B"]
    ) -> Float[Array, "k B"]:
        """Margins that are >= 0 until a contact changes its mode; without friction its
        phase.
        """
        return self.normal_margins(const, modes, y)

    def normal_margins(
        self, const: Frozen, modes: Int[Array, "modes B"], y: Float[Array, "driving B"]
    ) -> Float[Array, "k B"]:
        """Margins that are >= 0 while a contact keeps its phase: m by indentation, m by
        velocity.

            phase         by indentation              by velocity
            OPEN          1; with gaps -x             g + NEGLIGIBLE tolerance;
                                                      with gaps 1
            COMPRESSION   1; with a limit limit - x   -g
            EXPANSION     x                           g
            YIELD         1                           -g

        Where forces slacken, as only laws with gaps do, these take their place: by
        indentation `onset` in COMPRESSION and `-onset` in SLACK, by velocity x in both.
        `onset` > 0 while spring and damper together press.
        """
        x, g, _ = self.rows(y)
        phase = self.modes(modes).phase
        by_x = jnp.where(phase == Phase.EXPANSION, x, 1.0)
        by_g = jnp.where(phase == Phase.COMPRESSION, -g, g)
        if self.limit is not None:
            by_x = jnp.where(phase == Phase.COMPRESSION, self.limit - x, by_x)
            by_g = jnp.where(phase == Phase.YIELD, -g, by_g)
        if not self.gapped:
            idle = NEGLIGIBLE * self.tolerance
            by_g = by_g + jnp.where(phase == Phase.OPEN, idle, 0.0)
            return jnp.concatenate([by_x, by_g])
        by_x = jnp.where(phase == Phase.OPEN, -x, by_x)
        by_g = jnp.where(phase == Phase.OPEN, 1.0, by_g)
        if self.slackens:
            onset = self.viscous.onset(x, g)  # type: ignore[union-attr]
            compressed = phase == Phase.COMPRESSION
            slack = phase == Phase.SLACK
            of_slack = jnp.where(slack, -onset, by_x)
            by_x = jnp.where(compressed, onset, of_slack)
            by_g = jnp.where(compressed | slack, x, by_g)
        return jnp.concatenate([by_x, by_g])

    def rooted(self, modes: Int[Array, "modes B"]) -> Bool[Array, "k B"]:
        """Mask of the margins that are openings: x falls to 0 like the square of the
        time left.
        """
        phase = self.modes(modes).phase
        opens = phase == Phase.EXPANSION
        by_g = (phase == Phase.COMPRESSION) & self.slackens
        return jnp.concatenate([opens, by_g])

    def switch(
        self,
        modes: Int[Array, "modes B"],
        y: Float[Array, "n B"],
        which: Bool[Array, "k B"],
    ) -> tuple[Int[Array, "modes B"], Float[Array, "n B"]]:
        """Modes and state after the events `which`; without friction those of the
        normal motion.
        """
        return self.normal_switch(modes, y, which)

    def normal_switch(
        self,
        modes: Int[Array, "modes B"],
        y: Float[Array, "n B"],
        which: Bool[Array, "k B"],
    ) -> tuple[Int[Array, "modes B"], Float[Array, "n B"]]:
        """Phases, closings, x and g after events by indentation and by velocity.

        An event ends the phase whose margin it is, see `normal_margins`. Where forces
        slacken: `_slackening`; elsewhere: `_turning`. The state has no slopes where it
        is `at_corner`.
        """
        phase, closings, slip = self.modes(modes)
        by_x, by_g, _, _ = self.kinds(which)
        if self.slopes:
            corner = self.at_corner(phase, y, by_g)
            y = without_slope(y, corner)
        if self.slackens:
            closed = by_x & (phase == Phase.OPEN)
            after, rows = self._slackening(phase, self.rows(y), by_x, by_g)
        else:
            closed = (by_x | by_g) & (phase == Phase.OPEN)
            after, rows = self._turning(phase, self.rows(y), by_x, by_g)
        closings = closings + closed.astype(closings.dtype)
        now = Modes(after, closings, slip)
        packed = now.packed().astype(modes.dtype)
        return packed, self.with_rows(y, rows)

    def _turning(
        self,
        phase: Int[Array, "m B"],
        rows: Contacts,
        by_x: Bool[Array, "m B"],
        by_g: Bool[Array, "m B"],
    ) -> tuple[Int[Array, "m B"], Contacts]:
        """Phases and rows after events of forces that last as long as the indentation.

            phase        event                next phase   set
            OPEN         by_x or by_g         COMPRESSION  x = 0 with gaps
            COMPRESSION  g = 0                EXPANSION    g = 0
            COMPRESSION  g = 0, idle          OPEN         g = 0, x = 0
            COMPRESSION  x = limit            YIELD        x = limit
            YIELD        g = 0                EXPANSION    g = 0
            EXPANSION    x = 0                OPEN         g = e g, x = 0
            EXPANSION    g = 0                COMPRESSION  g = 0

        Idle are contacts whose energy `x^(eta + 1)` is below (NEGLIGIBLE tolerance)^2,
        so that they would do nothing more.
        """
        x, g, p = rows
        opened = by_x & (phase == Phase.EXPANSION)
        closed = (by_x | by_g) & (phase == Phase.OPEN)
        turned = by_g & (phase == Phase.COMPRESSION)
        left = power(x, plus_one(self.exponent))
        idle = left <= (NEGLIGIBLE * self.tolerance) ** 2
        turns_to = jnp.where(idle, Phase.OPEN, Phase.EXPANSION)
        after = jnp.where(turned, turns_to, phase)
        if self.limit is not None:
            yields = by_x & (phase == Phase.COMPRESSION) & ~turned
            x = jnp.where(yields, self.limit, x)
            after = jnp.where(yields, Phase.YIELD, after)
            unloads = by_g & (phase == Phase.YIELD)
            after = jnp.where(unloads, Phase.EXPANSION, after)
        returns = by_g & (phase == Phase.EXPANSION)
        after = jnp.where(returns, Phase.COMPRESSION, after)
        after = jnp.where(closed, Phase.COMPRESSION, after)
        after = jnp.where(opened, Phase.OPEN, after)
        g = jnp.where(opened, self.restitution * g, g)
        g = jnp.where(by_g & (phase != Phase.OPEN), 0.0, g)
        at_zero = opened | (turned & idle) | (closed & self.gapped)
        x = jnp.where(at_zero, 0.0, x)
        return after, Contacts(x, g, p)

    def at_corner(
        self,
        phase: Int[Array, "m B"],
        y: Float[Array, "n B"],
        turned: Bool[Array, "m B"],
    ) -> Bool[Array, "1 B"]:
        """Mask: two contacts with e = 0 that act on each other end compression at once.

        Their expansions take no time. Which of them is over when the other begins
        depends on the direction in which anything changes, and so do the slopes of the
        outcome.
        """
        _, g, _ = self.rows(y)
        sudden = (phase == Phase.COMPRESSION) & (self.restitution == 0)
        ends = sudden & turned
        together = sudden & (jnp.abs(g) <= self.zero_margin)
        load = ends.astype(y.dtype)
        pushed = self.coupling.magnitude().times(load) - load > 0
        return any_of(together & pushed)

    def _slackening(
        self,
        phase: Int[Array, "m B"],
        rows: Contacts,
        by_x: Bool[Array, "m B"],
        by_g: Bool[Array, "m B"],
    ) -> tuple[Int[Array, "m B"], Contacts]:
        """Phases and rows after events of forces that may end before the indentation.

        COMPRESSION ends SLACK where the force ends, SLACK in COMPRESSION where it sets
        in; both end OPEN at x = 0, where OPEN closes to COMPRESSION.
        """
        x, g, p = rows
        is_open = phase == Phase.OPEN
        opened = by_g & ~is_open
        closed = by_x & is_open
        free = (phase == Phase.SLACK) | is_open
        ends = by_x & (phase == Phase.COMPRESSION)
        after = jnp.where(ends, Phase.SLACK, phase)
        after = jnp.where(by_x & free, Phase.COMPRESSION, after)
        after = jnp.where(opened, Phase.OPEN, after)
        x = jnp.where(opened | closed, 0.0, x)
        return after, Contacts(x, g, p)

    def begins(
        self, before: Int[Array, "modes B"], after: Int[Array, "modes B"]
    ) -> Bool[Array, "1 B"]:
        """Mask: a contact has closed behind a gap, from where on x grows like t.

        False without gaps: there x sets in like t^2, and forces are smooth enough.
        """
        if not self.gapped:
            return jnp.zeros((1, *before.shape[1:]), bool)
        closed_before = self.modes(before).closings
        return any_of(self.modes(after).closings > closed_before)

    def coasts(self, modes: Int[Array, "modes B"]) -> Bool[Array, "1 B"] | None:
        """Mask: no contact is loaded; None without gaps."""
        if not self.gapped:
            return None
        phase = self.modes(modes).phase
        return ~any_of((phase != Phase.OPEN) & (phase != Phase.SLACK))

    # ---- results

    def contact_states(
        self, modes: Int[Array, "modes B"], y: Float[Array, "n B"]
    ) -> ContactStates:
        """Forces, velocities and the rate of time in a state."""
        const = self.normal_constants(modes)
        none = y[:0]
        x, g, p = self.rows(y)
        return ContactStates(
            force=self.force(const, x, g),
            indentation=x,
            impulse=p,
            gap_velocity=const.scale * g,
            tangential_force=none,
            tangential_impulse=none,
            slip=none,
            tangential_energy=none,
            rate=const.unit,
        )

    def change(self, y: Float[Array, "n B"]) -> Float[Array, "m B"]:
        """Change `G p` of the gap velocities by the impulses of a state."""
        return self.coupling.times(self.rows(y).p)

    # ---- the end

    @property
    def at_once(self) -> bool:
        """True if `finish` alone is the impact: one contact, with a closed form."""
        return self.closed_form and self.contacts == 1

    @property
    def self_similar(self) -> bool:
        """True if a state multiplied by s takes the same course: see
        `plastic_limit.py`.
        """
        return not self.gapped and self.viscous is None

    def first_cycle(
        self, gamma: Float[Array, "m B"], modes: Int[Array, "modes B"]
    ) -> Any:
        """None: friction wedges no contacts; see `wedged_limit.py`."""
        return None

    @property
    def looks_ahead(self) -> bool:
        """True if the chain is so long that a look ahead decides whether it comes to
        rest.
        """
        long_chain = isinstance(self.coupling, Chain) and self.contacts > MANY
        return long_chain and self.self_similar

    def look_due(self, passes: Float[Array, "1 B"]) -> Bool[Array, "1 B"]:
        """Mask: passes per contact are LOOKS times 1, 2, 4, ..., and energy is lost."""
        interval = LOOKS * self.contacts
        passes = passes.astype(jnp.int32)
        number = jax.lax.div(passes, jnp.full_like(passes, interval))
        due = (passes == number * interval) & is_power_of_two(number)
        return due & any_of(self.restitution < 1)

    def pauses(
        self,
        before: Int[Array, "modes B"],
        after: Int[Array, "modes B"],
        passes: Float[Array, "1 B"],
    ) -> Bool[Array, "1 B"] | None:
        """Mask: the most closings of a contact become 8, 16, 32, ... after DRAGGING
        passes per contact, or a look ahead is due; None where no state returns as a
        multiple of itself. See `plastic_limit.py`.
        """
        if not self.self_similar:
            return None
        count = largest_of(self.modes(after).closings)
        old = largest_of(self.modes(before).closings)
        doubled = (count > old) & (count >= OFTEN) & is_power_of_two(count)
        doubled = doubled & (passes > DRAGGING * self.contacts)
        if self.looks_ahead:
            return doubled | self.look_due(passes)
        return doubled

    def patience(self, passes: Float[Array, "1 B"]) -> Float[Array, "1 B"]:
        """The tolerance, WIDENED once an impact drags on."""
        late = passes > PATIENCE * self.taking_part
        return jnp.where(late, WIDENED, 1.0) * self.tolerance

    def energy(
        self, x: Float[Array, "m B"], g: Float[Array, "m B"]
    ) -> Float[Array, "m B"]:
        """Twice the energy of each contact by itself, `x^(eta + 1) + g^2`."""
        return power(x, plus_one(self.exponent)) + g * g

    def at_work(
        self,
        modes: Int[Array, "modes B"],
        y: Float[Array, "n B"],
        tolerance: Float[Array, "1 B"],
    ) -> tuple[Bool[Array, "m B"], Float[Array, "m B"], Float[Array, "m B"]]:
        """Mask of contacts at work, gamma, and the gamma that each would have at its
        end, alone.

        At work: loaded or approaching, with `x^(eta + 1) + g^2 > tolerance^2`; alone it
        ends with e times the root of that, others with their gamma. With a viscous
        force: approaching, or loaded at x > 0, with x or |g| above the tolerance.
        """
        x, g, _ = self.rows(y)
        gamma = self.scales(modes) * g
        energy = self.energy(x, g)
        loaded = (x > 0) | (gamma < 0)
        works = loaded & (energy > tolerance**2)
        if self.viscous is not None:
            works = self.loaded(modes) & (x > 0) | (gamma < 0)
            moves = (x > tolerance) | (jnp.abs(g) > tolerance)
            works = works & moves
        stored = jnp.where(works, energy, 1.0)
        rebound = self.restitution * jnp.sqrt(stored)
        return works, gamma, jnp.where(works, rebound, gamma)

    def over(
        self,
        modes: Int[Array, "modes B"],
        y: Float[Array, "n B"],
        passes: Float[Array, "1 B"],
    ) -> Bool[Array, "1 B"]:
        """Mask: no contact is at work; or, with a closed form, those at work act on no
        others at work, and the rest follows from their energies.

        With changes d of gamma in contacts that end alone, others keep
        `gamma + min(G, 0) d >= 0`.
        """
        tolerance = self.patience(passes)
        works, gamma, rebound = self.at_work(modes, y, tolerance)
        if not self.closed_form:
            return ~any_of(works)
        # over the others, i != j: sum |G_ji|, i at work; gamma_j + sum min(G_ji, 0) d_i
        at_work = works.astype(y.dtype)
        coupled = self.coupling.magnitude().times(at_work) - at_work > 0
        d = rebound - gamma
        lowest = gamma + self.coupling.pull().times(d) - d
        goes_on = jnp.where(works, coupled, lowest < -tolerance)
        return ~any_of(goes_on)

    def finished(
        self, modes: Int[Array, "modes B"], y: Float[Array, "n B"]
    ) -> Float[Array, "n B"]:
        """The state of `finish` alone."""
        _, y = self.finish(modes, y)
        return y

    def finish(
        self, modes: Int[Array, "modes B"], y: Float[Array, "n B"]
    ) -> tuple[Int[Array, "modes B"], Float[Array, "n B"]]:
        """All contacts open; where a closed form ends the impact, its impulses are
        added.
        """
        x, _, p = self.rows(y)
        _, gamma, rebound = self.at_work(modes, y, self.tolerance)
        if not self.closed_form:
            rebound = gamma
        phase, closings, slip = self.modes(modes)
        all_open = jnp.full_like(phase, Phase.OPEN)
        modes = Modes(all_open, closings, slip).packed()
        rows = Contacts(jnp.zeros_like(x), rebound, p + rebound - gamma)
        return modes, self.with_rows(y, rows)
