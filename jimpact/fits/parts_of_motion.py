"""What a fit of a motion may have as parameters besides those of the law: start,
gravity, floor.
"""

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jimpact.core.contact import Contact
from jimpact.core.law import Impulses, Law, OptionalValues, forwards_to_law, parameter

if TYPE_CHECKING:  # a fit of impacts imports no motion
    from jimpact.motion.record import Motion
    from jimpact.motion.system import System

OF_A_MOTION = ("q0", "v0", "gravity", "floor")
# Share of the weight by which the forces of a system at its start may differ from a
# weight's, by rounding in single precision. Ten times more would still refuse every
# other potential.
OTHER_FORCES = 1e-4


@forwards_to_law
class LawInMotion(Law):
    """A law, and the parts of a motion that are fitted with it; None: as the motion has
    them.

    The start (n,) or (K, n), the acceleration of gravity, and the height of the floor,
    by which all heights are above those that the body's gaps are measured from.
    """

    law: Law
    q0: OptionalValues = parameter(per_contact=False, default=None)
    v0: OptionalValues = parameter(per_contact=False, default=None)
    gravity: OptionalValues = parameter(low=0.0, per_contact=False, default=None)
    floor: OptionalValues = parameter(per_contact=False, default=None)

    def impulses(self, contact: Contact) -> Impulses:
        """Impulses of the law."""
        return self.law.impulses(contact)

    def in_system(self, system: "System") -> "System":
        """The system with the potential of this gravity in the place of its own."""
        if self.gravity is None:
            return system
        weight = system.body.gravity(self.gravity)
        return eqx.tree_at(lambda s: s.potential, system, weight)

    def start(
        self, system: "System", q0: jax.Array, v0: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Fitted start q0, v0, else the given one; heights in q0 are above the fitted
        floor.
        """
        if self.q0 is not None:
            q0 = self.q0
        if self.v0 is not None:
            v0 = self.v0
        if self.floor is None:
            return q0, v0
        return q0 - jnp.broadcast_to(self.floor * _up(system), q0.shape), v0

    def seen(self, motion: "Motion", system: "System") -> "Motion":
        """The motion with heights as they were measured: those above the floor, plus
        its height.
        """
        if self.floor is None:
            return motion
        rise = (self.floor * _up(system))[None, :]
        raised = motion.q + rise, motion.events.q + rise
        return eqx.tree_at(lambda m: (m.q, m.events.q), motion, raised)


def _up(system: "System") -> jax.Array:
    """(n,) change of the coordinates q where all bodies are lifted by one metre."""
    directions = system.body.base_directions
    assert directions is not None  # `with_parts_of_motion` has seen to it
    return directions[:, -1]


def with_parts_of_motion(
    law: Law, system: "System", q0: jax.Array, v0: jax.Array, free: Iterable[str]
) -> Law:
    """The law with the parts of the motion that `free` names; the law itself, if it
    names none.

    Args:
        law: to fit.
        system: the moving bodies.
        q0, v0: start (n,), or starts (K, n); gravity is read at the first one.
        free: names, of the law's parameters or of `OF_A_MOTION`: start q0, velocity v0,
            `gravity` g >= 0 [m/s^2], `floor`: its height () [m] in the coordinates that
            were measured.

    Raises:
        ValueError: parts that the motion does not have.
    """
    wanted = [name for name in OF_A_MOTION if name in free]
    if not wanted:
        return law
    if q0.shape != v0.shape and {"q0", "floor"} & set(wanted):
        raise ValueError(
            "Argument `free` must not name `q0` or `floor` of bodies whose poses are "
            "quaternions."
        )
    # of q where the base moves, None: it has no floor
    directions = system.body.base_directions
    if "floor" in wanted and (directions is None or system.base is not None):
        if system.base is not None:
            where = " on a moving base"
        else:
            where = ""
        raise ValueError(
            f"Argument `free` may name `floor` only of bodies over a floor at rest, "
            f"but the system is of a {type(system.body).__name__}{where}."
        )
    values: dict[str, Any] = {"q0": q0, "v0": v0, "floor": jnp.zeros((), q0.dtype)}
    if "gravity" in wanted:
        values["gravity"] = _acceleration(system, q0.reshape(-1, q0.shape[-1])[0])
    return LawInMotion(law, **{name: values[name] for name in wanted})


def _acceleration(system: "System", q: jax.Array) -> jax.Array:
    """The acceleration of gravity g () of a system, from its forces at q (n,) [m/s^2].

    Equation: `g = f^T w / w^T w`, f the gradient of its potential, w that of the weight
    with g = 1.

    Raises:
        ValueError: f is not g w: there are other forces, or none.
    """
    refused = ValueError(
        "Argument `free` may name `gravity` only of a system whose one potential is "
        "its weight: give it `gravity=`."
    )
    if system.potential is None:
        raise refused
    try:
        unit = np.asarray(jax.grad(system.body.gravity(jnp.ones((), q.dtype)))(q + 1.0))
    except TypeError:
        raise refused from None
    force = np.asarray(jax.grad(system.potential)(q + 1.0))
    size = float(force @ unit / (unit @ unit))
    if np.abs(force - size * unit).max() > OTHER_FORCES * np.abs(force).max():
        raise refused
    return jnp.asarray(size, q.dtype)
