"""Contact forces whose pairs have the same restitution, compared on one scene."""

from typing import Any

import jax
import jax.numpy as jnp

from jimpact._checks import as_float_array, check_per_contact, check_values
from jimpact.contact import delassus_matrix
from jimpact.laws.calibration import calibrate
from jimpact.laws.compliant import Compliant
from jimpact.laws.forces import Bistiffness, Force, HuntCrossley, KelvinVoigt, KuwabaraKono
from jimpact.methods.comparison import Comparison, compare
from jimpact.scene import Scene, gap_velocity
from jimpact.solvers.tridiagonal import diagonal


def compare_rheologies(
    scene: Scene, velocity: Any, restitution: Any, stiffness: Any = 1.0
) -> Comparison:
    """Outcomes of all contact forces whose pairs have the same restitution at this approach.

    Each contact is calibrated at its reduced mass `1/W_jj` and the largest approach speed. The
    linear forces get the stiffness that reaches the same largest indentation as Hertz's:
    `k_linear = 0.8 k sqrt(x_max)`.

    Args:
        scene: n coordinates, m contacts, with gaps or without.
        velocity: v- (n,) [m/s]; something must approach.
        restitution: e in [0.05, 1], scalar or (m,).
        stiffness: Hertz k, scalar or (m,) [N / m^1.5].

    Returns:
        `Comparison` with an entry for each force; `ji.plot.rheologies` draws it.

    Raises:
        ValueError: nothing approaches, restitution or stiffness out of range.

    >>> import jimpact as ji
    >>> result = ji.compare_rheologies(ji.chain([1.0, 1.0, 1.0]), [1.0, 0.0, 0.0], 0.9)
    >>> for name, entry in result.entries.items():
    ...     print(f"{name:20}", *(f"{float(v):7.3f}" for v in entry.outcome.velocity))
    Hertz, bistiffness    -0.009   0.104   0.904
    linear, bistiffness   -0.065   0.167   0.898
    Kelvin-Voigt          -0.098   0.191   0.907
    Hunt-Crossley         -0.039   0.123   0.916
    Kuwabara-Kono         -0.039   0.124   0.916
    """
    k = as_float_array("stiffness", stiffness)
    check_values("stiffness", k, low=0.0, open_low=True)
    forces = forces_of_equal_restitution(scene, velocity, restitution, k)
    return compare(scene, velocity, {name: Compliant(force) for name, force in forces.items()})


def forces_of_equal_restitution(
    scene: Scene, velocity: Any, restitution: Any, stiffness: jax.Array
) -> dict[str, Force]:
    """The forces that `compare_rheologies` compares, each with arrays of shape (m,)."""
    for name, value in (("restitution", restitution), ("stiffness", stiffness)):
        check_per_contact(name, value, scene.contacts)
    mass = 1 / diagonal(delassus_matrix(scene))
    speed = jnp.max(-gap_velocity(scene, velocity))
    check_values("velocity: its largest approach", speed, low=0.0, open_low=True)
    deepest = (1.25 * mass * speed**2 / stiffness) ** 0.4
    k, linear = jnp.broadcast_to(stiffness, mass.shape), 0.8 * stiffness * jnp.sqrt(deepest)
    e = as_float_array("restitution", restitution)
    none = jnp.zeros_like(k)
    undamped: dict[str, Force] = {
        "Hertz, bistiffness": Bistiffness(k, 1.5),
        "linear, bistiffness": Bistiffness(linear, 1.0),
        "Kelvin-Voigt": KelvinVoigt(linear, none),
        "Hunt-Crossley": HuntCrossley(k, none),
        "Kuwabara-Kono": KuwabaraKono(k, none),
    }
    return {name: calibrate(force, e, mass, speed) for name, force in undamped.items()}
