"""The description of a body: gaps, tangents and mass matrix as functions of its
configuration.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact.bodies.closed_pairs import ActivePairs
from jimpact.core.scene import Scene
from jimpact.tools.checks import (
    as_float_array,
    as_numbers,
    check_shape,
    check_values,
    is_traced,
)
from jimpact.tools.compiling import full_precision, quick_jit
from jimpact.tools.precision import precision

STANDARD_GRAVITY = 9.80665  # m/s^2
# [m] gaps this small are rounding of f(q) = 0; ten times more are, too
CLOSED_BELOW = 1e-12

_AROUND = np.linspace(0, 2 * np.pi, 49)  # [rad] corners of a drawn circle
# outline of a ball of radius 1
CIRCLE = np.stack([np.cos(_AROUND), np.sin(_AROUND)], axis=1)

Potential = Callable[[jax.Array], jax.Array]  # q (n,) -> V () [J]

PLANAR = ("x [m]", "y [m]", "angle [rad]")  # names of coordinates


def rate_of(name: str) -> str:
    """Name and unit of the rate of "x [m]": "x' [m/s]"."""
    word, unit = split_name(name)
    if unit:
        return f"{word}' [{unit}/s]"
    return f"{word}'"


def split_name(name: str) -> tuple[str, str]:
    """ "x [m]" as "x" and "m"; without a unit that is empty."""
    word, _, unit = name.removesuffix("]").partition(" [")
    return word, unit


def numbered(names: Sequence[str], count: int) -> tuple[str, ...]:
    """Names of `count` bodies: "x [m]" as "x1 [m]", "x2 [m]", ...; of one alone as they
    are.
    """
    if count == 1:
        return tuple(names)
    parts = [split_name(name) for name in names]
    return tuple(
        f"{word}{i + 1} [{unit}]" for i in range(count) for word, unit in parts
    )


class Directions(NamedTuple):
    """Gaps at one configuration, and gradients: `f' = N^T v`, slip velocities
    `H_t^T v`.
    """

    gaps: jax.Array  # f (m,)
    normals: jax.Array  # N (n, m)
    tangents: jax.Array | None  # H_t (n, m), in space (n, 2 m)


class Body(eqx.Module):
    """One or several bodies with contacts, as functions of their configuration q.

    Equation: gaps `f(q)`, normals `N = grad f`, tangents `H_t`, mass matrix `M(q)`; the
    velocities v (n,) are the rates of q (n,), or what `moved` makes of them:
    `q' = rates(q, v)`.

    At one instant a body is a `Scene` (`scene(q)`), under loads it is a `System` that
    moves. A body of your own gives `gap_function(q) -> (m,)`, `mass`, and for friction
    `tangent_function(q) -> (m,)` (or `tangents(q)` itself); where it shall stand under
    gravity or on a moving base, `gravity(acceleration)` and `base_directions`; where
    its gap function has a range, `valid`. Only a body whose velocities are not the
    rates of q gives `coordinates`, `moved` and `inertial_force`, too. It is a pytree:
    its numbers may be traced, batched and differentiated.

    >>> import jimpact as ji
    >>> block = ji.Block(width=1.0, height=2.0)
    >>> block.gap_function(block.touching(0.0)).tolist()
    [0.0, 0.0, 2.0, 2.0]
    """

    @property
    def coordinates(self) -> int | None:
        """Number of coordinates in q; None: as many as there are velocities."""
        return None

    def gap_function(self, q: jax.Array) -> jax.Array:
        """Gaps f(q) (m,) [m]; negative in penetration."""
        raise NotImplementedError(f"{type(self).__name__} must define `gap_function`.")

    range_in_words: ClassVar[str] = "see its `valid`"

    def valid(self, q: jax.Array) -> jax.Array:
        """Margin () that is >= 0 where the gap function holds at q; here it always
        does.
        """
        return jnp.ones((), q.dtype)

    def moved(self, q: jax.Array, u: jax.Array) -> jax.Array:
        """q after the displacement u (n,), a constant velocity times its time:
        `q + u`.
        """
        return q + u

    def nearby(self, q: jax.Array, u: jax.Array) -> jax.Array:
        """q after the displacement u, to second order in u; derivatives at u = 0 take
        it.
        """
        return self.moved(q, u)

    def rates(self, q: jax.Array, v: jax.Array) -> jax.Array:
        """q' at velocities v (n,): the derivative of `nearby(q, u)` in u, at 0, along
        v.
        """
        at_rest = jnp.zeros_like(v)
        _, rate = jax.jvp(lambda u: self.nearby(q, u), (at_rest,), (v,))
        return rate

    @property
    def mass(self) -> Any:
        """M: an array (n,) or (n, n) if it is constant, else a function q -> M(q)."""
        raise NotImplementedError(f"{type(self).__name__} must define `mass`.")

    def tangent_function(self, q: jax.Array) -> jax.Array | None:
        """Displacements (m,) [m] along the contact planes at q; their rates are sliding
        speeds.
        """
        return None

    def normals(self, q: jax.Array) -> jax.Array:
        """N (n, m) at q: gap velocities are `N^T v`."""
        return self._gradient(self.gap_function, q)

    def tangents(self, q: jax.Array) -> jax.Array | None:
        """H_t (n, m) at q, in space (n, 2 m), contact-major: `v_t = H_t^T v`; None: no
        friction.
        """
        if self.tangent_function(q) is None:
            return None
        return self._gradient(self.tangent_function, q)

    def directions(self, q: jax.Array, with_tangents: bool = True) -> Directions:
        """f, N and, `with_tangents`, H_t at q; here by differentiation, see
        `has_formulas`.
        """
        if with_tangents:
            tangents = self.tangents(q)
        else:
            tangents = None
        return Directions(self.gap_function(q), self.normals(q), tangents)

    @property
    def has_formulas(self) -> bool:
        """True if the body has its own `directions`, which need no differentiation."""
        return type(self).directions is not Body.directions

    def mass_matrix(self, q: jax.Array) -> jax.Array:
        """M(q) (n, n), or (n,) its diagonal."""
        mass = self.mass
        return jnp.asarray(mass(q) if callable(mass) else mass)

    @full_precision
    def inertial_force(self, q: jax.Array, v: jax.Array) -> jax.Array:
        """Coriolis and centrifugal terms (n,) [N] of `M v' = F + inertial_force` at q
        and v.

        Equation: `grad(v^T M v) / 2 - M' v`, 0 for a constant M.
        """
        if not callable(self.mass):
            return jnp.zeros_like(v)

        def momentum(x: jax.Array) -> jax.Array:
            """`M(x) v` (n,)."""
            mass = self.mass_matrix(x)
            if mass.ndim == 1:
                return mass * v
            return mass @ v

        _, change = jax.jvp(momentum, (q,), (v,))
        gradient = jax.grad(lambda x: v @ momentum(x))(q)
        return 0.5 * gradient - change

    def pulled(self, q: jax.Array, gradient: jax.Array) -> jax.Array:
        """A `gradient` in q as one in the displacements u (n,): `(dq/du)^T gradient` at
        u = 0.
        """
        velocities = self.mass_matrix(q).shape[:1]
        zero = jnp.zeros(velocities, q.dtype)
        _, pull = jax.vjp(lambda u: self.nearby(q, u), zero)
        return pull(gradient)[0]

    def _gradient(
        self, function: Callable[[jax.Array], Any], q: jax.Array
    ) -> jax.Array:
        """Gradients (n, k) of q -> (k,) in displacements u, at 0; forward mode allows
        loops.
        """
        velocities = self.mass_matrix(q).shape[:1]
        zero = jnp.zeros(velocities, q.dtype)
        derivative = jax.jacfwd(lambda u: function(self.nearby(q, u)))
        return derivative(zero).T

    @property
    def pair_count(self) -> int | None:
        """Number of contacts that `active_pairs` chooses from; None: time stepping
        takes all.
        """
        return None

    @property
    def overlap(self) -> Any:
        """Penetration [m] with which a motion may start: what steps of a pile leave."""
        return 0.0

    def least_gap(self, q: jax.Array) -> jax.Array:
        """The least gap () [m] at q (n,), of a body with `pair_count`."""
        return jnp.min(self.gap_function(q))

    def active_pairs(
        self, q: jax.Array, later: jax.Array, below: jax.Array
    ) -> ActivePairs:
        """The contacts, at q, with gaps up to `below` [m] at q or `later`, for time
        stepping.

        Only for bodies with three velocities each in a plane, six in space, and a
        diagonal M.
        """
        raise NotImplementedError(
            f"{type(self).__name__} has no `pair_count`, no `active_pairs`."
        )

    @property
    def functions(self) -> tuple[Any, ...]:
        """Functions of q (or None) that it holds as fields; they may close over traced
        arrays.
        """
        return ()

    def gravity(self, acceleration: Any) -> Potential:
        """Potential `q -> V ()` [J] of its weight at this acceleration g [m/s^2]."""
        raise TypeError(
            f"{type(self).__name__} has no vertical: give its `potential` yourself."
        )

    @property
    def base_directions(self) -> jax.Array | None:
        """B (n, d): velocities when everything moves with the base; None: it has no
        base.
        """
        return None

    def outlines(self, q: np.ndarray, point: float) -> Sequence[np.ndarray]:
        """Curves (k, 2) of (x, y) [m] that show it at q; mass points get the radius
        `point`.
        """
        raise TypeError(
            f"{type(self).__name__} has no outlines: give `outlines` yourself."
        )

    def outlines_by_body(
        self, q: np.ndarray, point: float
    ) -> Sequence[Sequence[np.ndarray]]:
        """Curves (k, 2) [m] of each body, drawn in one colour; here each curve of
        `outlines` alone.

        Args:
            q: configuration (n,).
            point: radius of mass points [m].
        """
        return [[curve] for curve in self.outlines(q, point)]

    def shadows(self, q: np.ndarray) -> Sequence[np.ndarray]:
        """Curves (k, 2) [m] of the shadows at q; none but of bodies in space."""
        return []

    @property
    def names(self) -> tuple[str, ...]:
        """Coordinates of q by name and unit, "x [m]", for pictures; (): nobody named
        them.
        """
        return ()

    @property
    def velocity_names(self) -> tuple[str, ...]:
        """Velocities by name and unit; here the rates of q, "x' [m/s]"."""
        return tuple(rate_of(name) for name in self.names)

    @property
    def floors(self) -> Sequence[Any]:
        """Planes to draw, (angle, offset) each; in space and where all hang none."""
        return ((0.0, 0.0),)

    def touching(self, *where: Any, **options: Any) -> Any:
        """q (n,) at which it touches what is around it; `where` and `options` as each
        body says.
        """
        raise TypeError(
            f"{type(self).__name__} has no `touching`: give its `q` yourself."
        )

    def scene(self, q: Any = None, closed_below: float = CLOSED_BELOW) -> Scene:
        """The scene at configuration q, its normals and tangents in the velocities
        (n,).

        q None is where it touches, `touching()`. Gaps up to `closed_below` [m] (or a
        few roundings of q) count as closed.

        Raises:
            ValueError: q of another size, not finite, or out of the range of the gap
                function (inside jit: normals that are NaN, so that `impact` says
                `not_finite`); penetration; a mass that is not positive.
        """
        q = as_float_array("q", self.touching() if q is None else q)
        mass = self.mass
        if callable(mass):
            mass = jax.eval_shape(mass, q)
        if self.coordinates is None:
            size = mass.shape[:1]
        else:
            size = (self.coordinates,)
        check_shape("q", q, size, "one per coordinate of the body")
        check_values("q", q)
        parts = self._parts(q)
        f = parts.gaps
        if f.ndim != 1 or f.size == 0:
            raise ValueError(
                f"Argument `gap_function` must return shape (m,), a gap for each of m "
                f">= 1 contacts of {type(self).__name__}, but it returns {f.shape}."
            )
        check_range("q", self, parts.margin)
        largest_coordinate = jnp.maximum(1.0, jnp.abs(q).max())
        noise = precision(f.dtype).noise * largest_coordinate
        largest = jnp.maximum(closed_below, noise)  # gap that counts as closed
        check_penetration("q", f, largest)
        closed = f <= largest.astype(f.dtype)
        gaps = jnp.where(closed, 0.0, f)  # NaN stays
        fields = (parts.mass, parts.normals, parts.tangents, gaps)
        in_precision = jax.tree.map(lambda x: x.astype(f.dtype), fields)
        return Scene(*in_precision)

    def scenes(self, q: Any, near: float = CLOSED_BELOW) -> list[Scene]:
        """Scenes at measured configurations q (K, d): the contacts that touch, no
        others.

        A measured height is hardly as good as a gap, so gaps count from the least one:
        contacts up to `near` [m] above it are closed, the others are left out.

        Raises:
            ValueError: q of another shape, not finite, out of the range of the gap
                function.

        >>> import jimpact as ji
        >>> edge = ji.Block(width=1.0, height=2.0).scenes([[0.0, 1.01, 0.0]])
        >>> edge[0].contacts
        2
        """
        q = as_float_array("q", q)
        if q.ndim != 2 or len(q) == 0:
            raise ValueError(
                f"Argument `q` must have shape (K, d), K >= 1 configurations, but has "
                f"{q.shape}."
            )
        d = self.coordinates or jax.eval_shape(self.mass_matrix, q[0]).shape[0]
        check_shape("q", q, (len(q), d), "a configuration a row")
        check_values("q", q)
        check_values("near", near, low=0.0)
        each = jax.tree.map(np.asarray, _many_parts(self, q))  # rows: configurations
        for k, margin in enumerate(each.margin):
            check_range("q", self, margin, f" in row {k + 1}")
        scenes = []
        gaps = each.gaps
        tangents = each.tangents
        least = gaps.min(axis=1, keepdims=True)
        for k, closed in enumerate(gaps <= least + near):
            closed_tangents = None
            if tangents is not None:
                of_contact = tangents.shape[2] // gaps.shape[1]
                columns = np.repeat(closed, of_contact)
                closed_tangents = tangents[k][:, columns]
            normals = each.normals[k][:, closed]
            scenes.append(Scene(each.mass[k], normals, closed_tangents))
        return scenes

    def _parts(self, q: jax.Array) -> "Parts":
        """Mass, normals, tangents and gaps at q, by a compiled program."""
        return _compiled_parts(self, q)


class Parts(NamedTuple):
    """The arrays of a body's scene at q (d,); in a batch (K, ...)."""

    mass: jax.Array  # M (n,) or (n, n)
    normals: jax.Array  # N (n, m)
    tangents: jax.Array | None  # H_t (n, m), in space (n, 2 m)
    gaps: jax.Array  # f (m,) [m]
    margin: jax.Array  # (), negative out of the range of the gap function


