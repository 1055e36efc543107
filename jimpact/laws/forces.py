"""Force-indentation laws of a compliant contact, for `Compliant`.

Each gives the force [N] at indentation x >= 0 [m] and indentation rate x' [m/s],
contact by contact: parameters are scalars or (m,). Forces never pull: where a damper
would, the contact is slack until the force returns.
"""

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from jimpact.core.law import (
    LARGEST_EXPONENT,
    Declared,
    StaticOrValues,
    Values,
    parameter,
    with_parameter,
)
from jimpact.tools.checks import as_float_array, check_function
from jimpact.tools.loops import fori_loop

# decades [m] in which the indentation scale of a force is searched
_SEARCH = (-60.0, 60.0)
_BISECTIONS = 50  # halvings of these decades, to about 1e-13 of one
# |zeta - 1| below which e of damped and overdamped springs is one series, and its
# terms: each is half of |zeta - 1| times the one before, so that the third derivative
# has an error of 1e-17. Ten times less, and the third derivative of the formulas
# outside would lose nine digits to their 0 / 0.
_CRITICAL = 0.1
_CRITICAL_TERMS = 18


class Force(Declared):
    """A contact force; `force` and, where it may slacken, a smooth `onset` of its sign.

    A force of your own with declared parameters inherits it; `UserForce` takes a
    function. What else it can do it declares: `slackens`, the force may end before the
    indentation does; `bistiffness`, for forces that are one, and the `bound` of one
    that yields; `damping_scale` and a parameter `damping`, for `calibrate`;
    `pair_restitution`, where it is known in closed form.

    >>> import jax.numpy as jnp
    >>> import jimpact as ji
    >>> class Stiffening(ji.Force):
    ...     stiffness: float = ji.parameter(low=0, open_low=True)
    ...
    ...     def force(self, x, rate):
    ...         return self.stiffness * x * (1 + x)
    >>> float(Stiffening(2.0).force(jnp.array(1.0), jnp.array(0.0)))
    4.0
    """

    slackens: ClassVar[bool] = False

    def force(self, x: jax.Array, rate: jax.Array) -> jax.Array:
        """Force (m,) [N] at indentation x > 0 (m,) [m] and rate x' (m,) [m/s]."""
        raise NotImplementedError(f"{type(self).__name__} must define `force`.")

    def onset(self, x: jax.Array, rate: jax.Array) -> jax.Array:
        """Sign of the force at x >= 0 and rate x', of any dimension; positive at rate
        0.
        """
        return self.force(x, rate)

    def onset_scale(self, depth: jax.Array, speed: jax.Array) -> jax.Array:
        """Largest `onset` at indentation `depth` (m,) [m], at rest and at `speed` (m,)
        [m/s].
        """
        at_rest = self.onset(depth, jnp.zeros_like(depth))
        return jnp.maximum(at_rest, self.onset(depth, speed))

    @property
    def bistiffness(self) -> "Bistiffness | None":
        """The same force as a `Bistiffness`, which stores energy and has a history;
        else None.
        """
        return None

    @property
    def bound(self) -> jax.Array | None:
        """Force [N] beyond which indentation is plastic; None: it has no such bound."""
        return None

    def damping_scale(self, mass: jax.Array, speed: jax.Array) -> jax.Array | None:
        """A strong `damping` of a pair of reduced `mass` [kg] at a `speed` [m/s]; None:
        no such.
        """
        return None

    def with_damping(self, damping: jax.Array) -> "Force":
        """The force with another value of its parameter `damping`."""
        force: Force = with_parameter(self, "damping", damping)
        return force

    def pair_restitution(self, mass: jax.Array, speed: jax.Array) -> jax.Array | None:
        """e of a pair of reduced `mass` [kg] at a `speed` [m/s]; None: to be
        integrated.
        """
        return None

    def indentation_scale(self, energy: jax.Array) -> jax.Array:
        """Indentation (m,) [m] at which about `energy` (m,) [J] is stored: x F(x, 0) =
        2 energy.

        By bisection of log10(x); no derivatives.
        """

        def excess(log_x: jax.Array) -> jax.Array:
            """`x F(x, 0) - 2 energy` (m,) [J] at decades log10(x) (m,)."""
            x = 10.0**log_x
            return x * self.force(x, jnp.zeros_like(x)) - 2 * energy

        low, high = (jnp.full_like(energy, end) for end in _SEARCH)

        def halve(
            _: int, ends: tuple[jax.Array, jax.Array]
        ) -> tuple[jax.Array, jax.Array]:
            """The half of the intervals (low, high) in which the excess changes
            sign.
            """
            low, high = ends
            middle = 0.5 * (low + high)
            above = excess(middle) > 0
            return jnp.where(above, low, middle), jnp.where(above, middle, high)

        low, high = fori_loop(0, _BISECTIONS, halve, (low, high))
        return jax.lax.stop_gradient(10.0 ** (0.5 * (low + high)))


