"""The LZB impact dynamics as a regular, dimensionless flow, and one Runge-Kutta step of it.

With sqrt-energy units (Q for normalized velocities, T for time; see `laws/lzb.py`) the law reads

    x_j' = -omega_j c_j gamma_j,    p_j' = (eta_j + 1)/2 omega_j x_j^eta_j,    gamma = gamma- + G p

with c_j = 1 in compression and 1/e_j^2 in expansion, and stored energy x_j^(eta_j + 1) / 2.
In expansion g_j = gamma_j / e_j takes the place of gamma_j, and time runs in units of the smallest
e at work: nothing is then divided by e, so that e = 0 is an ordinary, differentiable case (the
whole expansion takes no time; derivatives in e there are one-sided).

A step may advance in time or in another variable xi that grows or falls monotonically:

    TIME     xi = t
    START    xi = t^(1/r): an impact begins like x ~ t, and forces t^eta are smooth in xi
    ZERO_G   xi = g_j, ending on g_j = 0 (or a given value): lands on the event (Henon's trick)
    ROOT_X   xi = x_j^(1/r), ending on x_j = 0: the same for an opening, x_j^eta smooth in xi
    FROM_GAP xi = x_j from below to x_j = 0: a gap closes
    ONSET    xi = a function of x_j and x_j' to 0: a viscous contact gets slack, or loaded again

Contacts with gaps (`gapped`, the compliant law): an open contact keeps track of x_j = -gap_j and
closes when that returns to 0; without, geometry is frozen and it closes when gamma_j < 0.
A `viscous` force replaces the power law; it is never tensile, so that a contact may be open (slack)
with x_j > 0.

with r = 2 where 2 eta is known to be whole, else 8.

Contacts are the first axis of all arrays; what is one number an impact has length 1 there, and
further axes are batches (see `contacts.py`).
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jimpact.events.tableaux import DOP853, Tableau
from jimpact.numerics.columns import by_itself
from jimpact.numerics.contacts import first_least, of
from jimpact.numerics.powers import Exponent, factor, power
from jimpact.solvers.tridiagonal import Symmetric, Tridiagonal

TIME, START, ZERO_G, ROOT_X, FROM_GAP, ONSET = 0, 1, 2, 3, 4, 5  # variable of a step
OPEN, COMPRESSION, EXPANSION = 0, 1, 2  # phase of a contact

UNROLLED = 8  # products with a matrix of this size are written out, without a reduction


class Viscous(NamedTuple):
    """A force `model` (see `rheology.py`) and the units (m,) that make it dimensionless."""

    model: Any
    indentation: jax.Array  # [m]
    speed: jax.Array  # [m/s]
    force: jax.Array  # [N]

    def push(self, x: jax.Array, gamma: jax.Array) -> jax.Array:
        """Dimensionless force, not tensile."""
        x = jnp.where(x >= 0, x, 0.0) * self.indentation
        return jnp.maximum(self.model.force(x, -gamma * self.speed), 0.0) / self.force

    def onset(self, x: jax.Array, gamma: jax.Array) -> jax.Array:
        """Smooth function with the sign of the force, of order 1."""
        return self.model.onset(x * self.indentation, -gamma * self.speed) / self.force


class Flow(NamedTuple):
    """Parameters (m,) or (1,) of the dimensionless law, and the unit-diagonal `coupling` G."""

    coupling: Symmetric
    omega: jax.Array
    restitution: jax.Array
    exponent: Exponent
    gapped: bool = False
    root: int = 2
    viscous: Viscous | None = None

    @property
    def slackens(self) -> bool:
        """Whether a contact may lose its force before its indentation."""
        return self.viscous is not None and self.viscous.model.slackens


def frozen(flow: Flow) -> Flow:
    """The same flow, not differentiated (a static exponent stays static)."""
    exponent = flow.exponent
    if isinstance(exponent, jax.Array):
        exponent = jax.lax.stop_gradient(exponent)
    viscous = jax.tree.map(jax.lax.stop_gradient, flow.viscous)
    return Flow(*jax.lax.stop_gradient(flow[:3]), exponent, flow.gapped, flow.root, viscous)


class State(NamedTuple):
    """Indentation x, scaled gap velocity g, impulse p (all (m,)) and impact time t (1,)."""

    x: jax.Array
    g: jax.Array
    p: jax.Array
    t: jax.Array


class Slopes(NamedTuple):
    """What the stages of a step keep of x, g and p, or what follows from them: an error."""

    x: jax.Array
    g: jax.Array
    p: jax.Array


def lands(kind: jax.Array) -> jax.Array:
    """Whether a step of this kind ends on an event."""
    return (kind != TIME) & (kind != START)


def apply(matrix: Symmetric, vector: jax.Array) -> jax.Array:
    """`matrix @ vector`, where a dense matrix (m, m, ...) may have the batch axes of the vector."""
    if isinstance(matrix, Tridiagonal) or matrix.ndim == 2:
        return matrix @ vector
    if matrix.shape[0] > UNROLLED:
        return jnp.sum(matrix * vector[None], axis=1)
    columns = [matrix[:, j] * vector[j : j + 1] for j in range(matrix.shape[0])]
    return functools.reduce(jnp.add, columns)


class Rates(NamedTuple):
    """What of the field does not change while the phases last."""

    unit: jax.Array  # (1,) time unit s*
    ratio: jax.Array  # (m,) s* / s_j
    closing: jax.Array  # (m,) x' / g
    stiffness: jax.Array  # (m,) force / x^eta


def scales(flow: Flow, phase: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """`s_j` with `gamma_j = s_j g_j`, the time unit `s*`, and `s* / s_j` (0/0 = 1)."""
    s = jnp.where(phase == EXPANSION, flow.restitution, jnp.ones_like(flow.restitution))
    unit = of(first_least(s), s)  # not min(): its derivative is shared among ties
    ratio = jnp.where(s > 0, unit / jnp.where(s > 0, s, 1.0), 1.0)
    return s, unit, ratio


def rates_of(flow: Flow, phase: jax.Array) -> Rates:
    """The constants of the field while these phases last."""
    _, unit, ratio = scales(flow, phase)
    closing, stiffness = -ratio * flow.omega, factor(flow.exponent, flow.omega) * flow.omega
    if flow.gapped:
        return Rates(unit, ratio, closing, jnp.where(phase == OPEN, 0.0, stiffness))
    return Rates(unit, ratio, jnp.where(phase == OPEN, 0.0, closing), stiffness)


def push(flow: Flow, phase: jax.Array, rates: Rates, x: jax.Array, g: jax.Array) -> jax.Array:
    """Force, without `unit`: p' = unit * push with respect to time in units of `s*`."""
    if flow.viscous is None:
        return rates.stiffness * power(x, flow.exponent)
    return jnp.where(phase == OPEN, 0.0, flow.viscous.push(x, g))