def parts_at(body: Body, q: jax.Array) -> Parts:
    """M, N, H_t, f and its margin at q; N is NaN out of the range of the gap
    function.
    """
    margin = body.valid(q)
    gaps, normals, tangents = body.directions(q)
    normals = jnp.where(margin >= 0, normals, jnp.nan)
    return Parts(body.mass_matrix(q), normals, tangents, gaps, margin)


@quick_jit
def _compiled_parts(body: Body, q: jax.Array) -> Parts:
    """The same, compiled."""
    return parts_at(body, q)


@quick_jit
def _many_parts(body: Body, q: jax.Array) -> Parts:
    """The same at many q (K, d), compiled."""
    return jax.vmap(partial(parts_at, body))(q)


def check_range(name: str, body: Body, margin: Any, where: str = "") -> None:
    """Raise a ValueError where `margin` (), that is `body.valid` of the argument, is
    negative.
    """
    if not is_traced(margin) and not float(margin) >= 0:
        raise ValueError(
            f"Argument `{name}` must be in the range of the gap function "
            f"({body.range_in_words}), but its margin `valid({name})` has value "
            f"{float(margin):g}{where}."
        )


def check_penetration(name: str, f: jax.Array, closed_below: jax.Array) -> None:
    """Raise a ValueError of argument `name` unless all gaps f (m,) are >=
    `-closed_below` [m].
    """
    if (
        is_traced((f, closed_below))
        or (np.asarray(f) >= -np.asarray(closed_below)).all()
    ):
        return
    worst = int(np.argmin(f))
    raise ValueError(
        f"Argument `{name}` must have no penetration (f >= -{float(closed_below):g} "
        f"m), but gap {worst} has value {float(f[worst]):g} m."
    )


