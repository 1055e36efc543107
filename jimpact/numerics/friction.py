"""The LZB impact with Coulomb friction, dimensionless: its inputs, its outcome."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jimpact.numerics import friction_single, friction_stepper as stepper
from jimpact.numerics.contacts import any_of
from jimpact.numerics.dimensionless import (
    ENDLESS,
    GRADIENT_TIGHTENING,
    QUIET,
    Inputs,
    Units,
    flow_of,
    indentation,
)
from jimpact.numerics.friction_flow import Frictional
from jimpact.numerics.powers import Exponent
from jimpact.numerics.sensitivity import both_modes
from jimpact.numerics.steps import FINEST
from jimpact.status import CODE

# Passes a contact after which an impact is given up: wedged by friction, contacts may vibrate
# for very long while their velocities fall to 0.
PASSES = 2000


class Tangential(NamedTuple):
    """What friction adds to `Inputs`: K_nt (m t,), K_tt above and on its diagonal, mu, u-."""

    across: jax.Array
    along: jax.Array
    friction: jax.Array
    slip: jax.Array


def to_dimensionless(
    across: jax.Array, along: jax.Array, friction: jax.Array, slip: jax.Array, units: Units
) -> Tangential:
    """Blocks W_nt (m, t), W_tt (t, t) and slip velocities (t,) in the units of the normals."""
    m, t = across.shape
    root = jnp.repeat(units.root, t // m)
    i, j = jnp.triu_indices(t)
    return Tangential(
        across=(across / (units.root[:, None] * root[None, :])).reshape(-1),
        along=(along / (root[:, None] * root[None, :]))[i, j],
        friction=jnp.atleast_1d(friction),
        slip=slip / (root * units.velocity),
    )


def solve(
    inputs: Inputs, tangential: Tangential, exponent: Exponent, max_steps: int
) -> tuple[tuple[jax.Array, jax.Array], jax.Array]:
    """Dimensionless impulses (p, p_t) and status, differentiable in both modes."""
    if inputs.gamma.shape == tangential.slip.shape == (1,):
        return _alone(inputs, tangential)
    static = None if isinstance(exponent, jax.Array) else exponent

    def run(
        both: tuple[Inputs, Tangential], differentiated: bool
    ) -> tuple[tuple[jax.Array, jax.Array], jax.Array]:
        given, side = both
        flow = _flow_of(given, side, static)  # type: ignore[arg-type]
        floor = FINEST * float(jnp.finfo(given.gamma.dtype).eps)
        tighten = GRADIENT_TIGHTENING if differentiated else 1.0
        tolerance = jnp.maximum(tighten * given.tolerance, floor)
        x = indentation(given, flow.normal.exponent)
        start = stepper.begin(flow, tolerance, given.gamma, side.slip, x)
        most = min(max_steps, PASSES * len(given.gamma))
        end = stepper.run(flow, tolerance, most, start)
        quiet = jnp.abs(end.state.g) <= QUIET * given.tolerance
        endless = any_of((end.closures >= ENDLESS) & quiet)
        code = jnp.where(endless, CODE["plastic_limit"], CODE["ok"])
        code = jnp.where(end.done, code, CODE["max_steps"])[0]
        return (end.state.p, end.state.side), code

    return both_modes(run, columns=True)((inputs, tangential))


def _alone(inputs: Inputs, tangential: Tangential) -> tuple[tuple[jax.Array, jax.Array], jax.Array]:
    """A single planar contact."""
    contact = friction_single.Contact(
        tangential.across, tangential.along, tangential.friction, inputs.restitution
    )
    p, side, done = friction_single.solve(
        contact, inputs.gamma, tangential.slip, 0.5 * inputs.energy
    )
    return (p, side), jnp.where(done, CODE["ok"], CODE["max_steps"])[0]


def _flow_of(inputs: Inputs, tangential: Tangential, exponent: Exponent) -> Frictional:
    normal = flow_of(inputs, exponent, False)
    m, t, batch = inputs.gamma.shape[0], tangential.slip.shape[0], inputs.gamma.shape[1:]
    i, j = jnp.triu_indices(t)
    along = jnp.zeros((t, t, *batch), inputs.gamma.dtype).at[i, j].set(tangential.along)
    unit = jnp.eye(t, dtype=bool).reshape((t, t) + (1,) * len(batch))
    along = along + jnp.where(unit, 0.0, jnp.swapaxes(along, 0, 1))
    across = tangential.across.reshape(m, t, *batch)
    return Frictional(normal, across, along, tangential.friction)
