"""Forces in contacts as a flow: LZB, gaps and viscous forces, with and without planar friction.

With sqrt-energy units (see `impact_dynamics.py`) and frozen geometry the law reads

    x_j' = -omega_j c_j gamma_j,   p_j' = F_j = (eta_j + 1)/2 omega_j x_j^eta_j,
    gamma' = G F + K_nt lambda,    u' = K_tn F + K_tt lambda

with c_j = 1 in compression and 1/e_j^2 in expansion, and stored energy x_j^(eta_j + 1) / 2. In
expansion g_j = gamma_j / e_j takes the place of gamma_j, and time runs in units of the smallest e
of these contacts: nothing is then divided by e, so that e = 0 is an ordinary, differentiable case
(the whole expansion takes no time; derivatives in e there are one-sided).

STATE (rows)   x, g, p (m each), time; with friction slip u and its impulse (t each). A flow that
               `watches` its exponents has one more before the time.
MODES (rows)   phase (m), how often each contact has closed (m); with friction the slip: 0 sticks,
               +-1 the direction (m).

A contact is OPEN, in COMPRESSION or in EXPANSION. Without gaps the geometry is frozen: an open
contact closes as soon as gamma < 0. With gaps (`gapped`) it keeps track of x = -gap and closes when
that returns to 0. A `viscous` force replaces the power law; it never pulls, so that a contact
may be SLACK: x > 0, and no force. It opens at x = 0, from SLACK or, with what force it has there,
from COMPRESSION. With a `limit` of x the force is bounded: the contact YIELDS at
x = limit until it expands, and what it takes up meanwhile is lost.
"""

import dataclasses
import enum
import functools
import math
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from jimpact.numerics.dense import COLUMNS_WRITTEN_OUT, times, unit
from jimpact.numerics.sparse import Neighbours, neighbour_sum
from jimpact.numerics.stepper import Flow, any_of, total
from jimpact.numerics.tridiagonal import tridiagonal_product


class Phase(enum.IntEnum):
    """What a contact does within a step."""

    OPEN = 0
    COMPRESSION = 1
    EXPANSION = 2
    SLACK = 3
    YIELD = 4


# The first two are in tolerances of velocity. Margins closer to 0 than SNAP are 0; ten times more
# would move events by a tenth of the tolerance. An approach or a load below NEGLIGIBLE does nothing
# more; ten times more would lose what the tolerance promises.
SNAP = 1e-2
NEGLIGIBLE = 0.1
# Passes per contact after which an impact may end at WIDENED times the tolerance: some re-close so
# often that they would not end. Ten times more passes: such impacts take ten times longer; ten
# times wider: they end with errors of 1000 tolerances.
PATIENCE = 2000
WIDENED = 100.0  # tolerances, at which an impact may end after PATIENCE passes
# Passes per contact, which few impacts need, before endless closings are checked for; ten times
# more: they are detected later.
DRAGGING = 100
# Closings of a contact, from which on they may be endless, a power of 2: ten times more:
# detected later.
OFTEN = 8
# Contacts of a chain, more of which may come to rest together in no order that returns; passes per
# contact after which a look ahead decides (`look_ahead.py`), again after twice, four times as many.
# Ten times more contacts: chains of 20 take 30 times as long; ten times more passes: as much later.
MANY, LOOKS = 8, 15
# Tolerances within which a flow watches the derivative of its forces in the exponents; the
# tolerance is then that of derivatives, a hundred times finer than the law's. Ten times more: such
# derivatives are ten times coarser than the others.
WATCHED = 100.0
# Whole and half exponents below it are products, not powers. Ten times more: longer products.
LARGE = 6.0

T = TypeVar("T")
Exponent = float | tuple[float, ...] | jax.Array


def power(x: jax.Array, exponent: Exponent) -> jax.Array:
    """`max(x, 0)^exponent` of rows x, with finite derivatives at 0; fast for static halves."""
    if isinstance(exponent, tuple) and len(set(exponent)) == 1:
        exponent = exponent[0]
    if isinstance(exponent, float) and exponent == 1.0:
        return jnp.where(x >= 0, x, 0.0)  # at 0 the derivative of a contact that closes
    positive = x > 0
    safe = jnp.where(positive, x, 1.0)
    if isinstance(exponent, float) and exponent < LARGE and (2 * exponent).is_integer():
        x = jnp.where(positive, x, 0.0)
        whole = [x] * int(exponent)
        factors = whole if exponent.is_integer() else [*whole, jnp.sqrt(safe)]
        return functools.reduce(jnp.multiply, factors)
    eta = per_row(exponent, x)
    return jnp.where(positive, jnp.exp(eta * jnp.log(safe)), 0.0)


