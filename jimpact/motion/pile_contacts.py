"""The contacts of a pile in one time step: who touches whom, and with which impulse."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jimpact._checks import as_float_array, check_concrete, check_kind, in_common_dtype
from jimpact.bodies.base import listed_pairs
from jimpact.compiling import quick_jit
from jimpact.law import Law
from jimpact.motion.arguments import check_motion, check_stepped_law, friction_of, substeps_of
from jimpact.motion.dynamics import is_pile
from jimpact.motion.simulate import closed_gaps
from jimpact.motion.stepping import step_of_pile
from jimpact.motion.system import System
from jimpact.scene import Scene


class PileContacts(NamedTuple):
    """What `pile_contacts` returns: m contacts, those of bodies i < j first, then with walls.

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
    >>> found = ji.pile_contacts(system, law, ball.at([[0.0, 0.0, 0.1]]), v, step=1e-9)
    >>> round(float(found.impulse[0]), 6), [round(float(x), 6) for x in found.tangential[0]]
    (3.0, [-0.15, 0.0, 0.0])
    """

    bodies: np.ndarray
    normals: np.ndarray
    impulse: np.ndarray
    tangential: np.ndarray
    velocity: jax.Array
    status: jax.Array
    scene: Scene


def pile_contacts(
    system: System, law: Law, q: Any, v: Any, step: float, *, t: Any = 0.0, friction: Any = None
) -> PileContacts:
    """The contacts of a pile, and their impulses, in the step of time stepping that begins at q, v.

    Equation: that of `simulate(method="time_stepping")`: `0 <= p _|_ gamma' + w >= 0`,
    `|p_t| <= mu p`. In a heap at rest `impulse / step` are the contact forces; without forces of
    the system, and with a step in which nothing moves far, it is an impact by Moreau's law, with
    friction, on a packing of any size.

    Args:
        system: of a body with many contacts (`Bodies`).
        law: `Moreau`.
        q: (n,), for example a sample of a motion.
        v: (n,) [m/s, rad/s].
        step: its length > 0 [s], that of the motion.
        t: time at its begin [s].
        friction: mu (), as of `simulate`.

    Returns:
        `PileContacts`: bodies, normals, impulses, velocity after the step. Not differentiable, not
        inside jit.

    Raises:
        ValueError: as of `simulate`; a system without many contacts, no contact in this step.

    Source: Brogliato, Nonsmooth Mechanics (2016), Remark 6.9.

    >>> import jimpact as ji
    >>> discs = ji.Bodies([ji.Disc(0.1, 1.0), ji.Disc(0.1, 2.0)], room=8)
    >>> system = ji.System(discs, gravity=10.0)
    >>> q = discs.at([[0.0, 0.3], [0.0, 0.1]])
    >>> found = ji.pile_contacts(system, ji.Moreau(0.0), q, [0.0] * 6, step=1e-3)
    >>> found.bodies.tolist(), [round(float(p) / 1e-3, 3) for p in found.impulse]
    ([[0, 1], [1, -1]], [10.0, 30.0])
    """
    check_kind("system", system, System)
    check_kind("law", law, Law)
    if not is_pile(system):
        raise ValueError(
            "Argument `system` must be of a body with many contacts (`Bodies`), "
            f"but is of {type(system.body).__name__}."
        )
    q, v = as_float_array("q", q), as_float_array("v", v)
    check_concrete("q", q)
    system, law, q, v = in_common_dtype(system, law, q, v)
    substeps_of(step, t, t + step, 2)
    times = jnp.asarray([t, t + step], q.dtype)
    f = check_motion(system, q, v, *times)
    mu = friction_of(system, law, friction, q)
    check_stepped_law(system, law, q, law.joins_step and friction is None)
    below, _ = closed_gaps(q, f, None)
    pairs, impulse, after, status = jax.device_get(_step(system, law, mu, q, v, times, below))
    if not pairs.filled:
        raise ValueError("Arguments `q` and `v` must lead to a contact within the step.")
    order, bodies, ways, scene = listed_pairs(pairs, system.mass)
    x, places = impulse[order], (ways.shape[3] + 1) // 2
    tangential = np.einsum("mk,mkx->mx", x[:, 1:], ways[:, 1:, 0, :places])
    return PileContacts(bodies, ways[:, 0, 0, :places], x[:, 0], tangential, after, status, scene)


_step = quick_jit(step_of_pile)
