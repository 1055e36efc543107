"""Restitution that depends on the speed of the approach: an option of every law that
has an e.
"""

from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from jimpact.core.contact import Contact
from jimpact.core.law import (
    Impulses,
    Law,
    OptionalValues,
    StaticNumbers,
    Values,
    forwards_to_law,
    free_parameters_of,
    option,
    parameter,
    with_parameter,
)
from jimpact.core.registry import REGISTRY
from jimpact.events.impact_dynamics import Dynamics
from jimpact.numerics.tridiagonal import as_matrix, diagonal
from jimpact.tools.checks import as_float_array, check_kind, check_values
from jimpact.tools.compiling import full_precision
from jimpact.tools.loops import while_loop
from jimpact.tools.masks import quotient
from jimpact.tools.precision import precision

# Speeds [m/s] at which a user's function of the speed is tried once.
TRIED = (0.1, 1.0, 10.0)


def _curve(value: Any) -> Any:
    """The argument `curve`: None, a function, or a table as two tuples, speeds [m/s]
    and values.

    Raise a ValueError for a table of other shapes, with negative entries or speeds that
    do not rise.
    """
    if value is None or callable(value):
        return value
    columns = [np.asarray(as_float_array("curve", x), float) for x in value]
    shapes = [x.shape for x in columns]
    is_table = len(columns) == 2 and len(set(shapes)) == 1 and columns[0].ndim == 1
    if not is_table or len(columns[0]) < 2:
        raise ValueError(
            f"Argument `curve` must be a function of the speed, or (speeds, values) of "
            f"two or more rows, but has shapes {shapes}."
        )
    speeds, values = columns
    check_values("curve", speeds, low=0.0)
    check_values("curve", values, low=0.0)
    if not (np.diff(speeds) > 0).all():
        raise ValueError(
            f"Argument `curve` must have speeds that rise, but has {speeds.tolist()}."
        )
    return StaticNumbers(speeds.tolist()), StaticNumbers(values.tolist())