def per_row(values: Exponent, like: jax.Array) -> jax.Array:
    """Values of contacts, (m,) or one, shaped to broadcast against rows (m, B)."""
    values = jnp.asarray(values, like.dtype)
    return values if values.ndim == like.ndim else values.reshape(-1, *[1] * (like.ndim - 1))


def plus_one(exponent: Exponent) -> Exponent:
    """`exponent + 1`, static where `exponent` is."""
    return tuple(e + 1 for e in exponent) if isinstance(exponent, tuple) else exponent + 1


class Viscous(NamedTuple):
    """A force `model` (see `laws/forces.py`) and the units (m, B) that make it dimensionless."""

    model: Any
    indentation: jax.Array  # [m]
    speed: jax.Array  # [m/s]
    force: jax.Array  # [N]
    onset_unit: jax.Array  # of `onset`, whose dimension is the model's own

    def push(self, x: jax.Array, gamma: jax.Array) -> jax.Array:
        """Dimensionless force, not tensile."""
        x = jnp.where(x >= 0, x, 0.0) * self.indentation
        return jnp.maximum(self._value("force", x, gamma) / self.force, 0.0)

    def onset(self, x: jax.Array, gamma: jax.Array) -> jax.Array:
        """Smooth function with the sign of the force, of order 1."""
        x = jnp.where(x >= 0, x, 0.0) * self.indentation
        return self._value("onset", x, gamma) / self.onset_unit

    def _value(self, name: str, x: jax.Array, gamma: jax.Array) -> jax.Array:
        """A force knows contacts (m,), not batches."""

        def of_one(model: Any, x: jax.Array, rate: jax.Array) -> jax.Array:
            """Of one impact, arrays (m,)."""
            return getattr(model, name)(x, rate)

        return jax.vmap(of_one, in_axes=-1, out_axes=-1)(self.model, x, -gamma * self.speed)


def written_out(coupling: Any, n: int) -> jax.Array:
    """The matrix (n, n, B) of a coupling that multiplies."""
    entries = jax.tree.leaves(coupling)[0]
    one = jnp.eye(n, dtype=entries.dtype)[..., None]
    columns = jnp.broadcast_to(one, (n, n, entries.shape[-1]))
    return jax.vmap(coupling.times, out_axes=1)(columns)


class Chain(NamedTuple):
    """The coupling of a chain: G without its unit diagonal, (m - 1, B)."""

    off_diagonal: jax.Array

    def dense(self, n: int) -> jax.Array:
        """The matrix (n, n, B)."""
        return written_out(self, n)

    def times(self, f: jax.Array) -> jax.Array:
        """`G f` (m, B)."""
        return tridiagonal_product(f, self.off_diagonal, f)

    def magnitude(self) -> "Chain":
        """|G|, entry by entry."""
        return Chain(jnp.abs(self.off_diagonal))

    def pull(self) -> "Chain":
        """min(G, 0) with its unit diagonal."""
        return Chain(jnp.minimum(self.off_diagonal, 0.0))


class Dense(NamedTuple):
    """A coupling matrix (m, m, B)."""

    matrix: jax.Array

    def dense(self, _: int) -> jax.Array:
        """The matrix."""
        return self.matrix

    def times(self, f: jax.Array) -> jax.Array:
        """`G f` (m, B)."""
        return times(self.matrix, f)

    def _off_diagonal(self) -> jax.Array:
        """G without its diagonal."""
        return self.matrix * (1 - unit(self.matrix))

    def magnitude(self) -> "Dense":
        """|G|, entry by entry, with a unit diagonal."""
        return Dense(jnp.abs(self._off_diagonal()) + unit(self.matrix))

    def pull(self) -> "Dense":
        """min(G, 0) with a unit diagonal."""
        return Dense(jnp.minimum(self._off_diagonal(), 0.0) + unit(self.matrix))


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Packing:
    """The coupling of a packing: entries of G off its unit diagonal, (m, K, B), at neighbours."""

    entries: jax.Array
    neighbours: Neighbours = dataclasses.field(metadata={"static": True})

    def dense(self, n: int) -> jax.Array:
        """The matrix (n, n, B)."""
        return written_out(self, n)

    def times(self, f: jax.Array) -> jax.Array:
        """`G f` (m, B)."""
        return f + neighbour_sum(self.entries, f, self.neighbours)

    def magnitude(self) -> "Packing":
        """|G|, entry by entry."""
        return dataclasses.replace(self, entries=jnp.abs(self.entries))

    def pull(self) -> "Packing":
        """min(G, 0) with its unit diagonal."""
        return dataclasses.replace(self, entries=jnp.minimum(self.entries, 0.0))


