"""Contacts with friction, in the plane and in space: interior points.

With p = g a, p_t = h y, h / g = mu the disc |p_t| <= mu (p + load) is the cone |y| <= a
+ load. With the rates scaled alike, nu = g r and s -> h s, contact with friction is

    a nu = 0                      a, nu >= 0                           (complementary)
    Y o K = (Y . K, Y_0 K_t + K_0 Y_t) = 0,
    Y = (a + load, y) and K = (kappa, s) in the cone

where kappa = |s|. For `nu = g r + |s| - kappa` with a known |s| this would be a convex
problem, which Mehrotra's predictor and corrector solve in a few iterations, however
redundant the contacts and wherever slip turns to. |s| is that of the iteration before
as long as contacts might still stick, and changes with s where they slide. Where r = 0
is prescribed, a contact that pulls has p = g (a - nu), a nu = 0. Interior points
converge slowly where p = r = 0, so Newton's method on the modes ends it.

Source: Acary, Cadoux, Lemarechal and Malick, ZAMM 91 (2011) 155-175, for the convex
problem.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jimpact.numerics.dense import block_solve
from jimpact.numerics.discs import tangents_of
from jimpact.tools.compiling import full_precision
from jimpact.tools.loops import fori_loop, while_loop
from jimpact.tools.masks import quotient
from jimpact.tools.precision import precision

# Iterations of an attempt; 10 to 15 are usual. Ten times more: what diverges takes
# longer.
_MOST = 25
# Of the attempts: a contact counts as sliding whose |s|^2 is above this multiple of the
# mean of
# a nu and Y . K. Ten times more: slower where contacts slide; ten times less: contacts
# that nearly stick turn their slip in each iteration. 4 of 1 000 scenes of 4 to 12
# contacts need the last one.
_SLIDES = np.array([100.0, 1.0, 1e-4])
ATTEMPTS = len(_SLIDES)
# Misfit, as a part of the tolerance, at which Newton's method takes over after the
# first attempt (which ends at the root of rounding). Ten times more: the modes are not
# yet right; ten times less: contacts with p = r = 0 take all iterations.
_CLOSER = 1e-2
# Of the way to the boundary of the cones, what an iteration goes at most. Closer to 1:
# those that follow have no room.
_WITHIN = 0.99
# Part of the mean of a nu and Y . K at least that an iteration aims at. Ten times more:
# slower; ten times less: the last digits are those of rounding.
_LEAST_AIM = 1e-6


class Cones(NamedTuple):
    """Scaled problem: rates `constant + coupling x`, impulses `scale x`; b = 1 + rows
    columns.
    """

    coupling: Float[Array, "m b m b"]
    constant: Float[Array, "m b"]
    scale: Float[Array, "m b"]
    load: Float[Array, " m"]
    complementary: bool


class _Inside(NamedTuple):
    """A point inside the cones: Y = (a + load, y), K = (kappa, s), a and nu positive.

    Also a change of one, or its affine forms with an axis of w coefficients behind.
    """

    push: Float[Array, "m *w"]  # a
    normal: Float[Array, "m *w"]  # nu
    side: Float[Array, "m rows *w"]  # y
    bound: Float[Array, "m *w"]  # kappa
    slip: Float[Array, "m rows *w"]  # s


class Best(NamedTuple):
    """Impulses of the least misfit so far."""

    impulse: Float[Array, "m b"]
    misfit: Float[Array, ""]


class _Iterate(NamedTuple):
    """A point, the best impulses so far, and iterations done."""

    point: _Inside
    best: Best
    done: Int[Array, ""]


def cones_of(
    matrix: Float[Array, "m b m b"],
    rate: Float[Array, "m b"],
    friction: Float[Array, " m"],
    load: Float[Array, " m"] | None,
    complementary: bool,
) -> Cones:
    """The problem in impulses `(p, p_t) = (g a, h y)`, g = 1 / max(mu, 1) and h = mu
    g.
    """
    large = jnp.maximum(friction, 1.0)
    of_contacts = (friction / large)[:, None]
    sides = jnp.repeat(of_contacts, rate.shape[1] - 1, axis=1)
    normals = 1 / large[:, None]
    scale = jnp.concatenate([normals, sides], axis=1)
    scaled_rows = matrix * scale[:, :, None, None]
    coupling = scaled_rows * scale[None, None]
    if load is None:
        pressed = jnp.zeros_like(friction)
    else:
        pressed = load * large
    return Cones(coupling, rate * scale, scale, pressed, complementary)


@full_precision
def within_cones(
    cones: Cones,
    misfit: Callable[[jax.Array], jax.Array],
    attempt: Int[Array, ""],
    tolerance: float,
) -> Best:
    """Impulses x = (p, p_t) of contacts with friction, by interior points.

    Args:
        cones: the problem, with a diagonal and rates of order 1.
        misfit: how far x is from the law, a number >= 0.
        attempt: number of the attempt; from ATTEMPTS on nothing is done.
        tolerance: of the misfit.

    Returns:
        The x of the least misfit: that of the first attempt is close, others are
            closer.
    """
    first_close = precision(cones.constant.dtype).root
    unit = jnp.ones_like(cones.load)
    none = jnp.zeros_like(tangents_of(cones.constant))
    nan = 0 * jnp.sum(cones.constant)  # NaN where a rate is not finite
    middle = _Inside(unit + nan, unit, none, unit, none)
    slides = jnp.asarray(_SLIDES, unit.dtype)[attempt]
    close = jnp.where(attempt == 0, first_close, _CLOSER * tolerance)
    most = jnp.where(attempt < ATTEMPTS, _MOST, 0)

    def iterate(now: _Iterate) -> _Iterate:
        """The next point, and the best impulses so far."""
        point = _corrected(cones, now.point, slides)
        best = better(misfit, now.best, _impulse(cones, point))
        return _Iterate(point, best, now.done + 1)

    def goes_on(now: _Iterate) -> Bool[Array, ""]:
        """True while the misfit is not close to 0, NaN too, and iterations are left."""
        return ~(now.best.misfit <= close) & (now.done < most)

    unknown = jnp.asarray(jnp.inf, unit.dtype) + nan
    first = Best(_impulse(cones, middle), unknown)
    start = _Iterate(middle, first, jnp.asarray(0))
    return while_loop(goes_on, iterate, start).best


def better(
    misfit: Callable[[jax.Array], jax.Array], best: Best, x: Float[Array, "m b"]
) -> Best:
    """The impulses of less misfit: `best`, or x."""
    wrong = misfit(x)
    less = wrong < best.misfit
    impulse = jnp.where(less, x, best.impulse)
    return Best(impulse, jnp.where(less, wrong, best.misfit))


def _impulse(cones: Cones, at: _Inside) -> Float[Array, "m b"]:
    """Impulses (p, p_t) of a point in the units of the problem."""
    normal = _normal(cones, at)[:, None]
    return cones.scale * jnp.concatenate([normal, at.side], axis=1)


def _normal(cones: Cones, at: _Inside) -> Float[Array, " m"]:
    """Normal impulses a, or a - nu, which may pull, where rates are prescribed."""
    if cones.complementary:
        return at.push
    return at.push - at.normal


def _mean(cones: Cones, at: _Inside) -> Float[Array, ""]:
    """Mean of the products a nu and Y . K over all contacts, which is 0 at the
    solution.
    """
    product = jnp.sum(at.side * at.slip, axis=1)
    cone = (at.push + cones.load) * at.bound + product
    return jnp.mean(at.push * at.normal + cone) / 2


def _corrected(cones: Cones, at: _Inside, slides: Float[Array, ""]) -> _Inside:
    """The next point: a predictor shows how small a nu and Y . K may become at once.

    Changes are affine in those of (p, y) and in the aim: arrays (.., n + 2) of the n
    coefficients, what is constant, and the factor of the aim.
    """
    m, b = cones.constant.shape
    n = m * b
    mean = _mean(cones, at)
    change, matrix, right = _linearized(cones, at, slides)
    constant_moves, aim_moves = block_solve(matrix, right).reshape(n, 2).T

    def ahead(aim: Float[Array, ""]) -> _Inside:
        """The next point, if all products shall be `aim`, as far as the cones allow."""
        coefficients = constant_moves + aim * aim_moves
        factors = jnp.stack([1.0 + 0 * aim, aim])
        way = jnp.concatenate([coefficients, factors])
        way = jax.tree.map(lambda form: jnp.tensordot(form, way, axes=1), change)
        of_normals = _room_of_normals(at, way)
        room = jnp.minimum(_room_in_cone(cones, at, way), of_normals)
        part = jnp.minimum(1.0, _WITHIN * room)
        return jax.tree.map(lambda x, dx: x + part * dx, at, way)

    def look(
        _: Any, state: tuple[_Inside, Float[Array, ""]]
    ) -> tuple[_Inside, Float[Array, ""]]:
        """The point ahead with this aim, and the aim that follows:
        `mean (mean+ / mean)^2`.
        """
        _, aim = state
        point = ahead(aim)
        share = jnp.minimum(_mean(cones, point) / mean, 1.0) ** 2
        return point, jnp.maximum(share, _LEAST_AIM) * mean

    begin = (at, jnp.zeros_like(mean))
    return fori_loop(0, 2, look, begin)[0]


def _linearized(
    cones: Cones, at: _Inside, slides: Float[Array, ""]
) -> tuple[_Inside, Float[Array, "m b m b"], Float[Array, "m b 2"]]:
    """Changes of a point as affine forms, and the equations of their coefficients,
    linearized.

    Returns:
        Forms with a last axis of n coefficients, a constant and the factor of the aim;
        the matrix, and two right sides: of what is constant and of the aim.
    """
    m, b = cones.constant.shape
    n = m * b
    eye = jnp.eye(n + 2, dtype=cones.constant.dtype)
    x = eye[:n].reshape(m, b, n + 2)
    constant = eye[n][None]
    aim = eye[n + 1][None]
    of_rows = cones.coupling.reshape(m, b, n)
    rates = jnp.pad(of_rows, ((0, 0), (0, 0), (0, 2)))
    normal_rows = _normal(cones, at)[:, None]
    own = jnp.concatenate([normal_rows, at.side], axis=1).reshape(n)
    coupled = jnp.tensordot(of_rows, own, axes=1)
    missed = cones.constant + coupled
    square = jnp.sum(at.slip**2, axis=1)
    speed = jnp.sqrt(square)
    smoothed = speed**2 + slides * _mean(cones, at)
    turns = (speed / smoothed)[:, None] * at.slip
    side = tangents_of(x)
    gap = (tangents_of(missed) - at.slip)[..., None]
    slip = tangents_of(rates) + gap * constant[None]
    product = aim - (at.push * at.normal)[:, None] * constant
    if cones.complementary:
        push = x[:, 0]
    else:
        both = (at.push + at.normal)[:, None]
        pushed = at.push[:, None] * x[:, 0]
        push = (product + pushed) / both
    radius = at.push + cones.load
    of_sides = jnp.sum(at.side * at.slip, axis=1)
    inner = radius * at.bound + of_sides
    known_part = aim - inner[:, None] * constant
    bound = known_part - at.bound[:, None] * push
    turned = bound - _dot(at.side, slip) - _dot(at.slip, side)
    bound = turned / radius[:, None]
    normal = rates[:, 0] + missed[:, 0, None] * constant
    if cones.complementary:
        off = speed - at.bound - at.normal
        known_part = normal + off[:, None] * constant
        normal = known_part + _dot(turns, slip) - bound
        of_normal = at.push[:, None] * normal
        first = of_normal + at.normal[:, None] * push - product
    else:
        first = normal
        normal = push - x[:, 0]
    of_slip = radius[:, None] * at.slip
    outer = of_slip + at.bound[:, None] * at.side
    of_slips = radius[:, None, None] * slip
    sides = of_slips + at.bound[:, None, None] * side
    with_bound = sides + at.side[..., None] * bound[:, None]
    sides = with_bound + at.slip[..., None] * push[:, None]
    sides = sides + outer[..., None] * constant[None]
    equations = jnp.concatenate([first[:, None], sides], axis=1)
    matrix = equations[..., :n].reshape(m, b, m, b)
    point = _Inside(push, normal, side, bound, slip)
    return point, matrix, -equations[..., n:]


def _dot(
    values: Float[Array, "m rows"], forms: Float[Array, "m rows w"]
) -> Float[Array, "m w"]:
    """Sums `sum_i v_ji f_ji` over the tangents i of each contact j."""
    products = values[..., None] * forms
    return jnp.sum(products, axis=1)


def _room_of_normals(at: _Inside, way: _Inside) -> Float[Array, ""]:
    """Largest multiple of the change `way` with which all a and nu stay >= 0."""
    value = jnp.concatenate([at.push, at.normal])
    falls = jnp.concatenate([way.push, way.normal]) / value
    room = quotient(-1, falls, where=falls < 0, otherwise=jnp.inf)
    return jnp.min(room)


def _room_in_cone(cones: Cones, at: _Inside, way: _Inside) -> Float[Array, ""]:
    """Largest multiple of the change `way` with which all Y and K stay in the cone.

    With each turned into the middle of the cone, by a hyperbolic rotation.
    """
    first = jnp.concatenate([at.push + cones.load, at.bound])
    pairs = ([x.side, x.slip] for x in (at, way))
    side, change = (jnp.concatenate(pair) for pair in pairs)
    grows = jnp.concatenate([way.push, way.bound])
    square = first**2 - jnp.sum(side**2, axis=1)
    least = precision(first.dtype).tiny
    root = jnp.sqrt(jnp.maximum(square, least))
    first = first / root
    side = side / root[:, None]
    along = first * grows - jnp.sum(side * change, axis=1)
    share = (along + grows) / (1 + first)
    across = change - share[:, None] * side
    speed = jnp.sqrt(jnp.sum(across**2, axis=1))
    out = jnp.max((speed - along) / root)
    return quotient(1, out, where=out > 0, otherwise=jnp.inf)
