"""Exact steps of the linear flow (eta = 1): the exponential of its matrix, applied as a series.

With phases frozen `x' = -r omega g`, `g' = r G omega x` is linear, so a step is a Taylor
polynomial in its length, summed to rounding. Unlike an eigenvector form it can be differentiated
where frequencies coincide. Events are roots of that polynomial.
"""

import jax
import jax.numpy as jnp

from jimpact.numerics.events import SNAP, margin_signs
from jimpact.numerics.flow import (
    ROOT_X,
    START,
    Flow,
    Rates,
    Slopes,
    State,
    field,
    lands,
    rates_of,
)
from jimpact.solvers.tridiagonal import as_matrix

TERMS = 20  # 1 / 20! < 1e-18: beyond rounding for steps up to REACH
REACH = 1.0  # step length times the largest frequency
NEWTON_STEPS = 8  # from the parabola's root, quadratic convergence leaves rounding only
LANDED = 1e-12  # |event variable| that counts as on the event
DIP_STEPS = 5  # Newton steps to a minimum inside a step, from the parabola's
SHORTEST_PART = 1e-3  # of a step, up to a minimum inside it: any less shortens it as much


def propagate(
    flow: Flow,
    phase: jax.Array,
    state: State,
    kind: jax.Array,
    target: jax.Array,
    start: jax.Array,
    length: jax.Array,
    due: jax.Array,
    tolerance: jax.Array,
) -> tuple[State, Slopes, Slopes]:
    """As `flow.step`, for exponent 1; the "error" only keeps the step within REACH."""
    coefficients = _series(flow, phase, state)
    landing = lands(kind)
    row = jnp.where((kind == ROOT_X)[None], coefficients.x, coefficients.g)
    event = jnp.sum(jnp.where(target[None], row, 0.0), axis=1, keepdims=True)
    event = event.at[0].add(jnp.where(kind == ROOT_X, 0.0, -(start + length)))
    h = jnp.where(kind == START, (start + length) ** 2 - start**2, length)
    h = jnp.where(landing, _root(event, due), h)
    end = State(*(_evaluate(series, h) for series in coefficients))
    end = end._replace(
        x=jnp.where(target & (kind == ROOT_X), 0.0, end.x),
        g=jnp.where(target & landing & (kind != ROOT_X), start + length, end.g),
    )
    strength = jnp.max(jnp.sum(jnp.abs(as_matrix(flow.coupling)) * flow.omega[None, :], axis=1))
    frequency = jnp.sqrt(strength * jnp.max(flow.omega))
    missed = landing & ~((h > 0) & (jnp.abs(_evaluate(event, h)) < LANDED))
    size = jnp.where(missed, jnp.nan, (h * frequency / REACH) ** 8)
    size = jnp.maximum(size, _dip(margin_signs(phase)[None] * coefficients.g, h, SNAP * tolerance))
    none = jnp.zeros_like(end.x)
    return end, Slopes(none, none, size * tolerance), Slopes(none, none, none)


def _dip(margins: jax.Array, h: jax.Array, snap: jax.Array) -> jax.Array:
    """An "error" that shortens a step to the first minimum below zero that no end of it shows."""
    margins, h = jax.lax.stop_gradient((margins, h))
    orders = jnp.arange(1, TERMS, dtype=margins.dtype)
    slopes = margins[1:] * orders[:, None]
    curvatures = slopes[1:] * orders[:-1, None]
    begin, end = slopes[0], _evaluate(slopes, h)
    turns = (begin < 0) & (end > 0)

    def newton(_: int, at: jax.Array) -> jax.Array:
        curvature = _evaluate(curvatures, at)
        down = _evaluate(slopes, at) / jnp.where(curvature > 0, curvature, jnp.inf)
        return jnp.clip(at - down, 0.0, h)

    secant = h * begin / jnp.where(turns, begin - end, 1.0)
    at = jax.lax.fori_loop(0, DIP_STEPS, newton, jnp.where(turns, secant, 0.0))
    hidden = turns & (_evaluate(margins, at) < -snap)
    part = jnp.min(jnp.where(hidden, at, h), keepdims=True) / jnp.where(h > 0, h, 1.0)
    return jnp.where(jnp.any(hidden), (1 / jnp.maximum(part, SHORTEST_PART)) ** 8, 0.0)


def _series(flow: Flow, phase: jax.Array, state: State) -> State:
    """Taylor coefficients (TERMS, m) of x, g, p and (TERMS,) of t in the length of the step."""
    rates = rates_of(flow, phase)

    def following(carry: State, order: jax.Array) -> tuple[State, State]:
        dx, dg, dp = _linear(flow, phase, rates, carry.x, carry.g)
        dt = jnp.where(order == 1, rates.unit, 0.0)
        after = State(dx / order, dg / order, dp / order, dt)
        return after, after

    first = state
    _, rest = jax.lax.scan(following, first, jnp.arange(1, TERMS, dtype=state.x.dtype))
    return State(*(jnp.concatenate([a[None], b]) for a, b in zip(first, rest)))


def _linear(
    flow: Flow, phase: jax.Array, rates: Rates, x: jax.Array, g: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """`flow.field` continued to x < 0, as a coefficient of a series may be."""
    up = field(flow, phase, rates, x, g)
    down = field(flow, phase, rates, -x, -g)
    return up[0], up[1] - down[1], up[2] - down[2]


def _evaluate(series: jax.Array, h: jax.Array) -> jax.Array:
    """Horner's rule, as a loop: unrolled it would take seconds to compile."""

    def following(value: jax.Array, row: jax.Array) -> tuple[jax.Array, None]:
        return value * h + row, None

    return jax.lax.scan(following, jnp.zeros_like(series[0]), series, reverse=True)[0]


def _root(event: jax.Array, guess: jax.Array) -> jax.Array:
    """Root of the event polynomial near `guess`, differentiable by one more Newton step."""
    fixed = jax.lax.stop_gradient(event)
    slopes = fixed[1:] * jnp.arange(1, TERMS, dtype=fixed.dtype)[:, None]

    def newton(_: int, h: jax.Array) -> jax.Array:
        return h - _evaluate(fixed, h) / _evaluate(slopes, h)

    h = jax.lax.stop_gradient(jax.lax.fori_loop(0, NEWTON_STEPS, newton, guess))
    return h - _evaluate(event, h) / _evaluate(slopes, h)