class Bistiffness(Force):
    """Elastic-plastic contact of `LZB`: loads as `k x^eta`, unloads steeper, to x > 0.

    Equation: loading `F = k x^eta`; unloading from (x_c, F_c) along
    `F = F_c ((x - x_r) / (x_c - x_r))^eta` with the residual indentation
    `x_r = (1 - e^2) x_c`, where the surface remains after unloading. The pair's
    restitution coefficient is e at any speed.

    Args:
        stiffness: k > 0 [N / m^eta].
        exponent: eta >= 1; a float (or a tuple) is static, an array is differentiable.
        restitution: e in [0, 1].

    Source: Brogliato, Nonsmooth Mechanics (2016), section 6.3.1, (6.67).

    >>> import jimpact as ji
    >>> force = ji.Bistiffness(1.0, exponent=1.5, restitution=0.8)
    >>> round(float(ji.measured_restitution(force, mass=1.0, speed=1.0)), 9)
    0.8
    """

    stiffness: Values = parameter(low=0.0, open_low=True, log=True)
    exponent: StaticOrValues = parameter(
        low=1.0, static_numbers=True, searched_high=LARGEST_EXPONENT, default=1.5
    )
    restitution: Values = parameter(low=0.0, high=1.0, default=1.0)

    @property
    def bistiffness(self) -> "Bistiffness":
        """Itself."""
        return self

    def pair_restitution(self, mass: jax.Array, speed: jax.Array) -> jax.Array:
        """e, whatever the mass and the speed."""
        shape = jnp.broadcast_shapes(mass.shape, speed.shape, self.restitution.shape)
        return jnp.broadcast_to(self.restitution, shape)

    def force(self, x: jax.Array, rate: jax.Array) -> jax.Array:
        """Force of the loading branch, `k x^eta` (m,) [N], 0 at x <= 0."""
        positive = x > 0
        power = jnp.where(positive, x, 1.0) ** jnp.asarray(self.exponent, x.dtype)
        return self.stiffness * jnp.where(positive, power, 0.0)


