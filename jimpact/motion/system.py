"""Systems of mechanical motion: bodies under loads."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jimpact.bodies.base import STANDARD_GRAVITY, Body, LinearPotential, Potential
from jimpact.bodies.functions import FunctionBody
from jimpact.core.law import Law
from jimpact.core.scene import Scene
from jimpact.tools.checks import (
    as_float_array,
    check_function,
    check_shape,
    check_values,
    in_numbers,
    is_traced,
)

Base = Callable[[jax.Array], jax.Array]  # t () -> displacement y_b (d,) [m]
# functions of a system that are differentiated: whole numbers would have derivative 0
DIFFERENTIATED = ("gap_function", "tangent_function", "potential", "base")


class System(eqx.Module):
    """A body and the loads that move it between impacts; a pytree if its functions are.

    Equation: `M(q) q'' = F(q, q', t) - grad V(q) - (Coriolis terms) + N lambda_n + H
    lambda_t` with `N = grad f(q_r)`, `H = grad h(q_r)`, `q_r = q - B y_b(t)` the
    position seen from the base.

    Args:
        gap_function: a `Body`, which has its own mass and tangents; or q_r (n,) -> gaps
            f (m,) [m], written with jax.numpy.
        mass: M: (n,), (n, n), or a function q -> M(q); its Coriolis terms follow by
            differentiation of `T = v^T M(q) v / 2`.
        force: (q, v, t) -> generalized forces (n,); None: none. They do work on v: of a
            body in space v has its angular velocity in the axes of the body, and so are
            its moments.
        potential: q -> V () [J], its forces are `-grad V`; None: 0.
        gravity: True: the body has a weight; or its acceleration g >= 0 [m/s^2],
            downwards. For functions, see `gravity`.
        tangent_function: q_r -> tangential displacements h (m,) [m] of the contacts
            (planar); their gradients are the tangents. None: no friction possible.
        base: t -> displacement y_b (d,) [m] of a moving base, written with jax.numpy.
        base_directions: B (n, d): how q changes when everything moves with the base;
            None: those of the body.
        friction: coefficient mu >= 0 of persistent contacts, scalar or (m,), where
            there are tangents, in the plane or in space; None: that of the law, if it
            has a field `friction`.

    Functions that are `equinox.Module`s may hold arrays, and `simulate` is
    differentiable in these. JAX compiles again for each new lambda.

    Raises:
        ValueError: a mass that is not positive definite, a base without its directions,
            a potential besides gravity. TypeError: gravity of functions.

    >>> import jax.numpy as jnp, jimpact as ji
    >>> ball = ji.System(
    ...     lambda q: q[1:] - 0.5, [2.0, 2.0], potential=ji.gravity([0.0, 2.0])
    ... )
    >>> float(ball.potential(jnp.array([0.0, 1.0])))
    19.6133
    >>> block = ji.Block(width=0.2, height=0.6)
    >>> float(ji.System(block, gravity=10.0).potential(jnp.array([0.0, 2.0, 0.0])))
    20.0
    >>> ball = ji.System(ji.Column([1.0]), gravity=True)
    >>> motion = ji.simulate(ball, ji.Newton(0.5), [1.0], [0.0], 1.0, samples=21)
    >>> round(float(motion.events.time[0]), 6)
    0.451601
    """

    body: Body
    force: Callable[[jax.Array, jax.Array, jax.Array], jax.Array] | None
    potential: Potential | None
    base: Base | None
    base_directions: Float[Array, "n d"] | None
    friction: Float[Array, "..."] | None

    @staticmethod
    def _instead_of(value: Any) -> str:
        """Advice for a value that is no system, ending the message of `check_kind`."""
        if isinstance(value, Body):
            return " A body becomes one under its loads: ji.System(body, gravity=True)."
        if isinstance(value, Law):
            return " The system comes before the law."
        if isinstance(value, Scene):
            return (
                " A scene has no places: give a body, as in "
                "ji.System(ji.Column(masses), gravity=True)."
            )
        return ""

    def __str__(self) -> str:
        """The body, its mass, and the loads."""
        names = ("force", "potential", "base")
        loads = [name for name in names if getattr(self, name) is not None]
        lines = [f"system of a {type(self.body).__name__}"]
        if self.friction is not None:
            lines.append(f"friction {in_numbers(self.friction)}")
        if not callable(self.mass):
            lines.append(f"mass     {in_numbers(self.mass)}")
        return "\n".join([*lines, f"loads    {', '.join(loads) or 'none'}"])

    def __init__(
        self,
        gap_function: Body | Callable[[jax.Array], jax.Array],
        mass: Any = None,
        force: Callable[[jax.Array, jax.Array, jax.Array], jax.Array] | None = None,
        potential: Potential | None = None,
        tangent_function: Callable[[jax.Array], jax.Array | None] | None = None,
        base: Base | None = None,
        base_directions: Any = None,
        gravity: Any = False,
        friction: Any = None,
    ):
        functions = {"force": force, "potential": potential, "base": base}
        for name, function in functions.items():
            if function is not None:
                check_function(name, function)
        if not isinstance(gap_function, Body):
            if mass is None and callable(gap_function):
                raise ValueError(
                    "Argument `mass` must be given where `gap_function` is a function "
                    "(a body has "
                    "its own): an array or a function q -> M(q), but is None."
                )
            self.body = FunctionBody(gap_function, mass, tangent_function)
        elif mass is None and tangent_function is None:
            self.body = gap_function
        else:
            raise ValueError(
                "Arguments `mass` and `tangent_function` must not be given with a "
                "body, which has "
                "its own."
            )
        if gravity is not False:
            if potential is not None:
                raise ValueError(
                    "Argument `potential` must not be given besides `gravity`."
                )
            acceleration = _acceleration_of(gravity)
            potential = self.body.gravity(acceleration)
        self.force = force
        self.potential = potential
        self.base = base
        if friction is None:
            self.friction = None
        else:
            self.friction = as_float_array("friction", friction)
        check_values("friction", self.friction, low=0.0)
        if base is not None and base_directions is None:
            base_directions = self.body.base_directions
        if (base is None) != (base_directions is None):
            raise ValueError(
                "Argument `base_directions` must be given with `base`, and only with "
                "it."
            )
        self.base_directions = _directions_of_base(base_directions)

    @property
    def gap_function(self) -> Callable[[jax.Array], jax.Array]:
        """q_r -> gaps f (m,) [m] of the body."""
        return self.body.gap_function

    @property
    def tangent_function(self) -> Callable[[jax.Array], jax.Array | None]:
        """q_r -> displacements h (m,) [m] along the contact planes, or None."""
        return self.body.tangent_function

    @property
    def mass(self) -> Any:
        """M of the body, or q -> M(q)."""
        return self.body.mass


def _directions_of_base(directions: Any) -> Float[Array, "n d"] | None:
    """Directions B (n, d) of a base, checked; None without a base."""
    if directions is None:
        return None
    b = as_float_array("base_directions", directions)
    check_values("base_directions", b)
    if b.ndim != 2:
        raise ValueError(
            "Argument `base_directions` must have shape (n, d), but has shape "
            f"{b.shape}."
        )
    return b


def _acceleration_of(gravity: Any) -> Float[Array, ""]:
    """Size >= 0 [m/s^2] of an acceleration that points downwards; True: the standard
    one.
    """
    if gravity is True:
        gravity = STANDARD_GRAVITY
    acceleration = as_float_array("gravity", gravity)
    check_shape("gravity", acceleration, (), "the size of the acceleration")
    known = not is_traced(acceleration)
    if known and float(acceleration) < 0:
        raise ValueError(
            "Argument `gravity` must be >= 0, the size of an acceleration that points "
            f"downwards, but has value {float(acceleration):g} m/s^2."
        )
    check_values("gravity", acceleration, low=0.0)
    return acceleration


def gravity(mass_along_up: Any, acceleration: Any = STANDARD_GRAVITY) -> Potential:
    """Potential of gravity of a body, or for coordinates in which heights are linear.

    Equation: `V = g sum_i m_i q_i`.

    Args:
        mass_along_up: a `Body`; or (n,): the mass that each coordinate lifts [kg], 0
            for horizontal ones and angles, negative where the coordinate points down.
        acceleration: g [m/s^2].

    Returns:
        Potential q -> V () [J].

    Raises:
        ValueError: numbers that are not finite.

    >>> import jimpact as ji
    >>> ji.gravity([0.0, 2.0], acceleration=10.0).weights.tolist()
    [0.0, 20.0]
    >>> ji.gravity(
    ...     ji.Block(width=0.2, height=0.6, mass=2.0), acceleration=10.0
    ... ).weights.tolist()
    [0.0, 20.0, 0.0]
    """
    check_values("acceleration", acceleration)
    if isinstance(mass_along_up, Body):
        g = as_float_array("acceleration", acceleration)
        return mass_along_up.gravity(g)
    weights = as_float_array("mass_along_up", mass_along_up)
    check_values("mass_along_up", weights)
    g = jnp.asarray(acceleration, weights.dtype)
    return LinearPotential(weights * g)


DIRECTIONS = ("line", "vertical", "horizontal")


class HarmonicBase(eqx.Module):
    """A base that vibrates: `y_b = A sin(2 pi f t + phase)`.

    Args:
        amplitude: A [m].
        frequency: f [Hz].
        phase: [rad].
        direction: 'line' for systems that move along one (`Column`);
            'vertical' or 'horizontal' for bodies in the plane.

    >>> import jimpact as ji
    >>> ji.HarmonicBase(0.1, 1.0, direction="horizontal")(0.25).tolist()
    [0.1, 0.0]
    """

    amplitude: Float[Array, "..."]
    frequency: Float[Array, "..."]
    phase: Float[Array, "..."]
    direction: str = eqx.field(static=True)

    def __init__(
        self, amplitude: Any, frequency: Any, phase: Any = 0.0, direction: str = "line"
    ):
        self.amplitude = as_float_array("amplitude", amplitude)
        self.frequency = as_float_array("frequency", frequency)
        self.phase = as_float_array("phase", phase)
        for name in ("amplitude", "frequency", "phase"):
            check_values(name, getattr(self, name))
        if direction not in DIRECTIONS:
            raise ValueError(
                f"Argument `direction` must be one of {DIRECTIONS}, but has value "
                f"{direction!r}."
            )
        self.direction = direction

    def __call__(self, t: Any) -> Float[Array, " d"]:
        """Displacement [m] along the line, or (x, y)."""
        omega = 2 * jnp.pi * self.frequency
        angle = omega * t + self.phase
        y = self.amplitude * jnp.sin(angle)
        if self.direction == "line":
            return y[None]
        if self.direction == "vertical":
            pair = (0 * y, y)
        else:
            pair = (y, 0 * y)
        return jnp.stack(pair)


def check_functions(system: System, q: jax.Array, v: jax.Array, t: jax.Array) -> None:
    """Raise where a function of the system cannot be called, or returns another shape
    or type.

    At (q, v, t), traced in the precision of q; nothing is computed.
    """
    body = system.body
    n = v.shape[0]
    precision = q.dtype
    mass = _shape_of("mass", body.mass_matrix, {"q": q}, precision)
    if mass not in ((n,), (n, n)):
        raise ValueError(
            f"Argument `system` must have a mass of shape ({n},) or ({n}, {n}) as `v0` "
            f"has {n} "
            f"velocities, but has one of shape {mass}."
        )
    f = _shape_of("gap_function", body.gap_function, {"q": q}, precision)
    fits = len(f) == 1 and f[0] > 0
    _check_returned("gap_function", f, "(m,), a gap for each of m >= 1 contacts", fits)
    h = _shape_of("tangent_function", body.tangent_function, {"q": q}, precision)
    if h is not None:
        _check_returned(
            "tangent_function", h, "(m,), one displacement a contact", len(h) == 1
        )
    if system.force is not None:
        values = {"q": q, "v": v, "t": t}
        force = _shape_of("force", system.force, values, precision)
        _check_returned("force", force, f"({n},), one per velocity", force == (n,))
    if system.potential is not None:
        energy = _shape_of("potential", system.potential, {"q": q}, precision)
        is_scalar = energy == ()
        _check_returned("potential", energy, "(), an energy", is_scalar)
    if system.base is not None:
        assert system.base_directions is not None
        d = system.base_directions.shape[1]
        check_shape(
            "base_directions", system.base_directions, (n, d), "a row for each velocity"
        )
        place = _shape_of("base", system.base, {"t": t}, precision)
        fits = place == (d,) or (place == () and d == 1)
        _check_returned(
            "base", place, f"({d},), as `base_directions` has {d} columns", fits
        )


def _shape_of(
    name: str, function: Any, values: dict[str, jax.Array], precision: Any
) -> Any:
    """Shape that a function returns for traced `values` of its arguments; None where
    that is None.

    Raises a TypeError where it cannot be traced, returns whole numbers to be
    differentiated, or a finer precision.
    """

    def call(*traced: jax.Array) -> jax.Array | None:
        out = function(*traced)
        if out is None:
            return None
        return jnp.asarray(out)

    try:
        out = jax.eval_shape(call, *values.values())
    except Exception as error:
        reason = next(iter(str(error).splitlines()), "")
        raise TypeError(
            f"Argument `system` must have a `{name}` that takes JAX arrays "
            f"({', '.join(values)}) "
            f"and returns one, but it raises {type(error).__name__}: {reason}"
        ) from error
    if out is None:
        return None
    whole = not jnp.issubdtype(out.dtype, jnp.floating)
    if whole and name in DIFFERENTIATED:
        raise TypeError(
            f"Argument `system` must have a `{name}` that returns floating numbers, "
            f"but it "
            f"returns {out.dtype}."
        )
    if whole:
        return out.shape
    bits = jnp.finfo(out.dtype).bits
    allowed = jnp.finfo(precision).bits
    if bits > allowed:
        raise TypeError(
            f"Argument `system` must compute in the precision of `q0`, {precision}, "
            f"but its "
            f"`{name}` returns {out.dtype}: give `q0` in it, too."
        )
    return out.shape


def _check_returned(name: str, shape: Any, allowed: str, fits: bool) -> None:
    """Raise a ValueError for the shape that a function returns, unless it `fits`."""
    if not fits:
        raise ValueError(
            f"Argument `system` must have a `{name}` that returns shape {allowed}, "
            f"but it returns {shape}."
        )
