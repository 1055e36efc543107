"""Builders of scenes: chains and columns."""

from typing import Any

import equinox as eqx
import jax

from jimpact._checks import as_float_array, check_shape, check_values
from jimpact.scene import Scene, chain_scene

_WALLS = {
    False: (False, False),
    True: (False, True),
    "right": (False, True),
    "left": (True, False),
    "both": (True, True),
}


def chain(masses: Any, wall: bool | str = False, gaps: Any = None) -> Scene:
    """A row of bodies along +x; contact j joins bodies j and j+1.

    Equation: `gamma_j = v_{j+1} - v_j`; at a wall on the right `gamma_m = -v_n`, on the left
    `gamma_1 = v_1`. The Delassus matrix is tridiagonal and never formed densely.

    Args:
        masses: (n,) > 0 [kg].
        wall: False; True or 'right': last contact; 'left': first contact; 'both'.
        gaps: (m,) >= 0 [m], None: all closed.

    Raises:
        ValueError: masses or gaps out of range or of wrong shape, unknown wall, no contact.

    >>> import jimpact as ji
    >>> ji.chain([1.0, 1.0, 1.0], wall=True).contacts
    3
    """
    if wall not in _WALLS:
        raise ValueError(
            f"Argument `wall` must be one of False, True, 'left', 'right', 'both', "
            f"but has value {wall!r}."
        )
    mass = as_float_array("masses", masses)
    if mass.ndim != 1:
        raise ValueError(f"Argument `masses` must have shape (n,), but has shape {mass.shape}.")
    check_values("masses", mass, low=0.0, open_low=True)
    left, right = _WALLS[wall]
    contacts = mass.shape[0] - 1 + left + right
    if contacts < 1:
        raise ValueError(
            f"Argument `masses` must give at least one contact, "
            f"but {mass.shape[0]} body and wall={wall!r} give none."
        )
    if gaps is not None:
        gaps = as_float_array("gaps", gaps)
        check_shape("gaps", gaps, (contacts,), "one gap per contact")
        check_values("gaps", gaps, low=0.0)
    return chain_scene(mass, (left, right), gaps)


def column(masses: Any, gaps: Any = None) -> Scene:
    """A column of bodies above a floor: `chain(masses, wall='right')`, +x down, body 1 on top.

    >>> import jimpact as ji
    >>> ji.column([1.0, 1.0]).contacts
    2
    """
    return chain(masses, wall="right", gaps=gaps)


def with_gaps(scene: Scene, gaps: jax.Array) -> Scene:
    """The scene with these gaps (m,)."""
    return eqx.tree_at(lambda tree: tree.gaps, scene, gaps, is_leaf=lambda x: x is None)
