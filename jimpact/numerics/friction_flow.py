"""The LZB flow with Coulomb friction: its field, and one Runge-Kutta step of it.

To the dimensionless flow of `flow.py` come slip velocities u_j, in units of the normal ones, and
tangential forces lambda_j:

    p' = F,   u' = K_tn F + K_tt lambda,   gamma' = K_nn F + K_nt lambda,
    slip:   lambda_j = -mu_j F_j u_j / |u_j|
    stick:  lambda such that u_j' = 0, while |lambda_j| <= mu_j F_j

Who slips and who sticks (`Modes`) is frozen during a step; events change it. The normal forces
follow from the indentations, so that lambda exists and u' is unique whatever mu is: there is no
Painleve paradox. Where K_tt is singular (both corners of a block lying flat) lambda is shared
among the contacts that stick in proportion to mu_j F_j: they then break loose together.

Contacts are the first axis, tangential rows are contact-major with one (planar) or two rows a
contact, further axes are batches. A step advances in one of the variables

    TIME, START   as in `flow.py`
    ROOT_X        xi = x_j^(1/r) to 0: an opening
    MARGIN        xi = |gamma_j| or |u_j| to 0 (see `friction_events.py`): Henon's trick
    HOLDING       time, to where a contact breaks loose
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jimpact.events.tableaux import DOP853
from jimpact.numerics.columns import by_itself
from jimpact.numerics.contacts import along_contacts, of
from jimpact.numerics.events import margin_signs
from jimpact.numerics.flow import OPEN, START, TIME, Flow, Rates, frozen, rates_of
from jimpact.numerics.powers import power

__all__ = ["HOLDING", "MARGIN", "ROOT_X", "START", "TIME"]

ROOT_X, MARGIN, HOLDING = 2, 3, 4  # kinds of steps that land on an event

# Stick forces minimize sum lambda^2 / (mu F) with this weight beside K_tt: it decides where K_tt
# is singular only, and refinements remove what it changes elsewhere.
SHARING = 1e-7
REFINEMENTS = 3
WRITTEN_OUT = 6  # sizes up to it are inverted by scalars


class Frictional(NamedTuple):
    """The normal `Flow`, K_nt (m, t), K_tt (t, t) and mu (m,) or (1,)."""

    normal: Flow
    across: jax.Array
    along: jax.Array
    friction: jax.Array

    @property
    def rows(self) -> int:
        """Tangential rows a contact: 1 planar, 2 spatial."""
        return self.along.shape[0] // self.across.shape[0]


def still(flow: Frictional) -> Frictional:
    """The same flow, not differentiated."""
    return Frictional(frozen(flow.normal), *jax.lax.stop_gradient(flow[1:]))


class State(NamedTuple):
    """Indentation x, scaled gap velocity g, impulse p (m,), slip u and its impulse (t,), time."""

    x: jax.Array
    g: jax.Array
    u: jax.Array
    p: jax.Array
    side: jax.Array
    t: jax.Array


class Modes(NamedTuple):
    """Frozen in a step: normal phase, who sticks, sign of planar slip (all (m,))."""

    phase: jax.Array
    stick: jax.Array
    sign: jax.Array


def times(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    """`matrix @ vector` for (a, b, ...) and (b, ...)."""
    columns = [matrix[:, j] * vector[j : j + 1] for j in range(matrix.shape[1])]
    return sum(columns[1:], columns[0])


def per_row(values: jax.Array, rows: int) -> jax.Array:
    """Values (m, ...) of contacts, repeated for their tangential rows."""
    return jnp.repeat(values, rows, axis=0)


def size(tangential: jax.Array, rows: int) -> jax.Array:
    """|u_j| (m, ...) of rows (t, ...), with derivative 0 at 0."""
    if rows == 1:
        return jnp.abs(tangential)
    squares = jnp.sum(tangential.reshape(-1, rows, *tangential.shape[1:]) ** 2, axis=1)
    some = squares > 0
    return jnp.where(some, jnp.sqrt(jnp.where(some, squares, 1.0)), 0.0)


def direction(flow: Frictional, modes: Modes, u: jax.Array) -> jax.Array:
    """Unit vectors of slip (t, ...)."""
    if flow.rows == 1:
        return modes.sign
    speed = per_row(size(u, 2), 2)
    return jnp.where(speed > 0, u / jnp.where(speed > 0, speed, 1.0), 0.0)


def normal_force(flow: Frictional, modes: Modes, x: jax.Array) -> jax.Array:
    """F (m,) in units of p'."""
    rates = rates_of(flow.normal, modes.phase)
    force = rates.stiffness * power(x, flow.normal.exponent)
    return jnp.where(modes.phase == OPEN, 0.0, force)