class LinearPotential(eqx.Module):
    """Potential `V = w^T q` [J] of constant forces -w (n,) [N]."""

    weights: jax.Array

    @full_precision
    def __call__(self, q: jax.Array) -> jax.Array:
        """V () [J]."""
        return self.weights @ q


def positive(name: str, value: Any, low_allowed: bool = False) -> jax.Array:
    """The argument `name` as a scalar > 0, or >= 0 where `low_allowed`; else raise a
    ValueError.
    """
    return as_numbers(name, value, (), "one number", low=0.0, open_low=not low_allowed)


def number(name: str, value: Any) -> jax.Array:
    """The argument `name` as a finite scalar; else raise a ValueError."""
    return as_numbers(name, value, (), "one number")


def positives(
    name: str, value: Any, count: int | None = None, low_allowed: bool = False
) -> jax.Array:
    """The argument `name` as numbers (count,) > 0, or >= 0 where `low_allowed`.

    A scalar stands for all of them; `count` None: as many as are given.
    """
    numbers = as_float_array(name, value)
    if count is not None and numbers.ndim == 0:
        numbers = jnp.full(count, numbers)
    shape = (numbers.size if count is None else count,)
    return as_numbers(
        name, numbers, shape, "one of each", low=0.0, open_low=not low_allowed
    )


