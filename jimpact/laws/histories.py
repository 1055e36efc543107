"""What happens during an impact: forces, indentations, energies and velocities over its time."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from jimpact._checks import as_whole, check_values, in_common_dtype
from jimpact.compiling import quick_jit
from jimpact.events.batches import in_columns
from jimpact.events.contact_flow import ContactStates
from jimpact.events.impact_dynamics import ImpulseProgram
from jimpact.events.impact_history import Samples
from jimpact.law import Law, check_law
from jimpact.laws.compliant import Compliant
from jimpact.laws.forces import Bistiffness
from jimpact.laws.lzb import LZB
from jimpact.scene import Scene, as_velocity, velocity_change


class History(eqx.Module):
    """Histories over impact time: rows are samples; SI units.

    `time` (s,), `force`, `indentation`, `energy`, `impulse`, `gap_velocity` (s, m), `velocity`
    (s, n); with friction `tangential_force`, `tangential_impulse` and `slip` (s, t), else t = 0;
    `duration` (), `maximum_force` (m,) and `status` of the whole impact.
    `indentation` is the effective one, `E = k x^(eta + 1) / (eta + 1)`, of the loading curve.
    """

    time: jax.Array
    force: jax.Array
    indentation: jax.Array
    energy: jax.Array
    impulse: jax.Array
    gap_velocity: jax.Array
    velocity: jax.Array
    tangential_force: jax.Array
    tangential_impulse: jax.Array
    slip: jax.Array
    duration: jax.Array
    maximum_force: jax.Array
    status: jax.Array


def history(law: Law, scene: Scene, velocity: Any, samples: int = 200) -> History:
    """Sample the impact of an `LZB` or `Compliant` law at equal intervals of impact time.

    Equation: `gamma' = W F`, `p' = F`, `F_j = k_j x_j^eta_j`; between the steps of the
    integrator a sample is one more step of the same method. (With friction in space intervals are
    equal only nearly: `time` tells.)

    Args:
        law: an `LZB` with method 'time', or a `Compliant` with a power law or a `Bistiffness`
            (gaps included: `indentation` is 0 while a contact is open); stiffness in SI units
            makes time and force SI.
        scene: n coordinates, m contacts.
        velocity: v- (n,) [m/s].
        samples: number of rows, first before and last after the impact.

    Returns:
        `History`: rows are samples; `status` () as of `impact`.

    Differentiable in both modes: `duration` and `maximum_force` too.

    Raises:
        TypeError: a law without impact dynamics. ValueError: what `impact` refuses.

    >>> import jimpact as ji
    >>> h = ji.history(ji.LZB(1.0, 2.0, exponent=1.0), ji.chain([1.0], wall=True), [1.0])
    >>> round(float(h.duration), 3), round(float(h.maximum_force[0]), 3)  # pi/sqrt(k), sqrt(k)
    (2.221, 1.414)
    """
    compliant = isinstance(law, Compliant) and isinstance(law.force, Bistiffness)
    if not compliant and not (isinstance(law, LZB) and law.method == "time"):
        raise TypeError(
            "Argument `law` must be an LZB law with method='time' or a Compliant law with a "
            "Bistiffness force (others have no impact dynamics that are sampled), "
            f"but is {law!r}."
        )
    as_whole("samples", samples, 2)
    v = as_velocity(scene, velocity)
    check_values("velocity", v)
    law, scene, v = in_common_dtype(law, scene, v)
    check_law(law, scene, v.dtype)
    return _history(law, scene, v, samples)  # type: ignore[arg-type]


@quick_jit
def _history(law: LZB | Compliant, scene: Scene, v: jax.Array, samples: int) -> History:
    contact = law.contact(scene, v)
    happens, gamma = contact.happens, contact.gap_velocity
    harmless = jnp.where(happens, gamma, -jnp.ones_like(gamma))
    given = law.dynamics(eqx.tree_at(lambda c: c.gap_velocity, contact, harmless))
    leaves, tree = given.columns()
    outcome = ImpulseProgram(
        tree, given.static_exponent, given.chain, law.max_steps, given.tangents, whole=True
    )
    time, energy, *rest = in_columns(Samples(outcome, samples), *leaves)
    *rows, maximum, code = (x[..., 0] for x in rest)
    seen, units = ContactStates(*rows), given.units
    force, side = units.momentum / units.time, jnp.repeat(units.root, given.tangents // len(gamma))

    def live(x: jax.Array, before: Any = 0.0) -> jax.Array:
        """Nothing happens: as before."""
        return jnp.where(happens, x, before)

    impulse = live(seen.impulse * units.momentum[None])
    tangential = live(seen.tangential_impulse * (units.velocity / side)[None])
    change = jax.vmap(lambda p, q: velocity_change(scene, p, q if given.tangents else None))
    none = jnp.zeros(0, v.dtype)
    before = none if contact.slip is None or not given.tangents else contact.slip
    return History(
        time=live(time[:, 0, 0] * units.time),
        force=live(seen.force * force[None]),
        indentation=live(seen.indentation * units.indentation[None]),
        energy=live(0.5 * units.velocity**2 * energy[..., 0]),
        impulse=impulse,
        gap_velocity=live(seen.gap_velocity * (units.velocity * units.root)[None], gamma[None]),
        velocity=v[None] + change(impulse, tangential),
        tangential_force=live(seen.tangential_force * (units.velocity / side / units.time)[None]),
        tangential_impulse=tangential,
        slip=live(seen.slip * (units.velocity * side)[None], before[None]),
        duration=live(time[-1, 0, 0] * units.time),
        maximum_force=live(maximum * force),
        status=live(code[0]).astype(jnp.int32),
    )