def tangential_force(
    flow: Frictional, modes: Modes, force: jax.Array, u: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """lambda (t,), and the largest friction mu F (m,)."""
    rows = flow.rows
    most = along_contacts(flow.friction, force) * force
    stick = per_row(modes.stick, rows)
    slipping = -per_row(most, rows) * direction(flow, modes, u)
    slipping = jnp.where(stick, 0.0, slipping)
    missing = -(times(jnp.swapaxes(flow.across, 0, 1), force) + times(flow.along, slipping))
    sticking = _holding(flow.along, jnp.where(stick, missing, 0.0), stick, per_row(most, rows))
    return jnp.where(stick, sticking, slipping), most


def _holding(k: jax.Array, right: jax.Array, stick: jax.Array, most: jax.Array) -> jax.Array:
    """`K lambda = right` on the rows that stick, shared in proportion to `most`."""
    largest = jax.lax.stop_gradient(jnp.max(most, axis=0, keepdims=True))
    weight = most / jnp.where(largest > 0, largest, 1.0)
    k = jnp.where(stick[:, None] & stick[None, :], k, 0.0) * weight[None, :]
    unit = jnp.eye(len(right), dtype=right.dtype).reshape(
        (len(right),) * 2 + (1,) * (right.ndim - 1)
    )
    inverse = _inverse(k + unit * jnp.where(stick, SHARING, 1.0)[:, None])
    z = times(inverse, right)
    for _ in range(REFINEMENTS):
        z = z + times(inverse, right - times(k, z))
    return weight * z


def _inverse(matrix: jax.Array) -> jax.Array:
    """Inverse (t, t, ...) of what is similar to a positive definite matrix: needs no pivots."""
    n = len(matrix)
    if n > WRITTEN_OUT:
        inverse = jnp.linalg.inv(jnp.moveaxis(matrix, (0, 1), (-2, -1)))
        return jnp.moveaxis(inverse, (-2, -1), (0, 1))
    unit = jnp.eye(n, dtype=matrix.dtype).reshape((n, n) + (1,) * (matrix.ndim - 2))
    both = jnp.concatenate([matrix, jnp.broadcast_to(unit, matrix.shape)], axis=1)
    rows = [both[i] for i in range(n)]
    for k in range(n):
        rows[k] = rows[k] / rows[k][k][None]
        rows = [row if i == k else row - row[k][None] * rows[k] for i, row in enumerate(rows)]
    return jnp.stack([row[n:] for row in rows])


def field(flow: Frictional, modes: Modes, rates: Rates, state: State) -> State:
    """Rates of all of the state, with respect to time in units of `s*`; modes frozen."""
    force = normal_force(flow, modes, state.x)
    side, _ = tangential_force(flow, modes, force, state.u)
    pull = times(flow.normal.coupling, force) + times(flow.across, side)  # type: ignore[arg-type]
    slip = times(jnp.swapaxes(flow.across, 0, 1), force) + times(flow.along, side)
    slip = jnp.where(per_row(modes.stick, flow.rows), 0.0, slip)
    unit = rates.unit
    return State(
        rates.closing * state.g, rates.ratio * pull, unit * slip, unit * force, unit * side, unit
    )


def speed_of(flow: Frictional, modes: Modes, u: jax.Array) -> jax.Array:
    """Speed (m,) of slip; planar along its sign, negative once it has passed 0."""
    return modes.sign * u if flow.rows == 1 else size(u, 2)


def slowing(flow: Frictional, modes: Modes, u: jax.Array, rate: jax.Array) -> jax.Array:
    """Rate (m,) of the speed of slip."""
    along = direction(flow, modes, u) * rate
    if flow.rows == 1:
        return along
    return jnp.sum(along.reshape(-1, 2, *u.shape[1:]), axis=1)


def flat(state: State) -> jax.Array:
    """All of a state in one array (n, ...)."""
    return jnp.concatenate(state)


def unflat(flow: Frictional, y: jax.Array) -> State:
    """The state of an array of `flat`."""
    m, t = flow.across.shape[:2]
    ends = np.cumsum([m, m, t, m, t])
    return State(*jnp.split(y, ends))


def step(
    flow: Frictional,
    modes: Modes,
    state: State,
    kind: jax.Array,
    target: jax.Array,
    start: jax.Array,
    length: jax.Array,
) -> tuple[State, State, State]:
    """One step of order 8 and its two error estimates.

    `target` (4 m,), one-hot, is the event on which a ROOT_X or MARGIN step ends.
    """
    dtype, count, m = state.x.dtype, len(DOP853.c), state.x.shape[0]
    dense = np.array([[*row, *[0.0] * (count - len(row))] for row in DOP853.a])
    a, c = jnp.asarray(dense, dtype), jnp.asarray(DOP853.c, dtype)
    known = target[:m] & (kind == ROOT_X)
    r = flow.normal.root
    rates = rates_of(flow.normal, modes.phase)
    first = flat(state)

    def stage(i: jax.Array, slopes: jax.Array) -> jax.Array:
        xi = start + c[i] * length
        row = jax.lax.dynamic_index_in_dim(a, i, keepdims=False)
        y = unflat(flow, first + length * jnp.tensordot(row, slopes, axes=1))
        y = y._replace(x=jnp.where(known, xi**r, y.x))

        def derivatives() -> jax.Array:
            dy = field(flow, modes, rates, y)
            nears = of(target[m : 2 * m], margin_signs(modes.phase) * dy.g)
            nears = nears + of(target[2 * m : 3 * m], slowing(flow, modes, y.u, dy.u))
            rate = jnp.where(kind == ROOT_X, of(known, dy.x), jnp.where(kind == MARGIN, nears, 1.0))
            rooted = (kind == START) | (kind == ROOT_X)
            numerator = jnp.where(rooted, r * xi ** (r - 1), 1.0)
            dt = jnp.where(rate == 0, jnp.nan, numerator) / jnp.where(rate == 0, 1.0, rate)
            return flat(dy) * dt

        new = by_itself(derivatives, length)
        return jax.lax.dynamic_update_index_in_dim(slopes, new, i, 0)

    slopes = jax.lax.fori_loop(0, count, stage, jnp.zeros((count, *first.shape), dtype))
    weights = jnp.asarray([DOP853.b, DOP853.error_high, DOP853.error_low], dtype)
    change, high, low = jnp.tensordot(weights, slopes, axes=1)
    end = unflat(flow, first + length * change)
    end = end._replace(x=jnp.where(known, 0.0, end.x))
    return end, unflat(flow, length * high), unflat(flow, length * low)