class ElastoPlastic(Force):
    """Elastic contact that yields: `F = k x^eta` up to a force that it never exceeds.

    Equation: `F = k x_e^eta` of the elastic indentation, `x_e' = -gamma`, but
    `x_e' = 0` while `F = F_y` and the contact is compressed. Unloading is elastic,
    along another branch, to the residual indentation x - x_e, where the surface
    remains. A pair is elastic up to a speed v_y; above it `e = v_y / v`, as it returns
    at most the elastic energy at F_y,
    `m v_y^2 / 2 = F_y^((eta + 1) / eta) / ((eta + 1) k^(1 / eta))`.

    A `Bistiffness`, in comparison, loses its share at any speed, and its force has no
    bound.

    Args:
        stiffness: k > 0 [N / m^eta].
        yield_force: F_y > 0 [N].
        exponent: eta >= 1; a float (or a tuple) is static, an array is differentiable.

    `Compliant` takes it without friction, and not by method 'implicit'; motions do not
    take it.

    Source: elastic, ideally plastic contact; Brogliato, Nonsmooth Mechanics (2016),
    6.3.1, on what a bistiffness leaves out.

    >>> import jimpact as ji
    >>> force = ji.ElastoPlastic(
    ...     8.0, yield_force=2.0, exponent=1.0
    ... )  # F_y^2 / (2 k) = 1/4 J
    >>> [
    ...     round(float(ji.measured_restitution(force, mass=2.0, speed=v)), 6)
    ...     for v in (0.4, 1.0)
    ... ]
    [1.0, 0.5]
    """

    stiffness: Values = parameter(low=0.0, open_low=True, log=True)
    yield_force: Values = parameter(low=0.0, open_low=True, log=True)
    exponent: StaticOrValues = parameter(
        low=1.0, static_numbers=True, searched_high=LARGEST_EXPONENT, default=1.5
    )

    @property
    def bistiffness(self) -> Bistiffness:
        """Its elastic part."""
        return Bistiffness(self.stiffness, self.exponent)

    @property
    def bound(self) -> jax.Array:
        """The yield force."""
        return self.yield_force

    def pair_restitution(self, mass: jax.Array, speed: jax.Array) -> jax.Array:
        """`e = min(1, v_y / v)` with `m v_y^2 / 2` the elastic energy at the yield
        force.
        """
        eta = jnp.asarray(self.exponent, mass.dtype)
        f_y = self.yield_force
        k = self.stiffness
        energy = f_y ** ((eta + 1) / eta) / (eta + 1) / k ** (1 / eta)
        v_y = jnp.sqrt(2 * energy / mass)
        return jnp.minimum(1.0, v_y / speed)

    def force(self, x: jax.Array, rate: jax.Array) -> jax.Array:
        """Force of a first loading, `min(k x^eta, F_y)` (m,) [N]."""
        return jnp.minimum(self.bistiffness.force(x, rate), self.yield_force)


def PowerLaw(stiffness: Any, exponent: Any = 1.5) -> Bistiffness:
    """Elastic contact `F = k x^eta`.

    Args:
        stiffness: k > 0, scalar or (m,) [N / m^eta].
        exponent: eta >= 1; a float or a tuple is static, an array is differentiable.

    Returns:
        `Bistiffness` with restitution 1.

    Raises:
        ValueError: a stiffness that is not positive, an exponent below 1.

    >>> import jimpact as ji
    >>> import jax.numpy as jnp
    >>> float(ji.PowerLaw(2.0, 1.5).force(jnp.array(4.0), jnp.array(0.0)))
    16.0
    """
    return Bistiffness(stiffness, exponent)


def Hertz(stiffness: Any) -> Bistiffness:
    """Hertz contact `F = k x^1.5`, k in [N / m^1.5] (see `ji.theory.hertz_stiffness`).

    Args:
        stiffness: k > 0, scalar or (m,) [N / m^1.5].

    Returns:
        `Bistiffness` with exponent 1.5 and restitution 1.

    Raises:
        ValueError: a stiffness that is not positive.

    >>> import jimpact as ji
    >>> float(ji.Hertz(2.0).exponent)
    1.5
    """
    return Bistiffness(stiffness, 1.5)


def LinearSpring(stiffness: Any) -> Bistiffness:
    """Linear spring `F = k x`, k in [N/m].

    Args:
        stiffness: k > 0, scalar or (m,) [N/m].

    Returns:
        `Bistiffness` with exponent 1 and restitution 1.

    Raises:
        ValueError: a stiffness that is not positive.

    >>> import jimpact as ji
    >>> float(ji.LinearSpring(2.0).exponent)
    1.0
    """
    return Bistiffness(stiffness, 1.0)


