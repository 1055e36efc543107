"""The friction solver against brute force: every outcome, how many there are, and derivatives.

Scenes of fewer contacts are padded with contacts that take no part, so that all planar questions
share one compiled program for each of the two laws, and all spatial ones another.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from programs import CODE

import jimpact as ji


def test_three_solutions_of_moreau():
    """25 of 381 random scenes with two contacts were like this one, and said ok."""
    scene = ji.Scene(
        [1.0] * 4,
        [[2.0, 0.0], [0.0, 0.0], [2.0, 1.0], [0.0, 1.0]],
        tangents=[[-2.0, 2.0], [0.0, 1.0], [0.0, 1.0], [0.0, 2.0]],
    )
    v = np.array([-2.0, 2.0, -2.0, 1.0])
    out = ji.impact(ji.Moreau(0.0, friction=1.0), scene, v)
    assert int(out.status) == CODE["several_outcomes"]


@pytest.mark.slow
def test_a_spinning_cube_flat_on_four_corners_has_several_outcomes():
    """Four corners share the normal impulse in many ways. If the cube spins, the way
    decides how friction changes the spin; without spin only impulses are not unique.
    """
    corners = np.array([[x, y, -0.5] for x in (-0.5, 0.5) for y in (-0.5, 0.5)])

    def along(d):
        """Directions (4, 6) of the corners' motion along d, by v' and omega."""
        return np.concatenate([np.tile(d, (4, 1)), np.cross(corners, d)], axis=1)

    along_x, along_y, along_z = map(along, np.eye(3))
    tangents = np.stack([along_x, along_y], axis=1).reshape(8, 6)
    mass = [1.0] * 3 + [1 / 6] * 3
    cube = ji.Scene(mass, along_z.T, tangents=tangents.T)
    law = ji.Moreau(0.5, friction=0.1)

    @jax.jit
    def status(spin):
        return ji.impact(law, cube, jnp.array([0.3, 0.1, -1, 0, 0, spin])).status

    assert int(status(2.0)) == CODE["several_outcomes"]
    assert int(status(0.0)) == CODE["impulse_not_unique"]