@forwards_to_law
class VelocityDependent(Law):
    """A law whose restitution falls with speed, and is 1 below the yield speed.

    Equation: `e_j(v)^2 = y^2 + (1 - y^2) f^2`, `f = min(1, e_j (v / v_ref)^-k)`,
    `y = min(1, v_y / v)`, and the law acts with these e_j. With k = 0 the energy up to
    that of the yield speed comes back whole, and e_j^2 of what exceeds it; with v_y = 0
    it is a power law (k about 1/4 for metals well above their yield, 1/5 of 1 - e for
    viscoelastic spheres). v is the fastest approach of all contacts that contact j is
    coupled with: one at rest, which an impact elsewhere loads, is as lossy as the
    others. With a `curve` c, f = min(1, e_j c(v)): of a law with e = 1 it is e itself.

    Args:
        law: with `restitution` e_j, scalar or (m,): its value at `reference_speed`.
        speed_exponent: k in [-1, 1], scalar or (m,); None: no power law.
        yield_speed: v_y >= 0, scalar or (m,) [m/s]; None: no yield.
        reference_speed: v_ref > 0 [m/s], where e_j holds; cannot be fitted together
            with e_j and k.
        curve: in the place of the power law: a table (speeds [m/s], values), between
            whose rows c is linear, and constant beyond its ends; or a function of an
            array of speeds, in jnp, the same object in each call, or all compiles anew.
            It is no parameter: a fit scales it by e_j.

    Status: that of the law. Derivatives: forward and reverse; one-sided where e reaches
    1 and where two contacts approach equally fast. In `yield_speed` at 0 the slope is
    0: start a fit above.

    Source: Brogliato, Nonsmooth Mechanics (2016), section 6.3.1 (impacts below the
    speed of plastification lose nothing); Johnson, Contact Mechanics (1985), 11.5 (k =
    1/4).

    >>> import jimpact as ji
    >>> law = ji.VelocityDependent(
    ...     ji.Newton(0.5), speed_exponent=0.25, yield_speed=0.01
    ... )
    >>> [round(float(e), 4) for e in law.restitution_at([0.005, 1.0, 16.0])]
    [1.0, 0.5001, 0.25]
    >>> pair = ji.chain([1.0, 1.0])
    >>> [
    ...     round(float(ji.impact(law, pair, [v, 0.0]).velocity[1] / v), 4)
    ...     for v in (0.005, 16.0)
    ... ]
    [1.0, 0.625]
    >>> table = ji.VelocityDependent(
    ...     ji.Newton(1.0), curve=([0.5, 1.0, 4.0], [0.9, 0.8, 0.5])
    ... )
    >>> [round(float(e), 2) for e in table.restitution_at([0.1, 0.75, 2.5])]
    [0.9, 0.85, 0.65]
    """

    joins_step: ClassVar[bool] = False  # its e is not a field

    law: Law
    speed_exponent: OptionalValues = parameter(
        low=-1.0, high=1.0, default=None, kw_only=True
    )
    yield_speed: OptionalValues = parameter(low=0.0, default=None, kw_only=True)
    reference_speed: Values = parameter(
        low=0.0, open_low=True, default=1.0, kw_only=True
    )
    curve: Any = option(None, converter=_curve)

    def __check_init__(self) -> None:
        """Raise a TypeError for a law without e, or that depends on the velocity
        already.
        """
        check_kind("law", self.law, Law)
        if isinstance(self.law, VelocityDependent):
            raise TypeError("Argument `law` must not depend on the velocity already.")
        restitution = free_parameters_of(self.law).get("restitution")
        if restitution is None or np.ndim(restitution.value) > 1:
            raise TypeError(
                f"Argument `law` must have `restitution`, one number or one per "
                f"contact, but is {type(self.law).__name__}."
            )
        if self.curve is not None and self.speed_exponent is not None:
            raise ValueError(
                "Arguments `curve` and `speed_exponent` must not both be given."
            )
        if callable(self.curve):
            _check_function(self.curve)

    @property
    def friction(self) -> jax.Array | None:
        """Coulomb's mu of the law; None: no friction."""
        return getattr(self.law, "friction", None)

    def restitution_at(self, speed: Any) -> jax.Array:
        """e at a `speed` of approach [m/s], of its shape; an entry each contact where e
        is (m,).
        """
        return self._at(as_float_array("speed", speed))

    def _at(self, v: jax.Array) -> jax.Array:
        """e (m,) at speeds v [m/s]: `e^2 = y^2 + (1 - y^2) f^2`, y and f as of the
        class.
        """
        e = free_parameters_of(self.law)["restitution"].value
        moving = v > 0
        # at rest e is that of the law
        safe = jnp.where(moving, v, self.reference_speed)
        # comparisons, as min() of two equal numbers would halve the derivative
        largest = jnp.where(e > 1, e, 1.0)  # of f: 1, or an e above 1 itself
        f = e * jnp.ones_like(v)
        if self.speed_exponent is not None:
            ratio = safe / self.reference_speed
            falls = e * ratio**-self.speed_exponent <= largest
            falling = e * jnp.where(falls, ratio, 1.0) ** -self.speed_exponent
            f = jnp.where(falls, falling, largest)
        elif self.curve is not None:
            f = e * self._curve_at(safe)
            f = jnp.where(f <= largest, f, largest)
        if self.yield_speed is None:
            return f
        yields = safe >= self.yield_speed
        y = quotient(self.yield_speed, safe, where=yields, otherwise=1.0)
        smooth = moving & (y > 0)  # the root has no slope at 0
        square = jnp.where(smooth, y**2 + (1 - y**2) * f**2, 1.0)
        return jnp.where(smooth, jnp.sqrt(square), f)

    def _curve_at(self, v: jax.Array) -> jax.Array:
        """Values of the curve at speeds v [m/s]; a table is linear between its rows."""
        if callable(self.curve):
            return jnp.asarray(self.curve(v), v.dtype)
        speeds, values = self.curve
        table = jnp.asarray(speeds, v.dtype), jnp.asarray(values, v.dtype)
        return jnp.interp(v, *table)

    @full_precision
    def impulses(self, contact: Contact) -> Impulses:
        """Impulses of the law with e at the speeds of approach of these contacts."""
        return self._law_at(contact).impulses(contact)

    def dynamics(self, contact: Contact) -> Dynamics:
        """Dynamics of the law with e at the speeds of approach of these contacts."""
        return self._law_at(contact).dynamics(contact)

    def _law_at(self, contact: Contact) -> Law:
        """The law with the restitution e (m,) at the speeds of approach of these
        contacts.
        """
        restitution = self._at(approach_speed(contact))
        law: Law = with_parameter(self.law, "restitution", restitution)
        return law