Coupling = Chain | Dense | Packing


class Frozen(NamedTuple):
    """What of the field does not change while the modes last."""

    unit: jax.Array  # (1, B) time unit s*: the smallest s_j
    ratio: jax.Array  # (m, B) s* / s_j
    closing: jax.Array  # (m, B) x' / g
    stiffness: jax.Array  # (m, B) force / x^eta
    scale: jax.Array  # (m, B) s_j = gamma / g


class ContactStates(NamedTuple):
    """Of a state F, x, p, gamma (m, B), lambda, its impulse, slip (t, B), rate of time (1, B)."""

    force: jax.Array
    indentation: jax.Array
    impulse: jax.Array
    gap_velocity: jax.Array
    tangential_force: jax.Array
    tangential_impulse: jax.Array
    slip: jax.Array
    rate: jax.Array


COMPILED_IN = ("exponent_static", "gapped", "closed_form", "watches")  # fields that are no arrays


def as_pytree(flow: type[T]) -> type[T]:
    """A dataclass of arrays as a pytree; the fields COMPILED_IN belong to its structure."""
    names = [field.name for field in dataclasses.fields(flow)]  # type: ignore[arg-type]
    arrays = [name for name in names if name not in COMPILED_IN]
    fixed = [name for name in names if name in COMPILED_IN]
    return jax.tree_util.register_dataclass(flow, arrays, fixed)


