"""The LZB impact in units of its own: results do not depend on the user's unit system.

With Q the largest normalized approach velocity (or stored energy) of the impact, contact j has

    x_ref,j = ((eta_j + 1) Q^2 / (2 k_j))^(1 / (eta_j + 1)),   t_ref,j = x_ref,j / (Q sqrt(W_jj))

and omega_j = T / t_ref,j with T the smallest t_ref: the flow of `numerics/flow.py`.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jimpact.numerics import impulse_form, stepper, windows
from jimpact.numerics.contacts import along_contacts, any_of
from jimpact.numerics.flow import Flow, Viscous, apply, step
from jimpact.numerics.powers import Exponent, root_order
from jimpact.numerics.propagator import propagate
from jimpact.numerics.sensitivity import both_modes
from jimpact.numerics.steps import FINEST, Carry, Control, patience
from jimpact.solvers.tridiagonal import Symmetric, Tridiagonal, diagonal, scaled
from jimpact.status import CODE

METHODS = ("time", "propagator", "impulse")
# Derivatives are one or two digits worse than values at the same tolerance; at order 8 two digits
# more cost a third more steps.
GRADIENT_TIGHTENING = 0.01
RIDGE = 64  # eps on the diagonal of G: redundant contacts are singular, the remainder is tiny
DENSE_IN_BATCHES = 4  # contacts
QUIET = 2.0  # tolerances, of a contact at rest once the rest of its bounces is neglected
# Contacts so many times slower than the fastest see as many of its periods, whose errors add up.
WIDE_SPREAD = 5.0
ENDLESS = 3  # a contact that re-closed so often and ends at rest was closing without end


class Inputs(NamedTuple):
    """What the dimensionless outcome depends on; contacts are the first axis of all of it.

    `coupling` holds the entries beside the diagonal of G. What is perturbed costs a tangent an
    entry: a common restitution or exponent stays one entry, and energies that are not perturbed
    are kept instead of the indentations they make.
    """

    coupling: jax.Array
    omega: jax.Array
    restitution: jax.Array
    exponent: jax.Array | None
    gamma: jax.Array
    energy: jax.Array  # x^(eta + 1) of contacts loaded beforehand
    gap: jax.Array | None  # in units of the indentation
    tolerance: jax.Array


class Units(NamedTuple):
    """Scales back to SI: Q [m/s sqrt(kg)], time [s], `sqrt(W_jj)`, x_ref [m]."""

    velocity: jax.Array
    time: jax.Array
    root: jax.Array
    indentation: jax.Array


def to_dimensionless(
    delassus: Symmetric,
    gamma: jax.Array,
    restitution: jax.Array,
    stiffness: jax.Array,
    exponent: Exponent,
    stored: jax.Array,
    rtol: float,
    gaps: jax.Array | None = None,
) -> tuple[Inputs, Units]:
    """Inputs of the dimensionless problem and the units to return from it."""
    m, dtype = gamma.shape[0], gamma.dtype
    eta = jnp.broadcast_to(jnp.asarray(exponent, dtype), (m,))
    root = jnp.sqrt(diagonal(delassus))
    qn = gamma / root
    approach = jnp.where(gamma < 0, qn, 0.0)
    q = jax.lax.stop_gradient(jnp.sqrt(jnp.max(approach**2 + 2 * stored)))
    x_ref = ((eta + 1) * q**2 / (2 * stiffness)) ** (1 / (eta + 1))
    t_ref = x_ref / (q * root)
    time = jax.lax.stop_gradient(jnp.min(t_ref))
    # tolerance is asked of velocities: where W_jj is large, impulses must be finer
    fastest = jnp.max(jnp.maximum(-gamma, jnp.sqrt(2 * stored) * root))
    weight = jax.lax.stop_gradient(jnp.maximum(1.0, q * root / fastest))
    omega = time / t_ref
    g = scaled(delassus, 1 / root)
    beside = g.off_diagonal if isinstance(g, Tridiagonal) else g[jnp.triu_indices(m, 1)]
    inputs = Inputs(
        coupling=beside,
        omega=omega,
        restitution=jnp.atleast_1d(restitution),
        exponent=jnp.atleast_1d(exponent) if isinstance(exponent, jax.Array) else None,
        gamma=qn / q,
        energy=2 * stored / q**2,
        gap=None if gaps is None else gaps / x_ref,
        # errors of many contacts add up
        tolerance=rtol * min(1.0, 2 / m) * _closeness(omega) / weight,
    )
    return inputs, Units(q, time, root, x_ref)


def _closeness(omega: jax.Array) -> jax.Array:
    """1, or less where some contact is much slower than the fastest."""
    return jax.lax.stop_gradient(jnp.minimum(1.0, WIDE_SPREAD * jnp.min(omega)))


def impulse_step(inputs: Inputs) -> jax.Array:
    """Step of the impulse form: the tolerance itself, whatever the stiffnesses."""
    return jax.lax.stop_gradient(jnp.min(inputs.tolerance / _closeness(inputs.omega)))


def indentation(inputs: Inputs, exponent: Exponent) -> jax.Array:
    """x (m,) before the impact; negative where a gap is open."""
    if inputs.gap is not None:
        return -inputs.gap  # at 0 too: its derivative there is the one-sided one
    loaded = inputs.energy > 0
    energy = jnp.where(loaded, inputs.energy, 1.0)
    eta = along_contacts(jnp.asarray(exponent, energy.dtype), energy)
    return jnp.where(loaded, energy ** (1 / (eta + 1)), 0.0)


def flow_of(inputs: Inputs, exponent: Exponent, chain: bool) -> Flow:
    """The flow of these inputs; `exponent` is the static one where `inputs` hold none."""
    m, batch = inputs.gamma.shape[0], inputs.gamma.shape[1:]
    # the product with a small dense matrix vectorizes better than shifts by one contact
    if chain and not (batch and m <= DENSE_IN_BATCHES):
        coupling: Symmetric = Tridiagonal(jnp.ones_like(inputs.gamma), inputs.coupling)
    else:
        i, j = jnp.triu_indices(m, 1)
        if chain:
            i, j = jnp.arange(m - 1), jnp.arange(1, m)
        upper = jnp.zeros((m, m, *batch), inputs.gamma.dtype).at[i, j].set(inputs.coupling)
        unit = jnp.eye(m, dtype=inputs.gamma.dtype).reshape((m, m) + (1,) * len(batch))
        coupling = unit + upper + jnp.swapaxes(upper, 0, 1)
    eta = exponent if inputs.exponent is None else inputs.exponent
    root = root_order(eta)
    return Flow(coupling, inputs.omega, inputs.restitution, eta, inputs.gap is not None, root)


def control_of(
    inputs: Inputs, max_steps: int, method: str, differentiated: bool = False
) -> Control:
    """How to step; local tolerances are not below rounding."""
    floor = FINEST * float(jnp.finfo(inputs.gamma.dtype).eps)
    tighten = GRADIENT_TIGHTENING if differentiated else 1.0
    tolerance = jnp.maximum(tighten * inputs.tolerance, floor)
    explicit = functools.partial(step, apart=differentiated)
    chosen = propagate if method == "propagator" else explicit
    contacts = inputs.gamma.shape[0]
    return Control(tolerance, max_steps, contacts, chosen, halving=not differentiated)


def solve(
    inputs: Inputs,
    exponent: Exponent,
    chain: bool,
    max_steps: int,
    method: str = "time",
    viscous: Viscous | None = None,
) -> tuple[jax.Array, jax.Array]:
    """Dimensionless impulses and status, differentiable in both modes."""
    static = None if isinstance(exponent, jax.Array) else exponent

    def run(
        both: tuple[Inputs, Viscous | None], differentiated: bool
    ) -> tuple[jax.Array, jax.Array]:
        given, force = both
        flow = flow_of(given, static, chain)._replace(viscous=force)  # type: ignore[arg-type]
        x = indentation(given, flow.exponent)
        if method == "impulse":
            return _walk(flow, given, max_steps)
        control = control_of(given, max_steps, method, differentiated)
        control = control._replace(closed_form=force is None)
        end = windows.run(flow, control, stepper.begin(flow, control, given.gamma, x))
        p, at_rest = settled(flow, given.gamma, given.tolerance, end)
        return p, status_of(end, at_rest)

    # a batch of its own order of axes; a user's force knows but one impact
    columns = method == "time" and viscous is None
    return both_modes(run, columns)((inputs, viscous))


def settled(
    flow: Flow, gamma: jax.Array, tolerance: jax.Array, end: Carry
) -> tuple[jax.Array, jax.Array]:
    """Impulses once endless re-closing has come to its limit, and the contacts left at rest."""
    at_rest = reclosing(end, tolerance)

    def come_to_rest(p: jax.Array) -> jax.Array:
        p = p + plastic_remainder(flow, gamma, p, at_rest)
        # errors of many closings add up: contacts beside them may be left with an approach
        approaching = gamma + apply(flow.coupling, p) < 0
        beside = any_of(at_rest) & _quiet(end, tolerance) & approaching
        return p + plastic_remainder(flow, gamma, p, at_rest | beside)

    p = jax.lax.cond(jnp.any(at_rest), come_to_rest, lambda p: p, end.state.p)
    return p, at_rest


def reclosing(end: Carry, tolerance: jax.Array) -> jax.Array:
    """Contacts (m,) as good as at rest where some re-closed again and again."""
    quiet = _quiet(end, tolerance)
    endless = quiet & (end.closures >= ENDLESS)
    return end.done & (endless | (any_of(endless) & quiet & (end.state.g < 0)))


def _quiet(end: Carry, tolerance: jax.Array) -> jax.Array:
    # no wider than what ended the impact: a ball of a long chain may be as slow as WIDENED allows
    return jnp.abs(end.state.g) <= QUIET * patience(end, end.phase.shape[0]) * tolerance


def status_of(end: Carry, at_rest: jax.Array) -> jax.Array:
    """Status code of a finished or interrupted run."""
    code = jnp.where(any_of(at_rest), CODE["plastic_limit"], CODE["ok"])
    return jnp.where(end.done, code, CODE["max_steps"])[0]


def plastic_remainder(flow: Flow, gamma: jax.Array, p: jax.Array, at_rest: jax.Array) -> jax.Array:
    """Impulses that bring the contacts `at_rest` to exactly gamma+ = 0: the limit they approach."""
    g, none = flow.coupling, jnp.zeros_like(p)
    missing = jnp.where(at_rest, -(gamma + apply(g, p)), none)
    ridge = RIDGE * float(jnp.finfo(p.dtype).eps)
    if isinstance(g, Tridiagonal):
        both = at_rest[1:] & at_rest[:-1]
        off = jnp.where(both, g.off_diagonal, none[1:])
        return Tridiagonal(none + 1 + ridge, off).solve(missing)
    both = at_rest[:, None] & at_rest[None, :]
    unit = jnp.eye(g.shape[0], dtype=g.dtype).reshape(g.shape[:2] + (1,) * (g.ndim - 2))
    matrix = jnp.where(both, g, unit) + ridge * unit
    if g.ndim == 2:
        return jnp.linalg.solve(matrix, missing)
    return jnp.linalg.solve(jnp.moveaxis(matrix, 2, 0), missing.T[..., None])[..., 0].T


def _walk(flow: Flow, given: Inputs, max_steps: int) -> tuple[jax.Array, jax.Array]:
    energy = 0.5 * given.energy
    end = impulse_form.solve(flow, impulse_step(given), max_steps, given.gamma, energy)
    return end.p, jnp.where(impulse_form.at_work(end), CODE["max_steps"], CODE["ok"])