class KelvinVoigt(Force):
    """Spring and damper in parallel: `F = k x + c x'`, cut at 0.

    Args:
        stiffness: k > 0 [N/m].
        damping: c >= 0 [N s/m].

    Its force jumps to c x' when the contact closes.

    >>> import jax.numpy as jnp
    >>> import jimpact as ji
    >>> float(ji.KelvinVoigt(2.0, 0.5).force(jnp.array(1.0), jnp.array(-1.0)))
    1.5
    """

    slackens: ClassVar[bool] = True

    stiffness: Values = parameter(low=0.0, open_low=True, log=True)
    damping: Values = parameter(low=0.0)

    def damping_scale(self, mass: jax.Array, speed: jax.Array) -> jax.Array:
        """Critical damping [N s/m]."""
        return 2 * jnp.sqrt(self.stiffness * mass)

    def pair_restitution(self, mass: jax.Array, speed: jax.Array) -> jax.Array:
        """e of the damped spring with `zeta = c / (2 sqrt(k m))`, at every speed."""
        zeta = self.damping / (2 * jnp.sqrt(self.stiffness * mass))
        return _damped_spring(zeta) + jnp.zeros_like(speed)

    def force(self, x: jax.Array, rate: jax.Array) -> jax.Array:
        """`k x + c x'`."""
        return self.stiffness * x + self.damping * rate


class HuntCrossley(Force):
    """Damping that grows with the indentation: `F = k x^eta (1 + d x')`, cut at 0.

    Args:
        stiffness: k > 0 [N / m^eta].
        damping: d >= 0 [s/m].
        exponent: eta >= 1, a float.

    Source: Hunt and Crossley (1975).

    >>> import jax.numpy as jnp
    >>> import jimpact as ji
    >>> float(ji.HuntCrossley(2.0, 0.5).force(jnp.array(1.0), jnp.array(0.1)))
    2.1
    """

    slackens: ClassVar[bool] = True

    stiffness: Values = parameter(low=0.0, open_low=True, log=True)
    damping: Values = parameter(low=0.0)
    exponent: StaticOrValues = parameter(
        low=1.0, static_numbers=True, searched_high=LARGEST_EXPONENT, default=1.5
    )

    def damping_scale(self, mass: jax.Array, speed: jax.Array) -> jax.Array:
        """`1 / v` [s/m]."""
        return 1 / speed

    def force(self, x: jax.Array, rate: jax.Array) -> jax.Array:
        """Force `k x^eta (1 + d x')` (m,) [N], 0 at x <= 0."""
        positive = x > 0
        eta = jnp.asarray(self.exponent, x.dtype)
        power = jnp.where(positive, jnp.where(positive, x, 1.0) ** eta, 0.0)
        return self.stiffness * power * (1 + self.damping * rate)

    def onset(self, x: jax.Array, rate: jax.Array) -> jax.Array:
        """`1 + d x'`: where the indentation is 0 the force ends by itself."""
        return 1 + self.damping * rate + 0.0 * x


class KuwabaraKono(Force):
    """Viscoelastic Hertz spheres: `F = k (x^1.5 + 1.5 A sqrt(x) x')`, cut at 0.

    Args:
        stiffness: k > 0 [N / m^1.5].
        damping: A >= 0 [s], the dissipative time.

    Source: Kuwabara and Kono (1987); Brilliantov, Spahn, Hertzsch and Poeschel (1996).

    >>> import jax.numpy as jnp
    >>> import jimpact as ji
    >>> float(ji.KuwabaraKono(2.0, 0.5).force(jnp.array(1.0), jnp.array(1.0)))
    3.5
    """

    slackens: ClassVar[bool] = True

    stiffness: Values = parameter(low=0.0, open_low=True, log=True)
    damping: Values = parameter(low=0.0)

    def damping_scale(self, mass: jax.Array, speed: jax.Array) -> jax.Array:
        """About the time of an impact, `(m^2 / (k^2 v))^(1/5)` [s]."""
        return (mass**2 / (self.stiffness**2 * speed)) ** 0.2

    def force(self, x: jax.Array, rate: jax.Array) -> jax.Array:
        """`k sqrt(x) (x + 1.5 A x')`."""
        positive = x > 0
        root = jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)
        return self.stiffness * root * (x + 1.5 * self.damping * rate)

    def onset(self, x: jax.Array, rate: jax.Array) -> jax.Array:
        """`k (x + 1.5 A x') sqrt(x_1)`: without the root, whose slope at 0 is
        infinite.
        """
        return self.stiffness * (x + 1.5 * self.damping * rate)


