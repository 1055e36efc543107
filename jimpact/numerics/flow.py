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
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jimpact.numerics.tableaux import DOP853
from jimpact.numerics.tridiagonal import Symmetric

TIME, START, ZERO_G, ROOT_X, FROM_GAP, ONSET = 0, 1, 2, 3, 4, 5  # variable of a step
OPEN, COMPRESSION, EXPANSION = 0, 1, 2  # phase of a contact

_DENSE_A = np.array([[*row, *[0.0] * (len(DOP853.c) - len(row))] for row in DOP853.a])

Exponent = float | tuple[float, ...] | jax.Array


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
    """Parameters of the dimensionless law, all (m,) but the unit-diagonal matrix `coupling` G."""

    coupling: Symmetric
    omega: jax.Array
    restitution: jax.Array
    exponent: Exponent
    gapped: bool = False
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
    return Flow(*jax.lax.stop_gradient(flow[:3]), exponent, flow.gapped, viscous)


class State(NamedTuple):
    """Indentation x, scaled gap velocity g, impulse p (all (m,)) and impact time t ()."""

    x: jax.Array
    g: jax.Array
    p: jax.Array
    t: jax.Array


def lands(kind: jax.Array) -> jax.Array:
    """Whether a step of this kind ends on an event."""
    return (kind != TIME) & (kind != START)


def power(x: jax.Array, exponent: Exponent) -> jax.Array:
    """`max(x, 0)^exponent` with finite derivatives at 0; fast for static 1, 1.5 and 2."""
    if isinstance(exponent, tuple) and len(set(exponent)) == 1:
        exponent = exponent[0]
    if isinstance(exponent, float) and exponent == 1.0:
        return jnp.where(x >= 0, x, 0.0)  # at 0 the derivative of a contact that closes
    positive = x > 0
    x = jnp.where(positive, x, 0.0)
    if isinstance(exponent, float):
        if exponent == 2.0:
            return x * x
        if exponent == 1.5:
            return x * jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)
    eta = jnp.asarray(exponent, x.dtype)
    return jnp.where(positive, jnp.exp(eta * jnp.log(jnp.where(positive, x, 1.0))), 0.0)


def plus_one(exponent: Exponent) -> Exponent:
    """`exponent + 1`, static where `exponent` is."""
    return tuple(e + 1 for e in exponent) if isinstance(exponent, tuple) else exponent + 1


def root_order(exponent: Exponent) -> int:
    """`r` of the START and ROOT_X variables: powers `xi^(r eta)` are then smooth enough."""
    known = isinstance(exponent, (float, tuple))
    etas = np.atleast_1d(np.asarray(exponent)) if known else np.array([0.1])
    return 2 if np.all(2 * etas == np.round(2 * etas)) else 8


def factor(exponent: Exponent, dtype: jnp.dtype) -> jax.Array:
    """`(eta + 1) / 2`."""
    return (jnp.asarray(exponent, dtype) + 1) / 2


def scales(flow: Flow, phase: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """`s_j` with `gamma_j = s_j g_j`, the time unit `s*`, and `s* / s_j` (0/0 = 1)."""
    s = jnp.where(phase == EXPANSION, flow.restitution, 1.0)
    unit = s[jnp.argmin(s)]  # not min(): its derivative is shared among ties
    ratio = jnp.where(s > 0, unit / jnp.where(s > 0, s, 1.0), 1.0)
    return s, unit, ratio


def field(flow: Flow, phase: jax.Array, x: jax.Array, g: jax.Array) -> tuple[jax.Array, ...]:
    """`(x', g', p', t')` with respect to time in units of `s*`, phases frozen."""
    _, unit, ratio = scales(flow, phase)
    if flow.viscous is None:
        force = factor(flow.exponent, x.dtype) * flow.omega * power(x, flow.exponent)
    else:
        force = flow.viscous.push(x, g)
    if flow.gapped:
        force = jnp.where(phase == OPEN, 0.0, force)
    closing = -ratio * flow.omega
    if not flow.gapped:
        closing = jnp.where(phase == OPEN, 0.0, closing)
    return closing * g, ratio * (flow.coupling @ force), unit * force, unit


def step(
    flow: Flow,
    phase: jax.Array,
    state: State,
    kind: jax.Array,
    target: jax.Array,
    start: jax.Array,
    length: jax.Array,
) -> tuple[State, State, State]:
    """One DOP853 step of `length` in the variable `kind`, which begins at `start`.

    `target` (m,) is one-hot: the contact whose event ends a ZERO_G or ROOT_X step. Returns the
    end state and the two error estimates. The stages are a loop of matrix products: unrolled,
    the derivative takes seven times as long to compile.
    """
    m, dtype, r = state.x.shape[0], state.x.dtype, root_order(flow.exponent)
    a, c = jnp.asarray(_DENSE_A, dtype), jnp.asarray(DOP853.c, dtype)
    known_x = target & ((kind == ROOT_X) | (kind == FROM_GAP))
    known_g = target & (kind == ZERO_G)
    y = jnp.concatenate([state.x, state.g])

    def stage(i: jax.Array, slopes: jax.Array) -> jax.Array:
        at = y + length * (a[i] @ slopes[:, : 2 * m])
        xi = start + c[i] * length
        # the variable of the step is known exactly at every stage
        x = jnp.where(known_x, jnp.where(kind == FROM_GAP, xi, xi**r), at[:m])
        g = jnp.where(known_g, xi, at[m:])
        rates = field(flow, phase, x, g)
        row = jnp.concatenate([*rates[:3], rates[3][None]])
        dx, dg = rates[:2]
        if flow.slackens:
            turning = jax.jvp(flow.viscous.onset, (x, g), (dx, dg))[1]  # type: ignore[union-attr]
            dx = jnp.where(kind == ONSET, turning, dx)
        return slopes.at[i].set(row * _stretch(kind, target, xi, (dx, dg), r))

    slopes = jax.lax.fori_loop(0, len(c), stage, jnp.zeros((len(c), 3 * m + 1), dtype))
    weights = jnp.asarray([DOP853.b, DOP853.error_high, DOP853.error_low], dtype)
    change, high, low = (
        State(row[:m], row[m : 2 * m], row[2 * m : 3 * m], row[3 * m])
        for row in length * (weights @ slopes)
    )
    end = State(*(before + by for before, by in zip(state, change)))
    end = end._replace(
        x=jnp.where(known_x, 0.0, end.x), g=jnp.where(known_g, start + length, end.g)
    )
    return end, high, low


def _stretch(
    kind: jax.Array, target: jax.Array, xi: jax.Array, rates: tuple[jax.Array, ...], r: int
) -> jax.Array:
    """`dt / dxi`."""
    dx, dg = (jnp.sum(jnp.where(target, rate, 0.0)) for rate in rates[:2])
    rate = jnp.where(kind == ZERO_G, dg, jnp.where(lands(kind), dx, 1.0))
    numerator = jnp.where((kind == START) | (kind == ROOT_X), r * xi ** (r - 1), 1.0)
    safe = jnp.where(rate == 0, 1.0, rate)
    return jnp.where(rate == 0, jnp.nan, 1.0) * numerator / safe
