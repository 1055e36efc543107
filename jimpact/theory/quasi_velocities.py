"""Kinetic quasi-velocities: normal and tangential to the contacts in the kinetic
metric.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from jimpact.core.contact import (
    kinetic_norm,
    normalized_delassus as normalized_delassus,
    normalized_gap_velocity as normalized_gap_velocity,
)
from jimpact.core.quasi_space import quasi_basis as quasi_basis
from jimpact.core.scene import (
    Scene,
    as_velocity,
    gap_velocity,
    momentum,
    velocity_change,
)
from jimpact.numerics.tridiagonal import as_matrix
from jimpact.tools.checks import as_numbers
from jimpact.tools.compiling import full_precision


class ContactPower(eqx.Module):
    """Power of contact forces () [W], its parts as in (6.40).

    `total` is the sum of `normal`, `coupling` and `tangential`.
    """

    normal: jax.Array
    coupling: jax.Array
    tangential: jax.Array
    total: jax.Array


@full_precision
def to_quasi_velocities(scene: Scene, velocity: Any) -> tuple[jax.Array, jax.Array]:
    """Quasi-velocities `qn = n_q^T M v` (m,) and `qt = t_q^T M v` (n - m - b,).

    The columns of n_q (n, m) and t_q (n, n - m - b) are the unit normals of the
    contacts and an orthonormal basis of all tangents, in the kinetic metric M
    (`quasi_basis`).

    Args:
        scene: n coordinates, m contacts, b bilateral constraints.
        velocity: (n,) [m/s]; it satisfies the bilateral constraints.

    Returns:
        qn, qt, both [sqrt(kg) m/s]; qn_j = gamma_j / |grad f_j| < 0 on approach.

    Raises:
        ValueError: redundant contacts; a velocity of another size.

    Source: Brogliato (2016), (6.23).

    >>> import jimpact as ji
    >>> four = ji.chain([2.0, 2.0, 2.0, 2.0])
    >>> qn, qt = ji.theory.to_quasi_velocities(four, [0.3, -0.2, 0.5, 0.7])
    >>> [round(float(q), 6) for q in qn], round(float(qt[0]), 6)
    ([-0.5, 0.7, 0.2], 0.919239)
    """
    v = as_velocity(scene, velocity)
    _, tangent = quasi_basis(scene)
    return normalized_gap_velocity(scene, v), tangent.T @ momentum(scene, v)


@full_precision
def from_quasi_velocities(scene: Scene, normal: Any, tangential: Any) -> jax.Array:
    """The velocity (n,) with these quasi-velocities; inverse of `to_quasi_velocities`.

    Equation: `v = n_q G^-1 qn + t_q qt`, with the normalized Delassus matrix G and the
    basis n_q, t_q of `quasi_basis`; n_q without its part along bilateral constraints.

    Args:
        scene: n coordinates, m contacts, b bilateral constraints.
        normal: qn (m,) [sqrt(kg) m/s].
        tangential: qt (n - m - b,) [sqrt(kg) m/s].

    Returns:
        v (n,) [m/s].

    Raises:
        ValueError: redundant contacts; wrong sizes.

    Source: Brogliato (2016), (6.31)-(6.32), with (6.35) for bilateral constraints.

    >>> import jimpact as ji
    >>> v = ji.theory.from_quasi_velocities(ji.chain([2.0, 2.0]), [-1.0], [2.0])
    >>> [round(float(each), 6) for each in v]
    [1.5, 0.5]
    """
    qn = as_numbers("normal", normal, (scene.contacts,), "one per contact")
    _, tangent = quasi_basis(scene)
    qt = as_numbers(
        "tangential", tangential, tangent.shape[1:], "one per tangent of `quasi_basis`"
    )
    # n_q G^-1 qn = M^-1 N p with p = G^-1 qn / |grad f|
    g = as_matrix(normalized_delassus(scene))
    impulse = jnp.linalg.solve(g, qn) / kinetic_norm(scene)
    return velocity_change(scene, impulse) + tangent @ qt


@full_precision
def kinetic_energy_split(scene: Scene, velocity: Any) -> tuple[jax.Array, jax.Array]:
    """Normal and tangential kinetic energy [J]; their sum is the kinetic energy.

    Equation: `T_n = qn^T G^-1 qn / 2`, `T_t = qt^T qt / 2`, G the normalized Delassus
    matrix. Frictionless impacts change T_n only.

    Args:
        scene: n coordinates, m contacts, b bilateral constraints.
        velocity: (n,) [m/s]; it satisfies the bilateral constraints.

    Returns:
        T_n () and T_t () [J].

    Raises:
        ValueError: redundant contacts; not one velocity per coordinate.

    Source: Brogliato (2016), (6.33)-(6.35).

    >>> import jimpact as ji
    >>> split = ji.theory.kinetic_energy_split(ji.chain([2.0, 2.0]), [1.5, 0.5])
    >>> [round(float(t), 6) for t in split]
    [0.5, 2.0]
    """
    qn, qt = to_quasi_velocities(scene, velocity)
    weighted = jnp.linalg.solve(as_matrix(normalized_delassus(scene)), qn)
    return 0.5 * qn @ weighted, 0.5 * qt @ qt


@full_precision
def contact_power(
    scene: Scene, velocity: Any, force: Any, tangential_force: Any = None
) -> ContactPower:
    """Power that contact forces feed into a motion, split as (6.40).

    Equation: with `F_norm^n = G lambda_bar`, `F_norm^t = n_q^T H lambda_t` and
    `F_tan^t = t_q^T H lambda_t`: `normal = <F_norm^n, qn>_Dn = gamma^T lambda`
    (6.36)-(6.37), `coupling = <qn, F_norm^t>_Dn`, `tangential = <qt, F_tan^t>_Dt`
    (6.39), where `<a, b>_D = a^T D b`, `D_n = G^-1`, `D_t = I`,
    `lambda_bar = |grad f| lambda`; G, n_q, t_q as in `from_quasi_velocities`, H the
    tangents. Coupling and tangential together are the local power `v_t^T lambda_t` of
    (6.41).

    Args:
        scene: n coordinates, m contacts; with tangents where tangential forces act.
        velocity: (n,) [m/s]; it satisfies the bilateral constraints.
        force: normal forces lambda (m,) [N], or impulses for a work.
        tangential_force: lambda_t, one per column of the tangents [N]; None: 0.

    Returns:
        `ContactPower`, each term () [W].

    Raises:
        ValueError: redundant contacts, wrong sizes, tangential forces without tangents.

    Source: Brogliato (2016), (6.36)-(6.41).

    >>> import jimpact as ji
    >>> float(ji.theory.contact_power(ji.chain([2.0, 2.0]), [1.5, 0.5], [3.0]).total)
    -3.0
    """
    lambda_n = as_numbers("force", force, (scene.contacts,), "one per contact")
    v = as_velocity(scene, velocity)
    qn, qt = to_quasi_velocities(scene, v)
    normal = lambda_n @ gap_velocity(scene, v)
    if tangential_force is None:
        zero = jnp.zeros_like(normal)
        return ContactPower(normal, zero, zero, normal)
    if scene.tangents is None:
        raise ValueError(
            "Argument `scene` must have tangents where tangential forces act."
        )
    shape = scene.tangents.shape[1:]
    lambda_t = as_numbers(
        "tangential_force", tangential_force, shape, "one per tangent"
    )
    _, t_q = quasi_basis(scene)
    # M^-1 H lambda_t
    accelerated = velocity_change(scene, jnp.zeros_like(lambda_n), lambda_t)
    f_norm = normalized_gap_velocity(scene, accelerated)  # n_q^T H lambda_t
    coupling = qn @ jnp.linalg.solve(as_matrix(normalized_delassus(scene)), f_norm)
    tangential = qt @ (t_q.T @ (scene.tangents @ lambda_t))
    return ContactPower(normal, coupling, tangential, normal + coupling + tangential)