class UserForce(Force):
    """A force of your own: `function(x, rate, parameters)`, for arrays (m,); cut at 0.

    Args:
        function: smooth for x >= 0; it must push at x > 0, rate = 0. Where F(0) > 0 the
            contact ends at x = 0 with that force. Contacts that touch at rest can then
            take any force up to F(0) without motion; this is not resolved (status
            `max_steps`, or slopes that are NaN).
        parameters: any pytree; its arrays are differentiable. `calibrate` finds the
            entry 'damping' of a dict.

    >>> import jimpact as ji
    >>> soft = ji.UserForce(lambda x, rate, k: k * x * (1 + x), 3.0)
    >>> out = ji.impact(ji.Compliant(soft), ji.chain([1.0, 1.0]), [1.0, 0.0])
    >>> [round(float(v), 6) for v in out.velocity]
    [0.0, 1.0]
    """

    slackens: ClassVar[bool] = True

    function: Callable[[jax.Array, jax.Array, Any], jax.Array] = eqx.field(static=True)
    parameters: Any

    def __init__(self, function: Callable[..., jax.Array], parameters: Any = None):
        check_function("function", function)
        self.function = function
        self.parameters = jax.tree.map(
            lambda leaf: as_float_array("parameters", leaf), parameters
        )

    def damping_scale(self, mass: jax.Array, speed: jax.Array) -> jax.Array | None:
        """The size of the entry 'damping' of `parameters`, if they are a dict with
        one.
        """
        if not isinstance(self.parameters, dict) or "damping" not in self.parameters:
            return None
        return jnp.abs(self.parameters["damping"])

    def with_damping(self, damping: jax.Array) -> "UserForce":
        """The force with another entry 'damping' of its parameters."""
        return UserForce(self.function, self.parameters | {"damping": damping})

    def force(self, x: jax.Array, rate: jax.Array) -> jax.Array:
        """`function(x, rate, parameters)`."""
        return self.function(x, rate, self.parameters)


def _damped_spring(zeta: jax.Array) -> jax.Array:
    """e of the force `k x + c x'`, cut where it would pull, by the damping ratio zeta.

    Equation: `log e = -2 zeta Q`, `Q = arccos(zeta) / sqrt(1 - zeta^2)` for zeta < 1,
    `arcosh(zeta) / sqrt(zeta^2 - 1)` above; about 1, with y = 1 - zeta,
    `Q = 1 + y/3 (1 + 2 y/5 (1 + 3 y/7 (1 + ...)))`.

    Source: Schwager and Poeschel (2007), (17)-(19).
    """
    near = jnp.abs(zeta - 1) < _CRITICAL
    away = jnp.where(near, 0.5, zeta)  # any harmless value
    under = away < 1
    z = jnp.where(under, away, 0.5)
    root = jnp.sqrt(1 - z**2)
    underdamped = jnp.arctan2(root, z) / root  # Q
    z = jnp.where(under, 2.0, away)
    root = jnp.sqrt(z**2 - 1)
    overdamped = jnp.log(z + root) / root  # Q
    series = jnp.ones_like(zeta)
    y = jnp.where(near, 1 - zeta, 0.0)
    for n in range(_CRITICAL_TERMS, 0, -1):
        series = 1 + n / (2 * n + 1) * y * series
    quotient = jnp.where(near, series, jnp.where(under, underdamped, overdamped))
    return jnp.exp(-2 * zeta * quotient)
