"""The contacts of a pile in one time step: who touches whom, and with which impulse."""

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from jimpact.bodies.closed_pairs import listed_pairs
from jimpact.core.law import Law
from jimpact.core.scene import Scene
from jimpact.motion.dynamics import is_pile
from jimpact.motion.start import start_of
from jimpact.motion.step_contacts import check_stepped_law
from jimpact.motion.stepping import step_of_pile
from jimpact.motion.system import System
from jimpact.tools.checks import (
    as_float_array,
    check_concrete,
    check_kind,
    in_common_dtype,
)
from jimpact.tools.compiling import quick_jit


class PileContacts(NamedTuple):
    """The m closed contacts of a pile in one step: those of bodies i < j first, then
    with walls.

    Args:
        bodies: (m, 2) numbers i, j; -1 for a wall.
        normals: (m, d) unit vectors towards body i, d = 2 or 3.
        impulse: p (m,) >= 0 [N s]; over the step it is the mean force.
        tangential: (m, d) impulse on body i along the contact plane [N s].
        velocity: (n,) after the step.
        status: () of the step, as of a motion.
        scene: the contacts as a scene without friction, for `ji.plot.force_chains`.

    >>> import jimpact as ji
    >>> ball = ji.Bodies([ji.Sphere(0.1)], room=8)
    >>> system, v = ji.System(ball), [1.0, 0.0, -2.0, 0.0, 0.0, 0.0]
    >>> law = ji.Moreau(0.5, friction=0.05)
    >>> found = ji.TimeStepping(1e-9).contacts(
    ...     system, law, ball.at([[0.0, 0.0, 0.1]]), v
    ... )
    >>> (
    ...     round(float(found.impulse[0]), 6),
    ...     [round(float(x), 6) for x in found.tangential[0]],
    ... )
    (3.0, [-0.15, 0.0, 0.0])
    """

    bodies: np.ndarray
    normals: np.ndarray
    impulse: np.ndarray
    tangential: np.ndarray
    velocity: Float[Array, " n"]
    status: Int[Array, ""]
    scene: Scene


def contacts_of_step(
    system: System, law: Law, q: Any, v: Any, t: Any, step: float, closed_below: Any
) -> PileContacts:
    """Closed contacts of a pile and their impulses in one step, see
    `TimeStepping.contacts`.
    """
    check_kind("system", system, System)
    check_kind("law", law, Law)
    if not is_pile(system):
        raise ValueError(
            "Argument `system` must be of a body with many contacts (`Bodies`), "
            f"but is of {type(system.body).__name__}."
        )
    q = as_float_array("q", q)
    v = as_float_array("v", v)
    check_concrete("q", q)
    system, law, q, v = in_common_dtype(system, law, q, v)
    times = (t, t + step)
    start = start_of(system, law, q, v, times, closed_below)
    check_stepped_law(
        system, law, start.contacts, law.joins_step and system.friction is None
    )
    made = jax.device_get(_step(start, law))
    if not made.pairs.filled:
        raise ValueError(
            "Arguments `q` and `v` must lead to a contact within the step."
        )
    order, bodies, directions, scene = listed_pairs(made.pairs, system.mass)
    # directions (m, b, body i or j, velocity): the first d velocities of a body are
    # those of places
    impulse = made.impulse[order]
    d = (directions.shape[3] + 1) // 2
    return PileContacts(
        bodies=bodies,
        normals=directions[:, 0, 0, :d],
        impulse=impulse[:, 0],
        tangential=np.einsum("mk,mkx->mx", impulse[:, 1:], directions[:, 1:, 0, :d]),
        velocity=made.velocity,
        status=made.status,
        scene=scene,
    )


_step = quick_jit(step_of_pile)