def as_planes(planes: Any, dimension: int) -> jax.Array:
    """Planes as rows (k, d + 1): unit normal into the free half space `n . x >= c`, and
    c [m].

    In the plane also an angle a [rad], or (a, c): n = (-sin a, cos a). None: the
    ground.
    """
    d = dimension
    if planes is None:
        return jnp.eye(1, d + 1, d - 1)
    if not np.iterable(planes):
        raise TypeError(
            f"Argument `planes` must be a list, one entry a plane, not {planes!r}."
        )
    rows = []
    for plane in planes:
        row = as_float_array("planes", plane)
        if d == 2 and row.shape in ((), (2,)):
            if row.ndim == 0:
                a = row
                c = jnp.zeros_like(row)
            else:
                a, c = row
            normal = [-jnp.sin(a), jnp.cos(a)]
            row = jnp.stack([*normal, c])
        if d == 2:
            angles = ", or an angle, or an angle and a distance, of each"
        else:
            angles = " of each"
        check_shape("planes", row, (d + 1,), f"a normal and a distance{angles}")
        check_values("planes", row)
        length, n = lengths(row[None, :d])
        if not is_traced(length) and not float(length[0]) > 0:
            raise ValueError(
                f"Argument `planes` must have normals that are not 0, but has {row}."
            )
        rows.append(jnp.concatenate([n[0], row[d:]]))
    if rows:
        return jnp.stack(rows)
    return jnp.zeros((0, d + 1))


def lengths(vectors: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Lengths (..) and unit vectors (.., d) of vectors (.., d); of one of length 0
    these are 0.
    """
    square = dot(vectors, vectors)
    length = jnp.sqrt(jnp.where(square > 0, square, 1.0))
    unit = vectors / length[..., None]
    return jnp.where(square > 0, length, 0.0), unit


def dot(a: jax.Array, b: jax.Array) -> jax.Array:
    """Scalar products (..)."""
    return jnp.sum(a * b, axis=-1)


# of the view of bodies in space
_AZIMUTH = np.deg2rad(30.0)
_ELEVATION = np.deg2rad(20.0)
_SCREEN = np.array(
    [
        [np.cos(_AZIMUTH), np.sin(_AZIMUTH), 0.0],
        [
            -np.sin(_AZIMUTH) * np.sin(_ELEVATION),
            np.cos(_AZIMUTH) * np.sin(_ELEVATION),
            np.cos(_ELEVATION),
        ],
    ]
)


def projected(points: np.ndarray) -> np.ndarray:
    """Points (.., 3) of space on the screen (.., 2): parallel projection, from above
    the plane.
    """
    return points @ _SCREEN.T