def _check_function(curve: Callable[[Any], Any]) -> None:
    """Raise a ValueError for a function of other shapes, or negative, at the speeds
    `TRIED`.
    """
    speeds = jnp.asarray(TRIED)
    values = as_float_array("curve", curve(speeds))
    if values.shape != speeds.shape:
        raise ValueError(
            f"Argument `curve` must give an array of the shape of the speeds, "
            f"{speeds.shape}, but gives {values.shape}."
        )
    check_values("curve", values, low=0.0)


def approach_speed(contact: Contact) -> jax.Array:
    """Largest approach speed (m,) [m/s] among the contacts that each contact is coupled
    with.

    Equation: `v_j = max(max(-gamma_i, 0))` over contacts i that a path of entries
    `W_ab != 0` joins to j. Differentiable: the fastest contact is found first, on
    constants.

    >>> import jimpact as ji
    >>> from jimpact.laws.velocity_dependent import approach_speed
    >>> approach_speed(ji.Contact([[2.0, -1.0], [-1.0, 2.0]], [-0.5, 0.0])).tolist()
    [0.5, 0.5]
    """
    speed = jnp.maximum(-contact.gap_velocity, 0.0)
    w = as_matrix(contact.delassus)
    root = jnp.sqrt(diagonal(contact.delassus))
    rounding = precision(speed.dtype).accumulated  # of normals and of M^-1
    coupled = jnp.abs(w) > rounding * root[:, None] * root[None, :]
    coupled, constant = jax.lax.stop_gradient((coupled, speed))

    def passed_on(state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        """Fastest contact (m,) known to each one or to its neighbours; True () if one
        changed.
        """
        fastest, _ = state
        around = jnp.where(coupled, constant[fastest][None, :], -1.0)
        other = fastest[jnp.argmax(around, axis=1)]
        faster = constant[other] > constant[fastest]
        return jnp.where(faster, other, fastest), jnp.any(faster)

    def changes(state: tuple[jax.Array, jax.Array]) -> jax.Array:
        """True () if a contact has learned of a faster one."""
        _, changed = state
        return changed

    first = jnp.arange(len(speed)), jnp.asarray(True)
    fastest, _ = while_loop(changes, passed_on, first)
    return speed[fastest]


def make_velocity_dependent(
    base: str,
    restitution: Any,
    speed_exponent: Any = None,
    yield_speed: Any = None,
    reference_speed: Any = 1.0,
    curve: Any = None,
    stiffness: Any = None,
    exponent: Any = None,
    friction: Any = None,
    tangential_stiffness: Any = None,
) -> VelocityDependent:
    """`VelocityDependent` from plain parameters, as a study gives them; `base` is a
    law's name.

    Raise a ValueError for a base without a restitution, or that lacks a parameter which
    is not None.
    """
    if base not in REGISTRY or "restitution" not in REGISTRY[base].arguments:
        known = ", ".join(
            name for name, row in REGISTRY.items() if "restitution" in row.arguments
        )
        raise ValueError(
            f"Argument `base` must be one of {known}, but has value {base!r}."
        )
    row = REGISTRY[base]
    values = {
        "restitution": restitution,
        "stiffness": stiffness,
        "exponent": exponent,
        "friction": friction,
        "tangential_stiffness": tangential_stiffness,
    }
    parameters = {name: value for name, value in values.items() if value is not None}
    for name in parameters:
        if name not in row.arguments:
            raise ValueError(
                f"Argument `{name}` must not be given: {base} does not have it."
            )
    return VelocityDependent(
        row.build(**parameters),
        speed_exponent=speed_exponent,
        yield_speed=yield_speed,
        reference_speed=reference_speed,
        curve=curve,
    )