@as_pytree
@dataclasses.dataclass
class ContactFlow(Flow):
    """Contacts without friction."""

    coupling: Coupling
    omega: jax.Array  # (m, B)
    restitution: jax.Array  # (m, B)
    exponent_array: jax.Array | None  # (m, B)
    tolerance: jax.Array  # (1, B)
    taking_part: jax.Array  # (1, B) contacts that are not open for good
    viscous: Viscous | None = None
    limit: jax.Array | None = None  # (m, B) indentation at which the force stays
    exponent_static: float | tuple[float, ...] | None = None
    gapped: bool = False
    closed_form: bool = True  # an impact may end by the energy of contacts that work alone
    # Steps are also short enough for the derivative in the exponents, F log x: it is less smooth at
    # x = 0 than F. At exponent 1 F is linear, and steps of any length would do for it alone.
    watches: bool = False

    longest = math.inf  # no rate is much larger than the others

    @property
    def exponent(self) -> Exponent:
        """Exponents of the contacts: compiled in, or an array (m, B)."""
        static = self.exponent_static
        return static if static is not None else self.exponent_array  # type: ignore[return-value]

    @property
    def contacts(self) -> int:
        """Number m of contacts."""
        return self.omega.shape[0]

    @property
    def zero_margin(self) -> jax.Array:
        """Margins (1, B) below this are 0."""
        return SNAP * self.tolerance

    @property
    def slackens(self) -> bool:
        """Whether a contact may lose its force before its indentation."""
        return self.viscous is not None and self.viscous.model.slackens

    # ---- the state

    @property
    def driving(self) -> tuple[int, ...]:
        """Blocks of rows that the field depends on."""
        return self.contacts, self.contacts

    @property
    def adding(self) -> tuple[int, ...]:
        """Blocks of rows, behind those, that only add up."""
        return (self.contacts, 1, 1) if self.watches else (self.contacts, 1)

    def rows(self, y: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """x, g and p."""
        m = self.contacts
        return y[:m], y[m : 2 * m], y[2 * m : 3 * m]

    def start(self, gamma: jax.Array, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Modes and state before the impact; a touching contact at rest starts in compression."""
        phase = jnp.where((gamma <= 0) | (x > 0), Phase.COMPRESSION, Phase.OPEN)
        phase = jnp.where(x < 0, Phase.OPEN, phase)
        expands = (x > 0) & (gamma > 0)
        if not self.slackens:
            phase = jnp.where(expands, Phase.EXPANSION, phase)
        # loaded, separating and e = 0: it opens at once and returns nothing
        spent = (phase == Phase.EXPANSION) & (self.restitution == 0)
        phase, x = jnp.where(spent, Phase.OPEN, phase), jnp.where(spent, 0.0, x)
        g = gamma / jnp.where(phase == Phase.EXPANSION, self.restitution, 1.0)
        modes = jnp.concatenate([phase, jnp.zeros_like(phase)]).astype(jnp.int32)
        last = jnp.zeros_like(g[:1])
        watched = [last] if self.watches else []
        return modes, jnp.concatenate([x, g, jnp.zeros_like(g), *watched, last])

    def scales(self, modes: jax.Array) -> jax.Array:
        """s_j = gamma_j / g_j (m, B)."""
        return jnp.where(modes[: self.contacts] == Phase.EXPANSION, self.restitution, 1.0)

    # ---- the protocol

    def constants(self, modes: jax.Array) -> Any:
        """What the field needs of the modes; without friction the normal factors alone."""
        return self.normal_constants(modes)

    def normal_constants(self, modes: jax.Array) -> Frozen:
        """Factors of the normal field in the phases of the contacts."""
        phase, s = modes[: self.contacts], self.scales(modes)
        # the least one makes e = 0 regular; of several one of them, whole: min() would share its
        # derivative among them
        least = (
            functools.reduce(
                lambda a, b: jnp.where(b < a, b, a), [s[j : j + 1] for j in range(self.contacts)]
            )
            if self.contacts <= COLUMNS_WRITTEN_OUT
            else jnp.take_along_axis(s, jnp.argmin(s, axis=0, keepdims=True), axis=0)
        )
        ratio = jnp.where(s > 0, least / jnp.where(s > 0, s, 1.0), 1.0)
        moves = jnp.ones_like(phase, bool) if self.gapped else phase != Phase.OPEN
        loaded = (phase == Phase.COMPRESSION) | (phase == Phase.EXPANSION)
        if self.limit is not None:
            moves, loaded = moves & (phase != Phase.YIELD), loaded | (phase == Phase.YIELD)
        closing = jnp.where(moves, -ratio * self.omega, 0.0)
        stiffness = (per_row(self.exponent, self.omega) + 1) / 2 * self.omega
        return Frozen(least, ratio, closing, jnp.where(loaded, stiffness, 0.0), s)

    def force(self, const: Frozen, x: jax.Array, g: jax.Array) -> jax.Array:
        """Normal force: p' = unit * force with respect to time in units of `s*`."""
        if self.viscous is None:
            return const.stiffness * power(x, self.exponent)
        return jnp.where(const.stiffness > 0, self.viscous.push(x, g), 0.0)

    def field(self, const: Any, modes: jax.Array, y: jax.Array) -> jax.Array:
        """Rates of x, g, p and time."""
        x, g, _ = self.rows(y)
        f = self.force(const, x, g)
        dg = const.ratio * self.coupling.times(f)
        watched = []
        if self.watches:
            slope = f * jnp.log(jnp.where(x > 0, x, 1.0))
            watched = [jax.lax.stop_gradient(const.unit * total(slope))]
        return jnp.concatenate([const.closing * g, dg, const.unit * f, *watched, const.unit])

    def allowance(self, modes: jax.Array, y: jax.Array) -> jax.Array | float:
        """More in the row that only watches."""
        if not self.watches:
            return 1.0
        return jnp.ones_like(y[:, :1]).at[-2].set(WATCHED)

    def margins(self, const: Any, modes: jax.Array, y: jax.Array) -> jax.Array:
        """What stays positive until a contact changes its mode; without friction its phase."""
        return self.normal_margins(const, modes, y)

    def normal_margins(self, const: Frozen, modes: jax.Array, y: jax.Array) -> jax.Array:
        """By indentation (an opening, a gap that closes, the onset of a force), by velocity."""
        x, g, _ = self.rows(y)
        phase = modes[: self.contacts]
        by_x = jnp.where(phase == Phase.EXPANSION, x, 1.0)
        by_g = jnp.where(phase == Phase.COMPRESSION, -g, g)
        if self.limit is not None:
            by_x = jnp.where(phase == Phase.COMPRESSION, self.limit - x, by_x)
            by_g = jnp.where(phase == Phase.YIELD, -g, by_g)
        if not self.gapped:
            return jnp.concatenate(
                [by_x, by_g + jnp.where(phase == Phase.OPEN, NEGLIGIBLE * self.tolerance, 0.0)]
            )
        by_x = jnp.where(phase == Phase.OPEN, -x, by_x)
        by_g = jnp.where(phase == Phase.OPEN, 1.0, by_g)
        if self.slackens:
            onset = self.viscous.onset(x, g)  # type: ignore[union-attr]
            compressed, slack = phase == Phase.COMPRESSION, phase == Phase.SLACK
            by_x = jnp.where(compressed, onset, jnp.where(slack, -onset, by_x))
            by_g = jnp.where(compressed | slack, x, by_g)
        return jnp.concatenate([by_x, by_g])

    def rooted(self, modes: jax.Array) -> jax.Array:
        """Openings: x falls to 0 like the square of the time left."""
        phase = modes[: self.contacts]
        opens = phase == Phase.EXPANSION
        by_g = (phase == Phase.COMPRESSION) & self.slackens
        return jnp.concatenate([opens, by_g])

    def switch(
        self, modes: jax.Array, y: jax.Array, which: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Modes and state after an event; without friction those of the normal motion."""
        return self.normal_switch(modes, y, which)

    def normal_switch(
        self, modes: jax.Array, y: jax.Array, which: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Phases and closings after events by indentation and by velocity."""
        m = self.contacts
        phase, count = modes[:m], modes[m : 2 * m]
        x, g, _ = self.rows(y)
        by_x, by_g = which[:m], which[m : 2 * m]
        if self.slackens:
            after = self._slackening(phase, by_x, by_g)
            opened = by_g & (phase != Phase.OPEN)
            closed = by_x & (phase == Phase.OPEN)
            x = jnp.where(opened | closed, 0.0, x)
        else:
            opened = by_x & (phase == Phase.EXPANSION)
            closed = (by_x | by_g) & (phase == Phase.OPEN)
            # what is left in it would do nothing more: it need not be unloaded
            idle = power(x, plus_one(self.exponent)) <= (NEGLIGIBLE * self.tolerance) ** 2
            turned = by_g & (phase == Phase.COMPRESSION)
            after = jnp.where(turned, jnp.where(idle, Phase.OPEN, Phase.EXPANSION), phase)
            if self.limit is not None:
                yields = by_x & (phase == Phase.COMPRESSION) & ~turned
                after, x = jnp.where(yields, Phase.YIELD, after), jnp.where(yields, self.limit, x)
                after = jnp.where(by_g & (phase == Phase.YIELD), Phase.EXPANSION, after)
            after = jnp.where(by_g & (phase == Phase.EXPANSION), Phase.COMPRESSION, after)
            after = jnp.where(opened, Phase.OPEN, jnp.where(closed, Phase.COMPRESSION, after))
            g = jnp.where(opened, self.restitution * g, g)
            g = jnp.where(by_g & (phase != Phase.OPEN), 0.0, g)
            x = jnp.where(opened | (turned & idle) | (closed & self.gapped), 0.0, x)
        count = count + closed.astype(count.dtype)
        modes = jnp.concatenate([after, count, modes[2 * m :]]).astype(modes.dtype)
        return modes, jnp.concatenate([x, g, y[2 * m :]])

    def _slackening(self, phase: jax.Array, by_x: jax.Array, by_g: jax.Array) -> jax.Array:
        """Phases (m, B) after events where forces may vanish before the indentation."""
        after = jnp.where(by_x & (phase == Phase.COMPRESSION), Phase.SLACK, phase)
        free = (phase == Phase.SLACK) | (phase == Phase.OPEN)
        after = jnp.where(by_x & free, Phase.COMPRESSION, after)
        return jnp.where(by_g & ~(phase == Phase.OPEN), Phase.OPEN, after)

    def begins(self, before: jax.Array, after: jax.Array) -> jax.Array:
        """Behind a gap x sets in like t; without gaps like t^2, and forces are smooth enough."""
        m = self.contacts
        if not self.gapped:
            return jnp.zeros((1, *before.shape[1:]), bool)
        return any_of(after[m : 2 * m] > before[m : 2 * m])

    def coasts(self, modes: jax.Array) -> jax.Array | None:
        """With gaps, while no contact is loaded."""
        if not self.gapped:
            return None
        phase = modes[: self.contacts]
        return ~any_of((phase != Phase.OPEN) & (phase != Phase.SLACK))

    # ---- results

    def contact_states(self, modes: jax.Array, y: jax.Array) -> ContactStates:
        """Forces, velocities and the rate of time in a state."""
        const, none = self.normal_constants(modes), y[:0]
        x, g, p = self.rows(y)
        force = self.force(const, x, g)
        return ContactStates(force, x, p, const.scale * g, none, none, none, const.unit)

    def change(self, y: jax.Array) -> jax.Array:
        """What the impulses of a state change of the gap velocities (m, B)."""
        return self.coupling.times(self.rows(y)[2])

    # ---- the end

    @property
    def at_once(self) -> bool:
        """Whether `finish` alone is the impact: one contact, with a closed form."""
        return self.closed_form and self.contacts == 1

    @property
    def self_similar(self) -> bool:
        """Whether a state multiplied by s takes the same course: see `plastic_limit.py`."""
        return not self.gapped and self.viscous is None

    @property
    def looks_ahead(self) -> bool:
        """Whether the chain is so long that a look ahead decides whether it comes to rest."""
        return isinstance(self.coupling, Chain) and self.contacts > MANY and self.self_similar

    def look_due(self, passes: jax.Array) -> jax.Array:
        """Whether (1, B) passes per contact are LOOKS times 1, 2, 4, ..., and energy is lost."""
        each = LOOKS * self.contacts
        whole = passes.astype(jnp.int32)
        number = jax.lax.div(whole, jnp.full_like(whole, each))
        due = (whole == number * each) & (number > 0) & (number & (number - 1) == 0)
        return due & any_of(self.restitution < 1)

    def pauses(self, before: jax.Array, after: jax.Array, passes: jax.Array) -> jax.Array | None:
        """Where the most closings of a contact become 8, 16, 32, ...: see `plastic_limit.py`."""
        if not self.self_similar:
            return None
        m = self.contacts
        count, old = (jnp.max(x[m : 2 * m], axis=0, keepdims=True) for x in (after, before))
        doubled = (count > old) & (count >= OFTEN) & (count & (count - 1) == 0)
        doubled = doubled & (passes > DRAGGING * m)
        return doubled | self.look_due(passes) if self.looks_ahead else doubled

    def patience(self, passes: jax.Array) -> jax.Array:
        """The tolerance (1, B), WIDENED once an impact drags on."""
        return jnp.where(passes > PATIENCE * self.taking_part, WIDENED, 1.0) * self.tolerance

    def energy(self, x: jax.Array, g: jax.Array) -> jax.Array:
        """Twice the energy of each contact by itself."""
        return power(x, plus_one(self.exponent)) + g * g

    def at_work(
        self, modes: jax.Array, y: jax.Array, tolerance: jax.Array
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Contacts loaded or approaching by more than the tolerance, gamma, gamma once alone."""
        x, g, _ = self.rows(y)
        phase = modes[: self.contacts]
        gamma = self.scales(modes) * g
        energy = self.energy(x, g)
        works = ((x > 0) | (gamma < 0)) & (energy > tolerance**2)
        if self.viscous is not None:
            loaded = (phase == Phase.COMPRESSION) | (phase == Phase.EXPANSION)
            works = loaded & (x > 0) | (gamma < 0)
            works = works & ((x > tolerance) | (jnp.abs(g) > tolerance))
        rebound = self.restitution * jnp.sqrt(jnp.where(works, energy, 1.0))
        return works, gamma, jnp.where(works, rebound, gamma)

    def over(self, modes: jax.Array, y: jax.Array, passes: jax.Array) -> jax.Array:
        """Whether loaded contacts act on no others: the rest then follows from the energy."""
        tolerance = self.patience(passes)
        works, gamma, rebound = self.at_work(modes, y, tolerance)
        if not self.closed_form:
            return ~any_of(works)
        # |G| and min(G, 0), both with a unit diagonal
        load = works.astype(y.dtype)
        felt = self.coupling.magnitude().times(load) - load > 0
        change = rebound - gamma
        left = gamma + self.coupling.pull().times(change) - change
        return ~any_of(jnp.where(works, felt, left < -tolerance))

    def finish(self, modes: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        """All contacts open; where a closed form ends the impact, its impulses are added."""
        m = self.contacts
        x, _, p = self.rows(y)
        _, gamma, rebound = self.at_work(modes, y, self.tolerance)
        if not self.closed_form:
            rebound = gamma
        phase = jnp.full_like(modes[:m], Phase.OPEN)
        return jnp.concatenate([phase, modes[m:]]), jnp.concatenate(
            [jnp.zeros_like(x), rebound, p + rebound - gamma, y[3 * m :]]
        )
