"""What all ways to integrate the LZB impact have in common: problem, result, row of the table.

All work on the dimensionless flow of `events/contact_flow.py`. In time form, with c_j = 1 in
compression and 1/e_j^2 in expansion, and stored energy x_j^(eta_j + 1) / 2,

    x_j' = -omega_j c_j gamma_j,   p_j' = (eta_j + 1)/2 omega_j x_j^eta_j,   gamma = gamma- + G p

With friction `gamma = gamma- + G p + K_nt p_t`, `u = u- + K_tn p + K_tt p_t`, and tangential forces
regularized below a slip s: `p_t,j' = -mu_j p_j' u_j / sqrt(|u_j|^2 + s_j^2)`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import as_float_array, in_common_dtype
from jimpact.compiling import precise_jit
from jimpact.contact import Contact
from jimpact.events import impact_dynamics
from jimpact.events.contact_flow import power
from jimpact.events.impact_dynamics import Dynamics, ImpactUnits, Sides
from jimpact.impacts import Impact, impact
from jimpact.law import Impulses, Law
from jimpact.laws.lzb import LZB
from jimpact.methods.contenders.impulse_form import Rule, rule_of
from jimpact.scene import Scene
from jimpact.solvers.tangential import per_tangent
from jimpact.status import CODE

UNCOUNTED = -1  # evaluations of a method that does not count them


class MethodResult(NamedTuple):
    """Impulses (m,) [N s], duration () [s] (NaN: not known), field evaluations (), status ().

    With friction also tangential impulses (t,) [N s].
    """

    impulse: jax.Array
    duration: jax.Array
    evaluations: jax.Array
    code: jax.Array
    tangential: jax.Array | None = None


Solve = Callable[[LZB, Scene, Any, Any], MethodResult]


class Method(NamedTuple):
    """A way to integrate an LZB impact.

    `setting` is the kind of number that `solve` takes: 'rtol', a tolerance on velocities relative
    to the largest |v-|; 'step', the time step in units of `time_scale`; or 'impulse step', the
    step in the primary impulse, in units of the impact's momentum. `ladder`: settings from coarse
    to fine. `divides`: by e, which must not be 0. `jax`: `solve(law, scene, velocity, setting)` can
    be jitted, vmapped and differentiated forward, over the setting too; otherwise it takes concrete
    values. `duration_apart`: the duration takes a run of its own. `friction`: has Coulomb friction.
    """

    name: str
    label: str
    setting: str
    ladder: tuple[float, ...]
    solve: Solve
    divides: bool = True
    jax: bool = True
    duration_apart: bool = False
    friction: bool = False

    def supports(self, law: LZB) -> str | None:
        """None, or why it cannot integrate this law."""
        if law.friction is not None and not self.friction:
            return "it has no friction"
        refused = self.divides and np.any(law.restitution == 0)
        return "it divides by e^2, and a restitution is 0" if refused else None


class ScaledImpact(NamedTuple):
    """The dimensionless problem of an impact; `inputs` holds its tolerances."""

    dynamics: Dynamics
    max_steps: int
    happens: jax.Array  # False: nothing approaches or is stored; `inputs` are then a placeholder

    @property
    def inputs(self) -> impact_dynamics.Problem:
        """Arrays (m,) of the contacts."""
        return self.dynamics.problem

    @property
    def units(self) -> ImpactUnits:
        """Scales back to SI."""
        return self.dynamics.units

    @property
    def sides(self) -> Sides | None:
        """The tangential block and mu; None without friction."""
        return self.inputs.sides

    @property
    def x(self) -> jax.Array:
        """Indentations (m,) before the impact."""
        energy, eta = self.inputs.energy, jnp.asarray(self.dynamics.exponent)
        loaded = energy > 0
        return jnp.where(loaded, jnp.where(loaded, energy, 1.0) ** (1 / (eta + 1)), 0.0)

    @property
    def flow(self) -> Rule:
        """G, omega, e and eta of the contacts."""
        return rule_of(self.inputs, self.dynamics.static_exponent, self.dynamics.structure)


def problem(
    law: LZB, scene: Scene, velocity: Any, rtol: Any = 1.0, friction: bool = False
) -> ScaledImpact:
    """The impact in dimensionless form, without open contacts; `friction`: it may have some."""
    if law.friction is not None and not friction:
        raise TypeError("Argument `law` must have no friction: this method has none.")
    v = as_float_array("velocity", velocity)
    law, scene, v = in_common_dtype(law, scene, v)
    contact = law.contact(scene, v)
    gamma, happens = contact.gap_velocity, contact.happens
    harmless = jnp.where(happens, gamma, -jnp.ones_like(gamma))
    contact = eqx.tree_at(lambda c: c.gap_velocity, contact, harmless)
    return ScaledImpact(law.dynamics(contact, jnp.asarray(rtol, v.dtype)), law.max_steps, happens)


def in_si(
    scaled: ScaledImpact,
    p: jax.Array,
    t: jax.Array,
    evaluations: jax.Array,
    code: jax.Array,
    side: jax.Array | None = None,
) -> MethodResult:
    """The result in SI units, nothing where nothing happens, `not_finite` where it is not.

    `side`: tangential impulses (t,), where the impact has friction.
    """
    momentum, tangential = scaled.units.momentum, None
    impulse = jnp.where(scaled.happens, p * momentum, 0.0)
    finite = jnp.all(jnp.isfinite(impulse))
    if scaled.sides is not None and side is not None:
        tangential = jnp.where(scaled.happens, side * per_tangent(momentum, side), 0.0)
        finite = finite & jnp.all(jnp.isfinite(tangential))
    code = jnp.where(scaled.happens, code, CODE["ok"])
    return MethodResult(
        impulse=impulse,
        duration=jnp.where(scaled.happens, t * scaled.units.time, 0.0),
        evaluations=jnp.asarray(evaluations, jnp.int32),
        code=jnp.where(finite, code, CODE["not_finite"]).astype(jnp.int32),
        tangential=tangential,
    )


def time_scale(law: LZB, scene: Scene, velocity: Any) -> jax.Array:
    """Time [s] that 'step' settings are parts of: that of the fastest contact alone.

    Equation: `min_j x_ref,j / (Q sqrt(W_jj))` (see `events/impact_dynamics.py`); a contact alone
    with exponent 1 and e = 1 lasts pi of its own.

    >>> import jimpact as ji
    >>> from jimpact.methods.contenders import time_scale
    >>> float(time_scale(ji.LZB(1.0, 4.0, exponent=1.0), ji.chain([1.0], wall=True), [1.0]))
    0.5
    """
    return problem(law, scene, velocity, friction=True).units.time


class _KnownImpulses(Law):
    """A law whose impulses are known beforehand."""

    known: jax.Array
    tangential: jax.Array | None
    code: jax.Array
    initial_energy: jax.Array

    def impulses(self, contact: Contact) -> Impulses:
        """These impulses, whatever the contacts are."""
        return Impulses(self.known, self.tangential, self.code)


def outcome(law: LZB, scene: Scene, velocity: Any, result: MethodResult) -> Impact:
    """Velocities, energy and full status (`impact`'s own checks included) of a method's result."""
    known = (result.impulse, result.tangential, result.code, law.initial_energy)
    return impact(_KnownImpulses(*known), scene, velocity)


def time_form(
    flow: Rule, gamma: jax.Array, x: jax.Array, p: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Rates `(x', p')` at indentations x and impulses p; `gamma`: gap velocities before."""
    now = gamma + flow.coupling @ p
    opening = 1 / flow.restitution**2
    closing = -flow.omega * jnp.where(now > 0, opening, 1.0) * now
    factor = (jnp.asarray(flow.exponent, x.dtype) + 1) / 2
    return closing, factor * flow.omega * power(x, flow.exponent)


def pull(sides: Sides | None, side: jax.Array) -> jax.Array | float:
    """What tangential impulses (t,) change of the gap velocities (m,)."""
    return 0.0 if sides is None else sides.block.normal_tangent @ side


def slip(sides: Sides, p: jax.Array, side: jax.Array) -> jax.Array:
    """u (t,) after impulses p (m,) and tangential ones (t,)."""
    return sides.block.slip + sides.block.normal_tangent.T @ p + sides.block.tangent @ side


def regularized(sides: Sides, force: jax.Array, u: jax.Array, slow: jax.Array) -> jax.Array:
    """Friction forces (t,) at forces (m,) and slip (t,), regularized below the slip `slow` (m,)."""
    each = u.reshape(len(force), -1)
    square = jnp.sum(each**2, axis=1) + slow**2
    moves = square > 0
    size = jnp.sqrt(jnp.where(moves, square, 1.0))
    drag = jnp.where(moves, sides.friction * force / size, 0.0)
    return -(drag[:, None] * each).ravel()


def stopped_within(sides: Sides, force: jax.Array, step: jax.Array) -> jax.Array:
    """Slip (m,) that full friction stops within a step: slower slip needs a smaller force.

    `mu F step |K_tt|`, with the largest absolute row sum, which no eigenvalue exceeds: friction
    regularized below it is stable for whatever step.
    """
    stiffest = jnp.max(jnp.sum(jnp.abs(sides.block.tangent), axis=1))
    return sides.friction * force * step * stiffest


setup = precise_jit(problem)
