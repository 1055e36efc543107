"""Unilateral contacts with friction by accelerated projections: only products `A x` are
needed.

The problem is that of `friction.solve`, complementary,

    0 <= r _|_ p >= 0,    p_t in -mu p Sgn(s),    (r, s) = (a, b) + A x,   x = (p, p_t),

for thousands of contacts, to a tolerance, without derivatives and without the search
for further solutions. One iteration is a step against (r, s) and a projection onto p >=
0 and onto the discs |p_t| <= mu p; Nesterov's momentum, given up where it points
uphill, makes some hundred of them enough for a pile. Anderson's extrapolation, which
`step_impulses.py` uses for few contacts, needs 691 products for 316 (a pile of 74
contacts, misfit 1e-4), and finds no end of 322 contacts in 4000.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jimpact.numerics.discs import in_disc, normals_of, tangents_of
from jimpact.tools.compiling import full_precision
from jimpact.tools.loops import while_loop

# Factors of the inverse step size, the estimate of the largest eigenvalue: where a step
# shows that it is too small, and at the beginning of the next problem. Further from 1:
# short steps, or steps taken back.
STEEPER = 1.5
RELAX = 0.9
# Share by which a curvature may exceed the estimate by rounding. Ten times more is
# rounding, too.
CURVATURE_ROUNDING = 1e-9
# Discs grow and shrink with p: full momentum may go round and round among them. So
# there is less of it in each quarter of the iterations.
MOMENTUM = np.array([1.0, 0.9, 0.7, 0.5])


class Many(NamedTuple):
    """Impulses of many contacts, and how the iteration ended."""

    impulse: Float[Array, "m b"]  # x
    misfit: Float[Array, ""]  # over the largest rate, both scaled to a diagonal of 1
    residual_velocity: Float[Array, ""]  # [m/s] at most
    iterations: Int[Array, ""]
    inverse_step_size: Float[Array, ""]  # at the end


class _At(NamedTuple):
    """State of the iteration, in the scaling with diagonal 1."""

    x: Float[Array, "m b"]
    ax: Float[Array, "m b"]  # A x
    y: Float[Array, "m b"]  # x with momentum
    ay: Float[Array, "m b"]  # A y
    weight: Float[Array, ""]  # t of Nesterov's momentum
    inverse_step_size: Float[Array, ""]  # L
    best: Float[Array, "m b"]  # x of the least misfit so far
    misfit: Float[Array, ""]  # of `best`
    tries: Int[Array, ""]  # iterations so far


@full_precision
def solve_many(
    product: Callable[[jax.Array], jax.Array],
    diagonal: Float[Array, "m b"],
    rate: Float[Array, "m b"],
    friction: Float[Array, ""] | Float[Array, " m"],
    start: Float[Array, "m b"],
    inverse_step_size: Float[Array, ""],
    tolerance: float,
    most: Any,
    load: Float[Array, " m"] | None = None,
) -> Many:
    """Impulses x of contacts with Coulomb friction, normals first (b = 1, 2, 3).

    Equation: `0 <= x_n _|_ (A x + rate)_n >= 0`, `|x_t| <= mu (x_n + load)`, x_t
    against the slip `(A x + rate)_t` where it slides.

    Args:
        product: x -> A x; rows of contacts that take no part are 0.
        diagonal: of A.
        rate: gap velocities and slips without the impulses [m/s].
        friction: mu.
        start: x to begin with.
        inverse_step_size: estimate of the largest eigenvalue of A, scaled to a diagonal
            of 1.
        tolerance: misfit at which it ends, of the largest of `rate`.
        most: iterations, an int or ().
        load: normal impulses in addition to x_n, which friction includes; None: 0.

    Returns:
        `Many`: the impulse of the least misfit, which the iteration need not end with.

    Source: Nesterov (1983), O'Donoghue and Candes (2015) for the restart; Mazhar, Heyn,
    Negrut and Tasora, ACM Trans. Graph. 34 (2015) for granular media (there the cone is
    convexified, which opens contacts that slide; here it is not).

    >>> import jax.numpy as jnp
    >>> from jimpact.numerics.many_contacts import solve_many
    >>> one = jnp.ones((1, 2))
    >>> problem = (
    ...     jnp.array([[-1.0, 3.0]]),
    ...     jnp.array(0.5),
    ...     0 * one,
    ...     jnp.array(1.0),
    ...     1e-6,
    ...     100,
    ... )
    >>> [round(float(x), 5) for x in solve_many(lambda x: x, one, *problem).impulse[0]]
    [1.0, -0.5]
    """
    scale = _scale(diagonal)
    # discs stay discs: all tangents of a contact have one scale
    slope = friction * scale[:, 0] / scale[:, -1]
    goal = rate * scale
    if load is None:
        carried = None
    else:
        carried = load / scale[:, 0]
    size = jnp.max(jnp.abs(goal))

    def times(x: Float[Array, "m b"]) -> Float[Array, "m b"]:
        """`S A S x` with the scales S of the impulses."""
        return scale * product(scale * x)

    def going(at: _At) -> Bool[Array, ""]:
        """True while the misfit is too large and iterations are left."""
        return (at.misfit > tolerance * size) & (at.tries < most)

    def iterate(at: _At) -> _At:
        """State after the step `x = P(y - (A y + rate) / L)`, P the projection on the
        cones.
        """
        gradient = at.ay + goal
        x = _projected(at.y - gradient / at.inverse_step_size, slope, carried)
        return _with_momentum(at, x, times(x), most)

    # NaN where a rate is not finite
    x = _projected(start / scale, slope, carried) + 0 * size
    ax = times(x)
    unit = jnp.ones((), x.dtype)
    inverse_step_size = jnp.maximum(RELAX * inverse_step_size, unit)
    unknown = jnp.inf * unit
    begin = _At(
        x=x,
        ax=ax,
        y=x,
        ay=ax,
        weight=unit,
        inverse_step_size=inverse_step_size,
        best=x,
        misfit=unknown,
        tries=jnp.int32(0),
    )
    end = while_loop(going, iterate, begin)
    relative = end.misfit / jnp.where(size > 0, size, 1.0)
    # a bound, in the units of `rate`
    residual = end.misfit * jnp.sqrt(jnp.max(diagonal))
    impulse = end.best * scale
    return Many(impulse, relative, residual, end.tries, end.inverse_step_size)


def _scale(diagonal: Float[Array, "m b"]) -> Float[Array, "m b"]:
    """Scales of the impulses, 1 / sqrt of the diagonal; the tangents of a contact share
    one.
    """
    of_tangents = jnp.mean(tangents_of(diagonal), axis=1, keepdims=True)
    squares = jnp.concatenate([normals_of(diagonal), of_tangents], axis=1)
    squares = jnp.where(squares > 0, squares, 1.0)
    kind = jnp.minimum(jnp.arange(diagonal.shape[1]), 1)
    return 1 / jnp.sqrt(squares[:, kind])


def _projected(
    x: Float[Array, "m b"], slope: Float[Array, " m"], load: Float[Array, " m"] | None
) -> Float[Array, "m b"]:
    """Nearest impulses with `p >= 0`, then with `|p_t| <= slope (p + load)`, slope:
    scaled mu.
    """
    p = jnp.maximum(normals_of(x), 0.0)
    pressed = p
    if load is not None:
        pressed = p + load[:, None]
    radius = slope[:, None] * pressed
    side = in_disc(tangents_of(x)[..., None], radius)
    return jnp.concatenate([p, side[..., 0]], axis=1)


def _with_momentum(
    at: _At, x: Float[Array, "m b"], ax: Float[Array, "m b"], most: Any
) -> _At:
    """The iterate after a projected step from y to x, with A x: Nesterov's method with
    restarts.

    Equation: y+ is `x + (t - 1) / t+ (x - x before)`, `t+ = (1 + sqrt(1 + 4 t^2)) / 2`.
    Where `step . A step > L |step|^2`, L the inverse step size, the step overshoots: x
    is not taken, and L grows. There, and where the momentum points uphill, t begins
    again with 1. The best x is that of the least misfit, `L max|step|`.
    """
    step = x - at.y
    a_step = ax - at.ay
    square = jnp.vdot(step, step)
    allowed_curvature = at.inverse_step_size * square * (1 + CURVATURE_ROUNDING)
    overshoots = jnp.vdot(step, a_step) > allowed_curvature
    restarts = overshoots | (jnp.vdot(step, x - at.x) < 0)
    root = jnp.sqrt(1 + 4 * at.weight**2)
    weight = (1 + root) / 2
    # less momentum where many iterations did not suffice
    stage = len(MOMENTUM) * at.tries // jnp.maximum(most, 1)
    allowed = jnp.asarray(MOMENTUM, x.dtype)[stage]
    of_nesterov = (at.weight - 1) / weight
    momentum = jnp.where(restarts, 0.0, jnp.minimum(of_nesterov, allowed))
    x = jnp.where(overshoots, at.x, x)
    ax = jnp.where(overshoots, at.ax, ax)
    change = at.inverse_step_size * jnp.max(jnp.abs(step))
    misfit = jnp.where(overshoots, jnp.inf, change)
    better = ~(misfit >= at.misfit)  # also NaN, which is then the result
    return _At(
        x=x,
        ax=ax,
        y=x + momentum * (x - at.x),
        ay=ax + momentum * (ax - at.ax),
        weight=jnp.where(restarts, 1.0, weight),
        inverse_step_size=jnp.where(overshoots, STEEPER, 1.0) * at.inverse_step_size,
        best=jnp.where(better, x, at.best),
        misfit=jnp.where(better, misfit, at.misfit),
        tries=at.tries + 1,
    )