def field(
    flow: Flow, phase: jax.Array, rates: Rates, x: jax.Array, g: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """`(x', g', p')` with respect to time in units of `s*`, phases frozen."""
    force = push(flow, phase, rates, x, g)
    return rates.closing * g, rates.ratio * apply(flow.coupling, force), rates.unit * force


def step(
    flow: Flow,
    phase: jax.Array,
    state: State,
    kind: jax.Array,
    target: jax.Array,
    start: jax.Array,
    length: jax.Array,
    due: jax.Array,
    tolerance: jax.Array,
    tableau: Tableau = DOP853,
    apart: bool = False,
) -> tuple[State, Slopes, Slopes]:
    """One Runge-Kutta step of `length` in the variable `kind`, which begins at `start`.

    It needs neither `due`, the time expected to the event, nor the tolerance: other methods do.

    `target` (m,) is one-hot: the contact whose event ends a ZERO_G or ROOT_X step. Returns the
    end state and the two error estimates. The stages are a loop of matrix products: unrolled,
    the derivative takes seven times as long to compile. They keep x' and the force only: g' is
    linear in the force. With `apart` a stage is a computation of its own: derivatives of a batch
    take less than half the time then.
    """
    dtype, r, count, m = state.x.dtype, flow.root, len(tableau.c), state.x.shape[0]
    dense = np.array([[*row, *[0.0] * (count - len(row))] for row in tableau.a])
    a, b, c = (jnp.asarray(z, dtype) for z in (dense, tableau.b, tableau.c))
    known_x = target & ((kind == ROOT_X) | (kind == FROM_GAP))
    known_g = target & (kind == ZERO_G)
    rates = rates_of(flow, phase)

    def stage(i: jax.Array, carried: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        slopes, elapsed = carried
        xi = start + c[i] * length
        row = jax.lax.dynamic_index_in_dim(a, i, keepdims=False)
        change = length * jnp.tensordot(row, slopes, axes=1)

        def derivatives() -> tuple[jax.Array, jax.Array, jax.Array]:
            # the variable of the step is known exactly at every stage
            x = state.x + change[:m]
            x = jnp.where(known_x, jnp.where(kind == FROM_GAP, xi, xi**r), x)
            g = state.g + rates.ratio * apply(flow.coupling, change[m:])
            g = jnp.where(known_g, xi, g)
            force = push(flow, phase, rates, x, g)
            dx, dg = rates.closing * g, rates.ratio * apply(flow.coupling, force)
            turning = dx
            if flow.slackens:
                turning = jax.jvp(flow.viscous.onset, (x, g), (dx, dg))[1]  # type: ignore[union-attr]
                turning = jnp.where(kind == ONSET, turning, dx)
            dt = _stretch(kind, target, xi, turning, dg, r)
            return dx * dt, force * dt, dt

        dx, force, dt = by_itself(derivatives, length) if apart else derivatives()
        new = jnp.concatenate([dx, force])
        return jax.lax.dynamic_update_index_in_dim(slopes, new, i, 0), elapsed + b[i] * dt

    none = jnp.zeros((count, 2 * m, *state.x.shape[1:]), dtype)
    slopes, elapsed = jax.lax.fori_loop(0, count, stage, (none, jnp.zeros_like(start)))
    weights = jnp.asarray([tableau.b, tableau.error_high, tableau.error_low], dtype)

    def sums(row: jax.Array) -> Slopes:
        x, q = length * row[:m], length * row[m:]
        return Slopes(x, rates.ratio * apply(flow.coupling, q), rates.unit * q)

    change, high, low = (sums(row) for row in jnp.tensordot(weights, slopes, axes=1))
    end = State(
        jnp.where(known_x, 0.0, state.x + change.x),
        jnp.where(known_g, start + length, state.g + change.g),
        state.p + change.p,
        state.t + length * rates.unit * elapsed,
    )
    return end, high, low


def _stretch(
    kind: jax.Array, target: jax.Array, xi: jax.Array, dx: jax.Array, dg: jax.Array, r: int
) -> jax.Array:
    """`dt / dxi`."""
    rate = jnp.where(kind == ZERO_G, of(target, dg), jnp.where(lands(kind), of(target, dx), 1.0))
    numerator = jnp.where((kind == START) | (kind == ROOT_X), r * xi ** (r - 1), 1.0)
    safe = jnp.where(rate == 0, 1.0, rate)
    return jnp.where(rate == 0, jnp.nan, 1.0) * numerator / safe
